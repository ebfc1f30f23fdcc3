"""The paper's target and radars: paths, layouts, what the theory promises them, Monte Carlo on them.

The specification's choices fill the paper's gaps: the first two scans start the track with their two-point covariance;
sensor 1 stays at the origin, the others stand 200 km from the target's first position.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from trackers import ConvertedFusion, Layout
from trackers.consistency import nees
from trackers.converted_measurement import convert, moments, polar
from trackers.linalg import psd_inverse, symmetrize
from trackers.motion_3d import process_noise_3d, transition_3d

STEP_S, SCANS = 1.0, 51
"""Fifty scans after the first."""

DISTANCE_M, HEIGHT_M, SPEED_M_S = 200.0e3, 10.0e3, 300.0
ACCELERATION_STD = 1.0
EQUAL = (50.0, 1.0, 1.0)
"""Standard deviations of range [m], azimuth and elevation [deg]."""

LAST = 10
"""Scans over which Monte Carlo errors are averaged: the last ones."""

MOST_SENSORS = 3
RISE = math.atan2(HEIGHT_M, DISTANCE_M)
"""Elevation at which a sensor on the ground sees the target's first position [rad]."""


def straight_path() -> np.ndarray:
    """The target without process noise, [k, 6]: at 10 km, from 200 km at 300 m/s towards the origin."""
    t = STEP_S * np.arange(SCANS)
    still = np.zeros(SCANS)
    return np.stack([DISTANCE_M - SPEED_M_S * t, still, still + HEIGHT_M, still - SPEED_M_S, still, still], axis=-1)


def ring(azimuth_deg: Any, height_m: Any = 0.0, std: Sequence[float] = EQUAL, distance_m: float = DISTANCE_M) -> Layout:
    """Sensors at a horizontal distance around the target's first position; azimuth 0 is at the origin.

    Args:
        azimuth_deg: [..., n]; height_m: [..., n] or one number.
        std: of range [m], azimuth and elevation [deg].
    """
    around = math.pi + np.deg2rad(np.asarray(azimuth_deg, dtype=float))
    x, y = DISTANCE_M + distance_m * np.cos(around), distance_m * np.sin(around)
    position = np.stack([x, y, np.broadcast_to(np.asarray(height_m, dtype=float), x.shape)], axis=-1)
    n = x.shape[-1]
    return Layout(position, np.tile([std[0], *np.deg2rad(std[1:])], (n, 1)), np.ones(n, dtype=bool))


def raised(elevation_deg):
    """Height [m] from which the target is seen this much lower than from the ground."""
    return np.maximum(HEIGHT_M + DISTANCE_M * np.tan(np.deg2rad(elevation_deg) - RISE), 0.0)


def pair(azimuth_deg: Any = 0.0, elevation_deg: Any = 0.0, std: Sequence[float] = EQUAL) -> Layout:
    """Sensor 1 at the origin, sensor 2 off by azimuth θ12 and elevation β12 as seen from the target; broadcasts."""
    azimuth, height = np.broadcast_arrays(np.asarray(azimuth_deg, dtype=float), raised(elevation_deg))
    zero = np.zeros_like(azimuth)
    return ring(np.stack([zero, azimuth], -1), np.stack([zero, height], -1), std)


def position_error(layout: Layout) -> np.ndarray:
    """√(p₁₁ + p₂₂ + p₃₃) [...] m after the last scan, in theory."""
    return ConvertedFusion().theoretical(straight_path(), layout).position_std_m[..., -1]


def error_ratio(layout: Layout) -> np.ndarray:
    """The same over that of the first of these sensors alone at the origin."""
    alone = Layout(np.zeros((1, 3)), layout.std[:1], layout.ranging[:1])
    return position_error(layout) / position_error(alone)


# -- variants of the theory, in plain matrices ------------------------------------------------------------------------


def printed_r33(position, sensor, std) -> np.ndarray:
    """Eq 7 as printed [...] m²: azimuth's variance in the first term, 1 − exp(−σ²) in the bracket."""
    line = np.asarray(position) - sensor
    var_r, var_a, var_e = np.square(std)
    r2 = np.square(line).sum(-1)
    bracket = r2 * -np.expm1(-var_e) + var_r
    return 0.5 * (r2 + var_r) * -np.expm1(-2.0 * var_a) + bracket * np.exp(-2.0 * var_e) * line[..., 2] ** 2 / r2


def matrix_error(layout: Layout, start_cov: np.ndarray | None = None, printed: bool = False) -> float:
    """`position_error` of one layout written without the kernels, with a start or an R33 of its own.

    Args:
        layout: n sensors.
        start_cov: [6, 6] after the second scan; None takes the two-point covariance.
        printed: R33 as printed.
    """
    F, Q, path = transition_3d(STEP_S), process_noise_3d(STEP_S, ACCELERATION_STD), straight_path()
    R = moments(path[:, None, :3], layout.position, layout.std).cov
    if printed:
        R[..., 2, 2] = printed_r33(path[:, None, :3], layout.position, layout.std[0])
    fused = psd_inverse(psd_inverse(R).sum(1))
    P = two_point_cov(*fused[:2]) if start_cov is None else start_cov
    for k in range(2, SCANS):
        P = F @ P @ F.T + Q
        P = P - P[:, :3] @ np.linalg.solve(P[:3, :3] + fused[k], P[:3])
    return float(np.sqrt(np.trace(P[:3, :3])))


def two_point_cov(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """[6, 6] of positions with covariances [3, 3] one step apart."""
    vv = (first + second) / STEP_S**2 + 0.25 * (STEP_S * ACCELERATION_STD) ** 2 * np.eye(3)
    return np.block([[second, second / STEP_S], [second / STEP_S, vv]])


# -- Monte Carlo ------------------------------------------------------------------------------------------------------


class Runs(NamedTuple):
    """Random numbers that all layouts share: true paths [r, k, 6], noise [r, k, n, 3] in standard deviations."""

    path: np.ndarray
    noise: np.ndarray


class Record(NamedTuple):
    """Position errors [r, k] m, and normalised squared errors [r, `LAST`] of the six states."""

    position_error: np.ndarray
    nees: np.ndarray

    def squares(self) -> np.ndarray:
        """Mean squared position error [r] m² of each run's last scans."""
        return np.square(self.position_error[:, -LAST:]).mean(-1)

    def rmse(self) -> float:
        """Root mean square position error [m] over all runs' last scans."""
        return float(np.sqrt(self.squares().mean()))


def draw_runs(runs: int, rng: np.random.Generator) -> Runs:
    """The straight path with a white acceleration in the truth, and noise for up to `MOST_SENSORS` sensors."""
    push = ACCELERATION_STD * rng.standard_normal((runs, SCANS, 3))
    drift, F = np.zeros((runs, SCANS, 6)), transition_3d(STEP_S)
    for k in range(1, SCANS):
        pushed = np.concatenate([0.5 * STEP_S**2 * push[:, k], STEP_S * push[:, k]], axis=-1)
        drift[:, k] = drift[:, k - 1] @ F.T + pushed
    return Runs(straight_path() + drift, rng.standard_normal((runs, SCANS, MOST_SENSORS, 3)))


def follow(runs: Runs, layout: Layout, linearisation: str = "local") -> Record:
    """Track all runs from one layout."""
    noise = runs.noise[:, :, : len(layout.ranging)]
    track = ConvertedFusion(linearisation=linearisation).track(runs.path, layout, noise)
    last = slice(-LAST, None)
    return Record(track.position_error_m, nees(track.mean[:, last], track.cov[:, last], runs.path[:, last]))


def nees_at_measurement(runs: Runs, layout: Layout) -> np.ndarray:
    """NEES [r] over the last scans if bias and R, formulas for the truth, are evaluated at each measurement itself."""
    F, Q, n = transition_3d(STEP_S), process_noise_3d(STEP_S, ACCELERATION_STD), len(layout.ranging)
    z = polar(runs.path[:, :, None], layout.position) + layout.std * runs.noise[:, :, :n]
    converted = convert(z, layout.position)
    bias, R = moments(converted, layout.position, layout.std)
    information = psd_inverse(R)
    fused = psd_inverse(information.sum(2))
    position = np.einsum("rkij,rknjl,rknl->rki", fused, information, converted - bias)
    x = np.concatenate([position[:, 1], (position[:, 1] - position[:, 0]) / STEP_S], axis=-1)
    P, said = two_point_cov(fused[:, 0], fused[:, 1]), []
    for k in range(2, SCANS):
        x, P = x @ F.T, F @ P @ F.T + Q
        K = P[..., :3] @ psd_inverse(P[..., :3, :3] + fused[:, k])
        x = x + np.einsum("rij,rj->ri", K, position[:, k] - x[:, :3])
        P = symmetrize(P - K @ P[..., :3, :])
        said.append(nees(x, P, runs.path[:, k]))
    return np.mean(said[-LAST:], axis=0)
