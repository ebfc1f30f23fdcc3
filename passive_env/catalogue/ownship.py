"""One moving direction finder: range is observable only through the platform's own maneuvers.

The classical case of target motion analysis: with bearings from one platform that flies straight, courses of any range
fit the measurements of a target that flies straight too; a turn tells them apart. The tracker is the
range-parameterised bank of `trackers.rp_ekf` over the whole range interval.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from passive_env.catalogue.bearings import BearingScenario, Courses, instants_first
from passive_env.kinematics import weave
from passive_env.scenario import flag, integer, number
from trackers.compiled import kernel

TARGET_UNIFORMS = 5
"""Uniform numbers of a target: range, bearing, course, speed, recorded flight."""
DISC_UNIFORMS = 2
"""Of a no-go disc: distance along and offset across a line of sight."""
TURN_UNIFORMS = 4
"""Of a turn: straight time before it, duration, rate, sense."""

NEAREST_DISC = 1.5
"""Least distance of a disc's centre from the platform's start, in radii: at the default speed, turn rate and radius a
platform that heads straight at it can still turn away. The largest is the nearest start of a target, whatever the
target's own range: where the discs are must not tell how far the target is."""
DISC_OFFSET = 1.5
"""Largest distance of a disc's centre from the line of sight it was drawn on, in radii."""


@dataclass(frozen=True, kw_only=True)
class Ownship(BearingScenario):
    """One platform steers by turn rate; its tracker ranges up to three targets from unlabelled bearings.

    The platform starts at the origin on a random heading, the targets at any bearing, at ranges within the limits, on
    any course. The first random numbers of an episode make platform and targets, so keywords that add turns, discs,
    misses or false bearings leave the starts as they are.

    Observation: `TrackObservation`; with no-go discs also where they are, which the belief holds in `discs`.
    Cost: ``reward_standoff`` and ``reward_nogo`` times the relative depth of intrusion into the rings about the targets
    and into the discs, which `info` shows unweighted.
    Bound: starts from what the tracker knows before any bearing, a range anywhere in its interval (as a Gaussian of the
    same variance) and 200 m/s per axis. Targets are drawn from less than that, so early errors lie below the bound.
    """

    stations: ClassVar[int] = 1
    ordered: ClassVar[tuple[tuple[str, str], ...]] = (
        *BearingScenario.ordered,
        ("target_turn_min_deg_s", "target_turn_max_deg_s"),
        ("target_turn_min_s", "target_turn_max_s"),
        ("target_straight_min_s", "target_straight_max_s"),
    )

    targets: int = integer(1, 1, 3, "number of targets")
    steps: int = integer(60, 1, 10_000, "decisions per episode")
    step_s: float = number(5.0, 0.1, 60.0, "time between scans")
    max_turn_rate_deg_s: float = number(3.0, 0.0, 45.0, "turn rate at action ±1")
    range_floor_m: float = number(15e3, 100.0, 1e5, "nearest range the tracker looks for a target at first")
    range_cap_m: float = number(120e3, 1e3, 1e7, "farthest")
    process_noise_m_s: float = number(
        5.0, 0.0, 500.0, "the filter's q, velocity increment per step: 1 m/s² at the default step"
    )
    merge_below: float = number(1.0, 0.0, 100.0, "squared Mahalanobis distance at which a bank's hypotheses merge")
    second_order: bool = flag(True, "whether a bearing's curvature adds to a bank's innovation variance")
    range_min_m: float = number(25e3, 1e3, 1e6, "nearest drawn start of a target")
    range_max_m: float = number(90e3, 1e3, 1e6, "farthest")
    target_speed_min_m_s: float = number(100.0, 1.0, 2000.0, "slowest drawn target")
    maneuvering: bool = flag(False, "whether drawn targets turn now and then")
    target_turn_min_deg_s: float = number(1.0, 0.0, 45.0, "slowest turn of a maneuvering target")
    target_turn_max_deg_s: float = number(3.0, 0.0, 45.0, "fastest")
    target_turn_min_s: float = number(10.0, 5.0, 1e5, "shortest turn")
    target_turn_max_s: float = number(30.0, 5.0, 1e5, "longest")
    target_straight_min_s: float = number(30.0, 5.0, 1e5, "shortest straight leg between turns")
    target_straight_max_s: float = number(90.0, 5.0, 1e5, "longest")
    nogo_discs: int = integer(0, 0, 4, "number of no-go discs")
    nogo_radius_m: float = number(8e3, 100.0, 1e5, "radius of a no-go disc")

    @property
    def discs(self) -> int:
        """Number of no-go discs."""
        return self.nogo_discs

    @property
    def bound_range_std_m(self) -> float:
        """Of a range spread evenly over the interval in which the tracker looks for a target."""
        return (self.range_cap_m - self.range_floor_m) / math.sqrt(12.0)

    @property
    def course_uniforms(self) -> int:
        """The platform's heading, then targets, discs and turns."""
        return 1 + self.targets * (TARGET_UNIFORMS + TURN_UNIFORMS * self._turns) + DISC_UNIFORMS * self.discs

    @property
    def _turns(self) -> int:
        """Turns drawn per target: enough for an episode of shortest legs and turns."""
        if not self.maneuvering or self.course != "random":
            return 0
        return math.ceil(self.steps * self.step_s / (self.target_turn_min_s + self.target_straight_min_s))

    def draw_courses(self, u: np.ndarray) -> Courses:
        """Platform, targets and discs of episodes from uniforms [e, course_uniforms]."""
        e, m, d = len(u), self.targets, self.discs
        edges = np.cumsum([1, m * TARGET_UNIFORMS, d * DISC_UNIFORMS])
        heading, target_u, disc_u, turn_u = (np.ascontiguousarray(part) for part in np.split(u, edges, axis=1))
        target_u = target_u.reshape(e, m, TARGET_UNIFORMS)
        limits = np.array(
            [
                self.station_speed_m_s, self.range_min_m, self.range_max_m, self.target_speed_min_m_s,
                self.target_speed_max_m_s, self.nogo_radius_m,
            ]
        )  # fmt: skip
        platform, start, discs = _random_starts(
            heading[:, 0], target_u, disc_u.reshape(e, d, DISC_UNIFORMS), limits, np.empty(4), np.empty(3)
        )
        if self.course == "flights":
            paths = self.fly_flights(start, target_u[..., 4])
        else:
            paths = self._drawn_paths(start, turn_u)
        return Courses(platform[:, None], paths, discs)

    def _drawn_paths(self, start: np.ndarray, turn_u: np.ndarray) -> np.ndarray:
        """Paths [e, k + 1, m, 4] from starts [e, m, 4]: straight, or with the turns of uniforms."""
        axis = np.empty(self.steps + 1)
        if not self._turns:
            return instants_first(weave(start, np.zeros(1), np.zeros((1, 2)), self.step_s, axis))
        limits = np.array(
            [
                self.target_straight_min_s, self.target_straight_max_s, self.target_turn_min_s, self.target_turn_max_s,
                math.radians(self.target_turn_min_deg_s), math.radians(self.target_turn_max_deg_s),
            ]
        )  # fmt: skip
        drawn = turn_u.reshape(*start.shape[:2], self._turns, TURN_UNIFORMS)
        rates, windows = _random_turns(drawn, limits, np.empty(2))
        return instants_first(weave(start, rates, windows, self.step_s, axis))


@kernel("(),(m,t),(d,o),(l),(x),(c)->(x),(m,x),(d,c)")
def _random_starts(heading_u, target_u, disc_u, limits, like_x, like_c, platform, start, discs):
    """Platform at the origin, targets about it; disc j on the way to target j modulo m, beside the line of sight."""
    two_pi = 2.0 * math.pi
    heading = two_pi * heading_u
    platform[0] = platform[1] = 0.0
    platform[2], platform[3] = limits[0] * math.cos(heading), limits[0] * math.sin(heading)
    n = start.shape[0]
    for m in range(n):
        distance = limits[1] + (limits[2] - limits[1]) * target_u[m, 0]
        bearing, course = two_pi * target_u[m, 1], two_pi * target_u[m, 2]
        speed = limits[3] + (limits[4] - limits[3]) * target_u[m, 3]
        start[m, 0], start[m, 1] = distance * math.cos(bearing), distance * math.sin(bearing)
        start[m, 2], start[m, 3] = speed * math.cos(course), speed * math.sin(course)
    radius = limits[5]
    for d in range(discs.shape[0]):
        x, y = start[d % n, 0], start[d % n, 1]
        distance = math.hypot(x, y)
        nearest = NEAREST_DISC * radius
        along = nearest + max(limits[1] - nearest, 0.0) * disc_u[d, 0]
        across = DISC_OFFSET * radius * (2.0 * disc_u[d, 1] - 1.0)
        discs[d, 0], discs[d, 1] = (x * along - y * across) / distance, (y * along + x * across) / distance
        discs[d, 2] = radius


@kernel("(t,q),(l),(w)->(t),(t,w)")
def _random_turns(u, limits, like, rates, windows):
    """Turn rates [t] rad/s and windows [t, 2] s: a straight leg, a turn, a straight leg, …

    The first leg has any length up to the longest, so that targets may begin to turn at once.
    """
    t = 0.0
    for i in range(u.shape[0]):
        shortest = limits[0] if i > 0 else 0.0
        t += shortest + (limits[1] - shortest) * u[i, 0]
        duration = limits[2] + (limits[3] - limits[2]) * u[i, 1]
        rate = limits[4] + (limits[5] - limits[4]) * u[i, 2]
        rates[i] = rate if u[i, 3] < 0.5 else -rate
        windows[i, 0], windows[i, 1] = t, t + duration
        t += duration


CATALOGUE: dict[str, Ownship] = {
    "Ownship": Ownship(),
    "OwnshipManeuvering": Ownship(maneuvering=True, tracker="rp_ekf_adaptive"),
    "OwnshipMulti": Ownship(targets=3, standoff_m=10e3),
}
"""This module's scenarios by name; each becomes the environment ``passive/NAME-v0``."""
