"""From where a platform should head to the turn that brings it there, in the plane and in space."""

from __future__ import annotations

import math

import numpy as np

from passive_env.kinematics import plan_view
from trackers.angles import wrap, wrap_scalar
from trackers.compiled import kernel


def course(platforms: np.ndarray) -> np.ndarray:
    """Level courses [..., s] rad of platforms [..., s, 4] or [..., s, 6]."""
    level = plan_view(platforms)
    return np.arctan2(level[..., 3], level[..., 2])


def towards(headings: np.ndarray, platforms: np.ndarray, turn_per_step: float) -> np.ndarray:
    """Turn commands [..., s] in [−1, 1] that bring platforms [..., s, n] to headings [..., s] rad, then hold them.

    A heading that is not a number, as towards a diverged track, means straight on.
    """
    missing = np.nan_to_num(wrap(headings - course(platforms)))
    return np.clip(missing / max(turn_per_step, 1e-12), -1.0, 1.0)


def lead_pursuit(platform: np.ndarray, target: np.ndarray) -> np.ndarray:
    """Headings [...] rad on which platforms meet targets that fly straight on soonest.

    A target that cannot be met is aimed at where it will be after the time that the way to it takes; towards one that
    is no number the heading is none either.

    Args:
        platform, target: states [..., 4] or [..., 6].
    """
    own, other = plan_view(platform), plan_view(target)
    line, v = other[..., :2] - own[..., :2], other[..., 2:]
    speed = np.linalg.norm(own[..., 2:], axis=-1)
    a, b, c = np.square(v).sum(-1) - speed**2, (line * v).sum(-1), np.square(line).sum(-1)
    root = np.sqrt(np.maximum(b * b - a * c, 0.0))
    slow = np.where(a < 0.0, (-b - root) / np.where(a < 0.0, a, -1.0), np.inf)  # the target is the slower one
    fast = c / np.where(root > b, root - b, np.nan)
    time = np.where(a < 0.0, slow, np.where((b < 0.0) & (b * b >= a * c), fast, np.inf))
    time = np.where(np.isfinite(time), time, np.sqrt(c) / np.maximum(speed, 1e-9))
    aim = line + time[..., None] * v
    return np.arctan2(aim[..., 1], aim[..., 0])


def line_of_sight(platforms: np.ndarray, mean: np.ndarray) -> np.ndarray:
    """Level directions [..., s] rad from platforms [..., s, n] to the middle of tracks [..., m, n]."""
    to_middle = mean[..., None, :, :2].mean(-2) - platforms[..., :2]
    return np.arctan2(to_middle[..., 1], to_middle[..., 0])


@kernel("(s,n),(m,n)->(s)")
def _outward(platforms, mean, out):
    stations, tracks, v = platforms.shape[0], mean.shape[0], platforms.shape[1] // 2
    x, y, px, py = 0.0, 0.0, 0.0, 0.0
    for m in range(tracks):
        x, y = x + mean[m, 0] / tracks, y + mean[m, 1] / tracks
    for i in range(stations):
        px, py = px + platforms[i, 0] / stations, py + platforms[i, 1] / stations
    for i in range(stations):
        more_left = 0
        for j in range(stations):
            across = (x - px) * (platforms[j, 1] - platforms[i, 1]) - (y - py) * (platforms[j, 0] - platforms[i, 0])
            if across > 0.0 or (across == 0.0 and j > i):
                more_left += 1
        fan = stations - 1 - 2 * more_left
        if fan == 0:
            own_left = (x - platforms[i, 0]) * platforms[i, v + 1] - (y - platforms[i, 1]) * platforms[i, v]
            fan = 1 if own_left >= 0.0 else -1
        out[i] = 1.0 if fan > 0 else -1.0


def outward(platforms: np.ndarray, mean: np.ndarray) -> np.ndarray:
    """Sides [..., s] to which platforms [..., s, n] fan out, looking from their midpoint to the middle of the tracks.

    +1, left, for the left half of them, −1, right, for the right half. One in the middle of an odd number goes to the
    side of its own line of sight that its course is on. Of platforms in line with the tracks later ones count as left.

    Args:
        platforms: place and velocity, in the plane or in space.
        mean: tracks [..., m, n], alike.
    """
    return _outward(platforms, mean)


def shorter_sides(
    platforms: np.ndarray, mean: np.ndarray, *, angle: float, worth: float, turn_per_step: float, way_per_step: float
) -> np.ndarray:
    """Sides [..., s] as of `outward`, or for all platforms the opposite ones where opening to those is sooner done.

    All go to the other side, crossing each other's way, where that saves the average one more steps of turning than
    `worth` times those it takes to fly the longest baseline. Two platforms that then turn to `angle` stay on their way,
    for it saves them ever more to turn. Of more than two an inner pair passes before the others do: decide but once.

    Args:
        platforms, mean: as of `outward`.
        angle: off its own line of sight to which a platform turns [rad].
        worth: infinite never crosses.
        turn_per_step, way_per_step: largest turn [rad] and longest way [m] in a step.
    """
    sides = outward(platforms, mean)
    if math.isinf(worth):
        return sides
    off = course(platforms) - line_of_sight(platforms, mean)
    turning, otherwise = (np.abs(wrap(side * angle - off)).mean(axis=-1) for side in (sides, -sides))
    saved = (turning - otherwise) / max(turn_per_step, 1e-12)
    crossing = saved > worth * _longest_baseline(platforms) / max(way_per_step, 1e-12)
    return np.where(crossing[..., None], -sides, sides)


def _longest_baseline(platforms: np.ndarray) -> np.ndarray:
    """The largest distance [...] between any two of the platforms [..., s, n]."""
    apart = platforms[..., :, None, :2] - platforms[..., None, :, :2]
    return np.sqrt(np.square(apart).sum(axis=-1)).max(axis=(-2, -1))


@kernel("(s,n),(m,n),(s)->(s)")
def _left_to_turn(platforms, mean, off, out):
    stations, tracks, v = platforms.shape[0], mean.shape[0], platforms.shape[1] // 2
    x, y = 0.0, 0.0
    for m in range(tracks):
        x, y = x + mean[m, 0] / tracks, y + mean[m, 1] / tracks
    for i in range(stations):
        dx, dy, vx, vy = x - platforms[i, 0], y - platforms[i, 1], platforms[i, v], platforms[i, v + 1]
        left = wrap_scalar(math.atan2(vx * dy - vy * dx, vx * dx + vy * dy) + off[i])
        out[i] = left if math.isfinite(left) else 0.0


def left_to_turn(platforms: np.ndarray, mean: np.ndarray, off: np.ndarray) -> np.ndarray:
    """Turns [..., s] rad that bring platforms [..., s, n] to headings `off` [..., s] rad left of their sights.

    Sights run to the middle of the tracks [..., m, n]. Off the sight to a diverged track, where that is not a number,
    it is straight on.
    """
    return _left_to_turn(platforms, mean, off)
