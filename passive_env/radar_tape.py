"""The tape of passive radar: sites, paths, the noise and loss of every echo (see `passive_env.tape`)."""

from __future__ import annotations

from typing import Any, NamedTuple


class Echoes(NamedTuple):
    """What would come back if every transmitter were listened to; e environments, t instants, n transmitters.

    Attributes:
        targets: [e, t, m, 2d] true target states; m is 1.
        noise: [e, t, n] standard normal noise of range sums.
        heard: [e, t, n] bool, whether a clear transmitter's echo is received.
        blocked: [e, t, n] bool.
    """

    targets: Any
    noise: Any
    heard: Any
    blocked: Any


class RadarTape(NamedTuple):
    """Randomness of whole episodes; e environments, k + 1 instants, n transmitters, d dimensions.

    Attributes:
        platforms: [e, 1, 2d] the receiver at the first decision.
        discs: [e, 0, 3] there are no no-go discs.
        transmitters: [e, n, d] m.
        guess: [e, 2d] what an operator took the target's state for at the first scan of the acquisition.
        targets, noise, heard, blocked: as of `Echoes`, from the first decision on (t = k + 1).
        accelerations: [e, k + 1, m, 2] level accelerations of maneuvers [m/s²].
        acquisition: the scans from which the track is started; the last one is that of the first decision.
    """

    platforms: Any
    discs: Any
    transmitters: Any
    guess: Any
    targets: Any
    noise: Any
    heard: Any
    blocked: Any
    accelerations: Any
    acquisition: Echoes
