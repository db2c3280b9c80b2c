"""The report of a benchmark in a browser: it sorts, filters and draws, on a desktop, a phone and paper."""

from __future__ import annotations

import base64
import itertools
import math
import os
from dataclasses import replace
from pathlib import Path

import pytest

pytest.importorskip("selenium", reason="needs selenium")
pytest.importorskip("arch", reason="needs the extra bench")
pytest.importorskip("matplotlib", reason="needs the extra figures")

from selenium.webdriver.common.by import By
from selenium.webdriver.common.keys import Keys
from selenium.webdriver.support.ui import Select

from baselines.benchmark.aggregate import leaderboard
from baselines.benchmark.bench import run_bench
from baselines.benchmark.plan import Plan
from baselines.benchmark.replays import headline, write_replays
from baselines.benchmark.report import write_report
from baselines.pages.replay import write_replay

PLAN = Plan(
    policies=("reference:consistent", "pure_pursuit", "feedback_linearisation:bounded+truth+grip"),
    tasks=("infinity", "flower"),
    disturbances=("nominal", "start", "ice"),
    seeds=(20_000, 20_004),
    overrides=(("horizon_s", 8.0), ("plant", "batch")),
)
SHOTS = os.environ.get("TLF_SCREENSHOTS")  # a folder for pictures of the pages


def report(plan: Plan, folder: Path, replays: int) -> Path:
    results = run_bench(plan, folder)
    board = leaderboard(results, "tlf bench --plan own.yaml")
    ranked = [row["policy"] for row in board["policies"]]
    chosen = headline(results.ordered(), ranked, replays)
    written = write_replays(plan, chosen, folder, write_replay)
    return write_report(results, board, folder, written)


@pytest.fixture(scope="module")
def page(tmp_path_factory) -> Path:
    return report(PLAN, tmp_path_factory.mktemp("report"), 4)


@pytest.fixture(scope="module")
def swept(tmp_path_factory) -> Path:
    plan = replace(
        PLAN,
        tasks=("infinity",),
        disturbances=("nominal",),
        sweep="slip.delta_1_mm_s",
        sweep_values=(0.0, 20.0, 60.0),
        seeds=(20_000, 20_002),
    )
    return report(plan, tmp_path_factory.mktemp("sweep"), 0)


def picture(browser, name: str) -> None:
    """A picture of the whole page, for a person to look at."""
    if SHOTS:
        shot = browser.execute_cdp_cmd("Page.captureScreenshot", {"captureBeyondViewport": True})
        Path(SHOTS).mkdir(parents=True, exist_ok=True)
        (Path(SHOTS) / f"{name}.png").write_bytes(base64.b64decode(shot["data"]))


def column(table, number: int) -> list[str]:
    cells = table.find_elements(By.CSS_SELECTOR, f"tbody td:nth-child({number + 1})")
    return [cell.get_attribute("data-v") for cell in cells]


def in_order(values: list[str], down: bool) -> bool:
    """Whether values are sorted, the empty ones last."""
    known = [value for value in values if value != ""]
    if "" in values[: len(known)]:
        return False
    try:
        keys: list = [float(value) for value in known]
    except ValueError:
        keys = [value.casefold() for value in known]
    pairs = itertools.pairwise(keys)
    return all(a >= b if down else a <= b for a, b in pairs)


@pytest.mark.parametrize("name", ["board", "against", "all"])
def test_every_column_sorts_by_click_and_by_key(opened, page, complaints, name):
    table = opened(page).find_element(By.ID, name)
    heads = table.find_elements(By.CSS_SELECTOR, "thead th")
    rows = len(table.find_elements(By.CSS_SELECTOR, "tbody tr"))
    for number, head in enumerate(heads):
        button = head.find_element(By.TAG_NAME, "button")
        button.send_keys(Keys.ENTER)
        assert head.get_attribute("aria-sort") == "ascending"
        assert in_order(column(table, number), down=False), number
        button.send_keys(Keys.SPACE)
        assert head.get_attribute("aria-sort") == "descending"
        assert in_order(column(table, number), down=True), number
        others = [one.get_attribute("aria-sort") for one in heads if one != head]
        assert set(others) == {"none"}
    heads[0].find_element(By.TAG_NAME, "button").click()
    assert heads[0].get_attribute("aria-sort") == "ascending"
    assert len(table.find_elements(By.CSS_SELECTOR, "tbody tr")) == rows
    assert complaints() == []


def test_the_filters_leave_what_fits(opened, page, complaints):
    browser = opened(page)
    rows = browser.find_elements(By.CSS_SELECTOR, "#all tbody tr")
    assert len(rows) == 3 * 2 * 3
    Select(browser.find_element(By.ID, "by-task")).select_by_visible_text("flower")
    Select(browser.find_element(By.ID, "by-disturbance")).select_by_visible_text("ice")
    visible = [row for row in rows if row.is_displayed()]
    assert len(visible) == 3
    for row in visible:
        texts = [cell.text for cell in row.find_elements(By.TAG_NAME, "td")[:3]]
        assert texts[1:] == ["flower", "ice"]
    assert browser.find_element(By.ID, "shown").text == "3 of 18 rows"
    Select(browser.find_element(By.ID, "by-policy")).select_by_visible_text("pure_pursuit")
    assert sum(row.is_displayed() for row in rows) == 1
    assert complaints() == []


def test_a_press_on_a_number_shows_its_runs_and_their_commands(opened, page, complaints):
    browser = opened(page)
    numbers = browser.find_elements(By.CSS_SELECTOR, "#heat-map button")
    assert len(numbers) == 3 * 3
    for number in numbers:
        number.click()
        chosen = browser.find_element(By.ID, "chosen")
        commands = [one.text for one in chosen.find_elements(By.TAG_NAME, "code")]
        assert len(commands) == 2
        for command in commands:
            assert command.startswith("tlf run infinity --disturbance ")
            assert "--horizon-s 8 --plant batch" in command
    assert len(browser.find_elements(By.CSS_SELECTOR, "#heat-map button[aria-pressed=true]")) == 1
    copy = browser.find_element(By.CSS_SELECTOR, "#chosen .copy")
    browser.execute_cdp_cmd(
        "Browser.grantPermissions",
        {"permissions": ["clipboardReadWrite", "clipboardSanitizedWrite"]},
    )
    copy.click()
    assert copy.text in ("copied", "copy")
    said = browser.execute_async_script(
        "const done = arguments[0]; navigator.clipboard.readText().then(done, () => done(null));"
    )
    assert said in (None, commands[0])
    assert complaints() == []


def test_the_charts_follow_what_is_chosen(opened, page, complaints):
    browser = opened(page)
    for task in ("flower", "infinity"):
        Select(browser.find_element(By.ID, "task")).select_by_visible_text(task)
        for metric in range(6):
            Select(browser.find_element(By.ID, "metric")).select_by_index(metric)
            shown = [one.text for one in browser.find_elements(By.CSS_SELECTOR, "#heat-map button")]
            assert len(shown) == 9
            numbers = [float(one) for one in shown if one != "–"]
            assert all(map(math.isfinite, numbers))
        Select(browser.find_element(By.ID, "disturbance")).select_by_visible_text("start")
        assert browser.find_element(By.ID, "chart-title").text.startswith(f"{task}, start")
        panels = browser.find_elements(By.CSS_SELECTOR, "#chart-panels svg")
        assert len(panels) == 3
        for panel in panels:
            assert len(panel.find_elements(By.CSS_SELECTOR, "circle")) == 3
            assert "NaN" not in panel.get_attribute("outerHTML")
    assert len(browser.find_elements(By.CSS_SELECTOR, "#profile-panels polyline")) == 3
    assert complaints() == []


def test_links_lead_to_files(opened, page, complaints):
    browser = opened(page)
    links = {one.get_attribute("href") for one in browser.find_elements(By.TAG_NAME, "a")}
    assert len(links) == 4
    for link in links:
        browser.get(link)
        assert browser.title
        assert complaints() == []


def test_a_sweep_draws_bands_and_lines(opened, swept, complaints, overflow):
    browser = opened(swept)
    panels = browser.find_elements(By.CSS_SELECTOR, "#sweep-panels svg")
    assert len(panels) == 2
    for panel in panels:
        assert len(panel.find_elements(By.CSS_SELECTOR, "polyline")) == 3
        assert "NaN" not in panel.get_attribute("outerHTML")
    assert len(panels[0].find_elements(By.CSS_SELECTOR, "polygon")) == 3
    key = browser.find_element(By.CSS_SELECTOR, "#sweep-legend button")
    key.click()
    assert len(browser.find_elements(By.CSS_SELECTOR, "#sweep-panels g.faded")) == 2 * 2
    key.click()
    assert not browser.find_elements(By.CSS_SELECTOR, "#sweep-panels g.faded")
    assert overflow() == []
    assert complaints() == []
    picture(browser, "sweep")


@pytest.mark.parametrize("name", ["light", "dark"])
def test_both_themes_are_legible(opened, page, theme, complaints, name):
    theme(name)
    browser = opened(page)
    browser.execute_script("localStorage.clear()")
    browser.find_elements(By.CSS_SELECTOR, "#heat-map button")[4].click()
    for element in ("body", "#heat-map button", "#board td"):
        assert contrast(browser, element) > 4.5, element
    picture(browser, name)
    button = browser.find_element(By.CSS_SELECTOR, "#theme button")
    other = {"light": "dark", "dark": "light"}[name]
    assert button.text == f"{other} colours"
    button.click()
    assert browser.execute_script("return document.documentElement.dataset.theme") == other
    for element in ("body", "#heat-map button"):
        assert contrast(browser, element) > 4.5, element
    browser.execute_script("localStorage.clear()")
    assert complaints() == []


def contrast(browser, selector: str) -> float:
    """The least contrast ratio, after WCAG, of the texts of some elements on their grounds."""
    return browser.execute_script(
        """
        const canvas = document.createElement('canvas').getContext('2d', {willReadFrequently: true});
        const pixel = (colour) => {
          canvas.clearRect(0, 0, 1, 1);
          canvas.fillStyle = colour;
          canvas.fillRect(0, 0, 1, 1);
          return canvas.getImageData(0, 0, 1, 1).data;
        };
        const light = (p) => [0.2126, 0.7152, 0.0722].reduce((sum, w, i) => {
          const c = p[i] / 255;
          return sum + w * (c <= 0.04045 ? c / 12.92 : ((c + 0.055) / 1.055) ** 2.4);
        }, 0);
        let least = 99;
        for (const one of document.querySelectorAll(arguments[0])) {
          let ground = one;
          while (ground && !pixel(getComputedStyle(ground).backgroundColor)[3]) ground = ground.parentElement;
          const a = light(pixel(getComputedStyle(one).color));
          const b = light(pixel(getComputedStyle(ground || document.body).backgroundColor));
          least = Math.min(least, (Math.max(a, b) + 0.05) / (Math.min(a, b) + 0.05));
        }
        return least;
        """,
        selector,
    )


def test_a_phone_shows_all_of_it_without_moving_sideways(
    phone, opened, page, swept, overflow, complaints
):
    for one in (swept, page):
        browser = opened(one)
        assert browser.execute_script("return innerWidth") == 390
        browser.find_element(By.CSS_SELECTOR, "#heat-map button").click()
        browser.execute_script(
            "for (const one of document.querySelectorAll('details')) one.open = true;"
        )
        assert overflow() == []
    picture(browser, "phone")
    assert complaints() == []


def test_on_paper_the_ground_is_white_and_the_controls_are_gone(opened, page, theme, browser):
    theme("dark")
    opened(page)
    browser.execute_cdp_cmd("Emulation.setEmulatedMedia", {"media": "print"})
    assert (
        browser.execute_script("return getComputedStyle(document.body).backgroundColor")
        == "rgb(255, 255, 255)"
    )
    assert not any(one.is_displayed() for one in browser.find_elements(By.CSS_SELECTOR, ".screen"))
    assert contrast(browser, "#heat-map button") > 4.5
    pdf = browser.execute_cdp_cmd("Page.printToPDF", {"preferCSSPageSize": True})
    assert base64.b64decode(pdf["data"]).startswith(b"%PDF")
