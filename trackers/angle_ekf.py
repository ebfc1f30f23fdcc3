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
from trackers.angles import wrap_scalar
from trackers.compiled import kernel
from trackers.direction import absorb, along, innovation_cov, linearize_direction
from trackers.gaussian import Gaussian
from trackers.linalg import LOG_TWO_PI
from trackers.motion_3d import predict_3d
from trackers.triangulation_3d import first_valid, start_tracks


@kernel(
    "(x6),(x6,x6),(s,b,a2),(s,b),(s,p3),(s,a2),(s,a2)->(x6),(x6,x6),(s,a2),(s,a2,a2),(),(s),(s)", "FFFBFFBFFFFfII"
)
def _update(x, P, angles, valid, platforms, std, available, x_out, P_out, nu, S, log_likelihood, slot, seen):
    H, column = np.empty((2, 3)), np.empty(6)
    x_out[:] = x
    P_out[:] = P
    log_likelihood[0] = 0.0
    for s in range(platforms.shape[0]):
        h = linearize_direction(x, platforms[s], H)
        innovation_cov(P, H, std[s], S[s])
        k = first_valid(valid[s])
        slot[s], seen[s] = -1, 0
        for c in range(2):
            nu[s, c] = 0.0
            if k < 0 or not available[s, c]:
                continue
            slot[s], seen[s] = k, 1
            nu[s, c] = wrap_scalar(angles[s, k, c] - h[c])
            root = absorb(P_out, H[c], std[s, c] * std[s, c], column)
            moved = H[c, 0] * (x_out[0] - x[0]) + H[c, 1] * (x_out[1] - x[1]) + H[c, 2] * (x_out[2] - x[2])
            y = (nu[s, c] - moved) / root
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
        slots used [..., s] (−1 for none) and their number [..., s].
    """
    return _update(
        prior.mean, prior.cov, scan.angles, scan.valid, scan.platforms, scan.angle_std, scan.available
    )  # fmt: skip


@dataclass(frozen=True)
class AngleEkf:
    """Fused EKF with availability on the first valid return of every sensor (`trackers.angle_contract.AngleTracker`).

    Settings, SI units:
        process_noise: √q [m/s²], acceleration held over a step, per axis.
        initial_velocity_std: east, north, up [m/s]; the first velocity is 0.
        floor_m, cap_m: nearest and farthest range of interest, for the first position.
    """

    process_noise: float = 30.0
    initial_velocity_std: tuple[float, float, float] = (200.0, 200.0, 50.0)
    floor_m: float = 1.0e3
    cap_m: float = 1.0e5

    def initiate(self, scan: AngleScan) -> Gaussian:
        """One track [..., 1, 6] at the fix of the scan's first returns."""
        start = start_tracks(scan, self.floor_m, self.cap_m, np.array(self.initial_velocity_std))
        return Gaussian(start.mean[..., None, :], start.cov[..., None, :, :])

    def predict(self, state: Gaussian, step_s) -> Gaussian:
        """Propagate all tracks by one step."""
        return predict_3d(state, step_s, self.process_noise)

    def estimate(self, state: Gaussian) -> Gaussian:
        """Mean [..., m, 6] and covariance [..., m, 6, 6]."""
        return state

    def update(self, state: Gaussian, scan: AngleScan) -> AngleUpdate:
        """Condition every track on the scan."""
        mean, cov, nu, S, log_likelihood, slot, seen = update_directions(state, scan.over_tracks())
        return AngleUpdate(
            Gaussian(mean, cov), nu, S, log_likelihood, slot, seen, 1.0 - seen, np.zeros_like(seen)
        )  # fmt: skip
