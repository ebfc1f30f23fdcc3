"""The record of one episode under one policy: arrays over time, as a replay draws them.

Things come and go (returns, hypotheses, fixes): a layer's arrays are as large as at its fullest instant, and NaN where
there is nothing.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from agents.policy import Policy, sees_world
from passive_env.core import World
from passive_env.env import PassiveEnv
from passive_env.layers import STYLES, Instant


class Flight(NamedTuple):
    """One episode as it was flown.

    Attributes:
        worlds: [k + 1] the true worlds, batches of one.
        rewards: by term, [k + 1] what each step earned; NaN at the first instant, before any step.
    """

    worlds: list[World]
    rewards: dict[str, np.ndarray]


class ViewRecord(NamedTuple):
    """One drawing over time.

    Attributes:
        name, axes, names, equal: as of `passive_env.layers.View`.
        layers: by name, [k, g, n, c]; k is 1 where nothing changes.
        reach: [k] half width of axes that follow the instant; None: they hold still.
    """

    name: str
    axes: tuple[str, str]
    names: dict[str, tuple[str, ...]]
    equal: bool
    layers: dict[str, np.ndarray]
    reach: np.ndarray | None


class EpisodeRecord(NamedTuple):
    """An episode of k instants with m targets.

    Attributes:
        at: [k] places on the time axis.
        labels: [k] the same in words.
        views: the map first.
        errors: by kind ("range", "position"), errors and Cramér–Rao bounds, each [k, m] m.
        rewards: by term, [k] what the step earned; NaN where there was none.
        probabilities: by name, [k].
    """

    at: np.ndarray
    labels: list[str]
    views: tuple[ViewRecord, ...]
    errors: dict[str, tuple[np.ndarray, np.ndarray]]
    rewards: dict[str, np.ndarray]
    probabilities: dict[str, np.ndarray]


def fly_once(scenario: Any, policy: Policy, seed: int) -> Flight:
    """Fly a policy through the episode of a seed and keep every world."""
    env = PassiveEnv(scenario)
    observation, _ = env.reset(seed=seed)
    belief, worlds, earned = env.belief(), [env.world], []
    policy.reset(belief)
    done = False
    while not done:
        if sees_world(policy):
            seer: Any = policy
            seer.see(env.world)
        commands = policy.act(belief, observation[None])
        action = env.simulation.actions.encode(commands, belief)[0]
        observation, _, _, done, info = env.step(action)
        belief = env.belief()
        worlds.append(env.world)
        earned.append(info["reward_terms"])
    return Flight(worlds, {name: np.array([np.nan, *(terms[name] for terms in earned)]) for name in earned[0]})


def record(scenario: Any, flight: Flight) -> EpisodeRecord:
    """Arrays over time of an episode.

    A step's reward stands at its first instant; a world may tell of several (a track run after the last placement).
    """
    simulation = scenario.make_simulation()
    told = [scenario.make_instants(world, simulation) for world in flight.worlds]
    firsts = np.cumsum([0, *(len(instants) for instants in told[:-1])])
    instants = [instant for several in told for instant in several]
    rewards = {name: np.full(len(instants), np.nan) for name in flight.rewards}
    for name, values in flight.rewards.items():
        rewards[name][firsts] = values
    views = tuple(_view(several) for several in zip(*(instant.views for instant in instants), strict=True))
    return EpisodeRecord(
        np.array([instant.at for instant in instants]), [instant.label for instant in instants], views,
        _errors(instants), rewards, _probabilities(instants),
    )  # fmt: skip


def _view(several: Sequence[Any]) -> ViewRecord:
    """One view's instants as arrays; layers in the order in which they are drawn."""
    first = several[0]
    present = {name for view in several for name in view.layers}
    layers = {name: stack([view.layers.get(name) for view in several]) for name in STYLES if name in present}
    reach = None if first.reach is None else np.array([view.reach for view in several])
    return ViewRecord(first.name, first.axes, first.names, first.equal, layers, reach)


def stack(rows: Sequence[np.ndarray | None]) -> np.ndarray:
    """Arrays [g, n, c] of different g and n (None: there is nothing) over time: [k, g, n, c], missing rows NaN.

    What never changes keeps one instant; infinities, which nobody could draw, are NaN.
    """
    shapes = np.array([row.shape for row in rows if row is not None])
    stacked = np.full((len(rows), *shapes.max(0)), np.nan)
    for t, row in enumerate(rows):
        if row is not None:
            stacked[t, : row.shape[0], : row.shape[1]] = row
    stacked[~np.isfinite(stacked)] = np.nan
    still = all(np.array_equal(stacked[0], later, equal_nan=True) for later in stacked[1:])
    return stacked[:1] if still else stacked


def _errors(instants: Sequence[Instant]) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    kinds = instants[0].errors
    return {
        kind: tuple(np.stack([instant.errors[kind][part] for instant in instants]) for part in (0, 1)) for kind in kinds
    }  # pyright: ignore[reportReturnType]  two parts


def _probabilities(instants: Sequence[Instant]) -> dict[str, np.ndarray]:
    names = instants[0].probabilities
    return {name: np.array([instant.probabilities[name] for instant in instants], dtype=float) for name in names}


def record_all(scenario: Any, flights: Mapping[str, Flight]) -> dict[str, EpisodeRecord]:
    """Records of several policies' flights on the same tape."""
    return {name: record(scenario, flight) for name, flight in flights.items()}
