"""Acting by a network without what Stable-Baselines3 wraps around it.

`predict` builds a distribution about the network's output only to take its mode, and PyTorch computes a tanh slower
than the matrix product before it. Here blocks of observations that fit a core's cache pass through the same layers,
with NumPy's vectorised tanh in place; actions agree with `predict(…, deterministic=True)` to rounding of single
precision. Matrix products use as many threads as `torch.set_num_threads` allows.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
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
from agents.transmitter_network import SharedLayers, TransmitterPolicy

ROWS, SHARED_ROWS = 1024, 256
"""Observations in one block: of a chain, and of layers that work on every combination of every observation."""


class Chain:
    """Layers one after the other: linear ones, the first among them, tanh and ReLU.

    Attributes:
        layers: the modules, from flat observations to outputs.
    """

    rows = ROWS

    def __init__(self, layers: list[nn.Module]):
        self.layers = layers

    def __call__(self, x: torch.Tensor) -> np.ndarray:
        """Outputs [e, o] of observations [e, d]."""
        for layer in self.layers:
            if isinstance(layer, nn.Tanh):
                np.tanh(x.numpy(), out=x.numpy())  # the same memory
            else:
                x = layer(x)
        return x.numpy()


class Shared:
    """Layers that transmitters share.

    Attributes:
        layers: the module.
    """

    rows = SHARED_ROWS

    def __init__(self, layers: SharedLayers):
        self.layers = layers

    def __call__(self, x: torch.Tensor) -> np.ndarray:
        """Outputs [e, o] of observations [e, d]."""
        return self.layers.forward_actor(x).numpy()


class PlainActor:
    """Deterministic actions of a feed-forward network.

    The layers are the model's own: what it learns later shows at once.

    Args:
        network: outputs [e, o] of observations [e, d]: numbers of a Box before `squash`, or scores of all choices.
        space: of the actions.
        squash: whether outputs pass through tanh and are scaled to a Box; they are clipped otherwise.
    """

    def __init__(self, network: Chain | Shared, space: spaces.Box | spaces.MultiDiscrete, squash: bool = False):
        self.network, self.space, self.squash = network, space, squash
        self._act: Callable[[np.ndarray], np.ndarray] = self._numbers if isinstance(space, spaces.Box) else self._best

    def __call__(self, observation: np.ndarray) -> np.ndarray:
        """Actions [e, a], float32 or numbers of choices, of observations [e, d]."""
        x = torch.from_numpy(np.ascontiguousarray(observation, dtype=np.float32))
        with torch.inference_mode(), one_thread():
            return self._act(np.concatenate([self.network(block) for block in x.split(self.network.rows)]))

    def _numbers(self, output: np.ndarray) -> np.ndarray:
        box: Any = self.space
        if self.squash:
            return box.low + 0.5 * (np.tanh(output) + 1.0) * (box.high - box.low)
        return np.clip(output, box.low, box.high)

    def _best(self, output: np.ndarray) -> np.ndarray:
        """Of every set of choices the one with the highest score."""
        choices: Any = self.space
        ends = np.cumsum(choices.nvec)[:-1]
        return np.stack([scores.argmax(axis=1) for scores in np.split(output, ends, axis=1)], axis=1)


def outputs(space: spaces.Box | spaces.MultiDiscrete) -> int:
    """How many numbers a network puts out for a space of actions."""
    return int(np.prod(space.shape)) if isinstance(space, spaces.Box) else int(space.nvec.sum())


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
    """A model's actor without its wrapping; None if it is no feed-forward network of known layers on the CPU."""
    policy: Any = model.policy
    space = model.action_space
    if not isinstance(space, (spaces.Box, spaces.MultiDiscrete)) or model.device.type != "cpu":
        return None
    network, extractor = _network(policy)
    if network is None or type(extractor) is not FlattenExtractor:
        return None
    return PlainActor(network, space, policy.squash_output)


def _network(policy: Any) -> tuple[Chain | Shared | None, Any]:
    """A policy's actor and what flattens its observations; None for an actor of another kind."""
    if type(policy) is TransmitterPolicy and not policy.use_sde:
        return Shared(policy.mlp_extractor), policy.pi_features_extractor
    if type(policy) is ActorCriticPolicy and not policy.use_sde:
        return _chain([*policy.mlp_extractor.policy_net, policy.action_net]), policy.pi_features_extractor
    if type(policy) is SACPolicy and not policy.actor.use_sde:
        return _chain([*policy.actor.latent_pi, policy.actor.mu]), policy.actor.features_extractor
    return None, None


def _chain(layers: list[nn.Module]) -> Chain | None:
    """Layers as a chain, if all are known and the first is linear: a tanh in place must not meet the observations."""
    known = all(type(layer) in (nn.Linear, nn.Tanh, QuickTanh, nn.ReLU) for layer in layers)
    return Chain(layers) if known and type(layers[0]) is nn.Linear else None
