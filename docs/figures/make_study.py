"""Run the study's disturbances anew and put the counts into ``docs/controller.md``.

``python docs/figures/make_study.py`` drives the reference on ∞ for 60 s, 50 seeds a row, with two
ratios k₂/k₃ and two rules of who is lost; it takes some minutes. It needs no extra.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from make_board import DOCS, with_part, write_text
from scipy.stats import fisher_exact

from baselines import ReferencePolicy
from baselines.runs.run import run_seeds, seed_blocks
from tlf_env.onboard.tracking import TrackingGains
from tlf_env.task.scenario import load_scenario

HORIZON_S = 60.0
SEEDS = range(20_000, 20_050)
RATIOS = (2.0, 0.83)  # k₂/k₃, 1/s
END, LOST_RMS_MM, FAR_MM = 0.7, 100.0, 1200.0
BEGIN_PART, END_PART = "<!-- study -->", "<!-- end of study -->"


class Case(NamedTuple):
    """A disturbance, and how many of how many runs the study lost."""

    name: str
    disturbance: dict[str, Any]
    lost: int | None = None
    runs: int | None = None
    true_pose: str | None = None  # the study's, with the true pose fed back


class Counts(NamedTuple):
    """Runs lost of ``SEEDS``."""

    at_the_end: int  # RMS error of a robot above 100 mm over the last 30 %: the study's rule
    ever: int  # that, or an error beyond 1200 mm at any time: the rule of the tables
    rms_mm: float  # over the last 30 %: the worst robot's, median over seeds


def slip(delta_1_mm_s: float = 0.0, delta_2_rad_s: float = 0.0) -> dict[str, Any]:
    """Constant slip of all robots."""
    return {"slip": {"delta_1_mm_s": delta_1_mm_s, "delta_2_rad_s": delta_2_rad_s}}


def scatter(part: float) -> dict[str, Any]:
    """A part of the preset `start`."""
    return {"start": {"position_std_mm": 80 * part, "heading_std_rad": 0.3 * part}}


CASES = (
    Case("nominal", {}),
    Case("$\\delta_1$ = 5 mm/s", slip(5), 3, 4, "18 mm"),
    Case("$\\delta_1$ = 20 mm/s", slip(20), 20, 20, "lost"),
    Case("$\\delta_2$ = 0.05 rad/s", slip(0, 0.05), true_pose="3–10 mm"),
    Case("$\\delta_2$ = 0.2 rad/s", slip(0, 0.2), 18, 20, "3–10 mm"),
    Case("fixes to 1 mm", {"position": {"noise_std_mm": 1}}, 12, 20),
    Case("fixes to 2 mm", {"position": {"noise_std_mm": 2}}, 20, 20),
    Case("tyre friction × 0.85", {"tyre": {"friction_scale": 0.85}}, 3, 8),
    Case("tyre friction × 0.7", {"tyre": {"friction_scale": 0.7}}, 0, 8),
    Case("tyre friction × 0.5", {"tyre": {"friction_scale": 0.5}}, 8, 8),
    Case("starts off by 80 mm, 0.3 rad", scatter(1), 17, 20, "none lost"),
    Case("starts off by 10 mm, 0.04 rad", scatter(1 / 8)),
    Case("starts off by 1 mm, 0.004 rad", scatter(1 / 80)),
)


def measure(case: Case, ratio: float, estimator: str) -> Counts:
    """Drive all seeds of a case."""
    scenario = load_scenario(
        "infinity",
        disturbance=case.disturbance,
        estimator=estimator,
        horizon_s=HORIZON_S,
        plant="batch",
    )
    policy = ReferencePolicy(TrackingGains(k_2_mm2_s=ratio * TrackingGains().k_3_mm2))
    first = round(END * scenario.horizon_steps)
    rows = []
    for seeds in seed_blocks(SEEDS):
        for record in run_seeds(scenario, policy, seeds):
            error_mm = record["position_error_mm"]
            rms_mm = np.sqrt(np.mean(error_mm[first:] ** 2, axis=0))
            rows.append((rms_mm.max(), error_mm.max()))
    rms_mm, largest_mm = np.transpose(rows)
    late = rms_mm > LOST_RMS_MM
    return Counts(
        int(late.sum()), int((late | (largest_mm > FAR_MM)).sum()), float(np.median(rms_mm))
    )


def chance(case: Case, found: Counts) -> str:
    """Fisher's exact test, one-sided: how likely counts so far apart are if both have the same share."""
    if case.lost is None or case.runs is None:
        return ""
    table = [
        [case.lost, case.runs - case.lost],
        [found.at_the_end, len(SEEDS) - found.at_the_end],
    ]
    return f"{min(fisher_exact(table, way).pvalue for way in ('less', 'greater')):.2f}"


def row(case: Case) -> str:
    """A row of the table."""
    damped, printed = (measure(case, ratio, "ekf") for ratio in RATIOS)
    study = "" if case.lost is None else f"{case.lost} of {case.runs}"
    cells = [case.name, study]
    for found in (damped, printed):
        cells += [f"{found.at_the_end}, {found.ever}", chance(case, found)]
    cells.append(case.true_pose or "")
    for ratio in RATIOS:
        if case.true_pose:
            found = measure(case, ratio, "truth")
            lost = f"{found.at_the_end}, {found.ever} lost"
            cells.append(f"{found.rms_mm:.1f} mm" if not found.ever else lost)
        else:
            cells.append("")
    return f"| {' | '.join(cells)} |"


def main() -> None:
    """Write the table."""
    head = ["disturbance", "study"]
    head += [cell for ratio in RATIOS for cell in (f"$k_2/k_3$ = {ratio:g}", "p")]
    head += ["true pose: study", *(f"$k_2/k_3$ = {ratio:g}" for ratio in RATIOS)]
    lines = [f"| {' | '.join(head)} |", "|---|" + "---:|" * (len(head) - 1)]
    for case in CASES:
        lines.append(row(case))
        print(lines[-1], flush=True)
    page = DOCS / "controller.md"
    text = with_part(page.read_text("utf-8"), "\n".join(lines), BEGIN_PART, END_PART, page.name)
    write_text(page, text)


if __name__ == "__main__":
    main()
