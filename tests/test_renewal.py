"""The belief that knows how long stretches last: against simulation, brute force and closed forms."""

import math
from typing import Any

import numpy as np
import pytest
from scipy.stats import norm

from passive_env import PassiveVectorEnv
from passive_env.blockage import Stretches, blocked
from passive_env.catalogue import make_scenario
from passive_env.radar_promise import Ahead, Durations, Foresight
from passive_env.renewal import MOST_BINS, Renewal

STRETCHES = Stretches(30.0, 60.0, 20.0, 50.0)


def drawn(stretches, count, instants, seed, step_s=1.0):
    """When transmitters are blocked [count, instants]."""
    u = np.random.default_rng(seed).random((count, 1, stretches.uniforms(step_s * instants)))
    return blocked(u, stretches, step_s, instants)[..., 0]


def share_blocked(probability):
    return probability[..., 0, :].sum(-1)


def unheard(count):
    return np.zeros(count, dtype=bool)


# --------------------------------------------------------------------------------------------------------- the chain


def test_what_is_left_at_a_random_instant_is_as_simulated():
    """Remaining times of blocked stretches, chi-squared per bin at 99.99 %."""
    count = 40_000
    hidden = drawn(STRETCHES, count, 62, 1)
    left = np.where(hidden[:, 0], hidden.cumprod(axis=1).sum(axis=1), 0)  # instants for which it stays blocked
    expected = Renewal(STRETCHES, 1.0, 0.8).stationary[0]
    # blocked at 0, 1, …, k and no more: what is left lies in (k, k + 1], bin k
    found = np.bincount(left[left > 0] - 1, minlength=len(expected))[: len(expected)] / count
    spread = norm.isf(0.5e-4 / len(expected)) * np.sqrt(expected * (1.0 - expected) / count)
    assert (np.abs(found - expected) < spread + 1e-12).all()


def test_the_stationary_chain_stays_as_it_is():
    renewal = Renewal(STRETCHES, 1.0, 0.8)
    assert share_blocked(renewal.stationary) == pytest.approx(STRETCHES.share, rel=1e-12)
    later = renewal.follow(renewal.stationary[None], unheard(1), unheard(1))[0]
    np.testing.assert_allclose(later, renewal.stationary, atol=1e-12)


def test_fresh_stretches_last_as_long_as_drawn():
    renewal = Renewal(STRETCHES, 1.0, 0.8)
    instants = 1.0 + np.arange(renewal.fresh.shape[1])  # of a stretch that ends within the bin's last second
    np.testing.assert_allclose(renewal.fresh.sum(axis=1), 1.0, rtol=1e-12)
    np.testing.assert_allclose(renewal.fresh @ instants, [45.0, 35.0], rtol=1e-9)


@pytest.mark.parametrize("step_s", [0.5, 1.0, 7.0, 60.0])
@pytest.mark.parametrize(
    "stretches",
    [STRETCHES, Stretches(5.0, 5.0, 5.0, 5.0), Stretches(1.0, 1e4, 1.0, 1e5), Stretches(0.1, 0.2, 1.0, 2.0)],
)
def test_any_durations_make_probabilities(stretches, step_s):
    renewal = Renewal(stretches, step_s, 0.8)
    for part in (renewal.fresh[0], renewal.fresh[1], renewal.stationary):
        assert (part >= -1e-12).all()
        assert part.sum() == pytest.approx(1.0, abs=1e-9)
    assert renewal.fresh.shape[1] <= MOST_BINS
    rng = np.random.default_rng(3)
    belief = np.broadcast_to(renewal.stationary, (50, *renewal.stationary.shape))
    for _ in range(40):
        heard = rng.random(50)
        belief = renewal.follow(belief, heard < 0.2, heard > 0.6)
        assert (belief >= -1e-12).all()
        np.testing.assert_allclose(belief.sum((-2, -1)), 1.0, atol=1e-9)


def test_long_stretches_are_cut_into_few_bins_that_last_as_long():
    """Bins of 20 scans: mean durations of the chain, by solving for its times of absorption."""
    stretches = Stretches(600.0, 1280.0, 300.0, 900.0)
    renewal = Renewal(stretches, 1.0, 0.8)
    assert renewal.fresh.shape[1] == MOST_BINS
    width = 1280.0 / MOST_BINS
    scans = (1.0 + np.arange(MOST_BINS)) * width
    np.testing.assert_allclose(renewal.fresh @ scans, [940.0, 600.0], rtol=0.02)


# ------------------------------------------------------------------------------------------------------- the filter


def test_the_filter_tells_how_often_histories_end_blocked():
    """Every history of five looks at simulated transmitters against the share that is blocked then (99.99 %)."""
    count, looks, q = 300_000, (0, 4, 9, 33, 41), 0.2
    hidden = drawn(STRETCHES, count, 50, 5)
    heard = np.random.default_rng(6).random((count, len(looks))) >= q
    answers = np.stack([heard[:, i] & ~hidden[:, t] for i, t in enumerate(looks)], axis=1)
    renewal = Renewal(STRETCHES, 1.0, 1.0 - q)
    histories = np.array(list(np.ndindex(*([2] * len(looks)))), dtype=bool)
    # the first look is at the first instant, at which nothing has been predicted yet
    first = np.where(histories[:, :1, None], [[[0.0], [1.0]]], [[[1.0], [q]]])
    belief = first * renewal.stationary
    belief /= belief.sum((1, 2), keepdims=True)
    for t in range(1, 46):
        column = histories[:, looks.index(t)] if t in looks else None
        answered = unheard(len(histories)) if column is None else column
        belief = renewal.follow(belief, answered, unheard(len(histories)) if column is None else ~column)
    code = answers @ (1 << np.arange(len(looks)))
    tested = 0
    for row, history in enumerate(histories):
        rows = code == history @ (1 << np.arange(len(looks)))
        if rows.sum() < 500:
            continue
        found, expected = hidden[rows, 45].mean(), share_blocked(belief[row])
        band = norm.isf(0.5e-4 / len(histories)) * math.sqrt(expected * (1.0 - expected) / rows.sum())
        assert abs(found - expected) < band + 0.006, history  # and what the cut into seconds may cost
        tested += 1
    assert tested > 15


def test_in_the_environment_it_is_calibrated_and_knows_more_than_two_states():
    """Share blocked in ten groups of its probability, and the mean log loss against the Markov chain's (paired)."""
    env = PassiveVectorEnv("PassiveRadar", num_envs=512)
    env.reset(seed=9)
    rng = np.random.default_rng(2)
    probability, two_states, true = [], [], []
    for step in range(120):
        env.step(rng.uniform(-1.0, 1.0, (512, 8)))
        if step > 20 and step % 12 == 0:
            told = env.world.reports.listening
            probability.append(share_blocked(told.stretch))
            two_states.append(told.blocked_probability)
            true.append(env.world.reports.blocked)
    p, two, hidden = (np.array(part).ravel() for part in (probability, two_states, true))
    group = np.digitize(p, np.linspace(0.0, 1.0, 11)[1:-1])
    for g in range(10):
        rows = group == g
        band = norm.isf(0.5e-5) * math.sqrt((p[rows] * (1.0 - p[rows])).sum()) / rows.sum()
        assert abs(hidden[rows].mean() - p[rows].mean()) < band + 0.01

    def loss(b):
        b = np.clip(b, 1e-6, 1.0 - 1e-6)
        return -np.where(hidden, np.log(b), np.log1p(-b))

    gain = loss(two) - loss(p)
    assert gain.mean() > norm.isf(1e-4) * gain.std() / math.sqrt(len(gain) / 8)  # eight transmitters' share an episode


def test_what_was_held_for_impossible_is_believed():
    renewal = Renewal(STRETCHES, 1.0, 1.0)  # no echo is ever missed
    surely = np.array([renewal.fresh * [[1.0], [0.0]], renewal.fresh * [[0.0], [1.0]]])
    surely[:, :, 0] = 0.0  # and no stretch is about to end
    after = renewal.follow(surely, np.array([True, False]), np.array([False, True]))
    np.testing.assert_allclose(share_blocked(after), [0.0, 1.0], atol=1e-12)
    np.testing.assert_allclose(after.sum((1, 2)), 1.0)


def test_without_blockage_everything_stays_clear():
    renewal = Renewal(Stretches(0.0, 0.0, 30.0, 60.0), 1.0, 0.8)
    belief = renewal.stationary[None]
    for _ in range(5):
        belief = renewal.follow(belief, np.array([False]), np.array([True]))
        assert share_blocked(belief)[0] == 0.0
    np.testing.assert_allclose(renewal.stationary @ [1.0], [0.0, 1.0])
    table = renewal.outlook_table(np.array([0, 5]))
    np.testing.assert_allclose(renewal.stationary.ravel() @ table, [0.0, 1.0, 1.0, 0.0, 0.0])


# ------------------------------------------------------------------------------------------------------ the outlook


def test_outlook_equals_following_the_chain_without_looking():
    renewal = Renewal(STRETCHES, 1.0, 0.8)
    rng = np.random.default_rng(4)
    belief = rng.random((6, *renewal.fresh.shape))
    belief /= belief.sum((1, 2), keepdims=True)
    steps = np.array([0, 1, 7, 40])
    found = belief.reshape(6, -1) @ renewal.outlook_table(steps)
    now = renewal.follow(belief, unheard(6), unheard(6))
    np.testing.assert_allclose(found[:, 0], share_blocked(now), rtol=1e-12)
    for kind, columns in ((1, found[:, 1:5]), (0, found[:, 5:])):
        part = now.copy()
        part[:, 1 - kind] = 0.0
        weight = part.sum((1, 2), keepdims=True)
        part /= weight
        for step in range(41):
            if step in steps:
                clear = weight[:, 0, 0] * (1.0 - share_blocked(part))
                np.testing.assert_allclose(columns[:, list(steps).index(step)], clear, rtol=1e-9, atol=1e-15)
            part = renewal.follow(part, unheard(6), unheard(6))


def belief_of(scenario: Any, steps: int = 30, seed: int = 1) -> Any:
    env = PassiveVectorEnv(scenario, num_envs=4)
    env.reset(seed=seed)
    rng = np.random.default_rng(seed)
    for _ in range(steps):
        env.step(rng.uniform(-1.0, 1.0, (4, env.simulation.actions.size)))
    return env.belief()


def test_searches_expect_of_the_next_scans_what_is_foreseen():
    scenario = make_scenario("PassiveRadarRetune", {})
    belief = belief_of(scenario)
    outlook = Durations(scenario)(belief, Ahead(5, 2))
    expected = 0.8 * Foresight(scenario, range(1, 11))(belief)
    blocked_first = outlook.blocked[:, None]
    answers = blocked_first * outlook.if_blocked + (1.0 - blocked_first) * outlook.if_clear
    np.testing.assert_allclose(answers, np.moveaxis(expected.reshape(4, 8, 5, 2).mean(-1), -1, 1), rtol=1e-9)
    single = Durations(scenario)(belief, Ahead(1, 1))
    np.testing.assert_allclose(1.0 - single.blocked, expected[..., 0], rtol=1e-12)
    assert (outlook.if_clear <= 0.8 + 1e-12).all()
    assert (outlook.if_blocked >= 0.0).all()


def test_chances_to_be_clear_are_observed_where_durations_are_known():
    scenario = make_scenario("PassiveRadar", {"durations_known": True, "transmitters": 5})
    belief = belief_of(scenario)
    model = scenario.make_observation()
    seen = model(belief)
    names = [field.name for field in model.fields]
    foreseen = Foresight(scenario, (1, 5, 10, 20))(belief)
    for n in range(5):
        for q, scans in enumerate((1, 5, 10, 20)):
            at = names.index(f"transmitter{n}.clear_in_{scans}")
            np.testing.assert_allclose(seen[:, at], 2.0 * foreseen[:, n, q] - 1.0, atol=1e-6)
    plain = make_scenario("PassiveRadar", {"transmitters": 5}).make_observation()
    kept = [i for i, name in enumerate(names) if "clear_in" not in name]
    np.testing.assert_array_equal(seen[:, kept], plain(belief))
