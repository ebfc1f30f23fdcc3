"""Azimuth and elevation in space: motion, directions, fused EKF, association, outliers, first positions, bounds."""

import itertools
import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import least_squares
from scipy.special import logsumexp
from scipy.stats import binom, chi2, multivariate_normal, norm, truncnorm

from trackers import (
    ANGLE_TRACKERS,
    AngleEkf,
    AngleFilter,
    AngleNearestNeighbour,
    AnglePdaf,
    AnglePdafSequential,
    AngleScan,
    AngleTracker,
    Gaussian,
)
from trackers.angle_pdaf import MAX_RETURNS, associate_directions
from trackers.angles import wrap
from trackers.bounds_3d import (
    advance,
    bound_start,
    position_std_3d,
    posterior_bound_information_3d,
    range_std_3d,
)
from trackers.compiled import Blocks
from trackers.direction import direction, direction_jacobian, gate, std_with_curvature, unit_vector
from trackers.motion_3d import predict_3d, process_noise_3d, transition_3d
from trackers.outliers import TESTS, outlier_distances
from trackers.pair_weights import return_weights
from trackers.triangulation_3d import fix_3d, start_tracks

STD = math.radians(0.5)
PLATFORMS = np.array([[0.0, 0.0, 6e3], [500.0, -6e3, 5.5e3]])
MASKS = [np.reshape(mask, (2, 2)) for mask in itertools.product([False, True], repeat=4)]


def random_tracks(rng, *shape):
    """Tracks [*shape] some 25 km east of the platforms, all correlations, unequal scales."""
    mean = np.array([24e3, -5e3, 8e3, -150.0, 40.0, 5.0]) + rng.standard_normal((*shape, 6)) * [
        3e3,
        2e3,
        5e2,
        50,
        50,
        9,
    ]
    root = rng.standard_normal((*shape, 6, 8)) * np.array([1500.0, 400.0, 250.0, 90.0, 60.0, 25.0])[:, None]
    return Gaussian(mean, root @ np.swapaxes(root, -1, -2) / 8)


def repeated(prior, count):
    return Gaussian(np.broadcast_to(prior.mean, (count, 6)), np.broadcast_to(prior.cov, (count, 6, 6)))


def as_state(track):
    """Tracks [..., 6] with the axis of m = 1."""
    return Gaussian(track.mean[..., None, :], track.cov[..., None, :, :])


def rows(parts, at):
    """Rows of every array of a tuple, as the same type."""
    return type(parts)(*(part[at] for part in parts))


def make_scan(angles, valid=None, available=True, density=0.0, platforms=PLATFORMS, std=None):
    """A scan of angles [..., s, b, 2]; everything else spread over its leading axes."""
    angles = np.asarray(angles, dtype=float)
    lead, (sensors, slots) = angles.shape[:-3], angles.shape[-3:-1]
    valid = np.ones((*lead, sensors, slots), dtype=bool) if valid is None else valid
    std = np.full((sensors, 2), STD) if std is None else std

    def spread(part, *core):
        return np.broadcast_to(part, (*lead, *core)).copy()

    return AngleScan(
        angles, valid, spread(platforms, sensors, 3), spread(std, sensors, 2), spread(available, sensors, 2),
        spread(density, sensors),
    )  # fmt: skip


def cluttered_scan(rng, track, returns, gamma=16.0, density=None, spread=0.6):
    """Returns [..., 2, b] scattered over somewhat more than the gates of tracks [..., 6]; random validity."""
    search = gate(track.mean, track.cov, PLATFORMS, np.full((2, 2), STD), gamma)
    lead = track.mean.shape[:-1]
    reach = np.sqrt(gamma) * spread * np.sqrt(np.diagonal(search.cov, axis1=-2, axis2=-1))
    angles = search.angles[..., None, :] + reach[..., None, :] * rng.standard_normal((*lead, 2, returns, 2))
    density = returns / search.area if density is None else density
    return make_scan(angles, rng.random((*lead, 2, returns)) < 0.8, density=density)


def stacked(track, scan, slots):
    """ν, H, R of the given slot of every sensor, −1 for none; rows of masked components left out. One track."""
    rows_nu, rows_H, rows_R = [], [], []
    for s, k in enumerate(slots):
        if k < 0:
            continue
        nu = wrap(scan.angles[s, k] - direction(track.mean, scan.platforms[s]))
        H = np.zeros((2, 6))
        H[:, :3] = direction_jacobian(track.mean, scan.platforms[s])
        keep = scan.available[s]
        rows_nu.append(nu[keep])
        rows_H.append(H[keep])
        rows_R.append(scan.angle_std[s][keep] ** 2)
    return (
        np.concatenate(rows_nu or [[]]),
        np.concatenate(rows_H or [np.zeros((0, 6))]),
        np.diag(np.concatenate(rows_R or [[]])),
    )


def dense_update(track, nu, H, R):
    """Textbook gain form with Joseph covariance."""
    if not len(nu):
        return track
    S = H @ track.cov @ H.T + R
    K = track.cov @ H.T @ np.linalg.inv(S)
    left = np.eye(6) - K @ H
    return Gaussian(track.mean + K @ nu, left @ track.cov @ left.T + K @ R @ K.T)


# ------------------------------------------------------------------------------------------------ motion, directions


def test_prediction_equals_dense_matrices():
    rng = np.random.default_rng(0)
    track = random_tracks(rng, 3, 4)
    ours = predict_3d(track, 2.5, 30.0)
    phi, Q = transition_3d(2.5), process_noise_3d(2.5, 30.0)
    np.testing.assert_allclose(ours.mean, track.mean @ phi.T)
    np.testing.assert_allclose(ours.cov, phi @ track.cov @ phi.T + Q, rtol=1e-12)


def test_process_noise_is_an_acceleration_held_over_the_step():
    """Section 2, correction C1: T³/2 in the lower left block; and √q = 30 gives 60 m and 60 m/s at T = 2 s."""
    Q = process_noise_3d(2.0, 30.0)
    np.testing.assert_allclose(np.diag(Q), [60.0**2] * 6)
    np.testing.assert_allclose(Q[3:, :3], 900.0 * 4.0 * np.eye(3))
    assert np.linalg.matrix_rank(Q) == 3


def test_jacobian_equals_finite_differences():
    rng = np.random.default_rng(1)
    position = rng.normal([20e3, -4e3, 3e3], [8e3, 8e3, 4e3], (50, 3))
    H = direction_jacobian(position, PLATFORMS[1])
    for axis in range(3):
        step = np.zeros(3)
        step[axis] = 1.0
        difference = wrap(direction(position + step, PLATFORMS[1]) - direction(position - step, PLATFORMS[1])) / 2.0
        np.testing.assert_allclose(H[..., axis], difference, rtol=1e-6, atol=1e-12)


def test_curvature_is_that_of_the_second_derivatives():
    """½ tr(H_xx P H_xx P) with Hessians from differences of the Jacobian."""
    rng = np.random.default_rng(2)
    tracks = random_tracks(rng, 5)
    tracks.mean[:, 2] += 15e3 * rng.standard_normal(5)  # steep lines of sight too
    widened = std_with_curvature(tracks, PLATFORMS, np.full((2, 2), STD))
    step = 1.0
    for i, (mean, cov) in enumerate(zip(*tracks, strict=True)):
        for s, platform in enumerate(PLATFORMS):
            hessian = np.stack(
                [
                    (direction_jacobian(mean[:3] + e, platform) - direction_jacobian(mean[:3] - e, platform)) / 2 / step
                    for e in step * np.eye(3)
                ],
                axis=-1,
            )
            product = hessian @ cov[:3, :3]
            expected = STD**2 + 0.5 * np.trace(product @ product, axis1=-2, axis2=-1)
            np.testing.assert_allclose(widened[i, s] ** 2, expected, rtol=1e-5)


def test_second_order_variance_is_nearer_to_the_innovations_spread():
    """Directions of 200,000 draws from a wide prior: first order misses 7 % of their variance, second order less."""
    rng = np.random.default_rng(3)
    root = np.array([[4e3, 0.0, 0.0], [1.5e3, 3e3, 0.0], [0.0, 5e2, 2e3]])
    cov = np.eye(6)
    cov[:3, :3] = root @ root.T
    track = Gaussian(np.array([25e3, 0.0, 8e3, 0.0, 0.0, 0.0]), cov)
    drawn = direction(track.mean[:3] + rng.standard_normal((200_000, 3)) @ root.T, PLATFORMS[1])
    found = wrap(drawn - direction(track.mean, PLATFORMS[1])).var(axis=0)
    linear, second = (
        np.diag(gate(track.mean, cov, PLATFORMS[1:], std, 1.0).cov[0])
        for std in (np.full((1, 2), 1e-9), std_with_curvature(track, PLATFORMS[1:], np.full((1, 2), 1e-9)))
    )
    assert (np.abs(second / found - 1.0) < 0.7 * np.abs(linear / found - 1.0)).all()


@pytest.mark.parametrize("name", ["angle_ekf", "angle_pdaf", "angle_nn"])
def test_second_order_counts_the_curvature_once_and_only_if_asked(name):
    rng = np.random.default_rng(4)
    tracks = random_tracks(rng, 3)
    scan = make_scan(direction(tracks.mean[:, None], PLATFORMS)[..., None, :] + STD, density=1e-3)
    plain, wide = (ANGLE_TRACKERS[name](second_order=flag).update(as_state(tracks), scan) for flag in (False, True))
    assert (np.linalg.det(wide.posterior.cov) > np.linalg.det(plain.posterior.cov)).all()
    by_hand = scan._replace(angle_std=std_with_curvature(tracks, PLATFORMS, scan.angle_std))
    expected = ANGLE_TRACKERS[name]().update(as_state(tracks), by_hand)
    np.testing.assert_array_equal(wide.posterior.mean, expected.posterior.mean)
    np.testing.assert_array_equal(wide.innovation_cov, expected.innovation_cov)


def test_directions_by_hand():
    assert direction([-3e3, 4e3, 6e3], [0.0, 0.0, 1e3]) == pytest.approx([math.atan2(4, -3), math.pi / 4])
    np.testing.assert_allclose(
        unit_vector(np.array([math.pi / 2, math.pi / 6])), [0.0, math.sqrt(0.75), 0.5], atol=1e-12
    )
    assert np.isfinite(direction_jacobian([0.0, 0.0, 5e3], np.zeros(3))).all()


def test_gate_is_the_innovation_ellipse():
    track = random_tracks(np.random.default_rng(2), 5)
    found = gate(track.mean, track.cov, PLATFORMS, np.full((2, 2), STD), 16.0)
    for i, s in itertools.product(range(5), range(2)):
        H = direction_jacobian(track.mean[i], PLATFORMS[s])
        S = H @ track.cov[i, :3, :3] @ H.T + STD**2 * np.eye(2)
        np.testing.assert_allclose(found.cov[i, s], S, rtol=1e-10)
        assert found.area[i, s] == pytest.approx(16.0 * math.pi * math.sqrt(np.linalg.det(S)))
        np.testing.assert_allclose(found.angles[i, s], direction(track.mean[i], PLATFORMS[s]))


# ------------------------------------------------------------------------------------------------ fused EKF


def one_return(rng, track, platforms=PLATFORMS, std=STD):
    """Angles [..., s, 1, 2] of targets drawn from tracks [..., 6]."""
    truth = track.mean + np.einsum(
        "...ij,...j->...i", np.linalg.cholesky(track.cov), rng.standard_normal(track.mean.shape)
    )
    z = direction(truth[..., None, :], platforms)
    return wrap(z + std * rng.standard_normal(z.shape))[..., None, :]


@pytest.mark.parametrize("mask", MASKS, ids=lambda mask: "".join(map(str, mask.astype(int).ravel())))
def test_gain_form_equals_information_form_for_every_mask(mask):
    """Section 4: masked components carry no information; noises differ between sensors and components."""
    rng = np.random.default_rng(3)
    track, std = random_tracks(rng, 1), np.array([[0.7, 1.1], [2.0, 0.4]]) * STD
    scan = make_scan(one_return(rng, track), available=mask, std=std)
    update = AngleEkf().update(as_state(track), scan)
    prior, alone = rows(track, 0), rows(scan, 0)
    nu, H, R = stacked(prior, alone, (0, 0))
    information = np.linalg.inv(prior.cov) + H.T @ np.linalg.inv(R) @ H
    np.testing.assert_allclose(update.posterior.cov[0, 0], np.linalg.inv(information), rtol=1e-6, atol=1e-6)
    dense = dense_update(prior, nu, H, R)
    np.testing.assert_allclose(update.posterior.mean[0, 0], dense.mean, rtol=1e-9)
    np.testing.assert_allclose(update.posterior.cov[0, 0], dense.cov, rtol=1e-7, atol=1e-7)
    if len(nu):
        expected = multivariate_normal(np.zeros(len(nu)), H @ prior.cov @ H.T + R).logpdf(nu)
        assert update.log_likelihood[0, 0] == pytest.approx(expected)
    np.testing.assert_array_equal(update.missed[0, 0], ~mask.any(-1))
    np.testing.assert_array_equal(update.assignment[0, 0], np.where(mask.any(-1), 0, -1))
    np.testing.assert_array_equal(update.innovation[0, 0][~mask], 0.0)


@pytest.mark.parametrize("name", ANGLE_TRACKERS)
@pytest.mark.parametrize("hidden", ["masked", "invalid"])
def test_nothing_available_leaves_the_prediction(name, hidden):
    rng = np.random.default_rng(4)
    track = random_tracks(rng, 3, 1)
    valid = np.full((3, 2, 1), hidden == "masked")
    scan = make_scan(one_return(rng, Gaussian(track.mean[:, 0], track.cov[:, 0])), valid, available=hidden == "invalid")
    update = ANGLE_TRACKERS[name]().update(track, scan)
    np.testing.assert_array_equal(update.posterior.mean, track.mean)
    np.testing.assert_allclose(update.posterior.cov, track.cov, rtol=1e-15)
    np.testing.assert_array_equal(update.missed, 1.0)
    np.testing.assert_array_equal(update.assignment, -1)


def test_any_number_of_platforms_is_fused():
    """Five sensors with one prior equal the stacked update; so does one."""
    rng = np.random.default_rng(5)
    for sensors in (1, 5):
        platforms = PLATFORMS[0] + rng.normal(0.0, 4e3, (sensors, 3))
        track = random_tracks(rng, 1)
        scan = make_scan(one_return(rng, track, platforms), platforms=platforms)
        posterior = AngleEkf().update(as_state(track), scan).posterior
        prior, alone = rows(track, 0), rows(scan, 0)
        dense = dense_update(prior, *stacked(prior, alone, (0,) * sensors))
        np.testing.assert_allclose(posterior.mean[0, 0], dense.mean, rtol=1e-9)
        np.testing.assert_allclose(posterior.cov[0, 0], dense.cov, rtol=1e-6, atol=1e-6)


def test_innovations_wrap_across_west():
    track = Gaussian(np.array([[[-20e3, -60.0, 6e3, 0.0, 0.0, 0.0]]]), 1e6 * np.eye(6)[None, None])
    z = direction(track.mean[0, 0] + [0.0, 150.0, 0, 0, 0, 0], PLATFORMS)
    assert z[0, 0] > 3.1
    assert direction(track.mean[0, 0], PLATFORMS)[0, 0] < -3.1
    for tracker in (AngleEkf(), AnglePdaf()):
        update = tracker.update(track, make_scan(z[None, :, None], density=1e-9))
        assert np.abs(update.innovation[0, 0]).max() < 0.02
        assert abs(update.posterior.mean[0, 0, 1] - 90.0) < 60.0


@pytest.mark.parametrize("name", ANGLE_TRACKERS)
def test_covariances_stay_positive_and_finite_in_extreme_geometry(name):
    """Targets within metres of a platform, errors of tens of kilometres, tiny noise, many scans."""
    rng = np.random.default_rng(6)
    mean = np.concatenate(
        [PLATFORMS[0] + rng.normal(0.0, 10.0 ** rng.uniform(-1, 4, (200, 1)), (200, 3)), np.zeros((200, 3))], -1
    )
    state, tracker = (
        Gaussian(mean[:, None], np.diag([1e9, 1e9, 1e9, 1e5, 1e5, 1e4])[None, None] * np.ones((200, 1, 1, 1))),
        ANGLE_TRACKERS[name](),
    )
    for _ in range(30):
        z = rng.uniform(-1.0, 1.0, (200, 2, 3, 2)) * [math.pi, math.pi / 2]
        scan = make_scan(z, available=rng.random((200, 2, 2)) < 0.8, density=1.0, std=np.full((2, 2), 1e-6))
        update = tracker.update(tracker.predict(state, 2.0), scan)
        state = update.posterior
        assert all(np.isfinite(part).all() for part in (*state, *update[1:]))
        assert (np.linalg.eigvalsh(state.cov) > 0.0).all()
        np.testing.assert_array_equal(state.cov, np.swapaxes(state.cov, -1, -2))


# ------------------------------------------------------------------------------------------------ association


def dense_mixture(track, scan, settings):
    """Section 6 written out with dense matrices for one track: log weights by pair, and the mixture's moments."""
    p_d, gates, lam, miss = settings.detection_probability, [], [], []
    for s in range(2):
        inside = []
        for k in np.flatnonzero(scan.valid[s]):
            nu, H, R = stacked(track, scan, tuple(k if i == s else -1 for i in range(2)))
            S = H @ track.cov @ H.T + R
            if nu @ np.linalg.inv(S) @ nu <= settings.gate:
                inside.append(int(k))
        gates.append([-1, *inside])
        known = settings.clutter_known and scan.clutter_density[s] > 0
        S = gate(track.mean, track.cov, scan.platforms[s : s + 1], scan.angle_std[s : s + 1], settings.gate)
        lam.append(scan.clutter_density[s] if known else max(len(inside), 1) / S.area[0])
        miss.append(math.log(1.0 - p_d * (1.0 - math.exp(-0.5 * settings.gate))))
    pairs, log_w, posteriors = [], [], []
    for pair in itertools.product(*gates):
        nu, H, R = stacked(track, scan, pair)
        S = H @ track.cov @ H.T + R
        if min(pair) >= 0 and nu @ np.linalg.inv(S) @ nu > settings.fused_gate:
            continue
        log = sum(math.log(p_d / lam[s]) if k >= 0 else miss[s] for s, k in enumerate(pair))
        log += multivariate_normal(np.zeros(len(nu)), S).logpdf(nu) if len(nu) else 0.0
        pairs.append(pair)
        log_w.append(log)
        posteriors.append(dense_update(track, nu, H, R))
    w = np.exp(np.array(log_w) - logsumexp(log_w))
    means = np.array([p.mean for p in posteriors])
    mean = w @ means
    cov = sum(b * (p.cov + np.outer(p.mean - mean, p.mean - mean)) for b, p in zip(w, posteriors, strict=True))
    return dict(zip(pairs, w, strict=True)), Gaussian(mean, cov), logsumexp(log_w), gates


@pytest.mark.parametrize("settings", [AnglePdaf(detection_probability=0.85), AnglePdaf(0.0, 9.21, 11.0, 0.6, False)])
def test_all_pairs_equal_dense_matrices(settings):
    """The whitened four-gain form against an enumeration with a dense update for every pair."""
    rng = np.random.default_rng(7)
    track = random_tracks(rng, 30)
    scan = cluttered_scan(rng, track, 5, settings.gate)
    update = settings.update(as_state(track), scan)
    pairs_seen = 0
    for i in range(30):
        alone, prior = rows(scan, i), rows(track, i)
        weights, mixture, evidence, gates = dense_mixture(prior, alone, settings)
        pairs_seen += sum(min(pair) >= 0 for pair in weights)
        np.testing.assert_allclose(update.posterior.mean[i, 0], mixture.mean, rtol=1e-9)
        np.testing.assert_allclose(update.posterior.cov[i, 0], mixture.cov, rtol=1e-6, atol=1e-4)
        assert update.log_likelihood[i, 0] == pytest.approx(evidence)
        for s in range(2):
            marginal = {k: sum(w for pair, w in weights.items() if pair[s] == k) for k in gates[s]}
            assert update.missed[i, 0, s] == pytest.approx(marginal[-1], abs=1e-12)
            assert update.assignment[i, 0, s] == max(marginal, key=marginal.__getitem__)
            assert update.validated[i, 0, s] == len(gates[s]) - 1
            nu = wrap(alone.angles[s] - direction(prior.mean, PLATFORMS[s]))
            expected = sum(w * nu[k] for k, w in marginal.items() if k >= 0)
            np.testing.assert_allclose(update.innovation[i, 0, s], expected, atol=1e-12)
    assert pairs_seen > 50


@pytest.mark.parametrize("name", ["angle_pdaf", "angle_nn"])
def test_association_without_clutter_equals_the_ekf(name):
    """Section 10: λ → 0 with one return per sensor."""
    rng = np.random.default_rng(8)
    track = random_tracks(rng, 40)
    scan = make_scan(one_return(rng, track), density=1e-12)
    state = as_state(track)
    wide = ANGLE_TRACKERS[name](gate=60.0, fused_gate=80.0).update(state, scan)
    ekf = AngleEkf().update(state, scan)
    np.testing.assert_allclose(wide.posterior.mean, ekf.posterior.mean, rtol=1e-9)
    np.testing.assert_allclose(wide.posterior.cov, ekf.posterior.cov, rtol=1e-7, atol=1e-5)


@pytest.mark.parametrize("second_order", [False, True])
def test_sequential_pdaf_is_one_pdaf_after_another(second_order):
    """Three platforms; each sensor alone is the dense mixture at what the former left."""
    rng = np.random.default_rng(9)
    track, platforms = random_tracks(rng, 6), np.vstack([PLATFORMS, [[3e3, 5e3, 7e3]]])
    z = one_return(rng, track, platforms)
    scan = make_scan(
        np.concatenate([z, z + rng.normal(0.0, 2 * STD, z.shape)], axis=-2), density=400.0, platforms=platforms
    )
    tracker = AnglePdafSequential(detection_probability=(0.9, 0.8, 0.7), second_order=second_order)
    state = as_state(track)
    update = tracker.update(state, scan)
    for s, p_d in enumerate(tracker.detection_probability):
        state = AnglePdaf(detection_probability=p_d, second_order=second_order).update(state, scan.sensor(s)).posterior
    np.testing.assert_array_equal(update.posterior.mean, state.mean)
    np.testing.assert_array_equal(update.posterior.cov, state.cov)
    assert update.missed.shape == update.dropped.shape == (6, 1, 3)
    assert update.innovation_cov.shape == (6, 1, 3, 2, 2)


def test_nearest_neighbour_takes_the_nearest_pair_else_the_nearest_return():
    rng = np.random.default_rng(10)
    track = random_tracks(rng, 60)
    scan = cluttered_scan(rng, track, 4)
    tracker, kinds = AngleNearestNeighbour(), set()
    update = tracker.update(as_state(track), scan)
    for i in range(60):
        alone, prior = rows(scan, i), rows(track, i)

        def squared(pair, alone=alone, prior=prior):
            nu, H, R = stacked(prior, alone, pair)
            return float(nu @ np.linalg.inv(H @ prior.cov @ H.T + R) @ nu) if len(nu) else math.inf

        slots = [[int(k) for k in np.flatnonzero(alone.valid[s])] for s in range(2)]
        inside = [[k for k in slots[s] if squared((k, -1) if s == 0 else (-1, k)) <= 16.0] for s in range(2)]
        pairs = [pair for pair in itertools.product(*inside) if squared(pair) <= 18.47]
        single = [(k, -1) for k in inside[0]] + [(-1, k) for k in inside[1]]
        best = min(pairs or single or [(-1, -1)], key=squared)
        kinds.add(sum(k >= 0 for k in best))
        np.testing.assert_array_equal(update.assignment[i, 0], best)
        dense = dense_update(prior, *stacked(prior, alone, best))
        np.testing.assert_allclose(update.posterior.mean[i, 0], dense.mean, rtol=1e-9)
        np.testing.assert_allclose(update.posterior.cov[i, 0], dense.cov, rtol=1e-6, atol=1e-5)
    assert kinds >= {1, 2}


def test_returns_beyond_the_maximum_are_counted_and_the_nearest_kept():
    """100 returns in one gate: the farthest do not matter, wherever they stand in the scan."""
    rng = np.random.default_rng(11)
    track = random_tracks(rng, 1)
    search = gate(track.mean, track.cov, PLATFORMS, np.full((2, 2), STD), 16.0)
    root = np.linalg.cholesky(search.cov[0])
    radius = np.sqrt(15.9 * np.arange(100) / 100.0)
    turn = rng.uniform(0.0, 2.0 * math.pi, (2, 100))
    disk = radius[:, None] * np.stack([np.cos(turn), np.sin(turn)], axis=-1)
    angles = search.angles[0][:, None] + disk @ np.swapaxes(root, -1, -2)
    order, state, tracker = rng.permutation(100), as_state(track), AnglePdaf(detection_probability=0.9)
    many = tracker.update(state, make_scan(angles[None, :, order], density=1e4))
    few = tracker.update(state, make_scan(angles[None, :, :MAX_RETURNS], density=1e4))
    np.testing.assert_array_equal(many.validated, 100)
    np.testing.assert_array_equal(many.dropped, 100 - MAX_RETURNS)
    np.testing.assert_array_equal(few.dropped, 0)
    np.testing.assert_allclose(many.posterior.mean, few.posterior.mean, rtol=1e-12)
    np.testing.assert_allclose(many.posterior.cov, few.posterior.cov, rtol=1e-9)
    np.testing.assert_allclose(many.missed, few.missed, rtol=1e-9)
    nearest = AngleNearestNeighbour().update(state, make_scan(angles[None, :, order], density=1e4))
    assert order[nearest.assignment].max() < MAX_RETURNS


def test_one_component_is_gated_and_weighed_in_that_one():
    """Azimuth only: an elevation far off changes nothing, an azimuth outside ±4σ is no candidate."""
    rng = np.random.default_rng(12)
    track = random_tracks(rng, 1)
    search = gate(track.mean, track.cov, PLATFORMS, np.full((2, 2), STD), 16.0)
    sigma = np.sqrt(search.cov[0, :, 0, 0])
    angles = np.repeat(search.angles[0][:, None], 3, axis=1)
    angles[:, :, 0] += sigma[:, None] * [0.5, 3.9, 4.1]
    shifted = angles.copy()
    shifted[..., 1] += 0.7
    azimuth = np.array([True, False])
    state = as_state(track)
    one, two = (
        AnglePdaf().update(state, make_scan(a[None], available=azimuth, density=50.0)) for a in (angles, shifted)
    )
    np.testing.assert_array_equal(one.validated, 2)
    np.testing.assert_array_equal(one.posterior.mean, two.posterior.mean)
    np.testing.assert_array_equal(one.assignment, 0)


def test_when_every_hypothesis_is_improbable_the_best_one_stays():
    """Dense clutter and returns at the gate's edge: weights sum to one and nothing is NaN."""
    rng = np.random.default_rng(13)
    track = random_tracks(rng, 20)
    scan = cluttered_scan(rng, track, 8, density=1e12, spread=1.0)
    update = AnglePdaf(detection_probability=1e-6).update(as_state(track), scan)
    np.testing.assert_allclose(update.missed, 1.0, atol=1e-6)
    np.testing.assert_allclose(update.posterior.mean[:, 0], track.mean, rtol=1e-9)


# ------------------------------------------------------------------------------------------------ calibration

SCANS, BIN_SIGMA = 300_000, 4.5


def calibration_scans(rng, components, p_d, gamma, clutter, prior):
    """Scans of a linearised sensor pair drawn from the model itself: returns, and whether slot 0 is in the gate."""
    H = np.concatenate([direction_jacobian(prior.mean, place) for place in PLATFORMS])
    S = H @ prior.cov[:3, :3] @ H.T + STD**2 * np.eye(4)
    nu = rng.multivariate_normal(np.zeros(4), S, SCANS, method="cholesky").reshape(SCANS, 2, 1, 2)
    search = gate(prior.mean, prior.cov, PLATFORMS, np.full((2, 2), STD), gamma)
    count = rng.poisson(clutter, (SCANS, 2))
    slots = int(count.max())
    if components.all():
        radius, turn = np.sqrt(gamma * rng.random((SCANS, 2, slots))), rng.uniform(0.0, 2 * math.pi, (SCANS, 2, slots))
        disk = radius[..., None] * np.stack([np.cos(turn), np.sin(turn)], axis=-1)
        false = disk @ np.swapaxes(np.linalg.cholesky(search.cov), -1, -2)
        squared = np.einsum("nsbi,sij,nsbj->nsb", nu, np.linalg.inv(search.cov), nu)[..., 0]
    else:
        half = np.sqrt(gamma * search.cov[:, 0, 0])
        false = np.stack([rng.uniform(-1.0, 1.0, (SCANS, 2, slots)) * half[:, None], np.zeros((SCANS, 2, slots))], -1)
        squared = nu[:, :, 0, 0] ** 2 / search.cov[:, 0, 0]
    seen = rng.random((SCANS, 2)) < p_d
    angles = search.angles[:, None] + np.concatenate([nu, false], axis=2)
    valid = np.concatenate([seen[..., None], np.arange(slots) < count[..., None]], axis=-1)
    scan = make_scan(angles, valid, available=components, density=clutter / search.area)
    return scan, seen & (squared <= gamma), S


def test_association_weights_are_calibrated_for_scalar_sensors():
    """Specification, section 6: innovation correlation 0.49, 300,000 scans, classes 00, 10, 01, 11.

    P_D 0.8 and 0.7 at 3σ gates. The product form of the miss is wrong by the joint miss's correlation, 2e-4 at most.
    """
    rng = np.random.default_rng(14)
    truth = np.array([30e3, -3e3, 8e3, -150.0, 0.0, 0.0])
    prior = Gaussian(truth, np.diag([300.0**2, 258.0**2, 258.0**2, 1e4, 1e4, 1e4]))
    p_d, gamma = np.array([0.8, 0.7]), 9.0
    scan, inside, S = calibration_scans(rng, np.array([True, False]), p_d, gamma, 3.0, prior)
    assert S[0, 2] / math.sqrt(S[0, 0] * S[2, 2]) == pytest.approx(0.49, abs=0.02)
    settings = AnglePdaf(gate=gamma, fused_gate=1e6)
    *_, log_likelihood, _, _, missed, _ = associate_directions(repeated(prior, SCANS), scan, settings, p_d)
    q = 1.0 - p_d * math.erf(3.0 / math.sqrt(2.0))
    none = q[0] * q[1] * np.exp(-log_likelihood)
    posterior = np.stack([none, missed[:, 1] - none, missed[:, 0] - none, 1.0 - missed.sum(1) + none], axis=-1)
    happened = np.stack(
        [~inside[:, 0] & ~inside[:, 1], inside[:, 0] & ~inside[:, 1], ~inside[:, 0] & inside[:, 1], inside.all(1)], -1
    )
    band = BIN_SIGMA * (posterior - happened).std(0) / math.sqrt(SCANS) + 2e-4
    np.testing.assert_array_less(np.abs(posterior.mean(0) - happened.mean(0)), band)
    specified = np.array([0.0612, 0.2408, 0.1415, 0.5566])
    band = BIN_SIGMA * np.sqrt(2.0 * specified * (1.0 - specified) / SCANS)
    np.testing.assert_array_less(np.abs(posterior.mean(0) - specified), band)
    assert band.max() < 0.006


def test_association_weights_are_calibrated_for_azimuth_and_elevation():
    """Scans in which a return weighs between a and b hold the target's there as often as the weights say."""
    rng = np.random.default_rng(15)
    truth = np.array([30e3, -3e3, 8e3, -150.0, 0.0, 0.0])
    prior = Gaussian(truth, np.diag([300.0**2, 258.0**2, 258.0**2, 1e4, 1e4, 1e4]))
    p_d = np.array([0.8, 0.7])
    scan, inside, _ = calibration_scans(rng, np.array([True, True]), p_d, 16.0, 4.0, prior)
    settings = AnglePdaf(gate=16.0, fused_gate=1e6)
    *_, missed, _ = associate_directions(repeated(prior, SCANS), scan, settings, p_d)
    for s in range(2):
        bins = np.minimum((20.0 * missed[:, s]).astype(int), 19)
        for b in range(20):
            own = bins == b
            if own.sum() < 500:
                continue
            claimed, happened = missed[own, s], ~inside[own, s]
            band = BIN_SIGMA * (claimed - happened).std() / math.sqrt(own.sum()) + 1e-3
            assert abs(claimed.mean() - happened.mean()) < band, (s, b)
        assert len(np.unique(bins)) >= 15


# ------------------------------------------------------------------------------------------------ outliers


@pytest.mark.parametrize("test", TESTS)
def test_false_alarm_rate_of_outlier_tests_is_one_percent(test):
    """Section 4.1: 20,000 trials at nominal 1 %; 99.9 % binomial band."""
    rng = np.random.default_rng(16)
    trials = 20_000
    mean = np.array([25e3, -3e3, 8e3, -150.0, 0.0, 0.0])
    prior = Gaussian(
        np.broadcast_to(mean, (trials, 6)), np.broadcast_to(np.diag([9e4, 4e4, 4e4, 1e4, 1e4, 1e4]), (trials, 6, 6))
    )
    distance = outlier_distances(prior, make_scan(one_return(rng, prior)), test)
    low, high = binom.ppf([5e-4, 1 - 5e-4], trials, 0.01)
    assert low <= (distance[:, 1] > TESTS[test][1]).sum() <= high
    np.testing.assert_array_equal(distance[:, 0], 0.0)
    degrees = {"conditioned": 2, "coplanarity": 1}[test]
    assert TESTS[test][1] == pytest.approx(chi2.ppf(0.99, degrees))
    spread = math.sqrt(2.0 * degrees / trials)
    assert distance[:, 1].mean() == pytest.approx(degrees, abs=4.0 * spread)


@pytest.mark.parametrize("test", TESTS)
def test_outlier_leaves_sensor_two_out_of_the_scan(test):
    rng = np.random.default_rng(17)
    track = random_tracks(rng, 1)
    z = direction(track.mean[:, None], PLATFORMS)[..., None, :]
    z[:, 1, 0, 1] += 8 * math.degrees(STD) * STD * 30
    state, scan = as_state(track), make_scan(z)
    update = AngleEkf(outlier_test=test).update(state, scan)
    masked = AngleEkf().update(state, scan._replace(available=np.array([[[True, True], [False, False]]])))
    np.testing.assert_array_equal(update.posterior.mean, masked.posterior.mean)
    np.testing.assert_array_equal(update.missed[0, 0], [0.0, 1.0])
    fair = AngleEkf(outlier_test=test).update(state, make_scan(direction(track.mean[:, None], PLATFORMS)[..., None, :]))
    np.testing.assert_array_equal(fair.missed, 0.0)


def test_fused_gate_implies_both_outlier_tests():
    """Section 4.1: d4² = d1² + d²(2 given 1), and d4² ≥ coplanarity's d² to first order."""
    rng = np.random.default_rng(18)
    prior = Gaussian(np.array([25e3, -3e3, 8e3, -150.0, 0.0, 0.0]), np.diag([9e4, 4e4, 4e4, 1e4, 1e4, 1e4]))
    z = direction(prior.mean, PLATFORMS)[None, :, None] + rng.normal(0.0, 1.5 * STD, (200, 2, 1, 2))
    scan = make_scan(z)
    tracks = Gaussian(np.broadcast_to(prior.mean, (200, 6)), np.broadcast_to(prior.cov, (200, 6, 6)))
    given, plane = (outlier_distances(tracks, scan, test)[:, 1] for test in TESTS)
    for i in range(200):
        alone = rows(scan, i)
        nu, H, R = stacked(prior, alone, (0, 0))
        four = nu @ np.linalg.inv(H @ prior.cov @ H.T + R) @ nu
        nu, H, R = stacked(prior, alone, (0, -1))
        assert four - nu @ np.linalg.inv(H @ prior.cov @ H.T + R) @ nu == pytest.approx(given[i], rel=0.1, abs=0.1)
        assert plane[i] <= 1.05 * four + 0.05


@pytest.mark.parametrize("test", TESTS)
def test_pairs_that_fail_a_test_are_not_weighed(test):
    """Against the formulas written out (`return_weights`), which a test changes in part of the scans."""
    rng = np.random.default_rng(19)
    track = random_tracks(rng, 200)
    scan, changed = cluttered_scan(rng, track, 6), 0
    tested, plain = (AnglePdaf(outlier_test=name, detection_probability=0.9) for name in (test, None))
    update = tested.update(as_state(track), scan)
    for i in range(200):
        prior, alone = rows(track, i), rows(scan, i)
        weights = return_weights(prior, alone, tested)
        np.testing.assert_allclose(1.0 - weights.sum(-1), update.missed[i, 0], atol=1e-6)
        changed += np.abs(weights - return_weights(prior, alone, plain)).max() > 1e-3
    assert 20 < changed < 200


def test_platforms_at_one_place_say_nothing_about_coplanarity():
    track = random_tracks(np.random.default_rng(20), 2)
    scan = make_scan(np.random.default_rng(20).normal(0.0, 0.1, (2, 2, 1, 2)), platforms=PLATFORMS[[0, 0]])
    np.testing.assert_array_equal(outlier_distances(track, scan, "coplanarity"), 0.0)


# ------------------------------------------------------------------------------------------------ first positions


def test_fix_equals_a_least_squares_solver():
    rng = np.random.default_rng(21)
    truth, std = np.array([24e3, -3e3, 8e3]), np.array([[0.5, 1.0], [1.5, 0.7]]) * STD
    for _ in range(5):
        z = direction(truth, PLATFORMS) + std * rng.standard_normal((2, 2))
        found = fix_3d(z, np.ones(2, bool), PLATFORMS, std)
        solved = least_squares(lambda p, z=z: (wrap(z - direction(p, PLATFORMS)) / std).ravel(), truth, x_scale=1e3)
        assert found.converged
        np.testing.assert_allclose(found.position, solved.x, atol=1.0)
        H = (direction_jacobian(found.position, PLATFORMS) / std[..., None]).reshape(4, 3)
        np.testing.assert_allclose(found.cov, np.linalg.inv(H.T @ H), rtol=0.02)


def test_fix_is_honest():
    """NEES of 4,000 noisy fixes; 99.9 % band of its mean, widened by 3 % for the curvature of 1.9 km errors."""
    rng = np.random.default_rng(22)
    truth = np.array([30e3, -3e3, 8e3])
    z = direction(truth, PLATFORMS) + STD * rng.standard_normal((4000, 2, 2))
    found = fix_3d(z, np.ones((4000, 2), bool), PLATFORMS, np.full((2, 2), STD))
    assert found.converged.all()
    error = found.position - truth
    nees = np.einsum("ni,nij,nj->n", error, np.linalg.inv(found.cov), error)
    low, high = chi2.ppf([5e-4, 1 - 5e-4], 3 * 4000) / 4000
    assert 0.97 * low < nees.mean() < 1.03 * high


def test_first_position_of_the_paper_has_a_range_error_of_1870_m():
    """Specification, section 7."""
    platforms = np.array([[0.0, 0.0, 6e3], [0.0, -6e3, 6e3]])
    truth = np.array([30e3, -3e3, 8e3, -150.0, 0.0, 0.0])
    cov = bound_start(truth, platforms, np.full((2, 2), STD), (200.0, 200.0, 50.0))
    assert range_std_3d(cov, truth, platforms[0]) == pytest.approx(1870.0, rel=0.01)
    start = start_tracks(
        make_scan(direction(truth, platforms)[:, None], platforms=platforms), 1e3, 1e5, (200.0, 200.0, 50.0)
    )
    np.testing.assert_allclose(start.mean, [*truth[:3], 0.0, 0.0, 0.0], atol=0.1)
    np.testing.assert_allclose(start.cov, cov, rtol=1e-4, atol=1.0)


def prior_moments(floor_m, cap_m):
    """E r and E r² of the log-normal prior of range, cut at three standard deviations; in closed form."""
    median, deviation = 0.5 * math.log(floor_m * cap_m), 0.25 * math.log(cap_m / floor_m)
    within = norm.cdf(3.0) - norm.cdf(-3.0)
    return [
        math.exp(k * median + 0.5 * (k * deviation) ** 2)
        * (norm.cdf(3.0 - k * deviation) - norm.cdf(-3.0 - k * deviation))
        / within
        for k in (1, 2)
    ]


@pytest.mark.parametrize("case", ["one platform", "one sensor down", "contradiction"])
def test_one_line_of_sight_starts_with_the_prior_of_range(case):
    """So do two that cross nowhere before the platforms, by 20° of 0.5°: only the first one then counts."""
    platforms, truth, sensors = np.array([[0.0, 0.0, 6e3], [0.0, 4e3, 6e3]]), np.array([25e3, 0.0, 6e3]), 2
    if case == "one platform":
        platforms, sensors = platforms[:1], 1
    z = direction(truth, platforms)
    if case == "contradiction":
        z[1, 0] += math.radians(20.0)
    available = np.array([[True, True], [True, False]])[:sensors] if case == "one sensor down" else True
    tracker = AngleEkf(floor_m=2e3, cap_m=80e3)
    start = tracker.initiate(make_scan(z[None, :, None], available=available, platforms=platforms))
    first, second = prior_moments(2e3, 80e3)
    np.testing.assert_allclose(start.mean[0, 0], [first, 0.0, 6e3, 0.0, 0.0, 0.0], rtol=2e-3, atol=1e-6)
    across = STD * math.sqrt(second)
    np.testing.assert_allclose(
        np.sqrt(np.diag(start.cov[0, 0])),
        [math.sqrt(second - first**2), across, across, 200.0, 200.0, 50.0], rtol=3e-3,
    )  # fmt: skip


def test_oblique_line_of_sight_start_has_the_lines_axes():
    platform = np.array([[1e3, -2e3, 500.0]])
    z = np.array([2.2, 0.4])
    tracker = AngleEkf()
    start = tracker.initiate(make_scan(z[None, None, None], platforms=platform))
    u = unit_vector(z)
    first, second = prior_moments(tracker.floor_m, tracker.cap_m)
    np.testing.assert_allclose(start.mean[0, 0, :3], platform[0] + first * u, rtol=2e-3)
    values, axes = np.linalg.eigh(start.cov[0, 0, :3, :3])
    assert abs(axes[:, -1] @ u) == pytest.approx(1.0)
    across = math.sqrt(second) * STD
    expected = [across * math.cos(0.4), across, math.sqrt(second - first**2)]
    np.testing.assert_allclose(np.sqrt(values), expected, rtol=3e-3)


WEAK = {
    "in line": ([-4e3, 0.0, 6e3], [0.0, 0.0]),
    "nearly in line": ([-4e3, -500.0, 6.5e3], [0.3, -0.5]),
    "crossing at 3 degrees": ([-3e3, -2.5e3, 5e3], [0.8, 0.2]),
    "parallel": ([0.0, -1e3, 6e3], [-1.5, 0.5]),
}
"""Second platform [m] and how far its direction is off [standard deviations]; the first one's is right."""


@pytest.mark.parametrize("case", WEAK)
def test_weak_start_equals_importance_sampling(case):
    """Independent route, no linearisation: ranges from the prior, first directions from their noise, weighed by the
    exact likelihood of the second direction. Band: five standard errors of the weighted sample, and 3 %."""
    rng = np.random.default_rng(31)
    other, off = WEAK[case]
    platforms, truth = np.array([[0.0, 0.0, 6e3], other]), np.array([35e3, 3e3, 8e3])
    if case == "in line":
        truth = np.array([35e3, 0.0, 6e3])
    z = direction(truth, platforms)
    z[1] += STD * np.array(off)
    tracker = AngleEkf(floor_m=10e3, cap_m=100e3)
    start = tracker.initiate(make_scan(z[None, :, None], platforms=platforms))
    draws = 400_000
    log_range = truncnorm.rvs(-3.0, 3.0, size=draws, random_state=rng)
    r = np.exp(0.5 * math.log(1e9) + 0.25 * math.log(10.0) * log_range)
    x = platforms[0] + r[:, None] * unit_vector(z[0] + STD * rng.standard_normal((draws, 2)))
    log_w = -0.5 * ((wrap(z[1] - direction(x, platforms[1])) / STD) ** 2).sum(axis=-1)
    w = np.exp(log_w - log_w.max())
    w /= w.sum()
    mean = w @ x
    cov = (x - mean).T @ (w[:, None] * (x - mean))
    effective, std = 1.0 / (w**2).sum(), np.sqrt(np.diag(cov))
    assert effective > 10_000
    assert (np.abs(start.mean[0, 0, :3] - mean) < std * (5.0 / math.sqrt(effective) + 0.03)).all()
    np.testing.assert_allclose(np.sqrt(np.diag(start.cov[0, 0, :3, :3])), std, rtol=0.03 + 5.0 / math.sqrt(effective))


def test_start_passes_from_the_sum_over_ranges_to_the_fix_without_a_jump():
    """Where the fix takes over, both have the same deviation within 8 % and means closer than a third of it."""
    platforms, truth = np.array([[0.0, 0.0, 6e3], [0.0, -4.4e3, 6e3]]), np.array([35e3, 0.0, 8e3])
    scan = make_scan(direction(truth, platforms)[None, :, None], platforms=platforms)
    fix = AngleEkf().initiate(scan)
    share = math.sqrt(fix.cov[0, 0, 0, 0]) / np.linalg.norm(truth)
    assert 0.093 < share < 0.1
    farther = scan._replace(angle_std=scan.angle_std * 0.101 / share)
    summed = AngleEkf().initiate(farther)
    assert np.linalg.norm(summed.mean[0, 0, :3] - truth) < 0.33 * share * 35e3
    np.testing.assert_allclose(summed.cov[0, 0, 0, 0] ** 0.5, 0.101 * np.linalg.norm(truth), rtol=0.08)


def test_first_scan_with_false_returns_takes_the_coplanar_pair():
    truth = np.array([24e3, -3e3, 8e3])
    z = direction(truth, PLATFORMS)
    angles = np.stack([z + np.array([0.02, 0.15]), z, z - np.array([0.05, 0.08])], axis=-2)[None]
    angles[0, 1] = angles[0, 1, ::-1] + [[0.0, 0.3], [0.0, 0.0], [0.0, -0.2]]
    start = AnglePdaf().initiate(make_scan(angles))
    np.testing.assert_allclose(start.mean[0, 0, :3], truth, atol=1.0)


def test_scan_without_any_return_cannot_start_a_track():
    z = np.zeros((3, 2, 1, 2))
    valid = np.array([[True], [True]]) & np.array([True, False, True])[:, None, None]
    with pytest.raises(ValueError, match=r"scan \(1,\) of the batch holds no return"):
        AngleEkf().initiate(make_scan(z, valid))
    with pytest.raises(ValueError, match="need one"):
        AngleEkf().initiate(make_scan(z, available=np.array([True, False])))


def test_lost_tracks_start_afresh_if_asked():
    """A track that admits an error of a third of its range takes the scan's fix, a sound one does not."""
    truth = np.array([24e3, -3e3, 8e3, -150.0, 0.0, 0.0])
    lost = Gaussian(truth + np.array([0.0, 9e3, 2e3, 0.0, 0.0, 0.0]), np.diag([8e3**2, 3e3**2, 1e3**2, 1e4, 1e4, 1e4]))
    sound = Gaussian(truth, np.diag([5e2**2, 2e2**2, 2e2**2, 1e4, 1e4, 1e4]))
    state = Gaussian(*(np.stack(parts)[:, None] for parts in zip(lost, sound, strict=True)))
    scan = make_scan(np.broadcast_to(direction(truth, PLATFORMS)[:, None], (2, 2, 1, 2)), density=1e3)
    plain, renewed = (AnglePdaf(gate=4.0, reinitiate=flag).update(state, scan).posterior for flag in (False, True))
    np.testing.assert_allclose(renewed.mean[0, 0], [*truth[:3], 0.0, 0.0, 0.0], atol=1.0)
    assert np.linalg.norm(plain.mean[0, 0, :3] - truth[:3]) > 2e3
    np.testing.assert_array_equal(renewed.mean[1], plain.mean[1])
    np.testing.assert_array_equal(renewed.cov[1], plain.cov[1])


# ------------------------------------------------------------------------------------------------ bounds


def test_bound_equals_the_information_form():
    """Masks and shares of availability, heterogeneous sensors; the two forms share no code."""
    rng = np.random.default_rng(23)
    steps, std = 15, np.array([[0.5, 0.9], [1.4, 0.6]]) * STD
    truth = np.zeros((2, steps + 1, 6))
    truth[..., :3] = np.array([25e3, -3e3, 8e3]) + np.cumsum(rng.normal(0.0, 300.0, (2, steps + 1, 3)), axis=1)
    platforms = PLATFORMS + np.cumsum(rng.normal(0.0, 200.0, (2, steps + 1, 2, 3)), axis=1)
    for available in (1.0, 0.9, np.array([[1.0, 1.0], [0.0, 0.6]])):
        P = bound_start(truth[:, 0], platforms[:, 0], std, (200.0, 200.0, 50.0))
        expected = posterior_bound_information_3d(truth, platforms, P, std, 2.0, 30.0, available)
        for k in range(1, steps + 1):
            P = advance(P, truth[:, k], platforms[:, k], 2.0, 30.0, std, available)
            np.testing.assert_allclose(P, expected[:, k], rtol=1e-6, atol=1e-6)
    assert position_std_3d(P) == pytest.approx(np.sqrt(P[:, 0, 0] + P[:, 1, 1] + P[:, 2, 2]))


def test_ekf_on_its_own_model_is_honest():
    """Targets drawn from the filter's motion model: NEES of the tenth scan in the 99.9 % band, 3 % for curvature."""
    rng = np.random.default_rng(24)
    runs = 2000
    root = np.linalg.cholesky(np.diag([3e2, 2e2, 2e2, 30.0, 30.0, 20.0]) ** 2)
    start = np.array([25e3, -3e3, 8e3, -150.0, 20.0, 0.0])
    truth = start + rng.standard_normal((runs, 6)) @ root.T
    state, tracker = Gaussian(np.tile(start, (runs, 1, 1)), np.tile(root @ root.T, (runs, 1, 1, 1))), AngleEkf(5.0)
    for _ in range(10):
        push = np.concatenate([2.0 * np.eye(3), 2.0 * np.eye(3)])
        truth = truth @ transition_3d(2.0).T + 5.0 * rng.standard_normal((runs, 3)) @ push.T
        z = direction(truth[:, None], PLATFORMS) + STD * rng.standard_normal((runs, 2, 2))
        state = tracker.update(tracker.predict(state, 2.0), make_scan(z[..., None, :])).posterior
    error = state.mean[:, 0] - truth
    nees = np.einsum("ni,nij,nj->n", error, np.linalg.inv(state.cov[:, 0]), error)
    low, high = chi2.ppf([5e-4, 1 - 5e-4], 6 * runs) / runs
    assert 0.97 * low < nees.mean() < 1.03 * high


# ------------------------------------------------------------------------------------------------ contract, bad input


@pytest.mark.parametrize("name", ANGLE_TRACKERS)
def test_batch_equals_loop_and_the_empty_batch_works(name):
    rng = np.random.default_rng(25)
    tracker, track = ANGLE_TRACKERS[name](), random_tracks(rng, 7)
    assert isinstance(tracker, AngleTracker)
    state, scan = as_state(track), cluttered_scan(rng, track, 4)
    whole = tracker.update(tracker.predict(state, 2.0), scan)
    for i in range(7):
        one = tracker.update(
            tracker.predict(rows(state, slice(i, i + 1)), 2.0),
            rows(scan, slice(i, i + 1)),
        )
        for ours, theirs in zip((*whole.posterior, *whole[1:]), (*one.posterior, *one[1:]), strict=True):
            np.testing.assert_array_equal(ours[i : i + 1], theirs)
    none = tracker.update(rows(state, slice(0)), rows(scan, slice(0)))
    assert none.posterior.mean.shape == (0, 1, 6)
    assert none.innovation.shape == (0, 1, 2, 2)
    assert tracker.initiate(rows(scan, slice(0))).mean.shape == (0, 1, 6)


def test_threads_do_the_same_work_as_one_call():
    rng = np.random.default_rng(26)
    track = random_tracks(rng, 400)
    state, scan, tracker = as_state(track), cluttered_scan(rng, track, 6), AnglePdaf()

    def part(rows):
        return tracker.update(Gaussian(*(p[rows] for p in state)), AngleScan(*(p[rows] for p in scan))).posterior.mean

    blocks = Blocks(400, block=64, threads=2)
    np.testing.assert_array_equal(
        np.concatenate(blocks.map(part, blocks.slices)), tracker.update(state, scan).posterior.mean
    )


@pytest.mark.parametrize("name", ["angle_pdaf", "angle_nn"])
def test_pairs_of_more_than_two_platforms_are_refused_with_the_remedy(name):
    track = random_tracks(np.random.default_rng(27), 1, 1)
    scan = make_scan(np.zeros((1, 3, 1, 2)), platforms=np.zeros((3, 3)))
    with pytest.raises(ValueError, match=r"holds 3 platforms.*AnglePdafSequential"):
        ANGLE_TRACKERS[name]().update(track, scan)


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"gate": 0.0}, "gate 0.0: must be positive"),
        ({"fused_gate": math.nan}, "fused_gate nan: must be positive"),
        ({"floor_m": -1.0}, "floor_m -1.0: must be positive"),
        ({"cap_m": 500.0}, "cap_m 500.0: must be finite and above floor_m 5000.0"),
        ({"process_noise": -1.0}, "process_noise -1.0: must be finite and not negative"),
        ({"detection_probability": 0.0}, r"detection_probability 0.0: must lie in \(0, 1\]"),
        ({"detection_probability": (0.5, 1.1)}, r"must lie in \(0, 1\]"),
        ({"initial_velocity_std": (1.0, 2.0)}, "must be three positive numbers"),
        ({"initial_velocity_std": (1.0, 2.0, 0.0)}, "must be three positive numbers"),
        ({"outlier_test": "chi2"}, "outlier_test 'chi2': must be None or one of 'conditioned', 'coplanarity'"),
    ],
)
@pytest.mark.parametrize("name", ANGLE_TRACKERS)
def test_bad_settings_are_refused(name, settings, words):
    with pytest.raises(ValueError, match=words):
        ANGLE_TRACKERS[name](**settings)


def test_settings_that_do_not_fit_the_scan_are_refused():
    track = random_tracks(np.random.default_rng(28), 1, 1)
    scan = make_scan(np.zeros((1, 2, 1, 2)))
    with pytest.raises(ValueError, match="detection_probability has 3 values: must be one number or 2"):
        AnglePdaf(detection_probability=(0.9, 0.9, 0.9)).update(track, scan)
    with pytest.raises(ValueError, match="sensors are not compared"):
        AnglePdafSequential(outlier_test="coplanarity")
    with pytest.raises(ValueError, match="must have length 3"):
        AngleEkf().update(track, scan._replace(platforms=scan.platforms[..., :2]))
    with pytest.raises(ValueError, match="must have length 6"):
        AngleEkf().predict(Gaussian(track.mean[..., :4], track.cov[..., :4, :4]), 2.0)


@pytest.mark.parametrize("name", ANGLE_TRACKERS)
def test_numbers_that_are_none_are_refused_before_they_spread(name):
    tracker, track = ANGLE_TRACKERS[name](), random_tracks(np.random.default_rng(30), 2, 1)
    good = make_scan(np.full((2, 2, 3, 2), 0.1))
    for field, at, value, words in (
        ("angles", (1, 0, 2, 1), math.nan, r"scan.angles\[1, 0, 2, 1\] is nan: must be finite"),
        ("platforms", (0, 1, 2), math.inf, r"scan.platforms\[0, 1, 2\] is inf: must be finite"),
        ("angle_std", (1, 1, 0), 0.0, r"scan.angle_std\[1, 1, 0\] is 0.0: must be positive"),
        ("angle_std", (1, 1, 0), math.nan, r"scan.angle_std\[1, 1, 0\] is nan: must be positive"),
        ("angle_std", (0, 1, 1), math.inf, r"scan.angle_std\[0, 1, 1\] is inf: must be positive, 1000 rad at most"),
        ("clutter_density", (1, 0), math.inf, r"scan.clutter_density\[1, 0\] is inf: must be finite"),
    ):
        bad = getattr(good, field).copy()
        bad[at] = value
        for call in (tracker.initiate, lambda scan: tracker.update(track, scan)):
            with pytest.raises(ValueError, match=words):
                call(good._replace(**{field: bad}))


def test_flags_that_are_shares_are_refused():
    """An availability of 0.9 must not silently count as "available"."""
    track, good = random_tracks(np.random.default_rng(32), 2, 1), make_scan(np.full((2, 2, 3, 2), 0.1))
    for field in ("valid", "available"):
        bad = good._replace(**{field: 0.9 * getattr(good, field)})
        with pytest.raises(ValueError, match=f"scan.{field} holds float64: must be bool"):
            AnglePdaf().update(track, bad)


@pytest.mark.parametrize("available", [-0.1, 1.1, math.nan, np.array([[1.0, 1.0], [1.0, 2.0]])])
def test_bounds_refuse_shares_that_are_none(available):
    truth, std = np.array([24e3, -3e3, 8e3, -150.0, 0.0, 0.0]), np.full((2, 2), STD)
    start = bound_start(truth, PLATFORMS, std, (200.0, 200.0, 50.0))
    path, places = np.tile(truth, (2, 1)), np.tile(PLATFORMS, (2, 1, 1))
    for bound in (
        lambda: bound_start(truth, PLATFORMS, std, (200.0, 200.0, 50.0), available),
        lambda: advance(start, truth, PLATFORMS, 2.0, 30.0, std, available),
        lambda: posterior_bound_information_3d(path, places, start, std, 2.0, 30.0, available),
    ):
        with pytest.raises(ValueError, match=r"available holds .*must lie in \[0, 1\]"):
            bound()


@pytest.mark.parametrize("name", ["angle_pdaf", "angle_nn", "angle_pdaf_sequential"])
@pytest.mark.parametrize("density", [1e-320, 1e-300, 1e300])
def test_extreme_clutter_densities_leave_finite_numbers(name, density):
    rng = np.random.default_rng(33)
    track = random_tracks(rng, 20)
    update = ANGLE_TRACKERS[name]().update(as_state(track), cluttered_scan(rng, track, 5, density=density))
    assert all(np.isfinite(part).all() for part in (*update.posterior, *update[1:]))


def test_clutter_density_that_is_unknown_is_estimated():
    """Zero, NaN and clutter_known=False all mean m/V."""
    rng = np.random.default_rng(29)
    track = random_tracks(rng, 20)
    state, scan = as_state(track), cluttered_scan(rng, track, 5)
    estimated = AnglePdaf(clutter_known=False).update(state, scan).posterior.mean
    for unknown in (0.0, math.nan, -1.0):
        other = scan._replace(clutter_density=np.full((20, 2), unknown))
        np.testing.assert_array_equal(AnglePdaf().update(state, other).posterior.mean, estimated)
    assert not np.array_equal(AnglePdaf().update(state, scan).posterior.mean, estimated)


def test_registry_holds_filters_with_the_agreed_settings():
    assert list(ANGLE_TRACKERS) == ["angle_ekf", "angle_pdaf", "angle_nn", "angle_pdaf_sequential"]
    for kind in ANGLE_TRACKERS.values():
        assert issubclass(kind, AngleFilter)
        assert replace(kind(), gate=9.21).gate == 9.21
        assert kind() == kind(30.0, 16.0, 18.47, 1.0, True, (200.0, 200.0, 50.0), None, False)
