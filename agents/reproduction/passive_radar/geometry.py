"""What the sites decide before any target flies: dilution maps, true and ghost solutions, bounds for other sites."""

from __future__ import annotations

import itertools
from functools import cache
from typing import Any, NamedTuple

import numpy as np

from agents.reproduction.passive_radar.monte_carlo import (
    ACCELERATION_VAR,
    GOOD,
    PAIR,
    PAIR_PRIOR_STD,
    PLAIN,
    POOR,
    PRIOR,
    START_SCANS,
    STD_M,
    STEPS,
    TARGET,
    Flights,
    Sites,
    fly,
    follow,
)
from trackers import Gaussian, RangeSumScan
from trackers.ellipse_intersection import branch, intersect
from trackers.range_sum import dilution, range_sum, range_sum_jacobian
from trackers.range_sum_bounds import advance, position_std, posterior_bound
from trackers.range_sum_start import fixed_damping_step

HEIGHT_M = 10e3
MAP_M = np.arange(-200e3, 200.1e3, 10e3)
STEADY_S = 50
"""Means over time leave out the seconds before this one."""


# -- dilution of one scan ---------------------------------------------------------------------------------------------


def grid(axis: np.ndarray) -> np.ndarray:
    """Points [y, x, 2] m."""
    return np.stack(np.meshgrid(axis, axis), axis=-1)


def horizontal_map(sites: Sites, axis: np.ndarray = MAP_M, height_known: bool = False) -> np.ndarray:
    """Horizontal standard deviation [y, x] m of one scan, targets at `HEIGHT_M`, or at 0 for sites in the plane."""
    points, d = grid(axis), len(sites.receiver)
    if d == 3:
        points = np.concatenate([points, np.full((*points.shape[:2], 1), HEIGHT_M)], axis=-1)
    H = range_sum_jacobian(points, *sites)
    return dilution(H[..., :2] if height_known else H, STD_M).horizontal


# -- true and ghost solutions -----------------------------------------------------------------------------------------


def random_misses(rng: np.random.Generator, d: int, count: int = 2000) -> tuple[np.ndarray, np.ndarray]:
    """Distance of the nearer root from the target, relative to the target's from the receiver [count]; both valid."""
    p, receiver = rng.uniform(-1e5, 1e5, (2, count, d))
    transmitters = rng.uniform(-1e5, 1e5, (count, d, d))
    roots = intersect(range_sum(p, receiver, transmitters), transmitters, receiver)
    miss = np.linalg.norm(roots.position - p[:, None], axis=-1).min(-1)
    return miss / np.linalg.norm(p - receiver, axis=-1), roots.valid.all(-1)


def sides_differ(rng: np.random.Generator, count: int = 200) -> int:
    """In how many random plane geometries the roots lie on opposite sides of the polyline of rays and segments."""
    p, receiver = rng.uniform(-1e5, 1e5, (2, count, 2))
    transmitters = rng.uniform(-1e5, 1e5, (count, 2, 2))
    roots = intersect(range_sum(p, receiver, transmitters), transmitters, receiver).position
    far = transmitters + 1e4 * (transmitters - transmitters[:, ::-1])
    corners = np.stack([far[:, 0], transmitters[:, 0], receiver, transmitters[:, 1], far[:, 1]], axis=1)
    line = corners[:, None] - roots[:, :, None]
    sight = line[..., 0] + 1j * line[..., 1]
    turned = np.angle(sight[..., 1:] / sight[..., :-1]).sum(-1)
    return int(((turned[:, 0] > 0.0) != (turned[:, 1] > 0.0)).sum())


GHOST_TARGETS = {
    "(5, 5) km": (5e3, 5e3, 100.0, 200.0),
    "(-20, 30) km": (-20e3, 30e3, 100.0, 200.0),
    "(40, -10) km": (40e3, -10e3, 100.0, 200.0),
    "(-40, -80) km": (-40e3, -80e3, -100.0, -200.0),
}
"""The paper's target and three of ours (the specification does not name its own), which cross no border."""

START_GRID_M = np.arange(-60e3, 60.1e3, 4e3)
ENDED_M = 1e3
"""A start has converged if it ends nearer than this to a solution."""

STATIC_STEPS = 400
EKF_S = 150


class Ends(NamedTuple):
    """Where starts on the grid end: shares of all starts that converge, and of those that obey a rule."""

    converged: float
    sign: float
    nearest: float
    count: int


def ends_of(starts: np.ndarray, ends: np.ndarray, first: np.ndarray, last: np.ndarray) -> Ends:
    """Starts and ends [g, 2] m; both solutions [2, 2] m when the starts were made and at the end."""
    miss = np.linalg.norm(ends[:, None] - last, axis=-1)
    converged = miss.min(-1) < ENDED_M
    at = miss.argmin(-1)[converged]
    side = np.where(branch(starts, PAIR.transmitters, PAIR.receiver) > 0.0, 0, 1)[converged]
    near = np.linalg.norm(starts[:, None] - first, axis=-1).argmin(-1)[converged]
    return Ends(float(converged.mean()), float((side == at).mean()), float((near == at).mean()), int(converged.sum()))


def solutions(position: np.ndarray) -> np.ndarray:
    """True and ghost solution [..., 2, 2] m of the two sums of a target [..., 2] m."""
    return intersect(range_sum(position, *PAIR), PAIR.transmitters, PAIR.receiver).position


@cache
def scan_ends(target, damping: float) -> Ends:
    """Eq 12 repeated on one noise-free scan from every start of the grid."""
    p, starts = np.array(target[:2]), grid(START_GRID_M).reshape(-1, 2)
    scan = RangeSumScan(range_sum(p, *PAIR), np.ones(2, bool), PAIR.transmitters, PAIR.receiver, np.full(2, STD_M))
    ends = starts
    for _ in range(STATIC_STEPS):
        ends = fixed_damping_step(ends, scan, damping)
    return ends_of(starts, ends, solutions(p), solutions(p))


def filter_ends(target, rng: np.random.Generator, batch: bool) -> Ends:
    """The filter after 150 s from every start of the grid, plain or after the batch start."""
    starts = grid(START_GRID_M).reshape(-1, 2)
    one = fly(rng, np.array(target), 1, steps=EKF_S)
    flights = Flights(
        np.repeat(one.path, len(starts), axis=0), STD_M * rng.standard_normal((len(starts), EKF_S + 1, 3))
    )
    prior = Gaussian(np.hstack([starts, np.zeros_like(starts)]), np.diag(np.square(PAIR_PRIOR_STD)))
    record = follow(PLAIN, PAIR, flights, prior, START_SCANS if batch else 1)
    first, last = solutions(one.path[0, [0, -1], :2])
    return ends_of(starts, record.error[:, -1] + one.path[0, -1, :2], first, last)


def ghost_path(seconds: int) -> tuple[np.ndarray, np.ndarray]:
    """Solutions [k + 1, 2, 2] m, true first, of section 3.4's target, and its third range sum's difference [k + 1]."""
    t = np.arange(seconds + 1.0)[:, None]
    both = solutions(np.array([5e3, 5e3]) + t * [100.0, 200.0])
    third = range_sum(both, PAIR.receiver, POOR.transmitters[2:, :2])[..., 0]
    return both, np.abs(third[:, 1] - third[:, 0])


# -- bounds for other sites -------------------------------------------------------------------------------------------


@cache
def straight_path() -> np.ndarray:
    """True states [k + 1, 6] of the paper's target without random accelerations."""
    t = np.arange(STEPS + 1.0)[:, None]
    return np.hstack([TARGET[:3] + t * TARGET[3:], np.tile(TARGET[3:], (STEPS + 1, 1))])


def bound(sites: Sites) -> np.ndarray:
    """Posterior bound along the straight path, horizontal and vertical [2, k + 1] m."""
    cov = posterior_bound(straight_path(), sites.transmitters, sites.receiver, PRIOR.cov, STD_M, 1.0, ACCELERATION_VAR)
    return np.array(position_std(cov)[1:])


def mean_bound(sites: Sites) -> np.ndarray:
    """The same, mean over 50 to 600 s [2] m."""
    return bound(sites)[:, STEADY_S:].mean(-1)


SIX = Sites(np.zeros(3), np.concatenate([POOR.transmitters, GOOD.transmitters]))
"""Transmitters of both layouts, receiver at the origin."""

PAIRS = np.array([[i in pair for i in range(6)] for pair in itertools.combinations(range(6), 2)])
"""All choices of two of six [15, 6]."""


@cache
def triples() -> np.ndarray:
    """Mean horizontal bounds [20] m of all choices of three of the six; the last is the triangle."""
    chosen = itertools.combinations(range(6), 3)
    return np.array([mean_bound(SIX._replace(transmitters=SIX.transmitters[list(three)]))[0] for three in chosen])


def pair_bound(choose: Any) -> np.ndarray:
    """Mean horizontal bound [...] m if `choose(k)` says which transmitters [..., 6] are heard in scan k.

    It may return more than one choice on the last leading axis.
    """
    path, cov, found = straight_path(), PRIOR.cov, []
    std, w = np.full(6, STD_M), np.array(ACCELERATION_VAR)
    for k in range(STEPS + 1):
        cov = advance(cov, path[k], SIX.transmitters, SIX.receiver, std, float(k > 0), w, choose(k, cov).astype(float))
        found.append(position_std(cov).horizontal)
    return np.mean(found[STEADY_S:], axis=0)


def best_pair(k: int, cov: np.ndarray) -> np.ndarray:
    """The pair [6] that leaves the smallest horizontal bound after this scan."""
    after = advance(
        cov, straight_path()[k], SIX.transmitters, SIX.receiver, np.full(6, STD_M), float(k > 0),
        np.array(ACCELERATION_VAR), PAIRS.astype(float),
    )  # fmt: skip
    return PAIRS[position_std(after).horizontal.argmin()]


@cache
def pair_choices() -> dict[str, float]:
    """Mean horizontal bounds [m] of two of six per scan."""
    triangle = PAIRS[~PAIRS[:, :3].any(-1)]
    return {
        "best fixed pair": float(pair_bound(lambda k, cov: PAIRS).min()),
        "round-robin over all pairs": float(pair_bound(lambda k, cov: PAIRS[k % 15])),
        "round-robin in the triangle": float(pair_bound(lambda k, cov: triangle[k % 3])),
        "greedy": float(pair_bound(best_pair)),
    }
