"""RadarPlacement: where actions put sensors, what the paper's layouts promise, policies, evaluation, bad input."""

import dataclasses
import math
from itertools import pairwise

import gymnasium as gym
import numpy as np
import pytest
from matplotlib.collections import QuadMesh

from agents.comparison import summarize
from agents.evaluation import fly, fly_all
from agents.placement import PLACEMENT, RULES, Promise, commands_of, layout_commands, spaced, stacked, stacked_or_even
from agents.placement_pictures import placement_cards, placement_maps
from agents.policy import make_policy, policy_names
from agents.report import as_markdown, write_evaluation
from agents.sb3 import Sb3VecEnv
from passive_env import PassiveEnv, PassiveVectorEnv
from passive_env.catalogue.placement import PAPER, RadarPlacement
from passive_env.core import map_rows
from passive_env.placement import (
    COURSES,
    Task,
    commands,
    course_prior,
    positions,
    representative_courses,
    seen_from_entry,
    site,
)
from trackers.consistency import mean_band
from trackers.converted_measurement import Layout

NAME = "RadarPlacement"


def begin(scenario=None, episodes=64, seed=0):
    scenario = scenario or RadarPlacement()
    simulation = scenario.make_simulation()
    return simulation, simulation.begin([np.random.default_rng(seed + i) for i in range(episodes)])


def task_of(scenario=None, episodes=64, seed=0) -> Task:
    return begin(scenario, episodes, seed)[1].tape.task


def place_all(simulation, world, layouts):
    """Worlds after every one of the commands [e, n, 3], with rewards."""
    steps = []
    for i in range(layouts.shape[1]):
        world, reward, _ = simulation.advance(world, layouts[:, i])
        steps.append((world, reward))
    return steps


# ------------------------------------------------------------------------------------------------ geometry


def test_the_papers_sensors_lie_where_it_puts_them():
    """Section 6: sensor i at target_xy + 200 km (cos(π + a), sin(π + a))."""
    a = np.radians([0.0, 20.0, -90.0])
    expected = np.array([200e3, 0.0]) + 200e3 * np.stack([np.cos(math.pi + a), np.sin(math.pi + a)], axis=-1)
    np.testing.assert_allclose(site(a, 200e3, 5e3, 200e3)[:, :2], expected, atol=1e-6)
    layouts = layout_commands(spaced(20.0), task_of(PAPER, 1), 2)
    np.testing.assert_allclose(positions(layouts, task_of(PAPER, 1))[0], [[0, 0, 0], [*expected[1], 0]], atol=1e-6)


def test_places_and_what_is_seen_from_the_entry_are_each_others_reverse():
    rng = np.random.default_rng(0)
    a, d, h = rng.uniform(-3.1, 3.1, 50), rng.uniform(1e5, 2e5, 50), rng.uniform(0, 2e4, 50)
    np.testing.assert_allclose(seen_from_entry(site(a, d, h, 2e5), 2e5), (a, d, h), rtol=1e-9)
    task = task_of()
    wanted = rng.uniform(-1.0, 1.0, (64, 4, 3))
    np.testing.assert_allclose(commands_of(positions(wanted, task), task), wanted, atol=1e-9)


def test_commands_outside_the_limits_go_to_the_nearest_limit():
    task = task_of(PAPER, 1)
    np.testing.assert_array_equal(commands(9.0, 1e9, -1e3, task), [[1.0, 0.0, -1.0]])  # its distance is fixed
    task = task_of(RadarPlacement(), 1)
    np.testing.assert_array_equal(commands(-9.0, 1e9, 1e9, task), [[-1.0, 1.0, 1.0]])


def test_every_action_keeps_to_the_limits_told():
    task = task_of(episodes=200)
    rng = np.random.default_rng(1)
    place = positions(rng.choice([-1.0, -0.3, 1.0], (200, 6, 3)), task)
    azimuth, distance, height = seen_from_entry(place, task.entry_distance_m[:, None])
    assert (np.abs(azimuth) <= task.azimuth_limit_rad[:, None] * (1 + 1e-12)).all()
    assert (distance >= task.distance_m[:, :1] * (1 - 1e-12)).all()
    assert (distance <= task.distance_m[:, 1:] * (1 + 1e-12)).all()
    assert (height >= 0.0).all()
    assert (height <= task.height_limit_m[:, None] * (1 + 1e-12)).all()


# ------------------------------------------------------------------------------------------------ courses


def test_targets_enter_inside_the_limits_told():
    _, world = begin(RadarPlacement(process_noise_m_s2=0.0), 500)
    task, start = world.tape.task, world.tape.targets[:, 0, 0]
    bearing = np.arctan2(start[:, 1], start[:, 0])
    off_site = np.arctan2(start[:, 4], start[:, 3]) - bearing - math.pi
    off_site = (off_site + math.pi) % (2.0 * math.pi) - math.pi
    speed = np.hypot(start[:, 3], start[:, 4])
    np.testing.assert_allclose(np.hypot(start[:, 0], start[:, 1]), 200e3)
    for value, low, high in (
        (bearing, -task.sector_rad, task.sector_rad),
        (off_site, -task.heading_rad, task.heading_rad),
        (start[:, 2], *task.altitude_m.T),
        (speed, *task.speed_m_s.T),
    ):
        share = (value - low) / (high - low)
        assert (share >= -1e-9).all()
        assert (share <= 1.0 + 1e-9).all()
        assert abs(share.mean() - 0.5) < 4.0 / math.sqrt(12 * 500)  # four standard errors of a uniform mean
    np.testing.assert_allclose(world.tape.targets[:, -1, 0, :3], start[:, :3] + 49.0 * start[:, 3:], rtol=1e-9)


@pytest.mark.parametrize(
    "fields",
    [
        {},
        {"entry_sector_min_deg": 30.0, "entry_sector_max_deg": 30.0, "heading_spread_max_deg": 60.0,
         "nearest_min_m": 200e3},
        {"entry_sector_min_deg": 2.0, "entry_sector_max_deg": 2.0, "process_noise_m_s2": 20.0},
    ],
)  # fmt: skip
def test_the_prior_of_the_last_state_has_the_moments_of_what_is_drawn(fields):
    """NEES of true last states; its spread about the mean is no wider than that of normal numbers."""
    scenario = RadarPlacement(**fields)
    _, world = begin(scenario, 2000)
    prior = course_prior(world.tape.task, scenario.scans, scenario.step_s, scenario.process_noise_m_s2)
    error = prior.mean - world.truth[:, 0]
    nees = np.einsum("ei,ei->e", error, np.linalg.solve(prior.cov, error[..., None])[..., 0])
    low, high = mean_band(6, 2000)
    assert low < nees.mean() < high


def test_representative_courses_have_the_moments_of_a_uniform_sector():
    task = task_of(episodes=3)
    start = representative_courses(task, 50, 1.0)[:, :, 0]
    bearing = np.arctan2(start[..., 1], start[..., 0])
    weight = np.array([w for _, w in COURSES])
    assert weight.sum() == pytest.approx(1.0)
    for power, moment in ((1, 0.0), (2, 1 / 3), (4, 1 / 5)):
        np.testing.assert_allclose((weight * bearing**power).sum(-1), moment * task.sector_rad**power, atol=1e-12)


def test_recorded_flights_enter_where_and_as_drawn():
    scenario = RadarPlacement(course="flights")
    _, world = begin(scenario, 20)
    path, task = world.tape.targets[:, :, 0], world.tape.task
    assert np.hypot(path[:, 0, 0], path[:, 0, 1]) == pytest.approx(200e3)
    assert (path[:, 0, 2] >= task.altitude_m[:, 0] - 1e-9).all()
    assert (path[:, 0, 2] <= task.altitude_m[:, 1] + 1e-9).all()
    assert (path[..., 2] >= 0.0).all()
    assert np.isfinite(path).all()


# ------------------------------------------------------------------------------------------------ the episode


def test_error_halves_with_20_deg_between_two_radars():
    """Section 7: 0.71 of one sensor's error for the co-located pair, 0.51 for the 20° pair."""
    single = np.exp(Promise(PAPER.replace(steps=1))(task_of(PAPER, 1), np.array([[[[0.0, 0.0, -1.0]]]])))[0, 0]
    task = task_of(PAPER, 1)
    ratio = lambda step: np.exp(Promise(PAPER)(task, layout_commands(spaced(step), task, 2)[:, None]))[0, 0] / single  # noqa: E731
    assert ratio(0.0) == pytest.approx(0.708, abs=0.01)
    assert ratio(20.0) == pytest.approx(0.506, abs=0.01)
    assert ratio(90.0) == pytest.approx(0.516, abs=0.01)


def test_figures_are_those_of_the_tracker_run_alone():
    """The kernels called episode by episode: the other route to bound, estimate and scored error."""
    scenario = RadarPlacement(angle_only=1)
    simulation, world = begin(scenario, 5)
    layouts = np.random.default_rng(3).uniform(-1.0, 1.0, (5, 3, 3))
    steps = place_all(simulation, world, layouts)
    tape, fusion = world.tape, scenario.make_tracker()
    for i in range(5):
        task = Task(*(part[i : i + 1] for part in tape.task))
        place = positions(layouts[i : i + 1], task)[0]
        ranging = np.array([True, True, False])
        for count, (after, _) in enumerate(steps, start=1):
            layout = Layout(place[:count], np.tile(task.std[0], (count, 1)), ranging[:count])
            theory = fusion.theoretical(tape.targets[i, :, 0], layout)
            assert after.metrics.position_crlb_m[i, 0] == pytest.approx(theory.position_std_m[-1], rel=1e-12)
        track = fusion.track(tape.targets[i, :, 0], layout, tape.noise[i])
        done = steps[-1][0]
        np.testing.assert_allclose(done.estimate.mean[i, 0], track.mean[-1], rtol=1e-12)
        assert done.metrics.position_error_m[i, 0] == pytest.approx(track.position_error_m[-10:].mean(), rel=1e-12)
        assert done.metrics.track_error_m[i, 0] == pytest.approx(track.position_error_m.mean(), rel=1e-12)


def test_the_default_reward_is_the_log_error_in_the_last_step():
    simulation, world = begin()
    steps = place_all(simulation, world, np.random.default_rng(0).uniform(-1, 1, (64, 3, 3)))
    assert all((reward == 0.0).all() for _, reward in steps[:-1])
    done, reward = steps[-1]
    np.testing.assert_allclose(reward, -np.log(np.maximum(done.metrics.position_error_m[:, 0], 30.0) / 1e3))


def test_gains_add_up_to_the_whole_reduction_of_the_promised_error():
    scenario = RadarPlacement(reward_position_gain=1.0, reward_final_log_position_error=0.0)
    simulation, world = begin(scenario)
    steps = place_all(simulation, world, np.random.default_rng(0).uniform(-1, 1, (64, 3, 3)))
    before, after = (w.metrics.position_crlb_m[:, 0] for w in (world, steps[-1][0]))
    np.testing.assert_allclose(sum(reward for _, reward in steps), np.log(before / after), rtol=1e-9)
    for _, reward in steps[1:]:
        assert (reward > 0.0).all()  # a further sensor never takes information away


def test_more_sensors_promise_less_error_and_the_promise_holds():
    """RMS of 2,000 scored errors of the exact linearisation's theory, within the paper's 10 % of the prediction's."""
    scenario = PAPER.replace(scored_scans=1)
    simulation, world = begin(scenario, 2000)
    layouts = layout_commands(spaced(20.0), world.tape.task, 2)
    (first, _), (done, _) = place_all(simulation, world, layouts)
    assert (first.metrics.position_crlb_m > done.metrics.position_crlb_m).all()
    rms = math.sqrt(np.square(done.metrics.position_error_m).mean())
    promised = math.sqrt(np.square(done.metrics.position_crlb_m).mean())
    assert 0.97 < rms / promised < 1.2


def test_the_truth_does_not_show_before_the_track_is_run():
    simulation, world = begin()
    moved = world.tape._replace(targets=world.tape.targets + 500.0, noise=-world.tape.noise)
    other = world._replace(tape=moved, truth=world.truth + 500.0)
    layouts = np.random.default_rng(0).uniform(-1, 1, (64, 3, 3))
    flown = ([w for w, _ in place_all(simulation, x, layouts)] for x in (world, other))
    pairs = [(world, other), *zip(*flown, strict=True)]
    for ours, theirs in pairs:
        np.testing.assert_array_equal(simulation.observe(ours), simulation.observe(theirs))
    for ours, theirs in pairs[:-1]:
        map_rows(np.testing.assert_array_equal, simulation.belief(ours), simulation.belief(theirs))


def test_advancing_changes_no_world_in_place():
    simulation, world = begin(episodes=4)
    kept = map_rows(np.copy, world)
    for _ in range(2):
        after, _, _ = simulation.advance(world, np.full((4, 3), 0.5))
    place_all(simulation, after, np.full((4, 2, 3), -0.5))
    map_rows(np.testing.assert_array_equal, world, kept)


@pytest.mark.parametrize("course", ["random", "flights"])
def test_a_wide_batch_equals_its_singles_bit_for_bit(course):
    env = PassiveVectorEnv(NAME, num_envs=140, course=course, threads=2)
    observation, info = env.reset(seed=50)
    actions = np.random.default_rng(5).uniform(-1, 1, (3, 140, 3)).astype(np.float32)
    wide = [(observation, np.zeros(140), info)]
    for action in actions:
        observation, reward, _, _, info = env.step(action)
        wide.append((observation, reward, info))
    for row in range(0, 140, 9):
        single = PassiveEnv(NAME, course=course)
        calls = [(*single.reset(seed=50 + row)[:1], 0.0, single.reset(seed=50 + row)[1])]
        calls += [(step[0], step[1], step[4]) for step in map(single.step, actions[:, row])]
        for ours, theirs in zip(wide, calls, strict=True):
            np.testing.assert_array_equal(ours[0][row], theirs[0])
            assert ours[1][row] == theirs[1]
            for name in ("range_error_m", "position_error_m", "range_m", "range_crlb_m", "nees", "position_crlb_m"):
                assert ours[2][name][row] == theirs[2][name], name
        map_rows(lambda a, b, row=row: np.testing.assert_array_equal(a[row], b[0]), env.world.tape, single.world.tape)


def test_episodes_out_of_step_are_those_in_step():
    """Partial resets leave sub-environments with different numbers of sensors."""
    env = PassiveVectorEnv(NAME, num_envs=2, autoreset_mode="disabled", threads=1)
    actions = np.random.default_rng(0).uniform(-1, 1, (4, 2, 3)).astype(np.float32)
    env.reset(seed=7)
    env.step(actions[0])
    env.reset(seed=[None, 99], options={"reset_mask": np.array([False, True])})
    env.step(actions[1])
    *_, info = env.step(actions[2])
    single = PassiveEnv(NAME)
    single.reset(seed=7)
    for action in actions[:3]:
        *_, expected = single.step(action[0])
    for name in ("position_error_m", "position_crlb_m", "range_error_m", "nees"):
        assert info[name][0] == expected[name]


# ------------------------------------------------------------------------------------------------ policies


@pytest.mark.parametrize("steps", [2, 3, 4])
def test_policies_decide_within_limits_and_by_the_belief_alone(steps):
    scenario = RadarPlacement(steps=steps)
    simulation, world = begin(scenario, 3)
    for name in policy_names(scenario):
        policy, at = make_policy(name, scenario), world
        policy.reset(simulation.belief(at))
        for _ in range(steps if name != "optimizer" else 1):
            belief = simulation.belief(at)
            command = policy.act(belief, simulation.observe(at))
            assert command.shape == (3, 3)
            assert (np.abs(command) <= 1.0 + 1e-12).all()
            at, _, _ = simulation.advance(at, command)


def test_the_search_promises_no_more_than_any_rule_or_greedy():
    scenario = RadarPlacement()
    simulation, world = begin(scenario, 3, seed=10)
    promise, task = Promise(scenario), world.tape.task
    found = {}
    for name in ("optimizer", "greedy", "rule_best"):
        policy, at = make_policy(name, scenario), world
        policy.reset(simulation.belief(at))
        layout = []
        for _ in range(3):
            layout.append(policy.act(simulation.belief(at), None))
            at, _, _ = simulation.advance(at, layout[-1])
        found[name] = promise(task, np.stack(layout, axis=1)[:, None])[:, 0]
    rules = [promise(task, layout_commands(rule, task, 3)[:, None])[:, 0] for rule in RULES]
    np.testing.assert_allclose(found["rule_best"], np.min(rules, axis=0), rtol=1e-12)
    assert (found["optimizer"] <= found["rule_best"] + 1e-9).all()
    assert (found["optimizer"] <= found["greedy"] + 1e-3).all()


def test_stacking_pays_where_elevation_is_measured_worse():
    """Section 10: σβ = 2°, σθ = 1°: 0.640 of a single sensor for the 20° pair, 0.425 one above the other."""
    worse = PAPER.replace(elevation_std_min_deg=2.0, elevation_std_max_deg=2.0)
    promise, task = Promise(worse), task_of(worse, 1)
    pair, stack, rule = (
        np.exp(promise(task, layout_commands(r, task, 2)[:, None]))[0, 0]
        for r in (spaced(20.0), stacked, stacked_or_even)
    )
    assert stack / pair == pytest.approx(0.425 / 0.640, abs=0.02)
    assert rule == stack


def test_greedy_chooses_the_same_whatever_the_batch():
    scenario = RadarPlacement()
    simulation, world = begin(scenario, 20)
    policy = make_policy("greedy", scenario)
    whole = policy.act(simulation.belief(world), None)
    part = policy.act(simulation.belief(map_rows(lambda a: a[11:13], world)), None)
    np.testing.assert_array_equal(whole[11:13], part)


# ------------------------------------------------------------------------------------------------ evaluation


def test_records_have_a_column_per_scan():
    scenario = RadarPlacement(scans=12, scored_scans=4)
    record = fly(scenario, make_policy("even", scenario), 5, 0)
    assert record.error_m.shape == record.bound_m.shape == record.range_error_m.shape == (5, 12)
    np.testing.assert_allclose(record.scored_error_m, record.error_m[:, -4:].mean(1), rtol=1e-12)
    assert record.state_size == 6


def test_an_evaluation_writes_tables_and_placement_maps(tmp_path):
    scenario = RadarPlacement(scans=10)
    policies = {name: make_policy(name, scenario) for name in ("paper", "rule")}
    records = fly_all(scenario, policies, 4, 0, progress=False)
    summary = summarize("passive/RadarPlacement-v0", 0, records)
    files = write_evaluation(tmp_path, summary, records, scenario)
    names = {file.name for file in files}
    assert names == {
        "evaluation.json", "evaluation.csv", "evaluation.md", "position_error_over_time.png", "placement.png",
    }  # fmt: skip
    assert "last scans" in as_markdown(summary)


def test_maps_show_every_policys_last_sensor_and_the_papers():
    scenario = RadarPlacement(scans=10)
    worlds = {}
    for name in ("paper", "rule"):
        simulation, world = begin(scenario, 1, seed=2)
        policy = make_policy(name, scenario)
        policy.reset(simulation.belief(world))
        for _ in range(3):
            world, _, _ = simulation.advance(world, policy.act(simulation.belief(world), None))
        worlds[name] = world
    figure = placement_maps(worlds, scenario, "two policies")
    maps = [axes for axes in figure.axes if axes.get_title(loc="left")]
    assert [axes.get_title(loc="left").split(":")[0] for axes in maps] == ["paper", "rule"]
    paper = 1e-3 * worlds["paper"].platforms[0, -1, :2]
    for axes in maps:
        crosses = [line for line in axes.lines if line.get_marker() == "x"]
        np.testing.assert_allclose([line.get_xydata()[0] for line in crosses], [paper])
    cards = placement_cards(worlds, scenario)
    assert list(cards) == ["paper", "rule"]
    for card, axes in zip(cards.values(), maps, strict=True):
        (mesh,), (same,) = card.axes[0].findobj(QuadMesh), axes.findobj(QuadMesh)
        np.testing.assert_array_equal(mesh.get_array(), same.get_array())
        assert mesh.get_clim() == same.get_clim()
        assert card.axes[0].get_title(loc="left") == axes.get_title(loc="left")


def test_learners_see_it():
    env = Sb3VecEnv(PassiveVectorEnv(NAME, num_envs=3, autoreset_mode="same_step", threads=1))
    env.reset()
    for _ in range(3):
        _, _, done, infos = env.step(np.zeros((3, 3), np.float32))
    assert done.all()
    assert infos[0]["episode"]["l"] == 3
    assert infos[0]["terminal_observation"].shape == env.observation_space.shape


# ------------------------------------------------------------------------------------------------ pictures


def test_the_picture_shows_sensors_as_they_are_placed():
    env = gym.make("passive/RadarPlacement-v0", render_mode="rgb_array", angle_only=1)
    env.reset(seed=0)
    pictures = [env.render()]
    for action in ((-0.5, 0.0, 0.0), (0.5, 0.0, 1.0), (0.0, 1.0, -1.0)):
        env.step(np.array(action, np.float32))
        pictures.append(env.render())
    assert all(picture.shape == (800, 800, 3) and picture.dtype == np.uint8 for picture in pictures)
    assert all((a != b).any() for a, b in pairwise(pictures))


# ------------------------------------------------------------------------------------------------ bad input


@pytest.mark.parametrize(
    ("fields", "words"),
    [
        ({"height_limit_min_m": -10.0}, "height_limit_min_m"),
        ({"range_std_min_m": 0.0}, "range_std_min_m"),
        ({"azimuth_std_min_deg": -1.0}, "azimuth_std_min_deg"),
        ({"elevation_std_max_deg": math.nan}, "elevation_std_max_deg"),
        ({"azimuth_limit_min_deg": 90.0, "azimuth_limit_max_deg": 45.0}, "azimuth_limit_min_deg = 90.0: must"),
        ({"nearest_max_m": 220e3}, "nearest_max_m = 220000.0: must not exceed farthest_min_m"),
        ({"height_limit_min_m": 5e3, "height_limit_max_m": 1e3}, "must not exceed height_limit_max_m"),
        ({"steps": 5}, "steps = 5"),
        ({"angle_only": 4}, "angle_only = 4: must not exceed steps"),
        ({"scored_scans": 51}, "scored_scans = 51: must not exceed scans"),
        ({"nearest_min_m": 40e3}, "nearest_min_m = 40000.0: a target may enter"),
        ({"minimum_range_m": 1e5}, "to stay beyond minimum_range_m = 100000 of every sensor"),
        ({"range_std_max_m": 1e4}, "beyond 10 range_std_max_m = 100000"),
        ({"tracker": "truth"}, "tracker = 'truth'"),
        ({"flights": "x.csv"}, "add course='flights'"),
    ],
)  # fmt: skip
def test_bad_fields_are_refused_by_name(fields, words):
    with pytest.raises(ValueError) as caught:
        RadarPlacement(**fields)
    assert words in str(caught.value)


def test_a_recorded_flight_that_could_come_too_close_is_refused():
    near = RadarPlacement().replace(course="flights", nearest_min_m=45e3, target_speed_max_m_s=201.0, scans=30)
    with pytest.raises(ValueError, match="nearest_min_m"):
        near.replace(minimum_range_m=3e3).check_flights()


@pytest.mark.parametrize("action", [np.zeros(2), [np.nan, 0, 0], [np.inf, 0, 0]], ids=str)
def test_bad_actions_are_refused(action):
    env = PassiveEnv(NAME)
    env.reset(seed=0)
    with pytest.raises(ValueError, match="action"):
        env.step(action)


def test_every_policy_is_offered():
    assert policy_names(RadarPlacement()) == [*PLACEMENT, "random"]
    assert {f.name for f in dataclasses.fields(RadarPlacement)} >= {"steps", "scans", "angle_only"}
