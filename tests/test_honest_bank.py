"""A bank that knows what it does not know: the bearing's curvature, late merging, one moving platform."""

import math

import numpy as np
import pytest
from scipy.stats import chi2

from trackers import AdaptiveRpEkf, FusedEkf, RpEkf, Scan, rp_ekf
from trackers.association import PRUNED, AssociationModel, associate
from trackers.consistency import nees
from trackers.gaussian import Gaussian
from trackers.measurement import bearing, bearing_jacobian, update
from trackers.motion import process_noise, transition
from trackers.rp_ekf import Bank
from trackers.soft_association import branch_and_update

STEP_S, STD = 5.0, math.radians(0.5)
OWNSHIP = {"floor_m": 15e3, "cap_m": 120e3, "process_noise": 5.0, "merge_below": 1.0, "second_order": True}


def random_gaussians(rng, count):
    """Tracks 3 to 20 km from the origin with errors of up to a third of that, all components correlated."""
    angle, distance = rng.uniform(-math.pi, math.pi, count), rng.uniform(3e3, 2e4, count)
    mean = np.column_stack([distance * np.cos(angle), distance * np.sin(angle), rng.normal(0.0, 200.0, (count, 2))])
    scale = np.column_stack([distance / 6, distance / 9, np.full(count, 80.0), np.full(count, 50.0)])
    root = rng.standard_normal((count, 4, 6)) * scale[:, :, None] / 2.5
    return Gaussian(mean, root @ np.swapaxes(root, -1, -2))


def added_variance(prior, station, std):
    first, second = (update(prior, 0.3, station, std, second_order=flag).innovation_var for flag in (False, True))
    return second - first


# ------------------------------------------------------------------------------------------------ second order


def test_added_variance_is_that_of_a_finite_difference_hessian():
    """½ tr(H_xx P H_xx P) with H_xx from differences of the Jacobian."""
    station, prior = np.array([400.0, -300.0]), random_gaussians(np.random.default_rng(0), 50)
    h = 0.1
    step = h * np.eye(2)
    hessian = np.stack(
        [
            (bearing_jacobian(prior.mean[:, :2] + e, station) - bearing_jacobian(prior.mean[:, :2] - e, station))
            / (2 * h)
            for e in step
        ],
        axis=-2,
    )
    product = hessian @ prior.cov[:, :2, :2]
    expected = 0.5 * np.trace(product @ product, axis1=-2, axis2=-1)
    np.testing.assert_allclose(added_variance(prior, station, 1e-3), expected, rtol=1e-5)


def test_added_variance_is_that_of_the_quadratic_part_of_the_bearing():
    """Gauss–Hermite quadrature of h(x) − H(x − x̂) under a Gaussian of 4 % of the range: exact to higher orders."""
    prior = random_gaussians(np.random.default_rng(1), 30)
    small = Gaussian(prior.mean, 0.01 * prior.cov)
    nodes, weights = np.polynomial.hermite_e.hermegauss(12)
    grid = np.stack(np.meshgrid(nodes, nodes), axis=-1).reshape(-1, 2)
    w = np.outer(weights, weights).reshape(-1) / weights.sum() ** 2
    root = np.linalg.cholesky(small.cov[:, :2, :2])
    offset = np.einsum("nij,kj->nki", root, grid)
    slope = bearing_jacobian(small.mean, np.zeros(2))
    turned = bearing(small.mean[:, None, :2] + offset, np.zeros(2)) - bearing(small.mean, np.zeros(2))[:, None]
    bent = (turned + math.pi) % (2 * math.pi) - math.pi - np.einsum("ni,nki->nk", slope, offset)
    expected = bent**2 @ w - (bent @ w) ** 2
    np.testing.assert_allclose(added_variance(small, np.zeros(2), 1e-4), expected, rtol=0.05)


def test_innovation_variance_lies_between_the_first_order_and_monte_carlo():
    """Range known to 25 %: bearings drawn from the prior spread more than their slope says; the second order makes up
    for part of it (the cubic term of the bearing, correlated with the linear one, for the rest)."""
    rng = np.random.default_rng(2)
    mean, cov = np.array([4e3, 0.0, 0.0, 0.0]), np.diag([1e3**2, 200.0**2, 1.0, 1.0])
    draws = rng.multivariate_normal(mean, cov, 200_000)
    spread = (bearing(draws, np.zeros(2)) + rng.normal(0.0, 1e-3, len(draws))).var()
    first, second = (
        float(update(Gaussian(mean, cov), 0.0, np.zeros(2), 1e-3, flag).innovation_var) for flag in (False, True)
    )
    assert second == pytest.approx(first + (1.0 / 4.0) ** 2 * 0.05**2)
    standard_error = math.sqrt(2.0 / len(draws)) * spread
    assert first < second < spread - 5.0 * standard_error


def test_gain_and_posterior_are_those_of_a_noisier_bearing():
    """The added variance acts as measurement noise, in the single update, the bank and both associations alike."""
    prior = random_gaussians(np.random.default_rng(3), 6)
    station, z = np.array([100.0, 200.0]), bearing(prior.mean, np.array([100.0, 200.0])) + 0.01
    noisy = np.sqrt(STD**2 + added_variance(prior, station, STD))
    expected = update(prior, z, station, noisy)
    found = update(prior, z, station, STD, second_order=True)
    for part, other in zip(found.posterior, expected.posterior, strict=True):
        np.testing.assert_allclose(part, other, rtol=1e-9)
    np.testing.assert_allclose(found.log_likelihood, expected.log_likelihood)
    bank = Bank(prior.mean[:, None], prior.cov[:, None], np.zeros((6, 1)))
    in_bank = rp_ekf.update(bank, z[:, None], np.ones((6, 1), bool), station[None], STD, second_order=True)
    np.testing.assert_allclose(in_bank.posterior.cov[:, 0], found.posterior.cov)
    scan = Scan(z[:, None, None], np.ones((6, 1, 1), bool), np.broadcast_to(station, (6, 1, 2)), STD)
    tracks = tuple(part[:, None] for part in bank)
    soft = branch_and_update(*tracks, scan, AssociationModel(), 1e-4, 1.0, second_order=True)
    np.testing.assert_allclose(soft[0][:, 0, 0], found.posterior.mean)
    np.testing.assert_allclose(soft[1][:, 0, 0], found.posterior.cov)
    np.testing.assert_allclose(soft[5][:, 0, 0], found.innovation_var)
    miss, hit = AssociationModel().log_costs()
    assert miss > 0
    hard = associate(*tracks, scan, AssociationModel(), second_order=True)
    np.testing.assert_allclose(hard.cost, hit - found.log_likelihood)


# ------------------------------------------------------------------------------------------------ thresholds


def close_bank():
    """Two hypotheses 1.5 standard deviations apart in x, one far away and improbable."""
    mean = np.array([[4e4, 0.0, 0.0, 0.0], [4.15e4, 0.0, 0.0, 0.0], [8e4, 0.0, 0.0, 0.0]])
    cov = np.broadcast_to(np.diag([1e3, 300.0, 20.0, 20.0]) ** 2, (3, 4, 4))
    return mean[None], cov[None], np.log([[0.6, 0.4 - 1e-8, 1e-8]])


@pytest.mark.parametrize(("merge_below", "alive"), [(0.0, 3), (1.0, 3), (2.0, 3), (3.0, 2), (4.0, 2)])
def test_hypotheses_merge_at_the_distance_asked_for(merge_below, alive):
    """2.25 apart in squared Mahalanobis distance; the mixture's first two moments stay."""
    scan = Scan(np.zeros((1, 1)), np.ones((1, 1), bool), np.zeros((1, 2)), STD)
    x, P, lw, *_ = branch_and_update(*close_bank(), scan, AssociationModel(), 0.0, merge_below)
    assert (lw > PRUNED).sum() == alive
    apart, apart_cov, apart_lw, *_ = branch_and_update(*close_bank(), scan, AssociationModel(), 0.0, 0.0)
    merged, expected = rp_ekf.estimate(Bank(x, P, lw)), rp_ekf.estimate(Bank(apart, apart_cov, apart_lw))
    np.testing.assert_allclose(merged.mean, expected.mean, rtol=1e-9, atol=1e-6)
    np.testing.assert_allclose(merged.cov, expected.cov, rtol=1e-6, atol=1e-3)


@pytest.mark.parametrize(("prune_below", "alive"), [(0.0, 3), (1e-12, 3), (1e-4, 2)])
def test_no_hypothesis_is_removed_below_a_threshold_of_zero(prune_below, alive):
    scan = Scan(np.zeros((1, 1)), np.ones((1, 1), bool), np.zeros((1, 2)), STD)
    lw = branch_and_update(*close_bank(), scan, AssociationModel(), prune_below, 0.0)[2]
    assert (lw > PRUNED).sum() == alive
    bank = Bank(*(part[0] for part in close_bank()))
    kept = rp_ekf.update(bank, [0.0], [True], np.zeros((1, 2)), STD, prune_below).posterior.log_weights
    assert (kept > PRUNED).sum() == alive


def test_weights_worlds_apart_stay_finite():
    """A hypothesis 1,000 nepers down lies within the merging distance of the best one."""
    mean, cov, _ = close_bank()
    scan = Scan(np.zeros((1, 1)), np.ones((1, 1), bool), np.zeros((1, 2)), STD)
    log_weights = np.array([[0.0, -1e3, -2e3]])
    x, P, lw, own, *_ = branch_and_update(mean, cov, log_weights, scan, AssociationModel(), 0.0, 4.0)
    for part in (x, P, lw, own):
        assert np.isfinite(part).all()
    assert (lw > PRUNED).sum() == 2


@pytest.mark.parametrize("kind", [RpEkf, FusedEkf, AdaptiveRpEkf])
@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"hypotheses": 0}, "hypotheses = 0: must be at least 1"),
        ({"floor_m": 0.0}, "floor_m = 0.0: must be positive"),
        ({"floor_m": math.nan}, "floor_m = nan: must be positive"),
        ({"floor_m": 3e4, "cap_m": 2e4}, "cap_m = 20000.0: must be above floor_m = 30000.0"),
        ({"velocity_std": 0.0}, "velocity_std = 0.0: must be positive"),
        ({"process_noise": -1.0}, "process_noise = -1.0: must be at least 0"),
        ({"process_noise": math.inf}, "process_noise = inf: must be at least 0"),
        ({"prune_below": 1.0}, r"prune_below = 1.0: must be in \[0, 1\)"),
        ({"merge_below": -0.5}, "merge_below = -0.5: must be at least 0"),
    ],
)
def test_settings_that_cannot_be_are_refused(kind, settings, words):
    with pytest.raises(ValueError, match=f"{kind.__name__}.{words}"):
        kind(**settings)


# ------------------------------------------------------------------------------------------------ one platform


def fly_past(tracker, truth, noise, turn=0.55):
    """One platform flies legs of 75 s, ±60° off the bearing, past targets [k + 1, runs, 4]; yields estimates."""
    runs = truth.shape[1]
    position, heading = np.zeros((runs, 2)), np.full(runs, turn)
    state = None
    for k in range(len(truth)):
        z = bearing(truth[k], position) + noise[k]
        scan = Scan(z[:, None, None], np.ones((runs, 1, 1), bool), position[:, None], STD)
        state = tracker.initiate(scan) if k == 0 else tracker.update(tracker.predict(state, STEP_S), scan).posterior
        mean, cov = tracker.estimate(state)
        yield Gaussian(mean[:, 0], cov[:, 0]), state
        wish = z + math.radians(60.0) * (1.0 if k // 15 % 2 == 0 else -1.0)
        heading = heading + np.clip((wish - heading + math.pi) % (2 * math.pi) - math.pi, -0.26, 0.26)
        position = position + 250.0 * STEP_S * np.column_stack([np.cos(heading), np.sin(heading)])


def courses(rng, runs, steps, q=0.0):
    """Constant-velocity targets 25 to 90 km off with velocity increments q [m/s] per step: [k + 1, runs, 4]."""
    angle, distance = rng.uniform(-math.pi, math.pi, runs), rng.uniform(25e3, 90e3, runs)
    course, speed = rng.uniform(-math.pi, math.pi, runs), rng.uniform(100.0, 300.0, runs)
    start = np.column_stack(
        [distance * np.cos(angle), distance * np.sin(angle), speed * np.cos(course), speed * np.sin(course)]
    )
    return drift(rng, start, steps, q)


def drift(rng, start, steps, q):
    truth = [start]
    for _ in range(steps):
        w = rng.normal(0.0, q, (len(start), 2)) if q else np.zeros((len(start), 2))
        kick = np.concatenate([0.5 * STEP_S * w, w], axis=1)
        truth.append(truth[-1] @ transition(STEP_S).T + kick)
    return np.array(truth)


@pytest.fixture(scope="module")
def model_runs():
    """NEES [k + 1, runs] of a bank on truth drawn from its own model, initial Gaussian mixture included.

    The range hypothesis is drawn by its weight and the state from that hypothesis' Gaussian about the first, exact
    bearing; the bank's own start is about the same bearing.
    """
    rng, runs, steps = np.random.default_rng(21), 600, 40
    tracker = RpEkf(**OWNSHIP)
    first = Scan(np.full((1, 1), 0.7), np.ones((1, 1), bool), np.zeros((1, 2)), STD)
    bank = tracker.initiate(first)
    pick = rng.choice(8, runs, p=np.exp(bank.log_weights[0]))
    root = np.linalg.cholesky(bank.cov[0])
    start = bank.mean[0, pick] + np.einsum("nij,nj->ni", root[pick], rng.standard_normal((runs, 4)))
    truth = drift(rng, start, steps, 5.0)
    noise = rng.normal(0.0, STD, (steps + 1, runs))
    noise[0] = 0.7 - bearing(truth[0], np.zeros(2))
    return np.array([nees(*estimate, truth[k]) for k, (estimate, _) in enumerate(fly_past(tracker, truth, noise))])


@pytest.mark.parametrize("update", [1, 10, 20, 30, 40])
def test_bank_on_one_moving_platform_knows_its_errors(model_runs, update):
    """Truth obeys the model: mean NEES over runs inside its own 99.9 % band."""
    values = model_runs[update]
    low, high = chi2.ppf([5e-4, 1 - 5e-4], df=4 * len(values)) / len(values)
    assert low < values.mean() < high


def test_second_order_and_late_merging_keep_passes_honest():
    """Constant-velocity targets, a fifth passed within 8 km: the paper's bank collapses now and then, this one not."""
    rng = np.random.default_rng(22)
    truth, noise = courses(rng, 2000, 60), rng.normal(0.0, STD, (61, 2000))
    final = {}
    for name, tracker in {
        "paper": RpEkf(floor_m=15e3, cap_m=120e3, process_noise=5.0),
        "honest": RpEkf(**OWNSHIP),
    }.items():
        *_, (estimate, _) = fly_past(tracker, truth, noise)
        final[name] = nees(*estimate, truth[-1]), np.linalg.norm((estimate.mean - truth[-1])[:, :2], axis=-1)
    limit = chi2.ppf(0.9999, df=4)
    collapsed = {name: ((values > limit) | (error > 15e3)).mean() for name, (values, error) in final.items()}
    assert collapsed["paper"] > 0.004
    assert collapsed["honest"] <= 0.001
    assert final["honest"][0].mean() < 4.0
    assert final["honest"][1].mean() < 0.95 * final["paper"][1].mean()


@pytest.mark.parametrize("tracker", [RpEkf(**OWNSHIP), RpEkf(**OWNSHIP, prune_below=0.0), AdaptiveRpEkf()])
def test_covariances_stay_positive_definite_over_a_rough_run(tracker):
    """200 scans of 40 wildly turning targets, seen from a platform that starts 40 m to 90 km away from them."""
    rng = np.random.default_rng(23)
    truth = courses(rng, 40, 200, q=60.0)
    truth[..., :2] *= np.geomspace(1e-3, 1.0, 40)[:, None]
    for estimate, state in fly_past(tracker, truth, rng.normal(0.0, STD, (201, 40))):
        for part in (*estimate, *state):
            assert np.isfinite(part).all()
        alive = state.log_weights > PRUNED
        assert alive.reshape(40, -1).any(-1).all()
        deviation = np.sqrt(np.diagonal(state.cov[alive], axis1=-2, axis2=-1))
        assert np.linalg.eigvalsh(state.cov[alive] / deviation[:, :, None] / deviation[:, None, :]).min() > 0.0
        assert np.linalg.eigvalsh(estimate.cov).min() > 0.0


def test_one_station_starts_over_the_whole_interval():
    scan = Scan(np.array([[[0.3, -2.0]]]), np.ones((1, 1, 2), bool), np.array([[[1e3, 2e3]]]), STD)
    state = RpEkf(**OWNSHIP).initiate(scan)
    distance = np.linalg.norm(state.mean[0, ..., :2] - [1e3, 2e3], axis=-1)
    edges = np.geomspace(15e3, 120e3, 9)
    np.testing.assert_allclose(distance, np.tile((edges[1:] + edges[:-1]) / 2, (2, 1)))
    np.testing.assert_allclose(
        bearing(state.mean[0], np.array([1e3, 2e3])), np.broadcast_to([[0.3], [-2.0]], (2, 8)), atol=1e-12
    )
    q = process_noise(STEP_S, 5.0)
    np.testing.assert_allclose(
        RpEkf(**OWNSHIP).predict(state, STEP_S).cov - transition(STEP_S) @ state.cov @ transition(STEP_S).T,
        np.broadcast_to(q, state.cov.shape),
        atol=1e-6,
    )
