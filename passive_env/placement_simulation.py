"""Episodes of another kind: one sensor placed per step, the whole track run in the last one by a single call.

`PlacementSimulation` stands where `passive_env.core.Simulation` does and gives the same `World`: platforms are the
sensors, the estimate is what is known of the target's state at the last scan.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from passive_env.core import Simulation, World
from passive_env.metrics import FARTHEST_M, MAX_NEES, Violations, at_most
from passive_env.placement import PlacementBelief, Task, course_prior, positions
from passive_env.rewards import Moment, evaluate
from trackers.compiled import kernel
from trackers.consistency import nees
from trackers.converted_measurement import Layout
from trackers.gaussian import Gaussian


class PlacementTape(NamedTuple):
    """Randomness of whole episodes; e environments, k scans, n sensors.

    Attributes:
        platforms: [e, n, 6] where sensors are before they are placed: at the site.
        targets: [e, k, 1, 6] true states.
        noise: [e, k, n, 3] standard normal noise of range, azimuth and elevation.
        discs: [e, 0, 3] there are no no-go discs.
        task: what is known.
    """

    platforms: Any
    targets: Any
    noise: Any
    discs: Any
    task: Task


class PlacementMetrics(NamedTuple):
    """Figures of merit, each [e, 1]; until the track has been run they are those of what is expected of the course.

    Attributes:
        range_error_m: |estimated − true range| from the first sensor, mean over the scans that are scored [m].
        position_error_m: distance of the estimate from the target, mean over the scans that are scored [m].
        range_m: true range from the first sensor at the last scan [m].
        range_crlb_m: standard deviation of the range at the last scan that the sensors placed so far promise [m].
        nees: normalised estimation error squared at the last scan (6 degrees of freedom).
        lost: far off without knowing it.
        position_crlb_m: standard deviation of the position at the last scan that the sensors placed so far promise
            along the true course (root of the trace) [m].
        track_error_m: `position_error_m` over all scans.
    """

    range_error_m: Any
    position_error_m: Any
    range_m: Any
    range_crlb_m: Any
    nees: Any
    lost: Any
    position_crlb_m: Any
    track_error_m: Any


class History(NamedTuple):
    """The track scan by scan, each [e, k]; 0 until there is something to tell.

    Attributes:
        range_error_m, position_error_m: as of `PlacementMetrics`.
        position_crlb_m: of the sensors placed so far.
        position: [e, k, 3] m, estimates.
    """

    range_error_m: Any
    position_error_m: Any
    position_crlb_m: Any
    position: Any


class PlacementSimulation(Simulation):
    """A placement scenario's parts, put together once; holds no state of any episode."""

    def __init__(self, scenario: Any):
        self.scenario = scenario
        self.tracker = scenario.make_tracker()
        self.actions = scenario.make_actions()
        self.observation = scenario.make_observation()

    def begin(self, generators: Sequence[np.random.Generator]) -> World:
        """Draw a tape per generator; nothing is placed yet."""
        s = self.scenario
        tape = s.draw_tape(generators)
        batch, scans = tape.noise.shape[:2]
        prior = course_prior(tape.task, scans, s.step_s, s.process_noise_m_s2)
        estimate = Gaussian(prior.mean[:, None], prior.cov[:, None])
        truth, errors = tape.targets[:, -1], np.zeros((batch, scans))
        history = History(errors, errors.copy(), errors.copy(), np.zeros((batch, scans, 3)))
        metrics = self._expected(estimate, truth, tape.platforms)
        return World(
            np.zeros(batch, dtype=np.int64), tape.platforms, tape, (), estimate, history, np.zeros((batch, 3)),
            prior.cov, truth, metrics, _none(batch),
        )  # fmt: skip

    def advance(self, world: World, command: Any) -> tuple[World, Any, dict[str, Any]]:
        """Place a sensor in every episode; those that have none left run their track and are scored."""
        rows = np.arange(len(command))
        platforms = world.platforms.copy()
        platforms[rows, world.step, :3] = positions(command, world.tape.task)
        placed = world._replace(step=world.step + 1, platforms=platforms, last_action=command)
        new = self._run(self._promise(placed))
        moment = Moment(new.metrics, world.metrics, new.violations, command, self.finished(new))
        reward, terms = evaluate(self.scenario.reward_weights, moment)
        return new, reward, terms

    def belief(self, world: World) -> Any:
        """What an operator knows of the world."""
        return PlacementBelief(
            self.scenario.steps - world.step, world.platforms, world.estimate.mean, world.estimate.cov,
            world.last_action, world.tape.task,
        )  # fmt: skip

    def info(self, world: World) -> dict[str, Any]:
        """What `info` shows besides the reward's terms, each [e, …]; truth is used here."""
        depths = {f"{name}_violation": depth for name, depth in world.violations._asdict().items()}
        return world.metrics._asdict() | depths

    def history(self, world: World) -> dict[str, Any]:
        """Figures of finished episodes scan by scan, each [e, k, 1]; of the range's bound the last only, [e, 1, 1]."""
        told = world.reports
        by_scan = {name: getattr(told, name)[..., None] for name in History._fields if name != "position"}
        return by_scan | {"range_crlb_m": world.metrics.range_crlb_m[:, None]}

    def layout(self, positions_m: Any, task: Task) -> Layout:
        """Sensors at positions [e, ..., n, 3] m with a task's accuracies."""
        n, lead = np.shape(positions_m)[-2], (1,) * (np.ndim(positions_m) - 2)
        std = np.broadcast_to(task.std.reshape(-1, *lead, 3), (len(task.std), *lead[1:], n, 3))
        return Layout(positions_m, std, self.scenario.ranging[:n])

    def _promise(self, world: World) -> World:
        """The world with what the sensors placed so far promise along the true course."""
        cov, by_scan = np.array(world.bound), world.reports.position_crlb_m.copy()
        for count in np.unique(world.step):  # at most as many as there are sensors
            rows = np.flatnonzero(world.step == count)
            task = world.tape.task.rows(rows)
            layout = self.layout(world.platforms[rows, :count, :3], task)
            theory = self.tracker.theoretical(world.tape.targets[rows, :, 0], layout)
            cov[rows], by_scan[rows] = theory.cov, theory.position_std_m
        position_std, range_std, distance = _promised(cov[:, None], world.truth, world.platforms[:, :1, :3])
        metrics = world.metrics._replace(position_crlb_m=position_std, range_crlb_m=range_std, range_m=distance)
        reports = world.reports._replace(position_crlb_m=by_scan)
        return world._replace(bound=cov, metrics=metrics, reports=reports)

    def _run(self, world: World) -> World:
        """The world with the track of every episode that has all its sensors."""
        rows = np.flatnonzero(self.finished(world))
        if not len(rows):
            return world
        tape, sensors = world.tape, world.platforms[rows, :, :3]
        path = tape.targets[rows, :, 0]
        layout = self.layout(sensors, tape.task.rows(rows))
        track = self.tracker.track(path, layout, tape.noise[rows])
        estimate, history, metrics = (_copied(part) for part in (world.estimate, world.reports, world.metrics))
        estimate.mean[rows, 0], estimate.cov[rows, 0] = track.mean[:, -1], track.cov[:, -1]
        judged = _judge(track.mean, path, sensors[:, 0], self.scenario.scored_scans)
        history.range_error_m[rows], history.position_error_m[rows] = judged[:2]
        history.position[rows] = track.mean[..., :3]
        for figure, values in zip(("range_error_m", "position_error_m", "track_error_m"), judged[2:], strict=True):
            getattr(metrics, figure)[rows, 0] = values
        metrics.nees[rows, 0] = _cut(nees(track.mean[:, -1], track.cov[:, -1], path[:, -1]), MAX_NEES)
        return world._replace(estimate=estimate, reports=history, metrics=self._judged(metrics))

    def _expected(self, estimate: Gaussian, truth: Any, platforms: Any) -> PlacementMetrics:
        """Figures of what is expected of the course before anything is placed."""
        first = platforms[:, :1, :3]
        *_, range_error, error, _ = _judge(estimate.mean, truth, first[:, 0], 1)
        position_std, range_std, distance = _promised(estimate.cov, truth, first)
        metrics = PlacementMetrics(
            range_error[:, None], error[:, None], distance, range_std,
            _cut(nees(estimate.mean, estimate.cov, truth), MAX_NEES), np.zeros(distance.shape, dtype=bool),
            position_std, error[:, None].copy(),
        )  # fmt: skip
        return self._judged(metrics)

    def _judged(self, metrics: PlacementMetrics) -> PlacementMetrics:
        s = self.scenario
        return metrics._replace(lost=(metrics.position_error_m > s.lost_error_m) & (metrics.nees > s.lost_nees))


def _none(batch: int) -> Violations:
    return Violations(np.zeros(batch), np.zeros(batch))


def _copied(parts: Any) -> Any:
    return type(parts)(*(np.array(part) for part in parts))


def _cut(value: Any, most: float) -> Any:
    """The lesser of both; the limit for NaN."""
    return np.where(value <= most, value, most)


# NumPy may add up a batch's rows in another order than a single one's; compiled sums are the same bit for bit.


@kernel("(k,x6),(k,x6),(p3),()->(k),(k),(),(),()", "FFFiFFfff")
def _judge(mean, path, sensor, late, range_error, position_error, scored_range, scored_position, track):
    """Errors of every scan, their means over the last `late` scans, and over all."""
    k = mean.shape[0]
    scored_range[0] = scored_position[0] = track[0] = 0.0
    for t in range(k):
        miss = estimated = true = 0.0
        for i in range(3):
            miss += (mean[t, i] - path[t, i]) ** 2
            estimated += (mean[t, i] - sensor[i]) ** 2
            true += (path[t, i] - sensor[i]) ** 2
        range_error[t] = at_most(abs(math.sqrt(estimated) - math.sqrt(true)), FARTHEST_M)
        position_error[t] = at_most(math.sqrt(miss), FARTHEST_M)
        track[0] += position_error[t] / k
        if t >= k - late:
            scored_range[0] += range_error[t] / late
            scored_position[0] += position_error[t] / late


@kernel("(x6,x6),(x6),(p3)->(),(),()", "FFFfff")
def _promised(cov, truth, sensor, position_std, range_std, distance):
    """√(p₁₁ + p₂₂ + p₃₃), the standard deviation along the sensor's line of sight, and the range."""
    squared = along = 0.0
    for i in range(3):
        squared += (truth[i] - sensor[i]) ** 2
        for j in range(3):
            along += (truth[i] - sensor[i]) * cov[i, j] * (truth[j] - sensor[j])
    distance[0] = math.sqrt(squared)
    range_std[0] = math.sqrt(along / squared)
    position_std[0] = math.sqrt(cov[0, 0] + cov[1, 1] + cov[2, 2])
