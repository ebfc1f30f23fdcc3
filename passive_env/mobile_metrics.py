"""Figures of merit of the track of sensors that move, and the bound along the true course. Truth is used here."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from passive_env.angle_metrics import AngleMetrics, measure_in_space
from passive_env.metrics import Violations
from passive_env.mobile_sensors import accuracies
from trackers.converted_measurement import Layout
from trackers.scan_fusion import NOT_WAITING


class Bound(NamedTuple):
    """The theoretical covariance along the true course, after `trackers.scan_fusion.ScanState`; e environments.

    Attributes:
        cov: [e, 1, 6, 6]; scans: [e, 1] int; waited_s: [e, 1].
    """

    cov: Any
    scans: Any
    waited_s: Any


class MobileFigures:
    """Figures of merit of a scenario with moving sensors; holds no state of any episode.

    Args:
        scenario: supplies kinds, the filter, time between scans and the limits of a lost track.
    """

    def __init__(self, scenario: Any):
        self._scenario, self._tracker = scenario, scenario.make_tracker()

    def begin(self, estimate, truth, platforms, tape, reports) -> tuple[Bound, AngleMetrics]:
        """Bound and figures of what is expected of the target before anything is installed."""
        shape = truth.shape[:2]
        bound = Bound(np.array(estimate.cov), np.zeros(shape, dtype=np.int64), np.full(shape, NOT_WAITING))
        return bound, self._measure(estimate, truth, bound, platforms)

    def advance(self, estimate, truth, bound, platforms, tape, reports) -> tuple[Bound, AngleMetrics]:
        """Bound and figures of a scan from the bound after the one before it."""
        s = self._scenario
        layout = Layout(platforms[:, None, None, :, :3], accuracies(tape.task, s.sensors)[:, None], s.ranging)
        cov, scans, waited, _ = self._tracker.promise(bound, truth[:, :, None], layout, s.step_s)
        new = Bound(cov, scans, waited)
        return new, self._measure(estimate, truth, new, platforms)

    def violations(self, platforms, truth, tape) -> Violations:
        """There are neither stand-off rings nor no-go discs."""
        return Violations(np.zeros(len(platforms)), np.zeros(len(platforms)))

    def _measure(self, estimate, truth, bound: Bound, platforms) -> AngleMetrics:
        s = self._scenario
        return AngleMetrics(
            *measure_in_space(estimate.mean, estimate.cov, truth, bound.cov, platforms, s.lost_error_m, s.lost_nees)
        )
