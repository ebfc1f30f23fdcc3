"""Where bearing lines cross: signed ranges, range intervals, least-squares fixes, first pairings.

Frame: east x, north y, metres; bearings in radians counter-clockwise from east. The reference station is the one
along whose bearing ranges are counted (station 2 in the paper).
Source: Xiu et al. (2002), eqs 1–10.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from trackers.angles import wrap_scalar
from trackers.compiled import helper, kernel
from trackers.measurement import linearize

PARALLEL = 1e-12
"""|sin| of the crossing angle below which two bearings are taken as parallel."""


class RangeInterval(NamedTuple):
    """Bounds [...] m of the range along a reference bearing."""

    low: Any
    high: Any


class Fix(NamedTuple):
    """A position fix: position [..., 2] m, covariance [..., 2, 2] m², converged [...] bool."""

    position: Any
    cov: Any
    converged: Any


@helper
def signed_ranges(theta, alpha, x1, y1, x2, y2):
    """Signed ranges (r1 along θ from station 1, r2 along α from station 2) of the crossing; inf when parallel."""
    s = math.sin(theta - alpha)
    if abs(s) < PARALLEL:
        return math.inf, math.inf
    r1 = ((x1 - x2) * math.sin(alpha) - (y1 - y2) * math.cos(alpha)) / s
    r2 = ((y2 - y1) * math.cos(theta) + (x1 - x2) * math.sin(theta)) / s
    return r1, r2


@kernel("(),(),(p),(p)->(),()")
def _crossing(theta, alpha, station, reference, r1, r2):
    r1[0], r2[0] = signed_ranges(theta, alpha, station[0], station[1], reference[0], reference[1])


def crossing_ranges(theta, alpha, station, reference):
    """Signed distances of a crossing from both stations.

        r₂(θ, α) = [(y₂ − y₁) cos θ + (x₁ − x₂) sin θ] / sin(θ − α)

    Negative means that the lines cross behind that station; the paper's eq 5 is |r₂|.

    Args:
        theta: [...] rad, bearing of `station` [..., 2].
        alpha: [...] rad, bearing of `reference` [..., 2].
    Returns:
        r₁, r₂ [...] m; inf where the bearings are parallel.
    Source: Xiu et al. (2002), eqs 1–5, free of the tangents' singularities.
    """
    return _crossing(theta, alpha, station, reference)


@helper
def _reaches_forward(theta, alpha, x1, y1, x2, y2, spread, floor, cap):
    """Whether a crossing with θ ± spread can lie ahead of both stations and between floor and cap."""
    near, far = math.inf, 0.0
    for sign in (-1.0, 0.0, 1.0):
        r1, r2 = signed_ranges(theta + sign * spread, alpha, x1, y1, x2, y2)
        if r1 > 0.0 and r2 > 0.0:
            near, far = min(near, r2), max(far, r2)
    if far > 0.0 and abs(wrap_scalar(theta - alpha)) <= spread:
        far = math.inf
    return near < cap and far > floor


@helper
def _extends(ok, owner, j, seen):
    """Kuhn's augmenting path: try to find a partner for row j, moving earlier rows if need be (iterative depth 2^m)."""
    n = ok.shape[1]
    for h in range(n):
        if ok[j, h] and not seen[h]:
            seen[h] = True
            if owner[h] < 0 or _extends(ok, owner, owner[h], seen):
                owner[h] = j
                return True
    return False


@helper
def _matches_all(ok, rows):
    """Whether every listed row finds a partner of its own."""
    n = ok.shape[1]
    owner = np.full(n, -1)
    for j in range(ok.shape[0]):
        if rows[j] and not _extends(ok, owner, j, np.zeros(n, dtype=np.bool_)):
            return False
    return True


@kernel("(a),(a),(p),(h),(h),(p),(),(),()->(a,h)", "fbffbffffb")
def _admissible(alphas, alpha_valid, reference, thetas, theta_valid, station, spread, floor, cap, out):
    m, n = alphas.shape[0], thetas.shape[0]
    for j in range(m):
        for h in range(n):
            out[j, h] = (
                alpha_valid[j]
                and theta_valid[h]
                and _reaches_forward(
                    thetas[h], alphas[j], station[0], station[1], reference[0], reference[1], spread, floor, cap
                )
            )
    ok = out.copy()
    if not _matches_all(ok, alpha_valid):
        return
    rows = alpha_valid.copy()
    for j in range(m):
        for h in range(n):
            if ok[j, h]:
                rest = ok.copy()
                rest[:, h] = False
                rows[j] = False
                out[j, h] = _matches_all(rest, rows)
                rows[j] = alpha_valid[j]


def admissible_crossings(alphas, alpha_valid, reference, thetas, theta_valid, station, spread, floor=1.0e3, cap=2.0e5):
    """Which crossings of two stations' bearings can be targets: forward, and part of a one-to-one pairing of all.

    Args:
        alphas: [..., a] rad, reference bearings; alpha_valid [..., a] bool.
        reference, station: [..., 2] m.
        thetas: [..., h] rad, the other station's; theta_valid [..., h] bool.
        spread: [...] rad, tolerance of each bearing of `station`.
        floor, cap: [...] m, range limits along the reference bearing.
    Returns:
        [..., a, h] bool. Where no one-to-one pairing exists at all, every forward crossing stays.
    """
    return _admissible(alphas, alpha_valid, reference, thetas, theta_valid, station, spread, floor, cap)


@kernel("(),(p),(h),(h),(p),(),(),()->(),()", "fffbffffff")
def _forward_interval(alpha, reference, thetas, valid, station, spread, floor, cap, lo_out, hi_out):
    lo, hi = math.inf, 0.0
    for h in range(thetas.shape[0]):
        if not valid[h]:
            continue
        parallel = abs(math.sin(thetas[h] - alpha)) <= math.sin(spread)
        forward = 0
        for sign in (-1.0, 1.0):
            theta = thetas[h] + sign * spread
            r1, r2 = signed_ranges(theta, alpha, station[0], station[1], reference[0], reference[1])
            if r1 > 0.0 and r2 > 0.0:
                forward += 1
                lo, hi = min(lo, r2), max(hi, r2)
        if parallel and forward > 0:
            hi = cap
    if hi <= 0.0:
        lo, hi = floor, cap
    lo = min(max(lo, floor), 0.9 * cap)
    lo_out[0] = lo
    hi_out[0] = min(max(hi, 1.1 * lo), cap)


def forward_interval(alpha, reference, thetas, valid, station, spread, floor=1.0e3, cap=2.0e5) -> RangeInterval:
    """Range interval along a reference bearing from all forward crossings with another station's bearings.

    Crossings behind either station are impossible and dropped; a ±spread bracket that contains the parallel
    direction reaches to the sensor's cap; nothing forward leaves the whole [floor, cap].

    Args:
        alpha: [...] rad, reference bearing.
        reference: [..., 2] m.
        thetas: [..., h] rad, all bearings of the other station, pairing unknown.
        valid: [..., h] bool.
        station: [..., 2] m.
        spread: [...] rad, half width of the bracket (3σ in the paper).
        floor, cap: [...] m, nearest and farthest range of interest.
    Returns:
        RangeInterval with floor <= low < high <= cap.
    Source: Xiu et al. (2002), eqs 8–10. Deviation: forward crossings and a cap instead of moduli, which the
        specification shows to admit crossings behind the stations (up to 1000 km).
    """
    return RangeInterval(*_forward_interval(alpha, reference, thetas, valid, station, spread, floor, cap))


@kernel("(),(p),(h),(p),()->(),()")
def _modulus_interval(alpha, reference, thetas, station, spread, lo, hi):
    lo[0], hi[0] = math.inf, 0.0
    for h in range(thetas.shape[0]):
        for sign in (-1.0, 1.0):
            theta = thetas[h] + sign * spread
            r = abs(signed_ranges(theta, alpha, station[0], station[1], reference[0], reference[1])[1])
            lo[0], hi[0] = min(lo[0], r), max(hi[0], r)


def modulus_interval(alpha, reference, thetas, station, spread) -> RangeInterval:
    """The paper's literal range interval: min and max of |r(θ_h ± spread, α)| over all h; for reproduction only.

    Arguments and shapes as in `forward_interval`. Source: Xiu et al. (2002), eqs 8–10 as printed.
    """
    return RangeInterval(*_modulus_interval(alpha, reference, thetas, station, spread))


@kernel("(s),(s),(s,p),(),(p)->(p),(p,p),()", "fbfffffb")
def _least_squares(bearings, used, stations, std, guess, position, cov, converged):
    position[:] = guess
    var = std * std
    converged[0] = False
    for _ in range(25):
        xx = xy = yy = gx = gy = 0.0
        for s in range(bearings.shape[0]):
            if used[s]:
                h, a, b = linearize(position[0], position[1], stations[s, 0], stations[s, 1])
                nu = wrap_scalar(bearings[s] - h)
                xx, xy, yy = xx + a * a / var, xy + a * b / var, yy + b * b / var
                gx, gy = gx + a * nu / var, gy + b * nu / var
        det = xx * yy - xy * xy
        if not det > 1e-14 * xx * yy:
            break
        cov[0, 0], cov[1, 1], cov[0, 1] = yy / det, xx / det, -xy / det
        cov[1, 0] = cov[0, 1]
        dx, dy = cov[0, 0] * gx + cov[0, 1] * gy, cov[1, 0] * gx + cov[1, 1] * gy
        position[0] += dx
        position[1] += dy
        if dx * dx + dy * dy < 1e-6 * (cov[0, 0] + cov[1, 1]):
            converged[0] = True
            break
    if not converged[0]:
        position[:] = guess
        cov[:] = 0.0


def least_squares_fix(bearings, used, stations, bearing_std, guess) -> Fix:
    """Gauss–Newton fix of one target from the bearings of s >= 2 stations, with its covariance (HᵀH)⁻¹σ².

    Args:
        bearings: [..., s] rad.
        used: [..., s] bool.
        stations: [..., s, 2] m.
        bearing_std: [...] rad.
        guess: [..., 2] m, start of the iteration.
    Returns:
        Fix; where `converged` is False (collinear geometry, fewer than two bearings) position is the guess and
        cov is zero.
    """
    return Fix(*_least_squares(bearings, used, stations, bearing_std, guess))


@kernel("(a),(a),(p),(h),(h),(p),(),()->(a)", "fbffbfffi")
def _pair(alphas, alpha_valid, reference, thetas, theta_valid, station, floor, cap, partner):
    """Exact search over one-to-one pairings, depth first with a running bound."""
    m, n = alphas.shape[0], thetas.shape[0]
    cost = np.empty((m, n + 1))
    for j in range(m):
        cost[j, n] = 1e3 if alpha_valid[j] else 0.0
        for h in range(n):
            r1, r2 = signed_ranges(thetas[h], alphas[j], station[0], station[1], reference[0], reference[1])
            ok = alpha_valid[j] and theta_valid[h] and r1 > 0.0 and floor < r2 < cap
            cost[j, h] = math.log(r2) if ok else math.inf
    choice, best_cost = np.full(m, -1), math.inf
    level, total = 0, np.zeros(m + 1)
    taken = np.full(n + 1, -1)
    partner[:] = -1
    while level >= 0:
        if choice[level] >= 0 and taken[choice[level]] == level:
            taken[choice[level]] = -1
        choice[level] += 1
        h = choice[level]
        if h > n:
            choice[level] = -1
            level -= 1
            continue
        c = total[level] + cost[level, h]
        if taken[h] >= 0 or c >= best_cost:
            continue
        if level == m - 1:
            best_cost = c
            for j in range(m):
                partner[j] = choice[j] if choice[j] < n else -1
            continue
        taken[h] = level if h < n else -1
        total[level + 1] = c
        level += 1


def pair_bearings(alphas, alpha_valid, reference, thetas, theta_valid, station, floor=1.0e3, cap=2.0e5):
    """One-to-one pairing of two stations' first bearings, ghosts rejected.

    A pairing may use forward crossings between `floor` and `cap` only. Two bearings from two stations always meet
    exactly, so residuals cannot tell pairings apart; but the parallaxes θ − α of all pairings have the same sum, and
    range goes as baseline / parallax: among the feasible pairings the one with the smallest Σ log r is taken, which
    spreads the parallax most evenly over the targets.

    Args:
        alphas: [..., a] rad, reference bearings; alpha_valid [..., a] bool.
        reference, station: [..., 2] m.
        thetas: [..., h] rad, the other station's; theta_valid [..., h] bool.
        floor, cap: [...] m.
    Returns:
        [..., a] index into `thetas`, −1 where no forward partner is left.
    """
    return _pair(alphas, alpha_valid, reference, thetas, theta_valid, station, floor, cap)
