"""How sure a Monte Carlo mean or share is: bootstrap over runs, within each seed; Wilson's interval."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.stats import binomtest

DRAWS = 2000
LEVEL = 0.95


class Interval(NamedTuple):
    """Ends of a two-sided confidence interval, shapes as the quantity's."""

    low: np.ndarray
    high: np.ndarray


def bootstrap_means(samples: np.ndarray, rng: np.random.Generator, draws: int = DRAWS) -> np.ndarray:
    """Means of resampled runs; all trailing entries of one run are drawn together.

    Args:
        samples: [seeds, runs, ...].
        draws: number of resamples.
    Returns:
        [draws, seeds, ...].
    """
    seeds, runs = samples.shape[:2]
    share = rng.multinomial(runs, np.full(runs, 1.0 / runs), size=(draws, seeds)) / runs
    flat = np.einsum("dsr,src->dsc", share, samples.reshape(seeds, runs, -1), optimize=True)
    return flat.reshape(draws, seeds, *samples.shape[2:])


def percentile_interval(resamples: np.ndarray, level: float = LEVEL) -> Interval:
    """Percentile interval over the first axis of resampled values [draws, ...]."""
    tail = 50.0 * (1.0 - level)
    return Interval(*np.percentile(resamples, [tail, 100.0 - tail], axis=0))


def mean_interval(samples: np.ndarray, rng: np.random.Generator, draws: int = DRAWS) -> Interval:
    """Bootstrap interval of the mean over seeds and runs of samples [seeds, runs, ...]."""
    return percentile_interval(bootstrap_means(samples, rng, draws).mean(1))


def wilson_interval(successes: int, runs: int, level: float = LEVEL) -> tuple[float, float]:
    """Wilson's interval of a share, honest for few successes too."""
    found = binomtest(successes, runs).proportion_ci(level, method="wilson")
    return float(found.low), float(found.high)
