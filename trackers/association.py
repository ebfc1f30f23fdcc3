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
from trackers.measurement import curvature, linearize, log_normal

PRUNED = -1.0e6
"""Log weight of a removed hypothesis: finite, and exp(PRUNED) is exactly 0."""

NEGLIGIBLE = -40.0
"""Log of a share that vanishes beside 1 in double precision: its exponential is not worth computing."""

NODE_LIMIT = 20_000
"""Search nodes per scan; a scan that needs more (dozens of tracks in each other's gates) keeps the best found."""


@dataclass(frozen=True)
class AssociationModel:
    """What an operator assumes about returns.

    Attributes:
        gate_sigma: half width of a bearing gate in innovation standard deviations.
        detection_probability: in (0, 1]; 1 is taken as 0.999, so that a bearing outside every gate can be left out.
        false_bearing_density: expected false bearings per station, scan and radian; floored at 1e-3.
    """

    gate_sigma: float = 4.0
    detection_probability: float = 1.0
    false_bearing_density: float = 0.0

    def log_costs(self) -> tuple[float, float]:
        """Cost of a missed bearing, and cost added to −log N(ν; 0, S) of an assigned one."""
        detected = min(self.detection_probability, 0.999)
        return -math.log1p(-detected), -math.log(detected) + math.log(max(self.false_bearing_density, 1e-3))


class Association(NamedTuple):
    """Result of `associate`.

    Attributes:
        assignment: [..., m, s] slot of the scan, −1 for none.
        bearings: [..., m, s] rad, the assigned bearing, 0 for none.
        used: [..., m, s] bool.
        cost: [...] negative log-likelihood (ratio) of the whole assignment.
    """

    assignment: Any
    bearings: Any
    used: Any
    cost: Any


@helper
def innovations(x, P, lw, z, valid, stations, var, second_order, gate, nu, S, inside):
    """Innovations of one track's hypotheses and the moments of their joint density.

    With `second_order` each station's variance holds its bearing's curvature; the stations' cross-covariance does not.

    Fills nu [s, n, b]; S [6, n]: S_a, S_b, regression S_ab / S_a, conditional variance S_b|a, logs of S_a and S_b|a;
    inside [2, b]: returns in some gate.
    """
    inside[:] = False
    for i in range(lw.shape[0]):
        if lw[i] <= PRUNED:
            continue
        f0 = f1 = 0.0
        for s in range(z.shape[0]):
            h, a, b = linearize(x[i, 0], x[i, 1], stations[s, 0], stations[s, 1])
            cross = a * f0 + b * f1
            f0, f1 = a * P[i, 0, 0] + b * P[i, 0, 1], a * P[i, 0, 1] + b * P[i, 1, 1]
            S[s, i] = a * f0 + b * f1 + var
            if second_order:
                S[s, i] += curvature(P[i], a, b)
            if s == 1:
                S[2, i] = cross / S[0, i]
                S[3, i] = S[1, i] - S[2, i] * cross
                S[5, i] = math.log(S[3, i])
            else:
                S[4, i] = math.log(S[0, i])
            limit = gate * gate * S[s, i]
            for k in range(z.shape[1]):
                if valid[s, k]:
                    v = wrap_scalar(z[s, k] - h)
                    nu[s, i, k] = v
                    if v * v <= limit:
                        inside[s, k] = True


@helper
def pair_log_likelihood(nu, S, i, ka, kb):
    """Joint log-likelihood of the returns (ka, kb) of the two stations under hypothesis i; −1 for none."""
    if ka >= 0:
        va = nu[0, i, ka]
        e = -0.5 * (LOG_TWO_PI + S[4, i] + va * va / S[0, i])
        if kb >= 0:
            vb = nu[1, i, kb] - S[2, i] * va
            e -= 0.5 * (LOG_TWO_PI + S[5, i] + vb * vb / S[3, i])
        return e
    return log_normal(nu[1, i, kb], S[1, i]) if kb >= 0 else 0.0


@helper
def _pair_cost(lw, nu, S, ka, kb, row):
    """−log of the mixture's likelihood of the returns (ka, kb); each hypothesis' own goes to row [n]."""
    if ka < 0 and kb < 0:
        row[:] = 0.0
        return 0.0
    best, total = -math.inf, 0.0
    for i in range(lw.shape[0]):
        if lw[i] <= PRUNED:
            continue
        row[i] = pair_log_likelihood(nu, S, i, ka, kb)
        e = lw[i] + row[i]
        if e > best:
            total = total * math.exp(best - e) + 1.0 if best - e > NEGLIGIBLE else 1.0
            best = e
        elif e - best > NEGLIGIBLE:
            total += math.exp(e - best)
    return -best - math.log(total) if total != 1.0 else -best


@helper
def list_options(lw, nu, S, inside, two_stations, hit, miss, c_opt, k_opt, log_likelihood):
    """Every combination of gated returns and misses of one track, cheapest first; returns their number.

    Fills costs c_opt [o]; returns of both stations and a row number k_opt [o, 3]; log_likelihood [row, n].
    """
    count = 0
    n_slots = inside.shape[1]
    for ka in range(-1, n_slots):
        if ka >= 0 and not inside[0, ka]:
            continue
        for kb in range(-1, n_slots if two_stations else 0):
            if kb >= 0 and not inside[1, kb]:
                continue
            c = _pair_cost(lw, nu, S, ka, kb, log_likelihood[count]) + (hit if ka >= 0 else miss)
            if two_stations:
                c += hit if kb >= 0 else miss
            t = count
            while t > 0 and c_opt[t - 1] > c:
                c_opt[t] = c_opt[t - 1]
                for q in range(3):
                    k_opt[t, q] = k_opt[t - 1, q]
                t -= 1
            c_opt[t] = c
            k_opt[t, 0], k_opt[t, 1], k_opt[t, 2] = ka, kb, count
            count += 1
    return count


@helper
def walk_assignments(c_opt, k_opt, count, bound, collect, chosen, weight, sums, marks):
    """Depth-first walk over joint assignments cheaper than a bound; options are sorted, so a level ends at the first
    one that cannot win.

    collect False: the bound shrinks to the best assignment found, which is left in `chosen` [m]; returns its cost.
    collect True: every assignment below the bound adds exp(bound − cost) to `weight` [m, options] of its options.
    Scratch: sums [2, > m] float, marks [3, > m and > returns] int.
    """
    m = c_opt.shape[0]
    suffix, prefix = sums[0], sums[1]  # cost still to come at least, cost so far
    cursor, owner = marks[0], marks[1:]  # next option of each level; which level holds a return
    suffix[m] = prefix[0] = 0.0
    for j in range(m - 1, -1, -1):
        suffix[j] = suffix[j + 1] + c_opt[j, 0]
        cursor[j] = 0
    owner[:] = -1
    found, nodes, level = False, 0, 0
    while level >= 0:
        nodes += 1
        if cursor[level] > 0:  # release what this level held
            for s in range(2):
                k = k_opt[level, cursor[level] - 1, s]
                if k >= 0 and owner[s, k] == level:
                    owner[s, k] = -1
        o = cursor[level]
        exhausted = o >= count[level] or (nodes > NODE_LIMIT and found)
        if exhausted or prefix[level] + c_opt[level, o] + suffix[level + 1] >= bound:
            cursor[level] = 0
            level -= 1
            continue
        cursor[level] += 1
        ka, kb = k_opt[level, o, 0], k_opt[level, o, 1]
        if (ka >= 0 and owner[0, ka] >= 0) or (kb >= 0 and owner[1, kb] >= 0):
            continue
        if level == m - 1:
            found = True
            c = prefix[level] + c_opt[level, o]
            if collect:
                for j in range(m):
                    weight[j, cursor[j] - 1] += math.exp(bound - c)
            else:
                bound = c
                for j in range(m):
                    chosen[j] = cursor[j] - 1
            continue
        if ka >= 0:
            owner[0, ka] = level
        if kb >= 0:
            owner[1, kb] = level
        prefix[level + 1] = prefix[level] + c_opt[level, o]
        level += 1
    return bound


@kernel("(m,n,x),(m,n,x,x),(m,n),(s,b),(s,b),(s,p),(),(),(),(),()->(m,s),(m,s),(m,s),()", "ffffbfffffbifbf")
def _associate(x, P, lw, z, valid, stations, std, gate, miss, hit, second_order, assignment, z_out, used, total):
    n_tracks, n_hyp = lw.shape
    n_stations, n_slots = z.shape
    c_opt = np.empty((n_tracks, (n_slots + 1) ** n_stations))
    k_opt = np.empty((n_tracks, c_opt.shape[1], 3), dtype=np.int64)
    count = np.zeros(n_tracks, dtype=np.int64)
    nu, S = np.empty((n_stations, n_hyp, n_slots)), np.empty((6, n_hyp))
    rows = np.empty((c_opt.shape[1], n_hyp))
    inside = np.zeros((2, n_slots), dtype=np.bool_)
    for j in range(n_tracks):
        innovations(x[j], P[j], lw[j], z, valid, stations, std * std, second_order, gate, nu, S, inside)
        count[j] = list_options(lw[j], nu, S, inside, n_stations == 2, hit, miss, c_opt[j], k_opt[j], rows)
    best = np.zeros(n_tracks, dtype=np.int64)
    sums, marks = np.empty((2, n_tracks + 1)), np.empty((3, n_tracks + n_slots + 1), dtype=np.int64)
    total[0] = walk_assignments(c_opt, k_opt, count, math.inf, False, best, c_opt, sums, marks)
    for j in range(n_tracks):
        for s in range(n_stations):
            k = k_opt[j, best[j], s]
            assignment[j, s] = k
            used[j, s] = k >= 0
            z_out[j, s] = z[s, k] if k >= 0 else 0.0


def associate(
    mean, cov, log_weights, scan: Scan, model: AssociationModel = AssociationModel(), second_order: bool = False
):
    """Assign a scan's unlabelled bearings to tracks: exact minimum of the summed negative log-likelihood.

    Each bearing serves at most one track, each track takes at most one bearing per station; missed and extra bearings
    are allowed. A bearing is a candidate for a track if it lies in the gate of one of the track's hypotheses.

    Args:
        mean: [..., m, n, 4], cov: [..., m, n, 4, 4], log_weights: [..., m, n] predicted tracks with n hypotheses
            (`PRUNED` marks removed ones).
        scan: one or two stations (s), b slots.
        model: gates, detection probability, clutter density.
        second_order: whether a bearing's curvature adds to its innovation variance.
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
        model.gate_sigma, miss, hit, second_order,
    )  # fmt: skip
    return Association(assignment, bearings, used, cost)
