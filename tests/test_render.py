"""Pictures of episodes: content, trails, axes that hold still, trackers of any kind, machines without a display."""

import os
import subprocess
import sys
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
import pytest

from passive_env import PassiveEnv, PassiveVectorEnv
from passive_env.artists import Frame, edge_points, ellipses, grow, kilometres, metres
from passive_env.layers import ELLIPSE_STD
from passive_env.render import Trail, Viewer, hypotheses_of
from trackers import Bank, FusedEkf

SHAPE = (800, 800, 3)
APART = np.array([0.6, -0.6], dtype=np.float32)


def make(**fields) -> PassiveEnv:
    return PassiveEnv(render_mode="rgb_array", **fields)


def flown(decisions, seed=0, **fields) -> PassiveEnv:
    env = make(**fields)
    env.reset(seed=seed)
    for _ in range(decisions):
        env.step(APART)
    return env


def assert_is_picture(picture):
    assert picture.shape == SHAPE
    assert picture.dtype == np.uint8
    share_white = (picture == 255).all(-1).mean()
    assert 0.5 < share_white < 0.99
    assert len(np.unique(picture.reshape(-1, 3), axis=0)) > 50


def changed(a, b) -> float:
    """Share of pixels that differ."""
    return (a != b).any(-1).mean()


# ------------------------------------------------------------------------------------------------ whole pictures


def test_a_whole_episode_renders_and_every_picture_is_new():
    env = gym.make("passive/TwoStation-v0", render_mode="rgb_array", steps=12)
    env.reset(seed=3)
    pictures = [env.render()]
    while not env.step(APART)[3]:
        pictures.append(env.render())
    pictures.append(env.render())
    for picture in pictures:
        assert_is_picture(picture)
    assert len({picture.tobytes() for picture in pictures}) == 13


@pytest.mark.parametrize(
    "fields",
    [{"course": "paper"}, {"tracker": "fused_ekf"}, {"targets": 1}, {"targets": 6}, {"hypotheses": 1}, {"steps": 1}],
    ids=str,
)
def test_variants_render(fields):
    env = flown(1, **fields)
    assert_is_picture(env.render())


def test_missed_and_false_bearings_render():
    env = flown(3, detection_probability=0.5, false_bearings_mean=2.0)
    assert_is_picture(env.render())


def test_same_seed_gives_the_same_picture_and_another_seed_another():
    first, again, other = (flown(4, seed=seed).render() for seed in (5, 5, 6))
    assert np.array_equal(first, again)
    assert changed(first, other) > 0.01


def test_drawing_a_step_twice_changes_nothing_and_pictures_share_no_memory():
    env = flown(2)
    first = env.render()
    kept = first.copy()
    assert np.array_equal(env.render(), first)
    env.step(APART)
    env.render()
    assert np.array_equal(first, kept)


def test_rendering_may_begin_in_the_middle():
    assert_is_picture(flown(5).render())


def test_render_after_close_begins_anew():
    env = flown(2)
    first = env.render()
    env.close()
    assert np.array_equal(env.render(), first)


# ------------------------------------------------------------------------------------------------ trackers of a user


class OwnState(NamedTuple):
    """A state that no picture knows."""

    tracks: Any


class OwnTracker:
    """The fused EKF with a state of its own type."""

    def __init__(self):
        self.ekf = FusedEkf()

    def initiate(self, scan):
        return OwnState(self.ekf.initiate(scan))

    def predict(self, state, step_s):
        return OwnState(self.ekf.predict(state.tracks, step_s))

    def update(self, state, scan):
        update = self.ekf.update(state.tracks, scan)
        return update._replace(posterior=OwnState(update.posterior))

    def estimate(self, state):
        return self.ekf.estimate(state.tracks)


def test_a_tracker_whose_state_is_no_bank_gives_the_picture_of_the_same_filter():
    own, same = flown(4, tracker=OwnTracker()), flown(4, tracker="fused_ekf")
    assert hypotheses_of(own.world.track_state) is None
    assert np.array_equal(own.render(), same.render())


def test_hypotheses_are_shown_and_vanish_with_them():
    env = flown(1, course="paper")
    with_bank = env.render()
    env._world = env.world._replace(track_state=())
    without = env.render()
    assert changed(with_bank, without) > 1e-3
    assert np.array_equal(without, Viewer(env.simulation, "rgb_array").draw(env.world))


def test_hypotheses_are_those_of_the_bank():
    rng = np.random.default_rng(0)
    bank = Bank(
        rng.normal(size=(1, 3, 5, 4)), rng.normal(size=(1, 3, 5, 4, 4)), np.log(rng.dirichlet(np.ones(5), (1, 3)))
    )
    found = hypotheses_of(bank)
    assert found is not None
    assert np.array_equal(found.position[2, 4], bank.mean[0, 2, 4, :2])
    assert np.allclose(found.weight.sum(-1), 1.0)
    for state in ((), bank._replace(log_weights=bank.log_weights[0]), bank._replace(mean=bank.mean[..., :2])):
        assert hypotheses_of(state) is None


# ------------------------------------------------------------------------------------------------ trails


def test_the_trail_is_cleared_by_reset():
    env = make(course="paper")
    env.reset(seed=1)
    first = env.render()
    for _ in range(6):
        env.step(APART)
        env.render()
    env.reset(seed=1)
    assert np.array_equal(env.render(), first)


def test_the_trail_holds_every_step_once_and_forgets_what_a_new_episode_does_not_know():
    env = make()
    env.reset(seed=0)
    worlds = [env.world]
    for _ in range(3):
        env.step(APART)
        worlds.append(env.world)
    truth = np.stack([world.platforms[0, :, :2] for world in worlds], axis=1)
    trail = Trail()
    assert [trail.add(world) for world in (*worlds, worlds[3])] == [True, False, False, False, False]
    assert np.array_equal(trail.paths, truth)
    trail.add(worlds[1])
    assert np.array_equal(trail.paths, truth[:, :2])
    env.reset(seed=1)
    env.step(APART)
    assert trail.add(env.world)
    assert trail.paths.shape == (2, 1, 2)


def test_a_trail_is_drawn_through_every_step_seen():
    env = make(course="paper")
    env.reset(seed=0)
    seldom = Viewer(env.simulation, "rgb_array")
    seldom.draw(env.world)
    for _ in range(8):
        env.render()
        env.step(APART)
    bent, straight = env.render(), seldom.draw(env.world)
    assert 1e-4 < changed(bent, straight) < 0.01


# ------------------------------------------------------------------------------------------------ axes


def test_axes_grow_and_never_shrink_or_move_otherwise():
    frame = grow(None, np.array([[0.0, 0.0], [10.0, 20.0]]), 1.0)
    assert np.allclose(frame.low, [-7.0, -2.0])  # margin 0.1 · 20 on all sides, then 24 × 24 about the middle
    assert np.allclose(frame.high, [17.0, 22.0])
    assert grow(frame, np.array([[-6.0, 21.0]]), 1.0) is frame
    wider = grow(frame, np.array([[30.0, 0.0]]), 1.0)
    assert (wider.low <= frame.low).all()
    assert (wider.high >= frame.high).all()
    assert wider.high[0] > 30.0


def test_axes_keep_the_aspect():
    frame = grow(None, np.array([[0.0, 0.0], [1.0, 50.0]]), 1.25)
    width, height = frame.high - frame.low
    assert width / height == pytest.approx(1.25)


def test_axes_of_a_single_point_are_not_empty():
    frame = grow(None, np.array([[3.0, 4.0]]), 1.0)
    assert (frame.high > frame.low).all()


def test_an_estimate_far_off_leaves_the_picture_as_it_was():
    env = flown(20, course="paper")
    before = env.render()
    world = env.world
    mean = world.estimate.mean.copy()
    mean[0, 0, :2] += 150e3
    env._world = world._replace(estimate=world.estimate._replace(mean=mean))
    assert 1e-4 < changed(before, env.render()) < 0.02


def test_axes_hold_still_through_an_episode_that_stays_in_sight():
    env = make(course="paper")
    env.reset(seed=0)
    tick_labels = {env.render()[:, :60].tobytes()}
    while not env.step(np.zeros(2))[3]:
        tick_labels.add(env.render()[:, :60].tobytes())
    assert len(tick_labels) == 1


def test_a_track_that_is_not_finite_is_left_out():
    env = flown(3, course="paper", tracker="fused_ekf")
    mean, cov = env.world.estimate.mean.copy(), env.world.estimate.cov.copy()
    mean[0, 1], cov[0, 1] = np.nan, np.inf
    env._world = env.world._replace(estimate=env.world.estimate._replace(mean=mean, cov=cov))
    assert_is_picture(env.render())


def test_segments_are_cut_at_the_frame():
    frame = Frame(np.array([0.0, 0.0]), np.array([100.0, 50.0]))
    ends = np.array([[50.0, 25.0], [200.0, 40.0], [20.0, -100.0], [20.0, 10.0]])
    points, cut = edge_points(np.array([20.0, 10.0]), ends, frame)
    # The inset is 2 % of each side: the edge lies at 98 east and at 1 north.
    assert np.allclose(points, [[50.0, 25.0], [98.0, 10.0 + 30.0 * 78.0 / 180.0], [20.0, 1.0], [20.0, 10.0]])
    assert cut.tolist() == [False, True, True, False]


def test_ellipses_lie_two_standard_deviations_off():
    rng = np.random.default_rng(0)
    root = rng.normal(size=(3, 2, 2))
    mean, cov = rng.normal(size=(3, 2)), root @ np.swapaxes(root, -1, -2)
    outline = ellipses(mean, cov)
    assert outline.shape == (3, 65, 2)
    off = outline - mean[:, None]
    assert np.allclose(np.einsum("mki,mij,mkj->mk", off, np.linalg.inv(cov), off), ELLIPSE_STD**2)


def test_distances_read_well():
    assert [kilometres(d) for d in (312.0, 9_994.0, 9_996.0, 42_340.0, 123_456.0)] == [
        "0.31 km", "9.99 km", "10.0 km", "42.3 km", "123 km",
    ]  # fmt: skip
    assert [metres(d) for d in (0.4, 312.0, 999.4, 999.6, 42_340.0)] == ["0 m", "312 m", "999 m", "1.00 km", "42.3 km"]


# ------------------------------------------------------------------------------------------------ vector environment


def test_the_vector_environment_gives_one_picture_per_episode_equal_to_the_single_ones():
    env = PassiveVectorEnv(num_envs=3, render_mode="rgb_array", threads=1)
    env.reset(seed=7)
    pictures = env.render()
    assert isinstance(pictures, tuple)
    for i, picture in enumerate(pictures):
        assert np.array_equal(picture, flown(0, seed=7 + i).render())
    env.step(np.tile(APART, (3, 1)))
    for i, picture in enumerate(env.render()):
        assert np.array_equal(picture, flown(1, seed=7 + i).render())
    env.close()


# ------------------------------------------------------------------------------------------------ pyplot and windows


def run(code: str, **environment: str) -> str:
    """Output of a fresh interpreter without a display."""
    variables = {k: v for k, v in os.environ.items() if k not in ("DISPLAY", "WAYLAND_DISPLAY", "MPLBACKEND")}
    done = subprocess.run(
        [sys.executable, "-c", code], env=variables | environment, capture_output=True, text=True, timeout=300
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_rgb_array_imports_no_pyplot_and_leaves_matplotlib_as_it_was():
    code = """
import sys, matplotlib, gymnasium, passive_env
before = matplotlib.rcParams.copy()
env = gymnasium.make("passive/TwoStation-v0", render_mode="rgb_array")
env.reset(seed=0)
env.render()
print("matplotlib.pyplot" in sys.modules, matplotlib.rcParams.copy() == before)
"""
    assert run(code) == "False True\n"


HUMAN = """
import warnings, gymnasium, passive_env
with warnings.catch_warnings(record=True) as caught:
    warnings.simplefilter("always")
    env = gymnasium.make("passive/TwoStation-v0", render_mode="human").unwrapped
    env.reset(seed=0)
    for _ in range(3):
        env.step(env.action_space.sample())
    shown = env.render()
    env.close()
print(shown, sum("rgb_array" in str(w.message) for w in caught))
"""


@pytest.mark.parametrize(
    "backend", ["agg", pytest.param("tkagg", marks=pytest.mark.skipif(sys.platform != "linux", reason="X11"))]
)
def test_human_without_a_display_warns_once_and_goes_on(backend):
    assert run(HUMAN, MPLBACKEND=backend) == "None 1\n"


def test_gymnasiums_checker_passes_every_render_mode_without_a_display():
    code = """
import gymnasium, passive_env
from gymnasium.utils.env_checker import check_env
check_env(gymnasium.make("passive/TwoStation-v0").unwrapped)
print("passed")
"""
    assert run(code, MPLBACKEND="agg").endswith("passed\n")


WINDOWED = '''
"""A backend that claims to open windows and counts what they are asked to do."""
from matplotlib.backend_bases import FigureManagerBase
from matplotlib.backends.backend_agg import FigureCanvasAgg

CALLS = {"show": 0, "draw": 0}

class FigureManager(FigureManagerBase):
    def show(self):
        CALLS["show"] += 1

class FigureCanvas(FigureCanvasAgg):
    required_interactive_framework = "headless"
    manager_class = FigureManager

    def draw_idle(self):
        CALLS["draw"] += 1
        self.draw()

    def start_event_loop(self, timeout=0):
        pass
'''


def test_human_with_a_display_updates_a_window_until_it_is_closed(tmp_path):
    (tmp_path / "windowed.py").write_text(WINDOWED)
    code = """
import gymnasium, numpy as np, passive_env, windowed
from matplotlib import pyplot
env = gymnasium.make("passive/TwoStation-v0", render_mode="human").unwrapped
env.reset(seed=0)
for _ in range(3):
    env.step(np.zeros(2, dtype=np.float32))
drawn = np.array(pyplot.gcf().canvas.buffer_rgba())[..., :3]
assert drawn.shape == (800, 800, 3) and (drawn != 255).any(-1).mean() > 0.01
print(windowed.CALLS, len(pyplot.get_fignums()))
pyplot.close("all")
env.step(np.zeros(2, dtype=np.float32))
env.close()
print(windowed.CALLS, len(pyplot.get_fignums()))
"""
    out = run(code, MPLBACKEND="module://windowed", PYTHONPATH=str(tmp_path))
    assert out.splitlines() == ["{'show': 4, 'draw': 4} 1", "{'show': 4, 'draw': 4} 0"]
