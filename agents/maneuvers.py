"""What a policy does: courses off the line of sight, legs and turns over many episodes, as figures and as a picture."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from agents.pictures import DPI, axes_at, style_diagram
from passive_env.palette import INK, MUTED, curve_color

PER_ROW = 5
"""Most policies side by side; more continue below."""
COLUMN_IN, HEIGHTS_IN = 2.9, (1.7, 1.35, 1.35)
"""Width of a policy's diagrams, and their heights from top to bottom."""
QUANTILES = (0.05, 0.25, 0.5, 0.75, 0.95)
TURN_LINE: dict[str, Any] = {"color": MUTED, "linestyle": (0, (4, 2)), "linewidth": 1.4}
LEG_BINS = 20


class Maneuvers(NamedTuple):
    """How one platform flew through e episodes of k steps.

    Attributes:
        off_sight_rad: [e, k + 1] course from the line of sight, left positive, in [−π, π].
        turns: [e, k] turn commands as shares of the limit, left positive.
    """

    off_sight_rad: Any
    turns: Any


# -- figures -----------------------------------------------------------------------------------------------------------


def angle_quantiles_deg(off_sight_rad: Any) -> np.ndarray:
    """Quantiles [5, k + 1] of the angle between course and line of sight [°], over episodes [e, k + 1]."""
    return np.quantile(np.degrees(np.abs(off_sight_rad)), QUANTILES, axis=0)


def first_side_share(off_sight_rad: Any) -> np.ndarray:
    """Share [k + 1] of episodes [e, k + 1] in which the course is on the side of the line of sight it began on."""
    left = np.asarray(off_sight_rad) >= 0.0
    return (left == left[:, :1]).mean(axis=0)


def leg_steps(off_sight_rad: Any) -> np.ndarray:
    """Lengths [n] in steps of all legs of episodes [e, k + 1].

    A leg is the time on one side of the line of sight, until the course crosses it ahead or astern; the leg that the
    episode's end cuts short is none.
    """
    left = np.asarray(off_sight_rad) >= 0.0
    begins = np.concatenate([np.ones_like(left[:, :1]), left[:, 1:] != left[:, :-1]], axis=1)
    episode, at = np.nonzero(begins)
    return np.diff(at)[np.diff(episode) == 0]


# -- the picture -------------------------------------------------------------------------------------------------------


def maneuvers(time_s: Any, flown: Mapping[str, Maneuvers], title: str) -> Figure:
    """Per policy, from top to bottom: angle off the line of sight, side of it and turns over time, lengths of legs.

    Args:
        time_s: [k + 1] s.
        flown: per policy, one platform's maneuvers in the same episodes.
        title: of the figure.
    Raises:
        ValueError: no policy, fewer than two instants, or arrays of other shapes than time_s asks for.
    """
    _check(time_s, flown)
    figure, panels = _sheet(len(flown))
    step_s = float(time_s[1] - time_s[0])
    legs = {name: step_s * leg_steps(flight.off_sight_rad) for name, flight in flown.items()}
    tallest = max(_leg_counts(leg, len(flown[name].turns), time_s)[0].max() for name, leg in legs.items())
    for i, ((angle, side, durations), (name, flight)) in enumerate(zip(panels, flown.items(), strict=True)):
        angle.set_title(name, fontsize=11.5, color=INK)
        _draw_angle(angle, time_s, flight, curve_color(i))
        _draw_side(side, time_s, flight, curve_color(i))
        _draw_legs(durations, time_s, legs[name], len(flight.turns), curve_color(i))
        durations.set_ylim(0.0, 1.05 * max(tallest, 0.1))
    figure.suptitle(title, fontsize=13, color=INK, y=1.0 - 0.1 / figure.get_figheight(), va="top")
    figure.legend(
        handles=_samples(), loc="lower center", ncols=max(1, int(figure.get_figwidth() / 2.9)), fontsize=9.5,
        frameon=False, labelcolor=INK,
    )  # fmt: skip
    return figure


def _check(time_s: Any, flown: Mapping[str, Maneuvers]) -> None:
    if not flown:
        raise ValueError("flown: needs at least one policy")
    instants = len(time_s)
    if instants < 2:
        raise ValueError(f"time_s has {instants} instants, must have at least 2")
    for name, flight in flown.items():
        shapes = np.shape(flight.off_sight_rad), np.shape(flight.turns)
        episodes = shapes[0][0] if shapes[0] else 0
        if episodes < 1 or shapes != ((episodes, instants), (episodes, instants - 1)):
            raise ValueError(
                f"flown[{name!r}]: off_sight_rad and turns have shapes {shapes[0]} and {shapes[1]}, must be "
                f"[episodes, {instants}] and [episodes, {instants - 1}]"
            )


def _sheet(count: int) -> tuple[Figure, list[tuple[Axes, ...]]]:
    """A figure with three diagrams per policy, laid out in inches; only the leftmost carry labels."""
    rows = math.ceil(count / PER_ROW)
    columns = math.ceil(count / rows)
    left, right, bottom, top, between, title = 0.85, 0.2, 1.35 if columns < 3 else 0.95, 0.4, 0.3, 0.4
    gaps = (0.15, 0.65, 0.65)
    row_height = title + sum(HEIGHTS_IN) + sum(gaps[:2])
    width = left + columns * (COLUMN_IN + between) - between + right
    figure = Figure(figsize=(width, bottom + rows * row_height + (rows - 1) * gaps[2] + top), dpi=DPI)
    panels = []
    for i in range(count):
        row, column = divmod(i, columns)
        x = left + column * (COLUMN_IN + between)
        y = figure.get_figheight() - top - row * (row_height + gaps[2]) - title
        stack = []
        for height, gap in zip(HEIGHTS_IN, gaps, strict=True):
            y -= height
            stack.append(axes_at(figure, x, y, COLUMN_IN, height))
            y -= gap
        _label(stack, leftmost=column == 0)
        panels.append(tuple(stack))
    return figure, panels


def _label(stack: list[Axes], leftmost: bool) -> None:
    labels = (
        ("", "angle off line\nof sight [°]"),
        ("time [s]", "on first\nside [%]"),
        ("leg [s]", "legs per\nepisode"),
    )
    for axes, (x_label, y_label) in zip(stack, labels, strict=True):
        style_diagram(axes, x_label, y_label if leftmost else "")
        axes.tick_params(labelleft=leftmost)
    stack[0].tick_params(labelbottom=False)


def _draw_angle(axes: Axes, time_s: Any, flight: Maneuvers, color: str) -> None:
    low, lower, median, upper, high = angle_quantiles_deg(flight.off_sight_rad)
    axes.fill_between(time_s, low, high, color=color, alpha=0.2, linewidth=0.0)
    axes.fill_between(time_s, lower, upper, color=color, alpha=0.35, linewidth=0.0)
    axes.plot(time_s, median, color=color, linewidth=2.0)
    axes.set_xlim(time_s[0], time_s[-1])
    axes.set_ylim(0.0, 180.0)
    axes.set_yticks(range(0, 181, 45))


def _draw_side(axes: Axes, time_s: Any, flight: Maneuvers, color: str) -> None:
    turning = 100.0 * np.abs(flight.turns).mean(axis=0)
    axes.stairs(turning, time_s, baseline=None, **TURN_LINE)
    axes.plot(time_s, 100.0 * first_side_share(flight.off_sight_rad), color=color, linewidth=2.0)
    axes.set_xlim(time_s[0], time_s[-1])
    axes.set_ylim(-3.0, 103.0)
    axes.set_yticks(range(0, 101, 25))


def _draw_legs(axes: Axes, time_s: Any, legs_s: np.ndarray, episodes: int, color: str) -> None:
    counts, edges = _leg_counts(legs_s, episodes, time_s)
    axes.stairs(counts, edges, fill=True, color=color, alpha=0.8)
    axes.set_xlim(0.0, time_s[-1] - time_s[0])
    axes.annotate(
        f"{len(legs_s) / episodes:.1f} crossings\nper episode", (0.97, 0.94), xycoords="axes fraction", ha="right",
        va="top", fontsize=9, color=INK,
    )  # fmt: skip


def _leg_counts(legs_s: np.ndarray, episodes: int, time_s: Any) -> tuple[np.ndarray, np.ndarray]:
    """Legs per episode in bins of whole steps, and the bins' edges [s], half a step off the possible lengths."""
    steps, step_s = len(time_s) - 1, float(time_s[1] - time_s[0])
    width = math.ceil(steps / LEG_BINS)
    edges = step_s * (0.5 + width * np.arange(math.ceil(steps / width) + 1))
    return np.histogram(legs_s, edges)[0] / episodes, edges


def _samples() -> list[Any]:
    return [
        Line2D([], [], color=MUTED, linewidth=2.0, label="median angle; share on first side"),
        Patch(facecolor=MUTED, alpha=0.55, label="25 to 75 % of episodes"),
        Patch(facecolor=MUTED, alpha=0.2, label="5 to 95 %"),
        Line2D([], [], label="mean turn rate, % of limit", **TURN_LINE),
    ]
