"""Pictures of evaluations and training: each function returns a figure, saving it is the caller's.

Figures are made without pyplot and change no global setting. Colours and signs are those of `passive_env.render`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import EngFormatter, FuncFormatter, LogLocator, MaxNLocator, NullLocator
from scipy.optimize import isotonic_regression

from passive_env import render
from passive_env.palette import BAD, GOOD, GRID, INK, MUTED, curve_color, series_color

DPI = 150
PANEL_IN = 4.4
"""Width and height of one panel of `geometry`."""
ERROR_LINE: dict[str, Any] = {"linestyle": "-", "linewidth": 2.0}
BOUND_LINE: dict[str, Any] = {"linestyle": (0, (4, 2)), "linewidth": 1.2}
LABEL_GAP = 0.06
"""Least distance of two labels at the right edge, as a share of the axes' height."""


class EpisodePaths(NamedTuple):
    """What happened in one episode of k steps, s stations (the last is the reference) and m targets.

    Attributes:
        stations: [k + 1, s, 2] m, east-north.
        targets: [k + 1, m, 2] m, true positions.
        estimates: [k + 1, m, 2] m, estimated positions.
        final_cov: [m, 2, 2] m², position covariances of the last estimates.
        range_error_m: [k + 1, m] |estimated − true range| from the reference.
    """

    stations: Any
    targets: Any
    estimates: Any
    final_cov: Any
    range_error_m: Any


# -- range error over time ---------------------------------------------------------------------------------------------


def range_error_over_time(
    time_s: Any, curves: Mapping[str, Any], bound: Mapping[str, Any] | None, title: str
) -> Figure:
    """Mean range error of several policies over time, on a logarithmic axis.

    The bound is a standard deviation: the mean absolute error of an efficient Gaussian estimator is √(2/π) ≈ 0.8 of it.

    Args:
        time_s: [k + 1] s.
        curves: per policy, mean range error [k + 1] m.
        bound: per policy (those that have one), Cramér–Rao bound [k + 1] m, drawn dashed in the policy's colour.
        title: of the figure.
    Raises:
        ValueError: no curve, a curve of another length than time_s, or a bound of an unknown policy.
    """
    bound = bound or {}
    _check_curves(time_s, curves, bound)
    figure = Figure(figsize=(8.0, 4.6), dpi=DPI, layout="constrained")
    axes = _plain_axes(figure, title, "time [s]", "mean range error [km]")
    for i, (name, error) in enumerate(curves.items()):
        axes.plot(time_s, 1e-3 * np.asarray(error), color=curve_color(i), **ERROR_LINE)
        if name in bound:
            axes.plot(time_s, 1e-3 * np.asarray(bound[name]), color=curve_color(i), **BOUND_LINE)
    _log_ticks(axes.yaxis, axes.set_yscale)
    axes.set_xlim(time_s[0], time_s[-1])
    _label_ends(axes, time_s[-1], {name: 1e-3 * float(error[-1]) for name, error in curves.items()})
    if bound:
        samples = [("range error", ERROR_LINE), ("Cramér–Rao bound, 1σ", BOUND_LINE)]
        lines = [Line2D([], [], color=MUTED, label=name, **style) for name, style in samples]
        axes.legend(handles=lines, loc="best", fontsize=9, frameon=True, edgecolor="none", labelcolor=INK)
    return figure


def _check_curves(time_s: Any, curves: Mapping[str, Any], bound: Mapping[str, Any]) -> None:
    if not curves:
        raise ValueError("curves: needs at least one policy")
    for name in bound:
        if name not in curves:
            raise ValueError(f"bound[{name!r}]: no such policy in curves ({', '.join(curves)})")
    for owner, group in (("curves", curves), ("bound", bound)):
        for name, values in group.items():
            if np.shape(values) != np.shape(time_s):
                raise ValueError(f"{owner}[{name!r}] has shape {np.shape(values)}, time_s has {np.shape(time_s)}")


def _label_ends(axes: Axes, at: float, ends_km: Mapping[str, float]) -> None:
    """Name every curve at its right end, labels moved apart just enough not to overlap."""
    low, high = np.log(axes.get_ylim())
    names = sorted(ends_km, key=lambda name: ends_km[name])
    share = np.array([(math.log(max(ends_km[name], 1e-9)) - low) / (high - low) for name in names])
    share = np.clip(np.nan_to_num(share, nan=1.0), 0.0, 1.0)
    offset = LABEL_GAP * np.arange(len(names))
    places = isotonic_regression(share - offset).x + offset
    colors = {name: curve_color(i) for i, name in enumerate(ends_km)}
    for name, place in zip(names, places, strict=True):
        leader = {"arrowstyle": "-", "color": colors[name], "shrinkA": 2, "shrinkB": 0, "relpos": (0, 0.5)}
        axes.annotate(
            f"{name}, {render.kilometres(1e3 * ends_km[name])}", (at, ends_km[name]), xytext=(1.05, place),
            textcoords="axes fraction", va="center", fontsize=9.5, color=INK, annotation_clip=False, arrowprops=leader,
        )  # fmt: skip


# -- geometry ----------------------------------------------------------------------------------------------------------


def geometry(paths: Mapping[str, EpisodePaths], title: str) -> Figure:
    """Paths of stations and targets and the final estimates, one panel per policy, all on the same axes.

    Args:
        paths: per policy, one episode; same tape, so that the panels differ by the policy only.
        title: of the figure.
    Raises:
        ValueError: no policy.
    """
    if not paths:
        raise ValueError("paths: needs at least one policy")
    figure, panels = _panels(len(paths))
    frame = _common_frame(paths)
    for axes, (name, episode) in zip(panels, paths.items(), strict=True):
        _panel(axes, episode, frame)
        final = render.kilometres(np.mean(episode.range_error_m[-1]))
        axes.set_title(f"{name}\nmean range error at the end {final}", fontsize=10.5, color=INK)
    figure.suptitle(title, fontsize=12.5, color=INK, y=1.0 - 0.12 / figure.get_figheight(), va="top")
    figure.legend(
        handles=render.legend_samples(hypotheses=False)[:4], loc="lower center", ncols=2 if len(paths) == 1 else 4,
        fontsize=9, frameon=False, labelcolor=INK,
    )  # fmt: skip
    return figure


def _panels(count: int) -> tuple[Figure, list[Axes]]:
    """A figure of equal square panels, laid out in inches; only outer panels carry tick labels."""
    columns = {1: 1, 2: 2, 4: 2}.get(count, 3)
    rows = math.ceil(count / columns)
    left, right, bottom, top, between, title = 0.65, 0.15, 0.95, 0.35, 0.2, 0.5
    width = left + columns * (PANEL_IN + between) - between + right
    height = bottom + rows * (PANEL_IN + title) + top
    figure = Figure(figsize=(width, height), dpi=DPI)
    panels = []
    for i in range(count):
        row, column = divmod(i, columns)
        x = left + column * (PANEL_IN + between)
        y = bottom + (rows - 1 - row) * (PANEL_IN + title)
        axes = figure.add_axes((x / width, y / height, PANEL_IN / width, PANEL_IN / height))
        render.style_axes(axes)
        if column > 0:
            axes.tick_params(labelleft=False)
            axes.set_ylabel("")
        if row < rows - 1:
            axes.tick_params(labelbottom=False)
            axes.set_xlabel("")
        panels.append(axes)
    return figure, panels


def _common_frame(paths: Mapping[str, EpisodePaths]) -> render.Frame:
    """A square that holds all platforms and true targets of all episodes; estimates may fall outside."""
    tracks = [path for episode in paths.values() for path in (episode.stations, episode.targets)]
    return render.grow(None, 1e-3 * np.concatenate([np.reshape(path, (-1, 2)) for path in tracks]), 1.0)


def _panel(axes: Axes, episode: EpisodePaths, frame: render.Frame) -> None:
    stations, targets, estimates = (np.asarray(path) for path in episode[:3])
    colors = [series_color(j) for j in range(targets.shape[1])]
    render.set_limits(axes, frame)
    render.add_lines(axes, [INK], 1.4, alpha=0.75).set_segments(_segments(stations))
    render.add_lines(axes, colors, 1.8).set_segments(_segments(targets))
    render.add_ellipses(axes, colors).set_verts(list(1e-3 * render.ellipses(estimates[-1], episode.final_cov)))
    for state, text in zip(_final_states(stations), render.station_names(stations.shape[1]), strict=True):
        render.place_dart(axes.plot([], [], **render.marker(INK))[0], state)
        render.place_name(render.name_tag(axes, text, INK), state, stations[-1].mean(0), frame)
    for j, (state, color) in enumerate(zip(_final_states(targets), colors, strict=True)):
        render.place_dart(axes.plot([], [], **render.marker(color))[0], state)
        render.place_number(render.name_tag(axes, str(j + 1), color), state, stations[-1, -1])
    rings = [axes.plot([], [], **render.ring(color, 12.0))[0] for color in colors]
    notes = [render.name_tag(axes, "", color) for color in colors]
    render.place_estimates(rings, notes, stations[-1, -1], estimates[-1], frame)


def _segments(path_m: np.ndarray) -> list[np.ndarray]:
    return list(1e-3 * np.swapaxes(path_m, 0, 1))


def _final_states(path_m: np.ndarray) -> np.ndarray:
    """Last positions of paths [k + 1, n, 2] with the last displacement for a course: [n, 4]."""
    return np.concatenate([path_m[-1], path_m[-1] - path_m[-min(2, len(path_m))]], axis=-1)


# -- training and comparison -------------------------------------------------------------------------------------------


def reward_curve(steps: Any, mean: Any, low: Any, high: Any) -> Figure:
    """Return of an episode in the course of training.

    Args:
        steps: [n] environment steps taken so far.
        mean: [n] mean return of an episode.
        low, high: [n] band around it.
    Raises:
        ValueError: empty arrays or arrays of different lengths.
    """
    steps, mean, low, high = (np.asarray(values, dtype=float) for values in (steps, mean, low, high))
    if not len(steps) or not steps.shape == mean.shape == low.shape == high.shape:
        shapes = ", ".join(str(values.shape) for values in (steps, mean, low, high))
        raise ValueError(f"steps, mean, low, high must have the same length, at least 1; got {shapes}")
    figure = Figure(figsize=(7.0, 4.0), dpi=DPI, layout="constrained")
    axes = _plain_axes(figure, "Training", "environment steps", "return of an episode")
    axes.fill_between(steps, low, high, color=GOOD, alpha=0.2, linewidth=0.0)
    axes.plot(steps, mean, color=GOOD, linewidth=2.0, marker="o" if len(steps) < 30 else "", markersize=4)
    axes.margins(x=0.01)
    axes.xaxis.set_major_formatter(EngFormatter(sep=" "))
    return figure


def ratio_chart(ratios: Mapping[str, tuple[float, float, float]], title: str) -> Figure:
    """Horizontal bars from a baseline at 1 to each ratio, with 95 % intervals, on a logarithmic axis.

    Args:
        ratios: per policy, ratio to the baseline's error and the ends of its 95 % interval (NaN: no interval, as a
            bootstrap gives for equal samples).
        title: of the figure; should name the baseline.
    Raises:
        ValueError: no ratio, or one that is not a positive number.
    """
    if not ratios:
        raise ValueError("ratios: needs at least one policy")
    for name, (ratio, _, _) in ratios.items():
        if not 0.0 < ratio < math.inf:
            raise ValueError(f"ratios[{name!r}]: ratio {ratio} must be a positive number")
    names, values = list(ratios), np.array(list(ratios.values()), dtype=float)
    ratio, low, high = values.T
    figure = Figure(figsize=(7.5, 1.5 + 0.42 * len(names)), dpi=DPI, layout="constrained")
    axes = _plain_axes(figure, title, "error relative to the baseline (left of 1: better), 95 % intervals", "")
    rows = np.arange(len(names))[::-1]
    colors = [GOOD if b < 1.0 else BAD if a > 1.0 else MUTED for a, b in zip(low, high, strict=True)]
    axes.barh(rows, ratio - 1.0, left=1.0, height=0.55, color=colors, alpha=0.85, zorder=2)
    axes.hlines(rows, low, high, color=INK, linewidth=1.6, zorder=3)
    axes.plot([low, high], [rows, rows], "|", color=INK, markersize=7, zorder=3)
    axes.axvline(1.0, color=INK, linewidth=1.2)
    axes.set_yticks(rows, names, fontsize=10, color=INK)
    axes.grid(False, axis="y")
    shown = values[np.isfinite(values) & (values > 0.0)]
    axes.set_xlim(min(shown.min(), 0.95) / 1.04, max(shown.max(), 1.05) * 1.04)
    axes.set_ylim(-0.6, len(names) - 0.4)
    _log_ticks(axes.xaxis, axes.set_xscale)
    for row, (r, a, b) in zip(rows, values, strict=True):
        interval = f"  [{a:.2f}, {b:.2f}]" if a <= b else ""
        axes.annotate(
            f"{r:.2f}{interval}", (1.02, row), xycoords=("axes fraction", "data"), va="center", fontsize=9.5,
            color=INK, annotation_clip=False,
        )  # fmt: skip
    return figure


# -- axes --------------------------------------------------------------------------------------------------------------


def _plain_axes(figure: Figure, title: str, x_label: str, y_label: str) -> Axes:
    axes = figure.add_subplot()
    axes.set_title(title, loc="left", fontsize=12, color=INK)
    axes.set_xlabel(x_label, fontsize=10, color=INK)
    axes.set_ylabel(y_label, fontsize=10, color=INK)
    axes.tick_params(labelsize=9, colors=INK)
    axes.grid(True, color=GRID, linewidth=0.8)
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)
    return axes


def _log_ticks(axis: Any, set_scale: Any) -> None:
    """A logarithmic axis with plain numbers: 1, 2, 5, 10, … or equal steps where it spans little."""
    set_scale("log")
    low, high = axis.get_view_interval()
    subs = (1, 2, 5) if high / low > 8.0 else (1, 1.5, 2, 3, 5, 7)
    axis.set_major_locator(
        LogLocator(subs=subs, numticks=99) if high / low > 2.5 else MaxNLocator(6, steps=[1, 2, 5, 10])
    )
    axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axis.set_minor_locator(NullLocator())
