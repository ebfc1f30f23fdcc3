"""Learning curves: several runs of one environment, median and range over their seeds, from the logs they left.

A run's folder holds TensorBoard event files anywhere below it or, where there are none, Stable-Baselines3's
`progress.csv`. Runs must be repetitions: they may differ by nothing but the seed.
"""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import EngFormatter
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from agents.files import atomic_write, save_figure
from agents.learned import read_config
from agents.pictures import DPI, style_diagram
from agents.training import SAME
from passive_env.palette import GOOD, INK, MUTED

REPEATED = tuple(name for name in SAME if name != "seed")
"""Entries of the configuration in which repetitions agree."""

RATIO, REWARD = "eval/ratio_to_rule", "rollout/ep_rew_mean"
PROGRESS, STEPS = "progress.csv", "time/total_timesteps"
WORDS = {RATIO: "final error / rule's", REWARD: "return of an episode"}


class Series(NamedTuple):
    """One quantity of one run: environment steps [n], increasing, and values [n]."""

    steps: np.ndarray
    values: np.ndarray


class Run(NamedTuple):
    """What a run left: its folder, its configuration, its finite quantities by name."""

    folder: Path
    config: dict[str, Any]
    series: dict[str, Series]


class Curve(NamedTuple):
    """One quantity over all runs.

    Attributes:
        steps: [n] environment steps, within what all runs have reached.
        values: [runs, n], interpolated where a run has no value of its own.
    """

    steps: np.ndarray
    values: np.ndarray

    def median(self) -> np.ndarray:
        """Median over runs [n]."""
        return np.median(self.values, axis=0)


def draw_curves(folders: Sequence[str | Path], out: str | Path) -> list[Path]:
    """Draw learning curves of several runs, and write the numbers beside the picture.

    Args:
        folders: run folders made by ``passive-env train``, of one environment and preset, with different seeds.
        out: a .png file; a .csv file of the same name is written beside it.
    Returns:
        both files.
    Raises:
        FileNotFoundError: no run folder, or one without logs.
        ValueError: fewer than two runs, runs that differ by more than the seed, nothing that all have logged.
    """
    out = Path(out)
    if out.suffix != ".png":
        raise ValueError(f"--out {out}: must end in .png")
    runs = [read_run(Path(folder)) for folder in folders]
    _check_repetitions(runs)
    curves = gather(runs)
    table = out.with_suffix(".csv")
    return [save_figure(out, picture(curves, title(runs))), atomic_write(table, as_csv(curves, seeds(runs)))]


def title(runs: Sequence[Run]) -> str:
    """Environment, algorithm, seeds."""
    config = runs[0].config
    return f"{config['environment']}, {config['algo']}: {len(runs)} runs, seeds {', '.join(map(str, seeds(runs)))}"


def seeds(runs: Sequence[Run]) -> list[int]:
    """The runs' seeds, in their order."""
    return [run.config["seed"] for run in runs]


def _check_repetitions(runs: Sequence[Run]) -> None:
    if len(runs) < 2:
        raise ValueError(f"{len(runs)} runs: a range over seeds needs at least two")
    first = runs[0]
    for run in runs[1:]:
        for name in REPEATED:
            found = difference(name, run.config.get(name), first.config.get(name))
            if found is not None:
                where, here, there = found
                raise ValueError(
                    f"{run.folder}: {where} is {here!r}, but {there!r} in {first.folder}; curves are of runs that "
                    "differ by their seed only"
                )
    by_seed: dict[int, Path] = {}
    for run, seed in zip(runs, seeds(runs), strict=True):
        if seed in by_seed:
            raise ValueError(f"{run.folder}: seed {seed} is that of {by_seed[seed]} too; every run needs its own")
        by_seed[seed] = run.folder


def difference(name: str, one: Any, other: Any) -> tuple[str, Any, Any] | None:
    """The first place where two settings differ, such as 'preset.learning_rate', and both values; None if nowhere."""
    if not (isinstance(one, dict) and isinstance(other, dict)):
        return None if one == other else (name, one, other)
    for key in {**one, **other}:
        found = difference(f"{name}.{key}", one.get(key), other.get(key))
        if found is not None:
            return found
    return None


# -- reading ----------------------------------------------------------------------------------------------------------


def read_run(folder: Path) -> Run:
    """A run's configuration and logs.

    Raises:
        FileNotFoundError: no run folder, or neither event files nor a progress.csv in it; ValueError: unreadable.
    """
    config = read_config(folder)
    if "seed" not in config:
        raise ValueError(f"{folder}: its configuration names no seed; restore it or train again")
    events = sorted({file.parent for file in folder.rglob("events.out.tfevents.*")})
    tables = sorted(folder.rglob(PROGRESS))
    if events:
        points = _together(_events(place) for place in events)
    elif tables:
        points = _together(_progress(file) for file in tables)
    else:
        raise FileNotFoundError(f"{folder}: neither TensorBoard's event files nor {PROGRESS} in it")
    return Run(folder, config, {name: series for name, found in points.items() if len((series := _series(found))[0])})


def _together(parts: Any) -> dict[str, dict[int, float]]:
    """Values by name and step; where two logs have a step, the later log's."""
    points: dict[str, dict[int, float]] = {}
    for part in parts:
        for name, found in part.items():
            points.setdefault(name, {}).update(found)
    return points


def _series(points: Mapping[int, float]) -> Series:
    """In the order of steps, finite values only."""
    steps = np.array(sorted(points), dtype=float)
    values = np.array([points[step] for step in sorted(points)], dtype=float)
    finite = np.isfinite(values)
    return Series(steps[finite], values[finite])


def _events(folder: Path) -> dict[str, dict[int, float]]:
    """All scalars of one folder's event files; of a resumed run the repeated steps' later values."""
    log = EventAccumulator(str(folder), size_guidance={"scalars": 0}).Reload()
    return {name: {event.step: event.value for event in log.Scalars(name)} for name in log.Tags()["scalars"]}


def _progress(file: Path) -> dict[str, dict[int, float]]:
    """All columns of Stable-Baselines3's table; an empty cell is a quantity not logged then.

    Raises:
        ValueError: no column of steps, or a cell that is no number.
    """
    rows = list(csv.DictReader(io.StringIO(file.read_text(encoding="utf-8"))))
    points: dict[str, dict[int, float]] = {}
    for i, row in enumerate(rows):
        if not row.get(STEPS):
            raise ValueError(f"{file}: row {i + 1} has no {STEPS}")
        try:
            numbers = {name: float(cell) for name, cell in row.items() if cell}
        except (ValueError, TypeError) as error:
            raise ValueError(f"{file}: row {i + 1}: {error}") from error
        for name, number in numbers.items():
            points.setdefault(name, {})[int(numbers[STEPS])] = number
    return points


# -- curves -----------------------------------------------------------------------------------------------------------


def gather(runs: Sequence[Run]) -> dict[str, Curve]:
    """The quantities that are drawn, of all runs: ratio to the rule, final errors, return of an episode.

    Raises:
        ValueError: no such quantity, or runs that share no step.
    """
    shown = quantities(runs)
    if not shown:
        has = "; ".join(f"{run.folder}: {', '.join(sorted(run.series)) or 'nothing'}" for run in runs)
        raise ValueError(f"no {RATIO}, eval/final_…_error_m or {REWARD} that all runs have logged ({has})")
    return {name: _curve(name, runs) for name in shown}


def quantities(runs: Sequence[Run]) -> list[str]:
    """Names of what is drawn and all runs have logged, in the order of the panels."""
    logged = set.intersection(*(set(run.series) for run in runs))
    wanted = [RATIO, *sorted(n for n in logged if n.startswith("eval/final_") and n.endswith("_error_m")), REWARD]
    return [name for name in wanted if name in logged]


def _curve(name: str, runs: Sequence[Run]) -> Curve:
    """All steps that lie within what every run has logged; values between a run's own are interpolated."""
    found = [run.series[name] for run in runs]
    begin, end = max(series.steps[0] for series in found), min(series.steps[-1] for series in found)
    if begin > end:
        spans = "; ".join(
            f"{r.folder}: {s.steps[0]:.0f} to {s.steps[-1]:.0f}" for r, s in zip(runs, found, strict=True)
        )
        raise ValueError(f"{name}: the runs share no step ({spans})")
    steps = np.unique(np.concatenate([series.steps for series in found]))
    steps = steps[(steps >= begin) & (steps <= end)]
    return Curve(steps, np.stack([np.interp(steps, series.steps, series.values) for series in found]))


def as_csv(curves: Mapping[str, Curve], labels: Sequence[int]) -> str:
    """One row per quantity and step: median, range, and every seed's value."""
    buffer = io.StringIO()
    writer = csv.writer(buffer, lineterminator="\n")
    writer.writerow(["quantity", "step", "median", "low", "high", *(f"seed {seed}" for seed in labels)])
    for name, curve in curves.items():
        low, high = curve.values.min(0), curve.values.max(0)
        for i, step in enumerate(curve.steps):
            writer.writerow([name, int(step), curve.median()[i], low[i], high[i], *curve.values[:, i]])
    return buffer.getvalue()


def picture(curves: Mapping[str, Curve], heading: str) -> Figure:
    """A panel per quantity over environment steps: median, range, and faintly every run; a single run as it is."""
    figure = Figure(figsize=(7.5, 0.6 + 2.6 * len(curves)), dpi=DPI, layout="constrained")
    if heading:
        figure.suptitle(heading, fontsize=12, color=INK)
    panels: list[Axes] = list(np.atleast_1d(figure.subplots(len(curves), 1, sharex=True)))
    for axes, (name, curve) in zip(panels, curves.items(), strict=True):
        style_diagram(axes, "", words_of(name))
        several = len(curve.values) > 1
        if several:
            low, high = curve.values.min(0), curve.values.max(0)
            axes.fill_between(curve.steps, low, high, color=GOOD, alpha=0.2, linewidth=0.0, label="range")
            axes.plot(curve.steps, curve.values.T, color=GOOD, linewidth=0.6, alpha=0.5)
        marker, label = "o" if len(curve.steps) < 30 else "", "median" if several else "this run"
        axes.plot(curve.steps, curve.median(), color=GOOD, linewidth=2.0, marker=marker, markersize=4, label=label)
        if name == RATIO:
            axes.axhline(1.0, color=MUTED, linestyle=":", label="the rule")
        axes.margins(x=0.01)
    panels[0].legend(frameon=False, fontsize=9, labelcolor=INK)
    panels[-1].set_xlabel("environment steps", fontsize=10, color=INK)
    panels[-1].xaxis.set_major_formatter(EngFormatter(sep=" "))
    return figure


def words_of(name: str) -> str:
    """A quantity in words: 'final range error [m]' of 'eval/final_range_error_m'."""
    return WORDS[name] if name in WORDS else name.removeprefix("eval/").removesuffix("_m").replace("_", " ") + " [m]"
