"""PettingZoo's contract, over all environments with agents, and what a user may get wrong."""

import re
import subprocess
import sys
import warnings
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
from pettingzoo.test import api_test, parallel_api_test, parallel_seed_test
from pettingzoo.utils.conversions import parallel_to_aec
from spoilt_trackers import SPOILT, spoilt_later

import passive_env
from passive_env.catalogue import SCENARIOS, environment_id
from passive_env.env import PassiveEnv
from passive_env.parallel import parallel_env
from trackers.rp_ekf import RpEkf

DOCUMENT = Path(__file__).parents[1] / "docs" / "pettingzoo.md"
IDS = [environment_id(name) for name, scenario in SCENARIOS.items() if scenario.steering is not None]
CASES = [
    *((env_id, {}) for env_id in IDS),
    *((env_id, {"view": "own", "reward": "difference"}) for env_id in IDS if "Clutter" not in env_id),
    ("passive/TwoStation-v0", {"actions": "discrete", "view": "own"}),
    ("passive/AngleFusion-v0", {"actions": "headings"}),
    ("passive/ManeuveringTarget-v0", {"actions": "headings", "stations": 4, "reward": "difference"}),
    ("passive/MobilePlacement-v0", {"actions": "velocities", "sensors": 2}),
]
over_cases = pytest.mark.parametrize(("env_id", "keywords"), CASES, ids=lambda part: str(part))


@over_cases
def test_api_and_seed_tests(env_id, keywords):
    """PettingZoo's tests assert and warn by themselves; here besides that an episode was flown to its end."""
    env = parallel_env(env_id, steps=3, **keywords)
    with warnings.catch_warnings():
        warnings.simplefilter("error")  # where the test only warns, it found something
        parallel_api_test(env, num_cycles=10)
    assert env.agents == []
    assert env.world.step.tolist() == [3]
    parallel_seed_test(lambda: parallel_env(env_id, steps=3, **keywords), num_cycles=10)


def test_turn_by_turn():
    """PettingZoo's test asserts by itself; here besides that both platforms have a turn per step, and a last look."""
    env = parallel_to_aec(parallel_env(steps=3))
    api_test(env, num_cycles=20)
    env.reset(seed=0)
    turns = []
    for agent in env.agent_iter():
        *_, terminated, truncated, _ = env.last()
        turns.append(agent)
        env.step(None if terminated or truncated else env.action_space(agent).sample())
    assert turns == ["platform_0", "platform_1"] * 4


@over_cases
def test_spaces_are_bounded_and_everything_finite(env_id, keywords):
    env = parallel_env(env_id, steps=5, **keywords)
    names = [field.name for field in env.observation_fields]
    assert len(set(names)) == len(names)
    seen, infos = env.reset(seed=0)
    for _ in range(5):
        for agent in env.agents:
            space = env.observation_space(agent)
            assert space.shape == (len(names),)
            assert np.isfinite([space.low, space.high]).all()
            assert space.contains(seen[agent])
        actions = {agent: env.action_space(agent).sample() for agent in env.agents}
        seen, rewards, terminations, truncations, infos = env.step(actions)
        assert all(type(reward) is float and np.isfinite(reward) for reward in rewards.values())
        assert all(np.isfinite(infos[agent]["range_error_m"]).all() for agent in env.possible_agents)
        assert env.state_space.contains(env.state())
    assert not any(terminations.values())
    assert all(truncations.values())
    assert env.agents == []


@pytest.mark.parametrize("name", ["TwoStation", "ManeuveringTarget"])
@pytest.mark.parametrize("reward", ["team", "difference"])
def test_the_episode_is_the_single_environments(name, reward):
    """Same seed, same actions: same observations, rewards and infos bit for bit."""
    env, single = parallel_env(name, reward=reward, steps=6), PassiveEnv(name, steps=6)
    seen, infos = env.reset(seed=5)
    observation, info = single.reset(seed=5)
    size, kinds = len(env.possible_agents), env.action_space("platform_0").shape[0]
    earned = 0.0
    for _ in range(6):
        for agent in env.agents:
            np.testing.assert_array_equal(seen[agent][:-size], observation)
            np.testing.assert_array_equal(infos[agent]["range_error_m"], info["range_error_m"])
            assert infos[agent]["team_reward"] == earned
        np.testing.assert_array_equal(env.state(), observation)
        whole = single.action_space.sample()
        by_kind = whole.reshape(kinds, size)  # the first number of all platforms, then the second one of all
        actions = {f"platform_{i}": by_kind[:, i] for i in range(size)}
        seen, rewards, _, _, infos = env.step(actions)
        observation, earned, _, _, info = single.step(whole)
        if reward == "team":
            assert set(rewards.values()) == {earned}
        else:
            assert earned not in rewards.values()


def test_a_diverged_tracker_gives_finite_numbers():
    for view in ("common", "own"):
        tracker = spoilt_later(RpEkf, SPOILT["mean"])
        env = parallel_env(view=view, reward="difference", tracker=tracker, steps=8)
        env.reset(seed=0)
        while env.agents:
            seen, rewards, _, _, _ = env.step({agent: env.action_space(agent).sample() for agent in env.agents})
            assert all(env.observation_space(agent).contains(each) for agent, each in seen.items())
            assert np.isfinite(list(rewards.values())).all()
        assert tracker.asked > 3


def test_pictures():
    env = parallel_env(render_mode="rgb_array", steps=2)
    env.reset(seed=0)
    assert env.render().ndim == 3
    env.close()


@pytest.mark.parametrize(
    ("keywords", "message"),
    [
        ({"env_id": "passive/Ownship-v0"}, "Ownship: agents are platforms, and at least two must be steered"),
        ({"env_id": "passive/PassiveRadar-v0"}, "PassiveRadar: agents are platforms"),
        ({"env_id": "passive/MobileReceiver-v0"}, "PassiveRadar: agents are platforms"),
        ({"env_id": "passive/RadarPlacement-v0"}, "RadarPlacement: agents are platforms"),
        ({"env_id": "passive/TwoStatoin-v0"}, "did you mean 'passive/TwoStation-v0'"),
        ({"view": "private"}, "view = 'private': must be one of 'common', 'own'"),
        ({"view": None}, "view = None: must be one of"),
        ({"reward": "shapley"}, "reward = 'shapley': must be one of 'team', 'difference'"),
        ({"render_mode": "ansi"}, "render_mode = 'ansi': must be None"),
        ({"steps": 0}, r"steps = 0: must lie in \[1, 10000\]"),
        (
            {"env_id": "passive/AngleFusionClutter-v0", "view": "own"},
            r"clutter_mean = 8.0: such false returns lie in the gates of the common track.*clutter_density_per_deg2",
        ),
        (
            {"env_id": "passive/AngleFusion-v0", "view": "own", "actions": "headings"},
            "actions = 'headings': these are told off the common track.*take actions='continuous'",
        ),
        (
            {"env_id": "passive/MobilePlacement-v0", "view": "own", "actions": "velocities"},
            "actions = 'velocities': these are told off the common track",
        ),
    ],
)
def test_what_cannot_be_made(keywords, message):
    with pytest.raises(ValueError, match=message):
        parallel_env(**keywords)


def test_unknown_fields_are_named():
    with pytest.raises(TypeError, match="has no field 'step'; did you mean 'steps'"):
        parallel_env(step=3)


@pytest.mark.parametrize(
    ("actions", "message"),
    [
        ({"platform_0": [0.0]}, r"actions: got platform_0, must be a dict with one for each of \['platform_0', 'pl"),
        ({}, "actions: got none, must be a dict"),
        ({"platform_0": [0.0], "platform_1": [0.0], "platform_2": [0.0]}, "got platform_0, platform_1, platform_2"),
        ([[0.0], [0.0]], r"got \[\[0.0\], \[0.0\]\], must be a dict"),
        ({"platform_0": [0.0], "platform_1": [0.0, 0.0]}, r"action of platform_1: has shape \(2,\), must have shape"),
        ({"platform_0": [np.nan], "platform_1": [0.0]}, "action of platform_0: .*must be a finite number"),
        ({"platform_0": [0.0], "platform_1": ["left"]}, r"action of platform_1: \['left'\], must be numbers"),
    ],
)
def test_bad_actions_are_refused_and_nothing_changes(actions, message):
    env = parallel_env(steps=3)
    env.reset(seed=0)
    before = env.state()
    with pytest.raises(ValueError, match=message):
        env.step(actions)
    np.testing.assert_array_equal(env.state(), before)
    assert env.world.step[0] == 0


def test_a_choice_that_there_is_not_is_refused():
    env = parallel_env(steps=3, actions="discrete")
    env.reset(seed=0)
    with pytest.raises(ValueError, match="choices must be integers from 0 to 2"):
        env.step({"platform_0": [1], "platform_1": [3]})


def test_an_episode_must_be_under_way():
    env = parallel_env(steps=1)
    for call in (lambda: env.step({}), env.state):
        with pytest.raises(gym.error.ResetNeeded, match=r"call reset\(\)"):
            call()
    env.reset(seed=0)
    still = {agent: np.zeros(1) for agent in env.agents}
    env.step(still)
    with pytest.raises(gym.error.ResetNeeded, match="no agent is in an episode"):
        env.step(still)


def test_without_pettingzoo_the_message_names_the_command(monkeypatch):
    monkeypatch.setitem(sys.modules, "pettingzoo", None)
    monkeypatch.delitem(sys.modules, "passive_env.pettingzoo_env", raising=False)
    with pytest.raises(ImportError, match=r'python -m pip install "passive-env\[pettingzoo\]"'):
        passive_env.parallel_env()


def test_the_package_imports_pettingzoo_only_when_asked():
    code = "import sys, passive_env; assert callable(passive_env.parallel_env); print('pettingzoo' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "False"


def test_the_documents_code_runs_and_it_names_all_environments(capsys):
    text = DOCUMENT.read_text(encoding="utf-8")
    (block,) = re.findall(r"```python\n(.*?)```", text, re.DOTALL)
    exec(compile(block, str(DOCUMENT), "exec"), {})
    assert "return2.azimuth_sin" in capsys.readouterr().out
    assert [env_id for env_id in IDS if f"`{env_id}`" not in text] == []
