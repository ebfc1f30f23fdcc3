"""Sections 3.1 to 3.4 of Xu and Wang (2009) simulated: flights, range sums, and the trackers that follow them.

Everything is computed for all runs of all seeds at once; the only Python loop is the one over the scans. Errors of all
trackers of a scenario belong to the same flights and the same noise.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from passive_env.catalogue.passive_radar import PAPER_GUESS, PAPER_TARGET
from passive_env.radar_sites import PAPER_SITES_M
from trackers import Gaussian, RangeSumEkf, RangeSumEkfLiteral, RangeSumScan, RangeSumTrack
from trackers.axis_motion import axis_noise
from trackers.range_sum import range_sum
from trackers.range_sum_start import fixed_damping_step

STD_M = 200.0
STEPS = 600
START_SCANS = 10
"""Scans of the batch start."""

ACCELERATION_VAR = (1.0, 1.0, 0.01)
"""w of the truth and of the filters [(m/s²)²]."""

NO_FLOOR_M = -1e9
"""A floor that turns nothing up: the paper's filter knows no ground."""

PLAIN = RangeSumEkfLiteral(floor_m=NO_FLOOR_M)
"""The paper's filter without its maneuver test."""


class Sites(NamedTuple):
    """Sites at rest: receiver [d] m, transmitters [n, d] m."""

    receiver: np.ndarray
    transmitters: np.ndarray

    def in_plane(self, count: int) -> Sites:
        """The first `count` transmitters in the plane."""
        return Sites(self.receiver[:2], self.transmitters[:count, :2])


def _paper_sites(name: str) -> Sites:
    points = np.array(PAPER_SITES_M[name])
    return Sites(points[0], points[1:])


POOR, GOOD = _paper_sites("paper_poor"), _paper_sites("paper_good")
"""The second: the equilateral triangle the paper's section 3.2 means; it prints T₁ = T₂."""

PAIR = POOR.in_plane(2)
"""Section 3.4: the first two transmitters, in the plane."""

TARGET = np.array(PAPER_TARGET)
PAIR_TARGET = np.array([5e3, 5e3, 100.0, 200.0])
GUESS = np.array(PAPER_GUESS)
PRIOR_STD = np.array([20e3, 20e3, 3e3, 200.0, 200.0, 10.0])
"""What an operator knows, m and m/s: specification, section 4."""

PAIR_GUESSES = {"true": np.array([30e3, 5e3, 0.0, 0.0]), "ghost": np.array([-30e3, -40e3, 0.0, 0.0])}
PAIR_PRIOR_STD = np.array([20e3, 20e3, 200.0, 200.0])

MANEUVER_S = (450, 550)
MANEUVER_M_S2 = (-8.0, 10.0, 0.0)
TURN_G = 3.0
GRAVITY = 9.81


def gaussian(mean, std) -> Gaussian:
    """Independent entries."""
    return Gaussian(np.asarray(mean), np.diag(np.square(std)))


PRIOR = gaussian(GUESS, PRIOR_STD)

PLAIN_STARTS = {
    "20 km, 200 m/s": gaussian(GUESS, PRIOR_STD),
    "1 km, 100 m/s": gaussian(GUESS, [1e3, 1e3, 1e3, 100.0, 100.0, 10.0]),
    "200 m, 10 m/s": gaussian(GUESS, [200.0, 200.0, 200.0, 10.0, 10.0, 10.0]),
}
"""P₀ of the paper's basic filter, which does not print it: specification, section 9."""


# -- flights and range sums -------------------------------------------------------------------------------------------


class Flights(NamedTuple):
    """Runs on the first axis.

    Attributes:
        path: [r, k + 1, 2d] m, m/s, a scan a second.
        errors: [r, k + 1, 3] m, of the range sums.
    """

    path: np.ndarray
    errors: np.ndarray

    def heard(self, sites: Sites) -> RangeSumScan:
        """All range sums [r, k + 1, n]; a path in space stays one if the sites lie in the plane."""
        sums = range_sum(self.path[..., : self.path.shape[-1] // 2], *raised(sites, self.path.shape[-1] // 2))
        sums = sums + self.errors[..., : sums.shape[-1]]
        return RangeSumScan(
            sums, np.ones(sums.shape, bool), sites.transmitters, sites.receiver, np.full(sums.shape[-1], STD_M)
        )


def raised(sites: Sites, d: int) -> Sites:
    """The sites with d coordinates, those missing 0."""
    receiver, transmitters = np.zeros(d), np.zeros((len(sites.transmitters), d))
    receiver[: len(sites.receiver)] = sites.receiver
    transmitters[:, : len(sites.receiver)] = sites.transmitters
    return Sites(receiver, transmitters)


def fly(
    rng: np.random.Generator, start: np.ndarray, runs: int, maneuver: np.ndarray | float = 0.0, steps: int = STEPS
) -> Flights:
    """Paths with the model's random accelerations and a maneuver's [steps, d] m/s²."""
    d = len(start) // 2
    a = rng.standard_normal((runs, steps, d)) * np.sqrt(ACCELERATION_VAR[:d]) + maneuver
    velocity = start[d:] + np.concatenate([np.zeros((runs, 1, d)), a.cumsum(1)], axis=1)
    moved = velocity[:, :-1] + 0.5 * a
    position = start[:d] + np.concatenate([np.zeros((runs, 1, d)), moved.cumsum(1)], axis=1)
    return Flights(np.concatenate([position, velocity], axis=-1), STD_M * rng.standard_normal((runs, steps + 1, 3)))


def paper_maneuver() -> np.ndarray:
    """Section 3.3: one acceleration [k, 3] m/s² for 100 s, at the end of which the target flies 1.08 km/s."""
    a = np.zeros((STEPS, 3))
    a[slice(*MANEUVER_S)] = MANEUVER_M_S2
    return a


def level_turn() -> np.ndarray:
    """A turn by 180° at `TURN_G` g from the maneuver's first second on: accelerations [k, 3] m/s² of the scans."""
    speed = np.hypot(*TARGET[3:5])
    rate = TURN_G * GRAVITY / speed
    turned = np.clip(rate * (np.arange(STEPS + 1) - MANEUVER_S[0]), 0.0, np.pi)
    heading = np.arctan2(TARGET[4], TARGET[3]) + turned
    velocity = np.stack([speed * np.cos(heading), speed * np.sin(heading), np.zeros(STEPS + 1)], axis=-1)
    return np.diff(velocity, axis=0)


# -- following --------------------------------------------------------------------------------------------------------


class Record(NamedTuple):
    """How far a tracker was off, at every scan.

    Attributes:
        error: [r, k + 1, d] m, estimated minus true.
        fired: [r, k + 1] bool, the maneuver test; False while the batch start goes on.
    """

    error: np.ndarray
    fired: np.ndarray

    @property
    def squares(self) -> np.ndarray:
        """Squared horizontal errors [r, k + 1] m²."""
        return np.square(self.error[..., :2]).sum(-1)

    def rms(self) -> np.ndarray:
        """Root mean square horizontal error [k + 1] m."""
        return np.sqrt(self.squares.mean(0))

    def rms_height(self) -> np.ndarray:
        """Root mean square error of the height [k + 1] m."""
        return np.sqrt(np.square(self.error[..., 2]).mean(0))


def follow(
    tracker: RangeSumEkf, sites: Sites, flights: Flights, prior: Gaussian, start_scans: int = START_SCANS
) -> Record:
    """Start from a prior at time 0 by the batch over the first scans; `start_scans` 1: the plain filter, no batch.

    The plain filter's first update is one step of the filter at the guess, as in the paper.
    """
    scans = flights.heard(sites)
    state, tracks, fired = RangeSumTrack(prior.mean, prior.cov, 0.0), [], []
    for k in range(scans.range_sums.shape[1]):
        if start_scans > 1 and k < start_scans:
            state, alarm = tracker.initiate(_scans(scans, slice(k + 1)), prior, np.arange(k + 1.0)), False
        else:
            update = tracker.update(tracker.predict(state, 1.0 if k else 0.0), _scans(scans, k))
            state, alarm = update.posterior, update.maneuver
        tracks.append(state.mean[:, : len(sites.receiver)])
        fired.append(np.broadcast_to(alarm, len(flights.path)))
    return _record(flights, tracks, fired)


def follow_wording(tracker: RangeSumEkf, sites: Sites, flights: Flights, prior: Gaussian) -> Record:
    """As `follow`, but a fired test widens the next scan's prediction, not its own: the paper's wording."""
    scans, asks = flights.heard(sites), RangeSumEkf(tracker.process_noise, tracker.false_alarm, 1.0, tracker.floor_m)
    wider = (tracker.inflation**2 - 1.0) * axis_noise(1.0, ACCELERATION_VAR)
    state = asks.initiate(_scans(scans, slice(START_SCANS)), prior, np.arange(START_SCANS, dtype=float))
    tracks, alarm = [state.mean[:, :3]] * START_SCANS, np.zeros(len(flights.path), bool)
    fired = [alarm] * START_SCANS
    for k in range(START_SCANS, scans.range_sums.shape[1]):
        state = asks.predict(state, 1.0)
        state = state._replace(cov=state.cov + alarm[:, None, None] * wider)
        update = asks.update(state, _scans(scans, k))
        state, alarm = update.posterior, update.maneuver
        tracks.append(state.mean[:, :3])
        fired.append(alarm)
    return _record(flights, tracks, fired)


def follow_literal_start(sites: Sites, flights: Flights, guess: np.ndarray, damping: float, scans: int) -> np.ndarray:
    """Errors [r, d] m after one step of eq 12 for each of the first scans, from the guess [d]."""
    heard, d = flights.heard(sites), len(sites.receiver)
    position = np.broadcast_to(guess[:d], (len(flights.path), d))
    for k in range(scans):
        position = fixed_damping_step(position, _scans(heard, k), damping)
    return position - flights.path[:, scans - 1, :d]


def _scans(scans: RangeSumScan, key) -> RangeSumScan:
    """One scan, or several with their axis for time."""
    sums = scans.range_sums[:, key]
    rows = (None,) if sums.ndim == 3 else ()
    return RangeSumScan(sums, scans.valid[:, key], *(np.asarray(part)[rows] for part in scans[2:]))


def _record(flights: Flights, tracks: list, fired: list) -> Record:
    position = np.stack(tracks, axis=1)
    return Record(position - flights.path[..., : position.shape[-1]], np.stack(fired, axis=1))
