"""The batch of environments of several agents, one row per agent: for learners whose agents share one network."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space

from passive_env.core import World
from passive_env.observations import Field
from passive_env.scenario import Scenario
from passive_env.team import IdleWorlds, Team
from passive_env.vector_env import PassiveVectorEnv


class TeamVectorEnv(VectorEnv):
    """`num_envs` episodes of s agents each as ``num_envs · s`` rows; agent i of episode j is row j s + i.

    The rows of an episode equal `passive_env.pettingzoo_env.PassiveParallelEnv` with seed + j, bit for bit. Every
    episode lasts ``steps`` decisions, so all end together and begin anew in the same step; ``final_obs`` and
    ``final_info`` hold what the ended ones showed.

    Observation, action, reward: as of `passive_env.team.Team`.
    info: what the environment shows, once per agent, and ``team_reward``.

    Args:
        scenario: catalogue name or a `Scenario`.
        num_envs: number of episodes at once.
        view, reward: as of `passive_env.team.Team`.
        threads: worker threads; None takes all cores, 1 none.
        **fields: scenario fields to override.
    """

    def __init__(
        self,
        scenario: str | Scenario = "TwoStation",
        num_envs: int = 1,
        view: str = "common",
        reward: str = "team",
        threads: int | None = None,
        **fields: Any,
    ):
        self.episodes = PassiveVectorEnv(scenario, num_envs, AutoresetMode.DISABLED, threads, **fields)
        self.scenario, self.simulation = self.episodes.scenario, self.episodes.simulation
        self.team = Team(self.simulation, view, reward)
        self._idle = IdleWorlds(self.team) if reward == "difference" else None
        self.autoreset_mode = AutoresetMode.SAME_STEP
        self.metadata = {"render_modes": [], "autoreset_mode": self.autoreset_mode}
        self.render_mode = None
        self.num_envs = num_envs * len(self.team.agents)
        self.single_observation_space = self.team.observation_space
        self.single_action_space = self.team.action_space
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)
        self.action_space = batch_space(self.single_action_space, self.num_envs)

    @property
    def observation_fields(self) -> tuple[Field, ...]:
        """Name, unit and scale of every number of an agent's observation."""
        return self.team.fields

    @property
    def world(self) -> World:
        """The true world of all episodes; for evaluation and pictures, never for policies."""
        return self.episodes.world

    def reset(self, *, seed: int | Sequence[int | None] | None = None, options: dict[str, Any] | None = None):
        """Begin all episodes; seeds as of `PassiveVectorEnv`, one per episode.

        Raises:
            ValueError: a mask, or a list of seeds of the wrong length.
        """
        if options is not None and "reset_mask" in options:
            raise ValueError("reset_mask: all episodes begin together, leave it out")
        observation, info = self.episodes.reset(seed=seed)
        if self._idle is not None:
            self._idle.begin(self.episodes.world)
        return self._rows(observation), self._info(info, np.zeros(self.episodes.num_envs))

    def step(self, actions: Any):
        """Fly one step in every episode.

        Raises:
            ValueError: actions of the wrong shape or with values that are not finite.
        """
        shape = self.action_space.shape
        if np.shape(actions) != shape:
            raise ValueError(f"actions have shape {np.shape(actions)}, must have shape {shape}")
        of_agents = np.asarray(actions).reshape(self.episodes.num_envs, len(self.team.agents), -1)
        observation, reward, _, truncated, shown = self.episodes.step(self.team.joined(of_agents))
        seen, earned, info = self._rows(observation), self._earned(reward), self._info(shown, reward)
        done = np.repeat(truncated, len(self.team.agents))
        if done.any():
            final = {"final_obs": seen, "final_info": info} | {
                f"_final_{name}": done.copy() for name in ("obs", "info")
            }
            seen, info = self.reset()
            info |= final
        return seen, earned, np.zeros(self.num_envs, dtype=bool), done, info

    def render(self) -> None:
        """Batches of agents make no pictures."""

    def close_extras(self, **kwargs: Any) -> None:
        """Close the episodes' environment."""
        self.episodes.close()

    def _rows(self, observation: np.ndarray) -> np.ndarray:
        team = self.team
        seen = self.episodes.of_beliefs(team.observe) if team.needs_belief else team.observe(None, observation)
        return seen.reshape(self.num_envs, -1)

    def _earned(self, reward: np.ndarray) -> np.ndarray:
        if self._idle is None:
            return np.repeat(reward, len(self.team.agents))
        commands = self.episodes.of_beliefs(lambda belief: belief.last_action)
        return self._idle.difference(commands, reward).ravel()

    def _info(self, info: dict[str, Any], reward: np.ndarray) -> dict[str, Any]:
        size = len(self.team.agents)
        terms = {name: np.repeat(term, size) for name, term in info["reward_terms"].items()}
        rows = {name: np.repeat(value, size, axis=0) for name, value in info.items() if name != "reward_terms"}
        return rows | {"reward_terms": terms, "team_reward": np.repeat(reward, size)}
