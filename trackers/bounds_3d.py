"""How well platforms in space can range: the posterior Cramér–Rao bound on azimuths and elevations.

    J(k+1) = (Q + Φ J(k)⁻¹ Φᵀ)⁻¹ + Σ_s p_s H_sᵀ R_s⁻¹ H_s

at the true states; p is the share of scans in which a component is available (information reduction). Batches use the
covariance form, which is the EKF linearised at the truth; `posterior_bound_information_3d` is the same bound with
matrix inverses, written independently, and a test holds the two together.
Source: Tichavský, Muravchik and Nehorai, IEEE Trans. Signal Processing 46(5), 1998; scenario of Wang, Wang and Yang
(2004).
"""

from __future__ import annotations

from typing import Any

import numpy as np

from trackers.compiled import helper, kernel
from trackers.direction import absorb, direction_jacobian, linearize_direction
from trackers.linalg import psd_inverse
from trackers.motion_3d import predict_6_in_place, process_noise_3d, transition_3d

PRIOR_POSITION_STD_M = 1.0e6
"""What is known of the position before the first scan: next to nothing."""


@helper
def _look(P, truth, platforms, std, share):
    """Add one scan's expected information to the bound P [6, 6], in place."""
    H, column = np.empty((2, 3)), np.empty(6)
    for s in range(platforms.shape[0]):
        linearize_direction(truth, platforms[s], H)
        for c in range(2):
            if share[s, c] > 0.0:
                absorb(P, H[c], std[s, c] * std[s, c] / share[s, c], column)


@kernel("(x6,x6),(x6),(s,p3),(s,a2),(s,a2),(),()->(x6,x6)", "FFFFFffF")
def _advance(P, truth, platforms, std, share, T, acceleration_std, P_out):
    P_out[:] = P
    predict_6_in_place(truth.copy(), P_out, T, acceleration_std)
    _look(P_out, truth, platforms, std, share)


def advance(cov, truth, platforms, step_s, acceleration_std, angle_std, available: Any = 1.0):
    """One step of the bound: motion, then a scan.

    Args:
        cov: [..., 6, 6] bound before the step.
        truth: [..., 6] true state after it.
        platforms: [..., s, 3] m after it.
        step_s: T [s]; acceleration_std: √q [m/s²].
        angle_std: [..., s, 2] rad.
        available: share of scans in which a component is available, [..., s, 2] or one number; bool masks work too.
    Returns:
        [..., 6, 6].
    """
    return _advance(cov, truth, platforms, angle_std, _shares(available, angle_std), step_s, acceleration_std)


def bound_start(truth, platforms, angle_std, velocity_std, available: Any = 1.0, position_std_m=PRIOR_POSITION_STD_M):
    """The bound [..., 6, 6] after the first scan: a velocity prior, next to no position prior, and the scan.

    Args:
        truth: [..., 6]; platforms: [..., s, 3] m; angle_std: [..., s, 2] rad; available: as in `advance`.
        velocity_std: [3] m/s.
        position_std_m: per axis; what remains along a line of sight that nothing crosses.
    """
    prior = np.diag(np.square([position_std_m] * 3 + list(velocity_std)))
    return _bound_start(prior, truth, platforms, angle_std, _shares(available, angle_std))


@kernel("(x6,x6),(x6),(s,p3),(s,a2),(s,a2)->(x6,x6)", "FFFFFF")
def _bound_start(prior, truth, platforms, std, share, P_out):
    P_out[:] = prior
    _look(P_out, truth, platforms, std, share)


def _shares(available, angle_std):
    """Shares of one number for all components, or as given.

    Raises:
        ValueError: a share outside [0, 1].
    """
    share = np.asarray(available)
    sound = (share >= 0) & (share <= 1)
    if not sound.all():
        raise ValueError(f"available holds {share[~sound].flat[0]}: shares of scans must lie in [0, 1]")
    return np.broadcast_to(available, np.shape(angle_std)) if np.ndim(available) == 0 else available


def range_std_3d(cov, truth, platform):
    """Standard deviation √(uᵀCu) [...] m of the range from `platform` [..., 3]; cov [..., 6, 6], truth [..., 6]."""
    d = np.asarray(truth)[..., :3] - platform
    u = d / np.maximum(np.linalg.norm(d, axis=-1, keepdims=True), 1.0)
    return np.sqrt(np.maximum(np.einsum("...i,...ij,...j->...", u, np.asarray(cov)[..., :3, :3], u), 0.0))


def position_std_3d(cov):
    """Root mean square position error √tr C [...] m of cov [..., 6, 6]."""
    return np.sqrt(np.maximum(np.trace(np.asarray(cov)[..., :3, :3], axis1=-2, axis2=-1), 0.0))


def posterior_bound_information_3d(
    truth, platforms, prior_cov, angle_std, step_s, acceleration_std, available: Any = 1.0
):
    """The posterior bound along whole paths, in information form (matrix inverses).

    Args:
        truth: [..., k+1, 6]; the prior holds at index 0, its scan included.
        platforms: [..., k+1, s, 3] m; prior_cov: [..., 6, 6].
        angle_std: [..., s, 2] rad; step_s: s; acceleration_std: √q [m/s²].
        available: share of scans, one number or [..., s, 2].
    Returns:
        covariance bounds [..., k+1, 6, 6].
    """
    phi, Q = transition_3d(step_s), process_noise_3d(step_s, acceleration_std)
    weight = _shares(available, angle_std) / np.square(angle_std)
    covs = [np.broadcast_to(prior_cov, (*truth.shape[:-2], 6, 6))]
    for k in range(1, truth.shape[-2]):
        J = psd_inverse(Q + phi @ covs[-1] @ phi.T)
        H = direction_jacobian(truth[..., k, None, :], platforms[..., k, :, :])
        J[..., :3, :3] += np.einsum("...sc,...sci,...scj->...ij", weight, H, H)
        covs.append(psd_inverse(J))
    return np.stack(covs, axis=-3)
