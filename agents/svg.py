"""Figures as SVG whose colours follow the reader's choice of a light or a dark page."""

from __future__ import annotations

import io
import re

import matplotlib
from matplotlib.backends.backend_svg import FigureCanvasSVG
from matplotlib.collections import QuadMesh
from matplotlib.figure import Figure

from passive_env.palette import BLACK, BLUE, CURVES, GRID, INK, MUTED

WHITE = "#FFFFFF"
BROWN = CURVES[7]
DARK = {
    WHITE: "#15181C", INK: "#E6E8EB", BLACK: "#F5F6F7", MUTED: "#A5ADB6", GRID: "#333A42", BLUE: "#2E8BC9",
    BROWN: "#B07A6E",
}  # fmt: skip
"""What stands for a colour on a dark page; the other colours have contrast enough on both."""

_NAMES = {color.lower(): f"--c{i}" for i, color in enumerate(DARK)}


def as_svg(figure: Figure) -> bytes:
    """A figure as SVG: letters as outlines, meshes as pixels, no time or version in it: equal figures, equal bytes."""
    for mesh in figure.findobj(QuadMesh):
        mesh.set_rasterized(True)
    buffer = io.StringIO()
    with matplotlib.rc_context({"svg.hashsalt": "figure", "svg.fonttype": "path"}):
        FigureCanvasSVG(figure).print_svg(buffer, metadata=dict.fromkeys(("Date", "Creator", "Format", "Type")))
    return _two_coloured(_short(buffer.getvalue())).encode()


def _short(text: str) -> str:
    """Without comments, line breaks and what stands before the picture."""
    text = re.sub(r"<!--.*?-->", "", text[text.index("<svg") :], flags=re.DOTALL)
    return re.sub(r"\s+", " ", text).replace("> <", "><")


def _two_coloured(text: str) -> str:
    """Colours that differ on a dark page become variables, and a style sheet gives them their values.

    Black is what an SVG is filled with where it does not say, so that is a variable too.
    """
    named = re.sub(r"#[0-9a-fA-F]{6}\b", _variable, text)
    light = "".join(f"{name}:{color};" for color, name in _NAMES.items())
    dark = "".join(f"{_NAMES[color.lower()]}:{other};" for color, other in DARK.items())
    rules = f"svg{{fill:var({_NAMES[BLACK.lower()]});{light}}}@media(prefers-color-scheme:dark){{svg{{{dark}}}}}"
    return named.replace("</style>", rules + "</style>", 1)


def _variable(found: re.Match[str]) -> str:
    name = _NAMES.get(found[0].lower())
    return f"var({name})" if name else found[0]
