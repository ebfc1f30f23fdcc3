"""The world: tapes, kinematics, sensors, rewards, metrics, scenarios, one's own tracker; and no leak of the truth."""

import dataclasses
import importlib.util
import itertools
import math
import re
from pathlib import Path
from types import SimpleNamespace
from typing import NamedTuple

import gymnasium as gym
import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.stats import binom, chi2, poisson
from spoilt_trackers import SPOILT, spoilt_later
from twin_worlds import SHIFT, assert_blind_to_truth, assert_twins_look_alike, fly, fly_twins, random_decisions

from agents.policy import make_policy
from passive_env import PassiveEnv, PassiveVectorEnv
from passive_env.actions import Continuous, Discrete
from passive_env.catalogue import make_scenario
from passive_env.catalogue.angle_fusion import AngleFusion
from passive_env.catalogue.bearings import BearingScenario
from passive_env.catalogue.maneuvering import ManeuveringTarget
from passive_env.catalogue.ownship import Ownship
from passive_env.catalogue.passive_radar import PassiveRadar
from passive_env.catalogue.placement import RadarPlacement
from passive_env.catalogue.two_station import TwoStation
from passive_env.core import Simulation, map_rows
from passive_env.flights import load_flights
from passive_env.kinematics import maneuver, turn
from passive_env.metrics import Metrics, violations
from passive_env.observations import TrackObservation
from passive_env.rewards import TERMS, Moment
from passive_env.sensors import sense
from trackers import Gaussian, Scan, Tracker, Update
from trackers.bounds import posterior_bound_information

TAIL = 5e-4
"""Probability on each side of a statistical band that a right program falls outside (seeds are fixed)."""


def band(distribution, *args):
    return distribution.ppf([TAIL, 1.0 - TAIL], *args)


def wrapped(angle):
    return (angle + math.pi) % (2.0 * math.pi) - math.pi


def begin(episodes, **fields):
    """A scenario's simulation and the world of its first instant."""
    simulation = Simulation(TwoStation(**fields))
    return simulation, simulation.begin([np.random.default_rng(seed) for seed in range(episodes)])


# ------------------------------------------------------------------------------------------------ no leak of the truth


@pytest.mark.parametrize(
    "fields",
    [
        {},
        {"tracker": "fused_ekf"},
        {"detection_probability": 0.7, "false_bearings_mean": 1.0},
        {"bearings": "reference"},
    ],
    ids=str,
)
def test_observations_do_not_change_when_the_truth_behind_the_same_bearings_does(monkeypatch, fields):
    first, second = fly_twins(monkeypatch, TwoStation(**fields), random_decisions(), range(5))
    np.testing.assert_allclose(second.truth[20] - first.truth[20], np.broadcast_to(SHIFT, (5, 3, 4)), atol=1e-6)
    assert_twins_look_alike(first, second)


def test_belief_and_observation_read_nothing_of_the_truth():
    simulation, world = begin(4)
    assert_blind_to_truth(simulation, world)


def test_nothing_depends_on_what_happens_later():
    simulation, world = begin(4, detection_probability=0.8, false_bearings_mean=1.0)
    tape = world.tape

    def rewrite(a):
        later = a.copy()
        if a.ndim > 3 or a.dtype == np.int64:  # everything but the platforms' start has the instant on axis 1
            later[:, 9:] = np.zeros_like(later[:, 9:])
        return later

    other = world._replace(tape=map_rows(rewrite, tape))
    command = np.full((4, 2), 0.4)
    for k in range(1, 12):
        world, reward, _ = simulation.advance(world, command)
        other, expected, _ = simulation.advance(other, command)
        assert np.array_equal(reward, expected) == (k < 9)
        assert np.array_equal(simulation.observe(world), simulation.observe(other)) == (k < 9)


def test_worlds_are_never_changed_in_place():
    simulation, world = begin(3, detection_probability=0.8, false_bearings_mean=1.0)
    before = map_rows(np.copy, world)
    futures = [simulation.advance(world, np.full((3, 2), command))[0] for command in (1.0, -1.0, 1.0)]
    map_rows(np.testing.assert_array_equal, world, before)
    map_rows(np.testing.assert_array_equal, futures[0], futures[2])
    assert not np.array_equal(futures[0].platforms, futures[1].platforms)


# ------------------------------------------------------------------------------------------------ tape


def test_the_tape_depends_on_the_seed_and_not_on_the_actions():
    fields = {"detection_probability": 0.8, "false_bearings_mean": 1.0}
    tapes, truths = [], []
    for seed, command in ((3, 0.9), (3, -0.9), (4, 0.9)):
        env = PassiveEnv(**fields)
        env.reset(seed=seed)
        truths.append([env.world.truth])
        for _ in range(45):
            env.step(np.full(2, command))
            truths[-1].append(env.world.truth)
        tapes.append(env.world.tape)
    map_rows(np.testing.assert_array_equal, tapes[0], tapes[1])
    np.testing.assert_array_equal(truths[0], truths[1])
    assert not np.array_equal(tapes[0].targets, tapes[2].targets)
    assert not np.array_equal(tapes[0].noise, tapes[2].noise)


def test_policies_meet_the_same_targets_and_noise():
    seen = []
    for name in ("paper", "rule", "random"):
        scenario = TwoStation()
        policy = make_policy(name, scenario)
        env = PassiveVectorEnv(scenario, num_envs=3, autoreset_mode="disabled")
        observation, _ = env.reset(seed=12)
        policy.reset(env.belief())
        residuals = []
        for k in range(1, 46):
            observation, *_ = env.step(policy.act(env.belief(), observation))
            world = env.world
            scan = sense(world.tape, world.step, world.platforms, math.radians(0.5))
            line = world.truth[:, None, :, :2] - world.platforms[:, :, None, :2]
            bearing = np.take_along_axis(np.arctan2(line[..., 1], line[..., 0]), scan.origin, axis=-1)
            noise = np.take_along_axis(world.tape.noise[:, k], scan.origin, axis=-1)
            residual = np.degrees(wrapped(scan.scan.bearings - bearing)) / 0.5
            np.testing.assert_allclose(residual, noise, atol=1e-9)
            residuals.append(world.tape.noise[:, k])
        seen.append((world.tape.targets, np.array(residuals), world.platforms))
    for targets, noise, platforms in seen[1:]:
        assert np.array_equal(targets, seen[0][0])
        assert np.array_equal(noise, seen[0][1])
        assert not np.array_equal(platforms, seen[0][2])


def test_bearing_noise_has_the_stated_deviation_and_no_correlation():
    _, world = begin(60)
    z = world.tape.noise.reshape(60, 46, -1)
    count = z.size
    low, high = chi2.ppf([TAIL, 1.0 - TAIL], df=count) / count
    assert low < np.square(z).mean() < high
    assert abs(z.mean()) < 3.3 / math.sqrt(count)
    assert abs((z[:, 1:] * z[:, :-1]).mean()) < 3.3 / math.sqrt(count)  # from scan to scan
    assert abs((z[..., 1:] * z[..., :-1]).mean()) < 3.3 / math.sqrt(count)  # between targets and stations


# ------------------------------------------------------------------------------------------------ kinematics


def integrate(state, turn_rate, acceleration, seconds):
    """x, y, heading and speed by an adaptive Runge–Kutta method of order 8."""

    def rates(_, s):
        return [s[3] * math.cos(s[2]), s[3] * math.sin(s[2]), turn_rate, acceleration]

    x, y, vx, vy = state
    start = [x, y, math.atan2(vy, vx), math.hypot(vx, vy)]
    end = solve_ivp(rates, (0.0, seconds), start, method="DOP853", rtol=1e-12, atol=1e-9).y[:, -1]
    return np.array([end[0], end[1], end[3] * math.cos(end[2]), end[3] * math.sin(end[2])])


TURN_RATES = (0.0, 1e-12, -1e-9, 1e-7, -4.9e-5, 5.1e-5, -1e-4, 1e-3, math.radians(5.0), -math.radians(45.0))


@pytest.mark.parametrize("turn_rate", TURN_RATES)
def test_turning_platforms_fly_the_exact_arc(turn_rate):
    """The closed form and its series change over at |ωh| = 1e-4, that is ω = 5e-5 for h = 2 s."""
    states = np.array([[1e4, -2e4, 150.0, 200.0], [-3e3, 5e3, -40.0, 9.0]])
    flown = turn(states, np.array([turn_rate, -turn_rate]), 2.0)
    np.testing.assert_allclose(flown[0], integrate(states[0], turn_rate, 0.0, 2.0), rtol=0, atol=1e-6)
    np.testing.assert_allclose(flown[1], integrate(states[1], -turn_rate, 0.0, 2.0), rtol=0, atol=1e-6)


def test_speed_is_constant_and_the_path_a_circle_when_turning():
    state, rate = np.array([[0.0, 0.0, 0.0, 250.0]]), math.radians(5.0)
    center = np.array([-250.0 / rate, 0.0])  # left of a platform that heads north
    for k in range(1, 100):
        state = turn(state, np.array([rate]), 2.0)
        assert math.hypot(*state[0, 2:]) == pytest.approx(250.0, rel=1e-12)
        assert math.dist(state[0, :2], center) == pytest.approx(250.0 / rate, rel=1e-12)
        assert wrapped(math.atan2(state[0, 3], state[0, 2]) - (math.pi / 2.0 + 2.0 * k * rate)) == pytest.approx(
            0.0, abs=1e-9
        )


@pytest.mark.parametrize("turn_rate", TURN_RATES)
@pytest.mark.parametrize("acceleration", [10.0, -3.0])
def test_accelerating_targets_fly_the_exact_curve(turn_rate, acceleration):
    start = np.array([5e4, 5e4, -170.0, -180.0])
    always = np.array([0.0, 1e9])
    path = maneuver(start, turn_rate, always, acceleration, always, 2.0, np.empty(6))
    assert np.array_equal(path[0], start)
    for k in range(1, 6):
        np.testing.assert_allclose(path[k], integrate(start, turn_rate, acceleration, 2.0 * k), rtol=0, atol=1e-5)


def test_maneuver_windows_open_and_close_between_scans():
    """Turn from 3.3 to 7.9 s, acceleration from 5.1 to 6.2 s, scans every 2 s; the pieces are integrated one by one."""
    start, rate = np.array([6e4, 4e4, -200.0, 150.0]), math.radians(-5.0)
    path = maneuver(start, rate, np.array([3.3, 7.9]), 10.0, np.array([5.1, 6.2]), 2.0, np.empty(7))
    pieces = [(0.0, 3.3, 0, 0), (3.3, 5.1, 1, 0), (5.1, 6.2, 1, 1), (6.2, 7.9, 1, 0), (7.9, 12.0, 0, 0)]
    for k in range(7):
        state = start
        for since, until, turning, accelerating in pieces:
            if 2.0 * k > since:
                state = integrate(state, rate * turning, 10.0 * accelerating, min(until, 2.0 * k) - since)
        np.testing.assert_allclose(path[k], state, rtol=0, atol=1e-5)


def test_drawn_targets_turn_20_degrees_and_reach_their_final_speed():
    _, world = begin(40, steps=60)
    velocity = world.tape.targets[..., 2:]
    speed = np.hypot(velocity[..., 0], velocity[..., 1])
    heading = np.arctan2(velocity[..., 1], velocity[..., 0])
    turned = np.degrees(wrapped(heading[:, -1] - heading[:, 0]))
    np.testing.assert_allclose(np.abs(turned), 20.0, atol=1e-9)
    assert (np.sign(turned) == np.sign(turned[:, :1])).all()  # an episode's targets turn to the same side
    assert 0.2 < (turned[:, 0] > 0).mean() < 0.8
    assert np.all((speed[:, 0] >= 200.0) & (speed[:, 0] <= 300.0))
    assert np.all((speed[:, -1] >= 430.0) & (speed[:, -1] <= 450.0))
    assert np.all(np.diff(speed, axis=1) > -1e-9)


def test_drawn_geometry_stays_within_the_scenarios_limits():
    fields = {"baseline_min_m": 5e3, "baseline_max_m": 6e3, "range_min_m": 30e3, "range_max_m": 31e3, "targets": 4}
    _, world = begin(200, **fields)
    stations, targets = world.platforms[..., :2], world.truth[..., :2]
    baseline = np.linalg.norm(stations[:, 0] - stations[:, 1], axis=-1)
    distance = np.linalg.norm(targets - stations[:, 1:], axis=-1)
    for values, low, high in ((baseline, 5e3, 6e3), (distance, 30e3, 31e3)):
        assert low <= values.min() < low + 0.05 * (high - low)
        assert high - 0.05 * (high - low) < values.max() <= high
    bearing = np.arctan2(*(targets - stations[:, 1:])[..., ::-1].transpose(2, 0, 1))
    gaps = np.degrees(wrapped(np.diff(bearing, axis=1)))
    true_order = gaps[(gaps > 0).all(axis=1)]
    assert len(true_order) > 150  # bearing noise may swap neighbours; jitter keeps them 4.5 to 10.5° apart
    assert true_order.min() > 4.5
    assert true_order.max() < 10.5


# ------------------------------------------------------------------------------------------------ the paper's course


@pytest.mark.parametrize(
    ("course", "headings", "senses"),
    [("paper", (225.0, 225.0, 225.0), (1, 1, 1)), ("paper_bestfit", (233.0, 210.0, 221.0), (1, 1, -1))],
)
def test_paper_targets_follow_the_papers_timeline(course, headings, senses):
    """250 m/s until 22 s; 5°/s from 22 to 26 s; 10 m/s² from 22 s until 450, 430, 430 m/s.

    Tracks are numbered counter-clockwise as seen from the reference: the paper's targets 3, 1, 2.
    """
    _, world = begin(1, course=course)
    path = world.tape.targets[0]
    starts = ((58600.0, 46760.0), (53000.0, 53000.0), (45660.0, 59500.0))
    for j, paper in enumerate((2, 0, 1)):
        final = (450.0, 430.0, 430.0)[paper]
        np.testing.assert_allclose(path[0, j, :2], starts[j])
        for k, (_, _, vx, vy) in enumerate(path[:, j]):
            t = 2.0 * k
            expected = min(250.0 + 10.0 * max(t - 22.0, 0.0), final)
            assert math.hypot(vx, vy) == pytest.approx(expected, abs=1e-9)
            turned = 5.0 * min(max(t - 22.0, 0.0), 4.0) * senses[paper]
            assert math.degrees(wrapped(math.atan2(vy, vx) - math.radians(headings[paper] + turned))) == pytest.approx(
                0.0, abs=1e-9
            )


def test_paper_stations_start_as_the_paper_says():
    _, world = begin(1, course="paper")
    np.testing.assert_allclose(world.platforms[0, :, :2], [[-10000.0, 0.0], [3536.0, 3536.0]])
    np.testing.assert_allclose(np.degrees(np.arctan2(world.platforms[0, :, 3], world.platforms[0, :, 2])), 45.0)
    np.testing.assert_allclose(np.hypot(world.platforms[0, :, 2], world.platforms[0, :, 3]), 250.0)


# ------------------------------------------------------------------------------------------------ recorded flights


def test_recorded_flights_keep_shape_and_speed():
    """Each flown path is a recorded window, shifted and turned, never mirrored, stretched or sped up."""
    episodes, steps = 25, 30
    _, world = begin(episodes, course="flights", steps=steps)
    paths = load_flights().split("train").resample(2.0)
    hops = np.linalg.norm(np.diff(paths.states[:, :2], axis=0), axis=-1)
    starts = np.concatenate([np.arange(lo, hi - steps) for lo, hi in itertools.pairwise(paths.flight_start)])
    first_hops = hops[starts]
    for path in world.tape.targets.transpose(0, 2, 1, 3).reshape(-1, steps + 1, 4):
        flown = np.linalg.norm(np.diff(path[:, :2], axis=0), axis=-1)
        near = starts[np.abs(first_hops - flown[0]) < 1e-6]
        match = [at for at in near if np.allclose(hops[at : at + steps], flown, rtol=0, atol=1e-6)]
        assert len(match) >= 1
        window = paths.states[match[0] : match[0] + steps + 1]
        along = [complex(*row) for row in np.diff(window[:, :2], axis=0)]
        turned = [complex(*row) for row in np.diff(path[:, :2], axis=0)]
        rotation = np.array(turned) / np.array(along)  # a mirror image would not turn all hops by one angle
        np.testing.assert_allclose(rotation, rotation[0], atol=1e-7)
        np.testing.assert_allclose(np.hypot(path[:, 2], path[:, 3]), np.hypot(window[:, 3], window[:, 4]), atol=1e-9)
        velocity = np.array([complex(*row) for row in path[:, 2:]]) / np.array(
            [complex(*row) for row in window[:, 3:5]]
        )
        np.testing.assert_allclose(velocity, rotation[0], atol=1e-7)


def test_train_and_test_flights_are_different_windows():
    tapes = [begin(3, course="flights", flight_split=part)[1].tape.targets for part in ("train", "test")]
    lengths = [np.linalg.norm(np.diff(t[..., :2], axis=1), axis=-1) for t in tapes]
    assert not np.allclose(*lengths)


def test_flights_start_where_drawn_targets_would():
    flights, drawn = (begin(20, course=course)[1] for course in ("flights", "random"))
    starts = [np.sort(np.linalg.norm(w.tape.targets[:, 0, :, :2], axis=-1), axis=1) for w in (flights, drawn)]
    np.testing.assert_allclose(starts[0], starts[1])


# ------------------------------------------------------------------------------------------------ sensors


@pytest.mark.parametrize("targets", [1, 3, 6])
def test_acquisition_scan_is_complete_and_counter_clockwise(targets):
    """Whatever the scenario's misses and false bearings, and wherever the seam at ±180° lies."""
    _, world = begin(300, targets=targets, detection_probability=0.3, false_bearings_mean=3.0)
    sighting = sense(world.tape, world.step, world.platforms, math.radians(0.5), in_order=True)
    bearings, valid = sighting.scan.bearings, sighting.scan.valid
    assert np.array_equal(valid.sum(axis=-1), np.full((300, 2), targets))
    assert valid[..., :targets].all()
    gaps = wrapped(np.diff(bearings[..., :targets], axis=-1))
    assert (gaps > 0.0).all()
    assert (wrapped(bearings[..., targets - 1] - bearings[..., 0]) > 0.0).all() or targets == 1
    assert np.array_equal(np.sort(sighting.origin[..., :targets], axis=-1), np.tile(np.arange(targets), (300, 2, 1)))
    assert np.array_equal(sighting.origin[:, 1, :targets], np.tile(np.arange(targets), (300, 1)))  # track j is target j
    if targets > 1:
        straddles = np.abs(np.diff(bearings[:, 1, :targets], axis=-1)).max(axis=-1) > math.pi
        assert straddles.any()
    assert np.array_equal(world.reports.returns, np.full((300, 2), targets))


def test_tracks_start_on_the_bearings_of_the_targets_they_are_scored_against():
    _, world = begin(100, bearing_std_deg=0.1)
    line = world.truth[..., :2] - world.platforms[:, 1:, :2]
    track = world.estimate.mean[..., :2] - world.platforms[:, 1:, :2]
    off = wrapped(np.arctan2(track[..., 1], track[..., 0]) - np.arctan2(line[..., 1], line[..., 0]))
    assert np.degrees(np.abs(off)).max() < 0.6


def test_detections_and_false_bearings_have_the_stated_frequencies():
    _, world = begin(50, detection_probability=0.7, false_bearings_mean=2.0)
    detected, count = world.tape.detected, world.tape.false_count
    assert detected[:, 0].all()
    assert (count[:, 0] == 0).all()
    seen, scans = detected[:, 1:], count[:, 1:]
    low, high = band(binom, seen.size, 0.7)
    assert low <= seen.sum() <= high
    low, high = band(binom, seen[..., 0, 0].size, 0.7)
    for s, m in itertools.product(range(2), range(3)):
        assert low <= seen[:, :, s, m].sum() <= high
    low, high = band(poisson, 2.0 * scans.size)
    assert low <= scans.sum() <= high
    expected = poisson.pmf(np.arange(7), 2.0) * scans.size
    expected = np.append(expected, scans.size - expected.sum())
    observed = np.append([(scans == n).sum() for n in range(7)], (scans >= 7).sum())
    assert ((observed - expected) ** 2 / expected).sum() < chi2.ppf(1.0 - TAIL, df=7)


def test_scans_hold_what_the_tape_says():
    simulation, world = begin(20, detection_probability=0.7, false_bearings_mean=2.0)
    for _ in range(10):
        world, _, _ = simulation.advance(world, np.zeros((20, 2)))
        k = int(world.step[0])
        sighting = sense(world.tape, world.step, world.platforms, math.radians(0.5))
        valid, origin = sighting.scan.valid, sighting.origin
        assert np.array_equal(valid.sum(-1), world.tape.detected[:, k].sum(-1) + world.tape.false_count[:, k])
        assert np.array_equal(world.reports.returns, valid.sum(-1))
        for m in range(3):
            assert np.array_equal((origin == m).sum(-1), world.tape.detected[:, k, :, m])
        assert np.array_equal(((origin == -1) & valid).sum(-1), world.tape.false_count[:, k])
        assert (sighting.scan.bearings[~valid] == 0.0).all()
        assert np.abs(sighting.scan.bearings).max() <= math.pi


def test_false_bearings_are_uniform_around_the_circle():
    _, world = begin(50, false_bearings_mean=3.0)
    slots = np.arange(world.tape.false_bearings.shape[-1])
    shown = world.tape.false_bearings[slots < world.tape.false_count[..., None]]
    observed, _ = np.histogram(shown, bins=12, range=(-math.pi, math.pi))
    assert observed.sum() == len(shown) > 10_000
    expected = len(shown) / 12
    assert ((observed - expected) ** 2 / expected).sum() < chi2.ppf(1.0 - TAIL, df=11)


@pytest.mark.parametrize("targets", [2, 3, 4])
def test_every_order_of_returns_is_equally_likely(targets):
    _, world = begin(100, targets=targets)
    orders = []
    for k in range(1, 46):
        orders.append(sense(world.tape, np.full(100, k), world.platforms, 0.01).origin)
    orders = np.array(orders).reshape(-1, targets)
    permutations = list(itertools.permutations(range(targets)))
    observed = np.array([(orders == p).all(axis=1).sum() for p in permutations])
    assert observed.sum() == len(orders) == 9000
    expected = len(orders) / len(permutations)
    assert ((observed - expected) ** 2 / expected).sum() < chi2.ppf(1.0 - TAIL, df=len(permutations) - 1)


# ------------------------------------------------------------------------------------------------ rewards


ELSEWHERE = ("position", "acceleration", "horizontal", "height")
IN_PLANE = [term for term in TERMS if not any(word in term for word in ELSEWHERE)]
"""Terms of scenarios with unlabelled bearings."""


def moment(standoff_m=12e3, **changes) -> Moment:
    """Two targets, two platforms, one disc, one environment; every number chosen by hand."""
    now = Metrics(
        range_error_m=np.array([[2000.0, 500.0]]),
        position_error_m=np.array([[2500.0, 900.0]]),
        range_m=np.array([[40e3, 10e3]]),
        range_crlb_m=np.array([[1000.0, 250.0]]),
        nees=np.array([[3.0, 30.0]]),
        lost=np.array([[False, True]]),
    )
    before = now._replace(range_crlb_m=np.array([[4000.0, 500.0]]))
    platforms = np.array([[[0.0, 0.0, 250.0, 0.0], [10e3, 0.0, 250.0, 0.0]]])
    truth = np.array([[[0.0, 3e3, 1.0, 1.0], [10e3, 40e3, 1.0, 1.0]]])
    discs = np.array([[[13e3, 4e3, 8e3]]])
    deep = violations(platforms, truth, standoff_m, discs)
    values = {"metrics": now, "previous": before, "violations": deep, "command": np.array([[1.0, -0.5]])}
    return Moment(**{**values, "final": np.array([True]), **changes})


@pytest.mark.parametrize(
    ("term", "expected"),
    [
        ("log_range_error", -(math.log(2.0) + math.log(0.5)) / 2.0),
        ("relative_range_error", -(2000.0 / 40e3 + 500.0 / 10e3) / 2.0),
        ("range_error", -(0.2 + 0.05) / 2.0),
        ("final_range_error", -(0.2 + 0.05) / 2.0),
        ("log_range_bound", -(math.log(1.0) + math.log(0.25)) / 2.0),
        ("final_log_range_bound", -(math.log(1.0) + math.log(0.25)) / 2.0),
        ("information_gain", (math.log(4.0) + math.log(2.0)) / 2.0),
        ("maneuver", -(1.0 + 0.25) / 2.0),
        # Station 0 is 3 km from target 0; station 1 is √109 km from it; both are 40 km or more from target 1.
        ("standoff", -((1.0 - 3.0 / 12.0) + (1.0 - math.sqrt(109.0) / 12.0))),
        ("nogo", -(1.0 - 5.0 / 8.0)),  # station 1 is 5 km from the disc's centre, station 0 outside
        ("lost_track", -0.5),
    ],
)
def test_reward_term_by_hand(term, expected):
    assert TERMS[term](moment()) == pytest.approx(np.array([expected]), rel=1e-12)


def test_every_reward_term_has_a_weight_and_a_hand_computed_test():
    assert set(TERMS) == {
        "log_range_error", "relative_range_error", "range_error", "final_range_error", "log_range_bound",
        "final_log_range_bound", "information_gain", "maneuver", "standoff", "nogo", "lost_track", "log_position_error",
        "relative_position_error", "position_error", "final_position_error", "log_position_bound",
        "turn_position_error", "acceleration_error", "final_log_position_error", "position_gain",
        "log_horizontal_error", "horizontal_error", "height_error", "log_horizontal_bound",
    }  # fmt: skip
    in_plane, *others = (
        {f.name.removeprefix("reward_") for f in dataclasses.fields(family) if f.name.startswith("reward_")}
        for family in (TwoStation, AngleFusion, ManeuveringTarget, RadarPlacement, PassiveRadar)
    )
    assert in_plane.union(*others) == set(TERMS)
    assert in_plane == set(IN_PLANE)


def test_reward_terms_of_placements_by_hand():
    final = np.array([True])
    assert TERMS["final_log_position_error"](moment()) == pytest.approx(-(math.log(2.5) + math.log(0.9)) / 2.0)
    assert TERMS["final_log_position_error"](moment(final=~final)) == pytest.approx(0.0)
    now, before = (SimpleNamespace(position_crlb_m=np.array([bounds])) for bounds in ([500.0, 30.0], [1000.0, 90.0]))
    gain = TERMS["position_gain"](moment(metrics=now, previous=before))
    assert gain == pytest.approx(np.array([(math.log(2.0) + math.log(3.0)) / 2.0]))


def test_rewards_are_floored_where_luck_begins_and_cut_where_a_track_is_far_off():
    metrics = moment().metrics
    lucky = metrics._replace(range_error_m=np.array([[0.0, 29.0]]))
    assert TERMS["log_range_error"](moment(metrics=lucky)) == pytest.approx(np.array([math.log(1000.0 / 30.0)]))
    far = metrics._replace(range_error_m=np.array([[1e9, 1000.0]]))
    assert TERMS["relative_range_error"](moment(metrics=far)) == pytest.approx(np.array([-(10.0 + 0.1) / 2.0]))
    assert TERMS["range_error"](moment(metrics=far)) == pytest.approx(np.array([-(10.0 + 0.1) / 2.0]))
    assert TERMS["final_range_error"](moment(final=np.array([False]))) == pytest.approx(np.array([0.0]))
    assert TERMS["standoff"](moment(standoff_m=0.0)) == pytest.approx(np.array([0.0]))
    assert TERMS["final_log_range_bound"](moment(final=np.array([False]))) == pytest.approx(np.array([0.0]))


def test_rewards_in_the_environment_are_the_weighted_terms():
    weights = {f"reward_{name}": 0.1 * (i + 1) for i, name in enumerate(IN_PLANE)}
    env = PassiveEnv(steps=20, standoff_m=1e5, lost_error_m=500.0, lost_nees=1.0, **weights)
    _, info = env.reset(seed=1)
    for k in range(20):
        previous = info["range_crlb_m"]
        action = np.array([0.9, -0.1 * (k % 5)])
        _, reward, _, truncated, info = env.step(action)
        gap = np.linalg.norm(env.world.platforms[0, :, None, :2] - env.world.truth[0, None, :, :2], axis=-1)
        expected = {
            "log_range_error": -np.log(np.maximum(info["range_error_m"], 30.0) / 1e3).mean(),
            "relative_range_error": -(info["range_error_m"] / info["range_m"]).mean(),
            "range_error": -info["range_error_m"].mean() / 1e4,
            "final_range_error": -info["range_error_m"].mean() / 1e4 * truncated,
            "log_range_bound": -np.log(info["range_crlb_m"] / 1e3).mean(),
            "final_log_range_bound": -np.log(info["range_crlb_m"] / 1e3).mean() * truncated,
            "information_gain": np.log(previous / info["range_crlb_m"]).mean(),
            "maneuver": -np.square(action).mean(),
            "standoff": -np.maximum(0.0, 1.0 - gap / 1e5).sum(),
            "lost_track": -info["lost"].mean(),
        }
        for name, value in expected.items():
            assert info["reward_terms"][name] == pytest.approx(
                weights[f"reward_{name}"] * value, rel=1e-9, abs=1e-12
            ), name
        assert reward == pytest.approx(sum(info["reward_terms"].values()), rel=1e-12)
    assert info["lost"].any()
    assert truncated


def test_standoff_counts_only_where_a_distance_is_set():
    assert "standoff" not in PassiveEnv(reward_standoff=5.0).reset(seed=0)[1]["reward_terms"]
    assert "standoff" not in PassiveEnv(reward_standoff=0.0, standoff_m=5e3).reset(seed=0)[1]["reward_terms"]
    env = PassiveEnv(standoff_m=5e3)  # nobody is near: the term stands there and is 0
    env.reset(seed=0)
    assert env.step(np.zeros(2))[4]["reward_terms"]["standoff"] == 0.0


# ------------------------------------------------------------------------------------------------ metrics


@pytest.mark.parametrize("tracker", ["rp_ekf", "fused_ekf"])
def test_metrics_against_numpy(tracker):
    env = PassiveVectorEnv(num_envs=20, tracker=tracker, autoreset_mode="disabled", lost_error_m=2e3, lost_nees=4.0)
    env.reset(seed=0)
    rng = np.random.default_rng(0)
    for _ in range(30):
        *_, info = env.step(rng.uniform(-1.0, 1.0, (20, 2)))
    mean, cov = env.world.estimate
    truth = env.world.tape.targets[:, 30]
    reference = env.world.platforms[:, 1:, :2]
    true_range = np.linalg.norm(truth[..., :2] - reference, axis=-1)
    off = mean - truth
    position_error = np.linalg.norm(off[..., :2], axis=-1)
    nees = np.einsum("emi,emi->em", off, np.linalg.solve(cov, off[..., None])[..., 0])
    np.testing.assert_allclose(info["range_m"], true_range, rtol=1e-12)
    np.testing.assert_allclose(
        info["range_error_m"], np.abs(np.linalg.norm(mean[..., :2] - reference, axis=-1) - true_range), atol=1e-6
    )
    np.testing.assert_allclose(info["position_error_m"], position_error, rtol=1e-12)
    np.testing.assert_allclose(info["nees"], nees, rtol=1e-6)
    np.testing.assert_array_equal(info["lost"], (position_error > 2e3) & (nees > 4.0))
    assert 0 < info["lost"].sum() < 60


@pytest.mark.parametrize("bearings", ["all", "reference"])
@pytest.mark.parametrize("detection_probability", [1.0, 0.5])
def test_range_crlb_is_the_information_form_bound_along_the_true_path(bearings, detection_probability):
    """The recursion in information form, from a prior of 15 km radially and 200 m/s that is blind across the line of
    sight, to which the first scan adds its bearings once. A missed bearing scales the expected information."""
    fields = {"bearings": bearings, "detection_probability": detection_probability}
    env = PassiveVectorEnv(num_envs=4, autoreset_mode="disabled", **fields)
    _, info = env.reset(seed=5)
    rng = np.random.default_rng(1)
    platforms, bound = [env.world.platforms], [info["range_crlb_m"]]
    for _ in range(45):
        *_, info = env.step(rng.uniform(-1.0, 1.0, (4, 2)))
        platforms.append(env.world.platforms)
        bound.append(info["range_crlb_m"])
    counted = slice(None) if bearings == "all" else slice(1, None)
    std = math.radians(0.5)
    for e, m in itertools.product(range(4), range(3)):
        truth = env.world.tape.targets[e, :, m]
        stations = np.array([p[e, :, :2] for p in platforms])
        prior = np.linalg.inv(first_information(truth[0], stations[0], std))
        cov = posterior_bound_information(
            truth, stations[:, counted], prior, std / math.sqrt(detection_probability), 2.0, 15.0
        )
        line = truth[:, :2] - stations[:, 1]
        u = line / np.linalg.norm(line, axis=-1, keepdims=True)
        expected = np.sqrt(np.einsum("ki,kij,kj->k", u, cov[:, :2, :2], u))
        np.testing.assert_allclose([b[e, m] for b in bound], expected, rtol=1e-5)


def first_information(truth, stations, std):
    """Information [4, 4] of the radial and velocity prior and of all first bearings, which every filter uses."""
    information = np.diag([0.0, 0.0, 200.0**-2, 200.0**-2])
    line = truth[:2] - stations[1]
    u = line / np.linalg.norm(line)
    information[:2, :2] += np.outer(u, u) / 15e3**2
    for station in stations:
        line = truth[:2] - station
        distance = np.linalg.norm(line)
        across = np.array([-line[1], line[0]]) / distance
        information[:2, :2] += np.outer(across, across) / (distance * std) ** 2
    return information


# ------------------------------------------------------------------------------------------------ actions


def test_continuous_actions_are_clipped_shares_of_the_limit():
    codec = Continuous(2)
    assert np.array_equal(codec.decode([0.25, -3.0], None), [[0.25, -1.0]])
    assert np.array_equal(codec.decode([[0.5, 1.5], [-0.5, 0.0]], 2), [[0.5, 1.0], [-0.5, 0.0]])
    commands = np.array([[0.125, -0.75], [1.0, -1.0]])
    assert np.array_equal(codec.decode(codec.encode(commands), 2), commands)
    assert codec.encode(commands).dtype == np.float32
    assert codec.encode(commands)[0] in codec.space


def test_discrete_choices_are_right_straight_left():
    codec = Discrete(2)
    assert np.array_equal(codec.decode([0, 2], None), [[-1.0, 1.0]])
    assert np.array_equal(codec.decode([[1, 0], [2, 1]], 2), [[0.0, -1.0], [1.0, 0.0]])
    assert np.array_equal(codec.encode(np.array([[-1.0, -0.6], [0.4, 0.6], [7.0, -0.2]])), [[0, 0], [1, 2], [2, 1]])
    five = Discrete(1, levels=5)
    assert np.array_equal(five.decode([[0], [1], [2], [3], [4]], 5)[:, 0], [-1.0, -0.5, 0.0, 0.5, 1.0])
    assert codec.encode(np.zeros((1, 2)))[0] in codec.space


@pytest.mark.parametrize("bad", [[3, 0], [-1, 0], [0.5, 1.0], [0], [0, 1, 2], [np.nan, 0], "ab"], ids=str)
def test_bad_discrete_actions(bad):
    with pytest.raises(ValueError, match="action"):
        Discrete(2).decode(bad, None)


def test_positive_actions_turn_counter_clockwise_at_the_limit():
    env = PassiveEnv(max_turn_rate_deg_s=3.0)
    env.reset(seed=0)
    before = env.world.platforms[0]
    env.step(np.array([1.0, -0.5]))
    after = env.world.platforms[0]
    turned = np.degrees(wrapped(np.arctan2(after[:, 3], after[:, 2]) - np.arctan2(before[:, 3], before[:, 2])))
    np.testing.assert_allclose(turned, [6.0, -3.0], atol=1e-9)


# ------------------------------------------------------------------------------------------------ scenarios

KINDS = (TwoStation, Ownship)
RULED = [
    pytest.param(kind, f, id=f"{kind.__name__}-{f.name}")
    for kind in KINDS
    for f in dataclasses.fields(kind)
    if f.metadata["kind"] in ("number", "integer")
]
ORDERED = [(kind, low, high) for kind in KINDS for low, high in kind.ordered]
PARTNERS = {low: high for _, low, high in ORDERED} | {high: low for _, low, high in ORDERED}
over_numbers = pytest.mark.parametrize(("kind", "f"), RULED)


def test_every_field_states_what_is_allowed():
    for f in (f for kind in KINDS for f in dataclasses.fields(kind)):
        assert f.metadata["kind"] in ("number", "integer", "choice", "flag", "free"), f.name
        assert f.metadata["doc"], f.name
        if "low" in f.metadata:
            assert f.metadata["low"] <= f.default <= f.metadata["high"], f.name


@over_numbers
def test_numbers_outside_their_limits_are_errors_that_name_field_value_and_limits(kind, f):
    low, high = f.metadata["low"], f.metadata["high"]
    whole = f.metadata["kind"] == "integer"
    for value in (
        (low - 1, high + 1) if whole else (low - 0.01, high * 1.01 + 0.01, math.nan, math.inf, -math.inf, 10**400)
    ):
        with pytest.raises(ValueError) as caught:
            kind(**{f.name: value})
        assert f"{kind.__name__}.{f.name} = {value!r}" in str(caught.value)
        assert f"[{low}, {high}]" in str(caught.value)


@over_numbers
def test_values_of_the_wrong_type_are_errors_that_name_the_field(kind, f):
    wrong = ["3", None, True, [1], 1 + 2j] + ([2.0, math.nan] if f.metadata["kind"] == "integer" else [])
    for value in wrong:
        with pytest.raises(ValueError, match=rf"{kind.__name__}\.{f.name} = .*must be (an integer|a number)"):
            kind(**{f.name: value})


@over_numbers
def test_limits_themselves_are_allowed_and_make_an_environment(kind, f):
    for value in (f.metadata["low"], f.metadata["high"]):
        fields = {f.name: value}
        if f.name in PARTNERS:
            fields[PARTNERS[f.name]] = value
        if f.name == "steps" and value > 1000:
            fields["targets"] = 1
        if f.name == "range_cap_m":
            fields["range_floor_m"] = 100.0
        env = PassiveEnv(kind(**fields))
        observation, _ = env.reset(seed=0)
        assert observation in env.observation_space
        assert env.step(env.action_space.high)[0] in env.observation_space


@pytest.mark.parametrize("number", [np.float64(2.5), np.float32(2.5), np.int64(2)], ids=lambda n: type(n).__name__)
def test_numpy_numbers_are_numbers(number):
    """Parameter sweeps come from arrays."""
    assert TwoStation(step_s=number).step_s == number
    if isinstance(number, np.integer):
        assert TwoStation(targets=number).targets == 2


@pytest.mark.parametrize(("kind", "low", "high"), ORDERED, ids=str)
def test_a_minimum_above_its_maximum_is_an_error_that_names_both(kind, low, high):
    top = getattr(kind(), high)
    with pytest.raises(ValueError, match=rf"{kind.__name__}\.{low} = {top + 1}.*{high} = {top}"):
        kind(**{low: top + 1})


@pytest.mark.parametrize("cap", [5e4, 4e4])
@pytest.mark.parametrize("kind", KINDS)
def test_the_trackers_nearest_range_must_lie_below_its_farthest(kind, cap):
    with pytest.raises(ValueError, match=rf"{kind.__name__}\.range_floor_m = 50000.0.*below range_cap_m = {cap}"):
        kind(range_floor_m=5e4, range_cap_m=cap)


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("course", "Paper"), ("course", None), ("bearings", "both"), ("actions", "box"), ("flight_split", "held-out"),
        ("tracker", "kalman"), ("tracker", ""), ("course", 3), ("course", np.array([1, 2])),
    ],
    ids=str,
)  # fmt: skip
def test_unknown_choices_are_errors_that_list_the_known_ones(field, value):
    with pytest.raises(ValueError, match=rf"TwoStation\.{field} = .*must be one of '\w+', '\w+'"):
        TwoStation(**{field: value})


@pytest.mark.parametrize("value", [3, 2.5, ["a.csv"], b"a.csv", True], ids=repr)
def test_flights_that_are_no_path_are_an_error_when_the_scenario_is_made(value):
    with pytest.raises(ValueError, match=r"TwoStation\.flights"):
        TwoStation(course="flights", flights=value)


def test_paper_courses_have_three_targets():
    with pytest.raises(ValueError, match=r"TwoStation\.targets = 2.*'paper' has 3"):
        TwoStation(course="paper", targets=2)


def test_an_unknown_field_suggests_the_nearest_or_lists_all():
    with pytest.raises(TypeError, match="no field 'step'; did you mean 'steps'"):
        make_scenario("TwoStation", {"step": 4})
    with pytest.raises(TypeError, match=r"no field 'xyzzy'; known fields: .*baseline_max_m.*targets"):
        make_scenario("TwoStation", {"xyzzy": 4})


def test_an_unknown_scenario_suggests_the_nearest():
    with pytest.raises(ValueError, match=r"unknown environment 'TwoStations'.*did you mean 'passive/TwoStation-v0'"):
        PassiveEnv("TwoStations")


def test_scenarios_are_values():
    scenario = TwoStation(targets=2)
    assert scenario == TwoStation(targets=2) != TwoStation()
    assert hash(scenario) == hash(TwoStation(targets=2))
    with pytest.raises(dataclasses.FrozenInstanceError):
        scenario.targets = 3
    assert scenario.replace(steps=7) == TwoStation(targets=2, steps=7)
    assert scenario.to_dict()["targets"] == 2


# ------------------------------------------------------------------------------------------------ a user's own tracker


class Tracks(NamedTuple):
    mean: np.ndarray
    cov: np.ndarray


class PlainEkf:
    """What a user might write in an afternoon: NumPy, one EKF per target, each bearing to the nearest track.

    Obeys `trackers.contract.Tracker` and knows nothing of this project's trackers.
    """

    def __init__(self, step_noise=15.0, range_m=70e3, range_std_m=6e3):
        self.q, self.range_m, self.range_std_m = step_noise, range_m, range_std_m

    def initiate(self, scan: Scan) -> Tracks:
        bearing, station = scan.bearings[:, -1], scan.stations[:, -1]
        along = np.stack([np.cos(bearing), np.sin(bearing)], axis=-1)
        across = np.stack([-along[..., 1], along[..., 0]], axis=-1)
        mean = np.zeros((*bearing.shape, 4))
        mean[..., :2] = station[:, None] + self.range_m * along
        cov = np.zeros((*bearing.shape, 4, 4))
        for u, std in ((along, self.range_std_m), (across, self.range_m * scan.bearing_std)):
            cov[..., :2, :2] += std**2 * u[..., :, None] * u[..., None, :]
        cov[..., 2, 2] = cov[..., 3, 3] = 250.0**2
        return Tracks(mean, cov)

    def predict(self, state: Tracks, step_s: float) -> Tracks:
        phi = np.eye(4) + step_s * np.eye(4, k=2)
        gain = np.vstack([0.5 * step_s * np.eye(2), np.eye(2)])
        return Tracks(state.mean @ phi.T, phi @ state.cov @ phi.T + self.q**2 * gain @ gain.T)

    def update(self, state: Tracks, scan: Scan) -> Update:
        mean, cov = state.mean.copy(), state.cov.copy()
        shape = (*mean.shape[:2], scan.bearings.shape[1])
        innovation, variance = np.zeros(shape), np.ones(shape)
        assignment = np.full(shape, -1)
        for e, s in itertools.product(range(shape[0]), range(shape[2])):
            nu, S, H = self._innovations(mean[e], cov[e], scan.bearings[e, s], scan.stations[e, s], scan.bearing_std)
            cost = np.where(scan.valid[e, s] & (nu**2 < 16.0 * S[:, None]), nu**2 / S[:, None], np.inf)
            while np.isfinite(cost).any():
                j, k = np.unravel_index(np.argmin(cost), cost.shape)
                gain = cov[e, j] @ H[j] / S[j]
                mean[e, j] += gain * nu[j, k]
                cov[e, j] -= np.outer(gain, gain) * S[j]
                innovation[e, j, s], variance[e, j, s], assignment[e, j, s] = nu[j, k], S[j], k
                cost[j], cost[:, k] = np.inf, np.inf
        log_likelihood = -0.5 * (np.log(2 * np.pi * variance) + innovation**2 / variance).sum(-1)
        return Update(Tracks(mean, cov), innovation, variance, log_likelihood, assignment)

    def estimate(self, state: Tracks) -> Gaussian:
        return Gaussian(state.mean, state.cov)

    @staticmethod
    def _innovations(mean, cov, bearings, station, std):
        d = mean[:, :2] - station
        r2 = (d**2).sum(-1)
        H = np.stack([-d[:, 1] / r2, d[:, 0] / r2, 0 * r2, 0 * r2], axis=-1)
        S = np.einsum("mi,mij,mj->m", H, cov, H) + std**2
        return wrapped(bearings - np.arctan2(d[:, 1], d[:, 0])[:, None]), S, H


def test_a_users_own_tracker_plugs_in_and_finds_the_targets():
    """A start at 70 km is 5 km off on average; after the rule's maneuver a plain EKF must be well below that."""
    tracker = PlainEkf()
    assert isinstance(tracker, Tracker)
    env = gym.make("passive/TwoStation-v0", tracker=tracker)
    assert env.unwrapped.simulation.tracker is tracker
    policy = make_policy("rule", env.unwrapped.scenario)
    first, last = [], []
    for seed in range(12):
        observation, info = env.reset(seed=seed)
        first.append(info["range_error_m"].mean())
        policy.reset(env.unwrapped.belief())
        truncated = False
        while not truncated:
            command = policy.act(env.unwrapped.belief(), observation[None])[0]
            observation, _, _, truncated, info = env.step(command.astype(np.float32))
            assert observation in env.observation_space
        last.append(info["range_error_m"].mean())
    assert 3e3 < np.mean(first) < 8e3
    assert np.median(last) < 1000.0
    assert np.mean(last) < 0.4 * np.mean(first)


def test_a_users_tracker_runs_in_batches_and_restarts_row_by_row():
    fields = {"tracker": PlainEkf(), "steps": 4, "detection_probability": 0.8, "false_bearings_mean": 1.0}
    env = PassiveVectorEnv(num_envs=3, autoreset_mode="next_step", **fields)
    singles = [PassiveEnv(**fields) for _ in range(3)]
    observation, _ = env.reset(seed=0)
    assert np.array_equal(observation, [single.reset(seed=i)[0] for i, single in enumerate(singles)])
    observation, _ = env.reset(seed=5, options={"reset_mask": np.array([False, True, False])})
    assert np.array_equal(observation[1], singles[1].reset(seed=6)[0])
    for _ in range(3):
        observation, *_ = env.step(np.full((3, 2), 0.3))
        np.testing.assert_allclose(observation, [single.step([0.3, 0.3])[0] for single in singles], atol=1e-6)


@dataclasses.dataclass(frozen=True)
class Boxed:
    tracks: Tracks


class BoxedEkf(PlainEkf):
    """The same with its state in a frozen dataclass, the contract's other form."""

    def initiate(self, scan):
        return Boxed(super().initiate(scan))

    def predict(self, state, step_s):
        return Boxed(super().predict(state.tracks, step_s))

    def update(self, state, scan):
        update = super().update(state.tracks, scan)
        return update._replace(posterior=Boxed(update.posterior))

    def estimate(self, state):
        return super().estimate(state.tracks)


def test_a_users_tracker_may_keep_its_state_in_a_dataclass():
    plain, boxed = (
        PassiveVectorEnv(num_envs=300, steps=2, tracker=tracker, autoreset_mode="same_step")
        for tracker in (PlainEkf(), BoxedEkf())
    )
    plain.reset(seed=0), boxed.reset(seed=0)
    mask = np.arange(300) % 2 == 0
    assert np.array_equal(*(env.reset(options={"reset_mask": mask})[0] for env in (plain, boxed)))
    for _ in range(3):
        assert np.array_equal(*(env.step(np.full((300, 2), 0.3))[0] for env in (plain, boxed)))
    assert np.array_equal(boxed.world.track_state.tracks.mean, plain.world.track_state.mean)


def test_the_observations_docstring_lists_every_field():
    text = TrackObservation.__doc__ or ""
    rows = re.findall(r"^        ((?:\w+\.?\w* )+)", text, re.MULTILINE)
    listed = {name for row in rows for name in row.split()}
    observations = (TrackObservation(2, 3, 2, 45), TrackObservation(1, 2, 1, 60, discs=1))
    names = {re.sub(r"\d+", "N", field.name) for observation in observations for field in observation.fields}
    axis = "(?:radial|cross)(?:_velocity)?"
    names = {re.sub(rf"log_std_{axis}$", "log_std_AXIS", name) for name in names}
    assert {re.sub(rf"corr_{axis}_{axis}$", "corr_AXIS_AXIS", name) for name in names} == listed


@pytest.mark.parametrize("verb", ["initiate", "predict", "update", "estimate"])
def test_an_object_without_one_of_the_verbs_is_a_type_error_that_names_it(verb):
    verbs = {name: (lambda self, *args: None) for name in ("initiate", "predict", "update", "estimate") if name != verb}
    with pytest.raises(TypeError, match=rf"has no {verb};"):
        gym.make("passive/TwoStation-v0", tracker=type("Half", (), verbs)())


def test_a_tracker_that_is_no_object_of_the_kind_names_all_verbs():
    with pytest.raises(TypeError, match=r"tracker is the class PlainEkf, must be an object"):
        TwoStation(tracker=PlainEkf)
    with pytest.raises(TypeError, match="has no initiate, predict, update, estimate"):
        PassiveEnv(tracker=3)


@pytest.mark.parametrize(
    ("spoil", "error", "message"),
    [
        (lambda mean, cov: (mean, cov), TypeError, r"Spoiled: estimate\(\) gave tuple, must give .*Gaussian"),
        (
            lambda mean, cov: Gaussian(mean[:, :1], cov[:, :1]),
            ValueError,
            r"must be \(\(1, 3, 4\)",
        ),
        (lambda mean, cov: Gaussian(mean, -cov), ValueError, "variances that are not positive"),
        (lambda mean, cov: Gaussian(mean, np.nan * cov), ValueError, "variances that are not positive"),
    ],
    ids=["tuple", "a track too few", "negative", "nan"],
)
def test_a_trackers_first_estimate_is_checked(spoil, error, message):
    class Spoiled(PlainEkf):
        def estimate(self, state):
            return spoil(*super().estimate(state))

    with pytest.raises(error, match=message):
        PassiveEnv(tracker=Spoiled()).reset(seed=0)


LATE_FAULTS = {
    "tuple": (lambda mean, cov: (mean, cov), TypeError, r"Later: estimate\(\) gave tuple"),
    "a track too few": (lambda mean, cov: Gaussian(mean[:, :1], cov[:, :1]), ValueError, r"must be \(\(2, 3, 4\)"),
    "one for all": (lambda mean, cov: Gaussian(mean[:1], cov[:1]), ValueError, r"\(1, 3, 4\), .*must be \(\(2, 3, 4\)"),
    "no velocity": (lambda mean, cov: Gaussian(mean[..., :2], cov), ValueError, r"must be \(\(2, 3, 4\)"),
    "variances": (lambda mean, cov: Gaussian(mean, cov[..., 0]), ValueError, r"\(2, 3, 4, 4\)"),
}


@pytest.mark.parametrize(("spoil", "error", "message"), LATE_FAULTS.values(), ids=LATE_FAULTS)
def test_a_trackers_later_estimates_keep_their_shape(spoil, error, message):
    """An estimate for one environment would broadcast to all without a word."""
    env = PassiveVectorEnv(num_envs=2, threads=1, tracker=spoilt_later(PlainEkf, spoil))
    env.reset(seed=0)
    for _ in range(2):
        env.step(np.zeros((2, 2)))
    with pytest.raises(error, match=message):
        env.step(np.zeros((2, 2)))


def numbers_in(tree):
    """All arrays and numbers in nested dicts and tuples."""
    if isinstance(tree, dict):
        tree = tuple(tree.values())
    return [leaf for part in tree for leaf in numbers_in(part)] if isinstance(tree, tuple) else [tree]


@pytest.mark.parametrize("spoil", SPOILT.values(), ids=SPOILT)
@pytest.mark.parametrize("scenario", ["TwoStation", "Ownship"])
def test_what_a_tracker_loses_later_does_not_leave_the_environment(spoil, scenario):
    """Observation, reward and all of info stay finite, with every reward term in use."""
    weights = {f"reward_{name}": 1.0 for name in IN_PLANE}
    tracker = spoilt_later(PlainEkf, spoil)
    env = PassiveVectorEnv(scenario, num_envs=2, threads=1, tracker=tracker, standoff_m=10e3, steps=8, **weights)
    env.reset(seed=0)
    with np.errstate(all="ignore"):
        for _ in range(8):
            observation, reward, _, _, info = env.step(np.full(env.action_space.shape, 0.3))
            assert observation in env.observation_space
            assert np.isfinite(reward).all()
            assert all(np.isfinite(leaf).all() for leaf in numbers_in(info))
    assert tracker.asked == 9


def test_flights_are_checked_when_the_environment_is_made(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"nowhere\.csv"):
        gym.make("passive/TwoStation-v0", course="flights", flights=str(tmp_path / "nowhere.csv"))
    with pytest.raises(ValueError, match=r"TwoStation\.flights = .*is not used with course='random'"):
        gym.make_vec("passive/TwoStation-v0", num_envs=2, flights=str(tmp_path / "nowhere.csv"))
    with pytest.raises(ValueError, match="5000"):
        PassiveVectorEnv(course="flights", steps=5000)


class Diverging(PlainEkf):
    """Loses its head after two scans."""

    def estimate(self, state):
        mean, cov = state
        if np.abs(cov[..., 2, 2]).max() < 250.0**2 - 1.0:
            return Gaussian(np.full_like(mean, np.nan), np.full_like(cov, np.inf))
        return Gaussian(mean, cov)


def test_a_users_diverging_tracker_cannot_push_the_observation_out_of_its_box():
    """Design: a diverging filter must not leak inf into what a learner sees."""
    env = PassiveEnv(tracker=Diverging())
    env.reset(seed=0)
    with np.errstate(all="ignore"):
        for _ in range(10):
            observation, reward, _, _, info = env.step(np.array([0.3, -0.3]))
            assert observation in env.observation_space
            assert math.isfinite(reward)
            assert all(np.isfinite(info[name]).all() for name in ("range_error_m", "position_error_m", "nees"))
    assert info["lost"].all()
    assert np.isnan(env.world.estimate.mean).all()


# ------------------------------------------------------------------------------------------------ robustness


def load_soak():
    spec = importlib.util.spec_from_file_location("soak", Path(__file__).parents[1] / "benchmarks" / "soak.py")
    module = importlib.util.module_from_spec(spec)
    import sys

    sys.modules["soak"] = module  # dataclasses look their module up
    spec.loader.exec_module(module)
    return module


SOAK = load_soak()
SOAK_STEPS = 400_000


@pytest.mark.parametrize("name", list(SOAK.EXTREMES))
def test_extreme_scenarios_stay_finite_and_inside_the_box(name):
    """Whole episodes of random actions in every extreme; `benchmarks/soak.py` flies millions."""
    seen = SOAK.soak(SOAK.EXTREMES[name], SOAK_STEPS // len(SOAK.EXTREMES), envs=128, seed=1)
    assert seen.steps >= SOAK_STEPS // len(SOAK.EXTREMES)
    assert seen.episodes >= 128


def test_the_soak_test_notices_a_value_that_is_not_finite(monkeypatch):
    """It must be able to fail."""
    observe = Simulation.observe
    monkeypatch.setattr(Simulation, "observe", lambda self, world: observe(self, world) * np.float32("nan"))
    with pytest.raises(SOAK.Violation, match="observation out of its box"):
        SOAK.soak(TwoStation(), 100, envs=2)


def test_twin_flights_repeat_themselves():
    """The helper that holds truths apart flies the environment's own episodes."""
    flown = fly(TwoStation(steps=5), random_decisions()(), range(3, 5))
    env = PassiveVectorEnv(num_envs=2, steps=5)
    observation, _ = env.reset(seed=3)
    for k in range(5):
        assert np.array_equal(observation, flown.observations[k])
        observation, reward, *_ = env.step(flown.commands[k])
        assert np.array_equal(reward, flown.rewards[k])


def test_a_family_that_leaves_out_a_part_cannot_be_made():
    class Unfinished(BearingScenario):
        pass

    with pytest.raises(TypeError, match=r"abstract.*bound_range_std_m.*course_uniforms.*draw_courses"):
        Unfinished()  # type: ignore
