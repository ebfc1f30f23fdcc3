"""Bistatic range sums: from a transmitter to the target and on to the receiver, in the plane or in space.

    ρᵢ = |p − R| + |p − Tᵢ|,      ∂ρᵢ/∂p = u_R + uᵢ,   u_R = (p − R)/|p − R|,   uᵢ = (p − Tᵢ)/|p − Tᵢ|

Source: Xu and Wang (2009), eqs 1 and 11.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from trackers.compiled import helper
from trackers.measurement import MIN_RANGE_SQUARED, NOISE_FLOOR


class Dilution(NamedTuple):
    """Standard deviation of the position that one scan fixes [...] m; inf where it fixes none.

    Attributes:
        position: √tr C; horizontal: √(C₁₁ + C₂₂).
        vertical: √C₃₃; 0 in the plane.
    """

    position: Any
    horizontal: Any
    vertical: Any


def range_sum(position, site, sites):
    """Range sums [..., n] m.

    Args:
        position: [..., d] m.
        site: [..., d] m, the receiver of several transmitters or the transmitter of several receivers.
        sites: [..., n, d] m, the others.
    """
    common = np.linalg.norm(np.asarray(position) - site, axis=-1)
    own = np.linalg.norm(np.asarray(position)[..., None, :] - sites, axis=-1)
    return common[..., None] + own


def range_sum_jacobian(position, site, sites):
    """∂ρ/∂p [..., n, d]; within 1 m of a site as at 1 m. Arguments as in `range_sum`."""
    p = np.asarray(position)
    return _unit(p - site)[..., None, :] + _unit(p[..., None, :] - sites)


def _unit(line):
    return line / np.sqrt(np.maximum(np.square(line).sum(-1, keepdims=True), MIN_RANGE_SQUARED))


def check_std(name: str, std) -> None:
    """Refuse standard deviations [...] m that are not positive and finite.

    Raises:
        ValueError: says which entry of `name` it is.
    """
    std = np.asarray(std)
    good = (std > 0.0) & (std < np.inf)
    if not good.all():
        at = tuple(int(i) for i in np.argwhere(~good)[0])
        raise ValueError(f"{name}{list(at) or ''} is {std[at]}: must be positive and finite [m]")


def each_sum(name: str, values, count: int) -> np.ndarray:
    """Numbers [..., n], one for each of `count` range sums, of as many or of one for all.

    Raises:
        ValueError: another length.
    """
    values = np.asarray(values, dtype=float)
    if values.ndim == 0:
        return np.full(count, float(values))
    if values.shape[-1] != count:
        raise ValueError(f"{name} {values.shape}: must be [..., {count}], one for each range sum, or one number")
    return values


def dilution(jacobian, std) -> Dilution:
    """What one scan fixes: C = (Σᵢ HᵢᵀHᵢ / σᵢ²)⁻¹.

    Args:
        jacobian: [..., n, d], `range_sum_jacobian`; its first two columns alone if the height is known.
        std: [..., n] m or one number.
    Returns:
        `Dilution`; inf where the information's condition number is above 10¹².
    Raises:
        ValueError: standard deviations that are not positive and finite, or of another length.
    Source: Xu and Wang (2009), eqs 2 and 3.
    """
    check_std("dilution: std", std)
    H = np.asarray(jacobian) / each_sum("dilution: std", std, np.shape(jacobian)[-2])[..., None]
    spread, axes = np.linalg.eigh(np.swapaxes(H, -1, -2) @ H)
    fixed = spread[..., 0] > 1e-12 * spread[..., -1]
    variance = (np.square(axes) / np.where(fixed[..., None], spread, 1.0)[..., None, :]).sum(-1)
    variance = np.where(fixed[..., None], variance, np.inf)
    horizontal, vertical = variance[..., :2].sum(-1), variance[..., 2:].sum(-1)
    return Dilution(*np.sqrt([horizontal + vertical, horizontal, vertical]))


@helper
def range_sum_row(p, site, other, row, d):
    """Range sum [m] at p [≥d] by way of two sites [d]; fills row [d], its derivative."""
    out = back = 0.0
    for i in range(d):
        out += (p[i] - other[i]) ** 2
        back += (p[i] - site[i]) ** 2
    out, back = math.sqrt(max(out, MIN_RANGE_SQUARED)), math.sqrt(max(back, MIN_RANGE_SQUARED))
    for i in range(d):
        row[i] = (p[i] - other[i]) / out + (p[i] - site[i]) / back
    return out + back


@helper
def sum_spread(P, row, d):
    """Variance h P hᵀ [m²] of a range sum of slope h [d] that a track of covariance P leaves; never negative."""
    spread = 0.0
    for i in range(d):
        for j in range(d):
            spread += row[i] * P[i, j] * row[j]
    return max(spread, 0.0)


@helper
def _whitened_gain(P, row, var, column, d, size):
    """The first `size` rows of `whitened_row_gain`."""
    for i in range(size):
        column[i] = 0.0
        for j in range(d):
            column[i] += P[i, j] * row[j]
    spread = 0.0
    for j in range(d):
        spread += row[j] * column[j]
    root = math.sqrt(max(spread, 0.0) + max(var, NOISE_FLOOR * spread))
    for i in range(size):
        column[i] /= root
    return root, spread


@helper
def whitened_row_gain(P, row, var, column, d):
    """Fill column [2d] = P hᵀ / √S of row h [d] over position and noise variance `var`; returns √S and h P hᵀ.

    The noise counts at least as a tiny share of h P hᵀ, so that P − column columnᵀ stays positive definite.
    """
    return _whitened_gain(P, row, var, column, d, 2 * d)


@helper
def absorb_sum(P, row, var, column, d, size):
    """Condition the first `size` rows and columns of P [2d, 2d] on a range sum of slope row [d], in place.

    column [≥size] is scratch.
    """
    _whitened_gain(P, row, var, column, d, size)
    absorb_column(P, column, size)


@helper
def range_sum_curvature(p, P, site, other, curve, d):
    """What a range sum's second derivative makes of a spread P about p: mean [m] and variance [m²] to second order.

    ½ tr(G P) and ½ tr((G P)²) with G = (I − u uᵀ)/r of the one way and the other; curve [d, d] is scratch.
    """
    near, far = 0.0, 0.0
    for i in range(d):
        near += (p[i] - site[i]) ** 2
        far += (p[i] - other[i]) ** 2
    near, far = max(near, MIN_RANGE_SQUARED), max(far, MIN_RANGE_SQUARED)
    r, r_other = math.sqrt(near), math.sqrt(far)
    for i in range(d):
        for j in range(d):
            curve[i, j] = 0.0
            for k in range(d):
                unit = 1.0 if i == k else 0.0
                one_way = (unit - (p[i] - site[i]) * (p[k] - site[k]) / near) / r
                other_way = (unit - (p[i] - other[i]) * (p[k] - other[k]) / far) / r_other
                curve[i, j] += (one_way + other_way) * P[k, j]
    mean = variance = 0.0
    for i in range(d):
        mean += 0.5 * curve[i, i]
        for j in range(d):
            variance += 0.5 * curve[i, j] * curve[j, i]
    return max(mean, 0.0), max(variance, 0.0)


@helper
def absorb_column(P, column, n):
    """P [n, n] − column columnᵀ, in place."""
    for i in range(n):
        for j in range(i + 1):
            P[i, j] -= column[i] * column[j]
            P[j, i] = P[i, j]


@helper
def short_of_baseline(range_sum_m, std, site, other, d):
    """Whether a range sum [m] is shorter than the sites' distance by more than noise explains, `BASELINE_SIGMAS`."""
    squared = 0.0
    for i in range(d):
        squared += (other[i] - site[i]) ** 2
    return range_sum_m < math.sqrt(squared) - BASELINE_SIGMAS * std


BASELINE_SIGMAS = 6.0
"""A range sum further below the baseline than so many standard deviations is no echo of a target."""
