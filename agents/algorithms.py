"""The learning algorithms by name, and all in which they differ. Their settings are the presets."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

from sb3_contrib import RecurrentPPO
from stable_baselines3 import PPO, SAC
from stable_baselines3.common.base_class import BaseAlgorithm

from agents import bound_gradient
from agents.transmitter_network import NETWORK


class Algorithm(NamedTuple):
    """A learner of Stable-Baselines3 or sb3-contrib, or one of ours with their interface.

    Attributes:
        learner: its class.
        network: name of its policy class.
        on_policy: it learns from whole episodes of all environments and forgets them. Otherwise it learns between steps
            from a replay buffer, knows continuous actions only, and cannot begin with a teacher's or a rule's actions.
        scenario_refusal: why it cannot learn from a scenario, None if it can; None: it learns from every one.
    """

    learner: type[BaseAlgorithm]
    network: str = "MlpPolicy"
    on_policy: bool = True
    scenario_refusal: Callable[[Any], str | None] | None = None

    def arguments(self, preset: dict[str, Any], steps: int, envs: int) -> dict[str, Any]:
        """The learner's keyword arguments: the preset's, cut to episodes of so many steps in so many environments."""
        given = dict(preset.get("arguments", {}))
        if not self.on_policy:
            return given
        return {**given, "n_steps": steps, "batch_size": min(given["batch_size"], steps * envs)}

    def log_interval(self, envs: int) -> int:
        """Log once per episode of all environments; off-policy learners count episodes, the others rollouts."""
        return 1 if self.on_policy else envs

    def refusal(self, preset: dict[str, Any], scenario: Any) -> str | None:
        """Why it cannot be trained with a preset on a scenario; None if it can."""
        if self.scenario_refusal is not None and (words := self.scenario_refusal(scenario)) is not None:
            return words
        actions = scenario.actions
        if not self.on_policy and actions == "discrete":
            return f"cannot choose among actions={actions!r}, it needs a Box of them, such as actions='continuous'"
        if not self.on_policy and "imitation" in preset:
            return "cannot imitate a teacher first, its preset must not have a section 'imitation'"
        if not self.on_policy and "first_action" in preset:
            return "has no mean action to begin with, its preset must not say 'first_action'"
        if preset.get("asymmetric", False) and (self.learner, self.network) != (PPO, "MlpPolicy"):
            return "has no critic that could know more than its actor, its preset must not say 'asymmetric = true'"
        if "network" in preset:
            return self._network_refusal(preset)
        return None

    def refusal_by_rllib(self) -> str | None:
        """Why RLlib cannot train it; None if it can."""
        return None if self.learner is PPO else "is none that --engine rllib trains: take ppo, ppo_long or ppo_scratch"

    def _network_refusal(self, preset: dict[str, Any]) -> str | None:
        if preset["network"] != NETWORK:
            return f"knows no network {preset['network']!r}: its preset must say {NETWORK!r}, or leave it out"
        if self.learner is not PPO or "first_action" in preset:
            return f"cannot take network = {NETWORK!r}: it is for ppo without 'first_action'"
        return None


ALGORITHMS: dict[str, Algorithm] = {
    "ppo": Algorithm(PPO),
    "ppo_long": Algorithm(PPO),
    "ppo_scratch": Algorithm(PPO),
    "recurrent_ppo": Algorithm(RecurrentPPO, "MlpLstmPolicy"),
    "sac": Algorithm(SAC, on_policy=False),
    "bound_gradient": Algorithm(bound_gradient.BoundGradient, scenario_refusal=bound_gradient.refusal),
}
"""Algorithms by the name `--algo` takes; each has its settings in a scenario's preset (`agents.presets`)."""


def find_algorithm(name: str) -> Algorithm:
    """An algorithm by its name.

    Raises:
        ValueError: unknown.
    """
    if name not in ALGORITHMS:
        raise ValueError(f"unknown algorithm {name!r}: known are {', '.join(ALGORITHMS)}")
    return ALGORITHMS[name]
