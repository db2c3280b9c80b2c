"""What each part of `tuned` does: leave one out and drive ∞.

Writes the tables of ``docs/controller/slip-estimator.md`` and ``docs/controller/limits-and-spacing.md``.
``python docs/figures/make_parts.py`` drives 16 seeds of each disturbance for 60 s; it takes some minutes
and needs no extra.
"""

from __future__ import annotations

from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
from make_board import DOCS, with_part, write_text

from baselines import ReferencePolicy
from baselines.runs.outcome import failed
from baselines.runs.run import run_seeds
from tlf_env.onboard.controllers import controller
from tlf_env.task.scenario import load_scenario

HORIZON_S = 60.0
SEEDS = range(2_000, 2_016)
DISTURBANCES = ("noise", "slip", "start", "combined-hard", "ice")
TUNED = controller("tuned")
WITHOUT_LEARNING = {
    "fix_variance_time_s": None,
    "fix_variance_mm2": 2.1,
    "fix_variance_factor": 1.0,
}
WITHOUT_WHEELS = {"most_acceleration_mm_s2": None, "most_yaw_acceleration_rad_s2": None}
WITHOUT_SURPRISE = {"surprise_threshold": None}
FILTERS: dict[str, dict[str, Any]] = {
    "complete filter": {},
    "no jumps of the wheel speed": {"ekf_slip": WITHOUT_WHEELS},
    "no innovation test": {"ekf_slip": WITHOUT_SURPRISE},
    "fixed variance of the fixes, 2.1 mm²": {"ekf_slip": WITHOUT_LEARNING},
    "none of the three": {"ekf_slip": {**WITHOUT_LEARNING, **WITHOUT_SURPRISE, **WITHOUT_WHEELS}},
    "true pose and slip": {"estimator": "truth"},
}
PAPER = controller("consistent").gains
LAWS: dict[str, dict[str, Any]] = {
    "`tuned`": {},
    "$k_1$ = 0.23 1/s, the paper's": {"gains": {"k_1_per_s": PAPER.k_1_per_s}},
    "$k_2/k_3$ = 0.83 1/s, the paper's": {
        "gains": {"k_2_mm2_s": PAPER.k_2_mm2_s / PAPER.k_3_mm2 * TUNED.gains.k_3_mm2}
    },
    "$k_3$ = 12 000 mm², the paper's": {
        "gains": {
            "k_2_mm2_s": TUNED.gains.k_2_mm2_s / TUNED.gains.k_3_mm2 * PAPER.k_3_mm2,
            "k_3_mm2": PAPER.k_3_mm2,
        }
    },
    "no $w$": {"limits": {"braking_error_mm": None}},
    "no $E_1$": {"limits": {"forward_error_mm": None}},
    "no $E_2$": {"limits": {"lateral_error_mm": None}},
    "$F$ = 0": {"limits": {"free_speed_mm_s": 0.0}},
    "$R$ = 100 mm": {"limits": {"free_reach_mm": 100.0}},
    "no $\\Omega$": {"limits": {"yaw_rate_rad_s": None}},
    "no $A_1$, $A_3$": {"limits": {"acceleration_mm_s2": None, "turning_acceleration_mm_s2": None}},
    "no $A_2$": {"limits": {"yaw_acceleration_rad_s2": None}},
    "$A_\\perp$ = 230 mm/s²": {"limits": {"lateral_acceleration_mm_s2": 230.0}},
    "no $V$": {"limits": {"reverse_mm_s": None}},
    "slip not subtracted": {"limits": {"cancel_slip": False}},
    "no distance to the predecessor": {"spacing": None},
    "no lead": {"lead_s": 0.0},
    "$\\eta$ = 0.4, $\\epsilon$ = 1000": {"gains": {"eta": 0.4, "epsilon": 1000.0}},
}


def changed(change: dict[str, Any]) -> ReferencePolicy:
    """`tuned` with some numbers of its gains or limits, its spacing or its lead changed."""
    return ReferencePolicy(
        TUNED.model_copy(
            update={
                part: getattr(TUNED, part).model_copy(update=value)
                if isinstance(value, dict)
                else value
                for part, value in change.items()
            }
        )
    )


def cell(policy: ReferencePolicy, disturbance: str, fields: dict[str, Any]) -> str:
    """The worst robot's position RMS (mm), median over seeds, and how many runs lost a robot."""
    fields = {"estimator": "ekf-slip", "broadcast_smoothing_s": 0.0, **fields}
    scenario = load_scenario(
        "infinity", disturbance=disturbance, horizon_s=HORIZON_S, plant="batch", **fields
    )
    runs = [record.metrics() for record in run_seeds(scenario, policy, SEEDS)]
    rms_mm = np.median([max(robot.position_rmse_mm for robot in run) for run in runs])
    lost = sum(map(failed, runs))
    return f"{rms_mm:.1f} ({lost})" if lost else f"{rms_mm:.1f}"


def table(rows: dict[str, tuple[ReferencePolicy, dict[str, Any]]]) -> str:
    """A row for each variant, a column for each disturbance."""
    lines = ["| | " + " | ".join(f"`{name}`" for name in DISTURBANCES) + " |"]
    lines.append("|---" + "|---:" * len(DISTURBANCES) + "|")
    with ProcessPoolExecutor() as pool:
        found = {
            name: [pool.submit(cell, policy, disturbance, fields) for disturbance in DISTURBANCES]
            for name, (policy, fields) in rows.items()
        }
        for name, cells in found.items():
            lines.append(f"| {name} | " + " | ".join(one.result() for one in cells) + " |")
            print(lines[-1], flush=True)
    return "\n".join(lines)


def put(page: Path, lines: str, name: str) -> None:
    """Replace the part of a page between the markers of a name."""
    text = page.read_text(encoding="utf-8")
    write_text(
        page, with_part(text, lines, f"<!-- {name} -->", f"<!-- end of {name} -->", page.name)
    )


def main() -> None:
    """Write both tables."""
    pages = DOCS / "controller"
    tuned = ReferencePolicy(TUNED)
    filters = table({name: (tuned, fields) for name, fields in FILTERS.items()})
    laws = table({name: (changed(change), {}) for name, change in LAWS.items()})
    put(pages / "slip-estimator.md", filters, "filter")
    put(pages / "limits-and-spacing.md", laws, "limits")


if __name__ == "__main__":
    main()
