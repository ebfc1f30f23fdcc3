"""The quicker tanh is tanh: values, gradients, saved files."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from stable_baselines3 import PPO
from torch import nn

from agents.activation import QuickTanh, quicken, single_tanh
from agents.sb3 import Sb3VecEnv
from passive_env import PassiveVectorEnv


def numbers() -> torch.Tensor:
    """Ordinary, tiny, huge and special numbers [4000]."""
    rng = np.random.default_rng(0)
    ordinary = rng.uniform(-12.0, 12.0, 3000)
    tiny = 10.0 ** rng.uniform(-30.0, -3.0, 992) * rng.choice([-1.0, 1.0], 992)
    return torch.tensor([*ordinary, *tiny, 0.0, -0.0, 1e30, -1e30, np.inf, -np.inf, 88.0, -88.0], dtype=torch.float32)


def test_values_and_gradients_are_those_of_tanh():
    x = numbers()
    a, b = x.clone().requires_grad_(), x.clone().requires_grad_()
    quick, exact = QuickTanh()(a), torch.tanh(b)
    torch.testing.assert_close(quick, torch.tanh(x.double()).float(), rtol=5e-7, atol=0.0)
    assert (quick.abs() <= 1.0).all()
    weights = torch.linspace(-1.0, 1.0, len(x))
    (quick * weights).sum().backward()
    (exact * weights).sum().backward()
    assert a.grad is not None
    torch.testing.assert_close(a.grad, b.grad, rtol=1e-5, atol=1e-6)  # 1 − y² of a y to 5e-7
    assert (a.grad[:3000].abs() > 0.0).any()


def test_what_is_no_number_stays_none():
    """A training that has broken down must show it."""
    assert np.isnan(single_tanh(np.array([0.0, np.nan], dtype=np.float32))).tolist() == [False, True]


def test_what_only_decides_is_numpys():
    with torch.no_grad():
        x = nn.Linear(1, 8)(torch.linspace(-9.0, 9.0, 500)[:, None])
        np.testing.assert_array_equal(QuickTanh()(x).numpy(), np.tanh(x.numpy()))


def test_any_shape_and_order_in_memory():
    x = torch.linspace(-4.0, 4.0, 7 * 65).reshape(7, 65).T.requires_grad_()
    y = QuickTanh()(x)
    assert y.shape == (65, 7)
    torch.testing.assert_close(y, torch.tanh(x), rtol=1e-6, atol=0.0)


def test_gradient_agrees_with_finite_differences():
    x = torch.linspace(-2.0, 2.0, 9, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(QuickTanh(), (x,))


def test_every_tanh_of_a_network_is_replaced_and_nothing_else():
    network = nn.Sequential(nn.Linear(3, 4), nn.Tanh(), nn.Sequential(nn.Linear(4, 4), nn.Tanh(), nn.ReLU()))
    kept = network.state_dict()
    quicken(network)
    kinds = [type(module) for module in network.modules()]
    assert nn.Tanh not in kinds
    assert kinds.count(QuickTanh) == 2
    assert kinds.count(nn.ReLU) == 1
    assert all(kept[name] is value or torch.equal(kept[name], value) for name, value in network.state_dict().items())


@pytest.mark.parametrize("passes", [1, 3])
def test_a_quickened_model_learns_the_same_up_to_rounding(passes):
    """The same rollout and the same minibatches: losses' gradients differ by rounding only."""
    models = []
    for quick in (False, True):
        env = Sb3VecEnv(PassiveVectorEnv("Ownship", num_envs=8, autoreset_mode="same_step", steps=10))
        env.seed(3)
        model = PPO("MlpPolicy", env, n_steps=10, batch_size=40, n_epochs=passes, seed=2, device="cpu")
        if quick:
            quicken(model.policy)
        models.append(model.learn(80))
    plain, quickened = (model.policy.state_dict() for model in models)
    untouched = PPO("MlpPolicy", env, seed=2, device="cpu").policy.state_dict()
    for name, value in plain.items():
        torch.testing.assert_close(quickened[name], value, rtol=0.0, atol=2e-5)
    assert max((plain[name] - untouched[name]).abs().max() for name in plain) > 2e-4


def test_a_quickened_model_is_saved_as_an_ordinary_one(tmp_path):
    env = Sb3VecEnv(PassiveVectorEnv("Ownship", num_envs=2, autoreset_mode="same_step"))
    model = PPO("MlpPolicy", env, seed=2, device="cpu")
    quicken(model.policy)
    model.save(tmp_path / "model.zip")
    loaded = PPO.load(tmp_path / "model.zip", device="cpu")
    assert QuickTanh not in {type(module) for module in loaded.policy.modules()}
    x = np.random.default_rng(0).uniform(-5.0, 5.0, (20, 18)).astype(np.float32)
    ours, theirs = (each.predict(x, deterministic=True)[0] for each in (model, loaded))
    np.testing.assert_allclose(ours, theirs, rtol=0.0, atol=1e-6)
