"""How wide the velocity observer of the wheel loop has to be, for encoders of 4096 and 1024 counts.

Writes the table of ``docs/controller/wheel-speeds.md``. ``python docs/figures/make_bandwidths.py`` drives 16
seeds of each cell for 60 s on the batch plant; it takes a minute or two and needs no extra.
"""

from __future__ import annotations

import numpy as np
from make_board import DOCS
from make_limits import HORIZON_S, counts
from make_parts import put

from baselines.policies.registry import fit_policy
from baselines.runs.outcome import failed
from baselines.runs.run import run_seeds
from baselines.runs.seed_ranges import FIRST_TABLE_SEED
from tlf_env.task.scenario import load_scenario

SEEDS = range(FIRST_TABLE_SEED, FIRST_TABLE_SEED + 16)
NUMBERS = (4096, 1024)
BANDWIDTHS = (None, 20.0, 30.0, 50.0, 80.0, 120.0, 200.0)


def cell(number: int, bandwidth_rad_s: float | None) -> str:
    """The worst robot's position RMS (mm), median and worst over seeds, and how many runs failed."""
    fields = counts(number) | {"wheel_loop": {"speed_observer_rad_s": bandwidth_rad_s}}
    scenario = load_scenario("infinity", horizon_s=HORIZON_S, plant="batch", **fields)
    fitted = fit_policy("reference:tuned", scenario)
    runs = [one.metrics() for one in run_seeds(fitted.scenario, fitted.policy, SEEDS)]
    rms_mm = [max(robot.position_rmse_mm or 0.0 for robot in run) for run in runs]
    lost = sum(map(failed, runs))
    return f"{np.median(rms_mm):.3g}, {np.max(rms_mm):.3g}" + (f" ({lost} failed)" if lost else "")


def main() -> None:
    """Drive and write the table."""
    lines = ["| rad/s | " + " | ".join(f"{n} counts" for n in NUMBERS) + " |", "|---|---:|---:|"]
    for bandwidth in BANDWIDTHS:
        name = "no observer" if bandwidth is None else f"{bandwidth:g}"
        lines.append(f"| {name} | " + " | ".join(cell(n, bandwidth) for n in NUMBERS) + " |")
        print(lines[-1], flush=True)
    put(DOCS / "controller" / "wheel-speeds.md", "\n".join(lines), "bandwidths")


if __name__ == "__main__":
    main()
