"""The entries of the board under continuous slip, beside the steps of slip that they were tuned on.

Writes a table of the README. ``python docs/figures/make_continuous.py`` drives 50 seeds of each cell for 60 s
on the batch plant, on all cores; it takes about ten minutes and needs no extra. ``--seeds N`` drives fewer.
``--only TEXT`` drives the entries whose names contain the text, and keeps the other rows.
"""

from __future__ import annotations

import argparse
from concurrent.futures import ProcessPoolExecutor

import numpy as np
from make_board import DOCS
from make_limits import HORIZON_S
from make_parts import put

from baselines.policies.registry import fit_policy
from baselines.runs.outcome import failed
from baselines.runs.run import run_seeds
from baselines.runs.seed_ranges import FIRST_TABLE_SEED
from tlf_env.task.scenario import load_scenario

TASKS = {"infinity": "∞", "flower": "flower"}
DISTURBANCES = ("slip-ramps", "slip-noise", "slip-sines", "slip")
BEST = "reference:linearised"
ENTRIES = {
    f"`{BEST}`": BEST,
    "`residual`": "residual",
    "`reference:tuned`": "reference:tuned",
    "`feedback_linearisation:bounded+ekf-slip+body`": "feedback_linearisation:bounded+ekf-slip+body",
    "`kanayama:bounded+ekf-slip+body`": "kanayama:bounded+ekf-slip+body",
    "`direct`": "direct",
    "`reference:consistent`": "reference:consistent",
    "`reference:tuned`, true state": "reference:tuned+truth",
}


def cell(name: str, task: str, disturbance: str, seeds: range) -> str:
    """The worst robot's position RMS (mm), median over seeds, and how many runs failed."""
    scenario = load_scenario(task, disturbance=disturbance, horizon_s=HORIZON_S, plant="batch")
    fitted = fit_policy(name, scenario)
    runs = [one.metrics() for one in run_seeds(fitted.scenario, fitted.policy, seeds, name=name)]
    rms_mm = np.median([max(robot.position_rmse_mm or 0.0 for robot in run) for run in runs])
    lost = sum(map(failed, runs))
    if 2 * lost >= len(runs):
        return f"({lost})"
    return f"{rms_mm:.1f}" + (f" ({lost})" if lost else "")


def main() -> None:
    """Drive and write the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=50)
    parser.add_argument("--only", default="")
    options = parser.parse_args()
    seeds = range(FIRST_TABLE_SEED, FIRST_TABLE_SEED + options.seeds)
    page = DOCS.parent / "README.md"
    kept = {line.split(" | ")[0][2:]: line for line in page.read_text("utf-8").splitlines()}
    head = [f"{TASKS[task]} `{one}`" for task in TASKS for one in DISTURBANCES]
    lines = ["| | " + " | ".join(head) + " |", "|---" + "|---:" * len(head) + "|"]
    with ProcessPoolExecutor() as pool:
        rows = {
            entry: [
                pool.submit(cell, name, task, one, seeds) for task in TASKS for one in DISTURBANCES
            ]
            for entry, name in ENTRIES.items()
            if options.only in entry
        }
        for entry in ENTRIES:
            if entry in rows:
                found = " | ".join(one.result() for one in rows[entry])
                lines.append(f"| {entry} | {found} |")
                print(lines[-1], flush=True)
            else:
                lines.append(kept[entry])
    put(page, "\n".join(lines), "continuous")


if __name__ == "__main__":
    main()
