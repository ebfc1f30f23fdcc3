"""Scenarios by name, one module per paper or problem; each becomes the environment ``passive/NAME-v0``."""

from __future__ import annotations

import difflib
from typing import Any

from passive_env.catalogue import (
    angle_fusion,
    maneuvering,
    mobile_placement,
    ownship,
    passive_radar,
    placement,
    two_station,
)
from passive_env.scenario import Scenario

SCENARIOS: dict[str, Any] = {
    **two_station.CATALOGUE,
    **ownship.CATALOGUE,
    **angle_fusion.CATALOGUE,
    **maneuvering.CATALOGUE,
    **placement.CATALOGUE,
    **mobile_placement.CATALOGUE,
    **passive_radar.CATALOGUE,
}
"""All scenarios by name."""

NAMESPACE, VERSION = "passive", "v0"


def environment_id(name: str) -> str:
    """Gymnasium id of a scenario."""
    return f"{NAMESPACE}/{name}-{VERSION}"


def environment_ids() -> list[str]:
    """All registered ids."""
    return [environment_id(name) for name in SCENARIOS]


def scenario_name(env_id: str) -> str:
    """Scenario of an environment id; the namespace and version may be left out.

    Raises:
        ValueError: unknown id, with the nearest known one.
    """
    name = env_id.split(":")[-1].removeprefix(f"{NAMESPACE}/").removesuffix(f"-{VERSION}")
    if name in SCENARIOS:
        return name
    near = difflib.get_close_matches(name, SCENARIOS, n=1, cutoff=0.4)
    hint = f"; did you mean {environment_id(near[0])!r}?" if near else ""
    raise ValueError(f"unknown environment {env_id!r}: known are {', '.join(environment_ids())}{hint}")


def make_scenario(scenario: str | Scenario, fields: dict[str, Any]) -> Any:
    """A scenario by name or value, with fields overridden.

    Raises:
        ValueError: unknown name or bad value; TypeError: unknown field.
    """
    base = SCENARIOS[scenario_name(scenario)] if isinstance(scenario, str) else scenario
    return base.replace(**fields)
