"""Predicted costs, greedy, planner and oracle: what they minimise, that they find it, and what they keep away from."""

import itertools
import math
import pickle
from types import SimpleNamespace

import numpy as np
import pytest

from agents.evaluation import fly
from agents.greedy import Greedy
from agents.imitation import imitate
from agents.planner import Oracle, Planner
from agents.policy import make_policy, sees_world
from agents.prediction import CRITERIA, GUARD_PER_S, STANDOFF_PER_S, WORST, Prediction, situation
from agents.tuning import as_markdown, tune_zigzag
from passive_env.belief import Belief
from passive_env.catalogue.two_station import TwoStation
from passive_env.core import Simulation
from passive_env.kinematics import turn
from passive_env.steering import towards
from trackers.bounds import fisher_information
from trackers.motion import process_noise, transition


def scenario(**fields):
    """The fields of a scenario that predictions read."""
    values = {
        "step_s": 5.0, "steps": 40, "max_turn_rate_deg_s": 3.0, "bearing_std_deg": 0.5, "detection_probability": 0.8,
        "bearings": "all", "process_noise_m_s": 5.0, "standoff_m": 0.0,
    }  # fmt: skip
    return SimpleNamespace(**{**values, **fields})


def random_belief(batch=3, platforms=1, tracks=1, steps_left=20, seed=0):
    """Tracks 25 to 60 km off with full covariances, platforms at 250 m/s."""
    rng = np.random.default_rng(seed)
    heading = rng.uniform(-math.pi, math.pi, (batch, platforms))
    places = rng.uniform(-8e3, 8e3, (batch, platforms, 2))
    velocity = 250.0 * np.stack([np.cos(heading), np.sin(heading)], axis=-1)
    bearing, r = rng.uniform(-math.pi, math.pi, (batch, tracks)), rng.uniform(25e3, 60e3, (batch, tracks))
    position = r[..., None] * np.stack([np.cos(bearing), np.sin(bearing)], axis=-1)
    mean = np.concatenate([position, rng.normal(0.0, 120.0, (batch, tracks, 2))], axis=-1)
    root = rng.normal(size=(batch, tracks, 4, 4)) * np.array([6e3, 6e3, 80.0, 80.0])[:, None]
    cov = root @ np.swapaxes(root, -1, -2)
    return Belief(
        np.full(batch, steps_left), np.concatenate([places, velocity], axis=-1), mean, cov,
        np.ones((batch, tracks, platforms), dtype=bool), np.full((batch, platforms), tracks),
        np.zeros((batch, platforms)), None, np.empty((batch, 0, 3)),
    )  # fmt: skip


def commands_of(belief, policy):
    policy.reset(belief)
    return policy.act(belief, np.empty((len(belief.mean), 0)))


# ------------------------------------------------------------------------------------------------ the prediction


def expected_cost(belief, row, fields, criterion, plan, ends, steps, guard_m, discs=(), turns=False):
    """One plan's cost, written with matrices and without any of the code under test."""
    T, limit = fields.step_s, math.radians(fields.max_turn_rate_deg_s)
    phi, Q = transition(T), process_noise(T, fields.process_noise_m_s)
    var = math.radians(fields.bearing_std_deg) ** 2 / fields.detection_probability
    platforms, mean, cov = belief.platforms[row].copy(), belief.mean[row].copy(), belief.cov[row].copy()
    penalty, logs = 0.0, []
    for k in range(steps):
        leg = next((g for g, end in enumerate(ends) if k < end), len(ends) - 1)
        heading = np.arctan2(platforms[:, 3], platforms[:, 2])
        missing = (plan[leg] - heading + math.pi) % (2.0 * math.pi) - math.pi
        rate = limit * plan[leg] if turns else np.clip(missing / T, -limit, limit)
        platforms = turn(platforms, rate, T)
        mean = mean @ phi.T
        for s, m in itertools.product(range(len(platforms)), range(len(mean))):
            distance = math.dist(platforms[s, :2], mean[m, :2])
            penalty += GUARD_PER_S * T * max(0.0, 1.0 - distance / guard_m) if guard_m else 0.0
            if fields.standoff_m:
                penalty += STANDOFF_PER_S * T * max(0.0, 1.0 - distance / fields.standoff_m)
        for s, (x, y, radius) in itertools.product(range(len(platforms)), discs):
            penalty += STANDOFF_PER_S * T * max(0.0, 1.0 - math.dist(platforms[s, :2], (x, y)) / radius)
        used = range(len(platforms)) if fields.bearings == "all" else [len(platforms) - 1]
        radial = []
        for m in range(len(mean)):
            cov[m] = phi @ cov[m] @ phi.T + Q
            for s in used:
                dx, dy = mean[m, :2] - platforms[s, :2]
                H = np.array([-dy, dx, 0.0, 0.0]) / (dx**2 + dy**2)
                gain = cov[m] @ H / (H @ cov[m] @ H + var)
                cov[m] -= np.outer(gain, H @ cov[m])
            sight = mean[m, :2] - platforms[-1, :2]
            radial.append(sight @ cov[m, :2, :2] @ sight / (sight @ sight))
        logs.append(0.5 * np.log(radial).sum())
    figure = {
        "range_std": math.log(np.sqrt(radial).sum()),
        "range_variance": math.log(np.sum(radial)),
        "trace": math.log(np.trace(cov[:, :2, :2], axis1=1, axis2=2).sum()),
        "log_determinant": 0.5 * np.linalg.slogdet(cov)[1].sum(),
        "mean_log_std": np.mean(logs),
    }[criterion]
    return figure + penalty


@pytest.mark.parametrize("criterion", CRITERIA)
@pytest.mark.parametrize(("platforms", "tracks", "bearings"), [(1, 1, "all"), (2, 3, "all"), (3, 2, "reference")])
def test_costs_equal_a_plain_loop(criterion, platforms, tracks, bearings):
    fields = scenario(bearings=bearings)
    belief = random_belief(3, platforms, tracks, seed=1)._replace(steps_left=np.array([9, 20, 4]))
    rng = np.random.default_rng(2)
    plans = rng.uniform(-7.0, 7.0, (3, 5, 4, platforms))
    ends = np.sort(rng.integers(0, 12, (3, 5, 4)), axis=-1)
    start = situation(belief, fields.step_s, 12)
    assert list(start.steps) == [9, 12, 4]
    costs = Prediction(fields, criterion, guard_m=30e3).cost(start, plans, ends)
    expected = [
        [expected_cost(belief, e, fields, criterion, plans[e, c], ends[e, c], start.steps[e], 30e3) for c in range(5)]
        for e in range(3)
    ]
    np.testing.assert_allclose(costs, expected, rtol=1e-8)


def test_costs_of_held_turn_rates_equal_a_plain_loop():
    fields, belief = scenario(), random_belief(2, 2, 1, seed=3)
    plans = np.random.default_rng(4).uniform(-1.0, 1.0, (2, 3, 1, 2))
    ends = np.full((2, 3, 1), 8)
    costs = Prediction(fields, "trace", 0.0, "turns").cost(situation(belief, 5.0, 8), plans, ends)
    expected = [
        [expected_cost(belief, e, fields, "trace", plans[e, c], [8], 8, 0.0, turns=True) for c in range(3)]
        for e in range(2)
    ]
    np.testing.assert_allclose(costs, expected, rtol=1e-9)


def test_penalties_of_guard_rings_and_discs_equal_a_plain_loop():
    fields, belief = scenario(standoff_m=28e3), random_belief(2, 2, 2, seed=5)
    discs = np.random.default_rng(6).uniform(-1e4, 1e4, (2, 3, 3))
    discs[..., 2] = [2e3, 15e3, 6e3]
    plans = np.random.default_rng(7).uniform(-3.0, 3.0, (2, 4, 2, 2))
    ends = np.tile([5, 12], (2, 4, 1))
    prediction = Prediction(fields, "range_std", guard_m=33e3)
    costs = prediction.cost(situation(belief._replace(discs=discs), 5.0, 12), plans, ends)
    expected = [
        [
            expected_cost(belief, e, fields, "range_std", plans[e, c], ends[e, c], 12, 33e3, discs[e])
            for c in range(4)
        ]
        for e in range(2)
    ]  # fmt: skip
    np.testing.assert_allclose(costs, expected, rtol=1e-8)
    free = prediction.cost(situation(belief, 5.0, 12), plans, ends)
    assert (costs > free + 1.0).any()


def test_costs_of_a_large_batch_equal_those_of_its_rows():
    """The batch is cut into blocks for all cores."""
    belief, prediction = random_belief(300, 1, 2, seed=8), Prediction(scenario())
    start = situation(belief, 5.0, 10)
    plans = np.random.default_rng(9).uniform(-3.0, 3.0, (300, 2, 3, 1))
    ends = np.tile([3, 6, 10], (300, 2, 1))
    costs = prediction.cost(start, plans, ends)
    for row in (0, 149, 150, 299):
        alone = prediction.cost(start.rows([row]), plans[[row]], ends[[row]])
        assert np.array_equal(alone[0], costs[row])
    assert prediction.cost(start.rows(np.arange(0)), plans[:0], ends[:0]).shape == (0, 2)


@pytest.mark.parametrize("criterion", CRITERIA)
def test_costs_of_diverged_tracks_are_finite(criterion):
    belief = random_belief(4, 2, 1, seed=10)
    belief.mean[0], belief.cov[1], belief.mean[2], belief.cov[3] = np.nan, np.inf, 1e300, 0.0
    costs = Prediction(scenario(), criterion).cost(
        situation(belief, 5.0, 5), np.zeros((4, 2, 1, 2)), np.full((4, 2, 1), 5)
    )
    assert np.isfinite(costs).all()
    assert (costs[:2] == WORST).all()


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"criterion": "entropy"}, "criterion 'entropy'.*'trace'"),
        ({"guard_m": -1.0}, "guard_m = -1.0.*at least 0"),
        ({"guard_m": math.nan}, "guard_m = nan"),
        ({"guard_m": math.inf}, "guard_m = inf"),
        ({"horizon": 0}, "horizon = 0.*at least 1"),
        ({"horizon": 2.5}, "horizon = 2.5.*integer"),
    ],
    ids=str,
)
@pytest.mark.parametrize("kind", [Greedy, Planner, Oracle])
def test_bad_settings_are_errors_that_name_them(kind, settings, message):
    with pytest.raises(ValueError, match=message):
        kind(scenario(), **settings)


@pytest.mark.parametrize(
    ("kind", "settings", "message"),
    [
        (Greedy, {"headings": 0}, "headings = 0"),
        (Greedy, {"controls": "jumps"}, "controls 'jumps'.*'headings', 'turns'"),
        (Planner, {"segments": 0}, "segments = 0"),
        (Planner, {"samples": 7, "elites": 3}, "samples = 7.*even"),
        (Planner, {"samples": 4, "elites": 5}, "samples = 4.*elites = 5"),
        (Planner, {"elites": 0}, "elites = 0"),
        (Planner, {"iterations": 0}, "iterations = 0"),
        (Planner, {"replan_steps": True}, "replan_steps = True"),
        (Planner, {"spread_deg": 0.0}, r"spread_deg = 0.0.*\(0, 360\]"),
        (Planner, {"seed": -1}, "seed = -1"),
    ],
    ids=str,
)
def test_bad_settings_of_one_policy_are_errors_that_name_them(kind, settings, message):
    with pytest.raises(ValueError, match=message):
        kind(scenario(), **settings)


# ------------------------------------------------------------------------------------------------ greedy


@pytest.mark.parametrize("criterion", CRITERIA)
@pytest.mark.parametrize("horizon", [1, 4, 8, 12])
def test_greedy_equals_enumeration(criterion, horizon):
    """Every heading of the grid and the present one, costed one by one with plain matrices."""
    fields, belief = scenario(), random_belief(3, 1, 2, steps_left=10, seed=horizon)
    policy = Greedy(fields, horizon, criterion, headings=7)
    commands = commands_of(belief, policy)
    steps = min(horizon, 10)
    for e in range(3):
        x, y = belief.mean[e, :, :2].mean(axis=0) - belief.platforms[e, 0, :2]
        held = math.atan2(belief.platforms[e, 0, 3], belief.platforms[e, 0, 2])
        grid = [held, *(math.atan2(y, x) + math.radians(360.0 / 7.0 * i) for i in range(-3, 4))]
        costs = [expected_cost(belief, e, fields, criterion, np.array([[h]]), [steps], steps, 8e3) for h in grid]
        best = grid[int(np.argmin(costs))]
        expected = np.clip(((best - held + math.pi) % (2 * math.pi) - math.pi) / math.radians(15.0), -1.0, 1.0)
        assert commands[e, 0] == pytest.approx(expected, abs=1e-9)


def test_greedy_equals_enumeration_of_turn_rates():
    fields, belief = scenario(), random_belief(4, 1, 1, seed=11)
    commands = commands_of(belief, Greedy(fields, 4, "range_std", controls="turns"))
    rates = np.linspace(-1.0, 1.0, 9)
    for e in range(4):
        costs = [expected_cost(belief, e, fields, "range_std", np.array([[r]]), [4], 4, 8e3, turns=True) for r in rates]
        assert commands[e, 0] == pytest.approx(rates[int(np.argmin(costs))], abs=1e-12)


def test_greedy_with_two_platforms_is_no_worse_than_any_single_change():
    belief = random_belief(5, 2, 2, seed=12)
    policy = Greedy(scenario(), 8, headings=9)
    start = situation(belief, 5.0, 8)
    best = policy.best(start, belief.mean)
    candidates = policy.candidates(start, belief.mean)
    plans = np.repeat(best[:, None, None], 10, axis=1)
    plans[..., 0, 1] = candidates[:, 1]
    costs = policy.prediction.cost(start, plans, np.full((5, 10, 1), 8))
    own = policy.prediction.cost(start, best[:, None, None], np.full((5, 1, 1), 8))
    assert (own <= costs + 1e-12).all()
    held = np.arctan2(belief.platforms[..., 3], belief.platforms[..., 2])[:, None, None]
    assert (own < policy.prediction.cost(start, held, np.full((5, 1, 1), 8))).all()


# ------------------------------------------------------------------------------------------------ planner


@pytest.mark.parametrize(("platforms", "tracks"), [(1, 1), (2, 3), (4, 1)])
@pytest.mark.parametrize("criterion", ["mean_log_std", "range_std"])
def test_planner_is_never_worse_than_greedy_or_its_previous_plan(platforms, tracks, criterion):
    belief = random_belief(6, platforms, tracks, seed=13)
    planner = Planner(scenario(), criterion, samples=8, elites=3, iterations=2)
    greedy = Greedy(scenario(), 12, criterion)
    start, near = situation(belief, 5.0, 40), situation(belief, 5.0, 12)
    choice = greedy.best(near, belief.mean)[:, None, None]
    held = planner.prediction.cost(start, choice, np.full((6, 1, 1), 20))[:, 0]
    rng = np.random.default_rng(14)
    previous = type(planner._plan)(rng.uniform(-3, 3, (6, 4, platforms)), np.tile([2, 7, 12, 20], (6, 1)))
    before = planner.prediction.cost(start, previous.controls[:, None], previous.ends[:, None])[:, 0]
    planner.reset(belief)
    best, cost = planner.plan(start, planner.known_plans(start, belief.mean, previous))
    assert (cost <= held + 1e-12).all()
    assert (cost <= before + 1e-12).all()
    again = planner.prediction.cost(start, best.controls[:, None], best.ends[:, None])[:, 0]
    np.testing.assert_allclose(again, cost, rtol=1e-12)
    assert (cost < held - 1e-3).any()  # several legs are better than one


def test_planner_nears_the_optimum_of_a_fine_grid():
    """One platform, two legs: a search over all pairs of headings 5° apart."""
    belief = random_belief(8, 1, 1, steps_left=24, seed=15)
    planner = Planner(scenario(), "range_std", segments=2, samples=64, iterations=6)
    planner.reset(belief)
    start = situation(belief, 5.0, 24)
    previous = type(planner._plan)(np.zeros((8, 2, 1)), np.zeros((8, 2), dtype=np.int64))
    _, cost = planner.plan(start, planner.known_plans(start, belief.mean, previous))
    angles = np.radians(np.arange(0, 360, 5))
    pairs = np.stack(np.meshgrid(angles, angles, indexing="ij"), axis=-1).reshape(1, -1, 2, 1)
    exact = planner.prediction.cost(
        start, np.repeat(pairs, 8, axis=0), np.broadcast_to([12, 24], (8, pairs.shape[1], 2))
    ).min(axis=1)
    assert np.median(cost - exact) < 0.01
    assert (cost - exact).max() < 0.1


def test_planner_plans_at_intervals_and_flies_its_legs_in_between(monkeypatch):
    belief = random_belief(3, 1, 1, steps_left=20, seed=16)
    planner, calls = Planner(scenario(), replan_steps=4), []
    original = planner.plan
    monkeypatch.setattr(planner, "plan", lambda start, known: calls.append(len(start.steps)) or original(start, known))
    planner.reset(belief)
    for k in range(9):
        planner.act(belief._replace(steps_left=belief.steps_left - k), np.empty(0))
    assert calls == [3, 3, 3]
    planner.act(belief._replace(steps_left=np.array([20, 11, 11])), np.empty(0))  # episode 0 has begun anew
    assert calls == [3, 3, 3, 1]


def test_planner_is_repeatable_and_its_seed_matters():
    belief = random_belief(4, 1, 1, seed=17)
    runs = [commands_of(belief, Planner(scenario(), seed=seed, replan_steps=1)) for seed in (1, 1)]
    assert np.array_equal(*runs)
    costs = []
    for seed in (1, 2):
        planner = Planner(scenario(), seed=seed)
        planner.reset(belief)
        start = situation(belief, 5.0, 40)
        known = planner.known_plans(start, belief.mean, planner._plan)
        costs.append(planner.plan(start, known)[1])
    assert not np.array_equal(*costs)


# ------------------------------------------------------------------------------------------------ both


def mirrored(belief):
    """The belief seen in a mirror: y becomes −y."""
    flip = np.array([1.0, -1.0, 1.0, -1.0])
    return belief._replace(
        platforms=belief.platforms * flip, mean=belief.mean * flip, cov=belief.cov * np.outer(flip, flip)
    )


POLICIES = [
    lambda: Greedy(scenario()),
    lambda: Greedy(scenario(), 1, controls="turns"),
    lambda: Planner(scenario(), samples=16),
]


@pytest.mark.parametrize("make", POLICIES)
@pytest.mark.parametrize(("platforms", "tracks"), [(1, 1), (2, 3)])
def test_mirrored_beliefs_give_mirrored_commands(make, platforms, tracks):
    belief = random_belief(20, platforms, tracks, seed=18)
    commands = commands_of(belief, make())
    assert np.abs(commands).max() > 0.1
    np.testing.assert_allclose(commands_of(mirrored(belief), make()), -commands, atol=1e-6)


@pytest.mark.parametrize("make", POLICIES)
def test_commands_do_not_depend_on_the_frame(make):
    """Turning and shifting the whole scene changes nothing."""
    belief, angle = random_belief(10, 2, 2, seed=19), 0.7
    c, s = math.cos(angle), math.sin(angle)
    R = np.kron(np.eye(2), [[c, -s], [s, c]])
    shift = np.array([4e3, -9e3, 0.0, 0.0])
    moved = belief._replace(
        platforms=belief.platforms @ R.T + shift, mean=belief.mean @ R.T + shift, cov=R @ belief.cov @ R.T
    )
    np.testing.assert_allclose(commands_of(moved, make()), commands_of(belief, make()), atol=1e-6)


@pytest.mark.parametrize("make", POLICIES)
def test_a_batch_decides_like_its_rows(make):
    belief = random_belief(7, 2, 2, seed=20)._replace(steps_left=np.array([1, 20, 3, 40, 5, 2, 12]))
    together = commands_of(belief, make())
    for row in range(7):
        alone = Belief(*(part[[row]] if isinstance(part, np.ndarray) else part for part in belief))
        assert np.array_equal(commands_of(alone, make())[0], together[row])


@pytest.mark.parametrize("make", POLICIES)
def test_a_pickled_belief_gives_the_same_commands(make):
    """A belief is plain numbers: nothing hangs on it from which the truth could be read."""
    belief = random_belief(3, 1, 2, seed=21)
    copy = pickle.loads(pickle.dumps(belief))
    assert np.array_equal(commands_of(copy, make()), commands_of(belief, make()))


@pytest.mark.parametrize("make", POLICIES)
def test_diverged_tracks_still_give_finite_commands(make):
    belief = random_belief(4, 1, 1, seed=22)
    belief.mean[0], belief.cov[1], belief.mean[2], belief.cov[3] = 1e12, 1e30, np.nan, np.nan
    assert np.isfinite(commands_of(belief, make())).all()


def closest_approach_m(policy, fields, belief, steps, discs=None):
    """Least distances to the predicted target and to each disc along a flight, the belief's mean being the truth."""
    target, own = belief.mean.copy(), belief.platforms.copy()
    policy.reset(belief)
    near = []
    for k in range(steps):
        now = belief._replace(steps_left=belief.steps_left - k, platforms=own, mean=target)
        own = turn(own, policy.act(now, np.empty(0)) * math.radians(fields.max_turn_rate_deg_s), fields.step_s)
        target = target + np.concatenate([target[..., 2:], np.zeros_like(target[..., 2:])], axis=-1) * fields.step_s
        near.append(np.linalg.norm(own[:, 0, :2] - target[:, 0, :2], axis=-1))
    return np.min(near, axis=0)


def approaching(range_m):
    """A target ahead that comes towards the platform, its covariance stretched along the line of sight."""
    mean = np.array([[[range_m, 0.0, -200.0, 0.0]]])
    platforms = np.array([[[0.0, 0.0, 250.0, 0.0]]])
    cov = np.diag([1e7, 1e5, 1e4, 1e4])[None, None]
    return random_belief(1)._replace(mean=mean, platforms=platforms, cov=cov, steps_left=np.array([24]))


@pytest.mark.parametrize("kind", [Greedy, Planner])
def test_the_guard_keeps_predicted_ranges_long(kind):
    belief = approaching(24e3)
    free, guarded = (
        closest_approach_m(kind(scenario(), guard_m=guard), scenario(), belief, 24)[0] for guard in (0.0, 8e3)
    )
    assert free < 5e3
    assert guarded > 7.5e3


@pytest.mark.parametrize("kind", [Greedy, Planner])
def test_stand_off_rings_are_kept(kind):
    ring = scenario(standoff_m=12e3)
    assert closest_approach_m(kind(ring, guard_m=0.0), ring, approaching(30e3), 24)[0] > 11.9e3


def test_no_go_discs_are_flown_around():
    """A disc lies across the best heading found without it."""
    belief = random_belief(6, 1, 1, seed=23)
    policy = Greedy(scenario(), 12, "range_std", guard_m=0.0)
    free = policy.best(situation(belief, 5.0, 12), belief.mean)

    def path(headings):
        own = belief.platforms
        for _ in range(12):
            rate = towards(headings, own, math.radians(15.0)) * math.radians(3.0)
            own = turn(own, rate, 5.0)
            yield own[:, 0, :2]

    end = list(path(free))[-1]
    discs = np.concatenate([end, np.full((6, 1), 5e3)], axis=-1)[:, None]
    around = policy.best(situation(belief._replace(discs=discs), 5.0, 12), belief.mean)
    distance = np.min([np.linalg.norm(place - end, axis=-1) for place in path(around)], axis=0)
    assert distance.min() > 5e3


# ------------------------------------------------------------------------------------------------ observability


@pytest.mark.parametrize(("maneuver", "rank"), [(False, 3), (True, 4)])
def test_one_platform_ranges_a_target_only_by_maneuvering(maneuver, rank):
    """Information about the initial state of a target at constant velocity: the range is missing until a turn."""
    own, target, T = np.array([[0.0, 0.0, 250.0, 0.0]]), np.array([40e3, 15e3, -120.0, 90.0]), 5.0
    information = np.zeros((4, 4))
    for k in range(40):
        phi = transition(k * T)
        J = np.zeros((4, 4))
        J[:2, :2] = fisher_information(phi @ target, own[:, :2], math.radians(0.5))
        information += phi.T @ J @ phi
        own = turn(own, np.array([math.radians(3.0) if maneuver and 10 <= k < 16 else 0.0]), T)
    scale = np.diag([1e4, 1e4, 1e2, 1e2])
    assert np.linalg.matrix_rank(scale @ information @ scale, tol=1e-6) == rank


# ------------------------------------------------------------------------------------------------ oracle


def test_the_oracle_must_be_shown_the_world():
    belief = random_belief(2)
    oracle = Oracle(scenario())
    oracle.reset(belief)
    with pytest.raises(ValueError, match=r"see\(world\)"):
        oracle.act(belief, np.empty(0))


def test_only_the_oracle_is_shown_the_world_and_it_plans_on_the_true_paths():
    fields = TwoStation(steps=6)
    oracle = make_policy("oracle", fields)
    assert sees_world(oracle)
    assert not any(sees_world(make_policy(name, fields)) for name in ("greedy", "planner", "rule"))
    simulation = Simulation(fields)
    world = simulation.begin([np.random.default_rng(seed) for seed in range(2)])
    oracle.see(world)
    start = oracle._situation(simulation.belief(world))
    np.testing.assert_array_equal(start.paths, world.tape.targets[:, 1:7, :, :2])
    record = fly(fields, oracle, 3, 0)
    assert np.isfinite(record.range_error_m).all()


def test_the_oracle_is_no_teacher():
    with pytest.raises(ValueError, match="'oracle' looks at the truth"):
        imitate(SimpleNamespace(policy=None), TwoStation(steps=2), "oracle", 2, 1, 1e-3, 0.1, 0)


# ------------------------------------------------------------------------------------------------ tuning


def test_tuning_flies_the_whole_grid_and_names_the_best():
    fields = TwoStation(steps=10)
    table = tune_zigzag(fields, [6.0, 12.0], [40.0, 90.0], episodes=4, seed=7, progress=False)
    assert [(s.leg_s, s.angle_deg) for s in table.scores] == [(6.0, 40.0), (6.0, 90.0), (12.0, 40.0), (12.0, 90.0)]
    assert table.best_final.final_m == min(s.final_m for s in table.scores)
    assert table.best_average.average_m == min(s.average_m for s in table.scores)
    assert len({s.final_m for s in table.scores}) == 4
    assert as_markdown(table).count("**") == 4


@pytest.mark.parametrize(("legs", "angles"), [([], [60.0]), ([10.0], [])])
def test_tuning_an_empty_grid_is_an_error(legs, angles):
    with pytest.raises(ValueError, match="nothing to tune"):
        tune_zigzag(TwoStation(), legs, angles, 2, 0)


def test_towards_turns_the_shorter_way_at_most_at_the_limit():
    platforms = np.array([[0.0, 0.0, -250.0, 10.0], [0.0, 0.0, 0.0, 250.0]])
    commands = towards(np.array([-3.0, math.radians(95.0)]), platforms, math.radians(15.0))
    left = 2.0 * math.pi - 3.0 - math.atan2(10.0, -250.0)
    np.testing.assert_allclose(commands, [left / math.radians(15.0), 1.0 / 3.0])
    assert np.array_equal(towards(np.array([0.0, -1.0]), platforms, math.radians(15.0)), [-1.0, -1.0])
