"""What all trackers on position fixes share: the first position, fixes from bearings, the verbs."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Any

import numpy as np

from trackers.angle_contract import AngleScan
from trackers.fix_contract import BearingScan, ManeuverUpdate
from trackers.gaussian import Gaussian
from trackers.position_fix import MAX_CONDITION, fix_bearings
from trackers.triangulation_3d import start_tracks


@dataclass(frozen=True)
class FixTracker(ABC):
    """Settings and common verbs (`trackers.fix_contract.ManeuverTracker`).

    Settings, SI units:
        initial_velocity_std: per axis [m/s]; the first velocity is 0.
        floor_m, cap_m: 95 % of the log-normal prior of range lie between them; it counts where the first bearings do
            not fix the position (`trackers.triangulation_3d`).
        max_condition: a fix whose Fisher information is worse conditioned has no weight (`trackers.position_fix`).
    Raises:
        ValueError: a setting outside its range.
    """

    initial_velocity_std: float = 200.0
    floor_m: float = 5.0e3
    cap_m: float = 2.0e5
    max_condition: float = MAX_CONDITION

    def __post_init__(self) -> None:
        for name in ("initial_velocity_std", "floor_m"):
            self.require(0.0 < getattr(self, name) < np.inf, name, "positive and finite")
        self.require(self.floor_m < self.cap_m < np.inf, "cap_m", f"finite and above floor_m {self.floor_m}")
        self.require(1.0 < self.max_condition < np.inf, "max_condition", "finite and above 1")

    def require(self, met: bool, name: str, words: str) -> None:
        """Raise a ValueError that names the setting, its value and what it must be, unless the condition is met."""
        if not met:
            raise ValueError(f"{type(self).__name__}.{name} = {getattr(self, name)!r}: must be {words}")

    def numbers(self, name: str, words: str) -> np.ndarray:
        """The setting `name`, a row of numbers or rows of them, as an array; raises as `require` if it is none."""
        try:
            return np.array(getattr(self, name), dtype=float)
        except (TypeError, ValueError):
            self.require(False, name, words)
            raise

    def initiate(self, scan: BearingScan) -> Any:
        """One track [..., 1, …] at the scan's fix, its velocity unknown; see `triangulation_3d` for a fix that fails.

        Raises:
            ValueError: a scan without any valid bearing.
        """
        scan.check()
        bearings, valid, stations, std = map(np.asarray, scan)
        level = AngleScan(
            np.stack([bearings, np.zeros(bearings.shape)], axis=-1)[..., None, :],
            valid[..., None],
            np.concatenate([stations, np.zeros((*stations.shape[:-1], 1))], axis=-1),
            np.repeat(np.broadcast_to(std, bearings.shape)[..., None], 2, axis=-1),
            np.ones((*bearings.shape, 2), dtype=bool),
            np.zeros(bearings.shape),
        )
        start = start_tracks(level, self.floor_m, self.cap_m, np.full(3, self.initial_velocity_std))
        plane = np.array([0, 1, 3, 4])
        return self.start(Gaussian(start.mean[..., None, plane], start.cov[..., None, plane[:, None], plane]))

    def update(self, state: Any, scan: BearingScan) -> ManeuverUpdate:
        """Condition every track on the scan's fix; without one it coasts."""
        scan.check()
        told = scan.over_tracks()
        return self.update_fix(state, *fix_bearings(*told, self.max_condition))

    def checked_fix(self, position: Any, cov: Any) -> tuple[np.ndarray, np.ndarray]:
        """Measured positions [..., d] m and covariances [..., d, d] as arrays.

        Raises:
            ValueError: entries that are not finite, negative variances.
        """
        position, cov = np.asarray(position, dtype=float), np.asarray(cov, dtype=float)
        if not np.isfinite(position).all():
            raise ValueError("update_fix: position must be finite (0 where there is no fix)")
        if not (np.isfinite(cov).all() and (np.diagonal(cov, axis1=-2, axis2=-1) >= 0.0).all()):
            raise ValueError("update_fix: cov must be finite, its variances not negative (0 where there is no fix)")
        return position, cov

    @staticmethod
    def checked_start(track: Gaussian) -> tuple[np.ndarray, np.ndarray]:
        """Mean [..., 2d] and cov [..., 2d, 2d] of a start as arrays.

        Raises:
            ValueError: not d = 2 or 3, shapes that do not belong together, entries that are not finite.
        """
        mean, cov = (np.asarray(part, dtype=float) for part in track)
        n = mean.shape[-1] if mean.ndim else 0
        if n not in (4, 6) or cov.shape != (*mean.shape, n):
            shapes = f"mean {mean.shape} and cov {cov.shape}"
            raise ValueError(f"start: {shapes}: must be [..., n] and [..., n, n], n = 4 in the plane or 6 in space")
        if not (np.isfinite(mean).all() and np.isfinite(cov).all()):
            raise ValueError("start: mean and cov must be finite")
        return mean, cov

    @property
    @abstractmethod
    def models(self) -> int:
        """Number of filters."""

    @abstractmethod
    def start(self, track: Gaussian) -> Any:
        """State of tracks that begin as mean [..., 2d] (position, velocity) and cov [..., 2d, 2d], d = 2 or 3."""

    @abstractmethod
    def predict(self, state: Any, step_s: float) -> Any:
        """Propagate all tracks by one step."""

    @abstractmethod
    def update_fix(self, state: Any, position: Any, cov: Any, fixed: Any = True) -> ManeuverUpdate:
        """Condition tracks on measured positions [..., d] m with covariances [..., d, d]; `fixed` False: coast."""

    @abstractmethod
    def estimate(self, state: Any) -> Gaussian:
        """Mean [..., m, 2d] m, m/s and covariance [..., m, 2d, 2d]."""

    @abstractmethod
    def acceleration(self, state: Any) -> Gaussian:
        """Mean [..., m, d] m/s² and covariance [..., m, d, d]."""


def transition_matrix(tracker: FixTracker, name: str, models: int) -> np.ndarray:
    """The setting `name` as Π [r, r], row from, column to.

    Raises:
        ValueError: another number of rows or columns than models, or rows that are no probabilities.
    """
    words = f"{models} rows of {models}, one a model"
    matrix = tracker.numbers(name, words)
    tracker.require(matrix.shape == (models, models), name, words)
    good = (matrix >= 0.0).all() and np.allclose(matrix.sum(1), 1.0, rtol=0.0, atol=1e-9)
    tracker.require(bool(good), name, "probabilities, every row summing to 1")
    return matrix
