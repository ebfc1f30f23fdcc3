"""How far off the tracks are, how far off anyone must be, and whether a track is lost. Truth is used here."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from trackers.bounds import bound_prior, range_variance
from trackers.compiled import helper, kernel
from trackers.linalg import cholesky_4, mahalanobis_4
from trackers.measurement import condition_into, slope
from trackers.motion import predict_in_place

FARTHEST_M = 1e9
"""Errors are cut here, and a tracker's NaN counts as this: a diverged filter must not leak into rewards."""

MAX_NEES = 1e12

PRIOR_VELOCITY_STD_M_S = 200.0
"""Velocity prior of the Cramér–Rao bound at the first scan, the trackers' own; the scenario supplies the range's."""
PRIOR_BEARING_STD_RAD = 10.0
"""Nothing is known across the line of sight before the first scan; its bearings are counted once, as every scan's."""


class Metrics(NamedTuple):
    """Figures of merit of one instant, each [..., m].

    Attributes:
        range_error_m: |estimated − true range| from the reference station [m].
        position_error_m: distance of the estimate from the target [m].
        range_m: true range from the reference station [m].
        range_crlb_m: posterior Cramér–Rao bound on the range along the true geometry [m].
        nees: normalised estimation error squared (4 degrees of freedom).
        lost: far off without knowing it.
    """

    range_error_m: Any
    position_error_m: Any
    range_m: Any
    range_crlb_m: Any
    nees: Any
    lost: Any


class Violations(NamedTuple):
    """How deep platforms are where they should not be, each [...] and 0 while every platform keeps clear.

    A depth is relative: 0 at a ring's edge, 1 at its centre.

    Attributes:
        standoff: sum over platform–target pairs of the depth in the target's stand-off ring [1].
        nogo: sum over platform–disc pairs of the depth in the no-go disc [1].
    """

    standoff: Any
    nogo: Any


@helper
def at_most(value, limit):
    """The lesser of both; the limit for NaN."""
    return value if value <= limit else limit


@helper
def errors_in_plane(mean, cov, truth, sx, sy, x):
    """Range error, position error and NEES of a track, and the true range from sx, sy [m]; `x` [4] is scratch."""
    true_range = math.hypot(truth[0] - sx, truth[1] - sy)
    range_error = at_most(abs(math.hypot(mean[0] - sx, mean[1] - sy) - true_range), FARTHEST_M)
    position_error = at_most(math.hypot(mean[0] - truth[0], mean[1] - truth[1]), FARTHEST_M)
    for i in range(4):
        x[i] = mean[i] - truth[i]
    return range_error, position_error, at_most(mahalanobis_4(cholesky_4(cov), x), MAX_NEES), true_range


@kernel(
    "(m,x),(m,x,x),(m,x),(m,x,x),(s,x),(),(),(),(),(),(),(x)->(m,x,x),(m),(m),(m),(m),(m),(m)",
    "FFFFFfffbffFFFFFFFB",
)
def _measure(mean, cov, truth, bound, platforms, T, q, std, all_stations, lost_error, lost_nees, x,
             new_bound, range_error, position_error, true_range, crlb, nees, lost):  # fmt: skip
    """`x` is scratch: allocating inside the kernel would cost a third of its time."""
    n_stations = platforms.shape[0]
    sx, sy = platforms[n_stations - 1, 0], platforms[n_stations - 1, 1]
    new_bound[:] = bound
    for m in range(mean.shape[0]):
        P = new_bound[m]
        x[:] = truth[m]
        if T > 0.0:
            predict_in_place(x, P, T, q)
        for s in range(0 if all_stations else n_stations - 1, n_stations):
            a, b = slope(truth[m, 0], truth[m, 1], platforms[s, 0], platforms[s, 1])
            condition_into(x, P, 0.0, a, b, std * std, x, P)
        crlb[m] = math.sqrt(range_variance(P, truth[m, 0], truth[m, 1], sx, sy))
        range_error[m], position_error[m], nees[m], true_range[m] = errors_in_plane(
            mean[m], cov[m], truth[m], sx, sy, x
        )
        lost[m] = position_error[m] > lost_error and nees[m] > lost_nees


def measure(
    estimate, truth, bound, platforms, step_s, process_noise, bearing_std, all_stations, lost_error_m, lost_nees
) -> tuple[Any, Metrics]:
    """Advance the posterior Cramér–Rao bound by one scan and compare the tracks with the truth.

    Args:
        estimate: Gaussian, mean [..., m, 4], cov [..., m, 4, 4].
        truth: [..., m, 4].
        bound: [..., m, 4, 4] bound after the previous scan.
        platforms: [..., s, 4]; the last one is the reference.
        step_s: [...] s since the previous scan; 0 for the first.
        process_noise: q [m/s per step] of the bound's motion model.
        bearing_std: rad, divided by the square root of the detection probability by the caller.
        all_stations: whether all stations' bearings count or the reference's only.
        lost_error_m, lost_nees: a track is lost if both are exceeded.
    Returns:
        new bound [..., m, 4, 4], Metrics.
    """
    new_bound, *figures = _measure(
        estimate.mean, estimate.cov, truth, bound, platforms, step_s, process_noise, bearing_std,
        all_stations, lost_error_m, lost_nees, np.empty(4),
    )  # fmt: skip
    return new_bound, Metrics(*figures)


@helper
def _depth(platform, x, y, radius):
    """Relative depth of a platform inside a circle; 0 outside, and for a circle without extent."""
    distance = math.hypot(platform[0] - x, platform[1] - y)
    return max(0.0, 1.0 - distance / max(radius, 1e-9)) if radius > 0.0 else 0.0


@kernel("(s,x),(m,x),(),(d,c)->(),()")
def _violations(platforms, truth, standoff_m, discs, standoff, nogo):
    standoff[0] = nogo[0] = 0.0
    for s in range(platforms.shape[0]):
        for m in range(truth.shape[0]):
            standoff[0] += _depth(platforms[s], truth[m, 0], truth[m, 1], standoff_m)
        for d in range(discs.shape[0]):
            nogo[0] += _depth(platforms[s], discs[d, 0], discs[d, 1], discs[d, 2])


def violations(platforms, truth, standoff_m, discs) -> Violations:
    """Depths of intrusion into stand-off rings and no-go discs.

    Args:
        platforms: [..., s, 4]; truth: [..., m, 4] m.
        standoff_m: radius of the ring about every target, 0 for none.
        discs: [..., d, 3] centre x, y and radius [m].
    """
    if standoff_m == 0.0 and discs.shape[-2] == 0:
        return Violations(np.zeros(platforms.shape[:-2]), np.zeros(platforms.shape[:-2]))
    return Violations(*_violations(platforms, truth, standoff_m, discs))


class BearingMetrics:
    """Figures of merit and violations of a scenario with bearings; holds no state of any episode.

    Args:
        scenario: supplies noise, bearings used, detection probability, the bound's prior and the limits.
    """

    def __init__(self, scenario: Any):
        self._scenario = scenario
        self._all_stations = scenario.bearings == "all"
        self._std = math.radians(scenario.bearing_std_deg)
        # A missed bearing scales the expected information: the same as noise larger by 1/√P_D.
        self._bound_std = self._std / math.sqrt(scenario.detection_probability)

    def begin(self, estimate, truth, platforms, tape, reports) -> tuple[Any, Metrics]:
        """Bound and figures of the first scan, of which all stations' bearings count."""
        prior = bound_prior(
            truth, platforms[:, None, -1, :2], PRIOR_BEARING_STD_RAD, self._scenario.bound_range_std_m,
            PRIOR_VELOCITY_STD_M_S,
        )  # fmt: skip
        return self._measure(estimate, truth, prior, platforms, 0.0, self._std, all_stations=True)

    def advance(self, estimate, truth, bound, platforms, tape, reports) -> tuple[Any, Metrics]:
        """Bound and figures of a later scan from the bound after the one before it."""
        return self._measure(
            estimate, truth, bound, platforms, self._scenario.step_s, self._bound_std, self._all_stations
        )

    def violations(self, platforms, truth, tape) -> Violations:
        """Intrusions into stand-off rings and no-go discs."""
        return violations(platforms, truth, self._scenario.standoff_m, tape.discs)

    def _measure(self, estimate, truth, bound, platforms, step_s, std, all_stations) -> tuple[Any, Metrics]:
        s = self._scenario
        return measure(
            estimate, truth, bound, platforms, step_s, s.process_noise_m_s, std, all_stations, s.lost_error_m,
            s.lost_nees,
        )  # fmt: skip
