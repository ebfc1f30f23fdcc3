"""Honest comparison: all policies on the same tapes, with intervals.

Episode i of every policy draws its tape from seed + i, so targets, noise, detections and false bearings are the same
for all; what differs is only where the platforms went. Ratios of means come with paired bootstrap intervals.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from scipy.stats import binomtest, bootstrap, chi2
from tqdm import tqdm

from agents.pictures import EpisodePaths
from agents.policy import Policy, sees_world
from passive_env.core import World, map_rows
from passive_env.steering import course, line_of_sight
from passive_env.vector_env import PassiveVectorEnv
from trackers.angles import wrap

BLOCK = 1024
"""Episodes flown at once."""

BASELINES = (
    "paper",
    "fixed",
    "open",
    "rule",
    "rule_tuned",
    "rule_average",
    "rule_best",
    "round_robin",
    "greedy",
    "skip",
    "bayes",
    "timed",
    "hysteresis",
    "hold10",
    "timed10",
    "pursuit",
    "timed_pursuit",
    "planner",
    "optimizer",
)
"""Policies that all others are compared with, where they take part."""

COLLAPSE_M = 15e3
COLLAPSE_LEVEL = 0.9999
"""A track that ends farther off than the one, or with a NEES above this quantile of an honest tracker's, has
collapsed."""


class NeesScale(NamedTuple):
    """What an honest tracker's NEES would be: χ² with as many degrees of freedom as the state has numbers.

    Attributes:
        degrees: of freedom, also the mean.
        median: what half of them lie below.
        band: where 95 % of them lie.
        collapse: what 99.99 % of them lie below.
    """

    degrees: int
    median: float
    band: tuple[float, float]
    collapse: float


def nees_scale(degrees: int) -> NeesScale:
    """The scale of states of so many numbers."""
    low, high = chi2.ppf([0.025, 0.975], df=degrees)
    collapse = chi2.ppf(COLLAPSE_LEVEL, df=degrees)
    return NeesScale(degrees, float(chi2.median(df=degrees)), (float(low), float(high)), float(collapse))


RESAMPLES = 2000

ALIKE = ("paths", "state_size", "settled")
"""What a record takes from its first block."""

LATE_STEPS, LATE_ERROR_M = 5, 1e3
"""A track in space counts as lost if its position error averaged over the last steps exceeds this: Wang, Wang and Yang
(2004) as specified, "lost A"."""


PARTIAL = ("turn_position_error_m",)
"""Errors that not every episode has."""


@dataclass(frozen=True)
class Outcomes:
    """What tables are made of: a policy's figures of e episodes, without their course.

    Attributes:
        score: the error that counts, "range" or "position".
        errors: what policies are compared by, each [e] m (or m/s²): final and average errors, those of maneuvers, NaN
            in episodes without any; by name in reports.
        bounds: [e] m Cramér–Rao bounds at the end; by name in reports.
        lost, collapsed, nees, standoff, nogo, state_size, decision_time_us, lost_late: as in `Record`.
    """

    score: str
    errors: dict[str, np.ndarray]
    bounds: dict[str, np.ndarray]
    lost: np.ndarray
    collapsed: np.ndarray
    nees: np.ndarray
    standoff: np.ndarray
    nogo: np.ndarray
    state_size: int
    decision_time_us: float
    lost_late: Any = None

    @property
    def samples(self) -> dict[str, np.ndarray]:
        """The errors of the episodes that have them."""
        return {
            name: values[np.isfinite(values)] if name in PARTIAL else values for name, values in self.errors.items()
        }


@dataclass(frozen=True)
class Record:
    """What a policy achieved; e episodes, k steps.

    Where sensors are placed and then a track is run, errors and bounds have a column per scan (range_crlb_m only the
    last one), and `paths` is the first episode's last world.

    Attributes:
        range_error_m: [e, k + 1] mean over targets, index 0 before the first decision.
        range_crlb_m: [e, k + 1] the same of the posterior Cramér–Rao bound.
        lost, collapsed: [e] share of tracks at the end.
        decision_time_us: wall time of a decision per step and episode, in batches.
        paths: the first episode's geometry.
        nees: [e, m] normalised estimation error squared of every track at the end.
        off_sight_rad: [e, k + 1, s] each platform's course from its line of sight to the middle of the true targets,
            left positive, in [−π, π].
        turns: [e, k, s] turn commands flown, as shares of the limit, left positive.
        standoff, nogo: [e] share of the steps that end with a platform inside a stand-off ring, a no-go disc.
        state_size: numbers of a track's state, the NEES's degrees of freedom.
        position_error_m, position_crlb_m: as those of the range, in scenarios that are scored by the position.
        lost_late: [e] share of tracks whose position error, averaged over the last `LATE_STEPS` steps, exceeds
            `LATE_ERROR_M`; in the same scenarios.
        turn_error_m: [e] position error averaged over the steps after decisions at which a target maneuvers, NaN in
            episodes without any; in scenarios whose figures tell who maneuvers.
        acceleration_error_m_s2: [e, k + 1] mean over targets; in the same scenarios.
        scored_error_m: [e] the position error that `info` shows at the end, where that is another than the last scan's.
        horizontal_error_m, height_error_m: [e, k + 1] mean over targets; in scenarios whose figures tell them.
        settled: column from which a track is taken to have settled, in the same scenarios.
    """

    range_error_m: np.ndarray
    range_crlb_m: np.ndarray
    lost: np.ndarray
    collapsed: np.ndarray
    decision_time_us: float
    paths: EpisodePaths | World
    nees: np.ndarray
    off_sight_rad: np.ndarray
    turns: np.ndarray
    standoff: np.ndarray
    nogo: np.ndarray
    state_size: int = 4
    position_error_m: Any = None
    position_crlb_m: Any = None
    lost_late: Any = None
    turn_error_m: Any = None
    acceleration_error_m_s2: Any = None
    scored_error_m: Any = None
    horizontal_error_m: Any = None
    height_error_m: Any = None
    settled: int = 1

    @property
    def score(self) -> str:
        """The error that counts, "range" or "position"."""
        return "range" if self.position_error_m is None else "position"

    @property
    def errors(self) -> dict[str, tuple[np.ndarray, np.ndarray]]:
        """Per kind of error, the one that counts first: errors and bounds [e, k + 1]."""
        ranges = {"range": (self.range_error_m, self.range_crlb_m)}
        return ranges if self.score == "range" else {"position": (self.position_error_m, self.position_crlb_m)} | ranges

    @property
    def outcomes(self) -> Outcomes:
        """The figures of every episode, without its course."""
        named = {}
        for kind, (error, _) in self.errors.items():
            named[f"final_{kind}_error_m"] = error[:, -1]
            named[f"mean_{kind}_error_m"] = error[:, 1:].mean(axis=1)
        if self.scored_error_m is not None:
            named["scored_position_error_m"] = self.scored_error_m
        if self.turn_error_m is not None and np.isfinite(self.turn_error_m).any():
            named["turn_position_error_m"] = self.turn_error_m
        if self.acceleration_error_m_s2 is not None:
            named["mean_acceleration_error_m_s2"] = self.acceleration_error_m_s2[:, 1:].mean(axis=1)
        bounds = {f"final_{kind}_crlb_m": bound[:, -1] for kind, (_, bound) in self.errors.items()}
        return Outcomes(
            self.score, named | self._level_samples(), bounds, self.lost, self.collapsed, self.nees, self.standoff,
            self.nogo, self.state_size, self.decision_time_us, self.lost_late,
        )  # fmt: skip

    @property
    def samples(self) -> dict[str, np.ndarray]:
        """What policies are compared by, each [e]: final and average errors, those of maneuvers; by name in reports."""
        return self.outcomes.samples

    def _level_samples(self) -> dict[str, np.ndarray]:
        """Averages of level errors, also of settled tracks, and in space of height errors."""
        level, height = self.horizontal_error_m, self.height_error_m
        if level is None:
            return {}
        named = {"mean_horizontal_error_m": level[:, 1:].mean(axis=1)}
        if self.settled < level.shape[1]:
            named["settled_horizontal_error_m"] = level[:, self.settled :].mean(axis=1)
        return named | ({"mean_height_error_m": height[:, 1:].mean(axis=1)} if height.any() else {})

    @property
    def error_m(self) -> np.ndarray:
        """[e, k + 1] the error that counts."""
        return self.errors[self.score][0]

    @property
    def bound_m(self) -> np.ndarray:
        """[e, k + 1] the bound on it."""
        return self.errors[self.score][1]

    @property
    def final(self) -> np.ndarray:
        """[e] the error that counts after the last step."""
        return self.error_m[:, -1]

    @property
    def mean(self) -> np.ndarray:
        """[e] the same averaged over all steps after decisions."""
        return self.error_m[:, 1:].mean(axis=1)


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


def summarize(
    environment: str, seed: int, records: Mapping[str, Record], more_baselines: Sequence[str] = ()
) -> dict[str, Any]:
    """The evaluation as plain data: figures per policy, ratios to the baselines with paired 95 % intervals."""
    outcomes = {name: record.outcomes for name, record in records.items()}
    first = next(iter(outcomes.values()))
    baselines = [name for name in (*BASELINES, *more_baselines) if name in records] or [next(iter(records))]
    return {
        "environment": environment,
        "episodes": len(first.lost),
        "seed": seed,
        "state_size": first.state_size,
        "score": first.score,
        "policies": {name: figures_of(flown) for name, flown in outcomes.items()},
        "ratios": {
            base: {name: _ratios(flown, outcomes[base]) for name, flown in outcomes.items() if name != base}
            for base in baselines
        },
    }


def figures_of(flown: Outcomes) -> dict[str, Any]:
    """A policy's figures as plain data."""
    low, high = nees_scale(flown.state_size).band
    errors = {name: _statistics(values) for name, values in flown.samples.items()}
    bounds = {name: float(bound.mean()) for name, bound in flown.bounds.items()}
    late = {} if flown.lost_late is None else _share(flown.lost_late)
    return (
        errors
        | late
        | {
            "lost_share": float(flown.lost.mean()),
            "collapse_share": float(flown.collapsed.mean()),
            "standoff_share": float(flown.standoff.mean()),
            "nogo_share": float(flown.nogo.mean()),
            "final_nees": _statistics(flown.nees),
            "final_nees_in_band_share": float(((flown.nees >= low) & (flown.nees <= high)).mean()),
        }
        | bounds
        | {"decision_time_us": flown.decision_time_us}
    )


def _share(lost: np.ndarray) -> dict[str, Any]:
    """Share of lost tracks with its Wilson 95 % interval, each episode's tracks counting as one."""
    interval = binomtest(round(float(lost.sum())), len(lost)).proportion_ci(method="wilson")
    return {"lost_late_share": float(lost.mean()), "lost_late_ci95": [float(interval.low), float(interval.high)]}


def _statistics(values: np.ndarray) -> dict[str, float]:
    return {
        "mean": float(values.mean()),
        "median": float(np.median(values)),
        "rms": float(np.sqrt(np.square(values).mean())),
        "p95": float(np.percentile(values, 95.0)),
    }


def _ratios(flown: Outcomes, base: Outcomes) -> dict[str, Any]:
    pairs = zip(flown.samples.items(), base.samples.values(), strict=True)
    ratios = {name: ratio_of_means(values, other) for (name, values), other in pairs}
    if flown.lost_late is not None:
        ratios["lost_late_share"] = difference_of_means(flown.lost_late, base.lost_late)
    return ratios


def mean_interval(values: np.ndarray, seed: int = 0) -> list[float]:
    """Percentile bootstrap 95 % interval [low, high] of a sample's mean; values [e], seed of the resampling."""
    if len(values) < 2:
        return [float(values.mean())] * 2
    draws = np.random.default_rng(seed).multinomial(len(values), np.full(len(values), 1.0 / len(values)), RESAMPLES)
    low, high = np.percentile(draws @ values / len(values), [2.5, 97.5])
    return [float(low), float(high)]


def ratio_of_means(values: np.ndarray, base: np.ndarray, seed: int = 0) -> dict[str, Any]:
    """Ratio of two paired samples' means with a percentile bootstrap 95 % interval.

    Args:
        values, base: [e] of the same episodes.
        seed: of the resampling.
    Returns:
        {"ratio", "ci95": [low, high]}; a single episode has no interval: both ends are the ratio.
    """
    ratio = float(values.mean() / base.mean())
    interval = _paired_interval(values, base, lambda a, b, axis: a.mean(axis) / b.mean(axis), seed)
    return {"ratio": ratio, "ci95": interval or [ratio, ratio]}


def difference_of_means(values: np.ndarray, base: np.ndarray, seed: int = 0) -> dict[str, Any]:
    """The same of the difference of two paired shares, of which the other may be 0: {"difference", "ci95"}."""
    difference = float(values.mean() - base.mean())
    interval = _paired_interval(values, base, lambda a, b, axis: a.mean(axis) - b.mean(axis), seed)
    return {"difference": difference, "ci95": interval or [difference, difference]}


def _paired_interval(values: np.ndarray, base: np.ndarray, statistic: Any, seed: int) -> list[float]:
    """Percentile bootstrap 95 % interval of a statistic of paired samples; empty for a single episode."""
    if len(values) < 2:
        return []
    result = bootstrap(
        (values, base),
        statistic,
        paired=True,
        vectorized=True,
        n_resamples=RESAMPLES,
        batch=max(1, 2_000_000 // len(values)),
        method="percentile",
        rng=np.random.default_rng(seed),
    )
    low, high = result.confidence_interval
    return [float(low), float(high)]


def steps_axis(scenario: Any) -> np.ndarray:
    """Times s of a record's columns."""
    return scenario.step_s * np.arange(scenario.instants)


def unique_names(names: Iterable[str]) -> list[str]:
    """Names made unique by numbering repetitions: learned, learned_2, …"""
    seen: dict[str, int] = {}
    unique = []
    for name in names:
        seen[name] = seen.get(name, 0) + 1
        unique.append(name if seen[name] == 1 else f"{name}_{seen[name]}")
    return unique
