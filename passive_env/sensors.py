"""Direction finders: tape row and geometry to unlabelled bearings."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from passive_env.tape import Tape
from trackers.angles import wrap_scalar
from trackers.compiled import kernel
from trackers.contract import Scan


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
