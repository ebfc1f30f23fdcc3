"""What a tracker found in a recording, as tables: CSV of every instant, a summary for JSON, a policy's advice."""

from __future__ import annotations

import csv
import io
import math
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from scipy.stats import chi2

from passive_env.playback import Moment, Playback

AXES = {2: ("east", "north"), 3: ("east", "north", "up")}


@dataclass(frozen=True)
class Track:
    """A tracker's way through a recording; k instants, m tracks, d coordinates.

    Attributes:
        playback: recording and settings.
        moments: [k] from the tracks' start on.
        commands: [k, a] a policy's, at every instant; [0] without a policy.
    """

    playback: Playback
    moments: list[Moment]
    commands: np.ndarray

    @cached_property
    def time_s(self) -> np.ndarray:
        """[k] s."""
        return self.playback.recording.time_s[self.moments[0].index :]

    @cached_property
    def mean(self) -> np.ndarray:
        """[k, m, 2d] m, m/s."""
        return np.concatenate([moment.world.estimate.mean for moment in self.moments])

    @cached_property
    def cov(self) -> np.ndarray:
        """[k, m, 2d, 2d]."""
        return np.concatenate([moment.world.estimate.cov for moment in self.moments])

    @cached_property
    def platforms(self) -> np.ndarray:
        """[k, s, 2d] m, m/s."""
        return np.concatenate([moment.world.platforms for moment in self.moments])

    @cached_property
    def sights(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """From the reference to the tracks: range and its standard deviation [k, m] m, bearing [k, m] deg from north.

        σ² = uᵀ P u, u the unit vector of the line of sight.
        """
        d = self.mean.shape[-1] // 2
        line = self.mean[..., :d] - self.platforms[:, None, self.playback.scenario.reference, :d]
        distance = np.linalg.norm(line, axis=-1)
        along = line / np.maximum(distance, 1.0)[..., None]
        variance = np.einsum("kmi,kmij,kmj->km", along, self.cov[..., :d, :d], along)
        return distance, np.sqrt(np.maximum(variance, 0.0)), np.degrees(np.arctan2(line[..., 0], line[..., 1])) % 360.0

    @cached_property
    def fits(self) -> tuple[np.ndarray, np.ndarray]:
        """NIS and its degrees of freedom [k, m]; 0 of 0 at the start and where a track got nothing."""
        none = np.zeros(self.mean.shape[1])
        found = [(none, none) if moment.fit is None else moment.fit[:2] for moment in self.moments]
        nis, degrees = (np.array(column, dtype=float) for column in zip(*found, strict=True))
        return nis, degrees

    @cached_property
    def on_earth(self) -> np.ndarray | None:
        """Latitude, longitude [deg] and in space height [m], [k, m, d]; None where the recording has metres."""
        frame, d = self.playback.recording.frame, self.mean.shape[-1] // 2
        if frame is None:
            return None
        places = np.moveaxis(self.mean[..., :d], -1, 0)
        found = frame.ground(*places) if d == 2 else frame.geodetic(*places)
        return np.concatenate([np.degrees(found[..., :2]), found[..., 2:]], axis=-1)


# -- every instant -----------------------------------------------------------------------------------------------------


def track_csv(track: Track) -> str:
    """A row per instant and track."""
    rows = [row for k in range(len(track.moments)) for row in _rows(track, k)]
    names = list(dict.fromkeys(name for row in rows for name in row))
    return _csv(names, rows)


def _csv(names: list[str], rows: list[dict[str, Any]]) -> str:
    buffer = io.StringIO()
    writer = csv.DictWriter(buffer, names, restval="", lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    return buffer.getvalue()


def _rows(track: Track, k: int) -> list[dict[str, Any]]:
    moment = track.moments[k]
    nis, degrees = track.fits
    distance, distance_std, bearing = track.sights
    rows = []
    for j in range(track.mean.shape[1]):
        row: dict[str, Any] = {"time_s": float(track.time_s[k]), "track": j + 1}
        row |= _state(track.mean[k, j], track.cov[k, j])
        row |= {
            "range_m": float(distance[k, j]), "range_std_m": float(distance_std[k, j]),
            "bearing_deg": float(bearing[k, j]),
        }  # fmt: skip
        if track.on_earth is not None:
            names = ("latitude_deg", "longitude_deg", "height_m")
            row |= {name: float(value) for name, value in zip(names, track.on_earth[k, j], strict=False)}
        row |= dict.fromkeys(("nis", "nis_degrees", "log_likelihood", "used"), "")
        if moment.fit is not None:
            row |= {
                "nis": float(nis[k, j]), "nis_degrees": int(degrees[k, j]),
                "log_likelihood": float(moment.fit.log_likelihood[j]), "used": _used(track, moment.fit.used[j]),
            }  # fmt: skip
        row |= {f"weight_{i + 1}": float(weight) for i, weight in enumerate(moment.weights[j])}
        row |= {f"model_{i + 1}": float(share) for i, share in enumerate(moment.models[j])}
        rows.append(row)
    return rows


def _state(mean: np.ndarray, cov: np.ndarray) -> dict[str, float]:
    """Columns of a state, its standard deviations and the covariance's upper triangle."""
    names = _state_names(len(mean) // 2)
    units = ["m"] * (len(mean) // 2) + ["m_s"] * (len(mean) // 2)
    std = np.sqrt(np.maximum(np.diagonal(cov), 0.0))
    told = {f"{name}_{unit}": float(value) for name, unit, value in zip(names, units, mean, strict=True)}
    told |= {f"std_{name}_{unit}": float(value) for name, unit, value in zip(names, units, std, strict=True)}
    for i, name in enumerate(names):
        told |= {f"cov_{name}_{names[j]}": float(cov[i, j]) for j in range(i, len(names))}
    return told


def _state_names(d: int) -> list[str]:
    return [*AXES[d], *(f"velocity_{axis}" for axis in AXES[d])]


def _used(track: Track, used: np.ndarray) -> str:
    """Names of the stations, or transmitters, whose measurements updated a track."""
    recording = track.playback.recording
    names = getattr(recording, "names", recording.stations)
    return " ".join(name for name, told in zip(names, used, strict=True) if told)


# -- summary -----------------------------------------------------------------------------------------------------------


def summary(track: Track) -> dict[str, Any]:
    """The track as plain data: what was read, settings, how well scans fit, where tracks end."""
    playback, recording = track.playback, track.playback.recording
    nis, degrees = track.fits
    first, last = track.moments[0].index, len(recording.time_s)
    return {
        "file": recording.source,
        "epoch": recording.epoch or None,
        "stations": list(recording.stations),
        "transmitters": list(getattr(recording, "names", ())),
        "instants": last,
        "duration_s": float(recording.time_s[-1] - recording.time_s[0]),
        "start_s": float(track.time_s[0]),
        "step_s": playback.scenario.step_s,
        "missing_scans": sum(playback.parts(index) - 1 for index in range(first + 1, last)),
        "tracks": track.mean.shape[1],
        "origin": None if recording.frame is None else _origin(recording.frame),
        "scenario": playback.scenario.to_dict(),
        "nis_per_degree_band95": _band(degrees.sum() / max(degrees.shape[1], 1)),
        "final": [_final(track, j, nis[:, j], degrees[:, j]) for j in range(track.mean.shape[1])],
        "course": {
            "time_s": track.time_s, "mean": track.mean, "cov": track.cov, "nis": nis, "nis_degrees": degrees,
            "range_m": track.sights[0], "range_std_m": track.sights[1],
            "weights": [moment.weights for moment in track.moments],
            "models": [moment.models for moment in track.moments],
        },
    }  # fmt: skip


def _origin(frame: Any) -> list[float]:
    return [math.degrees(frame.latitude), math.degrees(frame.longitude), frame.height]


def _band(degrees: float) -> list[float] | None:
    """Where 95 % of a consistent tracker's mean NIS per degree of freedom lie; None without any."""
    return None if degrees < 1.0 else [float(chi2.ppf(p, degrees) / degrees) for p in (0.025, 0.975)]


def _final(track: Track, j: int, nis: np.ndarray, degrees: np.ndarray) -> dict[str, Any]:
    distance, distance_std, bearing = (part[-1, j] for part in track.sights)
    return {
        "dimensions": track.mean.shape[-1] // 2, "mean": track.mean[-1, j],
        "std": np.sqrt(np.maximum(np.diagonal(track.cov[-1, j]), 0.0)), "range_m": distance,
        "range_std_m": distance_std, "bearing_deg": bearing,
        "nis_per_degree": nis.sum() / max(degrees.sum(), 1.0), "updates": int((degrees > 0.0).sum()),
    }  # fmt: skip


# -- advice ------------------------------------------------------------------------------------------------------------


def advice_rows(track: Track) -> list[dict[str, Any]]:
    """A row per instant: what the policy would do next."""
    return [
        {"time_s": float(time_s)} | track.playback.maneuver(command)
        for time_s, command in zip(track.time_s, track.commands, strict=True)
    ]


def advice_csv(track: Track) -> str:
    """The rows as CSV."""
    rows = advice_rows(track)
    return _csv(list(rows[0]), rows)


def advice_table(track: Track) -> str:
    """The rows as text in columns; turn rates are positive to the left."""
    rows = advice_rows(track)
    cells = [list(rows[0])] + [[_short(value) for value in row.values()] for row in rows]
    widths = [max(map(len, column)) for column in zip(*cells, strict=True)]
    return "\n".join("  ".join(cell.rjust(width) for cell, width in zip(row, widths, strict=True)) for row in cells)


def _short(value: float | str) -> str:
    return value if isinstance(value, str) else f"{value + 0.0:.2f}"
