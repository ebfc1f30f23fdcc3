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
from trackers.linalg import LOG_TWO_PI, cholesky_in_place, invert_3, psd_inverse
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


# -- one measurement's information ------------------------------------------------------------------------------------


@helper
def _line_into(z, line):
    """Line of sight [3] m of z = (range, azimuth, elevation)."""
    level = z[0] * math.cos(z[2])
    line[0], line[1], line[2] = level * math.cos(z[1]), level * math.sin(z[1]), z[0] * math.sin(z[2])


@helper
def _debias(line, at, sensor, averaged, std, u, R):
    """Debiased position into line [3], its covariance into R [3, 3]; both evaluated at `at` [≥3], or averaged."""
    bias = (0.0, 0.0, 0.0)
    if averaged:
        bias = averaged_at(line[0], line[1], line[2], std[0], u[0], u[1], R)
    else:
        bias = moments_at(at[0] - sensor[0], at[1] - sensor[1], at[2] - sensor[2], std[0], u[0], u[1], R)
    for i in range(3):
        line[i] += sensor[i] - bias[i]


@helper
def _add_position(position, info, p, total, g):
    """Add information `info` [3, 3] about a measured position [3]; returns dᵀ info d for d = position − p."""
    squared = 0.0
    for i in range(3):
        pull = 0.0
        for j in range(3):
            total[i, j] += info[i, j]
            pull += info[i, j] * (position[j] - p[j])
        g[i] += pull
        squared += pull * (position[i] - p[i])
    return squared


@helper
def _add_direction(z, sensor, std, at, p, H, total, g):
    """Add the information of azimuth and elevation linearised at `at` [≥3]; returns the squared residuals at p."""
    azimuth, elevation = linearize_direction(at, sensor, H)
    squared = 0.0
    for a in range(2):
        nu = wrap_scalar(z[1] - azimuth) if a == 0 else z[2] - elevation
        for i in range(3):
            nu += H[a, i] * (at[i] - p[i])
        weight = 1.0 / (std[1 + a] * std[1 + a])
        squared += weight * nu * nu
        for i in range(3):
            g[i] += weight * nu * H[a, i]
            for j in range(3):
                total[i, j] += weight * H[a, i] * H[a, j]
    return squared


@helper
def _clear(total, g, information):
    """Information `information` · I about the position, and g = 0."""
    for i in range(3):
        g[i] = 0.0
        for j in range(3):
            total[i, j] = information if i == j else 0.0


@helper
def _move(p, total, g, cov):
    """cov [3, 3] = total⁻¹; p [3] moves by cov g."""
    invert_3(total, cov)
    for i in range(3):
        for j in range(3):
            p[i] += cov[i, j] * g[j]


@helper
def _absorb(x, P, total, g, x_out, P_out, L, A, M, B, E):
    """Posterior of x [6], P [6, 6] given information `total` [3, 3] and g [3]; returns gᵀ P⁺ g and log √det(I + PΛ).

    With P_pp = LLᵀ and I + LᵀΛL = CCᵀ the position's posterior is BᵀB, B = C⁻¹Lᵀ: positive whatever Λ is, even 0.
    """
    for i in range(3):
        for j in range(i + 1):
            L[i, j] = P[i, j]
    cholesky_in_place(L)
    for i in range(3):
        for j in range(3):
            s, t = P[3 + i, j], 0.0
            for k in range(j):
                s -= A[i, k] * L[j, k]
            A[i, j] = s / L[j, j]
            for k in range(j, 3):
                t += total[i, k] * L[k, j]
            B[i, j] = t
    for i in range(3):
        for j in range(i + 1):
            s = 1.0 if i == j else 0.0
            for k in range(i, 3):
                s += L[k, i] * B[k, j]
            M[i, j] = s
    cholesky_in_place(M)
    for j in range(3):
        for i in range(3):
            s = L[j, i] if i <= j else 0.0
            for k in range(i):
                s -= M[i, k] * B[k, j]
            B[i, j] = s / M[i, i]
    for i in range(3):
        for j in range(3):
            s = A[i, j]
            for k in range(j):
                s -= E[i, k] * M[j, k]
            E[i, j] = s / M[j, j]
    gain = 0.0
    for i in range(6):
        x_out[i] = x[i]
    for k in range(3):
        b = B[k, 0] * g[0] + B[k, 1] * g[1] + B[k, 2] * g[2]
        gain += b * b
        for i in range(3):
            x_out[i] += B[k, i] * b
            x_out[3 + i] += E[i, k] * b
    for i in range(3):
        for j in range(3):
            pp, vp, vv = 0.0, 0.0, P[3 + i, 3 + j]
            for k in range(3):
                pp += B[k, i] * B[k, j]
                vp += E[i, k] * B[k, j]
                vv += E[i, k] * E[j, k] - A[i, k] * A[j, k]
            P_out[i, j], P_out[3 + i, j], P_out[j, 3 + i], P_out[3 + i, 3 + j] = pp, vp, vp, vv
    return gain, math.log(M[0, 0] * M[1, 1] * M[2, 2])


# -- start ------------------------------------------------------------------------------------------------------------


@helper
def _any_ranging(ranging):
    found = False
    for i in range(ranging.shape[0]):
        found = found or ranging[i]
    return found


@helper
def _cross(z, sensors, std, expected_range, p, total, g, cov, H, m, u):
    """Position p [3] and cov [3, 3] where the directions cross, under a prior `expected_range` wide."""
    n, weak = sensors.shape[0], 1.0 / (expected_range * expected_range)
    for i in range(3):
        m[i] = 0.0
    for s in range(n):
        _sight(z[s], u)
        for i in range(3):
            m[i] += (sensors[s, i] + expected_range * u[i]) / n
    _clear(total, g, weak)
    for s in range(n):
        _sight(z[s], u)
        weight, along = weak / (std[s, 1] * std[s, 2]), 0.0
        for j in range(3):
            along += u[j] * (sensors[s, j] - m[j])
        for i in range(3):
            g[i] += weight * (sensors[s, i] - m[i] - u[i] * along)
            for j in range(3):
                total[i, j] += weight * ((1.0 if i == j else 0.0) - u[i] * u[j])
    for i in range(3):
        p[i] = m[i]
    _move(p, total, g, cov)
    for _ in range(_CROSSING_STEPS):
        _clear(total, g, weak)
        for i in range(3):
            g[i] = weak * (m[i] - p[i])
        for s in range(n):
            _add_direction(z[s], sensors[s], std[s], p, p, H, total, g)
        _move(p, total, g, cov)


@helper
def _sight(z, u):
    level = math.cos(z[2])
    u[0], u[1], u[2] = level * math.cos(z[1]), level * math.sin(z[1]), math.sin(z[2])


@helper
def _one_point(x, P, p, R, velocity_std):
    """Track at a measured position, its velocity 0 ± velocity_std."""
    for i in range(3):
        x[i], x[3 + i] = p[i], 0.0
        for j in range(3):
            P[i, j], P[i, 3 + j], P[3 + i, j] = R[i, j], 0.0, 0.0
            P[3 + i, 3 + j] = velocity_std * velocity_std if i == j else 0.0


@helper
def _two_point(x, P, p, R, T, q, x_out, P_out):
    """Track of the first scan's position in x [6], P [6, 6] and the second's p [3], R [3, 3]."""
    for i in range(3):
        x_out[3 + i] = (p[i] - x[i]) / T
        x_out[i] = p[i]
    for i in range(3):
        for j in range(3):
            vv = (P[i, j] + R[i, j]) / (T * T) + (0.25 * T * T * q * q if i == j else 0.0)
            P_out[i, j], P_out[i, 3 + j], P_out[3 + i, j] = R[i, j], R[i, j] / T, R[i, j] / T
            P_out[3 + i, 3 + j] = vv


@helper
def _start_track(x, P, p, R, second, T, q, velocity_std, x_out, P_out):
    if second:
        _two_point(x, P, p, R, T, q, x_out, P_out)
    else:
        _one_point(x_out, P_out, p, R, velocity_std)


# -- one scan ---------------------------------------------------------------------------------------------------------


@helper
def _start(
    x, P, lx, lP, second, z, sensors, std, u, ranging, truth, mode, T, q, rho, V, x_out, P_out, lx_out, lP_out, W, v
):  # fmt: skip
    """The fused track and the sensors' own from the first scan, or from the first two."""
    p, g, line = v[0], v[1], v[2]
    total, R, info, cov, H = W[0], W[1], W[2], W[3], W[4]
    _clear(total, g, 0.0)
    first = True
    for s in range(sensors.shape[0]):
        if ranging[s]:
            _line_into(z[s], line)
            _debias(line, truth, sensors[s], mode != _TRUTH, std[s], u[s], R)
            _start_track(lx[s], lP[s], line, R, second, T, q, V, lx_out[s], lP_out[s])
            if first:
                for i in range(3):
                    p[i] = line[i]
                first = False
            invert_3(R, info)
            _add_position(line, info, p, total, g)
        else:
            for i in range(6):
                lx_out[s, i] = 0.0
                for j in range(6):
                    lP_out[s, i, j] = 0.0
    if first:
        _cross(z, sensors, std, rho, p, total, g, cov, H, v[3], v[4])
    else:
        _move(p, total, g, cov)
        for i in range(3):
            g[i] = 0.0
        for s in range(sensors.shape[0]):
            if not ranging[s]:
                _add_direction(z[s], sensors[s], std[s], p, p, H, total, g)
        _move(p, total, g, cov)
    _start_track(x, P, p, cov, second, T, q, V, x_out, P_out)


@helper
def _update(x, P, lx, lP, z, sensors, std, u, ranging, truth, mode, x_out, P_out, lx_out, lP_out, W, v):
    """One scan on predicted tracks; returns the squared residuals' sum, its explained part, and log √det S."""
    at, g, line, own = v[0], v[1], v[2], v[3]
    total, R, info, H, own_total = W[0], W[1], W[2], W[3], W[4]
    L, A, M, B, E = W[5], W[6], W[7], W[8], W[9]
    squared = gain = log_det = spread = 0.0
    for i in range(3):
        at[i] = x[i]
    for _ in range(2 if mode == _ITERATED else 1):
        _clear(total, g, 0.0)
        squared = log_det = 0.0
        for s in range(sensors.shape[0]):
            if ranging[s]:
                _line_into(z[s], line)
                # a branch per mode: the places are arrays of different layouts
                if mode == _LOCAL:
                    _debias(line, lx[s], sensors[s], False, std[s], u[s], R)
                elif mode == _TRUTH:
                    _debias(line, truth, sensors[s], False, std[s], u[s], R)
                else:
                    _debias(line, at, sensors[s], mode == _MEASUREMENT, std[s], u[s], R)
                log_det += 0.5 * math.log(invert_3(R, info))
                squared += _add_position(line, info, x, total, g)
                if mode == _LOCAL:
                    _clear(own_total, own, 0.0)
                    _add_position(line, info, lx[s], own_total, own)
                    _absorb(lx[s], lP[s], own_total, own, lx_out[s], lP_out[s], L, A, M, B, E)
            else:
                squared += _add_direction(z[s], sensors[s], std[s], at, x, H, total, g)
                log_det += math.log(std[s, 1] * std[s, 2])
        gain, spread = _absorb(x, P, total, g, x_out, P_out, L, A, M, B, E)
        for i in range(3):
            at[i] = x_out[i]
    return squared, gain, log_det + spread


@helper
def _shrinkages(std, u):
    for s in range(std.shape[0]):
        u[s, 0], u[s, 1] = shrinkage(std[s, 1]), shrinkage(std[s, 2])


@helper
def _copy_tracks(lx, lP, lx_out, lP_out):
    for s in range(lx.shape[0]):
        for i in range(6):
            lx_out[s, i] = lx[s, i]
            for j in range(6):
                lP_out[s, i, j] = lP[s, i, j]


# -- whole episodes ---------------------------------------------------------------------------------------------------


@kernel(
    "(k,x6),(k,n,p3),(n,p3),(n),(k,n,p3),(),(),(),(),()->(k,x6),(k,x6,x6),(k),(n)",
    "FfFBFiffffFFFF",
)
def _track(path, sensors, std, ranging, noise, mode, T, q, rho, V, mean, cov, error, nearest):
    k, n = noise.shape[0], noise.shape[1]
    x, P, lx, lP = np.zeros(6), np.zeros((6, 6)), np.zeros((n, 6)), np.zeros((n, 6, 6))
    W, v, u, z = np.empty((10, 3, 3)), np.empty((5, 3)), np.empty((n, 2)), np.empty((n, 3))
    _shrinkages(std, u)
    two_point = _any_ranging(ranging)
    for s in range(n):
        nearest[s] = math.inf
    for t in range(k):
        for s in range(n):
            dx, dy, dz = path[t, 0] - sensors[t, s, 0], path[t, 1] - sensors[t, s, 1], path[t, 2] - sensors[t, s, 2]
            level2 = dx * dx + dy * dy
            r = math.sqrt(level2 + dz * dz)
            nearest[s] = min(nearest[s], r)
            z[s, 0] = r + std[s, 0] * noise[t, s, 0] if ranging[s] else 0.0
            z[s, 1] = math.atan2(dy, dx) + std[s, 1] * noise[t, s, 1]
            z[s, 2] = math.atan2(dz, math.sqrt(level2)) + std[s, 2] * noise[t, s, 2]
        if t == 0 or (t == 1 and two_point):
            _start(x, P, lx, lP, t == 1, z, sensors[t], std, u, ranging, path[t], mode, T, q, rho, V,
                   mean[t], cov[t], lx, lP, W, v)  # fmt: skip
        else:
            predict_6_in_place(x, P, T, q)
            if mode == _LOCAL:
                for s in range(n):
                    if ranging[s]:
                        predict_6_in_place(lx[s], lP[s], T, q)
            _update(x, P, lx, lP, z, sensors[t], std, u, ranging, path[t], mode, mean[t], cov[t], lx, lP, W, v)
        for i in range(6):
            x[i] = mean[t, i]
            for j in range(6):
                P[i, j] = cov[t, i, j]
        error[t] = math.sqrt((x[0] - path[t, 0]) ** 2 + (x[1] - path[t, 1]) ** 2 + (x[2] - path[t, 2]) ** 2)


@kernel("(k,x6),(k,n,p3),(n,p3),(n),(),(),(),()->(k),(x6,x6),(n)", "FfFBffffFFF")
def _theory(path, sensors, std, ranging, T, q, rho, V, position_std, P_out, nearest):
    k, n = sensors.shape[0], sensors.shape[1]
    x, P, W, v, u = np.zeros(6), np.zeros((6, 6)), np.empty((10, 3, 3)), np.zeros((3, 3)), np.empty((n, 2))
    total, R, info, cov, H, g, line, z = W[0], W[1], W[2], W[3], W[4], v[0], v[1], v[2]
    _shrinkages(std, u)
    two_point = _any_ranging(ranging)
    for s in range(n):
        nearest[s] = math.inf
    for t in range(k):
        _clear(total, g, 1.0 / (rho * rho) if t == 0 and not two_point else 0.0)
        for s in range(n):
            dx, dy, dz = path[t, 0] - sensors[t, s, 0], path[t, 1] - sensors[t, s, 1], path[t, 2] - sensors[t, s, 2]
            nearest[s] = min(nearest[s], math.sqrt(dx * dx + dy * dy + dz * dz))
            if ranging[s]:
                moments_at(dx, dy, dz, std[s, 0], u[s, 0], u[s, 1], R)
                invert_3(R, info)
                _add_position(line, info, line, total, g)
            else:
                _add_direction(z, sensors[t, s], std[s], path[t], path[t], H, total, g)
        for i in range(3):
            g[i] = 0.0
        if t == 0 or (t == 1 and two_point):
            invert_3(total, cov)
            _start_track(x, P, line, cov, t == 1, T, q, V, x, P_out)
        else:
            predict_6_in_place(x, P, T, q)
            _absorb(x, P, total, g, x, P_out, W[5], W[6], W[7], W[8], W[9])
        for i in range(6):
            for j in range(6):
                P[i, j] = P_out[i, j]
        position_std[t] = math.sqrt(P[0, 0] + P[1, 1] + P[2, 2])


# -- scan by scan -----------------------------------------------------------------------------------------------------


@kernel("(x6),(x6,x6),(n,x6),(n,x6,x6),(),(n),(),(),()->(x6),(x6,x6),(n,x6),(n,x6,x6)", "FFFFiBiffFFFF")
def _predict(x, P, lx, lP, scans, ranging, mode, T, q, x_out, P_out, lx_out, lP_out):
    for i in range(6):
        x_out[i] = x[i]
        for j in range(6):
            P_out[i, j] = P[i, j]
    _copy_tracks(lx, lP, lx_out, lP_out)
    if scans > 1 or not _any_ranging(ranging):
        predict_6_in_place(x_out, P_out, T, q)
        if mode == _LOCAL:
            for s in range(ranging.shape[0]):
                if ranging[s]:
                    predict_6_in_place(lx_out[s], lP_out[s], T, q)


@kernel(
    "(x6),(x6,x6),(n,x6),(n,x6,x6),(),(n,p3),(n,p3),(n,p3),(n),(),(),(),(),()"
    "->(x6),(x6,x6),(n,x6),(n,x6,x6),(n,p3),(),()",
    "FFFFiFFFBiffffFFFFFff",
)
def _condition(
    x, P, lx, lP, scans, z, sensors, std, ranging, mode, T, q, rho, V,
    x_out, P_out, lx_out, lP_out, nu, nis, log_likelihood,
):  # fmt: skip
    n = ranging.shape[0]
    W, v, u, H = np.empty((10, 3, 3)), np.empty((5, 3)), np.empty((n, 2)), np.empty((2, 3))
    _shrinkages(std, u)
    nis[0] = log_likelihood[0] = 0.0
    degrees = 0
    for s in range(n):
        azimuth, elevation = linearize_direction(x, sensors[s], H)
        nu[s, 0] = 0.0
        if ranging[s] and scans > 0:
            dx, dy, dz = x[0] - sensors[s, 0], x[1] - sensors[s, 1], x[2] - sensors[s, 2]
            nu[s, 0] = z[s, 0] - math.sqrt(dx * dx + dy * dy + dz * dz)
        nu[s, 1] = wrap_scalar(z[s, 1] - azimuth) if scans > 0 else 0.0
        nu[s, 2] = z[s, 2] - elevation if scans > 0 else 0.0
        degrees += 3 if ranging[s] else 2
    if scans == 0 or (scans == 1 and _any_ranging(ranging)):
        _start(x, P, lx, lP, scans == 1, z, sensors, std, u, ranging, x, mode, T, q, rho, V,
               x_out, P_out, lx_out, lP_out, W, v)  # fmt: skip
    else:
        _copy_tracks(lx, lP, lx_out, lP_out)
        squared, gain, log_root = _update(
            x, P, lx, lP, z, sensors, std, u, ranging, x, mode, x_out, P_out, lx_out, lP_out, W, v
        )
        nis[0] = squared - gain
        log_likelihood[0] = -0.5 * (nis[0] + degrees * LOG_TWO_PI) - log_root


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


# -- tracker ----------------------------------------------------------------------------------------------------------


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
        mean, cov, error, nearest = _track(
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
        position_std, cov, nearest = _theory(
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
            raise ValueError(f"layout moves, position has shape {position.shape}: must be [..., {path.shape[-2]}, n, 3]")
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
        shape = np.broadcast_shapes(*(np.shape(part)[:-2] for part in (scan.measurement, scan.layout.position)))
        n = np.shape(scan.layout.ranging)[-1]
        zeros = [np.zeros((*shape, *core)) for core in ((6,), (6, 6), (n, 6), (n, 6, 6))]
        return self.update(FusionState(*zeros, np.zeros(shape, dtype=np.int64)), scan).posterior

    def predict(self, state: FusionState, layout: Layout) -> FusionState:
        """Propagate tracks by one step; one that waits for its second scan stays at its first position."""
        mode = LINEARISATIONS.index(self.linearisation)
        tracks = _predict(*state, layout.ranging, mode, self.step_s, self.acceleration_std)
        return FusionState(*tracks, state.scans)

    def update(self, state: FusionState, scan: PolarScan) -> FusionUpdate:
        """Condition predicted tracks on a scan.

        Raises:
            ValueError: an unsound scan, or the linearisation `truth`.
        """
        self._require(self.linearisation != TRUTH, "linearisation", "another: a scan does not say what is true")
        scan.check()
        position, std, ranging = scan.layout
        *tracks, nu, nis, log_likelihood = _condition(
            *state, scan.measurement, position, std, ranging, LINEARISATIONS.index(self.linearisation), self.step_s,
            self.acceleration_std, self.expected_range_m, self.velocity_std,
        )  # fmt: skip
        return FusionUpdate(FusionState(*tracks, np.asarray(state.scans) + 1), nu, nis, log_likelihood)

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
