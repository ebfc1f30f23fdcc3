"""What the agent does: spaces of actions and their meaning.

A codec checks actions (`decode`), turns them into commands, the shares of rates that platforms fly by (`commands`), and
finds the actions that give the commands of a rule (`encode`).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from gymnasium import spaces

from passive_env.belief import Belief
from passive_env.steering import (
    course,
    lead_pursuit,
    left_to_turn,
    line_of_sight,
    outward,
    shorter_sides,
    towards,
)
from trackers.angles import wrap

GUIDED = ("headings", "velocities")
"""Kinds of actions that become plain commands only by what is known at the time; `Continuous` has their space."""

HARD_TURN_DEG = 60.0
"""A platform that turns as hard as it can is taken to head for this much off its course, or for as much as a step turns
it if that is more: whoever learns from such an action may then err without turning the other way."""

LEADS_DEG = (-150.0, -90.0, -50.0, -25.0, -10.0, 0.0, 10.0, 25.0, 50.0, 90.0, 150.0)
"""Courses off that of lead pursuit, finest about it."""


class Continuous:
    """A Box in [−1, 1], one number per rate as a share of its limit: turns (counter-clockwise +), then any climbs.

    Args:
        size: how many numbers.
        odd: [size] whether a number changes its sign when left and right are exchanged; None: all do.
    """

    meaning = ""
    """What the numbers stand for where `space` does not tell: a model fits only where they mean what it learned."""

    def __init__(self, size: int, odd: Sequence[bool] | None = None):
        self.size = size
        self._odd = np.array([True] * size if odd is None else odd)
        self.space = spaces.Box(-1.0, 1.0, (size,), np.float32)

    def decode(self, action: Any, batch: int | None) -> np.ndarray:
        """Commands [e, a] in [−1, 1], float64, of actions [a] (batch None) or [batch, a]; outside values are clipped.

        Raises:
            ValueError: wrong shape, or values that are not finite numbers.
        """
        values = _numbers(action, (self.size,) if batch is None else (batch, self.size))
        return np.minimum(np.maximum(values, -1.0), 1.0)

    def commands(self, values: np.ndarray, belief: Belief) -> np.ndarray:
        """Commands [e, a] of decoded actions [e, a]: the same."""
        return values

    def encode(self, commands: np.ndarray, belief: Belief | None = None) -> np.ndarray:
        """Actions [e, a] that mean the commands [e, a]."""
        return commands.astype(np.float32)

    def mirrored(self, actions: np.ndarray) -> np.ndarray:
        """Actions [..., a] that do in the mirrored world what these do here."""
        return np.where(self._odd, -actions, actions)


class Headings(Continuous):
    """A Box in [−1, 1] of headings to turn to, as shares of 180° off a platform's own line of sight, then any climbs.

    Positive is outwards (`passive_env.steering.outward`): the left half of the platforms, looking along the mean line
    of sight, turns to the left of their own. Platforms turn as fast as they can until they fly on the heading. What is
    constant here opens the baseline and keeps it open; exploring about it moves platforms where shares of turn rates
    would average out.

    Args:
        size, odd: as of `Continuous`; the first `platforms` numbers are headings.
        platforms: how many turn.
        turn_per_step: largest turn in a step [rad].
    """

    meaning = "headings"

    def __init__(self, size: int, platforms: int, turn_per_step: float, odd: Sequence[bool] | None = None):
        super().__init__(size, odd)
        self._platforms, self._turn_per_step = platforms, turn_per_step

    def commands(self, values: np.ndarray, belief: Belief) -> np.ndarray:
        """Commands [e, a] of decoded actions [e, a], by the lines of sight to the track of a belief."""
        left = self._left_to_turn(values, belief)
        return np.concatenate([self._turns(left), values[:, self._platforms :]], axis=1)

    def _left_to_turn(self, values: np.ndarray, belief: Belief) -> np.ndarray:
        off = self._sides(belief) * math.pi * values[:, : self._platforms]
        return left_to_turn(belief.platforms, belief.mean, off)

    def _sides(self, belief: Belief) -> np.ndarray:
        """+1 [e, s] where positive headings are left of the line of sight, −1 where right."""
        return outward(belief.platforms, belief.mean)

    def _turns(self, left: np.ndarray) -> np.ndarray:
        """Commands [e, s] of what is left to turn [e, s] rad: all of it, or as much as can be."""
        return np.clip(left / max(self._turn_per_step, 1e-12), -1.0, 1.0)

    def encode(self, commands: np.ndarray, belief: Belief | None = None) -> np.ndarray:
        """Actions [e, a] that mean the commands [e, a] to a belief, which is needed.

        A heading cannot name turns of 180° or more: where a step can turn so far, such a command comes back as another.
        """
        if belief is None:
            raise TypeError("encode(commands, belief): headings off a line of sight need the belief")
        n = self._platforms
        turns = commands[:, :n]
        hardest = max(math.radians(HARD_TURN_DEG), self._turn_per_step)
        ahead = np.where(np.abs(turns) < 1.0, self._turn_per_step, hardest) * turns
        aim = course(belief.platforms) + ahead
        off = wrap(aim - line_of_sight(belief.platforms, belief.mean)) * self._sides(belief)
        return np.concatenate([np.nan_to_num(off) / math.pi, commands[:, n:]], axis=1).astype(np.float32)

    def mirrored(self, actions: np.ndarray) -> np.ndarray:
        """Actions [..., a] that do in the mirrored world what these do here: sides are the platforms' own."""
        return actions


class HeadingsAndSpeeds(Headings):
    """Headings as of `Headings`, then speeds from the lowest, −1, to the highest.

    Positive is the side on which the baseline is sooner opened (`passive_env.steering.shorter_sides`): outwards, or for
    both of two platforms the opposite if that saves much turning. They cross each other's way then, and are outside
    after it. Sides are named anew at every step, so headings far from `opening_angle` may change them on the way.

    A platform that flies more than 90° off the heading, and farther off than a step turns it, turns at its lowest
    speed, on the spot if that is 0, whatever its speed should be then: the way flown meanwhile would have to be flown
    back.

    Args:
        as of `Headings`; there is a speed per platform.
        way_per_step: longest way in a step [m].
        opening_angle, crossing_worth: angle [rad] and worth of `shorter_sides`; more than two platforms never cross.
    """

    meaning = "headings from the sides on which the baseline is sooner opened, and speeds"

    def __init__(
        self, size: int, platforms: int, turn_per_step: float, odd: Sequence[bool] | None = None, *,
        way_per_step: float, opening_angle: float, crossing_worth: float,
    ):  # fmt: skip
        super().__init__(size, platforms, turn_per_step, odd)
        self._way_per_step, self._opening_angle = way_per_step, opening_angle
        self._crossing_worth = crossing_worth if platforms == 2 else math.inf
        self._slow_beyond = max(0.5 * math.pi, 1.001 * turn_per_step)  # beyond what rounding adds to a step's turn

    def commands(self, values: np.ndarray, belief: Belief) -> np.ndarray:
        """Commands [e, a] of decoded actions [e, a], by the lines of sight to the track of a belief."""
        left = self._left_to_turn(values, belief)
        speeds = np.where(np.abs(left) > self._slow_beyond, -1.0, values[:, self._platforms :])
        return np.concatenate([self._turns(left), speeds], axis=1)

    def _sides(self, belief: Belief) -> np.ndarray:
        """+1 [e, s] where positive headings are left of the line of sight, −1 where right."""
        return shorter_sides(
            belief.platforms, belief.mean, angle=self._opening_angle, worth=self._crossing_worth,
            turn_per_step=self._turn_per_step, way_per_step=self._way_per_step,
        )  # fmt: skip


class Discrete:
    """A MultiDiscrete with one choice per rate among equally spaced ones from −limit to +limit.

    Args:
        size, odd: as of `Continuous`.
        levels: choices per rate.
    """

    meaning = ""

    def __init__(self, size: int, levels: int = 3, odd: Sequence[bool] | None = None):
        self.size = size
        self._odd = np.array([True] * size if odd is None else odd)
        self.levels = levels
        self.space = spaces.MultiDiscrete([levels] * size)

    def decode(self, action: Any, batch: int | None) -> np.ndarray:
        """Commands [e, a] in [−1, 1] of choices [a] or [batch, a].

        Raises:
            ValueError: wrong shape, or a choice outside 0 … levels − 1.
        """
        values = _numbers(action, (self.size,) if batch is None else (batch, self.size))
        if ((values < 0) | (values >= self.levels) | (values != np.rint(values))).any():
            raise ValueError(f"action {action!r}: choices must be integers from 0 to {self.levels - 1}")
        return 2.0 * values / (self.levels - 1) - 1.0

    def commands(self, values: np.ndarray, belief: Belief) -> np.ndarray:
        """Commands [e, a] of decoded actions [e, a]: the same."""
        return values

    def encode(self, commands: np.ndarray, belief: Belief | None = None) -> np.ndarray:
        """The choices [e, a] nearest to commands [e, a]."""
        return np.rint(0.5 * (np.clip(commands, -1.0, 1.0) + 1.0) * (self.levels - 1)).astype(np.int64)

    def mirrored(self, actions: np.ndarray) -> np.ndarray:
        """Choices [..., a] that do in the mirrored world what these do here."""
        return np.where(self._odd, self.levels - 1 - actions, actions)


class Combinations:
    """A MultiDiscrete whose last number picks one of several combinations of n; another one may precede it.

    Commands are n scores, 1 of what is in the combination and −1 of the others.

    Args:
        combinations: [c, k] what each holds, numbers below n.
        n: how many there are to choose from.
    """

    meaning = ""

    _before: tuple[int, ...] = ()
    """Choices of the number that comes first, if there is one."""

    def __init__(self, combinations: np.ndarray, n: int):
        self.size = len(self._before) + n
        self._n, self._k = n, combinations.shape[1]
        self._scores = np.full((len(combinations), n), -1.0)
        np.put_along_axis(self._scores, combinations, 1.0, axis=1)
        self._place = np.zeros(2**n, dtype=np.int64)
        self._place[(1 << combinations).sum(1)] = np.arange(len(combinations))
        self._choices = np.array([*self._before, len(combinations)])
        self.space = spaces.MultiDiscrete(self._choices)

    def decode(self, action: Any, batch: int | None) -> np.ndarray:
        """What choices [q] or [batch, q] say [e, a]: of the first one its number, of the last one scores.

        Raises:
            ValueError: wrong shape, or a choice that there is not.
        """
        shape = (len(self._choices),)
        values = _numbers(action, shape if batch is None else (batch, *shape))
        if ((values < 0) | (values >= self._choices) | (values != np.rint(values))).any():
            highest = ", ".join(map(str, self._choices - 1))
            raise ValueError(f"action {action!r}: choices must be integers from 0 to {highest}")
        chosen = values.astype(np.int64)
        return np.concatenate([values[:, :-1], self._scores[chosen[:, -1]]], axis=1)

    def commands(self, values: np.ndarray, belief: Any) -> np.ndarray:
        """Commands [e, a] of decoded actions [e, a]: the same."""
        return values

    def encode(self, commands: np.ndarray, belief: Any = None) -> np.ndarray:
        """The choices [e, q] nearest to commands [e, a]: of scores the highest, of equal ones the first."""
        highest = np.argsort(-commands[:, -self._n :], axis=1, kind="stable")[:, : self._k]
        return self._place[(1 << highest).sum(1)][:, None]

    def mirrored(self, actions: np.ndarray) -> np.ndarray:
        """Choices [..., q] that do in the mirrored world what these do here: the same."""
        return actions


class LeadsAndCombinations(Combinations):
    """Combinations as of `Combinations`, and before them the course of one platform, one of `LEADS_DEG`.

    The platform turns as fast as it can until it flies on that course, which is off that of lead pursuit, to the left
    if positive (`passive_env.steering.lead_pursuit`).

    Args:
        combinations, n: as of `Combinations`.
        turn_per_step: largest turn in a step [rad].
    """

    meaning = f"courses of {LEADS_DEG} degrees off lead pursuit"

    _before = (len(LEADS_DEG),)

    def __init__(self, combinations: np.ndarray, n: int, turn_per_step: float):
        super().__init__(combinations, n)
        self._turn_per_step, self._leads = turn_per_step, np.radians(LEADS_DEG)

    def commands(self, values: np.ndarray, belief: Any) -> np.ndarray:
        """Commands [e, a] of decoded actions [e, a], by the track of a belief: a turn, then scores."""
        aim = lead_pursuit(belief.platforms[:, 0], belief.mean[:, 0]) + self._leads[values[:, 0].astype(np.int64)]
        return np.concatenate([towards(aim[:, None], belief.platforms, self._turn_per_step), values[:, 1:]], axis=1)

    def encode(self, commands: np.ndarray, belief: Any = None) -> np.ndarray:
        """The choices [e, 2] nearest to commands [e, a] to a belief, which is needed.

        A turn as hard as can be is taken for a course `HARD_TURN_DEG` off.
        """
        if belief is None:
            raise TypeError("encode(commands, belief): courses off lead pursuit need the belief")
        hardest = max(math.radians(HARD_TURN_DEG), self._turn_per_step)
        ahead = np.where(np.abs(commands[:, 0]) < 1.0, self._turn_per_step, hardest) * commands[:, 0]
        off = course(belief.platforms)[:, 0] + ahead - lead_pursuit(belief.platforms[:, 0], belief.mean[:, 0])
        lead = np.abs(wrap(off[:, None] - self._leads)).argmin(axis=1)
        return np.concatenate([lead[:, None], super().encode(commands)], axis=1)

    def mirrored(self, actions: np.ndarray) -> np.ndarray:
        """Choices [..., 2] that do in the mirrored world what these do here: leads the other way round."""
        return np.concatenate([len(LEADS_DEG) - 1 - actions[..., :1], actions[..., 1:]], axis=-1)


def _numbers(action: Any, shape: tuple[int, ...]) -> np.ndarray:
    try:
        if np.iscomplexobj(action):
            raise TypeError("complex")
        values = np.asarray(action, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise ValueError(f"action {action!r}: must be numbers of shape {shape}") from error
    if values.shape != shape:
        raise ValueError(f"action has shape {values.shape}, must have shape {shape}")
    if not np.isfinite(values).all():
        raise ValueError(f"action {action!r}: every value must be a finite number")
    return values if len(shape) == 2 else values[None]
