"""The tape of scenarios in space: randomness of azimuths, elevations, clutter and dropouts (see `passive_env.tape`).

Clutter is drawn as points of a unit disc or square and put into angles when a scan is taken, for where a tracker's
gate lies depends on what the platforms did.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from scipy.stats import poisson

from passive_env.tape import Reader

CUT = 1e-9
"""Probability beyond which a Poisson count is cut."""


class AngleTape(NamedTuple):
    """Randomness of whole episodes; e environments, k + 1 instants, s platforms, m targets, f slots for false returns.

    Attributes:
        platforms: [e, s, 6] start states of the platforms.
        targets: [e, k + 1, m, 6] true target states; m is 1.
        discs: [e, 0, 3] there are no no-go discs.
        noise: [e, k + 1, s, 2] standard normal noise of azimuth and elevation.
        share: [e, s] probability that a platform's sensor is available.
        available: [e, k + 1, s] bool.
        detected: [e, k + 1, s] bool, of the target by an available sensor.
        false_count: [e, k + 1, s] int.
        false_points: [e, k + 1, s, f, 2] uniform; the first false_count of them appear.
        order: [e, k + 1, s] uniform, decides the slot of the target's return.
    """

    platforms: Any
    targets: Any
    discs: Any
    noise: Any
    share: Any
    available: Any
    detected: Any
    false_count: Any
    false_points: Any
    order: Any


class AngleReturnModel(NamedTuple):
    """What a scan may hold: instants, platforms, detection probability, mean false returns, least and most dropouts.

    Attributes:
        share_min, share_max: [s] limits of the probability of availability, drawn once per episode.
    """

    instants: int
    platforms: int
    detection_probability: float
    false_mean: float
    share_min: Any
    share_max: Any

    @property
    def false_slots(self) -> int:
        """Slots kept for false returns: the Poisson count is cut at its 1 − 1e-9 quantile."""
        return int(poisson.ppf(1.0 - CUT, self.false_mean)) if self.false_mean else 0

    @property
    def uniforms(self) -> int:
        """Uniform numbers that `angle_returns` consumes per episode."""
        per_scan = 2 + (self.detection_probability < 1.0) + (self.false_mean > 0.0) * (1 + 2 * self.false_slots)
        return self.platforms + self.instants * self.platforms * per_scan


def angle_returns(model: AngleReturnModel, uniforms: np.ndarray) -> dict[str, np.ndarray]:
    """Availability, detections, clutter and order of returns from [e, model.uniforms] uniform numbers.

    The first scan is the acquisition: every sensor is available and sees the target and nothing else.
    """
    shape = (len(uniforms), model.instants, model.platforms)
    take = Reader(uniforms)
    low, high = np.asarray(model.share_min), np.asarray(model.share_max)
    share = low + (high - low) * take((len(uniforms), model.platforms))
    available = take(shape) < share[:, None]
    order = take(shape)
    detected = np.ones(shape, dtype=bool)
    if model.detection_probability < 1.0:
        detected = take(shape) < model.detection_probability
    count, points = np.zeros(shape, dtype=np.int64), np.zeros((*shape, model.false_slots, 2))
    if model.false_mean > 0.0:
        edges = poisson.cdf(np.arange(model.false_slots), model.false_mean)
        count = np.searchsorted(edges, take(shape), side="right")
        points = take((*shape, model.false_slots, 2))
    available[:, 0], detected[:, 0], count[:, 0] = True, True, 0
    return {
        "share": share, "available": available, "detected": detected, "false_count": count, "false_points": points,
        "order": order,
    }  # fmt: skip
