"""What the agent sees: flat, bounded, documented fields computed from the belief and nothing else."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from gymnasium import spaces

from passive_env.belief import Belief
from trackers.compiled import helper, kernel

LIMIT = 5.0
"""Every observation value is clipped to [−LIMIT, LIMIT]."""


class Field(NamedTuple):
    """One number of the observation: name, unit of the underlying quantity, and how it is scaled."""

    name: str
    unit: str
    scale: str


@helper
def _clip(value):
    return min(max(value, -LIMIT), LIMIT) if value == value else 0.0


@kernel(
    "(),(s,x),(m,x),(m,x,x),(m,s),(a),(d)->(d)",
    "ffffbfgg",
)
def _observe(time_left, platforms, mean, cov, assigned, last_action, like, out):
    n_stations, n_tracks = platforms.shape[0], mean.shape[0]
    ref = n_stations - 1
    rx, ry = platforms[ref, 0], platforms[ref, 1]
    cx = cy = 0.0
    for m in range(n_tracks):
        cx, cy = cx + mean[m, 0] / n_tracks, cy + mean[m, 1] / n_tracks
    ox = oy = 0.0
    for s in range(n_stations):
        ox, oy = ox + platforms[s, 0] / n_stations, oy + platforms[s, 1] / n_stations
    psi = math.atan2(cy - oy, cx - ox)
    c, s_ = math.cos(psi), math.sin(psi)
    i = 0
    out[i] = time_left
    i += 1
    for s in range(n_stations):
        dx, dy = platforms[s, 0] - rx, platforms[s, 1] - ry
        speed = max(math.hypot(platforms[s, 2], platforms[s, 3]), 1e-9)
        if s != ref:
            out[i] = _clip((c * dx + s_ * dy) / 2e4)
            out[i + 1] = _clip((c * dy - s_ * dx) / 2e4)
            i += 2
        out[i] = (c * platforms[s, 2] + s_ * platforms[s, 3]) / speed
        out[i + 1] = (c * platforms[s, 3] - s_ * platforms[s, 2]) / speed
        i += 2
    for a in range(last_action.shape[0]):
        out[i] = last_action[a]
        i += 1
    for m in range(n_tracks):
        dx, dy = mean[m, 0] - rx, mean[m, 1] - ry
        r = max(math.hypot(dx, dy), 1.0)
        ur, ut = dx / r, dy / r
        out[i] = _clip(math.log(r / 5e4))
        out[i + 1], out[i + 2] = c * ur + s_ * ut, c * ut - s_ * ur
        out[i + 3] = _clip((ur * mean[m, 2] + ut * mean[m, 3]) / 300.0)
        out[i + 4] = _clip((ur * mean[m, 3] - ut * mean[m, 2]) / 300.0)
        i += 5
        for s in range(n_stations):
            if s != ref:
                ex, ey = mean[m, 0] - platforms[s, 0], mean[m, 1] - platforms[s, 1]
                e = max(math.hypot(ex, ey), 1.0)
                out[i] = _clip(math.log(e / 5e4))
                out[i + 1] = (ur * ey - ut * ex) / e
                i += 2
        # Covariance in the line-of-sight frame: rows radial, cross, radial velocity, cross velocity.
        p = cov[m]
        a00 = ur * ur * p[0, 0] + 2.0 * ur * ut * p[0, 1] + ut * ut * p[1, 1]
        a11 = ut * ut * p[0, 0] - 2.0 * ur * ut * p[0, 1] + ur * ur * p[1, 1]
        a01 = ur * ut * (p[1, 1] - p[0, 0]) + (ur * ur - ut * ut) * p[0, 1]
        v00 = ur * ur * p[2, 2] + 2.0 * ur * ut * p[2, 3] + ut * ut * p[3, 3]
        v11 = ut * ut * p[2, 2] - 2.0 * ur * ut * p[2, 3] + ur * ur * p[3, 3]
        v01 = ur * ut * (p[3, 3] - p[2, 2]) + (ur * ur - ut * ut) * p[2, 3]
        b00 = ur * (ur * p[0, 2] + ut * p[0, 3]) + ut * (ur * p[1, 2] + ut * p[1, 3])
        b01 = ur * (ur * p[0, 3] - ut * p[0, 2]) + ut * (ur * p[1, 3] - ut * p[1, 2])
        b10 = ur * (ur * p[1, 2] + ut * p[1, 3]) - ut * (ur * p[0, 2] + ut * p[0, 3])
        b11 = ur * (ur * p[1, 3] - ut * p[1, 2]) - ut * (ur * p[0, 3] - ut * p[0, 2])
        d0, d1 = math.sqrt(max(a00, 1e-6)), math.sqrt(max(a11, 1e-6))
        d2, d3 = math.sqrt(max(v00, 1e-6)), math.sqrt(max(v11, 1e-6))
        out[i], out[i + 1] = _clip(math.log(d0 / 1e3) / 2.0), _clip(math.log(d1 / 1e3) / 2.0)
        out[i + 2], out[i + 3] = _clip(math.log(d2 / 50.0) / 2.0), _clip(math.log(d3 / 50.0) / 2.0)
        out[i + 4], out[i + 5], out[i + 6] = _clip(a01 / (d0 * d1)), _clip(b00 / (d0 * d2)), _clip(b01 / (d0 * d3))
        out[i + 7], out[i + 8], out[i + 9] = _clip(b10 / (d1 * d2)), _clip(b11 / (d1 * d3)), _clip(v01 / (d2 * d3))
        i += 10
        for s in range(n_stations):
            out[i] = 1.0 if assigned[m, s] else 0.0
            i += 1
    for k in range(i):  # a diverged tracker's NaN reads 0
        out[k] = _clip(out[k])


class TrackObservation:
    """Platforms and tracks relative to the mean line of sight, whole track covariances in their line-of-sight frames.

    The mean line of sight ψ runs from the platforms' midpoint to the middle of the tracks; the reference platform is
    the last one. Fields, in order: see `fields`.
    """

    def __init__(self, stations: int, targets: int, actions: int, steps: int):
        self.fields = tuple(_fields(stations, targets, actions))
        self.space = spaces.Box(-LIMIT, LIMIT, (len(self.fields),), np.float32)
        self._like = np.empty(len(self.fields), dtype=np.float32)
        self._steps = float(steps)

    def __call__(self, belief: Belief) -> Any:
        """Observation [e, d] float32 inside the space."""
        return _observe(
            belief.steps_left / self._steps, belief.platforms, belief.mean, belief.cov, belief.assigned,
            belief.last_action, self._like,
        )  # fmt: skip


def _fields(stations: int, targets: int, actions: int):
    yield Field("time_left", "1", "share of the episode's steps")
    for s in range(stations):
        if s < stations - 1:
            yield Field(f"platform{s}.along", "m", "position relative to the reference platform along ψ / 20 km")
            yield Field(f"platform{s}.across", "m", "the same, left of ψ / 20 km")
        yield Field(f"platform{s}.heading_cos", "1", "cosine of heading − ψ")
        yield Field(f"platform{s}.heading_sin", "1", "sine of heading − ψ")
    for a in range(actions):
        yield Field(f"last_action{a}", "1", "previous action")
    for m in range(targets):
        name = f"track{m}"
        yield Field(f"{name}.log_range", "m", "log(range from the reference / 50 km)")
        yield Field(f"{name}.bearing_cos", "1", "cosine of line of sight − ψ")
        yield Field(f"{name}.bearing_sin", "1", "sine of line of sight − ψ")
        yield Field(f"{name}.radial_velocity", "m/s", "/ 300 m/s")
        yield Field(f"{name}.cross_velocity", "m/s", "/ 300 m/s, left positive")
        for s in range(stations - 1):
            yield Field(f"{name}.log_range{s}", "m", f"log(range from platform {s} / 50 km)")
            yield Field(
                f"{name}.crossing_sin{s}", "1", f"sine of the angle from the reference's to platform {s}'s line"
            )
        axes = ("radial", "cross", "radial_velocity", "cross_velocity")
        for axis in axes:
            unit, size = ("m/s", "50 m/s") if "velocity" in axis else ("m", "1 km")
            yield Field(f"{name}.log_std_{axis}", unit, f"log(standard deviation / {size}) / 2")
        for i, first in enumerate(axes):
            for second in axes[i + 1 :]:
                yield Field(f"{name}.corr_{first}_{second}", "1", "correlation coefficient")
        for s in range(stations):
            yield Field(f"{name}.assigned{s}", "1", f"1 if platform {s}'s bearing updated the track")
