"""What environments say of themselves: observation, action, reward and keywords, as Markdown tables."""

from __future__ import annotations

import dataclasses
import inspect
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from agents.reproduction.report import markdown_table
from passive_env.catalogue import SCENARIOS, environment_id, make_scenario
from passive_env.catalogue.angle_fusion import AngleFusion
from passive_env.catalogue.bearings import BearingScenario
from passive_env.catalogue.maneuvering import ManeuveringTarget
from passive_env.catalogue.mobile_placement import MobilePlacement
from passive_env.catalogue.passive_radar import PassiveRadar
from passive_env.catalogue.placement import RadarPlacement
from passive_env.rewards import TERMS

PLACE = (
    ("azimuth at the expected entry", "the limit told to the right … to the left of the direction to the site"),
    ("horizontal distance from the entry", "the nearest … the farthest place told"),
    ("height", "the ground … the highest place told"),
)
"""What the three numbers of a sensor's place mean, and what −1 and +1 are."""


def page_name(name: str) -> str:
    """File of an environment's page: TwoStation has two_station.md."""
    return re.sub(r"(?<!^)(?=[A-Z])", "_", name).lower() + ".md"


def environments_table(root: Path, folder: str) -> str:
    """All environments: numbers observed and commanded, steps, tracker; names lead to their pages in `folder`."""
    return markdown_table(
        ("environment", "observation", "action", "steps", "step", "tracker", "scored by"),
        [_environment_row(name, scenario, folder) for name, scenario in SCENARIOS.items()],
    )


def _environment_row(name: str, scenario: Any, folder: str) -> tuple[Any, ...]:
    actions, observation = scenario.make_actions(), scenario.make_observation()
    return (
        f"[`{environment_id(name)}`]({folder}{page_name(name)})", str(len(observation.fields)), str(actions.size),
        str(scenario.steps), f"{scenario.step_s:g} s", f"`{scenario.tracker}`", f"{scenario.score} error",
    )  # fmt: skip


def observation_table(root: Path, name: str) -> str:
    """Name, unit and scale of every number of an observation, in order."""
    fields = make_scenario(name, {}).make_observation().fields
    rows = [(str(i), f"`{each.name}`", each.unit, each.scale) for i, each in enumerate(fields)]
    return markdown_table(("index", "field", "unit", "scale"), rows)


def action_table(root: Path, name: str) -> str:
    """What every number of an action commands, and what its limits mean."""
    scenario = make_scenario(name, {})
    rows = [(str(i), what, limits) for i, (what, limits) in enumerate(action_rows(scenario))]
    return markdown_table(("index", "commands", "from −1 to +1"), rows)


def action_rows(scenario: Any) -> list[tuple[str, str]]:
    """Per number of a scenario's continuous or heading actions: what it commands, what −1 and +1 mean."""
    for family, rows in ROWS.items():
        if isinstance(scenario, family):
            return list(rows(scenario))
    raise TypeError(f"{type(scenario).__name__}: no words for its actions; add its family to ROWS")


def _turn_rows(scenario: Any, platforms: int, whose: str) -> Iterator[tuple[str, str]]:
    for s in range(platforms):
        if scenario.actions == "headings":
            yield f"heading of {whose} {s}", "180° inwards … outwards off its line of sight to the track"
        else:
            limit = scenario.max_turn_rate_deg_s
            yield f"turn rate of {whose} {s}", f"{limit:g}°/s to the right … to the left"


def _bearing_rows(scenario: BearingScenario) -> Iterator[tuple[str, str]]:
    yield from _turn_rows(scenario, scenario.stations, "platform")


def _angle_rows(scenario: AngleFusion) -> Iterator[tuple[str, str]]:
    yield from _turn_rows(scenario, scenario.stations, "platform")
    for s in range(scenario.stations):
        yield f"climb rate of platform {s}", f"{scenario.max_climb_m_s:g} m/s down … up"


def _maneuver_rows(scenario: ManeuveringTarget) -> Iterator[tuple[str, str]]:
    yield from _turn_rows(scenario, scenario.stations, "station")
    for s in range(scenario.stations):
        yield f"speed of station {s}", f"{scenario.min_speed_m_s:g} … {scenario.top_speed_m_s:g} m/s"


def _placement_rows(scenario: RadarPlacement) -> Iterator[tuple[str, str]]:
    for what, limits in PLACE:
        yield f"{what} of the next sensor", limits


def _mobile_rows(scenario: MobilePlacement) -> Iterator[tuple[str, str]]:
    for s in range(scenario.sensors):
        for what, limits in PLACE:
            yield f"{what} that sensor {s} should go to", limits


def _radar_rows(scenario: PassiveRadar) -> Iterator[tuple[str, str]]:
    if scenario.moves:
        if scenario.actions == "headings":
            yield "heading of the receiver", "180° right … left of its line of sight to the track"
        else:
            yield "turn rate of the receiver", f"{scenario.max_turn_rate_deg_s:g}°/s to the right … to the left"
    for t in range(scenario.pool):
        yield f"score of transmitter {t}", f"the {scenario.listened} highest of all are listened to"


ROWS: dict[type, Any] = {
    BearingScenario: _bearing_rows,
    AngleFusion: _angle_rows,
    ManeuveringTarget: _maneuver_rows,
    RadarPlacement: _placement_rows,
    MobilePlacement: _mobile_rows,
    PassiveRadar: _radar_rows,
}
"""Words for the actions of a family of scenarios."""


def reward_table(root: Path, name: str) -> str:
    """Weight and meaning of every reward term that a scenario offers, those in use first."""
    scenario = make_scenario(name, {})
    offered = [f.name.removeprefix("reward_") for f in dataclasses.fields(scenario) if f.name.startswith("reward_")]
    used = scenario.reward_weights
    rows = [
        (f"`reward_{term}`", f"{getattr(scenario, f'reward_{term}'):g}", "yes" if term in used else "", _meaning(term))
        for term in sorted(offered, key=lambda term: term not in used)
    ]
    return markdown_table(("keyword", "weight", "counts", "term"), rows)


def _meaning(term: str) -> str:
    """First sentence of a term's docstring; other terms' names in it stay code."""
    return inspect.cleandoc(TERMS[term].__doc__ or "").splitlines()[0]


def keyword_table(root: Path, name: str) -> str:
    """Every field of a scenario but its rewards: default, what is allowed, meaning."""
    scenario = make_scenario(name, {})
    rows = [
        (f"`{f.name}`", f"`{getattr(scenario, f.name)}`", _allowed(f.metadata), f.metadata["doc"])
        for f in dataclasses.fields(scenario)
        if not f.name.startswith("reward_")
    ]
    return markdown_table(("keyword", "default", "allowed", "meaning"), rows)


def _allowed(rule: Any) -> str:
    if rule["kind"] in ("number", "integer"):
        return f"{rule['low']:g} to {rule['high']:g}"
    if rule["kind"] == "choice":
        return ", ".join(f"`{option}`" for option in rule["options"])
    return "`True`, `False`" if rule["kind"] == "flag" else ""
