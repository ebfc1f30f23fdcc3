"""Two platforms in space: courses, scans, clutter in gates, dropouts, bound, observation, pictures, bad input."""

import dataclasses
import math

import gymnasium as gym
import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from scipy.stats import binom, chi2, kstest, norm, poisson
from spoilt_trackers import SPOILT, spoilt_later
from twin_worlds import (
    SHIFT,
    assert_blind_to_truth,
    assert_twins_look_alike,
    fly_twins,
    random_decisions,
    shift,
)

from agents.evaluation import fly as fly_policy
from agents.policy import make_policy
from passive_env import PassiveEnv, PassiveVectorEnv
from passive_env.angle_sensors import CLEAN_DENSITY
from passive_env.artists import Frame
from passive_env.catalogue import make_scenario
from passive_env.catalogue.angle_fusion import PAPER_PLATFORMS, PAPER_TARGET, AngleFusion
from passive_env.core import Simulation, map_rows
from passive_env.flights import load_flights
from passive_env.kinematics import turn_and_climb
from passive_env.render_angles import AngleScene, look_of
from trackers import ANGLE_TRACKERS, AngleEkf, AnglePdaf
from trackers.angle_pdaf import MAX_RETURNS
from trackers.angles import wrap
from trackers.bounds_3d import bound_start, position_std_3d, posterior_bound_information_3d, range_std_3d
from trackers.direction import direction, gate

IDS = ("AngleFusion", "AngleFusionClutter", "AngleFusionSlow")
ROUGH = {"clutter_mean": 4.0, "availability0_min": 0.5, "availability1_min": 0.5, "detection_probability": 0.9}
STD = math.radians(0.5)


def begin(episodes, name="AngleFusion", **fields):
    """A scenario's simulation and the world of its first instant."""
    simulation = Simulation(make_scenario(name, fields))
    return simulation, simulation.begin([np.random.default_rng(seed) for seed in range(episodes)])


def flown(episodes, steps, command=None, name="AngleFusion", seed=0, **fields):
    """All worlds of a flight under one command for all, or random ones."""
    simulation, world = begin(episodes, name, **fields)
    rng = np.random.default_rng(seed)
    worlds = [world]
    for _ in range(steps):
        chosen = rng.uniform(-1.0, 1.0, (episodes, 4)) if command is None else np.tile(command, (episodes, 1))
        worlds.append(simulation.advance(worlds[-1], np.asarray(chosen, dtype=float))[0])
    return simulation, worlds


def share_band(probability, n):
    """Share of n draws that leaves this band once in 10,000 times."""
    return binom.ppf([5e-5, 1 - 5e-5], n, probability) / n


# ------------------------------------------------------------------------------------------------ variants, courses


def test_the_named_variants_are_those_of_the_problem():
    clean, clutter, slow = (make_scenario(name, {}) for name in IDS)
    assert (clean.steps, clean.step_s, clean.platform_speed_m_s, clean.standoff_m) == (40, 2.0, 150.0, 6e3)
    assert (clean.max_turn_rate_deg_s, clean.max_climb_m_s, clean.clutter_mean) == (5.0, 30.0, 0.0)
    assert clutter == clean.replace(clutter_mean=8.0, availability0_min=0.3, availability1_min=0.3)
    assert slow == clean.replace(max_turn_rate_deg_s=1.0)


def test_the_paper_layout_stands_where_the_specification_puts_it():
    _, world = begin(2, course="paper")
    for e in range(2):
        np.testing.assert_array_equal(world.platforms[e], PAPER_PLATFORMS)
        time_s = 2.0 * np.arange(41)[:, None]
        start = np.array(PAPER_TARGET)
        np.testing.assert_allclose(world.tape.targets[e, :, 0, :3], start[:3] + time_s * start[3:])
    assert np.array_equal(world.platforms[0, :, 3:5], [[150.0, 0.0]] * 2)
    faster = begin(1, course="paper", platform_speed_m_s=200.0)[1].platforms[0]
    assert np.array_equal(faster[:, 3:5], [[200.0, 0.0]] * 2)


def test_drawn_courses_fill_their_limits_and_fly_straight():
    _, world = begin(600)
    platforms, targets = world.platforms, world.tape.targets[:, :, 0]
    assert np.array_equal(platforms[:, 0, :2], np.zeros((600, 2)))
    level = targets[:, 0, :2]
    for values, low, high in (
        (np.hypot(*level.T), 20e3, 40e3),
        (np.hypot(*platforms[:, 1, :2].T), 3e3, 9e3),
        (np.hypot(*targets[:, 0, 3:5].T), 100.0, 250.0),
        (targets[:, 0, 2], 4e3, 11e3),
        (targets[:, 0, 5], -10.0, 10.0),
        (platforms[..., 2].ravel(), 5e3, 8e3),
        (np.arctan2(*level.T[::-1]), -math.pi, math.pi),
        (np.arctan2(targets[:, 0, 4], targets[:, 0, 3]), -math.pi, math.pi),
        (np.arctan2(platforms[:, 0, 4], platforms[:, 0, 3]), -math.pi, math.pi),
    ):
        assert kstest(values, "uniform", args=(low, high - low)).pvalue > 1e-4
    np.testing.assert_allclose(np.diff(targets[..., :3], axis=1), 2.0 * targets[:, 1:, 3:], rtol=1e-9, atol=1e-7)
    assert np.array_equal(platforms[:, 0, 3:], platforms[:, 1, 3:])


@pytest.mark.parametrize(("formation", "along"), [("abreast", 0.0), ("trail", 1.0)])
def test_formations_fly_abreast_or_in_trail_on_both_sides(formation, along):
    _, world = begin(200, formation=formation)
    velocity, gap = world.platforms[:, 0, 3:5] / 150.0, world.platforms[:, 1, :2]
    ahead = (velocity * gap).sum(-1) / np.hypot(*gap.T)
    left = (velocity[:, 0] * gap[:, 1] - velocity[:, 1] * gap[:, 0]) / np.hypot(*gap.T)
    np.testing.assert_allclose(np.abs(ahead), along, atol=1e-12)
    low, high = share_band(0.5, 200)
    assert low < ((ahead if along else left) > 0.0).mean() < high


def test_half_of_random_formations_fly_abreast():
    _, world = begin(400)
    across = world.platforms[:, 0, 3] * world.platforms[:, 1, 0] + world.platforms[:, 0, 4] * world.platforms[:, 1, 1]
    low, high = share_band(0.5, 400)
    assert low < (np.abs(across) < 1e-6).mean() < high


def test_recorded_flights_keep_shape_speed_and_altitude():
    scenario = make_scenario("AngleFusion", {"course": "flights", "steps": 20})
    recorded = load_flights().split("train").resample(2.0).states
    tape = scenario.draw_tape([np.random.default_rng(seed) for seed in range(12)])
    for path in tape.targets[:, :, 0]:
        windows = [recorded[at : at + 21] for at in np.flatnonzero(recorded[:, 2] == path[0, 2])]
        window = next(window for window in windows if np.array_equal(window[:, 2], path[:, 2]))
        np.testing.assert_array_equal(path[:, 5], window[:, 5])
        np.testing.assert_allclose(np.hypot(*path[:, 3:5].T), np.hypot(*window[:, 3:5].T), rtol=1e-12)
        gaps = [np.hypot(*np.diff(p[:, :2], axis=0).T) for p in (path, window)]
        np.testing.assert_allclose(*gaps, rtol=1e-9, atol=1e-6)
    assert np.ptp(tape.targets[:, 0, 0, 2]) > 1e3
    assert (np.hypot(*tape.targets[:, 0, 0, :2].T) >= 20e3 - 1e-6).all()


def test_keywords_that_add_clutter_and_dropouts_leave_the_starts_as_they_are():
    plain, rough = begin(5)[1], begin(5, **ROUGH)[1]
    assert np.array_equal(plain.platforms, rough.platforms)
    assert np.array_equal(plain.tape.targets, rough.tape.targets)
    assert np.array_equal(plain.tape.noise, rough.tape.noise)


# ------------------------------------------------------------------------------------------------ motion


def test_turns_are_arcs_at_constant_level_speed_and_climbs_add_to_them():
    start = np.array([[100.0, -50.0, 6000.0, 150.0, 0.0, 0.0]])
    rate, climb, step = math.radians(5.0), 30.0, 2.0
    (after,) = turn_and_climb(start, np.array([rate]), np.array([climb]), step, np.array([0.0, 15e3]))
    radius = 150.0 / rate
    np.testing.assert_allclose(
        after,
        [
            100.0 + radius * math.sin(rate * step), -50.0 + radius * (1.0 - math.cos(rate * step)), 6060.0,
            150.0 * math.cos(rate * step), 150.0 * math.sin(rate * step), 30.0,
        ],
        rtol=1e-12,
    )  # fmt: skip


def test_a_platform_stops_at_its_lowest_and_highest_altitude():
    fields = {"platform_altitude_min_m": 5e3, "platform_altitude_max_m": 5e3}
    fields |= {"altitude_floor_m": 4900.0, "altitude_ceiling_m": 5100.0}
    _, worlds = flown(2, 4, [0.0, 0.0, 1.0, -1.0], **fields)
    heights = np.array([world.platforms[0, :, 2] for world in worlds])
    np.testing.assert_allclose(heights.T, [[5000, 5060, 5100, 5100, 5100], [5000, 4940, 4900, 4900, 4900]])
    np.testing.assert_allclose([world.platforms[0, 0, 5] for world in worlds], [0.0, 30.0, 20.0, 0.0, 0.0])


def test_actions_are_turns_then_climbs():
    _, (before, after) = flown(1, 1, [1.0, -0.5, 0.25, 0.0])
    heading = [np.arctan2(w.platforms[0, :, 4], w.platforms[0, :, 3]) for w in (before, after)]
    np.testing.assert_allclose(np.degrees(wrap(heading[1] - heading[0])), [10.0, -5.0], rtol=1e-9)
    np.testing.assert_allclose(after.platforms[0, :, 5], [7.5, 0.0], atol=1e-12)


def test_discrete_actions_are_three_of_every_rate():
    env = PassiveEnv("AngleFusion", actions="discrete")
    assert np.array_equal(env.action_space.nvec, [3, 3, 3, 3])
    twin = PassiveEnv("AngleFusion")
    env.reset(seed=0), twin.reset(seed=0)
    observed, expected = env.step(np.array([0, 1, 2, 1]))[0], twin.step(np.array([-1.0, 0.0, 1.0, 0.0]))[0]
    assert np.array_equal(observed, expected)


# ------------------------------------------------------------------------------------------------ scans


def sightings(episodes, steps, **fields):
    """Worlds of a flight with what the sensors sent at each of them."""
    simulation, worlds = flown(episodes, steps, **fields)
    return simulation, worlds, [world.reports.scan for world in worlds]


def test_clean_returns_are_the_true_directions_with_the_noise_of_the_tape():
    _, worlds, scans = sightings(40, 40)
    for k, (world, scan) in enumerate(zip(worlds, scans, strict=True)):
        assert scan.angles.shape == (40, 2, 1, 2)
        assert scan.valid.all()
        exact = direction(world.truth, world.platforms[..., :3])
        np.testing.assert_allclose(wrap(scan.angles[:, :, 0] - exact) / STD, world.tape.noise[:, k], atol=1e-9)
        assert np.array_equal(scan.clutter_density, np.full((40, 2), CLEAN_DENSITY))
        assert np.array_equal(world.reports.returns, np.ones((40, 2)))
    noise = worlds[0].tape.noise.reshape(-1, 2)
    assert all(kstest(noise[:, c], norm.cdf).pvalue > 1e-4 for c in range(2))
    assert abs(np.corrcoef(noise.T)[0, 1]) < 4.0 / math.sqrt(len(noise))


def test_clutter_fills_the_gates_of_the_predicted_track_evenly():
    """Squared distances in a gate that is filled evenly are uniform up to γ; counts are Poisson."""
    simulation, worlds, scans = sightings(60, 20, clutter_mean=3.0, gate=12.0)
    shares, counts = [], []
    for before, world, scan in zip(worlds, worlds[1:], scans[1:], strict=False):
        predicted = simulation.tracker.estimate(simulation.tracker.predict(before.track_state, 2.0))
        np.testing.assert_array_equal(world.reports.predicted.mean, predicted.mean)
        sought = gate(predicted.mean[:, 0], predicted.cov[:, 0], scan.platforms, scan.angle_std, 12.0)
        np.testing.assert_allclose(scan.clutter_density, 3.0 / sought.area, rtol=1e-9)
        nu = wrap(scan.angles - sought.angles[:, :, None])
        d2 = np.einsum("esbi,esij,esbj->esb", nu, np.linalg.inv(sought.cov), nu)
        exact = direction(world.truth, world.platforms[..., :3]) + STD * world.tape.noise[:, world.step[0]]
        false = scan.valid & (np.abs(wrap(scan.angles - exact[:, :, None])).max(-1) > 1e-9)
        shares.append(d2[false] / 12.0)
        counts.append(false.sum(-1))
        assert np.array_equal(scan.valid.sum(-1), false.sum(-1) + 1)
    shares, counts = np.concatenate(shares), np.array(counts)
    assert shares.max() <= 1.0 + 1e-9
    assert kstest(shares, "uniform").pvalue > 1e-4
    low, high = poisson.ppf([5e-5, 1 - 5e-5], 3.0 * counts.size) / counts.size
    assert low < counts.mean() < high
    assert (scans[0].valid.sum(-1) == 1).all()  # the acquisition sees nothing false


def test_the_targets_return_may_stand_in_any_slot():
    _, worlds, scans = sightings(80, 10, clutter_mean=2.0)
    ranks = []
    for k, (world, scan) in enumerate(zip(worlds[1:], scans[1:], strict=True), start=1):
        exact = direction(world.truth, world.platforms[..., :3]) + STD * world.tape.noise[:, k]
        slot = np.abs(wrap(scan.angles - exact[:, :, None])).max(-1).argmin(-1)
        two = scan.valid.sum(-1) == 2
        ranks.extend(slot[two])
    low, high = share_band(0.5, len(ranks))
    assert len(ranks) > 200
    assert low < np.mean(ranks) < high


def test_fixed_density_fills_a_window_about_the_target():
    fields = {"clutter_density_per_deg2": 0.05, "clutter_window_deg": 6.0}
    _, worlds, scans = sightings(60, 20, **fields)
    offsets = []
    for k, (world, scan) in enumerate(zip(worlds[1:], scans[1:], strict=True), start=1):
        np.testing.assert_allclose(scan.clutter_density, 0.05 / math.radians(1.0) ** 2, rtol=1e-9)
        exact = direction(world.truth, world.platforms[..., :3])
        off = wrap(scan.angles - exact[:, :, None])
        own = np.abs(off - STD * world.tape.noise[:, k, :, None]).max(-1) < 1e-9
        offsets.append(np.degrees(off[scan.valid & ~own]))
    offsets = np.concatenate(offsets)
    assert all(kstest(offsets[:, c], "uniform", args=(-6.0, 12.0)).pvalue > 1e-4 for c in range(2))
    low, high = poisson.ppf([5e-5, 1 - 5e-5], 0.05 * 144.0 * 60 * 20 * 2)
    assert low < len(offsets) < high


def test_unknown_density_is_not_told():
    _, _, scans = sightings(3, 2, clutter_mean=3.0, clutter_known=False)
    assert all(np.array_equal(scan.clutter_density, np.zeros((3, 2))) for scan in scans)


def test_availability_is_drawn_per_episode_and_platform_and_sets_the_dropouts():
    fields = {"availability0_min": 0.3, "availability1_min": 0.8, "availability1_max": 0.8}
    _, world = begin(500, **fields)
    share, available = world.tape.share, world.tape.available
    assert kstest(share[:, 0], "uniform", args=(0.3, 0.7)).pvalue > 1e-4
    assert np.array_equal(share[:, 1], np.full(500, 0.8))
    assert available[:, 0].all()
    low, high = share_band(0.8, 500 * 40)
    assert low < available[:, 1:, 1].mean() < high
    spread = (available[:, 1:, 0].mean(1) - share[:, 0]) / np.sqrt(share[:, 0] * (1.0 - share[:, 0]) / 40.0 + 1e-12)
    assert abs(spread.mean()) < 4.0 / math.sqrt(500)
    assert 0.8 < spread.std() < 1.2


def test_a_sensor_that_is_not_available_sends_nothing_and_the_belief_says_so():
    simulation, worlds = flown(30, 10, **ROUGH)
    gone = 0
    for k, world in enumerate(worlds):
        silent = ~world.tape.available[:, k]
        belief = simulation.belief(world)
        assert not world.reports.scan.valid[silent].any()
        assert np.array_equal(belief.available, np.repeat(~silent[..., None], 2, axis=-1))
        np.testing.assert_allclose(belief.missed[:, 0][silent], 1.0, rtol=1e-12)
        assert (belief.returns[silent] == 0).all()
        assert not belief.assigned[:, 0][silent].any()
        gone += silent.sum()
    assert gone > 50


def test_targets_are_missed_as_often_as_the_detection_probability_says():
    _, _, scans = sightings(100, 20, detection_probability=0.7)
    seen = np.mean([scan.valid for scan in scans[1:]])
    low, high = share_band(0.7, 100 * 20 * 2)
    assert low < seen < high
    assert scans[0].valid.all()


def test_more_returns_than_the_tracker_weighs_are_counted():
    """Gates of sensors this coarse hold the whole window and its 71 false returns."""
    fields = {"clutter_density_per_deg2": 1.0, "clutter_window_deg": 4.2}
    env = PassiveEnv("AngleFusion", azimuth_std_deg=3.0, elevation_std_deg=3.0, **fields)
    dropped, inside = [], []
    for seed in range(6):
        _, info = env.reset(seed=seed)
        assert np.array_equal(info["dropped_returns"], [0])
        for _ in range(3):
            *_, info = env.step(np.zeros(4))
            dropped.append(int(info["dropped_returns"][0]))
            returns = env.world.reports.returns[0]
            inside.append(int(np.maximum(returns - MAX_RETURNS, 0).sum()))
    assert dropped == inside
    assert max(dropped) > 0


# ------------------------------------------------------------------------------------------------ trackers


def test_without_clutter_the_pdaf_is_the_ekf():
    commands = [0.4, -0.4, 0.1, 0.0]
    errors = []
    for tracker in ("angle_pdaf", "angle_ekf"):
        _, worlds = flown(50, 40, commands, course="paper", tracker=tracker)
        errors.append(np.array([world.metrics.position_error_m for world in worlds]))
    typical = np.abs(errors[0] - errors[1]) / errors[1]
    assert np.median(typical) < 1e-6  # returns outside the gate, 3 in 10,000, part them


@pytest.mark.parametrize("name", ANGLE_TRACKERS)
def test_every_tracker_by_name_flies(name):
    _, worlds = flown(4, 5, tracker=name, clutter_mean=2.0, availability1_min=0.5)
    assert np.isfinite(worlds[-1].metrics.position_error_m).all()


def test_settings_reach_the_tracker():
    fields = {"process_noise_m_s2": 12.0, "gate": 9.0, "fused_gate": 13.0, "detection_probability": 0.8}
    fields |= {"clutter_known": False, "outlier_test": "coplanarity", "reinitiate": True}
    fields |= {"second_order": False, "range_floor_m": 7e3, "range_cap_m": 70e3}
    assert make_scenario("AngleFusion", fields).make_tracker() == AnglePdaf(
        process_noise=12.0, gate=9.0, fused_gate=13.0, detection_probability=0.8, clutter_known=False,
        outlier_test="coplanarity", second_order=False, reinitiate=True, floor_m=7e3, cap_m=70e3,
    )  # fmt: skip
    assert make_scenario("AngleFusion", {}).make_tracker() == AnglePdaf(second_order=True, floor_m=10e3, cap_m=100e3)


def test_a_users_tracker_is_taken_as_it_is():
    own = AngleEkf(process_noise=5.0, second_order=True, floor_m=10e3, cap_m=100e3)
    _, worlds = flown(3, 3, [0.0] * 4, tracker=own)
    _, named = flown(3, 3, [0.0] * 4, tracker="angle_ekf", process_noise_m_s2=5.0)
    assert np.array_equal(worlds[-1].estimate.mean, named[-1].estimate.mean)


@pytest.mark.parametrize("fields", [{"clutter_mean": 5.0}, {"clutter_density_per_deg2": 0.05}], ids=str)
@pytest.mark.parametrize("spoil", SPOILT.values(), ids=SPOILT)
def test_what_a_tracker_loses_later_does_not_leave_the_environment(spoil, fields):
    """Observation, reward, scan and all of info stay finite, with every reward term in use."""
    weights = {f.name: 1.0 for f in dataclasses.fields(AngleFusion) if f.name.startswith("reward_")}
    tracker = spoilt_later(AnglePdaf, spoil)
    env = PassiveVectorEnv("AngleFusion", num_envs=3, threads=1, tracker=tracker, steps=8, **fields, **weights)
    env.reset(seed=0)
    with np.errstate(all="ignore"):
        for _ in range(8):
            observation, reward, _, _, info = env.step(np.full((3, 4), 0.3))
            assert observation in env.observation_space
            assert np.isfinite(reward).all()
            assert all(np.isfinite(part).all() for name, part in info.items() if name != "reward_terms")
            assert all(np.isfinite(part).all() for part in env.world.reports.scan)
    assert tracker.asked == 17


def test_platforms_and_target_in_one_line_start_with_the_prior_of_range():
    """In trail towards the target no two lines of sight cross: the start says so and nothing breaks."""
    simulation, _ = begin(1)
    draw = simulation.scenario.draw_tape

    def in_line(generators):
        tape = draw(generators)
        targets = tape.targets.copy()
        targets[..., :2], targets[..., 3:] = (30e3, 0.0), 0.0
        platforms = tape.platforms.copy()
        platforms[:, :, :3] = [[0.0, 0.0, 6000.0], [-5000.0, 0.0, 6000.0]]
        platforms[..., 3:] = (150.0, 0.0, 0.0)
        targets[..., 2] = 6000.0
        return tape._replace(platforms=platforms, targets=targets, noise=np.zeros_like(tape.noise))

    object.__setattr__(simulation.scenario, "draw_tape", in_line)
    world = simulation.begin([np.random.default_rng(0)])
    assert math.sqrt(world.estimate.cov[0, 0, 0, 0]) > 10e3
    for _ in range(40):
        world, reward, _ = simulation.advance(world, np.zeros((1, 4)))
        assert np.isfinite(simulation.observe(world)).all()
        assert np.isfinite(reward).all()
        assert all(np.isfinite(figure).all() for figure in world.metrics)


def straight_nees(**fields):
    """NEES [k + 1, e] of 2,048 random courses flown straight."""
    env = PassiveVectorEnv("AngleFusion", 2048, "disabled", threads=1, **fields)
    _, info = env.reset(seed=300_000)
    nees = [info["nees"][:, 0]]
    for _ in range(env.scenario.steps):
        nees.append(env.step(np.zeros((2048, 4)))[4]["nees"][:, 0])
    return np.array(nees)


def test_tracks_are_honest_from_the_first_scan_on():
    """Random courses, some of them nearly in line with both platforms: at any step no more tracks than chance allows
    lie beyond the 99 % and the 99.99 % of an honest tracker, and their mean NEES is no larger than honest. (It is
    smaller: targets fly slower than the velocity prior admits, and without the process noise it provides for.)"""
    nees = straight_nees()
    for level in (0.99, 0.9999):
        beyond = (nees > chi2.ppf(level, 6)).sum(axis=1)
        assert (beyond <= binom.ppf(1 - 1e-5, 2048, 1 - level)).all()
    assert nees.mean(axis=1).max() < chi2.ppf(1 - 1e-5, 6 * 2048) / 2048


def test_without_the_curvature_some_tracks_collapse_while_range_is_poorly_known():
    """The contrast to the test above, and why `second_order` is this environment's default."""
    assert straight_nees(second_order=False).max() > 1e3 > straight_nees().max()


# ------------------------------------------------------------------------------------------------ figures of merit


def test_the_paper_layouts_bound_is_the_specifications():
    """Range bound from platform 0 at steps 1, 5, 10, 20, 30, 40: 1305, 963, 769, 471, 204, 67 m, within 3 %."""
    simulation, world = begin(1, course="paper", max_turn_rate_deg_s=22.5)
    bound = [world.metrics.range_crlb_m[0, 0]]
    for k in range(40):
        command = np.array([[1.0 if k == 20 else 0.0, 0.0, 0.0, 0.0]])  # 45° to the north in one step
        world, *_ = simulation.advance(world, command)
        bound.append(world.metrics.range_crlb_m[0, 0])
    np.testing.assert_allclose([bound[k] for k in (1, 5, 10, 20, 30, 40)], [1305, 963, 769, 471, 204, 67], rtol=0.03)


def test_the_bound_is_the_information_recursion_with_the_episodes_availability():
    fields = {"availability0_min": 0.4, "availability1_min": 0.4, "detection_probability": 0.9}
    _, worlds = flown(3, 12, azimuth_std_deg=0.3, elevation_std_deg=0.8, **fields)
    std = np.tile(np.radians([0.3, 0.8]), (2, 1))
    for e in range(3):
        truth = np.array([world.truth[e, 0] for world in worlds])
        platforms = np.array([world.platforms[e, :, :3] for world in worlds])
        prior = bound_start(truth[0], platforms[0], std, (200.0, 200.0, 50.0))
        share = np.repeat(0.9 * worlds[0].tape.share[e][:, None], 2, axis=1)
        covs = posterior_bound_information_3d(truth, platforms, prior, std, 2.0, 30.0, share)
        shown = np.array([world.metrics.range_crlb_m[e, 0] for world in worlds])
        np.testing.assert_allclose(shown, range_std_3d(covs, truth, platforms[:, 0]), rtol=1e-6)
        position = np.array([world.metrics.position_crlb_m[e, 0] for world in worlds])
        np.testing.assert_allclose(position, position_std_3d(covs), rtol=1e-6)


def test_figures_of_merit_and_reward_by_hand():
    weights = {f"reward_{name}": 0.1 * (i + 1) for i, name in enumerate(
        ("log_range_error", "relative_range_error", "log_position_error", "relative_position_error", "position_error",
         "final_position_error", "log_range_bound", "log_position_bound", "information_gain", "maneuver", "standoff",
         "lost_track")
    )}  # fmt: skip
    env = PassiveEnv("AngleFusion", steps=4, lost_error_m=300.0, lost_nees=1.0, standoff_m=11e3, **weights)
    _, info = env.reset(seed=4)
    world = env.world._replace(platforms=env.world.platforms.copy())
    world.platforms[0, 1, :3] = world.truth[0, 0, :3] + [6e3, 2e3, 1e3]  # inside the stand-off sphere
    env._world = world
    for _ in range(4):
        previous = info["range_crlb_m"]
        action = np.array([0.5, -1.0, 0.2, 0.0])
        _, reward, _, truncated, info = env.step(action)
        world = env.world
        (mean,), (cov,), (truth,) = world.estimate.mean[0], world.estimate.cov[0], world.truth[0]
        reference = world.platforms[0, 0, :3]
        true_range = np.linalg.norm(truth[:3] - reference)
        position_error = np.linalg.norm(mean[:3] - truth[:3])
        range_error = abs(np.linalg.norm(mean[:3] - reference) - true_range)
        gaps = np.linalg.norm(world.platforms[0, :, :3] - truth[:3], axis=-1)
        nees = (mean - truth) @ np.linalg.solve(cov, mean - truth)
        lost = position_error > 300.0 and nees > 1.0
        for name, value in (
            ("range_m", true_range), ("range_error_m", range_error), ("position_error_m", position_error),
            ("nees", nees), ("lost", lost),
        ):  # fmt: skip
            assert info[name] == pytest.approx(np.array([value]), rel=1e-6), name
        depth = np.maximum(0.0, 1.0 - gaps / 11e3).sum()
        assert info["standoff_violation"] == pytest.approx(depth)
        assert depth > 0.0
        expected = {
            "log_range_error": -math.log(max(range_error, 30.0) / 1e3),
            "relative_range_error": -range_error / true_range,
            "log_position_error": -math.log(max(position_error, 30.0) / 1e3),
            "relative_position_error": -position_error / true_range,
            "position_error": -position_error / 1e3,
            "final_position_error": -position_error / 1e3 * truncated,
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


# ------------------------------------------------------------------------------------------------ belief, observation


@pytest.mark.parametrize("fields", [{}, ROUGH, {"clutter_density_per_deg2": 0.02}], ids=str)
def test_observations_do_not_change_when_the_truth_behind_the_same_returns_does(monkeypatch, fields):
    scenario = make_scenario("AngleFusion", {"steps": 12, **fields})
    first, second = fly_twins(monkeypatch, scenario, random_decisions(3), range(4))
    np.testing.assert_allclose(second.truth[9] - first.truth[9], np.broadcast_to(shift(6), (4, 1, 6)), atol=1e-6)
    assert len(SHIFT) == 4
    assert_twins_look_alike(first, second)


def test_belief_and_observation_read_nothing_of_the_truth():
    simulation, worlds = flown(4, 3, **ROUGH)
    world = worlds[-1]
    assert_blind_to_truth(simulation, world)


def test_worlds_are_never_changed_in_place():
    simulation, world = begin(3, **ROUGH)
    kept = map_rows(np.copy, world)
    for _ in range(3):
        simulation.advance(world, np.full((3, 4), 0.5))
    map_rows(np.testing.assert_array_equal, world, kept)


def field_values(env, observation):
    return {field.name: float(value) for field, value in zip(env.observation_fields, observation, strict=True)}


def test_observed_fields_by_hand():
    env = PassiveEnv("AngleFusionClutter")
    env.reset(seed=2)
    for _ in range(7):
        observation, *_ = env.step(np.array([0.5, -0.25, 1.0, 0.0]))
    seen, belief = field_values(env, observation), env.belief()
    platforms, mean, cov = belief.platforms[0], belief.mean[0, 0], belief.cov[0, 0]
    middle = mean[:2] - platforms[:, :2].mean(0)
    psi = math.atan2(middle[1], middle[0])
    turn = np.array([[math.cos(psi), math.sin(psi)], [-math.sin(psi), math.cos(psi)]])
    gap = turn @ (platforms[1, :2] - platforms[0, :2])
    sight = mean[:3] - platforms[0, :3]
    other = mean[:3] - platforms[1, :3]
    level, azimuth = math.hypot(*sight[:2]), math.atan2(sight[1], sight[0])
    radial = sight / np.linalg.norm(sight)
    cross = np.array([-math.sin(azimuth), math.cos(azimuth), 0.0])
    up = np.cross(radial, cross)
    frame = np.kron(np.eye(2), np.array([radial, cross, up]))
    C = frame @ cov @ frame.T
    std = np.sqrt(np.diag(C))
    headings = (turn @ platforms[:, 3:5].T).T / 150.0
    crossing = math.atan2(other[1], other[0]) - azimuth
    expected = {
        "time_left": 33 / 40, "last_action0": 0.5, "last_action1": -0.25, "last_action2": 1.0, "last_action3": 0.0,
        "platform1.along": gap[0] / 1e4, "platform1.across": gap[1] / 1e4,
        "platform1.above": (platforms[1, 2] - platforms[0, 2]) / 2e3,
        "platform0.heading_cos": headings[0, 0], "platform1.heading_sin": headings[1, 1],
        "track0.log_range": math.log(np.linalg.norm(sight) / 2e4), "track0.bearing_cos": math.cos(azimuth - psi),
        "track0.bearing_sin": math.sin(azimuth - psi), "track0.above": sight[2] / 5e3,
        "track0.radial_velocity": mean[3:5] @ sight[:2] / level / 300.0,
        "track0.cross_velocity": mean[3:5] @ cross[:2] / 300.0, "track0.climb": mean[5] / 50.0,
        "track0.log_range1": math.log(np.linalg.norm(other) / 2e4),
        "track0.crossing_cos1": math.cos(crossing), "track0.crossing_sin1": math.sin(crossing),
        "track0.log_std_radial": math.log(std[0] / 1e3) / 2.0, "track0.log_std_up": math.log(std[2] / 1e3) / 2.0,
        "track0.log_std_cross_velocity": math.log(std[4] / 50.0) / 2.0,
        "track0.corr_radial_cross": C[0, 1] / (std[0] * std[1]),
        "track0.corr_radial_radial_velocity": C[0, 3] / (std[0] * std[3]),
        "track0.corr_cross_up_velocity": C[1, 5] / (std[1] * std[5]),
        "track0.corr_cross_velocity_up_velocity": C[4, 5] / (std[4] * std[5]),
        "platform0.returns": belief.returns[0, 0] / 10.0, "platform1.missed": belief.missed[0, 0, 1],
        "platform1.available": float(belief.available[0, 1].all()),
    }  # fmt: skip
    for name, value in expected.items():
        assert seen[name] == pytest.approx(np.clip(value, -5.0, 5.0), abs=2e-6, rel=1e-5), name


MIRROR = np.array([1.0, -1.0, 1.0, 1.0, -1.0, 1.0])


def mirrored_tape(tape):
    points = tape.false_points.copy()
    points[..., 1] = (0.5 - points[..., 1]) % 1.0
    return tape._replace(
        platforms=tape.platforms * MIRROR, targets=tape.targets * MIRROR, noise=tape.noise * [-1.0, 1.0],
        false_points=points,
    )  # fmt: skip


@pytest.mark.parametrize("fields", [{}, ROUGH], ids=str)
def test_a_mirrored_world_shows_the_mirrored_observation_and_earns_the_same(monkeypatch, fields):
    scenario = make_scenario("AngleFusion", {"steps": 12, **fields})
    commands = np.random.default_rng(1).uniform(-1.0, 1.0, (12, 6, 4))

    def fly(flown_commands):
        simulation = Simulation(scenario)
        world = simulation.begin([np.random.default_rng(seed) for seed in range(6)])
        observations, rewards = [simulation.observe(world)], []
        for command in flown_commands:
            world, reward, _ = simulation.advance(world, command)
            observations.append(simulation.observe(world))
            rewards.append(reward)
        return np.array(observations), np.array(rewards)

    observations, rewards = fly(commands)
    draw = AngleFusion.draw_tape
    monkeypatch.setattr(AngleFusion, "draw_tape", lambda self, generators: mirrored_tape(draw(self, generators)))
    images, same = fly(scenario.make_actions().mirrored(commands))
    expected = scenario.make_observation().mirrored(observations)
    assert not np.allclose(observations, expected, atol=0.1)
    np.testing.assert_allclose(images, expected, atol=1e-4)
    np.testing.assert_allclose(same, rewards, atol=1e-5)


def test_mirrored_commands_turn_the_other_way_and_climb_alike():
    actions = make_scenario("AngleFusion", {}).make_actions()
    assert np.array_equal(actions.mirrored(np.array([0.1, 0.2, 0.3, 0.4])), [-0.1, -0.2, 0.3, 0.4])
    assert np.array_equal(make_scenario("TwoStation", {}).make_actions().mirrored(np.array([0.1, 0.2])), [-0.1, -0.2])


# ------------------------------------------------------------------------------------------------ batches, policies


@pytest.mark.parametrize("fields", [ROUGH, {"clutter_density_per_deg2": 0.02}, {"course": "flights"}], ids=str)
def test_sub_environments_are_single_environments_whatever_the_width(fields):
    wide = PassiveVectorEnv("AngleFusion", num_envs=300, threads=2, **fields)
    actions = np.random.default_rng(0).uniform(-1.0, 1.0, (6, 300, 4)).astype(np.float32)
    observation, _ = wide.reset(seed=50)
    singles = {row: PassiveEnv("AngleFusion", **fields) for row in (0, 149, 150, 299)}
    for row, single in singles.items():
        assert np.array_equal(single.reset(seed=50 + row)[0], observation[row])
    for action in actions:
        observation, reward, _, _, info = wide.step(action)
        for row, single in singles.items():
            own = single.step(action[row])
            assert np.array_equal(own[0], observation[row])
            assert own[1] == reward[row]
            for name in ("position_error_m", "position_crlb_m", "dropped_returns", "nees"):
                assert np.array_equal(own[4][name], info[name][row]), name


@pytest.mark.parametrize("name", IDS)
def test_policies_that_look_at_nothing_fly(name):
    scenario = make_scenario(name, {"steps": 6})
    for policy in ("straight", "random"):
        record = fly_policy(scenario, make_policy(policy, scenario), 12, seed=0)
        assert record.state_size == 6
        assert record.turns.shape == (12, 6, 2)
        assert np.isfinite(record.range_error_m).all()
        assert np.any(record.turns) == (policy == "random")


# ------------------------------------------------------------------------------------------------ pictures


def picture(env) -> np.ndarray:
    drawn = env.render()
    assert drawn is not None
    return drawn


def picture_env(name="AngleFusionClutter", steps=0, **fields):
    env = PassiveEnv(name, render_mode="rgb_array", **fields)
    env.reset(seed=3)
    for _ in range(steps):
        env.step(np.array([0.6, -0.6, 0.5, 0.0]))
    return env


@pytest.mark.parametrize("steps", [0, 1, 12])
@pytest.mark.parametrize("name", IDS)
def test_pictures_render_at_any_step(name, steps):
    env = picture_env(name, steps)
    drawn = picture(env)
    assert drawn.shape == (800, 800, 3)
    assert drawn.dtype == np.uint8
    assert 0.5 < (drawn == 255).all(-1).mean() < 0.99
    assert np.array_equal(picture(env), drawn)
    env.step(np.zeros(4))
    assert not np.array_equal(picture(env), drawn)


def test_a_diverged_track_still_gives_a_picture():
    env = picture_env(steps=3)
    world = env.world
    lost = map_rows(lambda a: np.full_like(a, np.nan), world.estimate)
    predicted = map_rows(lambda a: np.full_like(a, np.nan), world.reports.predicted)
    env._world = world._replace(estimate=lost, reports=world.reports._replace(predicted=predicted))
    assert picture(env).shape == (800, 800, 3)


def scene_after(steps, **fields):
    """The scene of a flight's last world, and that world."""
    simulation, worlds = flown(1, steps, [0.6, -0.6, 0.0, 0.0], **fields)
    figure = Figure()
    FigureCanvasAgg(figure)
    scene = AngleScene(figure, simulation.scenario)
    trails = np.stack([world.platforms[0, :, :3] for world in worlds], axis=1)
    scene.update(worlds[-1], trails, Frame(np.full(2, -50.0), np.full(2, 50.0)), simulation)
    return scene, worlds[-1]


def test_pictures_head_panels_with_what_was_received():
    heads = [panel._head.get_text() for panel in scene_after(0)[0]._panels]
    assert heads == ["P0: 1 return, missed 0.00", "P1: 1 return, missed 0.00"]
    scene, world = scene_after(3, clutter_mean=8.0, availability1_min=0.0, availability1_max=0.0)
    count, missed = world.reports.scan.valid[0, 0].sum(), world.reports.missed[0, 0, 0]
    heads = [panel._head.get_text() for panel in scene._panels]
    assert heads == [f"P0: {count} returns, missed {missed:.2f}", "P1: nothing received"]


def test_the_side_view_holds_platforms_target_and_the_estimates_ellipse():
    scene, world = scene_after(1)
    low, high = scene._side.axes.get_ylim()
    vertices = scene._side._ellipse.get_paths()[0].vertices[:, 1]
    assert low <= vertices.min()
    assert vertices.max() <= high
    for height_m in (*world.platforms[0, :, 2], world.truth[0, 0, 2]):
        assert low < 1e-3 * height_m < high


def test_weights_in_the_picture_are_the_trackers():
    """What the sensors' weights lack of 1 is the tracker's own weight of a miss, computed by its kernel."""
    simulation, worlds = flown(12, 8, clutter_mean=5.0, detection_probability=0.8, availability1_min=0.6)
    seen = 0
    for world in worlds[1:]:
        for e in range(12):
            row = map_rows(lambda a, e=e: a[e : e + 1], world)
            look = look_of(row, simulation)
            heard = world.reports.available[e].all(-1)
            np.testing.assert_allclose(1.0 - look.weights.sum(-1)[heard], world.reports.missed[e, 0][heard], atol=1e-6)
            for s in np.flatnonzero(heard & (world.reports.slots[e, 0] >= 0)):
                assert look.weights[s].argmax() == world.reports.slots[e, 0, s]
                seen += 1
    assert seen > 100


# ------------------------------------------------------------------------------------------------ bad input


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"clutter_mean": 12.5}, r"clutter_mean = 12.5: must lie in \[0.0, 12.0\]"),
        ({"clutter_mean": -1.0}, "clutter_mean"),
        ({"clutter_density_per_deg2": 0.9}, "clutter_density_per_deg2 = 0.9: 360 false returns .* in a window of 20"),
        ({"clutter_mean": 1.0, "clutter_density_per_deg2": 0.1}, "choose it or clutter_mean"),
        ({"availability0_min": -0.1}, r"availability0_min = -0.1: must lie in \[0.0, 1.0\]"),
        ({"availability1_max": 1.1}, r"availability1_max = 1.1: must lie in \[0.0, 1.0\]"),
        ({"availability1_min": math.nan}, "availability1_min"),
        ({"availability0_min": 0.9, "availability0_max": 0.5}, "must not exceed availability0_max"),
        ({"standoff_m": 12e3}, r"standoff_m = 12000.0: range_min_m − baseline_max_m lets platforms start 11000 m"),
        ({"range_min_m": 14e3}, "standoff_m = 6000.0: .* start 5000 m from the target"),
        ({"course": "paper", "standoff_m": 31e3}, "standoff_m = 31000.0: course='paper' starts 30"),
        ({"baseline_min_m": 9.5e3}, "must not exceed baseline_max_m"),
        ({"altitude_floor_m": 5.5e3}, "must not exceed platform_altitude_min_m"),
        ({"altitude_ceiling_m": 7e3}, "must not exceed altitude_ceiling_m"),
        ({"range_floor_m": 2e5}, "range_floor_m = 200000.0: must lie below range_cap_m = 100000.0"),
        ({"range_floor_m": 1e5}, "range_floor_m = 100000.0: must lie below range_cap_m"),
        ({"detection_probability": 0.0}, "detection_probability"),
        ({"tracker": "rp_ekf"}, "tracker = 'rp_ekf': must be one of 'angle_ekf'"),
        ({"tracker": "angle_pdaf_sequential", "outlier_test": "conditioned"}, "outlier_test"),
        ({"outlier_test": "chi2"}, "must be one of 'off', 'conditioned', 'coplanarity'"),
        ({"course": "paper_bestfit"}, "must be one of 'random', 'flights', 'paper'"),
        ({"formation": "line"}, "must be one of 'random', 'abreast', 'trail'"),
        ({"flights": "x.csv"}, "add course='flights'"),
        ({"gate": 0.0}, "gate"),
        ({"max_climb_m_s": math.inf}, "max_climb_m_s"),
    ],
    ids=str,
)
def test_bad_values_are_errors_that_name_field_value_and_what_is_right(fields, message):
    with pytest.raises(ValueError, match=message):
        make_scenario("AngleFusion", fields)


def test_a_tracker_of_another_family_or_without_verbs_is_refused():
    with pytest.raises(TypeError, match="has no initiate"):
        make_scenario("AngleFusion", {"tracker": object()})
    with pytest.raises(TypeError, match="is the class AnglePdaf"):
        make_scenario("AngleFusion", {"tracker": AnglePdaf})


def test_bad_actions_are_errors():
    env = gym.make("passive/AngleFusion-v0").unwrapped
    env.reset(seed=0)
    for action in (np.zeros(2), np.full(4, np.nan), None):
        with pytest.raises(ValueError, match="action"):
            env.step(action)


def test_every_field_has_a_rule():
    assert all(f.metadata.get("doc") for f in dataclasses.fields(AngleFusion))
