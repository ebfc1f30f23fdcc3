"""Fixed schedules, rules and the random policy: what they fly, and that they read nothing but the belief."""

import math
from types import SimpleNamespace

import gymnasium as gym
import numpy as np
import pytest
from twin_worlds import fly, fly_twins

from agents.fixed import Random, Schedule, Straight
from agents.policy import Policy, make_policy, policy_names, sees_world
from agents.rules import HoldOffSight, LeadLag, OpenBaseline, Split, TurnApart, Zigzag
from passive_env import PassiveEnv, PassiveVectorEnv
from passive_env.belief import Belief
from passive_env.catalogue import make_scenario
from passive_env.catalogue.angle_fusion import AngleFusion
from passive_env.catalogue.maneuvering import ManeuveringTarget
from passive_env.catalogue.ownship import Ownship
from passive_env.catalogue.two_station import TwoStation
from passive_env.core import Simulation, map_rows
from passive_env.kinematics import turn

NAMES = policy_names(TwoStation())
BELIEF_ONLY = [name for name in NAMES if not sees_world(make_policy(name, TwoStation()))]
IN_SPACE = [name for name in policy_names(AngleFusion()) if not sees_world(make_policy(name, AngleFusion()))]
FIXING = [name for name in policy_names(ManeuveringTarget()) if not sees_world(make_policy(name, ManeuveringTarget()))]
GROUND = {"carrier": "ground", "stations": 3, "detection_probability": 0.8}
MISSES = {"detection_probability": 0.7, "false_bearings_mean": 1.0}
ROUGH = {"clutter_mean": 4.0, "availability0_min": 0.5, "availability1_min": 0.5, "detection_probability": 0.9}


def wrapped_deg(angle):
    return (np.asarray(angle) + 180.0) % 360.0 - 180.0


def assert_flies_within_the_action_space(name, scenario):
    """Fly three whole episodes by a policy of this name."""
    env = PassiveVectorEnv(scenario, num_envs=3, autoreset_mode="disabled")
    observation, _ = env.reset(seed=0)
    policy = make_policy(name, scenario)
    policy.reset(env.belief())
    for _ in range(scenario.steps):
        action = env.simulation.actions.encode(policy.act(env.belief(), observation))
        assert action in env.action_space
        observation, *_ = env.step(action)


def headings_flown(policy, scenario, seed=0, episodes=1):
    """Platform headings [k + 1, e, s] deg of whole episodes flown in the environment."""
    env = PassiveVectorEnv(scenario, num_envs=episodes, autoreset_mode="disabled")
    observation, _ = env.reset(seed=seed)
    policy.reset(env.belief())
    states = [env.world.platforms]
    for _ in range(scenario.steps):
        observation, *_ = env.step(env.simulation.actions.encode(policy.act(env.belief(), observation)))
        states.append(env.world.platforms)
    size = states[0].shape[-1] // 2
    velocity = np.array(states)[..., size:]
    return np.degrees(np.arctan2(velocity[..., 1], velocity[..., 0]))


# ------------------------------------------------------------------------------------------------ the paper's schedule


@pytest.mark.parametrize(("name", "second_sense"), [("paper", 1), ("paper_opposed", -1)])
@pytest.mark.parametrize("actions", ["continuous", "discrete"])
def test_schedules_turn_20_degrees_in_the_papers_windows_and_at_no_other_time(name, second_sense, actions):
    """Station 1 turns at 5°/s from 52 to 56 s, station 2 from 22 to 26 s; both head 45° before."""
    scenario = TwoStation(course="paper", actions=actions)
    heading = headings_flown(make_policy(name, scenario), scenario)[:, 0]
    for k, (first, second) in enumerate(heading):
        t = 2.0 * k
        assert first == pytest.approx(45.0 + 5.0 * min(max(t - 52.0, 0.0), 4.0), abs=1e-4), t
        assert second == pytest.approx(45.0 + second_sense * 5.0 * min(max(t - 22.0, 0.0), 4.0), abs=1e-4), t


@pytest.mark.parametrize(("step_s", "steps"), [(0.5, 180), (1.0, 90), (3.0, 30), (4.0, 23), (60.0, 2)])
def test_schedules_turn_20_degrees_whatever_the_step(step_s, steps):
    """Where a step reaches over a window's edge it turns for the window's share of it."""
    scenario = TwoStation(step_s=step_s, steps=steps)
    heading = headings_flown(make_policy("paper", scenario), scenario)[:, 0]
    np.testing.assert_allclose(wrapped_deg(heading[-1] - heading[0]), 20.0, atol=1e-3)
    before = math.floor(22.0 / step_s)
    np.testing.assert_allclose(wrapped_deg(heading[before] - heading[0]), 0.0, atol=1e-6)


@pytest.mark.parametrize(("limit", "turned"), [(2.5, 10.0), (5.0, 20.0), (10.0, 20.0), (45.0, 20.0), (0.0, 0.0)])
def test_schedules_keep_the_papers_rate_as_far_as_the_limit_allows(limit, turned):
    scenario = TwoStation(max_turn_rate_deg_s=limit)
    heading = headings_flown(make_policy("paper", scenario), scenario)[:, 0]
    np.testing.assert_allclose(wrapped_deg(heading[-1] - heading[0]), turned, atol=1e-3)


def test_schedule_of_ones_own_windows_and_senses():
    scenario = TwoStation(steps=10)
    heading = headings_flown(Schedule(scenario, [(0.0, 2.0), (4.0, 10.0)], [-1, 1]), scenario)[:, 0]
    np.testing.assert_allclose(wrapped_deg(heading[:, 0] - heading[0, 0]), [0.0, *[-10.0] * 10], atol=1e-4)
    np.testing.assert_allclose(
        wrapped_deg(heading[:, 1] - heading[0, 1]), [0, 0, 0, 10, 20, 30, 30, 30, 30, 30, 30], atol=1e-4
    )


def test_straight_holds_course():
    scenario = TwoStation()
    heading = headings_flown(make_policy("straight", scenario), scenario, episodes=3)
    np.testing.assert_allclose(wrapped_deg(heading - heading[0]), 0.0, atol=1e-9)


# ------------------------------------------------------------------------------------------------ turn apart


def line_of_sight_deg(env):
    """Direction [e] from the stations' midpoint to the tracks' middle, and how far station 0 lies left of station 1."""
    belief = env.belief()
    middle = belief.platforms[:, :, :2].mean(axis=1)
    x, y = (belief.mean[..., :2].mean(axis=1) - middle).T
    apart = belief.platforms[:, 0, :2] - belief.platforms[:, 1, :2]
    return np.degrees(np.arctan2(y, x)), x * apart[:, 1] - y * apart[:, 0]


@pytest.mark.parametrize(
    ("name", "left_deg", "right_deg"), [("rule", 60.0, 80.0), ("rule_perpendicular", 90.0, 90.0), (None, 20.0, 130.0)]
)
@pytest.mark.parametrize("actions", ["continuous", "discrete"])
def test_turn_apart_ends_on_both_sides_of_the_line_of_sight(name, left_deg, right_deg, actions):
    """The left station goes left, whichever of the two it is; discrete turns of 10° end within half of one."""
    scenario = TwoStation(actions=actions, steps=20)
    policy = TurnApart(scenario, left_deg, right_deg) if name is None else make_policy(name, scenario)
    env = PassiveVectorEnv(scenario, num_envs=40)
    env.reset(seed=0)
    sight, left_by = line_of_sight_deg(env)
    heading = headings_flown(policy, scenario, seed=0, episodes=40)
    off = wrapped_deg(heading[-1] - sight[:, None])
    first_is_left = left_by > 0.0
    assert 5 < first_is_left.sum() < 35
    left, right = np.where(first_is_left[:, None], off, off[:, ::-1]).T
    tolerance = 1e-3 if actions == "continuous" else 5.0 + 1e-3
    np.testing.assert_allclose(left, left_deg, atol=tolerance)
    np.testing.assert_allclose(right, -right_deg, atol=tolerance)


def test_turn_apart_that_follows_keeps_its_angle_to_the_line_of_sight_of_the_moment():
    scenario = TwoStation(steps=30)
    policy = TurnApart(scenario, 40.0, 100.0, follow=True)
    env = PassiveVectorEnv(scenario, num_envs=40, autoreset_mode="disabled")
    observation, _ = env.reset(seed=0)
    policy.reset(env.belief())
    first_sight, _ = line_of_sight_deg(env)
    for _ in range(30):
        sight, left_by = line_of_sight_deg(env)
        observation, *_ = env.step(policy.act(env.belief(), observation))
    velocity = env.world.platforms[..., 2:]
    off = wrapped_deg(np.degrees(np.arctan2(velocity[..., 1], velocity[..., 0])) - sight[:, None])
    left, right = np.where((left_by > 0.0)[:, None], off, off[:, ::-1]).T
    np.testing.assert_allclose(left, 40.0, atol=1e-6)
    np.testing.assert_allclose(right, -100.0, atol=1e-6)
    assert np.abs(wrapped_deg(sight - first_sight)).max() > 5.0  # the line of sight has moved meanwhile


def test_turn_apart_turns_the_shorter_way_at_the_limit_and_then_flies_straight():
    scenario = TwoStation(steps=25)
    heading = headings_flown(make_policy("rule", scenario), scenario, episodes=40)
    turns = wrapped_deg(np.diff(heading, axis=0))
    assert np.abs(turns).max() <= 10.0 + 1e-4
    total = wrapped_deg(heading[-1] - heading[0])
    np.testing.assert_allclose(turns.sum(axis=0), total, atol=1e-6)  # never more than half a circle
    needed = np.ceil(np.abs(total) / 10.0 - 1e-6)
    np.testing.assert_allclose((np.abs(turns) > 1e-4).sum(axis=0), needed, atol=0)
    assert np.abs(turns[18:]).max() < 1e-4


# ------------------------------------------------------------------------------------------------ two in space


@pytest.mark.parametrize("course", ["paper", "random"])
@pytest.mark.parametrize(("limit", "last"), [(5.0, 45.0), (10.0, 45.0), (1.0, 40.0), (0.0, 0.0)])
def test_the_papers_maneuver_in_space_turns_platform_0_left_from_step_20(course, limit, last):
    """45° at the limit, as far as 20 steps of 2 s suffice; platform 1 flies straight on."""
    scenario = AngleFusion(course=course, max_turn_rate_deg_s=limit)
    heading = headings_flown(make_policy("paper", scenario), scenario, seed=3, episodes=3)
    turned = wrapped_deg(heading - heading[0])
    np.testing.assert_allclose(turned[:21], 0.0, atol=1e-6)
    np.testing.assert_allclose(turned[21, :, 0], min(2.0 * limit, 45.0), atol=1e-3)
    np.testing.assert_allclose(turned[-1, :, 0], last, atol=1e-3)
    np.testing.assert_allclose(turned[..., 1], 0.0, atol=1e-6)
    assert course == "random" or heading[0, 0, 0] == pytest.approx(0.0)


def test_split_turns_45_degrees_apart_to_the_side_that_opens_the_baseline():
    """The distance across the line of sight, of the first belief's, grows; with the sign changed it would shrink."""
    scenario = AngleFusion(steps=20)
    policy = make_policy("split", scenario)
    assert isinstance(policy, Split)
    env = PassiveVectorEnv(scenario, num_envs=60, autoreset_mode="disabled")
    env.reset(seed=1)
    belief = env.belief()
    heading = headings_flown(policy, scenario, seed=1, episodes=60)
    turned = wrapped_deg(heading[-1] - heading[0])
    np.testing.assert_allclose(np.sort(turned, axis=1), np.tile([-45.0, 45.0], (60, 1)), atol=1e-3)
    x, y = (belief.mean[:, 0, :2] - belief.platforms[:, :, :2].mean(axis=1)).T
    apart = belief.platforms[:, 0, :2] - belief.platforms[:, 1, :2]
    across = (x * apart[:, 1] - y * apart[:, 0]) / np.hypot(x, y)
    angle = np.radians(heading[-1])
    drift = (np.cos(angle) * -y[:, None] + np.sin(angle) * x[:, None]) / np.hypot(x, y)[:, None]
    assert (np.sign(across) * (drift[:, 0] - drift[:, 1]) > 0.0).all()
    assert 10 < (turned[:, 0] > 0.0).sum() < 50


@pytest.mark.parametrize("exchange", [False, True])
def test_hold_off_sight_holds_its_angles_off_each_platforms_own_line_of_sight(exchange):
    """80° for 22 scans, then 50°, on opposite sides, reached by turns at the limit."""
    scenario = AngleFusion(steps=36)
    policy = HoldOffSight(scenario, 80.0, 50.0, 22, exchange)
    env = PassiveVectorEnv(scenario, num_envs=60, autoreset_mode="disabled")
    observation, _ = env.reset(seed=2)
    policy.reset(env.belief())
    off = []
    for _ in range(36):
        belief = env.belief()
        to = belief.mean[:, :1, :2] - belief.platforms[:, :, :2]
        sight = np.degrees(np.arctan2(to[..., 1], to[..., 0]))
        before = [env.world.platforms[..., axis] for axis in (3, 4)]
        observation, *_ = env.step(policy.act(belief, observation))
        course = np.degrees(np.arctan2(env.world.platforms[..., 4], env.world.platforms[..., 3]))
        off.append(wrapped_deg(course - sight))
        turned = np.abs(wrapped_deg(course - np.degrees(np.arctan2(before[1], before[0]))))
        assert turned.max() <= 10.0 + 1e-3
    off = np.array(off)
    for at, angle in ((21, 80.0), (35, 50.0)):
        settled = np.isclose(np.abs(off[at]), angle, atol=1e-2).all(axis=1)
        assert settled.mean() > 0.9  # in the others the line of sight moves faster than they turn
        np.testing.assert_allclose(np.sort(off[at][settled], axis=1), [[-angle, angle]] * settled.sum(), atol=1e-2)


def test_sides_in_space_go_by_who_is_left():
    scenario = AngleFusion(course="paper")
    heading = headings_flown(HoldOffSight(scenario, 60.0), scenario)[:, 0]
    assert heading[8, 0] == pytest.approx(60.0, abs=15.0)  # the northern platform, which looks east
    assert heading[8, 1] == pytest.approx(-60.0, abs=15.0)


@pytest.mark.parametrize(
    ("name", "fields", "angles"),
    [("AngleFusion", {}, (70.0, 60.0)), ("AngleFusionSlow", {}, (90.0, 75.0)), ("AngleFusionClutter", {}, (70.0, 60.0)),
     ("AngleFusion", {"clutter_density_per_deg2": 0.01}, (70.0, 60.0))],
)  # fmt: skip
def test_the_rule_in_space_is_tuned_per_variant(name, fields, angles):
    scenario = make_scenario(name, fields)
    policy = make_policy("rule", scenario)
    assert isinstance(policy, HoldOffSight)
    assert policy._exchange == (scenario != make_scenario("AngleFusion", {}))
    np.testing.assert_allclose(np.degrees(policy._angles), angles)


@pytest.mark.parametrize(
    ("angle", "then", "message"),
    [(181.0, None, "angle_deg = 181.0"), (60.0, -1.0, "then_deg = -1.0"), (math.nan, None, "angle_deg = nan")],
)
def test_impossible_angles_off_sight_are_errors(angle, then, message):
    with pytest.raises(ValueError, match=message):
        HoldOffSight(AngleFusion(), angle, then)


def test_policies_in_space_known_by_name():
    offer = policy_names(AngleFusion())
    assert offer == [
        "paper", "straight", "random", "split", "rule", "rule_60", "greedy", "greedy_4", "greedy_1", "planner",
        "oracle",
    ]  # fmt: skip
    with pytest.raises(ValueError, match=r"unknown policy 'rule_tuned': AngleFusion offers paper, .*planner, oracle"):
        make_policy("rule_tuned", AngleFusion())


# ------------------------------------------------------------------------------------------------ stations that fix


def stations_at(places, headings_deg, target, steps_left=70, speed=1e-6):
    """Belief of one episode: stations at places [s, 2] km, a target that stands at [2] km."""
    heading = np.radians(headings_deg)
    velocity = speed * np.stack([np.cos(heading), np.sin(heading)], axis=-1)
    platforms = np.concatenate([1e3 * np.array(places), velocity], axis=-1)[None]
    mean = np.array([[[*(1e3 * np.array(target)), 0.0, 0.0]]])
    return Belief(
        np.array([steps_left]), platforms, mean, np.eye(4)[None, None], None, None,
        np.zeros((1, 2 * len(places))), None, np.empty((1, 0, 3)),
    )  # fmt: skip


def open_baseline(belief, *angles, turn_rate=5.0, **settings):
    """Commands of `OpenBaseline`: turns [s], speeds [s]."""
    policy = OpenBaseline(
        SimpleNamespace(step_s=1.0, steps=70, max_turn_rate_deg_s=turn_rate, top_speed_m_s=250.0), *angles, **settings
    )
    policy.reset(belief)
    return np.split(policy.act(belief, np.empty((1, 0)))[0], 2)


def test_fixed_stations_stand_still():
    scenario = ManeuveringTarget(steps=12, stations=3)
    env = PassiveVectorEnv(scenario, num_envs=4, autoreset_mode="disabled")
    observation, _ = env.reset(seed=0)
    before, policy = env.world.platforms, make_policy("fixed", scenario)
    policy.reset(env.belief())
    for _ in range(12):
        observation, *_ = env.step(policy.act(env.belief(), observation))
    np.testing.assert_allclose(env.world.platforms, before, atol=1e-3)


def test_opening_turns_the_left_station_left_and_the_right_one_right_of_their_lines_of_sight():
    """Both look north at a target far off and head 2° off the wanted courses: 80° left, 80° right of the sight."""
    belief = stations_at([[-1.0, 0.0], [1.0, 0.0]], [90.0 + 78.0, 90.0 - 78.0], [0.0, 1e5])
    turns, speeds = open_baseline(belief, 80.0, 80.0)
    np.testing.assert_allclose(turns, [0.4, -0.4], atol=1e-3)
    np.testing.assert_allclose(speeds, 1.0)
    exchanged = belief._replace(platforms=belief.platforms[:, ::-1])
    np.testing.assert_allclose(open_baseline(exchanged, 80.0, 80.0)[0], [-0.4, 0.4], atol=1e-3)


@pytest.mark.parametrize(("crossing", "angle"), [(0.0, 80.0), (30.0, 60.0), (60.0, 40.0), (90.0, 20.0), (150.0, 20.0)])
def test_opening_bends_forward_as_the_lines_of_sight_cross(crossing, angle):
    """From 80° at 0° to 20° at 90° and beyond; the target is 10 km north of two stations that see it so."""
    half = 10.0 * math.tan(math.radians(0.5 * max(crossing, 1e-4)))
    sight = np.array([90.0 - 0.5 * crossing, 90.0 + 0.5 * crossing])
    belief = stations_at([[-half, 0.0], [half, 0.0]], sight + np.array([angle - 2.0, 2.0 - angle]), [0.0, 10.0])
    np.testing.assert_allclose(open_baseline(belief, 80.0, 20.0, 90.0)[0], [0.4, -0.4], atol=1e-3)


def test_opening_turns_on_the_spot_while_the_course_is_too_far_off():
    belief = stations_at([[-1.0, 0.0], [1.0, 0.0]], [180.0 + 89.0, 0.0 - 91.0], [0.0, 1e5])
    turns, speeds = open_baseline(belief, 90.0, 90.0)
    np.testing.assert_allclose(turns, [-1.0, 1.0])
    np.testing.assert_allclose(speeds, [1.0, -1.0])
    np.testing.assert_allclose(open_baseline(belief, 90.0, 90.0, 90.0, 180.0)[1], 1.0)


@pytest.mark.parametrize(("cross", "crosses"), [(0.0, True), (3.9, True), (4.1, False), (math.inf, False)])
def test_opening_crosses_where_that_saves_turns(cross, crosses):
    """Both head inwards, 170° off; the other side is 10° off: 160° or 32 s saved, 4 times the 8 s of the baseline."""
    belief = stations_at([[-1.0, 0.0], [1.0, 0.0]], [10.0, 170.0], [0.0, 1e5])
    commands = open_baseline(belief, 90.0, 90.0, 90.0, 90.0, cross)
    np.testing.assert_allclose(commands, [[-1.0, 1.0], [1.0, 1.0]] if crosses else [[1.0, -1.0], [-1.0, -1.0]])


def test_three_stations_open_to_both_sides_and_the_middle_one_to_the_side_it_heads_for():
    for middle, side in ((100.0, 1.0), (80.0, -1.0)):
        belief = stations_at([[-1.0, 0.0], [0.0, 0.0], [1.0, 0.0]], [90.0, middle, 90.0], [0.0, 1e5])
        np.testing.assert_allclose(open_baseline(belief, 80.0, 80.0)[0], [1.0, side, -1.0])


def test_ground_stations_halt_on_every_other_step():
    belief = stations_at([[-1.0, 0.0], [1.0, 0.0]], [180.0, 0.0], [0.0, 1e5])
    speeds = [
        open_baseline(belief._replace(steps_left=np.array([left])), 90.0, 90.0, halt_every=2)[1]
        for left in (70, 69, 68, 67)
    ]
    np.testing.assert_allclose(speeds, np.repeat([[1.0], [-1.0], [1.0], [-1.0]], 2, axis=1))


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"wide_deg": 181.0}, "wide_deg = 181.0"), ({"narrow_deg": -1.0}, "narrow_deg = -1.0"),
        ({"within_deg": math.nan}, "within_deg = nan"), ({"crossing_deg": 0.0}, "crossing_deg = 0.0"),
        ({"cross": -1.0}, "cross = -1.0"), ({"cross": math.nan}, "cross = nan"),
        ({"halt_every": 0}, "halt_every = 0"),
    ],
    ids=str,
)  # fmt: skip
def test_impossible_openings_are_errors(settings, message):
    with pytest.raises(ValueError, match=message):
        OpenBaseline(ManeuveringTarget(), **{"wide_deg": 80.0, **settings})


@pytest.mark.parametrize(
    ("fields", "crosses", "halt_every"),
    [({}, True, None), ({"course": "flights"}, False, None), ({"carrier": "ground"}, True, 2)],
)
def test_the_opening_rule_suits_the_variant(fields, crosses, halt_every):
    policy = make_policy("rule", ManeuveringTarget(**fields))
    assert isinstance(policy, OpenBaseline)
    assert (policy._cross < math.inf) == crosses
    assert policy._halt_every == halt_every


def test_policies_of_stations_that_fix_known_by_name():
    offer = policy_names(ManeuveringTarget())
    assert offer == ["fixed", "straight", "random", "open", "rule_bend", "rule", "greedy", "planner", "oracle"]
    with pytest.raises(ValueError, match=r"unknown policy 'paper': ManeuveringTarget offers fixed, .*planner, oracle"):
        make_policy("paper", ManeuveringTarget())


# ------------------------------------------------------------------------------------------------ random


def test_random_policy_is_repeatable_and_spreads_over_the_box():
    scenario = TwoStation(steps=30)
    runs = [headings_flown(make_policy("random", scenario, seed), scenario, episodes=20) for seed in (3, 3, 4)]
    assert np.array_equal(runs[0], runs[1])
    assert not np.array_equal(runs[0], runs[2])
    shares = wrapped_deg(np.diff(runs[0], axis=0)) / 10.0
    assert shares.min() == pytest.approx(-1.0, abs=0.02)
    assert shares.max() == pytest.approx(1.0, abs=0.02)
    assert abs(shares.mean()) < 3.3 / math.sqrt(3.0 * shares.size)


def test_random_policy_repeats_itself_after_reset():
    scenario = TwoStation(steps=5)
    policy = make_policy("random", scenario, 1)
    first, second = (headings_flown(policy, scenario, episodes=2) for _ in range(2))
    assert np.array_equal(first, second)


def test_random_commands_belong_to_the_episode_and_not_to_its_place_in_a_batch():
    """So that an evaluation gives the same result however it is cut into blocks."""
    scenario = TwoStation(steps=6)
    whole = headings_flown(make_policy("random", scenario, 7), scenario, seed=10, episodes=5)
    part = headings_flown(make_policy("random", scenario, 7), scenario, seed=12, episodes=3)
    assert np.array_equal(whole[:, 2:], part)
    assert len(np.unique(np.diff(whole, axis=0)[0])) == 10  # and no two platforms turn alike


# ------------------------------------------------------------------------------------------------ all of them


@pytest.mark.parametrize(
    ("family", "name", "fields"),
    [
        *((TwoStation, name, fields) for name in BELIEF_ONLY for fields in ({}, MISSES)),
        *((AngleFusion, name, fields) for name in IN_SPACE for fields in ({}, ROUGH)),
        *((ManeuveringTarget, name, fields) for name in FIXING for fields in ({}, GROUND)),
    ],
)
def test_policies_depend_on_the_belief_only(monkeypatch, family, name, fields):
    """The truth behind the same bearings is another: every command is the same."""
    scenario = family(**fields)

    def decide():
        policy, begun = make_policy(name, scenario, 0), []

        def act(belief, observation):
            if not begun:
                policy.reset(belief)
                begun.append(True)
            return policy.act(belief, observation)

        return act

    first, second = fly_twins(monkeypatch, scenario, decide, range(4))
    assert not np.array_equal(first.truth[10], second.truth[10])
    assert np.array_equal(first.commands, second.commands)


@pytest.mark.parametrize(
    ("scenario", "name"),
    [
        *((TwoStation(targets=2, steps=4), name) for name in BELIEF_ONLY),
        *((AngleFusion(steps=4, **ROUGH), name) for name in IN_SPACE),
        *((ManeuveringTarget(steps=4), name) for name in FIXING),
    ],
)
def test_policies_obey_the_protocol(scenario, name):
    policy = make_policy(name, scenario)
    assert isinstance(policy, Policy)
    simulation = Simulation(scenario)
    for episodes in (1, 3):
        world = simulation.begin([np.random.default_rng(seed) for seed in range(episodes)])
        belief = simulation.belief(world)
        before = map_rows(np.copy, belief)
        assert policy.reset(belief) is None
        commands = policy.act(belief, simulation.observe(world))
        assert commands.shape == (episodes, simulation.actions.size)
        assert np.issubdtype(commands.dtype, np.floating)
        assert np.abs(commands).max() <= 1.0
        map_rows(np.testing.assert_array_equal, belief, before)


@pytest.mark.parametrize("name", BELIEF_ONLY)
@pytest.mark.parametrize(
    "fields",
    [
        {"actions": "discrete"}, {"targets": 1}, {"targets": 6}, {"course": "flights"}, {"tracker": "fused_ekf"},
        {"steps": 1}, {"station_speed_m_s": 0.0}, {"max_turn_rate_deg_s": 0.0},
    ],
    ids=str,
)  # fmt: skip
def test_every_policy_flies_every_kind_of_scenario(name, fields):
    assert_flies_within_the_action_space(name, TwoStation(**{"steps": 8, **fields}))


@pytest.mark.parametrize(
    "fields",
    [
        {"actions": "discrete"}, {"course": "paper"}, {"course": "flights"}, {"steps": 1},
        {"max_turn_rate_deg_s": 0.0}, {"max_turn_rate_deg_s": 1.0}, ROUGH,
    ],
    ids=str,
)  # fmt: skip
@pytest.mark.parametrize("name", IN_SPACE)
def test_every_policy_in_space_flies_every_kind_of_scenario(name, fields):
    assert_flies_within_the_action_space(name, AngleFusion(**{"steps": 5, **fields}))


@pytest.mark.parametrize(
    "fields",
    [
        {"actions": "discrete"}, {"course": "paper1"}, {"course": "paper2"}, {"course": "flights"}, {"steps": 1},
        {"max_turn_rate_deg_s": 0.0}, {"stations": 4}, {"tracker": "imm3"}, {"standoff_m": 10e3}, GROUND,
    ],
    ids=str,
)  # fmt: skip
@pytest.mark.parametrize("name", FIXING)
def test_every_policy_of_stations_that_fix_flies_every_kind_of_scenario(name, fields):
    assert_flies_within_the_action_space(name, ManeuveringTarget(**{"steps": 5, **fields}))


@pytest.mark.parametrize(
    ("scenario", "name"),
    [
        *((TwoStation(steps=6), name) for name in BELIEF_ONLY),
        *((AngleFusion(steps=6, **ROUGH), name) for name in IN_SPACE),
        *((ManeuveringTarget(steps=6, **GROUND), name) for name in FIXING),
    ],
)
def test_a_policy_decides_row_by_row(scenario, name):
    """Batch equals loop."""
    decide = {}

    def acting(policy):
        begun = []

        def act(belief, observation):
            if not begun:
                policy.reset(belief)
                begun.append(True)
            return policy.act(belief, observation)

        return act

    decide["batch"] = fly(scenario, acting(make_policy(name, scenario)), range(4)).commands
    for row in range(4):
        alone = fly(scenario, acting(make_policy(name, scenario)), range(row, row + 1)).commands
        np.testing.assert_allclose(np.array(decide["batch"])[:, row], np.array(alone)[:, 0], rtol=0, atol=1e-12)


def test_policies_known_by_name():
    assert {"paper", "paper_opposed", "straight", "random", "rule", "rule_perpendicular"} <= set(NAMES)
    scenario = TwoStation()
    assert isinstance(make_policy("paper", scenario), Schedule)
    assert isinstance(make_policy("straight", scenario), Straight)
    assert isinstance(make_policy("random", scenario), Random)
    assert isinstance(make_policy("rule", scenario), TurnApart)


@pytest.mark.parametrize("name", ["rules", "", "Paper", "learned"])
def test_an_unknown_policy_is_an_error_that_lists_the_known_ones(name):
    with pytest.raises(ValueError, match=rf"unknown policy '{name}'.*paper, .*rule"):
        make_policy(name, TwoStation())


def test_an_object_without_the_verbs_is_no_policy():
    assert not isinstance(object(), Policy)
    assert not isinstance(PassiveEnv(), Policy)


def test_policies_run_in_a_plain_gymnasium_loop():
    """The batch of one, as a user writes it."""
    env = gym.make("passive/TwoStation-v0", steps=5)
    policy = make_policy("rule", env.unwrapped.scenario)
    observation, _ = env.reset(seed=0)
    policy.reset(env.unwrapped.belief())
    total, truncated = 0.0, False
    while not truncated:
        command = policy.act(env.unwrapped.belief(), observation[None])[0].astype(np.float32)
        observation, reward, _, truncated, _ = env.step(command)
        total += reward
    assert math.isfinite(total)


# ------------------------------------------------------------------------------------------------ one platform


def one_platform(**fields):
    """The fields of a scenario that the rules read."""
    return SimpleNamespace(**{"step_s": 5.0, "steps": 60, "max_turn_rate_deg_s": 3.0, **fields})


def fly_past(policy, target, steps=60, tracks=1):
    """Angles [k] deg of the courses off the line of sight, the estimate being the truth; the platform heads east."""
    own, target = np.array([[[0.0, 0.0, 250.0, 0.0]]]), np.tile(np.array(target, dtype=float), (1, tracks, 1))
    off = []
    for k in range(steps):
        belief = Belief(np.array([60 - k]), own, target, None, None, None, np.zeros((1, 1)), None, np.empty((1, 0, 3)))
        if k == 0:
            policy.reset(belief)
        command = policy.act(belief, np.empty((1, 0)))
        assert np.abs(command).max() <= 1.0
        own = turn(own, command * math.radians(3.0), 5.0)
        sight = np.degrees(np.arctan2(*(target[0, 0, 1::-1] - own[0, 0, 1::-1])))
        off.append(float(wrapped_deg(np.degrees(np.arctan2(own[0, 0, 3], own[0, 0, 2])) - sight)))
        target = target + 5.0 * np.concatenate([target[..., 2:], np.zeros((1, tracks, 2))], axis=-1)
    return np.array(off)


def test_zigzag_changes_sides_with_every_leg_and_follows_the_line_of_sight():
    """Legs of 75 s at 60°: 15 steps each, of which up to 8 turn by 15°; the first is on the nearer side."""
    off = fly_past(Zigzag(one_platform(), 75.0, 60.0), [300e3, 100e3, -100.0, 150.0])
    for leg, side in enumerate((-1.0, 1.0, -1.0, 1.0)):
        np.testing.assert_allclose(off[15 * leg + 9 : 15 * leg + 15], side * 60.0, atol=0.5)


def test_perpendicular_keeps_to_one_side():
    offer = policy_names(Ownship())
    assert offer[:6] == ["straight", "random", "perpendicular", "lead_lag", "rule", "rule_average"]
    off = fly_past(make_policy("perpendicular", Ownship()), [300e3, -100e3, -100.0, 150.0])
    np.testing.assert_allclose(off[8:], 90.0, atol=0.5)


@pytest.mark.parametrize("across", [-150.0, 150.0])
def test_lead_lag_lags_then_leads_once_the_targets_course_is_known(across):
    """A target that moves left of the line of sight is lagged on the right; the first leg is on the nearer side."""
    off = fly_past(LeadLag(one_platform(), 50.0, 70.0), [300e3, 50e3, -100.0, across])
    assert off[9] == pytest.approx(-70.0, abs=0.5)
    for leg, lead in ((2, False), (3, True), (4, False), (5, True)):
        side = np.sign(across) if lead else -np.sign(across)
        assert off[10 * leg + 9] == pytest.approx(70.0 * side, abs=1.0), leg


@pytest.mark.parametrize(
    ("leg_s", "angle_deg", "message"),
    [(0.0, 60.0, "leg_s = 0.0"), (math.nan, 60.0, "leg_s = nan"), (50.0, 181.0, "angle_deg = 181.0"),
     (50.0, -1.0, "angle_deg = -1.0"), (50.0, math.nan, "angle_deg = nan")],
)  # fmt: skip
@pytest.mark.parametrize("kind", [Zigzag, LeadLag])
def test_impossible_legs_are_errors(kind, leg_s, angle_deg, message):
    with pytest.raises(ValueError, match=message):
        kind(one_platform(), leg_s, angle_deg)


def test_a_policy_of_another_family_is_an_error_that_names_those_on_offer():
    with pytest.raises(ValueError, match=r"unknown policy 'lead_lag': TwoStation offers paper, .*rule_tuned.*planner"):
        make_policy("lead_lag", TwoStation())
    with pytest.raises(ValueError, match=r"unknown policy 'paper': Ownship offers straight, random, perpendicular"):
        make_policy("paper", Ownship())
