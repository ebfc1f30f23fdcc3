"""What an operator knows: the only input of observations and policies."""

from __future__ import annotations

from typing import Any, NamedTuple


class Received(NamedTuple):
    """What the platforms' sensors themselves delivered at the last scan; e environments, s platforms, b slots.

    Attributes:
        angles: [e, s, b, 1] azimuths [rad], counter-clockwise from east; in space [e, s, b, 2] with elevations.
        valid: [e, s, b] bool, slots that hold a return; in no order that would tell which is whose.
    """

    angles: Any
    valid: Any


class Reports(NamedTuple):
    """What the last scan brought, as an operator sees it; fields as in `Belief`."""

    assigned: Any
    returns: Any
    missed: Any
    available: Any
    model_probability: Any = ()
    detected: Any = ()
    acceleration: Any = ()
    received: Any = ()


class Belief(NamedTuple):
    """Knowledge after a scan; e environments, s platforms, m tracks, d no-go discs.

    Attributes:
        steps_left: [e] decisions left in the episode.
        platforms: [e, s, n] x, y [m], vx, vy [m/s], east-north; in three dimensions x, y, z, vx, vy, vz.
        mean: [e, m, n] track means.
        cov: [e, m, n, n] track covariances.
        assigned: [e, m, s] bool, which stations' measurements updated the track.
        returns: [e, s] number of returns received; where clutter is dense, of those in the track's gate.
        last_action: [e, a] the previous action, 0 at first.
        track_state: the tracker's own state (hypotheses and their weights for a bank).
        discs: [e, d, 3] no-go discs: centre x, y and radius [m]; d is 0 where there are none.
        missed: [e, m, s] probability, to the tracker's mind, that none of the platform's returns is the target's;
            s is 0 in scenarios whose trackers do not say.
        available: [e, s, 2] bool, whether the platform's azimuths and elevations of the last scan could be used;
            s is 0 in scenarios without dropouts.
        model_probability: [e, m, r] probabilities of a multiple-model tracker's r models; empty, like the next two,
            in scenarios whose trackers have none.
        detected: [e, m, r] bool, models that find the target maneuvering.
        acceleration: [e, m, 2] estimated acceleration [m/s²].
        start: [e, s, n] the platforms at the first scan.
        received: the last scan itself, a `Received`.
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
    missed: Any = None
    available: Any = None
    model_probability: Any = ()
    detected: Any = ()
    acceleration: Any = ()
    start: Any = ()
    received: Any = ()
