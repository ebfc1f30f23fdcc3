"""Exporting a policy as an ONNX file, which is compared with the policy it was made from before it is written."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from gymnasium import spaces

from agents.evaluation import fly
from agents.files import atomic_write
from agents.learned import ActorPolicy, as_trained, open_policy, read_config
from agents.networks import rebuild
from agents.onnx_file import OnnxActor, is_onnx, onnx_bytes
from agents.pack import COMPARED_STEPS, Both, describe_run
from agents.packed import is_packed, read_packed
from agents.pretrained import packed_file
from passive_env.catalogue import environment_ids, make_scenario

COMPARED_SEED = 90_000_000
"""Of the first of the episodes in which both fly."""

SAME_WITHIN, MOST_DIFFERENT = 5e-6, 1e-3
"""Of actions in single precision, which for one observation alone or among others already differ by up to 1.2e-6; and
share of choices that may differ because two score alike to rounding."""


def export(source: str | Path, out: Path) -> OnnxActor:
    """Write a policy as an ONNX file.

    Args:
        source: folder made by ``passive-env train``, file made by ``passive-env pack``, or the id of an environment
            whose pretrained policy is meant.
        out: FILE.onnx.
    Returns:
        what was written.
    Raises:
        FileNotFoundError: no such run or file; ImportError: onnx or onnxruntime is not installed; ValueError: another
            ending, or a network that cannot be exported.
    """
    if not is_onnx(out):
        raise ValueError(f"--onnx {out}: must be the name of a file that ends in .onnx")
    path = packed_file(str(source)) if str(source) in environment_ids() else Path(source)
    description, arrays = _described(path)
    environment, fields = description["environment"], description["fields"]
    scenario = make_scenario(environment, fields)
    policy = open_policy(path, environment, scenario.make_simulation())
    simulation = as_trained(description, environment, scenario.make_simulation())
    rebuild(str(source), description["network"], arrays, simulation)  # whatever does not fit is named here
    content = onnx_bytes(description, arrays, simulation)
    actor = OnnxActor(out, content)
    actor.check(simulation)
    _check_same(out, scenario, ActorPolicy(actor, simulation, scenario), policy)
    atomic_write(out, content)
    return actor


def _described(path: Path) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """A policy's description and arrays."""
    if is_packed(path):
        return read_packed(path)
    return describe_run(path, read_config(path))


def _check_same(out: Path, scenario: Any, exported: ActorPolicy, policy: ActorPolicy) -> None:
    """The exported policy's commands are the policy's wherever that flies."""
    both = Both(policy, exported, SAME_WITHIN)
    fly(scenario, both, COMPARED_STEPS, COMPARED_SEED)
    allowed = 0.0 if isinstance(scenario.make_actions().space, spaces.Box) else MOST_DIFFERENT
    if not both.different_share <= allowed:
        raise ValueError(
            f"{out}: not written, {both.different_share:.2%} of its commands differ from the policy's by more than "
            f"{SAME_WITHIN}, up to {both.difference:g}"
        )
