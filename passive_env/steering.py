"""From where a platform should head to the turn that brings it there, in the plane and in space."""

from __future__ import annotations

import numpy as np

from passive_env.kinematics import plan_view
from trackers.angles import wrap


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
