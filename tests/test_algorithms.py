"""Every learning algorithm: trains, saves, resumes to the same end, evaluates; what does not go together is refused."""

import copy
import dataclasses
from pathlib import Path

import numpy as np
import pytest
import torch
from training_runs import interrupt, logged

from agents import cli, training
from agents.algorithms import ALGORITHMS
from agents.evaluation import fly
from agents.learned import LearnedPolicy, ModelPolicy, load_model
from agents.presets import LONGER, load_preset
from agents.sb3 import Sb3VecEnv
from agents.training import CHECKPOINT, Run, new_model, plan, train
from passive_env import PassiveVectorEnv
from passive_env.catalogue import SCENARIOS, make_scenario
from passive_env.core import Simulation

ENVS, STEPS = 6, 10
ROLLOUT = ENVS * STEPS
ID = "passive/Ownship-v0"
FIELDS = {"steps": STEPS}
EVERYWHERE = [algo for algo, known in ALGORITHMS.items() if known.scenario_refusal is None]
"""Algorithms for every scenario; the others have their own tests."""
TRAINED = [algo for algo in EVERYWHERE if algo not in LONGER]
EVERY = pytest.mark.parametrize("algo", TRAINED)


def tiny_preset(algo: str) -> dict:
    """The shipped preset with everything that takes time cut down."""
    preset = copy.deepcopy(load_preset("Ownship", algo)) | {"checkpoint_rollouts": 1, "net_arch": [8]}
    small = {"batch_size": 20, "n_epochs": 2, "learning_starts": 150, "gradient_steps": 2, "buffer_size": 400}
    preset["arguments"] |= {name: value for name, value in small.items() if name in preset["arguments"]}
    if "imitation" in preset:
        preset["imitation"] |= {"teacher": "rule", "episodes": 8, "epochs": 2}
    if "lstm_hidden_size" in preset.get("policy", {}):
        preset["policy"]["lstm_hidden_size"] = 8
    return preset


def tiny_run(folder: Path, algo: str, rollouts: int = 4, **changes) -> Run:
    values = {"scenario_name": "Ownship", "fields": FIELDS, "algo": algo, "seed": 5, "device": "cpu"}
    values |= {"timesteps": rollouts * ROLLOUT, "envs": ENVS, "preset": tiny_preset(algo)}
    return Run(folder, **(values | changes))


@pytest.fixture(autouse=True)
def few_evaluation_episodes(monkeypatch):
    monkeypatch.setattr(training, "EVALUATION_EPISODES", 4)


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """Uninterrupted runs by algorithm, each trained when first asked for."""
    runs = {}

    def run_of(algo: str) -> Run:
        if algo not in runs:
            runs[algo] = tiny_run(tmp_path_factory.mktemp(algo) / "run", algo)
            train(runs[algo], progress=False)
        return runs[algo]

    return run_of


def parameters(file: Path, algo: str) -> dict[str, torch.Tensor]:
    return load_model(file, algo).policy.state_dict()


# ------------------------------------------------------------------------------------------------ all of them


@EVERY
def test_it_trains_logs_saves_and_flies(finished, algo):
    run = finished(algo)
    model = load_model(run.folder / "model.zip", algo)
    assert type(model) is ALGORITHMS[algo].learner
    assert model.num_timesteps == 4 * ROLLOUT
    curves = {tag: [event.step for event in events] for tag, events in logged(run.folder).items()}
    assert {"rollout/ep_rew_mean", "rollout/final_range_error_m", "eval/final_range_error_m", "eval/ratio_to_rule"} <= {
        *curves
    }
    assert curves["rollout/ep_rew_mean"] == [k * ROLLOUT for k in (1, 2, 3, 4)]
    trained, before = parameters(run.folder / "model.zip", algo), parameters(run.folder / CHECKPOINT, algo)
    assert any(not torch.equal(trained[name], before[name]) for name in trained)
    record = fly(run.scenario, LearnedPolicy(run.folder, ID, Simulation(run.scenario)), 5, 0)
    assert record.range_error_m.shape == (5, STEPS + 1)
    assert np.isfinite(record.range_error_m).all()


@EVERY
def test_an_interrupted_run_resumes_to_exactly_the_same_end(finished, algo, tmp_path):
    run = dataclasses.replace(finished(algo), folder=tmp_path / "run")
    interrupt(run, 2 * ROLLOUT + ENVS)
    assert not (run.folder / "model.zip").exists()
    assert load_model(run.folder / CHECKPOINT, algo).num_timesteps == 2 * ROLLOUT
    train(run, resume=True, progress=False)
    whole, resumed = (parameters(folder / "model.zip", algo) for folder in (finished(algo).folder, run.folder))
    assert whole.keys() == resumed.keys()
    for name in whole:
        assert torch.equal(whole[name], resumed[name]), name


@EVERY
def test_a_truncated_model_is_a_value_error_that_names_file_and_algorithm(finished, algo, tmp_path):
    file = tmp_path / "model.zip"
    content = (finished(algo).folder / "model.zip").read_bytes()
    file.write_bytes(content[: len(content) // 2])
    with pytest.raises(ValueError, match=rf"{file}: damaged or not a saved {algo} model"):
        load_model(file, algo)


@pytest.mark.parametrize("algo", EVERYWHERE)
@pytest.mark.parametrize("name", SCENARIOS)
def test_every_scenario_has_a_preset_from_which_a_model_can_be_made(algo, name, tmp_path):
    run = plan(name, tmp_path, algo, envs=2)
    assert run.timesteps % (run.scenario.steps * run.preset["envs"]) == 0
    run = dataclasses.replace(run, preset={key: part for key, part in run.preset.items() if key != "imitation"})
    flown = PassiveVectorEnv(run.training_scenario, num_envs=2, autoreset_mode="same_step")
    env = Sb3VecEnv(flown)
    policy = ModelPolicy(new_model(run, env), flown.simulation)
    observation = env.reset()
    commanded = run.scenario.replace(actions="continuous").make_actions().size
    assert policy.act(flown.belief(), observation).shape == (2, commanded)


@pytest.mark.parametrize("algo", [algo for algo in TRAINED if ALGORITHMS[algo].on_policy])
def test_on_policy_algorithms_choose_among_discrete_actions(algo, tmp_path):
    run = tiny_run(tmp_path / "run", algo, rollouts=1, fields={**FIELDS, "actions": "discrete"})
    train(run, progress=False)
    env = PassiveVectorEnv(run.scenario, num_envs=4)
    observation, _ = env.reset(seed=0)
    policy = LearnedPolicy(run.folder, ID, env.simulation)
    policy.reset(env.belief())
    assert set(np.unique(policy.act(env.belief(), observation))) <= {-1.0, 0.0, 1.0}


def test_help_and_list_name_every_algorithm(capsys):
    with pytest.raises(SystemExit):
        cli.main(["train", "--help"])
    printed = capsys.readouterr().out
    assert all(algo in printed for algo in ALGORITHMS)
    assert cli.main(["list"]) == 0
    assert f"algorithms: {', '.join(ALGORITHMS)}" in capsys.readouterr().out


# ------------------------------------------------------------------------------------------------ refusals


@pytest.mark.parametrize("make", [lambda *a, **fields: plan("Ownship", *a, **fields), tiny_run], ids=["plan", "run"])
def test_sac_refuses_discrete_actions(make, tmp_path):
    with pytest.raises(ValueError, match=r"--algo sac .*actions='discrete'.*needs a Box .* actions='continuous'"):
        make(tmp_path / "run", "sac", fields={**FIELDS, "actions": "discrete"})


def test_sac_refuses_a_teacher(tmp_path):
    preset = tiny_preset("sac") | {"imitation": tiny_preset("ppo")["imitation"]}
    with pytest.raises(ValueError, match="--algo sac cannot imitate"):
        tiny_run(tmp_path / "run", "sac", preset=preset)


def test_unknown_algorithms_are_refused_with_the_known_ones(tmp_path):
    with pytest.raises(ValueError, match="'dreams': known are ppo, ppo_long, ppo_scratch, recurrent_ppo, sac, bound_g"):
        dataclasses.replace(tiny_run(tmp_path / "run", "ppo"), algo="dreams")


def test_a_run_of_one_algorithm_is_not_resumed_as_another(finished):
    run = finished("ppo")
    with pytest.raises(ValueError, match=r"cannot resume, algo was 'ppo' .* is 'ppo_scratch' now"):
        train(dataclasses.replace(run, algo="ppo_scratch"), resume=True, progress=False)


# ------------------------------------------------------------------------------------------------ memory


@pytest.fixture
def flight():
    """Observations [k, e, d] of five episodes under random commands, and a belief."""
    env = PassiveVectorEnv("Ownship", num_envs=5, **FIELDS)
    rng = np.random.default_rng(0)
    observations = [env.reset(seed=0)[0]]
    while len(observations) < STEPS:
        observations.append(env.step(rng.uniform(-1.0, 1.0, (5, 1)).astype(np.float32))[0])
    return np.array(observations), env.belief()


def decisions(policy, observations, belief) -> np.ndarray:
    policy.reset(belief)
    return np.array([policy.act(belief, observation) for observation in observations])


def test_a_recurrent_policy_decides_alike_in_batches_of_any_width(finished, flight):
    observations, belief = flight
    policy = LearnedPolicy(finished("recurrent_ppo").folder, ID, Simulation(make_scenario("Ownship", FIELDS)))
    together = decisions(policy, observations, belief)
    assert np.ptp(together, axis=1).min() > 0.0
    for rows in (slice(0, 1), slice(1, 3), slice(2, 5)):
        np.testing.assert_allclose(decisions(policy, observations[:, rows], belief), together[:, rows], atol=1e-6)
    assert np.array_equal(decisions(policy, observations, belief), together)


def test_a_recurrent_policy_remembers_an_episode_until_reset(finished, flight):
    observations, belief = flight
    policy = LearnedPolicy(finished("recurrent_ppo").folder, ID, Simulation(make_scenario("Ownship", FIELDS)))
    policy.reset(belief)
    first = policy.act(belief, observations[0])
    assert not np.array_equal(policy.act(belief, observations[0]), first)
    with pytest.raises(ValueError, match=r"3 observations, but 5 episodes .* reset\(\)"):
        policy.act(belief, observations[0, :3])
    policy.reset(belief)
    assert np.array_equal(policy.act(belief, observations[0]), first)


# ------------------------------------------------------------------------------------------------ replay buffer


def test_a_checkpoint_of_sac_holds_its_replay_buffer_and_the_model_does_not(finished):
    folder = finished("sac").folder
    model = load_model(folder / CHECKPOINT, "sac")
    assert model.replay_buffer.pos == 3 * STEPS
    assert np.abs(model.replay_buffer.observations[: 3 * STEPS]).max(axis=-1).min() > 0.0
    assert load_model(folder / "model.zip", "sac").replay_buffer.pos == 0


def test_a_replay_buffer_follows_the_model_to_another_device(finished, tmp_path):
    run = dataclasses.replace(finished("sac"), folder=tmp_path)
    model = load_model(finished("sac").folder / CHECKPOINT, "sac")
    model.replay_buffer.device = torch.device("meta")
    training.save_model(model, tmp_path / CHECKPOINT, "replay_buffer")
    (tmp_path / "config.json").write_bytes((finished("sac").folder / "config.json").read_bytes())
    train(run, resume=True, progress=False)
    whole, resumed = (parameters(folder / "model.zip", "sac") for folder in (finished("sac").folder, tmp_path))
    assert all(torch.equal(whole[name], resumed[name]) for name in whole)
