"""The world's one loop, over whole batches: move, sense, track, measure, reward, observe.

Nothing here knows which family of scenarios runs; the scenario names the parts:

    draw_tape(generators)       randomness, true paths and start of the platforms
    move(platforms, command)    platforms after one step
    make_sensors(tracker)       one with acquire, sense, acquired, report, info (`passive_env.sensors.DirectionFinders`)
    make_metrics()              one with begin, advance, violations (`passive_env.metrics.BearingMetrics`)
    make_tracker, make_actions, make_observation, reward_weights

Scenarios whose episodes run otherwise make a simulation of their own, as `passive_env.placement_simulation` is one.

Everything is a pure function of the world and the action: a `World` is never changed in place, so a planner may keep
one and imagine.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from passive_env.belief import Belief
from passive_env.metrics import Violations
from passive_env.rewards import Moment, evaluate
from trackers.gaussian import Gaussian


class World(NamedTuple):
    """Everything about e episodes at one instant; every array's first axis is the environment.

    Tape, reports and metrics are the family's own tuples; `reports` is what the last scan brought, `start` where the
    platforms were at the first one.
    """

    step: Any
    platforms: Any
    tape: Any
    track_state: Any
    estimate: Gaussian
    reports: Any
    last_action: Any
    bound: Any
    truth: Any
    metrics: Any
    violations: Violations
    start: Any = ()


class Simulation:
    """A scenario's parts, put together once; holds no state of any episode."""

    def __init__(self, scenario: Any):
        self.scenario = scenario
        self.tracker = scenario.make_tracker()
        self.actions = scenario.make_actions()
        self.observation = scenario.make_observation()
        self.sensors = scenario.make_sensors(self.tracker)
        self.metrics = scenario.make_metrics()

    def begin(self, generators: Sequence[np.random.Generator]) -> World:
        """Draw a tape per generator, take the first scan and start the tracks; track j is scored against target j."""
        tape, sighting = self.sensors.acquire(self.scenario.draw_tape(generators))
        state = self.tracker.initiate(sighting.scan)
        estimate = self.tracker.estimate(state)
        check_estimate(estimate, sighting.truth.shape, self.tracker)
        reports = self.sensors.acquired(sighting, state)
        bound, metrics = self.metrics.begin(estimate, sighting.truth, tape.platforms, tape, reports)
        batch = len(generators)
        return World(
            np.zeros(batch, dtype=np.int64), tape.platforms, tape, state, estimate, reports,
            np.zeros((batch, self.actions.size)), bound, sighting.truth, metrics,
            self.metrics.violations(tape.platforms, sighting.truth, tape), tape.platforms,
        )  # fmt: skip

    def advance(self, world: World, command: Any) -> tuple[World, Any, dict[str, Any]]:
        """One step of all episodes under commands [e, a] in [−1, 1]: new world, reward [e], reward terms."""
        step = world.step + 1
        platforms = self.move(world, command)
        predicted = self.tracker.predict(world.track_state, self.scenario.step_s)
        sighting = self.sense(world, step, platforms, predicted, command)
        update = self.tracker.update(predicted, sighting.scan)
        estimate = self.tracker.estimate(update.posterior)
        _check_shapes(estimate, sighting.truth.shape, self.tracker)
        reports = self.sensors.report(sighting, update)
        bound, metrics = self.metrics.advance(estimate, sighting.truth, world.bound, platforms, world.tape, reports)
        new = World(
            step, platforms, world.tape, update.posterior, estimate, reports, command, bound, sighting.truth, metrics,
            self.metrics.violations(platforms, sighting.truth, world.tape), world.start,
        )  # fmt: skip
        moment = Moment(metrics, world.metrics, new.violations, command, self.finished(new))
        reward, terms = evaluate(self.scenario.reward_weights, moment)
        return new, reward, terms

    def move(self, world: World, command: Any) -> Any:
        """Platforms [e, s, n] after one step."""
        return self.scenario.move(world.platforms, command)

    def sense(self, world: World, step: Any, platforms: Any, predicted: Any, command: Any) -> Any:
        """The scan after a step, by platforms that have moved; a family's may depend on what was commanded."""
        return self.sensors.sense(world.tape, step, platforms, predicted)

    def command(self, world: World, values: Any) -> Any:
        """Commands [e, a] of decoded actions [e, a], by what is known of a world."""
        return self.actions.commands(values, self.belief(world))

    def belief(self, world: World) -> Belief:
        """What an operator knows of the world."""
        told = world.reports
        return Belief(
            self.scenario.steps - world.step, world.platforms, world.estimate.mean, world.estimate.cov,
            told.assigned, told.returns, world.last_action, world.track_state, world.tape.discs,
            told.missed, told.available, told.model_probability, told.detected, told.acceleration,
            world.start, told.received,
        )  # fmt: skip

    def observe(self, world: World) -> Any:
        """Observations [e, d] float32, from the belief."""
        return self.observation(self.belief(world))

    def finished(self, world: World) -> Any:
        """[e] bool: the episode's last decision has been taken."""
        return world.step >= self.scenario.steps

    def info(self, world: World) -> dict[str, Any]:
        """What `info` shows besides the reward's terms, each [e, …]; truth is used here."""
        depths = {f"{name}_violation": depth for name, depth in world.violations._asdict().items()}
        return world.metrics._asdict() | depths | self.sensors.info(world.reports)

    def history(self, world: World) -> dict[str, Any]:
        """Figures of finished episodes at the instants that `info` does not show one by one; here there are none."""
        return {}


def check_estimate(estimate: Any, shape: tuple[int, ...], tracker: Any) -> None:
    """Refuse a user's tracker whose first estimate is none.

    Raises:
        TypeError: no mean and cov; ValueError: wrong shapes, or variances that are not positive numbers.
    """
    _check_shapes(estimate, shape, tracker)
    variances = np.diagonal(estimate.cov, axis1=-2, axis2=-1)
    if not ((variances > 0.0) & np.isfinite(variances)).all():
        raise ValueError(f"tracker {type(tracker).__name__}: estimate() gave variances that are not positive numbers")


def _check_shapes(estimate: Any, shape: tuple[int, ...], tracker: Any) -> None:
    """Refuse what is no estimate of every target [e, m, 4]; what may become NaN on the way is cut where it is used.

    Raises:
        TypeError: no mean and cov; ValueError: wrong shapes, which kernels might broadcast.
    """
    name = f"tracker {type(tracker).__name__}: estimate()"
    if not (hasattr(estimate, "mean") and hasattr(estimate, "cov")):
        raise TypeError(f"{name} gave {type(estimate).__name__}, must give a trackers.gaussian.Gaussian (mean, cov)")
    found, wanted = (np.shape(estimate.mean), np.shape(estimate.cov)), (shape, (*shape, shape[-1]))
    if found != wanted:
        raise ValueError(f"{name} gave mean and cov of shapes {found}, must be {wanted}")


def map_rows(function: Any, *trees: Any) -> Any:
    """Apply a function to corresponding arrays of equal nestings of tuples and dataclasses (worlds, tracker states)."""
    first = trees[0]
    if dataclasses.is_dataclass(first) and not isinstance(first, type):
        names = [f.name for f in dataclasses.fields(first)]
        parts = {name: map_rows(function, *(getattr(tree, name) for tree in trees)) for name in names}
        return dataclasses.replace(first, **parts)
    if isinstance(first, tuple):
        parts = [map_rows(function, *children) for children in zip(*trees, strict=True)]
        return type(first)(*parts) if hasattr(first, "_fields") else tuple(parts)
    return function(*trees)


def replace_rows(world: World, rows: np.ndarray, fresh: World) -> World:
    """A world in which the given rows are those of a fresh one."""

    def put(old, new):
        merged = old.copy()
        merged[rows] = new
        return merged

    return map_rows(put, world, fresh)
