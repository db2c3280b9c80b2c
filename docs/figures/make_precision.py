"""What single precision changes: a table of ``docs/performance.md``.

``python docs/figures/make_precision.py`` runs the default system on both tasks of the published board under
each of its disturbances, with substeps in double and in single precision on the same seeds (the extra
``bench``; some ten minutes on one core).
"""

from __future__ import annotations

import functools
from typing import Any, NamedTuple
from unittest.mock import patch

import numpy as np
import yaml
from make_parts import DOCS, put
from make_speed import table
from tqdm import tqdm

from baselines.benchmark.statistics import interval
from baselines.policies.registry import fit_policy
from baselines.runs import run
from baselines.runs.outcome import failed
from tlf_env.engine.batch import PRECISIONS, BatchPlant
from tlf_env.task.scenario import load_scenario

SYSTEM = "reference:linearised"
SEEDS = range(20_000, 20_020)


class Cell(NamedTuple):
    """Scores (mm) of the runs that both precisions hold, and how many runs failed."""

    scores: dict[str, np.ndarray]
    failed: dict[str, int]


def cell(task: str, disturbance: str, horizon_s: float) -> Cell:
    """The default system on some seeds in both precisions."""
    scenario = load_scenario(task, disturbance=disturbance, horizon_s=horizon_s)
    fitted = fit_policy(SYSTEM, scenario)
    scores, lost = {}, {}
    for precision in PRECISIONS:
        made = functools.partial(BatchPlant, precision=precision)
        with patch.object(run, "BatchPlant", made):
            records = list(run.run_seeds(fitted.scenario, fitted.policy, SEEDS))
        metrics = [record.metrics() for record in records]
        errors = [max(robot.position_rmse_mm for robot in one) for one in metrics]
        lost[precision] = np.array([failed(one) for one in metrics])
        scores[precision] = np.array(errors)
    held = ~np.any(list(lost.values()), axis=0)
    return Cell(
        {name: one[held] for name, one in scores.items()},
        {name: int(one.sum()) for name, one in lost.items()},
    )


def row(disturbance: str, task: str, found: Cell) -> list[str]:
    """A row of the table: medians, and the interval of the mean difference."""
    double, single = (found.scores[name] for name in PRECISIONS)
    lost = "/".join(str(found.failed[name]) for name in PRECISIONS)
    ends = interval(single - double, np.mean)
    if ends is None:
        return [disturbance, task, "–", "–", "–", lost]
    medians = (f"{np.median(one):.2f}" for one in (double, single))
    return [disturbance, task, *medians, f"{ends[0]:+.3f} … {ends[1]:+.3f}", lost]


def main() -> None:
    """Run all cells, and write the table."""
    plan: dict[str, Any] = yaml.safe_load((DOCS.parent / "configs/plans/board.yaml").read_text())
    cells = [(task, one) for one in plan["disturbances"] for task in plan["tasks"]]
    cells += [tuple(one.split(":")) for one in plan["also"]]
    horizon_s = plan["horizon_s"]
    rows = [row(one, task, cell(task, one, horizon_s)) for task, one in tqdm(cells)]
    head = [
        "disturbance",
        "task",
        "double, mm",
        "single, mm",
        "single − double, mm",
        "failed, of 20 each",
    ]
    put(DOCS / "performance.md", table(head, rows, names=2), "precision")


if __name__ == "__main__":
    main()
