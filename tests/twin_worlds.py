"""Twin runs for tests: the same bearings reach the tracker, but the truth behind them is another."""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from passive_env import core
from passive_env.core import Simulation

SHIFT = np.array([23e3, -17e3, 40.0, -70.0])
"""Truth of the second twin minus truth of the first [m, m/s]."""


class Flown(NamedTuple):
    """One run, instant by instant: belief, observation, command (none at the end), true targets, reward."""

    beliefs: list[Any]
    observations: list[Any]
    commands: list[Any]
    truth: list[Any]
    rewards: list[Any]


def fly(scenario: Any, decide: Callable[[Any, Any], Any], seeds: range) -> Flown:
    """Fly whole episodes; `decide` maps belief and observation to commands [e, a]."""
    simulation = Simulation(scenario)
    world = simulation.begin([np.random.default_rng(seed) for seed in seeds])
    flown = Flown([], [], [], [world.truth], [])
    for _ in range(scenario.steps):
        flown.beliefs.append(simulation.belief(world))
        flown.observations.append(simulation.observe(world))
        flown.commands.append(decide(flown.beliefs[-1], flown.observations[-1]))
        world, reward, _ = simulation.advance(world, flown.commands[-1])
        flown.truth.append(world.truth)
        flown.rewards.append(reward)
    flown.beliefs.append(simulation.belief(world))
    flown.observations.append(simulation.observe(world))
    return flown


def fly_twins(monkeypatch, scenario: Any, decide: Callable[[], Callable[[Any, Any], Any]], seeds: range):
    """A run, and its twin whose targets are elsewhere while every scan repeats the first run's, slot by slot.

    `decide` makes a decision function anew for each run.
    """
    sense, draw_tape = core.sense, type(scenario).draw_tape
    scans = []

    def record(*args, **kwargs):
        scans.append(sense(*args, **kwargs))
        return scans[-1]

    def replay(tape, step, *args, **kwargs):
        sighting = scans.pop(0)
        return sighting._replace(truth=np.take_along_axis(tape.targets, step[:, None, None, None], axis=1)[:, 0])

    def shifted(self, generators):
        tape = draw_tape(self, generators)
        return tape._replace(targets=tape.targets + SHIFT, noise=-tape.noise)

    with monkeypatch.context() as patch:
        patch.setattr(core, "sense", record)
        first = fly(scenario, decide(), seeds)
    with monkeypatch.context() as patch:
        patch.setattr(core, "sense", replay)
        patch.setattr(type(scenario), "draw_tape", shifted)
        second = fly(scenario, decide(), seeds)
    assert scans == []
    return first, second
