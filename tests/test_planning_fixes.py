"""Predicted costs, greedy, planner and oracle of stations that steer by turn rate and speed and fix a position."""

import math

import numpy as np
import pytest

from agents.prediction import GUARD_PER_S, STANDOFF_PER_S
from agents.prediction_fixes import CRITERIA_FIXES, MANEUVER_NOISE_M_S2, FixPrediction
from passive_env.belief import Belief
from passive_env.catalogue.maneuvering import ManeuveringTarget
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
    scenario = ManeuveringTarget(stations=stations, **fields)
    belief = random_belief(3, stations, seed=1)._replace(steps_left=np.array([9, 20, 4]))
    plans, ends = random_plans(3, 5, 3, stations, seed=2)
    if "carrier" in fields:
        plans[:, 2:, :, stations : 2 * stations] = -1.0  # random speeds seldom let two stations measure at once
    prediction = FixPrediction(scenario, criterion, guard_m=20e3)
    start = prediction.situation(belief, 12)
    assert list(start.steps) == [9, 12, 4]
    expected = [
        [expected_cost(belief, e, scenario, criterion, plans[e, c], ends[e, c], start.steps[e], 20e3) for c in range(5)]
        for e in range(3)
    ]
    np.testing.assert_allclose(prediction.cost(start, plans, ends), expected, rtol=1e-7)
