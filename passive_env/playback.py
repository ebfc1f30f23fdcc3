"""Trackers on recorded measurements: the loop of `passive_env.core` with a file in place of the world.

    recorded instant → time passes (predict) → recorded scan → update → estimate, belief

Nobody knows the truth here: worlds hold zeros in its place, and figures of merit there are none. What a policy may see,
the belief and its observation, is made by the scenario's own parts.

Process noise and the switching of models count per step. So time that passes between two instants is cut into as many
equal parts as come nearest to the scenario's step; every part but the last ends with a scan that nobody received, just
as in an environment in which all stations missed it. Where parts are not a step long, noise and transition matrix are
scaled to their length (`paced`).

What differs from family to family, how scans are read and tracks started, stands in `passive_env.playback_bearings`,
`playback_angles`, `playback_fixes` and `playback_sums`.
"""

from __future__ import annotations

import dataclasses
from abc import ABC, abstractmethod
from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np

from passive_env.core import World, check_estimate
from passive_env.metrics import Violations
from passive_env.recording import Recording
from passive_env.steering import course
from trackers.adaptive_rp_ekf import AdaptiveRpEkf
from trackers.angle_filter import AngleFilter
from trackers.angles import wrap
from trackers.gaussian import Gaussian
from trackers.imm import Imm3
from trackers.imm_mie import ImmMie
from trackers.range_sum_ekf import RangeSumEkf
from trackers.rp_ekf import RpEkf

MOST_PARTS = 10_000
"""Largest number of steps between two scans; a track that coasts longer means nothing."""

SAME_STEP = 1e-6
"""Share of a step by which a time between two scans may differ and still counts as a step."""


class RecordedTape(NamedTuple):
    """What a belief takes from a tape: no-go discs [1, 0, 3], there are none, and transmitters [1, n, d] m."""

    discs: Any
    transmitters: Any = None


class Fit(NamedTuple):
    """How well a scan fits the m tracks' predictions.

    Attributes:
        nis: [m] normalised innovation squared, of χ² with `degrees` [m] degrees of freedom; 0 of 0 for a track that got
            nothing.
        log_likelihood: [m] as the tracker tells.
        used: [m, s] bool, whose measurements updated the track.
    """

    nis: Any
    degrees: Any
    log_likelihood: Any
    used: Any


class Moment(NamedTuple):
    """A recorded instant.

    Attributes:
        index: among the recording's instants.
        world: of one episode, its truth unknown.
        fit: of the scan; None where the tracks start.
        weights: [m, n] of a bank's hypotheses; n is 0 where there are none.
        models: [m, r] probabilities of motion models; r is 0 where there are none.
    """

    index: int
    world: World
    fit: Fit | None
    weights: Any
    models: Any


def paced(tracker: Any, share: float) -> Any:
    """A named tracker for predictions over a share of the step that its settings are meant for.

    Variances grow with time: velocity increments per step with its root, accelerations held over a step with the
    inverse root; Π becomes Π^share. An estimator's windows stay so many scans.
    """
    if abs(share - 1.0) <= SAME_STEP:
        return tracker
    root = share**0.5
    changes: dict[str, Any] = {}
    if isinstance(tracker, RpEkf):
        changes["process_noise"] = tracker.process_noise * root
    if isinstance(tracker, AdaptiveRpEkf):
        changes |= {"maneuver_noise": tracker.maneuver_noise * root, "transition": _power(tracker.transition, share)}
    if isinstance(tracker, AngleFilter):
        changes["process_noise"] = tracker.process_noise / root
    if isinstance(tracker, RangeSumEkf):
        changes["process_noise"] = tuple(w / share for w in tracker.process_noise)
    if isinstance(tracker, ImmMie):
        changes |= {
            "acceleration_std": tracker.acceleration_std / root, "transition": _power(tracker.transition, share),
        }  # fmt: skip
    if isinstance(tracker, Imm3):
        velocity, *increments = tracker.noise_std
        changes |= {
            "noise_std": (velocity / root, *(q * root for q in increments)),
            "transition": _power(tracker.transition, share),
        }
    return dataclasses.replace(tracker, **changes)


def _power(transition: Any, share: float) -> tuple[tuple[float, ...], ...]:
    """Π^share of a stochastic matrix, by its eigenvalues; what rounding or a root makes negative is cut."""
    values, vectors = np.linalg.eig(np.array(transition, dtype=float))
    power = (vectors * np.maximum(np.real(values), 0.0) ** share) @ np.linalg.inv(vectors)
    power = np.maximum(np.real(power), 0.0)
    return tuple(tuple(float(p) for p in row / row.sum()) for row in power)


class Playback(ABC):
    """A tracker's way through a recording; holds no state of it.

    Args:
        scenario: whose tracker, sensors and belief are used; its step is what the tracker's noise is meant for.
        recording: what was measured.
    Raises:
        ValueError: a recording that the tracker cannot start from, or that the scenario does not fit.
    """

    def __init__(self, scenario: Any, recording: Any):
        if scenario.discs:
            raise ValueError("no-go discs are not part of a recording: leave them out of the fields")
        self.scenario, self.recording = scenario, recording
        self._check_gaps()
        self.simulation = scenario.make_simulation()
        self.tracker, self.sensors = self.simulation.tracker, self.simulation.sensors
        self._paces: dict[float, Any] = {}

    def _check_gaps(self) -> None:
        """Refuse times without a scan that are longer than a track lasts."""
        times, longest = self.recording.time_s, MOST_PARTS * self.scenario.step_s
        long = np.flatnonzero(np.diff(times) > longest)
        if len(long):
            since, until = times[long[0]], times[long[0] + 1]
            raise ValueError(
                f"{self.recording.source}: nothing from {since:g} s to {until:g} s, {MOST_PARTS} steps of "
                f"{self.scenario.step_s:g} s at most can be bridged; split the file there"
            )

    # -- what a family supplies ----------------------------------------------------------------------------------------

    @abstractmethod
    def begin(self) -> tuple[int, World]:
        """Index of the instant at which the tracks start, and the world then."""

    @abstractmethod
    def sighting(self, index: int, world: World, predicted: Any, heard: bool) -> Any:
        """The scan of an instant as the family's sensors tell it; with `heard` False one that nobody received."""

    @abstractmethod
    def flown(self, before: np.ndarray, after: np.ndarray, time_s: float) -> np.ndarray:
        """Commands [1, a] in [−1, 1] that bring platforms [1, s, 2d] from one state to another."""

    @abstractmethod
    def maneuver(self, command: np.ndarray) -> dict[str, float | str]:
        """What commands [a] in [−1, 1] mean, by names with units; turns are positive to the left."""

    @abstractmethod
    def fit(self, scan: Any, update: Any) -> Fit:
        """How well a scan fits, by the tracker's update."""

    def weights(self, state: Any) -> tuple[np.ndarray, np.ndarray]:
        """Weights of hypotheses [m, n] and probabilities of models [m, r] of a tracker's state."""
        tracks = len(self.tracker.estimate(state).mean[0])
        return np.empty((tracks, 0)), np.empty((tracks, 0))

    def turns(self, command: np.ndarray) -> dict[str, float | str]:
        """Turn rates of all stations of commands that begin with them."""
        names = self.recording.stations
        rates = self.scenario.max_turn_rate_deg_s * command[: len(names)]
        return {f"turn_{name}_deg_s": float(rate) for name, rate in zip(names, rates, strict=True)}

    # -- the loop ------------------------------------------------------------------------------------------------------

    def moments(self) -> Iterator[Moment]:
        """All instants from the tracks' start on.

        Raises:
            ValueError: a track that has become no number.
        """
        index, world = self.begin()
        yield Moment(index, self._checked(index, world), None, *self.weights(world.track_state))
        for later in range(index + 1, len(self.recording.time_s)):
            world, fit = self._pass_time(world, later)
            yield Moment(later, self._checked(later, world), fit, *self.weights(world.track_state))

    def belief(self, world: World) -> Any:
        """What an operator knows; at least one decision is left, also when an episode would be over."""
        step = np.minimum(world.step, self.scenario.steps - 1)
        return self.simulation.belief(world._replace(step=step))

    def observe(self, belief: Any) -> np.ndarray:
        """Observations [1, o] of a belief."""
        return self.simulation.observation(belief)

    def parts(self, index: int) -> int:
        """Parts into which the time before an instant is cut; all but the last one are scans that are missing."""
        time_s = float(self.recording.time_s[index] - self.recording.time_s[index - 1])
        return max(1, round(time_s / self.scenario.step_s))

    def _pass_time(self, world: World, index: int) -> tuple[World, Fit]:
        """The world at the next instant, and how well its scan fits."""
        time_s = float(self.recording.time_s[index] - self.recording.time_s[index - 1])
        parts = self.parts(index)
        for _ in range(parts - 1):
            world, _ = self._scan(world, index, time_s / parts, heard=False)
        before = self.recording.platforms[None, index - 1]
        world, fit = self._scan(world, index, time_s / parts, heard=True)
        return world._replace(last_action=self.flown(before, world.platforms, time_s)), fit

    def _scan(self, world: World, index: int, step_s: float, heard: bool) -> tuple[World, Fit]:
        tracker = self._paced(step_s / self.scenario.step_s)
        predicted = tracker.predict(world.track_state, step_s)
        platforms = self.recording.platforms[None, index]
        sighting = self.sighting(index, world, predicted, heard)
        update = tracker.update(predicted, sighting.scan)
        reports = self.sensors.report(sighting, update)
        world = world._replace(
            step=world.step + 1, platforms=platforms, track_state=update.posterior,
            estimate=tracker.estimate(update.posterior), reports=reports,
        )  # fmt: skip
        return world, self.fit(sighting.scan, update)

    def _paced(self, share: float) -> Any:
        if share not in self._paces:
            self._paces[share] = paced(self.tracker, share)
        return self._paces[share]

    def _world(self, index: int, state: Any, estimate: Gaussian, reports: Any, transmitters: Any = None) -> World:
        """The world in which the tracks start."""
        check_estimate(estimate, estimate.mean.shape, self.tracker)
        tape = RecordedTape(np.empty((1, 0, 3)), transmitters)
        platforms = self.recording.platforms[None, index]
        return World(
            np.zeros(1, dtype=np.int64), platforms, tape, state, estimate, reports,
            np.zeros((1, self.simulation.actions.size)), None, np.zeros_like(estimate.mean), None,
            Violations(np.zeros(1), np.zeros(1)), platforms,
        )  # fmt: skip

    def _checked(self, index: int, world: World) -> World:
        if not (np.isfinite(world.estimate.mean).all() and np.isfinite(world.estimate.cov).all()):
            time_s = self.recording.time_s[index]
            raise ValueError(
                f"{self.recording.source}: at {time_s:g} s the track is no number any more; check units and standard "
                "deviations, and that the measurements up to then belong to one target each"
            )
        return world


def turn_commands(before: np.ndarray, after: np.ndarray, rate: float, time_s: float) -> np.ndarray:
    """Turn commands [1, s] flown between two states, as shares of the largest rate [rad/s]."""
    if rate == 0.0:
        return np.zeros(after.shape[:2])
    return np.clip(wrap(course(after) - course(before)) / (rate * time_s), -1.0, 1.0)


def fit_of(nis: Any, degrees: Any, log_likelihood: Any, used: Any) -> Fit:
    """The fit in arrays [1, m, …], `used` [1, m, s], of a batch of one episode."""
    return Fit(nis[0], np.asarray(degrees)[0], np.asarray(log_likelihood)[0], used[0])


def first_scan(recording: Recording, reference_only: bool = True) -> int:
    """Index of the first scan with a return, of the reference station (the last) or of any.

    Raises:
        ValueError: no return at all.
    """
    there = recording.valid[:, -1] if reference_only else recording.valid.any(-1)
    ready = np.flatnonzero(there.any(-1))
    if not len(ready):
        whose = f"station {recording.stations[-1]!r}, the reference," if reference_only else "any station"
        raise ValueError(f"{recording.source}: has no return of {whose} from which a track could start")
    return int(ready[0])
