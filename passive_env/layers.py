"""What a drawing of an instant holds, as plain numbers, layer by layer: what the replay's page draws.

A layer is an array [g, n, c] of n things in each of g groups (a colour each); c is what the layer's shape needs:

    dart      x, y, course [°, counter-clockwise from east, NaN: a dot]
    dot       x, y, weight (area and opacity)
    ring      x, y
    cross     x, y
    site      x, y
    square    x, y
    line      x₁, y₁, x₂, y₂
    ellipse   x, y of the middle, then of one end of two conjugate half axes, as seen from the middle
    path      x, y; n points of one line

NaN is what is not there. Lengths are km, unless a view says otherwise. Pictures (`passive_env.render` and its
neighbours) are made of the same functions.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from passive_env.palette import BLUE, GREEN, INK, MUTED, ORANGE, PURPLE, VERMILION

ELLIPSE_STD = 2.0
"""Half axes of a covariance ellipse in standard deviations."""
SENSOR_COLORS = (VERMILION, ORANGE)
"""Returns and gates of platform 0 and 1; the target and its track are blue."""


class Style(NamedTuple):
    """How a layer looks.

    Attributes:
        shape: one of those above.
        colors: of its groups, in order; empty: the colours of series, as targets have them.
        switch: layers with the same words are switched together; empty: a layer's own name.
        trail: whether a line shows where its things have been.
        dash: of its lines, as plotly names it.
        width: of its lines [px].
        opacity: of its lines.
        fill: opacity of the area inside.
        size: of its markers [px].
        open: whether markers are hollow.
        frames: whether the axes must hold it.
        named: whether names stand beside its markers.
    """

    shape: str
    colors: tuple[str, ...] = ()
    switch: str = ""
    trail: bool = False
    dash: str = "solid"
    width: float = 1.2
    opacity: float = 1.0
    fill: float = 0.0
    size: float = 13.0
    open: bool = False
    frames: bool = False
    named: bool = False


GATE: dict[str, Any] = {"colors": SENSOR_COLORS, "switch": "gates", "dash": "dot"}
RETURN: dict[str, Any] = {"colors": SENSOR_COLORS, "switch": "returns"}
STYLES = {
    "where sensors may be": Style("path", (MUTED,), dash="dash", frames=True),
    "expected courses": Style("line", (BLUE,), opacity=0.6, frames=True),
    "where the target enters": Style("path", (BLUE,), switch="expected courses", opacity=0.6, frames=True),
    "no-go discs": Style("ellipse", (MUTED,), fill=0.15, frames=True),
    "stand-off rings": Style("ellipse", dash="dash"),
    "2σ ellipses": Style("ellipse", fill=0.16),
    "bearings used": Style("line", opacity=0.45, width=1.0),
    "gates": Style("line", **GATE),
    "gate": Style("ellipse", **GATE),
    "returns": Style("line", **RETURN, opacity=0.7, width=1.0),
    "returns by weight": Style("dot", **RETURN),
    "range sums": Style("ellipse", (GREEN,), opacity=0.8),
    "echoes": Style("line", (BLUE,), opacity=0.45, width=1.0),
    "blocked (the truth)": Style("square", ("#A8A8A8",), size=22.0),
    "other transmitters": Style("site", (INK,), switch="transmitters", size=11.0, open=True, frames=True),
    "transmitters": Style("site", (INK,), size=11.0, frames=True),
    "echo missed": Style("cross", (VERMILION,), switch="transmitters", size=10.0),
    "ghost": Style("cross", (PURPLE,), size=11.0),
    "range hypotheses": Style("dot"),
    "position fix": Style("cross", (VERMILION,), size=9.0),
    "its 2σ ellipse": Style("ellipse", (VERMILION,), switch="position fix", dash="dot"),
    "true acceleration": Style("line", width=2.0),
    "estimated acceleration": Style("ring", size=11.0),
    "true direction": Style("cross", (BLUE,), size=11.0),
    "true targets": Style("dart", trail=True, width=2.2, size=11.0, frames=True),
    "estimates": Style("ring", size=17.0),
    "estimates off the map": Style("dart", switch="estimates", size=15.0, open=True),
    "platforms": Style("dart", (INK,), trail=True, width=1.5, frames=True, named=True),
    "sensors without range": Style("site", (INK,), switch="platforms", size=13.0, frames=True),
}
"""How layers look, by name; those that come first are drawn below the others."""


class View(NamedTuple):
    """One drawing of an instant.

    Attributes:
        name: what it shows; "map" is the view from above.
        axes: titles of the horizontal and vertical axis, with their unit.
        layers: by name, each [g, n, c].
        names: by layer, what its things are called.
        reach: half width of axes that follow the instant and have 0 in the middle; None: they hold still.
        equal: whether both axes have the same scale.
    """

    name: str
    axes: tuple[str, str]
    layers: dict[str, np.ndarray]
    names: dict[str, tuple[str, ...]] = {}  # noqa: RUF012  a NamedTuple's default; nobody writes to it
    reach: float | None = None
    equal: bool = True


class Instant(NamedTuple):
    """What there is to see at one instant, m targets.

    Attributes:
        at: place on the time axis.
        label: in words.
        views: the map first.
        errors: by kind ("range", "position"), the error [m] m and its Cramér–Rao bound [m] m.
        probabilities: by name.
    """

    at: float
    label: str
    views: tuple[View, ...]
    errors: dict[str, tuple[np.ndarray, np.ndarray]]
    probabilities: dict[str, float]


PLAN = ("east [km]", "north [km]")
"""Axes of the view from above."""


def half_axes(cov: Any) -> np.ndarray:
    """Half axes [..., 2, 2], a row each, of the 2σ ellipses of covariances [..., 2, 2]; 0 where one is not finite."""
    finite = np.isfinite(cov).all((-2, -1), keepdims=True)
    values, vectors = np.linalg.eigh(np.where(finite, cov, 0.0))
    return np.swapaxes(vectors * (ELLIPSE_STD * np.sqrt(np.maximum(values, 0.0)))[..., None, :], -1, -2)


def ellipse_rows(mean_m: Any, cov: Any) -> np.ndarray:
    """Ellipses [..., 6] km of means [..., 2] m and covariances [..., 2, 2] m²."""
    axes = half_axes(cov)
    return 1e-3 * np.concatenate([mean_m, axes[..., 0, :], axes[..., 1, :]], axis=-1)


def circle_rows(center_m: Any, radius_m: Any) -> np.ndarray:
    """Circles [..., 6] km about centers [..., 2] m with a radius [...] m."""
    center_m = np.asarray(center_m)
    radius = np.broadcast_to(radius_m, center_m.shape[:-1])[..., None]
    zero = np.zeros_like(radius)
    return 1e-3 * np.concatenate([center_m, radius, zero, zero, radius], axis=-1)


def course_deg(state: Any) -> np.ndarray:
    """Courses [...] degrees, counter-clockwise from east, of states [..., 4]; NaN where one has none.

    Rounding is no motion, turning on the spot is.
    """
    vx, vy = np.asarray(state)[..., 2], np.asarray(state)[..., 3]
    return np.where(np.hypot(vx, vy) > 1e-7, np.degrees(np.arctan2(vy, vx)), np.nan)


def dart_rows(state_m: Any) -> np.ndarray:
    """Darts [..., 3] of states [..., 4] m, m/s in the plane of the picture."""
    state_m = np.asarray(state_m)
    return np.concatenate([1e-3 * state_m[..., :2], course_deg(state_m)[..., None]], axis=-1)


def line_rows(segments_m: Any) -> np.ndarray:
    """Lines [..., 4] km of segments [..., 2, 2] m."""
    segments_m = np.asarray(segments_m)
    return 1e-3 * segments_m.reshape(*segments_m.shape[:-2], 4)


def dot_rows(position: Any, weight: Any) -> np.ndarray:
    """Dots [..., 3] of positions [..., 2] in the view's unit and weights [...]; negligible ones are left out."""
    rows = np.concatenate([position, np.asarray(weight)[..., None]], axis=-1)
    return np.where(rows[..., 2:] > 1e-3, rows, np.nan)


def clock(step: int, scenario: Any) -> tuple[float, str]:
    """Time [s] of a step, and the same in words."""
    time_s = step * scenario.step_s
    return time_s, f"t = {time_s:g} s (step {step} of {scenario.steps})"


def errors_of(metrics: Any, score: str) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Error and bound [m] m, of what policies are compared by and of the range, in a batch of one."""
    kinds = dict.fromkeys((score, "range"))
    return {kind: (getattr(metrics, f"{kind}_error_m")[0], getattr(metrics, f"{kind}_crlb_m")[0]) for kind in kinds}


def numbered(word: str, count: int, first: int = 1) -> tuple[str, ...]:
    """Names of several things: the only one needs no number."""
    return tuple(f"{word} {i + first}" for i in range(count)) if count > 1 else (word,)
