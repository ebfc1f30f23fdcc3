"""Pictures of an episode in space: plan and side view, and the returns of either sensor beside its gate.

Plan (east-north) and side view (east-altitude) hold the platforms with their trails in black, the target's true path
and dart, the estimate (ring) with its 2σ ellipse, the stand-off circle (dashed), the edges of the gates in which the
sensors searched (dotted) and the returns as lines of sight, stronger with association weight. The panels beside them
show azimuth and elevation of the returns about the predicted direction, the gate, and weights as the dots' areas.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from matplotlib.collections import LineCollection
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from passive_env.artists import (
    ELLIPSE_STD,
    RING_LINE,
    Frame,
    add_ellipses,
    add_lines,
    bottom_legend,
    circles,
    ellipses,
    kilometres,
    marker,
    name_tag,
    place_dart,
    place_estimates,
    place_name,
    ring,
    set_limits,
    style_axes,
)
from passive_env.core import Simulation, World
from passive_env.palette import BLUE, GRID, INK, MUTED, ORANGE, VERMILION
from trackers import AnglePdaf
from trackers.angle_contract import AngleScan
from trackers.angle_filter import AngleFilter
from trackers.angles import wrap
from trackers.direction import gate
from trackers.gaussian import Gaussian
from trackers.pair_weights import return_weights

PLAN_BOX = (0.085, 0.40, 0.58, 0.54)
SIDE_BOX = (0.085, 0.14, 0.58, 0.18)
SENSOR_BOXES = ((0.735, 0.665, 0.245, 0.245), (0.735, 0.315, 0.245, 0.245))
"""Left, bottom, width, height of the axes as shares of the picture."""
SENSOR_COLORS = (VERMILION, ORANGE)
"""Returns and gates of platform 0 and 1; the target and its track are blue."""
Box = tuple[float, float, float, float]
FARTHEST_ALTITUDE_KM = 30.0
"""An estimate farther up or down does not stretch the side view."""
FAINTEST = 0.12
"""Opacity of a return without weight."""


class Look(NamedTuple):
    """One scan of one environment.

    Attributes:
        angles: [s, b, 2] rad; valid: [s, b] bool; weights: [s, b] association weights.
        centers: [s, 2] rad predicted directions; covs: [s, 2, 2] rad², innovation covariances; None at the first scan,
            which nothing predicted.
    """

    angles: Any
    valid: Any
    weights: Any
    centers: Any
    covs: Any


def look_of(world: World, simulation: Simulation) -> Look:
    """The last scan of a world (a batch of one): returns, their weights and the gates they were sought in.

    Weights are those of the pairwise PDAF; of any other tracker's scan the likeliest returns have weight 1.
    """
    reports, tracker = world.reports, simulation.tracker
    scan = AngleScan(*(part[0] for part in reports.scan))
    predicted = Gaussian(reports.predicted.mean[0, 0], reports.predicted.cov[0, 0])
    weights = (np.arange(scan.valid.shape[1]) == reports.slots[0, 0][:, None]).astype(float)
    if not (predicted.cov.any() and np.isfinite(predicted.mean).all() and np.isfinite(predicted.cov).all()):
        return Look(scan.angles, scan.valid, weights, None, None)
    if isinstance(tracker, AngleFilter):
        scan = tracker.around(predicted, scan)
    if type(tracker) is AnglePdaf:
        weights = return_weights(predicted, scan, tracker)
    sought = gate(predicted.mean, predicted.cov, scan.platforms, scan.angle_std, 1.0)
    return Look(scan.angles, scan.valid, weights, sought.angles, sought.cov)


class AngleScene:
    """The artists of a picture, made once and moved from step to step.

    Args:
        figure: an empty figure.
        scenario: supplies gate, stand-off and the episode's length.
    """

    def __init__(self, figure: Figure, scenario: Any):
        self._figure, self._scenario = figure, scenario
        self.aspect = PLAN_BOX[2] / PLAN_BOX[3]
        self._plan, self._side = (View(figure, box, scenario.stations) for box in (PLAN_BOX, SIDE_BOX))
        style_axes(self._plan.axes)
        style_axes(self._side.axes)
        self._side.axes.set_aspect("auto")
        self._side.axes.set_ylabel("altitude [km]", fontsize=10, color=INK)
        self._panels = [
            Panel(figure, box, s, scenario.gate, SENSOR_COLORS[s]) for s, box in enumerate(SENSOR_BOXES)
        ]  # fmt: skip
        self._title = figure.text(PLAN_BOX[0], 0.955, "", fontsize=11, color=INK)
        bottom_legend(figure, _samples(scenario.standoff_m > 0.0), columns=4)

    def update(self, world: World, trails: np.ndarray, frame: Frame, simulation: Simulation) -> None:
        """Show a world (a batch of one) with the platforms' trails [s, k, 3] m; the frame is the plan's."""
        step, look = int(world.step[0]), look_of(world, simulation)
        course = world.tape.targets[0, : step + 1, 0]
        low, high = _altitudes(trails, course, world.estimate.mean[0, 0, 2], world.estimate.cov[0, 0, 2, 2])
        radius, size = self._scenario.standoff_m, float(np.linalg.norm(frame.high - frame.low)) * 1e3
        rays = _lines(world.platforms[0], look.angles, size)
        edges = _gate_edges(look, world.platforms[0], self._scenario.gate, size)
        for view, frame_, axes in (
            (self._plan, frame, (0, 1)),
            (self._side, Frame(np.array([frame.low[0], low]), np.array([frame.high[0], high])), (0, 2)),
        ):
            view.show(world, trails, course, frame_, axes, radius)
            view.show_looks(look, rays, edges, axes)
        for panel in self._panels:
            panel.show(look, world.truth[0, 0], world.platforms[0])
        m = world.metrics
        self._title.set_text(
            f"t = {step * self._scenario.step_s:g} s   (step {step} of {self._scenario.steps})    position error "
            f"{kilometres(m.position_error_m[0, 0])},  1σ bound {kilometres(m.position_crlb_m[0, 0])}"
        )

    def pixels(self) -> np.ndarray:
        """RGB uint8 [h, w, 3]."""
        canvas: Any = self._figure.canvas
        canvas.draw()
        return np.array(np.asarray(canvas.buffer_rgba())[..., :3])


class View:
    """Plan or side view."""

    def __init__(self, figure: Figure, box: Box, platforms: int):
        self.axes = axes = figure.add_axes(box)
        self._edges = LineCollection([], linewidths=0.9, linestyles=":", zorder=2)
        self._rays = LineCollection([], linewidths=0.9, zorder=2)
        for lines in (self._edges, self._rays):
            axes.add_collection(lines)
        self._standoff = add_lines(axes, [BLUE], 1.2, alpha=0.8)
        self._standoff.set_linestyle(RING_LINE)
        self._trails = add_lines(axes, [INK], 1.4, alpha=0.75)
        self._course = add_lines(axes, [BLUE], 2.0)
        self._ellipse = add_ellipses(axes, [BLUE])
        self._platforms = [axes.plot([], [], **marker(INK))[0] for _ in range(platforms)]
        self._names = [name_tag(axes, f"P{s}", INK) for s in range(platforms)]
        self._target = axes.plot([], [], **marker(BLUE))[0]
        self._estimate = [axes.plot([], [], **ring(BLUE))[0]]
        self._off_frame = [name_tag(axes, "", BLUE)]

    def show(
        self, world: World, trails: Any, course: Any, frame: Frame, axes: tuple[int, int], radius_m: float
    ) -> None:
        """Platforms, target and track, projected onto two of the three axes."""
        pick = list(axes)
        states = [*pick, *(3 + axis for axis in axes)]
        set_limits(self.axes, frame)
        self._trails.set_segments(list(1e-3 * trails[..., pick]))
        self._course.set_segments([1e-3 * course[:, pick]])
        platforms, truth = world.platforms[0][:, states], world.truth[0, 0, states]
        for state, line, name in zip(platforms, self._platforms, self._names, strict=True):
            place_dart(line, state)
            place_name(name, state, platforms[:, :2].mean(0), frame)
        place_dart(self._target, truth)
        mean, cov = world.estimate.mean[0, :, :3], world.estimate.cov[0, :, :3, :3]
        shown = np.where(np.isfinite(mean), mean, 0.0)[:, pick]
        self._ellipse.set_verts(list(1e-3 * ellipses(shown, cov[:, pick][:, :, pick])))
        place_estimates(self._estimate, self._off_frame, platforms[0, :2], shown, frame)
        rings = circles(truth[:2], radius_m)[None] if radius_m > 0.0 else np.empty((0, 65, 2))
        self._standoff.set_segments(list(1e-3 * rings))

    def show_looks(self, look: Look, rays: Any, edges: Any, axes: tuple[int, int]) -> None:
        """Returns as lines of sight [s, b, 2, 3] m, gates' edges [s, 2, 2, 2, 3] m or None."""
        pick = list(axes)
        segments, colors = [], []
        for s, color in enumerate(SENSOR_COLORS):
            for line, weight in zip(rays[s][look.valid[s]], look.weights[s][look.valid[s]], strict=True):
                segments.append(1e-3 * line[:, pick])
                colors.append(_faded(color, weight))
        self._rays.set_segments(segments)
        self._rays.set_color(colors)
        component = 0 if axes[1] == 1 else 1  # azimuth bounds the plan, elevation the side view
        bounds = [] if edges is None else [1e-3 * edge[:, pick] for s in range(2) for edge in edges[s, component]]
        self._edges.set_segments(bounds)
        self._edges.set_color([color for color in SENSOR_COLORS for _ in range(2)][: len(bounds)])


class Panel:
    """Azimuth and elevation of one sensor's returns about the predicted direction."""

    def __init__(self, figure: Figure, box: Box, sensor: int, gate_size: float, color: str):
        self._sensor, self._gate, self._color = sensor, gate_size, color
        self._axes = axes = figure.add_axes(box)
        axes.tick_params(labelsize=8, colors=INK)
        axes.grid(True, color=GRID, linewidth=0.8)
        axes.set_axisbelow(True)
        axes.set_xlabel("", fontsize=8, color=INK, labelpad=1)
        axes.set_ylabel("elevation [°]", fontsize=8, color=INK, labelpad=0)
        self._outline = axes.plot([], [], color=color, linestyle=":", linewidth=1.2)[0]
        self._returns = axes.scatter([], [], zorder=4)
        self._truth = axes.plot([], [], marker="+", markersize=9, color=BLUE, linestyle="none", zorder=5)[0]
        self._head = axes.set_title("", fontsize=9, color=INK, loc="left")

    def show(self, look: Look, truth: Any, platforms: Any) -> None:
        """Gate, returns and the target's true direction, all about the prediction (at first, the return)."""
        s = self._sensor
        valid, weights = look.valid[s], look.weights[s]
        if look.centers is None:
            center, reach = (look.angles[s][valid][0] if valid.any() else np.zeros(2)), 2.0
            self._outline.set_data([], [])
            self._axes.set_xlabel("azimuth off the return [°]")
        else:
            center = look.centers[s]
            self._axes.set_xlabel("azimuth off prediction [°]")
            reach = 1.15 * np.degrees(math.sqrt(self._gate * np.diagonal(look.covs[s]).max()))
            outline = np.degrees(ellipses(np.zeros(2), look.covs[s] * (self._gate / ELLIPSE_STD**2)))
            self._outline.set_data(*outline.T)
        offsets = np.degrees(wrap(look.angles[s][valid] - center))
        self._returns.set_offsets(offsets)
        self._returns.set_sizes(12.0 + 130.0 * weights[valid])
        self._returns.set_color([_faded(self._color, weight) for weight in weights[valid]] or [self._color])
        d = truth[:3] - platforms[s, :3]
        direction = np.array([math.atan2(d[1], d[0]), math.atan2(d[2], math.hypot(d[0], d[1]))])
        self._truth.set_data(*np.degrees(wrap(direction - center))[:, None])
        self._axes.set_xlim(-reach, reach)
        self._axes.set_ylim(-reach, reach)
        self._head.set_text(f"P{s}: {_seen(int(valid.sum()), weights.sum())}")


def _seen(returns: int, weight: float) -> str:
    """Head of a panel: number of returns, and the probability that none of them is the target's."""
    if not returns:
        return "nothing received"
    return f"{returns} return{'s' if returns > 1 else ''}, missed {abs(round(1.0 - weight, 2)):.2f}"


def _faded(color: str, weight: float) -> tuple[str, float]:
    return color, float(np.clip(FAINTEST + (1.0 - FAINTEST) * weight, 0.0, 1.0))


def _altitudes(trails: Any, course: Any, estimate_m: float, variance_m2: float) -> tuple[float, float]:
    """Limits [km] of the side view: platforms, target and, unless far off, the estimate's ellipse."""
    values = 1e-3 * np.concatenate([trails[..., 2].ravel(), course[:, 2]])
    reach = 1e-3 * ELLIPSE_STD * math.sqrt(max(variance_m2, 0.0)) if math.isfinite(variance_m2) else 0.0
    for end in (1e-3 * estimate_m - reach, 1e-3 * estimate_m + reach):
        if abs(end) < FARTHEST_ALTITUDE_KM:  # NaN compares False
            values = np.append(values, end)
    return min(values.min() - 1.0, 0.0), max(values.max() + 1.0, 10.0)


def _lines(platforms: Any, angles: Any, length_m: float) -> np.ndarray:
    """Segments [s, ..., 2, 3] m from platforms [s, 6] along directions [s, ..., 2] rad."""
    level = np.cos(angles[..., 1])
    way = np.stack([level * np.cos(angles[..., 0]), level * np.sin(angles[..., 0]), np.sin(angles[..., 1])], axis=-1)
    start = platforms[:, :3].reshape(len(platforms), *[1] * (way.ndim - 2), 3)
    return np.stack(np.broadcast_arrays(start, start + length_m * way), axis=-2)


def _gate_edges(look: Look, platforms: Any, gate_size: float, length_m: float) -> np.ndarray | None:
    """Lines [s, component, side, 2, 3] m along the largest and smallest azimuth and elevation of every gate."""
    if look.centers is None:
        return None
    half = np.sqrt(gate_size * np.diagonal(look.covs, axis1=-2, axis2=-1))
    shift = half[:, :, None, None] * np.eye(2)[:, None] * np.array([1.0, -1.0])[:, None]
    return _lines(platforms, look.centers[:, None, None] + shift, length_m)


def _samples(standoff: bool) -> list[Any]:
    dart = Line2D([], [], color=INK, linewidth=1.4, marker="^", markersize=8, label="platform, trail")
    target = Line2D([], [], color=BLUE, linewidth=2.0, marker="^", markersize=8, label="true target, path")
    samples: list[Any] = [
        dart, target,
        Line2D([], [], **ring(BLUE, 9.0), label="estimate"),
        Patch(facecolor=(*to_rgb(BLUE), 0.16), edgecolor=BLUE, linewidth=0.9, label="its 2σ ellipse"),
        Line2D([], [], color=MUTED, linewidth=0.9, label="return, by weight"),
        Line2D([], [], color=MUTED, linewidth=0.9, linestyle=":", label="gate"),
        Line2D([], [], color=BLUE, marker="+", linestyle="none", label="true direction"),
    ]  # fmt: skip
    ring_line = Line2D([], [], color=BLUE, linewidth=1.2, linestyle=RING_LINE, label="stand-off")
    return [*samples, ring_line] if standoff else samples
