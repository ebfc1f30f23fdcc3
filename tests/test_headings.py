"""Actions that name headings off the line of sight: what they mean, and models that were trained on them."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from agents.evaluation import fly
from agents.learned import LearnedPolicy, observation_digest, read_config
from agents.policy import make_policy
from agents.presets import load_preset
from agents.rules import HoldOffSight, OpenBaseline
from agents.sb3 import Sb3VecEnv
from agents.training import Run, begin_with, new_model, plan, train
from passive_env import PassiveEnv, PassiveVectorEnv
from passive_env.actions import Headings, HeadingsAndSpeeds
from passive_env.catalogue import make_scenario
from passive_env.catalogue.maneuvering import OPENING_DEG
from passive_env.core import Simulation
from passive_env.steering import course, left_to_turn, line_of_sight, outward, shorter_sides
from trackers.angles import wrap

LIMIT = np.radians(10.0)
WAY, OPENING = 250.0, np.radians(OPENING_DEG)
ID = "passive/AngleFusion-v0"


def belief_of(places, courses_deg, target=(20_000.0, 0.0)):
    """Belief of one episode: platforms at 150 m/s in the plane and a track at rest."""
    courses = np.radians(courses_deg)
    platforms = np.column_stack([places, 150.0 * np.cos(courses), 150.0 * np.sin(courses)])[None]
    return SimpleNamespace(platforms=platforms, mean=np.array([[[*target, 0.0, 0.0]]]))


def codec(size=2, odd=None):
    return Headings(size, 2, LIMIT, odd)


def with_speeds(turn_per_step):
    return HeadingsAndSpeeds(
        4, 2, turn_per_step, [True, True, False, False], way_per_step=WAY, opening_angle=OPENING, crossing_worth=2.25
    )


def test_outward_is_left_for_the_left_platform():
    belief = belief_of([(0.0, -3000.0), (0.0, 3000.0)], [0.0, 0.0])
    assert np.array_equal(outward(belief.platforms, belief.mean), [[-1.0, 1.0]])
    behind = belief_of([(0.0, -3000.0), (0.0, 3000.0)], [0.0, 0.0], target=(-20_000.0, 0.0))
    assert np.array_equal(outward(behind.platforms, behind.mean), [[1.0, -1.0]])


def sides_by_rank(places, courses, target):
    """Sides [s] of one episode: its platforms sorted from left to right, the middle of an odd number by its course."""
    sight = target - places.mean(axis=0)
    from_left = np.argsort(places @ [sight[1], -sight[0]])
    sides, half = np.zeros(len(places)), len(places) // 2
    sides[from_left[:half]], sides[from_left[len(places) - half :]] = 1.0, -1.0
    to_target = np.arctan2(*(target - places).T[::-1])
    return np.where(sides == 0.0, np.where(wrap(courses - to_target) >= 0.0, 1.0, -1.0), sides)


@pytest.mark.parametrize("stations", [2, 3, 4, 5])
def test_the_left_half_goes_left_the_right_half_right_and_a_middle_one_where_it_heads(stations):
    rng = np.random.default_rng(stations)
    platforms = np.concatenate(
        [rng.normal(0.0, 1e4, (200, stations, 2)), rng.normal(0.0, 200.0, (200, stations, 2))], 2
    )
    mean = rng.normal(0.0, 3e4, (200, 3, 4))
    sides = outward(platforms, mean)
    for i in range(200):
        expected = sides_by_rank(platforms[i, :, :2], course(platforms)[i], mean[i, :, :2].mean(axis=0))
        assert np.array_equal(sides[i], expected)


def test_a_middle_station_keeps_its_side_whichever_side_of_the_midpoint_it_is_on():
    for course_deg, side in ((20.0, 1.0), (-20.0, -1.0)):
        for north in (-50.0, 50.0):
            belief = belief_of([(0.0, -3000.0), (0.0, north), (0.0, 3000.0)], [0.0, course_deg, 0.0])
            assert np.array_equal(outward(belief.platforms, belief.mean), [[-1.0, side, 1.0]])


def test_what_is_left_to_turn_is_the_same_compiled_and_written_out():
    for name, fields in (("AngleFusion", {}), ("ManeuveringTarget", {}), ("ManeuveringTarget", {"stations": 3})):
        env = PassiveVectorEnv(name, num_envs=64, **fields)
        env.reset(seed=0)
        belief = env.belief()
        off = np.random.default_rng(0).uniform(-np.pi, np.pi, belief.platforms.shape[:2])
        expected = wrap(line_of_sight(belief.platforms, belief.mean) + off - course(belief.platforms))
        np.testing.assert_allclose(left_to_turn(belief.platforms, belief.mean, off), expected, atol=1e-9)


def test_platforms_in_line_with_the_target_go_to_different_sides():
    belief = belief_of([(0.0, 0.0), (-5000.0, 0.0)], [0.0, 0.0])
    assert np.array_equal(outward(belief.platforms, belief.mean), [[-1.0, 1.0]])


def test_a_heading_is_an_angle_off_the_platforms_own_line_of_sight():
    """The right platform sees the target 45° to the left of east, the left one 45° to the right."""
    places = [(0.0, -10_000.0), (0.0, 10_000.0)]
    values = np.array([[60.0 / 180.0, 90.0 / 180.0]])
    aims = [45.0 - 60.0, -45.0 + 90.0]
    for courses, expected in (
        (aims, [0.0, 0.0]),
        ([aims[0] - 5.0, aims[1] + 2.5], [0.5, -0.25]),
        ([aims[0] + 90.0, aims[1] - 90.0], [-1.0, 1.0]),
    ):
        belief = belief_of(places, courses, target=(10_000.0, 0.0))
        np.testing.assert_allclose(codec().commands(values, belief), [expected], atol=1e-12)


def sides_of(belief, worth):
    return shorter_sides(
        belief.platforms, belief.mean, angle=OPENING, worth=worth, turn_per_step=LIMIT, way_per_step=WAY
    )


@pytest.mark.parametrize(("worth", "expected"), [(2.0, [1.0, -1.0]), (2.25, [-1.0, 1.0]), (np.inf, [-1.0, 1.0])])
def test_platforms_cross_where_that_saves_enough_turning(worth, expected):
    """Both would turn by 170°, 17 steps, to open the baseline of 2 km, 8 steps long; across they need not turn."""
    belief = belief_of([(0.0, -1000.0), (0.0, 1000.0)], [85.0, -85.0], target=(1e9, 0.0))
    assert np.array_equal(sides_of(belief, worth), [expected])


def test_a_diverged_track_makes_nobody_cross():
    belief = belief_of([(0.0, -1000.0), (0.0, 1000.0)], [85.0, -85.0], target=(np.nan, 0.0))
    assert np.array_equal(sides_of(belief, 0.0), outward(belief.platforms, belief.mean))
    commands = with_speeds(LIMIT).commands(np.array([[0.5, 0.5, 1.0, 1.0]]), belief)
    assert np.array_equal(commands, [[0.0, 0.0, 1.0, 1.0]])


@pytest.mark.parametrize(
    ("fields", "least", "most"),
    [({}, 0.05, 0.5), ({"course": "flights"}, 0.0, 0.0), ({"carrier": "ground"}, 0.0, 0.0)],
    ids=["drawn", "flights", "ground"],
)
def test_who_crosses_decided_at_every_step_is_who_crosses_decided_once(fields, least, most):
    """A constant heading action is the rule, which remembers its decision, until targets pass between the stations."""
    worlds = [
        PassiveVectorEnv("ManeuveringTarget", num_envs=256, actions=kind, **fields)
        for kind in ("headings", "continuous")
    ]
    for env in worlds:
        env.reset(seed=0)
    scenario, belief = worlds[1].scenario, worlds[1].belief()
    rule = OpenBaseline(scenario, OPENING_DEG, cross=scenario.crossing_worth)
    rule.reset(belief)
    sides = shorter_sides(
        belief.platforms, belief.mean, angle=OPENING, worth=scenario.crossing_worth,
        turn_per_step=np.radians(scenario.max_turn_rate_deg_s), way_per_step=scenario.top_speed_m_s,
    )  # fmt: skip
    assert least <= (sides != outward(belief.platforms, belief.mean)).all(axis=1).mean() <= most
    heading = np.tile(np.array([OPENING_DEG / 180.0, OPENING_DEG / 180.0, 1.0, 1.0], dtype=np.float32), (256, 1))
    for _ in range(40):
        belief = worlds[1].belief()
        worlds[0].step(heading)
        worlds[1].step(rule.act(belief, np.empty(0)).astype(np.float32))
    first, second = (env.belief().platforms for env in worlds)
    np.testing.assert_allclose(first, second, atol=1e-2)


@pytest.mark.parametrize("stations", [3, 4])
def test_more_than_two_stations_open_outwards(stations):
    env = PassiveVectorEnv("ManeuveringTarget", num_envs=256, actions="headings", stations=stations)
    env.reset(seed=0)
    belief, actions = env.belief(), env.simulation.actions
    off = np.full((256, stations), 85.0 / 180.0)
    commands = actions.commands(np.concatenate([off, np.ones_like(off)], axis=1), belief)
    sides = outward(belief.platforms, belief.mean)
    aim = line_of_sight(belief.platforms, belief.mean) + sides * OPENING
    turns = np.clip(wrap(aim - course(belief.platforms)) / np.radians(5.0), -1.0, 1.0)
    np.testing.assert_allclose(commands[:, :stations], turns, atol=1e-9)


def test_the_strongest_rule_crosses_where_the_scenario_says():
    for course_of, crosses in (("random", True), ("flights", False)):
        scenario = make_scenario("ManeuveringTarget", {"course": course_of})
        env = PassiveVectorEnv(scenario, num_envs=256)
        env.reset(seed=0)
        belief = env.belief()
        rules = [make_policy(name, scenario) for name in ("rule", "rule_bend")]
        for rule in rules:
            rule.reset(belief)
        first, second = (rule.act(belief, np.empty(0)) for rule in rules)
        assert np.array_equal(first, second) != crosses


def test_climbs_pass_unchanged():
    belief = belief_of([(0.0, -10_000.0), (0.0, 10_000.0)], [0.0, 0.0])
    actions = codec(4, [True, True, False, False])
    values = np.array([[0.1, 0.2, 0.3, -0.4]])
    assert np.array_equal(actions.commands(values, belief)[:, 2:], values[:, 2:])
    assert np.array_equal(actions.mirrored(values), values)


def test_stations_far_off_their_heading_turn_at_their_lowest_speed():
    """Lines of sight at ±45°; both are to head 90° outwards of them, one is 89° off that, the other 91°."""
    places = [(0.0, -10_000.0), (0.0, 10_000.0)]
    belief = belief_of(places, [-45.0 + 89.0, 45.0 - 91.0], target=(10_000.0, 0.0))
    actions = with_speeds(LIMIT)
    np.testing.assert_allclose(
        actions.commands(np.array([[0.5, 0.5, 0.75, 0.75]]), belief), [[-1.0, 1.0, 0.75, -1.0]], atol=1e-12
    )


def test_stations_that_a_step_turns_to_their_heading_do_not_slow_down():
    """The same sights; a step turns by 100°, enough for 91° but not for 105°."""
    actions = with_speeds(np.radians(100.0))
    belief = belief_of([(0.0, -10_000.0), (0.0, 10_000.0)], [-45.0 + 91.0, 45.0 - 105.0], target=(10_000.0, 0.0))
    np.testing.assert_allclose(
        actions.commands(np.array([[0.5, 0.5, 0.75, 0.75]]), belief), [[-0.91, 1.0, 0.75, -1.0]], atol=1e-12
    )


@pytest.mark.parametrize("name", ["AngleFusion", "ManeuveringTarget"])
@pytest.mark.parametrize(
    "fields", [{}, {"step_s": 5.0, "max_turn_rate_deg_s": 20.0}], ids=["few degrees a step", "100 degrees a step"]
)
def test_encoded_commands_are_the_same_commands_again(name, fields):
    env = PassiveVectorEnv(name, num_envs=64, actions="headings", **fields)
    env.reset(seed=1)
    belief, actions = env.belief(), env.simulation.actions
    commands = np.clip(np.random.default_rng(2).uniform(-1.5, 1.5, (64, 4)), -1.0, 1.0)
    again = actions.commands(actions.decode(actions.encode(commands, belief), 64), belief)
    np.testing.assert_allclose(again, commands, atol=1e-5)
    with pytest.raises(TypeError, match="need the belief"):
        actions.encode(commands)


@pytest.mark.parametrize("name", ["AngleFusion", "ManeuveringTarget"])
def test_off_the_sight_to_a_diverged_track_platforms_go_straight_on(name):
    simulation = Simulation(make_scenario(name, {"actions": "headings"}))
    belief = simulation.belief(simulation.begin([np.random.default_rng(0)]))
    lost = belief._replace(mean=np.full_like(belief.mean, np.nan))
    values = np.full((1, simulation.actions.size), 0.5)
    assert np.all(simulation.actions.commands(values, belief)[:, :2])
    commands = simulation.actions.commands(values, lost)
    assert np.array_equal(commands, np.where(np.arange(values.shape[1]) < 2, 0.0, values))
    assert np.isfinite(simulation.actions.encode(commands, lost)).all()


def test_a_constant_action_holds_an_angle_off_the_line_of_sight():
    scenario = make_scenario("AngleFusion", {"actions": "headings", "steps": 25})
    env = PassiveVectorEnv(scenario, num_envs=32, autoreset_mode="disabled")
    rule = HoldOffSight(scenario, 60.0, exchange=True)
    env.reset(seed=3)
    rule.reset(env.belief())
    action = np.tile(np.float32([1 / 3, 1 / 3, 0.0, 0.0]), (32, 1))
    for _ in range(scenario.steps):
        belief = env.belief()
        expected = rule.act(belief, None)
        values = env.simulation.actions.decode(action, 32)
        np.testing.assert_allclose(env.simulation.actions.commands(values, belief), expected, atol=1e-5)
        env.step(action)
    belief = env.belief()
    off = wrap(course(belief.platforms) - line_of_sight(belief.platforms, belief.mean))
    assert np.median(np.abs(np.abs(off) - np.pi / 3)) < np.radians(3.0)


def test_a_batch_flies_headings_as_single_environments_do():
    batch = PassiveVectorEnv("AngleFusion", num_envs=3, actions="headings", clutter_mean=2.0)
    seen, _ = batch.reset(seed=11)
    singles = [PassiveEnv("AngleFusion", actions="headings", clutter_mean=2.0) for _ in range(3)]
    for i, env in enumerate(singles):
        assert np.array_equal(env.reset(seed=11 + i)[0], seen[i])
    rng = np.random.default_rng(0)
    for _ in range(6):
        action = rng.uniform(-1.0, 1.0, (3, 4)).astype(np.float32)
        seen, reward, *_ = batch.step(action)
        for i, env in enumerate(singles):
            alone, earned, *_ = env.step(action[i])
            assert np.array_equal(alone, seen[i])
            assert earned == reward[i]


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """A run of one short rollout that chooses headings, on a scenario that is evaluated by rates."""
    preset = load_preset("AngleFusion", "ppo")
    preset |= {"net_arch": [8], "first_action": [0.5, 0.25, 0.0, 0.0]}
    preset["scenario"] = {"actions": "headings"}
    preset["arguments"] = {**preset["arguments"], "batch_size": 30, "n_epochs": 1}
    run = Run(
        tmp_path_factory.mktemp("headings") / "run", "AngleFusion", {"steps": 5}, "ppo", 0, "cpu", 30, 6, preset=preset
    )
    train(run, progress=False)
    return run


def test_a_model_of_headings_flies_where_rates_are_flown(trained):
    assert read_config(trained.folder)["interface"] == {"actions": "headings"}
    for kind in ("continuous", "headings"):
        scenario = make_scenario("AngleFusion", {"steps": 5, "actions": kind})
        env = PassiveVectorEnv(scenario, num_envs=8, autoreset_mode="disabled")
        observation, _ = env.reset(seed=0)
        policy = LearnedPolicy(trained.folder, ID, env.simulation)
        policy.reset(env.belief())
        commands = policy.act(env.belief(), observation)
        if kind == "continuous":
            first = commands
        np.testing.assert_allclose(commands, first, atol=1e-6)
    by_rates, by_headings = (
        fly(make_scenario("AngleFusion", {"steps": 5, "actions": kind}), policy, 8, 0)
        for kind in ("continuous", "headings")
    )
    np.testing.assert_allclose(by_rates.final, by_headings.final, rtol=1e-3)


def test_a_model_of_headings_does_not_choose_among_three_rates(trained):
    scenario = make_scenario("AngleFusion", {"steps": 5, "actions": "discrete"})
    with pytest.raises(ValueError, match="action kind"):
        LearnedPolicy(trained.folder, ID, Simulation(scenario))


def test_the_fingerprint_tells_headings_from_rates():
    digests = {
        kind: observation_digest(Simulation(make_scenario("AngleFusion", {"actions": kind})))
        for kind in ("continuous", "headings", "discrete")
    }
    assert len(set(digests.values())) == 3


def test_the_fingerprint_tells_what_headings_mean(monkeypatch):
    """Headings that are counted otherwise have the same space: the codec says what they stand for."""
    simulation = make_scenario("ManeuveringTarget", {"actions": "headings"}).make_simulation()
    assert type(simulation.actions) is HeadingsAndSpeeds
    now = observation_digest(simulation)
    monkeypatch.setattr(HeadingsAndSpeeds, "meaning", Headings.meaning)
    assert observation_digest(simulation) != now


def untrained(run):
    """A run's model before training, and its mean actions in six episodes' first belief."""
    env = Sb3VecEnv(
        PassiveVectorEnv(run.training_scenario, num_envs=6, autoreset_mode="same_step"), truth=run.asymmetric
    )
    model = new_model(run, env)
    return model, model.predict(env.reset(), deterministic=True)[0]


def test_an_actor_begins_with_the_first_action(trained):
    model, actions = untrained(trained)
    np.testing.assert_allclose(actions, np.tile([0.5, 0.25, 0.0, 0.0], (6, 1)), atol=0.1)
    for values, expected in (([0.5, 0.25], [0.5, 0.5, 0.25, 0.25]), ([-0.5], [-0.5] * 4), ([0, 1, 2, 3], [0, 1, 2, 3])):
        begin_with(model, values)
        np.testing.assert_allclose(model.policy.action_net.bias.detach().numpy(), expected)
    for values in ([], [0.5, 0.25, 0.0], [0.5] * 8):
        with pytest.raises(ValueError, match=rf"first_action has {len(values)} values, must have .*divisor of 4"):
            begin_with(model, values)


HEADINGS_PRESETS = {"AngleFusion": (0.36, 0.0), "ManeuveringTarget": (0.42, 1.0)}
"""Scenarios whose preset names headings: the heading and the other number that every platform begins with."""


@pytest.mark.parametrize(
    ("name", "fields"),
    [(name, {}) for name in HEADINGS_PRESETS] + [("ManeuveringTarget", {"stations": n}) for n in (3, 4)],
)
def test_the_presets_rule_is_begun_with_whatever_the_number_of_stations(name, fields, tmp_path):
    run = plan(name, tmp_path, envs=6, fields=fields)
    _, actions = untrained(run)
    stations = run.training_scenario.stations
    np.testing.assert_allclose(actions, np.tile(np.repeat(HEADINGS_PRESETS[name], stations), (6, 1)), atol=0.1)


@pytest.mark.parametrize("name", HEADINGS_PRESETS)
@pytest.mark.parametrize("actions", ["continuous", "discrete"])
def test_other_actions_than_the_presets_begin_with_no_rule(name, actions, tmp_path):
    """Headings read as turn rates, or as scores of choices, would be some other rule."""
    run = plan(name, tmp_path, envs=6, fields={"actions": actions})
    model, chosen = untrained(run)
    assert not model.policy.action_net.bias.detach().numpy().any()
    commands = run.training_scenario.make_actions().decode(chosen, 6)
    assert np.abs(commands).max() < 0.1 if actions == "continuous" else set(np.unique(commands)) <= {-1.0, 0.0, 1.0}


def test_algorithms_without_a_mean_action_refuse_a_first_one(trained):
    preset = load_preset("AngleFusion", "sac") | {"first_action": [0.36, 0.0]}
    with pytest.raises(ValueError, match=r"--algo sac has no mean action .* must not say 'first_action'"):
        replace(trained, algo="sac", preset=preset)
