"""The replay page in a browser: what it draws is what was recorded, and each control does what it names."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from helpers import Aborted

from baselines.pages.replay import write_comparison, write_replay
from baselines.policies.reference import ReferencePolicy
from baselines.policies.registry import fit_policy
from baselines.runs.run import Record, run_policy
from tlf_env.task.scenario import load_scenario

HOSTILE = "</script><img src=x onerror=\"document.title='ran'\">"


def made(policy: str) -> Record:
    fitted = fit_policy(policy, load_scenario("infinity", disturbance="slip", horizon_s=12.0))
    return run_policy(fitted.scenario, fitted.policy, 0, name=policy)


@pytest.fixture(scope="module")
def records() -> list[Record]:
    return [made("reference:consistent"), made("reference:linearised")]


@pytest.fixture(scope="module")
def single(records, tmp_path_factory) -> Path:
    return write_replay(records[1], tmp_path_factory.mktemp("page") / "replay.html")


@pytest.fixture(scope="module")
def both(records, tmp_path_factory) -> Path:
    return write_comparison(records, tmp_path_factory.mktemp("page") / "compare.html")


@pytest.fixture
def at(browser):
    """Opens a page at a time, without playing; returns the browser."""

    def open_at(path: Path, t_s: float):
        browser.get("about:blank")  # so that an address with another time is loaded, too
        browser.get(f"{path.resolve().as_uri()}#t={t_s}")
        return browser

    return open_at


def scrub(browser, t_s: float) -> None:
    """Move the slider as a hand would."""
    browser.execute_script(
        "const slider = document.querySelector('input[type=range]'); slider.value = arguments[0];"
        "slider.dispatchEvent(new Event('input'));",
        t_s,
    )


def press(browser, key: str) -> None:
    browser.execute_script(
        "document.body.dispatchEvent(new KeyboardEvent('keydown', {key: arguments[0], bubbles: true}))",
        key,
    )


def state(browser, name: str):
    return browser.execute_script(f"return Replay.state.{name}")


# The colour of the canvas in the middle of a robot's nose, and the colour of the robot.
NOSE = """
const [number, robot] = arguments, {run, plane} = Replay.columns[number], view = Replay.view;
const [x, y, theta] = run.pose(run.row(Replay.state.t), robot);
const nose = run.robots[robot].nose;
const e = nose.reduce((sum, p) => sum + p[0], 0) / 3, f = nose.reduce((sum, p) => sum + p[1], 0) / 3;
const px = plane.clientWidth / 2 + (x + e * Math.cos(theta) - f * Math.sin(theta) - view.x) * view.scale;
const py = plane.clientHeight / 2 - (y + e * Math.sin(theta) + f * Math.cos(theta) - view.y) * view.scale;
const ratio = devicePixelRatio;
const data = plane.getContext('2d').getImageData(Math.round(px * ratio), Math.round(py * ratio), 1, 1).data;
return [[x, y, theta], [...data].slice(0, 3), run.robots[robot].colour];
"""


@pytest.mark.parametrize("t_s", [0.0, 3.14, 7.7, 12.0])
def test_scrubbing_moves_the_robots_to_the_recorded_poses(t_s, single, records, at, complaints):
    page = at(single, 0.0)
    page.execute_script("Replay.view.scale = 1;")
    scrub(page, t_s)
    assert not complaints()  # before the pixels are read, of which the browser warns
    record = records[1]
    row = round(t_s / 0.02)
    for robot in range(record.robots):
        page.execute_script(
            "Replay.state.arrows = false; Replay.state.trail_s = 0;"
            "[Replay.view.x, Replay.view.y] = arguments[0]; Replay.draw();",
            [float(record["x_mm"][row, robot]), float(record["y_mm"][row, robot])],
        )
        pose, pixel, colour = page.execute_script(NOSE, 0, robot)
        wanted = [record[name][row, robot] for name in ("x_mm", "y_mm", "theta_rad")]
        assert pose == pytest.approx(wanted, abs=1e-3)
        assert pixel == [int(colour[i : i + 2], 16) for i in (1, 3, 5)]


def test_plots_and_canvas_agree_on_the_time(both, at):
    page = at(both, 2.0)
    for t_s in (5.5, 9.98):
        scrub(page, t_s)
        cursors = page.execute_script(
            "return Replay.columns.flatMap(({plots}) => plots.map((plot) => plot.cursor.t))"
        )
        assert len(cursors) == 2 * 5
        assert cursors == pytest.approx([t_s] * len(cursors), abs=1e-5)
        assert page.find_element("css selector", "output").text.startswith(f"{t_s:.2f} s")


def test_a_drag_in_a_plot_moves_the_time(single, at):
    from selenium.webdriver import ActionChains

    page = at(single, 0.0)
    plot = page.find_elements("css selector", "canvas.plot")[2]
    ActionChains(page).move_to_element(plot).click().perform()
    now = state(page, "t")
    assert 4.0 < now < 8.0
    ActionChains(page).click_and_hold(plot).move_by_offset(40, 0).release().perform()
    assert state(page, "t") > now + 0.5


def test_counters_are_those_of_the_record(both, records, at):
    page = at(both, 10.0)
    counts = [one.text for one in page.find_elements("css selector", ".count")]
    for record, text in zip(records, counts, strict=True):
        error = record["position_error_mm"]
        settled = round(record.scenario.settle_s / 0.02)
        rms = np.sqrt((error[settled:501] ** 2).mean(axis=0)).max()
        lost = int((record.lost_at_s <= 10.0).sum())
        assert f"worst error {error[500].max():.1f} mm" in text
        assert f"lost {lost} of 3" in text
        shown = float(text.partition("RMS since 4.8 s ")[2].partition(" mm")[0])
        assert shown == pytest.approx(rms, abs=0.01 + 1e-3 * rms)


def test_a_comparison_shows_each_run(both, at, complaints):
    page = at(both, 8.0)
    heads = [one.text for one in page.find_elements("css selector", ".run h2")]
    assert heads == ["A: reference:consistent", "B: reference:linearised"]
    drawn = page.execute_script(
        """
        return [...document.querySelectorAll('canvas')].map((canvas) => {
          const data = canvas.getContext('2d').getImageData(0, 0, canvas.width, canvas.height).data;
          return new Set(new Uint32Array(data.buffer)).size;
        });
        """
    )
    assert len(drawn) == 2 * 6
    assert min(drawn) > 10  # colours in each canvas
    cells = [one.text for one in page.find_elements("css selector", "#differences td:first-child")]
    assert "policy" in cells
    assert "robots lost" in cells
    press(page, "o")
    planes = page.find_elements("css selector", "canvas.plane")
    assert [one.is_displayed() for one in planes] == [True, False]
    press(page, "o")
    assert planes[1].is_displayed()
    assert not complaints()


@pytest.mark.parametrize(
    ("key", "name", "value"),
    [
        (" ", "playing", True),
        ("ArrowRight", "t", 3.02),
        ("ArrowLeft", "t", 2.98),
        ("Home", "t", 0),
        ("End", "t", 12),
        ("]", "speed", 2),
        ("[", "speed", 0.5),
        ("2", "follow", 1),
        ("t", "trail_s", 30),
        ("g", "ghosts", False),
        ("s", "arrows", False),
    ],
)
def test_each_key_changes_what_it_names(key, name, value, single, at):
    page = at(single, 3.0)
    press(page, key)
    assert state(page, name) == pytest.approx(value, abs=1e-4)


def test_zoom_pan_and_the_whole_path(single, at):
    from selenium.webdriver import ActionChains

    page = at(single, 3.0)
    view = "return [Replay.view.x, Replay.view.y, Replay.view.scale]"
    start = page.execute_script(view)
    press(page, "+")
    assert page.execute_script(view)[2] == pytest.approx(1.3 * start[2])
    plane = page.find_element("css selector", "canvas.plane")
    ActionChains(page).drag_and_drop_by_offset(plane, 30, 20).perform()
    x, y, scale = page.execute_script(view)
    assert (x, y) == pytest.approx((start[0] - 30 / scale, start[1] + 20 / scale), rel=0.02)
    press(page, "0")
    assert page.execute_script(view) == pytest.approx(start, rel=1e-6)


def test_it_plays_by_itself_and_ends(single, browser):
    from selenium.webdriver.support.ui import WebDriverWait

    browser.get(single.resolve().as_uri())
    WebDriverWait(browser, 10).until(lambda page: state(page, "t") > 0.1)
    browser.execute_script("Replay.state.t = 11.9;")
    WebDriverWait(browser, 10).until(lambda page: not state(page, "playing"))
    assert state(browser, "t") == pytest.approx(12.0)


def test_both_themes_and_a_phone(both, at, phone, theme, overflow, complaints):
    grounds = []
    for name in ("light", "dark"):
        theme(name)
        page = at(both, 4.0)
        assert overflow() == []
        assert page.execute_script("return Replay.dark()") == (name == "dark")
        pixel = page.execute_script(
            "return [...document.querySelector('canvas.plane').getContext('2d').getImageData(3, 3, 1, 1).data]"
        )
        grounds.append(sum(pixel[:3]))
    assert grounds[0] > 600 > 200 > grounds[1]
    plane = page.find_element("css selector", "canvas.plane")
    assert plane.size["width"] > 300
    assert not complaints()


def test_a_name_stays_text(records, tmp_path, at, complaints):
    record = replace(records[0], policy=HOSTILE)
    page = at(write_comparison([record, records[1]], tmp_path / "hostile.html"), 1.0)
    assert HOSTILE in page.find_element("css selector", ".run h2").text
    assert not page.find_elements("css selector", "img")
    assert page.title != "ran"
    page = at(write_replay(record, tmp_path / "one.html"), 1.0)
    assert HOSTILE in page.find_element("css selector", "h1").text
    assert not complaints()


def test_an_aborted_run_is_replayed_to_its_end(tmp_path, at, complaints):
    record = run_policy(
        load_scenario("infinity"), Aborted(), 0, name="aborted", keep_interrupted=True
    )
    page = at(write_replay(record, tmp_path / "replay.html"), 60.0)
    assert state(page, "t") == pytest.approx(1.0)
    assert "interrupted after 1 s of" in page.find_element("css selector", "header").text
    assert not complaints()


@pytest.mark.parametrize(
    "fields",
    [
        {"robots": 1},
        {"robots": 12, "horizon_s": 1.0},
        {"plant": "kinematic"},
        {"horizon_s": 0.02},
        {"disturbance": {"tyre": {"friction_scale": 0.02}}},
    ],
)
def test_odd_runs_are_drawn(fields, tmp_path, at, complaints, phone, overflow):
    scenario = load_scenario("circle", **({"horizon_s": 6.0} | fields))
    record = run_policy(scenario, ReferencePolicy(), 0, name="odd")
    page = at(write_replay(record, tmp_path / "replay.html"), 0.5)
    rows = page.find_elements("css selector", "table.robots tbody tr")
    assert len(rows) == record.robots
    press(page, "End")
    assert state(page, "t") == pytest.approx(record.t_s[-1], abs=1e-5)
    assert overflow() == []
    assert not complaints()
