"""MobilePlacement: how carriers move, what the track is, what moving is worth, policies, bad input."""

import math
from itertools import pairwise

import numpy as np
import pytest
from scipy.stats import t as student
from twin_worlds import SHIFT, assert_twins_look_alike, fly_twins, random_decisions

from agents.comparison import summarize
from agents.evaluation import fly, fly_all
from agents.mobile_placement import BestStatic, Formation, Greedy, Static, StaticPromise, tracked
from agents.placement import RULES, commands_of, even, layout_commands
from agents.policy import make_policy, policy_names
from agents.report import as_markdown, write_evaluation
from passive_env import PassiveEnv, PassiveVectorEnv
from passive_env.catalogue.mobile_placement import MobilePlacement
from passive_env.core import map_rows
from passive_env.mobile_observation import course_of
from passive_env.mobile_simulation import drive, routes, wanted
from passive_env.placement import entry_prior, seen_from_entry
from trackers.consistency import mean_band
from trackers.converted_fusion import ConvertedFusion
from trackers.converted_measurement import Layout

NAME = "MobilePlacement"
KINDS = ("continuous", "velocities")


def begin(scenario=None, episodes=16, seed=0):
    scenario = scenario or MobilePlacement()
    simulation = scenario.make_simulation()
    return simulation, simulation.begin([np.random.default_rng(seed + i) for i in range(episodes)])


def play(simulation, world, commands):
    """Worlds after every one of the commands [k, e, a]."""
    worlds = []
    for command in commands:
        world, _, _ = simulation.advance(world, command)
        worlds.append(world)
    return worlds


def random_commands(scenario, episodes=16, seed=3):
    return np.random.default_rng(seed).uniform(-1.0, 1.0, (scenario.steps, episodes, 3 * scenario.sensors))


# ------------------------------------------------------------------------------------------------ carriers


def test_the_first_action_installs_and_later_ones_move_within_the_limits():
    scenario = MobilePlacement(steps=12, climb_rate_m_s=7.0)
    simulation, world = begin(scenario)
    commands = random_commands(scenario)
    worlds = play(simulation, world, commands)
    np.testing.assert_allclose(worlds[0].platforms[..., :3], wanted(commands[0], world.tape.task), rtol=1e-12)
    assert (worlds[0].platforms[..., 3:] == 0.0).all()
    for before, after, command in zip(worlds, worlds[1:], commands[1:], strict=False):
        goal = wanted(command, world.tape.task)
        moved = after.platforms[..., :3] - before.platforms[..., :3]
        level = np.hypot(moved[..., 0], moved[..., 1])
        left = np.hypot(*np.moveaxis((goal - before.platforms[..., :3])[..., :2], -1, 0))
        np.testing.assert_allclose(level, np.minimum(left, 1500.0), rtol=1e-9)
        turn = moved[..., 0] * (goal - before.platforms[..., :3])[..., 1]
        turn -= moved[..., 1] * (goal - before.platforms[..., :3])[..., 0]
        np.testing.assert_allclose(turn / (level * left), 0.0, atol=1e-9)  # straight
        climb = goal[..., 2] - before.platforms[..., 2]
        np.testing.assert_allclose(moved[..., 2], np.clip(climb, -70.0, 70.0), atol=1e-8)
        np.testing.assert_allclose(after.platforms[..., 3:], moved / 10.0, atol=1e-8)


def test_carriers_arrive_and_stay():
    place = np.array([[[0.0, 0.0, 100.0, 0.0, 0.0, 0.0]]])
    goal = np.array([[[2000.0, -1500.0, 350.0]]])
    for wanted_level in (1500.0, 2500.0, 2500.0):
        place = drive(place, goal, False, 150.0, 10.0, 10.0)
        assert math.hypot(*place[0, 0, :2]) == pytest.approx(wanted_level)
    np.testing.assert_array_equal(place[0, 0], [2000.0, -1500.0, 350.0, 0.0, 0.0, 5.0])
    assert (drive(place, goal, False, 150.0, 10.0, 10.0)[..., 3:] == 0.0).all()


def test_carriers_on_the_ground_stay_there_and_are_slow():
    scenario = MobilePlacement(carrier="ground", steps=8)
    simulation, world = begin(scenario)
    worlds = play(simulation, world, random_commands(scenario))
    for before, after in pairwise(worlds):
        assert (after.platforms[..., [2, 5]] == 0.0).all()
        moved = np.linalg.norm(after.platforms[..., :2] - before.platforms[..., :2], axis=-1)
        np.testing.assert_allclose(moved, 200.0)


def test_routes_are_what_carriers_drive():
    rng = np.random.default_rng(0)
    place = rng.uniform(-1e4, 1e4, (7, 3, 6))
    goal = rng.uniform(-1e4, 1e4, (7, 3, 3))
    planned = routes(place, goal, False, 150.0, 10.0, 10.0, np.empty(9))
    for k in range(9):
        place = drive(place, goal, False, 150.0, 10.0, 10.0)
        np.testing.assert_array_equal(planned[:, k], place[..., :3])
    assert (routes(place, goal, True, 150.0, 10.0, 10.0, np.empty(2)) == goal[:, None]).all()


def test_no_action_leads_out_of_where_sensors_are_sent_or_under_ground():
    scenario = MobilePlacement(steps=30)
    simulation, world = begin(scenario)
    task = world.tape.task
    for after in play(simulation, world, np.sign(random_commands(scenario))):
        _, distance, height = seen_from_entry(after.platforms[..., :3], task.entry_distance_m[:, None])
        assert (height >= 0.0).all()
        assert (height <= task.height_limit_m[:, None] * (1 + 1e-12)).all()
        assert (distance <= task.distance_m[:, 1:] * (1 + 1e-9)).all()


# ------------------------------------------------------------------------------------------------ the track


@pytest.mark.parametrize("fields", [{}, {"angle_only": 1}, {"tracker": "iterated"}], ids=str)
def test_a_constant_action_is_the_static_layout_of_the_whole_episodes_filter(fields):
    """The kernel that runs a whole episode, on the same noise: the other route to every figure."""
    scenario = MobilePlacement(steps=25, nearest_min_m=100e3, **fields)
    simulation, world = begin(scenario, 6)
    tape = world.tape
    command = layout_commands(even, tape.task, 3)
    worlds = play(simulation, world, [command.reshape(6, -1)] * 25)
    whole = ConvertedFusion(step_s=10.0, acceleration_std=0.3, linearisation=scenario.tracker)
    std = np.broadcast_to(tape.task.std[:, None], (6, 3, 3))
    layout = Layout(wanted(command.reshape(6, -1), tape.task), std, scenario.ranging)
    path = tape.targets[:, 1:, 0]
    track, theory = whole.track(path, layout, tape.noise[:, 1:]), whole.theoretical(path, layout)
    for k, after in enumerate(worlds):
        np.testing.assert_array_equal(after.platforms[..., :3], worlds[0].platforms[..., :3])
        np.testing.assert_allclose(after.estimate.mean[:, 0], track.mean[:, k], rtol=1e-12, atol=1e-6)
        np.testing.assert_allclose(after.estimate.cov[:, 0], track.cov[:, k], rtol=1e-9, atol=1e-6)
        np.testing.assert_allclose(after.metrics.position_error_m[:, 0], track.position_error_m[:, k], rtol=1e-8)
        np.testing.assert_allclose(after.metrics.position_crlb_m[:, 0], theory.position_std_m[:, k], rtol=1e-12)


def test_the_bound_follows_the_sensors_true_places():
    """The whole course's theory with sensors that move, in one call."""
    scenario = MobilePlacement(steps=20)
    simulation, world = begin(scenario, 6)
    worlds = play(simulation, world, random_commands(scenario, 6))
    tape, place = world.tape, np.stack([after.platforms[..., :3] for after in worlds], axis=1)
    layout = Layout(place, np.broadcast_to(tape.task.std[:, None], (6, 3, 3)), scenario.ranging)
    whole = ConvertedFusion(step_s=10.0, acceleration_std=0.3)
    theory = whole.theoretical(tape.targets[:, 1:, 0], layout, moving=True)
    bound = np.stack([after.metrics.position_crlb_m[:, 0] for after in worlds], axis=1)
    np.testing.assert_allclose(bound, theory.position_std_m, rtol=1e-12)


def test_a_sensor_does_not_measure_a_target_that_is_too_close():
    scenario = MobilePlacement(steps=40)
    simulation, world = begin(scenario, 8)
    tape, near = world.tape, 0
    for _ in range(40):
        ahead = tape.targets[np.arange(8), np.minimum(world.step + 1, 40), 0, :3]
        goal = ahead[:, None] + np.array([[0.0, 0.0, 0.0], [2e4, 0.0, 0.0], [-2e4, 2e4, 0.0]])
        world, _, _ = simulation.advance(world, commands_of(goal, tape.task).reshape(8, -1))
        distance = np.linalg.norm(world.platforms[..., :3] - world.truth[..., :3], axis=-1)
        np.testing.assert_array_equal(world.reports.measured, distance >= 5e3)
        near += int((distance < 5e3).sum())
        assert np.isfinite(world.estimate.mean).all()
        assert (world.metrics.position_error_m[world.step > 5] < 5e3).all()
    assert near > 10


def test_the_track_is_nearly_honest():
    """NEES of 300 runs with the filter's own motion; evaluated at the prediction it is up to 1.7 of the ideal."""
    scenario = MobilePlacement(steps=30)
    simulation, world = begin(scenario, 300)
    command = layout_commands(even, world.tape.task, 3).reshape(300, -1)
    last = play(simulation, world, [command] * 30)[-1]
    low, high = mean_band(6, 300)
    assert low < last.metrics.nees.mean() < 1.7 * high
    assert last.metrics.lost.mean() < 0.01


@pytest.mark.parametrize("course", ["random", "flights"])
def test_targets_enter_as_expected_and_the_prior_is_honest(course):
    scenario = MobilePlacement(course=course, process_noise_m_s2=0.0)
    _, world = begin(scenario, 600 if course == "random" else 40)
    start, task = world.tape.targets[:, 0, 0], world.tape.task
    assert np.hypot(start[:, 0], start[:, 1]) == pytest.approx(200e3)
    assert (start[:, 2] >= task.altitude_m[:, 0] - 1e-9).all()
    assert (start[:, 2] <= task.altitude_m[:, 1] + 1e-9).all()
    assert np.isfinite(world.tape.targets).all()
    if course == "random":
        assert world.metrics.nees.mean() == pytest.approx(5.0, abs=0.5)  # of six numbers one, the climb, is known


def test_drawn_targets_stay_above_ground_and_move_as_their_velocities_say():
    """Ten minutes of white acceleration would lead every sixth one under ground."""
    _, world = begin(MobilePlacement(), 200)
    x = world.tape.targets[:, :, 0]
    assert (x[..., 2] >= -1e-6).all()
    assert 10 < (x[..., 2].min(axis=1) < 1e-6).sum() < 70
    np.testing.assert_allclose(np.diff(x[..., :3], axis=1), 5.0 * (x[:, 1:, 3:] + x[:, :-1, 3:]), atol=1e-6)


def test_what_is_expected_of_the_entry_has_the_moments_of_what_is_drawn():
    scenario = MobilePlacement(process_noise_m_s2=0.0)
    _, world = begin(scenario, 1)
    runs = 40_000
    task = map_rows(lambda part: np.repeat(part, runs, axis=0), world.tape.task)
    start = scenario._draw_path(task, np.random.default_rng(5).random((runs, 5)), np.zeros((runs, 1, 3)))[:, 0]
    prior = entry_prior(world.tape.task)
    spread = np.sqrt(np.diagonal(prior.cov[0]))
    np.testing.assert_allclose((start.mean(0) - prior.mean[0]) / spread, 0.0, atol=4.5 / math.sqrt(runs))
    scaled = np.cov(start.T) / np.outer(spread, spread)
    wanted_ = prior.cov[0] / np.outer(spread, spread)
    wanted_[5, 5] = 0.0  # the climb is 0, its decimetre per second a care of the filter's
    np.testing.assert_allclose(scaled, wanted_, atol=0.03)


def test_observations_do_not_change_when_the_truth_behind_the_same_measurements_does(monkeypatch):
    first, second = fly_twins(monkeypatch, MobilePlacement(steps=20), random_decisions(), range(4))
    np.testing.assert_allclose((second.truth[9] - first.truth[9])[:, 0, [0, 1]], np.tile(SHIFT[:2], (4, 1)), atol=1e-6)
    assert_twins_look_alike(first, second)


def test_advancing_changes_no_world_in_place():
    scenario = MobilePlacement(steps=6)
    simulation, world = begin(scenario, 4)
    kept = map_rows(np.copy, world)
    worlds = play(simulation, world, random_commands(scenario, 4))
    again = map_rows(np.copy, worlds[2])
    simulation.advance(worlds[2], np.zeros((4, 9)))
    map_rows(np.testing.assert_array_equal, world, kept)
    map_rows(np.testing.assert_array_equal, worlds[2], again)


@pytest.mark.parametrize("fields", [{}, {"course": "flights"}, {"actions": "velocities"}], ids=str)
def test_a_wide_batch_equals_its_singles_bit_for_bit(fields):
    fields = {"steps": 8, **fields}
    env = PassiveVectorEnv(NAME, num_envs=140, threads=2, **fields)
    observation, info = env.reset(seed=50)
    actions = np.random.default_rng(5).uniform(-1, 1, (8, 140, 9)).astype(np.float32)
    wide = [(observation, np.zeros(140), info)]
    for action in actions:
        observation, reward, _, _, info = env.step(action)
        wide.append((observation, reward, info))
    for row in range(0, 140, 9):
        single = PassiveEnv(NAME, **fields)
        first = single.reset(seed=50 + row)
        calls = [(first[0], 0.0, first[1])] + [(c[0], c[1], c[4]) for c in map(single.step, actions[:, row])]
        for ours, theirs in zip(wide, calls, strict=True):
            np.testing.assert_array_equal(ours[0][row], theirs[0])
            assert ours[1][row] == theirs[1]
            for name in ("range_error_m", "position_error_m", "range_m", "range_crlb_m", "nees", "position_crlb_m"):
                assert ours[2][name][row] == theirs[2][name], name


# ------------------------------------------------------------------------------------------------ actions and mirror


def mirrored(world):
    """The world with left and right exchanged."""
    odd = np.array([1.0, -1.0, 1.0, 1.0, -1.0, 1.0])
    tape = world.tape._replace(targets=world.tape.targets * odd, noise=world.tape.noise * [1.0, -1.0, 1.0])
    return world._replace(tape=tape, truth=world.truth * odd)


@pytest.mark.parametrize("actions", KINDS)
def test_mirrored_actions_in_the_mirrored_world_show_the_mirror_image(actions):
    scenario = MobilePlacement(steps=10, actions=actions)
    simulation, world = begin(scenario)
    other, codec = mirrored(world), simulation.actions
    assert not np.array_equal(other.truth, world.truth)
    for action in random_commands(scenario):
        image = codec.mirrored(action)
        world, reward, _ = simulation.advance(world, simulation.command(world, action))
        other, reward_, _ = simulation.advance(other, simulation.command(other, image))
        shown = simulation.observation.mirrored(simulation.observe(world))
        np.testing.assert_allclose(simulation.observe(other), shown, atol=2e-4)
        np.testing.assert_allclose(reward, reward_, rtol=1e-6)


def test_velocities_say_where_to_go_from_here():
    """Ahead and left of a target that flies west: west and south; a step's way is cut to what a carrier can go."""
    simulation, world = begin(MobilePlacement(actions="velocities", process_noise_m_s2=0.0), 1)
    still = np.zeros((1, 9))
    for _ in range(3):
        world, _, _ = simulation.advance(world, simulation.command(world, still))
    mean = world.estimate.mean.copy()
    mean[..., 3:] = [-200.0, 0.0, 0.0]
    world = world._replace(estimate=world.estimate._replace(mean=mean))
    here = world.platforms[0, :, :3]
    action = np.array([[0.5, 0.0, 0.0, 0.0, 0.25, 1.0, 1.0, 1.0, 0.0]])
    after, _, _ = simulation.advance(world, simulation.command(world, action))
    moved = after.platforms[0, :, :3] - here
    np.testing.assert_allclose(moved[0], [-750.0, 0.0, 0.0], atol=1e-6)
    np.testing.assert_allclose(moved[1], [0.0, -375.0, 100.0], atol=1e-6)
    np.testing.assert_allclose(moved[2], [-1500.0 * math.sqrt(0.5), -1500.0 * math.sqrt(0.5), 0.0], atol=1e-6)


def test_velocities_lead_across_what_is_too_near():
    """A carrier at the nearest place from the entry, 40 km off, told to fly through it: straight, at top speed."""
    scenario = MobilePlacement(actions="velocities", nearest_max_m=40e3, azimuth_limit_min_deg=180.0)
    simulation, world = begin(scenario, 1)
    installed = np.tile([-1.0, 0.0, -1.0], 3)[None]
    world, _, _ = simulation.advance(world, simulation.command(world, installed))
    entry = np.array([world.tape.task.entry_distance_m[0], 0.0])
    distances = []
    for _ in range(56):
        (c, s), before = course_of(simulation.belief(world))[0], world.platforms[0, :, :3]
        action = np.zeros((1, 9))
        action[0, :2] = 0.6 * c, -0.6 * s  # the first one away from the site, the others stay
        world, _, _ = simulation.advance(world, simulation.command(world, action))
        moved = world.platforms[0, :, :3] - before
        distances.append(np.hypot(*(world.platforms[0, 0, :2] - entry)))
        inside = distances[-1] < 40e3 - 1.0
        np.testing.assert_allclose(moved[0, 1:], 0.0, atol=1e-6)
        np.testing.assert_allclose(moved[1:], 0.0, atol=1e-6)
        assert moved[0, 0] == pytest.approx(1500.0) if inside else moved[0, 0] > 0.0
    assert min(distances) < 1e3
    assert distances[-1] > 40e3
    assert world.platforms[0, 0, 0] > entry[0] + 40e3


@pytest.mark.parametrize("start_m", np.arange(41_000.0, 41_500.0, 50.0))
def test_a_carrier_sent_to_the_nearest_distance_stops_there(start_m):
    """Its encoded way ends at the limit up to float32: that is not a way across what is too near."""
    scenario = MobilePlacement(actions="velocities", nearest_max_m=40e3)
    simulation, world = begin(scenario, 8)
    near, far = world.tape.task.distance_m.T
    azimuth = np.linspace(-0.9, 0.9, 8)
    places = np.tile([0.0, 0.0, -1.0], (8, 3))
    places[:, ::3] = azimuth[:, None]
    places[:, 1::3] = (2.0 * (start_m - near) / (far - near) - 1.0)[:, None]
    for _ in range(4):
        action = simulation.actions.encode(places, simulation.belief(world)).astype(float)
        world, _, _ = simulation.advance(world, simulation.command(world, action))
        _, distance, _ = seen_from_entry(world.platforms[..., :3], world.tape.task.entry_distance_m[:, None])
        assert (distance > 40e3 - 0.1).all()
        places[:, 1::3] = -1.0
    np.testing.assert_allclose(distance, 40e3, atol=0.1)


def test_a_far_side_beyond_the_azimuths_limit_leads_to_the_limit():
    scenario = MobilePlacement(
        actions="velocities", nearest_max_m=40e3, azimuth_limit_min_deg=90.0, azimuth_limit_max_deg=90.0
    )
    simulation, world = begin(scenario, 1)
    world, _, _ = simulation.advance(world, simulation.command(world, np.tile([-1.0, 0.1, -1.0], 3)[None]))
    entry = world.tape.task.entry_distance_m[0]
    for _ in range(50):
        c, s = course_of(simulation.belief(world))[0]
        action = np.tile([0.6 * c, -0.6 * s, 0.0], 3)[None]  # away from the site
        world, _, _ = simulation.advance(world, simulation.command(world, action))
    x, y = world.platforms[0, 0, :2]
    assert x == pytest.approx(entry, abs=1.0)
    assert 40e3 - 1.0 < abs(y) < 41e3


@pytest.mark.parametrize("course", ["random", "flights"])
def test_velocities_fly_every_policy_as_places_do(course):
    """The encoded way leads to the same place: the same flight but for the rounding of actions to float32.

    Carriers may stand all round, so that whichever way leads across what is too near ends at a place that is allowed.
    """
    flown = []
    for actions in KINDS:
        scenario = MobilePlacement(steps=40, actions=actions, course=course, azimuth_limit_min_deg=180.0)
        simulation, world = begin(scenario)
        towards_entry = random_commands(scenario) * np.tile([1.0, 0.3, 1.0], 3) - np.tile([0.0, 0.7, 0.0], 3)
        for command in towards_entry:
            action = simulation.actions.encode(command, simulation.belief(world)).astype(float)
            assert (np.abs(action) <= 1.0 + 1e-7).all()
            world, _, _ = simulation.advance(world, simulation.command(world, action))
        flown.append(world)
    places = [world.platforms[..., :3] for world in flown]
    np.testing.assert_allclose(places[0], places[1], atol=1.0)
    with pytest.raises(TypeError, match="belief"):
        simulation.actions.encode(command)


# ------------------------------------------------------------------------------------------------ policies


@pytest.mark.parametrize("fields", [{}, {"sensors": 2, "carrier": "ground"}, {"sensors": 4, "angle_only": 1}], ids=str)
def test_policies_decide_within_limits(fields):
    scenario = MobilePlacement(steps=4, **fields)
    simulation, world = begin(scenario, 3)
    for name in policy_names(scenario):
        policy, at = make_policy(name, scenario), world
        policy.reset(simulation.belief(at))
        for _ in range(4):
            if name == "oracle":
                policy.see(at)
            command = policy.act(simulation.belief(at), simulation.observe(at))
            assert command.shape == (3, 3 * scenario.sensors)
            assert (np.abs(command) <= 1.0 + 1e-12).all()
            at, _, _ = simulation.advance(at, command)


@pytest.mark.parametrize("name", ["rule", "greedy", "rule_static"])
def test_decisions_do_not_depend_on_the_truth(monkeypatch, name):
    scenario = MobilePlacement(steps=8)

    def decide():
        policy = make_policy(name, scenario)
        return lambda belief, observation: (policy.reset(belief), policy.act(belief, observation))[1]

    first, second = fly_twins(monkeypatch, scenario, decide, range(3))
    for a, b in zip(first.commands, second.commands, strict=True):
        np.testing.assert_array_equal(a, b)


def test_the_search_promises_no_more_than_any_rule():
    scenario = MobilePlacement()
    simulation, world = begin(scenario, 2, seed=10)
    belief, task = simulation.belief(world), world.tape.task
    policy = make_policy("optimizer", scenario)
    policy.reset(belief)
    first = policy.act(belief, None)
    np.testing.assert_array_equal(policy.act(belief, None), first)  # it keeps to its plan
    promise = StaticPromise(scenario)
    rules = np.stack([layout_commands(rule, task, 3) for rule in RULES], axis=1)
    assert (promise(task, first.reshape(2, 1, 3, 3))[:, 0] <= promise(task, rules).min(axis=1)).all()


def test_searches_side_by_side_find_what_they_find_alone(monkeypatch):
    scenario = MobilePlacement()
    simulation, world = begin(scenario, 3, seed=20)
    task, policy = simulation.belief(world).task, BestStatic(scenario, seed=1)
    monkeypatch.setattr(BestStatic, "GENERATIONS", 4)
    alone = [policy.search(task.rows(slice(i, i + 1))) for i in range(3)]
    for cores in (1, 2):
        monkeypatch.setattr("trackers.compiled.available_cores", lambda cores=cores: cores)
        np.testing.assert_array_equal(policy.plan(task), alone)
    assert policy.plan(task.rows(slice(0))).shape == (0, 3, 3)


def test_what_is_promised_of_a_static_layout_is_its_bound_on_that_course():
    """A target that enters and flies just as expected: one course instead of three, and the episode's own bound."""
    certain = {
        f"{name}_{end}_{unit}": value
        for name, unit, value in (("entry_sector", "deg", 0.0), ("heading_spread", "deg", 0.0), ("altitude", "m", 9e3),
                                  ("target_speed", "m_s", 300.0))
        for end in ("min", "max")
    }  # fmt: skip
    scenario = MobilePlacement(steps=30, process_noise_m_s2=0.0, **certain)
    simulation, world = begin(scenario, 3)
    command = layout_commands(even, world.tape.task, 3)
    worlds = play(simulation, world, [command.reshape(3, -1)] * 30)
    average = np.mean([np.log(after.metrics.position_crlb_m[:, 0]) for after in worlds], axis=0)
    np.testing.assert_allclose(StaticPromise(scenario)(world.tape.task, command[:, None])[:, 0], average, rtol=1e-9)


def test_moving_beats_the_best_static_layout():
    """Paired on 8 episodes: the bound averaged over tracks, which no luck of noise touches, and the error itself."""
    scenario = MobilePlacement()
    names = ("optimizer", "even", "rule", "greedy")
    flown = {name: fly(scenario, make_policy(name, scenario), 8, 700) for name in names}
    bound = {name: np.exp(np.log(record.bound_m[:, 1:]).mean()) for name, record in flown.items()}
    assert bound["optimizer"] < bound["even"]
    assert bound["rule"] < bound["optimizer"]
    assert bound["greedy"] < 0.75 * bound["optimizer"]
    ratio = flown["greedy"].mean / flown["optimizer"].mean
    assert ratio.mean() + student.ppf(0.95, 7) * ratio.std(ddof=1) / math.sqrt(8) < 0.9


def test_the_formation_stands_round_a_point_ahead_of_the_target():
    scenario = MobilePlacement(sensors=4, azimuth_limit_min_deg=180.0, nearest_min_m=5e3, nearest_max_m=5e3)
    simulation, world = begin(scenario, 5)
    world = play(simulation, world, [np.zeros((5, 12))] * 4)[-1]
    belief = simulation.belief(world)
    place = wanted(Formation(scenario, lead_s=100.0, radius_m=20e3).act(belief, None), world.tape.task)
    x = tracked(belief)
    np.testing.assert_allclose(x, world.estimate.mean[:, 0])
    np.testing.assert_allclose(place[..., :2].mean(1), x[:, :2] + 100.0 * x[:, 3:5], rtol=1e-6)
    behind = place[:, 0, :2] - place[..., :2].mean(1)
    np.testing.assert_allclose(np.linalg.norm(behind, axis=-1), 20e3, rtol=1e-6)
    assert ((behind * x[:, 3:5]).sum(-1) < 0.0).all()
    np.testing.assert_allclose(place[..., 2], world.tape.task.height_limit_m[:, None] * [0.0, 1.0, 0.0, 1.0], atol=1e-6)


def test_greedy_installs_and_moves_episodes_that_are_out_of_step_alike():
    """A batch in which some sensors are installed already decides as its halves do."""
    scenario = MobilePlacement()
    simulation, world = begin(scenario, 4)
    later = play(simulation, world, [Static(even, 3).act(simulation.belief(world), None)] * 4)[-1]
    mixed = map_rows(lambda a, b: np.concatenate([a[:2], b[2:]]), world, later)
    policy = Greedy(scenario)
    halves = [policy.act(simulation.belief(each), None) for each in (world, later)]
    np.testing.assert_array_equal(policy.act(simulation.belief(mixed), None)[:2], halves[0][:2])
    np.testing.assert_array_equal(policy.act(simulation.belief(mixed), None)[2:], halves[1][2:])


def test_an_evaluation_writes_its_tables_and_pictures(tmp_path):
    scenario = MobilePlacement(steps=5)
    records = fly_all(scenario, {name: make_policy(name, scenario) for name in ("even", "rule")}, 3, 0, progress=False)
    summary = summarize(f"passive/{NAME}-v0", 0, records)
    files = {path.name for path in write_evaluation(tmp_path, summary, records, scenario)}
    assert {"evaluation.md", "geometry.png", "position_error_over_time.png"} <= files
    assert "| rule |" in as_markdown(summary)


def test_pictures_show_the_carriers_trails():
    env = PassiveEnv(NAME, render_mode="rgb_array", angle_only=1)
    env.reset(seed=0)
    pictures = [env.render()]
    for _ in range(2):
        env.step(np.linspace(-1.0, 1.0, 9, dtype=np.float32))
        pictures.append(env.render())
    for before, after in pairwise(pictures):
        assert after.shape == (800, 800, 3)
        assert (before != after).any()
    env.close()


# ------------------------------------------------------------------------------------------------ bad input


@pytest.mark.parametrize(
    ("fields", "words"),
    [
        ({"sensors": 1}, "sensors"),
        ({"carrier": "sea"}, "carrier"),
        ({"tracker": "local"}, "tracker"),
        ({"angle_only": 4}, "angle_only"),
        ({"range_std_min_m": 0.0}, "range_std_min_m"),
        ({"azimuth_std_max_deg": -1.0}, "azimuth_std_max_deg"),
        ({"height_limit_min_m": -1.0}, "height_limit_min_m"),
        ({"nearest_min_m": 4e3}, "minimum_range_m = 5000"),
        ({"minimum_range_m": 500.0}, "range_std_max_m"),
        ({"nearest_max_m": 220e3}, "must not exceed farthest_min_m"),
        ({"airborne_speed_m_s": math.nan}, "airborne_speed_m_s"),
        ({"steps": 0}, "steps"),
    ],
    ids=str,
)
def test_a_bad_field_is_refused_with_its_name(fields, words):
    with pytest.raises(ValueError, match=words):
        MobilePlacement(**fields)


def test_the_best_static_layout_is_a_search_of_the_static_promise():
    assert isinstance(make_policy("optimizer", MobilePlacement()), BestStatic)
