"""Two moving direction finders and three targets: Xiu et al. (2002), "Study on multitarget tracking algorithm in two
direction-finding location systems", Acta Electronica Sinica 30(12), 1763–1767.

Station 0 is the paper's station 1; the last station is the reference, the paper's station 2.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from passive_env.catalogue.bearings import BearingScenario, Courses, instants_first
from passive_env.kinematics import maneuver
from passive_env.scenario import choice, integer, number
from trackers.compiled import kernel


@dataclass(frozen=True)
class PaperCourse:
    """A fixed reading of the paper's scenario (positions m, headings deg counter-clockwise from east, times s)."""

    stations_m: tuple[tuple[float, float], ...] = ((-10000.0, 0.0), (3536.0, 3536.0))
    targets_m: tuple[tuple[float, float], ...] = ((53000.0, 53000.0), (45660.0, 59500.0), (58600.0, 46760.0))
    station_heading_deg: tuple[float, ...] = (45.0, 45.0)
    target_heading_deg: tuple[float, ...] = (225.0, 225.0, 225.0)
    target_sense: tuple[int, ...] = (1, 1, 1)
    station_sense: tuple[int, ...] = (1, 1)
    final_speed_m_s: tuple[float, ...] = (450.0, 430.0, 430.0)
    target_turn_s: tuple[float, float] = (22.0, 26.0)
    station_turn_s: tuple[tuple[float, float], ...] = ((52.0, 56.0), (22.0, 26.0))
    speed_m_s: float = 250.0
    turn_rate_deg_s: float = 5.0
    acceleration_m_s2: float = 10.0


NATURAL = PaperCourse()
"""The symmetric reading: stations head 45°, targets 225°, every turn counter-clockwise."""

BESTFIT = PaperCourse(target_heading_deg=(233.0, 210.0, 221.0), target_sense=(1, 1, -1), station_sense=(1, -1))
"""A searched reading that comes nearest to the paper's Table 1: evidence that it is attainable, no identification."""

PAPER_COURSES = {"paper": NATURAL, "paper_bestfit": BESTFIT}

TABLE_1_UPDATES = (1, 5, 9, 13, 17, 21, 25, 29, 33, 37, 39, 40, 41, 42, 43, 44, 45)
TABLE_1_RANGE_ERROR_KM = (
    (
        435.92, 438.35, 451.32, 434.49, 172.11, 38.36, 41.94, 47.81, 38.53,
        21.36, 15.12, 12.27, 8.77, 4.94, 3.28, 2.32, 2.30,
    ),
    (
        15.159, 8.914, 4.550, 8.035, 6.581, 7.168, 14.921, 17.394, 11.958,
        7.604, 5.088, 4.088, 2.988, 1.727, 1.613, 1.656, 1.847,
    ),
    (
        301.62, 302.57, 287.08, 258.97, 155.67, 45.95, 12.15, 13.95, 15.84,
        13.26, 9.75, 7.83, 5.72, 4.55, 2.90, 2.19, 1.92,
    ),
)  # fmt: skip
"""The paper's Table 1, range error to station 2 [km] per target at the updates above."""


@dataclass(frozen=True, kw_only=True)
class TwoStation(BearingScenario):
    """Two stations steer by turn rate; their tracker ranges up to six targets from unlabelled bearings.

    Drawn per episode, uniformly (course "random"): baseline length and direction; both stations' headings; the mean
    line of sight from the reference; one course for all targets, each off it by up to ``course_spread_deg``; starts in
    range, spacing and speed within the fields' limits. From one time between 10 s and ``maneuver_start_max_s`` (each
    target up to ``maneuver_spread_s`` later) all targets turn to one side, left or right, at 5°/s for 4 s and
    accelerate at 10 m/s² to ``final_speed_m_s`` ± 10 m/s, as in the paper.
    """

    stations: ClassVar[int] = 2
    ordered: ClassVar[tuple[tuple[str, str], ...]] = (("baseline_min_m", "baseline_max_m"), *BearingScenario.ordered)

    course: str = choice(
        "random", ("random", "flights", *PAPER_COURSES), "target motion: drawn, recorded flights, or a paper reading"
    )
    targets: int = integer(3, 1, 6, "number of targets")
    bearings: str = choice("all", ("all", "reference"), "whose bearings the filter uses after the first scan")
    baseline_min_m: float = number(12e3, 100.0, 1e6, "shortest drawn distance between the stations")
    baseline_max_m: float = number(16e3, 100.0, 1e6, "longest")
    spacing_deg: float = number(7.5, 0.0, 60.0, "angle between neighbouring targets, seen from the reference")
    spacing_jitter_deg: float = number(1.5, 0.0, 60.0, "each target's bearing is shifted by up to this")
    course_spread_deg: float = number(
        30.0, 0.0, 180.0, "targets share a drawn course of any direction, each ± up to this"
    )
    maneuver_spread_s: float = number(4.0, 0.0, 1e3, "each target begins up to this long after the first")
    maneuver_start_max_s: float = number(
        40.0, 0.0, 1e5, "the targets turn and accelerate from a time between 10 s and this"
    )
    final_speed_m_s: float = number(440.0, 1.0, 3000.0, "speed a target accelerates to, ±10")

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.course in PAPER_COURSES and self.targets != len(NATURAL.targets_m):
            raise self._error("targets", f"course={self.course!r} has {len(NATURAL.targets_m)}")

    @property
    def bound_range_std_m(self) -> float:
        """As in the specification of Xiu et al. (2002), section 10."""
        return 15e3

    @property
    def course_uniforms(self) -> int:
        """Eight numbers of the episode and six of each target."""
        return 8 + 6 * self.targets

    def draw_courses(self, u: np.ndarray) -> Courses:
        """Stations and targets of episodes from uniforms [e, course_uniforms]; there are no discs."""
        discs = np.empty((len(u), 0, 3))
        if self.course in PAPER_COURSES:
            fixed = _fixed_courses(PAPER_COURSES[self.course], len(u), self.steps, self.step_s, self.station_speed_m_s)
            return Courses(*fixed, discs)
        like_stations, like_targets = np.empty((self.stations, 4)), np.empty((self.targets, 4))
        limits = np.array(
            [
                self.baseline_min_m, self.baseline_max_m, self.range_min_m, self.range_max_m,
                math.radians(self.spacing_deg), math.radians(self.spacing_jitter_deg), self.target_speed_min_m_s,
                self.target_speed_max_m_s, self.maneuver_start_max_s, self.final_speed_m_s, self.station_speed_m_s,
                math.radians(self.course_spread_deg), self.maneuver_spread_s,
            ]
        )  # fmt: skip
        stations, start, schedule = _random_starts(u, limits, like_stations, like_targets, np.empty(6))
        if self.course == "flights":
            return Courses(stations, self.fly_flights(start, u[:, 8:].reshape(len(u), self.targets, 6)[..., 5]), discs)
        axis = np.empty(self.steps + 1)
        paths = maneuver(
            start, schedule[..., 0], schedule[..., 1:3], schedule[..., 3], schedule[..., 4:6], self.step_s, axis
        )
        return Courses(stations, instants_first(paths), discs)


@kernel("(c),(l),(s,x),(m,x),(w)->(s,x),(m,x),(m,w)")
def _random_starts(u, limits, like_s, like_m, like_w, stations, start, schedule):
    """Start states [s, 4], [m, 4] and maneuver schedules (rate, from, to, acceleration, from, to) of an episode."""
    two_pi = 2.0 * math.pi
    baseline = limits[0] + (limits[1] - limits[0]) * u[0]
    angle, line_of_sight = two_pi * u[1], two_pi * u[2]
    stations[:] = 0.0
    stations[0, 0], stations[0, 1] = baseline * math.cos(angle), baseline * math.sin(angle)
    for s in range(2):
        heading = two_pi * u[3 + s]
        stations[s, 2], stations[s, 3] = limits[10] * math.cos(heading), limits[10] * math.sin(heading)
    n = start.shape[0]
    sense = 1.0 if u[7] < 0.5 else -1.0
    for m in range(n):
        v = u[8 + 6 * m : 14 + 6 * m]
        distance = limits[2] + (limits[3] - limits[2]) * v[0]
        bearing = line_of_sight + (m - 0.5 * (n - 1)) * limits[4] + (2.0 * v[1] - 1.0) * limits[5]
        heading = two_pi * u[5] + limits[11] * (2.0 * v[2] - 1.0)
        speed = limits[6] + (limits[7] - limits[6]) * v[3]
        start[m, 0], start[m, 1] = distance * math.cos(bearing), distance * math.sin(bearing)
        start[m, 2], start[m, 3] = speed * math.cos(heading), speed * math.sin(heading)
        begin = min(10.0, limits[8]) + max(limits[8] - 10.0, 0.0) * u[6] + limits[12] * v[4]
        final = limits[9] + 20.0 * (v[5] - 0.5)
        schedule[m, 0] = sense * math.radians(5.0)
        schedule[m, 1], schedule[m, 2] = begin, begin + 4.0
        schedule[m, 3] = 10.0
        schedule[m, 4], schedule[m, 5] = begin, begin + max(final - speed, 0.0) / 10.0


def _fixed_courses(course: PaperCourse, batch: int, steps: int, step_s: float, station_speed: float):
    stations = _states(course.stations_m, course.station_heading_deg, station_speed)
    start = _states(course.targets_m, course.target_heading_deg, course.speed_m_s)
    rate = math.radians(course.turn_rate_deg_s) * np.array(course.target_sense, dtype=float)
    begin = course.target_turn_s[0]
    gain_s = (np.array(course.final_speed_m_s) - course.speed_m_s) / course.acceleration_m_s2
    window = np.stack([np.full(len(rate), begin), begin + gain_s], axis=-1)
    paths = maneuver(
        start, rate, np.array(course.target_turn_s), course.acceleration_m_s2, window, step_s, np.empty(steps + 1)
    )
    targets = np.swapaxes(paths, 0, 1)
    return np.tile(stations, (batch, 1, 1)), np.tile(targets, (batch, 1, 1, 1))


def _states(positions, headings_deg, speed) -> np.ndarray:
    heading = np.radians(headings_deg)
    return np.column_stack([np.array(positions), speed * np.cos(heading), speed * np.sin(heading)])


CATALOGUE: dict[str, TwoStation] = {"TwoStation": TwoStation()}
"""This module's scenarios by name; each becomes the environment ``passive/NAME-v0``."""
