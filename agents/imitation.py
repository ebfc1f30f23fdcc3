"""A head start: a new actor first imitates a teacher, then reinforcement learning improves on it."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from gymnasium import spaces
from stable_baselines3.common.base_class import BaseAlgorithm
from torch.nn import functional

from agents.policy import make_policy, sees_world
from passive_env.vector_env import PassiveVectorEnv

BATCH = 2048


def imitate(
    model: BaseAlgorithm,
    scenario: Any,
    teacher: str,
    episodes: int,
    epochs: int,
    learning_rate: float,
    noise: float,
    seed: int,
) -> float:
    """Fit the actor to a teacher's commands; returns the last loss.

    The loss is the mean square error of the actor's mean action, or of choices their mean negative log-likelihood.

    The teacher is flown through episodes in which its commands are disturbed, so that the actor also learns what to do
    where the teacher alone would never have been.

    Args:
        model: an on-policy model (its policy has `get_distribution`); only its policy is changed.
        scenario: what to fly.
        teacher: policy name.
        episodes: flown at once; epochs: passes over all their steps.
        learning_rate: of Adam.
        noise: standard deviation of the disturbance of commands in [−1, 1].
        seed: of episodes, disturbance and order.
    """
    observations, commands = _demonstrations(scenario, teacher, episodes, noise, seed)
    x, y = torch.as_tensor(observations), torch.as_tensor(commands)
    policy: Any = model.policy
    x, y = x.to(policy.device), y.to(policy.device)
    optimizer = torch.optim.Adam(policy.parameters(), learning_rate)
    choices = isinstance(model.action_space, spaces.MultiDiscrete)
    order = torch.Generator().manual_seed(seed)
    loss = torch.zeros(())
    for _ in range(epochs):
        for rows in torch.randperm(len(x), generator=order).split(BATCH):
            actor = policy.get_distribution(x[rows])
            loss = -actor.log_prob(y[rows]).mean() if choices else functional.mse_loss(actor.mode(), y[rows])
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
    return float(loss.detach())


def _demonstrations(scenario: Any, teacher: str, episodes: int, noise: float, seed: int) -> tuple[np.ndarray, ...]:
    """Observations [n, d] and the teacher's actions [n, a] along disturbed flights."""
    env = PassiveVectorEnv(scenario, num_envs=episodes, autoreset_mode="disabled")
    observation, _ = env.reset(seed=seed)
    policy = make_policy(teacher, scenario, seed)
    if sees_world(policy):
        raise ValueError(f"teacher {teacher!r} looks at the truth: imitate one that decides from the belief")
    policy.reset(env.belief())
    rng = np.random.default_rng(seed)
    observations, commands = [], []
    drift = np.zeros((episodes, env.simulation.actions.size))
    shaken = rng.random((episodes, 1)) < 0.5  # half the flights also drift off for longer
    for _ in range(scenario.steps):
        command = policy.act(env.belief(), observation)
        observations.append(observation)
        commands.append(env.simulation.actions.encode(command))
        drift = 0.8 * drift + noise * rng.standard_normal(command.shape)
        disturbed = command + noise * rng.standard_normal(command.shape) + shaken * drift
        observation = env.step(env.simulation.actions.encode(np.clip(disturbed, -1.0, 1.0)))[0]
    return np.concatenate(observations), np.concatenate(commands)
