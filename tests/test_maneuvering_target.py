"""A maneuvering target: courses, stations' motion, azimuths, figures of merit, observation, pictures, bad input."""

import dataclasses
import itertools
import math

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.stats import binom, kstest, norm
from spoilt_trackers import SPOILT, spoilt_later
from twin_worlds import assert_blind_to_truth, assert_twins_look_alike, fly_twins, random_decisions

from agents.comparison import summarize
from agents.evaluation import fly as fly_policy
from agents.policy import make_policy
from agents.report import as_csv, as_markdown
from passive_env import PassiveEnv, PassiveVectorEnv
from passive_env.catalogue import make_scenario
from passive_env.catalogue.maneuvering import PAPER_MIDDLE_M, ManeuveringTarget, paper_acceleration
from passive_env.core import Simulation, map_rows
from passive_env.flights import load_flights
from passive_env.kinematics import STANDING_M_S, drive, random_maneuvers
from passive_env.maneuver_metrics import PRIOR_POSITION_STD_M
from passive_env.truth import AHEAD_S
from trackers import MANEUVER_TRACKERS, Imm3, ImmMie
from trackers.angles import wrap
from trackers.bounds import fisher_information, posterior_bound_information, range_std

NAME = "ManeuveringTarget"
STAND, GO = [0.0, 0.0, -1.0, -1.0], [0.0, 0.0, 1.0, 1.0]
ROUGH = {"detection_probability": 0.7, "carrier": "ground", "stations": 3}


def begin(episodes, **fields):
    """A scenario's simulation and the world of its first instant."""
    simulation = Simulation(make_scenario(NAME, fields))
    return simulation, simulation.begin([np.random.default_rng(seed) for seed in range(episodes)])


def flown(episodes, steps, command=None, seed=0, **fields):
    """All worlds of a flight under one command for all, or random ones."""
    simulation, world = begin(episodes, **fields)
    rng, size = np.random.default_rng(seed), simulation.actions.size
    worlds = [world]
    for _ in range(steps):
        chosen = rng.uniform(-1.0, 1.0, (episodes, size)) if command is None else np.tile(command, (episodes, 1))
        worlds.append(simulation.advance(worlds[-1], np.asarray(chosen, dtype=float))[0])
    return simulation, worlds


def share_band(probability, n):
    """Share of n draws that leaves this band once in 10,000 times."""
    return binom.ppf([5e-5, 1 - 5e-5], n, probability) / n


# ------------------------------------------------------------------------------------------------ courses


def test_defaults_are_those_of_the_problem():
    s = make_scenario(NAME, {})
    assert (s.stations, s.baseline_m, s.azimuth_std_mrad, s.step_s, s.steps) == (2, 2e3, 1.0, 1.0, 70)
    assert (s.max_speed_m_s, s.min_speed_m_s, s.top_speed_m_s, s.tracker) == (250.0, 0.0, 250.0, "imm_mie")
    assert (s.target_acceleration_max_m_s2, s.target_turn_max_rad_s) == (30.0, 0.1)
    assert make_scenario(NAME, {"carrier": "ground"}).top_speed_m_s == 25.0


def test_drawn_starts_fill_their_limits():
    _, world = begin(600)
    start, platforms = world.truth[:, 0], world.platforms
    sight = np.arctan2(start[:, 1], start[:, 0])
    gap = platforms[:, 1, :2] - platforms[:, 0, :2]
    tilt = wrap(np.arctan2(gap[:, 1], gap[:, 0]) - sight - 0.5 * math.pi)
    for values, low, high in (
        (np.hypot(start[:, 0], start[:, 1]), 15e3, 30e3),
        (np.hypot(start[:, 2], start[:, 3]), 150.0, 350.0),
        (sight, -math.pi, math.pi),
        (np.arctan2(start[:, 3], start[:, 2]), -math.pi, math.pi),
        (np.degrees(tilt), -30.0, 30.0),
        (np.arctan2(platforms[:, 0, 3], platforms[:, 0, 2]), -math.pi, math.pi),
        (wrap(np.diff(np.arctan2(platforms[..., 3], platforms[..., 2]))[:, 0]), -math.pi, math.pi),
    ):
        assert kstest(values, "uniform", args=(low, high - low)).pvalue > 1e-4
    np.testing.assert_allclose(platforms[..., :2].mean(1), 0.0, atol=1e-9)
    np.testing.assert_allclose(np.hypot(*gap.T), 2e3)
    np.testing.assert_allclose(np.hypot(platforms[..., 2], platforms[..., 3]), STANDING_M_S)


def test_more_stations_stand_evenly_along_the_baseline():
    _, world = begin(3, stations=4, baseline_m=9e3)
    gaps = np.diff(world.platforms[..., :2], axis=1)
    np.testing.assert_allclose(np.hypot(gaps[..., 0], gaps[..., 1]), 3e3)
    np.testing.assert_allclose(gaps[:, 1:], gaps[:, :-1], atol=1e-9)


def legs_of(u, limits, speed, until):
    """Stages (duration, acceleration along the course, turn rate) of a schedule, read off its uniform numbers."""
    stages, t, leg = [], 0.0, 0
    while t < until:
        row = u[min(leg, len(u) - 1)]
        quiet = limits[0] + (limits[1] - limits[0]) * row[0]
        size = limits[4] + (limits[5] - limits[4]) * row[2]
        if row[1] < limits[9]:
            rate = min(size / speed, limits[6]) * (1.0 if row[4] < 0.5 else -1.0)
            stage = (limits[2] + (limits[3] - limits[2]) * row[3], 0.0, rate)
        else:
            gain = limits[7] + (limits[8] - limits[7]) * row[3] - speed
            stage = (min(abs(gain) / size, limits[3]), math.copysign(size, gain), 0.0)
            speed += stage[0] * stage[1]
        stages += [(quiet, 0.0, 0.0), stage]
        t += quiet + stage[0]
        leg += 1
    return stages


def test_random_maneuvers_are_what_their_schedules_integrate_to():
    """Second route: the stages written as a list, and each integrated numerically."""
    rng = np.random.default_rng(2)
    limits = np.array([5.0, 20.0, 5.0, 30.0, 10.0, 30.0, 0.1, 150.0, 350.0, 0.6])
    start = np.array([[100.0, -50.0, 200.0, 90.0], [0.0, 10.0, -150.0, 80.0], [5.0, 5.0, 10.0, -320.0]])
    u = rng.random((3, 3, 5))  # fewer legs than the path has: the last one repeats
    paths, accelerations = random_maneuvers(start, u, limits, 0.5, np.empty(201))
    for e in range(3):
        state, t, grid = start[e], 0.0, 0.5 * np.arange(201)
        for duration, a, w in legs_of(u[e], limits, math.hypot(*start[e, 2:]), 100.0):

            def force(v, a=a, w=w):
                return a * v / np.hypot(*v) + w * np.array([-v[1], v[0]])

            motion = solve_ivp(
                lambda _, x, force=force: np.concatenate([x[2:], force(x[2:])]), (0.0, duration), state,
                dense_output=True, rtol=1e-10, atol=1e-8,
            )  # fmt: skip
            inside = (grid >= t) & (grid < t + duration)
            for k in np.flatnonzero(inside):
                np.testing.assert_allclose(paths[e, k], motion.sol(grid[k] - t), rtol=1e-7, atol=1e-4)
                np.testing.assert_allclose(accelerations[e, k], force(paths[e, k, 2:]), atol=1e-9)
            state, t = motion.y[:, -1], t + duration


def test_drawn_maneuvers_keep_their_limits_and_the_share_of_turns():
    _, world = begin(400)
    path, a = world.tape.targets[:, :, 0], world.tape.accelerations[:, :, 0]
    speed, size = np.hypot(path[..., 2], path[..., 3]), np.hypot(a[..., 0], a[..., 1])
    assert speed.min() > 150.0 - 1e-6
    assert speed.max() < 350.0 + 1e-6
    along = (a * path[..., 2:]).sum(-1) / speed
    left = (path[..., 2] * a[..., 1] - path[..., 3] * a[..., 0]) / speed
    busy = size > 0.0
    assert size.max() < 30.0 + 1e-9
    assert (np.abs(left) / speed).max() < 0.1 + 1e-12
    turning, speeding = np.abs(left) > 1e-6, np.abs(along) > 1e-6
    assert not (turning & speeding).any()
    assert size[speeding].min() > 10.0 - 1e-9
    assert size[turning].min() >= 10.0 - 1e-9
    assert not busy[:, :5].any()
    starts = busy[:, 1:] & ~busy[:, :-1]
    low, high = share_band(0.75, int(starts.sum()))
    assert low < turning[:, 1:][starts].mean() < high
    assert 0.3 < busy.mean() < 0.7


def test_the_papers_second_track_is_the_specifications():
    """Straight at 300 m/s to 20 s, a left turn at 0.1 rad/s about (6000, 3000) with radius 3000 m to 50 s, straight."""
    _, world = begin(1, course="paper2", baseline_m=10e3)
    path, a = world.tape.targets[0, :, 0], world.tape.accelerations[0, :, 0]
    t = np.arange(71.0)
    turned = np.clip(0.1 * (t - 20.0), 0.0, 3.0)
    after = np.maximum(t - 50.0, 0.0)
    x = np.minimum(300.0 * t, 6000.0) + 3000.0 * np.sin(turned) + 300.0 * np.cos(turned) * after
    y = 3000.0 * (1.0 - np.cos(turned)) + 300.0 * np.sin(turned) * after
    np.testing.assert_allclose(path[:, :2], np.stack([x, y], -1), atol=1e-6)
    np.testing.assert_allclose(np.hypot(*a.T), np.where((t >= 20) & (t < 50), 30.0, 0.0), atol=1e-9)
    to_center = np.array([6000.0, 3000.0]) - path[20:50, :2]
    np.testing.assert_allclose(a[20:50], to_center / 100.0, atol=1e-6)
    np.testing.assert_allclose(world.platforms[0, :, :2], [[-2e3, -20e3], [8e3, -20e3]])
    assert PAPER_MIDDLE_M == (3e3, -20e3)


def test_the_papers_first_track_adds_up_its_accelerations():
    t = np.arange(81.0)
    u = paper_acceleration(t)
    assert np.array_equal(u[[0, 14, 15, 39, 40]], [0.0, 0.0, 20.0, 20.0, 20.0])
    np.testing.assert_allclose(u[[60, 80]], [10.0, 0.0], atol=1e-12)
    _, world = begin(200, course="paper1", steps=80)
    path, a = world.tape.targets[:, :, 0], world.tape.accelerations[:, :, 0]
    np.testing.assert_array_equal(a, np.broadcast_to(np.stack([u, 0.0 * u], -1), a.shape))
    pushed = np.diff(path[..., 2:], axis=1) - a[:, :-1]  # the perturbation of 1 m/s² per axis
    assert kstest(pushed.ravel(), norm.cdf).pvalue > 1e-4
    moved = path[:, :-1, 2:] + 0.5 * (a[:, :-1] + pushed)
    np.testing.assert_allclose(np.diff(path[..., :2], axis=1), moved, atol=1e-6)
    assert np.array_equal(path[:, 0], np.tile([0.0, 0.0, 100.0, 100.0], (200, 1)))


def test_the_papers_raw_fixes_are_as_far_off_as_the_specification_says():
    """Section 8: root mean square errors of the raw fix with stations that stand, within 10 %."""
    for baseline_m, expected in ((2e3, 398.0), (5e3, 161.0), (10e3, 84.0), (20e3, 50.0), (40e3, 44.0)):
        _, worlds = flown(60, 70, STAND, course="paper2", baseline_m=baseline_m)
        errors = np.array([world.metrics.fix_error_m for world in worlds])
        assert math.sqrt(np.square(errors).mean()) == pytest.approx(expected, rel=0.1)


@pytest.mark.parametrize(("tracker", "expected"), [("imm_mie", 138.0), ("imm3", 178.0)])
def test_the_papers_turn_is_tracked_as_well_as_the_specification_says_by_stations_that_close_in(tracker, expected):
    """Section 8: both stations fly north at 250 m/s from 2 km apart; root mean square error from 26 to 50 s."""
    simulation, world = begin(100, course="paper2", tracker=tracker)
    platforms = world.platforms.copy()
    platforms[..., 2:] = 0.0, STANDING_M_S
    world, errors = world._replace(platforms=platforms), []
    for _ in range(50):
        world = simulation.advance(world, np.tile(GO, (100, 1)))[0]
        errors.append(world.metrics.position_error_m)
    assert math.sqrt(np.square(errors[25:49]).mean()) == pytest.approx(expected, rel=0.1)


def test_recorded_flights_keep_their_shape_and_turn_as_long_as_asked():
    scenario = make_scenario(NAME, {"course": "flights", "flight_turn_s": 10.0, "steps": 40})
    recorded = load_flights().split("train").resample(1.0).states
    tape = scenario.draw_tape([np.random.default_rng(seed) for seed in range(12)])
    for path, a in zip(tape.targets[:, :, 0], tape.accelerations[:, :, 0], strict=True):
        speed = np.hypot(*path[:, 2:].T)
        at = next(i for i in np.flatnonzero(np.isclose(np.hypot(*recorded[:, 3:5].T), speed[0], rtol=1e-12))
                  if np.allclose(np.hypot(*recorded[i : i + 41, 3:5].T), speed, rtol=1e-9))  # fmt: skip
        gaps = [np.hypot(*np.diff(p[:, :2], axis=0).T) for p in (path, recorded[at : at + 41])]
        np.testing.assert_allclose(*gaps, rtol=1e-9, atol=1e-6)
        assert (np.hypot(*np.diff(path[:, 2:], axis=0).T) > 3.0).sum() >= 10
        np.testing.assert_allclose(a[1:-1], 0.5 * (path[2:, 2:] - path[:-2, 2:]), atol=1e-9)
    everything = make_scenario(NAME, {"course": "flights", "steps": 40})
    assert len(scenario._flight_rows) < len(everything._flight_rows)
    np.testing.assert_array_equal(everything._flight_rows, everything.flight_paths.window_starts(40))


def test_keywords_that_add_misses_leave_the_episode_as_it_is():
    plain, rough = begin(5)[1], begin(5, detection_probability=0.5)[1]
    for name in ("platforms", "targets", "accelerations", "noise"):
        assert np.array_equal(getattr(plain.tape, name), getattr(rough.tape, name)), name


# ------------------------------------------------------------------------------------------------ motion


def test_stations_drive_arcs_at_their_commanded_speed():
    start = np.array([[100.0, -50.0, 0.0, STANDING_M_S], [0.0, 0.0, 30.0, 40.0]])
    first, second = drive(start, np.array([0.05, 0.0]), np.array([200.0, 100.0]), 2.0)
    radius = 200.0 / 0.05
    np.testing.assert_allclose(
        first,
        [
            100.0 - radius * (1.0 - math.cos(0.1)), -50.0 + radius * math.sin(0.1),
            -200.0 * math.sin(0.1), 200.0 * math.cos(0.1),
        ],
        rtol=1e-12,
    )  # fmt: skip
    np.testing.assert_allclose(second, [120.0, 160.0, 60.0, 80.0], rtol=1e-12)


def test_a_station_that_stands_stays_and_turns_on_the_spot():
    _, worlds = flown(2, 30, [1.0, -0.5, -1.0, -1.0])
    first, last = worlds[0].platforms, worlds[-1].platforms
    np.testing.assert_allclose(first[..., :2], last[..., :2], atol=1e-4)
    headings = [np.arctan2(p[..., 3], p[..., 2]) for p in (first, last)]
    expected = np.radians([150.0, -75.0])
    np.testing.assert_allclose(wrap(headings[1] - headings[0] - expected), 0.0, atol=1e-9)


def test_actions_are_turns_then_speeds_between_the_least_and_the_top():
    _, worlds = flown(1, 1, [1.0, -0.5, 1.0, -0.5], min_speed_m_s=50.0)
    before, after = (world.platforms[0] for world in worlds)
    np.testing.assert_allclose(np.hypot(*before[:, 2:].T), 50.0)
    np.testing.assert_allclose(np.hypot(*after[:, 2:].T), [250.0, 100.0])
    heading = [np.degrees(np.arctan2(p[:, 3], p[:, 2])) for p in (before, after)]
    np.testing.assert_allclose((heading[1] - heading[0] + 180.0) % 360.0 - 180.0, [5.0, -2.5], rtol=1e-9)


def test_discrete_actions_are_three_of_every_rate_and_speed():
    env, twin = PassiveEnv(NAME, actions="discrete"), PassiveEnv(NAME)
    assert np.array_equal(env.action_space.nvec, [3, 3, 3, 3])
    env.reset(seed=0), twin.reset(seed=0)
    observed, expected = env.step(np.array([0, 1, 2, 1]))[0], twin.step(np.array([-1.0, 0.0, 1.0, 0.0]))[0]
    assert np.array_equal(observed, expected)


def test_a_constant_heading_opens_the_baseline_at_full_speed():
    """60° outwards off each line of sight: once the turns are over, both fly there, on opposite sides."""
    env = PassiveVectorEnv(NAME, 20, "disabled", threads=1, actions="headings")
    env.reset(seed=0)
    for _ in range(50):
        env.step(np.tile([1 / 3, 1 / 3, 1.0, 1.0], (20, 1)))
    platforms, mean = env.world.platforms, env.world.estimate.mean[:, 0]
    sight = mean[:, None, :2] - platforms[..., :2]
    off = wrap(
        np.arctan2(platforms[..., 3], platforms[..., 2]) - np.arctan2(sight[..., 1], sight[..., 0])
    )  # the line of sight has moved by less than 5° since the action
    np.testing.assert_allclose(np.sort(np.degrees(off), axis=1), np.tile([-60.0, 60.0], (20, 1)), atol=5.0)
    np.testing.assert_allclose(np.hypot(platforms[..., 2], platforms[..., 3]), 250.0)
    gap = platforms[:, 0, :2] - platforms[:, 1, :2]
    assert (np.hypot(*gap.T) > 5e3).all()


# ------------------------------------------------------------------------------------------------ azimuths, fixes


def scans_of(simulation, worlds):
    """The scans of a flight, taken again."""
    step = [np.full(len(world.platforms), k) for k, world in enumerate(worlds)]
    return [simulation.sensors.sense(w.tape, k, w.platforms, None).scan for k, w in zip(step, worlds, strict=True)]


def test_azimuths_are_the_true_ones_with_the_noise_of_the_tape():
    simulation, worlds = flown(40, 20, azimuth_std_mrad=2.0)
    for k, (world, scan) in enumerate(zip(worlds, scans_of(simulation, worlds), strict=True)):
        away = world.truth[:, :, :2] - world.platforms[..., :2]
        exact = np.arctan2(away[..., 1], away[..., 0])
        np.testing.assert_allclose(wrap(scan.bearings - exact), 2e-3 * world.tape.noise[:, k], atol=1e-9)
        assert scan.valid.all()
        assert np.array_equal(scan.bearing_std, np.full((40, 2), 2e-3))
        assert np.array_equal(world.reports.returns, np.full(40, 2))
    assert kstest(worlds[0].tape.noise.ravel(), norm.cdf).pvalue > 1e-4


def test_targets_are_missed_as_often_as_the_detection_probability_says():
    simulation, worlds = flown(100, 20, detection_probability=0.7)
    scans = scans_of(simulation, worlds)
    low, high = share_band(0.7, 100 * 20 * 2)
    assert low < np.mean([scan.valid for scan in scans[1:]]) < high
    assert scans[0].valid.all()
    both = np.array([scan.valid.all(-1) for scan in scans])
    fixed = np.array([world.reports.fixed[:, 0] for world in worlds])
    assert not (fixed & ~both).any()
    assert (both & ~fixed).mean() < 0.02  # lines that noise makes cross behind a station
    for world in worlds:
        assert np.array_equal(world.reports.assigned[:, 0], np.repeat(world.reports.fixed, 2, axis=1))
        assert np.array_equal(world.metrics.fix_error_m > 0.0, world.reports.fixed)


def test_ground_stations_measure_only_while_they_stand():
    simulation, worlds = flown(3, 5, GO, carrier="ground")
    np.testing.assert_allclose(np.hypot(*worlds[-1].platforms[0, :, 2:].T), 25.0)
    assert worlds[0].reports.fixed.all()
    spread = [np.trace(world.estimate.cov[0, 0, :2, :2]) for world in worlds]
    assert not any(world.reports.fixed.any() or world.reports.returns.any() for world in worlds[1:])
    assert (np.diff(spread) > 0.0).all()  # the track coasts
    bound = [world.metrics.position_crlb_m[0, 0] for world in worlds]
    assert (np.diff(bound) > 0.0).all()
    stood, *_ = simulation.advance(worlds[-1], np.tile(STAND, (3, 1)))
    assert stood.reports.fixed.all()
    assert (stood.reports.returns == 2).all()
    assert stood.metrics.position_crlb_m[0, 0] < bound[-1]
    slow = np.tile([0.0, 0.0, -0.92, -0.92], (3, 1))  # 1 m/s, the limit
    assert simulation.advance(worlds[-1], slow)[0].reports.fixed.all()


def test_lines_of_sight_that_do_not_cross_let_the_track_coast():
    """From 10 m apart noise decides whether lines cross ahead: about as often as not."""
    simulation, worlds = flown(40, 40, STAND, baseline_m=10.0)
    fixed = np.array([world.reports.fixed[:, 0] for world in worlds])
    assert 0.3 < fixed[1:].mean() < 0.7
    tracker = simulation.tracker
    for before, world in itertools.pairwise(worlds):
        assert np.array_equal(world.reports.assigned[:, 0], np.repeat(world.reports.fixed, 2, axis=1))
        prior, coasts = tracker.predict(before.track_state, 1.0), ~world.reports.fixed[:, 0]
        coasted = tracker.estimate(tracker.update_fix(prior, np.zeros(2), np.zeros((2, 2)), False).posterior)
        for ours, expected in zip(world.estimate, coasted, strict=True):
            np.testing.assert_array_equal(ours[coasts], expected[coasts])
            assert not np.array_equal(ours[~coasts], expected[~coasts])
        shown = [simulation.observe(world), *world.metrics, *simulation.info(world).values()]
        assert all(np.isfinite(part).all() for part in shown if not isinstance(part, dict))


# ------------------------------------------------------------------------------------------------ trackers


@pytest.mark.parametrize("name", MANEUVER_TRACKERS)
def test_every_tracker_by_name_flies_and_tells_its_models(name):
    simulation, worlds = flown(4, 12, tracker=name)
    told = worlds[-1].reports
    assert told.model_probability.shape == told.detected.shape == (4, 1, simulation.tracker.models)
    np.testing.assert_allclose(told.model_probability.sum(-1), 1.0)
    np.testing.assert_allclose(worlds[0].reports.model_probability, 1.0 / simulation.tracker.models)
    assert np.isfinite(worlds[-1].metrics.acceleration_error_m_s2).all()


def test_settings_reach_the_tracker():
    fields = {"initial_velocity_std_m_s": 150.0, "range_floor_m": 4e3, "range_cap_m": 8e4, "mixing": "sens"}
    common = {"initial_velocity_std": 150.0, "floor_m": 4e3, "cap_m": 8e4}
    assert make_scenario(NAME, fields).make_tracker() == ImmMie(mixing="sens", **common)
    assert make_scenario(NAME, {**fields, "tracker": "imm3", "mixing": "literal"}).make_tracker() == Imm3(**common)


def test_a_users_tracker_is_taken_as_it_is():
    own = ImmMie(windows=(5,), thresholds=(9.0,), transition=((1.0,),), floor_m=5e3, cap_m=1e5)
    simulation, worlds = flown(3, 3, GO, tracker=own)
    assert simulation.tracker is own
    assert worlds[-1].reports.model_probability.shape == (3, 1, 1)


@pytest.mark.parametrize("actions", ["continuous", "headings"])
@pytest.mark.parametrize("spoil", SPOILT.values(), ids=SPOILT)
def test_what_a_tracker_loses_later_does_not_leave_the_environment(spoil, actions):
    """Observation, truth of the critic, reward and all of info stay finite, with every reward term in use."""
    weights = {f.name: 1.0 for f in dataclasses.fields(ManeuveringTarget) if f.name.startswith("reward_")}
    tracker = spoilt_later(ImmMie, spoil)
    env = PassiveVectorEnv(NAME, num_envs=3, threads=1, tracker=tracker, steps=8, actions=actions, **weights)
    truth = env.scenario.make_truth_observation()
    env.reset(seed=0)
    with np.errstate(all="ignore"):
        for _ in range(8):
            observation, reward, _, _, info = env.step(np.full((3, 4), 0.3))
            assert observation in env.observation_space
            assert np.isfinite(reward).all()
            assert np.isfinite(truth(env.world)).all()
            assert all(np.isfinite(part).all() for name, part in info.items() if name != "reward_terms")
            assert np.isfinite(env.world.platforms).all()
    assert tracker.asked == 9


class Miscounted(ImmMie):
    """Tells of more models than it has."""

    @property
    def models(self):
        return 3


def test_probabilities_of_another_shape_than_the_models_are_refused():
    env = PassiveEnv(NAME, tracker=Miscounted())
    env.reset(seed=0)
    with pytest.raises(
        ValueError, match=r"Miscounted: update\(\) gave model_probability of shape \(1, 1, 2\), must be"
    ):
        env.step(np.zeros(4))


# ------------------------------------------------------------------------------------------------ figures of merit


def test_the_bound_is_the_information_recursion():
    """Second route: matrix inverses, with the prior's and the first scan's information added up."""
    fields = {"azimuth_std_mrad": 3.0, "bound_acceleration_m_s2": 4.0, "step_s": 2.0, "stations": 3}
    _, worlds = flown(3, 15, **fields)
    truth = np.array([world.truth[:, 0] for world in worlds]).swapaxes(0, 1)
    stations = np.array([world.platforms[..., :2] for world in worlds]).swapaxes(0, 1)
    prior = np.diag(np.square([PRIOR_POSITION_STD_M] * 2 + [200.0] * 2))
    information = np.tile(np.linalg.inv(prior), (3, 1, 1))
    information[:, :2, :2] += fisher_information(truth[:, 0], stations[:, 0], 3e-3)
    covs = posterior_bound_information(truth, stations, np.linalg.inv(information), 3e-3, 2.0, 8.0)
    shown = np.array([world.metrics.range_crlb_m[:, 0] for world in worlds]).T
    np.testing.assert_allclose(shown, range_std(covs, truth, stations[:, :, -1]), rtol=1e-5)
    position = np.array([world.metrics.position_crlb_m[:, 0] for world in worlds]).T
    np.testing.assert_allclose(position, np.sqrt(np.trace(covs[..., :2, :2], axis1=-2, axis2=-1)), rtol=1e-5)


def test_missed_azimuths_widen_the_bound_as_larger_noise_would():
    _, missed = flown(2, 10, GO, detection_probability=0.25)
    _, coarse = flown(2, 10, GO, azimuth_std_mrad=2.0)
    later = [[world.metrics.position_crlb_m for world in worlds[6:]] for worlds in (missed, coarse)]
    np.testing.assert_allclose(*later, rtol=0.2)  # the first scan misses nothing, so they begin apart
    assert (missed[10].metrics.position_crlb_m > flown(2, 10, GO)[1][10].metrics.position_crlb_m).all()


def test_figures_of_merit_and_reward_by_hand():
    names = (
        "log_range_error", "relative_range_error", "log_position_error", "relative_position_error", "position_error",
        "final_position_error", "turn_position_error", "acceleration_error", "log_range_bound", "log_position_bound",
        "information_gain", "maneuver", "standoff", "lost_track",
    )  # fmt: skip
    weights = {f"reward_{name}": 0.1 * (i + 1) for i, name in enumerate(names)}
    env = PassiveEnv(NAME, steps=25, lost_error_m=200.0, lost_nees=1.0, standoff_m=13e3, **weights)
    _, info = env.reset(seed=4)
    world = env.world._replace(platforms=env.world.platforms.copy())
    world.platforms[0, 1, :2] = world.truth[0, 0, :2] + [6e3, 2e3]  # inside the stand-off ring
    env._world = world
    maneuvering = []
    for k in range(25):
        previous = info["range_crlb_m"]
        action = np.array([0.5, -1.0, 0.2, -0.4])
        _, reward, _, truncated, info = env.step(action)
        world = env.world
        (mean,), (cov,), (truth,) = world.estimate.mean[0], world.estimate.cov[0], world.truth[0]
        reference = world.platforms[0, 1, :2]
        true_range = math.dist(truth[:2], reference)
        position_error = math.dist(mean[:2], truth[:2])
        range_error = abs(math.dist(mean[:2], reference) - true_range)
        depth = sum(max(0.0, 1.0 - math.dist(p[:2], truth[:2]) / 13e3) for p in world.platforms[0])
        nees = (mean - truth) @ np.linalg.solve(cov, mean - truth)
        lost = position_error > 200.0 and nees > 1.0
        true_acceleration = world.tape.accelerations[0, k + 1, 0]
        off = math.dist(env.simulation.tracker.acceleration(world.track_state).mean[0, 0], true_acceleration)
        turning = bool(np.hypot(*true_acceleration) > 1.0)
        maneuvering.append(turning)
        for name, value in (
            ("range_m", true_range), ("range_error_m", range_error), ("position_error_m", position_error),
            ("nees", nees), ("lost", lost), ("acceleration_error_m_s2", off), ("maneuvering", turning),
            ("fix_error_m", math.dist(world.reports.fix.position[0], truth[:2])),
        ):  # fmt: skip
            assert info[name] == pytest.approx(np.array([value]), rel=1e-6), name
        assert info["standoff_violation"] == pytest.approx(depth)
        expected = {
            "log_range_error": -math.log(max(range_error, 30.0) / 1e3),
            "relative_range_error": -range_error / true_range,
            "log_position_error": -math.log(max(position_error, 30.0) / 1e3),
            "relative_position_error": -position_error / true_range,
            "position_error": -position_error / 1e3,
            "final_position_error": -position_error / 1e3 * truncated,
            "turn_position_error": -position_error / 1e3 * turning,
            "acceleration_error": -off / 10.0,
            "log_range_bound": -math.log(info["range_crlb_m"][0] / 1e3),
            "log_position_bound": -math.log(info["position_crlb_m"][0] / 1e3),
            "information_gain": math.log(previous[0] / info["range_crlb_m"][0]),
            "maneuver": -np.square(action).mean(),
            "standoff": -depth,
            "lost_track": -float(lost),
        }
        assert set(info["reward_terms"]) == set(expected)
        for name, value in expected.items():
            assert info["reward_terms"][name] == pytest.approx(weights[f"reward_{name}"] * value, rel=1e-6), name
        assert reward == pytest.approx(sum(info["reward_terms"].values()))
    assert set(maneuvering) == {False, True}


def test_evaluation_tells_errors_of_maneuvers_by_hand():
    scenario = make_scenario(NAME, {"steps": 30})
    record = fly_policy(scenario, make_policy("straight", scenario), 9, seed=3)
    env = PassiveVectorEnv(scenario, 9, "disabled", threads=1)
    env.reset(seed=3)
    infos = [env.step(np.zeros((9, 4)))[4] for _ in range(30)]
    error, busy, acceleration = (
        np.array([info[name][:, 0] for info in infos]).T
        for name in ("position_error_m", "maneuvering", "acceleration_error_m_s2")
    )
    expected = [error[e][busy[e]].mean() if busy[e].any() else np.nan for e in range(9)]
    assert np.isfinite(expected).any()
    np.testing.assert_allclose(record.turn_error_m, expected)
    np.testing.assert_allclose(record.acceleration_error_m_s2[:, 1:], acceleration)
    summary = summarize("x", 3, {"straight": record, "again": record})
    figures = summary["policies"]["straight"]
    assert figures["turn_position_error_m"]["mean"] == pytest.approx(np.nanmean(expected))
    assert figures["mean_acceleration_error_m_s2"]["mean"] == pytest.approx(acceleration.mean())
    assert summary["ratios"]["straight"]["again"]["turn_position_error_m"] == {"ratio": 1.0, "ci95": [1.0, 1.0]}
    table = as_markdown(summary)
    assert "| time average | while maneuvering | acceleration |" in table
    assert "| again | while maneuvering | 1.000 [1.000, 1.000] |" in table
    assert "turn_position_error_m_over_straight_low" in as_csv(summary)


def test_evaluations_of_targets_that_never_maneuver_have_no_such_column():
    scenario = make_scenario(NAME, {"steps": 4})
    record = fly_policy(scenario, make_policy("straight", scenario), 3, seed=3)
    assert np.isnan(record.turn_error_m).all()
    table = as_markdown(summarize("x", 3, {"straight": record}))
    assert "while maneuvering" not in table
    assert "| acceleration |" in table
    other = make_scenario("TwoStation", {"steps": 2})
    summary = summarize("x", 0, {"straight": fly_policy(other, make_policy("straight", other), 2, seed=0)})
    assert "acceleration" not in as_markdown(summary)


# ------------------------------------------------------------------------------------------------ belief, observation


@pytest.mark.parametrize("fields", [{}, ROUGH], ids=str)
def test_observations_do_not_change_when_the_truth_behind_the_same_azimuths_does(monkeypatch, fields):
    scenario = make_scenario(NAME, {"steps": 12, **fields})
    first, second = fly_twins(monkeypatch, scenario, random_decisions(3), range(4))
    assert_twins_look_alike(first, second)


def test_belief_and_observation_read_nothing_of_the_truth():
    simulation, worlds = flown(4, 15)
    world = worlds[-1]
    reports = world.reports._replace(true_acceleration=np.full_like(world.reports.true_acceleration, 77.0))
    assert_blind_to_truth(simulation, world, reports=reports)


def test_worlds_are_never_changed_in_place():
    simulation, world = begin(3)
    kept = map_rows(np.copy, world)
    for _ in range(3):
        simulation.advance(world, np.full((3, 4), 0.5))
    map_rows(np.testing.assert_array_equal, world, kept)


def maneuvering_world(**fields):
    """A world in which a filter has just found a maneuver, and its simulation."""
    simulation, worlds = flown(1, 60, [0.3, -0.2, 1.0, 0.5], **fields)
    return simulation, next(world for world in worlds[20:] if world.reports.detected.any())


def test_observed_fields_by_hand():
    simulation, world = maneuvering_world()
    belief = simulation.belief(world)
    names = [field.name for field in simulation.observation.fields]
    seen = dict(zip(names, simulation.observe(world)[0].astype(float), strict=True))
    platforms, mean, cov = belief.platforms[0], belief.mean[0, 0], belief.cov[0, 0]
    middle = mean[:2] - platforms[:, :2].mean(0)
    psi = math.atan2(middle[1], middle[0])
    turn = np.array([[math.cos(psi), math.sin(psi)], [-math.sin(psi), math.cos(psi)]])
    gap = turn @ (platforms[0, :2] - platforms[1, :2])
    sight, other = mean[:2] - platforms[1, :2], mean[:2] - platforms[0, :2]
    azimuth = math.atan2(sight[1], sight[0])
    radial = sight / np.hypot(*sight)
    frame = np.kron(np.eye(2), np.array([radial, [-radial[1], radial[0]]]))
    C = frame @ cov @ frame.T
    std = np.sqrt(np.diag(C))
    headings = (turn @ platforms[:, 2:].T).T / np.hypot(*platforms[:, 2:].T)[:, None]
    acceleration = frame[:2, :2] @ simulation.tracker.acceleration(world.track_state).mean[0, 0]
    probability, detected = belief.model_probability[0, 0], belief.detected[0, 0]
    expected = {
        "time_left": 1.0 - world.step[0] / 70, "last_action0": 0.3, "last_action1": -0.2, "last_action2": 1.0,
        "last_action3": 0.5, "platform0.along": gap[0] / 2e4, "platform0.across": gap[1] / 2e4,
        "platform0.heading_cos": headings[0, 0], "platform1.heading_sin": headings[1, 1],
        "platform0.speed": 1.0, "platform1.speed": 0.75,
        "track0.log_range": math.log(np.hypot(*sight) / 5e4), "track0.bearing_cos": math.cos(azimuth - psi),
        "track0.bearing_sin": math.sin(azimuth - psi), "track0.radial_velocity": mean[2:] @ radial / 300.0,
        "track0.cross_velocity": mean[2:] @ frame[1, :2] / 300.0,
        "track0.log_range0": math.log(np.hypot(*other) / 5e4),
        "track0.crossing_sin0": math.sin(math.atan2(other[1], other[0]) - azimuth),
        "track0.log_std_radial": math.log(std[0] / 1e3) / 2.0,
        "track0.log_std_cross_velocity": math.log(std[3] / 50.0) / 2.0,
        "track0.corr_radial_cross": C[0, 1] / (std[0] * std[1]),
        "track0.corr_cross_radial_velocity": C[1, 2] / (std[1] * std[2]), "track0.assigned1": 1.0,
        "track0.radial_acceleration": acceleration[0] / 30.0, "track0.cross_acceleration": acceleration[1] / 30.0,
        "track0.detected": probability[detected].sum(), "track0.model_probability0": probability[0],
    }  # fmt: skip
    assert 0.0 < expected["track0.detected"] <= 1.0
    for name, value in expected.items():
        assert seen[name] == pytest.approx(np.clip(value, -5.0, 5.0), abs=2e-6, rel=1e-5), name


def test_info_shows_what_the_tracker_makes_of_the_maneuver():
    simulation, world = maneuvering_world()
    info = simulation.info(world)
    state = world.track_state
    np.testing.assert_array_equal(info["acceleration"], simulation.tracker.acceleration(state).mean)
    np.testing.assert_array_equal(info["model_probability"], state.probability)
    assert info["detected"].any()
    assert info["fixed"].all()


MIRROR = np.array([1.0, -1.0, 1.0, -1.0])


def mirrored_tape(tape):
    return tape._replace(
        platforms=tape.platforms * MIRROR, targets=tape.targets * MIRROR,
        accelerations=tape.accelerations * MIRROR[:2], noise=-tape.noise,
    )  # fmt: skip


@pytest.mark.parametrize("fields", [{}, ROUGH], ids=str)
def test_a_mirrored_world_shows_the_mirrored_observation_and_earns_the_same(monkeypatch, fields):
    scenario = make_scenario(NAME, {"steps": 25, **fields})
    commands = np.random.default_rng(1).uniform(-1.0, 1.0, (25, 6, 2 * scenario.stations))
    critic = scenario.make_truth_observation()

    def fly(flown_commands):
        simulation = Simulation(scenario)
        world = simulation.begin([np.random.default_rng(seed) for seed in range(6)])
        observations, truths, rewards = [simulation.observe(world)], [critic(world)], []
        for command in flown_commands:
            world, reward, _ = simulation.advance(world, command)
            observations.append(simulation.observe(world))
            truths.append(critic(world))
            rewards.append(reward)
        return np.array(observations), np.array(truths), np.array(rewards)

    observations, truths, rewards = fly(commands)
    draw = ManeuveringTarget.draw_tape
    monkeypatch.setattr(ManeuveringTarget, "draw_tape", lambda self, generators: mirrored_tape(draw(self, generators)))
    images, critics, same = fly(scenario.make_actions().mirrored(commands))
    expected = scenario.make_observation().mirrored(observations)
    assert not np.allclose(observations, expected, atol=0.1)
    np.testing.assert_allclose(images, expected, atol=1e-3)
    np.testing.assert_allclose(critics, critic.mirrored(truths), atol=1e-3)
    np.testing.assert_allclose(same, rewards, atol=1e-4)


def test_mirrored_commands_turn_the_other_way_at_the_same_speed():
    actions = make_scenario(NAME, {}).make_actions()
    assert np.array_equal(actions.mirrored(np.array([0.1, 0.2, 0.3, 0.4])), [-0.1, -0.2, 0.3, 0.4])


def test_the_critics_truth_by_hand():
    simulation, world = maneuvering_world()
    critic = simulation.scenario.make_truth_observation()
    seen = dict(zip([field.name for field in critic.fields], critic(world)[0].astype(float), strict=True))
    truth, reference = world.truth[0, 0], world.platforms[0, 1, :2]
    sight = truth[:2] - reference
    radial = sight / np.hypot(*sight)
    left = np.array([-radial[1], radial[0]])
    assert seen["truth0.log_range"] == pytest.approx(math.log(np.hypot(*sight) / 5e4), abs=1e-6)
    assert seen["truth0.radial_velocity"] == pytest.approx(truth[2:] @ radial / 300.0, abs=1e-6)
    for i, ahead in enumerate(AHEAD_S):
        at = min(int(world.step[0] + ahead), 70)
        a = world.tape.accelerations[0, at, 0]
        assert seen[f"truth0.radial_acceleration{i}"] == pytest.approx(a @ radial / 30.0, abs=1e-6)
        assert seen[f"truth0.cross_acceleration{i}"] == pytest.approx(a @ left / 30.0, abs=1e-6)
    error = (
        simulation.tracker.acceleration(world.track_state).mean[0, 0] - world.tape.accelerations[0, world.step[0], 0]
    )
    assert seen["truth0.radial_acceleration_error"] == pytest.approx(error @ radial / 30.0, abs=1e-6)
    assert seen["truth0.cross_acceleration_error"] == pytest.approx(error @ left / 30.0, abs=1e-6)
    bound = 0.5 * math.log(world.metrics.position_crlb_m[0, 0] / 100.0)
    assert seen["truth0.log_position_bound"] == pytest.approx(bound, abs=1e-6)


# ------------------------------------------------------------------------------------------------ batches, pictures


@pytest.mark.parametrize("fields", [{}, ROUGH, {"course": "flights"}, {"course": "paper1"}], ids=str)
def test_sub_environments_are_single_environments_whatever_the_width(fields):
    wide = PassiveVectorEnv(NAME, num_envs=300, threads=2, **fields)
    size = wide.single_action_space.shape[0]
    actions = np.random.default_rng(0).uniform(-1.0, 1.0, (12, 300, size)).astype(np.float32)
    observation, _ = wide.reset(seed=50)
    singles = {row: PassiveEnv(NAME, **fields) for row in (0, 149, 150, 299)}
    for row, single in singles.items():
        assert np.array_equal(single.reset(seed=50 + row)[0], observation[row])
    for action in actions:
        observation, reward, _, _, info = wide.step(action)
        for row, single in singles.items():
            own = single.step(action[row])
            assert np.array_equal(own[0], observation[row])
            assert own[1] == reward[row]
            for name in ("position_error_m", "position_crlb_m", "acceleration", "model_probability", "detected"):
                assert np.array_equal(own[4][name], info[name][row]), name


def picture(env) -> np.ndarray:
    drawn = env.render()
    assert drawn is not None
    return drawn


def picture_env(steps=0, **fields):
    env = PassiveEnv(NAME, render_mode="rgb_array", **fields)
    env.reset(seed=3)
    for _ in range(steps):
        env.step(np.concatenate([np.full(env.scenario.stations, 0.4), np.ones(env.scenario.stations)]))
    return env


@pytest.mark.parametrize("fields", [{}, {"stations": 4, "tracker": "imm3", "standoff_m": 5e3}], ids=str)
@pytest.mark.parametrize("steps", [0, 1, 30])
def test_pictures_render_at_any_step(steps, fields):
    env = picture_env(steps, **fields)
    drawn = picture(env)
    assert drawn.shape == (800, 800, 3)
    assert drawn.dtype == np.uint8
    assert 0.5 < (drawn == 255).all(-1).mean() < 0.99
    assert np.array_equal(picture(env), drawn)
    env.step(np.zeros(2 * env.scenario.stations))
    assert not np.array_equal(picture(env), drawn)


def test_a_picture_shows_fix_accelerations_and_models():
    """Taking any of them from the world changes the picture."""
    env = picture_env(30)
    world, whole = env.world, picture(env)
    told = world.reports
    for reports in (
        told._replace(fix=told.fix._replace(fixed=np.zeros_like(told.fix.fixed))),
        told._replace(acceleration=told.acceleration + 5.0),
        told._replace(true_acceleration=told.true_acceleration + 5.0),
        told._replace(model_probability=1.0 - 0.5 * told.model_probability),
        told._replace(detected=~told.detected),
    ):
        env._world = world._replace(reports=reports)
        assert not np.array_equal(picture(env), whole)


@pytest.mark.parametrize("stations", [2, 3, 4])
def test_names_of_stations_close_together_do_not_cover_each_other(stations):
    env = PassiveEnv(NAME, render_mode="rgb_array", stations=stations)
    for seed in range(8):
        env.reset(seed=seed)
        picture(env)
        boxes = [name.get_window_extent() for name in env._viewer._scene._station_names]
        assert not any(a.overlaps(b) for a, b in itertools.combinations(boxes, 2)), seed


def test_a_diverged_track_and_a_scan_without_a_fix_still_give_a_picture():
    env = picture_env(3, carrier="ground")
    world = env.world
    assert not world.reports.fixed.any()
    lost = map_rows(lambda a: np.full_like(a, np.nan), world.estimate)
    told = world.reports._replace(acceleration=np.full((1, 1, 2), np.nan), model_probability=np.full((1, 1, 2), np.nan))
    env._world = world._replace(estimate=lost, reports=told)
    assert picture(env).shape == (800, 800, 3)


# ------------------------------------------------------------------------------------------------ bad input


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"stations": 1}, r"stations = 1: must lie in \[2, 4\]"),
        ({"stations": 5}, "stations"),
        ({"stations": 2.0}, "must be an integer"),
        ({"azimuth_std_mrad": 0.0}, "azimuth_std_mrad"),
        ({"azimuth_std_mrad": math.nan}, "azimuth_std_mrad"),
        ({"detection_probability": 0.0}, "detection_probability"),
        ({"carrier": "ship"}, "must be one of 'aircraft', 'ground'"),
        ({"course": "paper"}, "must be one of 'random', 'flights', 'paper1', 'paper2'"),
        ({"mixing": "all"}, "must be one of 'literal'"),
        ({"mixing": "sens", "tracker": "imm3"}, "mixing = 'sens': is not used with tracker='imm3'"),
        ({"min_speed_m_s": 300.0}, "must not exceed max_speed_m_s = 250.0"),
        ({"min_speed_m_s": 30.0, "carrier": "ground"}, "min_speed_m_s = 30.0: must not exceed ground_speed_m_s"),
        ({"min_speed_m_s": 2.0, "carrier": "ground"}, "never measure: must not exceed it"),
        ({"range_min_m": 31e3}, "must not exceed range_max_m"),
        ({"target_speed_min_m_s": 400.0}, "must not exceed target_speed_max_m_s"),
        ({"quiet_min_s": 30.0}, "must not exceed quiet_max_s"),
        ({"maneuver_min_s": 40.0}, "must not exceed maneuver_max_s"),
        ({"target_acceleration_min_m_s2": 40.0}, "must not exceed target_acceleration_max_m_s2"),
        ({"turn_share": 1.1}, "turn_share"),
        ({"standoff_m": 15e3}, "standoff_m = 15000.0: stations may start 14000 m from the target"),
        ({"course": "paper2", "standoff_m": 21e3}, "standoff_m = 21000.0: stations may start 20100 m"),
        ({"flight_turn_s": 5.0}, "add course='flights'"),
        ({"flight_turn_s": 80.0, "course": "flights"}, "flight_turn_s = 80.0: an episode lasts 70 s"),
        ({"flights": "x.csv"}, "add course='flights'"),
        ({"range_floor_m": 1e5}, "range_floor_m = 100000.0: must lie below range_cap_m = 100000.0"),
        ({"range_cap_m": 10.0}, "must lie below range_cap_m = 10.0"),
        ({"initial_velocity_std_m_s": 0.0}, "initial_velocity_std_m_s = 0.0: must lie in"),
        ({"baseline_m": 0.0}, "baseline_m = 0.0: must lie in"),
        ({"actions": "turns"}, "must be one of 'continuous', 'headings', 'discrete'"),
        ({"tracker": "rp_ekf"}, "tracker = 'rp_ekf': must be one of 'imm_mie'"),
    ],
    ids=str,
)
def test_bad_values_are_errors_that_name_field_value_and_what_is_right(fields, message):
    with pytest.raises(ValueError, match=message):
        make_scenario(NAME, fields)


def test_a_baseline_longer_than_the_range_is_allowed_where_nobody_must_stand_off():
    _, worlds = flown(20, 3, GO, baseline_m=40e3)
    assert np.isfinite([world.metrics.position_error_m for world in worlds]).all()
    with pytest.raises(ValueError, match="stations may start 0 m from the target"):
        make_scenario(NAME, {"baseline_m": 40e3, "standoff_m": 1.0})


def test_aircraft_may_never_fly_slower_than_ground_stations_drive():
    """Each carrier's least speed is held against its own top speed."""
    scenario = make_scenario(NAME, {"min_speed_m_s": 100.0})
    assert scenario.top_speed_m_s == 250.0
    assert make_scenario(NAME, {"carrier": "ground", "max_speed_m_s": 1.0, "min_speed_m_s": 0.5}).top_speed_m_s == 25.0


def test_recorded_flights_that_never_turn_so_long_are_an_error():
    with pytest.raises(ValueError, match=r"flight_turn_s = 300.0: no window of 300 steps .* 'train', turns"):
        PassiveEnv(NAME, course="flights", steps=300, flight_turn_s=300.0)


class Mute(ImmMie):
    """Says nothing of its models."""

    models = None


def test_a_tracker_of_another_family_or_without_verbs_is_refused():
    with pytest.raises(TypeError, match=r"has no initiate, .*acceleration"):
        make_scenario(NAME, {"tracker": object()})
    with pytest.raises(TypeError, match="is the class ImmMie"):
        make_scenario(NAME, {"tracker": ImmMie})
    with pytest.raises(TypeError, match="models is None, must be its number of models"):
        make_scenario(NAME, {"tracker": Mute()})


def test_bad_actions_are_errors():
    env = PassiveEnv(NAME)
    env.reset(seed=0)
    for action in (np.zeros(2), np.full(4, np.nan), None):
        with pytest.raises(ValueError, match="action"):
            env.step(action)


def test_every_field_has_a_rule():
    assert all(f.metadata.get("doc") for f in dataclasses.fields(ManeuveringTarget))
