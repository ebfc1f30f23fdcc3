"""The critic sees the truth, the actor does not, and what is saved flies without it."""

import dataclasses

import numpy as np
import pytest
import torch
from stable_baselines3 import PPO

from agents.asymmetric import AsymmetricPolicy, for_flying
from agents.imitation import imitate
from agents.learned import LearnedPolicy, ModelPolicy
from agents.sb3 import Sb3VecEnv
from agents.training import new_model, plan, train
from passive_env.catalogue import environment_id, make_scenario
from passive_env.core import Simulation
from passive_env.truth import TruthObservation
from passive_env.vector_env import PassiveVectorEnv

SMALL = {"timesteps": 2 * 8 * 12, "envs": 8, "fields": {"steps": 12}}


def small_run(folder, name="Ownship", **preset):
    run = plan(name, folder, **SMALL)
    imitation = {"teacher": "rule", "episodes": 8, "epochs": 1, "learning_rate": 1e-3, "noise": 0.3, "critic": 0.5}
    changes = {"asymmetric": True, "net_arch": [8], "imitation": {**imitation, "mirror": True}, **preset}
    return dataclasses.replace(run, preset={**run.preset, **changes})


def vector_env(run):
    env = PassiveVectorEnv(run.training_scenario, num_envs=run.envs, autoreset_mode="same_step")
    return Sb3VecEnv(env, truth=True)


def test_observations_are_belief_then_truth(tmp_path):
    env = vector_env(small_run(tmp_path, "OwnshipMulti"))
    seen = env.reset()
    known = env.env.single_observation_space.shape[0]
    assert seen.shape == (8, known + 21)
    np.testing.assert_array_equal(seen[:, :known], env.env.simulation.observe(env.env.world))
    for _ in range(12):
        seen, *_ = env.step(np.zeros((8, 1), np.float32))
        assert env.observation_space.contains(seen[0])
    fields = dict(zip([field.name for field in env.truth.fields], seen[3, known:], strict=True))
    metrics = env.env.world.metrics
    assert fields["truth1.log_range"] == pytest.approx(np.log(metrics.range_m[3, 1] / 5e4), abs=1e-6)
    assert fields["truth2.log_range_bound"] == pytest.approx(0.5 * np.log(metrics.range_crlb_m[3, 2] / 1e3), abs=1e-6)


def test_truth_parts_by_hand():
    """A target 30 km north-east, flying north at 200 m/s, whose track is twice as far and flies west at 100 m/s."""
    scenario = make_scenario("Ownship", {})
    world = Simulation(scenario).begin([np.random.default_rng(0)])
    place = 30e3 * np.array([0.6, 0.8])
    world.platforms[:, 0, :2] = 0.0
    world.truth[:, 0] = [*place, 0.0, 200.0]
    world.estimate.mean[:, 0] = [*(2.0 * place), -100.0, 0.0]
    log_range, ratio, radial, cross, radial_error, cross_error, _ = TruthObservation(1)(world)[0]
    assert log_range == pytest.approx(np.log(0.6), abs=1e-6)
    assert ratio == pytest.approx(2.0 * np.log(2.0), abs=1e-6)
    assert (radial, cross) == pytest.approx((160.0 / 300.0, 120.0 / 300.0), abs=1e-6)
    # error (−100, −200) m/s along (0.6, 0.8) and along its left (−0.8, 0.6)
    assert (radial_error, cross_error) == pytest.approx((-2.2, -0.4), abs=1e-6)


def test_truth_of_the_mirrored_world():
    scenario = make_scenario("OwnshipMulti", {})
    world = Simulation(scenario).begin([np.random.default_rng(1)])
    flip = np.array([1.0, -1.0, 1.0, -1.0])
    estimate = world.estimate._replace(mean=world.estimate.mean[:, ::-1] * flip)
    crlb = world.metrics._replace(range_crlb_m=world.metrics.range_crlb_m[:, ::-1])
    image = world._replace(
        platforms=world.platforms * flip, truth=world.truth[:, ::-1] * flip, estimate=estimate, metrics=crlb
    )
    truth = TruthObservation(3)
    np.testing.assert_allclose(truth(image), truth.mirrored(truth(world)), atol=1e-6)
    assert not np.allclose(truth(image), truth(world))


def test_a_diverged_tracker_gives_finite_numbers():
    world = Simulation(make_scenario("Ownship", {})).begin([np.random.default_rng(0)])
    world.estimate.mean[:] = np.nan
    assert np.isfinite(TruthObservation(1)(world)).all()


def test_actor_ignores_the_truth_and_critic_does_not(tmp_path):
    run = small_run(tmp_path)
    env = vector_env(run)
    model = new_model(run, env)
    assert isinstance(model.policy, AsymmetricPolicy)
    seen = torch.as_tensor(env.reset())
    other = seen.clone()
    other[:, -7:] += 1.0
    policy = model.policy
    torch.testing.assert_close(policy.get_distribution(seen).mode(), policy.get_distribution(other).mode())
    assert not torch.allclose(policy.predict_values(seen), policy.predict_values(other))


def test_what_flies_has_the_same_actor(tmp_path):
    run = small_run(tmp_path)
    env = vector_env(run)
    model = new_model(run, env)
    plain = for_flying(model)
    assert type(plain) is PPO
    seen = env.reset()
    np.testing.assert_allclose(
        plain.predict(seen[:, :-7], deterministic=True)[0], model.predict(seen, deterministic=True)[0], atol=1e-6
    )
    np.testing.assert_allclose(plain.policy.log_std.detach(), model.policy.log_std.detach())


def test_the_critic_learns_from_the_truth_in_imitation(tmp_path):
    """The teacher's rewards depend on the true range, which the belief does not know at first."""
    weights = {f"reward_{name}": 0.0 for name in ("log_range_bound", "relative_range_error", "final_log_range_bound")}
    run = small_run(tmp_path, scenario={**weights, "reward_log_range_error": 0.1})
    losses = {}
    for asymmetric in (False, True):
        chosen = dataclasses.replace(run, preset={**run.preset, "asymmetric": asymmetric, "net_arch": [32]})
        preset = {name: value for name, value in chosen.preset.items() if name != "imitation"}
        env = Sb3VecEnv(
            PassiveVectorEnv(run.training_scenario, num_envs=8, autoreset_mode="same_step"), truth=asymmetric
        )
        model = new_model(dataclasses.replace(chosen, preset=preset), env)
        taught = {
            **run.preset["imitation"],
            "episodes": 256,
            "epochs": 60,
            "learning_rate": 1e-2,
            "critic": 1e3,
            "mirror": False,
        }
        losses[asymmetric] = imitate(model, run.training_scenario, seed=1, truth=env.truth, **taught)
    assert losses[True] < 0.7 * losses[False]


def test_trained_model_flies_on_the_belief_alone(tmp_path):
    run = small_run(tmp_path / "run")
    train(run, progress=False)
    simulation = Simulation(run.scenario)
    policy = LearnedPolicy(run.folder, environment_id("Ownship"), simulation)
    assert isinstance(policy, ModelPolicy)
    env = PassiveVectorEnv(run.scenario, num_envs=4, autoreset_mode="disabled")
    seen, _ = env.reset(seed=5)
    policy.reset(env.belief())
    assert np.isfinite(policy.act(env.belief(), seen)).all()


def test_resumed_equals_uninterrupted(tmp_path):
    whole, half = small_run(tmp_path / "whole", checkpoint_rollouts=1), small_run(tmp_path / "half")
    half = dataclasses.replace(half, preset=whole.preset)
    train(whole, progress=False)
    train(half, progress=False)
    (half.folder / "model.zip").unlink()  # as if it had been killed after its last checkpoint
    train(half, resume=True, progress=False)
    ours, theirs = (PPO.load(run.folder / "model.zip").policy.state_dict() for run in (whole, half))
    actor = [name for name in ours if name.startswith(("mlp_extractor.policy_net", "action_net", "log_std"))]
    assert len(actor) == 5
    for name in actor:
        torch.testing.assert_close(ours[name], theirs[name], rtol=0, atol=0)


def test_bootstrap_and_truth_exclude_each_other():
    env = PassiveVectorEnv("Ownship", num_envs=2, autoreset_mode="same_step")
    with pytest.raises(ValueError, match="truth=True goes with bootstrap_at_horizon=False"):
        Sb3VecEnv(env, bootstrap_at_horizon=True, truth=True)


@pytest.mark.parametrize("algo", ["recurrent_ppo", "sac"])
def test_other_algorithms_refuse(tmp_path, algo):
    run = plan("Ownship", tmp_path, algo=algo)
    with pytest.raises(ValueError, match=f"--algo {algo} has no critic that could know more"):
        dataclasses.replace(run, preset={**run.preset, "asymmetric": True})
