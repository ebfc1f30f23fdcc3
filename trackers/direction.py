"""The direction measurement: azimuth atan2(dy, dx) and elevation atan2(dz, ρ) of a target in space.

With d = position − platform, ρ² = dx² + dy² and r² = ρ² + dz²:

    H = [ −dy/ρ²          dx/ρ²          0     0 0 0 ]
        [ −dx dz/(ρ r²)   −dy dz/(ρ r²)  ρ/r²  0 0 0 ]

Source: Wang, Wang and Yang (2004), eqs 4–7, with atan2 for the arctangent and each platform's own range throughout
(the paper's row 4 mixes them).
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from trackers.compiled import helper, kernel
from trackers.measurement import MIN_RANGE_SQUARED, NOISE_FLOOR


def direction(position, platform):
    """Azimuth and elevation [..., 2] rad from `platform` [..., 3] to `position` [..., ≥3], metres."""
    dx, dy, dz = (np.asarray(position)[..., i] - np.asarray(platform)[..., i] for i in range(3))
    return np.stack([np.arctan2(dy, dx), np.arctan2(dz, np.hypot(dx, dy))], axis=-1)


def direction_jacobian(position, platform):
    """∂(azimuth, elevation)/∂(x, y, z) [..., 2, 3] rad/m; within 1 m of the vertical as at 1 m."""
    dx, dy, dz = (np.asarray(position)[..., i] - np.asarray(platform)[..., i] for i in range(3))
    rho2 = np.maximum(dx * dx + dy * dy, MIN_RANGE_SQUARED)
    rho, r2 = np.sqrt(rho2), rho2 + dz * dz
    azimuth = np.stack([-dy / rho2, dx / rho2, np.zeros_like(rho)], axis=-1)
    elevation = np.stack([-dx * dz / (rho * r2), -dy * dz / (rho * r2), rho / r2], axis=-1)
    return np.stack([azimuth, elevation], axis=-2)


def unit_vector(angles):
    """Line of sight [..., 3] of azimuth and elevation [..., 2] rad."""
    azimuth, elevation = angles[..., 0], angles[..., 1]
    level = np.cos(elevation)
    return np.stack([level * np.cos(azimuth), level * np.sin(azimuth), np.sin(elevation)], axis=-1)


@helper
def sight_line(azimuth, elevation, u):
    """Unit vector u [3] of a direction [rad]."""
    level = math.cos(elevation)
    u[0], u[1], u[2] = level * math.cos(azimuth), level * math.sin(azimuth), math.sin(elevation)


@helper
def linearize_direction(x, platform, H):
    """Predicted azimuth and elevation [rad] of x [≥3]; fills H [2, 3] rad/m."""
    dx, dy, dz = x[0] - platform[0], x[1] - platform[1], x[2] - platform[2]
    rho2 = max(dx * dx + dy * dy, MIN_RANGE_SQUARED)
    rho, r2 = math.sqrt(rho2), rho2 + dz * dz
    H[0, 0], H[0, 1], H[0, 2] = -dy / rho2, dx / rho2, 0.0
    H[1, 0], H[1, 1], H[1, 2] = -dx * dz / (rho * r2), -dy * dz / (rho * r2), rho / r2
    return math.atan2(dy, dx), math.atan2(dz, rho)


@helper
def absorb(P, h, var, column):
    """Condition P [6, 6] on one scalar with Jacobian h [3] over position and variance `var`, in place.

    Fills column [6] = P hᵀ / √S, the gain per standard deviation of the innovation, and returns √S. Taking components
    one after the other at one linearisation equals the stacked update, for their noises are independent; P − g gᵀ
    stays symmetric, and the floor under the noise keeps it positive where rounding would not.
    """
    for i in range(6):
        column[i] = P[i, 0] * h[0] + P[i, 1] * h[1] + P[i, 2] * h[2]
    hph = h[0] * column[0] + h[1] * column[1] + h[2] * column[2]
    root = math.sqrt(hph + max(var, NOISE_FLOOR * hph))
    for i in range(6):
        column[i] /= root
    for i in range(6):
        for j in range(i + 1):
            P[i, j] -= column[i] * column[j]
            P[j, i] = P[i, j]
    return root


@helper
def along(h, column):
    """h·g over position, for h [3] and column [6]."""
    return h[0] * column[0] + h[1] * column[1] + h[2] * column[2]


@helper
def moved(h, x, x_new):
    """h·(x_new − x) over position: the part of an innovation that other components have already explained."""
    return h[0] * (x_new[0] - x[0]) + h[1] * (x_new[1] - x[1]) + h[2] * (x_new[2] - x[2])


@helper
def direction_curvature(x, platform, P):
    """½ tr(H_xx P H_xx P) [rad²] of azimuth and elevation at x [≥3] for P [≥3, ≥3]: variance a curvature adds.

    With ρ, t, z the axes along and across the level line of sight and up, and r, t, e those of the line of sight
    itself, the Hessians are −(ρtᵀ + tρᵀ)/ρ² and −(reᵀ + erᵀ + tan(elevation) ttᵀ)/r². Both count where range is
    poorly known compared with itself.
    """
    dx, dy, dz = x[0] - platform[0], x[1] - platform[1], x[2] - platform[2]
    rho2 = max(dx * dx + dy * dy, MIN_RANGE_SQUARED)
    r2, rho = rho2 + dz * dz, math.sqrt(rho2)
    c, s = dx / rho, dy / rho
    level, rise, tangent = rho / math.sqrt(r2), dz / math.sqrt(r2), dz / rho
    cc, cs, ss = c * c, c * s, s * s
    p_rho, p_t = cc * P[0, 0] + 2.0 * cs * P[1, 0] + ss * P[1, 1], ss * P[0, 0] - 2.0 * cs * P[1, 0] + cc * P[1, 1]
    p_rho_t = cs * (P[1, 1] - P[0, 0]) + (cc - ss) * P[1, 0]
    p_rho_z, p_t_z, p_z = c * P[2, 0] + s * P[2, 1], c * P[2, 1] - s * P[2, 0], P[2, 2]
    p_r = level * level * p_rho + 2.0 * level * rise * p_rho_z + rise * rise * p_z
    p_e = rise * rise * p_rho - 2.0 * level * rise * p_rho_z + level * level * p_z
    p_r_e = level * rise * (p_z - p_rho) + (level * level - rise * rise) * p_rho_z
    p_r_t, p_e_t = level * p_rho_t + rise * p_t_z, level * p_t_z - rise * p_rho_t
    azimuth = (p_rho * p_t + p_rho_t * p_rho_t) / (rho2 * rho2)
    elevation = p_r * p_e + p_r_e * p_r_e + tangent * (0.5 * tangent * p_t * p_t + 2.0 * p_e_t * p_r_t)
    return max(azimuth, 0.0), max(elevation / (r2 * r2), 0.0)


@kernel("(x6),(x6,x6),(s,p3),(s,a2)->(s,a2)", "FFFFF")
def _std_with_curvature(x, P, platforms, std, widened):
    for s in range(platforms.shape[0]):
        azimuth, elevation = direction_curvature(x, platforms[s], P)
        widened[s, 0] = math.sqrt(std[s, 0] * std[s, 0] + azimuth)
        widened[s, 1] = math.sqrt(std[s, 1] * std[s, 1] + elevation)


def std_with_curvature(prior, platforms, angle_std):
    """Standard deviations [..., s, 2] rad of measurements about a linearised prediction: noise and curvature.

    Args:
        prior: mean [..., 6], cov [..., 6, 6].
        platforms: [..., s, 3] m; angle_std: [..., s, 2] rad.
    Source: Bar-Shalom, Li and Kirubarajan, Estimation with Applications to Tracking and Navigation (2001), section
        10.3.2: the diagonal of the second-order term of S, without its correction of the predicted measurement.
    """
    return _std_with_curvature(prior.mean, prior.cov, platforms, angle_std)


class DirectionGate(NamedTuple):
    """Where a sensor expects its target.

    Attributes:
        angles: [..., s, 2] rad, predicted azimuth and elevation.
        cov: [..., s, 2, 2] rad², innovation covariance S = H P Hᵀ + R.
        area: [..., s] rad², V = π γ √det S.
    """

    angles: Any
    cov: Any
    area: Any


@helper
def innovation_cov(P, H, std, S):
    """S [2, 2] = H P Hᵀ + R of one sensor, for H [2, 3] and std [2]; returns its determinant."""
    for a in range(2):
        for b in range(a + 1):
            total = 0.0
            for i in range(3):
                for j in range(3):
                    total += H[a, i] * P[i, j] * H[b, j]
            S[a, b] = S[b, a] = total
        S[a, a] += std[a] * std[a]
    return max(S[0, 0] * S[1, 1] - S[0, 1] * S[0, 1], 1e-300)


@kernel("(x6),(x6,x6),(s,p3),(s,a2),()->(s,a2),(s,a2,a2),(s)", "FFFFfFFF")
def _gate(x, P, platforms, std, gamma, angles, S, area):
    H = np.empty((2, 3))
    for s in range(platforms.shape[0]):
        angles[s, 0], angles[s, 1] = linearize_direction(x, platforms[s], H)
        area[s] = math.pi * gamma * math.sqrt(innovation_cov(P, H, std[s], S[s]))


def gate(mean, cov, platforms, angle_std, gamma: float) -> DirectionGate:
    """The ellipse νᵀS⁻¹ν ≤ γ each sensor searches for a predicted target.

    Args:
        mean: [..., 6]; cov: [..., 6, 6].
        platforms: [..., s, 3] m; angle_std: [..., s, 2] rad.
        gamma: γ₂.
    Source: Wang, Wang and Yang (2004), section 4.1, with one fused prediction for all sensors.
    """
    return DirectionGate(*_gate(mean, cov, platforms, angle_std, gamma))
