"""Recordings made by the simulator: what a tracker was told in an episode, as a file of `passive-env track`.

The shipped samples are made by ``python -m agents.track_sample FOLDER``.
"""

from __future__ import annotations

import csv
import io
import math
import sys
from collections.abc import Callable, Iterator
from importlib import resources
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from agents.files import atomic_write
from agents.policy import make_policy
from passive_env.catalogue import make_scenario
from passive_env.vector_env import PassiveVectorEnv


class Sample(NamedTuple):
    """How a shipped sample is made: environment, fields, policy and seed."""

    environment: str
    fields: dict[str, Any]
    policy: str
    seed: int


SAMPLES = {
    "rp-ekf": Sample("TwoStation", {"detection_probability": 0.9}, "rule", 3),
    "angle-fusion": Sample("AngleFusion", {"availability1_min": 0.7, "availability1_max": 0.7}, "rule", 3),
    "imm-mie": Sample("ManeuveringTarget", {"detection_probability": 0.95}, "rule", 5),
    "passive-radar": Sample("PassiveRadar", {"steps": 60, "transmitters": 6}, "greedy", 9),
}
"""Shipped samples by the tracker's name."""

SAMPLE_GUESS = (-19556.0, -41855.0, -381.0, 355.0)
"""What the operator of the shipped range sums took for the target's state at the first scan, to the metre."""


class Listener:
    """A tracker that keeps every scan it is told; all else is the inner tracker's.

    Attributes:
        scans: in order; where a track starts from several scans they stand one by one.
        guess: what a track on range sums started from.
    """

    def __init__(self, tracker: Any):
        self._tracker = tracker
        self.scans: list[Any] = []
        self.guess: Any = None

    def __getattr__(self, name: str) -> Any:
        return getattr(self._tracker, name)

    def initiate(self, scan: Any, guess: Any = None, times_s: Any = None) -> Any:
        """The inner tracker's start."""
        if guess is None:
            self.scans = [scan]
            return self._tracker.initiate(scan)
        self.guess = guess
        self.scans = [type(scan)(*(part[:, t] for part in scan)) for t in range(len(times_s))]
        return self._tracker.initiate(scan, guess, times_s)

    def update(self, state: Any, scan: Any) -> Any:
        """The inner tracker's update."""
        self.scans.append(scan)
        return self._tracker.update(state, scan)

    def predict(self, state: Any, step_s: float) -> Any:
        """The inner tracker's prediction."""
        return self._tracker.predict(state, step_s)

    def estimate(self, state: Any) -> Any:
        """The inner tracker's estimate."""
        return self._tracker.estimate(state)


class Episode(NamedTuple):
    """A flown episode of k decisions, as its operator saw it.

    Attributes:
        scenario: that was flown, with its tracker by name.
        scans: that the tracker got, the first ones those from which it started.
        platforms: [scans, s, 2d] at them.
        beliefs: [k + 1] after the tracks' start and every later scan.
        commands: [k] flown, each [1, a].
        listened: [scans, n] bool whom a passive radar listened to; None elsewhere.
        guess: [2d] of a passive radar's operator; None elsewhere.
    """

    scenario: Any
    scans: list[Any]
    platforms: np.ndarray
    beliefs: list[Any]
    commands: list[np.ndarray]
    listened: Any
    guess: Any


def fly_episode(environment: str, fields: dict[str, Any], policy: str, seed: int) -> Episode:
    """Fly an episode and keep what its tracker was told.

    Args:
        environment: a catalogue name; fields: of its scenario.
        policy: one of `agents.policy.policy_names`.
        seed: of the episode.
    """
    scenario = make_scenario(environment, fields)
    listener = Listener(scenario.make_tracker())
    env = PassiveVectorEnv(scenario.replace(tracker=listener), num_envs=1, autoreset_mode="disabled", threads=1)
    observation, _ = env.reset(seed=seed)
    pilot = make_policy(policy, scenario)
    beliefs, commands = [env.belief()], []
    pilot.reset(beliefs[0])
    for _ in range(scenario.steps):
        commands.append(np.array(pilot.act(beliefs[-1], observation), dtype=float))
        observation, *_ = env.step(env.simulation.actions.encode(commands[-1], beliefs[-1]))
        beliefs.append(env.belief())
    later = np.stack([belief.platforms[0] for belief in beliefs])
    before = len(listener.scans) - len(beliefs)
    guess = None if listener.guess is None else listener.guess.mean[0]
    return Episode(
        scenario, listener.scans, np.concatenate([_earlier(later[0], before, scenario.step_s), later]), beliefs,
        commands, _listened(listener.scans, beliefs, scenario, before) if guess is not None else None, guess,
    )  # fmt: skip


def _earlier(first: np.ndarray, scans: int, step_s: float) -> np.ndarray:
    """Platforms [scans, s, 2d] that flew straight to where the first decision finds them [s, 2d]."""
    d = first.shape[-1] // 2
    states = np.tile(first, (scans, 1, 1))
    states[..., :d] += step_s * np.arange(-scans, 0)[:, None, None] * first[:, d:]
    return states


def _listened(scans: list[Any], beliefs: list[Any], scenario: Any, before: int) -> np.ndarray:
    """[scans, n] whom the receiver listened to: all in turn at first, then those chosen."""
    n, at_once = scenario.pool, scenario.listened
    turns = [(np.arange(n) - t * at_once) % n < at_once for t in range(before)]
    return np.array([*turns, *(belief.chosen[0] for belief in beliefs)])


# -- files -------------------------------------------------------------------------------------------------------------


def write_episode(path: str | Path, tracker: str, episode: Episode, radians: bool = False) -> Path:
    """Write an episode as a recording.

    Args:
        path: of the file.
        tracker: one of `SAMPLES`.
        episode: as flown.
        radians: whether angles stand as trackers have them, directions counter-clockwise from east in rad: the file
            then has every bit of them. Otherwise they are bearings from north in degrees.
    """
    rows = ROWS[tracker](episode, radians)
    buffer = io.StringIO()
    writer = csv.DictWriter(buffer, fieldnames=list(rows[0]), lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    return atomic_write(path, buffer.getvalue())


def _angle(value: float, radians: bool) -> dict[str, Any]:
    return {"direction_rad": float(value)} if radians else {"bearing_deg": (90.0 - math.degrees(value)) % 360.0}


def _no_angle(radians: bool) -> dict[str, Any]:
    return {"direction_rad" if radians else "bearing_deg": ""}


def _where(state: np.ndarray) -> dict[str, float]:
    """Columns of a platform's state [2d]."""
    d = len(state) // 2
    places = ("east_m", "north_m", "up_m")[:d]
    speeds = tuple(f"velocity_{name.removesuffix('_m')}_m_s" for name in places)
    return {name: float(value) + 0.0 for name, value in zip((*places, *speeds), state, strict=True)}  # no −0


def _instants(episode: Episode) -> Iterator[tuple[float, Any, np.ndarray]]:
    """Time, scan and platforms [s, 2d] of every scan."""
    for k, (scan, platforms) in enumerate(zip(episode.scans, episode.platforms, strict=True)):
        yield k * episode.scenario.step_s, scan, platforms


def _bearing_rows(episode: Episode, radians: bool) -> list[dict[str, Any]]:
    """A row per bearing, or an empty one where a station got none."""
    rows = []
    for time_s, scan, platforms in _instants(episode):
        for s, state in enumerate(platforms):
            bearings, valid = np.atleast_1d(scan.bearings[0, s]), np.atleast_1d(scan.valid[0, s])
            told = [_angle(value, radians) for value in bearings[valid]] or [_no_angle(radians)]
            rows += [{"time_s": time_s, "station": f"S{s + 1}", **angle, **_where(state)} for angle in told]
    return rows


def _angle_rows(episode: Episode, radians: bool) -> list[dict[str, Any]]:
    """A row per return; a sensor that got nothing has an empty one, and one that was off says so."""
    rows = []
    for time_s, scan, platforms in _instants(episode):
        for s, state in enumerate(platforms):
            returns = scan.angles[0, s][scan.valid[0, s]]
            told = [_pair(azimuth, elevation, radians) for azimuth, elevation in returns]
            empty = _no_angle(radians) | {"elevation_rad" if radians else "elevation_deg": ""}
            more = {
                "available": int(scan.available[0, s].any()),
                "clutter_density_per_rad2": float(scan.clutter_density[0, s]),
            }
            rows += [
                {"time_s": time_s, "station": f"S{s + 1}", **angles, **_where(state), **more}
                for angles in told or [empty]
            ]
    return rows


def _pair(azimuth: float, elevation: float, radians: bool) -> dict[str, Any]:
    up = {"elevation_rad": float(elevation)} if radians else {"elevation_deg": math.degrees(elevation)}
    return _angle(azimuth, radians) | up


def _sum_rows(episode: Episode, radians: bool) -> list[dict[str, Any]]:
    """A row per transmitter listened to, empty where no echo came."""
    rows = []
    for k, (time_s, scan, platforms) in enumerate(_instants(episode)):
        for n in np.flatnonzero(episode.listened[k] | scan.valid[0]):
            site = {f"transmitter_{name}": value for name, value in _where(_standing(scan.transmitters[0, n])).items()
                    if not name.startswith("velocity")}  # fmt: skip
            value = float(scan.range_sums[0, n]) if scan.valid[0, n] else ""
            rows.append(
                {"time_s": time_s, "transmitter": f"T{n + 1}", "range_sum_m": value, **_where(platforms[0]), **site}
            )
    return rows


def _standing(place: np.ndarray) -> np.ndarray:
    return np.concatenate([place, np.zeros_like(place)])


ROWS: dict[str, Callable[[Episode, bool], list[dict[str, Any]]]] = {
    "rp-ekf": _bearing_rows, "angle-fusion": _angle_rows, "imm-mie": _bearing_rows, "passive-radar": _sum_rows,
}  # fmt: skip


def sample_path(tracker: str) -> Path:
    """The shipped sample of a tracker."""
    return Path(str(resources.files("passive_env.data") / f"track_{tracker.replace('-', '_')}.csv"))


def write_samples(folder: str | Path) -> list[Path]:
    """Make all shipped samples anew in a folder."""
    return [
        write_episode(Path(folder) / sample_path(tracker).name, tracker, fly_episode(*sample))
        for tracker, sample in SAMPLES.items()
    ]


if __name__ == "__main__":
    for written in write_samples(sys.argv[1]):
        print(written)
