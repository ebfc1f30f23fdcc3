"""The predicted cost of plans of platforms in space that measure azimuth and elevation (see `agents.prediction`).

Platforms keep their altitude: the specification finds that climbs of ±30 m/s add less than 2 %.

    P⁻ = Φ P Φᵀ + Q,   M = Σ_s p_s H_sᵀ R_s⁻¹ H_s,   W = (M⁻¹ + A)⁻¹ = (I + M A)⁻¹ M,   P = P⁻ − P⁻ Eᵀ W E P⁻

with A the position block of P⁻ and E = [I 0]: one scan of all platforms, whose information M concerns the position
only, costs one inverse of a 3×3 matrix. p_s is the share of scans in which sensor s is expected to see the target.

Eight plans are computed side by side, each number of theirs in eight neighbouring places, so that compilers use the
processor's vector instructions.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from agents.prediction import CRITERIA, LARGEST, WORST, Prediction, Situation
from passive_env.belief import Belief
from passive_env.core import World
from passive_env.kinematics import fly_legs
from trackers.compiled import helper, kernel
from trackers.linalg import cholesky_in_place

CRITERIA_3D = (*CRITERIA, "mean_log_position_std", "position_std")
"""What a plan minimises: as in the plane, the range being platform 0's, and the same of the position: log standard
deviation √(trace) averaged over time and summed over tracks; its sum over tracks at the end, then the logarithm."""

PRIOR_SCANS = 2.0
"""The limits' middle counts like this many scans in the running estimate of a sensor's availability."""

LOGARITHM_EVERY = 8
"""Steps whose variances are multiplied before a logarithm is taken of the product."""


ROWS = 30
"""Rows of the working array w [30, 8], a column per lane. A covariance [[A, B], [Bᵀ, C]] of position and velocity has
the six numbers of A row by row from row 0, the nine of B from row 6, the six of C from row 15; those of the scan's
information M follow from row 21, sum and product of `_follow` in rows 27 and 28, the penalty in row 29."""


@helper
def _put(w, row, lane, x, y, z):
    """Write three numbers of one lane below each other."""
    w[row, lane], w[row + 1, lane], w[row + 2, lane] = x, y, z


@helper
def _start(P, w):
    """All lanes begin with the covariance P [6, 6]."""
    for lane in range(8):
        for row, block in ((0, P[:3, :3]), (15, P[3:, 3:])):
            _put(w, row, lane, block[0, 0], block[0, 1], block[0, 2])
            _put(w, row + 3, lane, block[1, 1], block[1, 2], block[2, 2])
        for r in range(3):
            _put(w, 6 + 3 * r, lane, P[r, 3], P[r, 4], P[r, 5])


@helper
def _look(flight, altitude, target, azimuth_weight, elevation_weight, w):
    """Add one platform's information about the target to the lanes' M; flight [2, 8]."""
    for lane in range(8):
        dx, dy, dz = target[0] - flight[0, lane], target[1] - flight[1, lane], target[2] - altitude
        rho2 = max(dx * dx + dy * dy, 1.0)
        per_rho2, per_r2 = 1.0 / rho2, 1.0 / (rho2 + dz * dz)
        a = azimuth_weight * per_rho2 * per_rho2
        e = elevation_weight * per_r2 * per_r2
        b = e * dz * dz * per_rho2
        w[21, lane] += a * dy * dy + b * dx * dx
        w[22, lane] += (b - a) * dx * dy
        w[23, lane] -= e * dx * dz
        w[24, lane] += a * dx * dx + b * dy * dy
        w[25, lane] -= e * dy * dz
        w[26, lane] += e * rho2


@helper
def _three(w, row, lane):
    """Three numbers of one lane below each other."""
    return w[row, lane], w[row + 1, lane], w[row + 2, lane]


@helper
def _symmetric(w, row, lane):
    """Six numbers of a symmetric 3×3 matrix of one lane, row by row."""
    return _three(w, row, lane) + _three(w, row + 3, lane)


@helper
def _predict(A, B, C, T, q2):
    """Blocks of Φ P Φᵀ + Q for P = [[A, B], [Bᵀ, C]]; A and C of six numbers, B of nine."""
    a00, a01, a02, a11, a12, a22 = A
    b00, b01, b02, b10, b11, b12, b20, b21, b22 = B
    c00, c01, c02, c11, c12, c22 = C
    quarter, half, whole = 0.25 * T * T * T * T * q2, 0.5 * T * T * T * q2, T * T * q2
    A = (
        a00 + T * (2.0 * b00 + T * c00) + quarter, a01 + T * (b01 + b10 + T * c01), a02 + T * (b02 + b20 + T * c02),
        a11 + T * (2.0 * b11 + T * c11) + quarter, a12 + T * (b12 + b21 + T * c12),
        a22 + T * (2.0 * b22 + T * c22) + quarter,
    )  # fmt: skip
    B = (
        b00 + T * c00 + half, b01 + T * c01, b02 + T * c02,
        b10 + T * c01, b11 + T * c11 + half, b12 + T * c12,
        b20 + T * c02, b21 + T * c12, b22 + T * c22 + half,
    )  # fmt: skip
    return A, B, (c00 + whole, c01, c02, c11 + whole, c12, c22 + whole)


@helper
def _rows(A):
    """Rows (or columns) of a symmetric 3×3 matrix of six numbers."""
    a00, a01, a02, a11, a12, a22 = A
    return (a00, a01, a02), (a01, a11, a12), (a02, a12, a22)


@helper
def _dot(u, v):
    return u[0] * v[0] + u[1] * v[1] + u[2] * v[2]


@helper
def _times(u, rows):
    """A row of three numbers times a symmetric matrix."""
    return _dot(u, rows[0]), _dot(u, rows[1]), _dot(u, rows[2])


@helper
def _scan_weight(a, m):
    """Rows of W = (I + M A)⁻¹ M from rows of the symmetric A and M."""
    g00, g01, g02 = 1.0 + _dot(m[0], a[0]), _dot(m[0], a[1]), _dot(m[0], a[2])
    g10, g11, g12 = _dot(m[1], a[0]), 1.0 + _dot(m[1], a[1]), _dot(m[1], a[2])
    g20, g21, g22 = _dot(m[2], a[0]), _dot(m[2], a[1]), 1.0 + _dot(m[2], a[2])
    k0 = g11 * g22 - g12 * g21, g02 * g21 - g01 * g22, g01 * g12 - g02 * g11
    k1 = g12 * g20 - g10 * g22, g00 * g22 - g02 * g20, g02 * g10 - g00 * g12
    k2 = g10 * g21 - g11 * g20, g01 * g20 - g00 * g21, g00 * g11 - g01 * g10
    d = 1.0 / _dot((g00, g01, g02), (k0[0], k1[0], k2[0]))
    return _rows((
        d * _dot(k0, m[0]), d * _dot(k0, m[1]), d * _dot(k0, m[2]),
        d * _dot(k1, m[1]), d * _dot(k1, m[2]), d * _dot(k2, m[2]),
    ))  # fmt: skip


@helper
def _step(w, T, q2):
    """Prediction and scan of all lanes: A − A W A, B − A W B, C − Bᵀ W B."""
    for lane in range(8):
        B = _three(w, 6, lane) + _three(w, 9, lane) + _three(w, 12, lane)
        A, B, C = _predict(_symmetric(w, 0, lane), B, _symmetric(w, 15, lane), T, q2)
        b00, b01, b02, b10, b11, b12, b20, b21, b22 = B
        (a0, a1, a2), b0, b1, b2 = _rows(A), (b00, b10, b20), (b01, b11, b21), (b02, b12, b22)
        W = _scan_weight((a0, a1, a2), _rows(_symmetric(w, 21, lane)))
        u0, u1, u2 = _times(a0, W), _times(a1, W), _times(a2, W)
        v0, v1, v2 = _times(b0, W), _times(b1, W), _times(b2, W)
        _put(w, 0, lane, A[0] - _dot(u0, a0), A[1] - _dot(u0, a1), A[2] - _dot(u0, a2))
        _put(w, 3, lane, A[3] - _dot(u1, a1), A[4] - _dot(u1, a2), A[5] - _dot(u2, a2))
        _put(w, 6, lane, b00 - _dot(u0, b0), b01 - _dot(u0, b1), b02 - _dot(u0, b2))
        _put(w, 9, lane, b10 - _dot(u1, b0), b11 - _dot(u1, b1), b12 - _dot(u1, b2))
        _put(w, 12, lane, b20 - _dot(u2, b0), b21 - _dot(u2, b1), b22 - _dot(u2, b2))
        _put(w, 15, lane, C[0] - _dot(v0, b0), C[1] - _dot(v0, b1), C[2] - _dot(v0, b2))
        _put(w, 18, lane, C[3] - _dot(v1, b1), C[4] - _dot(v1, b2), C[5] - _dot(v2, b2))


@helper
def _range_variances(flight, altitude, target, w, lane):
    """uᵀ A u of one lane along the line of sight from the reference platform."""
    dx, dy, dz = target[0] - flight[0, lane], target[1] - flight[1, lane], target[2] - altitude
    quadratic = w[0, lane] * dx * dx + w[3, lane] * dy * dy + w[5, lane] * dz * dz
    quadratic += 2.0 * (w[1, lane] * dx * dy + w[2, lane] * dx * dz + w[4, lane] * dy * dz)
    return quadratic / max(dx * dx + dy * dy + dz * dz, 1.0)


@helper
def _keep_away(flight, altitude, target, radius, cost, w):
    """Add a platform's intrusions into a sphere about the target to the lanes' penalties."""
    for lane in range(8):
        dx, dy, dz = target[0] - flight[0, lane], target[1] - flight[1, lane], target[2] - altitude
        w[29, lane] += cost * max(1.0 - math.sqrt(dx * dx + dy * dy + dz * dz) / radius, 0.0)


@helper
def _half_log_det(w, lane, full):
    """Half the log-determinant of one lane's covariance; full [6, 6] is scratch."""
    i = 0
    for r in range(3):
        for c in range(r, 3):
            full[r, c] = full[c, r] = w[i, lane]
            full[r + 3, c + 3] = full[c + 3, r + 3] = w[15 + i, lane]
            i += 1
        for c in range(3):
            full[r, c + 3] = full[c + 3, r] = w[6 + 3 * r + c, lane]
    cholesky_in_place(full)
    total = 0.0
    for r in range(6):
        total += math.log(full[r, r])
    return total


@helper
def _figure(w, flight, altitude, target, criterion, lane, full):
    """One track's part of a criterion of the plan's end."""
    if criterion == 3:
        return _half_log_det(w, lane, full)
    if criterion < 2:
        variance = max(_range_variances(flight, altitude, target, w, lane), 0.0)
        return variance if criterion == 1 else math.sqrt(variance)
    trace = w[0, lane] + w[3, lane] + w[5, lane]
    return trace if criterion == 2 else math.sqrt(max(trace, 0.0))


@helper
def _fly_lanes(platforms, controls, ends, first, steps, model, flights):
    """Fill flights [k, s, 2, 8] with those of plans `first` … `first` + 7; the last plan fills what is left.

    A platform whose plan is the same as in the lane before is not flown again: most searches vary one at a time.
    """
    level = np.empty(4)
    for lane in range(8):
        c = min(first + lane, controls.shape[0] - 1)
        before = max(c - 1, 0)
        for s in range(platforms.shape[0]):
            same = c > 0
            for g in range(ends.shape[1]):
                same = same and controls[c, g, s] == controls[before, g, s] and ends[c, g] == ends[before, g]
            if same or (lane > 0 and first + lane > c):
                for k in range(steps):
                    flights[k, s, 0, lane] = flights[k, s, 0, lane - 1]
                    flights[k, s, 1, lane] = flights[k, s, 1, lane - 1]
                continue
            level[0], level[1], level[2], level[3] = platforms[s, 0], platforms[s, 1], platforms[s, 3], platforms[s, 4]
            fly_legs(
                level, controls[c, :, s], ends[c], steps, model[0], model[1], model[6] > 0.0, flights[:, s, :, lane]
            )


@helper
def _follow(cov, path, platforms, share, steps, model, flights, w):
    """Covariances of one track in all lanes along a path [k, 3]; rows 27 and 28 take the mean log of the variance."""
    criterion = int(model[5])
    _start(cov, w)
    for lane in range(8):
        w[27, lane], w[28, lane] = 0.0, 1.0
    for k in range(steps):
        for i in range(21, 27):
            for lane in range(8):
                w[i, lane] = 0.0
        for s in range(platforms.shape[0]):
            _look(flights[k, s], platforms[s, 2], path[k], share[s] * model[3], share[s] * model[4], w)
            for i in range(2):
                if model[7 + 2 * i] > 0.0:
                    _keep_away(
                        flights[k, s], platforms[s, 2], path[k], model[7 + 2 * i], model[0] * model[8 + 2 * i], w
                    )
        _step(w, model[0], model[2])
        if criterion == 4:
            for lane in range(8):
                variance = _range_variances(flights[k, 0], platforms[0, 2], path[k], w, lane)
                w[28, lane] *= min(max(variance, 1.0), LARGEST)
        elif criterion == 5:
            for lane in range(8):
                w[28, lane] *= min(max(w[0, lane] + w[3, lane] + w[5, lane], 1.0), LARGEST)
        if criterion >= 4 and (k % LOGARITHM_EVERY == LOGARITHM_EVERY - 1 or k == steps - 1):
            for lane in range(8):
                w[27, lane] += 0.5 * math.log(w[28, lane]) / steps
                w[28, lane] = 1.0


@kernel("(s,x6),(k,m,p3),(m,x6,x6),(d,r),(),(s),(c,g,s),(c,g),(l),(t,s,p,b)->(c)", "FFFFiFFiFFF")
def _plan_costs_3d(platforms, paths, cov, discs, steps, share, controls, ends, model, flights, cost):
    """Costs of c plans, eight at a time. `flights` [k, s, 2, 8] is scratch, shared by all items of a call."""
    criterion = int(model[5])
    w, full, figures = np.empty((ROWS, 8)), np.empty((6, 6)), np.empty(8)
    for first in range(0, cost.shape[0], 8):
        _fly_lanes(platforms, controls, ends, first, steps, model, flights)
        for lane in range(8):
            w[29, lane] = figures[lane] = 0.0
        for m in range(cov.shape[0]):
            _follow(cov[m], paths[:, m], platforms, share, steps, model, flights, w)
            for lane in range(8):
                if criterion == 4 or criterion == 5:
                    figures[lane] += w[27, lane]
                else:
                    figures[lane] += _figure(
                        w, flights[steps - 1, 0], platforms[0, 2], paths[steps - 1, m], criterion, lane, full
                    )
        for lane in range(min(8, cost.shape[0] - first)):
            final = criterion < 3 or criterion == 6
            total = w[29, lane] + (math.log(max(figures[lane], 1.0)) if final else figures[lane])
            cost[first + lane] = total if abs(total) < WORST else WORST


class Prediction3D(Prediction):
    """Costs of plans of platforms in space.

    Args:
        scenario: supplies step, turn limit, noises, detection probability, limits of availability, stand-off distance.
        criterion: one of `CRITERIA_3D`.
        guard_m, controls: as of `agents.prediction.Prediction`.
    Raises:
        ValueError: as of `agents.prediction.Prediction`.
    """

    criteria = CRITERIA_3D
    usual_criterion, usual_guard_m, usual_horizon, usual_headings = "mean_log_position_std", 0.0, 8, 14
    about_course = True

    def __init__(
        self, scenario: Any, criterion: str | None = None, guard_m: float | None = None, controls: str = "headings"
    ):
        super().__init__(scenario, criterion, guard_m, controls)
        platforms = range(scenario.stations)
        self._least, self._most = (
            np.array([getattr(scenario, f"availability{p}_{end}") for p in platforms]) for end in ("min", "max")
        )
        self._detection = float(scenario.detection_probability)
        self._steps_left = np.empty(0, dtype=np.int64)
        self._scans = self._looks = np.empty(0)

    def situation(self, belief: Belief, horizon: int) -> Situation:
        """What the belief says, with a running estimate of each sensor's availability since the episode began.

        The estimate counts the scans in which a sensor was available, and the middle of the scenario's limits as
        `PRIOR_SCANS` more; it stays within the limits.
        """
        self._count(belief)
        middle = 0.5 * (self._least + self._most)
        share = (self._looks + PRIOR_SCANS * middle) / (self._scans[:, None] + PRIOR_SCANS)
        share = self._detection * np.clip(share, self._least, self._most)
        return super().situation(belief, horizon)._replace(share=share)

    def revealed(self, start: Situation, world: World) -> Situation:
        """The situation with true paths, bound and availability."""
        return super().revealed(start, world)._replace(share=self._detection * world.tape.share)

    def _count(self, belief: Belief) -> None:
        """Count one more scan of the episodes that go on; those that have begun know of none but the acquisition."""
        left = np.array(belief.steps_left)
        if len(left) != len(self._steps_left):
            self._steps_left, self._scans = np.full(len(left), -1), np.zeros(len(left))
            self._looks = np.zeros((len(left), len(self._least)))
        went_on, same = left == self._steps_left - 1, left == self._steps_left
        seen = np.asarray(belief.available).mean(axis=-1)
        self._scans = np.where(went_on, self._scans + 1.0, np.where(same, self._scans, 0.0))
        self._looks = np.where(went_on[:, None], self._looks + seen, np.where(same[:, None], self._looks, 0.0))
        self._steps_left = left

    def _numbers(self, scenario: Any) -> tuple[float, ...]:
        weights = (1.0 / math.radians(std) ** 2 for std in (scenario.azimuth_std_deg, scenario.elevation_std_deg))
        return (self.step_s, self.turn_per_step, float(scenario.process_noise_m_s2) ** 2, *weights)

    def _costs(self, start: Situation, controls: np.ndarray, ends: np.ndarray) -> np.ndarray:
        flights = np.empty((start.paths.shape[1], start.platforms.shape[1], 2, 8))
        return _plan_costs_3d(*start, controls, ends, np.array(self._settings), flights)
