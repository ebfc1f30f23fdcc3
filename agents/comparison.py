"""Policies compared: figures of each, ratios of means to the baselines, with intervals.

Episodes are paired, the same tapes for all; so are the resamples of which intervals are made.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from scipy.stats import bootstrap

from agents.outcomes import Outcomes, Record, nees_scale
from agents.resampling import wilson_interval

BASELINES = (
    "paper",
    "fixed",
    "open",
    "rule",
    "rule_tuned",
    "rule_average",
    "rule_best",
    "round_robin",
    "greedy",
    "skip",
    "bayes",
    "timed",
    "hysteresis",
    "hold10",
    "timed10",
    "pursuit",
    "timed_pursuit",
    "planner",
    "optimizer",
)
"""Policies that all others are compared with, where they take part."""

RESAMPLES = 2000


def summarize(
    environment: str, seed: int, records: Mapping[str, Record], more_baselines: Sequence[str] = ()
) -> dict[str, Any]:
    """The evaluation as plain data: figures per policy, ratios to the baselines with paired 95 % intervals."""
    outcomes = {name: record.outcomes for name, record in records.items()}
    first = next(iter(outcomes.values()))
    baselines = [name for name in (*BASELINES, *more_baselines) if name in records] or [next(iter(records))]
    return {
        "environment": environment,
        "episodes": len(first.lost),
        "seed": seed,
        "state_size": first.state_size,
        "score": first.score,
        "policies": {name: figures_of(flown) for name, flown in outcomes.items()},
        "ratios": {
            base: {name: _ratios(flown, outcomes[base]) for name, flown in outcomes.items() if name != base}
            for base in baselines
        },
    }


def figures_of(flown: Outcomes) -> dict[str, Any]:
    """A policy's figures as plain data."""
    low, high = nees_scale(flown.state_size).band
    errors = {name: _statistics(values) for name, values in flown.samples.items()}
    bounds = {name: float(bound.mean()) for name, bound in flown.bounds.items()}
    late = {} if flown.lost_late is None else _share(flown.lost_late)
    return (
        errors
        | late
        | {
            "lost_share": float(flown.lost.mean()),
            "collapse_share": float(flown.collapsed.mean()),
            "standoff_share": float(flown.standoff.mean()),
            "nogo_share": float(flown.nogo.mean()),
            "final_nees": _statistics(flown.nees),
            "final_nees_in_band_share": float(((flown.nees >= low) & (flown.nees <= high)).mean()),
        }
        | bounds
        | {"decision_time_us": flown.decision_time_us}
    )


def _share(lost: np.ndarray) -> dict[str, Any]:
    """Share of lost tracks with its Wilson 95 % interval, each episode's tracks counting as one."""
    interval = wilson_interval(round(float(lost.sum())), len(lost))
    return {"lost_late_share": float(lost.mean()), "lost_late_ci95": list(interval)}


def _statistics(values: np.ndarray) -> dict[str, float]:
    return {
        "mean": float(values.mean()),
        "median": float(np.median(values)),
        "rms": float(np.sqrt(np.square(values).mean())),
        "p95": float(np.percentile(values, 95.0)),
    }


def _ratios(flown: Outcomes, base: Outcomes) -> dict[str, Any]:
    pairs = zip(flown.samples.items(), base.samples.values(), strict=True)
    ratios = {name: ratio_of_means(values, other) for (name, values), other in pairs}
    if flown.lost_late is not None:
        ratios["lost_late_share"] = difference_of_means(flown.lost_late, base.lost_late)
    return ratios


def mean_interval(values: np.ndarray, seed: int = 0) -> list[float]:
    """Percentile bootstrap 95 % interval [low, high] of a sample's mean; values [e], seed of the resampling."""
    if len(values) < 2:
        return [float(values.mean())] * 2
    draws = np.random.default_rng(seed).multinomial(len(values), np.full(len(values), 1.0 / len(values)), RESAMPLES)
    low, high = np.percentile(draws @ values / len(values), [2.5, 97.5])
    return [float(low), float(high)]


def ratio_of_means(values: np.ndarray, base: np.ndarray, seed: int = 0) -> dict[str, Any]:
    """Ratio of two paired samples' means with a percentile bootstrap 95 % interval.

    Args:
        values, base: [e] of the same episodes.
        seed: of the resampling.
    Returns:
        {"ratio", "ci95": [low, high]}; a single episode has no interval: both ends are the ratio.
    """
    ratio = float(values.mean() / base.mean())
    interval = _paired_interval(values, base, lambda a, b, axis: a.mean(axis) / b.mean(axis), seed)
    return {"ratio": ratio, "ci95": interval or [ratio, ratio]}


def difference_of_means(values: np.ndarray, base: np.ndarray, seed: int = 0) -> dict[str, Any]:
    """The same of the difference of two paired shares, of which the other may be 0: {"difference", "ci95"}."""
    difference = float(values.mean() - base.mean())
    interval = _paired_interval(values, base, lambda a, b, axis: a.mean(axis) - b.mean(axis), seed)
    return {"difference": difference, "ci95": interval or [difference, difference]}


def _paired_interval(values: np.ndarray, base: np.ndarray, statistic: Any, seed: int) -> list[float]:
    """Percentile bootstrap 95 % interval of a statistic of paired samples; empty for a single episode."""
    if len(values) < 2:
        return []
    result = bootstrap(
        (values, base),
        statistic,
        paired=True,
        vectorized=True,
        n_resamples=RESAMPLES,
        batch=max(1, 2_000_000 // len(values)),
        method="percentile",
        rng=np.random.default_rng(seed),
    )
    low, high = result.confidence_interval
    return [float(low), float(high)]
