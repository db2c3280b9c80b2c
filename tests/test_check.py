"""``tlf bench --check``: a cell of the published board, run again and compared digit for digit."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

pytest.importorskip("arch")

from baselines import cli
from baselines.benchmark import check as checking
from baselines.benchmark.aggregate import leaderboard
from baselines.benchmark.bench import run_bench
from baselines.benchmark.plan import Plan

DOCS = Path(__file__).parents[1] / "docs" / "leaderboard" / "leaderboard.json"
PLAN = Plan(
    policies=("pure_pursuit", "reference:tuned"),
    tasks=("circle",),
    disturbances=("nominal", "slip"),
    seeds=(20_000, 20_003),
    overrides=(("horizon_s", 4.0), ("plant", "batch")),
)


@pytest.fixture(scope="module")
def small(tmp_path_factory):
    """A small published board."""
    results = run_bench(PLAN, tmp_path_factory.mktemp("board"), processes=1)
    board = leaderboard(results)
    return json.loads(json.dumps({"plan": board["plan"]["plan"], "cells": board["cells"]}))


@pytest.fixture
def published(small, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    path = tmp_path / "published.json"
    path.write_text(json.dumps(small), encoding="utf-8")
    monkeypatch.setattr(checking, "PUBLISHED", path)
    return path


def tlf(monkeypatch, *words: str) -> None:
    monkeypatch.setenv("COLUMNS", "160")
    monkeypatch.setattr("sys.argv", ["tlf", "bench", "--check", *words, "--processes", "1"])
    cli.main()


def test_a_cell_that_comes_out_again_agrees(published, monkeypatch, capsys):
    tlf(monkeypatch, "circle:slip")
    answer = capsys.readouterr()
    assert answer.out.count(" agrees") == 2
    assert "All values agree with the published board, in every digit." in answer.out
    assert "seeds 20000 to 20002" in answer.out


@pytest.mark.parametrize("part", ["median", "interval", "count"])
def test_the_last_digit_counts(part, small, published, monkeypatch, capsys):
    """Each kind of value; the other entry still agrees."""
    changed = json.loads(json.dumps(small))
    (cell,) = (
        one
        for one in changed["cells"]
        if (one["policy"], one["disturbance"]) == ("pure_pursuit", "slip")
    )
    if part == "count":
        cell["success"]["count"] += 1
        name = "success.count"
    else:
        value = cell["position_rmse_mm"]["median"] * (1 + 1e-15)
        if part == "median":
            assert value != cell["position_rmse_mm"]["median"]
            cell["position_rmse_mm"]["median"] = value
            name = "position_rmse_mm.median"
        else:
            cell["position_rmse_mm"]["interval"][0] *= 1 + 1e-15
            name = "position_rmse_mm.interval.0"
    published.write_text(json.dumps(changed), encoding="utf-8")
    with pytest.raises(SystemExit) as stopped:
        tlf(monkeypatch, "circle:slip")
    assert stopped.value.code == cli.FAILED
    answer = capsys.readouterr()
    assert f"tlf: pure_pursuit: {name} is " in answer.err
    assert "1 differ" in answer.out
    assert answer.out.count(" agrees") == 1


def test_one_entry_may_be_checked_alone(published, monkeypatch, capsys):
    tlf(monkeypatch, "circle:nominal", "--policies", "pure_pursuit")
    out = capsys.readouterr().out
    assert "pure_pursuit" in out
    assert "reference:tuned" not in out
    found = json.loads(Path("results/check/circle-nominal/plan.json").read_text(encoding="utf-8"))
    assert found["plan"]["seeds"] == [20_000, 20_003]


@pytest.mark.parametrize(
    ("words", "named"),
    [
        (["circle:slipp"], "did you mean 'circle:slip'?"),
        (["circle"], "must be TASK:DISTURBANCE of the published board"),
        (["circle:slip", "--policies", "pure_pursit"], "did you mean 'pure_pursuit'?"),
        (["circle:slip", "--level", "2"], "--level cannot be used with --check"),
    ],
)
def test_what_the_board_does_not_have_is_refused(words, named, published, monkeypatch, capsys):
    with pytest.raises(SystemExit) as stopped:
        tlf(monkeypatch, *words)
    assert stopped.value.code == cli.BAD_INPUT
    assert named in capsys.readouterr().err


def test_the_package_has_the_cells_of_the_page():
    """`make_board.py` writes both."""
    board = json.loads(DOCS.read_text(encoding="utf-8"))
    published = checking.published_board()
    assert published["cells"] == board["cells"]
    assert published["plan"] == board["plan"]["plan"]
