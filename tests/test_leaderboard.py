"""The committed leaderboard, held against episodes run now."""

import json
from pathlib import Path

import pytest

from baselines.bench import Cell, Plan, run_cell

ROOT = Path(__file__).parent.parent / "docs" / "leaderboard"
LINES = [json.loads(line) for line in (ROOT / "slice.jsonl").read_text("utf-8").splitlines()]
BOARD = json.loads((ROOT / "leaderboard.json").read_text("utf-8"))


def plan_of_the_board() -> Plan:
    told = BOARD["plan"]["plan"]
    names = ("policies", "tasks", "disturbances", "seeds")
    return Plan(
        **{name: tuple(told[name]) for name in names},
        level=told["level"],
        overrides=tuple(tuple(pair) for pair in told["overrides"]),
    )


@pytest.mark.parametrize("line", LINES, ids=lambda line: f"{line['policy']} {line['disturbance']}")
def test_a_slice_of_the_table_comes_out_again(line):
    again = run_cell(plan_of_the_board(), Cell(*(line[name] for name in Cell._fields)))
    assert again["scenario_hash"] == line["scenario_hash"]
    for now, then in zip(again["robots"], line["robots"], strict=True):
        assert (now["lost"], now["touched"]) == (then["lost"], then["touched"])
        if not then["lost"]:  # a lost run is chaos: its numbers hold on one machine only
            for metric in ("position_rmse_mm", "settled_formation_rmse_mm", "score"):
                assert now[metric] == pytest.approx(then[metric], rel=0.01)


def test_the_slice_is_of_the_board():
    cells = {(cell["policy"], cell["task"], cell["disturbance"]) for cell in BOARD["cells"]}
    assert {(line["policy"], line["task"], line["disturbance"]) for line in LINES} <= cells


def test_the_readme_shows_the_boards_numbers():
    readme = (ROOT.parent.parent / "README.md").read_text("utf-8")
    for row in BOARD["policies"]:
        assert f"| `{row['policy']}` | {row['score']['iqm']:.1f} |" in readme
