"""A policy of Stable-Baselines3 as a module of RLlib: either trains the same network, and both leave the same file."""

# pyright: reportMissingImports=false

from __future__ import annotations

from typing import Any

import torch
from gymnasium import spaces
from ray.rllib.core.columns import Columns
from ray.rllib.core.distribution.torch.torch_distribution import TorchMultiCategorical
from ray.rllib.core.rl_module.apis.value_function_api import ValueFunctionAPI
from ray.rllib.core.rl_module.rl_module import RLModuleSpec
from ray.rllib.core.rl_module.torch import TorchRLModule
from stable_baselines3.common.base_class import BaseAlgorithm

from agents.activation import quicken


class PolicyModule(TorchRLModule, ValueFunctionAPI):
    """Actor and critic of an on-policy model; ``model_config`` as of `module_spec`.

    Attributes:
        policy: the `ActorCriticPolicy`.
    """

    def setup(self) -> None:
        """Build the network with the weights that it begins with."""
        settings: Any = self.model_config
        self.policy = settings["policy_class"](
            self.observation_space, self.action_space, lambda _: 0.0, **settings["policy_kwargs"]
        )
        quicken(self.policy)
        self.policy.load_state_dict(settings["weights"])
        if isinstance(self.action_space, spaces.MultiDiscrete):
            choices = [int(n) for n in self.action_space.nvec]
            scores: Any = TorchMultiCategorical
            self.action_dist_cls = scores.get_partial_dist_cls(input_lens=choices)

    def _forward(self, batch: dict[str, Any], **_: Any) -> dict[str, Any]:
        """Means and logarithms of standard deviations [e, 2 a] of numbers, or scores of all choices [e, c]."""
        drawn = self.policy.get_distribution(batch[Columns.OBS]).distribution
        if isinstance(drawn, list):
            inputs = torch.cat([choice.logits for choice in drawn], dim=-1)
        else:
            inputs = torch.cat([drawn.mean, drawn.stddev.log()], dim=-1)
        return {Columns.ACTION_DIST_INPUTS: inputs}

    def compute_values(self, batch: dict[str, Any], embeddings: Any = None) -> torch.Tensor:
        """Values [e] of observations."""
        return self.policy.predict_values(batch[Columns.OBS])[:, 0]


def module_spec(model: BaseAlgorithm) -> RLModuleSpec:
    """The module that begins with a model's weights."""
    learner: Any = model
    return RLModuleSpec(
        module_class=PolicyModule,
        observation_space=model.observation_space,
        action_space=model.action_space,
        model_config={
            "policy_class": learner.policy_class,
            "policy_kwargs": learner.policy_kwargs,
            "weights": {name: value.cpu() for name, value in learner.policy.state_dict().items()},
        },
    )


def take_weights(model: BaseAlgorithm, state: dict[str, Any]) -> None:
    """Give a model the weights that its module has learned; state: as of ``module.get_state()``."""
    prefix = "policy."
    weights = {name.removeprefix(prefix): torch.as_tensor(value) for name, value in state.items()}
    learner: Any = model
    learner.policy.load_state_dict(weights)
