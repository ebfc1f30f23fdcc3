"""Receding-horizon planning: a cross-entropy search over a few headings held one after the other.

Source: cross-entropy method after Rubinstein and Kroese, "The Cross-Entropy Method", Springer 2004. Deviations: the
same normal numbers serve all environments and all decisions, in pairs of opposite sign, so that a decision is a
function of the belief alone and of mirrored beliefs the mirrored one; the search spreads about the best plan so far.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from agents.greedy import FixGreedy, Greedy, predict
from agents.prediction import Situation
from passive_env.belief import Belief
from passive_env.core import World
from trackers.angles import wrap

NARROWEST_RAD = math.radians(3.0)
"""The search never narrows below this spread per heading."""

SPEED_SPREAD, WITHIN_SPREAD = 0.1, 0.1
"""Spread of the first round's speeds, as commands in [−1, 1], and of the angles [rad] outside which stations turn on
the spot, about the best plan known."""


class Plan(NamedTuple):
    """Headings flown one after the other: controls [..., g, s] rad; ends [..., g] steps from now, the last one open."""

    controls: Any
    ends: Any


class Planner:
    """Searches, at intervals, the plan of least predicted cost to the episode's end, and flies it.

    Candidates include the rest of the previous plan and the greedy choice held to the end (and that choice followed
    by each round's samples), so a plan is never worse than either on its own criterion.

    Args:
        scenario: where it acts.
        criterion, guard_m: as in `agents.prediction.Prediction`; None: the usual one of the scenario's family.
        horizon: steps to plan ahead at most; None for the whole rest of the episode.
        segments: headings in a plan, held equally long.
        samples: plans tried in each round, an even number.
        iterations: rounds.
        elites: best plans of a round that set the next one's spread.
        replan_steps: steps flown before planning anew.
        spread_deg: spread of the first round's headings about the best plan known.
        seed: of the normal numbers.
    Raises:
        ValueError: a number outside its range, naming it; or what `Prediction` refuses.
    """

    needs_world = False

    def __init__(
        self, scenario: Any, criterion: str | None = None, guard_m: float | None = None, horizon: int | None = None,
        segments: int = 4, samples: int = 32, iterations: int = 3, elites: int = 6, replan_steps: int = 3,
        spread_deg: float = 80.0, seed: int = 0,
    ):  # fmt: skip
        whole = int(scenario.steps)
        numbers = {
            "horizon": (whole if horizon is None else horizon, 1), "segments": (segments, 1), "samples": (samples, 2),
            "iterations": (iterations, 1), "elites": (elites, 1), "replan_steps": (replan_steps, 1), "seed": (seed, 0),
        }  # fmt: skip
        for name, (value, least) in numbers.items():
            if isinstance(value, bool) or not isinstance(value, (int, np.integer)) or value < least:
                raise ValueError(f"{name} = {value!r}: must be an integer of at least {least}")
        if samples % 2 or elites > samples:
            raise ValueError(f"samples = {samples}: must be even and at least elites = {elites}")
        if not 0.0 < spread_deg <= 360.0:
            raise ValueError(f"spread_deg = {spread_deg!r}: must lie in (0, 360]")
        self.prediction = predict(scenario, criterion, guard_m)
        self.horizon = numbers["horizon"][0]
        self._greedy = self._make_greedy(scenario, criterion, guard_m)
        self._segments, self._elites, self._replan_steps = segments, elites, replan_steps
        self._spread = math.radians(spread_deg)
        self._shape = (iterations, samples // 2, segments)
        self._seed = seed
        self._normals: Any = None
        self._plan = Plan(np.empty((0, segments, 1)), np.empty((0, segments), dtype=np.int64))
        self._steps_left = self._age = np.empty(0, dtype=np.int64)

    def reset(self, belief: Belief) -> None:
        """Forget all plans."""
        batch = len(belief.platforms)
        width = self.prediction.held(belief.platforms).shape[-1]
        half = np.random.default_rng(self._seed).standard_normal((*self._shape, width))
        self._normals = np.concatenate([half, -half], axis=1)
        self._plan = Plan(np.zeros((batch, self._segments, width)), np.zeros((batch, self._segments), np.int64))
        self._age = np.full(batch, self._replan_steps)
        self._steps_left = np.full(batch, -1)

    def act(self, belief: Belief, observation: np.ndarray) -> np.ndarray:
        """Turn towards the present heading of the plan; plan anew where it is due or an episode has begun."""
        begun = belief.steps_left != self._steps_left - 1
        self._age = np.where(begun, self._replan_steps, self._age + 1)
        self._plan = self._plan._replace(ends=self._plan.ends - 1)
        due = np.flatnonzero(self._age >= self._replan_steps)
        if len(due):
            self._replan(belief, due, begun)
        self._steps_left = np.array(belief.steps_left)
        return self.prediction.commands(self._controls(), belief)

    def plan(self, start: Situation, known: Plan) -> tuple[Plan, np.ndarray]:
        """The best plan found and its cost [e].

        Args:
            start: where it begins.
            known: [e, p, …] plans to begin with.
        """
        best, cost = self._choose(start, known)
        ends = _even_legs(start.steps, self._segments)
        widest = self._widest(best.controls.shape[-1])
        spread = np.broadcast_to(widest, best.controls.shape)
        for normals in self._normals:
            samples = _controls_at(best, ends)[:, None] + spread[:, None] * normals
            costs = self.prediction.cost(start, samples, np.broadcast_to(ends[:, None], samples.shape[:-1]))
            order = np.argsort(costs, axis=1, kind="stable")[:, : self._elites]
            elite = np.take_along_axis(samples, order[..., None, None], axis=1)
            better = np.take_along_axis(costs, order[:, :1], axis=1)[:, 0] < cost
            cost = np.where(better, costs.min(axis=1), cost)
            best = Plan(
                np.where(better[:, None, None], elite[:, 0], best.controls), np.where(better[:, None], ends, best.ends)
            )
            off = wrap(elite - _controls_at(best, ends)[:, None])
            spread = np.clip(np.sqrt(np.square(off).mean(axis=1)), NARROWEST_RAD, widest)
        return best, cost

    def _choose(self, start: Situation, plans: Plan) -> tuple[Plan, np.ndarray]:
        """The best of plans [e, p, …] and its cost [e]."""
        costs = self.prediction.cost(start, *plans)
        choice = costs.argmin(axis=1)
        rows = np.arange(len(choice))
        return Plan(plans.controls[rows, choice], plans.ends[rows, choice]), costs[rows, choice]

    def known_plans(self, start: Situation, mean: np.ndarray, previous: Plan) -> Plan:
        """Plans [e, 3, …] to begin with: the previous one, the heading best to the end, the greedy policy's heading.

        Args:
            start: where they begin; mean: [e, m, 4] track means, for the line of sight; previous: [e, …].
        """
        near = start._replace(steps=np.minimum(start.steps, self._greedy.horizon))
        held = np.stack([self._greedy.best(start, mean), self._greedy.best(near, mean)], axis=1)
        controls = np.concatenate(
            [previous.controls[:, None], np.repeat(held[:, :, None], self._segments, axis=2)], axis=1
        )
        ends = np.concatenate(
            [previous.ends[:, None], np.repeat(_even_legs(start.steps, self._segments)[:, None], 2, axis=1)], axis=1
        )
        return Plan(controls, ends)

    def _make_greedy(self, scenario: Any, criterion: str | None, guard_m: float | None) -> Greedy:
        """What finds controls to hold."""
        return Greedy(scenario, criterion=criterion, guard_m=guard_m)

    def _widest(self, width: int) -> np.ndarray:
        """Spreads [a] of the first round."""
        return np.full(width, self._spread)

    def _situation(self, belief: Belief) -> Situation:
        return self.prediction.situation(belief, self.horizon)

    def _replan(self, belief: Belief, due: np.ndarray, begun: np.ndarray) -> None:
        held = self.prediction.held(belief.platforms)[:, None]
        controls = np.where(begun[:, None, None], held, self._plan.controls)
        start, mean = self._situation(belief).rows(due), belief.mean[due]
        known = self.known_plans(start, mean, Plan(controls[due], self._plan.ends[due]))
        best, _ = self.plan(start, known)
        ends = self._plan.ends.copy()
        controls[due], ends[due], self._age[due] = best.controls, best.ends, 0
        self._plan = Plan(controls, ends)

    def _controls(self) -> np.ndarray:
        """Controls [e, a] of the present legs."""
        return _controls_at(self._plan, np.ones((len(self._plan.ends), 1), dtype=np.int64))[:, 0]


class Oracle(Planner):
    """The same search on the targets' true paths and from the Cramér–Rao bound in place of the tracks' covariances.

    Neither a policy, for it reads the truth, nor a strict bound: the search is not exhaustive, and the least bound
    need not give a filter its least error. It tells how much better knowledge would help.

    Args:
        as of `Planner`.
    """

    needs_world = True

    def __init__(self, scenario: Any, **settings: Any):
        super().__init__(scenario, **settings)
        self._world: World | None = None

    def see(self, world: World) -> None:
        """Look at the world before a decision; the evaluation calls this, and nothing else does."""
        self._world = world

    def _situation(self, belief: Belief) -> Situation:
        if self._world is None:
            raise ValueError("the oracle must see the world before it acts: call see(world)")
        return self.prediction.revealed(super()._situation(belief), self._world)


class FixPlanner(Planner):
    """The same search for stations that steer by turn rate and speed (`agents.greedy.FixGreedy`).

    Args:
        as of `Planner`.
    """

    _greedy: FixGreedy

    def __init__(self, scenario: Any, *, segments: int = 4, **settings: Any):
        super().__init__(scenario, segments=max(segments, FixGreedy(scenario).legs), **settings)

    def known_plans(self, start: Situation, mean: np.ndarray, previous: Plan) -> Plan:
        """Plans [e, 3, …] to begin with, as those of `Planner`, the greedy ones with their stops."""
        near = start._replace(steps=np.minimum(start.steps, self._greedy.horizon))
        plans = [previous]
        for situation in (start, near):
            controls, ends = self._greedy.plan(situation, mean)
            longer = ((0, 0), (0, self._segments - ends.shape[1]))
            plans.append(Plan(np.pad(controls, (*longer, (0, 0)), "edge"), np.pad(ends, longer, "edge")))
        return Plan(*(np.stack(parts, axis=1) for parts in zip(*plans, strict=True)))

    def _make_greedy(self, scenario: Any, criterion: str | None, guard_m: float | None) -> FixGreedy:
        return FixGreedy(scenario, criterion=criterion, guard_m=guard_m)

    def _widest(self, width: int) -> np.ndarray:
        return np.repeat([self._spread, SPEED_SPREAD, WITHIN_SPREAD], width // 3)


class FixOracle(Oracle, FixPlanner):
    """`FixPlanner` on the target's true path and from the Cramér–Rao bound (`Oracle`)."""


def _even_legs(steps: np.ndarray, segments: int) -> np.ndarray:
    """Ends [e, g] of equally long legs over steps [e], each of at least one step while steps last."""
    return np.ceil(steps[:, None] * np.arange(1, segments + 1) / segments).astype(np.int64)


def _controls_at(plan: Plan, ends: np.ndarray) -> np.ndarray:
    """A plan's controls [e, h, a] in the middle of the legs with the given ends [e, h]."""
    begin = np.concatenate([np.zeros_like(ends[:, :1]), ends[:, :-1]], axis=1)
    middle = (begin + np.maximum(ends - 1, begin)) // 2
    leg = (plan.ends[:, None] <= middle[..., None]).sum(axis=-1).clip(max=plan.ends.shape[1] - 1)
    return np.take_along_axis(plan.controls, leg[..., None], axis=1)


PLANNERS = {
    "planner": lambda scenario, seed: Planner(scenario, seed=seed),
    "oracle": lambda scenario, seed: Oracle(scenario, seed=seed),
}
"""Makers (scenario, seed)."""

IN_SPACE: dict[str, Any] = {
    "horizon": 24,
    "segments": 4,
    "samples": 16,
    "iterations": 2,
    "elites": 4,
    "replan_steps": 1,
}
"""Settings for platforms in space: less searching each time, but at every scan. Plans flown blindly for some scans end,
once in a thousand episodes, in a pass so close that the track is lost; seeds from 500,000 on."""

PLANNERS_IN_SPACE = {
    "planner": lambda scenario, seed: Planner(scenario, seed=seed, **IN_SPACE),
    "oracle": lambda scenario, seed: Oracle(scenario, seed=seed, **IN_SPACE),
}
"""Makers (scenario, seed)."""

FIX_SETTINGS: dict[str, Any] = {
    "horizon": 25,
    "segments": 3,
    "samples": 16,
    "elites": 4,
    "replan_steps": 1,
    "spread_deg": 30.0,
}
"""Settings for stations whose bearings become fixes: what a maneuvering target does later is anyone's guess, and what is
to be found lies near the greedy plan."""

FIX_SEARCHES = {
    "planner": lambda scenario, seed: FixPlanner(scenario, seed=seed, **FIX_SETTINGS),
    "oracle": lambda scenario, seed: FixOracle(scenario, seed=seed, **FIX_SETTINGS),
}
"""Makers (scenario, seed) for stations whose bearings become fixes."""
