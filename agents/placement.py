"""Policies that place sensors: the paper's layouts, rules, greedy one by one, and a slow search over whole layouts.

All decide from the belief. Promised errors are the theoretical covariance's, averaged (in logarithms) over the courses
that stand for the sector of entry (`passive_env.placement.representative_courses`).
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import Any

import numpy as np
from scipy.optimize import differential_evolution, minimize

from agents.policy import Policy
from passive_env.placement import (
    COURSES,
    PlacementBelief,
    Task,
    commands,
    positions,
    representative_courses,
    seen_from_entry,
)
from trackers.compiled import Blocks

Rule = Callable[[Task, int], tuple[Any, Any, Any]]
"""Azimuths [rad], distances and heights [m], each [e, n] or what broadcasts to it, of a task's n sensors."""

_AXES = (np.linspace(-1.0, 1.0, 17), (-1.0, 0.0), np.linspace(-1.0, 1.0, 5))
GRID = np.stack(np.meshgrid(*_AXES, indexing="ij"), axis=-1).reshape(-1, 3)
"""Commands [c, 3] among which the greedy policy chooses."""

BLOCK = 8
"""Episodes whose candidates are weighed in one go."""


class ByRule:
    """Places all sensors by a rule of the task.

    Args:
        rule: says where.
        sensors: how many.
    """

    def __init__(self, rule: Rule, sensors: int):
        self._rule, self._sensors = rule, sensors

    def reset(self, belief: PlacementBelief) -> None:
        """Nothing to remember."""

    def act(self, belief: PlacementBelief, observation: np.ndarray) -> np.ndarray:
        """Commands [e, 3] for the next sensor."""
        turn = next_sensor(belief)
        return layout_commands(self._rule, belief.task, self._sensors)[np.arange(len(turn)), turn]


def next_sensor(belief: PlacementBelief) -> np.ndarray:
    """[e] number of the sensor to be placed, counted from 0; the last one once all are placed."""
    n = belief.platforms.shape[1]
    return np.minimum(n - belief.steps_left, n - 1)


def layout_commands(rule: Rule, task: Task, sensors: int) -> np.ndarray:
    """Commands [e, n, 3] of a rule's whole layouts."""
    shape = (len(task.std), sensors)
    azimuth, distance, height = (np.broadcast_to(part, shape) for part in rule(task, sensors))
    return commands(azimuth, distance, height, task)


# -- the paper's layouts and rules -------------------------------------------------------------------------------------


def spaced(step_deg: float) -> Rule:
    """The paper's: on the ground, one sensor at the site and every other `step_deg` further to the left."""

    def rule(task: Task, sensors: int) -> tuple[Any, Any, Any]:
        return math.radians(step_deg) * np.arange(sensors), task.entry_distance_m[:, None], 0.0

    return rule


def fan(spread_deg: float | None, heights: tuple[float, float]) -> Rule:
    """As near as allowed, evenly over ±`spread_deg` (None: all round), or over what is allowed of it.

    Heights are shares of the highest allowed, of every other sensor the second one: lines of sight of low and high
    sensors lie in no common plane.
    """

    def rule(task: Task, sensors: int) -> tuple[Any, Any, Any]:
        gaps = max(sensors - 1, 1)
        between = 2.0 * math.pi / sensors if spread_deg is None else math.radians(2.0 * spread_deg) / gaps
        step = np.minimum(between, 2.0 * task.azimuth_limit_rad / gaps)[:, None]
        azimuth = step * (np.arange(sensors) - 0.5 * (sensors - 1))
        return azimuth, task.distance_m[:, :1], task.height_limit_m[:, None] * np.take(heights, np.arange(sensors) % 2)

    return rule


even, tripod = fan(None, (0.0, 0.0)), fan(None, (0.0, 1.0))


def stacked(task: Task, sensors: int) -> tuple[Any, Any, Any]:
    """One above the other, evenly up to the highest place, as near as allowed."""
    return 0.0, task.distance_m[:, :1], task.height_limit_m[:, None] * np.arange(sensors) / max(sensors - 1, 1)


def stacked_or_even(task: Task, sensors: int) -> tuple[Any, Any, Any]:
    """`stacked` where elevation is measured worse than azimuth, else `even`.

    The direction across both lines of sight keeps its error: it should be the well measured one.
    """
    worse = (task.std[:, 2] > task.std[:, 1])[:, None]
    choices = zip(stacked(task, sensors), even(task, sensors), strict=True)
    azimuth, distance, height = (np.where(worse, one, other) for one, other in choices)
    return azimuth, distance, height


# -- promised errors ---------------------------------------------------------------------------------------------------


class Promise:
    """Expected log of the position's standard deviation at the last scan [m].

    Args:
        scenario: supplies the filter, kinds and scans.
    """

    def __init__(self, scenario: Any):
        self._scenario, self._simulation = scenario, scenario.make_simulation()

    def __call__(self, task: Task, layouts: np.ndarray) -> np.ndarray:
        """[e, c] of candidate layouts, commands [e, c, n, 3]; n may be less than the number of all sensors."""
        return self.of(task)(layouts)

    def of(self, task: Task) -> Callable[[np.ndarray], np.ndarray]:
        """The same of layouts alone, for a search: what the task decides is worked out once."""
        scenario = self._scenario
        path = representative_courses(task, scenario.scans, scenario.step_s)[:, :, None]

        def promised(layouts: np.ndarray) -> np.ndarray:
            layout = self._simulation.layout(positions(layouts, task)[:, None], task)
            return expected(np.log(self._simulation.tracker.theoretical(path, layout).position_std_m[..., -1]))

        return promised


def expected(value: np.ndarray) -> np.ndarray:
    """Mean [e, c] over the representative courses, of values [e, 3, c]."""
    return np.tensordot([weight for _, weight in COURSES], value, axes=(0, 1))


class Planned(ABC):
    """Plans a layout of all sensors at an episode's first decision and keeps to it.

    Args:
        scenario: what to act in.
    """

    def __init__(self, scenario: Any):
        self._promise, self._sensors = Promise(scenario), scenario.steps
        self._plan: np.ndarray | None = None

    @abstractmethod
    def plan(self, task: Task) -> np.ndarray:
        """Commands [e, n, 3] of whole layouts."""

    def reset(self, belief: PlacementBelief) -> None:
        """Forget the plan."""
        self._plan = None

    def act(self, belief: PlacementBelief, observation: np.ndarray) -> np.ndarray:
        """The plan's next commands [e, 3]."""
        turn = next_sensor(belief)
        if self._plan is None:
            self._plan = self.plan(belief.task)
        return self._plan[np.arange(len(turn)), turn]


class BestRule(Planned):
    """Keeps to the rule whose layout promises least."""

    def plan(self, task: Task) -> np.ndarray:
        """Commands [e, n, 3] of the best of `RULES`."""
        layouts = np.stack([layout_commands(rule, task, self._sensors) for rule in RULES], axis=1)
        return layouts[np.arange(len(layouts)), self._promise(task, layouts).argmin(axis=1)]


# -- searches ----------------------------------------------------------------------------------------------------------


class Greedy:
    """Places every sensor where the sensors so far and this one promise the least error; looks no further ahead.

    Args:
        scenario: what to act in.
    """

    def __init__(self, scenario: Any):
        self._promise = Promise(scenario)

    def reset(self, belief: PlacementBelief) -> None:
        """Nothing to remember: the belief holds the sensors placed."""

    def act(self, belief: PlacementBelief, observation: np.ndarray) -> np.ndarray:
        """The best of `GRID` for the next sensor, [e, 3]."""
        best = np.zeros((len(belief.steps_left), 3))
        turn = next_sensor(belief)
        for count in np.unique(turn):  # at most as many as there are sensors
            rows = np.flatnonzero(turn == count)
            best[rows] = self._choose(belief, rows, int(count))
        return best

    def _choose(self, belief: PlacementBelief, rows: np.ndarray, count: int) -> np.ndarray:
        task = belief.task.rows(rows)
        placed = commands_of(belief.platforms[rows, :count, :3], task)

        def choose(part: slice) -> np.ndarray:
            before = np.broadcast_to(placed[part, None], (part.stop - part.start, len(GRID), count, 3))
            ours = np.broadcast_to(GRID[:, None], (*before.shape[:2], 1, 3))
            layouts = np.concatenate([before, ours], axis=2)
            return GRID[self._promise(task.rows(part), layouts).argmin(axis=1)]

        blocks = Blocks(len(rows), block=BLOCK)
        return np.concatenate(blocks.map(choose, blocks.slices))


def commands_of(position: np.ndarray, task: Task) -> np.ndarray:
    """Commands [e, n, 3] that put sensors at positions [e, n, 3] m."""
    return commands(*seen_from_entry(position, task.entry_distance_m[:, None]), task)


class Search(Planned):
    """Looks for the best layout of all sensors at once with `scipy.optimize`: what the others are measured by.

    Differential evolution, begun with all rules' layouts among others, then L-BFGS-B from the best; every episode by
    itself, a fifth to a third of a second each.

    Args:
        scenario: what to act in.
        seed: of the search.
    """

    GENERATIONS, PER_NUMBER, STEP = 60, 4, 1e-6

    def __init__(self, scenario: Any, seed: int = 0):
        super().__init__(scenario)
        self._seed = seed

    def plan(self, task: Task) -> np.ndarray:
        """Commands [e, n, 3] of the best layouts found; every thread searches in episodes of its own."""
        episodes = len(task.std)
        if not episodes:
            return np.empty((0, self._sensors, 3))
        blocks = Blocks(episodes, block=episodes, smallest=1)

        def layouts(part: slice) -> list[np.ndarray]:
            return [self.search(task.rows(slice(i, i + 1))) for i in range(part.start, part.stop)]

        return np.stack([layout for found in blocks.map(layouts, blocks.slices) for layout in found])

    def search(self, task: Task) -> np.ndarray:
        """Commands [n, 3] of the best layout found for a task (a batch of one)."""
        size, rng, promise = 3 * self._sensors, np.random.default_rng(self._seed), self._promise.of(task)
        start: Any = rng.uniform(-1.0, 1.0, (self.PER_NUMBER * size, size))
        known = [layout_commands(rule, task, self._sensors).ravel() for rule in RULES]
        start[: len(known)] = known

        def promised(x: np.ndarray) -> np.ndarray:
            """[c] of numbers [3 n, c]."""
            return promise(x.T.reshape(1, -1, self._sensors, 3))[0]

        found = differential_evolution(
            promised, [(-1.0, 1.0)] * size, maxiter=self.GENERATIONS, init=start, polish=False, vectorized=True,
            updating="deferred", tol=0.0, rng=rng,
        )  # fmt: skip

        def with_slope(x: np.ndarray) -> tuple[float, np.ndarray]:
            steps = np.where(x > 0.0, -self.STEP, self.STEP)  # away from the nearer limit
            value, *beside = promised(x[:, None] + np.diag(np.append(0.0, steps))[1:])
            return value, (np.array(beside) - value) / steps

        polished = minimize(with_slope, found.x, jac=True, method="L-BFGS-B", bounds=[(-1.0, 1.0)] * size)
        best = polished.x if polished.fun < found.fun else found.x
        return best.reshape(self._sensors, 3)


_HEIGHTS = ((0.0, 0.0), (0.0, 1.0), (1.0, 0.0), (1.0, 1.0))
_FANS = tuple(fan(spread_deg, heights) for spread_deg in (None, 20.0, 40.0, 60.0) for heights in _HEIGHTS)
RULES: tuple[Rule, ...] = (spaced(0.0), spaced(20.0), spaced(90.0), stacked, *_FANS)
"""All rules; what the best layouts of a search look like, and the paper's."""


def _by(rule: Rule) -> Callable[[Any, int], Policy]:
    return lambda scenario, seed: ByRule(rule, scenario.steps)


PLACEMENT: dict[str, Callable[[Any, int], Policy]] = {
    "paper": _by(spaced(20.0)),
    "paper_co_located": _by(spaced(0.0)),
    "paper_90": _by(spaced(90.0)),
    "even": _by(even),
    "rule": _by(stacked_or_even),
    "tripod": _by(tripod),
    "rule_best": lambda scenario, seed: BestRule(scenario),
    "greedy": lambda scenario, seed: Greedy(scenario),
    "optimizer": lambda scenario, seed: Search(scenario, seed),
}
"""Makers (scenario, seed) of what places sensors."""
