"""Sensors of azimuth and elevation: tape row, geometry and gates to unlabelled returns."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from passive_env.angle_tape import AngleTape
from passive_env.belief import Received
from trackers.angle_contract import AngleScan, AngleUpdate
from trackers.angles import wrap_scalar
from trackers.compiled import helper, kernel
from trackers.direction import innovation_cov, linearize_direction
from trackers.gaussian import Gaussian

CLEAN_DENSITY = 1e-9
"""False returns per rad² told to a tracker where there are none: 0 would mean that nobody knows."""

SHAPES = ("gate", "window")
"""Where clutter lies: in the ellipse in which a sensor searches for the predicted track, or in a fixed window of angles
about the target, whatever the gate."""


class AngleSighting(NamedTuple):
    """A scan, and what only the world knows about it.

    Attributes:
        scan: what the tracker gets.
        truth: [e, m, 6] true target states at this instant.
        origin: [e, s, b] 0 where a return is the target's, −1 for a false return or an empty slot.
        predicted: the track's prediction for this instant, whose gates the clutter lies in.
    """

    scan: AngleScan
    truth: Any
    origin: Any
    predicted: Gaussian


class AngleReports(NamedTuple):
    """What the last scan brought, as an operator sees it; fields as in `passive_env.belief.Belief`, and for pictures:

    Attributes:
        dropped: [e, m] returns in the gates beyond the largest number that the tracker weighs.
        slots: [e, m, s] slot of the likeliest return, −1 where none is likelier.
        scan: the scan itself.
        predicted: the track's prediction for the scan; the first scan's has no covariance, for nothing was predicted.
    """

    assigned: Any
    returns: Any
    missed: Any
    available: Any
    dropped: Any
    slots: Any
    scan: AngleScan
    predicted: Gaussian
    model_probability: Any = ()
    detected: Any = ()
    acceleration: Any = ()

    @property
    def received(self) -> Received:
        """The returns of the scan, as of `passive_env.belief.Belief`."""
        return Received(self.scan.angles, self.scan.valid)


class Clutter(NamedTuple):
    """How false returns are placed.

    Attributes:
        shape: one of `SHAPES`.
        mean: false returns per sensor and scan.
        gate: γ of the gates that are filled.
        window: half the width and height of the window [rad].
        told: whether the tracker is told the density.
    """

    shape: str
    mean: float
    gate: float
    window: float
    told: bool


@helper
def _put(angles, azimuth, elevation):
    """Write a direction [2] into (−π, π] and [−π/2, π/2]."""
    angles[0] = wrap_scalar(azimuth)
    angles[1] = min(max(elevation, -0.5 * math.pi), 0.5 * math.pi)


@kernel(
    "(k,m,x6),(k,s,a2),(k,s),(k,s),(k,s),(k,s,f,a2),(k,s),(),(s,x6),(m,x6),(m,x6,x6),(a2),(),(c),(b)"
    "->(s,b,a2),(s,b),(s,b),(s),(m,x6)",
    "FFBBIFFiFFFFbFFFBIFF",
)
def _sense(targets, noise, available, detected, false_count, false_points, order, k, platforms, mean, cov, std,
           in_gate, clutter, like, angles, valid, origin, density, truth):  # fmt: skip
    H, S, h, center = np.empty((2, 3)), np.empty((2, 2)), np.empty(2), np.empty(2)
    n_mean, gamma, window = clutter[0], clutter[1], clutter[2]
    truth[:] = targets[k]
    for s in range(platforms.shape[0]):
        angles[s] = 0.0
        valid[s] = False
        origin[s] = -1
        density[s] = CLEAN_DENSITY
        h[0], h[1] = linearize_direction(truth[0], platforms[s], H)
        n, count = 0, false_count[k, s] if available[k, s] else 0
        if available[k, s] and detected[k, s]:
            _put(angles[s, 0], h[0] + std[0] * noise[k, s, 0], h[1] + std[1] * noise[k, s, 1])
            origin[s, 0] = 0
            n = 1
        l00 = l10 = l11 = 0.0
        if n_mean > 0.0 and in_gate:
            center[0], center[1] = linearize_direction(mean[0], platforms[s], H)
            det = innovation_cov(cov[0], H, std, S)
            density[s] = n_mean / (math.pi * gamma * math.sqrt(det))
            l00 = math.sqrt(max(S[0, 0], 1e-300))
            l10, l11 = S[0, 1] / l00, math.sqrt(det) / l00
            if not (0.0 < density[s] < math.inf and math.isfinite(center[0] + center[1] + l00 + l10 + l11)):
                density[s], count = CLEAN_DENSITY, 0  # a diverged track searches nowhere
        elif n_mean > 0.0:
            density[s] = n_mean / (4.0 * window * window)
        for i in range(count):
            u, v = false_points[k, s, i, 0], false_points[k, s, i, 1]
            if in_gate:
                radius = math.sqrt(gamma * u)
                a, b = radius * math.cos(2.0 * math.pi * v), radius * math.sin(2.0 * math.pi * v)
                _put(angles[s, n], center[0] + l00 * a, center[1] + l10 * a + l11 * b)
            else:
                _put(angles[s, n], h[0] + window * (2.0 * u - 1.0), h[1] + window * (2.0 * v - 1.0))
            n += 1
        valid[s, :n] = True
        if origin[s, 0] == 0:  # false returns are alike: the target's alone must not betray itself by its slot
            j = min(int(order[k, s] * n), n - 1)
            for c in range(2):
                angles[s, 0, c], angles[s, j, c] = angles[s, j, c], angles[s, 0, c]
            origin[s, 0], origin[s, j] = origin[s, j], origin[s, 0]


class AngleSensors:
    """All platforms' sensors of azimuth and elevation.

    Args:
        tracker: supplies the predicted track about which gates lie.
        angle_std: [2] rad, of azimuth and elevation.
        clutter: how false returns are placed.
        slots: return slots of one platform's scan.
    """

    def __init__(self, tracker: Any, angle_std: Any, clutter: Clutter, slots: int):
        self._tracker = tracker
        self._std = np.asarray(angle_std, dtype=float)
        self._in_gate, self._told = clutter.shape == "gate", clutter.told
        self._clutter = np.array([clutter.mean, clutter.gate, clutter.window])
        self._like = np.empty(slots)

    def acquire(self, tape: AngleTape) -> tuple[AngleTape, AngleSighting]:
        """The first scan, in which every platform sees the target and nothing else; there is no prediction yet."""
        e, targets = len(tape.platforms), tape.targets.shape[2]
        nothing = Gaussian(np.zeros((e, targets, 6)), np.zeros((e, targets, 6, 6)))
        return tape, self._sense(tape, np.zeros(e, dtype=np.int64), tape.platforms, nothing)

    def sense(self, tape: AngleTape, step, platforms, predicted: Any) -> AngleSighting:
        """The scan of an instant: steps [e], platforms [e, s, 6], the tracker's predicted state."""
        return self._sense(tape, step, platforms, self._tracker.estimate(predicted))

    def acquired(self, sighting: AngleSighting, state: Any) -> AngleReports:
        """What the first scan brought: a track from every platform's return."""
        e, platforms, _ = sighting.scan.valid.shape
        one = np.ones((e, 1, platforms), dtype=np.int64)
        return self._reports(sighting, np.zeros_like(one), one, np.zeros((e, 1, platforms)), np.zeros_like(one))

    def report(self, sighting: AngleSighting, update: AngleUpdate) -> AngleReports:
        """What a scan brought, by the tracker's own account."""
        return self._reports(sighting, update.assignment, update.validated, update.missed, update.dropped)

    def info(self, reports: AngleReports) -> dict[str, Any]:
        """Returns that the tracker had no room for."""
        return {"dropped_returns": reports.dropped}

    def _sense(self, tape: AngleTape, step, platforms, predicted: Gaussian) -> AngleSighting:
        angles, valid, origin, density, truth = _sense(
            tape.targets, tape.noise, tape.available, tape.detected, tape.false_count, tape.false_points, tape.order,
            step, platforms, predicted.mean, predicted.cov, self._std, self._in_gate, self._clutter, self._like,
        )  # fmt: skip
        available = tape.available[np.arange(len(step)), step]
        shape = (*available.shape, 2)
        scan = AngleScan(
            angles, valid, np.ascontiguousarray(platforms[..., :3]), np.broadcast_to(self._std, shape),
            np.broadcast_to(available[..., None], shape), density if self._told else np.zeros_like(density),
        )  # fmt: skip
        return AngleSighting(scan, truth, origin, predicted)

    def _reports(self, sighting: AngleSighting, slots, validated, missed, dropped) -> AngleReports:
        return AngleReports(
            slots >= 0, validated[:, 0], missed, sighting.scan.available, np.add.reduce(dropped, axis=-1), slots,
            sighting.scan, sighting.predicted,
        )  # fmt: skip
