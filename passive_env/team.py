"""Platforms as agents: who commands what, who sees what, who earns what; over whole batches of episodes.

`Team` belongs to a simulation and holds no state of any episode. The single environment of several agents
(`passive_env.pettingzoo_env`) and the batch of them (`passive_env.team_vector_env`) are both thin about it.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from gymnasium import spaces

from passive_env.actions import GUIDED
from passive_env.core import Simulation, World, map_rows
from passive_env.observations import LIMIT, Field

VIEWS = ("common", "own")
"""What an agent sees: the observation of the common track and of all platforms, or its own place and returns alone."""

REWARDS = ("team", "difference")
"""What an agent earns: the environment's reward, or by how much it is larger than if this agent had idled."""


class Steering(NamedTuple):
    """Which numbers of a command steer which platform; s platforms, k numbers each.

    Attributes:
        columns: [s, k] their places in the command.
        idle: [k] what commands a platform that does nothing.
    """

    columns: np.ndarray
    idle: np.ndarray


def kind_by_kind(platforms: int, idle: Sequence[float]) -> Steering:
    """Commands that say the first number of all platforms, then the second one of all, and so on."""
    kinds = len(idle)
    return Steering(np.arange(kinds * platforms).reshape(kinds, platforms).T.copy(), np.array(idle))


def one_by_one(platforms: int, idle: Sequence[float]) -> Steering:
    """Commands that say all numbers of the first platform, then all of the second one, and so on."""
    kinds = len(idle)
    return Steering(np.arange(kinds * platforms).reshape(platforms, kinds), np.array(idle))


class Team:
    """A scenario's platforms as agents, all with the same spaces; e episodes, s agents, k numbers of an action.

    Observation: with view "common" the environment's own observation, made of the common track and all platforms; with
        view "own" what the platform knows by itself (`make_own_observation` of the scenario: its place and motion and
        the returns of its own sensor). Then ``agent.isN``, 1 for the agent's own number N, so that agents that share a
        network may act differently. `fields` names every number.
    Action: the agent's own numbers of the environment's action, in their order there, a `Box` or `MultiDiscrete`.

    Args:
        simulation: the environment's parts.
        view: one of `VIEWS`; reward: one of `REWARDS`.
    Raises:
        ValueError: unknown names, fewer than two steered platforms, or view "own" where a platform's actions or returns
            have to do with the common track.
    """

    def __init__(self, simulation: Simulation, view: str = "common", reward: str = "team"):
        _check("view", view, VIEWS)
        _check("reward", reward, REWARDS)
        self.simulation, self.view, self.reward = simulation, view, reward
        self.steering = _steering(simulation.scenario)
        self._own = _own_observation(simulation.scenario) if view == "own" else None
        seen = simulation.observation.fields if self._own is None else self._own.fields
        size = len(self.steering.columns)
        self.agents = tuple(f"platform_{i}" for i in range(size))
        self.fields: tuple[Field, ...] = (*seen, *(Field(f"agent.is{i}", "1", "its number") for i in range(size)))
        self.observation_space = spaces.Box(-LIMIT, LIMIT, (len(self.fields),), np.float32)
        self.action_space = _share(simulation.actions.space, self.steering.columns)
        self._numbers = np.eye(size, dtype=np.float32)

    @property
    def needs_belief(self) -> bool:
        """Whether the environment's own observation does not tell what agents see."""
        return self._own is not None

    def observe(self, belief: Any, observation: np.ndarray | None = None) -> np.ndarray:
        """Observations [e, s, d] float32.

        Args:
            belief: of e episodes; not used with view "common" if the observation is there.
            observation: the environment's own [e, …]; None makes it of the belief where it is needed.
        """
        if self._own is not None:
            seen = self._own(belief)
        else:
            seen = (self.simulation.observation(belief) if observation is None else observation)[:, None]
        size, width = len(self.agents), seen.shape[-1]
        told = np.empty((len(seen), size, width + size), dtype=np.float32)
        told[..., :width] = seen
        told[..., width:] = self._numbers
        return told

    def mirrored(self, observation: np.ndarray) -> np.ndarray:
        """Observations [..., d] of the mirrored worlds, with view "common": left is right, agents keep their numbers.

        Raises:
            ValueError: another view.
        """
        if self._own is not None:
            raise ValueError(f"view = {self.view!r}: only observations with view 'common' are mirrored")
        width = observation.shape[-1] - len(self.agents)
        seen = self.simulation.observation.mirrored(observation[..., :width])
        return np.concatenate([seen, observation[..., width:]], axis=-1)

    def joined(self, actions: np.ndarray) -> np.ndarray:
        """The environment's actions [e, a] of the agents' [e, s, k]."""
        whole = np.empty((len(actions), self.steering.columns.size), dtype=actions.dtype)
        whole[:, self.steering.columns] = actions
        return whole

    def split(self, actions: np.ndarray) -> np.ndarray:
        """The agents' actions [..., s, k] of the environment's [..., a]."""
        return actions[..., self.steering.columns]


class IdleWorlds:
    """For every agent the same episodes in which it idles from the first step on, while the others do what they do.

    They give the difference reward of agent i in every step,

        D_i = G(z) − G(z₋ᵢ, idle)

    with G the environment's reward in the episodes z as they are flown. The second term is that of the same tapes with
    all of the agent's commands replaced by its `Steering.idle` and those of the others left as they are. As long as the
    others keep to their commands it has nothing to do with what the agent does: whatever raises the agent's sum of D
    raises the sum of G alike. But D lacks most of what the others and the tape's luck do to G.

    Source: Wolpert and Tumer (2001), "Optimal payoff functions for members of collectives", Advances in Complex Systems
    4(2/3), 265–279: the utility with the agent's whole history clamped. Their clamping vector is ours to choose.

    Args:
        team: whose simulation and steering are taken.
    """

    def __init__(self, team: Team):
        self._simulation, size = team.simulation, len(team.agents)
        columns, idle = team.steering
        self._idles = np.zeros((size, 1, columns.size), dtype=bool)
        self._idle = np.empty(columns.size)
        for i in range(size):
            self._idles[i, 0, columns[i]] = True
            self._idle[columns[i]] = idle
        self._worlds: World | None = None

    def begin(self, world: World) -> None:
        """Copy the world [e, …] of an episode's begin for every agent: agent i's are rows i e … i e + e − 1."""
        self._worlds = map_rows(lambda part: np.concatenate([part] * len(self._idles)), world)

    def difference(self, command: np.ndarray, reward: np.ndarray) -> np.ndarray:
        """Difference rewards [e, s] of a step of commands [e, a] that earned rewards [e]."""
        assert self._worlds is not None
        flown = np.where(self._idles, self._idle, command).reshape(-1, command.shape[1])
        self._worlds, earned, _ = self._simulation.advance(self._worlds, flown)
        return reward[:, None] - earned.reshape(len(self._idles), -1).T


def _check(name: str, value: Any, allowed: tuple[str, ...]) -> None:
    if not (isinstance(value, str) and value in allowed):
        raise ValueError(f"{name} = {value!r}: must be one of {', '.join(map(repr, allowed))}")


def _steering(scenario: Any) -> Steering:
    """A scenario's steering.

    Raises:
        ValueError: no two platforms are steered at a time.
    """
    steering = scenario.steering
    if steering is None:
        raise ValueError(
            f"{type(scenario).__name__}: agents are platforms, and at least two must be steered at a time; take "
            "TwoStation, AngleFusion, ManeuveringTarget, MobilePlacement or a variant of them"
        )
    return steering


def _own_observation(scenario: Any) -> Any:
    """What platforms know by themselves.

    Raises:
        ValueError: what actions mean depends on more than that, or the scenario has no such share.
    """
    if scenario.actions in GUIDED:
        raise ValueError(
            f"{type(scenario).__name__}.actions = {scenario.actions!r}: these are told off the common track, which a "
            "platform alone does not know; take actions='continuous' or 'discrete', or view='common'"
        )
    return scenario.make_own_observation()


def _share(space: Any, columns: np.ndarray) -> spaces.Box | spaces.MultiDiscrete:
    """The space of one agent's actions; the first one's is every other's."""
    own = columns[0]
    if isinstance(space, spaces.MultiDiscrete):
        return spaces.MultiDiscrete(space.nvec[own])
    return spaces.Box(space.low[own], space.high[own])
