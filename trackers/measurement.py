"""The bearing measurement: h(x) = atan2(y − y_s, x − x_s), counter-clockwise from east, in (−π, π]."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from trackers.angles import wrap_scalar
from trackers.compiled import helper, kernel
from trackers.gaussian import Gaussian
from trackers.linalg import LOG_TWO_PI

MIN_RANGE_SQUARED = 1.0
"""A track that comes closer than 1 m to a station is linearised at 1 m: the Jacobian stays finite."""

NOISE_FLOOR = 1e-13
"""A bearing's noise variance counts as at least this share of HPHᵀ: a sharper posterior than rounding can hold would
leave P indefinite. Met only by tracks some metres from a station with errors of tens of kilometres."""


class BearingUpdate(NamedTuple):
    """Result of conditioning a track on one bearing.

    Attributes:
        posterior: Gaussian, mean [..., 4], cov [..., 4, 4].
        innovation: [...] rad, wrapped.
        innovation_var: [...] rad².
        log_likelihood: [...] of the bearing under the prior.
    """

    posterior: Gaussian
    innovation: Any
    innovation_var: Any
    log_likelihood: Any


def bearing(position, station):
    """Bearing [...] rad from `station` [..., 2] to `position` [..., ≥2], metres, counter-clockwise from east."""
    dx, dy = (np.asarray(position)[..., i] - np.asarray(station)[..., i] for i in (0, 1))
    return np.arctan2(dy, dx)


def bearing_jacobian(position, station):
    """∂h/∂(x, y) [..., 2] rad/m: [−dy, dx] / r². Source: Xiu et al. (2002), eq 32."""
    dx, dy = (np.asarray(position)[..., i] - np.asarray(station)[..., i] for i in (0, 1))
    r2 = np.maximum(dx * dx + dy * dy, MIN_RANGE_SQUARED)
    return np.stack([-dy / r2, dx / r2], axis=-1)


@helper
def slope(x, y, sx, sy):
    """The two non-zero Jacobian entries [rad/m] of the bearing."""
    dx, dy = x - sx, y - sy
    per_r2 = 1.0 / max(dx * dx + dy * dy, MIN_RANGE_SQUARED)
    return -dy * per_r2, dx * per_r2


@helper
def linearize(x, y, sx, sy):
    """Predicted bearing [rad] and the two non-zero Jacobian entries [rad/m]."""
    a, b = slope(x, y, sx, sy)
    return math.atan2(y - sy, x - sx), a, b


@helper
def curvature(P, a, b):
    """½ tr(H_xx P H_xx P) [rad²], the variance a bearing's curvature adds, for slopes a, b and P [4, 4].

    The Hessian is H_xx = [[−2ab, a² − b²], [a² − b², 2ab]] in x and y, zero in velocity. In the frame of the line of
    sight the figure is (σ_r² σ_c² + σ_rc²) / r⁴: it counts where range is poorly known compared with itself.
    """
    c, d = 2.0 * a * b, a * a - b * b
    m00, m01 = d * P[0, 1] - c * P[0, 0], d * P[1, 1] - c * P[0, 1]
    m10, m11 = d * P[0, 0] + c * P[0, 1], d * P[0, 1] + c * P[1, 1]
    return 0.5 * (m00 * m00 + 2.0 * m01 * m10 + m11 * m11)


@helper
def update_into(x, P, z, sx, sy, var, second_order, x_out, P_out):
    """EKF update of x [4], P [4, 4] with one bearing, Joseph form, written to x_out, P_out; returns ν, S.

    `second_order`: whether the bearing's curvature adds to its variance. The output may be the input itself.
    """
    h, a, b = linearize(x[0], x[1], sx, sy)
    nu = wrap_scalar(z - h)
    if second_order:
        var += curvature(P, a, b)
    return nu, condition_into(x, P, nu, a, b, var, x_out, P_out)


@helper
def condition_into(x, P, nu, a, b, var, x_out, P_out):
    """Condition x [4], P [4, 4] on an innovation ν with Jacobian H = [a, b, 0, 0]; returns S.

    P' = (I − KH) P (I − KH)ᵀ + K σ² Kᵀ, written out for this H; the upper triangle is computed and mirrored.
    """
    p00, p01, p02, p03 = P[0, 0], P[0, 1], P[0, 2], P[0, 3]
    p11, p12, p13, p22, p23, p33 = P[1, 1], P[1, 2], P[1, 3], P[2, 2], P[2, 3], P[3, 3]
    f0, f1, f2, f3 = a * p00 + b * p01, a * p01 + b * p11, a * p02 + b * p12, a * p03 + b * p13
    hph = a * f0 + b * f1
    var = max(var, NOISE_FLOOR * hph)
    S = hph + var
    per_S = 1.0 / S
    k0, k1, k2, k3 = f0 * per_S, f1 * per_S, f2 * per_S, f3 * per_S
    x_out[0], x_out[1] = x[0] + k0 * nu, x[1] + k1 * nu
    x_out[2], x_out[3] = x[2] + k2 * nu, x[3] + k3 * nu
    # With f = PHᵀ and g = σ²K − (I − KH)PHᵀ the Joseph form is P − K fᵀ + g Kᵀ.
    g0, g1 = var * k0 - (f0 - k0 * hph), var * k1 - (f1 - k1 * hph)
    g2, g3 = var * k2 - (f2 - k2 * hph), var * k3 - (f3 - k3 * hph)
    P_out[0, 0] = p00 - k0 * f0 + g0 * k0
    P_out[1, 1] = p11 - k1 * f1 + g1 * k1
    P_out[2, 2] = p22 - k2 * f2 + g2 * k2
    P_out[3, 3] = p33 - k3 * f3 + g3 * k3
    P_out[0, 1] = P_out[1, 0] = p01 - k0 * f1 + g0 * k1
    P_out[0, 2] = P_out[2, 0] = p02 - k0 * f2 + g0 * k2
    P_out[0, 3] = P_out[3, 0] = p03 - k0 * f3 + g0 * k3
    P_out[1, 2] = P_out[2, 1] = p12 - k1 * f2 + g1 * k2
    P_out[1, 3] = P_out[3, 1] = p13 - k1 * f3 + g1 * k3
    P_out[2, 3] = P_out[3, 2] = p23 - k2 * f3 + g2 * k3
    return S


@helper
def log_normal(nu, S):
    """log N(ν; 0, S) of a scalar innovation."""
    return -0.5 * (LOG_TWO_PI + math.log(S) + nu * nu / S)


@kernel("(x),(x,x),(),(p),(),()->(x),(x,x),(),(),()", "fffffbfffff")
def _update(x, P, z, station, std, second_order, x_out, P_out, nu_out, S_out, ll_out):
    nu, S = update_into(x, P, z, station[0], station[1], std * std, second_order, x_out, P_out)
    nu_out[0] = nu
    S_out[0] = S
    ll_out[0] = log_normal(nu, S)


def update(prior: Gaussian, bearing, station, bearing_std, second_order: bool = False) -> BearingUpdate:
    """Condition a track on one bearing (EKF, Joseph form).

        ν = wrap(z − h(x))    S = H P Hᵀ + σ²    K = P Hᵀ / S

    With `second_order` S also holds ½ tr(H_xx P H_xx P), the variance of the bearing's curvature under the prior:
    close to a target whose range is poorly known a bearing says less than its slope promises.

    Args:
        prior: mean [..., 4] x, y [m], vx, vy [m/s], east-north; cov [..., 4, 4].
        bearing: [...] rad, counter-clockwise from east.
        station: [..., 2] position [m].
        bearing_std: [...] rad.
        second_order: whether S holds the variance of the curvature.
    Returns:
        BearingUpdate: posterior, innovation, its variance, log-likelihood.
    Raises:
        ValueError: if the trailing axes do not fit.
    Source: Xiu et al. (2002), eqs 28, 31–36 with an absolute state; atan2 for tan⁻¹. Second order: Bar-Shalom, Li and
        Kirubarajan, Estimation with Applications to Tracking and Navigation (2001), section 10.3.2, without its
        correction of the predicted bearing, which is a wash here.
    """
    mean, cov, nu, S, log_likelihood = _update(prior.mean, prior.cov, bearing, station, bearing_std, second_order)
    return BearingUpdate(Gaussian(mean, cov), nu, S, log_likelihood)
