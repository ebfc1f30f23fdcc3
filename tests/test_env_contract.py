"""The Gymnasium contract, over the whole registry and over variants of every environment in it."""

import dataclasses
import json
import subprocess
import sys
import warnings
from itertools import combinations

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.envs.registration import EnvSpec
from gymnasium.utils.env_checker import check_env
from stable_baselines3.common.env_checker import check_env as sb3_check_env

import passive_env
from passive_env.catalogue import SCENARIOS, environment_ids, scenario_name
from passive_env.catalogue.passive_radar import PassiveRadar

VARIANTS = (
    {},
    {"course": "paper"},
    {"course": "paper_bestfit"},
    {"course": "flights"},
    {"tracker": "fused_ekf"},
    {"bearings": "reference"},
    {"detection_probability": 0.7, "false_bearings_mean": 2.0},
    {"actions": "discrete"},
    {"actions": "headings"},
    {"actions": "velocities"},
    {"standoff_m": 5000.0},
    {"targets": 1},
    {"targets": 6},
    {"steps": 3},
    {"maneuvering": True},
    {"nogo_discs": 2, "standoff_m": 5000.0, "targets": 2},
    {"clutter_mean": 4.0, "detection_probability": 0.7, "availability0_min": 0.3, "availability1_min": 0.3},
    {"clutter_density_per_deg2": 0.05, "clutter_window_deg": 5.0, "clutter_mean": 0.0},
    {"formation": "trail"},
    {"tracker": "angle_ekf"},
    {"course": "paper1"},
    {"course": "paper2", "stations": 4},
    {"course": "flights", "flight_turn_s": 2.0},
    {"carrier": "ground", "measuring_speed_m_s": 20.0},
    {"stations": 3, "detection_probability": 0.7},
    {"tracker": "imm3"},
    {"tracker": "mie"},
    {"angle_only": 1},
    {"tracker": "iterated"},
    {"dimensions": 3},
    {"dimensions": 3, "course": "flights", "receiver_speed_m_s": 60.0, "actions": "discrete"},
    {"maneuvers": True, "tracker": "ekf_literal"},
    {"sites": "paper_good", "retune_delay_s": 2.5},
    {"render_mode": "rgb_array"},
)


def applies(env_id, variant) -> bool:
    """Whether an environment's scenario has a variant's fields and allows its values."""
    rules = {f.name: f.metadata for f in dataclasses.fields(SCENARIOS[scenario_name(env_id)])}
    return all(
        name == "render_mode" or (name in rules and allows(rules[name], value)) for name, value in variant.items()
    )


def allows(rule, value) -> bool:
    if rule["kind"] == "free":
        return value in rule["doc"].replace(",", "").split()  # the trackers' names
    return value in rule.get("options", (value,)) and value <= rule.get("high", value)


CASES = [
    pytest.param(env_id, variant, id=f"{scenario_name(env_id)}-{json.dumps(variant)}")
    for env_id in environment_ids()
    for variant in VARIANTS
    if applies(env_id, variant)
]
over_registry = pytest.mark.parametrize(("env_id", "variant"), CASES)

INFO = {
    "range_error_m": np.float64,
    "position_error_m": np.float64,
    "range_m": np.float64,
    "range_crlb_m": np.float64,
    "nees": np.float64,
    "lost": np.bool_,
}
VIOLATIONS = {"standoff_violation", "nogo_violation"}
INFO_IN_SPACE = {"position_crlb_m": np.float64, "dropped_returns": np.int64}
"""What scenarios in space show besides."""
INFO_OF_MANEUVERS = {
    "position_crlb_m": np.float64,
    "acceleration_error_m_s2": np.float64,
    "fix_error_m": np.float64,
    "fixed": np.bool_,
    "maneuvering": np.bool_,
}
"""What those with a maneuvering target show besides."""
PARTS_OF_MANEUVERS = {"acceleration": np.float64, "model_probability": np.float64, "detected": np.bool_}
"""The same with an axis of components or models."""
INFO_OF_PLACEMENT = {"position_crlb_m": np.float64, "track_error_m": np.float64}
"""What those in which sensors are placed show besides."""
INFO_OF_MOVING_SENSORS = {"position_crlb_m": np.float64}
"""The same where they go on moving."""
INFO_OF_PASSIVE_RADAR = {
    "position_crlb_m": np.float64,
    "horizontal_error_m": np.float64,
    "horizontal_crlb_m": np.float64,
    "height_error_m": np.float64,
    "height_crlb_m": np.float64,
    "maneuver": np.bool_,
}
"""What a passive radar shows besides."""
PARTS_OF_PASSIVE_RADAR = {
    "chosen": np.bool_,
    "answered": np.bool_,
    "missed": np.bool_,
    "blocked": np.bool_,
    "blocked_probability": np.float64,
}
"""The same, of every transmitter."""
PER_EPISODE = "task."
"""Observed numbers that are the same throughout an episode."""
MIDDLE = (".azimuth_sin",)
"""Those that the middle one of discrete choices leaves as they were."""
REPORTS = (".assigned", ".returns", ".missed", ".available", ".detected", ".answered", ".maneuver")
"""Observed numbers that tell what the last scan brought."""
FOUND = ("_acceleration", ".model_probability", ".log_statistic", ".chosen", ".recent_answer", ".recent_miss", ".wait")
"""Those that take a maneuver or a choice, and more scans than a few, or than stations that seldom stand bring."""


def make(env_id, variant):
    return gym.make(env_id, **variant)


def episode(env, seed=0):
    """All calls of an episode under random actions: (observation, reward, truncated, info), reset first."""
    env.action_space.seed(seed)
    observation, info = env.reset(seed=seed)
    calls = [(observation, 0.0, False, info)]
    while not calls[-1][2]:
        observation, reward, terminated, truncated, info = env.step(env.action_space.sample())
        assert terminated is False
        calls.append((observation, reward, truncated, info))
    return calls


def arrays_of(observation, info):
    return [observation, *(value for value in info.values() if isinstance(value, np.ndarray))]


def test_every_catalogue_scenario_is_registered_with_both_entry_points():
    known = ("TwoStation", "Ownship", "OwnshipManeuvering", "OwnshipMulti")
    known += ("AngleFusion", "AngleFusionClutter", "AngleFusionSlow", "ManeuveringTarget", "RadarPlacement")
    known += ("MobilePlacement", "PassiveRadar", "PassiveRadarRetune", "MobileReceiver")
    assert {f"passive/{name}-v0" for name in known} <= set(environment_ids())
    for env_id in environment_ids():
        spec = gym.spec(env_id)
        assert env_id.startswith("passive/")
        assert env_id.endswith("-v0")
        assert spec.entry_point
        assert spec.vector_entry_point


def test_registering_again_changes_nothing():
    before = dict(gym.registry)
    passive_env.register_all()
    assert dict(gym.registry) == before


# ------------------------------------------------------------------------------------------------ the two checkers


@over_registry
def test_gymnasium_checker_passes(env_id, variant):
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        check_env(make(env_id, variant).unwrapped)
    complaints = [str(w.message) for w in caught if "shows nothing" not in str(w.message)]  # no display in a test
    assert complaints == []


@over_registry
def test_stable_baselines3_checker_passes(env_id, variant):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        sb3_check_env(make(env_id, variant))


# ------------------------------------------------------------------------------------------------ ways to make one


@over_registry
def test_prefixed_and_plain_ids_make_the_same_environment(env_id, variant):
    plain, prefixed = make(env_id, variant), make(f"passive_env:{env_id}", variant)
    assert type(plain.unwrapped) is type(prefixed.unwrapped) is passive_env.PassiveEnv
    assert np.array_equal(plain.reset(seed=4)[0], prefixed.reset(seed=4)[0])


FRESH_PROCESS = """
import sys
import gymnasium as gym

if __name__ == "__main__":
    assert "passive_env" not in sys.modules
    env = gym.make("passive_env:passive/TwoStation-v0")
    print(float(env.reset(seed=3)[0].sum()))
    workers = gym.make_vec(
        "passive_env:passive/TwoStation-v0", num_envs=2, vectorization_mode="async", vector_kwargs={"context": "spawn"}
    )
    print(*(float(row.sum()) for row in workers.reset(seed=3)[0]))
    workers.close()
"""


def test_prefixed_id_works_in_fresh_processes_and_spawned_workers(tmp_path):
    script = tmp_path / "fresh.py"
    script.write_text(FRESH_PROCESS)
    done = subprocess.run([sys.executable, script], capture_output=True, text=True, timeout=300, check=False)
    assert done.returncode == 0, done.stderr
    own = [float(make("passive/TwoStation-v0", {}).reset(seed=seed)[0].sum()) for seed in (3, 4)]
    single, workers = done.stdout.strip().splitlines()
    assert float(single) == own[0]
    assert [float(value) for value in workers.split()] == own


@over_registry
def test_make_vec_gives_the_native_vector_environment(env_id, variant):
    env = gym.make_vec(env_id, num_envs=2, **variant)
    assert isinstance(env, passive_env.PassiveVectorEnv)
    single = make(env_id, variant)
    assert env.single_observation_space == single.observation_space
    assert env.single_action_space == single.action_space
    observation, _ = env.reset(seed=9)
    assert observation in env.observation_space
    assert np.array_equal(observation[0], single.reset(seed=9)[0])


@over_registry
def test_spec_survives_json(env_id, variant):
    env = make(env_id, variant)
    spec = EnvSpec.from_json(env.spec.to_json())
    assert spec == env.spec
    again = gym.make(spec)
    assert again.unwrapped.scenario == env.unwrapped.scenario
    assert again.render_mode == env.render_mode == variant.get("render_mode")
    assert np.array_equal(again.reset(seed=1)[0], env.reset(seed=1)[0])


@pytest.mark.parametrize("field", [{"target": 2}, {"tragets": 2}, {"bearing_std_degrees": 1.0}], ids=str)
def test_a_misspelt_field_is_an_error_that_suggests_the_right_name(field):
    with pytest.raises(TypeError, match=r"did you mean '(targets|bearing_std_deg)'"):
        make("passive/TwoStation-v0", field)


def test_an_unknown_render_mode_is_an_error_that_names_the_known_ones():
    with pytest.raises(ValueError, match="rgb_array"):
        passive_env.PassiveEnv(render_mode="ascii")
    with pytest.raises(ValueError, match="rgb_array"):
        passive_env.PassiveVectorEnv(render_mode="human")


# ------------------------------------------------------------------------------------------------ observations


@over_registry
def test_observations_lie_in_their_box_and_match_the_fields(env_id, variant):
    env = make(env_id, variant)
    fields = env.unwrapped.observation_fields
    assert env.observation_space.shape == (len(fields),)
    assert env.observation_space.dtype == np.float32
    assert np.all(np.isfinite(env.observation_space.low))
    assert np.all(np.isfinite(env.observation_space.high))
    assert len({field.name for field in fields}) == len(fields)
    assert all(field.name and field.unit and field.scale for field in fields)
    for observation, *_ in episode(env):
        assert observation.dtype == np.float32
        assert observation in env.observation_space


@over_registry
def test_every_observed_number_changes_during_an_episode(env_id, variant):
    """What scans brought may be the same every time where nothing is missed and nothing false."""
    env = make(env_id, variant)
    seen = np.array([observation for observation, *_ in episode(env, seed=1)])
    constant = {
        f.name
        for f, varies in zip(env.unwrapped.observation_fields, np.ptp(seen, axis=0) > 0, strict=True)
        if not varies
    }
    may = (*REPORTS, PER_EPISODE) + MIDDLE * (variant.get("actions") == "discrete")
    may += FOUND * ("steps" in variant or "carrier" in variant or variant.get("course") == "flights")
    may += FOUND * (getattr(env.unwrapped.scenario, "retune_delay_s", 0.0) > 0.0)  # of choices that never last as long
    assert {name for name in constant if not any(part in name for part in may)} == set()
    if variant.get("detection_probability", 1.0) < 1.0:
        assert {
            name for name in constant if variant.get("availability0_min", 1.0) < 1.0 or "avail" not in name
        } == set()


@over_registry
def test_what_is_constant_in_an_episode_differs_between_episodes(env_id, variant):
    env = make(env_id, variant)
    told = [field.name.startswith(PER_EPISODE) for field in env.unwrapped.observation_fields]
    first, second = (env.reset(seed=seed)[0][told] for seed in (1, 2))
    assert not np.any(first == second)


def test_time_left_and_last_action_fields_say_what_they_name():
    env = make("passive/TwoStation-v0", {"steps": 4})
    names = [field.name for field in env.unwrapped.observation_fields]
    observation, _ = env.reset(seed=0)
    assert observation[names.index("time_left")] == 1.0
    assert observation[names.index("last_action1")] == 0.0
    observation, *_ = env.step(np.array([0.25, -0.5], dtype=np.float32))
    assert observation[names.index("time_left")] == 0.75
    assert observation[names.index("last_action0")] == 0.25
    assert observation[names.index("last_action1")] == -0.5


# ------------------------------------------------------------------------------------------------ info and reward


@over_registry
def test_info_has_the_designed_keys_shapes_and_types(env_id, variant):
    env = make(env_id, variant)
    targets = env.unwrapped.scenario.targets
    shown = INFO | (INFO_IN_SPACE if "AngleFusion" in env_id else {})
    shown |= INFO_OF_MANEUVERS if "ManeuveringTarget" in env_id else {}
    shown |= INFO_OF_PLACEMENT if "RadarPlacement" in env_id else {}
    shown |= INFO_OF_MOVING_SENSORS if "MobilePlacement" in env_id else {}
    radar = isinstance(env.unwrapped.scenario, PassiveRadar)
    shown |= INFO_OF_PASSIVE_RADAR if radar else {}
    parts = PARTS_OF_PASSIVE_RADAR if radar else PARTS_OF_MANEUVERS if "fixed" in shown else {}
    for _, reward, truncated, info in episode(env):
        assert set(info) == {*shown, *parts, *VIOLATIONS, "reward_terms"}
        for name, dtype in parts.items():
            assert info[name].shape[0] == (env.unwrapped.scenario.pool if radar else targets), name
            assert info[name].ndim == (1 if radar else 2), name
            assert info[name].dtype == dtype, name
            assert np.all(np.isfinite(info[name])), name
        assert all(type(info[name]) is float and info[name] >= 0.0 for name in VIOLATIONS)
        for name, dtype in shown.items():
            assert info[name].shape == (targets,), name
            assert info[name].dtype == dtype, name
            assert np.all(np.isfinite(info[name])), name
        assert np.all(info["range_error_m"] >= 0.0)
        assert np.all(info["position_error_m"] >= info["range_error_m"] - 1e-6)  # triangle inequality
        assert np.all(info["range_crlb_m"] > 0.0)
        assert np.all(info["nees"] >= 0.0)
        assert type(reward) is float
        assert type(truncated) is bool
        assert all(type(value) is float for value in info["reward_terms"].values())
        assert reward == pytest.approx(sum(info["reward_terms"].values()), abs=1e-12)


def test_reward_terms_show_every_weighted_term_and_no_other():
    weighted = {"reward_log_range_error": 0.5, "reward_maneuver": 2.0, "reward_lost_track": 3.0, "standoff_m": 1e4}
    env = make("passive/TwoStation-v0", weighted)
    assert set(env.reset(seed=0)[1]["reward_terms"]) == {"log_range_error", "maneuver", "lost_track", "standoff"}
    *_, info = env.step(np.array([1.0, 0.5], dtype=np.float32))
    assert info["reward_terms"]["maneuver"] == pytest.approx(-2.0 * (1.0 + 0.25) / 2.0)


# ------------------------------------------------------------------------------------------------ order of calls


def test_step_belief_and_world_before_reset_are_errors():
    for env in (passive_env.PassiveEnv(), passive_env.PassiveVectorEnv(num_envs=2)):
        for call in (lambda env=env: env.step(env.action_space.sample()), env.belief, lambda env=env: env.world):
            with pytest.raises(gym.error.ResetNeeded):
                call()


@over_registry
def test_an_episode_ends_after_its_steps_and_a_further_step_is_an_error(env_id, variant):
    env = make(env_id, variant)
    assert len(episode(env)) - 1 == variant.get("steps", env.unwrapped.scenario.steps)
    with pytest.raises(gym.error.ResetNeeded, match="over"):
        env.unwrapped.step(env.action_space.sample())
    env.reset()
    env.step(env.action_space.sample())


def test_a_bad_action_is_an_error_and_leaves_the_episode_as_it_was():
    env, twin = (passive_env.PassiveEnv() for _ in range(2))
    env.reset(seed=0), twin.reset(seed=0)
    for bad in (np.zeros(3), np.zeros((1, 2)), 0.0, [np.nan, 0.0], [np.inf, 0.0], ["left", "right"], [1j, 0.0], None):
        with pytest.raises(ValueError, match="action"):
            env.step(bad)
    straight = np.zeros(2, dtype=np.float32)
    assert np.array_equal(env.step(straight)[0], twin.step(straight)[0])


# ------------------------------------------------------------------------------------------------ determinism


def same(a, b) -> bool:
    if isinstance(a, dict):
        return set(a) == set(b) and all(same(a[key], b[key]) for key in a)
    return np.array_equal(a, b)


@over_registry
def test_same_seed_and_actions_give_the_same_episode(env_id, variant):
    first, second = make(env_id, variant), make(env_id, variant)
    for a, b in zip(episode(first, seed=7), episode(second, seed=7), strict=True):
        assert all(same(x, y) for x, y in zip(a, b, strict=True))
    repeated = episode(first, seed=7)
    assert all(same(x[0], y[0]) for x, y in zip(repeated, episode(second, seed=7), strict=True))
    assert not same(episode(first, seed=8)[0][0], repeated[0][0])


def test_reset_without_seed_goes_on_with_the_generator():
    first, second = make("passive/TwoStation-v0", {}), make("passive/TwoStation-v0", {})
    openings = []
    for env in (first, second):
        openings.append([env.reset(seed=5)[0], env.reset()[0], env.reset()[0]])
    assert all(np.array_equal(a, b) for a, b in zip(*openings, strict=True))
    assert not any(np.array_equal(a, b) for a, b in combinations(openings[0], 2))


def test_global_generators_are_neither_read_nor_moved():
    np.random.seed(1)  # noqa: NPY002
    before = np.random.get_state()[1].copy()  # noqa: NPY002
    first = episode(make("passive/TwoStation-v0", {"detection_probability": 0.7, "false_bearings_mean": 1.0}))
    assert np.array_equal(np.random.get_state()[1], before)  # noqa: NPY002
    np.random.seed(2)  # noqa: NPY002
    second = episode(make("passive/TwoStation-v0", {"detection_probability": 0.7, "false_bearings_mean": 1.0}))
    assert all(same(a[0], b[0]) for a, b in zip(first, second, strict=True))


# ------------------------------------------------------------------------------------------------ ownership of arrays


@over_registry
def test_returned_arrays_share_no_memory_between_calls(env_id, variant):
    calls = [arrays_of(call[0], call[3]) for call in episode(make(env_id, {**variant, "steps": 3}))]
    for earlier, later in combinations(calls, 2):
        assert not any(np.shares_memory(a, b) for a in earlier for b in later)
    for arrays in calls:
        assert not any(np.shares_memory(a, b) for a, b in combinations(arrays, 2))


def test_returned_dictionaries_are_new_in_every_call():
    infos = [call[3] for call in episode(make("passive/TwoStation-v0", {"steps": 3}))]
    assert len({id(info) for info in infos}) == len({id(info["reward_terms"]) for info in infos}) == 4


def scribble(tree):
    """Overwrite every array and dictionary a user was given."""
    for key, value in list(tree.items()):
        if isinstance(value, np.ndarray):
            value[...] = 1
        elif isinstance(value, dict):
            scribble(value)
        else:
            tree[key] = 1.0


def test_scribbling_over_what_was_returned_changes_nothing_later():
    fields = {"standoff_m": 5e3, "reward_information_gain": 1.0}  # the gain looks back at the last step's figures
    env, twin = (make("passive/TwoStation-v0", fields) for _ in range(2))
    observation, info = env.reset(seed=2)
    twin.reset(seed=2)
    for k in range(6):
        observation[...] = 1.0
        scribble(info)
        action = np.array([0.3, -0.1 * k])
        observation, reward, _, _, info = env.step(action)
        action[...] = 0.0  # nor does the environment keep the user's action array
        expected = twin.step(np.array([0.3, -0.1 * k]))
        assert np.array_equal(observation, expected[0])
        assert reward == expected[1]
        assert same(info, expected[4])
