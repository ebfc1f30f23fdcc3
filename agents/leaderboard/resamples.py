"""Bootstrap resamples of means and 95th percentiles of many errors of the same episodes, drawn once for all of them."""

from __future__ import annotations

from collections.abc import Iterator
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from agents.comparison import RESAMPLES

PERCENTILE = 95.0
MOST_NUMBERS = 4_000_000
"""Counts that are multiplied at a time, 32 MB."""


class Resamples(NamedTuple):
    """Means and 95th percentiles [RESAMPLES] of bootstrap resamples; equal rows are equal episodes, so ratios of two
    policies' are those of paired resamples."""

    mean: np.ndarray
    p95: np.ndarray


def resample(values: np.ndarray, seed: int = 0) -> Resamples:
    """Bootstrap resamples of one error of all episodes [e]; the same episodes for all errors of as many."""
    parts = [(part @ values / len(values), _percentiles(part, values)) for part in _parts(_counts(len(values), seed))]
    return Resamples(*(np.concatenate(each) for each in zip(*parts, strict=True)))


def _parts(counts: np.ndarray) -> Iterator[np.ndarray]:
    """Counts as real numbers, which multiply faster, not more at a time than memory easily holds."""
    rows = max(1, MOST_NUMBERS // counts.shape[1])
    for begin in range(0, len(counts), rows):
        yield counts[begin : begin + rows].astype(float)


def interval(resamples: np.ndarray) -> list[float]:
    """Percentile 95 % interval."""
    low, high = np.percentile(resamples, [2.5, 97.5])
    return [float(low), float(high)]


@lru_cache(maxsize=4)
def _counts(episodes: int, seed: int) -> np.ndarray:
    """How often every episode is drawn, [RESAMPLES, e]; never a hundred times, so a byte will do."""
    rng = np.random.default_rng(seed)
    counts = np.empty((RESAMPLES, episodes), dtype=np.uint8)
    for row in counts:
        row[:] = np.bincount(rng.integers(0, episodes, episodes), minlength=episodes)
    counts.flags.writeable = False  # all callers share it
    return counts


def _percentiles(counts: np.ndarray, values: np.ndarray) -> np.ndarray:
    """95th percentiles [RESAMPLES] as NumPy interpolates them; values beyond are few, so only those are counted."""
    below, share = divmod(PERCENTILE / 100.0 * (len(values) - 1), 1.0)
    wanted = len(values) - 1 - int(below)  # place from above, from 0, of the larger neighbour less one
    largest = np.argsort(values)[::-1]
    width = min(len(values), 2 * wanted + 32)
    while True:
        drawn = counts[:, largest[:width]].cumsum(axis=1)
        if width == len(values) or drawn[:, -1].min() > wanted:
            break
        width = min(len(values), 2 * width)
    at = values[largest[:width]]
    lower, upper = (at[(drawn > place).argmax(axis=1)] for place in (wanted, max(wanted - 1, 0)))
    return lower + share * (upper - lower)
