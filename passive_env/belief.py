"""What an operator knows: the only input of observations and policies."""

from __future__ import annotations

from typing import Any, NamedTuple


class Belief(NamedTuple):
    """Knowledge after a scan; e environments, s platforms, m tracks, d no-go discs.

    Attributes:
        steps_left: [e] decisions left in the episode.
        platforms: [e, s, 4] x, y [m], vx, vy [m/s], east-north.
        mean: [e, m, 4] track means.
        cov: [e, m, 4, 4] track covariances.
        assigned: [e, m, s] bool, which stations' bearings updated the track.
        returns: [e, s] number of bearings received.
        last_action: [e, a] the previous action, 0 at first.
        track_state: the tracker's own state (hypotheses and their weights for a bank).
        discs: [e, d, 3] no-go discs: centre x, y and radius [m]; d is 0 where there are none.
    """

    steps_left: Any
    platforms: Any
    mean: Any
    cov: Any
    assigned: Any
    returns: Any
    last_action: Any
    track_state: Any
    discs: Any
