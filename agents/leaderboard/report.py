"""What a leaderboard leaves behind: JSON, CSV, Markdown and a picture, none of them ever half-written."""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from agents.files import atomic_write, save_figure, write_json, write_text
from agents.leaderboard.contestants import GEOMETRIES, geometry_of
from agents.leaderboard.crossed import tracker_part, varied_part
from agents.leaderboard.judged import goals_part, learned_part, open_part, verdicts_of
from agents.leaderboard.pictures import overview
from agents.leaderboard.standings import REFERENCE
from agents.leaderboard.words import (
    KIND_WORDS,
    best_of,
    listed,
    mean_words,
    metres,
    nees_words,
    ratio_words,
    ratios_of,
    rows_table,
    sections_of,
    short,
    standings_of,
    targets,
)
from agents.outcomes import COLLAPSE_M, LATE_ERROR_M, LATE_STEPS
from agents.provenance import short_commit
from agents.report import flatten, percent

PICTURE = "leaderboard.png"
SHORT_KINDS = ("greedy", "planner", "learned", "oracle")
"""Kinds whose best policy stands beside the reference in the short form."""

FIRST = " *"
"""Marks a figure of the episodes on which the best were chosen."""


def write_leaderboard(out: Path, data: Mapping[str, Any]) -> list[Path]:
    """Write ``leaderboard.json``, ``.csv``, ``.md``, the picture and ``verdicts.csv``; returns the files."""
    return [
        write_json(out / "leaderboard.json", data),
        atomic_write(out / "leaderboard.csv", as_csv(data)),
        atomic_write(out / "verdicts.csv", verdicts_csv(data)),
        write_text(out / "leaderboard.md", as_markdown(data)),
        save_figure(out / PICTURE, overview(sections_of(data, "leaderboard"))),
    ]


# -- CSV ---------------------------------------------------------------------------------------------------------------


def as_csv(data: Mapping[str, Any]) -> str:
    """One row per section, environment, standing and policy; one column per figure."""
    rows = []
    for section in data["sections"]:
        for environment, entry in standings_of(data, section):
            rows += [_csv_row(section, environment, entry, policy) for policy in entry["policies"]]
    return _csv(rows)


def verdicts_csv(data: Mapping[str, Any]) -> str:
    """One row per learned policy, courses, error and opponent; only the head where nothing learned takes part."""
    return _csv([_verdict_cells(*each) for each in verdicts_of(data)])


def _csv(rows: Sequence[Mapping[str, Any]]) -> str:
    columns = list(dict.fromkeys(name for row in rows for name in row))
    buffer = io.StringIO()
    writer = csv.DictWriter(buffer, fieldnames=columns)
    writer.writeheader()
    writer.writerows(rows)
    return buffer.getvalue()


def _verdict_cells(environment: str, entry: Mapping[str, Any], each: Mapping[str, Any]) -> dict[str, Any]:
    row = {
        "environment": environment, "title": entry["title"], "episodes": each["episodes"], "seed": each["seed"],
        "policy": each["policy"], "metric": each["metric"], "base": each["base"], "base_kind": KIND_WORDS[each["kind"]],
    }  # fmt: skip
    for what in ("mean", "p95", "oracle"):
        ratio = each[what] or {"ratio": "", "ci95": ("", "")}
        row |= {f"{what}_ratio": ratio["ratio"], f"{what}_low": ratio["ci95"][0], f"{what}_high": ratio["ci95"][1]}
    return row | {"mean_verdict": each["mean_verdict"], "p95_verdict": each["p95_verdict"], "open": each["open"]}


def _csv_row(section: str, environment: str, entry: Mapping[str, Any], policy: str) -> dict[str, Any]:
    figures = dict(entry["policies"][policy])
    ratios = figures.pop("ratios")
    row = {
        "section": section, "environment": environment, "title": entry["title"], "tracker": entry["tracker"],
        "episodes": entry["episodes"], "seed": entry["seed"], "policy": policy, "kind": figures.pop("kind"),
        "reference": entry["reference"],
    }  # fmt: skip
    for name, value in figures.items():
        if isinstance(value, Mapping) and "ci95" in value:
            value = {**value, "low": value["ci95"][0], "high": value["ci95"][1]}
            del value["ci95"]
        row |= flatten({name: value})
    for metric, pair in ratios.items():
        for what, ratio in pair.items():
            low, high = ratio["ci95"]
            name = f"{metric}_{what}_over_reference"
            row |= {name: ratio["ratio"], f"{name}_low": low, f"{name}_high": high}
    return row


# -- Markdown ----------------------------------------------------------------------------------------------------------


_BOUND = (
    "The bound is the least mean posterior Cramér–Rao bound at the end, shown where final errors are: a standard "
    "deviation, which a mean error may undercut (of a Gaussian range it is 0.8 of it), and that for targets as "
    "restless as the filter assumes. Drawn ones fly steadier, so good policies come out below it."
)


def as_markdown(data: Mapping[str, Any]) -> str:
    """The whole leaderboard; its first part is the short form."""
    parts = ["# Leaderboard", _head(data), "## In short", short_form(data), f"![Ratios to the best rule]({PICTURE})"]
    parts += [_BOUND, *learned_part(data), *open_part(data), *goals_part(data), *_full_part(data)]
    parts += [*tracker_part(data), *varied_part(data)]
    return "\n\n".join(parts)


def _head(data: Mapping[str, Any]) -> str:
    about = data["about"]
    software = ", ".join(f"{name} {version}" for name, version in about["versions"].items())
    source = f"commit {short_commit(about['commit'])}, " if about["commit"] else ""
    fields = "".join(f", {name}={value}" for name, value in about["fields"].items())
    machine = f"{about['processor']}, {about['cores']} cores, {about['platform']}"
    return (
        f"{about['episodes']:,} paired episodes per table from seed {about['seed']:,}{fields}: in every table all "
        "policies meet the same targets and noise. Intervals are 95 %, bootstrapped over episodes, those of ratios "
        f"paired. {_held_out(about)}Made on {about['date']} ({machine}; "
        f"{source}sources {about['code']}; {software}) by\n\n    {about['command']}"
    )


def _held_out(about: Mapping[str, Any]) -> str:
    """A sentence about recorded targets, if any are flown."""
    if not about["held_out"]:
        return ""
    count = "{flights} flights by {aircraft} aircraft".format(**about["held_out"])
    return (
        f"Recorded targets fly {count} that no policy was trained on, each of them many times, with other windows, "
        "places and noise: more episodes are no more flights. "
    )


def short_form(data: Mapping[str, Any]) -> str:
    """One row per environment and kind of courses: the best policy of every kind beside the best fixed one or rule."""
    confirm = data["about"]["confirm"]
    rows = [_short_row(environment, entry, confirm) for environment, entry in standings_of(data, "leaderboard")]
    again = (
        f" The best are those of the {data['about']['episodes']:,} episodes above; the figures are of {confirm:,} "
        f"others, but where marked{FIRST}."
    )
    note = (
        "Ratios to the mean error of the best fixed policy or rule, the best of every kind; below 1 is better. Paper: "
        f"the reference geometry, {listed(GEOMETRIES)}, the first one offered.{again if confirm else ''}"
    )
    return "\n".join([rows_table(rows), "", note])


def _short_row(environment: str, entry: Mapping[str, Any], confirm: int) -> dict[str, str]:
    """Cells by the names of their columns."""
    best = {kind: entry["best"].get(kind) for kind in SHORT_KINDS}
    ratios = {"paper": geometry_of(entry["policies"]), **best}
    figures = entry.get("confirmation", entry)["policies"].get(
        entry["reference"], entry["policies"][entry["reference"]]
    )
    return {
        "environment": short(environment),
        "targets": targets(entry),
        "error": entry["metrics"][entry["headline"]],
        "best fixed or rule": f"`{entry['reference']}`" if best_of(entry, REFERENCE) else "",
        "mean [m]": metres(figures[entry["headline"]]["mean"]),
        **{column: _short_ratio(entry, name, "mean", confirm) for column, name in ratios.items()},
        "p95, learned": _short_ratio(entry, best["learned"], "p95", confirm),
    }


def _short_ratio(entry: Mapping[str, Any], name: str | None, what: str, confirm: int) -> str:
    """To the reference, by the error that ranks; marked if it should be of further episodes and is not."""
    if name is None:
        return ""
    ratios, again = ratios_of(entry, name)
    return ratio_words(ratios[what]) + (FIRST if confirm and not again else "")


def _full_part(data: Mapping[str, Any]) -> list[str]:
    """All policies of every environment."""
    parts = ["## All policies", _full_note()]
    for environment, entries in sections_of(data, "leaderboard").items():
        parts.append(f"### `{environment}`")
        times = decision_times(entries)
        for entry in entries:
            parts += [_caption(entry), figures_table(entry, times)]
    return parts


def _full_note() -> str:
    return (
        "Errors in metres, means over targets; acceleration in m/s². Bound: mean posterior Cramér–Rao bound at the "
        "end of the geometry that the policy flew; the row of that name shows the least. Lost: "
        "as the scenario's `lost_error_m` and `lost_nees` say, at the end; lost late: more than "
        f"{LATE_ERROR_M / 1e3:.0f} km off on average over the last {LATE_STEPS} steps; collapsed: more than "
        f"{COLLAPSE_M / 1e3:.0f} km off at the end, or with a NEES above its 99.99 % quantile. Decision times are the "
        "least of all flights of a policy in its environment."
    )


def _caption(entry: Mapping[str, Any]) -> str:
    return (
        f"{entry['title'].capitalize()}, {entry['score']} error, tracker `{entry['tracker']}`. Ratios to "
        f"`{entry['reference']}`, the best {_reference_kind(entry)} ({entry['metrics'][entry['headline']]})."
        + "".join(f" `{name}` does not fit: {why}." for name, why in entry["unfit"].items())
    )


def _reference_kind(entry: Mapping[str, Any]) -> str:
    return "fixed policy or rule" if best_of(entry, REFERENCE) else "policy, for no fixed one or rule takes part"


def decision_times(entries: Sequence[Mapping[str, Any]]) -> dict[str, float]:
    """Of every policy [µs], the least of all its flights: other work on the machine only adds."""
    flown = [each for entry in entries for each in (entry, entry.get("confirmation", entry))]
    names = dict.fromkeys(name for each in flown for name in each["policies"])
    return {
        name: min(each["policies"][name]["decision_time_us"] for each in flown if name in each["policies"])
        for name in names
    }


def figures_table(entry: Mapping[str, Any], times: Mapping[str, float]) -> str:
    """One row per policy, then the least bound; times per decision [µs] by policy."""
    rows = [_figures_row(entry, name, figures, times[name]) for name, figures in entry["policies"].items()]
    least = dict.fromkeys(rows[0], "") | {"policy": "bound", "kind": _bound_words(entry)}
    return rows_table([*rows, least | {"bound": metres(entry["bound"]["mean"])}])


def _bound_words(entry: Mapping[str, Any]) -> str:
    return f"of `{entry['bound']['policy']}`"


def _figures_row(entry: Mapping[str, Any], name: str, figures: Mapping[str, Any], time_us: float) -> dict[str, str]:
    """Cells by the names of their columns."""
    final, average, *more = (figures[metric] for metric in entry["metrics"])
    late = {"lost late": percent(figures["lost_late_share"])} if "lost_late_share" in figures else {}
    return {
        "policy": f"`{name}`",
        "kind": figures["kind"],
        "final mean": mean_words(final),
        "median": metres(final["median"]),
        "p95": metres(final["p95"]),
        "time average": mean_words(average),
        "its p95": metres(average["p95"]),
        **{words: mean_words(each) for words, each in zip(list(entry["metrics"].values())[2:], more, strict=True)},
        "bound": metres(figures[f"final_{entry['score']}_crlb_m"]),
        "lost": percent(figures["lost_share"]),
        **late,
        "collapsed": percent(figures["collapse_share"]),
        "NEES mean / median": nees_words(figures),
        "episodes": f"{entry['episodes']:,}",
        "µs/decision": f"{time_us:,.2f}",
        **{
            f"{words} / {entry['reference']}": ratio_words(figures["ratios"][metric]["mean"])
            for metric, words in entry["metrics"].items()
        },
    }
