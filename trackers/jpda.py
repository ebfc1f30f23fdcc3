"""Joint probabilistic data association for banks whose filters must keep their places.

Where `soft_association` lets every hypothesis branch over the returns and keeps the best branches, here each filter
averages its branches: one Gaussian per filter goes in, one comes out, so range hypotheses and motion models stay where
they are. With v_i the weight and L_i(o) the likelihood of filter i under the option o,

    w_{i,o} = β(o) · v_i L_i(o) / Σ_i v_i L_i(o)    w_i = Σ_o w_{i,o}
    x_i = Σ_o w_{i,o} / w_i · x_{i,o}    P_i = Σ_o w_{i,o} / w_i · [P_{i,o} + (x_{i,o} − x_i)(x_{i,o} − x_i)ᵀ]

and β(o) the share of the joint assignments that give the track the option o. Where only one joint assignment is
plausible, which is nearly always, this is the hard assignment.
Source: Fortmann, Bar-Shalom and Scheffe, IEEE J. Oceanic Eng. 8(3), 1983; as part of an IMM: Chen and Tugnait,
Automatica 37(2), 2001. Approximation: each filter's mixture over options is matched by one Gaussian.
"""

from __future__ import annotations

import math

from trackers.association import NEGLIGIBLE, PRUNED
from trackers.compiled import helper, kernel
from trackers.hypotheses import clear_hypothesis, copy_hypothesis, log_threshold, reweight
from trackers.soft_association import (
    fixed_cost,
    mixture_innovation,
    scratch,
    update_branches,
    weigh_options,
)

FAINTEST = 0.5 * PRUNED
"""Smallest log weight of a filter that has not been removed."""


@helper
def _weigh_filter(log_w, log_likelihood, share, c_opt, k_opt, two, hit, miss, log_share):
    """Log w_{i,o} of one filter's options; returns their largest and Σ exp of the differences to it."""
    top, total = -math.inf, 0.0
    for o in range(log_share.shape[0]):
        log_share[o] = -math.inf
        if share[o] > 0.0:
            own = log_w + log_likelihood[k_opt[o, 2]] - fixed_cost(k_opt[o, 0], k_opt[o, 1], two, hit, miss)
            log_share[o] = math.log(share[o]) + c_opt[o] + own
            top = max(top, log_share[o])
    for o in range(log_share.shape[0]):
        if log_share[o] - top > NEGLIGIBLE:
            total += math.exp(log_share[o] - top)
    return top, total


@helper
def _add_moments(x, x_branch, P_branch, share, dx, P):
    """Add a branch to the first and second moments about x [d]."""
    for r in range(x.shape[0]):
        dx[r] += share * (x_branch[r] - x[r])
        for c in range(x.shape[0]):
            P[r, c] += share * (P_branch[r, c] + (x_branch[r] - x[r]) * (x_branch[c] - x[c]))


@helper
def _center_moments(x, dx, x_out, P_out):
    """Turn moments about x [d] into mean and covariance."""
    for r in range(x.shape[0]):
        x_out[r] = x[r] + dx[r]
        for c in range(x.shape[0]):
            P_out[r, c] -= dx[r] * dx[c]


@kernel(
    "(m,n,x),(m,n,x,x),(m,n),(s,b),(s,b),(s,p),(),(),(),(),(),(),(m,o,u),(m,o,v),(m,s,n,b),(m,g,n),(l,q),(h,r),(t,b),(c,x),(c,x,x)"
    "->(m,n,x),(m,n,x,x),(m,n),(m,s),(m,s),(m,s),(m)",
    "ffffbffffffbfifffibfffffffif",
)
def _average_and_update(x, P, lw, z, valid, stations, std, gate, miss, hit, log_prune, second_order,
                        options, k_opt, nu, S, line, marks, inside, x_branch, P_branch,
                        x_out, P_out, lw_out, nu_out, S_out, assignment, evidence):  # fmt: skip
    """Inputs from `options` to `P_branch` are scratch (`soft_association.scratch`), shared by all items of a call."""
    n_tracks, n = lw.shape
    n_stations = z.shape[0]
    two, var = n_stations == 2, std * std
    c_opt, share, log_likelihood = options[:, :, 0], options[:, :, 1], options[:, :, 2:]
    count, best, parent, option, dx = marks[3], marks[4], marks[5], marks[6], line[4, :4]
    weigh_options(
        x, P, lw, z, valid, stations, var, second_order, gate, miss, hit,
        c_opt, share, log_likelihood, k_opt, nu, S, line, marks, inside,
    )  # fmt: skip
    for j in range(n_tracks):
        evidence[j] = fixed_cost(k_opt[j, best[j], 0], k_opt[j, best[j], 1], two, hit, miss) - c_opt[j, best[j]]
        for s in range(n_stations):
            k = k_opt[j, best[j], s]
            assignment[j, s] = k
            nu_out[j, s], S_out[j, s] = mixture_innovation(lw[j], nu[j, s], S[j, s], k, var)
        log_share = line[3, : count[j]]
        for i in range(n):
            clear_hypothesis(x_out[j, i], P_out[j, i])
            lw_out[j, i] = PRUNED
            if lw[j, i] <= PRUNED:
                continue
            top, total = _weigh_filter(
                lw[j, i], log_likelihood[j, :, i], share[j], c_opt[j], k_opt[j], two, hit, miss, log_share
            )
            lw_out[j, i] = max(top + math.log(total), FAINTEST)
            dx[:] = 0.0
            parent[0] = i
            branches = 0
            for o in range(count[j]):
                if not log_share[o] - top > NEGLIGIBLE:
                    continue
                option[0] = o
                branches += 1
                update_branches(
                    x[j], P[j], nu[j], z, stations, var, second_order, k_opt[j], 1, parent, option, x_branch, P_branch
                )
                _add_moments(x[j, i], x_branch[0], P_branch[0], math.exp(log_share[o] - top) / total, dx, P_out[j, i])
            if branches == 1:  # nothing to average
                copy_hypothesis(x_branch[0], P_branch[0], x_out[j, i], P_out[j, i])
            else:
                _center_moments(x[j, i], dx, x_out[j, i], P_out[j, i])
        reweight(lw_out[j], log_prune)


def average_and_update(mean, cov, log_weights, scan, model, prune_below, second_order=False):
    """Condition every filter of a batch of banks on the returns it may have caused, averaged over joint assignments.

    Args:
        mean: [..., m, n, 4], cov: [..., m, n, 4, 4], log_weights: [..., m, n] predicted banks of m tracks.
        scan: one or two stations; see `trackers.contract.Scan`.
        model: `trackers.association.AssociationModel`.
        prune_below: weight below which a filter is removed, 0 for none; the best one always stays.
        second_order: whether a bearing's curvature adds to its innovation variance (`measurement.update`).
    Returns:
        mean, cov and log weights of the posterior banks, filters in their places; innovation, its variance and slot
        of the best joint assignment [..., m, s]; its log-likelihood [..., m].
    Raises:
        ValueError: for more than two stations.
    """
    if scan.bearings.shape[-2] > 2:
        raise ValueError(f"a scan may hold bearings of one or two stations, got {scan.bearings.shape[-2]}")
    miss, hit = model.log_costs()
    return _average_and_update(
        mean, cov, log_weights, scan.bearings, scan.valid, scan.stations, scan.bearing_std,
        model.gate_sigma, miss, hit, log_threshold(prune_below), second_order,
        *scratch(mean.shape, *scan.bearings.shape[-2:]),
    )  # fmt: skip
