"""The environment of several agents with PettingZoo's interface: one episode, a platform per agent."""

from __future__ import annotations

import copy
from collections.abc import Mapping
from typing import Any

import gymnasium as gym
import numpy as np
from pettingzoo import ParallelEnv

from passive_env.belief import Belief
from passive_env.core import World
from passive_env.env import PassiveEnv
from passive_env.observations import Field
from passive_env.scenario import Scenario
from passive_env.team import IdleWorlds, Team

NUMBERS = "biuf"
"""Kinds of arrays of numbers: bool, signed, unsigned, float."""


class PassiveParallelEnv(ParallelEnv[str, np.ndarray, Any]):
    """One episode in which every platform is an agent: ``platform_0``, ``platform_1``, … in the scenario's order.

    It is the single environment (`passive_env.env.PassiveEnv`) with its action and observation dealt out: the same seed
    and the same actions give the same episode bit for bit.

    Observation, action: as of `passive_env.team.Team`; `observation_fields` names every number of the observation.
    Reward: with "team" every agent earns the environment's reward, with "difference" by how much that is larger than if
        the agent had idled all along (`passive_env.team.IdleWorlds`); that takes about as long again as a step.
    Episode end: all agents are truncated together after ``steps`` decisions; never terminated.
    infos: for every agent what the environment's `info` shows, truth included, and ``team_reward``. Agents' infos share
        their arrays.
    state: the environment's own observation, made of the common track and all platforms.

    Args:
        scenario: catalogue name or a `Scenario`.
        view, reward: as of `passive_env.team.Team`.
        render_mode: None, "rgb_array" or "human".
        **fields: scenario fields to override.
    Raises:
        ValueError: bad values, or an environment without two steered platforms.
    """

    metadata: dict[str, Any] = {  # noqa: RUF012  copied, never changed
        **PassiveEnv.metadata, "name": "passive_env", "is_parallelizable": True,
    }  # fmt: skip

    def __init__(
        self,
        scenario: str | Scenario = "TwoStation",
        view: str = "common",
        reward: str = "team",
        render_mode: str | None = None,
        **fields: Any,
    ):
        self._env = PassiveEnv(scenario, render_mode, **fields)
        self.team = Team(self._env.simulation, view, reward)
        self._idle = IdleWorlds(self.team) if reward == "difference" else None
        self.scenario, self.render_mode = self._env.scenario, render_mode
        self.metadata = {**type(self).metadata, "name": type(self.scenario).__name__}
        self.possible_agents: list[str] = list(self.team.agents)
        self.agents: list[str] = []
        self.observation_spaces = {agent: copy.deepcopy(self.team.observation_space) for agent in self.possible_agents}
        self.action_spaces = {agent: copy.deepcopy(self.team.action_space) for agent in self.possible_agents}
        self.state_space = self._env.observation_space
        self._shape = self.team.steering.columns.shape

    @property
    def observation_fields(self) -> tuple[Field, ...]:
        """Name, unit and scale of every number of an agent's observation; the same for all agents."""
        return self.team.fields

    @property
    def world(self) -> World:
        """The true world, a batch of one; for evaluation and pictures, never for policies."""
        return self._env.world

    def belief(self) -> Belief:
        """What an operator knows now, a batch of one."""
        return self._env.belief()

    def observation_space(self, agent: str) -> gym.Space:
        """Space of an agent's observations."""
        return self.observation_spaces[agent]

    def action_space(self, agent: str) -> gym.Space:
        """Space of an agent's actions."""
        return self.action_spaces[agent]

    def reset(self, seed: int | None = None, options: dict[str, Any] | None = None):
        """Begin an episode; returns observations and infos by agent."""
        info = self._env.begin(seed)
        if self._idle is not None:
            self._idle.begin(self._env.world)
        self.agents = list(self.possible_agents)
        return self._observations(), self._infos(info, 0.0)

    def step(self, actions: Mapping[str, Any]):
        """Fly one step; returns observations, rewards, terminations, truncations and infos by agent.

        Raises:
            ValueError: actions of other agents than the living ones, of the wrong shape, or with values that are none.
            gymnasium.error.ResetNeeded: before the first reset or after the episode's end.
        """
        if not self.agents:
            raise gym.error.ResetNeeded("no agent is in an episode: call reset() before step()")
        reward, truncated, info = self._env.fly(self._joined(actions))
        agents = self.agents
        self.agents = [] if truncated else list(agents)
        return (
            self._observations(), self._rewards(reward), dict.fromkeys(agents, False),
            dict.fromkeys(agents, truncated), self._infos(info, reward),
        )  # fmt: skip

    def state(self) -> np.ndarray:
        """The environment's own observation [d] float32: what an operator sees of all."""
        return self._env.simulation.observe(self._env.world)[0]

    def render(self):
        """Picture of the moment, as of `passive_env.env.PassiveEnv`."""
        return self._env.render()

    def close(self) -> None:
        """Close the window, if any."""
        self._env.close()

    def _observations(self) -> dict[str, np.ndarray]:
        return dict(zip(self.possible_agents, self.team.observe(self._env.belief())[0], strict=True))

    def _rewards(self, reward: float) -> dict[str, float]:
        if self._idle is None:
            return dict.fromkeys(self.possible_agents, reward)
        earned = self._idle.difference(self._env.world.last_action, np.array([reward]))[0]
        return dict(zip(self.possible_agents, earned.tolist(), strict=True))

    def _infos(self, info: dict[str, Any], reward: float) -> dict[str, dict[str, Any]]:
        return {agent: {**info, "team_reward": reward} for agent in self.possible_agents}

    def _joined(self, actions: Any) -> np.ndarray:
        """The environment's action [a] of all agents'."""
        if not isinstance(actions, Mapping) or actions.keys() != set(self.agents):
            given = ", ".join(map(str, actions)) if isinstance(actions, Mapping) else repr(actions)
            raise ValueError(f"actions: got {given or 'none'}, must be a dict with one for each of {self.agents}")
        try:
            own = np.array([actions[agent] for agent in self.agents])
        except ValueError:  # of different shapes
            own = None
        if own is None or own.shape != self._shape or own.dtype.kind not in NUMBERS or not np.isfinite(own).all():
            raise next(filter(None, (self._refusal(agent, actions[agent]) for agent in self.agents)))
        return self.team.joined(own[None])[0]

    def _refusal(self, agent: str, action: Any) -> ValueError | None:
        """What is wrong with an agent's action; None if nothing is."""
        shape = self._shape[1:]
        try:
            values = np.array(action)
        except ValueError:
            values = np.array(None)
        if values.dtype.kind not in NUMBERS:
            return ValueError(f"action of {agent}: {action!r}, must be numbers of shape {shape}")
        if values.shape != shape:
            return ValueError(f"action of {agent}: has shape {values.shape}, must have shape {shape}")
        if not np.isfinite(values).all():
            return ValueError(f"action of {agent}: {action!r}, every value must be a finite number")
        return None
