"""Pictures: the paper's figures 1 to 6, what the place of evaluation costs, and a map for a third radar.

Figures 1 to 3 are theory, with our Monte Carlo on 1 and 2 and the paper's misprinted R33 beside it on 2 and 3; figures
4 to 6 are Monte Carlo.
"""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from agents.reproduction.radar_placement.claims import PAIRS, ROUND, SINGLE, STUDIED, Trials
from agents.reproduction.radar_placement.scenario import (
    DISTANCE_M,
    STEP_S,
    error_ratio,
    matrix_error,
    pair,
    position_error,
    ring,
)
from passive_env.palette import BLACK, BLUE, GREEN, INK, MUTED, ORANGE, PURPLE, VERMILION
from trackers import Layout

FIRST = 2
"""First scan drawn: the start takes two."""

OVER_TIME = {
    "figure_4_azimuth": ("Figure 4: two radars on the ground", ("co-located", "θ12 = 10°", "θ12 = 20°")),
    "figure_5_elevation": ("Figure 5: one radar raised, θ12 = 0", ("co-located", "β12 = 10°", "β12 = 20°")),
    "figure_6_both": ("Figure 6: both angles", ("β12 = 20°", "θ12 = 20°", "θ12 = β12 = 20°")),
}
LINEARISATION_COLORS = {
    "truth": BLACK,
    "iterated": GREEN,
    "fused": BLUE,
    "local": VERMILION,
    "measurement": PURPLE,
}
MAP_STEP_M = 10.0e3


def all_pictures(trials: Trials) -> dict[str, Figure]:
    """Figures by file name."""
    return {
        "figure_1_azimuth_theory": azimuth_picture(trials),
        "figure_2_elevation_theory": elevation_picture(trials),
        "figure_3_both_theory": surface_picture(),
        **{name: time_picture(trials, title, names) for name, (title, names) in OVER_TIME.items()},
        "linearisations": linearisation_picture(trials),
        "third_radar": map_picture(),
    }


def azimuth_picture(trials: Trials) -> Figure:
    """Ratio of errors over θ12."""
    figure, axes = _ratio_axes("Figure 1: two radars on the ground", "θ12 [deg]")
    angles = np.linspace(0.0, 180.0, 361)
    axes.plot(angles, error_ratio(pair(angles)), color=BLUE, label="theory")
    _simulated(axes, trials, 0)
    axes.set_xticks(np.arange(0, 181, 30))
    axes.legend(frameon=False)
    return figure


def elevation_picture(trials: Trials) -> Figure:
    """Ratio of errors over β12 at one azimuth, and what the misprint makes of it."""
    figure, axes = _ratio_axes("Figure 2: one radar raised, θ12 = 0", "β12 [deg]")
    angles = np.linspace(0.0, 45.0, 181)
    axes.plot(angles, error_ratio(pair(0.0, angles)), color=BLUE, label="theory")
    coarse = angles[::12]
    alone = matrix_error(ring([0.0]), printed=True)
    printed = [matrix_error(pair(0.0, angle), printed=True) / alone for angle in coarse]
    axes.plot(coarse, printed, color=MUTED, linestyle="--", label="theory, R33 as printed")
    _simulated(axes, trials, 1)
    axes.legend(frameon=False)
    return figure


def _simulated(axes: Axes, trials: Trials, place: int) -> None:
    """Monte Carlo ratios where only the angle at `place` is not 0."""
    points = [(angles[place], name) for name, angles in PAIRS.items() if angles[1 - place] == 0.0]
    single = trials.pairs[SINGLE].rmse()
    ratios = [trials.pairs[name].rmse() / single for _, name in points]
    axes.plot([angle for angle, _ in points], ratios, "o", color=VERMILION, label="Monte Carlo")


def _ratio_axes(title: str, across: str) -> tuple[Figure, Axes]:
    figure = Figure(figsize=(8.0, 4.6), layout="constrained")
    axes = figure.subplots()
    axes.axhline(0.5, color=INK, linestyle=":", linewidth=1.0, label="floor of two equal radars")
    axes.set(title=title, xlabel=across, ylabel="position error over one radar's", ylim=(0.45, 0.8))
    axes.grid(visible=True, alpha=0.3)
    return figure, axes


def surface_picture() -> Figure:
    """The ratio over both angles, as a map: correct, and with R33 as printed."""
    azimuth, elevation = np.linspace(0.0, 90.0, 91), np.linspace(0.0, 45.0, 46)
    correct = error_ratio(pair(*np.meshgrid(azimuth, elevation)))
    rough = azimuth[::6], elevation[::5]
    alone = matrix_error(ring([0.0]), printed=True)
    printed = np.array([[matrix_error(pair(a, e), printed=True) / alone for a in rough[0]] for e in rough[1]])
    figure = Figure(figsize=(10.0, 4.4), layout="constrained")
    levels = np.arange(0.50, 0.7601, 0.02)
    left, right = figure.subplots(1, 2, sharey=True)
    for axes, x, y, ratio, title in (
        (left, azimuth, elevation, correct, "Figure 3: corrected equations"),
        (right, *rough, printed, "Figure 3: R33 as printed"),
    ):
        drawn = axes.contourf(x, y, ratio, levels=levels, cmap="cividis", extend="both")
        axes.clabel(axes.contour(x, y, ratio, levels=levels, colors="white", linewidths=0.6), fmt="%.2f", fontsize=8)
        axes.set(title=title, xlabel="θ12 [deg]")
        if axes is right:
            figure.colorbar(drawn, ax=[left, right], label="position error over one radar's")
    left.set_ylabel("β12 [deg]")
    return figure


def time_picture(trials: Trials, title: str, names: tuple[str, ...]) -> Figure:
    """Monte Carlo position errors over time."""
    figure, axes = _time_axes(title)
    for name, color in zip((SINGLE, *names), (BLACK, VERMILION, ORANGE, BLUE), strict=True):
        _plot_rmse(axes, trials.pairs[name].position_error, color, name)
    axes.legend(frameon=False)
    return figure


def linearisation_picture(trials: Trials) -> Figure:
    """Position errors of three radars all round over time, by the place of evaluation."""
    figure, axes = _time_axes(f"Three radars all round ({ROUND}): where bias and R are evaluated")
    for linearisation, color in LINEARISATION_COLORS.items():
        _plot_rmse(axes, trials.studied[ROUND, linearisation].position_error, color, linearisation)
    axes.legend(frameon=False)
    return figure


def _time_axes(title: str) -> tuple[Figure, Axes]:
    figure = Figure(figsize=(8.0, 4.6), layout="constrained")
    axes = figure.subplots()
    axes.set(title=title, xlabel="time [s]", ylabel="position RMSE [m]", yscale="log")
    ticks = (200, 300, 500, 700, 1000, 1500, 2000, 3000, 4000)
    axes.set_yticks(ticks, [f"{tick:d}" for tick in ticks])
    axes.minorticks_off()
    axes.grid(visible=True, alpha=0.3)
    return figure, axes


def _plot_rmse(axes: Axes, error: np.ndarray, color: str, label: str) -> None:
    rmse = np.sqrt(np.square(error).mean(0))
    axes.plot(STEP_S * np.arange(FIRST, len(rmse)), rmse[FIRST:], color=color, label=label)


def map_picture() -> Figure:
    """Theoretical error over the ground position of a third radar beside the 20° pair."""
    x, y = np.arange(-50e3, 451e3, MAP_STEP_M), np.arange(-250e3, 251e3, MAP_STEP_M)
    given = STUDIED["θ12 = 20°"]
    grid = np.stack([*np.meshgrid(x, y), np.zeros((len(y), len(x)))], axis=-1)
    pairs = np.broadcast_to(given.position, (*grid.shape[:2], 2, 3))
    position = np.concatenate([pairs, grid[..., None, :]], axis=-2)
    error = position_error(Layout(position, np.tile(given.std[:1], (3, 1)), np.ones(3, dtype=bool)))
    figure = Figure(figsize=(7.6, 6.2), layout="constrained")
    axes = figure.subplots()
    drawn = axes.contourf(x / 1e3, y / 1e3, error, levels=np.arange(100.0, 661.0, 40.0), cmap="cividis", extend="both")
    figure.colorbar(drawn, label="position error after 50 s, theory [m]")
    axes.plot(*(given.position[:, :2].T / 1e3), "s", color="white", markeredgecolor=INK, label="radars 1 and 2")
    end = DISTANCE_M / 1e3 - 15.0
    axes.plot([DISTANCE_M / 1e3, end], [0.0, 0.0], color=VERMILION, linewidth=3.0, label="target's track")
    steps, behind = (ring([0.0, 20.0, angle]).position[2, :2] / 1e3 for angle in (40.0, -120.0))
    axes.plot(*steps, "o", color=ORANGE, markeredgecolor=INK, label="the paper's next step, 40°")
    axes.plot(*behind, "*", color=GREEN, markersize=13, markeredgecolor=INK, label="at −120°")
    axes.set(title="Where to put a third radar", xlabel="east [km]", ylabel="north [km]", aspect="equal")
    axes.legend(loc="lower right", fontsize=8)
    return figure
