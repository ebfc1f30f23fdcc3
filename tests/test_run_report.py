"""The page that train and evaluate leave behind: what it says, that it is whole, and how it shows in a browser."""

import base64
import io
import json
import re
import shlex
from dataclasses import fields, replace
from xml.etree import ElementTree

import numpy as np
import pytest
from chromium import DESKTOP, PHONE
from chromium import Page as Window
from html_page import Page
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from matplotlib.image import imread
from test_evaluation import record
from test_learning_curves import ERROR, logged

from agents import cli, run_report
from agents.comparison import summarize
from agents.curves import RATIO, REWARD
from agents.evaluation import fly_all
from agents.main_job import compare
from agents.policy import make_policy
from agents.run_report import REPORT, Settings, command_line, comparison, duration, flat, write_run_report
from agents.svg import DARK, WHITE, as_svg
from passive_env.catalogue import environment_id, make_scenario
from passive_env.catalogue.two_station import TwoStation
from passive_env.palette import CURVES, INK, MUTED

ID = "passive/TwoStation-v0"
STEPS = 6
BASE = 1000.0 + 100.0 * np.arange(8.0)[:, None]
"""Final errors [m] of eight episodes."""


def flown(**ratios: float):
    """Records of policies whose errors are so many times those of `rule`, in every episode."""
    shape = np.linspace(20.0, 1.0, STEPS + 1)
    return {name: record(ratio * BASE * shape) for name, ratio in {"rule": 1.0, **ratios}.items()}


def made(records, focus="", heading="Drawn courses"):
    return comparison(heading, summarize(ID, 5, records), records, TwoStation(steps=STEPS), focus)


def asked(**more) -> Settings:
    return Settings("A title & more", "passive-env evaluate x --seed 5", {"seed": 5}, **more)


@pytest.fixture(scope="module")
def report(tmp_path_factory):
    """A folder with the report of eight policies in two comparisons, with learning curves."""
    folder = tmp_path_factory.mktemp("report")
    points = {RATIO: {100: 1.5, 300: 0.5}, ERROR: {100: 1500.0, 300: 500.0}, REWARD: {50: -10.0, 400: -5.0}}
    run = logged(folder / "run", 3, points)
    records = flown(learned=0.9, paper=3.0, **{f"rule_{i}": 1.1 + 0.1 * i for i in range(5)})
    both = [made(records, "learned", heading) for heading in ("Drawn courses", "Recorded flights")]
    write_run_report(folder, asked(folder=run, preset={"arguments": {"gamma": 1.0}}), both)
    return folder


@pytest.fixture(scope="module")
def page(report):
    return Page((report / REPORT).read_text(encoding="utf-8"))


def table(page: Page, first: str) -> list[list[str]]:
    """The rows below the first table whose head begins with this."""
    return next(rows for head, *rows in page.tables if head[0] == first)


def svgs(page: Page) -> list[bytes]:
    return [base64.b64decode(image["src"].removeprefix("data:image/svg+xml;base64,")) for image in page.all("img")]


# ------------------------------------------------------------------------------------------------ what it says


def test_comparison_ranks_policies_by_the_error_that_counts(page):
    rows = table(page, "policy")
    assert [row[0] for row in rows] == ["learned", "rule", *(f"rule_{i}" for i in range(5)), "paper"]
    mean = BASE.mean()
    assert [row[1] for row in rows[:2]] == [f"{0.9 * mean:,.0f}", f"{mean:,.0f}"]
    assert [row[2] for row in rows] == [
        "0.900 [0.900, 0.900]", "1", *(f"{r:.3f} [{r:.3f}, {r:.3f}]" for r in (1.1, 1.2, 1.3, 1.4, 1.5, 3.0)),
    ]  # fmt: skip
    assert [row[3] for row in rows[:2]] == [f"{r * np.percentile(BASE, 95.0):,.0f}" for r in (0.9, 1.0)]


def test_figures_are_those_of_the_summary(report, page):
    records = flown(learned=0.9, paper=3.0, **{f"rule_{i}": 1.1 + 0.1 * i for i in range(5)})
    summary = summarize(ID, 5, records)
    (head,) = {tuple(rows[0]) for rows in page.tables if rows[0][:2] == ["policy", "final"]}
    for row in table(page, "policy"):
        shown, figures = dict(zip(head, row, strict=True)), summary["policies"][row[0]]
        assert shown["time average"] == f"{figures['mean_range_error_m']['mean']:,.0f}"
        assert shown["bound"] == f"{figures['final_range_crlb_m']:,.0f}"
        assert shown["lost"] == f"{100 * figures['lost_share']:.2f} %"


@pytest.mark.parametrize(
    ("factor", "noise", "judged"), [(0.8, 0.0, "ahead"), (1.0, 0.3, "level"), (1.3, 0.0, "behind")]
)
def test_finding_says_what_the_interval_says(factor, noise, judged):
    wavy = factor * (1.0 + noise * (-1.0) ** np.arange(8.0))[:, None] * BASE
    records = flown(paper=3.0) | {"learned": record(np.broadcast_to(wavy, (8, STEPS + 1)))}
    summary = summarize(ID, 5, records)
    low, high = summary["ratios"]["rule"]["learned"]["final_range_error_m"]["ci95"]
    assert (high < 1.0, low <= 1.0 <= high, low > 1.0) == tuple(judged == word for word in ("ahead", "level", "behind"))
    finding = made(records, "learned").finding
    assert f'<span class="{judged}">' in finding
    assert "<code>rule</code>, the strongest baseline" in finding
    assert ("has the least mean" in finding) == (wavy.mean() < BASE.mean())


def test_without_a_focus_the_best_policy_is_told_beside_the_next_baseline():
    finding = made(flown(paper=0.5, random=2.0)).finding
    assert "<code>paper</code> has the least mean range error at the end: 675 m" in finding
    assert "0.500 [0.500, 0.500] times the error of <code>rule</code>, the next baseline" in finding


def test_a_single_episode_is_judged_by_nobody():
    records = {
        name: record(factor * BASE[:1] * np.ones((1, STEPS + 1))) for name, factor in (("rule", 1.0), ("x", 2.0))
    }
    finding = made(records, "x").finding
    assert finding.endswith(
        "2.000 [2.000, 2.000] times the error of <code>rule</code>, the strongest baseline, in a single episode."
    )
    assert "behind" not in finding


def test_comparisons_of_one_name_are_chapters_of_their_own(tmp_path):
    page = Page(
        write_run_report(tmp_path, asked(), [made(flown()), made(flown(paper=2.0))]).read_text(encoding="utf-8")
    )
    assert [rows[0] for rows in page.tables].count(
        ["policy", "final", "p95, final", "time average", "bound", "lost"]
    ) == 1
    assert len([head for head, *_ in page.tables if head[:2] == ["policy", "final"]]) == 2


def test_a_single_policy_is_compared_with_nothing():
    only = made(flown())
    assert only.finding == f"<code>rule</code> has a mean range error at the end: {1e-3 * BASE.mean():.2f} km."
    assert "relative to" not in only.body
    Page(only.body)


def test_errors_of_nothing_are_compared_without_dividing_by_them():
    perfect = made({"paper": record(0.0 * np.ones((8, STEPS + 1)))} | flown())
    assert "<code>paper</code> has the least mean range error at the end: 0 m" in perfect.finding
    assert "0.000 [0.000, 0.000] times the error of <code>rule</code>" in perfect.finding
    other = made({"paper": record(0.0 * np.ones((8, STEPS + 1)))} | flown(), focus="rule")
    assert "times" not in other.finding
    for each in (perfect, other):
        cells = [cell for rows in Page(each.body).tables for row in rows for cell in row]
        assert not [cell for cell in cells if "nan" in cell]


def test_learning_curves_tell_first_and_last_values(page):
    (alt,) = (image["alt"] for image in page.all("img") if image["alt"].startswith("Learning curves"))
    assert "final error / rule's: 1.5 at 100 steps, 0.5 at 300" in alt
    assert "return of an episode: -10 at 50 steps, -5 at 400" in alt


def test_a_run_without_curves_says_so(tmp_path):
    unlogged = run_report._learning(logged(tmp_path / "other", 0, {"train/loss": {50: 1.0}}))
    (tmp_path / "none").mkdir()
    (tmp_path / "none" / "config.json").write_text((tmp_path / "other" / "config.json").read_text())
    assert "too short" in unlogged
    assert "no logs" in run_report._learning(tmp_path / "none")


def test_configuration_names_every_field_and_what_was_changed(page):
    changed, whole = (rows for head, *rows in page.tables if head == ["field", "value", "default", "meaning"])
    assert [row[:3] for row in changed] == [["steps", str(STEPS), str(make_scenario("TwoStation", {}).steps)]]
    assert [row[0] for row in whole] == [field.name for field in fields(TwoStation())]
    assert ["arguments.gamma", "1.0"] in [row for rows in page.tables for row in rows]


def test_settings_in_one_level():
    given = {"a": 1, "b": {"c": 2, "d": {"e": (3, 4)}}, "f": {}}
    assert list(flat(given)) == [("a", 1), ("b.c", 2), ("b.d.e", (3, 4)), ("f", {})]


@pytest.mark.parametrize(
    ("seconds", "words"), [(0.4, "0 s"), (59.6, "1 min 0 s"), (3599.0, "59 min 59 s"), (7260.0, "2 h 1 min")]
)
def test_duration_in_words(seconds, words):
    assert duration(seconds) == words


def test_text_is_shown_as_text(report):
    assert "A title &amp; more" in (report / REPORT).read_text(encoding="utf-8")
    hostile = made(flown(**{"<b>x</b>": 1.2}))
    assert "<b>x" not in hostile.body + hostile.finding


# ------------------------------------------------------------------------------------------------ how to repeat it


def parsed(command: str, monkeypatch):
    seen = []
    monkeypatch.setattr(cli, "_guarded", lambda given: seen.append(given) or 0)
    program, *arguments = shlex.split(command)
    assert program == "passive-env"
    assert cli.main(arguments) == 0
    return seen[0]


def test_a_command_reads_back_as_what_was_asked(monkeypatch):
    given = {
        "policies": ["rule", "runs/my run"], "trackers": (), "episodes": 7, "seed": 8, "flights": None,
        "fields": {"tracker": "rp_ekf", "std": 0.5, "pair": (1, 2), "word": "12", "nothing": None, "no": False},
    }  # fmt: skip
    evaluate = parsed(command_line("evaluate", given | {"out": "DIR"}, "passive/Ownship-v0"), monkeypatch)
    assert (evaluate.env, evaluate.policies, evaluate.trackers) == ("passive/Ownship-v0", ("rule", "runs/my run"), ())
    assert (evaluate.episodes, evaluate.seed, evaluate.flights, str(evaluate.out)) == (7, 8, None, "DIR")
    assert cli.parse_fields(evaluate.fields) == given["fields"]


def test_the_printed_command_repeats_the_evaluation(tmp_path, monkeypatch):
    arguments = ["evaluate", ID, "--policies", "paper", "rule", "--episodes", "2", "--seed", "9"]
    arguments += ["--fields", "steps=4", "course=paper"]
    assert cli.main([*arguments, "--out", str(tmp_path / "one")]) == 0
    text = (tmp_path / "one" / REPORT).read_text(encoding="utf-8")
    (shown,) = re.findall(r"<pre><code>(.*?)</code></pre>", text)
    with monkeypatch.context() as patch:
        repeated = parsed(re.sub("<.*?>", "", shown), patch)
    assert cli._guarded(replace(repeated, out=tmp_path / "two")) == 0
    one, two = (json.loads((tmp_path / name / "evaluation.json").read_text()) for name in ("one", "two"))
    for summary in (one, two):
        for figures in summary["policies"].values():
            del figures["decision_time_us"]
    assert one == two
    assert "Course paper" in text


# ------------------------------------------------------------------------------------------------ one whole file


def test_page_fetches_nothing(page):
    assert not {"script", "link", "iframe", "object", "video"} & {tag for tag, _ in page.tags}
    assert "url(" not in page.style
    assert "@import" not in page.style
    assert all(image["src"].startswith("data:image/svg+xml;base64,") for image in page.all("img"))
    named = {attributes["id"] for _, attributes in page.tags if "id" in attributes}
    links = [anchor["href"] for anchor in page.all("a")]
    assert len(links) == 5
    assert all(link[0] == "#" and link[1:] in named for link in links)


def test_pictures_are_whole_and_fetch_nothing(page):
    found = svgs(page)
    assert len(found) == 2 * (2 + 1 + 8 + 1) + 1  # charts, key, maps, maneuvers; learning curves
    for svg in found:
        for part in ElementTree.fromstring(svg).iter():
            links = [value for name, value in part.attrib.items() if name.endswith("href")]
            assert all(link.startswith(("#", "data:image/png;base64,")) for link in links)


def test_page_is_accessible(page):
    assert page.all("html") == [{"lang": "en"}]
    levels = [tag for tag, _ in page.tags if tag in ("h1", "h2", "h3")]
    assert levels.count("h1") == 1
    assert all(low <= high[1] for low, high in zip("12", levels[:2], strict=True))
    assert all(len(image["alt"]) > 20 for image in page.all("img"))
    assert {head["scope"] for head in page.all("th")} == {"col", "row"}
    regions = [block for block in page.all("div") if block.get("role") == "region"]
    assert len(regions) == len(page.tables) + 2  # the maneuvers' pictures scroll too
    assert all(block["aria-label"] and block["tabindex"] == "0" for block in regions)
    identities = [attributes["id"] for _, attributes in page.tags if "id" in attributes]
    assert len(set(identities)) == len(identities)


def test_a_repeated_evaluation_replaces_the_report_and_a_failing_one_leaves_it(tmp_path, monkeypatch):
    def run(policy):
        compare(ID, [policy], (), 2, 0, None, tmp_path, {"steps": 3})

    run("paper")
    first = (tmp_path / REPORT).read_bytes()
    run("rule")
    second = (tmp_path / REPORT).read_bytes()
    assert b"<code>rule</code> has" in second
    assert b"<code>paper</code> has" in first
    assert b"<code>paper</code> has" not in second

    def full(path, content):
        raise OSError("no space left")

    monkeypatch.setattr(run_report, "write_text", full)
    with pytest.raises(OSError, match="no space"):
        run("paper")
    assert (tmp_path / REPORT).read_bytes() == second
    assert not list(tmp_path.glob(".*"))


def test_trackers_crossed_with_policies_are_chapters_of_one_report(tmp_path):
    trackers = ("rp_ekf", "fused_ekf")
    compare(ID, ["rule", "paper"], trackers, 2, 0, None, tmp_path, {"steps": 3})
    assert sorted(path.relative_to(tmp_path).as_posix() for path in tmp_path.rglob("*.html")) == [REPORT]
    text = (tmp_path / REPORT).read_text(encoding="utf-8")
    chapters = re.findall(r"<h2[^>]*>(.*?)</h2>", text)
    assert chapters[:3] == ["Trackers and policies", "Tracker rp_ekf", "Tracker fused_ekf"]
    (row,) = (row for row in table(Page(text), "field") if row[0] == "tracker")
    assert row[1] == "rp_ekf / fused_ekf"


@pytest.mark.parametrize(
    ("name", "fields", "policies", "picture"),
    [
        ("Ownship", {"steps": 3}, ("straight", "rule"), "Per policy: angle between"),
        ("AngleFusion", {"steps": 3}, ("paper", "rule"), "Per policy: angle between"),
        ("ManeuveringTarget", {"steps": 6}, ("open", "rule"), "Per policy: angle between"),
        ("RadarPlacement", {}, ("paper", "even"), "even: "),
        ("MobilePlacement", {}, ("paper", "even"), "paper: "),
        ("PassiveRadar", {"steps": 6}, ("round_robin", "nearest"), "nearest: "),
    ],
)
def test_every_family_has_a_report(tmp_path, name, fields, policies, picture):
    scenario = make_scenario(name, fields)
    records = fly_all(scenario, {each: make_policy(each, scenario) for each in policies}, 2, 0, progress=False)
    summary = summarize(environment_id(name), 0, records)
    write_run_report(tmp_path, asked(), [comparison("Drawn courses", summary, records, scenario)])
    page = Page((tmp_path / REPORT).read_text(encoding="utf-8"))
    assert {row[0] for row in table(page, "policy")} == set(policies)
    assert any(image["alt"].startswith(picture) for image in page.all("img"))
    assert len(set(svgs(page))) == len(page.all("img"))
    assert "nan" not in " ".join(cell for rows in page.tables for row in rows for cell in row).lower().split()


# ------------------------------------------------------------------------------------------------ colours


def contrast(one: str, other: str) -> float:
    """Contrast ratio of two colours, as WCAG 2.2 defines it."""
    linear = [
        np.where((c := np.array(to_rgb(x))) <= 0.04045, c / 12.92, ((c + 0.055) / 1.055) ** 2.4) for x in (one, other)
    ]
    dark, light = sorted(0.05 + float(rgb @ [0.2126, 0.7152, 0.0722]) for rgb in linear)
    return light / dark


def test_colours_can_be_seen_on_a_dark_page():
    assert contrast("#000000", "#FFFFFF") == pytest.approx(21.0)
    paper = DARK[WHITE]
    shown = [DARK.get(color, color) for color in CURVES]
    assert min(contrast(color, paper) for color in shown) > 3.0
    assert min(contrast(DARK[color], paper) for color in (INK, MUTED)) > 4.5
    assert len(set(shown)) == len(CURVES)


def test_pictures_have_the_pages_own_paper(page):
    assert f"--paper: {DARK[WHITE].lower()}" in page.style


def test_equal_figures_are_equal_files_in_which_no_light_colour_is_fixed():
    def drawn() -> bytes:
        figure = Figure(figsize=(2.0, 2.0))
        axes = figure.subplots()
        axes.plot([0.0, 1.0], [0.0, 1.0], color=INK)
        axes.pcolormesh([[0.0, 1.0], [1.0, 0.0]], shading="gouraud")
        return as_svg(figure)

    text = drawn().decode()
    assert text.encode() == drawn()
    _, rules, body = re.split("<style.*?>|</style>", text, maxsplit=2)
    assert not [color for color in DARK if color.lower() in body.lower()]
    used = set(re.findall(r"var\((--c\d+)\)", body))
    assert len(used) >= 2
    assert all(len(re.findall(rf"{name}:#", rules)) == 2 for name in used)
    assert "data:image/png;base64," in body
    assert "filter" not in body


# ------------------------------------------------------------------------------------------------ in a browser


ENTER = "\ue007"
"""The key, as a browser's driver names it."""


@pytest.fixture(params=[DESKTOP, PHONE], ids=["desktop", "phone"])
def size(request) -> tuple[int, int]:
    return request.param


@pytest.fixture
def window(chromium, report, size) -> Window:
    prefer(chromium, "light")
    return Window(chromium, report / REPORT, ready="document.readyState === 'complete'", size=size, touch=size == PHONE)


def prefer(driver, scheme: str) -> None:
    """Let the browser's user prefer light or dark pages."""
    features = [{"name": "prefers-color-scheme", "value": scheme}]
    driver.execute_cdp_cmd("Emulation.setEmulatedMedia", {"features": features})


def pixels(png: bytes) -> np.ndarray:
    """A screenshot [height, width, 3] in [0, 1]."""
    return imread(io.BytesIO(png))[..., :3]


def test_page_loads_without_errors_and_without_a_network(window):
    assert window.complaints() == []
    assert all(name.startswith("data:") for name in window.fetched())
    assert window.value("[...document.images].every(each => each.complete && each.naturalWidth > 0)")
    assert window.unnamed() == []


def test_page_fits_its_window_and_shows_its_pictures(window, size):
    """Nothing but tables and wide pictures scrolls sideways, and those inside their own regions."""
    assert window.value("document.documentElement.scrollWidth") == size[0]
    images = window.driver.find_elements("css selector", "figure > img")
    visible = [image for image in images if image.is_displayed()]
    assert len(visible) == 2 * (2 + 1 + run_report.CARDS) + 1
    for image in (visible[0], visible[1], visible[-1]):
        assert 0.25 * size[0] < image.size["width"] < size[0]
        assert len(np.unique(pixels(image.screenshot_as_png).reshape(-1, 3), axis=0)) > 20


def test_letters_of_pictures_can_be_read(window):
    """The smallest ones are set in 9 pt, in figures that shrink to the window's width."""
    shrunk = window.value(
        "[...document.querySelectorAll('figure > img')].filter(each => each.offsetParent && !each.closest('.wide'))"
        ".map(each => each.width / each.naturalWidth)"
    )
    assert len(shrunk) > 10
    assert min(shrunk) * 9.0 * 96.0 / 72.0 > 8.0


def test_page_and_pictures_are_dark_where_dark_pages_are_preferred(window):
    for scheme, paper in (("dark", DARK[WHITE]), ("light", WHITE)):
        prefer(window.driver, scheme)
        for png in (window.driver.get_screenshot_as_png(), window.find("figure > img").screenshot_as_png):
            same = np.abs(pixels(png) - np.array(to_rgb(paper))).max(-1) < 0.02
            assert 0.5 < same.mean() < 0.995


def test_what_is_folded_opens_by_keyboard(window):
    folded = window.driver.find_elements("tag name", "details")
    assert [each.find_element("tag name", "summary").text for each in folded] == [
        *(2 * [run_report.EVERYTHING, "The other 2", "Courses and legs of every policy"]),
        "Preset of the algorithm", f"All {len(fields(TwoStation()))} fields",
    ]  # fmt: skip
    for each in folded:
        inside, title = each.find_element("css selector", "table, img"), each.find_element("tag name", "summary")
        assert not inside.is_displayed()
        title.send_keys(ENTER)
        assert inside.is_displayed()
        title.send_keys(ENTER)
        assert not inside.is_displayed()


def test_links_lead_to_their_parts(window, size):
    links = window.driver.find_elements("css selector", "nav a")
    assert len(links) == 5
    for link in links:
        link.send_keys(ENTER)
        top = window.value(f"document.querySelector('{link.get_attribute('hash')}').getBoundingClientRect().top")
        at_the_end = window.value("innerHeight + scrollY > document.documentElement.scrollHeight - 2")
        assert abs(top) < 5.0 or (at_the_end and 0.0 < top < size[1])
