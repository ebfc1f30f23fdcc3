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
from trackers.outliers import TESTS, outlier_distances


def return_weights(predicted: Gaussian, scan: AngleScan, settings: AnglePdaf) -> np.ndarray:
    """Probability of every return that it is the target's; what a sensor's row lacks of 1 is its miss.

    Args:
        predicted: mean [6], cov [6, 6] of one track.
        scan: of two sensors, without leading axes; a sensor is available as a whole or not at all.
        settings: gates, P_D, whether the scan's density counts, outlier test.
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
        hits.append(math.log(p_d[s]) - math.log(density))
    log_w = np.full([len(inside) + 1 for inside in slots], miss.sum())
    for s, row in enumerate((log_w[1:, 0], log_w[0, 1:])):
        row[:] = hits[s] + miss[1 - s] + _log_normal(nu[s][slots[s]], S[2 * s : 2 * s + 2, 2 * s : 2 * s + 2])
    first, second = (np.ravel(index) for index in np.meshgrid(*slots, indexing="ij"))
    pairs = np.concatenate([nu[0][first], nu[1][second]], axis=-1)
    allowed = _squared(pairs, S) <= settings.fused_gate
    if settings.outlier_test is not None:
        allowed &= _agree(predicted, scan, S, pairs, first, second, settings.outlier_test)
    together = np.where(allowed, sum(hits) + _log_normal(pairs, S), -np.inf)
    log_w[1:, 1:] = together.reshape(log_w[1:, 1:].shape)
    w = np.exp(log_w - log_w.max())
    w /= w.sum()
    weights = np.zeros(np.shape(scan.valid))
    weights[0, slots[0]], weights[1, slots[1]] = w[1:].sum(1), w[:, 1:].sum(0)
    return weights


def _agree(predicted: Gaussian, scan: AngleScan, S: Any, pairs: Any, first: Any, second: Any, test: str) -> np.ndarray:
    """Which of n pairs of returns pass an outlier test; `first` and `second` [n] are slots, `pairs` [n, 4] their ν.

    The conditioned test's d² is what sensor 1 adds to the distance of sensor 0's innovation.
    """
    if test == "conditioned":
        distance = _squared(pairs, S) - _squared(pairs[:, :2], S[:2, :2])
    else:
        n = len(first)
        looks = np.stack([scan.angles[0][first], scan.angles[1][second]], axis=1)[:, :, None]
        many = AngleScan(*(np.broadcast_to(part, (n, *np.shape(part))) for part in scan))
        pair_scan = many._replace(angles=looks, valid=np.ones((n, 2, 1), dtype=bool))
        distance = outlier_distances(predicted, pair_scan, test)[:, 1]
    return distance <= TESTS[test][1]


def _squared(nu: Any, S: Any) -> np.ndarray:
    """Squared Mahalanobis lengths [n] of innovations [n, d]."""
    return np.einsum("ni,ij,nj->n", nu, np.linalg.inv(S), nu)


def _log_normal(nu: Any, S: Any) -> np.ndarray:
    """log N(ν; 0, S) [n] of innovations [n, d]."""
    return -0.5 * (_squared(nu, S) + np.linalg.slogdet(2.0 * math.pi * S)[1])
