"""Soak test: millions of random-action steps through scenarios at the edge of what the fields allow.

    python benchmarks/soak.py --steps 10000000

After every step all that the environment hands out must be finite and inside its bounds: observation, reward, every
field of info, the tracks and their covariances. The first violation stops the run with scenario, step and row.
The test suite flies the same scenarios for fewer steps (tests/test_world.py).
"""

from __future__ import annotations

import argparse
import dataclasses
import time
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from passive_env import PassiveVectorEnv
from passive_env.catalogue.bearings import BearingScenario
from passive_env.catalogue.maneuvering import ManeuveringTarget
from passive_env.catalogue.ownship import Ownship
from passive_env.catalogue.tracking import TrackingScenario
from passive_env.catalogue.two_station import TwoStation


def all_terms(family: type) -> dict[str, float]:
    """A weight for every reward term that a family of scenarios has."""
    return {field.name: 1.0 for field in dataclasses.fields(family) if field.name.startswith("reward_")}


ALL_TERMS = all_terms(BearingScenario) | {"standoff_m": 1e5}
MANEUVER_TERMS = all_terms(ManeuveringTarget)
OVERHEAD = {
    "range_min_m": 1e3,
    "range_max_m": 1e3,
    "baseline_min_m": 100.0,
    "baseline_max_m": 100.0,
    "station_speed_m_s": 1000.0,
    "max_turn_rate_deg_s": 45.0,
    "target_speed_min_m_s": 1.0,
    "target_speed_max_m_s": 2000.0,
}
FAR = {"range_min_m": 1e6, "range_max_m": 1e6, "baseline_min_m": 1e6, "baseline_max_m": 1e6}


@dataclass(frozen=True, kw_only=True)
class OnTop(BearingScenario):
    """Targets sit exactly on the stations: bearings of zero distance."""

    def draw_tape(self, generators):
        tape = super().draw_tape(generators)
        targets = tape.targets.copy()
        for m in range(self.targets):
            targets[:, :, m, :] = tape.platforms[:, None, m % self.stations, :]
        return tape._replace(targets=targets)


@dataclass(frozen=True, kw_only=True)
class TwoStationOnTop(OnTop, TwoStation):
    """Two stations under their targets."""


@dataclass(frozen=True, kw_only=True)
class OwnshipOnTop(OnTop, Ownship):
    """One platform under its targets."""


@dataclass(frozen=True, kw_only=True)
class ManeuveringOnTop(ManeuveringTarget):
    """The target sits exactly on the first station and accelerates all the same."""

    def draw_tape(self, generators):
        tape = super().draw_tape(generators)
        targets = np.broadcast_to(tape.platforms[:, None, :1], tape.targets.shape).copy()
        return tape._replace(targets=targets)


WILD = {
    "range_min_m": 1e3,
    "range_max_m": 1e3,
    "target_speed_max_m_s": 2000.0,
    "target_acceleration_max_m_s2": 200.0,
    "target_turn_max_rad_s": 1.0,
    "quiet_min_s": 1.0,
    "maneuver_min_s": 1.0,
    "max_turn_rate_deg_s": 45.0,
}

EXTREMES: dict[str, TrackingScenario] = {
    "defaults": TwoStation(**ALL_TERMS),
    "paper course": TwoStation(course="paper", **ALL_TERMS),
    "recorded flights": TwoStation(course="flights", targets=6, steps=20, **ALL_TERMS),
    "targets overhead": TwoStation(targets=6, **OVERHEAD, **ALL_TERMS),
    "targets overhead, fused": TwoStation(tracker="fused_ekf", **OVERHEAD, **ALL_TERMS),
    "targets on the stations": TwoStationOnTop(station_speed_m_s=0.0, **ALL_TERMS),
    "targets on the stations, fused": TwoStationOnTop(station_speed_m_s=0.0, tracker="fused_ekf", **ALL_TERMS),
    "far away": TwoStation(**FAR, **ALL_TERMS),
    "bearing noise 10 deg": TwoStation(bearing_std_deg=10.0, **ALL_TERMS),
    "bearing noise 10 deg, fused": TwoStation(bearing_std_deg=10.0, tracker="fused_ekf", **ALL_TERMS),
    "bearing noise 0.001 deg, no process noise": TwoStation(bearing_std_deg=1e-3, process_noise_m_s=0.0, **ALL_TERMS),
    "no process noise": TwoStation(process_noise_m_s=0.0, **ALL_TERMS),
    "detection 0.05": TwoStation(detection_probability=0.05, **ALL_TERMS),
    "detection 0.05, clutter, fused": TwoStation(
        detection_probability=0.05, false_bearings_mean=5.0, tracker="fused_ekf", **ALL_TERMS
    ),
    "10 false bearings, 6 targets": TwoStation(
        detection_probability=0.5, false_bearings_mean=10.0, targets=6, hypotheses=4, **ALL_TERMS
    ),
    "6 targets on one line of sight": TwoStation(targets=6, spacing_deg=0.0, spacing_jitter_deg=0.0, **ALL_TERMS),
    "targets all round": TwoStation(targets=6, spacing_deg=60.0, spacing_jitter_deg=60.0, **ALL_TERMS),
    "one hypothesis": TwoStation(hypotheses=1, **ALL_TERMS),
    "64 hypotheses": TwoStation(hypotheses=64, targets=1, **ALL_TERMS),
    "scans a minute apart": TwoStation(step_s=60.0, **ALL_TERMS),
    "scans 0.1 s apart": TwoStation(step_s=0.1, **ALL_TERMS),
    "reference bearings only, noisy": TwoStation(bearings="reference", bearing_std_deg=10.0, **ALL_TERMS),
    "discrete, standing stations": TwoStation(actions="discrete", station_speed_m_s=0.0, **ALL_TERMS),
    "everything at once": TwoStation(
        targets=6, hypotheses=2, step_s=60.0, bearing_std_deg=10.0, process_noise_m_s=500.0, detection_probability=0.05,
        false_bearings_mean=5.0, **OVERHEAD, **ALL_TERMS,
    ),
    "one platform, turning targets, discs": Ownship(targets=3, maneuvering=True, nogo_discs=4, **ALL_TERMS),
    "one platform, detection 0.01, 10 false bearings": Ownship(
        targets=3, detection_probability=0.01, false_bearings_mean=10.0, **ALL_TERMS
    ),
    "one platform, 3 false bearings, fused": Ownship(
        targets=3, detection_probability=0.5, false_bearings_mean=3.0, tracker="fused_ekf", **ALL_TERMS
    ),
    "one platform, targets overhead": Ownship(
        targets=3, range_floor_m=100.0, range_cap_m=1e3, nogo_discs=4, nogo_radius_m=1e5, maneuvering=True,
        target_turn_max_deg_s=45.0, **{name: value for name, value in OVERHEAD.items() if "baseline" not in name},
        **ALL_TERMS,
    ),
    "one platform, targets on it": OwnshipOnTop(station_speed_m_s=0.0, targets=3, **ALL_TERMS),
    "one platform, noise 0.001 deg, no process noise": Ownship(
        bearing_std_deg=1e-3, process_noise_m_s=0.0, **ALL_TERMS
    ),
    "one platform, discrete, scans a minute apart": Ownship(
        actions="discrete", step_s=60.0, range_cap_m=1e7, bearing_std_deg=10.0, **ALL_TERMS
    ),
    "maneuvering target, defaults": ManeuveringTarget(**MANEUVER_TERMS),
    "maneuvering target overhead": ManeuveringTarget(max_speed_m_s=1000.0, **WILD, **MANEUVER_TERMS),
    "maneuvering target overhead, imm3, 4 stations": ManeuveringTarget(
        tracker="imm3", stations=4, baseline_m=10.0, **WILD, **MANEUVER_TERMS
    ),
    "maneuvering target on a station": ManeuveringOnTop(**MANEUVER_TERMS),
    "maneuvering target on a station, ie": ManeuveringOnTop(tracker="ie", max_speed_m_s=1.0, **MANEUVER_TERMS),
    "maneuvering target, noise 200 mrad": ManeuveringTarget(
        azimuth_std_mrad=200.0, baseline_m=10.0, **MANEUVER_TERMS
    ),
    "maneuvering target, noise 0.001 mrad": ManeuveringTarget(
        azimuth_std_mrad=1e-3, mixing="sens", baseline_m=1e5, **MANEUVER_TERMS
    ),
    "maneuvering target far away, mie": ManeuveringTarget(
        range_min_m=1e6, range_max_m=1e6, range_cap_m=1e7, tracker="mie", **MANEUVER_TERMS
    ),
    "maneuvering target, ground stations, detection 0.3": ManeuveringTarget(
        carrier="ground", measuring_speed_m_s=15.0, detection_probability=0.3, stations=3, **MANEUVER_TERMS
    ),
    "maneuvering target never fixed again": ManeuveringTarget(
        carrier="ground", measuring_speed_m_s=0.0, steps=60, mixing="output", **MANEUVER_TERMS
    ),
    "maneuvering target, scans a minute apart": ManeuveringTarget(step_s=60.0, mixing="none", **MANEUVER_TERMS),
    "maneuvering target, headings, scans 0.1 s apart": ManeuveringTarget(
        step_s=0.1, actions="headings", **MANEUVER_TERMS
    ),
}  # fmt: skip


class Soaked(NamedTuple):
    """What one scenario's run saw: environment steps, episodes, largest values, wall time."""

    steps: int
    episodes: int
    worst_range_error_m: float
    worst_nees: float
    largest_std_m: float
    lost_share: float
    seconds: float


class Violation(AssertionError):
    """Something handed out was not finite or out of bounds; the message says what, where and when."""


def soak(scenario: TrackingScenario, steps: int, envs: int, seed: int = 0, threads: int | None = None) -> Soaked:
    """Fly at least `steps` environment steps under random actions and check everything after each.

    Raises:
        Violation: at the first value that is not finite or out of bounds.
    """
    env = PassiveVectorEnv(scenario, num_envs=envs, autoreset_mode="same_step", threads=threads)
    rng = np.random.default_rng(seed)
    begin = time.perf_counter()
    observation, info = env.reset(seed=seed)
    _check(env, 0, observation, np.zeros(envs), info)
    worst = np.zeros(3)
    episodes, lost, flown = 0, 0.0, 0
    held = rng.uniform(-1.0, 1.0, (envs, env.simulation.actions.size))
    while flown < steps:
        action = _random_action(env, rng, held)
        observation, reward, _, truncated, info = env.step(action)
        flown += envs
        _check(env, flown // envs, observation, reward, info)
        std = np.sqrt(np.trace(env.world.estimate.cov[..., :2, :2], axis1=-2, axis2=-1))
        worst = np.maximum(worst, [info["range_error_m"].max(), info["nees"].max(), std.max()])
        episodes += int(truncated.sum())
        lost += info["lost"].mean() * envs
    return Soaked(flown, episodes, *worst.tolist(), lost / flown, time.perf_counter() - begin)


def _random_action(env: PassiveVectorEnv, rng: np.random.Generator, held: np.ndarray) -> np.ndarray:
    """Half the environments jitter, half hold a turn; one in a hundred of these picks another."""
    redraw = rng.random(len(held)) < 0.01
    held[redraw] = rng.uniform(-1.5, 1.5, (int(redraw.sum()), held.shape[1]))
    command = np.where(np.arange(len(held))[:, None] % 2, held, rng.uniform(-1.0, 1.0, held.shape))
    return env.simulation.actions.encode(np.clip(command, -1.0, 1.0), env.belief())


def _check(env: PassiveVectorEnv, step: int, observation: np.ndarray, reward: np.ndarray, info: dict[str, Any]) -> None:
    low, high = env.single_observation_space.low, env.single_observation_space.high
    inside = (observation >= low) & (observation <= high)  # NaN compares False
    _require(inside.all(axis=-1), step, "observation out of its box", observation)
    _require(np.isfinite(reward), step, "reward not finite", reward)
    for name, value in _numbers(info):
        rows = value.reshape(env.num_envs, -1)
        _require(np.isfinite(rows).all(axis=-1), step, f"info[{name!r}] not finite", value)
    mean, cov = env.world.estimate
    _require(np.isfinite(mean).all(axis=(-1, -2)), step, "track mean not finite", mean)
    _require(np.isfinite(cov).all(axis=(-1, -2, -3)), step, "track covariance not finite", cov)
    variance = np.diagonal(cov, axis1=-2, axis2=-1)
    _require((variance >= 0.0).all(axis=(-1, -2)), step, "track variance negative", variance)
    symmetric = np.abs(cov - np.swapaxes(cov, -1, -2)) <= 1e-9 * np.abs(cov).max(axis=(-1, -2), keepdims=True)
    _require(symmetric.all(axis=(-1, -2, -3)), step, "track covariance not symmetric", cov)


def _numbers(info: dict[str, Any], prefix: str = "") -> Iterator[tuple[str, np.ndarray]]:
    for name, value in info.items():
        if isinstance(value, dict):
            yield from _numbers(value, f"{prefix}{name}.")
        else:
            yield f"{prefix}{name}", value


def _require(good: np.ndarray, step: int, what: str, values: np.ndarray) -> None:
    if not good.all():
        row = int(np.flatnonzero(~good)[0])
        raise Violation(f"step {step}, sub-environment {row}: {what}: {values[row]!r}")


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--steps", type=int, default=10_000_000, help="environment steps in all (default 10,000,000)")
    parser.add_argument("--envs", type=int, default=512, help="sub-environments stepped at once (default 512)")
    parser.add_argument("--seed", type=int, default=0, help="of actions and episodes (default 0)")
    parser.add_argument("--threads", type=int, default=None, help="worker threads (default all cores)")
    arguments = parser.parse_args()
    share = -(-arguments.steps // len(EXTREMES))
    total, begin = 0, time.perf_counter()
    print(
        f"{'scenario':42s} {'steps':>9s} {'episodes':>8s} {'range error':>12s} {'NEES':>9s} {'std':>9s} "
        f"{'lost':>7s} {'µs/step':>8s}"
    )
    for name, scenario in EXTREMES.items():
        try:
            seen = soak(scenario, share, arguments.envs, arguments.seed, arguments.threads)
        except Violation as violation:
            raise SystemExit(f"{name}: {violation}") from violation
        total += seen.steps
        print(
            f"{name:42s} {seen.steps:9d} {seen.episodes:8d} {seen.worst_range_error_m:10.3g} m {seen.worst_nees:9.3g} "
            f"{seen.largest_std_m:7.3g} m {100 * seen.lost_share:6.2f}% {1e6 * seen.seconds / seen.steps:8.1f}",
            flush=True,
        )
    print(f"{total} steps in {time.perf_counter() - begin:.0f} s: every value finite and inside its bounds")


if __name__ == "__main__":
    main()
