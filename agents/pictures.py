"""Pictures of evaluations and training: each function returns a figure, saving it is the caller's.

Figures are made without pyplot and change no global setting. Colours and signs are those of `passive_env.artists`.
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

from passive_env import artists
from passive_env.palette import BAD, GOOD, GRID, INK, MUTED, curve_color, series_color

DPI = 150
PANEL_IN, CARD_IN = 4.4, 4.2
"""Width and height of one map of `geometry`, and of one that stands alone."""
DIAGRAM_IN = 1.5
"""Height of the diagram below it."""
ERROR_LINE: dict[str, Any] = {"linestyle": "-", "linewidth": 2.0}
BOUND_LINE: dict[str, Any] = {"linestyle": (0, (4, 2)), "linewidth": 1.2}
LABEL_GAP = 0.06
"""Least distance of two labels at the right edge, as a share of the axes' height."""


class EpisodePaths(NamedTuple):
    """What happened in one episode of k steps, s stations and m targets.

    Attributes:
        stations: [k + 1, s, 2] m, east-north.
        targets: [k + 1, m, 2] m, true positions.
        estimates: [k + 1, m, 2] m, estimated positions.
        final_cov: [m, 2, 2] m², position covariances of the last estimates.
        error_m: [k + 1, m] the tracks' errors, of the kind that `error` names.
        bound_m: [k + 1, m] posterior Cramér–Rao bound on them, a standard deviation.
        discs: [d, 3] no-go discs: centre x, y and radius [m].
        standoff_m: radius of the targets' stand-off rings, 0 for none.
        error: "range" (from the reference) or "position".
        reference: index of the reference station.
    """

    stations: Any
    targets: Any
    estimates: Any
    final_cov: Any
    error_m: Any
    bound_m: Any
    discs: Any = np.empty((0, 3))
    standoff_m: float = 0.0
    error: str = "range"
    reference: int = -1


# -- error over time ---------------------------------------------------------------------------------------------------


def error_over_time(
    time_s: Any, curves: Mapping[str, Any], bound: Mapping[str, Any] | None, title: str, error: str = "range"
) -> Figure:
    """Mean error of several policies over time, on a logarithmic axis.

    The bound is a standard deviation: the mean absolute error of an efficient Gaussian estimator is √(2/π) ≈ 0.8 of it.

    Args:
        time_s: [k + 1] s.
        curves: per policy, mean error [k + 1] m.
        bound: per policy (those that have one), Cramér–Rao bound [k + 1] m, drawn dashed in the policy's colour.
        title: of the figure.
        error: what kind of error it is, "range" or "position".
    Raises:
        ValueError: no curve, a curve of another length than time_s, or a bound of an unknown policy.
    """
    bound = bound or {}
    _check_curves(time_s, curves, bound)
    figure = Figure(figsize=(8.0, 4.6), dpi=DPI, layout="constrained")
    axes = _plain_axes(figure, title, "time [s]", f"mean {error} error [km]")
    for i, (name, curve) in enumerate(curves.items()):
        axes.plot(time_s, 1e-3 * np.asarray(curve), color=curve_color(i), **ERROR_LINE)
        if name in bound:
            axes.plot(time_s, 1e-3 * np.asarray(bound[name]), color=curve_color(i), **BOUND_LINE)
    log_ticks(axes.yaxis, axes.set_yscale)
    axes.set_xlim(time_s[0], time_s[-1])
    _label_ends(axes, time_s[-1], {name: 1e-3 * float(curve[-1]) for name, curve in curves.items()})
    if bound:
        axes.legend(
            handles=_error_samples(error), loc="best", fontsize=9, frameon=True, edgecolor="none", labelcolor=INK
        )
    return figure


def _error_samples(error: str) -> list[Line2D]:
    samples = [(f"{error} error", ERROR_LINE), ("Cramér–Rao bound, 1σ", BOUND_LINE)]
    return [Line2D([], [], color=MUTED, label=name, **style) for name, style in samples]


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
            f"{name}, {artists.kilometres(1e3 * ends_km[name])}", (at, ends_km[name]), xytext=(1.05, place),
            textcoords="axes fraction", va="center", fontsize=9.5, color=INK, annotation_clip=False, arrowprops=leader,
        )  # fmt: skip


# -- geometry ----------------------------------------------------------------------------------------------------------


def geometry(time_s: Any, paths: Mapping[str, EpisodePaths], title: str) -> Figure:
    """Paths of stations and targets and the final estimates; below, error and Cramér–Rao bound over time.

    One panel per policy, all maps on the same axes and all diagrams on the same axes.

    Args:
        time_s: [k + 1] s.
        paths: per policy, one episode; same tape, so that the panels differ by the policy only.
        title: of the figure.
    Raises:
        ValueError: no policy, or errors or bounds of another shape than [k + 1, m].
    """
    _check_paths(time_s, paths)
    bottom = 1.6 if len(paths) == 1 else 1.2  # a narrow legend is a high one
    figure, maps, diagrams = _panels(len(paths), next(iter(paths.values())).error, PANEL_IN, bottom, 0.4)
    frame, limits = _common_frame(paths), _common_errors_km(paths)
    for axes, below, (name, episode) in zip(maps, diagrams, paths.items(), strict=True):
        _map_and_errors(axes, below, time_s, name, episode, frame, limits)
    figure.suptitle(title, fontsize=13, color=INK, y=1.0 - 0.12 / figure.get_figheight(), va="top")
    samples = _geometry_samples(next(iter(paths.values())))
    columns = min(len(samples), int(figure.get_figwidth() / 2.3))
    figure.legend(handles=samples, loc="lower center", ncols=columns, fontsize=9.5, frameon=False, labelcolor=INK)
    return figure


def geometry_cards(time_s: Any, paths: Mapping[str, EpisodePaths]) -> dict[str, Figure]:
    """The maps of `geometry` with their diagrams as a figure per policy, on the same axes; arguments as there."""
    _check_paths(time_s, paths)
    frame, limits = _common_frame(paths), _common_errors_km(paths)
    cards = {}
    for name, episode in paths.items():
        cards[name], (axes,), (below,) = _panels(1, episode.error, CARD_IN, 0.55, 0.0)
        _map_and_errors(axes, below, time_s, name, episode, frame, limits)
    return cards


def geometry_legend(episode: EpisodePaths) -> Figure:
    """What the signs of `geometry_cards` mean."""
    samples = _geometry_samples(episode)
    figure = Figure(figsize=(4.7, 0.1 + 0.26 * math.ceil(len(samples) / 2)), dpi=DPI)
    figure.legend(handles=samples, loc="center", ncols=2, fontsize=9.5, frameon=False, labelcolor=INK, borderpad=0.0)
    return figure


def _map_and_errors(
    axes: Axes, below: Axes, time_s: Any, name: str, episode: EpisodePaths, frame: artists.Frame,
    limits: tuple[float, float],
) -> None:  # fmt: skip
    _panel(axes, episode, frame)
    _errors_below(below, time_s, episode, limits)
    final = artists.kilometres(np.mean(episode.error_m[-1]))
    axes.set_title(f"{name}: {final} off at the end", fontsize=11.5, color=INK)


def _check_paths(time_s: Any, paths: Mapping[str, EpisodePaths]) -> None:
    if not paths:
        raise ValueError("paths: needs at least one policy")
    for name, episode in paths.items():
        wanted = (len(time_s), np.shape(episode.targets)[1])
        for field in ("error_m", "bound_m"):
            if np.shape(getattr(episode, field)) != wanted:
                found = np.shape(getattr(episode, field))
                raise ValueError(f"paths[{name!r}].{field} has shape {found}, must be [instants, targets] = {wanted}")


def _geometry_samples(episode: EpisodePaths) -> list[Any]:
    several = np.shape(episode.stations)[1] > 1
    samples = artists.legend_samples(hypotheses=False, reference=several)[:4]
    samples += artists.zone_samples(len(episode.discs) > 0, episode.standoff_m > 0.0)
    return [*samples, *_error_samples(episode.error)]


def _panels(
    count: int, error: str, panel_in: float, bottom: float, top: float
) -> tuple[Figure, list[Axes], list[Axes]]:
    """A figure of equal square maps, each with a diagram below, laid out in inches; only outer ones carry labels.

    Bottom and top are the room for labels and a legend, and for the figure's title.
    """
    columns = {1: 1, 2: 2, 4: 2, 7: 4, 8: 4}.get(count, 3)
    rows = math.ceil(count / columns)
    left, right, between, title, gap = 0.75, 0.2, 0.35, 0.4, 0.65
    row_height, row_gap = title + panel_in + gap + DIAGRAM_IN, 0.6
    width = left + columns * (panel_in + between) - between + right
    figure = Figure(figsize=(width, bottom + rows * (row_height + row_gap) - row_gap + top), dpi=DPI)
    maps, diagrams = [], []
    for i in range(count):
        row, column = divmod(i, columns)
        x, y = left + column * (panel_in + between), bottom + (rows - 1 - row) * (row_height + row_gap)
        axes = axes_at(figure, x, y + DIAGRAM_IN + gap, panel_in, panel_in)
        artists.style_axes(axes)
        below = axes_at(figure, x, y, panel_in, DIAGRAM_IN)
        style_diagram(below, "time [s]", f"{error} error [km]")
        if column > 0:
            _hide_left_labels(axes, below)
        if i + columns < count:
            below.set_xlabel("")
        maps.append(axes)
        diagrams.append(below)
    return figure, maps, diagrams


def _hide_left_labels(*panels: Axes) -> None:
    for axes in panels:
        axes.tick_params(labelleft=False)
        axes.set_ylabel("")


def _common_errors_km(paths: Mapping[str, EpisodePaths]) -> tuple[float, float]:
    """Limits [km] of all errors and bounds."""
    drawn = [np.ravel(part) for episode in paths.values() for part in (episode.error_m, episode.bound_m)]
    low, high = error_limits(np.concatenate(drawn))
    return 1e-3 * low, 1e-3 * high


def error_limits(values_m: np.ndarray) -> tuple[float, float]:
    """Limits [m] that hold bounds and the errors [n] m that are not near one of their passages through zero."""
    values = values_m[np.isfinite(values_m) & (values_m > 0.0)]
    if not len(values):
        return 100.0, 10e3
    return max(0.7 * float(np.percentile(values, 2.0)), 1.0), 1.4 * float(values.max())


def _errors_below(axes: Axes, time_s: Any, episode: EpisodePaths, limits: tuple[float, float]) -> None:
    axes.set_ylim(*limits)
    line: dict[str, Any] = ERROR_LINE if np.shape(episode.error_m)[1] == 1 else ERROR_LINE | {"linewidth": 1.4}
    errors = zip(np.transpose(episode.error_m), np.transpose(episode.bound_m), strict=True)
    for j, (error, bound) in enumerate(errors):
        axes.plot(time_s, 1e-3 * error, color=series_color(j), **line)
        axes.plot(time_s, 1e-3 * bound, color=series_color(j), **BOUND_LINE)
    axes.set_xlim(time_s[0], max(time_s[-1], time_s[0] + 1.0))
    log_ticks(axes.yaxis, axes.set_yscale)
    axes.set_ylim(*limits)


def _common_frame(paths: Mapping[str, EpisodePaths]) -> artists.Frame:
    """A square that holds all platforms, true targets and discs of all episodes; estimates may fall outside."""
    discs = next(iter(paths.values())).discs
    tracks = [path for episode in paths.values() for path in (episode.stations, episode.targets)]
    tracks.append(artists.circles(discs[:, :2], discs[:, 2]))
    return artists.grow(None, 1e-3 * np.concatenate([np.reshape(path, (-1, 2)) for path in tracks]), 1.0)


def _panel(axes: Axes, episode: EpisodePaths, frame: artists.Frame) -> None:
    stations, targets, estimates = (np.asarray(path) for path in episode[:3])
    colors = [series_color(j) for j in range(targets.shape[1])]
    artists.set_limits(axes, frame)
    artists.add_discs(axes).set_verts(list(1e-3 * artists.circles(episode.discs[:, :2], episode.discs[:, 2])))
    if episode.standoff_m > 0.0:
        rings_about = artists.add_lines(axes, colors, 1.2, alpha=0.8)
        rings_about.set_linestyle(artists.RING_LINE)
        rings_about.set_segments(list(1e-3 * artists.circles(targets[-1], episode.standoff_m)))
    artists.add_lines(axes, [INK], 1.4, alpha=0.75).set_segments(_segments(stations))
    artists.add_lines(axes, colors, 1.8).set_segments(_segments(targets))
    artists.add_ellipses(axes, colors).set_verts(list(1e-3 * artists.ellipses(estimates[-1], episode.final_cov)))
    names = [artists.name_tag(axes, text, INK) for text in artists.station_names(stations.shape[1], episode.reference)]
    for state, name in zip(_final_states(stations), names, strict=True):
        artists.place_dart(axes.plot([], [], **artists.marker(INK))[0], state)
        artists.place_name(name, state, stations[-1].mean(0), frame)
    artists.part_names(names, frame)
    numbers = []
    for j, (state, color) in enumerate(zip(_final_states(targets), colors, strict=True)):
        artists.place_dart(axes.plot([], [], **artists.marker(color))[0], state)
        numbers.append(artists.name_tag(axes, str(j + 1), color))
        artists.place_number(numbers[j], state, stations[-1, episode.reference])
    rings = [axes.plot([], [], **artists.ring(color, 12.0))[0] for color in colors]
    notes = [artists.name_tag(axes, "", color) for color in colors]
    artists.place_estimates(rings, notes, stations[-1, episode.reference], estimates[-1], frame)
    for number, note in zip(numbers, notes, strict=True):
        _clear(number, note)


def _clear(number: Any, note: Any) -> None:
    """Move a target's number to the other side of its dart if the note on an estimate off the picture is there."""
    x, y = number.get_position()
    below = note.get_va() == "top"
    if note.get_text() and (y < 0.0) == below:
        number.set_position((-x, -y))


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
    log_ticks(axes.xaxis, axes.set_xscale)
    for row, (r, a, b) in zip(rows, values, strict=True):
        interval = f"  [{a:.2f}, {b:.2f}]" if a <= b else ""
        axes.annotate(
            f"{r:.2f}{interval}", (1.02, row), xycoords=("axes fraction", "data"), va="center", fontsize=9.5,
            color=INK, annotation_clip=False,
        )  # fmt: skip
    return figure


# -- axes --------------------------------------------------------------------------------------------------------------


def axes_at(figure: Figure, left: float, bottom: float, width: float, height: float) -> Axes:
    """New axes at a place given in inches."""
    w, h = figure.get_size_inches()
    return figure.add_axes((left / w, bottom / h, width / w, height / h))


def _plain_axes(figure: Figure, title: str, x_label: str, y_label: str) -> Axes:
    axes = figure.add_subplot()
    axes.set_title(title, loc="left", fontsize=12, color=INK)
    style_diagram(axes, x_label, y_label)
    return axes


def style_diagram(axes: Axes, x_label: str, y_label: str) -> None:
    """Axes of a diagram: labels, a light grid behind everything, no frame above and right."""
    axes.set_xlabel(x_label, fontsize=10, color=INK)
    axes.set_ylabel(y_label, fontsize=10, color=INK)
    axes.tick_params(labelsize=9, colors=INK)
    axes.grid(True, color=GRID, linewidth=0.8)
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)


def log_ticks(axis: Any, set_scale: Any) -> None:
    """A logarithmic axis with plain numbers: 1, 2, 5, 10, … or equal steps where it spans little."""
    set_scale("log")
    low, high = axis.get_view_interval()
    subs = (1, 2, 5) if high / low > 8.0 else (1, 1.5, 2, 3, 5, 7)
    axis.set_major_locator(
        LogLocator(subs=subs, numticks=99) if high / low > 2.5 else MaxNLocator(6, steps=[1, 2, 5, 10])
    )
    axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axis.set_minor_locator(NullLocator())
