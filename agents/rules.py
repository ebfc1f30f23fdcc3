"""Simple rules a sensible crew would follow: what a learned policy must beat, not only the paper's schedule."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from agents.prediction import line_of_sight, towards
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
        return towards(course, belief.platforms, self._step)

    def _aim(self, belief: Belief) -> np.ndarray:
        """Courses [e, 2] rad."""
        p = belief.platforms[..., :2]
        to_tracks = belief.mean[..., :2].mean(axis=1) - p.mean(axis=1)
        sight = np.arctan2(to_tracks[:, 1], to_tracks[:, 0])
        apart = p[:, 0] - p[:, 1]
        first_is_left = np.cos(sight) * apart[:, 1] - np.sin(sight) * apart[:, 0] > 0.0
        turns = np.where(first_is_left[:, None], (self._left, -self._right), (-self._right, self._left))
        return sight[:, None] + turns


class Zigzag:
    """Fly legs at an angle off the line of sight, to one side and the other in turn, following the line of sight.

    The first leg lies on the side nearer to the first heading; the line of sight runs from a platform to the middle of
    the tracks.

    Args:
        scenario: supplies step, number of steps and turn rate limit.
        leg_s: duration of a leg [s], the turn into it included; infinite for a single leg.
        angle_deg: off the line of sight, 0 to 180.
    Raises:
        ValueError: no positive leg time, or an angle outside its range.
    """

    def __init__(self, scenario: Any, leg_s: float, angle_deg: float):
        if not leg_s > 0.0:
            raise ValueError(f"leg_s = {leg_s!r}: must be a positive time")
        if not 0.0 <= angle_deg <= 180.0:
            raise ValueError(f"angle_deg = {angle_deg!r}: must lie in [0, 180]")
        self._steps, self._step_s = scenario.steps, scenario.step_s
        self._turn_per_step = math.radians(scenario.max_turn_rate_deg_s) * scenario.step_s
        self._leg_s, self._angle = leg_s, math.radians(angle_deg)
        self._side = np.empty((0, 1))

    def reset(self, belief: Belief) -> None:
        """Choose the first leg's side."""
        self._side = self._nearer_side(belief)

    def act(self, belief: Belief, observation: np.ndarray) -> np.ndarray:
        """Turn towards the leg's course at the limit, then hold it."""
        sight = line_of_sight(belief.platforms, belief.mean)
        return towards(sight + self._side_now(belief) * self._angle, belief.platforms, self._turn_per_step)

    def _leg(self, belief: Belief) -> np.ndarray:
        """Number [e, 1] of the present leg, from 0."""
        elapsed = (self._steps - belief.steps_left) * self._step_s
        return np.floor(elapsed / self._leg_s + 1e-9)[:, None].astype(np.int64)

    def _side_now(self, belief: Belief) -> np.ndarray:
        """Side [e, s] of the present leg: +1 left of the line of sight, −1 right."""
        return np.where(self._leg(belief) % 2 == 0, self._side, -self._side)

    def _nearer_side(self, belief: Belief) -> np.ndarray:
        heading = np.arctan2(belief.platforms[..., 3], belief.platforms[..., 2])
        return np.where(wrap(heading - line_of_sight(belief.platforms, belief.mean)) >= 0.0, 1.0, -1.0)


class LeadLag(Zigzag):
    """The legs of classical target motion analysis: lag the target, then lead it, and so on.

    A lag leg has its speed across the line of sight against the target's, a lead leg with it. Which side that is, is
    read from the tracks whenever a lag leg begins; the first one, before anything is known of the target's course, lies
    on the side nearer to the first heading.

    Args:
        scenario, leg_s, angle_deg: as of `Zigzag`.
    Source: lead and lag line of sight after J. S. Davis, "Ekelund ranging", and Lindgren and Gong, "Position and
        velocity estimation via bearing observations", IEEE Trans. Aerospace and Electronic Systems 14(4), 1978.
    """

    def _side_now(self, belief: Belief) -> np.ndarray:
        leg = self._leg(belief)
        begins = (leg % 2 == 0) & (leg > 0) & (leg > self._leg(belief._replace(steps_left=belief.steps_left + 1)))
        self._side = np.where(begins, -_crossing_side(belief), self._side)
        return super()._side_now(belief)


def _crossing_side(belief: Belief) -> np.ndarray:
    """Side [e, s] to which the middle of the tracks moves across the line of sight: +1 left, −1 right."""
    sight = line_of_sight(belief.platforms, belief.mean)
    velocity = belief.mean[:, None, :, 2:].mean(axis=2)
    across = np.cos(sight) * velocity[..., 1] - np.sin(sight) * velocity[..., 0]
    return np.where(across >= 0.0, 1.0, -1.0)


TURN_APART = {
    "rule": lambda scenario, seed: TurnApart(scenario, 60.0, 80.0),
    "rule_tuned": lambda scenario, seed: TurnApart(scenario, 65.0, 65.0, follow=True),
    "rule_perpendicular": lambda scenario, seed: TurnApart(scenario, 90.0, 90.0),
}
"""Makers (scenario, seed) for two stations. `rule` is the specification's variant, the better one than perpendicular in
the mean final range error; `rule_tuned` is the strongest found: it follows the line of sight, its angle being the best
of a grid from 45° to 90° on seeds that no evaluation uses."""

BEST_ZIGZAGS = {
    "one target": ((110.0, 40.0), (40.0, 40.0)),
    "maneuvering": ((30.0, 35.0), (35.0, 45.0)),
    "several targets": ((110.0, 70.0), (50.0, 55.0)),
}
"""Leg [s] and angle [deg] of the zigzags best in mean final and in mean time-averaged range error: `tune_zigzag` on
seeds 500,000 and up, which no evaluation uses, 512 to 2,048 episodes per cell, legs 15–150 s, angles 15–80°."""


def _best_zigzag(scenario: Any, average: bool) -> Zigzag:
    case = "several targets" if scenario.targets > 1 else "maneuvering" if scenario.maneuvering else "one target"
    return Zigzag(scenario, *BEST_ZIGZAGS[case][int(average)])


ONE_PLATFORM = {
    "perpendicular": lambda scenario, seed: Zigzag(scenario, math.inf, 90.0),
    "lead_lag": lambda scenario, seed: LeadLag(scenario, 60.0, 60.0),
    "rule": lambda scenario, seed: _best_zigzag(scenario, average=False),
    "rule_average": lambda scenario, seed: _best_zigzag(scenario, average=True),
}
"""Makers (scenario, seed) for one platform. `rule` and `rule_average` are the zigzags best in the final and in the
time-averaged error."""
