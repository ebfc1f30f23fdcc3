"""A head start: a new actor first imitates a teacher, then reinforcement learning improves on it."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from gymnasium import spaces
from sb3_contrib.common.recurrent.policies import RecurrentActorCriticPolicy
from stable_baselines3.common.base_class import BaseAlgorithm
from torch.nn import functional

from agents.policy import make_policy, sees_world
from passive_env.team import Team
from passive_env.truth import TruthObservation
from passive_env.vector_env import PassiveVectorEnv

BATCH = 2048
BLOCK = 16_384
"""Episodes that the teacher flies at once: what is kept of them is small, what flies them is not."""


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
    mirror: bool = False,
    truth: TruthObservation | None = None,
    team: Team | None = None,
) -> float:
    """Fit the actor to a teacher's commands; returns the last loss.

    The loss is the mean square error of the actor's mean action, or of choices their mean negative log-likelihood.

    The teacher is flown through episodes in which its commands are disturbed, so that the actor also learns what to do
    where the teacher alone would never have been. A recurrent actor learns from whole flights, any other from steps.

    Args:
        model: an on-policy model (its policy has `get_distribution`); only its policy is changed.
        scenario: what to fly.
        teacher: policy name.
        episodes: flown, `BLOCK` at once; epochs: passes over all their steps.
        learning_rate: of Adam.
        noise: standard deviation of the disturbance of commands in [−1, 1].
        seed: of episodes, disturbance and order.
        critic: weight of the critic's share of the loss: the mean square error of its values against the discounted
            rewards that the flights earned, over their variance. A critic that knows nothing would at first spoil
            what the actor has learned.
        mirror: learn from the mirror image of every flight too, with left and right exchanged; a teacher that treats
            the two sides alike would have flown it so.
        truth: what the critic of an `agents.asymmetric.AsymmetricPolicy` sees beside the belief.
        team: the agents that share the actor: each learns its part of the teacher's actions from what it sees.
    """
    policy: Any = model.policy
    blocks = [
        _demonstrations(
            scenario, teacher, min(BLOCK, episodes - at), noise, seed + at, getattr(model, "gamma", 1.0), mirror, truth,
            team,
        )
        for at in range(0, episodes, BLOCK)
    ]  # fmt: skip
    flights = [np.concatenate(parts, axis=1) for parts in zip(*blocks, strict=True)]
    length = scenario.steps if isinstance(policy, RecurrentActorCriticPolicy) else 1
    x, y, earned = (_in_sequences(part, length).to(policy.device) for part in flights)
    optimizer = torch.optim.Adam(policy.parameters(), learning_rate)
    choices = isinstance(model.action_space, spaces.MultiDiscrete)
    order = torch.Generator().manual_seed(seed)
    loss = torch.zeros(())
    spread = earned.var().clamp(min=1e-6)
    for _ in range(epochs):
        for rows in torch.randperm(len(x), generator=order).split(max(BATCH // length, 1)):
            actor, values = _read(policy, x[rows])
            taught = y[rows].flatten(0, 1)
            loss = -actor.log_prob(taught).mean() if choices else functional.mse_loss(actor.mode(), taught)
            if critic > 0.0:
                loss = loss + critic * functional.mse_loss(values, earned[rows].flatten()) / spread
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
    return float(loss.detach())


def _in_sequences(part: np.ndarray, length: int) -> torch.Tensor:
    """Flights [k, e, …] as sequences [n, length, …]: of one step, or whole."""
    flights = torch.as_tensor(part)
    return flights.flatten(0, 1).unsqueeze(1) if length == 1 else flights.swapaxes(0, 1)


def _read(policy: Any, x: torch.Tensor) -> tuple[Any, torch.Tensor]:
    """Distribution of commands and values [n·k] along sequences of observations [n, k, d] that begin episodes."""
    flat = x.flatten(0, 1)
    if not isinstance(policy, RecurrentActorCriticPolicy):
        return policy.get_distribution(flat), policy.predict_values(flat)[:, 0]
    layers, _, hidden = policy.lstm_hidden_state_shape
    fresh = torch.zeros(layers, len(x), hidden, device=x.device)
    states, within = (fresh, fresh), torch.zeros(len(flat), device=x.device)
    return policy.get_distribution(flat, states, within)[0], policy.predict_values(flat, states, within)[:, 0]


def _demonstrations(
    scenario: Any,
    teacher: str,
    episodes: int,
    noise: float,
    seed: int,
    gamma: float,
    mirror: bool,
    truth: TruthObservation | None = None,
    team: Team | None = None,
) -> tuple[np.ndarray, ...]:
    """Disturbed flights: observations [k, e, d], the teacher's actions [k, e, a], discounted rewards to go [k, e]."""
    env = PassiveVectorEnv(scenario, num_envs=episodes, autoreset_mode="disabled")
    observation, _ = env.reset(seed=seed)
    policy = make_policy(teacher, scenario, seed)
    if sees_world(policy):
        raise ValueError(f"teacher {teacher!r} looks at the truth: imitate one that decides from the belief")
    policy.reset(env.belief())
    rng = np.random.default_rng(seed)
    observations, truths, actions, rewards = [], [], [], []
    codec = env.simulation.actions
    drift = np.zeros((episodes, codec.size))
    shaken = rng.random((episodes, 1)) < 0.5  # half the flights also drift off for longer
    for _ in range(scenario.steps):
        belief = env.belief()
        command = policy.act(belief, observation)
        observations.append(observation if team is None else team.observe(belief, observation))
        if truth is not None:
            truths.append(truth(env.world))
        actions.append(codec.encode(command, belief))
        drift = 0.8 * drift + noise * rng.standard_normal(command.shape)
        disturbed = command + noise * rng.standard_normal(command.shape) + shaken * drift
        observation, reward, *_ = env.step(codec.encode(np.clip(disturbed, -1.0, 1.0), belief))
        rewards.append(reward)
    for k in range(len(rewards) - 2, -1, -1):
        rewards[k] = rewards[k] + gamma * rewards[k + 1]
    y, earned = np.array(actions), np.array(rewards, dtype=np.float32)
    seen = [(np.array(observations), env.simulation.observation.mirrored if team is None else team.mirrored)]
    if truth is not None:
        seen.append((np.array(truths), truth.mirrored))
    x = np.concatenate([part for part, _ in seen], axis=-1)
    if mirror:
        x = np.concatenate([x, np.concatenate([image(part) for part, image in seen], axis=-1)], axis=1)
        y = np.concatenate([y, codec.mirrored(y)], axis=1)
        earned = np.concatenate([earned, earned], axis=1)
    return (x, y, earned) if team is None else _dealt(team, x, y, earned)


def _dealt(team: Team, x: np.ndarray, y: np.ndarray, earned: np.ndarray) -> tuple[np.ndarray, ...]:
    """Flights of agents, [k, e s, …], of what they saw [k, e, s, d], the teacher's actions [k, e, a] and rewards."""
    steps, _, size, width = x.shape
    actions = team.split(y)
    rows = (x.reshape(steps, -1, width), actions.reshape(steps, -1, actions.shape[-1]))
    return *rows, np.repeat(earned, size, axis=1)
