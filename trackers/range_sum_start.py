"""How a track on range sums starts: from an operator's coarse guess and the first scans.

`start_range_sums` finds the maximum a posteriori state at time 0 of all sums of the first scans under a Gaussian prior,

    min over X:  Σ (ρ − F(p + v t))² / σ²  +  (X − X̄)ᵀ W (X − X̄),      W the inverse of the guess's covariance

by Levenberg–Marquardt with λ on the diagonal of N = JᵀJ + W (× 0.2 after a step that helps, × 5 after one that does
not). N⁻¹ is its covariance; both are propagated to the last scan. So P₀ is honest: directions that no sum has told of
keep the guess's spread, and without an echo the guess itself is the start. A minimum below the ground, or one that
noise does not explain (a ghost's, say), is tried again from its mirror image and from places a standard deviation off
the guess; the least of all counts.
`fixed_damping_step` is the paper's own: one step a scan on the position alone, its λ fixed.
Source: Xu and Wang (2009), eq 12. Deviations: see above; H is taken at the current iterate, Z of the current scan.
"""

from __future__ import annotations

import math

import numpy as np

from trackers.axis_motion import add_axis_noise, move_axes
from trackers.compiled import helper, kernel
from trackers.gaussian import Gaussian
from trackers.linalg import cholesky_in_place, solve_with_factor
from trackers.position_update import copy_gaussian
from trackers.range_sum import range_sum_row, short_of_baseline
from trackers.range_sum_contract import RangeSumScan

ITERATIONS = 60
FIRST_DAMPING = 1e-3
LARGEST_DAMPING = 1e12
SETTLED = 1e-12
"""Squared length of a step, in standard deviations, at which the iteration ends."""

PLAUSIBLE = 5.0
"""A minimum so many standard deviations above what noise explains is taken for a local one."""

ATTEMPTS = 6
UNDER_GROUND = 1e12
"""Added to the cost of a minimum below the ground: any other is better."""


def start_range_sums(scans: RangeSumScan, guess: Gaussian, times_s, acceleration_var, floor_m: float) -> Gaussian:
    """State at the last of t scans.

    Args:
        scans: range_sums and valid [..., t, n], transmitters [..., t, n, d], receiver [..., t, d], std [..., t, n].
        guess: mean [..., 2d] and cov [..., 2d, 2d] at time 0.
        times_s: [t] s, ascending, not before 0.
        acceleration_var: [3] (m/s²)² of the motion from time 0 to the last scan.
        floor_m: height of the ground (see `mirror_up`).
    Returns:
        mean [..., 2d] and cov [..., 2d, 2d].
    Raises:
        ValueError: shapes that do not belong together, entries that are not finite, variances that are not positive,
            times out of order.
    """
    scans.check()
    mean, cov = _checked_guess(guess, np.shape(scans.receiver)[-1])
    times = np.asarray(times_s, dtype=float)
    ordered = times.ndim == 1 and times.size > 0 and bool((np.diff(times, prepend=0.0) >= 0.0).all())
    if not (ordered and np.isfinite(times).all()):
        raise ValueError(f"times_s is {times_s!r}: must be [t] seconds, one scan or more, ascending, not before 0")
    if np.ndim(scans.range_sums) < 2 or np.shape(scans.range_sums)[-2] not in (1, len(times)):
        raise ValueError(f"scans.range_sums {np.shape(scans.range_sums)}: must be [..., t, n] with t = {len(times)}")
    n = np.shape(scans.range_sums)[-1]
    sums, valid, std = (_spread(part, (len(times), n)) for part in (scans.range_sums, scans.valid, scans.std))
    sites, receiver = _spread(scans.transmitters, (len(times), n, mean.shape[-1] // 2)), scans.receiver
    receiver = _spread(receiver, (len(times), mean.shape[-1] // 2))
    return Gaussian(*_start(mean, cov, sums, valid, sites, receiver, std, times, acceleration_var, floor_m))


def _spread(part, core: tuple[int, ...]):
    """The part with its last axes broadcast to `core`."""
    part = np.asarray(part)
    return (
        np.broadcast_to(part, (*part.shape[: -len(core)], *core))
        if part.ndim >= len(core)
        else np.broadcast_to(part, core)
    )


def _checked_guess(guess: Gaussian, d: int) -> tuple[np.ndarray, np.ndarray]:
    mean, cov = (np.asarray(part, dtype=float) for part in guess)
    if mean.shape[-1:] != (2 * d,) or cov.shape[-2:] != (2 * d, 2 * d):
        raise ValueError(f"guess: mean {mean.shape} and cov {cov.shape}: must be [..., n] and [..., n, n], n = {2 * d}")
    if not (np.isfinite(mean).all() and np.isfinite(cov).all()):
        raise ValueError("guess: mean and cov must be finite")
    if not (np.diagonal(cov, axis1=-2, axis2=-1) > 0.0).all():
        raise ValueError("guess.cov: variances must be positive")
    return mean, cov


@helper
def mirror_up(x, P, floor):
    """Turn a state x [6], P [6, 6] below the ground about it: z, its velocity and their covariances with the rest."""
    if x[2] < floor:
        x[2] = 2.0 * floor - x[2]
        x[5] = -x[5]
        for i in range(6):
            P[2, i], P[5, i] = -P[2, i], -P[5, i]
        for i in range(6):
            P[i, 2], P[i, 5] = -P[i, 2], -P[i, 5]


@helper
def _place(x, t, d, p):
    """p [d], where x [2d] is after t seconds."""
    for i in range(d):
        p[i] = x[i] + t * x[d + i]


@helper
def _cost(x, mean, W, sums, used, transmitters, receiver, std, times, p, row, d):
    """Twice the negative log posterior, but for a constant."""
    total = 0.0
    for i in range(2 * d):
        for j in range(2 * d):
            total += (x[i] - mean[i]) * W[i, j] * (x[j] - mean[j])
    for t in range(sums.shape[0]):
        _place(x, times[t], d, p)
        for s in range(sums.shape[1]):
            if used[t, s]:
                miss = (sums[t, s] - range_sum_row(p, receiver[t], transmitters[t, s], row, d)) / std[t, s]
                total += miss * miss
    return total


@helper
def _normal_equations(x, mean, W, sums, used, transmitters, receiver, std, times, N, g, p, row, d):
    """N = JᵀJ + W [2d, 2d] and the downhill gradient g [2d] at x."""
    for i in range(2 * d):
        g[i] = 0.0
        for j in range(2 * d):
            N[i, j] = W[i, j]
            g[i] -= W[i, j] * (x[j] - mean[j])
    for t in range(sums.shape[0]):
        _place(x, times[t], d, p)
        for s in range(sums.shape[1]):
            if used[t, s]:
                weight = 1.0 / (std[t, s] * std[t, s])
                miss = weight * (sums[t, s] - range_sum_row(p, receiver[t], transmitters[t, s], row, d))
                for i in range(d):
                    g[i] += row[i] * miss
                    g[d + i] += times[t] * row[i] * miss
                    for j in range(d):
                        info = weight * row[i] * row[j]
                        N[i, j] += info
                        N[i, d + j] += times[t] * info
                        N[d + i, j] += times[t] * info
                        N[d + i, d + j] += times[t] * times[t] * info


@helper
def _minimise(x, mean, W, sums, used, transmitters, receiver, std, times, N, A, g, step, trial, p, row, d):
    """Levenberg–Marquardt from x [2d], in place; returns the cost and leaves N at the last x."""
    n = 2 * d
    damping = FIRST_DAMPING
    cost = _cost(x, mean, W, sums, used, transmitters, receiver, std, times, p, row, d)
    _normal_equations(x, mean, W, sums, used, transmitters, receiver, std, times, N, g, p, row, d)
    for _ in range(ITERATIONS):
        for i in range(n):
            step[i] = g[i]
            for j in range(n):
                A[i, j] = N[i, j] * (1.0 + damping) if i == j else N[i, j]
        cholesky_in_place(A)
        solve_with_factor(A, step)
        length = 0.0
        for i in range(n):
            trial[i] = x[i] + step[i]
            length += step[i] * g[i]
        found = _cost(trial, mean, W, sums, used, transmitters, receiver, std, times, p, row, d)
        if found < cost:
            cost = found
            damping *= 0.2
            for i in range(n):
                x[i] = trial[i]
            _normal_equations(x, mean, W, sums, used, transmitters, receiver, std, times, N, g, p, row, d)
        else:
            damping *= 5.0
        if length < SETTLED or damping > LARGEST_DAMPING:
            break
    return cost


@helper
def _invert_into(A, n, inverse):
    """inverse [n, n] = A⁻¹ of symmetric positive definite A, which is overwritten."""
    cholesky_in_place(A)
    for i in range(n):
        for j in range(n):
            inverse[i, j] = 1.0 if i == j else 0.0
        solve_with_factor(A, inverse[i])


@helper
def _begin(attempt, mean, cov, best, floor, d, x):
    """Where an attempt starts, into x [2d]: the guess, the best so far turned up, the guess a σ off along x or y."""
    for i in range(2 * d):
        x[i] = best[i] if attempt == 1 else mean[i]
    if attempt == 1 and d == 3:
        x[2], x[5] = 2.0 * floor - x[2], -x[5]
    if attempt >= 2:
        axis = (attempt - 2) // 2
        x[axis] += math.sqrt(cov[axis, axis]) * (1.0 if attempt % 2 == 0 else -1.0)


@kernel("(a),(a,a),(t,n),(t,n),(t,n,d),(t,d),(t,n),(t),(w),()->(a),(a,a)", "FFFBFFFFFfFF")
def _start(mean, cov, sums, valid, transmitters, receiver, std, times, w, floor, best, P):
    n = mean.shape[0]
    d = n // 2
    N, A, W, used = np.empty((n, n)), np.empty((n, n)), np.empty((n, n)), np.empty(valid.shape, np.bool_)
    x, g, step, trial, p, row = np.empty(n), np.empty(n), np.empty(n), np.empty(n), np.empty(d), np.empty(d)
    count = 0.0
    for t in range(sums.shape[0]):
        for s in range(sums.shape[1]):
            short = short_of_baseline(sums[t, s], std[t, s], receiver[t], transmitters[t, s], d)
            used[t, s] = valid[t, s] and not short
            count += 1.0 if used[t, s] else 0.0
    copy_gaussian(mean, cov, n, best, A)
    _invert_into(A, n, W)
    least = math.inf
    for attempt in range(ATTEMPTS):
        _begin(attempt, mean, cov, best, floor, d, x)
        cost = _minimise(x, mean, W, sums, used, transmitters, receiver, std, times, N, A, g, step, trial, p, row, d)
        if d == 3 and x[2] < floor:
            cost += UNDER_GROUND
        if cost < least:
            least = cost
            for i in range(n):
                best[i] = x[i]
        if least <= count + PLAUSIBLE * math.sqrt(2.0 * count):
            break
    _normal_equations(best, mean, W, sums, used, transmitters, receiver, std, times, N, g, p, row, d)
    _invert_into(N, n, P)
    before = 0.0
    for t in range(times.shape[0]):
        move_axes(best, P, times[t] - before, d)
        add_axis_noise(P, times[t] - before, w, 1.0, d)
        before = times[t]
    if d == 3:
        mirror_up(best, P, floor)


# -- the paper's own --------------------------------------------------------------------------------------------------


@kernel("(d),(n),(n),(n,d),(d),()->(d)", "FFBFFfF")
def _fixed_damping_step(p, sums, used, transmitters, receiver, damping, p_out):
    d = p.shape[0]
    A, row = np.zeros((d, d)), np.empty(d)
    p_out[:] = 0.0
    for i in range(d):
        A[i, i] = damping
    for s in range(sums.shape[0]):
        if used[s]:
            miss = sums[s] - range_sum_row(p, receiver, transmitters[s], row, d)
            for i in range(d):
                p_out[i] += row[i] * miss
                for j in range(d):
                    A[i, j] += row[i] * row[j]
    cholesky_in_place(A)
    solve_with_factor(A, p_out)
    for i in range(d):
        p_out[i] += p[i]
        if not math.isfinite(p_out[i]):
            p_out[i] = p[i]


def fixed_damping_step(position, scan: RangeSumScan, damping: float):
    """The paper's step x + (HᵀH + λI)⁻¹Hᵀ(z − F(x)) [..., d] m from positions [..., d] m, one for each scan.

    Args:
        damping: λ, positive: without it the poor layout's nearly singular HᵀH throws the iterate away.
    """
    scan.check()
    if not 0.0 < damping < np.inf:
        raise ValueError(f"damping = {damping!r}: must be positive and finite")
    return _fixed_damping_step(position, *scan[:4], damping)
