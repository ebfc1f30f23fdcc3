"""Training presets: a TOML file per family of scenarios, with a section per algorithm.

A file of a scenario's own name says only in what that scenario differs from its family, and the section of a longer
training only in what it differs from the shorter one; without such a section the two are the same.
"""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from importlib import resources
from typing import Any

from passive_env.catalogue import make_scenario

LONGER = {"ppo_long": "ppo"}
"""The trainings that take their time, and the shorter ones that they otherwise repeat."""


def load_preset(scenario_name: str, algo: str) -> dict[str, Any]:
    """Settings of an algorithm for a scenario: its family's, with what the scenario's own file says instead.

    Raises:
        ValueError: no preset of that name.
    """
    family = type(make_scenario(scenario_name, {})).__name__
    presets = _read(family)
    if scenario_name != family:
        presets = _overridden(presets, _read(scenario_name))
    for longer, shorter in LONGER.items():
        if shorter in presets:
            presets = {**presets, longer: _overridden(presets[shorter], presets.get(longer, {}))}
    if algo not in presets:
        raise ValueError(
            f"no preset for algorithm {algo!r} in {scenario_name}: known are {', '.join(presets) or 'none'}"
        )
    return presets[algo]


def flights_share(preset: Mapping[str, Any], fields: Mapping[str, Any]) -> float:
    """Share of environments with recorded courses while a run learns; 0 where the user's fields chose the course."""
    return 0.0 if "course" in fields else preset.get("flights_share", 0.0)


def _read(name: str) -> dict[str, Any]:
    """A preset file's sections; none where there is no such file."""
    file = resources.files(__name__) / f"{name}.toml"
    return tomllib.loads(file.read_text(encoding="utf-8")) if file.is_file() else {}


def _overridden(base: dict[str, Any], changes: dict[str, Any]) -> dict[str, Any]:
    """Nested settings with some replaced or added."""
    merged = dict(base)
    for name, value in changes.items():
        old = base.get(name)
        merged[name] = _overridden(old, value) if isinstance(old, dict) and isinstance(value, dict) else value
    return merged
