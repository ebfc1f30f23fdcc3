"""Pictures of an episode with a maneuvering target: the view from above, accelerations, model probabilities.

The view is that of `passive_env.render` and shows besides the scan's position fix with its 2σ ellipse. Of the panels
beside it one shows the true acceleration (line from the middle) and its estimate (ring), the other the probability of
every model, filled where the model finds the target maneuvering.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from matplotlib.collections import PolyCollection
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from passive_env.artists import Frame, ellipses, metres, ring
from passive_env.core import Simulation, World
from passive_env.layers import PLAN, Instant, View, clock, ellipse_rows, errors_of, line_rows, numbered
from passive_env.palette import BLUE, GRID, INK, VERMILION
from passive_env.render import Scene, bearing_lines, level_layers, plane_names

PLAN_BOX = (0.085, 0.175, 0.60, 0.745)
ACCELERATION_BOX = (0.76, 0.63, 0.22, 0.22)
MODEL_BOX = (0.76, 0.24, 0.22, 0.22)
"""Left, bottom, width, height of the axes as shares of the picture."""
REACH_M_S2 = 40.0
"""Half the width of the panel of accelerations, unless one is larger."""
FIX: dict[str, Any] = {"linestyle": "none", "marker": "x", "markersize": 7.0, "color": VERMILION, "zorder": 5}
"""Style of a position fix."""


class ManeuverScene(Scene):
    """The artists of a picture, made once and moved from step to step.

    Args:
        figure: an empty figure.
        scenario: supplies the number of stations, the stand-off and the episode's length.
    """

    legend_columns = 3

    def __init__(self, figure: Figure, scenario: Any):
        super().__init__(figure, scenario.stations, 1, scenario.steps, scenario.standoff_m, PLAN_BOX)
        self._merit.xy = (0.0, 1.0)
        self._merit.set(ha="left", position=(0, 24))  # a line of its own above the clock
        self._fix = self._axes.plot([], [], **FIX)[0]
        self._fix_ellipse = PolyCollection(
            [], facecolors="none", edgecolors=VERMILION, linewidths=0.9, linestyles=":", zorder=3
        )
        self._axes.add_collection(self._fix_ellipse)
        self._vectors = _panel(figure, ACCELERATION_BOX, "acceleration [m/s²]")
        self._vectors.set_aspect("equal", adjustable="box")
        self._true_acceleration = self._vectors.plot([], [], color=BLUE, linewidth=2.0)[0]
        self._acceleration = self._vectors.plot([], [], **ring(BLUE, 9.0))[0]
        self._models = _panel(figure, MODEL_BOX, "model probability")
        self._models.set_ylim(0.0, 1.0)
        self._bars: Any = None

    def update(self, world: World, trails: np.ndarray, frame: Frame, simulation: Simulation) -> None:
        """Show a world (a batch of one) with the stations' trails [s, k, 2] m inside a frame."""
        super().update(world, trails, frame, simulation)
        told = world.reports
        shown = told.fix.position[told.fix.fixed]
        self._fix.set_data(*(1e-3 * shown.T))
        self._fix_ellipse.set_verts(list(1e-3 * ellipses(shown, told.fix.cov[told.fix.fixed])))
        self._show_accelerations(told.true_acceleration[0, 0], told.acceleration[0, 0])
        self._show_models(told.model_probability[0, 0], told.detected[0, 0])

    def pixels(self) -> np.ndarray:
        """RGB uint8 [h, w, 3]."""
        canvas: Any = self._figure.canvas
        canvas.draw()
        return np.array(np.asarray(canvas.buffer_rgba())[..., :3])

    def _show_accelerations(self, true: np.ndarray, estimate: np.ndarray) -> None:
        seen = np.where(np.isfinite(estimate), estimate, 0.0)
        reach = _reach(true, estimate)
        self._true_acceleration.set_data([0.0, true[0]], [0.0, true[1]])
        self._acceleration.set_data(seen[:1], seen[1:])
        self._vectors.set_xlim(-reach, reach)
        self._vectors.set_ylim(-reach, reach)

    def _show_models(self, probability: np.ndarray, detected: np.ndarray) -> None:
        if self._bars is None:
            names = [str(r + 1) for r in range(len(probability))]
            self._bars = self._models.bar(names, probability, edgecolor=BLUE, linewidth=1.2)
        for bar, height, found in zip(self._bars, probability, detected, strict=True):
            bar.set_height(height if math.isfinite(height) else 0.0)
            bar.set_facecolor(BLUE if found else "none")

    def _merit_of(self, world: World) -> str:
        error, bound = world.metrics.position_error_m[0, 0], world.metrics.position_crlb_m[0, 0]
        return f"position error {metres(error)},  1σ bound {metres(bound)}"

    def _more_samples(self) -> list[Any]:
        fix = Line2D([], [], **FIX, label="fix, its 2σ ellipse (dotted)")
        found = Patch(facecolor=to_rgb(BLUE), label="maneuver detected by the model")
        return [fix, found]


def maneuver_instants(world: World, simulation: Simulation) -> list[Instant]:
    """What there is to see of a world (a batch of one) with a maneuvering target."""
    scenario, told = simulation.scenario, world.reports
    layers = level_layers(world, scenario.standoff_m) | {"bearings used": line_rows(bearing_lines(world))}
    if told.fix.fixed[0]:
        layers["position fix"] = 1e-3 * told.fix.position[:, None]
        layers["its 2σ ellipse"] = ellipse_rows(told.fix.position, told.fix.cov)[:, None]
    true, estimated = told.true_acceleration[0], told.acceleration[0]
    vectors = {
        "true acceleration": np.concatenate([np.zeros_like(true), true], axis=-1)[:, None],
        "estimated acceleration": estimated[:, None],
    }
    views = (
        View("map", PLAN, layers, plane_names(world, scenario.reference)),
        View("acceleration", ("east [m/s²]", "north [m/s²]"), vectors, reach=_reach(true, estimated)),
    )
    models = told.model_probability[0, 0]
    at, label = clock(int(world.step[0]), scenario)
    errors, names = errors_of(world.metrics, scenario.score), numbered("model", len(models))
    return [Instant(at, label, views, errors, dict(zip(names, models, strict=True)))]


def _reach(true: np.ndarray, estimated: np.ndarray) -> float:
    """Half width of axes that hold both accelerations, unless the estimate is beyond belief."""
    seen = np.where(np.isfinite(estimated), estimated, 0.0)
    return max(REACH_M_S2, 1.1 * min(float(np.abs([true, seen]).max()), 1e3))


def _panel(figure: Figure, box: tuple[float, float, float, float], title: str) -> Any:
    axes = figure.add_axes(box)
    axes.tick_params(labelsize=8, colors=INK)
    axes.grid(True, color=GRID, linewidth=0.8)
    axes.set_axisbelow(True)
    axes.set_title(title, fontsize=9, color=INK, loc="left")
    return axes
