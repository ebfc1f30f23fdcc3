"""Policies of a passive radar: which transmitters to listen to, and where a receiver that moves should fly.

All decide from the belief, except the oracles. Promised errors are those of `passive_env.radar_promise`.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import Any

import numpy as np

from agents.policy import Policy, sees_world
from passive_env.core import World, map_rows
from passive_env.radar_promise import BLOCK, Ahead, Blockage, Durations, Outlook, SumPrediction, everyone, straight_on
from passive_env.radar_sensors import RadarBelief, distance
from passive_env.radar_sites import PAPER_SITES_M
from passive_env.steering import lead_pursuit, towards
from trackers.compiled import Blocks, kernel
from trackers.range_sum import range_sum_row

SKIP_S = 10.0
"""A transmitter that missed less than this ago is skipped."""


# -- what all have in common -------------------------------------------------------------------------------------------


def scores_of(chosen: np.ndarray, pool: int) -> np.ndarray:
    """Scores [e, n], 1 of the chosen transmitters [e, k] and −1 of the others."""
    scores = np.full((len(chosen), pool), -1.0)
    np.put_along_axis(scores, chosen, 1.0, axis=1)
    return scores


class Selection(ABC):
    """Listens to one of the scenario's combinations of transmitters; a receiver that moves flies straight on.

    Args:
        scenario: what to act in.
    """

    def __init__(self, scenario: Any):
        self._scenario, self._combinations = scenario, scenario.combinations
        self._member = np.zeros((scenario.pool, len(self._combinations)))
        self._member[self._combinations.T, np.arange(len(self._combinations))] = 1.0

    def reset(self, belief: RadarBelief) -> None:  # noqa: B027  most have nothing to forget
        """Begin episodes."""

    def act(self, belief: RadarBelief, observation: np.ndarray) -> np.ndarray:
        """Commands [e, a]: a turn, where the receiver moves, then scores."""
        scores = scores_of(self._combinations[self.choose(belief)], self._scenario.pool)
        return np.concatenate([np.zeros((len(scores), int(self._scenario.moves))), scores], axis=1)

    @abstractmethod
    def choose(self, belief: RadarBelief) -> np.ndarray:
        """Numbers [e] of the combinations to listen to."""

    def number_of(self, chosen: np.ndarray) -> np.ndarray:
        """Numbers [e] of the combinations that have most of the transmitters chosen [e, n]."""
        return (chosen @ self._member).argmax(axis=1)


# -- rules -------------------------------------------------------------------------------------------------------------


class Fixed(Selection):
    """Listens to the same transmitters all the time, the pool's first ones: in space to all of the paper's sites."""

    def choose(self, belief: RadarBelief) -> np.ndarray:
        """Numbers [e] of the combinations to listen to."""
        return np.zeros(len(belief.steps_left), dtype=int)


class RoundRobin(Selection):
    """Listens to all combinations in turn, each for as long as it takes to hear something.

    From one to the next goes a stride without common divisor with their number: soon every transmitter has had a turn.
    """

    def __init__(self, scenario: Any):
        super().__init__(scenario)
        count = len(self._combinations)
        self._stride = next(s for s in range(max(int(0.382 * count), 1), count + 1) if math.gcd(s, count) == 1)
        self._dwell = 1 + 2 * math.ceil(scenario.retune_delay_s / scenario.step_s - 1e-6)

    def choose(self, belief: RadarBelief) -> np.ndarray:
        """Numbers [e] of the combinations to listen to."""
        step = self._scenario.steps - belief.steps_left
        return step // self._dwell * self._stride % len(self._combinations)


class Repeat(Selection):
    """Keeps the transmitters that answered, and takes for one that did not the one whose last miss is longest ago."""

    def choose(self, belief: RadarBelief) -> np.ndarray:
        """Numbers [e] of the combinations to listen to."""
        kept = belief.chosen & ~belief.missed
        order = np.argsort(-np.where(kept, np.inf, belief.since_miss_s), axis=1, kind="stable")
        return self.number_of(scores_of(order[:, : self._scenario.listened], self._scenario.pool))


@kernel("(y),(y),(n,d),(c,k)->(c),(c),(c)", "FFFIFFF")
def _shapes(x, receiver, sites, combinations, spread, area, reach):
    """Of combinations: volume that their slopes' directions span, squared area of sites, sum of their ranges."""
    d, n, k = sites.shape[1], sites.shape[0], combinations.shape[1]
    rows, G = np.empty((n, d)), np.empty((d, d))
    for i in range(n):
        range_sum_row(x, receiver, sites[i], rows[i], d)
        length = 0.0
        for a in range(d):
            length += rows[i, a] * rows[i, a]
        for a in range(d):
            rows[i, a] /= math.sqrt(max(length, 1e-12))
    for c in range(combinations.shape[0]):
        reach[c] = area[c] = 0.0
        G[:] = 0.0
        for m in range(k):
            i = combinations[c, m]
            reach[c] += distance(x, sites[i], d)
            for a in range(d):
                for b in range(d):
                    G[a, b] += rows[i, a] * rows[i, b]
            for q in range(m):
                for corner in range(q + 1):
                    j = combinations[c, q]
                    o = receiver if corner == q else sites[combinations[c, corner]]
                    ux, uy, vx, vy = sites[i, 0] - o[0], sites[i, 1] - o[1], sites[j, 0] - o[0], sites[j, 1] - o[1]
                    if k == 2 or corner < q:
                        area[c] += (ux * vy - uy * vx) ** 2
        spread[c] = G[0, 0] * G[1, 1] - G[0, 1] * G[1, 0]
        if d == 3:
            spread[c] = (
                G[0, 0] * (G[1, 1] * G[2, 2] - G[1, 2] * G[2, 1])
                - G[0, 1] * (G[1, 0] * G[2, 2] - G[1, 2] * G[2, 0])
                + G[0, 2] * (G[1, 0] * G[2, 1] - G[1, 1] * G[2, 0])
            )


class ByShape(Selection):
    """Listens to the combination whose layout about the track is best.

    Args:
        scenario: what to act in.
        figure: "angle": the slopes of its range sums span the largest angle, in space the largest volume; "triangle":
            its sites, two of them with the receiver, span the largest triangle; "nearest": its sites are nearest to
            the track.
    """

    FIGURES = ("angle", "triangle", "nearest")

    def __init__(self, scenario: Any, figure: str):
        super().__init__(scenario)
        self._figure = self.FIGURES.index(figure)

    def choose(self, belief: RadarBelief) -> np.ndarray:
        """Numbers [e] of the combinations to listen to."""
        figures = _shapes(belief.mean[:, 0], belief.platforms[:, 0], belief.transmitters, self._combinations)
        chosen = figures[self._figure]
        return chosen.argmin(axis=1) if self._figure == 2 else chosen.argmax(axis=1)


class BestFixed(Selection):
    """Listens all the time to the combination that promises the least mean error over the episode, by its first belief.

    Args:
        scenario: what to act in.
    """

    def __init__(self, scenario: Any):
        super().__init__(scenario)
        self._prediction = SumPrediction(scenario, scenario.steps, "position_std")
        self._share = scenario.echo_probability * (1.0 - scenario.stretches.share)
        self._plan = np.empty(0, dtype=int)

    def reset(self, belief: RadarBelief) -> None:
        """Choose."""
        outlook = everyone(belief, self._prediction.ahead)
        self._plan = self._prediction(belief, outlook._replace(if_clear=self._share * outlook.if_clear)).argmin(axis=1)

    def choose(self, belief: RadarBelief) -> np.ndarray:
        """Numbers [e] of the combinations to listen to."""
        return self._plan


class Hindsight(Selection):
    """Listens all the time to the combination that turns out to be best, which nobody can know.

    Its error, summed over the very same episode, is the least of all: the episode is flown with every combination. A
    receiver that moves flies straight on.
    """

    needs_world = True
    _world: World

    def __init__(self, scenario: Any):
        super().__init__(scenario)
        self._simulation = scenario.make_simulation()
        self._plan = np.empty(0, dtype=int)

    def see(self, world: World) -> None:
        """Look at the truth."""
        self._world = world

    def reset(self, belief: RadarBelief) -> None:
        """Fly."""
        blocks = Blocks(len(belief.mean), block=BLOCK)
        self._plan = np.concatenate(blocks.map(self._fly, blocks.slices))

    def choose(self, belief: RadarBelief) -> np.ndarray:
        """Numbers [e] of the combinations to listen to."""
        return self._plan

    def _fly(self, rows: slice) -> np.ndarray:
        """Numbers of the best combinations of some episodes."""
        start = map_rows(lambda part: part[rows], self._world)
        return np.argmin([self._error(start, chosen) for chosen in self._combinations], axis=0)

    def _error(self, world: World, chosen: np.ndarray) -> np.ndarray:
        """Summed position errors [e] from a world to the end, with one combination."""
        scores = scores_of(np.tile(chosen, (len(world.step), 1)), self._scenario.pool)
        command = np.concatenate([np.zeros((len(scores), int(self._scenario.moves))), scores], axis=1)
        total = np.zeros(len(scores))
        for _ in range(self._scenario.steps - int(world.step[0])):
            world = self._simulation.advance(world, command)[0]
            total += world.metrics.position_error_m[:, 0]
        return total


# -- searches ----------------------------------------------------------------------------------------------------------


class Greedy(Selection):
    """Listens to the combination that promises the least error of the scans to come if it is kept.

    Args:
        scenario: what to act in.
        outlook: (belief, ahead) who will answer; None: what the belief in blocked transmitters lets expect.
        scans: looked ahead.
        waits: whether retuning is known to take its time.
        prediction: further settings of `passive_env.radar_promise.SumPrediction`.
    """

    def __init__(
        self, scenario: Any, outlook: Callable[[RadarBelief, Ahead], Outlook] | None = None, scans: int = 1,
        waits: bool = True, **prediction: Any,
    ):  # fmt: skip
        super().__init__(scenario)
        self._outlook = Blockage(scenario) if outlook is None else outlook
        self._prediction, self._waits = SumPrediction(scenario, scans, **prediction), waits

    def costs(self, belief: RadarBelief) -> np.ndarray:
        """Promised error [e, c] of every combination."""
        return self._prediction(belief, self._outlook(belief, self._prediction.ahead), waits=self._waits)

    def choose(self, belief: RadarBelief) -> np.ndarray:
        """Numbers [e] of the combinations to listen to."""
        return self.costs(belief).argmin(axis=1)


def not_missed(belief: RadarBelief, ahead: Ahead) -> Outlook:
    """Every transmitter answers but those whose last miss is less than `SKIP_S` ago; of these rather the earlier."""
    doubt = 1.0 - 1e-3 * belief.since_miss_s / SKIP_S
    return everyone(belief, ahead)._replace(blocked=np.where(belief.since_miss_s < SKIP_S, doubt, 0.0))


class Hysteresis(Greedy):
    """Greedy without regard to retuning that keeps its choice unless another promises clearly less.

    Args:
        scenario: what to act in.
        advantage: by which share the other one's error must be less.
        settings: as of `Greedy`.
    """

    def __init__(self, scenario: Any, advantage: float = 0.1, **settings: Any):
        super().__init__(scenario, waits=False, **settings)
        self._least = -math.log1p(-advantage)

    def choose(self, belief: RadarBelief) -> np.ndarray:
        """Numbers [e] of the combinations to listen to."""
        costs = self.costs(belief)
        rows, best = np.arange(len(costs)), costs.argmin(axis=1)
        kept = self.number_of(belief.chosen)
        return np.where(costs[rows, best] < costs[rows, kept] - self._least, best, kept)


class Oracle(Greedy):
    """Greedy that knows who will be blocked: what knowing it would be worth."""

    needs_world = True
    _world: World

    def __init__(self, scenario: Any, **settings: Any):
        super().__init__(scenario, self._known, **settings)

    def see(self, world: World) -> None:
        """Look at the truth."""
        self._world = world

    def _known(self, belief: RadarBelief, ahead: Ahead) -> Outlook:
        hidden = self._world.tape.blocked
        later = self._world.step[:, None] + 1 + ahead.scans * np.arange(ahead.instants)
        clear = ~hidden[np.arange(len(hidden))[:, None], np.minimum(later, hidden.shape[1] - 1)]
        share = self._scenario.echo_probability * clear
        return Outlook(np.zeros_like(belief.blocked_probability), share, share)


# -- a receiver that moves ---------------------------------------------------------------------------------------------


class Moving:
    """A receiver that flies by one rule and listens by another policy.

    Args:
        scenario: what to act in.
        selection: whom to listen to.
        heading: (belief) level headings [e] rad to turn to; None: circles where it is.
    """

    def __init__(self, scenario: Any, selection: Selection, heading: Callable[[RadarBelief], np.ndarray] | None):
        self._selection, self._heading = selection, heading
        self._turn = math.radians(scenario.max_turn_rate_deg_s) * scenario.step_s

        self.needs_world = sees_world(selection)

    def see(self, world: World) -> None:
        """Let an oracle that selects look at the truth."""
        show: Any = self._selection
        show.see(world)

    def reset(self, belief: RadarBelief) -> None:
        """Begin episodes."""
        self._selection.reset(belief)

    def act(self, belief: RadarBelief, observation: np.ndarray) -> np.ndarray:
        """Commands [e, a]: a turn, then scores."""
        commands = self._selection.act(belief, observation)
        if self._heading is None:
            commands[:, 0] = 1.0
        else:
            commands[:, :1] = towards(self._heading(belief)[:, None], belief.platforms, self._turn)
        return commands


def pursuit(belief: RadarBelief) -> np.ndarray:
    """Headings [e] rad of lead pursuit of the track."""
    return lead_pursuit(belief.platforms[:, 0], belief.mean[:, 0])


class HeadingSearch:
    """Headings on which the best combination promises the least error, averaged over the time looked ahead.

    Args:
        scenario: what to act in.
        scans: looked ahead.
        together: scans that are taken as one.
        headings: candidates, evenly round, besides `pursuit`.
        every: steps between two searches.
    """

    def __init__(self, scenario: Any, scans: int = 60, together: int = 10, headings: int = 12, every: int = 5):
        self._scenario, self._every, self._count = scenario, every, headings
        self._prediction = SumPrediction(scenario, scans, together=together, cases=False)
        self._outlook = Blockage(scenario)
        self._held = np.empty(0)

    def __call__(self, belief: RadarBelief) -> np.ndarray:
        """Headings [e] rad."""
        due = (self._scenario.steps - belief.steps_left) % self._every == 0
        if len(self._held) != len(due) or due.any():
            found = self._search(belief)
            self._held = np.where(due, found, self._held) if len(self._held) == len(due) else found
        return self._held

    def _search(self, belief: RadarBelief) -> np.ndarray:
        turn = 2.0 * math.pi * np.arange(self._count) / self._count
        lead = pursuit(belief)
        offered = np.concatenate([lead[:, None], lead[:, None] + turn[1:]], axis=1)
        outlook = self._outlook(belief, self._prediction.ahead)
        costs = [self._prediction(belief, outlook, receiver=self._way(belief, to)).min(axis=1) for to in offered.T]
        return offered[np.arange(len(lead)), np.argmin(costs, axis=0)]

    def _way(self, belief: RadarBelief, heading: np.ndarray) -> np.ndarray:
        """Places [e, h, d] of receivers that turn to a heading [e] at once."""
        state = belief.platforms[:, 0].copy()
        d = state.shape[1] // 2
        speed = np.linalg.norm(state[:, d : d + 2], axis=1)
        state[:, d], state[:, d + 1] = speed * np.cos(heading), speed * np.sin(heading)
        return straight_on(state, self._prediction.times_s)


# -- by name -----------------------------------------------------------------------------------------------------------

HELD: dict[str, Any] = {"scans": 10, "together": 2, "cases": False}
"""Search among combinations that are kept for ten scans, the time of retuning included."""

Maker = Callable[[Any, int], Policy]

RULES: dict[str, Maker] = {
    "best_fixed": lambda scenario, seed: BestFixed(scenario),
    "hindsight": lambda scenario, seed: Hindsight(scenario),
    "angle": lambda scenario, seed: ByShape(scenario, "angle"),
    "triangle": lambda scenario, seed: ByShape(scenario, "triangle"),
    "nearest": lambda scenario, seed: ByShape(scenario, "nearest"),
    "round_robin": lambda scenario, seed: RoundRobin(scenario),
    "repeat": lambda scenario, seed: Repeat(scenario),
    "rule": lambda scenario, seed: Repeat(scenario),
}
"""Makers (scenario, seed) of the rules; "rule" is the strongest of them, the one that repeats what answered."""

SEARCHES: dict[str, Maker] = {
    "greedy": lambda scenario, seed: Greedy(scenario, everyone, waits=False),
    "skip": lambda scenario, seed: Greedy(scenario, not_missed, waits=False),
    "bayes": lambda scenario, seed: Greedy(scenario, waits=False),
    "timed": lambda scenario, seed: Greedy(scenario, Durations(scenario), waits=False),
    "oracle": lambda scenario, seed: Oracle(scenario),
}
"""Makers of searches one scan ahead, without regard to retuning."""

RETUNING: dict[str, Maker] = {
    "hysteresis": lambda scenario, seed: Hysteresis(scenario),
    "hold10": lambda scenario, seed: Greedy(scenario, **HELD),
    "timed10": lambda scenario, seed: Greedy(scenario, Durations(scenario), **HELD),
    "oracle": lambda scenario, seed: Oracle(scenario, **HELD),
}
"""Makers of those that know that retuning takes time."""


def _moving(heading: Callable[[Any], Any], outlook: Callable[[Any], Any] = Blockage) -> Maker:
    return lambda scenario, seed: Moving(scenario, Greedy(scenario, outlook(scenario), waits=False), heading(scenario))


MOVING: dict[str, Maker] = {
    "hold": _moving(lambda scenario: None),
    "pursuit": _moving(lambda scenario: pursuit),
    "rule": _moving(lambda scenario: pursuit),
    "timed_pursuit": _moving(lambda scenario: pursuit, Durations),
    "planner": _moving(HeadingSearch),
    "oracle": lambda scenario, seed: Moving(scenario, Oracle(scenario), pursuit),
}
"""Makers of what moves; all listen as "bayes" does, which flies straight on, but those that are named otherwise."""


def radar_makers(scenario: Any) -> dict[str, Maker]:
    """Makers by name of all that can act in a scenario."""
    fixed = "paper" if scenario.sites in PAPER_SITES_M else "fixed"
    makers: dict[str, Maker] = {fixed: lambda scenario, seed: Fixed(scenario), **RULES, **SEARCHES}
    if scenario.retune_delay_s > 0.0:
        makers |= RETUNING
    if scenario.moves:
        makers |= {"straight": makers["bayes"], **MOVING}
    return makers
