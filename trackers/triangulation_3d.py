"""A target's first position in space from two or more directions, with its covariance.

Lines of sight that cross well fix it by Gauss–Newton:

    X̂ = argmin Σ_s νᵀ R_s⁻¹ ν,   ν = wrap(z_s − h_s(X)),   C = (Σ_s H_sᵀ R_s⁻¹ H_s)⁻¹

Where they cross at an angle of only a few standard deviations, or not at all, that covariance is worth little: what
the directions fix is the inverse of range, and a range with a deviation of a third of itself is far from normal. There
the range along the first line of sight gets a prior, log-normal with 95 % between two ranges of interest, and its
posterior is summed over nodes. At each node position is normal: r times the noise of the first direction across the
line of sight, conditioned on the other directions with their linearisation there. The start is the mean and covariance
of this mixture. With one direction it is the prior; directions that contradict each other at every range count as one.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from scipy.stats import chi2

from trackers.angles import wrap_scalar
from trackers.compiled import helper, kernel, routine
from trackers.direction import absorb, linearize_direction, moved, sight_line
from trackers.gaussian import Gaussian
from trackers.linalg import cholesky_in_place
from trackers.outliers import coplanarity, first_valid

ITERATIONS = 25

WEAK_SHARE = 0.1
"""Standard deviation over range above which a Gauss–Newton fix gives way to the sum over ranges."""

NODES = 64
"""Ranges of that sum, evenly spaced in log range: 0.09 apart by default, below the least deviation it is used for."""

REACH = 3.0
"""Prior standard deviations of log range, both ways, that the nodes cover."""

DISAGREEMENT = float(chi2.ppf(0.9999, 2))
"""Squared innovation per further direction above which, at every range, directions contradict each other."""


class Fix3d(NamedTuple):
    """A position from directions.

    Attributes:
        position: [..., 3] m.
        cov: [..., 3, 3] m².
        converged: [...] bool; False where the directions do not fix the range: position and cov are then zero.
    """

    position: Any
    cov: Any
    converged: Any


@routine
def solve_3(A, b, factor):
    """Overwrite b [3] by A⁻¹b for symmetric A [3, 3]; returns whether A is positive definite beyond rounding.

    `factor` [3, 3] receives the Cholesky factor.
    """
    factor[:] = A
    cholesky_in_place(factor)
    for i in range(3):
        if not factor[i, i] * factor[i, i] > 1e-12 * A[i, i] + 1e-200:
            return False
    for i in range(3):
        for k in range(i):
            b[i] -= factor[i, k] * b[k]
        b[i] /= factor[i, i]
    for i in range(2, -1, -1):
        for k in range(i + 1, 3):
            b[i] -= factor[k, i] * b[k]
        b[i] /= factor[i, i]
    return True


@routine
def _nearest_point(angles, used, platforms, A, position, factor, u):
    """Point with the least squared distance from all lines of sight; returns whether it is unique."""
    A[:] = 0.0
    position[:] = 0.0
    for s in range(angles.shape[0]):
        if used[s]:
            sight_line(angles[s, 0], angles[s, 1], u)
            for i in range(3):
                for j in range(3):
                    across = (1.0 if i == j else 0.0) - u[i] * u[j]
                    A[i, j] += across
                    position[i] += across * platforms[s, j]
    return solve_3(A, position, factor)


@routine
def _normal_equations(angles, used, platforms, std, position, A, g, H):
    """A [3, 3] = Σ HᵀR⁻¹H and g [3] = Σ HᵀR⁻¹ν at a position."""
    A[:] = 0.0
    g[:] = 0.0
    for s in range(angles.shape[0]):
        if used[s]:
            azimuth, elevation = linearize_direction(position, platforms[s], H)
            for c in range(2):
                nu = wrap_scalar(angles[s, c] - (azimuth if c == 0 else elevation))
                weight = 1.0 / (std[s, c] * std[s, c])
                for i in range(3):
                    g[i] += H[c, i] * nu * weight
                    for j in range(3):
                        A[i, j] += H[c, i] * H[c, j] * weight


@routine
def fix_into(angles, used, platforms, std, position, cov):
    """Gauss–Newton fix from directions [s, 2]; returns whether it exists and converged."""
    A, factor, H = np.empty((3, 3)), np.empty((3, 3)), np.empty((2, 3))
    g, step = np.empty(3), np.empty(3)
    if not _nearest_point(angles, used, platforms, A, position, factor, g):
        return False
    for _ in range(ITERATIONS):
        _normal_equations(angles, used, platforms, std, position, A, g, H)
        step[:] = g
        if not solve_3(A, step, factor):
            return False
        length = 0.0  # squared, in standard deviations
        for i in range(3):
            position[i] += step[i]
            length += g[i] * step[i]
        if length < 1e-6:
            for i in range(3):
                for j in range(3):
                    cov[j, i] = 1.0 if i == j else 0.0
                solve_3(A, cov[:, i], factor)
            return True
    return False


@helper
def _range_variance(cov, u):
    """uᵀ C u [m²] along a unit vector u [3]."""
    total = 0.0
    for i in range(3):
        for j in range(3):
            total += u[i] * cov[i, j] * u[j]
    return total


@helper
def _across_sight(r, angles, std, P):
    """Covariance P [6, 6] of a position at range r on a line of sight: σ_az r cos(el) level, σ_el r upwards."""
    level, rise = (r * std[0] * math.cos(angles[1])) ** 2, (r * std[1]) ** 2
    c, s, lift = math.cos(angles[0]), math.sin(angles[0]), math.sin(angles[1])
    across, up = (-s, c, 0.0), (-lift * c, -lift * s, math.cos(angles[1]))
    P[:] = 0.0
    for i in range(3):
        for j in range(3):
            P[i, j] = level * across[i] * across[j] + rise * up[i] * up[j]


@routine
def _at_range(r, u, angles, used, first, platforms, std, x, P):
    """Position x [≥3] and P [6, 6] of a target at range r along the first line of sight u, given all directions.

    Returns the log-likelihood of the other directions, up to a constant, and their squared innovation.
    """
    node, column, H = np.empty(3), np.empty(6), np.empty((2, 3))
    for i in range(3):
        node[i] = x[i] = platforms[first, i] + r * u[i]
    _across_sight(r, angles[first], std[first], P)
    log_likelihood = squared = 0.0
    for s in range(first + 1, angles.shape[0]):
        if used[s]:
            h = linearize_direction(node, platforms[s], H)
            for c in range(2):
                root = absorb(P, H[c], std[s, c] * std[s, c], column)
                y = (wrap_scalar(angles[s, c] - h[c]) - moved(H[c], node, x)) / root
                for i in range(3):
                    x[i] += column[i] * y
                log_likelihood -= 0.5 * y * y + math.log(root)
                squared += y * y
    return log_likelihood, squared


@routine
def _sum_over_ranges(u, angles, used, first, platforms, std, floor, cap, mean, cov):
    """Mean [3] and covariance [3, 3] over all ranges; returns the least squared innovation of any of them."""
    x, P, log_w = np.empty((NODES, 3)), np.empty((NODES, 6, 6)), np.empty(NODES)
    median, deviation, least = 0.5 * math.log(floor * cap), 0.25 * math.log(cap / floor), math.inf
    for n in range(NODES):
        t = REACH * ((2.0 * n + 1.0) / NODES - 1.0)
        r = math.exp(median + t * deviation)
        log_likelihood, squared = _at_range(r, u, angles, used, first, platforms, std, x[n], P[n])
        log_w[n] = log_likelihood - 0.5 * t * t
        least = min(least, squared)
    w = np.exp(log_w - log_w.max())
    w /= w.sum()
    mean[:] = 0.0
    cov[:] = 0.0
    for n in range(NODES):
        for i in range(3):
            mean[i] += w[n] * x[n, i]
    for n in range(NODES):
        for i in range(3):
            for j in range(3):
                cov[i, j] += w[n] * (P[n, i, j] + (x[n, i] - mean[i]) * (x[n, j] - mean[j]))
    return least


@routine
def start_into(angles, used, platforms, std, floor, cap, velocity_std, mean, cov):
    """Start of a track from one direction [2] per used sensor; returns whether more than one of them serves it.

    A Gauss–Newton fix counts if it lies before the first used sensor and is better than `WEAK_SHARE` of its range.
    """
    first = count = 0
    while not used[first]:
        first += 1
    for s in range(first, used.shape[0]):
        count += used[s]
    u = np.empty(3)
    sight_line(angles[first, 0], angles[first, 1], u)
    mean[:] = 0.0
    cov[:] = 0.0
    fixed = fix_into(angles, used, platforms, std, mean[:3], cov[:3, :3])
    if fixed:
        ahead = 0.0
        for i in range(3):
            ahead += u[i] * (mean[i] - platforms[first, i])
        fixed = ahead > 0.0 and _range_variance(cov[:3, :3], u) < (WEAK_SHARE * ahead) ** 2
    if not fixed:
        x, P = mean[:3], cov[:3, :3]
        least = _sum_over_ranges(u, angles, used, first, platforms, std, floor, cap, x, P)
        fixed = count > 1 and least <= DISAGREEMENT * (count - 1)
        if count > 1 and not fixed:
            alone = np.zeros(used.shape[0], dtype=np.bool_)
            _sum_over_ranges(u, angles, alone, first, platforms, std, floor, cap, x, P)
    for i in range(3):
        cov[i + 3, i + 3] = velocity_std[i] * velocity_std[i]
    return fixed


@routine
def choose_returns(angles, valid, platforms, std, available, chosen, used):
    """One return per sensor for a fix: of two sensors the most nearly coplanar pair, else each one's first.

    Fills chosen [s, 2] rad and used [s]; sensors without both components stay out.
    """
    for s in range(platforms.shape[0]):
        k = first_valid(valid[s])
        used[s] = k >= 0 and available[s, 0] and available[s, 1]
        chosen[s] = angles[s, max(k, 0)]
    if platforms.shape[0] != 2 or not (used[0] and used[1]):
        return
    least = math.inf
    for i in range(valid.shape[1]):
        for j in range(valid.shape[1]):
            if valid[0, i] and valid[1, j]:
                d = coplanarity(angles[0, i], std[0], angles[1, j], std[1], platforms[0], platforms[1])
                if d < least:
                    least = d
                    chosen[0], chosen[1] = angles[0, i], angles[1, j]


@kernel("(s,b,a2),(s,b),(s,p3),(s,a2),(s,a2),(),(),(x6)->(x6),(x6,x6)", "FBFFBffFFF")
def _start(angles, valid, platforms, std, available, floor, cap, state_std, mean, cov):
    chosen, used = np.empty((platforms.shape[0], 2)), np.empty(platforms.shape[0], dtype=np.bool_)
    choose_returns(angles, valid, platforms, std, available, chosen, used)
    start_into(chosen, used, platforms, std, floor, cap, state_std[3:], mean, cov)


@kernel("(x6),(x6,x6),(s,b,a2),(s,b),(s,p3),(s,a2),(s,a2),(),(),(x6),()->(x6),(x6,x6),()", "FFFBFFBffFfFFb")
def _restart(x, P, angles, valid, platforms, std, available, floor, cap, state_std, lost_share, x_out, P_out, renewed):
    x_out[:] = x
    P_out[:] = P
    renewed[0] = False
    spread, distance = P[0, 0] + P[1, 1] + P[2, 2], 0.0
    for i in range(3):
        distance += (x[i] - platforms[0, i]) ** 2
    if spread <= lost_share * lost_share * distance:
        return
    chosen, used = np.empty((platforms.shape[0], 2)), np.empty(platforms.shape[0], dtype=np.bool_)
    choose_returns(angles, valid, platforms, std, available, chosen, used)
    count = 0
    for s in range(used.shape[0]):
        count += used[s]
    mean, cov = np.empty(6), np.empty((6, 6))
    fixed = count >= 2 and start_into(chosen, used, platforms, std, floor, cap, state_std[3:], mean, cov)
    if fixed and cov[0, 0] + cov[1, 1] + cov[2, 2] < spread:
        x_out[:] = mean
        P_out[:] = cov
        renewed[0] = True


def restart_tracks(state: Gaussian, scan, floor_m: float, cap_m: float, velocity_std, lost_share: float):
    """Start lost tracks afresh where the scan fixes the target better than the track does.

    A track counts as lost when its own position error √tr P exceeds a share of the range it claims.

    Args:
        state: mean [..., 6], cov [..., 6, 6].
        scan: leading axes as the state's; others as in `start_tracks`.
        lost_share: position standard deviation over range from platform 0.
    Returns:
        mean, cov, and which tracks are new [...] bool.
    """
    return _restart(
        state.mean, state.cov, scan.angles, scan.valid, scan.platforms, scan.angle_std, scan.available,
        floor_m, cap_m, _state_std(velocity_std), lost_share,
    )  # fmt: skip


def _state_std(velocity_std) -> np.ndarray:
    """Standard deviations [6] of a start: the position's come from the fix."""
    return np.concatenate([np.zeros(3), velocity_std])


def fix_3d(angles, used, platforms, angle_std) -> Fix3d:
    """Gauss–Newton fix of one target from directions.

    Args:
        angles: [..., s, 2] rad; used: [..., s] bool.
        platforms: [..., s, 3] m; angle_std: [..., s, 2] rad.
    Returns:
        Fix3d; `converged` is False for fewer than two directions and for lines of sight that do not cross.
    """
    return Fix3d(*_fix(angles, used, platforms, angle_std))


@kernel("(s,a2),(s),(s,p3),(s,a2)->(p3),(p3,p3),()", "FBFFFFb")
def _fix(angles, used, platforms, std, position, cov, converged):
    converged[0] = fix_into(angles, used, platforms, std, position, cov)
    if not converged[0]:
        position[:] = 0.0
        cov[:] = 0.0


def start_tracks(scan, floor_m: float, cap_m: float, velocity_std) -> Gaussian:
    """One track per scan from the first directions: mean [..., 6] and covariance [..., 6, 6].

    Args:
        scan: `AngleScan`.
        floor_m, cap_m: 95 % of the log-normal prior of range lie between them; it counts where a fix is weak.
        velocity_std: [3] m/s; the first velocity is 0.
    Raises:
        ValueError: a scan without any return whose azimuth and elevation are both available.
    """
    seen = (np.asarray(scan.valid).any(-1) & np.asarray(scan.available).all(-1)).any(-1)
    if not seen.all():
        where = tuple(int(i) for i in np.argwhere(~seen)[0])
        raise ValueError(f"initiate: scan {where} of the batch holds no return with azimuth and elevation: need one")
    return Gaussian(
        *_start(
            scan.angles, scan.valid, scan.platforms, scan.angle_std, scan.available,
            floor_m, cap_m, _state_std(velocity_std),
        )
    )  # fmt: skip
