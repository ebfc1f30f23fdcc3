"""Simple rules a sensible crew would follow: what a learned policy must beat, not only the paper's schedule."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from passive_env.belief import Belief
from trackers.angles import circular_mean, wrap


class TurnApart:
    """Turn apart at once until the stations fly off the mean line of sight on opposite sides, then straight.

    The station that is left of the other, looking along the mean line of sight, goes left. The line of sight is taken
    once, from the first belief.

    Args:
        scenario: supplies step length and turn rate limit.
        left_deg, right_deg: final courses, measured from the mean line of sight to the left and to the right.
    Source: the specification of Xiu et al. (2002), section 11, "turn apart at once by +60°/−80°, then straight".
    """

    def __init__(self, scenario: Any, left_deg: float, right_deg: float):
        self._step = max(math.radians(scenario.max_turn_rate_deg_s) * scenario.step_s, 1e-12)
        self._left, self._right = math.radians(left_deg), math.radians(right_deg)
        self._course = np.empty((0, 2))

    def reset(self, belief: Belief) -> None:
        """Choose both stations' courses from the first belief."""
        p = belief.platforms[..., :2]
        to_tracks = belief.mean[..., :2] - p.mean(axis=1, keepdims=True)
        sight = circular_mean(np.arctan2(to_tracks[..., 1], to_tracks[..., 0]))
        apart = p[:, 0] - p[:, 1]
        first_is_left = np.cos(sight) * apart[:, 1] - np.sin(sight) * apart[:, 0] > 0.0
        turns = np.where(first_is_left[:, None], (self._left, -self._right), (-self._right, self._left))
        self._course = sight[:, None] + turns

    def act(self, belief: Belief, observation: np.ndarray) -> np.ndarray:
        """Turn towards the chosen course at the limit, then hold it."""
        heading = np.arctan2(belief.platforms[..., 3], belief.platforms[..., 2])
        return np.clip(wrap(self._course - heading) / self._step, -1.0, 1.0)


RULES = {
    "rule": lambda scenario, seed: TurnApart(scenario, 60.0, 80.0),
    "rule_tuned": lambda scenario, seed: TurnApart(scenario, 70.0, 70.0),
    "rule_perpendicular": lambda scenario, seed: TurnApart(scenario, 90.0, 90.0),
}
"""Makers (scenario, seed). `rule` is the specification's variant, the better one than perpendicular in the mean final
range error; `rule_tuned` is the best of a grid of angles from 45° to 90°, tuned on seeds that no evaluation uses."""
