"""Simple rules a sensible crew would follow: what a learned policy must beat, not only the paper's schedule."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from passive_env.belief import Belief
from trackers.angles import wrap


class TurnApart:
    """Turn apart at once until the stations fly off the mean line of sight on opposite sides.

    The station that is left of the other, looking along the mean line of sight, goes left. The line of sight runs
    from the stations' midpoint to the middle of the tracks; it is taken once, from the first belief ("then
    straight"), or followed as the tracks move.

    Args:
        scenario: supplies step length and turn rate limit.
        left_deg, right_deg: courses, measured from the mean line of sight to the left and to the right.
        follow: aim anew at every step.
    Source: the specification of Xiu et al. (2002), section 11, "turn apart at once by +60°/−80°, then straight";
        following the line of sight is ours.
    """

    def __init__(self, scenario: Any, left_deg: float, right_deg: float, follow: bool = False):
        self._step = math.radians(scenario.max_turn_rate_deg_s) * scenario.step_s
        self._left, self._right = math.radians(left_deg), math.radians(right_deg)
        self._follow = follow
        self._course = np.empty((0, 2))

    def reset(self, belief: Belief) -> None:
        """Choose both stations' courses from the first belief."""
        self._course = self._aim(belief)

    def act(self, belief: Belief, observation: np.ndarray) -> np.ndarray:
        """Turn towards the course at the limit, then hold it."""
        course = self._aim(belief) if self._follow else self._course
        heading = np.arctan2(belief.platforms[..., 3], belief.platforms[..., 2])
        return np.clip(wrap(course - heading) / max(self._step, 1e-12), -1.0, 1.0)

    def _aim(self, belief: Belief) -> np.ndarray:
        """Courses [e, 2] rad."""
        p = belief.platforms[..., :2]
        to_tracks = belief.mean[..., :2].mean(axis=1) - p.mean(axis=1)
        sight = np.arctan2(to_tracks[:, 1], to_tracks[:, 0])
        apart = p[:, 0] - p[:, 1]
        first_is_left = np.cos(sight) * apart[:, 1] - np.sin(sight) * apart[:, 0] > 0.0
        turns = np.where(first_is_left[:, None], (self._left, -self._right), (-self._right, self._left))
        return sight[:, None] + turns


RULES = {
    "rule": lambda scenario, seed: TurnApart(scenario, 60.0, 80.0),
    "rule_tuned": lambda scenario, seed: TurnApart(scenario, 65.0, 65.0, follow=True),
    "rule_perpendicular": lambda scenario, seed: TurnApart(scenario, 90.0, 90.0),
}
"""Makers (scenario, seed). `rule` is the specification's variant, the better one than perpendicular in the mean final
range error; `rule_tuned` is the strongest found: it follows the line of sight, its angle being the best of a grid from
45° to 90° on seeds that no evaluation uses."""
