"""Association weights of one scan of two sensors, as the formulas stand: for pictures, and to check the compiled PDAF.

    w_00 = q₁ q₂                         w_i0 = (P_D/λ₁) N(ν₁ᵢ; 0, S₁₁) q₂
    w_0j = (P_D/λ₂) N(ν₂ⱼ; 0, S₂₂) q₁    w_ij = (P_D P_D/(λ₁ λ₂)) N(ν_ij; 0, S)

with q = 1 − P_D P_G, every P_D its sensor's own, and S the innovations' joint covariance.
Source: Wang, Wang and Yang (2004), section 4, with per-sensor Poisson clutter in place of eqs 21–24.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from trackers.angle_contract import AngleScan
from trackers.angle_pdaf import SURE, AnglePdaf
from trackers.angles import wrap
from trackers.direction import direction, direction_jacobian
from trackers.gaussian import Gaussian


def return_weights(predicted: Gaussian, scan: AngleScan, settings: AnglePdaf) -> np.ndarray:
    """Probability of every return that it is the target's; what a sensor's row lacks of 1 is its miss.

    Args:
        predicted: mean [6], cov [6, 6] of one track.
        scan: of two sensors, without leading axes; a sensor is available as a whole or not at all.
        settings: gates, P_D, whether the scan's density counts; outlier tests are not looked at.
    Returns:
        [2, b]; 0 for returns outside the gates.
    """
    nu = wrap(np.asarray(scan.angles) - direction(predicted.mean, scan.platforms)[:, None])
    H = direction_jacobian(predicted.mean, scan.platforms).reshape(4, 3)
    S = H @ predicted.cov[:3, :3] @ H.T + np.diag(np.square(scan.angle_std).ravel())
    p_d = settings.detection(scan)
    miss = np.log(np.maximum(1.0 + p_d * math.expm1(-0.5 * settings.gate), SURE))
    hits, slots = [], []
    for s in range(2):
        own = S[2 * s : 2 * s + 2, 2 * s : 2 * s + 2]
        inside = np.flatnonzero(scan.valid[s] & (_squared(nu[s], own) <= settings.gate))
        area = math.pi * settings.gate * math.sqrt(np.linalg.det(own))
        known = settings.clutter_known and scan.clutter_density[s] > 0.0
        density = scan.clutter_density[s] if known else max(len(inside), 1) / area
        slots.append(inside)
        hits.append(math.log(p_d[s] / density))
    log_w = np.full([len(inside) + 1 for inside in slots], miss.sum())
    for s, row in enumerate((log_w[1:, 0], log_w[0, 1:])):
        row[:] = hits[s] + miss[1 - s] + _log_normal(nu[s][slots[s]], S[2 * s : 2 * s + 2, 2 * s : 2 * s + 2])
    pairs = np.concatenate(
        [np.repeat(nu[0][slots[0]], len(slots[1]), axis=0), np.tile(nu[1][slots[1]], (len(slots[0]), 1))], axis=-1
    )
    together = np.where(_squared(pairs, S) <= settings.fused_gate, sum(hits) + _log_normal(pairs, S), -np.inf)
    log_w[1:, 1:] = together.reshape(log_w[1:, 1:].shape)
    w = np.exp(log_w - log_w.max())
    w /= w.sum()
    weights = np.zeros(np.shape(scan.valid))
    weights[0, slots[0]], weights[1, slots[1]] = w[1:].sum(1), w[:, 1:].sum(0)
    return weights


def _squared(nu: Any, S: Any) -> np.ndarray:
    """Squared Mahalanobis lengths [n] of innovations [n, d]."""
    return np.einsum("ni,ij,nj->n", nu, np.linalg.inv(S), nu)


def _log_normal(nu: Any, S: Any) -> np.ndarray:
    """log N(ν; 0, S) [n] of innovations [n, d]."""
    return -0.5 * (_squared(nu, S) + np.linalg.slogdet(2.0 * math.pi * S)[1])
