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

REFERENCE = "reference"
"""Stands for the best of fixed policies and rules among the best of every kind."""

BASES = {REFERENCE: "fixed or rule", "greedy": "greedy"}
"""Whose best learned policies are compared with, and its name in tables."""

ORACLE = "oracle"
"""The kind that shows beside them what knowing the truth would be worth."""


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
        "reference" (the best fixed policy or rule by the "headline" error); the "best" policy of every kind by that
        error, and "best_by" every error ("metrics"; one that equals another in every episode is left out); "bound", the
        least mean Cramér–Rao bound of any policy's geometry; "verdicts" on learned policies against the best rule and
        the best greedy one.
    """
    first = outcomes[field[0].name]
    policies, metrics, drawn = _figures(field, outcomes)
    for name, figures in policies.items():
        for metric in metrics:
            figures[metric]["ci95"] = interval(drawn[name][metric].mean)
    headline = headline_of(scenario, {name: len(first.samples[name]) / len(first.lost) for name in metrics})
    best_by = {metric: _best_of_kinds(policies, metric) for metric in metrics}
    reference = best_by[headline].get(REFERENCE) or _least(list(policies), policies, headline)
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
        "best": {kind: name for kind, name in best_by[headline].items() if kind in KINDS},
        "best_by": best_by,
        "bound": _bound(policies, f"final_{first.score}_crlb_m"),
        "policies": policies,
        "verdicts": _verdicts(policies, drawn, best_by),
    }


def confirmed(
    field: Sequence[Contestant], outcomes: Mapping[str, Outcomes], best_by: Mapping[str, Mapping[str, str]], seed: int
) -> dict[str, Any]:
    """What other episodes say than those that chose the best rule and the best greedy policy.

    Args:
        field: `finalists` of the first comparison.
        outcomes: theirs, by name.
        best_by: policy of every kind by every error, as the first comparison has it.
        seed: of the first of these episodes.
    Returns:
        Their number "episodes" and "seed", figures of "policies" and "verdicts".
    """
    policies, _, drawn = _figures(field, outcomes)
    verdicts = _verdicts(policies, drawn, best_by)
    return {"episodes": len(outcomes[field[0].name].lost), "seed": seed, "policies": policies, "verdicts": verdicts}


def finalists(field: Sequence[Contestant], best_by: Mapping[str, Mapping[str, str]]) -> list[Contestant]:
    """Everything learned and, by every error, the best rule, the best greedy policy and the best oracle.

    Nobody where nothing learned takes part.
    """
    named = {best.get(kind) for metric, best in best_by.items() if _judged(metric) for kind in (*BASES, ORACLE)}
    found = [one for one in field if one.kind == "learned" or one.name in named]
    return found if any(one.kind == "learned" for one in found) else []


def _figures(field: Sequence[Contestant], outcomes: Mapping[str, Outcomes]) -> tuple[dict[str, Any], Any, Any]:
    """Policies' figures, the errors that are compared, and resamples of these by policy and error."""
    policies = {one.name: {"kind": one.kind, **figures_of(outcomes[one.name])} for one in field}
    metrics = _distinct(metrics_of({"score": outcomes[field[0].name].score, "policies": policies}), outcomes)
    drawn = {one.name: {name: resample(outcomes[one.name].samples[name]) for name in metrics} for one in field}
    return policies, metrics, drawn


def _distinct(metrics: Mapping[str, str], outcomes: Mapping[str, Outcomes]) -> dict[str, str]:
    """Errors without further ones that equal the time average, as the horizontal one does in the plane."""
    final, average, *more = metrics
    return {name: metrics[name] for name in (final, average, *(n for n in more if not _same(n, average, outcomes)))}


def _same(metric: str, other: str, outcomes: Mapping[str, Outcomes]) -> bool:
    """Up to rounding."""
    return all(_close(flown.samples[metric], flown.samples[other]) for flown in outcomes.values())


def _close(ours: np.ndarray, other: np.ndarray) -> bool:
    return ours.shape == other.shape and np.allclose(ours, other, rtol=1e-9, atol=0.0)


def _best_of_kinds(policies: Mapping[str, Any], metric: str) -> dict[str, str]:
    """By this error; the best fixed policy or rule as `REFERENCE`."""
    groups = {kind: (kind,) for kind in KINDS} | {REFERENCE: ("fixed", "rule")}
    named = {
        group: [name for name, found in policies.items() if found["kind"] in kinds] for group, kinds in groups.items()
    }
    return {group: _least(names, policies, metric) for group, names in named.items() if names}


def _least(names: Sequence[str], policies: Mapping[str, Any], metric: str) -> str:
    return min(names, key=lambda name: policies[name][metric]["mean"])


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


def _judged(metric: str) -> bool:
    """Whether it is an error of the position or range."""
    return metric.endswith("_error_m")


def _verdicts(policies: Any, drawn: Any, best_by: Mapping[str, Mapping[str, str]]) -> list[dict[str, Any]]:
    """Every learned policy against the best rule and the best greedy one, position or range error by error.

    One is open where it is behind on the mean or not ahead on the 95th percentile. "oracle" is the ratio of the best
    oracle in its place, None where there is none.
    """
    found = []
    for name in (name for name, figures in policies.items() if figures["kind"] == "learned"):
        for kind in BASES:
            for metric in (each for each in best_by if _judged(each) and kind in best_by[each]):
                base, oracle = best_by[metric][kind], best_by[metric].get(ORACLE)
                ratio = _ratio(policies, drawn, name, base, metric)
                mean, p95 = (verdict(ratio[what]["ci95"]) for what in ("mean", "p95"))
                found.append({
                    "policy": name, "base": base, "kind": kind, "metric": metric, **ratio, "mean_verdict": mean,
                    "p95_verdict": p95, "open": mean == "behind" or p95 != "ahead",
                    "oracle": _ratio(policies, drawn, oracle, base, metric)["mean"] if oracle else None,
                })  # fmt: skip
    return found
