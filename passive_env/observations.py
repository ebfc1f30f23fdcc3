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
    """One number of the observation.

    Attributes:
        name: what it is.
        unit: of the underlying quantity.
        scale: how it is scaled.
        odd: whether it changes its sign when left and right are exchanged.
    """

    name: str
    unit: str
    scale: str
    odd: bool = False


@helper
def clip_value(value):
    """A value within the limits; 0 for NaN."""
    return min(max(value, -LIMIT), LIMIT) if value == value else 0.0


@helper
def mean_sight(platforms, mean):
    """Cosine and sine of the mean line of sight ψ, from the platforms' midpoint to the middle of the tracks."""
    dx = dy = 0.0
    for m in range(mean.shape[0]):
        dx, dy = dx + mean[m, 0] / mean.shape[0], dy + mean[m, 1] / mean.shape[0]
    for s in range(platforms.shape[0]):
        dx, dy = dx - platforms[s, 0] / platforms.shape[0], dy - platforms[s, 1] / platforms.shape[0]
    psi = math.atan2(dy, dx)
    return math.cos(psi), math.sin(psi)


@helper
def write_platforms(platforms, c, s, out, i):
    """Platforms relative to the reference and their headings, in the frame of ψ; returns the next index."""
    ref = platforms.shape[0] - 1
    for p in range(platforms.shape[0]):
        vx, vy = platforms[p, 2], platforms[p, 3]
        speed = max(math.hypot(vx, vy), 1e-9)
        if p != ref:
            dx, dy = platforms[p, 0] - platforms[ref, 0], platforms[p, 1] - platforms[ref, 1]
            out[i], out[i + 1] = (c * dx + s * dy) / 2e4, (c * dy - s * dx) / 2e4
            i += 2
        out[i], out[i + 1] = (c * vx + s * vy) / speed, (c * vy - s * vx) / speed
        i += 2
    return i


@helper
def write_track(x, platforms, alone, c, s, out, i):
    """Range, bearing and velocity of a track from the reference, range and crossing angle from the other platforms.

    One platform's line of sight to a track that is `alone` is ψ itself: its bearing is left out.
    """
    ref = platforms.shape[0] - 1
    dx, dy = x[0] - platforms[ref, 0], x[1] - platforms[ref, 1]
    r = max(math.hypot(dx, dy), 1.0)
    a, b = dx / r, dy / r
    out[i] = math.log(r / 5e4)
    i += 1
    if not alone:
        out[i], out[i + 1] = c * a + s * b, c * b - s * a
        i += 2
    out[i], out[i + 1] = (a * x[2] + b * x[3]) / 300.0, (a * x[3] - b * x[2]) / 300.0
    i += 2
    for p in range(ref):
        ex, ey = x[0] - platforms[p, 0], x[1] - platforms[p, 1]
        e = max(math.hypot(ex, ey), 1.0)
        out[i], out[i + 1] = math.log(e / 5e4), (a * ey - b * ex) / e
        i += 2
    return i, a, b


@helper
def write_covariance(P, a, b, out, i):
    """Log standard deviations and correlations in the line-of-sight frame (a, b): radial, cross, and their rates."""
    p00 = a * a * P[0, 0] + 2.0 * a * b * P[0, 1] + b * b * P[1, 1]
    p11 = b * b * P[0, 0] - 2.0 * a * b * P[0, 1] + a * a * P[1, 1]
    p01 = a * b * (P[1, 1] - P[0, 0]) + (a * a - b * b) * P[0, 1]
    v00 = a * a * P[2, 2] + 2.0 * a * b * P[2, 3] + b * b * P[3, 3]
    v11 = b * b * P[2, 2] - 2.0 * a * b * P[2, 3] + a * a * P[3, 3]
    v01 = a * b * (P[3, 3] - P[2, 2]) + (a * a - b * b) * P[2, 3]
    c00 = a * (a * P[0, 2] + b * P[0, 3]) + b * (a * P[1, 2] + b * P[1, 3])
    c01 = a * (a * P[0, 3] - b * P[0, 2]) + b * (a * P[1, 3] - b * P[1, 2])
    c10 = a * (a * P[1, 2] + b * P[1, 3]) - b * (a * P[0, 2] + b * P[0, 3])
    c11 = a * (a * P[1, 3] - b * P[1, 2]) - b * (a * P[0, 3] - b * P[0, 2])
    d0, d1 = math.sqrt(max(p00, 1e-6)), math.sqrt(max(p11, 1e-6))
    d2, d3 = math.sqrt(max(v00, 1e-6)), math.sqrt(max(v11, 1e-6))
    out[i], out[i + 1] = math.log(d0 / 1e3) / 2.0, math.log(d1 / 1e3) / 2.0
    out[i + 2], out[i + 3] = math.log(d2 / 50.0) / 2.0, math.log(d3 / 50.0) / 2.0
    out[i + 4], out[i + 5], out[i + 6] = p01 / (d0 * d1), c00 / (d0 * d2), c01 / (d0 * d3)
    out[i + 7], out[i + 8], out[i + 9] = c10 / (d1 * d2), c11 / (d1 * d3), v01 / (d2 * d3)
    return i + 10


@helper
def _write_discs(discs, platforms, c, s, out, i):
    """Centres of no-go discs relative to the reference, in the frame of ψ; returns the next index."""
    ref = platforms.shape[0] - 1
    for k in range(discs.shape[0]):
        dx, dy = discs[k, 0] - platforms[ref, 0], discs[k, 1] - platforms[ref, 1]
        out[i], out[i + 1] = (c * dx + s * dy) / 2e4, (c * dy - s * dx) / 2e4
        i += 2
    return i


@kernel("(),(s,x),(m,x),(m,x,x),(m,s),(a),(h,c),(d)->(d)", "fFFFBFFgG")
def _observe(time_left, platforms, mean, cov, assigned, last_action, discs, like, out):
    c, s = mean_sight(platforms, mean)
    alone = platforms.shape[0] == 1 and mean.shape[0] == 1
    out[0] = time_left
    i = write_platforms(platforms, c, s, out, 1)
    for k in range(last_action.shape[0]):
        out[i + k] = last_action[k]
    i += last_action.shape[0]
    for m in range(mean.shape[0]):
        i, a, b = write_track(mean[m], platforms, alone, c, s, out, i)
        i = write_covariance(cov[m], a, b, out, i)
        for p in range(platforms.shape[0]):
            out[i + p] = 1.0 if assigned[m, p] else 0.0
        i += platforms.shape[0]
    i = _write_discs(discs, platforms, c, s, out, i)
    for k in range(i):  # a diverged tracker's NaN reads 0
        out[k] = clip_value(out[k])


class TrackObservation:
    """Platforms and tracks relative to the mean line of sight, whole track covariances in their line-of-sight frames.

    The mean line of sight ψ runs from the platforms' midpoint to the middle of the tracks; the reference platform is
    the last one. With one platform and one track ψ is the track's line of sight, so the track's bearing is left out.

    Fields in order (`fields` names each with its unit and scale); N is a platform's, track's or disc's number, AXIS
    one of radial, cross, radial_velocity, cross_velocity:

        time_left                                        1    share of the episode's steps
        platformN.along platformN.across                 m    position relative to the reference / 20 km
        platformN.heading_cos platformN.heading_sin      1    of heading − ψ
        last_actionN                                     1    previous action
        trackN.log_range                                 m    log(range from the reference / 50 km)
        trackN.bearing_cos trackN.bearing_sin            1    of line of sight − ψ
        trackN.radial_velocity trackN.cross_velocity     m/s  along and left of the line of sight / 300 m/s
        trackN.log_rangeN                                m    log(range from another platform / 50 km)
        trackN.crossing_sinN                             1    sine of the angle to that platform's line of sight
        trackN.log_std_AXIS                              m    log(standard deviation / 1 km or 50 m/s) / 2
        trackN.corr_AXIS_AXIS                            1    correlation coefficient
        trackN.assignedN                                 1    1 if the platform's bearing updated the track
        discN.along discN.across                         m    centre of a no-go disc, as of platforms

    Platforms' positions, ranges and crossing angles are of all but the reference. Values are clipped to ±5.
    """

    def __init__(self, stations: int, targets: int, actions: int, steps: int, discs: int = 0):
        self.fields = tuple(_fields(stations, targets, actions, discs))
        self.space = spaces.Box(-LIMIT, LIMIT, (len(self.fields),), np.float32)
        self._like = np.empty(len(self.fields), dtype=np.float32)
        self._steps = float(steps)
        self._mirror_of = _mirror_images(self.fields, targets)
        self._mirror_sign = np.array([-1 if field.odd else 1 for field in self.fields], dtype=np.float32)

    def __call__(self, belief: Belief) -> Any:
        """Observation [e, d] float32 inside the space."""
        return _observe(
            belief.steps_left / self._steps, belief.platforms, belief.mean, belief.cov, belief.assigned,
            belief.last_action, belief.discs, self._like,
        )  # fmt: skip

    def mirrored(self, observation: np.ndarray) -> np.ndarray:
        """Observations [..., d] of the mirrored worlds: left is right, and the tracks stand in reverse order."""
        return self._mirror_sign * observation[..., self._mirror_of]


def _mirror_images(fields: tuple[Field, ...], targets: int) -> list[int]:
    """Index of every field's image in the mirror: tracks are numbered counter-clockwise, there clockwise."""
    images = {f"track{m}": f"track{targets - 1 - m}" for m in range(targets)}
    place = {field.name: i for i, field in enumerate(fields)}
    names = (field.name.partition(".") for field in fields)
    return [place[images.get(owner, owner) + dot + quantity] for owner, dot, quantity in names]


def _fields(stations: int, targets: int, actions: int, discs: int):
    yield Field("time_left", "1", "share of the episode's steps")
    yield from platform_fields(stations)
    for a in range(actions):
        yield Field(f"last_action{a}", "1", "previous action", odd=True)
    for m in range(targets):
        yield from track_fields(f"track{m}", stations, bearing=stations > 1 or targets > 1)
        for s in range(stations):
            yield Field(f"track{m}.assigned{s}", "1", f"1 if platform {s}'s bearing updated the track")
    for d in range(discs):
        yield Field(f"disc{d}.along", "m", "centre of a no-go disc relative to the reference platform along ψ / 20 km")
        yield Field(f"disc{d}.across", "m", "the same, left of ψ / 20 km", odd=True)


def platform_fields(stations: int):
    """What `write_platforms` writes."""
    for s in range(stations):
        if s < stations - 1:
            yield Field(f"platform{s}.along", "m", "position relative to the reference platform along ψ / 20 km")
            yield Field(f"platform{s}.across", "m", "the same, left of ψ / 20 km", odd=True)
        yield Field(f"platform{s}.heading_cos", "1", "cosine of heading − ψ")
        yield Field(f"platform{s}.heading_sin", "1", "sine of heading − ψ", odd=True)


def track_fields(name: str, stations: int, bearing: bool = True):
    """What `write_track` and `write_covariance` write of a track."""
    yield Field(f"{name}.log_range", "m", "log(range from the reference / 50 km)")
    if bearing:
        yield Field(f"{name}.bearing_cos", "1", "cosine of line of sight − ψ")
        yield Field(f"{name}.bearing_sin", "1", "sine of line of sight − ψ", odd=True)
    yield Field(f"{name}.radial_velocity", "m/s", "/ 300 m/s")
    yield Field(f"{name}.cross_velocity", "m/s", "/ 300 m/s, left positive", odd=True)
    for s in range(stations - 1):
        yield Field(f"{name}.log_range{s}", "m", f"log(range from platform {s} / 50 km)")
        angle = f"sine of the angle from the reference's to platform {s}'s line"
        yield Field(f"{name}.crossing_sin{s}", "1", angle, odd=True)
    axes = ("radial", "cross", "radial_velocity", "cross_velocity")
    for axis in axes:
        unit, size = ("m/s", "50 m/s") if "velocity" in axis else ("m", "1 km")
        yield Field(f"{name}.log_std_{axis}", unit, f"log(standard deviation / {size}) / 2")
    for i, first in enumerate(axes):
        for second in axes[i + 1 :]:
            odd = ("cross" in first) != ("cross" in second)
            yield Field(f"{name}.corr_{first}_{second}", "1", "correlation coefficient", odd)
