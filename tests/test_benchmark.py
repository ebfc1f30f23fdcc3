"""The benchmark's form and fairness: schema, goals, what is compared. No test asserts a time."""

import json
import math
import platform
import re
from pathlib import Path

import numpy as np
import pytest
import torch

from agents import benchmark
from agents.benchmark import MEASUREMENTS, clutter, filters, maneuvers, run_benchmark
from agents.benchmark.results import Result, Section, as_json, as_markdown, machine, meets
from agents.benchmark.timing import QUICK, Effort, take_turns
from agents.cli import main
from agents.planner import Planner
from trackers import AnglePdafSequential, Gaussian, ImmMie, measurement
from trackers.association import PRUNED
from trackers.compiled import Blocks
from trackers.imm import ImmState, imm_predict, imm_update
from trackers.motion import process_noise, transition
from trackers.position_fix import fix_bearings

TINY = Effort(rounds=1, batches=1, single_updates=2, num_envs=8, episodes=1, rollouts=1, ppo_envs=4)
CHEAP = ("bearing updates", "Table 1 Monte Carlo", "resets", "single environment", "memory")
README = Path(__file__).resolve().parent.parent / "benchmarks" / "README.md"


@pytest.fixture(scope="module")
def sections():
    """Every measurement, as short as can be."""
    return {title: measure(TINY) for title, measure in MEASUREMENTS.items()}


def without_rivals(monkeypatch):
    def refuse(name):
        raise ImportError(f"No module named {name!r}")

    monkeypatch.setattr(filters, "import_module", refuse)


# -------------------------------------------------------------------------------------------------- goals and schema


@pytest.mark.parametrize(
    ("value", "goal", "met"),
    [
        (10.0, ">= 10", True),
        (9.999, ">= 10", False),
        (60.0, "<= 60", True),
        (60.1, "<= 60", False),
        (0.2, "< 0.2", False),
        (0.1999, "< 0.2", True),
        (1.7, "> 1.7", False),
        (math.nan, ">= 0", False),
        (math.nan, "<= 0", False),
        (5.0, None, None),
    ],
)
def test_goal_is_met_or_missed(value, goal, met):
    assert meets(value, goal) is met


@pytest.mark.parametrize("goal", ["", "10", ">=10", "at least 10", ">= ten"])
def test_malformed_goal_is_refused(goal):
    with pytest.raises(ValueError, match=r"goal|float"):
        meets(1.0, goal)


def test_every_goal_in_use_can_be_read(sections):
    results = [result for section in sections.values() for result in section.results]
    goals = {result.name: result.goal for result in results if result.goal}
    assert all(isinstance(meets(result.value, result.goal), bool) for result in results if result.goal)
    assert goals["bearing_updates_one_core"] == ">= 10"
    assert goals["vector_env_random_actions"] == ">= 250000"
    assert goals["ownship_random_actions"] == ">= 1000000"
    assert goals["angles_clean_random_actions"] == ">= 400000"
    assert goals["angles_clutter_8_random_actions"] == ">= 40000"
    assert goals["greedy_decision"] == "< 30"
    assert goals["planner_decision"] == "< 200"
    assert goals["single_env_step"] == "<= 60"
    assert goals["table_1_monte_carlo_50_runs"] == "< 0.2"
    assert goals["ppo_steps"] == ">= 20000"
    assert goals["ppo_environment_share"] == "<= 20"
    assert goals.get("stone_soup_pda_scan_over_ours", ">= 300") == ">= 300"
    assert goals.get("filterpy_imm_step_over_ours", ">= 50") == ">= 50"


def test_figures_are_positive_numbers_with_unique_names(sections):
    results = [result for section in sections.values() for result in section.results]
    assert len({result.name for result in results}) == len(results) >= 14
    assert all(math.isfinite(result.value) and result.value > 0.0 for result in results)


def test_every_figure_is_explained(sections):
    explained = re.findall(r"^\| `([^`]+)`", README.read_text(encoding="utf-8"), re.MULTILINE)
    for section in sections.values():
        for result in section.results:
            assert any(result.name == name or result.name.endswith(name.lstrip("…")) for name in explained), result.name


def test_json_has_the_stated_form():
    results = [Result("fast", 12.5, "million/s", ">= 10"), Result("size", 3.0, "kB")]
    assert as_json(results, {"cores": 2}) == {
        "results": {
            "fast": {"value": 12.5, "unit": "million/s", "goal": ">= 10"},
            "size": {"value": 3.0, "unit": "kB", "goal": None},
        },
        "machine": {"cores": 2},
    }


def test_markdown_says_met_missed_and_notes():
    results = [Result("fast", 12.5, "million/s", ">= 10"), Result("slow", 3, "×", ">= 5"), Result("size", 2048.0, "kB")]
    lines = as_markdown(results, {"cores": 2}, ["Something is missing."]).splitlines()
    cells = [[cell.strip() for cell in line.split("|")] for line in lines if line.startswith("|")]
    rows = {row[1]: row[2:6] for row in cells}
    assert rows["name"] == ["value", "unit", "goal", "met"]
    assert rows["fast"] == ["12.5", "million/s", ">= 10", "yes"]
    assert rows["slow"] == ["3", "×", ">= 5", "no"]
    assert rows["size"] == ["2048", "kB", "", ""]
    assert "- Something is missing." in lines


def test_machine_names_versions_but_not_the_computer():
    about = machine(quick=True)
    assert {"processor", "cores", "threads", "platform", "python", "numpy", "numba", "torch", "quick"} <= set(about)
    assert platform.node() not in json.dumps(about).split('"')


# ------------------------------------------------------------------------------------------------------------ running


def test_quick_run_prints_the_table_and_writes_both_files(tmp_path, capsys):
    out = tmp_path / "deep" / "benchmark"
    report = run_benchmark(out, quick=True, measurements={title: MEASUREMENTS[title] for title in CHEAP})
    assert json.loads((out / "benchmark.json").read_text(encoding="utf-8")) == report
    assert set(report) == {"results", "machine"}
    assert all(set(figure) == {"value", "unit", "goal"} for figure in report["results"].values())
    text = (out / "benchmark.md").read_text(encoding="utf-8")
    assert text.strip() in capsys.readouterr().out
    assert all(name in text for name in report["results"])
    assert sorted(path.name for path in out.iterdir()) == ["benchmark.json", "benchmark.md"]


def test_missed_goal_is_reported_not_raised(tmp_path, capsys):
    report = run_benchmark(tmp_path, True, {"slow": lambda effort: Section([Result("slow", 1.0, "steps/s", ">= 2")])})
    assert report["results"]["slow"] == {"value": 1.0, "unit": "steps/s", "goal": ">= 2"}
    assert re.search(r"\| slow .*\| no ", capsys.readouterr().out)


def test_value_that_is_no_number_is_null_and_a_miss(tmp_path, capsys):
    run_benchmark(tmp_path, True, {"bad": lambda effort: Section([Result("bad", math.nan, "s", "< 2")])})
    written = json.loads((tmp_path / "benchmark.json").read_text(encoding="utf-8"))
    assert written["results"]["bad"] == {"value": None, "unit": "s", "goal": "< 2"}
    assert re.search(r"\| bad .*\| no ", capsys.readouterr().out)


def test_command_line_runs_it(tmp_path, monkeypatch):
    calls = []
    monkeypatch.setattr(benchmark, "run_benchmark", lambda out, quick: calls.append((out, quick)))
    assert main(["benchmark", "--quick", "--out", str(tmp_path)]) == 0
    assert calls == [(tmp_path, True)]


def test_out_that_is_a_file_is_refused_before_measuring(tmp_path, capsys):
    (tmp_path / "taken").write_text("", encoding="utf-8")
    assert main(["benchmark", "--quick", "--out", str(tmp_path / "taken")]) == 2
    assert "must name a folder" in capsys.readouterr().err


def test_ppo_leaves_no_files_and_torch_as_it_was(tmp_path, tmp_path_factory, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("TORCHINDUCTOR_CACHE_DIR", str(tmp_path_factory.mktemp("inductor")))  # PyTorch's own, if any
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    monkeypatch.setattr("tempfile.tempdir", None)
    before = torch.get_num_threads()
    results = {result.name: result.value for result in MEASUREMENTS["PPO"](TINY).results}
    assert results["ppo_environment_share"] > 0.0
    assert torch.get_num_threads() == before
    assert list(tmp_path.iterdir()) == []


def test_tasks_take_turns_after_one_run_each():
    calls = []
    times = take_turns({name: lambda name=name: lambda: calls.append(name) for name in "AB"}, rounds=3)
    assert calls == list("AB" * 4)
    assert {name: taken.shape for name, taken in times.items()} == {"A": (3,), "B": (3,)}


# ------------------------------------------------------------------------------------------------------ what is timed


def test_every_update_of_the_batch_is_made():
    problem = filters.make_problem(64)
    prior, posterior = problem.bank, filters.update_banks(problem, Blocks(64, block=64))[0].posterior
    assert prior.mean.shape == (64, filters.HYPOTHESES, 4)
    assert (posterior.log_weights > PRUNED).all()
    assert (np.linalg.det(posterior.cov) < 0.999 * np.linalg.det(prior.cov)).all()


def test_two_threads_do_the_same_work_as_one():
    problem = filters.make_problem(300)
    one, two = (filters.update_banks(problem, Blocks(300, block=100, threads=threads)) for threads in (1, 2))
    assert len(one) == 3
    assert len(two) == 4
    np.testing.assert_array_equal(*(np.concatenate([part.posterior.mean for part in parts]) for parts in (one, two)))


@pytest.mark.parametrize("rival", filters.RIVALS, ids=lambda rival: rival.name)
def test_other_libraries_compute_the_same_posterior(rival):
    """The compared updates answer one question: same priors, same bearings, same posterior means."""
    pytest.importorskip({"Stone Soup": "stonesoup", "filterpy": "filterpy"}[rival.library])
    problem = filters.make_problem(20)
    prior = Gaussian(problem.bank.mean[:, 0], problem.bank.cov[:, 0])
    ours = measurement.update(prior, problem.bearings[:, 0], problem.stations[:, 0], filters.BEARING_STD)
    theirs = np.array([np.asarray(mean, dtype=float) for mean in rival.prepare(problem, 20)()])
    # Stone Soup differentiates numerically, here to half a percent.
    tolerance = 2e-2 if rival.library == "Stone Soup" else 1e-9
    correction = np.abs(ours.posterior.mean - prior.mean).max(axis=0)
    assert (correction > 1.0).all()
    np.testing.assert_array_less(np.abs(theirs - ours.posterior.mean).max(axis=0), tolerance * correction)


def test_stone_soup_weighs_the_same_scans():
    """The compared scans answer one question: our sequential filter and Stone Soup's PDA give the same means."""
    pytest.importorskip("stonesoup")
    scene = clutter.make_scene(clutter.COMPARED, 6)
    tracker = AnglePdafSequential(gate=clutter.GAMMA, detection_probability=clutter.DETECTION)
    update = tracker.update(scene.state, scene.scan)
    np.testing.assert_array_equal(update.validated[..., 0], clutter.COMPARED)
    theirs = np.array(clutter.stone_soup_scans(scene, 6)())
    correction = np.abs(update.posterior.mean - scene.state.mean)[:, 0, :3].max(axis=0)
    assert (correction > 10.0).all()
    # Stone Soup differentiates numerically.
    off = np.abs(theirs - update.posterior.mean[:, 0])[:, :3].max(axis=0)
    np.testing.assert_array_less(off, 0.02 * correction)


def test_scenes_hold_what_they_promise():
    """Every return lies in its sensor's gate, in all batches of the growth measurement."""
    for returns in clutter.RETURNS:
        scene = clutter.make_scene(returns, 20)
        update = AnglePdafSequential(gate=clutter.GAMMA).update(scene.state, scene.scan)
        np.testing.assert_array_equal(update.validated[..., 0], returns)


def test_filterpys_imm_is_an_imm_like_ours():
    """The step it is timed at gives the means of our general IMM with the same two models."""
    pytest.importorskip("filterpy")
    chase = maneuvers.make_chase(5)
    first, last = (fix_bearings(*chase.scans[k]) for k in (0, -1))
    mean, cov = np.zeros((5, 2, 4)), np.zeros((5, 2, 4, 4))
    mean[..., :2] = last.position[:, None]
    cov[..., :2, :2] = first.cov[:, None]
    cov[..., 2:, 2:] = 200.0**2 * np.eye(2)
    F = np.broadcast_to(transition(maneuvers.STEP_S), (2, 4, 4))
    Q = np.stack([process_noise(maneuvers.STEP_S, noise) for noise in maneuvers.NOISE_M_S2])
    prior = imm_predict(ImmState(mean, cov, np.full((5, 2), 0.5)), maneuvers.CHAIN, F, Q)
    ours, *_ = imm_update(prior, last.position, last.cov)
    theirs = np.array(maneuvers.filterpy_imm_steps(chase, 5)())
    np.testing.assert_allclose(theirs, (ours.probability[..., None] * ours.mean).sum(-2), rtol=1e-9, atol=1e-6)


def test_half_of_the_timed_targets_are_maneuvering():
    chase = maneuvers.make_chase(200)
    tracker = ImmMie()
    state = maneuvers.followed(tracker, chase)
    detected = tracker.update(tracker.predict(state, maneuvers.STEP_S), chase.scans[-1]).detected.any(-1)
    assert detected[::2].mean() > 0.8
    assert detected[1::2].mean() < 0.2


def test_missing_filterpy_leaves_out_its_imm(monkeypatch):
    def refuse(name):
        raise ImportError(f"No module named {name!r}")

    monkeypatch.setattr(maneuvers, "import_module", refuse)
    section = maneuvers.measure_maneuvers(TINY)
    assert [result.name for result in section.results] == ["imm_mie_step", "imm3_step"]
    assert "pip install passive-env[bench]" in section.notes[0]


def test_missing_stone_soup_leaves_out_its_pda(monkeypatch):
    def refuse(name):
        raise ImportError(f"No module named {name!r}")

    monkeypatch.setattr(clutter, "import_module", refuse)
    section = clutter.measure_clutter(TINY)
    assert not [result for result in section.results if result.name.startswith("stone_soup")]
    assert len(section.notes) == 1
    assert "pip install passive-env[bench]" in section.notes[0]


def test_missing_libraries_are_noted_with_the_remedy(monkeypatch):
    without_rivals(monkeypatch)
    section = filters.measure_rivals(QUICK)
    assert section.results == []
    assert [re.search(r"^(.*) is not installed", note).group(1) for note in section.notes] == ["Stone Soup", "filterpy"]
    assert all("pip install passive-env[bench]" in note for note in section.notes)


def test_planner_plans_anew_in_every_timed_decision(monkeypatch):
    """A decision that only steers along an old plan would flatter the figure."""
    planned, replan = [], Planner._replan

    def watched(self, belief, due, begun):
        planned.append(len(due))
        replan(self, belief, due, begun)

    monkeypatch.setattr(Planner, "_replan", watched)
    MEASUREMENTS["decisions"](TINY)
    assert planned == [TINY.num_envs] * (TINY.rounds + 1)


def test_memory_is_the_sum_of_tape_and_state(sections):
    sizes = {result.name: result.value for result in sections["memory"].results}
    assert sizes["memory_per_environment"] == pytest.approx(sizes["memory_tape"] + sizes["memory_state"])
    noise, order, targets, stations, steps = 2 * 3 * 8, 2 * 3 * 8, 3 * 4 * 8, 2 * 4 * 8, 46
    detected, false_bearings, false_count = 2 * 3, 2 * 8, 2 * 8
    tape = stations + steps * (noise + order + targets + detected + false_bearings + false_count)
    assert sizes["memory_tape"] == pytest.approx(tape / 1e3)
