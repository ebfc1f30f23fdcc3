"""Constant-velocity motion in the plane or in space, accelerations held over each step, each axis with its own noise.

State X = [p, v] with d = 2 or 3 numbers each, in metres and metres per second, absolute.

    X' = A X + G a,   a ~ N(0, diag(w)),   A = [[I, T I], [0, I]],   G = [T²/2 I; T I]

Source: Xu and Wang (2009), eqs 4 and 5. Deviation: G's lower half is T I, not I (the same at the paper's T = 1 s).
"""

from __future__ import annotations

import numpy as np

from trackers.compiled import helper


def axis_transition(step_s: float, d: int) -> np.ndarray:
    """A [2d, 2d] over a step of `step_s` seconds."""
    return np.kron([[1.0, step_s], [0.0, 1.0]], np.eye(d))


def axis_noise(step_s: float, acceleration_var) -> np.ndarray:
    """G diag(w) Gᵀ [2d, 2d] of variances w [d] (m/s²)² (rank d: never invert it)."""
    g = np.array([0.5 * step_s**2, step_s])
    return np.kron(np.outer(g, g), np.diag(acceleration_var))


@helper
def move_axes(x, P, T, d):
    """A x and A P Aᵀ of x [2d] and P [2d, 2d], in place; velocity is read before it changes."""
    for i in range(d):
        x[i] += T * x[d + i]
        for j in range(d):
            P[i, j] += T * (P[i, d + j] + P[d + i, j] + T * P[d + i, d + j])
    for i in range(d):
        for j in range(d):
            P[i, d + j] += T * P[d + i, d + j]
            P[d + j, i] = P[i, d + j]


@helper
def add_axis_noise(P, T, w, scale, d):
    """P [2d, 2d] + scale · G diag(w) Gᵀ of w [≥d], in place."""
    for i in range(d):
        q = scale * w[i]
        P[i, i] += 0.25 * T * T * T * T * q
        P[i, d + i] += 0.5 * T * T * T * q
        P[d + i, i] = P[i, d + i]
        P[d + i, d + i] += T * T * q
