"""Pictures: the paper's figures 1 to 6 from our computations, and two ellipses with true and ghost solution."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from agents.reproduction.passive_radar import geometry
from agents.reproduction.passive_radar.claims import LAYOUTS, Trials
from agents.reproduction.passive_radar.monte_carlo import (
    GOOD,
    MANEUVER_S,
    PAIR,
    PAIR_GUESSES,
    PAIR_TARGET,
    POOR,
    Sites,
)
from passive_env.palette import BLUE, GREEN, GRID, INK, MUTED, ORANGE, PURPLE, SKY_BLUE, VERMILION
from trackers.ellipse_intersection import branch, intersect
from trackers.range_sum import range_sum

KM = 1e3
FINE_M = np.arange(-200e3, 200.1e3, 4e3)
GOOD_LEVELS = (240, 280, 320, 360, 400, 450, 500)
POOR_LEVELS = (500, 1000, 1500, 2000, 3000, 4000, 6000)
TICKS_M = (50, 100, 200, 500, 1000, 2000, 5000, 10000, 20000)
NAMES = {"A": "A, poor", "B": "B, triangle"}


def all_pictures(trials: Trials) -> dict[str, Figure]:
    """Figures by file name."""
    return {
        "figure_1_dilution": dilution_picture(),
        "figure_2_start": start_picture(trials),
        "figure_3_layouts": layout_picture(trials),
        "figure_4_maneuver": maneuver_picture(trials),
        "figure_5_two_or_three": comparison_picture(),
        "figure_6_two_transmitters": pair_picture(trials),
        "ellipses_true_and_ghost": ellipse_picture(),
    }


def dilution_picture() -> Figure:
    """Figure 1: horizontal error of one scan over the map, both layouts."""
    figure = Figure(figsize=(11.0, 5.0), layout="constrained")
    left, right = figure.subplots(1, 2, sharey=True)
    _map(figure, left, geometry.horizontal_map(GOOD, FINE_M), GOOD, GOOD_LEVELS, "Figure 1a: triangle, receiver inside")
    _map(figure, right, geometry.horizontal_map(POOR, FINE_M), POOR, POOR_LEVELS, "Figure 1b: sites to one side")
    left.set_ylabel("north [km]")
    return figure


def comparison_picture() -> Figure:
    """Figure 5: three transmitters in space beside two in the plane."""
    figure = Figure(figsize=(11.0, 5.0), layout="constrained")
    left, right = figure.subplots(1, 2, sharey=True)
    three, two = geometry.horizontal_map(POOR, FINE_M), geometry.horizontal_map(PAIR, FINE_M)
    _map(figure, left, three, POOR, POOR_LEVELS, "Figure 5a: T₁, T₂, T₃, height unknown")
    _map(figure, right, two, PAIR, POOR_LEVELS, "Figure 5b: T₁, T₂, in the plane")
    right.contour(FINE_M / KM, FINE_M / KM, two - three, levels=[0.0], colors=[VERMILION], linewidths=1.5)
    right.plot([], [], color=VERMILION, label="as good as three")
    right.legend(loc="upper right", fontsize=8)
    left.set_ylabel("north [km]")
    return figure


def _map(figure: Figure, axes: Axes, error: np.ndarray, sites: Sites, levels: Sequence[float], title: str) -> None:
    shown = np.minimum(error, 10.0 * levels[-1])
    x = FINE_M / KM
    drawn = axes.contourf(x, x, shown, levels=levels, cmap="cividis", extend="both")
    axes.contour(x, x, shown, levels=levels, colors="white", linewidths=0.5)
    figure.colorbar(drawn, ax=axes, label="horizontal error of one scan [m]")
    _sites(axes, sites)
    axes.set(title=title, xlabel="east [km]", aspect="equal")


def _sites(axes: Axes, sites: Sites) -> None:
    axes.plot(*(sites.transmitters[:, :2].T / KM), "^", color=ORANGE, markeredgecolor=INK, label="transmitters")
    axes.plot(*(sites.receiver[:2] / KM), "o", color="white", markeredgecolor=INK, label="receiver")


def start_picture(trials: Trials) -> Figure:
    """Figure 2: what the start does in the poor layout."""
    figure, (above, below) = _stacked()
    shown = {
        "batch": ("batch start", BLUE),
        "20 km, 200 m/s": ("plain, P₀ 20 km, 200 m/s", GREEN),
        "1 km, 100 m/s": ("plain, P₀ 1 km, 100 m/s", ORANGE),
        "200 m, 10 m/s": ("plain, P₀ 200 m, 10 m/s", VERMILION),
        "vz 100 m/s": ("plain, P₀ 20 km, 200 m/s, climb 100 m/s", PURPLE),
    }
    for way, (label, color) in shown.items():
        record = trials.straight["A", way]
        above.plot(record.rms(), color=color, label=label)
        below.plot(record.rms_height(), color=color)
    _bound(above, below, POOR)
    _dress(above, below, "Figure 2: starts in the poor layout")
    return figure


def layout_picture(trials: Trials) -> Figure:
    """Figure 3: both layouts after the batch start."""
    figure, (above, below) = _stacked()
    for name, color in (("A", VERMILION), ("B", BLUE)):
        record = trials.straight[name, "batch"]
        above.plot(record.rms(), color=color, label=NAMES[name])
        below.plot(record.rms_height(), color=color)
        _bound(above, below, LAYOUTS[name])
    _dress(above, below, "Figure 3: the layout decides")
    return figure


def _bound(above: Axes, below: Axes, sites: Sites) -> None:
    horizontal, vertical = geometry.bound(sites)
    above.plot(horizontal, color=INK, linestyle=":", linewidth=1.0)
    below.plot(vertical, color=INK, linestyle=":", linewidth=1.0)


def _stacked() -> tuple[Figure, tuple[Axes, Axes]]:
    figure = Figure(figsize=(8.0, 7.0), layout="constrained")
    above, below = figure.subplots(2, 1, sharex=True)
    return figure, (above, below)


def _dress(above: Axes, below: Axes, title: str) -> None:
    above.plot([], [], color=INK, linestyle=":", linewidth=1.0, label="posterior bound")
    for axes, what in ((above, "horizontal"), (below, "height")):
        _logarithmic(axes, f"{what} RMS [m]")
    above.set_title(title)
    above.legend(frameon=False, fontsize=9)
    below.set_xlabel("time [s]")


def _logarithmic(axes: Axes, up: str) -> None:
    axes.set(yscale="log", ylabel=up)
    axes.set_yticks(TICKS_M, [f"{tick:d}" for tick in TICKS_M])
    axes.minorticks_off()
    axes.grid(visible=True, alpha=0.3)


def maneuver_picture(trials: Trials) -> Figure:
    """Figure 4: one run's track with and without the test, and the errors of all."""
    figure = Figure(figsize=(11.0, 5.0), layout="constrained")
    left, right = figure.subplots(1, 2)
    truth = trials.flights["burning"].path[0, :, :2]
    left.plot(*(truth.T / KM), color=INK, linewidth=2.0, label="target")
    for n, color, label in ((0, VERMILION, "without the test"), (100, BLUE, "with it, N = 100")):
        record = trials.burning["A", n]
        left.plot(*((truth + record.error[0, :, :2]).T / KM), color=color, linewidth=1.0, label=label)
        right.plot(record.rms(), color=color, label=f"A, {label}")
        right.plot(trials.burning["B", n].rms(), color=color, linestyle="--", label=f"B, {label}")
    for second in MANEUVER_S:
        right.axvline(second, color=GRID, zorder=0)
    left.set(title="Figure 4: a maneuver, one run in A", xlabel="east [km]", ylabel="north [km]", aspect="equal")
    right.set(title="all runs", xlabel="time [s]")
    _logarithmic(right, "horizontal RMS [m]")
    for axes in (left, right):
        axes.legend(frameon=False, fontsize=8)
    return figure


def pair_picture(trials: Trials) -> Figure:
    """Figure 6: two transmitters; single-scan solutions of one run and its tracks from both guesses."""
    figure = Figure(figsize=(7.6, 7.0), layout="constrained")
    flights = trials.flights["pair"]
    sums = flights.heard(PAIR).range_sums[0]
    roots = intersect(sums, PAIR.transmitters, PAIR.receiver)
    for axes, (name, guess) in zip(figure.subplots(1, 2), PAIR_GUESSES.items(), strict=True):
        for i, (label, color) in enumerate((("solutions, det H > 0", MUTED), ("solutions, det H < 0", SKY_BLUE))):
            shown = roots.position[roots.valid[:, i], i] / KM
            axes.plot(*shown.T, ".", color=color, markersize=2, label=label)
        track = trials.pair[name].error[0] + flights.path[0, :, :2]
        axes.plot(*(track.T / KM), color=VERMILION, linewidth=1.2, label="track")
        axes.plot(*(flights.path[0, :, :2].T / KM), color=INK, linewidth=0.8, linestyle="--", label="target")
        axes.plot(*(guess[:2] / KM), "x", color=PURPLE, markersize=9, label="guess")
        _sites(axes, PAIR)
        axes.set(title=f"Figure 6: guess on the {name} side", xlabel="east [km]", ylabel="north [km]", aspect="equal")
        axes.legend(frameon=False, fontsize=7, loc="upper left")
    return figure


def ellipse_picture() -> Figure:
    """Two range sums' ellipses, their two solutions, and the border between them."""
    figure = Figure(figsize=(7.0, 6.4), layout="constrained")
    axes = figure.subplots()
    axis = np.arange(-70e3, 50.1e3, 0.5e3)
    points, target = geometry.grid(axis), PAIR_TARGET[:2]
    side = branch(points, PAIR.transmitters, PAIR.receiver)
    axes.contourf(axis / KM, axis / KM, side, levels=[-2, 0, 2], colors=[GRID, "white"], alpha=0.6)
    told, sums = range_sum(target, *PAIR), range_sum(points, *PAIR)
    for i, color in enumerate((BLUE, GREEN)):
        axes.contour(axis / KM, axis / KM, sums[..., i], levels=[told[i]], colors=[color])
        axes.plot([], [], color=color, label=f"range sum by T{'₁₂'[i]}")
    true, ghost = geometry.solutions(target) / KM
    axes.plot(*true, "*", color=VERMILION, markersize=14, markeredgecolor=INK, label="target, det H > 0")
    axes.plot(*ghost, "X", color=PURPLE, markersize=10, markeredgecolor=INK, label="ghost, det H < 0 (grey)")
    _sites(axes, PAIR)
    axes.set(
        title="Two range sums: two ellipses, which cross twice", xlabel="east [km]", ylabel="north [km]", aspect="equal"
    )
    axes.legend(loc="upper left", fontsize=8)
    return figure
