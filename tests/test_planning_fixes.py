"""Predicted costs, greedy, planner and oracle of stations that steer by turn rate and speed and fix a position."""

import itertools
import math

import numpy as np
import pytest

from agents.evaluation import fly
from agents.greedy import HALTS, FixGreedy
from agents.planner import FixOracle, FixPlanner, Plan
from agents.policy import make_policy
from agents.prediction import GUARD_PER_S, STANDOFF_PER_S, WORST
from agents.prediction_fixes import CRITERIA_FIXES, MANEUVER_NOISE_M_S2, FixPrediction
from passive_env.belief import Belief
from passive_env.catalogue.maneuvering import ManeuveringTarget
from passive_env.core import Simulation
from passive_env.kinematics import drive
from trackers.motion import process_noise, transition


def random_belief(batch=3, stations=2, steps_left=20, seed=0):
    """A track 12 to 30 km off with a full covariance; stations some kilometres apart at 0 to 250 m/s."""
    rng = np.random.default_rng(seed)
    heading, speed = rng.uniform(-math.pi, math.pi, (batch, stations)), rng.uniform(1.0, 250.0, (batch, stations))
    velocity = speed[..., None] * np.stack([np.cos(heading), np.sin(heading)], axis=-1)
    places = rng.uniform(-4e3, 4e3, (batch, stations, 2))
    bearing, r = rng.uniform(-math.pi, math.pi, (batch, 1)), rng.uniform(12e3, 30e3, (batch, 1))
    position = r[..., None] * np.stack([np.cos(bearing), np.sin(bearing)], axis=-1)
    mean = np.concatenate([position, rng.normal(0.0, 200.0, (batch, 1, 2))], axis=-1)
    root = rng.normal(size=(batch, 1, 4, 4)) * np.array([6e2, 6e2, 80.0, 80.0])[:, None]
    return Belief(
        np.full(batch, steps_left), np.concatenate([places, velocity], axis=-1), mean, root @ np.swapaxes(root, -1, -2),
        np.ones((batch, 1, stations), dtype=bool), np.ones((batch, stations), dtype=np.int64),
        np.zeros((batch, 2 * stations)), None, np.empty((batch, 0, 3)), np.empty((batch, 1, 0)),
        np.empty((batch, 0, 2), dtype=bool), np.full((batch, 1, 2), 0.5), np.zeros((batch, 1, 2), dtype=bool),
        np.zeros((batch, 1, 2)),
    )  # fmt: skip


def random_plans(batch, count, legs, stations, seed):
    """Headings of any size, speeds that exceed the limits now and then."""
    rng = np.random.default_rng(seed)
    headings, speeds = (
        rng.uniform(-7.0, 7.0, (batch, count, legs, stations)),
        rng.uniform(-1.2, 1.2, (batch, count, legs, stations)),
    )
    within = rng.uniform(0.0, 3.5, headings.shape)
    return np.concatenate([headings, speeds, within], axis=-1), np.sort(
        rng.integers(0, 12, (batch, count, legs)), axis=-1
    )


def commands_of(belief, policy):
    policy.reset(belief)
    return policy.act(belief, np.empty((len(belief.mean), 0)))


# ------------------------------------------------------------------------------------------------ the prediction


def expected_cost(belief, row, fields, criterion, plan, ends, steps, guard_m):
    """One plan's cost: the environment's own motion, a fix's covariance R = (Σ hᵀh/σ²)⁻¹ in a Kalman filter."""
    T, limit = fields.step_s, math.radians(fields.max_turn_rate_deg_s)
    F, Q = transition(T), process_noise(T, MANEUVER_NOISE_M_S2 * T)
    H = np.eye(2, 4)
    platforms, mean, cov = belief.platforms[row].copy(), belief.mean[row, 0].copy(), belief.cov[row, 0].copy()
    stations, penalty, stds = len(platforms), 0.0, []
    for k in range(steps):
        leg = next((g for g, end in enumerate(ends) if k < end), len(ends) - 1)
        heading = np.arctan2(platforms[:, 3], platforms[:, 2])
        missing = (plan[leg, :stations] - heading + math.pi) % (2.0 * math.pi) - math.pi
        rate = np.clip(missing / T, -limit, limit)
        waits = np.abs(missing) > plan[leg, 2 * stations :]
        share = np.where(waits, 0.0, 0.5 * (np.clip(plan[leg, stations : 2 * stations], -1.0, 1.0) + 1.0))
        speed = fields.min_speed_m_s + share * (fields.top_speed_m_s - fields.min_speed_m_s)
        platforms = drive(platforms, rate, speed, T)
        mean = F @ mean
        cov = F @ cov @ F.T + Q
        fim = np.zeros((2, 2))
        for s in range(stations):
            away = mean[:2] - platforms[s, :2]
            distance = np.hypot(*away)
            penalty += GUARD_PER_S * T * max(0.0, 1.0 - distance / guard_m) if guard_m else 0.0
            if fields.standoff_m:
                penalty += STANDOFF_PER_S * T * max(0.0, 1.0 - distance / fields.standoff_m)
            if speed[s] <= fields.measuring_speed_limit_m_s:
                h = np.array([[-away[1], away[0]]]) / distance**2
                fim += h.T @ h / (1e-3 * fields.azimuth_std_mrad) ** 2
        if np.linalg.matrix_rank(fim, tol=1e-9 * np.trace(fim)) == 2:
            S = cov[:2, :2] + np.linalg.inv(fim)
            K = cov @ H.T @ np.linalg.inv(S)
            cov = cov - K @ S @ K.T
        stds.append(math.sqrt(cov[0, 0] + cov[1, 1]))
    figure = {
        "mean_position_std": math.log(np.mean(stds)),
        "position_std": math.log(stds[-1]),
        "mean_log_position_std": np.mean(np.log(stds)),
    }[criterion]
    return figure + penalty


@pytest.mark.parametrize("criterion", CRITERIA_FIXES)
@pytest.mark.parametrize(
    ("stations", "fields"),
    [(2, {}), (3, {"standoff_m": 12e3}), (2, {"carrier": "ground"}), (4, {"min_speed_m_s": 20.0, "step_s": 2.0})],
)
def test_costs_equal_a_plain_kalman_filter(criterion, stations, fields):
    """Some plans share a station's part with the plan before."""
    scenario = ManeuveringTarget(stations=stations, **fields)
    belief = random_belief(3, stations, seed=1)._replace(steps_left=np.array([9, 20, 4]))
    plans, ends = random_plans(3, 7, 3, stations, seed=2)
    plans[:, 2:4, :, 1::stations], ends[:, 2:4] = plans[:, 1:2, :, 1::stations], ends[:, 1:2]
    if "carrier" in fields:
        plans[:, 2:, :, stations : 2 * stations] = -1.0  # random speeds seldom let two stations measure at once
    prediction = FixPrediction(scenario, criterion, guard_m=20e3)
    start = prediction.situation(belief, 12)
    assert list(start.steps) == [9, 12, 4]
    expected = [
        [expected_cost(belief, e, scenario, criterion, plans[e, c], ends[e, c], start.steps[e], 20e3) for c in range(7)]
        for e in range(3)
    ]
    np.testing.assert_allclose(prediction.cost(start, plans, ends), expected, rtol=1e-7)


def test_costs_of_a_large_batch_and_of_single_plans_are_the_same():
    belief, prediction = random_belief(300, seed=5), FixPrediction(ManeuveringTarget())
    start = prediction.situation(belief, 10)
    plans, ends = random_plans(300, 9, 3, 2, seed=6)
    costs = prediction.cost(start, plans, ends)
    for row, plan in ((0, 0), (149, 7), (150, 8), (299, 3)):
        alone = prediction.cost(start.rows([row]), plans[[row], plan : plan + 1], ends[[row], plan : plan + 1])
        assert alone[0, 0] == pytest.approx(costs[row, plan], rel=1e-12)
    assert prediction.cost(start.rows(np.arange(0)), plans[:0], ends[:0]).shape == (0, 9)


@pytest.mark.parametrize("criterion", CRITERIA_FIXES)
def test_costs_of_diverged_tracks_are_finite(criterion):
    belief = random_belief(5, seed=7)
    belief.mean[0], belief.cov[1], belief.mean[2], belief.cov[3], belief.cov[4] = np.nan, np.nan, 1e300, 0.0, 1e40
    prediction = FixPrediction(ManeuveringTarget(), criterion)
    plans, ends = random_plans(5, 2, 1, 2, seed=8)
    costs = prediction.cost(prediction.situation(belief, 20), plans, ends)
    assert np.isfinite(costs).all()
    assert (np.abs(costs) <= WORST).all()


def coasted_std(belief, row, steps):
    """Position standard deviation [m] after some steps without a fix."""
    F, Q = transition(1.0), process_noise(1.0, MANEUVER_NOISE_M_S2)
    cov = belief.cov[row, 0]
    for _ in range(steps):
        cov = F @ cov @ F.T + Q
    return math.sqrt(np.trace(cov[:2, :2]))


def test_scans_without_a_fix_bring_nothing():
    """Ground stations that drive, and stations in one line with the target."""
    belief = random_belief(3, seed=9)
    drive_on, stand = (np.tile([0.0, 0.0, speed, speed, 4.0, 4.0], (3, 1, 1, 1)) for speed in (1.0, -1.0))
    ends = np.full((3, 1, 1), 6)
    expected = [[math.log(coasted_std(belief, e, 6))] for e in range(3)]
    ground = FixPrediction(ManeuveringTarget(carrier="ground"), "position_std")
    np.testing.assert_allclose(ground.cost(ground.situation(belief, 6), drive_on, ends), expected, rtol=1e-9)
    assert (ground.cost(ground.situation(belief, 6), stand, ends) < np.array(expected) - 0.5).all()
    aircraft = FixPrediction(ManeuveringTarget(), "position_std")
    belief.platforms[..., :2] = np.array([[1e3, 2e3], [2e3, 4e3]])
    belief.mean[..., :] = np.array([10e3, 20e3, 0.0, 0.0])
    np.testing.assert_allclose(aircraft.cost(aircraft.situation(belief, 6), stand, ends), expected, rtol=1e-9)


def test_a_wider_baseline_a_nearer_target_and_a_quieter_azimuth_cost_less():
    belief = random_belief(1, seed=10)
    belief.mean[:] = [20e3, 0.0, 0.0, 0.0]
    stand = np.array([[[[0.0, 0.0, -1.0, -1.0, 4.0, 4.0]]]])

    def cost(half_baseline_m, range_m=20e3, **fields):
        belief.platforms[0] = [[0.0, half_baseline_m, 1.0, 0.0], [0.0, -half_baseline_m, 1.0, 0.0]]
        belief.mean[..., 0] = range_m
        prediction = FixPrediction(ManeuveringTarget(**fields), "position_std")
        return prediction.cost(prediction.situation(belief, 10), stand, np.full((1, 1, 1), 10))[0, 0]

    assert cost(10e3) < cost(5e3) - 0.3 < cost(1e3) - 0.9
    assert cost(5e3, 15e3) < cost(5e3) - 0.3
    assert cost(5e3, azimuth_std_mrad=0.5) == pytest.approx(cost(5e3) - math.log(2.0), abs=0.2)


# ------------------------------------------------------------------------------------------------ commands


def test_a_plans_first_step_becomes_turns_and_speeds():
    """A station farther off its heading than its angle turns at its lowest speed; else it has the plan's."""
    prediction, belief = FixPrediction(ManeuveringTarget(max_turn_rate_deg_s=5.0)), random_belief(1)
    belief.platforms[0, :, 2:] = [[100.0, 0.0], [0.0, 1e-6]]  # one flies east, one stands and looks north
    near, far = math.radians(2.0), math.radians(-100.0)
    for within, speeds in ((math.pi, [0.3, 1.0]), (math.radians(90.0), [0.3, -1.0])):
        controls = np.array([[near, 0.5 * math.pi + far, 0.3, 1.4, within, within]])
        commands = prediction.commands(controls, belief)
        np.testing.assert_allclose(commands, [[0.4, -1.0, *speeds]], atol=1e-12)


# ------------------------------------------------------------------------------------------------ greedy, planner


@pytest.mark.parametrize("stations", [2, 3])
def test_greedy_is_no_worse_than_any_single_change_and_than_all_patterns_of_sides(stations):
    """Enumerated with matrices; its last change is of the last station."""
    scenario, belief = ManeuveringTarget(stations=stations), random_belief(3, stations, seed=11)
    policy = FixGreedy(scenario, 6, headings=4)
    start = policy.prediction.situation(belief, 6)
    controls, ends = policy.plan(start, belief.mean)
    for e in range(3):

        def cost(plan, e=e):
            return expected_cost(belief, e, scenario, "mean_log_position_std", np.array([plan]), [99], 6, 0.0)

        own = cost(controls[e, 0])
        away = belief.mean[e, 0, :2] - belief.platforms[e, :, :2]
        sight = np.arctan2(away[:, 1], away[:, 0])
        for turn, within in itertools.product(range(4), (math.pi, 0.5 * math.pi)):
            other = controls[e, 0].copy()
            other[[stations - 1, 2 * stations - 1, 3 * stations - 1]] = sight[-1] + turn * 0.5 * math.pi, 1.0, within
            assert own <= cost(other) + 1e-9
        for signs in itertools.product((1.0, -1.0), repeat=stations):
            pattern = [*(sight + math.radians(80.0) * np.array(signs)), *[1.0] * stations, *[math.pi] * stations]
            assert own <= cost(pattern) + 1e-9
        heading = np.arctan2(belief.platforms[e, :, 3], belief.platforms[e, :, 2])
        assert own <= cost([*heading, *[-1.0] * stations, *[math.pi] * stations]) + 1e-9
    assert ends.shape == (3, 1)


@pytest.mark.parametrize("carrier", ["aircraft", "ground"])
def test_planner_is_never_worse_than_greedy_or_its_previous_plan(carrier):
    scenario, belief = ManeuveringTarget(carrier=carrier), random_belief(40, steps_left=60, seed=12)
    planner = FixPlanner(scenario, segments=3, spread_deg=30.0)
    start = planner.prediction.situation(belief, 60)
    held = planner.prediction.cost(start, *(part[:, None] for part in planner._greedy.plan(start, belief.mean)))[:, 0]
    controls, ends = random_plans(40, 1, planner._segments, 2, seed=13)
    before = planner.prediction.cost(start, controls, ends)[:, 0]
    planner.reset(belief)
    best, cost = planner.plan(start, planner.known_plans(start, belief.mean, Plan(controls[:, 0], ends[:, 0])))
    assert (cost <= held + 1e-9).all()
    assert (cost <= before + 1e-9).all()
    again = planner.prediction.cost(start, best.controls[:, None], best.ends[:, None])[:, 0]
    np.testing.assert_allclose(again, cost, rtol=1e-9)
    assert carrier == "ground" or (cost < held - 1e-3).any()


def test_stations_that_stop_to_measure_halt_together_on_every_other_leg_or_stay():
    scenario, belief = ManeuveringTarget(carrier="ground", ground_speed_m_s=60.0), random_belief(40, seed=14)
    policy = FixGreedy(scenario)
    assert policy.horizon == scenario.steps
    controls, ends = policy.plan(policy.prediction.situation(belief, 20), belief.mean)
    assert controls.shape == (40, 2 * HALTS, 6)
    assert (controls[:, 1::2, 2:4] == -1.0).all()
    assert (np.diff(ends, axis=1) >= 0).all()
    drives = (controls[:, 0, 2:4] == 1.0).any(axis=1)
    assert drives.sum() > 0
    stand = np.tile([0.0, 0.0, -1.0, -1.0, 4.0, 4.0], (40, 1, 1, 1))
    start = policy.prediction.situation(belief, 20)
    staying = policy.prediction.cost(start, stand, np.full((40, 1, 1), 20))[:, 0]
    found = policy.prediction.cost(start, controls[:, None], ends[:, None])[:, 0]
    assert (found <= staying + 1e-9).all()
    assert (found[drives] < staying[drives]).all()


def mirrored(belief):
    flip = np.array([1.0, -1.0, 1.0, -1.0])
    return belief._replace(
        platforms=belief.platforms * flip, mean=belief.mean * flip, cov=belief.cov * np.outer(flip, flip)
    )


POLICIES = [
    (lambda: FixGreedy(ManeuveringTarget(stations=3)), 3),
    (lambda: FixGreedy(ManeuveringTarget(carrier="ground")), 2),
    (lambda: FixPlanner(ManeuveringTarget(), samples=8, elites=4, iterations=2, horizon=30), 2),
    (lambda: make_policy("rule", ManeuveringTarget()), 2),
    (lambda: make_policy("open", ManeuveringTarget(stations=3)), 3),
]


@pytest.mark.parametrize(("make", "stations"), POLICIES)
def test_mirrored_beliefs_give_mirrored_commands(make, stations):
    belief = random_belief(20, stations, seed=15)
    commands, image = commands_of(belief, make()), commands_of(mirrored(belief), make())
    assert np.abs(commands[:, :stations]).max() > 0.1
    np.testing.assert_allclose(image, commands * ([-1.0] * stations + [1.0] * stations), atol=1e-6)


@pytest.mark.parametrize(("make", "stations"), POLICIES)
def test_a_batch_decides_like_its_rows(make, stations):
    belief = random_belief(5, stations, seed=16)._replace(steps_left=np.array([1, 20, 3, 40, 5]))
    together = commands_of(belief, make())
    for row in range(5):
        alone = Belief(*(part[[row]] if isinstance(part, np.ndarray) else part for part in belief))
        np.testing.assert_allclose(commands_of(alone, make())[0], together[row], atol=1e-9)


@pytest.mark.parametrize(("make", "stations"), POLICIES)
def test_diverged_tracks_still_give_finite_commands(make, stations):
    belief = random_belief(4, stations, seed=17)
    belief.mean[0], belief.cov[1], belief.mean[2], belief.cov[3] = 1e12, 1e30, np.nan, np.nan
    assert np.isfinite(commands_of(belief, make())).all()


# ------------------------------------------------------------------------------------------------ in the environment


@pytest.fixture(scope="module")
def flown():
    """Records of policies on the same 96 episodes."""
    scenario = ManeuveringTarget()
    return {name: fly(scenario, make_policy(name, scenario), 96, 7) for name in ("fixed", "open", "rule", "greedy")}


def test_opening_the_baseline_quarters_the_error_of_fixed_stations_in_turns(flown):
    fixed, opened, rule = (np.nanmean(flown[name].turn_error_m) for name in ("fixed", "open", "rule"))
    assert rule < opened < 0.35 * fixed
    assert rule < 0.25 * fixed


def test_greedy_is_as_good_as_the_best_rule(flown):
    """It is told no angles."""
    assert np.nanmean(flown["greedy"].turn_error_m) < 1.02 * np.nanmean(flown["rule"].turn_error_m)
    assert flown["greedy"].mean.mean() < 1.02 * flown["rule"].mean.mean()
    assert flown["greedy"].mean.mean() < 0.9 * flown["open"].mean.mean()


@pytest.mark.parametrize("name", ["greedy", "planner"])
def test_stand_off_rings_are_mostly_kept(name):
    """The rule does not know of them."""
    scenario = ManeuveringTarget(standoff_m=13e3)
    found, rule = (fly(scenario, make_policy(known, scenario), 32, 7).standoff.mean() for known in (name, "rule"))
    assert rule > 0.1
    assert found < 0.5 * rule


def test_the_oracle_plans_on_the_true_path_and_bound():
    scenario = ManeuveringTarget(steps=6)
    oracle = make_policy("oracle", scenario)
    assert isinstance(oracle, FixOracle)
    simulation = Simulation(scenario)
    world = simulation.begin([np.random.default_rng(seed) for seed in range(3)])
    with pytest.raises(ValueError, match=r"must see the world before it acts"):
        oracle._situation(simulation.belief(world))
    oracle.see(world)
    start = oracle._situation(simulation.belief(world))
    np.testing.assert_array_equal(start.paths, world.tape.targets[:, 1:7, :, :2])
    np.testing.assert_array_equal(start.cov, world.bound)
    assert np.isfinite(fly(scenario, oracle, 3, 0).position_error_m).all()


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"criterion": "range_std"}, "criterion 'range_std'.*'mean_position_std', 'position_std'"),
        ({"guard_m": -1.0}, "guard_m = -1.0.*at least 0"),
        ({"horizon": 0}, "horizon = 0.*at least 1"),
    ],
    ids=str,
)
@pytest.mark.parametrize("kind", [FixGreedy, FixPlanner, FixOracle])
def test_bad_settings_are_errors_that_name_them(kind, settings, message):
    with pytest.raises(ValueError, match=message):
        kind(ManeuveringTarget(), **settings)


def test_turn_rates_to_hold_are_refused():
    with pytest.raises(ValueError, match=r"controls 'turns': .* by 'headings'"):
        FixGreedy(ManeuveringTarget(), controls="turns")
