"""What the agent sees of a track and of the carriers that follow it: documented fields of the belief, nothing else."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from gymnasium import spaces

from passive_env.mobile_simulation import MobileBelief
from passive_env.observations import LIMIT, Field, clip_value
from passive_env.placement_observation import kind_of, task_fields, task_numbers
from trackers.compiled import helper, kernel

SLOWEST_M_S = 30.0
"""A track slower than this has no course yet: it is taken to fly to the site."""

TRACK_FIELDS, SENSOR_FIELDS = 16, 9


class MobileObservation:
    """The task, the track, and the carriers seen from the expected entry and from the target.

    Two frames: from the expected entry, towards the site and to the left of who looks there, as actions are; and from
    the target, ahead on its estimated course and to the left of it (a track that has no speed yet flies to the site).

    Fields in order (`fields` names each with its unit and scale); N is a sensor's number, `task.…` are the same
    throughout an episode:

        time_left                                1     share of the episode's decisions
        task.…                                         as of `passive_env.placement_observation.PlacementObservation`
        target.along target.left                 m     from the expected entry towards the site and left / 100 km
        target.height                            m     / 10 km
        target.course_cos target.course_sin      1     of its course off the direction from the entry to the site
        target.speed                             m/s   level / 300 m/s
        target.climb                             m/s   / 50 m/s
        target.log_SIDE_std                      m     log(standard deviation / 300 m) / 2, of ahead, left and up
        target.log_SIDE_velocity_std             m/s   log(standard deviation / 10 m/s) / 2
        target.corr_ahead_left target.corr_ahead_up target.corr_left_up   1   of the position
        sensorN.azimuth_cos sensorN.azimuth_sin  1     at the expected entry; 0 until installed, as the rest
        sensorN.distance                         m     (horizontal distance from the expected entry − 200 km) / 50 km
        sensorN.height                           m     / 10 km
        sensorN.ahead sensorN.left               m     of the target on its course / 100 km
        sensorN.log_range                        m     log(distance from the target / 50 km)
        sensorN.above                            1     sine of its elevation seen from the target
        sensorN.available                        1     whether it measured at the last scan

    Values are clipped to ±5.

    Args:
        ranging: [n] whether a sensor measures range.
        steps: decisions of an episode.
    """

    def __init__(self, ranging: Any, steps: int):
        self.fields = tuple(_fields(ranging))
        self.space = spaces.Box(-LIMIT, LIMIT, (len(self.fields),), np.float32)
        self._steps = steps
        self._like = np.empty(TRACK_FIELDS + SENSOR_FIELDS * len(ranging))
        self._mirror_sign = np.array([-1 if field.odd else 1 for field in self.fields], dtype=np.float32)

    def __call__(self, belief: MobileBelief) -> Any:
        """Observation [e, d] float32 inside the space."""
        seen = _observe(
            belief.mean[:, 0], belief.cov[:, 0], course_of(belief), belief.platforms, belief.measured,
            belief.installed, belief.task.entry_distance_m, self._like,
        )  # fmt: skip
        numbers = np.hstack([(belief.steps_left / self._steps)[:, None], task_numbers(belief.task), seen])
        return np.clip(numbers, -LIMIT, LIMIT).astype(np.float32)

    def mirrored(self, observation: np.ndarray) -> np.ndarray:
        """Observations [..., d] of the mirrored worlds: left is right."""
        return self._mirror_sign * observation


def course_of(belief: MobileBelief) -> np.ndarray:
    """Unit vectors [e, 2] of the tracks' courses, which actions and observations are told by."""
    x = belief.mean[:, 0]
    speed, far = np.hypot(x[:, 3], x[:, 4]), np.hypot(x[:, 0], x[:, 1])
    flies, away = speed >= SLOWEST_M_S, far >= 1.0
    to_site = np.where(away[:, None], -x[:, :2] / np.maximum(far, 1.0)[:, None], [-1.0, 0.0])
    return np.where(flies[:, None], x[:, 3:5] / np.maximum(speed, 1.0)[:, None], to_site)


@helper
def _write_spreads(P, c, s, axes, frame, out, i):
    """Log standard deviations ahead, left and up, of the velocity too, and the position's correlations."""
    for j in range(3):
        for k in range(3):
            axes[j, k] = 0.0
    axes[0, 0], axes[0, 1], axes[1, 0], axes[1, 1], axes[2, 2] = c, s, -s, c, 1.0
    for half in range(2):
        for m in range(3):
            for n in range(m + 1):
                total = 0.0
                for j in range(3):
                    for k in range(3):
                        total += axes[m, j] * P[3 * half + j, 3 * half + k] * axes[n, k]
                frame[half, m, n] = total
        for m in range(3):
            frame[half, m, m] = math.sqrt(max(frame[half, m, m], 1e-6))
            out[i] = 0.5 * math.log(frame[half, m, m] / (300.0 if half == 0 else 10.0))
            i += 1
    for m in range(1, 3):
        for n in range(m):
            out[i] = frame[0, m, n] / (frame[0, m, m] * frame[0, n, n])
            i += 1
    return i


@kernel("(x6),(x6,x6),(p),(n,x6),(n),(),(),(d)->(d)", "FFFFBbfFF")
def _observe(x, P, course, platforms, measured, installed, entry_distance, like, out):
    c, s = course[0], course[1]
    out[:] = 0.0
    out[0], out[1], out[2] = (entry_distance - x[0]) / 1e5, -x[1] / 1e5, x[2] / 1e4
    out[3], out[4], out[5], out[6] = -c, -s, math.hypot(x[3], x[4]) / 300.0, x[5] / 50.0
    i = _write_spreads(P, c, s, np.empty((3, 3)), np.empty((2, 3, 3)), out, 7)
    for k in range(platforms.shape[0]):
        if installed:
            along, left = entry_distance - platforms[k, 0], -platforms[k, 1]
            level = max(math.hypot(along, left), 1.0)
            dx, dy, dz = platforms[k, 0] - x[0], platforms[k, 1] - x[1], platforms[k, 2] - x[2]
            r = max(math.sqrt(dx * dx + dy * dy + dz * dz), 1.0)
            out[i], out[i + 1] = along / level, left / level
            out[i + 2], out[i + 3] = (level - 2e5) / 5e4, platforms[k, 2] / 1e4
            out[i + 4], out[i + 5] = (c * dx + s * dy) / 1e5, (c * dy - s * dx) / 1e5
            out[i + 6], out[i + 7], out[i + 8] = math.log(r / 5e4), dz / r, 1.0 if measured[k] else 0.0
        i += SENSOR_FIELDS
    for j in range(out.shape[0]):
        out[j] = clip_value(out[j])


SIDES = ("ahead", "left", "up")


def _fields(ranging: Any):
    yield Field("time_left", "1", "share of the episode's decisions")
    yield from task_fields()
    yield Field("target.along", "m", "from the expected entry towards the site / 100 km")
    yield Field("target.left", "m", "left of that / 100 km", odd=True)
    yield Field("target.height", "m", "/ 10 km")
    yield Field("target.course_cos", "1", "of its course off the direction from the entry to the site")
    yield Field("target.course_sin", "1", "of its course off the direction from the entry to the site", odd=True)
    yield Field("target.speed", "m/s", "level / 300 m/s")
    yield Field("target.climb", "m/s", "/ 50 m/s")
    for side in SIDES:
        yield Field(f"target.log_{side}_std", "m", "log(standard deviation / 300 m) / 2")
    for side in SIDES:
        yield Field(f"target.log_{side}_velocity_std", "m/s", "log(standard deviation / 10 m/s) / 2")
    for pair in ("ahead_left", "ahead_up", "left_up"):
        yield Field(f"target.corr_{pair}", "1", "correlation of the position", odd="left" in pair)
    for i, ranges in enumerate(ranging):
        yield Field(f"sensor{i}.azimuth_cos", "1", "of its azimuth at the expected entry; 0 until installed")
        yield Field(f"sensor{i}.azimuth_sin", "1", "of its azimuth at the expected entry; 0 until installed", odd=True)
        yield Field(f"sensor{i}.distance", "m", "(from the expected entry, level − 200 km) / 50 km; 0 until installed")
        yield Field(f"sensor{i}.height", "m", f"/ 10 km; 0 until installed{kind_of(ranges)}")
        yield Field(f"sensor{i}.ahead", "m", "of the target on its course / 100 km; 0 until installed")
        yield Field(f"sensor{i}.left", "m", "of the target's course / 100 km; 0 until installed", odd=True)
        yield Field(f"sensor{i}.log_range", "m", "log(distance from the target / 50 km); 0 until installed")
        yield Field(f"sensor{i}.above", "1", "sine of its elevation seen from the target; 0 until installed")
        yield Field(f"sensor{i}.available", "1", "1 if it measured at the last scan")


@kernel("(),(t),(n,x6),(a),(n,k),(n,p3),(n),(n),(),(),(d)->(n,d)", "fFFFIFBBbfgG")
def _observe_own(time_left, task, platforms, last_action, columns, measurement, measured, ranging, installed,
                 entry_distance, like, out):  # fmt: skip
    for s in range(platforms.shape[0]):
        seen = out[s]
        seen[:] = 0.0
        seen[0] = time_left
        for k in range(task.shape[0]):
            seen[1 + k] = task[k]
        i = 1 + task.shape[0]
        if installed:
            along, left = entry_distance - platforms[s, 0], -platforms[s, 1]
            level = max(math.hypot(along, left), 1.0)
            seen[i], seen[i + 1] = along / level, left / level
            seen[i + 2], seen[i + 3] = (level - 2e5) / 5e4, platforms[s, 2] / 1e4
        i += 4
        for k in range(columns.shape[1]):
            seen[i + k] = last_action[columns[s, k]]
        i += columns.shape[1]
        if measured[s]:
            r, azimuth, elevation = measurement[s, 0], measurement[s, 1], measurement[s, 2]
            seen[i], seen[i + 1] = 1.0, math.log(max(r, 1.0) / 5e4) if ranging[s] else 0.0
            seen[i + 2], seen[i + 3], seen[i + 4] = -math.cos(azimuth), -math.sin(azimuth), elevation
        for k in range(seen.shape[0]):
            seen[k] = clip_value(seen[k])


class OwnMobileObservation:
    """Every carrier's own place and what its own sensor measured at the last scan; nothing of the track or of others.

    The task is the briefing that all get before the episode. Directions are told as places are: off the direction from
    the expected entry to the site, to the left of who looks there.

    Fields in order (`fields` names each with its unit and scale); N is a number:

        time_left                              1    share of the episode's decisions
        task.…                                      as of `passive_env.placement_observation.PlacementObservation`
        own.azimuth_cos own.azimuth_sin        1    at the expected entry; 0 until installed, as the next two
        own.distance                           m    (horizontal distance from the expected entry − 200 km) / 50 km
        own.height                             m    / 10 km
        own.last_actionN                       1    its own previous action
        own.measured                           1    whether it measured at the last scan; the rest is 0 if not
        own.measured_log_range                 m    log(measured range / 50 km); 0 of a sensor without range
        own.measured_cos own.measured_sin      1    of the measured azimuth
        own.measured_elevation                 rad

    Values are clipped to ±5.

    Args:
        columns: [n, 3] which numbers of a command are whose.
        ranging: [n] whether a sensor measures range.
        steps: decisions of an episode.
    """

    def __init__(self, columns: np.ndarray, ranging: np.ndarray, steps: int):
        self.fields = tuple(_own_fields())
        self.space = spaces.Box(-LIMIT, LIMIT, (len(self.fields),), np.float32)
        self._columns, self._ranging, self._steps = columns, ranging, steps
        self._like = np.empty(len(self.fields), dtype=np.float32)

    def __call__(self, belief: MobileBelief) -> Any:
        """Observations [e, n, d] float32 inside the space."""
        return _observe_own(
            belief.steps_left / self._steps, task_numbers(belief.task), belief.platforms, belief.last_action,
            self._columns, belief.measurement, belief.measured, self._ranging, belief.installed,
            belief.task.entry_distance_m, self._like,
        )  # fmt: skip


def _own_fields():
    yield Field("time_left", "1", "share of the episode's decisions")
    yield from task_fields()
    yield Field("own.azimuth_cos", "1", "of its azimuth at the expected entry; 0 until installed")
    yield Field("own.azimuth_sin", "1", "of its azimuth at the expected entry; 0 until installed", odd=True)
    yield Field("own.distance", "m", "(from the expected entry, level − 200 km) / 50 km; 0 until installed")
    yield Field("own.height", "m", "/ 10 km; 0 until installed")
    for k in range(3):
        yield Field(f"own.last_action{k}", "1", "its own previous action", odd=k == 0)
    yield Field("own.measured", "1", "1 if it measured at the last scan")
    yield Field("own.measured_log_range", "m", "log(range / 50 km); 0 without")
    yield Field("own.measured_cos", "1", "of the azimuth off the direction from the entry to the site; 0 without")
    yield Field("own.measured_sin", "1", "of the azimuth off the direction from the entry to the site; 0 without", True)
    yield Field("own.measured_elevation", "rad", "0 without")
