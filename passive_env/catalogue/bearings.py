"""What scenarios of moving direction finders share: stations that steer by turn rate, unlabelled bearings, a tracker.

A scenario of this family says how many stations there are (`BearingScenario.stations`) and draws where everybody starts
and how the targets move (`BearingScenario.draw_courses`); the rest is here.
"""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple

import numpy as np

from passive_env.actions import Continuous, Discrete
from passive_env.catalogue.tracking import TrackingScenario
from passive_env.kinematics import turn
from passive_env.layers import Instant
from passive_env.metrics import BearingMetrics
from passive_env.observations import TrackObservation
from passive_env.own_observation import OwnObservation
from passive_env.scenario import choice, flag, free, integer, number
from passive_env.sensors import DirectionFinders
from passive_env.tape import ReturnModel, Tape, draw, returns, uniforms_needed
from passive_env.team import Steering, kind_by_kind
from passive_env.truth import TruthObservation
from trackers import TRACKERS
from trackers.association import AssociationModel
from trackers.compiled import kernel
from trackers.contract import Tracker


class Courses(NamedTuple):
    """Where everybody starts and how the targets move.

    Attributes:
        platforms: [e, s, 4] start states m, m/s.
        targets: [e, k + 1, m, 4] states m, m/s.
        discs: [e, d, 3] no-go discs: centre x, y and radius [m].
    """

    platforms: Any
    targets: Any
    discs: Any


@dataclass(frozen=True, kw_only=True)
class BearingScenario(TrackingScenario):
    """Base of scenarios in which direction finders steer by turn rate and a tracker ranges targets from bearings."""

    stations: ClassVar[int]
    """Number of platforms; the last one is the reference."""
    trackers: ClassVar[Mapping[str, Any]] = TRACKERS
    bearings: ClassVar[str] = "all"
    """Whose bearings the filter uses after the first scan; a field where there is a choice."""
    ordered: ClassVar[tuple[tuple[str, str], ...]] = (
        ("range_min_m", "range_max_m"),
        ("target_speed_min_m_s", "target_speed_max_m_s"),
    )

    targets: int = integer(1, 1, 6, "number of targets")
    station_speed_m_s: float = number(250.0, 0.0, 1000.0, "speed of every station")
    bearing_std_deg: float = number(0.5, 1e-3, 10.0, "bearing noise")
    tracker: Any = free("rp_ekf", f"{' or '.join(TRACKERS)}, or an object with the tracker contract")
    hypotheses: int = integer(8, 1, 64, "range hypotheses per target of a bank")
    range_floor_m: float = number(5e3, 100.0, 1e5, "nearest range the tracker looks for a target at first")
    range_cap_m: float = number(2e5, 1e3, 1e7, "farthest")
    process_noise_m_s: float = number(15.0, 0.0, 500.0, "the filter's q, velocity increment per step")
    prune_below: float = number(1e-4, 0.0, 0.5, "weight at which a bank removes a hypothesis; 0 keeps all")
    merge_below: float = number(4.0, 0.0, 100.0, "squared Mahalanobis distance at which a bank's hypotheses merge")
    second_order: bool = flag(False, "whether a bearing's curvature adds to a bank's innovation variance")
    detection_probability: float = number(1.0, 0.01, 1.0, "of each bearing, after the first scan")
    false_bearings_mean: float = number(0.0, 0.0, 10.0, "false bearings per station and scan, after the first scan")
    range_min_m: float = number(60e3, 1e3, 1e6, "nearest drawn start of a target from the reference")
    range_max_m: float = number(80e3, 1e3, 1e6, "farthest")
    target_speed_min_m_s: float = number(200.0, 1.0, 2000.0, "slowest drawn target")
    target_speed_max_m_s: float = number(300.0, 1.0, 2000.0, "fastest")
    lost_error_m: float = number(5e3, 1.0, 1e6, "a track is lost if farther off than this …")
    lost_nees: float = number(23.5, 1.0, 1e9, "… and its NEES exceeds this (99.99 % of χ² with 4 degrees)")
    actions: str = choice("continuous", ("continuous", "discrete"), "Box turn rates, or 3 turn rates per station")
    reward_nogo: float = number(1.0, 0.0, 1e6, "weight; counts only where there are no-go discs")

    # -- what each scenario draws ------------------------------------------------------------------------------------

    @property
    @abstractmethod
    def course_uniforms(self) -> int:
        """Uniform numbers per episode that `draw_courses` needs."""

    @abstractmethod
    def draw_courses(self, u: np.ndarray) -> Courses:
        """Courses of episodes from uniforms [e, course_uniforms], row by row."""

    @property
    @abstractmethod
    def bound_range_std_m(self) -> float:
        """Radial standard deviation of the Cramér–Rao bound's prior at the first scan."""

    # -- the parts the core asks for ---------------------------------------------------------------------------------

    @property
    def tracker_settings(self) -> dict[str, Any]:
        """Keywords of the named tracker."""
        names = () if self.tracker == "fused_ekf" else ("hypotheses", "prune_below", "merge_below", "second_order")
        return {
            **{name: getattr(self, name) for name in names},
            "floor_m": self.range_floor_m,
            "cap_m": self.range_cap_m,
            "process_noise": self.process_noise_m_s,
            "reference_only": self.bearings == "reference",
            "model": AssociationModel(
                detection_probability=self.detection_probability,
                false_bearing_density=self.false_bearings_mean / (2.0 * math.pi),
            ),
        }

    def make_actions(self) -> Continuous | Discrete:
        """Action codec, one turn rate per station."""
        return Continuous(self.stations) if self.actions == "continuous" else Discrete(self.stations)

    def make_observation(self) -> TrackObservation:
        """Observation model."""
        return TrackObservation(self.stations, self.targets, self.stations, self.steps, self.discs)

    @property
    def steering(self) -> Steering | None:
        """A turn rate per station; one that idles flies straight on."""
        return kind_by_kind(self.stations, (0.0,)) if self.stations > 1 else None

    def make_own_observation(self) -> OwnObservation:
        """What every station knows by itself."""
        return OwnObservation(kind_by_kind(self.stations, (0.0,)).columns, self.steps, self._returns.slots)

    def make_truth_observation(self) -> TruthObservation:
        """What a critic may know in training."""
        return TruthObservation(self.targets)

    def make_sensors(self, tracker: Tracker) -> DirectionFinders:
        """The stations' direction finders; what they see does not depend on the tracker."""
        return DirectionFinders(math.radians(self.bearing_std_deg))

    def make_metrics(self) -> BearingMetrics:
        """Figures of merit."""
        return BearingMetrics(self)

    def make_scene(self, figure: Any) -> Any:
        """The view from above, in a matplotlib figure."""
        from passive_env.render import Scene

        return Scene(figure, self.stations, self.targets, self.steps, self.standoff_m)

    def make_instants(self, world: Any, simulation: Any) -> list[Instant]:
        """What there is to see of a world (a batch of one), as plain numbers."""
        from passive_env.render import bearing_instants

        return bearing_instants(world, simulation)

    def move(self, platforms, command):
        """Platforms [e, s, 4] after one step of turn commands [e, s] in [−1, 1]."""
        return turn(platforms, command * math.radians(self.max_turn_rate_deg_s), self.step_s)

    def draw_tape(self, generators: Sequence[np.random.Generator]) -> Tape:
        """Tapes of len(generators) episodes, row i from generator i."""
        k, s, m, model = self.steps + 1, self.stations, self.targets, self._returns
        course = self.course_uniforms
        z, u = draw(generators, k * s * m, course + uniforms_needed(model))
        courses = self.draw_courses(np.ascontiguousarray(u[:, :course]))
        noise = z.reshape(-1, k, s, m)
        return Tape(courses.platforms, courses.targets, noise, **returns(model, u[:, course:]), discs=courses.discs)

    @property
    def _returns(self) -> ReturnModel:
        return ReturnModel(
            self.steps + 1, self.stations, self.targets, self.detection_probability, self.false_bearings_mean
        )

    def fly_flights(self, start: np.ndarray, picks: np.ndarray) -> np.ndarray:
        """Recorded windows chosen by uniforms [e, m] that begin at the starts [e, m, 4] on their courses.

        Returns:
            [e, k + 1, m, 4]; shape and speed of the recorded paths are unaltered.
        """
        windows = self.flight_paths.windows(picks, self.steps)
        return instants_first(place_flight(start, windows))


def instants_first(paths: np.ndarray) -> np.ndarray:
    """Paths [..., m, k + 1, 4] as a tape holds them: [..., k + 1, m, 4]."""
    return np.ascontiguousarray(np.swapaxes(paths, -2, -3))


def place_flight(start: np.ndarray, window: np.ndarray) -> np.ndarray:
    """Recorded windows [..., k, 6] turned and shifted so that they begin at starts [..., 4] on their courses.

    Returns:
        [..., k, 4].
    """
    return _place_flight(start, window)


@kernel("(x),(k,y)->(k,x)")
def _place_flight(start, window, path):
    """Turn and shift a recorded window so that it begins at a start position on a start course."""
    turn_by = math.atan2(start[3], start[2]) - math.atan2(window[0, 4], window[0, 3])
    c, s = math.cos(turn_by), math.sin(turn_by)
    for k in range(window.shape[0]):
        dx, dy = window[k, 0] - window[0, 0], window[k, 1] - window[0, 1]
        path[k, 0], path[k, 1] = start[0] + c * dx - s * dy, start[1] + s * dx + c * dy
        path[k, 2], path[k, 3] = c * window[k, 3] - s * window[k, 4], s * window[k, 3] + c * window[k, 4]
