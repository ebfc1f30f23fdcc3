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


CHANGED = "-dirty"
"""Mark of a commit whose sources have been changed since, as of ``git describe --dirty``."""


def commit() -> str | None:
    """Commit of the source tree this runs from, if it is one and git is there; `CHANGED` where code or presets are."""
    found = _git("rev-parse", "HEAD")
    if found is None or not (name := found.stdout.strip()):
        return None
    changed = _git("diff", "--quiet", "HEAD", "--", ":(top)*.py", ":(top)*.toml")
    return name + CHANGED if changed is not None and changed.returncode == 1 else name


def short_commit(name: str) -> str:
    """A commit's first digits, with its mark."""
    return name[:12] + (CHANGED if name.endswith(CHANGED) else "")


def _git(*words: str) -> subprocess.CompletedProcess[str] | None:
    git = shutil.which("git")
    if git is None:
        return None
    here = str(Path(__file__).resolve().parent)
    return subprocess.run([git, "-C", here, *words], capture_output=True, text=True, check=False)


def processor_name() -> str:
    """The processor's own name for itself, where the system tells it."""
    info = Path("/proc/cpuinfo")
    lines = info.read_text(encoding="utf-8").splitlines() if info.exists() else []
    names = [line.partition(":")[2].strip() for line in lines if line.lower().startswith("model name")]
    return names[0] if names else platform.processor() or platform.machine()
