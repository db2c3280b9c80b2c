"""What each part of the filter with gyro and torques is worth, under slip of many shapes.

Writes the tables of ``docs/controller/gyro-estimator.md``. ``python docs/figures/make_gyro.py`` drives 16
seeds of each cell for 60 s on the batch plant, on all cores; it needs no extra. ``--seeds N`` drives others,
``--only NAME`` makes one table.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterable
from concurrent.futures import ProcessPoolExecutor
from typing import Any

from make_board import DOCS
from make_limits import cell
from make_parts import put

from baselines.runs.seed_ranges import FIRST_TABLE_SEED
from tlf_env.common.presets import read_preset_or_file

LAW = "feedback_linearisation:bounded"
LIMITER = "grip"  # of the table of slip
ALL_SLIP = {"ekf_gyro": {"floor_slip_acceleration_mm_s2": None}}
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


def slippery(friction_scale: float) -> list[dict[str, float]]:
    """The patches of the preset, with another friction."""
    patches = read_preset_or_file("disturbance", "patches")["tyre"]["patches"]
    return [patch | {"friction_scale": friction_scale} for patch in patches]


# Sensors, motors, robots and floors, on systems of these estimators and limiters.
OTHERS = {
    "`ekf-slip`": "ekf-slip+body",
    "all slip reported": "ekf-gyro-smoothed+body",
    "`ekf-gyro-smoothed`": "ekf-gyro-smoothed+body",
    "`ekf-gyro-smoothed+grip`": "ekf-gyro-smoothed+grip",
    "`truth`": "truth+body",
}
SLOW_START = {"start_ramp_s": 6.0}
CONDITIONS: dict[str, dict[str, Any]] = {
    "encoders of 4096 counts, with velocity observer": {
        "disturbance": "encoders-4096",
        "wheel_loop": {"speed_observer_rad_s": 80.0},
    },
    "fixes at 100 Hz": {"disturbance": "fixes-100hz"},
    "sensors and motors of `infinity_hardware`": {"source": "infinity_hardware"},
    "five robots": {"robots": 5},
    "ten robots on `long_circle`": {"source": "long_circle", "robots": 10},
    "friction × 0.5, start within 6 s": {"disturbance": "ice", **SLOW_START},
    "friction × 0.45": {"disturbance": {"tyre": {"friction_scale": 0.45}}, **SLOW_START},
    "friction × 0.4": {"disturbance": {"tyre": {"friction_scale": 0.4}}, **SLOW_START},
    "friction × 0.35": {"disturbance": {"tyre": {"friction_scale": 0.35}}, **SLOW_START},
    "`patches` (× 0.4), start within 6 s": {"disturbance": "patches", **SLOW_START},
    "patches × 0.3": {"disturbance": {"tyre": {"patches": slippery(0.3)}}, **SLOW_START},
    "`split-ice`": {"disturbance": "split-ice"},
    "`payload`": {"disturbance": "payload"},
    "`calibration`": {"disturbance": "calibration"},
    "`fixes-outage`": {"disturbance": "fixes-outage"},
    "`slip`": {"disturbance": "slip"},
}


def one(row: str, column: str, seeds: range) -> str:
    """A cell of the table of slip."""
    estimator, fields = ROWS[row]
    disturbance = {"slip": COLUMNS[column], "gyro": GYRO}
    return cell((f"{LAW}+{estimator}+{LIMITER}", {}), {"disturbance": disturbance, **fields}, seeds)


def other(system: str, condition: str, seeds: range) -> str:
    """A cell of the table of other conditions."""
    fields = ALL_SLIP if system == "all slip reported" else {}
    return cell((f"{LAW}+{OTHERS[system]}", {}), {**CONDITIONS[condition], **fields}, seeds)


def table(
    head: str, rows: Iterable[str], columns: Iterable[str], made: Callable[..., str], seeds: range
) -> str:
    """A row for each condition, a column for each estimator."""
    estimators = list(columns)
    lines = [
        f"| {head} | " + " | ".join(estimators) + " |",
        "|---" + "|---:" * len(estimators) + "|",
    ]
    with ProcessPoolExecutor() as pool:
        found = {
            row: [pool.submit(made, estimator, row, seeds) for estimator in estimators]
            for row in rows
        }
        for row, cells in found.items():
            lines.append(f"| {row} | " + " | ".join(each.result() for each in cells) + " |")
            print(lines[-1], flush=True)
    return "\n".join(lines)


def main() -> None:
    """Drive and write the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=16)
    parser.add_argument("--only", choices=("shapes", "conditions"))
    options = parser.parse_args()
    seeds = range(FIRST_TABLE_SEED, FIRST_TABLE_SEED + options.seeds)
    page = DOCS / "controller" / "gyro-estimator.md"
    if options.only != "conditions":
        put(page, table("slip", COLUMNS, ROWS, one, seeds), "shapes")
    if options.only != "shapes":
        put(page, table("", CONDITIONS, OTHERS, other, seeds), "conditions")


if __name__ == "__main__":
    main()
