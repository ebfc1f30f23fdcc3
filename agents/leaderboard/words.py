"""How figures of the leaderboard read in tables and sentences."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from agents.leaderboard.standings import BASES, PLANNER
from agents.report import table

KIND_WORDS = BASES | {PLANNER: "planner"}
"""Kinds of opponents, and their names in tables."""


def sections_of(data: Mapping[str, Any], section: str) -> dict[str, list[dict[str, Any]]]:
    """Standings of a section by environment; empty where it was not asked for."""
    return data["sections"].get(section, {})


def standings_of(data: Mapping[str, Any], section: str) -> Iterator[tuple[str, dict[str, Any]]]:
    """(environment, standing), one after another."""
    for environment, entries in sections_of(data, section).items():
        for entry in entries:
            yield environment, entry


def rows_table(rows: Sequence[Mapping[str, str]]) -> str:
    """A Markdown table of rows with the same columns."""
    return "\n".join(table(list(rows[0]), [list(row.values()) for row in rows]))


def listed(names: Sequence[str]) -> str:
    """Names of policies in a row."""
    return ", ".join(f"`{name}`" for name in names)


def short(environment: str) -> str:
    """An environment's name without the package's."""
    return f"`{environment.split('/')[-1]}`"


def targets(entry: Mapping[str, Any]) -> str:
    """What kind of courses targets fly."""
    return "recorded" if entry["course"] == "flights" else "drawn"


def metres(value: float) -> str:
    """Three digits, or whole metres."""
    return f"{value:,.0f}" if abs(value) >= 100.0 else f"{value:.3g}"


def mean_words(figure: Mapping[str, Any]) -> str:
    """A mean and its interval."""
    low, high = figure["ci95"]
    return f"{metres(figure['mean'])} [{metres(low)}, {metres(high)}]"


def ratio_words(ratio: Mapping[str, Any]) -> str:
    """A ratio and its interval; 1 where a policy is compared with itself."""
    low, high = ratio["ci95"]
    return "1" if low == high == ratio["ratio"] == 1.0 else f"{ratio['ratio']:.3f} [{low:.3f}, {high:.3f}]"


def nees_words(figures: Mapping[str, Any]) -> str:
    """Mean and median of the final NEES."""
    return f"{figures['final_nees']['mean']:.1f} / {figures['final_nees']['median']:.1f}"


def best_of(entry: Mapping[str, Any], kind: str) -> str | None:
    """The best policy of a kind by the error that ranks."""
    return entry["best_by"][entry["headline"]].get(kind)


def mean_of(entry: Mapping[str, Any], name: str | None) -> str:
    """A policy's mean of the error that ranks; empty for nobody."""
    return metres(entry["policies"][name][entry["headline"]]["mean"]) if name else ""


def ratios_of(entry: Mapping[str, Any], name: str) -> tuple[Mapping[str, Any], bool]:
    """A policy's ratios, of means and of 95th percentiles, to the best fixed policy or rule by the error that ranks.

    And whether they are of further episodes than those on which the best were chosen: wherever it flew any.
    """
    further = entry.get("confirmation", {"policies": {}})["policies"]
    again = name in further
    return (further if again else entry["policies"])[name]["ratios"][entry["headline"]], again


def headline_verdicts(entry: Mapping[str, Any], kind: str, name: str | None = None) -> list[dict[str, Any]]:
    """Verdicts by the error that ranks against a kind's best, of all learned policies or of one."""
    return [
        each
        for each in entry["verdicts"]
        if each["kind"] == kind and each["metric"] == entry["headline"] and name in (None, each["policy"])
    ]
