"""Xiu et al. (2002) repeated: acceptance tests of the specification, Table 1, the bounds, the report and its files."""

import itertools
import json
import math
import os
import time
from dataclasses import replace

import numpy as np
import pytest
from matplotlib.figure import Figure

from agents import files
from agents.files import atomic_write, save_figure, write_json, write_text
from agents.reproduction import print_report, reproduce_two_station
from agents.reproduction.report import HEADS, ORIGINS, PAPER, SPEC, VERDICTS, claim, markdown_table, within, words
from agents.reproduction.two_station.claims import SPECIFIED_BOUNDS_KM, prior_mean_error_km
from agents.reproduction.two_station.monte_carlo import (
    BEARING_STD,
    FUSED,
    READINGS,
    STEPS,
    TABLE_1_KM,
    Noise,
    draw_noise,
    draw_seeds,
    follow,
    paper_paths,
    range_bound,
    sight,
    table_1_errors,
    table_1_score,
)
from agents.resampling import bootstrap_means, mean_interval
from passive_env.catalogue.two_station import BESTFIT, NATURAL, TwoStation
from trackers import Scan
from trackers.bounds import bound_prior, fisher_information
from trackers.motion import process_noise, transition
from trackers.triangulation import crossing_ranges, forward_interval, modulus_interval, pair_bearings

PATHS = paper_paths(NATURAL)
FIRST_STATIONS = PATHS.stations[0, :, :2]
THETA, ALPHA = PATHS.bearings[0]


@pytest.fixture(scope="module")
def result():
    return reproduce_two_station()


# ------------------------------------------------------------------------------------------------ the paper's scenario


def test_first_geometry_is_the_specifications():
    """Section 5: ranges 70.0 km, bearings 40.07, 46.91, 34.28° and 45.00, 53.03, 38.13°, baseline 14.0 km."""
    np.testing.assert_allclose(PATHS.ranges[0], 70.0e3, atol=60.0)
    np.testing.assert_allclose(np.degrees(THETA), [40.07, 46.91, 34.28], atol=0.01)
    np.testing.assert_allclose(np.degrees(ALPHA), [45.00, 53.03, 38.13], atol=0.01)
    assert math.dist(*FIRST_STATIONS) == pytest.approx(14.0e3, abs=20.0)


@pytest.mark.parametrize("course", [NATURAL, BESTFIT])
def test_everybody_turns_and_speeds_up_by_the_schedule(course):
    """20° turns at 22–26 s and 52–56 s, targets to 450, 430, 430 m/s; distance flown equals the integral of speed."""
    paths = paper_paths(course)
    velocity = paths.targets[..., 2:]
    speed = np.hypot(velocity[..., 0], velocity[..., 1])
    np.testing.assert_allclose(speed[:12], 250.0)
    np.testing.assert_allclose(speed[12], 270.0)
    np.testing.assert_allclose(speed[-1], [450.0, 430.0, 430.0])
    turned = np.degrees(np.arctan2(velocity[..., 1], velocity[..., 0]))
    np.testing.assert_allclose(turned[11], np.array(course.target_heading_deg) - 360.0)
    np.testing.assert_allclose(turned[13] - turned[11], 20.0 * np.array(course.target_sense))
    np.testing.assert_allclose(turned[-1], turned[13])
    straight = np.hypot(*(paths.targets[-1, 0, :2] - paths.targets[13, 0, :2]))
    seconds = 90.0 - 26.0
    accelerating = 20.0 - 4.0
    assert straight == pytest.approx(290.0 * accelerating + 5.0 * accelerating**2 + 450.0 * (seconds - accelerating))
    heading = np.degrees(np.arctan2(paths.stations[..., 3], paths.stations[..., 2]))
    np.testing.assert_allclose(heading[[26, 28], 0], [45.0, 45.0 + 20.0 * course.station_sense[0]])
    np.testing.assert_allclose(heading[[11, 13], 1], [45.0, 45.0 + 20.0 * course.station_sense[1]])


@pytest.mark.parametrize(("name", "course"), [("paper", NATURAL), ("paper_bestfit", BESTFIT)])
def test_environment_flies_the_same_courses(name, course):
    tape = TwoStation(course=name).draw_tape([np.random.default_rng(0)])
    np.testing.assert_allclose(tape.targets[0], paper_paths(course).targets, atol=1e-6)
    np.testing.assert_allclose(tape.platforms[0], paper_paths(course).stations[0], atol=1e-9)


# ------------------------------------------------------------------------------------------------ acceptance (b)–(f)


def test_prior_mean_errors_of_literal_moduli():
    """Acceptance test (b): 440.7, −15.5, 319.8 km, to 0.1 km, from the banks' own weighted mean range."""
    np.testing.assert_allclose(prior_mean_error_km(PATHS), [440.7, -15.5, 319.8], atol=0.1)
    noise = Noise(np.zeros((1, STEPS + 1, 2, 3)), np.tile(np.arange(3), (1, STEPS + 1, 2, 1)))
    record = follow(READINGS["NATURAL"].tracker, PATHS, sight(PATHS, noise, exact_start=True))
    np.testing.assert_allclose(record.range_error[0, 0] / 1e3, [440.7, -15.5, 319.8], atol=0.1)


def test_forward_intervals():
    """Acceptance test (c): 20.6–106.0, 12.6–96.5, 46.7–123.0 km."""
    found = forward_interval(ALPHA, FIRST_STATIONS[1], THETA, np.ones(3, bool), FIRST_STATIONS[0], 3 * BEARING_STD)
    np.testing.assert_allclose(found.low / 1e3, [20.6, 12.6, 46.7], atol=0.05)
    np.testing.assert_allclose(found.high / 1e3, [106.0, 96.5, 123.0], atol=0.05)


def test_six_of_nine_first_crossings_lie_ahead_and_one_pairing_is_possible():
    """Acceptance test (d)."""
    r1, r2 = crossing_ranges(THETA, ALPHA[:, None], FIRST_STATIONS[0], FIRST_STATIONS[1])
    ahead = (r1 > 0) & (r2 > 0)
    assert ahead.sum() == 6
    feasible = [order for order in itertools.permutations(range(3)) if ahead[np.arange(3), order].all()]
    assert feasible == [(0, 1, 2)]
    order, every = np.array([2, 0, 1]), np.ones(3, bool)
    partner = pair_bearings(ALPHA, every, FIRST_STATIONS[1], THETA[order], every, FIRST_STATIONS[0])
    np.testing.assert_array_equal(order[partner], [0, 1, 2])


def test_first_covariances_are_longest_along_the_reference_bearing():
    """Acceptance test (e), on the paper's scenario."""
    interval = modulus_interval(ALPHA, FIRST_STATIONS[1], THETA, FIRST_STATIONS[0], 3 * BEARING_STD)
    assert (interval.high > interval.low).all()
    noise = draw_noise(np.random.default_rng(0), 1)
    seen = sight(PATHS, noise, exact_start=True, labelled=True)
    tracker = READINGS["NATURAL"].tracker
    bank = tracker.initiate(Scan(seen.bearings[:, 0], np.ones((2, 3), bool), FIRST_STATIONS, BEARING_STD))
    axis = np.linalg.eigh(bank.cov[0, :, :, :2, :2])[1][..., :, -1]
    along = np.stack([np.cos(ALPHA), np.sin(ALPHA)], axis=-1)[:, None]
    np.testing.assert_allclose(np.abs((axis * along).sum(-1)), 1.0)


def test_both_bearings_end_below_1500_m_in_the_natural_scenario(result):
    """Acceptance test (f), unlabelled bearings."""
    final = result["final"]["NATURAL"]["fused"]
    assert max(final["mean_km"]) < 1.5
    assert max(final["interval_km"][1]) < 1.5
    assert final["own_bearing_share"] > 0.999


# ------------------------------------------------------------------------------------------------ Table 1


def test_table_1_is_approached_in_the_natural_reading(result):
    """Mean |ln(ours / paper)| of 51 entries, 50 runs, four seeds: at most 0.65 (specification: 0.55)."""
    assert result["scores"]["NATURAL"]["mean"] <= 0.65


def test_table_1_is_approached_more_closely_in_the_best_fitting_reading(result):
    """At most 0.40 (specification: about 0.3), association included."""
    assert result["scores"]["BESTFIT"]["mean"] <= 0.40
    assert result["scores"]["BESTFIT"]["labelled"]["mean"] <= 0.35


def test_scores_are_means_over_seeds_of_50_runs_each(result):
    for name, reading in READINGS.items():
        one = table_1_errors(reading.course, reading.tracker, 50, np.random.default_rng(2))
        assert one.shape == (50, 17, 3)
        assert result["scores"][name]["per_seed"][2] == pytest.approx(table_1_score(one.mean(0)))
        assert result["scores"][name]["mean"] == pytest.approx(np.mean(result["scores"][name]["per_seed"]))


def test_score_by_hand():
    assert table_1_score(TABLE_1_KM * 1e3) == pytest.approx(0.0)
    assert table_1_score(TABLE_1_KM * 1e3 * math.e) == pytest.approx(1.0)
    assert TABLE_1_KM.shape == (17, 3)
    np.testing.assert_array_equal(TABLE_1_KM[[0, -1]], [[435.92, 15.159, 301.62], [2.30, 1.847, 1.92]])


def test_fifty_runs_take_less_than_a_fifth_of_a_second():
    reading, seconds = READINGS["NATURAL"], []
    for seed in range(6):
        start = time.perf_counter()
        table_1_errors(reading.course, reading.tracker, 50, np.random.default_rng(seed))
        seconds.append(time.perf_counter() - start)
    assert min(seconds[1:]) < 0.2


def test_the_order_of_bearings_makes_no_difference():
    """Natural reading, no ambiguity: shuffled scans give the same tracks as labelled ones."""
    noise = draw_seeds([5], 10)
    shuffled = follow(READINGS["NATURAL"].tracker, PATHS, sight(PATHS, noise, exact_start=True))
    labelled = sight(PATHS, noise, exact_start=True, labelled=True)
    ordered = follow(READINGS["NATURAL"].tracker, PATHS, labelled)
    apart = follow(READINGS["NATURAL"].tracker, PATHS, labelled, labelled=True)
    assert shuffled.own.all()
    np.testing.assert_allclose(shuffled.position, ordered.position, rtol=1e-9)
    np.testing.assert_allclose(shuffled.position, apart.position, rtol=1e-9)


@pytest.mark.parametrize("tracker", [READINGS["BESTFIT"].tracker, FUSED], ids=["paper", "fused"])
def test_a_run_does_not_depend_on_its_neighbours(tracker):
    noise, paths = draw_seeds([6], 5), paper_paths(BESTFIT)
    batch = follow(tracker, paths, sight(paths, noise, exact_start=False))
    alone = follow(tracker, paths, sight(paths, Noise(*(part[3:4] for part in noise)), exact_start=False))
    for part, expected in zip(batch, alone, strict=True):
        np.testing.assert_array_equal(part[3:4], expected)


def test_paper_excludes_both_bearings_in_its_filter(result):
    """Section 7: with both bearings the error is near 10 km after one update, the paper's is 436 km."""
    tracker = replace(READINGS["NATURAL"].tracker, reference_only=False)
    seen = sight(PATHS, draw_seeds([0], 50), exact_start=True, labelled=True)
    first = np.abs(follow(tracker, PATHS, seen, labelled=True).range_error[:, 1]).mean(0)
    assert (first < 15e3).all()
    assert result["table_1"][0]["NATURAL"]["mean_km"] == pytest.approx([440.0, 12.0, 320.0], rel=0.1)


# ------------------------------------------------------------------------------------------------ bounds


@pytest.mark.parametrize("name", SPECIFIED_BOUNDS_KM)
def test_bounds_agree_with_the_specification(result, name):
    """Section 10: three final values and the mean over targets and updates, within 5 %."""
    found = result["bounds"]["NATURAL"][name]
    final, time_mean = SPECIFIED_BOUNDS_KM[name]
    assert found["final_km"] == pytest.approx(final, rel=0.05)
    assert found["time_mean_km"] == pytest.approx(time_mean, rel=0.05)


def test_range_bound_equals_a_plain_recursion():
    """Target 2, both stations, q = 10, written out with NumPy's inverse."""
    path, stations = PATHS.targets[:, 1], PATHS.stations[..., :2]
    cov = bound_prior(path[0], stations[0, 1], BEARING_STD, 15e3, 200.0)
    phi, Q = transition(2.0), process_noise(2.0, 10.0)
    expected = []
    for k in range(STEPS + 1):
        information = np.linalg.inv(phi @ cov @ phi.T + Q) if k else np.linalg.inv(cov)
        seen = stations[k] if k else stations[0, :1]
        information[:2, :2] += fisher_information(path[k], seen, BEARING_STD)
        cov = np.linalg.inv(information)
        sight_line = (path[k, :2] - stations[k, 1]) / PATHS.ranges[k, 1]
        expected.append(math.sqrt(sight_line @ cov[:2, :2] @ sight_line))
    np.testing.assert_allclose(range_bound(PATHS, 10.0, both=True)[:, 1], expected, rtol=1e-6)


# ------------------------------------------------------------------------------------------------ claims, report


def test_every_claim_has_a_verdict_and_the_vague_one_is_not_testable(result):
    keys = {"origin", "source", "claim", "stated", "ours", "interval", "verdict"}
    assert all(set(c) == keys and c["origin"] in ORIGINS for c in result["claims"])
    assert all(c["verdict"] in VERDICTS for c in result["claims"])
    assert [c["claim"] for c in result["claims"] if c["verdict"] == "not testable"] == [
        "computation is far below that of traditional methods"
    ]


def test_what_is_not_reproduced_is_said(result):
    """The specification's own finding: the plateau of target 1 and the late collapse appear in no reading."""
    denied = [c["claim"] for c in result["claims"] if c["verdict"] == "not reproduced"]
    for reading in READINGS:
        assert any("stays between 38 and 48 km" in text and reading in text for text in denied)
        assert any("entry by entry" in text and reading in text for text in denied)


def test_report_shows_table_1_beside_ours(result):
    text = print_report(result)
    assert "| 45     | 2.3 / 1.85 / 1.92" in text
    for heading in ("Table 1", "Score", "Range error at update 45", "Posterior Cramér–Rao bound", *HEADS.values()):
        assert f"## {heading}" in text


def test_files_are_written_whole_strict_and_alike_every_time(tmp_path):
    once = reproduce_two_station(runs=4, seeds=(1, 2), out=tmp_path / "a")
    reproduce_two_station(runs=4, seeds=(1, 2), out=tmp_path / "b")
    names = sorted(path.name for path in (tmp_path / "a").iterdir())
    assert names == [
        "range_error.png", "range_target_1.png", "range_target_2.png", "range_target_3.png", "reproduction.json",
        "reproduction.md",
    ]  # fmt: skip
    for name in names:
        assert (tmp_path / "a" / name).read_bytes() == (tmp_path / "b" / name).read_bytes(), name
    text = (tmp_path / "a" / "reproduction.json").read_text()
    saved = json.loads(text, parse_constant=lambda word: pytest.fail(f"{word} in JSON"))
    assert saved["scores"] == once["scores"]
    assert {"claims", "scores", "table_1"} <= set(saved)


def test_one_run_of_one_seed_is_enough_and_none_is_an_error():
    assert reproduce_two_station(runs=1, seeds=(3,))["scores"]["NATURAL"]["mean"] > 0
    for runs, seeds in ((0, (1,)), (5, ())):
        with pytest.raises(ValueError, match="at least one of each"):
            reproduce_two_station(runs=runs, seeds=seeds)


def test_claims_refuse_an_unknown_verdict_and_an_unknown_origin():
    with pytest.raises(ValueError, match="verdict 'perhaps' of claim 'x'"):
        claim(PAPER, "1", "x", 1, 1, "perhaps")
    with pytest.raises(ValueError, match="origin 'rumor' of claim 'x': must be one of 'paper', 'specification'"):
        claim("rumor", "1", "x", 1, 1, True)
    assert claim(SPEC, "1", "x", np.array([1.0]), np.float64(2.0), np.True_)["verdict"] == "reproduced"
    assert within([1.0, -2.2], [1.0, -2.0], relative=0.11)
    assert not within([1.0, -2.2], [1.0, -2.0], absolute=0.19)


def test_tables_escape_bars_and_line_up():
    table = markdown_table(("a", "b"), [("|x|", 0.12345), (None, [1.0, 250.0])])
    assert table.splitlines()[2] == "| \\|x\\| | 0.123     |"
    assert len({len(line) for line in table.splitlines()}) == 1
    assert words([1, "km", 12345.678]) == "1 / km / 12345.7"


def test_bootstrap_equals_the_known_error_of_a_mean():
    rng = np.random.default_rng(0)
    samples = rng.normal(3.0, 2.0, (4, 200, 5))
    means = bootstrap_means(samples, rng, draws=1000)
    assert means.shape == (1000, 4, 5)
    np.testing.assert_allclose(means.std(0), samples.std(1) / math.sqrt(200), rtol=0.12)
    low, high = mean_interval(samples, rng)
    np.testing.assert_allclose(high - low, 2 * 1.96 * 2.0 / math.sqrt(800), rtol=0.15)
    assert (low < samples.mean((0, 1))).all()
    assert (samples.mean((0, 1)) < high).all()


# ------------------------------------------------------------------------------------------------ files


def test_an_interrupted_write_leaves_the_old_file_and_nothing_else(tmp_path, monkeypatch):
    path = tmp_path / "new" / "table.json"
    write_json(path, {"a": 1})
    monkeypatch.setattr(files.os, "replace", lambda *_: (_ for _ in ()).throw(OSError("power cut")))
    with pytest.raises(OSError, match="power cut"):
        write_text(path, "half")
    assert json.loads(path.read_text()) == {"a": 1}
    assert os.listdir(path.parent) == ["table.json"]


def test_data_that_cannot_be_json_is_refused_before_anything_is_written(tmp_path):
    with pytest.raises(TypeError, match="object has no form in JSON"):
        write_json(tmp_path / "x.json", {"a": [1, object()]})
    assert not list(tmp_path.iterdir())


def test_json_holds_numbers_lists_and_null(tmp_path):
    data = {"nan": math.nan, "inf": [np.float32(np.inf), 2], 3: np.arange(2), "flag": np.True_, "path": tmp_path}
    text = write_json(tmp_path / "x.json", data).read_text()
    assert json.loads(text) == {"nan": None, "inf": [None, 2], "3": [0, 1], "flag": True, "path": str(tmp_path)}
    assert text.endswith("}\n")


def test_bytes_text_and_figures_are_written(tmp_path):
    assert atomic_write(tmp_path / "b", b"\x00\xff").read_bytes() == b"\x00\xff"
    assert write_text(tmp_path / "t", "ρ\n\n").read_text() == "ρ\n"
    figure = Figure()
    figure.subplots().plot([1, 2])
    assert save_figure(tmp_path / "f.png", figure).read_bytes().startswith(b"\x89PNG")
