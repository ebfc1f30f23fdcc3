"""Probabilistic data association of one target seen from two platforms among false returns: all pairs of returns.

Sensor gates νᵀS_ss⁻¹ν ≤ γ₂ leave m₁ and m₂ returns. Hypothesis (i, j), 0 for "this sensor did not supply the target":

    w_00 = q₁ q₂                                   q_s = 1 − P_D P_G
    w_i0 = (P_D/λ₁) N₂(ν¹_i; 0, S₁₁) q₂            w_0j alike
    w_ij = (P_D²/(λ₁λ₂)) N₄(ν_ij; 0, S)            where ν_ijᵀS⁻¹ν_ij ≤ γ₄        β = w / Σw, from logarithms

with false returns Poisson of density λ, known or estimated by m/V. Four gains serve all pairs:

    X̂ = X̂⁻ + Σ β Δ,   P = Σ β P_h + Σ β (Δ − Δ̄)(Δ − Δ̄)ᵀ,   P_h = P⁻ − K_h S_h K_hᵀ

Innovations are whitened once: with sensor 2 after sensor 1, ν_ijᵀS⁻¹ν_ij = |y_i|² + |u_j − t_i|², so a pair costs two
differences, two squares and an exponential.
Source: Wang, Wang and Yang (2004), section 4. Deviations, all needed for weights that are probabilities: per-sensor
factors V⁻ᵐ and priors for eqs 21–23, whose pairs share one dimension, one count and one prior; no count of pairs
(eq 24); 2-D innovations of (i, 0) and (0, j) are not padded. q₁q₂ is the product form of a joint miss; the exact one
differs by the correlation of two near-certain gates.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from trackers.angle_contract import AngleScan, AngleUpdate
from trackers.angle_filter import AngleFilter
from trackers.angles import wrap_scalar
from trackers.association import NEGLIGIBLE
from trackers.compiled import helper, kernel
from trackers.direction import absorb, along, innovation_cov, linearize_direction
from trackers.gaussian import Gaussian
from trackers.linalg import LOG_TWO_PI
from trackers.outliers import CONDITIONED, COPLANARITY, NO_TEST, TESTS, coplanarity

MAX_RETURNS = 64
"""Returns of one sensor that are weighed; of more in its gate the nearest are kept and the rest counted."""

SURE = 1e-12
"""Smallest probability that a sensor missed the target: with P_D = 1 and a wide gate it would be 0."""


LEAST_CLUTTER = 1e-100
"""Expected false returns in a gate, at least: a product of small numbers must not become 0."""


@helper
def sensor_gain(P, H, std, available, columns, roots):
    """Condition P [6, 6] on the available components of one sensor, in place: its gain columns and pivots.

    columns [2, 6] and roots [2] as of `absorb`; a masked component has a zero column and the root 1. Returns the
    regression of the second component on the first.
    """
    for c in range(2):
        roots[c] = 1.0
        columns[c] = 0.0
        if available[c]:
            roots[c] = absorb(P, H[c], std[c] * std[c], columns[c])
    return along(H[1], columns[0])


@helper
def whiten(a, b, roots, cross, available):
    """L⁻¹ν of one sensor's innovation ν = (a, b); 0 for a masked component."""
    first = a / roots[0] if available[0] else 0.0
    return first, ((b - cross * first) / roots[1] if available[1] else 0.0)


@helper
def keep_nearest(angles, valid, h, roots, cross, available, gamma, slots, nu, y, d):
    """Validate a sensor's returns; returns how many lie in the gate.

    Fills the rows of the nearest `MAX_RETURNS`: slots, nu [rad], y (whitened) and d = |y|². A masked component does
    not count.
    """
    inside = 0
    for k in range(valid.shape[0]):
        if not valid[k]:
            continue
        a = wrap_scalar(angles[k, 0] - h[0]) if available[0] else 0.0
        b = wrap_scalar(angles[k, 1] - h[1]) if available[1] else 0.0
        ya, yb = whiten(a, b, roots, cross, available)
        distance = ya * ya + yb * yb
        if distance > gamma:
            continue
        row = inside
        inside += 1
        if row >= slots.shape[0]:
            row = 0
            for r in range(1, slots.shape[0]):
                if d[r] > d[row]:
                    row = r
            if distance >= d[row]:
                continue
        slots[row], d[row] = k, distance
        nu[row, 0], nu[row, 1], y[row, 0], y[row, 1] = a, b, ya, yb
    return inside


@helper
def log_factors(roots, area, available, gamma, density, inside, p_d):
    """Of one sensor: log (P_D/λ) N(0; 0, S) and the log of its miss.

    A sensor with one component left has an interval of length 2√(γS) for its gate instead of the ellipse of this
    area; the expected number of false returns in it is the ellipse's.
    """
    count = int(available[0]) + int(available[1])
    if count == 0:
        return 0.0, 0.0
    volume, captured = area, 1.0 - math.exp(-0.5 * gamma)
    if count == 1:
        volume, captured = 2.0 * math.sqrt(gamma) * roots[0] * roots[1], math.erf(math.sqrt(0.5 * gamma))
    expected = max(density * area, LEAST_CLUTTER) if density > 0.0 else max(inside, 1)
    hit = math.log(p_d * volume / expected) - 0.5 * count * LOG_TWO_PI - math.log(roots[0] * roots[1])
    return hit, math.log(max(1.0 - p_d * captured, SURE))


@helper
def weigh_pairs(d, u, t, hits, misses, fused_gamma, limit, log_w):
    """Log weights [m₁ + 1, m₂ + 1] of all hypotheses; pairs beyond a gate get −inf.

    d [2, m] squared lengths; u [m₂, 2], t [m₁, 2] whitened innovation of sensor 2 and its expectation given sensor 1;
    hits: log factors of sensor 1, sensor 2 and sensor 2 after sensor 1; limit: of |u − t|² alone.
    """
    log_w[0, 0] = misses[0] + misses[1]
    for j in range(1, log_w.shape[1]):
        log_w[0, j] = misses[0] + hits[1] - 0.5 * d[1, j - 1]
    for i in range(1, log_w.shape[0]):
        log_w[i, 0] = misses[1] + hits[0] - 0.5 * d[0, i - 1]
        for j in range(1, log_w.shape[1]):
            a, b = u[j - 1, 0] - t[i - 1, 0], u[j - 1, 1] - t[i - 1, 1]
            given = a * a + b * b
            together = d[0, i - 1] + given
            log_w[i, j] = -math.inf
            if together <= fused_gamma and given <= limit:
                log_w[i, j] = hits[0] + hits[2] - 0.5 * together


@helper
def reject_crossing(angles, std, platforms, slots, limit, log_w):
    """Remove the pairs whose lines of sight pass each other (`outliers.coplanarity`)."""
    for i in range(1, log_w.shape[0]):
        for j in range(1, log_w.shape[1]):
            if log_w[i, j] > -math.inf:
                a, b = angles[0, slots[0, i - 1]], angles[1, slots[1, j - 1]]
                if coplanarity(a, std[0], b, std[1], platforms[0], platforms[1]) > limit:
                    log_w[i, j] = -math.inf


@helper
def only_nearest(d, hits, log_w):
    """Keep the pair of least 4-D distance, else the single return of least distance, else no return."""
    best_i, best_j, least = 0, 0, math.inf
    for i in range(1, log_w.shape[0]):
        for j in range(1, log_w.shape[1]):
            distance = 2.0 * (hits[0] + hits[2] - log_w[i, j])
            if distance < least:
                best_i, best_j, least = i, j, distance
    if best_i == 0:
        for s in range(2):
            for k in range(log_w.shape[s] - 1):
                if d[s, k] < least:
                    least = d[s, k]
                    best_i, best_j = (k + 1, 0) if s == 0 else (0, k + 1)
    kept = log_w[best_i, best_j]
    log_w[:] = -math.inf
    log_w[best_i, best_j] = kept


@helper
def normalise(log_w):
    """Turn log weights [n, k] into weights that sum to 1, in place; returns the log of their sum."""
    top, total = -math.inf, 0.0
    for i in range(log_w.shape[0]):
        for j in range(log_w.shape[1]):
            top = max(top, log_w[i, j])
    for i in range(log_w.shape[0]):
        for j in range(log_w.shape[1]):
            below = log_w[i, j] - top
            log_w[i, j] = math.exp(below) if below > NEGLIGIBLE else 0.0
            total += log_w[i, j]
    for i in range(log_w.shape[0]):
        for j in range(log_w.shape[1]):
            log_w[i, j] /= total
    return top + math.log(total)


@helper
def whitened_moments(w, y, u, t, mean, spread):
    """First and centred second moments of the hypotheses' whitened innovations [6], and the weights of the classes.

    Entries: sensor 1; sensor 2 after sensor 1; sensor 2 alone. The mean of the fourfold class {1, 2} is gathered row
    by row. Returns the weights of {1}, {1, 2} and {2}.
    """
    mean[:] = 0.0
    spread[:] = 0.0
    single, double = 0.0, 0.0
    for i in range(1, w.shape[0]):
        row = v0 = v1 = v00 = v01 = v11 = 0.0
        for j in range(1, w.shape[1]):
            beta = w[i, j]
            if beta > 0.0:
                a, b = u[j - 1, 0] - t[i - 1, 0], u[j - 1, 1] - t[i - 1, 1]
                row += beta
                v0, v1 = v0 + beta * a, v1 + beta * b
                v00, v01, v11 = v00 + beta * a * a, v01 + beta * a * b, v11 + beta * b * b
        single += w[i, 0]
        double += row
        y0, y1, beta = y[0, i - 1, 0], y[0, i - 1, 1], row + w[i, 0]
        mean[0], mean[1] = mean[0] + beta * y0, mean[1] + beta * y1
        mean[2], mean[3] = mean[2] + v0, mean[3] + v1
        spread[0, 0] += beta * y0 * y0
        spread[1, 0] += beta * y0 * y1
        spread[1, 1] += beta * y1 * y1
        spread[2, 0] += v0 * y0
        spread[2, 1] += v0 * y1
        spread[3, 0] += v1 * y0
        spread[3, 1] += v1 * y1
        spread[2, 2] += v00
        spread[3, 2] += v01
        spread[3, 3] += v11
    second = 0.0
    for j in range(1, w.shape[1]):
        a, b, beta = y[1, j - 1, 0], y[1, j - 1, 1], w[0, j]
        second += beta
        mean[4], mean[5] = mean[4] + beta * a, mean[5] + beta * b
        spread[4, 4] += beta * a * a
        spread[5, 4] += beta * a * b
        spread[5, 5] += beta * b * b
    for a in range(6):
        for b in range(a + 1):
            spread[a, b] -= mean[a] * mean[b]
            spread[b, a] = spread[a, b]
    return single, double, second


@helper
def mix(x, P, P_h, weights, columns, mean, spread, x_out, P_out):
    """Mean and covariance of the four-component mixture; columns [6, 6], one gain per whitened innovation."""
    none = max(1.0 - weights[0] - weights[1] - weights[2], 0.0)
    x_out[:] = x
    for c in range(6):
        for r in range(6):
            x_out[r] += columns[c, r] * mean[c]
    row = np.empty(6)
    for r in range(6):
        for b in range(6):
            row[b] = 0.0
            for a in range(6):
                row[b] += columns[a, r] * spread[a, b]
        for k in range(r + 1):
            total = none * P[r, k]
            for h in range(3):
                total += weights[h] * P_h[h, r, k]
            for b in range(6):
                total += row[b] * columns[b, k]
            P_out[r, k] = P_out[k, r] = total


@helper
def report(w, s, kept, slots, nu, nu_out, assignment, missed):
    """One sensor's marginal weights: mean innovation, likeliest slot, weight of a miss."""
    nu_out[:] = 0.0
    assignment[s] = -1
    others = w.shape[1 - s]
    best = 0.0
    for k in range(kept + 1):
        beta = 0.0
        for o in range(others):
            beta += w[k, o] if s == 0 else w[o, k]
        if k == 0:
            missed[s] = beta
        else:
            nu_out[0] += beta * nu[k - 1, 0]
            nu_out[1] += beta * nu[k - 1, 1]
        if beta > best:
            best = beta
            assignment[s] = slots[k - 1] if k > 0 else -1


@helper
def expect_second(H, y, nu, kept, columns, roots, cross, available, u, t):
    """Sensor 2 after sensor 1: whitened innovations u [m₂, 2], and their expectations t [m₁, 2] given sensor 1's y."""
    for j in range(kept[1]):
        u[j, 0], u[j, 1] = whiten(nu[1, j, 0], nu[1, j, 1], roots, cross, available)
    for i in range(kept[0]):
        a = along(H[0], columns[0]) * y[0, i, 0] + along(H[0], columns[1]) * y[0, i, 1]
        b = along(H[1], columns[0]) * y[0, i, 0] + along(H[1], columns[1]) * y[0, i, 1]
        t[i, 0], t[i, 1] = whiten(a, b, roots, cross, available)


@kernel(
    "(x6),(x6,x6),(s,b,a2),(s,b),(s,p3),(s,a2),(s,a2),(s),(s),(),(),(),(),()"
    "->(x6),(x6,x6),(s,a2),(s,a2,a2),(),(s),(s),(s),(s)",
    "FFFBFFBFFffbifFFFFfIIFI",
)
def _average(x, P, angles, valid, platforms, std, available, density, p_d, gamma, fused_gamma, nearest, test, limit,
             x_out, P_out, nu_out, S, evidence, assignment, validated, missed, dropped):  # fmt: skip
    H, columns, roots = np.empty((2, 2, 3)), np.zeros((6, 6)), np.ones((3, 2))
    P_h, cross = np.empty((3, 6, 6)), np.zeros(3)
    slots, nu, y = np.empty((2, MAX_RETURNS), np.int64), np.empty((2, MAX_RETURNS, 2)), np.empty((2, MAX_RETURNS, 2))
    d, kept = np.empty((2, MAX_RETURNS)), np.zeros(2, np.int64)
    hits, misses = np.zeros(3), np.zeros(2)
    for h in range(3):
        P_h[h] = P
    for s in range(platforms.shape[0]):
        own = 2 * s  # the first gain is {1}'s, the second what sensor 2 adds to it, the third {2}'s
        predicted = linearize_direction(x, platforms[s], H[s])
        area = math.pi * gamma * math.sqrt(innovation_cov(P, H[s], std[s], S[s]))
        at = columns[2 * own : 2 * own + 2]
        cross[own] = sensor_gain(P_h[own], H[s], std[s], available[s], at, roots[own])
        inside = 0
        if available[s, 0] or available[s, 1]:
            inside = keep_nearest(
                angles[s], valid[s], predicted, roots[own], cross[own], available[s], gamma, slots[s], nu[s], y[s], d[s]
            )
        kept[s] = min(inside, MAX_RETURNS)
        validated[s], dropped[s] = inside, inside - kept[s]
        hits[s], misses[s] = log_factors(roots[own], area, available[s], gamma, density[s], inside, p_d[s])
    u, t = np.empty((kept[1], 2)), np.empty((kept[0], 2))
    if platforms.shape[0] == 2:
        P_h[1] = P_h[0]
        cross[1] = sensor_gain(P_h[1], H[1], std[1], available[1], columns[2:4], roots[1])
        hits[2] = hits[1] + math.log(roots[2, 0] * roots[2, 1]) - math.log(roots[1, 0] * roots[1, 1])
        expect_second(H[1], y, nu, kept, columns, roots[1], cross[1], available[1], u, t)
    w = np.empty((kept[0] + 1, kept[1] + 1))
    weigh_pairs(d, u, t, hits, misses, fused_gamma, limit if test == CONDITIONED else math.inf, w)
    if test == COPLANARITY and available[0].all() and available[1].all():
        reject_crossing(angles, std, platforms, slots, limit, w)
    if nearest:
        only_nearest(d, hits, w)
    evidence[0] = normalise(w)
    mean, spread = np.empty(6), np.empty((6, 6))
    weights = whitened_moments(w, y, u, t, mean, spread)
    mix(x, P, P_h, weights, columns, mean, spread, x_out, P_out)
    for s in range(platforms.shape[0]):
        report(w, s, kept[s], slots[s], nu[s], nu_out[s], assignment, missed)


def associate_directions(
    prior: Gaussian, scan: AngleScan, settings: AngleFilter, detection_probability, nearest: bool = False
):
    """Condition tracks on a scan of one or two sensors' returns.

    Args:
        prior: mean [..., 6], cov [..., 6, 6].
        scan: leading axes as the prior's.
        settings: gates, clutter, outlier test.
        detection_probability: [s], in (0, 1].
        nearest: take the nearest pair (else the nearest return) for the target's instead of averaging.
    Returns:
        posterior mean and cov, then the fields of `AngleUpdate` after the posterior.
    Raises:
        ValueError: for more than two sensors.
    """
    sensors = np.shape(scan.platforms)[-2]
    if sensors > 2:
        raise ValueError(
            f"scan.platforms holds {sensors} platforms: pairs of returns are weighed for one or two; "
            "AnglePdafSequential takes any number"
        )
    density = scan.clutter_density if settings.clutter_known else np.zeros(np.shape(scan.clutter_density))
    test, limit = TESTS[settings.outlier_test] if settings.outlier_test else (NO_TEST, np.inf)
    return _average(
        prior.mean, prior.cov, scan.angles, scan.valid, scan.platforms, scan.angle_std, scan.available, density,
        detection_probability, settings.gate, settings.fused_gate, nearest, test, limit,
    )  # fmt: skip


@dataclass(frozen=True)
class AnglePdaf(AngleFilter):
    """Pairwise probabilistic data association, one or two platforms (`trackers.angle_contract.AngleTracker`).

    Settings as in `AngleFilter`. An `outlier_test` is asked of every pair of returns; the conditioned one at the
    linearisation of the fused update.
    """

    def update(self, state: Gaussian, scan: AngleScan) -> AngleUpdate:
        """Weigh all pairs of returns for every track."""
        return self._associate(state, scan, nearest=False)

    def _associate(self, state: Gaussian, scan: AngleScan, nearest: bool) -> AngleUpdate:
        scan.check()
        scan = scan.over_tracks()
        mean, cov, *rest = associate_directions(state, self.around(state, scan), self, self.detection(scan), nearest)
        return AngleUpdate(self.renew(Gaussian(mean, cov), scan), *rest)


@dataclass(frozen=True)
class AngleNearestNeighbour(AnglePdaf):
    """The nearest pair of returns, else the nearest return, is taken for the target's; a contrast to `AnglePdaf`."""

    def update(self, state: Gaussian, scan: AngleScan) -> AngleUpdate:
        """Give every track its nearest returns."""
        return self._associate(state, scan, nearest=True)


@dataclass(frozen=True)
class AnglePdafSequential(AnglePdaf):
    """One sensor after the other, each linearised at and gated by what the former left; any number of platforms.

    A contrast to `AnglePdaf`: returns of two sensors support each other only through the first one's posterior.
    """

    def __post_init__(self):
        super().__post_init__()
        if self.outlier_test is not None:
            raise ValueError(f"outlier_test {self.outlier_test!r}: sensors are not compared, one follows the other")

    def update(self, state: Gaussian, scan: AngleScan) -> AngleUpdate:
        """Weigh the returns of every sensor in turn."""
        scan.check()
        whole, parts, p_d = scan.over_tracks(), [], self.detection(scan)
        posterior = state
        for s in range(np.shape(scan.platforms)[-2]):
            one = self.around(posterior, whole.sensor(s))
            mean, cov, *rest = associate_directions(posterior, one, self, p_d[s : s + 1])
            posterior = Gaussian(mean, cov)
            parts.append(rest)
        nu, S, evidence, *counts = zip(*parts, strict=True)
        per_sensor = (np.concatenate(part, axis=-1) for part in counts)
        posterior = self.renew(posterior, whole)
        return AngleUpdate(
            posterior, np.concatenate(nu, axis=-2), np.concatenate(S, axis=-3), sum(evidence), *per_sensor
        )
