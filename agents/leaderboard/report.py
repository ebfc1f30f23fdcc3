"""What a leaderboard leaves behind: JSON, CSV, Markdown and a picture, none of them ever half-written."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from agents.files import atomic_write, save_figure, write_json, write_text
from agents.leaderboard.contestants import COSTLY, GEOMETRIES
from agents.leaderboard.pictures import overview
from agents.leaderboard.standings import BASES, REFERENCE
from agents.leaderboard.tried import TRIED, Tried
from agents.outcomes import COLLAPSE_M, LATE_ERROR_M, LATE_STEPS
from agents.provenance import short_commit
from agents.report import flatten, percent, table

PICTURE = "leaderboard.png"
SHORT_KINDS = ("greedy", "planner", "learned", "oracle")
"""Kinds whose best policy stands beside the reference in the short form."""


def write_leaderboard(out: Path, data: Mapping[str, Any]) -> list[Path]:
    """Write ``leaderboard.json``, ``.csv``, ``.md``, the picture and ``verdicts.csv``; returns the files."""
    return [
        write_json(out / "leaderboard.json", data),
        atomic_write(out / "leaderboard.csv", as_csv(data)),
        atomic_write(out / "verdicts.csv", verdicts_csv(data)),
        write_text(out / "leaderboard.md", as_markdown(data)),
        save_figure(out / PICTURE, overview(_sections(data, "leaderboard"))),
    ]


def _sections(data: Mapping[str, Any], section: str) -> dict[str, list[dict[str, Any]]]:
    """Standings of a section by environment; empty where it was not asked for."""
    return data["sections"].get(section, {})


def _standings(data: Mapping[str, Any], section: str) -> Iterator[tuple[str, dict[str, Any]]]:
    """(environment, standing), one after another."""
    for environment, entries in _sections(data, section).items():
        for entry in entries:
            yield environment, entry


# -- CSV ---------------------------------------------------------------------------------------------------------------


def as_csv(data: Mapping[str, Any]) -> str:
    """One row per section, environment, standing and policy; one column per figure."""
    rows = []
    for section in data["sections"]:
        for environment, entry in _standings(data, section):
            rows += [_csv_row(section, environment, entry, policy) for policy in entry["policies"]]
    return _csv(rows)


def verdicts_csv(data: Mapping[str, Any]) -> str:
    """One row per learned policy, courses, error and opponent; only the head where nothing learned takes part."""
    return _csv([_verdict_cells(*each) for each in _verdicts(data)])


def _csv(rows: Sequence[Mapping[str, Any]]) -> str:
    columns = list(dict.fromkeys(name for row in rows for name in row))
    buffer = io.StringIO()
    writer = csv.DictWriter(buffer, fieldnames=columns)
    writer.writeheader()
    writer.writerows(rows)
    return buffer.getvalue()


def _verdict_cells(environment: str, entry: Mapping[str, Any], each: Mapping[str, Any]) -> dict[str, Any]:
    drawn = entry.get("confirmation", entry)
    row = {
        "environment": environment, "title": entry["title"], "episodes": drawn["episodes"], "seed": drawn["seed"],
        "policy": each["policy"], "metric": each["metric"], "base": each["base"], "base_kind": BASES[each["kind"]],
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
    "deviation, which a mean error may undercut (of a Gaussian range it is 0.8 of it), for targets as restless as the "
    "filter assumes, which drawn ones are not."
)


def as_markdown(data: Mapping[str, Any]) -> str:
    """The whole leaderboard; its first part is the short form."""
    parts = ["# Leaderboard", _head(data), "## In short", short_form(data), f"![Ratios to the best rule]({PICTURE})"]
    parts += [_BOUND]
    parts += [*_learned_part(data), *_open_part(data), *_full_part(data), *_tracker_part(data), *_varied_part(data)]
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
    rows = [_short_row(environment, entry) for environment, entry in _standings(data, "leaderboard")]
    note = (
        "Ratios to the mean error of the best fixed policy or rule, the best of every kind; below 1 is better. Paper: "
        f"the reference geometry, {_listed(GEOMETRIES)}, the first one offered."
    )
    return "\n".join([*_rows_table(rows), "", note])


def _short_row(environment: str, entry: Mapping[str, Any]) -> dict[str, str]:
    """Cells by the names of their columns."""
    metric, reference, learned = entry["headline"], entry["reference"], entry["best"].get("learned")
    geometry = next((name for name in GEOMETRIES if name in entry["policies"]), None)
    tail = entry["policies"][learned]["ratios"][metric]["p95"] if learned else None
    return {
        "environment": _short(environment),
        "targets": _targets(entry),
        "error": entry["metrics"][metric],
        "best fixed or rule": f"`{reference}`" if _base(entry, REFERENCE) else "",
        "mean [m]": _mean_of(entry, reference),
        "paper": _mean_ratio(entry, geometry),
        **{kind: _mean_ratio(entry, entry["best"].get(kind)) for kind in SHORT_KINDS},
        "p95, learned": _ratio_words(tail) if tail else "",
    }


def _mean_ratio(entry: Mapping[str, Any], name: str | None) -> str:
    """To the reference, by the error that ranks."""
    return _ratio_words(entry["policies"][name]["ratios"][entry["headline"]]["mean"]) if name else ""


def _listed(names: Sequence[str]) -> str:
    return ", ".join(f"`{name}`" for name in names)


def _learned_part(data: Mapping[str, Any]) -> list[str]:
    """Every learned policy against the best rule and the best greedy one."""
    rows = [_verdict_row(environment, entry, each) for environment, entry, each in _verdicts(data)]
    if not rows:
        return []
    episodes = data["about"]["confirm"]
    again = f"; these ratios are of {episodes:,} others, whose seeds follow" if episodes else ", the same as here"
    note = (
        "Ahead: the interval of the ratio lies below 1; behind: above; level: it holds 1. Against whom: the fixed "
        "policy or rule, and the greedy one, of least mean of that very error on the episodes above"
        f"{again}. Intervals are 95 % each: were all {2 * len(rows)} verdicts in truth level, some "
        f"{math.ceil(0.1 * len(rows))} would say otherwise. An oracle searches with the targets' true paths, or the "
        "blockages to come, known: below 1, what knowing them is worth to such a search; above 1, its search is not "
        "good enough to tell. `RadarPlacement-v0` has none."
    )
    heading = "## Learned policies against the best fixed policy or rule and the best greedy one"
    return [heading, note, "\n".join(table(_VERDICT, rows))]


def _open_part(data: Mapping[str, Any]) -> list[str]:
    """Where what was learned is behind on the mean, or not ahead on the 95th percentile."""
    verdicts = list(_verdicts(data))
    if not verdicts:
        return []
    rows = [_verdict_row(environment, entry, each) for environment, entry, each in verdicts if each["open"]]
    note = (
        f"{len(rows)} of {len(verdicts)} comparisons: the learned policy is behind on the mean, or not ahead on the "
        "95th percentile."
    )
    environments = dict.fromkeys(environment for environment, _, each in verdicts if each["open"])
    parts = ["## Open", note, *(["\n".join(table(_VERDICT, rows))] if rows else [])]
    tried = [part for name in environments if name in TRIED for part in _tried(name, TRIED[name])]
    return parts + (["## What was tried", *tried] if tried else [])


def _tried(environment: str, tried: Tried) -> list[str]:
    """Trainings that were compared, and what they say."""
    found = table(["tried", *tried.columns], [list(row) for row in tried.rows])
    return [f"{_short(environment)}. {tried.measured}", "\n".join(found), tried.lesson]


_VERDICT = [
    "environment", "targets", "policy", "error", "against", "kind", "ratio of means", "mean", "ratio of p95", "p95",
    "oracle's ratio of means",
]  # fmt: skip


def _verdicts(data: Mapping[str, Any]) -> Iterator[tuple[str, dict[str, Any], dict[str, Any]]]:
    for environment, entry in _standings(data, "leaderboard"):
        for each in entry["verdicts"]:
            yield environment, entry, each


def _verdict_row(environment: str, entry: Mapping[str, Any], each: Mapping[str, Any]) -> list[str]:
    return [
        _short(environment), _targets(entry), f"`{each['policy']}`", entry["metrics"][each["metric"]],
        f"`{each['base']}`", BASES[each["kind"]], _ratio_words(each["mean"]), each["mean_verdict"],
        _ratio_words(each["p95"]), each["p95_verdict"], _ratio_words(each["oracle"]) if each["oracle"] else "—",
    ]  # fmt: skip


def _full_part(data: Mapping[str, Any]) -> list[str]:
    """All policies of every environment."""
    parts = ["## All policies", _full_note()]
    for environment, entries in _sections(data, "leaderboard").items():
        parts.append(f"### `{environment}`")
        for entry in entries:
            parts += [_caption(entry), "\n".join(figures_table(entry))]
    return parts


def _full_note() -> str:
    return (
        "Errors in metres, means over targets; acceleration in m/s². Bound: mean posterior Cramér–Rao bound at the "
        "end of the geometry that the policy flew; the row of that name shows the least. Lost: "
        "as the scenario's `lost_error_m` and `lost_nees` say, at the end; lost late: more than "
        f"{LATE_ERROR_M / 1e3:.0f} km off on average over the last {LATE_STEPS} steps; collapsed: more than "
        f"{COLLAPSE_M / 1e3:.0f} km off at the end, or with a NEES above its 99.99 % quantile."
    )


def _caption(entry: Mapping[str, Any]) -> str:
    return (
        f"{entry['title'].capitalize()}, {entry['score']} error, tracker `{entry['tracker']}`. Ratios to "
        f"`{entry['reference']}`, the best {_reference_kind(entry)} ({entry['metrics'][entry['headline']]})."
        + "".join(f" `{name}` does not fit: {why}." for name, why in entry["unfit"].items())
    )


def _reference_kind(entry: Mapping[str, Any]) -> str:
    return "fixed policy or rule" if _base(entry, REFERENCE) else "policy, for no fixed one or rule takes part"


def figures_table(entry: Mapping[str, Any]) -> list[str]:
    """One row per policy, then the least bound."""
    rows = [_figures_row(entry, name, figures) for name, figures in entry["policies"].items()]
    least = dict.fromkeys(rows[0], "") | {"policy": "bound", "kind": _bound_words(entry)}
    return _rows_table([*rows, least | {"bound": _metres(entry["bound"]["mean"])}])


def _bound_words(entry: Mapping[str, Any]) -> str:
    return f"of `{entry['bound']['policy']}`"


def _figures_row(entry: Mapping[str, Any], name: str, figures: Mapping[str, Any]) -> dict[str, str]:
    """Cells by the names of their columns."""
    final, average, *more = (figures[metric] for metric in entry["metrics"])
    late = {"lost late": percent(figures["lost_late_share"])} if "lost_late_share" in figures else {}
    return {
        "policy": f"`{name}`",
        "kind": figures["kind"],
        "final mean": _mean_words(final),
        "median": _metres(final["median"]),
        "p95": _metres(final["p95"]),
        "time average": _mean_words(average),
        "its p95": _metres(average["p95"]),
        **{words: _mean_words(each) for words, each in zip(list(entry["metrics"].values())[2:], more, strict=True)},
        "bound": _metres(figures[f"final_{entry['score']}_crlb_m"]),
        "lost": percent(figures["lost_share"]),
        **late,
        "collapsed": percent(figures["collapse_share"]),
        "NEES mean / median": _nees_words(figures),
        "episodes": f"{entry['episodes']:,}",
        "µs/decision": f"{figures['decision_time_us']:,.2f}",
        **{
            f"{words} / {entry['reference']}": _ratio_words(figures["ratios"][metric]["mean"])
            for metric, words in entry["metrics"].items()
        },
    }


def _tracker_part(data: Mapping[str, Any]) -> list[str]:
    """Every tracker under every policy."""
    if not _sections(data, "trackers"):
        return []
    parts = [
        "## Trackers",
        "Every tracker under every policy on the same tapes: does a maneuver help the tracker it was made for only? "
        "Final error in metres. NEES: an honest tracker has the mean that is named. Ratios to the rule or fixed policy "
        f"that is best with the same tracker. {_left_out()}",
    ]
    for environment, entries in _sections(data, "trackers").items():
        parts += [f"### Trackers of `{environment}`", f"{_honest(entries[0])}{_helped(entries)}"]
        parts.append("\n".join(tracker_table(entries)))
    return parts


def _helped(entries: Sequence[Mapping[str, Any]]) -> str:
    """Which trackers what was learned helps, in words; empty where nothing learned takes part."""
    found = [
        f"`{entry['title']}` {_ratio_words(each['mean'])}, {each['mean_verdict']}"
        for entry in entries
        for each in entry["verdicts"]
        if each["kind"] == REFERENCE and each["metric"] == entry["headline"]
    ]
    if not found:
        return ""
    error = entries[0]["metrics"][entries[0]["headline"]]
    return f" Learned to the best fixed policy or rule with the same tracker ({error}): {'; '.join(found)}."


def _left_out() -> str:
    named = "; ".join(f"{_listed(names)} of {_short(environment)}" for environment, names in COSTLY.items())
    return f"Left out, for they search for a tenth of a second per episode or longer: {named}."


def _honest(entry: Mapping[str, Any]) -> str:
    return f"{entry['score'].capitalize()} error; mean NEES of an honest tracker: {entry['state_size']}."


def tracker_table(entries: Sequence[Mapping[str, Any]]) -> list[str]:
    """One row per tracker and policy."""
    rows: list[dict[str, str]] = []
    for entry in entries:
        rows += [_tracker_row(entry, name, figures) for name, figures in entry["policies"].items()]
        missing = dict.fromkeys(rows[0], "") | {"tracker": f"`{entry['title']}`", "final mean": "does not fit"}
        rows += [missing | {"policy": f"`{name}`"} for name in entry["unfit"]]
    return _rows_table(rows)


def _tracker_row(entry: Mapping[str, Any], name: str, figures: Mapping[str, Any]) -> dict[str, str]:
    """Cells by the names of their columns."""
    final, average, *_ = entry["metrics"]
    return {
        "tracker": f"`{entry['title']}`",
        "policy": f"`{name}`",
        "final mean": _mean_words(figures[final]),
        "p95": _metres(figures[final]["p95"]),
        "time average": _mean_words(figures[average]),
        "NEES mean / median": _nees_words(figures),
        "lost": percent(figures["lost_share"]),
        "collapsed": percent(figures["collapse_share"]),
        "reference": f"`{entry['reference']}`",
        "final / reference": _ratio_words(figures["ratios"][final]["mean"]),
        "average / reference": _ratio_words(figures["ratios"][average]["mean"]),
    }


def _varied_part(data: Mapping[str, Any]) -> list[str]:
    """Other circumstances than those of training."""
    if not _sections(data, "generalisation"):
        return []
    parts = [
        "## Generalisation",
        "Where one thing differs from what learned policies were trained in: ratios to the best fixed policy or rule "
        f"and to the best greedy one in the same circumstances. {_left_out()} Numbers of targets, stations and "
        "transmitters stay as they are: they decide what a policy sees.",
    ]
    for environment, entries in _sections(data, "generalisation").items():
        parts += [f"### Generalisation in `{environment}`", "\n".join(varied_table(entries))]
    return parts


def varied_table(entries: Sequence[Mapping[str, Any]]) -> list[str]:
    """One row per circumstance and learned policy; a single one where nothing learned takes part."""
    rows = []
    for entry in entries:
        learned = [name for name, figures in entry["policies"].items() if figures["kind"] == "learned"]
        rows += [_varied_row(entry, name) for name in (*learned, *entry["unfit"]) or ("",)]
    return _rows_table(rows)


def _varied_row(entry: Mapping[str, Any], name: str) -> dict[str, str]:
    """Cells by the names of their columns."""
    metric = entry["headline"]
    row = {"circumstances": entry["title"], "error": entry["metrics"][metric]}
    for kind, words in BASES.items():
        best = _base(entry, kind)
        row |= {f"best {words}": f"`{best}`" if best else "", f"mean, {words}": _mean_of(entry, best)}
    mean = "does not fit" if name in entry["unfit"] else _mean_of(entry, name)
    row |= {"policy": f"`{name}`" if name else "", "mean": mean}
    for what in ("mean", "p95"):
        row |= {f"{what} / {words}": _against(entry, name, kind, what) for kind, words in BASES.items()}
    return row


def _base(entry: Mapping[str, Any], kind: str) -> str | None:
    """Whom learned policies are compared with by the error that ranks."""
    return entry["best_by"][entry["headline"]].get(kind)


def _mean_of(entry: Mapping[str, Any], name: str | None) -> str:
    return _metres(entry["policies"][name][entry["headline"]]["mean"]) if name else ""


def _against(entry: Mapping[str, Any], name: str, kind: str, what: str) -> str:
    """A learned policy's ratio to the best one of a kind."""
    wanted = (name, kind, entry["headline"])
    found = [each for each in entry["verdicts"] if (each["policy"], each["kind"], each["metric"]) == wanted]
    return _ratio_words(found[0][what]) if found else ""


def _rows_table(rows: Sequence[Mapping[str, str]]) -> list[str]:
    """A table of rows with the same columns."""
    return table(list(rows[0]), [list(row.values()) for row in rows])


def _short(environment: str) -> str:
    return f"`{environment.split('/')[-1]}`"


def _nees_words(figures: Mapping[str, Any]) -> str:
    return f"{figures['final_nees']['mean']:.1f} / {figures['final_nees']['median']:.1f}"


def _targets(entry: Mapping[str, Any]) -> str:
    return "recorded" if entry["course"] == "flights" else "drawn"


def _metres(value: float) -> str:
    return f"{value:,.0f}" if abs(value) >= 100.0 else f"{value:.3g}"


def _mean_words(figure: Mapping[str, Any]) -> str:
    low, high = figure["ci95"]
    return f"{_metres(figure['mean'])} [{_metres(low)}, {_metres(high)}]"


def _ratio_words(ratio: Mapping[str, Any]) -> str:
    low, high = ratio["ci95"]
    return "1" if low == high == ratio["ratio"] == 1.0 else f"{ratio['ratio']:.3f} [{low:.3f}, {high:.3f}]"
