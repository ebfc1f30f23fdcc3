"""Pictures of an episode: where the platforms and targets are, what the tracker believes, how far off it is.

A picture holds, in the colour of its target, the true path (solid, dart at its head), the track's estimate (ring) with
its 2σ ellipse, the hypotheses of a bank (dots, larger and darker with weight) and a thin line to the estimate from
every station whose bearing updated the track; in black the stations with their trails; where the scenario has them,
no-go discs (hatched) and stand-off rings (dashed). Axes are km, east-north.

The window of mode "human" is pyplot's; mode "rgb_array" neither imports pyplot nor touches any global setting.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.markers import MarkerStyle
from matplotlib.patches import Patch
from matplotlib.path import Path
from matplotlib.patheffects import withStroke

from passive_env.core import Simulation, World
from passive_env.palette import GRID, INK, MUTED, series_color

SIZE_IN, DPI = 8.0, 100
"""Pictures are 800 × 800 pixels."""
AXES_BOX = (0.085, 0.135, 0.895, 0.805)
"""Left, bottom, width, height of the axes as shares of the picture."""
ELLIPSE_STD = 2.0
"""Half axes of a covariance ellipse in standard deviations."""
LOOK_AHEAD = 60
"""Instants of the targets' courses that the first frame leaves room for, so that axes rarely change later."""
LINE_BEYOND = 1.06
"""A bearing line ends this many times as far as the estimate."""
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
PAUSE_S = 0.1
"""Time a window stays at one step."""

_DART = Path([(-0.7, -0.8), (0.0, 1.0), (0.7, -0.8), (0.0, -0.4), (-0.7, -0.8)])
_HALO = [withStroke(linewidth=2.5, foreground="white")]
_CIRCLE = np.stack([f(np.linspace(0.0, 2.0 * math.pi, 65)) for f in (np.cos, np.sin)])


class Frame(NamedTuple):
    """Axis limits [km]: west, south and east, north corner, each [2]."""

    low: Any
    high: Any


class Hypotheses(NamedTuple):
    """Where the hypotheses of m tracks are: position [m, n, 2] m, weight [m, n]."""

    position: Any
    weight: Any


NO_HYPOTHESES = Hypotheses(np.empty((1, 0, 2)), np.empty((1, 0)))


class Viewer:
    """Draws worlds of one environment, one after the other.

    Args:
        simulation: the scenario's parts.
        render_mode: "rgb_array", or "human" for a window (needs a display; without one it warns once).
    """

    def __init__(self, simulation: Simulation, render_mode: str):
        self._simulation = simulation
        self._scene: Any = None
        self._trail = Trail()
        self._frame: Frame | None = None
        self._window = Window() if render_mode == "human" else None

    def clear(self) -> None:
        """Forget the trails and the axis limits: a new episode begins."""
        self._trail = Trail()
        self._frame = None

    def draw(self, world: World) -> np.ndarray | None:
        """Picture of a world that is a batch of one: RGB uint8 [800, 800, 3], or None for mode "human"."""
        if self._window is not None and not self._window.is_open():
            return None
        if self._scene is None:
            figure = _figure() if self._window is None else self._window.figure
            self._scene = self._simulation.scenario.make_scene(figure)
        if self._trail.add(world):
            self._frame = None
        self._frame = grow(self._frame, contents(world, self._trail, self._frame is None), self._scene.aspect)
        self._scene.update(world, self._trail.paths, self._frame, self._simulation)
        if self._window is not None:
            return self._window.show()
        return self._scene.pixels()

    def close(self) -> None:
        """Close the window and free the figure."""
        if self._window is not None:
            self._window.close()
        self._scene = None
        self.clear()


class Trail:
    """Where the platforms have been since the episode's start, or since the first picture of it."""

    def __init__(self) -> None:
        self._points: dict[int, np.ndarray] = {}
        self._episode = b""

    def add(self, world: World) -> bool:
        """Take a world's platforms; a step seen before replaces what followed it. True if an episode begins."""
        step, episode = int(world.step[0]), _fingerprint(world)
        new = episode != self._episode or step == 0
        self._episode = episode
        self._points = {} if new else {k: p for k, p in self._points.items() if k < step}
        self._points[step] = np.array(world.platforms[0, :, : world.platforms.shape[-1] // 2])
        return new

    @property
    def paths(self) -> np.ndarray:
        """Positions [s, k, 2] m, in space [s, k, 3] m, in order of time."""
        return np.stack(list(self._points.values()), axis=1)


class Window:
    """A pyplot window; without a display it warns once and stays shut."""

    def __init__(self) -> None:
        self._figure: Any = None
        self._refused = False

    @property
    def figure(self) -> Figure:
        """The window's figure."""
        return self._figure

    def is_open(self) -> bool:
        """Open the window at the first call; False without a display or once the user has closed it."""
        if self._refused:
            return False
        from matplotlib import pyplot

        if self._figure is not None:
            return pyplot.fignum_exists(self._figure.number)
        try:
            self._figure = pyplot.figure(figsize=(SIZE_IN, SIZE_IN), dpi=DPI)
        except Exception as error:  # a GUI toolkit without a display raises an error of its own
            return self._refuse(str(error))
        if not getattr(self._figure.canvas, "required_interactive_framework", None):
            pyplot.close(self._figure)
            return self._refuse(f"matplotlib's backend {pyplot.get_backend()!r} opens no windows")
        return True

    def show(self) -> None:
        """Bring the window up to date and let it react for a moment."""
        self._figure.show()
        self._figure.canvas.draw_idle()
        self._figure.canvas.start_event_loop(PAUSE_S)

    def close(self) -> None:
        """Close the window."""
        if self._figure is not None and not self._refused:
            from matplotlib import pyplot

            pyplot.close(self._figure)
        self._figure = None

    def _refuse(self, reason: str) -> bool:
        self._refused = True
        gym.logger.warn(f"render_mode='human' shows nothing: {reason}. Use render_mode='rgb_array' for pictures.")
        return False


class Scene:
    """The artists of a picture, made once and moved from step to step.

    Args:
        figure: an empty figure.
        stations, targets: how many.
        steps: the episode's length, for the title.
        standoff_m: radius of the targets' stand-off rings, 0 for none.
        box: left, bottom, width, height of the axes as shares of the picture.
    """

    legend_columns = 4
    """Of more than six samples: two rows have room."""

    def __init__(
        self, figure: Figure, stations: int, targets: int, steps: int, standoff_m: float = 0.0, box: Any = AXES_BOX
    ):
        self._figure, self._steps, self._standoff_m = figure, steps, standoff_m
        self._axes = axes = figure.add_axes(box)
        style_axes(axes)
        self.aspect = box[2] / box[3]
        colors = [series_color(j) for j in range(targets)]
        self._colors = np.array([to_rgb(color) for color in colors])
        per_line = [color for color in colors for _ in range(stations)]
        self._discs = add_discs(axes)
        self._bearings = add_lines(axes, per_line, 0.8, alpha=0.35)
        self._rings = add_lines(axes, colors, 1.2, alpha=0.8)
        self._rings.set_linestyle(RING_LINE)
        self._trails = add_lines(axes, [INK], 1.4, alpha=0.75)
        self._courses = add_lines(axes, colors, 2.0)
        self._ellipses = add_ellipses(axes, colors)
        self._hypotheses = axes.scatter([], [], linewidths=0.0, zorder=4)
        self._stations = [axes.plot([], [], **marker(INK))[0] for _ in range(stations)]
        self._targets = [axes.plot([], [], **marker(color))[0] for color in colors]
        self._estimates = [axes.plot([], [], **ring(color))[0] for color in colors]
        self._station_names = [name_tag(axes, text, INK) for text in station_names(stations)]
        self._target_names = [name_tag(axes, str(j + 1), color) for j, color in enumerate(colors)]
        self._off_frame = [name_tag(axes, "", color) for color in colors]
        self._clock = _title(axes, 0.0, "left")
        self._merit = _title(axes, 1.0, "right")
        self._shown: tuple[Any, ...] | None = None
        self._background: Any = None

    def update(self, world: World, trails: np.ndarray, frame: Frame, simulation: Simulation) -> None:
        """Show a world (a batch of one) with the platforms' trails [s, k, 2] m inside a frame."""
        step, step_s = int(world.step[0]), simulation.scenario.step_s
        hypotheses = hypotheses_of(world.track_state)
        self._show_axes(frame, hypotheses is not None, world)
        self._show_platforms(world, trails, frame)
        self._show_targets(world, step)
        self._show_tracks(world, frame)
        self._show_hypotheses(hypotheses or NO_HYPOTHESES)
        self._clock.set_text(f"t = {step * step_s:g} s   (step {step} of {self._steps})")
        self._merit.set_text(self._merit_of(world))

    def _merit_of(self, world: World) -> str:
        error, bound = world.metrics.range_error_m[0].mean(), world.metrics.range_crlb_m[0].mean()
        return f"mean range error {kilometres(error)},  1σ bound {kilometres(bound)}"

    def pixels(self) -> np.ndarray:
        """RGB uint8 [h, w, 3]; axes and legend, three quarters of the work, are drawn only when they change."""
        canvas: Any = self._figure.canvas
        moving = [*self._axes.collections, *self._axes.lines, *self._axes.texts]
        if self._background is None:
            for artist in moving:
                artist.set_animated(True)
            canvas.draw()
            self._background = canvas.copy_from_bbox(self._figure.bbox)
        canvas.restore_region(self._background)
        for artist in sorted(moving, key=lambda artist: artist.zorder):
            artist.draw(canvas.get_renderer())
        return np.ascontiguousarray(np.asarray(canvas.buffer_rgba())[..., :3])

    def _show_axes(self, frame: Frame, hypotheses: bool, world: World) -> None:
        if self._shown == (hypotheses, *frame.low, *frame.high):
            return
        self._shown, self._background = (hypotheses, *frame.low, *frame.high), None
        set_limits(self._axes, frame)
        samples = legend_samples(hypotheses, world.platforms.shape[1] > 1)
        samples += zone_samples(world.tape.discs.shape[1] > 0, self._standoff_m > 0.0) + self._more_samples()
        bottom_legend(self._figure, samples, columns=3 if len(samples) <= 6 else self.legend_columns)

    def _more_samples(self) -> list[Any]:
        """Samples of what a family's own scene adds."""
        return []

    def _show_platforms(self, world: World, trails: np.ndarray, frame: Frame) -> None:
        self._trails.set_segments(list(1e-3 * trails))
        for state, line, name in zip(world.platforms[0], self._stations, self._station_names, strict=True):
            place_dart(line, state)
            place_name(name, state, world.platforms[0, :, :2].mean(0), frame)
        part_names(self._station_names, frame)

    def _show_targets(self, world: World, step: int) -> None:
        self._discs.set_verts(list(1e-3 * circles(world.tape.discs[0, :, :2], world.tape.discs[0, :, 2])))
        if self._standoff_m > 0.0:
            self._rings.set_segments(list(1e-3 * circles(world.truth[0, :, :2], self._standoff_m)))
        courses = world.tape.targets[0, : step + 1, :, :2]
        self._courses.set_segments(list(1e-3 * np.swapaxes(courses, 0, 1)))
        for state, line, number in zip(world.truth[0], self._targets, self._target_names, strict=True):
            place_dart(line, state)
            place_number(number, state, world.platforms[0, -1])

    def _show_tracks(self, world: World, frame: Frame) -> None:
        mean, stations = world.estimate.mean[0, :, :2], world.platforms[0, :, :2]
        self._ellipses.set_verts(list(1e-3 * ellipses(mean, world.estimate.cov[0, :, :2, :2])))
        ends = stations + LINE_BEYOND * (mean[:, None] - stations)
        lines = np.stack(np.broadcast_arrays(stations, ends), axis=2)
        lines = np.where(world.reports.assigned[0][..., None, None], 1e-3 * lines, np.nan)
        self._bearings.set_segments(list(lines.reshape(-1, 2, 2)))
        place_estimates(self._estimates, self._off_frame, stations[-1], mean, frame)

    def _show_hypotheses(self, hypotheses: Hypotheses) -> None:
        weight = hypotheses.weight
        alpha = np.where(weight > 1e-3, 0.25 + 0.5 * weight, 0.0)
        rgb = np.broadcast_to(self._colors[: len(weight), None], (*weight.shape, 3))
        self._hypotheses.set_offsets(1e-3 * hypotheses.position.reshape(-1, 2))
        self._hypotheses.set_sizes(8.0 + 110.0 * weight.ravel())
        colors: Any = np.concatenate([rgb, alpha[..., None]], axis=-1).reshape(-1, 4)
        self._hypotheses.set_facecolor(colors)


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
    finite = np.isfinite(cov).all((-2, -1), keepdims=True)
    values, vectors = np.linalg.eigh(np.where(finite, cov, 0.0))
    half_axes = vectors * (ELLIPSE_STD * np.sqrt(np.maximum(values, 0.0)))[..., None, :]
    return np.asarray(mean)[..., None, :] + np.swapaxes(half_axes @ _CIRCLE, -1, -2)


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


def contents(world: World, trail: Trail, first: bool) -> np.ndarray:
    """Points [n, 2] km that the frame must hold: trails, courses, discs; at first also the targets' near future."""
    last = int(world.step[0]) + 1 + (LOOK_AHEAD if first else 0)
    targets = world.tape.targets[0, :last, :, :2]
    discs = circles(world.tape.discs[0, :, :2], world.tape.discs[0, :, 2])
    trails = trail.paths[..., :2]
    return 1e-3 * np.concatenate([points.reshape(-1, 2) for points in (trails, targets, discs)])


def hypotheses_of(state: Any) -> Hypotheses | None:
    """Hypotheses of a batch of one if the tracker's state has the fields of a bank and several of them, else None."""
    mean: Any = getattr(state, "mean", None)
    log_weights: Any = getattr(state, "log_weights", None)
    shape = np.shape(log_weights)
    if len(shape) != 3 or shape[2] < 2 or np.shape(mean) != (*shape, 4):
        return None
    return Hypotheses(np.asarray(mean)[0, ..., :2], np.exp(log_weights)[0])


def _fingerprint(world: World) -> bytes:
    """Tells episodes apart: a tape's first numbers."""
    return b"".join(np.ascontiguousarray(part).tobytes() for part in (world.tape.platforms[0], world.tape.noise[0, 0]))


# -- artists, shared with `agents.pictures` ----------------------------------------------------------------------------


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
    """Put a dart at a state [4] m, m/s, pointing along its velocity."""
    heading_deg = math.degrees(math.atan2(state_m[3], state_m[2]))
    line.set_data([1e-3 * state_m[0]], [1e-3 * state_m[1]])
    line.set_marker(_arrow(heading_deg))


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
    ahead = state_m[2:] / max(math.hypot(*state_m[2:]), 1e-9)
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


def _title(axes: Axes, x: float, side: str) -> Any:
    return axes.annotate(
        "", (x, 1.0), xytext=(0, 7), xycoords="axes fraction", textcoords="offset points", ha=side, fontsize=11,
        color=INK, annotation_clip=False,
    )  # fmt: skip


def _figure() -> Figure:
    figure = Figure(figsize=(SIZE_IN, SIZE_IN), dpi=DPI, facecolor="white")
    FigureCanvasAgg(figure)
    return figure
