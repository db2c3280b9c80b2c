"""What each part of the filter with gyro and torques is worth, under slip of many shapes.

Writes the table of ``docs/controller/gyro-estimator.md``. ``python docs/figures/make_gyro.py`` drives 16
seeds of each cell for 60 s on the batch plant, on all cores; it needs no extra. ``--seeds N`` drives others.
"""

from __future__ import annotations

import argparse
from concurrent.futures import ProcessPoolExecutor
from typing import Any

from make_board import DOCS
from make_limits import cell
from make_parts import put

from baselines.runs.seed_ranges import FIRST_TABLE_SEED
from tlf_env.common.presets import read_preset_or_file

LAW = "feedback_linearisation:bounded"
# A gyro as sold, in every column: noise, walking bias and a scale within 3 %.
GYRO = read_preset_or_file("disturbance", "gyro")["gyro"]
BY_ENCODERS = {"ekf_gyro": {"torque_time_s": None}}
ROWS: dict[str, tuple[str, dict[str, Any]]] = {
    "`ekf-slip`": ("ekf-slip", {}),
    "`ekf-slip-smoothed`": ("ekf-slip-smoothed", {}),
    "`ekf-gyro`, `torque_time_s: null`": ("ekf-gyro", BY_ENCODERS),
    "`ekf-gyro`": ("ekf-gyro", {}),
    "`ekf-gyro-smoothed`": ("ekf-gyro-smoothed", {}),
    "`truth`": ("truth", {}),
}


def sines(frequency_hz: float) -> dict[str, Any]:
    """Slip of one frequency forward, and of another in yaw, with drawn phases."""
    return {
        "delta_1_mm_s": wave(40.0, frequency_hz),
        "delta_2_rad_s": wave(0.25, 1.37 * frequency_hz),
    }


def wave(amplitude: float, frequency_hz: float) -> dict[str, Any]:
    """A sine with a drawn phase."""
    return {
        "type": "sine",
        "amplitude": amplitude,
        "frequency_hz": frequency_hz,
        "random_phase": True,
    }


def walks(time_s: float) -> dict[str, Any]:
    """Slip as an Ornstein–Uhlenbeck process."""
    process = {"type": "ornstein_uhlenbeck", "time_constant_s": time_s}
    return {"delta_1_mm_s": process | {"std": 30.0}, "delta_2_rad_s": process | {"std": 0.2}}


def ramps(time_s: float) -> dict[str, Any]:
    """The draws of the preset ``slip``, each reached within a time."""
    drawn: dict[str, Any] = {"type": "uniform", "every_s": 3.0}
    if time_s:
        drawn["ramp_s"] = time_s
    return {
        "delta_1_mm_s": drawn | {"low": -60.0, "high": 60.0},
        "delta_2_rad_s": drawn | {"low": -0.4, "high": 0.4},
    }


COLUMNS: dict[str, dict[str, Any]] = {
    "no slip": {},
    **{f"sine {f:g} Hz": sines(f) for f in (0.05, 0.15, 0.3, 0.6, 1.0)},
    **{f"OU {t:g} s": walks(t) for t in (5.0, 1.5, 0.5, 0.1)},
    **{f"ramp {t:g} s": ramps(t) for t in (0.0, 0.1, 0.5, 3.0)},
}


def one(row: str, column: str, seeds: range) -> str:
    """A cell of the table."""
    estimator, fields = ROWS[row]
    disturbance = {"slip": COLUMNS[column], "gyro": GYRO}
    return cell((f"{LAW}+{estimator}+body", {}), {"disturbance": disturbance, **fields}, seeds)


def main() -> None:
    """Drive and write the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=16)
    seeds = range(FIRST_TABLE_SEED, FIRST_TABLE_SEED + parser.parse_args().seeds)
    lines = ["| slip | " + " | ".join(ROWS) + " |", "|---" + "|---:" * len(ROWS) + "|"]
    with ProcessPoolExecutor() as pool:
        found = {
            column: [pool.submit(one, row, column, seeds) for row in ROWS] for column in COLUMNS
        }
        for column, cells in found.items():
            lines.append(f"| {column} | " + " | ".join(each.result() for each in cells) + " |")
            print(lines[-1], flush=True)
    put(DOCS / "controller" / "gyro-estimator.md", "\n".join(lines), "shapes")


if __name__ == "__main__":
    main()
