"""What places of sensors promise, in PyTorch: `ScanFusion.promise` with gradients with respect to the places.

The compiled recursion says how good a layout is, this one also which way it gets better. A minimum range has no
gradient: `edge_m` lets a sensor's information fade out over some distance above it.
"""

from __future__ import annotations

import torch
from torch import Tensor

from trackers.scan_fusion import ScanFusion

MIN_LEVEL_M2 = 1.0
"""Square of the least level distance between a sensor and a target: the azimuth of one overhead has no gradient."""


def promised_std(
    places: Tensor, path: Tensor, std: Tensor, ranging: Tensor, prior: Tensor, tracker: ScanFusion, step_s: float,
    edge_m: float = 0.0,
) -> Tensor:  # fmt: skip
    """Standard deviation of the position [e, k] m, √(p₁₁ + p₂₂ + p₃₃), after each scan of a track that begins here.

    Args:
        places: [e, k, n, 3] m of the sensors at the scans.
        path: [e, k, 3] m of the target.
        std: [e, 3] of range [m], azimuth and elevation [rad], the same of all sensors.
        ranging: [n] bool, whether a sensor measures range.
        prior: [e, 6, 6] covariance a step before the first scan; it counts until a track can start.
        tracker: the filter's settings.
        step_s: between scans.
        edge_m: width over which a sensor's information fades in above the minimum range; 0: all at once. What starts
            a track is not faded.
    Source: `trackers.scan_fusion`, after Yang et al. (1998).
    """
    line = path[:, :, None] - places
    info = converted_information(line, std[:, None, None], ranging)
    above = line.norm(dim=-1) - tracker.minimum_range_m
    recursion = _Recursion(prior, ranging, tracker, step_s)
    covs = [recursion.after(info[:, t], above[:, t], edge_m) for t in range(info.shape[1])]
    return torch.stack([_spread(cov) for cov in covs], dim=1)


def converted_information(line: Tensor, std: Tensor, ranging: Tensor) -> Tensor:
    """Information [..., n, 3, 3] 1/m² about a target at `line` [..., n, 3] m from its sensors.

    Args:
        std: [..., 1, 3] or [..., n, 3] of range [m], azimuth and elevation [rad].
        ranging: [n] bool; a sensor that measures no range knows azimuth and elevation, linearised.
    Source: Yang et al. (1998), eqs 5–10, as `trackers.converted_measurement` arranges them; its signs and letters.
    """
    level2 = (line[..., :2] ** 2).sum(dim=-1).clamp(min=MIN_LEVEL_M2)
    r2, level = level2 + line[..., 2] ** 2, level2.sqrt()
    var, (ua, ue) = std[..., 0] ** 2, (-torch.expm1(-(std[..., i] ** 2)) for i in (1, 2))
    cc, cs = level2 / r2, level * line[..., 2] / r2  # of the elevation: cos², cos sin
    s, ea, ee = r2 + var, 1.0 - ua, 1.0 - ue
    h, steep = 0.5 * ue * (1.0 + ee) + ee * ee * cc, 0.5 * (1.0 + ee)
    along = h * (var * ea + 0.5 * s * ua * ua) + r2 * ea * ue * (steep - ee * cc)
    across = 0.5 * h * s * ua * (1.0 + ea)
    up = var * (1.0 - h) + r2 * ue * (steep - ee * (1.0 - cc))
    coupling = ea.sqrt() * ee * (var * ee - r2 * ue) * cs
    det = along * up - coupling * coupling
    thin = 1.0 / (r2 * std[..., 2] ** 2)
    far = torch.where(ranging, up / det, thin * (1.0 - cc))
    high = torch.where(ranging, along / det, thin * cc)
    mixed = torch.where(ranging, -coupling / det, -thin * cs)
    wide = torch.where(ranging, 1.0 / across, 1.0 / (level2 * std[..., 1] ** 2))
    return _turned(far, high, mixed, wide, line[..., 0] / level, line[..., 1] / level)


def _turned(far: Tensor, high: Tensor, mixed: Tensor, wide: Tensor, c: Tensor, q: Tensor) -> Tensor:
    """[..., 3, 3] along x, y, z of what is known along (c, q), up, of both, and across (−q, c)."""
    xy, xz, yz = (far - wide) * c * q, mixed * c, mixed * q
    rows = [[far * c * c + wide * q * q, xy, xz], [xy, far * q * q + wide * c * c, yz], [xz, yz, high]]
    return torch.stack([torch.stack(row, dim=-1) for row in rows], dim=-2)


def _shown(above: Tensor, edge: float) -> Tensor:
    """Share of a sensor's information that is there, so far above the minimum range: 0 below, 1 from the edge on."""
    if edge == 0.0:
        return (above >= 0.0).to(above)
    share = (above / edge).clamp(0.0, 1.0)
    return share * share * (3.0 - 2.0 * share)


class _Recursion:
    """The filter's covariances [e, 6, 6], scan by scan, started as by `trackers.position_information`.

    A track waits for a scan that can start it, and, if sensors measure range, for a second one. `torch.where` tells
    who does what; what it leaves out is finite, so that its gradient is 0.
    """

    def __init__(self, prior: Tensor, ranging: Tensor, tracker: ScanFusion, step_s: float):
        self._cov, self._ranging, self._tracker, self._T = prior, ranging, tracker, step_s
        self._two_point = bool(ranging.any())
        self._scans = torch.zeros(len(prior), dtype=torch.int64, device=prior.device)
        self._waited = torch.zeros(len(prior), dtype=prior.dtype, device=prior.device)
        self._eye = torch.eye(3, dtype=prior.dtype, device=prior.device)
        self._phi, self._noise = _motion(self._eye, tracker.acceleration_std**2, step_s)

    def after(self, info: Tensor, above: Tensor, edge_m: float) -> Tensor:
        """The covariances after a scan of sensors' information [e, n, 3, 3], `above` [e, n] m the minimum range."""
        moved = self._phi @ self._cov @ self._phi.mT + self._noise
        starting = self._scans < (2 if self._two_point else 1)
        cov = self._absorbed(info, _shown(above, edge_m), moved)
        if starting.any():
            cov = _pick(starting, self._started(info, above >= 0.0, moved), cov)
        self._cov = cov
        return cov

    def _absorbed(self, info: Tensor, shown: Tensor, P: Tensor) -> Tensor:
        total = (shown[..., None, None] * info).sum(dim=1)
        known = torch.linalg.solve(self._eye + total @ P[:, :3, :3], total)  # (total⁻¹ + P)⁻¹
        P = P - P[:, :, :3] @ known @ P[:, :3]
        return 0.5 * (P + P.mT)

    def _started(self, info: Tensor, measured: Tensor, moved: Tensor) -> Tensor:
        T, q, first = self._T, self._tracker.acceleration_std**2, self._scans == 0
        usable = (measured & self._ranging if self._two_point else measured).any(dim=1)
        total = (measured[..., None, None] * info).sum(dim=1)
        if not self._two_point:
            total = total + self._eye / self._tracker.expected_range_m**2
        R = torch.linalg.inv(_pick(usable, total, self._eye))
        self._waited = torch.where(first, 0.0, self._waited + T)
        waited = self._waited.clamp(min=T)[:, None, None]
        one = _blocks(R, torch.zeros_like(R), (self._tracker.velocity_std**2 * self._eye).expand_as(R))
        velocity = (self._cov[:, :3, :3] + R) / waited**2 + 0.25 * waited**2 * q * self._eye
        started = _pick(first, one, _blocks(R, R / waited, velocity))
        self._scans = self._scans + usable
        return _pick(usable, started, _pick(first, moved, self._cov))


def _pick(which: Tensor, these: Tensor, others: Tensor) -> Tensor:
    """Matrices [e, i, i] of episodes that are meant [e], the others' from elsewhere."""
    return torch.where(which[:, None, None], these, others)


def _motion(eye: Tensor, q: float, T: float) -> tuple[Tensor, Tensor]:
    """Φ and the noise of a step, [6, 6] each."""
    zero = torch.zeros_like(eye)
    return _blocks(eye, T * eye, eye, zero), q * _blocks(0.25 * T**4 * eye, 0.5 * T**3 * eye, T**2 * eye)


def _blocks(pp: Tensor, pv: Tensor, vv: Tensor, vp: Tensor | None = None) -> Tensor:
    """[..., 6, 6] of blocks [..., 3, 3]; symmetric unless the fourth is given."""
    below = pv.mT if vp is None else vp
    return torch.cat([torch.cat([pp, pv], dim=-1), torch.cat([below, vv], dim=-1)], dim=-2)


def _spread(cov: Tensor) -> Tensor:
    return cov[:, :3, :3].diagonal(dim1=-2, dim2=-1).sum(dim=-1).sqrt()
