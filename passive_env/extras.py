"""Optional dependencies: imported where they are needed, and asked for by name where they are missing."""

from __future__ import annotations

import importlib
from typing import Any


class MissingExtra(ImportError):
    """An optional dependency that is not installed."""


def needs(module: str, extra: str) -> Any:
    """An optional dependency's module.

    Args:
        module: what to import.
        extra: name of this package's extra that brings it.
    Raises:
        MissingExtra: not installed; it names the command that installs it.
    """
    try:
        return importlib.import_module(module)
    except ImportError as error:
        package = module.partition(".")[0]
        raise MissingExtra(
            f'{package} is not installed: python -m pip install "passive-env[{extra}]" ({error})', name=package
        ) from error
