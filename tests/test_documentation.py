"""What the documentation takes from the code: tables are current and right, pictures show what they say."""

import math
import re
from pathlib import Path

import numpy as np
import pytest
from markdown_tables import tables

from agents.documentation import GENERATED, MAKERS, documents, with_tables, write_tables
from agents.documentation.api import module_names
from agents.documentation.environments import action_rows, page_name
from agents.documentation.pictures import BASELINES_M, STD_DEG, TARGET_M, crossing_figure, moment, twin_paths
from agents.documentation.results import table_after
from agents.documentation.settings import REGISTRIES, tracker_classes
from passive_env.catalogue import SCENARIOS
from passive_env.env import PassiveEnv
from trackers.angles import wrap
from trackers.measurement import bearing

ROOT = Path(__file__).parents[1]
WITH_TABLES = [path for path in documents(ROOT) if GENERATED.search(path.read_text(encoding="utf-8"))]


def generated(path: Path) -> dict[str, str]:
    """What the generated parts of a document hold, by their names."""
    return {found[1]: found[0] for found in GENERATED.finditer(path.read_text(encoding="utf-8"))}


@pytest.mark.parametrize("path", WITH_TABLES, ids=lambda path: str(path.relative_to(ROOT)))
def test_tables_are_current(path):
    """Otherwise: python -m agents.documentation"""
    text = path.read_text(encoding="utf-8")
    assert with_tables(text, ROOT) == text
    assert text.count("<!-- generated: ") == len(GENERATED.findall(text))


@pytest.mark.parametrize("name", SCENARIOS)
def test_every_environment_has_a_page_with_its_own_tables_and_a_picture(name):
    page = ROOT / "docs" / "environments" / page_name(name)
    opening = {found[1]: found[2] for found in GENERATED.finditer(page.read_text(encoding="utf-8"))}
    assert opening == dict.fromkeys(("action", "reward", "baselines", "observation", "keywords"), name)
    assert page.with_suffix(".png").stat().st_size > 10_000


@pytest.mark.parametrize("name", SCENARIOS)
def test_tables_of_an_environment_count_its_spaces(name):
    """The tables have a row per number of the spaces that the environment itself shows."""
    env = PassiveEnv(name)
    shown = generated(ROOT / "docs" / "environments" / page_name(name))
    (observed,), (commanded,) = tables(shown["observation"]), tables(shown["action"])
    assert [row[1].strip("`") for row in observed[1:]] == [field.name for field in env.observation_fields]
    assert len(observed) - 1 == env.observation_space.shape[0]
    assert len(commanded) - 1 == env.action_space.shape[0]


@pytest.mark.parametrize("name", SCENARIOS)
def test_reward_table_says_what_counts(name):
    (rows,) = tables(generated(ROOT / "docs" / "environments" / page_name(name))["reward"])
    counted = {row[0].strip("`").removeprefix("reward_"): float(row[1]) for row in rows[1:] if row[2] == "yes"}
    assert counted == SCENARIOS[name].reward_weights


def test_action_words_hold():
    """+1 and −1 do what the table says: a left turn by the limit, a climb, the top speed."""
    env = PassiveEnv("ManeuveringTarget")
    env.reset(seed=1)
    before = env.world.platforms[0].copy()
    env.step([1.0, -1.0, 1.0, 1.0])
    after = env.world.platforms[0]
    turned = wrap(np.arctan2(after[:, 3], after[:, 2]) - np.arctan2(before[:, 3], before[:, 2]))
    assert action_rows(env.scenario)[0] == ("turn rate of station 0", "5°/s to the right … to the left")
    np.testing.assert_allclose(np.degrees(turned), [5.0, -5.0], atol=1e-9)
    assert action_rows(env.scenario)[2] == ("speed of station 0", "0 … 250 m/s")
    np.testing.assert_allclose(np.hypot(after[:, 2], after[:, 3]), 250.0)


def test_action_words_follow_the_scenario():
    assert action_rows(SCENARIOS["Ownship"].replace(max_turn_rate_deg_s=1.5)) == [
        ("turn rate of platform 0", "1.5°/s to the right … to the left")
    ]
    rows = action_rows(SCENARIOS["AngleFusion"].replace(actions="headings"))
    assert rows[1][0] == "heading of platform 1"
    assert rows[3] == ("climb rate of platform 1", "30 m/s down … up")
    assert action_rows(SCENARIOS["MobileReceiver"].replace(actions="continuous"))[0][0] == "turn rate of the receiver"


def test_actions_without_words_are_refused():
    with pytest.raises(TypeError, match="object: no words for its actions; add its family to ROWS"):
        action_rows(object())


@pytest.mark.parametrize("name", tracker_classes())
def test_every_tracker_has_a_page(name):
    text = (ROOT / "docs" / "trackers" / f"{name}.md").read_text(encoding="utf-8")
    for heading in ("## Equations", "## Source and deviations", "## In use", "## Settings"):
        assert f"\n{heading}\n" in text
    assert f"<!-- generated: settings {name} -->" in text
    assert "```math\n" in text
    assert tracker_classes()[name].__name__ in text


def test_trackers_of_all_families_are_named_once():
    assert len(tracker_classes()) == sum(len(family) for family in REGISTRIES.values())


def test_reference_has_every_module_once():
    for package in ("trackers", "passive_env", "agents"):
        shown = re.findall(r"^::: (\S+)$", (ROOT / "docs" / "api" / f"{package}.md").read_text(encoding="utf-8"), re.M)
        assert shown == module_names(ROOT, package)
        assert len(shown) == len(set(shown)) > 30
    assert "trackers.rp_ekf" in module_names(ROOT, "trackers")
    assert "agents.documentation.__main__" not in module_names(ROOT, "agents")


def test_unknown_table_is_refused():
    with pytest.raises(ValueError, match="generated: weather: nothing makes such a table; there are environments, "):
        with_tables("<!-- generated: weather -->\n<!-- end -->", ROOT)


def test_table_below_an_unknown_heading_is_refused():
    with pytest.raises(ValueError, match="the leaderboard has no table below '## Elsewhere'"):
        table_after("\n## In short\n\n| a |\n|---|\n| 1 |\n", "## Elsewhere")


def test_table_after_a_heading_is_the_first_one_below_it():
    text = "\n## A\n\n| a | b |\n|---|---|\n| 1 | 2 |\n\n## B\n\nwords\n\n| c |\n|---|\n| 3 |\n| 4 |\n\n| d |\n|---|\n"
    assert table_after(text, "## B") == [["c"], ["3"], ["4"]]
    assert table_after(text, "## A") == [["a", "b"], ["1", "2"]]


def test_writing_tables_changes_what_is_stale_and_nothing_else(tmp_path):
    for name in ("README.md", "CONTRIBUTING.md"):
        (tmp_path / name).write_text("as it is\n", encoding="utf-8")
    (tmp_path / "docs").mkdir()
    page = tmp_path / "docs" / "page.md"
    page.write_text("before\n\n<!-- generated: action Ownship -->\nold\n<!-- end -->\n\nafter\n", encoding="utf-8")
    assert write_tables(tmp_path) == [page]
    text = page.read_text(encoding="utf-8")
    assert MAKERS["action"](tmp_path, "Ownship") in text
    assert text.startswith("before\n\n<!-- generated: action Ownship -->\n\n|")
    assert text.endswith("|\n\n<!-- end -->\n\nafter\n")
    assert write_tables(tmp_path) == []


# -- pictures --------------------------------------------------------------------------------------------------------


def test_titles_of_the_crossing_are_the_rule_of_thumb():
    """√2 σ r²/b, the page's formula, for the shorter baselines; the figure's numbers come from Fisher information."""
    titles = [axes.get_title() for axes in crossing_figure().axes[: len(BASELINES_M)]]
    for title, baseline in zip(titles[:2], BASELINES_M[:2], strict=True):
        shown = re.search(r"range ± ([\d.]+) km", title)
        assert shown
        rule = math.sqrt(2.0) * math.radians(STD_DEG) * TARGET_M[1] ** 2 / baseline / 1e3
        assert float(shown[1]) == pytest.approx(rule, rel=0.04)


def test_twin_shares_all_bearings_until_the_platform_turns():
    platform, target, twin = twin_paths(False)
    np.testing.assert_allclose(wrap(bearing(twin, platform) - bearing(target, platform)), 0.0, atol=1e-12)
    platform, target, twin = twin_paths(True)
    apart = np.abs(wrap(bearing(twin, platform) - bearing(target, platform)))
    assert (apart[: len(apart) // 2 + 1] < 1e-12).all()
    assert apart[-1] > math.radians(10.0)
    assert (np.diff(apart[len(apart) // 2 :]) > 0.0).all()


def test_moment_of_an_environment_is_a_picture():
    picture = moment("Ownship")
    assert picture.shape == (800, 800, 3)
    assert picture.dtype == np.uint8
    assert len(np.unique(picture.reshape(-1, 3), axis=0)) > 50
