"""Figures of merit of a track on range sums, in the plane and in space. Truth is used here."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from passive_env.metrics import FARTHEST_M, MAX_NEES, Violations, at_most, violations
from passive_env.radar_sensors import distance, sum_std
from trackers.axis_motion import add_axis_noise, move_axes
from trackers.compiled import kernel
from trackers.linalg import cholesky_in_place, mahalanobis_with_factor
from trackers.range_sum import absorb_column, range_sum_row, whitened_row_gain


class RadarMetrics(NamedTuple):
    """Figures of merit of one instant, each [..., m].

    Attributes:
        range_error_m: |estimated − true range| from the receiver [m].
        position_error_m: distance of the estimate from the target [m].
        range_m: true range from the receiver [m].
        range_crlb_m: posterior Cramér–Rao bound on the range along the true geometry [m].
        nees: normalised estimation error squared (2d degrees of freedom).
        lost: far off without knowing it.
        position_crlb_m: the bound on the root mean square position error [m].
        horizontal_error_m, horizontal_crlb_m: of the level part of the position; in the plane the same as of all.
        height_error_m, height_crlb_m: of its height; 0 in the plane.
    """

    range_error_m: Any
    position_error_m: Any
    range_m: Any
    range_crlb_m: Any
    nees: Any
    lost: Any
    position_crlb_m: Any
    horizontal_error_m: Any
    horizontal_crlb_m: Any
    height_error_m: Any
    height_crlb_m: Any


@kernel(
    "(m,y),(m,y,y),(m,y),(m,y,y),(s,y),(n,d),(n),(d),(l)->(m,y,y),(m),(m),(m),(m),(m),(m),(m),(m),(m),(m),(m)",
    "FFFFFFBFFFFFFFFBFFFFF",
)
def _measure(mean, cov, truth, bound, platforms, transmitters, answered, noise, limits,
             new_bound, range_error, position_error, true_range, range_crlb, nees, lost, position_crlb,
             horizontal_error, horizontal_crlb, height_error, height_crlb):  # fmt: skip
    d, receiver, T = transmitters.shape[1], platforms[0], limits[0]
    scratch = np.empty((2 * d + 4, 2 * d))  # one piece: every allocation takes time
    factor, column, off, sight, row = scratch[: 2 * d], scratch[2 * d], scratch[-3], scratch[-2], scratch[-1]
    new_bound[:] = bound
    for m in range(mean.shape[0]):
        P = new_bound[m]
        if T > 0.0:
            off[:] = truth[m]
            move_axes(off, P, T, d)
            add_axis_noise(P, T, noise, 1.0, d)
        r = max(distance(truth[m], receiver, d), 1.0)
        for j in range(d):
            sight[j] = (truth[m, j] - receiver[j]) / r
        for i in range(answered.shape[0]):
            if answered[i]:
                r_i = range_sum_row(truth[m], receiver, transmitters[i], row, d) - r
                std = sum_std(r, r_i, limits[1], limits[2], limits[3])
                whitened_row_gain(P, row, std * std, column, d)
                absorb_column(P, column, 2 * d)
        true_range[m] = r
        range_error[m] = at_most(abs(distance(mean[m], receiver, d) - r), FARTHEST_M)
        position_error[m] = at_most(distance(mean[m], truth[m], d), FARTHEST_M)
        horizontal_error[m] = at_most(distance(mean[m], truth[m], 2), FARTHEST_M)
        height_error[m] = at_most(abs(mean[m, 2] - truth[m, 2]), FARTHEST_M) if d == 3 else 0.0
        level, along = P[0, 0] + P[1, 1], 0.0
        for j in range(d):
            for k in range(d):
                along += sight[j] * P[j, k] * sight[k]
        range_crlb[m] = math.sqrt(max(along, 0.0))
        horizontal_crlb[m] = math.sqrt(max(level, 0.0))
        height_crlb[m] = math.sqrt(max(P[2, 2], 0.0)) if d == 3 else 0.0
        position_crlb[m] = math.hypot(horizontal_crlb[m], height_crlb[m])
        for i in range(2 * d):
            off[i] = mean[m, i] - truth[m, i]
            for j in range(2 * d):
                factor[i, j] = cov[m, i, j]
        cholesky_in_place(factor)
        nees[m] = at_most(mahalanobis_with_factor(factor, off), MAX_NEES)
        lost[m] = position_error[m] > limits[4] and nees[m] > limits[5]


class RadarFigures:
    """Figures of merit and violations of a passive radar; holds no state of any episode.

    The bound knows of the target what the operator does before the first scan, then every echo that comes back: it is
    the bound given which ones do.

    Args:
        scenario: supplies noise, the target's disturbance and the limits.
    """

    def __init__(self, scenario: Any):
        s = self._scenario = scenario
        self._noise = np.array(s.process_noise[: s.dimensions])
        rest = (s.range_sum_std_m, s.std_range_m, s.std_floor_m, s.lost_error_m, s.lost_nees)
        self._first, self._later = np.array([0.0, *rest]), np.array([s.step_s, *rest])

    def begin(self, estimate, truth, sightings, guess, tape) -> tuple[Any, RadarMetrics]:
        """Bound and figures when the track has been started."""

        def measure(sighting: Any, bound: Any, limits: Any) -> tuple[Any, RadarMetrics]:
            receiver = np.zeros_like(tape.platforms)
            receiver[:, 0, : self._scenario.dimensions] = sighting.scan.receiver
            return self._measure(estimate, sighting.truth, bound, receiver, tape, sighting.scan.valid, limits)

        bound, metrics = measure(sightings[0], guess.cov[:, None], self._first)
        for sighting in sightings[1:]:
            bound, metrics = measure(sighting, bound, self._later)
        return bound, metrics

    def advance(self, estimate, truth, bound, platforms, tape, reports) -> tuple[Any, RadarMetrics]:
        """Bound and figures of a later scan from the bound after the one before it."""
        return self._measure(estimate, truth, bound, platforms, tape, reports.listening.answered, self._later)

    def violations(self, platforms, truth, tape) -> Violations:
        """Intrusions into the target's stand-off ring; there are no no-go discs."""
        return violations(platforms, truth, self._scenario.standoff_m, tape.discs)

    def _measure(self, estimate, truth, bound, platforms, tape, answered, limits) -> tuple[Any, RadarMetrics]:
        new_bound, *figures = _measure(
            estimate.mean, estimate.cov, truth, bound, platforms, tape.transmitters, answered, self._noise,
            limits,
        )  # fmt: skip
        return new_bound, RadarMetrics(*figures)
