"""The picture of some cases of the test set, and the table of ``docs/test-set.md`` on how hard cases are.

``python docs/figures/make_test_set.py`` runs 60 cases with numbers from 10300 on, never the published ones, for
60 s each with every system of the table. It takes about ten minutes on one core, needs the extras
``bench`` and ``figures``, and can be interrupted: the runs are kept in ``results/test_set_cases``.
``--figure`` draws only the picture. ``--published FOLDER`` takes over the results of ``tlf bench --test``
instead: the table of results, and the files in ``docs/test-set``.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

import numpy as np
from make_board import DOCS, write_text
from make_parts import put
from matplotlib.figure import Figure
from matplotlib.patches import Circle

from baselines.benchmark.bench import run_bench
from baselines.benchmark.lines import Line
from baselines.benchmark.testset import NAME, case_scenario, drawn_case, severity_of
from baselines.benchmark.testset_plan import PUBLISHED, TestPlan, fingerprint
from baselines.benchmark.testset_score import SEVERITIES, case_error_mm, geometric_mean
from baselines.runs.outcome import failed
from baselines.runs.seed_ranges import FIRST_TABLE_SEED
from baselines.runs.style import GREY, METADATA, tidy
from tlf_env.common.files import atomic
from tlf_env.task.trajectories import reference_from

FIRST = 10_300
SYSTEMS = (
    "reference:consistent",
    "reference:tuned",
    "feedback_linearisation:bounded+ekf-slip+body",
    "feedback_linearisation:bounded+ekf-gyro-smoothed+grip",
    "reference:tuned+truth+body",
    "feedback_linearisation:bounded+truth+body",
)
DRAWN, ROWS = 8, 2


def run_cases(count: int, processes: int) -> list[Line]:
    """The lines of all systems on the first cases."""
    seeds = (FIRST, FIRST + count)
    if seeds[1] > FIRST_TABLE_SEED:
        raise ValueError(f"at most {FIRST_TABLE_SEED - FIRST} cases are not for tables")
    plan = TestPlan(
        policies=SYSTEMS,
        tasks=(NAME,),
        disturbances=("others",),
        seeds=seeds,
        fingerprint=fingerprint(""),
    )
    folder = Path("results/test_set_cases")
    return run_bench(plan, folder, processes=processes, progress=_report).ordered()


def _report(done: int, total: int) -> None:
    print(f"\r{done} of {total}", end="", flush=True)


def table(lines: list[Line]) -> str:
    """A row for each system, and one for the cases that some privileged system holds."""
    parts = [
        "| system | easiest third | middle third | hardest third | held | score mm |",
        "|---|---:|---:|---:|---:|---:|",
    ]
    held: dict[str, set[int]] = {}
    errors: dict[str, list[float]] = {}
    for line in lines:
        held.setdefault(line["policy"], set())
        errors.setdefault(line["policy"], []).append(case_error_mm(line))
        if not failed(line["robots"]):
            held[line["policy"]].add(line["seed"])
    seeds = sorted({line["seed"] for line in lines})
    for name in SYSTEMS:
        score = geometric_mean(np.array(errors[name]))
        parts.append(f"| `{name}` | {_shares(held[name], seeds)} | {score:.1f} |")
    privileged = set().union(*(held[name] for name in SYSTEMS if "+truth" in name))
    parts.append(f"| one of the two on the true state | {_shares(privileged, seeds)} | |")
    return "\n".join(parts)


def take_over(folder: Path) -> None:
    """Keep the leaderboard of a run of the published cases, and write the table.

    Raises
    ------
    ValueError
        for results of other cases.
    """
    board = json.loads((folder / "leaderboard.json").read_text("utf-8"))
    if not board["published"] or board["cases"] != list(PUBLISHED):
        raise ValueError(f"{folder} has other cases than the published ones")
    kept = DOCS / "test-set"
    kept.mkdir(exist_ok=True)
    for name in ("leaderboard.json", "leaderboard.md"):
        write_text(kept / name, (folder / name).read_text("utf-8"))
    put(DOCS / "test-set.md", results(board), "results")


def results(board: dict[str, Any]) -> str:
    """A row for each entry: score, cases held, and the share held in each third of the severities."""
    out = [
        "| entry | score mm | held | easiest third | middle third | hardest third |",
        "|---|---:|---:|---:|---:|---:|",
    ]
    for entry in board["entries"]:
        low, high = entry["score"]["interval"]
        name = f"`{entry['policy']}`" + (" (privileged)" if entry["privileged"] else "")
        shares = " | ".join(f"{100 * one['share']:.0f} %" for one in entry["held_by_severity"])
        score = f"{entry['score']['mm']:.1f} [{low:.1f}, {high:.1f}]"
        out.append(
            f"| {name} | {score} | {entry['held']['count']} of {entry['cases']} | {shares} |"
        )
    return "\n".join(out)


def _shares(held: set[int], seeds: list[int]) -> str:
    cells = []
    for low, high in (*SEVERITIES, (0.0, 1.0)):
        inside = [seed for seed in seeds if low <= severity_of(seed) < high]
        cells.append(f"{sum(seed in held for seed in inside)} of {len(inside)}")
    return " | ".join(cells)


def draw() -> None:
    """Write ``docs/images/test_set.png``: paths of some cases, with the row after 30 s."""
    figure = Figure(figsize=(9, 5), layout="constrained")
    for panel, seed in zip(
        figure.subplots(ROWS, DRAWN // ROWS).flat, range(FIRST, FIRST + DRAWN), strict=True
    ):
        scenario = case_scenario(seed)
        t_s = np.arange(0.0, scenario.horizon_s, 0.05)
        metres = reference_from(scenario.trajectory, t_s, scenario.start_ramp_s)[:, :2] / 1000
        panel.plot(*metres.T, color=GREY, lw=0.9)
        for patch in scenario.disturbance.tyre.patches:
            place = (patch.x_mm / 1000, patch.y_mm / 1000)
            panel.add_patch(Circle(place, patch.radius_mm / 1000, color="C0", alpha=0.3, lw=0))
        for robot in range(scenario.robot_count):
            at = np.searchsorted(t_s, 30.0 - robot * scenario.time_gap_s)
            panel.plot(*metres[at], "o", ms=4, color=f"C{robot}")
        knobs = sum(
            len(group)
            for group in drawn_case(seed)["disturbance"].values()
            if group != scenario.name
        )
        panel.set_title(f"{seed}: severity {severity_of(seed):.2f}, {knobs} channels", fontsize=7)
        panel.set_aspect("equal", adjustable="datalim")
        panel.tick_params(labelsize=6)
        tidy(panel)
    figure.supxlabel("x, m", fontsize=8)
    figure.supylabel("y, m", fontsize=8)
    with atomic(DOCS / "images" / "test_set.png", "wb") as file:
        figure.savefig(file, format="png", dpi=110, metadata=METADATA.get("png"))


def main() -> None:
    """Draw, run and write the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--cases", type=int, default=60)
    parser.add_argument("--processes", type=int, default=1)
    parser.add_argument("--figure", action="store_true")
    parser.add_argument("--published", type=Path, metavar="FOLDER")
    options = parser.parse_args()
    if options.published is not None:
        take_over(options.published)
        return
    draw()
    if not options.figure:
        put(DOCS / "test-set.md", table(run_cases(options.cases, options.processes)), "cases")


if __name__ == "__main__":
    main()
