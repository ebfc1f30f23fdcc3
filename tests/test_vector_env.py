"""The vector environment equals single environments, bit for bit, in every autoreset mode and at every width.

The oracle is Gymnasium's own `SyncVectorEnv` over single environments: it defines what the autoreset modes mean.
"""

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode, SyncVectorEnv

from passive_env import PassiveEnv, PassiveVectorEnv
from passive_env.catalogue import SCENARIOS
from passive_env.core import map_rows

MODES = (AutoresetMode.NEXT_STEP, AutoresetMode.SAME_STEP, AutoresetMode.DISABLED)
WIDTHS = (1, 3, 300)  # 300 crosses the border between two blocks
ROUGH = {
    "steps": 5,
    "detection_probability": 0.8,
    "false_bearings_mean": 1.0,
    "standoff_m": 6e4,
    "reward_maneuver": 0.5,
}
over_modes = pytest.mark.parametrize("mode", MODES, ids=lambda mode: mode.name)


def oracle(num_envs, mode, **fields) -> SyncVectorEnv:
    return SyncVectorEnv([lambda: PassiveEnv(**fields) for _ in range(num_envs)], autoreset_mode=mode)


def assert_same_info(ours, theirs, rows=slice(None)):
    """Every entry of an oracle's info stands in ours, equal in the rows it speaks of."""
    for name, value in theirs.items():
        if name.startswith("_"):
            continue
        mask = theirs[f"_{name}"]
        assert np.array_equal(ours[f"_{name}"][mask], mask[mask]), name
        if isinstance(value, dict):
            assert_same_nested(ours[name], value, mask)
        else:
            assert np.array_equal(ours[name][mask], np.stack(list(value[mask])) if mask.any() else value[mask]), name


def assert_same_nested(ours, theirs, mask):
    for name, value in theirs.items():
        if name.startswith("_"):
            continue
        if isinstance(value, dict):
            assert_same_nested(ours[name], value, mask)
        else:
            assert np.array_equal(ours[name][mask], value[mask]), name


def assert_same_step(ours, theirs):
    for got, expected in zip(ours[:4], theirs[:4], strict=True):
        assert got.dtype == expected.dtype
        assert np.array_equal(got, expected)
    assert set(ours[4]) == set(theirs[4])
    assert_same_info(ours[4], theirs[4])


def random_actions(env, seed, count):
    rng = np.random.default_rng(seed)
    shape = (count, env.num_envs, *env.single_action_space.shape)
    if isinstance(env.single_action_space, gym.spaces.MultiDiscrete):
        return rng.integers(0, 3, shape)
    return rng.uniform(-1.0, 1.0, shape).astype(np.float32)


def assert_same_flights(ours, theirs, seed, calls):
    """Step both by the same random actions; DISABLED resets by hand when the episodes are over."""
    assert_same_reset(ours.reset(seed=seed), theirs.reset(seed=seed))
    for action in random_actions(ours, seed, calls):
        step, expected = ours.step(action), theirs.step(action)
        assert_same_step(step, expected)
        if ours.autoreset_mode == AutoresetMode.DISABLED and step[3].any():
            assert_same_reset(
                ours.reset(options={"reset_mask": step[3]}), theirs.reset(options={"reset_mask": step[3]})
            )


def assert_same_reset(ours, theirs):
    assert np.array_equal(ours[0], theirs[0])
    assert_same_info(ours[1], theirs[1])


# ------------------------------------------------------------------------------------------------ single = vector


@over_modes
@pytest.mark.parametrize("num_envs", WIDTHS)
def test_vector_equals_singles_over_two_episodes(num_envs, mode):
    ours = PassiveVectorEnv(num_envs=num_envs, autoreset_mode=mode, threads=2, **ROUGH)
    assert_same_flights(ours, oracle(num_envs, mode, **ROUGH), seed=11, calls=13)


@pytest.mark.parametrize(
    "fields",
    [
        {},
        {"course": "flights"},
        {"course": "paper", "bearings": "reference"},
        {"tracker": "fused_ekf", "detection_probability": 0.9},
        {"actions": "discrete", "targets": 5, "false_bearings_mean": 0.5},
        {"scenario": "Ownship", "steps": 30, "detection_probability": 0.9},
        {"scenario": "AngleFusion"},
        {"scenario": "AngleFusionClutter", "detection_probability": 0.9},
        {"scenario": "AngleFusionSlow", "course": "flights", "actions": "discrete"},
        {"scenario": "OwnshipManeuvering", "steps": 30, "nogo_discs": 2, "targets": 2, "false_bearings_mean": 0.5},
    ],
    ids=str,
)
def test_vector_equals_singles_over_whole_default_episodes(fields):
    assert_same_flights(
        PassiveVectorEnv(num_envs=3, **fields), oracle(3, AutoresetMode.NEXT_STEP, **fields), seed=2, calls=93
    )


@over_modes
@pytest.mark.parametrize("name", list(SCENARIOS))
def test_every_registered_scenario_vectorises(name, mode):
    single = lambda: PassiveEnv(name, steps=4)  # noqa: E731
    theirs = SyncVectorEnv([single] * 2, autoreset_mode=mode)
    assert_same_flights(PassiveVectorEnv(name, num_envs=2, autoreset_mode=mode, steps=4), theirs, seed=0, calls=9)


def test_sub_environments_do_not_depend_on_the_width_of_the_batch():
    wide, narrow = (PassiveVectorEnv(num_envs=n, autoreset_mode="same_step", **ROUGH) for n in (300, 7))
    first, second = wide.reset(seed=40), narrow.reset(seed=40)
    actions = random_actions(wide, 1, 8)
    for action in actions:
        assert np.array_equal(first[0][:7], second[0])
        first, second = wide.step(action), narrow.step(action[:7])
        assert np.array_equal(first[1][:7], second[1])
        assert np.array_equal(first[4]["nees"][:7], second[4]["nees"])


@over_modes
def test_threads_change_nothing(mode):
    one, two = (PassiveVectorEnv(num_envs=1100, autoreset_mode=mode, threads=threads, **ROUGH) for threads in (1, 2))
    assert len(one.blocks.slices) == 3
    assert len(two.blocks.slices) == 4
    assert (one.blocks.threads, two.blocks.threads) == (1, 2)
    assert_same_reset(one.reset(seed=3), two.reset(seed=3))
    for action in random_actions(one, 3, 5 if mode == AutoresetMode.DISABLED else 8):
        assert_same_step(one.step(action), two.step(action))


def test_belief_and_world_of_a_batch_are_those_of_its_singles():
    env = PassiveVectorEnv(num_envs=300, **ROUGH)
    env.reset(seed=6)
    action = random_actions(env, 6, 1)[0]
    env.step(action)
    for row in (0, 149, 150, 299):
        single = PassiveEnv(**ROUGH)
        single.reset(seed=6 + row)
        single.step(action[row])
        map_rows(
            lambda a, b, row=row: np.testing.assert_array_equal(np.asarray(a)[row], np.asarray(b)[0]),
            (env.belief(), env.world.tape, env.world.truth),
            (single.belief(), single.world.tape, single.world.truth),
        )


@over_modes
def test_the_world_is_that_of_all_blocks_at_every_instant_whenever_it_was_last_asked_for(mode):
    env = PassiveVectorEnv(num_envs=300, autoreset_mode=mode, steps=2, targets=1)

    def check():
        assert len(env._worlds) == 2
        expected = map_rows(lambda *parts: np.concatenate(parts), *env._worlds)
        map_rows(np.testing.assert_array_equal, env.world, expected)
        assert env.world is env.world
        assert np.array_equal(env.belief().mean, expected.estimate.mean)

    env.reset(seed=6)
    check()
    tape = env.world.tape
    for k in range(7):
        if mode == AutoresetMode.DISABLED and env._done.any():
            for some in (np.arange(300) < 20, np.arange(300) >= 20):
                env.reset(options={"reset_mask": some})
                check()
        env.step(np.zeros((300, env.single_action_space.shape[0])))
        if k not in (2, 3):
            check()
    assert env.world.tape is not tape


# ------------------------------------------------------------------------------------------------ autoreset modes


def test_next_step_ignores_the_action_and_gives_no_reward():
    env, twin = (PassiveVectorEnv(num_envs=3, autoreset_mode="next_step", steps=2) for _ in range(2))
    for e in (env, twin):
        e.reset(seed=0)
        e.step(np.zeros((3, 2)))
        assert e.step(np.zeros((3, 2)))[3].all()
    first, second = env.step(np.full((3, 2), 0.7)), twin.step(np.full((3, 2), -0.7))
    assert_same_step(first, second)
    assert np.array_equal(first[1], np.zeros(3))
    assert not first[3].any()
    assert np.array_equal(first[4]["reward_terms"]["log_range_error"], np.zeros(3))
    names = [field.name for field in env.observation_fields]
    assert np.array_equal(first[0][:, names.index("time_left")], np.ones(3))
    assert np.array_equal(first[0][:, names.index("last_action0")], np.zeros(3))


def test_same_step_gives_the_new_episodes_start_and_the_old_ones_end():
    env = PassiveVectorEnv(num_envs=3, autoreset_mode="same_step", steps=2)
    last = PassiveVectorEnv(num_envs=3, autoreset_mode="disabled", steps=2)
    for e in (env, last):
        e.reset(seed=0)
        assert "final_obs" not in e.step(np.full((3, 2), 0.5))[4]
    observation, reward, _, truncated, info = env.step(np.full((3, 2), -0.5))
    end = last.step(np.full((3, 2), -0.5))
    start = last.reset()  # no seed: the generators go on
    assert truncated.all()
    assert np.array_equal(info["final_obs"], end[0])
    assert np.array_equal(reward, end[1])
    assert np.array_equal(observation, start[0])
    for name in ("range_error_m", "nees", "lost", "range_crlb_m"):
        assert np.array_equal(info["final_info"][name], end[4][name]), name
        assert np.array_equal(info[name], start[1][name]), name
    assert np.array_equal(info["final_info"]["reward_terms"]["log_range_error"], reward)
    assert np.array_equal(info["reward_terms"]["log_range_error"], np.zeros(3))
    assert np.array_equal(info["_final_obs"], truncated)
    assert np.array_equal(info["_final_info"], truncated)


def test_disabled_refuses_to_step_a_finished_episode():
    env = PassiveVectorEnv(num_envs=2, autoreset_mode="disabled", steps=1)
    env.reset(seed=0)
    env.step(np.zeros((2, 2)))
    with pytest.raises(gym.error.ResetNeeded, match="reset_mask"):
        env.step(np.zeros((2, 2)))
    env.reset(options={"reset_mask": np.array([True, False])})
    with pytest.raises(gym.error.ResetNeeded, match="reset_mask"):
        env.step(np.zeros((2, 2)))
    env.reset(options={"reset_mask": np.array([False, True])})
    env.step(np.zeros((2, 2)))


@over_modes
@pytest.mark.parametrize("num_envs", [3, 300])
def test_reset_mask_begins_some_episodes_only_and_they_then_end_at_different_times(num_envs, mode):
    fields = {**ROUGH, "steps": 4}
    ours, theirs = PassiveVectorEnv(num_envs=num_envs, autoreset_mode=mode, **fields), oracle(num_envs, mode, **fields)
    actions = random_actions(ours, 5, 12)
    assert_same_reset(ours.reset(seed=5), theirs.reset(seed=5))
    for action in actions[:2]:
        assert_same_step(ours.step(action), theirs.step(action))
    mask = np.arange(num_envs) % 3 == 1
    assert_same_reset(ours.reset(options={"reset_mask": mask}), theirs.reset(options={"reset_mask": mask}))
    for action in actions[2:]:
        step, expected = ours.step(action), theirs.step(action)
        assert_same_step(step, expected)
        done = step[3]
        assert not (done.any() and done.all())  # the episodes stay out of step
        if mode == AutoresetMode.DISABLED and done.any():
            assert_same_reset(ours.reset(options={"reset_mask": done}), theirs.reset(options={"reset_mask": done}))


def test_reset_mask_with_a_seed_seeds_the_chosen_rows_only():
    env = PassiveVectorEnv(num_envs=3, autoreset_mode="disabled", steps=3)
    before, _ = env.reset(seed=0)
    after, _ = env.reset(seed=20, options={"reset_mask": np.array([False, True, False])})
    assert np.array_equal(after[[0, 2]], before[[0, 2]])
    assert np.array_equal(after[1], PassiveEnv(steps=3).reset(seed=21)[0])


# ------------------------------------------------------------------------------------------------ seeds


def test_a_list_of_seeds_seeds_each_sub_environment():
    env = PassiveVectorEnv(num_envs=3, steps=3)
    observation, _ = env.reset(seed=[7, 3, 7])
    assert np.array_equal(observation[0], observation[2])
    for row, seed in enumerate((7, 3, 7)):
        assert np.array_equal(observation[row], PassiveEnv(steps=3).reset(seed=seed)[0])


def test_none_in_a_list_of_seeds_leaves_that_generator_going_on():
    env, twin = (PassiveVectorEnv(num_envs=2, steps=3) for _ in range(2))
    env.reset(seed=4), twin.reset(seed=4)
    mixed, _ = env.reset(seed=[9, None])
    assert np.array_equal(mixed[0], PassiveEnv(steps=3).reset(seed=9)[0])
    assert np.array_equal(mixed[1], twin.reset()[0][1])


def test_without_any_seed_episodes_differ_between_environments_and_runs():
    env, other = (PassiveVectorEnv(num_envs=2, steps=3) for _ in range(2))
    first, second = env.reset()[0], other.reset()[0]
    assert not np.array_equal(first[0], first[1])
    assert not np.array_equal(first, second)


# ------------------------------------------------------------------------------------------------ bad input


@pytest.mark.parametrize("num_envs", [0, -1, 2.0, "2", None])
def test_bad_num_envs(num_envs):
    with pytest.raises(ValueError, match="num_envs"):
        PassiveVectorEnv(num_envs=num_envs)


@pytest.mark.parametrize("threads", [0, -1, 1.5, "2"])
def test_bad_threads(threads):
    with pytest.raises(ValueError, match="threads"):
        PassiveVectorEnv(num_envs=600, threads=threads)


@pytest.mark.parametrize("mode", ["sometimes", "", 3, None])
def test_unknown_autoreset_mode_names_the_known_ones(mode):
    with pytest.raises(ValueError, match="NEXT_STEP, SAME_STEP, DISABLED"):
        PassiveVectorEnv(num_envs=2, autoreset_mode=mode)


@pytest.mark.parametrize("mode", [AutoresetMode.SAME_STEP, "SAME_STEP", "same_step", "SameStep"])
def test_autoreset_mode_by_member_name_or_value(mode):
    env = PassiveVectorEnv(num_envs=2, autoreset_mode=mode)
    assert env.metadata["autoreset_mode"] is AutoresetMode.SAME_STEP
    assert "autoreset_mode" not in PassiveVectorEnv.metadata


@pytest.mark.parametrize("seed", [[1, 2], [1, 2, 3, 4], [1, -2, 3], [1, 2.5, 3], -1, 1.5, "7"], ids=str)
def test_bad_seeds_are_errors_and_change_nothing(seed):
    env, twin = (PassiveVectorEnv(num_envs=3, steps=3) for _ in range(2))
    env.reset(seed=0), twin.reset(seed=0)
    with pytest.raises((ValueError, TypeError, gym.error.Error), match=r"(?i)seed"):
        env.reset(seed=seed)
    assert np.array_equal(env.step(np.zeros((3, 2)))[0], twin.step(np.zeros((3, 2)))[0])
    assert np.array_equal(env.reset()[0], twin.reset()[0])


@pytest.mark.parametrize(
    "mask",
    [
        [True, False, True],
        np.array([1, 0, 1]),
        np.array([True, False]),
        np.array([[True], [False], [True]]),
        np.zeros(3, dtype=bool),
    ],
    ids=repr,
)
def test_bad_reset_mask_is_an_error_and_changes_nothing(mask):
    env, twin = (PassiveVectorEnv(num_envs=3, steps=3) for _ in range(2))
    env.reset(seed=0), twin.reset(seed=0)
    with pytest.raises(ValueError, match="reset_mask"):
        env.reset(seed=8, options={"reset_mask": mask})
    assert np.array_equal(env.step(np.zeros((3, 2)))[0], twin.step(np.zeros((3, 2)))[0])
    assert np.array_equal(env.reset()[0], twin.reset()[0])


def test_first_reset_must_begin_all_episodes():
    env = PassiveVectorEnv(num_envs=2)
    with pytest.raises(gym.error.ResetNeeded, match="reset_mask"):
        env.reset(options={"reset_mask": np.array([True, False])})


@pytest.mark.parametrize(
    "action", [np.zeros((2, 2)), np.zeros(2), np.full((3, 2), np.nan), None], ids=["rows", "flat", "nan", "none"]
)
def test_bad_actions(action):
    env = PassiveVectorEnv(num_envs=3)
    env.reset(seed=0)
    with pytest.raises(ValueError, match="action"):
        env.step(action)


# ------------------------------------------------------------------------------------------------ ownership


def test_returned_arrays_are_the_users_own():
    env, twin = (PassiveVectorEnv(num_envs=3, autoreset_mode="same_step", steps=2) for _ in range(2))
    given = env.reset(seed=0)
    expected = twin.reset(seed=0)
    for k in range(5):
        for value in (given[0], *given[1:-1], *(v for v in given[-1].values() if isinstance(v, np.ndarray))):
            value[...] = 1
        given, expected = (e.step(np.full((3, 2), 0.1 * k)) for e in (env, twin))
        assert_same_step(given, expected)


def test_make_vec_takes_max_episode_steps_and_modes():
    env = gym.make_vec("passive/TwoStation-v0", num_envs=2, max_episode_steps=3, autoreset_mode="same_step", targets=2)
    assert env.metadata["autoreset_mode"] is AutoresetMode.SAME_STEP
    env.reset(seed=0)
    ends = [env.step(env.action_space.sample())[3].tolist() for _ in range(6)]
    assert ends == [[False, False], [False, False], [True, True]] * 2
