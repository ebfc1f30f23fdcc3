"""A target that maneuvers hard, tracked from position fixes whose covariance depends on where the stations are.

The tracker is that of Sheng et al. (2009), interacting filters with modified input estimation; azimuths from stations
that move feed it.

Station s is any direction finder; the last one is the reference, from which ranges are counted.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, ClassVar

import numpy as np

from passive_env.actions import Continuous, Discrete, HeadingsAndSpeeds
from passive_env.catalogue.bearings import place_flight
from passive_env.catalogue.tracking import TrackingScenario
from passive_env.kinematics import MANEUVER_UNIFORMS, STANDING_M_S, drive, maneuver, random_maneuvers
from passive_env.layers import Instant
from passive_env.maneuver_metrics import ManeuverFigures
from passive_env.maneuver_observation import ManeuverObservation
from passive_env.maneuver_sensors import AzimuthSensors
from passive_env.maneuver_tape import ManeuverTape
from passive_env.own_observation import OwnObservation
from passive_env.scenario import choice, free, integer, number
from passive_env.tape import Reader, draw
from passive_env.team import Steering, kind_by_kind
from passive_env.truth import ManeuverTruthObservation
from trackers import MANEUVER_TRACKERS
from trackers.compiled import kernel
from trackers.fix_contract import ManeuverTracker
from trackers.imm_mie import MIXINGS, ImmMie

ACTIONS = ("continuous", "headings", "discrete")

OPENING_DEG = 85.0
"""Off the line of sight: where stations turn first when they open the baseline."""

CROSSING_WORTH = 2.25
"""Of `passive_env.steering.shorter_sides`: aircraft 2 km apart, at 250 m/s and 5°/s, cross to save 180° in sum.

Crossing pays later: on recorded flights, which turn less than drawn targets and often at once, nobody crosses. Tuned
with the angles of the strongest rule."""

START_UNIFORMS = 6
"""Uniform numbers of an episode's start besides the stations' headings: line of sight, range, tilt of the baseline,
target's course, speed, recorded flight."""

PAPER_MIDDLE_M = (3e3, -20e3)
"""Middle of the stations' baseline, which runs east, with the paper's tracks. The specification gives the north
coordinate only; abreast of the middle of the second track's first leg, and not of its ends, the errors of fixes and of
turns are its own within 8 %."""

PAPER_VELOCITY_M_S = {"paper1": (100.0, 100.0), "paper2": (300.0, 0.0)}
"""Of the target, which starts at the origin."""

PAPER_TURN_S, PAPER_TURN_RAD_S = (20.0, 50.0), 0.1
"""Second track: a turn of 30 m/s² and 3000 m radius."""

FLIGHT_TURN_M_S2 = 3.0
"""Horizontal acceleration from which a recorded aircraft counts as turning."""


@dataclass(frozen=True, kw_only=True)
class ManeuveringTarget(TrackingScenario):
    """Two to four stations steer and choose their speed; their tracker fixes a target that turns hard.

    The stations stand, at first, evenly spaced along a baseline, each on a heading of its own. Drawn per episode,
    uniformly (course "random"): the line of sight to the target, its range from the middle of the baseline, the
    baseline's tilt off the perpendicular to it, the target's course and speed, and its maneuvers: after a quiet time it
    turns, at a lateral acceleration drawn and for a time drawn, or (1 − ``turn_share``) goes to another speed drawn,
    then flies straight again, and so on. Courses "paper1" and "paper2" are the paper's two tracks with the stations
    20 km south of them, "flights" recorded aircraft on a drawn course from a drawn place.

    Action: turn rates of all stations as shares of the limit, then their speeds, −1 the least and +1 the top speed. A
    station has its speed from the step's beginning on and may turn on the spot. With actions "headings" the first
    numbers are headings to turn to, as shares of 180° off the own line of sight, positive to the side on which the
    baseline is sooner opened (`passive_env.actions.HeadingsAndSpeeds`, ``crossing_worth``). With carrier "ground" a
    station measures only after a step driven at ``measuring_speed_m_s`` at most; a scan of fewer than two azimuths has
    no fix.
    Observation: `passive_env.maneuver_observation.ManeuverObservation`.
    info: besides what every environment shows ``position_crlb_m``, ``acceleration_error_m_s2``, ``fix_error_m``,
        ``maneuvering``, ``fixed``, each [1], ``acceleration`` [1, 2] (estimated), ``model_probability`` and
        ``detected``, each [1, models].
    Bound: for a target of constant velocity that a white acceleration of ``bound_acceleration_m_s2`` per axis and step
        disturbs, known to 200 m/s per axis at first.
    """

    trackers: ClassVar[Mapping[str, Any]] = MANEUVER_TRACKERS
    tracker_verbs: ClassVar[tuple[str, ...]] = ("acceleration",)
    targets: ClassVar[int] = 1
    score: ClassVar[str] = "position"
    ordered: ClassVar[tuple[tuple[str, str], ...]] = (
        ("range_min_m", "range_max_m"),
        ("target_speed_min_m_s", "target_speed_max_m_s"),
        ("quiet_min_s", "quiet_max_s"),
        ("maneuver_min_s", "maneuver_max_s"),
        ("target_acceleration_min_m_s2", "target_acceleration_max_m_s2"),
        ("min_speed_m_s", "max_speed_m_s"),
    )

    stations: int = integer(2, 2, 4, "number of stations")
    course: str = choice(
        "random", ("random", "flights", "paper1", "paper2"), "target motion: drawn, recorded flights, a paper's track"
    )
    steps: int = integer(70, 1, 10_000, "decisions per episode")
    step_s: float = number(1.0, 0.1, 60.0, "time between scans")
    carrier: str = choice("aircraft", ("aircraft", "ground"), "what stations are; on the ground they stop to measure")
    max_speed_m_s: float = number(250.0, 1.0, 1000.0, "top speed of aircraft")
    ground_speed_m_s: float = number(25.0, 0.1, 100.0, "top speed of ground stations")
    min_speed_m_s: float = number(0.0, 0.0, 1000.0, "least speed of either; 0 lets them stand")
    measuring_speed_m_s: float = number(1.0, 0.0, 100.0, "largest speed at which a ground station measures")
    baseline_m: float = number(2e3, 10.0, 1e5, "distance between the outer stations at first")
    baseline_tilt_deg: float = number(30.0, 0.0, 90.0, "largest drawn angle between baseline and perpendicular")
    azimuth_std_mrad: float = number(1.0, 1e-3, 200.0, "azimuth noise")
    detection_probability: float = number(1.0, 0.01, 1.0, "of the target by a station, after the first scan")
    tracker: Any = free("imm_mie", f"{' or '.join(MANEUVER_TRACKERS)}, or an object with the tracker contract")
    mixing: str = choice("literal", MIXINGS, "how imm_mie mixes its filters: the paper's way, or a repair")
    range_floor_m: float = number(5e3, 1.0, 1e7, "the tracker's prior of range, where azimuths do not fix it: 95 % …")
    range_cap_m: float = number(1e5, 1.0, 1e7, "… lie between these two")
    initial_velocity_std_m_s: float = number(200.0, 1.0, 1e4, "the tracker's prior of velocity, per axis")
    standoff_m: float = number(0.0, 0.0, 1e5, "distance stations should keep from the target; 0 for none")
    range_min_m: float = number(15e3, 1e3, 1e6, "nearest drawn start of the target from the middle of the baseline")
    range_max_m: float = number(30e3, 1e3, 1e6, "farthest")
    target_speed_min_m_s: float = number(150.0, 1.0, 2000.0, "slowest drawn target, also after a change of speed")
    target_speed_max_m_s: float = number(350.0, 1.0, 2000.0, "fastest")
    turn_share: float = number(0.75, 0.0, 1.0, "share of drawn maneuvers that are turns, not changes of speed")
    target_acceleration_min_m_s2: float = number(10.0, 0.1, 200.0, "least drawn acceleration of a maneuver")
    target_acceleration_max_m_s2: float = number(30.0, 0.1, 200.0, "largest")
    target_turn_max_rad_s: float = number(0.1, 1e-3, 1.0, "fastest turn of a drawn target")
    quiet_min_s: float = number(5.0, 1.0, 1e5, "shortest time between drawn maneuvers")
    quiet_max_s: float = number(20.0, 1.0, 1e5, "longest")
    maneuver_min_s: float = number(5.0, 1.0, 1e5, "shortest drawn turn")
    maneuver_max_s: float = number(30.0, 1.0, 1e5, "longest drawn turn or change of speed")
    flight_turn_s: float = number(
        0.0, 0.0, 1e4, f"recorded windows turn, harder than {FLIGHT_TURN_M_S2:g} m/s², for at least this long"
    )
    bound_acceleration_m_s2: float = number(10.0, 0.0, 500.0, "acceleration the Cramér–Rao bound's target has")
    lost_error_m: float = number(1e3, 1.0, 1e6, "a track is lost if farther off than this …")
    lost_nees: float = number(23.5, 1.0, 1e9, "… and its NEES exceeds this (99.99 % of χ² with 4 degrees)")
    actions: str = choice("continuous", ACTIONS, "Box of rates, of headings (speeds in either), or 3 of each kind")
    reward_log_range_error: float = number(0.0, 0.0, 1e6, "weight")
    reward_log_position_error: float = number(1.0, 0.0, 1e6, "weight")
    reward_relative_position_error: float = number(0.0, 0.0, 1e6, "weight")
    reward_position_error: float = number(0.0, 0.0, 1e6, "weight")
    reward_final_position_error: float = number(0.0, 0.0, 1e6, "weight")
    reward_turn_position_error: float = number(0.0, 0.0, 1e6, "weight")
    reward_acceleration_error: float = number(0.2, 0.0, 1e6, "weight")
    reward_log_position_bound: float = number(0.0, 0.0, 1e6, "weight")

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.min_speed_m_s > self.top_speed_m_s:
            raise self._error("min_speed_m_s", f"must not exceed ground_speed_m_s = {self.ground_speed_m_s}")
        if self.carrier == "ground" and self.min_speed_m_s > self.measuring_speed_m_s:
            raise self._error(
                "min_speed_m_s", f"stations that never drive at measuring_speed_m_s = {self.measuring_speed_m_s} or "
                "slower never measure: must not exceed it with carrier='ground'",
            )  # fmt: skip
        if self.flight_turn_s > 0.0 and self.course != "flights":
            raise self._error("flight_turn_s", f"is not used with course={self.course!r}; add course='flights'")
        if self.flight_turn_s > self.steps * self.step_s:
            raise self._error("flight_turn_s", f"an episode lasts {self.steps * self.step_s:g} s: must not exceed this")
        if self.mixing != "literal" and self.tracker != "imm_mie":
            raise self._error("mixing", f"is not used with tracker={self.tracker!r}; add tracker='imm_mie'")
        gap = self._nearest_m
        if self.standoff_m > gap:
            raise self._error("standoff_m", f"stations may start {gap:.0f} m from the target: must not exceed this")

    @property
    def _nearest_m(self) -> float:
        """Lower limit of the distance of a station from the target at first."""
        if self.course in PAPER_VELOCITY_M_S:
            return math.hypot(max(PAPER_MIDDLE_M[0] - 0.5 * self.baseline_m, 0.0), PAPER_MIDDLE_M[1])
        return max(self.range_min_m - 0.5 * self.baseline_m, 0.0)

    @property
    def top_speed_m_s(self) -> float:
        """Speed of a station at action +1."""
        return self.max_speed_m_s if self.carrier == "aircraft" else self.ground_speed_m_s

    @property
    def measuring_speed_limit_m_s(self) -> float:
        """Speed above which a station does not measure."""
        return math.inf if self.carrier == "aircraft" else max(self.measuring_speed_m_s, STANDING_M_S) * (1.0 + 1e-9)

    @property
    def crossing_worth(self) -> float:
        """Steps of turning that one step on the way across must save (`shorter_sides`); infinite: nobody crosses."""
        return math.inf if self.course == "flights" else CROSSING_WORTH

    # -- the parts the core asks for ---------------------------------------------------------------------------------

    @property
    def tracker_settings(self) -> dict[str, Any]:
        """Keywords of the named tracker."""
        common = {
            "initial_velocity_std": self.initial_velocity_std_m_s, "floor_m": self.range_floor_m,
            "cap_m": self.range_cap_m,
        }  # fmt: skip
        return common | ({"mixing": self.mixing} if issubclass(MANEUVER_TRACKERS[self.tracker], ImmMie) else {})

    def make_tracker(self) -> ManeuverTracker:
        """The tracker object; a name is made with this scenario's settings.

        Raises:
            ValueError: unknown name; TypeError: an object that lacks a verb of the contract or its number of models.
        """
        tracker = super().make_tracker()
        models = getattr(tracker, "models", None)
        if not isinstance(models, int) or models < 1:
            raise TypeError(f"tracker {tracker!r}: models is {models!r}, must be its number of models, 1 or more")
        return tracker

    def make_actions(self) -> Continuous | Discrete:
        """Action codec: turn rates of all stations, or headings to turn to, then speeds."""
        odd = [True] * self.stations + [False] * self.stations
        if self.actions == "headings":
            turn_per_step = math.radians(self.max_turn_rate_deg_s) * self.step_s
            return HeadingsAndSpeeds(
                len(odd), self.stations, turn_per_step, odd, way_per_step=self.top_speed_m_s * self.step_s,
                opening_angle=math.radians(OPENING_DEG), crossing_worth=self.crossing_worth,
            )  # fmt: skip
        return Continuous(len(odd), odd) if self.actions == "continuous" else Discrete(len(odd), odd=odd)

    def make_observation(self) -> ManeuverObservation:
        """Observation model."""
        return ManeuverObservation(self.stations, self.steps, self.make_tracker().models, self.top_speed_m_s)

    @property
    def steering(self) -> Steering:
        """Turn rate and speed per station; one that idles goes straight on at the least speed."""
        return kind_by_kind(self.stations, (0.0, -1.0))

    def make_own_observation(self) -> OwnObservation:
        """What every station knows by itself."""
        return OwnObservation(self.steering.columns, self.steps, 1, place_unit_m=2e3, top_speed_m_s=self.top_speed_m_s)

    def make_truth_observation(self) -> ManeuverTruthObservation:
        """What a critic may know in training."""
        return ManeuverTruthObservation(self.step_s, self.reference)

    def make_sensors(self, tracker: ManeuverTracker) -> AzimuthSensors:
        """The stations' direction finders."""
        return AzimuthSensors(tracker, 1e-3 * self.azimuth_std_mrad, self.measuring_speed_limit_m_s)

    def make_metrics(self) -> ManeuverFigures:
        """Figures of merit."""
        return ManeuverFigures(self)

    def make_scene(self, figure: Any) -> Any:
        """The view from above, accelerations and model probabilities, in a matplotlib figure."""
        from passive_env.render_maneuver import ManeuverScene

        return ManeuverScene(figure, self)

    def make_instants(self, world: Any, simulation: Any) -> list[Instant]:
        """What there is to see of a world (a batch of one), as plain numbers."""
        from passive_env.render_maneuver import maneuver_instants

        return maneuver_instants(world, simulation)

    def move(self, platforms, command):
        """Stations [e, s, 4] after one step of commands [e, 2 s] in [−1, 1]: turns, then speeds."""
        rates = command[..., : self.stations] * math.radians(self.max_turn_rate_deg_s)
        share = 0.5 * (command[..., self.stations :] + 1.0)
        return drive(
            platforms, rates, self.min_speed_m_s + (self.top_speed_m_s - self.min_speed_m_s) * share, self.step_s
        )

    def draw_tape(self, generators: Sequence[np.random.Generator]) -> ManeuverTape:
        """Tapes of len(generators) episodes, row i from generator i."""
        k, s, n = self.steps + 1, self.stations, self._legs
        noisy = 2 * self.steps if self.course == "paper1" else 0
        dropouts = k * s if self.detection_probability < 1.0 else 0
        z, u = draw(generators, k * s + noisy, START_UNIFORMS + s + n * MANEUVER_UNIFORMS + dropouts)
        take = Reader(u)
        place = take((len(u), START_UNIFORMS + s))
        platforms, start = self._draw_starts(place)
        targets, acceleration = self._draw_paths(
            start, take((len(u), n, MANEUVER_UNIFORMS)), place[:, START_UNIFORMS - 1], z[:, k * s :]
        )
        detected = np.ones((len(u), k, s), dtype=bool)
        if dropouts:
            detected[:, 1:] = take((len(u), k, s))[:, 1:] < self.detection_probability
        return ManeuverTape(
            platforms, targets[:, :, None], acceleration[:, :, None], np.empty((len(u), 0, 3)),
            np.ascontiguousarray(z[:, : k * s]).reshape(-1, k, s), detected,
        )  # fmt: skip

    # -- drawing -----------------------------------------------------------------------------------------------------

    @property
    def _legs(self) -> int:
        """Legs drawn per target: enough for an episode of shortest ones."""
        return math.ceil(self.steps * self.step_s / self.quiet_min_s) if self.course == "random" else 0

    @cached_property
    def _flight_rows(self) -> np.ndarray:
        """Rows of the recorded flights at which a window may start."""
        return self.flight_paths.turning_starts(self.steps, FLIGHT_TURN_M_S2, self.flight_turn_s)

    def check_flights(self) -> None:
        """Load the recorded flights now (see the base), and make sure that some of them turn long enough."""
        super().check_flights()
        if self.course == "flights" and not len(self._flight_rows):
            raise self._error(
                "flight_turn_s", f"no window of {self.steps} steps of {self.flight_paths.source}, part "
                f"{self.flight_split!r}, turns that long: take less",
            )  # fmt: skip

    def _draw_starts(self, u: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Stations [e, s, 4] and targets [e, 4] at first, from uniforms [e, START_UNIFORMS + s]."""
        limits = np.array(
            [
                self.range_min_m, self.range_max_m, math.radians(self.baseline_tilt_deg), self.target_speed_min_m_s,
                self.target_speed_max_m_s, self.baseline_m, max(self.min_speed_m_s, STANDING_M_S),
            ]
        )  # fmt: skip
        platforms, start = _random_starts(u, limits, np.empty((self.stations, 4)))
        if self.course in PAPER_VELOCITY_M_S:
            share = np.linspace(-0.5, 0.5, self.stations)
            platforms[..., 0], platforms[..., 1] = PAPER_MIDDLE_M[0] + self.baseline_m * share, PAPER_MIDDLE_M[1]
            start = np.tile((0.0, 0.0, *PAPER_VELOCITY_M_S[self.course]), (len(u), 1))
        return platforms, start

    def _draw_paths(self, start, legs, pick, z) -> tuple[np.ndarray, np.ndarray]:
        """Paths [e, k + 1, 4] and accelerations [e, k + 1, 2] from starts [e, 4], uniforms and normals [e, 2 k]."""
        axis = np.empty(self.steps + 1)
        if self.course == "random":
            limits = np.array(
                [
                    self.quiet_min_s, self.quiet_max_s, self.maneuver_min_s, self.maneuver_max_s,
                    self.target_acceleration_min_m_s2, self.target_acceleration_max_m_s2, self.target_turn_max_rad_s,
                    self.target_speed_min_m_s, self.target_speed_max_m_s, self.turn_share,
                ]
            )  # fmt: skip
            return random_maneuvers(start, legs, limits, self.step_s, axis)
        if self.course == "flights":
            rows = self._flight_rows
            at = rows[np.minimum((pick * len(rows)).astype(np.intp), len(rows) - 1)]
            paths = place_flight(start, self.flight_paths.states[at[:, None] + np.arange(self.steps + 1)])
            return paths, np.gradient(paths[..., 2:], self.step_s, axis=1)
        if self.course == "paper1":
            return paper_acceleration_path(start, z.reshape(len(start), self.steps, 2), self.step_s)
        window, never = np.array(PAPER_TURN_S), np.zeros(2)
        paths = maneuver(start, PAPER_TURN_RAD_S, window, 0.0, never, self.step_s, axis)
        time_s = self.step_s * np.arange(self.steps + 1)
        turning = (time_s >= window[0]) & (time_s < window[1])
        left = np.stack([-paths[..., 3], paths[..., 2]], axis=-1)
        return paths, PAPER_TURN_RAD_S * turning[:, None] * left


def paper_acceleration(time_s: np.ndarray) -> np.ndarray:
    """Eastward acceleration [...] m/s² of the paper's first track.

    0 until 15 s, 20 m/s² until 40 s, then 10 cos(π (t − 40) / 40) + 10 until it reaches 0 at 80 s. (With the absolute
    time that is printed it would jump to 0.)
    Source: Sheng et al. (2009), section 4, as the specification reads it.
    """
    falling = 10.0 * np.cos(math.pi * (time_s - 40.0) / 40.0) + 10.0
    return np.select([time_s < 15.0, time_s < 40.0, time_s < 80.0], [0.0, 20.0, falling], 0.0)


def paper_acceleration_path(start, noise, step_s: float) -> tuple[np.ndarray, np.ndarray]:
    """The paper's first track with its perturbation, a white acceleration of 1 m/s² per axis, and accelerations.

        x(k) = F x(k−1) + C [u(k−1) + w(k−1)],   C = [T²/2; T] per axis

    Args:
        start: [e, 4] m, m/s; noise: [e, k, 2] w, standard normal; step_s: s.
    Returns:
        [e, k + 1, 4] states and [e, k + 1, 2] m/s² accelerations u, the perturbation left out.
    """
    e, steps, _ = noise.shape
    u = np.zeros((e, steps + 1, 2))
    u[..., 0] = paper_acceleration(step_s * np.arange(steps + 1))
    gained = step_s * np.cumsum(u[:, :-1] + noise, axis=1)
    velocity = np.concatenate([start[:, None, 2:], start[:, None, 2:] + gained], axis=1)
    moved = np.cumsum(0.5 * step_s * (velocity[:, :-1] + velocity[:, 1:]), axis=1)
    position = np.concatenate([start[:, None, :2], start[:, None, :2] + moved], axis=1)
    return np.concatenate([position, velocity], axis=-1), u


@kernel("(c),(l),(s,x)->(s,x),(x)")
def _random_starts(u, limits, like, platforms, start):
    """Stations about the origin at their least speed, and the target's start."""
    two_pi = 2.0 * math.pi
    sight = two_pi * u[0]
    distance = limits[0] + (limits[1] - limits[0]) * u[1]
    along = sight + 0.5 * math.pi + limits[2] * (2.0 * u[2] - 1.0)
    course, speed = two_pi * u[3], limits[3] + (limits[4] - limits[3]) * u[4]
    start[0], start[1] = distance * math.cos(sight), distance * math.sin(sight)
    start[2], start[3] = speed * math.cos(course), speed * math.sin(course)
    n = platforms.shape[0]
    for s in range(n):
        offset = limits[5] * (s / (n - 1.0) - 0.5)
        heading = two_pi * u[6 + s]
        platforms[s, 0], platforms[s, 1] = offset * math.cos(along), offset * math.sin(along)
        platforms[s, 2], platforms[s, 3] = limits[6] * math.cos(heading), limits[6] * math.sin(heading)


CATALOGUE: dict[str, ManeuveringTarget] = {"ManeuveringTarget": ManeuveringTarget()}
"""This module's scenarios by name; each becomes the environment ``passive/NAME-v0``."""
