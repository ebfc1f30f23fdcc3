"""What pictures of the world are made of: frames, outlines, markers, names and samples of legends. Axes are km."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.markers import MarkerStyle
from matplotlib.patches import Patch
from matplotlib.path import Path
from matplotlib.patheffects import withStroke

from passive_env.layers import course_deg, half_axes
from passive_env.palette import GRID, INK, MUTED

DART_PT, RING_PT = 13.0, 16.0
"""Sizes of markers; a ring leaves the dart inside visible."""
RING_LINE = (0, (5, 3))
"""Dashes of a stand-off ring."""
DISC: dict[str, Any] = {"facecolor": (*to_rgb(MUTED), 0.12), "edgecolor": MUTED, "linewidth": 0.9, "hatch": "///"}
"""Style of a no-go disc."""
ASIDE = 0.4
"""From this share of a unit vector on a name counts as standing to that side."""
CROWDED = 0.16
"""Platforms nearer to each other than this share of the picture would have their names overlap."""

_DART = Path([(-0.7, -0.8), (0.0, 1.0), (0.7, -0.8), (0.0, -0.4), (-0.7, -0.8)])
_HALO = [withStroke(linewidth=2.5, foreground="white")]
_CIRCLE = np.stack([f(np.linspace(0.0, 2.0 * math.pi, 65)) for f in (np.cos, np.sin)])


class Frame(NamedTuple):
    """Axis limits [km]: west, south and east, north corner, each [2]."""

    low: Any
    high: Any


# -- geometry of a picture, all in km except where a name ends in _m ---------------------------------------------------


def grow(frame: Frame | None, points: np.ndarray, aspect: float) -> Frame:
    """The frame, enlarged by a margin where points [n, 2] km come near its edge; width / height equals aspect."""
    low, high = points.min(0), points.max(0)
    if frame is not None:
        slack = 0.03 * (frame.high - frame.low)
        if (low >= frame.low + slack).all() and (high <= frame.high - slack).all():
            return frame
        low, high = np.minimum(low, frame.low), np.maximum(high, frame.high)
    margin = np.maximum(0.1 * (high - low).max(), 1.0)
    low, high = low - margin, high + margin
    size = high - low
    missing = np.maximum(np.array([aspect * size[1], size[0] / aspect]) - size, 0.0)
    return Frame(low - 0.5 * missing, high + 0.5 * missing)


def ellipses(mean: Any, cov: Any) -> np.ndarray:
    """Outlines [..., 65, 2] of the 2σ ellipses of mean [..., 2] and cov [..., 2, 2], in the mean's unit.

    A covariance that is not finite gives a point.
    """
    return np.asarray(mean)[..., None, :] + _CIRCLE.T @ half_axes(cov)


def circles(center: Any, radius: Any) -> np.ndarray:
    """Outlines [..., 65, 2] of circles about center [..., 2] with radius [...], in the same unit."""
    return np.asarray(center)[..., None, :] + np.asarray(radius)[..., None, None] * _CIRCLE.T


def edge_points(start: np.ndarray, ends: np.ndarray, frame: Frame) -> tuple[np.ndarray, np.ndarray]:
    """Where the segments from start [2] inside a frame to ends [m, 2] stop: points [m, 2], cut short [m] bool."""
    inset = 0.02 * (frame.high - frame.low)
    way = ends - start
    room = np.where(way > 0.0, frame.high - inset, frame.low + inset) - start
    share = np.divide(room, way, out=np.full_like(way, np.inf), where=way != 0.0).min(-1)
    return start + np.clip(share, 0.0, 1.0)[:, None] * way, share < 1.0


# -- artists -----------------------------------------------------------------------------------------------------------


def style_axes(axes: Axes) -> None:
    """Equal km axes with a light grid behind everything."""
    axes.set_xlabel("east [km]", fontsize=10, color=INK)
    axes.set_ylabel("north [km]", fontsize=10, color=INK, labelpad=2)
    axes.tick_params(labelsize=9, colors=INK)
    axes.grid(True, color=GRID, linewidth=0.8)
    axes.set_axisbelow(True)
    axes.set_facecolor("white")
    axes.set_aspect("equal", adjustable="box")


def set_limits(axes: Axes, frame: Frame) -> None:
    """Show exactly a frame."""
    axes.set_xlim(frame.low[0], frame.high[0])
    axes.set_ylim(frame.low[1], frame.high[1])


def marker(color: str) -> dict[str, Any]:
    """Style of a dart: a station or a true target."""
    return {
        "linestyle": "none", "color": color, "markersize": DART_PT, "markeredgecolor": "white",
        "markeredgewidth": 0.7, "zorder": 6,
    }  # fmt: skip


def ring(color: str, size_pt: float = RING_PT) -> dict[str, Any]:
    """Style of an estimate."""
    return {
        "linestyle": "none", "marker": "o", "markersize": size_pt, "markerfacecolor": "none", "markeredgecolor": color,
        "markeredgewidth": 1.6, "zorder": 5,
    }  # fmt: skip


def add_lines(axes: Axes, colors: list[str], width_pt: float, alpha: float = 1.0) -> LineCollection:
    """Lines in the given colours; `set_segments` places them."""
    lines = LineCollection([], colors=colors, linewidths=width_pt, alpha=alpha, zorder=2)
    axes.add_collection(lines)
    return lines


def add_ellipses(axes: Axes, colors: list[str]) -> PolyCollection:
    """One faintly filled ellipse per colour; `set_verts` places them."""
    faces = [(*to_rgb(color), 0.16) for color in colors]
    outlines = PolyCollection([], facecolors=faces, edgecolors=colors, linewidths=0.9, zorder=3)
    axes.add_collection(outlines)
    return outlines


def add_discs(axes: Axes) -> PolyCollection:
    """Hatched no-go discs; `set_verts` places them."""
    outlines = PolyCollection([], **DISC, zorder=1)
    axes.add_collection(outlines)
    return outlines


def place_dart(line: Line2D, state_m: Any) -> None:
    """Put a dart at a state [4] m, m/s, pointing along its velocity; a dot where that is 0."""
    heading_deg = float(course_deg(state_m))
    line.set_data([1e-3 * state_m[0]], [1e-3 * state_m[1]])
    line.set_marker(_arrow(heading_deg) if math.isfinite(heading_deg) else MarkerStyle("o"))


def place_estimates(rings: list[Line2D], notes: list[Any], reference_m: Any, mean_m: Any, frame: Frame) -> None:
    """Put rings at estimates [m, 2] m; one outside the frame becomes an arrow at its edge, with the range as a note."""
    points, outside = edge_points(1e-3 * reference_m, 1e-3 * mean_m, frame)
    ranges = np.hypot(*(mean_m - reference_m).T)
    for j, (line, note) in enumerate(zip(rings, notes, strict=True)):
        way = mean_m[j] - reference_m
        line.set_data([points[j, 0]], [points[j, 1]])
        line.set_marker(_arrow(math.degrees(math.atan2(way[1], way[0]))) if outside[j] else MarkerStyle("o"))
        note.set_text(f"{ranges[j] / 1e3:.0f} km" if outside[j] else "")
        note.xy = points[j]
        right, upper = points[j] > 0.5 * (frame.low + frame.high)
        note.set(ha="right" if right else "left", va="top" if upper else "bottom")
        note.set_position((-9 if right else 9, -9 if upper else 9))


def name_tag(axes: Axes, text: str, color: str) -> Any:
    """A text that the functions below place beside a marker."""
    return axes.annotate(
        text, (0.0, 0.0), xytext=(9, -7), textcoords="offset points", fontsize=9, fontweight="bold", color=color,
        path_effects=_HALO, zorder=7, annotation_clip=True,
    )  # fmt: skip


def place_name(note: Any, state_m: Any, middle_m: Any, frame: Frame) -> None:
    """Write a name ahead of a state [4] m, m/s, where its trail is not.

    Where the frame ends it stands beside the state, rather on the side away from the middle [2] m of all platforms, or
    behind it.
    """
    note.xy = 1e-3 * state_m[:2]
    ahead = state_m[2:] / math.hypot(*state_m[2:]) if np.isfinite(course_deg(state_m)) else np.array((0.0, 1.0))
    left = np.array((-ahead[1], ahead[0]))
    out = left if left @ (state_m[:2] - middle_m) > 0.0 else -left
    share = (note.xy - frame.low) / (frame.high - frame.low)
    ways = [way for way in (ahead, out, -out, -ahead) if _has_room(way, share)]
    _stand_off(note, ways[0] if ways else ahead)


def _has_room(way: np.ndarray, share: np.ndarray) -> bool:
    """Whether a name fits into the frame on the side [2] of a place at shares [2] of its width and height."""
    room = np.array((0.22, 0.07))  # a name is wider than it is high
    return not ((way > ASIDE) & (share > 1.0 - room) | (way < -ASIDE) & (share < room)).any()


def _stand_off(note: Any, way: np.ndarray) -> None:
    """Move a name off its place into a direction [2]."""
    ha, va = (np.digitize(x, (-ASIDE, ASIDE)) for x in way)
    note.set(ha=("right", "center", "left")[ha], va=("top", "center", "bottom")[va], position=tuple(12.0 * way))


def part_names(notes: list[Any], frame: Frame) -> None:
    """Let placed names of platforms close together stand on different sides: outer ones outwards, inner ones across."""
    places = np.array([note.xy for note in notes]) / (frame.high - frame.low)
    for place, note in zip(places, notes, strict=True):
        crowd = places[np.hypot(*(places - place).T) < CROWDED]
        off, farthest = place - crowd.mean(0), np.hypot(*(crowd - crowd.mean(0)).T).max()
        distance = math.hypot(*off)
        if distance > 1e-9:
            out = off / distance
            _stand_off(note, out if distance > 0.5 * farthest else np.array((-out[1], out[0])))


def place_number(note: Any, state_m: Any, reference_m: Any) -> None:
    """Write a target's number beside its state [4] m, off the line of sight along which the ellipse lies."""
    note.xy = 1e-3 * state_m[:2]
    x, y = state_m[:2] - reference_m[:2]
    distance = max(math.hypot(x, y), 1.0)
    note.set(ha="center", va="center", position=(17.0 * y / distance, -17.0 * x / distance))


def legend_samples(hypotheses: bool, reference: bool = True) -> list[Any]:
    """Samples of the legend; hypotheses only where the tracker has them, a reference where there are more stations."""
    samples: list[Any] = [
        _dart_sample(INK, 1.4, "station (ref.: reference)" if reference else "platform"),
        _dart_sample(MUTED, 2.0, "true target, path"),
        Line2D([], [], **ring(MUTED, 9.0), label="estimate (arrow: off the picture)"),
        Patch(facecolor=(*to_rgb(MUTED), 0.16), edgecolor=MUTED, linewidth=0.9, label="its 2σ ellipse"),
        Line2D([], [], color=MUTED, linewidth=0.9, alpha=0.6, label="bearing used"),
    ]
    dot = Line2D([], [], linestyle="none", marker="o", markersize=7, color=MUTED, alpha=0.6, markeredgewidth=0.0)
    dot.set_label("range hypothesis, by weight")
    return [*samples, dot] if hypotheses else samples


def zone_samples(discs: bool, rings: bool) -> list[Any]:
    """Samples of the zones a scenario has."""
    disc = Patch(**DISC, label="no-go disc")
    standoff = Line2D([], [], color=MUTED, linewidth=1.2, linestyle=RING_LINE, label="stand-off ring")
    return [disc] * discs + [standoff] * rings


def bottom_legend(figure: Figure, samples: list[Any], columns: int) -> None:
    """Replace the figure's legend by one along its lower edge."""
    for old in figure.legends:
        old.remove()
    figure.legend(
        handles=samples, loc="lower center", ncols=columns, fontsize=9, frameon=False, labelcolor=INK,
        bbox_to_anchor=(0.53, 0.0) if columns <= 3 else (0.5, 0.0), columnspacing=2.5 if columns <= 3 else 1.0,
    )  # fmt: skip


def station_names(stations: int, reference: int = -1) -> list[str]:
    """Names of the stations; the one of index `reference` is marked, the only one needs no number."""
    if stations == 1:
        return ["platform"]
    return [f"S{i + 1}{' (ref.)' if i == reference % stations else ''}" for i in range(stations)]


def kilometres(distance_m: float) -> str:
    """A distance with three digits or so."""
    km = distance_m / 1e3
    return f"{km:.2f} km" if km < 9.995 else f"{km:.1f} km" if km < 99.95 else f"{km:,.0f} km"


def metres(distance_m: float) -> str:
    """A distance in metres, or in kilometres where it has some."""
    return f"{distance_m:.0f} m" if distance_m < 999.5 else kilometres(distance_m)


def _dart_sample(color: str, width_pt: float, label: str) -> Line2D:
    line = Line2D([], [], **marker(color))
    line.set(marker=_arrow(0.0), markersize=11, linestyle="-", linewidth=width_pt, label=label)
    return line


def _arrow(heading_deg: float) -> MarkerStyle:
    return MarkerStyle(_DART).rotated(deg=heading_deg - 90.0)
