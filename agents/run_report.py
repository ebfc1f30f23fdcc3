"""The page that a training or an evaluation leaves behind: tables, pictures and settings in one file.

Nothing in it is fetched and nothing runs in it. Pictures are SVG inside the page and follow its light or dark colours.
"""

from __future__ import annotations

import base64
import dataclasses
import html
import math
import shlex
from collections.abc import Iterable, Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from matplotlib.figure import Figure

from agents import pictures
from agents.curves import Curve, gather, picture, quantities, read_run, words_of
from agents.files import write_text
from agents.maneuvers import maneuvers
from agents.outcomes import Record, steps_axis
from agents.page import fragment, shell
from agents.placement_pictures import placement_cards
from agents.provenance import commit, processor_name, short_commit, versions
from agents.report import (
    as_markdown,
    courses,
    flown_paths,
    has_courses,
    headline,
    metrics_of,
    percent,
    ratio_words,
    verdict,
)
from agents.svg import as_svg
from passive_env.artists import metres
from passive_env.catalogue import make_scenario
from passive_env.catalogue.placement import RadarPlacement
from passive_env.scenario import parse_fields
from trackers.compiled import available_cores

REPORT = "report.html"
CHART_IN = (5.2, 4.2)
"""Size of a diagram over time; letters of this size can be read on a phone."""
CARDS = 6
"""Policies that are drawn; the others' maps are folded."""
VERDICT_WORDS = {"ahead": "ahead of it", "level": "level with it", "behind": "behind it"}
EVERYTHING = "All figures, and ratios to every baseline"
NOTHING = "–"


class Comparison(NamedTuple):
    """Policies that flew the same episodes, in words and pictures.

    Attributes:
        heading: what was compared.
        summary: as of `agents.comparison.summarize`.
        scenario: that was flown.
        body: HTML of tables and pictures.
        finding: HTML of one sentence.
        tiles: the figures that matter most, HTML by what they are.
    """

    heading: str
    summary: dict[str, Any]
    scenario: Any
    body: str
    finding: str
    tiles: Mapping[str, str]


class Settings(NamedTuple):
    """What was asked for.

    Attributes:
        title: of the report.
        command: that repeats it.
        settings: names and values.
        folder: of a training run, whose learning curves are drawn; None for an evaluation.
        preset: of that run.
        tiles: figures beside those of the first comparison.
        preface: HTML before the comparisons.
    """

    title: str
    command: str
    settings: Mapping[str, Any]
    folder: Path | None = None
    preset: Mapping[str, Any] = {}
    tiles: Mapping[str, str] = {}
    preface: str = ""


def write_run_report(out: Path, asked: Settings, comparisons: Sequence[Comparison]) -> Path:
    """Write ``report.html`` into a folder, whole or not at all; returns the file."""
    first = comparisons[0]
    chapters = [
        *((each.heading, each.body) for each in comparisons),
        *([("Learning curves", _learning(asked.folder))] if asked.folder is not None else []),
        ("Configuration", _configuration(asked, comparisons)),
        ("How to repeat it", _repeating(asked)),
    ]
    links = "".join(f'<li><a href="#part-{i}">{_text(heading)}</a></li>' for i, (heading, _) in enumerate(chapters, 1))
    body = [
        f'<div class="run"><header><h1>{_text(asked.title)}</h1>{_findings(comparisons)}',
        f'{_tiles({**first.tiles, **asked.tiles})}<nav aria-label="Parts of this report"><ul>{links}</ul></nav>',
        f"</header>{asked.preface}",
        *(_chapter(f"part-{i}", *chapter) for i, chapter in enumerate(chapters, 1)),
        "</div>",
    ]
    return write_text(out / REPORT, shell(asked.title, "\n".join(body)))


def _chapter(place: str, heading: str, content: str) -> str:
    return f'<section aria-labelledby="{place}"><h2 id="{place}">{_text(heading)}</h2>{content}</section>'


# -- a comparison ------------------------------------------------------------------------------------------------------


def comparison(
    heading: str, summary: dict[str, Any], records: Mapping[str, Record], scenario: Any, focus: str = ""
) -> Comparison:
    """A comparison in words and pictures.

    Args:
        heading: what was compared.
        summary: as of `agents.comparison.summarize`.
        records: it was made of.
        scenario: that was flown.
        focus: the policy it is about; default the best.
    """
    metric = _ranking_error(summary, records, scenario)
    order = sorted(summary["policies"], key=lambda name: summary["policies"][name][metric]["mean"])
    focus = focus or order[0]
    base = next((name for name in order if _can_be_base(name, summary, metric) and name != focus), "")
    shown = {name: records[name] for name in _in_order(order, focus, next(iter(summary["ratios"])))}
    charts = [
        *([_ratio_picture(summary, order, metric, base)] if base else []),
        _error_over_time(shown, scenario, summary["score"]),
    ]
    body = [
        _figures(summary, order, metric, base, focus),
        _details(EVERYTHING, f'<div class="unbroken">{fragment(as_markdown(summary), name=EVERYTHING)}</div>'),
        f'<div class="pair">{"".join(f"<div>{chart}</div>" for chart in charts)}</div>',
        "<h3>Geometry</h3>",
        _geometry(shown, scenario, summary["seed"]),
    ]
    return Comparison(
        heading, summary, scenario, "\n".join(body), _finding(summary, metric, base, focus),
        _comparison_tiles(summary, metric, base, focus),
    )  # fmt: skip


def _can_be_base(name: str, summary: Mapping[str, Any], metric: str) -> bool:
    """Whether it is a baseline with an error that others can be divided by."""
    return name in summary["ratios"] and summary["policies"][name][metric]["mean"] > 0.0


def _in_order(order: Sequence[str], focus: str, reference: str) -> list[str]:
    """Names in the order of pictures: first the one in focus, then the best; the reference among the first ones."""
    names = [focus, *(name for name in order if name != focus)]
    if reference in names[CARDS:]:
        names.remove(reference)
        names.insert(CARDS - 1, reference)
    return names


def _ranking_error(summary: Mapping[str, Any], records: Mapping[str, Record], scenario: Any) -> str:
    outcomes = next(iter(records.values())).outcomes
    return headline(scenario, {name: len(outcomes.samples[name]) / len(outcomes.lost) for name in metrics_of(summary)})


def _error_name(metric: str, score: str) -> str:
    """The ranking error in words."""
    names = {"final": f"{score} error at the end", "mean": f"{score} error averaged over time"}
    return names.get(metric.partition("_")[0], f"{score} error while the target maneuvers")


def _finding(summary: Mapping[str, Any], metric: str, base: str, focus: str) -> str:
    """One sentence: how large the error is, and how it compares with the best baseline's."""
    figures, error = summary["policies"][focus][metric], _error_name(metric, summary["score"])
    least = " the least" if focus == _least(summary, metric) and len(summary["policies"]) > 1 else " a"
    said = f"<code>{_text(focus)}</code> has{least} mean {error}: {metres(figures['mean'])}"
    if not base:
        return said + "."
    ratio = summary["ratios"][base][focus][metric]
    judged = verdict(ratio["ci95"])
    rival = "the next baseline" if focus in summary["ratios"] else "the strongest baseline"
    beside = f"That is {ratio_words(ratio)} times the error of <code>{_text(base)}</code>, {rival}"
    if summary["episodes"] < 2:
        return f"{said}. {beside}, in a single episode."
    return f'{said}. {beside}: <span class="{judged}">{VERDICT_WORDS[judged]}</span>.'


def _least(summary: Mapping[str, Any], metric: str) -> str:
    return min(summary["policies"], key=lambda name: summary["policies"][name][metric]["mean"])


def _comparison_tiles(summary: Mapping[str, Any], metric: str, base: str, focus: str) -> dict[str, str]:
    figures, score = summary["policies"][focus], summary["score"]
    tiles = {f"{_error_name(metric, score)}, {_text(focus)}": metres(figures[metric]["mean"])}
    if base:
        ratio = summary["ratios"][base][focus][metric]
        low, high = ratio["ci95"]
        tiles[f"times the error of {_text(base)} [{low:.3f}, {high:.3f}]"] = f"{ratio['ratio']:.3f}"
    return tiles | {
        "Cramér–Rao bound at the end, 1σ": metres(figures[f"final_{score}_crlb_m"]),
        "tracks lost": percent(figures["lost_share"]),
        "paired episodes": f"{summary['episodes']:,}",
    }


def _figures(summary: Mapping[str, Any], order: Sequence[str], metric: str, base: str, focus: str) -> str:
    """The table that matters: a row per policy, the best first."""
    metrics, score = metrics_of(summary), summary["score"]
    others = [each for each in metrics if each != metric]
    head = ["policy", metrics[metric], *([f"{metrics[metric]} / {base}"] if base else []), f"p95, {metrics[metric]}"]
    head += [*(metrics[each] for each in others), "bound", "lost"]
    rows = []
    for name in order:
        figures = summary["policies"][name]
        cells = [name, _number(figures[metric]["mean"])]
        if base:
            cells.append("1" if name == base else ratio_words(summary["ratios"][base][name][metric]))
        cells += [_number(figures[metric]["p95"]), *(_number(figures[each]["mean"]) for each in others)]
        rows.append([*cells, _number(figures[f"final_{score}_crlb_m"]), percent(figures["lost_share"])])
    unit = ", accelerations in m/s²" if "mean_acceleration_error_m_s2" in metrics else ""
    note = (
        f"Mean {score} errors in metres{unit}, over {summary['episodes']:,} paired episodes from seed "
        f"{summary['seed']:,}; ranked by the bold column. Bound: posterior Cramér–Rao bound at the end, a standard "
        "deviation (a mean error may lie 20 % below it). In brackets: paired bootstrap 95 % interval."
    )
    table = _table(head, rows, "Comparison of policies", "figures", 1, order.index(focus))
    return f'{table}<p class="small">{note}</p>'


def _number(value: float) -> str:
    """Metres without decimals, small values with two digits."""
    if value is None or not math.isfinite(value):
        return NOTHING
    return f"{value:,.0f}" if abs(value) >= 10.0 else f"{value:.2g}"


def _ratio_picture(summary: Mapping[str, Any], order: Sequence[str], metric: str, base: str) -> str:
    ratios = {name: summary["ratios"][base][name][metric] for name in order if name != base}
    bars = {name: (ratio["ratio"], *ratio["ci95"]) for name, ratio in ratios.items() if ratio["ratio"] > 0.0}
    if not bars:
        return ""
    figure = pictures.ratio_chart(bars, "")
    figure.set_size_inches(CHART_IN[0], figure.get_figheight())
    said = "; ".join(f"{name} {ratio_words(ratio)}" for name, ratio in ratios.items())
    drawn = _picture(figure, f"Bars: mean error relative to that of {base}, with 95 % intervals. {said}.")
    name = f"{_error_name(metric, summary['score'])}, relative to {base}"
    return f"<h3>{_text(name[0].upper() + name[1:])}</h3>{drawn}"


def _error_over_time(records: Mapping[str, Record], scenario: Any, score: str) -> str:
    times, drawn = steps_axis(scenario), list(records.items())[:CARDS]
    errors = {name: record.error_m.mean(0) for name, record in drawn}
    bounds = {name: record.bound_m.mean(0) for name, record in drawn}
    figure = pictures.error_over_time(times, errors, bounds, "", score)
    figure.set_size_inches(*CHART_IN)
    ends = "; ".join(f"{name} {metres(error[-1])}" for name, error in errors.items())
    alt = f"Mean {score} error over {times[-1]:g} s, logarithmic. At the end: {ends}."
    caption = "Averaged over targets and episodes; dashed: the bound of the geometry flown."
    if len(records) > CARDS:
        caption += f" {len(records) - CARDS} more policies stand in the table only."
    return f"<h3>Error over time</h3>{_picture(figure, alt, caption)}"


def _geometry(records: Mapping[str, Record], scenario: Any, seed: int) -> str:
    """A card per policy: what it did in the first episode."""
    said = f"<p>The first episode (seed {seed:,}): the same targets and the same noise for every policy.</p>"
    if isinstance(scenario, RadarPlacement):
        worlds: dict[str, Any] = {name: record.paths for name, record in records.items()}
        key = (
            "<p>Dots: sensors by number, with the position error promised at the last scan. Colours: what would be "
            "promised if the last sensor stood there, the others as they are. Cross: where the paper puts it.</p>"
        )
        cards = _cards(placement_cards(worlds, scenario), "sensors, and what the last one would promise elsewhere")
        return said + key + cards
    paths, times = flown_paths(records, scenario), steps_axis(scenario)
    key = _picture(
        pictures.geometry_legend(next(iter(paths.values()))), "Key to the signs of the maps below.", kind="key"
    )
    cards = _cards(pictures.geometry_cards(times, paths), "map of the paths, and below it the error and its bound")
    return said + key + cards + _maneuvers(records, scenario)


def _cards(figures: Mapping[str, Figure], what: str) -> str:
    """Pictures side by side; those after the first ones fold away."""
    titles = (figure.axes[0].get_title() or figure.axes[0].get_title("left") for figure in figures.values())
    cards = [_picture(card, f"{title}; {what}") for title, card in zip(titles, figures.values(), strict=True)]
    first, more = (f'<div class="cards">{"".join(part)}</div>' for part in (cards[:CARDS], cards[CARDS:]))
    return first + (_details(f"The other {len(cards) - CARDS}", more) if len(cards) > CARDS else "")


def _maneuvers(records: Mapping[str, Record], scenario: Any) -> str:
    if not has_courses(scenario):
        return ""
    figure = maneuvers(steps_axis(scenario), courses(records), "Courses and legs over all episodes")
    alt = "Per policy: angle between course and line of sight over time, side of it and turns, lengths of legs."
    wide = f'<div class="wide" role="region" tabindex="0" aria-label="Courses and legs">{_picture(figure, alt)}</div>'
    return _details("Courses and legs of every policy", wide)


# -- the rest of the page ----------------------------------------------------------------------------------------------


def _findings(comparisons: Sequence[Comparison]) -> str:
    """The sentences that matter, each with its heading where there are several."""
    if len(comparisons) == 1:
        return f'<p class="lede">{comparisons[0].finding}</p>'
    said = (f"<li><strong>{_text(each.heading)}:</strong> {each.finding}</li>" for each in comparisons)
    return f'<ul class="lede">{"".join(said)}</ul>'


def _learning(folder: Path) -> str:
    """Curves of the run's own logs."""
    try:
        run = read_run(folder)
    except FileNotFoundError:
        return "<p>This run has left no logs.</p>"
    if not quantities([run]):
        return "<p>This run was too short for a logged episode.</p>"
    curves = gather([run])
    figure = picture(curves, "")
    figure.set_size_inches(CHART_IN[0], 0.4 + 2.2 * len(curves))
    told = "; ".join(_course_of(name, curve) for name, curve in curves.items())
    note = (
        "Errors are those of the untouched scenario on tapes kept for this, flown at every checkpoint; the return is "
        "that of training, with its rewards and its exploration."
    )
    return _picture(figure, f"Learning curves over environment steps. {told}.", note)


def _course_of(name: str, curve: Curve) -> str:
    steps, values = curve.steps, curve.median()
    return f"{words_of(name)}: {values[0]:.3g} at {steps[0]:,.0f} steps, {values[-1]:.3g} at {steps[-1]:,.0f}"


def _configuration(asked: Settings, comparisons: Sequence[Comparison]) -> str:
    """What was asked for, what differs from the environment's defaults, and every field."""
    rows = [[name, _value(value)] for name, value in flat(asked.settings) if _value(value) != NOTHING]
    fields = _fields(comparisons)
    changed = [row for row in fields if row[1] != row[2]]
    head = ["field", "value", "default", "meaning"]
    order = f", {' / '.join(each.heading.lower() for each in comparisons)}" if len(comparisons) > 1 else ""
    parts = [_table(["setting", "value"], rows, "Settings")]
    if asked.preset:
        preset = [[name, _value(value)] for name, value in flat(asked.preset)]
        parts.append(_details("Preset of the algorithm", _table(["setting", "value"], preset, "Preset")))
    parts.append(
        f"<h3>Scenario</h3><p>What differs from the environment's defaults{order}:</p>"
        + _table(head, changed, "Changed fields", "fields")
        if changed
        else "<h3>Scenario</h3><p>All fields are at the environment's defaults.</p>"
    )
    return "".join(parts) + _details(f"All {len(fields)} fields", _table(head, fields, "All fields", "fields"))


def _fields(comparisons: Sequence[Comparison]) -> list[list[str]]:
    """Every scenario field: values, default, meaning."""
    usual = make_scenario(comparisons[0].summary["environment"], {})
    rows = []
    for field in dataclasses.fields(usual):
        values = [_value(getattr(each.scenario, field.name)) for each in comparisons]
        default, meaning = _value(getattr(usual, field.name)), field.metadata.get("doc", "")
        rows.append([field.name, " / ".join(dict.fromkeys(values)), default, meaning])
    return rows


def flat(settings: Mapping[str, Any], prefix: str = "") -> Iterable[tuple[str, Any]]:
    """Settings in one level: names of inner ones after those of outer ones, with a dot between."""
    for name, value in settings.items():
        if isinstance(value, Mapping) and value:
            yield from flat(value, f"{prefix}{name}.")
        else:
            yield prefix + name, value


def _value(value: Any) -> str:
    if value is None or (isinstance(value, (Mapping, Sequence)) and not value):
        return NOTHING
    if isinstance(value, (list, tuple)):
        return ", ".join(map(_value, value))
    if isinstance(value, int) and not isinstance(value, bool):
        return f"{value:,}"
    return str(value)


def _repeating(asked: Settings) -> str:
    """Command, versions, machine, date."""
    rows = [["date", f"{datetime.now(UTC):%Y-%m-%d}"], ["commit", short_commit(commit() or NOTHING)]]
    rows += [["processor", f"{processor_name()}, {available_cores()} cores"], *map(list, versions().items())]
    return (
        f"<pre><code>{_unbroken_flags(asked.command)}</code></pre><p>DIR is a new folder. With the same versions the "
        "numbers come out the same, the times of decisions apart.</p>" + _table(["what", "version"], rows, "Versions")
    )


def _unbroken_flags(command: str) -> str:
    """A command as HTML in which no line ends between a flag's two hyphens and its name."""
    words = (_text(word) for word in command.split(" "))
    return " ".join(f'<span class="flag">{word}</span>' if word.startswith("--") else word for word in words)


def command_line(verb: str, flags: Mapping[str, Any], place: str = "") -> str:
    """A command of ``passive-env`` as one would type it.

    Args:
        verb: the command.
        flags: values by flag; None and empty ones are left out, ``fields`` is a mapping of scenario fields.
        place: what stands before the flags.
    """
    words = ["passive-env", verb, *([place] if place else [])]
    for name, value in flags.items():
        if name == "fields":
            value = [f"{field}={_literal(given)}" for field, given in value.items()]
        values = value if isinstance(value, (list, tuple)) else [] if value is None else [value]
        words += [f"--{name}", *map(str, values)] if values else []
    return shlex.join(words)


def duration(seconds: float) -> str:
    """A time in the largest units that it has."""
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours} h {minutes} min" if hours else f"{minutes} min {rest} s" if minutes else f"{rest} s"


def _literal(value: Any) -> str:
    """A field's value as it is written behind its equals sign."""
    plain = isinstance(value, str) and parse_fields([f"x={value}"]) == {"x": value}
    return value if plain else repr(value)


# -- HTML --------------------------------------------------------------------------------------------------------------


def _text(words: Any) -> str:
    return html.escape(str(words))


def _tiles(tiles: Mapping[str, str]) -> str:
    """A list of figures; what they are is HTML already."""
    return f'<dl class="tiles">{"".join(f"<div><dt>{name}</dt><dd>{v}</dd></div>" for name, v in tiles.items())}</dl>'


def _details(title: str, content: str) -> str:
    return f"<details><summary>{_text(title)}</summary>{content}</details>"


def _table(
    head: Sequence[str], rows: Sequence[Sequence[str]], name: str, kind: str = "", counts: int = -1, focus: int = -1
) -> str:
    """A table in a named region that scrolls; one column may count most, one row be the one it is about."""
    style = [' class="counts"' if i == counts else "" for i in range(len(head))]
    heads = "".join(f'<th scope="col"{style[i]}>{_text(cell)}</th>' for i, cell in enumerate(head))
    lines = []
    for at, row in enumerate(rows):
        first, *others = (_text(cell) for cell in row)
        cells = "".join(f"<td{style[i]}>{cell}</td>" for i, cell in enumerate(others, 1))
        marked = ' class="focus"' if at == focus else ""
        lines.append(f'<tr{marked}><th scope="row">{first}</th>{cells}</tr>')
    return (
        f'<div class="table {kind}" role="region" tabindex="0" aria-label="{_text(name)}"><table><thead><tr>{heads}'
        f"</tr></thead><tbody>{''.join(lines)}</tbody></table></div>"
    )


def _picture(figure: Figure, alt: str, caption: str = "", kind: str = "") -> str:
    content = base64.b64encode(as_svg(figure)).decode()
    width, height = np.round(96.0 * figure.get_size_inches()).astype(int)
    below = f"<figcaption>{_text(caption)}</figcaption>" if caption else ""
    return (
        f'<figure class="{kind}"><img src="data:image/svg+xml;base64,{content}" alt="{_text(alt)}" width="{width}" '
        f'height="{height}">{below}</figure>'
    )
