"""Timing in rounds: rivals take turns, so that a machine that slows down slows all of them."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

Task = Callable[[], Callable[[], Any]]
"""Prepares one round and returns what is timed."""


@dataclass(frozen=True)
class Effort:
    """How long to measure.

    Attributes:
        rounds: turns of every rival; medians are taken over them.
        batches: calls of our own update, each on a full batch, in a turn.
        single_updates: updates of another library in a turn.
        num_envs: width of the vector environment.
        episodes: episodes of the single environment, each step timed by itself.
        rollouts: PPO rollouts timed after the first.
        ppo_envs: environments of PPO; None takes the preset's number.
    """

    rounds: int = 25
    batches: int = 8
    single_updates: int = 200
    num_envs: int = 1024
    episodes: int = 100
    rollouts: int = 12
    ppo_envs: int | None = None


FULL = Effort()
QUICK = Effort(rounds=3, batches=2, single_updates=50, episodes=10, rollouts=2)


def seconds(action: Callable[[], Any]) -> float:
    """Wall time of one call [s]."""
    start = time.perf_counter()
    action()
    return time.perf_counter() - start


def take_turns(tasks: Mapping[str, Task], rounds: int) -> dict[str, np.ndarray]:
    """Wall times [rounds] s by name, in the order A B C A B C …; every task runs once before, to compile."""
    for task in tasks.values():
        task()()
    times = [[seconds(task()) for task in tasks.values()] for _ in range(rounds)]
    return dict(zip(tasks, np.array(times).T, strict=True))
