"""The paper's two scenarios simulated, on plain position measurements and on fixes of passive stations.

All runs are one batch; the only Python loop is the one over scans. Every tracker meets the same measurements. The
specification's choices fill the paper's gaps: a step of 1 s, two-point differencing, white perturbation in scenario 1.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from passive_env.catalogue.maneuvering import PAPER_MIDDLE_M
from trackers import FixTracker, Gaussian, ImmMie, Mie
from trackers.measurement import bearing
from trackers.motion import transition
from trackers.position_fix import PositionFix, fix_bearings, fix_range_sums
from trackers.range_sum import range_sum

STEP_S = 1.0
THRESHOLD, ALWAYS, NEVER = 8.0, 1e-13, 1e30
"""λ of the paper, and those that open and close a detector."""

MEASUREMENT_STD_M = 10.0
"""√100 m: the paper's "Q = 100 I" is measurement noise."""

ONSET_S = {1: 15.0, 2: 20.0}
SPEED_M_S, TURN_RATE, TURN_END_S, ACCELERATION_M_S2 = 300.0, 0.1, 50.0, 20.0
STEPS = {1: 80, 2: 70}

PHASES: dict[int, dict[str, tuple[float, float]]] = {
    1: {"CV": (8, 15), "onset": (15, 22), "constant": (22, 40), "decaying": (40, 80)},
    2: {"CV before": (8, 20), "onset": (20, 26), "turn": (26, 50), "exit": (50, 56), "CV after": (56, 70)},
}
"""Spans [from, to) in seconds over which errors are averaged."""


class Path(NamedTuple):
    """True states [k, 4] (x, y, vx, vy) and accelerations [k, 2] m/s² at multiples of the step."""

    state: np.ndarray
    acceleration: np.ndarray


def paper_path(scenario: int) -> Path:
    """The target without perturbation.

    Scenario 1: (100, 100) m/s; 20 m/s² east from 15 s; from 40 s on 10 cos(π(t − 40 s)/40 s) + 10. Scenario 2:
    300 m/s east, from 20 to 50 s a left turn of 0.1 rad/s (radius 3 km).
    """
    t = STEP_S * np.arange(STEPS[scenario] + 1)
    return _accelerated_path(t) if scenario == 1 else _turning_path(t)


def _accelerated_path(t: np.ndarray) -> Path:
    """The acceleration at the start of a step is held over it."""
    fading = 0.5 * ACCELERATION_M_S2 * (np.cos(math.pi * (t - 40.0) / 40.0) + 1.0)
    along = np.where(t < ONSET_S[1], 0.0, np.where(t < 40.0, ACCELERATION_M_S2, fading))
    acceleration = np.stack([along, np.zeros_like(along)], axis=-1)
    state = np.empty((len(t), 4))
    state[0] = 0.0, 0.0, 100.0, 100.0
    gain = _input_gain()
    for k in range(len(t) - 1):
        state[k + 1] = transition(STEP_S) @ state[k] + gain @ acceleration[k]
    return Path(state, acceleration)


def _turning_path(t: np.ndarray) -> Path:
    """Straight, an arc, straight."""
    turned = TURN_RATE * np.clip(t - ONSET_S[2], 0.0, TURN_END_S - ONSET_S[2])
    straight = SPEED_M_S * np.minimum(t, ONSET_S[2])
    beyond = SPEED_M_S * np.maximum(t - TURN_END_S, 0.0)
    radius = SPEED_M_S / TURN_RATE
    east, north = np.cos(turned), np.sin(turned)
    x, y = straight + radius * north + beyond * east, radius * (1.0 - east) + beyond * north
    turning = (t >= ONSET_S[2]) & (t < TURN_END_S)
    acceleration = SPEED_M_S * TURN_RATE * turning[:, None] * np.stack([-north, east], axis=-1)
    return Path(np.stack([x, y, SPEED_M_S * east, SPEED_M_S * north], axis=-1), acceleration)


def _input_gain() -> np.ndarray:
    """C = G [4, 2]."""
    return np.vstack([0.5 * STEP_S**2 * np.eye(2), STEP_S * np.eye(2)])


class Measured(NamedTuple):
    """What r runs measure.

    Attributes:
        truth: [r, k, 4]; acceleration: [k, 2] m/s² without the perturbation.
        position: [r, k, 2] m; cov: [r, k, 2, 2] m²; fixed: [r, k] bool.
    """

    truth: np.ndarray
    acceleration: np.ndarray
    position: np.ndarray
    cov: np.ndarray
    fixed: np.ndarray

    def raw_rmse(self, first: int = 0) -> float:
        """Root mean square error of the measured positions [m] from scan `first` on."""
        error = (self.position - self.truth[..., :2])[:, first:][self.fixed[:, first:]]
        return float(np.sqrt(np.square(error).sum(-1).mean()))


def measure_positions(scenario: int, runs: int, rng: np.random.Generator) -> Measured:
    """Plain position measurements of 10 m; scenario 1 with a white acceleration of 1 m/s² per axis in the truth."""
    path = paper_path(scenario)
    truth = np.broadcast_to(path.state, (runs, *path.state.shape)).copy()
    if scenario == 1:
        truth += perturbation(runs, STEPS[1], rng)
    return _measured(Path(truth, path.acceleration), rng)


def measure_quiet(runs: int, steps: int, rng: np.random.Generator) -> Measured:
    """No maneuver, only the white acceleration that the filters believe in."""
    return _measured(Path(perturbation(runs, steps, rng), np.zeros((steps + 1, 2))), rng)


def perturbation(runs: int, steps: int, rng: np.random.Generator) -> np.ndarray:
    """What a white acceleration of 1 m/s² per axis adds to the states [r, k + 1, 4]."""
    drift, pushes = np.zeros((runs, steps + 1, 4)), rng.standard_normal((runs, steps, 2))
    for k in range(steps):
        drift[:, k + 1] = drift[:, k] @ transition(STEP_S).T + pushes[:, k] @ _input_gain().T
    return drift


def _measured(truth: Path, rng: np.random.Generator) -> Measured:
    """Measurements of 10 m of the true states [r, k, 4]."""
    shape = truth.state.shape[:2]
    position = truth.state[..., :2] + MEASUREMENT_STD_M * rng.standard_normal((*shape, 2))
    cov = np.broadcast_to(MEASUREMENT_STD_M**2 * np.eye(2), (*shape, 2, 2)).copy()
    return Measured(truth.state, truth.acceleration, position, cov, np.ones(shape, bool))


# -- passive stations -------------------------------------------------------------------------------------------------

BEARING_STD = 1.0e-3
RANGE_SUM_STD_M = 15.0
START_OFFSET_M = 300.0
"""Per axis, off the truth: where the iteration on range sums starts."""


class Layout(NamedTuple):
    """Two stations abreast south of the target.

    Attributes:
        baseline_m: distance at the start, about `PAPER_MIDDLE_M`.
        opening_m_s: speed at which the baseline grows; closing_m_s: of both stations northwards.
        ellipses: range sums instead of bearings; a transmitter stands midway, both stations receive.
        told_std_m: trackers are told this error of a fix, round, instead of the fix's own covariance.
    """

    baseline_m: float
    opening_m_s: float = 0.0
    closing_m_s: float = 0.0
    ellipses: bool = False
    told_std_m: float | None = None

    def stations(self, t: np.ndarray) -> np.ndarray:
        """Positions [k, 2, 2] m at times [k] s."""
        half = 0.5 * (self.baseline_m + self.opening_m_s * t)
        x, y = PAPER_MIDDLE_M[0], PAPER_MIDDLE_M[1] + self.closing_m_s * t
        return np.stack([np.stack([x - half, y], -1), np.stack([x + half, y], -1)], axis=1)


def measure_fixes(layout: Layout, runs: int, rng: np.random.Generator) -> Measured:
    """Scenario 2's target fixed at every scan by the layout's stations."""
    path = paper_path(2)
    truth = np.broadcast_to(path.state, (runs, *path.state.shape)).copy()
    stations = layout.stations(STEP_S * np.arange(len(path.state)))
    fix = (_fix_ellipses if layout.ellipses else _fix_lines)(truth[..., :2], stations, rng)
    cov = fix.cov if layout.told_std_m is None else np.broadcast_to(layout.told_std_m**2 * np.eye(2), fix.cov.shape)
    return Measured(truth, path.acceleration, fix.position, cov.copy(), fix.fixed)


def _fix_lines(truth: np.ndarray, stations: np.ndarray, rng: np.random.Generator) -> PositionFix:
    z = bearing(truth[:, :, None], stations) + BEARING_STD * rng.standard_normal((*truth.shape[:2], 2))
    return fix_bearings(z, np.ones(z.shape, bool), stations, np.full(z.shape, BEARING_STD))


def _fix_ellipses(truth: np.ndarray, stations: np.ndarray, rng: np.random.Generator) -> PositionFix:
    transmitter = stations.mean(1)
    sums = range_sum(truth, transmitter, stations)
    sums = sums + RANGE_SUM_STD_M * rng.standard_normal(sums.shape)
    noise = RANGE_SUM_STD_M**2 * np.eye(2)
    return fix_range_sums(sums, np.ones(sums.shape, bool), transmitter, stations, noise, truth + START_OFFSET_M)


# -- trackers ---------------------------------------------------------------------------------------------------------


class Record(NamedTuple):
    """What a tracker said in r runs; scans before the start hold NaN.

    Attributes:
        position_error: [r, k, 2] m; acceleration_error: [r, k, 2] m/s²; acceleration: [r, k, 2] m/s².
        probability: [r, k, f] of the filters; detected: [r, k, f] bool.
        nees: [r, k] normalised squared error of the four states.
    """

    position_error: Any
    acceleration_error: Any
    acceleration: Any
    probability: Any
    detected: Any
    nees: Any

    def rmse(self, span: tuple[float, float] | None = None) -> Any:
        """Root mean square position error [k] m per scan, or over a span [from, to) of seconds."""
        return _rms(self.position_error, span)

    def acceleration_rmse(self, span: tuple[float, float] | None = None) -> Any:
        """The same of the acceleration [m/s²]."""
        return _rms(self.acceleration_error, span)


def _rms(error: np.ndarray, span: tuple[float, float] | None) -> Any:
    squares = np.square(error).sum(-1)
    return np.sqrt(squares.mean(0)) if span is None else float(np.sqrt(squares[:, scans_in(span)].mean()))


def scans_in(span: tuple[float, float]) -> slice:
    """Scans of a span [from, to) of seconds."""
    return slice(round(span[0] / STEP_S), round(span[1] / STEP_S))


def two_point_start(measured: Measured) -> Gaussian:
    """Track at scan 1 from the first two measured positions [r, 4], with its covariance."""
    first, second = measured.position[:, 0], measured.position[:, 1]
    R0, R1 = measured.cov[:, 0], measured.cov[:, 1]
    cov = np.block([[R1, R1 / STEP_S], [R1 / STEP_S, (R0 + R1) / STEP_S**2]])
    return Gaussian(np.concatenate([second, (second - first) / STEP_S], axis=-1), cov)


def follow(tracker: FixTracker, measured: Measured) -> Record:
    """Run a tracker over all runs."""
    state, said = tracker.start(two_point_start(measured)), []
    for k in range(2, measured.truth.shape[1]):
        at = (measured.position[:, k], measured.cov[:, k], measured.fixed[:, k])
        update = tracker.update_fix(tracker.predict(state, STEP_S), *at)
        state = update.posterior
        estimate, acceleration = tracker.estimate(state), tracker.acceleration(state).mean
        error = estimate.mean - measured.truth[:, k]
        nees = (error[..., None] * np.linalg.solve(estimate.cov, error[..., None])).sum((-1, -2))
        off = acceleration - measured.acceleration[k]
        said.append((error[:, :2], off, acceleration, update.model_probability, update.detected, nees))
    return Record(*(_from_start(np.stack(series, axis=1)) for series in zip(*said, strict=True)))


def mean_input_errors(tracker: ImmMie, measured: Measured, span: tuple[float, float]) -> np.ndarray:
    """Mean error [f] m/s² of the eastward acceleration of each filter by itself, over a span."""
    state, errors = tracker.start(two_point_start(measured)), []
    at = scans_in(span)
    for k in range(2, at.stop):
        state = tracker.update_fix(
            tracker.predict(state, STEP_S), measured.position[:, k], measured.cov[:, k]
        ).posterior
        errors.append(state.input[..., 0] - measured.acceleration[k, 0])
    return np.mean(errors[at.start - 2 :], axis=(0, 1))


def quiet_alarms(window: int, measured: Measured) -> np.ndarray:
    """Tests [r, k] of one filter that are passed where there is nothing to detect, from the first full window on.

    Nothing is done about an alarm, so every window is that of a filter in quiet flight.
    """
    tester, filter_ = (Mie(windows=(window,), thresholds=(threshold,)) for threshold in (THRESHOLD, NEVER))
    state, found = filter_.start(two_point_start(measured)), []
    for k in range(2, measured.truth.shape[1]):
        prior, fix = filter_.predict(state, STEP_S), (measured.position[:, k], measured.cov[:, k])
        found.append(tester.update_fix(prior, *fix).detected[:, 0])
        state = filter_.update_fix(prior, *fix).posterior
    return np.stack(found[window - 1 :], axis=1)


def _from_start(series: np.ndarray) -> np.ndarray:
    """Two scans of nothing before a series [r, k, ...]: the start consumed them."""
    nothing = False if series.dtype == bool else np.nan
    return np.concatenate([np.full((len(series), 2, *series.shape[2:]), nothing), series], axis=1)


# -- without chance ---------------------------------------------------------------------------------------------------

SETTLE_STEPS, STEADY_STEPS = 20, 60


def noise_free_inputs(mixing: str, acceleration: float = ACCELERATION_M_S2, d: int = 2) -> tuple[np.ndarray, float]:
    """Errors of û after a long constant acceleration without any noise, detectors open, windows 6 and 4.

    The filters start without mixing, each exact as soon as its window is full; then `mixing` is switched on.

    Returns:
        errors [2] m/s² of the filters along the acceleration, and of their mixture.
    """
    windows, eye, zero = (6, 4), np.eye(d), np.zeros((d, d))
    F, C = np.block([[eye, STEP_S * eye], [zero, eye]]), np.vstack([0.5 * STEP_S**2 * eye, STEP_S * eye])
    u, R = acceleration * eye[0], MEASUREMENT_STD_M**2 * eye
    x = np.concatenate([np.zeros(d), np.full(d, 100.0)])
    state = ImmMie(windows=windows).start(Gaussian(x, np.block([[R, R], [R, 2.0 * R]])))
    tracker = ImmMie(windows=windows)
    for k in range(1, SETTLE_STEPS + STEADY_STEPS + 1):
        thresholds = tuple(ALWAYS if k >= s else NEVER for s in windows)
        tracker = ImmMie(windows=windows, thresholds=thresholds, mixing="none" if k <= SETTLE_STEPS else mixing)
        x = F @ x + C @ u
        state = tracker.update_fix(tracker.predict(state, STEP_S), x[:d], R).posterior
    return state.input[:, 0] - acceleration, float(tracker.acceleration(state).mean[0] - acceleration)
