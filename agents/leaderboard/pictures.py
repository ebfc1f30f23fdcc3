"""The leaderboard in one picture: how far every kind of policy is from the best rule, environment by environment."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from agents.leaderboard.contestants import KINDS
from agents.leaderboard.words import ratios_of
from agents.pictures import DPI, log_ticks, style_diagram
from passive_env.palette import BLACK, BLUE, GREEN, GRID, INK, MUTED, ORANGE, PURPLE, VERMILION

COLORS = dict(zip(KINDS, (MUTED, BLACK, ORANGE, GREEN, BLUE, PURPLE), strict=True))
MARKERS = dict(zip(KINDS, ("s", "D", "^", "v", "o", "*"), strict=True))
"""Kinds differ in form as well as in colour."""
BOUND = VERMILION
NEAREST, FARTHEST = 0.4, 3.0
"""What is shown: what matters is near 1. Ratios beyond stand at the edge, with their number and without interval."""
ROW_IN, WIDTH_IN = 0.62, 5.2
SPREAD = 0.62
"""Share of a row over which its kinds are spread."""


def overview(sections: Mapping[str, Sequence[Mapping[str, Any]]]) -> Figure:
    """One panel per kind of courses, one row per environment, one dot per kind of policy: the best of it.

    Args:
        sections: standings (`agents.leaderboard.standings.standing`, with "title") by environment.
    Raises:
        ValueError: no environment.
    """
    if not sections:
        raise ValueError("sections: needs at least one environment")
    titles = list(dict.fromkeys(entry["title"] for entries in sections.values() for entry in entries))
    height = 1.7 + ROW_IN * len(sections)
    figure = Figure(figsize=(2.2 + WIDTH_IN * len(titles), height), dpi=DPI, layout="constrained")
    panels = np.atleast_1d(figure.subplots(1, len(titles), sharey=True))
    for axes, title in zip(panels, titles, strict=True):
        _panel(axes, title, {env: _named(entries, title) for env, entries in sections.items()})
    panels[0].set_yticks(range(len(sections)), [env.split("/")[-1] for env in sections], fontsize=10, color=INK)
    panels[0].set_ylim(len(sections) - 0.5, -0.5)
    shown = {label for axes in panels for label in axes.get_legend_handles_labels()[1]}
    samples = [_dot(kind) for kind in KINDS if kind in shown] + [_stroke(13.0)] * ("bound" in shown)
    samples += [_dot(kind, hollow=True) for kind in KINDS if _first(kind) in shown]
    figure.legend(handles=samples, loc="outside lower center", ncols=len(samples), frameon=False, labelcolor=INK)
    return figure


def _named(entries: Sequence[Mapping[str, Any]], title: str) -> Mapping[str, Any] | None:
    return next((entry for entry in entries if entry["title"] == title), None)


def _panel(axes: Axes, title: str, entries: Mapping[str, Mapping[str, Any] | None]) -> None:
    style_diagram(axes, "mean error relative to the best fixed policy or rule, 95 % interval", "")
    axes.set_title(title, loc="left", fontsize=12, color=INK)
    axes.axvline(1.0, color=INK, linewidth=1.2, zorder=1)
    for row, entry in enumerate(entries.values()):
        if row % 2:
            axes.axhspan(row - 0.5, row + 0.5, color=GRID, alpha=0.4, zorder=0, linewidth=0.0)
        if entry is not None:
            _row(axes, row, entry)
    axes.set_xscale("log")
    axes.set_xlim(NEAREST / 1.03, FARTHEST * 1.03)
    log_ticks(axes.xaxis, axes.set_xscale)
    axes.grid(False, axis="y")


def _row(axes: Axes, row: int, entry: Mapping[str, Any]) -> None:
    """Dots with intervals, one below another; the bound as an upright stroke where the final error is shown.

    Hollow are dots of the episodes on which the best were chosen, where others flew further ones.
    """
    metric, kinds = entry["headline"], list(entry["best"])
    places = row + SPREAD * (np.arange(len(kinds)) - 0.5 * (len(kinds) - 1)) / max(len(KINDS) - 1, 1)
    for kind, place in zip(kinds, places, strict=True):
        ratios, again = ratios_of(entry, entry["best"][kind])
        ratio, hollow = ratios["mean"], "confirmation" in entry and not again
        if _put(axes, _dot(kind, hollow), ratio["ratio"], place, COLORS[kind]):
            axes.hlines(place, *ratio["ci95"], color=COLORS[kind], linewidth=1.6, zorder=3)
    if metric.startswith("final"):
        share = entry["bound"]["mean"] / entry["policies"][entry["reference"]][metric]["mean"]
        _put(axes, _stroke(26.0), share, row, BOUND)
    axes.autoscale_view()


def _put(axes: Axes, sign: Line2D, ratio: float, place: float, color: str) -> bool:
    """A sign at a ratio, or at the edge with its number; returns whether the ratio itself is shown."""
    shown = min(max(ratio, NEAREST), FARTHEST)
    axes.add_line(_at(sign, shown, place))
    if shown != ratio:
        _note_at_edge(axes, ratio, shown, place, color)
    return shown == ratio


def _note_at_edge(axes: Axes, ratio: float, edge: float, place: float, color: str) -> None:
    beyond = ratio > edge
    axes.annotate(
        f"{ratio:.2g} →" if beyond else f"← {ratio:.2g}", (edge, place), xytext=(-8 if beyond else 8, 0),
        textcoords="offset points", ha="right" if beyond else "left", va="center", fontsize=8, color=color,
    )  # fmt: skip


def _first(kind: str) -> str:
    """The name of a kind's hollow dots."""
    return f"{kind}, first episodes"


def _dot(kind: str, hollow: bool = False) -> Line2D:
    edge = {"markerfacecolor": "white", "markeredgewidth": 1.4} if hollow else {"markeredgecolor": "white"}
    return Line2D(
        [], [], linestyle="", marker=MARKERS[kind], color=COLORS[kind], label=_first(kind) if hollow else kind,
        zorder=4, markersize=8.0 if kind == "oracle" else 6.0, **{"markeredgewidth": 0.6, **edge},
    )  # fmt: skip


def _stroke(length: float) -> Line2D:
    return Line2D(
        [], [], linestyle="", marker="|", color=BOUND, label="bound", markersize=length, markeredgewidth=1.4, zorder=2
    )


def _at(sign: Line2D, x: float, y: float) -> Line2D:
    sign.set_data([x], [y])
    return sign
