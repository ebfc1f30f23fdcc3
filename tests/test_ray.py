"""On Ray: a local cluster of two processes flies what this process flies; what RLlib trains can be flown without it.

The cluster's workers find this module, whose policies they fly, on the path that they are started with.
"""

import copy
import json
import os
import re
import shutil
import signal
import socket
import subprocess
import sys
import textwrap
from pathlib import Path

import numpy as np
import pytest
import torch

pytest.importorskip("ray", reason="the extra 'ray' is not installed")

from records import same_record
from training_runs import logged

import agents.training
from agents import evaluation
from agents.cli import main
from agents.distributed import flying
from agents.distributed import training as distributed_training
from agents.distributed.cluster import cluster
from agents.distributed.env_runner import PassiveEnvRunner
from agents.distributed.flying import ray_engine
from agents.distributed.module import module_spec, take_weights
from agents.distributed.training import CHECKPOINT, configuration, last_checkpoint, train_on_ray
from agents.evaluation import fly, fly_all
from agents.learned import LearnedPolicy, load_model
from agents.policy import make_policy
from agents.presets import load_preset
from agents.pretrained import load_pretrained
from agents.training import Run, new_model, training_env, training_seed
from passive_env import PassiveVectorEnv
from passive_env.catalogue import SCENARIOS, make_scenario

ID = "passive/TwoStation-v0"
ENVS, STEPS = 4, 6
ROLLOUT = ENVS * STEPS


@pytest.fixture(scope="module")
def address():
    """A cluster of two nodes on this machine, one process at a time on each."""
    from ray.cluster_utils import Cluster

    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("PYTHONPATH", os.pathsep.join(path for path in sys.path if path))
        nodes = Cluster(initialize_head=True, head_node_args={"num_cpus": 1, "include_dashboard": False})
        nodes.add_node(num_cpus=1)
    yield nodes.address
    nodes.shutdown()


@pytest.fixture(autouse=True)
def small(monkeypatch):
    """Blocks and evaluations of few episodes."""
    monkeypatch.setattr(evaluation, "BLOCK", 8)
    monkeypatch.setattr(agents.training, "EVALUATION_EPISODES", 8)


class Straight:
    """Flies straight on, and leaves the number of every process in which it began."""

    def __init__(self, folder: Path):
        self._folder = folder

    def reset(self, belief):
        (self._folder / f"process-{os.getpid()}").touch()

    def act(self, belief, observation):
        return np.zeros_like(belief.last_action)


class Deadly(Straight):
    """Kills the process in which it flies a block, at its third step, as often as it is told to."""

    def __init__(self, folder: Path, times: int):
        super().__init__(folder)
        self._times, self._step = times, 0

    def act(self, belief, observation):
        self._step += 1
        deaths = len(list(self._folder.glob("death-*")))
        if self._step == 3 and deaths < self._times:
            (self._folder / f"death-{os.getpid()}").touch()
            os.kill(os.getpid(), signal.SIGKILL)
        return super().act(belief, observation)


class Broken(Straight):
    """Decides something that nobody can fly."""

    def act(self, belief, observation):
        raise ValueError("no such maneuver")


class Bar:
    """Counts what a tqdm bar is told."""

    def __init__(self):
        self.episodes = 0

    def update(self, episodes):
        self.episodes += episodes

    def set_description(self, title):
        assert title


def flown_on_ray(scenario, policies, episodes, seed, address, workers=2):
    with ray_engine(workers, address) as engine:
        return fly_all(scenario, policies, episodes, seed, progress=False, engine=engine)


# ------------------------------------------------------------------------------------------------------- evaluation


def test_records_on_a_cluster_equal_those_of_this_process_bit_for_bit(address):
    scenario = make_scenario("TwoStation", {"steps": STEPS})
    policies = {name: make_policy(name, scenario) for name in ("paper", "random", "greedy")}
    policies["pretrained"] = load_pretrained("TwoStation", scenario)
    records = flown_on_ray(scenario, policies, 21, 3, address)
    expected = fly_all(scenario, policies, 21, 3, progress=False)
    assert all(same_record(records[name], expected[name]) for name in policies)
    assert not same_record(records["paper"], expected["random"])
    assert all(len(record.final) == 21 and record.decision_time_us > 0.0 for record in records.values())


@pytest.mark.parametrize("name", ["AngleFusion", "RadarPlacement", "PassiveRadar"])
def test_every_kind_of_world_comes_back_whole(name, address):
    scenario = make_scenario(name, {})
    policies = {"random": make_policy("random", scenario)}
    records = flown_on_ray(scenario, policies, 10, 5, address)
    assert same_record(records["random"], fly(scenario, policies["random"], 10, 5))


def test_both_processes_fly(tmp_path, address):
    scenario = make_scenario("TwoStation", {"steps": STEPS})
    flown_on_ray(scenario, {"straight": Straight(tmp_path)}, 64, 1, address)
    processes = {path.name for path in tmp_path.iterdir()}
    assert len(processes) >= 2
    assert f"process-{os.getpid()}" not in processes


def test_the_block_of_a_killed_worker_is_flown_again_and_counted_once(tmp_path, address):
    scenario = make_scenario("TwoStation", {"steps": STEPS})
    bar = Bar()
    with ray_engine(2, address) as engine:
        flight = evaluation.Flight("deadly", scenario, lambda: Deadly(tmp_path, 2), 30, 9)
        records = dict(engine({"deadly": flight}, bar))
    assert len(list(tmp_path.glob("death-*"))) == 2
    assert bar.episodes == 30
    assert same_record(records["deadly"], fly(scenario, make_policy("straight", scenario), 30, 9))


def test_workers_that_always_die_are_reported_with_their_episodes(tmp_path, address, monkeypatch):
    monkeypatch.setattr(flying, "TRIES", 2)
    scenario = make_scenario("TwoStation", {"steps": STEPS})
    with pytest.raises(OSError, match=r"deadly: the workers that flew episodes 11 to 18 died 2 times"):
        flown_on_ray(scenario, {"deadly": Deadly(tmp_path, 99)}, 8, 11, address)
    assert len(list(tmp_path.glob("death-*"))) == 2


def test_an_error_in_a_worker_arrives_as_it_is(tmp_path, address):
    scenario = make_scenario("TwoStation", {"steps": STEPS})
    with pytest.raises(ValueError, match=r"^no such maneuver$"):
        flown_on_ray(scenario, {"broken": Broken(tmp_path)}, 8, 1, address)


def test_the_commands_write_the_same_tables_on_ray(tmp_path, address, capsys):
    arguments = ["evaluate", ID, "--policies", "paper", "rule", "--episodes", "12", "--fields", f"steps={STEPS}"]
    assert main([*arguments, "--out", str(tmp_path / "here")]) == 0
    on_ray = ["--engine", "ray", "--workers", "2", "--address", address]
    assert main([*arguments, *on_ray, "--out", str(tmp_path / "ray")]) == 0
    assert timeless(tmp_path / "here" / "evaluation.json") == timeless(tmp_path / "ray" / "evaluation.json")
    arguments = ["leaderboard", "--envs", ID, "--policies", "paper", "rule", "--episodes", "12", "--no-flights"]
    arguments += ["--fields", f"steps={STEPS}"]
    assert main([*arguments, "--out", str(tmp_path / "board")]) == 0
    assert main([*arguments, *on_ray, "--out", str(tmp_path / "board-ray")]) == 0
    sections = [timeless(tmp_path / name / "leaderboard.json")["sections"] for name in ("board", "board-ray")]
    assert sections[0] == sections[1]
    assert "paper" in json.dumps(sections[0])


def timeless(file: Path):
    """A file's data without what a clock has measured."""

    def without(data):
        if isinstance(data, dict):
            return {name: without(value) for name, value in data.items() if name != "decision_time_us"}
        return [without(value) for value in data] if isinstance(data, list) else data

    return without(json.loads(file.read_text(encoding="utf-8")))


def test_a_cluster_of_ones_own_is_stopped():
    """In a process of its own: Ray loses actors in a process that has started one cluster and then joins another."""
    code = (
        "from agents.distributed.cluster import cluster\n"
        "with cluster(None, 1) as ray:\n"
        "    assert ray.cluster_resources()['CPU'] == 1\n"
        "    print(ray.get_runtime_context().gcs_address)\n"
        "assert not ray.is_initialized()\n"
        "import time; print('stopped', flush=True); time.sleep(60)\n"
    )
    with subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        lines = [process.stdout.readline().strip() for _ in range(2)]
        try:
            assert lines[1] == "stopped"
            with pytest.raises(OSError, match="refused"):
                socket.create_connection(address_of(lines[0]), timeout=5)
        finally:
            process.kill()


def test_a_cluster_that_ran_before_is_left_running(address):
    with cluster(address, 5) as ray:
        assert ray.cluster_resources()["CPU"] == 2
    assert not ray.is_initialized()
    socket.create_connection(address_of(address), timeout=5).close()


def address_of(text: str) -> tuple[str, int]:
    host, port = text.split(":")
    return host, int(port)


def test_a_cluster_that_does_not_answer_is_named(tmp_path, capsys):
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        nowhere = f"127.0.0.1:{taken.getsockname()[1]}"
        for command in (["evaluate", "--engine", "ray"], ["train", "--engine", "rllib"]):
            assert main([*command, "--address", nowhere, "--out", str(tmp_path / "out")]) == 2
            message = capsys.readouterr().err
            assert f"--address {nowhere}: nothing answers there" in message
            assert "ray start --head" in message


# --------------------------------------------------------------------------------------------------------- the runner


def tiny_run(folder: Path, rollouts: int = 3, scenario_name: str = "TwoStation", algo: str = "ppo", **changes) -> Run:
    """A run of a few rollouts of four short episodes, with a checkpoint after each."""
    preset = copy.deepcopy(load_preset(scenario_name, algo))
    preset |= {"checkpoint_rollouts": 1}
    preset["arguments"] |= {"n_epochs": 2, "batch_size": 4}
    preset.pop("imitation", None)
    fields = {"steps": STEPS} if scenario_name == "TwoStation" else {}
    values = {"scenario_name": scenario_name, "fields": fields, "algo": algo, "seed": 3, "device": "cpu"}
    values |= {"timesteps": rollouts * ROLLOUT, "envs": ENVS, "preset": preset, "runners": 2}
    return Run(folder, **(values | changes))


def runner(run: Run, place: int = 1) -> PassiveEnvRunner:
    model = new_model(run, training_env(run))
    return PassiveEnvRunner(config=configuration(run, model), worker_index=place, num_workers=run.runners)


def test_a_runners_episodes_are_those_of_the_environment(tmp_path):
    run = tiny_run(tmp_path, fields={"steps": STEPS, "bearing_std_deg": 0.8})
    episodes = runner(run, place=2).sample()
    width = ENVS // run.runners
    first = training_seed(run.seed) + width  # the first runner has the ones before
    assert [episode.id_ for episode in episodes] == [str(first + i) for i in range(width)]
    env = PassiveVectorEnv(run.training_scenario, num_envs=width, autoreset_mode="disabled")
    observation, _ = env.reset(seed=first)
    for k in range(STEPS):
        assert np.array_equal(observation, [episode.get_observations(k) for episode in episodes])
        drawn = np.array([episode.get_actions(k) for episode in episodes])
        observation, reward, *_ = env.step(np.clip(drawn, -1.0, 1.0))
        assert np.array_equal(reward, [episode.get_rewards(k) for episode in episodes])
    assert np.array_equal(observation, [episode.get_observations(STEPS) for episode in episodes])
    assert all(len(episode) == STEPS and episode.is_terminated for episode in episodes)


def test_the_configuration_in_the_document_flies_rllibs_own_network(tmp_path):
    document = Path(__file__).parents[1] / "docs" / "ray.md"
    (block,) = re.findall(r"```python\n(.*?)```", document.read_text(encoding="utf-8"), re.DOTALL)
    names = {}
    exec(compile(textwrap.dedent(block), str(document), "exec"), names)
    one = PassiveEnvRunner(config=names["config"], worker_index=1)
    assert one.env.scenario.bearing_std_deg == 0.7
    episodes = one.sample()
    assert len(episodes) == 128
    assert len({float(episode.get_return()) for episode in episodes}) > 100
    assert np.isfinite([episode.get_extra_model_outputs("action_logp") for episode in episodes]).all()


def test_no_two_samples_share_an_episode(tmp_path):
    run = tiny_run(tmp_path)
    seeds = []
    for place in (1, 2):
        one = runner(run, place)
        for steps in (0, ROLLOUT, ROLLOUT, 2 * ROLLOUT):  # the second time at the same step: others' samples were lost
            one.set_state({"num_env_steps_sampled_lifetime": steps})
            seeds += [int(episode.id_) for episode in one.sample()]
    assert len(seeds) == len(set(seeds)) == 4 * ENVS


def test_rollouts_fly_drawn_or_recorded_courses_by_the_presets_share(tmp_path):
    run = tiny_run(tmp_path, scenario_name="OwnshipMulti", fields={"steps": STEPS})
    assert run.preset["flights_share"] == 0.5
    one, courses = runner(run), []
    for steps in range(0, 20 * ROLLOUT, ROLLOUT):
        one.set_state({"num_env_steps_sampled_lifetime": steps})
        one.sample()
        courses.append((one.env.scenario.course, one.env.scenario.flight_split))
    assert set(courses) == {("random", "train"), ("flights", "train")}
    chosen = tiny_run(tmp_path, scenario_name="OwnshipMulti", fields={"steps": STEPS, "course": "flights"})
    assert configuration(chosen, new_model(chosen, training_env(chosen))).env_config["flights_share"] == 0.0


def test_a_runner_flies_as_many_whole_episodes_as_it_is_asked_for(tmp_path):
    one = runner(tiny_run(tmp_path))
    width = ENVS // 2
    assert len(one.sample()) == width
    assert len(one.sample(num_episodes=width + 1)) == 2 * width
    assert len(one.sample(num_timesteps=width * STEPS)) == width
    assert len(one.sample(num_timesteps=width * STEPS + 1)) == 2 * width
    random = one.sample(random_actions=True)
    assert not np.array_equal(random[0].get_actions(0), random[1].get_actions(0))
    steady = [one.sample(explore=False)[0] for _ in range(2)]
    assert "action_logp" not in steady[0].extra_model_outputs


@pytest.mark.parametrize(
    ("name", "algo", "fields"),
    [
        ("TwoStation", "ppo", {"steps": STEPS}),
        ("TwoStation", "ppo", {"steps": STEPS, "actions": "discrete"}),
        ("TwoStation", "ppo_long", {"steps": STEPS}),
        ("Ownship", "ppo", {}),
        ("PassiveRadar", "ppo", {}),
        ("RadarPlacement", "ppo_scratch", {}),
    ],
)
def test_the_module_is_the_models_own_network(name, algo, fields, tmp_path):
    run = tiny_run(tmp_path, scenario_name=name, algo=algo, fields=fields)
    env = training_env(run)
    model = new_model(run, env)
    module = module_spec(model).build()
    batch = {"obs": torch.as_tensor(env.reset())}
    drawn = module.get_train_action_dist_cls().from_logits(module.forward_train(batch)["action_dist_inputs"])
    actions = drawn.sample()
    values, logs, entropy = model.policy.evaluate_actions(batch["obs"], actions)
    assert torch.allclose(drawn.logp(actions), logs, atol=1e-5)
    assert torch.allclose(drawn.entropy(), entropy, atol=1e-5)
    assert torch.allclose(module.compute_values(batch), values[:, 0], atol=1e-6)
    other = new_model(tiny_run(tmp_path, scenario_name=name, algo=algo, fields=fields, seed=4), env)
    assert not same_parameters(other, model)
    take_weights(other, module.get_state())
    assert same_parameters(other, model)


def same_parameters(a, b) -> bool:
    first, second = a.policy.state_dict(), b.policy.state_dict()
    assert first.keys() == second.keys()
    return all(torch.equal(first[name], second[name]) for name in first)


# ---------------------------------------------------------------------------------------------------------- training


@pytest.fixture(scope="module")
def finished(tmp_path_factory, address):
    """An uninterrupted run of three rollouts."""
    run = tiny_run(tmp_path_factory.mktemp("finished") / "run")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(agents.training, "EVALUATION_EPISODES", 8)
        train_on_ray(run, address, progress=False)
    return run


def test_a_run_leaves_what_a_run_here_leaves(finished):
    names = {path.name for path in finished.folder.iterdir()}
    assert names == {"config.json", "model.zip", "training.json", "tensorboard", f"{CHECKPOINT}{2 * ROLLOUT}"}
    config = json.loads((finished.folder / "config.json").read_text())
    assert (config["engine"], config["runners"], config["algo"]) == ("rllib", 2, "ppo")
    model = load_model(finished.folder / "model.zip", "ppo")
    assert model.num_timesteps == 3 * ROLLOUT
    assert not same_parameters(model, new_model(finished, training_env(finished)))
    assert same_parameters(load_model(last_checkpoint(finished.folder) / "model.zip", "ppo"), model) is False


def test_its_curves_have_the_names_of_a_run_here(finished):
    curves = logged(finished.folder)
    assert {
        "rollout/ep_rew_mean", "rollout/final_range_error_m", "eval/final_range_error_m", "eval/ratio_to_paper",
    } <= set(curves)  # fmt: skip
    assert [event.step for event in curves["rollout/ep_rew_mean"]] == [ROLLOUT * k for k in (1, 2, 3)]
    assert [event.step for event in curves["eval/ratio_to_paper"]] == [ROLLOUT, 2 * ROLLOUT]


def test_its_policy_flies_and_is_packed_without_ray(finished, tmp_path):
    scenario = finished.scenario
    learned = LearnedPolicy(finished.folder, ID, scenario.make_simulation())
    record = fly(scenario, learned, 5, 1)
    assert not same_record(record, fly(scenario, make_policy("straight", scenario), 5, 1))
    packed = tmp_path / "policy.npz"
    assert main(["pack", str(finished.folder), "--out", str(packed), "--episodes", "4"]) == 0
    arguments = ["evaluate", ID, "--policies", "paper", str(finished.folder), str(packed), "--episodes", "4"]
    assert main([*arguments, "--fields", f"steps={STEPS}", "--out", str(tmp_path / "e")]) == 0
    policies = json.loads((tmp_path / "e" / "evaluation.json").read_text())["policies"]
    error = "final_range_error_m"
    assert policies["learned"][error]["mean"] == pytest.approx(policies["learned_2"][error]["mean"], rel=1e-5)


def test_an_interrupted_run_resumes_to_the_same_model(finished, tmp_path, address, monkeypatch):
    run = tiny_run(tmp_path / "run")

    def interrupt(*arguments):
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(distributed_training.Clock, "save", interrupt)  # after the first checkpoint
        with pytest.raises(KeyboardInterrupt):
            train_on_ray(run, address, progress=False)
    assert last_checkpoint(run.folder).name == f"{CHECKPOINT}{ROLLOUT}"
    (run.folder / f".{CHECKPOINT}99.1.tmp").mkdir()  # what a kill in the middle of saving leaves
    train_on_ray(run, address, resume=True, progress=False)
    again, once = (load_model(folder / "model.zip", "ppo") for folder in (run.folder, finished.folder))
    assert again.num_timesteps == once.num_timesteps
    assert same_parameters(again, once)


def test_the_train_command_trains_and_compares(tmp_path, address, capsys, monkeypatch):
    monkeypatch.setattr(agents.training, "load_preset", lambda *_: tiny_run(tmp_path).preset)
    out = tmp_path / "run"
    arguments = ["train", "--engine", "rllib", "--address", address, "--envs", "4", "--timesteps", str(ROLLOUT)]
    arguments += ["--episodes", "3", "--fields", f"steps={STEPS}", "--out", str(out)]
    assert main(arguments) == 0
    assert "| learned |" in capsys.readouterr().out
    for folder in (out, out / "flights"):
        assert {"paper", "rule", "learned"} <= set(json.loads((folder / "evaluation.json").read_text())["policies"])
    assert main(arguments) == 2
    assert "already exists" in capsys.readouterr().err


def test_what_cannot_be_resumed_is_refused(finished, tmp_path, address):
    folder = tmp_path / "run"
    shutil.copytree(finished.folder, folder)
    with pytest.raises(ValueError, match="runners was 2 when it began and is 1 now"):
        train_on_ray(tiny_run(folder, runners=1), address, resume=True, progress=False)
    state = next((last_checkpoint(folder) / "rllib").glob("algorithm_state*"))
    state.write_bytes(b"no checkpoint")
    before = {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}
    with pytest.raises(ValueError, match="damaged checkpoint"):
        train_on_ray(tiny_run(folder), address, resume=True, progress=False)
    assert {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()} == before


def test_an_argument_that_rllib_does_not_know_is_named(tmp_path):
    run = tiny_run(tmp_path)
    run.preset["arguments"]["target_kl"] = 0.01
    with pytest.raises(ValueError, match=r"--engine rllib knows no target_kl: .* batch_size"):
        configuration(run, new_model(run, training_env(run)))


def test_every_scenario_with_a_preset_can_be_trained_so(tmp_path):
    """A rollout of every world by RLlib's runner, with the network of its preset."""
    for name in SCENARIOS:
        run = tiny_run(tmp_path, scenario_name=name, fields={})
        episodes = runner(run).sample()
        assert len(episodes) == ENVS // 2
        for episode in episodes:
            assert len(episode) == run.training_scenario.steps
            assert np.isfinite(episode.get_rewards()).all()
            assert np.isfinite(episode.get_observations()).all()
