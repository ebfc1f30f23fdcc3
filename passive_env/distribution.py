"""Detects other distributions that install modules of our top-level names.

`trackers` and `agents` are also module names of unrelated distributions on PyPI (`trackers`, `openai-agents`). When
both are installed into one environment, whichever came last has overwritten files of the other.
"""

from __future__ import annotations

import warnings
from importlib import metadata, util
from pathlib import Path

OURS = "passive-env"
RIVALS = {"trackers": ("trackers",), "agents": ("openai-agents", "agents")}
"""Distributions known to install a top-level module of each name."""


def check_names() -> None:
    """Make sure that `trackers` and `agents` are this project's own.

    Raises:
        ImportError: one of them belongs to another distribution; names it and the cure.
    Warns:
        RuntimeWarning: ours is intact, but another distribution that shares the name is installed too.
    """
    for name, rivals in RIVALS.items():
        installed = [rival for rival in rivals if _installed(rival)]
        if not _is_ours(name):
            raise ImportError(_message(name, installed or _owners(name)))
        if installed:
            warnings.warn(_message(name, installed), RuntimeWarning, stacklevel=3)


def _is_ours(name: str) -> bool:
    """Our packages carry the distribution's name in their `__init__`."""
    origin = _origin(name)
    mark = f'DISTRIBUTION = "{OURS}"'
    return origin is not None and mark in Path(origin).read_text(encoding="utf-8", errors="replace")


def _origin(name: str) -> str | None:
    """File that `import name` would run."""
    spec = util.find_spec(name)
    return spec.origin if spec else None


def _installed(distribution: str) -> bool:
    try:
        metadata.distribution(distribution)
    except metadata.PackageNotFoundError:
        return False
    return True


def _owners(name: str) -> list[str]:
    """Distributions that own a top-level module, ours left out (slow: reads all metadata)."""
    owners = {owner.lower().replace("_", "-") for owner in metadata.packages_distributions().get(name, [])}
    return sorted(owners - {OURS})


def _message(name: str, owners: list[str]) -> str:
    return (
        f"passive_env needs its own top-level package {name!r}, but {' and '.join(owners) or 'another distribution'} "
        f"installs a module of the same name ({name} is found at {_origin(name)}). "
        f"Install passive-env in a virtual environment of its own: "
        f"python -m venv .venv, then .venv/bin/python -m pip install passive-env"
    )
