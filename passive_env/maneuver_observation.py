"""What the agent sees of a maneuvering target's track: flat, bounded, documented fields of the belief, nothing else."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from gymnasium import spaces

from passive_env.belief import Belief
from passive_env.observations import (
    LIMIT,
    Field,
    clip_value,
    mean_sight,
    platform_fields,
    track_fields,
    write_covariance,
    write_platforms,
    write_track,
)
from trackers.compiled import kernel


@kernel("(),(s,x),(m,x),(m,x,x),(m,s),(a),(m,p),(m,r),(m,r),(),(d)->(d)", "fFFFBFFFBfgG")
def _observe(time_left, platforms, mean, cov, assigned, last_action, acceleration, probability, detected, top_speed,
             like, out):  # fmt: skip
    c, s = mean_sight(platforms, mean)
    out[0] = time_left
    i = write_platforms(platforms, c, s, out, 1)
    for p in range(platforms.shape[0]):
        out[i + p] = math.hypot(platforms[p, 2], platforms[p, 3]) / top_speed
    i += platforms.shape[0]
    for k in range(last_action.shape[0]):
        out[i + k] = last_action[k]
    i += last_action.shape[0]
    i, a, b = write_track(mean[0], platforms, False, c, s, out, i)
    i = write_covariance(cov[0], a, b, out, i)
    for p in range(platforms.shape[0]):
        out[i + p] = 1.0 if assigned[0, p] else 0.0
    i += platforms.shape[0]
    ax, ay = acceleration[0, 0], acceleration[0, 1]
    out[i], out[i + 1] = (a * ax + b * ay) / 30.0, (a * ay - b * ax) / 30.0
    i += 2
    share = 0.0
    for r in range(probability.shape[1]):
        share += probability[0, r] if detected[0, r] else 0.0
    out[i] = share
    i += 1
    for r in range(probability.shape[1] - 1):
        out[i + r] = probability[0, r]
    i += probability.shape[1] - 1
    for k in range(i):  # a diverged tracker's NaN reads 0
        out[k] = clip_value(out[k])


class ManeuverObservation:
    """Stations and one track relative to the mean line of sight, its covariance along its own, and its maneuver.

    The mean line of sight ψ runs from the stations' midpoint to the track; the reference station is the last one.

    Fields in order (`fields` names each with its unit and scale); N is a station's or model's number, AXIS one of
    radial, cross, radial_velocity, cross_velocity:

        time_left                                        1     share of the episode's steps
        platformN.along platformN.across                 m     position relative to the reference / 20 km
        platformN.heading_cos platformN.heading_sin      1     of heading − ψ
        platformN.speed                                  m/s   / top speed
        last_actionN                                     1     previous action: turns of all stations, then speeds
        track0.log_range                                 m     log(range from the reference / 50 km)
        track0.bearing_cos track0.bearing_sin            1     of line of sight − ψ
        track0.radial_velocity track0.cross_velocity     m/s   along and left of the line of sight / 300 m/s
        track0.log_rangeN                                m     log(range from another station / 50 km)
        track0.crossing_sinN                             1     sine of the angle to that station's line of sight
        track0.log_std_AXIS                              m     log(standard deviation / 1 km or 50 m/s) / 2
        track0.corr_AXIS_AXIS                            1     correlation coefficient
        track0.assignedN                                 1     1 if the station's azimuth went into the fix
        track0.radial_acceleration track0.cross_…        m/s²  estimate, as of the velocity / 30 m/s²
        track0.detected                                  1     probability of the models that find it maneuvering
        track0.model_probabilityN                        1     of every model but the last

    Positions, ranges and crossing angles are of all stations but the reference. Values are clipped to ±5.

    Args:
        stations, steps: how many.
        models: number of the tracker's models.
        top_speed: of a station [m/s].
    """

    def __init__(self, stations: int, steps: int, models: int, top_speed: float):
        self.fields = tuple(_fields(stations, models))
        self.space = spaces.Box(-LIMIT, LIMIT, (len(self.fields),), np.float32)
        self._like = np.empty(len(self.fields), dtype=np.float32)
        self._steps, self._top_speed = float(steps), top_speed
        self._mirror_sign = np.array([-1 if field.odd else 1 for field in self.fields], dtype=np.float32)

    def __call__(self, belief: Belief) -> Any:
        """Observation [e, d] float32 inside the space."""
        return _observe(
            belief.steps_left / self._steps, belief.platforms, belief.mean, belief.cov, belief.assigned,
            belief.last_action, belief.acceleration, belief.model_probability, belief.detected, self._top_speed,
            self._like,
        )  # fmt: skip

    def mirrored(self, observation: np.ndarray) -> np.ndarray:
        """Observations [..., d] of the mirrored worlds: left is right."""
        return self._mirror_sign * observation


def _fields(stations: int, models: int):
    yield Field("time_left", "1", "share of the episode's steps")
    yield from platform_fields(stations)
    for s in range(stations):
        yield Field(f"platform{s}.speed", "m/s", "/ top speed")
    for a in range(2 * stations):
        yield Field(f"last_action{a}", "1", "previous turn" if a < stations else "previous speed", odd=a < stations)
    yield from track_fields("track0", stations)
    for s in range(stations):
        yield Field(f"track0.assigned{s}", "1", f"1 if station {s}'s azimuth went into the fix")
    yield Field("track0.radial_acceleration", "m/s²", "/ 30 m/s²")
    yield Field("track0.cross_acceleration", "m/s²", "/ 30 m/s², left positive", odd=True)
    yield Field("track0.detected", "1", "probability of the models that find it maneuvering")
    for r in range(models - 1):
        yield Field(f"track0.model_probability{r}", "1", f"of model {r}")
