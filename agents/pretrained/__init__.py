"""Trained policies that come with the package, at most one per environment, packed without code (`agents.packed`).

``NAME.npz`` is the policy of ``passive/NAME-v0``, ``NAME.md`` its model card, ``NAME.json`` what it reached when it was
packed. ``passive-env pack RUN --out agents/pretrained/NAME.npz`` makes all three.
"""

from __future__ import annotations

import json
from importlib import resources
from pathlib import Path
from typing import Any

from agents.packed import SUFFIX
from passive_env.catalogue import SCENARIOS, environment_id, make_scenario, scenario_name

PRETRAINED = "pretrained"
"""Its name among an environment's policies."""

MOST_FILE_BYTES = 500_000
"""A policy in the package is smaller."""


def pretrained_ids() -> list[str]:
    """Ids of the environments that have a pretrained policy."""
    return [environment_id(name) for name in SCENARIOS if _file(name, SUFFIX).is_file()]


def load_pretrained(environment: str, scenario: Any = None) -> Any:
    """The pretrained policy of an environment.

    Args:
        environment: id, such as ``passive/Ownship-v0``.
        scenario: what it shall fly, a variant of that environment with the same observation; None: as registered.
    Returns:
        an `agents.policy.Policy`.
    Raises:
        ValueError: an unknown environment, one without a pretrained policy, or a variant with another observation.
    """
    from agents.learned import PackedPolicy

    file, name = packed_file(environment), scenario_name(environment)
    scenario = make_scenario(name, {}) if scenario is None else scenario
    return PackedPolicy(file, environment_id(name), scenario.make_simulation())


def packed_file(environment: str) -> Path:
    """The packed file of an environment's pretrained policy.

    Raises:
        ValueError: an unknown environment, or one without a pretrained policy.
    """
    name = scenario_name(environment)
    if environment_id(name) not in pretrained_ids():
        raise ValueError(
            f"{environment_id(name)} has no pretrained policy: there are those of "
            f"{', '.join(pretrained_ids()) or 'no environment'}; train one with 'passive-env train --env "
            f"{environment_id(name)}'"
        )
    return _file(name, SUFFIX)


def sees_alike(environment: str, scenario: Any) -> bool:
    """Whether a scenario shows what the registered environment shows, so that its pretrained policy can fly it."""
    from agents.learned import observation_digest

    registered = make_scenario(environment, {})
    digests = {observation_digest(each.make_simulation()) for each in (scenario, registered)}
    return len(digests) == 1 and scenario.interface() == registered.interface()


def read_record(environment: str) -> dict[str, Any]:
    """What an environment's pretrained policy reached when it was packed (`agents.pack`)."""
    return json.loads(_file(scenario_name(environment), ".json").read_text(encoding="utf-8"))


def card(environment: str) -> Path:
    """Its model card."""
    return _file(scenario_name(environment), ".md")


def _file(name: str, suffix: str) -> Path:
    return Path(str(resources.files(__name__) / f"{name}{suffix}"))
