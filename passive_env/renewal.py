"""The belief in blocked transmitters that knows how long stretches last: a chain over the time that is left of them.

Blocked and clear stretches alternate, each of a duration drawn uniformly between two limits (`passive_env.blockage`):
an alternating renewal process. Whether a transmitter is blocked and how much of the stretch is left is a Markov chain,
the time cut into bins as long as a step, or longer where there would be more than `MOST_BINS`. Bayes' rule follows it
exactly but for that cut, where the chain with two states takes every stretch for as likely to end now as ever.

    predict    from bin k to bin k − 1 with probability T / w (w: a bin's width); from bin 0 to a fresh stretch
    echo       everything blocked ← 0
    no echo    everything clear times the probability of a miss

Source: explicit durations as in Ferguson, "Variable Duration Models for Speech", 1980 (hidden semi-Markov models).
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from passive_env.blockage import Stretches
from trackers.compiled import kernel

MOST_BINS = 64


@kernel("(k,r),(k,r),(),(),(),()->(k,r)", "FFFFBBF")
def _follow(before, fresh, move, missing, answered, missed, after):
    """Probabilities [2, r] (blocked, clear; time left) after a step and what was heard of the transmitter."""
    r, total = before.shape[1], 0.0
    for kind in range(2):
        ended = move * before[1 - kind, 0]
        for k in range(r):
            left = before[kind, k + 1] if k < r - 1 else 0.0
            after[kind, k] = (1.0 - move) * before[kind, k] + move * left + ended * fresh[kind, k]
            if kind == 0 and answered:
                after[kind, k] = 0.0
            elif kind == 1 and missed:
                after[kind, k] *= missing
            total += after[kind, k]
    if total > 0.0:
        for kind in range(2):
            for k in range(r):
                after[kind, k] /= total
    else:  # what was held for impossible has happened: of the stretch now known nothing is known
        for kind in range(2):
            for k in range(r):
                after[kind, k] = fresh[kind, k] if (kind == 1) == answered else 0.0


class Renewal:
    """The chain of one transmitter; probabilities are [..., 2, r]: blocked and clear, by time left.

    Args:
        stretches: limits of durations.
        step_s: time between scans.
        echo_probability: of a transmitter that is not blocked.
    """

    def __init__(self, stretches: Stretches, step_s: float, echo_probability: float):
        self._missing = 1.0 - echo_probability
        limits = np.array(stretches).reshape(2, 2)
        longest = limits.max() if stretches.share else step_s
        width = max(step_s, longest / MOST_BINS)
        bins = math.ceil(longest / width - 1e-9)
        edges = width * np.arange(bins + 1)
        self._move = step_s / width if stretches.share else 0.0
        if not stretches.share:
            self.fresh = self.stationary = np.array([[0.0], [1.0]])
            return
        self.fresh = np.array([_fresh(edges, low, high, step_s) for low, high in limits])
        left = np.array([np.diff(_survived(edges, low, high)) for low, high in limits])
        self.stationary = left / left.sum()

    def follow(self, probability: Any, answered: Any, missed: Any) -> Any:
        """Probabilities [..., 2, r] a step later, by whether an echo came or, listened to, did not [...]."""
        return _follow(probability, self.fresh, self._move, self._missing, answered, missed)

    def outlook_table(self, steps: np.ndarray) -> np.ndarray:
        """Weights [2r, 1 + 2h] that turn probabilities [2r] into those of the steps to come.

        Args:
            steps: [h] how many steps after the next one.
        Returns:
            columns: blocked at the next step; clear at it and clear `steps` later; blocked at it and clear then.
        """
        chain, r = self._chain(), self.fresh.shape[1]
        clear = np.repeat([0.0, 1.0], r)
        later, columns = clear, []
        for step in range(int(np.max(steps, initial=0)) + 1):
            if step > 0:
                later = chain @ later
            columns.append(later)
        then = np.array(columns)[np.asarray(steps, dtype=int)].T
        return np.concatenate([chain @ np.column_stack([1.0 - clear, clear[:, None] * then]),
                               chain @ ((1.0 - clear)[:, None] * then)], axis=1)  # fmt: skip

    def _chain(self) -> np.ndarray:
        """Transition matrix [2r, 2r], from row to column."""
        r = self.fresh.shape[1]
        chain = (1.0 - self._move) * np.eye(2 * r)
        for kind in range(2):
            for k in range(r):
                row = chain[kind * r + k]
                if k > 0:
                    row[kind * r + k - 1] += self._move
                else:
                    row[(1 - kind) * r : (2 - kind) * r] += self._move * self.fresh[1 - kind]
        return chain


def _survived(x: np.ndarray, low: float, high: float) -> np.ndarray:
    """Integral from 0 to x of the probability that a duration uniform in [low, high] exceeds a time."""
    if high == low:
        return np.clip(x, 0.0, low)
    late = np.clip(x, low, high)
    return np.clip(x, 0.0, low) + ((high - low) ** 2 - (high - late) ** 2) / (2.0 * (high - low))


def _fresh(edges: np.ndarray, low: float, high: float, step_s: float) -> np.ndarray:
    """Probabilities of bins for what is left, at the end of a step, of a stretch that began at a random time in it."""
    left = np.diff(_survived(edges, low, high) - _survived(edges + step_s, low, high)) / step_s
    left[0] += 1.0 - left.sum()  # it may be over already: then it ends with the next step
    return left
