"""Kalman update with a measured position, and the sums over filters that an IMM needs; helpers for kernels.

States are [p, v, …] with d numbers each, so that H = [I 0]. With S = H P Hᵀ + R = L Lᵀ everything is written in the
whitened innovation w = L⁻¹ν and the gain per standard deviation G = P Hᵀ L⁻ᵀ:

    x + K ν = x + G w,    P − K S Kᵀ = P − G Gᵀ,    log N(ν; 0, S) = −(d log 2π + wᵀw)/2 − log det L

d and the state's length are arguments: a constant one at the call lets the compiler unroll every loop.
"""

from __future__ import annotations

import math

from trackers.compiled import helper
from trackers.linalg import JITTER, LOG_TWO_PI
from trackers.measurement import NOISE_FLOOR

NEVER = -1e300
"""Log of a probability of zero."""


@helper
def factor_innovation(P, R, d, L):
    """Lower factor L [d, d] of P[:d, :d] + R; returns log det L. R counts at least as a tiny share of P."""
    log_det = 0.0
    for i in range(d):
        for j in range(i + 1):
            total = P[i, j] + R[i, j]
            if i == j:
                total += max(NOISE_FLOOR * P[i, i] - R[i, i], 0.0)
            scale = total
            for k in range(j):
                total -= L[i, k] * L[j, k]
            L[i, j] = total / L[j, j] if j < i else math.sqrt(max(total, JITTER * abs(scale) + 1e-300))
        log_det += math.log(L[i, i])
    return log_det


@helper
def whiten_position(L, d, x, z, w):
    """w [d] = L⁻¹(z − x[:d]); returns wᵀw."""
    total = 0.0
    for i in range(d):
        s = z[i] - x[i]
        for k in range(i):
            s -= L[i, k] * w[k]
        w[i] = s / L[i, i]
        total += w[i] * w[i]
    return total


@helper
def whitened_gain(P, L, d, n, G):
    """G [n, d] = P Hᵀ L⁻ᵀ of P [n, n]."""
    for i in range(n):
        for a in range(d):
            s = P[i, a]
            for b in range(a):
                s -= G[i, b] * L[a, b]
            G[i, a] = s / L[a, a]


@helper
def correct(x, P, G, w, d, n):
    """x [n] + G w and P [n, n] − G Gᵀ, in place."""
    for i in range(n):
        for a in range(d):
            x[i] += G[i, a] * w[a]
        for j in range(i + 1):
            for a in range(d):
                P[i, j] -= G[i, a] * G[j, a]
            P[j, i] = P[i, j]


@helper
def copy_gaussian(x, P, n, x_out, P_out):
    """Copy x [n] and P [n, n]; explicit loops compile faster than slices of arrays and copy faster."""
    for i in range(n):
        x_out[i] = x[i]
        for j in range(n):
            P_out[i, j] = P[i, j]


@helper
def gaussian_log(log_det, squared, d):
    """log N(ν; 0, LLᵀ) for log det L and wᵀw."""
    return -0.5 * (d * LOG_TWO_PI + squared) - log_det


@helper
def moment_match_into(x, P, share, n, x_out, P_out):
    """Mean [n] and covariance [n, n] of r Gaussians with shares [r] that sum to 1; those of share 0 do not count."""
    for i in range(n):
        x_out[i] = 0.0
        for k in range(share.shape[0]):
            x_out[i] += share[k] * x[k, i]
        for j in range(i + 1):
            P_out[i, j] = 0.0
    for k in range(share.shape[0]):
        if share[k] > 0.0:
            for i in range(n):
                for j in range(i + 1):
                    P_out[i, j] += share[k] * (P[k, i, j] + (x[k, i] - x_out[i]) * (x[k, j] - x_out[j]))
    for i in range(n):
        for j in range(i):
            P_out[j, i] = P_out[i, j]


@helper
def mixing_shares(transition, probability, j, share):
    """share [r] of model j's predecessors, p_ij μ_i / c_j; returns c_j. A model nobody enters keeps its own state."""
    total = 0.0
    for i in range(share.shape[0]):
        share[i] = transition[i, j] * probability[i]
        total += share[i]
    for i in range(share.shape[0]):
        share[i] = share[i] / total if total > 0.0 else (1.0 if i == j else 0.0)
    return total


@helper
def reweigh(probability, log_likelihood):
    """Multiply probabilities [r] by likelihoods and normalise, in place; returns the log of the sum before.

    log_likelihood [r] is overwritten. Likelihoods of nothing at all change nothing.
    """
    top = NEVER
    for j in range(probability.shape[0]):
        log_likelihood[j] += math.log(probability[j]) if probability[j] > 0.0 else NEVER
        top = max(top, log_likelihood[j])
    if not top > NEVER:
        return NEVER
    total = 0.0
    for j in range(probability.shape[0]):
        total += math.exp(log_likelihood[j] - top)
    for j in range(probability.shape[0]):
        probability[j] = math.exp(log_likelihood[j] - top) / total
    return top + math.log(total)


@helper
def say_innovation(y, Pi, mu, z, R, fixed, d, nu, S):
    """Innovation [d] of the mixture of predictions [r, ≥d] and its covariance [d, d]; without a fix 0 and H P Hᵀ."""
    for i in range(d):
        nu[i] = z[i] if fixed else 0.0
        for k in range(mu.shape[0]):
            nu[i] -= mu[k] * y[k, i] if fixed else 0.0
        for j in range(d):
            S[i, j] = R[i, j] if fixed else 0.0
    for k in range(mu.shape[0]):
        for i in range(d):
            for j in range(d):
                S[i, j] += mu[k] * Pi[k, i, j]
                for o in range(k):
                    S[i, j] += mu[k] * mu[o] * (y[k, i] - y[o, i]) * (y[k, j] - y[o, j])
