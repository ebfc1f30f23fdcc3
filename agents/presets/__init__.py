"""Training presets, one TOML file per environment."""

from __future__ import annotations

import tomllib
from importlib import resources
from typing import Any


def load_preset(scenario_name: str, algo: str) -> dict[str, Any]:
    """Settings of an algorithm for a scenario.

    Raises:
        ValueError: no preset of that name.
    """
    file = resources.files(__name__) / f"{scenario_name}.toml"
    presets = tomllib.loads(file.read_text(encoding="utf-8")) if file.is_file() else {}
    if algo not in presets:
        raise ValueError(
            f"no preset for algorithm {algo!r} in {scenario_name}: known are {', '.join(presets) or 'none'}"
        )
    return presets[algo]
