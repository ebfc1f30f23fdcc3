"""The predicted cost of plans of stations whose bearings become position fixes (see `agents.prediction`).

A plan says where every station heads and how fast it moves. The tracker of a maneuvering target is predicted as a filter
at constant velocity with an effective maneuver noise, which takes one fix a scan:

    P⁻ = Φ P Φᵀ + q² G Gᵀ,   M = Σ_s hᵀ h / σ²,   W = (I + M A)⁻¹ M,   P = P⁻ − P⁻ Eᵀ W E P⁻

with A the position block of P⁻, E = [I 0] and h the slope of station s's bearing at the predicted target. M is the
inverse of the fix's covariance, so that this is the filter's own update by a fix. Where M is too flat for a fix, or
fewer than two stations measure, the scan brings nothing, as in `trackers.position_fix`.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from agents.prediction import LARGEST, STANDOFF_PER_S, WORST, Prediction, Situation, depth, predict_numbers
from passive_env.belief import Belief
from passive_env.kinematics import arc
from trackers.angles import wrap_scalar
from trackers.compiled import helper, kernel
from trackers.measurement import slope

CRITERIA_FIXES = ("mean_position_std", "position_std", "mean_log_position_std")
"""What a plan minimises, of the position's standard deviation √(trace): the logarithm of its mean over time, the
logarithm at the end, the mean logarithm over time; summed over tracks, before the logarithm where there is one."""

FLATTEST = 1e-12
"""Where the smaller of M's two eigenvalues is below this share of the larger there is no fix."""


@helper
def _drive(level, headings, speeds, ends, steps, T, limit, range_of_speed, flight):
    """Places and speeds flight [k, 3] of a station after each of k steps of T seconds; legs as of `fly_legs`.

    Turn by at most `limit` rad a step towards the leg's heading, at the leg's speed, a command in [−1, 1].
    """
    x, y, heading, leg = level[0], level[1], math.atan2(level[3], level[2]), 0
    for k in range(steps):
        while leg < ends.shape[0] - 1 and k >= ends[leg]:
            leg += 1
        turned = min(max(wrap_scalar(headings[leg] - heading), -limit), limit)
        share = 0.5 * (min(max(speeds[leg], -1.0), 1.0) + 1.0)
        speed = range_of_speed[0] + share * (range_of_speed[1] - range_of_speed[0])
        forward, left = arc(speed, 0.0, turned / T, T)
        c, s = math.cos(heading), math.sin(heading)
        x, y = x + c * forward - s * left, y + s * forward + c * left
        heading += turned
        flight[k, 0], flight[k, 1], flight[k, 2] = x, y, speed


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
    criterion = int(model[6])
    P = (
        cov[0, 0], cov[0, 1], cov[0, 2], cov[0, 3], cov[1, 1],
        cov[1, 2], cov[1, 3], cov[2, 2], cov[2, 3], cov[3, 3],
    )  # fmt: skip
    total = 0.0
    for k in range(steps):
        m00, m01, m11 = _information(path[k], flight[k], model[3], model[7])
        P = _fix(predict_numbers(P, model[0], model[2]), m00, m01, m11)
        if criterion == 0:
            total += _position_std(P) / steps
        elif criterion == 2:
            total += math.log(_position_std(P)) / steps
    return _position_std(P) if criterion == 1 else total


@kernel("(s,x),(k,m,p),(m,x,x),(),(c,g,b),(c,g),(l),(k,s,v)->(c)", "FFFiFiFFF")
def _plan_costs(platforms, paths, cov, steps, controls, ends, model, flight, cost):
    """Costs of c plans; `flight` [k, s, 3] is scratch, shared by all items of a call."""
    stations = platforms.shape[0]
    for c in range(cost.shape[0]):
        for s in range(stations):
            headings, speeds = controls[c, :, s], controls[c, :, stations + s]
            _drive(platforms[s], headings, speeds, ends[c], steps, model[0], model[1], model[4:6], flight[:, s])
        figure = penalty = 0.0
        for m in range(cov.shape[0]):
            figure += _figure(cov[m], paths[:, m], flight, steps, model)
            if model[8] > 0.0:
                for k in range(steps):
                    for s in range(stations):
                        dx, dy = flight[k, s, 0] - paths[k, m, 0], flight[k, s, 1] - paths[k, m, 1]
                        penalty += model[9] * depth(dx, dy, model[8])
        total = model[0] * penalty + (figure if model[6] == 2.0 else math.log(figure))
        cost[c] = total if abs(total) < WORST else WORST


class FixPrediction(Prediction):
    pass
