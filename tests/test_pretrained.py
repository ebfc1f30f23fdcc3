"""The policies that come with the package: small, described, and as good as recorded."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import agents
from agents import load_pretrained, pretrained_ids
from agents.cli import main
from agents.comparison import mean_interval
from agents.evaluation import fly
from agents.leaderboard.contestants import COSTLY, KIND_OF
from agents.learned import observation_digest
from agents.model_card import pretrained_table, training_command, with_table
from agents.outcomes import Record
from agents.pack import AGAINST
from agents.packed import read_packed
from agents.policy import Policy, make_policy
from agents.pretrained import MOST_FILE_BYTES, card, read_record, sees_alike
from passive_env.catalogue import environment_id, environment_ids, make_scenario, scenario_name

FOLDER = Path(agents.__file__).parent / "pretrained"
DOCUMENT = Path(__file__).parents[1] / "docs" / "pretrained.md"
FILES = sorted(FOLDER.glob("*.npz"))

REPEATED_WITHIN, REPEATED = 1e-3, 0.95
"""An episode is repeated if its errors are the recorded ones to a thousandth; of all at least this share has to be.
On the same processor all are, to the last digit kept. On another one errors differ from the sixth digit on, and where
that changes a choice or loses a track, the episode goes on as another one. A few such can decide over the mean of all:
hence the share, not the ratio of the means."""


def test_every_file_belongs_to_an_environment():
    assert pretrained_ids()
    assert {environment_id(file.stem) for file in FILES} == set(pretrained_ids())
    assert set(pretrained_ids()) <= set(environment_ids())
    expected = {f"{file.stem}{suffix}" for file in FILES for suffix in (".npz", ".json", ".md")}
    assert {path.name for path in FOLDER.iterdir() if path.suffix in (".npz", ".json", ".md")} == expected


@pytest.mark.parametrize("file", FILES, ids=lambda file: file.stem)
def test_a_file_is_small_and_of_this_version_of_its_environment(file):
    assert file.stat().st_size < MOST_FILE_BYTES
    description = read_packed(file).description
    environment = environment_id(file.stem)
    assert description["environment"] == environment == read_record(environment)["environment"]
    assert description["fields"] == {}
    scenario = make_scenario(file.stem, {}).replace(**description["interface"])
    assert description["observation_digest"] == observation_digest(scenario.make_simulation())
    assert read_record(environment)["bytes"] == file.stat().st_size


@pytest.mark.parametrize("environment", pretrained_ids())
def test_a_card_names_command_seed_time_numbers_and_limits(environment):
    text = card(environment).read_text(encoding="utf-8")
    description = read_packed(FOLDER / f"{scenario_name(environment)}.npz").description
    assert training_command(description) in text
    assert f"seed {description['seed']} in {description['seconds']:.0f} s" in text
    assert all(f"## {title}" in text for title in ("Numbers", "Limits", "Versions"))
    for error in read_record(environment)["recorded"]["errors"].values():
        assert f"{error['mean']:.4g}" in text
    assert description["commit"] in text
    assert ("recorded flights of the training part" in text) == ("flights_share" in description["preset"])


@pytest.mark.parametrize("environment", pretrained_ids())
def test_a_policy_still_reaches_its_recorded_numbers(environment):
    """The same 200 episodes, one by one; and every mean lies within the recorded bootstrap interval."""
    recorded = read_record(environment)["recorded"]
    scenario = make_scenario(environment, {})
    assert recorded["scenario"] == json.loads(json.dumps(scenario.to_dict()))
    assert recorded["episodes"] == 200
    policy = load_pretrained(environment)
    assert isinstance(policy, Policy)
    flown = fly(scenario, policy, recorded["episodes"], recorded["seed"])
    assert flown.samples.keys() == recorded["errors"].keys()
    for name, values in flown.samples.items():
        low, high = recorded["errors"][name]["ci95"]
        assert low <= values.mean() <= high, name
    assert abs(flown.lost.mean() - recorded["lost_share"]) < 0.05
    assert {name: len(kept) for name, kept in recorded["each"].items()} == {
        f"{when}_{flown.score}_error_m": recorded["episodes"] for when in ("final", "mean")
    }
    assert repeated_share(flown, recorded) >= REPEATED


def repeated_share(flown: Record, recorded: dict[str, Any]) -> float:
    """Share of the recorded episodes whose final error and time average a flight repeats."""
    errors = flown.samples
    same = [np.isclose(errors[name], kept, rtol=REPEATED_WITHIN, atol=0.0) for name, kept in recorded["each"].items()]
    return float(np.all(same, axis=0).mean())


@pytest.mark.parametrize("environment", pretrained_ids())
def test_no_other_policy_passes_for_a_pretrained_one(environment):
    """Not even the strongest ones, whose means may well lie within the recorded intervals, repeat the episodes."""
    record = read_record(environment)
    recorded, scenario = record["recorded"], make_scenario(environment, {})
    strongest = {name for each in record["comparison"]["strongest"].values() for name in each.values()}
    for name in strongest - set(COSTLY.get(environment, ())):
        flown = fly(scenario, make_policy(name, scenario), recorded["episodes"], recorded["seed"])
        assert repeated_share(flown, recorded) < 0.5 * REPEATED, name


@pytest.mark.parametrize("environment", pretrained_ids())
def test_the_strongest_are_of_the_kinds_that_the_leaderboard_says(environment):
    text = card(environment).read_text(encoding="utf-8")
    for each in read_record(environment)["comparison"]["strongest"].values():
        assert each.keys() == AGAINST.keys()
        for group, name in each.items():
            assert KIND_OF[name] in AGAINST[group]
            assert f"| {name} " in text


def test_intervals_of_a_mean_are_those_of_normal_theory():
    """20,000 exponential numbers: mean ± 1.96 standard errors to a few per cent of the width."""
    values = np.random.default_rng(7).exponential(100.0, 20_000)
    error = values.std() / np.sqrt(len(values))
    low, high = mean_interval(values)
    np.testing.assert_allclose([low, high], values.mean() + np.array([-1.96, 1.96]) * error, atol=0.15 * error)
    assert mean_interval(np.array([3.0])) == [3.0, 3.0]


def test_an_environment_without_one_names_those_that_have_one(monkeypatch):
    names = pretrained_ids()
    missing, kept = names[0], names[1:]
    monkeypatch.setattr("agents.pretrained.pretrained_ids", lambda: kept)
    with pytest.raises(ValueError, match=f"{missing} has no pretrained policy: there are those of {kept[0]}"):
        load_pretrained(missing)
    with pytest.raises(ValueError, match="unknown environment 'passive/Nothing-v0'"):
        load_pretrained("passive/Nothing-v0")


def test_a_variant_is_flown_where_it_looks_the_same():
    name = "Ownship"
    finer, more = make_scenario(name, {"bearing_std_deg": 0.25}), make_scenario(name, {"targets": 2})
    assert sees_alike(name, finer)
    assert not sees_alike(name, more)
    record = fly(finer, load_pretrained(name, finer), 4, 0)
    assert np.isfinite(record.final).all()
    with pytest.raises(ValueError, match="made for other observations or actions of passive/Ownship-v0"):
        load_pretrained(name, more)


def test_the_command_knows_it_by_name(tmp_path, capsys):
    words = ["evaluate", "passive/Ownship-v0", "--episodes", "4", "--out", str(tmp_path)]
    assert main([*words, "--policies", "pretrained", "rule"]) == 0
    assert set(json.loads((tmp_path / "evaluation.json").read_text())["policies"]) == {"pretrained", "rule"}
    capsys.readouterr()
    assert main(["list"]) == 0
    for line in capsys.readouterr().out.splitlines():
        title, _, names = line.partition(": ")
        if title.startswith("policies of "):
            assert ("pretrained" in names.split(", ")) == (title.removeprefix("policies of ") in pretrained_ids())


def test_the_documents_table_is_current():
    """Otherwise: python -m agents.model_card docs/pretrained.md"""
    text = DOCUMENT.read_text(encoding="utf-8")
    assert with_table(text) == text
    assert all(f"| `{environment}`" in pretrained_table() for environment in pretrained_ids())
    with pytest.raises(ValueError, match="has no lines"):
        with_table("no place")
