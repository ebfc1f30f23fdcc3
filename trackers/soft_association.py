"""Association that decides late: every hypothesis of a bank branches over the returns it may have caused.

A hard assignment that trades two bearings once is hard to undo: the tracks go on as ghosts. Here a scan's joint
assignments only *weigh* branches. Near-duplicates merge, each track keeps its n best branches, and wrong ones (ghost
ranges, traded bearings) lose weight as the geometry tells them apart, just as wrong range hypotheses do in the
paper's bank. Where only one joint assignment is plausible, which is nearly always, this is the hard assignment.

    own weight     v_{i,o} ∝ v_i L_i(o)
    β_j(o) = Σ_{joint assignments that give track j the option o} exp(−cost) / Σ_{all} exp(−cost)
    weight         w_{i,o} = β_j(o) · v_i L_i(o) / Σ_i v_i L_i(o)

L_i(o) is the joint likelihood of the option's bearings under hypothesis i. That a return has one owner couples the
tracks' weights; the coupling is computed afresh from the tracks' own weights in every scan, for feeding it back would
count it again and again. Source: joint probabilistic data association (Fortmann, Bar-Shalom and Scheffe, IEEE J.
Oceanic Eng. 8(3), 1983) for β; branches are kept as a mixture instead of being merged into one Gaussian.
"""

from __future__ import annotations

import math

import numpy as np

from trackers.association import PRUNED, innovations, list_options, walk_assignments
from trackers.compiled import helper, kernel
from trackers.hypotheses import KEEP_ALL, clear_hypothesis, copy_hypothesis, log_threshold, reweight
from trackers.linalg import cholesky_4, mahalanobis_4
from trackers.measurement import condition_into, curvature, slope, update_into

SLACK = 9.0
"""Joint assignments this many nepers above the best one still count (e⁻⁹ ≈ 1e-4)."""

ROOM = 2
"""Branches weighed per place of the bank: near-duplicates merge before the lightest are dropped."""

MAX_EXPONENT = 700.0
"""Weights further apart than this many nepers would overflow; the lighter share is 0 long before."""


@helper
def weigh_options(x, P, lw, z, valid, stations, var, second_order, gate, miss, hit,
                  c_opt, share, log_likelihood, k_opt, nu, S, line, marks, inside):  # fmt: skip
    """List every track's options and weigh them by the joint assignments they take part in.

    Fills `innovations`' and `list_options`' arrays for all tracks, share [m, o] ∝ β_j(o), and in `marks` the numbers
    of options (row 3) and those of the best joint assignment (row 4). Returns whether that one alone is plausible:
    every track then has one option, its cheapest.
    """
    n_tracks, two = lw.shape[0], z.shape[0] == 2
    count, best = marks[3], marks[4]
    for j in range(n_tracks):
        innovations(x[j], P[j], lw[j], z, valid, stations, var, second_order, gate, nu[j], S[j], inside)
        count[j] = list_options(lw[j], nu[j], S[j], inside, two, hit, miss, c_opt[j], k_opt[j], log_likelihood[j])
        best[j] = 0
        share[j, 0], share[j, 1:] = 1.0, 0.0
    clear = _disjoint(k_opt)
    for j in range(n_tracks):
        clear &= count[j] == 1 or c_opt[j, 1] - c_opt[j, 0] > SLACK
    if not clear:
        cost = walk_assignments(c_opt, k_opt, count, math.inf, False, best, share, line, marks[:3])
        share[:] = 0.0
        walk_assignments(c_opt, k_opt, count, cost + SLACK, True, best, share, line, marks[:3])
    return clear


@helper
def _disjoint(k_opt):
    """Whether no two tracks' cheapest options take the same return: they are the best joint assignment then."""
    for j in range(1, k_opt.shape[0]):
        for i in range(j):
            for s in range(2):
                if k_opt[j, 0, s] >= 0 and k_opt[j, 0, s] == k_opt[i, 0, s]:
                    return False
    return True


@helper
def fixed_cost(ka, kb, two, hit, miss):
    """What an option's returns (ka, kb) cost whatever the hypothesis: detections, misses and clutter."""
    price = hit if ka >= 0 else miss
    if two:
        price += hit if kb >= 0 else miss
    return price


@helper
def _select_branches(lw, log_likelihood, k_opt, share, count, hit, miss, two, c_opt, weight, own, parent, option):
    """The heaviest (hypothesis, option) branches of one track, as many as `weight` has room for, heaviest first.

    `lw` are own log weights before the scan; fills the branches' weights (an option's sum to its share), own weights
    (not normalised), parents and options; returns their number.
    """
    n, room = lw.shape[0], weight.shape[0]
    kept = 0
    for o in range(count):
        if share[o] <= 0.0:
            continue
        price = fixed_cost(k_opt[o, 0], k_opt[o, 1], two, hit, miss)
        coupling = math.log(share[o]) + c_opt[o]
        for i in range(n):
            if lw[i] <= PRUNED:
                continue
            v = lw[i] + log_likelihood[k_opt[o, 2], i] - price
            w = v + coupling
            if kept == room and w <= weight[room - 1]:
                continue
            t = kept if kept < room else room - 1
            while t > 0 and weight[t - 1] < w:
                weight[t], own[t] = weight[t - 1], own[t - 1]
                parent[t], option[t] = parent[t - 1], option[t - 1]
                t -= 1
            weight[t], own[t], parent[t], option[t] = w, v, i, o
            kept = min(kept + 1, room)
    return kept


@helper
def update_branches(x, P, nu, z, stations, var, second_order, k_opt, kept, parent, option, x_out, P_out):
    """Condition each kept branch's parent on the branch's returns; `nu` [s, n, b] holds the parents' innovations."""
    for i in range(kept):
        x_prior, P_prior = x[parent[i]], P[parent[i]]
        fresh = True
        for s in range(stations.shape[0]):
            k = k_opt[option[i], s]
            if k < 0:
                continue
            if fresh:
                a, b = slope(x_prior[0], x_prior[1], stations[s, 0], stations[s, 1])
                noise = var + curvature(P_prior, a, b) if second_order else var
                condition_into(x_prior, P_prior, nu[s, parent[i], k], a, b, noise, x_out[i], P_out[i])
            else:
                update_into(
                    x_prior, P_prior, z[s, k], stations[s, 0], stations[s, 1], var, second_order, x_out[i], P_out[i]
                )
            x_prior, P_prior = x_out[i], P_out[i]
            fresh = False
        if fresh:
            copy_hypothesis(x_prior, P_prior, x_out[i], P_out[i])


@helper
def _near(x, P, other, merge_below):
    """Whether each coordinate alone leaves a squared Mahalanobis distance within `merge_below` possible."""
    for r in range(x.shape[0]):
        delta = other[r] - x[r]
        if delta * delta > merge_below * P[r, r]:
            return False
    return True


@helper
def merge(x, P, lw, own, merge_below, delta):
    """Merge branches of one track that lie within `merge_below`, a squared Mahalanobis distance, of a heavier one.

    Moments are preserved.
    """
    n, d = lw.shape[0], x.shape[1]
    for i in range(n):
        if lw[i] <= PRUNED:
            continue
        factored = False
        L = (1.0, 0.0, 1.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0)
        for k in range(i + 1, n):
            if lw[k] <= PRUNED:
                continue
            if not _near(x[i], P[i], x[k], merge_below):
                continue
            for r in range(d):
                delta[r] = x[k, r] - x[i, r]
            if not factored:
                L = cholesky_4(P[i])
                factored = True
            if mahalanobis_4(L, delta) > merge_below:
                continue
            a = 1.0 / (1.0 + math.exp(min(lw[i] - lw[k], MAX_EXPONENT)))  # share of the lighter one
            for r in range(d):
                for c in range(d):
                    P[i, r, c] = (1.0 - a) * P[i, r, c] + a * P[k, r, c] + a * (1.0 - a) * delta[r] * delta[c]
            for r in range(d):
                x[i, r] += a * delta[r]
            lw[i] -= math.log1p(-a)
            own[i] = max(own[i], own[k]) + math.log1p(math.exp(-abs(own[i] - own[k])))
            lw[k] = own[k] = PRUNED
            factored = False


@helper
def _keep_heaviest(x, P, lw, own, x_out, P_out, lw_out, own_out):
    """Move the heaviest branches to the bank's n places, clear the places left; returns whether any was dropped."""
    room, n = lw.shape[0], lw_out.shape[0]
    alive = 0
    for i in range(room):
        alive += lw[i] > PRUNED
    dropped = alive > n
    while alive > n:
        lightest = -1
        for i in range(room):
            if lw[i] > PRUNED and (lightest < 0 or lw[i] < lw[lightest]):
                lightest = i
        lw[lightest] = PRUNED
        alive -= 1
    t = 0
    for i in range(room):
        if lw[i] > PRUNED:
            copy_hypothesis(x[i], P[i], x_out[t], P_out[t])
            lw_out[t], own_out[t] = lw[i], own[i]
            t += 1
    for i in range(t, n):
        clear_hypothesis(x_out[i], P_out[i])
        lw_out[i] = own_out[i] = PRUNED
    return dropped


@helper
def cut_tail(lw, own, kept, log_prune):
    """Prune and renormalise `kept` branches of one option, heaviest first; returns how many are left."""
    left = kept
    while left > 1 and lw[left - 1] < log_prune:
        left -= 1
    total = 0.0
    if left == 1:
        lw[0] = 0.0
    elif left < kept:
        for i in range(left):
            total += math.exp(lw[i])
        for i in range(left):
            lw[i] -= math.log(total)
    for i in range(left):
        own[i] = lw[i]
    return left


@helper
def close_gaps(x, P, lw, own, kept):
    """Move what `merge` left of the first `kept` branches to the front of the bank, clear the places behind."""
    t = 0
    for i in range(kept):
        if lw[i] > PRUNED:
            if t < i:
                copy_hypothesis(x[i], P[i], x[t], P[t])
                lw[t], own[t] = lw[i], own[i]
            t += 1
    for i in range(t, lw.shape[0]):
        clear_hypothesis(x[i], P[i])
        lw[i] = own[i] = PRUNED


@helper
def mixture_innovation(lw, nu, S, k, var):
    """Mean and variance of the innovation of return k over a track's hypotheses; (0, σ²) for none."""
    if k < 0:
        return 0.0, var
    mean = second = 0.0
    for i in range(lw.shape[0]):
        if lw[i] > PRUNED:
            w, v = math.exp(lw[i]), nu[i, k]
            mean += w * v
            second += w * (S[i] + v * v)
    return mean, max(second - mean * mean, var)


def scratch(shape: tuple[int, ...], stations: int, slots: int):
    """Working arrays of one call for banks [..., m, n, 4]: allocating inside the kernel would dominate its time."""
    m, n = shape[-3:-1]
    options, room = (slots + 1) ** stations, ROOM * n
    width = max(room, m, slots, options, 4) + 1
    return (
        np.empty((m, options, 2 + n)),
        np.empty((m, options, 3), dtype=np.int64),
        np.empty((m, stations, n, slots)),
        np.empty((m, 6, n)),
        np.empty((5, width)),
        np.empty((7, width), dtype=np.int64),
        np.empty((2, slots), dtype=bool),
        np.empty((room, 4)),
        np.empty((room, 4, 4)),
    )


@helper
def _renew_in_place(x, P, lw, nu, z, stations, var, second_order, log_likelihood, k_opt, share, c_opt, hit, miss, two,
                    log_prune, merge_below, parent, option, delta, x_out, P_out, lw_out, own_out):  # fmt: skip
    """One track's posterior bank where one option is left: as many branches as hypotheses, made in their places.

    parent, option and delta are scratch; the rest as in `_renew_from_branches`.
    """
    kept = _select_branches(
        lw, log_likelihood, k_opt, share, 1, hit, miss, two, c_opt, lw_out, own_out, parent, option
    )  # fmt: skip
    kept = cut_tail(lw_out, own_out, kept, log_prune)
    update_branches(x, P, nu, z, stations, var, second_order, k_opt, kept, parent, option, x_out, P_out)
    merge(x_out, P_out, lw_out[:kept], own_out[:kept], merge_below, delta)
    close_gaps(x_out, P_out, lw_out, own_out, kept)


@helper
def _renew_from_branches(x, P, lw, nu, count, z, stations, var, second_order, log_likelihood, k_opt, share, c_opt, hit,
                         miss, two, log_prune, merge_below, parent, option, delta, weight, own, x_branch, P_branch,
                         x_out, P_out, lw_out, own_out):  # fmt: skip
    """One track's posterior bank from the branches of `count` options, which are made in a place of their own.

    x, P, lw: the prior bank, nu [s, n, b] its innovations; log_likelihood, k_opt, share, c_opt: the track's options as
    `weigh_options` leaves them; from `parent` to `P_branch` all is scratch.
    """
    kept = _select_branches(
        lw, log_likelihood, k_opt, share, count, hit, miss, two, c_opt, weight, own, parent, option
    )  # fmt: skip
    update_branches(x, P, nu, z, stations, var, second_order, k_opt, kept, parent, option, x_branch, P_branch)
    lw_kept, own_kept = weight[:kept], own[:kept]
    if kept == 1:  # nothing to weigh
        lw_kept[0] = own_kept[0] = 0.0
    else:
        reweight(lw_kept, log_prune)
        for i in range(kept):
            if lw_kept[i] <= PRUNED:
                own_kept[i] = PRUNED
        merge(x_branch, P_branch, lw_kept, own_kept, merge_below, delta)
    dropped = _keep_heaviest(x_branch, P_branch, lw_kept, own_kept, x_out, P_out, lw_out, own_out)
    if kept > 1:
        reweight(own_out, KEEP_ALL)
    if dropped:
        reweight(lw_out, log_prune)


@kernel(
    "(m,n,x),(m,n,x,x),(m,n),(s,b),(s,b),(s,p),(),(),(),(),(),(),(),(m,o,u),(m,o,v),(m,s,n,b),(m,g,n),(l,q),(h,r),(t,b),(c,x),(c,x,x)"
    "->(m,n,x),(m,n,x,x),(m,n),(m,n),(m,s),(m,s),(m,s),(m)",
    "FFFfbfffffffbFIFFFIBFFFFFFFFIF",
)
def _branch_and_update(x, P, lw, z, valid, stations, std, gate, miss, hit, log_prune, merge_below, second_order,
                       options, k_opt, nu, S, line, marks, inside, x_branch, P_branch,
                       x_out, P_out, lw_out, own_out, nu_out, S_out, assignment, evidence):  # fmt: skip
    """Inputs from `options` to `P_branch` are scratch (`scratch`), shared by all items of a call."""
    n_tracks, n_stations = lw.shape[0], z.shape[0]
    two, var = n_stations == 2, std * std
    c_opt, share, log_likelihood = options[:, :, 0], options[:, :, 1], options[:, :, 2:]
    room = x_branch.shape[0]
    weight, own, delta = line[2, :room], line[3, :room], line[4, :4]
    count, best, parent, option = marks[3], marks[4], marks[5], marks[6]
    clear = weigh_options(
        x, P, lw, z, valid, stations, var, second_order, gate, miss, hit,
        c_opt, share, log_likelihood, k_opt, nu, S, line, marks, inside,
    )  # fmt: skip
    for j in range(n_tracks):
        evidence[j] = fixed_cost(k_opt[j, best[j], 0], k_opt[j, best[j], 1], two, hit, miss) - c_opt[j, best[j]]
        for s in range(n_stations):
            k = k_opt[j, best[j], s]
            assignment[j, s] = k
            nu_out[j, s], S_out[j, s] = mixture_innovation(lw[j], nu[j, s], S[j, s], k, var)
        if clear:
            _renew_in_place(
                x[j], P[j], lw[j], nu[j], z, stations, var, second_order, log_likelihood[j], k_opt[j], share[j],
                c_opt[j], hit, miss, two, log_prune, merge_below, parent, option, delta, x_out[j], P_out[j],
                lw_out[j], own_out[j],
            )  # fmt: skip
        else:
            _renew_from_branches(
                x[j], P[j], lw[j], nu[j], count[j], z, stations, var, second_order, log_likelihood[j], k_opt[j],
                share[j], c_opt[j], hit, miss, two, log_prune, merge_below, parent, option, delta, weight, own,
                x_branch, P_branch, x_out[j], P_out[j], lw_out[j], own_out[j],
            )  # fmt: skip


def branch_and_update(mean, cov, own_log_weights, scan, model, prune_below, merge_below=4.0, second_order=False):
    """Branch a batch of banks over a scan's returns and condition every branch on its bearings.

    Args:
        mean: [..., m, n, 4], cov: [..., m, n, 4, 4], own_log_weights: [..., m, n] predicted banks of m
            tracks.
        scan: one or two stations; see `trackers.contract.Scan`.
        model: `trackers.association.AssociationModel`.
        prune_below: weight below which a branch is removed, 0 for none; the best one always stays.
        merge_below: squared Mahalanobis distance below which two branches are one.
        second_order: whether a bearing's curvature adds to its innovation variance (`measurement.update`).
    Returns:
        mean, cov, log weights and own log weights of the posterior banks; innovation, its variance and slot of the
        best joint assignment [..., m, s]; its log-likelihood [..., m].
    Raises:
        ValueError: for more than two stations.
    """
    if scan.bearings.shape[-2] > 2:
        raise ValueError(f"a scan may hold bearings of one or two stations, got {scan.bearings.shape[-2]}")
    miss, hit = model.log_costs()
    return _branch_and_update(
        mean, cov, own_log_weights, scan.bearings, scan.valid, scan.stations, scan.bearing_std,
        model.gate_sigma, miss, hit, log_threshold(prune_below), merge_below, second_order,
        *scratch(mean.shape, *scan.bearings.shape[-2:]),
    )  # fmt: skip
