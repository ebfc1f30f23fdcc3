"""Trained policies: a run folder's model, or one in a file, checked against the environment it shall steer."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from stable_baselines3.common.base_class import BaseAlgorithm

from agents.actor import one_thread, plain_actor
from agents.algorithms import find_algorithm
from agents.networks import rebuild
from agents.onnx_file import is_onnx, read_onnx
from agents.packed import is_packed, read_packed
from passive_env.belief import Belief
from passive_env.catalogue import make_scenario
from passive_env.core import Simulation

CONFIG, MODEL = "config.json", "model.zip"


class ActorPolicy:
    """Steers by the actions of a function of the observation.

    Args:
        actor: actions of observations [e, d].
        simulation: the parts by which it was trained.
        shown: scenario whose observations it will be given; where it shows others than those it was trained on, they
            are made from the belief. None: the same.
    """

    def __init__(self, actor: Callable[[np.ndarray], np.ndarray], simulation: Simulation, shown: Any = None):
        self._actor = actor
        trained = simulation.scenario
        sees_otherwise = shown is not None and any(getattr(trained, n) != getattr(shown, n) for n in trained.sight)
        self._codec, self._sight = simulation.actions, simulation.observation if sees_otherwise else None

    def reset(self, belief: Belief) -> None:
        """The first decision shall not wait for a kernel to be loaded."""
        if belief is not None:
            self._codec.commands(np.zeros((len(belief.steps_left), self._codec.size)), belief)

    def act(self, belief: Belief, observation: np.ndarray) -> np.ndarray:
        """Commands [e, a] of observations [e, d]."""
        actions = self._actor(observation if self._sight is None else self._sight(belief))
        return self._codec.commands(self._codec.decode(actions, len(actions)), belief)


class ModelPolicy(ActorPolicy):
    """A model that steers by its deterministic action; a recurrent one remembers its episodes so far.

    Args:
        model: whose spaces are those of the environment.
        simulation, shown: as of `ActorPolicy`.
    """

    def __init__(self, model: BaseAlgorithm, simulation: Simulation, shown: Any = None):
        super().__init__(plain_actor(model) or self._predict, simulation, shown)
        self._model = model
        self._memory: Any = None  # a recurrent network's states [layers, e, hidden]; others have none

    def reset(self, belief: Belief) -> None:
        """Forget the episodes before."""
        self._memory = None
        super().reset(belief)

    def _predict(self, observation: np.ndarray) -> np.ndarray:
        """Actions of observations [e, d].

        Raises:
            ValueError: a recurrent model in the middle of another number of episodes.
        """
        if self._memory is not None and self._memory[0].shape[1] != len(observation):
            raise ValueError(
                f"{len(observation)} observations, but {self._memory[0].shape[1]} episodes are remembered: "
                "call reset() before other episodes"
            )
        with one_thread():
            actions, self._memory = self._model.predict(observation, self._memory, deterministic=True)
        return actions


class LearnedPolicy(ModelPolicy):
    """A trained model, checked against the environment it shall steer.

    Args:
        run: folder made by ``passive-env train``.
        environment: id of the environment it shall steer.
        simulation: that environment's parts.
    Raises:
        FileNotFoundError: no such run or model; ValueError: made for another environment or damaged.
    """

    def __init__(self, run: str | Path, environment: str, simulation: Simulation):
        config = read_config(Path(run))
        trained = _checked_parts(run, config, environment, simulation)
        model = load_model(Path(run) / MODEL, config["algo"])
        _check_spaces(Path(run) / MODEL, model, trained)
        super().__init__(model, trained, simulation.scenario)


class PackedPolicy(ActorPolicy):
    """A packed policy, checked against the environment it shall steer; its file needs no trust.

    Args:
        file: made by ``passive-env pack``.
        environment: id of the environment it shall steer.
        simulation: that environment's parts.
    Raises:
        FileNotFoundError: no such file; ValueError: made for another environment or damaged.
    """

    def __init__(self, file: str | Path, environment: str, simulation: Simulation):
        packed = read_packed(file)
        self.description = packed.description
        trained = _checked_parts(file, self.description, environment, simulation)
        actor = rebuild(str(file), self.description["network"], packed.arrays, trained)
        super().__init__(actor, trained, simulation.scenario)


class OnnxPolicy(ActorPolicy):
    """A policy in ONNX, checked against the environment it shall steer.

    Args:
        file: made by ``passive-env export``.
        environment: id of the environment it shall steer.
        simulation: that environment's parts.
    Raises:
        FileNotFoundError: no such file; ImportError: onnxruntime is not installed; ValueError: made for another
            environment or damaged.
    """

    def __init__(self, file: str | Path, environment: str, simulation: Simulation):
        actor = read_onnx(file)
        self.description = actor.description
        trained = _checked_parts(file, self.description, environment, simulation)
        actor.check(trained)
        super().__init__(actor, trained, simulation.scenario)


def is_policy_file(path: str | Path) -> bool:
    """Whether a name is that of one file that holds a policy, packed or in ONNX."""
    return is_packed(path) or is_onnx(path)


def is_trained(path: str | Path) -> bool:
    """Whether a name is that of a run folder, or of what should be one, or of a policy's file."""
    return Path(path).is_dir() or (Path(path) / CONFIG).exists() or is_policy_file(path)


def open_policy(path: str | Path, environment: str, simulation: Simulation) -> ActorPolicy:
    """The policy of a run folder or of a file; arguments and errors as of the class that is made."""
    kind = PackedPolicy if is_packed(path) else OnnxPolicy if is_onnx(path) else LearnedPolicy
    return kind(path, environment, simulation)


def read_config(run: Path) -> dict[str, Any]:
    """A run folder's resolved configuration.

    Raises:
        FileNotFoundError: not a run folder; ValueError: unreadable.
    """
    config = read_settings(run, f"a run folder is made by 'passive-env train --out {run}'")
    needed = ("environment", "observation_digest", "algo")
    missing = [name for name in needed if not (isinstance(config, dict) and name in config)]
    if not missing and not isinstance(trained_interface(config), dict):
        missing = ["interface"]
    if missing:
        raise ValueError(
            f"{run / CONFIG}: is no run's configuration, {', '.join(missing)} missing; restore it or train again"
        )
    return config


def read_settings(run: Path, how: str) -> Any:
    """What a folder's configuration file holds, whatever has been trained there.

    Args:
        run: folder.
        how: how such a folder is made, for messages.
    Raises:
        FileNotFoundError: there is no such file; ValueError: no JSON.
    """
    file = run / CONFIG
    if not file.is_file():
        raise FileNotFoundError(f"{run}: no {CONFIG} in it; {how}")
    try:
        return json.loads(file.read_text(encoding="utf-8"))
    except ValueError as error:
        raise ValueError(f"{file}: is no valid JSON ({error}); restore it or train again") from error


def load_model(file: Path, algo: str, **options: Any) -> BaseAlgorithm:
    """A saved model.

    Raises:
        FileNotFoundError: missing; ValueError: damaged file or unknown algorithm.
    """
    learner = find_algorithm(algo).learner
    if not file.is_file():
        raise FileNotFoundError(f"{file}: no such model; has the training run been finished?")
    try:
        return learner.load(file, device=options.pop("device", "cpu"), **options)
    except Exception as error:  # whatever Stable-Baselines3, zipfile, pickle and torch raise on foreign bytes
        reason = f"{type(error).__name__}: {error}".splitlines()[0]
        raise ValueError(
            f"{file}: damaged or not a saved {algo} model ({reason}); restore it or train again"
        ) from error


def observation_digest(simulation: Simulation) -> str:
    """Fingerprint of the observation's fields and of the actions: a model fits only where they are the same."""
    names = "|".join(f"{f.name},{f.unit},{f.scale}" for f in simulation.observation.fields)
    told = (names, str(simulation.actions.space), simulation.actions.meaning)
    return hashlib.sha256("|".join(filter(None, told)).encode()).hexdigest()[:16]


def trained_interface(config: dict[str, Any]) -> dict[str, Any]:
    """Fields by which a model sees and acts; runs of earlier versions name the kind of actions only."""
    return config.get("interface", {"actions": config.get("actions", "continuous")})


def as_trained(config: dict[str, Any], environment: str, simulation: Simulation) -> Simulation:
    """The parts by which a model sees and acts, where fields have the registered values: only commands leave it.

    That a user names a field's registered value makes no difference: the environment itself stays what it is.
    """
    scenario, registered = simulation.scenario, make_scenario(environment, {}).interface()
    changed = {
        name: value
        for name, value in trained_interface(config).items()
        if name in registered and getattr(scenario, name) == registered[name] != value
    }
    return replace(scenario, **changed).make_simulation() if changed else simulation


def _checked_parts(path: str | Path, config: dict[str, Any], environment: str, simulation: Simulation) -> Simulation:
    """The parts by which a model sees and acts, as of `as_trained`, in the environment that it shall steer.

    Args:
        path: of the model's folder or file, for messages.
        config: of the run that made the model.
        environment: id of that environment.
        simulation: its parts.
    Raises:
        ValueError: made for another environment, for other observations or actions, or trained with other fields.
    """
    _check_environment(Path(path), config, environment)
    trained = as_trained(config, environment, simulation)
    _check_fit(Path(path), config, environment, trained)
    return trained


def _check_spaces(file: Path, model: BaseAlgorithm, simulation: Simulation) -> None:
    ours = (simulation.observation.space, simulation.actions.space)
    if (model.observation_space, model.action_space) != ours:
        raise ValueError(
            f"{file}: made for observations {model.observation_space} and actions {model.action_space}, not for "
            f"{ours[0]} and {ours[1]}; it is not the model that {CONFIG} beside it describes"
        )


def _check_environment(run: Path, config: dict[str, Any], environment: str) -> None:
    made_for = config.get("environment")
    if made_for != environment:
        raise ValueError(
            f"{run}: its model was made for {made_for}, not for {environment}; train one with --env {environment}"
        )


def _check_fit(run: Path, config: dict[str, Any], environment: str, simulation: Simulation) -> None:
    if config.get("observation_digest") != observation_digest(simulation):
        raise ValueError(
            f"{run}: its model was made for other observations or actions of {environment} than this scenario has "
            f"(number of targets, action kind, or another version of the package); train again"
        )
    now = simulation.scenario.interface()
    for name, value in trained_interface(config).items():
        if now.get(name, value) != value:
            raise ValueError(
                f"{run}: its model was trained with {name}={value!r}, not {now[name]!r}; leave it out or train again"
            )
