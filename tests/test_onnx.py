"""Policies as ONNX files: they act as the models they were made from, and bad files are refused."""

from __future__ import annotations

import copy
import json
import os
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from gymnasium import spaces
from test_packed import KINDS, LAYERS, described, observations

from agents.cli import main
from agents.export import export
from agents.leaderboard.contestants import learned_policies
from agents.learned import OnnxPolicy, as_trained, load_model, observation_digest, open_policy
from agents.onnx_file import CHECKSUM, DESCRIPTION, UNKNOWN, OnnxActor, onnx_bytes, read_onnx
from agents.pack import Both
from agents.packed import MOST_BYTES, read_packed
from agents.pretrained import packed_file
from agents.training import plan, train
from passive_env.catalogue import make_scenario
from passive_env.extras import MissingExtra, needs
from passive_env.observations import LIMIT

onnx: Any = pytest.importorskip("onnx")
pytest.importorskip("onnxruntime")

ID = "passive/Ownship-v0"


def in_double(model: Any, x: np.ndarray) -> np.ndarray:
    """The model's own modules in double precision: outputs before they become actions."""
    policy = copy.deepcopy(model.policy).double()
    with torch.no_grad():
        values = torch.from_numpy(x.astype(np.float64))
        if hasattr(policy, "actor"):
            return policy.actor.mu(policy.actor.latent_pi(values)).numpy()
        return policy.action_net(policy.mlp_extractor.forward_actor(values)).numpy()


def actions_of(output: np.ndarray, space: Any, squash: bool) -> np.ndarray:
    if isinstance(space, spaces.Box):
        return np.tanh(output) if squash else np.clip(output, -1.0, 1.0)
    return np.stack([scores.argmax(1) for scores in np.split(output, np.cumsum(space.nvec)[:-1], axis=1)], axis=1)


@pytest.mark.parametrize("kind", KINDS)
def test_actions_are_those_of_the_model(kind, tmp_path):
    """10,000 observations: in double precision to 1e-6, and what Stable-Baselines3 rounds to single to 5e-6."""
    model, simulation, description, arrays = described(kind, tmp_path)
    actor = OnnxActor("policy", onnx_bytes(description, arrays, simulation))
    actor.check(simulation)
    x = observations(model.observation_space, 10_000)
    promised = getattr(simulation.observation, "promised", 0)
    if promised:
        x[:, -promised:] = np.abs(x[:, -promised:]) / model.policy.sharpness
    actions, (predicted, _) = actor(x), model.predict(x, deterministic=True)
    exact = actions_of(in_double(model, x), model.action_space, kind.endswith("squashed"))
    assert (actions.shape, actions.dtype) == (predicted.shape, predicted.dtype)
    if actions.dtype == np.float32:
        np.testing.assert_allclose(actions, exact, rtol=0.0, atol=1e-6)
        np.testing.assert_allclose(actions, predicted, rtol=0.0, atol=5e-6)
        assert exact.std() > 0.05
    else:
        np.testing.assert_array_equal(actions, exact)
        assert (actions == predicted).all(axis=1).mean() > 0.999
        assert all(len(np.unique(column)) > 1 for column in exact.T)


def test_what_is_no_observation_is_limited_inside_the_graph(tmp_path):
    _, simulation, description, arrays = described(LAYERS, tmp_path)
    actor = OnnxActor("policy", onnx_bytes(description, arrays, simulation))
    x = observations(simulation.observation.space, 6)
    wild, limited = x.copy(), x.copy()
    for row, (value, read_as) in enumerate(
        [(np.nan, 0.0), (np.inf, LIMIT), (-np.inf, -LIMIT), (1e30, LIMIT), (-7.0, -LIMIT)]
    ):
        wild[row, 3], limited[row, 3] = value, read_as
    np.testing.assert_array_equal(actor(wild), actor(limited))
    assert (actor(wild)[:5] != actor(x)[:5]).any()


def test_a_batch_is_its_rows_whatever_its_size(tmp_path):
    _, simulation, description, arrays = described("shared, with courses", tmp_path)
    actor = OnnxActor("policy", onnx_bytes(description, arrays, simulation))
    x = observations(simulation.observation.space, 1030)  # more than a block
    whole = actor(x)
    assert whole.shape == (1030, 2)
    np.testing.assert_array_equal(whole[1020:], np.concatenate([actor(row[None]) for row in x[1020:]]))
    assert actor(x[:0]).shape == (0, 2)


def test_equal_policies_are_equal_files(tmp_path):
    _, simulation, description, arrays = described(LAYERS, tmp_path)
    assert onnx_bytes(description, arrays, simulation) == onnx_bytes(description, arrays, simulation)


# ----------------------------------------------------------------------------------------------- exported from what is


@pytest.fixture(scope="module")
def file(tmp_path_factory):
    """The pretrained policy of the environment, exported by the command."""
    file = tmp_path_factory.mktemp("onnx") / "policy.onnx"
    assert main(["export", ID, "--onnx", str(file)]) == 0
    return file


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """A finished tiny run."""
    run = plan("Ownship", tmp_path_factory.mktemp("run") / "run", "ppo_scratch", envs=4, timesteps=240)
    train(run, progress=False)
    return run


def test_a_run_is_exported_and_flies_as_its_model(run, tmp_path):
    file = tmp_path / "policy.onnx"
    assert main(["export", str(run.folder), "--onnx", str(file)]) == 0
    simulation = run.scenario.make_simulation()
    policy = open_policy(file, ID, simulation)
    assert isinstance(policy, OnnxPolicy)
    x = observations(simulation.observation.space, 10_000)
    model = load_model(run.folder / "model.zip", "ppo_scratch")
    predicted, _ = model.predict(x, deterministic=True)
    np.testing.assert_allclose(policy.act(None, x), predicted, rtol=0.0, atol=1e-6)  # type: ignore[arg-type]
    config = json.loads((run.folder / "config.json").read_text())
    assert {name: policy.description[name] for name in config} == config


def test_the_pretrained_policy_exported_is_the_packed_one(file):
    packed = read_packed(packed_file(ID))
    simulation = make_scenario(ID, {}).make_simulation()
    policies = [open_policy(path, ID, simulation) for path in (packed_file(ID), file)]
    x = observations(simulation.observation.space, 10_000)
    actions = [policy.act(None, x) for policy in policies]  # type: ignore[arg-type]
    np.testing.assert_allclose(*actions, rtol=0.0, atol=2e-6)
    assert actions[0].std() > 0.1
    description = read_onnx(file).description
    assert {name: description[name] for name in packed.description} == packed.description


def test_evaluate_takes_the_file(file, tmp_path):
    words = ["evaluate", ID, "--episodes", "8", "--out", str(tmp_path), "--policies", "pretrained", str(file)]
    assert main(words) == 0
    policies = json.loads((tmp_path / "evaluation.json").read_text())["policies"]
    ours, theirs = (policies[name]["final_range_error_m"]["mean"] for name in ("pretrained", "learned"))
    assert theirs == pytest.approx(ours, rel=1e-3)
    (_, contestant) = learned_policies(ID, [file])
    assert contestant.name == "learned"


def test_other_programs_read_what_the_file_is_for(file):
    """With nothing but onnx: the environment, every field's unit and scale, the space of actions."""
    model = onnx.load(file)
    metadata = {entry.key: entry.value for entry in model.metadata_props}
    description = json.loads(metadata[DESCRIPTION])
    simulation = as_trained(description, ID, make_scenario(ID, {}).make_simulation())
    assert description["environment"] == ID
    assert description["observation_digest"] == observation_digest(simulation)
    fields = [(f["name"], f["unit"], f["scale"]) for f in description["observation"]]
    assert fields == [f[:3] for f in simulation.observation.fields]
    assert description["action"]["space"] == str(simulation.actions.space)
    assert description["interface"] == simulation.scenario.interface()
    assert len(metadata[CHECKSUM]) == len(UNKNOWN)
    assert [opset.domain for opset in model.opset_import] == [""]  # standard operators only


def test_a_single_decision_takes_less_than_50_us(file):
    """The least of many: what else the machine does is not measured."""
    actor = read_onnx(file)
    x = np.zeros((1, 18), dtype=np.float32)
    seconds = []
    for _ in range(2000):
        start = time.perf_counter()
        actor(x)
        seconds.append(time.perf_counter() - start)
    assert min(seconds) < 50e-6


# --------------------------------------------------------------------------------------------------------- bad input


def altered(file: Path, tmp_path: Path, change: Any, **changes: Any) -> Path:
    """The file with another graph or description and a checksum that fits."""
    import hashlib

    model = onnx.load(file)
    metadata = {entry.key: entry.value for entry in model.metadata_props}
    metadata |= {DESCRIPTION: json.dumps(json.loads(metadata[DESCRIPTION]) | changes), CHECKSUM: UNKNOWN}
    change(model)
    del model.metadata_props[:]
    onnx.helper.set_model_props(model, metadata)
    content = model.SerializeToString(deterministic=True)
    out = tmp_path / "altered.onnx"
    out.write_bytes(content.replace(UNKNOWN.encode(), hashlib.sha256(content).hexdigest().encode()))
    return out


def nothing(model: Any) -> None:
    """Leave the graph as it is."""


def test_a_file_of_another_environment_is_refused(file, capsys):
    words = ["evaluate", "passive/TwoStation-v0", "--policies", str(file), "--episodes", "1"]
    assert main(words) == 2
    assert "its model was made for passive/Ownship-v0, not for passive/TwoStation-v0" in capsys.readouterr().err
    with pytest.raises(ValueError, match="made for other observations or actions of passive/Ownship-v0"):
        OnnxPolicy(file, ID, make_scenario("Ownship", {"targets": 2}).make_simulation())


@pytest.mark.parametrize(
    ("changes", "words"),
    {
        "digest": ({"observation_digest": "0" * 16}, "made for other observations or actions"),
        "interface": ({"interface": {"actions": "headings"}}, "Ownship.actions = 'headings': must be one of"),
        "format": (
            {"format": "something"},
            "must say format = 'passive-env policy'; make one with 'passive-env export",
        ),
        "version": ({"format_version": 9}, "format_version = 9, this version of the package reads 1"),
        "no fields": ({"fields": None}, "has fields = None, must be a dict"),
    }.values(),
)
def test_another_description_is_refused(file, tmp_path, changes, words):
    with pytest.raises(ValueError, match=words):
        OnnxPolicy(altered(file, tmp_path, nothing, **changes), ID, make_scenario(ID, {}).make_simulation())


def wider(model: Any) -> None:
    model.graph.input[0].type.tensor_type.shape.dim[1].dim_value = 19


def renamed(model: Any) -> None:
    model.graph.output[0].name = "u"
    model.graph.node[-1].output[0] = "u"


def beyond(model: Any) -> None:
    """Let the graph's last cut be missing and its last bias be large: actions beyond the Box."""
    named = {tensor.name: tensor for tensor in model.graph.initializer}
    for node in model.graph.node:
        if node.op_type in ("Min", "Max"):
            far = onnx.numpy_helper.from_array(np.array([9.0]), node.input[1])
            named[node.input[1]].CopyFrom(far)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (wider, r"altered\.onnx: (its graph has the ends|damaged or no ONNX file)"),
        (renamed, r"its graph has the ends .*must have \[\('observation', 'tensor\(float\)', 18\), \('action'"),
        (beyond, r"its actions \[\[9\.0\], \[9\.0\]\] do not lie in Box"),
    ],
)
def test_another_graph_is_refused(file, tmp_path, change, words):
    with pytest.raises(ValueError, match=words):
        OnnxPolicy(altered(file, tmp_path, change), ID, make_scenario(ID, {}).make_simulation())


@pytest.mark.parametrize("content", [b"", b"\x08\x09", b"PK\x03\x04", b"no protocol buffer", os.urandom(300)])
def test_what_is_no_onnx_file_is_refused(tmp_path, content, capsys):
    (tmp_path / "bad.onnx").write_bytes(content)
    with pytest.raises(ValueError, match=r"bad\.onnx: damaged or no ONNX file \(.*'passive-env export RUN --onnx"):
        read_onnx(tmp_path / "bad.onnx")
    assert main(["evaluate", ID, "--policies", str(tmp_path / "bad.onnx"), "--episodes", "1"]) == 2
    assert "damaged or no ONNX file" in capsys.readouterr().err


@pytest.mark.parametrize("share", [0.1, 0.5, 0.9, 0.999])
def test_a_truncated_or_altered_file_is_refused(file, tmp_path, share):
    good = file.read_bytes()
    at = int(share * len(good))
    (tmp_path / "short.onnx").write_bytes(good[:at])
    flipped = bytearray(good)
    flipped[at] ^= 0x10
    (tmp_path / "flipped.onnx").write_bytes(bytes(flipped))
    for name in ("short.onnx", "flipped.onnx"):
        with pytest.raises(ValueError, match=rf"{name}: (damaged|no policy of this package)"):
            read_onnx(tmp_path / name)


def test_a_graph_of_somebody_else_is_refused(tmp_path):
    _, simulation, description, arrays = described(LAYERS, tmp_path)
    model = onnx.load_from_string(onnx_bytes(description, arrays, simulation))
    del model.metadata_props[:]
    onnx.save(model, tmp_path / "other.onnx")
    with pytest.raises(ValueError, match="no policy of this package, its metadata have no 'passive_env'"):
        read_onnx(tmp_path / "other.onnx")


def test_missing_and_huge_files_are_named(tmp_path):
    for path in (tmp_path / "none.onnx", tmp_path):
        with pytest.raises(FileNotFoundError, match="no such ONNX file; make one with"):
            read_onnx(path)
    with open(tmp_path / "large.onnx", "wb") as large:
        large.truncate(MOST_BYTES + 1)
    with pytest.raises(ValueError, match=f"has {MOST_BYTES + 1} bytes, a policy has at most {MOST_BYTES}"):
        read_onnx(tmp_path / "large.onnx")


def test_what_cannot_be_exported_says_why(tmp_path, capsys):
    for words, told in (
        ([ID, "--onnx", str(tmp_path / "policy.pb")], "must be the name of a file that ends in .onnx"),
        ([str(tmp_path), "--onnx", str(tmp_path / "p.onnx")], "no config.json in it"),
        ([str(tmp_path / "none.npz"), "--onnx", str(tmp_path / "p.onnx")], "no such packed policy"),
    ):
        assert main(["export", *words]) == 2
        assert told in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


def test_a_recurrent_policy_is_not_exported(tmp_path):
    run = plan("Ownship", tmp_path / "run", "recurrent_ppo", envs=2, timesteps=1)
    run.preset.pop("imitation", None)
    train(run, progress=False)
    with pytest.raises(ValueError, match="a model of recurrent_ppo with this network cannot be packed or exported"):
        export(run.folder, tmp_path / "p.onnx")
    assert not (tmp_path / "p.onnx").exists()


def test_a_difference_from_the_policy_is_not_written(run, tmp_path, monkeypatch):
    monkeypatch.setattr(OnnxActor, "__call__", shifted(OnnxActor.__call__))
    with pytest.raises(ValueError, match=r"p\.onnx: not written, 100\.00% of its commands differ .* up to 0\.01"):
        export(run.folder, tmp_path / "p.onnx")
    assert not (tmp_path / "p.onnx").exists()


def shifted(act: Any) -> Any:
    return lambda self, x: np.where(act(self, x) > 0.0, act(self, x) - 0.01, act(self, x) + 0.01).astype(np.float32)


@pytest.mark.parametrize("module", ["onnx", "onnxruntime"])
def test_a_missing_extra_names_the_command(file, tmp_path, monkeypatch, capsys, module):
    monkeypatch.setitem(sys.modules, module, None)
    command = 'python -m pip install "passive-env[onnx]"'
    assert main(["export", ID, "--onnx", str(tmp_path / "p.onnx")]) == 2
    assert f"{module} is not installed: {command}" in capsys.readouterr().err
    if module == "onnxruntime":
        assert main(["evaluate", ID, "--policies", str(file), "--episodes", "1"]) == 2
        assert command in capsys.readouterr().err
    with pytest.raises(MissingExtra, match="not installed"):
        needs(module, "onnx")


def test_the_comparison_counts_what_differs():
    same = type("Same", (), {"act": lambda *_: np.array([[0.1], [0.2]])})()
    other = type("Other", (), {"act": lambda *_: np.array([[0.1], [np.nan]])})()
    both = Both(same, other)
    both.act(None, np.zeros((2, 1)))
    assert both.different_share == 0.5
