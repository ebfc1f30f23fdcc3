"""Range, azimuth and elevation of one target from sensors that move: tape row and geometry to one scan."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from passive_env.placement import Task, entry_prior
from passive_env.placement_simulation import PlacementTape
from trackers.compiled import kernel
from trackers.converted_measurement import Layout
from trackers.gaussian import Gaussian
from trackers.scan_fusion import FusedScan, ScanState, ScanUpdate


class MobileSighting(NamedTuple):
    """A scan, and what only the world knows about it.

    Attributes:
        scan: what the tracker gets: a `FusedScan` of arrays [e, 1, n, …], or, before there is any, what is expected of
            the target, a Gaussian [e, 1, 6].
        truth: [e, 1, 6] true states at this instant.
    """

    scan: Any
    truth: Any


class MobileReports(NamedTuple):
    """What the last scan brought, as an operator sees it.

    Attributes:
        measured: [e, n] bool, whether a sensor measured the target.
        measurement: [e, n, 3] range [m], 0 of a sensor without, azimuth and elevation [rad]; all 0 where not measured.
    """

    measured: Any
    measurement: Any


@kernel("(k,m,x6),(k,n,p3),(),(n,x6),(p3),(n),()->(n,p3),(n),(m,x6)", "FFiFFBfFBF")
def _sense(targets, noise, step, platforms, std, ranging, nearest, z, measured, truth):
    truth[:] = targets[step]
    x = targets[step, 0]
    for s in range(platforms.shape[0]):
        dx, dy, dz = x[0] - platforms[s, 0], x[1] - platforms[s, 1], x[2] - platforms[s, 2]
        level2 = dx * dx + dy * dy
        r = math.sqrt(level2 + dz * dz)
        measured[s] = r >= nearest
        z[s, 0] = r + std[0] * noise[step, s, 0] if ranging[s] else 0.0
        z[s, 1] = math.atan2(dy, dx) + std[1] * noise[step, s, 1]
        z[s, 2] = math.atan2(dz, math.sqrt(level2)) + std[2] * noise[step, s, 2]


class RadarSensors:
    """All sensors of an episode; one that is too close to the target does not measure it.

    Args:
        scenario: supplies kinds, minimum range, time between scans and the white acceleration of courses.
    """

    def __init__(self, scenario: Any):
        self._scenario = scenario

    def acquire(self, tape: PlacementTape) -> tuple[PlacementTape, MobileSighting]:
        """Before sensors are installed there is no scan, only what is known of the target where it enters."""
        prior = entry_prior(tape.task)
        return tape, MobileSighting(Gaussian(prior.mean[:, None], prior.cov[:, None]), tape.targets[:, 0])

    def sense(self, tape: PlacementTape, step, platforms, predicted: Any) -> MobileSighting:
        """The scan of an instant: steps [e], platforms [e, n, 6]; nothing in it depends on the predicted track."""
        s = self._scenario
        z, measured, truth = _sense(
            tape.targets, tape.noise, step, platforms, tape.task.std, s.ranging, s.minimum_range_m
        )
        layout = Layout(platforms[:, None, :, :3], accuracies(tape.task, s.sensors)[:, None], s.ranging)
        return MobileSighting(FusedScan(z[:, None], measured[:, None], layout), truth)

    def acquired(self, sighting: MobileSighting, state: ScanState) -> MobileReports:
        """What there is before the first scan: nothing."""
        shape = (len(sighting.truth), self._scenario.sensors)
        return MobileReports(np.zeros(shape, dtype=bool), np.zeros((*shape, 3)))

    def report(self, sighting: MobileSighting, update: ScanUpdate) -> MobileReports:
        """What a scan brought."""
        measured = sighting.scan.measured[:, 0]
        return MobileReports(measured, np.where(measured[..., None], sighting.scan.measurement[:, 0], 0.0))

    def info(self, reports: MobileReports) -> dict[str, Any]:
        """Nothing besides the figures of merit."""
        return {}


def accuracies(task: Task, sensors: int) -> np.ndarray:
    """Standard deviations [e, n, 3] of all sensors' range [m], azimuth and elevation [rad]."""
    return np.ascontiguousarray(np.broadcast_to(task.std[:, None], (len(task.std), sensors, 3)))
