"""Training speed: PPO with the preset, and how much of the wall time its environment takes."""

from __future__ import annotations

import tempfile
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from stable_baselines3.common.callbacks import BaseCallback

from agents.benchmark.environments import SCENARIO
from agents.benchmark.results import Result, Section
from agents.benchmark.timing import Effort
from agents.sb3 import Sb3VecEnv
from agents.training import Run, new_model, plan, rollout_steps
from passive_env.vector_env import PassiveVectorEnv


def measure_ppo(effort: Effort) -> Section:
    """Steps per second of whole rollouts (collection, learning, logs) after the first, with the preset's threads.

    The preset's head start by imitation is left out: it happens once and changes no rollout's cost.
    """
    before = torch.get_num_threads()
    try:
        with tempfile.TemporaryDirectory() as folder:
            run = plan(SCENARIO, Path(folder), envs=effort.ppo_envs)
            run = replace(run, preset={name: part for name, part in run.preset.items() if name != "imitation"})
            torch.set_num_threads(run.preset.get("torch_threads", 1))
            wall, inside = _time_rollouts(run, effort.rollouts)
    finally:
        torch.set_num_threads(before)
    return Section(
        [
            Result("ppo_steps", rollout_steps(run) / float(np.median(wall)), "steps/s", ">= 20000"),
            Result("ppo_environment_share", 100.0 * float(inside.sum() / wall.sum()), "%", "<= 20"),
        ]
    )


def _time_rollouts(run: Run, rollouts: int) -> tuple[np.ndarray, np.ndarray]:
    """Wall time and time inside the environment [rollouts] s of every rollout but the first."""
    env = ClockedVecEnv(PassiveVectorEnv(run.training_scenario, num_envs=run.envs, autoreset_mode="same_step"))
    model, clock = new_model(run, env), _Clock(env)
    model.learn((rollouts + 1) * rollout_steps(run), callback=clock, tb_log_name="log")
    clock.stamp()
    env.close()
    model.logger.close()
    wall, inside = np.diff(np.array(clock.stamps), axis=0)[1:].T
    return wall, inside


class ClockedVecEnv(Sb3VecEnv):
    """The training environment with a clock: `seconds` is the time spent in `step_wait`, resets included."""

    def __init__(self, env: PassiveVectorEnv):
        super().__init__(env)
        self.seconds = 0.0

    def step_wait(self) -> Any:
        """Fly the step."""
        start = time.perf_counter()
        outcome = super().step_wait()
        self.seconds += time.perf_counter() - start
        return outcome


class _Clock(BaseCallback):
    """Stamps (time, environment's time so far) at the start of every rollout."""

    def __init__(self, env: ClockedVecEnv):
        super().__init__()
        self._env = env
        self.stamps: list[tuple[float, float]] = []

    def stamp(self) -> None:
        self.stamps.append((time.perf_counter(), self._env.seconds))

    def _on_rollout_start(self) -> None:
        self.stamp()

    def _on_step(self) -> bool:
        return True
