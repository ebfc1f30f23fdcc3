"""Predicted costs, greedy, planner and oracle in space: the same plans as in the plane, on azimuths and elevations."""

import itertools
import math

import numpy as np
import pytest
from twin_worlds import fly as fly_world

from agents.evaluation import fly
from agents.greedy import Greedy
from agents.planner import Oracle, Planner
from agents.policy import make_policy
from agents.prediction import GUARD_PER_S, STANDOFF_PER_S, WORST
from agents.prediction_3d import CRITERIA_3D, PRIOR_SCANS, Prediction3D
from passive_env.belief import Belief
from passive_env.catalogue.angle_fusion import AngleFusion
from passive_env.core import Simulation
from passive_env.kinematics import turn_and_climb
from trackers.direction import direction_jacobian
from trackers.motion_3d import process_noise_3d, transition_3d

NO_LIMITS = np.array([-1e9, 1e9])
SHARE = np.array([0.9, 0.4])


def scenario(**fields):
    """Both sensors drop out, with shares that are known; unequal noises; no stand-off."""
    shares = {f"availability{p}_{end}": SHARE[p] for p in range(2) for end in ("min", "max")}
    values = {"azimuth_std_deg": 0.4, "elevation_std_deg": 0.7, "detection_probability": 0.8, "standoff_m": 0.0}
    return AngleFusion(**{**values, **shares, **fields})


def random_belief(batch=3, tracks=1, steps_left=20, seed=0):
    """Tracks 12 to 40 km off with full covariances, platforms at 150 m/s."""
    rng = np.random.default_rng(seed)
    heading = rng.uniform(-math.pi, math.pi, (batch, 2))
    level = 150.0 * np.stack([np.cos(heading), np.sin(heading), 0.0 * heading], axis=-1)
    places = rng.uniform([-6e3, -6e3, 5e3], [6e3, 6e3, 8e3], (batch, 2, 3))
    bearing, r = rng.uniform(-math.pi, math.pi, (batch, tracks)), rng.uniform(12e3, 40e3, (batch, tracks))
    height = rng.uniform(4e3, 11e3, (batch, tracks))
    position = np.stack([r * np.cos(bearing), r * np.sin(bearing), height], axis=-1)
    mean = np.concatenate([position, rng.normal(0.0, 100.0, (batch, tracks, 3))], axis=-1)
    root = rng.normal(size=(batch, tracks, 6, 6)) * np.array([1e3, 1e3, 3e2, 80.0, 80.0, 30.0])[:, None]
    return Belief(
        np.full(batch, steps_left), np.concatenate([places, level], axis=-1), mean, root @ np.swapaxes(root, -1, -2),
        np.ones((batch, tracks, 2), dtype=bool), np.ones((batch, 2), dtype=np.int64), np.zeros((batch, 4)), None,
        np.empty((batch, 0, 3)), np.zeros((batch, tracks, 2)), np.ones((batch, 2, 2), dtype=bool),
    )  # fmt: skip


def commands_of(belief, policy):
    policy.reset(belief)
    return policy.act(belief, np.empty((len(belief.mean), 0)))


# ------------------------------------------------------------------------------------------------ the prediction


def expected_cost(belief, row, fields, criterion, plan, ends, steps, guard_m, turns=False):
    """One plan's cost, written with matrices in information form and without any of the code under test."""
    T, limit = fields.step_s, math.radians(fields.max_turn_rate_deg_s)
    phi, Q = transition_3d(T), process_noise_3d(T, fields.process_noise_m_s2)
    weights = np.diag([math.radians(std) ** -2 for std in (fields.azimuth_std_deg, fields.elevation_std_deg)])
    platforms, mean, cov = belief.platforms[row].copy(), belief.mean[row].copy(), belief.cov[row].copy()
    penalty, logs = 0.0, {"range": [], "position": []}
    for k in range(steps):
        leg = next((g for g, end in enumerate(ends) if k < end), len(ends) - 1)
        heading = np.arctan2(platforms[:, 4], platforms[:, 3])
        missing = (plan[leg] - heading + math.pi) % (2.0 * math.pi) - math.pi
        rate = limit * plan[leg] if turns else np.clip(missing / T, -limit, limit)
        platforms = turn_and_climb(platforms, rate, np.zeros(2), T, NO_LIMITS)
        mean = mean @ phi.T
        for s, m in itertools.product(range(2), range(len(mean))):
            distance = math.dist(platforms[s, :3], mean[m, :3])
            penalty += GUARD_PER_S * T * max(0.0, 1.0 - distance / guard_m) if guard_m else 0.0
            if fields.standoff_m:
                penalty += STANDOFF_PER_S * T * max(0.0, 1.0 - distance / fields.standoff_m)
        radial, traces = [], []
        for m in range(len(mean)):
            J = np.linalg.inv(phi @ cov[m] @ phi.T + Q)
            for s in range(2):
                H = direction_jacobian(mean[m], platforms[s, :3])
                J[:3, :3] += SHARE[s] * fields.detection_probability * H.T @ weights @ H
            cov[m] = np.linalg.inv(J)
            sight = mean[m, :3] - platforms[0, :3]
            radial.append(sight @ cov[m, :3, :3] @ sight / (sight @ sight))
            traces.append(np.trace(cov[m, :3, :3]))
        logs["range"].append(0.5 * np.log(radial).sum())
        logs["position"].append(0.5 * np.log(traces).sum())
    figure = {
        "range_std": math.log(np.sqrt(radial).sum()),
        "range_variance": math.log(np.sum(radial)),
        "trace": math.log(np.sum(traces)),
        "log_determinant": 0.5 * np.linalg.slogdet(cov)[1].sum(),
        "mean_log_std": np.mean(logs["range"]),
        "mean_log_position_std": np.mean(logs["position"]),
        "position_std": math.log(np.sqrt(traces).sum()),
    }[criterion]
    return figure + penalty


@pytest.mark.parametrize("criterion", CRITERIA_3D)
@pytest.mark.parametrize(("tracks", "standoff_m"), [(1, 0.0), (2, 15e3)])
def test_costs_equal_a_plain_loop(criterion, tracks, standoff_m):
    """More plans than are computed side by side, some of which share a platform's headings with their neighbours."""
    fields = scenario(standoff_m=standoff_m, range_min_m=30e3)
    belief = random_belief(3, tracks, seed=1)._replace(steps_left=np.array([9, 20, 4]))
    rng = np.random.default_rng(2)
    plans = rng.uniform(-7.0, 7.0, (3, 13, 4, 2))
    ends = np.sort(rng.integers(0, 12, (3, 13, 4)), axis=-1)
    plans[:, 3:6, :, 1], ends[:, 3:6] = plans[:, 2:3, :, 1], ends[:, 2:3]
    plans[:, 7:10, :, 0], ends[:, 7:10] = plans[:, 6:7, :, 0], ends[:, 6:7]
    prediction = Prediction3D(fields, criterion, guard_m=20e3)
    start = prediction.situation(belief, 12)
    assert list(start.steps) == [9, 12, 4]
    expected = [
        [expected_cost(belief, e, fields, criterion, plans[e, c], ends[e, c], start.steps[e], 20e3) for c in range(13)]
        for e in range(3)
    ]
    np.testing.assert_allclose(prediction.cost(start, plans, ends), expected, rtol=1e-7)


def test_costs_of_held_turn_rates_equal_a_plain_loop():
    fields, belief = scenario(), random_belief(2, seed=3)
    plans = np.random.default_rng(4).uniform(-1.0, 1.0, (2, 3, 1, 2))
    prediction = Prediction3D(fields, "trace", 0.0, "turns")
    costs = prediction.cost(prediction.situation(belief, 8), plans, np.full((2, 3, 1), 8))
    expected = [
        [expected_cost(belief, e, fields, "trace", plans[e, c], [8], 8, 0.0, turns=True) for c in range(3)]
        for e in range(2)
    ]
    np.testing.assert_allclose(costs, expected, rtol=1e-8)


def test_costs_of_a_large_batch_and_of_single_plans_are_the_same():
    belief, prediction = random_belief(300, seed=5), Prediction3D(scenario())
    start = prediction.situation(belief, 10)
    plans = np.random.default_rng(6).uniform(-3.0, 3.0, (300, 9, 3, 2))
    ends = np.tile([3, 6, 10], (300, 9, 1))
    costs = prediction.cost(start, plans, ends)
    for row, plan in ((0, 0), (149, 7), (150, 8), (299, 3)):
        alone = prediction.cost(start.rows([row]), plans[[row], plan : plan + 1], ends[[row], plan : plan + 1])
        assert alone[0, 0] == pytest.approx(costs[row, plan], rel=1e-12)
    assert prediction.cost(start.rows(np.arange(0)), plans[:0], ends[:0]).shape == (0, 9)


@pytest.mark.parametrize("criterion", CRITERIA_3D)
def test_costs_of_diverged_tracks_are_finite(criterion):
    belief = random_belief(5, seed=7)
    belief.mean[0], belief.cov[1], belief.mean[2], belief.cov[3], belief.cov[4] = np.nan, np.nan, 1e300, 0.0, 1e40
    prediction = Prediction3D(scenario(), criterion)
    costs = prediction.cost(prediction.situation(belief, 20), np.zeros((5, 2, 1, 2)), np.full((5, 2, 1), 20))
    assert np.isfinite(costs).all()
    assert (np.abs(costs) <= WORST).all()


def test_an_elevation_tells_the_height_and_an_azimuth_does_not():
    """Without elevations of any worth the height is known as badly as before; with them it is known well."""
    belief = random_belief(4, seed=8)
    plans, ends = np.zeros((4, 1, 1, 2)), np.full((4, 1, 1), 10)
    costs = [
        (prediction := Prediction3D(scenario(elevation_std_deg=std), "position_std")).cost(
            prediction.situation(belief, 10), plans, ends
        )
        for std in (0.1, 10.0)
    ]
    assert (costs[0] < costs[1] - 0.5).all()


# ------------------------------------------------------------------------------------------------ availability


def test_availability_is_estimated_from_what_the_belief_reports():
    """A middle of 0.6 counts as two scans; a new episode forgets; asking twice counts once."""
    fields = AngleFusion(availability0_min=0.2, availability1_min=0.2, detection_probability=0.5)
    prediction, belief = Prediction3D(fields), random_belief(2, steps_left=10)
    np.testing.assert_allclose(prediction.situation(belief, 4).share, 0.5 * 0.6)
    seen = np.array([[True, False], [False, False]])
    for k in (9, 8, 8):
        belief = belief._replace(steps_left=np.full(2, k), available=np.repeat(seen[..., None], 2, axis=-1))
        share = prediction.situation(belief, 4).share
    ratio = (2.0 + PRIOR_SCANS * 0.6) / (2.0 + PRIOR_SCANS)
    np.testing.assert_allclose(share[0, 0], 0.5 * ratio)
    np.testing.assert_allclose(share[1], 0.5 * max(PRIOR_SCANS * 0.6 / (2.0 + PRIOR_SCANS), 0.2))
    share = prediction.situation(belief._replace(steps_left=np.array([10, 7])), 4).share
    np.testing.assert_allclose(share[0], 0.5 * 0.6)
    assert share[1, 0] < 0.5 * 0.6


def test_the_estimate_of_availability_nears_the_truth():
    fields = AngleFusion(availability0_min=0.0, availability1_min=0.0, steps=200, course="random", standoff_m=0.0)
    simulation = Simulation(fields)
    world = simulation.begin([np.random.default_rng(seed) for seed in range(20)])
    prediction = Prediction3D(fields)
    for _ in range(200):
        share = prediction.situation(simulation.belief(world), 1).share
        world, *_ = simulation.advance(world, np.zeros((20, 4)))
    assert np.abs(share - world.tape.share).max() < 5.0 * math.sqrt(0.25 / 200) + 2.0 / 200


# ------------------------------------------------------------------------------------------------ greedy, planner


@pytest.mark.parametrize("horizon", [1, 4, 8])
def test_greedy_is_no_worse_than_any_single_change_enumerated_with_matrices(horizon):
    fields, belief = scenario(), random_belief(3, steps_left=10, seed=horizon)
    policy = Greedy(fields, horizon, headings=4)
    start = policy.prediction.situation(belief, horizon)
    best = policy.best(start, belief.mean)
    for e in range(3):
        held = np.arctan2(belief.platforms[e, :, 4], belief.platforms[e, :, 3])
        reach = horizon * math.radians(fields.max_turn_rate_deg_s) * fields.step_s
        grid = [held + reach * share for share in (-1.0, -0.5, 0.0, 0.5, 1.0)]

        def cost(plan, e=e):
            return expected_cost(belief, e, fields, "mean_log_position_std", np.array([plan]), [99], horizon, 0.0)

        own = cost(best[e])
        assert any(best[e, 0] == pytest.approx(g[0]) for g in grid)
        for g in grid:
            assert own <= cost([best[e, 0], g[1]]) + 1e-9
        pairs = [cost([one[0], other[1]]) for one in grid for other in grid]
        assert own <= min(pairs) + 0.02
    wanted = np.clip(
        (best - np.arctan2(belief.platforms[..., 4], belief.platforms[..., 3])) / math.radians(10.0), -1, 1
    )
    commands = commands_of(belief, policy)
    np.testing.assert_allclose(commands[:, :2], wanted, atol=1e-9)
    assert not commands[:, 2:].any()


def test_greedy_nearly_always_finds_the_best_pair():
    """Improving the platforms in turn is compared with all pairs."""
    belief, policy = random_belief(200, seed=9), Greedy(AngleFusion(), 8, "position_std")
    start = policy.prediction.situation(belief, 8)
    own = policy.best(start, belief.mean)[:, None, None]
    own = policy.prediction.cost(start, own, np.full((200, 1, 1), 8))[:, 0]
    candidates = policy.candidates(start, belief.mean)
    first, second = (candidates[:, s] for s in range(2))
    pairs = np.stack([np.repeat(first, 15, axis=1), np.tile(second, (1, 15))], axis=-1)[:, :, None]
    exact = policy.prediction.cost(start, pairs, np.full((200, 225, 1), 8)).min(axis=1)
    assert (own >= exact - 1e-12).all()
    assert np.mean(own < exact + 1e-9) > 0.8
    assert np.quantile(own - exact, 0.95) < 0.02


@pytest.mark.parametrize("criterion", ["mean_log_position_std", "position_std"])
def test_planner_is_never_worse_than_greedy_or_its_previous_plan(criterion):
    belief = random_belief(6, seed=10)
    planner = Planner(scenario(), criterion, samples=8, elites=3, iterations=2)
    greedy = Greedy(scenario(), 8, criterion)
    start, near = planner.prediction.situation(belief, 40), greedy.prediction.situation(belief, 8)
    held = planner.prediction.cost(start, greedy.best(near, belief.mean)[:, None, None], np.full((6, 1, 1), 20))[:, 0]
    rng = np.random.default_rng(11)
    previous = type(planner._plan)(rng.uniform(-3, 3, (6, 4, 2)), np.tile([2, 7, 12, 20], (6, 1)))
    before = planner.prediction.cost(start, previous.controls[:, None], previous.ends[:, None])[:, 0]
    planner.reset(belief)
    best, cost = planner.plan(start, planner.known_plans(start, belief.mean, previous))
    assert (cost <= held + 1e-9).all()
    assert (cost <= before + 1e-9).all()
    again = planner.prediction.cost(start, best.controls[:, None], best.ends[:, None])[:, 0]
    np.testing.assert_allclose(again, cost, rtol=1e-9)
    assert (cost < held - 1e-3).any()


def mirrored(belief):
    flip = np.array([1.0, -1.0, 1.0, 1.0, -1.0, 1.0])
    return belief._replace(
        platforms=belief.platforms * flip, mean=belief.mean * flip, cov=belief.cov * np.outer(flip, flip)
    )


POLICIES = [
    lambda: Greedy(scenario()),
    lambda: Greedy(scenario(), 2, "position_std", controls="turns"),
    lambda: Planner(scenario(), samples=8, elites=4, iterations=2),
]


@pytest.mark.parametrize("make", POLICIES)
def test_mirrored_beliefs_give_mirrored_commands(make):
    belief = random_belief(20, seed=12)
    commands = commands_of(belief, make())
    assert np.abs(commands[:, :2]).max() > 0.1
    np.testing.assert_allclose(commands_of(mirrored(belief), make()), -commands, atol=1e-6)


@pytest.mark.parametrize("make", POLICIES)
def test_a_batch_decides_like_its_rows(make):
    belief = random_belief(5, seed=13)._replace(steps_left=np.array([1, 20, 3, 40, 5]))
    together = commands_of(belief, make())
    for row in range(5):
        alone = Belief(*(part[[row]] if isinstance(part, np.ndarray) else part for part in belief))
        np.testing.assert_allclose(commands_of(alone, make())[0], together[row], atol=1e-9)


@pytest.mark.parametrize("make", POLICIES)
def test_diverged_tracks_still_give_finite_commands(make):
    belief = random_belief(4, seed=14)
    belief.mean[0], belief.cov[1], belief.mean[2], belief.cov[3] = 1e12, 1e30, np.nan, np.nan
    assert np.isfinite(commands_of(belief, make())).all()


def deepest(name, fields):
    """Greatest depth [e] inside the stand-off sphere, relative to its radius, over whole flights."""
    policy, simulation = make_policy(name, fields), Simulation(fields)
    world = simulation.begin([np.random.default_rng(seed) for seed in range(8)])
    depths = []
    policy.reset(simulation.belief(world))
    for _ in range(fields.steps):
        world, *_ = simulation.advance(world, policy.act(simulation.belief(world), simulation.observe(world)))
        depths.append(world.violations.standoff)
    return np.max(depths, axis=0)


@pytest.mark.parametrize("name", ["greedy", "planner"])
def test_stand_off_spheres_are_mostly_kept(name):
    """Head-on at 300 m/s straight flight goes deep; those that look ahead turn away, as well as they know the track."""
    fields = AngleFusion(course="paper", steps=75)
    straight, found = deepest("straight", fields), deepest(name, fields)
    assert straight.min() > 0.7
    assert found.max() < straight.min()
    assert np.median(found) < 0.1


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"criterion": "entropy"}, "criterion 'entropy'.*'mean_log_position_std', 'position_std'"),
        ({"guard_m": -1.0}, "guard_m = -1.0.*at least 0"),
        ({"horizon": 0}, "horizon = 0.*at least 1"),
    ],
    ids=str,
)
@pytest.mark.parametrize("kind", [Greedy, Planner, Oracle])
def test_bad_settings_are_errors_that_name_them(kind, settings, message):
    with pytest.raises(ValueError, match=message):
        kind(AngleFusion(), **settings)


def test_the_oracle_plans_on_the_true_path_bound_and_availability():
    fields = AngleFusion(steps=6, availability1_min=0.3, detection_probability=0.9)
    oracle = make_policy("oracle", fields)
    simulation = Simulation(fields)
    world = simulation.begin([np.random.default_rng(seed) for seed in range(3)])
    oracle.see(world)
    start = oracle._situation(simulation.belief(world))
    np.testing.assert_array_equal(start.paths, world.tape.targets[:, 1:7, :, :3])
    np.testing.assert_array_equal(start.cov, world.bound)
    np.testing.assert_allclose(start.share, 0.9 * world.tape.share)
    record = fly(fields, oracle, 3, 0)
    assert np.isfinite(record.position_error_m).all()


@pytest.mark.parametrize("name", ["greedy", "planner"])
def test_searches_beat_the_paper_on_its_own_random_courses(name):
    """Paired: the position error at the end is less than half of the paper's."""
    fields = AngleFusion()
    found, paper = (fly(fields, make_policy(known, fields), 96, 7) for known in (name, "paper"))
    assert found.final.mean() < 0.5 * paper.final.mean()
    assert found.mean.mean() < 0.7 * paper.mean.mean()


def test_greedy_flies_cluttered_worlds_with_finite_commands():
    fields = AngleFusion(clutter_mean=8.0, availability0_min=0.3, availability1_min=0.3, steps=12)
    policy = make_policy("greedy", fields)
    flown = fly_world(fields, policy.act, range(8))
    assert np.isfinite(flown.commands).all()
