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


@helper
def _start(P, w):
    """All lanes begin with the covariance P [6, 6]."""
    for lane in range(8):
        w[0, lane], w[1, lane], w[2, lane] = P[0, 0], P[0, 1], P[0, 2]
        w[3, lane], w[4, lane], w[5, lane] = P[1, 1], P[1, 2], P[2, 2]
        w[6, lane], w[7, lane], w[8, lane] = P[0, 3], P[0, 4], P[0, 5]
        w[9, lane], w[10, lane], w[11, lane] = P[1, 3], P[1, 4], P[1, 5]
        w[12, lane], w[13, lane], w[14, lane] = P[2, 3], P[2, 4], P[2, 5]
        w[15, lane], w[16, lane], w[17, lane] = P[3, 3], P[3, 4], P[3, 5]
        w[18, lane], w[19, lane], w[20, lane] = P[4, 4], P[4, 5], P[5, 5]


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
def _step(w, T, q2):
    """Prediction and scan of all lanes."""
    half, quarter = 0.5 * T * T * T * q2, 0.25 * T * T * T * T * q2
    for lane in range(8):
        c00, c01, c02, c11, c12, c22 = w[15, lane], w[16, lane], w[17, lane], w[18, lane], w[19, lane], w[20, lane]
        b00, b01, b02 = w[6, lane], w[7, lane], w[8, lane]
        b10, b11, b12 = w[9, lane], w[10, lane], w[11, lane]
        b20, b21, b22 = w[12, lane], w[13, lane], w[14, lane]
        a00 = w[0, lane] + T * (2.0 * b00 + T * c00) + quarter
        a01 = w[1, lane] + T * (b01 + b10 + T * c01)
        a02 = w[2, lane] + T * (b02 + b20 + T * c02)
        a11 = w[3, lane] + T * (2.0 * b11 + T * c11) + quarter
        a12 = w[4, lane] + T * (b12 + b21 + T * c12)
        a22 = w[5, lane] + T * (2.0 * b22 + T * c22) + quarter
        b00, b01, b02 = b00 + T * c00 + half, b01 + T * c01, b02 + T * c02
        b10, b11, b12 = b10 + T * c01, b11 + T * c11 + half, b12 + T * c12
        b20, b21, b22 = b20 + T * c02, b21 + T * c12, b22 + T * c22 + half
        c00, c11, c22 = c00 + T * T * q2, c11 + T * T * q2, c22 + T * T * q2
        m00, m01, m02, m11, m12, m22 = w[21, lane], w[22, lane], w[23, lane], w[24, lane], w[25, lane], w[26, lane]
        # G = I + M A
        g00 = 1.0 + m00 * a00 + m01 * a01 + m02 * a02
        g01 = m00 * a01 + m01 * a11 + m02 * a12
        g02 = m00 * a02 + m01 * a12 + m02 * a22
        g10 = m01 * a00 + m11 * a01 + m12 * a02
        g11 = 1.0 + m01 * a01 + m11 * a11 + m12 * a12
        g12 = m01 * a02 + m11 * a12 + m12 * a22
        g20 = m02 * a00 + m12 * a01 + m22 * a02
        g21 = m02 * a01 + m12 * a11 + m22 * a12
        g22 = 1.0 + m02 * a02 + m12 * a12 + m22 * a22
        k00, k01, k02 = g11 * g22 - g12 * g21, g02 * g21 - g01 * g22, g01 * g12 - g02 * g11
        k10, k11, k12 = g12 * g20 - g10 * g22, g00 * g22 - g02 * g20, g02 * g10 - g00 * g12
        k20, k21, k22 = g10 * g21 - g11 * g20, g01 * g20 - g00 * g21, g00 * g11 - g01 * g10
        d = 1.0 / (g00 * k00 + g01 * k10 + g02 * k20)
        # W = G⁻¹ M
        w00 = d * (k00 * m00 + k01 * m01 + k02 * m02)
        w01 = d * (k00 * m01 + k01 * m11 + k02 * m12)
        w02 = d * (k00 * m02 + k01 * m12 + k02 * m22)
        w11 = d * (k10 * m01 + k11 * m11 + k12 * m12)
        w12 = d * (k10 * m02 + k11 * m12 + k12 * m22)
        w22 = d * (k20 * m02 + k21 * m12 + k22 * m22)
        # A W and Bᵀ W
        u00, u01, u02 = (
            a00 * w00 + a01 * w01 + a02 * w02, a00 * w01 + a01 * w11 + a02 * w12, a00 * w02 + a01 * w12 + a02 * w22,
        )  # fmt: skip
        u10, u11, u12 = (
            a01 * w00 + a11 * w01 + a12 * w02, a01 * w01 + a11 * w11 + a12 * w12, a01 * w02 + a11 * w12 + a12 * w22,
        )  # fmt: skip
        u20, u21, u22 = (
            a02 * w00 + a12 * w01 + a22 * w02, a02 * w01 + a12 * w11 + a22 * w12, a02 * w02 + a12 * w12 + a22 * w22,
        )  # fmt: skip
        v00, v01, v02 = (
            b00 * w00 + b10 * w01 + b20 * w02, b00 * w01 + b10 * w11 + b20 * w12, b00 * w02 + b10 * w12 + b20 * w22,
        )  # fmt: skip
        v10, v11, v12 = (
            b01 * w00 + b11 * w01 + b21 * w02, b01 * w01 + b11 * w11 + b21 * w12, b01 * w02 + b11 * w12 + b21 * w22,
        )  # fmt: skip
        v20, v21, v22 = (
            b02 * w00 + b12 * w01 + b22 * w02, b02 * w01 + b12 * w11 + b22 * w12, b02 * w02 + b12 * w12 + b22 * w22,
        )  # fmt: skip
        w[15, lane] = c00 - v00 * b00 - v01 * b10 - v02 * b20
        w[16, lane] = c01 - v00 * b01 - v01 * b11 - v02 * b21
        w[17, lane] = c02 - v00 * b02 - v01 * b12 - v02 * b22
        w[18, lane] = c11 - v10 * b01 - v11 * b11 - v12 * b21
        w[19, lane] = c12 - v10 * b02 - v11 * b12 - v12 * b22
        w[20, lane] = c22 - v20 * b02 - v21 * b12 - v22 * b22
        w[6, lane] = b00 - u00 * b00 - u01 * b10 - u02 * b20
        w[7, lane] = b01 - u00 * b01 - u01 * b11 - u02 * b21
        w[8, lane] = b02 - u00 * b02 - u01 * b12 - u02 * b22
        w[9, lane] = b10 - u10 * b00 - u11 * b10 - u12 * b20
        w[10, lane] = b11 - u10 * b01 - u11 * b11 - u12 * b21
        w[11, lane] = b12 - u10 * b02 - u11 * b12 - u12 * b22
        w[12, lane] = b20 - u20 * b00 - u21 * b10 - u22 * b20
        w[13, lane] = b21 - u20 * b01 - u21 * b11 - u22 * b21
        w[14, lane] = b22 - u20 * b02 - u21 * b12 - u22 * b22
        w[0, lane] = a00 - u00 * a00 - u01 * a01 - u02 * a02
        w[1, lane] = a01 - u00 * a01 - u01 * a11 - u02 * a12
        w[2, lane] = a02 - u00 * a02 - u01 * a12 - u02 * a22
        w[3, lane] = a11 - u10 * a01 - u11 * a11 - u12 * a12
        w[4, lane] = a12 - u10 * a02 - u11 * a12 - u12 * a22
        w[5, lane] = a22 - u20 * a02 - u21 * a12 - u22 * a22


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
    w, full, figures = np.empty((30, 8)), np.empty((6, 6)), np.empty(8)
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
