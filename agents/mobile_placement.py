"""Policies for sensors on carriers: static layouts, moving rules, greedy repositioning along the predicted track.

All decide from the belief, except the oracle. What is promised is the theoretical covariance's position error, in
logarithms, averaged over the scans looked at.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from agents.placement import (
    BestRule,
    Planned,
    Promise,
    Rule,
    Search,
    commands_of,
    even,
    expected,
    layout_commands,
    spaced,
)
from agents.placement import tripod as static_tripod
from agents.policy import Policy
from passive_env.core import World
from passive_env.mobile_sensors import accuracies
from passive_env.mobile_simulation import MobileBelief, routes
from passive_env.placement import Task, entry_prior, positions, representative_courses
from trackers.compiled import Blocks
from trackers.converted_measurement import Layout
from trackers.scan_fusion import ScanState

BLOCK = 32
"""Episodes whose candidates are weighed in one go."""


# -- static layouts ----------------------------------------------------------------------------------------------------


class Static:
    """Installs sensors by a rule of the task and leaves them there.

    Args:
        rule: says where.
        sensors: how many.
    """

    def __init__(self, rule: Rule, sensors: int):
        self._rule, self._sensors = rule, sensors

    def reset(self, belief: MobileBelief) -> None:
        """Nothing to remember."""

    def act(self, belief: MobileBelief, observation: np.ndarray) -> np.ndarray:
        """Commands [e, 3 n], the same at every step."""
        return layout_commands(self._rule, belief.task, self._sensors).reshape(len(belief.steps_left), -1)


class StaticPromise(Promise):
    """Expected log of the position's standard deviation [m], averaged over an episode's scans, of static layouts.

    Args:
        scenario: supplies the filter, kinds and scans.
    """

    def __init__(self, scenario: Any):
        self._scenario, self._tracker = scenario, scenario.make_tracker()

    def of(self, task: Task) -> Callable[[np.ndarray], np.ndarray]:
        """[e, c] of candidate layouts, commands [e, c, n, 3], for one task."""
        s = self._scenario
        path = representative_courses(task, s.steps + 1, s.step_s)[:, :, None, 1:]
        state = _spread(self._tracker.initiate(entry_prior(task)), 2)
        std = accuracies(task, s.sensors)[:, None, None]

        def promised(layouts: np.ndarray) -> np.ndarray:
            place = positions(layouts, task)[:, None, :, None]
            place = np.broadcast_to(place, (*place.shape[:3], s.steps, *place.shape[-2:]))
            n = place.shape[-2]
            layout = Layout(place, std[..., :n, :], s.ranging[:n])
            return expected(np.log(self._tracker.promise(state, path, layout, s.step_s).position_std_m).mean(-1))

        return promised


def _spread(state: Any, axes: int) -> ScanState:
    """A state [e] with axes of length one behind the first."""
    at = tuple(range(1, 1 + axes))
    return ScanState(*(np.expand_dims(part, at) for part in (state.mean, state.cov, state.scans, state.waited_s)))


class Standing(Planned):
    """Plans whole layouts by `StaticPromise`, installs them and leaves them there."""

    def __init__(self, scenario: Any):
        self._promise, self._sensors = StaticPromise(scenario), scenario.sensors
        self._plan: np.ndarray | None = None

    def act(self, belief: MobileBelief, observation: np.ndarray) -> np.ndarray:
        """Commands [e, 3 n], the same at every step."""
        if self._plan is None:
            self._plan = self.plan(belief.task)
        return self._plan.reshape(len(self._plan), -1)


class BestStaticRule(Standing, BestRule):
    """Keeps to the rule whose layout promises least."""


class BestStatic(Standing, Search):
    """The best static layout that the search finds: what moving is measured by.

    Args:
        scenario: what to act in.
        seed: of the search.
    """

    def __init__(self, scenario: Any, seed: int = 0):
        Standing.__init__(self, scenario)
        self._seed = seed


# -- moving ------------------------------------------------------------------------------------------------------------


def tracked(belief: MobileBelief) -> np.ndarray:
    """Estimated states [e, 6]; the velocity of a track without any is what the task lets expect."""
    x = belief.mean[:, 0].copy()
    fresh = belief.track_state.scans[:, 0] < 2
    x[fresh, 3:] = entry_prior(belief.task).mean[fresh, 3:]
    return x


class Formation:
    """Keeps all sensors about a point of the predicted course ahead of the target, evenly round it.

    Every other sensor flies at the highest place, so lines of sight lie in no common plane. Carriers are slower than
    the target: they wait for it and leave with it.

    Args:
        scenario: what to act in.
        install_s, lead_s: how far ahead of the target the point lies at first, and later.
        radius_m: of the formation, whose first sensor is behind that point.
    """

    def __init__(self, scenario: Any, install_s: float = 250.0, lead_s: float = 120.0, radius_m: float = 15e3):
        self._sensors, self._times, self._radius = scenario.sensors, (install_s, lead_s), radius_m

    def reset(self, belief: MobileBelief) -> None:
        """Nothing to remember."""

    def act(self, belief: MobileBelief, observation: np.ndarray) -> np.ndarray:
        """Commands [e, 3 n]."""
        x = tracked(belief)
        lead = np.where(belief.installed, self._times[1], self._times[0])[:, None]
        centre = x[:, :2] + lead * x[:, 3:5]
        backwards = np.arctan2(-x[:, 4], -x[:, 3])[:, None]
        angle = backwards + 2.0 * math.pi * np.arange(self._sensors) / self._sensors
        height = belief.task.height_limit_m[:, None] * (np.arange(self._sensors) % 2)
        x_y = (centre[:, [0]] + self._radius * np.cos(angle), centre[:, [1]] + self._radius * np.sin(angle))
        place = np.stack([*x_y, height], axis=-1)
        return commands_of(place, belief.task).reshape(len(x), -1)


class Moment(NamedTuple):
    """What a greedy decision starts from; e environments of which all or none have their sensors installed.

    Attributes:
        task: what is known; state: the track, [e]; platforms: [e, n, 6].
        path: [e, k, 6] expected states at the scans looked at; step_s: between them.
        installing: bool, whether sensors are set down rather than sent.
    """

    task: Task
    state: ScanState
    platforms: np.ndarray
    path: np.ndarray
    step_s: float
    installing: bool


class Greedy:
    """Sends one carrier after another to the place, among some, on the way to which the least error is promised.

    The target is taken to fly straight on from where the track has it. Where sensors are installed is chosen alike,
    in two rounds, as if they would stay there for a while.

    Args:
        scenario: what to act in.
        scans: looked at, spread evenly over the time.
        ahead_s: time looked ahead.
        install_s: the same when sensors are installed; of carriers on the ground, which move little, the whole track.
        installer: who installs them instead, if any.
    """

    BEARINGS, RADII_M = 8, (10e3, 30e3)
    """Ways to go: so many directions from the carrier, and as many from where the target will be, so far from it."""

    def __init__(
        self,
        scenario: Any,
        scans: int = 8,
        ahead_s: float = 240.0,
        install_s: float = 320.0,
        installer: Policy | None = None,
    ):
        self._installer = installer
        self._scenario, self._tracker = scenario, scenario.make_tracker()
        whole = scenario.steps * scenario.step_s
        self._scans, self._ahead_s = scans, ahead_s
        self._install_s = install_s if scenario.carrier == "airborne" else whole

    def reset(self, belief: MobileBelief) -> None:
        """Nothing to remember, except what the installer does."""
        if self._installer is not None:
            self._installer.reset(belief)

    def act(self, belief: MobileBelief, observation: np.ndarray) -> np.ndarray:
        """Commands [e, 3 n]."""
        best = np.empty((len(belief.installed), self._scenario.sensors, 3))
        for installed in (False, True):
            rows = np.flatnonzero(belief.installed == installed)
            if len(rows) and not installed and self._installer is not None:
                best[rows] = self._installer.act(belief, observation).reshape(best.shape)[rows]
            elif len(rows):
                best[rows] = self._choose_rows(belief, rows, not installed)
        return best.reshape(len(best), -1)

    def path(self, belief: MobileBelief, time_s: np.ndarray) -> np.ndarray:
        """Expected states [e, k, 6] at times [k] from now."""
        x = tracked(belief)[:, None]
        velocity = np.broadcast_to(x[..., 3:], (len(x), len(time_s), 3))
        return np.concatenate([x[..., :3] + time_s[:, None] * velocity, velocity], axis=-1)

    def _choose_rows(self, belief: MobileBelief, rows: np.ndarray, installing: bool) -> np.ndarray:
        step_s = (self._install_s if installing else self._ahead_s) / self._scans
        path = self.path(belief, step_s * np.arange(1, self._scans + 1))

        def choose(part: slice) -> np.ndarray:
            own = rows[part]
            state = ScanState(*(field[own, 0] for field in belief.track_state))
            task = belief.task.rows(own)
            return self._choose(Moment(task, state, belief.platforms[own], path[own], step_s, installing))

        blocks = Blocks(len(rows), block=BLOCK)
        return np.concatenate(blocks.map(choose, blocks.slices))

    def _choose(self, now: Moment) -> np.ndarray:
        """Commands [e, n, 3] of a block."""
        n, here = self._scenario.sensors, now.platforms[..., :3]
        chosen = layout_commands(even, now.task, n) if now.installing else commands_of(here, now.task)
        for i in [*range(n)] * (2 if now.installing else 1):
            offered = np.concatenate([chosen[:, i, None], self._offer(now, here[:, i])], axis=1)
            trial = np.broadcast_to(chosen[:, None], (*offered.shape[:2], n, 3)).copy()
            trial[:, :, i] = offered
            best = self._promise(now, trial).argmin(axis=1)
            chosen[:, i] = offered[np.arange(len(best)), best]
        return chosen

    def _promise(self, now: Moment, trial: np.ndarray) -> np.ndarray:
        """Log standard deviations of the position, averaged over scans, [e, c] of commands [e, c, n, 3]."""
        s = self._scenario
        places = routes(
            now.platforms[:, None], positions(trial, now.task), now.installing, s.speed_m_s, s.climb_m_s, now.step_s,
            np.empty(self._scans),
        )  # fmt: skip
        layout = Layout(places, accuracies(now.task, s.sensors)[:, None], s.ranging)
        promised = self._tracker.promise(_spread(now.state, 1), now.path[:, None], layout, now.step_s)
        return np.log(promised.position_std_m).mean(-1)

    def _offer(self, now: Moment, here: np.ndarray) -> np.ndarray:
        """Commands [e, c, 3] of places to install a sensor at, or for a carrier at `here` [e, 3] to go to."""
        if now.installing:
            return np.broadcast_to(PLACES, (len(here), *PLACES.shape))
        s, half = self._scenario, now.path[:, len(now.path[0]) // 2, :2]
        angle = 2.0 * math.pi * np.arange(self.BEARINGS) / self.BEARINGS
        way = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
        about = [here[:, None, :2] + s.speed_m_s * self._ahead_s * way]
        about += [half[:, None] + radius * way for radius in self.RADII_M]
        level = np.concatenate(about, axis=1)[:, None]
        height = here[:, 2, None] + s.climb_m_s * self._ahead_s * np.array([0.0, 1.0, -1.0])
        height = np.clip(height, 0.0, now.task.height_limit_m[:, None])[..., None, None]
        e, _, c, _ = level.shape
        place = np.concatenate(
            [np.broadcast_to(level, (e, 3, c, 2)), np.broadcast_to(height, (e, 3, c, 1))], axis=-1
        )  # fmt: skip
        return commands_of(place.reshape(e, -1, 3), now.task)


_AXES = (np.linspace(-1.0, 1.0, 17), (-1.0, -0.7, -0.4, 0.0, 0.5), (-1.0, 0.0, 1.0))
PLACES = np.stack(np.meshgrid(*_AXES, indexing="ij"), axis=-1).reshape(-1, 3)
"""Commands [c, 3] among which sensors are installed."""


class Oracle(Greedy):
    """Greedy that knows the target's true course: what knowing it would be worth."""

    needs_world = True
    _world: World

    def see(self, world: World) -> None:
        """Look at the truth."""
        self._world = world

    def path(self, belief: MobileBelief, time_s: np.ndarray) -> np.ndarray:
        """True states [e, k, 6] at the instants nearest to times [k] from now; after the episode's end straight on."""
        targets, T = self._world.tape.targets[:, :, 0], self._scenario.step_s
        step = self._world.step[:, None] + np.rint(time_s / T).astype(int)
        last = np.minimum(step, targets.shape[1] - 1)
        x = targets[np.arange(len(targets))[:, None], last]
        x[..., :3] += (T * (step - last))[..., None] * x[..., 3:]
        return x


def _static(rule: Rule) -> Callable[[Any, int], Policy]:
    return lambda scenario, seed: Static(rule, scenario.sensors)


MOBILE: dict[str, Callable[[Any, int], Policy]] = {
    "paper": _static(spaced(20.0)),
    "even": _static(even),
    "tripod": _static(static_tripod),
    "rule_static": lambda scenario, seed: BestStaticRule(scenario),
    "optimizer": lambda scenario, seed: BestStatic(scenario, seed),
    "rule": lambda scenario, seed: Formation(scenario),
    "greedy": lambda scenario, seed: Greedy(scenario),
    "greedy_after_rule": lambda scenario, seed: Greedy(scenario, installer=Formation(scenario)),
    "greedy_after_optimizer": lambda scenario, seed: Greedy(scenario, installer=BestStatic(scenario, seed)),
    "oracle": lambda scenario, seed: Oracle(scenario),
}
"""Makers (scenario, seed) of what installs sensors and moves them."""
