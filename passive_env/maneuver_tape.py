"""The tape of scenarios with a maneuvering target: path, acceleration, azimuth noise (see `passive_env.tape`)."""

from __future__ import annotations

from typing import Any, NamedTuple


class ManeuverTape(NamedTuple):
    """Randomness of whole episodes; e environments, k + 1 instants, s stations, m targets.

    Attributes:
        platforms: [e, s, 4] start states of the stations.
        targets: [e, k + 1, m, 4] true target states; m is 1.
        accelerations: [e, k + 1, m, 2] true accelerations [m/s²].
        discs: [e, 0, 3] there are no no-go discs.
        noise: [e, k + 1, s] standard normal noise of azimuths.
        detected: [e, k + 1, s] bool, whether a station that measures sees the target.
    """

    platforms: Any
    targets: Any
    accelerations: Any
    discs: Any
    noise: Any
    detected: Any
