"""An example of learning with several agents: one network that all platforms share, compared with the central policy.

    python -m agents.parameter_sharing --out runs/common
    python -m agents.parameter_sharing --out runs/own --view own
    python -m agents.parameter_sharing --out comparison --runs runs/common runs/own

Every platform decides by itself, from its own share of the belief, with the same network (parameter sharing); 256
episodes of all agents are rows of one batch (`passive_env.team_vector_env`), learned from by Stable-Baselines3's PPO.
The comparison flies it, the pretrained policy that steers all platforms at once, and rules on the same tapes.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
import tyro
from stable_baselines3 import PPO

from agents.activation import quicken
from agents.comparison import summarize
from agents.evaluation import fly_all, unique_names
from agents.files import make_folder, write_json
from agents.imitation import imitate
from agents.learned import CONFIG, MODEL, ModelPolicy, load_model, read_settings
from agents.main_job import FINAL_SEED
from agents.memory import keep_freed_memory
from agents.policy import Policy, make_policy, policy_names
from agents.pretrained import PRETRAINED, load_pretrained, pretrained_ids
from agents.provenance import commit, versions
from agents.report import as_markdown, write_evaluation
from agents.sb3 import Sb3VecEnv
from agents.training import LinearDecay, save_model, training_seed
from passive_env.catalogue import environment_id, make_scenario, scenario_name
from passive_env.scenario import parse_fields
from passive_env.team import Team
from passive_env.team_vector_env import TeamVectorEnv

BASELINES = ("paper", "fixed", "open", "rule", "planner")
"""Policies of the comparison, where a scenario offers them."""


@dataclass(frozen=True)
class Sharing:
    """Train one network that every platform decides by, then compare it with the central policy."""

    out: Path
    """Folder for evaluation.json, .csv, .md and pictures, and for model.zip and config.json of what is trained."""
    runs: tuple[Path, ...] = ()
    """Folders of finished runs to compare, instead of training one."""
    env: str = "passive/TwoStation-v0"
    """Environment id, of one with at least two steered platforms."""
    view: Literal["common", "own"] = "common"
    """What a platform sees: the common track and all platforms, or its own place and returns alone."""
    reward: Literal["team", "difference"] = "team"
    """What it earns: the environment's reward, or by how much it has raised that."""
    timesteps: int = 2_304_000
    """Decisions of platforms to learn from."""
    envs: int = 256
    """Episodes flown at once."""
    seed: int = 0
    """Seed of training."""
    teacher: str = "planner"
    """Policy that the network imitates first; 'none' for none."""
    teacher_episodes: int = 2048
    """Episodes that the teacher flies."""
    rewards: tuple[str, ...] = ("reward_log_range_error=0.5", "reward_log_range_bound=0.5")
    """Scenario keywords while learning, NAME=VALUE …: as the environment's preset."""
    episodes: int = 1000
    """Paired episodes of the comparison."""


class SharedPolicy(ModelPolicy):
    """A model that decides for every platform by that platform's share of the belief.

    Args:
        model: whose spaces are those of an agent.
        team: the agents.
    """

    def __init__(self, model: Any, team: Team):
        super().__init__(model, team.simulation)
        self._sight, self._actor = team.observe, _for_all(self._actor, team)


def _for_all(actor: Callable[[np.ndarray], np.ndarray], team: Team) -> Callable[[np.ndarray], np.ndarray]:
    """The environment's actions [e, a] of what all agents see [e, s, d], by an actor that knows one."""

    def act(seen: np.ndarray) -> np.ndarray:
        actions = actor(seen.reshape(-1, seen.shape[-1]))
        return team.joined(actions.reshape(*seen.shape[:2], -1))

    return act


def train(job: Sharing) -> SharedPolicy:
    """Train the shared network; leaves ``model.zip`` and ``config.json`` in the run's folder."""
    keep_freed_memory()
    torch.set_num_threads(1)
    name = scenario_name(job.env)
    learning = make_scenario(name, parse_fields(job.rewards))
    batch = TeamVectorEnv(learning, job.envs, job.view, job.reward)
    env = Sb3VecEnv(batch)
    env.seed(training_seed(job.seed))
    model = PPO(
        "MlpPolicy", env, seed=job.seed, device="cpu", learning_rate=LinearDecay(2e-4), n_steps=learning.steps,
        batch_size=min(2880, learning.steps * env.num_envs), n_epochs=10, gamma=0.98, gae_lambda=0.95, ent_coef=0.0,
        policy_kwargs={"net_arch": [64, 64], "log_std_init": -1.5},
    )  # fmt: skip
    quicken(model.policy)
    begin = time.perf_counter()
    if job.teacher != "none":
        imitate(
            model, learning, job.teacher, job.teacher_episodes, epochs=30, learning_rate=1e-3, noise=0.3,
            seed=training_seed(job.seed), critic=0.5, mirror=job.view == "common", team=batch.team,
        )  # fmt: skip
    model.learn(job.timesteps, progress_bar=True)
    seconds = time.perf_counter() - begin
    save_model(model, job.out / MODEL)
    write_json(job.out / CONFIG, asdict(job) | {"seconds": seconds, "versions": versions(), "commit": commit()})
    print(f"trained in {seconds:.0f} s, {time.process_time():.0f} s of processor time; run folder {job.out}")
    return SharedPolicy(model, _team(job.env, job.view))


def load_shared(run: Path, environment: str) -> SharedPolicy:
    """The shared network of a finished run.

    Raises:
        FileNotFoundError: no such run; ValueError: damaged, or made for another environment.
    """
    config = read_settings(run, "a run is made by 'python -m agents.parameter_sharing'")
    if not (isinstance(config, dict) and {"env", "view"} <= config.keys()):
        raise ValueError(f"{run / CONFIG}: is no shared network's configuration, it names no env and view; train again")
    if scenario_name(config["env"]) != scenario_name(environment):
        raise ValueError(f"{run}: its network was made for {config['env']}, not for {environment}; train another")
    team, model = _team(environment, config["view"]), load_model(run / MODEL, "ppo")
    if (model.observation_space, model.action_space) != (team.observation_space, team.action_space):
        raise ValueError(f"{run}: its network was made for another version of {environment}; train again")
    return SharedPolicy(model, team)


def _team(environment: str, view: str) -> Team:
    return Team(make_scenario(scenario_name(environment), {}).make_simulation(), view)


def compare(job: Sharing, shared: Mapping[str, Policy]) -> dict[str, Any]:
    """Fly shared networks, the central policy and rules on the same tapes; writes the files, prints the table."""
    name = scenario_name(job.env)
    scenario = make_scenario(name, {})
    known = [policy for policy in BASELINES if policy in policy_names(scenario)]
    policies = {policy: make_policy(policy, scenario) for policy in known}
    if environment_id(name) in pretrained_ids():
        policies[PRETRAINED] = load_pretrained(name, scenario)
    records = fly_all(scenario, {**policies, **shared}, job.episodes, FINAL_SEED)
    summary = summarize(environment_id(name), FINAL_SEED, records, [PRETRAINED])
    write_evaluation(job.out, summary, records, scenario)
    print(as_markdown(summary))
    return summary


def _shared(job: Sharing) -> dict[str, Policy]:
    """The networks to compare, by the names they have in tables."""
    if not job.runs:
        return {"shared": train(job)}
    names = unique_names([f"shared_{run.name}" for run in job.runs])
    return {name: load_shared(run, job.env) for name, run in zip(names, job.runs, strict=True)}


def main(arguments: Sequence[str] | None = None) -> int:
    """Entry point; returns the exit status, 2 for bad input."""
    job = tyro.cli(Sharing, args=arguments, prog="python -m agents.parameter_sharing")
    try:
        if any(make_folder(job.out).iterdir()):
            raise FileExistsError(f"--out {job.out}: holds files already; choose another folder")
        compare(job, _shared(job))
    except (ValueError, TypeError, OSError) as error:
        print(f"parameter_sharing: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
