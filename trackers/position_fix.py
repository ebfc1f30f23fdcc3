"""Positions with covariances from lines of sight or range sums: what filters on position measurements are fed with.

    p̂ = argmin νᵀ W ν,   ν = z − h(p),      R = (Jᵀ W J)⁻¹ at p̂,      W the inverse covariance of the measurements

by Gauss–Newton, from the crossing of the lines (bearings, azimuth and elevation) or from a given start (range sums,
whose ellipses cross more than once). Rows of J: azimuth [−sin az, cos az] / horizontal range, elevation
[−sin el cos az, −sin el sin az, cos el] / slant range, range sum e_transmitter + e_receiver (unit vectors towards p).
There is no fix, and a track coasts, where fewer measurements than needed are used, where the iteration does not
settle, where lines cross behind a sensor, or where JᵀWJ is worse conditioned than a limit.
Limits: in poor geometry the fix is biased, and R, evaluated at it, goes with its error.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from trackers.angles import wrap_scalar
from trackers.compiled import helper, kernel
from trackers.linalg import cholesky_in_place, solve_with_factor
from trackers.measurement import MIN_RANGE_SQUARED
from trackers.range_sum import range_sum_row
from trackers.triangulation_3d import fix_3d

ITERATIONS = 25
SETTLED = 1e-12
"""Squared length of a step, in standard deviations, at which the iteration ends."""

MAX_CONDITION = 1e12
"""Default limit of the condition number of the Fisher information."""


class PositionFix(NamedTuple):
    """A measured position.

    Attributes:
        position: [..., d] m; 0 where not fixed.
        cov: [..., d, d] m²; 0 where not fixed.
        fixed: [...] bool.
    """

    position: Any
    cov: Any
    fixed: Any


# -- bearings in the plane --------------------------------------------------------------------------------------------


@helper
def _nearest_crossing(bearings, used, stations, std):
    """Point (x, y) of least weighted squared distance from all lines, and whether it is unique."""
    a = b = c = u = v = 0.0
    for s in range(bearings.shape[0]):
        if used[s]:
            nx, ny, weight = -math.sin(bearings[s]), math.cos(bearings[s]), 1.0 / (std[s] * std[s])
            offset = weight * (nx * stations[s, 0] + ny * stations[s, 1])
            a, b, c = a + weight * nx * nx, b + weight * nx * ny, c + weight * ny * ny
            u, v = u + nx * offset, v + ny * offset
    determinant = a * c - b * b
    if not determinant > 1e-14 * a * c:
        return 0.0, 0.0, False
    return (c * u - b * v) / determinant, (a * v - b * u) / determinant, True


@helper
def fix_bearings_into(bearings, used, stations, std, max_condition, position, cov):
    """Fix [2] and its covariance [2, 2] from bearings [s]; returns whether there is one. Exact for two bearings."""
    x, y, crossing = _nearest_crossing(bearings, used, stations, std)
    for _ in range(ITERATIONS if crossing else 0):
        a = b = c = u = v = 0.0
        ahead = True
        for s in range(bearings.shape[0]):
            if used[s]:
                dx, dy = x - stations[s, 0], y - stations[s, 1]
                r2 = max(dx * dx + dy * dy, MIN_RANGE_SQUARED)
                nu = wrap_scalar(bearings[s] - math.atan2(dy, dx))
                ahead = ahead and abs(nu) < 0.5 * math.pi
                weight = 1.0 / (r2 * r2 * std[s] * std[s])
                a, b, c = a + weight * dy * dy, b - weight * dx * dy, c + weight * dx * dx
                u, v = u - weight * r2 * nu * dy, v + weight * r2 * nu * dx
        determinant, trace = a * c - b * b, a + c
        # the larger eigenvalue times the smaller is the determinant
        largest = 0.5 * (trace + math.sqrt((a - c) * (a - c) + 4.0 * b * b))
        if not largest * largest <= max_condition * determinant:
            return False
        step_x, step_y = (c * u - b * v) / determinant, (a * v - b * u) / determinant
        x, y = x + step_x, y + step_y
        if u * step_x + v * step_y < SETTLED:
            position[0], position[1] = x, y
            cov[0, 0], cov[1, 1] = c / determinant, a / determinant
            cov[0, 1] = cov[1, 0] = -b / determinant
            return ahead
    return False


@kernel("(s),(s),(s,p),(s),()->(p),(p,p),()", "FBFFfFFb")
def _fix_bearings(bearings, used, stations, std, max_condition, position, cov, fixed):
    fixed[0] = fix_bearings_into(bearings, used, stations, std, max_condition, position, cov)
    if not fixed[0]:
        position[:] = 0.0
        cov[:] = 0.0


def fix_bearings(bearings, used, stations, bearing_std, max_condition: float = MAX_CONDITION) -> PositionFix:
    """Fix in the plane from two or more bearings.

    Args:
        bearings: [..., s] rad, counter-clockwise from east; used: [..., s] bool.
        stations: [..., s, 2] m; bearing_std: [..., s] rad.
        max_condition: largest condition number of the Fisher information.
    """
    return PositionFix(*_fix_bearings(bearings, used, stations, bearing_std, max_condition))


# -- azimuth and elevation in space -----------------------------------------------------------------------------------


def fix_directions(angles, used, platforms, angle_std, max_condition: float = MAX_CONDITION) -> PositionFix:
    """Fix in space from two or more pairs of azimuth and elevation (`trackers.triangulation_3d.fix_3d`).

    Args:
        angles: [..., s, 2] rad; used: [..., s] bool.
        platforms: [..., s, 3] m; angle_std: [..., s, 2] rad.
        max_condition: largest condition number of the Fisher information.
    """
    position, cov, converged = fix_3d(angles, used, platforms, angle_std)
    return _well_conditioned(position, cov, converged, max_condition)


def _well_conditioned(position, cov, converged, max_condition: float) -> PositionFix:
    """The fix where its covariance's condition number, that of its inverse, is within the limit; else none."""
    spread = np.linalg.eigvalsh(cov)
    fixed = converged & (spread[..., -1] <= max_condition * spread[..., 0])
    return PositionFix(np.where(fixed[..., None], position, 0.0), np.where(fixed[..., None, None], cov, 0.0), fixed)


# -- range sums -------------------------------------------------------------------------------------------------------


@kernel("(k),(k),(d),(k,d),(k,k),(d)->(d),(d,d),()", "FBFFFFFFb")
def _fix_range_sums(sums, used, transmitter, receivers, noise, start, position, cov, settled):
    k, d = receivers.shape
    L, J, A = np.empty((k, k)), np.empty((k, d + 1)), np.empty((d, d))
    step = np.empty(d)
    for i in range(k):
        for j in range(k):
            # what is not used becomes a row of its own without slope
            L[i, j] = noise[i, j] if used[i] and used[j] else (1.0 if i == j else 0.0)
    cholesky_in_place(L)
    position[:] = start
    cov[:] = 0.0
    settled[0] = False
    for _ in range(ITERATIONS):
        for i in range(k):
            J[i, d] = sums[i] - range_sum_row(position, transmitter, receivers[i], J[i, :d], d)
            for c in range(d + 1):
                J[i, c] = J[i, c] if used[i] else 0.0
                for j in range(i):
                    J[i, c] -= L[i, j] * J[j, c]
                J[i, c] /= L[i, i]
        A[:] = 0.0
        step[:] = 0.0
        for i in range(k):
            for a in range(d):
                step[a] += J[i, a] * J[i, d]
                for b in range(d):
                    A[a, b] += J[i, a] * J[i, b]
        scale = length = 0.0
        for a in range(d):
            scale += A[a, a]
        cholesky_in_place(A)
        for a in range(d):
            if not A[a, a] * A[a, a] > 1e-14 * scale:
                position[:] = 0.0
                return
        gradient = step.copy()
        solve_with_factor(A, step)
        for a in range(d):
            position[a] += step[a]
            length += gradient[a] * step[a]
        if not length < math.inf:
            position[:] = 0.0
            return
        if length < SETTLED:
            for a in range(d):
                cov[a, a] = 1.0
                solve_with_factor(A, cov[a])
            settled[0] = True
            return
    position[:] = 0.0


def fix_range_sums(
    sums, used, transmitter, receivers, noise_cov, start, max_condition: float = MAX_CONDITION
) -> PositionFix:
    """Fix from bistatic range sums, in the plane or in space.

    Args:
        sums: [..., k] m; used: [..., k] bool.
        transmitter: [..., d] m; receivers: [..., k, d] m; one range sum for each.
        noise_cov: [..., k, k] m², full where receivers share the transmitter's timing error.
        start: [..., d] m, such as a tracker's prediction; of several crossings the iteration finds the one near it.
        max_condition: largest condition number of the Fisher information.
    """
    position, cov, settled = _fix_range_sums(sums, used, transmitter, receivers, noise_cov, start)
    return _well_conditioned(position, cov, settled, max_condition)
