"""Section 3 of Xiu et al. (2002) simulated: the paper's filter, the fused baseline and the bounds on its scenario.

Everything is computed for all runs of all seeds at once; the only Python loop is the one over the 45 scans.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from passive_env.catalogue.two_station import (
    BESTFIT,
    NATURAL,
    TABLE_1_RANGE_ERROR_KM,
    TABLE_1_UPDATES,
    PaperCourse,
)
from passive_env.kinematics import maneuver
from trackers import Bank, FusedEkf, Gaussian, RpEkf, Scan, Tracker, Update, rp_ekf
from trackers.association import AssociationModel, associate
from trackers.bounds import bound_prior, bound_update, posterior_bound_information, range_std
from trackers.measurement import bearing
from trackers.triangulation import modulus_interval

STEP_S = 2.0
STEPS = 45
BEARING_STD = math.radians(0.5)
UPDATES = np.array(TABLE_1_UPDATES)
TABLE_1_KM = np.array(TABLE_1_RANGE_ERROR_KM).T
"""The paper's Table 1 [17 updates, 3 targets], km."""

PRIOR_RANGE_STD_M, PRIOR_VELOCITY_STD_M_S = 15e3, 200.0
"""Prior of the posterior Cramér–Rao bound, specification section 10."""


GATES = AssociationModel()
"""4σ bearing gates, every target seen, no false bearings."""


@dataclass(frozen=True)
class LiteralRpEkf:
    """The paper's filter as printed: range interval from moduli, one bearing per scan, a given initial radial speed.

    For reproduction only: moduli admit crossings behind the stations. Bearings are gated and assigned once per scan
    (section 2.2's last paragraph; the one best joint assignment is ours), so hypothesis i remains the paper's
    subinterval i. Settings, SI units:
        process_noise: q [m/s per step].
        velocity_std: initial velocity standard deviation σ_v per axis [m/s].
        radial_speed: initial velocity along the reference bearing [m/s], outward positive (eq 18's v_s).
        hypotheses, prune_below: N and the detection threshold of section 3.
        reference_only: use the reference station's bearings only after initiation, as the paper does.
        model: gates and detection model of the association.
    Source: Xiu et al. (2002), eqs 8–38.
    """

    process_noise: float
    velocity_std: float
    radial_speed: float
    hypotheses: int = 8
    prune_below: float = 1e-3
    reference_only: bool = True
    model: AssociationModel = GATES

    def initiate(self, scan: Scan) -> Bank:
        """One bank per reference bearing, over the paper's literal range interval."""
        alpha, reference = scan.bearings[..., -1, :], scan.stations[..., None, -1, :]
        thetas, station = scan.bearings[..., None, 0, :], scan.stations[..., None, 0, :]
        interval = modulus_interval(alpha, reference, thetas, station, 3.0 * scan.bearing_std)
        return rp_ekf.initiate(
            alpha, reference, scan.bearing_std, interval, self.hypotheses, self.radial_speed, self.velocity_std
        )

    def predict(self, state: Bank, step_s: float) -> Bank:
        """Propagate all EKFs by one step."""
        return rp_ekf.predict(state, step_s, self.process_noise)

    def update(self, state: Bank, scan: Scan) -> Update:
        """Assign the scan's bearings to the tracks, then condition every EKF on them, reweight and prune."""
        scan = scan.reference_only() if self.reference_only else scan
        found = associate(*state, scan, self.model)
        posterior, nu, S, log_likelihood = rp_ekf.update(
            state, found.bearings, found.used, scan.stations[..., None, :, :], scan.bearing_std, self.prune_below
        )
        return Update(posterior, nu, S, log_likelihood, found.assignment)

    def estimate(self, state: Bank) -> Gaussian:
        """Weighted mean [..., m, 4] and covariance [..., m, 4, 4]."""
        return rp_ekf.estimate(state)


class Reading(NamedTuple):
    """One way to fill the paper's gaps: a course, and its filter's settings."""

    course: PaperCourse
    tracker: LiteralRpEkf


READINGS = {
    "NATURAL": Reading(NATURAL, LiteralRpEkf(process_noise=15.0, velocity_std=200.0, radial_speed=-200.0)),
    "BESTFIT": Reading(BESTFIT, LiteralRpEkf(process_noise=25.0, velocity_std=50.0, radial_speed=200.0)),
}
"""Specification, section 9."""

FUSED = FusedEkf(process_noise=10.0)
"""The specification's baseline: one EKF per target on both stations' bearings, from the cross-fix."""

BANK = RpEkf(process_noise=10.0)
"""This package's bank on both stations' bearings: forward crossings, late association."""


# -- the world of section 3 ------------------------------------------------------------------------------------------


class Paths(NamedTuple):
    """True states [k + 1, stations or targets, 4] at multiples of the step; the last station is the reference."""

    stations: np.ndarray
    targets: np.ndarray

    @property
    def ranges(self) -> np.ndarray:
        """True ranges [k + 1, m] m from the reference station."""
        return distance(self.targets, self.stations[:, -1:])

    @property
    def bearings(self) -> np.ndarray:
        """True bearings [k + 1, s, m] rad."""
        return bearing(self.targets[:, None], self.stations[:, :, None])


def distance(a, b):
    """Distance [...] m between positions in the first two entries of a and b [..., ≥2]."""
    return np.hypot(a[..., 0] - b[..., 0], a[..., 1] - b[..., 1])


def paper_paths(course: PaperCourse, steps: int = STEPS) -> Paths:
    """Exact arcs of stations and targets by the paper's schedule; targets gain speed from the start of their turn."""
    rate, axis = math.radians(course.turn_rate_deg_s), np.empty(steps + 1)
    gain_s = (np.array(course.final_speed_m_s) - course.speed_m_s) / course.acceleration_m_s2
    gain_window = course.target_turn_s[0] + np.stack([np.zeros_like(gain_s), gain_s], axis=-1)
    stations = _start(course.stations_m, course.station_heading_deg, course.speed_m_s)
    targets = _start(course.targets_m, course.target_heading_deg, course.speed_m_s)
    station_rate, target_rate = (rate * np.array(sense, float) for sense in (course.station_sense, course.target_sense))
    stations = maneuver(stations, station_rate, np.array(course.station_turn_s), 0.0, np.zeros(2), STEP_S, axis)
    targets = maneuver(
        targets, target_rate, np.array(course.target_turn_s), course.acceleration_m_s2, gain_window, STEP_S, axis
    )
    return Paths(np.swapaxes(stations, 0, 1), np.swapaxes(targets, 0, 1))


def _start(positions, headings_deg, speed) -> np.ndarray:
    """States [n, 4] from positions [n, 2] m, headings [n] deg and one speed."""
    heading = np.radians(headings_deg)
    return np.column_stack([np.array(positions), speed * np.cos(heading), speed * np.sin(heading)])


class Noise(NamedTuple):
    """Randomness of r runs: standard normal errors and slot orders, both [r, k + 1, s, m]."""

    errors: np.ndarray
    order: np.ndarray


def draw_noise(rng: np.random.Generator, runs: int, steps: int = STEPS, stations: int = 2, targets: int = 3) -> Noise:
    """Bearing errors, and a random order of every scan's bearings, so that nothing but the tracker labels them."""
    shape = (runs, steps + 1, stations, targets)
    return Noise(rng.standard_normal(shape), rng.random(shape).argsort(-1))


def draw_seeds(seeds: Sequence[int], runs: int) -> Noise:
    """Noise of all runs of all seeds in one batch [seeds · runs, ...], each seed from its own generator."""
    parts = [draw_noise(np.random.default_rng(seed), runs) for seed in seeds]
    return Noise(*(np.concatenate(arrays) for arrays in zip(*parts, strict=True)))


class Sightings(NamedTuple):
    """What the stations report: bearings [r, k + 1, s, m] rad, and the target behind each (for scoring only)."""

    bearings: np.ndarray
    origin: np.ndarray


def sight(paths: Paths, noise: Noise, exact_start: bool, labelled: bool = False) -> Sightings:
    """Noisy bearings in random order.

    Args:
        exact_start: the first scan has no noise, as the paper's Table 1 needs (specification, section 7).
        labelled: keep the targets' order, for the comparison with a tracker that is told which bearing is whose.
    """
    errors = BEARING_STD * noise.errors
    if exact_start:
        errors[:, 0] = 0.0
    order = np.broadcast_to(np.arange(noise.order.shape[-1]), noise.order.shape) if labelled else noise.order
    return Sightings(np.take_along_axis(paths.bearings + errors, order, axis=-1), order)


# -- following the targets -------------------------------------------------------------------------------------------


class Record(NamedTuple):
    """What a tracker said, in the targets' order; track j is scored against the target behind its first bearing.

    Attributes:
        position: [r, k + 1, m, 2] m, combined estimate.
        range_error: [r, k + 1, m] m, estimated minus true range from the reference station.
        weights: [r, k + 1, m, n] of the range hypotheses.
        own: [r, k + 1, m] bool, the reference bearing used was the target's own.
    """

    position: np.ndarray
    range_error: np.ndarray
    weights: np.ndarray
    own: np.ndarray


def follow(tracker: Tracker, paths: Paths, seen: Sightings, labelled: bool = False) -> Record:
    """Run a tracker over unlabelled scans.

    Args:
        labelled: give each track a scan of its own target's bearings only (`seen` in the targets' order).
    """
    valid = np.ones(seen.bearings.shape[2:], dtype=bool)
    state = tracker.initiate(Scan(seen.bearings[:, 0], valid, paths.stations[0, :, :2], BEARING_STD))
    target = seen.origin[:, 0, -1]
    moments = [(tracker.estimate(state).mean[..., :2], state.log_weights, np.ones_like(target, dtype=bool))]
    for k in range(1, len(paths.stations)):
        scan = Scan(seen.bearings[:, k], valid, paths.stations[k, :, :2], BEARING_STD)
        prior = tracker.predict(state, STEP_S)
        state, slot = _update_apart(tracker, prior, scan) if labelled else _update(tracker, prior, scan)
        behind = target if labelled else np.take_along_axis(seen.origin[:, k, -1], np.maximum(slot, 0), axis=-1)
        moments.append((tracker.estimate(state).mean[..., :2], state.log_weights, (behind == target) & (slot >= 0)))
    return _record(paths, moments, target)


def _update(tracker: Tracker, prior: Bank, scan: Scan) -> tuple[Bank, np.ndarray]:
    """Posterior, and the slot [r, m] of the reference bearing each track took."""
    update = tracker.update(prior, scan)
    return update.posterior, update.assignment[..., -1]


def _update_apart(tracker: Tracker, prior: Bank, scan: Scan) -> tuple[Bank, np.ndarray]:
    """The same with every track alone in a scan [r, m, s, 1] of its own bearings."""
    alone = Scan(np.swapaxes(scan.bearings, -1, -2)[..., None], scan.valid[:, :1], scan.stations, scan.bearing_std)
    posterior, slot = _update(tracker, Bank(*(part[:, :, None] for part in prior)), alone)
    return Bank(*(part[:, :, 0] for part in posterior)), slot[..., 0]


def _record(paths: Paths, moments: list, target: np.ndarray) -> Record:
    position, log_weights, own = (np.stack(series, axis=1) for series in zip(*moments, strict=True))
    track = target.argsort(-1)[:, None, :]
    position = np.take_along_axis(position, track[..., None], axis=2)
    error = distance(position, paths.stations[:, -1:]) - paths.ranges
    weights = np.exp(np.take_along_axis(log_weights, track[..., None], axis=2))
    return Record(position, error, weights, np.take_along_axis(own, track, axis=2))


def table_1_errors(course: PaperCourse, tracker: LiteralRpEkf, runs: int, rng: np.random.Generator) -> np.ndarray:
    """The paper's Monte Carlo: |range error| [runs, 17, 3] m at the updates of Table 1."""
    paths = paper_paths(course)
    seen = sight(paths, draw_noise(rng, runs), exact_start=True)
    return np.abs(follow(tracker, paths, seen).range_error[:, UPDATES])


def table_1_score(mean_error_m: np.ndarray) -> np.ndarray:
    """Mean |ln(ours / paper)| [...] over the 51 entries; mean errors [..., 17, 3] m."""
    return np.abs(np.log(mean_error_m / 1e3 / TABLE_1_KM)).mean((-1, -2))


def range_bound(paths: Paths, process_noise: float, both: bool) -> np.ndarray:
    """Posterior Cramér–Rao bound [k + 1, m] m on the range from the reference station, along the true paths.

    The prior (15 km radial, 200 m/s) holds the reference station's first bearing; with both stations the other's
    first bearing counts too. Source: specification, section 10.

    Args:
        process_noise: q [m/s per step] of the bound's motion model, 0 for known target inputs.
        both: whether both stations' bearings count, or the reference's only.
    """
    truth, stations = np.swapaxes(paths.targets, 0, 1), paths.stations[:, :, :2]
    prior = bound_prior(truth[:, 0], stations[0, -1], BEARING_STD, PRIOR_RANGE_STD_M, PRIOR_VELOCITY_STD_M_S)
    if both:
        prior = bound_update(prior, truth[:, 0], stations[0, :1], np.array([True]), BEARING_STD)
    counted = stations if both else stations[:, -1:]
    cov = posterior_bound_information(truth, counted, prior, BEARING_STD, STEP_S, process_noise)
    return range_std(cov, truth, stations[:, -1]).T


# -- the whole study -------------------------------------------------------------------------------------------------

BOUNDS = {
    "reference, q = 0": (0.0, False),
    "reference, q = 10": (10.0, False),
    "both, q = 0": (0.0, True),
    "both, q = 10": (10.0, True),
}
"""Name: (q, both stations)."""


class Study(NamedTuple):
    """All that was computed for one reading; the runs of all seeds lie on the first axis of every record.

    Attributes:
        reading, paths: what was simulated.
        paper, paper_labelled: the paper's filter on unlabelled and on labelled bearings, first scan without noise.
        fused, fused_labelled: `FUSED`; bank: `BANK` on unlabelled bearings; every scan noisy.
        bounds: [k + 1, m] m by name.
    """

    reading: Reading
    paths: Paths
    paper: Record
    paper_labelled: Record
    fused: Record
    fused_labelled: Record
    bank: Record
    bounds: dict[str, np.ndarray]


def study(reading: Reading, noise: Noise) -> Study:
    """All trackers on the same noise, and the bounds."""
    paths = paper_paths(reading.course)

    def record(tracker: Tracker, exact_start: bool, labelled: bool) -> Record:
        return follow(tracker, paths, sight(paths, noise, exact_start, labelled), labelled)

    return Study(
        reading,
        paths,
        paper=record(reading.tracker, exact_start=True, labelled=False),
        paper_labelled=record(reading.tracker, exact_start=True, labelled=True),
        fused=record(FUSED, exact_start=False, labelled=False),
        fused_labelled=record(FUSED, exact_start=False, labelled=True),
        bank=record(BANK, exact_start=False, labelled=False),
        bounds={name: range_bound(paths, *setting) for name, setting in BOUNDS.items()},
    )
