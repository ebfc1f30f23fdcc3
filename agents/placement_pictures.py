"""Maps of a placement: what the last sensor would be worth elsewhere, for every policy's own earlier sensors."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter

from agents.pictures import DPI, axes_at
from agents.placement import Promise, commands_of
from passive_env.core import World
from passive_env.palette import INK, VERMILION
from passive_env.placement import Task, positions
from passive_env.render_placement import draw_area, draw_heights, draw_sensors

COLUMN_IN, MAP_IN, HEIGHTS_IN, BAR_IN, PER_ROW = 3.4, 3.2, 1.0, 1.0, 4
AZIMUTHS, DISTANCES, HEIGHTS = 41, 7, 9
"""Points of the maps along each axis."""
PAPER: dict[str, Any] = {"marker": "x", "color": VERMILION, "markersize": 9, "markeredgewidth": 2.0, "zorder": 8}


def placement_maps(worlds: Mapping[str, World], scenario: Any, title: str) -> Figure:
    """A map and its heights per policy: promised error over the place of the last sensor, the earlier ones given.

    The map varies azimuth and distance at the height chosen, the diagram below azimuth and height at the distance
    chosen. The sensors are numbered; a cross is where the paper puts the last one, if "paper" is among the policies.

    Args:
        worlds: per policy, an episode's last world (a batch of one), all with the same task.
        scenario: they come from.
        title: of the figure.
    """
    figure, panels = _sheet(len(worlds), title)
    draw = _Drawing(worlds, scenario)
    for name, (above, side) in zip(worlds, panels, strict=True):
        shown = draw(name, above, side)
    _color_bar(figure, shown)
    return figure


def placement_cards(worlds: Mapping[str, World], scenario: Any) -> dict[str, Figure]:
    """The same as a figure per policy, all in the same colours; arguments as there."""
    draw, cards = _Drawing(worlds, scenario), {}
    for name in worlds:
        cards[name], (panel,) = _sheet(1, "", beside=0.25, head=0.35)
        _color_bar(cards[name], draw(name, *panel))
    return cards


class _Drawing:
    """Draws one policy's map and heights after another, in the colours that all share."""

    def __init__(self, worlds: Mapping[str, World], scenario: Any):
        promise = Promise(scenario)
        self._worlds, self._scenario = worlds, scenario
        self._maps = {name: _promised(promise, world) for name, world in worlds.items()}
        everywhere = np.concatenate([part.ravel() for pair in self._maps.values() for _, part in pair])
        self._norm = LogNorm(everywhere.min(), max(everywhere.max(), 1.001 * everywhere.min()))
        self._paper = worlds["paper"].platforms[0, -1, :3] if "paper" in worlds else None

    def __call__(self, name: str, above: Axes, side: Axes) -> Any:
        """Returns what the colour bar is of."""
        world = self._worlds[name]
        shown = _draw(above, side, world, self._maps[name], self._norm, self._scenario, self._paper)
        above.set_title(f"{name}: {world.metrics.position_crlb_m[0, 0]:.0f} m", loc="left", fontsize=10, color=INK)
        return shown


def _color_bar(figure: Figure, shown: Any) -> None:
    width, height = figure.get_size_inches()
    bar = figure.colorbar(shown, cax=axes_at(figure, width - BAR_IN, 0.25 * height, 0.18, 0.5 * height))
    for axis in ("major", "minor"):
        getattr(bar.ax.yaxis, f"set_{axis}_formatter")(FuncFormatter(lambda value, _: f"{value:.0f}"))
    bar.set_label("promised position error at the last scan, 1σ [m]", fontsize=9, color=INK)


def _promised(promise: Promise, world: World) -> tuple[tuple[np.ndarray, np.ndarray], ...]:
    """Places [a, d, 3] m and promised errors [a, d] m of the last sensor over azimuth and distance; the same of height.

    Args:
        promise: of layouts.
        world: a batch of one.
    """
    task = world.tape.task
    chosen = commands_of(world.platforms[..., :3], task)[0]
    azimuth = np.linspace(-1.0, 1.0, AZIMUTHS)
    parts = []
    for axis, count in ((1, DISTANCES), (2, HEIGHTS)):
        last = np.tile(chosen[-1], (AZIMUTHS, count, 1))
        last[..., 0], last[..., axis] = azimuth[:, None], np.linspace(-1.0, 1.0, count)
        before = np.broadcast_to(chosen[:-1], (last[..., 0].size, len(chosen) - 1, 3))
        layouts = np.concatenate([before, last.reshape(-1, 1, 3)], axis=1)
        parts.append((positions(last[None], task)[0], np.exp(promise(task, layouts[None])[0]).reshape(last.shape[:2])))
    return tuple(parts)


def _draw(above: Axes, side: Axes, world: World, maps: Any, norm: Any, scenario: Any, paper: Any) -> Any:
    """One policy's map and diagram; returns what the colour bar is of."""
    task = world.tape.task.rows(slice(1))
    draw_area(above, task, scenario)
    (places, errors), (_, by_height) = maps
    shown = above.pcolormesh(
        1e-3 * places[..., 0], 1e-3 * places[..., 1], errors, norm=norm, shading="gouraud", zorder=1
    )
    limit = math.degrees(task.azimuth_limit_rad[0])
    draw_heights(side, task, (-limit, limit) if limit > 0.0 else (-1.0, 1.0))
    side.set_xlabel("azimuth at the expected entry [°]", fontsize=9, color=INK)
    grid = np.linspace(-limit, limit, AZIMUTHS), np.linspace(0.0, 1e-3 * task.height_limit_m[0], HEIGHTS)
    side.pcolormesh(*grid, by_height.T, norm=norm, shading="gouraud", zorder=1)
    sensors = world.platforms[0, :, :3]
    draw_sensors(above, sensors, scenario.ranging, heights=False)
    draw_sensors(side, _by_azimuth(sensors, task), scenario.ranging, heights=True)
    if paper is not None:
        above.plot(*(1e-3 * paper[:2]), **PAPER)
        side.plot(*(1e-3 * _by_azimuth(paper[None], task)[0, [0, 2]]), **PAPER)
    return shown


def _by_azimuth(position: np.ndarray, task: Task) -> np.ndarray:
    """Positions [n, 3] m with a thousand times the azimuth [°] instead of x, as the diagram's axis has it."""
    turned = np.array(position)
    x = task.entry_distance_m[0] - position[:, 0]
    turned[:, 0] = 1e3 * np.degrees(np.arctan2(-position[:, 1], x))
    return turned


def _sheet(count: int, title: str, beside: float = 0.7, head: float = 0.8) -> tuple[Figure, list[tuple[Axes, Axes]]]:
    """A figure with two axes per policy, laid out in inches: room beside each, and above them all for the title."""
    columns = min(count, PER_ROW)
    rows = math.ceil(count / columns)
    below = 0.55 + HEIGHTS_IN + 0.75
    width, height = 0.8 + columns * (COLUMN_IN + beside) + BAR_IN, head + rows * (MAP_IN + below + 0.3) - 0.3
    figure = Figure(figsize=(width, height), dpi=DPI)
    figure.suptitle(title, x=0.02, ha="left", fontsize=12, color=INK)
    panels = []
    for i in range(count):
        row, column = divmod(i, columns)
        x, top = 0.8 + column * (COLUMN_IN + beside), height - head - row * (MAP_IN + below + 0.3)
        above = axes_at(figure, x, top - MAP_IN, COLUMN_IN, MAP_IN)
        side = axes_at(figure, x, top - MAP_IN - 0.55 - HEIGHTS_IN, COLUMN_IN, HEIGHTS_IN)
        panels.append((above, side))
    return figure, panels
