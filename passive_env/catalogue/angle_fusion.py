"""Two airborne platforms that measure azimuth and elevation, with dropouts and clutter: Wang, Wang and Yang (2004),
"Fusion tracking of a maneuvering target with two airborne passive sensors".

Range is measured from platform 0, the paper's P1, where the fusion centre is.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from passive_env.actions import Continuous, Discrete, Headings
from passive_env.angle_metrics import AngleFigures
from passive_env.angle_observation import AngleObservation
from passive_env.angle_sensors import AngleSensors, Clutter
from passive_env.angle_tape import AngleReturnModel, AngleTape, angle_returns
from passive_env.catalogue.tracking import TrackingScenario
from passive_env.kinematics import turn_and_climb
from passive_env.layers import Instant
from passive_env.own_observation import OwnObservation
from passive_env.scenario import choice, flag, free, integer, number
from passive_env.tape import draw
from passive_env.team import Steering, kind_by_kind
from passive_env.truth import TruthObservation
from trackers import ANGLE_TRACKERS
from trackers.angle_contract import AngleTracker
from trackers.compiled import kernel

PAPER_PLATFORMS = ((0.0, 0.0, 6000.0, 150.0, 0.0, 0.0), (0.0, -6000.0, 6000.0, 150.0, 0.0, 0.0))
PAPER_TARGET = (30000.0, -3000.0, 8000.0, -150.0, 0.0, 0.0)
"""The paper's layout as the specification reads it: two platforms abreast, 6 km apart, head east at 150 m/s towards a
target that heads west; states m, m/s."""

PAPER_TURN_S, PAPER_TURN_DEG = 40.0, 45.0
"""The paper's maneuver: at this time platform 0 turns left, to the north, by this angle; platform 1 flies on."""

COURSE_UNIFORMS = 13
"""Uniform numbers of an episode's courses: formation, its side, baseline, heading, two altitudes; the target's bearing,
range, speed, course, altitude, climb, recorded flight."""

ACTIONS = ("continuous", "headings", "discrete")
"""Kinds of action spaces (`passive_env.actions`)."""

MOST_FALSE = 128
"""Slots for false returns of one scan of one platform, at most."""


@dataclass(frozen=True, kw_only=True)
class AngleFusion(TrackingScenario):
    """Two platforms steer by turn and climb rates; their tracker fuses azimuths and elevations of one target.

    Drawn per episode, uniformly (course "random"): the platforms' common heading, formation (abreast or in trail, with
    platform 0 on any side), baseline and altitudes; the target's bearing from platform 0, level range, course, speed,
    altitude and climb. Targets and formations fly straight. With course "flights" the target flies a recorded path at
    its recorded altitude from that bearing and range on that course; course "paper" is the paper's layout.

    The first scan is the acquisition: both platforms see the target and nothing else. Later a platform's sensor is
    available with a probability drawn per episode; an available one detects the target with `detection_probability`
    and adds clutter: a Poisson number of returns, either ``clutter_mean`` in each sensor's gate about the predicted
    track, or ``clutter_density_per_deg2`` over a window about the target (beyond it there is none).

    Action: turn rates of both platforms, then climb rates, as shares of the limits.
    Observation: `passive_env.angle_observation.AngleObservation`.
    info: besides what every environment shows ``position_crlb_m`` and ``dropped_returns``, each [1]: returns in gates
        beyond the largest number the tracker weighs.
    """

    stations: ClassVar[int] = 2
    """Number of platforms; platform 0 is the reference."""
    trackers: ClassVar[Mapping[str, Any]] = ANGLE_TRACKERS
    reference: ClassVar[int] = 0
    targets: ClassVar[int] = 1
    score: ClassVar[str] = "position"
    ordered: ClassVar[tuple[tuple[str, str], ...]] = (
        ("baseline_min_m", "baseline_max_m"),
        ("range_min_m", "range_max_m"),
        ("target_speed_min_m_s", "target_speed_max_m_s"),
        ("target_altitude_min_m", "target_altitude_max_m"),
        ("platform_altitude_min_m", "platform_altitude_max_m"),
        ("altitude_floor_m", "platform_altitude_min_m"),
        ("platform_altitude_max_m", "altitude_ceiling_m"),
        ("availability0_min", "availability0_max"),
        ("availability1_min", "availability1_max"),
    )

    course: str = choice(
        "random", ("random", "flights", "paper"), "target motion: drawn, recorded flights, or the paper's layout"
    )
    formation: str = choice("random", ("random", "abreast", "trail"), "how drawn platforms fly beside each other")
    steps: int = integer(40, 1, 10_000, "decisions per episode")
    platform_speed_m_s: float = number(150.0, 1.0, 1000.0, "level speed of both platforms")
    max_climb_m_s: float = number(30.0, 0.0, 200.0, "climb rate at action ±1")
    altitude_floor_m: float = number(500.0, 0.0, 3e4, "lowest altitude of a platform")
    altitude_ceiling_m: float = number(15e3, 0.0, 3e4, "highest")
    azimuth_std_deg: float = number(0.5, 1e-3, 10.0, "azimuth noise")
    elevation_std_deg: float = number(0.5, 1e-3, 10.0, "elevation noise")
    tracker: Any = free("angle_pdaf", f"{' or '.join(ANGLE_TRACKERS)}, or an object with the tracker contract")
    process_noise_m_s2: float = number(30.0, 0.0, 500.0, "the filter's √q, acceleration per axis")
    gate: float = number(16.0, 1.0, 100.0, "γ₂, squared size of the gates of single sensors")
    fused_gate: float = number(18.47, 1.0, 200.0, "γ₄, squared size of the gate of pairs of returns")
    outlier_test: str = choice("off", ("off", "conditioned", "coplanarity"), "test that sets a platform's return aside")
    range_floor_m: float = number(
        10e3, 1.0, 1e7, "the tracker's prior of range, where directions do not fix it: 95 % …"
    )
    range_cap_m: float = number(100e3, 1.0, 1e7, "… lie between these two")
    second_order: bool = flag(True, "whether the curvature of azimuth and elevation adds to their variance")
    reinitiate: bool = flag(False, "whether a track that the tracker finds lost starts anew")
    detection_probability: float = number(1.0, 0.01, 1.0, "of the target by an available sensor, after the first scan")
    availability0_min: float = number(1.0, 0.0, 1.0, "share of scans that platform 0's sensor delivers: least drawn")
    availability0_max: float = number(1.0, 0.0, 1.0, "largest")
    availability1_min: float = number(1.0, 0.0, 1.0, "the same of platform 1")
    availability1_max: float = number(1.0, 0.0, 1.0, "largest")
    clutter_mean: float = number(0.0, 0.0, 12.0, "false returns per gate and scan, after the first scan")
    clutter_density_per_deg2: float = number(0.0, 0.0, 1.0, "false returns per square degree and scan instead")
    clutter_window_deg: float = number(10.0, 0.1, 45.0, "half the width and height of the window of fixed density")
    clutter_known: bool = flag(True, "whether the tracker is told the density; else it goes by the returns in its gate")
    standoff_m: float = number(6e3, 0.0, 1e5, "distance platforms should keep from the target; 0 for none")
    baseline_min_m: float = number(3e3, 10.0, 1e5, "shortest drawn distance between the platforms")
    baseline_max_m: float = number(9e3, 10.0, 1e5, "longest")
    range_min_m: float = number(20e3, 1e3, 1e6, "nearest drawn start of the target from platform 0, level")
    range_max_m: float = number(40e3, 1e3, 1e6, "farthest")
    target_speed_min_m_s: float = number(100.0, 1.0, 2000.0, "slowest drawn target")
    target_speed_max_m_s: float = number(250.0, 1.0, 2000.0, "fastest")
    target_altitude_min_m: float = number(4e3, 0.0, 3e4, "lowest drawn target")
    target_altitude_max_m: float = number(11e3, 0.0, 3e4, "highest")
    target_climb_max_m_s: float = number(10.0, 0.0, 200.0, "drawn targets climb or descend by up to this")
    platform_altitude_min_m: float = number(5e3, 0.0, 3e4, "lowest drawn platform")
    platform_altitude_max_m: float = number(8e3, 0.0, 3e4, "highest")
    lost_error_m: float = number(1e3, 1.0, 1e6, "a track is lost if farther off than this …")
    lost_nees: float = number(27.9, 1.0, 1e9, "… and its NEES exceeds this (99.99 % of χ² with 6 degrees)")
    actions: str = choice("continuous", ACTIONS, "Box of rates; Box of headings and climbs; or 3 rates of each kind")
    reward_log_range_error: float = number(0.0, 0.0, 1e6, "weight")
    reward_log_position_error: float = number(1.0, 0.0, 1e6, "weight")
    reward_relative_position_error: float = number(0.0, 0.0, 1e6, "weight")
    reward_position_error: float = number(0.0, 0.0, 1e6, "weight")
    reward_final_position_error: float = number(0.0, 0.0, 1e6, "weight")
    reward_log_position_bound: float = number(0.0, 0.0, 1e6, "weight")
    reward_standoff: float = number(5.0, 0.0, 1e6, "weight; counts only when standoff_m > 0")

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.clutter_mean > 0.0 and self.clutter_density_per_deg2 > 0.0:
            raise self._error("clutter_density_per_deg2", f"choose it or clutter_mean = {self.clutter_mean}")
        if self._returns.false_slots > MOST_FALSE:
            raise self._error(
                "clutter_density_per_deg2",
                f"{self._false_mean:.0f} false returns on average and up to {self._returns.false_slots} in a window of "
                f"{2 * self.clutter_window_deg:g}° are more than {MOST_FALSE}; lower it or clutter_window_deg",
            )
        self._check_standoff()

    def _check_standoff(self) -> None:
        """Refuse layouts in which a platform may start inside the target's stand-off sphere."""
        if self.course == "paper":
            gap = min(math.dist(platform[:3], PAPER_TARGET[:3]) for platform in PAPER_PLATFORMS)
            where = "course='paper' starts"
        else:
            gap, where = self.range_min_m - self.baseline_max_m, "range_min_m − baseline_max_m lets platforms start"
        if self.standoff_m > gap:
            raise self._error("standoff_m", f"{where} {gap:.0f} m from the target: must not exceed this")

    # -- the parts the core asks for ---------------------------------------------------------------------------------

    @property
    def tracker_settings(self) -> dict[str, Any]:
        """Keywords of the named tracker."""
        same = ("gate", "fused_gate", "detection_probability", "clutter_known", "second_order", "reinitiate")
        return {
            **{name: getattr(self, name) for name in same},
            "floor_m": self.range_floor_m,
            "cap_m": self.range_cap_m,
            "process_noise": self.process_noise_m_s2,
            "outlier_test": None if self.outlier_test == "off" else self.outlier_test,
        }

    def make_actions(self) -> Continuous | Discrete:
        """Action codec: turn rates of all platforms, then climb rates."""
        odd = [True] * self.stations + [False] * self.stations
        if self.actions == "headings":
            return Headings(len(odd), self.stations, math.radians(self.max_turn_rate_deg_s) * self.step_s, odd)
        return Continuous(len(odd), odd) if self.actions == "continuous" else Discrete(len(odd), odd=odd)

    def make_observation(self) -> AngleObservation:
        """Observation model."""
        return AngleObservation(self.stations, self.steps)

    @property
    def steering(self) -> Steering:
        """Turn and climb rate per platform; one that idles flies straight and level."""
        return kind_by_kind(self.stations, (0.0, 0.0))

    def make_own_observation(self) -> OwnObservation:
        """What every platform knows by itself.

        Raises:
            ValueError: false returns lie about the common track and would tell where that is.
        """
        if self.clutter_mean > 0.0:
            raise self._error(
                "clutter_mean", "such false returns lie in the gates of the common track, which a platform alone does "
                "not know; take clutter_mean=0 and clutter_density_per_deg2, or view='common'",
            )  # fmt: skip
        slots = 1 + self._returns.false_slots
        return OwnObservation(self.steering.columns, self.steps, slots, dimensions=3, place_unit_m=1e4)

    def make_truth_observation(self) -> TruthObservation:
        """What a critic may know in training."""
        return TruthObservation(self.targets, self.reference)

    def make_sensors(self, tracker: AngleTracker) -> AngleSensors:
        """The platforms' sensors; clutter per gate lies where the tracker searches."""
        std = np.radians([self.azimuth_std_deg, self.elevation_std_deg])
        shape = "window" if self.clutter_density_per_deg2 > 0.0 else "gate"
        window = math.radians(self.clutter_window_deg)
        clutter = Clutter(shape, self._false_mean, self.gate, window, self.clutter_known)
        return AngleSensors(tracker, std, clutter, 1 + self._returns.false_slots)

    def make_metrics(self) -> AngleFigures:
        """Figures of merit."""
        return AngleFigures(self)

    def make_scene(self, figure: Any) -> Any:
        """Plan and side view, and what each sensor sees, in a matplotlib figure."""
        from passive_env.render_angles import AngleScene

        return AngleScene(figure, self)

    def make_instants(self, world: Any, simulation: Any) -> list[Instant]:
        """What there is to see of a world (a batch of one), as plain numbers."""
        from passive_env.render_angles import angle_instants

        return angle_instants(world, simulation)

    def move(self, platforms, command):
        """Platforms [e, s, 6] after one step of commands [e, 2 s] in [−1, 1]: turns, then climbs."""
        rates = command[..., : self.stations] * math.radians(self.max_turn_rate_deg_s)
        climbs = command[..., self.stations :] * self.max_climb_m_s
        return turn_and_climb(
            platforms, rates, climbs, self.step_s, np.array([self.altitude_floor_m, self.altitude_ceiling_m])
        )

    def draw_tape(self, generators: Sequence[np.random.Generator]) -> AngleTape:
        """Tapes of len(generators) episodes, row i from generator i."""
        k, s, model = self.steps + 1, self.stations, self._returns
        z, u = draw(generators, k * s * 2, COURSE_UNIFORMS + model.uniforms)
        platforms, targets = self._draw_courses(np.ascontiguousarray(u[:, :COURSE_UNIFORMS]))
        rest = angle_returns(model, u[:, COURSE_UNIFORMS:])
        return AngleTape(platforms, targets, np.empty((len(u), 0, 3)), z.reshape(-1, k, s, 2), **rest)

    # -- drawing -----------------------------------------------------------------------------------------------------

    @property
    def _false_mean(self) -> float:
        """False returns per platform and scan."""
        return self.clutter_mean or self.clutter_density_per_deg2 * (2.0 * self.clutter_window_deg) ** 2

    @property
    def _returns(self) -> AngleReturnModel:
        return AngleReturnModel(
            self.steps + 1, self.stations, self.detection_probability, self._false_mean,
            (self.availability0_min, self.availability1_min), (self.availability0_max, self.availability1_max),
        )  # fmt: skip

    def _draw_courses(self, u: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Start of the platforms [e, s, 6] and target paths [e, k + 1, 1, 6] from uniforms [e, COURSE_UNIFORMS]."""
        if self.course == "paper":
            platforms = np.tile(PAPER_PLATFORMS, (len(u), 1, 1))
            platforms[..., 3:5] *= self.platform_speed_m_s / 150.0
            start = np.tile(PAPER_TARGET, (len(u), 1))
        else:
            platforms, start = _random_starts(u, self._limits(), np.empty((self.stations, 6)))
        if self.course == "flights":
            windows = self.flight_paths.windows(u[:, COURSE_UNIFORMS - 1], self.steps)
            return platforms, place_flight_in_space(start, windows)[:, :, None]
        time_s = self.step_s * np.arange(self.steps + 1)[:, None]
        velocity = np.broadcast_to(start[:, None, 3:], (len(u), len(time_s), 3))
        return platforms, np.concatenate([start[:, None, :3] + time_s * velocity, velocity], axis=-1)[:, :, None]

    def _limits(self) -> np.ndarray:
        abreast = {"random": 0.5, "abreast": 1.0, "trail": 0.0}[self.formation]
        return np.array(
            [
                abreast, self.platform_speed_m_s, self.baseline_min_m, self.baseline_max_m,
                self.platform_altitude_min_m, self.platform_altitude_max_m, self.range_min_m, self.range_max_m,
                self.target_speed_min_m_s, self.target_speed_max_m_s, self.target_altitude_min_m,
                self.target_altitude_max_m, self.target_climb_max_m_s,
            ]
        )  # fmt: skip


@kernel("(c),(l),(s,x6)->(s,x6),(x6)")
def _random_starts(u, limits, like, platforms, start):
    """Start states of platforms [s, 6], the first at the origin, and of the target [6]."""
    two_pi = 2.0 * math.pi
    heading, sign = two_pi * u[3], 1.0 if u[1] < 0.5 else -1.0
    side = heading + (0.5 * math.pi if u[0] < limits[0] else 0.0)
    baseline = sign * (limits[2] + (limits[3] - limits[2]) * u[2])
    for s in range(platforms.shape[0]):
        platforms[s, 0], platforms[s, 1] = s * baseline * math.cos(side), s * baseline * math.sin(side)
        platforms[s, 2] = limits[4] + (limits[5] - limits[4]) * u[4 + s]
        platforms[s, 3], platforms[s, 4] = limits[1] * math.cos(heading), limits[1] * math.sin(heading)
        platforms[s, 5] = 0.0
    bearing, course = two_pi * u[6], two_pi * u[9]
    distance, speed = limits[6] + (limits[7] - limits[6]) * u[7], limits[8] + (limits[9] - limits[8]) * u[8]
    start[0], start[1] = distance * math.cos(bearing), distance * math.sin(bearing)
    start[2] = limits[10] + (limits[11] - limits[10]) * u[10]
    start[3], start[4] = speed * math.cos(course), speed * math.sin(course)
    start[5] = limits[12] * (2.0 * u[11] - 1.0)


def place_flight_in_space(start: np.ndarray, window: np.ndarray) -> np.ndarray:
    """Recorded windows [..., k, 6] turned and shifted to starts [..., 6] on their courses, at the recorded altitudes.

    Returns:
        [..., k, 6].
    """
    return _place_flight(start, window)


@kernel("(x6),(k,x6)->(k,x6)")
def _place_flight(start, window, path):
    """Turn and shift a recorded window so that it begins at a start's place on its course, at the recorded altitude."""
    turn_by = math.atan2(start[4], start[3]) - math.atan2(window[0, 4], window[0, 3])
    c, s = math.cos(turn_by), math.sin(turn_by)
    for k in range(window.shape[0]):
        dx, dy = window[k, 0] - window[0, 0], window[k, 1] - window[0, 1]
        path[k, 0], path[k, 1], path[k, 2] = start[0] + c * dx - s * dy, start[1] + s * dx + c * dy, window[k, 2]
        path[k, 3], path[k, 4] = c * window[k, 3] - s * window[k, 4], s * window[k, 3] + c * window[k, 4]
        path[k, 5] = window[k, 5]


CATALOGUE: dict[str, AngleFusion] = {
    "AngleFusion": AngleFusion(),
    "AngleFusionClutter": AngleFusion(clutter_mean=8.0, availability0_min=0.3, availability1_min=0.3),
    "AngleFusionSlow": AngleFusion(max_turn_rate_deg_s=1.0),
}
"""This module's scenarios by name; each becomes the environment ``passive/NAME-v0``."""
