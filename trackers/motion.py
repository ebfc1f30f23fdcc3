"""Constant-velocity motion with the paper's noise input.

State x = [x, y, vx, vy] in metres and metres per second, east-north, absolute.

    x' = Φ x + G w,   w ~ N(0, q² I₂),   G = [T/2 I₂; I₂]

The noise w is a velocity increment per step, so q has the unit m/s per step (acceleration × T): one step of 10 m/s²
at T = 2 s is q = 20.
Source: Xiu et al. (2002), eqs 24–30; the paper's station-relative state with the known own displacement U is
equivalent to the absolute state used here.
"""

from __future__ import annotations

import math

import numpy as np

from trackers.compiled import helper, kernel
from trackers.gaussian import Gaussian


def transition(step_s: float) -> np.ndarray:
    """Φ [4, 4] over a step of `step_s` seconds."""
    phi = np.eye(4)
    phi[0, 2] = phi[1, 3] = step_s
    return phi


def process_noise(step_s: float, velocity_std: float) -> np.ndarray:
    """q² G Gᵀ [4, 4] (rank 2: never invert it); `velocity_std` is q in m/s per step."""
    g = np.vstack([0.5 * step_s * np.eye(2), np.eye(2)])
    return velocity_std**2 * g @ g.T


@helper
def predict_into(x, P, T, q, x_out, P_out):
    """One constant-velocity prediction of x [4] and P [4, 4], written to x_out, P_out.

    The output may be the input itself: every entry is read before any is written.
    """
    q2 = q * q
    half, quarter = 0.5 * T * q2, 0.25 * T * T * q2
    px, py, vx, vy = x[0], x[1], x[2], x[3]
    pxx, pxy, pyy = P[0, 0], P[0, 1], P[1, 1]
    vxx, vxy, vyy = P[2, 2], P[2, 3], P[3, 3]
    cxx, cxy, cyx, cyy = P[0, 2], P[0, 3], P[1, 2], P[1, 3]
    x_out[0], x_out[1], x_out[2], x_out[3] = px + T * vx, py + T * vy, vx, vy
    P_out[0, 0] = pxx + (2.0 * T * cxx + T * T * vxx + quarter)
    P_out[1, 1] = pyy + (2.0 * T * cyy + T * T * vyy + quarter)
    P_out[0, 1] = P_out[1, 0] = pxy + (T * (cxy + cyx) + T * T * vxy)
    P_out[0, 2] = P_out[2, 0] = cxx + T * vxx + half
    P_out[0, 3] = P_out[3, 0] = cxy + T * vxy
    P_out[1, 2] = P_out[2, 1] = cyx + T * vxy
    P_out[1, 3] = P_out[3, 1] = cyy + T * vyy + half
    P_out[2, 2] = vxx + q2
    P_out[3, 3] = vyy + q2
    P_out[2, 3] = P_out[3, 2] = vxy


@helper
def predict_in_place(x, P, T, q):
    """`predict_into` the input itself."""
    predict_into(x, P, T, q, x, P)


@helper
def _rotate_velocity(x, P, angle):
    """Turn the velocity of x [4] and P [4, 4] by an angle [rad], in place."""
    c, s = math.cos(angle), math.sin(angle)
    x[2], x[3] = c * x[2] - s * x[3], s * x[2] + c * x[3]
    for i in range(2):
        P[i, 2], P[i, 3] = c * P[i, 2] - s * P[i, 3], s * P[i, 2] + c * P[i, 3]
        P[2, i], P[3, i] = P[i, 2], P[i, 3]
    vxx, vxy, vyy = P[2, 2], P[2, 3], P[3, 3]
    P[2, 2] = c * c * vxx - 2.0 * c * s * vxy + s * s * vyy
    P[3, 3] = s * s * vxx + 2.0 * c * s * vxy + c * c * vyy
    P[2, 3] = P[3, 2] = c * s * (vxx - vyy) + (c * c - s * s) * vxy


@helper
def turn_in_place(x, P, T, rate, q):
    """One prediction of x [4] and P [4, 4] at a known turn rate ω [rad/s], in place; noise as in the module's model.

    The target moves along the arc's chord, vT sin(ωT/2) / (ωT/2) at ωT/2 off its course, and turns by ωT: half the
    turn, a straight step of the chord's length, the other half.
    Source: Bar-Shalom, Li and Kirubarajan (2001), section 11.7.1.
    """
    half = 0.5 * rate * T
    if half == 0.0:
        predict_in_place(x, P, T, q)
        return
    _rotate_velocity(x, P, half)
    predict_in_place(x, P, T * math.sin(half) / half, 0.0)
    _rotate_velocity(x, P, half)
    q2 = q * q
    for i in range(2):
        P[i, i] += 0.25 * T * T * q2
        P[i, i + 2] += 0.5 * T * q2
        P[i + 2, i] = P[i, i + 2]
        P[i + 2, i + 2] += q2


@kernel("(x),(x,x),(),()->(x),(x,x)")
def _predict(x, P, T, q, x_out, P_out):
    predict_into(x, P, T, q, x_out, P_out)


def predict(prior: Gaussian, step_s, velocity_std) -> Gaussian:
    """Propagate a track by one step: Φx, ΦPΦᵀ + q²GGᵀ.

    Args:
        prior: mean [..., 4] m, m/s; cov [..., 4, 4].
        step_s: T [...] s.
        velocity_std: q [...] m/s per step.
    Source: Xiu et al. (2002), eqs 29–30 with an absolute state.
    """
    return Gaussian(*_predict(prior.mean, prior.cov, step_s, velocity_std))
