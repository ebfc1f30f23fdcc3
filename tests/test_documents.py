"""README and docs/: Python blocks run, commands parse, links lead somewhere, environments are all named."""

import dataclasses
import re
import shlex
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from markdown_tables import tables

from agents import cli
from agents.reproduction.angle_fusion import run_trials
from agents.reproduction.angle_fusion.claims import all_claims
from agents.reproduction.report import VERDICTS
from passive_env.catalogue import environment_ids, make_scenario

ROOT = Path(__file__).parents[1]
DOCUMENTS = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").glob("*.md"))]
FAMILIES = {
    "Ownship": ROOT / "docs" / "ownship.md",
    "AngleFusion": ROOT / "docs" / "angle_fusion.md",
    "ManeuveringTarget": ROOT / "docs" / "maneuvering_target.md",
    "RadarPlacement": ROOT / "docs" / "radar_placement.md",
    "MobilePlacement": ROOT / "docs" / "mobile_placement.md",
    "PassiveRadar": ROOT / "docs" / "passive_radar.md",
}
"""Environments and the documents that describe them."""
TRACKER_PAGES = [ROOT / "docs" / f"{name}_trackers.md" for name in ("imm_mie", "radar_placement", "passive_radar")]
OTHER_PAGES = [ROOT / "docs" / f"{name}.md" for name in ("pretrained", "replay")]
WITH_CODE = [ROOT / "README.md", *OTHER_PAGES, *TRACKER_PAGES, *FAMILIES.values()]


def blocks(document: Path) -> list[str]:
    return re.findall(r"```python\n(.*?)```", document.read_text(encoding="utf-8"), re.DOTALL)


def commands(document: Path) -> list[str]:
    """Indented lines, and table cells in backticks, that begin with the command's name."""
    return re.findall(r"^(?: {4}|\| `)passive-env ([^`\n]+)", document.read_text(encoding="utf-8"), re.MULTILINE)


@pytest.mark.parametrize("document", WITH_CODE, ids=lambda path: path.name)
def test_python_blocks_run(document, capsys):
    found = blocks(document)
    assert found
    for block in found:
        exec(compile(block, str(document), "exec"), {})
    assert capsys.readouterr().out


@pytest.mark.parametrize("document", WITH_CODE, ids=lambda path: path.name)
def test_commands_parse(document, monkeypatch):
    parsed = []
    monkeypatch.setattr(cli, "_guarded", lambda command: parsed.append(command) or 0)
    found = commands(document)
    assert found
    for line in found:
        assert cli.main(shlex.split(line, comments=True)) == 0
    for command in parsed:
        assert getattr(command, "env", environment_ids()[0]) in environment_ids()


@pytest.mark.parametrize("document", DOCUMENTS, ids=lambda path: path.name)
def test_links_and_pictures_exist(document):
    for target in re.findall(r"\]\(([^)#]+)", document.read_text(encoding="utf-8")):
        assert target.startswith("https://") or (document.parent / target).is_file(), target


def test_readme_names_every_environment():
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    assert [name for name in environment_ids() if f"`{name}`" not in text] == []


def table(document: Path, head: list[str]) -> list[list[str]]:
    """The rows of the only table with these column names."""
    (found,) = (rows for names, *rows in tables(document.read_text(encoding="utf-8")) if names == head)
    return found


@pytest.mark.parametrize("name", FAMILIES)
def test_observation_table_is_what_the_environment_says(name):
    env: Any = gym.make(f"passive/{name}-v0").unwrapped
    shown = table(FAMILIES[name], ["field", "unit", "scale"])
    assert shown == [[f"`{field.name}`", field.unit, field.scale] for field in env.observation_fields]


@pytest.mark.parametrize("name", FAMILIES)
def test_keyword_table_is_what_the_scenario_says(name):
    fields = {f"`{field.name}`": field for field in dataclasses.fields(make_scenario(name, {}))}
    shown = table(FAMILIES[name], ["keyword", "default", "meaning"])
    assert len(shown) > 10
    assert shown == [[name, str(fields[name].default), fields[name].metadata["doc"]] for name, *_ in shown]


def test_angle_fusion_claims_are_those_the_reproduction_judges():
    """Claim by claim; the numbers behind the verdicts are what a run prints."""
    bare = re.compile(r"[\d.]+ (?=validated)|\([\d.]+ ?%?\)")
    records = run_trials(2, (0,))
    judged = [bare.sub("", each["claim"]) for each in all_claims(records, np.random.default_rng(0))]
    shown = table(FAMILIES["AngleFusion"], ["claim", "paper, specification", "ours", "95 % interval", "verdict"])
    assert [bare.sub("", row[0]) for row in shown] == judged
    assert {row[-1] for row in shown} <= set(VERDICTS)
