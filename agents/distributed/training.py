"""Training by RLlib's PPO: many processes fly, this one learns. It leaves what training here (`agents.training`) does.

The preset is the same, the network is the same, and ``model.zip`` is a model of Stable-Baselines3: whatever takes a run
folder takes this one, without Ray. Before every rollout the learner is seeded from (seed, steps so far), and so are the
runners, so a run that was killed and resumed ends with the model of one that was not.
"""

# pyright: reportMissingImports=false

from __future__ import annotations

import os
import random
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import torch
from ray.rllib.algorithms.ppo import PPOConfig
from ray.rllib.core import DEFAULT_MODULE_ID
from ray.rllib.utils.metrics import ENV_RUNNER_RESULTS, EPISODE_RETURN_MEAN, NUM_ENV_STEPS_SAMPLED_LIFETIME
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.logger import configure
from tqdm import tqdm

from agents.distributed.cluster import cluster
from agents.distributed.env_runner import FINAL_ERROR, PassiveEnvRunner
from agents.distributed.module import module_spec, take_weights
from agents.files import write_json
from agents.learned import CONFIG, MODEL, load_model
from agents.memory import keep_freed_memory
from agents.presets import flights_share
from agents.training import (
    FINAL_RATE,
    Clock,
    Run,
    Yardstick,
    check_folder,
    flown,
    new_model,
    rollout_steps,
    save_model,
    training_env,
    training_seed,
)
from passive_env.catalogue import environment_id

CHECKPOINT = "checkpoint-"
"""Folders begin so; what follows are the steps flown. Each holds RLlib's own checkpoint and the model."""
RLLIB = "rllib"

ARGUMENTS = {
    "batch_size": "minibatch_size", "n_epochs": "num_epochs", "gamma": "gamma", "gae_lambda": "lambda_",
    "ent_coef": "entropy_coeff", "vf_coef": "vf_loss_coeff", "clip_range": "clip_param", "max_grad_norm": "grad_clip",
}  # fmt: skip
"""RLlib's names of a preset's arguments."""
DEFAULTS = {"ent_coef": 0.0, "vf_coef": 0.5, "clip_range": 0.2, "max_grad_norm": 0.5}
"""Stable-Baselines3's, where a preset says nothing."""


def train_on_ray(run: Run, address: str | None = None, resume: bool = False, progress: bool = True) -> Path:
    """Train and leave what `agents.training.train` leaves, with a folder ``checkpoint-STEPS`` for its checkpoint.

    Args:
        run: what to train; ``run.runners`` processes fly.
        address: of a running cluster; None starts one on this machine.
        resume, progress: as of `agents.training.train`.
    Returns:
        the model's file.
    Raises:
        as `agents.training.train` and `agents.distributed.cluster.cluster`.
    """
    check_folder(run, resume)
    begun = last_checkpoint(run.folder) if resume else None
    keep_freed_memory()
    with cluster(address, run.runners):
        torch.set_num_threads(run.preset.get("torch_threads", 1))
        clock = Clock(run.folder)
        env = training_env(run)
        model = new_model(run, env) if begun is None else load_model(begun / MODEL, run.algo, env=env)
        algorithm: Any = configuration(run, model).build_algo()
        try:
            if begun is None:
                write_json(run.folder / CONFIG, run.to_dict())
            else:
                _restore(algorithm, begun)
            _learn(run, algorithm, model, clock, progress)
        finally:
            algorithm.stop()
    save_model(flown(model), run.folder / MODEL)
    clock.save()
    env.close()
    return run.folder / MODEL


def configuration(run: Run, model: BaseAlgorithm) -> PPOConfig:
    """RLlib's configuration of a run that begins with a model.

    Raises:
        ValueError: an argument in the preset that RLlib has no name for.
    """
    rate, whole = run.preset["learning_rate"], rollout_steps(run)
    given = {**DEFAULTS, **run.preset.get("arguments", {})}
    unknown = sorted(given.keys() - ARGUMENTS.keys())
    if unknown:
        known = ", ".join(ARGUMENTS)
        raise ValueError(f"--engine rllib knows no {', '.join(unknown)}: a preset's arguments can be {known}")
    settings: Any = {ARGUMENTS[name]: value for name, value in given.items()}
    settings["minibatch_size"] = min(settings["minibatch_size"], whole)
    low = FINAL_RATE * rate
    decay = [[0, rate], [int((1.0 - FINAL_RATE) * run.timesteps), low], [run.timesteps, low]]
    settings_of_env = {**run.preset.get("scenario", {}), **run.fields, "truth": run.asymmetric}
    settings_of_env |= {"first_seed": training_seed(run.seed), "flights_share": flights_share(run.preset, run.fields)}
    return (
        PPOConfig()
        .environment(
            environment_id(run.scenario_name),
            env_config=settings_of_env,
            observation_space=model.observation_space,
            action_space=model.action_space,
        )
        .env_runners(
            env_runner_cls=PassiveEnvRunner,
            num_env_runners=run.runners,
            num_envs_per_env_runner=run.envs // run.runners,
            rollout_fragment_length=run.scenario.steps,
            sample_timeout_s=None,
        )
        .learners(num_learners=0)
        .rl_module(rl_module_spec=module_spec(model))
        .training(
            train_batch_size_per_learner=whole, lr=decay, use_kl_loss=False, vf_clip_param=float("inf"), **settings
        )
        .debugging(log_level="ERROR")
    )


def _learn(run: Run, algorithm: Any, model: BaseAlgorithm, clock: Clock, progress: bool) -> None:
    """Train until all steps are flown; the model has the weights then."""
    every = run.preset.get("checkpoint_rollouts", 20) * rollout_steps(run)
    logger = configure(str(run.folder / "tensorboard" / "log_0"), ["tensorboard"])
    yardstick = Yardstick(run)
    steps = steps_flown(algorithm)
    with tqdm(total=run.timesteps, initial=steps, unit="step", disable=not progress) as bar:
        while steps < run.timesteps:
            reseed(training_seed(run.seed) + steps)
            flown_by_runners = algorithm.train()[ENV_RUNNER_RESULTS]
            before, steps = steps, steps_flown(algorithm)
            bar.update(steps - before)
            logger.record("rollout/ep_rew_mean", flown_by_runners[EPISODE_RETURN_MEAN])
            logger.record(f"rollout/{FINAL_ERROR}", flown_by_runners[FINAL_ERROR])
            if steps // every > before // every and steps < run.timesteps:
                _update(model, algorithm, steps)
                for name, value in yardstick.figures(model).items():
                    logger.record(f"eval/{name}", value)
                save_checkpoint(run.folder, algorithm, model, steps)
                clock.save()
            logger.dump(steps)
    logger.close()
    _update(model, algorithm, steps)


def reseed(seed: int) -> None:
    """Seed everything by which a learner shuffles."""
    torch.manual_seed(seed)
    np.random.seed(seed % 2**32)  # noqa: NPY002  RLlib shuffles minibatches with a global generator
    random.seed(seed)


def steps_flown(algorithm: Any) -> int:
    """Steps that all runners have flown in this training."""
    return int(algorithm.metrics.peek((ENV_RUNNER_RESULTS, NUM_ENV_STEPS_SAMPLED_LIFETIME), default=0))


def _update(model: BaseAlgorithm, algorithm: Any, steps: int) -> None:
    """Give the model what has been learned."""
    take_weights(model, algorithm.learner_group.get_weights()[DEFAULT_MODULE_ID])
    model.num_timesteps = steps


def save_checkpoint(folder: Path, algorithm: Any, model: BaseAlgorithm, steps: int) -> Path:
    """Save a checkpoint whole or not at all, then remove the ones before."""
    older = _checkpoints(folder)
    neighbour, final = folder / f".{CHECKPOINT}{steps}.{os.getpid()}.tmp", folder / f"{CHECKPOINT}{steps}"
    algorithm.save_to_path(str((neighbour / RLLIB).resolve()))
    save_model(model, neighbour / MODEL)
    os.replace(neighbour, final)
    for path in older:
        shutil.rmtree(path)
    return final


def last_checkpoint(folder: Path) -> Path | None:
    """The folder's last whole checkpoint, None if it has none."""
    return max(_checkpoints(folder), key=_steps, default=None)


def _checkpoints(folder: Path) -> list[Path]:
    return [path for path in folder.glob(f"{CHECKPOINT}*") if path.is_dir() and _steps(path) >= 0]


def _steps(path: Path) -> int:
    text = path.name.removeprefix(CHECKPOINT)
    return int(text) if text.isdigit() else -1


def _restore(algorithm: Any, checkpoint: Path) -> None:
    """Go on from a checkpoint.

    Raises:
        ValueError: it is damaged.
    """
    try:
        algorithm.restore_from_path(str((checkpoint / RLLIB).resolve()))
    except Exception as error:  # whatever RLlib, pickle and pyarrow raise on foreign bytes
        reason = f"{type(error).__name__}: {error}".splitlines()[0]
        raise ValueError(f"{checkpoint}: damaged checkpoint ({reason}); remove it, or train again") from error
    if steps_flown(algorithm) != _steps(checkpoint):
        raise ValueError(f"{checkpoint}: damaged checkpoint (it holds {steps_flown(algorithm)} steps); remove it")
