"""Range-parameterised EKF: a bank of EKFs, one per geometric subinterval of the unknown range.

Source: Xiu et al. (2002), eqs 11–38. Deviations, each stated where it is made: the weights live in the log domain,
are renormalised after pruning, and the best hypothesis always stays; the state is absolute; any number of stations'
bearings may enter an update; by default initial velocity has zero mean; `RpEkf` prunes at 1e-4 in place of 1e-3 (a
right hypothesis that one scan speaks against comes back) and merges hypotheses that have become one.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from trackers.association import PRUNED, AssociationModel
from trackers.compiled import kernel
from trackers.contract import Scan, Update
from trackers.gaussian import Gaussian
from trackers.hypotheses import clear_hypothesis, copy_hypothesis, log_threshold, reweight
from trackers.lone_return import is_lone, take_or_branch
from trackers.measurement import log_normal, update_into
from trackers.motion import predict_into
from trackers.soft_association import branch_and_update
from trackers.triangulation import RangeInterval, admissible_crossings, forward_interval

_FOUR = np.zeros(4)
"""Tells a kernel the length of the state, which no other input carries."""


class Bank(NamedTuple):
    """A bank of n EKFs.

    Attributes:
        mean: [..., n, 4] x, y [m], vx, vy [m/s].
        cov: [..., n, 4, 4].
        log_weights: [..., n]; `PRUNED` marks removed hypotheses; exp of the others sums to 1.
    """

    mean: Any
    cov: Any
    log_weights: Any


class BranchedBank(NamedTuple):
    """A bank whose hypotheses branch over returns (`trackers.soft_association`).

    Attributes:
        mean, cov, log_weights: as in `Bank`; the weights include that every return has one owner.
        own_log_weights: [..., n] weights from the track's own likelihoods only.
    """

    mean: Any
    cov: Any
    log_weights: Any
    own_log_weights: Any


class Subintervals(NamedTuple):
    """Geometric subintervals: centre [..., n] m, half length [..., n] m, prior weight [..., n]."""

    center: Any
    half_length: Any
    weight: Any


class BankUpdate(NamedTuple):
    """Posterior bank; innovation and its variance [..., s], moment-matched over hypotheses; log-likelihood [...]."""

    posterior: Bank
    innovation: Any
    innovation_var: Any
    log_likelihood: Any


@kernel("(),(),(n)->(n),(n),(n)")
def _subintervals(low, high, like, center, half_length, weight):
    n = like.shape[0]
    rho = (high / low) ** (1.0 / n)
    edge = low
    for i in range(n):
        upper = high if i == n - 1 else edge * rho
        center[i] = 0.5 * (upper + edge)
        half_length[i] = 0.5 * (upper - edge)
        weight[i] = (upper - edge) / (high - low)
        edge = upper


def subintervals(interval: RangeInterval, n: int) -> Subintervals:
    """Split a range interval into n subintervals with a constant ratio of length to distance.

        ρ = (R_max / R_min)^(1/n)    R_i = ρ^{i−1}(ρ + 1) R_min / 2    σ_i = ρ^{i−1}(ρ − 1) R_min / 2

    Args:
        interval: bounds [...] m, 0 < low < high.
        n: number of subintervals, at least 1.
    Source: Xiu et al. (2002), eqs 11–17, 21. σ_i is the half length, used as a standard deviation (conservative).
    """
    return Subintervals(*_subintervals(interval.low, interval.high, np.empty(n)))


@kernel("(),(p),(),(n),(n),(n),(),(),(x)->(n,x),(n,x,x),(n)")
def _initiate(alpha, station, std, center, half_length, weight, radial_speed, speed_std, like, mean, cov, log_w):
    c, s = math.cos(alpha), math.sin(alpha)
    cov[:] = 0.0
    for i in range(center.shape[0]):
        mean[i, 0] = station[0] + center[i] * c
        mean[i, 1] = station[1] + center[i] * s
        mean[i, 2], mean[i, 3] = radial_speed * c, radial_speed * s
        cross, radial = (center[i] * std) ** 2, half_length[i] ** 2
        cov[i, 0, 0] = radial * c * c + cross * s * s
        cov[i, 1, 1] = radial * s * s + cross * c * c
        cov[i, 0, 1] = cov[i, 1, 0] = (radial - cross) * c * s
        cov[i, 2, 2] = cov[i, 3, 3] = speed_std * speed_std
        log_w[i] = math.log(weight[i])


def initiate(
    bearing, station, bearing_std, interval: RangeInterval, n: int = 8, radial_speed=0.0, velocity_std=200.0
) -> Bank:
    """Start a bank along a bearing: one EKF per subinterval of the range interval.

    Args:
        bearing: [...] rad, reference bearing α.
        station: [..., 2] reference station [m].
        bearing_std: [...] rad.
        interval: range bounds [...] m.
        n: number of hypotheses.
        radial_speed: [...] m/s along α; the paper's literal start is outward, v_s > 0.
        velocity_std: [...] m/s per axis.
    Source: Xiu et al. (2002), eqs 18–21. Deviation: zero-mean velocity by default.
    """
    parts = subintervals(interval, n)
    return Bank(*_initiate(bearing, station, bearing_std, *parts, radial_speed, velocity_std, _FOUR))


@kernel("(n,x),(n,x,x),(n),(),()->(n,x),(n,x,x)", "FFFffFF")
def _predict(x, P, lw, T, q, x_out, P_out):
    for i in range(lw.shape[0]):
        if lw[i] <= PRUNED:
            clear_hypothesis(x_out[i], P_out[i])
        else:
            predict_into(x[i], P[i], T, q, x_out[i], P_out[i])


def predict(bank: Bank, step_s, velocity_std) -> Bank:
    """Propagate every hypothesis by one step (`trackers.motion`); weights are unchanged, removed ones are zeroed."""
    mean, cov = _predict(bank.mean, bank.cov, bank.log_weights, step_s, velocity_std)
    return Bank(mean, cov, bank.log_weights)


@kernel("(n,x),(n,x,x),(n),(s),(s),(s,p),(),(),()->(n,x),(n,x,x),(n),(s),(s),()", "ffffbfffbffffff")
def _update(x, P, lw, z, used, stations, std, log_prune, second_order, x_out, P_out, lw_out, nu_out, S_out, evidence):
    n, n_stations = lw.shape[0], z.shape[0]
    var = std * std
    nu_out[:] = 0.0
    S_out[:] = 0.0
    any_used = False
    for i in range(n):
        lw_out[i] = lw[i]
    x_prior, P_prior = x, P
    for s in range(n_stations):
        if not used[s]:
            continue
        for i in range(n):
            if lw[i] <= PRUNED:
                continue
            nu, S = update_into(
                x_prior[i], P_prior[i], z[s], stations[s, 0], stations[s, 1], var, second_order, x_out[i], P_out[i]
            )
            lw_out[i] += log_normal(nu, S)
            w = 1.0 if lw[i] == 0.0 else math.exp(lw[i])
            nu_out[s] += w * nu
            S_out[s] += w * (S + nu * nu)
        x_prior, P_prior = x_out, P_out
        any_used = True
    for i in range(n):
        if lw[i] <= PRUNED or not any_used:
            copy_hypothesis(x[i], P[i], x_out[i], P_out[i])
    for s in range(n_stations):
        S_out[s] = max(S_out[s] - nu_out[s] * nu_out[s], var)
    evidence[0] = reweight(lw_out, log_prune) if any_used else 0.0


def update(
    bank: Bank, bearings, used, stations, bearing_std, prune_below=1e-3, second_order: bool = False
) -> BankUpdate:
    """Condition every hypothesis on the bearings of one or several stations, then reweight and prune.

        w_i(k) ∝ w_i(k−1) |2πS_i|^{−1/2} exp(−ν_i² / 2S_i)

    Stations enter one after the other, each linearised at the estimate the previous one left.

    Args:
        bank: [..., n] hypotheses.
        bearings: [..., s] rad; used: [..., s] bool (False: missed, no effect).
        stations: [..., s, 2] m.
        bearing_std: [...] rad.
        prune_below: weight below which a hypothesis is removed for good, 0 for none; the best one always stays.
        second_order: whether a bearing's curvature adds to its innovation variance (`measurement.update`).
    Source: Xiu et al. (2002), eqs 22–23, 28, 31–36. Deviations: logs, renormalisation after pruning, absolute state.
    """
    mean, cov, log_weights, nu, S, evidence = _update(
        *bank, bearings, used, stations, bearing_std, log_threshold(prune_below), second_order
    )
    return BankUpdate(Bank(mean, cov, log_weights), nu, S, evidence)


@kernel("(n,x),(n,x,x),(n)->(x),(x,x)", "FFFFF")
def _estimate(x, P, lw, x_out, P_out):
    n = lw.shape[0]
    alive, only = 0, 0
    a = b = c = d = 0.0
    for i in range(n):
        if lw[i] > PRUNED:
            alive, only = alive + 1, i
            w = math.exp(lw[i])
            a, b, c, d = a + w * x[i, 0], b + w * x[i, 1], c + w * x[i, 2], d + w * x[i, 3]
    if alive == 1:
        copy_hypothesis(x[only], P[only], x_out, P_out)
        return
    x_out[0], x_out[1], x_out[2], x_out[3] = a, b, c, d
    p00 = p01 = p02 = p03 = p11 = p12 = p13 = p22 = p23 = p33 = 0.0
    for i in range(n):
        if lw[i] > PRUNED:
            w = math.exp(lw[i])
            e, f, g, h = x[i, 0] - a, x[i, 1] - b, x[i, 2] - c, x[i, 3] - d
            p00, p01 = p00 + w * (P[i, 0, 0] + e * e), p01 + w * (P[i, 0, 1] + e * f)
            p02, p03 = p02 + w * (P[i, 0, 2] + e * g), p03 + w * (P[i, 0, 3] + e * h)
            p11, p12 = p11 + w * (P[i, 1, 1] + f * f), p12 + w * (P[i, 1, 2] + f * g)
            p13, p22 = p13 + w * (P[i, 1, 3] + f * h), p22 + w * (P[i, 2, 2] + g * g)
            p23, p33 = p23 + w * (P[i, 2, 3] + g * h), p33 + w * (P[i, 3, 3] + h * h)
    P_out[0, 0], P_out[1, 1], P_out[2, 2], P_out[3, 3] = p00, p11, p22, p33
    P_out[0, 1], P_out[0, 2], P_out[0, 3] = p01, p02, p03
    P_out[1, 0], P_out[1, 2], P_out[1, 3] = p01, p12, p13
    P_out[2, 0], P_out[2, 1], P_out[2, 3] = p02, p12, p23
    P_out[3, 0], P_out[3, 1], P_out[3, 2] = p03, p13, p23


def estimate(bank: Bank) -> Gaussian:
    """Mixture mean [..., 4] and covariance [..., 4, 4]. Source: Xiu et al. (2002), eqs 37–38."""
    return Gaussian(*_estimate(*bank))


@dataclass(frozen=True)
class RpEkf:
    """The range-parameterised EKF as a multi-target tracker (`trackers.contract.Tracker`).

    The last station of a scan is the reference. Settings, SI units:
        hypotheses: EKFs per target.
        floor_m, cap_m: nearest and farthest range a target is looked for.
        velocity_std: initial velocity standard deviation per axis [m/s].
        process_noise: q [m/s per step].
        prune_below: weight at which a hypothesis is removed; 0 keeps all.
        merge_below: squared Mahalanobis distance at which two hypotheses become one. A bank that merges late stays
            fine-grained in range, which matters when few bearings have to tell ranges apart.
        second_order: whether a bearing's curvature adds to its innovation variance. A track that is passed closely
            while its range is poorly known then stays honest.
        reference_only: use the reference station's bearings only after initiation, as in the paper.
        model: gates and detection model of the association.
    """

    hypotheses: int = 8
    floor_m: float = 5.0e3
    cap_m: float = 2.0e5
    velocity_std: float = 200.0
    process_noise: float = 15.0
    prune_below: float = 1e-4
    merge_below: float = 4.0
    second_order: bool = False
    reference_only: bool = False
    model: AssociationModel = AssociationModel()

    def __post_init__(self) -> None:
        for field, good, allowed in (
            ("hypotheses", self.hypotheses >= 1, "at least 1"),
            ("floor_m", 0.0 < self.floor_m < math.inf, "positive"),
            ("cap_m", self.floor_m < self.cap_m < math.inf, f"above floor_m = {self.floor_m}"),
            ("velocity_std", 0.0 < self.velocity_std < math.inf, "positive"),
            ("process_noise", 0.0 <= self.process_noise < math.inf, "at least 0"),
            ("prune_below", 0.0 <= self.prune_below < 1.0, "in [0, 1)"),
            ("merge_below", 0.0 <= self.merge_below < math.inf, "at least 0"),
        ):
            if not good:
                raise ValueError(f"{type(self).__name__}.{field} = {getattr(self, field)!r}: must be {allowed}")

    def initiate(self, scan: Scan) -> BranchedBank:
        """One bank per reference bearing, over the range interval of its forward crossings.

        A single station has no crossings: its banks start over the whole [floor_m, cap_m].
        """
        alpha, reference = scan.bearings[..., -1, :], scan.stations[..., None, -1, :]
        interval = self._crossings(scan) if scan.stations.shape[-2] > 1 else RangeInterval(self.floor_m, self.cap_m)
        bank = initiate(alpha, reference, scan.bearing_std, interval, self.hypotheses, 0.0, self.velocity_std)
        return BranchedBank(*bank, bank.log_weights)

    def _crossings(self, scan: Scan) -> RangeInterval:
        alpha, reference = scan.bearings[..., -1, :], scan.stations[..., None, -1, :]
        others, station = scan.bearings[..., None, 0, :], scan.stations[..., None, 0, :]
        spread = 3.0 * math.sqrt(2.0) * scan.bearing_std
        valid = admissible_crossings(
            alpha, scan.valid[..., -1, :], scan.stations[..., -1, :], scan.bearings[..., 0, :], scan.valid[..., 0, :],
            scan.stations[..., 0, :], spread, self.floor_m, self.cap_m,
        )  # fmt: skip
        return forward_interval(alpha, reference, others, valid, station, spread, self.floor_m, self.cap_m)

    def predict(self, state: BranchedBank, step_s) -> BranchedBank:
        """Propagate all hypotheses by one step."""
        mean, cov = _predict(state.mean, state.cov, state.log_weights, step_s, self.process_noise)
        return BranchedBank(mean, cov, state.log_weights, state.own_log_weights)

    def update(self, state: BranchedBank, scan: Scan) -> Update:
        """Branch every hypothesis over the returns, weighed by the joint assignments (`soft_association`)."""
        if self.reference_only:
            scan = scan.reference_only()
        condition = take_or_branch if is_lone(state.mean, scan) else branch_and_update
        *bank, nu, S, assignment, log_likelihood = condition(
            state.mean,
            state.cov,
            state.own_log_weights,
            scan,
            self.model,
            self.prune_below,
            self.merge_below,
            self.second_order,
        )
        return Update(BranchedBank(*bank), nu, S, log_likelihood, assignment)

    def estimate(self, state: BranchedBank) -> Gaussian:
        """Mixture mean [..., m, 4] and covariance [..., m, 4, 4]."""
        return estimate(Bank(state.mean, state.cov, state.log_weights))
