"""Where a result comes from: versions, commit, processor. No computer's name, no user's."""

from __future__ import annotations

import platform
import shutil
import subprocess
from collections.abc import Iterable
from importlib import metadata
from pathlib import Path

NUMERIC = ("passive-env", "numpy", "scipy", "numba")
"""Distributions that decide what trackers compute."""
LEARNING = ("gymnasium", "stable-baselines3", "sb3-contrib", "torch")
"""Distributions that decide what is learned besides."""


def versions(names: Iterable[str] = (*NUMERIC, *LEARNING)) -> dict[str, str]:
    """Versions of everything that decides a result: Python's and those of distributions."""
    return {"python": platform.python_version(), **{name: _version(name) for name in names}}


def _version(name: str) -> str:
    try:
        return metadata.version(name)
    except metadata.PackageNotFoundError:
        return "not installed"


def commit() -> str | None:
    """Commit of the source tree this runs from, if it is one and git is there."""
    git = shutil.which("git")
    if git is None:
        return None
    here = Path(__file__).resolve().parent
    done = subprocess.run([git, "-C", str(here), "rev-parse", "HEAD"], capture_output=True, text=True, check=False)
    return done.stdout.strip() or None


def processor_name() -> str:
    """The processor's own name for itself, where the system tells it."""
    info = Path("/proc/cpuinfo")
    lines = info.read_text(encoding="utf-8").splitlines() if info.exists() else []
    names = [line.partition(":")[2].strip() for line in lines if line.lower().startswith("model name")]
    return names[0] if names else platform.processor() or platform.machine()
