"""How well range sums can tell a target's state: the posterior Cramér–Rao bound along a true path.

    J(k+1) = (Q + A J(k)⁻¹ Aᵀ)⁻¹ + Σᵢ pᵢ HᵢᵀHᵢ / σᵢ²

at the true states; pᵢ is the share of scans in which transmitter i is heard (information reduction). `advance` is the
covariance form for batches; `posterior_bound` is the same with matrix inverses, written independently, and a test
holds the two together.
Source: Tichavský, Muravchik and Nehorai, IEEE Trans. Signal Processing 46(5), 1998; scenarios of Xu and Wang (2009).
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from trackers.axis_motion import add_axis_noise, axis_noise, axis_transition, move_axes
from trackers.compiled import kernel
from trackers.linalg import psd_inverse
from trackers.position_update import copy_gaussian
from trackers.range_sum import absorb_sum, check_std, each_sum, range_sum_jacobian, range_sum_row


class PositionStd(NamedTuple):
    """Root mean square position errors [...] m of a covariance: all axes, x and y, z (0 in the plane)."""

    position: Any
    horizontal: Any
    vertical: Any


def position_std(cov) -> PositionStd:
    """Of cov [..., 2d, 2d], d = 2 or 3."""
    variance = np.maximum(np.diagonal(cov, axis1=-2, axis2=-1), 0.0)
    horizontal = variance[..., :2].sum(-1)
    vertical = variance[..., 2] if variance.shape[-1] == 6 else np.zeros_like(horizontal)
    return PositionStd(*np.sqrt([horizontal + vertical, horizontal, vertical]))


@kernel("(a,a),(a),(n,d),(d),(n),(n),(),(w)->(a,a)", "FFFFFFfFF")
def _advance(P, truth, transmitters, receiver, std, share, T, w, P_out):
    row, column, x, d = np.empty(3), np.empty(6), np.empty(6), truth.shape[0] // 2
    copy_gaussian(truth, P, 2 * d, x, P_out)
    move_axes(x, P_out, T, d)
    add_axis_noise(P_out, T, w, 1.0, d)
    for i in range(transmitters.shape[0]):
        if share[i] > 0.0:
            range_sum_row(truth, receiver, transmitters[i], row, d)
            absorb_sum(P_out, row, std[i] * std[i] / share[i], column, d, 2 * d)


def advance(cov, truth, transmitters, receiver, std, step_s, acceleration_var, share: Any = 1.0):
    """One step of the bound: motion, then a scan.

    Args:
        cov: [..., 2d, 2d] bound before the step; a step of 0 s adds a scan only.
        truth: [..., 2d] true state after it.
        transmitters: [..., n, d] m; receiver: [..., d] m after it.
        std: [..., n] m or one number.
        step_s: T [s]; acceleration_var: w [3] (m/s²)², the last without meaning in the plane.
        share: of scans in which a transmitter is heard, [..., n] or one number; bool masks work too.
    Returns:
        [..., 2d, 2d].
    Raises:
        ValueError: axes that do not belong together, standard deviations that are not positive and finite.
    """
    d, n = np.shape(receiver)[-1], np.shape(transmitters)[-2]
    if np.shape(truth)[-1] != 2 * d or d not in (2, 3) or np.shape(acceleration_var) != (3,):
        shapes = (
            f"truth {np.shape(truth)}, receiver {np.shape(receiver)}, acceleration_var {np.shape(acceleration_var)}"
        )
        raise ValueError(f"advance: {shapes}: must be [..., 2d], [..., d] and [3], d = 2 or 3")
    check_std("advance: std", std)
    std, shares = each_sum("advance: std", std, n), each_sum("advance: share", share, n)
    return _advance(cov, truth, transmitters, receiver, std, shares, step_s, acceleration_var)


def posterior_bound(truth, transmitters, receiver, prior_cov, std, step_s, acceleration_var, share: Any = 1.0):
    """The bound along whole paths, in information form.

    Args:
        truth: [..., k + 1, 2d]; the prior holds at index 0 before its scan, which counts.
        transmitters: [..., n, d] m; receiver: [..., d] m; both at rest.
        prior_cov: [..., 2d, 2d]; std: [n] m or one number; share: as in `advance`, [n] or one number.
    Returns:
        covariance bounds [..., k + 1, 2d, 2d].
    Raises:
        ValueError: standard deviations that are not positive and finite, or of another length.
    """
    truth, n = np.asarray(truth), np.shape(transmitters)[-2]
    check_std("posterior_bound: std", std)
    std, share = each_sum("posterior_bound: std", std, n), each_sum("posterior_bound: share", share, n)
    d = truth.shape[-1] // 2
    A, Q = axis_transition(step_s, d), axis_noise(step_s, np.asarray(acceleration_var)[:d])
    H = range_sum_jacobian(
        truth[..., :d], np.asarray(receiver)[..., None, :], np.asarray(transmitters)[..., None, :, :]
    )
    weight = np.broadcast_to(share / np.square(std), H.shape[:-1])
    told = np.einsum("...n,...ni,...nj->...ij", weight, H, H)
    covs, prior = [], np.broadcast_to(prior_cov, (*truth.shape[:-2], 2 * d, 2 * d))
    for k in range(truth.shape[-2]):
        J = psd_inverse(prior)
        J[..., :d, :d] += told[..., k, :, :]
        covs.append(psd_inverse(J))
        prior = Q + A @ covs[-1] @ A.T
    return np.stack(covs, axis=-3)
