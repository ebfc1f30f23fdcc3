"""Learning down the gradient of the bound: places, bounds and slopes of the compiled code, and that it learns."""

import dataclasses
from typing import Any

import numpy as np
import pytest
import torch
from training_runs import finish, interrupt, logged

from agents import training
from agents.bound_gradient import EDGE_M, BoundGradient, Flight, bound_of, gradient, loss
from agents.evaluation import fly
from agents.learned import load_model, open_policy
from agents.pack import pack
from agents.presets import load_preset
from agents.sb3 import Sb3VecEnv
from agents.torch_bound import converted_information, promised_std
from agents.torch_carriers import carried
from agents.training import CHECKPOINT, Run, new_model, plan, train, training_env
from passive_env import PassiveVectorEnv
from passive_env.catalogue import make_scenario
from passive_env.mobile_observation import course_of
from passive_env.placement import entry_prior, seen_from_entry
from trackers.converted_measurement import Layout, moments

KINDS = pytest.mark.parametrize(
    "fields",
    [
        {}, {"angle_only": 1}, {"angle_only": 3}, {"carrier": "ground"}, {"sensors": 2, "steps": 30},
        {"course": "flights"}, {"nearest_min_m": 5e3, "nearest_max_m": 6e3, "steps": 40},
    ],
    ids=str,
)  # fmt: skip
NEAR = {
    "sensors": 2, "nearest_min_m": 1e4, "nearest_max_m": 1e4, "minimum_range_m": 9.9e3, "altitude_max_m": 4e3,
    "steps": 20,
}  # fmt: skip
"""Sensors installed at the nearest distance miss many of the first scans."""


def scenario_with(fields):
    return make_scenario("MobilePlacement", {"actions": "velocities", **fields})


def flown(fields, episodes=8, seed=3, near=False):
    """Actions [e, k, 3 n] that drift at random, what was flown, and where the environment had carriers and bounds.

    near: install sensors at the nearest distance.
    """
    scenario, rng = scenario_with(fields), np.random.default_rng(seed)
    env: Any = PassiveVectorEnv(scenario, num_envs=episodes, autoreset_mode="disabled")
    env.reset(seed=seed)
    tape, drift = env.world.tape, np.zeros((episodes, 3 * scenario.sensors))
    actions, courses, places, bounds = [], [], [], []
    for _ in range(scenario.steps):
        courses.append(course_of(env.belief()))
        drift = 0.9 * drift + 0.4 * rng.standard_normal(drift.shape)
        actions.append(np.clip(drift, -1.0, 1.0).astype(np.float32))
        if near and len(actions) == 1:
            actions[0][:, ::3] = -1.0
        info = env.step(actions[-1])[-1]
        places.append(env.world.platforms[..., :3])
        bounds.append(info["position_crlb_m"][:, 0])
    actions, courses, places, bounds = (np.stack(part, axis=1) for part in (actions, courses, places, bounds))
    return actions, Flight(scenario, tape.task, tape.targets[:, 1:, 0, :3], courses), places, bounds


def places_of(actions, flight):
    s, a = flight.scenario, torch.tensor(actions, dtype=torch.float64).unflatten(-1, (flight.scenario.sensors, 3))
    reach, climb = s.speed_m_s * s.step_s, s.climb_m_s * s.step_s
    return carried(a, torch.as_tensor(flight.courses), flight.task, reach, climb).numpy()


# ------------------------------------------------------------------------------------------------ the same numbers


@KINDS
def test_carriers_go_where_the_environment_has_them(fields):
    actions, flight, places, _ = flown(fields)
    np.testing.assert_allclose(places_of(actions, flight), places, rtol=0, atol=1e-6)
    azimuth, distance, _ = seen_from_entry(places[:, 1:], flight.task.entry_distance_m[:, None, None])
    limit = flight.task.azimuth_limit_rad[:, None, None]
    nearest = flight.task.distance_m[:, 0, None, None]
    assert (np.isclose(abs(azimuth), limit) | (distance < nearest)).any()  # limits are met, and crossed


@KINDS
def test_the_bound_is_the_environments(fields):
    actions, flight, _, bounds = flown(fields)
    np.testing.assert_allclose(bound_of(torch.tensor(actions).double(), flight).numpy(), bounds, rtol=1e-8)


@pytest.mark.parametrize("angle_only", [0, 1, 2])
def test_a_track_waits_for_scans_that_can_start_it(angle_only):
    actions, flight, places, bounds = flown({**NEAR, "angle_only": angle_only}, episodes=200, near=True)
    s = flight.scenario
    measured = np.linalg.norm(flight.path[:, :, None] - places, axis=-1) >= s.minimum_range_m
    usable = (measured & s.ranging if s.ranging.any() else measured).any(axis=-1)
    assert (~usable[:, 0]).sum() > 10
    assert (usable[:, 0] & ~usable[:, 1]).any() or not s.ranging.any()
    np.testing.assert_allclose(bound_of(torch.tensor(actions).double(), flight).numpy(), bounds, rtol=1e-6)
    assert np.isfinite(gradient(actions, flight)[0]).all()


def test_information_is_the_inverse_of_a_converted_measurements_covariance():
    rng = np.random.default_rng(0)
    line, std = rng.normal(scale=3e4, size=(50, 3)), np.array([60.0, 0.02, 0.03])
    info = converted_information(torch.tensor(line), torch.tensor(std), torch.tensor(True)).numpy()
    np.testing.assert_allclose(
        info @ moments(line, np.zeros(3), std).cov, np.broadcast_to(np.eye(3), (50, 3, 3)), atol=1e-9
    )


def test_information_fades_in_above_the_minimum_range():
    """A track that two sensors start, then comes so close to one of them that it may miss the third scan."""
    tracker = scenario_with({}).make_tracker()
    places = torch.tensor([[0.0, 0.0, 0.0], [4e4, 3e4, 0.0]]).expand(5, 3, 2, 3).double()
    distance = torch.tensor([[8e3, 8e3, last] for last in (4999.0, 5000.0, 5500.0, 6000.0, 7000.0)]).double()
    path = torch.stack([distance, 0.0 * distance, 0.0 * distance], dim=-1)
    std, both = torch.tensor([[30.0, 0.01, 0.01]]).expand(5, 3).double(), torch.tensor([True, True])
    prior = 1e8 * torch.eye(6).expand(5, 6, 6).double()
    edged, sharp = (promised_std(places, path, std, both, prior, tracker, 10.0, edge) for edge in (1e3, 0.0))
    torch.testing.assert_close(edged[:, :2], sharp[:, :2])
    torch.testing.assert_close(edged[0], sharp[0])  # it misses the scan
    assert edged[1, 2] == pytest.approx(float(sharp[0, 2]), rel=1e-3)
    assert 1.02 * sharp[2, 2] < edged[2, 2] < 0.98 * sharp[0, 2]
    torch.testing.assert_close(edged[3:], sharp[3:])


# ------------------------------------------------------------------------------------------------ slopes


WEIGHTS = {
    "reward_log_position_error": 0.2, "reward_log_position_bound": 0.1, "reward_position_error": 1.0,
    "reward_final_log_position_error": 2.0, "reward_final_position_error": 5.0,
}  # fmt: skip


@pytest.mark.parametrize("fields", [{}, {"angle_only": 1}, {"carrier": "ground"}, {"course": "flights"}], ids=str)
def test_the_gradient_is_that_of_the_compiled_bound(fields):
    """Central differences of the compiled recursion along places that the environment's equations give."""
    actions, flight, _, _ = flown({**WEIGHTS, "steps": 12, **fields}, episodes=3)
    s = flight.scenario

    def compiled(actions):
        std = np.broadcast_to(np.asarray(flight.task.std)[:, None], (3, s.sensors, 3))
        state = s.make_tracker().initiate(entry_prior(flight.task))
        path = np.concatenate([flight.path, np.zeros_like(flight.path)], axis=-1)
        layout = Layout(places_of(actions, flight), std, s.ranging)
        promised = s.make_tracker().promise(state, path, layout, s.step_s)
        return loss(torch.tensor(promised.position_std_m), s).numpy()

    slope, bound = gradient(actions, flight)
    assert bound.shape == (3, 12)
    rng = np.random.default_rng(1)
    inner = np.argwhere(abs(actions) < 0.9)
    for e, k, a in rng.permutation(inner)[:60]:
        shifted = [actions.astype(float) for _ in range(2)]
        shifted[0][e, k, a] += 1e-5
        shifted[1][e, k, a] -= 1e-5
        difference = (compiled(shifted[0]) - compiled(shifted[1])) / 2e-5
        assert slope[e, k, a] == pytest.approx(difference[e], rel=1e-4, abs=1e-5), (e, k, a)
        assert np.delete(difference, e) == pytest.approx(0.0)


def test_the_gradient_holds_for_carriers_that_fly_across_what_is_too_near():
    """Central differences along actions that lead through it, the places being the environment's own (as above)."""
    actions, flight, _, _ = flown({**WEIGHTS, "steps": 16, "nearest_max_m": 4e4}, episodes=4, near=True)
    c, q = np.moveaxis(flight.courses, -1, 0)[..., None]
    actions[:, 0, 1::3] = 0.0, 0.3, -0.3
    actions[:, 1:, 0::3], actions[:, 1:, 1::3] = 0.8 * c[:, 1:], -0.8 * q[:, 1:]  # away from the site, all of them
    _, distance, _ = seen_from_entry(places_of(actions, flight), flight.task.entry_distance_m[:, None, None])
    assert (distance[:, 4:] < 4e4 - 1.0).any()
    slope, _ = gradient(actions, flight)
    for e, k, a in np.argwhere((abs(actions) > 0.1) & (abs(actions) < 0.99))[::17]:
        shifted = [torch.tensor(actions).double() for _ in range(2)]
        shifted[0][e, k, a] += 1e-5
        shifted[1][e, k, a] -= 1e-5
        up, down = (loss(bound_of(part, flight, EDGE_M), flight.scenario)[e] for part in shifted)
        assert slope[e, k, a] == pytest.approx(float(up - down) / 2e-5, rel=1e-3, abs=1e-5), (e, k, a)


def test_blocks_do_not_matter(monkeypatch):
    actions, flight, _, _ = flown({"steps": 5}, episodes=5)
    whole = gradient(actions, flight)
    monkeypatch.setattr("agents.bound_gradient.BLOCK", 2)
    for part, other in zip(gradient(actions, flight), whole, strict=True):
        np.testing.assert_allclose(part, other, rtol=1e-9, atol=1e-12)


def test_slopes_are_finite_below_the_minimum_range_overhead_and_standing_still():
    actions, flight, _, _ = flown({"steps": 4}, episodes=2)
    actions[:, 1:] = 0.0
    where = places_of(actions, flight)
    above = where[:, :, 0] + np.array([0.0, 0.0, 6e3])  # the first sensor straight below, the path being there
    for path in (above, where[:, :, 0]):
        slope, bound = gradient(actions, flight._replace(path=path))
        assert np.isfinite(slope).all()
        assert np.isfinite(bound).all()


# ------------------------------------------------------------------------------------------------ learning


ENVS, STEPS = 32, 12


def small_run(folder, rollouts=4, **preset):
    shipped = load_preset("MobilePlacement", "bound_gradient")
    shipped = {key: part for key, part in shipped.items() if key != "imitation"}
    shipped |= {"checkpoint_rollouts": 2, "net_arch": [16], "learning_rate": 1e-2, **preset}
    shipped["arguments"] = {**shipped["arguments"], "batch_size": 96}
    fields = {"steps": STEPS}
    return Run(folder, "MobilePlacement", fields, "bound_gradient", 5, "cpu", rollouts * ENVS * STEPS, ENVS, shipped)


@pytest.fixture(autouse=True)
def few_evaluation_episodes(monkeypatch):
    monkeypatch.setattr(training, "EVALUATION_EPISODES", 4)


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    return finish(small_run(tmp_path_factory.mktemp("gradient") / "run"), 4)


def untrained(run) -> Any:
    model = new_model(run, training_env(run))
    assert isinstance(model, BoundGradient)
    return model


def test_it_learns(tmp_path):
    run = small_run(tmp_path / "run", rollouts=12)
    train(run, progress=False)
    bound = logged(run.folder)["train/position_bound_m"]
    assert bound[-1].value < 0.75 * bound[0].value


def test_both_kinds_of_targets_are_flown_and_learned_from(tmp_path):
    model = untrained(small_run(tmp_path / "run"))
    model.learn(ENVS * STEPS)
    assert [flight.scenario.course for flight in model._flights] == ["random", "flights"]
    assert [len(flight.path) for flight in model._flights] == [ENVS // 2, ENVS // 2]


def test_actions_beyond_the_box_are_led_back_and_never_further_out(tmp_path):
    model = untrained(small_run(tmp_path / "run"))
    with torch.no_grad():
        model.policy.action_net.bias.fill_(1.5)
    x = torch.zeros(4, *model.observation_space.shape)
    before = model.policy.get_distribution(x).mode().detach().clone()
    g = torch.ones(4, 9)
    g[:, 1] = -1.0
    model._descend(x, g)
    moved = model.policy.get_distribution(x).mode() - before
    assert (moved[:, 0] < 0.0).all()
    model.policy.optimizer = torch.optim.SGD(model.policy.parameters(), 1e-2)
    before = model.policy.get_distribution(x).mode().detach().clone()
    model._descend(x, -torch.ones(4, 9))
    torch.testing.assert_close(model.policy.get_distribution(x).mode(), before)


def test_a_checkpoint_holds_no_flights(finished):
    assert (finished.folder / CHECKPOINT).stat().st_size < 400_000
    model = load_model(finished.folder / CHECKPOINT, "bound_gradient")
    assert not {"_seen", "_flown", "_flights"} & set(vars(model))


def test_an_interrupted_run_resumes_to_exactly_the_same_end(finished, tmp_path):
    run = dataclasses.replace(finished, folder=tmp_path / "run")
    interrupt(run, 3 * ENVS * STEPS)
    train(run, resume=True, progress=False)
    whole, resumed = (
        load_model(folder / "model.zip", "bound_gradient").policy.state_dict()
        for folder in (finished.folder, run.folder)
    )
    for name in whole:
        assert torch.equal(whole[name], resumed[name]), name


def test_one_draw_does_not_outweigh_all_others(tmp_path, monkeypatch):
    """Slopes longer than `max_slope` are cut to it, shorter ones stay."""
    model, given = untrained(small_run(tmp_path / "run")), []
    monkeypatch.setattr(model, "_descend", lambda x, g: given.append(g))
    model.learn(ENVS * STEPS)
    lengths = torch.cat(given).norm(dim=1)
    assert len(lengths) == ENVS * STEPS
    assert lengths.max() == pytest.approx(model.max_slope, rel=1e-5)
    assert (lengths < 0.9 * model.max_slope).any()
    with pytest.raises(ValueError, match=r"max_slope 0\.0: must be positive"):
        BoundGradient("MlpPolicy", model.get_env(), max_slope=0.0)


def test_a_gradient_that_is_not_finite_changes_nothing(tmp_path, monkeypatch):
    model = untrained(small_run(tmp_path / "run"))
    before = {name: part.clone() for name, part in model.policy.state_dict().items()}

    def spoiled(actions, flight):
        slope, bound = gradient(actions, flight)
        slope[1, 2, 3] = np.nan
        return slope, bound

    monkeypatch.setattr("agents.bound_gradient.gradient", spoiled)
    with pytest.raises(FloatingPointError, match=r"not finite in 2 of 32 episodes"):
        model.learn(ENVS * STEPS)
    for name, part in model.policy.state_dict().items():
        assert torch.equal(part, before[name]), name


def test_a_rollout_begins_with_an_episode(tmp_path):
    model = untrained(small_run(tmp_path / "run"))
    model.learn(2 * ENVS, callback=lambda known, _: known["self"].num_timesteps < 2 * ENVS)
    with pytest.raises(ValueError, match="must begin with an episode"):
        model.learn(ENVS * STEPS, reset_num_timesteps=False)


def test_the_shipped_preset_begins_with_its_teacher(tmp_path):
    run = plan("MobilePlacement", tmp_path / "run", "bound_gradient", envs=4, fields={"steps": 3}, timesteps=24)
    preset = {**run.preset, "imitation": {**run.preset["imitation"], "episodes": 2, "epochs": 1}}
    run = dataclasses.replace(run, preset=preset)
    train(run, progress=False)
    assert load_model(run.folder / "model.zip", "bound_gradient").num_timesteps == 24


def test_it_is_packed_and_acts_the_same(finished, tmp_path):
    pack(finished.folder, tmp_path / "policy.npz", episodes=2)
    scenario = make_scenario("MobilePlacement", {"actions": "velocities", "steps": STEPS})
    flown = [
        fly(scenario, open_policy(str(path), "passive/MobilePlacement-v0", scenario.make_simulation()), 4, 1).samples
        for path in (finished.folder, tmp_path / "policy.npz")
    ]
    for error in flown[0]:
        np.testing.assert_allclose(flown[0][error], flown[1][error], rtol=1e-3)


def test_what_it_cannot_follow_is_refused(tmp_path):
    with pytest.raises(
        ValueError, match=r"--algo bound_gradient follows .* actions='velocities' only, not of 'continuous'"
    ):
        plan("MobilePlacement", tmp_path, "bound_gradient", fields={"actions": "continuous"})
    with pytest.raises(ValueError, match=r"no preset for algorithm 'bound_gradient' in Ownship: known are ppo"):
        plan("Ownship", tmp_path, "bound_gradient")
    for fields, words in (
        ({"reward_position_gain": 5.0}, r"no derivative of reward_position_gain: set it to 0 and weigh reward_log_pos"),
        ({"reward_position_error": 0.0, "reward_final_position_error": 0.0}, r"nothing to follow, all of the reward's"),
    ):
        with pytest.raises(ValueError, match=words):
            plan("MobilePlacement", tmp_path, "bound_gradient", fields=fields)
    with pytest.raises(ValueError, match="none that --engine rllib trains"):
        plan("MobilePlacement", tmp_path, "bound_gradient", runners=2)
    assert not list(tmp_path.iterdir())


def test_environments_and_rollouts_of_other_kinds_are_refused():
    def begin(name, n_steps=4, **fields):
        env = Sb3VecEnv(PassiveVectorEnv(name, num_envs=2, autoreset_mode="same_step", **fields))
        return BoundGradient("MlpPolicy", env, n_steps=n_steps, batch_size=4)

    with pytest.raises(ValueError, match="BoundGradient on Ownship needs sensors on carriers"):
        begin("Ownship")
    with pytest.raises(ValueError, match=r"BoundGradient on MobilePlacement follows .* not of 'continuous'"):
        begin("MobilePlacement")
    with pytest.raises(ValueError, match=r"n_steps 4: must be 60, the steps of an episode"):
        begin("MobilePlacement", actions="velocities")
