"""The page of the crossing: made from its cells, which come out again."""

import importlib
import json
import sys
from pathlib import Path

import pytest

pytest.importorskip("arch")
pytest.importorskip("matplotlib")

from helpers import benched

from baselines.benchmark.bench import run_episode
from baselines.benchmark.plan import Episode, Plan, read_plan
from baselines.cli import PLAN_OPTIONS
from baselines.policies.systems import parse_system

ROOT = Path(__file__).parent.parent
DOCS = ROOT / "docs"
sys.path.insert(0, str(DOCS / "figures"))
make_crossing = importlib.import_module("make_crossing")

CELLS = json.loads((DOCS / make_crossing.CELLS).read_text("utf-8"))
LINES = [json.loads(one) for one in (DOCS / make_crossing.SLICE).read_text("utf-8").splitlines()]


def test_the_page_is_that_of_the_cells():
    page = (DOCS / make_crossing.PAGE).read_text("utf-8")
    assert make_crossing.page_of(page, CELLS) == page


def test_the_cells_are_those_of_the_plan():
    names = ("crossing", "crossing-slow", "crossing-moving-horizon")
    plans = [read_plan(name, PLAN_OPTIONS) for name in names]
    wanted = {
        (policy, disturbance)
        for plan in plans
        for policy in plan["policies"].split(",")
        for disturbance in plan["disturbances"].split(",")
    }
    assert {(cell["policy"], cell["disturbance"]) for cell in CELLS} == wanted
    for cell in CELLS:
        slow = "nmpc" in cell["policy"] or "moving-horizon" in cell["policy"]
        assert cell["runs"] >= (16 if slow else 100)


@pytest.mark.parametrize("line", LINES, ids=lambda line: f"{line['policy']} {line['disturbance']}")
def test_a_run_of_each_controller_comes_out_again(line):
    if line["policy"].startswith("nmpc"):
        pytest.importorskip("casadi")
    plan = Plan(
        (), (), (), (0, 0), overrides=(("horizon_s", 60.0), ("plant", "batch"))
    )  # an episode names the rest
    again = run_episode(plan, Episode.of_line(line))
    assert again["scenario_hash"] == line["scenario_hash"]
    lost = [any(robot["lost"] for robot in run["robots"]) for run in (again, line)]
    assert lost[0] == lost[1]
    if not lost[0]:  # a lost run is chaotic: its numbers hold on one machine only
        for now, then in zip(again["robots"], line["robots"], strict=True):
            assert now["position_rmse_mm"] == pytest.approx(then["position_rmse_mm"], rel=0.01)


def cell(failed: int, median_mm: float | None, runs: int = 100) -> dict:
    interval_mm = None if median_mm is None else [0.9 * median_mm, 1.2 * median_mm]
    return {"runs": runs, "failed": failed, "median_mm": median_mm, "interval_mm": interval_mm}


def test_a_cell_has_an_interval_and_the_failed_runs():
    assert make_crossing.shown(cell(0, 1.0)) == "1.00 [0.90, 1.20]"
    assert make_crossing.shown(cell(3, 20.0)) == "20.0 [18.0, 24.0] (3)"
    assert make_crossing.shown(cell(50, 20.0)) == "(50)"
    assert make_crossing.shown(cell(100, None)) == "(100)"


def test_every_system_has_its_row_on_the_table_of_its_estimator():
    for estimator in make_crossing.estimators(CELLS):
        rows = make_crossing.table(CELLS, estimator).splitlines()[2:]
        systems = {parse_system(cell["policy"]) for cell in CELLS}
        assert len(rows) == sum(system.estimator == estimator for system in systems)


@pytest.fixture(scope="module")
def results(tmp_path_factory):
    plan = (
        "policies: {controllers: [kanayama], estimators: [ekf, truth], limiters: [none]}\n"
        "tasks: infinity\ndisturbances: [nominal, ice]\nplant: batch\n"
    )
    words = "--seeds 20000:20002 --horizon-s 12"
    return benched(tmp_path_factory.mktemp("crossed"), plan, words)


def test_results_make_the_page_twice_alike(results, tmp_path):
    (tmp_path / "docs").mkdir()
    page = tmp_path / "docs" / make_crossing.PAGE
    marks = "".join(f"<!-- {one} -->\nold\n<!-- end of {one} -->\n" for one in ("ekf", "truth"))
    page.write_text(marks)
    make_crossing.write_crossing([results], tmp_path)
    made = page.read_text()
    assert "old" not in made
    assert made.count("| `kanayama` | `none` | 2 |") == 2
    make_crossing.write_crossing([results], tmp_path)
    assert page.read_text() == made
    assert len((tmp_path / "docs" / make_crossing.SLICE).read_text().splitlines()) == 1


def test_results_are_added_to_those_of_other_systems(results, tmp_path):
    (tmp_path / "docs" / "crossing").mkdir(parents=True)
    page = tmp_path / "docs" / make_crossing.PAGE
    marks = "".join(f"<!-- {one} -->\nold\n<!-- end of {one} -->\n" for one in ("ekf", "truth"))
    page.write_text(marks)
    other = {**cell(1, 5.0), "policy": "lqr+truth+none", "disturbance": "nominal"}
    mine = {**cell(0, 7.0), "policy": "kanayama+ekf+none", "disturbance": "nominal"}
    both = [one | {"disturbance": name} for one in (other, mine) for name in ("nominal", "ice")]
    (tmp_path / "docs" / make_crossing.CELLS).write_text(json.dumps(both))
    (tmp_path / "docs" / make_crossing.SLICE).write_text('{"policy": "lqr+truth+none"}\n')
    make_crossing.write_crossing([results], tmp_path, add=True)
    cells = json.loads((tmp_path / "docs" / make_crossing.CELLS).read_text())
    assert cells[:2] == both[:2]
    assert len(cells) == 6
    assert {one["median_mm"] for one in cells if one["policy"] == "kanayama+ekf+none"} != {7.0}
    lines = (tmp_path / "docs" / make_crossing.SLICE).read_text().splitlines()
    assert [json.loads(one)["policy"].split("+")[0] for one in lines] == ["lqr", "kanayama"]
    assert "| `lqr` | `none` | 100 | 5.00 [4.50, 6.00] (1) |" in page.read_text()


def test_a_page_without_markers_is_refused_and_nothing_is_written(results, tmp_path):
    (tmp_path / "docs").mkdir()
    (tmp_path / "docs" / make_crossing.PAGE).write_text("no table\n")
    with pytest.raises(ValueError, match=r"crossing\.md must have one line '<!-- ekf -->'"):
        make_crossing.write_crossing([results], tmp_path)
    assert not (tmp_path / "docs" / make_crossing.CELLS).exists()
