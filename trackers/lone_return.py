"""The commonest scan by far, in a fraction of the time: one track, one station, one return that is plainly the track's.

A shortcut through `soft_association`: the same figures, up to rounding, from one pass over the bank. The only
question is whether the track takes the return, so options need neither lists nor walks, and slopes are computed once.
Where the answer is not plain, and where the return is missing, `soft_association` decides.
"""

from __future__ import annotations

import math

import numpy as np

from trackers.angles import wrap_scalar
from trackers.association import PRUNED
from trackers.compiled import helper, kernel
from trackers.contract import Scan
from trackers.hypotheses import log_threshold
from trackers.measurement import condition_into, curvature, linearize, log_normal
from trackers.soft_association import SLACK, branch_and_update, close_gaps, cut_tail, merge


@helper
def _weigh(x, P, lw, z, station, var, second_order, gate, figures):
    """How well a return fits each hypothesis.

    Fills figures [6, n]: log-likelihood, innovation and its variance, the bearing's two slopes, noise variance.
    Returns −log of the mixture's likelihood, and whether the return lies in some hypothesis' gate.
    """
    log_likelihood, nu, S, slope_x, slope_y, noise = figures
    inside, best = False, -math.inf
    for i in range(lw.shape[0]):
        if lw[i] <= PRUNED:
            continue
        h, a, b = linearize(x[i, 0], x[i, 1], station[0], station[1])
        noise[i] = var + curvature(P[i], a, b) if second_order else var
        S[i] = a * (a * P[i, 0, 0] + b * P[i, 0, 1]) + b * (a * P[i, 0, 1] + b * P[i, 1, 1]) + noise[i]
        nu[i], slope_x[i], slope_y[i] = wrap_scalar(z - h), a, b
        inside |= nu[i] * nu[i] <= gate * gate * S[i]
        log_likelihood[i] = log_normal(nu[i], S[i])
        best = max(best, lw[i] + log_likelihood[i])
    total = 0.0
    for i in range(lw.shape[0]):
        if lw[i] > PRUNED:
            total += math.exp(lw[i] + log_likelihood[i] - best)
    return -best - math.log(total), inside


@helper
def _sort_by_weight(lw, log_likelihood, cost, lw_out, parent):
    """Posterior log weights and the hypotheses they belong to, heaviest first; returns their number."""
    kept = 0
    for i in range(lw.shape[0]):
        if lw[i] <= PRUNED:
            continue
        w = lw[i] + log_likelihood[i] + cost
        t = kept
        while t > 0 and lw_out[t - 1] < w:
            lw_out[t], parent[t] = lw_out[t - 1], parent[t - 1]
            t -= 1
        lw_out[t], parent[t] = w, i
        kept += 1
    return kept


@helper
def _mixture_innovation(lw, nu, S, var):
    mean = second = 0.0
    for i in range(lw.shape[0]):
        if lw[i] > PRUNED:
            w = math.exp(lw[i])
            mean += w * nu[i]
            second += w * (S[i] + nu[i] * nu[i])
    return mean, max(second - mean * mean, var)


@kernel(
    "(n,x),(n,x,x),(n),(),(),(p),(),(),(),(),(),(),(),(g,n),(n),(x)->(n,x),(n,x,x),(n),(n),(),(),(),()",
    "FFFfbFffffffbFIFFFFFffff",
)
def _take(x, P, lw, z, valid, station, std, gate, miss, hit, log_prune, merge_below, second_order,
          figures, parent, delta, x_out, P_out, lw_out, own_out, nu_out, S_out, evidence, plain):  # fmt: skip
    """`figures`, `parent` and `delta` are scratch; where `plain` is 0 the other outputs hold nothing."""
    plain[0] = 0.0
    if not valid:
        return
    var = std * std
    rows = (figures[0], figures[1], figures[2], figures[3], figures[4], figures[5])
    log_likelihood, nu, S, slope_x, slope_y, noise = rows
    cost, inside = _weigh(x, P, lw, z, station, var, second_order, gate, rows)
    if not (inside and miss - hit - cost > SLACK):  # NaN compares False
        return
    plain[0], evidence[0] = 1.0, -cost
    nu_out[0], S_out[0] = _mixture_innovation(lw, nu, S, var)
    kept = cut_tail(lw_out, own_out, _sort_by_weight(lw, log_likelihood, cost, lw_out, parent), log_prune)
    for t in range(kept):
        i = parent[t]
        condition_into(x[i], P[i], nu[i], slope_x[i], slope_y[i], noise[i], x_out[t], P_out[t])
    merge(x_out, P_out, lw_out[:kept], own_out[:kept], merge_below, delta)
    close_gaps(x_out, P_out, lw_out, own_out, kept)


def is_lone(mean, scan: Scan) -> bool:
    """Whether a scan of one station with one slot meets banks [..., m, n, 4] of one track."""
    return mean.shape[-3] == 1 and scan.bearings.shape[-2:] == (1, 1)


def take_or_branch(
    mean, cov, own_log_weights, scan: Scan, model, prune_below, merge_below=4.0, second_order=False
) -> list[np.ndarray]:
    """`soft_association.branch_and_update` for lone tracks [..., 1, n, 4] and scans of one slot, with its results."""
    n = mean.shape[-2]
    miss, hit = model.log_costs()
    x, P, lw, own, nu, S, evidence, plain = _take(
        mean[..., 0, :, :], cov[..., 0, :, :, :], own_log_weights[..., 0, :], scan.bearings[..., 0, 0],
        scan.valid[..., 0, 0], scan.stations[..., 0, :], scan.bearing_std, model.gate_sigma, miss, hit,
        log_threshold(prune_below), merge_below, second_order,
        np.empty((6, n)), np.empty(n, dtype=np.int64), np.empty(4),
    )  # fmt: skip
    slot = np.zeros((*nu.shape, 1, 1), dtype=np.int64)
    taken = [
        x[..., None, :, :], P[..., None, :, :, :], lw[..., None, :], own[..., None, :],
        nu[..., None, None], S[..., None, None], slot, evidence[..., None],
    ]  # fmt: skip
    rest = plain == 0.0
    if rest.any():
        some = Scan(
            _rows(scan.bearings, rest, 2), _rows(scan.valid, rest, 2), _rows(scan.stations, rest, 2),
            _rows(scan.bearing_std, rest, 0),
        )  # fmt: skip
        branched = branch_and_update(
            _rows(mean, rest, 3), _rows(cov, rest, 4), _rows(own_log_weights, rest, 2), some,
            model, prune_below, merge_below, second_order,
        )  # fmt: skip
        for part, decided in zip(taken, branched, strict=True):
            part[rest] = decided
    return taken


def _rows(array, rows: np.ndarray, core: int) -> np.ndarray:
    """The chosen items [k, …] of an array whose leading axes, all but `core`, broadcast to those of `rows`."""
    array = np.asarray(array)
    return np.broadcast_to(array, (*rows.shape, *array.shape[array.ndim - core :]))[rows]
