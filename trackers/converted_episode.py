"""Kernels of the fusion of N sensors (`trackers.converted_fusion`): whole episodes, single scans, the theory.

x, P are the centre's track, lx, lP the sensors' own; `mode` is a place in `LINEARISATIONS`, T the step [s], q the
acceleration's standard deviation [m/s²], rho the expected range [m] and V the velocity's deviation [m/s] of a start.
W and v are scratch: ten matrices and five vectors.
"""

from __future__ import annotations

import math

import numpy as np

from trackers.angles import wrap_scalar
from trackers.compiled import helper, kernel
from trackers.converted_measurement import information_at
from trackers.direction import linearize_direction
from trackers.linalg import LOG_TWO_PI, invert_3
from trackers.motion_3d import predict_6_in_place
from trackers.position_information import (
    absorb_information,
    add_direction,
    add_position,
    any_ranging,
    clear_information,
    cross_directions,
    debias,
    fill_shrinkages,
    line_into,
    move,
    start_track,
)

LINEARISATIONS = LOCAL, FUSED, ITERATED, MEASUREMENT, TRUTH = ("local", "fused", "iterated", "measurement", "truth")
_LOCAL, _FUSED, _ITERATED, _MEASUREMENT, _TRUTH = range(len(LINEARISATIONS))


# -- one scan ---------------------------------------------------------------------------------------------------------


@helper
def _fuse_positions(p, at, averaged, z, sensors, std, u, ranging, total, g, cov, R, info, H, line):
    """Position p [3] and cov [3, 3] of one scan; bias and R evaluated at `at` [≥3] or averaged, p a point near it."""
    clear_information(total, g, 0.0)
    for s in range(sensors.shape[0]):
        if ranging[s]:
            line_into(z[s], line)
            debias(line, at, sensors[s], averaged, std[s], u[s], R)
            invert_3(R, info)
            add_position(line, info, p, total, g)
    move(p, total, g, cov)
    for i in range(3):
        g[i] = 0.0
    for s in range(sensors.shape[0]):
        if not ranging[s]:
            add_direction(z[s], sensors[s], std[s], p, p, H, total, g)
    move(p, total, g, cov)


@helper
def start_scan(
    x, P, lx, lP, second, z, sensors, std, u, ranging, truth, mode, T, q, rho, V, x_out, P_out, lx_out, lP_out, W, v
):  # fmt: skip
    """The fused track and the sensors' own from the first scan, or from the first two."""
    p, g, line, at = v[0], v[1], v[2], v[3]
    total, R, info, cov, H = W[0], W[1], W[2], W[3], W[4]
    first = True
    for s in range(sensors.shape[0]):
        for i in range(6):
            if not ranging[s]:
                lx_out[s, i] = 0.0
                for j in range(6):
                    lP_out[s, i, j] = 0.0
        if ranging[s]:
            line_into(z[s], line)
            debias(line, truth, sensors[s], mode != _TRUTH, std[s], u[s], R)
            start_track(lx[s], lP[s], line, R, second, T, q, V, lx_out[s], lP_out[s])
            if first:
                for i in range(3):
                    p[i] = line[i]
            first = False
    if first:
        cross_directions(z, sensors, std, rho, p, total, g, cov, H, v[3], v[4])
    else:
        _fuse_positions(p, truth, mode != _TRUTH, z, sensors, std, u, ranging, total, g, cov, R, info, H, line)
        if mode in (_FUSED, _ITERATED):
            for i in range(3):
                at[i] = p[i]
            _fuse_positions(p, at, False, z, sensors, std, u, ranging, total, g, cov, R, info, H, line)
    start_track(x, P, p, cov, second, T, q, V, x_out, P_out)


@helper
def update_scan(x, P, lx, lP, z, sensors, std, u, ranging, truth, mode, x_out, P_out, lx_out, lP_out, W, v):
    """One scan on predicted tracks; returns the squared residuals' sum, its explained part, and log √det S."""
    at, g, line, own = v[0], v[1], v[2], v[3]
    total, R, info, H, own_total = W[0], W[1], W[2], W[3], W[4]
    L, A, M, B, E = W[5], W[6], W[7], W[8], W[9]
    squared = gain = log_det = spread = 0.0
    for i in range(3):
        at[i] = x[i]
    for _ in range(2 if mode == _ITERATED else 1):
        clear_information(total, g, 0.0)
        squared = log_det = 0.0
        for s in range(sensors.shape[0]):
            if ranging[s]:
                line_into(z[s], line)
                # a branch per mode: the places are arrays of different layouts
                if mode == _LOCAL:
                    debias(line, lx[s], sensors[s], False, std[s], u[s], R)
                elif mode == _TRUTH:
                    debias(line, truth, sensors[s], False, std[s], u[s], R)
                else:
                    debias(line, at, sensors[s], mode == _MEASUREMENT, std[s], u[s], R)
                log_det += 0.5 * math.log(invert_3(R, info))
                squared += add_position(line, info, x, total, g)
                if mode == _LOCAL:
                    clear_information(own_total, own, 0.0)
                    add_position(line, info, lx[s], own_total, own)
                    absorb_information(lx[s], lP[s], own_total, own, lx_out[s], lP_out[s], L, A, M, B, E)
            else:
                squared += add_direction(z[s], sensors[s], std[s], at, x, H, total, g)
                log_det += math.log(std[s, 1] * std[s, 2])
        gain, spread = absorb_information(x, P, total, g, x_out, P_out, L, A, M, B, E)
        for i in range(3):
            at[i] = x_out[i]
    return squared, gain, log_det + spread


@helper
def innovate(x, z, sensor, ranging, known, H, nu):
    """Measured less predicted range [m], azimuth and elevation [rad] into nu [3]; 0 unless x is known."""
    azimuth, elevation = linearize_direction(x, sensor, H)
    nu[0] = nu[1] = nu[2] = 0.0
    if ranging and known:
        dx, dy, dz = x[0] - sensor[0], x[1] - sensor[1], x[2] - sensor[2]
        nu[0] = z[0] - math.sqrt(dx * dx + dy * dy + dz * dz)
    if known:
        nu[1], nu[2] = wrap_scalar(z[1] - azimuth), z[2] - elevation


@helper
def _copy_tracks(lx, lP, lx_out, lP_out):
    for s in range(lx.shape[0]):
        for i in range(6):
            lx_out[s, i] = lx[s, i]
            for j in range(6):
                lP_out[s, i, j] = lP[s, i, j]


@helper
def add_promised(at, sensor, std, u, ranging, W, v, total, g):
    """Add to `total` [3, 3] the information that a measurement of a target at `at` promises.

    W [5, 3, 3] and v [3, 3] are scratch of which v[2] is 0: what is measured does not matter.
    """
    info = W[2]
    if ranging:
        information_at(at[0] - sensor[0], at[1] - sensor[1], at[2] - sensor[2], std[0], u[0], u[1], info)
        for i in range(3):
            for j in range(3):
                total[i, j] += info[i, j]
    else:
        add_direction(v[2], sensor, std, at, at, W[4], total, g)


# -- whole episodes ---------------------------------------------------------------------------------------------------


@kernel(
    "(k,x6),(k,n,p3),(n,p3),(n),(k,n,p3),(),(),(),(),()->(k,x6),(k,x6,x6),(k),(n)",
    "FfFBFiffffFFFF",
)
def track_episode(path, sensors, std, ranging, noise, mode, T, q, rho, V, mean, cov, error, nearest):
    """Simulate the measurements of one episode and track the target; says the closest approach to each sensor too."""
    k, n = noise.shape[0], noise.shape[1]
    x, P, lx, lP = np.zeros(6), np.zeros((6, 6)), np.zeros((n, 6)), np.zeros((n, 6, 6))
    W, v, u, z = np.empty((10, 3, 3)), np.empty((5, 3)), np.empty((n, 2)), np.empty((n, 3))
    fill_shrinkages(std, u)
    two_point = any_ranging(ranging)
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
            start_scan(x, P, lx, lP, t == 1, z, sensors[t], std, u, ranging, path[t], mode, T, q, rho, V,
                   mean[t], cov[t], lx, lP, W, v)  # fmt: skip
        else:
            predict_6_in_place(x, P, T, q)
            if mode == _LOCAL:
                for s in range(n):
                    if ranging[s]:
                        predict_6_in_place(lx[s], lP[s], T, q)
            update_scan(x, P, lx, lP, z, sensors[t], std, u, ranging, path[t], mode, mean[t], cov[t], lx, lP, W, v)
        for i in range(6):
            x[i] = mean[t, i]
            for j in range(6):
                P[i, j] = cov[t, i, j]
        error[t] = math.sqrt((x[0] - path[t, 0]) ** 2 + (x[1] - path[t, 1]) ** 2 + (x[2] - path[t, 2]) ** 2)


@kernel("(k,x6),(k,n,p3),(n,p3),(n),(),(),(),()->(k),(x6,x6),(n)", "FfFBffffFFF")
def predict_errors(path, sensors, std, ranging, T, q, rho, V, position_std, P_out, nearest):
    """The covariance recursion along a path, all information evaluated on it."""
    k, n = sensors.shape[0], sensors.shape[1]
    x, P, W, v, u = np.zeros(6), np.zeros((6, 6)), np.empty((10, 3, 3)), np.zeros((3, 3)), np.empty((n, 2))
    total, cov, g, line = W[0], W[3], v[0], v[1]
    fill_shrinkages(std, u)
    two_point = any_ranging(ranging)
    for s in range(n):
        nearest[s] = math.inf
    for t in range(k):
        clear_information(total, g, 1.0 / (rho * rho) if t == 0 and not two_point else 0.0)
        for s in range(n):
            dx, dy, dz = path[t, 0] - sensors[t, s, 0], path[t, 1] - sensors[t, s, 1], path[t, 2] - sensors[t, s, 2]
            nearest[s] = min(nearest[s], math.sqrt(dx * dx + dy * dy + dz * dz))
            add_promised(path[t], sensors[t, s], std[s], u[s], ranging[s], W, v, total, g)
        for i in range(3):
            g[i] = 0.0
        if t == 0 or (t == 1 and two_point):
            invert_3(total, cov)
            start_track(x, P, line, cov, t == 1, T, q, V, x, P_out)
        else:
            predict_6_in_place(x, P, T, q)
            absorb_information(x, P, total, g, x, P_out, W[5], W[6], W[7], W[8], W[9])
        for i in range(6):
            for j in range(6):
                P[i, j] = P_out[i, j]
        position_std[t] = math.sqrt(P[0, 0] + P[1, 1] + P[2, 2])


# -- scan by scan -----------------------------------------------------------------------------------------------------


@kernel("(x6),(x6,x6),(n,x6),(n,x6,x6),(),(n),(),(),()->(x6),(x6,x6),(n,x6),(n,x6,x6)", "FFFFiBiffFFFF")
def predict_tracks(x, P, lx, lP, scans, ranging, mode, T, q, x_out, P_out, lx_out, lP_out):
    """One step of all tracks; those that ranges start stay until their second scan: no velocity yet."""
    for i in range(6):
        x_out[i] = x[i]
        for j in range(6):
            P_out[i, j] = P[i, j]
    _copy_tracks(lx, lP, lx_out, lP_out)
    if scans > 1 or not any_ranging(ranging):
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
def condition_tracks(
    x, P, lx, lP, scans, z, sensors, std, ranging, mode, T, q, rho, V,
    x_out, P_out, lx_out, lP_out, nu, nis, log_likelihood,
):  # fmt: skip
    """One scan on all tracks, the start included."""
    n = ranging.shape[0]
    W, v, u, H = np.empty((10, 3, 3)), np.empty((5, 3)), np.empty((n, 2)), np.empty((2, 3))
    fill_shrinkages(std, u)
    nis[0] = log_likelihood[0] = 0.0
    degrees = 0
    for s in range(n):
        innovate(x, z[s], sensors[s], ranging[s], scans > 0, H, nu[s])
        degrees += 3 if ranging[s] else 2
    if scans == 0 or (scans == 1 and any_ranging(ranging)):
        start_scan(x, P, lx, lP, scans == 1, z, sensors, std, u, ranging, x, mode, T, q, rho, V,
               x_out, P_out, lx_out, lP_out, W, v)  # fmt: skip
    else:
        _copy_tracks(lx, lP, lx_out, lP_out)
        squared, gain, log_root = update_scan(
            x, P, lx, lP, z, sensors, std, u, ranging, x, mode, x_out, P_out, lx_out, lP_out, W, v
        )
        nis[0] = squared - gain
        log_likelihood[0] = -0.5 * (nis[0] + degrees * LOG_TWO_PI) - log_root
