"""Extended Kalman filter on bistatic range sums, with a maneuver test that widens the prediction.

    J = eᵀ S⁻¹ e,   e = z − F(p̂),   S = H P Hᵀ + R,      H at the prediction p̂

J is χ² with as many degrees of freedom as sums were used. Where it reaches the threshold the scan is predicted again
with N²Q, for N scales the acceleration, and used then. As the noises are independent the sums are taken one after the
other at one linearisation, which equals the stacked update; J is then the sum of the squared whitened innovations.

With `second_order` a sum's curvature counts: it lengthens the expected sum and adds to its variance (Gaussian
second-order filter). Near a site, where noise that grows with the ranges is small, the plain filter takes itself for
far better than it is and may lose a target that is passed closely.

A scan that even the widened prediction misses by far belongs to a track that is elsewhere: at a target's ghost, say,
when a further transmitter answers. It is started anew from that scan, with the spread of `restart_std_m`. In space this
takes three sums; in the plane one will do, for what it leaves open is an arc.

Where all sites lie level, a target and its mirror image below them have the same range sums. An estimate below the
ground is therefore turned up again, position, velocity and covariance: the mirror's own track.
Source: Xu and Wang (2009), eqs 4–13. Deviations: eq 13's S has H P Hᵀ where the print drops Hᵀ, and its e is the
prediction's; the velocity starts from a prior; the same scan is predicted again, not the next (`range_sum_start` and
the document of the trackers tell more).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from scipy.stats import chi2

from trackers.axis_motion import add_axis_noise, move_axes
from trackers.compiled import helper, kernel
from trackers.ellipse_intersection import branch, pick_root, solutions
from trackers.gaussian import Gaussian
from trackers.linalg import LOG_TWO_PI
from trackers.position_update import copy_gaussian
from trackers.range_sum import (
    absorb_column,
    range_sum_curvature,
    range_sum_row,
    short_of_baseline,
    whitened_row_gain,
)
from trackers.range_sum_contract import RangeSumScan, RangeSumTrack, RangeSumUpdate
from trackers.range_sum_start import mirror_up, start_range_sums

LOST = 1e-6
"""Probability with which even the widened prediction would miss a scan by so much: then no maneuver explains it."""

RESTART_SPEED_M_S = 200.0
"""Standard deviation of the velocity, per axis about 0, with which a lost track is started anew."""

MOST_SUMS = 64
"""Largest number of range sums in one scan."""


@dataclass(frozen=True)
class RangeSumEkf:
    """`trackers.range_sum_contract.RangeSumTracker` by an extended Kalman filter.

    Settings, SI units:
        process_noise: w, variances of the acceleration [(m/s²)²] along x, y and z; z's does not count in the plane.
        false_alarm: probability that the maneuver test fires on a target that flies straight; 0: no test.
        inflation: N, at least 1; a fired test multiplies the acceleration's standard deviation by it.
        floor_m: height of the ground; estimates below it are turned up (in the plane without meaning).
        second_order: whether the curvature of range sums counts.
        turning_m_s2: standard deviation of the mean acceleration per axis while the track is started, beyond what
            process_noise makes of it: of targets that may turn.
        restart_std_m: what a track that is lost may be off, per axis, when it is started anew; 0: it never is.
    Raises:
        ValueError: a setting outside its range.
    """

    process_noise: tuple[float, float, float] = (1.0, 1.0, 0.01)
    false_alarm: float = 1e-3
    inflation: float = 100.0
    floor_m: float = 0.0
    second_order: bool = False
    turning_m_s2: float = 0.0
    restart_std_m: float = 10e3

    def __post_init__(self) -> None:
        w = np.array(self.process_noise, dtype=float)
        good = w.shape == (3,) and bool(((w >= 0.0) & (w < np.inf)).all())
        self._require(good, "process_noise", "three variances, not negative and finite [(m/s²)²]")
        self._require(0.0 <= self.false_alarm < 1.0, "false_alarm", "at least 0 and below 1")
        self._require(1.0 <= self.inflation < np.inf, "inflation", "finite and at least 1")
        self._require(-np.inf < self.floor_m < np.inf, "floor_m", "finite")
        for name in ("turning_m_s2", "restart_std_m"):
            self._require(0.0 <= getattr(self, name) < np.inf, name, "finite and not negative")

    def _require(self, met: bool, name: str, words: str) -> None:
        if not met:
            raise ValueError(f"{type(self).__name__}.{name} = {getattr(self, name)!r}: must be {words}")

    @cached_property
    def noise(self) -> np.ndarray:
        """w [3] (m/s²)²."""
        return np.array(self.process_noise, dtype=float)

    @cached_property
    def thresholds(self) -> np.ndarray:
        """J at which the maneuver test fires, and that of the widened prediction at which the track is lost.

        [2, s + 1], by the number of sums used.
        """
        found = np.full((2, MOST_SUMS + 1), np.inf)
        counts = np.arange(1, MOST_SUMS + 1)
        if self.false_alarm > 0.0:
            found[0, 1:] = chi2.isf(self.false_alarm, counts)
            if self.restart_std_m > 0.0:
                found[1, 1:] = chi2.isf(min(LOST, self.false_alarm), counts)
        return found

    def initiate(self, scans: RangeSumScan, guess: Gaussian, times_s: Any) -> RangeSumTrack:
        """Maximum a posteriori state at the last of the scans (`trackers.range_sum_start`).

        Args:
            scans: with an axis for time: range_sums [..., t, n], transmitters [..., t, n, d], receiver [..., t, d].
            guess: mean [..., 2d] and cov [..., 2d, 2d] at time 0.
            times_s: [t] s, ascending, not before 0.
        Raises:
            ValueError: shapes that do not belong together, entries that are not finite, times out of order.
        """
        start = start_range_sums(scans, guess, times_s, self.noise, self.floor_m, self.turning_m_s2)
        return RangeSumTrack(start.mean, start.cov, np.zeros(start.mean.shape[:-1]))

    def predict(self, state: RangeSumTrack, step_s: float) -> RangeSumTrack:
        """Propagate all tracks by one step.

        Raises:
            ValueError: a step that is negative or not finite.
        """
        if not 0.0 <= step_s < np.inf:
            raise ValueError(f"predict: step_s = {step_s!r}: must be finite and not negative [s]")
        mean, cov = _predict(state.mean, state.cov, step_s, self.noise)
        return RangeSumTrack(mean, cov, np.full(mean.shape[:-1], float(step_s)))

    def update(self, state: RangeSumTrack, scan: RangeSumScan) -> RangeSumUpdate:
        """Condition all tracks on one scan; without an echo they coast.

        A sum so short that no target can have caused it (`trackers.range_sum.short_of_baseline`) is not used.

        Raises:
            ValueError: shapes that do not belong together, entries that are not finite.
        """
        scan.check()
        states, sums = 2 * np.shape(scan.receiver)[-1], np.shape(scan.range_sums)[-1]
        if np.shape(state.mean)[-1:] != (states,) or sums > MOST_SUMS:
            shapes = f"mean {np.shape(state.mean)}, receiver {np.shape(scan.receiver)}, {sums} range sums"
            raise ValueError(f"update: {shapes}: must be [..., 2d], [..., d] and at most {MOST_SUMS}")
        settings = (self.thresholds, self.inflation, self.floor_m, self.second_order)
        mean, cov, *rest, lost = _update(*state, *scan, self.noise, *settings)
        if lost.any():
            mean, cov = self._restart(mean, cov, scan, rest[-1], lost)
        return RangeSumUpdate(RangeSumTrack(mean, cov, state.step_s), *rest)

    def _restart(self, mean, cov, scan: RangeSumScan, used, lost) -> tuple[np.ndarray, np.ndarray]:
        """Start lost tracks [...] anew from their last scan alone.

        Where more sums were used than are needed, two of them (in space three) give the place and its ghost, and all
        of them tell which it is; else what is nearest to where the track was is likeliest.
        """
        d, shape = np.shape(scan.receiver)[-1], np.shape(lost)
        cores = (1, 1, 2, 1, 1)
        parts = [np.broadcast_to(p, (*shape, *np.shape(p)[-c:]))[lost] for p, c in zip(scan, cores, strict=True)]
        own = RangeSumScan(*parts)._replace(valid=used[lost])
        place = mean[lost][:, :d]
        further = own.valid.sum(-1) > d
        if further.any():
            place[further] = _place_by_sums(RangeSumScan(*(p[further] for p in own)), place[further])
        guess = np.concatenate([place, np.zeros_like(place)], axis=-1)
        spread = np.repeat([self.restart_std_m, RESTART_SPEED_M_S], d) ** 2
        scans = RangeSumScan(*(part[:, None] for part in own))
        prior = Gaussian(guess, np.broadcast_to(np.diag(spread), (len(guess), 2 * d, 2 * d)))
        mean[lost], cov[lost] = start_range_sums(scans, prior, [0.0], self.noise, self.floor_m)
        return mean, cov

    def estimate(self, state: RangeSumTrack) -> Gaussian:
        """Mean [..., 1, 2d] and covariance [..., 1, 2d, 2d]."""
        return Gaussian(state.mean[..., None, :], state.cov[..., None, :, :])


@dataclass(frozen=True)
class RangeSumEkfLiteral(RangeSumEkf):
    """Without the maneuver test, and so without a restart: the filter of the paper's section 2.

    It starts as the other does, from a batch; the paper's own start, one step a scan, is
    `trackers.range_sum_start.fixed_damping_step`.
    """

    false_alarm: float = 0.0


@dataclass(frozen=True)
class RangeSumEkfSecondOrder(RangeSumEkf):
    """With the curvature of range sums: for receivers that come close to their target."""

    second_order: bool = True


def _place_by_sums(scan: RangeSumScan, place: np.ndarray) -> np.ndarray:
    """Where more than d sums of scans [r, n] say that targets are [r, d]; where they do not, the places given."""
    d = place.shape[-1]
    first = np.argsort(~scan.valid, axis=-1, kind="stable")[:, :d]
    rows = np.arange(len(first))[:, None]
    sites = scan.transmitters[rows, first]
    roots = solutions(scan.range_sums[rows, first], sites, scan.receiver)
    index, found = pick_root(roots, scan, branch(place, sites, scan.receiver))
    return np.where(found[:, None], roots.position[rows[:, 0], index], place)


@kernel("(a),(a,a),(),(w)->(a),(a,a)", "FFfFFF")
def _predict(x, P, T, w, x_out, P_out):
    d = x.shape[0] // 2
    copy_gaussian(x, P, 2 * d, x_out, P_out)
    move_axes(x_out, P_out, T, d)
    add_axis_noise(P_out, T, w, 1.0, d)


@helper
def _absorb_sums(x, sums, used, transmitters, receiver, std, curved, scratch, x_out, P_out, d):
    """Condition x_out, P_out on all used sums, linearised at x; returns J and log √det S."""
    bias, extra, curve, row, column = scratch
    squared = log_det = 0.0
    for i in range(sums.shape[0]):
        bias[i] = extra[i] = 0.0
        if curved and used[i]:
            bias[i], extra[i] = range_sum_curvature(x, P_out, receiver, transmitters[i], curve, d)
    for i in range(sums.shape[0]):
        if used[i]:
            nu = sums[i] - range_sum_row(x, receiver, transmitters[i], row, d) - bias[i]
            for j in range(d):
                nu -= row[j] * (x_out[j] - x[j])
            root, _ = whitened_row_gain(P_out, row, std[i] * std[i] + extra[i], column, d)
            nu /= root
            squared += nu * nu
            log_det += math.log(root)
            for j in range(2 * d):
                x_out[j] += column[j] * nu
            absorb_column(P_out, column, 2 * d)
    return squared, log_det


@helper
def _predict_sums(x, P, sums, valid, transmitters, receiver, std, curved, scratch, nu, S, used, d):
    """Innovations [n], their variances [n] and which sums can be used [n]; returns how many."""
    _, _, curve, row, column = scratch
    count = 0
    for i in range(sums.shape[0]):
        used[i] = valid[i] and not short_of_baseline(sums[i], std[i], receiver, transmitters[i], d)
        nu[i], S[i] = 0.0, std[i] * std[i]
        if used[i]:
            count += 1
            nu[i] = sums[i] - range_sum_row(x, receiver, transmitters[i], row, d)
            if curved:
                bias, extra = range_sum_curvature(x, P, receiver, transmitters[i], curve, d)
                nu[i], S[i] = nu[i] - bias, S[i] + extra
            S[i] += whitened_row_gain(P, row, S[i], column, d)[1]
    return count


@kernel(
    "(a),(a,a),(),(n),(n),(n,d),(d),(n),(w),(m,c),(),(),()->(a),(a,a),(n),(n),(),(),(),(n),()",
    "FFfFBFFFFFffbFFFFffbBb",
)
def _update(
    x, P, T, sums, valid, transmitters, receiver, std, w, thresholds, inflation, floor, curved,
    x_out, P_out, nu, S, log_likelihood, statistic, fired, used, lost,
):  # fmt: skip
    d, n = x.shape[0] // 2, sums.shape[0]
    scratch = (np.empty(n), np.empty(n), np.empty((3, 3)), np.empty(3), np.empty(6))
    count = _predict_sums(x, P, sums, valid, transmitters, receiver, std, curved, scratch, nu, S, used, d)
    copy_gaussian(x, P, 2 * d, x_out, P_out)
    squared, log_det = _absorb_sums(x, sums, used, transmitters, receiver, std, curved, scratch, x_out, P_out, d)
    statistic[0], fired[0], lost[0] = squared, squared >= thresholds[0, count], False
    if fired[0]:
        copy_gaussian(x, P, 2 * d, x_out, P_out)
        add_axis_noise(P_out, T, w, inflation * inflation - 1.0, d)
        squared, log_det = _absorb_sums(x, sums, used, transmitters, receiver, std, curved, scratch, x_out, P_out, d)
        lost[0] = squared >= thresholds[1, count] and count >= 2 * d - 3
    log_likelihood[0] = -0.5 * (count * LOG_TWO_PI + squared) - log_det
    if d == 3:
        mirror_up(x_out, P_out, floor)
