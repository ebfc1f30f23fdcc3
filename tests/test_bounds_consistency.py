"""Bounds against independent routes, and whether the two-station filter is honest about its errors."""

import math

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.stats import chi2

from trackers import FusedEkf, RpEkf, Scan
from trackers.bounds import (
    bound_predict,
    bound_prior,
    bound_update,
    fisher_information,
    gdop,
    posterior_bound_information,
    range_std,
)
from trackers.consistency import mean_band, nees, nis
from trackers.measurement import bearing
from trackers.motion import process_noise, transition

STATIONS = np.array([[-6e3, 1e3], [5e3, -2e3]])

# ------------------------------------------------------------------------------------------------ bounds


def test_fisher_information_is_the_curvature_of_the_log_likelihood():
    """Second differences of −Σ (z − h)² / 2σ² at noise-free bearings."""
    position, std, h = np.array([9e3, 2.2e4]), 0.01, 5.0
    z = bearing(position, STATIONS)

    def log_likelihood(x):
        return -0.5 * ((z - bearing(x, STATIONS)) ** 2).sum() / std**2

    axes = np.eye(2) * h
    curvature = np.array(
        [
            [
                sum(a * b * log_likelihood(position + a * axes[i] + b * axes[j]) for a in (-1, 1) for b in (-1, 1))
                / (4 * h * h)
                for j in range(2)
            ]
            for i in range(2)
        ]
    )
    np.testing.assert_allclose(fisher_information(position, STATIONS, std), -curvature, rtol=1e-4)


def test_gdop_of_perpendicular_lines_has_a_closed_form():
    """Lines of sight east (7 km) and north (11 km): cross-range errors r₁σ and r₂σ are independent."""
    target, std = np.array([3e3, 4e3]), 0.02
    stations = np.array([[3e3 - 7e3, 4e3], [3e3, 4e3 - 11e3]])
    assert gdop(target, stations, std) == pytest.approx(std * math.hypot(7e3, 11e3))


def test_gdop_of_collinear_lines_is_infinite():
    stations = np.array([[0.0, 0.0], [1e3, 2e3]])
    assert np.isinf(gdop(np.array([5e3, 1e4]), stations, 0.01))
    assert np.isinf(gdop(np.array([5e3, 1e4]), stations[:1], 0.01))


def random_paths(rng, batch, steps):
    """True states [batch, k + 1, 4] and station positions [batch, k + 1, 2, 2], all turning."""
    heading = rng.uniform(-math.pi, math.pi, (batch, 1)) + 0.05 * np.arange(steps + 1)
    velocity = 220.0 * np.stack([np.cos(heading), np.sin(heading)], axis=-1)
    truth = np.concatenate([[2e4, 2.6e4] + 2.0 * velocity.cumsum(1), velocity], axis=-1)
    stations = STATIONS + 2.0 * rng.normal(0.0, 150.0, (batch, steps + 1, 2, 2)).cumsum(1)
    return truth, stations


@pytest.mark.parametrize("q", [0.0, 8.0])
def test_riccati_recursion_equals_the_information_form(q):
    truth, stations = random_paths(np.random.default_rng(1), 3, 25)
    std, used = math.radians(0.5), np.array([True, True])
    prior = bound_prior(truth[:, 0], stations[:, 0, -1], std, 1.5e4, 200.0)
    expected = posterior_bound_information(truth, stations, prior, std, 2.0, q)
    cov = prior
    for k in range(1, 26):
        cov = bound_update(bound_predict(cov, 2.0, q), truth[:, k], stations[:, k], used, std)
        scale = np.sqrt(np.diagonal(expected[:, k], axis1=1, axis2=2))
        np.testing.assert_allclose((cov - expected[:, k]) / scale[:, :, None] / scale[:, None, :], 0.0, atol=1e-7)


def test_information_form_equals_one_big_least_squares_problem():
    """Without process noise the bound is the inverse of all information, carried to the last instant at once."""
    truth, stations = random_paths(np.random.default_rng(2), 1, 12)
    std = 0.01
    prior = bound_prior(truth[:, 0], stations[:, 0, -1], std, 1.5e4, 200.0)[0]
    back = np.linalg.inv(transition(2.0))
    information = np.zeros((4, 4))
    information += np.linalg.matrix_power(back, 12).T @ np.linalg.inv(prior) @ np.linalg.matrix_power(back, 12)
    for k in range(1, 13):
        H = np.zeros((2, 4))
        for s in range(2):
            dx, dy = truth[0, k, :2] - stations[0, k, s]
            H[s, :2] = np.array([-dy, dx]) / (dx**2 + dy**2)
        H = H @ np.linalg.matrix_power(back, 12 - k)
        information += H.T @ H / std**2
    found = posterior_bound_information(truth, stations, prior[None], std, 2.0, 0.0)[0, -1]
    np.testing.assert_allclose(found, np.linalg.inv(information), rtol=1e-6)


def test_bound_prior_has_its_axes_along_and_across_the_line_of_sight():
    truth, station = np.array([4e3, 3e3, 0.0, 0.0]), np.array([1e3, -1e3])
    P = bound_prior(truth, station, 0.01, 700.0, 30.0)
    along = np.array([0.6, 0.8])
    np.testing.assert_allclose(P[:2, :2] @ along, 700.0**2 * along)
    np.testing.assert_allclose(P[:2, :2] @ [-0.8, 0.6], (5000.0 * 0.01) ** 2 * np.array([-0.8, 0.6]))
    np.testing.assert_array_equal(P[2:, 2:], 900.0 * np.eye(2))
    np.testing.assert_array_equal(P[:2, 2:], 0.0)
    assert range_std(P, truth, station) == pytest.approx(700.0)


def test_an_unused_station_adds_nothing_and_missed_bearings_scale_the_information():
    truth, stations = random_paths(np.random.default_rng(3), 4, 1)
    prior = bound_prior(truth[:, 0], stations[:, 0, -1], 0.01, 1.5e4, 200.0)
    one = bound_update(prior, truth[:, 0], stations[:, 0], np.array([False, True]), 0.01)
    np.testing.assert_array_equal(one, bound_update(prior, truth[:, 0], stations[:, 0, 1:], np.array([True]), 0.01))
    none = bound_update(prior, truth[:, 0], stations[:, 0], np.array([False, False]), 0.01)
    np.testing.assert_array_equal(none, prior)
    seldom = bound_update(prior, truth[:, 0], stations[:, 0], np.array([True, True]), 0.01, 0.25)
    both = np.array([True, True])
    np.testing.assert_allclose(seldom, bound_update(prior, truth[:, 0], stations[:, 0], both, 0.02), rtol=1e-9)


# ------------------------------------------------------------------------------------------------ consistency


def test_nees_and_nis_by_hand():
    assert nees([3.0, 4.0], np.diag([9.0, 4.0]), [0.0, 0.0]) == pytest.approx(5.0)
    assert nis(2 * math.pi - 0.2, 0.01) == pytest.approx(4.0)


def test_mean_band_holds_its_level():
    """The χ² density integrated over the band; mean of 50 variables of 4 degrees is χ²(200) / 50."""
    low, high = mean_band(4, 50, level=0.95)
    inside, _ = quad(lambda x: 50 * chi2.pdf(50 * x, 200), low, high)
    assert inside == pytest.approx(0.95)
    assert low < 4 < high


@pytest.fixture(scope="module")
def honest_runs():
    """The cross-fix filter on truth drawn from its own model."""
    return runs_of(FusedEkf(velocity_std=100.0, process_noise=4.0))


@pytest.fixture(scope="module")
def honest_bank_runs():
    """The bank, hypotheses and all, on the same truth."""
    return runs_of(RpEkf(velocity_std=100.0, process_noise=4.0))


def runs_of(tracker):
    """A tracker on truth drawn from its own model: 500 runs of one target, 25 scans, σ = 0.05°, q = 4 m/s.

    The first position is where it is; the cross-fix of the first two bearings is the filter's own draw of it. Initial
    velocity is N(0, σ_v²) about zero and every step adds G w, as the filter assumes. Geometry keeps bearings nearly
    linear over the errors: 20 km baseline, 25 km range. Returns NEES [k + 1, runs], NIS [k, runs, s].
    """
    rng, runs, steps, std = np.random.default_rng(20), 500, 25, math.radians(0.05)
    heading = np.array([[0.3], [2.0]]) + 0.04 * np.arange(steps + 1)
    stations = np.array([[-1e4, 0.0], [1e4, 0.0]])[:, None] + 2.0 * 200.0 * np.stack(
        [np.cos(heading), np.sin(heading)], axis=-1
    ).cumsum(1)
    truth = np.concatenate([np.tile([2e3, 2.4e4], (runs, 1)), rng.normal(0.0, 100.0, (runs, 2))], axis=1)
    root = np.linalg.svd(process_noise(2.0, 4.0))
    noise_root = root.U[:, :2] * np.sqrt(root.S[:2])

    def scan(k):
        z = bearing(truth[:, None], stations[:, k]) + rng.normal(0.0, std, (runs, 2))
        return Scan(z[..., None], np.ones((2, 1), bool), stations[:, k], std)

    state = tracker.initiate(scan(0))
    all_nees, all_nis = [], []
    for k in range(steps + 1):
        if k > 0:
            truth = truth @ transition(2.0).T + rng.standard_normal((runs, 2)) @ noise_root.T
            update = tracker.update(tracker.predict(state, 2.0), scan(k))
            assert (update.assignment >= 0).mean() > 0.997
            state = update.posterior
            all_nis.append(nis(update.innovation, update.innovation_var)[:, 0])
        mean, cov = tracker.estimate(state)
        all_nees.append(nees(mean[:, 0], cov[:, 0], truth))
    return np.stack(all_nees), np.stack(all_nis)


@pytest.mark.parametrize("update", [0, 1, 5, 10, 25])
def test_two_station_filter_knows_its_errors(honest_runs, update):
    """Mean NEES over independent runs inside its own 99.9 % band at every looked-at instant."""
    values = honest_runs[0][update]
    low, high = chi2.ppf([5e-4, 1 - 5e-4], df=4 * len(values)) / len(values)
    assert low < values.mean() < high


@pytest.mark.parametrize("update", [3, 5, 10, 25])
def test_the_bank_knows_its_errors(honest_bank_runs, update):
    """The same of the bank, from the third update: its prior range is uniform, not a draw of the truth's."""
    values = honest_bank_runs[0][update]
    low, high = chi2.ppf([5e-4, 1 - 5e-4], df=4 * len(values)) / len(values)
    assert low < values.mean() < high


def test_two_station_filters_innovations_have_the_size_it_claims(honest_runs):
    """Normalised innovations of an honest filter are independent: mean 1 over all runs, scans and stations."""
    values = honest_runs[1]
    low, high = chi2.ppf([5e-4, 1 - 5e-4], df=values.size) / values.size
    assert low < values.mean() < high


def test_nees_notices_an_overconfident_filter(honest_runs):
    """The same errors with half the standard deviation claimed lie outside the band: the test has power."""
    values = 4.0 * honest_runs[0][10]
    _, high = chi2.ppf([5e-4, 1 - 5e-4], df=4 * len(values)) / len(values)
    assert values.mean() > high
