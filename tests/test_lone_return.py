"""The shortcut for one track and one return gives what the general association gives."""

from __future__ import annotations

import math

import numpy as np
import pytest

from trackers.association import PRUNED
from trackers.contract import Scan
from trackers.lone_return import is_lone, take_or_branch
from trackers.rp_ekf import RpEkf
from trackers.soft_association import branch_and_update

STD = math.radians(0.5)
TRACKER = RpEkf(hypotheses=6, floor_m=15e3, cap_m=120e3, process_noise=5.0, merge_below=1.0, second_order=True)


def scan_of(bearings, valid, stations, slots: int = 1) -> Scan:
    """One station's scans [e] with a return in the first slot; further slots are empty."""
    e = len(bearings)
    z, used = np.zeros((e, 1, slots)), np.zeros((e, 1, slots), dtype=bool)
    z[:, 0, 0], used[:, 0, 0] = bearings, valid
    return Scan(z, used, stations[:, None, :], STD)


def flown_banks(rng: np.random.Generator, episodes: int, scans: int):
    """Predicted banks after some scans from a weaving platform, its position and the next true bearing."""
    target = rng.uniform(-6e4, 6e4, (episodes, 2)) + 3e4
    velocity = rng.uniform(-200.0, 200.0, (episodes, 2))
    station = np.zeros((episodes, 2))
    state = None
    for k in range(scans + 1):
        dx, dy = (target - station).T
        bearing = np.arctan2(dy, dx)
        if k == scans:
            break
        scan = scan_of(bearing + STD * rng.standard_normal(episodes), np.ones(episodes, dtype=bool), station)
        state = TRACKER.initiate(scan) if state is None else TRACKER.update(state, scan).posterior
        state = TRACKER.predict(state, 5.0)
        target = target + 5.0 * velocity
        station = station + 1250.0 * np.array([math.cos(0.4 * k), math.sin(0.4 * k)])
    assert state is not None
    return state, station, bearing


def general(state, bearings, valid, station):
    """What `branch_and_update` makes of the scan."""
    scan = scan_of(bearings, valid, station)
    return branch_and_update(
        state.mean, state.cov, state.own_log_weights, scan, TRACKER.model, TRACKER.prune_below, TRACKER.merge_below,
        TRACKER.second_order,
    )  # fmt: skip


def assert_same(update, expected) -> None:
    *bank, nu, S, assignment, evidence = expected
    for got, wanted in zip(update.posterior, bank, strict=True):
        np.testing.assert_allclose(got, wanted, rtol=1e-9, atol=1e-9 * np.abs(wanted).max())
    np.testing.assert_array_equal(update.assignment, assignment)
    np.testing.assert_allclose(update.innovation, nu, rtol=1e-9, atol=1e-14)
    np.testing.assert_allclose(update.innovation_var, S, rtol=1e-9)
    np.testing.assert_allclose(update.log_likelihood, evidence, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("scans", [1, 5, 25])
def test_plain_returns_give_what_the_general_association_gives(scans):
    rng = np.random.default_rng(scans)
    state, station, bearing = flown_banks(rng, 300, scans)
    bearings, valid = bearing + STD * rng.standard_normal(300), np.ones(300, dtype=bool)
    update = TRACKER.update(state, scan_of(bearings, valid, station))
    assert (update.assignment == 0).mean() > 0.9
    assert_same(update, general(state, bearings, valid, station))


def test_doubtful_strange_and_missing_returns_are_told_apart():
    """Bearings at, near and beyond the gates, and none at all, in one batch; each row is as if alone."""
    rng = np.random.default_rng(7)
    state, station, bearing = flown_banks(rng, 400, 12)
    off = rng.uniform(-8.0, 8.0, 400) * STD
    off[:20] = math.pi / 2
    valid = rng.random(400) < 0.8
    update = TRACKER.update(state, scan_of(bearing + off, valid, station))
    assert_same(update, general(state, bearing + off, valid, station))
    assert (update.assignment[~valid] == -1).all()
    assert (update.assignment[:20] == -1).all()
    assert 0.3 < (update.assignment == 0).mean() < 0.9
    row = type(state)(*(part[33:34] for part in state))
    alone = TRACKER.update(row, scan_of(bearing[33:34] + off[33:34], valid[33:34], station[33:34]))
    for whole, one in zip(update.posterior, alone.posterior, strict=True):
        np.testing.assert_array_equal(whole[33], one[0])


def test_an_empty_second_slot_changes_nothing():
    """Two slots go the general way, one the short one."""
    rng = np.random.default_rng(3)
    state, station, bearing = flown_banks(rng, 200, 8)
    bearings, valid = bearing + STD * rng.standard_normal(200), rng.random(200) < 0.9
    two = scan_of(bearings, valid, station, slots=2)
    assert not is_lone(state.mean, two)
    short, wide = TRACKER.update(state, scan_of(bearings, valid, station)), TRACKER.update(state, two)
    assert_same(short, (*wide.posterior, wide.innovation, wide.innovation_var, wide.assignment, wide.log_likelihood))


def test_removed_hypotheses_stay_removed():
    rng = np.random.default_rng(5)
    state, station, bearing = flown_banks(rng, 50, 3)
    own = state.own_log_weights.copy()
    own[..., 1:] = PRUNED
    own[..., 0] = 0.0
    state = state._replace(own_log_weights=own, log_weights=own)
    posterior = TRACKER.update(state, scan_of(bearing, np.ones(50, dtype=bool), station)).posterior
    assert (posterior.log_weights[..., 0] == 0.0).all()
    assert (posterior.log_weights[..., 1:] <= PRUNED).all()
    assert (posterior.mean[..., 1:, :] == 0.0).all()


def test_leading_axes_broadcast_and_may_be_missing():
    rng = np.random.default_rng(11)
    state, station, bearing = flown_banks(rng, 4, 4)
    one = [part[0] for part in (state.mean, state.cov, state.own_log_weights)]
    bearings = bearing[0] + np.array([0.0, 2.0, 0.004])  # the second is far outside
    settings = (TRACKER.model, TRACKER.prune_below, TRACKER.merge_below, TRACKER.second_order)
    scan = Scan(bearings[:, None, None], np.ones((3, 1, 1), dtype=bool), station[:1], STD)
    together = take_or_branch(*one, scan, *settings)
    for i in range(3):
        single = Scan(bearings[i, None, None], np.ones((1, 1), dtype=bool), station[:1], STD)
        for whole, alone in zip(together, take_or_branch(*one, single, *settings), strict=True):
            np.testing.assert_array_equal(whole[i], np.reshape(alone, whole[i].shape))


def test_a_bank_that_is_no_number_does_not_count_as_plain():
    rng = np.random.default_rng(13)
    state, station, bearing = flown_banks(rng, 10, 4)
    mean = state.mean.copy()
    mean[4, 0, 2, 0] = np.nan
    valid = np.ones(10, dtype=bool)
    broken = TRACKER.update(state._replace(mean=mean), scan_of(bearing, valid, station))
    sound = TRACKER.update(state, scan_of(bearing, valid, station))
    for got, wanted in zip(broken.posterior, sound.posterior, strict=True):
        np.testing.assert_array_equal(np.delete(got, 4, axis=0), np.delete(wanted, 4, axis=0))
