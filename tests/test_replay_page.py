"""The replay's page in a real Chromium: loads, plays, scrubs, zooms, switches layers, by mouse, keyboard and touch."""

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from chromium import DESKTOP, PHONE, Page

from agents.policy import make_policy, policy_names
from agents.replay import write_replay
from agents.replay_record import fly_once, record
from passive_env.catalogue import SCENARIOS, environment_id

READY = "document.documentElement.dataset.readyMs !== undefined"
STEPS = 12
ALL_OF_IT = (1360, 4000)
"""A window in which the whole page is seen at once, so that every diagram is drawn."""


def make_page(folder: Path, name: str, policies: tuple[str, ...], steps: int) -> tuple[Path, dict[str, Any]]:
    scenario = SCENARIOS[name] if name == "RadarPlacement" else SCENARIOS[name].replace(steps=steps)
    records = {p: record(scenario, fly_once(scenario, make_policy(p, scenario), 3)) for p in policies}
    path = folder / f"{name}.html"
    return write_replay(path, environment_id(name), 3, scenario.replay_axis, records), records


@pytest.fixture(scope="module")
def two_station(tmp_path_factory):
    return make_page(tmp_path_factory.mktemp("replay"), "TwoStation", ("paper", "rule"), STEPS)


@pytest.fixture
def page(chromium, two_station) -> Page:
    return Page(chromium, two_station[0], READY)


def now(page: Page) -> int:
    """The instant shown, as the slider says."""
    return int(page.value("document.getElementById('time').value"))


def traces(page: Page, plot: int = 0) -> list[dict[str, Any]]:
    """What plotly draws in a diagram: places, colours and hover texts."""
    script = """return document.querySelectorAll('.js-plotly-plot')[arguments[0]].data.map(
        (t) => ({x: t.x, y: t.y, mode: t.mode, hover: t.hovertext ?? [], color: t.line?.color ?? t.marker?.color}))"""
    return page.run(script, plot)


def hovers(page: Page) -> list[str]:
    return [text for trace in traces(page) for text in trace["hover"] if text]


# ------------------------------------------------------------------------------------------------ loading


def test_loads_without_complaints_and_fetches_nothing(page):
    assert page.complaints() == []
    assert page.fetched() == []
    assert "passive/TwoStation-v0" in page.driver.title


def test_weighs_less_than_six_megabytes_with_three_policies_of_300_steps(tmp_path):
    path, _ = make_page(tmp_path, "PassiveRadar", ("fixed", "nearest", "round_robin"), 300)
    assert path.stat().st_size < 6e6


def test_answers_after_less_than_two_seconds_of_work(chromium, two_station):
    """Seconds of work of the page's thread, best of three: waiting for a busy machine is not the page's."""
    chromium.execute_cdp_cmd("Performance.enable", {"timeDomain": "threadTicks"})

    def worked() -> float:
        found = chromium.execute_cdp_cmd("Performance.getMetrics", {})["metrics"]
        return next(each["value"] for each in found if each["name"] == "TaskDuration")

    seconds = []
    for _ in range(3):
        chromium.get("about:blank")
        begun = worked()
        Page(chromium, two_station[0], READY)
        seconds.append(worked() - begun)
    chromium.execute_cdp_cmd("Performance.disable", {})
    assert 0.0 < min(seconds) < 2.0


@pytest.mark.parametrize("name", SCENARIOS)
def test_every_environment_is_drawn(chromium, tmp_path, name):
    known = policy_names(SCENARIOS[name])
    policy = next(each for each in ("paper", "fixed", "straight") if each in known)
    path, records = make_page(tmp_path, name, (policy,), 4)
    page = Page(chromium, path, READY, ALL_OF_IT)
    page.press("\ue010")  # End
    told = records[policy]
    wanted = len(told.views) + len(told.errors) + 1 + bool(told.probabilities)
    page.wait_for(f"document.querySelectorAll('.js-plotly-plot').length === {wanted}")
    page.wait_for("drawings.every((drawing) => !drawing.stale)")
    assert page.complaints() == []
    assert now(page) == len(told.labels) - 1
    assert page.value("document.getElementById('clock').textContent") == told.labels[-1]
    drawn = {text.split("<br>")[0] for text in hovers(page)}
    expected = {name for layer in ("platforms", "true targets", "estimates") for name in told.views[0].names[layer]}
    assert {f"<b>{name}</b>" for name in expected} <= drawn
    assert page.is_drawn()


# ------------------------------------------------------------------------------------------------ what it shows


def test_the_map_holds_the_recorded_places(page, two_station):
    layers = two_station[1]["paper"].views[0].layers
    page.run("seek(7)")
    shown = {text.split("<br>")[0][3:-4]: text for text in hovers(page) if "off the map" not in text}
    for j in range(3):
        x, y = layers["estimates"][7, j, 0]
        assert f"at {x:.2f}, {y:.2f}" in shown[f"estimate {j + 1}"]
    for s, name in enumerate(("S1", "S2 (ref.)")):
        x, y, _ = layers["platforms"][7, 0, s]
        assert f"at {x:.2f}, {y:.2f}" in shown[name]
    ellipse = next(t for t in traces(page) if t["mode"] == "lines" and len(t["x"]) == 50)
    x, y, ax, ay, *_ = layers["2σ ellipses"][7, 0, 0]
    assert (ellipse["x"][0], ellipse["y"][0]) == pytest.approx((x + ax, y + ay), rel=1e-5)


def test_the_table_and_the_diagrams_hold_the_recorded_errors(page, two_station):
    page.run("seek(9)")
    for i, (name, told) in enumerate(two_station[1].items()):
        cells = page.run("return Array.from(figures.tBodies[0].rows[arguments[0]].cells, (c) => c.textContent)", i)
        error, bound = (part[9].mean() for part in told.errors["range"])
        assert cells[0] == name
        assert [in_metres(cell) for cell in cells[1:3]] == pytest.approx([error, bound], rel=0.01)
        assert float(cells[3]) == pytest.approx(np.nansum(told.rewards["log_range_error"][:10]), abs=0.006)
    curve = next(t for t in traces(page, 2) if t["y"] is not None)
    assert curve["y"] == pytest.approx(two_station[1]["paper"].errors["range"][0].mean(-1), rel=1e-5)


def in_metres(text: str) -> float:
    value, unit = text.split()
    return float(value) * {"m": 1.0, "km": 1e3}[unit]


def test_hovering_tells_values(page):
    page.run("seek(5)")
    page.run(
        """const div = document.querySelector('.js-plotly-plot');
        const curve = div.data.findIndex((t) => (t.hovertext ?? []).some((text) => text.includes('weight')));
        Plotly.Fx.hover(div, [{curveNumber: curve, pointNumber: 0}]);"""
    )
    told = page.value("document.querySelector('.js-plotly-plot .hovertext').textContent")
    assert re.search(r"range hypothesis.*weight 0\.\d{3}.*at -?\d+\.\d\d, -?\d+\.\d\d", told)


# ------------------------------------------------------------------------------------------------ playing


def test_plays_to_the_end_and_pauses(page):
    button = page.find("#play")
    assert (button.text, now(page)) == ("Play", 0)
    page.run("setSpeed(0.25)")
    button.click()
    assert button.text == "Pause"
    page.wait_for("state.k >= 1")
    button.click()
    stopped = now(page)
    assert button.text == "Play"
    page.run("return new Promise((done) => setTimeout(done, 700))")
    assert now(page) == stopped < STEPS
    page.run("setSpeed(8)")
    button.click()
    page.wait_for(f"state.k === {STEPS} && !state.playing")
    assert button.text == "Play"
    button.click()  # once more from the start
    page.wait_for("state.playing && state.k < 12 || !state.playing")
    page.wait_for("!state.playing")
    assert now(page) == STEPS
    assert page.complaints() == []


def test_speed_is_steps_per_second(page):
    """At speed 1 eight steps take a second: time of the page's own clock between two instants shown."""
    script = """const done = arguments[arguments.length - 1], seen = [];
        const watch = (time) => {
            seen.push([time, state.k]);
            if (state.playing) requestAnimationFrame(watch); else done(seen);
        };
        play(true);
        watch(performance.now());"""
    page.driver.set_script_timeout(60)
    page.run("setSpeed(1)")
    seen = page.driver.execute_async_script(script)
    duration_s = (seen[-1][0] - seen[0][0]) / 1e3
    assert seen[-1][1] == STEPS
    assert duration_s >= 0.9 * STEPS / 8  # a slow machine leaves steps out; none is shown too early


def test_scrubs_by_slider_and_buttons(page):
    slider = page.find("#time")
    width = slider.size["width"]
    from selenium.webdriver.common.action_chains import ActionChains

    ActionChains(page.driver).move_to_element(slider).click_and_hold().move_by_offset(width // 2, 0).release().perform()
    assert now(page) == STEPS
    assert slider.get_attribute("aria-valuetext") == f"t = {2 * STEPS} s (step {STEPS} of {STEPS})"
    for button, k in (("back", STEPS - 1), ("first", 0), ("next", 1), ("next", 2), ("last", STEPS)):
        page.find(f"#{button}").click()
        assert now(page) == k
    assert "range error" in page.find("[role=status]").get_attribute("textContent")


def test_a_click_on_a_diagram_goes_to_that_time(page):
    place = page.run(
        """document.getElementById('together').scrollIntoView(); const div = document.querySelectorAll('.plot')[2];
        return div.getBoundingClientRect().width"""
    )
    page.wait_for("document.querySelectorAll('.plot')[2].querySelector('.nsewdrag') !== null")
    from selenium.webdriver.common.action_chains import ActionChains

    area = page.driver.find_elements("css selector", ".plot")[2].find_element("css selector", ".nsewdrag")
    half = area.size["width"] / 2
    ActionChains(page.driver).move_to_element_with_offset(area, int(-0.5 * half), 0).pause(0.3).click().perform()
    page.wait_for("state.k > 0")
    assert place > 500
    assert now(page) == round(0.25 * STEPS)


# ------------------------------------------------------------------------------------------------ without a mouse


def test_keys(page):
    right, left, end, home = "\ue014", "\ue012", "\ue010", "\ue011"
    for key, k in ((right, 1), (right, 2), (left, 1), (end, STEPS), (home, 0)):
        page.press(key)
        assert now(page) == k
    page.find("body").send_keys("\ue008" + right)  # with Shift
    assert now(page) == 10
    page.press(">")
    assert page.value("document.getElementById('speed').value") == "2"
    page.press("<", "<")
    assert page.value("document.getElementById('speed').value") == "0.5"
    page.press(" ")
    assert page.value("state.playing")
    page.press(" ")
    assert not page.value("state.playing")


def test_every_control_can_be_reached_by_tab_and_has_a_name(page):
    reached = []
    for _ in range(40):
        page.press("\ue004")
        reached.append(page.value("document.activeElement.id || document.activeElement.dataset.layer"))
    for name in ("first", "back", "play", "next", "last", "time", "speed", "closer", "farther", "fit", "estimates"):
        assert name in reached, name
    assert page.unnamed() == []


def test_a_focused_button_keeps_its_space_key(page):
    page.run("document.getElementById('next').focus()")
    page.press(" ")
    assert now(page) == 1
    assert not page.value("state.playing")


def test_the_slider_speaks_in_words(page):
    page.run("document.getElementById('time').focus()")
    page.press("\ue014")
    assert now(page) == 1
    assert page.find("#time").get_attribute("aria-valuetext") == f"t = 2 s (step 1 of {STEPS})"


# ------------------------------------------------------------------------------------------------ layers, zoom


def test_switches_every_layer_off_and_on(page):
    page.run("seek(6)")
    before = traces(page)
    boxes = page.driver.find_elements("css selector", "#layers input")
    assert len(boxes) == 6
    for box in boxes:
        box.click()
        fewer = traces(page)
        assert len(fewer) < len(before), box.get_attribute("data-layer")
        box.send_keys(" ")
        assert len(traces(page)) == len(before)
    for box in boxes:
        box.click()
    assert traces(page) == traces(page, 1) == []


def test_all_maps_zoom_together_about_the_targets_and_fit_again(page, two_station):
    whole = ranges(page, 0)
    page.run("seek(8)")
    page.press("z")
    nearer = ranges(page, 0)
    assert ranges(page, 1) == nearer
    truth = two_station[1]["paper"].views[0].layers["true targets"][8, :, 0, :2].mean(0)
    assert np.mean(nearer[0]) == pytest.approx(truth[0], abs=1e-3)
    assert np.mean(nearer[1]) == pytest.approx(truth[1], abs=1e-3)
    assert np.ptp(nearer[0]) == pytest.approx(0.6 * np.ptp(whole[0]), rel=1e-3)
    page.find("#farther").click()
    assert np.ptp(ranges(page, 0)[0]) == pytest.approx(np.ptp(whole[0]), rel=1e-3)
    page.find("#fit").click()
    assert ranges(page, 0) == whole


def test_panning_one_map_moves_the_others(page):
    from selenium.webdriver.common.action_chains import ActionChains

    whole = ranges(page, 0)
    area = page.find(".js-plotly-plot .nsewdrag")
    ActionChains(page.driver).drag_and_drop_by_offset(area, 60, 20).perform()
    page.wait_for("state.zoom.size > 0")
    assert ranges(page, 0) != whole
    assert ranges(page, 1) == ranges(page, 0)


def ranges(page: Page, plot: int) -> list[list[float]]:
    script = """const layout = document.querySelectorAll('.js-plotly-plot')[arguments[0]].layout;
        return [layout.xaxis.range, layout.yaxis.range]"""
    return page.run(script, plot)


# ------------------------------------------------------------------------------------------------ looks


@pytest.mark.parametrize(("size", "touch"), [(DESKTOP, False), (PHONE, True), ((320, 640), True)])
def test_fits_the_screen_and_is_not_blank(chromium, two_station, size, touch):
    page = Page(chromium, two_station[0], READY, size, touch)
    page.run("seek(6)")
    assert page.value("document.documentElement.scrollWidth") <= size[0]
    assert page.is_drawn()
    lefts = page.value("Array.from(document.querySelectorAll('#maps article'), (a) => a.getBoundingClientRect().left)")
    assert len(set(lefts)) == (2 if size == DESKTOP else 1)  # side by side, or below each other
    smallest = page.value("Math.min(...Array.from(document.querySelectorAll('button'), (b) => b.offsetHeight))")
    assert smallest >= 40


def test_follows_a_dark_screen(chromium, two_station):
    dark = {"features": [{"name": "prefers-color-scheme", "value": "dark"}]}
    chromium.execute_cdp_cmd("Emulation.setEmulatedMedia", dark)
    try:
        page = Page(chromium, two_station[0], READY)
        assert page.screenshot().mean() < 80
        assert page.complaints() == []
    finally:
        chromium.execute_cdp_cmd("Emulation.setEmulatedMedia", {"features": []})


def test_a_phone_scrolls_over_maps(chromium, two_station):
    """Maps do not catch the finger that scrolls the page."""
    page = Page(chromium, two_station[0], READY, PHONE, touch=True)
    assert page.value("document.querySelector('.js-plotly-plot').layout.dragmode") is False
