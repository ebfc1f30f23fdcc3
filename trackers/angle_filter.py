"""What all trackers on azimuth and elevation share: settings, first position, motion, a fresh start of lost tracks."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass

import numpy as np

from trackers.angle_contract import AngleScan, AngleUpdate
from trackers.direction import std_with_curvature
from trackers.gaussian import Gaussian
from trackers.motion_3d import predict_3d
from trackers.outliers import TESTS
from trackers.triangulation_3d import restart_tracks, start_tracks

LOST_SHARE = 0.25
"""Position standard deviation over range above which a track's own covariance calls it lost."""


@dataclass(frozen=True)
class AngleFilter(ABC):
    """Settings and common verbs; state [..., m, 6] (`trackers.angle_contract`).

    Settings, SI units:
        process_noise: √q [m/s²] per axis, an acceleration held over each step.
        gate: γ₂ of each sensor's gate; fused_gate: γ₄ of pairs of returns.
        detection_probability: P_D in (0, 1], one number or one per sensor.
        clutter_known: use the scan's clutter density where it is positive; otherwise m/V, from the returns in the gate.
        initial_velocity_std: east, north, up [m/s]; the first velocity is 0.
        outlier_test: None, "conditioned" or "coplanarity" at 99 % (`trackers.outliers`).
        second_order: whether the curvature of azimuth and elevation adds to their variance. While range is poorly known
            a scan says less than its slope promises (`trackers.direction.std_with_curvature`).
        reinitiate: start a track afresh from a scan's fix once its own covariance calls it lost (`LOST_SHARE`).
        floor_m, cap_m: 95 % of the log-normal prior of range lie between them; it counts where the first directions
            do not fix the position (`trackers.triangulation_3d`).
    Raises:
        ValueError: a setting outside its range.
    """

    process_noise: float = 30.0
    gate: float = 16.0
    fused_gate: float = 18.47
    detection_probability: float | tuple[float, ...] = 1.0
    clutter_known: bool = True
    initial_velocity_std: tuple[float, float, float] = (200.0, 200.0, 50.0)
    outlier_test: str | None = None
    second_order: bool = False
    reinitiate: bool = False
    floor_m: float = 5.0e3
    cap_m: float = 2.0e5

    def __post_init__(self):
        for name in ("gate", "fused_gate", "floor_m"):
            if not 0.0 < getattr(self, name) < np.inf:
                raise ValueError(f"{name} {getattr(self, name)}: must be positive and finite")
        if not 0.0 <= self.process_noise < np.inf:
            raise ValueError(f"process_noise {self.process_noise}: must be finite and not negative")
        p_d = np.asarray(self.detection_probability, dtype=float)
        if not ((p_d > 0.0) & (p_d <= 1.0)).all():
            raise ValueError(f"detection_probability {self.detection_probability}: must lie in (0, 1]")
        if not self.floor_m < self.cap_m < np.inf:
            raise ValueError(f"cap_m {self.cap_m}: must be finite and above floor_m {self.floor_m}")
        if np.shape(self.initial_velocity_std) != (3,) or not (np.array(self.initial_velocity_std) > 0.0).all():
            raise ValueError(f"initial_velocity_std {self.initial_velocity_std}: must be three positive numbers [m/s]")
        if self.outlier_test is not None and self.outlier_test not in TESTS:
            known = ", ".join(map(repr, TESTS))
            raise ValueError(f"outlier_test {self.outlier_test!r}: must be None or one of {known}")

    def initiate(self, scan: AngleScan) -> Gaussian:
        """One track [..., 1, 6] at the fix of the scan's returns; see `triangulation_3d` for a fix that fails."""
        scan.check()
        start = start_tracks(scan, self.floor_m, self.cap_m, np.array(self.initial_velocity_std))
        return Gaussian(start.mean[..., None, :], start.cov[..., None, :, :])

    def predict(self, state: Gaussian, step_s) -> Gaussian:
        """Propagate all tracks by one step."""
        return predict_3d(state, step_s, self.process_noise)

    @abstractmethod
    def update(self, state: Gaussian, scan: AngleScan) -> AngleUpdate:
        """Associate the scan with the tracks and condition on it."""

    def estimate(self, state: Gaussian) -> Gaussian:
        """Mean [..., m, 6] and covariance [..., m, 6, 6]."""
        return state

    def detection(self, scan: AngleScan) -> np.ndarray:
        """P_D [s] of the scan's sensors.

        Raises:
            ValueError: settings for another number of sensors.
        """
        sensors = np.shape(scan.platforms)[-2]
        if np.size(self.detection_probability) not in (1, sensors):
            given = np.size(self.detection_probability)
            raise ValueError(f"detection_probability has {given} values: must be one number or {sensors}, one a sensor")
        return np.broadcast_to(np.asarray(self.detection_probability, dtype=float), (sensors,))

    def around(self, prior: Gaussian, scan: AngleScan) -> AngleScan:
        """The scan as a linearisation at the prior may use it: with the curvature's variance if settings say so."""
        if not self.second_order:
            return scan
        return scan._replace(angle_std=std_with_curvature(prior, scan.platforms, scan.angle_std))

    def renew(self, state: Gaussian, scan: AngleScan) -> Gaussian:
        """The state, lost tracks started afresh if the settings say so; `scan` with the state's leading axes."""
        if not self.reinitiate:
            return state
        speed = np.array(self.initial_velocity_std)
        return Gaussian(*restart_tracks(state, scan, self.floor_m, self.cap_m, speed, LOST_SHARE)[:2])
