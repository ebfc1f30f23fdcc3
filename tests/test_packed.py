"""Policies in a file without code: they act as the models they were packed from, and bad files are refused unread."""

from __future__ import annotations

import io
import json
import os
import struct
import tracemalloc
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from agents.actor import plain_actor
from agents.cli import main
from agents.leaderboard.contestants import KIND_OF
from agents.learned import LearnedPolicy, PackedPolicy, open_policy
from agents.networks import describe, rebuild
from agents.pack import AGAINST, Both, _strongest, measure, pack
from agents.packed import LARGEST, MOST_BYTES, MOST_MEMBERS, read_packed, write_packed
from agents.sb3 import Sb3VecEnv
from agents.training import TRAINING, flown, new_model, plan, train, training_seconds
from agents.transmitter_network import NETWORK
from passive_env import PassiveVectorEnv
from passive_env.catalogue import environment_id, make_scenario

KINDS = {
    "tanh to a Box": ("Ownship", "ppo", {}),
    "tanh to choices": ("TwoStation", "ppo", {"actions": "discrete"}),
    "relu, squashed": ("TwoStation", "sac", {}),
    "shared, combinations": ("PassiveRadar", "ppo", {}),
    "shared, scores": ("PassiveRadar", "ppo", {"actions": "continuous"}),
    "shared, with courses": ("MobileReceiver", "ppo", {}),
}
"""Network kinds: scenario, algorithm, fields given."""

LAYERS = "tanh to a Box"


def model_of(kind: str, tmp_path: Path):
    """An untrained model of a kind with weights that matter, and the parts it acts by."""
    name, algo, fields = KINDS[kind]
    run = plan(name, tmp_path, algo, envs=2, timesteps=1, fields=fields)
    run.preset.pop("imitation", None)
    env = Sb3VecEnv(PassiveVectorEnv(run.training_scenario, num_envs=2, autoreset_mode="same_step"), run.asymmetric)
    model: Any = flown(new_model(run, env))
    generator = torch.Generator().manual_seed(3)
    with torch.no_grad():
        for parameter in model.policy.parameters():
            if parameter.ndim == 2:
                parameter.normal_(std=parameter.shape[1] ** -0.5, generator=generator)
            else:
                parameter.normal_(std=0.1, generator=generator)
    return model, run.training_scenario.make_simulation()


def described(kind: str, tmp_path: Path):
    """A model, the parts it acts by, and its description and arrays as `write_packed` takes them."""
    model, simulation = model_of(kind, tmp_path)
    actor = plain_actor(model)
    assert actor is not None
    network, arrays = describe(actor)
    name, algo, _ = KINDS[kind]
    more = {"environment": environment_id(name), "interface": simulation.scenario.interface(), "algo": algo}
    return model, simulation, {**more, "observation_digest": "0" * 16, "fields": {}, "network": network}, arrays


def observations(space, e: int) -> np.ndarray:
    """Anywhere in the observation space, its corners included."""
    rng = np.random.default_rng(2)
    x = rng.uniform(space.low, space.high, (e, *space.shape))
    return np.where(rng.random(x.shape) < 0.05, np.sign(x) * space.high, x).astype(np.float32)


@pytest.mark.parametrize("kind", KINDS)
def test_packed_actions_are_those_of_the_model(kind, tmp_path):
    """10,000 observations; of choices the same ones, unless two score alike to rounding."""
    model, simulation, description, arrays = described(kind, tmp_path)
    packed = read_packed(write_packed(tmp_path / "policy.npz", description, arrays))
    actor = rebuild("policy", packed.description["network"], packed.arrays, simulation)
    x = observations(model.observation_space, 10_000)
    promised = getattr(simulation.observation, "promised", 0)
    if promised:  # logarithms of ratios to the best, of an order that leaves the network a word
        x[:, -promised:] = np.abs(x[:, -promised:]) / model.policy.sharpness
    expected, _ = model.predict(x, deterministic=True)
    actions = actor(x)
    assert actions.shape == expected.shape
    if actions.dtype == np.float32:
        np.testing.assert_allclose(actions, expected, rtol=0.0, atol=1e-6)
        assert expected.std() > 0.05
    else:
        assert (actions == expected).all(axis=1).mean() > 0.999
        with torch.no_grad():
            scores = model.policy.get_distribution(torch.from_numpy(x)).distribution
        for k, part in enumerate(scores):
            chosen, best = (part.logits[np.arange(len(x)), a[:, k]] for a in (actions, expected))
            torch.testing.assert_close(chosen, best, rtol=1e-5, atol=1e-5)
            assert len(np.unique(expected[:, k])) > 1


def test_equal_policies_are_equal_files(tmp_path):
    _, _, description, arrays = described(LAYERS, tmp_path)
    files = [write_packed(tmp_path / f"{name}.npz", description, arrays) for name in "ab"]
    assert files[0].read_bytes() == files[1].read_bytes()


def test_rebuilding_draws_no_random_numbers(tmp_path):
    for kind in (LAYERS, "shared, combinations"):
        _, simulation, description, arrays = described(kind, tmp_path)
        before = torch.random.get_rng_state()
        rebuild("policy", description["network"], arrays, simulation)
        assert torch.equal(torch.random.get_rng_state(), before)


# ------------------------------------------------------------------------------------------------- files of any bytes


class Payload:
    """Unpickling it makes a folder."""

    def __init__(self, folder: Path):
        self.folder = folder

    def __reduce__(self):
        return os.mkdir, (str(self.folder),)


def npy(array: np.ndarray, allow_pickle: bool = False) -> bytes:
    buffer = io.BytesIO()
    np.save(buffer, array, allow_pickle=allow_pickle)
    return buffer.getvalue()


def contents(tmp_path: Path, kind: str = LAYERS) -> dict[str, bytes]:
    """The members of a good file."""
    *_, description, arrays = described(kind, tmp_path)
    with zipfile.ZipFile(write_packed(tmp_path / "good.npz", description, arrays)) as archive:
        return {name: archive.read(name) for name in archive.namelist()}


def zipped(file: Path, members: dict[str, bytes], compression: int = zipfile.ZIP_DEFLATED) -> Path:
    with zipfile.ZipFile(file, "w", compression) as archive:
        for name, content in members.items():
            archive.writestr(name, content)
    return file


def described_as(text: str) -> bytes:
    return npy(np.frombuffer(text.encode(), dtype=np.uint8))


@pytest.mark.parametrize("name", ["weight_0.npy", "description.npy", "more.npy"])
def test_a_pickle_in_the_file_is_refused_and_not_run(tmp_path, name):
    folder = tmp_path / "made"
    poisoned = npy(np.array([Payload(folder)], dtype=object), allow_pickle=True)
    file = zipped(tmp_path / "bad.npz", contents(tmp_path) | {name: poisoned})
    with pytest.raises(ValueError, match=rf"bad\.npz: {name[:-4]}: has type object, must be (float32|uint8)"):
        read_packed(file)
    assert not folder.exists()
    with np.load(file, allow_pickle=True) as trusting:
        trusting[name[:-4]]
    assert folder.exists()  # it would have run


def test_a_model_of_stable_baselines3_is_refused(tmp_path):
    model, _ = model_of(LAYERS, tmp_path)
    model.save(tmp_path / "model.zip")
    (tmp_path / "model.zip").rename(tmp_path / "model.npz")
    with pytest.raises(ValueError, match="member 'data' must be an array"):
        read_packed(tmp_path / "model.npz")


@pytest.mark.parametrize(
    "content", [b"", b"PK\x03\x04 and then nothing", b"\x93NUMPY\x01\x00", b"\x80\x05N.", os.urandom(300)]
)
def test_what_is_no_archive_is_refused(tmp_path, content):
    (tmp_path / "bad.npz").write_bytes(content)
    with pytest.raises(ValueError, match=r"bad\.npz: damaged or no packed policy \(.*make one with 'passive-env pack"):
        read_packed(tmp_path / "bad.npz")


def test_a_missing_file_and_a_folder_are_named(tmp_path):
    for file in (tmp_path / "none.npz", tmp_path):
        with pytest.raises(FileNotFoundError, match="no such packed policy"):
            read_packed(file)


@pytest.mark.parametrize("at", [40, 0.3, 0.6, 0.95, -30])
def test_a_truncated_or_altered_file_is_refused(tmp_path, at):
    good = (tmp_path / "good.npz", contents(tmp_path))[0].read_bytes()
    position = int(at * len(good)) if isinstance(at, float) else at
    (tmp_path / "short.npz").write_bytes(good[:position])
    with pytest.raises(ValueError, match=r"short\.npz"):
        read_packed(tmp_path / "short.npz")
    flipped = bytearray(good)
    flipped[position : position + 8] = bytes(255 - byte for byte in good[position : position + 8])
    (tmp_path / "flipped.npz").write_bytes(bytes(flipped))
    with pytest.raises(ValueError, match=r"flipped\.npz"):
        read_packed(tmp_path / "flipped.npz")


def header(shape: str, kind: str = "<f4", numbers: int = 4) -> bytes:
    """An array's bytes whose header claims a shape, with so many bytes of numbers."""
    text = f"{{'descr': '{kind}', 'fortran_order': False, 'shape': {shape}, }}".encode()
    text += b" " * (118 - len(text) - 1) + b"\n"
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(text)) + text + bytes(numbers)


def weights(value: float) -> bytes:
    return npy(np.full((128, 18), value, dtype=np.float32))


BAD_ARRAYS = {
    "float64": (npy(np.zeros((128, 18))), "has type float64, must be float32"),
    "whole numbers": (npy(np.zeros((128, 18), dtype=np.int32)), "has type int32, must be float32"),
    "words": (npy(np.array(["os.system"])), "has type <U9, must be float32"),
    "NaN": (weights(np.nan), "not finite"),
    "infinity": (weights(-np.inf), "not finite"),
    "huge": (weights(2.0 * LARGEST), "numbers beyond ±1e"),
    "no array": (b"import os", "is no NumPy array"),
    "empty": (b"", "is no NumPy array"),
    "later version": (b"\x93NUMPY\x02\x00" + bytes(40), "is no NumPy array"),
    "code in the header": (header("(print(1),)"), "is no NumPy array"),
    "claims more than there is": (header("(10**12,)".replace("10**12", "1000000000000")), "but 4 bytes of numbers"),
    "claims less": (header("(1,)", numbers=12), "but 12 bytes of numbers"),
    "negative lengths": (header("(-1, -1)"), "but 4 bytes of numbers"),
    "other byte order": (header("(1,)", kind=">f4"), "has type >f4, must be float32"),
}


@pytest.mark.parametrize("case", BAD_ARRAYS)
def test_bad_arrays_are_named(tmp_path, case):
    content, words = BAD_ARRAYS[case]
    file = zipped(tmp_path / "bad.npz", contents(tmp_path) | {"weight_0.npy": content})
    with pytest.raises(ValueError, match=rf"bad\.npz: weight_0: .*{words}"):
        read_packed(file)


BAD_TEXTS = {
    "no JSON": ("{", "is no valid JSON"),
    "NaN": ('{"format": NaN}', "NaN is no number of JSON"),
    "too deep": ("[" * 100_000, "is no valid JSON"),
    "a list": ("[1]", "must say format"),
    "another format": ('{"format": "pickle"}', "must say format = 'passive-env policy'"),
    "another version": ('{"format": "passive-env policy", "format_version": 2}', "format_version = 2"),
    "nothing else": ('{"format": "passive-env policy", "format_version": 1}', "environment = None, must be a str"),
}


@pytest.mark.parametrize("case", BAD_TEXTS)
def test_bad_descriptions_are_named(tmp_path, case):
    text, words = BAD_TEXTS[case]
    file = zipped(tmp_path / "bad.npz", contents(tmp_path) | {"description.npy": described_as(text)})
    with pytest.raises(ValueError, match=rf"bad\.npz.*{words}"):
        read_packed(file)


def test_a_description_that_is_not_utf8_is_refused(tmp_path):
    broken = npy(np.array([255, 254], dtype=np.uint8))
    with pytest.raises(ValueError, match="is no valid JSON"):
        read_packed(zipped(tmp_path / "bad.npz", contents(tmp_path) | {"description.npy": broken}))


def test_archives_that_lie_about_their_contents_are_refused(tmp_path):
    good = contents(tmp_path)
    with pytest.raises(ValueError, match="no array 'description'"):
        read_packed(zipped(tmp_path / "a.npz", {"weight_0.npy": good["weight_0.npy"]}))
    with pytest.raises(ValueError, match=f"at most {MOST_MEMBERS}"):
        read_packed(zipped(tmp_path / "b.npz", good | {f"w{i}.npy": b"" for i in range(MOST_MEMBERS)}))
    for name in ("../weight.npy", "weight_0", "sub/weight.npy"):
        with pytest.raises(ValueError, match="must be an array NAME"):
            read_packed(zipped(tmp_path / "c.npz", good | {name: b""}))
    with pytest.raises(ValueError, match="must be stored or deflated"):
        read_packed(zipped(tmp_path / "d.npz", good, zipfile.ZIP_LZMA))
    zipped(tmp_path / "e.npz", {"weight_0.npy": b"", "weight_1.npy": b""})
    twice = (tmp_path / "e.npz").read_bytes().replace(b"weight_1", b"weight_0")
    (tmp_path / "e.npz").write_bytes(twice)
    with pytest.raises(ValueError, match="every name once"):
        read_packed(tmp_path / "e.npz")


def test_a_bomb_is_refused_before_it_unpacks(tmp_path):
    """A small file of zeros that claims, or hides, more than a policy has; and one that is too large itself."""
    good = contents(tmp_path)
    bomb = zipped(tmp_path / "bomb.npz", good | {"weight_0.npy": bytes(MOST_BYTES)})
    assert bomb.stat().st_size < 200_000
    with pytest.raises(ValueError, match=f"unpacks to [0-9]+ bytes, a packed policy to at most {MOST_BYTES}"):
        read_packed(bomb)
    lying = bomb.read_bytes().replace(struct.pack("<I", MOST_BYTES), struct.pack("<I", 64))
    (tmp_path / "lying.npz").write_bytes(lying)
    tracemalloc.start()
    try:
        with pytest.raises(ValueError, match=r"lying\.npz: damaged"):
            read_packed(tmp_path / "lying.npz")
        assert tracemalloc.get_traced_memory()[1] < MOST_BYTES / 8
    finally:
        tracemalloc.stop()
    with open(tmp_path / "large.npz", "wb") as file:
        file.truncate(MOST_BYTES + 1)
    with pytest.raises(ValueError, match=f"has {MOST_BYTES + 1} bytes"):
        read_packed(tmp_path / "large.npz")


def test_an_encrypted_member_is_refused(tmp_path):
    content = bytearray(zipped(tmp_path / "bad.npz", contents(tmp_path)).read_bytes())
    content[content.rfind(b"PK\x01\x02") + 8] |= 1  # the flag in the directory
    (tmp_path / "bad.npz").write_bytes(bytes(content))
    with pytest.raises(ValueError, match="without a password"):
        read_packed(tmp_path / "bad.npz")


BAD_NETWORKS = {
    "kind": ({"kind": "transformer"}, "network.kind = 'transformer', must be one of 'layers', 'per_transmitter'"),
    "kind no word": ({"kind": ["layers"]}, r"network.kind = \['layers'\]"),
    "no sizes": ({"sizes": None}, "network.sizes = None, must be 1 to 12 whole numbers"),
    "sizes no numbers": ({"sizes": [18, "128", 1]}, "must be 1 to 12 whole numbers"),
    "sizes true": ({"sizes": [18, True, 1]}, "must be 1 to 12 whole numbers"),
    "absurd sizes": ({"sizes": [18, 10**12, 1]}, "must be 1 to 12 whole numbers in"),
    "too many": ({"sizes": [18] * 13}, "must be 1 to 12 whole numbers"),
    "other observation": ({"sizes": [17, 128, 128, 1]}, "must begin with 18 and end with 1"),
    "other actions": ({"sizes": [18, 128, 128, 2]}, "must begin with 18 and end with 1"),
    "other shape": ({"sizes": [18, 64, 128, 1]}, r"weight_0 has shape \(128, 18\), must be \(64, 18\)"),
    "fewer layers": ({"sizes": [18, 128, 1]}, "also has bias_2, weight_2; its network has the arrays weight_0"),
    "more layers": ({"sizes": [18, 128, 128, 128, 1]}, "lacks bias_3, weight_3"),
    "activation": ({"activation": "os.system"}, "network.activation = 'os.system', must be one of 'tanh', 'relu'"),
    "squash": ({"squash": 1}, "network.squash = 1, must be true or false"),
    "another kind": ({"kind": NETWORK, "sharpness": 1.0}, "Ownship observes no transmitters one by one"),
}


@pytest.mark.parametrize("case", BAD_NETWORKS)
def test_networks_that_do_not_fit_are_named(tmp_path, case):
    changes, words = BAD_NETWORKS[case]
    _, simulation, description, arrays = described(LAYERS, tmp_path)
    with pytest.raises(ValueError, match=f"^here: .*{words}"):
        rebuild("here", description["network"] | changes, arrays, simulation)


@pytest.mark.parametrize("sharpness", [None, True, -1.0, 1e9, "400"])
def test_a_bad_sharpness_is_named(tmp_path, sharpness):
    _, simulation, description, arrays = described("shared, combinations", tmp_path)
    with pytest.raises(ValueError, match=r"network\.sharpness = .*, must be a number in"):
        rebuild("here", description["network"] | {"sharpness": sharpness}, arrays, simulation)


def test_shared_layers_of_other_shapes_are_named(tmp_path):
    _, simulation, description, arrays = described("shared, combinations", tmp_path)
    with pytest.raises(ValueError, match="here: lacks member_weight; its network has the arrays actor_common_weight"):
        rebuild("here", description["network"], {k: v for k, v in arrays.items() if k != "member_weight"}, simulation)
    short = arrays | {"member_weight": arrays["member_weight"][:, 1:]}
    with pytest.raises(ValueError, match=r"member_weight has shape \(64, 63\), must be \(64, 64\)"):
        rebuild("here", description["network"], short, simulation)


def test_choices_cannot_be_squashed(tmp_path):
    _, simulation, description, arrays = described("tanh to choices", tmp_path)
    with pytest.raises(ValueError, match="false for choices"):
        rebuild("here", description["network"] | {"squash": True}, arrays, simulation)


# ----------------------------------------------------------------------------------------------------------- from runs


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """A finished tiny run."""
    folder = tmp_path_factory.mktemp("packed") / "run"
    run = plan("Ownship", folder, "ppo_scratch", envs=4, timesteps=240)
    train(run, progress=False)
    return run


@pytest.fixture(scope="module")
def file(run):
    file = run.folder.parent / "policy.npz"
    pack(run.folder, file, episodes=8, seed=5, progress=False)
    return file


def policies(run, file):
    simulation = run.scenario.make_simulation()
    return [open_policy(path, "passive/Ownship-v0", simulation) for path in (run.folder, file)]


def test_a_packed_run_flies_as_the_run_folder(run, file):
    learned, packed = policies(run, file)
    assert (type(learned), type(packed)) == (LearnedPolicy, PackedPolicy)
    x = observations(run.scenario.make_observation().space, 10_000)
    np.testing.assert_allclose(packed.act(None, x), learned.act(None, x), rtol=0.0, atol=1e-6)


def test_a_difference_from_the_model_does_not_pass(run, file):
    learned, packed = policies(run, file)
    x = observations(run.scenario.make_observation().space, 50)
    both = Both(packed, learned)
    both.act(None, x)
    assert both.difference <= 1e-6
    both = Both(packed, lambda: None)
    both._other = type("Shifted", (), {"act": lambda _, belief, o: packed.act(belief, o) + 0.01})()
    both.act(None, x)
    assert both.difference == pytest.approx(0.01)


def test_what_packing_leaves(run, file):
    record = json.loads(file.with_suffix(".json").read_text())
    card = file.with_suffix(".md").read_text()
    description = read_packed(file).description
    config = json.loads((run.folder / "config.json").read_text())
    assert {name: description[name] for name in config} == config
    assert description["seconds"] == json.loads((run.folder / TRAINING).read_text())["seconds"] > 0.0
    assert "passive-env train --env passive/Ownship-v0 --algo ppo_scratch --seed 0 --timesteps 240 --envs 4" in card
    assert record["comparison"]["episodes"] == 8
    compared = record["comparison"]
    assert set(compared["strongest"]) == {"final_range_error_m", "mean_range_error_m"}
    named = {(group, name) for each in compared["strongest"].values() for group, name in each.items()}
    assert {group for group, _ in named} == set(AGAINST)
    assert all(KIND_OF[name] in AGAINST[group] for group, name in named)
    assert set(compared["ratios"]) == {name for _, name in named}
    kept = record["recorded"]
    assert (kept["seed"], kept["episodes"]) == (5, 200)
    for name, values in kept["each"].items():
        assert len(values) == 200
        assert np.mean(values) == pytest.approx(kept["errors"][name]["mean"], rel=1e-3)
        assert ", ".join(f"{value:g}" for value in values[:3]) not in card
    for name, error in kept["errors"].items():
        low, high = error["ci95"]
        assert low < error["mean"] < high
        assert f"| {name}" in card
    assert kept["scenario"] == json.loads(json.dumps(run.scenario.to_dict()))


def test_the_strongest_of_a_kind_is_what_the_leaderboard_calls_so():
    """Error by error; fixed policies count with the rules, planners and learned ones do not."""
    means = {
        "planner": (1.0, 1.0), "timed": (2.0, 9.0), "greedy": (3.0, 8.0), "repeat": (4.0, 7.0), "rule": (5.0, 6.0),
        "straight": (9.0, 5.0), "learned": (0.1, 0.1),
    }  # fmt: skip
    errors = ("final_range_error_m", "mean_range_error_m")
    figures = {
        name: {error: {"mean": mean} for error, mean in zip(errors, pair, strict=True)} for name, pair in means.items()
    }
    assert _strongest(figures, "range") == {
        errors[0]: {"rule": "repeat", "greedy": "timed"}, errors[1]: {"rule": "straight", "greedy": "greedy"},
    }  # fmt: skip
    assert _strongest({name: figures[name] for name in ("planner", "rule")}, "range")[errors[0]] == {"rule": "rule"}


def trio(file: Path) -> dict[str, bytes]:
    """Contents of all that stands in a packed file's folder."""
    return {path.name: path.read_bytes() for path in file.parent.iterdir()}


FAILURES = {
    "the commands differ": ("_check_same", ValueError("differ")),
    "interrupted while flying": ("fly_all", KeyboardInterrupt()),
    "no record": ("recorded", ValueError("no number")),
    "no card": ("card_as_markdown", OSError("no space left")),
}


@pytest.mark.parametrize("case", FAILURES)
def test_what_stood_there_stays_if_packing_fails(run, tmp_path, monkeypatch, case):
    name, error = FAILURES[case]

    def fail(*_: Any) -> None:
        raise error

    out = tmp_path / "policy.npz"
    for suffix in (".npz", ".json", ".md"):
        out.with_suffix(suffix).write_text(f"old {suffix}")
    before = trio(out)
    monkeypatch.setattr(f"agents.pack.{name}", fail)
    with pytest.raises(type(error)):
        pack(run.folder, out, episodes=2, seed=5, progress=False)
    assert trio(out) == before
    monkeypatch.undo()
    pack(run.folder, out, episodes=2, seed=5, progress=False)
    after = trio(out)
    assert after.keys() == before.keys()
    assert all(after[file] != before[file] for file in before)


def without_times(record: dict[str, Any]) -> dict[str, Any]:
    """A record but for what differs from one flight of the same to the next."""
    for figures in record["comparison"]["policies"].values():
        del figures["decision_time_us"]
    return record


def test_a_packed_file_is_measured_again_and_stays(file, tmp_path):
    copy = tmp_path / "policy.npz"
    copy.write_bytes(file.read_bytes())
    time = copy.stat().st_mtime_ns
    record = measure(copy, episodes=8, seed=5, progress=False)
    assert (copy.read_bytes(), copy.stat().st_mtime_ns) == (file.read_bytes(), time)
    assert trio(copy).keys() == {"policy.npz", "policy.json", "policy.md"}
    assert json.loads(copy.with_suffix(".json").read_text()) == json.loads(json.dumps(record))
    assert without_times(record) == without_times(json.loads(file.with_suffix(".json").read_text()))


def evaluated(out: Path, policy: Path) -> Path:
    """The evaluation of a run or of a packed file beside rules."""
    policies = ["straight", "lead_lag", "rule", "rule_average"]
    words = ["evaluate", "passive/Ownship-v0", "--policies", *policies, str(policy)]
    assert main([*words, "--episodes", "4", "--out", str(out)]) == 0
    return out / "evaluation.json"


@pytest.fixture(scope="module")
def evaluation(run, tmp_path_factory):
    return evaluated(tmp_path_factory.mktemp("evaluation"), run.folder)


def test_a_card_can_take_the_runs_own_evaluation(run, evaluation, tmp_path):
    record = pack(run.folder, tmp_path / "p.npz", evaluation, progress=False)
    assert (record["comparison"]["episodes"], record["comparison"]["seed"]) == (4, 30_000_000)
    told = json.loads(evaluation.read_text())["policies"]
    for error, found in record["comparison"]["strongest"].items():
        assert found == {"rule": min(set(told) - {"learned"}, key=lambda name: told[name][error]["mean"])}
    card = (tmp_path / "p.md").read_text()
    assert "4 paired episodes from seed 30000000" in card
    assert "greedy" not in card.split("## Limits")[0]


def test_a_card_does_not_take_another_runs_evaluation(run, file, evaluation, tmp_path):
    """Of a policy whose weights are larger by a hundredth; and of other episodes than it says."""
    description, arrays = read_packed(file)
    larger = write_packed(tmp_path / "larger.npz", description, {name: 1.01 * array for name, array in arrays.items()})
    moved = tmp_path / "moved.json"
    moved.write_text(json.dumps(json.loads(evaluation.read_text()) | {"seed": 30_000_001}))
    for other in (evaluated(tmp_path / "evaluation", larger), moved):
        with pytest.raises(ValueError, match=r"_error_m = .* of 'learned', this run's model .*it is of another run"):
            pack(run.folder, tmp_path / "p.npz", other, progress=False)
    assert not (tmp_path / "p.npz").exists()


def test_evaluations_of_something_else_are_refused(run, tmp_path, capsys):
    evaluation = tmp_path / "evaluation.json"
    told = {"final_range_error_m": {"mean": 1.0}, "mean_range_error_m": {"mean": 1.0}}
    good = {
        "environment": "passive/Ownship-v0",
        "episodes": 2,
        "seed": 0,
        "score": "range",
        "policies": {"learned": {}, "rule": {}},
    }
    cases = {
        "is no valid JSON": "{",
        "must be an evaluation.json": "{}",
        "is of passive/TwoStation-v0": json.dumps(good | {"environment": "passive/TwoStation-v0"}),
        "flights held-out": json.dumps(good | {"flights": "held-out"}),
        "must have the policy 'learned'": json.dumps(good | {"policies": {"rule": {}}}),
        "and a rule or a fixed one": json.dumps(good | {"policies": {"learned": {}, "planner": {}}}),
        "= None of 'learned', must be a number": json.dumps(good),
        "has rule_tuned, which passive/Ownship-v0 does not offer": json.dumps(
            good | {"policies": {"learned": told, "rule_tuned": told}}
        ),
    }
    for words, text in cases.items():
        evaluation.write_text(text)
        command = ["pack", str(run.folder), "--out", str(tmp_path / "x.npz"), "--evaluation", str(evaluation)]
        assert main(command) == 2
        assert words in capsys.readouterr().err
    assert not (tmp_path / "x.npz").exists()


def test_the_file_flies_wherever_a_run_folder_does(file, tmp_path, capsys):
    words = ["evaluate", "passive/Ownship-v0", "--policies", "straight", str(file), "--episodes", "4"]
    assert main([*words, "--out", str(tmp_path)]) == 0
    assert set(json.loads((tmp_path / "evaluation.json").read_text())["policies"]) == {"straight", "learned"}
    capsys.readouterr()
    assert main(["evaluate", "passive/TwoStation-v0", *words[2:]]) == 2
    assert "was made for passive/Ownship-v0, not for passive/TwoStation-v0" in capsys.readouterr().err
    assert main([*words, "--fields", "targets=2"]) == 2
    assert "made for other observations or actions" in capsys.readouterr().err
    assert main(["evaluate", "passive/Ownship-v0", "--policies", str(tmp_path / "none.npz")]) == 2
    assert "no such packed policy" in capsys.readouterr().err


def test_packing_refuses_bad_names_and_numbers(run, tmp_path, capsys):
    for words, arguments in {
        "must be the name of a file that ends in .npz": [str(run.folder), "--out", str(tmp_path / "policy.zip")],
        "no config.json in it": [str(tmp_path), "--out", str(tmp_path / "p.npz")],
        "--episodes 0": [str(run.folder), "--out", str(tmp_path / "p.npz"), "--episodes", "0"],
    }.items():
        assert main(["pack", *arguments]) == 2
        assert words in capsys.readouterr().err
    with pytest.raises(ValueError, match="must end in"):
        write_packed(tmp_path / "policy.zip", {}, {})


def test_a_recurrent_model_is_refused(tmp_path):
    run = plan("Ownship", tmp_path / "run", "recurrent_ppo", envs=2, timesteps=120)
    run.preset.pop("imitation", None)
    train(run, progress=False)
    with pytest.raises(ValueError, match="a model of recurrent_ppo with this network cannot be packed"):
        pack(run.folder, tmp_path / "p.npz", episodes=2, progress=False)
    assert not (tmp_path / "p.npz").exists()


def test_time_of_training_is_kept_and_goes_on_when_resumed(run, tmp_path):
    import shutil

    kept = training_seconds(run.folder)
    assert kept is not None
    assert kept > 0.0
    folder = shutil.copytree(run.folder, tmp_path / "run")
    (folder / TRAINING).write_text('{"seconds": 1000.0}')
    train(plan("Ownship", folder, "ppo_scratch", envs=4, timesteps=240), resume=True, progress=False)
    resumed = training_seconds(folder)
    assert resumed is not None
    assert 1000.0 < resumed < 1100.0
    (folder / TRAINING).unlink()
    logged = training_seconds(folder)
    assert logged is not None
    assert 0.0 < logged < 100.0
    shutil.rmtree(folder / "tensorboard")
    assert training_seconds(folder) is None


def test_a_policy_of_another_version_of_the_observation_is_refused(file, tmp_path):
    packed = read_packed(file)
    scenario = make_scenario("Ownship", {})
    for change, words in (
        ({"observation_digest": "0" * 16}, "made for other observations or actions"),
        ({"interface": {"actions": "headings"}}, "Ownship.actions = 'headings': must be one of"),
    ):
        other = write_packed(tmp_path / "other.npz", packed.description | change, packed.arrays)
        with pytest.raises(ValueError, match=words):
            PackedPolicy(other, "passive/Ownship-v0", scenario.make_simulation())
