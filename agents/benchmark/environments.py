"""Environments: steps per second of the vector environment, a single step, a reset, memory."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import gymnasium as gym
import numpy as np

from agents.benchmark.results import Result, Section
from agents.benchmark.timing import Effort, Task, seconds, take_turns
from agents.greedy import Greedy
from agents.planner import Planner
from passive_env.catalogue import environment_id, make_scenario
from passive_env.parallel import parallel_env
from passive_env.vector_env import PassiveVectorEnv

SCENARIO, ONE_PLATFORM, TWO_AIRCRAFT, MANEUVERS = "TwoStation", "Ownship", "AngleFusion", "ManeuveringTarget"
PLACEMENT, CARRIERS, PASSIVE_RADAR = "RadarPlacement", "MobilePlacement", "PassiveRadar"


def measure_vector(effort: Effort) -> Section:
    """Environment steps per second in windows of whole episodes, resets included, on all cores and on one thread.

    Autoreset is the default, NEXT_STEP: a window is one call per step and one more that resets; only steps count.
    """
    wide = {"": _begun(effort, None), "_one_thread": _begun(effort, 1)}
    tasks = {
        f"vector_env_{kind}_actions{suffix}": _window(env, kind == "random")
        for kind in ("random", "zero")
        for suffix, env in wide.items()
    }
    return Section(_rates(tasks, effort, wide[""].scenario.steps, {"vector_env_random_actions": ">= 250000"}))


def measure_one_platform(effort: Effort) -> Section:
    """Environment steps per second where one platform tracks one target, windows as in `measure_vector`."""
    wide = {"": _begun(effort, None, ONE_PLATFORM), "_one_thread": _begun(effort, 1, ONE_PLATFORM)}
    tasks = {f"ownship_random_actions{suffix}": _window(env, True) for suffix, env in wide.items()}
    return Section(_rates(tasks, effort, wide[""].scenario.steps, {"ownship_random_actions": ">= 1000000"}))


def measure_two_aircraft(effort: Effort) -> Section:
    """Environment steps per second on azimuths and elevations, clean and in clutter, windows as in `measure_vector`."""
    clean, clutter = make_scenario(TWO_AIRCRAFT, {}), make_scenario(TWO_AIRCRAFT, {"clutter_mean": 8.0})
    tasks = {
        "angles_clean_random_actions": _window(_begun(effort, None, clean), True),
        "angles_clutter_8_random_actions": _window(_begun(effort, None, clutter), True),
    }
    goals = {"angles_clean_random_actions": ">= 400000", "angles_clutter_8_random_actions": ">= 40000"}
    return Section(_rates(tasks, effort, clean.steps, goals))


def measure_stations(effort: Effort) -> Section:
    """Environment steps per second against a maneuvering target, windows as in `measure_vector`."""
    wide = {"": _begun(effort, None, MANEUVERS), "_one_thread": _begun(effort, 1, MANEUVERS)}
    tasks = {f"maneuvers_random_actions{suffix}": _window(env, True) for suffix, env in wide.items()}
    return Section(_rates(tasks, effort, wide[""].scenario.steps, {"maneuvers_random_actions": ">= 150000"}))


def measure_placements(effort: Effort) -> Section:
    """Whole episodes per second in which three sensors are placed and a track of 50 scans is run and scored."""
    wide = {"": _begun(effort, None, PLACEMENT), "_one_thread": _begun(effort, 1, PLACEMENT)}
    tasks = {f"placement_episodes{suffix}": _window(env, True) for suffix, env in wide.items()}
    times = take_turns(tasks, effort.rounds)
    rates = {name: effort.num_envs / float(np.median(taken)) for name, taken in times.items()}
    goals = {"placement_episodes": ">= 5000"}
    return Section([Result(name, rate, "episodes/s", goals.get(name)) for name, rate in rates.items()])


def measure_carriers(effort: Effort) -> Section:
    """Environment steps per second with sensors on carriers, windows as in `measure_vector`."""
    wide = {"": _begun(effort, None, CARRIERS), "_one_thread": _begun(effort, 1, CARRIERS)}
    tasks = {f"carriers_random_actions{suffix}": _window(env, True) for suffix, env in wide.items()}
    return Section(_rates(tasks, effort, wide[""].scenario.steps, {}))


def measure_passive_radar(effort: Effort) -> Section:
    """Environment steps per second where a receiver chooses transmitters, windows as in `measure_vector`."""
    wide = {"": _begun(effort, None, PASSIVE_RADAR), "_one_thread": _begun(effort, 1, PASSIVE_RADAR)}
    tasks = {f"passive_radar_random_actions{suffix}": _window(env, True) for suffix, env in wide.items()}
    return Section(_rates(tasks, effort, wide[""].scenario.steps, {"passive_radar_random_actions": ">= 300000"}))


def _rates(tasks: Mapping[str, Task], effort: Effort, steps: int, goals: Mapping[str, str]) -> list[Result]:
    """Environment steps per second of windows of `steps` steps."""
    times = take_turns(tasks, effort.rounds)
    rates = {name: effort.num_envs * steps / float(np.median(taken)) for name, taken in times.items()}
    return [Result(name, rate, "env-steps/s", goals.get(name)) for name, rate in rates.items()]


def measure_decisions(effort: Effort) -> Section:
    """Time of one decision of the greedy policy and of the planner for all environments at an episode's start.

    Every environment plans anew, to the episode's end; between such decisions the planner only steers.
    """
    env = _begun(effort, None, ONE_PLATFORM)
    belief, observation = env.belief(), np.zeros(env.observation_space.shape)  # type: ignore[arg-type]

    def decision(policy: Any) -> Task:
        def prepare() -> Any:
            policy.reset(belief)
            return lambda: policy.act(belief, observation)

        return prepare

    tasks = {"greedy_decision": decision(Greedy(env.scenario)), "planner_decision": decision(Planner(env.scenario))}
    goals = {"greedy_decision": "< 30", "planner_decision": "< 200"}
    times = take_turns(tasks, effort.rounds)
    return Section([Result(name, 1e3 * float(np.median(taken)), "ms", goals[name]) for name, taken in times.items()])


def _begun(effort: Effort, threads: int | None, scenario: Any = SCENARIO) -> PassiveVectorEnv:
    env = PassiveVectorEnv(scenario, num_envs=effort.num_envs, threads=threads)
    env.reset(seed=0)
    return env


def _window(env: PassiveVectorEnv, random: bool) -> Task:
    """Every sub-environment flies one episode, from its first step to the reset after its last."""
    rng, shape = np.random.default_rng(1), (env.scenario.steps + 1, *env.action_space.shape)  # type: ignore[misc]

    def prepare() -> Any:
        actions = rng.uniform(-1.0, 1.0, shape) if random else np.zeros(shape)
        actions = actions.astype(np.float32)

        def run() -> None:
            for action in actions:
                env.step(action)

        return run

    return prepare


def measure_resets(effort: Effort) -> Section:
    """Beginning episodes, tapes drawn and first scans tracked, in the wide vector environment."""
    env = _begun(effort, None)
    times = take_turns({"reset": lambda: env.reset}, effort.rounds)["reset"]
    return Section([Result("reset_per_environment", 1e6 * float(np.median(times)) / effort.num_envs, "µs")])


def measure_single(effort: Effort) -> Section:
    """Median time of one step of the single environment, each step timed by itself."""
    env_id = environment_id(SCENARIO)
    bare, wrapped = gym.make(env_id, disable_env_checker=True), gym.make(env_id)
    times: dict[str, list[float]] = {"single_env_step": [], "single_env_step_default_wrappers": []}
    rng = np.random.default_rng(2)
    for episode in range(effort.episodes + 1):
        for env, taken in zip((bare, wrapped), times.values(), strict=True):
            steps = list(_step_times(env, rng, episode))
            taken += steps if episode > 0 else []
    return Section([Result(name, 1e6 * float(np.median(taken)), "µs", "<= 60") for name, taken in times.items()])


def _step_times(env: gym.Env[Any, Any], rng: np.random.Generator, seed: int) -> Iterator[float]:
    """Wall time of every step of an episode [s]."""
    env.reset(seed=seed)
    shape = env.action_space.shape
    done = False
    while not done:
        action = rng.uniform(-1.0, 1.0, shape).astype(np.float32)
        outcome: list[Any] = []
        yield seconds(lambda action=action, outcome=outcome: outcome.extend(env.step(action)))
        done = outcome[2] or outcome[3]


def measure_agents(effort: Effort) -> Section:
    """Median time of a step with PettingZoo's interface, and its share beyond that of the single environment's step.

    The two fly the same episodes in turn.
    """
    try:
        parallel = parallel_env(environment_id(SCENARIO))
    except ImportError as error:
        return Section([], [str(error)])
    single = gym.make(environment_id(SCENARIO), disable_env_checker=True)
    ours: list[float] = []
    base: list[float] = []
    for episode in range(effort.episodes + 1):
        rng = np.random.default_rng(episode)
        steps = list(_step_times(single, rng, episode)), list(_parallel_step_times(parallel, rng, episode))
        if episode > 0:
            base += steps[0]
            ours += steps[1]
    step, beyond = float(np.median(ours)), float(np.median(ours) / np.median(base)) - 1.0
    return Section(
        [Result("parallel_env_step", 1e6 * step, "µs"), Result("parallel_env_overhead", 100.0 * beyond, "%", "< 30")]
    )


def _parallel_step_times(env: Any, rng: np.random.Generator, seed: int) -> Iterator[float]:
    """Wall time of every step of an episode [s]."""
    env.reset(seed=seed)
    shape = env.action_space(env.agents[0]).shape
    while env.agents:
        actions = {agent: rng.uniform(-1.0, 1.0, shape).astype(np.float32) for agent in env.agents}
        yield seconds(lambda actions=actions: env.step(actions))


def measure_memory(effort: Effort) -> Section:
    """Bytes of a world's arrays per environment: the tape of the whole episode, and the state that steps replace."""
    env = _begun(effort, None)
    env.step(np.zeros(env.action_space.shape, dtype=np.float32))  # type: ignore[arg-type]
    world = env.world
    tape = array_bytes(world.tape) / effort.num_envs
    state = array_bytes(world) / effort.num_envs - tape
    figures = {"memory_per_environment": tape + state, "memory_tape": tape, "memory_state": state}
    return Section([Result(name, size / 1e3, "kB") for name, size in figures.items()])


def array_bytes(tree: Any) -> int:
    """Bytes of all arrays in nested tuples."""
    return sum(map(array_bytes, tree)) if isinstance(tree, tuple) else tree.nbytes
