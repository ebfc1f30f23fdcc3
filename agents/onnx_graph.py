"""The network of a policy as a graph in ONNX, from the same description and arrays as a packed policy's.

    observation [batch, d] float32  →  action [batch, a]: float32 in a Box, or int64 numbers of choices

Inside, before the network, values that are no number become 0 and others are cut to the observation's limits, as every
observation of this package is; behind it, numbers are cut (or squashed) to the Box and of scores the highest is chosen.
Numbers between are double: the action is that of the weights, whatever order a runtime adds in.
Source of the operators: ONNX operator set 18, https://onnx.ai/onnx/operators.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from gymnasium import spaces

from agents.networks import LAYERS
from agents.transmitter_network import NETWORK, network_settings
from passive_env.core import Simulation
from passive_env.extras import needs
from passive_env.observations import LIMIT

EXTRA = "onnx"
OBSERVATION, ACTION = "observation", "action"
OPERATORS, FORMAT = 18, 9
"""Operator set and version of the file format: known to every runtime since 2023."""

BENDS = {"tanh": "Tanh", "relu": "Relu"}


def graph(network: Mapping[str, Any], arrays: Mapping[str, np.ndarray], simulation: Simulation) -> Any:
    """A network's graph.

    Args:
        network, arrays: as of `agents.networks.describe`.
        simulation: parts of the environment in which it acts; it fits, as `agents.networks.rebuild` demands.
    Returns:
        an `onnx.ModelProto`.
    Raises:
        ImportError: onnx is not installed.
    """
    onnx = needs("onnx", EXTRA)
    nodes = Nodes(onnx)
    x = nodes.add("Cast", _limited(nodes), to=onnx.TensorProto.DOUBLE)
    output = {LAYERS: _layers, NETWORK: _per_transmitter}[network["kind"]](nodes, x, network, arrays, simulation)
    space = simulation.actions.space
    numbers = isinstance(space, spaces.Box)
    last = _to_box(nodes, output, space, network.get("squash", False)) if numbers else _best(nodes, output, space)
    nodes.add("Identity", last, output=ACTION)
    kind = onnx.TensorProto.FLOAT if numbers else onnx.TensorProto.INT64
    size = simulation.observation.space.shape[0]
    ends = [
        [onnx.helper.make_tensor_value_info(name, type_, ["batch", width])]
        for name, type_, width in ((OBSERVATION, onnx.TensorProto.FLOAT, size), (ACTION, kind, space.shape[0]))
    ]
    made = onnx.helper.make_graph(nodes.made, "policy", *ends, initializer=nodes.constants)
    operators = [onnx.helper.make_opsetid("", OPERATORS)]
    return onnx.helper.make_model(made, opset_imports=operators, ir_version=FORMAT, producer_name="passive-env")


class Nodes:
    """Nodes of a graph under construction.

    Attributes:
        onnx: the module.
        made, constants: in the order in which they were added.
    """

    def __init__(self, onnx: Any):
        self.onnx = onnx
        self.made: list[Any] = []
        self.constants: list[Any] = []

    def add(self, operator: str, *inputs: Any, output: str = "", **attributes: Any) -> str:
        """Add an operator's node; inputs are names, or arrays that become constants. Returns its output's name."""
        names = [value if isinstance(value, str) else self._constant(np.asarray(value)) for value in inputs]
        output = output or f"{operator.lower()}_{len(self.made)}"
        self.made.append(self.onnx.helper.make_node(operator, names, [output], **attributes))
        return output

    def linear(self, x: str, weight: np.ndarray, bias: np.ndarray | None = None) -> str:
        """A linear layer on the last axis; weight [out, in], bias [out]."""
        product = self.add("MatMul", x, weight.T.astype(np.float64))
        return product if bias is None else self.add("Add", product, bias.astype(np.float64))

    def part(self, x: str, begin: int, end: int) -> str:
        """Columns begin … end − 1 of a matrix."""
        return self.add("Slice", x, np.array([begin]), np.array([end]), np.array([1]))

    def _constant(self, array: np.ndarray) -> str:
        name = f"constant_{len(self.constants)}"
        self.constants.append(self.onnx.numpy_helper.from_array(np.ascontiguousarray(array), name))
        return name


def _limited(nodes: Nodes) -> str:
    """Observations within the limits, 0 for what is no number (`passive_env.observations.clip_value`)."""
    known = nodes.add("Where", nodes.add("IsNaN", OBSERVATION), np.float32(0.0), OBSERVATION)
    return nodes.add("Clip", known, np.float32(-LIMIT), np.float32(LIMIT))


def _to_box(nodes: Nodes, output: str, box: spaces.Box, squash: bool) -> str:
    """Numbers within a Box: cut there, or squashed by tanh."""
    low, high = (end.astype(np.float64) for end in (box.low, box.high))
    if squash:
        share = nodes.add("Mul", nodes.add("Add", nodes.add("Tanh", output), np.float64(1.0)), 0.5 * (high - low))
        output = nodes.add("Add", share, low)
    cut = nodes.add("Max", nodes.add("Min", output, high), low)
    return nodes.add("Cast", cut, to=nodes.onnx.TensorProto.FLOAT)


def _best(nodes: Nodes, output: str, choices: Any) -> str:
    """Of every set of choices the one with the highest score, the first of equal ones."""
    ends = np.cumsum(choices.nvec)
    best = [
        nodes.add("ArgMax", nodes.part(output, end - n, end), axis=1, keepdims=1)
        for n, end in zip(choices.nvec, ends, strict=True)
    ]
    return nodes.add("Concat", *best, axis=1)


def _layers(
    nodes: Nodes, x: str, network: Mapping[str, Any], arrays: Mapping[str, np.ndarray], simulation: Simulation
) -> str:
    """Linear layers with an activation between two of them."""
    last = len(network["sizes"]) - 2
    for i in range(last + 1):
        x = nodes.linear(x, arrays[f"weight_{i}"], arrays[f"bias_{i}"])
        x = nodes.add(BENDS[network["activation"]], x) if i < last else x
    return x


def _per_transmitter(
    nodes: Nodes, x: str, network: Mapping[str, Any], arrays: Mapping[str, np.ndarray], simulation: Simulation
) -> str:
    """Rates and scores as of `agents.transmitter_network.SharedLayers.forward_actor`, step by step."""
    layout, bend = network_settings(simulation.scenario), BENDS[network["activation"]]
    members = np.zeros((len(layout["combinations"]), layout["pool"]))
    np.put_along_axis(members, np.array(layout["combinations"]), 1.0, axis=1)
    each = _encoder(nodes, x, layout, arrays, bend)
    mean = nodes.add("ReduceMean", each, np.array([1]), keepdims=0)
    hidden = nodes.linear(each, arrays["member_weight"])
    if layout["discrete"]:
        hidden = nodes.add("MatMul", members, hidden)
    context = nodes.linear(mean, arrays["context_weight"], arrays["context_bias"])
    hidden = nodes.add("Add", hidden, nodes.add("Unsqueeze", context, np.array([1])))
    promise = _promises(nodes, x, layout, members, network["sharpness"])
    if promise is not None:
        log = nodes.add("Log", nodes.add("Add", promise, np.float64(1.0)))
        column = nodes.add("Unsqueeze", log, np.array([2]))
        hidden = nodes.add("Add", hidden, nodes.linear(column, arrays["promise_weight"]))
    score = nodes.linear(nodes.add(bend, hidden), arrays["score_weight"], arrays["score_bias"])
    score = nodes.add("Squeeze", score, np.array([2]))
    score = score if promise is None else nodes.add("Sub", score, promise)
    if not layout["moves"]:
        return score
    return nodes.add("Concat", nodes.linear(mean, arrays["move_weight"], arrays["move_bias"]), score, axis=1)


def _encoder(nodes: Nodes, x: str, layout: Mapping[str, Any], arrays: Mapping[str, np.ndarray], bend: str) -> str:
    """Features [batch, n, m] of every transmitter."""
    shared, n, f = layout["shared"], layout["pool"], layout["per_transmitter"]
    common = nodes.linear(
        nodes.part(x, 0, shared), arrays["actor_common_weight"], arrays["actor_common_bias"]
    )  # fmt: skip
    own = nodes.add("Reshape", nodes.part(x, shared, shared + n * f), np.array([-1, n, f]))
    own = nodes.linear(own, arrays["actor_own_weight"])
    x = nodes.add(bend, nodes.add("Add", nodes.add("Unsqueeze", common, np.array([1])), own))
    i = 1
    while f"actor_rest_{i}_weight" in arrays:  # its layers alternate with activations
        x = nodes.add(bend, nodes.linear(x, arrays[f"actor_rest_{i}_weight"], arrays[f"actor_rest_{i}_bias"]))
        i += 2
    return x


def _promises(nodes: Nodes, x: str, layout: Mapping[str, Any], members: np.ndarray, sharpness: float) -> str | None:
    """Sharpness times log promises of combinations [batch, c] or transmitters [batch, n]; None where none is shown."""
    if not layout["promised"]:
        return None
    begin = layout["shared"] + layout["pool"] * layout["per_transmitter"]
    promise = nodes.add("Mul", nodes.part(x, begin, begin + layout["promised"]), np.float64(sharpness))
    if layout["discrete"]:
        return promise
    without = np.where(members.T > 0.0, 0.0, np.inf)
    with_each = nodes.add("Add", nodes.add("Unsqueeze", promise, np.array([1])), without)
    return nodes.add("ReduceMin", with_each, np.array([2]), keepdims=0)
