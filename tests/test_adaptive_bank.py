"""The adaptive bank: models interact inside every range hypothesis, checked against an IMM written plainly in NumPy."""

import itertools
import math

import numpy as np
import pytest
from scipy.special import logsumexp

from trackers import TRACKERS, AdaptiveRpEkf, RpEkf, Scan, rp_ekf
from trackers.adaptive_rp_ekf import ModelBank, mix_and_predict, stationary
from trackers.association import PRUNED, AssociationModel
from trackers.consistency import nees
from trackers.gaussian import Gaussian, moment_match
from trackers.jpda import average_and_update
from trackers.measurement import bearing, update
from trackers.motion import process_noise, transition

STEP_S, STD = 5.0, math.radians(0.5)
CHAIN = np.array([[0.9, 0.08, 0.02], [0.25, 0.7, 0.05], [0.1, 0.3, 0.6]])
RATES = np.radians([0.0, 2.0, -3.0])
NOISE = np.array([4.0, 9.0, 12.0])


def turning(step_s, rate):
    """Transition of a turn at a known rate, as printed in Bar-Shalom, Li and Kirubarajan (2001), section 11.7.1."""
    if rate == 0.0:
        return transition(step_s)
    s, c = math.sin(rate * step_s), math.cos(rate * step_s)
    return np.array([[1, 0, s / rate, -(1 - c) / rate], [0, 1, (1 - c) / rate, s / rate], [0, 0, c, -s], [0, 0, s, c]])


def random_bank(rng, *lead, n=4, r=3):
    mean = np.concatenate([rng.uniform(1e4, 6e4, (*lead, n, r, 2)), rng.normal(0.0, 200.0, (*lead, n, r, 2))], axis=-1)
    root = rng.standard_normal((*lead, n, r, 4, 6)) * np.array([2e3, 1e3, 80.0, 50.0])[:, None]
    weights = rng.dirichlet(np.ones(n * r), size=lead).reshape(*lead, n, r)
    return ModelBank(mean, root @ np.swapaxes(root, -1, -2), np.log(weights))


def plain_imm_step(mean, cov, weight, chain, rates, noise):
    """Mixing and prediction of ONE range hypothesis: mean [r, 4], cov [r, 4, 4], weight [r]."""
    r = len(weight)
    predicted = weight @ chain
    out = []
    for j in range(r):
        share = chain[:, j] * weight / predicted[j]
        x = share @ mean
        P = sum(share[k] * (cov[k] + np.outer(mean[k] - x, mean[k] - x)) for k in range(r))
        F = turning(STEP_S, rates[j])
        out.append((F @ x, F @ P @ F.T + process_noise(STEP_S, noise[j])))
    return np.array([x for x, _ in out]), np.array([P for _, P in out]), predicted


def scan_of(z, station=(0.0, 0.0)):
    z = np.asarray(z, dtype=float)
    return Scan(z[..., None, :], np.ones((*z.shape[:-1], 1, z.shape[-1]), bool), np.array([station]), STD)


# ------------------------------------------------------------------------------------------------ interaction


def test_mixing_and_prediction_equal_a_plain_imm():
    """An asymmetric chain, three models that move differently; ranges never mix."""
    bank = random_bank(np.random.default_rng(0))
    found = mix_and_predict(bank, CHAIN, NOISE, RATES, STEP_S)
    for i in range(4):
        mean, cov, weight = plain_imm_step(bank.mean[i], bank.cov[i], np.exp(bank.log_weights[i]), CHAIN, RATES, NOISE)
        np.testing.assert_allclose(found.mean[i], mean, rtol=1e-10)
        np.testing.assert_allclose(found.cov[i], cov, rtol=1e-8, atol=1e-6)
        np.testing.assert_allclose(np.exp(found.log_weights[i]), weight)
    np.testing.assert_allclose(
        np.exp(found.log_weights).sum(-1), np.exp(bank.log_weights).sum(-1), err_msg="range weights change by bearings"
    )


def test_a_whole_step_equals_plain_imms_under_bayes_rule():
    rng = np.random.default_rng(1)
    bank = random_bank(rng, 1)
    tracker = AdaptiveRpEkf(
        hypotheses=4, process_noise=NOISE[0], maneuver_noise=9.0, turn_rates_deg_s=(2.0, -3.0),
        transition=tuple(map(tuple, CHAIN)), prune_below=0.0,
    )  # fmt: skip
    q = np.array([NOISE[0], 9.0, 9.0])
    z = 0.7
    found = tracker.update(tracker.predict(bank, STEP_S), scan_of([z])).posterior
    log_w = np.empty((4, 3))
    for i in range(4):
        prior = plain_imm_step(bank.mean[0, i], bank.cov[0, i], np.exp(bank.log_weights[0, i]), CHAIN, RATES, q)
        for j in range(3):
            step = update(Gaussian(prior[0][j], prior[1][j]), z, np.zeros(2), STD, second_order=True)
            np.testing.assert_allclose(found.mean[0, i, j], step.posterior.mean, rtol=1e-8)
            np.testing.assert_allclose(found.cov[0, i, j], step.posterior.cov, rtol=1e-6, atol=1e-4)
            log_w[i, j] = math.log(prior[2][j]) + step.log_likelihood
    np.testing.assert_allclose(found.log_weights[0], log_w - logsumexp(log_w), atol=1e-8)
    np.testing.assert_allclose(found.model_probabilities[0], np.exp(log_w - logsumexp(log_w)).sum(0))


def test_equal_models_are_the_plain_bank():
    """Three constant-velocity models with one q and any chain: every filter equals the single-model bank's."""
    rng = np.random.default_rng(2)
    chain = tuple(map(tuple, CHAIN))
    settings = {"floor_m": 15e3, "cap_m": 120e3, "process_noise": 6.0, "second_order": True, "prune_below": 0.0}
    adaptive = AdaptiveRpEkf(**settings, maneuver_noise=6.0, turn_rates_deg_s=(0.0, 0.0), transition=chain)
    bank = None
    for k in range(15):
        z, position = 0.4 + 0.01 * k + rng.normal(0.0, STD, 1), np.array([200.0 * k, -90.0 * k * k])
        scan = scan_of(z, position)
        if bank is None:
            state = adaptive.initiate(scan)
            bank = rp_ekf.Bank(*RpEkf(**settings).initiate(scan)[:3])
            continue
        state = adaptive.update(adaptive.predict(state, STEP_S), scan).posterior
        bank = rp_ekf.predict(bank, STEP_S, 6.0)
        bank = rp_ekf.update(bank, z[:, None], np.ones((1, 1), bool), position[None], STD, 0.0, True).posterior
        np.testing.assert_allclose(state.mean, np.repeat(bank.mean[..., None, :], 3, axis=-2), rtol=1e-7, atol=1e-4)
        np.testing.assert_allclose(logsumexp(state.log_weights, axis=-1), bank.log_weights, atol=1e-6)
        np.testing.assert_allclose(state.model_probabilities[0], stationary(CHAIN) @ np.eye(3))
        for part, other in zip(adaptive.estimate(state), rp_ekf.estimate(bank), strict=True):
            np.testing.assert_allclose(part, other, rtol=1e-6, atol=1e-3)


def test_removed_filters_come_back_within_their_range_only():
    bank = random_bank(np.random.default_rng(3))
    log_w = bank.log_weights.copy()
    log_w[1] = PRUNED
    log_w[2, 1] = PRUNED
    found = mix_and_predict(ModelBank(bank.mean, bank.cov, log_w), CHAIN, NOISE, RATES, STEP_S)
    assert (found.log_weights[1] == PRUNED).all()
    assert (found.mean[1] == 0.0).all()
    weight = np.where(log_w[2] > PRUNED, np.exp(log_w[2]), 0.0)
    np.testing.assert_allclose(np.exp(found.log_weights[2]), weight @ CHAIN)
    mean, _, _ = plain_imm_step(bank.mean[2], bank.cov[2], weight, CHAIN, RATES, NOISE)
    np.testing.assert_allclose(found.mean[2], mean)


def test_a_model_nobody_can_reach_stays_empty():
    chain = np.array([[0.9, 0.1, 0.0], [0.4, 0.6, 0.0], [0.5, 0.5, 0.0]])
    found = mix_and_predict(random_bank(np.random.default_rng(4)), chain, NOISE, RATES, STEP_S)
    assert (found.log_weights[:, 2] == PRUNED).all()
    assert all(np.isfinite(part).all() for part in found)
    np.testing.assert_allclose(stationary(chain), [0.8, 0.2, 0.0], atol=1e-12)
    tracker = AdaptiveRpEkf(transition=tuple(map(tuple, chain)))
    state = tracker.initiate(scan_of([0.3]))
    assert np.isfinite(state.log_weights).all()
    np.testing.assert_allclose(state.model_probabilities[0], [0.8, 0.2, 0.0], atol=1e-12)


@pytest.mark.parametrize("rate_deg_s", [0.0, 1e-9, 3.0, -2.0, 36.0, 72.0])
def test_turn_prediction_is_the_printed_transition(rate_deg_s):
    """Half and whole circles per step included: no division by the sine of the turn."""
    bank = random_bank(np.random.default_rng(5), n=1, r=1)
    rate = math.radians(rate_deg_s)
    found = mix_and_predict(bank, np.eye(1), np.array([7.0]), np.array([rate]), STEP_S)
    F = turning(STEP_S, rate if abs(rate) > 1e-8 else 0.0)
    np.testing.assert_allclose(found.mean[0, 0], F @ bank.mean[0, 0], rtol=1e-9, atol=1e-5)
    expected = F @ bank.cov[0, 0] @ F.T + process_noise(STEP_S, 7.0)
    np.testing.assert_allclose(found.cov[0, 0], expected, rtol=1e-8, atol=1e-2)


# ------------------------------------------------------------------------------------------------ association


@pytest.mark.parametrize("jitter", [-0.002, 0.0, 0.0015])
@pytest.mark.parametrize("filters", [1, 2])
def test_filters_average_over_all_joint_assignments(jitter, filters):
    """Two tracks want three bearings of one station: weights and moments from enumeration (e⁻⁹ apart, left out)."""
    rng, std = np.random.default_rng(10), 0.0005
    model = AssociationModel(gate_sigma=4.0, detection_probability=0.9, false_bearing_density=0.05)
    miss, hit = model.log_costs()
    angles, z = np.array([0.6, 0.613]), np.array([0.592, 0.6065 + jitter, 0.621])
    distance = 2.5e4 + 800.0 * np.arange(filters)
    mean = np.zeros((2, filters, 4))
    mean[..., :2] = distance[:, None] * np.stack([np.cos(angles), np.sin(angles)], axis=-1)[:, None]
    cov = np.broadcast_to(np.diag([250.0, 250.0, 20.0, 20.0]) ** 2, (2, filters, 4, 4))
    weight = rng.dirichlet(np.ones(filters), size=2)
    scan = Scan(z[None], np.ones((1, 3), bool), np.zeros((1, 2)), std)
    branches = {
        (j, i, k): update(Gaussian(mean[j, i], cov[j, i]), z[k], np.zeros(2), std)
        for j, i, k in itertools.product(range(2), range(filters), range(3))
    }

    def joint(j, i, k):
        """v_i L_i(k), detection and clutter included; k = −1 is a miss."""
        factor = math.exp(branches[j, i, k].log_likelihood - hit) if k >= 0 else math.exp(-miss)
        return weight[j, i] * factor

    beta = np.zeros((2, 4))
    for options in itertools.product(range(-1, 3), repeat=2):
        if options[0] != options[1] or options[0] < 0:
            share = math.prod(sum(joint(j, i, k) for i in range(filters)) for j, k in enumerate(options))
            for j, k in enumerate(options):
                beta[j, k] += share
    beta /= beta.sum(1, keepdims=True)
    assert (np.sort(beta)[:, -2] > 0.05).all()
    found = average_and_update(mean, cov, np.log(weight), scan, model, 0.0)
    for j, i in itertools.product(range(2), range(filters)):
        w = np.array([beta[j, k] * joint(j, i, k) / sum(joint(j, h, k) for h in range(filters)) for k in range(-1, 3)])
        states = [mean[j, i]] + [branches[j, i, k].posterior.mean for k in range(3)]
        covs = [cov[j, i]] + [branches[j, i, k].posterior.cov for k in range(3)]
        expected = moment_match(w / w.sum(), np.array(states), np.array(covs))
        assert np.exp(found[2][j, i]) == pytest.approx(w.sum(), abs=1e-3)
        np.testing.assert_allclose(found[0][j, i], expected.mean, rtol=1e-4, atol=0.5)
        scale = np.sqrt(np.diag(expected.cov))
        np.testing.assert_allclose(
            found[1][j, i] / np.outer(scale, scale), expected.cov / np.outer(scale, scale), atol=3e-3
        )


def test_crossing_bearings_keep_their_tracks():
    """Two targets whose bearings cross twice a minute apart, ranges known to 5 %: both tracks stay on their own."""
    rng, tracker = np.random.default_rng(11), AdaptiveRpEkf(process_noise=2.0, maneuver_noise=2.0)
    runs = 200
    truth = np.array([[3e4, -1.5e3, 0.0, 120.0], [4.5e4, 1.5e3, 0.0, -120.0]])
    spread = np.diag([1.5e3, 200.0, 20.0, 20.0])
    start = truth + rng.standard_normal((runs, 2, 4)) @ spread
    lead = (runs, 2, 1, 3)
    state = ModelBank(
        np.broadcast_to(start[:, :, None, None], (*lead, 4)).copy(),
        np.broadcast_to(spread**2, (*lead, 4, 4)).copy(),
        np.broadcast_to(np.log(stationary(tracker._models[0])), lead).copy(),
    )
    for _ in range(12):
        truth = truth @ transition(STEP_S).T
        z = bearing(truth, np.zeros(2)) + rng.normal(0.0, STD, (runs, 2))
        z = np.sort(z, axis=-1)
        scan = Scan(z[:, None], np.ones((runs, 1, 2), bool), np.zeros((1, 2)), STD)
        state = tracker.update(tracker.predict(state, STEP_S), scan).posterior
    mean, cov = tracker.estimate(state)
    assert (np.sign(mean[:, 0, 1] - mean[:, 1, 1]) == np.sign(truth[0, 1] - truth[1, 1])).mean() > 0.97
    assert nees(mean, cov, truth).mean() < 5.0


def test_covariances_stay_positive_definite_in_a_crowd():
    """150 scans: four targets wander across each other within 10 km of two stations, bearings missed and false."""
    rng, runs = np.random.default_rng(13), 6
    tracker = AdaptiveRpEkf(
        floor_m=1e3, cap_m=3e4, model=AssociationModel(detection_probability=0.9, false_bearing_density=0.3)
    )
    truth = np.concatenate([rng.uniform(-8e3, 8e3, (runs, 4, 2)), rng.normal(0.0, 200.0, (runs, 4, 2))], axis=-1)
    stations = np.array([[-3e3, 0.0], [3e3, 500.0]])
    state = None
    for _ in range(150):
        truth = truth @ transition(STEP_S).T
        truth[..., 2:] += rng.normal(0.0, 30.0, (runs, 4, 2)) - 1e-2 * truth[..., :2]
        z = bearing(truth[:, None], stations[:, None]) + rng.normal(0.0, STD, (runs, 2, 4))
        z = np.concatenate([z, rng.uniform(-math.pi, math.pi, (runs, 2, 2))], axis=-1)
        valid = rng.random(z.shape) < np.array([0.9] * 4 + [0.5] * 2)
        if state is None:
            state = tracker.initiate(Scan(z[..., :4], np.ones((runs, 2, 4), bool), stations, STD))
            continue
        state = tracker.update(tracker.predict(state, STEP_S), Scan(z, valid, stations, STD)).posterior
        for part in (*state, *tracker.estimate(state)):
            assert np.isfinite(part).all()
        np.testing.assert_allclose(state.model_probabilities.sum(-1), 1.0)
        alive = state.log_weights > PRUNED
        deviation = np.sqrt(np.diagonal(state.cov[alive], axis1=-2, axis2=-1))
        assert np.linalg.eigvalsh(state.cov[alive] / deviation[:, :, None] / deviation[:, None, :]).min() > 0.0


def test_averaging_refuses_more_than_two_stations():
    bank = random_bank(np.random.default_rng(12), 1).flat()
    three = Scan(np.zeros((3, 1)), np.ones((3, 1), bool), np.zeros((3, 2)), STD)
    with pytest.raises(ValueError, match="one or two stations, got 3"):
        average_and_update(*bank, three, AssociationModel(), 1e-3)


# ------------------------------------------------------------------------------------------------ as a tracker


def two_station_scans(rng, batch, targets=3, steps=12):
    """Unlabelled, shuffled bearings of turning targets from two moving stations, a few missed: scans of [batch]."""
    angle = rng.uniform(0.2, 1.2, (batch, 1)) + 0.15 * np.arange(targets)
    start = 5e4 * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    course = rng.uniform(-math.pi, math.pi, (batch, targets)) + np.zeros((steps + 1, 1, 1))
    course = course + math.radians(2.0) * STEP_S * np.arange(steps + 1)[:, None, None]
    path = start + 220.0 * STEP_S * np.stack([np.cos(course), np.sin(course)], axis=-1).cumsum(0)
    for k in range(steps + 1):
        stations = np.array([[-9e3, 500.0 + 900.0 * k], [4e3 + 700.0 * k, 3e3]])
        z = bearing(path[k][:, None], stations[:, None]) + rng.normal(0.0, STD, (batch, 2, targets))
        order = rng.permuted(np.tile(np.arange(targets), (batch, 2, 1)), axis=-1)
        valid = np.ones_like(z, bool) if k == 0 else rng.random(z.shape) < 0.95
        yield Scan(
            np.take_along_axis(z, order, axis=-1) if k else z, valid, np.broadcast_to(stations, (batch, 2, 2)), STD
        )


def run(tracker, scans):
    state = None
    for scan in scans:
        state = tracker.initiate(scan) if state is None else tracker.update(tracker.predict(state, STEP_S), scan)[0]
    return state


@pytest.mark.parametrize("reference_only", [False, True])
def test_batch_equals_loop_with_the_empty_batch(reference_only):
    tracker = AdaptiveRpEkf(reference_only=reference_only)
    scans = list(two_station_scans(np.random.default_rng(6), 5))
    whole = run(tracker, scans)
    for e in range(5):
        one = run(tracker, [Scan(s.bearings[e], s.valid[e], s.stations[e], STD) for s in scans])
        for part, expected in zip(whole, one, strict=True):
            np.testing.assert_array_equal(part[e], expected)
        np.testing.assert_array_equal(tracker.estimate(whole).cov[e], tracker.estimate(one).cov)
    none = run(tracker, [Scan(s.bearings[:0], s.valid[:0], s.stations[:0], STD) for s in scans])
    assert none.mean.shape == (0, 3, 8, 3, 4)
    assert none.model_probabilities.shape == (0, 3, 3)


def test_the_order_of_bearings_and_of_targets_does_not_matter():
    """Slots in any order give the same tracks; first bearings in another order give the tracks in that order."""
    tracker = AdaptiveRpEkf()
    scans = list(two_station_scans(np.random.default_rng(7), 4))
    expected = tracker.estimate(run(tracker, scans))
    for order in itertools.permutations(range(3)):
        mixed = [Scan(s.bearings[..., order], s.valid[..., order], s.stations, STD) for s in scans]
        found = tracker.estimate(run(tracker, [scans[0], *mixed[1:]]))
        np.testing.assert_allclose(found.mean, expected.mean, rtol=1e-9)
        renumbered = tracker.estimate(run(tracker, mixed))
        np.testing.assert_allclose(renumbered.mean, expected.mean[:, order], rtol=1e-9)


def test_it_notices_a_turn_and_its_end():
    """A target 25 km off flies straight, turns left at 2°/s for 30 s, flies on; two stations, σ = 0.05°."""
    std, tracker = math.radians(0.05), AdaptiveRpEkf(floor_m=5e3)
    stations = np.array([[-9e3, 0.0], [9e3, 0.0]])
    rate = np.zeros(40)
    rate[15:21] = math.radians(2.0)
    course = 0.5 + np.concatenate([[0.0], np.cumsum(rate * STEP_S)])
    rng = np.random.default_rng(8)
    x = np.array([2e3, 2.5e4])
    state, left = None, []
    for k in range(41):
        z = bearing(x, stations) + rng.normal(0.0, std, 2)
        scan = Scan(z[:, None], np.ones((2, 1), bool), stations, std)
        state = tracker.initiate(scan) if state is None else tracker.update(tracker.predict(state, STEP_S), scan)[0]
        left.append(state.model_probabilities[0, 1])
        np.testing.assert_allclose(state.model_probabilities.sum(-1), 1.0)
        x = x + 250.0 * STEP_S * np.array([math.cos(course[k]), math.sin(course[k])])
    assert max(left[17:22]) > 0.8
    assert max(left[8:15]) < 0.3
    assert left[-1] < 0.3


def test_on_turning_targets_it_is_better_and_more_honest_than_any_one_noise_level():
    """One platform on a zigzag, targets that turn at 1 to 3°/s for 10 to 30 s now and then: final position error and
    mean NEES against constant-velocity banks."""
    rng, runs, steps = np.random.default_rng(9), 800, 60
    settings = {"floor_m": 15e3, "cap_m": 120e3, "second_order": True, "merge_below": 1.0}
    rate = np.zeros((steps, runs))
    for i in range(runs):
        k = rng.integers(0, 8)
        while k < steps:
            last = k + rng.integers(2, 7)
            rate[k:last, i] = math.radians(rng.uniform(1.0, 3.0)) * rng.choice([-1, 1])
            k = last + rng.integers(4, 13)
    course = rng.uniform(-math.pi, math.pi, runs) + np.concatenate([np.zeros((1, runs)), STEP_S * rate.cumsum(0)])
    angle, distance = rng.uniform(-math.pi, math.pi, runs), rng.uniform(25e3, 90e3, runs)
    speed = rng.uniform(100.0, 300.0, runs)
    truth = np.empty((steps + 1, runs, 4))
    truth[0, :, :2] = np.column_stack([distance * np.cos(angle), distance * np.sin(angle)])
    truth[..., 2:] = speed[:, None] * np.stack([np.cos(course), np.sin(course)], axis=-1)
    for k in range(steps):
        truth[k + 1, :, :2] = truth[k, :, :2] + STEP_S * (truth[k, :, 2:] + truth[k + 1, :, 2:]) / 2
    noise = rng.normal(0.0, STD, (steps + 1, runs))

    def final(tracker):
        position, heading = np.zeros((runs, 2)), np.zeros(runs)
        state = None
        for k in range(steps + 1):
            z = bearing(truth[k], position) + noise[k]
            scan = Scan(z[:, None, None], np.ones((runs, 1, 1), bool), position[:, None], STD)
            state = tracker.initiate(scan) if state is None else tracker.update(tracker.predict(state, STEP_S), scan)[0]
            wish = z + math.radians(50.0) * (1.0 if k // 8 % 2 == 0 else -1.0)
            heading = heading + np.clip((wish - heading + math.pi) % (2 * math.pi) - math.pi, -0.26, 0.26)
            position = position + 250.0 * STEP_S * np.column_stack([np.cos(heading), np.sin(heading)])
        mean, cov = (part[:, 0] for part in tracker.estimate(state))
        return np.linalg.norm((mean - truth[-1])[:, :2], axis=-1).mean(), nees(mean, cov, truth[-1]).mean()

    error, consistency = final(AdaptiveRpEkf(**settings))
    for q in (5.0, 10.0, 20.0):
        other_error, other_consistency = final(RpEkf(**settings, process_noise=q))
        assert error < 0.95 * other_error
        assert consistency < other_consistency
    assert consistency < 8.0


# ------------------------------------------------------------------------------------------------ settings


def test_it_is_known_by_name():
    assert TRACKERS["rp_ekf_adaptive"] is AdaptiveRpEkf


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"maneuver_noise": -1.0}, "maneuver_noise = -1.0: must be at least 0"),
        ({"maneuver_noise": math.nan}, "maneuver_noise = nan: must be at least 0"),
        ({"turn_rates_deg_s": (2.0, math.inf)}, "turn_rates_deg_s = .*must be finite"),
        ({"turn_rates_deg_s": (2.0,)}, "transition = .*must be 2 rows of 2"),
        ({"transition": ((0.5, 0.5), (0.5, 0.5))}, "transition = .*must be 3 rows of 3"),
        ({"transition": ((1.0, 0.0, 0.0), (0.5, 0.5), (0.0, 0.0, 1.0))}, "transition = .*must be 3 rows of 3"),
        ({"transition": ((1.0, 0.0, 0.0), (0.5, 0.4, 0.0), (0.0, 0.0, 1.0))}, "transition = .*summing to 1"),
        ({"transition": ((1.2, -0.2, 0.0), (0.5, 0.5, 0.0), (0.0, 0.0, 1.0))}, "transition = .*probabilities"),
        ({"transition": ((math.nan, 0.0, 1.0), (0.5, 0.5, 0.0), (0.0, 0.0, 1.0))}, "transition = .*probabilities"),
    ],
)
def test_settings_that_cannot_be_are_refused(settings, words):
    with pytest.raises(ValueError, match=f"AdaptiveRpEkf.{words}"):
        AdaptiveRpEkf(**settings)
