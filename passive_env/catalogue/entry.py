"""What scenarios share in which sensors are placed for a target that enters at a known distance: tasks and courses."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from functools import cached_property
from typing import Any, ClassVar

import numpy as np

from passive_env.catalogue.angle_fusion import place_flight_in_space
from passive_env.catalogue.course import CourseScenario
from passive_env.placement import Task, entries, straight
from passive_env.rewards import TERMS
from passive_env.scenario import number

TASK_UNIFORMS, COURSE_UNIFORMS = 13, 5
"""Uniform numbers of an episode's task, and of the target's course in it."""

CLEAR_STD = 10.0
"""Targets stay this many standard deviations of range from sensors that measure it: no measured range is negative."""


@dataclass(frozen=True, kw_only=True)
class EntryScenario(CourseScenario):
    """Base of them. Drawn per episode, and told to the agent, are the task's limits (`passive_env.placement.Task`).

    All are uniform between their ``_min`` and ``_max`` fields, accuracies log-uniform; those of azimuth and elevation
    independently. The target's own entry, course, altitude and speed are uniform in the limits told; a white
    acceleration disturbs it, vertically less where it would lead under ground.
    """

    targets: ClassVar[int] = 1
    score: ClassVar[str] = "position"
    reference: ClassVar[int] = 0
    standoff_m: ClassVar[float] = 0.0
    ordered: ClassVar[tuple[tuple[str, str], ...]] = (
        ("entry_sector_min_deg", "entry_sector_max_deg"),
        ("heading_spread_min_deg", "heading_spread_max_deg"),
        ("altitude_min_m", "altitude_max_m"),
        ("target_speed_min_m_s", "target_speed_max_m_s"),
        ("range_std_min_m", "range_std_max_m"),
        ("azimuth_std_min_deg", "azimuth_std_max_deg"),
        ("elevation_std_min_deg", "elevation_std_max_deg"),
        ("azimuth_limit_min_deg", "azimuth_limit_max_deg"),
        ("nearest_min_m", "nearest_max_m"),
        ("nearest_max_m", "farthest_min_m"),
        ("farthest_min_m", "farthest_max_m"),
        ("height_limit_min_m", "height_limit_max_m"),
    )

    process_noise_m_s2: float = number(1.0, 0.0, 50.0, "white acceleration per axis, of drawn courses and the filter")
    entry_distance_m: float = number(200e3, 1e4, 1e6, "from the site to where targets enter")
    entry_sector_min_deg: float = number(2.0, 0.0, 90.0, "half width of the sector of entry, seen from the site: least")
    entry_sector_max_deg: float = number(10.0, 0.0, 90.0, "… and largest drawn")
    heading_spread_min_deg: float = number(
        5.0, 0.0, 180.0, "half width of courses off the direction to the site: least"
    )
    heading_spread_max_deg: float = number(20.0, 0.0, 180.0, "… and largest drawn")
    altitude_min_m: float = number(2e3, 0.0, 1e5, "lowest drawn limit of the target's altitude")
    altitude_max_m: float = number(15e3, 0.0, 1e5, "highest")
    target_speed_min_m_s: float = number(200.0, 1.0, 2000.0, "lowest drawn limit of the target's speed")
    target_speed_max_m_s: float = number(400.0, 1.0, 2000.0, "highest")
    range_std_min_m: float = number(20.0, 1e-3, 1e4, "least drawn range noise")
    range_std_max_m: float = number(100.0, 1e-3, 1e4, "largest")
    azimuth_std_min_deg: float = number(0.5, 1e-3, 10.0, "least drawn azimuth noise")
    azimuth_std_max_deg: float = number(2.0, 1e-3, 10.0, "largest")
    elevation_std_min_deg: float = number(0.5, 1e-3, 10.0, "least drawn elevation noise")
    elevation_std_max_deg: float = number(2.0, 1e-3, 10.0, "largest")
    azimuth_limit_min_deg: float = number(45.0, 0.0, 180.0, "least drawn limit of a sensor's azimuth; 180 is all round")
    azimuth_limit_max_deg: float = number(180.0, 0.0, 180.0, "largest")
    nearest_min_m: float = number(150e3, 1e3, 1e6, "least drawn lower limit of a sensor's distance from the entry")
    nearest_max_m: float = number(200e3, 1e3, 1e6, "largest")
    farthest_min_m: float = number(200e3, 1e3, 1e6, "least drawn upper limit of it")
    farthest_max_m: float = number(250e3, 1e3, 1e6, "largest")
    height_limit_min_m: float = number(0.0, 0.0, 1e5, "least drawn limit of a sensor's height")
    height_limit_max_m: float = number(20e3, 0.0, 1e5, "largest")

    @cached_property
    def reward_weights(self) -> dict[str, float]:
        """Weights of the reward terms in use."""
        names = (f.name.removeprefix("reward_") for f in dataclasses.fields(self) if f.name.startswith("reward_"))
        weights = {name: getattr(self, f"reward_{name}") for name in names if name in TERMS}
        return {name: weight for name, weight in weights.items() if weight > 0.0}

    # -- drawing -----------------------------------------------------------------------------------------------------

    def _draw_task(self, u: np.ndarray) -> Task:
        """Tasks from uniforms [e, TASK_UNIFORMS]."""
        columns = iter(np.ascontiguousarray(u.T))  # powers of strided numbers may differ in the last bit

        def between(name: str, unit: str) -> np.ndarray:
            low, high = getattr(self, f"{name}_min_{unit}"), getattr(self, f"{name}_max_{unit}")
            return low + (high - low) * next(columns)

        def log_between(name: str, unit: str) -> np.ndarray:
            low, high = getattr(self, f"{name}_min_{unit}"), getattr(self, f"{name}_max_{unit}")
            return low * (high / low) ** next(columns)

        def pair(name: str, unit: str) -> np.ndarray:
            return np.sort([between(name, unit), between(name, unit)], axis=0).T

        return Task(
            np.full(len(u), self.entry_distance_m),
            np.radians(between("entry_sector", "deg")),
            np.radians(between("heading_spread", "deg")),
            pair("altitude", "m"),
            pair("target_speed", "m_s"),
            np.stack(
                [
                    log_between("range_std", "m"), np.radians(log_between("azimuth_std", "deg")),
                    np.radians(log_between("elevation_std", "deg")),
                ], axis=-1,
            ),
            np.radians(between("azimuth_limit", "deg")),
            np.stack([between("nearest", "m"), between("farthest", "m")], axis=-1),
            between("height_limit", "m"),
        )  # fmt: skip

    def _draw_path(self, task: Task, u: np.ndarray, z: np.ndarray) -> np.ndarray:
        """True states [e, k, 6] from uniforms [e, COURSE_UNIFORMS] and normals [e, k − 1, 3], from the entry on."""
        bearing, off_site = task.sector_rad * (2.0 * u[:, 0] - 1.0), task.heading_rad * (2.0 * u[:, 1] - 1.0)
        altitude, speed = (low + (high - low) * x for (low, high), x in zip(_ends(task), u.T[2:4], strict=True))
        start = entries(task.entry_distance_m, bearing, off_site, altitude, speed)
        if self.course == "flights":
            path = place_flight_in_space(start, self.flight_paths.windows(u[:, 4], z.shape[1]))
            path[..., 2] = np.maximum(path[..., 2] - path[:, :1, 2] + start[:, None, 2], 0.0)
            return path
        path = straight(start, z.shape[1] + 1, self.step_s)
        pushed = self.process_noise_m_s2 * self.step_s * z
        gained = np.cumsum(pushed, axis=1)
        moved = self.step_s * np.cumsum(gained - 0.5 * pushed, axis=1)
        calmer = _above_ground(start[:, 2], moved[..., 2].min(axis=1))
        moved[..., 2] *= calmer[:, None]
        gained[..., 2] *= calmer[:, None]
        path[:, 1:, :3] += moved
        path[:, 1:, 3:] += gained
        return path


def _above_ground(altitude: np.ndarray, lowest: np.ndarray) -> np.ndarray:
    """Share [e] of its climbs and descents, `lowest` [e] m the deepest, with which a target at most touches ground."""
    return np.divide(altitude, -lowest, out=np.ones_like(altitude), where=-lowest > altitude)


def _ends(task: Task) -> tuple[Any, Any]:
    """Limits of altitude and of speed, each a pair of [e]."""
    return task.altitude_m.T, task.speed_m_s.T
