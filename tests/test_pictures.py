"""Pictures of evaluations: what they show, labels that do not overlap, values a report can bring."""

from itertools import pairwise

import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import to_hex
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.markers import MarkerStyle
from matplotlib.text import Text

from agents.maneuvers import Maneuvers, angle_quantiles_deg, first_side_share, leg_steps, maneuvers
from agents.pictures import (
    LABEL_GAP,
    EpisodePaths,
    error_over_time,
    geometry,
    geometry_cards,
    geometry_legend,
    ratio_chart,
    reward_curve,
)
from passive_env import artists
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
    error = np.full((46, 3), 1000.0 + 2000.0 * turn)
    return EpisodePaths(stations, targets, estimates, cov, error, 0.5 * error)


# ------------------------------------------------------------------------------------------------ range error over time


def test_range_error_names_every_policy_with_its_final_error():
    figure = error_over_time(TIME_S, {"rule": decay(2e3), "learned": decay(1.5e3)}, {"rule": decay(1e3)}, "Title")
    assert_is_picture(figure)
    axes = figure.axes[0]
    assert [text.get_text() for text in axes.texts] == ["learned, 1.57 km", "rule, 2.07 km"]
    assert axes.get_yscale() == "log"
    assert [line.get_color() for line in axes.lines] == [SERIES[0], SERIES[0], SERIES[1]]
    assert axes.lines[0].get_ydata()[0] == pytest.approx(32.0)


def test_labels_of_equal_curves_stand_apart():
    curves = {f"policy {i}": decay(2e3 + i) for i in range(6)}
    figure = error_over_time(TIME_S, curves, None, "Title")
    heights = np.sort([text.xyann[1] for text in figure.axes[0].texts])
    assert (np.diff(heights) > LABEL_GAP - 1e-9).all()
    picture = assert_is_picture(figure)
    boxes = sorted((Text.get_window_extent(text) for text in figure.axes[0].texts), key=lambda box: box.y0)
    assert all(box.x0 >= 0 and box.x1 <= picture.shape[1] for box in boxes)
    assert all(lower.y1 <= upper.y0 for lower, upper in pairwise(boxes))


def test_a_curve_that_ends_in_nan_is_still_drawn():
    broken = decay(2e3)
    broken[30:] = np.nan
    assert_is_picture(error_over_time(TIME_S, {"sound": decay(1e3), "broken": broken}, None, "Title"))


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
        error_over_time(TIME_S, curves, bound, "Title")


# ------------------------------------------------------------------------------------------------ geometry


@pytest.mark.parametrize("count", [1, 2, 5, 7, 9])
def test_geometry_has_a_map_and_a_diagram_per_policy_on_the_same_axes(count):
    figure = geometry(TIME_S, {f"policy {i}": episode(0.1 * i) for i in range(count)}, "Title")
    maps, diagrams = figure.axes[::2], figure.axes[1::2]
    assert len(maps) == len(diagrams) == count
    for panels in (maps, diagrams):
        assert len({(axes.get_xlim(), axes.get_ylim()) for axes in panels}) == 1
    for above, below in zip(maps, diagrams, strict=True):
        assert below.get_position().y1 < above.get_position().y0
        assert below.get_position().x0 == pytest.approx(above.get_position().x0)
    assert maps[-1].get_title() == f"policy {count - 1}: {1.0 + 0.2 * (count - 1):.2f} km off at the end"


@pytest.mark.parametrize("count", [1, 2, 5, 9])
def test_nothing_in_geometry_overlaps(count):
    zones = {"discs": np.array([[30e3, 30e3, 5e3]]), "standoff_m": 10e3}  # the longest legend
    shown = {f"policy {i}": episode(0.1 * i)._replace(**zones) for i in range(count)}
    figure = geometry(TIME_S, shown, "Title")
    assert_is_picture(figure)
    assert_apart(figure)


def assert_apart(figure: Figure) -> None:
    """Axes with their titles and labels, the legends and the figure's title keep clear of each other and the edges."""
    boxes = [axes.get_tightbbox() for axes in figure.axes] + [figure.legends[0].get_window_extent()]
    boxes.append(figure.texts[0].get_window_extent())
    for i, box in enumerate(boxes):
        assert box.x0 >= 0
        assert box.y0 >= 0
        assert box.x1 <= figure.bbox.x1
        assert box.y1 <= figure.bbox.y1
        assert not [other for other in boxes[i + 1 :] if box.overlaps(other)]


def test_error_and_bound_of_every_target_stand_below_its_map():
    shown = episode()._replace(error_m=np.outer(decay(2e3), [1.0, 2.0, 3.0]))
    below = geometry(TIME_S, {"x": shown}, "Title").axes[1]
    errors, bounds = below.lines[::2], below.lines[1::2]
    assert [line.get_color() for line in errors] == [line.get_color() for line in bounds] == list(SERIES[:3])
    assert [line.get_ydata()[-1] for line in errors] == pytest.approx(1e-3 * shown.error_m[-1])
    assert [line.get_ydata()[-1] for line in bounds] == [0.5, 0.5, 0.5]
    assert {line.get_linestyle() for line in errors} == {"-"}
    assert {line.get_linestyle() for line in bounds} == {"--"}


def test_a_perfect_estimate_is_drawn():
    assert_is_picture(geometry(TIME_S, {"x": episode()._replace(error_m=np.zeros((46, 3)))}, "Title"))


def test_zones_are_drawn_and_named_where_there_are_any():
    discs = np.array([[20e3, 300e3, 8e3], [30e3, 30e3, 5e3]])
    plain, zoned = episode(), episode()._replace(discs=discs, standoff_m=10e3)
    without, within = (geometry(TIME_S, {"x": shown}, "Title") for shown in (plain, zoned))
    assert assert_is_picture(without).shape == assert_is_picture(within).shape
    named = [[text.get_text() for text in figure.legends[0].get_texts()] for figure in (without, within)]
    assert set(named[1]) - set(named[0]) == {"no-go disc", "stand-off ring"}
    top = within.axes[0].get_ylim()[1]
    assert without.axes[0].get_ylim()[1] < 308.0 < top
    outlines = [path.vertices for part in within.axes[0].collections for path in part.get_paths()]
    for center, radius in [*((1e-3 * disc[:2], 1e-3 * disc[2]) for disc in discs), (1e-3 * zoned.targets[-1, 1], 10.0)]:
        assert any(np.allclose(np.hypot(*(outline - center).T), radius) for outline in outlines if len(outline))


def test_cards_are_the_panels_of_geometry_one_by_one():
    shown = {f"policy {i}": episode(0.1 * i) for i in range(3)}
    whole, cards = geometry(TIME_S, shown, "Title"), geometry_cards(TIME_S, shown)
    assert list(cards) == list(shown)
    for i, card in enumerate(cards.values()):
        assert_is_picture(card)
        for ours, panel in zip(card.axes, whole.axes[2 * i : 2 * i + 2], strict=True):
            assert ours.get_title() == panel.get_title()
            assert (ours.get_xlim(), ours.get_ylim()) == (panel.get_xlim(), panel.get_ylim())
            for line, same in zip(ours.lines, panel.lines, strict=True):
                assert np.array_equal(line.get_xydata(), same.get_xydata())
        boxes = [axes.get_tightbbox() for axes in card.axes]
        assert not boxes[0].overlaps(boxes[1])
        assert all(box.x0 >= 0 and box.y0 >= 0 and box.x1 <= card.bbox.x1 and box.y1 <= card.bbox.y1 for box in boxes)


def test_the_key_of_cards_names_what_geometry_names():
    zoned = episode()._replace(discs=np.array([[30e3, 30e3, 5e3]]), standoff_m=10e3)
    key = geometry_legend(zoned)
    assert_is_picture(key)
    (whole,), (ours,) = (figure.legends for figure in (geometry(TIME_S, {"x": zoned}, "T"), key))
    assert [text.get_text() for text in ours.get_texts()] == [text.get_text() for text in whole.get_texts()]
    box = ours.get_window_extent()
    assert box.x0 >= 0
    assert box.y0 >= 0
    assert box.x1 <= key.bbox.x1
    assert box.y1 <= key.bbox.y1


def test_geometry_says_which_figures_do_not_fit():
    cut = episode()._replace(bound_m=np.ones((45, 3)))
    with pytest.raises(ValueError, match=r"paths\['b'\]\.bound_m has shape \(45, 3\), must be .* \(46, 3\)"):
        geometry(TIME_S, {"a": episode(), "b": cut}, "Title")


def test_geometry_is_a_picture_that_differs_between_policies():
    straight, apart = (assert_is_picture(geometry(TIME_S, {"x": episode(turn)}, "T")) for turn in (0.0, 0.5))
    assert (straight != apart).any()


def test_an_estimate_far_off_changes_no_axes():
    near, far = (geometry(TIME_S, {"x": episode(far=far)}, "Title") for far in (False, True))
    assert near.axes[0].get_xlim() == far.axes[0].get_xlim()
    low, high = far.axes[0].get_xlim()
    rings = [line for line in far.axes[0].lines if line.get_markerfacecolor() == "none"]
    assert len(rings) == 3
    assert all(low < line.get_xdata()[0] < high for line in rings)
    assert_is_picture(far)


def test_number_of_a_target_keeps_clear_of_the_note_on_its_estimate():
    """Estimates far to the east of a target near the eastern edge, north and south of the middle."""
    for north in (1.0, -1.0):
        shown = episode()._replace(stations=np.array([1.0, north]) * episode().stations)
        shown = shown._replace(targets=np.array([1.0, north]) * shown.targets)
        for side in (1.0, -1.0):
            estimates = shown.targets + np.array([90e3, side * 20e3])
            axes = geometry(TIME_S, {"x": shown._replace(estimates=estimates)}, "Title").axes[0]
            axes.figure.canvas.draw()
            notes = [text for text in axes.texts if text.get_text().endswith(" km")]
            numbers = [text for text in axes.texts if text.get_text() in ("1", "2", "3")]
            assert len(notes) == len(numbers) == 3
            for note, number in zip(notes, numbers, strict=True):
                assert (number.get_position()[1] > 0.0) == (note.get_va() == "top")


def test_geometry_of_one_instant():
    whole = episode()
    at_start = EpisodePaths(*(part[:1] for part in whole[:3]), whole.final_cov, whole.error_m[:1], whole.bound_m[:1])
    assert_is_picture(geometry(TIME_S[:1], {"x": at_start}, "Title"))


def test_geometry_needs_a_policy():
    with pytest.raises(ValueError, match="at least one policy"):
        geometry(TIME_S, {}, "Title")


# ------------------------------------------------------------------------------------------------ maneuvers


def weaving(period: int, angle_deg: float = 60.0, episodes: int = 8) -> Maneuvers:
    """All episodes change sides every `period` steps; the odd ones begin on the right."""
    side = np.where(np.arange(len(TIME_S)) // period % 2 == 0, 1.0, -1.0)
    off = np.radians(angle_deg) * np.where(np.arange(episodes) % 2 == 0, 1.0, -1.0)[:, None] * side
    return Maneuvers(off, np.sign(np.diff(off, axis=1)))


def test_angle_quantiles_by_hand():
    off = np.radians([[-10.0, 20.0], [30.0, -170.0], [50.0, 90.0]])
    assert angle_quantiles_deg(off)[[1, 2, 3]] == pytest.approx(np.array([[20.0, 55.0], [30.0, 90.0], [40.0, 130.0]]))


def test_side_is_counted_from_where_an_episode_began():
    off = np.array([[0.5, -0.5, 0.5, -0.5], [-0.5, 0.5, 0.5, -0.5]])
    assert first_side_share(off).tolist() == [1.0, 0.0, 0.5, 0.5]


def test_legs_end_where_the_course_crosses_the_line_of_sight_and_not_at_the_episodes_end():
    off = np.array([[1.0, 1.0, -1.0, -1.0, -1.0, 1.0], [-3.1, 3.1, 1.0, 1.0, 1.0, 1.0], [1.0] * 6])
    assert leg_steps(off).tolist() == [2, 3, 1]


@pytest.mark.parametrize("count", [1, 2, 5, 6, 9])
def test_nothing_in_maneuvers_overlaps(count):
    figure = maneuvers(TIME_S, {f"policy {i}": weaving(5 + i) for i in range(count)}, "Title")
    assert len(figure.axes) == 3 * count
    assert_is_picture(figure)
    assert_apart(figure)


def test_maneuvers_show_angle_side_turns_and_legs():
    angle, side, legs = maneuvers(TIME_S, {"x": weaving(15, 60.0)}, "Title").axes
    assert angle.get_title() == "x"
    assert angle.lines[0].get_ydata() == pytest.approx(60.0)
    expected = np.repeat([100.0, 0.0, 100.0, 0.0], (15, 15, 15, 1))
    assert side.lines[0].get_ydata() == pytest.approx(expected)
    turning = np.zeros(45)
    turning[[14, 29, 44]] = 100.0
    assert side.patches[0].get_data().values == pytest.approx(turning)
    drawn = legs.patches[0].get_data()
    (filled,) = np.flatnonzero(drawn.values)
    assert drawn.edges[filled] < 30.0 < drawn.edges[filled + 1]
    assert drawn.values[filled] == 3.0
    assert legs.texts[0].get_text() == "3.0 crossings\nper episode"


def test_a_policy_that_never_crosses_the_line_of_sight_is_drawn():
    figure = maneuvers(TIME_S, {"x": weaving(100)}, "Title")
    assert_is_picture(figure)
    assert figure.axes[2].texts[0].get_text() == "0.0 crossings\nper episode"


@pytest.mark.parametrize(
    ("instants", "flown", "message"),
    [
        (46, {}, "at least one policy"),
        (1, {"x": weaving(5)}, "time_s has 1 instants"),
        (45, {"x": weaving(5)}, r"flown\['x'\]: off_sight_rad and turns have shapes \(8, 46\) and \(8, 45\)"),
        (46, {"x": weaving(5, episodes=0)}, r"shapes \(0, 46\)"),
        (46, {"x": weaving(5)._replace(turns=np.zeros((7, 45)))}, r"\(7, 45\), must be"),
    ],
)
def test_maneuvers_say_what_is_wrong(instants, flown, message):
    with pytest.raises(ValueError, match=message):
        maneuvers(TIME_S[:instants], flown, "Title")


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


def test_what_stands_is_a_dot():
    moving, turning, standing = Line2D([], []), Line2D([], []), Line2D([], [])
    artists.place_dart(moving, np.array([0.0, 0.0, 3.0, 4.0]))
    artists.place_dart(turning, np.array([0.0, 0.0, 0.0, 1e-6]))  # a station that turns on the spot
    artists.place_dart(standing, np.array([0.0, 0.0, 1e-11, 0.0]))
    shapes = [MarkerStyle(line.get_marker()).get_path().vertices.shape for line in (moving, turning, standing)]
    assert shapes[2] == MarkerStyle("o").get_path().vertices.shape != shapes[0] == shapes[1]
