"""Greedy information policies: hold the control that the predicted covariance likes best some steps ahead."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from agents.prediction import Prediction, Situation, situation
from agents.steering import line_of_sight, towards
from passive_env.belief import Belief

TURN_LEVELS = 9
"""Turn rates tried by `controls="turns"`, from −limit to +limit."""

PASSES = 2
"""How often several platforms' controls are improved in turn."""


class Greedy:
    """Tries controls held for some steps and takes the best: headings about the line of sight, or turn rates.

    One platform's candidates are compared exhaustively. Several platforms are improved in turn, beginning with all of
    them holding course, the others' controls being held meanwhile.

    Args:
        scenario: where it acts.
        horizon: steps to look ahead, fewer at the episode's end.
        criterion, guard_m, controls: as in `agents.prediction.Prediction`.
        headings: directions tried, equally spaced from the line of sight, besides the present one.
    Raises:
        ValueError: horizon or headings below 1, or what `Prediction` refuses.
    """

    def __init__(
        self, scenario: Any, horizon: int = 12, criterion: str = "mean_log_std", guard_m: float = 8e3,
        controls: str = "headings", headings: int = 24,
    ):  # fmt: skip
        for name, value in (("horizon", horizon), ("headings", headings)):
            if isinstance(value, bool) or not isinstance(value, (int, np.integer)) or value < 1:
                raise ValueError(f"{name} = {value!r}: must be an integer of at least 1")
        self.prediction = Prediction(scenario, criterion, guard_m, controls)
        self.horizon = int(horizon)
        self._turns = controls == "turns"
        self._grid = np.linspace(-1.0, 1.0, TURN_LEVELS) if self._turns else _directions(headings)

    def reset(self, belief: Belief) -> None:
        """Nothing to remember."""

    def act(self, belief: Belief, observation: np.ndarray) -> np.ndarray:
        """The first command of the best candidate."""
        best = self.best(situation(belief, self.prediction.step_s, self.horizon), belief.mean)
        return best if self._turns else towards(best, belief.platforms, self.prediction.turn_per_step)

    def best(self, start: Situation, mean: np.ndarray) -> np.ndarray:
        """The best controls [e, s] from a situation; `mean` [e, m, 4] gives the line of sight."""
        candidates = self.candidates(start.platforms, mean)
        batch, stations, count = candidates.shape
        best = candidates[..., 0].copy()
        ends = np.broadcast_to(start.steps[:, None, None], (batch, count, 1))
        for station in [*range(stations)] * (PASSES if stations > 1 else 1):
            plans = np.repeat(best[:, None, None], count, axis=1)
            plans[..., 0, station] = candidates[:, station]
            choice = self.prediction.cost(start, plans, ends).argmin(axis=1)
            best[:, station] = np.take_along_axis(candidates[:, station], choice[:, None], axis=1)[:, 0]
        return best

    def candidates(self, platforms: np.ndarray, mean: np.ndarray) -> np.ndarray:
        """Controls [e, s, c] to try; the first is to hold course."""
        if self._turns:
            held = np.zeros((*platforms.shape[:2], 1))
            return np.concatenate([held, np.broadcast_to(self._grid, (*held.shape[:2], TURN_LEVELS))], axis=-1)
        held = np.arctan2(platforms[..., 3], platforms[..., 2])[..., None]
        return np.concatenate([held, line_of_sight(platforms, mean)[..., None] + self._grid], axis=-1)


def _directions(count: int) -> np.ndarray:
    """Angles from 0 [rad], the same to both sides."""
    return 2.0 * math.pi / count * (np.arange(count) - (count - 1) // 2)


def greedy(**settings: Any) -> Any:
    """A maker (scenario, seed) of greedy policies with the settings of `Greedy`."""
    return lambda scenario, seed: Greedy(scenario, **settings)


GREEDY = {"greedy": greedy()}
"""Makers (scenario, seed); the default looks 12 steps ahead. Others: ``greedy(horizon=1, criterion="trace")``."""
