"""Trackers on recorded measurements: the loop of `passive_env.core` with a file in place of the world.

    recorded instant → time passes (predict) → recorded scan → update → estimate, belief

Nobody knows the truth here: worlds hold zeros in its place, and figures of merit there are none. What a policy may see,
the belief and its observation, is made by the scenario's own parts.

Process noise and the switching of models count per step. So time that passes between two instants is cut into as many
equal parts as come nearest to the scenario's step; every part but the last ends with a scan that nobody received, just
as in an environment in which all stations missed it. Where parts are not a step long, noise and transition matrix are
scaled to their length (`paced`).
"""

from __future__ import annotations

import dataclasses
from abc import ABC, abstractmethod
from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np

from passive_env.angle_sensors import CLEAN_DENSITY, AngleSighting
from passive_env.core import World, check_estimate, map_rows
from passive_env.maneuver_sensors import ManeuverSighting
from passive_env.metrics import Violations
from passive_env.radar_sensors import coarse_guess, stack_scans
from passive_env.recording import Recording, SumRecording
from passive_env.sensors import Sighting
from passive_env.steering import course
from trackers.adaptive_rp_ekf import AdaptiveRpEkf, ModelBank
from trackers.angle_contract import AngleScan
from trackers.angle_filter import AngleFilter
from trackers.angles import circular_mean, wrap
from trackers.contract import Scan
from trackers.fix_contract import BearingScan
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


def _turned(before: np.ndarray, after: np.ndarray, rate: float, time_s: float) -> np.ndarray:
    """Turn commands [1, s] flown between two states, as shares of the largest rate [rad/s]."""
    if rate == 0.0:
        return np.zeros(after.shape[:2])
    return np.clip(wrap(course(after) - course(before)) / (rate * time_s), -1.0, 1.0)


def _rows_used(nis: Any, degrees: Any, log_likelihood: Any, used: Any) -> Fit:
    """A fit of one episode's arrays [1, m, …]."""
    return Fit(nis[0], np.asarray(degrees)[0], np.asarray(log_likelihood)[0], used[0])


class BearingPlayback(Playback):
    """Unlabelled bearings; the last station is the reference, and its first bearings start the tracks."""

    def __init__(self, scenario: Any, recording: Recording):
        if len(recording.stations) > 2:
            raise ValueError(
                f"{recording.source}: has {len(recording.stations)} stations, {', '.join(recording.stations)}; the "
                "bank weighs bearings of one or two: leave stations out"
            )
        super().__init__(scenario, recording)
        self._std = scan_std(scenario, recording)

    def begin(self) -> tuple[int, World]:
        """Tracks in the order of the reference's bearings, counter-clockwise about their middle."""
        index = first_scan(self.recording)
        scan = _counter_clockwise(self._scan_at(index, True))
        tracks = int(scan.valid[0, -1].sum())
        state = self.tracker.initiate(scan)
        state = map_rows(lambda part: np.ascontiguousarray(part[:, :tracks]), state)
        estimate = self.tracker.estimate(state)
        reports = self.sensors.acquired(
            Sighting(_cut(scan, tracks), np.zeros_like(estimate.mean), np.full(scan.valid.shape, -1)), state
        )
        return index, self._world(index, state, estimate, reports)

    def sighting(self, index: int, world: World, predicted: Any, heard: bool) -> Sighting:
        """The bearings of an instant."""
        return Sighting(self._scan_at(index, heard), world.truth, None)

    def flown(self, before: np.ndarray, after: np.ndarray, time_s: float) -> np.ndarray:
        """Turns of all stations."""
        return _turned(before, after, np.radians(self.scenario.max_turn_rate_deg_s), time_s)

    def maneuver(self, command: np.ndarray) -> dict[str, float | str]:
        """Turns of all stations."""
        return self.turns(command)

    def fit(self, scan: Scan, update: Any) -> Fit:
        """Stations count one by one, as they are used."""
        used = update.assignment >= 0
        nis = np.where(used, np.square(update.innovation) / update.innovation_var, 0.0).sum(-1)
        stations = len(self.recording.stations)
        told = np.concatenate([np.zeros((*used.shape[:2], stations - used.shape[2]), dtype=bool), used], axis=-1)
        return _rows_used(nis, used.sum(-1), update.log_likelihood, told)

    def weights(self, state: Any) -> tuple[np.ndarray, np.ndarray]:
        """Of range hypotheses, and of the motion models of an adaptive bank."""
        weight = np.exp(state.log_weights)[0]
        if isinstance(state, ModelBank):
            return weight.sum(-1), weight.sum(-2)
        return weight, np.empty((len(weight), 0))

    def _scan_at(self, index: int, heard: bool) -> Scan:
        r = self.recording
        valid = r.valid[None, index] & heard
        bearings = np.where(valid, r.angles[None, index, ..., 0], 0.0)
        return Scan(bearings, valid, r.platforms[None, index, :, :2], self._std[index])


class AnglePlayback(Playback):
    """Azimuths and elevations of one target, perhaps among false returns; ranges count from the first platform."""

    def __init__(self, scenario: Any, recording: Recording):
        super().__init__(scenario, recording)
        told = np.radians([scenario.azimuth_std_deg, scenario.elevation_std_deg])
        self._std = np.where(np.isnan(recording.std), told, recording.std)
        density = recording.clutter_density
        self._density = np.where(np.isnan(density), self._usual_density(), density)

    def _usual_density(self) -> float:
        """False returns per rad² where the file does not tell; 0: unknown, the returns in a gate are counted."""
        s = self.scenario
        if s.clutter_density_per_deg2 > 0.0 and s.clutter_known:
            return s.clutter_density_per_deg2 * (180.0 / np.pi) ** 2
        clean = s.clutter_mean == 0.0 and s.clutter_density_per_deg2 == 0.0 and self.recording.valid.shape[-1] == 1
        return CLEAN_DENSITY if clean else 0.0

    def begin(self) -> tuple[int, World]:
        """The track starts at the first return with azimuth and elevation."""
        r = self.recording
        ready = np.flatnonzero((r.valid.any(-1) & r.available.all(-1)).any(-1))
        if not len(ready):
            raise ValueError(f"{r.source}: has no return with azimuth and elevation, a track starts from one")
        index = int(ready[0])
        scan = self._scan_at(index, True)
        state = self.tracker.initiate(scan)
        estimate = self.tracker.estimate(state)
        nothing = Gaussian(np.zeros_like(estimate.mean), np.zeros_like(estimate.cov))
        reports = self.sensors.acquired(AngleSighting(scan, nothing.mean, None, nothing), state)
        return index, self._world(index, state, estimate, reports)

    def sighting(self, index: int, world: World, predicted: Any, heard: bool) -> AngleSighting:
        """The returns of an instant."""
        return AngleSighting(self._scan_at(index, heard), world.truth, None, self.tracker.estimate(predicted))

    def flown(self, before: np.ndarray, after: np.ndarray, time_s: float) -> np.ndarray:
        """Turns of all platforms, then climbs."""
        turns = _turned(before, after, np.radians(self.scenario.max_turn_rate_deg_s), time_s)
        climbs = (after[..., 2] - before[..., 2]) / (time_s * max(self.scenario.max_climb_m_s, 1e-9))
        return np.concatenate([turns, np.clip(climbs, -1.0, 1.0)], axis=-1)

    def maneuver(self, command: np.ndarray) -> dict[str, float | str]:
        """Turns of all platforms, then climbs."""
        names = self.recording.stations
        climbs = self.scenario.max_climb_m_s * command[len(names) :]
        return self.turns(command) | {
            f"climb_{name}_m_s": float(climb) for name, climb in zip(names, climbs, strict=True)
        }

    def fit(self, scan: AngleScan, update: Any) -> Fit:
        """The sum of the sensors' own, of averaged innovations; that sensors share the track's error is left out."""
        used = update.assignment >= 0
        counted = used[..., None] & scan.available[:, None]
        nu = np.where(counted, update.innovation, 0.0)
        S = np.where(counted[..., None] & counted[..., None, :], update.innovation_cov, np.eye(2))
        nis = (nu * np.linalg.solve(S, nu[..., None])[..., 0]).sum((-2, -1))
        return _rows_used(nis, counted.sum((-2, -1)), update.log_likelihood, used)

    def _scan_at(self, index: int, heard: bool) -> AngleScan:
        r = self.recording
        valid, available = r.valid[None, index] & heard, r.available[None, index] & heard
        angles = np.where(valid[..., None], r.angles[None, index], 0.0)
        places = np.ascontiguousarray(r.platforms[None, index, :, :3])
        return AngleScan(angles, valid, places, self._std[None, index], available, self._density[None, index])


class FixPlayback(Playback):
    """One target's bearings from stations whose lines of sight cross; the last station is the reference."""

    def __init__(self, scenario: Any, recording: Recording):
        super().__init__(scenario, recording)
        std = recording.std[..., 0]
        self._std = np.where(np.isnan(std), 1e-3 * scenario.azimuth_std_mrad, std)

    def begin(self) -> tuple[int, World]:
        """The track starts at the first bearing."""
        index = first_scan(self.recording, reference_only=False)
        scan = self._scan_at(index, True)
        state = self.tracker.initiate(scan)
        estimate = self.tracker.estimate(state)
        reports = self.sensors.acquired(self._told(scan, estimate.mean), state)
        return index, self._world(index, state, estimate, reports)

    def sighting(self, index: int, world: World, predicted: Any, heard: bool) -> ManeuverSighting:
        """The bearings of an instant."""
        return self._told(self._scan_at(index, heard), world.truth)

    def flown(self, before: np.ndarray, after: np.ndarray, time_s: float) -> np.ndarray:
        """Turns of all stations, then their speeds."""
        s = self.scenario
        turns = _turned(before, after, np.radians(s.max_turn_rate_deg_s), time_s)
        room = max(s.top_speed_m_s - s.min_speed_m_s, 1e-9)
        share = (np.hypot(after[..., 2], after[..., 3]) - s.min_speed_m_s) / room
        return np.concatenate([turns, np.clip(2.0 * share - 1.0, -1.0, 1.0)], axis=-1)

    def maneuver(self, command: np.ndarray) -> dict[str, float | str]:
        """Turns of all stations, then their speeds."""
        s, names = self.scenario, self.recording.stations
        speeds = s.min_speed_m_s + (s.top_speed_m_s - s.min_speed_m_s) * 0.5 * (command[len(names) :] + 1.0)
        return self.turns(command) | {
            f"speed_{name}_m_s": float(speed) for name, speed in zip(names, speeds, strict=True)
        }

    def fit(self, scan: BearingScan, update: Any) -> Fit:
        """Of the fix, which has two coordinates."""
        fixed = update.fixed
        whitened = np.linalg.solve(update.innovation_cov, update.innovation[..., None])[..., 0]
        nis = np.where(fixed, (update.innovation * whitened).sum(-1), 0.0)
        used = fixed[..., None] & scan.valid[:, None]
        return _rows_used(nis, np.where(fixed, 2, 0), update.log_likelihood, used)

    def weights(self, state: Any) -> tuple[np.ndarray, np.ndarray]:
        """Probabilities of the filters."""
        return np.empty((1, 0)), state.probability[0]

    def _told(self, scan: BearingScan, mean: np.ndarray) -> ManeuverSighting:
        return ManeuverSighting(scan, np.zeros_like(mean), np.zeros((*mean.shape[:2], 2)))

    def _scan_at(self, index: int, heard: bool) -> BearingScan:
        r = self.recording
        valid = r.valid[None, index, :, 0] & heard
        bearings = np.where(valid, r.angles[None, index, :, 0, 0], 0.0)
        return BearingScan(bearings, valid, r.platforms[None, index, :, :2], self._std[None, index])


class SumPlayback(Playback):
    """Range sums of one target; the track starts from several scans and an operator's guess.

    Args:
        scenario, recording: as of `Playback`.
        guess: [2d] m, m/s, state at the first scan, its errors those of the scenario's fields.
    """

    def __init__(self, scenario: Any, recording: SumRecording, guess: np.ndarray):
        scans = len(recording.time_s)
        if scans < scenario.acquisition_scans:
            raise ValueError(
                f"{recording.source}: has {scans} scans, a track starts from acquisition_scans = "
                f"{scenario.acquisition_scans}: take fewer of them, 'acquisition_scans={scans}' among the fields"
            )
        super().__init__(scenario, recording)
        self._guess = coarse_guess(np.asarray(guess, dtype=float)[None], scenario.guess_std)
        self._sites = np.ascontiguousarray(recording.transmitters[None])

    def begin(self) -> tuple[int, World]:
        """The track starts at the last of the scenario's acquisition scans."""
        last = self.scenario.acquisition_scans - 1
        times = self.recording.time_s[: last + 1] - self.recording.time_s[0]
        sightings = self._acquire(self._guess.mean, times)
        state = self.tracker.initiate(stack_scans(sightings), self._guess, times)
        if self.scenario.std_range_m > 0.0:  # noise goes with the ranges: told anew for the track found
            found = self.tracker.estimate(state).mean[:, 0].copy()
            d = found.shape[1] // 2
            found[:, :d] -= times[-1] * found[:, d:]
            sightings = self._acquire(found, times)
            state = self.tracker.initiate(stack_scans(sightings), self._guess, times)
        reports = self.sensors.acquired(sightings)
        return last, self._world(last, state, self.tracker.estimate(state), reports, self._sites)

    def sighting(self, index: int, world: World, predicted: Any, heard: bool) -> Any:
        """The echoes of an instant, and what they tell of the transmitters."""
        mean = self.tracker.estimate(predicted).mean
        return self._told(index, world.reports.listening, mean, heard, tuned=False)

    def flown(self, before: np.ndarray, after: np.ndarray, time_s: float) -> np.ndarray:
        """The receiver's turn, where it moves; whom it listens to is known without."""
        command = np.zeros((1, self.simulation.actions.size))
        if self.scenario.moves:
            command[:, :1] = _turned(before, after, np.radians(self.scenario.max_turn_rate_deg_s), time_s)
        return command

    def maneuver(self, command: np.ndarray) -> dict[str, float | str]:
        """Whom to listen to, and the receiver's turn, where it moves."""
        scores = command[-len(self.recording.names) :]
        highest = np.sort(np.argsort(-scores, kind="stable")[: self.scenario.listened])
        listen: dict[str, float | str] = {"listen": " ".join(self.recording.names[n] for n in highest)}
        return (self.turns(command) if self.scenario.moves else {}) | listen

    def fit(self, scan: Any, update: Any) -> Fit:
        """The statistic of the maneuver test."""
        used = update.used
        likelihood = update.log_likelihood[:, None]
        return _rows_used(update.statistic[:, None], used.sum(-1)[:, None], likelihood, used[:, None])

    def _acquire(self, expected: np.ndarray, times: np.ndarray) -> list[Any]:
        """The first scans, standard deviations told for a target's state [1, 2d] at the first of them."""
        known, sightings, d = self.sensors.nothing_known(1, len(self.recording.names)), [], expected.shape[1] // 2
        for index, time_s in enumerate(times):
            place = expected.copy()
            place[:, :d] += place[:, d:] * time_s
            sightings.append(self._told(index, known, place[:, None], heard=True, tuned=True))
            known = sightings[-1].listening
        sightings[-1] = sightings[-1]._replace(listening=self.sensors.settled(known))
        return sightings

    def _told(self, index: int, known: Any, mean: np.ndarray, heard: bool, tuned: bool) -> Any:
        r = self.recording
        listened, answered = r.listened[None, index] & heard, r.answered[None, index] & heard
        sighting = self.sensors.recorded(answered, listened, known, r.platforms[None, index], self._sites, mean, tuned)
        std = np.where(np.isnan(r.std[None, index]), sighting.scan.std, r.std[None, index])
        sums = np.where(answered, r.range_sums[None, index], 0.0)
        return sighting._replace(scan=sighting.scan._replace(range_sums=sums, valid=answered, std=std))


# -- first scans -------------------------------------------------------------------------------------------------------


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


def scan_std(scenario: Any, recording: Recording) -> np.ndarray:
    """[k] rad, the bearings' standard deviation in every scan.

    Raises:
        ValueError: stations that differ in it, which the bank does not take.
    """
    std = np.where(np.isnan(recording.std[..., 0]), np.radians(scenario.bearing_std_deg), recording.std[..., 0])
    shown = recording.valid.any(-1)
    highest = np.where(shown, std, -np.inf).max(-1)
    apart = np.flatnonzero(highest > np.where(shown, std, np.inf).min(-1))
    if len(apart):
        raise ValueError(
            f"{recording.source}: at {recording.time_s[apart[0]]:g} s stations differ in their bearings' standard "
            "deviation; the bank takes one for all: give the larger one to both"
        )
    return np.where(shown.any(-1), highest, np.radians(scenario.bearing_std_deg))


def _counter_clockwise(scan: Scan) -> Scan:
    """A scan of one episode with every station's returns in order about their mean direction, and no empty slots."""
    bearings, valid = np.zeros_like(scan.bearings), np.zeros_like(scan.valid)
    for s in range(bearings.shape[1]):
        own = scan.bearings[0, s][scan.valid[0, s]]
        own = own[np.argsort(wrap(own - circular_mean(own)), kind="stable")] if len(own) else own
        bearings[0, s, : len(own)], valid[0, s, : len(own)] = own, True
    return _cut(Scan(bearings, valid, scan.stations, scan.bearing_std), int(valid.sum(-1).max()))


def _cut(scan: Scan, slots: int) -> Scan:
    """The first slots of a scan."""
    return scan._replace(
        bearings=np.ascontiguousarray(scan.bearings[..., :slots]), valid=np.ascontiguousarray(scan.valid[..., :slots])
    )
