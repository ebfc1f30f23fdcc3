"""One EKF per target, started at the cross-fix of two paired bearings: the baseline any bank must beat.

It is a bank of one hypothesis that takes the one best joint assignment of every scan as given.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from trackers.association import associate
from trackers.compiled import kernel
from trackers.contract import Scan, Update
from trackers.gaussian import Gaussian
from trackers.rp_ekf import Bank, RpEkf, predict, update
from trackers.triangulation import crossing_ranges, least_squares_fix, pair_bearings


@kernel("(),(p),(),(p),(p,p),(),(),(),(),(x)->(x),(x,x)", "fffffbffffff")
def _start(alpha, reference, std, fix, fix_cov, fixed, floor, cap, speed_std, like, mean, cov):
    """Fix with its covariance, or the middle of the admitted range interval where the fix is worse than that."""
    c, s = math.cos(alpha), math.sin(alpha)
    prior_range, prior_std = math.sqrt(floor * cap), 0.25 * (cap - floor)
    fix_range = math.hypot(fix[0] - reference[0], fix[1] - reference[1])
    fix_var = c * c * fix_cov[0, 0] + 2.0 * c * s * fix_cov[0, 1] + s * s * fix_cov[1, 1]
    mean[:] = 0.0
    cov[:] = 0.0
    cov[2, 2] = cov[3, 3] = speed_std * speed_std
    if fixed and fix_var < prior_std * prior_std and floor < fix_range < cap:
        mean[0], mean[1] = fix[0], fix[1]
        cov[:2, :2] = fix_cov
        return
    cross, radial = (prior_range * std) ** 2, prior_std * prior_std
    mean[0], mean[1] = reference[0] + prior_range * c, reference[1] + prior_range * s
    cov[0, 0] = radial * c * c + cross * s * s
    cov[1, 1] = radial * s * s + cross * c * c
    cov[0, 1] = cov[1, 0] = (radial - cross) * c * s


@dataclass(frozen=True)
class FusedEkf(RpEkf):
    """EKF on both stations' bearings from the cross-fix (`trackers.contract.Tracker`).

    Settings as in `RpEkf`; `hypotheses` is 1. A target whose bearings are too nearly parallel for a fix starts in
    the middle of the admitted range interval with a quarter of its length as standard deviation.
    """

    hypotheses: int = 1

    def initiate(self, scan: Scan) -> Bank:
        """One EKF per reference bearing, at the cross-fix with its partner (`pair_bearings`)."""
        alpha, reference = scan.bearings[..., -1, :], scan.stations[..., -1, :]
        thetas, station = scan.bearings[..., 0, :], scan.stations[..., 0, :]
        partner = pair_bearings(
            alpha, scan.valid[..., -1, :], reference, thetas, scan.valid[..., 0, :], station, self.floor_m, self.cap_m
        )
        theta = np.take_along_axis(thetas, np.maximum(partner, 0), axis=-1)
        start = self._fix(theta, alpha, station, reference, partner >= 0, scan.bearing_std)
        return Bank(start.mean[..., None, :], start.cov[..., None, :, :], np.zeros((*alpha.shape, 1)))

    def predict(self, state: Bank, step_s) -> Bank:
        """Propagate all tracks by one step."""
        return predict(state, step_s, self.process_noise)

    def estimate(self, state: Bank) -> Gaussian:
        """Mean [..., m, 4] and covariance [..., m, 4, 4]."""
        return Gaussian(state.mean[..., 0, :], state.cov[..., 0, :, :])

    def update(self, state: Bank, scan: Scan) -> Update:
        """Give each track its bearings of the one best joint assignment, then condition on them."""
        if self.reference_only:
            scan = scan.reference_only()
        found = associate(*state, scan, self.model, self.second_order)
        posterior, nu, S, log_likelihood = update(
            state, found.bearings, found.used, scan.stations[..., None, :, :], scan.bearing_std, self.prune_below,
            self.second_order,
        )  # fmt: skip
        return Update(posterior, nu, S, log_likelihood, found.assignment)

    def _fix(self, theta, alpha, station, reference, paired, std) -> Gaussian:
        _, r2 = crossing_ranges(theta, alpha, station[..., None, :], reference[..., None, :])
        r2 = np.clip(np.where(np.isfinite(r2), r2, self.cap_m), self.floor_m, self.cap_m)
        guess = reference[..., None, :] + r2[..., None] * np.stack([np.cos(alpha), np.sin(alpha)], axis=-1)
        bearings, used = np.stack([theta, alpha], axis=-1), np.stack([paired, paired], axis=-1)
        stations = np.stack(np.broadcast_arrays(station, reference), axis=-2)[..., None, :, :]
        fix = least_squares_fix(bearings, used, stations, std, guess)
        return Gaussian(
            *_start(alpha, reference[..., None, :], std, fix.position, fix.cov, fix.converged,
                    self.floor_m, self.cap_m, self.velocity_std, np.zeros(4))
        )  # fmt: skip
