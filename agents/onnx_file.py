"""Policies as ONNX files, which other runtimes and languages load: the graph, and inside it what it was made for.

A file's metadata have ``passive_env``, the description of a packed policy (`agents.packed`) with the fields of the
observation and the meaning of actions, and ``passive_env_sha256``, by which damage shows. Nothing in such a file is
code, but a graph may ask a runtime for any amount of work: what comes from a stranger should better be a packed policy.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from agents.actor import ROWS
from agents.onnx_graph import ACTION, EXTRA, OBSERVATION, graph
from agents.packed import MOST_BYTES, read_description, write_description
from passive_env.core import Simulation
from passive_env.extras import needs

SUFFIX = ".onnx"
DESCRIPTION, CHECKSUM = "passive_env", "passive_env_sha256"
UNKNOWN = "0" * 64
"""Stands in the file where its checksum shall stand while that is computed."""

HOW = "make one with 'passive-env export RUN --onnx FILE.onnx'"


class OnnxActor:
    """Deterministic actions of a policy in ONNX, by onnxruntime on one thread of the CPU.

    Args:
        where: what it was read from, for messages.
        content: bytes of the file.
    Attributes:
        description: as of `agents.packed.Packed`.
    Raises:
        ImportError: onnxruntime is not installed; ValueError: damaged, or no policy of this package.
    """

    def __init__(self, where: str | Path, content: bytes):
        self._where, self._session = where, _session(where, content)
        metadata = self._session.get_modelmeta().custom_metadata_map
        if DESCRIPTION not in metadata:
            raise ValueError(f"{where}: no policy of this package, its metadata have no {DESCRIPTION!r}; {HOW}")
        _check_sum(where, content, metadata.get(CHECKSUM, ""))
        self.description = read_description(where, metadata[DESCRIPTION].encode(), HOW)

    def __call__(self, observation: np.ndarray) -> np.ndarray:
        """Actions [e, a], float32 or numbers of choices, of observations [e, d]."""
        x = np.ascontiguousarray(observation, dtype=np.float32)
        blocks = [x[at : at + ROWS] for at in range(0, max(len(x), 1), ROWS)]
        return np.concatenate([self._session.run([ACTION], {OBSERVATION: block})[0] for block in blocks])

    def check(self, simulation: Simulation) -> None:
        """Refuse a graph that is not one from this environment's observations to its actions.

        Raises:
            ValueError: other inputs or outputs, or numbers that no action can be.
        """
        space, size = simulation.actions.space, simulation.observation.space.shape[0]
        kind = "tensor(float)" if space.dtype == np.float32 else "tensor(int64)"
        wanted = [(OBSERVATION, "tensor(float)", size), (ACTION, kind, space.shape[0])]
        found = [
            (end.name, end.type, end.shape[1] if len(end.shape) == 2 else end.shape)
            for end in (*self._session.get_inputs(), *self._session.get_outputs())
        ]
        if found != wanted:
            raise ValueError(f"{self._where}: its graph has the ends {found}, must have {wanted}; {HOW}")
        try:
            actions = self(np.zeros((2, size), dtype=np.float32))
        except Exception as error:  # whatever a runtime raises on foreign graphs
            raise ValueError(f"{self._where}: its graph does not run ({_first_line(error)}); {HOW}") from error
        if actions.shape != (2, *space.shape) or not all(row in space for row in actions):
            raise ValueError(f"{self._where}: its actions {actions.tolist()} do not lie in {space}; {HOW}")


def is_onnx(path: str | Path) -> bool:
    """Whether a name is that of an ONNX file."""
    return Path(path).suffix == SUFFIX


def onnx_bytes(description: Mapping[str, Any], arrays: Mapping[str, np.ndarray], simulation: Simulation) -> bytes:
    """A policy as the bytes of an ONNX file; equal policies are equal bytes.

    Args:
        description, arrays: as `agents.packed.write_packed` takes them.
        simulation: parts of the environment by which it sees and acts.
    Raises:
        ImportError: onnx is not installed.
    """
    onnx = needs("onnx", EXTRA)
    model = graph(description["network"], arrays, simulation)
    onnx.checker.check_model(model, full_check=True)
    described = {**description, "observation": _fields(simulation), "action": _meaning(simulation)}
    texts = {DESCRIPTION: write_description(described), CHECKSUM: UNKNOWN}
    onnx.helper.set_model_props(model, texts)
    content = model.SerializeToString(deterministic=True)
    return content.replace(UNKNOWN.encode(), hashlib.sha256(content).hexdigest().encode())


def read_onnx(path: str | Path) -> OnnxActor:
    """Read a policy.

    Raises:
        FileNotFoundError: no such file; ImportError, ValueError: as of `OnnxActor`.
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such ONNX file; {HOW}")
    if path.stat().st_size > MOST_BYTES:
        raise ValueError(f"{path}: has {path.stat().st_size} bytes, a policy has at most {MOST_BYTES}")
    return OnnxActor(path, path.read_bytes())


def _session(where: str | Path, content: bytes) -> Any:
    runtime = needs("onnxruntime", EXTRA)
    options = runtime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1  # handing over would take longer than the work
    options.log_severity_level = 4  # what goes wrong is raised
    try:
        return runtime.InferenceSession(content, options, providers=["CPUExecutionProvider"])
    except Exception as error:  # whatever onnxruntime and protobuf raise on foreign bytes
        raise ValueError(f"{where}: damaged or no ONNX file ({_first_line(error)}); {HOW}") from error


def _check_sum(where: str | Path, content: bytes, found: str) -> None:
    """Refuse a file that has been altered since it was made."""
    blank = content.replace(found.encode(), UNKNOWN.encode()) if len(found) == len(UNKNOWN) else b""
    if hashlib.sha256(blank).hexdigest() != found:
        raise ValueError(f"{where}: damaged or altered, its bytes do not fit its checksum {CHECKSUM}; {HOW}")


def _fields(simulation: Simulation) -> list[dict[str, str]]:
    """Name, unit and scale of every number of the observation."""
    return [{"name": f.name, "unit": f.unit, "scale": f.scale} for f in simulation.observation.fields]


def _meaning(simulation: Simulation) -> dict[str, Any]:
    """The space of actions in words, and what says in the package how they are meant."""
    return {"space": str(simulation.actions.space), "kind": type(simulation.actions).__name__}


def _first_line(error: Exception) -> str:
    return (str(error).splitlines() or [type(error).__name__])[0]
