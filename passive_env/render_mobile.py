"""Picture of sensors on carriers: the map with their trails, the target and its track, and all heights below."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from passive_env.artists import bottom_legend, kilometres, ring
from passive_env.core import Simulation, World
from passive_env.layers import Instant, clock, errors_of
from passive_env.palette import BLUE, INK
from passive_env.render_placement import (
    AREA,
    COURSE,
    HEIGHTS_BOX,
    MAP_BOX,
    SENSOR,
    TARGET,
    draw_area,
    draw_heights,
    draw_sensors,
    entry_views,
)

TRAIL: dict[str, Any] = {"color": INK, "linewidth": 1.4, "alpha": 0.75}


class MobileScene:
    """The artists of a picture, made anew at every step: there are few.

    Args:
        figure: an empty figure.
        scenario: supplies number and kinds of sensors, steps and their length.
    """

    aspect = MAP_BOX[2] / MAP_BOX[3]

    def __init__(self, figure: Figure, scenario: Any):
        self._figure, self._scenario = figure, scenario
        self._map, self._heights = figure.add_axes(MAP_BOX), figure.add_axes(HEIGHTS_BOX)
        samples = [
            Line2D([], [], marker="o", color=INK, label="sensor", **SENSOR), Line2D([], [], **TRAIL, label="its trail"),
            Line2D([], [], **TARGET, label="true course"), Line2D([], [], **ring(BLUE, 9.0), label="estimate"),
            Line2D([], [], **COURSE, label="expected courses"),
            Line2D([], [], **AREA, label="where sensors are sent"),
        ]  # fmt: skip
        bottom_legend(figure, samples, columns=3)

    def update(self, world: World, trails: np.ndarray, frame: Any, simulation: Any) -> None:
        """Show a world (a batch of one) with the carriers' trails [n, k, 3] m; before they are installed none."""
        task, step = world.tape.task.rows(slice(1)), int(world.step[0])
        course, trails = 1e-3 * world.tape.targets[0, : step + 1, 0, :3], 1e-3 * trails[:, -max(step, 1) :]
        draw_area(self._map, task, self._scenario)
        draw_heights(self._heights, task, self._map.get_xlim())
        for axes, up in ((self._map, 1), (self._heights, 2)):
            axes.plot(course[:, 0], course[:, up], **TARGET)
            axes.plot(*(1e-3 * world.estimate.mean[0, 0, [0, up]])[:, None], **ring(BLUE))
            if step > 0:
                for trail in trails:
                    axes.plot(trail[:, 0], trail[:, up], **TRAIL)
                draw_sensors(axes, world.platforms[0, :, :3], self._scenario.ranging, up == 2)
        figures = world.metrics
        self._map.set_title(f"t = {step * self._scenario.step_s:g} s", loc="left", fontsize=11, color=INK)
        self._map.set_title(
            f"position error {kilometres(figures.position_error_m[0, 0])},  1σ promised "
            f"{kilometres(figures.position_crlb_m[0, 0])}", loc="right", fontsize=11, color=INK,
        )  # fmt: skip

    def pixels(self) -> np.ndarray:
        """RGB uint8 [h, w, 3]."""
        canvas: Any = self._figure.canvas
        canvas.draw()
        return np.array(np.asarray(canvas.buffer_rgba())[..., :3])


def mobile_instants(world: World, simulation: Simulation) -> list[Instant]:
    """What there is to see of a world (a batch of one) of sensors on carriers; before they are installed none."""
    scenario, step = simulation.scenario, int(world.step[0])
    estimate, cov = world.estimate.mean[0, 0, :3], world.estimate.cov[0, 0, :3, :3]
    installed = world.platforms.shape[1] if step > 0 else 0
    views = entry_views(world, scenario, installed, world.truth[0, 0], estimate, cov)
    return [Instant(*clock(step, scenario), views, errors_of(world.metrics, scenario.score), {})]
