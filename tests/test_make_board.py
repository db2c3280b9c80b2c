"""The published pages, made from the results of a small benchmark."""

import importlib
import json
import sys
from pathlib import Path

import pytest

pytest.importorskip("arch")
pytest.importorskip("matplotlib")

from helpers import benched

ROOT = Path(__file__).parent.parent
sys.path.insert(0, str(ROOT / "docs" / "figures"))
make_board = importlib.import_module("make_board")

WORDS = "--horizon-s 12 --seeds 20000:20003 --disturbances nominal,start"
PAGES = (
    "README.md",
    "docs/leaderboard.md",
    "baselines/benchmark/published.json",
    *(
        f"docs/leaderboard/{name}"
        for name in (
            "leaderboard.json",
            "slice.jsonl",
            "scores.png",
            "failures.png",
            "profiles.png",
        )
    ),
)


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A small benchmark."""
    plan = "policies: [reference:tuned, pure_pursuit]\ntasks: infinity\nplant: batch\n"
    return benched(tmp_path_factory.mktemp("results"), plan, WORDS)


@pytest.fixture
def checkout(tmp_path):
    (tmp_path / "README.md").write_text(
        "# Top\n\n<!-- board -->\nold table\n<!-- end of board -->\n\nrest\n"
    )
    return tmp_path


def contents(root: Path) -> dict[str, bytes]:
    return {name: (root / name).read_bytes() for name in PAGES}


def test_every_page_comes_from_the_results_and_comes_out_again(made, checkout):
    make_board.write_board(made, checkout)
    first = contents(checkout)
    make_board.write_board(made, checkout)
    assert contents(checkout) == first
    readme = first["README.md"].decode()
    assert readme.startswith("# Top\n\n<!-- board -->\n")
    assert readme.endswith("<!-- end of board -->\n\nrest\n")
    assert "old table" not in readme
    assert readme.count("| `pure_pursuit` |") == 1
    page = first["docs/leaderboard.md"].decode()
    assert "![Scores](leaderboard/scores.png)" in page
    assert "## reference:tuned against the best other policy" in page


def test_the_slice_is_whole_lines_of_the_results(made, checkout):
    make_board.write_board(made, checkout)
    text = (checkout / "docs/leaderboard/slice.jsonl").read_text()
    lines = [json.loads(one) for one in text.splitlines()]
    assert {(line["policy"], line["disturbance"]) for line in lines} == {
        ("reference:tuned", "nominal"),
        ("pure_pursuit", "start"),
    }
    assert {json.dumps(line) for line in lines} <= set(
        (made / "runs.jsonl").read_text().splitlines()
    )


def damaged(made: Path, folder: Path, name: str, change) -> Path:
    folder.mkdir()
    for path in made.iterdir():
        (folder / path.name).write_bytes(path.read_bytes())
    change(folder / name)
    return folder


def cut_last_line(path: Path) -> None:
    path.write_text("\n".join(path.read_text().splitlines()[:-1]) + "\n")


def other_seeds(path: Path) -> None:
    plan = json.loads(path.read_text())
    plan["plan"]["seeds"] = [20_000, 20_004]
    path.write_text(json.dumps(plan))


@pytest.mark.parametrize(
    ("name", "change", "said"),
    [
        ("leaderboard.json", Path.unlink, "no leaderboard.json; run: tlf bench --plan board"),
        ("runs.jsonl", Path.unlink, "no runs.jsonl"),
        ("runs.jsonl", cut_last_line, "1 of 12 episodes are missing, the first is"),
        ("plan.json", other_seeds, "does not belong to plan.json"),
    ],
)
def test_results_that_miss_something_are_refused_and_nothing_is_written(
    made, checkout, name, change, said
):
    with pytest.raises(ValueError, match=said):
        make_board.write_board(damaged(made, checkout / "results", name, change), checkout)
    assert not (checkout / "docs").exists()
    assert "old table" in (checkout / "README.md").read_text()


@pytest.mark.parametrize("text", ["", "<!-- board -->", "<!-- end of board -->\n<!-- board -->"])
def test_a_page_without_its_markers_is_refused(text, made, checkout):
    (checkout / "README.md").write_text(text)
    with pytest.raises(ValueError, match=r"README\.md must have one line '<!-- board -->'"):
        make_board.write_board(made, checkout)
    assert not (checkout / "docs").exists()


def cell(policy: str, failed: int, error_mm: float | None, runs: int = 100) -> dict:
    return {
        "policy": policy,
        "task": "infinity",
        "disturbance": "ice",
        "runs": runs,
        "success": {"count": runs - failed},
        "position_rmse_mm": {"median": error_mm},
    }


def test_the_best_of_a_column_fails_least_and_then_errs_least():
    cells = [
        cell("a", 0, 3.04),
        cell("b", 0, 3.01),
        cell("d", 50, 9.0),
        cell("c", 1, 0.5),
        cell("e", 100, None),
    ]
    board = {
        "plan": {"plan": {"disturbances": ["ice"]}},
        "cells": cells,
        "policies": [{"policy": one["policy"], "score": {"iqm": 1.0}} for one in cells],
    }
    rows = [row.split("|") for row in make_board.readme_table(board, "infinity").split("\n")][2:]
    shown = [row[2].strip() for row in rows]
    assert shown == ["**3.0**", "**3.0**", "0.5 (1)", "(50)", "(100)"]  # a tie as it is shown
    assert [int(row[3]) for row in rows] == [0, 0, 1, 50, 100]  # failed runs of all tasks


def test_no_policy_is_best_where_all_runs_fail():
    best = make_board.standing(cell("a", 100, 2000.0))
    assert make_board.shown(cell("a", 100, 2000.0), best) == "(100)"


def test_the_published_plan_can_be_run():
    from baselines.benchmark.plan import read_plan
    from baselines.cli import PLAN_OPTIONS

    plan = read_plan("board", PLAN_OPTIONS)
    assert plan["seeds"].startswith("20000:")
    assert plan["plant"] == "batch"
