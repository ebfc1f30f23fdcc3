"""Direction finders: tape row and geometry to unlabelled bearings."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from passive_env.belief import Received, Reports
from passive_env.tape import Tape
from trackers.angles import wrap_scalar
from trackers.compiled import kernel
from trackers.contract import Scan, Update


class Sighting(NamedTuple):
    """A scan, and what only the world knows about it.

    Attributes:
        scan: what the tracker gets.
        truth: [e, m, 4] true target states at this instant.
        origin: [e, s, b] target behind each return, −1 for a false bearing or an empty slot.
    """

    scan: Scan
    truth: Any
    origin: Any


@kernel(
    "(k,m,x),(k,s,m),(k,s,m),(k,s,f),(k,s),(k,s,b),(),(s,x),(),()->(s,b),(s,b),(s,b),(m,x)",
    "FFBFIFiFfbFBIF",
)
def _sense(targets, noise, detected, false_bearings, false_count, order, k, platforms, std, in_order,
           bearings, valid, origin, truth):  # fmt: skip
    truth[:] = targets[k]
    for s in range(bearings.shape[0]):
        valid[s, :] = False
        origin[s, :] = -1
        bearings[s, :] = 0.0
        n = 0
        for m in range(targets.shape[1]):
            if detected[k, s, m]:
                dx, dy = targets[k, m, 0] - platforms[s, 0], targets[k, m, 1] - platforms[s, 1]
                bearings[s, n] = wrap_scalar(math.atan2(dy, dx) + std * noise[k, s, m])
                origin[s, n] = m
                n += 1
        for i in range(false_count[k, s]):
            bearings[s, n] = false_bearings[k, s, i]
            n += 1
        valid[s, :n] = True
        for i in range(n - 1, 0, -1):  # Fisher–Yates, or a sort about the middle direction for the first scan
            j = min(int(order[k, s, i] * (i + 1)), i)
            if in_order:
                middle = math.atan2(np.sin(bearings[s, :n]).sum(), np.cos(bearings[s, :n]).sum())
                j = i
                for c in range(i):
                    if wrap_scalar(bearings[s, c] - middle) > wrap_scalar(bearings[s, j] - middle):
                        j = c
            bearings[s, i], bearings[s, j] = bearings[s, j], bearings[s, i]
            origin[s, i], origin[s, j] = origin[s, j], origin[s, i]


def sense(tape: Tape, step, platforms, bearing_std, in_order: bool = False) -> Sighting:
    """Bearings of all stations at an instant, in random order (or sorted counter-clockwise, for the acquisition).

    Args:
        tape: episodes' randomness.
        step: [e] instant, 0 … k.
        platforms: [e, s, 4] m, m/s.
        bearing_std: [] rad.
        in_order: sort the returns counter-clockwise about their mean direction instead of shuffling them.
    """
    bearings, valid, origin, truth = _sense(
        tape.targets, tape.noise, tape.detected, tape.false_bearings, tape.false_count, tape.order,
        step, platforms, bearing_std, in_order,
    )  # fmt: skip
    return Sighting(Scan(bearings, valid, platforms[..., :2], bearing_std), truth, origin)


class DirectionFinders:
    """All stations' direction finders: the sensors of scenarios with unlabelled bearings.

    Args:
        bearing_std: [] rad.
    """

    def __init__(self, bearing_std: float):
        self._std = bearing_std

    def acquire(self, tape: Tape) -> tuple[Tape, Sighting]:
        """The first scan, in which every station sees every target and nothing else.

        Tracks follow the order of the reference station's first bearings, counter-clockwise; targets are renumbered
        to match.
        """
        step = np.zeros(len(tape.platforms), dtype=np.int64)
        sighting = sense(tape, step, tape.platforms, self._std, in_order=True)
        targets = tape.targets.shape[2]
        tape = _renumber(tape, sighting.origin[:, -1, :targets])
        bearings, valid = sighting.scan.bearings[..., :targets], sighting.scan.valid[..., :targets]
        scan = sighting.scan._replace(bearings=bearings, valid=valid)
        return tape, sighting._replace(scan=scan, truth=tape.targets[:, 0])

    def sense(self, tape: Tape, step, platforms, predicted: Any) -> Sighting:
        """A later scan; nothing in it depends on the predicted tracks."""
        return sense(tape, step, platforms, self._std)

    def acquired(self, sighting: Sighting, state: Any) -> Reports:
        """What the first scan brought: all of it started tracks."""
        e, stations, targets = sighting.scan.valid.shape
        slots = [(0, 0), (0, 0), (0, sighting.origin.shape[-1] - targets)]  # as many as later scans have
        scan = sighting.scan._replace(
            bearings=np.pad(sighting.scan.bearings, slots), valid=np.pad(sighting.scan.valid, slots)
        )
        return _reports(np.ones((e, targets, stations), dtype=bool), scan)

    def report(self, sighting: Sighting, update: Update) -> Reports:
        """What a scan brought; a tracker that uses the reference only reports one column, the others are unassigned."""
        assigned = update.assignment >= 0
        stations = sighting.scan.valid.shape[1]
        if assigned.shape[-1] != stations:
            full = np.zeros((*assigned.shape[:-1], stations), dtype=bool)
            full[..., -1:] = assigned
            assigned = full
        return _reports(assigned, sighting.scan)

    def info(self, reports: Reports) -> dict[str, Any]:
        """Nothing more than every `info` shows."""
        return {}


def _reports(assigned: np.ndarray, scan: Scan) -> Reports:
    e, targets, _ = assigned.shape
    returns = np.add.reduce(scan.valid, axis=-1)
    return Reports(
        assigned, returns, missed=np.empty((e, targets, 0)), available=np.empty((e, 0, 2), dtype=bool),
        received=Received(scan.bearings[..., None], scan.valid),
    )  # fmt: skip


def _renumber(tape: Tape, order: np.ndarray) -> Tape:
    """Reorder each episode's targets; noise and detections move with them."""
    if (order == np.arange(order.shape[-1])).all():
        return tape
    rows = order[:, None, None, :]
    return tape._replace(
        targets=np.take_along_axis(tape.targets, order[:, None, :, None], axis=2),
        noise=np.take_along_axis(tape.noise, rows, axis=3),
        detected=np.take_along_axis(tape.detected, rows, axis=3),
    )


def _all_stations(assigned: np.ndarray, stations: int) -> np.ndarray:
    """[e, m, stations]: a tracker that uses the reference only reports one column; the others stand unassigned."""
    if assigned.shape[-1] == stations:
        return assigned
    full = np.zeros((*assigned.shape[:-1], stations), dtype=bool)
    full[..., -1:] = assigned
    return full
