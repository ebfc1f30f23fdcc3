"""Converted measurements and their fusion: moments by two routes, closed forms, filters, honesty, bad input."""

import itertools
from typing import Any

import numpy as np
import pytest
from scipy.stats import multivariate_normal

from trackers import ConvertedFusion, Gaussian, Layout, PolarScan
from trackers.consistency import mean_band
from trackers.converted_fusion import FusionState, fuse_tracks
from trackers.converted_measurement import averaged_moments, convert, moments, polar, ranging_of
from trackers.direction import direction, direction_jacobian
from trackers.motion_3d import process_noise_3d, transition_3d

ORIGIN = np.zeros(3)
CASES = {"1 and 1 deg": (50.0, 1.0, 1.0), "1 and 3 deg": (50.0, 1.0, 3.0), "12 and 6 deg": (5e3, 12.0, 6.0)}
"""Range [m], azimuth, elevation [deg] of the specification's three cases."""
LOOK = np.array([200e3, 0.7, np.deg2rad(17.0)])
SCANS = 51


def accuracy(std):
    return np.array([std[0], *np.deg2rad(std[1:])])


def layout(positions, std=(50.0, 1.0, 1.0), ranging=None):
    positions = np.asarray(positions, dtype=float)
    n = positions.shape[-2]
    return Layout(positions, np.tile(accuracy(std), (n, 1)), np.ones(n, bool) if ranging is None else np.array(ranging))


PAIR = layout([[0.0, 0.0, 0.0], [12e3, 68e3, 500.0]])


def straight_path(scans=SCANS):
    t = np.arange(scans)[:, None]
    return np.concatenate([[200e3, 0.0, 10e3] + t * [-300.0, 0.0, 0.0], np.tile([-300.0, 0, 0], (scans, 1))], axis=1)


def drifting_paths(runs, rng):
    """The straight path with the white acceleration of 1 m/s² that the filter believes in."""
    paths = np.broadcast_to(straight_path(), (runs, SCANS, 6)).copy()
    off = np.zeros((runs, 6))
    for k in range(1, SCANS):
        push = rng.standard_normal((runs, 3))
        off = off @ transition_3d(1.0).T + np.concatenate([0.5 * push, push], axis=-1)
        paths[:, k] += off
    return paths


# ------------------------------------------------------------------------------------------------ moments


@pytest.mark.parametrize("std", CASES.values(), ids=CASES)
def test_moments_within_03_percent_of_monte_carlo(std):
    """Four million samples; covariances relative to the two axes' deviations, the bias within five standard errors."""
    sd, truth = accuracy(std), convert(LOOK, ORIGIN)
    rng, total, square = np.random.default_rng(0), np.zeros(3), np.zeros((3, 3))
    for _ in range(16):
        error = convert(LOOK + sd * rng.standard_normal((250_000, 3)), ORIGIN) - truth
        total += error.sum(0)
        square += error.T @ error
    mean = total / 4e6
    cov = square / 4e6 - np.outer(mean, mean)
    found = moments(truth, ORIGIN, sd)
    spread = np.sqrt(np.diag(cov))
    np.testing.assert_allclose(found.cov / np.outer(spread, spread), cov / np.outer(spread, spread), atol=0.003)
    np.testing.assert_allclose(np.diag(found.cov), np.diag(cov), rtol=0.003)
    assert (np.abs(found.bias - mean) < 5.0 * spread / np.sqrt(4e6)).all()


def printed_xyzw(r, beta, sr, sb, st):
    """The specification's corrected x, y, z, w as they stand."""
    eb, et, s = np.exp(-(sb**2)), np.exp(-(st**2)), r * r + sr * sr
    B, c2 = 1 - eb**2 + 2 * eb**2 * np.cos(beta) ** 2, np.cos(beta) ** 2
    x = s * (1 - et**2) * B / 4
    y = s * et**2 * B / 2 - r * r * et * eb * c2
    z = s * (1 - eb**2) / 2 + (r * r * (1 - 1 / eb) + sr * sr) * eb**2 * np.sin(beta) ** 2
    w = (-r * r * np.sqrt(et) * eb + s * np.sqrt(et) * eb**2) * np.cos(beta) * np.sin(beta)
    return x, y, z, w


@pytest.mark.parametrize("std", CASES.values(), ids=CASES)
def test_moments_are_the_corrected_equations(std):
    """Eqs 5–10 as printed and corrected, the bias, and the trace of eqs 11 and 12."""
    sr, st, sb = accuracy(std)
    r, theta, beta = LOOK
    x, y, z, w = printed_xyzw(r, beta, sr, sb, st)
    c, q = np.cos(theta), np.sin(theta)
    printed = [[x + y * c * c, y * c * q, w * c], [y * c * q, x + y * q * q, w * q], [w * c, w * q, z]]
    truth, station = convert(LOOK, ORIGIN), np.array([3e3, -2e3, 100.0])
    found = moments(truth + station, station, accuracy(std))
    np.testing.assert_allclose(found.cov, printed, rtol=1e-8)
    lb, lt = np.exp(-(sb**2) / 2), np.exp(-(st**2) / 2)
    np.testing.assert_allclose(found.bias, [(lb * lt - 1), (lb * lt - 1), lb - 1] * truth, rtol=1e-10)
    trace = r**2 * (1 - lb**2 * (lt**2 * np.cos(beta) ** 2 + np.sin(beta) ** 2)) + sr**2
    np.testing.assert_allclose(np.trace(found.cov), trace, rtol=1e-10)


@pytest.mark.parametrize("std", CASES.values(), ids=CASES)
def test_averaged_moments_are_means_over_what_a_measurement_leaves_open(std):
    """Second route: Gauss–Hermite quadrature of the moments given the truth."""
    sd = accuracy(std)
    nodes, weights = np.polynomial.hermite_e.hermegauss(30)
    weights = weights / weights.sum()
    grid = np.array(list(itertools.product(nodes, repeat=3)))
    share = np.prod(np.array(list(itertools.product(weights, repeat=3))), axis=1)
    truth = moments(convert(LOOK - sd * grid, ORIGIN), ORIGIN, sd)
    found = averaged_moments(LOOK, sd)
    np.testing.assert_allclose(found.bias, share @ truth.bias, rtol=1e-9)
    np.testing.assert_allclose(found.cov, np.einsum("s,sij->ij", share, truth.cov), rtol=1e-8)


def test_sharp_angles_leave_the_range_error():
    """With angles a thousand times sharper than usual R is σ_r² along the line of sight: nothing cancels."""
    truth = convert(LOOK, ORIGIN)
    u = truth / np.linalg.norm(truth)
    R = moments(truth, ORIGIN, np.array([1.0, 1e-9, 1e-9])).cov
    np.testing.assert_allclose(R, np.outer(u, u), atol=1e-5)


def closed_form_trace(one, two, theta):
    """Eq 18."""
    (x1, y1, z1, w1), (x2, y2, z2, w2) = one, two
    c = np.cos(theta)
    top = (
        (x1 + x2) * ((x1 + y1 + z1) * (x2 * z2 + y2 * z2 - w2**2) + (x2 + y2 + z2) * (x1 * z1 + y1 * z1 - w1**2))
        + x1 * x2 * ((x1 + y1 + x2 + y2) * (z1 + z2) - w1**2 - w2**2)
        - 2 * x1 * x2 * w1 * w2 * c
        + (y2 * z2 - w2**2) * (y1 * z1 - w1**2) * np.sin(theta) ** 2
    )
    bottom = (
        (x1 + x2 + y1) * (x1 * z2 + x2 * z2 + y2 * z2 - w2**2)
        + (x1 + x2 + y2) * (x1 * z1 + x2 * z1 + y1 * z1 - w1**2)
        - 2 * w1 * w2 * (x1 + x2) * c
        - (y1 * y2 * (z1 + z2) - y2 * w1**2 - y1 * w2**2) * c**2
    )
    return top / bottom


def equal_sensors_trace(one, theta):
    """Eq 19."""
    x, y, z, w = one
    c, q2, v = np.cos(theta), np.sin(theta) ** 2, z * x + z * y - w * w
    top = 4 * x * (x + y) * (v + z * x) + 4 * z * x * v - 2 * w**2 * x**2 * (1 + c) + (w**2 - z * y) ** 2 * q2
    return top / (8 * z * x * (x + y) - 4 * w**2 * x * (1 + c) - 2 * y * (w**2 - z * y) * q2)


def test_closed_form_traces_equal_inversion():
    """Eqs 18 and 19 against inverted matrices."""
    sd = np.array([5e3, np.deg2rad(4.0), np.deg2rad(3.0)])
    for range_2, beta_2, theta in ((140e3, 0.3, 0.5), (70e3, -0.2, 2.0), (200e3, 0.1, 0.05)):
        looks = np.array([[100e3, 0.4, 0.15], [range_2, 0.4 - theta, beta_2]])
        covs = moments(convert(looks, ORIGIN), ORIGIN, sd).cov
        fused = np.trace(np.linalg.inv(np.linalg.inv(covs).sum(0)))
        terms = [printed_xyzw(r, beta, sd[0], sd[2], sd[1]) for r, _, beta in looks]
        assert closed_form_trace(terms[0], terms[1], theta) == pytest.approx(fused, rel=1e-12)
        looks[1, 0], looks[1, 2] = looks[0, 0], looks[0, 2]
        covs = moments(convert(looks, ORIGIN), ORIGIN, sd).cov
        fused = np.trace(np.linalg.inv(np.linalg.inv(covs).sum(0)))
        assert equal_sensors_trace(terms[0], theta) == pytest.approx(fused, rel=1e-12)


# ------------------------------------------------------------------------------------------------ filters


class Reference:
    """The same filter in plain matrices: a Kalman filter on stacked converted measurements, one run."""

    def __init__(self, linearisation="fused", T=1.0, q=1.0):
        self.linearisation, self.F, self.Q, self.T, self.q = (
            linearisation,
            transition_3d(T),
            process_noise_3d(T, q),
            T,
            q,
        )

    def debiased(self, z, at, layout):
        """Positions [n, 3] and covariances [n, 3, 3] evaluated at `at` [n, 3], or averaged where it is None."""
        found = averaged_moments(z, layout.std) if at is None else moments(at, layout.position, layout.std)
        return convert(z, layout.position) - found.bias, found.cov

    def fuse(self, position, cov):
        R = np.linalg.inv(np.linalg.inv(cov).sum(0))
        return R @ np.linalg.solve(cov, position[..., None]).sum(0)[:, 0], R

    def start(self, first, second):
        (p1, R1), (p2, R2) = first, second
        vv = (R1 + R2) / self.T**2 + 0.25 * self.T**2 * self.q**2 * np.eye(3)
        return np.concatenate([p2, (p2 - p1) / self.T]), np.block([[R2, R2 / self.T], [R2 / self.T, vv]])

    def predict(self, x, P):
        return self.F @ x, self.F @ P @ self.F.T + self.Q

    def update(self, x, P, position, R):
        S = P[:3, :3] + R
        K = P[:, :3] @ np.linalg.inv(S)
        return x + K @ (position - x[:3]), P - K @ S @ K.T

    def run(self, z, path, layout):
        n = len(layout.position)
        places = [path[k, :3] if self.linearisation == "truth" else None for k in (0, 1)]
        starts = [self.debiased(z[k], places[k], layout) for k in (0, 1)]
        if self.linearisation == "fused":
            starts = [self.debiased(z[k], self.fuse(*starts[k])[0], layout) for k in (0, 1)]
        x, P = self.start(*(self.fuse(*scan) for scan in starts))
        own = [self.start(*((p[i], R[i]) for p, R in starts)) for i in range(n)]
        for k in range(2, len(z)):
            x, P = self.predict(x, P)
            own = [self.predict(*track) for track in own]
            places = {"fused": np.tile(x[:3], (n, 1)), "local": np.array([track[0][:3] for track in own]),
                      "truth": np.tile(path[k, :3], (n, 1)), "measurement": None}  # fmt: skip
            position, R = self.debiased(z[k], places[self.linearisation], layout)
            own = [self.update(*track, position[i], R[i]) for i, track in enumerate(own)]
            x, P = self.update(x, P, *self.fuse(position, R))
        return x, P


def measured(path, layout, noise):
    return polar(path[..., None, :], layout.position) + layout.std * noise


@pytest.mark.parametrize("linearisation", ["local", "fused", "measurement", "truth"])
def test_whole_episode_equals_a_filter_of_plain_matrices(linearisation):
    rng = np.random.default_rng(1)
    path, noise = drifting_paths(1, rng)[0], rng.standard_normal((SCANS, 2, 3))
    track = ConvertedFusion(linearisation=linearisation).track(path, PAIR, noise)
    x, P = Reference(linearisation).run(measured(path, PAIR, noise), path, PAIR)
    np.testing.assert_allclose(track.mean[-1], x, rtol=1e-7, atol=1e-4)
    np.testing.assert_allclose(track.cov[-1], P, rtol=1e-6, atol=1e-4)
    assert track.position_error_m[-1] == pytest.approx(np.linalg.norm(x[:3] - path[-1, :3]), rel=1e-6)


def stepwise(tracker, z, layout):
    state, updates = tracker.initiate(PolarScan(z[..., 0, :, :], layout)), []
    for k in range(1, z.shape[-3]):
        updates.append(tracker.update(tracker.predict(state, layout), PolarScan(z[..., k, :, :], layout)))
        state = updates[-1].posterior
    return updates


@pytest.mark.parametrize("linearisation", ["local", "fused", "iterated", "measurement"])
@pytest.mark.parametrize("ranging", [(True, True), (True, False), (False, False)])
def test_verbs_equal_the_whole_episode(linearisation, ranging):
    rng = np.random.default_rng(3)
    paths, noise = drifting_paths(3, rng), rng.standard_normal((3, SCANS, 2, 3))
    sensors, tracker = PAIR._replace(ranging=np.array(ranging)), ConvertedFusion(linearisation=linearisation)
    track = tracker.track(paths, sensors, noise)
    updates = stepwise(tracker, measured(paths, PAIR, noise), sensors)
    for k in (0, 1, 20, SCANS - 2):
        mean, cov = tracker.estimate(updates[k].posterior)
        np.testing.assert_allclose(mean, track.mean[:, k + 1], rtol=1e-7, atol=1e-4)
        np.testing.assert_allclose(cov, track.cov[:, k + 1], rtol=1e-6, atol=1e-3)


def test_distributed_fusion_without_feedback_equals_central_fusion():
    """Each sensor's own track and the information form, against the centre's filter, to 1e-12 of the scales."""
    rng = np.random.default_rng(4)
    layout_3 = layout([[0.0, 0.0, 0.0], [12e3, 68e3, 500.0], [60e3, -90e3, 2e3]])
    paths, noise = drifting_paths(5, rng), rng.standard_normal((5, SCANS, 3, 3))
    z, tracker = measured(paths, layout_3, noise), ConvertedFusion(linearisation="local")
    state = tracker.initiate(PolarScan(z[:, 0], layout_3))
    state = tracker.update(tracker.predict(state, layout_3), PolarScan(z[:, 1], layout_3)).posterior
    worst = 0.0
    for k in range(2, SCANS):
        prior = tracker.predict(state, layout_3)
        state = tracker.update(prior, PolarScan(z[:, k], layout_3)).posterior
        fused = fuse_tracks(
            Gaussian(prior.mean, prior.cov),
            Gaussian(prior.local_mean, prior.local_cov),
            Gaussian(state.local_mean, state.local_cov),
        )
        std = np.sqrt(np.diagonal(state.cov, axis1=-2, axis2=-1))
        scale = std[..., :, None] * std[..., None, :]
        worst = max(worst, np.abs((fused.cov - state.cov) / scale).max())
        worst = max(worst, (np.abs(fused.mean - state.mean) / np.linalg.norm(state.mean, axis=-1, keepdims=True)).max())
    assert worst < 1e-12


def test_angles_only_update_is_an_extended_kalman_filter():
    rng = np.random.default_rng(5)
    sensors = PAIR._replace(ranging=np.array([False, False]))
    path = drifting_paths(1, rng)[0]
    z = measured(path, PAIR, rng.standard_normal((SCANS, 2, 3)))
    tracker = ConvertedFusion()
    state = stepwise(tracker, z[:20], sensors)[-1].posterior
    prior = tracker.predict(state, sensors)
    update = tracker.update(prior, PolarScan(z[20], sensors))
    H = np.zeros((4, 6))
    H[:, :3] = direction_jacobian(prior.mean, sensors.position).reshape(4, 3)
    R, nu = np.diag(sensors.std[:, 1:].ravel() ** 2), (z[20, :, 1:] - direction(prior.mean, sensors.position)).ravel()
    S = H @ prior.cov @ H.T + R
    K = prior.cov @ H.T @ np.linalg.inv(S)
    np.testing.assert_allclose(update.posterior.mean, prior.mean + K @ nu, rtol=1e-9, atol=1e-6)
    np.testing.assert_allclose(update.posterior.cov, prior.cov - K @ S @ K.T, rtol=1e-7, atol=1e-5)
    np.testing.assert_allclose(update.innovation[:, 1:].ravel(), nu, rtol=1e-12)
    np.testing.assert_array_equal(update.innovation[:, 0], 0.0)
    assert update.nis == pytest.approx(nu @ np.linalg.solve(S, nu), rel=1e-9)
    assert update.log_likelihood == pytest.approx(multivariate_normal(np.zeros(4), S).logpdf(nu), rel=1e-9)


def test_likelihood_of_a_mixed_scan_is_the_joint_density():
    """Second route: one Gaussian of the stacked converted position and angles."""
    rng = np.random.default_rng(6)
    sensors = PAIR._replace(ranging=np.array([True, False]))
    z = measured(drifting_paths(1, rng)[0], PAIR, rng.standard_normal((SCANS, 2, 3)))
    tracker = ConvertedFusion(linearisation="fused")
    prior = tracker.predict(stepwise(tracker, z[:10], sensors)[-1].posterior, sensors)
    update = tracker.update(prior, PolarScan(z[10], sensors))
    found = moments(prior.mean, sensors.position[0], sensors.std[0])
    position = convert(z[10, 0], sensors.position[0]) - found.bias
    H, R = np.zeros((5, 6)), np.zeros((5, 5))
    H[:3, :3], H[3:, :3] = np.eye(3), direction_jacobian(prior.mean, sensors.position[1])
    R[:3, :3], R[3:, 3:] = found.cov, np.diag(sensors.std[1, 1:] ** 2)
    nu = np.concatenate([position - prior.mean[:3], z[10, 1, 1:] - direction(prior.mean, sensors.position[1])])
    S = H @ prior.cov @ H.T + R
    assert update.nis == pytest.approx(nu @ np.linalg.solve(S, nu), rel=1e-8)
    log_density = -0.5 * (nu @ np.linalg.solve(S, nu) + np.linalg.slogdet(2.0 * np.pi * S)[1])
    assert update.log_likelihood == pytest.approx(log_density, rel=1e-8)


def test_azimuth_wraps():
    """A target that crosses the line behind the sensor, azimuth ±180°, is tracked by angles alone."""
    t = np.arange(SCANS)[:, None]
    path = np.concatenate([[-100e3, 6e3, 10e3] + t * [0.0, -300.0, 0.0], np.tile([0.0, -300.0, 0], (SCANS, 1))], axis=1)
    sensors = layout([[0.0, 0.0, 0.0], [-90e3, -80e3, 0.0]], std=(50.0, 0.1, 0.1), ranging=[False, False])
    rng = np.random.default_rng(7)
    track = ConvertedFusion().track(path, sensors, rng.standard_normal((SCANS, 2, 3)))
    assert track.position_error_m[-1] < 5.0 * np.sqrt(np.trace(track.cov[-1, :3, :3])) < 1e3


# ------------------------------------------------------------------------------------------------ theory


@pytest.mark.parametrize("ranging", [(True, True), (True, False)])
def test_theory_equals_the_recursion_in_plain_matrices(ranging):
    path, sensors = straight_path(), PAIR._replace(ranging=np.array(ranging))
    theory = ConvertedFusion().theoretical(path, sensors)

    def information(k):
        Y = np.zeros((3, 3))
        for i in range(2):
            J = direction_jacobian(path[k], PAIR.position[i])
            only = J.T @ np.diag(PAIR.std[i, 1:] ** -2.0) @ J
            Y += np.linalg.inv(moments(path[k, :3], PAIR.position[i], PAIR.std[i]).cov) if ranging[i] else only
        return Y

    reference = Reference()
    x, P = reference.start(*((path[k, :3], np.linalg.inv(information(k))) for k in (0, 1)))
    for k in range(2, SCANS):
        x, P = reference.predict(x, P)
        x, P = reference.update(x, P, path[k, :3], np.linalg.inv(information(k)))
    np.testing.assert_allclose(theory.cov, P, rtol=1e-7, atol=1e-6)
    assert theory.position_std_m[-1] == pytest.approx(np.sqrt(np.trace(P[:3, :3])), rel=1e-9)


def test_theory_of_moving_sensors_that_stand_still_is_that_of_standing_ones():
    path, rng = straight_path(), np.random.default_rng(8)
    still = PAIR._replace(position=np.tile(PAIR.position, (SCANS, 1, 1)))
    tracker, noise = ConvertedFusion(), rng.standard_normal((SCANS, 2, 3))
    np.testing.assert_array_equal(
        tracker.theoretical(path, still, moving=True).cov, tracker.theoretical(path, PAIR).cov
    )
    there = tracker.track(path, still, noise, moving=True)
    np.testing.assert_array_equal(there.mean, tracker.track(path, PAIR, noise).mean)
    nearer = still._replace(position=still.position + np.arange(SCANS)[:, None, None] * [500.0, 0.0, 0.0])
    closing = tracker.theoretical(path, nearer, moving=True).position_std_m[-1]
    standing = tracker.theoretical(path, PAIR).position_std_m[-1]
    assert 0.5 * standing < closing < 0.95 * standing


def test_batch_equals_loop_and_may_be_empty():
    rng = np.random.default_rng(9)
    candidates = PAIR._replace(position=PAIR.position + rng.uniform(0.0, 20e3, (7, 2, 3)))
    paths, noise = drifting_paths(4, rng), rng.standard_normal((4, SCANS, 2, 3))
    tracker = ConvertedFusion()
    many = tracker.theoretical(paths[:, None], candidates)
    assert many.position_std_m.shape == (4, 7, SCANS)
    for i, j in ((0, 0), (3, 6), (2, 1)):
        one = tracker.theoretical(paths[i], candidates._replace(position=candidates.position[j]))
        np.testing.assert_array_equal(one.cov, many.cov[i, j])
    tracks = tracker.track(paths, PAIR, noise)
    np.testing.assert_array_equal(tracker.track(paths[2], PAIR, noise[2]).cov, tracks.cov[2])
    assert tracker.track(paths[:0], PAIR, noise[:0]).mean.shape == (0, SCANS, 6)
    assert tracker.theoretical(paths[:0], PAIR).cov.shape == (0, 6, 6)


# ------------------------------------------------------------------------------------------------ honesty


def mean_nees(track, paths, last=10):
    """Per run, the mean of the last scans' NEES: scans of a run are correlated, runs are not."""
    error = (track.mean - paths)[:, -last:]
    return np.einsum("rki,rki->rk", error, np.linalg.solve(track.cov[:, -last:], error[..., None])[..., 0]).mean(1)


@pytest.fixture(scope="module")
def thousand():
    rng = np.random.default_rng(10)
    return drifting_paths(1000, rng), rng.standard_normal((1000, SCANS, 2, 3))


def test_oracle_is_honest(thousand):
    """Section 9: NEES 6.0 with R at the truth, one scan of each run against its χ² band; so is the error."""
    paths, noise = thousand
    track = ConvertedFusion(linearisation="truth").track(paths, PAIR, noise)
    low, high = mean_band(6, 1000)
    assert low < mean_nees(track, paths, last=1).mean() < high
    theory = ConvertedFusion().theoretical(straight_path(), PAIR).position_std_m[-1]
    squares = track.position_error_m[:, -1] ** 2
    assert abs(squares.mean() - theory**2) < 4.0 * squares.std() / np.sqrt(1000)


def test_nees_of_section_9(thousand):
    """Prediction 8.5 to 10, averaged measurement 23 to 35, feedback closer to 6 than the sensors' own tracks."""
    paths, noise = thousand
    found = {}
    for linearisation in ("local", "fused", "iterated", "measurement"):
        nees = mean_nees(ConvertedFusion(linearisation=linearisation).track(paths, PAIR, noise), paths)
        found[linearisation] = nees.mean(), 4.0 * nees.std() / np.sqrt(1000)
    for name, (low, high) in {"local": (8.5, 10.0), "measurement": (23.0, 35.0)}.items():
        mean, band = found[name]
        assert low - band < mean < high + band
    assert found["iterated"][0] < found["fused"][0] < found["local"][0] < found["measurement"][0]


def test_feedback_recovers_what_the_local_predictions_lose_all_round(thousand):
    """Three radars all round: local a tenth worse than the oracle or more, feedback within 3 %, same numbers."""
    rng, (paths, _) = np.random.default_rng(12), thousand
    around = np.pi + np.deg2rad([0.0, 120.0, -120.0])
    sensors = layout(200e3 * np.stack([1.0 + np.cos(around), np.sin(around), np.zeros(3)], axis=-1))
    noise, rmse = rng.standard_normal((1000, SCANS, 3, 3)), {}
    for name in ("local", "fused", "iterated", "truth"):
        track = ConvertedFusion(linearisation=name).track(paths, sensors, noise)
        rmse[name] = np.sqrt((track.position_error_m[:, -10:] ** 2).mean())
    assert rmse["local"] > 1.1 * rmse["truth"]
    assert max(rmse["fused"], rmse["iterated"]) < 1.03 * rmse["truth"]


# ------------------------------------------------------------------------------------------------ bad input

GOOD = {"path": straight_path(), "noise": np.zeros((SCANS, 2, 3))}


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"position": PAIR.position - [0.0, 0.0, 1.0]}, "sensor 0 .* under ground"),
        ({"position": PAIR.position * np.nan}, "must be finite"),
        ({"position": np.zeros((2, 2))}, "must be .* n, 3"),
        ({"std": PAIR.std * [1.0, 1.0, 0.0]}, r"sensor 0 .* std .* must be positive"),
        ({"std": PAIR.std * [1.0, -1.0, 1.0]}, "must be positive"),
        ({"std": PAIR.std * [[1.0, 1.0, 1.0], [np.nan, 1.0, 1.0]]}, "sensor 1 .* must be positive"),
        ({"ranging": np.array([1, 1])}, "must be bool"),
        ({"position": np.array([[0.0, 0.0, 0.0], [190e3, 0.0, 10e3]])}, "sensor 1 .* comes within .* minimum range"),
    ],
)
def test_layouts_that_cannot_be_are_named(change, words):
    for call in (
        lambda sensors: ConvertedFusion().track(GOOD["path"], sensors, GOOD["noise"]),
        lambda sensors: ConvertedFusion().theoretical(GOOD["path"], sensors),
    ):
        with pytest.raises(ValueError, match=words):
            call(PAIR._replace(**change))


def test_range_accuracy_of_a_sensor_without_range_does_not_matter():
    std = PAIR.std.copy()
    std[1, 0] = 0.0
    mixed = PAIR._replace(ranging=np.array([True, False]))
    cov = ConvertedFusion().theoretical(GOOD["path"], mixed._replace(std=std)).cov
    np.testing.assert_array_equal(cov, ConvertedFusion().theoretical(GOOD["path"], mixed).cov)


def test_other_bad_input():
    tracker, path, noise = ConvertedFusion(), GOOD["path"], GOOD["noise"]
    for bad, words in ((path[:, :5], "path has shape"), (path[:1], "two scans"), (path + np.inf, "finite")):
        with pytest.raises(ValueError, match=words):
            tracker.theoretical(bad, PAIR)
    for bad in (noise[:, :1], noise[1:], noise * np.nan):
        with pytest.raises(ValueError, match="noise has shape"):
            tracker.track(path, PAIR, bad)
    with pytest.raises(ValueError, match="layout moves"):
        tracker.theoretical(path, PAIR, moving=True)
    with pytest.raises(ValueError, match="'radar': must be one of 'range_az_el', 'az_el'"):
        ranging_of(["az_el", "radar"])
    np.testing.assert_array_equal(ranging_of(["az_el", "range_az_el"]), [False, True])
    z = measured(path[0], PAIR, noise[0])
    for bad, words in ((z[:1], "one row per sensor"), (z * np.nan, "NaN"), (z * [-1.0, 1.0, 1.0], "must be positive")):
        with pytest.raises(ValueError, match=words):
            tracker.initiate(PolarScan(bad, PAIR))
    with pytest.raises(ValueError, match="does not say what is true"):
        ConvertedFusion(linearisation="truth").initiate(PolarScan(z, PAIR))
    settings: dict[str, Any] = {
        "step_s": 0.0, "acceleration_std": -1.0, "linearisation": "best", "expected_range_m": np.inf,
        "velocity_std": 0.0, "minimum_range_m": -1.0,
    }  # fmt: skip
    for field, value in settings.items():
        with pytest.raises(ValueError, match=f"ConvertedFusion.{field} = .*: must be"):
            ConvertedFusion(**{field: value})


@pytest.mark.parametrize("ranging", [(True, True), (True, False), (False, False)])
def test_nothing_but_finite_numbers_come_out(ranging):
    """Sensors at one place, above each other, a target overhead, noise of several σ and accuracies of 30 deg."""
    rng = np.random.default_rng(11)
    path = straight_path()
    places = [[[0, 0, 0], [0, 0, 0]], [[190e3, 0, 0], [190e3, 0, 500]], [[0, 0, 0], [400e3, 0, 0]]]
    for std in ((50.0, 1.0, 1.0), (1e4, 30.0, 30.0), (1e-2, 1e-5, 1e-5)):
        sensors = layout(places, std, ranging)._replace(std=np.tile(accuracy(std), (2, 1)), ranging=np.array(ranging))
        for linearisation in ("local", "fused", "iterated", "measurement", "truth"):
            track = ConvertedFusion(linearisation=linearisation).track(
                path, sensors, 3.0 * rng.standard_normal((20, 1, SCANS, 2, 3))
            )
            assert all(np.isfinite(part).all() for part in track)
            assert (np.diagonal(track.cov, axis1=-2, axis2=-1) > 0.0).all()
        theory = ConvertedFusion().theoretical(path, sensors)
        assert np.isfinite(theory.position_std_m).all()
        assert (np.linalg.eigvalsh(theory.cov) > 0.0).all()


def test_state_of_one_scan_waits_for_its_second():
    z = measured(straight_path(), PAIR, np.zeros((SCANS, 2, 3)))
    tracker = ConvertedFusion()
    state = tracker.initiate(PolarScan(z[0], PAIR))
    assert isinstance(state, FusionState)
    np.testing.assert_array_equal(tracker.predict(state, PAIR).cov, state.cov)
    np.testing.assert_array_equal(state.mean[3:], 0.0)
    assert state.cov[3, 3] == 300.0**2
