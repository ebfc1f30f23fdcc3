"""Greedy information policies: hold the control that the predicted covariance likes best some steps ahead."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from agents.prediction import Prediction, Situation
from agents.prediction_3d import Prediction3D
from agents.steering import level_flight
from passive_env.belief import Belief
from passive_env.catalogue.angle_fusion import AngleFusion
from passive_env.steering import course, line_of_sight, towards

TURN_LEVELS = 9
"""Turn rates tried by `controls="turns"`, from −limit to +limit."""

PASSES = 2
"""How often several platforms' controls are improved in turn."""


def predict(scenario: Any, *settings: Any) -> Prediction:
    """The prediction of a scenario's family: settings as of `agents.prediction.Prediction`."""
    return (Prediction3D if isinstance(scenario, AngleFusion) else Prediction)(scenario, *settings)


class Greedy:
    """Tries controls held for some steps and takes the best: headings, or turn rates.

    Headings lie about the line of sight, all around; in space, where a horizon is short, about the present course as
    far as it reaches. One platform's candidates are compared exhaustively. Several platforms are improved in turn,
    beginning with all of them holding course, the others' controls being held meanwhile.

    Args:
        scenario: where it acts.
        horizon: steps to look ahead, fewer at the episode's end.
        criterion, guard_m, controls: as in `agents.prediction.Prediction`.
        headings: directions tried, equally spaced, besides the present one.
        None for a setting: the usual one of the scenario's family.
    Raises:
        ValueError: horizon or headings below 1, or what `Prediction` refuses.
    """

    def __init__(
        self, scenario: Any, horizon: int | None = None, criterion: str | None = None, guard_m: float | None = None,
        controls: str = "headings", headings: int | None = None,
    ):  # fmt: skip
        self.prediction = predict(scenario, criterion, guard_m, controls)
        horizon = self.prediction.usual_horizon if horizon is None else horizon
        headings = self.prediction.usual_headings if headings is None else headings
        for name, value in (("horizon", horizon), ("headings", headings)):
            if isinstance(value, bool) or not isinstance(value, (int, np.integer)) or value < 1:
                raise ValueError(f"{name} = {value!r}: must be an integer of at least 1")
        self.horizon = int(horizon)
        self._turns = controls == "turns"
        self._headings = int(headings)

    def reset(self, belief: Belief) -> None:
        """Nothing to remember."""

    def act(self, belief: Belief, observation: np.ndarray) -> np.ndarray:
        """The first command of the best candidate."""
        best = self.best(self.prediction.situation(belief, self.horizon), belief.mean)
        turns = best if self._turns else towards(best, belief.platforms, self.prediction.turn_per_step)
        return level_flight(turns, belief)

    def best(self, start: Situation, mean: np.ndarray) -> np.ndarray:
        """The best controls [e, s] from a situation; `mean` [e, m, n] gives the line of sight."""
        candidates = self.candidates(start, mean)
        batch, stations, count = candidates.shape
        best = candidates[..., 0].copy()
        ends = np.broadcast_to(start.steps[:, None, None], (batch, count, 1))
        for station in [*range(stations)] * (PASSES if stations > 1 else 1):
            plans = np.repeat(best[:, None, None], count, axis=1)
            plans[..., 0, station] = candidates[:, station]
            choice = self.prediction.cost(start, plans, ends).argmin(axis=1)
            best[:, station] = np.take_along_axis(candidates[:, station], choice[:, None], axis=1)[:, 0]
        return best

    def candidates(self, start: Situation, mean: np.ndarray) -> np.ndarray:
        """Controls [e, s, c] to try; the first is to hold course."""
        held = course(start.platforms)[..., None]
        if self._turns:
            rates = np.linspace(-1.0, 1.0, TURN_LEVELS)
            return np.concatenate([0.0 * held, np.broadcast_to(rates, (*held.shape[:2], TURN_LEVELS))], axis=-1)
        if self.prediction.about_course:
            reach = np.minimum(start.steps * self.prediction.turn_per_step, math.pi)[:, None, None]
            return np.concatenate([held, held + reach * _shares(self._headings)], axis=-1)
        sight = line_of_sight(start.platforms, mean)[..., None]
        return np.concatenate([held, sight + _directions(self._headings)], axis=-1)


def _shares(count: int) -> np.ndarray:
    """Numbers equally spaced from −1 to 1, the same to both sides; 0 only if they are odd."""
    return np.delete(np.linspace(-1.0, 1.0, count + 1), count // 2) if count % 2 == 0 else np.linspace(-1.0, 1.0, count)


def _directions(count: int) -> np.ndarray:
    """Angles from 0 [rad], the same to both sides."""
    return 2.0 * math.pi / count * (np.arange(count) - (count - 1) // 2)


def greedy(**settings: Any) -> Any:
    """A maker (scenario, seed) of greedy policies with the settings of `Greedy`."""
    return lambda scenario, seed: Greedy(scenario, **settings)


GREEDY = {"greedy": greedy()}
"""Makers (scenario, seed); looks 12 steps ahead. Others: ``greedy(horizon=1, criterion="trace")``."""

GREEDY_IN_SPACE = {
    "greedy": greedy(horizon=8, criterion="position_std"),
    "greedy_4": greedy(horizon=4, criterion="position_std"),
    "greedy_1": greedy(horizon=1, criterion="position_std"),
}
"""Makers (scenario, seed) for platforms in space, which look 8, 4 and 1 steps ahead; the criterion is the best of
`agents.prediction_3d.CRITERIA_3D` in final and time-averaged position error together, on seeds from 500,000 on."""
