"""What a tracker of a maneuvering target takes and returns: bearings of one target whose lines of sight fix a position.

The verbs are those of `trackers.contract.Tracker` (`initiate`, `predict`, `update`, `estimate`) and `acceleration`.
Every scan holds at most one bearing per station, all of the same target. Where two or more of them cross well they
become a position and its covariance (`trackers.position_fix`), and that pair is what the filters are fed with; where
they do not, the scan has no weight and the track coasts.
"""

from __future__ import annotations

from typing import Any, NamedTuple, Protocol, runtime_checkable

import numpy as np

from trackers.gaussian import Gaussian


class BearingScan(NamedTuple):
    """One bearing per station, all of one instant and one target.

    Attributes:
        bearings: [..., s] rad, counter-clockwise from east; 0 where not valid.
        valid: [..., s] bool.
        stations: [..., s, 2] m, east-north, where the stations are at the scan's instant.
        bearing_std: [..., s] rad.
    """

    bearings: Any
    valid: Any
    stations: Any
    bearing_std: Any

    def over_tracks(self) -> BearingScan:
        """The scan with an axis for tracks: [..., 1, s]."""
        ranks = (1, 1, 2, 1)
        return BearingScan(*(np.expand_dims(part, -rank - 1) for part, rank in zip(self, ranks, strict=True)))

    def check(self) -> None:
        """Refuse what would spread through every number.

        Raises:
            ValueError: bearings or stations that are not finite, a standard deviation that is not positive and finite.
        """
        for name in ("bearings", "stations"):
            part = np.asarray(getattr(self, name))
            if not np.isfinite(part).all():
                at = tuple(int(i) for i in np.argwhere(~np.isfinite(part))[0])
                raise ValueError(f"scan.{name}{list(at)} is {part[at]}: must be finite (0 where a bearing is missing)")
        std = np.asarray(self.bearing_std)
        good = (std > 0.0) & (std < np.inf)
        if not good.all():
            at = tuple(int(i) for i in np.argwhere(~good)[0])
            raise ValueError(f"scan.bearing_std{list(at)} is {std[at]}: must be positive and finite [rad]")


class ManeuverUpdate(NamedTuple):
    """What an update returns.

    Attributes:
        posterior: the tracker's state after the scan.
        innovation: [..., m, 2] m, fix minus predicted position; 0 where the track coasted.
        innovation_cov: [..., m, 2, 2] m²; the prediction's own where the track coasted.
        log_likelihood: [..., m] of the fix under the prediction; 0 where the track coasted.
        model_probability: [..., m, r] of the filters, sum 1.
        detected: [..., m, r] bool, whether a filter finds the target maneuvering (a baseline IMM: never).
        fixed: [..., m] bool, whether the scan fixed a position; False means that the track coasted.
    """

    posterior: Any
    innovation: Any
    innovation_cov: Any
    log_likelihood: Any
    model_probability: Any
    detected: Any
    fixed: Any


@runtime_checkable
class ManeuverTracker(Protocol):
    """Estimates state and acceleration of a maneuvering target (see `trackers.contract.Tracker`)."""

    @property
    def models(self) -> int:
        """Number of filters whose probabilities the updates tell, at first all alike."""
        ...

    def initiate(self, scan: BearingScan) -> Any:
        """One track from the first scan."""
        ...

    def predict(self, state: Any, step_s: float) -> Any:
        """Propagate all tracks by one step."""
        ...

    def update(self, state: Any, scan: BearingScan) -> ManeuverUpdate:
        """Condition the tracks on the scan's fix."""
        ...

    def estimate(self, state: Any) -> Gaussian:
        """Mean [..., m, 4] (x, y [m], vx, vy [m/s], absolute east-north) and covariance [..., m, 4, 4]."""
        ...

    def acceleration(self, state: Any) -> Gaussian:
        """Mean [..., m, 2] m/s² and covariance [..., m, 2, 2]."""
        ...
