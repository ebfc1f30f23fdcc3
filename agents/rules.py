"""Simple rules a sensible crew would follow: what a learned policy must beat, not only the paper's schedule."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from agents.steering import level_flight
from passive_env.belief import Belief
from passive_env.catalogue.maneuvering import OPENING_DEG
from passive_env.steering import course, line_of_sight, outward, shorter_sides, towards
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
        aim = self._aim(belief) if self._follow else self._course
        return towards(aim, belief.platforms, self._step)

    def _aim(self, belief: Belief) -> np.ndarray:
        """Courses [e, 2] rad."""
        off = np.where(outward(belief.platforms, belief.mean) > 0.0, self._left, -self._right)
        return middle_sight(belief)[:, None] + off


class Split:
    """Both platforms turn by the same angle at once, apart, and fly straight on.

    To which side, is such that their distance across the line of sight grows: ahead of a target in front the left one
    goes left, ahead of one behind it goes right.

    Args:
        scenario: supplies step length and turn rate limit.
        angle_deg: of the turns.
    Source: the specification of Wang, Wang and Yang (2004), section 9, "each turns 45° away from the other at once".
    """

    def __init__(self, scenario: Any, angle_deg: float):
        self._step = math.radians(scenario.max_turn_rate_deg_s) * scenario.step_s
        self._angle = math.radians(angle_deg)
        self._course = np.empty((0, 2))

    def reset(self, belief: Belief) -> None:
        """Choose both courses from the first belief."""
        before = course(belief.platforms)
        ahead = np.where(np.cos(before - middle_sight(belief)[:, None]) >= 0.0, 1.0, -1.0)
        self._course = before + outward(belief.platforms, belief.mean) * ahead * self._angle

    def act(self, belief: Belief, observation: np.ndarray) -> np.ndarray:
        """Turn towards the course at the limit, then hold it."""
        return level_flight(towards(self._course, belief.platforms, self._step), belief)


class HoldOffSight:
    """Each platform holds an angle off its own line of sight to the tracks, the two of them on opposite sides.

    The platform that is left of the other, looking along the line of sight from their midpoint, flies on the left.

    Args:
        scenario: supplies step, number of steps and turn rate limit.
        angle_deg: off the line of sight, 0 to 180.
        then_deg: the angle after `scans` steps; None keeps the first one.
        scans: steps flown at the first angle.
        exchange: look again at every step which platform is the left one; else as it was at first. Platforms that
            turn too slowly to part before they have passed each other do better to change sides.
    Raises:
        ValueError: an angle outside its range.
    """

    def __init__(
        self, scenario: Any, angle_deg: float, then_deg: float | None = None, scans: int = 0, exchange: bool = False
    ):
        then_deg = angle_deg if then_deg is None else then_deg
        for name, angle in (("angle_deg", angle_deg), ("then_deg", then_deg)):
            if not 0.0 <= angle <= 180.0:
                raise ValueError(f"{name} = {angle!r}: must lie in [0, 180]")
        self._angles = math.radians(angle_deg), math.radians(then_deg)
        self._steps, self._scans, self._exchange = scenario.steps, scans, exchange
        self._step = math.radians(scenario.max_turn_rate_deg_s) * scenario.step_s
        self._sides = np.empty((0, 2))

    def reset(self, belief: Belief) -> None:
        """Choose the sides."""
        self._sides = outward(belief.platforms, belief.mean)

    def act(self, belief: Belief, observation: np.ndarray) -> np.ndarray:
        """Turn towards the angle of the moment off the line of sight of the moment."""
        if self._exchange:
            self._sides = outward(belief.platforms, belief.mean)
        early = self._steps - belief.steps_left < self._scans
        angle = np.where(early, *self._angles)[:, None]
        headings = line_of_sight(belief.platforms, belief.mean) + self._sides * angle
        return level_flight(towards(headings, belief.platforms, self._step), belief)


class OpenBaseline:
    """Stations go off their lines of sight to both sides at full speed, and bend forward as the sights cross.

    Looking along the mean line of sight the left half of them goes left, the right half right, a middle one to the side
    it heads for. The angle falls from `wide_deg` where lines of sight are parallel to `narrow_deg` where any two of
    them cross at `crossing_deg` or more.

    Args:
        scenario: supplies step, number of steps and turn rate limit.
        wide_deg: off the line of sight, 0 to 180.
        narrow_deg: the same, never bent forward if it equals `wide_deg`; None for that.
        crossing_deg: above 0, at most 180.
        within_deg: a station whose course is farther from where it should head than this turns at its lowest speed, on
            the spot if that is 0; 180 never waits.
        cross: all stations go to the other side, crossing each other's way, where that saves the average one more time
            to turn than this many times the time to fly the first baseline's length; infinite never does.
        halt_every: all stations halt on every so-manieth step, to measure; None for never.
    Raises:
        ValueError: an angle or a number of steps outside its range.
    """

    def __init__(
        self, scenario: Any, wide_deg: float, narrow_deg: float | None = None, crossing_deg: float = 90.0,
        within_deg: float = 90.0, cross: float = math.inf, halt_every: int | None = None,
    ):  # fmt: skip
        narrow_deg = wide_deg if narrow_deg is None else narrow_deg
        for name, angle in (("wide_deg", wide_deg), ("narrow_deg", narrow_deg), ("within_deg", within_deg)):
            if not 0.0 <= angle <= 180.0:
                raise ValueError(f"{name} = {angle!r}: must lie in [0, 180]")
        if not 0.0 < crossing_deg <= 180.0:
            raise ValueError(f"crossing_deg = {crossing_deg!r}: must lie in (0, 180]")
        if not cross >= 0.0:
            raise ValueError(f"cross = {cross!r}: must be at least 0")
        if halt_every is not None and halt_every < 1:
            raise ValueError(f"halt_every = {halt_every!r}: must be at least 1, or None")
        angles = np.radians([wide_deg, narrow_deg, crossing_deg, within_deg])
        self._wide, self._narrow, self._crossing, self._within = angles
        self._cross, self._halt_every, self._steps = cross, halt_every, scenario.steps
        self._turn_per_step = math.radians(scenario.max_turn_rate_deg_s) * scenario.step_s
        self._way_per_step = scenario.top_speed_m_s * scenario.step_s
        self._crossed = self._sides = np.empty((0, 1))

    def reset(self, belief: Belief) -> None:
        """Decide who crosses."""
        self._sides = shorter_sides(
            belief.platforms, belief.mean, angle=self._wide, worth=self._cross, turn_per_step=self._turn_per_step,
            way_per_step=self._way_per_step,
        )  # fmt: skip
        self._crossed = self._sides[:, :1] != outward(belief.platforms, belief.mean)[:, :1]  # all of them, or none

    def act(self, belief: Belief, observation: np.ndarray) -> np.ndarray:
        """Turn towards the angle of the moment at the limit; full speed until the stations stop."""
        sight = line_of_sight(belief.platforms, belief.mean)
        bent = np.minimum(_widest_crossing(sight) / self._crossing, 1.0)
        angle = self._wide + (self._narrow - self._wide) * bent
        sides = np.where(self._crossed, self._sides, outward(belief.platforms, belief.mean))
        headings = sight + sides * angle[:, None]
        near = np.abs(wrap(headings - course(belief.platforms))) <= self._within
        driving = near & ~self._halts(belief)[:, None]
        turns = towards(headings, belief.platforms, self._turn_per_step)
        return np.concatenate([turns, np.where(driving, 1.0, -1.0)], axis=-1)

    def _halts(self, belief: Belief) -> np.ndarray:
        """[e] whether this is a step on which all halt."""
        number = self._steps - belief.steps_left + 1
        return np.zeros(len(number), dtype=bool) if self._halt_every is None else number % self._halt_every == 0


def _widest_crossing(sight: np.ndarray) -> np.ndarray:
    """The largest angle [e] rad between any two of the directions [e, s] rad."""
    return np.abs(wrap(sight[:, :, None] - sight[:, None])).max(axis=(1, 2))


def middle_sight(belief: Belief) -> np.ndarray:
    """Direction [e] rad from the platforms' midpoint to the middle of the tracks."""
    to_tracks = belief.mean[..., :2].mean(axis=1) - belief.platforms[..., :2].mean(axis=1)
    return np.arctan2(to_tracks[:, 1], to_tracks[:, 0])


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
        off = wrap(course(belief.platforms) - line_of_sight(belief.platforms, belief.mean))
        return np.where(off >= 0.0, 1.0, -1.0)


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
    "recorded flights": ((50.0, 50.0), (40.0, 50.0)),
}
"""Leg [s] and angle [deg] of the zigzags best in mean final and in mean time-averaged range error: `tune_zigzag` on
seeds 500,000 and up, which no evaluation uses, 512 to 2,048 episodes per cell, legs 15–150 s, angles 15–80° (recorded
flights: those of training, adaptive tracker, legs 30–110 s, angles 30–70°)."""


def _best_zigzag(scenario: Any, average: bool) -> Zigzag:
    cases = {
        "several targets": scenario.targets > 1,
        "recorded flights": scenario.course == "flights",
        "maneuvering": scenario.maneuvering,
        "one target": True,
    }
    case = next(name for name, holds in cases.items() if holds)
    return Zigzag(scenario, *BEST_ZIGZAGS[case][int(average)])


ONE_PLATFORM = {
    "perpendicular": lambda scenario, seed: Zigzag(scenario, math.inf, 90.0),
    "lead_lag": lambda scenario, seed: LeadLag(scenario, 60.0, 60.0),
    "rule": lambda scenario, seed: _best_zigzag(scenario, average=False),
    "rule_average": lambda scenario, seed: _best_zigzag(scenario, average=True),
}
"""Makers (scenario, seed) for one platform. `rule` and `rule_average` are the zigzags best in the final and in the
time-averaged error."""

BEST_HOLD_OFF = {"clean": (70.0, 60.0, 15, False), "slow": (90.0, 75.0, 20, True), "clutter": (70.0, 60.0, 15, True)}
"""Angles, scans between them and whether sides are exchanged: the best compromise between mean final and mean
time-averaged position error on seeds 500,000 and up, which no evaluation uses, 2,048 episodes per cell. Grid: one angle
from 45° to 105° (slow: 120°) in steps of 5°; two angles, first 60–100°, then 30–75°, after 10, 15, 20 or 25 scans. No
cell is better by more than 0.6 % in either error. In clutter, 4,096 episodes: one angle from 50° to 75° and the pairs
60–45°, 70–60°, 75–45°, 90–60°; there a few diverged tracks decide the means, the share of lost ones counts too, and no
cell is better by more than 0.7 % (average), 1.6 % (final) or 0.2 points (lost)."""

SLOW_DEG_S = 2.5
"""Turn rates below this are slow: more than half a minute for a quarter turn."""


def _best_hold_off(scenario: Any) -> HoldOffSight:
    cluttered = scenario.clutter_mean > 0.0 or scenario.clutter_density_per_deg2 > 0.0
    slow = scenario.max_turn_rate_deg_s < SLOW_DEG_S
    return HoldOffSight(scenario, *BEST_HOLD_OFF["slow" if slow else "clutter" if cluttered else "clean"])


IN_SPACE = {
    "split": lambda scenario, seed: Split(scenario, 45.0),
    "rule": lambda scenario, seed: _best_hold_off(scenario),
    "rule_60": lambda scenario, seed: HoldOffSight(scenario, 60.0),
}
"""Makers (scenario, seed) for two platforms in space. `rule` is the strongest found, `rule_60` holds the one angle that
is best in the final error where platforms turn fast."""

OPENINGS = {
    "open": (75.0, 75.0, 90.0, 180.0),
    "rule_bend": (OPENING_DEG, 20.0, 70.0, 90.0),
}
"""Angles of `OpenBaseline`, in its order: outwards at full speed; turning on the spot and bending forward.

Best of grids in the mean position error while targets turn, the time-averaged one deciding where that differs by less
than its luck, on seeds 500,000 and up, which no evaluation uses, 1,536 episodes per cell: one angle from 70° to 90°;
first angle 75–90°, last 0–30°, at 70° or 80°; for the scenario's `crossing_worth` crossing that saves 150°, 180° or
210° in sum. Within a grid no cell is better by more than 0.6 % in either error."""


def _opening(name: str, crossing: bool = False) -> Any:
    """A maker (scenario, seed); stations that measure only when slow halt on every other step."""

    def make(scenario: Any, seed: int) -> OpenBaseline:
        worth = scenario.crossing_worth if crossing else math.inf
        return OpenBaseline(scenario, *OPENINGS[name], worth, halt_every=2 if scenario.carrier == "ground" else None)

    return make


OPEN_BASELINE = {
    "open": _opening("open"),
    "rule_bend": _opening("rule_bend"),
    "rule": _opening("rule_bend", crossing=True),
}
"""Makers (scenario, seed) for stations whose bearings become position fixes; `rule` is the strongest found."""
