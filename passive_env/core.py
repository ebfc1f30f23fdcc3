"""The world's one loop, over whole batches: move, sense, track, measure, reward, observe.

Nothing here knows which family of scenarios runs; the scenario names the parts. Everything is a pure function of the
world and the action: a `World` is never changed in place, so a planner may keep one and imagine.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from passive_env.belief import Belief
from passive_env.metrics import Metrics, Violations, measure, violations
from passive_env.rewards import Moment, evaluate
from passive_env.sensors import sense
from passive_env.tape import Tape
from trackers.bounds import bound_prior
from trackers.gaussian import Gaussian

PRIOR_VELOCITY_STD_M_S = 200.0
"""Velocity prior of the Cramér–Rao bound at the first scan, the trackers' own; the scenario supplies the range's."""
PRIOR_BEARING_STD_RAD = 10.0
"""Nothing is known across the line of sight before the first scan; its bearings are counted once, as every scan's."""


class World(NamedTuple):
    """Everything about e episodes at one instant; every array's first axis is the environment."""

    step: Any
    platforms: Any
    tape: Tape
    track_state: Any
    estimate: Gaussian
    assigned: Any
    returns: Any
    last_action: Any
    bound: Any
    truth: Any
    metrics: Metrics
    violations: Violations


class Simulation:
    """A scenario's parts, put together once; holds no state of any episode."""

    def __init__(self, scenario: Any):
        self.scenario = scenario
        self.tracker = scenario.make_tracker()
        self.actions = scenario.make_actions()
        self.observation = scenario.make_observation()
        self._all_stations = scenario.bearings == "all"
        self._std = math.radians(scenario.bearing_std_deg)
        # A missed bearing scales the expected information: the same as noise larger by 1/√P_D.
        self._bound_std = self._std / math.sqrt(scenario.detection_probability)

    def begin(self, generators: Sequence[np.random.Generator]) -> World:
        """Draw a tape per generator, take the first scan and start the tracks.

        Tracks follow the order of the reference station's first bearings, counter-clockwise; targets are renumbered
        to match, so track j is scored against target j.
        """
        tape = self.scenario.draw_tape(generators)
        batch = len(generators)
        step = np.zeros(batch, dtype=np.int64)
        sighting = sense(tape, step, tape.platforms, self._std, in_order=True)
        targets = tape.targets.shape[2]
        tape = _renumber(tape, sighting.origin[:, -1, :targets])
        truth = tape.targets[:, 0]
        scan = sighting.scan._replace(
            bearings=sighting.scan.bearings[..., :targets], valid=sighting.scan.valid[..., :targets]
        )
        state = self.tracker.initiate(scan)
        estimate = self.tracker.estimate(state)
        _check_estimate(estimate, truth.shape, self.tracker)
        stations = tape.platforms.shape[1]
        prior = bound_prior(
            truth, tape.platforms[:, None, -1, :2], PRIOR_BEARING_STD_RAD, self.scenario.bound_range_std_m,
            PRIOR_VELOCITY_STD_M_S,
        )  # fmt: skip
        bound, metrics = self._measure(estimate, truth, prior, tape.platforms, 0.0, self._std, all_stations=True)
        return World(
            step, tape.platforms, tape, state, estimate,
            np.ones((batch, targets, stations), dtype=bool), scan.valid.sum(-1),
            np.zeros((batch, self.actions.size)), bound, truth, metrics,
            violations(tape.platforms, truth, self.scenario.standoff_m, tape.discs),
        )  # fmt: skip

    def advance(self, world: World, command: Any) -> tuple[World, Any, dict[str, Any]]:
        """One step of all episodes under commands [e, a] in [−1, 1]: new world, reward [e], reward terms."""
        scenario = self.scenario
        step = world.step + 1
        platforms = scenario.move(world.platforms, command)
        sighting = sense(world.tape, step, platforms, self._std)
        update = self.tracker.update(self.tracker.predict(world.track_state, scenario.step_s), sighting.scan)
        estimate = self.tracker.estimate(update.posterior)
        bound, metrics = self._measure(
            estimate, sighting.truth, world.bound, platforms, scenario.step_s, self._bound_std, self._all_stations
        )
        assigned = _all_stations(update.assignment >= 0, platforms.shape[1])
        returns = np.add.reduce(sighting.scan.valid, axis=-1)
        new = World(
            step, platforms, world.tape, update.posterior, estimate, assigned, returns, command, bound,
            sighting.truth, metrics, violations(platforms, sighting.truth, scenario.standoff_m, world.tape.discs),
        )  # fmt: skip
        moment = Moment(metrics, world.metrics, new.violations, command, self.finished(new))
        reward, terms = evaluate(scenario.reward_weights, moment)
        return new, reward, terms

    def belief(self, world: World) -> Belief:
        """What an operator knows of the world."""
        return Belief(
            self.scenario.steps - world.step, world.platforms, world.estimate.mean, world.estimate.cov,
            world.assigned, world.returns, world.last_action, world.track_state, world.tape.discs,
        )  # fmt: skip

    def observe(self, world: World) -> Any:
        """Observations [e, d] float32, from the belief."""
        return self.observation(self.belief(world))

    def finished(self, world: World) -> Any:
        """[e] bool: the episode's last decision has been taken."""
        return world.step >= self.scenario.steps

    def _measure(self, estimate, truth, bound, platforms, step_s, std, all_stations):
        s = self.scenario
        return measure(
            estimate, truth, bound, platforms, step_s, s.process_noise_m_s, std, all_stations,
            s.lost_error_m, s.lost_nees,
        )  # fmt: skip


def _check_estimate(estimate: Any, shape: tuple[int, ...], tracker: Any) -> None:
    """Refuse a user's tracker whose first estimate is none.

    Raises:
        TypeError: no mean and cov; ValueError: wrong shapes, or variances that are not positive numbers.
    """
    name = f"tracker {type(tracker).__name__}: estimate()"
    if not (hasattr(estimate, "mean") and hasattr(estimate, "cov")):
        raise TypeError(f"{name} gave {type(estimate).__name__}, must give a trackers.gaussian.Gaussian (mean, cov)")
    found, wanted = (np.shape(estimate.mean), np.shape(estimate.cov)), (shape, (*shape, shape[-1]))
    if found != wanted:
        raise ValueError(f"{name} gave mean and cov of shapes {found}, must be {wanted}")
    variances = np.diagonal(estimate.cov, axis1=-2, axis2=-1)
    if not ((variances > 0.0) & np.isfinite(variances)).all():
        raise ValueError(f"{name} gave variances that are not positive numbers")


def _renumber(tape: Tape, order: np.ndarray) -> Tape:
    """Reorder each episode's targets; noise and detections move with them."""
    if (order == np.arange(order.shape[-1])).all():
        return tape
    rows = order[:, None, None, :]
    return tape._replace(
        targets=np.take_along_axis(tape.targets, order[:, None, :, None], axis=2),
        noise=np.take_along_axis(tape.noise, rows, axis=3),
        detected=np.take_along_axis(tape.detected, rows, axis=3),
    )


def _all_stations(assigned: np.ndarray, stations: int) -> np.ndarray:
    """[e, m, stations]: a tracker that uses the reference only reports one column; the others stand unassigned."""
    if assigned.shape[-1] == stations:
        return assigned
    full = np.zeros((*assigned.shape[:-1], stations), dtype=bool)
    full[..., -1:] = assigned
    return full


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
