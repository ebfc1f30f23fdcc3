"""Range, azimuth and elevation turned into x, y, z: mean and covariance of the converted error.

With u = 1 − exp(−σ²) of an angle (u_a azimuth, u_e elevation), s = r² + σ_r², and h = E cos²(elevation measured) =
u_e(2 − u_e)/2 + (1 − u_e)² cos²β, in the vertical plane through the line of sight and across it:

    along    h (σ_r² (1 − u_a) + s u_a²/2) + r² (1 − u_a) u_e [1 − u_e/2 − (1 − u_e) cos²β]
    across   h s u_a (2 − u_a)/2                                                                    the paper's x
    up       σ_r² (1 − h) + r² u_e [1 − u_e/2 − (1 − u_e) sin²β]                                      the paper's z
    coupling √(1 − u_a) (1 − u_e) [σ_r² (1 − u_e) − r² u_e] cos β sin β                                the paper's w
    bias     (λ_a λ_e − 1) (x, y),  (λ_e − 1) z,   λ = √(1 − u)

turned by the azimuth: R = [along c² + across q², (along − across) cq, coupling c; …; …]; along − across is the
paper's y. These are its eqs 5–10 arranged so that no large numbers cancel. They hold given the true position.
`averaged_moments` are their means over the true positions that a measurement leaves open (Lerro and Bar-Shalom 1993).

Source: Yang et al. (1998), eqs 5–10. Corrections: elevation's variance in all of eq 7 and 15, with 1 − exp(+σ²) in the
bracket; eq 11 with the two angles exchanged; R is an outer product; the bias, which the paper does not print.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from trackers.compiled import helper, kernel
from trackers.linalg import JITTER
from trackers.measurement import MIN_RANGE_SQUARED

KINDS = {"range_az_el": True, "az_el": False}
"""Kinds of sensors, and whether they measure range."""

MIN_RANGE_M = 1.0e3
"""Default of the closest a target may come to a sensor: nearer, a degree is no longer a small angle's error."""


class Moments(NamedTuple):
    """A converted measurement's error.

    Attributes:
        bias: [..., 3] m, mean; subtract it from the converted measurement.
        cov: [..., 3, 3] m².
    """

    bias: Any
    cov: Any


def polar(position, sensor):
    """Range [m], azimuth and elevation [rad], [..., 3], of `position` [..., ≥3] from `sensor` [..., 3]."""
    dx, dy, dz = (np.asarray(position)[..., i] - np.asarray(sensor)[..., i] for i in range(3))
    level = np.hypot(dx, dy)
    return np.stack([np.hypot(level, dz), np.arctan2(dy, dx), np.arctan2(dz, level)], axis=-1)


def convert(measurement, sensor):
    """Position [..., 3] m of range, azimuth and elevation [..., 3] measured by `sensor` [..., 3]; still biased."""
    r, azimuth, elevation = (np.asarray(measurement)[..., i] for i in range(3))
    level = r * np.cos(elevation)
    line = np.stack([level * np.cos(azimuth), level * np.sin(azimuth), r * np.sin(elevation)], axis=-1)
    return line + np.asarray(sensor)


# -- moments ----------------------------------------------------------------------------------------------------------


@helper
def shrinkage(angle_std):
    """u = 1 − exp(−σ²) of an angle."""
    return -math.expm1(-angle_std * angle_std)


@helper
def _principal(r2, level, slope, var, ua, ue):
    """Variances along the level line of sight, across it and upright, and the covariance of the first and the last.

    Of r², cos²β, cos β sin β, or means of these.
    """
    s, ea, ee = r2 + var, 1.0 - ua, 1.0 - ue
    h = 0.5 * ue * (1.0 + ee) + ee * ee * level
    steep = 0.5 * (1.0 + ee)
    along = h * (var * ea + 0.5 * s * ua * ua) + r2 * ea * ue * (steep - ee * level)
    across = 0.5 * h * s * ua * (1.0 + ea)
    upright = var * (1.0 - h) + r2 * ue * (steep - ee * (1.0 - level))
    return along, across, upright, math.sqrt(ea) * ee * (var * ee - r2 * ue) * slope


@helper
def _turn_into(principal, c, q, cc, cq, qq, R):
    """Fill R [3, 3] from what `_principal` gives and cos θ, sin θ, their squares and product, or means of these."""
    along, across, upright, coupling = principal
    R[0, 0] = along * cc + across * qq
    R[1, 1] = along * qq + across * cc
    R[2, 2] = upright
    R[0, 1] = R[1, 0] = (along - across) * cq
    R[0, 2] = R[2, 0] = coupling * c
    R[1, 2] = R[2, 1] = coupling * q


@helper
def _shortening(ua, ue):
    """λ_a λ_e − 1 and λ_e − 1."""
    la, le = math.sqrt(1.0 - ua), math.sqrt(1.0 - ue)
    upright = -ue / (1.0 + le)
    return upright * la - ua / (1.0 + la), upright


@helper
def moments_at(dx, dy, dz, range_std, ua, ue, R):
    """Bias (x, y, z) [m] of a target at (dx, dy, dz) [m] from the sensor; fills R [3, 3]."""
    rho2 = max(dx * dx + dy * dy, MIN_RANGE_SQUARED)
    r2, rho = rho2 + dz * dz, math.sqrt(rho2)
    c, q = dx / rho, dy / rho
    principal = _principal(r2, rho2 / r2, rho * dz / r2, range_std * range_std, ua, ue)
    _turn_into(principal, c, q, c * c, c * q, q * q, R)
    flat, upright = _shortening(ua, ue)
    return flat * dx, flat * dy, upright * dz


@helper
def information_at(dx, dy, dz, range_std, ua, ue, info):
    """Fill info [3, 3] with the inverse of what `moments_at` fills R with."""
    rho2 = max(dx * dx + dy * dy, MIN_RANGE_SQUARED)
    r2, turn = rho2 + dz * dz, 1.0 / math.sqrt(rho2)
    c, q, shrink = dx * turn, dy * turn, 1.0 / r2
    along, across, upright, coupling = _principal(
        r2, rho2 * shrink, rho2 * turn * dz * shrink, range_std * range_std, ua, ue
    )
    over = 1.0 / max(along * upright - coupling * coupling, JITTER * along * upright)
    _turn_into((upright * over, 1.0 / across, along * over, -coupling * over), c, q, c * c, c * q, q * q, info)


@helper
def averaged_at(dx, dy, dz, range_std, ua, ue, R):
    """The same averaged over where the target may be when (dx, dy, dz) [m] is the converted measurement."""
    rho2 = max(dx * dx + dy * dy, MIN_RANGE_SQUARED)
    r2, rho = rho2 + dz * dz, math.sqrt(rho2)
    c, q, ea, ee, var = dx / rho, dy / rho, 1.0 - ua, 1.0 - ue, range_std * range_std
    la, ee2, ea2, blur = math.sqrt(ea), ee * ee, ea * ea, 0.5 * ua * (1.0 + ea)
    level, slope = 0.5 * ue * (1.0 + ee) + ee2 * rho2 / r2, ee2 * rho * dz / r2
    cc, qq = blur + ea2 * c * c, blur + ea2 * q * q
    _turn_into(_principal(r2 + var, level, slope, var, ua, ue), la * c, la * q, cc, ea2 * c * q, qq, R)
    flat, upright = _shortening(ua, ue)
    flat, upright = flat * (1.0 + flat), upright * (1.0 + upright)
    return flat * dx, flat * dy, upright * dz


@kernel("(p3),(p3),()->(p3),(p3,p3)", "FFbFF")
def _moments(line, std, averaged, bias, R):
    ua, ue = shrinkage(std[1]), shrinkage(std[2])
    if averaged:
        bias[0], bias[1], bias[2] = averaged_at(line[0], line[1], line[2], std[0], ua, ue, R)
    else:
        bias[0], bias[1], bias[2] = moments_at(line[0], line[1], line[2], std[0], ua, ue, R)


def moments(position, sensor, std) -> Moments:
    """Bias and covariance of the converted measurement of a target known to be at `position`.

    Args:
        position: [..., 3] m; sensor: [..., 3] m.
        std: [..., 3] standard deviations of range [m], azimuth and elevation [rad].
    """
    return Moments(*_moments(np.asarray(position)[..., :3] - sensor, std, False))


def averaged_moments(measurement, std) -> Moments:
    """Bias and covariance where only the measurement [..., 3] (range m, azimuth, elevation rad) is known."""
    return Moments(*_moments(convert(measurement, np.zeros(3)), std, True))


# -- layouts ----------------------------------------------------------------------------------------------------------


class Layout(NamedTuple):
    """n sensors.

    Attributes:
        position: [..., n, 3] m, east-north-up, ground at height 0; of sensors that move [..., k, n, 3], one per scan.
        std: [..., n, 3] standard deviations of range [m], azimuth and elevation [rad].
        ranging: [..., n] bool, whether a sensor measures range (`KINDS`); the range std of others is not used.
    """

    position: Any
    std: Any
    ranging: Any

    def check(self) -> None:
        """Raise a ValueError that names the first sensor that cannot be.

        Raises:
            ValueError: shapes that do not belong together, a sensor under ground or nowhere, an accuracy that is not
                positive and finite.
        """
        position, std, ranging = map(np.asarray, self)
        if ranging.dtype != bool:
            raise ValueError(f"ranging has dtype {ranging.dtype}: must be bool, see ranging_of")
        n = ranging.shape[-1] if ranging.ndim else 0
        if n < 1 or position.shape[-2:] != (n, 3) or std.shape[-2:] != (n, 3):
            shapes = f"position {position.shape}, std {std.shape}, ranging {ranging.shape}"
            raise ValueError(f"layout has {shapes}: must be [..., n, 3], [..., n, 3], [..., n] with n of at least 1")
        if not np.isfinite(position).all():  # far quicker than to look at every sensor by itself
            _refuse(np.asarray(~np.isfinite(position).all(-1)), position, "position {} m: must be finite")
        _refuse(np.asarray(position[..., 2] < 0.0), position[..., 2], "height {} m: is under ground, must be 0 or more")
        used = np.where(ranging[..., None] | np.array([False, True, True]), std, 1.0)
        sound = (used > 0.0) & np.isfinite(used)
        _refuse(
            np.asarray(~sound.all(-1)),
            used,
            "std {} (range m, azimuth rad, elevation rad): must be positive and finite",
        )


def _refuse(bad: np.ndarray, value: np.ndarray, words: str) -> None:
    """Raise a ValueError about the first sensor of `bad` [..., n]."""
    if bad.any():
        at = tuple(int(i) for i in np.argwhere(bad)[0])
        raise ValueError(f"sensor {at[-1]} of layout {list(at[:-1])}: " + words.format(np.asarray(value)[at]))


def ranging_of(kinds: Sequence[str]) -> np.ndarray:
    """Whether each of the kinds of sensors measures range, [n] bool.

    Raises:
        ValueError: an unknown kind.
    """
    for kind in kinds:
        if kind not in KINDS:
            raise ValueError(f"sensor kind {kind!r}: must be one of {', '.join(map(repr, KINDS))}")
    return np.array([KINDS[kind] for kind in kinds], dtype=bool)
