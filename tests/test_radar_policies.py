"""Policies of a passive radar: what they choose, what their predictions promise, and the shared network."""

import copy
import itertools
import math
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from gymnasium import spaces
from scipy.stats import t as student

from agents.evaluation import fly
from agents.learned import MODEL, LearnedPolicy, ModelPolicy, load_model
from agents.policy import Policy, make_policy, policy_names, sees_world
from agents.radar_planner import Planner
from agents.radar_policies import Greedy, Hysteresis, Repeat, RoundRobin, pursuit
from agents.training import plan, train
from agents.transmitter_network import TransmitterPolicy, network_settings
from passive_env import PassiveVectorEnv
from passive_env.catalogue import make_scenario
from passive_env.catalogue.two_station import TwoStation
from passive_env.core import map_rows
from passive_env.observations import LIMIT
from passive_env.radar_promise import Ahead, Blockage, Outlook, SumPrediction, everyone, straight_on
from trackers.axis_motion import axis_noise, axis_transition
from trackers.range_sum import range_sum_jacobian

NAMES = ("PassiveRadar", "PassiveRadarRetune", "MobileReceiver")


def small(name="PassiveRadar", **fields):
    """A scenario of short episodes."""
    return make_scenario(name, {"steps": 12, **fields})


def flown_belief(scenario, episodes=3, steps=8, seed=1) -> tuple[Any, Any, Any]:
    """A belief some random decisions after an episode's start, and its observation."""
    env = PassiveVectorEnv(scenario, num_envs=episodes, autoreset_mode="disabled")
    observation, _ = env.reset(seed=seed)
    rng = np.random.default_rng(seed)
    for _ in range(steps):
        command = rng.uniform(-1.0, 1.0, (episodes, env.simulation.actions.size))
        observation, *_ = env.step(env.simulation.actions.encode(command, env.belief()))
    return env, env.belief(), observation


def known(**fields) -> Any:
    """A belief of which only some fields are told."""
    return SimpleNamespace(**fields)


def chosen(policy, belief, scenario):
    """Sorted transmitters [e, k] that a policy's commands choose."""
    scores = policy.act(belief, None)[:, -scenario.pool :]
    return np.sort(np.argsort(-scores, axis=1, kind="stable")[:, : scenario.listened], axis=1)


# ------------------------------------------------------------------------------------------------------- all of them


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("dimensions", [2, 3])
def test_every_policy_gives_commands_that_choose_and_depend_on_no_other_episode(name, dimensions):
    scenario = small(name, dimensions=dimensions)
    env, belief, observation = flown_belief(scenario)
    for policy_name in policy_names(scenario):
        whole: Any = make_policy(policy_name, scenario)
        alone: Any = make_policy(policy_name, scenario)
        assert isinstance(whole, Policy)
        pair: Any = ((whole, slice(None)), (alone, slice(1, 2)))
        for policy, rows in pair:
            world = map_rows(lambda part, rows=rows: part[rows], env.world)
            if sees_world(policy):
                policy.see(world)
            policy.reset(env.simulation.belief(world))
        commands = whole.act(belief, observation)
        assert commands.shape == (3, env.simulation.actions.size)
        assert (np.abs(commands) <= 1.0).all()
        row = map_rows(lambda part: part[1:2], env.world)
        np.testing.assert_array_equal(alone.act(env.simulation.belief(row), observation[1:2])[0], commands[1])
        if policy_name != "random":
            scores = commands[:, -scenario.pool :]
            assert ((scores == 1.0).sum(1) == scenario.listened).all()
            assert ((scores == -1.0).sum(1) == scenario.pool - scenario.listened).all()


def test_names_offered_follow_the_scenario():
    plain, retune, mobile = (set(policy_names(make_scenario(name, {}))) for name in NAMES)
    assert {"fixed", "best_fixed", "rule", "greedy", "skip", "bayes", "timed", "oracle", "random"} <= plain
    assert retune - plain == {"hysteresis", "hold10", "timed10"}
    assert {"straight", "pursuit", "timed_pursuit", "hold"} <= mobile - plain
    assert "paper" in policy_names(make_scenario("PassiveRadar", {"sites": "paper_good", "dimensions": 3}))


# -------------------------------------------------------------------------------------------------------------- rules


def test_hindsight_is_the_best_that_always_listens_to_the_same():
    scenario = small(transmitters=4, steps=30)
    best = fly(scenario, make_policy("hindsight", scenario), 6, 40)
    every = []
    for number in range(6):
        policy: Any = make_policy("fixed", scenario)
        policy.choose = lambda belief, number=number: np.full(len(belief.steps_left), number)
        every.append(fly(scenario, policy, 6, 40).mean.ravel())
    np.testing.assert_allclose(best.mean.ravel(), np.min(every, axis=0), rtol=1e-12)
    assert len(set(np.argmin(every, axis=0))) > 1


def test_round_robin_gives_every_combination_as_many_scans():
    scenario = small(steps=56)
    policy = RoundRobin(scenario)
    counts = np.zeros(28, dtype=int)
    for left in range(56, 0, -1):
        counts[policy.choose(known(steps_left=np.array([left])))] += 1
    assert (counts == 2).all()


def test_round_robin_stays_longer_than_retuning_takes():
    policy = RoundRobin(make_scenario("PassiveRadarRetune", {}))
    choices = [int(policy.choose(known(steps_left=np.array([left])))[0]) for left in range(300, 0, -1)]
    stays = [len(list(group)) for _, group in itertools.groupby(choices)]
    assert set(stays[:-1]) == {11}


def test_repeat_keeps_who_answered_or_is_being_tuned_and_replaces_who_missed():
    scenario = small(transmitters=4)
    belief = known(
        chosen=np.array([[True, True, False, False], [True, True, False, False]]),
        missed=np.array([[False, True, False, False], [False, False, False, False]]),
        since_miss_s=np.array([[50.0, 0.0, 3.0, 9.0], [1.0, 2.0, 90.0, 90.0]]),
    )
    np.testing.assert_array_equal(chosen(Repeat(scenario), belief, scenario), [[0, 3], [0, 1]])


def test_rules_of_shape_choose_by_hand_made_layouts():
    """Of transmitters 0 and 1, which stand close together, the second is nearer to the target, and 3 is nearest."""
    sites = [(0.0, 0.0), (-30e3, -1e3), (-31e3, 1e3), (80e3, 60e3), (-28e3, 30e3)]
    scenario = small(sites=sites)
    _, belief, _ = flown_belief(scenario, 1)
    belief.mean[0, 0, :2] = (0.0, 60e3)
    p = np.array([0.0, 60e3])
    rows = range_sum_jacobian(p, np.array(sites[0]), np.array(sites[1:]))
    rows /= np.linalg.norm(rows, axis=1, keepdims=True)
    best = max(itertools.combinations(range(4), 2), key=lambda pair: abs(np.linalg.det(rows[list(pair)])))
    assert tuple(chosen(make_policy("angle", scenario), belief, scenario)[0]) == best
    np.testing.assert_array_equal(chosen(make_policy("nearest", scenario), belief, scenario), [[1, 3]])

    def area(pair):
        a, b = np.array(sites[1:])[list(pair)]
        return abs(a[0] * b[1] - a[1] * b[0])

    largest = max(itertools.combinations(range(4), 2), key=area)
    assert tuple(chosen(make_policy("triangle", scenario), belief, scenario)[0]) == largest


def test_largest_triangle_in_space_is_that_of_three_sites():
    scenario = small(dimensions=3)
    _, belief, _ = flown_belief(scenario, 2)
    for sites, found in zip(
        belief.transmitters[..., :2], chosen(make_policy("triangle", scenario), belief, scenario), strict=True
    ):

        def area(triple, sites=sites):
            a, b, c = sites[list(triple)]
            return abs((b - a)[0] * (c - a)[1] - (b - a)[1] * (c - a)[0])

        assert tuple(found) == max(itertools.combinations(range(8), 3), key=area)


# --------------------------------------------------------------------------------------------------------- prediction


def dense_promise(belief, scenario, outlook, pair, scans, row):
    """The same number by information matrices and a sum over all cases: mean log √tr C over scans and cases."""
    d, T = scenario.dimensions, scenario.step_s
    A, Q = axis_transition(T, d), axis_noise(T, np.array(scenario.process_noise[:d]))
    total = 0.0
    for case in itertools.product([False, True], repeat=len(pair)):
        weight = math.prod(
            outlook.blocked[row, i] if hidden else 1.0 - outlook.blocked[row, i]
            for i, hidden in zip(pair, case, strict=True)
        )
        P = belief.cov[row, 0]
        for j in range(scans):
            P = A @ P @ A.T + Q
            place = belief.mean[row, 0, :d] + (j + 1) * T * belief.mean[row, 0, d:]
            H = range_sum_jacobian(place, belief.platforms[row, 0, :d], belief.transmitters[row])
            J = np.linalg.inv(P)
            for i, hidden in zip(pair, case, strict=True):
                if belief.wait_s[row, i] <= (j + 1) * T:
                    share = np.broadcast_to(outlook.if_blocked if hidden else outlook.if_clear, (scans, scenario.pool))
                    J[:d, :d] += share[j, i] * np.outer(H[i], H[i]) / scenario.range_sum_std_m**2
            P = np.linalg.inv(J)
            total += weight * 0.5 * math.log(np.trace(P[:d, :d])) / scans
    return total


@pytest.mark.parametrize("dimensions", [2, 3])
@pytest.mark.parametrize("scans", [1, 7])
def test_promises_equal_those_by_information_matrices(dimensions, scans):
    scenario = small("PassiveRadarRetune", dimensions=dimensions)
    _, belief, _ = flown_belief(scenario)
    prediction = SumPrediction(scenario, scans)
    outlook = Blockage(scenario)(belief, Ahead(scans, 1))
    promised = prediction(belief, outlook)
    for row, c in itertools.product(range(3), (0, 9, len(scenario.combinations) - 1)):
        dense = dense_promise(belief, scenario, outlook, scenario.combinations[c], scans, row)
        np.testing.assert_allclose(promised[row, c], dense, rtol=0.0, atol=1e-6)


def test_outlook_of_blockage_equals_powers_of_the_chain():
    scenario = make_scenario("PassiveRadar", {})
    to_blocked, to_clear = scenario.stretches.leaving(1.0)
    chain = np.array([[1.0 - to_blocked, to_blocked], [to_clear, 1.0 - to_clear]])
    belief = known(blocked_probability=np.array([[0.0, 1.0, 0.3]]))
    outlook = Blockage(scenario)(belief, Ahead(5, 2))
    b = belief.blocked_probability[0]
    np.testing.assert_allclose(outlook.blocked[0], (1 - b) * chain[0, 1] + b * chain[1, 1])
    for j in range(5):
        later = np.linalg.matrix_power(chain, 2 * j)
        np.testing.assert_allclose(outlook.if_clear[j], 0.8 * later[0, 0])
        np.testing.assert_allclose(outlook.if_blocked[j], 0.8 * later[1, 0], atol=1e-15)


def test_taking_scans_together_and_leaving_out_cases_changes_promises_little():
    scenario = make_scenario("PassiveRadarRetune", {"steps": 12})
    _, belief, _ = flown_belief(scenario, 16)
    outlook = Blockage(scenario)
    exact, quick = SumPrediction(scenario, 10), SumPrediction(scenario, 10, together=2, cases=False)
    a, b = exact(belief, outlook(belief, exact.ahead)), quick(belief, outlook(belief, quick.ahead))
    chosen_by_quick = a[np.arange(16), b.argmin(axis=1)]
    assert np.corrcoef((a - a.min(1, keepdims=True)).ravel(), (b - b.min(1, keepdims=True)).ravel())[0, 1] > 0.9
    assert (chosen_by_quick - a.min(axis=1)).mean() < 0.25 * (a.mean(axis=1) - a.min(axis=1)).mean()


def test_promises_stay_finite_for_a_diverged_track():
    scenario = small()
    _, belief, _ = flown_belief(scenario)
    belief.mean[0], belief.cov[0] = np.nan, np.nan
    promised = SumPrediction(scenario)(belief, everyone(belief, Ahead(1, 1)))
    assert np.isfinite(promised).all()


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"scans": 0}, "scans = 0: must be an integer of at least 1"),
        ({"scans": 2.0}, "scans = 2.0: must be an integer"),
        ({"scans": True}, "scans = True: must be an integer"),
        ({"scans": 10, "together": 0}, "together = 0: must be an integer"),
        ({"scans": 10, "together": 3}, "must be a multiple of together = 3"),
        ({"criterion": "trace"}, "criterion 'trace': must be one of position_std"),
    ],
)
def test_wrong_settings_of_predictions_are_refused(settings, words):
    with pytest.raises(ValueError, match=words):
        SumPrediction(small(), **settings)


# ----------------------------------------------------------------------------------------------------------- searches


def test_searches_leave_out_whom_they_take_for_blocked():
    scenario = small()
    _, belief, _ = flown_belief(scenario, 4)
    belief = belief._replace(
        since_miss_s=np.full_like(belief.since_miss_s, 1e4), blocked_probability=np.zeros_like(belief.std)
    )
    for name, field, value in (("skip", "since_miss_s", 1.0), ("bayes", "blocked_probability", 1.0)):
        policy = make_policy(name, scenario)
        clear = chosen(policy, belief, scenario)
        changed = getattr(belief, field).copy()
        changed[np.arange(4), clear[:, 0]] = value
        others = chosen(policy, belief._replace(**{field: changed}), scenario)
        assert not (others == clear[:, :1]).any()
        naive = make_policy("greedy", scenario)
        np.testing.assert_array_equal(
            chosen(naive, belief._replace(**{field: changed}), scenario), chosen(naive, belief, scenario)
        )


def test_hysteresis_changes_only_for_enough():
    scenario = make_scenario("PassiveRadarRetune", {"steps": 12})
    _, belief, _ = flown_belief(scenario, 6)
    kept = np.argsort(~belief.chosen, axis=1, kind="stable")[:, :2]
    np.testing.assert_array_equal(chosen(Hysteresis(scenario, 0.99), belief, scenario), np.sort(kept, axis=1))
    eager = chosen(Hysteresis(scenario, 0.0), belief, scenario)
    np.testing.assert_array_equal(eager, chosen(Greedy(scenario, waits=False), belief, scenario))
    assert (eager != np.sort(kept, axis=1)).any()


def test_oracle_never_listens_to_whom_it_knows_blocked_while_others_are_clear():
    scenario = small(steps=40)
    policy: Any = make_policy("oracle", scenario)
    env = PassiveVectorEnv(scenario, num_envs=8, autoreset_mode="disabled")
    observation, _ = env.reset(seed=5)
    policy.reset(env.belief())
    wasted = 0
    for _ in range(40):
        policy.see(env.world)
        commands = policy.act(env.belief(), observation)
        observation, *_, info = env.step(env.simulation.actions.encode(commands, env.belief()))
        enough = (~info["blocked"]).sum(1) >= 2
        wasted += (info["chosen"] & info["blocked"])[enough].sum()
    assert wasted == 0


@pytest.mark.parametrize(("better", "worse"), [("bayes", "skip"), ("skip", "greedy"), ("oracle", "bayes")])
def test_knowing_more_of_blockage_makes_the_median_error_smaller(better, worse):
    """The order of the prototype's table: blockage known < believed < last misses < ignored (paired, 99.9 %)."""
    scenario = make_scenario("PassiveRadar", {"steps": 150})
    logs = [np.log(fly(scenario, make_policy(name, scenario), 96, 700_000).mean) for name in (better, worse)]
    gain = logs[1] - logs[0]
    low = gain.mean() - student.ppf(0.999, 95) * gain.std(ddof=1) / math.sqrt(96)
    assert low > 0.0


# ------------------------------------------------------------------------------------------------------------ planner


@pytest.mark.parametrize("name", ["PassiveRadar", "PassiveRadarRetune"])
def test_where_nothing_is_lost_the_planner_imagines_what_is_promised(name):
    """Without blockage and misses every course of events is the one that the promise follows."""
    scenario = small(name, blocked_min_s=0.0, blocked_max_s=0.0, echo_probability=1.0)
    _, belief, _ = flown_belief(scenario)
    promise = SumPrediction(scenario, 6)
    promised = promise(belief, everyone(belief, promise.ahead))
    np.testing.assert_allclose(Planner(scenario, 6, samples=3).costs(belief), promised, rtol=1e-9)


def test_the_planner_leaves_out_whom_it_takes_for_blocked():
    scenario = small()
    _, belief, _ = flown_belief(scenario, 4)
    blocked = np.zeros_like(belief.std)
    blocked[:, :4] = 1.0
    found = chosen(Planner(scenario), belief._replace(blocked_probability=blocked), scenario)
    assert (found >= 4).all()


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"scans": 0}, "scans = 0: must be an integer"),
        ({"samples": 1.5}, "samples = 1.5: must be an integer"),
        ({"threshold": 1.0}, r"threshold = 1.0: must lie in \(0, 1\)"),
    ],
)
def test_wrong_settings_of_the_planner_are_refused(settings, words):
    with pytest.raises(ValueError, match=words):
        Planner(small(), **settings)


# ------------------------------------------------------------------------------------------------------------- moving


@pytest.mark.parametrize("velocity", [(150.0, 0.0), (-60.0, 90.0), (-200.0, 10.0), (-240.0, 30.0)])
def test_lead_pursuit_meets_a_target_that_flies_straight_on(velocity):
    receiver = np.array([[[1e3, -2e3, 0.0, 200.0]]])
    target = np.array([[[30e3, 10e3, *velocity]]])
    heading = pursuit(known(platforms=receiver, mean=target))[0]
    times = np.arange(0.0, 2000.0, 0.05)
    course = 200.0 * np.array([math.cos(heading), math.sin(heading)])
    apart = (target - receiver)[0, 0, :2] + times[:, None] * (np.array(velocity) - course)
    assert np.linalg.norm(apart, axis=1).min() < 20.0


def test_lead_pursuit_of_what_cannot_be_met_leads():
    receiver = np.array([[[0.0, 0.0, 0.0, 200.0]]])
    target = np.array([[[0.0, 20e3, 300.0, 0.0]]])
    assert pursuit(known(platforms=receiver, mean=target))[0] == pytest.approx(math.atan2(20e3, 30e3))


def test_a_receiver_that_holds_stays_near():
    scenario = make_scenario("MobileReceiver", {"steps": 72})
    policy = make_policy("hold", scenario)
    env = PassiveVectorEnv(scenario, num_envs=2, autoreset_mode="disabled")
    observation, _ = env.reset(seed=1)
    first = env.world.platforms[..., :2]
    for _ in range(72):
        commands = policy.act(env.belief(), observation)
        observation, *_ = env.step(env.simulation.actions.encode(commands, env.belief()))
        assert (np.linalg.norm(env.world.platforms[..., :2] - first, axis=-1) < 5e3).all()
    np.testing.assert_allclose(env.world.platforms[..., :2], first, atol=1.0)  # 72 · 5° is a circle


# ------------------------------------------------------------------------------------------------------------ network


def make_network(scenario, seed=0, truth=None):
    """An untrained network for a scenario."""
    torch.manual_seed(seed)
    simulation = scenario.make_simulation()
    size = len(simulation.observation.fields) + (0 if truth is None else len(truth.fields))
    return TransmitterPolicy(
        spaces.Box(-LIMIT, LIMIT, (size,), np.float32), simulation.actions.space, lambda share: 1e-3,
        net_arch=[16, 16], layout=network_settings(scenario, truth), sharpness=400.0,
    )  # fmt: skip


def shaken(network):
    """The network with weights that are not those of an untrained one."""
    torch.manual_seed(9)
    for parameter in network.parameters():
        torch.nn.init.normal_(parameter, std=0.3)
    return network


@pytest.mark.parametrize(
    ("name", "teacher", "scans", "known"),
    [
        ("PassiveRadar", "bayes", 1, False), ("PassiveRadarRetune", "hold10", 10, False),
        ("PassiveRadar", "timed", 1, True), ("PassiveRadarRetune", "timed10", 10, True),
    ],
)  # fmt: skip
@pytest.mark.parametrize("actions", ["discrete", "continuous"])
def test_an_untrained_network_acts_as_the_search_does(name, teacher, scans, known, actions):
    scenario = small(name, actions=actions, promised_scans=scans, durations_known=known)
    _, belief, observation = flown_belief(scenario, 16)
    network = make_network(scenario)
    actions, _ = network.predict(observation, deterministic=True)
    if scenario.actions == "discrete":
        found = scenario.combinations[actions[:, 0]]
    else:
        with torch.no_grad():
            scores = network.get_distribution(torch.from_numpy(observation)).mode().numpy()
        found = np.sort(np.argsort(-scores, axis=1)[:, :2], axis=1)
    np.testing.assert_array_equal(found, chosen(make_policy(teacher, scenario), belief, scenario))


def test_an_untrained_network_of_a_receiver_that_moves_flies_lead_pursuit():
    scenario = small("MobileReceiver", actions="discrete", promised_scans=1, durations_known=True, steps=40)
    env, belief, observation = flown_belief(scenario, 16, 30)
    actions, _ = make_network(scenario).predict(observation, deterministic=True)
    commands = env.simulation.actions.commands(env.simulation.actions.decode(actions, 16), belief)
    np.testing.assert_array_equal(commands, make_policy("timed_pursuit", scenario).act(belief, observation))


@pytest.mark.parametrize(("name", "actions"), [("PassiveRadar", "discrete"), ("MobileReceiver", "continuous")])
def test_only_the_critic_sees_the_truth_and_what_flies_acts_alike(name, actions):
    scenario = small(name, actions=actions, promised_scans=1)
    truth = scenario.make_truth_observation()
    env, _, observation = flown_belief(scenario, 8)
    network = shaken(make_network(scenario, truth=truth))
    rng = np.random.default_rng(0)
    told = truth(env.world)
    otherwise = rng.uniform(-1.0, 1.0, told.shape).astype(np.float32)
    both = [torch.from_numpy(np.hstack([observation, part])) for part in (told, otherwise)]
    with torch.no_grad():
        scores = [network.mlp_extractor.forward_actor(part).numpy() for part in both]
        values = [network.predict_values(part).numpy() for part in both]
    np.testing.assert_array_equal(*scores)
    assert (np.abs(values[0] - values[1]) > 1e-6).all()
    _, settings, actor = network.flown()
    plain = make_network(scenario)
    plain.load_state_dict(actor, strict=False)
    assert (settings["layout"]["truth"], settings["layout"]["truth_shared"]) == (0, 0)
    with torch.no_grad():
        found = plain.mlp_extractor.forward_actor(torch.from_numpy(observation)).numpy()
    np.testing.assert_array_equal(found, scores[0])
    flown = [part.predict(o, deterministic=True)[0] for part, o in ((network, both[0].numpy()), (plain, observation))]
    np.testing.assert_array_equal(*flown)


def test_the_critic_is_told_of_each_transmitter_what_is_its_own():
    """Exchanging two transmitters in the observation and in the truth leaves its value as it is."""
    scenario = small(transmitters=4)
    truth = scenario.make_truth_observation()
    _, _, observation = flown_belief(scenario, 8, 5)
    network = shaken(make_network(scenario, truth=truth))
    order, shared, own = np.array([2, 1, 0, 3]), network.layout["shared"], network.layout["per_transmitter"]
    blocks = observation[:, shared:].reshape(8, 4, own)
    told = np.random.default_rng(1).random((8, len(truth.fields))).astype(np.float32)
    kinds = told[:, truth.shared :].reshape(8, -1, 4)
    same = np.hstack([observation, told])
    moved = np.hstack([observation[:, :shared], blocks[:, order].reshape(8, -1), told[:, : truth.shared],
                       kinds[:, :, order].reshape(8, -1)])  # fmt: skip
    mixed = np.hstack([moved[:, : -kinds[0].size], told[:, truth.shared :]])
    with torch.no_grad():
        values = [network.predict_values(torch.from_numpy(part)).numpy() for part in (same, moved, mixed)]
    np.testing.assert_allclose(values[1], values[0], rtol=1e-4, atol=1e-5)
    assert (np.abs(values[2] - values[0]) > 1e-5).any()


@pytest.mark.parametrize("actions", ["discrete", "continuous"])
def test_scores_do_not_depend_on_how_transmitters_are_numbered(actions):
    scenario = small(actions=actions, promised_scans=1, transmitters=5)
    _, _, observation = flown_belief(scenario, 4)
    network = make_network(scenario)
    for parameter in network.mlp_extractor.score.parameters():
        torch.nn.init.normal_(parameter)
    order = np.array([3, 0, 4, 1, 2])
    pairs = [tuple(pair) for pair in scenario.combinations]
    moved = [pairs.index(tuple(sorted((order[a], order[b])))) for a, b in pairs]
    layout = network.layout
    first = layout["shared"]
    blocks = observation[:, first : first + 5 * layout["per_transmitter"]].reshape(4, 5, -1)
    tail = observation[:, first + 5 * layout["per_transmitter"] :]
    other = np.hstack([observation[:, :first], blocks[:, order].reshape(4, -1), tail[:, moved]])
    with torch.no_grad():
        a, b = (network.mlp_extractor.forward_actor(torch.from_numpy(o)).numpy() for o in (observation, other))
        values = [network.predict_values(torch.from_numpy(o)).numpy() for o in (observation, other)]
    np.testing.assert_allclose(b, a[:, moved if actions == "discrete" else order], rtol=1e-4, atol=1e-4)
    assert np.ptp(a + (400.0 * tail if actions == "discrete" else 0.0), axis=1).min() > 1e-3
    np.testing.assert_allclose(*values, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize(("name", "fields"), [("PassiveRadar", {}), ("MobileReceiver", {"transmitters": 4})])
def test_a_trained_network_is_saved_and_flies_again(tmp_path, name, fields):
    run = plan(name, tmp_path / "run", timesteps=96, envs=8, fields={"steps": 12, **fields})
    preset = copy.deepcopy(run.preset) | {"net_arch": [8, 8]}
    run = replace(run, preset=preset)
    train(run, progress=False)
    scenario = run.training_scenario
    env, belief, observation = flown_belief(scenario, 4)
    commands = LearnedPolicy(run.folder, f"passive/{name}-v0", env.simulation).act(belief, observation)
    assert commands.shape == (4, env.simulation.actions.size)
    assert ((commands[:, -scenario.pool :] == 1.0).sum(1) == 2).all()


def test_a_trained_network_flies_where_nothing_is_promised_and_scores_are_commanded(tmp_path):
    """It sees and acts as it was trained: commands are the same as where its own observations are shown."""
    run = plan("PassiveRadar", tmp_path / "run", timesteps=96, envs=8, fields={"steps": 12})
    train(run, progress=False)
    commands = []
    for scenario in (run.training_scenario, run.scenario):
        env = PassiveVectorEnv(scenario, num_envs=4)
        observation, _ = env.reset(seed=3)
        policy = LearnedPolicy(run.folder, "passive/PassiveRadar-v0", env.simulation)
        commands.append(policy.act(env.belief(), observation))
    assert run.scenario.promised_scans == 0 < run.training_scenario.promised_scans
    np.testing.assert_array_equal(*commands)
    other = run.training_scenario.replace(promised_scans=7)  # as many numbers, of another meaning
    with pytest.raises(ValueError, match="trained with promised_scans=1, not 7"):
        LearnedPolicy(run.folder, "passive/PassiveRadar-v0", other.make_simulation())
    by_sight = [
        ModelPolicy(load_model(run.folder / MODEL, run.algo), run.training_scenario.make_simulation(), shown)
        for shown in (run.training_scenario, other)
    ]
    belief, observation = env.belief(), other.make_observation()(env.belief())
    np.testing.assert_array_equal(by_sight[1].act(belief, observation), commands[0])
    assert (by_sight[0].act(belief, observation) != commands[0]).any()


def test_promises_are_observed_as_the_search_makes_them():
    scenario = small(promised_scans=1)
    env, belief, observation = flown_belief(scenario)
    costs = Greedy(scenario).costs(belief)
    promised = observation[:, -28:]
    np.testing.assert_allclose(promised, costs - costs.min(axis=1, keepdims=True), atol=1e-6)
    assert env.simulation.observation.fields[-28].name == "combination0.log_promise"


def test_wrong_networks_are_refused(tmp_path):
    run = plan("PassiveRadar", tmp_path)
    for change, words in (
        ({"network": "per_target"}, "knows no network 'per_target'"),
        ({"network": "per_transmitter", "first_action": [0.0]}, "cannot take network"),
    ):
        with pytest.raises(ValueError, match=words):
            replace(run, preset=run.preset | change)
    with pytest.raises(ValueError, match="TwoStation observes no transmitters one by one"):
        network_settings(TwoStation())


def test_straight_on_adds_velocity_times_time():
    state = np.array([[1.0, 2.0, 3.0, 10.0, 20.0, 30.0]])
    np.testing.assert_array_equal(straight_on(state, np.array([0.5, 2.0]))[0], [[6.0, 12.0, 18.0], [21.0, 42.0, 63.0]])


def test_of_larger_combinations_than_cases_are_weighed_the_one_in_between_is():
    scenario = small(channels=5)
    _, belief, _ = flown_belief(scenario)
    half = Outlook(np.full((3, 8), 0.5), np.ones((1, 1)), np.zeros((1, 1)))
    mean = Outlook(np.zeros((3, 8)), np.full((1, 1), 0.5), np.zeros((1, 1)))
    prediction = SumPrediction(scenario)
    np.testing.assert_allclose(prediction(belief, half), prediction(belief, mean), rtol=1e-12)
