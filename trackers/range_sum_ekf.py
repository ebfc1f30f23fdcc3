"""Extended Kalman filter on bistatic range sums, with a maneuver test that widens the prediction."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from trackers.gaussian import Gaussian
from trackers.range_sum_contract import RangeSumScan, RangeSumTrack, RangeSumUpdate


@dataclass(frozen=True)
class RangeSumEkf:
    """`trackers.range_sum_contract.RangeSumTracker`; SI units."""

    process_noise: tuple[float, float, float] = (1.0, 1.0, 0.01)
    false_alarm: float = 1e-3
    inflation: float = 100.0
    floor_m: float = 0.0

    def initiate(self, scans: RangeSumScan, guess: Gaussian, times_s: Any) -> RangeSumTrack:
        """Maximum a posteriori state at the last of the scans."""
        raise NotImplementedError

    def predict(self, state: RangeSumTrack, step_s: float) -> RangeSumTrack:
        """Propagate all tracks by one step."""
        raise NotImplementedError

    def update(self, state: RangeSumTrack, scan: RangeSumScan) -> RangeSumUpdate:
        """Condition all tracks on one scan."""
        raise NotImplementedError

    def estimate(self, state: RangeSumTrack) -> Gaussian:
        """Mean [..., 1, 2d] and covariance [..., 1, 2d, 2d]."""
        raise NotImplementedError


@dataclass(frozen=True)
class RangeSumEkfLiteral(RangeSumEkf):
    """Without the maneuver test."""

    false_alarm: float = 0.0
