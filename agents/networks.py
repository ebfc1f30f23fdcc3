"""Networks as plain arrays with a description, and back: what a packed policy (`agents.packed`) holds.

    kind "layers": weight_i [n_{i+1}, n_i] and bias_i [n_{i+1}] of linear layers, an activation between two of them
    kind "per_transmitter": the layers of `agents.transmitter_network` that the actor uses, by their names there

The description says sizes and activation; what else a network needs follows from the environment it acts in.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from torch import nn

from agents.activation import QuickTanh
from agents.actor import Chain, PlainActor, Shared, outputs
from agents.transmitter_network import NETWORK, SharedLayers, network_settings
from passive_env.core import Simulation

LAYERS = "layers"
ACTIVATIONS: dict[str, type[nn.Module]] = {"tanh": QuickTanh, "relu": nn.ReLU}
MOST_LAYERS, MOST_UNITS, MOST_SHARPNESS = 12, 4096, 1e6

CRITIC = "critic."
"""Parameters that start so are not needed to fly."""


def describe(actor: PlainActor) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """A network's description and its arrays.

    Raises:
        ValueError: a mixture of activations.
    """
    if isinstance(actor.network, Shared):
        layers = actor.network.layers
        described = {
            "kind": NETWORK, "sizes": list(layers.sizes), "activation": _activation([layers.bend]),
            "sharpness": float(layers.sharpness),
        }  # fmt: skip
        return described, {_plain(name): value.numpy() for name, value in _parameters(layers).items()}
    linear: list[Any] = actor.network.layers[::2]
    between = actor.network.layers[1::2]
    if not all(type(layer) is nn.Linear for layer in linear) or len(linear) != len(between) + 1:
        raise ValueError("only linear layers with one activation between two of them can be packed")
    arrays = {}
    sizes = [linear[0].weight.shape[1]]
    for i, layer in enumerate(linear):
        arrays |= {f"weight_{i}": layer.weight.detach().numpy(), f"bias_{i}": layer.bias.detach().numpy()}
        sizes.append(len(layer.bias))
    return {"kind": LAYERS, "sizes": sizes, "activation": _activation(between), "squash": actor.squash}, arrays


def rebuild(where: str, network: Mapping[str, Any], arrays: Mapping[str, np.ndarray], simulation: Simulation) -> Any:
    """The actor that a description and arrays say; neither needs to be trusted.

    Args:
        where: what they were read from, for messages.
        network, arrays: as of `describe`.
        simulation: parts of the environment in which it acts.
    Returns:
        a `PlainActor`.
    Raises:
        ValueError: an unknown kind, or whatever does not fit the environment or itself, named.
    """
    makers = {LAYERS: _chain, NETWORK: _shared}
    kind = network.get("kind")
    if not isinstance(kind, str) or kind not in makers:
        raise ValueError(f"{where}: network.kind = {kind!r}, must be one of {', '.join(map(repr, makers))}")
    return makers[kind](where, network, arrays, simulation)


def _chain(where: str, network: Mapping[str, Any], arrays: Mapping[str, np.ndarray], simulation: Simulation) -> Any:
    space = simulation.actions.space
    sizes, activation = _sizes(where, network), _known_activation(where, network)
    ends = (simulation.observation.space.shape[0], outputs(space))
    if len(sizes) < 2 or (sizes[0], sizes[-1]) != ends:
        raise ValueError(f"{where}: network.sizes = {sizes}, must begin with {ends[0]} and end with {ends[1]}")
    squash = network.get("squash")
    if not isinstance(squash, bool) or (squash and not hasattr(space, "low")):
        raise ValueError(f"{where}: network.squash = {squash!r}, must be true or false, and false for choices")
    expected: dict[str, tuple[int, ...]] = {}
    for i, (before, after) in enumerate(itertools.pairwise(sizes)):
        expected |= {f"weight_{i}": (after, before), f"bias_{i}": (after,)}
    _check(where, arrays, expected)
    layers: list[nn.Module] = []
    for i, (before, after) in enumerate(itertools.pairwise(sizes)):
        linear = nn.Linear(before, after, device="meta")  # without numbers: no random ones are drawn
        linear.load_state_dict(_tensors({"weight": arrays[f"weight_{i}"], "bias": arrays[f"bias_{i}"]}), assign=True)
        layers += [linear, activation()]
    return PlainActor(Chain(layers[:-1]), space, squash)


def _shared(where: str, network: Mapping[str, Any], arrays: Mapping[str, np.ndarray], simulation: Simulation) -> Any:
    sizes, activation = _sizes(where, network), _known_activation(where, network)
    sharpness = network.get("sharpness")
    if isinstance(sharpness, bool) or not isinstance(sharpness, (int, float)) or not 0.0 <= sharpness <= MOST_SHARPNESS:
        raise ValueError(f"{where}: network.sharpness = {sharpness!r}, must be a number in [0, {MOST_SHARPNESS:g}]")
    try:
        layout = network_settings(simulation.scenario)
    except ValueError as error:
        raise ValueError(f"{where}: {error}") from error
    with torch.device("meta"):
        layers = SharedLayers(layout, sizes, activation, float(sharpness))
    names = _parameters(layers)
    _check(where, arrays, {_plain(name): tuple(value.shape) for name, value in names.items()})
    layers.load_state_dict(_tensors({name: arrays[_plain(name)] for name in names}), strict=False, assign=True)
    return PlainActor(Shared(layers), simulation.actions.space)


def _parameters(layers: nn.Module) -> dict[str, torch.Tensor]:
    """The parameters that an actor uses."""
    return {name: value for name, value in layers.state_dict().items() if not name.startswith(CRITIC)}


def _plain(name: str) -> str:
    """A parameter's name as that of an array."""
    return name.replace(".", "_")


def _tensors(arrays: Mapping[str, np.ndarray]) -> dict[str, torch.Tensor]:
    return {name: torch.from_numpy(array.astype(np.float32)) for name, array in arrays.items()}


def _activation(layers: list[Any]) -> str:
    """The name of the activation of all layers.

    Raises:
        ValueError: several, or an unknown one.
    """
    found = {"tanh" if isinstance(layer, nn.Tanh) else type(layer).__name__.lower() for layer in layers} or {"tanh"}
    if len(found) > 1 or not found <= set(ACTIVATIONS):
        raise ValueError(f"activation {', '.join(sorted(found))}: only one of {', '.join(ACTIVATIONS)} can be packed")
    return found.pop()


def _known_activation(where: str, network: Mapping[str, Any]) -> type[nn.Module]:
    name = network.get("activation")
    if not isinstance(name, str) or name not in ACTIVATIONS:
        raise ValueError(f"{where}: network.activation = {name!r}, must be one of {', '.join(map(repr, ACTIVATIONS))}")
    return ACTIVATIONS[name]


def _sizes(where: str, network: Mapping[str, Any]) -> list[int]:
    sizes = network.get("sizes")
    whole = isinstance(sizes, list) and all(type(size) is int and 1 <= size <= MOST_UNITS for size in sizes)
    if not isinstance(sizes, list) or not whole or not 1 <= len(sizes) <= MOST_LAYERS:
        raise ValueError(
            f"{where}: network.sizes = {str(sizes)[:80]}, must be 1 to {MOST_LAYERS} whole numbers in [1, {MOST_UNITS}]"
        )
    return sizes


def _check(where: str, arrays: Mapping[str, np.ndarray], expected: Mapping[str, tuple[int, ...]]) -> None:
    """Refuse arrays that are missing, too many, or of another shape than the description says."""
    missing, more = sorted(expected.keys() - arrays.keys()), sorted(arrays.keys() - expected.keys())
    if missing or more:
        wrong = [f"lacks {', '.join(missing)}"] * bool(missing) + [f"also has {', '.join(more)}"] * bool(more)
        raise ValueError(f"{where}: {' and '.join(wrong)}; its network has the arrays {', '.join(expected)}")
    for name, shape in expected.items():
        if arrays[name].shape != shape:
            raise ValueError(f"{where}: {name} has shape {arrays[name].shape}, must be {shape}")
