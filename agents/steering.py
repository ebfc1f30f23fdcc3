"""From where a platform should head to the commands that bring it there, in the plane and in space."""

from __future__ import annotations

import numpy as np

from passive_env.belief import Belief
from passive_env.kinematics import plan_view
from trackers.angles import wrap


def course(platforms: np.ndarray) -> np.ndarray:
    """Level courses [..., s] rad of platforms [..., s, 4] or [..., s, 6]."""
    level = plan_view(platforms)
    return np.arctan2(level[..., 3], level[..., 2])


def towards(headings: np.ndarray, platforms: np.ndarray, turn_per_step: float) -> np.ndarray:
    """Turn commands [..., s] in [−1, 1] that bring platforms [..., s, n] to headings [..., s] rad, then hold them."""
    return np.clip(wrap(headings - course(platforms)) / max(turn_per_step, 1e-12), -1.0, 1.0)


def line_of_sight(platforms: np.ndarray, mean: np.ndarray) -> np.ndarray:
    """Level directions [..., s] rad from platforms [..., s, n] to the middle of tracks [..., m, n]."""
    to_middle = mean[..., None, :, :2].mean(-2) - platforms[..., :2]
    return np.arctan2(to_middle[..., 1], to_middle[..., 0])


def level_flight(turns: np.ndarray, belief: Belief) -> np.ndarray:
    """Commands [e, a] of turn commands [e, s]: platforms that can climb keep their altitude."""
    climbs = belief.last_action.shape[-1] - turns.shape[-1]
    return np.concatenate([turns, np.zeros((len(turns), climbs))], axis=-1) if climbs else turns
