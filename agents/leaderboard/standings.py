"""From outcomes to standings: figures with intervals, ratios to the best rule, verdicts on what was learned."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from agents.comparison import figures_of
from agents.leaderboard.contestants import KINDS, Contestant, geometry_of
from agents.leaderboard.goals import LOST, Goal
from agents.leaderboard.resamples import interval, resample
from agents.outcomes import Outcomes
from agents.report import headline as headline_of
from agents.report import metrics_of, verdict

REFERENCE = "reference"
"""Stands for the best of fixed policies and rules among the best of every kind."""

BASES = {REFERENCE: "fixed or rule", "greedy": "greedy"}
"""Whose best learned policies are to be ahead of, and its name in tables."""

PLANNER = "planner"
"""The kind that learned policies are compared with besides."""

ORACLE = "oracle"
"""The kind that shows beside them what knowing the truth would be worth."""


def standing(
    scenario: Any,
    field: Sequence[Contestant],
    outcomes: Mapping[str, Outcomes],
    seed: int,
    goals: Sequence[Goal] = (),
) -> dict[str, Any]:
    """The standing of policies on the same tapes, as plain data.

    Args:
        scenario: they were flown in.
        field: who took part.
        outcomes: theirs, by name.
        seed: of the first episode.
        goals: what learned policies are meant to reach.
    Returns:
        Policies' figures, "kind", intervals "ci95" of means beside them, "ratios" of means and 95th percentiles to the
        "reference" (the best fixed policy or rule by the "headline" error); the "best" policy of every kind by that
        error, and "best_by" every error ("metrics"; one that equals another in every episode is left out); "bound", the
        least mean Cramér–Rao bound of any policy's geometry; "verdicts" on learned policies against the best rule, the
        best greedy one and the best planner; "goals" of this course, and whether they are reached.
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
        "verdicts": _verdicts(policies, drawn, best_by, len(first.lost), seed),
        "goals": _results(goals, policies, drawn, metrics, best_by, len(first.lost)),
    }


def confirmed(
    before: Mapping[str, Any],
    field: Sequence[Contestant],
    outcomes: Mapping[str, Outcomes],
    seed: int,
    goals: Sequence[Goal] = (),
) -> dict[str, Any]:
    """A standing of which other episodes say more than those that chose the best rule and the best greedy policy.

    Args:
        before: the standing that chose them.
        field: its `finalists`.
        outcomes: theirs, by name.
        seed: of the first of these episodes.
        goals: as of `standing`.
    Returns:
        The same, with "confirmation": these episodes' number "episodes" and "seed", and figures of "policies" with
        "ratios" to the same reference. Verdicts and goals are those of these episodes, wherever whom they name was
        flown in them.
    """
    policies, metrics, drawn = _figures(field, outcomes)
    episodes, best_by = len(outcomes[field[0].name].lost), before["best_by"]
    fresh = _verdicts(policies, drawn, best_by, episodes, seed)
    reached = _results(goals, policies, drawn, metrics, best_by, episodes)
    for name, figures in policies.items():
        figures["ratios"] = _ratios(policies, drawn, name, before["reference"], metrics)
    return {
        **before,
        "confirmation": {"episodes": episodes, "seed": seed, "policies": policies},
        "verdicts": _replaced(before["verdicts"], fresh, ("policy", "kind", "metric")),
        "goals": _replaced(before["goals"], reached, ("policy", "goal")),
    }


def _replaced(before: Sequence[Any], fresh: Sequence[Any], names: Sequence[str]) -> list[Any]:
    """Entries, those replaced that have the same values of these names."""
    newer = {tuple(each[name] for name in names): each for each in fresh}
    return [newer.get(tuple(each[name] for name in names), each) for each in before]


def finalists(
    before: Mapping[str, Any],
    field: Sequence[Contestant],
    goals: Sequence[Goal] = (),
    spared: Collection[str] = (),
) -> list[Contestant]:
    """Everything learned, whoever is best of its kind by any error, the reference geometry, and those that goals name.

    Nobody where nothing learned takes part; no planner that is spared, unless ratios of `before` are to it.
    """
    best_by = before["best_by"]
    named = {best.get(kind) for metric, best in best_by.items() if _judged(metric) for kind in (REFERENCE, *KINDS)}
    named |= {name for goal in goals for name in goal.against} | {geometry_of([one.name for one in field])}
    named -= {one.name for one in field if one.kind == PLANNER and one.name in spared}
    named.add(before["reference"])
    found = [one for one in field if one.kind == "learned" or one.name in named]
    return found if any(one.kind == "learned" for one in found) else []


def _figures(field: Sequence[Contestant], outcomes: Mapping[str, Outcomes]) -> tuple[dict[str, Any], Any, Any]:
    """Policies' figures, the errors that are compared, and resamples of these by policy and error."""
    policies = {one.name: {"kind": one.kind, **figures_of(outcomes[one.name])} for one in field}
    metrics = _distinct(metrics_of({"score": outcomes[field[0].name].score, "policies": policies}), outcomes)
    drawn = {one.name: {name: resample(outcomes[one.name].samples[name]) for name in metrics} for one in field}
    for one in field:
        drawn[one.name][LOST] = resample(outcomes[one.name].lost.astype(float))
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
    return min(names, key=lambda name: _mean(policies[name], metric))


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


def _verdicts(
    policies: Any, drawn: Any, best_by: Mapping[str, Mapping[str, str]], episodes: int, seed: int
) -> list[dict[str, Any]]:
    """Every learned policy against the best rule, the best greedy one and the best planner, error by error.

    One is open where it is behind a rule or a greedy policy on the mean, or not ahead on the 95th percentile. "oracle"
    is the ratio of the best oracle in its place, None where there is none.
    """
    found = []
    for name in _learned(policies):
        for kind, metric, base in _opponents(best_by, policies):
            oracle = best_by[metric].get(ORACLE)
            ratio = _ratio(policies, drawn, name, base, metric)
            mean, p95 = (verdict(ratio[what]["ci95"]) for what in ("mean", "p95"))
            found.append({
                "policy": name, "base": base, "kind": kind, "metric": metric, **ratio, "mean_verdict": mean,
                "p95_verdict": p95, "open": kind in BASES and (mean == "behind" or p95 != "ahead"),
                "oracle": _ratio(policies, drawn, oracle, base, metric)["mean"] if oracle else None,
                "episodes": episodes, "seed": seed,
            })  # fmt: skip
    return found


def _learned(policies: Mapping[str, Any]) -> list[str]:
    return [name for name, figures in policies.items() if figures["kind"] == "learned"]


def _opponents(best_by: Mapping[str, Mapping[str, str]], policies: Mapping[str, Any]) -> Iterator[tuple[str, str, str]]:
    """(kind, error, policy) of whoever is best by an error of the position or range, and was flown."""
    for kind in (*BASES, PLANNER):
        for metric, best in best_by.items():
            if _judged(metric) and best.get(kind) in policies:
                yield kind, metric, best[kind]


def _results(
    goals: Sequence[Goal], policies: Any, drawn: Any, metrics: Mapping[str, str], best_by: Any, episodes: int
) -> list[dict[str, Any]]:
    """What learned policies reach of goals, wherever its error was met and all that it names were flown."""
    by_words, found = {words: metric for metric, words in metrics.items()} | {LOST: LOST}, []
    for name in _learned(policies):
        for number, goal in enumerate(goals):
            metric = by_words.get(goal.error)
            named = goal.against or (best_by.get(metric, {}).get(REFERENCE),)
            if metric is None or not policies.keys() >= set(named):
                continue
            base = _least(named, policies, metric)
            ratio = _reached(goal, policies, drawn, name, base, metric, episodes)
            found.append({
                "policy": name, "goal": number, **goal._asdict(), "base": base, **ratio, "episodes": episodes,
                "met": ratio["ci95"][1] <= goal.most if goal.what == "high" else ratio["ratio"] <= goal.most,
            })  # fmt: skip
    return found


def _reached(goal: Goal, policies: Any, drawn: Any, name: str, base: str, metric: str, episodes: int) -> dict[str, Any]:
    """The ratio that a goal is about, with its interval."""
    if metric != LOST:
        return _ratio(policies, drawn, name, base, metric)["p95" if goal.what == "p95" else "mean"]
    ours, other = (drawn[each][LOST].mean for each in (name, base))
    least = 1.0 / episodes  # a resample may have lost none: it counts as one
    ratio = _mean(policies[name], LOST) / max(_mean(policies[base], LOST), least)
    return {"ratio": ratio, "ci95": interval(ours / np.maximum(other, least))}


def _mean(figures: Mapping[str, Any], metric: str) -> float:
    return figures["lost_share"] if metric == LOST else figures[metric]["mean"]
