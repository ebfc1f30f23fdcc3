"""Which bearing belongs to which track: gates and one exact global assignment over both stations.

Tracks may be mixtures (banks). The cost of giving track j the pair (a, b) of two stations' bearings is the negative
log of the mixture's joint likelihood, cross-covariance between the stations included, so a pair of bearings whose
crossing lies away from the track (a ghost) is expensive even if each bearing alone lies inside its gate.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from trackers.angles import wrap_scalar
from trackers.compiled import helper, kernel
from trackers.contract import Scan
from trackers.linalg import LOG_TWO_PI
from trackers.measurement import linearize, log_normal

PRUNED = -1.0e6
"""Log weight of a removed hypothesis: finite, and exp(PRUNED) is exactly 0."""

NODE_LIMIT = 20_000
"""Search nodes per scan; a scan that needs more (dozens of tracks in each other's gates) keeps the best found."""


@dataclass(frozen=True)
class AssociationModel:
    """What an operator assumes about returns.

    Attributes:
        gate_sigma: half width of a bearing gate in innovation standard deviations.
        detection_probability: in (0, 1]; 1 is taken as 0.999, so that a bearing outside every gate can be left out.
        false_bearing_density: expected false bearings per station, scan and radian; floored at 1e-3.
        ambiguity_margin: a bearing that another track could take at a joint extra cost below this many nepers
            updates neither: tracks coast through crossing bearings instead of trading them. 0 switches it off.
    """

    gate_sigma: float = 4.0
    detection_probability: float = 1.0
    false_bearing_density: float = 0.0
    ambiguity_margin: float = 3.0

    def log_costs(self) -> tuple[float, float]:
        """Cost of a missed bearing, and cost added to −log N(ν; 0, S) of an assigned one."""
        detected = min(self.detection_probability, 0.999)
        return -math.log1p(-detected), -math.log(detected) + math.log(max(self.false_bearing_density, 1e-3))


class Association(NamedTuple):
    """Result of `associate`.

    Attributes:
        assignment: [..., m, s] slot of the scan, −1 for none.
        bearings: [..., m, s] rad, the assigned bearing, 0 for none.
        used: [..., m, s] bool: assigned and not ambiguous.
        cost: [...] negative log-likelihood (ratio) of the whole assignment.
    """

    assignment: Any
    bearings: Any
    used: Any
    cost: Any


@helper
def _innovations(x, P, lw, z, valid, stations, var, gate, nu, S, inside):
    """Innovations nu [s, n, b] and variances S [3, n] (two stations, cross term) of one track; gated returns."""
    inside[:] = False
    for i in range(lw.shape[0]):
        if lw[i] <= PRUNED:
            continue
        f0 = f1 = 0.0
        for s in range(z.shape[0]):
            h, a, b = linearize(x[i, 0], x[i, 1], stations[s, 0], stations[s, 1])
            if s == 1:
                S[2, i] = a * f0 + b * f1
            f0, f1 = a * P[i, 0, 0] + b * P[i, 0, 1], a * P[i, 0, 1] + b * P[i, 1, 1]
            S[s, i] = a * f0 + b * f1 + var
            for k in range(z.shape[1]):
                if valid[s, k]:
                    v = wrap_scalar(z[s, k] - h)
                    nu[s, i, k] = v
                    if v * v <= gate * gate * S[s, i]:
                        inside[s, k] = True


@helper
def _pair_cost(lw, nu, S, ka, kb):
    """−log of the mixture's likelihood of the returns (ka, kb) of the two stations; −1 for none."""
    best, total = -math.inf, 0.0
    for i in range(lw.shape[0]):
        if lw[i] <= PRUNED:
            continue
        e = lw[i]
        if ka >= 0 and kb >= 0:
            va, vb = nu[0, i, ka], nu[1, i, kb]
            det = S[0, i] * S[1, i] - S[2, i] * S[2, i]
            q = (S[1, i] * va * va - 2.0 * S[2, i] * va * vb + S[0, i] * vb * vb) / det
            e -= LOG_TWO_PI + 0.5 * (math.log(det) + q)
        elif ka >= 0:
            e += log_normal(nu[0, i, ka], S[0, i])
        elif kb >= 0:
            e += log_normal(nu[1, i, kb], S[1, i])
        if e > best:
            total = total * math.exp(best - e) + 1.0
            best = e
        else:
            total += math.exp(e - best)
    return -best - math.log(total)


@helper
def _insert_sorted(c_opt, k_opt, count, cost, ka, kb):
    """Insert an option into the ascending list of one track; returns the new length."""
    t = count
    while t > 0 and c_opt[t - 1] > cost:
        c_opt[t] = c_opt[t - 1]
        k_opt[t, 0], k_opt[t, 1] = k_opt[t - 1, 0], k_opt[t - 1, 1]
        t -= 1
    c_opt[t] = cost
    k_opt[t, 0], k_opt[t, 1] = ka, kb
    return count + 1


@helper
def _search(c_opt, k_opt, count, best):
    """Depth-first branch and bound over the tracks' sorted options; fills best [m] with options, returns the cost.

    Options are sorted, so the first one that cannot win ends its level.
    """
    m = count.shape[0]
    suffix, prefix = np.zeros(m + 1), np.zeros(m + 1)
    for j in range(m - 1, -1, -1):
        suffix[j] = suffix[j + 1] + c_opt[j, 0]
    cursor = np.zeros(m, dtype=np.int64)
    owner = np.full((2, c_opt.shape[1] + 1), -1)  # which level holds a return; the last column is "none"
    best_cost, nodes, level = math.inf, 0, 0
    while level >= 0:
        nodes += 1
        if cursor[level] > 0:  # release what this level held
            for s in range(2):
                k = k_opt[level, cursor[level] - 1, s]
                if k >= 0 and owner[s, k] == level:
                    owner[s, k] = -1
        o = cursor[level]
        exhausted = o >= count[level] or (nodes > NODE_LIMIT and best_cost < math.inf)
        if exhausted or prefix[level] + c_opt[level, o] + suffix[level + 1] >= best_cost:
            cursor[level] = 0
            level -= 1
            continue
        cursor[level] += 1
        ka, kb = k_opt[level, o, 0], k_opt[level, o, 1]
        if (ka >= 0 and owner[0, ka] >= 0) or (kb >= 0 and owner[1, kb] >= 0):
            continue
        if level == m - 1:
            best_cost = prefix[level] + c_opt[level, o]
            best[:] = cursor - 1
            continue
        if ka >= 0:
            owner[0, ka] = level
        if kb >= 0:
            owner[1, kb] = level
        prefix[level + 1] = prefix[level] + c_opt[level, o]
        level += 1
    return best_cost


@helper
def _is_ambiguous(cost, chosen, j, s, margin):
    """Whether another track could take track j's return of station s at a joint extra cost below the margin."""
    ja, jb = chosen[j, 0], chosen[j, 1]
    for i in range(chosen.shape[0]):
        if i == j:
            continue
        ia, ib = chosen[i, 0], chosen[i, 1]
        if s == 0:
            swapped = cost[j, ia, jb] + cost[i, ja, ib]
        else:
            swapped = cost[j, ja, ib] + cost[i, ia, jb]
        if swapped - cost[j, ja, jb] - cost[i, ia, ib] < margin:
            return True
    return False


@kernel("(m,n,x),(m,n,x,x),(m,n),(s,b),(s,b),(s,p),(),(),(),(),()->(m,s),(m,s),(m,s),()", "ffffbffffffifbf")
def _associate(x, P, lw, z, valid, stations, std, gate, miss, hit, margin, assignment, z_out, used, total):
    n_tracks, n_hyp = lw.shape
    n_stations, n_slots = z.shape
    cost = np.full((n_tracks, n_slots + 1, n_slots + 1), math.inf)  # index −1: none
    c_opt = np.empty((n_tracks, (n_slots + 1) ** n_stations))
    k_opt = np.empty((n_tracks, c_opt.shape[1], 2), dtype=np.int64)
    count = np.zeros(n_tracks, dtype=np.int64)
    nu, S = np.empty((n_stations, n_hyp, n_slots)), np.empty((3, n_hyp))
    inside = np.zeros((2, n_slots), dtype=np.bool_)
    for j in range(n_tracks):
        _innovations(x[j], P[j], lw[j], z, valid, stations, std * std, gate, nu, S, inside)
        for ka in range(-1, n_slots):
            for kb in range(-1, n_slots if n_stations == 2 else 0):
                if (ka >= 0 and not inside[0, ka]) or (kb >= 0 and not inside[1, kb]):
                    continue
                c = _pair_cost(lw[j], nu, S, ka, kb) + (hit if ka >= 0 else miss)
                if n_stations == 2:
                    c += hit if kb >= 0 else miss
                cost[j, ka, kb] = c
                count[j] = _insert_sorted(c_opt[j], k_opt[j], count[j], c, ka, kb)
    best = np.zeros(n_tracks, dtype=np.int64)
    total[0] = _search(c_opt, k_opt, count, best)
    chosen = np.empty((n_tracks, 2), dtype=np.int64)
    for j in range(n_tracks):
        chosen[j, 0], chosen[j, 1] = k_opt[j, best[j], 0], k_opt[j, best[j], 1]
    for j in range(n_tracks):
        for s in range(n_stations):
            k = chosen[j, s]
            assignment[j, s] = k
            used[j, s] = k >= 0 and not (margin > 0.0 and _is_ambiguous(cost, chosen, j, s, margin))
            z_out[j, s] = z[s, k] if k >= 0 else 0.0


def associate(mean, cov, log_weights, scan: Scan, model: AssociationModel = AssociationModel()):
    """Assign a scan's unlabelled bearings to tracks: exact minimum of the summed negative log-likelihood.

    Each bearing serves at most one track, each track takes at most one bearing per station; missed and extra bearings
    are allowed. A bearing is a candidate for a track if it lies in the gate of one of the track's hypotheses.

    Args:
        mean: [..., m, n, 4], cov: [..., m, n, 4, 4], log_weights: [..., m, n] predicted tracks with n hypotheses
            (`PRUNED` marks removed ones).
        scan: one or two stations (s), b slots.
        model: gates, detection probability, clutter density.
    Returns:
        Association.
    Raises:
        ValueError: for more than two stations.
    Source: Xiu et al. (2002), section 2.3 in spirit (bearing gates on both stations); the global assignment and the
        joint cost are ours.
    """
    if scan.bearings.shape[-2] > 2:
        raise ValueError(f"associate takes bearings of one or two stations, got {scan.bearings.shape[-2]}")
    miss, hit = model.log_costs()
    assignment, bearings, used, cost = _associate(
        mean, cov, log_weights, scan.bearings, scan.valid, scan.stations, scan.bearing_std,
        model.gate_sigma, miss, hit, model.ambiguity_margin,
    )  # fmt: skip
    return Association(assignment, bearings, used, cost)
