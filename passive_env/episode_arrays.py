"""Whole episodes as arrays: where everybody was, what the sensors said, what the tracker made of it."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from gymnasium.utils import seeding

from passive_env.angle_sensors import AngleSensors
from passive_env.core import World
from passive_env.maneuver_sensors import AzimuthSensors
from passive_env.radar_sensors import SumReceiver
from passive_env.sensors import DirectionFinders
from trackers.angle_contract import AngleScan
from trackers.contract import Scan
from trackers.fix_contract import BearingScan
from trackers.range_sum_contract import RangeSumScan

KINDS = (DirectionFinders, AngleSensors, AzimuthSensors, SumReceiver)
"""Sensors whose scans are known here."""


class Returns(NamedTuple):
    """What sensors said; e episodes, k + 1 instants, s stations, b slots, c measured components.

    Stations are the platforms; of a passive radar the transmitters whose echoes its receiver hears.

    Attributes:
        values: [e, k + 1, s, b, c] bearing, or azimuth and elevation [rad], or range sum [m]; slots that are not valid
            hold 0.
        valid: [e, k + 1, s, b] bool.
        origin: [e, k + 1, s, b] number of the target behind it, −1 for a false return or an empty slot.
        std: [e, k + 1, s, c] rad or m, as told to the tracker.
    """

    values: Any
    valid: Any
    origin: Any
    std: Any


class EpisodeArrays(NamedTuple):
    """Flown episodes; e episodes, k + 1 instants, s stations, m targets, states of d numbers.

    Attributes:
        times_s: [k + 1] since the first scan, to the microsecond.
        platforms: [e, k + 1, s, d] m, m/s: positions, then velocities, east-north(-up).
        truth: [e, k + 1, m, d] true target states.
        mean: [e, k + 1, m, d] track means; track j is that of target j.
        cov: [e, k + 1, m, d, d] their covariances.
        returns: what the sensors said.
        transmitters: [e, s, d / 2] m, of a passive radar; elsewhere there are none, s is 0.
    """

    times_s: Any
    platforms: Any
    truth: Any
    mean: Any
    cov: Any
    returns: Returns
    transmitters: Any

    def scan(self, k: int) -> Scan:
        """The bearings of instant k of all episodes, as trackers of bearings take them.

        Raises:
            ValueError: what was measured are no bearings, or not all equally accurate.
        """
        values, valid, _, std = (part[:, k] for part in self.returns)
        if values.shape[-1] != 1 or self.transmitters.size or np.ptp(self.returns.std) > 0.0:
            raise ValueError("scan(k) needs bearings of one accuracy, not another quantity or several accuracies")
        return Scan(values[..., 0], valid, self.platforms[:, k, :, :2], std.flat[0])


class Watched:
    """Sensors that remember their sightings.

    Attributes:
        sightings: one per scan so far; of the several with which a passive radar begins only the last.
    """

    def __init__(self, sensors: Any):
        self._sensors, self.sightings = sensors, []

    def __getattr__(self, name: str) -> Any:
        return getattr(self._sensors, name)

    def acquire(self, *arguments: Any) -> Any:
        """The first scan, or scans."""
        first, second = self._sensors.acquire(*arguments)
        self.sightings = [first[-1] if isinstance(first, list) else second]
        return first, second

    def sense(self, *arguments: Any) -> Any:
        """A later scan."""
        self.sightings.append(self._sensors.sense(*arguments))
        return self.sightings[-1]


def record(scenario: Any, policy: Any, episodes: int = 1, seed: int = 0) -> EpisodeArrays:
    """Fly a policy through episodes seed … seed + episodes − 1, as the environments do, and keep everything.

    Args:
        scenario: one whose sensors measure bearings, azimuth and elevation, or range sums.
        policy: with ``reset(belief)`` and ``act(belief, observation)`` (`agents.policy.Policy`).
        episodes, seed: how many, and the seed of the first.
    Raises:
        ValueError: fewer than one episode, or sensors that measure something else.
    """
    if episodes < 1:
        raise ValueError(f"episodes = {episodes}: must be at least 1")
    simulation = scenario.make_simulation()
    _check_kind(scenario, simulation)
    simulation.sensors = watched = Watched(simulation.sensors)
    world = simulation.begin([seeding.np_random(seed + i)[0] for i in range(episodes)])
    worlds, codec = [world], simulation.actions
    policy.reset(simulation.belief(world))
    for _ in range(scenario.steps):
        belief = simulation.belief(world)
        action = codec.encode(policy.act(belief, simulation.observe(world)), belief)
        world, *_ = simulation.advance(world, simulation.command(world, codec.decode(action, episodes)))
        worlds.append(world)
    return _gathered(scenario, worlds, watched.sightings)


def _check_kind(scenario: Any, simulation: Any) -> None:
    """Refuse scenarios whose scans are none of those known here."""
    if not isinstance(getattr(simulation, "sensors", None), KINDS):
        raise ValueError(
            f"{type(scenario).__name__}: its sensors measure neither bearings, nor azimuth and elevation, nor range "
            "sums; only episodes of those that do can be recorded"
        )


def _gathered(scenario: Any, worlds: list[World], sightings: list[Any]) -> EpisodeArrays:
    def stacked(parts: Any) -> np.ndarray:
        return np.stack(list(parts), axis=1)

    slots = sightings[-1].scan.valid.shape[-1]
    returns = [_returns(sighting, slots) for sighting in sightings]
    return EpisodeArrays(
        np.round(scenario.step_s * np.arange(scenario.steps + 1), 6),
        stacked(world.platforms for world in worlds),
        stacked(world.truth for world in worlds),
        stacked(world.estimate.mean for world in worlds),
        stacked(world.estimate.cov for world in worlds),
        Returns(*(stacked(column) for column in zip(*returns, strict=True))),
        np.array(getattr(sightings[0].scan, "transmitters", np.empty((len(worlds[0].truth), 0, 0)))),
    )


def _returns(sighting: Any, slots: int) -> Returns:
    """A sighting's returns with so many slots; the first scan may have fewer."""
    scan = sighting.scan
    if isinstance(scan, (BearingScan, RangeSumScan)):  # one slot, always the target's
        values, valid, std = scan[0], scan.valid[..., None], scan[-1]
        return Returns(values[..., None, None], valid, np.where(valid, 0, -1), np.array(std)[..., None])
    if isinstance(scan, AngleScan):
        return Returns(scan.angles, scan.valid, sighting.origin, np.array(scan.angle_std))
    origin = sighting.origin[..., : scan.valid.shape[-1]]
    std = np.full((*scan.valid.shape[:2], 1), scan.bearing_std)
    spare = ((0, 0), (0, 0), (0, slots - scan.valid.shape[-1]))
    bearings, valid = np.pad(scan.bearings, spare), np.pad(scan.valid, spare)
    return Returns(bearings[..., None], valid, np.pad(origin, spare, constant_values=-1), std)
