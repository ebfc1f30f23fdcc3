"""A bank of filters with modified input estimation, windows of different length, mixed by an IMM.

Per step: weights W_ij = p_ij μ_i / c_j, mixing, prediction; likelihood of the fix under the compensated outputs
y, Π (eqs 16–21); Kalman update, window, detection and compensation of every filter by itself
(`trackers.input_estimation`); μ_j ∝ Λ_j c_j. The output is the mixture of the y.

Mixing blends recursions x that have been cleared of inputs up to different times, while every window keeps its own
regressors. `mixing` says what is done about it:
    literal     the paper: blend x and P as they are (eqs 14–15). Accelerations of single filters are biased: the long
                window's too low, the short one's too high.
    sens        blend the sensitivities with the same weights. What this brings in of inputs older than the own window
                is cleared together with the window's oldest.
    output      blend y and Π and shift every x by its own change of y; P is blended with the spread of the y.
    none        Markov probabilities only.
Source: Sheng et al. (2009), section 4; the repairs are the specification's.
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
from trackers.input_estimation import (
    MAX_WINDOW,
    absorb_fix,
    absorb_nothing,
    age_sensitivities,
    apply_input,
    clear_window,
    column,
    compensate_window,
    predict_filter,
    regress,
    respond,
    shift_window,
)
from trackers.position_update import (
    copy_gaussian,
    factor_innovation,
    gaussian_log,
    mixing_shares,
    moment_match_into,
    reweigh,
    say_innovation,
    whiten_position,
    whitened_gain,
)

MIXINGS = LITERAL, SENS, OUTPUT, NONE = ("literal", "sens", "output", "none")
_SENS, _OUTPUT, _NONE = MIXINGS.index(SENS), MIXINGS.index(OUTPUT), MIXINGS.index(NONE)


class MieState(NamedTuple):
    """r filters of m tracks; d numbers per position, n = 2d, windows of up to s scans.

    Attributes:
        recursion, recursion_cov: x [..., m, r, n], P [..., m, r, n, n], compensated for inputs that left the window.
        output, output_cov: y [..., m, r, n], Π [..., m, r, n, n], compensated for all.
        input, input_cov: û [..., m, r, d] m/s², Σ_u [..., m, r, d, d]; 0 without a maneuver.
        probability: μ [..., m, r].
        sensitivity: E [..., m, r, s, n, d]; innovation: w [..., m, r, s, d]; regressor: B [..., m, r, s(s+1)/2, d, d].
        scans: [..., m, r] int, scans in the window, at most its length.
    """

    recursion: Any
    recursion_cov: Any
    output: Any
    output_cov: Any
    input: Any
    input_cov: Any
    probability: Any
    sensitivity: Any
    innovation: Any
    regressor: Any
    scans: Any


# -- prediction -------------------------------------------------------------------------------------------------------


@helper
def _mix_sensitivities(E, windows, share, j, d, E_out):
    """Blend E of all filters into E_out; what lies beyond the own window joins its oldest input."""
    own = windows[j] - 1
    for q in range(own):
        for i in range(2 * d):
            for a in range(d):
                total = 0.0
                for k in range(share.shape[0]):
                    at = windows[k] - 2 if q == own - 1 else min(q, windows[k] - 2)
                    total += share[k] * E[k, at, i, a]
                E_out[q, i, a] = total


@helper
def _shift_by_output(x, y, y_mixed, n, x_out):
    for i in range(n):
        x_out[i] = x[i] + y_mixed[i] - y[i]


@helper
def _predict_bank(x, P, y, Pi, u, mu, E, transition, windows, T, q, mode, d, x_out, P_out, y_out, Pi_out, c, E_out):
    n, r = 2 * d, mu.shape[0]
    share = np.empty(r)
    for j in range(r):
        c[j] = mixing_shares(transition, mu, j, share)
        copy_gaussian(y[j], Pi[j], n, y_out[j], Pi_out[j])
        if mode == _NONE or r == 1:
            copy_gaussian(x[j], P[j], n, x_out[j], P_out[j])
        elif mode == _OUTPUT:
            moment_match_into(y, P, share, n, y_out[j], P_out[j])
            moment_match_into(y, Pi, share, n, y_out[j], Pi_out[j])
            _shift_by_output(x[j], y[j], y_out[j], n, x_out[j])
        else:
            moment_match_into(x, P, share, n, x_out[j], P_out[j])
        if mode == _SENS and r > 1:
            _mix_sensitivities(E, windows, share, j, d, E_out[j])
            age_sensitivities(E_out[j], T, d, E_out[j])
        else:
            age_sensitivities(E[j], T, d, E_out[j])
        predict_filter(x_out[j], P_out[j], T, q, d)
        predict_filter(y_out[j], Pi_out[j], T, q, d)
        apply_input(y_out[j], u[j], T, d)


PREDICT = (
    "(r,n),(r,n,n),(r,n),(r,n,n),(r,d),(r),(r,s,n,d),(r,r),(r),(),(),()->(r,n),(r,n,n),(r,n),(r,n,n),(r),(r,s,n,d)"
)
PREDICT_TYPES = "FFFFFFFFIffiFFFFFF"


# One kernel for the plane and one for space: with a constant length the compiler unrolls every loop.
@kernel(PREDICT, PREDICT_TYPES)
def _predict_plane(x, P, y, Pi, u, mu, E, transition, windows, T, q, mode, x_out, P_out, y_out, Pi_out, c, E_out):
    _predict_bank(x, P, y, Pi, u, mu, E, transition, windows, T, q, mode, 2, x_out, P_out, y_out, Pi_out, c, E_out)


@kernel(PREDICT, PREDICT_TYPES)
def _predict_space(x, P, y, Pi, u, mu, E, transition, windows, T, q, mode, x_out, P_out, y_out, Pi_out, c, E_out):
    _predict_bank(x, P, y, Pi, u, mu, E, transition, windows, T, q, mode, 3, x_out, P_out, y_out, Pi_out, c, E_out)


# -- update -----------------------------------------------------------------------------------------------------------


@helper
def _detect_and_compensate(x, P, y, Pi, u, U, E, w, B, s, threshold, full, single, d, row):
    """Test the window of one filter and act on it; returns whether it found a maneuver."""
    n = 2 * d
    copy_gaussian(x, P, n, y, Pi)
    detected = full and regress(w, B, s, d, u, U) > threshold
    if not detected:
        for i in range(d):
            u[i] = 0.0
            for j in range(d):
                U[i, j] = 0.0
        return False
    respond(y, Pi, E, u, U, s - 1, -1, d, row)
    if single:
        copy_gaussian(y, Pi, n, x, P)
        clear_window(E, w, B, s, d)
    else:
        compensate_window(w, B, u, s, d)
        respond(x, P, E, u, U, s - 1, s - 2, d, row)
    return True


@helper
def _update_bank(
    x, P, y, Pi, mu, E, w, B, scans, z, R, fixed, windows, thresholds, single, d,
    x_out, P_out, y_out, Pi_out, u, U, mu_out, E_out, w_out, B_out, scans_out, detected, log_likelihood, nu, S,
):  # fmt: skip
    n, r = 2 * d, mu.shape[0]
    L, G, row, log_l = np.empty((d, d)), np.empty((n, d)), np.empty(d), np.empty(r)
    say_innovation(y, Pi, mu, z, R, fixed, d, nu, S)
    for j in range(r):
        s = windows[j]
        mu_out[j] = mu[j]
        log_l[j] = 0.0
        copy_gaussian(x[j], P[j], n, x_out[j], P_out[j])
        shift_window(E[j], w[j], B[j], s, d, E_out[j], w_out[j], B_out[j])
        if fixed:
            log_det = factor_innovation(Pi[j], R, d, L)
            log_l[j] = gaussian_log(log_det, whiten_position(L, d, y[j], z, row), d)
            factor_innovation(P[j], R, d, L)
            whiten_position(L, d, x[j], z, w_out[j, 0])
            whitened_gain(P[j], L, d, n, G)
            absorb_fix(x_out[j], P_out[j], E_out[j], w_out[j], B_out[j], L, G, s, d)
        else:
            absorb_nothing(w_out[j], B_out[j], s, d)
        scans_out[j] = min(scans[j] + 1, s)
        detected[j] = _detect_and_compensate(
            x_out[j], P_out[j], y_out[j], Pi_out[j], u[j], U[j], E_out[j], w_out[j], B_out[j],
            s, thresholds[j], scans_out[j] == s, single, d, row,
        )  # fmt: skip
        if single and detected[j]:
            scans_out[j] = 0
    log_likelihood[0] = reweigh(mu_out, log_l) if fixed else 0.0


UPDATE = (
    "(r,n),(r,n,n),(r,n),(r,n,n),(r),(r,s,n,d),(r,s,d),(r,b,d,d),(r),(d),(d,d),(),(r),(r),()"
    "->(r,n),(r,n,n),(r,n),(r,n,n),(r,d),(r,d,d),(r),(r,s,n,d),(r,s,d),(r,b,d,d),(r),(r),(),(d),(d,d)"
)
UPDATE_TYPES = "FFFFFFFFIFFbIFbFFFFFFFFFFIBfFF"


@kernel(UPDATE, UPDATE_TYPES)
def _update_plane(
    x, P, y, Pi, mu, E, w, B, scans, z, R, fixed, windows, thresholds, single,
    x_out, P_out, y_out, Pi_out, u, U, mu_out, E_out, w_out, B_out, scans_out, detected, log_likelihood, nu, S,
):  # fmt: skip
    _update_bank(
        x, P, y, Pi, mu, E, w, B, scans, z, R, fixed, windows, thresholds, single, 2,
        x_out, P_out, y_out, Pi_out, u, U, mu_out, E_out, w_out, B_out, scans_out, detected, log_likelihood, nu, S,
    )  # fmt: skip


@kernel(UPDATE, UPDATE_TYPES)
def _update_space(
    x, P, y, Pi, mu, E, w, B, scans, z, R, fixed, windows, thresholds, single,
    x_out, P_out, y_out, Pi_out, u, U, mu_out, E_out, w_out, B_out, scans_out, detected, log_likelihood, nu, S,
):  # fmt: skip
    _update_bank(
        x, P, y, Pi, mu, E, w, B, scans, z, R, fixed, windows, thresholds, single, 3,
        x_out, P_out, y_out, Pi_out, u, U, mu_out, E_out, w_out, B_out, scans_out, detected, log_likelihood, nu, S,
    )  # fmt: skip


PREDICTIONS = {2: _predict_plane, 3: _predict_space}
UPDATES = {2: _update_plane, 3: _update_space}


# -- trackers ---------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class ImmMie(FixTracker):
    """Interacting filters with modified input estimation, one per window.

    Settings as in `FixTracker`, and:
        windows: scans in each filter's window, 2 to `MAX_WINDOW`.
        thresholds: λ of each filter's test; χ² with d degrees of freedom in quiet flight, so 8 gives 1.83 % false
            alarms a step in the plane; 10.03 gives the same in space.
        transition: Π, probability to go from one filter (row) to another (column) in a step.
        acceleration_std: q of every filter [m/s²].
        mixing: one of `MIXINGS`.
    """

    windows: tuple[int, ...] = (6, 4)
    thresholds: tuple[float, ...] = (8.0, 8.0)
    transition: tuple[tuple[float, ...], ...] = ((0.8, 0.2), (0.2, 0.8))
    acceleration_std: float = 1.0
    mixing: str = LITERAL

    def __post_init__(self) -> None:
        super().__post_init__()
        words = f"whole numbers from 2 to {MAX_WINDOW}, one a filter"
        windows = self.numbers("windows", words)
        whole = windows.ndim == 1 and windows.size > 0 and (windows == np.rint(windows)).all()
        self.require(bool(whole and (windows >= 2).all() and (windows <= MAX_WINDOW).all()), "windows", words)
        thresholds, words = self.numbers("thresholds", "positive and finite"), f"{windows.size} numbers, one a window"
        self.require(bool(((thresholds > 0.0) & (thresholds < np.inf)).all()), "thresholds", "positive and finite")
        self.require(thresholds.shape == windows.shape, "thresholds", words)
        self.require(0.0 <= self.acceleration_std < np.inf, "acceleration_std", "finite and not negative")
        self.require(self.mixing in MIXINGS, "mixing", f"one of {', '.join(map(repr, MIXINGS))}")
        _ = self._bank

    @property
    def single_correction(self) -> bool:
        """Whether a detection corrects the state once and starts the window anew (classical input estimation)."""
        return False

    @cached_property
    def _bank(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Π [r, r], windows [r], thresholds [r]."""
        transition = transition_matrix(self, "transition", len(self.windows))
        return transition, np.array(self.windows, dtype=np.int64), np.array(self.thresholds, dtype=float)

    @property
    def models(self) -> int:
        """One per window."""
        return len(self.windows)

    def start(self, track: Gaussian) -> MieState:
        """All filters alike, windows empty."""
        mean, cov = self.checked_start(track)
        lead, n = mean.shape[:-1], mean.shape[-1]
        r, s, d = len(self.windows), int(self._bank[1].max()), n // 2
        x, P = (np.repeat(np.expand_dims(part, len(lead)), r, len(lead)) for part in (mean, cov))
        empty = [np.zeros((*lead, r, *shape)) for shape in ((d,), (d, d), (s, n, d), (s, d), (column(s), d, d))]
        u, U, E, w, B = empty
        return MieState(
            x, P, x.copy(), P.copy(), u, U, np.full((*lead, r), 1.0 / r), E, w, B, np.zeros((*lead, r), np.int64)
        )

    def predict(self, state: MieState, step_s: float) -> MieState:
        """Mix the filters and propagate each by one step."""
        transition, windows, _ = self._bank
        predict_filters = PREDICTIONS[state.input.shape[-1]]
        x, P, y, Pi, mu, E = predict_filters(
            state.recursion, state.recursion_cov, state.output, state.output_cov, state.input, state.probability,
            state.sensitivity, transition, windows, step_s, self.acceleration_std, MIXINGS.index(self.mixing),
        )  # fmt: skip
        return state._replace(recursion=x, recursion_cov=P, output=y, output_cov=Pi, probability=mu, sensitivity=E)

    def update_fix(self, state: MieState, position: Any, cov: Any, fixed: Any = True) -> ManeuverUpdate:
        """Condition tracks on measured positions [..., d] m with covariances [..., d, d]; `fixed` False: coast."""
        _, windows, thresholds = self._bank
        position, cov = self.checked_fix(position, cov)
        update_filters = UPDATES[state.input.shape[-1]]
        *filters, detected, log_likelihood, nu, S = update_filters(
            state.recursion, state.recursion_cov, state.output, state.output_cov, state.probability,
            state.sensitivity, state.innovation, state.regressor, state.scans, position, cov, fixed,
            windows, thresholds, self.single_correction,
        )  # fmt: skip
        posterior = MieState(*filters)
        seen = np.broadcast_to(fixed, log_likelihood.shape)
        return ManeuverUpdate(posterior, nu, S, log_likelihood, posterior.probability, detected, seen)

    def estimate(self, state: MieState) -> Gaussian:
        """Mixture of the outputs: mean [..., m, 2d] m, m/s and covariance [..., m, 2d, 2d]."""
        return moment_match(state.probability, state.output, state.output_cov)

    def acceleration(self, state: MieState) -> Gaussian:
        """Mixture of û + w, w the filters' own noise: mean [..., m, d] m/s² and covariance [..., m, d, d]."""
        noise = self.acceleration_std**2 * np.eye(state.input.shape[-1])
        return moment_match(state.probability, state.input, state.input_cov + noise)


@dataclass(frozen=True)
class Mie(ImmMie):
    """One filter with modified input estimation."""

    windows: tuple[int, ...] = (4,)
    thresholds: tuple[float, ...] = (8.0,)
    transition: tuple[tuple[float, ...], ...] = ((1.0,),)


@dataclass(frozen=True)
class InputEstimation(Mie):
    """Classical input estimation: a detection corrects the state once, then the window fills anew.

    The acceleration is reported at the detection only. Source: Chan, Hu and Plant (1979).
    """

    @property
    def single_correction(self) -> bool:
        """True."""
        return True
