"""Imitation of a teacher: mirror images of flights, and sequences for networks with memory."""

import copy
from pathlib import Path

import numpy as np
import pytest
import torch

from agents import imitation
from agents.imitation import _demonstrations, _read, imitate
from agents.learned import ModelPolicy
from agents.sb3 import Sb3VecEnv
from agents.training import new_model, plan
from passive_env import PassiveVectorEnv
from passive_env.catalogue import make_scenario
from passive_env.core import Simulation

UPSIDE_DOWN = np.array([1.0, -1.0, 1.0, -1.0])
"""Mirrors states x, y, vx, vy at the x axis."""


def mirrored_tape(tape):
    return tape._replace(
        platforms=tape.platforms * UPSIDE_DOWN,
        targets=tape.targets * UPSIDE_DOWN,
        noise=-tape.noise,
        false_bearings=-tape.false_bearings,
        discs=tape.discs * np.array([1.0, -1.0, 1.0]),
    )


def fly(scenario, commands):
    """Observations [k + 1, e, d] and rewards [k, e] under commands [k, e, a]."""
    simulation = Simulation(scenario)
    world = simulation.begin([np.random.default_rng(seed) for seed in range(commands.shape[1])])
    observations, rewards = [simulation.observe(world)], []
    for command in commands:
        world, reward, _ = simulation.advance(world, command)
        observations.append(simulation.observe(world))
        rewards.append(reward)
    return np.array(observations), np.array(rewards)


@pytest.mark.parametrize(
    ("name", "fields"),
    [
        ("Ownship", {}),
        ("Ownship", {"nogo_discs": 2, "detection_probability": 0.8}),
        ("OwnshipManeuvering", {}),
        ("OwnshipMulti", {}),
        ("TwoStation", {}),
        ("TwoStation", {"targets": 2, "false_bearings_mean": 0.5}),
    ],
    ids=str,
)
def test_a_mirrored_world_shows_the_mirrored_observation_and_earns_the_same(name, fields, monkeypatch):
    scenario = make_scenario(name, {"steps": 12, **fields})
    draw = type(scenario).draw_tape
    commands = np.random.default_rng(1).uniform(-1.0, 1.0, (12, 6, scenario.stations))
    observations, rewards = fly(scenario, commands)
    monkeypatch.setattr(type(scenario), "draw_tape", lambda self, generators: mirrored_tape(draw(self, generators)))
    images, same = fly(scenario, -commands)
    expected = scenario.make_observation().mirrored(observations)
    assert not np.allclose(observations, expected, atol=0.1)
    np.testing.assert_allclose(images, expected, atol=1e-4)
    np.testing.assert_allclose(same, rewards, atol=1e-6)


def test_a_mirror_image_of_the_mirror_image_is_the_observation():
    model = make_scenario("OwnshipMulti", {"nogo_discs": 1}).make_observation()
    observation = np.random.default_rng(0).uniform(-1.0, 1.0, (4, len(model.fields))).astype(np.float32)
    assert np.array_equal(model.mirrored(model.mirrored(observation)), observation)


@pytest.mark.parametrize("actions", ["continuous", "discrete"])
def test_mirrored_demonstrations_follow_the_flown_ones(actions):
    scenario = make_scenario("TwoStation", {"steps": 5, "actions": actions})
    x, y, earned = _demonstrations(scenario, "rule", 3, 0.3, 7, 0.9, mirror=False)
    both = _demonstrations(scenario, "rule", 3, 0.3, 7, 0.9, mirror=True)
    assert x.shape == (5, 3, len(scenario.make_observation().fields))
    assert (y.shape, earned.shape) == ((5, 3, 2), (5, 3))
    assert [part.dtype for part in both] == [x.dtype, y.dtype, earned.dtype]
    other_side = 2 - y if actions == "discrete" else -y
    images = scenario.make_observation().mirrored(x), other_side, earned
    for part, flown, image in zip(both, (x, y, earned), images, strict=True):
        assert np.array_equal(part[:, :3], flown)
        assert np.array_equal(part[:, 3:], image)


def untaught(algo, **fields):
    run = plan("Ownship", Path("unused"), algo, envs=2, fields={"steps": 8, **fields})
    preset = copy.deepcopy(run.preset)
    preset.pop("imitation")
    preset["net_arch"] = [16]
    object.__setattr__(run, "preset", preset)
    env = Sb3VecEnv(PassiveVectorEnv(run.training_scenario, num_envs=2, autoreset_mode="same_step"))
    return new_model(run, env), run.training_scenario


@pytest.mark.parametrize("algo", ["ppo", "recurrent_ppo"])
@pytest.mark.parametrize("mirror", [False, True])
def test_imitation_brings_the_actor_close_to_its_teacher(algo, mirror):
    model, scenario = untaught(algo)
    settings = {"teacher": "rule", "episodes": 64, "learning_rate": 3e-3, "noise": 0.3, "seed": 1, "mirror": mirror}
    first = imitate(model, scenario, epochs=1, **settings)
    last = imitate(model, scenario, epochs=60, **settings)
    assert last < 0.7 * first


@pytest.mark.parametrize("algo", ["ppo", "recurrent_ppo"])
def test_a_teacher_flies_its_episodes_in_blocks_of_consecutive_seeds(algo, monkeypatch):
    blocks, rows = [], []

    def recorded(scenario, teacher, episodes, noise, seed, *more):
        blocks.append((episodes, seed))
        found = _demonstrations(scenario, teacher, episodes, noise, seed, *more)
        rows.append(found[0])
        return found

    monkeypatch.setattr(imitation, "BLOCK", 3)
    monkeypatch.setattr(imitation, "_demonstrations", recorded)
    model, scenario = untaught(algo)
    loss = imitate(model, scenario, "rule", 7, epochs=1, learning_rate=1e-3, noise=0.3, seed=40)
    assert blocks == [(3, 40), (3, 43), (1, 46)]
    assert [part.shape[:2] for part in rows] == [(8, 3), (8, 3), (8, 1)]
    assert np.isfinite(loss)


def test_a_recurrent_actor_reads_flights_as_it_flies_them():
    """Whole sequences in one call against one decision after the other."""
    model, scenario = untaught("recurrent_ppo")
    x, _, _ = _demonstrations(scenario, "rule", 3, 0.3, 7, 0.9, mirror=False)
    with torch.no_grad():
        actor, values = _read(model.policy, torch.as_tensor(x).swapaxes(0, 1))
        read = actor.mode().numpy().reshape(3, 8, 1).swapaxes(0, 1)
    policy = ModelPolicy(model, Simulation(scenario))
    flown = np.array([policy.act(None, observation) for observation in x])
    np.testing.assert_allclose(read, flown, atol=1e-6)
    assert values.shape == (24,)
