"""What the leaderboard says of learned policies: verdicts, what is open, what was tried, which goals are reached."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from typing import Any

from agents.leaderboard.goals import LOST
from agents.leaderboard.standings import BASES, PLANNER
from agents.leaderboard.tried import TRIED, Tried
from agents.leaderboard.words import KIND_WORDS, ratio_words, short, standings_of, targets
from agents.report import table

_VERDICT = [
    "environment", "targets", "policy", "error", "against", "kind", "ratio of means", "mean", "ratio of p95", "p95",
    "oracle's ratio of means",
]  # fmt: skip

_WHAT = {"mean": "", "p95": ", p95", "high": ", end of interval"}
"""Of which figure a goal is, as words behind the error's name."""


def verdicts_of(data: Mapping[str, Any]) -> Iterator[tuple[str, dict[str, Any], dict[str, Any]]]:
    """(environment, standing, verdict), one after another."""
    for environment, entry in standings_of(data, "leaderboard"):
        for each in entry["verdicts"]:
            yield environment, entry, each


def learned_part(data: Mapping[str, Any]) -> list[str]:
    """Every learned policy against the best rule and the best greedy one, then against planners."""
    found = list(verdicts_of(data))
    rows = [_verdict_row(*each) for each in found if each[2]["kind"] in BASES]
    if not rows:
        return []
    heading = "## Learned policies against the best fixed policy or rule and the best greedy one"
    parts = [heading, _verdict_note(data["about"]["confirm"], len(rows)), "\n".join(table(_VERDICT, rows))]
    planned = [[*_verdict_row(*each), f"{each[2]['episodes']:,}"] for each in found if each[2]["kind"] == PLANNER]
    if planned:
        parts += ["### Against planners", _PLANNERS, "\n".join(table([*_VERDICT, "episodes"], planned))]
    return parts


def _verdict_note(confirm: int, count: int) -> str:
    again = f"; these ratios are of {confirm:,} others, whose seeds follow" if confirm else ", the same as here"
    return (
        "Ahead: the interval of the ratio lies below 1; behind: above; level: it holds 1. Against whom: the fixed "
        "policy or rule, and the greedy one, of least mean of that very error on the episodes above"
        f"{again}. Intervals are 95 % each: were all {2 * count} verdicts in truth level, some "
        f"{math.ceil(0.1 * count)} would say otherwise. An oracle searches with the targets' true paths, or the "
        "blockages to come, known: below 1, what knowing them is worth to such a search; above 1, its search is not "
        "good enough to tell. `RadarPlacement-v0` has none."
    )


_PLANNERS = (
    "Planners weigh several decisions to come and take far longer over each. Those that search longest, a fifth of a "
    "second per episode and more, are compared on the episodes above alone."
)


def open_part(data: Mapping[str, Any]) -> list[str]:
    """Where what was learned is behind on the mean, or not ahead on the 95th percentile, and what was tried there."""
    found = [each for each in verdicts_of(data) if each[2]["kind"] in BASES]
    if not found:
        return []
    rows = [_verdict_row(*each) for each in found if each[2]["open"]]
    behind = sum(each["mean_verdict"] == "behind" for _, _, each in found)
    note = (
        f"{len(rows)} of {len(found)} comparisons: the learned policy is behind on the mean ({behind} of them), or not "
        "ahead on the 95th percentile."
    )
    environments = dict.fromkeys(environment for environment, _, each in found if each["open"])
    parts = ["## Open", note, *(["\n".join(table(_VERDICT, rows))] if rows else [])]
    tried = [part for name in environments if name in TRIED for part in _tried(name, TRIED[name])]
    return parts + (["## What was tried", _TRIED, *tried] if tried else [])


_TRIED = (
    "Trainings that were compared while choosing, on episodes of other seeds. Where what is packed did best there, "
    "these figures flatter it; those that judge it stand above."
)


def _tried(environment: str, tried: Tried) -> list[str]:
    """Trainings that were compared, and what they say."""
    found = table(["tried", *tried.columns], [list(row) for row in tried.rows])
    return [f"{short(environment)}. {tried.measured}", "\n".join(found), tried.lesson]


def _verdict_row(environment: str, entry: Mapping[str, Any], each: Mapping[str, Any]) -> list[str]:
    return [
        short(environment), targets(entry), f"`{each['policy']}`", entry["metrics"][each["metric"]],
        f"`{each['base']}`", KIND_WORDS[each["kind"]], ratio_words(each["mean"]), each["mean_verdict"],
        ratio_words(each["p95"]), each["p95_verdict"], ratio_words(each["oracle"]) if each["oracle"] else "—",
    ]  # fmt: skip


def goals_part(data: Mapping[str, Any]) -> list[str]:
    """Goals of the registered environments, and whether they are reached."""
    found = [
        (environment, entry, goal)
        for environment, entry in standings_of(data, "leaderboard")
        for goal in entry.get("goals", ())
    ]
    if not found:
        return []
    note = (
        f"Ratios that learned policies were meant to stay below when the environments were made: "
        f"{sum(goal['met'] for _, _, goal in found)} of {len(found)} do. Where several policies were meant, the best "
        "of them counts. Goals of other scenarios than the registered ones are judged in the environments' documents."
    )
    head = ["environment", "targets", "policy", "error", "against", "at most", "ratio", "episodes", "reached"]
    rows = [_goal_row(*each) for each in found]
    return ["## What was meant to be reached", note, "\n".join(table(head, rows))]


def _goal_row(environment: str, entry: Mapping[str, Any], goal: Mapping[str, Any]) -> list[str]:
    error = "lost tracks" if goal["error"] == LOST else goal["error"]
    return [
        short(environment), targets(entry), f"`{goal['policy']}`", error + _WHAT[goal["what"]], f"`{goal['base']}`",
        f"{goal['most']:g}", ratio_words(goal), f"{goal['episodes']:,}", "yes" if goal["met"] else "no",
    ]  # fmt: skip
