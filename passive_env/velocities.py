"""Actions of sensors on carriers as velocities: where to go from here instead of where to be."""

from __future__ import annotations

import numpy as np

from passive_env.actions import Continuous
from passive_env.mobile_observation import course_of
from passive_env.mobile_simulation import MobileBelief, wanted
from passive_env.placement import commands, seen_from_entry

ORDER = [1, 0, 2]
"""Of a place's three numbers, azimuth, distance and height, in the first action: what is left stays on the left."""

SHORTEST_M = 1.0
"""A way shorter than this has no direction, and one that ends nearer to a limit than this ends at it."""


class Velocities(Continuous):
    """A Box in [−1, 1], three numbers per sensor: ahead and left, along the target's estimated course, and up.

    They are shares of what a carrier can go in a step; 0 stands still. A way longer than that is cut. One that would
    end nearer to the entry than a sensor may be sent goes on, at top speed, to where it may: carriers fly across that
    part, but do not stay. If the far side lies beyond the azimuth's limit, they make for the limit. The first action,
    which installs the sensors, is distance, azimuth and height of their places, as shares of the limits.

    Args:
        sensors: how many.
        speed_m_s, climb_m_s: of carriers.
        step_s: between decisions.
    """

    meaning = "velocities, also across what is too near"

    def __init__(self, sensors: int, speed_m_s: float, climb_m_s: float, step_s: float):
        super().__init__(3 * sensors, (False, True, False) * sensors)
        self._reach = np.maximum([speed_m_s * step_s, speed_m_s * step_s, climb_m_s * step_s], 1e-9)

    def commands(self, values: np.ndarray, belief: MobileBelief) -> np.ndarray:
        """Commands [e, 3 n], places, of decoded actions [e, 3 n]."""
        numbers = values.reshape(len(values), -1, 3)
        entry = belief.task.entry_distance_m[:, None]
        way = _turned(numbers * self._reach, course_of(belief), 1.0)
        goals = _across(belief.platforms[..., :3], way, entry, belief.task.distance_m[:, :1])
        places = commands(*seen_from_entry(goals, entry), belief.task)
        return np.where(belief.installed[:, None, None], places, numbers[..., ORDER]).reshape(len(values), -1)

    def encode(self, commands: np.ndarray, belief: MobileBelief | None = None) -> np.ndarray:
        """Actions [e, 3 n] that mean the places [e, 3 n] to a belief, which is needed."""
        if belief is None:
            raise TypeError("encode(commands, belief): velocities need the belief")
        places = commands.reshape(len(commands), -1, 3)
        way = _turned(wanted(commands, belief.task) - belief.platforms[..., :3], course_of(belief), -1.0) / self._reach
        level = np.maximum(np.hypot(way[..., 0], way[..., 1]), 1.0)[..., None]
        way = np.concatenate([way[..., :2] / level, np.clip(way[..., 2:], -1.0, 1.0)], axis=-1)
        numbers = np.where(belief.installed[:, None, None], way, places[..., ORDER])
        return numbers.reshape(len(commands), -1).astype(np.float32)


def _across(here: np.ndarray, way: np.ndarray, entry: np.ndarray, near: np.ndarray) -> np.ndarray:
    """Where ways [e, n, 3] m from places [e, n, 3] lead: one that ends too near to the entry to its far side.

    Args:
        entry, near: [e, 1] m, distances of the entry from the site and of the nearest place from the entry.
    """
    p, w = here[..., :2] - np.stack([entry, np.zeros_like(entry)], axis=-1), way[..., :2]
    a, b, c = (w * w).sum(-1), (p * w).sum(-1), (p * p).sum(-1) - near * near
    ends = a + 2.0 * b + c + near * near  # squared distance; what ends on the limit does so up to float32
    crosses = (ends < (near - SHORTEST_M) ** 2) & (a > SHORTEST_M**2)
    far = (np.sqrt(np.maximum(b * b - a * c, 0.0)) - b) / np.maximum(a, SHORTEST_M**2)
    level = np.where(crosses, far, 1.0)[..., None] * w
    return here + np.concatenate([level, way[..., 2:]], axis=-1)


def _turned(vectors: np.ndarray, course: np.ndarray, sense: float) -> np.ndarray:
    """Vectors [e, n, 3] from the course's frame (sense 1), courses [e, 2] being unit vectors, or into it (−1)."""
    c, s = course[:, :1], sense * course[:, 1:]
    x, y, z = (vectors[..., i] for i in range(3))
    return np.stack([c * x - s * y, s * x + c * y, z], axis=-1)
