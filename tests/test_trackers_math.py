"""The trackers' algebra: angles, bearings, Kalman updates, banks, fixes, kernels, and what the package may import."""

import ast
import math
import subprocess
import sys
import threading
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.special import logsumexp

import passive_env
import trackers
from trackers import Gaussian, rp_ekf
from trackers.angles import circular_mean, wrap, wrap_scalar
from trackers.association import PRUNED
from trackers.compiled import Blocks, Kernel
from trackers.gaussian import moment_match
from trackers.linalg import log_det, mahalanobis_squared, psd_inverse, psd_solve, symmetrize
from trackers.measurement import bearing, bearing_jacobian, update
from trackers.motion import predict, process_noise, transition
from trackers.rp_ekf import Bank, subintervals
from trackers.triangulation import (
    RangeInterval,
    crossing_ranges,
    forward_interval,
    least_squares_fix,
    modulus_interval,
)


def random_cov(rng, *shape, size=4, scale=(800.0, 300.0, 40.0, 90.0)):
    """Positive definite matrices [*shape, size, size] with all correlations and unequal scales."""
    root = rng.standard_normal((*shape, size, size + 2)) * np.array(scale)[:size, None]
    return root @ np.swapaxes(root, -1, -2) / (size + 2)


def random_tracks(rng, *shape):
    """Tracks [*shape] some 30 km north-east of the origin."""
    mean = np.array([25e3, 17e3, -150.0, 60.0]) + rng.standard_normal((*shape, 4)) * [5e3, 4e3, 60.0, 60.0]
    return Gaussian(mean, random_cov(rng, *shape))


def random_bank(rng, *shape, n=5):
    track = random_tracks(rng, *shape, n)
    log_w = np.log(rng.dirichlet(np.full(n, 2.0), size=shape))
    return Bank(track.mean, track.cov, log_w)


# ------------------------------------------------------------------------------------------------ angles


@settings(deadline=None, derandomize=True)
@given(st.floats(-1e4, 1e4))
def test_wrap_keeps_the_direction_and_lands_within_half_a_turn(angle):
    wrapped = float(wrap(angle))
    assert abs(wrapped) <= math.pi + 1e-12
    assert math.cos(wrapped - angle) == pytest.approx(1.0, abs=1e-12)
    assert wrap_scalar(angle) == pytest.approx(
        wrapped, abs=1e-15 * max(1.0, abs(angle))
    )  # compiled: fused multiply-add


def test_wrap_takes_the_short_way_round_north_west_and_south():
    np.testing.assert_allclose(
        wrap([math.pi + 0.1, -math.pi - 0.1, 7.0]), [0.1 - math.pi, math.pi - 0.1, 7 - 2 * math.pi]
    )


def test_circular_mean_does_not_break_at_the_branch_cut():
    assert abs(circular_mean([math.pi - 0.1, 0.2 - math.pi])) == pytest.approx(math.pi - 0.05)


# ------------------------------------------------------------------------------------------------ bearings


@pytest.mark.parametrize(
    ("east", "north", "degrees"), [(2.0, 0.0, 0.0), (0.0, 3.0, 90.0), (-1.0, 0.0, 180.0), (1.0, -1.0, -45.0)]
)
def test_bearings_count_counter_clockwise_from_east(east, north, degrees):
    assert math.degrees(bearing([10.0 + east, -5.0 + north], [10.0, -5.0])) == pytest.approx(degrees)


def test_jacobian_equals_finite_differences():
    rng = np.random.default_rng(1)
    position = rng.uniform(-5e4, 5e4, (200, 2))
    position[0] = [-3e4, 1e-3]  # just above the branch cut
    station, h = np.array([1200.0, -700.0]), 0.5
    differences = np.stack(
        [
            wrap(bearing(position + step, station) - bearing(position - step, station)) / (2 * h)
            for step in np.eye(2) * h
        ],
        axis=-1,
    )
    np.testing.assert_allclose(bearing_jacobian(position, station), differences, rtol=1e-6, atol=1e-12)


def test_update_by_hand():
    """Target 1 km east of the station: only y is seen, S = (100 m / 1 km)² + σ²."""
    prior = Gaussian(np.array([1000.0, 0.0, 3.0, 4.0]), np.diag([100.0, 100.0, 10.0, 10.0]) ** 2)
    result = update(prior, 0.02, np.zeros(2), 0.01)
    assert result.innovation_var == pytest.approx(0.0101)
    np.testing.assert_allclose(result.posterior.mean, [1000.0, 0.02 * 10.0 / 0.0101, 3.0, 4.0])
    np.testing.assert_allclose(np.diag(result.posterior.cov), [1e4, 1e4 * (1 - 0.01 / 0.0101), 100.0, 100.0])
    assert result.log_likelihood == pytest.approx(-0.5 * (math.log(2 * math.pi * 0.0101) + 0.02**2 / 0.0101))


def test_update_equals_a_kalman_filter_on_the_linearised_model():
    """z = h(x̄) + H (x − x̄) + v as one joint Gaussian of state and measurement, conditioned on z; 60 tracks."""
    rng = np.random.default_rng(2)
    prior, station, std = random_tracks(rng, 60), np.array([-4e3, 2e3]), 0.02
    z = bearing(prior.mean, station) + 0.05 * rng.standard_normal(60)
    result = update(prior, z, station, std)
    for i in range(60):
        H = np.zeros((1, 4))
        H[0, :2] = bearing_jacobian(prior.mean[i], station)
        joint = np.block([[prior.cov[i], prior.cov[i] @ H.T], [H @ prior.cov[i], H @ prior.cov[i] @ H.T + std**2]])
        gain = joint[:4, 4] / joint[4, 4]
        nu = z[i] - bearing(prior.mean[i], station)
        np.testing.assert_allclose(result.posterior.mean[i], prior.mean[i] + gain * nu)
        expected = joint[:4, :4] - np.outer(gain, joint[4, :4])
        np.testing.assert_allclose(result.posterior.cov[i], expected, rtol=1e-7, atol=1e-9 * np.abs(expected).max())


def test_joseph_form_equals_information_form():
    rng = np.random.default_rng(3)
    prior, station, std = random_tracks(rng, 50), np.array([3e3, -1e3]), 0.01
    posterior = update(prior, bearing(prior.mean, station), station, std).posterior
    H = np.zeros((50, 4))
    H[:, :2] = bearing_jacobian(prior.mean, station)
    information = np.linalg.inv(prior.cov) + H[:, :, None] * H[:, None, :] / std**2
    np.testing.assert_allclose(np.linalg.inv(information), posterior.cov, rtol=1e-6, atol=1e-3)


def test_innovation_is_wrapped_across_the_branch_cut():
    prior = Gaussian(np.array([-1000.0, -1.0, 0.0, 0.0]), np.eye(4))
    result = update(prior, math.pi - 0.001, np.zeros(2), 0.01)
    assert result.innovation == pytest.approx(-0.002)


def test_update_refuses_axes_that_do_not_fit():
    with pytest.raises(ValueError):
        update(Gaussian(np.zeros(4), np.eye(3)), 0.1, np.zeros(2), 0.01)
    with pytest.raises(ValueError):
        update(Gaussian(np.zeros((3, 4)), np.zeros((3, 4, 4)) + np.eye(4)), np.zeros(2), np.zeros(2), 0.01)


def test_prediction_equals_the_matrix_formula():
    rng = np.random.default_rng(4)
    prior = random_tracks(rng, 20)
    phi = np.array([[1, 0, 1.7, 0], [0, 1, 0, 1.7], [0, 0, 1, 0], [0, 0, 0, 1]])
    G = np.array([[0.85, 0], [0, 0.85], [1, 0], [0, 1]])
    posterior = predict(prior, 1.7, 12.0)
    np.testing.assert_allclose(transition(1.7), phi)
    np.testing.assert_allclose(process_noise(1.7, 12.0), 144.0 * G @ G.T)
    np.testing.assert_allclose(posterior.mean, prior.mean @ phi.T)
    np.testing.assert_allclose(posterior.cov, phi @ prior.cov @ phi.T + 144.0 * G @ G.T, rtol=1e-12)


@settings(max_examples=25, deadline=None, derandomize=True)
@given(
    seed=st.integers(0, 2**32 - 1),
    log_range=st.floats(0.0, 6.0),
    log_std=st.floats(-6.0, -1.0),
    log_prior=st.floats(1.0, 6.0),
    log_noise=st.floats(-3.0, 2.0),
)
def test_covariance_stays_positive_definite_over_a_thousand_updates(seed, log_range, log_std, log_prior, log_noise):
    """Ranges from 1 m to 1000 km, σ from 1e-6 rad, priors up to 1000 km, wrong bearings included."""
    rng = np.random.default_rng(seed)
    track = Gaussian(rng.standard_normal(4) * 10**log_range, np.diag([10**log_prior, 10**log_prior, 300.0, 300.0]) ** 2)
    stations = rng.standard_normal((1000, 2)) * 10**log_range
    bearings = rng.uniform(-math.pi, math.pi, 1000)
    for k in range(1000):
        track = update(track, bearings[k], stations[k], 10**log_std).posterior
        if k % 10 == 0:
            track = predict(track, 2.0, 10**log_noise)
    P = track.cov
    assert np.isfinite(track.mean).all()
    np.testing.assert_array_equal(P, P.T)
    assert (np.diag(P) > 0).all()
    scale = np.sqrt(np.diag(P))
    assert np.linalg.eigvalsh(P / scale / scale[:, None]).min() > 0


def test_a_bearing_sharper_than_rounding_can_hold_leaves_a_proper_covariance():
    """1.5 m from the station, 17 km unsure, σ = 3e-5 rad: HPHᵀ / σ² is 1e17, beyond double precision."""
    rng = np.random.default_rng(0)
    for angle in rng.uniform(-math.pi, math.pi, 200):
        prior = Gaussian(
            1.5 * np.array([math.cos(angle), math.sin(angle), 0.0, 0.0]), np.diag([1.7e4, 1.7e4, 3e2, 3e2]) ** 2
        )
        result = update(prior, angle, np.zeros(2), 3e-5)
        scale = np.sqrt(np.diag(result.posterior.cov))
        assert np.linalg.eigvalsh(result.posterior.cov / scale / scale[:, None]).min() > 0
        assert np.isfinite(result.log_likelihood)


# ------------------------------------------------------------------------------------------------ matrices, mixtures


def test_small_matrix_algebra_equals_numpy():
    rng = np.random.default_rng(5)
    A, b, x = random_cov(rng, 7), rng.standard_normal((7, 4, 3)), rng.standard_normal((7, 4))
    np.testing.assert_allclose(psd_solve(A, b), np.linalg.solve(A, b), rtol=1e-8)
    np.testing.assert_allclose(psd_inverse(A), np.linalg.inv(A), rtol=1e-7)
    np.testing.assert_allclose(log_det(A), np.linalg.slogdet(A)[1])
    np.testing.assert_allclose(mahalanobis_squared(x, A), np.einsum("ni,nij,nj->n", x, np.linalg.inv(A), x), rtol=1e-8)
    np.testing.assert_array_equal(symmetrize([[1.0, 4.0], [2.0, 3.0]]), [[1.0, 3.0], [3.0, 3.0]])


def test_mahalanobis_length_survives_an_indefinite_matrix():
    length = mahalanobis_squared([1.0, 1.0], [[1.0, 1.1], [1.1, 1.0]])
    assert np.isfinite(length)
    assert length >= 0


def test_moment_match_by_hand():
    """±1 with weights 3/4 and 1/4 and unit variances: mean 1/2, variance 1 + 3/4."""
    matched = moment_match([0.75, 0.25], np.array([[1.0], [-1.0]]), np.ones((2, 1, 1)))
    assert matched.mean == pytest.approx(0.5)
    assert matched.cov == pytest.approx(1.75)


def test_bank_estimate_equals_raw_moments():
    """x̂ = E[x] and P̂ = E[xxᵀ] − x̂x̂ᵀ, a different route from the kernel's; one hypothesis is pruned."""
    bank = random_bank(np.random.default_rng(6), 9, 2)
    log_w = bank.log_weights.copy()
    log_w[..., 2] = PRUNED
    log_w -= logsumexp(log_w, axis=-1, keepdims=True)
    log_w[..., 2] = PRUNED
    w = np.exp(log_w)
    mean = np.einsum("...n,...ni->...i", w, bank.mean)
    second = np.einsum("...n,...nij->...ij", w, bank.cov + bank.mean[..., :, None] * bank.mean[..., None, :])
    found = rp_ekf.estimate(Bank(bank.mean, bank.cov, log_w))
    np.testing.assert_allclose(found.mean, mean)
    np.testing.assert_allclose(found.cov, second - mean[..., :, None] * mean[..., None, :], rtol=1e-6, atol=1e-2)
    np.testing.assert_allclose(found.cov, moment_match(w, bank.mean, bank.cov).cov, rtol=1e-10)


# ------------------------------------------------------------------------------------------------ the bank


@settings(deadline=None, derandomize=True)
@given(low=st.floats(10.0, 1e5), ratio=st.floats(1.01, 1e3), n=st.integers(1, 40))
def test_subintervals_are_contiguous_and_their_weights_sum_to_one(low, ratio, n):
    """Acceptance test (a), and the closed forms of eqs 13, 16, 17 and 21."""
    high = low * ratio
    center, half, weight = subintervals(RangeInterval(low, high), n)
    rho, i = ratio ** (1 / n), np.arange(n)
    np.testing.assert_allclose(center, rho**i * (rho + 1) * low / 2, rtol=1e-9)
    np.testing.assert_allclose(half, rho**i * (rho - 1) * low / 2, rtol=1e-7)
    np.testing.assert_allclose(weight, 2 * half / (high - low), rtol=1e-9)
    np.testing.assert_allclose((center - half)[1:], (center + half)[:-1], rtol=1e-12)
    assert center[0] - half[0] == pytest.approx(low)
    assert center[-1] + half[-1] == pytest.approx(high)
    assert weight.sum() == pytest.approx(1.0)
    assert weight @ center == pytest.approx((low + high) / 2)


def test_the_banks_long_axes_lie_along_the_bearing():
    """Acceptance test (e): eigenvectors of the position covariance are the line of sight and its normal."""
    alpha, std = 2.2, math.radians(0.5)
    bank = rp_ekf.initiate(alpha, np.array([100.0, 50.0]), std, RangeInterval(2e4, 2e5), 8, 30.0, 200.0)
    along, across = np.array([math.cos(alpha), math.sin(alpha)]), np.array([-math.sin(alpha), math.cos(alpha)])
    center, half, weight = subintervals(RangeInterval(2e4, 2e5), 8)
    position = bank.cov[:, :2, :2]
    np.testing.assert_allclose(position @ along, half[:, None] ** 2 * along)
    np.testing.assert_allclose(position @ across, (center * std)[:, None] ** 2 * across)
    assert (half > center * std).all()
    np.testing.assert_allclose(bank.mean[:, :2], [100.0, 50.0] + center[:, None] * along)
    np.testing.assert_allclose(bank.mean[:, 2:], np.tile(30.0 * along, (8, 1)))
    np.testing.assert_allclose(bank.cov[:, 2:, 2:], np.tile(200.0**2 * np.eye(2), (8, 1, 1)))
    np.testing.assert_allclose(np.exp(bank.log_weights), weight)


def test_bank_update_equals_one_filter_after_another_and_bayes_rule():
    rng = np.random.default_rng(7)
    bank, stations, std = random_bank(rng), np.array([[-9e3, 1e3], [2e3, 4e3]]), 0.03
    z = np.array([0.75, 0.6])
    found = rp_ekf.update(bank, z, np.array([True, True]), stations, std, prune_below=1e-300)
    log_w = bank.log_weights.copy()
    for i in range(5):
        one = Gaussian(bank.mean[i], bank.cov[i])
        for s in range(2):
            step = update(one, z[s], stations[s], std)
            one, log_w[i] = step.posterior, log_w[i] + step.log_likelihood
        np.testing.assert_allclose(found.posterior.mean[i], one.mean)
        np.testing.assert_allclose(found.posterior.cov[i], one.cov)
    np.testing.assert_allclose(found.posterior.log_weights, log_w - logsumexp(log_w))
    assert found.log_likelihood == pytest.approx(logsumexp(log_w))


def test_weights_sum_to_one_and_pruned_hypotheses_stay_removed():
    rng = np.random.default_rng(8)
    bank, used = random_bank(rng, 30, n=8), np.array([True])
    gone = np.zeros((30, 8), dtype=bool)
    for _ in range(20):
        z = 0.6 + 0.02 * rng.standard_normal((30, 1))
        bank = rp_ekf.update(rp_ekf.predict(bank, 2.0, 5.0), z, used, np.zeros((1, 2)), 0.02, 0.02).posterior
        np.testing.assert_allclose(np.exp(bank.log_weights).sum(-1), 1.0)
        now = bank.log_weights == PRUNED
        assert (now | ~gone).all()
        assert (np.exp(bank.log_weights[~now]) >= 0.02).all()
        gone = now
    assert gone.any()
    assert not gone.all(-1).any()


def test_pruning_keeps_the_best_even_if_all_fall_below_the_threshold():
    rng = np.random.default_rng(9)
    bank = random_bank(rng, 10)
    full = rp_ekf.update(bank, [0.6], [True], np.zeros((1, 2)), 0.05, 1e-300).posterior
    pruned = rp_ekf.update(bank, [0.6], [True], np.zeros((1, 2)), 0.05, 0.999999).posterior
    alive = pruned.log_weights > PRUNED
    assert (alive.sum(-1) == 1).all()
    np.testing.assert_array_equal(alive.argmax(-1), full.log_weights.argmax(-1))
    np.testing.assert_allclose(pruned.log_weights[alive], 0.0, atol=1e-15)


def test_a_bearing_nobody_expected_leaves_everything_finite():
    bank = random_bank(np.random.default_rng(10), 6)
    result = rp_ekf.update(bank, [0.6 - math.pi], [True], np.zeros((1, 2)), 1e-5)
    for part in (*result.posterior, result.innovation, result.innovation_var, result.log_likelihood):
        assert np.isfinite(part).all()
    np.testing.assert_allclose(np.exp(result.posterior.log_weights).sum(-1), 1.0)


def test_a_missed_scan_changes_nothing():
    bank = random_bank(np.random.default_rng(11), 3)
    result = rp_ekf.update(bank, [0.0], [False], np.zeros((1, 2)), 0.01)
    for before, after in zip(bank, result.posterior, strict=True):
        np.testing.assert_array_equal(before, after)
    np.testing.assert_array_equal(result.log_likelihood, 0.0)


def test_batch_equals_loop_with_the_empty_batch():
    rng = np.random.default_rng(12)
    bank, z = random_bank(rng, 4, 3), rng.uniform(0.4, 0.8, (4, 3, 2))
    used, stations = rng.random((4, 3, 2)) < 0.7, rng.uniform(-5e3, 5e3, (4, 1, 2, 2))
    batch = rp_ekf.update(rp_ekf.predict(bank, 2.0, 3.0), z, used, stations, 0.02)
    for e in range(4):
        for j in range(3):
            one = rp_ekf.predict(Bank(*(part[e, j] for part in bank)), 2.0, 3.0)
            single = rp_ekf.update(one, z[e, j], used[e, j], stations[e, 0], 0.02)
            for part, expected in zip(batch.posterior, single.posterior, strict=True):
                np.testing.assert_array_equal(part[e, j], expected)
            np.testing.assert_array_equal(batch.innovation[e, j], single.innovation)
            np.testing.assert_array_equal(batch.log_likelihood[e, j], single.log_likelihood)
    none = rp_ekf.update(Bank(*(part[:0] for part in bank)), z[:0], used[:0], stations[:0], 0.02)
    assert none.posterior.mean.shape == (0, 3, 5, 4)
    assert rp_ekf.estimate(none.posterior).cov.shape == (0, 3, 4, 4)


# ------------------------------------------------------------------------------------------------ crossing lines


def test_crossing_ranges_equal_the_papers_tangents():
    """Eqs 3–5 with tangents, away from their singularities; both signed ranges lead to the same point."""
    rng = np.random.default_rng(13)
    p1, p2 = np.array([-1e4, 300.0]), np.array([3500.0, 3600.0])
    theta, alpha = rng.uniform(0.3, 1.2, 100), rng.uniform(0.3, 1.2, 100)
    t, a = np.tan(theta), np.tan(alpha)
    x = (p2[1] - p1[1] + p1[0] * t - p2[0] * a) / (t - a)
    y = (p2[1] * t - p1[1] * a + (p1[0] - p2[0]) * t * a) / (t - a)
    r1, r2 = crossing_ranges(theta, alpha, p1, p2)
    np.testing.assert_allclose(p2[0] + r2 * np.cos(alpha), x, rtol=1e-7)
    np.testing.assert_allclose(p2[1] + r2 * np.sin(alpha), y, rtol=1e-7)
    np.testing.assert_allclose(p1[0] + r1 * np.cos(theta), x, rtol=1e-7)
    np.testing.assert_allclose(np.abs(r2), np.hypot(x - p2[0], y - p2[1]), rtol=1e-7)


def test_parallel_bearings_cross_at_infinity():
    assert all(math.isinf(r) for r in crossing_ranges(0.7, 0.7, np.zeros(2), np.ones(2)))


def test_intervals_equal_a_loop_over_crossings():
    rng = np.random.default_rng(14)
    station, reference, spread = np.array([-1e4, 0.0]), np.array([3e3, 4e3]), 0.03
    for _ in range(50):
        alpha, thetas = rng.uniform(0.3, 1.0), rng.uniform(0.3, 1.0, 4)
        pairs = [crossing_ranges(t + e, alpha, station, reference) for t in thetas for e in (-spread, spread)]
        literal = modulus_interval(alpha, reference, thetas, station, spread)
        assert literal == pytest.approx((min(abs(r) for _, r in pairs), max(abs(r) for _, r in pairs)))
        forward = forward_interval(alpha, reference, thetas, np.ones(4, bool), station, spread, 1e3, 2e5)
        ahead = [r2 for r1, r2 in pairs if r1 > 0 and r2 > 0]
        assert 1e3 <= forward.low < forward.high <= 2e5
        if ahead and not (np.abs(wrap(thetas - alpha)) <= spread).any():
            low = min(max(min(ahead), 1e3), 1.8e5)
            assert forward == pytest.approx((low, min(max(max(ahead), 1.1 * low), 2e5)))


def test_a_bracket_that_holds_the_parallel_direction_reaches_to_the_cap():
    near_parallel = forward_interval(0.5, np.array([0.0, 1e3]), [0.51], [True], np.zeros(2), 0.03, 1e3, 1.5e5)
    assert near_parallel.high == 1.5e5
    nothing_ahead = forward_interval(0.5, np.array([0.0, 1e3]), [-1.0], [True], np.zeros(2), 0.03, 1e3, 1.5e5)
    assert nothing_ahead == (1e3, 1.5e5)


def test_fix_from_two_bearings_is_their_crossing():
    stations, target = np.array([[-7e3, 0.0], [4e3, 2e3]]), np.array([9e3, 3e4])
    z = bearing(target, stations)
    fix = least_squares_fix(z, np.array([True, True]), stations, 0.01, target + np.array([2e3, -3e3]))
    assert fix.converged
    np.testing.assert_allclose(fix.position, target, atol=1.0)


def test_fix_covariance_equals_monte_carlo():
    """Three stations, 4000 draws: sample covariance within 4 standard errors of (HᵀH)⁻¹σ², entry by entry."""
    rng = np.random.default_rng(15)
    stations, target, std = np.array([[-7e3, 0.0], [4e3, 2e3], [9e3, -8e3]]), np.array([5e3, 2.5e4]), 0.002
    z = bearing(target, stations) + std * rng.standard_normal((4000, 3))
    fix = least_squares_fix(z, np.ones(3, bool), stations, std, target + 500.0)
    assert fix.converged.all()
    error = fix.position - target
    sample, expected = error.T @ error / 4000, fix.cov.mean(0)
    variance = np.diag(expected)
    standard_error = np.sqrt((expected**2 + np.outer(variance, variance)) / 4000)
    assert (np.abs(sample - expected) < 4 * standard_error).all()


def test_no_fix_from_one_bearing_or_from_collinear_lines():
    stations, guess = np.array([[0.0, 0.0], [1e3, 0.0]]), np.array([5e3, 0.0])
    for z, used in (([0.0, 0.0], [True, True]), ([0.3, 0.0], [True, False])):
        fix = least_squares_fix(z, used, stations, 0.01, guess)
        assert not fix.converged
        np.testing.assert_array_equal(fix.position, guess)
        np.testing.assert_array_equal(fix.cov, 0.0)


# ------------------------------------------------------------------------------------------------ kernels


def double(x, out):
    out[0] = 2.0 * x


def test_kernel_refuses_a_layout_that_does_not_fit_its_dtypes():
    with pytest.raises(ValueError, match=r"kernel double: 2 arguments in the layout, 3 dtypes"):
        Kernel(double, "()->()", "fff")(1.0)


def test_kernel_raises_no_floating_point_warning():
    """Compiled code may set flags for numbers that it does not use; who lets NumPy raise must be able to call it."""
    with np.errstate(all="raise"):
        np.testing.assert_array_equal(Kernel(double, "()->()")(np.array([1.0, 1e308, np.inf])), [2.0, np.inf, np.inf])
        with pytest.raises(FloatingPointError):
            np.multiply(1e308, [10.0])


def test_kernel_of_dense_arrays_takes_strided_and_other_numbers():
    """Its compiled code ignores strides: what does not lie in one piece must be copied first."""
    rng = np.random.default_rng(8)
    mean, cov, log_w = rng.standard_normal((5, 3, 4)), random_cov(rng, 5, 3), np.log(rng.dirichlet(np.ones(3), 5))
    wanted = rp_ekf.estimate(Bank(mean, cov, log_w))
    strided = Bank(*(np.repeat(part, 2, axis=-1)[..., ::2] for part in (mean, cov, log_w)))
    assert not any(part.flags.c_contiguous for part in strided)
    turned = Bank(mean.swapaxes(0, 1).copy().swapaxes(0, 1), np.asfortranarray(cov), log_w)
    for bank in (strided, turned):
        for found, right in zip(rp_ekf.estimate(bank), wanted, strict=True):
            np.testing.assert_array_equal(found, right)
    whole = Bank(np.arange(12).reshape(3, 4), cov[0], log_w[0])
    as_float = rp_ekf.estimate(whole._replace(mean=whole.mean.astype(float)))
    np.testing.assert_array_equal(rp_ekf.estimate(whole).mean, as_float.mean)


def test_kernel_refuses_arrays_that_do_not_fit_its_layout():
    with pytest.raises(ValueError):
        predict(Gaussian(np.zeros(4), np.zeros((3, 4))), 1.0, 1.0)


@pytest.mark.parametrize(("size", "block", "threads"), [(0, 4, None), (1, 4, 1), (10, 4, 2), (1000, 256, 3)])
def test_blocks_cover_the_batch_once_and_in_order(size, block, threads):
    blocks = Blocks(size, block, threads)
    rows = blocks.map(lambda part: np.arange(size)[part], blocks.slices)
    np.testing.assert_array_equal(np.concatenate(rows), np.arange(size))
    assert all(len(row) <= block for row in rows)


def test_small_batches_are_shared_only_where_that_is_asked_for():
    assert Blocks(127, threads=2).threads == 1
    assert Blocks(128, threads=2).threads == 2
    few = Blocks(3, threads=2, smallest=1)
    assert (few.threads, sorted(part.stop - part.start for part in few.slices)) == (2, [1, 2])
    assert Blocks(1, threads=2, smallest=1).threads == 1


def test_blocks_inside_blocks_run_where_they_are():
    outer, inner = Blocks(256, 64, 2), Blocks(128, 64, 2)
    assert (outer.threads, inner.threads) == (2, 2)

    def work(rows):
        return sum(inner.map(lambda part: part.stop - part.start, inner.slices)), threading.get_ident()

    answer: list = []
    caller = threading.Thread(target=lambda: answer.extend(outer.map(work, outer.slices)), daemon=True)
    caller.start()
    caller.join(20.0)
    assert [size for size, _ in answer] == [128] * 4  # empty if it waits for itself
    assert len({thread for _, thread in answer}) == 2


@pytest.mark.parametrize("bad", [0, 3], ids=["calling thread", "other thread"])
def test_an_error_in_a_block_surfaces_after_all_blocks_have_run(bad):
    blocks, done = Blocks(1024, 256, 2), []

    def work(rows, place):
        if place == bad:
            raise ValueError(f"block {place}")
        done.append(place)

    with pytest.raises(ValueError, match=f"block {bad}"):
        blocks.map(work, blocks.slices, range(4))
    assert set(done) >= {2, 3} - {bad} if bad == 0 else set(done) == {0, 1, 2}


# ------------------------------------------------------------------------------------------------ boundaries

FORBIDDEN = {
    trackers: ("gymnasium", "torch", "stable_baselines3", "matplotlib", "passive_env", "agents"),
    passive_env: ("torch", "stable_baselines3", "agents"),
}


def imported_names(path):
    """Top-level names of all packages a source file imports, inside functions too."""
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            yield from (alias.name.split(".")[0] for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
            yield node.module.split(".")[0]


@pytest.mark.parametrize("package", FORBIDDEN, ids=lambda package: package.__name__)
def test_no_source_file_names_a_package_of_a_higher_floor(package):
    for path in Path(package.__file__).parent.rglob("*.py"):
        assert not set(imported_names(path)) & set(FORBIDDEN[package]), path


@pytest.mark.parametrize("package", FORBIDDEN, ids=lambda package: package.__name__)
def test_importing_a_floor_loads_nothing_of_a_higher_one(package):
    root = Path(package.__file__).parent
    modules = sorted(
        ".".join((package.__name__, *path.relative_to(root).with_suffix("").parts)).removesuffix(".__init__")
        for path in root.rglob("*.py")
    )
    script = "import importlib, sys\n" + "".join(f"importlib.import_module({name!r})\n" for name in modules)
    script += "print(*{name.split('.')[0] for name in sys.modules})"
    loaded = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True).stdout.split()
    assert package.__name__ in loaded
    assert not set(loaded) & set(FORBIDDEN[package])
