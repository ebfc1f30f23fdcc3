"""Training presets: a TOML file per family of scenarios (or for one of them), in it a section per algorithm."""

from __future__ import annotations

import tomllib
from importlib import resources
from typing import Any

from passive_env.catalogue import make_scenario


def load_preset(scenario_name: str, algo: str) -> dict[str, Any]:
    """Settings of an algorithm for a scenario: from the scenario's own file, or else from its family's.

    Raises:
        ValueError: no preset of that name.
    """
    family = type(make_scenario(scenario_name, {})).__name__
    files = (resources.files(__name__) / f"{name}.toml" for name in (scenario_name, family))
    texts = (file.read_text(encoding="utf-8") for file in files if file.is_file())
    presets = tomllib.loads(next(texts, ""))
    if algo not in presets:
        raise ValueError(
            f"no preset for algorithm {algo!r} in {scenario_name}: known are {', '.join(presets) or 'none'}"
        )
    return presets[algo]
