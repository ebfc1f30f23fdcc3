"""Where to put N sensors that measure range, azimuth and elevation, so that their fused track of a target is good.

After Yang et al. (1998): every measurement's error is a thin disk across its line of sight, and where the disks of the
sensors cross decides the fused error. Sensors are placed one per step, then the target comes.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, ClassVar

import numpy as np

from passive_env.actions import Continuous, Discrete
from passive_env.catalogue.entry import CLEAR_STD, COURSE_UNIFORMS, TASK_UNIFORMS, EntryScenario
from passive_env.layers import Instant
from passive_env.placement_observation import PlacementObservation
from passive_env.placement_simulation import PlacementSimulation, PlacementTape
from passive_env.scenario import choice, integer, number
from passive_env.tape import draw
from trackers.converted_fusion import LINEARISATIONS, TRUTH, ConvertedFusion
from trackers.converted_measurement import MIN_RANGE_M

SEEN = tuple(name for name in LINEARISATIONS if name != TRUTH)
"""Places where a fused filter can linearise without being told the truth."""

STRAY_STD = 10.0
"""The drawn courses' white acceleration may carry a target this many standard deviations closer to a sensor."""

LEVELS = 9
"""Choices per number of a discrete action."""


@dataclass(frozen=True, kw_only=True)
class RadarPlacement(EntryScenario):
    """Two to four sensors are placed, one per step; then a target is tracked for ``scans`` scans and the track scored.

    Drawn per episode, and told to the agent: the sector in which the target enters (half width), the spread of its
    course off the direction to the site, the limits of its altitude and speed, the sensors' accuracies (log-uniform;
    those of azimuth and elevation independently), and where sensors may be: azimuth at the expected entry, horizontal
    distance from there, height. All are uniform between their ``_min`` and ``_max`` fields; set both alike to fix one.
    The target's own entry, course, altitude and speed are uniform in the limits told; a white acceleration disturbs
    it. With course "flights" it flies a recorded path at the recorded speed, from the drawn place, course and altitude.

    Action: azimuth from −1, the limit to the right of the direction to the site, to +1, to the left; distance from −1,
    the least, to +1; height from −1, the ground, to +1.
    Observation: `passive_env.placement_observation.PlacementObservation`.
    Reward: the default is −log(position error / 1 km) in the last step, 0 before.
    info: besides what every environment shows ``position_crlb_m`` and ``track_error_m``, each [1]; see
        `passive_env.placement_simulation.PlacementMetrics`.
    Bound: the theoretical covariance of the fused filter along the true course.
    """

    ordered: ClassVar[tuple[tuple[str, str], ...]] = (
        *EntryScenario.ordered,
        ("angle_only", "steps"),
        ("scored_scans", "scans"),
    )
    replay_axis: ClassVar[str] = "sensors placed, then scans"

    steps: int = integer(3, 1, 4, "sensors to place, one per step; a single one is there to compare with")
    angle_only: int = integer(0, 0, 4, "how many of them, the last ones, measure azimuth and elevation only")
    scans: int = integer(50, 3, 1000, "scans of the track after the last step")
    scored_scans: int = integer(10, 1, 1000, "the last so many of them count for the position error")
    step_s: float = number(1.0, 0.1, 60.0, "time between scans")
    tracker: str = choice("local", SEEN, "where the fused filter takes bias and covariance of converted measurements")
    minimum_range_m: float = number(MIN_RANGE_M, 1.0, 1e5, "how close a target may come to a sensor")
    lost_error_m: float = number(5e3, 1.0, 1e6, "a track is lost if farther off than this …")
    lost_nees: float = number(27.9, 1.0, 1e9, "… and its NEES exceeds this (99.99 % of χ² with 6 degrees)")
    actions: str = choice("continuous", ("continuous", "discrete"), f"Box, or {LEVELS} choices per number")
    reward_final_log_position_error: float = number(1.0, 0.0, 1e6, "weight")
    reward_final_position_error: float = number(0.0, 0.0, 1e6, "weight")
    reward_position_gain: float = number(0.0, 0.0, 1e6, "weight")
    reward_lost_track: float = number(0.0, 0.0, 1e6, "weight")

    def __post_init__(self) -> None:
        super().__post_init__()
        self._check_nearest(self.target_speed_max_m_s)

    def _check_nearest(self, speed_m_s: float) -> None:
        """Refuse limits with which a target of this speed could come too close, or a measured range be negative."""
        flown = (self.scans - 1) * self.step_s
        stray = STRAY_STD * self.process_noise_m_s2 * self.step_s * flown * math.sqrt(self.scans / 3.0)
        aside = 2.0 * self.entry_distance_m * math.sin(0.5 * math.radians(self.entry_sector_max_deg))
        clear = max(self.minimum_range_m, CLEAR_STD * self.range_std_max_m)
        needed = clear + aside + speed_m_s * flown + stray
        if self.nearest_min_m < needed:
            raise self._error(
                "nearest_min_m", f"a target may enter {aside:.0f} m from where it is expected and fly "
                f"{speed_m_s * flown + stray:.0f} m; must be at least {needed:.0f} to stay beyond minimum_range_m = "
                f"{self.minimum_range_m:g} of every sensor and beyond {CLEAR_STD:g} range_std_max_m = "
                f"{CLEAR_STD * self.range_std_max_m:g}",
            )  # fmt: skip

    def check_flights(self) -> None:
        """Load the recorded flights now (see the base), and make sure that none of them comes too close to a sensor."""
        super().check_flights()
        if self.course == "flights":
            self._check_nearest(float(np.linalg.norm(self.flight_paths.states[:, 3:], axis=-1).max()))

    @property
    def stations(self) -> int:
        """Number of sensors."""
        return self.steps

    @property
    def instants(self) -> int:
        """Instants at which the track is judged: the scans."""
        return self.scans

    @cached_property
    def ranging(self) -> np.ndarray:
        """[n] bool, whether a sensor measures range."""
        return np.arange(self.steps) < self.steps - self.angle_only

    # -- the parts the simulation asks for ---------------------------------------------------------------------------

    def make_simulation(self) -> PlacementSimulation:
        """The loop that runs this scenario's episodes."""
        return PlacementSimulation(self)

    def make_tracker(self) -> ConvertedFusion:
        """The fused filter."""
        return ConvertedFusion(
            step_s=self.step_s, acceleration_std=self.process_noise_m_s2, linearisation=self.tracker,
            expected_range_m=self.entry_distance_m, minimum_range_m=self.minimum_range_m,
        )  # fmt: skip

    def make_actions(self) -> Continuous | Discrete:
        """Action codec: azimuth, distance, height of the next sensor."""
        odd = (True, False, False)
        return Continuous(3, odd) if self.actions == "continuous" else Discrete(3, LEVELS, odd)

    def make_observation(self) -> PlacementObservation:
        """Observation model."""
        return PlacementObservation(self.ranging)

    def make_scene(self, figure: Any) -> Any:
        """The map and the heights, in a matplotlib figure."""
        from passive_env.render_placement import PlacementScene

        return PlacementScene(figure, self)

    def make_instants(self, world: Any, simulation: Any) -> list[Instant]:
        """What there is to see of a world (a batch of one), as plain numbers."""
        from passive_env.render_placement import placement_instants

        return placement_instants(world, simulation)

    def draw_tape(self, generators: Sequence[np.random.Generator]) -> PlacementTape:
        """Tapes of len(generators) episodes, row i from generator i."""
        k, n, e = self.scans, self.steps, len(generators)
        z, u = draw(generators, k * n * 3 + (k - 1) * 3, TASK_UNIFORMS + COURSE_UNIFORMS)
        task = self._draw_task(u[:, :TASK_UNIFORMS])
        path = self._draw_path(task, u[:, TASK_UNIFORMS:], z[:, k * n * 3 :].reshape(e, k - 1, 3))
        noise = np.ascontiguousarray(z[:, : k * n * 3]).reshape(e, k, n, 3)
        return PlacementTape(np.zeros((e, n, 6)), path[:, :, None], noise, np.empty((e, 0, 3)), task)


CATALOGUE: dict[str, RadarPlacement] = {"RadarPlacement": RadarPlacement()}
"""This module's scenarios by name; each becomes the environment ``passive/NAME-v0``."""

PAPER = RadarPlacement(
    steps=2, entry_sector_min_deg=0.0, entry_sector_max_deg=0.0, heading_spread_min_deg=0.0, heading_spread_max_deg=0.0,
    altitude_min_m=10e3, altitude_max_m=10e3, target_speed_min_m_s=300.0, target_speed_max_m_s=300.0,
    range_std_min_m=50.0, range_std_max_m=50.0, azimuth_std_min_deg=1.0, azimuth_std_max_deg=1.0,
    elevation_std_min_deg=1.0, elevation_std_max_deg=1.0, azimuth_limit_min_deg=180.0, azimuth_limit_max_deg=180.0,
    nearest_min_m=200e3, nearest_max_m=200e3, farthest_min_m=200e3, farthest_max_m=200e3,
    height_limit_min_m=20e3, height_limit_max_m=20e3,
)  # fmt: skip
"""The paper's scenario: the target at (200, 0, 10) km flies to the site at 300 m/s."""
