"""The pages on the families of disturbances: channels, presets, snippets, tables and pictures."""

from __future__ import annotations

import importlib
import math
import re
import sys

import numpy as np
import pytest
import yaml
from page_tables import DOCS, rows_of

pytest.importorskip("matplotlib")

from tlf_env.common.presets import preset_names
from tlf_env.disturbances.channels import CHANNELS, PATHS
from tlf_env.disturbances.table import unit
from tlf_env.task.scenario import load_scenario

sys.path.insert(0, str(DOCS / "figures"))
make_families = importlib.import_module("make_families")
make_limits = importlib.import_module("make_limits")
family_runs = importlib.import_module("family_runs")
family_devices = importlib.import_module("family_devices")

FAMILIES = make_families.FAMILIES
PAGES = {
    name: (DOCS / "disturbances" / f"{name}.md").read_text(encoding="utf-8") for name in FAMILIES
}
every_family = pytest.mark.parametrize("family", FAMILIES)
SNIPPETS = [
    (family, text)
    for family, page in PAGES.items()
    for text in re.findall(r"```yaml\n(.*?)```", page, re.DOTALL)
]


def rows(family):
    """The cells of the table of the entries, by the text of the first."""
    return rows_of(f"disturbances/{family}.md", "entries")


# --- pages ---------------------------------------------------------------------------------------


def test_every_family_has_a_page_a_picture_and_a_link():
    folder = DOCS / "disturbances"
    assert sorted(path.stem for path in folder.glob("*.md")) == sorted(FAMILIES)
    assert sorted(path.stem for path in folder.glob("*.png")) == sorted(FAMILIES)
    assert list(make_families.DRAWINGS) == list(FAMILIES)
    reference = (DOCS / "disturbances.md").read_text(encoding="utf-8")
    for family, page in PAGES.items():
        assert f"(disturbances/{family}.md" in reference
        assert f"]({family}.png)" in page
        assert "(../disturbances.md)" in page


@pytest.mark.parametrize("channel", CHANNELS, ids=PATHS)
def test_every_channel_is_a_knob_of_exactly_one_family(channel):
    (line,) = [
        line
        for page in PAGES.values()
        for line in page.splitlines()
        if line.startswith(f"| `{channel.path}` |")
    ]
    assert line.split(" | ")[1] == unit(channel.path)


def test_no_page_names_a_channel_that_does_not_exist():
    groups = {path.split(".")[0] for path in PATHS}
    for page in PAGES.values():
        named = set(re.findall(r"`(\w+\.\w+)`", page))
        named = {path for path in named if path.split(".")[0] in groups}
        assert named - {"tyre.patches"} <= set(PATHS)


@pytest.mark.parametrize("name", preset_names("disturbance"))
def test_every_preset_is_on_a_page(name):
    assert any(f"`{name}`" in page for page in PAGES.values())


@pytest.mark.parametrize(("family", "text"), SNIPPETS)
def test_every_snippet_is_a_scenario(family, text):
    fields = yaml.safe_load(text)
    assert load_scenario("infinity", **fields) != load_scenario("infinity")


@pytest.mark.parametrize(
    ("family", "name"),
    [
        ("slip", "slip"),
        ("slip", "slip-ramps"),
        ("slip", "slip-noise"),
        ("slip", "slip-sines"),
        ("grip", "split-ice"),
        ("grip", "creep"),
        ("floor", "rolling"),
        ("motors", "actuator"),
        ("motors", "motor"),
        ("sensors", "gyro"),
        ("sensors", "calibration"),
        ("robots", "start"),
        ("robots", "radio"),
    ],
)
def test_the_snippet_of_a_preset_is_the_preset(family, name):
    wanted = load_scenario(disturbance=name).disturbance
    given = [yaml.safe_load(text) for page, text in SNIPPETS if page == family]
    found = [
        load_scenario(disturbance=fields.get("disturbance", {})).disturbance for fields in given
    ]
    assert wanted in [one.model_copy(update={"name": name}) for one in found]


def test_the_snippet_of_different_robots_is_the_scenario_mixed():
    (fields,) = [fields for _, text in SNIPPETS if "robots" in (fields := yaml.safe_load(text))]
    assert load_scenario("infinity", **fields).robot_models == load_scenario("mixed").robot_models


# --- tables --------------------------------------------------------------------------------------


@every_family
def test_the_tables_rows_are_those_of_the_script(family):
    assert f"<!-- entries -->\n| | {' | '.join(make_limits.ENTRIES)} |\n" in PAGES[family]
    found = rows(family)
    assert list(found) == list(FAMILIES[family])
    for cells in found.values():
        assert len(cells) == len(make_limits.ENTRIES)
        assert all(re.fullmatch(r"[\d.e+]+( \(\d+\))?", cell) for cell in cells)


def test_the_nominal_row_is_the_same_on_every_page():
    assert len({tuple(rows(family)["nominal"]) for family in FAMILIES}) == 1


@pytest.mark.parametrize(
    ("family", "name"), [(family, name) for family in FAMILIES for name in FAMILIES[family]]
)
def test_every_row_is_a_scenario_of_its_own(family, name):
    scenario = load_scenario("infinity", plant="batch", **FAMILIES[family][name])
    assert (scenario == load_scenario("infinity", plant="batch")) == (name == "nominal")
    (preset,) = re.findall(r"`([\w-]+)`$", name) or [None]
    if preset in preset_names("disturbance"):
        assert scenario.disturbance.name == preset


def test_every_channel_moves_in_a_row():
    disturbances = [
        load_scenario("infinity", plant="batch", **fields).disturbance
        for table in FAMILIES.values()
        for fields in table.values()
    ]
    for channel in CHANNELS:
        assert any(one.constant(channel.path) != channel.nominal for one in disturbances)


# --- numbers and pictures ------------------------------------------------------------------------


def test_joint_friction_holds_a_robot_on_a_slope_up_to_the_pages_number():
    """Static friction of the joints by eq. (5), as a force, over the weight: sin of the slope."""
    robot = family_runs.ROBOT
    arm_mm, radius_mm = robot.drive_joint.pin_radius_mm, robot.wheel_radius_mm
    drive = 2 * robot.drive_load_share * robot.drive_joint.mu_static * arm_mm / radius_mm
    castor = (
        robot.castor_load_share
        * robot.castor_joint.mu_static
        * robot.castor_joint.pin_radius_mm
        / robot.castor_radius_mm
    )
    slope = math.asin(drive + castor)
    assert f"holds it up to {slope:.2g} rad" in PAGES["floor"]


def test_the_floor_pages_reserve_is_that_of_the_motors():
    robot = family_runs.ROBOT
    force_N = 2 * 2.0 / robot.wheel_radius_mm  # two motors with 2 N·mm each
    weight_N = robot.mass_kg * robot.gravity_mm_s2 / 1000
    assert f"or {force_N:.2g} N of force" in PAGES["floor"]
    assert f"a slope of {force_N / weight_N:.2g} rad" in PAGES["floor"]


def test_the_allan_deviation_of_white_noise_and_of_a_constant():
    rates = np.random.default_rng(0).normal(size=100_000)
    counts = np.array([1, 10, 100])
    found = family_devices.allan_deviation(rates, 0.01, counts)
    assert found == pytest.approx(1 / np.sqrt(counts), rel=0.05)
    assert family_devices.allan_deviation(np.ones(1000), 0.01, counts) == pytest.approx(0, abs=1e-9)
