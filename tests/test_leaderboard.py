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
    default, searched = "reference:linearised", "adrc:searched+ekf-gyro-smoothed+grip"
    assert failed[searched] == min(failed.values())
    for policy, lead in (
        (searched, "`adrc:searched` fails least**, in"),
        ("reference:consistent", "controllers fail in"),
        ("reference:tuned", "gains and limits, fails in"),
        ("residual", "default beneath it: it fails in"),
        ("from-nothing", "all 49 pairs, and it fails in"),
    ):
        assert f"{lead} {failed[policy]} of {runs}" in verdicts, policy
    assert f"runs, the default in {failed[default]}," in verdicts
    assert f"The default fails in {failed[default]}," in verdicts
    cells = {(cell["policy"], cell["task"], cell["disturbance"]): cell for cell in BOARD["cells"]}
    medians = {place: cell["position_rmse_mm"]["median"] for place, cell in cells.items()}
    places = make_board.plan_of(BOARD).places

    def smaller(one, other):
        return sum(medians[one, *place] < medians[other, *place] for place in places)

    def more(one, other):
        """Pairs in which one fails more often than the other, and by how much."""
        found = {
            place: make_board.failures(cells[one, *place])
            - make_board.failures(cells[other, *place])
            for place in places
        }
        return {place: count for place, count in found.items() if count > 0}

    assert f"than the default's in {smaller(searched, default)} of the 49 pairs" in verdicts
    assert f"median error is smaller in {smaller('residual', default)} of the 49" in verdicts
    assert more("residual", default) == {("infinity", "combined-medium"): 1}
    assert "(in one, `combined-medium`, it fails once more)" in verdicts
    assert smaller("from-nothing", default) == 49
    lost = {
        policy: make_board.failures(cells[policy, "infinity", "split-ice"])
        for policy in (default, searched, "from-nothing")
    }
    assert f"{lost['from-nothing']} of them on the ∞ with ice under the left wheels" in verdicts
    assert f"where `adrc:searched` fails in {lost[searched]}." in verdicts
    assert f"{lost[default]} of them under `split-ice` on the ∞" in verdicts


def test_the_page_on_learning_names_where_its_policies_lose():
    page = " ".join((ROOT.parent / "learning.md").read_text("utf-8").split())
    cells = {(cell["policy"], cell["task"], cell["disturbance"]): cell for cell in BOARD["cells"]}
    places = make_board.plan_of(BOARD).places
    classical = [
        policy
        for policy in make_board.plan_of(BOARD).policies
        if policy not in ("residual", "from-nothing", "feedback_linearisation:bounded+truth+grip")
    ]

    def standing(policy, place):
        cell = cells[policy, *place]
        return make_board.failures(cell), cell["position_rmse_mm"]["median"]

    best = {place: min(standing(policy, place) for policy in classical) for place in places}
    mine = {place: standing("from-nothing", place) for place in places}
    worse = [place for place in places if mine[place][0] > best[place][0] + 1]
    assert worse == [("infinity", "split-ice")]
    assert "in every other pair at most once more" in page
    as_good = sum(mine[place][1] <= best[place][1] for place in places)
    assert f"that of the best system without learning in {as_good} of the 49 pairs" in page


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
