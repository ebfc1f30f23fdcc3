"""Pictures: range of each target as in the paper's figures 3 to 5, and the error over time beside its Table 1."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import LogFormatter

from agents.reproduction.two_station.monte_carlo import TABLE_1_KM, UPDATES, Study
from passive_env.palette import BLUE, GREEN, INK, PURPLE, VERMILION


def all_pictures(studies: Mapping[str, Study]) -> dict[str, Figure]:
    """Figures by file name."""
    targets = range(TABLE_1_KM.shape[1])
    ranges = {f"range_target_{j + 1}": range_picture(studies, j) for j in targets}
    return ranges | {"range_error": error_picture(studies)}


def range_picture(studies: Mapping[str, Study], target: int) -> Figure:
    """Range of one target over the updates in every reading: true, one run, mean of all runs."""
    figure = Figure(figsize=(9.0, 4.0), layout="constrained")
    panels = figure.subplots(1, len(studies), sharey=True, squeeze=False)[0]
    for axes, (name, one) in zip(panels, studies.items(), strict=True):
        true = one.paths.ranges[:, target] / 1e3
        estimated = true + one.paper.range_error[:, :, target] / 1e3
        axes.plot(true, color=INK, label="true")
        axes.plot(estimated[0], ":", color=VERMILION, label="paper's filter, one run")
        axes.plot(estimated.mean(0), "--", color=BLUE, label=f"paper's filter, mean of {len(estimated)} runs")
        _dress(axes, f"{name}, target {target + 1}", "range from station 2 [km]")
    return _with_legend(figure, panels[0], columns=3)


def error_picture(studies: Mapping[str, Study]) -> Figure:
    """Mean absolute range error of each target over the updates: Table 1, the readings, the fused EKF, the bounds."""
    figure = Figure(figsize=(12.0, 4.8), layout="constrained")
    panels = figure.subplots(1, TABLE_1_KM.shape[1], sharey=True, squeeze=False)[0]
    natural, bestfit = studies["NATURAL"], studies["BESTFIT"]
    for j, axes in enumerate(panels):
        axes.plot(UPDATES, TABLE_1_KM[:, j], "o", color=INK, label="paper, Table 1")
        for one, label, color in (
            (natural.paper, "paper's filter, NATURAL", BLUE),
            (bestfit.paper, "paper's filter, BESTFIT", VERMILION),
            (natural.fused, "both stations, EKF from the cross-fix, NATURAL", GREEN),
        ):
            axes.plot(np.abs(one.range_error[:, :, j]).mean(0) / 1e3, color=color, label=label)
        for name, style in (("reference, q = 10", "--"), ("both, q = 10", ":")):
            axes.plot(natural.bounds[name][:, j] / 1e3, style, color=PURPLE, label=f"Cramér–Rao bound, NATURAL, {name}")
        _dress(axes, f"target {j + 1}", "mean absolute range error [km]")
    return _with_legend(figure, panels[0], columns=3)


def _dress(axes: Axes, title: str, quantity: str) -> None:
    """Title, names of the axes, and a logarithmic scale with plain numbers."""
    axes.set(title=title, xlabel="update", ylabel=quantity, yscale="log")
    axes.yaxis.set_major_formatter(LogFormatter())
    axes.yaxis.set_minor_formatter(LogFormatter(labelOnlyBase=False, minor_thresholds=(1.5, 0.4)))
    axes.label_outer()
    axes.grid(visible=True, alpha=0.3)


def _with_legend(figure: Figure, axes: Axes, columns: int) -> Figure:
    """One legend below all panels."""
    handles, labels = axes.get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=columns, frameon=False)
    return figure
