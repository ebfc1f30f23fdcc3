"""Do two sensors look at the same thing? Tests of a second sensor's direction before it is fused.

*Conditioned* (two degrees of freedom): the prediction is updated with sensor 0, giving (X̂_a, P_a); then

    ν_i = wrap(z_i − h_i(X̂_a)),   d² = ν_iᵀ (H_i P_a H_iᵀ + R_i)⁻¹ ν_i

*Coplanarity* (one degree of freedom, no prediction needed): both lines of sight and the baseline b̂ lie in one plane,

    e = (u_0 × u_i)·b̂,   d² = e² / Σ_c σ_c² (∂e/∂c)²   over the four angles c

Both are χ² for the sensors' own noise; a direction is an outlier above the quantile of 99 %. Both follow from the
fused gate, so they reject more only where they are set tighter.
Source: Wang, Wang and Yang (2004), eqs 8–10, in the only reading with a distribution: an inverse covariance, the
predicted track as the model between the sensors. Coplanarity is ours.
"""

from __future__ import annotations

import math

import numpy as np
from scipy.stats import chi2

from trackers.angles import wrap_scalar
from trackers.compiled import helper, kernel
from trackers.direction import absorb, innovation_cov, linearize_direction, moved

NO_TEST, CONDITIONED, COPLANARITY = 0, 1, 2
TESTS = {"conditioned": (CONDITIONED, float(chi2.ppf(0.99, 2))), "coplanarity": (COPLANARITY, float(chi2.ppf(0.99, 1)))}
"""Name: number inside kernels, χ² quantile of 99 %."""


@helper
def first_valid(valid):
    """First valid slot of a sensor, −1 for none."""
    for k in range(valid.shape[0]):
        if valid[k]:
            return k
    return -1


@helper
def squared_length(nu_0, nu_1, S):
    """νᵀS⁻¹ν of an innovation for S [2, 2]."""
    root = math.sqrt(S[0, 0])
    cross = S[0, 1] / root
    a = nu_0 / root
    rest = nu_1 - cross * a
    return a * a + rest * rest / max(S[1, 1] - cross * cross, 1e-300)


@helper
def coplanarity(a, a_std, b, b_std, p, q):
    """d² of two directions a, b [2] rad from p, q [3]; 0 for platforms at one place, which nothing can contradict."""
    bx, by, bz = q[0] - p[0], q[1] - p[1], q[2] - p[2]
    length = math.sqrt(bx * bx + by * by + bz * bz)
    if length < 1.0:
        return 0.0
    bx, by, bz = bx / length, by / length, bz / length
    ca, sa, ea, fa = math.cos(a[0]), math.sin(a[0]), math.cos(a[1]), math.sin(a[1])
    cb, sb, eb, fb = math.cos(b[0]), math.sin(b[0]), math.cos(b[1]), math.sin(b[1])
    ux, uy, uz = ea * ca, ea * sa, fa
    vx, vy, vz = eb * cb, eb * sb, fb
    # e = u·(v × b̂) = v·(b̂ × u)
    mx, my, mz = vy * bz - vz * by, vz * bx - vx * bz, vx * by - vy * bx
    nx, ny, nz = by * uz - bz * uy, bz * ux - bx * uz, bx * uy - by * ux
    e = ux * mx + uy * my + uz * mz
    a0, a1 = ea * (ca * my - sa * mx), ea * mz - fa * (ca * mx + sa * my)
    b0, b1 = eb * (cb * ny - sb * nx), eb * nz - fb * (cb * nx + sb * ny)
    var = (a_std[0] * a0) ** 2 + (a_std[1] * a1) ** 2 + (b_std[0] * b0) ** 2 + (b_std[1] * b1) ** 2
    return e * e / max(var, 1e-300)


@helper
def condition_on_first(x, P, z, platform, std, available, H, column, x_out):
    """EKF update of x [6], P [6, 6] with the available components of one direction z [2]: to x_out, P in place."""
    x_out[:] = x
    h = linearize_direction(x, platform, H)
    for c in range(2):
        if available[c]:
            root = absorb(P, H[c], std[c] * std[c], column)
            y = (wrap_scalar(z[c] - h[c]) - moved(H[c], x, x_out)) / root
            for i in range(6):
                x_out[i] += column[i] * y


@kernel("(x6),(x6,x6),(s,b,a2),(s,b),(s,p3),(s,a2),(s,a2),()->(s)", "FFFBFFBiF")
def _outlier_distances(x, P, angles, valid, platforms, std, available, test, distance):
    x_a, P_a, column, H, S = x.copy(), P.copy(), np.empty(6), np.empty((2, 3)), np.empty((2, 2))
    first = first_valid(valid[0])
    distance[:] = 0.0
    if test == CONDITIONED and first >= 0:
        condition_on_first(x, P_a, angles[0, first], platforms[0], std[0], available[0], H, column, x_a)
    for s in range(1, platforms.shape[0]):
        k = first_valid(valid[s])
        if k < 0 or not (available[s, 0] and available[s, 1]):
            continue
        if test == CONDITIONED:
            h = linearize_direction(x_a, platforms[s], H)
            innovation_cov(P_a, H, std[s], S)
            distance[s] = squared_length(wrap_scalar(angles[s, k, 0] - h[0]), wrap_scalar(angles[s, k, 1] - h[1]), S)
        elif first >= 0 and available[0, 0] and available[0, 1]:
            distance[s] = coplanarity(angles[0, first], std[0], angles[s, k], std[s], platforms[0], platforms[s])


def outlier_distances(prior, scan, test: str):
    """d² [..., s] of every sensor's first valid return against sensor 0's; 0 for sensor 0 and where there is no test.

    Nothing is tested without both components of the sensor, and coplanarity not without both of sensor 0's. Without
    sensor 0 the conditioned test compares with the prediction.

    Args:
        prior: mean [..., 6], cov [..., 6, 6]; coplanarity does not use it.
        scan: `AngleScan`, leading axes as the prior's.
        test: a name in `TESTS`.
    """
    return _outlier_distances(
        prior.mean, prior.cov, scan.angles, scan.valid, scan.platforms, scan.angle_std, scan.available, TESTS[test][0]
    )
