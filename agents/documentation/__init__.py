"""What the documentation takes from the code: its tables and its pictures.

A document holds a table between two comments, ``<!-- generated: NAME ARGUMENT -->`` and ``<!-- end -->``; `MAKERS` has
what each NAME stands for. ``python -m agents.documentation`` writes all tables of README.md and docs/ anew, with
``--pictures`` the pictures too. A test checks that the tables are current.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from pathlib import Path

from agents.documentation.api import modules_list
from agents.documentation.environments import (
    action_table,
    environments_table,
    keyword_table,
    observation_table,
    reward_table,
)
from agents.documentation.results import baseline_table, leaderboard_table, performance_table
from agents.documentation.settings import settings_table, trackers_table
from agents.files import write_text

MAKERS: Mapping[str, Callable[[Path, str], str]] = {
    "environments": environments_table,
    "observation": observation_table,
    "action": action_table,
    "reward": reward_table,
    "keywords": keyword_table,
    "baselines": baseline_table,
    "leaderboard": leaderboard_table,
    "performance": performance_table,
    "trackers": trackers_table,
    "settings": settings_table,
    "api": modules_list,
}
"""Makers (folder of the checkout, argument) of the tables by name."""

GENERATED = re.compile(r"<!-- generated: (\w+)(?: (\S+))? -->\n.*?<!-- end -->", re.DOTALL)
"""A table with its two comments; the name and the argument are groups."""


def documents(root: Path) -> list[Path]:
    """README.md, CONTRIBUTING.md and all pages below docs/ of a checkout."""
    return [root / "README.md", root / "CONTRIBUTING.md", *sorted((root / "docs").rglob("*.md"))]


def with_tables(text: str, root: Path) -> str:
    """A document with its tables as they are now.

    Raises:
        ValueError: a table that nothing makes, with those there are.
    """

    def made(found: re.Match[str]) -> str:
        name, argument = found[1], found[2] or ""
        if name not in MAKERS:
            raise ValueError(f"generated: {name}: nothing makes such a table; there are {', '.join(MAKERS)}")
        opening = found[0].partition("\n")[0]
        return f"{opening}\n\n{MAKERS[name](root, argument)}\n\n<!-- end -->"

    return GENERATED.sub(made, text)


def write_tables(root: Path) -> list[Path]:
    """Write the tables of all documents anew; returns the documents that changed."""
    changed = []
    for document in documents(root):
        text = document.read_text(encoding="utf-8")
        if (current := with_tables(text, root)) != text:
            changed.append(write_text(document, current))
    return changed
