"""One target, N sensors that move: converted measurements fused scan by scan, and what places promise.

The filter is `trackers.converted_fusion`'s central one with bias and covariance evaluated at the fused prediction, for
sensors of which some may miss a scan; on sensors that miss none it gives the same numbers. The track begins with an
expectation of the state. It is forgotten at the first scan: as there, positions of two scans start the track, or the
first crossing of directions where no sensor measures range. A scan that cannot start it leaves it as it was.
Source: Yang et al. (1998), eqs 1, 2 and section 4, with the choices that `trackers.converted_fusion` states.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from trackers.compiled import helper, kernel
from trackers.converted_episode import (
    FUSED,
    ITERATED,
    LINEARISATIONS,
    add_promised,
    innovate,
    start_scan,
    update_scan,
)
from trackers.converted_fusion import PolarScan
from trackers.converted_measurement import Layout
from trackers.gaussian import Gaussian
from trackers.linalg import LOG_TWO_PI, invert_3
from trackers.motion_3d import predict_6_in_place
from trackers.position_information import (
    absorb_information,
    any_ranging,
    clear_information,
    fill_shrinkages,
    start_track,
)

NOT_WAITING = -1.0

MODES = (FUSED, ITERATED)
"""Linearisations that need no tracks of the sensors' own."""


class ScanState(NamedTuple):
    """A fused track.

    Attributes:
        mean: [..., 6] m, m/s; cov: [..., 6, 6].
        scans: [...] int, scans absorbed.
        waited_s: [...] time since the first scan of a track that waits for its second, `NOT_WAITING` of any other.
    """

    mean: Any
    cov: Any
    scans: Any
    waited_s: Any


class FusedScan(NamedTuple):
    """One scan of n sensors.

    Attributes:
        measurement: [..., n, 3] range [m], azimuth and elevation [rad]; not used of sensors that miss the scan, nor
            the range of those that measure none.
        measured: [..., n] bool, whether the sensor measured.
        layout: the sensors at the time of the scan, positions [..., n, 3].
    """

    measurement: Any
    measured: Any
    layout: Layout

    def check(self) -> None:
        """Raise a ValueError unless the layout is sound and everything used is finite, ranges positive."""
        z, measured = np.asarray(self.measurement, dtype=float), np.asarray(self.measured)
        if measured.dtype != bool or measured.shape != z.shape[:-1]:
            raise ValueError(
                f"measured has shape {measured.shape} and dtype {measured.dtype}: must be bool, one per row of "
                f"measurement, which has shape {z.shape}"
            )
        PolarScan(np.where(measured[..., None], z, 1.0), self.layout).check()


class ScanUpdate(NamedTuple):
    """What one scan did to a track.

    Attributes:
        posterior: ScanState.
        innovation: [..., n, 3] range [m], azimuth and elevation [rad], measured less predicted; 0 where not measured.
        nis, log_likelihood: [...] as of `trackers.converted_fusion.FusionUpdate`.
    """

    posterior: ScanState
    innovation: Any
    nis: Any
    log_likelihood: Any


class Promised(NamedTuple):
    """The covariance recursion along a path.

    Attributes:
        cov: [..., 6, 6], scans [...], waited_s [...] after the last scan, as of `ScanState`.
        position_std_m: [..., k] √(p₁₁ + p₂₂ + p₃₃) after each scan.
    """

    cov: Any
    scans: Any
    waited_s: Any
    position_std_m: Any


@dataclass(frozen=True)
class ScanFusion:
    """Fusion of N sensors on converted measurements, scan by scan.

    Settings, SI units:
        acceleration_std: √q per axis [m/s²].
        linearisation: where bias and R are evaluated, "fused", at the prediction, or "iterated", then once more at
            the estimate that comes of it.
        expected_range_m, velocity_std: as of `trackers.converted_fusion.ConvertedFusion`.
        minimum_range_m: a sensor does not measure a target that is nearer; `promise` leaves it out.
    Raises:
        ValueError: a setting outside its range.
    """

    acceleration_std: float = 0.3
    linearisation: str = FUSED
    expected_range_m: float = 200.0e3
    velocity_std: float = 300.0
    minimum_range_m: float = 5.0e3

    def __post_init__(self) -> None:
        for name in ("expected_range_m", "velocity_std"):
            self._require(0.0 < getattr(self, name) < np.inf, name, "positive and finite")
        for name in ("acceleration_std", "minimum_range_m"):
            self._require(0.0 <= getattr(self, name) < np.inf, name, "finite and not negative")
        self._require(self.linearisation in MODES, "linearisation", f"one of {', '.join(MODES)}")

    def _require(self, met: bool, name: str, words: str) -> None:
        if not met:
            raise ValueError(f"ScanFusion.{name} = {getattr(self, name)!r}: must be {words}")

    @staticmethod
    def initiate(expected: Gaussian) -> ScanState:
        """Tracks before their first scan: what is expected, mean [..., 6] and cov [..., 6, 6].

        Raises:
            ValueError: an expectation that is not finite.
        """
        mean, cov = np.array(expected.mean, dtype=float), np.array(expected.cov, dtype=float)
        if not (np.isfinite(mean).all() and np.isfinite(cov).all()):
            raise ValueError("expected holds NaN or infinity: must be finite")
        shape = mean.shape[:-1]
        return ScanState(mean, cov, np.zeros(shape, dtype=np.int64), np.full(shape, NOT_WAITING))

    def predict(self, state: ScanState, step_s) -> ScanState:
        """Propagate tracks by `step_s`; one that waits for its second scan stays at its first position."""
        mean, cov, waited = _predict(state.mean, state.cov, state.waited_s, step_s, self.acceleration_std)
        return ScanState(mean, cov, state.scans, waited)

    def update(self, state: ScanState, scan: FusedScan) -> ScanUpdate:
        """Condition predicted tracks on a scan.

        Raises:
            ValueError: an unsound scan.
        """
        scan.check()
        *track, nu, nis, log_likelihood = _condition(
            *state, scan.measurement, scan.measured, *scan.layout, LINEARISATIONS.index(self.linearisation),
            self.acceleration_std, self.expected_range_m, self.velocity_std,
        )  # fmt: skip
        return ScanUpdate(ScanState(*track), nu, nis, log_likelihood)

    @staticmethod
    def estimate(state: ScanState) -> Gaussian:
        """The fused track: mean [..., 6], cov [..., 6, 6]."""
        return Gaussian(state.mean, state.cov)

    def promise(self, state: Any, path, layout: Layout, step_s) -> Promised:
        """Go on from a track with everything evaluated along a path: what places of sensors promise.

        Args:
            state: a `ScanState` or `Promised`, of which cov, scans and waited_s are read.
            path: [..., k, 6] true or expected states at the next k scans.
            layout: positions [..., k, n, 3], one per scan.
            step_s: between scans.
        Raises:
            ValueError: an unsound layout, or a path that does not fit it.
        """
        path, position = np.asarray(path, dtype=float), np.asarray(layout.position)
        if path.ndim < 2 or position.ndim < 3 or path.shape[-2] != position.shape[-3] or not np.isfinite(path).all():
            raise ValueError(
                f"path has shape {path.shape}, positions {position.shape}: must be finite, [..., k, 6] and "
                "[..., k, n, 3] of the same scans"
            )
        layout.check()
        return Promised(
            *_promise(
                state.cov, state.scans, state.waited_s, path, *layout, self.minimum_range_m, step_s,
                self.acceleration_std, self.expected_range_m, self.velocity_std,
            )
        )  # fmt: skip


# -- kernels ----------------------------------------------------------------------------------------------------------


@helper
def _move_on(x, P, waited, T, q):
    """Predict a track in place, unless it waits for its second scan; returns the time waited."""
    if waited >= 0.0:
        return waited + T
    predict_6_in_place(x, P, T, q)
    return NOT_WAITING


@kernel("(x6),(x6,x6),(),(),()->(x6),(x6,x6),()", "FFfffFFf")
def _predict(x, P, waited, T, q, x_out, P_out, waited_out):
    x_out[:] = x
    P_out[:] = P
    waited_out[0] = _move_on(x_out, P_out, waited, T, q)


@kernel(
    "(x6),(x6,x6),(),(),(n,p3),(n),(n,p3),(n,p3),(n),(),(),(),()->(x6),(x6,x6),(),(),(n,p3),(),()",
    "FFifFBFFBifffFFifFff",
)
def _condition(
    x, P, scans, waited, z, measured, sensors, std, ranging, mode, q, rho, V,
    x_out, P_out, scans_out, waited_out, nu, nis, log_likelihood,
):  # fmt: skip
    n, m, degrees = ranging.shape[0], 0, 0
    rows, H = np.empty((3, n, 3)), np.empty((2, 3))
    kinds = np.empty(n, dtype=np.bool_)
    for s in range(n):
        nu[s, 0] = nu[s, 1] = nu[s, 2] = 0.0
        if measured[s]:
            innovate(x, z[s], sensors[s], ranging[s], scans > 0, H, nu[s])
            degrees += 3 if ranging[s] else 2
            for i in range(3):
                rows[0, m, i], rows[1, m, i], rows[2, m, i] = z[s, i], sensors[s, i], std[s, i]
            kinds[m] = ranging[s]
            m += 1
    kinds = kinds[:m]
    two_point, waits = any_ranging(ranging), waited >= 0.0
    x_out[:] = x
    P_out[:] = P
    nis[0] = log_likelihood[0] = 0.0
    scans_out[0], waited_out[0] = scans, waited
    starts = scans == 0 or waits
    usable = any_ranging(kinds) if starts and two_point else m > 0
    if usable:
        W, v, u = np.empty((10, 3, 3)), np.empty((5, 3)), np.empty((m, 2))
        lx, lP = np.zeros((m, 6)), np.zeros((m, 6, 6))
        fill_shrinkages(rows[2, :m], u)
        scans_out[0] = scans + 1
        waited_out[0] = 0.0 if two_point and scans == 0 else NOT_WAITING
        if starts:
            start_scan(x, P, lx, lP, waits, rows[0, :m], rows[1, :m], rows[2, :m], u, kinds, x, mode, waited, q, rho, V,
                       x_out, P_out, lx, lP, W, v)  # fmt: skip
        else:
            squared, gain, log_root = update_scan(
                x, P, lx, lP, rows[0, :m], rows[1, :m], rows[2, :m], u, kinds, x, mode, x_out, P_out, lx, lP, W, v
            )
            nis[0] = squared - gain
            log_likelihood[0] = -0.5 * (nis[0] + degrees * LOG_TWO_PI) - log_root


@kernel(
    "(x6,x6),(),(),(k,x6),(k,n,p3),(n,p3),(n),(),(),(),(),()->(x6,x6),(),(),(k)",
    "FifFFFBfffffFifF",
)
def _promise(P, scans, waited, path, sensors, std, ranging, nearest, T, q, rho, V,
             P_out, scans_out, waited_out, position_std):  # fmt: skip
    k, n = sensors.shape[0], sensors.shape[1]
    x, W, v, u = np.zeros(6), np.empty((10, 3, 3)), np.zeros((3, 3)), np.empty((n, 2))
    before, total, cov, g, line = P.copy(), W[0], W[3], v[0], v[1]
    fill_shrinkages(std, u)
    two_point = any_ranging(ranging)
    scans_out[0], waited_out[0] = scans, waited
    for t in range(k):
        waits = waited_out[0] >= 0.0
        starts = scans_out[0] == 0 or waits
        waited_out[0] = _move_on(x, before, waited_out[0], T, q)
        clear_information(total, g, 1.0 / (rho * rho) if starts and not two_point else 0.0)
        usable = False
        for s in range(n):
            dx, dy, dz = path[t, 0] - sensors[t, s, 0], path[t, 1] - sensors[t, s, 1], path[t, 2] - sensors[t, s, 2]
            if dx * dx + dy * dy + dz * dz < nearest * nearest:
                continue
            usable = usable or ranging[s] or not (starts and two_point)
            add_promised(path[t], sensors[t, s], std[s], u[s], ranging[s], W, v, total, g)
        for i in range(3):
            g[i] = 0.0
        if not usable:
            P_out[:] = before
        elif starts:
            invert_3(total, cov)
            start_track(x, before, line, cov, waits, waited_out[0], q, V, x, P_out)
        else:
            absorb_information(x, before, total, g, x, P_out, W[5], W[6], W[7], W[8], W[9])
        if usable:
            waited_out[0] = 0.0 if two_point and scans_out[0] == 0 else NOT_WAITING
            scans_out[0] += 1
        for i in range(6):
            for j in range(6):
                before[i, j] = P_out[i, j]
        position_std[t] = math.sqrt(P_out[0, 0] + P_out[1, 1] + P_out[2, 2])
