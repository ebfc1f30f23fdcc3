"""Replays: what is recorded is what happened, pages hold it, animations show it, bad input is refused."""

import base64
import json
import math
import re
import sys
from typing import Any

import numpy as np
import pytest
from matplotlib import animation
from PIL import Image
from scipy.stats import chi2
from spoilt_trackers import SPOILT, spoilt_later

from agents import cli
from agents.animation import HOLD, check_animation, write_animation
from agents.files import atomic_write
from agents.policy import make_policy, policy_names
from agents.replay import frame_of, pack, page_data, points_of, replay_page
from agents.replay_record import ViewRecord, fly_once, record, stack
from passive_env import PassiveEnv
from passive_env.artists import Frame, circles, ellipses
from passive_env.catalogue import SCENARIOS, environment_id, make_scenario
from passive_env.layers import (
    ELLIPSE_STD,
    STYLES,
    circle_rows,
    course_deg,
    dart_rows,
    dot_rows,
    ellipse_rows,
    errors_of,
    line_rows,
    numbered,
)
from passive_env.render_radar import ghost_of, sum_axes, sum_ellipse
from trackers import AnglePdaf, FusedEkf

COLUMNS = {"dart": 3, "dot": 3, "ring": 2, "cross": 2, "site": 2, "square": 2, "line": 4, "ellipse": 6, "path": 2}
STEPS = 4


def short(name: str) -> Any:
    """A scenario of few steps; that of placements has few of its own."""
    return SCENARIOS[name] if name == "RadarPlacement" else SCENARIOS[name].replace(steps=STEPS)


def first_policy(scenario: Any) -> str:
    return next(name for name in ("paper", "fixed", "straight") if name in policy_names(scenario))


def flown(scenario: Any, name: str, seed: int = 3) -> Any:
    return fly_once(scenario, make_policy(name, scenario), seed)


@pytest.fixture(scope="module")
def pair() -> tuple[Any, dict[str, Any]]:
    scenario = make_scenario("TwoStation", {"steps": 6})
    return scenario, {name: flown(scenario, name) for name in ("paper", "rule")}


# ------------------------------------------------------------------------------------------------ every environment


@pytest.mark.parametrize("name", SCENARIOS)
def test_every_environment_has_a_replay(name):
    scenario = short(name)
    told = record(scenario, flown(scenario, first_policy(scenario)))
    scans = scenario.scans if name == "RadarPlacement" else 0
    instants = scenario.steps + 1 + scans
    assert len(told.labels) == len(set(told.labels)) == len(told.at) == instants
    assert (np.diff(told.at) > 0.0).all()
    assert told.views[0].name == "map"
    assert {"platforms", "true targets", "estimates"} <= set(told.views[0].layers)
    for view in told.views:
        assert list(view.layers) == [layer for layer in STYLES if layer in view.layers]
        for layer, rows in view.layers.items():
            assert rows.shape[0] in (1, instants)
            assert rows.shape[-1] == COLUMNS[STYLES[layer].shape], layer
            assert not np.isinf(rows).any()
        for layer, names in view.names.items():
            if layer in view.layers:
                groups, things = view.layers[layer].shape[1:3]
                assert len(names) == (groups if groups > 1 else things), layer
    for error, bound in told.errors.values():
        assert error.shape == bound.shape == (instants, 1 if "Multi" not in name and name != "TwoStation" else 3)
    assert set(told.rewards) == set(scenario.reward_weights)
    page = replay_page(environment_id(name), 3, scenario.replay_axis, {"a": told})
    assert len(page.encode()) < 6e6
    assert 'http-equiv="Content-Security-Policy" content="default-src \'none\'' in page


@pytest.mark.parametrize("name", ["TwoStation", "AngleFusion", "ManeuveringTarget", "MobilePlacement", "PassiveRadar"])
def test_the_record_is_what_the_environment_shows(name):
    scenario = short(name)
    policy = first_policy(scenario)
    told = record(scenario, flown(scenario, policy))
    env, maker = PassiveEnv(scenario), make_policy(policy, scenario)
    observation, info = env.reset(seed=3)
    maker.reset(env.belief())
    for k in range(STEPS + 1):
        for kind in ("range", scenario.score):
            assert np.array_equal(told.errors[kind][0][k], info[f"{kind}_error_m"])
            assert np.array_equal(told.errors[kind][1][k], info[f"{kind}_crlb_m"])
        world, pick = env.world, [0, 1]
        assert np.array_equal(told.views[0].layers["true targets"][k, :, 0, :2], 1e-3 * world.truth[0][:, pick])
        assert np.array_equal(told.views[0].layers["estimates"][k, :, 0], 1e-3 * world.estimate.mean[0][:, pick])
        if k < STEPS:
            belief = env.belief()
            action = env.simulation.actions.encode(maker.act(belief, observation[None]), belief)[0]
            observation, reward, *_, info = env.step(action)
            assert sum(values[k + 1] for values in told.rewards.values()) == pytest.approx(reward)
    assert all(np.isnan(values[0]) for values in told.rewards.values())


def test_policies_share_the_tape_and_differ_where_they_decide(pair):
    scenario, flights = pair
    records = [record(scenario, flight) for flight in flights.values()]
    paths = [each.views[0].layers for each in records]
    assert np.array_equal(paths[0]["true targets"], paths[1]["true targets"])
    assert np.array_equal(paths[0]["platforms"][0], paths[1]["platforms"][0])
    assert not np.array_equal(paths[0]["platforms"][-1], paths[1]["platforms"][-1])


def test_hypotheses_weigh_one_in_all_and_the_heaviest_is_told(pair):
    scenario, flights = pair
    told = record(scenario, flights["paper"])
    weights = np.nan_to_num(told.views[0].layers["range hypotheses"][..., 2])
    assert weights.sum(-1) == pytest.approx(1.0, abs=8 * 1e-3)  # negligible ones are left out
    heaviest = np.stack(list(told.probabilities.values()), axis=1)
    assert weights.max(-1) == pytest.approx(heaviest)


def test_a_placement_is_replayed_sensor_by_sensor_then_scan_by_scan():
    scenario = SCENARIOS["RadarPlacement"]
    flight = flown(scenario, "paper")
    told = record(scenario, flight)
    sensors = told.views[0].layers["platforms"][:, 0, :, 0]
    assert np.isfinite(sensors).sum(-1).tolist() == [0, 1, 2, 3] + [3] * scenario.scans
    errors = told.errors["position"][0][-scenario.scored_scans :]
    assert errors.mean() == pytest.approx(flight.worlds[-1].metrics.position_error_m[0, 0])
    assert np.isnan(told.rewards["final_log_position_error"]).sum() == 1 + scenario.scans
    assert np.isfinite(told.views[0].layers["estimates"]).all(-1).sum() == scenario.scans


def test_returns_and_gates_of_a_scan_in_clutter():
    """A return that the gate's ellipse holds lies within it on the page, too."""
    scenario = SCENARIOS["AngleFusionClutter"].replace(steps=8)
    flight = flown(scenario, "paper")
    told = record(scenario, flight)
    views = {view.name: view for view in told.views}
    assert set(views) == {"map", "side view", "what P0 sees", "what P1 sees"}
    for s in (0, 1):
        layers = views[f"what P{s} sees"].layers
        seen = np.isfinite(layers["returns by weight"][:, s, :, 0]).sum(-1)
        valid = np.array([world.reports.scan.valid[0, s].sum() for world in flight.worlds])
        assert np.array_equal(seen, valid)
        assert valid.max() > 3
        _, _, ax, ay, bx, by = layers["gate"][-1, s, 0]
        inside = np.linalg.solve([[ax, bx], [ay, by]], layers["returns by weight"][-1, s, :, :2].T)
        lengths = np.hypot(*inside)
        assert (lengths[np.isfinite(lengths)] < 1.01).all()


@pytest.mark.filterwarnings("ignore::RuntimeWarning")
@pytest.mark.parametrize("spoil", SPOILT)
@pytest.mark.parametrize(("name", "family"), [("TwoStation", FusedEkf), ("AngleFusion", AnglePdaf)])
def test_a_diverged_track_still_gives_a_page(name, family, spoil):
    """Page and data hold no NaN but those that say that nothing is there."""
    scenario = SCENARIOS[name].replace(steps=5, tracker=spoilt_later(family, SPOILT[spoil]))
    told = record(scenario, flown(scenario, "straight"))
    page = replay_page(environment_id(name), 3, scenario.replay_axis, {"straight": told})
    data = page.partition('id="data">')[2].partition("</script>")[0]
    assert "NaN" not in data
    assert "Infinity" not in data
    for packed in json.loads(data)["policies"][0]["views"][0]["layers"].values():
        assert not np.isinf(np.frombuffer(base64.b64decode(packed["f32"]), dtype="<f4")).any()
    assert np.isfinite(told.views[0].layers["true targets"]).all()


# ------------------------------------------------------------------------------------------------ layers


def test_ellipse_rows_are_the_outlines_of_the_pictures():
    mean, cov = np.array([2e3, -1e3]), np.array([[9e6, 4e6], [4e6, 5e6]])
    middle, a, b = ellipse_rows(mean, cov).reshape(3, 2)
    angle = np.linspace(0.0, 2.0 * math.pi, 65)[:, None]
    outline = middle + np.cos(angle) * a + np.sin(angle) * b
    assert outline == pytest.approx(1e-3 * ellipses(mean, cov))
    off = 1e3 * outline - mean
    assert np.einsum("ni,ij,nj->n", off, np.linalg.inv(cov), off) == pytest.approx(ELLIPSE_STD**2)


def test_two_sigma_ellipses_hold_as_many_draws_as_theory_says():
    rng = np.random.default_rng(0)
    cov = np.array([[9.0, 4.0], [4.0, 5.0]])
    a, b = ellipse_rows(np.zeros(2), cov)[2:].reshape(2, 2)
    draws = rng.multivariate_normal(np.zeros(2), cov, size=20_000)
    inside = np.hypot(*np.linalg.solve(np.column_stack([a, b]), 1e-3 * draws.T)) < 1.0
    expected = chi2.cdf(ELLIPSE_STD**2, df=2)
    assert inside.mean() == pytest.approx(expected, abs=4.0 * math.sqrt(expected * (1.0 - expected) / 20_000))


def test_a_covariance_that_is_not_finite_gives_a_point():
    row = ellipse_rows(np.array([1e3, 2e3]), np.full((2, 2), np.nan))
    assert row.tolist() == [1.0, 2.0, 0.0, 0.0, 0.0, 0.0]


def test_circle_rows_are_the_outlines_of_the_pictures():
    centers, radii = np.array([[1e3, 2e3], [-4e3, 0.0]]), np.array([500.0, 2e3])
    rows = circle_rows(centers, radii)
    for row, outline in zip(rows, circles(centers, radii), strict=True):
        assert row[:2] + row[2:4] == pytest.approx(1e-3 * outline[0])
        assert row[:2] + row[4:] == pytest.approx(1e-3 * outline[16])


def test_points_of_a_range_sum_lie_on_its_ellipse():
    receiver, transmitter, total = np.array([1e3, 2e3]), np.array([30e3, -8e3]), 50e3
    middle, a, b = sum_axes(total, receiver, transmitter)
    for angle in (0.3, 2.0, 4.4):
        point = middle + math.cos(angle) * a + math.sin(angle) * b
        way = math.dist(point, receiver) + math.dist(point, transmitter)
        assert way == pytest.approx(total)
    outline = sum_ellipse(total, receiver, transmitter)
    assert outline[0] == pytest.approx(middle + a)
    assert outline[45] == pytest.approx(middle + b)


def test_the_ghost_has_the_first_two_range_sums():
    scenario = make_scenario("PassiveRadar", {"steps": 12, "dimensions": 2})
    ghosts = 0
    for world in flown(scenario, "fixed").worlds:
        scan, ghost = world.reports.scan, ghost_of(world)
        came = np.flatnonzero(scan.valid[0])[:2]
        for place in ghost:
            ghosts += 1
            sites, own = world.tape.transmitters[0, came, :2], world.platforms[0, 0, :2]
            sums = np.hypot(*(place - own)) + np.hypot(*(place - sites).T)
            assert sums == pytest.approx(scan.range_sums[0, came], rel=1e-6)
    assert ghosts > 0


def test_darts_point_along_velocities_and_have_none_at_rest():
    states = np.array([[1e3, 2e3, 0.0, 5.0], [0.0, 0.0, -3.0, 0.0], [5.0, 5.0, 0.0, 0.0]])
    assert course_deg(states)[:2].tolist() == [90.0, 180.0]
    assert np.isnan(course_deg(states)[2])
    assert dart_rows(states)[0].tolist() == [1.0, 2.0, 90.0]


def test_small_helpers():
    assert line_rows([[[1e3, 2e3], [3e3, 4e3]]]).tolist() == [[1.0, 2.0, 3.0, 4.0]]
    assert np.isnan(dot_rows(np.ones((2, 2)), np.array([0.5, 1e-4]))).all(-1).tolist() == [False, True]
    assert numbered("target", 1) == ("target",)
    assert numbered("target", 2) == ("target 1", "target 2")


def test_errors_are_of_the_score_first_and_of_the_range(pair):
    _, flights = pair
    metrics = flights["paper"].worlds[-1].metrics
    assert list(errors_of(metrics, "range")) == ["range"]
    with pytest.raises(AttributeError):
        errors_of(metrics, "no such score")


# ------------------------------------------------------------------------------------------------ stacking, packing


def test_stack_pads_what_comes_and_goes():
    rows = [np.ones((1, 2, 3)), None, np.full((2, 1, 3), np.inf)]
    stacked = stack(rows)
    assert stacked.shape == (3, 2, 2, 3)
    assert np.isfinite(stacked).sum() == 6
    assert (stacked[0, 0] == 1.0).all()


def test_stack_keeps_one_instant_of_what_never_changes():
    still = np.array([[[1.0, np.nan]]])
    assert stack([still, still, still]).shape == (1, 1, 1, 2)
    assert stack([still, still + 1.0]).shape == (2, 1, 1, 2)


def test_pack_is_little_endian_floats_with_a_shape():
    packed = pack(np.array([[1.5, -2.0], [np.inf, np.nan]]))
    values = np.frombuffer(base64.b64decode(packed["f32"]), dtype="<f4")
    assert packed["shape"] == (2, 2)
    assert values[:2].tolist() == [1.5, -2.0]
    assert np.isnan(values[2:]).all()


def view(**layers: np.ndarray) -> ViewRecord:
    return ViewRecord(
        "map", ("x", "y"), {}, True, {name.replace("_", " "): rows for name, rows in layers.items()}, None
    )


def test_the_frame_holds_what_must_be_seen_and_not_estimates():
    seen = view(
        platforms=np.array([[[[0.0, 0.0, 0.0]]], [[[60.0, 10.0, 0.0]]]]), estimates=np.array([[[[900.0, 0.0]]]])
    )
    frame: Any = frame_of([seen])
    assert (frame.low < [0.0, 0.0]).all()
    assert (frame.high > [60.0, 10.0]).all()
    assert frame.high[0] < 100.0


def test_points_of_lines_and_ellipses():
    assert points_of("expected courses", np.array([[[[1.0, 2.0, 3.0, 4.0]]]])).tolist() == [[1.0, 2.0], [3.0, 4.0]]
    disc = np.array([[[[0.0, 0.0, 3.0, 0.0, 0.0, 3.0]]]])
    assert points_of("no-go discs", disc).tolist() == [[-3.0, -3.0], [3.0, 3.0]]


def test_an_estimate_off_the_map_becomes_an_arrow_at_its_edge(pair):
    scenario, flights = pair
    told = record(scenario, flights["paper"])
    told.views[0].layers["estimates"][2, 1, 0] = 9e3, 12e3
    data = page_data("time [s]", {"paper": told})
    shown = data["policies"][0]["views"][0]
    packed = shown["layers"]["estimates off the map"]
    arrows = np.frombuffer(base64.b64decode(packed["f32"]), dtype="<f4").reshape(packed["shape"])
    frame = Frame(np.array(shown["frame"][:2]), np.array(shown["frame"][2:]))
    x, y, course, distance = arrows[2, 1, 0]
    middle = 0.5 * (frame.low + frame.high)
    estimates, slack = told.views[0].layers["estimates"], 0.02 * (frame.high - frame.low)
    inside = ((estimates >= frame.low + slack) & (estimates <= frame.high - slack)).all(-1)
    assert np.array_equal(np.isfinite(arrows).all(-1), ~inside)
    assert (frame.low < [x, y]).all()
    assert (frame.high > [x, y]).all()
    assert course == pytest.approx(math.degrees(math.atan2(12e3 - middle[1], 9e3 - middle[0])), abs=1e-3)
    assert distance == pytest.approx(math.dist((9e3, 12e3), middle), rel=1e-5)


# ------------------------------------------------------------------------------------------------ pages


def test_names_cannot_break_out_of_the_page(pair):
    scenario, flights = pair
    told = record(scenario, flights["paper"])
    evil = "</script><img src=x>"
    page = replay_page("passive/TwoStation-v0", 1, "time [s]", {evil: told})
    assert evil not in page
    data = re.search(r'<script type="application/json" id="data">(.*?)</script>', page, re.DOTALL)
    assert data is not None
    assert json.loads(data.group(1))["policies"][0]["name"] == evil


def test_the_page_needs_policies_of_the_same_episode(pair):
    scenario, flights = pair
    told = record(scenario, flights["paper"])
    with pytest.raises(ValueError, match="at least one policy"):
        replay_page("x", 0, "time [s]", {})
    other = told._replace(labels=told.labels[:-1])
    with pytest.raises(ValueError, match=r"records\['b'\] has 6 instants .* \(7\)"):
        replay_page("x", 0, "time [s]", {"a": told, "b": other})


def test_a_missing_plotly_names_the_command(pair, monkeypatch, tmp_path, capsys):
    for module in ("plotly", "plotly.offline"):
        monkeypatch.setitem(sys.modules, module, None)
    arguments = ["replay", "passive/TwoStation-v0", "--policies", "paper", "--out", str(tmp_path / "a.html")]
    assert cli.main(arguments) == 2
    assert 'python -m pip install "passive-env[web]"' in capsys.readouterr().err
    assert not (tmp_path / "a.html").exists()


# ------------------------------------------------------------------------------------------------ animations


def test_a_gif_shows_every_step_and_holds_the_last(pair, tmp_path):
    scenario, flights = pair
    path = write_animation(tmp_path / "a.gif", scenario, flights)
    with Image.open(path) as picture:
        frames = []
        for k in range(picture.n_frames):
            picture.seek(k)
            frames.append((np.asarray(picture.convert("L")), picture.info["duration"]))
    # equal frames at the end may be stored as one that lasts
    assert sum(duration for _, duration in frames) == pytest.approx((scenario.steps + 1 + HOLD) * 125, abs=20 * HOLD)
    assert len({pixels.tobytes() for pixels, _ in frames}) == scenario.steps + 1
    height, width = frames[0][0].shape
    assert width > 1.8 * height
    assert list(tmp_path.iterdir()) == [path]


def test_mp4_needs_ffmpeg_and_says_how_to_get_it(monkeypatch, tmp_path, capsys):
    monkeypatch.setattr(animation.writers, "is_available", lambda name: name != "ffmpeg")
    with pytest.raises(OSError, match=r"needs the program ffmpeg.*apt-get install ffmpeg.*--gif"):
        check_animation(tmp_path / "a.mp4")
    arguments = ["replay", "passive/TwoStation-v0", "--out", str(tmp_path / "a.html"), "--mp4", str(tmp_path / "a.mp4")]
    assert cli.main(arguments) == 2
    assert "ffmpeg" in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


def test_mp4_where_ffmpeg_is_there(pair, tmp_path):
    if not animation.writers.is_available("ffmpeg"):
        pytest.skip("ffmpeg is not installed")
    path = write_animation(tmp_path / "a.mp4", *pair)
    assert path.read_bytes()[4:8] == b"ftyp"


def test_an_animation_that_fails_leaves_no_file(pair, tmp_path):
    scenario, flights = pair
    broken = {name: flight._replace(worlds=[*flight.worlds[:2], None]) for name, flight in flights.items()}
    with pytest.raises(AttributeError):
        write_animation(tmp_path / "a.gif", scenario, broken)
    assert list(tmp_path.iterdir()) == []


def test_animations_refuse_other_files_and_no_policy(pair, tmp_path):
    with pytest.raises(ValueError, match=r"a.avi: must end in .gif or .mp4"):
        check_animation(tmp_path / "a.avi")
    with pytest.raises(ValueError, match="at least one policy"):
        write_animation(tmp_path / "a.gif", pair[0], {})


# ------------------------------------------------------------------------------------------------ the command


def test_the_command_writes_a_page_and_an_animation(tmp_path, capsys):
    page, gif = tmp_path / "new" / "a.html", tmp_path / "a.gif"
    arguments = [
        "replay", "passive/Ownship-v0", "--policies", "straight", "rule", "learned", "--seed", "4", "--fields",
        "steps=3", "--out", str(page), "--gif", str(gif),
    ]  # fmt: skip
    assert cli.main(arguments) == 0
    printed = capsys.readouterr().out
    assert str(page) in printed
    assert str(gif) in printed
    assert "passive/Ownship-v0: straight, rule, pretrained" in page.read_text(encoding="utf-8")
    assert gif.read_bytes()[:4] == b"GIF8"


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--out", "a.txt"], "--out a.txt: must be an HTML file"),
        (["--gif", "a.mp4"], "--gif a.mp4: must end in .gif"),
        (["--mp4", "a.gif"], "--mp4 a.gif: must end in .mp4"),
        (["--seed", "-1"], "--seed -1: must not be negative"),
        (["--policies", "nonsense"], "unknown policy 'nonsense'"),
        (["--policies"], "no policies to show"),
        (["--fields", "steps=0"], "TwoStation.steps = 0"),
    ],
)
def test_the_command_refuses_bad_input(arguments, message, capsys, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    assert cli.main(["replay", "passive/TwoStation-v0", *arguments]) == 2
    assert message in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


def test_an_older_page_is_replaced_whole(pair, tmp_path):
    from agents.replay import write_replay

    scenario, flights = pair
    path = atomic_write(tmp_path / "a.html", "old")
    write_replay(path, "passive/TwoStation-v0", 3, "time [s]", {"paper": record(scenario, flights["paper"])})
    assert path.read_text(encoding="utf-8").endswith("</html>\n")
