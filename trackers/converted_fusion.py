"""One target tracked by N sensors: converted measurements, a linear Kalman filter, fusion.

State [x, y, z, vx, vy, vz], constant velocity (`trackers.motion_3d`), H = [I 0]. A scan's measurements enter as
information Λ [3, 3] about the position and g [3], what it says about the predicted position p:

    range, azimuth, elevation   Λ = R⁻¹         g = R⁻¹ (converted − bias − p)
    azimuth, elevation only     Λ = Dᵀ W D      g = Λ (p₀ − p) + Dᵀ W (angles − angles at p₀),  D the slopes at p₀

summed over the sensors; p₀ is the prediction. Sensors' noises are independent, so this central filter is what the
fusion of the sensors' own tracks without feedback gives (`fuse_tracks`). `linearisation` says where the bias and R are
evaluated, as nobody knows the truth:
    local        at the sensor's own track's prediction, as without feedback: the paper's
    fused        at the fused prediction, and in the start at the fused position: the centre tells the sensors
    iterated     the same, then once more at the estimate that comes of it
    measurement  averaged over what the measurement leaves open (Lerro and Bar-Shalom 1993)
    truth        at the truth: for studies of how much the others lose
A sensor without range has no track of its own; the centre linearises its angles at the fused prediction.

Start: positions of the first two scans with averaged moments, and their difference; the covariance is
[[R₂, R₂/T], [R₂/T, (R₁ + R₂)/T² + q T²/4]]. If no sensor measures range, the first scan's directions are crossed
under a weak prior (`expected_range_m`), the velocity is 0 ± `velocity_std`, and the second scan updates like others.
Source: Yang et al. (1998), eqs 1, 2 and section 4; the start, the point of evaluation and the sensors without range
are this package's choices, for the paper says nothing of them (its P₀ = diag(10) makes sense in km² only).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from trackers.converted_episode import (
    LINEARISATIONS,
    LOCAL,
    TRUTH,
    condition_tracks,
    predict_errors,
    predict_tracks,
    track_episode,
)
from trackers.converted_measurement import MIN_RANGE_M, Layout
from trackers.gaussian import Gaussian
from trackers.linalg import psd_inverse


class Track(NamedTuple):
    """What the fused filter said over an episode of k scans.

    Attributes:
        mean: [..., k, 6] m, m/s; at the first scan a velocity of 0.
        cov: [..., k, 6, 6].
        position_error_m: [..., k] distance of the estimated from the true position.
    """

    mean: Any
    cov: Any
    position_error_m: Any


class Theory(NamedTuple):
    """What a layout promises.

    Attributes:
        position_std_m: [..., k] √(p₁₁ + p₂₂ + p₃₃) after each scan.
        cov: [..., 6, 6] after the last.
    """

    position_std_m: Any
    cov: Any


class FusionState(NamedTuple):
    """A track fused at the centre, and those of the n sensors (used by the linearisation `local` only).

    Attributes:
        mean: [..., 6] m, m/s; cov: [..., 6, 6].
        local_mean: [..., n, 6]; local_cov: [..., n, 6, 6].
        scans: [...] int, scans absorbed.
    """

    mean: Any
    cov: Any
    local_mean: Any
    local_cov: Any
    scans: Any


class FusionUpdate(NamedTuple):
    """What one scan did to a track.

    Attributes:
        posterior: FusionState.
        innovation: [..., n, 3] range [m], azimuth and elevation [rad], measured less predicted; range 0 without one.
        nis: [...] normalised innovation squared of all measurements together: χ² with three degrees of freedom a
            ranging sensor and two another. 0 while a track starts.
        log_likelihood: [...] log density of the converted measurements; 0 while a track starts.
    """

    posterior: FusionState
    innovation: Any
    nis: Any
    log_likelihood: Any


class PolarScan(NamedTuple):
    """One scan of n sensors.

    Attributes:
        measurement: [..., n, 3] range [m], azimuth and elevation [rad]; the range of a sensor without one is not used.
        layout: the sensors at the time of the scan, positions [..., n, 3].
    """

    measurement: Any
    layout: Layout

    def check(self) -> None:
        """Raise a ValueError unless the layout is sound and everything used is finite, ranges positive."""
        self.layout.check()
        z, ranging = np.asarray(self.measurement, dtype=float), np.asarray(self.layout.ranging)
        n = ranging.shape[-1]
        if z.shape[-2:] != (n, 3):
            raise ValueError(f"measurement has shape {z.shape}: must be [..., {n}, 3], one row per sensor")
        used = np.where(ranging[..., None] | np.array([False, True, True]), z, 1.0)
        if not np.isfinite(used).all():
            raise ValueError("measurement holds NaN or infinity where it is used: must be finite")
        if not (used[..., 0] > 0.0).all():
            raise ValueError(f"measurement holds the range {used[..., 0].min()} m: must be positive")


@dataclass(frozen=True)
class ConvertedFusion:
    """Fusion of N sensors on converted measurements.

    Settings, SI units:
        step_s: time between scans.
        acceleration_std: √q per axis [m/s²].
        linearisation: where bias and R are evaluated, one of `LINEARISATIONS`; `truth` in `track` only.
        expected_range_m: middle and width of the prior of range where no sensor measures range.
        velocity_std: per axis [m/s], of a track of one scan.
        minimum_range_m: a target nearer to a sensor is an error in `track` and `theoretical`.
    Raises:
        ValueError: a setting outside its range.
    """

    step_s: float = 1.0
    acceleration_std: float = 1.0
    linearisation: str = LOCAL
    expected_range_m: float = 200.0e3
    velocity_std: float = 300.0
    minimum_range_m: float = MIN_RANGE_M

    def __post_init__(self) -> None:
        for name in ("step_s", "expected_range_m", "velocity_std"):
            self._require(0.0 < getattr(self, name) < np.inf, name, "positive and finite")
        for name in ("acceleration_std", "minimum_range_m"):
            self._require(0.0 <= getattr(self, name) < np.inf, name, "finite and not negative")
        self._require(self.linearisation in LINEARISATIONS, "linearisation", f"one of {', '.join(LINEARISATIONS)}")

    def _require(self, met: bool, name: str, words: str) -> None:
        if not met:
            raise ValueError(f"ConvertedFusion.{name} = {getattr(self, name)!r}: must be {words}")

    def track(self, path, layout: Layout, noise, moving: bool = False) -> Track:
        """Measure and track whole episodes in one call.

        Args:
            path: [..., k, 6] true states at the scans.
            layout: n sensors.
            noise: [..., k, n, 3] standard normal numbers for range, azimuth and elevation.
            moving: whether the layout's positions are [..., k, n, 3], one per scan.
        Raises:
            ValueError: an unsound layout (`Layout.check`), a path or noise of another shape or not finite, a target
                closer to a sensor than `minimum_range_m`.
        """
        path, positions, std, ranging = self._checked(path, layout, moving)
        noise = np.asarray(noise, dtype=float)
        wanted = (path.shape[-2], ranging.shape[-1], 3)
        if noise.shape[-3:] != wanted or not np.isfinite(noise).all():
            raise ValueError(f"noise has shape {noise.shape}: must be [..., {', '.join(map(str, wanted))}] and finite")
        mean, cov, error, nearest = track_episode(
            path, positions, std, ranging, noise, LINEARISATIONS.index(self.linearisation), self.step_s,
            self.acceleration_std, self.expected_range_m, self.velocity_std,
        )  # fmt: skip
        self._refuse_near(nearest)
        return Track(mean, cov, error)

    def theoretical(self, path, layout: Layout, moving: bool = False) -> Theory:
        """The covariance recursion with everything evaluated along a path: what layouts promise.

        Many candidates in one call: path [..., 1, k, 6] and layouts [..., c, n, 3].

        Args:
            path: [..., k, 6] states, such as predicted ones.
            layout, moving: as in `track`.
        Raises:
            ValueError: as in `track`.
        """
        position_std, cov, nearest = predict_errors(
            *self._checked(path, layout, moving), self.step_s, self.acceleration_std, self.expected_range_m,
            self.velocity_std,
        )  # fmt: skip
        self._refuse_near(nearest)
        return Theory(position_std, cov)

    def _checked(self, path, layout: Layout, moving: bool) -> tuple[np.ndarray, ...]:
        """Path, positions [..., k, n, 3], accuracies and kinds as arrays."""
        path = np.asarray(path, dtype=float)
        if path.ndim < 2 or path.shape[-1] != 6 or path.shape[-2] < 2 or not np.isfinite(path).all():
            raise ValueError(f"path has shape {path.shape}: must be [..., k, 6] of two scans or more, finite")
        position, std, ranging = map(np.asarray, layout)
        layout.check()
        if not moving:
            *lead, n, _ = position.shape
            position = np.broadcast_to(position[..., None, :, :], (*lead, path.shape[-2], n, 3))
        elif position.ndim < 3 or position.shape[-3] != path.shape[-2]:
            raise ValueError(
                f"layout moves, position has shape {position.shape}: must be [..., {path.shape[-2]}, n, 3]"
            )
        return path, position, std, ranging

    def _refuse_near(self, nearest: np.ndarray) -> None:
        bad = nearest < self.minimum_range_m
        if bad.any():
            at = tuple(int(i) for i in np.argwhere(bad)[0])
            raise ValueError(
                f"sensor {at[-1]} of layout {list(at[:-1])}: the target comes within {nearest[at]:.6g} m, "
                f"must stay beyond the minimum range of {self.minimum_range_m:g} m"
            )

    def initiate(self, scan: PolarScan) -> FusionState:
        """Tracks at a first scan; their velocity is 0 until a second.

        Raises:
            ValueError: an unsound scan.
        """
        scan.check()
        position, std, ranging = scan.layout
        shape = np.broadcast_shapes(*(np.shape(part)[:-2] for part in (scan.measurement, position, std)))
        n = np.shape(ranging)[-1]
        zeros = [np.zeros((*shape, *core)) for core in ((6,), (6, 6), (n, 6), (n, 6, 6))]
        return self.update(FusionState(*zeros, scans=np.zeros(shape, dtype=np.int64)), scan).posterior

    def predict(self, state: FusionState, layout: Layout) -> FusionState:
        """Propagate tracks by one step; one that waits for its second scan stays at its first position."""
        mode = LINEARISATIONS.index(self.linearisation)
        tracks = predict_tracks(*state, layout.ranging, mode, self.step_s, self.acceleration_std)
        return FusionState(*tracks, scans=state.scans)

    def update(self, state: FusionState, scan: PolarScan) -> FusionUpdate:
        """Condition predicted tracks on a scan.

        Raises:
            ValueError: an unsound scan, or the linearisation `truth`.
        """
        self._require(self.linearisation != TRUTH, "linearisation", "another: a scan does not say what is true")
        scan.check()
        position, std, ranging = scan.layout
        *tracks, nu, nis, log_likelihood = condition_tracks(
            *state, scan.measurement, position, std, ranging, LINEARISATIONS.index(self.linearisation), self.step_s,
            self.acceleration_std, self.expected_range_m, self.velocity_std,
        )  # fmt: skip
        return FusionUpdate(FusionState(*tracks, scans=np.asarray(state.scans) + 1), nu, nis, log_likelihood)

    @staticmethod
    def estimate(state: FusionState) -> Gaussian:
        """The fused track: mean [..., 6], cov [..., 6, 6]."""
        return Gaussian(state.mean, state.cov)


def fuse_tracks(prior: Gaussian, local_prior: Gaussian, local_posterior: Gaussian) -> Gaussian:
    """The centre's track from the sensors' own, without feedback.

        Y = P⁻¹ + Σ [Pᵢ(k|k)⁻¹ − Pᵢ(k|k−1)⁻¹],      P' = Y⁻¹,
        x' = x + P' Σ [Pᵢ(k|k)⁻¹ (xᵢ(k|k) − x) − Pᵢ(k|k−1)⁻¹ (xᵢ(k|k−1) − x)]

    Args:
        prior: the centre's prediction, mean [..., 6], cov [..., 6, 6].
        local_prior, local_posterior: the sensors' tracks before and after the scan, [..., n, 6] and [..., n, 6, 6].
    Source: the information form of hierarchical estimation; the paper gives no formula.
    """
    after, before = psd_inverse(local_posterior.cov), psd_inverse(local_prior.cov)
    x = prior.mean[..., None, :]
    pull = np.einsum("...nij,...nj->...i", after, local_posterior.mean - x)
    pull -= np.einsum("...nij,...nj->...i", before, local_prior.mean - x)
    cov = psd_inverse(psd_inverse(prior.cov) + (after - before).sum(-3))
    return Gaussian(prior.mean + np.einsum("...ij,...j->...i", cov, pull), cov)
