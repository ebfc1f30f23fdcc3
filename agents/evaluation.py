"""Flying policies through episodes, all of them on the same tapes.

Episode i of every policy draws its tape from seed + i, so targets, noise, detections and false bearings are the same
for all; what differs is only where the platforms went. What is kept of them: `agents.outcomes`; how policies are
compared: `agents.comparison`.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from tqdm import tqdm

from agents.outcomes import COLLAPSE_M, LATE_ERROR_M, LATE_STEPS, Record, nees_scale
from agents.pictures import EpisodePaths
from agents.policy import Policy, sees_world
from passive_env.core import World, map_rows
from passive_env.steering import course, line_of_sight
from passive_env.vector_env import PassiveVectorEnv
from trackers.angles import wrap

BLOCK = 1024
"""Episodes flown at once."""

ALIKE = ("paths", "state_size", "settled")
"""What a record takes from its first block."""


def fly(scenario: Any, policy: Policy, episodes: int, seed: int, progress: Any = None) -> Record:
    """Fly a policy through episodes seed … seed + episodes − 1.

    Args:
        scenario: what to fly.
        policy: decides for batches.
        episodes: number of episodes.
        seed: of the first episode.
        progress: a tqdm bar to advance by episodes, if any.
    """
    blocks = []
    for first, count in blocks_of(episodes, seed):
        blocks.append(fly_block(scenario, policy, count, first))
        if progress is not None:
            progress.update(count)
    return joined(blocks, scenario)


def blocks_of(episodes: int, seed: int) -> list[tuple[int, int]]:
    """First seed and number of episodes of every block: the same cuts wherever the blocks are flown."""
    if episodes < 1:
        raise ValueError(f"episodes = {episodes}: must be at least 1")
    return [(seed + at, min(BLOCK, episodes - at)) for at in range(0, episodes, BLOCK)]


def joined(blocks: Sequence[dict[str, Any]], scenario: Any) -> Record:
    """The record of all blocks of a flight, in the order of their seeds."""
    merged = {
        name: np.concatenate([block[name] for block in blocks]) for name in blocks[0] if name not in ("seconds", *ALIKE)
    }
    decisions = len(merged["lost"]) * scenario.steps
    seconds = sum(block["seconds"] for block in blocks)
    alike = {name: blocks[0][name] for name in ALIKE if name in blocks[0]}
    return Record(**merged, decision_time_us=1e6 * seconds / decisions, **alike)


def fly_block(scenario: Any, policy: Policy, episodes: int, seed: int) -> dict[str, Any]:
    """A record's figures of one block of episodes, and the seconds that the policy took."""
    env = PassiveVectorEnv(scenario, num_envs=episodes, autoreset_mode="disabled")
    observation, info = env.reset(seed=seed)
    log, turns, levels = [_instant(env.world, info, scenario.score)], [_turn(info)], [_level(info)]
    belief, seconds = env.belief(), 0.0
    _show(policy, env.world)
    policy.reset(belief)
    encode = env.simulation.actions.encode
    for _ in range(scenario.steps):
        start = time.perf_counter()
        commands = policy.act(belief, observation)
        seconds += time.perf_counter() - start
        observation, _, _, _, info = env.step(encode(commands, belief))
        belief = env.belief()
        _show(policy, env.world)
        log.append(_instant(env.world, info, scenario.score))
        turns.append(_turn(info))
        levels.append(_level(info))
    instants = _Instant(*(np.stack(column, axis=1) for column in zip(*log, strict=True)))
    special = _turns(turns) | _levels(levels, scenario)
    return _block(instants, env, info) | special | {"seconds": seconds}


def _block(instants: _Instant, env: PassiveVectorEnv, info: Mapping[str, Any]) -> dict[str, Any]:
    """A record's figures of all families, of episodes that have been flown to their end; info: the last step's."""
    scenario, state_size = env.scenario, env.world.truth.shape[-1]
    collapsed = (info["position_error_m"] > COLLAPSE_M) | (info["nees"] > nees_scale(state_size).collapse)
    history = env.simulation.history(env.world)
    figures = {
        "range_error_m": instants.range_error_m, "range_crlb_m": instants.range_crlb_m,
        f"{scenario.score}_error_m": instants.scored_error_m, f"{scenario.score}_crlb_m": instants.scored_crlb_m,
    } | history  # fmt: skip
    position = {} if scenario.score == "range" else _position(figures["position_error_m"], figures["position_crlb_m"])
    scored = {"scored_error_m": info["position_error_m"].mean(-1)} if history else {}
    paths = map_rows(lambda part: part[:1], env.world) if history else _first_paths(instants, env.world, scenario)
    return (
        position
        | scored
        | {
            "range_error_m": figures["range_error_m"].mean(-1),
            "range_crlb_m": figures["range_crlb_m"].mean(-1),
            "lost": info["lost"].mean(-1),
            "collapsed": collapsed.mean(-1),
            "nees": info["nees"],
            "off_sight_rad": instants.off_sight_rad,
            "turns": instants.turns[:, 1:],
            "standoff": (instants.standoff_violation[:, 1:] > 0.0).mean(-1),
            "nogo": (instants.nogo_violation[:, 1:] > 0.0).mean(-1),
            "state_size": state_size,
            "paths": paths,
        }
    )


def _position(errors: np.ndarray, bounds: np.ndarray) -> dict[str, np.ndarray]:
    """A record's figures of position errors and bounds [e, k + 1, m]."""
    late = errors[:, 1:][:, -LATE_STEPS:].mean(axis=1) > LATE_ERROR_M
    return {
        "position_error_m": errors.mean(-1), "position_crlb_m": bounds.mean(-1), "lost_late": late.mean(-1),
    }  # fmt: skip


def _turn(info: Mapping[str, Any]) -> tuple[Any, ...]:
    """Who maneuvers, position and acceleration errors, each [e, m]; nothing where figures do not tell."""
    names = ("maneuvering", "position_error_m", "acceleration_error_m_s2")
    return tuple(info[name] for name in names) if names[0] in info else ()


def _turns(log: list[tuple[Any, ...]]) -> dict[str, np.ndarray]:
    """A record's figures of maneuvers."""
    if not log[0]:
        return {}
    maneuvering, error, acceleration = (np.stack(column, axis=1) for column in zip(*log, strict=True))
    during = maneuvering[:, 1:]
    count, total = during.sum((1, 2)), np.where(during, error[:, 1:], 0.0).sum((1, 2))
    average = np.divide(total, count, out=np.full(len(total), np.nan), where=count > 0)
    return {"turn_error_m": average, "acceleration_error_m_s2": acceleration.mean(-1)}


def _level(info: Mapping[str, Any]) -> tuple[Any, ...]:
    """Horizontal and height errors, each [e, m]; nothing where figures do not tell."""
    names = ("horizontal_error_m", "height_error_m")
    return tuple(info[name] for name in names) if names[0] in info else ()


def _levels(log: list[tuple[Any, ...]], scenario: Any) -> dict[str, Any]:
    """A record's figures of level and height errors."""
    if not log[0]:
        return {}
    level, height = (np.stack(column, axis=1).mean(-1) for column in zip(*log, strict=True))
    settled = round(scenario.settled_s / scenario.step_s) + 1
    return {"horizontal_error_m": level, "height_error_m": height, "settled": settled}


class _Instant(NamedTuple):
    """What is kept of e episodes at one instant; stacked along axis 1 it is kept of all instants."""

    range_error_m: Any
    range_crlb_m: Any
    scored_error_m: Any
    scored_crlb_m: Any
    stations: Any
    estimates: Any
    off_sight_rad: Any
    turns: Any
    standoff_violation: Any
    nogo_violation: Any


def _instant(world: World, info: Mapping[str, Any], score: str) -> _Instant:
    """Of the platforms' and estimates' positions the first episode's only: they are for a picture."""
    turns = world.last_action[:, : world.platforms.shape[1]]
    return _Instant(
        info["range_error_m"], info["range_crlb_m"], info[f"{score}_error_m"], info[f"{score}_crlb_m"],
        world.platforms[:1, :, :2], world.estimate.mean[:1, :, :2],
        wrap(course(world.platforms) - line_of_sight(world.platforms, world.truth)).astype(np.float32),
        np.asarray(turns, dtype=np.float32), info["standoff_violation"], info["nogo_violation"],
    )  # fmt: skip


def _first_paths(instants: _Instant, world: World, scenario: Any) -> EpisodePaths:
    """The first episode's geometry; world: its end."""
    return EpisodePaths(
        instants.stations[0], world.tape.targets[0, :, :, :2], instants.estimates[0],
        world.estimate.cov[0, :, :2, :2], instants.scored_error_m[0], instants.scored_crlb_m[0], world.tape.discs[0],
        scenario.standoff_m, scenario.score, scenario.reference,
    )  # fmt: skip


def _show(policy: Policy, world: World) -> None:
    """Let an oracle look at the world; no policy has a way to ask for it."""
    if sees_world(policy):
        seer: Any = policy
        seer.see(world)


class Flight(NamedTuple):
    """A policy to be flown through episodes.

    Attributes:
        title: for people.
        scenario, episodes, seed: as of `fly`.
        make: makes the policy, when its turn has come.
    """

    title: str
    scenario: Any
    make: Callable[[], Policy]
    episodes: int
    seed: int


Engine = Callable[[Mapping[str, Flight], Any], Iterator[tuple[str, Record]]]
"""Flies flights by name and yields their names and records as they are finished, in any order; advances a bar."""


def here(flights: Mapping[str, Flight], bar: Any) -> Iterator[tuple[str, Record]]:
    """The engine that flies in this process, one flight after the other."""
    for name, flight in flights.items():
        bar.set_description(flight.title)
        yield name, fly(flight.scenario, flight.make(), flight.episodes, flight.seed, bar)


def fly_all(
    scenario: Any, policies: Mapping[str, Policy], episodes: int, seed: int, progress: bool = True,
    engine: Engine = here,
) -> dict[str, Record]:  # fmt: skip
    """Records of several policies on the same tapes, with a progress bar."""
    flights = {
        name: Flight(name, scenario, lambda policy=policy: policy, episodes, seed) for name, policy in policies.items()
    }
    with tqdm(total=episodes * len(policies), unit="episode", disable=not progress, leave=False) as bar:
        records = dict(engine(flights, bar))
    return {name: records[name] for name in policies}


def unique_names(names: Iterable[str]) -> list[str]:
    """Names made unique by numbering repetitions: learned, learned_2, …"""
    seen: dict[str, int] = {}
    unique = []
    for name in names:
        seen[name] = seen.get(name, 0) + 1
        unique.append(name if seen[name] == 1 else f"{name}_{seen[name]}")
    return unique
