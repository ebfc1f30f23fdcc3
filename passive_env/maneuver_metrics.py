"""Figures of merit of a track of a maneuvering target in the plane. Truth is used here."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from passive_env.metrics import (
    FARTHEST_M,
    PRIOR_VELOCITY_STD_M_S,
    Violations,
    at_most,
    errors_in_plane,
    violations,
)
from trackers.bounds import range_variance
from trackers.compiled import kernel
from trackers.measurement import condition_into, slope
from trackers.motion import predict_in_place

PRIOR_POSITION_STD_M = 1e5
"""What the Cramér–Rao bound knows of the position before the first scan, per axis: next to nothing."""

HARDEST_M_S2 = 1e4
"""Errors of the acceleration are cut here, and a tracker's NaN counts as this."""

MANEUVER_M_S2 = 1.0
"""A target maneuvers while its true acceleration exceeds this."""


class ManeuverMetrics(NamedTuple):
    """Figures of merit of one instant, each [..., m].

    Attributes:
        range_error_m: |estimated − true range| from the reference station [m].
        position_error_m: distance of the estimate from the target [m].
        range_m: true range from the reference station [m].
        range_crlb_m: posterior Cramér–Rao bound on the range along the true geometry [m].
        nees: normalised estimation error squared (4 degrees of freedom).
        lost: far off without knowing it.
        position_crlb_m: the bound on the root mean square position error [m].
        acceleration_error_m_s2: length of the estimated minus the true acceleration.
        fix_error_m: distance of the scan's position fix from the target; 0 where there is no fix.
        maneuvering: whether the target's true acceleration exceeds `MANEUVER_M_S2`.
    """

    range_error_m: Any
    position_error_m: Any
    range_m: Any
    range_crlb_m: Any
    nees: Any
    lost: Any
    position_crlb_m: Any
    acceleration_error_m_s2: Any
    fix_error_m: Any
    maneuvering: Any


@kernel(
    "(m,x),(m,x,x),(m,p),(p),(),(m,x),(m,p),(m,x,x),(s,x),(l)->(m,x,x),(m),(m),(m),(m),(m),(m),(m),(m),(m),(m)",
    "FFFFbFFFFFFFFFFFBFFFB",
)
def _measure(mean, cov, acceleration, fix, fixed, truth, true_acceleration, bound, platforms, limits,
             new_bound, range_error, position_error, true_range, range_crlb, nees, lost, position_crlb,
             acceleration_error, fix_error, maneuvering):  # fmt: skip
    T, q, var, fastest, lost_error, lost_nees = limits[0], limits[1], limits[2], limits[3], limits[4], limits[5]
    ref = platforms.shape[0] - 1
    sx, sy = platforms[ref, 0], platforms[ref, 1]
    x = np.empty(4)
    new_bound[:] = bound
    for m in range(mean.shape[0]):
        P = new_bound[m]
        x[:] = truth[m]
        if T > 0.0:
            predict_in_place(x, P, T, q)
        for s in range(platforms.shape[0]):
            if math.hypot(platforms[s, 2], platforms[s, 3]) <= fastest:
                a, b = slope(truth[m, 0], truth[m, 1], platforms[s, 0], platforms[s, 1])
                condition_into(x, P, 0.0, a, b, var, x, P)
        range_crlb[m] = math.sqrt(range_variance(P, truth[m, 0], truth[m, 1], sx, sy))
        position_crlb[m] = math.sqrt(max(P[0, 0] + P[1, 1], 0.0))
        range_error[m], position_error[m], nees[m], true_range[m] = errors_in_plane(
            mean[m], cov[m], truth[m], sx, sy, x
        )
        lost[m] = position_error[m] > lost_error and nees[m] > lost_nees
        ax, ay = true_acceleration[m, 0], true_acceleration[m, 1]
        acceleration_error[m] = at_most(math.hypot(acceleration[m, 0] - ax, acceleration[m, 1] - ay), HARDEST_M_S2)
        off = math.hypot(fix[0] - truth[m, 0], fix[1] - truth[m, 1])
        fix_error[m] = min(off, FARTHEST_M) if fixed else 0.0
        maneuvering[m] = math.hypot(ax, ay) > MANEUVER_M_S2


class ManeuverFigures:
    """Figures of merit and violations of a scenario with a maneuvering target; holds no state of any episode.

    The bound's target has a constant velocity, disturbed by a white acceleration of a standard deviation that the
    scenario states. Stations too fast to measure do not count, and the others with the probability that they see the
    target (information reduction factor).

    Args:
        scenario: supplies noise, detection probability, the bound's acceleration and the limits.
    """

    def __init__(self, scenario: Any):
        s = self._scenario = scenario
        variance = (1e-3 * s.azimuth_std_mrad) ** 2
        rest = (s.measuring_speed_limit_m_s, s.lost_error_m, s.lost_nees)
        self._first = np.array([0.0, 0.0, variance, *rest])
        noise = s.bound_acceleration_m_s2 * s.step_s
        self._later = np.array([s.step_s, noise, variance / s.detection_probability, *rest])
        self._prior = np.diag(np.square([PRIOR_POSITION_STD_M] * 2 + [PRIOR_VELOCITY_STD_M_S] * 2))

    def begin(self, estimate, truth, platforms, tape, reports) -> tuple[Any, ManeuverMetrics]:
        """Bound and figures of the first scan, in which every station sees the target."""
        prior = np.broadcast_to(self._prior, (*truth.shape, 4))
        return self._measure(estimate, truth, prior, platforms, reports, self._first)

    def advance(self, estimate, truth, bound, platforms, tape, reports) -> tuple[Any, ManeuverMetrics]:
        """Bound and figures of a later scan from the bound after the one before it."""
        return self._measure(estimate, truth, bound, platforms, reports, self._later)

    def violations(self, platforms, truth, tape) -> Violations:
        """Intrusions into the target's stand-off ring; there are no no-go discs."""
        return violations(platforms, truth, self._scenario.standoff_m, tape.discs)

    def _measure(self, estimate, truth, bound, platforms, reports, limits) -> tuple[Any, ManeuverMetrics]:
        fix = reports.fix
        new_bound, *figures = _measure(
            estimate.mean, estimate.cov, reports.acceleration, fix.position, fix.fixed, truth,
            reports.true_acceleration, bound, platforms, limits,
        )  # fmt: skip
        return new_bound, ManeuverMetrics(*figures)
