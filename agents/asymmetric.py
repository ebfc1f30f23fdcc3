"""Asymmetric actor-critic: while a policy learns, its critic sees the truth and its actor the belief only.

How large an error will be depends on luck that the belief cannot know: how far the target really is, which way it will
turn. A critic that knows part of it explains more of the rewards, so that less noise is left in what the actor learns
from. Nothing of the critic is needed to fly.

Source: Pinto, Andrychowicz, Welinder, Zaremba and Abbeel, "Asymmetric Actor Critic for Image-Based Robot Learning",
Robotics: Science and Systems 2018; here with proximal policy optimisation.
"""

from __future__ import annotations

from typing import Any

import torch
from gymnasium import spaces
from stable_baselines3 import PPO
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.torch_layers import MlpExtractor
from torch import nn


class AsymmetricPolicy(ActorCriticPolicy):
    """A policy for observations [belief | truth] whose actor reads the belief's part only.

    Args:
        truth_size: how many of an observation's last numbers are the truth's.
        the others: as of `ActorCriticPolicy`.
    """

    def __init__(self, *arguments: Any, truth_size: int, **settings: Any):
        self.truth_size = truth_size  # before the base class, which builds the networks
        super().__init__(*arguments, **settings)

    def _build_mlp_extractor(self) -> None:
        self.mlp_extractor: Any = _SplitExtractor(
            self.features_dim, self.truth_size, list(self.net_arch), self.activation_fn, self.device
        )

    def flown(self) -> tuple[Any, dict[str, Any], dict[str, torch.Tensor]]:
        """Class or name, settings and the actor's parameters of a policy that acts alike and is not shown the truth."""
        return "MlpPolicy", {}, _actor(self.state_dict())


class _SplitExtractor(nn.Module):
    """Hidden layers of an actor that reads the first features and of a critic that reads all."""

    def __init__(self, size: int, truth_size: int, layers: list[Any], activation: type[nn.Module], device: Any):
        super().__init__()
        self._belief_size = size - truth_size
        self.actor = MlpExtractor(self._belief_size, {"pi": layers, "vf": []}, activation, device)
        self.critic = MlpExtractor(size, {"pi": [], "vf": layers}, activation, device)
        self.latent_dim_pi, self.latent_dim_vf = self.actor.latent_dim_pi, self.critic.latent_dim_vf

    def forward(self, features: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        return self.forward_actor(features), self.forward_critic(features)

    def forward_actor(self, features: torch.Tensor) -> torch.Tensor:
        return self.actor.forward_actor(features[..., : self._belief_size])

    def forward_critic(self, features: torch.Tensor) -> torch.Tensor:
        return self.critic.forward_critic(features)


def sees_truth(model: Any) -> bool:
    """Whether a model's critic is shown the truth behind the belief."""
    return getattr(model.policy, "truth_size", 0) > 0


def for_flying(model: Any) -> PPO:
    """A PPO model with the same actor, for observations without the truth, of one whose critic sees it.

    Its critic is untrained: whoever wants to go on learning with it has to teach that anew.
    """
    low, high = model.observation_space.low, model.observation_space.high
    belief = len(low) - model.policy.truth_size
    network, settings, actor = model.policy.flown()
    kept = {name: value for name, value in model.policy_kwargs.items() if name != "truth_size"}
    learner: Any = PPO  # its type wants an environment even where none is needed
    plain = learner(
        network, None, learning_rate=model.learning_rate, n_steps=model.n_steps, batch_size=model.batch_size,
        n_epochs=model.n_epochs, gamma=model.gamma, gae_lambda=model.gae_lambda, device=model.device,
        policy_kwargs={**kept, **settings},
        _init_setup_model=False,
    )  # fmt: skip
    plain.observation_space = spaces.Box(low[:belief], high[:belief])
    plain.action_space, plain.n_envs = model.action_space, model.n_envs
    plain._setup_model()
    plain.policy.load_state_dict(actor, strict=False)
    plain.num_timesteps = model.num_timesteps
    return plain


def _actor(state: dict[str, torch.Tensor]) -> dict[str, torch.Tensor]:
    """The actor's part of a policy's parameters, named as in a plain policy."""
    part = "mlp_extractor.actor."
    hidden = {name.replace(part, "mlp_extractor."): value for name, value in state.items() if name.startswith(part)}
    return hidden | {name: value for name, value in state.items() if name.startswith(("action_net.", "log_std"))}
