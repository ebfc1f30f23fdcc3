"""Pictures of a passive radar's episode: the map with range-sum ellipses, and who was asked and answered over time.

The map is that of `passive_env.render` and shows besides every transmitter, filled where the receiver listens to it,
with a line by way of the track to the receiver where its echo came; the ellipse on which that echo puts the target
(in space its level section at the track's height); and in the plane the ghost, where the first two of them cross for
the second time. Below it stands a row per transmitter: answered, missed, still retuning, and in grey, which no one
knows, blocked.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from matplotlib.collections import LineCollection
from matplotlib.colors import ListedColormap, to_rgb
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from passive_env.artists import (
    Frame,
    bottom_legend,
    ellipses,
    grow,
    metres,
    name_tag,
    place_estimates,
    ring,
    set_limits,
    zone_samples,
)
from passive_env.core import Simulation, World
from passive_env.kinematics import plan_view
from passive_env.layers import PLAN, Instant, View, clock, errors_of, line_rows, numbered
from passive_env.palette import BLUE, GREEN, INK, MUTED, ORANGE, PURPLE, VERMILION
from passive_env.render import Scene, level_layers
from trackers.ellipse_intersection import intersect
from trackers.gaussian import Gaussian

MAP_BOX = (0.085, 0.36, 0.895, 0.585)
ROWS_BOX = (0.085, 0.15, 0.895, 0.155)
"""Left, bottom, width, height of the axes as shares of the picture."""
COLORS = {"answered": BLUE, "missed": VERMILION, "retuning": ORANGE}
"""Of the rows, in the order of their codes from 1 on; 0 is not listened to."""
BLOCKED = "#CFCFCF"
"""Colour of the time in which a transmitter is blocked."""
SITE: dict[str, Any] = {"linestyle": "none", "marker": "^", "markersize": 9.0, "color": INK, "zorder": 6}
GHOST: dict[str, Any] = {"linestyle": "none", "marker": "x", "markersize": 9.0, "color": PURPLE, "zorder": 5}
"""Styles of a transmitter and of the ghost."""


class RadarScene(Scene):
    """The artists of a picture, made once and moved from step to step.

    Args:
        figure: an empty figure.
        scenario: supplies the pool, the stand-off and the episode's length.
    """

    legend_columns = 4

    def __init__(self, figure: Figure, scenario: Any):
        super().__init__(figure, 1, 1, scenario.steps, scenario.standoff_m, MAP_BOX)
        self._moves, n = scenario.moves, scenario.pool
        self._in_plane, self._waits = scenario.dimensions == 2, scenario.retune_delay_s > 0.0
        self._station_names[0].set_text("receiver")
        self._sites = [self._axes.plot([], [], **SITE)[0] for _ in range(n)]
        self._site_names = [name_tag(self._axes, str(i + 1), INK) for i in range(n)]
        self._sums = LineCollection([], colors=GREEN, linewidths=0.9, alpha=0.8, zorder=2)
        self._axes.add_collection(self._sums)
        self._ghost = self._axes.plot([], [], **GHOST)[0]
        self._rows = figure.add_axes(ROWS_BOX)
        self._rows.set_xlabel("time [s]", fontsize=9, color=INK, labelpad=1)
        self._rows.set_ylabel("transmitter", fontsize=9, color=INK)
        self._rows.tick_params(labelsize=8, colors=INK)
        self._rows.set_yticks(range(1, n + 1))
        half, end = 0.5 * scenario.step_s, scenario.steps * scenario.step_s
        box = (-half, end + half, n + 0.5, 0.5)
        self._hidden = self._layer(np.zeros((n, scenario.steps + 1)), ["#FFFFFF", BLOCKED], box)
        self._told = self._layer(np.zeros((n, scenario.steps + 1)), ["#FFFFFF00", *COLORS.values()], box)
        self._codes, self._episode = np.zeros((n, scenario.steps + 1)), b""

    def update(self, world: World, trails: np.ndarray, frame: Frame, simulation: Simulation) -> None:
        """Show a world (a batch of one) with the receiver's trail [1, k, d] m inside a frame."""
        sites, heights = world.tape.transmitters[0, :, :2], world.estimate.mean[0, 0, 2:3]
        frame = grow(frame, 1e-3 * sites, self.aspect)
        level = _level(world)
        super().update(level, trails[..., :2], frame, simulation)
        if not self._moves:
            self._stations[0].set_marker("D")
            self._station_names[0].set(ha="center", va="top", position=(0, -9))
        height = float(heights[0]) if world.truth.shape[-1] == 6 else 0.0
        self._show_sites(level, sites, frame)
        self._show_sums(level, sites, height)
        self._show_rows(world)

    def pixels(self) -> np.ndarray:
        """RGB uint8 [h, w, 3]."""
        canvas: Any = self._figure.canvas
        canvas.draw()
        return np.array(np.asarray(canvas.buffer_rgba())[..., :3])

    def _layer(self, values: np.ndarray, colors: list[str], box: tuple[float, float, float, float]) -> Any:
        return self._rows.imshow(
            values, cmap=ListedColormap(colors), vmin=0, vmax=len(colors) - 1, aspect="auto", interpolation="nearest",
            extent=box,
        )  # fmt: skip

    def _show_axes(self, frame: Frame, hypotheses: bool, world: World) -> None:
        if self._shown == (*frame.low, *frame.high):
            return
        self._shown = (*frame.low, *frame.high)
        set_limits(self._axes, frame)
        bottom_legend(self._figure, self._samples(), columns=self.legend_columns)

    def _samples(self) -> list[Any]:
        told = [
            Patch(facecolor=to_rgb(color), label=name)
            for name, color in COLORS.items()
            if self._waits or name != "retuning"
        ]
        ghost = Line2D([], [], **GHOST, label="ghost of two of them")
        return [
            Line2D([], [], **SITE, label="transmitter listened to"),
            Line2D([], [], **{**SITE, "markerfacecolor": "white"}, label="another one"),
            Line2D([], [], color=BLUE, linewidth=2.0, label="true path"),
            Line2D([], [], **ring(MUTED, 9.0), label="estimate, its 2σ ellipse"),
            Line2D([], [], color=GREEN, linewidth=0.9, label="range sum"),
            *([ghost] if self._in_plane else []), *told, Patch(facecolor=BLOCKED, label="blocked (the truth)"),
            *zone_samples(False, self._standoff_m > 0.0),
        ]  # fmt: skip

    def _show_sites(self, world: World, sites: np.ndarray, frame: Frame) -> None:
        for i, (line, name) in enumerate(zip(self._sites, self._site_names, strict=True)):
            line.set_data(*(1e-3 * sites[i, :, None]))
            line.set_markerfacecolor(INK if world.reports.listening.chosen[0, i] else "white")
            name.xy = 1e-3 * sites[i]

    def _show_tracks(self, world: World, frame: Frame) -> None:
        """The estimate with its ellipse, and the ways of the echoes that came: no station is assigned here."""
        mean, own = world.estimate.mean[0, :, :2], world.platforms[0, 0, :2]
        self._ellipses.set_verts(list(1e-3 * ellipses(mean, world.estimate.cov[0, :, :2, :2])))
        place_estimates(self._estimates, self._off_frame, own, mean, frame)
        self._bearings.set_segments(list(1e-3 * echo_ways(world)))

    def _show_sums(self, world: World, sites: np.ndarray, height: float) -> None:
        """Ellipses of the echoes that came, and the ghost where two of them cross again."""
        scan, own = world.reports.scan, world.platforms[0, 0, :2]
        came = scan.valid[0]
        outlines = [
            sum_ellipse(s, own, site, height) for s, site in zip(scan.range_sums[0, came], sites[came], strict=True)
        ]
        self._sums.set_segments([1e-3 * outline for outline in outlines])
        self._ghost.set_data(*(1e-3 * ghost_of(world).T) if self._in_plane else ([], []))

    def _show_rows(self, world: World) -> None:
        step, told = int(world.step[0]), world.reports.listening
        episode = world.tape.guess[0].tobytes()
        if episode != self._episode:
            self._codes[:] = 0.0
        self._episode = episode
        waits = told.chosen[0] & ~told.answered[0] & ~told.missed[0]
        self._codes[:, step:] = 0.0
        self._codes[:, step] = told.answered[0] + 2.0 * told.missed[0] + 3.0 * waits
        known = np.arange(self._codes.shape[1]) <= step
        self._told.set_data(self._codes)
        self._hidden.set_data(world.tape.blocked[0].T & known)

    def _merit_of(self, world: World) -> str:
        error, bound = world.metrics.horizontal_error_m[0, 0], world.metrics.horizontal_crlb_m[0, 0]
        return f"horizontal error {metres(error)},  1σ bound {metres(bound)}"


def sum_ellipse(range_sum_m: float, receiver: np.ndarray, transmitter: np.ndarray, height: float = 0.0) -> np.ndarray:
    """Level outline [k, 2] m of the points of a range sum, at a height [m] above two sites [2] m; one point if none."""
    middle, *half = sum_axes(range_sum_m, receiver, transmitter, height)
    angle = np.linspace(0.0, 2.0 * math.pi, 181)[:, None]
    return middle + np.cos(angle) * half[0] + np.sin(angle) * half[1]


def sum_axes(range_sum_m: float, receiver: np.ndarray, transmitter: np.ndarray, height: float = 0.0) -> np.ndarray:
    """Middle and half axes of the same ellipse: [3, 2] m."""
    middle, line = 0.5 * (receiver + transmitter), 0.5 * (transmitter - receiver)
    focal = max(math.hypot(*line), 1e-9)
    major = max(0.5 * range_sum_m, focal)
    minor = math.sqrt(major * major - focal * focal)
    scale = math.sqrt(max(1.0 - (height / minor) ** 2, 0.0)) if minor > 0.0 else 1.0
    along = line / focal
    left = np.array([-along[1], along[0]])
    return np.stack([middle, scale * major * along, scale * minor * left])


def echo_ways(world: World) -> np.ndarray:
    """Ways [n, 3, 2] m of the last echoes (a batch of one): transmitter, estimate, receiver."""
    sites = world.tape.transmitters[0, world.reports.listening.answered[0], :2]
    ends = np.broadcast_to([world.estimate.mean[0, 0, :2], world.platforms[0, 0, :2]], (len(sites), 2, 2))
    return np.concatenate([sites[:, None], ends], axis=1)


def ghost_of(world: World) -> np.ndarray:
    """Where the first two echoes' ellipses cross once more, off the estimate: [1, 2] m in the plane, or [0, 2]."""
    scan = world.reports.scan
    came = np.flatnonzero(scan.valid[0])[:2]
    if len(came) < 2:
        return np.empty((0, 2))
    sites = world.tape.transmitters[0, came, :2]
    crossings = intersect(scan.range_sums[0, came], sites, world.platforms[0, 0, :2])
    away = np.hypot(*(crossings.position - world.estimate.mean[0, 0, :2]).T)
    return crossings.position[[away.argmax()]] if crossings.valid.all() else np.empty((0, 2))


def radar_instants(world: World, simulation: Simulation) -> list[Instant]:
    """What there is to see of a world (a batch of one) of a passive radar."""
    scenario, known = simulation.scenario, world.reports.listening
    layers = level_layers(_level(world), scenario.standoff_m) | _radar_layers(world, scenario.dimensions)
    names = {
        "platforms": ("receiver",), "true targets": ("target",), "estimates": ("estimate",),
        **dict.fromkeys(("transmitters", "other transmitters"), numbered("transmitter", scenario.pool)),
    }  # fmt: skip
    at, label = clock(int(world.step[0]), scenario)
    blocked = dict(zip(numbered("blocked transmitter", scenario.pool), known.blocked_probability[0], strict=True))
    errors = errors_of(world.metrics, scenario.score)
    return [Instant(at, label, (View("map", PLAN, layers, names),), errors, blocked)]


def _radar_layers(world: World, dimensions: int) -> dict[str, np.ndarray]:
    """Transmitters, those listened to, those blocked and those whose echo did not come; echoes and their range sums."""
    known, scan = world.reports.listening, world.reports.scan
    sites, own = world.tape.transmitters[0, :, :2], world.platforms[0, 0, :2]
    height = float(world.estimate.mean[0, 0, 2]) if dimensions == 3 else 0.0
    came = scan.valid[0]
    sums = [sum_axes(s, own, site, height) for s, site in zip(scan.range_sums[0, came], sites[came], strict=True)]
    ways = echo_ways(world)
    ghost = ghost_of(world) if dimensions == 2 else np.empty((0, 2))

    def only(flags: np.ndarray) -> np.ndarray:
        return np.where(flags[:, None], 1e-3 * sites, np.nan)[None]

    return {
        "transmitters": only(known.chosen[0]), "other transmitters": only(~known.chosen[0]),
        "echo missed": only(known.missed[0]), "blocked (the truth)": only(world.reports.blocked[0]),
        "range sums": 1e-3 * np.reshape(sums, (1, len(sums), 6)), "ghost": 1e-3 * ghost[None],
        "echoes": line_rows(np.concatenate([ways[:, :2], ways[:, 1:]]))[None],
    }  # fmt: skip


def _level(world: World) -> World:
    """The world seen from above."""
    if world.truth.shape[-1] == 4:
        return world
    mean = np.ascontiguousarray(plan_view(world.estimate.mean))
    estimate = Gaussian(mean, world.estimate.cov)
    return world._replace(platforms=plan_view(world.platforms), truth=plan_view(world.truth), estimate=estimate)
