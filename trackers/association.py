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
from trackers.compiled import kernel
from trackers.contract import Scan
from trackers.linalg import LOG_TWO_PI
from trackers.measurement import linearize

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


@kernel("(m,n,x),(m,n,x,x),(m,n),(s,b),(s,b),(s,p),(),(),(),(),()->(m,s),(m,s),(m,s),()", "ffffbffffffifbf")
def _associate(x, P, lw, z, valid, stations, std, gate, miss, hit, pruned, assignment, z_out, used, cost):
    n_tracks, n_hyp = lw.shape
    n_stations, n_slots = z.shape
    options = (n_slots + 1) ** n_stations
    c_opt = np.empty((n_tracks, options))
    a_opt = np.empty((n_tracks, options), dtype=np.int64)
    b_opt = np.empty((n_tracks, options), dtype=np.int64)
    count = np.zeros(n_tracks, dtype=np.int64)
    nu = np.empty((n_stations, n_hyp, n_slots))
    inside = np.empty((n_stations, n_slots), dtype=np.bool_)
    S = np.empty((3, n_hyp))  # S_aa, S_bb, S_ab per hypothesis
    var = std * std
    last = n_stations - 1

    for j in range(n_tracks):
        inside[:] = False
        for i in range(n_hyp):
            if lw[j, i] <= pruned:
                continue
            p00, p01, p11 = P[j, i, 0, 0], P[j, i, 0, 1], P[j, i, 1, 1]
            f0 = f1 = 0.0
            for s in range(n_stations):
                h, a, b = linearize(x[j, i, 0], x[j, i, 1], stations[s, 0], stations[s, 1])
                if s == 1:
                    S[2, i] = a * f0 + b * f1
                f0, f1 = a * p00 + b * p01, a * p01 + b * p11
                S[s, i] = a * f0 + b * f1 + var
                limit = gate * gate * S[s, i]
                for k in range(n_slots):
                    if valid[s, k]:
                        v = wrap_scalar(z[s, k] - h)
                        nu[s, i, k] = v
                        if v * v <= limit:
                            inside[s, k] = True

        # Options of this track: every combination of gated bearings and misses, cheapest first.
        for ka in range(-1, n_slots):
            if ka >= 0 and not inside[0, ka]:
                continue
            for kb in range(-1, n_slots if n_stations == 2 else 0):
                if kb >= 0 and not inside[last, kb]:
                    continue
                best, total = -math.inf, 0.0
                for i in range(n_hyp):
                    if lw[j, i] <= pruned:
                        continue
                    e = lw[j, i]
                    if ka >= 0 and kb >= 0:
                        va, vb = nu[0, i, ka], nu[1, i, kb]
                        det = S[0, i] * S[1, i] - S[2, i] * S[2, i]
                        q = (S[1, i] * va * va - 2.0 * S[2, i] * va * vb + S[0, i] * vb * vb) / det
                        e -= LOG_TWO_PI + 0.5 * (math.log(det) + q)
                    elif ka >= 0:
                        e -= 0.5 * (LOG_TWO_PI + math.log(S[0, i]) + nu[0, i, ka] ** 2 / S[0, i])
                    elif kb >= 0:
                        e -= 0.5 * (LOG_TWO_PI + math.log(S[1, i]) + nu[1, i, kb] ** 2 / S[1, i])
                    if e > best:
                        total = total * math.exp(best - e) + 1.0
                        best = e
                    else:
                        total += math.exp(e - best)
                c = -best - math.log(total) + (hit if ka >= 0 else miss)
                if n_stations == 2:
                    c += hit if kb >= 0 else miss
                t = count[j]
                while t > 0 and c_opt[j, t - 1] > c:
                    c_opt[j, t], a_opt[j, t], b_opt[j, t] = c_opt[j, t - 1], a_opt[j, t - 1], b_opt[j, t - 1]
                    t -= 1
                c_opt[j, t], a_opt[j, t], b_opt[j, t] = c, ka, kb
                count[j] += 1

    # Depth-first branch and bound: options are sorted, so the first one that cannot win ends its level.
    suffix = np.zeros(n_tracks + 1)
    for j in range(n_tracks - 1, -1, -1):
        suffix[j] = suffix[j + 1] + c_opt[j, 0]
    prefix = np.zeros(n_tracks + 1)
    cursor = np.zeros(n_tracks, dtype=np.int64)
    owner_a = np.full(n_slots + 1, -1)
    owner_b = np.full(n_slots + 1, -1)
    best_cost, nodes, level = math.inf, 0, 0
    while level >= 0:
        nodes += 1
        o = cursor[level] - 1
        if o >= 0:  # release what this level held
            if owner_a[a_opt[level, o]] == level:
                owner_a[a_opt[level, o]] = -1
            if owner_b[b_opt[level, o]] == level:
                owner_b[b_opt[level, o]] = -1
        o = cursor[level]
        if (
            o >= count[level]
            or prefix[level] + c_opt[level, o] + suffix[level + 1] >= best_cost
            or (nodes > NODE_LIMIT and best_cost < math.inf)
        ):
            cursor[level] = 0
            level -= 1
            continue
        cursor[level] += 1
        ka, kb = a_opt[level, o], b_opt[level, o]
        if (ka >= 0 and owner_a[ka] >= 0) or (kb >= 0 and owner_b[kb] >= 0):
            continue
        c = prefix[level] + c_opt[level, o]
        if level == n_tracks - 1:
            best_cost = c
            for j in range(n_tracks):
                assignment[j, 0] = a_opt[j, cursor[j] - 1]
                if n_stations == 2:
                    assignment[j, 1] = b_opt[j, cursor[j] - 1]
            continue
        if ka >= 0:
            owner_a[ka] = level
        if kb >= 0:
            owner_b[kb] = level
        prefix[level + 1] = c
        level += 1

    cost[0] = best_cost
    for j in range(n_tracks):
        for s in range(n_stations):
            k = assignment[j, s]
            used[j, s] = k >= 0
            z_out[j, s] = z[s, k] if k >= 0 else 0.0


def associate(mean, cov, log_weights, scan: Scan, model: AssociationModel = AssociationModel(), pruned=-1.0e6):
    """Assign a scan's unlabelled bearings to tracks: exact minimum of the summed negative log-likelihood.

    Each bearing serves at most one track, each track takes at most one bearing per station; missed and extra bearings
    are allowed. A bearing is a candidate for a track if it lies in the gate of one of the track's hypotheses.

    Args:
        mean: [..., m, n, 4], cov: [..., m, n, 4, 4], log_weights: [..., m, n] predicted tracks with n hypotheses.
        scan: one or two stations (s), b slots.
        model: gates, detection probability, clutter density.
        pruned: log weight at or below which a hypothesis does not count.
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
        model.gate_sigma, miss, hit, pruned,
    )  # fmt: skip
    return Association(assignment, bearings, used, cost)
