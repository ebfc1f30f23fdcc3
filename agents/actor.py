"""Acting by a plain feed-forward network without what Stable-Baselines3 wraps around it.

`predict` builds a distribution about the network's output only to take its mode, and PyTorch computes a tanh slower
than the matrix product before it. Here blocks of observations that fit a core's cache pass through the same layers,
with NumPy's vectorised tanh in place; actions agree with `predict(…, deterministic=True)` to rounding of single
precision. Matrix products use as many threads as `torch.set_num_threads` allows.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import torch
from gymnasium import spaces
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.torch_layers import FlattenExtractor
from stable_baselines3.sac.policies import SACPolicy
from torch import nn

from agents.activation import QuickTanh

ROWS = 1024
"""Observations in one block."""


class PlainActor:
    """Deterministic actions of a model whose actor is a chain of linear layers, tanh and ReLU.

    The layers are the model's own: what it learns later shows at once.

    Args:
        layers: from flat observations to actions, before `squash`.
        space: of the actions.
        squash: whether the last layer's output passes through tanh and is scaled to the space; it is clipped otherwise.
    """

    def __init__(self, layers: list[nn.Module], space: spaces.Box, squash: bool):
        self._layers, self._space, self._squash = layers, space, squash

    def __call__(self, observation: np.ndarray) -> np.ndarray:
        """Actions [e, a] float32 of observations [e, d]."""
        x = torch.from_numpy(np.ascontiguousarray(observation, dtype=np.float32))
        with torch.inference_mode(), one_thread():
            output = np.concatenate([self._pass(block) for block in x.split(ROWS)])
        low, high = self._space.low, self._space.high
        if self._squash:
            return low + 0.5 * (np.tanh(output) + 1.0) * (high - low)
        return np.clip(output, low, high)

    def _pass(self, x: torch.Tensor) -> np.ndarray:
        for layer in self._layers:
            if isinstance(layer, nn.Tanh):
                np.tanh(x.numpy(), out=x.numpy())  # the same memory
            else:
                x = layer(x)
        return x.numpy()


@contextmanager
def one_thread() -> Iterator[None]:
    """PyTorch on one thread for a moment."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def plain_actor(model: BaseAlgorithm) -> PlainActor | None:
    """A model's actor without its wrapping; None if it is no plain network on the CPU that acts in a Box."""
    policy: Any = model.policy
    space = model.action_space
    if not isinstance(space, spaces.Box) or model.device.type != "cpu":
        return None
    if type(policy) is ActorCriticPolicy and not policy.use_sde:
        layers, extractor = [*policy.mlp_extractor.policy_net, policy.action_net], policy.pi_features_extractor
    elif type(policy) is SACPolicy and not policy.actor.use_sde:
        layers, extractor = [*policy.actor.latent_pi, policy.actor.mu], policy.actor.features_extractor
    else:
        return None
    known = all(type(layer) in (nn.Linear, nn.Tanh, QuickTanh, nn.ReLU) for layer in layers)
    starts_anew = type(layers[0]) is nn.Linear  # a tanh in place must not meet the observations themselves
    plain = known and starts_anew and type(extractor) is FlattenExtractor
    return PlainActor(layers, space, policy.squash_output) if plain else None
