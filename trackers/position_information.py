"""What measurements say about a position, as information Λ [3, 3] and g [3] about a prediction; helpers for kernels.

The state is [p, v] in space. Summing information over sensors is fusion; `absorb_information` turns the sum into a
posterior without inverting it, so that Λ may be singular (a single direction) or 0 (nothing measured).
"""

from __future__ import annotations

import math

from trackers.angles import wrap_scalar
from trackers.compiled import helper
from trackers.converted_measurement import averaged_at, moments_at, shrinkage
from trackers.direction import linearize_direction, sight_line
from trackers.linalg import cholesky_3, invert_3

CROSSING_STEPS = 5
"""Gauss–Newton steps from the point nearest to all lines."""


@helper
def line_into(z, line):
    """Line of sight [3] m of z = (range, azimuth, elevation)."""
    level = z[0] * math.cos(z[2])
    line[0], line[1], line[2] = level * math.cos(z[1]), level * math.sin(z[1]), z[0] * math.sin(z[2])


@helper
def debias(line, at, sensor, averaged, std, u, R):
    """Debiased position into line [3], its covariance into R [3, 3]; both evaluated at `at` [≥3], or averaged."""
    bias = (0.0, 0.0, 0.0)
    if averaged:
        bias = averaged_at(line[0], line[1], line[2], std[0], u[0], u[1], R)
    else:
        bias = moments_at(at[0] - sensor[0], at[1] - sensor[1], at[2] - sensor[2], std[0], u[0], u[1], R)
    for i in range(3):
        line[i] += sensor[i] - bias[i]


@helper
def add_position(position, info, p, total, g):
    """Add information `info` [3, 3] about a measured position [3]; returns dᵀ info d for d = position − p."""
    squared = 0.0
    for i in range(3):
        pull = 0.0
        for j in range(3):
            total[i, j] += info[i, j]
            pull += info[i, j] * (position[j] - p[j])
        g[i] += pull
        squared += pull * (position[i] - p[i])
    return squared


@helper
def add_direction(z, sensor, std, at, p, H, total, g):
    """Add the information of azimuth and elevation linearised at `at` [≥3]; returns the squared residuals at p."""
    azimuth, elevation = linearize_direction(at, sensor, H)
    squared = 0.0
    for a in range(2):
        nu = wrap_scalar(z[1] - azimuth) if a == 0 else z[2] - elevation
        for i in range(3):
            nu += H[a, i] * (at[i] - p[i])
        weight = 1.0 / (std[1 + a] * std[1 + a])
        squared += weight * nu * nu
        for i in range(3):
            g[i] += weight * nu * H[a, i]
            for j in range(3):
                total[i, j] += weight * H[a, i] * H[a, j]
    return squared


@helper
def clear_information(total, g, information):
    """Information `information` · I about the position, and g = 0."""
    for i in range(3):
        g[i] = 0.0
        for j in range(3):
            total[i, j] = information if i == j else 0.0


@helper
def move(p, total, g, cov):
    """cov [3, 3] = total⁻¹; p [3] moves by cov g."""
    invert_3(total, cov)
    for i in range(3):
        for j in range(3):
            p[i] += cov[i, j] * g[j]


@helper
def _factor(P, total, L, A, M, B, E):
    """L, A = P_vp L⁻ᵀ, M = C, B = C⁻¹Lᵀ and E = A C⁻ᵀ, each [3, 3], of `absorb_information`; returns det C."""
    i0, i1, i2 = cholesky_3(P, L)
    for i in range(3):
        A[i, 0] = P[3 + i, 0] * i0
        A[i, 1] = (P[3 + i, 1] - A[i, 0] * L[1, 0]) * i1
        A[i, 2] = (P[3 + i, 2] - A[i, 0] * L[2, 0] - A[i, 1] * L[2, 1]) * i2
    for i in range(3):
        for j in range(3):
            t = 0.0
            for k in range(j, 3):
                t += total[i, k] * L[k, j]
            B[i, j] = t
    for i in range(3):
        for j in range(i + 1):
            s = 1.0 if i == j else 0.0
            for k in range(i, 3):
                s += L[k, i] * B[k, j]
            E[i, j] = s
    i0, i1, i2 = cholesky_3(E, M)
    for j in range(3):
        B[0, j] = L[j, 0] * i0
        B[1, j] = ((L[j, 1] if j > 0 else 0.0) - M[1, 0] * B[0, j]) * i1
        B[2, j] = ((L[j, 2] if j > 1 else 0.0) - M[2, 0] * B[0, j] - M[2, 1] * B[1, j]) * i2
        E[j, 0] = A[j, 0] * i0
        E[j, 1] = (A[j, 1] - E[j, 0] * M[1, 0]) * i1
        E[j, 2] = (A[j, 2] - E[j, 0] * M[2, 0] - E[j, 1] * M[2, 1]) * i2
    return M[0, 0] * M[1, 1] * M[2, 2]


@helper
def absorb_information(x, P, total, g, x_out, P_out, L, A, M, B, E):
    """Posterior of x [6], P [6, 6] given information `total` [3, 3] and g [3]; returns gᵀ P⁺ g and log √det(I + PΛ).

    With P_pp = LLᵀ and I + LᵀΛL = CCᵀ the position's posterior is BᵀB, B = C⁻¹Lᵀ: positive whatever Λ is, even 0.
    L, A, M, B and E [3, 3] are scratch.
    """
    root = _factor(P, total, L, A, M, B, E)
    gain = 0.0
    for i in range(6):
        x_out[i] = x[i]
    for k in range(3):
        b = B[k, 0] * g[0] + B[k, 1] * g[1] + B[k, 2] * g[2]
        gain += b * b
        for i in range(3):
            x_out[i] += B[k, i] * b
            x_out[3 + i] += E[i, k] * b
    for i in range(3):
        for j in range(3):
            vp, vv = 0.0, P[3 + i, 3 + j]
            for k in range(3):
                vp += E[i, k] * B[k, j]
                vv += E[i, k] * E[j, k] - A[i, k] * A[j, k]
            P_out[3 + i, j], P_out[j, 3 + i], P_out[3 + i, 3 + j] = vp, vp, vv
            P_out[i, j] = B[0, i] * B[0, j] + B[1, i] * B[1, j] + B[2, i] * B[2, j]
    return gain, math.log(root)


@helper
def fill_shrinkages(std, u):
    """u [n, 2] of azimuth and elevation."""
    for s in range(std.shape[0]):
        u[s, 0], u[s, 1] = shrinkage(std[s, 1]), shrinkage(std[s, 2])


# -- start ------------------------------------------------------------------------------------------------------------


@helper
def any_ranging(ranging):
    """Whether one sensor or more measures range."""
    found = False
    for i in range(ranging.shape[0]):
        found = found or ranging[i]
    return found


@helper
def cross_directions(z, sensors, std, expected_range, p, total, g, cov, H, m, u):
    """Position p [3] and cov [3, 3] where the directions cross, under a prior `expected_range` wide."""
    n, weak = sensors.shape[0], 1.0 / (expected_range * expected_range)
    for i in range(3):
        m[i] = 0.0
    for s in range(n):
        sight_line(z[s, 1], z[s, 2], u)
        for i in range(3):
            m[i] += (sensors[s, i] + expected_range * u[i]) / n
    clear_information(total, g, weak)
    for s in range(n):
        sight_line(z[s, 1], z[s, 2], u)
        weight, along = weak / (std[s, 1] * std[s, 2]), 0.0
        for j in range(3):
            along += u[j] * (sensors[s, j] - m[j])
        for i in range(3):
            g[i] += weight * (sensors[s, i] - m[i] - u[i] * along)
            for j in range(3):
                total[i, j] += weight * ((1.0 if i == j else 0.0) - u[i] * u[j])
    for i in range(3):
        p[i] = m[i]
    move(p, total, g, cov)
    for _ in range(CROSSING_STEPS):
        clear_information(total, g, weak)
        for i in range(3):
            g[i] = weak * (m[i] - p[i])
        for s in range(n):
            add_direction(z[s], sensors[s], std[s], p, p, H, total, g)
        move(p, total, g, cov)


@helper
def _one_point(x, P, p, R, velocity_std):
    """Track at a measured position, its velocity 0 ± velocity_std."""
    for i in range(3):
        x[i], x[3 + i] = p[i], 0.0
        for j in range(3):
            P[i, j], P[i, 3 + j], P[3 + i, j] = R[i, j], 0.0, 0.0
            P[3 + i, 3 + j] = velocity_std * velocity_std if i == j else 0.0


@helper
def _two_point(x, P, p, R, T, q, x_out, P_out):
    """Track of the first scan's position in x [6], P [6, 6] and the second's p [3], R [3, 3]."""
    for i in range(3):
        x_out[3 + i] = (p[i] - x[i]) / T
        x_out[i] = p[i]
    for i in range(3):
        for j in range(3):
            vv = (P[i, j] + R[i, j]) / (T * T) + (0.25 * T * T * q * q if i == j else 0.0)
            P_out[i, j], P_out[i, 3 + j], P_out[3 + i, j] = R[i, j], R[i, j] / T, R[i, j] / T
            P_out[3 + i, 3 + j] = vv


@helper
def start_track(x, P, p, R, second, T, q, velocity_std, x_out, P_out):
    """A track's first state at p [3], R [3, 3], or its second with the first in x, P."""
    if second:
        _two_point(x, P, p, R, T, q, x_out, P_out)
    else:
        _one_point(x_out, P_out, p, R, velocity_std)
