"""The form every reproduced paper's result takes: claims with verdicts, tables in text, pictures, files."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from agents.files import make_folder, save_figure, write_json, write_text

REPRODUCED, NOT_REPRODUCED, NOT_TESTABLE = VERDICTS = ("reproduced", "not reproduced", "not testable")

PAPER, SPEC = ORIGINS = ("paper", "specification")
"""Whose statement a claim is.

paper: the authors publish it, as a value of a table or as a sentence. Where a sentence names no number, the criterion
    is ours and stands in the claim's text.
specification: it was computed for this project's specification of the paper, concluded there, or set by this project
    as a threshold. That we meet it says that two of our computations agree, not that the paper is right.
"""

HEADS = {PAPER: "What the authors claim", SPEC: "Our own cross-checks"}
COUNTED = {PAPER: "claims", SPEC: "cross-checks"}
"""By origin: heading above the statements, what they are counted as."""

RESULT = "reproduction.json"


class Paper(NamedTuple):
    """How a paper is repeated and told.

    Attributes:
        name: on the command line, and of its folder.
        subject: a heading, in ASCII.
        reproduce: runs, seeds and out (a folder or None) to the result: plain data with paper, settings and claims.
        sections: result to text per head, the tables.
        basis: by origin, what the claims rest on, in sentences.
        note: said beside what was run, such as units.
    """

    name: str
    subject: str
    reproduce: Callable[..., dict[str, Any]]
    sections: Callable[[Mapping[str, Any]], dict[str, str]]
    basis: Mapping[str, str]
    note: str = ""

    def words(self, result: Mapping[str, Any]) -> str:
        """The whole result as text (Markdown): the paper, what was run, a section per head, and the claims."""
        return f"# {result['paper']}\n\n{settings_line(result, self.note)}\n\n{chapters(self.told(result), 2)}"

    def told(self, result: Mapping[str, Any]) -> dict[str, str]:
        """The tables, then the claims by their origin: text per head."""
        return {**self.sections(result), **judgements(result["claims"], self.basis)}


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


def settings_line(result: Mapping[str, Any], note: str = "") -> str:
    """What was run, and a note."""
    settings = result["settings"]
    line = f"{settings['runs']} runs for each of the seeds {', '.join(map(str, settings['seeds']))}."
    return " ".join(filter(None, (line, note)))


def chapters(texts: Mapping[str, str], level: int) -> str:
    """Texts below their headings of one level (Markdown)."""
    return "\n\n".join(f"{'#' * level} {head}\n\n{text}" for head, text in texts.items())


def pictures_words(pictures: Mapping[str, str], folder: str = "") -> str:
    """Pictures (Markdown): what each shows by file name, in a folder given with its '/'."""
    return "\n\n".join(f"![{_bare(shown)}]({folder}{name})" for name, shown in pictures.items())


def _bare(text: str) -> str:
    """Text without the brackets that end a picture's description in Markdown."""
    return text.replace("[", "(").replace("]", ")")


def claim(
    origin: str, source: str, text: str, stated: Any, ours: Any, verdict: str | bool, interval: Any = None
) -> dict[str, Any]:
    """One statement beside what we find.

    Args:
        origin: whose it is, one of `ORIGINS`.
        source: where it stands, a section of the document that `origin` names.
        text: the statement, with the criterion it is judged by.
        stated, ours: the two values, numbers (lists per target) or words.
        verdict: one of `VERDICTS`, or whether the criterion is met.
        interval: 95 % interval of `ours`, (low, high), where there is one.
    Raises:
        ValueError: unknown origin or verdict.
    """
    if isinstance(verdict, (bool, np.bool_)):
        verdict = REPRODUCED if verdict else NOT_REPRODUCED
    for name, value, known in (("origin", origin, ORIGINS), ("verdict", verdict, VERDICTS)):
        if value not in known:
            raise ValueError(f"{name} {value!r} of claim {text!r}: must be one of {', '.join(map(repr, known))}")
    values = {"stated": stated, "ours": ours, "interval": None if interval is None else list(interval)}
    values = {key: _listed(value) for key, value in values.items()}
    return {"origin": origin, "source": source, "claim": text, **values, "verdict": verdict}


def within(ours: Any, stated: Any, relative: float = 0.0, absolute: float = 0.0) -> bool:
    """Whether every entry of `ours` lies within relative · |stated| + absolute of `stated`."""
    ours, stated = np.asarray(ours), np.asarray(stated)
    return bool((np.abs(ours - stated) <= relative * np.abs(stated) + absolute).all())


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


def judgements(claims: Sequence[Mapping[str, Any]], basis: Mapping[str, str]) -> dict[str, str]:
    """Counts and table of the claims of each origin that has any, the paper's own first: text per head (Markdown)."""
    texts, begun = {}, 1
    for origin in ORIGINS:
        if found := of_origin(claims, origin):
            said = f"{verdict_line(found, COUNTED[origin])}. {basis[origin]}"
            texts[HEADS[origin]] = f"{said}\n\n{claims_table(found, origin, begun)}"
            begun += len(found)
    return texts


def of_origin(claims: Sequence[Mapping[str, Any]], origin: str) -> list[Mapping[str, Any]]:
    """The claims of one origin, in their order."""
    return [c for c in claims if c["origin"] == origin]


def claims_table(claims: Sequence[Mapping[str, Any]], origin: str, begun: int = 1) -> str:
    """Claims of one origin as a Markdown table: verdict and claim in front, where a phone shows them.

    Args:
        begun: number of the first one.
    """
    header = ("no.", "verdict", "claim", origin, "ours", "95 % interval", f"section of the {origin}")
    return markdown_table(header, ((i, *claim_cells(c)) for i, c in enumerate(claims, begun)))


def claim_cells(c: Mapping[str, Any]) -> tuple[Any, ...]:
    """A claim's row of `claims_table`, after its number."""
    return (c["verdict"], c["claim"], c["stated"], c["ours"], _interval_words(c["interval"]), c["source"])


def verdict_line(claims: Sequence[Mapping[str, Any]], counted: str) -> str:
    """How many claims got which verdict."""
    counts = verdict_counts(claims)
    return f"{len(claims)} {counted}: " + ", ".join(f"{count} {verdict}" for verdict, count in counts.items())


def verdict_counts(claims: Sequence[Mapping[str, Any]]) -> dict[str, int]:
    """Number of claims by verdict."""
    return {verdict: sum(c["verdict"] == verdict for c in claims) for verdict in VERDICTS}


def write_reproduction(out: Path, result: Mapping[str, Any], text: str, figures: Mapping[str, Figure]) -> list[Path]:
    """Write one PNG per figure, `reproduction.md` and, last, `reproduction.json` into a folder; returns the paths.

    The JSON holds the result and, by file name, what the pictures show.
    """
    paths = [save_figure(out / f"{name}.png", figure) for name, figure in figures.items()]
    pictures = {f"{name}.png": described(figure) for name, figure in figures.items()}
    paths.append(write_text(out / "reproduction.md", f"{text}\n\n## Pictures\n\n{pictures_words(pictures)}"))
    paths.append(write_json(out / RESULT, {**result, "pictures": pictures}))
    return paths


def described(figure: Figure) -> str:
    """What a figure shows in words, for those who cannot see it: titles, axes, curves."""
    title = figure.get_suptitle()
    panels = [_panel_words(axes) for axes in figure.axes]
    curves = [text.get_text() for legend in figure.legends for text in legend.get_texts()]
    return ". ".join(filter(None, (title, *panels, f"Curves: {'; '.join(curves)}" if curves else "")))


def _panel_words(axes: Axes) -> str:
    """A panel's title, 'what over what', and its legend; a color bar's quantity."""
    title, across, up = axes.get_title() or axes.get_title("left"), axes.get_xlabel(), axes.get_ylabel()
    if axes.get_label() == "<colorbar>":
        return f"Color: {up or across}"
    quantities = " over ".join(filter(None, (up, across)))
    legend = axes.get_legend()
    curves = "; ".join(text.get_text() for text in legend.get_texts()) if legend else ""
    return ": ".join(filter(None, (title, quantities))) + (f" (curves: {curves})" if curves else "")


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
