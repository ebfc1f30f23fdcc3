"""Xu and Wang (2009), tracking with range sums in passive radar: sections 3.1 to 3.4 repeated, their claims judged.

`monte_carlo` simulates, `geometry` computes what the sites decide, `claims` judges, `pictures` draws; this module puts
the result together. What the specification adds (dilution, ghost rule, bounds, headroom) is repeated with it.
Specification: "T^n-R passive radar tracking with range sums".
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from agents.reproduction.passive_radar import geometry
from agents.reproduction.passive_radar.claims import (
    DAMPINGS,
    INFLATIONS,
    LAYOUTS,
    MOVED,
    UNDAMPED,
    Trials,
    all_claims,
    record_span,
)
from agents.reproduction.passive_radar.monte_carlo import (
    GUESS,
    PAIR,
    PAIR_GUESSES,
    PAIR_PRIOR_STD,
    PAIR_TARGET,
    PLAIN,
    PLAIN_STARTS,
    PRIOR,
    START_SCANS,
    TARGET,
    Flights,
    Record,
    fly,
    follow,
    follow_literal_start,
    follow_wording,
    gaussian,
    level_turn,
    paper_maneuver,
)
from agents.reproduction.passive_radar.pictures import all_pictures
from agents.reproduction.report import PAPER, SPEC, Paper, markdown_table, prepare, write_reproduction
from trackers import RangeSumEkf

__all__ = ["PASSIVE_RADAR", "print_passive_radar", "reproduce_passive_radar", "run_trials"]

LOOSE_CLIMB = gaussian(GUESS, [20e3, 20e3, 20e3, 200.0, 200.0, 100.0])
"""P₀ with which the plain filter's height diverges."""


def reproduce_passive_radar(
    runs: int = 50, seeds: Sequence[int] = (0, 1, 2, 3), out: Path | None = None
) -> dict[str, Any]:
    """Repeat the paper's simulations and what the specification computes, and judge the claims.

    Args:
        runs: Monte Carlo runs per seed (the paper and the specification: 50 in all).
        seeds: one generator each.
        out: folder for `reproduction.json`, `reproduction.md` and the pictures; None writes nothing.
    Returns:
        plain data: settings, layouts, maneuver, starts, claims.
    Raises:
        ValueError: runs or seeds that leave nothing to compute.
    """
    prepare(runs, seeds, out)
    trials = run_trials(runs, seeds)
    result = {
        "paper": "Xu and Wang (2009), target tracking in passive radar by range sums, sections 3.1 to 3.4",
        "settings": {"runs": runs, "seeds": list(seeds)},
        "layouts": {name: _straight_row(trials, name) for name in LAYOUTS},
        "maneuver": {f"{name}, N = {n}": record_span(r) for (name, n), r in trials.burning.items()},
        "starts": {f"{way}, {target}": ends._asdict() for (way, target), ends in trials.ends.items()},
        "claims": all_claims(trials, np.random.default_rng([*seeds, runs])),
    }
    if out is not None:
        write_reproduction(Path(out), result, print_passive_radar(result), all_pictures(trials))
    return result


def _straight_row(trials: Trials, layout: str) -> dict[str, list[float]]:
    """Horizontal RMS [m] at `SHOWN_S` by way of following, and the posterior bound."""
    rows = {way: r.rms()[[*SHOWN_S]].tolist() for (name, way), r in trials.straight.items() if name == layout}
    return {**rows, "posterior bound": geometry.bound(LAYOUTS[layout])[0][[*SHOWN_S]].tolist()}


SHOWN_S = (20, 50, 100, 200, 300, 450, 600)


# -- all trials -------------------------------------------------------------------------------------------------------


def run_trials(runs: int, seeds: Sequence[int]) -> Trials:
    """All ways of following on the same flights of each scenario; each seed has its own generator."""
    generators = [np.random.default_rng(seed) for seed in seeds]

    def flown(start, maneuver: np.ndarray | float = 0.0) -> Flights:
        return _together([fly(rng, np.array(start), runs, maneuver) for rng in generators])

    straight, burning, turning = flown(TARGET), flown(TARGET, paper_maneuver()), flown(TARGET, level_turn())
    pair, high = flown(PAIR_TARGET), flown([5e3, 5e3, 10e3, 100.0, 200.0, 0.0])
    straight_records = {name: _straight_records(name, straight) for name in LAYOUTS}
    true_guess = gaussian(PAIR_GUESSES["true"], PAIR_PRIOR_STD)
    rng = np.random.default_rng([*seeds, 1])
    return Trials(
        straight={(name, way): record for name in LAYOUTS for way, record in straight_records[name].items()},
        burning={(name, n): follow(_testing(n), LAYOUTS[name], burning, PRIOR) for name in LAYOUTS for n in _TESTS},
        wording={
            (name, n): follow_wording(_testing(n), LAYOUTS[name], burning, PRIOR)
            for name in LAYOUTS
            for n in INFLATIONS
        },
        turning={(name, n): follow(_testing(n), LAYOUTS[name], turning, PRIOR) for name in LAYOUTS for n in (0, 100)},
        pair={
            name: follow(RangeSumEkf(), PAIR, pair, gaussian(guess, PAIR_PRIOR_STD))
            for name, guess in PAIR_GUESSES.items()
        },
        raised={
            "10 km": follow(PLAIN, PAIR, high, true_guess, 1),
            "0 km": follow(PLAIN, PAIR, pair, true_guess, 1),
        },
        literal={
            (name, damping): follow_literal_start(sites, straight, GUESS, damping, START_SCANS)
            for name, sites in LAYOUTS.items()
            for damping in (UNDAMPED, *DAMPINGS)
        },
        flights={"straight": straight, "burning": burning, "pair": pair},
        ends=_all_ends(rng),
        pools=geometry.pair_choices(),
        triples=geometry.triples(),
        moved={
            name: (straight_records[name]["batch"], follow(PLAIN, moved, straight, PRIOR))
            for name, (moved, _, _) in MOVED.items()
        },
        seeds=len(seeds),
    )


_TESTS = (0, *INFLATIONS)


def _testing(inflation: int) -> RangeSumEkf:
    """The filter with the test and this N; 0: without."""
    return RangeSumEkf(inflation=float(inflation)) if inflation else PLAIN


def _straight_records(name: str, flights: Flights) -> dict[str, Record]:
    plain = {way: follow(PLAIN, LAYOUTS[name], flights, prior, 1) for way, prior in PLAIN_STARTS.items()}
    return {
        "batch": follow(PLAIN, LAYOUTS[name], flights, PRIOR),
        "batch, with test": follow(RangeSumEkf(), LAYOUTS[name], flights, PRIOR),
        **plain,
        "vz 100 m/s": follow(PLAIN, LAYOUTS[name], flights, LOOSE_CLIMB, 1),
    }


def _all_ends(rng: np.random.Generator) -> dict[tuple[str, str], geometry.Ends]:
    """Where starts on the grid end, by way of starting and target."""
    found = {}
    for name, target in geometry.GHOST_TARGETS.items():
        for damping in (1e-3, 1e-2, 1.0):
            found[f"λ = {damping:g}", name] = geometry.scan_ends(target, damping)
        found["plain filter", name] = geometry.filter_ends(target, rng, batch=False)
        found["batch and filter", name] = geometry.filter_ends(target, rng, batch=True)
    return found


def _together(parts: Sequence[Flights]) -> Flights:
    """Runs of all seeds as one batch."""
    return Flights(*(np.concatenate(arrays) for arrays in zip(*parts, strict=True)))


# -- words ------------------------------------------------------------------------------------------------------------


def print_passive_radar(result: Mapping[str, Any]) -> str:
    """The result of `reproduce_passive_radar` as text (Markdown)."""
    return PASSIVE_RADAR.words(result)


def _sections(result: Mapping[str, Any]) -> dict[str, str]:
    """The tables: text per head."""
    header = ("followed by", *(f"{s} s" for s in SHOWN_S))
    sections = {
        f"Layout {name}, horizontal RMS [m]": markdown_table(header, [(way, *row) for way, row in rows.items()])
        for name, rows in result["layouts"].items()
    }
    maneuver = [(name, error) for name, error in result["maneuver"].items()]
    sections["Maneuver"] = "N = 0: without the test.\n\n" + markdown_table(
        ("layout", "RMS, mean of 450 to 560 s [m]"), maneuver
    )
    starts = [(name, e["converged"], e["sign"], e["nearest"], e["count"]) for name, e in result["starts"].items()]
    sections["True or ghost"] = markdown_table(
        ("start", "converged", "on the side of det H", "at the nearer solution", "of"), starts
    )
    return sections


PASSIVE_RADAR = Paper(
    "passive-radar",
    "Range sums of passive radar (Xu and Wang 2009)",
    reproduce_passive_radar,
    _sections,
    {
        PAPER: "Sentences of sections 3.1, 3.2 and 3.4. What they leave open, above all P₀, decides some of them.",
        SPEC: "The specification's own Monte Carlo of 50 runs, bounds and closed forms.",
    },
)
