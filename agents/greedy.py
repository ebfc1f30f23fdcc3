"""Greedy information policies: hold the control that the predicted covariance likes best some steps ahead."""

from __future__ import annotations

import itertools
import math
from typing import Any

import numpy as np

from agents.prediction import Prediction, Situation
from agents.prediction_3d import Prediction3D
from agents.prediction_fixes import FixPrediction
from agents.steering import level_flight
from passive_env.belief import Belief
from passive_env.catalogue.angle_fusion import AngleFusion
from passive_env.catalogue.maneuvering import ManeuveringTarget
from passive_env.steering import course, line_of_sight

TURN_LEVELS = 9
"""Turn rates tried by `controls="turns"`, from −limit to +limit."""

OFF_SIGHT_DEG = 80.0
"""Angle off the line of sight at which sides are compared."""

TURN_WITHIN = 0.5 * math.pi
"""Angle between course and heading above which a station that turns on the spot waits."""

HALTS = 8
"""How often stations that stop to measure do so in a plan, every other step, before they stop for good."""

HOLD = 10**6
"""A number of steps that no episode has."""

PASSES = 2
"""How often several platforms' controls are improved in turn."""


def predict(scenario: Any, *settings: Any) -> Prediction:
    """The prediction of a scenario's family: settings as of `agents.prediction.Prediction`."""
    families = {AngleFusion: Prediction3D, ManeuveringTarget: FixPrediction}
    return next((kind for family, kind in families.items() if isinstance(scenario, family)), Prediction)(
        scenario, *settings
    )


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
        return level_flight(best, belief) if self._turns else self.prediction.commands(best, belief)

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


class FixGreedy(Greedy):
    """Tries headings and speeds held for some steps, of stations whose bearings become position fixes.

    Which side every station goes to is decided first: `OFF_SIGHT_DEG` off its line of sight, for all patterns of left
    and right, turning on the way or on the spot; or all go straight on, or all stop. Then the stations are improved in
    turn: headings all about the line of sight, turning on the way or on the spot, or to stop. Stations that measure
    only when slow drive for some of `DRIVE_STEPS`, all of them, and then stop.

    Args:
        as of `Greedy`, without `controls`.
    Raises:
        ValueError: as of `Greedy`.
    """

    prediction: FixPrediction

    @property
    def legs(self) -> int:
        """Legs of a plan; every other one is a halt where there are more than one."""
        return 2 * HALTS if self.prediction.stops_to_measure else 1

    def best(self, start: Situation, mean: np.ndarray) -> np.ndarray:
        """The best controls [e, 3 s] of the first step."""
        controls, ends = self.plan(start, mean)
        return controls[np.arange(len(ends)), (ends > 0).argmax(axis=1)]

    def plan(self, start: Situation, mean: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The best controls [e, g, 3 s] and ends of legs [e, g]."""
        controls, ends = self._patterns(start, mean)
        best, ends = self._better(start, controls, ends)
        stations = start.platforms.shape[1]
        for station in [*range(stations)] * (PASSES if stations > 2 else 1):
            moves = self._moves(start, mean, best, station)
            best, _ = self._better(start, moves, np.repeat(ends[:, None], moves.shape[1], axis=1))
        return best, ends

    def _better(self, start: Situation, controls: np.ndarray, ends: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The best of plans [e, c, …]."""
        rows = np.arange(len(controls))
        choice = self.prediction.cost(start, controls, ends).argmin(axis=1)
        return controls[rows, choice], ends[rows, choice]

    def _patterns(self, start: Situation, mean: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Controls [e, c, g, 3 s] and ends [e, c, g]: straight on, stopped, to all patterns of sides."""
        stations = start.platforms.shape[1]
        signs = np.array(list(itertools.product((1.0, -1.0), repeat=stations)))
        sides = line_of_sight(start.platforms, mean)[:, None] + math.radians(OFF_SIGHT_DEG) * signs
        apart = [_controls(sides, 1.0, within) for within in (math.pi, TURN_WITHIN)]
        drives = np.concatenate([self.prediction.held(start.platforms)[:, None], *apart], axis=1)
        stop = _stopped(drives[:, :1])
        last = start.steps[:, None, None]
        if self.legs == 1:
            controls = np.concatenate([drives, stop], axis=1)[:, :, None]
            return controls, np.broadcast_to(last, controls.shape[:3])
        drive_and_halt = np.tile(np.stack([drives, _stopped(drives)], axis=2), (1, 1, HALTS, 1))
        stay = np.repeat(stop[:, :, None], self.legs, axis=2)
        number = np.arange(self.legs)
        once = np.where(number == 0, 1, HOLD)
        ends = np.concatenate([number[None] + 1, np.repeat([number + 1, number, once], drives.shape[1], axis=0)])
        controls = np.concatenate([stay, *[drive_and_halt] * 3], axis=1)
        return controls, np.minimum(ends, last)

    def _moves(self, start: Situation, mean: np.ndarray, best: np.ndarray, station: int) -> np.ndarray:
        """Plans [e, c, g, 3 s] in which one station goes another way than in the best one so far [e, g, 3 s]."""
        stations = start.platforms.shape[1]
        sight = line_of_sight(start.platforms[:, station : station + 1], mean)
        ways = np.concatenate([course(start.platforms)[:, station, None], sight + _directions(self._headings)], axis=-1)
        count = ways.shape[1]
        plans = np.repeat(best[:, None], 2 * count + 2, axis=1)
        plans[:, 1, :, stations + station] = -1.0
        plans[:, 2:, :, station] = np.tile(ways, 2)[..., None]
        plans[:, 2:, ::2, stations + station] = 1.0
        plans[:, 2 : 2 + count, :, 2 * stations + station] = math.pi
        plans[:, 2 + count :, :, 2 * stations + station] = TURN_WITHIN
        return plans


def _controls(headings: np.ndarray, speed: float, within: float) -> np.ndarray:
    """Controls [..., 3 s] of headings [..., s] and one speed and angle for all stations."""
    return np.concatenate([headings, np.full_like(headings, speed), np.full_like(headings, within)], axis=-1)


def _stopped(controls: np.ndarray) -> np.ndarray:
    """Controls [..., 3 s] with the lowest speed for all stations."""
    return _controls(controls[..., : controls.shape[-1] // 3], -1.0, math.pi)


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

FIX_GREEDY = {"greedy": lambda scenario, seed: FixGreedy(scenario)}
"""Maker (scenario, seed) for stations whose bearings become fixes."""
