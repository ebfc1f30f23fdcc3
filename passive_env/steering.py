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


def line_of_sight(platforms: np.ndarray, mean: np.ndarray) -> np.ndarray:
    """Level directions [..., s] rad from platforms [..., s, n] to the middle of tracks [..., m, n]."""
    to_middle = mean[..., None, :, :2].mean(-2) - platforms[..., :2]
    return np.arctan2(to_middle[..., 1], to_middle[..., 0])


def outward(platforms: np.ndarray, mean: np.ndarray) -> np.ndarray:
    """+1 [..., s] for platforms [..., s, n] on the left of the line from their midpoint to the tracks, −1 on the right.

    Of platforms exactly on it the first goes right, the others left.
    """
    places = platforms[..., :2]
    apart = places - places.mean(-2, keepdims=True)
    sight = mean[..., None, :, :2].mean(-2) - places.mean(-2, keepdims=True)
    across = sight[..., 0] * apart[..., 1] - sight[..., 1] * apart[..., 0]
    on_it = np.where(np.arange(places.shape[-2]) == 0, -1.0, 1.0)
    return np.where(across > 0.0, 1.0, np.where(across < 0.0, -1.0, on_it))


@kernel("(s,n),(m,n),(s)->(s)")
def _left_to_turn(platforms, mean, off, out):
    stations, tracks, v = platforms.shape[0], mean.shape[0], platforms.shape[1] // 2
    x, y, px, py = 0.0, 0.0, 0.0, 0.0
    for m in range(tracks):
        x, y = x + mean[m, 0] / tracks, y + mean[m, 1] / tracks
    for i in range(stations):
        px, py = px + platforms[i, 0] / stations, py + platforms[i, 1] / stations
    for i in range(stations):
        across = (x - px) * (platforms[i, 1] - py) - (y - py) * (platforms[i, 0] - px)
        side = 1.0 if across > 0.0 or (across == 0.0 and i > 0) else -1.0
        dx, dy, vx, vy = x - platforms[i, 0], y - platforms[i, 1], platforms[i, v], platforms[i, v + 1]
        left = wrap_scalar(math.atan2(vx * dy - vy * dx, vx * dx + vy * dy) + side * off[i])
        out[i] = left if math.isfinite(left) else 0.0


def left_to_turn(platforms: np.ndarray, mean: np.ndarray, off: np.ndarray) -> np.ndarray:
    """Turns [..., s] rad that bring platforms [..., s, n] to headings `off` [..., s] rad outwards of their sights.

    Sights run to the middle of the tracks [..., m, n]; outwards is as of `outward`. Off the sight to a diverged track,
    where that is not a number, it is straight on.
    """
    return _left_to_turn(platforms, mean, off)
