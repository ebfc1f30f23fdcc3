"""All papers in one report, Markdown and HTML: what was claimed, what was found, how to find it again.

Every paper's finished part is kept in a folder of its own, so an interrupted run goes on where it stopped. A part
counts as finished if its files are as they were written, by the same code and versions for the same settings.
"""

from __future__ import annotations

import functools
import hashlib
import json
import sys
import time
import traceback
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path
from textwrap import indent
from typing import Any, NamedTuple

import numpy as np
from markdown.extensions.toc import slugify
from tqdm import tqdm

import passive_env
import trackers
from agents import resampling
from agents.files import make_folder, write_json, write_text
from agents.page import as_page
from agents.provenance import NUMERIC, processor_name, versions
from agents.reproduction import PAPERS
from agents.reproduction.report import (
    COUNTED,
    HEADS,
    NOT_REPRODUCED,
    NOT_TESTABLE,
    ORIGINS,
    PAPER,
    REPRODUCED,
    RESULT,
    SPEC,
    VERDICTS,
    Paper,
    chapters,
    markdown_table,
    of_origin,
    pictures_words,
    prepare,
    settings_line,
    verdict_counts,
    verdict_line,
)
from trackers.compiled import available_cores

REPORT, PARTS, FINISHED = "papers", "papers", "finished.json"
"""The report's files without their endings, the folder of the parts beside them, a part's seal."""

TITLE = "Five papers repeated"
INTRODUCTION = f"""What five papers state about tracking with passive sensors and about where to put sensors, beside
what this package computes. Two kinds of statements are told and counted apart:

- **{HEADS[PAPER]}**: values of a paper's tables and sentences of its text. Where a sentence names no number, the
  criterion is ours.
- **{HEADS[SPEC]}**: the papers leave choices open and hold misprints, so each one has a specification, written for
  this project, that fills and corrects them. Numbers that were computed for it, what it concludes from them, and
  thresholds that this project set tell whether our computations agree with one another, not whether a paper is right.

A statement is **{REPRODUCED}** if our value meets the criterion that stands in its text, **{NOT_REPRODUCED}** if it
does not, and **{NOT_TESTABLE}** if nothing is given to measure it by. A verdict holds for the paper as it is read here:
with other choices where it leaves them open, it might be another. Intervals hold 95 %: bootstrap over Monte Carlo runs,
Wilson's for shares. Of the papers' figures only what their text and tables say is known here: our figures bear their
numbers, and hold the papers' values where these are given."""

TOLD = {PAPER: "claims of the papers' authors", SPEC: "cross-checks of our own"}
"""What statements of an origin are in the headline."""


class Part(NamedTuple):
    """What became of one paper.

    Attributes:
        paper: which.
        result: what `reproduction.json` holds; None if it failed.
        seconds: processor time it took.
        elapsed: time by the clock [s].
        failure: what went wrong, "" if nothing.
    """

    paper: Paper
    result: dict[str, Any] | None
    seconds: float = 0.0
    elapsed: float = 0.0
    failure: str = ""


def reproduce_all(
    out: Path,
    runs: int | None = None,
    seeds: Sequence[int] = (0, 1, 2, 3),
    papers: Mapping[str, Paper] = PAPERS,
    progress: bool = True,
) -> list[Part]:
    """Repeat all papers one after the other and write one report; an error in one leaves the others.

    Args:
        out: folder for `papers.md`, `papers.html` and, per paper, `papers/NAME/` with its own report and pictures.
        runs: Monte Carlo runs per seed; None: each paper's own number.
        seeds: one generator each.
        papers: by name.
        progress: show a progress bar.
    Returns:
        a part per paper.
    Raises:
        ValueError: runs or seeds that leave nothing to compute.
    """
    prepare(1 if runs is None else runs, seeds, out)
    parts = []
    with tqdm(papers.values(), unit="paper", disable=not progress, leave=False) as bar:
        for paper in bar:
            bar.set_description(paper.name)
            parts.append(_part(paper, out / PARTS / paper.name, runs, seeds))
    write_report(out, parts, runs, seeds)
    return parts


def write_report(out: Path, parts: Sequence[Part], runs: int | None, seeds: Sequence[int]) -> list[Path]:
    """Write `papers.md` and `papers.html`; returns them."""
    text = report(parts, runs, seeds)
    written = write_text(out / f"{REPORT}.md", text)
    return [written, write_text(out / f"{REPORT}.html", as_page(text, TITLE, out, VERDICTS))]


# -- parts ------------------------------------------------------------------------------------------------------------


def _part(paper: Paper, folder: Path, runs: int | None, seeds: Sequence[int]) -> Part:
    """The kept part, or a new one."""
    key = {"runs": runs, "seeds": list(seeds), "code": code_digest(), "versions": versions(NUMERIC)}
    kept = _kept(paper, folder, key)
    if kept is not None:
        return kept
    begun = time.process_time(), time.perf_counter()
    try:
        make_folder(folder)
        paper.reproduce(**({} if runs is None else {"runs": runs}), seeds=seeds, out=folder)
    except Exception as error:  # whatever it is, the other papers shall be written
        traceback.print_exception(error, file=sys.stderr)
        return Part(paper, None, failure=f"{type(error).__name__}: {error}")
    seconds, elapsed = time.process_time() - begun[0], time.perf_counter() - begun[1]
    write_json(folder / FINISHED, {"key": key, "seconds": seconds, "elapsed": elapsed, "files": _digests(folder)})
    return Part(paper, _read(folder / RESULT), seconds, elapsed)


def _kept(paper: Paper, folder: Path, key: Mapping[str, Any]) -> Part | None:
    """A finished part of the same settings, code and versions whose files are as they were written."""
    try:
        seal = _read(folder / FINISHED)
        if seal["key"] == key and seal["files"] == _digests(folder):
            return Part(paper, _read(folder / RESULT), seal["seconds"], seal["elapsed"])
    except (OSError, ValueError, KeyError, TypeError):  # missing or damaged: it is computed anew
        pass
    return None


def _read(file: Path) -> dict[str, Any]:
    return json.loads(file.read_text(encoding="utf-8"))


def _digests(folder: Path) -> dict[str, str]:
    """Digest of every file but the seal."""
    files = sorted(path for path in folder.iterdir() if path.name != FINISHED)
    return {path.name: hashlib.sha256(path.read_bytes()).hexdigest() for path in files}


@functools.cache
def code_digest() -> str:
    """Digest of the sources that decide a reproduction: trackers, environments, resampling, this package but for this
    module."""
    digest, here = hashlib.sha256(), Path(__file__)
    for package in (Path(trackers.__file__).parent, Path(passive_env.__file__).parent, here.parent):
        for file in sorted(set(package.rglob("*.py")) - {here}):
            digest.update(file.relative_to(package).as_posix().encode() + file.read_bytes())
    digest.update(Path(resampling.__file__).read_bytes())
    return digest.hexdigest()[:12]


# -- the report -------------------------------------------------------------------------------------------------------


def report(parts: Sequence[Part], runs: int | None, seeds: Sequence[int]) -> str:
    """The whole report (Markdown); pictures' paths begin in the report's folder."""
    whole = {
        "Summary": summary_table(parts),
        "How this was made": _how(parts, runs, seeds),
        **{part.paper.subject: _chapter(part) for part in parts},
    }
    return f"# {TITLE}\n\n{INTRODUCTION}\n\n{chapters(whole, 2)}"


def summary_table(parts: Sequence[Part]) -> str:
    """The headline and, below their headings, tables: verdicts by origin, the papers' own first, and times."""
    tables = {HEADS[origin]: _verdicts(parts, origin) for origin in ORIGINS}
    return f"{headline(parts)}\n\n{chapters({**tables, 'Time': _times(parts)}, 3)}"


def headline(parts: Sequence[Part]) -> str:
    """How many of the authors' claims are reproduced, then how many cross-checks."""
    claims = [c for part in parts if part.result is not None for c in part.result["claims"]]
    return ". ".join(verdict_line(of_origin(claims, origin), TOLD[origin]) for origin in ORIGINS) + "."


def _verdicts(parts: Sequence[Part], origin: str) -> str:
    """Claims of one origin and their verdicts per paper, and their sum over those that were computed."""
    counts = [_counts(part, origin) for part in parts]
    rows = [(_link(part), *(found or ["not computed", *[None] * 3])) for part, found in zip(parts, counts, strict=True)]
    total = np.sum([found for found in counts if found] or np.zeros((1, 4), int), axis=0)
    return markdown_table(("paper", COUNTED[origin], *VERDICTS), [*rows, ("all", *total)])


def _link(part: Part) -> str:
    return f"[{part.paper.subject}](#{slugify(part.paper.subject, '-')})"


def _counts(part: Part, origin: str) -> list[int]:
    """Claims, and those of each verdict; empty if there is no result."""
    claims = of_origin(part.result["claims"], origin) if part.result else []
    return [len(claims), *verdict_counts(claims).values()] if part.result else []


def _times(parts: Sequence[Part]) -> str:
    """Processor time and time by the clock of what was computed, and their sums."""
    rows = [
        (part.paper.name, f"{part.seconds:.0f}", f"{part.elapsed:.0f}") for part in parts if part.result is not None
    ]
    total = ("all", f"{sum(part.seconds for part in parts):.0f}", f"{sum(part.elapsed for part in parts):.0f}")
    return markdown_table(("paper", "processor time [s]", "elapsed time [s]"), [*rows, total])


def _how(parts: Sequence[Part], runs: int | None, seeds: Sequence[int]) -> str:
    """Command, seeds, versions, machine, date."""
    given = "" if runs is None else f" --runs {runs}"
    command = f"passive-env reproduce all{given} --seeds {' '.join(map(str, seeds))} --out DIR"
    numbers = {part.paper.name: part.result["settings"]["runs"] for part in parts if part.result is not None}
    rows = [
        ("command", f"`{command}`"),
        ("one paper", f"`passive-env reproduce {parts[0].paper.name} --out DIR`"),
        ("runs per seed", ", ".join(f"{name} {number}" for name, number in numbers.items())),
        ("seeds", ", ".join(map(str, seeds))),
        ("versions", ", ".join(f"{name} {version}" for name, version in versions(NUMERIC).items())),
        ("code", f"{code_digest()}, a digest of the sources of trackers, environments and reproductions"),
        ("machine", f"{processor_name()}, {available_cores()} cores"),
        ("date", f"{datetime.now(UTC):%Y-%m-%d}"),
    ]
    return markdown_table(("what", "is"), rows)


def _chapter(part: Part) -> str:
    """A paper's tables, claims and pictures below its citation, or what went wrong."""
    paper, result = part.paper, part.result
    if result is None:
        return f"Not computed:\n\n{indent(part.failure, '    ')}"
    said = f"{result['paper']}. {settings_line(result, paper.note)}"
    pictures = {"Pictures": pictures_words(result["pictures"], f"{PARTS}/{paper.name}/")}
    return f"{said}\n\n{chapters({**paper.told(result), **pictures}, 3)}"
