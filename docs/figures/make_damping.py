"""Count lost runs for two ratios k₂/k₃, with the EKF and the true pose, for ``docs/controller/paper.md``.

``python docs/figures/make_damping.py`` drives the reference on ∞ for 60 s, 50 seeds a row; it takes some
minutes and needs no extra.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from make_board import DOCS, with_part, write_text

from baselines import ReferencePolicy
from baselines.runs.run import run_seeds, seed_blocks
from tlf_env.onboard.tracking import TrackingGains
from tlf_env.task.scenario import load_scenario

HORIZON_S = 60.0
SEEDS = range(20_000, 20_050)
RATIOS = (2.0, 0.83)  # k₂/k₃, 1/s
END, LOST_RMS_MM, FAR_MM = 0.7, 100.0, 1200.0
BEGIN_PART, END_PART = "<!-- damping -->", "<!-- end of damping -->"


class Case(NamedTuple):
    """A disturbance, and whether it is also run with the true pose."""

    name: str
    disturbance: dict[str, Any]
    true_pose: bool = False


class Counts(NamedTuple):
    """Runs lost of ``SEEDS``."""

    at_the_end: int  # RMS error of a robot above 100 mm over the last 30 %
    ever: int  # that, or an error beyond 1200 mm at any time
    rms_mm: float  # over the last 30 %: the worst robot's, median over seeds


def slip(delta_1_mm_s: float = 0.0, delta_2_rad_s: float = 0.0) -> dict[str, Any]:
    """Constant slip of all robots."""
    return {"slip": {"delta_1_mm_s": delta_1_mm_s, "delta_2_rad_s": delta_2_rad_s}}


def scatter(part: float) -> dict[str, Any]:
    """A part of the preset `start`."""
    return {"start": {"position_std_mm": 80 * part, "heading_std_rad": 0.3 * part}}


CASES = (
    Case("nominal", {}),
    Case("$\\delta_1$ = 5 mm/s", slip(5), true_pose=True),
    Case("$\\delta_1$ = 20 mm/s", slip(20), true_pose=True),
    Case("$\\delta_2$ = 0.05 rad/s", slip(0, 0.05), true_pose=True),
    Case("$\\delta_2$ = 0.2 rad/s", slip(0, 0.2), true_pose=True),
    Case("fixes to 1 mm", {"position": {"noise_std_mm": 1}}),
    Case("fixes to 2 mm", {"position": {"noise_std_mm": 2}}),
    Case("tyre friction × 0.85", {"tyre": {"friction_scale": 0.85}}),
    Case("tyre friction × 0.7", {"tyre": {"friction_scale": 0.7}}),
    Case("tyre friction × 0.5", {"tyre": {"friction_scale": 0.5}}),
    Case("starts off by 80 mm, 0.3 rad", scatter(1), true_pose=True),
    Case("starts off by 10 mm, 0.04 rad", scatter(1 / 8)),
    Case("starts off by 1 mm, 0.004 rad", scatter(1 / 80)),
)


def measure(case: Case, ratio: float, estimator: str) -> Counts:
    """Drive all seeds of a case."""
    scenario = load_scenario(
        "infinity",
        disturbance=case.disturbance,
        estimator=estimator,
        broadcast_smoothing_s=0.0,
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


def row(case: Case) -> str:
    """A row of the table."""
    cells = [case.name]
    for ratio in RATIOS:
        found = measure(case, ratio, "ekf")
        cells.append(f"{found.at_the_end}, {found.ever}")
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
    head = ["disturbance"]
    head += [f"{pose}, $k_2/k_3$ = {ratio:g}" for pose in ("EKF", "true pose") for ratio in RATIOS]
    lines = [f"| {' | '.join(head)} |", "|---|" + "---:|" * (len(head) - 1)]
    for case in CASES:
        lines.append(row(case))
        print(lines[-1], flush=True)
    page = DOCS / "controller" / "paper.md"
    text = with_part(page.read_text("utf-8"), "\n".join(lines), BEGIN_PART, END_PART, page.name)
    write_text(page, text)


if __name__ == "__main__":
    main()
