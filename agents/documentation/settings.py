"""What trackers say of themselves: names, classes, settings with their defaults, as Markdown tables."""

from __future__ import annotations

import inspect
from pathlib import Path
from typing import Any

import trackers
from agents.reproduction.report import markdown_table

REGISTRIES = {
    "bearings of unlabelled targets": trackers.TRACKERS,
    "azimuth and elevation of one target": trackers.ANGLE_TRACKERS,
    "position fixes of a maneuvering target": trackers.MANEUVER_TRACKERS,
    "bistatic range sums": trackers.RANGE_SUM_TRACKERS,
    "range, azimuth and elevation": {"converted_fusion": trackers.ConvertedFusion},
}
"""Trackers by what they measure, then by name."""


def tracker_classes() -> dict[str, type]:
    """All of them by the name of their page."""
    return {name: tracker for family in REGISTRIES.values() for name, tracker in family.items()}


def trackers_table(root: Path, folder: str) -> str:
    """All trackers by what they measure; names lead to their pages in `folder`."""
    rows = [
        (f"[`{name}`]({folder}{name}.md)", f"`{tracker.__name__}`", measured, _summary(tracker))
        for measured, family in REGISTRIES.items()
        for name, tracker in family.items()
    ]
    return markdown_table(("name", "class", "measures", "what it is"), rows)


def settings_table(root: Path, name: str) -> str:
    """A tracker's settings with their defaults; what each means stands in the class's docstring."""
    parameters = inspect.signature(tracker_classes()[name]).parameters.values()
    return markdown_table(("setting", "default"), [(f"`{each.name}`", _default(each)) for each in parameters])


def _summary(tracker: type) -> str:
    """First sentence of a class's docstring, without the cross reference in brackets."""
    return inspect.cleandoc(tracker.__doc__ or "").splitlines()[0].partition(" (`")[0].rstrip(".")


def _default(parameter: Any) -> str:
    return "" if parameter.default is inspect.Parameter.empty else f"`{parameter.default}`"
