"""A passive radar: transmitters of opportunity light up a target, one receiver chooses which of them to listen to.

The tracker is that of Xu and Wang (2009), an extended Kalman filter on range sums. Which transmitters, and where the
receiver is, decides how well it does.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, ClassVar

import numpy as np

from passive_env.actions import Combinations, Continuous, Headings, LeadsAndCombinations
from passive_env.blockage import Stretches, blocked
from passive_env.catalogue.angle_fusion import place_flight_in_space
from passive_env.catalogue.bearings import place_flight
from passive_env.catalogue.tracking import TrackingScenario
from passive_env.kinematics import MANEUVER_UNIFORMS, in_dimensions, plan_view, random_maneuvers, turn, turn_and_climb
from passive_env.layers import Instant
from passive_env.radar_courses import corridor, disturbed
from passive_env.radar_metrics import RadarFigures
from passive_env.radar_observation import FORESEEN_SCANS, RadarObservation
from passive_env.radar_promise import Foresight, Promise
from passive_env.radar_sensors import Receiver, SumReceiver
from passive_env.radar_simulation import RadarSimulation
from passive_env.radar_sites import PAPER_SITES_M, SITE_NAMES, checked_sites, draw_transmitters
from passive_env.radar_tape import Echoes, RadarTape
from passive_env.scenario import choice, flag, free, integer, number
from passive_env.tape import Reader, draw
from passive_env.truth import RadarTruthObservation
from trackers import RANGE_SUM_TRACKERS

START_UNIFORMS = 7
"""Uniform numbers of an episode's start: corridor's direction, distance and way along it, speed, altitude, recorded
flight, receiver's heading."""

PAPER_TARGET = (-100e3, 150e3, 10e3, 200.0, -100.0, 0.0)
PAPER_GUESS = (-80e3, 130e3, 8e3, 0.0, 0.0, 0.0)
PAPER_GUESS_STD_M = 20e3
"""State at the first scan of the paper's track, and the guess with what it may be off, per level axis."""

RESTART_STD_M, START_TURNING_M_S2 = 10e3, 1.0
"""How far off a lost track is looked for, and the mean acceleration that a target may have had while its track started,
where targets turn."""


@dataclass(frozen=True, kw_only=True)
class PassiveRadar(TrackingScenario):
    """A receiver hears, per scan, the echoes of some transmitters of a pool; from their range sums a target is tracked.

    Drawn per episode, uniformly (sites "random"): azimuth, distance and height of every transmitter about the
    receiver, which is the origin then; the target's corridor, a straight line whose direction, distance from the origin
    and point of entry are drawn, and its speed. White accelerations disturb its flight; with ``maneuvers`` it also
    turns and changes its speed, now and then. Course "paper" is the paper's, "flights" recorded aircraft that enter
    the corridor. An echo is missed with a probability (1 − ``echo_probability``), and every transmitter is blocked for
    a while now and then; both are observed as misses only of those listened to.

    Before the first decision the receiver listens to all transmitters in turn for ``acquisition_scans``; from these,
    and an operator's coarse guess of the target's state, the track is started.

    Action: a score per transmitter, the ``channels`` highest are listened to (of equal ones the first); before them,
    where the receiver moves (``receiver_speed_m_s``), its turn, or with actions "headings" the heading to turn to off
    the line of sight. Discrete: the number of a combination of transmitters, in lexicographic order; before it, where
    the receiver moves, that of one of eleven courses off lead pursuit. A newly chosen transmitter's echo comes
    ``retune_delay_s`` after the choice at the earliest.
    Observation: `passive_env.radar_observation.RadarObservation`.
    info: besides what every environment shows ``position_crlb_m, horizontal_error_m, horizontal_crlb_m,
        height_error_m, height_crlb_m, maneuver``, each [1], and ``chosen, answered, missed, blocked`` (the truth),
        ``blocked_probability``, each [transmitters].
    Bound: knows of the target what the operator does before the first scan, and every echo that comes back.
    """

    trackers: ClassVar[Mapping[str, Any]] = RANGE_SUM_TRACKERS
    targets: ClassVar[int] = 1
    score: ClassVar[str] = "position"
    ordered: ClassVar[tuple[tuple[str, str], ...]] = (
        ("site_range_min_m", "site_range_max_m"),
        ("corridor_offset_min_m", "corridor_offset_max_m"),
        ("corridor_start_min_m", "corridor_start_max_m"),
        ("altitude_min_m", "altitude_max_m"),
        ("target_speed_min_m_s", "target_speed_max_m_s"),
        ("blocked_min_s", "blocked_max_s"),
        ("clear_min_s", "clear_max_s"),
        ("quiet_min_s", "quiet_max_s"),
        ("maneuver_min_s", "maneuver_max_s"),
        ("target_acceleration_min_m_s2", "target_acceleration_max_m_s2"),
    )

    sight: ClassVar[tuple[str, ...]] = ("promised_scans", "durations_known")
    settled_s: ClassVar[float] = 50.0
    """Time after which evaluations take a track to have settled."""
    range_floor_m: ClassVar[float] = 0.0
    range_cap_m: ClassVar[float] = math.inf
    """Ranges are measured: the tracker needs no prior of them."""

    dimensions: int = integer(2, 2, 3, "2: everything in a plane; 3: in space")
    course: str = choice(
        "random", ("random", "flights", "paper"), "target motion: drawn, recorded flights, the paper's"
    )
    steps: int = integer(300, 1, 10_000, "decisions per episode")
    step_s: float = number(1.0, 0.1, 60.0, "time between scans")
    sites: Any = free("random", "random, paper_poor, paper_good, or coordinates [m] of receiver, then transmitters")
    transmitters: int = integer(8, 3, 16, "size of a drawn pool")
    channels: int = integer(0, 0, 16, "transmitters listened to in a scan; 0: as many as there are dimensions")
    site_range_min_m: float = number(20e3, 1e3, 1e6, "nearest drawn transmitter from the receiver")
    site_range_max_m: float = number(100e3, 1e3, 1e6, "farthest")
    site_height_max_m: float = number(300.0, 0.0, 1e4, "highest drawn transmitter, in space")
    retune_delay_s: float = number(0.0, 0.0, 60.0, "time from a choice to a newly chosen transmitter's first echo")
    receiver_speed_m_s: float = number(0.0, 0.0, 1000.0, "0: the receiver stands and has no turn in its action")
    range_sum_std_m: float = number(200.0, 1.0, 1e4, "noise of range sums")
    std_range_m: float = number(
        0.0, 0.0, 1e6, "noise goes with the product of the target's ranges from receiver and transmitter and is the "
        "nominal one where both are this; 0: the same everywhere",
    )  # fmt: skip
    std_floor_m: float = number(20.0, 1.0, 1e4, "least noise where it goes with the ranges")
    echo_probability: float = number(0.8, 0.01, 1.0, "of a transmitter that is not blocked")
    blocked_min_s: float = number(30.0, 0.0, 1e4, "shortest time for which a transmitter is blocked")
    blocked_max_s: float = number(60.0, 0.0, 1e4, "longest; 0: never")
    clear_min_s: float = number(30.0, 1.0, 1e5, "shortest time between")
    clear_max_s: float = number(60.0, 1.0, 1e5, "longest")
    acquisition_scans: int = integer(20, 1, 100, "scans, all transmitters in turn, from which the track is started")
    guess_position_std_m: float = number(
        5e3, 1.0, 1e6, "error of the operator's guess, per level axis; with the paper's course at least 20 km"
    )
    guess_velocity_std_m_s: float = number(200.0, 0.1, 1e4, "the same of velocity")
    guess_height_std_m: float = number(3e3, 1.0, 1e5, "error of the guessed height, in space")
    guess_climb_std_m_s: float = number(10.0, 0.1, 1e3, "the same of the vertical velocity")
    process_noise_m_s2: float = number(
        1.0, 0.0, 50.0, "white level acceleration per axis, of drawn targets and tracker"
    )
    climb_noise_m_s2: float = number(0.1, 0.0, 50.0, "the same of the vertical one")
    tracker: Any = free("ekf", f"{', '.join(RANGE_SUM_TRACKERS)}, or an object with the tracker contract")
    corridor_offset_min_m: float = number(
        5e3, 0.0, 1e6, "least drawn distance of the target's corridor from the origin"
    )
    corridor_offset_max_m: float = number(60e3, 0.0, 1e6, "largest")
    corridor_start_min_m: float = number(0.0, 0.0, 1e6, "least drawn way to the corridor's nearest point at first")
    corridor_start_max_m: float = number(60e3, 0.0, 1e6, "largest")
    altitude_min_m: float = number(5e3, 0.0, 1e5, "lowest drawn target, in space")
    altitude_max_m: float = number(12e3, 0.0, 1e5, "highest")
    target_speed_min_m_s: float = number(150.0, 1.0, 2000.0, "slowest drawn target, also after a change of speed")
    target_speed_max_m_s: float = number(250.0, 1.0, 2000.0, "fastest")
    maneuvers: bool = flag(False, "drawn targets turn and change their speed")
    turn_share: float = number(0.75, 0.0, 1.0, "share of maneuvers that are turns, not changes of speed")
    target_acceleration_min_m_s2: float = number(5.0, 0.1, 200.0, "least drawn acceleration of a maneuver")
    target_acceleration_max_m_s2: float = number(30.0, 0.1, 200.0, "largest")
    target_turn_max_rad_s: float = number(0.1, 1e-3, 1.0, "fastest turn")
    quiet_min_s: float = number(30.0, 1.0, 1e5, "shortest time between maneuvers")
    quiet_max_s: float = number(90.0, 1.0, 1e5, "longest")
    maneuver_min_s: float = number(5.0, 1.0, 1e5, "shortest turn")
    maneuver_max_s: float = number(20.0, 1.0, 1e5, "longest turn or change of speed")
    lost_error_m: float = number(3e3, 1.0, 1e6, "a track is lost if farther off than this …")
    lost_nees: float = number(27.9, 1.0, 1e9, "… and its NEES exceeds this (99.99 % of χ² with 6 degrees, as in space)")
    actions: str = choice(
        "continuous",
        ("continuous", "headings", "discrete"),
        "Box of scores and a turn or heading, or combinations and courses off lead pursuit",
    )
    promised_scans: int = integer(
        0, 0, 100, "the error that each combination promises if it is kept for so many scans is observed; 0: it is not"
    )
    durations_known: bool = flag(
        False, "chances to be clear in the scans to come are observed, and promises made, by the belief that knows how "
        "long stretches last",
    )  # fmt: skip
    reward_log_range_error: float = number(0.0, 0.0, 1e6, "weight")
    reward_log_horizontal_error: float = number(1.0, 0.0, 1e6, "weight")
    reward_horizontal_error: float = number(0.0, 0.0, 1e6, "weight")
    reward_height_error: float = number(0.0, 0.0, 1e6, "weight")
    reward_log_horizontal_bound: float = number(0.0, 0.0, 1e6, "weight")
    reward_log_position_error: float = number(0.0, 0.0, 1e6, "weight")
    reward_position_error: float = number(0.0, 0.0, 1e6, "weight")
    reward_final_position_error: float = number(0.0, 0.0, 1e6, "weight")
    reward_log_position_bound: float = number(0.0, 0.0, 1e6, "weight")
    reward_position_gain: float = number(0.0, 0.0, 1e6, "weight")

    def __post_init__(self) -> None:
        self._check_sites()
        super().__post_init__()
        if self.listened > self.pool:
            raise self._error("channels", f"there are {self.pool} transmitters: must not exceed this")
        if self.blocked_min_s == 0.0 < self.blocked_max_s:
            raise self._error("blocked_min_s", "must be above 0, or blocked_max_s = 0 for no blockage")
        if self.maneuvers and self.course != "random":
            raise self._error("maneuvers", f"is not used with course={self.course!r}; leave it out")
        if self.standoff_m > self._nearest_m:
            raise self._error(
                "standoff_m", f"the target may start {self._nearest_m:.0f} m from the receiver: must not exceed this"
            )

    def _check_sites(self) -> None:
        """Refuse layouts in which range sums cannot fix a position; keeps coordinates as tuples."""
        if isinstance(self.sites, str) and self.sites in SITE_NAMES:
            return
        try:
            object.__setattr__(self, "sites", checked_sites(self.sites, self.dimensions))
        except ValueError as error:
            raise self._error("sites", str(error)) from error

    # -- what follows from the fields ----------------------------------------------------------------------------------

    @property
    def stations(self) -> int:
        """Number of platforms: the receiver."""
        return 1

    @property
    def _nearest_m(self) -> float:
        """Lower limit of the target's level distance from the receiver at first."""
        if self.course == "paper":
            nearest = math.hypot(*PAPER_TARGET[:2])
        else:
            nearest = math.hypot(self.corridor_offset_min_m, self.corridor_start_min_m)
        aside = 0.0 if self._layout is None else math.hypot(*self._layout[0, :2])
        return max(nearest - aside, 0.0)

    @cached_property
    def pool(self) -> int:
        """Number of transmitters."""
        return self.transmitters if self._layout is None else len(self._layout) - 1

    @cached_property
    def listened(self) -> int:
        """Number of transmitters listened to in a scan."""
        return self.channels or min(self.dimensions, self.pool)

    @property
    def moves(self) -> bool:
        """Whether the receiver moves, and its turn or course leads the action."""
        return self.receiver_speed_m_s > 0.0

    @cached_property
    def combinations(self) -> np.ndarray:
        """[c, listened] transmitters of every choice, in the order of the discrete actions."""
        return np.array(list(itertools.combinations(range(self.pool), self.listened)))

    @cached_property
    def process_noise(self) -> tuple[float, float, float]:
        """Variances of the white acceleration east, north and up [(m/s²)²]."""
        return self.process_noise_m_s2**2, self.process_noise_m_s2**2, self.climb_noise_m_s2**2

    @cached_property
    def guess_std(self) -> np.ndarray:
        """[2d] m, m/s of the operator's guess."""
        least = PAPER_GUESS_STD_M if self.course == "paper" else 0.0
        level = max(self.guess_position_std_m, least)
        position = (level, level, self.guess_height_std_m)
        velocity = (self.guess_velocity_std_m_s, self.guess_velocity_std_m_s, self.guess_climb_std_m_s)
        return np.array([*position[: self.dimensions], *velocity[: self.dimensions]])

    @cached_property
    def stretches(self) -> Stretches:
        """For how long transmitters are blocked and clear."""
        return Stretches(self.blocked_min_s, self.blocked_max_s, self.clear_min_s, self.clear_max_s)

    @cached_property
    def _layout(self) -> np.ndarray | None:
        """Receiver and transmitters [1 + n, d] m where they are not drawn."""
        sites = PAPER_SITES_M.get(self.sites) if isinstance(self.sites, str) else self.sites
        return None if sites is None else np.array(sites)[:, : self.dimensions]

    # -- the parts the simulation asks for -----------------------------------------------------------------------------

    @property
    def tracker_settings(self) -> dict[str, Any]:
        """Keywords of the named tracker; the paper's own starts no track anew."""
        turns = self.course == "flights" or self.maneuvers
        restart = 0.0 if self.tracker == "ekf_literal" else RESTART_STD_M
        turning = START_TURNING_M_S2 if turns else 0.0
        return {"process_noise": self.process_noise, "restart_std_m": restart, "turning_m_s2": turning}

    def make_simulation(self) -> RadarSimulation:
        """The loop that runs this scenario's episodes."""
        return RadarSimulation(self)

    def make_actions(self) -> Continuous | Combinations:
        """Action codec: the receiver's turn, where it moves, then scores."""
        odd = [True] * self.moves + [False] * self.pool
        turn_per_step = math.radians(self.max_turn_rate_deg_s) * self.step_s
        if self.actions == "discrete":
            if self.moves:
                return LeadsAndCombinations(self.combinations, self.pool, turn_per_step)
            return Combinations(self.combinations, self.pool)
        if self.actions == "headings" and self.moves:
            return Headings(len(odd), 1, turn_per_step, odd)
        return Continuous(len(odd), odd)

    def make_observation(self) -> RadarObservation:
        """Observation model."""
        return RadarObservation(
            self.dimensions, self.pool, self.steps, self.moves, self.retune_delay_s, self.range_sum_std_m,
            self.std_range_m > 0.0,
            Promise(self, self.promised_scans, self.durations_known) if self.promised_scans else None,
            len(self.combinations), Foresight(self, FORESEEN_SCANS) if self.durations_known else None,
        )  # fmt: skip

    def make_truth_observation(self) -> RadarTruthObservation:
        """What a critic may know in training."""
        return RadarTruthObservation(self.pool)

    def make_sensors(self, tracker: Any) -> SumReceiver:
        """The receiver."""
        receiver = Receiver(
            self.listened, self.retune_delay_s, self.range_sum_std_m, self.std_range_m, self.std_floor_m,
            self.echo_probability, self.step_s,
        )  # fmt: skip
        return SumReceiver(tracker, receiver, self.stretches)

    def make_metrics(self) -> RadarFigures:
        """Figures of merit."""
        return RadarFigures(self)

    def make_scene(self, figure: Any) -> Any:
        """The map and the choices over time, in a matplotlib figure."""
        from passive_env.render_radar import RadarScene

        return RadarScene(figure, self)

    def make_instants(self, world: Any, simulation: Any) -> list[Instant]:
        """What there is to see of a world (a batch of one), as plain numbers."""
        from passive_env.render_radar import radar_instants

        return radar_instants(world, simulation)

    def move(self, platforms, command):
        """The receiver [e, 1, 2d] after one step of commands [e, a]: the first is its turn, where it moves."""
        if not self.moves:
            return platforms
        rate = command[:, :1] * math.radians(self.max_turn_rate_deg_s)
        if self.dimensions == 2:
            return turn(platforms, rate, self.step_s)
        return turn_and_climb(platforms, rate, np.zeros_like(rate), self.step_s, np.array([-math.inf, math.inf]))

    def draw_tape(self, generators: Sequence[np.random.Generator]) -> RadarTape:
        """Tapes of len(generators) episodes, row i from generator i; the target's does not depend on the pool."""
        d, a, e, n = self.dimensions, self.acquisition_scans, len(generators), self.pool
        instants, legs = a + self.steps, self._legs
        z, u = draw(generators, 2 * d + (instants - 1) * d, START_UNIFORMS + legs * MANEUVER_UNIFORMS)
        first_u = np.ascontiguousarray(u[:, :START_UNIFORMS])
        path, acceleration = self._draw_path(
            first_u, np.ascontiguousarray(u[:, START_UNIFORMS:]).reshape(e, legs, MANEUVER_UNIFORMS),
            np.ascontiguousarray(z[:, 2 * d :]).reshape(e, instants - 1, d),
        )  # fmt: skip
        guess = path[:, 0] + self.guess_std * z[:, : 2 * d]
        if self.course == "paper":
            guess[:] = in_dimensions(np.asarray(PAPER_GUESS), d)
        platforms = self._draw_receiver(first_u[:, 6])
        length = self.step_s * instants
        z, u = draw(generators, instants * n, n * (3 + self.stretches.uniforms(length)) + instants * n)
        take = Reader(u)
        transmitters = self._draw_transmitters(take((e, n, 3)))
        heard = take((e, instants, n)) < self.echo_probability
        hidden = blocked(take((e, n, self.stretches.uniforms(length))), self.stretches, self.step_s, instants)
        echoes = Echoes(path[:, :, None], z.reshape(e, instants, n), heard, hidden)
        first, later = (
            Echoes(*(np.ascontiguousarray(part[:, rows]) for part in echoes))
            for rows in (slice(0, a), slice(a - 1, None))
        )
        return RadarTape(
            platforms, np.empty((e, 0, 3)), transmitters, guess, *later,
            np.ascontiguousarray(acceleration[:, a - 1 :, None]), first,
        )  # fmt: skip

    def check_flights(self) -> None:
        """Load the recorded flights now (see the base); a flight lasts for the acquisition, too."""
        if self.course == "flights":
            self.flight_paths.window_starts(self.acquisition_scans + self.steps - 1)

    # -- drawing -------------------------------------------------------------------------------------------------------

    @property
    def _legs(self) -> int:
        """Legs drawn per target: enough for an episode of shortest ones."""
        flown = self.step_s * (self.acquisition_scans + self.steps)
        return math.ceil(flown / (self.quiet_min_s + self.maneuver_min_s)) if self.maneuvers else 0

    def _draw_path(self, u: np.ndarray, legs: np.ndarray, z: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Paths [e, t, 2d] and level accelerations [e, t, 2] from uniforms [e, START_UNIFORMS], legs, [e, t − 1, d]."""
        d, instants = self.dimensions, z.shape[1] + 1
        limits = np.array(
            [
                self.corridor_offset_min_m, self.corridor_offset_max_m, self.corridor_start_min_m,
                self.corridor_start_max_m, self.target_speed_min_m_s, self.target_speed_max_m_s, self.altitude_min_m,
                self.altitude_max_m,
            ]
        )  # fmt: skip
        start = corridor(u, limits, np.empty(6))
        if self.course == "flights":
            windows = self.flight_paths.windows(u[:, 5], instants - 1)
            path = place_flight(plan_view(start), windows) if d == 2 else place_flight_in_space(start, windows)
            return path, np.gradient(path[..., d : d + 2], self.step_s, axis=1)
        if self.course == "paper":
            start[:] = PAPER_TARGET
        level, acceleration = self._fly(plan_view(start), legs, instants)
        noise_std = np.sqrt(self.process_noise[:d])
        return disturbed(level, in_dimensions(start, d), z, noise_std, self.step_s), acceleration

    def _fly(self, start: np.ndarray, legs: np.ndarray, instants: int) -> tuple[np.ndarray, np.ndarray]:
        """Level paths [e, t, 4] and accelerations [e, t, 2] of undisturbed targets from starts [e, 4]."""
        if self.maneuvers:
            limits = np.array(
                [
                    self.quiet_min_s, self.quiet_max_s, self.maneuver_min_s, self.maneuver_max_s,
                    self.target_acceleration_min_m_s2, self.target_acceleration_max_m_s2, self.target_turn_max_rad_s,
                    self.target_speed_min_m_s, self.target_speed_max_m_s, self.turn_share,
                ]
            )  # fmt: skip
            return random_maneuvers(start, legs, limits, self.step_s, np.empty(instants))
        time_s = self.step_s * np.arange(instants)[:, None]
        velocity = np.broadcast_to(start[:, None, 2:], (len(start), instants, 2))
        path = np.concatenate([start[:, None, :2] + time_s * velocity, velocity], axis=-1)
        return path, np.zeros((len(start), instants, 2))

    def _draw_receiver(self, u: np.ndarray) -> np.ndarray:
        """Receivers [e, 1, 2d] at the first decision, on headings from uniforms [e]."""
        d = self.dimensions
        platforms = np.zeros((len(u), 1, 2 * d))
        if self._layout is not None:
            platforms[:, 0, :d] = self._layout[0]
        heading = 2.0 * math.pi * u
        platforms[:, 0, d] = self.receiver_speed_m_s * np.cos(heading)
        platforms[:, 0, d + 1] = self.receiver_speed_m_s * np.sin(heading)
        return platforms

    def _draw_transmitters(self, u: np.ndarray) -> np.ndarray:
        """Transmitters [e, n, d] from uniforms [e, n, 3]."""
        if self._layout is not None:
            return np.tile(self._layout[1:], (len(u), 1, 1))
        limits = np.array([self.site_range_min_m, self.site_range_max_m, self.site_height_max_m])
        return draw_transmitters(u, limits, np.empty(self.dimensions))


CATALOGUE: dict[str, PassiveRadar] = {
    "PassiveRadar": PassiveRadar(),
    "PassiveRadarRetune": PassiveRadar(retune_delay_s=5.0),
    "MobileReceiver": PassiveRadar(
        receiver_speed_m_s=200.0, std_range_m=50e3, actions="headings", tracker="ekf_second_order"
    ),
}
"""This module's scenarios by name; each becomes the environment ``passive/NAME-v0``."""
