"""Policies of a passive radar: which transmitters to listen to, and where a receiver that moves should fly.

All decide from the belief, except the oracles. Promised errors are those of `agents.prediction_sums`.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np

from agents.policy import Policy
from agents.prediction_sums import Blockage, Outlook, SumPrediction, everyone
from passive_env.core import World
from passive_env.radar_sensors import RadarBelief, distance
from trackers.compiled import kernel
from trackers.range_sum import range_sum_row

SKIP_S = 10.0
"""A transmitter that missed less than this ago is skipped."""


# -- what all have in common -------------------------------------------------------------------------------------------


def scores_of(chosen: np.ndarray, pool: int) -> np.ndarray:
    """Scores [e, n], 1 of the chosen transmitters [e, k] and −1 of the others."""
    scores = np.full((len(chosen), pool), -1.0)
    np.put_along_axis(scores, chosen, 1.0, axis=1)
    return scores


class Selection:
    """Listens to one of the scenario's combinations of transmitters; a receiver that moves flies straight on.

    Args:
        scenario: what to act in.
    """

    def __init__(self, scenario: Any):
        self._scenario, self._combinations = scenario, scenario.combinations

    def reset(self, belief: RadarBelief) -> None:
        """Begin episodes."""

    def act(self, belief: RadarBelief, observation: np.ndarray) -> np.ndarray:
        """Commands [e, a]: a turn, where the receiver moves, then scores."""
        scores = scores_of(self._combinations[self.choose(belief)], self._scenario.pool)
        return np.concatenate([np.zeros((len(scores), int(self._scenario.moves))), scores], axis=1)

    def choose(self, belief: RadarBelief) -> np.ndarray:
        """Numbers [e] of the combinations to listen to."""
        raise NotImplementedError


# -- rules -------------------------------------------------------------------------------------------------------------


class Fixed(Selection):
    """Listens to the same transmitters all the time: the first of the pool; of the paper's sites, all there are."""

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

    def act(self, belief: RadarBelief, observation: np.ndarray) -> np.ndarray:
        """Commands [e, a]."""
        kept = belief.chosen & ~belief.missed
        order = np.argsort(-np.where(kept, np.inf, belief.since_miss_s), axis=1, kind="stable")
        scores = scores_of(order[:, : self._scenario.listened], self._scenario.pool)
        return np.concatenate([np.zeros((len(scores), int(self._scenario.moves))), scores], axis=1)


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
        self._prediction = SumPrediction(scenario, scenario.steps)
        self._share = scenario.echo_probability * (1.0 - scenario.stretches.share)
        self._plan = np.empty(0, dtype=int)

    def reset(self, belief: RadarBelief) -> None:
        """Choose."""
        outlook = everyone(belief, self._scenario.steps)
        self._plan = self._prediction(belief, outlook._replace(if_clear=self._share * outlook.if_clear)).argmin(axis=1)

    def choose(self, belief: RadarBelief) -> np.ndarray:
        """Numbers [e] of the combinations to listen to."""
        return self._plan


# -- searches ----------------------------------------------------------------------------------------------------------


class Greedy(Selection):
    """Listens to the combination that promises the least error of the scans to come if it is kept.

    Args:
        scenario: what to act in.
        outlook: (belief, scans) who will answer; None: what the belief in blocked transmitters lets expect.
        scans: looked ahead.
        criterion: see `agents.prediction_sums.CRITERIA_SUMS`.
        waits: whether retuning is known to take its time.
    """

    def __init__(
        self, scenario: Any, outlook: Callable[[RadarBelief, int], Outlook] | None = None, scans: int = 1,
        criterion: str = "position_std", waits: bool = True,
    ):  # fmt: skip
        super().__init__(scenario)
        self._outlook = Blockage(scenario) if outlook is None else outlook
        self._prediction, self._waits = SumPrediction(scenario, scans, criterion), waits

    def costs(self, belief: RadarBelief) -> np.ndarray:
        """Promised error [e, c] of every combination."""
        outlook = self._outlook(belief, self._prediction.scans)
        return self._prediction(belief, outlook, waits=self._waits)

    def choose(self, belief: RadarBelief) -> np.ndarray:
        """Numbers [e] of the combinations to listen to."""
        return self.costs(belief).argmin(axis=1)


def not_missed(belief: RadarBelief, scans: int) -> Outlook:
    """Every transmitter answers but those whose last miss is less than `SKIP_S` ago; of these rather the earlier."""
    doubt = 1.0 - 1e-3 * belief.since_miss_s / SKIP_S
    return everyone(belief, scans)._replace(blocked=np.where(belief.since_miss_s < SKIP_S, doubt, 0.0))


class Oracle(Greedy):
    """Greedy that knows who will be blocked: what knowing it would be worth."""

    needs_world = True
    _world: World

    def __init__(self, scenario: Any, **settings: Any):
        super().__init__(scenario, self._known, **settings)

    def see(self, world: World) -> None:
        """Look at the truth."""
        self._world = world

    def _known(self, belief: RadarBelief, scans: int) -> Outlook:
        blocked = self._world.tape.blocked
        ahead = self._world.step[:, None] + np.arange(1, scans + 1)
        later = blocked[np.arange(len(blocked))[:, None], np.minimum(ahead, blocked.shape[1] - 1)]
        share = np.where(later, 0.0, self._scenario.echo_probability if scans > 1 else 1.0)
        return Outlook(np.zeros_like(belief.blocked_probability), share, share)


RADAR: dict[str, Callable[[Any, int], Policy]] = {
    "fixed": lambda scenario, seed: Fixed(scenario),
    "best_fixed": lambda scenario, seed: BestFixed(scenario),
    "angle": lambda scenario, seed: ByShape(scenario, "angle"),
    "triangle": lambda scenario, seed: ByShape(scenario, "triangle"),
    "nearest": lambda scenario, seed: ByShape(scenario, "nearest"),
    "round_robin": lambda scenario, seed: RoundRobin(scenario),
    "repeat": lambda scenario, seed: Repeat(scenario),
    "greedy": lambda scenario, seed: Greedy(scenario, everyone, waits=False),
    "skip": lambda scenario, seed: Greedy(scenario, not_missed, waits=False),
    "bayes": lambda scenario, seed: Greedy(scenario),
    "oracle": lambda scenario, seed: Oracle(scenario),
}
