"""Colours of all pictures: the Okabe–Ito set, which people with any common colour blindness can tell apart.

Source: Okabe & Ito (2008), "Color Universal Design".
"""

from __future__ import annotations

BLACK = "#000000"
ORANGE = "#E69F00"
SKY_BLUE = "#56B4E9"
GREEN = "#009E73"
BLUE = "#0072B2"
VERMILION = "#D55E00"
PURPLE = "#CC79A7"

INK = "#222222"
"""Text and stations."""
MUTED = "#6E6E6E"
"""Legend samples that stand for any target, intervals that include the baseline."""
GRID = "#E3E3E3"

SERIES = (BLUE, VERMILION, GREEN, ORANGE, PURPLE, SKY_BLUE)
"""Targets, tracks and policies, in order; yellow is left out (too pale on white), black is the stations'."""

CURVES = (*SERIES, BLACK, "#8C564B", "#999999")
"""Curves of a diagram without stations: the same, then black, a brown that lies between the set's hues, and a grey."""

GOOD, BAD = BLUE, VERMILION
"""Better and worse than a baseline."""


def series_color(i: int) -> str:
    """Colour of the i-th target, track or policy; the set repeats after six."""
    return SERIES[i % len(SERIES)]


def curve_color(i: int) -> str:
    """Colour of the i-th curve; the set repeats after nine."""
    return CURVES[i % len(CURVES)]
