"""Hypotheses of a bank: copied, cleared, weighed in the log domain; the best one always stays."""

from __future__ import annotations

import math

from trackers.association import NEGLIGIBLE, PRUNED
from trackers.compiled import helper

KEEP_ALL = -1e9
"""A log threshold that removes nothing."""


def log_threshold(prune_below: float) -> float:
    """Log of the weight below which hypotheses are removed; 0 keeps all."""
    return math.log(prune_below) if prune_below > 0.0 else KEEP_ALL


@helper
def reweight(log_w, log_prune):
    """Normalise log weights [n] in place, prune those below log_prune, renormalise; returns the evidence.

    When every hypothesis falls below the threshold the best one stays.
    """
    n = log_w.shape[0]
    best = 0
    for i in range(1, n):
        if log_w[i] > log_w[best]:
            best = i
    top = log_w[best]
    total = 0.0
    for i in range(n):
        if log_w[i] > PRUNED and log_w[i] - top > NEGLIGIBLE:
            total += math.exp(log_w[i] - top) if i != best else 1.0
    evidence = top + math.log(total)
    kept = 0.0
    pruned = False
    for i in range(n):
        if i != best and log_w[i] > PRUNED and not log_w[i] - evidence >= log_prune:
            log_w[i] = PRUNED
            pruned = True
    shift = evidence
    if pruned:
        for i in range(n):
            if i == best:
                kept += 1.0
            elif log_w[i] > PRUNED and log_w[i] - top > NEGLIGIBLE:
                kept += math.exp(log_w[i] - top)
        shift = top + math.log(kept)
    for i in range(n):
        if log_w[i] > PRUNED:
            log_w[i] -= shift
    return evidence


@helper
def copy_hypothesis(x, P, x_out, P_out):
    """Copy a mean [4] and covariance [4, 4] (explicit loops of known length: slices of arrays copy slowly)."""
    for r in range(4):
        x_out[r] = x[r]
        for c in range(4):
            P_out[r, c] = P[r, c]


@helper
def clear_hypothesis(x_out, P_out):
    """Zeros in the place of a removed hypothesis: finite, and cheaper than carrying it on."""
    for r in range(4):
        x_out[r] = 0.0
        for c in range(4):
            P_out[r, c] = 0.0
