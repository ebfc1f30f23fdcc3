"""A file format for policies that holds no code: plain float arrays and a description in JSON, in one ``.npz``.

Whatever bytes a file has, reading it runs none of them: no pickle, no class names, no more memory than a policy needs.
A file is a zip archive, without encryption, of NumPy arrays: ``description``, bytes of UTF-8 text, and float32 arrays
whose names and shapes follow from the description (`agents.networks`).
"""

from __future__ import annotations

import io
import json
import math
import zipfile
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from agents.files import atomic_write

FORMAT, FORMAT_VERSION = "passive-env policy", 1
SUFFIX = ".npz"
DESCRIPTION = "description"

MOST_BYTES, MOST_MEMBERS = 16 * 2**20, 100
"""A policy is not larger, packed or unpacked, and has no more arrays: what claims to be is refused unread."""

LARGEST = 1e6
"""No weight is larger: sums over layers stay finite."""

NEEDED = {
    "environment": str, "interface": dict, "observation_digest": str, "algo": str, "network": dict, "fields": dict,
}  # fmt: skip
"""Entries that every description has."""

HOW = "make one with 'passive-env pack RUN --out FILE.npz'"


class Packed(NamedTuple):
    """What a file holds.

    Attributes:
        description: configuration of the training run, and under "network" what the arrays mean.
        arrays: float32 by name, finite.
    """

    description: dict[str, Any]
    arrays: dict[str, np.ndarray]


def is_packed(path: str | Path) -> bool:
    """Whether a name is that of a packed policy's file."""
    return Path(path).suffix == SUFFIX


def write_packed(path: str | Path, description: Mapping[str, Any], arrays: Mapping[str, np.ndarray]) -> Path:
    """Write a policy; equal policies are equal files.

    Args:
        path: of the file, ending in .npz.
        description: entries of `NEEDED` and whatever else JSON can hold.
        arrays: by name; they are kept as float32.
    Raises:
        ValueError: another ending.
    """
    if not is_packed(path):
        raise ValueError(f"{path}: a packed policy's name must end in {SUFFIX}")
    members = {DESCRIPTION: np.frombuffer(write_description(description).encode(), dtype=np.uint8)}
    members |= {name: np.asarray(array, dtype="<f4") for name, array in arrays.items()}
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, array in members.items():
            content = io.BytesIO()
            np.lib.format.write_array(content, array, version=(1, 0), allow_pickle=False)
            archive.writestr(zipfile.ZipInfo(f"{name}.npy"), content.getvalue(), zipfile.ZIP_DEFLATED)  # without a time
    return atomic_write(path, buffer.getvalue())


def read_packed(path: str | Path) -> Packed:
    """Read a policy that anyone may have written.

    Raises:
        FileNotFoundError: no such file; ValueError: anything in it that a policy does not have, named.
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such packed policy; {HOW}")
    if path.stat().st_size > MOST_BYTES:
        raise ValueError(f"{path}: has {path.stat().st_size} bytes, a packed policy has at most {MOST_BYTES}")
    try:
        with zipfile.ZipFile(path) as archive:
            members = _members(path, archive)
    except (zipfile.BadZipFile, zlib.error, EOFError, OSError, NotImplementedError) as error:
        raise ValueError(f"{path}: damaged or no packed policy ({error}); {HOW}") from error
    if DESCRIPTION not in members:
        raise ValueError(f"{path}: no packed policy, it has no array {DESCRIPTION!r}; {HOW}")
    text = _array(f"{path}: {DESCRIPTION}", members.pop(DESCRIPTION), np.dtype(np.uint8)).tobytes()
    description = read_description(path, text, HOW)
    arrays = {name: _weights(f"{path}: {name}", content) for name, content in members.items()}
    return Packed(description, arrays)


def _members(path: Path, archive: zipfile.ZipFile) -> dict[str, bytes]:
    """Contents by name, after what the archive says of them has been found harmless."""
    infos = archive.infolist()
    if len(infos) > MOST_MEMBERS:
        raise ValueError(f"{path}: has {len(infos)} arrays, a packed policy has at most {MOST_MEMBERS}")
    size = sum(info.file_size for info in infos)
    if size > MOST_BYTES:
        raise ValueError(f"{path}: unpacks to {size} bytes, a packed policy to at most {MOST_BYTES}")
    members = {}
    for info in infos:
        name = info.filename.removesuffix(".npy")
        if name == info.filename or not name.isidentifier() or name in members:
            raise ValueError(f"{path}: member {info.filename!r} must be an array NAME.npy, every name once")
        if info.flag_bits & 1 or info.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
            raise ValueError(f"{path}: member {info.filename!r} must be stored or deflated, without a password")
        members[name] = _content(archive, info)
    return members


def _content(archive: zipfile.ZipFile, info: zipfile.ZipInfo) -> bytes:
    """A member's bytes, no more than it claims.

    `ZipFile.read` returns no more either, but unpacks all there is before it cuts. A read of 0 bytes checks no sum.
    """
    with archive.open(info) as file:
        return file.read(max(info.file_size, 1))


def _array(where: str, content: bytes, dtype: np.dtype) -> np.ndarray:
    """An array of this type, whose header claims exactly as many bytes as there are.

    Raises:
        ValueError: anything else, an array of Python objects above all.
    """
    stream = io.BytesIO(content)
    try:
        version = np.lib.format.read_magic(stream)
        if version != (1, 0):
            raise ValueError(f"version {version}, not (1, 0)")
        shape, _, found = np.lib.format.read_array_header_1_0(stream)
    except (ValueError, TypeError, SyntaxError, RecursionError, MemoryError) as error:
        raise ValueError(f"{where}: is no NumPy array ({str(error).splitlines()[0]}); {HOW}") from error
    if found != dtype:
        raise ValueError(f"{where}: has type {found}, must be {dtype}")
    claimed, there = math.prod(shape) * dtype.itemsize, len(content) - stream.tell()
    if claimed != there or any(length < 0 for length in shape):
        raise ValueError(f"{where}: has shape {shape} but {there} bytes of numbers; damaged")
    return np.load(io.BytesIO(content), allow_pickle=False)


def _weights(where: str, content: bytes) -> np.ndarray:
    array = _array(where, content, np.dtype("<f4"))
    if not np.isfinite(array).all():
        raise ValueError(f"{where}: has numbers that are not finite; damaged")
    if array.size and np.abs(array).max() > LARGEST:
        raise ValueError(f"{where}: has numbers beyond ±{LARGEST:g}; no trained network has")
    return np.ascontiguousarray(array)


def write_description(description: Mapping[str, Any]) -> str:
    """A policy's description as text, with the name and version of the format.

    Raises:
        ValueError: numbers that are not finite.
    """
    return json.dumps({"format": FORMAT, "format_version": FORMAT_VERSION, **description}, indent=1, allow_nan=False)


def read_description(where: str | Path, text: bytes, how: str) -> dict[str, Any]:
    """The description in a policy's file.

    Args:
        where: the file, for messages.
        text: what it says, UTF-8.
        how: how such a file is made, for messages.
    Raises:
        ValueError: no JSON, or an entry that is missing or of another type.
    """
    try:
        description = json.loads(text.decode(), parse_constant=_refuse)
    except (ValueError, RecursionError) as error:
        raise ValueError(f"{where}: {DESCRIPTION} is no valid JSON ({error})") from error
    if not isinstance(description, dict) or description.get("format") != FORMAT:
        raise ValueError(f"{where}: {DESCRIPTION} must say format = {FORMAT!r}; {how}")
    if description.get("format_version") != FORMAT_VERSION:
        raise ValueError(
            f"{where}: format_version = {description.get('format_version')!r}, this version of the package reads "
            f"{FORMAT_VERSION}; make it again from the run"
        )
    for name, kind in NEEDED.items():
        if not isinstance(description.get(name), kind):
            raise ValueError(
                f"{where}: {DESCRIPTION} has {name} = {description.get(name)!r}, must be a {kind.__name__}"
            )
    return description


def _refuse(constant: str) -> float:
    raise ValueError(f"{constant} is no number of JSON")
