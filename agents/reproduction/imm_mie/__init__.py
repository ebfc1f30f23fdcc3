"""Sheng et al. (2009), an IMM of filters with modified input estimation: section 5 repeated, its claims judged.

`monte_carlo` simulates, `claims` judges, `pictures` draws; this module puts the result together. Section 8 of the
specification, fixes of passive stations as the measurements, is repeated with it.
Specification: "IMM tracking with modified input estimation".
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from agents.reproduction.imm_mie.claims import (
    BIAS_M_S2,
    FUSED,
    GEOMETRY,
    LONG_SHARE,
    NOISY_SPAN_S,
    RIVAL,
    RMSE_M,
    Trials,
    all_claims,
    geometry_row,
    long_share,
    mean_error,
)
from agents.reproduction.imm_mie.monte_carlo import (
    PHASES,
    Measured,
    Record,
    follow,
    mean_input_errors,
    measure_fixes,
    measure_positions,
    measure_quiet,
    quiet_alarms,
)
from agents.reproduction.imm_mie.pictures import all_pictures
from agents.reproduction.report import PAPER, SPEC, Paper, markdown_table, prepare, write_reproduction
from trackers import FixTracker, Imm3, ImmMie, InputEstimation, Mie

__all__ = ["IMM_MIE", "TRACKED", "print_imm_mie", "reproduce_imm_mie", "run_trials"]

TRACKED: dict[str, FixTracker] = {
    FUSED: ImmMie(),
    RIVAL: Imm3(),
    "sens": ImmMie(mixing="sens"),
    "output": ImmMie(mixing="output"),
    "none": ImmMie(mixing="none"),
    **{f"mie_{s}": Mie(windows=(s,)) for s in (6, 4)},
    **{f"ie_{s}": InputEstimation(windows=(s,)) for s in (6, 4)},
}
"""What follows the paper's targets: the bank, its rival, repaired mixing, single filters, classical estimation."""

QUIET_STEPS = 200


def reproduce_imm_mie(runs: int = 50, seeds: Sequence[int] = (0, 1, 2, 3), out: Path | None = None) -> dict[str, Any]:
    """Repeat the paper's Monte Carlo and the one on passive stations, and judge the claims.

    Args:
        runs: Monte Carlo runs per seed (the specification: 200 in all, and 40 on passive stations).
        seeds: one generator each.
        out: folder for `reproduction.json`, `reproduction.md` and the pictures; None writes nothing.
    Returns:
        plain data: settings, positions, geometry, claims.
    Raises:
        ValueError: runs or seeds that leave nothing to compute.
    """
    prepare(runs, seeds, out)
    trials = run_trials(runs, seeds)
    result = {
        "paper": "Sheng et al. (2009), IMM tracking with modified input estimation, section 4",
        "settings": {"runs": runs, "seeds": list(seeds), "phases_s": PHASES},
        "positions": {
            str(k): {name: _summary(r, k) for name, r in found.items()} for k, found in trials.positions.items()
        },
        "geometry": {name: geometry_row(*found) for name, found in trials.geometry.items()},
        "claims": all_claims(trials, np.random.default_rng([*seeds, runs])),
    }
    if out is not None:
        write_reproduction(Path(out), result, print_imm_mie(result), all_pictures(trials))
    return result


def run_trials(runs: int, seeds: Sequence[int]) -> Trials:
    """All trackers on the same measurements of each scenario and layout; each seed has its own generator."""
    generators = [np.random.default_rng(seed) for seed in seeds]
    measured = {k: _together([measure_positions(k, runs, rng) for rng in generators]) for k in PHASES}
    positions = {k: {name: follow(tracker, m) for name, tracker in TRACKED.items()} for k, m in measured.items()}
    quiet = _together([measure_quiet(runs, QUIET_STEPS, rng) for rng in generators])
    geometry = {}
    for i, (name, (layout, _)) in enumerate(GEOMETRY.items()):
        fixes = _together([measure_fixes(layout, runs, np.random.default_rng([seed, i])) for seed in seeds])
        geometry[name] = (fixes, {tracker: follow(TRACKED[tracker], fixes) for tracker in (FUSED, RIVAL)})
    split = mean_input_errors(ImmMie(), measured[1], NOISY_SPAN_S)
    return Trials(positions, geometry, {s: quiet_alarms(s, quiet) for s in (6, 4)}, split, len(seeds))


def _together(parts: Sequence[Measured]) -> Measured:
    """Runs of all seeds as one batch; the path's acceleration is the same in all."""
    whole = (np.concatenate(arrays) for arrays in zip(*parts, strict=True))
    return Measured(*whole)._replace(acceleration=parts[0].acceleration)


def _summary(record: Record, scenario: int) -> dict[str, Any]:
    """Per phase: position RMSE [m], acceleration RMSE and eastward bias [m/s²], the first filter's probability."""
    spans = PHASES[scenario].values()
    return {
        "rmse_m": [record.rmse(span) for span in spans],
        "acceleration_rmse_m_s2": [record.acceleration_rmse(span) for span in spans],
        "bias_m_s2": [mean_error(record, span) for span in spans],
        "first_filter": [long_share(record, span) for span in spans],
    }


def print_imm_mie(result: Mapping[str, Any]) -> str:
    """The result of `reproduce_imm_mie` as text (Markdown)."""
    return IMM_MIE.words(result)


def _sections(result: Mapping[str, Any]) -> dict[str, str]:
    """The tables: text per head."""
    return {
        **{f"Scenario {k}": _scenario_words(result, k) for k in PHASES},
        "Passive stations": _geometry_words(result),
    }


def _scenario_words(result: Mapping[str, Any], scenario: int) -> str:
    """One row per figure and tracker, the specification's beside ours."""
    found = result["positions"][str(scenario)]
    rows = []
    for name, paper in zip((FUSED, RIVAL), RMSE_M[scenario], strict=True):
        rows += _pair(f"{name}: position RMSE [m]", paper, found[name]["rmse_m"])
    if scenario == 1:
        for name, paper in zip((FUSED, RIVAL), BIAS_M_S2, strict=True):
            rows += _pair(f"{name}: bias of the eastward acceleration [m/s²]", paper, found[name]["bias_m_s2"])
    rows += _pair(f"{FUSED}: probability of the long window", LONG_SHARE[scenario], found[FUSED]["first_filter"])
    for name in (FUSED, RIVAL):
        rows.append((f"{name}: acceleration RMSE [m/s²]", "ours", *found[name]["acceleration_rmse_m_s2"]))
    rows += [
        (f"{name}: position RMSE [m]", "ours", *f["rmse_m"]) for name, f in found.items() if name not in (FUSED, RIVAL)
    ]
    spans = [f"{phase}, {span[0]}–{span[1]} s" for phase, span in PHASES[scenario].items()]
    return markdown_table(("figure", "of", *spans), rows)


def _pair(figure: str, paper: Sequence[float], ours: Sequence[float]) -> list[tuple[Any, ...]]:
    return [(figure, "specification", *paper), ("", "ours", *ours)]


def _geometry_words(result: Mapping[str, Any]) -> str:
    """One row per layout: specification / ours."""
    header = ("stations", *(f"{what} [m]" for what in ("fix", "CV", "turn", "IMM3's turn")))
    rows = [
        (name, *(f"{paper} / {ours:.0f}" for paper, ours in zip(GEOMETRY[name][1], row, strict=True)))
        for name, row in result["geometry"].items()
    ]
    return "Root mean square errors, specification (40 runs) / ours:\n\n" + markdown_table(header, rows)


IMM_MIE = Paper(
    "imm-mie",
    "Modified input estimation in an IMM (Sheng et al. 2009)",
    reproduce_imm_mie,
    _sections,
    {
        PAPER: "Sentences of section 4 and of the abstract; their only number is the windows' equal weight.",
        SPEC: "The specification's own Monte Carlo, 200 runs on positions and 40 on fixes of passive stations.",
    },
)
