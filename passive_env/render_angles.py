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
from passive_env.layers import (
    ELLIPSE_STD,
    PLAN,
    SENSOR_COLORS,
    Instant,
    View,
    circle_rows,
    clock,
    dart_rows,
    dot_rows,
    ellipse_rows,
    errors_of,
    line_rows,
)
from passive_env.palette import BLUE, GRID, INK, MUTED
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
        self._plan, self._side = (Projection(figure, box, scenario.stations) for box in (PLAN_BOX, SIDE_BOX))
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


class Projection:
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
        component = _bounding(axes)
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
        valid, weights, center = look.valid[s], look.weights[s], middle_of(look, s)
        reach = reach_deg(look, s, self._gate)
        self._axes.set_xlabel(f"azimuth off {'the return' if look.centers is None else 'prediction'} [°]")
        if look.centers is None:
            self._outline.set_data([], [])
        else:
            outline = np.degrees(ellipses(np.zeros(2), look.covs[s] * (self._gate / ELLIPSE_STD**2)))
            self._outline.set_data(*outline.T)
        self._returns.set_offsets(np.degrees(wrap(look.angles[s][valid] - center)))
        self._returns.set_sizes(12.0 + 130.0 * weights[valid])
        self._returns.set_color([_faded(self._color, weight) for weight in weights[valid]] or [self._color])
        direction = direction_of(truth, platforms[s])
        self._truth.set_data(*np.degrees(wrap(direction - center))[:, None])
        self._axes.set_xlim(-reach, reach)
        self._axes.set_ylim(-reach, reach)
        self._head.set_text(f"P{s}: {_seen(int(valid.sum()), weights.sum())}")


def middle_of(look: Look, s: int) -> np.ndarray:
    """The direction [2] rad about which a sensor's returns are shown: the predicted one, at first a return's."""
    if look.centers is not None:
        return look.centers[s]
    return look.angles[s][look.valid[s]][0] if look.valid[s].any() else np.zeros(2)


def reach_deg(look: Look, s: int, gate_size: float) -> float:
    """Half width [°] of axes that hold a sensor's gate; a diverged track's may be anything."""
    if look.covs is None:
        return 2.0
    variance = float(np.nan_to_num(gate_size * np.diagonal(look.covs[s]).max()))
    return 1.15 * min(max(math.degrees(math.sqrt(max(variance, 0.0))), 1e-3), 180.0)


def direction_of(truth: np.ndarray, platform: np.ndarray) -> np.ndarray:
    """Azimuth and elevation [2] rad of a target [6] as a platform [6] sees it."""
    d = truth[:3] - platform[:3]
    return np.array([math.atan2(d[1], d[0]), math.atan2(d[2], math.hypot(d[0], d[1]))])


def angle_instants(world: World, simulation: Simulation) -> list[Instant]:
    """What there is to see of a world (a batch of one) in space: plan, side view, what either sensor sees."""
    scenario, look = simulation.scenario, look_of(world, simulation)
    names = {
        "platforms": tuple(f"P{s}" for s in range(scenario.stations)), "true targets": ("target",),
        "estimates": ("estimate",),
    }  # fmt: skip
    plan, side = (_space_layers(world, look, scenario, axes) for axes in ((0, 1), (0, 2)))
    if scenario.standoff_m > 0.0:
        plan["stand-off rings"] = circle_rows(world.truth[0, :, :2], scenario.standoff_m)[:, None]
    views = (
        View("map", PLAN, plan, names),
        View("side view", ("east [km]", "altitude [km]"), side, names, equal=False),
        *(_direction_view(world, look, s, scenario) for s in range(scenario.stations)),
    )
    at, label = clock(int(world.step[0]), scenario)
    missed = world.reports.missed[0, 0]
    words = [f"target missed by P{s}" for s in range(len(missed))]
    errors = errors_of(world.metrics, scenario.score)
    return [Instant(at, label, views, errors, dict(zip(words, missed, strict=True)))]


def _space_layers(world: World, look: Look, scenario: Any, axes: tuple[int, int]) -> dict[str, np.ndarray]:
    """Plan or side view: platforms, target, track, gates' edges and returns."""
    pick = list(axes)
    states = [*pick, *(3 + axis for axis in axes)]
    mean, cov = world.estimate.mean[0][:, pick], world.estimate.cov[0][:, pick][:, :, pick]
    platforms, mean = world.platforms[0], np.where(np.isfinite(mean), mean, 0.0)
    length = 2.0 * float(np.linalg.norm(world.truth[0, 0, :2] - platforms[0, :2]))
    rays = np.where(look.valid[..., None, None], _lines(platforms, look.angles, length)[..., pick], np.nan)
    edges = _gate_edges(look, platforms, scenario.gate, length)
    layers = {
        "platforms": dart_rows(platforms[None][..., states]), "returns": line_rows(rays),
        "true targets": dart_rows(world.truth[0][:, None, states]), "estimates": 1e-3 * mean[:, None],
        "2σ ellipses": ellipse_rows(mean, cov)[:, None],
    }  # fmt: skip
    return layers if edges is None else layers | {"gates": line_rows(edges[:, _bounding(axes)][..., pick])}


def _direction_view(world: World, look: Look, s: int, scenario: Any) -> View:
    """Azimuth and elevation of a sensor's returns about the predicted direction, in the gate."""
    center = middle_of(look, s)
    offsets = np.degrees(wrap(look.angles[s] - center))
    weights = np.where(look.valid[s], np.maximum(look.weights[s], 0.002), 0.0)  # those without weight are seen too
    direction = np.degrees(wrap(direction_of(world.truth[0, 0], world.platforms[0, s]) - center))
    layers = {"returns by weight": _of_group(s, dot_rows(offsets, weights)), "true direction": direction[None, None]}
    if look.covs is not None:
        size = np.degrees(1.0) ** 2 * scenario.gate / ELLIPSE_STD**2
        layers["gate"] = _of_group(s, 1e3 * ellipse_rows(np.zeros(2), look.covs[s] * size)[None])
    axes = ("azimuth off prediction [°]", "elevation off prediction [°]")
    return View(f"what P{s} sees", axes, layers, reach=reach_deg(look, s, scenario.gate))


def _of_group(s: int, rows: np.ndarray) -> np.ndarray:
    """Rows [n, c] as those of group s: [s + 1, n, c], nothing in the groups before."""
    return np.concatenate([np.full((s, *rows.shape), np.nan), rows[None]])


def _bounding(axes: tuple[int, int]) -> int:
    """Azimuth bounds the plan, elevation the side view."""
    return 0 if axes[1] == 1 else 1


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
