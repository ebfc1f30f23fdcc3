"""A plain network acts as `predict` says, without it."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from stable_baselines3 import PPO
from torch import nn

from agents.actor import ROWS, plain_actor
from agents.algorithms import ALGORITHMS
from agents.presets import load_preset
from agents.sb3 import Sb3VecEnv
from passive_env import PassiveVectorEnv

PLAIN = ("ppo", "ppo_long", "ppo_scratch", "sac")


def model_of(algo: str, scenario: str = "Ownship", **fields):
    """An untrained model with the shipped preset's network and large weights, so that actions reach their limits."""
    preset = load_preset(scenario, algo)
    env = Sb3VecEnv(PassiveVectorEnv(scenario, num_envs=2, autoreset_mode="same_step", **fields))
    learner = ALGORITHMS[algo].learner
    model = learner(
        ALGORITHMS[algo].network, env, seed=1, device="cpu",
        policy_kwargs={"net_arch": preset["net_arch"], **preset.get("policy", {})},
    )  # fmt: skip
    stir(model, 3)
    return model


def stir(model, seed: int) -> None:
    """Give the actor's last layer large random weights."""
    last = model.policy.actor.mu if hasattr(model.policy, "actor") else model.policy.action_net
    generator = torch.Generator().manual_seed(seed)
    with torch.no_grad():
        last.weight.normal_(std=0.5, generator=generator)
        last.bias.fill_(0.1)


def observations(model, e: int) -> np.ndarray:
    """Anywhere in the observation space, its corners included."""
    rng = np.random.default_rng(2)
    space = model.observation_space
    x = rng.uniform(space.low, space.high, (e, *space.shape))
    return np.where(rng.random(x.shape) < 0.1, np.sign(x) * space.high, x).astype(np.float32)


@pytest.mark.parametrize("scenario", ["Ownship", "TwoStation"])
@pytest.mark.parametrize("algo", PLAIN)
@pytest.mark.parametrize("e", [1, 7, ROWS, 2 * ROWS + 5])
def test_actions_are_those_of_predict(algo, scenario, e):
    model = model_of(algo, scenario)
    actor = plain_actor(model)
    assert actor is not None
    x = observations(model, e)
    before = x.copy()
    expected, _ = model.predict(x, deterministic=True)
    actions = actor(x)
    assert actions.shape == expected.shape
    assert actions.dtype == expected.dtype
    np.testing.assert_allclose(actions, expected, rtol=0.0, atol=1e-5)
    np.testing.assert_array_equal(x, before)
    if e > ROWS:
        assert (np.abs(expected) < 0.9).any()
        assert (np.abs(expected) > 0.999).any()


def test_what_the_model_learns_later_shows_at_once():
    model = model_of("ppo")
    actor = plain_actor(model)
    assert actor is not None
    x = observations(model, 50)
    early = actor(x)
    stir(model, 4)
    assert np.abs(actor(x) - early).max() > 0.1
    np.testing.assert_allclose(actor(x), model.predict(x, deterministic=True)[0], rtol=0.0, atol=1e-5)


def test_no_observations_give_no_actions():
    actor = plain_actor(model_of("ppo"))
    assert actor is not None
    assert actor(np.zeros((0, 18), dtype=np.float32)).shape == (0, 1)


@pytest.mark.parametrize("e", [0, 1, ROWS + 5])
def test_choices_are_those_of_predict(e):
    """The mode of every choice; the packed policies' tests look at near ties."""
    model = model_of("ppo", "TwoStation", actions="discrete")
    actor = plain_actor(model)
    assert actor is not None
    x = observations(model, e)
    expected = model.predict(x, deterministic=True)[0] if e else np.zeros((0, 2))
    np.testing.assert_array_equal(actor(x), expected)
    if e > ROWS:
        assert all(len(np.unique(column)) > 1 for column in expected.T)


def test_other_networks_are_left_to_predict():
    """Memory, exploration noise that depends on the state, layers of another kind."""
    env = Sb3VecEnv(PassiveVectorEnv("Ownship", num_envs=2, autoreset_mode="same_step"))
    assert plain_actor(model_of("recurrent_ppo")) is None
    assert plain_actor(PPO("MlpPolicy", env, use_sde=True, device="cpu")) is None
    assert plain_actor(PPO("MlpPolicy", env, policy_kwargs={"activation_fn": nn.ELU}, device="cpu")) is None
