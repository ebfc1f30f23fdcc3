"""What a critic may know while a policy learns: the truth behind the belief. No policy ever sees it."""

from __future__ import annotations

import numpy as np

from passive_env.core import World
from passive_env.observations import LIMIT, Field


class TruthObservation:
    """Each target's true range, motion and track error, as numbers of an observation's size.

    Fields in order, of every target N, along and left of the line of sight from the reference:

        truthN.log_range                     m     log(true range / 50 km)
        truthN.log_range_ratio               1     2 log(range of the track / true range)
        truthN.radial_velocity               m/s   true velocity relative to earth / 300 m/s
        truthN.cross_velocity                m/s   the same, left positive
        truthN.radial_velocity_error         m/s   track − truth, / 100 m/s
        truthN.cross_velocity_error          m/s   the same, left positive
        truthN.log_range_bound               m     log(Cramér–Rao bound / 1 km) / 2

    Values are clipped to ±5 and finite whatever the tracker does.

    Args:
        targets: number of targets.
        reference: index of the platform from which ranges are measured.
    """

    def __init__(self, targets: int, reference: int = -1):
        self.fields = tuple(field for m in range(targets) for field in _fields(f"truth{m}"))
        self._reference = reference
        order = np.arange(len(self.fields)).reshape(targets, -1)[::-1]
        self._mirror_of = order.ravel()
        self._mirror_sign = np.array([-1 if field.odd else 1 for field in self.fields], dtype=np.float32)

    def __call__(self, world: World) -> np.ndarray:
        """Numbers [e, d] float32 in ±`LIMIT`."""
        own = world.platforms[:, self._reference, None]
        d = own.shape[-1] // 2
        truth, mean = world.truth, world.estimate.mean
        with np.errstate(all="ignore"):  # a diverged tracker's numbers are cut below
            sight = truth[..., :d] - own[..., :d]
            true_range = np.maximum(np.linalg.norm(sight, axis=-1), 1.0)
            track_range = np.maximum(np.linalg.norm(mean[..., :d] - own[..., :d], axis=-1), 1.0)
            sight = sight / true_range[..., None]
            error = mean[..., d:] - truth[..., d:]
            parts = (
                np.log(true_range / 5e4), 2.0 * np.log(track_range / true_range),
                *(part / 300.0 for part in _along_and_left(truth[..., d:], sight)),
                *(part / 100.0 for part in _along_and_left(error, sight)),
                0.5 * np.log(np.maximum(world.metrics.range_crlb_m, 1.0) / 1e3),
            )  # fmt: skip
            numbers = np.nan_to_num(np.stack(parts, axis=-1), posinf=LIMIT, neginf=-LIMIT)
        return np.clip(numbers, -LIMIT, LIMIT).reshape(len(own), -1).astype(np.float32)

    def mirrored(self, numbers: np.ndarray) -> np.ndarray:
        """Numbers [..., d] of the mirrored worlds: left is right, and the targets stand in reverse order."""
        return self._mirror_sign * numbers[..., self._mirror_of]


AHEAD_S = (0.0, 5.0, 15.0)
"""Instants, from now, whose true accelerations a critic may know."""


class ManeuverTruthObservation:
    """What `TruthObservation` shows of a single target, and its maneuver, now and soon.

    Fields after those, along and left of the line of sight from the reference:

        truth0.radial_accelerationN truth0.cross_accelerationN  m/s²  true, at the N-th of `AHEAD_S`, / 30 m/s²
        truth0.radial_acceleration_error truth0.cross_…         m/s²  estimate − truth, / 30 m/s²
        truth0.log_position_bound                               m     log(bound / 100 m) / 2

    Args:
        step_s: time between scans [s].
        reference: index of the platform from which ranges are measured.
    """

    def __init__(self, step_s: float, reference: int = -1):
        self._truth = TruthObservation(1, reference)
        self.fields = (*self._truth.fields, *_maneuver_fields("truth0"))
        self._reference = reference
        self._ahead = np.rint(np.array(AHEAD_S) / step_s).astype(np.int64)
        self._mirror_sign = np.array([-1 if field.odd else 1 for field in self.fields], dtype=np.float32)

    def __call__(self, world: World) -> np.ndarray:
        """Numbers [e, d] float32 in ±`LIMIT`."""
        sight = world.truth[:, 0, :2] - world.platforms[:, self._reference, :2]
        sight = sight / np.maximum(np.linalg.norm(sight, axis=-1, keepdims=True), 1.0)
        known = world.tape.accelerations[:, :, 0]
        at = np.minimum(world.step[:, None] + self._ahead, known.shape[1] - 1)
        with np.errstate(all="ignore"):  # a diverged tracker's numbers are cut below
            error = world.reports.acceleration[:, 0] - world.reports.true_acceleration[:, 0]
            vectors = np.concatenate([np.take_along_axis(known, at[..., None], axis=1), error[:, None]], axis=1) / 30.0
            parts = np.stack(_along_and_left(vectors, sight[:, None]), axis=-1).reshape(len(at), -1)
            bound = 0.5 * np.log(np.maximum(world.metrics.position_crlb_m, 1.0) / 100.0)
            numbers = np.nan_to_num(np.hstack([parts, bound]), posinf=LIMIT, neginf=-LIMIT)
        return np.hstack([self._truth(world), np.clip(numbers, -LIMIT, LIMIT).astype(np.float32)])

    def mirrored(self, numbers: np.ndarray) -> np.ndarray:
        """Numbers [..., d] of the mirrored worlds: left is right."""
        return self._mirror_sign * numbers


SCANS_AHEAD = (5, 10, 20)
"""Scans to come of which a critic of a passive radar is told who will be blocked."""


class RadarTruthObservation:
    """What `TruthObservation` shows of a passive radar's target, and which transmitters are blocked now.

    Fields after those:

        truth0.log_horizontal_bound          m     log(bound / 100 m) / 2
        truth0.blockedN                      1     1 if transmitter N is
        truth0.blockedN_in_K                 1     share of the K scans to come in which it is, K each of `SCANS_AHEAD`

    Args:
        pool: number of transmitters.

    Attributes:
        shared: how many fields are not a transmitter's; of the others, each kind's stand together.
    """

    def __init__(self, pool: int):
        self._truth = TruthObservation(1)
        bound = Field("truth0.log_horizontal_bound", "m", "log(Cramér–Rao bound / 100 m) / 2")
        blocked = [Field(f"truth0.blocked{n}", "1", f"1 if transmitter {n} is blocked") for n in range(pool)]
        blocked += [
            Field(f"truth0.blocked{n}_in_{k}", "1", f"share of {k} scans in which transmitter {n} will be blocked")
            for k in SCANS_AHEAD
            for n in range(pool)
        ]
        self.fields = (*self._truth.fields, bound, *blocked)
        self.shared = len(self._truth.fields) + 1

    def __call__(self, world: World) -> np.ndarray:
        """Numbers [e, d] float32 in ±`LIMIT`."""
        bound = 0.5 * np.log(np.maximum(world.metrics.horizontal_crlb_m, 1.0) / 100.0)
        numbers = np.clip(np.hstack([bound, world.reports.blocked, *self._soon(world)]), -LIMIT, LIMIT)
        return np.hstack([self._truth(world), numbers.astype(np.float32)])

    def _soon(self, world: World) -> list[np.ndarray]:
        """Shares [e, n] of `SCANS_AHEAD` scans to come that are blocked; past the tape's end as at it."""
        hidden = world.tape.blocked
        later = np.minimum(world.step[:, None] + np.arange(1, max(SCANS_AHEAD) + 1), hidden.shape[1] - 1)
        ahead = hidden[np.arange(len(hidden))[:, None], later]
        return [ahead[:, :k].mean(axis=1) for k in SCANS_AHEAD]

    def mirrored(self, numbers: np.ndarray) -> np.ndarray:
        """Numbers [..., d] of the mirrored worlds: left is right, every transmitter keeps its number."""
        shared = len(self._truth.fields)
        return np.concatenate([self._truth.mirrored(numbers[..., :shared]), numbers[..., shared:]], axis=-1)


def _maneuver_fields(name: str):
    for i, ahead in enumerate(AHEAD_S):
        yield Field(f"{name}.radial_acceleration{i}", "m/s²", f"/ 30 m/s², in {ahead:g} s")
        yield Field(f"{name}.cross_acceleration{i}", "m/s²", f"/ 30 m/s², in {ahead:g} s, left positive", odd=True)
    yield Field(f"{name}.radial_acceleration_error", "m/s²", "estimate − truth, / 30 m/s²")
    yield Field(f"{name}.cross_acceleration_error", "m/s²", "estimate − truth, / 30 m/s², left positive", odd=True)
    yield Field(f"{name}.log_position_bound", "m", "log(Cramér–Rao bound / 100 m) / 2")


def _along_and_left(velocity: np.ndarray, sight: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Parts of velocities [..., d] along unit vectors [..., d] and level to their left."""
    left = sight[..., 0] * velocity[..., 1] - sight[..., 1] * velocity[..., 0]
    return np.sum(velocity * sight, axis=-1), left / np.maximum(np.hypot(sight[..., 0], sight[..., 1]), 1e-9)


def _fields(name: str):
    yield Field(f"{name}.log_range", "m", "log(true range / 50 km)")
    yield Field(f"{name}.log_range_ratio", "1", "2 log(range of the track / true range)")
    for error, scale in (("", "/ 300 m/s"), ("_error", "track − truth, / 100 m/s")):
        yield Field(f"{name}.radial_velocity{error}", "m/s", scale)
        yield Field(f"{name}.cross_velocity{error}", "m/s", f"{scale}, left positive", odd=True)
    yield Field(f"{name}.log_range_bound", "m", "log(Cramér–Rao bound / 1 km) / 2")
