"""The predicted cost of plans of stations whose bearings become position fixes (see `agents.prediction`).

A plan says where every station heads and how fast it moves. The tracker of a maneuvering target is predicted as a
filter at constant velocity with an effective maneuver noise, which takes one fix a scan:

    P⁻ = Φ P Φᵀ + q² G Gᵀ,   M = Σ_s hᵀ h / σ²,   W = (I + M A)⁻¹ M,   P = P⁻ − P⁻ Eᵀ W E P⁻

with A the position block of P⁻, E = [I 0] and h the slope of station s's bearing at the predicted target. M is the
inverse of the fix's covariance, so that this is the filter's own update by a fix. Where M is too flat for a fix, or
fewer than two stations measure, the scan brings nothing, as in `trackers.position_fix`.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from agents.prediction import LARGEST, WORST, Prediction, Situation, intrusion, predict_numbers
from passive_env.belief import Belief
from passive_env.kinematics import turned_at_most, turned_by
from passive_env.steering import course, towards
from trackers.angles import wrap, wrap_scalar
from trackers.compiled import helper, kernel
from trackers.measurement import slope

CRITERIA_FIXES = ("mean_position_std", "position_std", "mean_log_position_std")
"""What a plan minimises, of the position's standard deviation √(trace): the logarithm of its mean over time, the
logarithm at the end, the mean logarithm over time; summed over tracks, before the logarithm where there is one."""

MANEUVER_NOISE_M_S2 = 30.0
"""Effective maneuver noise q of the predicted filter: the acceleration of a hard turn. Plans hardly depend on it."""

FLATTEST = 1e-12
"""Where the smaller of M's two eigenvalues is below this share of the larger there is no fix."""


@helper
def _drive(level, headings, speeds, within, ends, steps, T, limit, range_of_speed, flight):
    """Places and speeds flight [k, 3] of a station after each of k steps of T seconds; legs as of `fly_legs`.

    Turn by at most `limit` rad a step towards the leg's heading, at the leg's speed, a command in [−1, 1], or at the
    lowest one while the course is farther from the heading than `within`.
    """
    x, y, heading, leg = level[0], level[1], math.atan2(level[3], level[2]), 0
    ux, uy = math.cos(heading), math.sin(heading)
    straight, hardest = turned_by(0.0, T), turned_by(limit, T)
    for k in range(steps):
        while leg < ends.shape[0] - 1 and k >= ends[leg]:
            leg += 1
        missing = wrap_scalar(headings[leg] - heading)
        turned = min(max(missing, -limit), limit)
        share = 0.5 * (min(max(speeds[leg], -1.0), 1.0) + 1.0) if abs(missing) <= within[leg] else 0.0
        speed = range_of_speed[0] + share * (range_of_speed[1] - range_of_speed[0])
        heading += turned
        c, s, along, across = turned_at_most(turned, T, limit, straight, hardest)
        x, y = x + speed * (along * ux - across * uy), y + speed * (along * uy + across * ux)
        ux, uy = c * ux - s * uy, s * ux + c * uy
        flight[k, 0], flight[k, 1], flight[k, 2] = x, y, speed


@helper
def _same(controls, ends, c, s, stations):
    """Whether station s does in plan c what it did in the plan before."""
    if c == 0:
        return False
    for g in range(ends.shape[1]):
        if ends[c, g] != ends[c - 1, g]:
            return False
        for i in range(3):
            if controls[c, g, i * stations + s] != controls[c - 1, g, i * stations + s]:
                return False
    return True


@helper
def _information(target, places, variance, fastest):
    """Three numbers of a scan's information on the position, M; zeros where it gives no fix."""
    m00 = m01 = m11 = 0.0
    looks = 0
    for s in range(places.shape[0]):
        if places[s, 2] <= fastest:
            a, b = slope(target[0], target[1], places[s, 0], places[s, 1])
            m00, m01, m11 = m00 + a * a / variance, m01 + a * b / variance, m11 + b * b / variance
            looks += 1
    trace, determinant = m00 + m11, m00 * m11 - m01 * m01
    return (m00, m01, m11) if looks > 1 and determinant > FLATTEST * trace * trace else (0.0, 0.0, 0.0)


@helper
def _fix(P, m00, m01, m11):
    """Covariance after a fix of information M, ten numbers in, ten out, row by row."""
    p00, p01, p02, p03, p11, p12, p13, p22, p23, p33 = P
    g00, g01 = 1.0 + m00 * p00 + m01 * p01, m00 * p01 + m01 * p11
    g10, g11 = m01 * p00 + m11 * p01, 1.0 + m01 * p01 + m11 * p11
    d = 1.0 / (g00 * g11 - g01 * g10)
    w00, w01, w11 = d * (g11 * m00 - g01 * m01), d * (g11 * m01 - g01 * m11), d * (g00 * m11 - g10 * m01)
    a0, b0 = p00 * w00 + p01 * w01, p00 * w01 + p01 * w11
    a1, b1 = p01 * w00 + p11 * w01, p01 * w01 + p11 * w11
    a2, b2 = p02 * w00 + p12 * w01, p02 * w01 + p12 * w11
    a3, b3 = p03 * w00 + p13 * w01, p03 * w01 + p13 * w11
    return (
        p00 - a0 * p00 - b0 * p01, p01 - a0 * p01 - b0 * p11, p02 - a0 * p02 - b0 * p12, p03 - a0 * p03 - b0 * p13,
        p11 - a1 * p01 - b1 * p11, p12 - a1 * p02 - b1 * p12, p13 - a1 * p03 - b1 * p13,
        p22 - a2 * p02 - b2 * p12, p23 - a2 * p03 - b2 * p13, p33 - a3 * p03 - b3 * p13,
    )  # fmt: skip


@helper
def _position_std(P):
    """Standard deviation [m] of the position, cut to a finite number."""
    return math.sqrt(min(max(P[0] + P[4], 1.0), LARGEST))


@helper
def _figure(cov, path, flight, steps, model):
    """One track's part of the criterion along a path [k, 2]."""
    criterion = int(model[7])
    P = (
        cov[0, 0], cov[0, 1], cov[0, 2], cov[0, 3], cov[1, 1],
        cov[1, 2], cov[1, 3], cov[2, 2], cov[2, 3], cov[3, 3],
    )  # fmt: skip
    total = 0.0
    for k in range(steps):
        m00, m01, m11 = _information(path[k], flight[k], model[3], model[6])
        P = _fix(predict_numbers(P, model[0], model[2]), m00, m01, m11)
        if criterion == 0:
            total += _position_std(P) / steps
        elif criterion == 2:
            total += math.log(_position_std(P)) / steps
    return _position_std(P) if criterion == 1 else total


@kernel("(s,x),(k,m,p),(m,x,x),(d,r),(),(c,g,b),(c,g),(l),(k,s,v)->(c)", "FFFFiFiFFF")
def _plan_costs(platforms, paths, cov, discs, steps, controls, ends, model, flight, cost):
    """Costs of c plans; `flight` [k, s, 3] is scratch, shared by all items of a call."""
    stations = platforms.shape[0]
    for c in range(cost.shape[0]):
        for s in range(stations):
            if _same(controls, ends, c, s, stations):
                continue  # most searches vary one station at a time
            _drive(
                platforms[s], controls[c, :, s], controls[c, :, stations + s], controls[c, :, 2 * stations + s],
                ends[c], steps, model[0], model[1], model[4:6], flight[:, s],
            )  # fmt: skip
        figure = penalty = 0.0
        for k in range(steps):
            penalty += intrusion(flight[k], paths[k], discs, model[9], model[10], model[11], model[12])
        for m in range(cov.shape[0]):
            figure += _figure(cov[m], paths[:, m], flight, steps, model)
        total = model[0] * penalty + (figure if model[7] == 2.0 else math.log(figure))
        cost[c] = total if abs(total) < WORST else WORST


class FixPrediction(Prediction):
    """Costs of plans of stations that steer by turn rate and speed.

    A plan's controls [e, c, g, 3 s] are the headings of all stations [rad], then their speeds as commands in [−1, 1],
    from the scenario's lowest to its highest, then the angles [rad] between course and heading within which they have
    these speeds; outside, a station turns at its lowest speed: on the spot, if that is 0.

    Args:
        scenario: supplies step, limits of turn rate and speed, the speed at which stations measure, noise of azimuths,
            stand-off distance.
        criterion: one of `CRITERIA_FIXES`.
        guard_m: as of `agents.prediction.Prediction`.
        controls: "headings".
    Raises:
        ValueError: as of `agents.prediction.Prediction`, or controls="turns".
    """

    criteria = CRITERIA_FIXES
    usual_criterion, usual_guard_m, usual_horizon, usual_headings = "mean_log_position_std", 0.0, 20, 16

    def __init__(
        self, scenario: Any, criterion: str | None = None, guard_m: float | None = None, controls: str = "headings"
    ):
        if controls == "turns":
            raise ValueError("controls 'turns': stations that also choose their speed are steered by 'headings'")
        super().__init__(scenario, criterion, guard_m, controls)
        top_speed, measuring_speed = self._settings[5:7]
        self.stops_to_measure = measuring_speed < top_speed
        if self.stops_to_measure:
            self.usual_horizon = int(scenario.steps)  # a drive pays late

    def held(self, platforms: np.ndarray) -> np.ndarray:
        """Controls [e, 3 s]: hold the heading, at full speed."""
        headings = course(platforms)
        return np.concatenate([headings, np.ones_like(headings), np.full_like(headings, math.pi)], axis=-1)

    def commands(self, controls: np.ndarray, belief: Belief) -> np.ndarray:
        """Turn commands towards the headings, then speeds."""
        headings, speeds, within = np.split(controls, 3, axis=-1)
        near = np.abs(wrap(headings - course(belief.platforms))) <= within
        turns = towards(headings, belief.platforms, self.turn_per_step)
        return np.concatenate([turns, np.where(near, np.clip(speeds, -1.0, 1.0), -1.0)], axis=-1)

    def _numbers(self, scenario: Any) -> tuple[float, ...]:
        std = 1e-3 * scenario.azimuth_std_mrad
        variance = std * std / scenario.detection_probability
        speeds = float(scenario.min_speed_m_s), float(scenario.top_speed_m_s), float(scenario.measuring_speed_limit_m_s)
        return (self.step_s, self.turn_per_step, MANEUVER_NOISE_M_S2 * self.step_s, variance, *speeds)

    def _costs(self, start: Situation, controls: np.ndarray, ends: np.ndarray) -> np.ndarray:
        flight = np.empty((start.paths.shape[1], start.platforms.shape[1], 3))
        return _plan_costs(*start[:5], controls, ends, np.array(self._settings), flight)
