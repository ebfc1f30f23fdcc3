"""One target tracked by N sensors: converted measurements, a linear Kalman filter, fusion.

State [x, y, z, vx, vy, vz], constant velocity (`trackers.motion_3d`), H = [I 0]. A scan's measurements enter as
information Λ [3, 3] about the position and g [3], what it says about the predicted position p:

    range, azimuth, elevation   Λ = R⁻¹         g = R⁻¹ (converted − bias − p)
    azimuth, elevation only     Λ = Dᵀ W D      g = Λ (p₀ − p) + Dᵀ W (angles − angles at p₀),  D the slopes at p₀

summed over the sensors; p₀ is the prediction. Sensors' noises are independent, so this central filter is what the
fusion of the sensors' own tracks without feedback gives (`fuse_tracks`). `linearisation` says where the bias and R are
evaluated, as nobody knows the truth:
    local        at the sensor's own track's prediction, as without feedback: the paper's
    fused        at the fused prediction: the centre tells the sensors
    iterated     at the fused prediction, then once more at the estimate that comes of it
    measurement  averaged over what the measurement leaves open (Lerro and Bar-Shalom 1993)
    truth        at the truth: for studies of how much the others lose
A sensor without range has no track of its own; the centre linearises its angles at the fused prediction.

Start: positions of the first two scans with averaged moments, and their difference; the covariance is
[[R₂, R₂/T], [R₂/T, (R₁ + R₂)/T² + q T²/4]]. If no sensor measures range, the first scan's directions are crossed under a
weak prior (`expected_range_m`), the velocity is 0 ± `velocity_std`, and the second scan is an update like others.
Source: Yang et al. (1998), eqs 1, 2 and section 4; the start, the point of evaluation and the sensors without range are
this package's choices, for the paper says nothing of them (its P₀ = diag(10) makes sense in km² only).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from trackers.angles import wrap_scalar
from trackers.compiled import helper, kernel
from trackers.converted_measurement import MIN_RANGE_M, Layout, averaged_at, moments_at, shrinkage
from trackers.direction import linearize_direction
from trackers.gaussian import Gaussian
from trackers.linalg import cholesky_in_place, psd_inverse, symmetrize
from trackers.motion_3d import predict_6_in_place

LINEARISATIONS = LOCAL, FUSED, ITERATED, MEASUREMENT, TRUTH = ("local", "fused", "iterated", "measurement", "truth")
_LOCAL, _ITERATED, _MEASUREMENT, _TRUTH = (LINEARISATIONS.index(x) for x in (LOCAL, ITERATED, MEASUREMENT, TRUTH))
_CROSSING_STEPS = 5


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
