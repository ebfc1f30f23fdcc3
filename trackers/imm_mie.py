"""Interacting filters with modified input estimation (being filled)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from trackers.fix_contract import BearingScan, ManeuverUpdate
from trackers.gaussian import Gaussian


@dataclass(frozen=True)
class ImmMie:
    """Bank of input-estimating filters."""

    initial_velocity_std: float = 200.0

    def initiate(self, scan: BearingScan) -> Any:
        """One track from the first scan."""
        raise NotImplementedError

    def predict(self, state: Any, step_s: float) -> Any:
        """Propagate all tracks by one step."""
        raise NotImplementedError

    def update(self, state: Any, scan: BearingScan) -> ManeuverUpdate:
        """Condition the tracks on the scan's fix."""
        raise NotImplementedError

    def estimate(self, state: Any) -> Gaussian:
        """Mean [..., m, 4] and covariance [..., m, 4, 4]."""
        raise NotImplementedError

    def acceleration(self, state: Any) -> Gaussian:
        """Mean [..., m, 2] m/s² and covariance [..., m, 2, 2]."""
        raise NotImplementedError
