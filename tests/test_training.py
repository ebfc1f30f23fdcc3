"""Training: what a run leaves behind, exact resume after a kill, refusals, and Stable-Baselines3 on our environment."""

import copy
import dataclasses
import json
import os
import re
import signal
import subprocess
import sys
import time
import zipfile
from pathlib import Path

import numpy as np
import pytest
import torch
from stable_baselines3.common.vec_env import VecMonitor, VecNormalize
from training_runs import finish, logged

from agents import training
from agents.cli import main
from agents.evaluation import fly
from agents.learned import LearnedPolicy, load_model, read_config
from agents.policy import Policy
from agents.presets import load_preset
from agents.sb3 import Sb3VecEnv
from agents.training import CHECKPOINT, TRAINING, Run, plan, train
from passive_env import PassiveEnv, PassiveVectorEnv
from passive_env.catalogue.two_station import TwoStation
from passive_env.core import Simulation

ENVS, STEPS = 8, 45
ROLLOUT = ENVS * STEPS
ID = "passive/TwoStation-v0"


def tiny_run(folder: Path, rollouts: int = 4, checkpoint_rollouts: int = 1, **changes) -> Run:
    """A run of a few rollouts of eight environments; the preset's settings with fewer epochs on one thread."""
    preset = copy.deepcopy(load_preset("TwoStation", "ppo"))
    preset |= {"torch_threads": 1, "checkpoint_rollouts": checkpoint_rollouts, "net_arch": [16, 16]}
    preset["arguments"] |= {"n_epochs": 2, "batch_size": 90}
    if "imitation" in preset:
        preset["imitation"] |= {"episodes": 16, "epochs": 2}
    values = {"scenario_name": "TwoStation", "fields": {}, "algo": "ppo", "seed": 3, "device": "cpu"}
    values |= {"timesteps": rollouts * ROLLOUT, "envs": ENVS, "preset": preset}
    return Run(folder, **(values | changes))


@pytest.fixture(autouse=True)
def few_evaluation_episodes(monkeypatch):
    monkeypatch.setattr(training, "EVALUATION_EPISODES", 8)


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """An uninterrupted run of four rollouts with a checkpoint after each."""
    return finish(tiny_run(tmp_path_factory.mktemp("finished") / "run"), 8)


@pytest.fixture
def copied(finished, tmp_path):
    """A copy of the finished run's folder that a test may damage."""
    import shutil

    shutil.copytree(finished.folder, tmp_path / "run")
    return dataclasses.replace(finished, folder=tmp_path / "run")


def parameters(file: Path) -> dict[str, torch.Tensor]:
    return load_model(file, "ppo").policy.state_dict()


def assert_same_parameters(a: Path, b: Path):
    first, second = parameters(a), parameters(b)
    assert set(first) == set(second)
    for name in first:
        assert torch.equal(first[name], second[name]), name


def snapshot(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


# ------------------------------------------------------------------------------------------------ what a run leaves


def test_a_run_leaves_model_configuration_checkpoint_and_tensorboard_logs(finished):
    names = {path.name for path in finished.folder.iterdir()}
    assert names == {"config.json", "model.zip", CHECKPOINT, TRAINING, "tensorboard"}
    assert list((finished.folder / "tensorboard").rglob("events.out.tfevents.*"))
    config = json.loads((finished.folder / "config.json").read_text())
    assert (config["environment"], config["algo"], config["seed"]) == (ID, "ppo", 3)
    assert (config["timesteps"], config["envs"]) == (4 * ROLLOUT, ENVS)
    assert config["preset"] == finished.preset
    assert config["scenario"]["targets"] == 3
    assert {"python", "numpy", "torch", "gymnasium", "stable-baselines3", "passive-env"} <= set(config["versions"])
    assert config["commit"] is None or len(config["commit"].removesuffix("-dirty")) == 40
    model = load_model(finished.folder / "model.zip", "ppo")
    assert model.num_timesteps == 4 * ROLLOUT
    checkpoint = load_model(finished.folder / CHECKPOINT, "ppo")
    assert checkpoint.num_timesteps == 3 * ROLLOUT


def test_training_changes_the_policy_and_repeats_itself(finished, tmp_path):
    again, other = tiny_run(tmp_path / "again"), tiny_run(tmp_path / "other", seed=4)
    train(again, progress=False)
    train(other, progress=False)
    assert_same_parameters(again.folder / "model.zip", finished.folder / "model.zip")
    trained = parameters(finished.folder / "model.zip")
    for different in (parameters(finished.folder / CHECKPOINT), parameters(other.folder / "model.zip")):
        assert not torch.equal(trained["action_net.weight"], different["action_net.weight"])


def test_logged_curves_hold_the_evaluation_on_the_way(finished):
    curves = logged(finished.folder)
    assert {
        "rollout/ep_rew_mean",
        "rollout/final_range_error_m",
        "eval/final_range_error_m",
        "eval/ratio_to_paper",
    } <= set(curves)
    assert [event.step for event in curves["rollout/ep_rew_mean"]] == [ROLLOUT * k for k in (1, 2, 3, 4)]
    for event in curves["eval/final_range_error_m"]:
        assert 10.0 < event.value < 1e5


def test_the_train_command_trains_and_compares(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(training, "load_preset", lambda *_: tiny_run(tmp_path).preset)
    out = tmp_path / "run"
    arguments = ["--envs", "8", "--timesteps", "360", "--episodes", "3", "--out", str(out)]
    arguments += ["--fields", "bearing_std_deg=0.7"]
    assert main(["train", *arguments]) == 0
    printed = capsys.readouterr().out
    for folder in (out, out / "flights"):
        summary = json.loads((folder / "evaluation.json").read_text())
        assert {"paper", "rule", "learned"} <= set(summary["policies"])
        assert summary["fields"] == {"bearing_std_deg": 0.7}
        assert {path.name for path in folder.glob("evaluation.*")} == {f"evaluation.{s}" for s in ("json", "csv", "md")}
    text = (out / "report.html").read_text(encoding="utf-8")
    assert re.findall(r"<h2[^>]*>(.*?)</h2>", text) == [
        "Drawn courses", "Held-out recorded flights", "Learning curves", "Configuration", "How to repeat it",
    ]  # fmt: skip
    assert "return of an episode:" in text
    (command,) = re.findall(r"<pre><code>(.*?)</code></pre>", text)
    assert re.sub("<.*?>", "", command) == (
        f"passive-env train --env {ID} --algo ppo --timesteps 360 --seed 0 --envs 8 --device cpu --episodes 3 "
        "--flights held-out --fields bearing_std_deg=0.7 --out DIR"
    )
    assert "| learned |" in printed
    assert str(out) in printed
    assert main(["train", *arguments]) == 2
    assert "already exists" in capsys.readouterr().err


def test_default_folders_are_numbered_and_never_reused(tmp_path, monkeypatch):
    from agents.main_job import _free_folder

    monkeypatch.chdir(tmp_path)
    first = _free_folder(Path("runs") / "x", resume=False)
    assert first == Path("runs/x")
    first.mkdir(parents=True)
    second = _free_folder(Path("runs") / "x", resume=False)
    assert second == Path("runs/x-2")
    second.mkdir()
    assert _free_folder(Path("runs") / "x", resume=False) == Path("runs/x-3")


# ------------------------------------------------------------------------------------------------ refusals


def test_an_existing_run_is_not_overwritten(copied):
    before = snapshot(copied.folder)
    with pytest.raises(FileExistsError, match=rf"{copied.folder}.*--resume"):
        train(copied, progress=False)
    assert snapshot(copied.folder) == before


def test_any_other_folder_with_content_is_not_written_into(tmp_path):
    (tmp_path / "notes.txt").write_text("mine")
    with pytest.raises(FileExistsError, match=str(tmp_path)):
        train(tiny_run(tmp_path), progress=False)
    assert snapshot(tmp_path) == {"notes.txt": b"mine"}


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"seed": 4}, ["seed was 3", "is 4 now"]),
        ({"timesteps": 5 * ROLLOUT}, ["timesteps was 1440", "is 1800 now"]),
        ({"envs": 4}, ["envs was 8", "is 4 now"]),
        ({"fields": {"targets": 2}}, ["now"]),
        (
            {"fields": {"actions": "discrete"}},
            ["interface was {'actions': 'continuous'}", "'discrete'} now"],
        ),
        ({"fields": {"reward_maneuver": 0.5}}, ["fields", "reward_maneuver"]),
    ],
    ids=str,
)
def test_resume_with_other_settings_is_refused_and_changes_nothing(copied, changes, words):
    before = snapshot(copied.folder)
    with pytest.raises(ValueError, match="cannot resume") as caught:
        train(dataclasses.replace(copied, **changes), resume=True, progress=False)
    assert str(copied.folder) in str(caught.value)
    assert all(word in str(caught.value) for word in words)
    assert snapshot(copied.folder) == before


def test_resume_with_another_preset_is_refused(copied):
    preset = copy.deepcopy(copied.preset)
    preset["arguments"]["gamma"] = 0.5
    with pytest.raises(ValueError, match="cannot resume, preset"):
        train(dataclasses.replace(copied, preset=preset), resume=True, progress=False)


def test_resume_where_nothing_was_begun_is_refused(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"config\.json"):
        train(tiny_run(tmp_path / "nothing"), resume=True, progress=False)
    assert not (tmp_path / "nothing").exists()


def damage(file: Path, how: str):
    content = file.read_bytes()
    if how == "truncated":
        file.write_bytes(content[: len(content) // 2])
    elif how == "random bytes":
        file.write_bytes(np.random.default_rng(0).bytes(5000))
    elif how == "empty":
        file.write_bytes(b"")
    elif how == "flipped bytes":
        broken = bytearray(content)
        for at in np.random.default_rng(1).integers(100, len(broken) - 100, 400):
            broken[at] ^= 0xFF
        file.write_bytes(bytes(broken))
    elif how == "another zip":
        with zipfile.ZipFile(file, "w") as archive:
            archive.writestr("hello.txt", "world")
    elif how == "half a model":
        with zipfile.ZipFile(file) as archive:
            parts = {name: archive.read(name) for name in archive.namelist() if not name.startswith("policy")}
        with zipfile.ZipFile(file, "w") as archive:
            for name, part in parts.items():
                archive.writestr(name, part)


DAMAGES = ("truncated", "random bytes", "empty", "flipped bytes", "another zip", "half a model")


@pytest.mark.parametrize("how", DAMAGES)
def test_a_damaged_model_is_a_value_error_that_names_the_file(copied, how):
    file = copied.folder / "model.zip"
    damage(file, how)
    with pytest.raises(ValueError, match=rf"{file}: damaged or not a saved ppo model"):
        LearnedPolicy(copied.folder, ID, Simulation(TwoStation()))


@pytest.mark.parametrize("how", DAMAGES)
def test_a_damaged_checkpoint_is_a_value_error_that_names_the_file_and_changes_nothing(copied, how):
    file = copied.folder / CHECKPOINT
    damage(file, how)
    before = snapshot(copied.folder)
    with pytest.raises(ValueError, match=rf"{file}: damaged or not a saved ppo model"):
        train(copied, resume=True, progress=False)
    assert snapshot(copied.folder) == before


@pytest.mark.parametrize("content", ["", "{", "[1, 2]", "null", "{}", '{"environment": "passive/TwoStation-v0"}'])
def test_a_damaged_configuration_is_a_value_error_that_names_the_folder(copied, content):
    (copied.folder / "config.json").write_text(content)
    with pytest.raises(ValueError, match=str(copied.folder)):
        LearnedPolicy(copied.folder, ID, Simulation(TwoStation()))


def test_a_configuration_without_its_algorithm_is_a_value_error(copied):
    config = read_config(copied.folder)
    del config["algo"]
    (copied.folder / "config.json").write_text(json.dumps(config))
    with pytest.raises(ValueError, match="algo"):
        LearnedPolicy(copied.folder, ID, Simulation(TwoStation()))


def test_a_model_for_another_environment_is_refused_with_both_names(copied):
    with pytest.raises(ValueError, match=rf"made for {ID}, not for passive/Elsewhere-v0"):
        LearnedPolicy(copied.folder, "passive/Elsewhere-v0", Simulation(TwoStation()))
    config = read_config(copied.folder) | {"environment": "passive/Elsewhere-v0"}
    (copied.folder / "config.json").write_text(json.dumps(config))
    with pytest.raises(ValueError, match=rf"made for passive/Elsewhere-v0, not for {ID}"):
        LearnedPolicy(copied.folder, ID, Simulation(TwoStation()))


@pytest.mark.parametrize("fields", [{"targets": 2}, {"actions": "discrete"}], ids=str)
def test_a_model_for_other_observations_or_actions_is_refused_with_the_environments_name(finished, fields):
    with pytest.raises(ValueError, match=rf"{finished.folder}.*other observations or actions of {ID}"):
        LearnedPolicy(finished.folder, ID, Simulation(TwoStation(**fields)))


def test_a_model_file_of_another_run_is_refused(copied, tmp_path):
    """config.json fits, but somebody has put the model of another scenario beside it."""
    other = tiny_run(tmp_path / "other", rollouts=1, fields={"targets": 2})
    train(other, progress=False)
    (copied.folder / "model.zip").write_bytes((other.folder / "model.zip").read_bytes())
    with pytest.raises(ValueError, match=rf"{copied.folder / 'model.zip'}"):
        LearnedPolicy(copied.folder, ID, Simulation(TwoStation()))


def test_an_unfinished_run_has_no_model_yet(copied):
    (copied.folder / "model.zip").unlink()
    with pytest.raises(FileNotFoundError, match=r"model\.zip.*finished"):
        LearnedPolicy(copied.folder, ID, Simulation(TwoStation()))


def test_evaluate_command_refuses_a_damaged_run_in_one_line(copied, tmp_path, capsys):
    damage(copied.folder / "model.zip", "truncated")
    out = tmp_path / "out"
    assert main(["evaluate", "--policies", "rule", str(copied.folder), "--episodes", "2", "--out", str(out)]) == 2
    error = capsys.readouterr().err
    assert str(copied.folder / "model.zip") in error
    assert len(error.strip().splitlines()) == 1
    assert not out.exists()


@pytest.mark.parametrize(
    ("changes", "word"),
    [
        ({"algo": "dreams"}, "ppo"),
        ({"timesteps": 0}, "timesteps"),
        ({"timesteps": -1}, "timesteps"),
        ({"envs": 0}, "envs"),
    ],
    ids=str,
)
def test_impossible_plans_are_refused(tmp_path, changes, word):
    with pytest.raises(ValueError, match=word):
        plan("TwoStation", tmp_path / "run", **changes)
    assert not (tmp_path / "run").exists()


def test_the_plan_takes_what_is_not_given_from_the_preset(tmp_path):
    preset = load_preset("TwoStation", "ppo")
    run = plan("TwoStation", tmp_path, envs=7)
    assert (run.envs, run.timesteps) == (7, preset["timesteps"])
    with pytest.raises(ValueError, match="no preset for algorithm 'dreams'"):
        load_preset("TwoStation", "dreams")


def test_a_longer_training_says_only_what_it_does_otherwise():
    short, long = load_preset("TwoStation", "ppo"), load_preset("TwoStation", "ppo_long")
    assert long["imitation"] == {**short["imitation"], "episodes": 16_384}
    assert long["flights_share"] == 0.25
    assert long["arguments"] == short["arguments"]
    assert load_preset("Ownship", "ppo_long") == load_preset("Ownship", "ppo")


def test_the_longer_training_trains_and_flies(tmp_path):
    preset = copy.deepcopy(load_preset("TwoStation", "ppo_long")) | {"net_arch": [16, 16]}
    preset["arguments"] |= {"n_epochs": 1, "batch_size": 90}
    preset["imitation"] |= {"episodes": 8, "epochs": 1}
    run = tiny_run(tmp_path / "run", rollouts=1, algo="ppo_long", preset=preset)
    train(run, progress=False)
    simulation = run.scenario.make_simulation()
    record = fly(run.scenario, LearnedPolicy(run.folder, ID, simulation), 4, 0)
    assert np.isfinite(record.final).all()


def test_a_scenario_of_a_family_overrides_its_preset():
    family, own = load_preset("Ownship", "ppo"), load_preset("OwnshipManeuvering", "ppo")
    assert family["imitation"]["teacher"] == "planner"
    assert own["imitation"] == {**family["imitation"], "teacher": "rule_average"}
    assert own["scenario"]["reward_range_error"] == 0.1
    assert own["arguments"] == {**family["arguments"], "gamma": 0.99}
    assert own["flights_share"] == 0.5
    assert "flights_share" not in family
    changed = ("timesteps", "scenario", "imitation", "arguments")
    assert [name for name in family if own[name] != family[name]] == [n for n in family if n in changed]
    assert load_preset("OwnshipManeuvering", "sac") == load_preset("Ownship", "sac")


# ------------------------------------------------------------------------------------------------ kill and resume

KILLED = """
import sys, time
from pathlib import Path
sys.path.insert(0, sys.argv[2])
from test_training import tiny_run
from agents import training

training.EVALUATION_EPISODES = 8
rollout_end = training.Checkpoints._on_rollout_end

def slowly(self):  # so that the killer finds it in the middle
    rollout_end(self)
    if (self._run.folder / training.CHECKPOINT).exists():
        time.sleep(1.0)

training.Checkpoints._on_rollout_end = slowly
training.train(tiny_run(Path(sys.argv[1]), rollouts=7, checkpoint_rollouts=2), progress=False)
"""


def test_a_killed_run_resumes_and_ends_with_exactly_the_same_policy(tmp_path):
    """SIGKILL after the first checkpoint; what came after it is lost, and is repeated to the bit."""
    folder, script = tmp_path / "killed", tmp_path / "killed.py"
    script.write_text(KILLED)
    process = subprocess.Popen(
        [sys.executable, script, folder, Path(__file__).parent], stderr=subprocess.PIPE, text=True
    )
    deadline = time.monotonic() + 120.0
    while not (folder / CHECKPOINT).exists() and process.poll() is None and time.monotonic() < deadline:
        time.sleep(0.02)
    time.sleep(0.5)
    process.send_signal(signal.SIGKILL)
    _, errors = process.communicate(timeout=60)
    assert process.returncode == -signal.SIGKILL, errors
    assert (folder / CHECKPOINT).exists()
    assert not (folder / "model.zip").exists()
    assert load_model(folder / CHECKPOINT, "ppo").num_timesteps in (2 * ROLLOUT, 4 * ROLLOUT)

    resumed = tiny_run(folder, rollouts=7, checkpoint_rollouts=2)
    train(resumed, resume=True, progress=False)
    whole = tiny_run(tmp_path / "whole", rollouts=7, checkpoint_rollouts=2)
    train(whole, progress=False)
    assert load_model(folder / "model.zip", "ppo").num_timesteps == 7 * ROLLOUT
    assert_same_parameters(folder / "model.zip", whole.folder / "model.zip")


def test_a_run_killed_before_its_first_checkpoint_begins_anew(finished, tmp_path):
    run = dataclasses.replace(finished, folder=tmp_path / "run")
    run.folder.mkdir()
    (run.folder / "config.json").write_bytes((finished.folder / "config.json").read_bytes())
    train(run, resume=True, progress=False)
    assert_same_parameters(run.folder / "model.zip", finished.folder / "model.zip")


def test_resuming_a_finished_run_repeats_its_end(copied):
    before = parameters(copied.folder / "model.zip")
    train(copied, resume=True, progress=False)
    after = parameters(copied.folder / "model.zip")
    assert all(torch.equal(before[name], after[name]) for name in before)


def test_models_are_saved_whole_or_not_at_all(finished, tmp_path, monkeypatch):
    file = tmp_path / "model.zip"
    file.write_bytes(b"old")
    model = load_model(finished.folder / "model.zip", "ppo")

    def die(*_):
        raise OSError("no space left on device")

    monkeypatch.setattr(os, "replace", die)
    with pytest.raises(OSError, match="no space"):
        training.save_model(model, file)
    assert file.read_bytes() == b"old"


# ------------------------------------------------------------------------------------------------ the learned policy


def test_a_learned_policy_decides_on_batches(finished):
    env = PassiveVectorEnv(num_envs=5)
    observation, _ = env.reset(seed=0)
    policy = LearnedPolicy(finished.folder, ID, env.simulation)
    assert isinstance(policy, Policy)
    policy.reset(env.belief())
    commands = policy.act(env.belief(), observation)
    assert commands.shape == (5, 2)
    assert np.abs(commands).max() <= 1.0
    assert np.ptp(commands, axis=0).min() > 0.0
    for row in range(5):
        alone = policy.act(env.belief(), observation[row : row + 1])
        np.testing.assert_allclose(alone[0], commands[row], atol=1e-5)
    assert np.array_equal(policy.act(env.belief(), observation), commands)


def test_a_learned_policy_is_its_networks_mean_action(finished):
    """Two hidden layers of tanh, computed by hand from the saved parameters."""
    p = {name: value.numpy().astype(float) for name, value in parameters(finished.folder / "model.zip").items()}
    observation = PassiveEnv().reset(seed=0)[0][None]
    hidden = observation.astype(float)
    for layer in (0, 2):
        weight, bias = (p[f"mlp_extractor.policy_net.{layer}.{part}"] for part in ("weight", "bias"))
        hidden = np.tanh(hidden @ weight.T + bias)
    expected = np.clip(hidden @ p["action_net.weight"].T + p["action_net.bias"], -1.0, 1.0)
    policy = LearnedPolicy(finished.folder, ID, Simulation(TwoStation()))
    np.testing.assert_allclose(policy.act(None, observation), expected, atol=1e-5)


def test_discrete_scenarios_train_and_fly(tmp_path):
    run = tiny_run(tmp_path / "run", rollouts=1, fields={"actions": "discrete"})
    train(run, progress=False)
    env = PassiveVectorEnv(num_envs=4, actions="discrete")
    observation, _ = env.reset(seed=0)
    commands = LearnedPolicy(run.folder, ID, env.simulation).act(env.belief(), observation)
    assert set(np.unique(commands)) <= {-1.0, 0.0, 1.0}
    env.step(env.simulation.actions.encode(commands))


# ------------------------------------------------------------------------------------------------ Stable-Baselines3


def make_env(num_envs=3, bootstrap=False, **fields) -> Sb3VecEnv:
    env = PassiveVectorEnv(num_envs=num_envs, autoreset_mode="same_step", **{"steps": 4, **fields})
    return Sb3VecEnv(env, bootstrap_at_horizon=bootstrap)


@pytest.mark.parametrize("mode", ["next_step", "disabled"])
def test_other_autoreset_modes_are_refused(mode):
    with pytest.raises(ValueError, match="same_step"):
        Sb3VecEnv(PassiveVectorEnv(num_envs=2, autoreset_mode=mode))


@pytest.mark.parametrize("bootstrap", [False, True])
def test_episode_ends_reach_stable_baselines(bootstrap):
    """Against single environments: return, length, last observation, final error, then the next episode's start."""
    env = make_env(bootstrap=bootstrap)
    env.seed(30)
    singles = [PassiveEnv(steps=4) for _ in range(3)]
    starts = np.array([single.reset(seed=30 + i)[0] for i, single in enumerate(singles)])
    assert np.array_equal(env.reset(), starts)
    rng = np.random.default_rng(0)
    for _ in range(2):
        returns = np.zeros(3)
        for k in range(4):
            actions = rng.uniform(-1.0, 1.0, (3, 2)).astype(np.float32)
            observation, reward, done, infos = env.step(actions)
            steps = [single.step(action) for single, action in zip(singles, actions, strict=True)]
            np.testing.assert_allclose(reward, [step[1] for step in steps], rtol=1e-6)
            assert reward.dtype == np.float32
            returns += [step[1] for step in steps]
            assert done.tolist() == [k == 3] * 3
            if k < 3:
                assert infos == [{}, {}, {}]
                assert np.array_equal(observation, [step[0] for step in steps])
        for i, info in enumerate(infos):
            assert np.array_equal(info["terminal_observation"], steps[i][0])
            assert info["episode"]["r"] == pytest.approx(returns[i], rel=1e-6)
            assert info["episode"]["l"] == 4
            assert info["TimeLimit.truncated"] is bootstrap
            assert info["episode"]["final_range_error_m"] == pytest.approx(steps[i][4]["range_error_m"].mean())
        assert np.array_equal(observation, [single.reset()[0] for single in singles])


def test_reset_begins_new_episodes_and_counts_from_zero():
    env = make_env()
    env.seed(1)
    first = env.reset()
    env.step(np.zeros((3, 2)))
    assert not np.array_equal(env.reset(), first)
    for _ in range(4):
        *_, infos = env.step(np.zeros((3, 2)))
    assert [info["episode"]["l"] for info in infos] == [4, 4, 4]
    env.seed(1)
    assert np.array_equal(env.reset(), first)


def test_stable_baselines_own_wrappers_work():
    env = VecNormalize(VecMonitor(make_env()))
    observation = env.reset()
    for _ in range(9):
        observation, reward, done, infos = env.step(np.zeros((3, 2), dtype=np.float32))
    assert observation.shape == (3, 66)
    assert np.isfinite(observation).all()
    assert np.isfinite(reward).all()
    assert len(done) == len(infos) == 3


def test_attributes_methods_and_pictures():
    env = make_env(num_envs=2)
    assert env.get_attr("num_envs") == [2, 2]
    assert env.get_attr("num_envs", indices=[1]) == [2]
    env.reset()
    assert len(env.env_method("belief")) == 2
    assert env.env_is_wrapped(VecMonitor) == [False, False]
    assert list(env.get_images()) == [None, None]
    pictured = Sb3VecEnv(PassiveVectorEnv(num_envs=2, autoreset_mode="same_step", steps=2, render_mode="rgb_array"))
    pictured.reset()
    pictures = pictured.get_images()
    assert len(pictures) == 2
    assert pictures[0].shape == pictures[1].shape
    assert not np.array_equal(*pictures)
    env.close()
