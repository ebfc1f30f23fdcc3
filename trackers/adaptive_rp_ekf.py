"""The range-parameterised bank for targets that maneuver: every range hypothesis is an interacting multiple model.

Each of n range hypotheses carries r motion models side by side (constant velocity or a turn at a known rate, each
with its own process noise), and a Markov chain says how a target switches between them. Per step and hypothesis i:

    predicted weight   w⁻_{i,j} = Σ_k Π_{kj} w_{i,k}
    mixed start        x⁰_{i,j} = Σ_k μ_{k|j} x_{i,k}    μ_{k|j} = Π_{kj} w_{i,k} / w⁻_{i,j}    (P⁰ moment-matched)
    prediction         model j from (x⁰_{i,j}, P⁰_{i,j})
    update             w_{i,j} ∝ w⁻_{i,j} L_{i,j}, over all n · r filters together

Ranges never mix with each other: their weights are the paper's, models interact within a range only.
Source: Blom and Bar-Shalom, IEEE Trans. Automatic Control 33(8), 1988; Bar-Shalom, Li and Kirubarajan, Estimation
with Applications to Tracking and Navigation (2001), section 11.6.6 (IMM) and section 11.7.1 (turn at a known rate).
Approximations: the IMM's (moment-matched mixing instead of all model histories) and those of `jpda`, which associates
bearings and tracks over all n · r filters.
Limits: averaging cannot take a traded bearing back. Where many crossings of two stations' bearings compete (ghosts),
the branching bank of `RpEkf` with a large process noise tracks better.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from trackers.association import PRUNED
from trackers.compiled import kernel
from trackers.contract import Scan, Update
from trackers.gaussian import Gaussian
from trackers.hypotheses import clear_hypothesis
from trackers.jpda import average_and_update
from trackers.motion import turn_in_place
from trackers.position_update import moment_match_into
from trackers.rp_ekf import Bank, RpEkf, estimate


class ModelBank(NamedTuple):
    """A bank of n range hypotheses with r motion models each.

    Attributes:
        mean: [..., n, r, 4] x, y [m], vx, vy [m/s].
        cov: [..., n, r, 4, 4].
        log_weights: [..., n, r]; `PRUNED` marks removed filters; exp of the others sums to 1 over n and r.
    """

    mean: Any
    cov: Any
    log_weights: Any

    @property
    def model_probabilities(self) -> Any:
        """[..., r] probability that the target moves by each model, whatever its range."""
        return np.exp(self.log_weights).sum(-2)

    def flat(self) -> Bank:
        """The same filters as one bank of n · r hypotheses, model index fastest."""
        *lead, n, r, d = self.mean.shape
        return Bank(
            self.mean.reshape(*lead, n * r, d),
            self.cov.reshape(*lead, n * r, d, d),
            self.log_weights.reshape(*lead, n * r),
        )


@kernel("(n,r,x),(n,r,x,x),(n,r),(r,r),(r),(r),()->(n,r,x),(n,r,x,x),(n,r)")
def _mix_and_predict(x, P, lw, transition, q, rate, T, x_out, P_out, lw_out):
    n, r = lw.shape
    share = np.empty(r)
    for i in range(n):
        top = lw[i, 0]
        for k in range(1, r):
            top = max(top, lw[i, k])
        for j in range(r):
            total = 0.0
            for k in range(r):
                share[k] = transition[k, j] * math.exp(lw[i, k] - top)
                total += share[k]
            if top <= PRUNED or total <= 0.0:
                clear_hypothesis(x_out[i, j], P_out[i, j])
                lw_out[i, j] = PRUNED
                continue
            for k in range(r):
                share[k] /= total
            lw_out[i, j] = top + math.log(total)
            moment_match_into(x[i], P[i], share, 4, x_out[i, j], P_out[i, j])
            turn_in_place(x_out[i, j], P_out[i, j], T, rate[j], q[j])


def mix_and_predict(bank: ModelBank, transition, velocity_std, turn_rate, step_s) -> ModelBank:
    """Let the models of every range hypothesis interact, then propagate each by one step.

    Args:
        bank: [..., n, r] filters.
        transition: [r, r] Π, row from, column to; rows sum to 1.
        velocity_std: [r] q of each model [m/s per step].
        turn_rate: [r] rad/s, counter-clockwise; 0 for constant velocity.
        step_s: T [...] s.
    """
    return ModelBank(*_mix_and_predict(*bank, transition, velocity_std, turn_rate, step_s))


@dataclass(frozen=True)
class AdaptiveRpEkf(RpEkf):
    """A range-parameterised bank whose filters switch between motion models (`trackers.contract.Tracker`).

    The first model is constant velocity, the others turn. Settings as in `RpEkf`, except that hypotheses never merge
    (`merge_below` has no effect), and:
        process_noise: q of the first model [m/s per step].
        maneuver_noise: q of the others [m/s per step].
        turn_rates_deg_s: turn rate of each further model, counter-clockwise; 0 is constant velocity.
        transition: [r, r] Π, probability to go from one model (row) to another (column) in one step; the default is
            meant for steps of 5 s and turns of 10 to 30 s.
    """

    process_noise: float = 5.0
    second_order: bool = True
    maneuver_noise: float = 10.0
    turn_rates_deg_s: tuple[float, ...] = (2.0, -2.0)
    transition: tuple[tuple[float, ...], ...] = ((0.93, 0.035, 0.035), (0.2, 0.6, 0.2), (0.2, 0.2, 0.6))

    def __post_init__(self) -> None:
        super().__post_init__()
        if not 0.0 <= self.maneuver_noise < math.inf:
            raise ValueError(f"AdaptiveRpEkf.maneuver_noise = {self.maneuver_noise!r}: must be at least 0")
        if not all(math.isfinite(rate) for rate in self.turn_rates_deg_s):
            raise ValueError(f"AdaptiveRpEkf.turn_rates_deg_s = {self.turn_rates_deg_s!r}: must be finite")
        r = 1 + len(self.turn_rates_deg_s)
        if [len(row) for row in self.transition] != [r] * r:
            raise ValueError(
                f"AdaptiveRpEkf.transition = {self.transition!r}: must be {r} rows of {r}, one per model "
                f"(constant velocity and {r - 1} turn_rates_deg_s)"
            )
        matrix = np.array(self.transition, dtype=float)
        if not ((matrix >= 0.0).all() and np.allclose(matrix.sum(1), 1.0, rtol=0.0, atol=1e-9)):
            raise ValueError(
                f"AdaptiveRpEkf.transition = {self.transition!r}: must hold probabilities, every row summing to 1"
            )

    @cached_property
    def _models(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Π [r, r], q [r] m/s per step, turn rates [r] rad/s."""
        rates = np.radians((0.0, *self.turn_rates_deg_s))
        q = np.full(len(rates), self.maneuver_noise)
        q[0] = self.process_noise
        return np.array(self.transition, dtype=float), q, rates

    def initiate(self, scan: Scan) -> ModelBank:
        """One bank per reference bearing; all models start alike, weighed by the chain's long-run shares."""
        bank = super().initiate(scan)
        share = stationary(self._models[0])
        r = len(share)
        log_share = np.full(r, PRUNED)
        np.log(share, out=log_share, where=share > 0.0)
        return ModelBank(
            np.repeat(bank.mean[..., None, :], r, axis=-2),
            np.repeat(bank.cov[..., None, :, :], r, axis=-3),
            np.maximum(bank.log_weights[..., None] + log_share, PRUNED),
        )

    def predict(self, state: ModelBank, step_s) -> ModelBank:
        """Mix the models of every hypothesis and propagate each by one step."""
        return mix_and_predict(state, *self._models, step_s)

    def update(self, state: ModelBank, scan: Scan) -> Update:
        """Condition all filters on the returns they may have caused, weighed by the joint assignments (`jpda`)."""
        if self.reference_only:
            scan = scan.reference_only()
        *bank, nu, S, assignment, log_likelihood = average_and_update(
            *state.flat(), scan, self.model, self.prune_below, self.second_order
        )
        posterior = ModelBank(*(part.reshape(before.shape) for part, before in zip(bank, state, strict=True)))
        return Update(posterior, nu, S, log_likelihood, assignment)

    def estimate(self, state: ModelBank) -> Gaussian:
        """Mixture mean [..., m, 4] and covariance [..., m, 4, 4]."""
        return estimate(state.flat())


def stationary(transition) -> np.ndarray:
    """Long-run share [r] of each model of a Markov chain Π [r, r]: p Π = p, Σ p = 1 (least squares)."""
    r = len(transition)
    system = np.vstack([np.transpose(transition) - np.eye(r), np.ones((1, r))])
    share = np.linalg.lstsq(system, np.append(np.zeros(r), 1.0), rcond=None)[0]
    share = np.where(share > 1e-12, share, 0.0)
    return share / share.sum()
