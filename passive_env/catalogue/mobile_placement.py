"""Sensors as in RadarPlacement, on carriers that keep repositioning while the target is tracked."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, ClassVar

import numpy as np

from passive_env.actions import Continuous, Discrete
from passive_env.catalogue.entry import CLEAR_STD, COURSE_UNIFORMS, TASK_UNIFORMS, EntryScenario
from passive_env.catalogue.placement import LEVELS
from passive_env.layers import Instant
from passive_env.mobile_metrics import MobileFigures
from passive_env.mobile_observation import MobileObservation, OwnMobileObservation
from passive_env.mobile_sensors import RadarSensors
from passive_env.mobile_simulation import MobileSimulation
from passive_env.placement import Task
from passive_env.placement_simulation import PlacementTape
from passive_env.scenario import choice, integer, number
from passive_env.tape import draw
from passive_env.team import Steering, one_by_one
from passive_env.velocities import Velocities
from trackers.scan_fusion import MODES, ScanFusion

ACTIONS = ("continuous", "velocities", "discrete")


@dataclass(frozen=True, kw_only=True)
class MobilePlacement(EntryScenario):
    """Two to four sensors on carriers; the first action installs them, every later one says where they should go.

    A scan is taken at the end of every step. Carriers take the straight way to the places commanded, at no more than
    their speed, and stay there: a constant action is a static layout. What is drawn and told is as in RadarPlacement
    (`passive_env.catalogue.placement.RadarPlacement`), but sensors may stand much nearer to the entry, and the track
    lasts until the target has passed most of the way to the site or all of it. A sensor does not measure a target
    that is closer than ``minimum_range_m``.

    Action: per sensor azimuth, distance and height of the place it should go to, as in RadarPlacement: all at once.
        With actions "velocities", where to go from where it is (`passive_env.velocities.Velocities`).
    Observation: `passive_env.mobile_observation.MobileObservation`.
    Reward: the default is −log(position error / 1 km) in every step.
    info: besides what every environment shows ``position_crlb_m``, [1].
    Bound: the theoretical covariance of the fused filter along the true course, with the sensors where they are.
    """

    ordered: ClassVar[tuple[tuple[str, str], ...]] = (*EntryScenario.ordered, ("angle_only", "sensors"))

    sensors: int = integer(3, 2, 4, "number of sensors, each on a carrier")
    carrier: str = choice("airborne", ("airborne", "ground"), "what carries sensors; on the ground their height is 0")
    airborne_speed_m_s: float = number(150.0, 0.0, 1000.0, "top speed of airborne carriers, level")
    climb_rate_m_s: float = number(10.0, 0.0, 300.0, "fastest climb and descent of airborne carriers")
    ground_speed_m_s: float = number(20.0, 0.0, 100.0, "top speed of carriers on the ground")
    steps: int = integer(60, 1, 10_000, "decisions per episode, each followed by a scan")
    step_s: float = number(10.0, 0.1, 60.0, "time between scans")
    angle_only: int = integer(0, 0, 4, "how many sensors, the last ones, measure azimuth and elevation only")
    tracker: str = choice("fused", MODES, "where the fused filter takes bias and covariance of converted measurements")
    minimum_range_m: float = number(5e3, 1.0, 1e5, "a sensor does not measure a target closer than this")
    process_noise_m_s2: float = number(0.3, 0.0, 50.0, "white acceleration per axis, of drawn courses and the filter")
    azimuth_limit_min_deg: float = number(90.0, 0.0, 180.0, "least drawn limit of a sensor's azimuth; 180 is all round")
    nearest_min_m: float = number(40e3, 1e3, 1e6, "least drawn lower limit of a sensor's distance from the entry")
    nearest_max_m: float = number(100e3, 1e3, 1e6, "largest")
    height_limit_min_m: float = number(2e3, 0.0, 1e5, "least drawn limit of an airborne sensor's height")
    height_limit_max_m: float = number(15e3, 0.0, 1e5, "largest")
    lost_error_m: float = number(5e3, 1.0, 1e6, "a track is lost if farther off than this …")
    lost_nees: float = number(27.9, 1.0, 1e9, "… and its NEES exceeds this (99.99 % of χ² with 6 degrees)")
    actions: str = choice("continuous", ACTIONS, f"Box of places, of velocities, or {LEVELS} choices per number")
    reward_log_position_error: float = number(1.0, 0.0, 1e6, "weight")
    reward_log_position_bound: float = number(0.0, 0.0, 1e6, "weight")
    reward_position_gain: float = number(0.0, 0.0, 1e6, "weight")
    reward_position_error: float = number(0.0, 0.0, 1e6, "weight")
    reward_final_log_position_error: float = number(0.0, 0.0, 1e6, "weight")
    reward_final_position_error: float = number(0.0, 0.0, 1e6, "weight")
    reward_lost_track: float = number(0.0, 0.0, 1e6, "weight")

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.minimum_range_m < CLEAR_STD * self.range_std_max_m:
            raise self._error(
                "minimum_range_m", f"must be at least {CLEAR_STD:g} range_std_max_m = "
                f"{CLEAR_STD * self.range_std_max_m:g}, or a measured range might be negative",
            )  # fmt: skip
        if self.nearest_min_m < self.minimum_range_m:
            raise self._error(
                "nearest_min_m", "sensors installed there would not measure a target that enters: must be at least "
                f"minimum_range_m = {self.minimum_range_m:g}",
            )  # fmt: skip

    @property
    def stations(self) -> int:
        """Number of sensors."""
        return self.sensors

    @cached_property
    def ranging(self) -> np.ndarray:
        """[n] bool, whether a sensor measures range."""
        return np.arange(self.sensors) < self.sensors - self.angle_only

    @property
    def scans(self) -> int:
        """Scans of an episode."""
        return self.steps

    @property
    def speed_m_s(self) -> float:
        """Top speed of carriers, level."""
        return self.airborne_speed_m_s if self.carrier == "airborne" else self.ground_speed_m_s

    @property
    def climb_m_s(self) -> float:
        """Fastest climb and descent of carriers."""
        return self.climb_rate_m_s if self.carrier == "airborne" else 0.0

    # -- the parts the core asks for ---------------------------------------------------------------------------------

    def make_simulation(self) -> MobileSimulation:
        """The loop that runs this scenario's episodes."""
        return MobileSimulation(self)

    def make_tracker(self) -> ScanFusion:
        """The fused filter."""
        return ScanFusion(
            acceleration_std=self.process_noise_m_s2, linearisation=self.tracker,
            expected_range_m=self.entry_distance_m, minimum_range_m=self.minimum_range_m,
        )  # fmt: skip

    def make_actions(self) -> Continuous | Discrete:
        """Action codec: azimuth, distance, height of every sensor's next place."""
        if self.actions == "velocities":
            return Velocities(self.sensors, self.speed_m_s, self.climb_m_s, self.step_s)
        odd = (True, False, False) * self.sensors
        return Continuous(len(odd), odd) if self.actions == "continuous" else Discrete(len(odd), LEVELS, odd)

    def make_observation(self) -> MobileObservation:
        """Observation model."""
        return MobileObservation(self.ranging, self.steps)

    @property
    def steering(self) -> Steering:
        """The place per sensor where it should go to; one that idles stands in the middle of what is allowed."""
        return one_by_one(self.sensors, (0.0, 0.0, 0.0))

    def make_own_observation(self) -> OwnMobileObservation:
        """What every sensor knows by itself."""
        return OwnMobileObservation(self.steering.columns, self.ranging, self.steps)

    def make_sensors(self, tracker: ScanFusion) -> RadarSensors:
        """The sensors on their carriers."""
        return RadarSensors(self)

    def make_metrics(self) -> MobileFigures:
        """Figures of merit."""
        return MobileFigures(self)

    def make_scene(self, figure: Any) -> Any:
        """The map and the heights, in a matplotlib figure."""
        from passive_env.render_mobile import MobileScene

        return MobileScene(figure, self)

    def make_instants(self, world: Any, simulation: Any) -> list[Instant]:
        """What there is to see of a world (a batch of one), as plain numbers."""
        from passive_env.render_mobile import mobile_instants

        return mobile_instants(world, simulation)

    def draw_tape(self, generators: Sequence[np.random.Generator]) -> PlacementTape:
        """Tapes of len(generators) episodes, row i from generator i; their first instant is before the first scan."""
        k, n, e = self.steps + 1, self.sensors, len(generators)
        z, u = draw(generators, k * n * 3 + self.steps * 3, TASK_UNIFORMS + COURSE_UNIFORMS)
        task = self._draw_task(u[:, :TASK_UNIFORMS])
        path = self._draw_path(task, u[:, TASK_UNIFORMS:], z[:, k * n * 3 :].reshape(e, self.steps, 3))
        noise = np.ascontiguousarray(z[:, : k * n * 3]).reshape(e, k, n, 3)
        return PlacementTape(np.zeros((e, n, 6)), path[:, :, None], noise, np.empty((e, 0, 3)), task)

    def _draw_task(self, u: np.ndarray) -> Task:
        """Tasks from uniforms [e, TASK_UNIFORMS]; carriers on the ground stay there."""
        task = super()._draw_task(u)
        return task if self.carrier == "airborne" else task._replace(height_limit_m=np.zeros(len(u)))


CATALOGUE: dict[str, MobilePlacement] = {"MobilePlacement": MobilePlacement()}
"""This module's scenarios by name; each becomes the environment ``passive/NAME-v0``."""
