"""Courses of a passive radar's targets: drawn corridors past the origin, and white accelerations along them."""

from __future__ import annotations

import math

from trackers.compiled import kernel


@kernel("(c),(l),(x6)->(x6)", "FFFF")
def corridor(u, limits, like, start):
    """A target's start on its way past the origin, [..., 6] m, m/s.

    Args:
        u: [..., 5 or more] uniform: direction, distance and side, way ahead, speed, altitude; more are not used.
        limits: [8] least and largest distance of the corridor [m], way to its nearest point [m], speed [m/s], altitude
            [m].
        like: [6], any numbers: only its length counts, for numba's sake.
    """
    course, sign = 2.0 * math.pi * u[0], 1.0 if u[1] < 0.5 else -1.0
    aside = sign * (limits[0] + (limits[1] - limits[0]) * abs(2.0 * u[1] - 1.0))
    ahead = limits[2] + (limits[3] - limits[2]) * u[2]
    speed = limits[4] + (limits[5] - limits[4]) * u[3]
    c, s = math.cos(course), math.sin(course)
    start[0], start[1] = -ahead * c - aside * s, -ahead * s + aside * c
    start[2] = limits[6] + (limits[7] - limits[6]) * u[4]
    start[3], start[4], start[5] = speed * c, speed * s, 0.0


@kernel("(t,x),(y),(q,d),(d),()->(t,y)", "FFFFfF")
def disturbed(level, start, z, std, T, path):
    """A level path, at the start's height, and what white accelerations that are held over each step add to it.

    Args:
        level: [..., t, 4] m, m/s.
        start: [..., 2d] m, m/s.
        z: [..., t − 1, d] standard normal.
        std: [d] m/s².
        T: step s.
    Returns:
        path [..., t, 2d] m, m/s.
    """
    d = std.shape[0]
    for j in range(d):
        moved = gained = 0.0
        for t in range(level.shape[0]):
            if t > 0:
                push = T * std[j] * z[t - 1, j]
                moved += T * (gained + 0.5 * push)
                gained += push
            path[t, j] = moved + (level[t, j] if j < 2 else start[2] + T * t * start[5])
            path[t, d + j] = gained + (level[t, 2 + j] if j < 2 else start[5])
