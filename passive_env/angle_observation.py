"""What the agent sees of a track in space: flat, bounded, documented fields of the belief and nothing else."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from gymnasium import spaces

from passive_env.belief import Belief
from passive_env.observations import LIMIT, Field, clip_value
from trackers.compiled import helper, kernel

AXES = ("radial", "cross", "up", "radial_velocity", "cross_velocity", "up_velocity")
"""Of a track's covariance: along the line of sight from platform 0, level and left of it, at right angles to both."""


@helper
def _write_platforms(platforms, c, s, out, i):
    """Headings in the frame of ψ, places relative to platform 0; returns the next index."""
    for p in range(platforms.shape[0]):
        if p > 0:
            dx, dy = platforms[p, 0] - platforms[0, 0], platforms[p, 1] - platforms[0, 1]
            out[i], out[i + 1] = (c * dx + s * dy) / 1e4, (c * dy - s * dx) / 1e4
            out[i + 2] = (platforms[p, 2] - platforms[0, 2]) / 2e3
            i += 3
        vx, vy = platforms[p, 3], platforms[p, 4]
        speed = max(math.hypot(vx, vy), 1e-9)
        out[i], out[i + 1] = (c * vx + s * vy) / speed, (c * vy - s * vx) / speed
        i += 2
    return i


@helper
def _write_track(x, platforms, c, s, out, i):
    """Range, bearing, height and velocity of a track from platform 0, range and crossing angle from the others."""
    dx, dy, dz = x[0] - platforms[0, 0], x[1] - platforms[0, 1], x[2] - platforms[0, 2]
    level = max(math.hypot(dx, dy), 1.0)
    a, b = dx / level, dy / level
    out[i] = math.log(math.hypot(level, dz) / 2e4)
    out[i + 1], out[i + 2] = c * a + s * b, c * b - s * a
    out[i + 3] = dz / 5e3
    out[i + 4], out[i + 5], out[i + 6] = (a * x[3] + b * x[4]) / 300.0, (a * x[4] - b * x[3]) / 300.0, x[5] / 50.0
    i += 7
    for p in range(1, platforms.shape[0]):
        ex, ey, ez = x[0] - platforms[p, 0], x[1] - platforms[p, 1], x[2] - platforms[p, 2]
        e = max(math.hypot(ex, ey), 1.0)
        out[i] = math.log(math.hypot(e, ez) / 2e4)
        out[i + 1], out[i + 2] = (a * ex + b * ey) / e, (a * ey - b * ex) / e
        i += 3
    return i


@helper
def _write_covariance(x, P, platform, axes, frame, out, i):
    """Log standard deviations and correlations along the line of sight, left of it and above it, and of their rates.

    axes [3, 3] and frame [6, 6] are scratch: unit vectors, and the covariance in their frame.
    """
    dx, dy, dz = x[0] - platform[0], x[1] - platform[1], x[2] - platform[2]
    level = max(math.hypot(dx, dy), 1.0)
    r = math.hypot(level, dz)
    a, b, cos_e, sin_e = dx / level, dy / level, level / r, dz / r
    axes[0, 0], axes[0, 1], axes[0, 2] = cos_e * a, cos_e * b, sin_e
    axes[1, 0], axes[1, 1], axes[1, 2] = -b, a, 0.0
    axes[2, 0], axes[2, 1], axes[2, 2] = -sin_e * a, -sin_e * b, cos_e
    for m in range(6):
        for n in range(m + 1):
            rows, columns = 3 * (m // 3), 3 * (n // 3)
            total = 0.0
            for j in range(3):
                for k in range(3):
                    total += axes[m % 3, j] * P[rows + j, columns + k] * axes[n % 3, k]
            frame[m, n] = total
    for m in range(6):
        frame[m, m] = math.sqrt(max(frame[m, m], 1e-6))
        out[i] = math.log(frame[m, m] / (1e3 if m < 3 else 50.0)) / 2.0
        i += 1
    for m in range(6):
        for n in range(m + 1, 6):
            out[i] = frame[n, m] / (frame[m, m] * frame[n, n])
            i += 1
    return i


@kernel("(),(s,x6),(m,x6),(m,x6,x6),(s),(m,s),(s,a2),(a),(d)->(d)", "fFFFiFBFgG")
def _observe(time_left, platforms, mean, cov, returns, missed, available, last_action, like, out):
    n_platforms = platforms.shape[0]
    dx, dy = mean[0, 0], mean[0, 1]
    for p in range(n_platforms):
        dx, dy = dx - platforms[p, 0] / n_platforms, dy - platforms[p, 1] / n_platforms
    psi = math.atan2(dy, dx)
    c, s = math.cos(psi), math.sin(psi)
    axes, frame = np.empty((3, 3)), np.empty((6, 6))
    out[0] = time_left
    i = _write_platforms(platforms, c, s, out, 1)
    for k in range(last_action.shape[0]):
        out[i + k] = last_action[k]
    i += last_action.shape[0]
    i = _write_track(mean[0], platforms, c, s, out, i)
    i = _write_covariance(mean[0], cov[0], platforms[0], axes, frame, out, i)
    for p in range(n_platforms):
        out[i], out[i + 1] = returns[p] / 10.0, missed[0, p]
        out[i + 2] = 0.5 * ((1.0 if available[p, 0] else 0.0) + (1.0 if available[p, 1] else 0.0))
        i += 3
    for k in range(i):  # a diverged tracker's NaN reads 0
        out[k] = clip_value(out[k])


class AngleObservation:
    """Platforms and one track in space relative to the mean line of sight, and what the last scan brought.

    The mean line of sight ψ runs level from the platforms' midpoint to the track; the reference is platform 0. The
    track's covariance stands in the frame of the line of sight from platform 0.

    Fields in order (`fields` names each with its unit and scale); N is a platform's number, AXIS one of radial, cross,
    up, radial_velocity, cross_velocity, up_velocity:

        time_left                                        1    share of the episode's steps
        platformN.along platformN.across                 m    position relative to platform 0 / 10 km
        platformN.above                                  m    altitude over platform 0 / 2 km
        platformN.heading_cos platformN.heading_sin      1    of heading − ψ
        last_actionN                                     1    previous action: turns of all platforms, then climbs
        track0.log_range                                 m    log(range from platform 0 / 20 km)
        track0.bearing_cos track0.bearing_sin            1    of line of sight − ψ
        track0.above                                     m    altitude over platform 0 / 5 km
        track0.radial_velocity track0.cross_velocity     m/s  level, along and left of the line of sight / 300 m/s
        track0.climb                                     m/s  / 50 m/s
        track0.log_rangeN                                m    log(range from another platform / 20 km)
        track0.crossing_cosN track0.crossing_sinN        1    of the level angle to that platform's line of sight
        track0.log_std_AXIS                              m    log(standard deviation / 1 km or 50 m/s) / 2
        track0.corr_AXIS_AXIS                            1    correlation coefficient
        platformN.returns                                1    returns in the gate / 10
        platformN.missed                                 1    probability that none of them is the target's
        platformN.available                              1    share of azimuth and elevation that was available

    Places, ranges and crossing angles are of all platforms but 0. Values are clipped to ±5.
    """

    def __init__(self, platforms: int, steps: int):
        self.fields = tuple(_fields(platforms))
        self.space = spaces.Box(-LIMIT, LIMIT, (len(self.fields),), np.float32)
        self._like = np.empty(len(self.fields), dtype=np.float32)
        self._steps = float(steps)
        self._mirror_sign = np.array([-1 if field.odd else 1 for field in self.fields], dtype=np.float32)

    def __call__(self, belief: Belief) -> Any:
        """Observation [e, d] float32 inside the space."""
        return _observe(
            belief.steps_left / self._steps, belief.platforms, belief.mean, belief.cov, belief.returns, belief.missed,
            belief.available, belief.last_action, self._like,
        )  # fmt: skip

    def mirrored(self, observation: np.ndarray) -> np.ndarray:
        """Observations [..., d] of the mirrored worlds: left is right."""
        return self._mirror_sign * observation


def _fields(platforms: int):
    yield Field("time_left", "1", "share of the episode's steps")
    for p in range(platforms):
        if p > 0:
            yield Field(f"platform{p}.along", "m", "position relative to platform 0 along ψ / 10 km")
            yield Field(f"platform{p}.across", "m", "the same, left of ψ / 10 km", odd=True)
            yield Field(f"platform{p}.above", "m", "altitude over platform 0 / 2 km")
        yield Field(f"platform{p}.heading_cos", "1", "cosine of heading − ψ")
        yield Field(f"platform{p}.heading_sin", "1", "sine of heading − ψ", odd=True)
    for a in range(2 * platforms):
        yield Field(f"last_action{a}", "1", "previous turn" if a < platforms else "previous climb", odd=a < platforms)
    yield Field("track0.log_range", "m", "log(range from platform 0 / 20 km)")
    yield Field("track0.bearing_cos", "1", "cosine of line of sight − ψ")
    yield Field("track0.bearing_sin", "1", "sine of line of sight − ψ", odd=True)
    yield Field("track0.above", "m", "altitude over platform 0 / 5 km")
    yield Field("track0.radial_velocity", "m/s", "level, along the line of sight / 300 m/s")
    yield Field("track0.cross_velocity", "m/s", "level, left of the line of sight / 300 m/s", odd=True)
    yield Field("track0.climb", "m/s", "/ 50 m/s")
    for p in range(1, platforms):
        angle = f"of the level angle from platform 0's to platform {p}'s line of sight"
        yield Field(f"track0.log_range{p}", "m", f"log(range from platform {p} / 20 km)")
        yield Field(f"track0.crossing_cos{p}", "1", f"cosine {angle}")
        yield Field(f"track0.crossing_sin{p}", "1", f"sine {angle}", odd=True)
    for axis in AXES:
        unit, size = ("m/s", "50 m/s") if "velocity" in axis else ("m", "1 km")
        yield Field(f"track0.log_std_{axis}", unit, f"log(standard deviation / {size}) / 2")
    for i, first in enumerate(AXES):
        for second in AXES[i + 1 :]:
            odd = ("cross" in first) != ("cross" in second)
            yield Field(f"track0.corr_{first}_{second}", "1", "correlation coefficient", odd)
    for p in range(platforms):
        yield Field(f"platform{p}.returns", "1", "returns in the gate / 10")
        yield Field(f"platform{p}.missed", "1", "probability that none of them is the target's")
        yield Field(f"platform{p}.available", "1", "share of azimuth and elevation that was available")
