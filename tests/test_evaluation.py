"""Evaluation: paired tapes, the summary's schema and statistics, the files, and the commands with their refusals."""

import csv
import json
import runpy
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from markdown_tables import tables
from scipy.stats import binom, chi2, norm

from agents import cli, evaluation
from agents.comparison import difference_of_means, ratio_of_means, summarize
from agents.evaluation import fly, fly_all, unique_names
from agents.outcomes import Record, steps_axis
from agents.pictures import EpisodePaths
from agents.policy import make_policy, policy_names
from agents.report import as_csv, as_markdown, write_evaluation
from passive_env import PassiveVectorEnv
from passive_env.catalogue.angle_fusion import AngleFusion
from passive_env.catalogue.ownship import Ownship
from passive_env.catalogue.two_station import TwoStation
from passive_env.scenario import parse_fields

SHORT = TwoStation(steps=6)
PICTURES = ("range_error_over_time.png", "geometry.png", "maneuvers.png")
FILES = {"evaluation.json", "evaluation.csv", "evaluation.md", *PICTURES}
STATISTICS = {"mean", "median", "rms", "p95"}


def policies(scenario, *names):
    return {name: make_policy(name, scenario) for name in names}


def record(range_error_m, lost=None) -> Record:
    """A record of hand-made errors [e, k + 1]; everything else is plausible."""
    errors = np.array(range_error_m, dtype=float)
    episodes, instants = errors.shape
    paths = EpisodePaths(
        np.cumsum(np.full((instants, 2, 2), 500.0), axis=0),
        np.full((instants, 1, 2), 7e4) + np.arange(instants)[:, None, None],
        np.full((instants, 1, 2), 6e4) + np.arange(instants)[:, None, None],
        np.full((1, 2, 2), 1e6) * np.eye(2),
        np.full((instants, 1), 1e3),
        np.full((instants, 1), 5e2),
    )
    share = np.zeros(episodes) if lost is None else np.array(lost, dtype=float)
    off_sight, turns = np.full((episodes, instants, 2), 0.5), np.zeros((episodes, instants - 1, 2))
    return Record(
        errors, 0.5 * errors, share, 0.5 * share, 12.5, paths, np.arange(1.0, episodes + 1.0)[:, None], off_sight,
        turns, 0.25 * share, 0.0 * share,
    )  # fmt: skip


# ------------------------------------------------------------------------------------------------ paired tapes


def test_all_policies_meet_the_same_targets_and_noise(monkeypatch):
    tapes = []

    class Spy(PassiveVectorEnv):
        def reset(self, **kwargs):
            result = super().reset(**kwargs)
            tapes.append((kwargs["seed"], self.world.tape))
            return result

    monkeypatch.setattr(evaluation, "PassiveVectorEnv", Spy)
    records = fly_all(SHORT, policies(SHORT, "paper", "rule", "random"), 5, 40, progress=False)
    assert [seed for seed, _ in tapes] == [40, 40, 40]
    for _, tape in tapes[1:]:
        for ours, first in zip(tape, tapes[0][1], strict=True):
            assert np.array_equal(ours, first)
    for ours in records.values():
        assert np.array_equal(ours.range_error_m[:, 0], records["paper"].range_error_m[:, 0])
        assert np.array_equal(ours.paths.targets, records["paper"].paths.targets)
    assert not np.array_equal(records["rule"].final, records["paper"].final)


def test_records_are_what_single_environments_show():
    """Episode i is the single environment reset with seed + i."""
    from passive_env import PassiveEnv

    flown = fly(SHORT, make_policy("rule", SHORT), 3, 70)
    assert flown.range_error_m.shape == flown.range_crlb_m.shape == (3, 7)
    for i in range(3):
        env, policy = PassiveEnv(SHORT), make_policy("rule", SHORT)
        observation, info = env.reset(seed=70 + i)
        policy.reset(env.belief())
        errors, bounds = [info["range_error_m"].mean()], [info["range_crlb_m"].mean()]
        for _ in range(6):
            command = policy.act(env.belief(), observation[None])[0].astype(np.float32)
            observation, _, _, _, info = env.step(command)
            errors.append(info["range_error_m"].mean())
            bounds.append(info["range_crlb_m"].mean())
        np.testing.assert_allclose(flown.range_error_m[i], errors, rtol=1e-12)
        np.testing.assert_allclose(flown.range_crlb_m[i], bounds, rtol=1e-12)
        assert flown.lost[i] == info["lost"].mean()


@pytest.mark.parametrize("name", policy_names(SHORT))
def test_cutting_episodes_into_blocks_changes_nothing(monkeypatch, name):
    scenario = TwoStation(steps=6, detection_probability=0.8, false_bearings_mean=1.0)
    whole = fly(scenario, make_policy(name, scenario), 11, 5)
    monkeypatch.setattr(evaluation, "BLOCK", 4)
    cut = fly(scenario, make_policy(name, scenario), 11, 5)
    for field in (
        "range_error_m", "range_crlb_m", "lost", "collapsed", "nees", "off_sight_rad", "turns", "standoff", "nogo",
    ):  # fmt: skip
        assert np.array_equal(getattr(cut, field), getattr(whole, field)), field
    assert np.array_equal(cut.paths.stations, whole.paths.stations)


def test_discrete_actions_are_flown_as_choices():
    scenario = TwoStation(steps=6, actions="discrete")
    flown = fly(scenario, make_policy("rule", scenario), 2, 0)
    velocity = np.diff(flown.paths.stations, axis=0)
    heading = np.degrees(np.arctan2(velocity[..., 1], velocity[..., 0]))
    turned = (np.diff(heading, axis=0) + 180.0) % 360.0 - 180.0
    assert np.all(np.isclose(np.abs(turned) % 5.0, 0.0, atol=1e-3) | np.isclose(np.abs(turned) % 5.0, 5.0, atol=1e-3))
    assert np.abs(turned).max() > 1.0


def test_courses_and_turns_are_those_flown():
    """Station 1 turns left by its full rate; angles from one platform's states and the true targets, by hand."""

    class LeftTurn:
        def reset(self, belief):
            pass

        def act(self, belief, observation):
            return np.tile([1.0, 0.0], (len(observation), 1))

    flown = fly(SHORT, LeftTurn(), 3, 20)
    assert flown.off_sight_rad.shape == (3, 7, 2)
    assert flown.turns.shape == (3, 6, 2)
    assert (flown.turns == [1.0, 0.0]).all()
    env = PassiveVectorEnv(SHORT, num_envs=3, autoreset_mode="disabled")
    env.reset(seed=20)
    for k in range(7):
        for e, s in np.ndindex(3, 2):
            x, y, vx, vy = env.world.platforms[e, s]
            tx, ty = env.world.truth[e, :, :2].mean(0) - (x, y)
            expected = np.arctan2(tx * vy - ty * vx, tx * vx + ty * vy)  # signed angle from sight to course
            assert flown.off_sight_rad[e, k, s] == pytest.approx(expected, abs=1e-6)
        if k < 6:
            env.step(np.tile(np.float32([1.0, 0.0]), (3, 1)))


def test_intrusions_are_counted_per_step():
    """A ring of 100 km about targets at 60 to 80 km: everybody is inside all the time; without a ring never."""
    for standoff_m, share in ((1e5, 1.0), (0.0, 0.0)):
        scenario = SHORT.replace(standoff_m=standoff_m)
        flown = fly(scenario, make_policy("straight", scenario), 3, 0)
        assert flown.standoff.tolist() == [share] * 3
        assert flown.nogo.tolist() == [0.0] * 3
        assert flown.paths.standoff_m == standoff_m
    scenario = Ownship(steps=40, nogo_discs=2)
    flown = fly(scenario, make_policy("straight", scenario), 40, 0)
    env, entered = PassiveVectorEnv(scenario, num_envs=40, autoreset_mode="disabled"), np.zeros(40)
    env.reset(seed=0)
    for _ in range(40):
        env.step(np.zeros((40, 1), dtype=np.float32))
        gap = np.linalg.norm(env.world.platforms[:, None, 0, :2] - env.world.tape.discs[..., :2], axis=-1) - 8e3
        entered += (gap < 0.0).any(-1)
    assert entered.sum() > 0.0
    np.testing.assert_allclose(flown.nogo, entered / 40)
    assert summarize("e", 0, {"a": flown})["policies"]["a"]["nogo_share"] == pytest.approx(entered.mean() / 40)
    assert np.array_equal(flown.paths.discs, env.world.tape.discs[0])


@pytest.mark.parametrize("episodes", [0, -1])
def test_no_episodes_is_an_error(episodes):
    with pytest.raises(ValueError, match="episodes"):
        fly(SHORT, make_policy("rule", SHORT), episodes, 0)


def test_collapsed_tracks_end_far_off_or_beyond_their_nees_quantile():
    """A scenario in which tracks get lost: shares of tracks, from the figures of the same episodes' last instant."""
    scenario = TwoStation(steps=20, hypotheses=1, process_noise_m_s=0.0, bearings="reference")
    flown = fly(scenario, make_policy("straight", scenario), 60, 0)
    env, policy = PassiveVectorEnv(scenario, num_envs=60), make_policy("straight", scenario)
    observation, _ = env.reset(seed=0)
    policy.reset(env.belief())
    for _ in range(20):
        observation, *_, info = env.step(policy.act(env.belief(), observation))
    far, inconsistent = info["position_error_m"] > 15e3, info["nees"] > chi2.ppf(0.9999, df=4)
    np.testing.assert_array_equal(flown.nees, info["nees"])
    np.testing.assert_allclose(flown.collapsed, (far | inconsistent).mean(-1))
    np.testing.assert_allclose(flown.lost, info["lost"].mean(-1))
    for one, other in ((far, inconsistent), (inconsistent, far)):
        assert (one & ~other).any()


# ------------------------------------------------------------------------------------------------ statistics


def test_summary_has_exactly_the_agreed_schema():
    records = fly_all(SHORT, policies(SHORT, "paper", "rule", "straight"), 4, 9, progress=False)
    summary = summarize("passive/TwoStation-v0", 9, records)
    assert {"environment", "episodes", "seed", "policies", "ratios"} <= set(summary)
    assert (summary["environment"], summary["episodes"], summary["seed"]) == ("passive/TwoStation-v0", 4, 9)
    assert list(summary["policies"]) == ["paper", "rule", "straight"]
    for figures in summary["policies"].values():
        assert set(figures["final_range_error_m"]) == set(figures["mean_range_error_m"]) == STATISTICS
        assert type(figures["lost_share"]) is type(figures["decision_time_us"]) is float
        assert figures["decision_time_us"] > 0.0
    assert set(summary["ratios"]) == {"paper", "rule"}
    for base, compared in summary["ratios"].items():
        assert set(compared) == {"paper", "rule", "straight"} - {base}
        for metrics in compared.values():
            assert set(metrics) == {"final_range_error_m", "mean_range_error_m"}
            for ratio in metrics.values():
                assert set(ratio) == {"ratio", "ci95"}
                low, high = ratio["ci95"]
                assert low <= ratio["ratio"] <= high
    json.dumps(summary, allow_nan=False)


def test_statistics_by_hand():
    """Five episodes of three instants; index 0, before the first decision, counts in neither figure."""
    errors = [[9e9, 10.0, 1.0], [9e9, 20.0, 2.0], [9e9, 30.0, 3.0], [9e9, 40.0, 4.0], [9e9, 50.0, 10.0]]
    base = [[9e9, 20.0, 2.0]] * 5
    summary = summarize("e", 0, {"paper": record(base), "x": record(errors, lost=[0.0, 0.0, 1.0, 0.5, 0.0])})
    figures = summary["policies"]["x"]
    final, mean = figures["final_range_error_m"], figures["mean_range_error_m"]
    assert final == pytest.approx({"mean": 4.0, "median": 3.0, "rms": np.sqrt(130.0 / 5.0), "p95": 4.0 + 0.8 * 6.0})
    # Episode averages over instants 1 and 2: 5.5, 11, 16.5, 22, 30.
    assert mean["mean"] == pytest.approx(17.0)
    assert mean["median"] == pytest.approx(16.5)
    assert mean["rms"] == pytest.approx(np.sqrt((5.5**2 + 11.0**2 + 16.5**2 + 22.0**2 + 30.0**2) / 5.0))
    assert mean["p95"] == pytest.approx(22.0 + 0.8 * 8.0)
    assert figures["lost_share"] == pytest.approx(0.3)
    assert figures["decision_time_us"] == 12.5
    assert figures["collapse_share"] == pytest.approx(0.15)
    # NEES 1 to 5 lie inside the 95 % band of χ² with 4 degrees, 0.484 to 11.14.
    assert figures["final_nees"] == pytest.approx({"mean": 3.0, "median": 3.0, "rms": np.sqrt(11.0), "p95": 4.8})
    assert figures["final_nees_in_band_share"] == 1.0
    half = replace(record(base), nees=np.array([[0.4, 1.0], [11.0, 12.0]]))
    assert summarize("e", 0, {"x": half})["policies"]["x"]["final_nees_in_band_share"] == pytest.approx(0.5)
    ratios = summary["ratios"]["paper"]["x"]
    assert ratios["final_range_error_m"]["ratio"] == pytest.approx(4.0 / 2.0)
    assert ratios["mean_range_error_m"]["ratio"] == pytest.approx(17.0 / 11.0)


def test_without_the_usual_baselines_the_first_policy_is_the_baseline():
    summary = summarize("e", 0, {"a": record([[1.0, 2.0]] * 3), "b": record([[1.0, 4.0]] * 3)})
    assert list(summary["ratios"]) == ["a"]
    assert summary["ratios"]["a"]["b"]["final_range_error_m"] == {"ratio": 2.0, "ci95": [2.0, 2.0]}


def test_ratio_of_identical_samples_is_one_without_doubt():
    values = np.random.default_rng(0).lognormal(7.0, 1.0, 50)
    assert ratio_of_means(values, values) == {"ratio": 1.0, "ci95": [1.0, 1.0]}
    tripled = ratio_of_means(3.0 * values, values)
    assert [tripled["ratio"], *tripled["ci95"]] == pytest.approx([3.0, 3.0, 3.0])


def test_ratio_of_a_single_episode_has_no_interval():
    assert ratio_of_means(np.array([3.0]), np.array([2.0])) == {"ratio": 1.5, "ci95": [1.5, 1.5]}


def test_ratio_interval_is_paired():
    """What episodes have in common cancels: the unpaired interval would be some ten times as wide."""
    rng = np.random.default_rng(1)
    base = rng.lognormal(7.0, 1.0, 300)
    low, high = ratio_of_means(0.8 * base * rng.normal(1.0, 0.05, 300), base)["ci95"]
    assert low < 0.8 < high
    assert high - low < 0.03


def test_ratio_interval_covers_the_true_ratio_as_often_as_it_says():
    """Percentile intervals of 100 episodes fall a little short of 95 %: between 92.5 and 96.5 % is honest."""
    rng = np.random.default_rng(2)
    trials, hits = 400, 0
    for _ in range(trials):
        common = rng.gamma(4.0, 0.25, 100)
        values, base = 0.7 * common * rng.gamma(9.0, 1.0 / 9.0, 100), common * rng.gamma(9.0, 1.0 / 9.0, 100)
        low, high = ratio_of_means(values, base)["ci95"]
        hits += low <= 0.7 <= high
    assert binom.ppf(5e-4, trials, 0.925) <= hits <= binom.ppf(1.0 - 5e-4, trials, 0.965)


def test_ratios_repeat():
    rng = np.random.default_rng(3)
    values, base = rng.lognormal(size=(2, 40))
    assert ratio_of_means(values, base) == ratio_of_means(values, base)
    assert ratio_of_means(values, base, seed=1)["ci95"] != ratio_of_means(values, base)["ci95"]


def test_names_of_several_learned_policies_are_numbered():
    assert unique_names(["rule", "learned", "learned", "rule", "learned"]) == [
        "rule", "learned", "learned_2", "rule_2", "learned_3",
    ]  # fmt: skip


def test_time_axis():
    assert steps_axis(TwoStation(steps=3, step_s=0.5)).tolist() == [0.0, 0.5, 1.0, 1.5]


# ------------------------------------------------------------------------------------------------ positions in space


def test_in_space_the_position_error_counts_and_the_range_error_stands_beside_it():
    """The record against a loop of one's own over the same episodes."""
    scenario = AngleFusion(steps=8, clutter_mean=4.0)
    flown = fly(scenario, make_policy("rule", scenario), 5, 3)
    env = PassiveVectorEnv(scenario, num_envs=5, autoreset_mode="disabled")
    observation, info = env.reset(seed=3)
    policy = make_policy("rule", scenario)
    policy.reset(env.belief())
    told = [info]
    for _ in range(8):
        observation, *_, info = env.step(policy.act(env.belief(), observation))
        told.append(info)
    for name in ("position_error_m", "position_crlb_m", "range_error_m", "range_crlb_m"):
        np.testing.assert_allclose(getattr(flown, name), np.stack([info[name][:, 0] for info in told], axis=1))
    assert flown.score == "position"
    assert np.array_equal(flown.final, flown.position_error_m[:, -1])
    assert np.array_equal(flown.mean, flown.position_error_m[:, 1:].mean(axis=1))
    late = np.stack([info["position_error_m"][:, 0] for info in told[-5:]]).mean(axis=0)
    assert np.array_equal(flown.lost_late, late > 1000.0)
    assert np.array_equal(flown.paths.error_m[:, 0], flown.position_error_m[0])
    assert flown.paths.error == "position"
    assert fly(SHORT, make_policy("rule", SHORT), 2, 0).score == "range"


def test_summary_in_space_has_both_errors_and_late_losses_with_their_intervals():
    scenario = AngleFusion(steps=6)
    records = fly_all(scenario, policies(scenario, "paper", "rule", "straight"), 20, 9, progress=False)
    summary = summarize("passive/AngleFusion-v0", 9, records)
    assert summary["score"] == "position"
    for name, figures in summary["policies"].items():
        for kind in ("position", "range"):
            errors = getattr(records[name], f"{kind}_error_m")
            assert figures[f"final_{kind}_error_m"]["mean"] == errors[:, -1].mean()
            assert figures[f"mean_{kind}_error_m"]["p95"] == np.percentile(errors[:, 1:].mean(axis=1), 95.0)
        share, n, z = figures["lost_late_share"], 20, norm.ppf(0.975)
        middle, half = share + z * z / (2 * n), z * np.sqrt(share * (1 - share) / n + z * z / (4 * n * n))
        wilson = (np.array([middle - half, middle + half]) / (1 + z * z / n)).tolist()
        assert figures["lost_late_ci95"] == pytest.approx(wilson, abs=1e-9)
    for compared in summary["ratios"].values():
        for ratios in compared.values():
            assert set(ratios) == {
                "final_position_error_m", "mean_position_error_m", "final_range_error_m", "mean_range_error_m",
                "lost_late_share",
            }  # fmt: skip
    json.dumps(summary, allow_nan=False)


def test_files_in_space_show_the_position(tmp_path):
    scenario = AngleFusion(steps=6)
    records = fly_all(scenario, policies(scenario, "paper", "rule", "straight"), 4, 0, progress=False)
    summary = summarize("passive/AngleFusion-v0", 0, records)
    written = {path.name for path in write_evaluation(tmp_path, summary, records, scenario)}
    assert written == (FILES - {"range_error_over_time.png"}) | {"position_error_over_time.png"}
    figures, ratios = tables(as_markdown(summary))
    shown, told = dict(zip(figures[0], figures[2], strict=True)), summary["policies"]["rule"]
    assert shown["final mean"] == f"{told['final_position_error_m']['mean']:.0f}"
    assert shown["time average"] == f"{told['mean_position_error_m']['mean']:.0f}"
    assert shown["average p95"] == f"{told['mean_position_error_m']['p95']:.0f}"
    assert shown["range final"] == f"{told['final_range_error_m']['mean']:.0f}"
    assert shown["range average"] == f"{told['mean_range_error_m']['mean']:.0f}"
    assert shown["lost late"] == f"{100 * told['lost_late_share']:.2f} %"
    assert shown["bound"] == f"{told['final_position_crlb_m']:.0f}"
    assert [row[1] for row in ratios[1:4]] == ["final", "time average", "lost late, less base"]
    ratio = summary["ratios"]["rule"]["straight"]["final_position_error_m"]
    found = {(row[0], row[1]): dict(zip(ratios[0], row, strict=True)) for row in ratios[1:]}
    assert found["straight", "final"]["/ rule"].startswith(f"{ratio['ratio']:.3f} [")
    rows = list(csv.DictReader((tmp_path / "evaluation.csv").read_text().splitlines()))
    assert float(rows[2]["final_position_error_m_over_rule"]) == ratio["ratio"]
    assert float(rows[1]["lost_late_ci95_high"]) == told["lost_late_ci95"][1]


def test_difference_of_paired_shares_may_be_taken_to_none():
    lost = np.array([1.0, 0.0, 1.0, 0.0] * 50)
    compared = difference_of_means(lost, np.zeros(200))
    low, high = compared["ci95"]
    half = norm.ppf(0.975) * np.sqrt(0.25 / 200)
    assert compared["difference"] == 0.5
    assert [low, high] == pytest.approx([0.5 - half, 0.5 + half], abs=0.015)
    assert difference_of_means(lost, lost) == {"difference": 0.0, "ci95": [0.0, 0.0]}
    assert difference_of_means(lost[:1], np.zeros(1)) == {"difference": 1.0, "ci95": [1.0, 1.0]}


# ------------------------------------------------------------------------------------------------ files


@pytest.fixture(scope="module")
def two_records():
    return fly_all(SHORT, policies(SHORT, "paper", "rule", "random"), 4, 0, progress=False)


def test_files_say_what_the_summary_says(tmp_path, two_records):
    summary = summarize("passive/TwoStation-v0", 0, two_records)
    written = write_evaluation(tmp_path / "new" / "folder", summary, two_records, SHORT)
    folder = tmp_path / "new" / "folder"
    assert {path.name for path in written} == {path.name for path in folder.iterdir()} == FILES
    assert json.loads((folder / "evaluation.json").read_text()) == summary
    for name in PICTURES:
        assert (folder / name).read_bytes()[:8] == b"\x89PNG\r\n\x1a\n"
    rows = list(csv.DictReader((folder / "evaluation.csv").read_text().splitlines()))
    assert [row["policy"] for row in rows] == ["paper", "rule", "random"]
    for row in rows:
        figures = summary["policies"][row["policy"]]
        assert float(row["final_range_error_m_mean"]) == figures["final_range_error_m"]["mean"]
        assert float(row["mean_range_error_m_p95"]) == figures["mean_range_error_m"]["p95"]
        for name in ("lost_share", "collapse_share", "final_nees_in_band_share"):
            assert float(row[name]) == figures[name]
        assert float(row["final_nees_mean"]) == figures["final_nees"]["mean"]
    ratio = summary["ratios"]["rule"]["random"]["final_range_error_m"]
    assert float(rows[2]["final_range_error_m_over_rule"]) == ratio["ratio"]
    assert [float(rows[2][f"final_range_error_m_over_rule_{end}"]) for end in ("low", "high")] == ratio["ci95"]
    assert rows[0]["final_range_error_m_over_paper"] == ""


def test_markdown_shows_figures_then_ratios(two_records):
    summary = summarize("passive/TwoStation-v0", 0, two_records)
    text = as_markdown(summary)
    figures, ratios = tables(text)
    for table in (figures, ratios):
        assert len({len(row) for row in table}) == 1
    assert [row[0] for row in figures[1:]] == ["paper", "rule", "random"]
    shown, random = dict(zip(figures[0], figures[3], strict=True)), summary["policies"]["random"]
    assert shown["final mean"] == f"{random['final_range_error_m']['mean']:.0f}"
    assert shown["time average"] == f"{random['mean_range_error_m']['mean']:.0f}"
    assert shown["NEES mean / median"] == "{mean:.1f} / {median:.1f}".format(**random["final_nees"])
    assert shown["collapsed"] == f"{100 * random['collapse_share']:.2f} %"
    assert "4 paired episodes" in text
    assert as_csv(summary).count("\n") == 4


def test_markdown_has_both_ratios_to_every_baseline_with_their_intervals(two_records):
    summary = summarize("passive/TwoStation-v0", 0, two_records)
    _, (head, *rows) = tables(as_markdown(summary))
    assert head == ["policy", "error", "/ paper", "/ rule"]
    found = {(row[0], row[1]): row[2:] for row in rows}
    assert list(found) == [(name, error) for name in summary["policies"] for error in ("final", "time average")]
    for (name, error), cells in found.items():
        metric = {"final": "final_range_error_m", "time average": "mean_range_error_m"}[error]
        for base, cell in zip(("paper", "rule"), cells, strict=True):
            if base == name:
                assert cell == "1"
                continue
            ratio = summary["ratios"][base][name][metric]
            assert cell == "{:.3f} [{:.3f}, {:.3f}]".format(ratio["ratio"], *ratio["ci95"])


def test_markdown_shows_zones_only_where_somebody_enters_them():
    clear, inside = ({"a": record([[2.0, 1.0]] * 2, lost)} for lost in ([0.0, 0.0], [0.2, 0.4]))
    heads = [tables(as_markdown(summarize("e", 0, records)))[0] for records in (clear, inside)]
    assert "in rings" not in heads[0][0]
    assert "in discs" not in heads[1][0]
    assert dict(zip(*heads[1], strict=True))["in rings"] == "7.50 %"


def test_an_earlier_evaluation_is_replaced_whole(tmp_path, two_records):
    summary = summarize("passive/TwoStation-v0", 0, two_records)
    write_evaluation(tmp_path, summary, two_records, SHORT)
    first = {path.name: path.read_bytes() for path in tmp_path.iterdir()}
    write_evaluation(tmp_path, summary, two_records, SHORT)
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == first


# ------------------------------------------------------------------------------------------------ commands


def evaluate(*arguments) -> int:
    return cli.main(["evaluate", *map(str, arguments)])


def test_evaluate_command_writes_and_prints_the_comparison(tmp_path, capsys):
    out = tmp_path / "out"
    assert evaluate("--policies", "paper", "rule", "straight", "--episodes", 3, "--seed", 5, "--out", out) == 0
    assert {path.name for path in out.iterdir()} == FILES | {"report.html"}
    summary = json.loads((out / "evaluation.json").read_text())
    assert list(summary["policies"]) == ["paper", "rule", "straight"]
    assert (summary["episodes"], summary["seed"], summary["environment"]) == (3, 5, "passive/TwoStation-v0")
    printed = capsys.readouterr().out
    assert all(name in printed for name in ("| paper |", "| rule |", "| straight |"))
    direct = fly(TwoStation(), make_policy("rule", TwoStation()), 3, 5)
    assert summary["policies"]["rule"]["final_range_error_m"]["mean"] == pytest.approx(direct.final.mean(), rel=1e-12)


def test_evaluate_command_flies_all_policies_but_the_oracle_by_default(tmp_path):
    assert evaluate("--episodes", 2, "--out", tmp_path) == 0
    summary = json.loads((tmp_path / "evaluation.json").read_text())
    untrained = [name for name in policy_names(TwoStation()) if name != "oracle"]
    assert list(summary["policies"]) == [*untrained, "pretrained"]
    assert {"paper", "rule", "rule_tuned", "greedy", "planner"} == set(summary["ratios"])
    assert evaluate("--episodes", 2, "--out", tmp_path, "--fields", "targets=2") == 0  # which looks otherwise
    assert list(json.loads((tmp_path / "evaluation.json").read_text())["policies"]) == untrained


def test_evaluate_command_crosses_policies_with_trackers(tmp_path):
    """The second use of the package: trackers under the same maneuvers."""
    status = evaluate(
        "passive/TwoStation-v0", "--policies", "rule", "paper", "--trackers", "rp_ekf", "fused_ekf", "--episodes", 3,
        "--out", tmp_path,
    )  # fmt: skip
    assert status == 0
    found = {}
    for tracker in ("rp_ekf", "fused_ekf"):
        assert {path.name for path in (tmp_path / tracker).iterdir()} == FILES
        summary = json.loads((tmp_path / tracker / "evaluation.json").read_text())
        assert summary["tracker"] == tracker
        scenario = TwoStation(tracker=tracker)
        direct = fly(scenario, make_policy("paper", scenario), 3, summary["seed"])
        found[tracker] = summary["policies"]["paper"]["final_range_error_m"]["mean"]
        assert found[tracker] == pytest.approx(direct.final.mean(), rel=1e-12)
    assert found["rp_ekf"] != found["fused_ekf"]
    together = json.loads((tmp_path / "evaluation.json").read_text())["trackers"]
    assert {name: part["policies"]["paper"]["final_range_error_m"]["mean"] for name, part in together.items()} == found
    assert f"| paper | {found['rp_ekf']:.0f} (" in (tmp_path / "evaluation.md").read_text()


@pytest.mark.parametrize("command", ["evaluate", "reproduce"])
def test_a_file_in_the_place_of_the_output_folder_is_refused_before_anything_is_flown(command, tmp_path, capsys):
    (tmp_path / "taken").write_text("mine")
    assert cli.main([command, "--out", str(tmp_path / "taken")]) == 2
    assert f"--out {tmp_path / 'taken'}: is a file, must name a folder" in capsys.readouterr().err
    assert (tmp_path / "taken").read_text() == "mine"


def test_evaluate_command_flies_held_out_traffic(tmp_path):
    assert evaluate("--policies", "rule", "--flights", "held-out", "--episodes", 2, "--out", tmp_path) == 0
    summary = json.loads((tmp_path / "evaluation.json").read_text())
    assert (summary["course"], summary["flights"]) == ("flights", "held-out")
    scenario = TwoStation(course="flights", flight_split="test")
    direct = fly(scenario, make_policy("rule", scenario), 2, summary["seed"])
    assert summary["policies"]["rule"]["final_range_error_m"]["mean"] == pytest.approx(direct.final.mean(), rel=1e-12)


def test_evaluate_command_changes_scenario_fields(tmp_path):
    changes = ("--fields", "steps=7", "tracker=fused_ekf", "reward_maneuver=0.5", "actions=discrete")
    assert evaluate("--policies", "rule", *changes, "--episodes", 2, "--out", tmp_path) == 0
    summary = json.loads((tmp_path / "evaluation.json").read_text())
    fields = {"steps": 7, "tracker": "fused_ekf", "reward_maneuver": 0.5, "actions": "discrete"}
    assert summary["fields"] == fields
    scenario = TwoStation(**fields)
    direct = fly(scenario, make_policy("rule", scenario), 2, summary["seed"])
    assert summary["policies"]["rule"]["final_range_error_m"]["mean"] == pytest.approx(direct.final.mean(), rel=1e-12)


def test_fields_are_literals_or_words():
    texts = [
        "steps=7",
        "bearing_std_deg=1e-1",
        "maneuvering=true",
        "second_order=False",
        "flights=none",
        "course=flights",
    ]
    expected = {
        "steps": 7, "bearing_std_deg": 0.1, "maneuvering": True, "second_order": False, "flights": None,
        "course": "flights",
    }  # fmt: skip
    assert parse_fields(texts) == expected
    assert parse_fields(["flights=data/a=b.csv"]) == {"flights": "data/a=b.csv"}


def flights_file(path: Path, rows: int = 130) -> Path:
    """One aircraft flying east at 150 m/s over the equator, heard every 2 s."""
    lines = ["timestamp,icao24,callsign,latitude,longitude,altitude,groundspeed,track,vertical_rate"]
    for k in range(rows):
        longitude = 10.0 + 2.0 * k * 150.0 / 111319.49
        minute, second = divmod(2 * k, 60)
        lines.append(
            f"2024-05-01 10:{minute:02d}:{second:02d}+00:00,abc123,TEST1,0.0,{longitude:.7f},30000,291.577,90.0,0"
        )
    path.write_text("\n".join(lines) + "\n")
    return path


def test_evaluate_command_flies_a_file_of_ones_own(tmp_path):
    file = flights_file(tmp_path / "own.csv")
    assert evaluate("--policies", "rule", "--flights", file, "--episodes", 2, "--out", tmp_path / "out") == 0
    scenario = TwoStation(course="flights", flights=str(file), flight_split="all")
    tape = PassiveVectorEnv(scenario, num_envs=2)
    tape.reset(seed=0)
    speed = np.hypot(tape.world.tape.targets[..., 2], tape.world.tape.targets[..., 3])
    np.testing.assert_allclose(speed, 150.0, rtol=0.01)


def assert_refused(capsys, out: Path, status: int, *words):
    """Exit status 2, one line on standard error that holds the words, and nothing written."""
    printed = capsys.readouterr()
    assert status == 2
    assert printed.err.startswith("passive-env: ")
    assert len(printed.err.strip().splitlines()) == 1
    assert printed.out == ""
    for word in words:
        assert str(word) in printed.err
    assert not out.exists()


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["passive/TwoStations-v0"], ["'passive/TwoStations-v0'", "did you mean", "passive/TwoStation-v0"]),
        (["CartPole-v1"], ["unknown environment 'CartPole-v1'", "passive/TwoStation-v0"]),
        (["--policies", "rule", "rules"], ["unknown policy 'rules'", "rule_perpendicular", "run folder"]),
        (["--policies"], ["--policies"]),
        (["--trackers", "rp_ekf", "kalman"], ["'kalman'", "'rp_ekf'", "'fused_ekf'", "'rp_ekf_adaptive'"]),
        (["--flights", "no/such/file.csv"], ["no/such/file.csv"]),
        (["--flights", "."], ["directory"]),
        (["--fields", "steps"], ["'steps'", "NAME=VALUE"]),
        (["--fields", "steps=9", "steps=8"], ["'steps=8'", "given twice"]),
        (["--fields", "stepps=9"], ["'stepps'", "did you mean 'steps'"]),
        (["--fields", "bearing_std_deg=wide"], ["bearing_std_deg = 'wide'", "must be a number"]),
        (["--episodes", "0"], ["--episodes 0"]),
        (["--episodes", "-3"], ["--episodes -3"]),
        (["--seed", "-1"], ["--seed -1"]),
    ],
    ids=lambda value: " ".join(value),
)
def test_bad_input_to_evaluate_is_refused_in_one_line(tmp_path, capsys, arguments, words):
    out = tmp_path / "out"
    assert_refused(capsys, out, evaluate(*arguments, "--out", out), *words)


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ("", []),
        ("a,b,c\n1,2,3\n", ["timestamp"]),
        ("not a table at all", []),
        (None, ["line 5", "latitude"]),
    ],
    ids=["empty", "columns", "text", "value"],
)
def test_malformed_flights_are_refused_in_one_line_that_names_the_file(tmp_path, capsys, content, words):
    file = flights_file(tmp_path / "flights.csv")
    if content is None:
        lines = file.read_text().splitlines()
        lines[4] = lines[4].replace(",0.0,", ",north,", 1)
        content = "\n".join(lines)
    file.write_text(content)
    out = tmp_path / "out"
    assert_refused(capsys, out, evaluate("--flights", file, "--episodes", 2, "--out", out), file, *words)


def test_flights_that_are_too_short_are_refused_with_their_length(tmp_path, capsys):
    """An episode lasts 90 s; the file's only flight 80."""
    file = flights_file(tmp_path / "short.csv", rows=41)
    out = tmp_path / "out"
    assert_refused(capsys, out, evaluate("--flights", file, "--out", out), file, "80 s", "90 s")


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--env", "passive/Nowhere-v0"], ["passive/Nowhere-v0"]),
        (["--algo", "dreams"], ["--algo dreams", "ppo", "sac"]),
        (["--timesteps", "0"], ["--timesteps 0"]),
        (["--envs", "-8"], ["--envs -8"]),
        (["--episodes", "0"], ["--episodes 0"]),
        (["--seed", "-1"], ["--seed -1"]),
        (["--device", "abacus"], ["--device abacus", "cpu"]),
        (["--flights", "no/such/file.csv"], ["no/such/file.csv"]),
        (["--fields", "steps"], ["'steps'", "NAME=VALUE"]),
        (["--fields", "steps=9", "steps=8"], ["'steps=8'", "given twice"]),
        (["--fields", "stepps=9"], ["'stepps'", "did you mean 'steps'"]),
        (["--fields", "bearing_std_deg=wide"], ["bearing_std_deg = 'wide'", "must be a number"]),
        (["--resume"], ["config.json"]),
    ],
    ids=lambda value: " ".join(value),
)
def test_bad_input_to_train_is_refused_before_any_training(tmp_path, capsys, monkeypatch, arguments, words):
    from stable_baselines3 import PPO

    def too_late(*_, **__):
        raise AssertionError("the training has begun")

    monkeypatch.setattr(PPO, "learn", too_late)
    out = tmp_path / "out"
    assert_refused(capsys, out, cli.main(["train", *arguments, "--out", str(out)]), *words)


FLAGS = {
    "train": ("env", "algo", "timesteps", "seed", "envs", "device", "out", "resume", "episodes", "flights"),
    "evaluate": ("policies", "trackers", "episodes", "seed", "flights", "out"),
    "leaderboard": (
        "envs",
        "policies",
        "runs",
        "episodes",
        "seed",
        "flights",
        "trackers",
        "generalisation",
        "fields",
        "out",
    ),
    "reproduce": ("runs", "seeds", "out"),
    "benchmark": ("out", "quick"),
    "compile": ("processes",),
    "list": (),
}


@pytest.mark.parametrize("command", FLAGS)
def test_help_of_every_command_names_its_flags(capsys, command):
    with pytest.raises(SystemExit) as ended:
        cli.main([command, "--help"])
    assert ended.value.code == 0
    printed = capsys.readouterr().out
    assert all(f"--{flag}" in printed for flag in FLAGS[command])


def test_help_names_every_command(capsys):
    with pytest.raises(SystemExit) as ended:
        cli.main(["--help"])
    assert ended.value.code == 0
    printed = capsys.readouterr().out
    assert all(command in printed for command in FLAGS)


@pytest.mark.parametrize(
    "arguments", [["fly"], ["evaluate", "--episode", "3"], ["evaluate", "--episodes", "many"], []], ids=str
)
def test_misspelt_commands_and_flags_exit_with_2(capsys, arguments):
    with pytest.raises(SystemExit) as ended:
        cli.main(arguments)
    assert ended.value.code == 2
    assert capsys.readouterr().err


def test_the_commands_module_runs_as_a_script(monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["passive-env", "list"])
    monkeypatch.delitem(sys.modules, "agents.cli")
    with pytest.raises(SystemExit) as ended:
        runpy.run_module("agents.cli", run_name="__main__")
    assert ended.value.code == 0
    assert "passive/TwoStation-v0" in capsys.readouterr().out


def test_list_names_environments_policies_trackers_and_algorithms(capsys):
    assert cli.main(["list"]) == 0
    printed = capsys.readouterr().out
    for name in ("passive/TwoStation-v0", *policy_names(TwoStation()), "rp_ekf", "fused_ekf", "ppo"):
        assert name in printed


def test_the_installed_command_runs():
    script = Path(sys.executable).with_name("passive-env")
    if not script.exists():
        pytest.skip("the package is not installed in this environment")
    done = subprocess.run(
        [script, "evaluate", "passive/Nope-v0"], capture_output=True, text=True, timeout=120, check=False
    )
    assert done.returncode == 2
    assert "passive/Nope-v0" in done.stderr
    assert "Traceback" not in done.stderr
