"""Fused EKF on azimuth and elevation of one target from any number of platforms, any of them missing.

    S = H P⁻ Hᵀ + R,   K = P⁻ Hᵀ S⁻¹,   X̂ = X̂⁻ + K ν,   P = P⁻ − K S Kᵀ

over the stacked rows of the available components only, all linearised at the prediction; equivalently
P⁻¹ = (P⁻)⁻¹ + Σ HᵀR⁻¹H. With nothing available the prediction stays.
Source: Wang, Wang and Yang (2004), section 3. Deviations: unavailable rows are deleted, where eq 14 inverts a singular
matrix; the gain's mask acts on the measurement side; the innovation is z − h(X̂⁻); absolute states (`motion_3d`).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from trackers.angle_contract import AngleScan, AngleUpdate
from trackers.angle_filter import AngleFilter
from trackers.angles import wrap_scalar
from trackers.compiled import kernel
from trackers.direction import absorb, innovation_cov, linearize_direction, moved
from trackers.gaussian import Gaussian
from trackers.linalg import LOG_TWO_PI
from trackers.outliers import TESTS, first_valid, outlier_distances


@kernel("(x6),(x6,x6),(s,b,a2),(s,b),(s,p3),(s,a2),(s,a2)->(x6),(x6,x6),(s,a2),(s,a2,a2),(),(s)", "FFFBFFBFFFFfI")
def _update(x, P, angles, valid, platforms, std, available, x_out, P_out, nu, S, log_likelihood, slot):
    H, column = np.empty((2, 3)), np.empty(6)
    x_out[:] = x
    P_out[:] = P
    log_likelihood[0] = 0.0
    for s in range(platforms.shape[0]):
        h = linearize_direction(x, platforms[s], H)
        innovation_cov(P, H, std[s], S[s])
        k = first_valid(valid[s])
        slot[s] = -1
        for c in range(2):
            nu[s, c] = 0.0
            if k < 0 or not available[s, c]:
                continue
            slot[s] = k
            nu[s, c] = wrap_scalar(angles[s, k, c] - h[c])
            root = absorb(P_out, H[c], std[s, c] * std[s, c], column)
            y = (nu[s, c] - moved(H[c], x, x_out)) / root
            for i in range(6):
                x_out[i] += column[i] * y
            log_likelihood[0] -= 0.5 * (LOG_TWO_PI + y * y) + math.log(root)


def update_directions(prior: Gaussian, scan: AngleScan):
    """Condition tracks on the first valid return of every sensor, all available components at once.

    Args:
        prior: mean [..., 6], cov [..., 6, 6].
        scan: leading axes as the prior's.
    Returns:
        posterior mean and cov, innovations [..., s, 2], their covariances [..., s, 2, 2], log-likelihood [...],
        slots used [..., s], −1 for none.
    """
    return _update(prior.mean, prior.cov, scan.angles, scan.valid, scan.platforms, scan.angle_std, scan.available)


@dataclass(frozen=True)
class AngleEkf(AngleFilter):
    """Fused EKF with availability on the first valid return of every sensor, whatever its distance.

    For scans without false returns (`trackers.angle_contract.AngleTracker`). With an `outlier_test` a sensor that
    contradicts sensor 0 is left out of the scan. Settings as in `AngleFilter`; gates are not used.
    """

    def update(self, state: Gaussian, scan: AngleScan) -> AngleUpdate:
        """Condition every track on the scan."""
        scan.check()
        scan = scan.over_tracks()
        if self.outlier_test is not None:
            accepted = outlier_distances(state, scan, self.outlier_test) <= TESTS[self.outlier_test][1]
            scan = scan._replace(available=scan.available & accepted[..., None])
        mean, cov, nu, S, log_likelihood, slot = update_directions(state, scan)
        seen = (slot >= 0).astype(np.int64)
        posterior = self.renew(Gaussian(mean, cov), scan)
        return AngleUpdate(posterior, nu, S, log_likelihood, slot, seen, 1.0 - seen, np.zeros_like(seen))
