"""Which bearing belongs to which track: exact searches against enumeration, pairings, late association."""

import itertools
import math

import numpy as np
import pytest
from scipy.optimize import linear_sum_assignment
from scipy.special import logsumexp
from scipy.stats import multivariate_normal, norm

from trackers import Scan
from trackers.angles import wrap
from trackers.association import PRUNED, AssociationModel, associate
from trackers.measurement import bearing, bearing_jacobian
from trackers.rp_ekf import Bank, update
from trackers.soft_association import branch_and_update, scratch
from trackers.triangulation import admissible_crossings, crossing_ranges, pair_bearings

STATIONS = np.array([[-9000.0, 500.0], [4000.0, 3000.0]])
STD = 0.01
MODEL = AssociationModel(gate_sigma=3.5, detection_probability=0.9, false_bearing_density=0.05)


def random_case(rng, tracks, stations, hypotheses=3, spread_m=900.0):
    """Predicted banks close enough to quarrel, and a scan with a missed and a false bearing now and then.

    Returns mean [m, n, 4], cov [m, n, 4, 4], log_weights [m, n], Scan of [s, m + 1] slots.
    """
    truth = np.array([2.4e4, 1.8e4]) + rng.normal(0.0, spread_m, (tracks, 2))
    mean = np.concatenate([truth[:, None] + rng.normal(0.0, 200.0, (tracks, hypotheses, 2)),
                           rng.normal(0.0, 50.0, (tracks, hypotheses, 2))], axis=-1)  # fmt: skip
    root = rng.standard_normal((tracks, hypotheses, 4, 6)) * np.array([250.0, 150.0, 30.0, 30.0])[:, None]
    log_w = np.log(rng.dirichlet(np.ones(hypotheses), size=tracks))
    if hypotheses > 1:
        log_w[rng.integers(tracks), 0] = PRUNED
    log_w -= logsumexp(log_w, axis=-1, keepdims=True) * (log_w > PRUNED)
    z = np.empty((stations, tracks + 1))
    z[:, :tracks] = bearing(truth, STATIONS[-stations:, None]) + rng.normal(0.0, STD, (stations, tracks))
    z[:, tracks] = z[:, 0] + rng.normal(0.0, 3 * STD, stations)
    valid = np.ones_like(z, dtype=bool)
    valid[:, 1:] = rng.random((stations, tracks)) < 0.7
    order = rng.permuted(np.tile(np.arange(tracks + 1), (stations, 1)), axis=1)
    z, valid = np.take_along_axis(z, order, axis=1), np.take_along_axis(valid, order, axis=1)
    return mean, root @ np.swapaxes(root, -1, -2) / 6, log_w, Scan(z, valid, STATIONS[-stations:], STD)


def option_costs(mean, cov, log_w, scan, model):
    """Cost of every gated option (slot or −1 per station) of ONE track, from scipy's multivariate normal."""
    stations, slots = scan.bearings.shape
    detected = min(model.detection_probability, 0.999)
    hit = -math.log(detected) + math.log(max(model.false_bearing_density, 1e-3))
    miss = -math.log(1.0 - detected)
    alive = [i for i in range(len(log_w)) if log_w[i] > PRUNED]
    H = {i: np.pad(bearing_jacobian(mean[i], scan.stations), ((0, 0), (0, 2))) for i in alive}
    S = {i: H[i] @ cov[i] @ H[i].T + scan.bearing_std**2 * np.eye(stations) for i in alive}
    nu = {i: wrap(scan.bearings - bearing(mean[i], scan.stations)[:, None]) for i in alive}
    gated = [
        [-1]
        + [
            k
            for k in range(slots)
            if scan.valid[s, k] and any(nu[i][s, k] ** 2 <= model.gate_sigma**2 * S[i][s, s] for i in alive)
        ]
        for s in range(stations)
    ]
    costs = {}
    for option in itertools.product(*gated):
        seen = [s for s in range(stations) if option[s] >= 0]
        terms = [
            log_w[i] + (multivariate_normal.logpdf([nu[i][s, option[s]] for s in seen], cov=S[i][np.ix_(seen, seen)])
                        if seen else 0.0)
            for i in alive
        ]  # fmt: skip
        costs[option] = -logsumexp(terms) + sum(hit if k >= 0 else miss for k in option)
    return costs


def joint_assignments(costs):
    """All joint assignments in which no slot serves two tracks: pairs (options per track, total cost)."""
    for options in itertools.product(*costs):
        if all(
            len({k for k in column if k >= 0}) == sum(k >= 0 for k in column) for column in zip(*options, strict=True)
        ):
            yield options, sum(cost[option] for cost, option in zip(costs, options, strict=True))


# ------------------------------------------------------------------------------------------------ hard assignment


@pytest.mark.parametrize("stations", [1, 2])
@pytest.mark.parametrize("tracks", [1, 2, 3, 4])
def test_association_equals_enumeration_of_all_assignments(tracks, stations):
    """Missed and false bearings, pruned hypotheses, cross-covariance of the stations: cost and assignment."""
    rng = np.random.default_rng(100 * tracks + stations)
    for _ in range(15 if tracks < 4 else 5):
        mean, cov, log_w, scan = random_case(rng, tracks, stations, spread_m=900.0 if tracks < 4 else 1500.0)
        costs = [option_costs(mean[j], cov[j], log_w[j], scan, MODEL) for j in range(tracks)]
        options, cost = min(joint_assignments(costs), key=lambda joint: joint[1])
        found = associate(mean, cov, log_w, scan, MODEL)
        assert found.cost == pytest.approx(cost, rel=1e-8, abs=1e-8)
        np.testing.assert_array_equal(found.assignment, options)


def test_one_station_association_equals_the_hungarian_method():
    """scipy's rectangular assignment with one private "missed" column per track."""
    rng = np.random.default_rng(7)
    for _ in range(40):
        mean, cov, log_w, scan = random_case(rng, 4, 1, spread_m=400.0)
        table = np.full((4, 5 + 4), 1e6)
        for j in range(4):
            for (k,), cost in option_costs(mean[j], cov[j], log_w[j], scan, MODEL).items():
                table[j, k if k >= 0 else 5 + j] = cost
        rows, columns = linear_sum_assignment(table)
        found = associate(mean, cov, log_w, scan, MODEL)
        assert found.cost == pytest.approx(table[rows, columns].sum())
        np.testing.assert_array_equal(found.assignment[:, 0], np.where(columns < 5, columns, -1))


def test_result_is_consistent_and_no_bearing_serves_twice():
    rng = np.random.default_rng(8)
    for _ in range(50):
        mean, cov, log_w, scan = random_case(rng, 3, 2, spread_m=200.0)
        found = associate(mean, cov, log_w, scan, MODEL)
        np.testing.assert_array_equal(found.used, found.assignment >= 0)
        for s in range(2):
            slots = found.assignment[:, s][found.used[:, s]]
            assert len(set(slots)) == len(slots)
            assert scan.valid[s, slots].all()
            np.testing.assert_array_equal(found.bearings[:, s][found.used[:, s]], scan.bearings[s, slots])
        np.testing.assert_array_equal(found.bearings[~found.used], 0.0)


def test_a_ghost_pair_is_dearer_than_two_single_bearings_tell():
    """Each bearing alone lies 2σ inside its gate; together they cross where the long, thin track cannot be."""
    sight = np.array([math.cos(0.6), math.sin(0.6)])
    normal = np.array([-sight[1], sight[0]])
    position = STATIONS[1] + 4e4 * sight
    cov = np.diag([0.0, 0.0, 1e4, 1e4])
    cov[:2, :2] = 5e3**2 * np.outer(sight, sight) + 50.0**2 * np.outer(normal, normal)
    expected = bearing(position, STATIONS)
    H = bearing_jacobian(position, STATIONS)
    S = H @ cov[:2, :2] @ H.T + STD**2 * np.eye(2)
    sigma = np.sqrt(np.diag(S))
    sign = np.sign(S[0, 1])

    def cost(offsets):
        scan = Scan((expected + offsets * sigma)[:, None], np.ones((2, 1), bool), STATIONS, STD)
        mean = np.array([*position, 0.0, 0.0])
        return associate(mean[None, None], cov[None, None], np.zeros((1, 1)), scan).cost

    assert cost(np.array([2.0, -2.0 * sign])) > cost(np.array([2.0, 2.0 * sign]))


def test_more_than_two_stations_are_refused():
    mean, cov, log_w, _ = random_case(np.random.default_rng(9), 2, 2)
    three = Scan(np.zeros((3, 3)), np.ones((3, 3), bool), np.zeros((3, 2)), STD)
    with pytest.raises(ValueError, match="one or two stations, got 3"):
        associate(mean, cov, log_w, three)
    with pytest.raises(ValueError, match="one or two stations, got 3"):
        branch_and_update(mean, cov, log_w, three, AssociationModel(), 1e-3)


def test_batch_equals_loop_with_the_empty_batch():
    rng = np.random.default_rng(10)
    cases = [random_case(rng, 3, 2) for _ in range(6)]
    mean, cov, log_w = (np.stack([case[i] for case in cases]) for i in range(3))
    z, valid = (np.stack([case[3][i] for case in cases]) for i in range(2))
    batch = associate(mean, cov, log_w, Scan(z, valid, STATIONS, STD), MODEL)
    soft = branch_and_update(mean, cov, log_w, Scan(z, valid, STATIONS, STD), MODEL, 1e-3)
    for e, case in enumerate(cases):
        for part, expected in zip(batch, associate(*case, MODEL), strict=True):
            np.testing.assert_array_equal(part[e], expected)
        for part, expected in zip(soft, branch_and_update(*case, MODEL, 1e-3), strict=True):
            np.testing.assert_array_equal(part[e], expected)
    none = associate(mean[:0], cov[:0], log_w[:0], Scan(z[:0], valid[:0], STATIONS, STD))
    assert none.assignment.shape == (0, 3, 2)


def test_costs_of_the_model_by_hand():
    miss, hit = AssociationModel(detection_probability=0.8, false_bearing_density=0.5).log_costs()
    assert miss == pytest.approx(-math.log(0.2))
    assert hit == pytest.approx(math.log(0.5 / 0.8))
    assert AssociationModel().log_costs() == pytest.approx((-math.log(0.001), math.log(0.001 / 0.999)))


# ------------------------------------------------------------------------------------------------ late association


def test_an_unambiguous_scan_branches_into_the_hard_assignment():
    """One station, tracks far apart: the bank's hypotheses, reordered by weight, equal the hard update's."""
    rng = np.random.default_rng(11)
    truth = np.array([[2.4e4, 1.8e4], [0.0, 3e4], [2.5e4, -2e4]])
    mean = np.zeros((3, 3, 4))
    mean[..., :2] = STATIONS[1] + np.array([0.9, 1.0, 1.12])[:, None] * (truth - STATIONS[1])[:, None]
    cov = np.broadcast_to(np.diag([300.0, 200.0, 20.0, 30.0]) ** 2, (3, 3, 4, 4)).copy()
    log_w = np.log(rng.dirichlet(np.ones(3), size=3))
    z = bearing(truth, STATIONS[1]) + rng.normal(0.0, STD, 3)
    scan = Scan(z[None, ::-1].copy(), np.ones((1, 3), bool), STATIONS[1:], STD)
    hard_update = update(Bank(mean, cov, log_w), z[:, None], np.ones((3, 1), bool), STATIONS[1:], STD, 1e-12)
    hard = hard_update.posterior
    x, P, lw, own, _, _, assignment, evidence = branch_and_update(mean, cov, log_w, scan, AssociationModel(), 1e-12)
    np.testing.assert_array_equal(assignment[:, 0], [2, 1, 0])
    order = (-hard.log_weights).argsort(-1)
    np.testing.assert_allclose(x, np.take_along_axis(hard.mean, order[..., None], axis=1))
    np.testing.assert_allclose(P, np.take_along_axis(hard.cov, order[..., None, None], axis=1), rtol=1e-9)
    np.testing.assert_allclose(lw, np.take_along_axis(hard.log_weights, order, axis=1), atol=1e-9)
    np.testing.assert_allclose(own, lw, atol=1e-9)
    np.testing.assert_allclose(evidence, hard_update.log_likelihood, rtol=1e-9)


@pytest.mark.parametrize("jitter", [-0.002, -0.001, 0.0, 0.0005, 0.0015])
def test_branch_weights_are_the_marginals_of_all_joint_assignments(jitter):
    """Two tracks want three bearings: weights equal β from enumeration (but for e⁻⁹, which the search leaves out).

    Bearings lie more than 0.6σ from the predictions and 10σ of their own noise apart, so no branches merge.
    """
    angles, std = np.array([0.6, 0.613]), 0.0005
    mean = np.zeros((2, 4))
    mean[:, :2] = STATIONS[1] + 2.5e4 * np.stack([np.cos(angles), np.sin(angles)], axis=-1)
    cov = np.diag([250.0, 250.0, 20.0, 20.0]) ** 2
    scan = Scan(np.array([[0.592, 0.6065 + jitter, 0.621]]), np.ones((1, 3), bool), STATIONS[1:], std)
    costs = [option_costs(mean[j, None], cov[None], np.zeros(1), scan, MODEL) for j in range(2)]
    joint = list(joint_assignments(costs))
    total = logsumexp([-cost for _, cost in joint])
    beta = np.zeros((2, 4))
    for options, cost in joint:
        for j, (k,) in enumerate(options):
            beta[j, k] += math.exp(-cost - total)
    log_w = np.full((2, 6), PRUNED)
    log_w[:, 0] = 0.0
    bank = np.repeat(mean[:, None], 6, axis=1), np.broadcast_to(cov, (2, 6, 4, 4))
    weights = np.exp(branch_and_update(*bank, log_w, scan, MODEL, 1e-12)[2])
    np.testing.assert_allclose(-np.sort(-weights)[:, :4], -np.sort(-beta), atol=3e-4)
    assert (np.sort(beta)[:, -2] > 0.05).all()  # a real quarrel


@pytest.mark.parametrize("hypotheses", [1, 2, 8])
@pytest.mark.parametrize("tracks", [1, 2, 3])
@pytest.mark.parametrize("slots", [1, 4])
def test_scratch_has_room_for_every_size(hypotheses, tracks, slots):
    """A kernel that wrote past its scratch would damage memory unnoticed: the needs are stated here once more."""
    options, k_opt, nu, S, line, marks, inside, x, P = scratch((tracks, hypotheses, 4), 2, slots)
    branches = x.shape[0]
    assert branches >= hypotheses
    assert line.shape[1] > max(branches, tracks, 4)  # weights and own weights of branches; a state's difference
    assert marks.shape[1] > max(branches, tracks, slots)
    assert line.shape[1] > (slots + 1) ** 2  # shares of a track's options
    assert options.shape == (tracks, (slots + 1) ** 2, 2 + hypotheses)
    assert (k_opt.shape[:2], nu.shape) == (options.shape[:2], (tracks, 2, hypotheses, slots))
    assert (S.shape, inside.shape, P.shape) == ((tracks, 6, hypotheses), (2, slots), (branches, 4, 4))


def test_near_duplicates_merge_before_the_lightest_branch_is_dropped():
    """Two places, four branches: two that agree outweigh together one that is heavier than either."""
    spread, std = 0.05, 0.0005  # the prior across the line of sight as seen from the station, and the noise [rad]
    mean, log_w = np.array([[[2.5e4, 0.0, 0.0, 0.0], [0.0, 0.0, 0.0, 0.0]]]), np.array([[0.0, PRUNED]])
    mean[0, 0, :2] += STATIONS[1]
    cov = np.broadcast_to(np.diag([100.0, 2.5e4 * spread, 20.0, 20.0]) ** 2, (1, 2, 4, 4)).copy()
    bearings = np.array([[0.0, 0.8 * spread, -1.0 * spread, -1.0 * spread - 0.5 * std]])
    scan = Scan(bearings, np.ones((1, 4), bool), STATIONS[1:], std)
    x, P, lw, *_ = branch_and_update(mean, cov, log_w, scan, MODEL, 1e-12)
    density = norm.pdf(bearings[0], scale=math.hypot(spread, std))
    kept = np.array([density[0], density[2] + density[3]])
    np.testing.assert_allclose(np.exp(lw[0]), kept / kept.sum(), rtol=1e-6)
    angles = np.arctan2(x[0, :, 1] - STATIONS[1, 1], x[0, :, 0] - STATIONS[1, 0])
    np.testing.assert_allclose(angles, [0.0, bearings[0, 2:].mean()], atol=std)
    assert (np.linalg.eigvalsh(P) > 0.0).all()


def test_branched_banks_stay_honest_mixtures():
    """Weights sum to one, covariances stay positive definite, over 60 scans of two tracks that cross in bearing."""
    rng = np.random.default_rng(13)
    position = np.array([[2.4e4, 1.8e4], [2.5e4, 1.7e4]])
    velocity = np.array([[120.0, -180.0], [-60.0, 150.0]])
    mean = np.concatenate([np.repeat(position[:, None], 6, axis=1), np.zeros((2, 6, 2))], axis=-1)
    mean[..., :2] += rng.normal(0.0, 800.0, (2, 6, 2))
    cov = np.broadcast_to(np.diag([800.0, 800.0, 200.0, 200.0]) ** 2, (2, 6, 4, 4)).copy()
    own = np.full((2, 6), -math.log(6))
    phi = np.eye(4) + np.diag([2.0, 2.0], k=2)
    for _ in range(60):
        position = position + 2.0 * velocity
        mean, cov = mean @ phi.T, phi @ cov @ phi.T + np.diag([1.0, 1.0, 25.0, 25.0])
        z = bearing(position, STATIONS[:, None]) + rng.normal(0.0, STD, (2, 2))
        scan = Scan(z, rng.random((2, 2)) < 0.95, STATIONS, STD)
        mean, cov, weights, own, *_ = branch_and_update(mean, cov, own, scan, AssociationModel(), 1e-3)
        for log_w in (weights, own):
            np.testing.assert_allclose(np.exp(log_w).sum(-1), 1.0)
        assert np.linalg.eigvalsh(cov[weights > PRUNED]).min() > 0
        assert np.isfinite(mean).all()


# ------------------------------------------------------------------------------------------------ first pairings


def first_scan(rng, targets, others):
    """Random reference bearings [a], the other station's [h]; some invalid, some from anywhere around."""
    position = rng.uniform([1e4, 1e4], [6e4, 6e4], (max(targets, others), 2))
    alphas = bearing(position[:targets], STATIONS[1]) + rng.normal(0.0, STD, targets)
    thetas = rng.permutation(bearing(position[:others], STATIONS[0]) + rng.normal(0.0, STD, others))
    for angles in (alphas, thetas):
        strange = rng.random(len(angles)) < 0.2
        angles[strange] = rng.uniform(-math.pi, math.pi, strange.sum())
    return alphas, rng.random(targets) < 0.9, thetas, rng.random(others) < 0.9


def pairing_cost(alphas, alpha_valid, thetas, theta_valid, partner, floor, cap):
    total = 0.0
    for j, h in enumerate(partner):
        if h < 0:
            total += 1e3 * alpha_valid[j]
            continue
        r1, r2 = crossing_ranges(thetas[h], alphas[j], STATIONS[0], STATIONS[1])
        if not (alpha_valid[j] and theta_valid[h] and r1 > 0 and floor < r2 < cap):
            return math.inf
        total += math.log(r2)
    return total


def all_partners(targets, others):
    """Every one-to-one pairing, −1 for none."""
    for partner in itertools.product(range(-1, others), repeat=targets):
        taken = [h for h in partner if h >= 0]
        if len(set(taken)) == len(taken):
            yield partner


@pytest.mark.parametrize(("targets", "others"), [(1, 1), (2, 3), (3, 3), (3, 2), (4, 4)])
def test_pairing_equals_enumeration(targets, others):
    rng = np.random.default_rng(10 * targets + others)
    for _ in range(20 if targets < 4 else 4):
        alphas, alpha_valid, thetas, theta_valid = case = first_scan(rng, targets, others)
        best = min(pairing_cost(*case, partner, 2e3, 1e5) for partner in all_partners(targets, others))
        found = pair_bearings(alphas, alpha_valid, STATIONS[1], thetas, theta_valid, STATIONS[0], 2e3, 1e5)
        assert pairing_cost(*case, found, 2e3, 1e5) == pytest.approx(best)


def test_admissible_crossings_equal_enumeration():
    """With no tolerance a crossing is admissible if some full pairing of forward crossings uses it."""
    rng = np.random.default_rng(14)
    for _ in range(40):
        alphas, alpha_valid, thetas, theta_valid = case = first_scan(rng, 3, 3)
        found = admissible_crossings(alphas, alpha_valid, STATIONS[1], thetas, theta_valid, STATIONS[0], 0.0, 2e3, 1e5)
        forward, full = np.zeros((3, 3), bool), np.zeros((3, 3), bool)
        for partner in all_partners(3, 3):
            if not math.isfinite(pairing_cost(*case, partner, 2e3, 1e5)):
                continue
            pairs = [(j, h) for j, h in enumerate(partner) if h >= 0]
            for j, h in pairs:
                forward[j, h] = True
                full[j, h] |= len(pairs) == alpha_valid.sum()
        np.testing.assert_array_equal(found, full if full.any() else forward)
