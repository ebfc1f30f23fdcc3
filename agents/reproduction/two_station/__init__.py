"""Xiu et al. (2002), two direction finders and three targets: section 3 repeated, its claims judged.

`monte_carlo` simulates, `claims` judges, `pictures` draws; this module puts the result together.
Specification: "two-station direction-finding, multi-target tracking with range-parameterised EKFs".
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from agents.reproduction.report import PAPER, SPEC, Paper, markdown_table, prepare, write_reproduction
from agents.reproduction.two_station.claims import SCORE_LIMITS, SPECIFIED_BOUNDS_KM, all_claims
from agents.reproduction.two_station.monte_carlo import (
    READINGS,
    TABLE_1_KM,
    UPDATES,
    Reading,
    Record,
    Study,
    draw_seeds,
    study,
    table_1_errors,
    table_1_score,
)
from agents.reproduction.two_station.pictures import all_pictures
from agents.resampling import bootstrap_means, mean_interval

__all__ = ["READINGS", "TWO_STATION", "print_report", "reproduce_two_station", "table_1_errors", "table_1_score"]


FOLLOWED = {
    "paper": ("paper's filter", "unlabelled"),
    "paper_labelled": ("paper's filter", "labelled"),
    "fused": ("both stations, EKF from the cross-fix", "unlabelled"),
    "fused_labelled": ("both stations, EKF from the cross-fix", "labelled"),
    "bank": ("both stations, this package's bank", "unlabelled"),
}
"""Records of a `Study` in words: filter, bearings."""


def score_of(record: Record, seeds: int, rng: np.random.Generator) -> dict[str, Any]:
    """Table 1 score of each seed, their mean, and its interval from the bootstrap's standard deviation.

    A resample's score is biased upwards (it holds the noise of two draws), so its percentiles would be too.
    """
    errors = by_seed(np.abs(record.range_error[:, UPDATES]), seeds)
    per_seed = table_1_score(errors.mean(1))
    mean, half = float(per_seed.mean()), 1.96 * float(table_1_score(bootstrap_means(errors, rng)).mean(-1).std())
    return {"per_seed": per_seed.tolist(), "mean": mean, "interval": [mean - half, mean + half]}


def final_of(record: Record, seeds: int, rng: np.random.Generator) -> dict[str, Any]:
    """Range error at the last update per target [km]: mean with interval, RMS, median, bias; and its mean over time."""
    error = record.range_error / 1e3
    final, interval = error[:, -1], mean_interval(by_seed(np.abs(error[:, -1]), seeds), rng)
    return {
        "mean_km": np.abs(final).mean(0).tolist(),
        "interval_km": [end.tolist() for end in interval],
        "rms_km": np.sqrt((final**2).mean(0)).tolist(),
        "median_km": np.median(np.abs(final), axis=0).tolist(),
        "bias_km": final.mean(0).tolist(),
        "time_mean_km": float(np.abs(error[:, 1:]).mean()),
        "own_bearing_share": float(record.own[:, 1:].mean()),
    }


def by_seed(values: np.ndarray, seeds: int) -> np.ndarray:
    """[seeds · runs, ...] as [seeds, runs, ...]."""
    return values.reshape(seeds, -1, *values.shape[1:])


def reproduce_two_station(
    runs: int = 50, seeds: Sequence[int] = (0, 1, 2, 3), out: Path | None = None
) -> dict[str, Any]:
    """Repeat the paper's Monte Carlo, the fused baseline and the bounds, and judge the paper's claims.

    Args:
        runs: Monte Carlo runs per seed (the paper: 50).
        seeds: one generator each; scores are averaged over them.
        out: folder for `reproduction.json`, `reproduction.md` and the pictures; None writes nothing.
    Returns:
        plain data: settings, scores, table_1, final, bounds, claims.
    Raises:
        ValueError: runs or seeds that leave nothing to compute.
    """
    prepare(runs, seeds, out)
    noise, rng = draw_seeds(seeds, runs), np.random.default_rng([*seeds, runs])
    studies = {name: study(reading, noise) for name, reading in READINGS.items()}
    result = {
        "paper": "Xiu, He, Wang and Xiu (2002), Acta Electronica Sinica 30(12), 1763–1767, section 3",
        "settings": {"runs": runs, "seeds": list(seeds), "readings": {n: _settings(r) for n, r in READINGS.items()}},
        "scores": {name: _scores(name, one, len(seeds), rng) for name, one in studies.items()},
        "table_1": _table_1(studies, len(seeds), rng),
        "final": {name: _finals(one, len(seeds), rng) for name, one in studies.items()},
        "bounds": {name: _bounds(one) for name, one in studies.items()},
    }
    result["claims"] = all_claims(studies, result, noise, rng)
    if out is not None:
        write_reproduction(Path(out), result, print_report(result), all_pictures(studies))
    return result


def _settings(reading: Reading) -> dict[str, Any]:
    tracker, course = reading.tracker, reading.course
    return {
        "process_noise_m_s": tracker.process_noise,
        "velocity_std_m_s": tracker.velocity_std,
        "radial_speed_m_s": tracker.radial_speed,
        "hypotheses": tracker.hypotheses,
        "prune_below": tracker.prune_below,
        "target_heading_deg": course.target_heading_deg,
        "target_sense": course.target_sense,
        "station_sense": course.station_sense,
    }


def _scores(name: str, one: Study, seeds: int, rng: np.random.Generator) -> dict[str, Any]:
    own = score_of(one.paper, seeds, rng)
    return {"limit": SCORE_LIMITS[name], **own, "labelled": score_of(one.paper_labelled, seeds, rng)}


def _table_1(studies: Mapping[str, Study], seeds: int, rng: np.random.Generator) -> list[dict[str, Any]]:
    """One row per update: the paper's values and each reading's mean |range error| with its interval [km]."""
    rows: list[dict[str, Any]] = [
        {"update": int(update), "paper_km": paper.tolist()} for update, paper in zip(UPDATES, TABLE_1_KM, strict=True)
    ]
    for name, one in studies.items():
        errors = np.abs(one.paper.range_error[:, UPDATES]) / 1e3
        low, high = mean_interval(by_seed(errors, seeds), rng)
        for i, row in enumerate(rows):
            row[name] = {"mean_km": errors[:, i].mean(0).tolist(), "interval_km": [low[i].tolist(), high[i].tolist()]}
    return rows


def _finals(one: Study, seeds: int, rng: np.random.Generator) -> dict[str, Any]:
    return {kind: final_of(getattr(one, kind), seeds, rng) for kind in FOLLOWED}


def _bounds(one: Study) -> dict[str, Any]:
    """Bounds at the last update and their mean over targets and updates [km]."""
    return {
        name: {"final_km": (bound[-1] / 1e3).tolist(), "time_mean_km": float(bound[1:].mean() / 1e3)}
        for name, bound in one.bounds.items()
    }


# -- in words --------------------------------------------------------------------------------------------------------


def print_report(result: Mapping[str, Any]) -> str:
    """The result of `reproduce_two_station` as text: Table 1 beside ours, scores, finals, bounds, claims (Markdown)."""
    return TWO_STATION.words(result)


def _sections(result: Mapping[str, Any]) -> dict[str, str]:
    """The tables: text per head."""
    return {
        "Table 1: mean |range error|": _table_1_words(result["table_1"]),
        "Score: mean |ln(ours / paper)| over 51 entries": _scores_words(result["scores"]),
        "Range error at update 45": _final_words(result["final"]),
        "Posterior Cramér–Rao bound on range, update 45": _bounds_words(result["bounds"]),
    }


def _table_1_words(rows: Sequence[Mapping[str, Any]]) -> str:
    names = list(READINGS)
    cells = [(row["update"], row["paper_km"], *(row[name]["mean_km"] for name in names)) for row in rows]
    return markdown_table(("update", "paper", *names), cells)


def _scores_words(scores: Mapping[str, Any]) -> str:
    rows = [
        (name, s["mean"], s["limit"], s["per_seed"], f"{s['interval'][0]:.3f} to {s['interval'][1]:.3f}",
         s["labelled"]["mean"])
        for name, s in scores.items()
    ]  # fmt: skip
    return markdown_table(("reading", "score", "limit", "each seed", "95 % interval", "with labelled bearings"), rows)


def _final_words(final: Mapping[str, Any]) -> str:
    rows = [
        (reading, *FOLLOWED[kind], f["mean_km"], f["median_km"], f["rms_km"], f["bias_km"], f["time_mean_km"],
         100.0 * f["own_bearing_share"])
        for reading, kinds in final.items() for kind, f in kinds.items()
    ]  # fmt: skip
    header = ("reading", "filter", "bearings", "mean", "median", "RMS", "bias", "time mean", "own bearings %")
    return markdown_table(header, rows)


def _bounds_words(bounds: Mapping[str, Any]) -> str:
    rows = [
        (reading, name, b["final_km"], SPECIFIED_BOUNDS_KM[name][0] if reading == "NATURAL" else None,
         b["time_mean_km"], SPECIFIED_BOUNDS_KM[name][1] if reading == "NATURAL" else None)
        for reading, kinds in bounds.items() for name, b in kinds.items()
    ]  # fmt: skip
    return markdown_table(("reading", "stations", "ours", "specification", "time mean", "specification "), rows)


TWO_STATION = Paper(
    "two-station",
    "Two stations, bearings only, three targets (Xiu et al. 2002)",
    reproduce_two_station,
    _sections,
    {
        PAPER: (
            "Table 1, and sentences of sections 3 and 4. Headings, senses of turn, process noise and more are not "
            "given: a claim that is not reproduced is not reproduced in the reading that it names."
        ),
        SPEC: (
            "What the specification computes from the paper's scenario and concludes from Table 1, and how near to "
            "Table 1 a reading shall come, a threshold of this project's."
        ),
    },
    "NATURAL and BESTFIT are two readings of what the paper leaves open. Errors in km, T1 / T2 / T3.",
)
