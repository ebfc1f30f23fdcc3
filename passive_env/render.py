"""Pictures of an episode: where the platforms and targets are, what the tracker believes, how far off it is.

A picture holds, in the colour of its target, the true path (solid, dart at its head), the track's estimate (ring) with
its 2σ ellipse, the hypotheses of a bank (dots, larger and darker with weight) and a thin line to the estimate from
every station whose bearing updated the track; in black the stations with their trails; where the scenario has them,
no-go discs (hatched) and stand-off rings (dashed). Axes are km, east-north.

The window of mode "human" is pyplot's; mode "rgb_array" neither imports pyplot nor touches any global setting.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure

from passive_env.artists import (
    RING_LINE,
    Frame,
    add_discs,
    add_ellipses,
    add_lines,
    bottom_legend,
    circles,
    ellipses,
    grow,
    kilometres,
    legend_samples,
    marker,
    name_tag,
    part_names,
    place_dart,
    place_estimates,
    place_name,
    place_number,
    ring,
    set_limits,
    station_names,
    style_axes,
    zone_samples,
)
from passive_env.core import Simulation, World
from passive_env.layers import (
    PLAN,
    Instant,
    View,
    circle_rows,
    clock,
    dart_rows,
    dot_rows,
    ellipse_rows,
    errors_of,
    line_rows,
    numbered,
)
from passive_env.palette import INK, series_color

SIZE_IN, DPI = 8.0, 100
"""Pictures are 800 × 800 pixels."""
AXES_BOX = (0.085, 0.135, 0.895, 0.805)
"""Left, bottom, width, height of the axes as shares of the picture."""
LOOK_AHEAD = 60
"""Instants of the targets' courses that the first frame leaves room for, so that axes rarely change later."""
LINE_BEYOND = 1.06
"""A bearing line ends this many times as far as the estimate."""
PAUSE_S = 0.1
"""Time a window stays at one step."""


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
        self._bearings.set_segments(list(1e-3 * bearing_lines(world).reshape(-1, 2, 2)))
        place_estimates(self._estimates, self._off_frame, stations[-1], mean, frame)

    def _show_hypotheses(self, hypotheses: Hypotheses) -> None:
        weight = hypotheses.weight
        alpha = np.where(weight > 1e-3, 0.25 + 0.5 * weight, 0.0)
        rgb = np.broadcast_to(self._colors[: len(weight), None], (*weight.shape, 3))
        self._hypotheses.set_offsets(1e-3 * hypotheses.position.reshape(-1, 2))
        self._hypotheses.set_sizes(8.0 + 110.0 * weight.ravel())
        colors: Any = np.concatenate([rgb, alpha[..., None]], axis=-1).reshape(-1, 4)
        self._hypotheses.set_facecolor(colors)


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


def bearing_lines(world: World) -> np.ndarray:
    """Segments [m, s, 2, 2] m from stations to just beyond estimates; NaN where a bearing did not update the track."""
    mean, stations = world.estimate.mean[0, :, :2], world.platforms[0, :, :2]
    ends = stations + LINE_BEYOND * (mean[:, None] - stations)
    lines = np.stack(np.broadcast_arrays(stations, ends), axis=2)
    return np.where(world.reports.assigned[0][..., None, None], lines, np.nan)


def level_layers(world: World, standoff_m: float) -> dict[str, np.ndarray]:
    """Layers of a world (a batch of one) in the plane that all families show on their maps."""
    truth, discs = world.truth[0], world.tape.discs[0]
    mean, cov = world.estimate.mean[0, :, :2], world.estimate.cov[0, :, :2, :2]
    layers = {
        "platforms": dart_rows(world.platforms), "true targets": dart_rows(truth)[:, None],
        "estimates": 1e-3 * mean[:, None], "2σ ellipses": ellipse_rows(mean, cov)[:, None],
    }  # fmt: skip
    if len(discs):
        layers["no-go discs"] = circle_rows(discs[None, :, :2], discs[None, :, 2])
    if standoff_m > 0.0:
        layers["stand-off rings"] = circle_rows(truth[:, :2], standoff_m)[:, None]
    return layers


def bearing_instants(world: World, simulation: Simulation) -> list[Instant]:
    """What there is to see of a world (a batch of one) of stations that take bearings."""
    scenario, banks = simulation.scenario, hypotheses_of(world.track_state)
    layers = level_layers(world, scenario.standoff_m) | {"bearings used": line_rows(bearing_lines(world))}
    heaviest = {}
    if banks is not None:
        layers["range hypotheses"] = dot_rows(1e-3 * banks.position, banks.weight)
        words = numbered("heaviest hypothesis of target", len(banks.weight))
        heaviest = dict(zip(words, banks.weight.max(-1), strict=True))
    view = View("map", PLAN, layers, plane_names(world, scenario.reference))
    at, label = clock(int(world.step[0]), scenario)
    return [Instant(at, label, (view,), errors_of(world.metrics, scenario.score), heaviest)]


def plane_names(world: World, reference: int) -> dict[str, tuple[str, ...]]:
    """Names of platforms, targets and estimates, by layer."""
    stations, targets = world.platforms.shape[1], world.truth.shape[1]
    return {
        "platforms": tuple(station_names(stations, reference)), "true targets": numbered("target", targets),
        "estimates": numbered("estimate", targets),
    }  # fmt: skip


def _fingerprint(world: World) -> bytes:
    """Tells episodes apart: a tape's first numbers."""
    return b"".join(np.ascontiguousarray(part).tobytes() for part in (world.tape.platforms[0], world.tape.noise[0, 0]))


def _title(axes: Axes, x: float, side: str) -> Any:
    return axes.annotate(
        "", (x, 1.0), xytext=(0, 7), xycoords="axes fraction", textcoords="offset points", ha=side, fontsize=11,
        color=INK, annotation_clip=False,
    )  # fmt: skip


def _figure() -> Figure:
    figure = Figure(figsize=(SIZE_IN, SIZE_IN), dpi=DPI, facecolor="white")
    FigureCanvasAgg(figure)
    return figure
