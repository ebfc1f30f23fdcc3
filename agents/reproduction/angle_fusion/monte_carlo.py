"""Section 5 of Wang, Wang and Yang (2004) simulated: two platforms, one target, dropouts and false returns.

All runs of all seeds are one batch; the only Python loop is the one over the 40 scans. The specification's choices
fill the paper's gaps: platforms abreast, the target ahead and on a straight course, a first position by triangulation.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any, NamedTuple

import numpy as np

from passive_env.catalogue.angle_fusion import PAPER_PLATFORMS, PAPER_TARGET
from trackers import ANGLE_TRACKERS, AngleFilter, AngleScan
from trackers.bounds_3d import bound_start, posterior_bound_information_3d, range_std_3d
from trackers.direction import direction, direction_jacobian, gate
from trackers.gaussian import Gaussian
from trackers.motion_3d import process_noise_3d, transition_3d

STEP_S = 2.0
STEPS = 40
TURN_STEP = 20
ANGLE_STD = math.radians(0.5)
PROCESS_NOISE = 30.0
"""√q [m/s²]: the paper's 900 without a unit, as an acceleration's variance."""

VELOCITY_STD_M_S = (200.0, 200.0, 50.0)
NO_CLUTTER = 1e-9
"""Density [rad⁻²] that tells a filter there are no false returns."""

MOST_FALSE_RETURNS = 200
"""A run with more false returns in one gate gets no returns any more (fixed density only)."""

LOST_SCANS, LOST_M = 5, 1.0e3
"""A run is lost if the mean position error of its last scans is larger."""


class Paths(NamedTuple):
    """True target states [k + 1, 6] and platform positions [k + 1, 2, 3] m at multiples of the step."""

    target: np.ndarray
    platforms: np.ndarray

    @property
    def ranges(self) -> np.ndarray:
        """True ranges [k + 1] m from platform 1."""
        return distance(self.target[:, :3], self.platforms[:, 0])


def distance(a, b):
    """Distance [...] m between positions [..., 3]."""
    return np.linalg.norm(a - b, axis=-1)


def paper_paths() -> Paths:
    """Platforms 6 km abreast heading east, platform 1 turning 45° north at once at k = 20; the target flies west."""
    t = STEP_S * np.arange(STEPS + 1)
    target, platforms = (_straight(np.array(start), t) for start in (PAPER_TARGET, PAPER_PLATFORMS))
    after = np.maximum(t - t[TURN_STEP], 0.0)
    speed = PAPER_PLATFORMS[0][3]
    platforms[:, 0, 0] += (math.sqrt(0.5) - 1.0) * speed * after
    platforms[:, 0, 1] += math.sqrt(0.5) * speed * after
    return Paths(target, platforms[..., :3])


def _straight(start: np.ndarray, t: np.ndarray) -> np.ndarray:
    """States [k + 1, ..., 6] on a straight course from states [..., 6]."""
    path = np.tile(start, (len(t), *[1] * start.ndim))
    path[..., :3] += t.reshape(-1, *[1] * start.ndim) * start[..., 3:]
    return path


PATHS = paper_paths()


class Noise(NamedTuple):
    """Randomness of r runs that no estimate acts on: errors [r, k + 1, 2, 2] rad, uniforms [r, k + 1] for dropouts."""

    errors: np.ndarray
    dropout: np.ndarray


def draw_seeds(seeds: Sequence[int], runs: int) -> Noise:
    """Noise of all runs of all seeds in one batch, each seed from its own generator."""
    parts = []
    for seed in seeds:
        rng = np.random.default_rng(seed)
        errors = ANGLE_STD * rng.standard_normal((runs, STEPS + 1, 2, 2))
        parts.append(Noise(errors, rng.random((runs, STEPS + 1))))
    return Noise(*(np.concatenate(arrays) for arrays in zip(*parts, strict=True)))


@dataclass(frozen=True)
class Trial:
    """What is tried on the paper's paths.

    Attributes:
        tracker: name in `ANGLE_TRACKERS`; settings: keywords of its class.
        clutter: mean number of false returns in each sensor's gate, every scan; 0 for none.
        fixed_density: `clutter` counts the gates of a filter without clutter instead of the tracker's own, on average
            over scans and sensors: one density for all of them, so that a gate that grows admits more.
        detection: probability that a sensor sees the target.
        availability: probability that sensor 2's data arrive, per scan; the first scan always does.
    """

    tracker: str = "angle_pdaf"
    settings: tuple[tuple[str, float], ...] = ()
    clutter: float = 0.0
    fixed_density: bool = False
    detection: float = 1.0
    availability: float = 1.0

    def make_tracker(self) -> AngleFilter:
        """The tracker, told of the detection probability."""
        settings = {"process_noise": PROCESS_NOISE, "initial_velocity_std": VELOCITY_STD_M_S, **dict(self.settings)}
        return ANGLE_TRACKERS[self.tracker](detection_probability=self.detection, **settings)


class Record(NamedTuple):
    """What a tracker said in r runs.

    Attributes:
        range_error: [r, k] m, estimated minus true range from platform 1, k = 1 … 40.
        position_error: [r, k] m.
        validated: [r, k, 2] returns in the gates.
        gated: [r, k, 2] bool, whether the target's own return was among them.
        nees: [r, k] normalised squared error of the six states.
    """

    range_error: np.ndarray
    position_error: np.ndarray
    validated: np.ndarray
    gated: np.ndarray
    nees: np.ndarray

    @property
    def lost(self) -> Any:
        """[r] bool by the main criterion: mean position error of the last five scans above 1 km."""
        return self.position_error[:, -LOST_SCANS:].mean(-1) > LOST_M

    @property
    def slipped(self) -> Any:
        """[r] bool by the other criterion: the target's returns outside both gates three scans running."""
        outside = np.logical_not(self.gated.any(-1))
        return np.any(outside[:, 2:] & outside[:, 1:-1] & outside[:, :-2], axis=-1)

    @property
    def kept(self) -> Any:
        """[r] bool, the runs that are not lost; all of them if none is left."""
        return np.logical_not(self.lost) if not self.lost.all() else np.ones(len(self.lost), dtype=bool)

    def rmse(self) -> np.ndarray:
        """Root mean square range error [k] m over the kept runs."""
        return np.sqrt(np.square(self.range_error[self.kept]).mean(0))


def follow(trial: Trial, noise: Noise, rng: np.random.Generator) -> Record:
    """Run a trial; false returns, which depend on the gates, and missed detections come from `rng`."""
    tracker, runs = trial.make_tracker(), len(noise.errors)
    z = direction(PATHS.target[:, None], PATHS.platforms) + noise.errors
    std = np.broadcast_to(ANGLE_STD, (runs, 2, 2)).copy()
    everything = np.ones((runs, 2, 2), dtype=bool)
    first = AngleScan(
        z[:, 0, :, None], np.ones((runs, 2, 1), bool), _places(0, runs), std, everything, np.zeros((runs, 2))
    )
    state, swamped, said = tracker.initiate(first), np.zeros(runs, dtype=bool), []
    for k in range(1, STEPS + 1):
        prior, platforms = tracker.predict(state, STEP_S), _places(k, runs)
        search = gate(prior.mean[:, 0], prior.cov[:, 0], platforms, std, tracker.gate)
        density = _density(trial, search.area)
        detected = rng.random((runs, 2)) < trial.detection
        angles, valid, swamped = _returns(z[:, k], detected, density, search, tracker.gate, swamped, rng)
        available = everything.copy()
        available[:, 1] = (noise.dropout[:, k] < trial.availability)[:, None]
        update = tracker.update(prior, AngleScan(angles, valid, platforms, std, available, density))
        state = update.posterior
        said.append(_say(tracker.estimate(state), update.validated[:, 0], _in_gate(z[:, k], search, tracker.gate), k))
    return Record(*(np.stack(series, axis=1) for series in zip(*said, strict=True)))


def _places(k: int, runs: int) -> np.ndarray:
    """Platform positions [r, 2, 3] m at scan k."""
    return np.broadcast_to(PATHS.platforms[k], (runs, 2, 3)).copy()


def _density(trial: Trial, area: np.ndarray) -> np.ndarray:
    """False returns per rad² [r, 2] for gates of these areas."""
    if trial.clutter == 0.0:
        return np.full(area.shape, NO_CLUTTER)
    return np.full(area.shape, trial.clutter / clean_gate()) if trial.fixed_density else trial.clutter / area


def _returns(z, detected, density, search, gamma, swamped, rng):
    """Angles [r, 2, b, 2] and validity [r, 2, b] of the target's return (slot 0) and uniform false ones in the gates.

    Also which runs are swamped [r]: once there are more than `MOST_FALSE_RETURNS` in a gate, nothing is returned.
    """
    count = rng.poisson(np.minimum(density * search.area, 10.0 * MOST_FALSE_RETURNS))
    count[density <= NO_CLUTTER] = 0
    swamped = swamped | (count > MOST_FALSE_RETURNS).any(-1)
    count[swamped] = 0
    slots = int(count.max(initial=0))
    radius = np.sqrt(gamma * rng.random((*count.shape, slots)))
    turn = rng.uniform(0.0, 2.0 * math.pi, radius.shape)
    disk = radius[..., None] * np.stack([np.cos(turn), np.sin(turn)], axis=-1)
    false = search.angles[..., None, :] + disk @ np.swapaxes(np.linalg.cholesky(search.cov), -1, -2)
    angles = np.concatenate([z[..., None, :], false], axis=-2)
    valid = np.concatenate([(detected & ~swamped[:, None])[..., None], np.arange(slots) < count[..., None]], axis=-1)
    return np.where(valid[..., None], angles, 0.0), valid, swamped


def _in_gate(z, search, gamma) -> np.ndarray:
    """Whether directions [r, 2, 2] lie in the gates [r, 2]."""
    nu = (z - search.angles)[..., None]
    return (nu * np.linalg.solve(search.cov, nu)).sum((-1, -2)) <= gamma


def _say(estimate: Gaussian, validated, gated, k: int) -> tuple[np.ndarray, ...]:
    """Fields of `Record` for one scan."""
    mean, cov = estimate.mean[:, 0], estimate.cov[:, 0]
    error = mean - PATHS.target[k]
    range_error = distance(mean[:, :3], PATHS.platforms[k, 0]) - PATHS.ranges[k]
    nees = (error[..., None] * np.linalg.solve(cov, error[..., None])).sum((-1, -2))
    return range_error, np.linalg.norm(error[:, :3], axis=-1), validated, gated, nees


# -- without chance ---------------------------------------------------------------------------------------------------


def start_bound() -> np.ndarray:
    """Covariance [6, 6] after the first looks of both sensors and the velocity prior."""
    return bound_start(PATHS.target[0], PATHS.platforms[0], np.full((2, 2), ANGLE_STD), VELOCITY_STD_M_S)


def range_bound(process_noise: float = PROCESS_NOISE, available: Any = 1.0) -> np.ndarray:
    """Posterior Cramér–Rao bound [k] m on the range from platform 1, k = 1 … 40.

    Args:
        process_noise: √q [m/s²]; available: share of scans, one number or [2, 2] by sensor and component.
    """
    cov = posterior_bound_information_3d(
        PATHS.target, PATHS.platforms, start_bound(), np.full((2, 2), ANGLE_STD), STEP_S, process_noise, available
    )
    return range_std_3d(cov, PATHS.target, PATHS.platforms[:, 0])[1:]


def linear_range_error() -> np.ndarray:
    """Standard deviation [k] m of the range error that the filter's gains leave on a target without process noise.

    A covariance analysis along the true path, without any drawing: Σ' = (I − KH)ΦΣΦᵀ(I − KH)ᵀ + K R Kᵀ with the
    gains K of a filter that believes in √q = 30 m/s²; errors of the first velocity count as they are, −150 m/s east.
    """
    phi, Q, eye = transition_3d(STEP_S), process_noise_3d(STEP_S, PROCESS_NOISE), np.eye(6)
    R = ANGLE_STD**2 * np.eye(4)
    P, actual, found = start_bound(), start_bound(), []
    actual[3:, 3:] = np.outer(PATHS.target[0, 3:], PATHS.target[0, 3:])
    for target, platforms in zip(PATHS.target[1:], PATHS.platforms[1:], strict=True):
        H = np.zeros((4, 6))
        H[:, :3] = direction_jacobian(target, platforms).reshape(4, 3)
        P = phi @ P @ phi.T + Q
        K = P @ H.T @ np.linalg.inv(H @ P @ H.T + R)
        left = eye - K @ H
        P = left @ P @ left.T + K @ R @ K.T
        actual = left @ phi @ actual @ phi.T @ left.T + K @ R @ K.T
        found.append(float(range_std_3d(actual, target, platforms[0])))
    return np.array(found)


def clean_gates() -> np.ndarray:
    """Gate areas [k, 2] rad² of a filter without clutter, γ₂ = 16, along the true path, k = 1 … 40."""
    std, cov = np.full((2, 2), ANGLE_STD), start_bound()
    phi, Q = transition_3d(STEP_S), process_noise_3d(STEP_S, PROCESS_NOISE)
    updated = posterior_bound_information_3d(PATHS.target, PATHS.platforms, cov, std, STEP_S, PROCESS_NOISE)
    predicted = phi @ updated[:-1] @ phi.T + Q
    return gate(PATHS.target[1:], predicted, PATHS.platforms[1:], std, 16.0).area


@cache
def clean_gate() -> float:
    """Average [rad²] of these areas over scans and sensors: a physical density is one number."""
    return float(clean_gates().mean())
