"""What a 3-D angle tracker takes and returns: azimuth and elevation of one target from any number of platforms.

The verbs are those of `trackers.contract.Tracker` (`initiate`, `predict`, `update`, `estimate`); the state is a
`Gaussian` over x, y, z [m], vx, vy, vz [m/s], absolute, east-north-up, with an axis of m tracks before it. Tracks take
their returns independently of each other. Range is counted from platform 0.
"""

from __future__ import annotations

from typing import Any, NamedTuple, Protocol, runtime_checkable

import numpy as np

from trackers.gaussian import Gaussian

LARGEST_STD = 1e3
"""Largest standard deviation of an angle [rad]: says nothing at all, and its square is still a number."""


class AngleScan(NamedTuple):
    """Returns of one instant: nobody says which of them, if any, is the target's.

    Attributes:
        angles: [..., s, b, 2] rad, azimuth counter-clockwise from east in (−π, π] and elevation; slots that are not
            valid hold 0.
        valid: [..., s, b] bool.
        platforms: [..., s, 3] m, east-north-up.
        angle_std: [..., s, 2] rad, of azimuth and elevation.
        available: [..., s, 2] bool per measured component; False carries no information.
        clutter_density: [..., s] false returns per scan and rad²; not positive or NaN: unknown.
    """

    angles: Any
    valid: Any
    platforms: Any
    angle_std: Any
    available: Any
    clutter_density: Any

    def over_tracks(self) -> AngleScan:
        """The scan with an axis for tracks: [..., 1, s, ...]."""
        ranks = (3, 2, 2, 2, 2, 1)
        return AngleScan(*(np.expand_dims(part, -rank - 1) for part, rank in zip(self, ranks, strict=True)))

    def check(self) -> None:
        """Refuse what would spread through every number.

        Raises:
            ValueError: angles or platforms that are not finite, a standard deviation outside (0, `LARGEST_STD`],
                an infinite clutter density, flags that are not bool.
        """
        for name in ("angles", "platforms"):
            part = np.asarray(getattr(self, name))
            self._require(np.isfinite(part), name, "must be finite (0 in slots that are not valid)")
        std = np.asarray(self.angle_std)
        self._require((std > 0.0) & (std <= LARGEST_STD), "angle_std", f"must be positive, {LARGEST_STD:g} rad at most")
        unknown = "must be finite; 0 or NaN says that nobody knows it"
        self._require(~np.isinf(self.clutter_density), "clutter_density", unknown)
        for name in ("valid", "available"):
            dtype = np.asarray(getattr(self, name)).dtype
            if dtype != np.bool_:
                raise ValueError(
                    f"scan.{name} holds {dtype}: must be bool, a return or component arrives or it does not"
                )

    def _require(self, holds: np.ndarray, name: str, allowed: str) -> None:
        """Refuse the first value of a field for which something does not hold."""
        if not holds.all():
            at = tuple(int(i) for i in np.argwhere(~holds)[0])
            raise ValueError(f"scan.{name}{list(at)} is {np.asarray(getattr(self, name))[at]}: {allowed}")

    def sensor(self, s: int) -> AngleScan:
        """The part of one sensor, its axis kept."""
        at = slice(s, s + 1)
        return AngleScan(
            self.angles[..., at, :, :],
            self.valid[..., at, :],
            self.platforms[..., at, :],
            self.angle_std[..., at, :],
            self.available[..., at, :],
            self.clutter_density[..., at],
        )


class AngleUpdate(NamedTuple):
    """What an update returns.

    Attributes:
        posterior: the tracker's state after the scan.
        innovation: [..., m, s, 2] rad, averaged with the association weights; 0 where nothing was used.
        innovation_cov: [..., m, s, 2, 2] rad², H P Hᵀ + R of each sensor.
        log_likelihood: [..., m] of the scan under the prediction; with clutter, of the scan relative to "all false".
        assignment: [..., m, s] slot with the largest weight, −1 where "none" weighs most.
        validated: [..., m, s] returns in the gate.
        missed: [..., m, s] weight of "this sensor did not supply the target"; 1 where nothing is available.
        dropped: [..., m, s] returns in the gate beyond the largest number that is weighed; the nearest are kept.
    """

    posterior: Any
    innovation: Any
    innovation_cov: Any
    log_likelihood: Any
    assignment: Any
    validated: Any
    missed: Any
    dropped: Any


@runtime_checkable
class AngleTracker(Protocol):
    """Estimates target states in space from scans of azimuths and elevations (see `trackers.contract.Tracker`)."""

    def initiate(self, scan: AngleScan) -> Any:
        """One track from the first scan."""
        ...

    def predict(self, state: Any, step_s: float) -> Any:
        """Propagate all tracks by one step."""
        ...

    def update(self, state: Any, scan: AngleScan) -> AngleUpdate:
        """Associate the scan with the tracks and condition on it."""
        ...

    def estimate(self, state: Any) -> Gaussian:
        """Mean [..., m, 6] and covariance [..., m, 6, 6]."""
        ...
