"""What the agent sees before it places a sensor: the task, and the sensors placed so far."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from gymnasium import spaces

from passive_env.observations import LIMIT, Field
from passive_env.placement import PlacementBelief, Task, seen_from_entry


class PlacementObservation:
    """The task and the sensors placed so far, seen from where the target is expected to enter.

    Fields in order (`fields` names each with its unit and scale); N is a sensor's number. All but `time_left` and the
    sensors' are the same throughout an episode:

        time_left                                1     share of the sensors that are still to be placed
        task.sector                              rad   half width of the sector of entry / 0.2
        task.heading                             rad   half width of the course off the direction to the site / 0.5
        task.altitude_low task.altitude_high     m     limits of the target's altitude / 10 km
        task.speed_low task.speed_high           m/s   limits of its speed / 300 m/s
        task.log_range_std                       m     log(standard deviation / 50 m)
        task.log_azimuth_std                     rad   log(standard deviation / 1°)
        task.log_elevation_std                   rad   the same
        task.azimuth_limit                       rad   largest azimuth of a sensor / 180°
        task.nearest task.farthest               m     (limits of a sensor's distance − 200 km) / 50 km
        task.height_limit                        m     largest height / 10 km
        sensorN.azimuth_cos sensorN.azimuth_sin  1     0 until it is placed, as the rest
        sensorN.distance                         m     (horizontal distance − 200 km) / 50 km
        sensorN.height                           m     / 10 km

    Values are clipped to ±5.

    Args:
        ranging: [n] whether a sensor measures range.
    """

    def __init__(self, ranging: Any):
        self.fields = tuple(_fields(ranging))
        self.space = spaces.Box(-LIMIT, LIMIT, (len(self.fields),), np.float32)
        self._sensors = len(ranging)
        self._mirror_sign = np.array([-1 if field.odd else 1 for field in self.fields], dtype=np.float32)

    def __call__(self, belief: PlacementBelief) -> Any:
        """Observation [e, d] float32 inside the space."""
        task = belief.task
        known = np.hstack([(belief.steps_left / self._sensors)[:, None], task_numbers(task)])
        azimuth, distance, height = seen_from_entry(belief.platforms[..., :3], task.entry_distance_m[:, None])
        sensors = np.stack([np.cos(azimuth), np.sin(azimuth), (distance - 2e5) / 5e4, height / 1e4], axis=-1)
        placed = np.arange(self._sensors) < self._sensors - belief.steps_left[:, None]
        numbers = np.hstack([known, np.where(placed[..., None], sensors, 0.0).reshape(len(known), -1)])
        return np.clip(numbers, -LIMIT, LIMIT).astype(np.float32)

    def mirrored(self, observation: np.ndarray) -> np.ndarray:
        """Observations [..., d] of the mirrored worlds: left is right."""
        return self._mirror_sign * observation


def task_numbers(task: Task) -> np.ndarray:
    """What is known of an episode, [e, 13] in the order of `task_fields`."""
    return np.stack(
        [
            task.sector_rad / 0.2, task.heading_rad / 0.5, *(task.altitude_m.T / 1e4), *(task.speed_m_s.T / 300.0),
            np.log(task.std[:, 0] / 50.0), *np.log(task.std[:, 1:].T / math.radians(1.0)),
            task.azimuth_limit_rad / math.pi, *((task.distance_m.T - 2e5) / 5e4), task.height_limit_m / 1e4,
        ], axis=-1,
    )  # fmt: skip


def task_fields():
    """What is the same throughout an episode."""
    yield Field("task.sector", "rad", "half width of the sector of entry / 0.2")
    yield Field("task.heading", "rad", "half width of the course off the direction to the site / 0.5")
    for end, words in (("low", "lowest"), ("high", "highest")):
        yield Field(f"task.altitude_{end}", "m", f"{words} altitude / 10 km")
    for end, words in (("low", "slowest"), ("high", "fastest")):
        yield Field(f"task.speed_{end}", "m/s", f"{words} target / 300 m/s")
    yield Field("task.log_range_std", "m", "log(standard deviation / 50 m)")
    for angle in ("azimuth", "elevation"):
        yield Field(f"task.log_{angle}_std", "rad", "log(standard deviation / 1°)")
    yield Field("task.azimuth_limit", "rad", "largest azimuth of a sensor / 180°")
    for end in ("nearest", "farthest"):
        yield Field(f"task.{end}", "m", f"({end} allowed distance − 200 km) / 50 km")
    yield Field("task.height_limit", "m", "largest height of a sensor / 10 km")


def kind_of(ranging: bool) -> str:
    """What a field's scale adds for a sensor without range: a policy trained with other kinds is refused by it."""
    return "" if ranging else "; measures no range"


def _fields(ranging: Any):
    yield Field("time_left", "1", "share of the sensors that are still to be placed")
    yield from task_fields()
    for i, ranges in enumerate(ranging):
        yield Field(f"sensor{i}.azimuth_cos", "1", "of its azimuth at the expected entry; 0 until placed")
        yield Field(f"sensor{i}.azimuth_sin", "1", "of its azimuth at the expected entry; 0 until placed", odd=True)
        yield Field(f"sensor{i}.distance", "m", "(horizontal distance − 200 km) / 50 km; 0 until placed")
        yield Field(f"sensor{i}.height", "m", f"/ 10 km; 0 until placed{kind_of(ranges)}")
