"""How a track on range sums starts: from an operator's coarse guess and the first scans.

`start_range_sums` finds the maximum a posteriori state at time 0 of all sums of the first scans under a Gaussian prior,

    min over X:  Σ (ρ − F(p + v t + a t²/2))² / σ²  +  (X − X̄)ᵀ W (X − X̄),      X = [p; v; a]

by Levenberg–Marquardt with λ on the diagonal of N = JᵀJ + W (× 0.2 after a step that helps, × 5 after one that does
not). a is the mean acceleration over the scans, 0 but for the motion's random accelerations and for turns (`turning`);
W is the inverse of the covariance of guess and a. N⁻¹ is X's covariance; all is carried to the last scan, and what
random accelerations add besides is added there. So P₀ is honest: directions that no sum has told of keep the guess's
spread, and without an echo the guess itself is the start. A minimum below the ground, or one that noise does not
explain (a ghost's, say), is tried again from its mirror image and from places off the guess; the least of all counts.

Few echoes leave a posterior that is long and bent, as ellipses are: N⁻¹ at its mode then claims far too much across the
bend. Where the costs off the mode show that, the posterior is cut across its widest ways by Gaussian slabs whose sum is
constant, each part is fitted on its own (a slab is one more linear observation), and the parts' mean and covariance
count: a Gaussian sum (Sorenson and Alspach 1971) placed where the posterior is.

`fixed_damping_step` is the paper's own: one step a scan on the position alone, its λ fixed.
Source: Xu and Wang (2009), eq 12. Deviations: see above; H is taken at the current iterate, Z of the current scan.
"""

from __future__ import annotations

import math

import numpy as np

from trackers.axis_motion import add_axis_noise, move_axes
from trackers.compiled import helper, kernel, routine
from trackers.gaussian import Gaussian
from trackers.linalg import cholesky_in_place, solve_with_factor
from trackers.range_sum import range_sum_row, short_of_baseline
from trackers.range_sum_contract import RangeSumScan

ITERATIONS = 60
FIRST_DAMPING = 1e-3
LARGEST_DAMPING = 1e12
SETTLED = 1e-12
"""Squared length of a step, in standard deviations, at which the iteration ends."""

PLAUSIBLE = 5.0
"""A minimum so many standard deviations above what noise explains is taken for a local one."""

ATTEMPTS = 18
"""The guess, the best so far turned up, eight places a standard deviation off the guess, eight 2.5 of them off."""

LEAST_DEFINITE = 1e-12
"""Least eigenvalue of the guess's correlations."""

PROBED = 1.5
"""Standard deviations from the mode, along the widest ways, at which the posterior is compared with a Gaussian …"""

BENT = 1.0
"""… and the difference of their costs from which on it is none."""

SPACING, SLAB, REACH = 0.75, 0.67, 8
"""Slabs of a bent posterior: their distance in standard deviations along a way, their own in distances, and how many at
most to each side. The sum of so many Gaussians is constant to 0.03 %."""

ROUGHLY = 1e-3
"""As `SETTLED`, for the mode of a slab."""

NEGLIGIBLE = -10.0
"""Logarithm of a slab's weight, the middle one's being 1, from which on it and those behind it are left out."""

POWER_STEPS = 20
"""Iterations for the widest way."""

LEAST_ACCELERATION_VAR = 1e-14
"""Variance [(m/s²)²] of a mean acceleration that is known to be 0: its inverse must exist."""

UNDER_GROUND = 1e12
"""Added to the cost of a minimum below the ground: any other is better."""


def start_range_sums(
    scans: RangeSumScan, guess: Gaussian, times_s, acceleration_var, floor_m: float, turning_m_s2: float = 0.0
) -> Gaussian:
    """State at the last of t scans.

    Args:
        scans: range_sums and valid [..., t, n], transmitters [..., t, n, d], receiver [..., t, d], std [..., t, n].
        guess: mean [..., 2d] and cov [..., 2d, 2d] at time 0.
        times_s: [t] s, ascending, not before 0.
        acceleration_var: [3] (m/s²)² of the motion from time 0 to the last scan.
        floor_m: height of the ground (see `mirror_up`).
        turning_m_s2: standard deviation of the mean acceleration that turns may cause besides, per axis.
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
    return Gaussian(
        *_start(mean, cov, sums, valid, sites, receiver, std, times, acceleration_var, turning_m_s2, floor_m)
    )


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
    if not _positive_definite(cov):
        raise ValueError("guess.cov: must be symmetric and positive definite; no direction may be known exactly")
    return mean, cov


def _positive_definite(cov: np.ndarray) -> bool:
    """Whether all covariances [..., n, n] of positive variances are symmetric and, beyond rounding, definite."""
    std = np.sqrt(np.diagonal(cov, axis1=-2, axis2=-1))
    correlation = cov / (std[..., :, None] * std[..., None, :])
    if not np.allclose(correlation, np.swapaxes(correlation, -1, -2), rtol=0.0, atol=1e-9):
        return False
    try:
        np.linalg.cholesky(correlation - LEAST_DEFINITE * np.eye(cov.shape[-1]))
    except np.linalg.LinAlgError:
        return False
    return True


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
    """p [d], where x [3d] is after t seconds."""
    for i in range(d):
        p[i] = x[i] + t * (x[d + i] + 0.5 * t * x[2 * d + i])


@routine
def _cost(x, prior, scans, cells, scratch, d):
    """Twice the negative log posterior, but for a constant."""
    (mean, W), (sums, used, transmitters, receiver, std, times) = prior, scans
    (slopes, places, widths), (p, row) = cells, scratch
    total = 0.0
    for i in range(3 * d):
        for j in range(3 * d):
            total += (x[i] - mean[i]) * W[i, j] * (x[j] - mean[j])
    for k in range(places.shape[0]):
        miss = -places[k]
        for i in range(3 * d):
            miss += slopes[k, i] * x[i]
        total += (miss / widths[k]) ** 2
    for t in range(sums.shape[0]):
        _place(x, times[t], d, p)
        for s in range(sums.shape[1]):
            if used[t, s]:
                miss = (sums[t, s] - range_sum_row(p, receiver[t], transmitters[t, s], row, d)) / std[t, s]
                total += miss * miss
    return total


@routine
def _normal_equations(x, prior, scans, cells, N, g, scratch, d):
    """N = JᵀJ + W [3d, 3d] and the downhill gradient g [3d] at x."""
    (mean, W), (sums, used, transmitters, receiver, std, times) = prior, scans
    (slopes, places, widths), (p, row) = cells, scratch
    for i in range(3 * d):
        g[i] = 0.0
        for j in range(3 * d):
            N[i, j] = W[i, j]
            g[i] -= W[i, j] * (x[j] - mean[j])
    for k in range(places.shape[0]):
        miss, weight = places[k], 1.0 / (widths[k] * widths[k])
        for i in range(3 * d):
            miss -= slopes[k, i] * x[i]
        for i in range(3 * d):
            g[i] += weight * slopes[k, i] * miss
            for j in range(3 * d):
                N[i, j] += weight * slopes[k, i] * slopes[k, j]
    for t in range(sums.shape[0]):
        _place(x, times[t], d, p)
        lever = (1.0, times[t], 0.5 * times[t] * times[t])
        for s in range(sums.shape[1]):
            if used[t, s]:
                weight = 1.0 / (std[t, s] * std[t, s])
                miss = weight * (sums[t, s] - range_sum_row(p, receiver[t], transmitters[t, s], row, d))
                for m in range(3):
                    for i in range(d):
                        g[m * d + i] += lever[m] * row[i] * miss
                        for n in range(3):
                            for j in range(d):
                                N[m * d + i, n * d + j] += weight * lever[m] * lever[n] * row[i] * row[j]


@routine
def _minimise(x, prior, scans, cells, normal, scratch, settled, d):
    """Levenberg–Marquardt from x [3d], in place; returns the cost and leaves N at the last x."""
    n = 3 * d
    N, A, g, step, trial = normal
    damping = FIRST_DAMPING
    cost = _cost(x, prior, scans, cells, scratch, d)
    _normal_equations(x, prior, scans, cells, N, g, scratch, d)
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
        found = _cost(trial, prior, scans, cells, scratch, d)
        if found < cost:
            cost = found
            damping *= 0.2
            for i in range(n):
                x[i] = trial[i]
            _normal_equations(x, prior, scans, cells, N, g, scratch, d)
        else:
            damping *= 5.0
        if length < settled or damping > LARGEST_DAMPING:
            break
    return cost


@routine
def _invert_into(A, n, inverse):
    """inverse [n, n] = A⁻¹ of symmetric positive definite A, which is overwritten by its factor; returns log √det A."""
    cholesky_in_place(A)
    log_det = 0.0
    for i in range(n):
        log_det += math.log(A[i, i])
        for j in range(n):
            inverse[i, j] = 1.0 if i == j else 0.0
        solve_with_factor(A, inverse[i])
    return log_det


@helper
def _begin(attempt, mean, cov, best, floor, d, x):
    """Where an attempt starts, into x [3d]: the guess, the best so far turned up, places level with the guess."""
    for i in range(3 * d):
        x[i] = best[i] if attempt == 1 else mean[i]
    if attempt == 1 and d == 3:
        x[2], x[5], x[8] = 2.0 * floor - x[2], -x[5], -x[8]
    if attempt >= 2:
        away = 1.0 if attempt < 10 else 2.5
        angle = 0.25 * math.pi * (2 * ((attempt - 2) % 4) + (attempt - 2) // 4)
        x[0] += away * math.sqrt(cov[0, 0]) * math.cos(angle)
        x[1] += away * math.sqrt(cov[1, 1]) * math.sin(angle)


@routine
def _fit(prior, scans, cells, cov, floor, count, normal, scratch, best, x, d):
    """The least minimum of all attempts, into best [3d]; returns its cost."""
    least = math.inf
    for attempt in range(ATTEMPTS):
        _begin(attempt, prior[0], cov, best, floor, d, x)
        cost = _minimise(x, prior, scans, cells, normal, scratch, SETTLED, d)
        if d == 3 and x[2] < floor:
            cost += UNDER_GROUND
        if cost < least:
            least = cost
            for i in range(3 * d):
                best[i] = x[i]
        if least <= count + PLAUSIBLE * math.sqrt(2.0 * count):
            break
    return least


@routine
def _prior(mean, cov, times, w, turning, wide, P, rest, d):
    """Mean wide [3d] and covariance P [3d, 3d] with the mean acceleration; rest [2d, 2d] is what noise adds to both.

    White accelerations change the velocity by that of their mean, exactly; what they add to the position besides is a
    bridge that does not depend on it, rest.
    """
    last = times[times.shape[0] - 1]
    for i in range(2 * d):
        for j in range(2 * d):
            rest[i, j] = 0.0
    before = 0.0
    for t in range(times.shape[0]):
        move_axes(wide, rest, times[t] - before, d)
        add_axis_noise(rest, times[t] - before, w, 1.0, d)
        before = times[t]
    for i in range(3 * d):
        wide[i] = mean[i] if i < 2 * d else 0.0
        for j in range(3 * d):
            P[i, j] = cov[i, j] if i < 2 * d and j < 2 * d else 0.0
    for i in range(d):
        share = rest[d + i, d + i] / (last * last) if last > 0.0 else 0.0
        P[2 * d + i, 2 * d + i] = max(share + turning * turning, LEAST_ACCELERATION_VAR)
        rest[i, i] -= 0.25 * last**4 * share
        rest[i, d + i] -= 0.5 * last**3 * share
        rest[d + i, i] = rest[i, d + i]
        rest[d + i, d + i] = 0.0


@routine
def _carry(x, P, t, x_out, P_out, d):
    """x [3d] and P [3d, 3d] after t seconds, without the acceleration, into x_out [2d] and, added to it, P_out."""
    for i in range(d):
        x_out[i] = x[i] + t * (x[d + i] + 0.5 * t * x[2 * d + i])
        x_out[d + i] = x[d + i] + t * x[2 * d + i]
    lever = ((1.0, t, 0.5 * t * t), (0.0, 1.0, t))
    for a in range(2):
        for b in range(2):
            for i in range(d):
                for j in range(d):
                    for m in range(3):
                        for q in range(3):
                            P_out[a * d + i, b * d + j] += lever[a][m] * lever[b][q] * P[m * d + i, q * d + j]


@routine
def _widest_ways(P, t, ways, slopes, widths, d):
    """Fill slopes [2, 3d], the two directions in which the place after t seconds is known worst, and their σ [2] m.

    As many of them as `ways`; the others keep an infinite σ, which says nothing of them.
    """
    C, e = np.empty((d, d)), np.empty((2, d))
    lever = (1.0, t, 0.5 * t * t)
    for i in range(d):
        for j in range(d):
            C[i, j] = 0.0
            for m in range(3):
                for q in range(3):
                    C[i, j] += lever[m] * lever[q] * P[m * d + i, q * d + j]
    for k in range(2):
        widths[k] = math.inf
        for i in range(3 * d):
            slopes[k, i] = 0.0
    for k in range(ways):
        most = 0
        for i in range(d):
            most = i if C[i, i] > C[most, most] else most
        for i in range(d):
            e[0, i] = C[i, most]
        size = 0.0
        for _ in range(POWER_STEPS):
            size = 0.0
            for i in range(d):
                e[1, i] = 0.0
                for j in range(d):
                    e[1, i] += C[i, j] * e[0, j]
                size += e[1, i] * e[1, i]
            size = math.sqrt(max(size, 1e-300))
            for i in range(d):
                e[0, i] = e[1, i] / size
        widths[k] = math.sqrt(max(size, 1e-12))
        for i in range(d):
            for m in range(3):
                slopes[k, m * d + i] = lever[m] * e[0, i]
            for j in range(d):
                C[i, j] -= size * e[0, i] * e[0, j]


@routine
def _bent(best, P, least, slope, width, prior, scans, none, trial, scratch, d):
    """Whether the posterior is no Gaussian along the way of a slope [3d] and its σ."""
    bent = False
    for side in (-1.0, 1.0):
        for i in range(3 * d):
            trial[i] = best[i]
            for j in range(3 * d):
                trial[i] += side * PROBED * P[i, j] * slope[j] / width
        cost = _cost(trial, prior, scans, none, scratch, d) - least
        bent = bent or abs(cost - PROBED * PROBED) > BENT
    return bent


@routine
def _lay_slabs(best, P, least, t, prior, scans, none, trial, scratch, slopes, sigma, widths, reach, d):
    """Lay slabs across the ways in which the posterior after t seconds is wide and bent.

    Fills slopes [2, 3d] and sigma [2] m of the widest ways, the slabs' widths [2] m, and reach [2], how many of them
    may lie to each side; along a way that is not bent it is 0, and the width infinite.
    """
    ways = d - 1
    _widest_ways(P, t, ways, slopes, sigma, d)
    for k in range(2):
        reach[k] = 0
        if k < ways and _bent(best, P, least, slopes[k], sigma[k], prior, scans, none, trial, scratch, d):
            reach[k] = REACH
        widths[k] = SLAB * SPACING * sigma[k] if reach[k] > 0 else math.inf


@helper
def _place_slab(best, slopes, sigma, reach, across, along, places, n):
    """Middle of a slab, places [2] m: so many slabs off the mode along the first way, and along the second."""
    for m in range(2):
        places[m] = 0.0
        for i in range(n):
            places[m] += slopes[m, i] * best[i]
    places[0] += across * SPACING * sigma[0] if reach[0] > 0 else 0.0
    places[1] += along * SPACING * sigma[1] if reach[1] > 0 else 0.0


@routine
def _sum_slabs(best, least, prior, scans, cells, sigma, reach, normal, scratch, floor, x, first, second, d):
    """Add up the parts in all slabs, each a Gaussian about its own mode; returns the sum of their weights.

    Adds the parts' weighted moments about the mode best [3d] to first [3d] and second [3d, 3d]. Every part is fitted
    from its neighbour's mode, from the middle outwards, until parts weigh nothing.
    """
    n = 3 * d
    slopes, places = cells[0], cells[1]
    column, own = np.empty(n), np.empty((n, n))
    total = reference = 0.0
    for side in (1, -1):
        column[:] = best
        for k in range((1 - side) // 2, reach[0] + 1):
            most = -math.inf
            for other in (1, -1):
                x[:] = column
                for q in range((1 - other) // 2, reach[1] + 1):
                    _place_slab(best, slopes, sigma, reach, side * k, other * q, places, n)
                    cost = _minimise(x, prior, scans, cells, normal, scratch, ROUGHLY, d)
                    if other == 1 and q == 0:
                        column[:] = x
                    weight = -0.5 * (cost - least) - _invert_into(normal[0], n, own)
                    if total == 0.0:
                        reference = weight
                    weight -= reference
                    most = max(most, weight)
                    if weight < NEGLIGIBLE or (d == 3 and x[2] < floor):
                        break
                    share = math.exp(min(weight, 50.0))
                    total += share
                    for i in range(n):
                        first[i] += share * (x[i] - best[i])
                        for j in range(n):
                            second[i, j] += share * (own[i, j] + (x[i] - best[i]) * (x[j] - best[j]))
            if most < NEGLIGIBLE:
                break
    return total


@routine
def _average(best, P, t, prior, scans, none, normal, scratch, floor, x, d):
    """Replace the mode best [3d] and its P [3d, 3d] by mean and covariance of a bent posterior, in place.

    The posterior is cut across the ways in which it is wide and bent by Gaussian slabs whose sum is constant, and every
    slab's part is taken for a Gaussian about its own mode.
    """
    n = 3 * d
    slopes, places, widths = np.empty((2, n)), np.empty(2), np.empty(2)
    sigma, reach = np.empty(2), np.zeros(2, np.int64)
    least = _cost(best, prior, scans, none, scratch, d)
    _lay_slabs(best, P, least, t, prior, scans, none, normal[4], scratch, slopes, sigma, widths, reach, d)
    if reach[0] + reach[1] == 0:
        return
    cells, first, second = (slopes, places, widths), np.zeros(n), np.zeros((n, n))
    total = _sum_slabs(best, least, prior, scans, cells, sigma, reach, normal, scratch, floor, x, first, second, d)
    if total == 0.0:
        return
    for i in range(n):
        for j in range(n):
            P[i, j] = second[i, j] / total - first[i] * first[j] / (total * total)
    for i in range(n):
        best[i] += first[i] / total


@kernel("(a),(a,a),(t,n),(t,n),(t,n,d),(t,d),(t,n),(t),(w),(),()->(a),(a,a)", "FFFBFFFFFffFF")
def _start(mean, cov, sums, valid, transmitters, receiver, std, times, w, turning, floor, x_out, P_out):
    d, last = mean.shape[0] // 2, times[times.shape[0] - 1]
    n = 3 * d
    N, A, W, P = np.empty((n, n)), np.empty((n, n)), np.empty((n, n)), np.empty((n, n))
    used = np.empty(valid.shape, np.bool_)
    wide, best, x, g, step, trial = np.empty(n), np.empty(n), np.empty(n), np.empty(n), np.empty(n), np.empty(n)
    scratch, normal = (np.empty(d), np.empty(d)), (N, A, g, step, trial)
    none = (np.empty((0, n)), np.empty(0), np.empty(0))
    count = 0.0
    for t in range(sums.shape[0]):
        for s in range(sums.shape[1]):
            short = short_of_baseline(sums[t, s], std[t, s], receiver[t], transmitters[t, s], d)
            used[t, s] = valid[t, s] and not short
            count += 1.0 if used[t, s] else 0.0
    _prior(mean, cov, times, w, turning, wide, P, P_out, d)
    A[:] = P
    _invert_into(A, n, W)
    scans, prior = (sums, used, transmitters, receiver, std, times), (wide, W)
    _fit(prior, scans, none, cov, floor, count, normal, scratch, best, x, d)
    _normal_equations(best, prior, scans, none, N, g, scratch, d)
    _invert_into(N, n, P)
    _average(best, P, 0.5 * last, prior, scans, none, normal, scratch, floor, x, d)
    _carry(best, P, last, x_out, P_out, d)
    if d == 3:
        mirror_up(x_out, P_out, floor)


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
