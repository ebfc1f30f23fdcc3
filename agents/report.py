"""What an evaluation leaves behind: JSON, CSV, Markdown and pictures, none of them ever half-written."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from agents import pictures
from agents.files import atomic_write, save_figure, write_json, write_text
from agents.maneuvers import Maneuvers, maneuvers
from agents.outcomes import COLLAPSE_M, LATE_ERROR_M, LATE_STEPS, Record, nees_scale, steps_axis
from agents.pictures import EpisodePaths
from agents.placement_pictures import placement_maps
from passive_env.catalogue.maneuvering import ManeuveringTarget
from passive_env.catalogue.mobile_placement import MobilePlacement
from passive_env.catalogue.passive_radar import PassiveRadar
from passive_env.catalogue.placement import RadarPlacement

METRICS = {"final": "final", "mean": "time average"}
"""The errors that are compared, and their names in tables."""
MANEUVERS = {"turn_position_error_m": "while maneuvering", "mean_acceleration_error_m_s2": "acceleration"}
"""What is compared besides where targets are known to maneuver, and its names."""
SCORED = {"scored_position_error_m": "last scans"}
"""The error by which an episode of placement is scored, and its name."""
LEVEL = {
    "mean_horizontal_error_m": "horizontal average", "settled_horizontal_error_m": "settled",
    "mean_height_error_m": "height average",
}  # fmt: skip
"""Averages of errors in the plane, of all steps and of a settled track's, and of height errors, and their names."""
ZONES = {"standoff_share": "in rings", "nogo_share": "in discs"}
"""Shares of the steps, shown where any policy enters a stand-off ring or a no-go disc."""
HEADLINES = {
    ManeuveringTarget: "turn_position_error_m",
    MobilePlacement: "mean_position_error_m",
    PassiveRadar: "mean_position_error_m",
}
"""The error by which policies are ranked, where it is not the final one: that during maneuvers (the time average, if
not even half of the episodes have any), and the time average where every step counts alike."""

VERDICTS = ("ahead", "level", "behind")
"""Whether the interval of a ratio lies below 1, holds it, or lies above."""


def headline(scenario: Any, shares: Mapping[str, float]) -> str:
    """Name of the error by which policies are ranked; shares: of episodes that have each, by name."""
    usual, average, *_ = shares
    wanted = next((name for family, name in HEADLINES.items() if isinstance(scenario, family)), usual)
    return wanted if shares.get(wanted, 0.0) > 0.5 else average


def verdict(ci95: Sequence[float]) -> str:
    """Of a ratio's interval; see `VERDICTS`."""
    low, high = ci95
    return "ahead" if high < 1.0 else "behind" if low > 1.0 else "level"


def write_evaluation(out: Path, summary: dict[str, Any], records: Mapping[str, Record], scenario: Any) -> list[Path]:
    """Write ``evaluation.json``, ``.csv``, ``.md`` and the pictures into a folder; returns the files."""
    title = f"{summary['environment']}, {summary['episodes']} episodes"
    times = steps_axis(scenario)
    score = summary["score"]
    over_time = pictures.error_over_time(
        times,
        {name: record.error_m.mean(0) for name, record in records.items()},
        {name: record.bound_m.mean(0) for name, record in records.items()},
        title,
        score,
    )
    return [
        write_json(out / "evaluation.json", summary),
        atomic_write(out / "evaluation.csv", as_csv(summary)),
        write_text(out / "evaluation.md", as_markdown(summary)),
        save_figure(out / f"{score}_error_over_time.png", over_time),
        *(save_figure(out / name, figure) for name, figure in _of_geometry(title, records, scenario, times)),
    ]


def _of_geometry(title: str, records: Mapping[str, Record], scenario: Any, times: Any) -> list[tuple[str, Any]]:
    """File names and figures of what the policies did."""
    paths = flown_paths(records, scenario)
    if isinstance(scenario, RadarPlacement):
        return [("placement.png", placement_maps(paths, scenario, f"{title}: the first one"))]
    geometry = pictures.geometry(times, paths, f"{title}: the first one")
    if not has_courses(scenario):
        return [("geometry.png", geometry)]
    platform = "the reference station's courses" if scenario.stations > 1 else "courses"
    return [
        ("geometry.png", geometry),
        ("maneuvers.png", maneuvers(times, courses(records), f"{title}: {platform} and legs")),
    ]


def flown_paths(records: Mapping[str, Record], scenario: Any) -> dict[str, Any]:
    """What every policy did in the first episode, as it is drawn."""
    paths: dict[str, Any] = {name: record.paths for name, record in records.items()}
    if isinstance(scenario, MobilePlacement):
        return {name: _installed(path) for name, path in paths.items()}
    return paths


def has_courses(scenario: Any) -> bool:
    """Whether platforms fly courses that a policy decides."""
    return not isinstance(scenario, (RadarPlacement, MobilePlacement)) and scenario.moves


def courses(records: Mapping[str, Record]) -> dict[str, Maneuvers]:
    """How every policy's last platform flew, in all episodes."""
    return {name: Maneuvers(record.off_sight_rad[..., -1], record.turns[..., -1]) for name, record in records.items()}


def _installed(paths: EpisodePaths) -> EpisodePaths:
    """Paths of sensors that stand, at first, where they are installed in the first step."""
    return paths._replace(stations=np.concatenate([paths.stations[1:2], paths.stations[1:]]))


def as_csv(summary: Mapping[str, Any]) -> str:
    """One row per policy, one column per figure."""
    rows = [{"policy": name, **flatten(figures)} for name, figures in summary["policies"].items()]
    for row in rows:
        for base, ratios in summary["ratios"].items():
            for metric in metrics_of(summary):
                ratio = ratios.get(row["policy"], {}).get(metric)
                low, high = ratio["ci95"] if ratio else (None, None)
                name = f"{metric}_over_{base}"
                row |= {name: ratio and ratio["ratio"], f"{name}_low": low, f"{name}_high": high}
    buffer = io.StringIO()
    writer = csv.DictWriter(buffer, fieldnames=list(rows[0]))
    writer.writeheader()
    writer.writerows(rows)
    return buffer.getvalue()


def metrics_of(summary: Mapping[str, Any]) -> dict[str, str]:
    """Errors that count, and their names in tables."""
    shown = next(iter(summary["policies"].values()))
    counted = {f"{when}_{summary['score']}_error_m": words for when, words in METRICS.items()}
    return counted | {name: words for name, words in (SCORED | MANEUVERS | LEVEL).items() if name in shown}


def flatten(figures: Mapping[str, Any]) -> dict[str, Any]:
    """Figures in one level, as columns of a table: the names of both levels joined by an underscore."""
    flat: dict[str, Any] = {}
    for name, value in figures.items():
        if isinstance(value, list):
            value = dict(zip(("low", "high"), value, strict=True))
        flat |= {f"{name}_{key}": v for key, v in value.items()} if isinstance(value, Mapping) else {name: value}
    return flat


def as_markdown(summary: Mapping[str, Any]) -> str:
    """The comparison as two tables: figures of every policy, then ratios of means with 95 % intervals."""
    return "\n".join([*_figures_table(summary), "", _note(summary), "", *_ratios_table(summary)])


def _figures_table(summary: Mapping[str, Any]) -> list[str]:
    policies, in_space = summary["policies"], summary["score"] == "position"
    zones = [name for name in ZONES if any(figures[name] > 0.0 for figures in policies.values())]
    _, _, *more = metrics_of(summary).items()
    head = ["policy", "final mean", "median", "p95", "time average", *(words for _, words in more)]
    head += ["average median", "average p95", "lost late", "range final", "range average"] if in_space else []
    head += ["bound", "lost", "collapsed", "NEES mean / median", *(ZONES[name] for name in zones), "µs/decision"]
    rows = []
    for name, figures in policies.items():
        final, mean, *rest = (figures[metric] for metric in metrics_of(summary))
        cells = [name, f"{final['mean']:.0f}", f"{final['median']:.0f}", f"{final['p95']:.0f}", f"{mean['mean']:.0f}"]
        cells += [f"{figure['mean']:.3g}" for figure in rest]
        if in_space:
            ranges = (figures[f"{when}_range_error_m"]["mean"] for when in METRICS)
            cells += [
                f"{mean['median']:.0f}",
                f"{mean['p95']:.0f}",
                percent(figures["lost_late_share"]),
                *(f"{value:.0f}" for value in ranges),
            ]
        bound = figures[f"final_{summary['score']}_crlb_m"]
        cells += [f"{bound:.0f}", percent(figures["lost_share"])]
        nees = figures["final_nees"]
        cells += [percent(figures["collapse_share"]), f"{nees['mean']:.1f} / {nees['median']:.1f}"]
        cells += [*(percent(figures[zone]) for zone in zones), f"{figures['decision_time_us']:.2f}"]
        rows.append(cells)
    return table(head, rows)


def _ratios_table(summary: Mapping[str, Any]) -> list[str]:
    """A row per policy and error that counts, and for positions one of lost tracks; one column per baseline."""
    bases = list(summary["ratios"])
    rows = []
    for name in summary["policies"]:
        compared = [summary["ratios"][base].get(name) for base in bases]
        for metric, words in metrics_of(summary).items():
            rows.append([name, words, *(_ratio_cell(ratios, metric) for ratios in compared)])
        if summary["score"] == "position":
            rows.append([name, "lost late, less base", *(_difference_cell(ratios) for ratios in compared)])
    return table(["policy", "error", *(f"/ {base}" for base in bases)], rows)


def table(head: list[str], rows: list[list[str]]) -> list[str]:
    """Lines of a Markdown table."""
    lines = [head, ["---"] * len(head), *rows]
    return ["| " + " | ".join(cells) + " |" for cells in lines]


def _note(summary: Mapping[str, Any]) -> str:
    honest = nees_scale(summary["state_size"])
    return (
        f"{summary['environment']}: {summary['score']} error in metres over {summary['episodes']} paired episodes from "
        f"seed {summary['seed']}, mean over targets. {_late_note(summary)}"
        f"{_scored_note(summary)}{_maneuver_note(summary)}{_level_note(summary)}"
        "Bound: posterior Cramér–Rao bound at the end, mean; it is a standard deviation (a mean absolute error may lie "
        "20 % below it) for targets as restless as the filter assumes (those that fly straight for long can be ranged "
        "better). Collapsed: ends more than "
        f"{COLLAPSE_M / 1e3:.0f} km off or with a NEES above {honest.collapse:.1f}, its 99.99 % quantile. NEES: at the "
        f"end; an honest tracker has mean {honest.degrees} and median {honest.median:.1f}, a cautious one less. "
        "Below: ratios of means to every baseline's, with paired bootstrap 95 % intervals."
    )


def _late_note(summary: Mapping[str, Any]) -> str:
    if summary["score"] == "range":
        return ""
    return f"Lost late: more than {LATE_ERROR_M / 1e3:.0f} km off on average over the last {LATE_STEPS} steps. "


def _scored_note(summary: Mapping[str, Any]) -> str:
    if not SCORED.keys() & metrics_of(summary).keys():
        return ""
    return "Last scans: position error over the scans that are scored (final: after the very last). "


def _maneuver_note(summary: Mapping[str, Any]) -> str:
    if not MANEUVERS.keys() & metrics_of(summary).keys():
        return ""
    return (
        "While maneuvering: position error over the steps at which the target accelerates, mean over the episodes that "
        "have any. Acceleration: error of its estimate in m/s², time average. "
    )


def _level_note(summary: Mapping[str, Any]) -> str:
    if not LEVEL.keys() & metrics_of(summary).keys():
        return ""
    return f"Settled: horizontal error averaged over the steps after the first {PassiveRadar.settled_s:g} s. "


def write_crossing(out: Path, summaries: Mapping[str, dict[str, Any]]) -> list[Path]:
    """Write ``evaluation.json`` ({"trackers": {name: summary}}) and ``.md`` of trackers crossed with policies."""
    return [
        write_json(out / "evaluation.json", {"trackers": summaries}),
        write_text(out / "evaluation.md", crossing_as_markdown(summaries)),
    ]


def crossing_as_markdown(summaries: Mapping[str, Mapping[str, Any]]) -> str:
    """Mean final error [m] and lost share, one row per policy, one column per tracker."""
    trackers, first = list(summaries), next(iter(summaries.values()))
    lines = ["| policy | " + " | ".join(trackers) + " |", "|" + "---|" * (1 + len(trackers))]
    for policy in first["policies"]:
        cells = [_crossing_cell(summaries[tracker]["policies"][policy], first["score"]) for tracker in trackers]
        lines.append(f"| {policy} | " + " | ".join(cells) + " |")
    note = (
        f"{first['environment']}: mean final {first['score']} error in metres and share of lost tracks, the same "
        f"{first['episodes']} tapes from seed {first['seed']} for every cell."
    )
    return "\n".join([*lines, "", note])


def _crossing_cell(figures: Mapping[str, Any], score: str) -> str:
    return f"{figures[f'final_{score}_error_m']['mean']:.0f} ({percent(figures['lost_share'])} lost)"


def percent(share: float) -> str:
    """A share as a percentage with two decimals."""
    return f"{100 * share:.2f} %"


def _ratio_cell(ratios: Mapping[str, Any] | None, metric: str) -> str:
    return "1" if ratios is None else ratio_words(ratios[metric])


def ratio_words(ratio: Mapping[str, Any]) -> str:
    """A ratio and its interval; a dash where both means are 0."""
    low, high = ratio["ci95"]
    return f"{ratio['ratio']:.3f} [{low:.3f}, {high:.3f}]" if math.isfinite(ratio["ratio"]) else "–"


def _difference_cell(ratios: Mapping[str, Any] | None) -> str:
    """Percentage points."""
    if ratios is None:
        return "0"
    lost = ratios["lost_late_share"]
    low, high = (100.0 * end for end in lost["ci95"])
    return f"{100.0 * lost['difference']:+.1f} [{low:+.1f}, {high:+.1f}] points"
