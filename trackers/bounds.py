"""How well anyone can range: Fisher information of bearings, the posterior Cramér–Rao recursion, GDOP.

For linear dynamics the posterior bound obeys the Riccati recursion of an EKF that linearises at the TRUE state, so
the recursion here reuses the filter's own predict and update with a zero innovation. `posterior_bound_information`
is the same bound in information form, written independently with matrix inverses; a test holds the two together.
Source: Tichavský, Muravchik and Nehorai, "Posterior Cramér–Rao bounds for discrete-time nonlinear filtering",
IEEE Trans. Signal Processing 46(5), 1998, specialised to additive noise; scenario figures after Xiu et al. (2002).
"""

from __future__ import annotations

import math

import numpy as np

from trackers.compiled import helper, kernel
from trackers.linalg import psd_inverse
from trackers.measurement import bearing_jacobian, condition_into, slope
from trackers.motion import predict_in_place, process_noise, transition


def fisher_information(position, stations, bearing_std):
    """Fisher information of one scan of bearings about a position.

        J = Σ_s H_sᵀ H_s / σ²

    Args:
        position: [..., ≥2] m.
        stations: [..., s, 2] m.
        bearing_std: [] rad.
    Returns:
        [..., 2, 2] m⁻².
    """
    H = bearing_jacobian(np.asarray(position)[..., None, :], stations)
    return np.einsum("...si,...sj->...ij", H, H) / bearing_std**2


def gdop(position, stations, bearing_std):
    """Geometric dilution: sqrt(tr J⁻¹) [...] m, the position error of one scan; inf where the lines are collinear."""
    J = fisher_information(position, stations, bearing_std)
    det = J[..., 0, 0] * J[..., 1, 1] - J[..., 0, 1] ** 2
    trace = J[..., 0, 0] + J[..., 1, 1]
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(det > 1e-14 * trace**2, np.sqrt(trace / det), np.inf)


@helper
def range_variance(P, x, y, sx, sy):
    """Variance uᵀPu of the range from a station, u the line of sight at (x, y)."""
    dx, dy = x - sx, y - sy
    r2 = max(dx * dx + dy * dy, 1.0)
    return max((dx * dx * P[0, 0] + 2.0 * dx * dy * P[0, 1] + dy * dy * P[1, 1]) / r2, 0.0)


@kernel("(x,x),(x),(p)->()")
def _range_std(P, truth, station, out):
    out[0] = math.sqrt(range_variance(P, truth[0], truth[1], station[0], station[1]))


def range_std(cov, truth, station):
    """Standard deviation [...] m of the range from `station` [..., 2] for cov [..., 4, 4] at truth [..., 4]."""
    return _range_std(cov, truth, station)


@kernel("(x,x),(x),(s,p),(s),(),()->(x,x)", "fffbfff")
def _bound_update(P, truth, stations, used, std, detection, P_out):
    x = truth.copy()
    P_out[:] = P
    var = std * std / detection
    for s in range(stations.shape[0]):
        if used[s]:
            a, b = slope(truth[0], truth[1], stations[s, 0], stations[s, 1])
            condition_into(x, P_out, 0.0, a, b, var, x, P_out)


def bound_update(cov, truth, stations, used, bearing_std, detection_probability=1.0):
    """Add the information of a scan to the bound.

    Args:
        cov: [..., 4, 4] bound before the scan.
        truth: [..., 4] true state.
        stations: [..., s, 2] m; used: [..., s] bool, stations whose bearings count.
        bearing_std: [...] rad.
        detection_probability: [...]; missed bearings scale the expected information (information reduction factor).
    Returns:
        [..., 4, 4].
    """
    return _bound_update(cov, truth, stations, used, bearing_std, detection_probability)


@kernel("(x,x),(),()->(x,x)")
def _bound_predict(P, T, q, P_out):
    x = np.zeros(4)
    P_out[:] = P
    predict_in_place(x, P_out, T, q)


def bound_predict(cov, step_s, velocity_std):
    """Propagate the bound [..., 4, 4] by one step with process noise q [m/s per step]."""
    return _bound_predict(cov, step_s, velocity_std)


def bound_prior(truth, station, bearing_std, range_std_m, velocity_std):
    """Prior covariance [..., 4, 4]: cross-range r σ from one bearing, a radial and a velocity standard deviation.

    Args:
        truth: [..., 4]; station: [..., 2] m, the one whose bearing is known.
        bearing_std: rad; range_std_m: m; velocity_std: m/s per axis.
    """
    return _bound_prior(truth, station, bearing_std, range_std_m, velocity_std)


@kernel("(x),(p),(),(),()->(x,x)")
def _bound_prior(truth, station, std, range_std_m, velocity_std, P):
    dx, dy = truth[0] - station[0], truth[1] - station[1]
    r = max(math.hypot(dx, dy), 1.0)
    c, s = dx / r, dy / r
    cross, radial = (r * std) ** 2, range_std_m**2
    P[:] = 0.0
    P[0, 0] = radial * c * c + cross * s * s
    P[1, 1] = radial * s * s + cross * c * c
    P[0, 1] = P[1, 0] = (radial - cross) * c * s
    P[2, 2] = P[3, 3] = velocity_std**2


def posterior_bound_information(truth, stations, prior_cov, bearing_std, step_s, velocity_std):
    """The posterior bound along whole paths, in information form.

        J(k+1) = (Q + Φ J(k)⁻¹ Φᵀ)⁻¹ + Σ_s H_sᵀ H_s / σ²

    Args:
        truth: [..., k+1, 4] true states; the prior holds at index 0.
        stations: [..., k+1, s, 2] m, the stations whose bearings count.
        prior_cov: [..., 4, 4].
        bearing_std: rad; step_s: s; velocity_std: q [m/s per step].
    Returns:
        covariance bounds [..., k+1, 4, 4]; index 0 is the prior.
    """
    phi, Q = transition(step_s), process_noise(step_s, velocity_std)
    covs = [np.broadcast_to(prior_cov, (*truth.shape[:-2], 4, 4))]
    for k in range(1, truth.shape[-2]):
        J = psd_inverse(Q + phi @ covs[-1] @ phi.T)
        J[..., :2, :2] += fisher_information(truth[..., k, :], stations[..., k, :, :], bearing_std)
        covs.append(psd_inverse(J))
    return np.stack(covs, axis=-3)
