"""The leaderboard: cells kept and flown again, paired statistics, files that agree, the command and its refusals."""

import contextlib
import csv
import dataclasses
import json
import re
from collections import Counter
from pathlib import Path

import numpy as np
import pytest
from markdown_tables import tables
from scipy.stats import binom, expon

from agents import cli, evaluation
from agents.comparison import RESAMPLES, ratio_of_means
from agents.evaluation import fly
from agents.leaderboard import COURSES, FLIGHTS, cells, contestants, leaderboard, tracker_names
from agents.leaderboard.cells import Cell, DamagedCell, code_digest, fly_cells, load, save
from agents.leaderboard.contestants import (
    COSTLY,
    KIND_OF,
    KINDS,
    Contestant,
    affordable,
    chosen,
    known_policies,
    opponents,
    unfit,
)
from agents.leaderboard.goals import DRAWN, GOALS, LOST, RECORDED, Goal
from agents.leaderboard.pictures import FARTHEST, NEAREST, overview
from agents.leaderboard.report import as_csv, as_markdown, decision_times
from agents.leaderboard.resamples import interval, resample
from agents.leaderboard.standings import finalists, standing, verdict
from agents.leaderboard.tried import TRIED, Tried
from agents.leaderboard.variations import VARIATIONS
from agents.main_job import HELD_OUT, flown_by
from agents.outcomes import Outcomes
from agents.policy import make_policy, policy_names
from agents.pretrained import load_pretrained, pretrained_ids
from passive_env.catalogue import SCENARIOS, environment_id, environment_ids, make_scenario
from passive_env.catalogue.ownship import Ownship
from passive_env.catalogue.two_station import TwoStation

EPISODES, SEED, STEPS = 6, 400, 4
FILES = {"leaderboard.json", "leaderboard.csv", "leaderboard.md", "leaderboard.png", "verdicts.csv"}
SHORT = TwoStation(steps=STEPS)


def by_name(name: str, label: str = "", kind: str = "", identity: str = "") -> Contestant:
    return Contestant(label or name, kind or KIND_OF[name], lambda scenario: make_policy(name, scenario), identity)


def cell(name: str = "rule", **changes) -> Cell:
    return dataclasses.replace(Cell("passive/TwoStation-v0", SHORT, by_name(name), EPISODES, SEED), **changes)


@pytest.fixture
def flights_of(monkeypatch):
    """Names of the policies whose cells are really flown, in order."""
    names = []

    def counted(scenario, policy, episodes, seed, progress=None):
        names.append(type(policy).__name__)
        return fly(scenario, policy, episodes, seed, progress)

    monkeypatch.setattr(evaluation, "fly", counted)
    return names


def model_stand_in(environment, runs):
    """A "learned" policy that is a rule in truth, and cannot fly one of the trackers."""

    def make(scenario):
        if scenario.tracker == "fused_ekf":
            raise ValueError("made for other observations")
        return make_policy("greedy", scenario)

    return [Contestant("learned", "learned", make, "0123")]


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """A whole small leaderboard: two environments, three sections."""
    out = tmp_path_factory.mktemp("leaderboard")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("agents.leaderboard.learned_policies", model_stand_in)
        data = leaderboard(
            ("TwoStation", "passive/Ownship-v0"), episodes=EPISODES, seed=SEED, trackers=True, generalisation=True,
            out=out, fields={"steps": STEPS}, progress=False,
        )  # fmt: skip
    return out, data


def small(out: Path, **changes):
    """A leaderboard of three policies in one environment."""
    settings = {"policies": ("paper", "rule", "greedy"), "episodes": EPISODES, "seed": SEED, "flights": False}
    settings |= {"fields": {"steps": STEPS}, "progress": False}
    return leaderboard(("TwoStation",), out=out, **(settings | changes))


def entries(data, section="leaderboard"):
    return [(env, entry) for env, found in data["sections"][section].items() for entry in found]


# ------------------------------------------------------------------------------------------------ who takes part


@pytest.mark.parametrize("name", SCENARIOS)
def test_every_policy_of_every_environment_has_a_kind_and_quick_ones_come_first(name):
    field = known_policies(SCENARIOS[name])
    assert sorted(one.name for one in field) == sorted(policy_names(SCENARIOS[name]))
    ranks = [KINDS.index(one.kind) for one in field]
    assert ranks == sorted(ranks)
    environment = environment_id(name)
    assert set(COSTLY.get(environment, ())) == {one.name for one in field} - {
        one.name for one in affordable(environment, field)
    }
    assert {"rule", "greedy"} <= {one.name for one in opponents(environment, field)}
    assert KINDS.index("oracle") == max(ranks) or "oracle" not in policy_names(SCENARIOS[name])


def test_a_policy_without_a_kind_is_named():
    with pytest.raises(ValueError, match=r"'zigzag'.*no kind.*fixed, rule, greedy"):
        contestants._known("zigzag", SHORT)


def test_a_name_belongs_to_one_kind():
    assert sum(map(len, contestants._NAMES.values())) == len(KIND_OF)


def test_policies_named_are_taken_and_run_folders_always():
    field = [by_name("rule"), by_name("greedy"), by_name("rule", "learned", "learned"), by_name("rule", "pretrained")]
    assert [one.name for one in chosen(field, ("greedy",))] == ["greedy", "learned"]
    assert chosen(field, ()) == field


def test_run_folders_are_flown_as_the_models_they_hold(tmp_path):
    """A real one, trained for a moment."""
    from test_training import tiny_run

    from agents.learned import LearnedPolicy
    from agents.training import train

    folder = tmp_path / "run"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("agents.training.EVALUATION_EPISODES", 8)
        train(tiny_run(folder, rollouts=1), progress=False)
    data = small(tmp_path / "out", policies=("rule",), runs=(f"TwoStation={folder}",))
    ((_, entry),) = entries(data)
    assert list(entry["policies"]) == ["rule", "learned"]
    direct = fly(SHORT, LearnedPolicy(folder, "passive/TwoStation-v0", SHORT.make_simulation()), EPISODES, SEED)
    assert entry["policies"]["learned"]["final_range_error_m"]["mean"] == direct.final.mean()
    (config,) = folder.glob("config.json")
    before = contestants.learned_policies("passive/TwoStation-v0", [folder])[-1].identity
    config.write_text(config.read_text() + "\n")
    assert contestants.learned_policies("passive/TwoStation-v0", [folder])[-1].identity != before


# ------------------------------------------------------------------------------------------------ cells on disk


def same(a: Outcomes, b: Outcomes) -> bool:
    parts = [(a.errors[name], b.errors[name]) for name in a.errors] + [(a.bounds[n], b.bounds[n]) for n in a.bounds]
    parts += [(getattr(a, name), getattr(b, name)) for name in cells.SHARES]
    alike = a.score == b.score and a.state_size == b.state_size and a.decision_time_us == b.decision_time_us
    return alike and list(a.errors) == list(b.errors) and all(np.array_equal(x, y, equal_nan=True) for x, y in parts)


@pytest.mark.parametrize("name", ["TwoStation", "ManeuveringTarget", "RadarPlacement"])
def test_a_kept_cell_is_what_was_flown(tmp_path, name):
    """Families differ in what they record: late losses, errors of maneuvers, of the scans that are scored."""
    scenario = make_scenario(name, {} if name == "RadarPlacement" else {"steps": 12})
    one = cell(environment=f"passive/{name}-v0", scenario=scenario)
    flown = fly(scenario, make_policy("rule", scenario), EPISODES, SEED).outcomes
    save(one, flown, tmp_path)
    kept = load(one, tmp_path)
    assert same(kept, flown)
    assert (kept.lost_late is None) == (flown.lost_late is None)
    assert flown.lost_late is None or np.array_equal(kept.lost_late, flown.lost_late)
    with pytest.raises(FileNotFoundError):
        load(dataclasses.replace(one, seed=SEED + 1), tmp_path)


def test_nothing_is_flown_twice_and_the_result_is_the_same(tmp_path, flights_of):
    first = small(tmp_path)
    assert len(flights_of) == 3
    files = {path: path.read_bytes() for path in tmp_path.rglob("*.npz")}
    again = small(tmp_path)
    assert len(flights_of) == 3
    assert again["about"]["cells"] == {"kept": 3}
    assert again["sections"] == first["sections"]
    assert {path: path.read_bytes() for path in tmp_path.rglob("*.npz")} == files


@pytest.mark.parametrize("name", SCENARIOS)
def test_pretrained_policies_take_part_where_there_are_any(name):
    """Each as one more policy, told apart by its file."""
    environment = environment_id(name)
    found = contestants.learned_policies(environment, [])
    assert [one.name for one in found] == ["pretrained"] * (environment in pretrained_ids())
    for one in found:
        assert (one.kind, len(one.identity)) == ("learned", 64)
        assert unfit(one, SCENARIOS[name]) == ""
        assert chosen(found, ("rule",)) == []
        mine = fly(SCENARIOS[name], one.make(SCENARIOS[name]), 2, SEED).final
        np.testing.assert_array_equal(mine, fly(SCENARIOS[name], load_pretrained(environment), 2, SEED).final)


def test_quick_policies_are_flown_first(tmp_path, flights_of):
    small(tmp_path, policies=("oracle", "planner", "greedy", "rule", "paper"))
    assert flights_of == ["Schedule", "TurnApart", "Greedy", "Planner", "Oracle"]


def test_an_interrupted_run_goes_on_where_it_was(tmp_path, monkeypatch):
    begun = []

    def killed_in_the_third(scenario, policy, episodes, seed, progress=None):
        begun.append(policy)
        if len(begun) == 3:
            raise KeyboardInterrupt
        return fly(scenario, policy, episodes, seed, progress)

    monkeypatch.setattr(evaluation, "fly", killed_in_the_third)
    with pytest.raises(KeyboardInterrupt):
        small(tmp_path)
    assert len(list(tmp_path.rglob("*.npz"))) == 2
    assert not (tmp_path / "leaderboard.json").exists()
    assert small(tmp_path)["about"]["cells"] == {"kept": 2, "new": 1}
    assert len(begun) == 4
    assert list(tmp_path.rglob("*.tmp")) == []


def truncate(content: bytes) -> bytes:
    return content[: len(content) // 2]


def pickled(content: bytes) -> bytes:
    import io

    buffer = io.BytesIO()
    np.savez(buffer, about=np.array([{"key": 1}], dtype=object))
    return buffer.getvalue()


@pytest.mark.parametrize("damage", [truncate, pickled, lambda _: b"", lambda _: b"not a cell"])
def test_a_damaged_cell_is_flown_again_with_a_warning(tmp_path, flights_of, damage):
    first = small(tmp_path)
    (file,) = tmp_path.rglob("rule-*.npz")
    whole = file.read_bytes()
    file.write_bytes(damage(whole))
    with pytest.warns(UserWarning, match=f"damaged cell, flown again: .*{file.name}"):
        again = small(tmp_path)
    assert again["about"]["cells"] == {"kept": 2, "damaged": 1}
    assert flights_of[3:] == ["TurnApart"]
    for name, figures in again["sections"]["leaderboard"]["passive/TwoStation-v0"][0]["policies"].items():
        before = first["sections"]["leaderboard"]["passive/TwoStation-v0"][0]["policies"][name]
        assert {**figures, "decision_time_us": 0} == {**before, "decision_time_us": 0}
    assert small(tmp_path)["about"]["cells"] == {"kept": 3}


def test_no_flipped_bit_is_ever_read_as_another_result(tmp_path):
    one, rng = cell(), np.random.default_rng(0)
    flown = fly(SHORT, make_policy("rule", SHORT), EPISODES, SEED).outcomes
    file = save(one, flown, tmp_path)
    whole = file.read_bytes()
    refused = 0
    for place, bit in zip(rng.integers(0, len(whole), 150), rng.integers(0, 8, 150), strict=True):
        spoilt = bytearray(whole)
        spoilt[place] ^= 1 << bit
        file.write_bytes(bytes(spoilt))
        with contextlib.suppress(DamagedCell):
            assert same(load(one, tmp_path), flown)
            continue
        refused += 1
    assert refused > 100


@pytest.mark.parametrize("spoil", ["short", "nan", "key"])
def test_a_cell_with_values_that_cannot_be_is_damaged(tmp_path, spoil):
    one, flown = cell(), fly(SHORT, make_policy("rule", SHORT), EPISODES, SEED).outcomes
    if spoil == "short":
        flown = dataclasses.replace(flown, lost=flown.lost[:-1])
        words = "lost has 5 episodes, not 6"
    elif spoil == "nan":
        flown = dataclasses.replace(flown, bounds={"final_range_crlb_m": np.full(EPISODES, np.nan)})
        words = "final_range_crlb_m has values that are no numbers"
    file = save(one, flown, tmp_path)
    if spoil == "key":
        other = dataclasses.replace(one, seed=SEED + 1)
        file = file.rename(other.file(tmp_path))
        one, words = other, "its key is not the one its name stands for"
    with pytest.raises(DamagedCell, match=words):
        load(one, tmp_path)


CHANGES = {
    "seed": {"seed": SEED + 1},
    "episodes": {"episodes": EPISODES + 1},
    "model": {"contestant": by_name("rule", identity="b")},
}


@pytest.mark.parametrize("name", CHANGES)
def test_cells_of_other_settings_are_flown_and_the_old_ones_stay(tmp_path, name):
    one, other = cell(), cell(**CHANGES[name])
    assert fly_cells([one], tmp_path, progress=False).states == {"new": 1}
    before = one.file(tmp_path).read_bytes()
    flown = fly_cells([other], tmp_path, progress=False)
    assert (flown.states, flown.differing) == ({"changed": 1}, {name})
    assert name in str(flown)
    assert one.file(tmp_path).read_bytes() == before
    assert fly_cells([one, other], tmp_path, progress=False).states == {"kept": 2}


def test_other_scenarios_and_policies_are_other_cells(tmp_path):
    variants = [
        cell(),
        cell("paper"),
        cell(scenario=SHORT.replace(bearing_std_deg=1.0)),
        cell(environment="passive/X-v0"),
    ]
    assert len({one.digest for one in variants}) == 4
    assert fly_cells(variants[:1], tmp_path, progress=False).states == {"new": 1}
    assert fly_cells(variants[1:3], tmp_path, progress=False).states == {"new": 2}


def test_cells_of_other_code_are_flown_again(tmp_path, monkeypatch):
    fly_cells([cell()], tmp_path, progress=False)
    monkeypatch.setattr(cells, "code_digest", lambda: "another")
    flown = fly_cells([cell()], tmp_path, progress=False)
    assert (flown.states, flown.differing) == ({"changed": 1}, {"code"})


def test_code_digest_sees_what_decides_and_nothing_else(tmp_path, monkeypatch):
    decisive = ["agents/rules.py", "passive_env/b.py", "passive_env/data/d.csv", "trackers/a.py"]
    showing = ["passive_env/render_c.py", "passive_env/playback_f.py", "agents/report.py", "agents/leaderboard/e.py"]
    for name in (*decisive, *showing):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text("1")
    monkeypatch.setattr(cells, "ROOT", tmp_path)
    first, changed = code_digest.__wrapped__(), []
    for path in sorted(path for path in tmp_path.rglob("*.*") if path.is_file()):
        path.write_text("2")
        if code_digest.__wrapped__() != first:
            changed.append(path.relative_to(tmp_path).as_posix())
        path.write_text("1")
    assert changed == decisive


def test_equal_cells_of_several_tables_are_flown_once(tmp_path, flights_of):
    """The environment's own tracker is that of the leaderboard, and its own circumstances."""
    data = small(tmp_path, policies=("rule",), trackers=True, flights=False)
    assert data["about"]["cells"] == {"new": len(tracker_names(SHORT))}
    assert len(flights_of) == len(tracker_names(SHORT))
    ((_, base),) = entries(data)
    (own,) = (entry for _, entry in entries(data, "trackers") if entry["title"] == SHORT.tracker)
    assert own["policies"] == base["policies"]


# ------------------------------------------------------------------------------------------------ statistics


def outcomes_of(final, average=None) -> Outcomes:
    """Hand-made errors [e]; everything else is plausible."""
    final = np.asarray(final, dtype=float)
    zero, average = np.zeros(len(final)), final if average is None else np.asarray(average, dtype=float)
    errors = {"final_range_error_m": final, "mean_range_error_m": average}
    nees = np.full((len(final), 1), 4.0)
    return Outcomes("range", errors, {"final_range_crlb_m": 0.5 * final}, zero, zero, nees, zero, zero, 4, 1.0)


def table_of(**finals):
    """A standing of policies with these errors; the kind stands before the name: kind__name."""
    field = [Contestant(label.split("__")[1], label.split("__")[0], lambda scenario: None) for label in finals]
    flown = {one.name: outcomes_of(final) for one, final in zip(field, finals.values(), strict=True)}
    return standing(SHORT, field, flown, 0)


def test_identical_policies_have_the_ratio_one_exactly(tmp_path):
    field = [by_name("rule"), by_name("rule", "twin", "greedy")]
    made = [cell(contestant=one) for one in field]
    flown = fly_cells(made, tmp_path, progress=False).outcomes
    found = standing(SHORT, field, {one.name: flown[c.digest] for one, c in zip(field, made, strict=True)}, SEED)
    assert found["reference"] == "rule"
    for metric in found["metrics"]:
        for what in ("mean", "p95"):
            assert found["policies"]["twin"]["ratios"][metric][what] == {"ratio": 1.0, "ci95": [1.0, 1.0]}


@pytest.mark.parametrize("count", [2, 37, 500, 1700])
def test_ratio_intervals_are_those_of_an_evaluation(count):
    """SciPy's paired bootstrap draws the same episodes, however the resamples are cut into pieces."""
    ours, base = np.random.default_rng(count).exponential(size=(2, count))
    found = interval(resample(ours).mean / resample(base).mean)
    np.testing.assert_allclose(found, ratio_of_means(ours, base)["ci95"], rtol=1e-12)


@pytest.mark.parametrize("count", [2, 3, 20, 21, 41, 500, 2000])
def test_resamples_are_those_of_drawing_episodes_one_by_one(count):
    values = np.random.default_rng(count).exponential(size=count).round(1)  # with ties
    rng = np.random.default_rng(0)
    drawn = np.array([values[rng.integers(0, count, count)] for _ in range(RESAMPLES)])
    found = resample(values)
    np.testing.assert_allclose(found.mean, drawn.mean(axis=1), rtol=1e-12)
    np.testing.assert_allclose(found.p95, np.percentile(drawn, 95.0, axis=1), rtol=1e-12)


@pytest.mark.parametrize("what", ["mean", "p95"])
def test_intervals_cover_what_is_true_as_often_as_they_say(what):
    """Exponential errors of mean 1 and 95th percentile log 20; a percentile bootstrap of 200 covers 92 to 96 %."""
    rng, truth, trials = np.random.default_rng(7), {"mean": 1.0, "p95": expon.ppf(0.95)}, 300
    covered = 0
    for _ in range(trials):
        low, high = interval(getattr(resample(rng.exponential(size=200)), what))
        covered += low <= truth[what] <= high
    assert binom.ppf(5e-4, trials, 0.92) <= covered <= binom.ppf(1 - 5e-4, trials, 0.96)


def test_p95_ratio_interval_is_paired():
    """Twice the same errors, episode by episode: the ratio is 2 whatever is drawn."""
    base = np.random.default_rng(1).exponential(size=80)
    found = table_of(rule__a=base, learned__b=2.0 * base)["policies"]["b"]["ratios"]["final_range_error_m"]["p95"]
    np.testing.assert_allclose([found["ratio"], *found["ci95"]], 2.0, rtol=1e-12)


def test_reference_is_the_best_fixed_policy_or_rule_and_no_other():
    base = np.random.default_rng(2).uniform(1.0, 2.0, 50)
    found = table_of(fixed__f=1.5 * base, rule__worse=1.2 * base, rule__better=base, greedy__g=0.5 * base)
    assert (found["reference"], found["best"]) == ("better", {"fixed": "f", "rule": "better", "greedy": "g"})
    assert found["policies"]["g"]["ratios"]["final_range_error_m"]["mean"]["ratio"] == pytest.approx(0.5)
    without = table_of(greedy__g=base, learned__l=0.9 * base)
    assert without["reference"] == "l"


def two_errors(**pairs):
    """A standing of policies by name, kind__name, and (final, average) errors."""
    field = [Contestant(label.split("__")[1], label.split("__")[0], lambda scenario: None) for label in pairs]
    return field, {one.name: outcomes_of(*errors) for one, errors in zip(field, pairs.values(), strict=True)}


def test_a_learned_policy_is_judged_against_whoever_is_best_at_that_very_error():
    base = np.random.default_rng(5).uniform(1.0, 2.0, 50)
    field, flown = two_errors(
        rule__ends_well=(base, 3.0 * base), fixed__starts_well=(2.0 * base, base), learned__l=(base, base),
        greedy__g=(base, 4.0 * base), greedy__h=(5.0 * base, base), oracle__o=(0.5 * base, 0.75 * base),
        planner__p=(base, base),
    )  # fmt: skip
    found = standing(SHORT, field, flown, 0)
    bases = {(each["metric"], each["kind"]): (each["base"], each["oracle"]["ratio"]) for each in found["verdicts"]}
    assert bases == {
        ("final_range_error_m", "reference"): ("ends_well", pytest.approx(0.5)),
        ("final_range_error_m", "greedy"): ("g", pytest.approx(0.5)),
        ("mean_range_error_m", "reference"): ("starts_well", pytest.approx(0.75)),
        ("mean_range_error_m", "greedy"): ("h", pytest.approx(0.75)),
        ("final_range_error_m", "planner"): ("p", pytest.approx(0.5)),
        ("mean_range_error_m", "planner"): ("p", pytest.approx(0.75)),
    }
    assert [each["open"] for each in found["verdicts"]] == [True] * 4 + [False] * 2  # planners decide nothing
    names = ["ends_well", "starts_well", "l", "g", "h", "o", "p"]
    assert [one.name for one in finalists(found, field)] == names
    assert [one.name for one in finalists(found, field, spared=("p", "g"))] == names[:-1]
    others = [Contestant(name, "rule", lambda scenario: None) for name in ("straight", "open", "hold")]
    goals = (Goal(DRAWN, "final", 1.0, ("open", "ends_well")),)
    assert [one.name for one in finalists(found, [*field, *others], goals)] == [*names, "straight", "open"]
    assert not finalists(standing(SHORT, field[:2], flown, 0), field[:2])  # nobody learned: nothing to judge


def test_a_spared_planner_flies_again_if_ratios_are_to_it():
    """For want of a fixed policy or rule."""
    base = np.random.default_rng(5).uniform(1.0, 2.0, 50)
    field, flown = two_errors(planner__p=(base, base), learned__l=(2.0 * base, 2.0 * base))
    before = standing(SHORT, field, flown, 0)
    assert before["reference"] == "p"
    assert [one.name for one in finalists(before, field, spared=("p",))] == ["p", "l"]


@pytest.mark.parametrize("dimensions", [2, 3])
def test_an_error_that_equals_the_average_in_every_episode_is_judged_once(dimensions):
    """The horizontal one in the plane."""
    scenario = make_scenario("PassiveRadar", {"steps": 20, "dimensions": dimensions})
    field = [by_name("fixed"), by_name("repeat", "l", "learned")]
    found = standing(scenario, field, {one.name: fly(scenario, one.make(scenario), 4, 0).outcomes for one in field}, 0)
    assert ("mean_horizontal_error_m" in found["metrics"]) == (dimensions == 3)
    assert "mean_horizontal_error_m" in found["policies"]["l"]


def test_least_bound_leaves_the_oracle_out():
    base = np.linspace(1.0, 2.0, 20)
    found = table_of(rule__a=base, planner__b=0.9 * base, oracle__c=0.1 * base)
    assert found["bound"] == {"policy": "b", "mean": pytest.approx(0.45 * 1.5)}
    assert table_of(oracle__c=base)["bound"]["policy"] == "c"


def test_verdicts():
    assert [verdict(ends) for ends in ([0.8, 0.99], [0.9, 1.0], [1.0, 1.1], [1.01, 1.2])] == [
        "ahead", "level", "level", "behind",
    ]  # fmt: skip


@pytest.mark.parametrize(
    ("factor", "mean", "p95", "is_open"),
    [(0.8, "ahead", "ahead", False), (1.0, "level", "level", True), (1.3, "behind", "behind", True)],
)
def test_open_is_what_is_behind_on_the_mean_or_not_ahead_on_the_tail(factor, mean, p95, is_open):
    base = np.random.default_rng(3).exponential(size=200)
    found = table_of(rule__r=base, greedy__g=2.0 * base, learned__l=factor * base)["verdicts"]
    against_rule = [each for each in found if each["base"] == "r"]
    assert len(against_rule) == 2
    for each in against_rule:
        assert (each["mean_verdict"], each["p95_verdict"], each["open"]) == (mean, p95, is_open)
    assert not any(each["open"] for each in found if each["base"] == "g")


def test_ahead_on_the_mean_but_not_on_the_tail_is_open():
    """The worst tenth of the episodes is worse, all others are better."""
    rng = np.random.default_rng(4)
    base = rng.uniform(1.0, 2.0, 300)
    ours = np.where(base > 1.9, 1.2 * base, 0.5 * base)
    (each, _) = table_of(rule__r=base, learned__l=ours)["verdicts"]
    assert (each["mean_verdict"], each["p95_verdict"], each["open"]) == ("ahead", "behind", True)


def test_maneuvering_targets_are_ranked_by_the_error_while_they_maneuver():
    scenario = make_scenario("ManeuveringTarget", {"steps": 25})
    field = [by_name("fixed"), by_name("rule"), by_name("greedy")]
    flown = {one.name: fly(scenario, one.make(scenario), 5, SEED).outcomes for one in field}
    found = standing(scenario, field, flown, SEED)
    assert found["headline"] == "turn_position_error_m"
    record = fly(scenario, make_policy("rule", scenario), 5, SEED)
    assert found["policies"]["rule"][found["headline"]]["mean"] == np.nanmean(record.turn_error_m)
    assert "mean_acceleration_error_m_s2" in found["metrics"]


# ------------------------------------------------------------------------------------------------ the whole, small


def test_figures_are_those_of_evaluate(run, tmp_path):
    """Another command, the same seeds: same figures, same ratios, same intervals."""
    _, data = run
    names = ["paper", "rule", "rule_tuned", "greedy"]
    for flags, title in (([], COURSES), (["--flights", "held-out"], FLIGHTS)):
        arguments = [
            "TwoStation",
            "--policies",
            *names,
            "--episodes",
            EPISODES,
            "--seed",
            SEED,
            "--fields",
            f"steps={STEPS}",
        ]
        assert cli.main(["evaluate", *map(str, arguments), *flags, "--out", str(tmp_path)]) == 0
        theirs = json.loads((tmp_path / "evaluation.json").read_text())
        (ours,) = (e for env, e in entries(data) if (env, e["title"]) == ("passive/TwoStation-v0", title))
        for name in names:
            for figure, value in theirs["policies"][name].items():
                if figure != "decision_time_us":
                    found = ours["policies"][name][figure]
                    assert value == (
                        {k: v for k, v in found.items() if k != "ci95"} if isinstance(found, dict) else found
                    )
            if name != ours["reference"]:
                for metric, ratio in theirs["ratios"][ours["reference"]][name].items():
                    found = ours["policies"][name]["ratios"][metric]["mean"]
                    assert found["ratio"] == pytest.approx(ratio["ratio"], rel=1e-12)
                    np.testing.assert_allclose(found["ci95"], ratio["ci95"], rtol=1e-12)


def test_every_environment_has_all_its_policies_on_both_kinds_of_courses(run):
    _, data = run
    for scenario in (TwoStation(), Ownship()):
        found = data["sections"]["leaderboard"][f"passive/{type(scenario).__name__}-v0"]
        assert [entry["title"] for entry in found] == [COURSES, FLIGHTS]
        for entry in found:
            assert sorted(entry["policies"]) == sorted([*policy_names(scenario), "learned"])
            judged = [metric for metric in entry["metrics"] if metric.endswith("_error_m")]
            assert {(each["metric"], each["kind"], each["base"]) for each in entry["verdicts"]} == {
                (metric, kind, entry["best_by"][metric][kind])
                for metric in judged
                for kind in ("reference", "greedy", "planner")
            }
    assert data["about"]["cells"]["new"] > 40


def test_every_tracker_is_under_every_policy_or_does_not_fit(run):
    _, data = run
    found = data["sections"]["trackers"]["passive/TwoStation-v0"]
    assert [entry["title"] for entry in found] == list(TwoStation.trackers)
    for entry in found:
        assert entry["tracker"] == entry["title"]
        learned = {"learned"} if entry["title"] != "fused_ekf" else set()
        assert set(entry["policies"]) == {*policy_names(TwoStation()), *learned}
        assert entry["unfit"] == ({} if learned else {"learned": "made for other observations"})


def test_generalisation_flies_every_variation_of_the_environment(run):
    _, data = run
    for name in ("TwoStation", "Ownship"):
        found = data["sections"]["generalisation"][f"passive/{name}-v0"]
        wanted = [each.title for each in VARIATIONS if each.name == name]
        assert [entry["title"] for entry in found] == ["as registered", *wanted]
    noisy = next(
        e for e in data["sections"]["generalisation"]["passive/TwoStation-v0"] if e["title"] == "bearings of 2°"
    )
    scenario = SHORT.replace(bearing_std_deg=2.0)
    direct = fly(scenario, make_policy("rule", scenario), EPISODES, SEED)
    assert noisy["policies"]["rule"]["final_range_error_m"]["mean"] == direct.final.mean()


@pytest.mark.parametrize("each", VARIATIONS, ids=lambda each: f"{each.name} {each.title}")
def test_variations_are_valid_and_show_what_the_registered_environment_shows(each):
    """A policy trained as registered must fit, or the row would say nothing."""
    registered = make_scenario(each.name, {})
    scenario = flown_by(each.name, HELD_OUT, each.fields) if each.flights else make_scenario(each.name, each.fields)
    assert scenario != registered
    assert scenario.make_simulation().observation.fields == registered.make_simulation().observation.fields
    assert scenario.make_simulation().actions.space == registered.make_simulation().actions.space


def test_variations_have_titles_of_their_own():
    assert max(Counter((each.name, each.title) for each in VARIATIONS).values()) == 1
    assert {each.name for each in VARIATIONS} == set(SCENARIOS)


@pytest.mark.parametrize("name", SCENARIOS)
def test_trackers_named_are_taken(name):
    names = tracker_names(SCENARIOS[name])
    assert len(names) >= 2
    assert SCENARIOS[name].tracker in names
    for tracker in names:
        assert SCENARIOS[name].replace(tracker=tracker).make_tracker() is not None


# ------------------------------------------------------------------------------------------------ files


def test_files_agree_with_the_data(run):
    out, data = run
    assert {path.name for path in out.iterdir()} == FILES | {"cells"}
    assert json.loads((out / "leaderboard.json").read_text()) == json.loads(json.dumps(data, default=float))
    assert (out / "leaderboard.md").read_text() == as_markdown(data) + "\n"
    with (out / "leaderboard.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == sum(len(e["policies"]) for section in data["sections"] for _, e in entries(data, section))
    by_key = {(row["section"], row["environment"], row["title"], row["policy"]): row for row in rows}
    for section in data["sections"]:
        for env, entry in entries(data, section):
            for name, figures in entry["policies"].items():
                row = by_key[section, env, entry["title"], name]
                final = figures["final_range_error_m"]
                assert float(row["final_range_error_m_mean"]) == final["mean"]
                assert [float(row[f"final_range_error_m_{end}"]) for end in ("low", "high")] == final["ci95"]
                ratio = figures["ratios"]["mean_range_error_m"]["p95"]
                assert float(row["mean_range_error_m_p95_over_reference"]) == ratio["ratio"]
                assert (row["kind"], int(row["episodes"]), int(row["seed"])) == (figures["kind"], EPISODES, SEED)


def test_markdown_shows_the_figures(run):
    _, data = run
    text = as_markdown(data)
    full = [found for found in tables(text) if found[0][:2] == ["policy", "kind"]]
    for (_, entry), (head, *rows) in zip(entries(data), full, strict=True):
        assert [row[0] for row in rows] == [*(f"`{name}`" for name in entry["policies"]), "bound"]
        for row in rows[:-1]:
            cells_of, figures = dict(zip(head, row, strict=True)), entry["policies"][row[0].strip("`")]
            assert cells_of["kind"] == figures["kind"]
            mean, *ends = (
                float(number.replace(",", "")) for number in re.findall(r"[\d,]*\d(?:\.\d+)?", cells_of["final mean"])
            )
            final = figures["final_range_error_m"]
            np.testing.assert_allclose([mean, *ends], [final["mean"], *final["ci95"]], rtol=6e-3)
            assert cells_of["lost"] == f"{100 * figures['lost_share']:.2f} %"
            ratio = figures["ratios"]["final_range_error_m"]["mean"]
            shown = cells_of[f"final / {entry['reference']}"]
            wanted = "{:.3f} [{:.3f}, {:.3f}]".format(ratio["ratio"], *ratio["ci95"])
            assert shown == ("1" if f"`{entry['reference']}`" == row[0] else wanted)
        assert rows[-1][1] == f"of `{entry['bound']['policy']}`"


def test_short_form_has_one_row_per_environment_and_courses(run):
    _, data = run
    head, *rows = tables(as_markdown(data))[0]
    assert [(row[0], row[1]) for row in rows] == [
        (f"`{name}-v0`", courses) for name in ("TwoStation", "Ownship") for courses in ("drawn", "recorded")
    ]
    for (_, entry), row in zip(entries(data), rows, strict=True):
        shown = dict(zip(head, row, strict=True))
        assert shown["best fixed or rule"] == f"`{entry['reference']}`"
        ratio = entry["policies"]["learned"]["ratios"]["final_range_error_m"]["mean"]
        assert shown["learned"] == "{:.3f} [{:.3f}, {:.3f}]".format(ratio["ratio"], *ratio["ci95"])


def test_open_section_is_computed(run):
    _, data = run
    text = as_markdown(data)
    every = [each for _, entry in entries(data) for each in entry["verdicts"] if each["kind"] != "planner"]
    still = [each for each in every if each["open"]]
    assert still
    assert f"{len(still)} of {len(every)} comparisons" in text
    all_rows, planned, open_rows = (found[1:] for found in tables(text) if "against" in found[0])
    assert {row[5] for row in planned} == {"planner"}
    assert (len(all_rows), len(open_rows)) == (len(every), len(still))
    assert [row for row in all_rows if row[6] == "behind" or row[8] != "ahead"] == open_rows
    nothing_learned = {
        **data,
        "sections": {"leaderboard": {"passive/X-v0": [table_of(rule__r=[1.0, 2.0]) | {"title": "t", "unfit": {}}]}},
    }
    assert "## Open" not in as_markdown(nothing_learned)


def test_learned_policies_are_confirmed_on_fresh_episodes(run, tmp_path, monkeypatch, flights_of):
    monkeypatch.setattr("agents.leaderboard.learned_policies", model_stand_in)
    data = leaderboard(
        ("TwoStation",), episodes=EPISODES, seed=SEED, confirm=2 * EPISODES, out=tmp_path, fields={"steps": STEPS},
        progress=False,
    )  # fmt: skip
    for (_, entry), (_, before) in zip(entries(data), list(entries(run[1]))[:2], strict=True):
        assert entry["policies"].keys() == before["policies"].keys()
        names = {before["best_by"][each["metric"]][each["kind"]] for each in entry["verdicts"]}
        scenario = make_scenario("TwoStation", {"steps": STEPS})
        if entry["course"] == "flights":
            scenario = flown_by("TwoStation", HELD_OUT, {"steps": STEPS})
        fresh = {
            name: fly(scenario, make_policy(name, scenario), 2 * EPISODES, SEED + EPISODES)
            for name in {*names, "oracle"}
        }
        learned = fly(scenario, make_policy("greedy", scenario), 2 * EPISODES, SEED + EPISODES).outcomes
        for each in entry["verdicts"]:
            ours, other = learned.samples[each["metric"]], fresh[each["base"]].outcomes.samples[each["metric"]]
            assert each["mean"]["ratio"] == pytest.approx(ours.mean() / other.mean(), rel=1e-12)
            assert each["p95"]["ratio"] == pytest.approx(np.percentile(ours, 95) / np.percentile(other, 95), rel=1e-12)
            oracle = fresh["oracle"].outcomes.samples[each["metric"]]
            assert each["oracle"]["ratio"] == pytest.approx(oracle.mean() / other.mean(), rel=1e-12)
        assert {each["base"] for each in entry["verdicts"]} == names
        assert (entry["confirmation"]["episodes"], entry["confirmation"]["seed"]) == (2 * EPISODES, SEED + EPISODES)
        best = set(before["best_by"]["final_range_error_m"].values()) | set(
            before["best_by"]["mean_range_error_m"].values()
        )
        assert names < entry["confirmation"]["policies"].keys() == best | {"paper"}
        assert {each["episodes"] for each in entry["verdicts"]} == {2 * EPISODES}
        reference, paper = (entry["confirmation"]["policies"][name] for name in (entry["reference"], "paper"))
        metric = entry["headline"]
        ratio = paper["ratios"][metric]["mean"]["ratio"]
        assert ratio == pytest.approx(paper[metric]["mean"] / reference[metric]["mean"], rel=1e-12)
        assert entry["verdicts"] != before["verdicts"]
    assert set(data["about"]["cells"]) == {"new"}
    assert f"--confirm {2 * EPISODES}" in data["about"]["command"]
    text = as_markdown(data)
    assert f"these ratios are of {2 * EPISODES} others" in text
    assert "the same as here" in as_markdown(run[1])
    flown = len(flights_of)
    again = leaderboard(
        ("TwoStation",), episodes=EPISODES, seed=SEED, confirm=2 * EPISODES, out=tmp_path, fields={"steps": STEPS},
        progress=False,
    )  # fmt: skip
    assert len(flights_of) == flown
    assert [entry["verdicts"] for _, entry in entries(again)] == [entry["verdicts"] for _, entry in entries(data)]


def test_costly_planners_are_not_confirmed_but_judged_on_the_first_episodes(run, tmp_path, monkeypatch):
    monkeypatch.setattr("agents.leaderboard.learned_policies", model_stand_in)
    monkeypatch.setattr("agents.leaderboard.COSTLY", {"passive/TwoStation-v0": ("planner",)})
    names = ("rule", "greedy", "planner", "learned")
    data = leaderboard(  # as many further episodes: only seeds tell them apart
        ("TwoStation",), names, episodes=EPISODES, seed=SEED, confirm=EPISODES, flights=False, out=tmp_path,
        fields={"steps": STEPS}, progress=False,
    )  # fmt: skip
    ((_, entry),) = entries(data)
    assert entry["confirmation"]["policies"].keys() == {"rule", "greedy", "learned"}
    seeds = {each["kind"]: each["seed"] for each in entry["verdicts"]}
    assert seeds == {"reference": SEED + EPISODES, "greedy": SEED + EPISODES, "planner": SEED}
    head, row = tables(as_markdown(data))[0]
    shown = dict(zip(head, row, strict=True))
    assert shown["planner"].endswith("*")
    assert not shown["greedy"].endswith("*")
    assert shown["mean [m]"] == f"{entry['confirmation']['policies']['rule']['final_range_error_m']['mean']:,.0f}"
    with (tmp_path / "verdicts.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    seeds = {row["base_kind"]: (int(row["seed"]), int(row["episodes"])) for row in rows}
    assert seeds["planner"] == (SEED, EPISODES)
    assert seeds["greedy"] == (SEED + EPISODES, EPISODES)
    (axes,) = overview(data["sections"]["leaderboard"]).axes
    hollow = {line.get_label() for line in axes.lines if line.get_markerfacecolor() == "white"}
    assert hollow == {"planner, first episodes"}


def goal_results(goals, **pairs):
    field, flown = two_errors(**pairs)
    return standing(SHORT, field, flown, 0, goals)["goals"]


def test_goals_are_reached_or_not_by_the_figure_they_are_about():
    base = np.random.default_rng(6).uniform(1.0, 2.0, 60)
    other = np.random.default_rng(7).uniform(1.0, 2.0, 60)
    pairs = {"rule__a": (base, 2.0 * base), "rule__b": (2.0 * base, base), "learned__l": (0.5 * base, other)}
    goals = (
        Goal(DRAWN, "final", 0.5),
        Goal(DRAWN, "final", 0.49),
        Goal(DRAWN, "final", 0.25, ("b",)),
        Goal(DRAWN, "final", 0.5, ("a", "b"), "p95"),
        Goal(DRAWN, "time average", 2.0),
        Goal(DRAWN, "time average", other.mean() / base.mean() + 1e-9, (), "high"),
        Goal(DRAWN, "final", 1.0, ("nobody",)),
    )
    found = goal_results(goals, **pairs)
    assert [(each["goal"], each["base"], each["met"]) for each in found] == [
        (0, "a", True), (1, "a", False), (2, "b", True), (3, "a", True), (4, "b", True), (5, "b", False),
    ]  # fmt: skip
    assert found[0]["ratio"] == found[3]["ratio"] == pytest.approx(0.5)
    assert found[5]["ratio"] == pytest.approx(other.mean() / base.mean())
    assert found[5]["ci95"][0] < found[5]["ratio"] < found[5]["ci95"][1]


def test_goals_about_what_was_not_flown_are_left_out():
    """No fixed policy or rule, or no episode with such an error."""
    base = np.random.default_rng(6).uniform(1.0, 2.0, 60)
    goals = (Goal(DRAWN, "final", 1.0), Goal(DRAWN, "while maneuvering", 1.0, ("g",)))
    assert goal_results(goals, greedy__g=(base, base), learned__l=(base, base)) == []


def test_a_goal_of_lost_tracks_compares_shares():
    base = np.full(40, 1.0)
    field, flown = two_errors(rule__r=(base, base), learned__l=(base, base))
    for name, lost in (("r", 4), ("l", 3)):
        flown[name].lost[:lost] = 1.0
    (found,) = standing(SHORT, field, flown, 0, (Goal(DRAWN, LOST, 1.0, ("r",)),))["goals"]
    assert found["ratio"] == pytest.approx(0.75)
    assert found["met"]
    assert np.isfinite(found["ci95"]).all()
    flown["r"].lost[:] = 0.0
    (found,) = standing(SHORT, field, flown, 0, (Goal(DRAWN, LOST, 1.0, ("r",)),))["goals"]
    assert found["ratio"] == pytest.approx(3.0)  # one lost counts where none is
    assert not found["met"]


def test_goals_name_errors_and_policies_that_there_are():
    for environment, goals in GOALS.items():
        scenario = make_scenario(environment, {})
        for goal in goals:
            assert goal.course in (DRAWN, RECORDED)
            assert goal.what in ("mean", "p95", "high")
            assert set(goal.against) <= set(policy_names(scenario))
        flown = fly(scenario, make_policy("rule", scenario), EPISODES, SEED).outcomes
        words = standing(scenario, [by_name("rule")], {"rule": flown}, SEED)["metrics"].values()
        assert {goal.error for goal in goals} <= {*words, LOST}
    assert set(GOALS) == set(environment_ids())


@pytest.mark.parametrize(
    ("name", "policies", "goals"),
    [
        ("AngleFusionSlow", ("rule", "greedy", "pretrained"), ["rule", "greedy"]),
        ("AngleFusionSlow", ("greedy", "pretrained"), ["greedy"]),  # none can be held against the best rule
        ("RadarPlacement", ("optimizer", "pretrained"), ["optimizer"]),  # spared, but the reference
    ],
)
def test_goals_of_registered_environments_are_judged_on_further_episodes(name, policies, goals, tmp_path):
    data = leaderboard((name,), policies, episodes=3, confirm=2, seed=SEED, flights=False, out=tmp_path, progress=False)
    ((_, entry),) = entries(data)
    assert [(each["base"], each["episodes"]) for each in entry["goals"]] == [(base, 2) for base in goals]
    assert "## What was meant to be reached" in (tmp_path / "leaderboard.md").read_text()


def test_the_committed_page_has_every_goal():
    text = (Path(__file__).parents[1] / "docs" / "leaderboard.md").read_text(encoding="utf-8")
    rows = tables(text.partition("\n## What was meant to be reached\n")[2])[0][1:]
    assert Counter(f"passive/{row[0].strip('`')}" for row in rows) == {env: len(goals) for env, goals in GOALS.items()}
    assert f"{sum(row[-1] == 'yes' for row in rows)} of {len(rows)} do." in text


def test_sentences_say_where_what_was_learned_is_behind(run):
    base = np.random.default_rng(8).uniform(1.0, 2.0, 50)
    factors = {"own": 3.0, "one": 2.0, "two": 0.5, "three": 1.5, "as one": 2.0, "as own": 3.0}
    found = [
        table_of(rule__r=base, learned__pretrained=factor * base) | {"title": title, "tracker": title, "unfit": {}}
        for title, factor in factors.items()
    ]
    misfit = table_of(rule__r=base) | {"title": "four", "unfit": {"pretrained": "other observations"}}
    about = run[1]["about"] | {"trained_on_flights": {"passive/X-v0": 0.25}}
    sections = {name: {"passive/X-v0": [*found, misfit]} for name in ("leaderboard", "trackers", "generalisation")}
    text = as_markdown({"about": about, "sections": sections})
    assert "ahead in 1, level in 0, behind in 2 (`X-v0` one 2.00, `X-v0` three 1.50); 1 more show it" in text
    assert "Behind the best fixed policy or rule: own 3.00, one 2.00, three 1.50, as one 2.00, as own 3.00." in text
    assert "`pretrained` met other recorded flights in 25 % of its training" in text
    another = table_of(rule__r=base, learned__learned=0.5 * base) | {"title": "one", "unfit": {}}
    for name, entry in (("X", another), ("Y", found[2])):  # a run of the user's; none of its training on flights
        sections["generalisation"] = {f"passive/{name}-v0": [entry]}
        text = as_markdown({"about": about, "sections": sections})
        assert "Behind the best fixed policy or rule: nowhere." in text
        assert "met other recorded flights" not in text


def test_decision_times_are_the_least_of_all_flights():
    base = np.full(30, 2.0)
    drawn, recorded = (table_of(rule__r=base, learned__l=base) | {"title": "t", "unfit": {}} for _ in range(2))
    for entry, times in ((drawn, (5.0, 9.0)), (recorded, (7.0, 3.0))):
        for name, time in zip(("r", "l"), times, strict=True):
            entry["policies"][name]["decision_time_us"] = time
    recorded["confirmation"] = {"policies": {"l": {"decision_time_us": 2.0}}}
    assert decision_times([drawn, recorded]) == {"r": 5.0, "l": 2.0}


def test_what_was_tried_stands_below_what_is_open(run, monkeypatch):
    data = run[1]
    monkeypatch.setattr("agents.leaderboard.judged.TRIED", {})
    assert "What was tried" not in as_markdown(data)
    name = next(env for env, found in data["sections"]["leaderboard"].items() if any(e["verdicts"] for e in found))
    tried = Tried("Ratios.", ("drawn",), (("packed", "1.1"), ("wider rollouts", "1.2")), "Wider is no better.")
    monkeypatch.setattr("agents.leaderboard.judged.TRIED", {name: tried})
    assert any(each["open"] for _, entry in entries(data) for each in entry["verdicts"])
    text = as_markdown(data)
    assert [["tried", "drawn"], ["packed", "1.1"], ["wider rollouts", "1.2"]] in tables(text)
    assert "Ratios." in text
    assert "Wider is no better." in text


def test_room_is_the_oracles_ratio_with_its_interval(run):
    base = np.full(40, 8.0)
    with_oracle = table_of(rule__a=base, oracle__c=0.75 * base, learned__d=base) | {"title": "t", "unfit": {}}
    without = table_of(rule__a=base, learned__d=base) | {"title": "u", "unfit": {}}
    data = {"about": run[1]["about"], "sections": {"leaderboard": {"passive/X-v0": [with_oracle, without]}}}
    rows = next(found for found in tables(as_markdown(data)) if "against" in found[0])[1:]
    assert [row[-1] for row in rows] == ["0.750 [0.750, 0.750]"] * 2 + ["—"] * 2


def test_only_environments_are_said_to_have_been_tried_and_rows_are_whole():
    assert set(TRIED) <= set(environment_ids())
    for tried in TRIED.values():
        assert {len(row) for row in tried.rows} == {1 + len(tried.columns)}


def test_of_everything_open_on_the_committed_page_it_is_said_what_was_tried():
    text = (Path(__file__).parents[1] / "docs" / "leaderboard.md").read_text(encoding="utf-8")
    head, *rows = next(found for found in tables(text.partition("\n## Open\n")[2]))
    assert "against" in head
    assert {f"passive/{row[0].strip('`')}" for row in rows} <= set(TRIED)


def test_tables_of_trackers_and_circumstances(run):
    _, data = run
    text = as_markdown(data)
    trackers = [found for found in tables(text) if found[0][0] == "tracker"]
    assert next(row for row in trackers[0] if "does not fit" in row)[:2] == ["`fused_ekf`", "`learned`"]
    varied = next(found for found in tables(text) if found[0][0] == "circumstances")
    entry = data["sections"]["generalisation"]["passive/TwoStation-v0"][1]
    shown = dict(zip(varied[0], varied[2], strict=True))
    (against,) = (e for e in entry["verdicts"] if e["metric"] == entry["headline"] and e["kind"] == "reference")
    assert shown["circumstances"] == entry["title"]
    assert shown["mean / fixed or rule"] == "{:.3f} [{:.3f}, {:.3f}]".format(
        against["mean"]["ratio"], *against["mean"]["ci95"]
    )


def test_every_row_has_as_many_cells_as_its_head(run):
    _, data = run
    for found in tables(as_markdown(data)):
        assert {len(row) for row in found} == {len(found[0])}


def test_head_says_what_it_was_made_with_and_no_computers_name(run):
    out, data = run
    text, about = as_markdown(data), data["about"]
    for part in (
        about["date"],
        about["processor"],
        f"{about['cores']} cores",
        f"numpy {np.__version__}",
        "seed 400",
        about["code"],
    ):
        assert str(part) in text
    (command,) = (line.strip() for line in text.splitlines() if line.startswith("    passive-env leaderboard"))
    assert command == (
        "passive-env leaderboard --envs TwoStation passive/Ownship-v0 --fields steps=4 --episodes 6 --seed 400 "
        "--trackers --generalisation"
    )
    made_with = {
        "date",
        "episodes",
        "seed",
        "fields",
        "command",
        "confirm",
        "processor",
        "cores",
        "platform",
        "versions",
        "commit",
        "code",
        "held_out",
        "trained_on_flights",
    }
    assert set(about) == made_with | {"cells", "seconds"}
    assert str(out) not in (out / "leaderboard.json").read_text()


def test_overview_shows_the_ratios_and_the_bound(run):
    _, data = run
    figure = overview(data["sections"]["leaderboard"])
    assert len(figure.axes) == 2
    for axes, place in zip(figure.axes, (0, 1), strict=True):
        shown = {(line.get_label(), round(float(line.get_xdata()[0]), 9)) for line in axes.lines}
        for found in data["sections"]["leaderboard"].values():
            entry = found[place]
            for kind, name in entry["best"].items():
                ratio = entry["policies"][name]["ratios"]["final_range_error_m"]["mean"]["ratio"]
                assert (kind, round(min(max(ratio, NEAREST), FARTHEST), 9)) in shown
            share = entry["bound"]["mean"] / entry["policies"][entry["reference"]]["final_range_error_m"]["mean"]
            assert ("bound", round(min(max(share, NEAREST), FARTHEST), 9)) in shown
        assert axes.get_xscale() == "log"
    with pytest.raises(ValueError, match="at least one environment"):
        overview({})


@pytest.mark.parametrize(("factor", "words"), [(40.0, "40 →"), (0.2, "← 0.2"), (2.5, None)])
def test_ratios_far_off_stand_at_the_edge_with_their_number(factor, words):
    base = np.random.default_rng(5).uniform(1.0, 2.0, 30)
    entry = table_of(rule__r=base, greedy__g=factor * base) | {"title": "drawn courses"}
    for bound, beside in ((1.0, []), (0.1, ["← 0.1"])):
        entry["bound"]["mean"] = bound * base.mean()
        (axes,) = overview({"passive/X-v0": [entry]}).axes
        assert [text.get_text() for text in axes.texts] == ([words] if words else []) + beside
    (dot,) = (line for line in axes.lines if line.get_label() == "greedy")
    assert dot.get_xdata()[0] == pytest.approx(min(max(factor, NEAREST), FARTHEST))
    left, right = axes.get_xlim()
    assert left < dot.get_xdata()[0] < right


# ------------------------------------------------------------------------------------------------ the command


def test_command_writes_prints_and_goes_on(tmp_path, capsys):
    out = tmp_path / "out"
    arguments = [
        "leaderboard", "--envs", "TwoStation", "--policies", "paper", "rule", "--episodes", "3", "--no-flights",
        "--fields", "steps=3", "--out", str(out),
    ]  # fmt: skip
    assert cli.main(arguments) == 0
    assert {path.name for path in out.iterdir()} == FILES | {"cells"}
    assert "2 flown" in capsys.readouterr().out
    assert cli.main(arguments) == 0
    assert "2 kept" in capsys.readouterr().out
    assert cli.main([*arguments, "--seed", "5"]) == 0
    assert "2 flown anew, seed being others than in those kept so far" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--envs", "passive/TwoStations-v0"], ["'passive/TwoStations-v0'", "did you mean", "passive/TwoStation-v0"]),
        (["--policies", "rule", "rules"], ["--policies 'rules'", "rule_tuned", "greedy"]),
        (["--envs", "Ownship", "--policies", "optimizer"], ["--policies 'optimizer'", "no environment offers it"]),
        (["--episodes", "1"], ["--episodes 1", "at least 2"]),
        (["--episodes", "-4"], ["--episodes -4"]),
        (["--seed", "-1"], ["--seed -1"]),
        (["--confirm", "1"], ["--confirm 1", "at least 2"]),
        (["--runs", "runs/x"], ["--runs 'runs/x'", "ENV=RUN"]),
        (["--runs", "Ownship="], ["--runs 'Ownship='", "ENV=RUN"]),
        (["--runs", "Nowhere=runs/x"], ["'Nowhere'", "passive/Ownship-v0"]),
        (["--envs", "TwoStation", "--runs", "Ownship=runs/x"], ["passive/Ownship-v0 takes no part", "--envs"]),
        (["--runs", "Ownship=no/such/run"], ["no/such/run", "config.json"]),
        (["--fields", "course=flights"], ["--fields course=flights", "leave it out"]),
        (["--fields", "stepps=4"], ["'stepps'", "did you mean 'steps'"]),
        (["--fields", "steps"], ["'steps'", "NAME=VALUE"]),
    ],
    ids=lambda value: " ".join(value),
)
def test_bad_input_is_refused_in_one_line_before_anything_is_done(tmp_path, capsys, monkeypatch, arguments, words):
    def too_late(*_, **__):
        raise AssertionError("episodes are being flown")

    monkeypatch.setattr(evaluation, "fly", too_late)
    out = tmp_path / "out"
    assert cli.main(["leaderboard", *arguments, "--out", str(out)]) == 2
    printed = capsys.readouterr()
    assert len(printed.err.strip().splitlines()) == 1
    for word in words:
        assert word in printed.err
    assert not out.exists()


def test_a_file_in_the_place_of_the_output_folder_is_refused(tmp_path, capsys):
    (tmp_path / "taken").write_text("mine")
    arguments = ["--envs", "TwoStation", "--policies", "paper", "--out", str(tmp_path / "taken")]
    assert cli.main(["leaderboard", *arguments]) == 2
    assert "is a file, must name a folder" in capsys.readouterr().err
    assert (tmp_path / "taken").read_text() == "mine"


def test_csv_has_no_row_without_a_policy(run):
    _, data = run
    rows = list(csv.reader(as_csv(data).splitlines()))
    assert {len(row) for row in rows} == {len(rows[0])}
    assert set(environment_ids()) >= {row[1] for row in rows[1:]}
