"""Training on drawn and recorded courses side by side."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from agents.mixture import JoinedVecEnv, recorded_environments
from agents.sb3 import Sb3VecEnv
from agents.training import plan, train, training_env
from passive_env.vector_env import PassiveVectorEnv

STEPS = 6


def part(envs: int, **fields) -> Sb3VecEnv:
    return Sb3VecEnv(PassiveVectorEnv("Ownship", num_envs=envs, autoreset_mode="same_step", steps=STEPS, **fields))


def mixed_run(folder, **fields):
    run = plan("Ownship", folder, timesteps=2 * 8 * 60, envs=8, fields=fields)
    preset = {name: value for name, value in run.preset.items() if name != "imitation"}
    return dataclasses.replace(run, preset=preset | {"flights_share": 0.25})


def test_joined_environments_fly_as_their_parts_alone():
    joined = JoinedVecEnv([part(3), part(2, course="flights")])
    alone = [part(3), part(2, course="flights")]
    joined.seed(700)
    alone[0].seed(700)
    alone[1].seed(703)
    rng = np.random.default_rng(0)
    seen = joined.reset()
    np.testing.assert_array_equal(seen, np.concatenate([each.reset() for each in alone]))
    for step in range(2 * STEPS + 1):  # past two resets
        actions = rng.uniform(-1.0, 1.0, (5, *joined.action_space.shape)).astype(np.float32)
        ours = joined.step(actions)
        theirs = [alone[0].step(actions[:3]), alone[1].step(actions[3:])]
        for i in range(3):
            np.testing.assert_array_equal(ours[i], np.concatenate([each[i] for each in theirs]))
        infos = [info for each in theirs for info in each[3]]
        assert [info.keys() for info in ours[3]] == [info.keys() for info in infos]
        assert all("episode" in info for info in ours[3]) == ((step + 1) % STEPS == 0)
        for mine, other in zip(ours[3], infos, strict=True):
            if mine:
                np.testing.assert_array_equal(mine["terminal_observation"], other["terminal_observation"])


def test_every_sub_environment_answers_for_its_own_part():
    joined = JoinedVecEnv([part(3), part(2, course="flights")])
    courses = [scenario.course for scenario in joined.get_attr("scenario")]
    assert courses == ["random"] * 3 + ["flights"] * 2
    assert [scenario.course for scenario in joined.get_attr("scenario", [4, 0])] == ["flights", "random"]
    joined.seed(1)
    joined.reset()
    beliefs = joined.env_method("belief", indices=[2, 3])
    assert [len(belief.platforms) for belief in beliefs] == [3, 2]
    assert joined.env_is_wrapped(object) == [False] * 5
    joined.close()


def test_parts_that_differ_are_refused():
    with pytest.raises(ValueError, match="spaces differ"):
        JoinedVecEnv([part(2), part(2, actions="discrete")])
    with pytest.raises(ValueError, match="at least one"):
        JoinedVecEnv([])


@pytest.mark.parametrize(("envs", "share", "count"), [(256, 0.5, 128), (8, 0.25, 2), (2, 0.01, 1), (2, 0.99, 1)])
def test_both_kinds_of_courses_are_always_there(envs, share, count):
    assert recorded_environments(envs, share) == count


@pytest.mark.parametrize(("envs", "share", "word"), [(8, 0.0, "flights_share"), (8, 1.0, "share"), (1, 0.5, "--envs")])
def test_shares_that_make_no_mixture_are_refused(envs, share, word):
    with pytest.raises(ValueError, match=word):
        recorded_environments(envs, share)


def test_a_preset_with_a_share_trains_on_both(tmp_path):
    run = mixed_run(tmp_path / "run")
    env = training_env(run)
    courses = [(scenario.course, scenario.flight_split) for scenario in env.get_attr("scenario")]
    assert courses[:6] == [("random", "train")] * 6
    assert courses[6:] == [("flights", "train")] * 2  # the aircraft held out stay out
    assert train(run, progress=False).is_file()
    train(run, resume=True, progress=False)


def test_a_course_of_the_users_own_is_not_mixed(tmp_path):
    env = training_env(mixed_run(tmp_path / "run", course="flights"))
    assert {scenario.course for scenario in env.get_attr("scenario")} == {"flights"}
