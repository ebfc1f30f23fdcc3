"""One network for all platforms: what it is taught, how it flies, what is left behind and refused."""

import json

import numpy as np
import pytest
import torch
from stable_baselines3 import PPO

from agents import parameter_sharing
from agents.imitation import _demonstrations, imitate
from agents.parameter_sharing import SharedPolicy, load_shared, main
from agents.sb3 import Sb3VecEnv
from passive_env.catalogue import make_scenario
from passive_env.parallel import parallel_env
from passive_env.team import Team
from passive_env.team_vector_env import TeamVectorEnv
from passive_env.vector_env import PassiveVectorEnv

STEPS = 5
SHORT = make_scenario("TwoStation", {"steps": STEPS})
VIEWS = pytest.mark.parametrize("view", ["common", "own"])


def learner(view, episodes=4, **fields):
    env = Sb3VecEnv(TeamVectorEnv(SHORT.replace(**fields), episodes, view))
    return PPO("MlpPolicy", env, n_steps=STEPS, batch_size=10, n_epochs=1, seed=0, policy_kwargs={"net_arch": [8]})


@VIEWS
@pytest.mark.parametrize("actions", ["continuous", "discrete"])
def test_every_platform_decides_by_what_it_sees(view, actions):
    """The policy's commands are those of the network asked for one agent after the other in single environments."""
    model = learner(view, actions=actions)
    scenario = SHORT.replace(actions=actions)
    policy = SharedPolicy(model, Team(scenario.make_simulation(), view))
    batch = PassiveVectorEnv(scenario, num_envs=3, autoreset_mode="disabled")
    observation, _ = batch.reset(seed=20)
    policy.reset(batch.belief())
    singles = [parallel_env(scenario, view) for _ in range(3)]
    seen = [env.reset(seed=20 + j)[0] for j, env in enumerate(singles)]
    for _ in range(STEPS):
        commands = policy.act(batch.belief(), observation)
        decided = []
        for env, told in zip(singles, seen, strict=True):
            own = {agent: model.predict(told[agent], deterministic=True)[0] for agent in env.agents}
            decided.append(np.concatenate([own[agent] for agent in env.agents]))
            told.update(env.step(own)[0])
        wanted = np.array(decided) if actions == "continuous" else np.array(decided) - 1.0
        np.testing.assert_allclose(commands, wanted, atol=1e-5)
        assert (commands[:, 0] != commands[:, 1]).any() or actions == "discrete"
        observation, *_ = batch.step(batch.simulation.actions.encode(commands))


def test_agents_are_taught_their_parts_of_the_teachers_actions():
    team = Team(SHORT.make_simulation())
    arguments = (SHORT, "rule", 3, 0.3, 5, 0.9, True)
    x, y, earned = _demonstrations(*arguments)
    of_agents = _demonstrations(*arguments, team=team)
    assert [part.shape for part in of_agents] == [(STEPS, 12, x.shape[-1] + 2), (STEPS, 12, 1), (STEPS, 12)]
    for episode in range(6):  # the last three are mirror images
        for i in range(2):
            row = 2 * episode + i
            np.testing.assert_array_equal(of_agents[0][:, row, :-2], x[:, episode])
            np.testing.assert_array_equal(of_agents[0][:, row, -2:], np.tile(np.arange(2) == i, (STEPS, 1)))
            np.testing.assert_array_equal(of_agents[1][:, row, 0], y[:, episode, i])
            np.testing.assert_array_equal(of_agents[2][:, row], earned[:, episode])


@VIEWS
def test_imitation_and_learning_change_the_network(view):
    model = learner(view)
    team = model.get_env().env.team
    teach = {"teacher": "rule", "episodes": 16, "epochs": 1, "learning_rate": 1e-2, "noise": 0.1, "seed": 0}
    first = imitate(model, SHORT, team=team, **teach)
    assert imitate(model, SHORT, team=team, **{**teach, "epochs": 60}) < 0.7 * first
    before = [part.clone() for part in model.policy.parameters()]
    model.learn(2 * STEPS * 8)
    assert model.num_timesteps == 2 * STEPS * 8
    assert any(not torch.equal(a, b) for a, b in zip(before, model.policy.parameters(), strict=True))


def test_a_critic_of_rows_cannot_see_the_truth():
    with pytest.raises(ValueError, match="truth=True needs a PassiveVectorEnv"):
        Sb3VecEnv(TeamVectorEnv(SHORT, 2), truth=True)


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """A finished run, as short as can be, compared with one rule."""
    folder = tmp_path_factory.mktemp("runs") / "own"
    arguments = ["--out", str(folder), "--view", "own", "--reward", "difference", "--timesteps", "360", "--envs", "4"]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(parameter_sharing, "BASELINES", ("rule",))
        assert main([*arguments, "--teacher", "rule", "--teacher-episodes", "4", "--episodes", "3"]) == 0
    return folder


def test_a_run_leaves_model_configuration_and_comparison(run):
    config = json.loads((run / "config.json").read_text())
    assert (config["env"], config["view"], config["reward"]) == ("passive/TwoStation-v0", "own", "difference")
    summary = json.loads((run / "evaluation.json").read_text())
    assert list(summary["policies"]) == ["rule", "pretrained", "shared"]
    assert summary["ratios"]["pretrained"]["shared"]["final_range_error_m"]["ratio"] > 0.0


def test_finished_runs_are_compared_without_training(run, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(parameter_sharing, "BASELINES", ("rule",))
    arguments = ["--out", str(tmp_path / "both"), "--runs", str(run), str(run), "--episodes", "3"]
    assert main(arguments) == 0
    again = json.loads((tmp_path / "both" / "evaluation.json").read_text())["policies"]
    assert list(again) == ["rule", "pretrained", "shared_own", "shared_own_2"]
    before = json.loads((run / "evaluation.json").read_text())["policies"]["shared"]
    assert again["shared_own"]["final_range_error_m"] == before["final_range_error_m"]
    assert "| shared_own_2 |" in capsys.readouterr().out
    assert not (tmp_path / "both" / "model.zip").exists()


def test_what_is_refused(run, tmp_path, capsys):
    for arguments, message in [
        (["--out", str(run)], "holds files already; choose another folder"),
        (["--out", str(tmp_path / "a"), "--env", "passive/Ownship-v0"], "at least two must be steered"),
        (["--out", str(tmp_path / "b"), "--env", "passive/Twostation-v0"], "did you mean 'passive/TwoStation-v0'"),
        (["--out", str(tmp_path / "c"), "--runs", str(tmp_path)], "no config.json in it"),
        (["--out", str(tmp_path / "d"), "--teacher", "nobody"], "unknown policy 'nobody'"),
    ]:
        assert main(arguments) == 2
        assert message in capsys.readouterr().err
    with pytest.raises(ValueError, match="made for passive/TwoStation-v0, not for passive/AngleFusion-v0"):
        load_shared(run, "passive/AngleFusion-v0")


def test_damaged_runs_are_refused(run, tmp_path):
    model, config = (run / "model.zip").read_bytes(), json.loads((run / "config.json").read_text())
    (tmp_path / "model.zip").write_bytes(model[: len(model) // 2])
    (tmp_path / "config.json").write_text(json.dumps(config))
    with pytest.raises(ValueError, match="damaged or not a saved ppo model"):
        load_shared(tmp_path, config["env"])
    (tmp_path / "model.zip").write_bytes(model)
    (tmp_path / "config.json").write_text(json.dumps({**config, "view": "common"}))
    with pytest.raises(ValueError, match="made for another version of passive/TwoStation-v0"):
        load_shared(tmp_path, config["env"])
    (tmp_path / "config.json").write_text("{")
    with pytest.raises(ValueError, match="is no valid JSON"):
        load_shared(tmp_path, "passive/TwoStation-v0")
    (tmp_path / "config.json").write_text("{}")
    with pytest.raises(ValueError, match="is no shared network's configuration, it names no env and view"):
        load_shared(tmp_path, "passive/TwoStation-v0")
