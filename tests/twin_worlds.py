"""Twin runs for tests: the same bearings reach the tracker, but the truth behind them is another."""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from passive_env.core import map_rows

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
    simulation = scenario.make_simulation()
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
    family = type(scenario)
    make_sensors = family.make_sensors
    scans = []

    class Recorder(Wrapper):
        def acquire(self, tape):
            scans.append(self.sensors.acquire(tape))
            return scans[-1]

        def sense(self, *args):
            scans.append(self.sensors.sense(*args))
            return scans[-1]

    class Replayer(Wrapper):
        def acquire(self, tape):
            tape, sighting = scans.pop(0)
            tape = tape._replace(targets=tape.targets + shift(tape.targets.shape[-1]), noise=-tape.noise)
            return tape, sighting._replace(truth=tape.targets[:, 0])

        def sense(self, tape, step, platforms, predicted):
            return scans.pop(0)._replace(truth=tape.targets[np.arange(len(step)), step])

    runs = []
    for twin in (Recorder, Replayer):
        with monkeypatch.context() as patch:
            patch.setattr(family, "make_sensors", lambda self, tracker, twin=twin: twin(make_sensors(self, tracker)))
            runs.append(fly(scenario, decide(), seeds))
    assert scans == []
    return runs


def shift(length):
    """SHIFT of a planar state of four numbers or, level, of one in space of six."""
    return SHIFT if length == 4 else np.insert(SHIFT, (2, 4), 0.0)


def random_decisions(seed: int = 0) -> Callable[[], Callable[[Any, Any], Any]]:
    """A maker of decision functions that all decide at random alike."""

    def make():
        rng = np.random.default_rng(seed)
        return lambda belief, observation: rng.uniform(-1.0, 1.0, belief.last_action.shape)

    return make


def assert_twins_look_alike(first: Flown, second: Flown) -> None:
    """Every reward differs, for it knows the truth; observations and beliefs are the same bit for bit."""
    assert not any(np.array_equal(a, b) for a, b in zip(first.rewards, second.rewards, strict=True))
    for a, b in zip(first.observations, second.observations, strict=True):
        np.testing.assert_array_equal(a, b)
    for a, b in zip(first.beliefs, second.beliefs, strict=True):
        map_rows(np.testing.assert_array_equal, a, b)


def assert_blind_to_truth(simulation: Any, world: Any, **truths: Any) -> None:
    """Observation and belief stay as they are when tape, truth, bound, metrics and what else is named are not."""
    names = ("tape", "truth", "bound", "metrics")
    rubbish = map_rows(lambda a: np.full_like(a, 77), tuple(getattr(world, name) for name in names))
    perturbed = world._replace(**dict(zip(names, rubbish, strict=True)), **truths)
    np.testing.assert_array_equal(simulation.observe(perturbed), simulation.observe(world))
    map_rows(np.testing.assert_array_equal, simulation.belief(perturbed), simulation.belief(world))


class Wrapper:
    """Sensors that pass everything on to others."""

    def __init__(self, sensors):
        self.sensors = sensors

    def __getattr__(self, name):
        return getattr(self.sensors, name)
