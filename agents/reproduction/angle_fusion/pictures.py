"""Pictures: the paper's three figures from our Monte Carlo. The paper's own curves are lost."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from agents.reproduction.angle_fusion.claims import LOST_SHARES, lost_share
from agents.reproduction.angle_fusion.monte_carlo import STEPS, Record, range_bound
from passive_env.palette import BLUE, GREEN, INK, PURPLE, VERMILION

SCAN = np.arange(1, STEPS + 1)
TICKS = (0, 1, 2, 3, 4, 5, 10, 20, 50, 100)


def all_pictures(records: Mapping[str, Record]) -> dict[str, Figure]:
    """Figures by file name."""
    return {
        "lost_tracks": lost_picture(records),
        "range_error_in_clutter": clutter_picture(records),
        "range_error_with_dropouts": dropout_picture(records),
    }


def lost_picture(records: Mapping[str, Record]) -> Figure:
    """Figure 1: share of lost tracks over validated returns per sensor, with Wilson intervals."""
    figure, axes = _figure()
    for name, label, color in (
        ("pdaf", "PDAF on the fused gate, γ₂ = 16", BLUE),
        ("nn", "nearest neighbour", VERMILION),
        ("fixed", "PDAF, fixed density", GREEN),
    ):
        found = [record for key, record in records.items() if _is_level(key, name)]
        if not found:
            continue
        candidates = [float(record.validated.mean()) for record in found]
        shares = [lost_share(record) for record in found]
        middle = np.array([share for share, _ in shares])
        ends = np.array([interval for _, interval in shares])
        error = np.abs(ends.T - middle)
        axes.errorbar(candidates, 100 * middle, 100 * error, marker="o", capsize=3, color=color, label=label)
    spec = [100 * share for share, _ in LOST_SHARES.values()]
    axes.plot([1 + n for n in LOST_SHARES], spec, "x", color=INK, label="specification, PDAF")
    axes.axhline(5.0, color=PURPLE, linestyle=":", label="5 %, the paper's limit up to 9 returns")
    axes.axvline(9.0, color=PURPLE, linestyle=":")
    _dress(axes, "Figure 1: lost tracks", "validated returns per sensor", "lost tracks [%]")
    axes.set_xlim(0.0, 20.0)
    axes.set_yscale("symlog", linthresh=5.0)
    axes.set_yticks(TICKS, [f"{tick:g}" for tick in TICKS])
    axes.set_ylim(0.0, 120.0)
    return figure


def _is_level(key: str, name: str) -> bool:
    """Whether a record is one of a family over clutter levels, such as 'pdaf_8'."""
    family, _, level = key.partition("_")
    return family == name and level.replace(".", "", 1).isdigit()


def clutter_picture(records: Mapping[str, Record]) -> Figure:
    """Figure 2: range error over time at 8 false returns per gate."""
    figure, axes = _figure()
    axes.plot(SCAN, records["pdaf_8"].rmse(), color=BLUE, label="PDAF on all pairs, kept runs, 8 false returns")
    axes.plot(SCAN, records["sequential_8"].rmse(), color=GREEN, label="PDAF sensor by sensor, kept runs")
    axes.plot(SCAN, records["ekf"].rmse(), color=INK, label="EKF without clutter")
    axes.plot(SCAN, range_bound(), ":", color=PURPLE, label="Cramér–Rao bound without clutter, √q = 30 m/s²")
    _dress(axes, "Figure 2: range error in clutter", "scan", "RMSE of range from platform 1 [m]", log=True)
    return figure


def dropout_picture(records: Mapping[str, Record]) -> Figure:
    """Figure 3: range error over time with sensor 2 at 90 %, with and without clutter."""
    figure, axes = _figure()
    for name, label, color, style in (
        ("ekf", "no clutter, sensor 2 always", INK, "-"),
        ("ekf_dropouts", "no clutter, sensor 2 at 90 %", VERMILION, "--"),
        ("pdaf_8", "8 false returns, sensor 2 always", BLUE, "-"),
        ("pdaf_dropouts", "8 false returns, sensor 2 at 90 %", GREEN, "--"),
    ):
        axes.plot(SCAN, records[name].rmse(), style, color=color, label=label)
    _dress(axes, "Figure 3: range error with dropouts", "scan", "RMSE of range from platform 1 [m]", log=True)
    return figure


def _figure() -> tuple[Figure, Axes]:
    figure = Figure(figsize=(8.0, 4.6), layout="constrained")
    return figure, figure.subplots()


def _dress(axes: Axes, title: str, across: str, up: str, log: bool = False) -> None:
    """Title, names of the axes, grid, legend."""
    axes.set(title=title, xlabel=across, ylabel=up, yscale="log" if log else "linear")
    axes.grid(visible=True, alpha=0.3)
    axes.legend(frameon=False, fontsize=9)
