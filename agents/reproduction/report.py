"""The form every reproduced paper's result takes: claims with verdicts, tables in text, pictures, files."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from agents.files import make_folder, save_figure, write_json, write_text

REPRODUCED, NOT_REPRODUCED, NOT_TESTABLE = VERDICTS = ("reproduced", "not reproduced", "not testable")


def prepare(runs: int, seeds: Sequence[int], out: Path | None) -> None:
    """Refuse what leaves nothing to compute, and make the folder, before anything is computed.

    Raises:
        ValueError: no run, no seed, or a negative one.
    """
    if runs < 1 or not seeds:
        raise ValueError(f"--runs {runs} --seeds {' '.join(map(str, seeds))}: need at least one of each")
    if min(seeds) < 0:
        raise ValueError(f"--seeds {' '.join(map(str, seeds))}: must not be negative")
    if out is not None:
        make_folder(out)


def document(result: Mapping[str, Any], sections: Mapping[str, str], note: str = "") -> str:
    """A reproduction as text (Markdown): the paper, what was run, a section per head, and the claims.

    Args:
        result: with paper, settings (runs, seeds) and claims.
        sections: text per head.
        note: said beside what was run, such as units.
    """
    settings, claims = result["settings"], result["claims"]
    title = f"{settings['runs']} runs for each of the seeds {', '.join(map(str, settings['seeds']))}."
    judged = {"Claims": verdict_line(claims) + "\n\n" + claims_table(claims)}
    body = "\n\n".join(f"## {head}\n\n{text}" for head, text in {**sections, **judged}.items())
    return f"# {result['paper']}\n\n{' '.join(filter(None, (title, note)))}\n\n{body}"


def claim(source: str, text: str, paper: Any, ours: Any, verdict: str | bool, interval: Any = None) -> dict[str, Any]:
    """One statement of a paper beside what we find.

    Args:
        source: section of the specification.
        text: the statement, with the criterion it is judged by.
        paper, ours: the two values, numbers (lists per target) or words.
        verdict: one of `VERDICTS`, or whether the criterion is met.
        interval: 95 % interval of `ours`, (low, high), where there is one.
    Raises:
        ValueError: unknown verdict.
    """
    if isinstance(verdict, (bool, np.bool_)):
        verdict = REPRODUCED if verdict else NOT_REPRODUCED
    if verdict not in VERDICTS:
        raise ValueError(f"verdict {verdict!r} of claim {text!r}: must be one of {', '.join(map(repr, VERDICTS))}")
    values = {"paper": paper, "ours": ours, "interval": None if interval is None else list(interval)}
    return {"source": source, "claim": text, **{key: _listed(v) for key, v in values.items()}, "verdict": verdict}


def within(ours: Any, paper: Any, relative: float = 0.0, absolute: float = 0.0) -> bool:
    """Whether every entry of `ours` lies within relative · |paper| + absolute of `paper`."""
    ours, paper = np.asarray(ours), np.asarray(paper)
    return bool((np.abs(ours - paper) <= relative * np.abs(paper) + absolute).all())


def markdown_table(header: Sequence[str], rows: Iterable[Sequence[Any]]) -> str:
    """A Markdown table with padded columns, so that it also reads as plain text."""
    cells = [list(header), *([words(value).replace("|", "\\|") for value in row] for row in rows)]
    widths = [max(map(len, column)) for column in zip(*cells, strict=True)]
    lines = [
        "| " + " | ".join(text.ljust(width) for text, width in zip(row, widths, strict=True)) + " |" for row in cells
    ]
    lines.insert(1, "|" + "|".join("-" * (width + 2) for width in widths) + "|")
    return "\n".join(lines)


def words(value: Any) -> str:
    """A number with three significant digits, a list of them joined by ' / ', other things as they are; None as ''."""
    if value is None:
        return ""
    if isinstance(value, (list, tuple, np.ndarray)):
        return " / ".join(map(words, value))
    if isinstance(value, (float, np.floating)):
        return f"{value:.1f}" if abs(value) >= 100 else f"{value:.3g}"
    return str(value)


def claims_table(claims: Sequence[Mapping[str, Any]]) -> str:
    """All claims as a Markdown table."""
    header = ("source", "claim", "paper", "ours", "95 % interval", "verdict")
    rows = [
        (c["source"], c["claim"], c["paper"], c["ours"], _interval_words(c["interval"]), c["verdict"]) for c in claims
    ]
    return markdown_table(header, rows)


def verdict_line(claims: Sequence[Mapping[str, Any]]) -> str:
    """How many claims got which verdict."""
    counts = {verdict: sum(c["verdict"] == verdict for c in claims) for verdict in VERDICTS}
    return f"{len(claims)} claims: " + ", ".join(f"{count} {verdict}" for verdict, count in counts.items())


def write_reproduction(out: Path, result: Mapping[str, Any], text: str, figures: Mapping[str, Figure]) -> list[Path]:
    """Write `reproduction.json`, `reproduction.md` and one PNG per figure into a folder; returns the paths."""
    paths = [save_figure(out / f"{name}.png", figure) for name, figure in figures.items()]
    pictures = "\n\n".join(f"![{name}]({name}.png)" for name in figures)
    paths.append(write_text(out / "reproduction.md", f"{text}\n\n## Pictures\n\n{pictures}"))
    paths.append(write_json(out / "reproduction.json", result))
    return paths


def _interval_words(interval: Any) -> str:
    """Interval per target: 'low to high / low to high'."""
    if interval is None:
        return ""
    low, high = (np.atleast_1d(end) for end in interval)
    return " / ".join(f"{words(float(a))} to {words(float(b))}" for a, b in zip(low, high, strict=True))


def _listed(value: Any) -> Any:
    """NumPy arrays and numbers as Python's own, inside lists too."""
    if isinstance(value, (np.ndarray, np.generic)):
        return value.tolist()
    return [_listed(item) for item in value] if isinstance(value, (list, tuple)) else value
