"""Interacting multiple models on measured positions, for any linear models and any transition matrix.

    c_j = Σ_i p_ij μ_i,   W_ij = p_ij μ_i / c_j,   (x⁰_j, P⁰_j) moment-matched over i with W_ij;
    x⁻_j = F_j x⁰_j,   P⁻_j = F_j P⁰_j F_jᵀ + Q_j,   Kalman update,   μ_j ∝ Λ_j c_j

and the baseline of Sheng et al. (2009): constant velocity and twice constant acceleration. Its models have states of
different dimension. They share the state [p, v, a], in which constant velocity says "a is 0", exactly: its transition
puts a and everything correlated with it to zero. A filter that mixes it in gets a pulled towards 0 with the weight
of that statement, which is what the statement means, and moments stay consistent (no row is left over from before).
Source: Blom and Bar-Shalom, IEEE Trans. Automatic Control 33(8), 1988; Bar-Shalom, Li and Kirubarajan (2001),
section 11.6.6; Sheng et al. (2009), section 4, with the specification's section 5.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from trackers.compiled import helper, kernel
from trackers.fix_contract import ManeuverUpdate
from trackers.fix_tracker import FixTracker, transition_matrix
from trackers.gaussian import Gaussian, moment_match
from trackers.position_update import (
    copy_gaussian,
    correct,
    factor_innovation,
    gaussian_log,
    mixing_shares,
    moment_match_into,
    reweigh,
    say_innovation,
    whiten_position,
    whitened_gain,
)


class ImmState(NamedTuple):
    """r filters of m tracks: mean [..., m, r, n], cov [..., m, r, n, n], probability [..., m, r] with sum 1."""

    mean: Any
    cov: Any
    probability: Any


@helper
def _propagate(x, P, F, Q, n, x_out, P_out):
    """F x and F P Fᵀ + Q; x [n] and P [n, n] are used up."""
    for i in range(n):
        x_out[i] = 0.0
        for k in range(n):
            x_out[i] += F[i, k] * x[k]
        for j in range(n):
            P_out[i, j] = 0.0
        for k in range(n):
            if F[i, k] != 0.0:
                for j in range(n):
                    P_out[i, j] += F[i, k] * P[k, j]
    for i in range(n):
        for j in range(n):
            P[i, j] = P_out[i, j]
    for i in range(n):
        for j in range(i + 1):
            total = Q[i, j]
            for k in range(n):
                total += P[i, k] * F[j, k]
            P_out[i, j] = total
            P_out[j, i] = total


@kernel("(r,n),(r,n,n),(r),(r,r),(r,n,n),(r,n,n)->(r,n),(r,n,n),(r)", "FFFFFFFFF")
def _predict(x, P, mu, transition, F, Q, x_out, P_out, c):
    r, n = x.shape
    share, mixed, mixed_cov = np.empty(r), np.empty(n), np.empty((n, n))
    for j in range(r):
        c[j] = mixing_shares(transition, mu, j, share)
        moment_match_into(x, P, share, n, mixed, mixed_cov)
        _propagate(mixed, mixed_cov, F[j], Q[j], n, x_out[j], P_out[j])


def imm_predict(state: ImmState, transition, model, noise) -> ImmState:
    """Mix the filters and propagate each by its model.

    Args:
        state: mean [..., r, n].
        transition: Π [r, r], row from, column to; rows sum to 1.
        model: F [r, n, n]; noise: Q [r, n, n].
    """
    return ImmState(*_predict(*state, transition, model, noise))


@kernel("(r,n),(r,n,n),(r),(d),(d,d),()->(r,n),(r,n,n),(r),(),(d),(d,d)", "FFFFFbFFFfFF")
def _update(x, P, mu, z, R, fixed, x_out, P_out, mu_out, log_likelihood, nu, S):
    r, n = x.shape
    d = z.shape[0]
    for j in range(r):
        mu_out[j] = mu[j]
        copy_gaussian(x[j], P[j], n, x_out[j], P_out[j])
    log_likelihood[0] = 0.0
    say_innovation(x, P, mu, z, R, fixed, d, nu, S)
    if not fixed:
        return
    L, G, w, log_l = np.empty((d, d)), np.empty((n, d)), np.empty(d), np.empty(r)
    for j in range(r):
        log_det = factor_innovation(P[j], R, d, L)
        log_l[j] = gaussian_log(log_det, whiten_position(L, d, x[j], z, w), d)
        whitened_gain(P[j], L, d, n, G)
        correct(x_out[j], P_out[j], G, w, d, n)
    log_likelihood[0] = reweigh(mu_out, log_l)


def imm_update(state: ImmState, position, cov, fixed=True):
    """Condition all filters on a measured position, the first d numbers of their states.

    Args:
        state: mean [..., r, n].
        position: [..., d] m; cov: [..., d, d] m²; fixed: [...] bool, False leaves the prediction as it is.
    Returns:
        posterior, log-likelihood [...], innovation of the mixture [..., d] and its covariance [..., d, d].
    """
    mean, P, mu, log_likelihood, nu, S = _update(*state, position, cov, fixed)
    return ImmState(mean, P, mu), log_likelihood, nu, S


# -- constant velocity, constant acceleration twice -------------------------------------------------------------------


def motion_model(step_s: float, accelerates: bool, noise_std: float, d: int) -> tuple[np.ndarray, np.ndarray]:
    """F and Q [3d, 3d] of one model on the state [p, v, a].

    Args:
        accelerates: whether a is kept (constant acceleration) or 0 (constant velocity).
        noise_std: of the acceleration over a step [m/s²]; with constant acceleration, of its increment per step.
    """
    T, on = step_s, float(accelerates)
    one_axis = np.array([[1.0, T, 0.5 * T * T * on], [0.0, 1.0, T * on], [0.0, 0.0, on]])
    g = np.array([0.5 * T * T, T, on])
    return np.kron(one_axis, np.eye(d)), noise_std**2 * np.kron(np.outer(g, g), np.eye(d))


@dataclass(frozen=True)
class Imm3(FixTracker):
    """Constant velocity, constant acceleration with little and with much noise: the paper's rival.

    Settings as in `FixTracker`, and:
        noise_std: per model, of the acceleration [m/s²]; with constant acceleration, of its increment per step.
        transition: Π, probability to go from one model (row) to another (column) in a step.
        initial_acceleration_std: per axis [m/s²].
    """

    noise_std: tuple[float, float, float] = (1.0, 1.0, 3.0)
    transition: tuple[tuple[float, ...], ...] = ((0.7, 0.15, 0.15), (0.15, 0.7, 0.15), (0.15, 0.15, 0.7))
    initial_acceleration_std: float = 1.0

    def __post_init__(self) -> None:
        super().__post_init__()
        words = "three numbers, finite and not negative"
        noise = self.numbers("noise_std", words)
        self.require(noise.shape == (3,) and bool(((noise >= 0.0) & (noise < np.inf)).all()), "noise_std", words)
        self.require(0.0 < self.initial_acceleration_std < np.inf, "initial_acceleration_std", "positive and finite")
        _ = self._chain

    @cached_property
    def _chain(self) -> np.ndarray:
        return transition_matrix(self, "transition", 3)

    @property
    def models(self) -> int:
        """Three."""
        return 3

    def start(self, track: Gaussian) -> ImmState:
        """All models alike, acceleration 0 ± `initial_acceleration_std`."""
        mean, cov = self.checked_start(track)
        lead, n = mean.shape[:-1], mean.shape[-1]
        d = n // 2
        x, P = np.zeros((*lead, 3, 3 * d)), np.zeros((*lead, 3, 3 * d, 3 * d))
        x[..., :n] = mean[..., None, :]
        P[..., :n, :n] = cov[..., None, :, :]
        P[..., n:, n:] = self.initial_acceleration_std**2 * np.eye(d)
        return ImmState(x, P, np.full((*lead, 3), 1.0 / 3.0))

    def predict(self, state: ImmState, step_s: float) -> ImmState:
        """Mix the models and propagate each by one step."""
        d = state.mean.shape[-1] // 3
        models = [
            motion_model(step_s, accelerates, q, d)
            for accelerates, q in zip((False, True, True), self.noise_std, strict=True)
        ]
        F, Q = (np.stack(parts) for parts in zip(*models, strict=True))
        return imm_predict(state, self._chain, F, Q)

    def update_fix(self, state: ImmState, position: Any, cov: Any, fixed: Any = True) -> ManeuverUpdate:
        """Condition tracks on measured positions [..., d] m with covariances [..., d, d]; `fixed` False: coast."""
        posterior, log_likelihood, nu, S = imm_update(state, *self.checked_fix(position, cov), fixed)
        never = np.zeros(posterior.probability.shape, dtype=bool)
        seen = np.broadcast_to(fixed, log_likelihood.shape)
        return ManeuverUpdate(posterior, nu, S, log_likelihood, posterior.probability, never, seen)

    def estimate(self, state: ImmState) -> Gaussian:
        """Mixture mean [..., m, 2d] m, m/s and covariance [..., m, 2d, 2d]."""
        n = 2 * (state.mean.shape[-1] // 3)
        return moment_match(state.probability, state.mean[..., :n], state.cov[..., :n, :n])

    def acceleration(self, state: ImmState) -> Gaussian:
        """Mixture mean [..., m, d] m/s² and covariance [..., m, d, d]."""
        n = 2 * (state.mean.shape[-1] // 3)
        return moment_match(state.probability, state.mean[..., n:], state.cov[..., n:, n:])
