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
    critic: float = 0.0,
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
        critic: weight of the critic's share of the loss: the mean square error of its values against the discounted
            rewards that the flights earned, over their variance. A critic that knows nothing would at first spoil
            what the actor has learned.
    """
    policy: Any = model.policy
    flights = _demonstrations(scenario, teacher, episodes, noise, seed, getattr(model, "gamma", 1.0))
    x, y, earned = (torch.as_tensor(part).to(policy.device) for part in flights)
    optimizer = torch.optim.Adam(policy.parameters(), learning_rate)
    choices = isinstance(model.action_space, spaces.MultiDiscrete)
    order = torch.Generator().manual_seed(seed)
    loss = torch.zeros(())
    spread = earned.var().clamp(min=1e-6)
    for _ in range(epochs):
        for rows in torch.randperm(len(x), generator=order).split(BATCH):
            actor = policy.get_distribution(x[rows])
            loss = -actor.log_prob(y[rows]).mean() if choices else functional.mse_loss(actor.mode(), y[rows])
            if critic > 0.0:
                values = policy.predict_values(x[rows])[:, 0]
                loss = loss + critic * functional.mse_loss(values, earned[rows]) / spread
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
    return float(loss.detach())


def _demonstrations(
    scenario: Any, teacher: str, episodes: int, noise: float, seed: int, gamma: float
) -> tuple[np.ndarray, ...]:
    """Observations [n, d], the teacher's actions [n, a] and discounted rewards to go [n] along disturbed flights."""
    env = PassiveVectorEnv(scenario, num_envs=episodes, autoreset_mode="disabled")
    observation, _ = env.reset(seed=seed)
    policy = make_policy(teacher, scenario, seed)
    if sees_world(policy):
        raise ValueError(f"teacher {teacher!r} looks at the truth: imitate one that decides from the belief")
    policy.reset(env.belief())
    rng = np.random.default_rng(seed)
    observations, commands, rewards = [], [], []
    drift = np.zeros((episodes, env.simulation.actions.size))
    shaken = rng.random((episodes, 1)) < 0.5  # half the flights also drift off for longer
    for _ in range(scenario.steps):
        command = policy.act(env.belief(), observation)
        observations.append(observation)
        commands.append(env.simulation.actions.encode(command))
        drift = 0.8 * drift + noise * rng.standard_normal(command.shape)
        disturbed = command + noise * rng.standard_normal(command.shape) + shaken * drift
        observation, reward, *_ = env.step(env.simulation.actions.encode(np.clip(disturbed, -1.0, 1.0)))
        rewards.append(reward)
    for k in range(len(rewards) - 2, -1, -1):
        rewards[k] = rewards[k] + gamma * rewards[k + 1]
    return np.concatenate(observations), np.concatenate(commands), np.concatenate(rewards).astype(np.float32)
