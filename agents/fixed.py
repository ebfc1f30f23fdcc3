"""Policies that look at nothing: the paper's schedules, straight flight, random turns."""

from __future__ import annotations

import zlib
from collections.abc import Sequence
from typing import Any

import numpy as np

from agents.policy import Policy
from agents.steering import level_flight
from passive_env.belief import Belief
from passive_env.catalogue.angle_fusion import PAPER_TURN_DEG, PAPER_TURN_S
from passive_env.catalogue.two_station import NATURAL


class Schedule:
    """Turn during fixed windows of time, as fast as the scenario's limit allows.

    Args:
        scenario: supplies step length, number of steps and turn rate limit.
        windows_s: per platform, time from and to [s].
        senses: per platform, +1 counter-clockwise, −1 clockwise, 0 for straight on.
        rate_deg_s: of the turns; the default is the two-station paper's.
    """

    def __init__(
        self, scenario: Any, windows_s: Sequence[tuple[float, float]], senses: Sequence[int],
        rate_deg_s: float = NATURAL.turn_rate_deg_s,
    ):  # fmt: skip
        self._scenario = scenario
        self._windows = np.array(windows_s, dtype=float)
        share = rate_deg_s / max(scenario.max_turn_rate_deg_s, 1e-12)
        self._command = np.array(senses, dtype=float) * min(share, 1.0)

    def reset(self, belief: Belief) -> None:
        """Nothing to remember."""

    def act(self, belief: Belief, observation: np.ndarray) -> np.ndarray:
        """The share of the coming step that lies in a platform's window, times its command."""
        begin = ((self._scenario.steps - belief.steps_left) * self._scenario.step_s)[:, None]
        inside = np.minimum(begin + self._scenario.step_s, self._windows[:, 1]) - np.maximum(begin, self._windows[:, 0])
        return level_flight(self._command * np.clip(inside / self._scenario.step_s, 0.0, 1.0), belief)


class Straight:
    """Hold course."""

    def reset(self, belief: Belief) -> None:
        """Nothing to remember."""

    def act(self, belief: Belief, observation: np.ndarray) -> np.ndarray:
        """Zero turn rate."""
        return np.zeros_like(belief.last_action)


class Stand:
    """Stay where one is: zero turn rate, lowest speed."""

    def reset(self, belief: Belief) -> None:
        """Nothing to remember."""

    def act(self, belief: Belief, observation: np.ndarray) -> np.ndarray:
        """No turns, speeds at −1."""
        commands = np.zeros_like(belief.last_action)
        commands[:, belief.platforms.shape[1] :] = -1.0
        return commands


class Random:
    """Uniform random commands.

    An episode's commands follow from the seed and its first tracks, so an evaluation can be repeated and gives the
    same result however its episodes are cut into batches. Of the tracks whole metres count, and metres per second: the
    last digits are the processor's.
    """

    def __init__(self, seed: int):
        self._seed = seed
        self._commands = np.empty((0, 1, 2))
        self._begin = np.empty(0, dtype=int)

    def reset(self, belief: Belief) -> None:
        """Draw whole episodes' commands [e, k, a]."""
        self._begin = np.array(belief.steps_left)
        shape = (max(int(self._begin.max()), 1), belief.last_action.shape[-1])
        marks = (zlib.crc32(mean.tobytes()) for mean in np.rint(belief.mean).astype(np.int64))
        generators = (np.random.default_rng([self._seed, mark]) for mark in marks)
        self._commands = np.stack([generator.uniform(-1.0, 1.0, shape) for generator in generators])

    def act(self, belief: Belief, observation: np.ndarray) -> np.ndarray:
        """Independent commands in [−1, 1]."""
        step = (self._begin - belief.steps_left) % self._commands.shape[1]
        return self._commands[np.arange(len(step)), step]


def _paper(scenario: Any, seed: int) -> Policy:
    return Schedule(scenario, NATURAL.station_turn_s, (1, 1))


def _paper_opposed(scenario: Any, seed: int) -> Policy:
    return Schedule(scenario, NATURAL.station_turn_s, (1, -1))


def _paper_in_space(scenario: Any, seed: int) -> Policy:
    """The first platform turns to its left, which is north in the paper's layout, as fast as it can."""
    limit = scenario.max_turn_rate_deg_s
    until = PAPER_TURN_S + PAPER_TURN_DEG / max(limit, 1e-12)
    return Schedule(scenario, [(PAPER_TURN_S, until), (0.0, 0.0)], (1, 0), limit)


PAPER = {"paper": _paper, "paper_opposed": _paper_opposed}
"""Makers (scenario, seed) of the two-station paper's schedules."""

PAPER_IN_SPACE = {"paper": _paper_in_space}
"""Maker (scenario, seed) of the paper's maneuver for two platforms in space."""

STEADY = {
    "straight": lambda scenario, seed: Straight(),
    "random": lambda scenario, seed: Random(seed),
}
"""Makers (scenario, seed) of what any scenario can fly."""

FIXED = {"fixed": lambda scenario, seed: Stand(), **STEADY}
"""Makers (scenario, seed) of what stations that choose their speed can do blindly; `straight` is at half speed."""
