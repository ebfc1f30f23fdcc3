"""From outcomes to standings: figures with intervals, ratios to the best rule, verdicts on what was learned."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from agents.comparison import RESAMPLES, figures_of
from agents.leaderboard.contestants import KINDS, Contestant
from agents.outcomes import Outcomes
from agents.report import headline as headline_of
from agents.report import metrics_of, verdict

CHUNK = 1_000_000
"""Numbers resampled at once."""

BASES = ("rule", "greedy")
"""Kinds whose best policy learned ones are compared with."""


class Resamples(NamedTuple):
    """Means and 95th percentiles [RESAMPLES] of bootstrap resamples; equal rows are equal episodes, so ratios of two
    policies' are those of paired resamples."""

    mean: np.ndarray
    p95: np.ndarray


def resample(values: np.ndarray, seed: int = 0) -> Resamples:
    """Bootstrap resamples of one error of all episodes [e]; the same episodes for all errors of as many."""
    rng, count = np.random.default_rng(seed), len(values)
    rows = max(1, min(RESAMPLES, CHUNK // count))
    mean, p95 = np.empty(RESAMPLES), np.empty(RESAMPLES)
    for begin in range(0, RESAMPLES, rows):
        part = slice(begin, min(begin + rows, RESAMPLES))
        drawn = values[rng.integers(0, count, (part.stop - part.start, count))]
        mean[part], p95[part] = drawn.mean(axis=1), np.percentile(drawn, 95.0, axis=1)
    return Resamples(mean, p95)


def interval(resamples: np.ndarray) -> list[float]:
    """Percentile 95 % interval."""
    low, high = np.percentile(resamples, [2.5, 97.5])
    return [float(low), float(high)]


def standing(scenario: Any, field: Sequence[Contestant], outcomes: Mapping[str, Outcomes], seed: int) -> dict[str, Any]:
    """The standing of policies on the same tapes, as plain data.

    Args:
        scenario: they were flown in.
        field: who took part.
        outcomes: theirs, by name.
        seed: of the first episode.
    Returns:
        Policies' figures, "kind", intervals "ci95" of means beside them, "ratios" of means and 95th percentiles to the
        "reference" (the best fixed policy or rule by the "headline" error); the "best" policy of every kind; "bound",
        the least mean Cramér–Rao bound of any policy's geometry; "verdicts" on learned policies against the best rule
        and the best greedy one.
    """
    first = outcomes[field[0].name]
    policies, metrics, drawn = _figures(field, outcomes)
    for name, figures in policies.items():
        for metric in metrics:
            figures[metric]["ci95"] = interval(drawn[name][metric].mean)
    headline = headline_of(scenario, {name: len(first.samples[name]) / len(first.lost) for name in metrics})
    best = _best_of_kinds(policies, headline)
    reference = _least([best[kind] for kind in ("fixed", "rule") if kind in best] or list(policies), policies, headline)
    for name, figures in policies.items():
        figures["ratios"] = _ratios(policies, drawn, name, reference, metrics)
    return {
        "course": scenario.course,
        "tracker": scenario.tracker if isinstance(scenario.tracker, str) else repr(scenario.tracker),
        "episodes": len(first.lost),
        "seed": seed,
        "score": first.score,
        "state_size": first.state_size,
        "headline": headline,
        "metrics": metrics,
        "reference": reference,
        "best": best,
        "bound": _bound(policies, f"final_{first.score}_crlb_m"),
        "policies": policies,
        "verdicts": _verdicts(policies, drawn, best, metrics),
    }


def confirmed(
    field: Sequence[Contestant], outcomes: Mapping[str, Outcomes], best: Mapping[str, str]
) -> list[dict[str, Any]]:
    """Verdicts from other episodes than those that chose the best rule and the best greedy policy.

    Args:
        field: `finalists` of the first comparison.
        outcomes: theirs, by name.
        best: policy of every kind, as the first comparison has it.
    """
    policies, metrics, drawn = _figures(field, outcomes)
    return _verdicts(policies, drawn, best, metrics)


def finalists(field: Sequence[Contestant], best: Mapping[str, str]) -> list[Contestant]:
    """Everything learned, the best rule and the best greedy policy."""
    named = [best.get(kind) for kind in BASES]
    return [one for one in field if one.kind == "learned" or one.name in named]


def _figures(field: Sequence[Contestant], outcomes: Mapping[str, Outcomes]) -> tuple[dict[str, Any], Any, Any]:
    """Policies' figures, the errors that are compared, and resamples of these by policy and error."""
    policies = {one.name: {"kind": one.kind, **figures_of(outcomes[one.name])} for one in field}
    metrics = metrics_of({"score": outcomes[field[0].name].score, "policies": policies})
    drawn = {one.name: {name: resample(outcomes[one.name].samples[name]) for name in metrics} for one in field}
    return policies, metrics, drawn


def _best_of_kinds(policies: Mapping[str, Any], headline: str) -> dict[str, str]:
    kinds = {kind: [name for name, figures in policies.items() if figures["kind"] == kind] for kind in KINDS}
    return {kind: _least(names, policies, headline) for kind, names in kinds.items() if names}


def _least(names: Sequence[str], policies: Mapping[str, Any], headline: str) -> str:
    return min(names, key=lambda name: policies[name][headline]["mean"])


def _bound(policies: Mapping[str, Any], name: str) -> dict[str, Any]:
    """The least mean bound, and whose geometry it is of; an oracle's does not count."""
    flown = {policy: figures[name] for policy, figures in policies.items() if figures["kind"] != "oracle"} or {
        policy: figures[name] for policy, figures in policies.items()
    }
    policy = min(flown, key=lambda each: flown[each])
    return {"policy": policy, "mean": flown[policy]}


def _ratios(policies: Any, drawn: Any, name: str, base: str, metrics: Mapping[str, str]) -> dict[str, Any]:
    """Ratios of means and of 95th percentiles to another policy's, with paired intervals, per error."""
    return {metric: _ratio(policies, drawn, name, base, metric) for metric in metrics}


def _ratio(policies: Any, drawn: Any, name: str, base: str, metric: str) -> dict[str, Any]:
    ours, other = drawn[name][metric], drawn[base][metric]
    result = {}
    for what, a, b in (("mean", ours.mean, other.mean), ("p95", ours.p95, other.p95)):
        ratio = policies[name][metric][what] / policies[base][metric][what]
        result[what] = {"ratio": ratio, "ci95": interval(a / b)}
    return result


def _verdicts(policies: Any, drawn: Any, best: Mapping[str, str], metrics: Mapping[str, str]) -> list[dict[str, Any]]:
    """Every learned policy against the best rule and the best greedy one, position or range error by error.

    One is open where it is behind on the mean or not ahead on the 95th percentile.
    """
    found = []
    for name in (name for name, figures in policies.items() if figures["kind"] == "learned"):
        for base in (best[kind] for kind in BASES if kind in best):
            for metric in (each for each in metrics if each.endswith("_error_m")):
                ratio = _ratio(policies, drawn, name, base, metric)
                mean, p95 = (verdict(ratio[what]["ci95"]) for what in ("mean", "p95"))
                entry = {"policy": name, "base": base, "metric": metric, **ratio, "mean_verdict": mean}
                found.append(entry | {"p95_verdict": p95, "open": mean == "behind" or p95 != "ahead"})
    return found
