"""Pictures of evaluations: what they show, labels that do not overlap, values a report can bring."""

from itertools import pairwise

import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import to_hex
from matplotlib.figure import Figure
from matplotlib.text import Text

from agents.pictures import LABEL_GAP, EpisodePaths, geometry, range_error_over_time, ratio_chart, reward_curve
from passive_env.palette import BAD, GOOD, MUTED, SERIES

TIME_S = np.arange(46) * 2.0


def pixels(figure: Figure) -> np.ndarray:
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    return np.array(canvas.buffer_rgba())[..., :3]


def assert_is_picture(figure: Figure) -> np.ndarray:
    assert isinstance(figure, Figure)
    picture = pixels(figure)
    assert 0.4 < (picture == 255).all(-1).mean() < 0.99
    return picture


def decay(final_m: float) -> np.ndarray:
    return final_m + 30e3 * np.exp(-TIME_S / 15.0)


def episode(turn: float = 0.0, far: bool = False) -> EpisodePaths:
    """Two stations that turn apart, three targets that come nearer; track 0 may be far off."""
    t = TIME_S[:, None, None]
    headings = np.array([0.8 + turn, 0.8 - turn])
    stations = np.array([[-1e4, 0.0], [3e3, 3e3]]) + 250.0 * t * np.stack([np.cos(headings), np.sin(headings)], axis=-1)
    targets = np.array([[50e3, 53e3], [45e3, 60e3], [58e3, 46e3]]) - 250.0 * t * np.array([0.7, 0.72])
    estimates = targets + np.array([300.0, 900.0])
    estimates[:, 0] += 150e3 * far
    cov = np.tile(np.array([[9e6, 4e6], [4e6, 3e6]]), (3, 1, 1))
    return EpisodePaths(stations, targets, estimates, cov, np.full((46, 3), 1000.0 + 2000.0 * turn))


# ------------------------------------------------------------------------------------------------ range error over time


def test_range_error_names_every_policy_with_its_final_error():
    figure = range_error_over_time(TIME_S, {"rule": decay(2e3), "learned": decay(1.5e3)}, {"rule": decay(1e3)}, "Title")
    assert_is_picture(figure)
    axes = figure.axes[0]
    assert [text.get_text() for text in axes.texts] == ["learned, 1.57 km", "rule, 2.07 km"]
    assert axes.get_yscale() == "log"
    assert [line.get_color() for line in axes.lines] == [SERIES[0], SERIES[0], SERIES[1]]
    assert axes.lines[0].get_ydata()[0] == pytest.approx(32.0)


def test_labels_of_equal_curves_stand_apart():
    curves = {f"policy {i}": decay(2e3 + i) for i in range(6)}
    figure = range_error_over_time(TIME_S, curves, None, "Title")
    heights = np.sort([text.xyann[1] for text in figure.axes[0].texts])
    assert (np.diff(heights) > LABEL_GAP - 1e-9).all()
    picture = assert_is_picture(figure)
    boxes = sorted((Text.get_window_extent(text) for text in figure.axes[0].texts), key=lambda box: box.y0)
    assert all(box.x0 >= 0 and box.x1 <= picture.shape[1] for box in boxes)
    assert all(lower.y1 <= upper.y0 for lower, upper in pairwise(boxes))


def test_a_curve_that_ends_in_nan_is_still_drawn():
    broken = decay(2e3)
    broken[30:] = np.nan
    assert_is_picture(range_error_over_time(TIME_S, {"sound": decay(1e3), "broken": broken}, None, "Title"))


@pytest.mark.parametrize(
    ("curves", "bound", "message"),
    [
        ({}, None, "at least one policy"),
        ({"a": decay(1e3)[:-1]}, None, r"curves\['a'\] has shape \(45,\)"),
        ({"a": decay(1e3)}, {"b": decay(1e3)}, r"bound\['b'\]: no such policy"),
        ({"a": decay(1e3)}, {"a": decay(1e3)[1:]}, r"bound\['a'\] has shape"),
    ],
)
def test_range_error_says_what_is_wrong(curves, bound, message):
    with pytest.raises(ValueError, match=message):
        range_error_over_time(TIME_S, curves, bound, "Title")


# ------------------------------------------------------------------------------------------------ geometry


@pytest.mark.parametrize("count", [1, 2, 3, 4, 5, 6])
def test_geometry_has_one_panel_per_policy_on_the_same_axes(count):
    figure = geometry({f"policy {i}": episode(0.1 * i) for i in range(count)}, "Title")
    assert len(figure.axes) == count
    assert len({(axes.get_xlim(), axes.get_ylim()) for axes in figure.axes}) == 1
    assert (
        figure.axes[-1].get_title()
        == f"policy {count - 1}\nmean range error at the end {1.0 + 0.2 * (count - 1):.2f} km"
    )


def test_geometry_is_a_picture_that_differs_between_policies():
    straight, apart = (assert_is_picture(geometry({"x": episode(turn)}, "T")) for turn in (0.0, 0.5))
    assert (straight != apart).any()


def test_an_estimate_far_off_changes_no_axes():
    near, far = (geometry({"x": episode(far=far)}, "Title") for far in (False, True))
    assert near.axes[0].get_xlim() == far.axes[0].get_xlim()
    low, high = far.axes[0].get_xlim()
    rings = [line for line in far.axes[0].lines if line.get_markerfacecolor() == "none"]
    assert len(rings) == 3
    assert all(low < line.get_xdata()[0] < high for line in rings)
    assert_is_picture(far)


def test_geometry_of_one_instant():
    at_start = EpisodePaths(*(part[:1] for part in episode()[:3]), episode().final_cov, episode().range_error_m[:1])
    assert_is_picture(geometry({"x": at_start}, "Title"))


def test_geometry_needs_a_policy():
    with pytest.raises(ValueError, match="at least one policy"):
        geometry({}, "Title")


# ------------------------------------------------------------------------------------------------ training, ratios


@pytest.mark.parametrize("points", [1, 2, 200])
def test_reward_curve(points):
    steps = np.arange(1, points + 1) * 10_000
    mean = -50.0 / np.sqrt(np.arange(1, points + 1))
    figure = reward_curve(steps, mean, mean - 2.0, mean + 3.0)
    assert_is_picture(figure)
    assert np.array_equal(figure.axes[0].lines[0].get_ydata(), mean)


@pytest.mark.parametrize("lengths", [(0, 0, 0, 0), (3, 3, 2, 3)])
def test_reward_curve_refuses_unequal_or_empty_arrays(lengths):
    with pytest.raises(ValueError, match="same length"):
        reward_curve(*(np.zeros(n) for n in lengths))


def test_ratio_bars_start_at_the_baseline_and_tell_better_from_worse():
    ratios = {"better": (0.6, 0.5, 0.7), "worse": (1.4, 1.2, 1.6), "unclear": (0.9, 0.7, 1.1)}
    figure = ratio_chart(ratios, "Title")
    assert_is_picture(figure)
    bars = figure.axes[0].patches
    assert [to_hex(bar.get_facecolor()).upper() for bar in bars] == [GOOD, BAD, MUTED]
    assert [bar.get_x() for bar in bars] == [1.0, 1.0, 1.0]
    assert np.allclose([bar.get_width() for bar in bars], [-0.4, 0.4, -0.1])
    assert figure.axes[0].texts[0].get_text() == "0.60  [0.50, 0.70]"
    heights = [bar.get_y() for bar in bars]
    assert heights == sorted(heights, reverse=True)


def test_a_ratio_without_a_finite_interval_is_drawn():
    figure = ratio_chart({"baseline itself": (1.0, np.nan, np.nan), "unbounded": (2.0, 0.5, np.inf)}, "Title")
    assert_is_picture(figure)
    assert [text.get_text() for text in figure.axes[0].texts] == ["1.00", "2.00  [0.50, inf]"]


@pytest.mark.parametrize("ratios", [{}, {"a": (0.0, 0.0, 0.1)}, {"a": (np.nan, 0.1, 0.2)}])
def test_ratio_chart_says_what_is_wrong(ratios):
    with pytest.raises(ValueError, match="ratio"):
        ratio_chart(ratios, "Title")
