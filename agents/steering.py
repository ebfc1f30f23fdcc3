"""Commands of platforms that may also climb (see `passive_env.steering` for the rest)."""

from __future__ import annotations

import numpy as np

from passive_env.belief import Belief


def level_flight(turns: np.ndarray, belief: Belief) -> np.ndarray:
    """Commands [e, a] of turn commands [e, s]: platforms that can climb keep their altitude."""
    climbs = belief.last_action.shape[-1] - turns.shape[-1]
    return np.concatenate([turns, np.zeros((len(turns), climbs))], axis=-1) if climbs else turns
