"""Constant-velocity motion in space with accelerations held over each step.

State X = [x, y, z, vx, vy, vz] in metres and metres per second, east-north-up, absolute.

    X' = Φ X + G v,   v ~ N(0, q I₃),   Φ = [[I, T I], [0, I]],   G = [T²/2 I; T I]

The settings hold √q, an acceleration's standard deviation [m/s²] per axis.
Source: Wang, Wang and Yang (2004), eqs 1–3. Deviations: the covariance's lower-left block has T³/2 where the paper
prints T³/4 (GqGᵀ must be symmetric); absolute states with known platform positions instead of states relative to
platform 1, whose own maneuvers the paper's model leaves out.
"""

from __future__ import annotations

import numpy as np

from trackers.compiled import helper, kernel
from trackers.gaussian import Gaussian


def transition_3d(step_s: float) -> np.ndarray:
    """Φ [6, 6] over a step of `step_s` seconds."""
    phi = np.eye(6)
    phi[:3, 3:] = step_s * np.eye(3)
    return phi


def process_noise_3d(step_s: float, acceleration_std: float) -> np.ndarray:
    """q G Gᵀ [6, 6] (rank 3: never invert it); `acceleration_std` is √q in m/s²."""
    g = np.vstack([0.5 * step_s**2 * np.eye(3), step_s * np.eye(3)])
    return acceleration_std**2 * g @ g.T


@helper
def predict_6_in_place(x, P, T, acceleration_std):
    """One constant-velocity prediction of x [6] and P [6, 6], in place; velocity is read before it changes."""
    for i in range(3):
        x[i] += T * x[i + 3]
        for j in range(3):
            P[i, j] += T * (P[i, j + 3] + P[i + 3, j] + T * P[i + 3, j + 3])
    for i in range(3):
        for j in range(3):
            P[i, j + 3] += T * P[i + 3, j + 3]
            P[j + 3, i] = P[i, j + 3]
    q = acceleration_std * acceleration_std
    for i in range(3):
        P[i, i] += 0.25 * T * T * T * T * q
        P[i, i + 3] += 0.5 * T * T * T * q
        P[i + 3, i] = P[i, i + 3]
        P[i + 3, i + 3] += T * T * q


@kernel("(x6),(x6,x6),(),()->(x6),(x6,x6)", "FFffFF")
def _predict_3d(x, P, T, acceleration_std, x_out, P_out):
    x_out[:] = x
    P_out[:] = P
    predict_6_in_place(x_out, P_out, T, acceleration_std)


def predict_3d(prior: Gaussian, step_s, acceleration_std) -> Gaussian:
    """Propagate a track by one step: ΦX, ΦPΦᵀ + qGGᵀ.

    Args:
        prior: mean [..., 6] m, m/s; cov [..., 6, 6].
        step_s: T [...] s.
        acceleration_std: √q [...] m/s².
    Source: Wang, Wang and Yang (2004), eqs 1–3, corrected (see the module).
    """
    return Gaussian(*_predict_3d(prior.mean, prior.cov, step_s, acceleration_std))
