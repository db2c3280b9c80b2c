"""The committed leaderboards, held against episodes run now."""

import importlib
import json
import sys
from pathlib import Path

import pytest

pytest.importorskip("arch")
pytest.importorskip("matplotlib")

from baselines.benchmark.bench import run_episode
from baselines.benchmark.page import markdown
from baselines.benchmark.plan import Episode

ROOT = Path(__file__).parent.parent / "docs" / "leaderboard"
sys.path.insert(0, str(ROOT.parent / "figures"))
make_board = importlib.import_module("make_board")

PAGES = list(make_board.BOARDS.values())
LINES, BOARDS = {}, {}
for name in PAGES:
    texts = (ROOT.parent / name / "slice.jsonl").read_text("utf-8").splitlines()
    LINES[name] = [json.loads(line) for line in texts]
    BOARDS[name] = json.loads((ROOT.parent / name / "leaderboard.json").read_text("utf-8"))
BOARD = BOARDS["leaderboard"]


@pytest.mark.parametrize(
    ("name", "line"),
    [(name, line) for name in PAGES for line in LINES[name]],
    ids=lambda one: f"{one['policy']} {one['disturbance']}" if isinstance(one, dict) else one,
)
def test_a_slice_of_the_table_comes_out_again(name, line):
    again = run_episode(make_board.plan_of(BOARDS[name]), Episode.of_line(line))
    assert again["scenario_hash"] == line["scenario_hash"]
    assert list(again) == list(line)
    fails = [any(robot["lost"] for robot in run["robots"]) for run in (again, line)]
    assert fails[0] == fails[1]
    if fails[1]:  # a lost run is chaos: its numbers hold on one machine only
        return
    for now, then in zip(again["robots"], line["robots"], strict=True):
        assert now["touched"] == then["touched"]
        for metric in ("position_rmse_mm", "settled_formation_rmse_mm", "score"):
            assert now[metric] == pytest.approx(then[metric], rel=0.01)


@pytest.mark.parametrize("name", PAGES)
def test_the_slice_is_of_the_board(name):
    cells = {(cell["policy"], cell["task"], cell["disturbance"]) for cell in BOARDS[name]["cells"]}
    assert {(line["policy"], line["task"], line["disturbance"]) for line in LINES[name]} <= cells


@pytest.mark.parametrize("name", PAGES)
def test_the_slice_has_every_policy_and_task_and_as_many_disturbances_as_fit(name):
    plan, keys = make_board.plan_of(BOARDS[name]), ("policy", "task", "disturbance")
    found = {key: {line[key] for line in LINES[name]} for key in keys}
    assert found["policy"] == set(plan.policies)
    assert found["task"] == {task for task, _ in plan.places}
    wanted = {disturbance for _, disturbance in plan.places}
    rows = len(plan.policies) * len(plan.tasks)
    assert found["disturbance"] <= wanted
    assert len(found["disturbance"]) >= min(rows, len(plan.disturbances))


def test_the_pages_are_those_of_the_board():
    root = ROOT.parent.parent
    readme = (root / "README.md").read_text("utf-8")
    assert make_board.with_part(readme, make_board.readme_part(BOARD)) == readme
    for page, board in BOARDS.items():
        figures = [f"{page}/{name}.png" for name in ("scores", "failures", "profiles")]
        assert markdown(board, figures) == (ROOT.parent / f"{page}.md").read_text("utf-8")
        assert all((ROOT.parent / name).is_file() for name in figures)


def test_the_verdicts_of_the_readme_are_those_of_the_board():
    text = " ".join((ROOT.parent.parent / "README.md").read_text("utf-8").split())
    verdicts = text.partition("<!-- end of board -->")[2].partition("## Verification")[0]
    failed = {row["policy"]: 0 for row in BOARD["policies"]}
    for cell in BOARD["cells"]:
        failed[cell["policy"]] += make_board.failures(cell)
    runs = len(make_board.plan_of(BOARD).episodes()) // len(failed)
    searched = "adrc:searched+ekf-gyro-smoothed+grip"
    learned = ("residual", "from-nothing")
    assert failed["residual"] == min(failed.values())
    assert failed[searched] == min(failed[one] for one in failed if one not in learned)
    for policy, lead in (
        (searched, "fails least without learning**, in"),
        ("reference:linearised", "The default fails in"),
        ("reference:consistent", "controllers fail in"),
        ("reference:tuned", "gains and limits, fails in"),
        ("residual", "default beneath it and fails in"),
        ("from-nothing", "without a controller beneath it, fails in"),
    ):
        assert f"{lead} {failed[policy]} of {runs}" in verdicts, policy
    cells = {(cell["policy"], cell["task"], cell["disturbance"]): cell for cell in BOARD["cells"]}
    medians = {place: cell["position_rmse_mm"]["median"] for place, cell in cells.items()}

    def smaller(one, other):
        places = make_board.plan_of(BOARD).places
        return sum(medians[one, *place] < medians[other, *place] for place in places)

    default = "reference:linearised"
    for place in make_board.plan_of(BOARD).places:
        assert make_board.failures(cells["residual", *place]) <= make_board.failures(
            cells[default, *place]
        )
    assert f"than the default's in {smaller(searched, default)} of the 49 pairs" in verdicts
    over_base, over_searched = smaller("residual", default), smaller("from-nothing", searched)
    assert f"default, and has in {over_base} of the 49 pairs a smaller median error." in verdicts
    found = f"in {over_searched} of the 49 pairs a smaller median error than `adrc:searched`"
    assert found in verdicts
    for policy in (default, "from-nothing"):
        lost = make_board.failures(cells[policy, "infinity", "split-ice"])
        assert f"{lost} of them on the ∞ with ice under one side" in verdicts


def test_the_page_on_learning_has_the_boards_verdicts():
    make_learning = importlib.import_module("make_learning")
    page = (ROOT.parent / "learning.md").read_text("utf-8")
    curves = make_learning.kept_curves()
    for name, table in (
        ("verdicts", make_learning.verdicts(BOARD)),
        ("trainings", make_learning.trainings(curves, make_learning.SHIPPED)),
        ("ladder", make_learning.trainings(curves, make_learning.LADDER)),
    ):
        assert f"<!-- {name} -->\n{table}\n<!-- end of {name} -->" in page
    assert set(curves) == {*make_learning.SHIPPED, *make_learning.LADDER}
