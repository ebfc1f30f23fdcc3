"""Picture of a placement: the map with sensors, where they may be and how the target may come, and their heights below.

`draw_area`, `draw_heights` and `draw_sensors` are shared with `agents.placement_pictures`.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from passive_env.artists import bottom_legend, kilometres, style_axes
from passive_env.core import Simulation, World
from passive_env.layers import Instant, View, dart_rows, ellipse_rows, errors_of, line_rows, numbered
from passive_env.palette import BLUE, GRID, INK, MUTED
from passive_env.placement import Task, representative_courses, site

MAP_BOX, HEIGHTS_BOX = (0.1, 0.36, 0.87, 0.58), (0.1, 0.15, 0.87, 0.14)
"""Left, bottom, width, height of map and heights as shares of the picture."""
AREA: dict[str, Any] = {"color": MUTED, "linewidth": 1.2, "linestyle": (0, (5, 3))}
COURSE: dict[str, Any] = {"color": BLUE, "linewidth": 0.9, "alpha": 0.6}
TARGET: dict[str, Any] = {"color": BLUE, "linewidth": 2.2}
SENSOR: dict[str, Any] = {"linestyle": "none", "markersize": 9, "markeredgecolor": "white", "markeredgewidth": 0.8}
MARKERS = {True: "o", False: "^"}
"""Of sensors that measure range, and of those that do not."""


class PlacementScene:
    """The artists of a picture, made anew at every step: there are few.

    Args:
        figure: an empty figure.
        scenario: supplies number, kinds and scans.
    """

    aspect = MAP_BOX[2] / MAP_BOX[3]

    def __init__(self, figure: Figure, scenario: Any):
        self._figure, self._scenario = figure, scenario
        self._map, self._heights = figure.add_axes(MAP_BOX), figure.add_axes(HEIGHTS_BOX)
        samples = [
            _sensor_sample(True, "sensor"), Line2D([], [], **TARGET, label="true course"),
            Line2D([], [], **COURSE, label="expected courses"), Line2D([], [], **AREA, label="where sensors may be"),
        ]  # fmt: skip
        if not scenario.ranging.all():
            samples.append(_sensor_sample(False, "sensor without range"))
        bottom_legend(figure, samples, columns=3)

    def update(self, world: World, trails: np.ndarray, frame: Any, simulation: Any) -> None:
        """Show a world (a batch of one)."""
        task, placed = world.tape.task.rows(slice(1)), int(world.step[0])
        sensors = world.platforms[0, :placed, :3]
        path = world.tape.targets[0, :, 0]
        draw_area(self._map, task, self._scenario)
        self._map.plot(*(1e-3 * path[:, :2].T), **TARGET)
        draw_heights(self._heights, task, self._map.get_xlim())
        self._heights.plot(1e-3 * path[:, 0], 1e-3 * path[:, 2], **TARGET)
        for axes, heights in ((self._map, False), (self._heights, True)):
            draw_sensors(axes, sensors, self._scenario.ranging, heights)
        self._write(world, placed)

    def pixels(self) -> np.ndarray:
        """RGB uint8 [h, w, 3]."""
        canvas: Any = self._figure.canvas
        canvas.draw()
        return np.array(np.asarray(canvas.buffer_rgba())[..., :3])

    def _write(self, world: World, placed: int) -> None:
        figures = world.metrics
        told = f"1σ promised {kilometres(figures.position_crlb_m[0, 0])}"
        if placed == self._scenario.steps:
            told = f"position error {kilometres(figures.position_error_m[0, 0])},  {told}"
        self._map.set_title(f"{placed} of {self._scenario.steps} sensors placed", loc="left", fontsize=11, color=INK)
        self._map.set_title(told, loc="right", fontsize=11, color=INK)


def area_corners(task: Task) -> np.ndarray:
    """Outline [n, 2] m of where sensors of a task (a batch of one) may be, seen from above."""
    angle = np.linspace(-task.azimuth_limit_rad[0], task.azimuth_limit_rad[0], 121)
    near, far = task.distance_m[0]
    outline = [site(a, d, 0.0, task.entry_distance_m[0])[:, :2] for a, d in ((angle, near), (angle[::-1], far))]
    return np.concatenate([*outline, outline[0][:1]])


def entry_arc(task: Task) -> np.ndarray:
    """Where the target of a task (a batch of one) may enter, seen from above: [k, 2] m."""
    bearing = np.linspace(-task.sector_rad[0], task.sector_rad[0], 41)
    return task.entry_distance_m[0] * np.stack([np.cos(bearing), np.sin(bearing)], axis=-1)


def draw_area(axes: Axes, task: Task, scenario: Any) -> None:
    """Clear a map and draw where sensors may be and how the target of a task (a batch of one) may come."""
    axes.clear()
    style_axes(axes)
    axes.set_xlabel("from the site towards the expected entry [km]", fontsize=10, color=INK)
    axes.set_ylabel("to the left, seen from the site [km]", fontsize=10, color=INK, labelpad=2)
    outline = 1e-3 * area_corners(task)
    axes.plot(*outline.T, **AREA)
    courses = representative_courses(task, scenario.scans, scenario.step_s)[0]
    axes.add_collection(LineCollection(list(1e-3 * courses[..., :2]), colors=BLUE, linewidths=0.9, alpha=0.6))
    sector = 1e-3 * entry_arc(task)
    axes.plot(*sector.T, **COURSE)
    axes.plot([0.0], [0.0], marker="+", color=INK, markersize=11)
    points = np.concatenate([outline, sector, [[0.0, 0.0]]])
    low, high = points.min(0), points.max(0)
    middle, size = 0.5 * (low + high), 1.1 * (high - low)
    box = axes.get_position(original=True)
    figure: Any = axes.get_figure()
    width, height = figure.get_size_inches() * (box.width, box.height)
    half = 0.5 * max(size[0] / width, size[1] / height)
    axes.set_xlim(middle[0] - half * width, middle[0] + half * width)
    axes.set_ylim(middle[1] - half * height, middle[1] + half * height)


def draw_heights(axes: Axes, task: Task, x_limits: tuple[float, float]) -> None:
    """Clear the side view of a task (a batch of one): limits of sensors' heights and of the target's altitude."""
    axes.clear()
    axes.set_xlabel("the same, from the side [km]", fontsize=10, color=INK)
    axes.set_ylabel("height [km]", fontsize=10, color=INK)
    axes.tick_params(labelsize=9, colors=INK)
    axes.grid(True, color=GRID, linewidth=0.8)
    axes.set_axisbelow(True)
    low, high = 1e-3 * task.altitude_m[0]
    limit = 1e-3 * task.height_limit_m[0]
    axes.axhline(limit, **AREA)
    axes.fill_between(x_limits, low, high, color=BLUE, alpha=0.12, linewidth=0.0)
    axes.set_xlim(*x_limits)
    axes.set_ylim(-1.5, math.ceil(1.1 * max(limit, high, 1.0)))


def draw_sensors(axes: Axes, position_m: np.ndarray, ranging: np.ndarray, heights: bool, color: str = INK) -> None:
    """Draw and number sensors at positions [n, 3] m, seen from above or from the side."""
    for i, place in enumerate(1e-3 * position_m):
        x, y = place[0], place[2 if heights else 1]
        axes.plot([x], [y], marker=MARKERS[bool(ranging[i])], color=color, zorder=6, **SENSOR)
        axes.annotate(
            str(i + 1), (x, y), xytext=(7, 5), textcoords="offset points", fontsize=9, fontweight="bold", color=color,
            zorder=7, annotation_clip=True,
        )  # fmt: skip


def placement_instants(world: World, simulation: Simulation) -> list[Instant]:
    """What there is to see of a world (a batch of one): sensors placed, and once all are, the track by scans."""
    scenario, placed, history = simulation.scenario, int(world.step[0]), world.reports
    course = world.tape.targets[0, :, 0]
    words = f"{placed} of {scenario.steps} sensors placed"
    views = entry_views(world, scenario, placed, course[0], None)
    instants = [Instant(float(placed), words, views, errors_of(world.metrics, scenario.score), {})]
    if placed < scenario.steps:
        return instants
    unknown = np.full(len(course), np.nan)
    bounds = {"position": history.position_crlb_m[0], "range": unknown}
    for t, state in enumerate(course):
        kinds = dict.fromkeys((scenario.score, "range"))
        errors = {kind: (getattr(history, f"{kind}_error_m")[0, [t]], bounds[kind][[t]]) for kind in kinds}
        views = entry_views(world, scenario, placed, state, history.position[0, t])
        label = f"scan {t + 1} of {len(course)} (t = {t * scenario.step_s:g} s)"
        instants.append(Instant(float(placed + 1 + t), label, views, errors, {}))
    return instants


def entry_views(
    world: World, scenario: Any, installed: int, target: np.ndarray, estimate: np.ndarray | None, cov: Any = None
) -> tuple[View, View]:
    """Map and side view of sensors and a target that enters.

    Args:
        world: a batch of one.
        scenario: supplies kinds of sensors and scans.
        installed: how many sensors there are.
        target: [6] its state.
        estimate: [3] m, None for none; cov: [3, 3] m², None for none.
    """
    plan, side = (_entry_layers(world, scenario, installed, target, estimate, cov, axes) for axes in ((0, 1), (0, 2)))
    sensors = numbered("sensor", world.platforms.shape[1])
    names = {
        **dict.fromkeys(("platforms", "sensors without range"), sensors), "true targets": ("target",),
        "estimates": ("estimate",),
    }  # fmt: skip
    return (
        View("map", ("towards the expected entry [km]", "to the left [km]"), plan, names),
        View("side view", ("towards the expected entry [km]", "height [km]"), side, names, equal=False),
    )


def _entry_layers(world: World, scenario: Any, installed: int, target: Any, estimate: Any, cov: Any, axes: Any) -> Any:
    """Layers of the map (axes 0, 1) or the side view (axes 0, 2)."""
    pick, task = list(axes), world.tape.task.rows(slice(1))
    states = [*pick, *(3 + axis for axis in axes)]
    courses = representative_courses(task, scenario.scans, scenario.step_s)[0][:, [0, -1]][..., pick]
    there = (np.arange(world.platforms.shape[1]) < installed)[:, None]
    sensors = np.where(there, dart_rows(world.platforms[0][:, states]), np.nan)
    layers = {
        "expected courses": line_rows(courses)[None], "true targets": dart_rows(target[states])[None, None],
        "platforms": np.where(scenario.ranging[:, None], sensors, np.nan)[None],
    }  # fmt: skip
    if not scenario.ranging.all():
        layers["sensors without range"] = np.where(scenario.ranging[:, None], np.nan, sensors)[None, :, :2]
    if estimate is not None:
        layers["estimates"] = 1e-3 * estimate[None, None, pick]
    if estimate is not None and cov is not None:
        layers["2σ ellipses"] = ellipse_rows(estimate[pick], cov[np.ix_(pick, pick)])[None, None]
    if axes == (0, 1):
        return layers | {
            "where sensors may be": 1e-3 * area_corners(task)[None],
            "where the target enters": 1e-3 * entry_arc(task)[None],
        }
    corners = area_corners(task)[:, 0]
    limit = np.array([[corners.min(), task.height_limit_m[0]], [corners.max(), task.height_limit_m[0]]])
    return layers | {"where sensors may be": 1e-3 * limit[None]}


def _sensor_sample(ranging: bool, label: str) -> Line2D:
    return Line2D([], [], marker=MARKERS[ranging], color=INK, label=label, **SENSOR)
