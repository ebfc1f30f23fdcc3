"""What a benchmark says: figures with units and goals, the machine they hold for, as JSON and Markdown."""

from __future__ import annotations

import operator
import platform
from collections.abc import Mapping, Sequence
from importlib import metadata
from pathlib import Path
from typing import Any, NamedTuple

from agents.files import write_json, write_text
from agents.presets import load_preset
from agents.provenance import processor_name, versions
from agents.reproduction.report import markdown_table
from trackers.compiled import available_cores

COMPARISONS = {">=": operator.ge, "<=": operator.le, ">": operator.gt, "<": operator.lt}
RIVALS = ("stonesoup", "filterpy")
"""Packages of the extra ``bench``."""


class Result(NamedTuple):
    """One figure.

    Attributes:
        name: key in ``benchmark.json``; `benchmarks/README.md` says how each is measured.
        value: number in `unit`.
        goal: comparison and limit in the same unit, such as ">= 10"; None where there is none.
    """

    name: str
    value: float
    unit: str
    goal: str | None = None


class Section(NamedTuple):
    """Results of one measurement, and sentences about what could not be measured."""

    results: Sequence[Result]
    notes: Sequence[str] = ()


def meets(value: float, goal: str | None) -> bool | None:
    """Whether a value meets a goal such as ">= 10"; None where there is no goal. NaN meets none.

    Raises:
        ValueError: a goal that is not a comparison and a number.
    """
    if goal is None:
        return None
    sign, _, limit = goal.partition(" ")
    if sign not in COMPARISONS:
        raise ValueError(f"goal {goal!r}: must be one of {', '.join(COMPARISONS)}, a space and a number")
    return COMPARISONS[sign](value, float(limit))


def machine(quick: bool) -> dict[str, Any]:
    """Processor, cores, threads of the environment and of torch in training, versions; no computer's name."""
    rivals = {name: _version(name) for name in RIVALS}
    return {
        "processor": processor_name(),
        "cores": available_cores(),
        "threads": available_cores(),
        "torch_threads": load_preset("TwoStation", "ppo").get("torch_threads", 1),
        "platform": f"{platform.system()} {platform.machine()}",
        "quick": quick,
        **versions(),
        **{name: version for name, version in rivals.items() if version},
    }


def _version(name: str) -> str | None:
    try:
        return metadata.version(name)
    except metadata.PackageNotFoundError:
        return None


def as_json(results: Sequence[Result], about: Mapping[str, Any]) -> dict[str, Any]:
    """The form of ``benchmark.json``: {"results": {name: {"value", "unit", "goal"}}, "machine": {…}}."""
    figures = {result.name: {"value": result.value, "unit": result.unit, "goal": result.goal} for result in results}
    return {"results": figures, "machine": dict(about)}


def as_markdown(results: Sequence[Result], about: Mapping[str, Any], notes: Sequence[str] = ()) -> str:
    """Table of results with met or missed goals, then notes, then the machine."""
    rows = [(r.name, value_words(r.value), r.unit, r.goal or "", met_words(r)) for r in results]
    table = markdown_table(("name", "value", "unit", "goal", "met"), rows)
    system = ", ".join(f"{name} {value}" for name, value in about.items())
    return "\n\n".join(["# Benchmark", table, *(f"- {note}" for note in notes), f"Machine: {system}."])


def met_words(result: Result) -> str:
    """'yes', 'no', or '' where there is no goal."""
    return {True: "yes", False: "no", None: ""}[meets(result.value, result.goal)]


def value_words(value: float) -> str:
    """Three significant digits, or whole numbers from 1000 on."""
    return f"{value:.0f}" if abs(value) >= 1000 else f"{value:.3g}"


def write_benchmark(out: Path, results: Sequence[Result], about: Mapping[str, Any], text: str) -> list[Path]:
    """Write ``benchmark.json`` and ``benchmark.md`` into a folder; returns the files."""
    return [write_json(out / "benchmark.json", as_json(results, about)), write_text(out / "benchmark.md", text)]
