"""Sheng et al. (2009) repeated: section 7's tables, the signs of the claims, section 8's geometry, files, command."""

import json

import numpy as np
import pytest

from agents import cli
from agents.reproduction import print_imm_mie, reproduce_imm_mie
from agents.reproduction.imm_mie import TRACKED, run_trials
from agents.reproduction.imm_mie.claims import (
    BIAS_M_S2,
    CLASSICAL_TURN_M,
    CV_S,
    FUSED,
    GEOMETRY,
    LONG_SHARE,
    ONSET_PEAK_M,
    RIVAL,
    RMSE_M,
    TURN_PEAK_M,
    TURN_S,
    all_claims,
    detection_delay,
    geometry_row,
    long_share,
    mean_error,
    peak,
)
from agents.reproduction.imm_mie.monte_carlo import (
    MEASUREMENT_STD_M,
    PHASES,
    STEP_S,
    Layout,
    measure_fixes,
    measure_positions,
    paper_path,
    scans_in,
    two_point_start,
)
from agents.reproduction.report import VERDICTS
from trackers.consistency import mean_band
from trackers.measurement import bearing_jacobian

PER_SEED, SEEDS = 50, (0, 1, 2, 3)
SHORT, LONG = "B = 2 km", "B = 40 km"


@pytest.fixture(scope="module")
def trials():
    """The specification's 200 runs."""
    return run_trials(PER_SEED, SEEDS)


@pytest.fixture(scope="module")
def result(tmp_path_factory):
    out = tmp_path_factory.mktemp("imm_mie")
    return reproduce_imm_mie(10, (5, 6), out), out


# ------------------------------------------------------------------------------------------------ the scenarios


def test_paths_are_the_papers():
    """Scenario 1: 20 m/s² for 25 s, then fading to 0; scenario 2: radius 3 km, three radians, speed kept."""
    path = paper_path(1)
    np.testing.assert_allclose(path.state[15], [1500.0, 1500.0, 100.0, 100.0])
    np.testing.assert_allclose(path.state[40, 2:], [600.0, 100.0])
    np.testing.assert_allclose(path.acceleration[[14, 15, 39, 60, 80], 0], [0.0, 20.0, 20.0, 10.0, 0.0], atol=1e-12)
    path = paper_path(2)
    np.testing.assert_allclose(np.linalg.norm(path.state[:, 2:], axis=-1), 300.0)
    centre = np.array([6e3, 3e3])
    np.testing.assert_allclose(np.linalg.norm(path.state[20:51, :2] - centre, axis=-1), 3e3)
    np.testing.assert_allclose(np.linalg.norm(path.acceleration[20:50], axis=-1), 30.0)
    np.testing.assert_array_equal(path.acceleration[[19, 50]], 0.0)
    chord = path.state[21, :2] - path.state[20, :2]
    np.testing.assert_allclose(np.linalg.norm(chord), 2 * 3e3 * np.sin(0.05))
    np.testing.assert_allclose(np.diff(path.state[:, 2:], axis=0)[30], path.acceleration[30:32].mean(0), rtol=2e-3)


def test_measurements_and_start_are_honest():
    """200 runs: measurement errors, and the two-point start's NEES, which leaves out the first step's perturbation."""
    measured = measure_positions(2, 500, np.random.default_rng(1))
    error = measured.position - measured.truth[..., :2]
    low, high = mean_band(2, error[..., 0].size)
    assert low < np.square(error / MEASUREMENT_STD_M).sum(-1).mean() < high
    start = two_point_start(measured)
    off = (start.mean - measured.truth[:, 1])[..., None]
    low, high = mean_band(4, 500)
    assert low < (off * np.linalg.solve(start.cov, off)).sum((-1, -2)).mean() < high


def test_fixes_have_the_error_their_geometry_promises():
    """Second route to the fixes' RMSE: the Fisher information at the truth, without any drawing, within 4 %."""
    for layout in (Layout(5e3), Layout(40e3), Layout(2e3, opening_m_s=600.0)):
        path, t = paper_path(2), STEP_S * np.arange(71)
        J = bearing_jacobian(path.state[:, None], layout.stations(t))
        bound = np.linalg.inv(np.einsum("ksi,ksj->kij", J, J) / 1e-6)
        expected = np.sqrt(np.trace(bound, axis1=-2, axis2=-1).mean())
        found = measure_fixes(layout, 300, np.random.default_rng(2)).raw_rmse()
        assert found == pytest.approx(expected, rel=0.04)


# ------------------------------------------------------------------------------------------------ section 7


@pytest.mark.parametrize("scenario", [1, 2])
@pytest.mark.parametrize("place", [0, 1])
def test_position_errors_of_both_tables(trials, scenario, place):
    """Every phase of both trackers within 6 % of the specification, 200 runs."""
    record = trials.positions[scenario][(FUSED, RIVAL)[place]]
    ours = [record.rmse(span) for span in PHASES[scenario].values()]
    np.testing.assert_allclose(ours, RMSE_M[scenario][place], rtol=0.06)


def test_biases_and_weights_of_both_tables(trials):
    for name, paper in zip((FUSED, RIVAL), BIAS_M_S2, strict=True):
        ours = [mean_error(trials.positions[1][name], span) for span in PHASES[1].values()]
        np.testing.assert_allclose(ours, paper, atol=0.4)
    for scenario, shares in LONG_SHARE.items():
        ours = [long_share(trials.positions[scenario][FUSED], span) for span in PHASES[scenario].values()]
        np.testing.assert_allclose(ours, shares, atol=0.05)


def test_signs_of_the_claims(trials):
    """Acceptance test 5: constant velocity, onset, turn and peak."""
    first, second = trials.positions[1], trials.positions[2]
    for records, spans in ((first, [(8, 15)]), (second, [CV_S, (20, 26), TURN_S, (56, 70)])):
        for span in spans:
            assert records[FUSED].rmse(span) < records[RIVAL].rmse(span)
    assert first[FUSED].rmse((15, 22)) < first[RIVAL].rmse((15, 22))
    assert peak(second[FUSED], 2) < peak(second[RIVAL], 2)
    np.testing.assert_allclose([peak(second[name], 2) for name in (FUSED, RIVAL)], TURN_PEAK_M, rtol=0.08)
    np.testing.assert_allclose([peak(first[name], 1) for name in (FUSED, RIVAL)], ONSET_PEAK_M, rtol=0.08)


def test_what_the_paper_claims_without_support(trials):
    """Scenario 2's acceleration is worse at the exit, and scenario 1's peak is not lower."""
    second = trials.positions[2]
    assert second[FUSED].acceleration_rmse((50, 56)) > 1.2 * second[RIVAL].acceleration_rmse((50, 56))
    assert second[FUSED].rmse((50, 56)) > second[RIVAL].rmse((50, 56))
    verdicts = {c["claim"].split(":")[0]: c["verdict"] for c in all_claims(trials, np.random.default_rng(0))}
    for words in ("clearly better in onset and turn", "a better acceleration curve in scenario 2"):
        assert verdicts[words] == "not reproduced"


@pytest.mark.parametrize("window", [6, 4])
def test_classical_estimation_is_much_worse_in_the_turn(trials, window):
    rmse = trials.positions[2][f"ie_{window}"].rmse(TURN_S)
    assert rmse == pytest.approx(CLASSICAL_TURN_M[f"ie_{window}"], rel=0.06)
    assert rmse > 1.5 * trials.positions[2][FUSED].rmse(TURN_S)


@pytest.mark.parametrize("mixing", ["sens", "output", "none"])
def test_repaired_mixing_changes_little(trials, mixing):
    """Specification: under 4 % in every phase for sens and none; output is compared in the maneuvers."""
    for scenario, spans in PHASES.items():
        for name, span in spans.items():
            if mixing == "output" and name.startswith("CV"):
                continue
            change = trials.positions[scenario][mixing].rmse(span) / trials.positions[scenario][FUSED].rmse(span)
            assert change == pytest.approx(1.0, abs=0.04)


# ------------------------------------------------------------------------------------------------ section 8


@pytest.mark.parametrize("name", GEOMETRY)
def test_geometry_table(trials, name):
    """Fix, turn and IMM3's turn within 10 % of the specification's 40 runs; CV, which forty runs fix badly, in the
    range that 40 of our runs span 99 % of the time, the one row of the document outside that 99.9 %."""
    measured, records = trials.geometry[name]
    paper, ours = GEOMETRY[name][1], geometry_row(measured, records)
    for place in (0, 2, 3):
        assert ours[place] == pytest.approx(paper[place], rel=0.10)
    squares = np.square(records[FUSED].position_error[:, scans_in(CV_S)]).sum(-1).mean(-1)
    rng = np.random.default_rng(3)
    draws = np.sqrt(squares[rng.integers(0, len(squares), (40_000, 40))].mean(1))
    outside = 0.001 if name == "ellipses, B = 10 km" else 0.01
    low, high = np.quantile(draws, [0.5 * outside, 1.0 - 0.5 * outside])
    assert low - 0.5 <= paper[1] <= high + 0.5


def test_error_rises_as_the_baseline_falls(trials):
    """Acceptance test 6: from 20 to 2 km, in constant velocity and in the turn, for both trackers."""
    rows = np.array([geometry_row(*trials.geometry[f"B = {b} km"]) for b in (20, 10, 5, 2)])
    assert (np.diff(rows, axis=0) > 0.0).all()


def test_geometry_changes_behaviour(trials):
    assert detection_delay(trials.geometry[SHORT][1][FUSED]) > detection_delay(trials.geometry[LONG][1][FUSED])
    told = trials.geometry["2 km, told R = 100 I"][1][FUSED]
    assert told.detected[:, scans_in(CV_S)].mean() == pytest.approx(0.9, abs=0.05)
    assert 0.40 < long_share(trials.geometry["B = 20 km"][1][FUSED], TURN_S) < 0.55


# ------------------------------------------------------------------------------------------------ report and command


def test_every_claim_has_a_verdict(result):
    claims = result[0]["claims"]
    assert len(claims) > 50
    assert all(c["verdict"] in VERDICTS for c in claims)
    assert len({c["claim"] for c in claims}) == len(claims)


def test_report_and_files(result):
    text = print_imm_mie(result[0])
    for words in (
        "## Scenario 1",
        "## Scenario 2",
        "## Passive stations",
        "## What the authors claim",
        "## Our own cross-checks",
        "opening at 600 m/s",
    ):
        assert words in text
    names = sorted(path.name for path in result[1].iterdir())
    assert names == ["figure_2_position_error.png", "figure_3_acceleration.png", "figure_4_position_error.png",
                     "figure_5_acceleration.png", "passive_stations.png", "reproduction.json",
                     "reproduction.md"]  # fmt: skip
    saved = json.loads((result[1] / "reproduction.json").read_text(), parse_constant=pytest.fail)
    assert set(saved["positions"]["2"]) == set(TRACKED)
    assert set(saved["geometry"]) == set(GEOMETRY)


def test_results_do_not_change_with_repetition(result):
    assert reproduce_imm_mie(10, (5, 6)) == result[0]


def test_one_run_is_enough_and_none_is_an_error():
    assert len(reproduce_imm_mie(1, (3,))["claims"]) > 50
    for runs, seeds, words in (
        (0, (1,), "at least one of each"),
        (5, (), "at least one"),
        (5, (-1,), "not be negative"),
    ):
        with pytest.raises(ValueError, match=words):
            reproduce_imm_mie(runs, seeds)


def test_command_prints_the_claims(capsys, tmp_path):
    assert cli.main(["reproduce", "imm-mie", "--runs", "3", "--seeds", "4", "--out", str(tmp_path / "r")]) == 0
    assert "the short window dominates scenario 2's turn" in capsys.readouterr().out
    assert (tmp_path / "r" / "reproduction.md").exists()
    (tmp_path / "taken").write_text("mine")
    assert cli.main(["reproduce", "imm-mie", "--out", str(tmp_path / "taken")]) == 2
    assert "is a file, must name a folder" in capsys.readouterr().err
