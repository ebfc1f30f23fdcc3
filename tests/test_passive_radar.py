"""A passive radar: pool and corridors, blockage, choices, range sums, bound, observation, pictures, bad input."""

import dataclasses
import itertools
import math

import numpy as np
import pytest
from scipy.stats import binom, kstest, norm

from agents.comparison import summarize
from agents.evaluation import fly
from agents.policy import make_policy
from agents.report import as_markdown, write_evaluation
from passive_env import PassiveEnv, PassiveVectorEnv
from passive_env.actions import LEADS_DEG, Combinations
from passive_env.blockage import Stretches, blocked, blocked_next
from passive_env.catalogue import make_scenario
from passive_env.catalogue.passive_radar import PassiveRadar
from passive_env.core import map_rows
from passive_env.kinematics import plan_view
from passive_env.radar_sensors import NEVER_S
from passive_env.radar_sites import PAPER_SITES_M
from passive_env.render_radar import sum_ellipse
from passive_env.steering import lead_pursuit
from trackers import RangeSumEkf, RangeSumEkfLiteral
from trackers.angles import wrap
from trackers.axis_motion import axis_noise, axis_transition
from trackers.gaussian import Gaussian
from trackers.range_sum import range_sum, range_sum_jacobian

NAME = "PassiveRadar"
CLEAN = {"echo_probability": 1.0, "blocked_min_s": 0.0, "blocked_max_s": 0.0}
MOBILE = {"receiver_speed_m_s": 200.0, "std_range_m": 50e3}
ROUGH = {"retune_delay_s": 2.0, "maneuvers": True, **MOBILE}


def begin(episodes, **fields):
    """A scenario's simulation and the world of its first instant."""
    simulation = make_scenario(NAME, fields).make_simulation()
    return simulation, simulation.begin([np.random.default_rng(seed) for seed in range(episodes)])


def flown(episodes, steps, decide=None, seed=0, **fields):
    """All worlds of a flight under random commands, or those that `decide` makes of a belief."""
    simulation, world = begin(episodes, **fields)
    rng, worlds = np.random.default_rng(seed), [world]
    for _ in range(steps):
        drawn = rng.uniform(-1.0, 1.0, (episodes, simulation.actions.size))
        command = drawn if decide is None else decide(simulation.belief(worlds[-1]))
        worlds.append(simulation.advance(worlds[-1], command)[0])
    return simulation, worlds


def asking(*transmitters, n=8, episodes=1):
    """Commands that choose these transmitters."""
    scores = np.full((episodes, n), -1.0)
    scores[:, list(transmitters)] = 1.0
    return scores


def share_band(probability, n):
    """Share of n draws that leaves this band once in 10,000 times."""
    return binom.ppf([5e-5, 1 - 5e-5], n, probability) / n


# ------------------------------------------------------------------------------------------------ pool and corridors


def test_defaults_are_those_of_the_problem():
    s = make_scenario(NAME, {})
    assert (s.dimensions, s.pool, s.listened, s.step_s, s.steps) == (2, 8, 2, 1.0, 300)
    assert (s.range_sum_std_m, s.echo_probability, s.blocked_min_s, s.blocked_max_s) == (200.0, 0.8, 30.0, 60.0)
    assert (s.process_noise, s.retune_delay_s, s.moves) == ((1.0, 1.0, 0.1**2), 0.0, False)
    assert make_scenario(NAME, {"dimensions": 3}).listened == 3
    assert make_scenario("PassiveRadarRetune", {}).retune_delay_s == 5.0
    mobile = make_scenario("MobileReceiver", {})
    assert (mobile.moves, mobile.receiver_speed_m_s, mobile.actions) == (True, 200.0, "headings")
    assert mobile.std_range_m > 0.0


@pytest.mark.parametrize("dimensions", [2, 3])
def test_drawn_pools_and_corridors_fill_their_limits(dimensions):
    _, world = begin(500, dimensions=dimensions)
    start, sites = plan_view(world.tape.acquisition.targets[:, 0, 0]), world.tape.transmitters
    course = np.arctan2(start[:, 3], start[:, 2])
    along, left = np.stack([np.cos(course), np.sin(course)], 1), np.stack([-np.sin(course), np.cos(course)], 1)
    aside = (start[:, :2] * left).sum(1)
    for values, low, high in (
        (course, -math.pi, math.pi),
        (np.abs(aside), 5e3, 60e3),
        (-(start[:, :2] * along).sum(1), 0.0, 60e3),
        (np.hypot(start[:, 2], start[:, 3]), 150.0, 250.0),
        (np.arctan2(sites[:, 3, 1], sites[:, 3, 0]), -math.pi, math.pi),
        (np.hypot(sites[..., 0], sites[..., 1]).ravel(), 20e3, 100e3),
    ):
        assert kstest(values, "uniform", args=(low, high - low)).pvalue > 1e-4
    low, high = share_band(0.5, 500)
    assert low < (aside > 0.0).mean() < high
    if dimensions == 3:
        height = world.tape.acquisition.targets[:, 0, 0, 2]
        assert kstest(height, "uniform", args=(5e3, 7e3)).pvalue > 1e-4
        assert kstest(sites[..., 2].ravel(), "uniform", args=(0.0, 300.0)).pvalue > 1e-4
    assert not world.platforms.any()


@pytest.mark.parametrize("dimensions", [2, 3])
def test_targets_drift_by_the_white_acceleration_that_the_tracker_expects(dimensions):
    _, world = begin(60, dimensions=dimensions)
    path, T, d = world.tape.targets[:, :, 0], 1.0, dimensions
    push = np.diff(path[..., d:], axis=1)
    moved = path[:, :-1, d:] * T + 0.5 * T * push
    np.testing.assert_allclose(np.diff(path[..., :d], axis=1), moved, atol=1e-6)
    std = np.sqrt(make_scenario(NAME, {}).process_noise[:d])
    assert kstest((push / std).ravel(), norm.cdf).pvalue > 1e-4


def test_the_acquisition_leads_up_to_the_first_decision():
    _, world = begin(4, acquisition_scans=6)
    early = world.tape.acquisition
    for name in ("targets", "noise", "heard", "blocked"):
        assert getattr(early, name).shape[1] == 6
        assert np.array_equal(getattr(early, name)[:, -1], getattr(world.tape, name)[:, 0]), name
    gap = early.targets[:, 1:, 0, :2] - early.targets[:, :-1, 0, :2]
    np.testing.assert_allclose(gap, early.targets[:, :-1, 0, 2:], atol=3.0)


def test_guesses_are_off_by_the_stated_deviations():
    for dimensions, std in ((2, [5e3] * 2 + [200.0] * 2), (3, [5e3, 5e3, 3e3, 200.0, 200.0, 10.0])):
        _, world = begin(400, dimensions=dimensions)
        off = (world.tape.guess - world.tape.acquisition.targets[:, 0, 0]) / std
        assert kstest(off.ravel(), norm.cdf).pvalue > 1e-4


def test_maneuvering_targets_turn_and_the_tape_tells_their_accelerations():
    _, world = begin(60, maneuvers=True, process_noise_m_s2=0.0)
    path, a = world.tape.targets[:, :, 0], world.tape.accelerations[:, :, 0]
    size = np.hypot(a[..., 0], a[..., 1])
    assert 0.05 < (size > 0.0).mean() < 0.5
    assert size.max() < 30.0 + 1e-9
    gained = np.linalg.norm(np.diff(path[..., 2:], axis=1), axis=-1)
    during = (size[:, :-1] > 0.0) & np.isclose(size[:, :-1], size[:, 1:])
    np.testing.assert_allclose(gained[during], size[:, :-1][during], rtol=1e-3)
    quiet = (size[:, :-1] == 0.0) & (size[:, 1:] == 0.0)
    assert (gained[quiet] < 1e-6).mean() > 0.99  # a change of speed may last for less than a step
    straight = begin(3)[1].tape.accelerations
    assert not straight.any()


def test_recorded_flights_enter_the_corridor_and_keep_their_shape():
    scenario = make_scenario(NAME, {"course": "flights", "steps": 40})
    recorded = scenario.flight_paths.states
    tape = scenario.draw_tape([np.random.default_rng(seed) for seed in range(5)])
    drawn = make_scenario(NAME, {"steps": 40}).draw_tape([np.random.default_rng(seed) for seed in range(5)])
    start, other = tape.acquisition.targets[:, 0, 0], drawn.acquisition.targets[:, 0, 0]
    np.testing.assert_allclose(start[:, :2], other[:, :2])
    np.testing.assert_allclose(wrap(np.arctan2(*start[:, :1:-1].T) - np.arctan2(*other[:, :1:-1].T)), 0.0, atol=1e-9)
    for path in np.concatenate([tape.acquisition.targets[:, :-1, 0], tape.targets[:, :, 0]], axis=1):
        speed = np.hypot(*path[:, 2:].T)
        at = [i for i in np.flatnonzero(np.isclose(np.hypot(*recorded[:, 3:5].T), speed[0], rtol=1e-12))
              if np.allclose(np.hypot(*recorded[i : i + 60, 3:5].T), speed, rtol=1e-9)]  # fmt: skip
        gaps = [np.hypot(*np.diff(p[:, :2], axis=0).T) for p in (path, recorded[at[0] : at[0] + 60])]
        np.testing.assert_allclose(*gaps, rtol=1e-9, atol=1e-6)


def test_targets_are_the_same_whatever_the_pool():
    plain = begin(4)[1].tape
    for fields in ({"transmitters": 10}, {"sites": "paper_poor"}, {"channels": 4}, {"retune_delay_s": 5.0}, CLEAN):
        tape = begin(4, **fields)[1].tape
        assert np.array_equal(tape.targets, plain.targets), fields
        assert np.array_equal(tape.guess, plain.guess), fields
    rarely = begin(4, echo_probability=0.3, **{k: v for k, v in CLEAN.items() if k != "echo_probability"})[1].tape
    assert np.array_equal(rarely.transmitters, plain.transmitters)
    assert np.array_equal(rarely.noise, plain.noise)


def test_the_papers_layouts_are_the_specifications():
    """Section 7; the good one's transmitters are an equilateral triangle about the receiver."""
    for name, sites in PAPER_SITES_M.items():
        _, world = begin(2, sites=name, dimensions=3)
        np.testing.assert_array_equal(world.platforms[0, 0, :3], sites[0])
        np.testing.assert_array_equal(world.tape.transmitters[1], sites[1:])
    receiver, *triangle = np.array(PAPER_SITES_M["paper_good"])[:, :2]
    sides = [np.hypot(*(a - b)) for a, b in itertools.combinations(triangle, 2)]
    np.testing.assert_allclose(sides, 249.4e3, rtol=1e-3)
    np.testing.assert_allclose(np.mean(triangle, axis=0), receiver, atol=1.0)
    own = ((0.0, 0.0), (5e4, 0.0), (0.0, 6e4), (-3e4, 4e4))
    _, world = begin(2, sites=own)
    np.testing.assert_array_equal(world.tape.transmitters[1], own[1:])


# ------------------------------------------------------------------------------------------------ blockage


STRETCHES = Stretches(30.0, 60.0, 20.0, 120.0)


def test_transmitters_are_blocked_for_the_stated_share_at_every_instant():
    u = np.random.default_rng(3).random((4000, 1, STRETCHES.uniforms(300.0)))
    hidden = blocked(u, STRETCHES, 1.0, 300)[..., 0]
    assert STRETCHES.share == pytest.approx(45.0 / 115.0)
    low, high = share_band(STRETCHES.share, 4000)
    assert ((hidden.mean(0) > low) & (hidden.mean(0) < high)).mean() > 0.99


def test_blocked_and_clear_stretches_last_as_long_as_stated():
    u = np.random.default_rng(4).random((400, 1, STRETCHES.uniforms(1500.0)))
    hidden = blocked(u, STRETCHES, 0.5, 3000)[..., 0]
    lasted = {True: [], False: []}
    for row in hidden:
        edges = np.flatnonzero(np.diff(row.astype(int)))
        for a, b in itertools.pairwise(edges):
            lasted[bool(row[a + 1])].append(0.5 * (b - a))
    for now, (low, high) in ((True, (30.0, 60.0)), (False, (20.0, 120.0))):
        values = np.array(lasted[now])
        assert values.min() >= low - 0.5
        assert values.max() <= high + 0.5
        spread = (high - low) / math.sqrt(12.0 * len(values))
        assert abs(values.mean() - 0.5 * (low + high)) < 6.0 * spread  # long ones end late: a little too few are seen


def test_nothing_is_blocked_without_blockage():
    _, world = begin(3, **CLEAN)
    assert not world.tape.blocked.any()
    assert world.tape.heard.all()
    assert not world.reports.listening.blocked_probability.any()


def forward_filter(listened, answered, share, to_blocked, to_clear, heard):
    """Second route: a hidden Markov chain's forward pass with matrices, one transmitter."""
    move = np.array([[1.0 - to_blocked, to_blocked], [to_clear, 1.0 - to_clear]])  # clear, blocked
    belief, told = np.array([1.0 - share, share]), []
    for asked, came in zip(listened, answered, strict=True):
        belief = belief @ move
        if asked:
            belief = belief * (np.array([heard, 0.0]) if came else np.array([1.0 - heard, 1.0]))
            belief /= belief.sum()
        told.append(belief[1])
    return told


def test_the_blockage_belief_is_the_forward_filter_of_what_was_heard():
    simulation, worlds = flown(6, 80)
    s = simulation.scenario
    to_blocked, to_clear = s.stretches.leaving(1.0)
    assert (to_blocked, to_clear) == pytest.approx((1 / 45, 1 / 45))
    early = [sighting.listening for sighting in simulation.sensors.acquire(worlds[0].tape)[0]]
    told = [*early, *(world.reports.listening for world in worlds[1:])]
    for e, n in itertools.product(range(6), range(8)):
        answered = [part.answered[e, n] for part in told]
        listened = [part.answered[e, n] or part.missed[e, n] for part in told]
        expected = forward_filter(listened, answered, s.stretches.share, to_blocked, to_clear, 0.8)
        np.testing.assert_allclose([part.blocked_probability[e, n] for part in told], expected, atol=1e-12)


def test_those_not_listened_to_are_as_likely_blocked_as_predicted():
    simulation, worlds = flown(5, 6)
    for before, now in itertools.pairwise(world.reports.listening for world in worlds):
        expected = blocked_next(before.blocked_probability, simulation.scenario.stretches, 1.0)
        aside = ~now.chosen
        np.testing.assert_allclose(now.blocked_probability[aside], expected[aside], rtol=1e-12)


def test_the_blockage_belief_is_calibrated():
    """Of the transmitters that it gives a probability, about that share is blocked; how long it has been it forgets."""
    _, worlds = flown(150, 60)
    told = np.array([world.reports.listening.blocked_probability for world in worlds[::12]]).ravel()
    true = np.array([world.reports.blocked for world in worlds[::12]]).ravel()
    for low, high in itertools.pairwise((0.0, 0.2, 0.4, 0.6, 0.8, 1.01)):
        inside = (told >= low) & (told < high)
        assert inside.sum() > 100
        assert true[inside].mean() == pytest.approx(told[inside].mean(), abs=0.15)


# ------------------------------------------------------------------------------------------------ choices and echoes


def test_the_highest_scores_are_listened_to_and_the_first_of_equal_ones():
    simulation, world = begin(1, channels=3)
    for scores, expected in (
        ([0.1, 0.9, -0.5, 0.3, 0.8, -1.0, 0.2, 0.0], [1, 3, 4]),
        ([0.0] * 8, [0, 1, 2]),
        ([-1.0, -1.0, 0.5, -1.0, 0.5, 0.5, 0.5, -1.0], [2, 4, 5]),
    ):
        new = simulation.advance(world, np.array([scores]))[0]
        assert np.flatnonzero(new.reports.listening.chosen[0]).tolist() == expected


def test_discrete_actions_are_combinations_in_order():
    scenario = make_scenario(NAME, {"actions": "discrete"})
    codec = scenario.make_actions()
    assert codec.space.nvec.tolist() == [28]
    assert scenario.combinations.tolist() == [list(pair) for pair in itertools.combinations(range(8), 2)]
    every = np.arange(28)[:, None]
    commands = codec.decode(every, 28)
    assert [np.flatnonzero(row > 0).tolist() for row in commands] == scenario.combinations.tolist()
    assert np.array_equal(codec.encode(commands), every)
    scores = np.array([[0.3, 0.3, 0.1, 0.3, -1.0, -1.0, 0.2, -1.0]])
    assert scenario.combinations[codec.encode(scores)[0, 0]].tolist() == [0, 1]
    env, twin = PassiveEnv(NAME, actions="discrete"), PassiveEnv(NAME)
    env.reset(seed=1), twin.reset(seed=1)
    assert np.array_equal(env.step(np.array([9]))[0], twin.step(asking(*scenario.combinations[9])[0])[0])


@pytest.mark.parametrize("dimensions", [2, 3])
def test_discrete_actions_of_a_moving_receiver_are_courses_off_lead_pursuit(dimensions):
    fields = {"actions": "discrete", "transmitters": 4, "dimensions": dimensions, **MOBILE}
    scenario = make_scenario(NAME, fields)
    codec, pairs = scenario.make_actions(), len(scenario.combinations)
    assert isinstance(codec, Combinations)
    assert codec.space.nvec.tolist() == [len(LEADS_DEG), pairs]
    simulation, world = begin(6, **fields)
    world = world._replace(platforms=world.platforms.copy())
    for lead, off in enumerate(np.radians(LEADS_DEG)):
        actions = np.column_stack([np.full(6, lead), np.arange(6) % pairs])
        belief = simulation.belief(world)
        commands = codec.commands(codec.decode(actions, 6), belief)
        aim = lead_pursuit(belief.platforms[:, 0], belief.mean[:, 0]) + off
        missing = np.degrees(wrap(aim - np.arctan2(*belief.platforms[:, 0, dimensions : dimensions + 2].T[::-1])))
        np.testing.assert_allclose(commands[:, 0], np.clip(missing / 5.0, -1.0, 1.0), atol=1e-9)
        assert np.array_equal(np.flatnonzero(commands[0, 1:] > 0), scenario.combinations[actions[0, 1]])
        # turned onto the course, the choice that keeps it is found again
        turned = world.platforms.copy()
        speed = np.linalg.norm(turned[:, 0, dimensions : dimensions + 2], axis=1)
        turned[:, 0, dimensions], turned[:, 0, dimensions + 1] = speed * np.cos(aim), speed * np.sin(aim)
        on_course = simulation.belief(world._replace(platforms=turned))
        kept = codec.commands(codec.decode(actions, 6), on_course)
        np.testing.assert_allclose(kept[:, 0], 0.0, atol=1e-9)
        assert np.array_equal(codec.encode(kept, on_course), actions)
    assert np.array_equal(codec.mirrored(np.array([[2, 3]])), [[len(LEADS_DEG) - 3, 3]])
    for bad in ([[len(LEADS_DEG), 0]], [[0, pairs]], [[-1, 0]], [[0.5, 0]], [[np.nan, 0]], [[1]]):
        with pytest.raises(ValueError, match="action"):
            codec.decode(bad, 1)
    with pytest.raises(TypeError, match="need the belief"):
        codec.encode(kept)


@pytest.mark.parametrize("dimensions", [2, 3])
def test_range_sums_are_the_true_ones_with_the_noise_of_the_tape(dimensions):
    _, worlds = flown(20, 15, dimensions=dimensions, std_range_m=60e3, std_floor_m=80.0)
    rows = np.arange(20)
    for k, world in enumerate(worlds):
        tape, told, scan = world.tape, world.reports.listening, world.reports.scan
        p, site, sites = world.truth[:, 0, :dimensions], world.platforms[:, 0, :dimensions], tape.transmitters
        listened = told.chosen
        assert np.array_equal(told.answered, listened & tape.heard[rows, k] & ~tape.blocked[rows, k])
        assert np.array_equal(told.missed, listened & ~told.answered)
        away = np.linalg.norm(p[:, None] - sites, axis=-1)
        std = np.maximum(200.0 * np.linalg.norm(p - site, axis=-1)[:, None] * away / 60e3**2, 80.0)
        expected = range_sum(p, site, sites) + std * tape.noise[rows, k]
        np.testing.assert_allclose(scan.range_sums, np.where(told.answered, expected, 0.0), rtol=1e-12)
        assert np.array_equal(scan.valid, told.answered)
        assert np.array_equal(scan.receiver, site)
    assert kstest(worlds[0].tape.noise[:, 1:40].ravel(), norm.cdf).pvalue > 1e-4


def test_standard_deviations_are_told_at_the_prediction_not_at_the_truth():
    simulation, worlds = flown(5, 3, std_range_m=60e3)
    predicted = simulation.tracker.predict(worlds[-2].track_state, 1.0)
    p, sites = predicted.mean[:, :2], worlds[-1].tape.transmitters
    std = 200.0 * np.linalg.norm(p, axis=-1)[:, None] * np.linalg.norm(p[:, None] - sites, axis=-1) / 60e3**2
    np.testing.assert_allclose(worlds[-1].reports.scan.std, np.maximum(std, 20.0), rtol=1e-12)
    _, constant = flown(2, 1)
    assert (constant[-1].reports.scan.std == 200.0).all()


def test_echoes_of_clear_transmitters_come_as_often_as_stated():
    _, world = begin(40, echo_probability=0.6)
    low, high = share_band(0.6, world.tape.heard.size)
    assert low < world.tape.heard.mean() < high


def test_the_acquisition_listens_to_all_transmitters_in_turn():
    simulation, world = begin(3, transmitters=5, channels=2)
    sightings, times = simulation.sensors.acquire(world.tape)
    assert np.array_equal(times, np.arange(20.0))
    asked = [np.flatnonzero(sighting.listening.chosen[0]).tolist() for sighting in sightings]
    assert asked[:5] == [[0, 1], [2, 3], [0, 4], [1, 2], [3, 4]]
    assert asked[5:10] == asked[10:15] == asked[15:] == asked[:5]


def test_a_newly_chosen_transmitter_is_heard_after_the_delay():
    simulation, world = begin(1, retune_delay_s=3.0, acquisition_scans=10, **CLEAN)
    assert np.flatnonzero(world.reports.listening.chosen[0]).tolist() == [2, 3]  # 10 scans of two of eight
    history = []
    for pair in [(2, 5)] * 4 + [(5, 6)] + [(2, 5)] * 4:
        world = simulation.advance(world, asking(*pair))[0]
        told = world.reports.listening
        history.append((np.flatnonzero(told.answered[0]).tolist(), told.wait_s[0, [2, 5, 6]].tolist()))
        assert not told.missed.any()
    assert [answered for answered, _ in history] == [[2], [2], [2, 5], [2, 5], [5], [5], [5], [2, 5], [2, 5]]
    assert [waits for _, waits in history[:3]] == [[0.0, 2.0, 3.0], [0.0, 1.0, 3.0], [0.0, 0.0, 3.0]]
    assert [waits for _, waits in history[4:6]] == [[3.0, 0.0, 2.0], [2.0, 0.0, 3.0]]


def test_answers_and_misses_are_remembered():
    _, worlds = flown(5, 40)
    told = [world.reports.listening for world in worlds]
    for before, now in itertools.pairwise(told):
        for was, happened, since in (
            (before.since_answer_s, now.answered, now.since_answer_s),
            (before.since_miss_s, now.missed, now.since_miss_s),
        ):
            np.testing.assert_array_equal(since, np.where(happened, 0.0, np.minimum(was + 1.0, NEVER_S)))
    fresh = begin(30, acquisition_scans=1)[1].reports.listening
    assert np.array_equal(fresh.since_answer_s == NEVER_S, ~fresh.answered)


# ------------------------------------------------------------------------------------------------ receiver


def test_a_receiver_that_stands_stays():
    _, worlds = flown(3, 5)
    assert np.array_equal(worlds[0].platforms, worlds[-1].platforms)


@pytest.mark.parametrize("dimensions", [2, 3])
def test_a_moving_receiver_turns_at_its_speed(dimensions):
    turn_left = lambda belief: np.hstack([np.ones((3, 1)), asking(0, 1, episodes=3)])  # noqa: E731
    _, worlds = flown(3, 4, turn_left, dimensions=dimensions, **MOBILE)
    states = np.array([plan_view(world.platforms)[:, 0] for world in worlds])
    np.testing.assert_allclose(np.hypot(states[..., 2], states[..., 3]), 200.0)
    turned = np.diff(np.arctan2(states[..., 3], states[..., 2]), axis=0)
    np.testing.assert_allclose(np.degrees(wrap(turned)), 5.0, rtol=1e-9)
    moved = np.hypot(*np.diff(states[..., :2], axis=0).T)
    np.testing.assert_allclose(moved, 200.0 * math.sin(math.radians(2.5)) / math.radians(2.5))
    if dimensions == 3:
        assert not any(world.platforms[..., [2, 5]].any() for world in worlds)


def test_a_moving_receiver_flies_straight_up_to_the_first_decision():
    simulation, world = begin(3, **MOBILE)
    sightings, times = simulation.sensors.acquire(world.tape)
    way = np.array([sighting.scan.receiver for sighting in sightings])
    expected = world.platforms[:, 0, :2] + (times - times[-1])[:, None, None] * world.platforms[:, 0, 2:]
    np.testing.assert_allclose(way, expected)


def test_a_constant_heading_leads_to_the_target():
    env = PassiveVectorEnv("MobileReceiver", 12, "disabled", threads=1)
    env.reset(seed=0)
    for _ in range(60):
        env.step(np.hstack([np.zeros((12, 1)), np.random.default_rng(0).uniform(-1, 1, (12, 8))]))
    platforms, mean = env.world.platforms[:, 0], env.world.estimate.mean[:, 0]
    sight = mean[:, :2] - platforms[:, :2]
    far = np.hypot(*sight.T) > 5e3  # nearer ones cross its nose faster than it turns
    off = wrap(np.arctan2(platforms[:, 3], platforms[:, 2]) - np.arctan2(sight[:, 1], sight[:, 0]))
    assert far.sum() >= 8
    assert (np.abs(np.degrees(off[far])) < 6.0).sum() >= far.sum() - 1  # one has just passed its target


# ------------------------------------------------------------------------------------------------ track, figures, bound


@pytest.mark.parametrize(("layout", "expected"), [("paper_poor", (316.0, 278.0, 243.0)), ("paper_good", (61.0,))])
def test_the_bound_of_the_papers_layouts_is_the_specifications(layout, expected):
    """Section 9: the bound on the horizontal error at 300, 450, 600 s of the poor layout, at 300 s of the good one."""
    fields = {"sites": layout, "course": "paper", "dimensions": 3, "steps": 591, **CLEAN}
    simulation, world = begin(12, **fields)
    bounds = []
    for _ in range(591):
        world = simulation.advance(world, np.zeros((12, 3)))[0]
        bounds.append(np.sqrt(np.square(world.metrics.horizontal_crlb_m).mean()))
    at = [290, 440, 590] if len(expected) == 3 else [290]
    np.testing.assert_allclose([bounds[i] for i in at], expected, rtol=0.08)


@pytest.mark.parametrize("dimensions", [2, 3])
def test_the_bound_equals_its_information_form(dimensions):
    simulation, worlds = flown(4, 12, dimensions=dimensions, std_range_m=60e3)
    s, d = simulation.scenario, dimensions
    F, Q = axis_transition(1.0, d), axis_noise(1.0, s.process_noise[:d])
    sightings, _ = simulation.sensors.acquire(worlds[0].tape)
    for e in range(4):
        scans = [(x.truth[e, 0], x.listening.answered[e]) for x in sightings]
        scans += [(world.truth[e, 0], world.reports.listening.answered[e]) for world in worlds[1:]]
        J, sites = np.diag(s.guess_std**-2.0), worlds[0].tape.transmitters[e]
        for k, (x, answered) in enumerate(scans):
            if k > 0:
                J = np.linalg.inv(Q + F @ np.linalg.inv(J) @ F.T)
            site, p = np.zeros(d), x[:d]
            std = np.maximum(200.0 * np.linalg.norm(p) * np.linalg.norm(p - sites, axis=-1) / 60e3**2, 20.0)
            H = range_sum_jacobian(p, site, sites) / std[:, None]
            J[:d, :d] += H[answered].T @ H[answered]
        C, figures = np.linalg.inv(J), map_rows(lambda a, e=e: a[e, 0], worlds[-1].metrics)
        u = p / np.linalg.norm(p)
        np.testing.assert_allclose(worlds[-1].bound[e, 0], C, rtol=1e-6, atol=1e-6)
        assert figures.range_crlb_m == pytest.approx(math.sqrt(u @ C[:d, :d] @ u), rel=1e-6)
        assert figures.horizontal_crlb_m == pytest.approx(math.sqrt(C[0, 0] + C[1, 1]), rel=1e-6)
        assert figures.position_crlb_m == pytest.approx(math.sqrt(np.trace(C[:d, :d])), rel=1e-6)
        assert figures.height_crlb_m == pytest.approx(math.sqrt(C[2, 2]) if d == 3 else 0.0, rel=1e-6)


@pytest.mark.parametrize("dimensions", [2, 3])
def test_figures_by_hand(dimensions):
    _, worlds = flown(3, 6, dimensions=dimensions, **MOBILE)
    world, d = worlds[-1], dimensions
    x, mean, site = world.truth[:, 0], world.estimate.mean[:, 0], world.platforms[:, 0, :d]
    off, m = mean - x, world.metrics
    ranges = [np.linalg.norm(p[:, :d] - site, axis=-1) for p in (x, mean)]
    np.testing.assert_allclose(m.range_m[:, 0], ranges[0])
    np.testing.assert_allclose(m.range_error_m[:, 0], np.abs(ranges[1] - ranges[0]), atol=1e-6)
    np.testing.assert_allclose(m.position_error_m[:, 0], np.linalg.norm(off[:, :d], axis=-1))
    np.testing.assert_allclose(m.horizontal_error_m[:, 0], np.hypot(off[:, 0], off[:, 1]))
    np.testing.assert_allclose(m.height_error_m[:, 0], np.abs(off[:, 2]) if d == 3 else 0.0)
    nees = [v @ np.linalg.solve(P, v) for v, P in zip(off, world.estimate.cov[:, 0], strict=True)]
    np.testing.assert_allclose(m.nees[:, 0], nees, rtol=1e-6)


def test_tracks_are_about_as_good_as_their_covariance_says():
    """NEES of tracks after a minute: its mean over 200 runs about 4, an EKF's own overconfidence allowed for."""
    _, worlds = flown(200, 60)
    nees = worlds[-1].metrics.nees[:, 0]
    assert 3.0 < np.sort(nees)[:196].mean() < 6.5
    assert worlds[-1].metrics.lost.mean() <= 0.02


def test_asking_those_who_are_likely_to_answer_beats_asking_the_same_pair():
    """The world has something to choose."""

    def likeliest(belief):
        return -belief.blocked_probability

    errors = {}
    for name, decide in (("fixed", lambda belief: asking(0, 1, episodes=100)), ("likeliest", likeliest)):
        _, worlds = flown(100, 150, decide)
        errors[name] = np.median([world.metrics.position_error_m[:, 0] for world in worlds[50:]])
    assert errors["likeliest"] < 0.8 * errors["fixed"]


def test_settings_reach_the_tracker():
    scenario = make_scenario(NAME, {"process_noise_m_s2": 2.0, "climb_noise_m_s2": 0.5})
    noise = (4.0, 4.0, 0.25)
    assert scenario.make_tracker() == RangeSumEkf(process_noise=noise, restart_std_m=10e3)
    assert scenario.replace(tracker="ekf_literal").make_tracker() == RangeSumEkfLiteral(process_noise=noise)
    for turns in ({"maneuvers": True}, {"course": "flights"}):
        found = scenario.replace(**turns).make_tracker()
        assert found == RangeSumEkf(process_noise=noise, restart_std_m=10e3, turning_m_s2=1.0)


def test_rewards_are_their_formulas():
    fields = {"reward_horizontal_error": 0.5, "reward_height_error": 2.0, "reward_log_horizontal_bound": 3.0}
    env = PassiveEnv(NAME, dimensions=3, steps=5, **fields)
    env.reset(seed=0)
    *_, info = env.step(np.zeros(8))
    terms = info["reward_terms"]
    error, height, bound = (info[name][0] for name in ("horizontal_error_m", "height_error_m", "horizontal_crlb_m"))
    assert terms["log_horizontal_error"] == pytest.approx(-math.log(max(error, 30.0) / 1e3))
    assert terms["horizontal_error"] == pytest.approx(-0.5 * error / 1e3)
    assert terms["height_error"] == pytest.approx(-2.0 * height / 1e3)
    assert terms["log_horizontal_bound"] == pytest.approx(-3.0 * math.log(bound / 1e3))


def test_evaluation_flies_the_family():
    scenario = make_scenario(NAME, {"steps": 12})
    record = fly(scenario, make_policy("random", scenario), 8, 0)
    assert record.score == "position"
    assert record.position_error_m.shape == (8, 13)


# ------------------------------------------------------------------------------------------------ belief, observation


class Recorder:
    """Sensors that keep every sighting they give."""

    def __init__(self, sensors, kept):
        self.sensors, self.kept = sensors, kept

    def __getattr__(self, name):
        return getattr(self.sensors, name)

    def acquire(self, *args):
        self.kept.append(self.sensors.acquire(*args))
        return self.kept[-1]

    def sense(self, *args):
        self.kept.append(self.sensors.sense(*args))
        return self.kept[-1]


class Replayer(Recorder):
    """Sensors that give what was kept: the same to the operator, with another truth behind it."""

    def acquire(self, *args):
        sightings, times = self.kept.pop(0)
        return [other_truth(sighting) for sighting in sightings], times

    def sense(self, *args):
        return other_truth(self.kept.pop(0))


def other_truth(sighting):
    """The sighting of a target that is elsewhere, with the blockage the other way round."""
    return sighting._replace(truth=sighting.truth + 7e3, blocked=~sighting.blocked)


@pytest.mark.parametrize("fields", [{}, {"dimensions": 3}, ROUGH], ids=str)
def test_observations_do_not_change_when_the_truth_behind_the_same_echoes_does(monkeypatch, fields):
    kept, runs = [], []
    make_sensors = PassiveRadar.make_sensors
    for twin in (Recorder, Replayer):
        with monkeypatch.context() as patch:
            patch.setattr(
                PassiveRadar, "make_sensors", lambda self, tracker, t=twin: t(make_sensors(self, tracker), kept)
            )
            simulation, worlds = flown(3, 20, **fields)
        runs.append((simulation, worlds))
    assert kept == []
    (first, ours), (second, theirs) = runs
    for a, b in zip(ours, theirs, strict=True):
        assert not np.array_equal(a.truth, b.truth)
        assert np.array_equal(first.observe(a), second.observe(b))
        map_rows(np.testing.assert_array_equal, first.belief(a), second.belief(b))
    assert not np.array_equal(ours[-1].metrics.position_error_m, theirs[-1].metrics.position_error_m)


def test_belief_and_observation_read_nothing_of_the_truth():
    simulation, worlds = flown(3, 5)
    world = worlds[-1]
    tape = world.tape._replace(targets=np.zeros_like(world.tape.targets), blocked=~world.tape.blocked)
    other = world._replace(
        tape=tape, truth=world.truth * 0.0, bound=world.bound * 7.0,
        reports=world.reports._replace(blocked=~world.reports.blocked),
    )  # fmt: skip
    assert np.array_equal(simulation.observe(world), simulation.observe(other))


def test_worlds_are_never_changed_in_place():
    simulation, world = begin(3, **ROUGH)
    before = map_rows(np.copy, world)
    for _ in range(3):
        simulation.advance(world, np.ones((3, simulation.actions.size)))
    map_rows(np.testing.assert_array_equal, world, before)


@pytest.mark.parametrize("dimensions", [2, 3])
def test_observed_fields_by_hand(dimensions):
    simulation, worlds = flown(1, 7, dimensions=dimensions, **ROUGH)
    belief, d = simulation.belief(worlds[-1]), dimensions
    shown = dict(zip((f.name for f in simulation.observation.fields), simulation.observe(worlds[-1])[0], strict=True))
    x, P, own = belief.mean[0, 0], belief.cov[0, 0], belief.platforms[0, 0]
    sight = x[:d] - own[:d]
    a = sight[:2] / np.hypot(*sight[:2])
    left = np.array([-a[1], a[0]])
    turn = np.stack([a, left]) if d == 2 else np.block([[np.stack([a, left]), np.zeros((2, 1))], [0.0, 0.0, 1.0]])
    C = np.kron(np.eye(2), turn) @ P @ np.kron(np.eye(2), turn).T
    std = np.sqrt(np.diag(C))
    axes = ("radial", "cross", "up")[:d]
    expected = {
        "time_left": 293 / 300,
        "track0.log_range": math.log(np.linalg.norm(sight) / 5e4),
        "track0.radial_velocity": x[d : d + 2] @ a / 300.0,
        "track0.cross_velocity": x[d : d + 2] @ left / 300.0,
        "track0.log_std_radial": math.log(std[0] / 1e3) / 2.0,
        f"track0.log_std_{axes[-1]}_velocity": math.log(std[-1] / 50.0) / 2.0,
        "track0.corr_radial_cross": C[0, 1] / (std[0] * std[1]),
        f"track0.corr_cross_{axes[-1]}_velocity": C[1, -1] / (std[1] * std[-1]),
        "track0.log_statistic": math.log1p(belief.statistic[0]) / 2.0,
        "receiver.heading_cos": own[d : d + 2] @ a / 200.0,
        "receiver.heading_sin": own[d : d + 2] @ left / 200.0,
        "last_action0": worlds[-1].last_action[0, 0],
    }
    if d == 3:
        expected |= {"track0.height": x[2] / 1e4, "track0.climb": x[5] / 50.0}
    for n, site in enumerate(belief.transmitters[0]):
        away = x[:d] - site
        u, h = away / np.linalg.norm(away), away / np.linalg.norm(away) + sight / np.linalg.norm(sight)
        name, sigma = f"transmitter{n}.", belief.std[0, n]
        expected |= {
            name + "log_range": math.log(np.linalg.norm(away) / 5e4),
            name + "sight_cos": u[:2] @ a,
            name + "sight_sin": u[:2] @ left,
            name + "log_gain": math.log(math.sqrt(h @ P[:d, :d] @ h) / sigma) / 2.0,
            name + "chosen": float(belief.chosen[0, n]),
            name + "answered": float(belief.answered[0, n]),
            name + "missed": float(belief.missed[0, n]),
            name + "recent_answer": math.exp(-belief.since_answer_s[0, n] / 10.0),
            name + "recent_miss": math.exp(-belief.since_miss_s[0, n] / 10.0),
            name + "blocked_probability": belief.blocked_probability[0, n],
            name + "wait": belief.wait_s[0, n] / 2.0,
            name + "log_noise": math.log(sigma / 200.0),
        }
        if d == 3:
            expected[name + "sight_up"] = 5.0 * u[2]
    for name, value in expected.items():
        assert shown[name] == pytest.approx(np.clip(value, -5.0, 5.0), rel=1e-5, abs=1e-6), name
    assert len(shown) == len(simulation.observation.fields)


def test_every_transmitters_fields_stand_together_in_the_same_order():
    for fields in ({}, {"dimensions": 3}, ROUGH):
        model = make_scenario(NAME, fields).make_observation()
        names = [field.name for field in model.fields]
        assert not any(name.startswith("transmitter") for name in names[: model.shared])
        blocks = np.array(names[model.shared :]).reshape(8, model.per_transmitter)
        for n, block in enumerate(blocks):
            assert [name.partition(".")[0] for name in block] == [f"transmitter{n}"] * model.per_transmitter
            assert [name.partition(".")[2] for name in block] == [name.partition(".")[2] for name in blocks[0]]


@pytest.mark.parametrize("fields", [{}, {"dimensions": 3}, ROUGH], ids=str)
def test_a_mirrored_world_shows_the_mirrored_observation_and_earns_the_same(monkeypatch, fields):
    scenario = make_scenario(NAME, fields)
    d = scenario.dimensions
    state = np.tile(np.where(np.arange(d) == 1, -1.0, 1.0), 2)
    draw_tape = PassiveRadar.draw_tape

    def mirrored(self, generators):
        tape = draw_tape(self, generators)
        early = tape.acquisition._replace(targets=tape.acquisition.targets * state)
        return tape._replace(
            platforms=tape.platforms * state, targets=tape.targets * state, guess=tape.guess * state,
            transmitters=tape.transmitters * state[:d], acquisition=early,
        )  # fmt: skip

    generators = lambda: [np.random.default_rng(seed) for seed in range(4)]  # noqa: E731
    simulation = scenario.make_simulation()
    world = simulation.begin(generators())
    with monkeypatch.context() as patch:
        patch.setattr(PassiveRadar, "draw_tape", mirrored)
        other = simulation.begin(generators())
    rng = np.random.default_rng(1)
    for _ in range(15):
        shown = simulation.observation.mirrored(simulation.observe(world))
        np.testing.assert_allclose(simulation.observe(other), shown, atol=2e-4)
        command = rng.uniform(-1.0, 1.0, (4, simulation.actions.size))
        world, earned, _ = simulation.advance(world, command)
        other, also, _ = simulation.advance(other, simulation.actions.mirrored(command))
        np.testing.assert_allclose(also, earned, atol=1e-3)
    truths = scenario.make_truth_observation()
    np.testing.assert_allclose(truths(other), truths.mirrored(truths(world)), atol=1e-3)


def test_the_critic_knows_who_is_blocked():
    scenario = make_scenario(NAME, {})
    _, worlds = flown(5, 4)
    model = scenario.make_truth_observation()
    numbers, names = model(worlds[-1]), [field.name for field in model.fields]
    assert numbers.shape == (5, len(names))
    first = names.index("truth0.blocked0")
    hidden = worlds[-1].tape.blocked
    assert np.array_equal(numbers[:, first : first + 8], hidden[:, 4].astype(np.float32))
    for scans in (5, 10, 20):
        at = names.index(f"truth0.blocked0_in_{scans}")
        np.testing.assert_allclose(numbers[:, at : at + 8], hidden[:, 5 : 5 + scans].mean(axis=1), rtol=1e-6)
    assert (model.shared, len(names)) == (first, first + 32)
    last = worlds[-1]._replace(step=np.full(5, hidden.shape[1] - 2))
    at = names.index("truth0.blocked0_in_10")
    assert np.array_equal(model(last)[:, at : at + 8], hidden[:, -1].astype(np.float32))  # as if it stayed so
    bound = 0.5 * np.log(worlds[-1].metrics.horizontal_crlb_m[:, 0] / 100.0)
    np.testing.assert_allclose(numbers[:, first - 1], bound, rtol=1e-5)


class Astray(RangeSumEkf):
    """A tracker whose estimates are sound for three calls only."""

    def __init__(self, spoil):
        super().__init__()
        object.__setattr__(self, "spoil", spoil)
        object.__setattr__(self, "asked", 0)

    def estimate(self, state):
        object.__setattr__(self, "asked", self.asked + 1)
        return super().estimate(state) if self.asked <= 3 else self.spoil(*super().estimate(state))


SPOILT = {
    "mean": lambda mean, cov: Gaussian(mean * np.nan, cov),
    "covariance": lambda mean, cov: Gaussian(mean, cov * np.nan),
    "infinite": lambda mean, cov: Gaussian(mean + np.inf, cov * np.inf),
    "negative": lambda mean, cov: Gaussian(mean, -cov),
}


@pytest.mark.parametrize("spoil", SPOILT.values(), ids=SPOILT)
@pytest.mark.parametrize("fields", [{}, {"dimensions": 3, **MOBILE}], ids=["plane", "space"])
def test_a_diverged_tracker_leaks_nothing(spoil, fields):
    simulation, worlds = flown(2, 4, tracker=Astray(spoil), **fields)
    truths = simulation.scenario.make_truth_observation()
    for world in worlds:
        assert np.isfinite(simulation.observe(world)).all()
        assert np.isfinite(truths(world)).all()
        for name, part in simulation.info(world).items():
            assert np.isfinite(part).all(), name
        assert np.isfinite(world.reports.scan.std).all()


# ------------------------------------------------------------------------------------------------ batches


@pytest.mark.parametrize(
    "fields", [{}, {"dimensions": 3}, ROUGH, {"course": "flights"}, {"actions": "discrete"}], ids=str
)
def test_sub_environments_are_single_environments_whatever_the_width(fields):
    fields = {"steps": 12, **fields}
    singles = [PassiveEnv(NAME, **fields) for _ in range(3)]
    wide = PassiveVectorEnv(NAME, 200, "same_step", threads=2, **fields)
    narrow = PassiveVectorEnv(NAME, 3, "same_step", threads=1, **fields)
    many, few = wide.reset(seed=5)[0], narrow.reset(seed=5)[0]
    own = np.array([env.reset(seed=5 + i)[0] for i, env in enumerate(singles)])
    wide.action_space.seed(0)
    for _ in range(12):
        assert np.array_equal(many[:3], few)
        assert np.array_equal(few, own)
        actions = wide.action_space.sample()
        many, earned, *_, info = wide.step(actions)
        few, also, *_ = narrow.step(actions[:3])
        steps = [env.step(action) for env, action in zip(singles, actions, strict=False)]
        own, rewards = np.array([step[0] for step in steps]), np.array([step[1] for step in steps])
        assert np.array_equal(earned[:3], also)
        assert np.array_equal(also, rewards)
        if "final_info" in info:
            many, few, info = info["final_obs"], few, info["final_info"]
            break
        for name in ("position_error_m", "position_crlb_m", "answered", "blocked_probability"):
            assert np.array_equal(info[name][:3], [step[4][name] for step in steps]), name


# ------------------------------------------------------------------------------------------------ pictures


@pytest.mark.parametrize(
    "fields", [{}, {"dimensions": 3}, ROUGH, {"dimensions": 3, **MOBILE}, {"sites": "paper_good"}], ids=str
)
def test_pictures_render_at_any_step_and_show_what_changed(fields):
    env = PassiveEnv(NAME, render_mode="rgb_array", **fields)
    env.action_space.seed(0)
    env.reset(seed=2)
    pictures = [env.render()]
    for _ in range(6):
        env.step(env.action_space.sample())
        pictures.append(env.render())
    assert all(picture.shape == (800, 800, 3) and picture.dtype == np.uint8 for picture in pictures)
    assert all((a != b).any() for a, b in itertools.pairwise(pictures))
    assert np.array_equal(env.render(), pictures[-1])
    env.close()


def test_a_picture_tells_who_was_asked_and_where_the_ghost_is():
    env = PassiveEnv(NAME, render_mode="rgb_array", **CLEAN)
    env.reset(seed=1)
    env.render()
    pairs = [(0, 3), (2, 5), (2, 5)]
    for pair in pairs:
        env.step(asking(*pair)[0])
        env.render()
    scene = env._viewer._scene
    codes = np.asarray(scene._told.get_array())
    assert [np.flatnonzero(codes[:, k] == 1.0).tolist() for k in (1, 2, 3)] == [list(pair) for pair in pairs]
    ghost, world = 1e3 * np.array(scene._ghost.get_data())[:, 0], env.world
    scan = world.reports.scan
    sums = range_sum(ghost, scan.receiver[0], scan.transmitters[0, [2, 5]])
    np.testing.assert_allclose(sums, scan.range_sums[0, [2, 5]], rtol=1e-6)
    assert np.hypot(*(ghost - world.estimate.mean[0, 0, :2])) > 1e3
    env.reset(seed=2)
    env.render()
    assert not np.asarray(scene._told.get_array())[:, 1:].any()
    env.close()


def test_an_ellipse_holds_the_points_of_its_range_sum():
    receiver, transmitter = np.array([1e3, -2e3]), np.array([4e4, 3e4])
    outline = sum_ellipse(9e4, receiver, transmitter)
    np.testing.assert_allclose(range_sum(outline, receiver, transmitter[None])[:, 0], 9e4)
    raised = np.column_stack([sum_ellipse(9e4, receiver, transmitter, 9e3), np.full(181, 9e3)])
    level = [np.append(site, 0.0) for site in (receiver, transmitter)]
    np.testing.assert_allclose(range_sum(raised, level[0], level[1][None])[:, 0], 9e4)
    assert np.isfinite(sum_ellipse(1e3, receiver, transmitter)).all()  # shorter than the baseline


def test_a_diverged_track_still_gives_a_picture():
    env = PassiveEnv(NAME, render_mode="rgb_array", tracker=Astray(SPOILT["mean"]))
    env.reset(seed=0)
    for _ in range(5):
        env.step(np.zeros(8))
    assert env.render().shape == (800, 800, 3)


# ------------------------------------------------------------------------------------------------ bad input

ON_A_LINE = ((0.0, 0.0), (1e4, 1e4), (-3e4, -3e4), (2e4, 2e4))
TWICE = ((0.0, 0.0), (1e4, 2e4), (3e4, 0.0), (1e4, 2e4))
PRINTED = ((-36e3, 0.0, 100.0), (-108e3, -124.7e3, 0.0), (-108e3, -124.7e3, 0.0), (108e3, 0.0, 0.0))
BAD = [
    ({"sites": "paper"}, r"PassiveRadar.sites = 'paper': must be one of 'random', 'paper_poor', 'paper_good'"),
    ({"sites": ON_A_LINE}, "all points lie on one line"),
    ({"sites": TWICE}, "points 1 and 3 coincide"),
    ({"sites": PRINTED, "dimensions": 3}, "points 1 and 2 coincide"),
    ({"sites": ((0.0, 0.0), (0.0, 0.0), (1e4, 0.0))}, "points 0 and 1 coincide"),
    ({"sites": ((0.0, 0.0), (1e4, 0.0))}, "3 points or more"),
    ({"sites": ((0.0, 0.0), (1e4, 0.0), (0.0, 1e4)), "dimensions": 3}, "of 3 coordinates"),
    ({"sites": ((0.0, 0.0), (1e4, np.nan), (0.0, 1e4))}, "finite"),
    ({"sites": (("a", 0.0), (1e4, 0.0), (0.0, 1e4))}, "coordinates"),
    ({"sites": ((0.0, 0.0), (1e4,), (0.0, 1e4))}, "coordinates"),
    ({"sites": [(1e3 * i, 1e3 * i * i) for i in range(18)]}, "16 transmitters at most"),
    ({"sites": None}, "coordinates|3 points"),
    ({"dimensions": 4}, r"dimensions = 4: must lie in \[2, 3\]"),
    ({"channels": 9}, "channels = 9: there are 8 transmitters"),
    ({"sites": "paper_poor", "channels": 4}, "there are 3 transmitters"),
    ({"transmitters": 2}, "transmitters = 2"),
    ({"echo_probability": 0.0}, "echo_probability"),
    ({"blocked_min_s": 0.0}, "blocked_min_s = 0.0: must be above 0"),
    ({"clear_min_s": 61.0}, "clear_min_s = 61.0: must not exceed clear_max_s"),
    ({"retune_delay_s": -1.0}, "retune_delay_s"),
    ({"course": "flights", "maneuvers": True}, "maneuvers = True: is not used with course='flights'"),
    ({"course": "flights", "steps": 10_000}, "no flight"),
    ({"sites": ((0, 0), (1e200, 0), (0, 1e200))}, "within 10000000 m of the origin"),
    ({"standoff_m": 6e3}, "may start 5000 m from the receiver"),
    ({"standoff_m": 5e3, "sites": "paper_good"}, "may start 0 m from the receiver"),
    ({"tracker": "kalman"}, "must be one of 'ekf', 'ekf_second_order', 'ekf_literal'"),
    ({"site_range_min_m": 2e5}, "site_range_min_m"),
    ({"range_sum_std_m": 0.0}, "range_sum_std_m"),
]


@pytest.mark.parametrize(("fields", "message"), BAD)
def test_bad_values_are_errors_that_name_field_value_and_what_is_right(fields, message):
    with pytest.raises(ValueError, match=message):
        PassiveEnv(NAME, **fields)


def test_fields_of_other_families_are_refused():
    for field in ("range_floor_m", "range_cap_m", "stations"):
        with pytest.raises(TypeError, match=field):
            make_scenario(NAME, {field: 1})


def test_a_tracker_that_tells_another_number_of_tests_is_refused():
    class Odd(RangeSumEkf):
        def update(self, state, scan):
            update = super().update(state, scan)
            return update._replace(maneuver=update.maneuver[:, None])

    simulation, world = begin(3, tracker=Odd())
    with pytest.raises(ValueError, match=r"tracker Odd: update\(\) gave maneuver of shape \(3, 1\)"):
        simulation.advance(world, np.zeros((3, 8)))


def test_trackers_of_other_families_or_without_verbs_are_refused():
    with pytest.raises(TypeError, match="must be an object"):
        make_scenario(NAME, {"tracker": RangeSumEkf})
    with pytest.raises(TypeError, match="has no initiate"):
        make_scenario(NAME, {"tracker": object()})


def test_bad_actions_are_errors_and_leave_the_episode_as_it_was():
    env, twin = PassiveEnv(NAME), PassiveEnv(NAME)
    env.reset(seed=0), twin.reset(seed=0)
    for bad in (np.zeros(9), np.zeros((1, 8)), [np.nan] * 8, "first", None):
        with pytest.raises(ValueError, match="action"):
            env.step(bad)
    assert np.array_equal(env.step(np.zeros(8))[0], twin.step(np.zeros(8))[0])


def test_scans_without_an_echo_let_the_track_coast():
    simulation, worlds = flown(3, 8, retune_delay_s=60.0)
    for before, world in itertools.pairwise(worlds):
        silent = ~world.reports.listening.answered.any(-1)
        coasted = simulation.tracker.estimate(simulation.tracker.predict(before.track_state, 1.0))
        np.testing.assert_array_equal(world.estimate.mean[silent], coasted.mean[silent])
        assert (world.reports.statistic[silent] == 0.0).all()
    assert silent.all()


def test_every_field_has_a_rule():
    for field in dataclasses.fields(PassiveRadar):
        assert field.metadata.get("doc"), field.name


# ------------------------------------------------------------------------------------------------------- evaluation


@pytest.mark.parametrize("dimensions", [2, 3])
def test_evaluations_tell_level_and_height_errors_and_those_of_settled_tracks(dimensions, tmp_path):
    scenario = make_scenario(NAME, {"steps": 60, "dimensions": dimensions})
    record = fly(scenario, make_policy("round_robin", scenario), 3, 5)
    env = PassiveVectorEnv(scenario, num_envs=3)
    observation, _ = env.reset(seed=5)
    policy, level, height = make_policy("round_robin", scenario), [], []
    policy.reset(env.belief())
    for _ in range(60):
        belief = env.belief()
        env.step(env.simulation.actions.encode(policy.act(belief, observation), belief))
        off = env.world.estimate.mean[:, 0] - env.world.truth[:, 0]
        level.append(np.hypot(off[:, 0], off[:, 1]))
        height.append(np.abs(off[:, 2]))
    samples = record.samples
    np.testing.assert_allclose(samples["mean_horizontal_error_m"], np.mean(level, axis=0), rtol=1e-9)
    np.testing.assert_allclose(samples["settled_horizontal_error_m"], np.mean(level[50:], axis=0), rtol=1e-9)
    assert ("mean_height_error_m" in samples) == (dimensions == 3)
    if dimensions == 3:
        np.testing.assert_allclose(samples["mean_height_error_m"], np.mean(height, axis=0), rtol=1e-9)
    summary = summarize(f"passive/{NAME}-v0", 5, {"round_robin": record, "twin": record})
    table = as_markdown(summary)
    assert "settled" in table
    assert "first 50 s" in table
    assert ("height average" in table) == (dimensions == 3)
    files = {file.name for file in write_evaluation(tmp_path, summary, {"round_robin": record}, scenario)}
    assert "maneuvers.png" not in files  # the receiver stands


def test_short_episodes_have_no_settled_tracks():
    scenario = make_scenario(NAME, {"steps": 30})
    assert "settled_horizontal_error_m" not in fly(scenario, make_policy("rule", scenario), 2, 1).samples
