"""Wang, Wang and Yang (2004), azimuth and elevation from two aircraft: section 5 repeated, its claims judged.

`monte_carlo` simulates, `claims` judges, `pictures` draws; this module puts the result together.
Specification: "two-platform angle-only fusion tracking".
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from agents.reproduction.angle_fusion.claims import ROWS, SCANS, all_claims, lost_share
from agents.reproduction.angle_fusion.monte_carlo import Record, Trial, draw_seeds, follow, range_bound
from agents.reproduction.angle_fusion.pictures import all_pictures
from agents.reproduction.report import PAPER, SPEC, Paper, markdown_table, prepare, write_reproduction

__all__ = ["ANGLE_FUSION", "TRIALS", "print_angle_fusion", "reproduce_angle_fusion"]

TRIALS: dict[str, Trial] = {
    "ekf": Trial("angle_ekf"),
    "ekf_dropouts": Trial("angle_ekf", availability=0.9),
    **{f"pdaf_{n}": Trial(clutter=n) for n in (1, 2, 4, 6, 8, 10)},
    "pdaf_dropouts": Trial(clutter=8, availability=0.9),
    "pdaf_narrow": Trial(settings=(("gate", 9.21),), clutter=8),
    "pdaf_missing": Trial(clutter=8, detection=0.9),
    **{f"pdaf_noise_{noise:g}": Trial(settings=(("process_noise", noise),), clutter=8) for noise in (10.0, 1.0)},
    **{f"nn_{n}": Trial("angle_nn", clutter=n) for n in (1, 4, 8)},
    "sequential_8": Trial("angle_pdaf_sequential", clutter=8),
    **{f"fixed_{n:g}": Trial(clutter=n, fixed_density=True) for n in (0.5, 1, 2, 3, 4)},
}
"""What is tried; the names of the levels end with the mean number of false returns per gate."""


def reproduce_angle_fusion(
    runs: int = 500, seeds: Sequence[int] = (0, 1, 2, 3), out: Path | None = None
) -> dict[str, Any]:
    """Repeat the paper's Monte Carlo and the bounds, and judge the paper's and the specification's claims.

    Args:
        runs: Monte Carlo runs per seed (the paper: 50 in all).
        seeds: one generator each.
        out: folder for `reproduction.json`, `reproduction.md` and the pictures; None writes nothing.
    Returns:
        plain data: settings, trials, bound_m, claims.
    Raises:
        ValueError: runs or seeds that leave nothing to compute.
    """
    prepare(runs, seeds, out)
    records = run_trials(runs, seeds)
    result = {
        "paper": "Wang, Wang and Yang (2004), J. Electronics & Information Technology 26(8), 1196–1202, section 5",
        "settings": {"runs": runs, "seeds": list(seeds), "scans": list(SCANS)},
        "trials": {name: _summary(record) for name, record in records.items()},
        "bound_m": range_bound()[ROWS].tolist(),
        "claims": all_claims(records, np.random.default_rng([*seeds, runs])),
    }
    if out is not None:
        write_reproduction(Path(out), result, print_angle_fusion(result), all_pictures(records))
    return result


def run_trials(runs: int, seeds: Sequence[int]) -> dict[str, Record]:
    """All trials on the same errors and dropouts, each with its own false returns."""
    noise, records = draw_seeds(seeds, runs), {}
    for i, (name, trial) in enumerate(TRIALS.items()):
        records[name] = follow(trial, noise, np.random.default_rng([*seeds, runs, i]))
    return records


def _summary(record: Record) -> dict[str, Any]:
    """Range RMSE of the kept runs at the named scans and its mean [m], validated returns, lost share."""
    rmse = record.rmse()
    share, interval = lost_share(record)
    return {
        "runs": len(record.lost),
        "rmse_m": rmse[ROWS].tolist(),
        "time_mean_m": float(rmse.mean()),
        "median_m": float(np.median(np.abs(record.range_error), axis=0).mean()),
        "validated": float(record.validated.mean()),
        "lost": share,
        "lost_interval": list(interval),
        "slipped": float(record.slipped.mean()),
    }


def print_angle_fusion(result: Mapping[str, Any]) -> str:
    """The result of `reproduce_angle_fusion` as text (Markdown)."""
    return ANGLE_FUSION.words(result)


def _sections(result: Mapping[str, Any]) -> dict[str, str]:
    """The tables: text per head."""
    return {
        "Range error and lost tracks": _trials_words(result),
    }


def _trials_words(result: Mapping[str, Any]) -> str:
    """One row per trial, and the bound."""
    scans = " / ".join(map(str, result["settings"]["scans"]))
    header = ("trial", "runs", f"RMSE of kept runs at scans {scans} [m]", "mean [m]", "median of all [m]",
              "returns in gate", "lost [%]", "95 % interval", "slipped [%]")  # fmt: skip
    rows = [
        (name, t["runs"], t["rmse_m"], t["time_mean_m"], t["median_m"], t["validated"], 100 * t["lost"],
         f"{100 * t['lost_interval'][0]:.1f} to {100 * t['lost_interval'][1]:.1f}", 100 * t["slipped"])
        for name, t in result["trials"].items()
    ]  # fmt: skip
    bound = ("Cramér–Rao bound", None, result["bound_m"], float(np.mean(range_bound())), *[None] * 5)
    return markdown_table(header, [*rows, bound])


ANGLE_FUSION = Paper(
    "angle-fusion",
    "Azimuth and elevation from two aircraft (Wang, Wang and Yang 2004)",
    reproduce_angle_fusion,
    _sections,
    {
        PAPER: "Sentences of section 5; one names a figure to meet, 5 % of lost tracks up to 9 returns.",
        SPEC: "The specification's own Monte Carlo of 200 to 500 runs, and bounds.",
    },
)
