"""Two moving direction finders and three targets: Xiu et al. (2002), "Study on multitarget tracking algorithm in two
direction-finding location systems", Acta Electronica Sinica 30(12), 1763–1767.

Station 0 is the paper's station 1; the last station is the reference, the paper's station 2.
"""

from __future__ import annotations

import math
import os
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from passive_env.actions import Continuous, Discrete
from passive_env.flights import FlightPaths, load_flights
from passive_env.kinematics import maneuver, turn
from passive_env.observations import TrackObservation
from passive_env.rewards import TERMS
from passive_env.scenario import Scenario, choice, free, integer, number
from passive_env.tape import ReturnModel, Tape, draw, returns, uniforms_needed
from trackers import TRACKERS
from trackers.association import AssociationModel
from trackers.compiled import kernel
from trackers.contract import Tracker

STATIONS = 2


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
class TwoStation(Scenario):
    """Two stations steer by turn rate; their tracker ranges up to six targets from unlabelled bearings."""

    course: str = choice(
        "random", ("random", "flights", *PAPER_COURSES), "target motion: drawn, recorded flights, or a paper reading"
    )
    targets: int = integer(3, 1, 6, "number of targets")
    steps: int = integer(45, 1, 10_000, "decisions per episode")
    step_s: float = number(2.0, 0.1, 60.0, "time between scans")
    station_speed_m_s: float = number(250.0, 0.0, 1000.0, "speed of both stations")
    max_turn_rate_deg_s: float = number(5.0, 0.0, 45.0, "turn rate at action ±1")
    bearing_std_deg: float = number(0.5, 1e-3, 10.0, "bearing noise")
    bearings: str = choice("all", ("all", "reference"), "whose bearings the filter uses after the first scan")
    tracker: Any = free("rp_ekf", f"{' or '.join(TRACKERS)}, or an object with the tracker contract")
    hypotheses: int = integer(8, 1, 64, "range hypotheses per target of a bank")
    process_noise_m_s: float = number(15.0, 0.0, 500.0, "the filter's q, velocity increment per step")
    detection_probability: float = number(1.0, 0.01, 1.0, "of each bearing, after the first scan")
    false_bearings_mean: float = number(0.0, 0.0, 10.0, "false bearings per station and scan, after the first scan")
    standoff_m: float = number(0.0, 0.0, 1e5, "distance stations should keep from targets; 0 for none")
    baseline_min_m: float = number(12e3, 100.0, 1e6, "shortest drawn distance between the stations")
    baseline_max_m: float = number(16e3, 100.0, 1e6, "longest")
    range_min_m: float = number(60e3, 1e3, 1e6, "nearest drawn start of a target from the reference")
    range_max_m: float = number(80e3, 1e3, 1e6, "farthest")
    spacing_deg: float = number(7.5, 0.0, 60.0, "angle between neighbouring targets, seen from the reference")
    spacing_jitter_deg: float = number(1.5, 0.0, 60.0, "each target's bearing is shifted by up to this")
    course_spread_deg: float = number(
        30.0, 0.0, 180.0, "targets share a drawn course of any direction, each ± up to this"
    )
    target_speed_min_m_s: float = number(200.0, 1.0, 2000.0, "slowest drawn target")
    target_speed_max_m_s: float = number(300.0, 1.0, 2000.0, "fastest")
    maneuver_spread_s: float = number(4.0, 0.0, 1e3, "each target begins up to this long after the first")
    maneuver_start_max_s: float = number(
        40.0, 0.0, 1e5, "the targets turn and accelerate from a time between 10 s and this"
    )
    final_speed_m_s: float = number(440.0, 1.0, 3000.0, "speed a target accelerates to, ±10")
    flights: Any = free(None, "file of recorded flights for course='flights'; None takes the shipped one")
    flight_split: str = choice("train", ("train", "test", "all"), "aircraft used for course='flights'")
    lost_error_m: float = number(5e3, 1.0, 1e6, "a track is lost if farther off than this …")
    lost_nees: float = number(23.5, 1.0, 1e9, "… and its NEES exceeds this (99.99 % of χ² with 4 degrees)")
    actions: str = choice("continuous", ("continuous", "discrete"), "Box turn rates, or 3 turn rates per station")
    reward_log_range_error: float = number(1.0, 0.0, 1e6, "weight")
    reward_relative_range_error: float = number(0.0, 0.0, 1e6, "weight")
    reward_log_range_bound: float = number(0.0, 0.0, 1e6, "weight")
    reward_final_log_range_bound: float = number(0.0, 0.0, 1e6, "weight")
    reward_information_gain: float = number(0.0, 0.0, 1e6, "weight")
    reward_maneuver: float = number(0.0, 0.0, 1e6, "weight")
    reward_standoff: float = number(1.0, 0.0, 1e6, "weight; counts only when standoff_m > 0")
    reward_lost_track: float = number(0.0, 0.0, 1e6, "weight")

    def __post_init__(self) -> None:
        super().__post_init__()
        for low, high in (
            ("baseline_min_m", "baseline_max_m"),
            ("range_min_m", "range_max_m"),
            ("target_speed_min_m_s", "target_speed_max_m_s"),
        ):
            if getattr(self, low) > getattr(self, high):
                raise ValueError(
                    f"TwoStation.{low} = {getattr(self, low)}: must not exceed {high} = {getattr(self, high)}"
                )
        if self.course in PAPER_COURSES and self.targets != len(NATURAL.targets_m):
            raise ValueError(
                f"TwoStation.targets = {self.targets}: course={self.course!r} has {len(NATURAL.targets_m)}"
            )
        if not isinstance(self.flights, (str, os.PathLike, type(None))):
            raise ValueError(f"TwoStation.flights = {self.flights!r}: must be the path of a file, or None")
        self.make_tracker()

    # -- the parts the core asks for ---------------------------------------------------------------------------------

    def make_tracker(self) -> Tracker:
        """The tracker object; a name is made with this scenario's settings.

        Raises:
            ValueError: unknown name; TypeError: an object that lacks a verb of the contract.
        """
        if not isinstance(self.tracker, str):
            return _checked_tracker(self.tracker)
        if self.tracker not in TRACKERS:
            raise ValueError(f"TwoStation.tracker = {self.tracker!r}: must be one of {', '.join(map(repr, TRACKERS))}")
        kind = TRACKERS[self.tracker]
        settings: dict[str, Any] = {} if self.tracker == "fused_ekf" else {"hypotheses": self.hypotheses}
        model = AssociationModel(
            detection_probability=self.detection_probability,
            false_bearing_density=self.false_bearings_mean / (2.0 * math.pi),
        )
        return kind(
            process_noise=self.process_noise_m_s, reference_only=self.bearings == "reference", model=model, **settings
        )

    def make_actions(self) -> Continuous | Discrete:
        """Action codec, one turn rate per station."""
        return Continuous(STATIONS) if self.actions == "continuous" else Discrete(STATIONS)

    def make_observation(self) -> TrackObservation:
        """Observation model."""
        return TrackObservation(STATIONS, self.targets, STATIONS, self.steps)

    @cached_property
    def reward_weights(self) -> dict[str, float]:
        """Weights of the reward terms in use."""
        weights = {name: getattr(self, f"reward_{name}") for name in TERMS}
        if self.standoff_m == 0.0:
            weights["standoff"] = 0.0
        return {name: weight for name, weight in weights.items() if weight > 0.0}

    def move(self, platforms, command):
        """Platforms [e, s, 4] after one step of turn commands [e, s] in [−1, 1]."""
        return turn(platforms, command * math.radians(self.max_turn_rate_deg_s), self.step_s)

    def draw_tape(self, generators: Sequence[np.random.Generator]) -> Tape:
        """Tapes of len(generators) episodes, row i from generator i."""
        k, m = self.steps + 1, self.targets
        model = ReturnModel(k, STATIONS, m, self.detection_probability, self.false_bearings_mean)
        course = 8 + 6 * m
        z, u = draw(generators, k * STATIONS * m, course + uniforms_needed(model))
        platforms, targets = self._courses(np.ascontiguousarray(u[:, :course]))
        noise = z.reshape(-1, k, STATIONS, m)
        return Tape(platforms, targets, noise, **returns(model, u[:, course:]))

    def check_flights(self) -> None:
        """Load the recorded flights now, so that a bad file is found before anything else is done.

        Raises:
            OSError, ValueError: missing or malformed file, or no flight long enough for an episode.
        """
        if self.course == "flights":
            self._flight_paths.window_starts(self.steps)

    # -- courses -----------------------------------------------------------------------------------------------------

    def _courses(self, u: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        if self.course in PAPER_COURSES:
            return _fixed_courses(PAPER_COURSES[self.course], len(u), self.steps, self.step_s, self.station_speed_m_s)
        like_stations, like_targets = np.empty((STATIONS, 4)), np.empty((self.targets, 4))
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
            picks = u[:, 8:].reshape(len(u), self.targets, 6)[..., 5]
            return stations, _place_flights(start, self._flight_paths.windows(picks, self.steps))
        axis = np.empty(self.steps + 1)
        paths = maneuver(
            start, schedule[..., 0], schedule[..., 1:3], schedule[..., 3], schedule[..., 4:6], self.step_s, axis
        )
        return stations, np.ascontiguousarray(np.swapaxes(paths, -2, -3))

    @cached_property
    def _flight_paths(self) -> FlightPaths:
        return load_flights(self.flights).split(self.flight_split).resample(self.step_s)


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


@kernel("(x),(k,y)->(k,x)")
def _place_flight(start, window, path):
    """Turn and shift a recorded window so that it begins at a start position on a start course."""
    turn_by = math.atan2(start[3], start[2]) - math.atan2(window[0, 4], window[0, 3])
    c, s = math.cos(turn_by), math.sin(turn_by)
    for k in range(window.shape[0]):
        dx, dy = window[k, 0] - window[0, 0], window[k, 1] - window[0, 1]
        path[k, 0], path[k, 1] = start[0] + c * dx - s * dy, start[1] + s * dx + c * dy
        path[k, 2], path[k, 3] = c * window[k, 3] - s * window[k, 4], s * window[k, 3] + c * window[k, 4]


def _place_flights(start, windows) -> np.ndarray:
    """Recorded windows [e, m, k + 1, 6] moved to the starts [e, m, 4]: [e, k + 1, m, 4]; shape and speed unaltered."""
    return np.ascontiguousarray(np.swapaxes(_place_flight(start, windows), -2, -3))


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


def _checked_tracker(tracker: Any) -> Tracker:
    missing = [
        verb for verb in ("initiate", "predict", "update", "estimate") if not callable(getattr(tracker, verb, None))
    ]
    if missing:
        raise TypeError(
            f"tracker {tracker!r} has no {', '.join(missing)}; a tracker needs initiate, predict, update, estimate"
        )
    return tracker


CATALOGUE: dict[str, TwoStation] = {"TwoStation": TwoStation()}
"""This module's scenarios by name; each becomes the environment ``passive/NAME-v0``."""
