"""What one platform alone knows: its own place and motion, its own sensor's returns, nothing of tracks or of others."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from gymnasium import spaces

from passive_env.belief import Belief
from passive_env.observations import LIMIT, Field, clip_value
from trackers.angles import wrap_scalar
from trackers.compiled import helper, kernel


@helper
def _write_motion(platform, start, place_unit, top_speed, out, i):
    """Place since the start in the frame of the heading, altitude, turn since the start, speed; the next index.

    place_unit: m; top_speed: m/s, 0 for platforms whose speed is always the same.
    """
    v = platform.shape[0] // 2
    vx, vy, ux, uy = platform[v], platform[v + 1], start[v], start[v + 1]
    speed, before = max(math.hypot(vx, vy), 1e-12), max(math.hypot(ux, uy), 1e-12)
    c, s = vx / speed, vy / speed
    dx, dy = platform[0] - start[0], platform[1] - start[1]
    out[i], out[i + 1] = (c * dx + s * dy) / place_unit, (c * dy - s * dx) / place_unit
    i += 2
    if v == 3:
        out[i], out[i + 1] = (platform[2] - start[2]) / 2e3, platform[2] / 1e4
        i += 2
    out[i], out[i + 1] = (ux * c + uy * s) / before, (ux * s - uy * c) / before
    i += 2
    if top_speed > 0.0:
        out[i] = speed / top_speed
        i += 1
    return i, c, s


@helper
def _write_returns(angles, valid, c, s, off, order, out, i):
    """Returns counter-clockwise about their middle, off the heading; zeros where there are none; the next index.

    off [b] and order [b] are scratch: azimuths off the middle, and slots in the order in which they are written.
    """
    x = y = 0.0
    for j in range(valid.shape[0]):
        if valid[j]:
            x, y = x + math.cos(angles[j, 0]), y + math.sin(angles[j, 0])
    middle, n = math.atan2(y, x), 0
    for j in range(valid.shape[0]):
        if valid[j]:
            azimuth, k = wrap_scalar(angles[j, 0] - middle), n
            while k > 0 and off[k - 1] > azimuth:
                off[k], order[k] = off[k - 1], order[k - 1]
                k -= 1
            off[k], order[k] = azimuth, j
            n += 1
    width = 2 + angles.shape[1]
    for j in range(valid.shape[0]):
        out[i : i + width] = 0.0
        if j < n:
            a, b = math.cos(angles[order[j], 0]), math.sin(angles[order[j], 0])
            out[i], out[i + 1], out[i + 2] = 1.0, c * a + s * b, c * b - s * a
            if angles.shape[1] == 2:
                out[i + 3] = angles[order[j], 1]
        i += width
    return i


@kernel("(),(s,n),(s,n),(a),(s,k),(s,b,q),(s,b),(s),(u),(d)->(s,d)", "fFFFIFBBFgG")
def _observe(time_left, platforms, start, last_action, columns, angles, valid, available, units, like, out):
    slots = valid.shape[1]
    off, order = np.empty(slots), np.empty(slots, dtype=np.int64)
    for p in range(platforms.shape[0]):
        seen = out[p]
        seen[0] = time_left
        i, c, s = _write_motion(platforms[p], start[p], units[0], units[1], seen, 1)
        for k in range(columns.shape[1]):
            seen[i + k] = last_action[columns[p, k]]
        i += columns.shape[1]
        if units[2] > 0.0:
            seen[i] = 1.0 if available[p] else 0.0
            i += 1
        i = _write_returns(angles[p], valid[p], c, s, off, order, seen, i)
        for k in range(i):
            seen[k] = clip_value(seen[k])


class OwnObservation:
    """Every platform's own place and motion, and the returns of its own sensor at the last scan.

    Directions are told off the platform's present heading, places by where it was at the first scan: nothing depends
    on where another platform is or was, nor on any track. Returns stand in counter-clockwise order about their middle;
    the fields of those that there are not are 0.

    Fields in order (`fields` names each with its unit and scale); N is a number:

        time_left                                  1    share of the episode's steps
        own.ahead own.left                         m    place since the first scan, along and left of the heading / unit
        own.above own.altitude                     m    in space: over the first altitude / 2 km, over ground / 10 km
        own.turned_cos own.turned_sin              1    of the turn since the first scan
        own.speed                                  m/s  where it is chosen: / top speed
        own.last_actionN                           1    its own previous action
        own.available                              1    in space: 1 if its sensor was at the last scan
        returnN.received                           1    1 if there was such a return
        returnN.azimuth_cos returnN.azimuth_sin    1    of its azimuth off the heading
        returnN.elevation                          rad  in space

    Values are clipped to ±5.

    Args:
        columns: [s, k] which numbers of a command are whose.
        steps: of an episode.
        slots: return slots of a scan.
        dimensions: 2 or 3.
        place_unit_m: of places.
        top_speed_m_s: of a platform; 0 where it does not choose its speed.
    """

    def __init__(
        self, columns: np.ndarray, steps: int, slots: int, dimensions: int = 2, place_unit_m: float = 2e4,
        top_speed_m_s: float = 0.0,
    ):  # fmt: skip
        in_space = dimensions == 3
        self.fields = tuple(_fields(columns.shape[1], slots, in_space, place_unit_m, top_speed_m_s > 0.0))
        self.space = spaces.Box(-LIMIT, LIMIT, (len(self.fields),), np.float32)
        self._columns, self._steps = columns, float(steps)
        self._units = np.array([place_unit_m, top_speed_m_s, float(in_space)])
        self._in_space = in_space
        self._like = np.empty(len(self.fields), dtype=np.float32)

    def __call__(self, belief: Belief) -> Any:
        """Observations [e, s, d] float32 inside the space."""
        angles, valid = belief.received
        available = belief.available[..., 0] if self._in_space else np.ones(valid.shape[:-1], dtype=bool)
        return _observe(
            belief.steps_left / self._steps, belief.platforms, belief.start, belief.last_action, self._columns, angles,
            valid, available, self._units, self._like,
        )  # fmt: skip


def _fields(actions: int, slots: int, in_space: bool, unit_m: float, chooses_speed: bool):
    yield Field("time_left", "1", "share of the episode's steps")
    yield Field("own.ahead", "m", f"place since the first scan, along the heading / {unit_m / 1e3:g} km")
    yield Field("own.left", "m", f"the same, left of the heading / {unit_m / 1e3:g} km", odd=True)
    if in_space:
        yield Field("own.above", "m", "altitude over the first one / 2 km")
        yield Field("own.altitude", "m", "/ 10 km")
    yield Field("own.turned_cos", "1", "cosine of the turn since the first scan")
    yield Field("own.turned_sin", "1", "sine of the turn since the first scan", odd=True)
    if chooses_speed:
        yield Field("own.speed", "m/s", "/ top speed")
    for k in range(actions):
        yield Field(f"own.last_action{k}", "1", "its own previous action", odd=k == 0)
    if in_space:
        yield Field("own.available", "1", "1 if its sensor was at the last scan")
    for j in range(slots):
        yield Field(f"return{j}.received", "1", "1 if there was such a return")
        yield Field(f"return{j}.azimuth_cos", "1", "cosine of its azimuth off the heading")
        yield Field(f"return{j}.azimuth_sin", "1", "sine of its azimuth off the heading", odd=True)
        if in_space:
            yield Field(f"return{j}.elevation", "rad", "its elevation")
