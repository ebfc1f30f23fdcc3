"""Range sums: measurement, intersections, start, filter with maneuver test and bounds, each by two routes."""

from __future__ import annotations

import itertools
from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import approx_fprime, least_squares
from scipy.stats import binom, chi2, multivariate_normal

from trackers import RANGE_SUM_TRACKERS, Gaussian, RangeSumEkf, RangeSumScan, RangeSumTrack, RangeSumTracker
from trackers.axis_motion import axis_noise, axis_transition
from trackers.consistency import mean_band, nees
from trackers.ellipse_intersection import Intersections, branch, intersect, pick_root
from trackers.range_sum import dilution, range_sum, range_sum_jacobian
from trackers.range_sum_bounds import advance, position_std, posterior_bound
from trackers.range_sum_start import fixed_damping_step

KM = 1e3
POOR = KM * np.array([[-32.0, -33.0, 0.05], [0.0, -45.0, 0.06], [-10.0, -90.0, 0.1]])
POOR_RECEIVER = np.zeros(3)
GOOD = KM * np.array([[-108.0, -124.7, 0.0], [-108.0, 124.7, 0.0], [108.0, 0.0, 0.0]])
GOOD_RECEIVER = KM * np.array([-36.0, 0.0, 0.1])
TARGET = np.array([-100e3, 150e3, 10e3, 200.0, -100.0, 0.0])
GUESS = Gaussian(
    np.array([-80e3, 130e3, 8e3, 0.0, 0.0, 0.0]), np.diag(np.square([20e3, 20e3, 3e3, 200.0, 200.0, 10.0]))
)
NOISE = np.array([1.0, 1.0, 0.01])
STD_M = 200.0


def fly(rng, runs, steps, start=TARGET, noise=NOISE):
    """Paths [runs, steps + 1, 2d] with the model's accelerations, scans a second apart."""
    d = np.shape(start)[-1] // 2
    a = rng.standard_normal((runs, steps, d)) * np.sqrt(noise[:d])
    path = np.empty((runs, steps + 1, 2 * d))
    path[:, 0] = start
    for k in range(steps):
        path[:, k + 1, :d] = path[:, k, :d] + path[:, k, d:] + 0.5 * a[:, k]
        path[:, k + 1, d:] = path[:, k, d:] + a[:, k]
    return path


def hear(rng, path, transmitters, receiver, share=1.0):
    """Scans [runs, steps + 1, n] along the paths; a share of the echoes arrives."""
    d = path.shape[-1] // 2
    sums = range_sum(path[..., :d], receiver, transmitters)
    valid = rng.random(sums.shape) < share
    sums = np.where(valid, sums + STD_M * rng.standard_normal(sums.shape), 0.0)
    sites = np.broadcast_to(transmitters, (*sums.shape, d))
    return RangeSumScan(sums, valid, sites, np.broadcast_to(receiver, path[..., :d].shape), np.full(sums.shape, STD_M))


def at(scans, key):
    """The scans at an index or a slice of time, the axis after the runs'."""
    return RangeSumScan(*(part[:, key] for part in scans))


def follow(tracker, scans, first=10, guess=GUESS):
    """Start from the first scans, filter the others: the last update and all updates' tests [runs, k]."""
    state, fired, tracks = tracker.initiate(at(scans, slice(first)), guess, np.arange(first)), [], []
    for k in range(first, scans.range_sums.shape[1]):
        update = tracker.update(tracker.predict(state, 1.0), at(scans, k))
        state = update.posterior
        fired.append(update.maneuver)
        tracks.append(state)
    return tracks, np.stack(fired, axis=1)


# -- measurement ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("d", [2, 3])
def test_jacobian_equals_finite_differences(d):
    rng = np.random.default_rng(d)
    p, receiver, sites = rng.uniform(-1e5, 1e5, d), rng.uniform(-1e4, 1e4, d), rng.uniform(-1e5, 1e5, (4, d))
    slopes = approx_fprime(p, lambda x: range_sum(x, receiver, sites), 1.0)
    np.testing.assert_allclose(range_sum_jacobian(p, receiver, sites), slopes, atol=1e-4)


def test_range_sum_is_the_way_by_the_target():
    assert range_sum([3.0, 4.0], [0.0, 0.0], [[3.0, 0.0], [15.0, 9.0]]) == pytest.approx([9.0, 18.0])


def test_dilution_of_the_papers_layouts():
    """Specification, section 3: 200 m, 10 km height."""
    for sites, receiver, told in ((POOR, POOR_RECEIVER, (23022, 2407, 22895)), (GOOD, GOOD_RECEIVER, (992, 318, 940))):
        found = dilution(range_sum_jacobian(TARGET[:3], receiver, sites), STD_M)
        assert np.array(found) == pytest.approx(told, rel=2e-3)


def test_dilution_equals_the_inverse_information():
    rng = np.random.default_rng(5)
    H, std = rng.standard_normal((7, 5, 3)), rng.uniform(50.0, 300.0, (7, 5))
    cov = np.linalg.inv(np.einsum("bn,bni,bnj->bij", std**-2, H, H))
    found = dilution(H, std)
    np.testing.assert_allclose(found.vertical, np.sqrt(cov[:, 2, 2]))
    np.testing.assert_allclose(found.horizontal, np.sqrt(cov[:, 0, 0] + cov[:, 1, 1]))
    np.testing.assert_allclose(found.position, np.hypot(found.vertical, found.horizontal))
    flat = dilution(H[..., :2], std)
    assert (flat.vertical == 0.0).all()
    assert (flat.position < found.horizontal).all()


def test_the_printed_good_layout_fixes_nothing():
    """The paper's section 3.2 prints T1 = T2 (specification, section 8.1)."""
    printed = GOOD[[0, 0, 2]]
    found = dilution(range_sum_jacobian(TARGET[:3], GOOD_RECEIVER, printed), STD_M)
    assert np.isinf(found).all()
    with pytest.raises(ValueError, match=r"intersect: transmitters coincide or lie on one line"):
        intersect(range_sum(TARGET[:3], GOOD_RECEIVER, printed), printed, GOOD_RECEIVER)


# -- intersections ----------------------------------------------------------------------------------------------------


def geometries(rng, d, kind, count=2000):
    """Targets [count, d], transmitters [count, d, d] and receivers [count, d] within some 100 km."""
    p, sites, receiver = (rng.uniform(-1e5, 1e5, (count, *shape)) for shape in ((d,), (d, d), (d,)))
    if kind == "level":
        sites[..., -1] = receiver[..., -1:] = 0.0
    if kind == "collinear":
        line = rng.standard_normal((count, d))
        sites, receiver = sites[..., :1] * line[:, None], receiver[..., :1] * line
    return p, sites, receiver


CASES = [(2, "any"), (2, "collinear"), (3, "any"), (3, "level")]


@pytest.mark.parametrize(("d", "kind"), CASES)
def test_intersections_on_2000_geometries(d, kind):
    p, sites, receiver = geometries(np.random.default_rng(11), d, kind)
    sums = range_sum(p, receiver, sites)
    found = intersect(sums, sites, receiver)
    assert found.valid.all()
    off = np.linalg.norm(found.position - p[:, None], axis=-1).min(-1)
    assert (off < 1e-6 * np.linalg.norm(p, axis=-1)).all()
    told = range_sum(found.position, receiver[:, None], sites[:, None])
    np.testing.assert_allclose(told, np.broadcast_to(sums[:, None], told.shape), rtol=1e-9)
    signs = branch(found.position, sites[:, None], receiver[:, None])
    assert (signs == [1.0, -1.0]).all()


@pytest.mark.parametrize(("d", "kind"), CASES)
def test_intersections_equal_least_squares(d, kind):
    """Started at another place than the roots, least squares lands on one of them."""
    rng = np.random.default_rng(12)
    p, sites, receiver = geometries(rng, d, kind, 40)
    sums = range_sum(p, receiver, sites)
    roots = intersect(sums, sites, receiver).position
    landed = 0
    for case in range(40):
        for root in roots[case]:
            solved = least_squares(
                lambda x, i: range_sum(x, receiver[i], sites[i]) - sums[i],
                root + rng.normal(0.0, 300.0, d), args=(case,), xtol=1e-15, ftol=1e-15, gtol=1e-15,
            )  # fmt: skip
            if solved.cost < 1e-6:
                off = np.linalg.norm(solved.x - roots[case], axis=-1).min()
                assert off < 1e-6 * np.linalg.norm(solved.x)
                landed += 1
    assert landed > 60


def test_mirror_of_the_poor_layout_and_ghost_of_two_transmitters():
    """Specification, sections 6 and 7."""
    roots = intersect(range_sum(TARGET[:3], POOR_RECEIVER, POOR), POOR, POOR_RECEIVER)
    assert sorted(roots.position[:, 2]) == pytest.approx([-10.2e3, 10e3], rel=0.01)
    p, sites = np.array([5e3, 5e3]), POOR[:2, :2]
    roots = intersect(range_sum(p, np.zeros(2), sites), sites, np.zeros(2))
    assert roots.position[0] == pytest.approx([5e3, 5e3])
    assert roots.position[1] == pytest.approx([-14.5e3, -39.0e3], rel=5e-3)


def side_of_polyline(p, sites, receiver):
    """Which side of the ray, the two segments and the ray p is on: parity of crossings of a way from a fixed side."""
    outwards = sites + 1e3 * (sites - sites[::-1])
    corners = np.array([outwards[0], sites[0], receiver, sites[1], outwards[1]])
    angle = sum(np.angle(complex(*(b - p)) / complex(*(a - p))) for a, b in itertools.pairwise(corners))
    return angle > 0.0


def test_true_and_ghost_lie_on_opposite_sides_of_the_polyline():
    """Specification, section 6: 200 random geometries, all."""
    p, sites, receiver = geometries(np.random.default_rng(13), 2, "any", 200)
    roots = intersect(range_sum(p, receiver, sites), sites, receiver).position
    for pair, t, r in zip(roots, sites, receiver, strict=True):
        assert side_of_polyline(pair[0], t, r) != side_of_polyline(pair[1], t, r)


def test_sums_no_point_has_leave_no_valid_root():
    sites = np.array([[30e3, 0.0], [0.0, 30e3]])
    short = intersect([20e3, 45e3], sites, np.zeros(2))  # below the baseline
    apart = intersect([30.001e3, 300e3], sites, np.zeros(2))  # one ellipse around the other
    for found in (short, apart):
        assert not found.valid.any()
        assert (found.position == 0.0).all()


def test_coincident_transmitters_are_refused():
    sites = np.array([[[3e4, 0.0], [0.0, 3e4]], [[1e4, 2e4], [1e4, 2e4]]])
    with pytest.raises(ValueError, match=r"transmitters\[1\] coincide"):
        intersect(np.full((2, 2), 1e5), sites, np.zeros(2))
    with pytest.raises(ValueError, match=r"must be \[\.\.\., d\]"):
        intersect(np.full(3, 1e5), sites[0], np.zeros(2))
    with pytest.raises(ValueError, match="range_sums must be finite"):
        intersect([np.nan, 1e5], sites[0], np.zeros(2))


def test_root_by_third_echo_and_by_side():
    """Specification, section 6: the third sum differs by 10 km at the ghost."""
    p, pool, receiver = np.array([5e3, 5e3]), POOR[:, :2], np.zeros(2)
    sums = range_sum(p, receiver, pool)
    roots = intersect(sums[:2], pool[:2], receiver)
    ghost_sum = range_sum(roots.position[1], receiver, pool)[2]
    assert abs(ghost_sum - sums[2]) == pytest.approx(10e3, rel=0.15)
    for third, side, chosen in ((True, -1.0, 0), (False, -1.0, 1), (False, 1.0, 0)):
        scan = RangeSumScan(sums, np.array([True, True, third]), pool, receiver, np.full(3, STD_M))
        assert pick_root(roots, scan, side) == (chosen, True)
    none = Intersections(np.zeros((2, 2)), np.zeros(2, bool))
    assert not pick_root(none, scan, 1.0)[1]


def test_roots_below_ground_are_not_valid():
    """Level sites: the mirror image has the same sums; and in a batch the rule is each row's own."""
    level, receiver = GOOD * [1.0, 1.0, 0.0], np.zeros(3)
    places = np.array([TARGET[:3], TARGET[:3] * [1.0, -1.0, 0.5]])
    sums = range_sum(places, receiver, level)
    assert intersect(sums, level, receiver).valid.all()
    found = intersect(sums, level, receiver, floor_m=0.0)
    assert (found.valid.sum(-1) == 1).all()
    np.testing.assert_allclose(found.position[found.valid], places, rtol=1e-6)
    assert (found.position[~found.valid] == 0.0).all()
    assert not intersect(sums, level, receiver, floor_m=20e3).valid.any()
    with pytest.raises(ValueError, match="floor_m = nan"):
        intersect(sums, level, receiver, floor_m=np.nan)


@pytest.mark.parametrize("d", [2, 3])
def test_roots_are_picked_in_a_batch(d):
    """A sum more than there are dimensions tells target from ghost, whatever the side says: 500 random geometries."""
    rng = np.random.default_rng(40 + d)
    p, sites, receiver = geometries(rng, d, "any", 500)
    pool = np.concatenate([sites, rng.uniform(-1e5, 1e5, (500, 2, d))], axis=1)
    exact = range_sum(p, receiver, pool)
    sums = exact + 20.0 * rng.standard_normal(exact.shape)
    roots = intersect(sums[:, :d], sites, receiver)
    scan = RangeSumScan(sums, np.ones(sums.shape, bool), pool, receiver, np.full(sums.shape, 20.0))
    off = np.linalg.norm(roots.position - p[:, None], axis=-1)
    away = np.linalg.norm(roots.position[:, 0] - roots.position[:, 1], axis=-1) > 10e3
    judged = away & roots.valid.all(-1)
    assert judged.sum() > 400
    index, found = pick_root(roots, scan, -branch(p, sites, receiver))
    assert found[judged].all()
    assert (index[judged] == off.argmin(-1)[judged]).mean() > 0.97
    alone = pick_root(roots, scan._replace(valid=np.arange(d + 2) < d + np.zeros((500, 1))), branch(p, sites, receiver))
    assert (alone[0][judged] == off.argmin(-1)[judged]).mean() > 0.98


def test_an_uncertain_root_does_not_decide():
    """Near det H = 0 a third sum that misses the root by many σ is explained by the root's own uncertainty."""
    receiver, pool = np.zeros(2), np.array([[60e3, 0.0], [60e3, 4e3], [0.0, 60e3]])
    p = np.array([30e3, 50e3])
    sums = range_sum(p, receiver, pool) + np.array([STD_M, -STD_M, 0.0])
    roots = intersect(sums[:2], pool[:2], receiver)
    near = np.linalg.norm(roots.position - p, axis=-1).argmin()
    off = np.abs(range_sum(roots.position, receiver, pool)[:, 2] - sums[2])
    assert (off[near], off[1 - near]) > (6.0 * STD_M, 6.0 * STD_M)
    scan = RangeSumScan(sums, np.ones(3, bool), pool, receiver, np.full(3, STD_M))
    for side in (-1.0, 1.0):
        assert pick_root(roots, scan, side) == (near, True)


# -- filter -----------------------------------------------------------------------------------------------------------


def curvature(x, P, scan, d):
    """What second derivatives [n, d, d] of the sums, by finite differences, make of P: means and variances [n]."""
    steps = np.eye(d)

    def slopes(p):
        return range_sum_jacobian(p, scan.receiver, scan.transmitters)

    G = np.stack([(slopes(x[:d] + h) - slopes(x[:d] - h)) / 2.0 for h in steps], axis=-1) @ P[:d, :d]
    return 0.5 * np.trace(G, axis1=1, axis2=2), 0.5 * np.trace(G @ G, axis1=1, axis2=2)


def dense_update(x, P, scan, step_s, tracker):
    """The update as the paper writes it, stacked and with matrix inverses; with curvature, if the tracker's counts."""
    d, used = len(x) // 2, scan.valid
    H = np.zeros((used.sum(), 2 * d))
    H[:, :d] = range_sum_jacobian(x[:d], scan.receiver, scan.transmitters)[used]

    def residuals(P):
        bias, extra = curvature(x, P, scan, d) if tracker.second_order else np.zeros((2, len(used)))
        missed = scan.range_sums - range_sum(x[:d], scan.receiver, scan.transmitters) - bias
        return missed[used], np.diag((scan.std**2 + extra)[used])

    e, R = residuals(P)
    first = e
    J = e @ np.linalg.inv(H @ P @ H.T + R) @ e if used.any() else 0.0
    fired = used.any() and tracker.false_alarm > 0 and chi2.sf(J, used.sum()) <= tracker.false_alarm
    if fired:
        P = P + (tracker.inflation**2 - 1.0) * axis_noise(step_s, tracker.noise[:d])
        e, R = residuals(P)
    S = H @ P @ H.T + R
    K = P @ H.T @ np.linalg.inv(S)
    joseph = np.eye(2 * d) - K @ H
    log_likelihood = multivariate_normal(np.zeros(len(e)), S).logpdf(e) if used.any() else 0.0
    return x + K @ e, joseph @ P @ joseph.T + K @ R @ K.T, first, J, fired, log_likelihood


@pytest.mark.parametrize("d", [2, 3])
@pytest.mark.parametrize("name", RANGE_SUM_TRACKERS)
def test_filter_equals_dense_numpy(d, name):
    """Echoes come and go; a jump in velocity makes the test fire."""
    tracker, rng = RANGE_SUM_TRACKERS[name](restart_std_m=0.0), np.random.default_rng(20 + d)
    pool = np.concatenate([POOR, GOOD])[:, :d]
    path = fly(rng, 1, 120, TARGET.reshape(2, 3)[:, :d].ravel())
    path[:, 60:, 0] += 100.0 * np.arange(61) ** 1.5
    scans = hear(rng, path, pool, np.zeros(d), share=0.4)
    x, P = path[0, 0], np.diag([1e3] * d + [50.0] * d) ** 2.0
    state, fired = RangeSumTrack(x, P, 0.0), 0
    A, Q = axis_transition(1.0, d), axis_noise(1.0, NOISE[:d])
    for k in range(1, 121):
        scan = RangeSumScan(*(part[0, k] for part in scans))
        x, P = A @ x, A @ P @ A.T + Q
        update = tracker.update(tracker.predict(state, 1.0), scan)
        x, P, innovation, *told = dense_update(x, P, scan, 1.0, tracker)
        np.testing.assert_allclose(update.innovation[scan.valid], innovation, rtol=1e-6, atol=1e-4)
        assert (update.innovation[~scan.valid] == 0.0).all()
        np.testing.assert_allclose(
            (update.statistic, update.maneuver, update.log_likelihood), np.array(told, dtype=float), rtol=1e-5
        )
        np.testing.assert_allclose(update.posterior.mean, x, rtol=1e-7, atol=1e-4)
        np.testing.assert_allclose(update.posterior.cov, P, rtol=1e-5, atol=1e-3)
        np.testing.assert_array_equal(update.used, scan.valid)
        state, fired = update.posterior, fired + update.maneuver
    assert (fired > 0) == (tracker.false_alarm > 0.0)


def test_innovation_variance_is_the_predictions():
    rng = np.random.default_rng(3)
    path = fly(rng, 1, 1)
    scan = RangeSumScan(*(part[0, 1] for part in hear(rng, path, POOR, POOR_RECEIVER)))
    scan = scan._replace(valid=np.array([True, False, True]))
    state = RangeSumTrack(path[0, 1], GUESS.cov, 1.0)
    H = range_sum_jacobian(state.mean[:3], POOR_RECEIVER, POOR)
    spread = np.einsum("ni,ij,nj->n", H, GUESS.cov[:3, :3], H)
    found = RangeSumEkf().update(state, scan)
    np.testing.assert_allclose(found.innovation_var, STD_M**2 + np.where(scan.valid, spread, 0.0))
    assert found.innovation[1] == 0.0


def test_batch_equals_loop():
    rng, tracker = np.random.default_rng(4), RangeSumEkf()
    scans = hear(rng, fly(rng, 5, 12), POOR, POOR_RECEIVER, share=0.7)
    batch = follow(tracker, scans)[0][-1]
    for run in range(5):
        alone = follow(tracker, RangeSumScan(*(part[run : run + 1] for part in scans)))[0][-1]
        for one, all_ in zip(alone[:2], batch[:2], strict=True):
            np.testing.assert_array_equal(one[0], all_[run])
    empty = follow(tracker, RangeSumScan(*(part[:0] for part in scans)))[0][-1]
    assert empty.mean.shape == (0, 6)
    estimate = tracker.estimate(batch)
    assert estimate.mean.shape == (5, 1, 6)
    assert estimate.cov.shape == (5, 1, 6, 6)


def test_trackers_obey_the_contract():
    for make in RANGE_SUM_TRACKERS.values():
        assert isinstance(make(), RangeSumTracker)


def test_coasts_without_an_echo():
    tracker, state = RangeSumEkf(), RangeSumTrack(TARGET, GUESS.cov, 1.0)
    silent = RangeSumScan(np.zeros(3), np.zeros(3, bool), POOR, POOR_RECEIVER, np.full(3, STD_M))
    found = tracker.update(state, silent)
    np.testing.assert_array_equal(found.posterior.mean, TARGET)
    np.testing.assert_array_equal(found.posterior.cov, GUESS.cov)
    assert (found.log_likelihood, found.statistic, found.maneuver, found.used.any()) == (0.0, 0.0, False, False)


def test_echoes_come_and_go():
    """The third transmitter falls silent for 60 s, then the second as well for 20 s: honest all the way."""
    rng = np.random.default_rng(10)
    path = fly(rng, 200, 160)
    scans = hear(rng, path, GOOD, GOOD_RECEIVER)
    heard = np.ones(scans.valid.shape, bool)
    heard[:, 60:120, 2] = heard[:, 90:110, 1] = False
    tracks, _ = follow(RangeSumEkf(), scans._replace(valid=heard))
    low, high = mean_band(6, 200)
    errors = []
    for second in (59, 89, 109, 160):
        state = tracks[second - 10]
        assert low < nees(state.mean, state.cov, path[:, second]).mean() < high
        errors.append(np.linalg.norm(state.mean[:, :2] - path[:, second, :2], axis=-1).mean())
    assert errors[0] < errors[1] < errors[2]
    assert errors[3] < 1.2 * errors[0]


def test_a_sum_below_the_baseline_is_not_used():
    sums = range_sum(TARGET[:3], POOR_RECEIVER, POOR)
    sums[1] = np.linalg.norm(POOR[1]) - 7.0 * STD_M
    scan = RangeSumScan(sums, np.ones(3, bool), POOR, POOR_RECEIVER, np.full(3, STD_M))
    found = RangeSumEkf().update(RangeSumTrack(TARGET, GUESS.cov, 1.0), scan)
    np.testing.assert_array_equal(found.used, [True, False, True])
    sums[1] = np.linalg.norm(POOR[1]) - 5.0 * STD_M
    assert RangeSumEkf().update(RangeSumTrack(TARGET, GUESS.cov, 1.0), scan._replace(range_sums=sums)).used.all()


def test_estimates_below_ground_are_turned_up():
    """With level sites the mirror image has the same sums: the turned track is the one of the turned prediction."""
    rng, tracker = np.random.default_rng(6), RangeSumEkf()
    level = GOOD * [1.0, 1.0, 0.0]
    a = rng.standard_normal((6, 6)) * np.array([3e3, 3e3, 1e3, 50, 50, 5])
    above = RangeSumTrack(TARGET, a.T @ a, 1.0)
    flip = np.diag([1.0, 1.0, -1.0, 1.0, 1.0, -1.0])
    below = RangeSumTrack(flip @ TARGET, flip @ above.cov @ flip, 1.0)
    sums = range_sum(TARGET[:3], np.zeros(3), level) + 100.0
    scan = RangeSumScan(sums, np.ones(3, bool), level, np.zeros(3), np.full(3, STD_M))
    one, other = tracker.update(above, scan).posterior, tracker.update(below, scan).posterior
    assert one.mean[2] > 0.0
    np.testing.assert_allclose(other.mean, one.mean)
    np.testing.assert_allclose(other.cov, one.cov)
    sunk = replace(tracker, floor_m=-1e6).update(below, scan).posterior
    assert sunk.mean[2] < 0.0


def test_false_alarm_rate_of_the_maneuver_test():
    """On a target that flies by the filter's own model; the band is the binomial's."""
    rng = np.random.default_rng(7)
    scans = hear(rng, fly(rng, 300, 110), GOOD, GOOD_RECEIVER)
    for false_alarm in (1e-3, 1e-2):
        _, fired = follow(RangeSumEkf(false_alarm=false_alarm, inflation=1.0), scans, first=20)
        low, high = binom.ppf([1e-3, 1 - 1e-3], fired.size, false_alarm)
        assert low <= fired.sum() <= high


def test_filter_is_honest_in_the_good_layout():
    rng = np.random.default_rng(8)
    path = fly(rng, 200, 100)
    tracks, _ = follow(RangeSumEkf(), hear(rng, path, GOOD, GOOD_RECEIVER))
    low, high = mean_band(6, 200)
    assert low < nees(tracks[-1].mean, tracks[-1].cov, path[:, -1]).mean() < high


def test_maneuver_test_follows_a_turn_that_the_plain_filter_loses():
    """Specification, scenario C in short: 12.8 m/s² for 30 s."""
    rng = np.random.default_rng(9)
    path = fly(rng, 40, 100)
    t = np.clip(np.arange(101.0) - 60.0, 0.0, 30.0)[:, None]
    path[..., :2] += (0.5 * t**2 + t * np.clip(np.arange(101.0)[:, None] - 90.0, 0.0, None)) * [-8.0, 10.0]
    scans = hear(rng, path, GOOD, GOOD_RECEIVER)
    errors = []
    for name in ("ekf", "ekf_literal"):
        tracks, _ = follow(RANGE_SUM_TRACKERS[name](), scans)
        errors.append(np.linalg.norm(tracks[80].mean[:, :2] - path[:, 90, :2], axis=-1).mean())
    assert errors[0] < 350.0 < 900.0 < errors[1]


def ghost_track(runs, further):
    """Tracks on scenario D's ghost, and scans of a third transmitter from second `further` on, in a plane."""
    rng = np.random.default_rng(77)
    path = fly(rng, runs, further + 30, np.array([5e3, 5e3, 100.0, 200.0]))
    scans = hear(rng, path, POOR[:, :2], np.zeros(2))
    heard = np.ones(scans.valid.shape, bool)
    heard[:, :further, 2] = False
    guess = Gaussian(np.array([-30e3, -40e3, 0.0, 0.0]), np.diag(np.square([20e3, 20e3, 200.0, 200.0])))
    return path, scans._replace(valid=heard), guess


@pytest.mark.parametrize("further", [30, 200])
def test_a_third_echo_brings_a_ghost_track_home(further):
    """Specification, section 6: the branch is rejected by its large J, and the track is the target's from then on."""
    path, scans, guess = ghost_track(50, further)
    for restart_std_m, at_home in ((10e3, True), (0.0, False)):
        tracks, _ = follow(RangeSumEkf(restart_std_m=restart_std_m), scans, 10, guess)
        off = [np.linalg.norm(t.mean[:, :2] - path[:, 10 + k, :2], axis=-1) for k, t in enumerate(tracks)]
        assert (off[further - 11] > 30e3).all()
        assert (off[further - 8] < 3e3).all() == at_home
        assert (off[-1] < 1e3).all() or not at_home
    low, high = mean_band(4, 50)
    tracks, _ = follow(RangeSumEkf(restart_std_m=10e3), scans, 10, guess)
    assert low < nees(tracks[-1].mean, tracks[-1].cov, path[:, -1]).mean() < high


def test_restart_of_some_tracks_leaves_the_others():
    """Batch equals loop where one of three tracks is lost; a scan with too few echoes restarts none."""
    scan = RangeSumScan(
        range_sum(TARGET[:3], POOR_RECEIVER, POOR), np.ones(3, bool), POOR, POOR_RECEIVER, np.full(3, STD_M)
    )
    mean = np.array([TARGET, np.add(TARGET, [60e3, -50e3, 0.0, 0.0, 0.0, 0.0]), TARGET])
    state = RangeSumTrack(mean, np.broadcast_to(GUESS.cov * 1e-4, (3, 6, 6)), np.ones(3))
    tracker = RangeSumEkf(restart_std_m=10e3)
    found = tracker.update(state, scan)
    for row in range(3):
        alone = tracker.update(RangeSumTrack(*(part[row] for part in state)), scan).posterior
        np.testing.assert_allclose(alone.mean, found.posterior.mean[row])
        np.testing.assert_allclose(alone.cov, found.posterior.cov[row])
    assert found.maneuver.tolist() == [False, True, False]
    assert nees(found.posterior.mean[1], found.posterior.cov[1], TARGET) < chi2.isf(1e-3, 6)
    kept = replace(tracker, restart_std_m=0.0).update(state, scan).posterior
    np.testing.assert_array_equal(kept.mean[[0, 2]], found.posterior.mean[[0, 2]])
    assert nees(kept.mean[1], kept.cov[1], TARGET) > 100.0
    few = scan._replace(valid=np.array([True, True, False]))
    np.testing.assert_array_equal(
        tracker.update(state, few).posterior.mean, replace(tracker, restart_std_m=0.0).update(state, few).posterior.mean
    )


def test_a_runaway_is_caught():
    """A track 7 km off that claims 50 m: restarted it comes home sooner, and is not flung about in the meantime."""
    rng, pool = np.random.default_rng(78), np.concatenate([POOR, GOOD])[:, :2]
    path = fly(rng, 200, 60, np.array([20e3, 30e3, -150.0, 100.0]))
    scans = hear(rng, path, pool, np.zeros(2), share=0.4)
    course = rng.uniform(0.0, 2.0 * np.pi, 200)
    mean = path[:, 0] + 7e3 * np.stack([np.cos(course), np.sin(course), 0 * course, 0 * course], -1)
    cov = np.broadcast_to(np.diag([50.0, 50.0, 10.0, 10.0]) ** 2, (200, 4, 4))
    off = {}
    for restart_std_m in (0.0, 10e3):
        tracker, state = RangeSumEkf(restart_std_m=restart_std_m), RangeSumTrack(mean, cov, np.zeros(200))
        off[restart_std_m] = np.empty((60, 200))
        for k in range(60):
            state = tracker.update(tracker.predict(state, 1.0), at(scans, k + 1)).posterior
            off[restart_std_m][k] = np.linalg.norm(state.mean[:, :2] - path[:, k + 1, :2], axis=-1)
    assert (off[10e3][-1] < 2e3).all()
    assert off[10e3][:20].mean() < 0.6 * off[0.0][:20].mean()
    assert off[10e3].max() < 0.7 * off[0.0].max()


# -- start ------------------------------------------------------------------------------------------------------------


def start_by_scipy(scans, guess, times):
    """Maximum a posteriori state at time 0 and its covariance by `scipy.optimize.least_squares`."""
    d = guess.mean.size // 2
    root = np.linalg.cholesky(np.linalg.inv(guess.cov)).T

    def residuals(x):
        p = x[:d] + np.asarray(times)[:, None] * x[d:]
        miss = (range_sum(p, scans.receiver, scans.transmitters) - scans.range_sums) / scans.std
        return np.concatenate([miss[scans.valid], root @ (x - guess.mean)])

    scale = np.sqrt(np.diag(guess.cov))
    found = least_squares(residuals, guess.mean, "3-point", x_scale=scale, diff_step=1e-4, xtol=1e-14, ftol=1e-14)
    return found.x, np.linalg.inv(found.jac.T @ found.jac)


@pytest.mark.parametrize("d", [2, 3])
def test_start_equals_scipy(d):
    """Where the posterior is as good as a Gaussian."""
    rng, times = np.random.default_rng(30 + d), np.arange(10) + 0.5
    keep = np.r_[:d, 3 : 3 + d]
    guess = Gaussian(GUESS.mean[keep], GUESS.cov[np.ix_(keep, keep)])
    scans = hear(rng, fly(rng, 6, 9, TARGET[keep]), GOOD[:, :d], GOOD_RECEIVER[:d], share=0.8)
    found = RangeSumEkf(process_noise=(0.0, 0.0, 0.0)).initiate(scans, guess, times)
    A = axis_transition(times[-1], d)
    for run in range(6):
        x, P = start_by_scipy(RangeSumScan(*(part[run] for part in scans)), guess, times)
        std = np.sqrt(np.diag(A @ P @ A.T))
        assert (np.abs(found.mean[run] - A @ x) < 1e-3 * std).all()
        assert (np.abs(found.cov[run] - A @ P @ A.T) < 1e-3 * np.outer(std, std)).all()


def test_start_is_honest():
    """Errors of starts drawn about the guess, in units of the claimed covariance."""
    rng = np.random.default_rng(32)
    lift = np.array([0.0, 0.0, 12e3, 0.0, 0.0, 0.0])
    truth = GUESS.mean + lift + rng.standard_normal((200, 6)) * np.sqrt(np.diag(GUESS.cov))
    guess = GUESS._replace(mean=GUESS.mean + lift)
    path = fly(rng, 200, 9, truth)
    found = RangeSumEkf().initiate(hear(rng, path, GOOD, GOOD_RECEIVER), guess, np.arange(10))
    low, high = mean_band(6, 200)
    assert low < nees(found.mean, found.cov, path[:, -1]).mean() < high


@pytest.mark.parametrize("d", [2, 3])
def test_bent_start_equals_importance_sampling(d):
    """One scan, one echo in the plane and two in space: mean and spread of the prior's samples by their likelihood."""
    rng, keep = np.random.default_rng(36 + d), np.r_[:d, 3 : 3 + d]
    mean, std = np.array([30e3, 40e3, 8e3, 0.0, 0.0, 0.0])[keep], np.array([15e3, 15e3, 2e3, 20.0, 20.0, 1.0])[keep]
    noise, pool = 700.0, POOR[: d - 1, :d]
    sums = range_sum(mean[:d] + 0.5 * std[:d], np.zeros(d), pool)
    scan = RangeSumScan(sums[None], np.ones((1, d - 1), bool), pool[None], np.zeros((1, d)), np.full((1, d - 1), noise))
    found = RangeSumEkf().initiate(scan, Gaussian(mean, np.diag(std**2)), [0.0])
    samples = mean + std * rng.standard_normal((800_000, 2 * d))
    miss = (range_sum(samples[:, :d], np.zeros(d), pool) - sums) / noise
    weight = np.exp(-0.5 * np.square(miss).sum(-1)) * ((d == 2) | (samples[:, min(2, 2 * d - 1)] > 0.0))
    weight /= weight.sum()
    centre = weight @ samples
    spread = np.einsum("n,ni,nj->ij", weight, samples - centre, samples - centre)
    error = 4.0 / np.sqrt(1.0 / np.square(weight).sum())
    scale = np.sqrt(np.diag(spread))
    assert error < 0.1
    assert (np.abs(found.mean - centre) < (error + 0.05) * scale).all()
    assert (np.abs(found.cov - spread) < (2.0 * error + 0.05) * np.outer(scale, scale)).all()


def random_pools(rng, runs, d, turning=0.0):
    """Starts as in random pools: targets within 70 km, eight transmitters, few echoes in 20 scans, and their truth."""
    times, std = np.arange(20.0), np.array([5e3, 5e3, 3e3, 200.0, 200.0, 10.0]).reshape(2, 3)[:, :d].ravel()
    course, away = rng.uniform(0.0, 2.0 * np.pi, (2, runs)), rng.uniform(5e3, 70e3, runs)
    truth = np.zeros((runs, 2, 3))
    truth[:, 0] = np.stack([away * np.cos(course[0]), away * np.sin(course[0]), rng.uniform(5e3, 12e3, runs)], -1)
    truth[:, 1, :2] = 200.0 * np.stack([np.cos(course[1]), np.sin(course[1])], -1)
    truth = truth[..., :d].reshape(runs, 2 * d)
    path = fly(rng, runs, 19, truth)
    a = turning * rng.standard_normal((runs, 1, d)) * [1.0, 1.0, 0.0][:d]
    path[..., :d] += 0.5 * times[:, None] ** 2 * a
    path[..., d:] += times[:, None] * a
    spot = rng.uniform(0.0, 2.0 * np.pi, (runs, 8))
    pool = rng.uniform(20e3, 100e3, (runs, 8, 1)) * np.stack([np.cos(spot), np.sin(spot), 0.0 * spot], -1)
    pool[..., 2] = rng.uniform(0.0, 300.0, (runs, 8))
    sums = range_sum(path[..., :d], np.zeros(d), pool[:, None, :, :d])
    silent = rng.random((runs, 1, 8)) < 0.5
    heard = (np.arange(8) - d * np.arange(20)[:, None]) % 8 < d
    valid = heard & ~silent & (rng.random(sums.shape) < 0.8)
    sums = np.where(valid, sums + STD_M * rng.standard_normal(sums.shape), 0.0)
    scans = RangeSumScan(sums, valid, pool[:, None, :, :d], np.zeros((1, 1, d)), np.full(sums.shape, STD_M))
    guess = Gaussian(truth + std * rng.standard_normal(truth.shape), np.diag(std**2))
    return scans, guess, times, path[:, -1]


@pytest.mark.parametrize("d", [2, 3])
def test_starts_from_few_echoes_are_honest(d):
    """Long bent posteriors: the share of starts beyond the 99.9 % quantile, which a Gaussian at the mode exceeds."""
    scans, guess, times, truth = random_pools(np.random.default_rng(50 + d), 1500, d)
    found = RangeSumEkf().initiate(scans, guess, times)
    scale = nees(found.mean, found.cov, truth)
    assert np.mean(scale > chi2.isf(1e-3, 2 * d)) < 0.009
    assert 0.8 < np.median(scale) / chi2.median(2 * d) < 1.1


def test_starts_of_turning_targets_are_honest():
    """With the acceleration that they may have, not without."""
    scans, guess, times, truth = random_pools(np.random.default_rng(60), 1500, 2, turning=2.0)
    beyond = {}
    for turning in (0.0, 2.0):
        found = RangeSumEkf(turning_m_s2=turning).initiate(scans, guess, times)
        beyond[turning] = np.mean(nees(found.mean, found.cov, truth) > chi2.isf(1e-3, 4))
    assert beyond[2.0] < 0.009 < 0.1 < beyond[0.0]


def test_start_without_an_echo_is_the_guess():
    silent = RangeSumScan(
        np.zeros((4, 3)), np.zeros((4, 3), bool), POOR[None], np.zeros((1, 3)), np.full((4, 3), STD_M)
    )
    found = RangeSumEkf().initiate(silent, GUESS, [0.0, 1.0, 2.0, 3.0])
    A, cov = axis_transition(1.0, 3), GUESS.cov
    for _ in range(3):
        cov = A @ cov @ A.T + axis_noise(1.0, NOISE)
    np.testing.assert_allclose(found.mean, axis_transition(3.0, 3) @ GUESS.mean)
    np.testing.assert_allclose(found.cov, cov, rtol=1e-9)


def test_start_from_below_ground_ends_above():
    """Low guess, level sites: the mirror fits as well, and is refused."""
    rng = np.random.default_rng(33)
    level = GOOD * [1.0, 1.0, 0.0]
    scans = hear(rng, fly(rng, 20, 9), level, np.zeros(3))
    guess = Gaussian(GUESS.mean * [1, 1, -0.2, 1, 1, 1], np.diag(np.square([2e4, 2e4, 1e4, 200, 200, 10])))
    found = RangeSumEkf().initiate(scans, guess, np.arange(10.0))
    assert (found.mean[:, 2] > 5e3).all()


def test_start_leaves_a_local_minimum():
    """Guess on the ghost's side of two transmitters; a third one, which knows better, is heard as well."""
    rng, times = np.random.default_rng(35), np.arange(10.0)
    path = fly(rng, 20, 9, np.array([5e3, 5e3, 100.0, 200.0]))
    scans = hear(rng, path, POOR[:, :2], np.zeros(2))
    guess = Gaussian(np.array([-30e3, -40e3, 0.0, 0.0]), np.diag(np.square([30e3, 30e3, 200.0, 200.0])))
    found = RangeSumEkf().initiate(scans, guess, times)
    assert (np.linalg.norm(found.mean[:, :2] - path[:, -1, :2], axis=-1) < 2e3).all()
    local, _ = start_by_scipy(RangeSumScan(*(part[0] for part in scans)), guess, times)
    assert np.linalg.norm(local[:2] - path[0, 0, :2]) > 20e3


def test_fixed_damping_step_is_equation_12():
    rng = np.random.default_rng(34)
    scan = RangeSumScan(*(part[0, 0] for part in hear(rng, fly(rng, 1, 0), POOR, POOR_RECEIVER)))
    p = GUESS.mean[:3]
    H = range_sum_jacobian(p, POOR_RECEIVER, POOR)
    e = scan.range_sums - range_sum(p, POOR_RECEIVER, POOR)
    expected = p + np.linalg.solve(H.T @ H + 0.01 * np.eye(3), H.T @ e)
    np.testing.assert_allclose(fixed_damping_step(p, scan, 0.01), expected)
    with pytest.raises(ValueError, match=r"damping = 0\.0"):
        fixed_damping_step(p, scan, 0.0)


# -- bounds -----------------------------------------------------------------------------------------------------------


def straight(steps):
    t = np.arange(steps + 1.0)[:, None]
    return np.hstack([TARGET[:3] + t * TARGET[3:], np.tile(TARGET[3:], (steps + 1, 1))])


@pytest.mark.parametrize(
    ("sites", "receiver", "told"),
    [(POOR, POOR_RECEIVER, {20: 845, 300: 316, 450: 278, 600: 243}), (GOOD, GOOD_RECEIVER, {50: 84, 300: 63, 450: 61})],
)
def test_bound_of_the_papers_layouts(sites, receiver, told):
    """Specification, section 9; the value at 300 s in the good layout is ours."""
    bound = position_std(posterior_bound(straight(600), sites, receiver, GUESS.cov, STD_M, 1.0, NOISE))
    assert bound.horizontal[list(told)] == pytest.approx(list(told.values()), rel=0.01)


def test_two_forms_of_the_bound_agree():
    path, std, share = straight(50), np.array([100.0, 200.0, 400.0]), np.array([1.0, 0.5, 0.8])
    told = posterior_bound(path, POOR, POOR_RECEIVER, GUESS.cov, std, 1.0, NOISE, share)
    cov = advance(GUESS.cov, path[0], POOR, POOR_RECEIVER, std, 0.0, NOISE, share)
    for k in range(51):
        np.testing.assert_allclose(cov, told[k], rtol=1e-6)
        if k < 50:
            cov = advance(cov, path[k + 1], POOR, POOR_RECEIVER, std, 1.0, NOISE, share)
    flat = position_std(np.diag([9.0, 16.0, 1.0, 1.0]))
    assert flat == (5.0, 5.0, 0.0)


# -- bad input --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("field", "value", "words"),
    [
        ("process_noise", (1.0, -1.0, 0.0), "three variances"),
        ("process_noise", (1.0, 1.0), "three variances"),
        ("false_alarm", 1.0, "at least 0 and below 1"),
        ("inflation", 0.5, "at least 1"),
        ("floor_m", np.inf, "finite"),
        ("turning_m_s2", -1.0, "finite and not negative"),
        ("restart_std_m", np.nan, "finite and not negative"),
    ],
)
def test_bad_settings_are_refused(field, value, words):
    with pytest.raises(ValueError, match=rf"RangeSumEkf\.{field} = .*{words}"):
        RangeSumEkf(**{field: value})


SCAN = RangeSumScan(np.full(3, 3e5), np.ones(3, bool), POOR, POOR_RECEIVER, np.full(3, STD_M))


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"range_sums": np.array([1e5, np.nan, 1e5])}, r"scan\.range_sums\[1\] is nan"),
        ({"transmitters": POOR + np.inf}, r"scan\.transmitters\[.*finite"),
        ({"receiver": np.array([0.0, np.nan, 0.0])}, r"scan\.receiver\[1\] is nan"),
        ({"std": np.array([200.0, 0.0, 200.0])}, r"scan\.std\[1\] is 0\.0"),
        ({"transmitters": POOR[:2]}, "scan: range_sums"),
        ({"std": np.full(2, STD_M)}, r"scan\.std \(2,\): must be \[\.\.\., 3\]"),
        ({"valid": np.ones(2, bool)}, r"scan\.valid \(2,\): must be \[\.\.\., 3\]"),
        ({"valid": np.array([np.nan, 0.0, 1.0])}, r"scan\.valid\[0\] is nan: must be True or False"),
        ({"valid": np.ones((2, 3), bool), "std": np.full((3, 3), STD_M)}, "leading axes must broadcast"),
        ({"transmitters": POOR[:, :2]}, "scan: range_sums"),
        ({"receiver": np.zeros(2), "transmitters": POOR[:, :2]}, r"update: mean \(6,\)"),
    ],
)
def test_bad_scans_are_refused(change, words):
    with pytest.raises(ValueError, match=words):
        RangeSumEkf().update(RangeSumTrack(TARGET, GUESS.cov, 1.0), SCAN._replace(**change))


@pytest.mark.parametrize(
    ("guess", "times", "words"),
    [
        (GUESS._replace(mean=np.zeros(4)), [0.0], "guess: mean"),
        (GUESS._replace(mean=np.full(6, np.nan)), [0.0], "guess: mean and cov must be finite"),
        (GUESS._replace(cov=np.zeros((6, 6))), [0.0], r"guess\.cov: variances"),
        (GUESS._replace(cov=GUESS.cov + 1e9 * np.eye(6)[::-1]), [0.0], r"guess\.cov: .*positive definite"),
        (GUESS._replace(cov=np.ones((6, 6))), [0.0], r"guess\.cov: .*positive definite"),
        (GUESS._replace(cov=GUESS.cov + 1e3 * np.eye(6, k=1)), [0.0], r"guess\.cov: .*symmetric"),
        (GUESS, [], "times_s"),
        (GUESS, [-1.0], "times_s"),
        (GUESS, [2.0, 1.0], "times_s"),
        (GUESS, [0.0, 1.0, 2.0], r"scans\.range_sums"),
    ],
)
def test_bad_starts_are_refused(guess, times, words):
    scans = RangeSumScan(*(np.stack([part, part]) for part in SCAN))
    if len(times) == 1:
        scans = RangeSumScan(*(part[:1] for part in scans))
    with pytest.raises(ValueError, match=words):
        RangeSumEkf().initiate(scans, guess, times)


@pytest.mark.parametrize("step_s", [-5.0, np.nan, np.inf])
def test_bad_steps_are_refused(step_s):
    with pytest.raises(ValueError, match=r"predict: step_s = .*: must be finite and not negative"):
        RangeSumEkf().predict(RangeSumTrack(TARGET, GUESS.cov, 1.0), step_s)


@pytest.mark.parametrize(
    ("std", "words"),
    [
        (0.0, "std is 0.0: must be positive and finite"),
        (np.array([200.0, np.nan, 200.0]), r"std\[1\] is nan: must be positive"),
        (np.full(2, 200.0), r"std \(2,\): must be \[\.\.\., 3\]"),
    ],
)
def test_bad_noise_of_bounds_is_refused(std, words):
    H = range_sum_jacobian(TARGET[:3], POOR_RECEIVER, POOR)
    with pytest.raises(ValueError, match=f"dilution: {words}"):
        dilution(H, std)
    with pytest.raises(ValueError, match=f"advance: {words}"):
        advance(GUESS.cov, TARGET, POOR, POOR_RECEIVER, std, 1.0, NOISE)
    with pytest.raises(ValueError, match=f"posterior_bound: {words}"):
        posterior_bound(straight(3), POOR, POOR_RECEIVER, GUESS.cov, std, 1.0, NOISE)


def test_too_many_sums_are_refused():
    n = 65
    scan = RangeSumScan(np.ones(n), np.zeros(n, bool), np.zeros((n, 3)), np.zeros(3), np.ones(n))
    with pytest.raises(ValueError, match="65 range sums"):
        RangeSumEkf().update(RangeSumTrack(TARGET, GUESS.cov, 1.0), scan)


def test_nothing_but_numbers_leaves_hostile_geometry():
    """Target at a site, sums far off, huge and tiny spreads: finite, with positive variances."""
    tracker = RangeSumEkf()
    for p in (POOR[0], POOR_RECEIVER, np.array([1e7, -1e7, 1e5])):
        for scale in (1e-3, 1.0, 1e4):
            for sums in (range_sum(p, POOR_RECEIVER, POOR), np.full(3, 1e6)):
                state = RangeSumTrack(np.r_[p, 0.0, 0.0, 0.0], scale**2 * GUESS.cov, 1.0)
                for _ in range(5):
                    found = tracker.update(tracker.predict(state, 1.0), SCAN._replace(range_sums=sums))
                    state = found.posterior
                    assert all(np.isfinite(part).all() for part in (*state, *found[1:]))
                    assert (np.diag(state.cov) > 0.0).all()
