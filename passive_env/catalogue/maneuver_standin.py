"""A constant-velocity filter on bearings until the trackers of a maneuvering target are there."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from trackers import motion
from trackers.fix_contract import BearingScan, ManeuverUpdate
from trackers.gaussian import Gaussian
from trackers.measurement import bearing_jacobian, update


@dataclass(frozen=True)
class CvFilter:
    initial_velocity_std: float = 200.0
    process_noise: float = 30.0
    models = 2

    def initiate(self, scan):
        n = np.stack([-np.sin(scan.bearings), np.cos(scan.bearings)], -1)
        A = np.einsum("...si,...sj->...ij", n, n)
        b = np.einsum("...si,...sj,...sj->...i", n, n, scan.stations)
        p = np.linalg.solve(A, b[..., None])[..., 0]
        H = bearing_jacobian(p[..., None, :], scan.stations) / scan.bearing_std[..., None]
        cov = np.zeros((*p.shape[:-1], 4, 4))
        cov[..., :2, :2] = np.linalg.inv(np.einsum("...si,...sj->...ij", H, H))
        cov[..., 2, 2] = cov[..., 3, 3] = self.initial_velocity_std**2
        return Gaussian(np.concatenate([p, 0 * p], -1)[..., None, :], cov[..., None, :, :])

    def predict(self, state, step_s):
        return motion.predict(state, step_s, self.process_noise)

    def update(self, state, scan: BearingScan):
        g = state
        for s in range(scan.bearings.shape[-1]):
            std = np.where(scan.valid[..., s], scan.bearing_std[..., s], 1e9)[..., None]
            g = update(g, scan.bearings[..., s, None], scan.stations[..., None, s, :], std).posterior
        m = g.mean.shape[:-1]
        return ManeuverUpdate(
            g,
            np.zeros((*m, 2)),
            np.tile(np.eye(2), (*m, 1, 1)),
            np.zeros(m),
            np.full((*m, 2), 0.5),
            np.zeros((*m, 2), bool),
            np.broadcast_to((scan.valid.sum(-1) > 1)[..., None], m),
        )

    def estimate(self, state):
        return state

    def acceleration(self, state):
        m = state.mean.shape[:-1]
        return Gaussian(np.zeros((*m, 2)), np.tile(np.eye(2), (*m, 1, 1)))
