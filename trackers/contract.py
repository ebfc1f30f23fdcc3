"""What a tracker is: the contract between an environment (or a user's loop) and an estimator.

A tracker object holds settings only. Its state goes in and comes out of every call, so one object serves any number
of environments, targets and Monte-Carlo runs, which lie on the leading axes.
"""

from __future__ import annotations

from typing import Any, NamedTuple, Protocol, runtime_checkable

from trackers.gaussian import Gaussian


class Scan(NamedTuple):
    """Unlabelled bearings of one instant: nobody says which target a bearing came from, if any.

    Attributes:
        bearings: [..., s, b] rad, counter-clockwise from east; slots that are not valid hold 0.
        valid: [..., s, b] bool.
        stations: [..., s, 2] station positions [m].
        bearing_std: [] rad.
    """

    bearings: Any
    valid: Any
    stations: Any
    bearing_std: Any

    def reference_only(self) -> Scan:
        """The last station's part of the scan."""
        return Scan(self.bearings[..., -1:, :], self.valid[..., -1:, :], self.stations[..., -1:, :], self.bearing_std)


class Update(NamedTuple):
    """What an update returns.

    Attributes:
        posterior: the tracker's state after the scan.
        innovation: [..., m, s] rad; 0 where the station's bearing was missed (hypotheses are averaged).
        innovation_var: [..., m, s] rad².
        log_likelihood: [..., m] of the assigned bearings under the prediction.
        assignment: [..., m, s] slot of the scan that updated the track, −1 for none.
    """

    posterior: Any
    innovation: Any
    innovation_var: Any
    log_likelihood: Any
    assignment: Any


@runtime_checkable
class Tracker(Protocol):
    """Estimates the states of m targets from scans of unlabelled bearings.

    The environment calls `initiate` once with the first scan, then `predict` and `update` once per step, and
    `estimate` whenever it needs the tracks. States are NamedTuples (or any nesting of tuples) of arrays whose first
    axis is the environment, so that finished environments can be replaced row by row.
    """

    def initiate(self, scan: Scan) -> Any:
        """One track per valid bearing of the reference station (the last one), in the order of its slots."""
        ...

    def predict(self, state: Any, step_s: float) -> Any:
        """Propagate all tracks by one step."""
        ...

    def update(self, state: Any, scan: Scan) -> Update:
        """Associate the scan with the tracks and condition on it."""
        ...

    def estimate(self, state: Any) -> Gaussian:
        """Mean [..., m, 4] (x, y [m], vx, vy [m/s], absolute east-north) and covariance [..., m, 4, 4]."""
        ...
