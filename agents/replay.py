"""A replay: policies side by side on the same tape, as one page that needs nothing else, or as an animation.

The page holds the episode's layers (`passive_env.layers`) as numbers and plotly.js to draw them. What happens when
somebody plays, scrubs or switches is in ``replay.js``; how it looks is in ``replay.html``.
"""

from __future__ import annotations

import base64
import html
import json
from collections.abc import Iterable, Mapping
from importlib import resources
from pathlib import Path
from string import Template
from typing import Any

import numpy as np

from agents.files import atomic_write
from agents.pictures import error_limits
from agents.replay_record import EpisodeRecord, ViewRecord
from passive_env.artists import Frame, edge_points, grow
from passive_env.extras import needs
from passive_env.layers import STYLES
from passive_env.palette import INK, MUTED, SERIES, curve_color

ASPECTS = (0.8, 1.5)
"""Widths of maps over their heights."""
LARGEST = 1e30
"""Beyond this a diverged track's numbers are not drawn."""
FARTHEST_KM = 1e6
"""Distances are told up to this."""
OFF_MAP = "estimates off the map"
"""Layer of arrows at the edge of a view."""


def write_replay(
    path: str | Path, environment: str, seed: int, axis: str, records: Mapping[str, EpisodeRecord]
) -> Path:
    """Write the page.

    Args:
        path: FILE.html.
        environment: its id.
        seed: of the episode.
        axis: what `EpisodeRecord.at` counts.
        records: per policy, of the same episode.
    Raises:
        ValueError: no policy, or policies with other instants; ImportError: plotly is missing.
    """
    return atomic_write(path, replay_page(environment, seed, axis, records))


def replay_page(environment: str, seed: int, axis: str, records: Mapping[str, EpisodeRecord]) -> str:
    """The page's HTML; arguments as of `write_replay`."""
    _check(records)
    heading = f"{environment}: {', '.join(records)}"
    same = "the same targets, noise and detections for every policy" if len(records) > 1 else "one policy"
    files = resources.files("agents")
    return Template((files / "replay.html").read_text(encoding="utf-8")).substitute(
        title=html.escape(f"Replay of {environment}, seed {seed}"),
        heading=html.escape(heading),
        summary=html.escape(f"Episode of seed {seed}; {same}."),
        data=json.dumps(page_data(axis, records), allow_nan=False, separators=(",", ":")).replace("<", "\\u003c"),
        plotly=plotly_script(),
        script=(files / "replay.js").read_text(encoding="utf-8"),
    )


def plotly_script() -> str:
    """plotly.js, as its Python package holds it.

    Raises:
        ImportError: the package is missing.
    """
    return needs("plotly.offline", "web").get_plotlyjs()


def _check(records: Mapping[str, EpisodeRecord]) -> None:
    if not records:
        raise ValueError("records: needs at least one policy")
    first = next(iter(records.values()))
    for name, record in records.items():
        if record.labels != first.labels:
            raise ValueError(
                f"records[{name!r}] has {len(record.labels)} instants that are not those of the first policy "
                f"({len(first.labels)}): all must be of the same episode"
            )


def page_data(axis: str, records: Mapping[str, EpisodeRecord]) -> dict[str, Any]:
    """What the script needs, in JSON's own types; arrays as base64 of 32-bit floats."""
    first = next(iter(records.values()))
    frames = [frame_of(parts) for parts in zip(*(record.views for record in records.values()), strict=True)]
    names = {name for record in records.values() for view in record.views for name in view.layers} | {OFF_MAP}
    return {
        "axis": axis, "at": first.at.tolist(), "labels": first.labels, "series": SERIES, "ink": INK, "muted": MUTED,
        "styles": {name: style._asdict() for name, style in STYLES.items() if name in names},
        "limits": {kind: _limits(kind, records.values()) for kind in first.errors},
        "policies": [
            _policy(name, curve_color(i), record, frames) for i, (name, record) in enumerate(records.items())
        ],
    }  # fmt: skip


def _limits(kind: str, records: Iterable[EpisodeRecord]) -> tuple[float, float]:
    return error_limits(np.concatenate([np.ravel(part) for record in records for part in record.errors[kind]]))


def _policy(name: str, color: str, record: EpisodeRecord, frames: list[Frame | None]) -> dict[str, Any]:
    return {
        "name": name, "color": color,
        "views": [_view(view, frame) for view, frame in zip(record.views, frames, strict=True)],
        "errors": {kind: [pack(part) for part in pair] for kind, pair in record.errors.items()},
        "rewards": {term: pack(values) for term, values in record.rewards.items()},
        "probabilities": {word: pack(values) for word, values in record.probabilities.items()},
    }  # fmt: skip


def _view(view: ViewRecord, frame: Frame | None) -> dict[str, Any]:
    layers = view.layers if frame is None else view.layers | _off_map(view, frame)
    return {
        "name": view.name, "axes": view.axes, "names": view.names, "equal": view.equal,
        "frame": None if frame is None else [*frame.low.tolist(), *frame.high.tolist()],
        "reach": None if view.reach is None else pack(view.reach),
        "layers": {name: pack(layers[name]) for name in STYLES if name in layers},
    }  # fmt: skip


def pack(values: np.ndarray) -> dict[str, Any]:
    """An array as base64 of little-endian 32-bit floats; what is not finite, or larger than they can be, as NaN."""
    values = np.asarray(values, dtype=float)
    content = np.where(np.abs(values) < LARGEST, values, np.nan).astype("<f4").tobytes()
    return {"shape": values.shape, "f32": base64.b64encode(content).decode()}


# -- frames ------------------------------------------------------------------------------------------------------------


def frame_of(views: Iterable[ViewRecord]) -> Frame | None:
    """Axis limits that hold what a view shows under all policies, or None where axes follow the instant.

    Estimates may fall outside.
    """
    views = list(views)
    if views[0].reach is not None:
        return None
    parts = [points_of(name, rows) for view in views for name, rows in view.layers.items() if STYLES[name].frames]
    points = np.concatenate(parts)
    low, high = points.min(0), points.max(0)
    if views[0].equal:
        width, height = np.maximum(high - low, 1.0)
        return grow(None, points, float(np.clip(width / height, *ASPECTS)))
    low = np.minimum(low, (np.inf, 0.0))  # the ground
    margin = np.maximum((0.05, 0.15) * (high - low), 0.5)
    return Frame(low - margin, high + margin)


def points_of(name: str, rows: np.ndarray) -> np.ndarray:
    """Points [n, 2] that an axis must hold to show a layer [k, g, n, c]."""
    shape, flat = STYLES[name].shape, rows.reshape(-1, rows.shape[-1])
    flat = flat[np.isfinite(flat[:, :2]).all(-1)]
    if shape == "line":
        return flat.reshape(-1, 2)
    if shape == "ellipse":
        extent = np.hypot(flat[:, 2:4], flat[:, 4:6])
        return np.concatenate([flat[:, :2] - extent, flat[:, :2] + extent])
    return flat[:, :2]


def _off_map(view: ViewRecord, frame: Frame) -> dict[str, np.ndarray]:
    """Arrows at the edge towards estimates outside a frame: x, y, course and distance from the middle; or nothing."""
    estimates = view.layers.get("estimates")
    if estimates is None:
        return {}
    middle = 0.5 * (frame.low + frame.high)
    ends = estimates.reshape(-1, 2)
    points, outside = edge_points(middle, np.where(np.isfinite(ends), ends, middle), frame)
    way = ends - middle
    course = np.degrees(np.arctan2(way[:, 1], way[:, 0]))
    arrows = np.column_stack([points, course, np.minimum(np.hypot(*way.T), FARTHEST_KM)])
    arrows[~outside] = np.nan
    return {OFF_MAP: arrows.reshape(*estimates.shape[:-1], 4)} if outside.any() else {}
