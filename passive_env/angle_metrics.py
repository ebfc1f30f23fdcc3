"""Figures of merit of tracks in space, range counted from platform 0. Truth is used here."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from passive_env.metrics import FARTHEST_M, MAX_NEES, Violations, at_most
from trackers.bounds_3d import advance, bound_start
from trackers.compiled import helper, kernel
from trackers.linalg import cholesky_in_place, mahalanobis_with_factor

PRIOR_VELOCITY_STD_M_S = (200.0, 200.0, 50.0)
"""Velocity prior of the Cramér–Rao bound, east, north, up: what trackers assume."""


class AngleMetrics(NamedTuple):
    """Figures of merit of one instant, each [..., m].

    Attributes:
        range_error_m: |estimated − true range| from platform 0 [m].
        position_error_m: distance of the estimate from the target [m].
        range_m: true range from platform 0 [m].
        range_crlb_m: posterior Cramér–Rao bound on the range along the true geometry [m].
        nees: normalised estimation error squared (6 degrees of freedom).
        lost: far off without knowing it.
        position_crlb_m: the bound on the root mean square position error [m].
    """

    range_error_m: Any
    position_error_m: Any
    range_m: Any
    range_crlb_m: Any
    nees: Any
    lost: Any
    position_crlb_m: Any


@helper
def _distance(a, b):
    dx, dy, dz = a[0] - b[0], a[1] - b[1], a[2] - b[2]
    return math.sqrt(dx * dx + dy * dy + dz * dz)


@kernel("(m,x6),(m,x6,x6),(m,x6),(m,x6,x6),(s,x6),(),()->(m),(m),(m),(m),(m),(m),(m)", "FFFFFffFFFFFBF")
def measure_in_space(mean, cov, truth, bound, platforms, lost_error, lost_nees,
                     range_error, position_error, true_range, range_crlb, nees, lost, position_crlb):  # fmt: skip
    """Figures of merit of m tracks, in the order of `AngleMetrics`, given the bound's covariance."""
    error, factor, u = np.empty(6), np.empty((6, 6)), np.empty(3)
    for m in range(mean.shape[0]):
        true_range[m] = _distance(truth[m], platforms[0])
        range_error[m] = at_most(abs(_distance(mean[m], platforms[0]) - true_range[m]), FARTHEST_M)
        position_error[m] = at_most(_distance(mean[m], truth[m]), FARTHEST_M)
        variance = trace = 0.0
        for i in range(3):
            u[i] = (truth[m, i] - platforms[0, i]) / max(true_range[m], 1.0)
        for i in range(3):
            trace += bound[m, i, i]
            for j in range(3):
                variance += u[i] * bound[m, i, j] * u[j]
        range_crlb[m], position_crlb[m] = math.sqrt(max(variance, 0.0)), math.sqrt(max(trace, 0.0))
        for i in range(6):
            error[i] = mean[m, i] - truth[m, i]
        factor[:] = cov[m]
        cholesky_in_place(factor)
        nees[m] = at_most(mahalanobis_with_factor(factor, error), MAX_NEES)
        lost[m] = position_error[m] > lost_error and nees[m] > lost_nees


@kernel("(s,x6),(m,x6),()->()")
def _standoff(platforms, truth, radius, depth):
    depth[0] = 0.0
    for s in range(platforms.shape[0]):
        for m in range(truth.shape[0]):
            depth[0] += max(0.0, 1.0 - _distance(platforms[s], truth[m]) / radius)


class AngleFigures:
    """Figures of merit and violations of a scenario in space; holds no state of any episode.

    The bound takes a platform's azimuths and elevations with the probability that they arrive (information reduction
    factor): availability of the episode times detection probability. Clutter is not counted against it.

    Args:
        scenario: supplies noise, detection probability and the limits.
    """

    def __init__(self, scenario: Any):
        self._scenario = scenario
        self._std = np.radians([scenario.azimuth_std_deg, scenario.elevation_std_deg])

    def begin(self, estimate, truth, platforms, tape, reports) -> tuple[Any, AngleMetrics]:
        """Bound and figures of the first scan, in which every sensor sees the target."""
        std = np.broadcast_to(self._std, (*platforms.shape[:2], 2))[:, None]
        bound = bound_start(truth, platforms[:, None, :, :3], std, PRIOR_VELOCITY_STD_M_S)
        return bound, self._measure(estimate, truth, bound, platforms)

    def advance(self, estimate, truth, bound, platforms, tape, reports) -> tuple[Any, AngleMetrics]:
        """Bound and figures of a later scan from the bound after the one before it."""
        s = self._scenario
        shape = (*truth.shape[:2], platforms.shape[1], 2)
        std = np.broadcast_to(self._std, shape)
        share: Any = np.broadcast_to(s.detection_probability * tape.share[:, None, :, None], shape)
        bound = advance(bound, truth, platforms[:, None, :, :3], s.step_s, s.process_noise_m_s2, std, share)
        return bound, self._measure(estimate, truth, bound, platforms)

    def violations(self, platforms, truth, tape) -> Violations:
        """Intrusions into the target's stand-off sphere; there are no no-go discs."""
        nothing = np.zeros(len(platforms))
        radius = self._scenario.standoff_m
        return Violations(_standoff(platforms, truth, radius) if radius > 0.0 else nothing, nothing.copy())

    def _measure(self, estimate, truth, bound, platforms) -> AngleMetrics:
        s = self._scenario
        return AngleMetrics(
            *measure_in_space(estimate.mean, estimate.cov, truth, bound, platforms, s.lost_error_m, s.lost_nees)
        )
