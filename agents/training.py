"""Training with Stable-Baselines3: checkpoints, exact resume, TensorBoard, progress bar, evaluation on the way.

At every checkpoint the environment, torch and NumPy are seeded anew from (seed, steps so far). A run that was killed
and resumed therefore ends with the same model as one that was not: what lies between two checkpoints depends on the
saved model and that seed only. A checkpoint of an off-policy learner holds its replay buffer.
"""

from __future__ import annotations

import json
import os
import random
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback

from agents.activation import quicken
from agents.algorithms import ALGORITHMS, find_algorithm
from agents.asymmetric import AsymmetricPolicy, for_flying, sees_truth
from agents.evaluation import fly
from agents.files import write_json
from agents.imitation import imitate
from agents.learned import CONFIG, MODEL, ModelPolicy, load_model, observation_digest, read_config
from agents.memory import keep_freed_memory
from agents.mixture import RECORDED, JoinedVecEnv, recorded_environments
from agents.policy import make_policy, policy_names
from agents.presets import flights_share, load_preset
from agents.provenance import commit, versions
from agents.sb3 import Sb3VecEnv
from agents.transmitter_network import TransmitterPolicy, network_settings
from passive_env.catalogue import environment_id, make_scenario
from passive_env.vector_env import PassiveVectorEnv

CHECKPOINT, TRAINING = "checkpoint.zip", "training.json"
EVALUATION_EPISODES = 256
REFERENCES = ("paper", "fixed", "open", "rule")
"""Policies a model in training is compared with, where the scenario offers them."""

SAME = (
    "environment", "interface", "observation_digest", "algo", "seed", "timesteps", "envs", "runners", "fields",
    "preset",
)  # fmt: skip
"""Entries of a run's configuration that must be as they were for it to be resumed."""

EVALUATION_SEED = 2_000_000_000
"""Seeds of the evaluation on the way; far from training's and from the final evaluation's."""


@dataclass(frozen=True)
class Run:
    """A training run, resolved.

    Attributes:
        folder: where everything goes.
        scenario_name: catalogue name.
        fields: scenario fields given by the user; they hold in training and evaluation.
        algo, seed, device, timesteps, envs: as on the command line.
        preset: the rest (`agents.presets`).
        runners: processes in which RLlib flies; 0 trains with Stable-Baselines3, in this process.
    Raises:
        ValueError: unknown algorithm, or one that cannot be trained so.
    """

    folder: Path
    scenario_name: str
    fields: dict[str, Any]
    algo: str
    seed: int
    device: str
    timesteps: int
    envs: int
    preset: dict[str, Any]
    runners: int = 0

    def __post_init__(self) -> None:
        algorithm = find_algorithm(self.algo)
        refusal = algorithm.refusal(self.preset, self.training_scenario)
        if refusal is None and self.runners:
            refusal = algorithm.refusal_by_rllib()
        if refusal is not None:
            raise ValueError(f"--algo {self.algo} {refusal}")
        if self.runners and self.envs % self.runners:
            raise ValueError(f"--envs {self.envs}: must be a multiple of --runners {self.runners}")
        if self.runners and self.device != "cpu":
            raise ValueError(f"--device {self.device}: --engine rllib learns on the cpu; leave it out")

    @property
    def scenario(self) -> Any:
        """The scenario that is evaluated."""
        return make_scenario(self.scenario_name, self.fields)

    @property
    def training_scenario(self) -> Any:
        """The same with the preset's rewards."""
        return make_scenario(self.scenario_name, {**self.preset.get("scenario", {}), **self.fields})

    @property
    def preset_actions(self) -> str:
        """The kind of actions that the preset is written for; the user's fields may ask for another."""
        return make_scenario(self.scenario_name, self.preset.get("scenario", {})).actions

    @property
    def asymmetric(self) -> bool:
        """Whether the critic sees the truth (`agents.asymmetric`)."""
        return self.preset.get("asymmetric", False)

    def to_dict(self) -> dict[str, Any]:
        """What is saved beside the model."""
        return {
            "environment": environment_id(self.scenario_name),
            "observation_digest": observation_digest(self.training_scenario.make_simulation()),
            "interface": self.training_scenario.interface(),
            "algo": self.algo,
            "seed": self.seed,
            "device": self.device,
            "timesteps": self.timesteps,
            "envs": self.envs,
            "fields": self.fields,
            "preset": self.preset,
            "engine": "rllib" if self.runners else "sb3",
            "runners": self.runners,
            "scenario": self.scenario.to_dict(),
            "versions": versions(),
            "commit": commit(),
        }


def plan(
    scenario_name: str, folder: Path, algo: str = "ppo", seed: int = 0, device: str = "cpu",
    timesteps: int | None = None, envs: int | None = None, fields: dict[str, Any] | None = None, runners: int = 0,
) -> Run:  # fmt: skip
    """Resolve a run: what is not given comes from the preset.

    Raises:
        ValueError: unknown algorithm, one that does not suit the scenario, or numbers that are not positive.
    """
    if algo not in ALGORITHMS:
        raise ValueError(f"--algo {algo}: must be one of {', '.join(ALGORITHMS)}")
    preset = load_preset(scenario_name, algo)
    given = {"timesteps": timesteps, "envs": envs}
    chosen = {name: preset[name] if value is None else value for name, value in given.items()}
    for name, value in chosen.items():
        if value < 1:
            raise ValueError(f"--{name} {value}: must be at least 1")
    _check_device(device)
    return Run(folder, scenario_name, fields or {}, algo, seed, device, **chosen, preset=preset, runners=runners)


def _check_device(device: str) -> None:
    try:
        torch.empty(0, device="cpu" if device == "auto" else device)
    except (RuntimeError, AssertionError) as error:  # PyTorch without CUDA raises the latter
        raise ValueError(f"--device {device}: {str(error).splitlines()[0]}; use cpu, cuda or auto") from error


def train(run: Run, resume: bool = False, progress: bool = True) -> Path:
    """Train and leave ``model.zip``, ``config.json``, ``training.json`` and TensorBoard logs in the run's folder.

    The process keeps the memory that it frees from then on (`agents.memory`).

    Args:
        run: what to train.
        resume: go on from the folder's checkpoint; the run must be the one that was begun there.
        progress: show a progress bar.
    Returns:
        the model's file.
    Raises:
        FileExistsError: the folder exists and `resume` is False.
        FileNotFoundError, ValueError: nothing to resume, another run's folder, or a damaged checkpoint.
    """
    check_folder(run, resume)
    keep_freed_memory()
    torch.set_num_threads(run.preset.get("torch_threads", 1))
    clock = Clock(run.folder)
    env = training_env(run)
    model = _load_checkpoint(run, env) if resume and (run.folder / CHECKPOINT).exists() else new_model(run, env)
    if not resume:
        write_json(run.folder / CONFIG, run.to_dict())
    left = run.timesteps - model.num_timesteps
    if left > 0:
        model.learn(
            left, callback=Checkpoints(run, clock), log_interval=ALGORITHMS[run.algo].log_interval(run.envs),
            reset_num_timesteps=False, progress_bar=progress, tb_log_name="log",
        )  # fmt: skip
    save_model(flown(model), run.folder / MODEL)
    clock.save()
    env.close()
    return run.folder / MODEL


def check_folder(run: Run, resume: bool) -> None:
    """Refuse a folder that another run has begun in, or, to be resumed, none or another run's; raises as `train`."""
    if resume:
        _check_same_run(run)
    elif run.folder.exists() and any(run.folder.iterdir()):
        raise FileExistsError(
            f"{run.folder}: run folder already exists; choose another --out, or add --resume to go on with it"
        )


def training_env(run: Run) -> Sb3VecEnv | JoinedVecEnv:
    """The environments to learn in, the last ones with recorded courses (`flights_share`)."""
    scenario, share = run.training_scenario, flights_share(run.preset, run.fields)
    if share == 0.0:
        return _vector_env(scenario, run.envs, run.asymmetric)
    recorded = recorded_environments(run.envs, share)
    return JoinedVecEnv(
        [
            _vector_env(scenario, run.envs - recorded, run.asymmetric),
            _vector_env(scenario.replace(**RECORDED), recorded, run.asymmetric),
        ]
    )


def _vector_env(scenario: Any, envs: int, truth: bool) -> Sb3VecEnv:
    return Sb3VecEnv(PassiveVectorEnv(scenario, num_envs=envs, autoreset_mode="same_step"), truth=truth)


def flown(model: Any) -> BaseAlgorithm:
    """The model as it is flown: without a critic that sees the truth."""
    return for_flying(model) if sees_truth(model) else model


def save_model(model: BaseAlgorithm, file: Path, *include: str) -> None:
    """Save a model whole or not at all, with attributes that Stable-Baselines3 leaves out unless they are named."""
    neighbour = file.with_name(f".{file.stem}.{os.getpid()}.tmp.zip")
    model.save(neighbour, include=include)
    os.replace(neighbour, file)


class Clock:
    """Wall time of a run, in ``training.json``: what a killed process did after its last checkpoint does not count."""

    def __init__(self, folder: Path):
        self._file = folder / TRAINING
        self._before, self._begin = _saved_seconds(self._file) or 0.0, time.perf_counter()

    def save(self) -> None:
        """Write the seconds so far."""
        write_json(self._file, {"seconds": self._before + time.perf_counter() - self._begin})


def training_seconds(folder: Path) -> float | None:
    """Wall time of a finished run; without ``training.json`` what its TensorBoard logs span, None without these."""
    seconds = _saved_seconds(folder / TRAINING)
    return _logged_seconds(folder / "tensorboard") if seconds is None else seconds


def _saved_seconds(file: Path) -> float | None:
    return json.loads(file.read_text(encoding="utf-8"))["seconds"] if file.is_file() else None


def _logged_seconds(folder: Path) -> float | None:
    from tensorboard.backend.event_processing.event_file_loader import LegacyEventFileLoader

    spans = []
    for file in sorted(folder.rglob("events.out.tfevents.*")):
        times = [event.wall_time for event in LegacyEventFileLoader(str(file)).Load()]
        spans.append(max(times) - min(times))
    return float(sum(spans)) if spans else None


def training_seed(seed: int) -> int:
    """Start of the seeds a run may use: 10⁹ to itself, far from those of every evaluation."""
    return (10 + seed) * 10**9


class Checkpoints(BaseCallback):
    """Between rollouts: every so many, save a checkpoint, evaluate, and seed everything anew."""

    def __init__(self, run: Run, clock: Clock):
        super().__init__()
        self._run, self._clock = run, clock
        self._every = run.preset.get("checkpoint_rollouts", 20) * rollout_steps(run)
        self._next = 0
        self._yardstick = Yardstick(run)

    def _on_training_start(self) -> None:
        self._next = self.num_timesteps

    def _on_rollout_start(self) -> None:
        if self.num_timesteps < self._next:
            return
        if self.num_timesteps > 0:
            self._evaluate()
            save_model(self.model, self._run.folder / CHECKPOINT, "replay_buffer")
            self._clock.save()
        self._next = self.num_timesteps + self._every
        reseed(self.model, training_seed(self._run.seed) + self.num_timesteps)

    def _on_step(self) -> bool:
        return True

    def _on_rollout_end(self) -> None:
        final = [
            info["final_range_error_m"] for info in self.model.ep_info_buffer or [] if "final_range_error_m" in info
        ]
        if final:
            self.logger.record("rollout/final_range_error_m", float(np.mean(final)))

    def _evaluate(self) -> None:
        for name, value in self._yardstick.figures(self.model).items():
            self.logger.record(f"eval/{name}", value)


class Yardstick:
    """Compares a model in training with the references on fixed tapes."""

    def __init__(self, run: Run):
        self._run = run
        self._references: dict[str, float] = {}

    def figures(self, model: BaseAlgorithm) -> dict[str, float]:
        """Mean final error, of the kind that counts, and its ratio to every reference; by name in logs."""
        scenario = self._run.scenario
        if not self._references:
            for name in (known for known in REFERENCES if known in policy_names(scenario)):
                record = fly(scenario, make_policy(name, scenario), EVALUATION_EPISODES, EVALUATION_SEED)
                self._references[name] = float(record.final.mean())
        policy = ModelPolicy(flown(model), self._run.training_scenario.make_simulation(), shown=scenario)
        error = float(fly(scenario, policy, EVALUATION_EPISODES, EVALUATION_SEED).final.mean())
        ratios = {f"ratio_to_{name}": error / reference for name, reference in self._references.items()}
        return {f"final_{scenario.score}_error_m": error} | ratios


def reseed(model: BaseAlgorithm, seed: int) -> None:
    """Seed torch, NumPy, Python and the environment, and begin new episodes."""
    learner: Any = model  # the two underscored attributes hold what the next rollout starts from
    torch.manual_seed(seed)
    np.random.seed(seed % 2**32)  # noqa: NPY002  Stable-Baselines3 shuffles minibatches with the global generator
    random.seed(seed)
    env = model.get_env()
    assert env is not None
    model.action_space.seed(seed)  # off-policy learners begin with random actions
    env.seed(seed)
    learner._last_obs = env.reset()
    learner._last_episode_starts = np.ones(env.num_envs, dtype=bool)


def rollout_steps(run: Run) -> int:
    """Environment steps of one rollout: whole episodes of all environments."""
    return run.scenario.steps * run.envs


def new_model(run: Run, env: Sb3VecEnv | JoinedVecEnv) -> BaseAlgorithm:
    """The model that a run begins with: untrained, with the preset's first action, or taught by its teacher."""
    preset = run.preset
    algorithm = ALGORITHMS[run.algo]
    learner: Any = algorithm.learner
    network, more = _network(run, env)
    model = learner(
        network,
        env,
        seed=run.seed,
        device=run.device,
        learning_rate=LinearDecay(preset["learning_rate"]),
        policy_kwargs={"net_arch": list(preset["net_arch"]), **more, **preset.get("policy", {})},
        tensorboard_log=str(run.folder / "tensorboard"),
        **algorithm.arguments(preset, run.scenario.steps, run.envs),
    )
    quicken(model.policy)
    if "first_action" in preset and run.training_scenario.actions == run.preset_actions:
        begin_with(model, preset["first_action"])
    if "imitation" in preset:
        imitate(model, run.training_scenario, truth=env.truth, seed=training_seed(run.seed), **preset["imitation"])
    return model


def _network(run: Run, env: Sb3VecEnv | JoinedVecEnv) -> tuple[Any, dict[str, Any]]:
    """The policy's class, or its name, and settings that follow from the scenario."""
    if "network" in run.preset:
        return TransmitterPolicy, {"layout": network_settings(run.training_scenario, env.truth)}
    if env.truth is not None:
        return AsymmetricPolicy, {"truth_size": len(env.truth.fields)}
    return ALGORITHMS[run.algo].network, {}


def begin_with(model: BaseAlgorithm, action: Sequence[float]) -> None:
    """Let an untrained actor's mean action be this one, whatever it sees: a rule to start from.

    Args:
        model: of an on-policy algorithm that draws actions from a Box.
        action: values in the order of the action; each stands for as many of its numbers as there are more of these
            than of values. Two are one per kind where every platform has two kinds of numbers, whatever the number of
            platforms; as many as an action has numbers are the action itself.
    Raises:
        ValueError: no values, or not a whole number of an action's numbers for each.
    """
    policy: Any = model.policy
    bias = policy.action_net.bias
    each, over = divmod(len(bias), len(action)) if len(action) else (0, 0)
    if each == 0 or over:
        raise ValueError(
            f"first_action has {len(action)} values, must have one per kind of number or {len(bias)}, one per number "
            f"of an action: a divisor of {len(bias)}"
        )
    with torch.no_grad():
        bias.copy_(torch.as_tensor(np.repeat(action, each)))


FINAL_RATE = 0.02
"""Share of the learning rate that is left in the end."""


class LinearDecay:
    """Learning rate that falls linearly to `FINAL_RATE` of its start."""

    def __init__(self, start: float):
        self.start = start

    def __call__(self, progress_remaining: float) -> float:
        """Rate when this share of the training is left."""
        return self.start * max(progress_remaining, FINAL_RATE)


def _load_checkpoint(run: Run, env: Sb3VecEnv | JoinedVecEnv) -> BaseAlgorithm:
    model: Any = load_model(run.folder / CHECKPOINT, run.algo, env=env, device=run.device)
    quicken(model.policy)
    if not ALGORITHMS[run.algo].on_policy:
        model.replay_buffer.device = model.device  # it still names the device of the run that saved it
    return model


def _check_same_run(run: Run) -> None:
    begun = {"runners": 0} | read_config(run.folder)
    now = run.to_dict()
    for name in SAME:
        if begun.get(name) != now[name]:
            raise ValueError(
                f"{run.folder}: cannot resume, {name} was {begun.get(name)!r} when it began and is {now[name]!r} now"
            )
