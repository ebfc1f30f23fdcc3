"""Files that are never half-written: everything goes to a neighbour first and is then renamed."""

from __future__ import annotations

import io
import json
import math
import os
import uuid
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure


def atomic_write(path: str | Path, content: bytes | str) -> Path:
    """Write a file whole or not at all; missing folders are made, an older file is replaced.

    Args:
        path: where the file shall stand.
        content: bytes, or text to be written as UTF-8.
    """
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    neighbour = path.with_name(f".{path.name}.{uuid.uuid4().hex}.tmp")
    try:
        with open(neighbour, "xb") as file:
            file.write(content.encode() if isinstance(content, str) else content)
            file.flush()
            os.fsync(file.fileno())
        os.replace(neighbour, path)
    finally:
        neighbour.unlink(missing_ok=True)
    return path


def make_folder(path: str | Path, flag: str = "--out") -> Path:
    """Make a folder for results before anything is computed for it.

    Raises:
        FileExistsError: a file of that name stands there; OSError: it cannot be made. Both name the flag.
    """
    path = Path(path)
    if path.exists() and not path.is_dir():
        raise FileExistsError(f"{flag} {path}: is a file, must name a folder")
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OSError(f"{flag} {path}: cannot be made a folder ({error.strerror})") from error
    return path


def write_text(path: str | Path, text: str) -> Path:
    """Write text, ending in one newline."""
    return atomic_write(path, text.rstrip("\n") + "\n")


def write_json(path: str | Path, data: Any) -> Path:
    """Write data as strict JSON: NumPy values as numbers and lists, paths as text, NaN and infinities as null."""
    return write_text(path, json.dumps(_plain(data), indent=2, allow_nan=False, ensure_ascii=False))


def save_figure(path: str | Path, figure: Figure) -> Path:
    """Write a figure as PNG, without time or library version in it, so that equal pictures are equal files."""
    buffer = io.BytesIO()
    FigureCanvasAgg(figure).print_png(buffer, metadata={"Software": None})
    return atomic_write(path, buffer.getvalue())


def _plain(value: Any) -> Any:
    """The same data in JSON's own types.

    Raises:
        TypeError: a value JSON has no form for.
    """
    if isinstance(value, dict):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, np.ndarray):
        return _plain(value.tolist())
    if isinstance(value, (list, tuple)):
        return [_plain(item) for item in value]
    if isinstance(value, np.generic):
        value = value.item()
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if value is None or isinstance(value, (bool, int, str)):
        return value
    if isinstance(value, Path):
        return str(value)
    raise TypeError(f"{type(value).__name__} has no form in JSON: {value!r}")
