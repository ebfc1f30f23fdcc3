"""Pictures of a tracked recording: the map and ranges over time, and how well the scans fit."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from scipy.stats import chi2

from agents.pictures import DPI, axes_at, log_ticks, style_diagram
from agents.track_files import Track
from passive_env import artists
from passive_env.palette import INK, MUTED, series_color

MAP_IN, DIAGRAM_IN, ELLIPSES = 5.2, 1.9, 6
"""Sizes of panels, and how many ellipses a track has, the first and the last instant's among them."""

FAR_SHARE = 1.5
"""Tracks are shown as far as this many times the distance of the farthest final estimate, ranges alike."""


def track_picture(track: Track) -> Figure:
    """Above, platforms and tracks with 2σ ellipses at some instants; below, ranges from the reference with 2σ."""
    figure = Figure(figsize=(MAP_IN + 1.0, MAP_IN + DIAGRAM_IN + 2.5), dpi=DPI)
    axes = axes_at(figure, 0.75, DIAGRAM_IN + 2.0, MAP_IN, MAP_IN)
    below = axes_at(figure, 0.75, 1.3, MAP_IN, DIAGRAM_IN)
    artists.style_axes(axes)
    frame = _frame(track)
    artists.set_limits(axes, frame)
    _draw_platforms(axes, track, frame)
    _draw_tracks(axes, track)
    _draw_ranges(below, track)
    figure.suptitle(_title(track), fontsize=12, color=INK, y=1.0 - 0.1 / figure.get_figheight(), va="top")
    artists.bottom_legend(figure, _samples(track), 3)
    return figure


def fit_picture(track: Track) -> Figure:
    """NIS over time with the band of 95 % of a consistent tracker, and below it weights of hypotheses or models."""
    shares = _shares(track)
    figure = Figure(figsize=(7.5, 3.2 + 2.2 * bool(shares)), dpi=DPI, layout="constrained")
    panels = figure.subplots(1 + bool(shares), 1, squeeze=False)[:, 0]
    _draw_fit(panels[0], track)
    if shares:
        _draw_shares(panels[1], track, *shares)
    panels[-1].set_xlabel("time [s]", fontsize=10, color=INK)
    figure.suptitle(_title(track), fontsize=11, color=INK)
    return figure


# -- map and ranges ----------------------------------------------------------------------------------------------------


def _title(track: Track) -> str:
    name = str(track.playback.recording.source).replace("\\", "/").rsplit("/", 1)[-1]
    return f"{name}, tracker {track.playback.scenario.tracker}"


def _sites(track: Track) -> np.ndarray:
    """Transmitters [n, 2] m; none where there are no such."""
    recording = track.playback.recording
    return recording.transmitters[:, :2] if hasattr(recording, "transmitters") else np.empty((0, 2))


def _frame(track: Track) -> artists.Frame:
    """A square that holds platforms, final estimates and whatever part of the tracks is not far off both."""
    fixed = np.concatenate([track.platforms[..., :2].reshape(-1, 2), track.mean[-1, :, :2], _sites(track)])
    middle = track.platforms[:, :, :2].mean((0, 1))
    reach = FAR_SHARE * np.linalg.norm(fixed - middle, axis=-1).max()
    path = track.mean[..., :2].reshape(-1, 2)
    near = path[np.linalg.norm(path - middle, axis=-1) <= reach]
    return artists.grow(None, 1e-3 * np.concatenate([fixed, near]), 1.0)


def _draw_platforms(axes: Axes, track: Track, frame: artists.Frame) -> None:
    recording, d = track.playback.recording, track.platforms.shape[-1] // 2
    paths = track.platforms[..., :2]
    artists.add_lines(axes, [INK], 1.4, alpha=0.75).set_segments(list(1e-3 * np.swapaxes(paths, 0, 1)))
    places = track.platforms[-1][:, [0, 1, d, d + 1]]
    reference = track.playback.scenario.reference % len(places)
    several = len(places) > 1
    names = [f"{n} (ref.)" if several and i == reference else n for i, n in enumerate(recording.stations)]
    notes = [artists.name_tag(axes, name, INK) for name in names]
    for note, state in zip(notes, places, strict=True):
        artists.place_dart(axes.plot([], [], **artists.marker(INK))[0], state)
        artists.place_name(note, state, paths[-1].mean(0), frame)
    artists.part_names(notes, frame)
    for name, place in zip(getattr(recording, "names", ()), 1e-3 * _sites(track), strict=True):
        axes.plot(*place, linestyle="none", marker="^", markersize=7, color=MUTED)
        axes.annotate(name, place, xytext=(6, 4), textcoords="offset points", fontsize=9, color=MUTED)


def _draw_tracks(axes: Axes, track: Track) -> None:
    shown = np.unique(np.linspace(0, len(track.moments) - 1, ELLIPSES).round().astype(int))
    for j in range(track.mean.shape[1]):
        color = series_color(j)
        axes.plot(*(1e-3 * track.mean[:, j, :2].T), color=color, linewidth=1.6, zorder=4)
        outlines = artists.ellipses(track.mean[shown, j, :2], track.cov[shown, j, :2, :2])
        artists.add_ellipses(axes, [color] * len(shown)).set_verts(list(1e-3 * outlines))
        axes.plot(*(1e-3 * track.mean[-1, j, :2]), **artists.ring(color, 10.0))


def _draw_ranges(axes: Axes, track: Track) -> None:
    distance, std, _ = track.sights
    style_diagram(axes, "time [s]", "range [km]")
    for j in range(distance.shape[1]):
        low, high = distance[:, j] - 2.0 * std[:, j], distance[:, j] + 2.0 * std[:, j]
        color = series_color(j)
        axes.fill_between(track.time_s, 1e-3 * np.maximum(low, 0.0), 1e-3 * high, color=color, alpha=0.16, linewidth=0)
        axes.plot(track.time_s, 1e-3 * distance[:, j], color=color, linewidth=1.8)
    axes.set_xlim(track.time_s[0], max(track.time_s[-1], track.time_s[0] + 1.0))
    late = slice(len(distance) // 4, None)  # early spreads may be many times the range
    low, high = (distance - 2.0 * std)[late].min(), (distance + 2.0 * std)[late].max()
    low, high = min(low, distance.min()), max(high, min(distance.max(), FAR_SHARE * high))
    axes.set_ylim(1e-3 * max(low - 0.05 * (high - low), 0.0), 1e-3 * (high + 0.05 * (high - low)))


def _samples(track: Track) -> list[Any]:
    station = Line2D([], [], color=INK, linewidth=1.4, marker="o", markersize=6)
    station.set_label("station, path")
    samples = [
        station, Line2D([], [], color=MUTED, linewidth=1.6, label="track"),
        Line2D([], [], **artists.ring(MUTED, 9.0), label="last estimate"),
        Patch(facecolor=MUTED, alpha=0.25, label="2σ"),
    ]  # fmt: skip
    if len(_sites(track)):
        samples.append(Line2D([], [], linestyle="none", marker="^", color=MUTED, label="transmitter"))
    return samples


# -- fit ---------------------------------------------------------------------------------------------------------------


def _draw_fit(axes: Axes, track: Track) -> None:
    """NIS per degree of freedom; the band is that of each instant's degrees, of the usual ones where there are none."""
    nis, degrees = track.fits
    style_diagram(axes, "", "NIS / degrees")
    for j in range(nis.shape[1]):
        seen = degrees[:, j] > 0.0
        share = np.maximum(nis[seen, j] / degrees[seen, j], 1e-3)
        axes.plot(track.time_s[seen], share, ".", color=series_color(j), markersize=5, label=f"track {j + 1}")
    most = degrees.max(1)
    most = np.where(most > 0.0, most, np.median(most[most > 0.0]) if most.any() else 1.0)
    low, high = (chi2.ppf(p, most) / most for p in (0.025, 0.975))
    axes.fill_between(track.time_s, np.maximum(low, 1e-3), high, color=MUTED, alpha=0.16, linewidth=0, step="mid",
                      label="95 % of a consistent tracker")  # fmt: skip
    axes.axhline(1.0, color=MUTED, linewidth=1.0)
    axes.set_ylim(1e-3, max(20.0, 1.5 * (nis / np.maximum(degrees, 1.0)).max()))
    log_ticks(axes.yaxis, axes.set_yscale)
    axes.legend(loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=4, fontsize=8.5, frameon=False, labelcolor=INK)


def _shares(track: Track) -> tuple[np.ndarray, str] | None:
    """Probabilities of models [k, m, r], else weights of hypotheses [k, m, n], and their name; None without either."""
    for kind, name in (("models", "model"), ("weights", "hypothesis")):
        found = np.stack([getattr(moment, kind) for moment in track.moments])
        if found.shape[-1] > 1:
            return found, name
    return None


def _draw_shares(axes: Axes, track: Track, shares: np.ndarray, name: str) -> None:
    """Models one by one; of hypotheses, which trade places, how many they amount to: 1 / Σ w²."""
    if name == "model":
        style_diagram(axes, "", "probability of model")
        for r in range(shares.shape[-1]):
            axes.plot(track.time_s, shares[:, 0, r], color=series_color(r), linewidth=1.5, label=f"model {r + 1}")
        axes.set_ylim(0.0, 1.0)
        axes.legend(fontsize=8.5, frameon=False, labelcolor=INK, ncols=3)
        return
    style_diagram(axes, "", "hypotheses, effective")
    for j in range(shares.shape[1]):
        effective = 1.0 / np.maximum(np.square(shares[:, j]).sum(-1), 1e-12)
        axes.plot(track.time_s, effective, color=series_color(j), linewidth=1.5)
    axes.set_ylim(0.0, shares.shape[-1])
