"""Wang, Wang and Yang (2004) repeated: the specification's tables, claims with Wilson intervals, files, command."""

import json
import math

import numpy as np
import pytest
from scipy.stats import norm

from agents import cli
from agents.reproduction import print_angle_fusion, reproduce_angle_fusion
from agents.reproduction.angle_fusion import TRIALS, run_trials
from agents.reproduction.angle_fusion.claims import (
    BOUND_M,
    BOUND_NO_NOISE_M,
    BOUND_ONE_PLATFORM_M,
    EKF_M,
    EKF_RUNS,
    FIXED_RUNS,
    FIXED_SHARES,
    LINEAR_M,
    ONE_PLATFORM_SHARE,
    ROWS,
    lost_share,
)
from agents.reproduction.angle_fusion.monte_carlo import (
    ANGLE_STD,
    NO_CLUTTER,
    PATHS,
    STEPS,
    Record,
    Trial,
    clean_gates,
    draw_seeds,
    follow,
    linear_range_error,
    range_bound,
    start_bound,
)
from agents.reproduction.report import VERDICTS
from agents.resampling import wilson_interval
from passive_env.catalogue.angle_fusion import AngleFusion
from trackers import AngleScan
from trackers.direction import direction, gate

RUNS = 500


@pytest.fixture(scope="module")
def records():
    """All trials, 4 × 125 runs."""
    return run_trials(125, (0, 1, 2, 3))


@pytest.fixture(scope="module")
def result(tmp_path_factory):
    out = tmp_path_factory.mktemp("angle_fusion")
    return reproduce_angle_fusion(30, (5, 6), out), out


# ------------------------------------------------------------------------------------------------ the scenario


def test_geometry_is_the_specifications():
    """Section 7: last ranges 10.8 and 7.0 km, the turn opens the baseline from 6 to 10.4 km."""
    np.testing.assert_allclose(PATHS.ranges[-1], 10.8e3, rtol=0.01)
    assert np.linalg.norm(PATHS.target[-1, :3] - PATHS.platforms[-1, 1]) == pytest.approx(7.0e3, rel=0.02)
    baseline = np.linalg.norm(PATHS.platforms[:, 0] - PATHS.platforms[:, 1], axis=-1)
    np.testing.assert_allclose(baseline[:21], 6e3)
    assert baseline[-1] == pytest.approx(10.4e3, rel=0.01)
    np.testing.assert_allclose(np.linalg.norm(np.diff(PATHS.platforms, axis=0), axis=-1), 300.0)
    np.testing.assert_allclose(np.diff(PATHS.target[:, :3], axis=0) / 2.0, PATHS.target[1:, 3:])


def test_environment_flies_the_same_courses():
    tape = AngleFusion(course="paper").draw_tape([np.random.default_rng(0)])
    np.testing.assert_allclose(tape.targets[0, :, 0], PATHS.target, atol=1e-9)
    np.testing.assert_allclose(tape.platforms[0, :, :3], PATHS.platforms[0], atol=1e-9)


# ------------------------------------------------------------------------------------------------ without chance


def test_bounds_agree_with_the_specification():
    """Within 3 %: both platforms with and without process noise, and platform 1 alone."""
    assert range_bound()[ROWS] == pytest.approx(BOUND_M, rel=0.03)
    assert range_bound().mean() == pytest.approx(497.0, rel=0.03)
    assert range_bound(0.0)[ROWS] == pytest.approx(BOUND_NO_NOISE_M, rel=0.03)
    alone = range_bound(available=np.array(ONE_PLATFORM_SHARE))
    assert alone[ROWS] == pytest.approx(BOUND_ONE_PLATFORM_M, rel=0.03)


def test_gains_on_a_target_without_process_noise_leave_the_specified_error():
    """Specification: 1299/893/724/433/191/65, mean 466, by covariance analysis; every entry within 1 %."""
    assert linear_range_error()[ROWS] == pytest.approx(LINEAR_M, rel=0.01)
    assert linear_range_error().mean() == pytest.approx(466.0, rel=0.01)


def test_first_covariance_is_the_triangulations():
    assert math.sqrt(start_bound()[0, 0]) == pytest.approx(1.87e3, rel=0.03)


# ------------------------------------------------------------------------------------------------ clean EKF


def test_ekf_without_clutter(records):
    """500 runs against the specification's 500 runs and, the second route, against the covariance analysis.

    Each RMSE of n runs has the relative standard error 1/√(2n); six entries, two-sided 99.9 % together.
    """
    rmse, z = records["ekf"].rmse(), norm.ppf(1.0 - 0.0005 / len(ROWS))
    both = z * math.sqrt(0.5 / EKF_RUNS + 0.5 / RUNS)
    np.testing.assert_array_less(np.abs(np.log(rmse[ROWS] / np.array(EKF_M))), both)
    assert rmse.mean() == pytest.approx(480.0, rel=0.06)
    late = slice(ROWS[2], None)  # before, the curvature of 2 km errors adds to the linear figure
    ours = z * math.sqrt(0.5 / RUNS) + 0.02
    np.testing.assert_array_less(np.abs(np.log(rmse[late] / linear_range_error()[late])), ours)


def dense_directions(x, places):
    """Azimuths and elevations [r, 2, 2] of positions [r, 3] from both platforms [2, 3], and their slopes [r, 4, 3]."""
    d = x[:, None] - places
    level, r = np.linalg.norm(d[..., :2], axis=-1), np.linalg.norm(d, axis=-1)
    azimuth = np.stack([-d[..., 1] / level**2, d[..., 0] / level**2, 0.0 * r], axis=-1)
    up = np.array([0.0, 0.0, 1.0]) - d * d[..., 2:] / r[..., None] ** 2  # ∂(dz/r)/∂x times r
    elevation = up / level[..., None]
    angles = np.stack([np.arctan2(d[..., 1], d[..., 0]), np.arcsin(d[..., 2] / r)], axis=-1)
    return angles, np.stack([azimuth, elevation], axis=-2).reshape(len(x), 4, 3)


def dense_range_errors(errors):
    """Range errors [r, k] m of an EKF written with dense matrices, nothing of it shared with the code under test."""
    runs, T = len(errors), 2.0
    F, G = np.eye(6) + np.eye(6, k=3) * T, np.vstack([np.eye(3) * T**2 / 2, np.eye(3) * T])
    x, P, found = np.tile([30e3, -3e3, 8e3], (runs, 1)), np.zeros((runs, 6, 6)), []
    for k in range(41):
        t, turned = 2.0 * k, 150.0 * max(2.0 * k - 40.0, 0.0)
        east, north = 150.0 * min(t, 40.0) + turned * math.cos(math.pi / 4), turned * math.sin(math.pi / 4)
        places = np.array([[east, north, 6e3], [150.0 * t, -6e3, 6e3]])
        target = np.array([30e3 - 150.0 * t, -3e3, 8e3])
        z = dense_directions(target[None], places)[0] + errors[:, k]
        if k == 0:
            for _ in range(30):
                h, H = dense_directions(x, places)
                x = x + np.einsum("rij,rj->ri", np.linalg.pinv(H), (z - h).reshape(runs, 4))
            H = dense_directions(x, places)[1]
            P[:, :3, :3] = math.radians(0.5) ** 2 * np.linalg.inv(H.swapaxes(1, 2) @ H)
            P[:, 3:, 3:] = np.diag([200.0**2, 200.0**2, 50.0**2])
            x = np.concatenate([x, np.zeros((runs, 3))], axis=1)
            continue
        x, P = x @ F.T, F @ P @ F.T + 900.0 * G @ G.T
        h, slopes = dense_directions(x[:, :3], places)
        H = np.concatenate([slopes, np.zeros((runs, 4, 3))], axis=-1)
        K = P @ H.swapaxes(1, 2) @ np.linalg.inv(H @ P @ H.swapaxes(1, 2) + math.radians(0.5) ** 2 * np.eye(4))
        x, P = x + np.einsum("rij,rj->ri", K, (z - h).reshape(runs, 4)), P - K @ H @ P
        found.append(np.linalg.norm(x[:, :3] - places[0], axis=1) - np.linalg.norm(target - places[0]))
    return np.array(found).T


def test_a_filter_written_anew_makes_the_same_errors(records):
    """Run by run within half a metre, where Gauss–Newton stops; in 5,000 runs a mean of 480 m within 1 %, as specified.

    The specification's entries of scans 20 and 30 (462 and 208 m, 500 runs) are too large by 1.9 and 2.8 of their
    standard errors.
    """
    ours = records["ekf"].range_error
    np.testing.assert_allclose(dense_range_errors(draw_seeds((0, 1, 2, 3), 125).errors), ours, atol=0.5)
    rng = np.random.default_rng(40)
    squares = np.square(dense_range_errors(math.radians(0.5) * rng.standard_normal((5000, 41, 2, 2))))
    rmse = np.sqrt(squares.mean(0))
    assert rmse.mean() == pytest.approx(480.0, rel=0.01)
    standard_error = squares.std(0) / (2.0 * rmse) * math.sqrt(1 / 5000 + 1 / EKF_RUNS)
    off = (np.array(EKF_M) - rmse[ROWS]) / standard_error[ROWS]
    assert np.abs(off).max() < norm.ppf(1.0 - 0.0005 / len(ROWS))
    assert (np.abs(rmse[ROWS[3:5]] / linear_range_error()[ROWS[3:5]] - 1.0) < 3.3 * math.sqrt(0.5 / 5000)).all()


def test_missing_a_tenth_of_sensor_twos_scans_costs_3_to_8_percent(records):
    assert 1.03 <= records["ekf_dropouts"].rmse().mean() / records["ekf"].rmse().mean() <= 1.08


def test_filter_is_modest_about_a_target_without_process_noise(records):
    """Specification: NEES 3.7 for six states."""
    assert records["ekf"].nees.mean() == pytest.approx(3.7, rel=0.1)


# ------------------------------------------------------------------------------------------------ association


def test_fewer_than_5_percent_are_lost_at_nine_validated_returns(records):
    """The paper's figure 1: Wilson interval of 500 runs meets the specification's [2.5, 6.4] %; more runs decide."""
    low, high = wilson_interval(16, 400)
    ours_low, ours_high = lost_share(records["pdaf_8"])[1]
    assert records["pdaf_8"].validated.mean() == pytest.approx(9.0, abs=0.1)
    assert ours_low <= high
    assert low <= ours_high
    many = follow(Trial(clutter=8), draw_seeds((7, 8), 1500), np.random.default_rng(9))
    share, (_, upper) = lost_share(many)
    assert share < 0.05
    assert upper < 0.06


def test_kept_tracks_in_dense_clutter_have_the_specified_error(records):
    """909 m on average, within 12 %; PDAF without clutter is the EKF."""
    assert records["pdaf_8"].rmse().mean() == pytest.approx(909.0, rel=0.12)
    noise = draw_seeds((0,), 20)
    pdaf, ekf = (follow(Trial(name), noise, np.random.default_rng(0)) for name in ("angle_pdaf", "angle_ekf"))
    gated = pdaf.gated.all((1, 2))
    assert gated.sum() >= 15
    np.testing.assert_allclose(pdaf.range_error[gated], ekf.range_error[gated], rtol=1e-5, atol=1e-3)


def test_nearest_neighbour_fails(records):
    """12, 93 and 99.8 % lost at 1, 4 and 8 false returns per gate; bands of both Monte Carlos, 99.9 %."""
    for clutter, share in ((1, 0.12), (4, 0.93), (8, 0.998)):
        ours = lost_share(records[f"nn_{clutter}"])[0]
        spread = math.sqrt(max(share * (1 - share), 0.002) * (1 / 400 + 1 / RUNS))
        assert abs(ours - share) < 3.3 * spread


def test_narrow_gate_loses_more(records):
    """γ₂ = 9.21: 10 % of 200 runs."""
    low, high = wilson_interval(20, 200, 0.999)
    assert low < lost_share(records["pdaf_narrow"])[0] < high
    assert records["pdaf_narrow"].lost.sum() > records["pdaf_8"].lost.sum()


def test_sequential_pdaf_loses_no_more_but_errs_more(records):
    low, high = lost_share(records["pdaf_8"])[1]
    ours_low, ours_high = lost_share(records["sequential_8"])[1]
    assert ours_low <= high
    assert low <= ours_high
    assert records["sequential_8"].rmse().mean() > 1.03 * records["pdaf_8"].rmse().mean()


@pytest.mark.parametrize(("clutter", "share"), FIXED_SHARES.items())
def test_fixed_density_is_much_harder(records, clutter, share):
    """A gate that grows admits more clutter and grows again: 0, 0.5, 8.2, 42, 82 % lost at 0.5 to 4 per clean gate.

    Intervals of 99.9 % of both Monte Carlos meet.
    """
    low, high = wilson_interval(round(share * FIXED_RUNS), FIXED_RUNS, 0.999)
    ours_low, ours_high = wilson_interval(int(records[f"fixed_{clutter:g}"].lost.sum()), RUNS, 0.999)
    assert ours_low <= high
    assert low <= ours_high


def test_lost_by_either_criterion():
    """Constructed records: a large late error; own returns outside both gates three times running."""
    shape = (4, STEPS)
    position, gated = np.full(shape, 100.0), np.ones((*shape, 2), bool)
    position[0, -5:] = 1200.0
    position[1, -6:-2] = 1200.0  # mean of the last five below 1 km
    gated[2, 10:13] = False
    gated[3, 10:13, 0] = gated[3, 20:22] = False
    record = Record(np.ones(shape), position, np.ones((*shape, 2)), gated, np.ones(shape))
    np.testing.assert_array_equal(record.lost, [True, False, False, False])
    np.testing.assert_array_equal(record.slipped, [False, False, True, False])
    assert record.rmse()[0] == 1.0
    hopeless = record._replace(position_error=np.full(shape, 2e3))
    assert hopeless.kept.all()


def test_clutter_per_gate_is_what_it_says():
    """Mean and uniformity of the false returns the filter sees, 300 runs: Poisson band, mean |d|² = γ/2."""
    seen = []

    class Watched(Trial):
        def make_tracker(self):
            tracker = super().make_tracker()

            class Spy:
                gate = tracker.gate

                def __getattr__(self, name):
                    return getattr(tracker, name)

                def update(self, prior, scan):
                    assert isinstance(scan, AngleScan)
                    search = gate(prior.mean[:, 0], prior.cov[:, 0], scan.platforms, scan.angle_std, tracker.gate)
                    nu = (scan.angles - search.angles[..., None, :])[..., 1:, :]
                    squared = np.einsum("rsbi,rsij,rsbj->rsb", nu, np.linalg.inv(search.cov), nu)
                    seen.append((scan.valid[..., 1:].sum(-1), squared[scan.valid[..., 1:]]))
                    np.testing.assert_allclose(scan.clutter_density * search.area, 3.0)
                    return tracker.update(prior, scan)

            return Spy()

    follow(Watched(clutter=3), draw_seeds((1,), 300), np.random.default_rng(2))
    counts, squared = (np.concatenate([np.ravel(part[i]) for part in seen]) for i in range(2))
    assert counts.mean() == pytest.approx(3.0, abs=4.0 * math.sqrt(3.0 / counts.size))
    assert counts.var() == pytest.approx(3.0, rel=0.05)
    assert squared.max() <= 16.0 * (1 + 1e-6)
    assert squared.mean() == pytest.approx(8.0, abs=4.0 * 16.0 / math.sqrt(12.0 * squared.size))


def test_clean_gates_are_those_of_a_filter_without_clutter():
    """Their logarithm against the mean over 200 runs of the EKF at three scans, within 10 %."""
    areas = []
    tracker, noise, runs = Trial("angle_ekf").make_tracker(), draw_seeds((3,), 200), 200
    z = direction(PATHS.target[:, None], PATHS.platforms) + noise.errors
    std, ones = np.full((runs, 2, 2), ANGLE_STD), np.ones((runs, 2, 2), bool)
    state = None
    for k in range(STEPS + 1):
        places = np.broadcast_to(PATHS.platforms[k], (runs, 2, 3)).copy()
        scan = AngleScan(
            z[:, k, :, None], np.ones((runs, 2, 1), bool), places, std, ones, np.full((runs, 2), NO_CLUTTER)
        )
        if state is None:
            state = tracker.initiate(scan)
            continue
        prior = tracker.predict(state, 2.0)
        areas.append(np.log(gate(prior.mean[:, 0], prior.cov[:, 0], places, std, 16.0).area).mean(0))
        state = tracker.update(prior, scan).posterior
    np.testing.assert_allclose(np.array(areas)[[9, 19, 39]], np.log(clean_gates()[[9, 19, 39]]), atol=0.1)


# ------------------------------------------------------------------------------------------------ report and command


def test_every_claim_has_a_verdict_and_rates_have_wilson_intervals(result):
    claims = result[0]["claims"]
    assert len(claims) > 25
    assert all(c["verdict"] in VERDICTS for c in claims)
    rates = [c for c in claims if "share lost: intervals meet" in c["claim"]]
    assert len(rates) == 6
    shares = {json.dumps(list(t["lost_interval"])) for t in result[0]["trials"].values()}
    assert all(json.dumps(c["interval"]) in shares for c in rates)
    assert [c["verdict"] for c in claims if "active sensors" in c["claim"]] == ["not testable"]


def test_wilson_interval_by_hand():
    """Specification, section 7: 2 of 50 gives 1 % to 13.5 %."""
    assert wilson_interval(2, 50) == pytest.approx((0.011, 0.135), abs=5e-4)
    assert wilson_interval(0, 10)[0] == 0.0


def test_report_and_files(result):
    text = print_angle_fusion(result[0])
    for words in (
        "## What the authors claim",
        "## Our own cross-checks",
        "## Range error and lost tracks",
        "| pdaf_8 ",
        "Cramér–Rao bound",
    ):
        assert words in text
    names = sorted(path.name for path in result[1].iterdir())
    assert names == ["lost_tracks.png", "range_error_in_clutter.png", "range_error_with_dropouts.png",
                     "reproduction.json", "reproduction.md"]  # fmt: skip
    saved = json.loads((result[1] / "reproduction.json").read_text(), parse_constant=pytest.fail)
    assert set(saved["trials"]) == set(TRIALS)


def test_results_do_not_change_with_repetition(result):
    again = reproduce_angle_fusion(30, (5, 6))
    assert again == result[0]


def test_one_run_is_enough_and_none_is_an_error():
    assert len(reproduce_angle_fusion(1, (3,))["claims"]) > 25
    for runs, seeds, words in (
        (0, (1,), "at least one of each"),
        (5, (), "at least one"),
        (5, (-1,), "not be negative"),
    ):
        with pytest.raises(ValueError, match=words):
            reproduce_angle_fusion(runs, seeds)


def test_command_prints_the_claims(capsys, tmp_path):
    assert cli.main(["reproduce", "angle-fusion", "--runs", "3", "--seeds", "4", "--out", str(tmp_path / "r")]) == 0
    printed = capsys.readouterr().out
    assert "fewer than 5 % of the tracks are lost" in printed
    assert (tmp_path / "r" / "reproduction.md").exists()
    (tmp_path / "taken").write_text("mine")
    assert cli.main(["reproduce", "angle-fusion", "--out", str(tmp_path / "taken")]) == 2
    assert "is a file, must name a folder" in capsys.readouterr().err
