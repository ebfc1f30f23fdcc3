"""The tape: all randomness that does not depend on actions, drawn when an episode begins.

`step` is then a deterministic function of state, action and tape row. Sub-environment i of a batch draws from its own
generator, two calls in a fixed order, so its episode is the same bit for bit whatever the width of the batch, and
every policy can be evaluated on the same tapes.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from scipy.stats import poisson


class Tape(NamedTuple):
    """Randomness of whole episodes; e environments, k + 1 instants, s stations, m targets, b return slots.

    Attributes:
        platforms: [e, s, 4] start states of the platforms.
        targets: [e, k + 1, m, 4] true target states.
        noise: [e, k + 1, s, m] standard normal bearing noise.
        detected: [e, k + 1, s, m] bool.
        false_bearings: [e, k + 1, s, b − m] rad, uniform; the first false_count of them appear.
        false_count: [e, k + 1, s] int.
        order: [e, k + 1, s, b] uniform, decides the order of the returns.
        discs: [e, d, 3] no-go discs: centre x, y and radius [m]; d is 0 where there are none.
    """

    platforms: Any
    targets: Any
    noise: Any
    detected: Any
    false_bearings: Any
    false_count: Any
    order: Any
    discs: Any


class ReturnModel(NamedTuple):
    """How many returns a scan has: instants, stations, targets, detection probability, mean false bearings."""

    instants: int
    stations: int
    targets: int
    detection_probability: float
    false_bearings_mean: float

    @property
    def false_slots(self) -> int:
        """Slots kept for false bearings: the Poisson count is cut at its 1 − 1e-9 quantile (at least one slot)."""
        return max(1, int(poisson.ppf(1.0 - 1e-9, self.false_bearings_mean))) if self.false_bearings_mean else 1

    @property
    def slots(self) -> int:
        """Return slots of one station's scan."""
        return self.targets + (self.false_slots if self.false_bearings_mean else 0)


def draw(generators: Sequence[np.random.Generator], normals: int, uniforms: int) -> tuple[np.ndarray, np.ndarray]:
    """Fill [e, normals] standard normal and [e, uniforms] uniform numbers, row i from generator i."""
    z, u = np.empty((len(generators), normals)), np.empty((len(generators), uniforms))
    for i, generator in enumerate(generators):
        generator.standard_normal(out=z[i])
        generator.random(out=u[i])
    return z, u


def uniforms_needed(model: ReturnModel) -> int:
    """Uniform numbers that `returns` consumes per episode."""
    scans = model.instants * model.stations
    count = scans * model.slots
    if model.detection_probability < 1.0:
        count += scans * model.targets
    if model.false_bearings_mean > 0.0:
        count += scans * (1 + model.false_slots)
    return count


def returns(model: ReturnModel, uniforms: np.ndarray) -> dict[str, np.ndarray]:
    """Detections, false bearings and order of returns from [e, uniforms_needed] uniform numbers.

    The first scan is the acquisition: every target is seen by every station and nothing else is.
    """
    e = len(uniforms)
    shape = (e, model.instants, model.stations)
    take = Reader(uniforms)
    order = take((*shape, model.slots))
    detected = np.ones((*shape, model.targets), dtype=bool)
    if model.detection_probability < 1.0:
        detected = take((*shape, model.targets)) < model.detection_probability
        detected[:, 0] = True
    count = np.zeros(shape, dtype=np.int64)
    bearings = np.zeros((*shape, model.false_slots))
    if model.false_bearings_mean > 0.0:
        edges = poisson.cdf(np.arange(model.false_slots), model.false_bearings_mean)
        count = np.searchsorted(edges, take(shape), side="right")
        count[:, 0] = 0
        bearings = (2.0 * take((*shape, model.false_slots)) - 1.0) * np.pi
    return {"detected": detected, "false_bearings": bearings, "false_count": count, "order": order}


class Reader:
    """Hands out consecutive columns of an array of uniforms, reshaped."""

    def __init__(self, uniforms: np.ndarray):
        self._uniforms, self._at = uniforms, 0

    def __call__(self, shape: tuple[int, ...]) -> np.ndarray:
        """The next columns as an array of a shape whose first axis is the environment."""
        width = int(np.prod(shape[1:]))
        block = self._uniforms[:, self._at : self._at + width]
        self._at += width
        return np.ascontiguousarray(block).reshape(shape)
