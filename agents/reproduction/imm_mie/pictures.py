"""Pictures: the paper's figures 2 to 5 from our Monte Carlo, and what the stations' geometry does.

Figures 2 and 4: position error of scenario 1 and 2; figures 3 and 5: their accelerations. The windows' probabilities
stand below the errors.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from agents.reproduction.imm_mie.claims import FUSED, RIVAL, Trials
from agents.reproduction.imm_mie.monte_carlo import PHASES, STEP_S, Record, paper_path
from passive_env.palette import BLUE, GREEN, GRID, INK, PURPLE, SERIES, VERMILION

LABELS = {FUSED: "IMM-MIE", RIVAL: "IMM of CV, CA, CA"}
COLORS = {FUSED: BLUE, RIVAL: VERMILION}
ERROR_TICKS = (10, 20, 50, 100, 200, 500)
FIRST = 4
"""First scan drawn: before it the two-point start decides."""


def all_pictures(trials: Trials) -> dict[str, Figure]:
    """Figures by file name."""
    pictures = {}
    for scenario, number in ((1, 2), (2, 4)):
        records = trials.positions[scenario]
        pictures[f"figure_{number}_position_error"] = error_picture(records, scenario, number)
        pictures[f"figure_{number + 1}_acceleration"] = acceleration_picture(records, scenario, number + 1)
    pictures["passive_stations"] = geometry_picture(trials)
    return pictures


def error_picture(records: Mapping[str, Record], scenario: int, number: int) -> Figure:
    """Position RMSE over time, and the probability of the windows below it."""
    figure, (above, below) = _figure(2)
    for name, label in LABELS.items():
        rmse = records[name].rmse()
        above.plot(_seconds(len(rmse)), rmse[FIRST:], color=COLORS[name], label=label)
    above.axhline(np.sqrt(2.0) * 10.0, color=INK, linestyle=":", linewidth=1.0, label="measurement")
    _dress(above, scenario, f"Figure {number}: position error, scenario {scenario}", "position RMSE [m]")
    share = records[FUSED].probability.mean(0)[FIRST:]
    for i, (window, color) in enumerate(((6, PURPLE), (4, GREEN))):
        below.plot(_seconds(len(share) + FIRST), share[:, i], color=color, label=f"window of {window} scans")
    below.set_ylim(0.0, 1.0)
    _dress(below, scenario, "", "probability")
    below.set_xlabel("time [s]")
    return figure


def acceleration_picture(records: Mapping[str, Record], scenario: int, number: int) -> Figure:
    """Mean estimated acceleration beside the true one, and its RMSE."""
    figure, (above, below) = _figure(2)
    truth = paper_path(scenario).acceleration
    axis, word = (0, "eastward") if scenario == 1 else (1, "northward")
    above.plot(
        _seconds(len(truth)), truth[FIRST:, axis], color=INK, linewidth=1.0, drawstyle="steps-post", label="truth"
    )
    for name, label in LABELS.items():
        record = records[name]
        above.plot(_seconds(len(truth)), record.acceleration.mean(0)[FIRST:, axis], color=COLORS[name], label=label)
        below.plot(_seconds(len(truth)), record.acceleration_rmse()[FIRST:], color=COLORS[name], label=label)
    title = f"Figure {number}: acceleration, scenario {scenario}"
    _dress(above, scenario, title, f"mean {word} [m/s²]")
    _dress(below, scenario, "", "RMSE [m/s²]")
    below.set_xlabel("time [s]")
    return figure


def geometry_picture(trials: Trials) -> Figure:
    """Position RMSE of IMM-MIE over time for stations at some baselines."""
    figure, (axes,) = _figure(1)
    names = (
        "B = 2 km",
        "B = 5 km",
        "B = 20 km",
        "B = 40 km",
        "2 km, opening at 600 m/s",
        "2 km, both closing at 250 m/s",
    )
    for name, color in zip(names, SERIES, strict=True):
        rmse = trials.geometry[name][1][FUSED].rmse()
        axes.plot(_seconds(len(rmse)), rmse[FIRST:], color=color, label=name)
    _dress(axes, 2, "Fixes of two passive stations, σ = 1 mrad, IMM-MIE", "position RMSE [m]", legend=False)
    axes.set_yscale("log")
    axes.set_yticks(ERROR_TICKS, [f"{tick:g}" for tick in ERROR_TICKS])
    axes.minorticks_off()
    axes.set_xlabel("time [s]")
    figure.legend(loc="outside right upper", frameon=False, fontsize=9)
    return figure


def _seconds(scans: int) -> np.ndarray:
    return STEP_S * np.arange(FIRST, scans)


def _figure(rows: int) -> tuple[Figure, list[Axes]]:
    heights = [2.0, 1.0] if rows == 2 else [1.0]
    figure = Figure(figsize=(8.0, 6.0 if rows == 2 else 4.6), layout="constrained")
    return figure, list(np.atleast_1d(figure.subplots(rows, 1, sharex=True, height_ratios=heights)))


def _dress(axes: Axes, scenario: int, title: str, up: str, legend: bool = True) -> None:
    """Title, names of the axes, grid, legend; thin lines where a phase begins."""
    axes.set(title=title, ylabel=up)
    for start, _ in list(PHASES[scenario].values())[1:]:
        axes.axvline(start, color=GRID, zorder=0)
    axes.grid(visible=True, axis="y", alpha=0.3)
    if legend:
        axes.legend(frameon=False, fontsize=9)
