"""The table by which the default system was chosen."""

import importlib
import sys

import pytest
from page_tables import DOCS, numbers_in, rows_of

pytest.importorskip("matplotlib")

from baselines.policies.registry import fit_policy
from baselines.tuning.config import load_tune
from tlf_env.onboard.controllers import controller
from tlf_env.onboard.kinds import DEFAULT_CONTROLLER
from tlf_env.task.scenario import load_scenario

sys.path.insert(0, str(DOCS / "figures"))
make_default = importlib.import_module("make_default")

TABLE = rows_of("systems.md", "candidates")


def failed_runs(cell):
    """The number in brackets, 0 without one."""
    return int(cell.rpartition("(")[2].rstrip(")")) if "(" in cell else 0


def test_the_first_candidate_is_the_default():
    name = make_default.CANDIDATES[0] + make_default.PARTS
    fitted = fit_policy(name, load_scenario("infinity", horizon_s=1.0))
    law, preset = fitted.policy.law, controller(DEFAULT_CONTROLLER)
    point = preset.linearisation
    assert (law.ahead_mm, law.gain_per_s) == (point.ahead_mm, point.gain_per_s)
    limits = fitted.policy.limiter.limits
    assert limits.lateral_acceleration_mm_s2 == preset.limits.lateral_acceleration_mm_s2
    assert fitted.scenario.estimator == "ekf-gyro"


def test_the_table_has_every_condition_and_no_seed_of_a_search():
    assert list(TABLE) == list(make_default.ROWS)
    assert all(len(cells) == len(make_default.CANDIDATES) for cells in TABLE.values())
    choose = load_tune("feedback_linearisation").choose
    assert choose.first + choose.count <= make_default.FIRST


def test_the_default_alone_loses_none_where_the_grip_is_least():
    rows = [TABLE["friction × 0.35"], TABLE["patches × 0.3"]]
    lost = [sum(map(failed_runs, cells)) for cells in zip(*rows, strict=True)]
    assert lost[0] == 0 < min(lost[1:])


@pytest.mark.parametrize(
    ("place", "row"),
    [(0, "friction × 0.35"), (0, "OU 1.5 s"), (2, "`calibration`"), (5, "five robots")],
)
def test_the_cells_come_out_again(place, row):
    few = range(make_default.FIRST, make_default.FIRST + 6)
    again = make_default.made(f"`{make_default.CANDIDATES[place]}`", row, few)
    assert numbers_in(again)[0] == pytest.approx(numbers_in(TABLE[row][place])[0], rel=0.4)
