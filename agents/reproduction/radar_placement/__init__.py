"""Yang et al. (1998), where to put two radars: section 3's curves and section 4's Monte Carlo repeated and judged.

`scenario` simulates, `claims` judges, `pictures` draws; this module puts the result together. What the specification
adds is repeated with it: corrected equations, the place of evaluation, what placement can gain beyond two radars.
Specification: "Where to put two 3-D radars for long-range air tracking".
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from agents.reproduction.radar_placement.claims import (
    MONTE_CARLO,
    PAIRS,
    SINGLE,
    STUDIED,
    THEORY,
    THEORY_M,
    Trials,
    all_claims,
)
from agents.reproduction.radar_placement.pictures import all_pictures
from agents.reproduction.radar_placement.scenario import (
    Runs,
    draw_runs,
    error_ratio,
    follow,
    nees_at_measurement,
    pair,
    ring,
)
from agents.reproduction.report import PAPER, SPEC, Paper, markdown_table, prepare, write_reproduction
from trackers.converted_episode import LINEARISATIONS

__all__ = ["RADAR_PLACEMENT", "print_radar_placement", "reproduce_radar_placement", "run_trials"]


def reproduce_radar_placement(
    runs: int = 500, seeds: Sequence[int] = (0, 1, 2, 3), out: Path | None = None
) -> dict[str, Any]:
    """Repeat theory and Monte Carlo, and judge the claims.

    Args:
        runs: Monte Carlo runs per seed (the paper: 50 in all; the specification advises 500).
        seeds: one generator each.
        out: folder for `reproduction.json`, `reproduction.md` and the pictures; None writes nothing.
    Returns:
        plain data: settings, layouts, linearisations, claims.
    Raises:
        ValueError: runs or seeds that leave nothing to compute.
    """
    prepare(runs, seeds, out)
    trials = run_trials(runs, seeds)
    single = trials.pairs[SINGLE].rmse()
    result = {
        "paper": "Yang et al. (1998), tracking accuracy of a long-range target with several sensors, sections 3 and 4",
        "settings": {"runs": runs, "seeds": list(seeds)},
        "layouts": {
            name: {"theory": float(error_ratio(pair(*angles))), "monte_carlo": trials.pairs[name].rmse() / single}
            for name, angles in PAIRS.items()
        },
        "linearisations": {
            linearisation: {
                name: {"rmse_m": record.rmse(), "nees": float(record.nees.mean())}
                for (name, used), record in trials.studied.items()
                if used == linearisation
            }
            for linearisation in LINEARISATIONS
        },
        "claims": all_claims(trials, np.random.default_rng([*seeds, runs])),
    }
    if out is not None:
        write_reproduction(Path(out), result, print_radar_placement(result), all_pictures(trials))
    return result


def run_trials(runs: int, seeds: Sequence[int]) -> Trials:
    """All layouts and linearisations on the same paths and noise; each seed has its own generator."""
    drawn = [draw_runs(runs, np.random.default_rng(seed)) for seed in seeds]
    every = Runs(*(np.concatenate(parts) for parts in zip(*drawn, strict=True)))
    pairs = {name: follow(every, pair(*angles)) for name, angles in PAIRS.items()}
    pairs[SINGLE] = follow(every, ring([0.0]))
    studied = {
        (name, linearisation): follow(every, layout, linearisation)
        for name, layout in STUDIED.items()
        for linearisation in LINEARISATIONS
    }
    raw = {name: nees_at_measurement(every, STUDIED[name]) for name in THEORY_M}
    return Trials(pairs, studied, raw, len(seeds))


def print_radar_placement(result: Mapping[str, Any]) -> str:
    """The result of `reproduce_radar_placement` as text (Markdown)."""
    return RADAR_PLACEMENT.words(result)


def _sections(result: Mapping[str, Any]) -> dict[str, str]:
    """The tables: text per head."""
    return {
        "Two radars": _pair_words(result),
        "Where bias and R are evaluated": _linearisation_words(result),
    }


def _pair_words(result: Mapping[str, Any]) -> str:
    """One row per layout: ratio of the position error to one radar's, the specification's beside ours."""
    told = {place: ratio for rows in THEORY.values() for place, ratio in rows}
    header = ("layout", "theory, specification", "theory, ours", "Monte Carlo, specification", "Monte Carlo, ours")
    rows = [
        (name, told[PAIRS[name]], found["theory"], MONTE_CARLO[name], found["monte_carlo"])
        for name, found in result["layouts"].items()
    ]
    return "Position error over one radar's:\n\n" + markdown_table(header, rows)


def _linearisation_words(result: Mapping[str, Any]) -> str:
    """One row per place of evaluation: RMSE and NEES of each layout."""
    rows = [
        (name, *(f"{at['rmse_m']:.0f} ({at['nees']:.1f})" for at in found.values()))
        for name, found in result["linearisations"].items()
    ]
    return "Position RMSE [m] of the last ten scans (NEES, ideal 6):\n\n" + markdown_table(("at", *STUDIED), rows)


RADAR_PLACEMENT = Paper(
    "radar-placement",
    "Where to put two radars (Yang et al. 1998)",
    reproduce_radar_placement,
    _sections,
    {
        PAPER: "Sentences of sections 3 and 5; their only numbers are angles, and 70 and 50 % of one radar's error.",
        SPEC: "The specification's own theory, and its Monte Carlo of 50 to 3000 runs.",
    },
)
