"""Engines of evaluation and training: what holds without Ray, and what is refused before it is started."""

import os
import socket
import sys
import threading
import time

import cloudpickle
import numpy as np
import pytest
import torch
from records import same_record

from agents import evaluation
from agents.cli import main
from agents.distributed import engine_named
from agents.distributed.cluster import check_address, ray_module
from agents.distributed.processes import process_engine
from agents.evaluation import Flight, blocks_of, fly, fly_all, fly_block, here, joined
from agents.policy import make_policy, policy_names
from agents.pretrained import load_pretrained
from agents.training import plan
from passive_env.catalogue import make_scenario
from trackers.compiled import Blocks, single_thread

SHORT = {"steps": 4}


# --------------------------------------------------------------------------------------------------- blocks, engines


def test_blocks_cover_every_episode_once():
    for episodes in (1, 5, 6, 7, 18):
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(evaluation, "BLOCK", 6)
            seeds = [seed + i for seed, count in blocks_of(episodes, 40) for i in range(count)]
        assert seeds == list(range(40, 40 + episodes))


def test_a_record_is_that_of_its_blocks_whatever_their_number(monkeypatch):
    scenario = make_scenario("TwoStation", SHORT)
    whole = fly(scenario, make_policy("random", scenario), 13, 7)
    monkeypatch.setattr(evaluation, "BLOCK", 5)
    blocks = [fly_block(scenario, make_policy("random", scenario), n, seed) for seed, n in blocks_of(13, 7)]
    assert len(blocks) == 3
    assert same_record(joined(blocks, scenario), whole)
    assert not same_record(joined(blocks[::-1], scenario), whole)


def test_records_keep_their_names_in_whatever_order_an_engine_finishes():
    scenario = make_scenario("TwoStation", SHORT)
    policies = {name: make_policy(name, scenario) for name in ("paper", "straight", "random")}

    def backwards(flights: dict[str, Flight], bar):
        yield from reversed(list(here(flights, bar)))

    records = fly_all(scenario, policies, 3, 1, progress=False, engine=backwards)
    expected = fly_all(scenario, policies, 3, 1, progress=False)
    assert list(records) == list(expected) == list(policies)
    assert all(same_record(records[name], expected[name]) for name in policies)
    assert not same_record(records["paper"], expected["random"])


def test_blocks_of_a_single_thread_run_on_it():
    blocks = Blocks(512, block=64, threads=2)
    with single_thread():
        inside = set(blocks.map(lambda _: threading.get_ident(), blocks.slices))
    after = set(blocks.map(lambda _: threading.get_ident(), blocks.slices))
    assert inside == {threading.get_ident()}
    assert len(after) == 2


# -------------------------------------------------------------------------------------------------------- processes


class Dying:
    """Ends the process that asks it."""

    def reset(self, belief):
        os._exit(1)

    def act(self, belief, observation):
        raise AssertionError("nobody lives to ask")


class Broken(Dying):
    """Fails as policies do."""

    def reset(self, belief):
        raise ValueError("no such maneuver")


class Telling:
    """Flies straight on and says which process, with how many threads, it flew in: by the file names in a folder."""

    def __init__(self, folder):
        self.folder = folder

    def reset(self, belief):
        blocks = Blocks(512, block=64, threads=2)
        threads = set(blocks.map(lambda _: threading.get_ident(), blocks.slices))
        (self.folder / f"{os.getpid()}-{len(threads)}-{torch.get_num_threads()}").touch()
        time.sleep(0.2)  # or one process could be through before the other has begun

    def act(self, belief, observation):
        return np.zeros((len(belief.steps_left), belief.platforms.shape[1]))


def in_processes(scenario, policies, episodes, seed):
    with process_engine(2) as engine:
        return fly_all(scenario, policies, episodes, seed, progress=False, engine=engine)


def test_records_of_processes_equal_those_of_this_one_bit_for_bit(tmp_path, monkeypatch):
    monkeypatch.setattr(evaluation, "BLOCK", 4)
    scenario = make_scenario("TwoStation", SHORT)
    policies = {name: make_policy(name, scenario) for name in ("paper", "random", "rule_tuned")}
    policies["pretrained"] = load_pretrained("TwoStation", scenario)
    policies["telling"] = Telling(tmp_path)
    records = in_processes(scenario, policies, 18, 3)
    for name in ("paper", "random", "rule_tuned", "pretrained"):
        assert same_record(records[name], fly(scenario, policies[name], 18, 3))
    assert not same_record(records["paper"], records["random"])
    seen = [tuple(map(int, path.name.split("-"))) for path in tmp_path.iterdir()]
    assert len(seen) == 2
    assert all(process != os.getpid() and (threads, torchs) == (1, 1) for process, threads, torchs in seen)


@pytest.mark.parametrize("name", ["MobilePlacement", "RadarPlacement", "PassiveRadar", "AngleFusion"])
def test_every_policy_of_a_family_can_be_sent(name):
    scenario = make_scenario(name, {})
    for policy in policy_names(scenario):
        assert cloudpickle.loads(cloudpickle.dumps((scenario, make_policy(policy, scenario))))


def test_a_process_that_dies_is_reported_with_what_to_do():
    with pytest.raises(OSError, match=r"dying: a process died before episodes 11 to 18 were flown; .* --engine local"):
        in_processes(make_scenario("TwoStation", SHORT), {"dying": Dying()}, 8, 11)


def test_an_error_in_a_process_arrives_as_it_is():
    with pytest.raises(ValueError, match=r"^no such maneuver$"):
        in_processes(make_scenario("TwoStation", SHORT), {"broken": Broken()}, 8, 1)


# ------------------------------------------------------------------------------------------------------- bad input


@pytest.mark.parametrize(
    "arguments",
    [
        ["evaluate", "passive/TwoStation-v0", "--engine", "ray"],
        ["leaderboard", "--envs", "passive/TwoStation-v0", "--policies", "paper", "--engine", "ray"],
        ["train", "--engine", "rllib", "--timesteps", "45", "--envs", "2"],
    ],
)
def test_without_ray_the_message_names_the_command_that_installs_it(arguments, tmp_path, monkeypatch, capsys):
    for name in [*(name for name in sys.modules if name.startswith(("ray.", "agents.distributed.training"))), "ray"]:
        monkeypatch.delitem(sys.modules, name, raising=False)
    monkeypatch.setitem(sys.modules, "ray", None)
    assert main([*arguments, "--out", str(tmp_path / "out")]) == 2
    assert 'python -m pip install "passive-env[ray]"' in capsys.readouterr().err
    assert not (tmp_path / "out" / "config.json").exists()
    with pytest.raises(ImportError, match="passive-env"):
        ray_module()


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["evaluate", "--workers", "2"], "--workers 2: is for --engine processes and ray only"),
        (["evaluate", "--engine", "processes", "--address", "auto"], "--address auto: is for --engine ray only"),
        (["evaluate", "--engine", "processes", "--workers", "0"], "--workers 0: must be at least 1"),
        (["leaderboard", "--address", "auto"], "--address auto: is for --engine ray only"),
        (["evaluate", "--engine", "ray", "--workers", "0"], "--workers 0: must be at least 1"),
        (["train", "--runners", "2"], "--runners 2: is for --engine rllib only"),
        (["train", "--address", "auto"], "--address auto: is for --engine rllib only"),
        (["train", "--engine", "rllib", "--runners", "0"], "--runners 0: must be at least 1"),
        (["train", "--engine", "rllib", "--envs", "9"], "--envs 9: must be a multiple of --runners 2"),
        (["train", "--engine", "rllib", "--algo", "sac"], "--algo sac is none that --engine rllib trains"),
        (["train", "--engine", "rllib", "--algo", "recurrent_ppo"], "take ppo, ppo_long or ppo_scratch"),
        (["train", "--engine", "rllib", "--device", "auto"], "--device auto: --engine rllib learns on the cpu"),
    ],
)
def test_bad_flags_are_named(arguments, words, tmp_path, capsys):
    ray_before = "ray" in sys.modules
    assert main([*arguments, "--out", str(tmp_path / "out")]) == 2
    assert words in capsys.readouterr().err
    assert not (tmp_path / "out").exists() or not any((tmp_path / "out").iterdir())
    assert ray_before or "ray" not in sys.modules


@pytest.mark.parametrize("address", ["", "here", "10.0.0.1", "host:", ":6379", "host:port", "host:0", "host:70000"])
def test_a_malformed_address_is_refused(address):
    with pytest.raises(ValueError, match="must be HOST:PORT"):
        check_address(address)


def test_an_address_without_an_answer_is_refused():
    with socket.socket() as taken:  # bound, but nobody listens
        taken.bind(("127.0.0.1", 0))
        port = taken.getsockname()[1]
        with pytest.raises(ConnectionError, match=f"--address 127.0.0.1:{port}: nothing answers there .*'ray start"):
            check_address(f"127.0.0.1:{port}")
        taken.listen()
        check_address(f"127.0.0.1:{port}")


def test_a_run_says_what_trains_it(tmp_path):
    configurations = [plan("TwoStation", tmp_path, envs=8, runners=n).to_dict() for n in (0, 4)]
    assert [(each["engine"], each["runners"]) for each in configurations] == [("sb3", 0), ("rllib", 4)]


def test_the_local_engine_takes_no_workers():
    with engine_named("local") as engine:
        assert engine is here
    with pytest.raises(ValueError, match="--workers 3"):
        engine_named("local", workers=3)
