"""`passive-env curves`: median and range over seeds from TensorBoard logs or progress.csv."""

import csv
import json

import numpy as np
import pytest
from torch.utils.tensorboard import SummaryWriter

from agents import cli
from agents.curves import RATIO, REWARD, difference, draw_curves, gather, picture, read_run

ERROR = "eval/final_range_error_m"
CONFIG = {
    "environment": "passive/Ownship-v0",
    "observation_digest": "0123456789abcdef",
    "interface": {"actions": "rates"},
    "algo": "ppo",
    "timesteps": 400,
    "envs": 2,
    "fields": {},
    "preset": {"learning_rate": 0.001, "arguments": {"gamma": 1.0}},
}


def configured(folder, seed, **changes):
    folder.mkdir()
    (folder / "config.json").write_text(json.dumps({**CONFIG, "seed": seed, **changes}))
    return folder


def logged(folder, seed, points, **changes):
    """A run folder with TensorBoard logs; points: values by name and step."""
    configured(folder, seed, **changes)
    with SummaryWriter(str(folder / "tensorboard" / "log_0")) as writer:
        for name, values in points.items():
            for step, value in values.items():
                writer.add_scalar(name, value, step)
    return folder


def table(file):
    return list(csv.DictReader(file.read_text().splitlines()))


@pytest.fixture
def five(tmp_path):
    """Five runs of the same steps; their ratios at steps 100, 200, 300 are known."""
    ratios = [(1.5, 1.0, 0.5), (1.4, 0.9, 0.6), (1.3, 0.8, 0.7), (1.2, 0.7, 0.8), (9.0, 0.6, 0.9)]
    return [
        logged(
            tmp_path / f"run{seed}",
            seed,
            {
                RATIO: dict(zip((100, 200, 300), ratio, strict=True)),
                ERROR: dict(zip((100, 200, 300), np.multiply(1000.0, ratio), strict=True)),
                REWARD: {50: -10.0 - seed, 400: -5.0 + seed},
                "train/loss": {50: 1.0},
            },
        )
        for seed, ratio in enumerate(ratios)
    ]


def test_median_and_range_by_hand(five, tmp_path):
    picture_file, numbers = draw_curves(five, tmp_path / "curves.png")
    assert picture_file.read_bytes()[:8] == b"\x89PNG\r\n\x1a\n"
    rows = table(numbers)
    assert [(row["quantity"], int(row["step"])) for row in rows] == [
        *((RATIO, step) for step in (100, 200, 300)),
        *((ERROR, step) for step in (100, 200, 300)),
        (REWARD, 50),
        (REWARD, 400),
    ]
    found = np.array([[float(row[name]) for name in ("median", "low", "high")] for row in rows])
    expected = np.array([(1.4, 1.2, 9.0), (0.8, 0.6, 1.0), (0.7, 0.5, 0.9)])
    np.testing.assert_allclose(found[:3], expected, rtol=1e-6)
    np.testing.assert_allclose(found[3:6], 1000.0 * expected, rtol=1e-6)
    np.testing.assert_allclose(found[6:], [(-12, -14, -10), (-3, -5, -1)])
    assert float(rows[0]["seed 4"]) == 9.0


def test_picture_shows_what_was_computed(five):
    curves = gather([read_run(folder) for folder in five])
    figure = picture(curves, "five")
    assert [axes.get_ylabel() for axes in figure.axes] == [
        "final error / rule's", "final range error [m]", "return of an episode",
    ]  # fmt: skip
    (median,) = (line for line in figure.axes[0].lines if line.get_label() == "median")
    np.testing.assert_allclose(median.get_ydata(), [1.4, 0.8, 0.7], rtol=1e-6)
    assert figure.get_suptitle() == "five"


def test_a_single_run_is_drawn_as_it_is(five):
    figure = picture(gather([read_run(five[0])]), "")
    (line,) = (line for line in figure.axes[0].lines if line.get_label() == "this run")
    np.testing.assert_allclose(line.get_ydata(), [1.5, 1.0, 0.5], rtol=1e-6)
    labels = [text.get_text() for text in figure.axes[0].get_legend().get_texts()]
    assert labels == ["this run", "the rule"]
    assert figure.get_suptitle() == ""


def test_command_names_environment_algorithm_and_files(five, tmp_path, capsys):
    out = tmp_path / "deep" / "curves.png"
    assert cli.main(["curves", *map(str, five), "--out", str(out)]) == 0
    assert capsys.readouterr().out.split() == [str(out), str(out.with_suffix(".csv"))]


def test_runs_of_other_steps_meet_where_all_have_been(tmp_path):
    """One run stopped early, another logged at other steps: values between are interpolated, none is invented."""
    a = logged(tmp_path / "a", 0, {RATIO: {0: 0.0, 100: 1.0, 300: 3.0}})
    b = logged(tmp_path / "b", 1, {RATIO: {50: 5.0, 250: 7.0}})
    curve = gather([read_run(a), read_run(b)])[RATIO]
    np.testing.assert_array_equal(curve.steps, [50, 100, 250])
    np.testing.assert_allclose(curve.values, [[0.5, 1.0, 2.5], [5.0, 5.5, 7.0]])


def test_a_resumed_run_counts_its_repeated_steps_once(tmp_path):
    run = logged(tmp_path / "a", 0, {RATIO: {100: 1.0, 200: 2.0}})
    with SummaryWriter(str(run / "tensorboard" / "log_0"), filename_suffix=".resumed") as writer:
        for step, value in ((200, 5.0), (300, 6.0)):
            writer.add_scalar(RATIO, value, step)
    series = read_run(run).series[RATIO]
    np.testing.assert_array_equal(series.steps, [100, 200, 300])
    np.testing.assert_array_equal(series.values, [1.0, 5.0, 6.0])


def test_progress_csv_serves_where_there_are_no_event_files(tmp_path):
    for seed in (0, 1):
        run = configured(tmp_path / f"run{seed}", seed)
        (run / "progress.csv").write_text(
            f"time/total_timesteps,{REWARD},{RATIO}\n100,{seed}.5,\n200,nan,2\n300,{seed}.25,4\n"
        )
    curves = gather([read_run(tmp_path / "run0"), read_run(tmp_path / "run1")])
    assert list(curves) == [RATIO, REWARD]
    np.testing.assert_array_equal(curves[RATIO].steps, [200, 300])
    np.testing.assert_array_equal(curves[REWARD].steps, [100, 300])
    np.testing.assert_array_equal(curves[REWARD].values, [[0.5, 0.25], [1.5, 1.25]])


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"environment": "passive/AngleFusion-v0"}, "environment is 'passive/AngleFusion-v0', but 'passive/Own"),
        ({"preset": {**CONFIG["preset"], "arguments": {"gamma": 0.9}}}, r"preset\.arguments\.gamma is 0\.9, but 1\.0"),
        ({"fields": {"steps": 3}}, r"fields\.steps is 3, but None"),
        ({"algo": "sac"}, "algo is 'sac', but 'ppo'"),
        ({"timesteps": 800}, "timesteps is 800, but 400"),
        ({"seed": 0}, "seed 0 is that of .*a too"),
    ],
)  # fmt: skip
def test_runs_that_are_no_repetitions_are_refused(tmp_path, changes, reason):
    runs = [
        logged(tmp_path / "a", 0, {RATIO: {1: 1.0}}),
        logged(tmp_path / "b", **{"seed": 1, "points": {}, **changes}),
    ]
    with pytest.raises(ValueError, match=reason) as caught:
        draw_curves(runs, tmp_path / "curves.png")
    assert str(tmp_path / "b") in str(caught.value)
    assert not (tmp_path / "curves.png").exists()


def test_what_cannot_be_drawn_is_refused_with_its_reason(tmp_path):
    run = logged(tmp_path / "a", 0, {RATIO: {1: 1.0, 2: 2.0}})
    other = logged(tmp_path / "b", 1, {"train/loss": {1: 1.0}})
    later = logged(tmp_path / "c", 2, {RATIO: {3: 1.0}})
    out = tmp_path / "curves.png"
    for runs, error, reason in (
        ([run], ValueError, "needs at least two"),
        ([run, other], ValueError, r"eval/ratio_to_rule.* that all runs have logged .*b: train/loss"),
        ([run, later], ValueError, r"share no step .*1 to 2.*3 to 3"),
        ([run, configured(tmp_path / "d", 3)], FileNotFoundError, "d: neither TensorBoard's"),
        ([run, tmp_path / "e"], FileNotFoundError, r"e: no config\.json"),
    ):
        with pytest.raises(error, match=reason):
            draw_curves(runs, out)
    with pytest.raises(ValueError, match=r"must end in \.png"):
        draw_curves([run, later], tmp_path / "curves.txt")


def test_a_run_without_seed_or_with_a_damaged_table_is_refused(tmp_path):
    run = configured(tmp_path / "a", None)
    config = json.loads((run / "config.json").read_text())
    (run / "progress.csv").write_text(f"{REWARD}\n1\n")
    with pytest.raises(ValueError, match=r"progress\.csv: row 1 has no time/total_timesteps"):
        read_run(run)
    (run / "progress.csv").write_text(f"time/total_timesteps,{REWARD}\n1,2\n2,two\n")
    with pytest.raises(ValueError, match="row 2: could not convert"):
        read_run(run)
    (run / "config.json").write_text(json.dumps({key: value for key, value in config.items() if key != "seed"}))
    with pytest.raises(ValueError, match="names no seed"):
        read_run(run)


def test_difference_names_the_place():
    assert difference("p", {"a": {"b": 1}}, {"a": {"b": 1}}) is None
    assert difference("p", {"a": {"b": 1}}, {"a": {"b": 2}}) == ("p.a.b", 1, 2)
    assert difference("p", {}, {"c": 0}) == ("p.c", None, 0)
    assert difference("p", {"a": 1}, None) == ("p", {"a": 1}, None)
