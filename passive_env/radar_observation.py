"""What the agent sees of a passive radar: flat, bounded, documented fields of the belief, nothing else."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from gymnasium import spaces

from passive_env.observations import LIMIT, Field, clip_value
from passive_env.radar_sensors import RadarBelief, distance
from trackers.compiled import helper, kernel
from trackers.range_sum import sum_spread

AXES = {2: ("radial", "cross"), 3: ("radial", "cross", "up")}
"""Of a track's covariance: level along the line of sight from the receiver, level to its left, and up."""

RECENT_S = 10.0
"""Time after which an answer or a miss counts 1/e."""

FORESEEN_SCANS = (1, 5, 10, 20)
"""Scans to come at which the chance to be clear is observed, where durations are known."""


@helper
def _write_covariance(P, a, b, d, frame, out, i):
    """Log standard deviations and correlations along the level line of sight (a, b), left of it, up, and of rates.

    frame [2d, 2d] is scratch: the covariance in that frame.
    """
    for m in range(2 * d):
        for n in range(2 * d):
            frame[m, n] = P[m, n]
    for block in range(2):  # rows, then columns
        for k in range(2):
            at = k * d
            for n in range(2 * d):
                if block == 0:
                    x, y = frame[at, n], frame[at + 1, n]
                    frame[at, n], frame[at + 1, n] = a * x + b * y, a * y - b * x
                else:
                    x, y = frame[n, at], frame[n, at + 1]
                    frame[n, at], frame[n, at + 1] = a * x + b * y, a * y - b * x
    for m in range(2 * d):
        frame[m, m] = math.sqrt(max(frame[m, m], 1e-6))
        out[i] = math.log(frame[m, m] / (1e3 if m < d else 50.0)) / 2.0
        i += 1
    for m in range(2 * d):
        for n in range(m + 1, 2 * d):
            out[i] = frame[m, n] / (frame[m, m] * frame[n, n])
            i += 1
    return i


@helper
def _write_track(x, P, receiver, a, b, r, statistic, maneuver, frame, out, i):
    """Range, velocities, height, covariance and maneuver test of the track, along the level line of sight (a, b)."""
    d = receiver.shape[0]
    out[i] = math.log(r / 5e4)
    out[i + 1], out[i + 2] = (a * x[d] + b * x[d + 1]) / 300.0, (a * x[d + 1] - b * x[d]) / 300.0
    i += 3
    if d == 3:
        out[i], out[i + 1] = (x[2] - receiver[2]) / 1e4, x[5] / 50.0
        i += 2
    i = _write_covariance(P, a, b, d, frame, out, i)
    out[i], out[i + 1] = math.log1p(max(statistic, 0.0)) / 2.0, 1.0 if maneuver else 0.0
    return i + 2


@helper
def _write_site(x, P, site, std, sight, h, a, b, out, i):
    """Where a transmitter is, and what its range sum would tell beyond its noise; h [d] is scratch."""
    d = site.shape[0]
    r = max(distance(x, site, d), 1.0)
    for j in range(d):
        h[j] = (x[j] - site[j]) / r
    out[i] = math.log(r / 5e4)
    out[i + 1], out[i + 2] = a * h[0] + b * h[1], a * h[1] - b * h[0]
    i += 3
    if d == 3:
        out[i] = 5.0 * h[2]
        i += 1
    for j in range(d):
        h[j] += sight[j]
    out[i] = math.log(math.sqrt(max(sum_spread(P, h, d), 1e-6)) / std) / 2.0
    return i + 1


@kernel(
    "(),(s,y),(m,y),(m,y,y),(a),(n,d),(n),(n),(n),(n),(n),(n),(n),(n,q),(n),(),(),(l),(o)->(o)",
    "fFFFFFBFBBFFFFFfbFgG",
)
def _observe(time_left, platforms, mean, cov, last_action, transmitters, chosen, wait, answered, missed, since_answer,
             since_miss, probability, foresight, std, statistic, maneuver, limits, like, out):  # fmt: skip
    d, receiver, x, P = transmitters.shape[1], platforms[0], mean[0], cov[0]
    moves, delay, std_m, varies = limits[0] > 0.0, limits[1], limits[2], limits[3] > 0.0
    scratch = np.empty((2 * d + 2, 2 * d))
    frame, h, sight = scratch[: 2 * d], scratch[2 * d], scratch[2 * d + 1]
    dx, dy = x[0] - receiver[0], x[1] - receiver[1]
    level = max(math.hypot(dx, dy), 1.0)
    a, b = dx / level, dy / level
    r = max(distance(x, receiver, d), 1.0)
    for j in range(d):
        sight[j] = (x[j] - receiver[j]) / r
    out[0] = time_left
    i = _write_track(x, P, receiver[:d], a, b, r, statistic, maneuver, frame, out, 1)
    if moves:
        vx, vy = receiver[d], receiver[d + 1]
        speed = max(math.hypot(vx, vy), 1e-9)
        out[i], out[i + 1], out[i + 2] = (a * vx + b * vy) / speed, (a * vy - b * vx) / speed, last_action[0]
        i += 3
    for n in range(transmitters.shape[0]):
        i = _write_site(x, P, transmitters[n], std[n], sight, h, a, b, out, i)
        out[i] = 1.0 if chosen[n] else 0.0
        out[i + 1], out[i + 2] = 1.0 if answered[n] else 0.0, 1.0 if missed[n] else 0.0
        out[i + 3], out[i + 4] = math.exp(-since_answer[n] / RECENT_S), math.exp(-since_miss[n] / RECENT_S)
        out[i + 5] = probability[n]
        i += 6
        if delay > 0.0:
            out[i] = wait[n] / delay
            i += 1
        if varies:
            out[i] = math.log(std[n] / std_m)
            i += 1
        for k in range(foresight.shape[1]):
            out[i] = 2.0 * foresight[n, k] - 1.0
            i += 1
    for k in range(i):  # a diverged tracker's NaN reads 0
        out[k] = clip_value(out[k])


class RadarObservation:
    """One track, its covariance, and every transmitter, relative to the level line of sight from the receiver.

    Fields in order (`fields` names each with its unit and scale); N is a transmitter's number, AXIS one of radial,
    cross, in space up, and of the same with _velocity; what stands in brackets is there only where it can differ:

        time_left                                         1     share of the episode's steps
        track0.log_range                                  m     log(range from the receiver / 50 km)
        track0.radial_velocity track0.cross_velocity      m/s   level, along and left of the line of sight / 300 m/s
        [track0.height track0.climb]                      m     above the receiver / 10 km; m/s / 50 m/s; in space
        track0.log_std_AXIS                               m     log(standard deviation / 1 km or 50 m/s) / 2
        track0.corr_AXIS_AXIS                             1     correlation coefficient
        track0.log_statistic                              1     log(1 + statistic of the maneuver test) / 2
        track0.maneuver                                   1     1 if the test fired
        [receiver.heading_cos receiver.heading_sin        1     of heading − line of sight; of a receiver that moves
         last_action0]                                    1     its previous turn
        transmitterN.log_range                            m     log(range from the track / 50 km)
        transmitterN.sight_cos transmitterN.sight_sin     1     level direction from it to the track, along and left
        [transmitterN.sight_up]                           1     5 · sine of its elevation; in space
        transmitterN.log_gain                             1     log(what the track leaves of its range sum / noise) / 2
        transmitterN.chosen                               1     1 if selected for the last scan
        transmitterN.answered transmitterN.missed         1     1 if listened to, and its echo came, or did not
        transmitterN.recent_answer                        1     exp(−time since its last echo / 10 s)
        transmitterN.recent_miss                          1     exp(−time since its last miss / 10 s)
        transmitterN.blocked_probability                  1
        [transmitterN.wait]                               s     time until an echo can come / the retuning delay
        [transmitterN.log_noise]                          m     log(standard deviation of its range sum / nominal)
        [transmitterN.clear_in_K]                         1     2 · chance to be clear at the Kth scan to come − 1
        [combinationC.log_promise]                        m     log(error it promises / least error promised)

    A direction of cosine −1 is that of a target between transmitter and receiver, whose range sum tells nothing of
    where; at cosine +1 it tells the range twice. The transmitters' fields, `per_transmitter` each, come after those
    of the track and the receiver, which are `shared`: a network may be shared between transmitters, and between
    combinations of them. Values are clipped to ±5.

    Args:
        dimensions: 2 or 3.
        pool, steps: number of transmitters and of decisions.
        moves: whether the receiver moves.
        retune_delay_s: s.
        std_m: nominal standard deviation of a range sum.
        std_varies: whether it differs with the ranges.
        promise: [e, c] log of the error that each combination promises, of beliefs; None: not observed.
        combinations: how many there are.
        foresight: [e, n, q] chances to be clear in `FORESEEN_SCANS`, of beliefs; None: not observed.
    """

    def __init__(
        self, dimensions: int, pool: int, steps: int, moves: bool, retune_delay_s: float, std_m: float,
        std_varies: bool, promise: Callable[[RadarBelief], np.ndarray] | None = None, combinations: int = 0,
        foresight: Callable[[RadarBelief], np.ndarray] | None = None,
    ):  # fmt: skip
        shared = tuple(_shared_fields(dimensions, moves))
        foreseen = FORESEEN_SCANS if foresight is not None else ()
        own = [
            tuple(_transmitter_fields(n, dimensions, retune_delay_s > 0.0, std_varies, foreseen)) for n in range(pool)
        ]
        named = shared + tuple(field for block in own for field in block)
        self.promised = combinations if promise is not None else 0
        self.fields = named + tuple(
            Field(f"combination{c}.log_promise", "m", "log(error it promises / least error promised)")
            for c in range(self.promised)
        )
        self._promise, self._foresight = promise, foresight
        self.shared, self.per_transmitter = len(shared), len(own[0])
        self.space = spaces.Box(-LIMIT, LIMIT, (len(self.fields),), np.float32)
        self._like = np.empty(len(named), dtype=np.float32)
        self._steps = float(steps)
        self._limits = np.array([float(moves), retune_delay_s, std_m, float(std_varies)])
        self._mirror_sign = np.array([-1 if field.odd else 1 for field in self.fields], dtype=np.float32)

    def __call__(self, belief: RadarBelief) -> Any:
        """Observation [e, o] float32 inside the space."""
        b = belief
        foresight = np.empty((1, b.std.shape[1], 0)) if self._foresight is None else self._foresight(b)
        seen = _observe(
            b.steps_left / self._steps, b.platforms, b.mean, b.cov, b.last_action, b.transmitters, b.chosen, b.wait_s,
            b.answered, b.missed, b.since_answer_s, b.since_miss_s, b.blocked_probability, foresight, b.std,
            b.statistic, b.maneuver, self._limits, self._like,
        )  # fmt: skip
        if self._promise is None:
            return seen
        promised = self._promise(belief)
        more = np.minimum(promised - promised.min(axis=1, keepdims=True), LIMIT)
        return np.concatenate([seen, more.astype(np.float32)], axis=1)

    def mirrored(self, observation: np.ndarray) -> np.ndarray:
        """Observations [..., o] of the mirrored worlds: left is right."""
        return self._mirror_sign * observation


def _shared_fields(dimensions: int, moves: bool):
    yield Field("time_left", "1", "share of the episode's steps")
    yield Field("track0.log_range", "m", "log(range from the receiver / 50 km)")
    yield Field("track0.radial_velocity", "m/s", "/ 300 m/s")
    yield Field("track0.cross_velocity", "m/s", "/ 300 m/s, left positive", odd=True)
    if dimensions == 3:
        yield Field("track0.height", "m", "above the receiver / 10 km")
        yield Field("track0.climb", "m/s", "/ 50 m/s")
    axes = (*AXES[dimensions], *(f"{axis}_velocity" for axis in AXES[dimensions]))
    for axis in axes:
        unit, size = ("m/s", "50 m/s") if "velocity" in axis else ("m", "1 km")
        yield Field(f"track0.log_std_{axis}", unit, f"log(standard deviation / {size}) / 2")
    for i, first in enumerate(axes):
        for second in axes[i + 1 :]:
            odd = ("cross" in first) != ("cross" in second)
            yield Field(f"track0.corr_{first}_{second}", "1", "correlation coefficient", odd)
    yield Field("track0.log_statistic", "1", "log(1 + statistic of the maneuver test) / 2")
    yield Field("track0.maneuver", "1", "1 if the maneuver test fired")
    if moves:
        yield Field("receiver.heading_cos", "1", "cosine of heading − line of sight")
        yield Field("receiver.heading_sin", "1", "sine of heading − line of sight", odd=True)
        yield Field("last_action0", "1", "previous turn", odd=True)


def _transmitter_fields(n: int, dimensions: int, waits: bool, varies: bool, foreseen: Sequence[int]):
    name = f"transmitter{n}"
    yield Field(f"{name}.log_range", "m", "log(range from the track / 50 km)")
    yield Field(f"{name}.sight_cos", "1", "of the level direction from it to the track, along the line of sight")
    yield Field(f"{name}.sight_sin", "1", "the same, left of the line of sight", odd=True)
    if dimensions == 3:
        yield Field(f"{name}.sight_up", "1", "5 · sine of the track's elevation above it")
    yield Field(f"{name}.log_gain", "1", "log(standard deviation that the track leaves of its range sum / noise) / 2")
    yield Field(f"{name}.chosen", "1", "1 if selected for the last scan")
    yield Field(f"{name}.answered", "1", "1 if its echo came")
    yield Field(f"{name}.missed", "1", "1 if it was listened to and its echo did not come")
    yield Field(f"{name}.recent_answer", "1", f"exp(−time since its last echo / {RECENT_S:g} s)")
    yield Field(f"{name}.recent_miss", "1", f"exp(−time since its last miss / {RECENT_S:g} s)")
    yield Field(f"{name}.blocked_probability", "1", "of being blocked")
    if waits:
        yield Field(f"{name}.wait", "s", "time until an echo can come / the retuning delay")
    if varies:
        yield Field(f"{name}.log_noise", "m", "log(standard deviation of its range sum / nominal)")
    for scans in foreseen:
        yield Field(f"{name}.clear_in_{scans}", "1", "2 · chance to be clear so many scans on − 1")
