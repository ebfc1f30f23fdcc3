"""Measured figures that several documents show: taken from where their own commands have written them."""

from __future__ import annotations

import json
import re
from pathlib import Path

from agents.benchmark.results import Result, met_words, value_words
from agents.reproduction.report import markdown_table
from passive_env.catalogue import environment_id

LEADERBOARD = Path("docs") / "leaderboard.md"
RESULTS = Path("benchmarks") / "RESULTS.json"

LEFT_OUT = re.compile(r"median|its p95|collapsed|NEES|episodes|µs|horizontal average|settled|lost late|scored")
"""Columns of the leaderboard's tables that an environment's page does without."""

SHORT_COLUMNS = (
    "environment", "error", "best fixed or rule", "mean [m]", "paper", "greedy", "planner", "oracle", "learned",
)  # fmt: skip
"""Columns of its short form that the README shows, of drawn courses; behind them what was learned on recorded ones."""


def table_after(text: str, heading: str) -> list[list[str]]:
    """Cells of the first table below a heading's line, row by row, its head first.

    Raises:
        ValueError: no such heading, or no table below it.
    """
    _, found, below = text.partition(f"\n{heading}\n")
    lines = below.splitlines()
    first = next((i for i, line in enumerate(lines) if line.startswith("|")), None)
    if not found or first is None:
        raise ValueError(f"the leaderboard has no table below {heading!r}")
    last = next((i for i, line in enumerate(lines[first:], first) if not line.startswith("|")), len(lines))
    rows = [[cell.strip() for cell in line.strip("|").split("|")] for line in lines[first:last]]
    return [rows[0], *rows[2:]]


def baseline_table(root: Path, name: str) -> str:
    """An environment's policies on drawn courses, from the leaderboard."""
    head, *rows = table_after((root / LEADERBOARD).read_text(encoding="utf-8"), f"### `{environment_id(name)}`")
    kept = [i for i, column in enumerate(head) if not LEFT_OUT.match(column)]
    return markdown_table([head[i] for i in kept], [[row[i] for i in kept] for row in rows])


def leaderboard_table(root: Path, argument: str) -> str:
    """The leaderboard's short form of drawn courses, beside the learned policies' on recorded flights."""
    head, *rows = table_after((root / LEADERBOARD).read_text(encoding="utf-8"), "## In short")
    named = [dict(zip(head, row, strict=True)) for row in rows]
    recorded = {row["environment"]: row["learned"] for row in named if row["targets"] == "recorded"}
    drawn = [row for row in named if row["targets"] == "drawn"]
    shown = [[*(row[name] for name in SHORT_COLUMNS), recorded[row["environment"]]] for row in drawn]
    return markdown_table((*SHORT_COLUMNS, "learned, recorded flights"), shown)


def performance_table(root: Path, argument: str) -> str:
    """The benchmark's last committed results."""
    figures = json.loads((root / RESULTS).read_text(encoding="utf-8"))["results"]
    results = [Result(name, each["value"], each["unit"], each["goal"]) for name, each in figures.items()]
    rows = [(f"`{r.name}`", value_words(r.value), r.unit, r.goal or "", met_words(r)) for r in results]
    return markdown_table(("name", "value", "unit", "goal", "met"), rows)
