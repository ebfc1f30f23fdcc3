"""Placement of sensors before a target comes: what is known of its course, and where an action puts a sensor.

The site is the origin; x runs from it to the place where the target is expected to enter, at a distance that is known.
A sensor's azimuth a is counted at that place from the direction to the site, positive to the left of who looks there
from the entry:

    x = D − d cos a,   y = −d sin a,   z = h

Source: Yang et al. (1998), section 6, whose sensors lie on such a circle of d = D = 200 km.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from trackers.gaussian import Gaussian
from trackers.motion_3d import predict_3d

COURSES = ((-math.sqrt(0.6), 5.0 / 18.0), (0.0, 8.0 / 18.0), (math.sqrt(0.6), 5.0 / 18.0))
"""Entries that stand for all of a sector, as shares of its half width, and their weights (Gauss–Legendre)."""


class Task(NamedTuple):
    """What an operator knows of an episode before it begins; e environments.

    Attributes:
        entry_distance_m: [e] D, from the site to the expected entry.
        sector_rad: [e] half width of the sector, seen from the site, in which the target enters at D; uniform.
        heading_rad: [e] half width of its course off the direction to the site; uniform.
        altitude_m: [e, 2] lowest and highest; uniform.
        speed_m_s: [e, 2] slowest and fastest; uniform.
        std: [e, 3] standard deviations of all sensors' range [m], azimuth and elevation [rad].
        azimuth_limit_rad: [e] largest |a| of a sensor.
        distance_m: [e, 2] least and largest d.
        height_limit_m: [e] largest h; the least is 0, the ground.
    """

    entry_distance_m: Any
    sector_rad: Any
    heading_rad: Any
    altitude_m: Any
    speed_m_s: Any
    std: Any
    azimuth_limit_rad: Any
    distance_m: Any
    height_limit_m: Any

    def rows(self, rows: Any) -> Task:
        """The tasks of some episodes: a slice, or their numbers."""
        return Task(*(part[rows] for part in self))


class PlacementBelief(NamedTuple):
    """What an operator knows between placements; e environments, n sensors.

    Attributes:
        steps_left: [e] sensors left to place.
        platforms: [e, n, 6] sensors m, m/s; those that are not placed yet stand at the site.
        mean: [e, 1, 6] state expected at the last scan; once the track has been run, the fused estimate of it.
        cov: [e, 1, 6, 6] its covariance.
        last_action: [e, 3] the previous action, 0 at first.
        task: what is known of courses, accuracies and limits.
    """

    steps_left: Any
    platforms: Any
    mean: Any
    cov: Any
    last_action: Any
    task: Task


def site(azimuth, distance, height, entry_distance):
    """Positions [..., 3] m of sensors at azimuth [rad], horizontal distance and height [m] of the expected entry."""
    x = entry_distance - distance * np.cos(azimuth)
    return np.stack(np.broadcast_arrays(x, -distance * np.sin(azimuth), height), axis=-1)


def seen_from_entry(position, entry_distance):
    """Azimuth [rad], horizontal distance and height [m], each [...], of positions [..., 3]; `site` reversed."""
    x, y, z = (np.asarray(position)[..., i] for i in range(3))
    along = entry_distance - x
    return np.arctan2(-y, along), np.hypot(along, y), z


def positions(commands, task: Task):
    """Positions [e, ..., 3] m that commands [e, ..., 3] in [−1, 1] mean: azimuth, distance, height."""
    c = np.asarray(commands, dtype=float)
    of_task = lambda part: np.reshape(part, (len(c), *(1,) * (c.ndim - 2)))  # noqa: E731
    near, far = of_task(task.distance_m[:, 0]), of_task(task.distance_m[:, 1])
    return site(
        c[..., 0] * of_task(task.azimuth_limit_rad), near + 0.5 * (c[..., 1] + 1.0) * (far - near),
        0.5 * (c[..., 2] + 1.0) * of_task(task.height_limit_m), of_task(task.entry_distance_m),
    )  # fmt: skip


def commands(azimuth, distance, height, task: Task):
    """Commands [e, ..., 3] that put sensors at azimuths [rad], distances and heights [m], each [e, ...] or a number.

    What lies outside the limits goes to the nearest limit.
    """
    axes = max(map(np.ndim, (azimuth, distance, height)))
    of_task = lambda part: np.reshape(part, (len(part), *(1,) * (axes - 1)))  # noqa: E731
    near, far, high = (of_task(part) for part in (*task.distance_m.T, task.height_limit_m))
    along = (
        _share(azimuth, of_task(task.azimuth_limit_rad)),
        _share(distance - 0.5 * (near + far), 0.5 * (far - near)),
        _share(height - 0.5 * high, 0.5 * high),
    )
    return np.clip(np.stack(np.broadcast_arrays(*along), axis=-1), -1.0, 1.0)


def _share(value, of):
    """value / of, 0 where there is nothing to choose."""
    value, of = np.broadcast_arrays(np.asarray(value, dtype=float), of)
    return np.divide(value, of, out=np.zeros_like(value), where=of > 0.0)


def entries(entry_distance, bearing, off_site, altitude, speed):
    """States [..., 6] of targets that enter at a bearing from the site on a course `off_site` from that to the site.

    Args:
        entry_distance: m; bearing, off_site: rad, counter-clockwise positive; altitude: m; speed: m/s.
    """
    course = bearing + math.pi + off_site
    return np.stack(
        np.broadcast_arrays(
            entry_distance * np.cos(bearing), entry_distance * np.sin(bearing), altitude, speed * np.cos(course),
            speed * np.sin(course), 0.0,
        ), axis=-1,
    )  # fmt: skip


def straight(start, scans: int, step_s: float):
    """Paths [..., k, 6] of constant velocity from starts [..., 6]."""
    start = np.asarray(start)[..., None, :]
    time_s = step_s * np.arange(scans)[:, None]
    velocity = np.broadcast_to(start[..., 3:], (*start.shape[:-2], scans, 3))
    return np.concatenate([start[..., :3] + time_s * velocity, velocity], axis=-1)


def representative_courses(task: Task, scans: int, step_s: float):
    """Paths [e, 3, k, 6] that stand for a task's sector of entry; `COURSES` has their weights.

    Course, speed and altitude are their means: they move the target by little against its distance from the sensors.
    """
    nodes = np.array([node for node, _ in COURSES])
    start = entries(
        task.entry_distance_m[:, None], nodes * task.sector_rad[:, None], 0.0, task.altitude_m.mean(-1)[:, None],
        task.speed_m_s.mean(-1)[:, None],
    )  # fmt: skip
    return straight(start, scans, step_s)


def entry_prior(task: Task) -> Gaussian:
    """Mean [e, 6] and covariance [e, 6, 6] of the state in which a target enters: moments of what is drawn.

    With b the bearing from the site, o the course off the direction to the site and V the speed, all uniform,
    E cos b = sin(β)/β of the half width β, E cos² b = (1 + E cos 2b)/2 and so on; x = D cos b, ẋ = −V cos(b + o).
    """
    s, h, D = task.sector_rad, task.heading_rad, task.entry_distance_m
    c, c2, d, d2 = (np.sinc(k * width / math.pi) for width in (s, h) for k in (1, 2))
    speed, altitude = task.speed_m_s.mean(-1), task.altitude_m.mean(-1)
    variance = np.diff(task.speed_m_s, axis=-1)[:, 0] ** 2 / 12.0
    cosine, sine = 0.5 * (1.0 + c2) - c**2, 0.5 * (1.0 - c2)  # variances of those of b
    squared = speed**2 + variance
    zero = np.zeros(len(s))
    mean = np.stack([D * c, zero, altitude, -speed * c * d, zero, zero], axis=-1)
    cov = np.tile(np.diag([1.0, 1.0, 1.0, 1e-2, 1e-2, 1e-2]), (len(s), 1, 1))  # a metre, a decimetre a second
    cov[:, 0, 0] += D**2 * cosine
    cov[:, 1, 1] += D**2 * sine
    cov[:, 2, 2] += np.diff(task.altitude_m, axis=-1)[:, 0] ** 2 / 12.0
    cov[:, 3, 3] += 0.5 * squared * (1.0 + c2 * d2) - (speed * c * d) ** 2
    cov[:, 4, 4] += 0.5 * squared * (1.0 - c2 * d2)
    for i, spread in ((0, cosine), (1, sine)):
        cov[:, i, 3 + i] = cov[:, 3 + i, i] = -D * speed * d * spread
    return Gaussian(mean, cov)


def course_prior(task: Task, scans: int, step_s: float, acceleration_std: float) -> Gaussian:
    """Mean [e, 6] and covariance [e, 6, 6] of the state at the last scan: moments of what is drawn, none measured.

    The entry's, moved on, and a white acceleration of `acceleration_std` per axis.
    """
    steps = scans - 1
    moved = predict_3d(entry_prior(task), step_s * steps, 0.0)
    half = 0.5 * step_s * steps
    noise = np.kron([[step_s**2 * (steps**2 / 3.0 - 1.0 / 12.0), half], [half, 1.0]], np.eye(3))
    return Gaussian(moved.mean, moved.cov + (acceleration_std * step_s) ** 2 * steps * noise)
