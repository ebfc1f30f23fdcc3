"""One platform, bearings only: what is drawn, how it moves, what trespassing costs, what can be known."""

import itertools
import math

import gymnasium as gym
import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.stats import chi2
from twin_worlds import SHIFT, assert_twins_look_alike, fly_twins, random_decisions

from agents.evaluation import fly
from agents.policy import make_policy
from passive_env import PassiveEnv, PassiveVectorEnv
from passive_env.catalogue import make_scenario
from passive_env.catalogue.angle_fusion import AngleFusion
from passive_env.catalogue.ownship import DISC_OFFSET, NEAREST_DISC, Ownship
from passive_env.core import Simulation, map_rows
from passive_env.flights import FlightFileError, load_flights
from passive_env.kinematics import maneuver, weave
from passive_env.metrics import PRIOR_VELOCITY_STD_M_S, violations
from passive_env.sensors import sense
from trackers import RpEkf, Scan
from trackers.bounds import posterior_bound_information
from trackers.measurement import bearing_jacobian
from trackers.motion import transition
from trackers.rp_ekf import initiate
from trackers.triangulation import RangeInterval

TAIL = 5e-4
STEP_S, SPEED, TURN = 5.0, 250.0, math.radians(3.0)


def begin(episodes, **fields):
    simulation = Simulation(Ownship(**fields))
    return simulation, simulation.begin([np.random.default_rng(seed) for seed in range(episodes)])


def wrapped(angle):
    return (angle + math.pi) % (2.0 * math.pi) - math.pi


def length(vector):
    return np.linalg.norm(vector, axis=-1)


# ------------------------------------------------------------------------------------------------ what is registered


@pytest.mark.parametrize(
    ("name", "fields"),
    [
        ("Ownship", {}),
        ("OwnshipManeuvering", {"maneuvering": True, "tracker": "rp_ekf_adaptive"}),
        ("OwnshipMulti", {"targets": 3, "standoff_m": 1e4}),
    ],
)
def test_registered_variants_differ_from_the_default_in_the_named_fields_only(name, fields):
    assert make_scenario(name, {}) == Ownship(**fields)
    assert gym.make(f"passive/{name}-v0").unwrapped.scenario == Ownship(**fields)


def test_defaults_are_those_of_the_problem():
    scenario = Ownship()
    tracker = scenario.make_tracker()
    assert (scenario.stations, scenario.targets, scenario.steps, scenario.step_s) == (1, 1, 60, 5.0)
    assert (scenario.max_turn_rate_deg_s, scenario.bearing_std_deg, scenario.station_speed_m_s) == (3.0, 0.5, 250.0)
    assert scenario.reward_weights == {"log_range_error": 1.0}
    assert isinstance(tracker, RpEkf)
    assert (tracker.hypotheses, tracker.floor_m, tracker.cap_m, tracker.velocity_std) == (8, 15e3, 120e3, 200.0)
    assert tracker.process_noise == 1.0 * scenario.step_s  # 1 m/s² over a step


# ------------------------------------------------------------------------------------------------ what is drawn


def test_starts_fill_the_scenarios_limits_in_every_direction():
    _, world = begin(600, targets=3)
    platform, target = world.platforms[:, 0], world.truth.reshape(-1, 4)
    assert (platform[:, :2] == 0.0).all()
    np.testing.assert_allclose(length(platform[:, 2:]), SPEED, rtol=1e-12)
    for values, low, high in ((length(target[:, :2]), 25e3, 90e3), (length(target[:, 2:]), 100.0, 300.0)):
        assert low <= values.min() < low + 0.02 * (high - low)
        assert high - 0.02 * (high - low) < values.max() <= high
        assert abs(values.mean() - 0.5 * (low + high)) < 4.0 * (high - low) / math.sqrt(12.0 * len(values))
    for vector in (platform[:, 2:], target[:, :2], target[:, 2:]):
        observed, _ = np.histogram(np.arctan2(vector[:, 1], vector[:, 0]), bins=12, range=(-math.pi, math.pi))
        expected = len(vector) / 12
        assert ((observed - expected) ** 2 / expected).sum() < chi2.ppf(1.0 - TAIL, df=11)


def test_the_tape_depends_on_the_seed_and_not_on_the_actions():
    fields = {"maneuvering": True, "nogo_discs": 2, "detection_probability": 0.8, "false_bearings_mean": 1.0}
    tapes = []
    for seed, command in ((3, 0.9), (3, -0.9), (4, 0.9)):
        env = PassiveEnv("Ownship", **fields)
        env.reset(seed=seed)
        for _ in range(60):
            env.step(np.full(1, command))
        tapes.append(env.world.tape)
    map_rows(np.testing.assert_array_equal, tapes[0], tapes[1])
    for name in ("platforms", "targets", "noise", "discs"):
        assert not np.array_equal(getattr(tapes[0], name), getattr(tapes[2], name)), name


@pytest.mark.parametrize(
    "fields",
    [{"maneuvering": True}, {"nogo_discs": 4}, {"detection_probability": 0.5, "false_bearings_mean": 2.0}],
    ids=str,
)
def test_keywords_leave_starts_and_noise_as_they_are(fields):
    plain, varied = (begin(20, **changes)[1] for changes in ({}, fields))
    np.testing.assert_array_equal(varied.tape.platforms, plain.tape.platforms)
    np.testing.assert_array_equal(varied.tape.targets[:, 0], plain.tape.targets[:, 0])
    np.testing.assert_array_equal(varied.tape.noise, plain.tape.noise)


def test_targets_fly_straight_unless_told_to_maneuver():
    _, world = begin(20)
    start = world.tape.targets[:, :1]
    time_s = STEP_S * np.arange(61)[:, None, None]
    np.testing.assert_allclose(world.tape.targets[..., :2], start[..., :2] + time_s * start[..., 2:], atol=1e-6)
    np.testing.assert_allclose(world.tape.targets[..., 2:], np.broadcast_to(start[..., 2:], (20, 61, 1, 2)), rtol=1e-12)


# ------------------------------------------------------------------------------------------------ maneuvering targets


def turns_of(heading, step_s):
    """(begin [s], rate [rad/s], duration [s]) of every turn of unwrapped headings [k] that ends before the last one."""
    change = np.diff(heading)
    turning = np.abs(change) > 1e-9
    edges = np.flatnonzero(np.diff(np.concatenate([[False], turning, [False]])))
    found = []
    for first, last in zip(edges[::2], edges[1::2], strict=True):
        if last < len(change):
            part = change[first:last]
            rate = part[np.argmax(np.abs(part))] / step_s
            found.append((first * step_s, rate, part.sum() / rate))
    return found


def test_maneuvering_targets_turn_as_often_as_long_and_as_fast_as_stated_at_constant_speed():
    """Sampled every 0.1 s: rates of 1–3°/s for 10–30 s, straight for 30–90 s between, several turns in 300 s."""
    scenario = Ownship(maneuvering=True, targets=3, step_s=0.1, steps=3000)
    targets = scenario.draw_tape([np.random.default_rng(seed) for seed in range(25)]).targets
    heading = np.unwrap(np.arctan2(targets[..., 3], targets[..., 2]), axis=1)
    speed = length(targets[..., 2:])
    np.testing.assert_allclose(speed, np.broadcast_to(speed[:, :1], speed.shape), rtol=1e-10)
    flown = [turns_of(heading[e, :, m], 0.1) for e in range(25) for m in range(3)]
    rates = np.degrees([rate for turns in flown for _, rate, _ in turns])
    durations = np.array([duration for turns in flown for *_, duration in turns])
    legs = [b[0] - (a[0] + a[2]) for turns in flown for a, b in itertools.pairwise(turns)]
    for values, low, high, resolution in ((np.abs(rates), 1.0, 3.0, 1e-6), (durations, 10.0, 30.0, 1e-6),
                                          (np.array(legs), 30.0, 90.0, 0.2)):  # fmt: skip
        assert low - resolution <= values.min() < low + 0.1 * (high - low)
        assert high - 0.1 * (high - low) < values.max() <= high + resolution
    assert 0.35 < (rates > 0).mean() < 0.65
    assert 3.0 < np.mean([len(turns) for turns in flown]) < 4.5
    assert max(turns[0][0] for turns in flown) <= 90.0
    assert min(turns[0][0] for turns in flown) < 10.0


def test_turns_last_to_the_end_of_long_episodes_of_the_shortest_legs():
    scenario = Ownship(maneuvering=True, target_turn_min_s=5, target_turn_max_s=5, target_straight_min_s=5,
                       target_straight_max_s=5, steps=500)  # fmt: skip
    targets = scenario.draw_tape([np.random.default_rng(seed) for seed in range(5)]).targets
    heading = np.unwrap(np.arctan2(targets[..., 3], targets[..., 2]), axis=1)
    assert (np.ptp(heading[:, -4:], axis=1) > 0.05).all()


def test_weaving_is_exact_through_windows_that_open_and_close_between_scans():
    """Two turns within one step of 5 s, one over several steps; the pieces are integrated one by one."""
    start = np.array([6e4, 4e4, -200.0, 150.0])
    rates = np.radians([3.0, -2.0, 1.0])
    windows = np.array([[0.7, 1.9], [2.2, 4.1], [8.5, 21.0]])
    path = weave(start, rates, windows, 5.0, np.empty(7))

    def slope(t, s):
        rate = sum(r for r, (low, high) in zip(rates, windows, strict=True) if low <= t < high)
        return [s[2], s[3], -rate * s[3], rate * s[2]]

    state, at = start, 0.0
    for t in sorted({*windows.ravel().tolist(), *(5.0 * np.arange(1, 7)).tolist()}):
        state = solve_ivp(slope, (at, t - 1e-12), state, method="DOP853", rtol=1e-12, atol=1e-9).y[:, -1]
        at = t
        if t % 5.0 == 0.0:
            np.testing.assert_allclose(path[round(t / 5.0)], state, rtol=0, atol=1e-5)


def test_one_turn_of_a_weave_is_a_maneuver_without_acceleration():
    start, window = np.array([3e4, -2e4, 120.0, 90.0]), np.array([7.3, 24.1])
    expected = maneuver(start, 0.03, window, 0.0, np.zeros(2), 5.0, np.empty(9))
    np.testing.assert_array_equal(weave(start, np.array([0.03]), window[None], 5.0, np.empty(9)), expected)


# ------------------------------------------------------------------------------------------------ the platform's arc


@pytest.mark.parametrize("command", [1.0, -0.4])
def test_a_turning_step_is_an_arc_and_the_bearing_is_taken_at_its_end(command):
    """Chord 2 R sin(ωT/2) along the middle heading, R = v/ω; 250 m/s and 3°/s give R = 4.77 km."""
    simulation, world = begin(4)
    after, *_ = simulation.advance(world, np.full((4, 1), command))
    rate = command * TURN
    before = world.platforms[:, 0]
    heading = np.arctan2(before[:, 3], before[:, 2])
    middle = heading + 0.5 * rate * STEP_S
    chord = 2.0 * SPEED / rate * math.sin(0.5 * rate * STEP_S)
    end = before[:, :2] + chord * np.stack([np.cos(middle), np.sin(middle)], axis=-1)
    np.testing.assert_allclose(after.platforms[:, 0, :2], end, atol=1e-6)
    turned = wrapped(np.arctan2(after.platforms[:, 0, 3], after.platforms[:, 0, 2]) - heading)
    np.testing.assert_allclose(np.degrees(turned), 15.0 * command, atol=1e-9)
    scan = sense(world.tape, after.step, after.platforms, math.radians(0.5)).scan
    line = world.tape.targets[:, 1, 0, :2] - end
    noise = world.tape.noise[:, 1, 0, 0] * math.radians(0.5)
    np.testing.assert_allclose(
        wrapped(scan.bearings[:, 0, 0] - np.arctan2(line[:, 1], line[:, 0]) - noise), 0, atol=1e-9
    )


# ------------------------------------------------------------------------------------------------ zones


@pytest.mark.parametrize(
    "fields", [{}, {"nogo_radius_m": 100.0}, {"nogo_radius_m": 1e5}, {"range_min_m": 1e3, "range_max_m": 1e3}], ids=str
)
def test_discs_lie_on_the_way_to_the_targets_and_never_over_the_start(fields):
    scenario = Ownship(nogo_discs=4, targets=3, **fields)
    tape = scenario.draw_tape([np.random.default_rng(seed) for seed in range(200)])
    radius = scenario.nogo_radius_m
    assert (tape.discs[..., 2] == radius).all()
    assert (length(tape.discs[..., :2] - tape.platforms[..., :2]) >= NEAREST_DISC * radius * (1.0 - 1e-12)).all()
    target = tape.targets[:, 0, [0, 1, 2, 0], :2]
    sight = target / length(target)[..., None]
    along = np.einsum("edi,edi->ed", sight, tape.discs[..., :2])
    across = sight[..., 0] * tape.discs[..., 1] - sight[..., 1] * tape.discs[..., 0]
    low, high = NEAREST_DISC * radius, max(NEAREST_DISC * radius, scenario.range_min_m)
    assert (along >= low * (1.0 - 1e-9)).all()
    assert (along <= high * (1.0 + 1e-9)).all()
    assert np.ptp(along) >= 0.9 * (high - low)
    assert 0.95 * DISC_OFFSET * radius < np.abs(across).max() <= DISC_OFFSET * radius * (1.0 + 1e-9)


def test_discs_do_not_tell_how_far_the_targets_are():
    near, far = (begin(50, nogo_discs=3, range_max_m=high)[1].tape for high in (30e3, 90e3))
    assert not np.allclose(near.targets, far.targets)
    np.testing.assert_allclose(near.discs, far.discs, rtol=1e-12)


def test_a_platform_can_turn_away_from_a_disc_straight_ahead():
    """The circle flown at full turn rate from the start passes beside the nearest disc."""
    turn_radius = SPEED / TURN
    assert math.hypot(NEAREST_DISC * Ownship().nogo_radius_m, turn_radius) > Ownship().nogo_radius_m + turn_radius


def test_violations_by_hand():
    platforms = np.array([[[0.0, 0.0, 1.0, 0.0]], [[6e3, 8e3, 1.0, 0.0]]])
    truth = np.array([[[3e3, 4e3, 1.0, 1.0], [4e4, 0.0, 1.0, 1.0]]] * 2)
    discs = np.array([[[6e3, 8e3, 8e3], [6e3, 3e3, 2e4]]] * 2)
    seen = violations(platforms, truth, 1e4, discs)
    np.testing.assert_allclose(seen.standoff, [0.5, 0.5])
    np.testing.assert_allclose(seen.nogo, [1.0 - math.sqrt(45.0) / 20.0, 1.0 + 0.75])
    assert violations(platforms, truth, 0.0, discs).standoff.tolist() == [0.0, 0.0]
    assert violations(truth[:, :1], truth, 0.0, discs).standoff.tolist() == [0.0, 0.0]  # not even on the target


@pytest.mark.parametrize("vector", [False, True])
def test_info_and_reward_show_violations(vector):
    """A platform that heads for the middle of a disc and across it, inside its target's wide ring."""
    fields = {"nogo_discs": 1, "nogo_radius_m": 1e4, "standoff_m": 1e5, "reward_nogo": 3.0, "steps": 60}
    env = (PassiveVectorEnv if vector else PassiveEnv)("Ownship", **fields)
    _, info = env.reset(seed=1)
    assert np.squeeze(info["nogo_violation"]) == 0.0
    deepest = 0.0
    for _ in range(60):
        command = ahead(env.world.platforms[0, 0], env.world.tape.discs[0, 0])
        *_, info = env.step(np.full((1, 1) if vector else 1, command))
        at = env.world.platforms[0, 0, :2]
        disc, target = env.world.tape.discs[0, 0], env.world.truth[0, 0]
        nogo = max(0.0, 1.0 - math.dist(at, disc[:2]) / disc[2])
        standoff = max(0.0, 1.0 - math.dist(at, target[:2]) / 1e5)
        assert np.squeeze(info["nogo_violation"]) == pytest.approx(nogo, abs=1e-12)
        assert np.squeeze(info["standoff_violation"]) == pytest.approx(standoff, abs=1e-12)
        assert np.squeeze(info["reward_terms"]["nogo"]) == pytest.approx(-3.0 * nogo, abs=1e-12)
        assert np.squeeze(info["reward_terms"]["standoff"]) == pytest.approx(-standoff, abs=1e-12)
        deepest = max(deepest, nogo)
    assert deepest > 0.8


def ahead(state, goal):
    """Command that turns a platform towards a goal."""
    off = wrapped(math.atan2(goal[1] - state[1], goal[0] - state[0]) - math.atan2(state[3], state[2]))
    return np.clip(off / (TURN * STEP_S), -1.0, 1.0)


def test_the_nogo_term_counts_only_where_there_are_discs():
    assert "nogo" not in PassiveEnv("Ownship", reward_nogo=5.0).reset(seed=0)[1]["reward_terms"]
    assert "nogo" not in PassiveEnv("Ownship", nogo_discs=1, reward_nogo=0.0).reset(seed=0)[1]["reward_terms"]
    assert "nogo" in PassiveEnv("Ownship", nogo_discs=1).reset(seed=0)[1]["reward_terms"]


# ------------------------------------------------------------------------------------------------ belief, observation


def test_belief_and_observation_hold_the_discs():
    env = PassiveVectorEnv("Ownship", num_envs=5, nogo_discs=2)
    env.reset(seed=0)
    observation, *_ = env.step(np.full((5, 1), 0.5))
    belief = env.belief()
    np.testing.assert_array_equal(belief.discs, env.world.tape.discs)
    names = [field.name for field in env.observation_fields]
    sight = belief.mean[:, 0, :2] - belief.platforms[:, 0, :2]
    sight /= length(sight)[:, None]
    for d in range(2):
        offset = belief.discs[:, d, :2] - belief.platforms[:, 0, :2]
        along, across = (observation[:, names.index(f"disc{d}.{axis}")] for axis in ("along", "across"))
        np.testing.assert_allclose(along, np.sum(sight * offset, axis=-1) / 2e4, atol=1e-5)
        np.testing.assert_allclose(across, (sight[:, 0] * offset[:, 1] - sight[:, 1] * offset[:, 0]) / 2e4, atol=1e-5)


def test_without_discs_the_belief_holds_none_and_the_observation_no_field():
    env = PassiveEnv("Ownship")
    env.reset(seed=0)
    assert env.belief().discs.shape == (1, 0, 3)
    assert not any("disc" in field.name for field in env.observation_fields)


def test_the_bearing_of_the_only_track_is_left_out():
    """It would be constant: ψ is that line of sight."""
    fields = {
        targets: [f.name for f in PassiveEnv("Ownship", targets=targets).observation_fields] for targets in (1, 2)
    }
    assert not any("bearing" in name for name in fields[1])
    assert sum("bearing" in name for name in fields[2]) == 4


@pytest.mark.parametrize(
    "fields",
    [
        {},
        {"targets": 3, "nogo_discs": 2, "standoff_m": 5e4},
        {"maneuvering": True, "detection_probability": 0.7, "false_bearings_mean": 1.0},
        {"tracker": "fused_ekf"},
    ],
    ids=str,
)
def test_observations_do_not_change_when_the_truth_behind_the_same_bearings_does(monkeypatch, fields):
    first, second = fly_twins(monkeypatch, Ownship(**fields), random_decisions(), range(4))
    assert np.abs(second.truth[20] - first.truth[20] - SHIFT).max() < 1e-6
    assert_twins_look_alike(first, second)


# ------------------------------------------------------------------------------------------------ the tracker's start


def test_one_stations_bank_starts_over_the_whole_interval():
    scan = Scan(np.array([[[0.3, -2.0]]]), np.ones((1, 1, 2), dtype=bool), np.array([[[1e3, -2e3]]]), 0.01)
    state = RpEkf(hypotheses=5, floor_m=15e3, cap_m=120e3).initiate(scan)
    for j, bearing in enumerate((0.3, -2.0)):
        expected = initiate(bearing, scan.stations[0, 0], 0.01, RangeInterval(15e3, 120e3), 5)
        np.testing.assert_array_equal(state.mean[0, j], expected.mean)
        np.testing.assert_array_equal(state.cov[0, j], expected.cov)
        np.testing.assert_array_equal(state.log_weights[0, j], expected.log_weights)
        edges = 15e3 * 8.0 ** (np.arange(6) / 5)
        np.testing.assert_allclose(
            length(state.mean[0, j, :, :2] - scan.stations[0, 0]), 0.5 * (edges[1:] + edges[:-1])
        )


@pytest.mark.parametrize("fields", [{}, {"range_floor_m": 5e3, "range_cap_m": 60e3}], ids=str)
def test_range_fields_reach_the_tracker_and_the_bounds_prior(fields):
    scenario = Ownship(**fields)
    simulation = Simulation(scenario)
    world = simulation.begin([np.random.default_rng(0)])
    near, far = scenario.range_floor_m, scenario.range_cap_m
    assert length(world.estimate.mean[0, 0, :2]) == pytest.approx(
        0.5 * (near + far), rel=1e-9
    )  # an even spread's middle
    assert world.metrics.range_crlb_m[0, 0] == pytest.approx((far - near) / math.sqrt(12.0), rel=1e-9)


# ------------------------------------------------------------------------------------------------ what can be known


def platforms_flown(commands):
    """[k + 1, 4] of one platform under commands [k]."""
    simulation, world = begin(1)
    states = [world.platforms[0, 0]]
    for command in commands:
        world, *_ = simulation.advance(world, np.full((1, 1), command))
        states.append(world.platforms[0, 0])
    return np.array(states), world.tape.targets[0, :, 0]


def test_a_straight_flight_leaves_one_direction_of_the_state_unknown_and_a_turn_shows_it():
    """Fisher information of all bearings about the target's start state: rank 3 before any maneuver, 4 after one.

    Columns are scaled to 10 km and 100 m/s. Source: Nardone and Aidala (1981), IEEE Trans. AES 17(2).
    """
    spectra = []
    for commands in (np.zeros(30), np.where(np.arange(30) // 5 % 2, 1.0, 0.0)):
        platforms, targets = platforms_flown(commands)
        rows = [
            np.concatenate([bearing_jacobian(target, platform[:2]), [0.0, 0.0]]) @ transition(STEP_S * k)
            for k, (platform, target) in enumerate(zip(platforms, targets, strict=False))
        ]
        H = np.array(rows) / math.radians(0.5) * np.array([1e4, 1e4, 1e2, 1e2])
        spectra.append(np.linalg.svd(H, compute_uv=False))
    straight, turned = spectra
    assert straight[2] > 1e-2
    assert straight[3] < 1e-9 * straight[0]
    assert turned[3] > 1e-2


def test_range_crlb_of_one_moving_platform_is_the_information_form_bound():
    simulation, world = begin(1)
    rng = np.random.default_rng(1)
    platforms, bound = [world.platforms[0]], [world.metrics.range_crlb_m[0, 0]]
    for _ in range(60):
        world, *_ = simulation.advance(world, rng.uniform(-1.0, 1.0, (1, 1)))
        platforms.append(world.platforms[0])
        bound.append(world.metrics.range_crlb_m[0, 0])
    truth, stations = world.tape.targets[0, :, 0], np.array(platforms)[..., :2]
    line = truth[:, :2] - stations[:, 0]
    distance = length(line)
    u = line / distance[:, None]
    across = np.array([-u[0, 1], u[0, 0]])
    prior = np.zeros((4, 4))
    prior[:2, :2] = (105e3**2 / 12.0) * np.outer(u[0], u[0])
    prior[:2, :2] += (distance[0] * math.radians(0.5)) ** 2 * np.outer(across, across)
    prior[2, 2] = prior[3, 3] = PRIOR_VELOCITY_STD_M_S**2
    cov = posterior_bound_information(truth, stations, prior, math.radians(0.5), 5.0, 5.0)
    np.testing.assert_allclose(bound, np.sqrt(np.einsum("ki,kij,kj->k", u, cov[:, :2, :2], u)), rtol=1e-5)
    assert bound[0] == pytest.approx(105e3 / math.sqrt(12.0), rel=1e-6)


def test_maneuvers_range_the_target_and_straight_flight_does_not():
    scenario = Ownship()
    straight, random = (fly(scenario, make_policy(name, scenario), 200, seed=50) for name in ("straight", "random"))
    assert straight.final.mean() > 25e3
    assert random.final.mean() < 0.5 * straight.final.mean()
    assert random.range_crlb_m[:, -1].mean() < 0.5 * straight.range_crlb_m[:, -1].mean()
    np.testing.assert_array_equal(random.range_error_m[:, 0], straight.range_error_m[:, 0])


# ------------------------------------------------------------------------------------------------ recorded flights


def test_recorded_flights_start_where_drawn_targets_would_and_keep_shape_and_speed():
    flown, drawn = (begin(15, course=course, targets=2)[1].tape.targets for course in ("flights", "random"))
    np.testing.assert_allclose(np.sort(length(flown[:, 0, :, :2])), np.sort(length(drawn[:, 0, :, :2])))
    paths = load_flights().split("train").resample(STEP_S)
    starts = paths.window_starts(60)
    speeds = length(paths.states[:, 3:5])[starts[:, None] + np.arange(61)]
    for path in flown.transpose(0, 2, 1, 3).reshape(-1, 61, 4):
        assert (np.abs(speeds - length(path[:, 2:])).max(axis=1) < 1e-6).any()
        np.testing.assert_allclose(np.diff(path[:, :2], axis=0) / STEP_S, path[:-1, 2:], atol=80.0)


def test_courses_of_flights_follow_the_drawn_course():
    flown, drawn = (begin(15, course=course)[1].tape.targets[:, 0, 0, 2:] for course in ("flights", "random"))
    cosine = np.sum(flown * drawn, axis=-1) / (length(flown) * length(drawn))
    np.testing.assert_allclose(cosine, 1.0, atol=1e-9)


def test_maneuvering_says_nothing_about_recorded_flights():
    tapes = [begin(3, course="flights", maneuvering=on)[1].tape for on in (False, True)]
    map_rows(np.testing.assert_array_equal, *tapes)


def test_a_missing_or_malformed_flights_file_is_found_at_once(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"none\.csv"):
        Ownship(course="flights", flights=str(tmp_path / "none.csv")).check_flights()
    (tmp_path / "bad.csv").write_text("time,place\n1,2\n")
    with pytest.raises(FlightFileError, match=r"bad\.csv"):
        Ownship(course="flights", flights=str(tmp_path / "bad.csv")).check_flights()
    with pytest.raises(ValueError, match="take fewer or shorter steps"):
        Ownship(course="flights", steps=5000).check_flights()


# ------------------------------------------------------------------------------------------------ bad input


@pytest.mark.parametrize("value", [1, 0, "yes", None, 1.0, [True]], ids=repr)
def test_maneuvering_must_be_true_or_false(value):
    with pytest.raises(ValueError, match=r"Ownship\.maneuvering = .*must be True or False"):
        Ownship(maneuvering=value)


def test_a_numpy_truth_value_is_one():
    assert Ownship(maneuvering=np.True_) == Ownship(maneuvering=True)


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"targets": 4}, r"Ownship\.targets = 4: must lie in \[1, 3\]"),
        ({"nogo_discs": 5}, r"Ownship\.nogo_discs = 5: must lie in \[0, 4\]"),
        ({"course": "paper"}, r"Ownship\.course = 'paper': must be one of 'random', 'flights'"),
        ({"tracker": "kalman"}, r"Ownship\.tracker = 'kalman': must be one of"),
        ({"flights": 3}, r"Ownship\.flights = 3: must be the path of a file"),
    ],
    ids=str,
)
def test_bad_fields_are_errors_that_name_field_value_and_what_is_allowed(fields, message):
    with pytest.raises(ValueError, match=message):
        gym.make("passive/Ownship-v0", **fields)


@pytest.mark.parametrize("field", ["bearings", "baseline_min_m", "nogo_disc"])
def test_fields_it_does_not_have_are_errors(field):
    with pytest.raises(TypeError, match=f"Ownship has no field '{field}'"):
        gym.make("passive/Ownship-v0", **{field: 1})


@pytest.mark.parametrize("action", [np.zeros(2), np.zeros((1, 1)), 0.0, [np.nan], [np.inf], ["left"], None], ids=repr)
def test_bad_actions_are_errors(action):
    env = PassiveEnv("Ownship")
    env.reset(seed=0)
    with pytest.raises(ValueError, match="action"):
        env.step(action)


# ------------------------------------------------------------------------------------------------ pictures


def picture(**fields):
    env = gym.make("passive/Ownship-v0", render_mode="rgb_array", **fields)
    env.reset(seed=3)
    env.step(np.ones(1, dtype=np.float32))
    return env.render()


def test_discs_and_rings_are_drawn():
    plain, ringed, disced = (picture(**fields) for fields in ({}, {"standoff_m": 1e4}, {"nogo_discs": 1}))
    axes = slice(60, 650)  # above the legend
    for other in (ringed, disced):
        assert 0.001 < (other[axes] != plain[axes]).any(-1).mean() < 0.9


def test_the_only_platform_is_no_reference():
    from passive_env.artists import legend_samples, station_names, zone_samples

    assert station_names(1) == ["platform"]
    assert station_names(2) == station_names(2, Ownship.reference) == ["S1", "S2 (ref.)"]
    assert station_names(2, AngleFusion.reference) == ["S1 (ref.)", "S2"]
    assert next(s.get_label() for s in legend_samples(False, reference=False)) == "platform"
    assert [s.get_label() for s in zone_samples(True, True)] == ["no-go disc", "stand-off ring"]
    assert zone_samples(False, False) == []
