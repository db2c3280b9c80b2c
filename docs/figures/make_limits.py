"""Where the entries of the board stop: slip of other shapes, little friction, real sensors, more robots.

Writes the tables of ``docs/limits.md``. ``python docs/figures/make_limits.py`` drives 16 seeds of each cell
for 60 s on the batch plant; it takes about a quarter of an hour and needs no extra. ``--seeds N`` drives
fewer, ``--entry NAME`` only some columns.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
from make_board import DOCS
from make_parts import put

from baselines.policies.registry import fit_policy
from baselines.runs.outcome import failed
from baselines.runs.run import run_seeds
from baselines.runs.seed_ranges import FIRST_TABLE_SEED
from tlf_env.task.scenario import load_scenario

HORIZON_S = 60.0
ENTRIES = {
    "`consistent`": ("reference:consistent", {}),
    "`tuned`": ("reference:tuned", {}),
    "`linearised`": ("reference:linearised", {}),
    "`residual`": ("residual", {}),
    "`from-nothing`": ("from-nothing", {}),
    "`tuned`, true state": ("reference:tuned", {"estimator": "truth"}),
}
SMOOTH = {"start_ramp_s": 6.0}


def slip(delta_1: dict[str, Any], delta_2: dict[str, Any]) -> dict[str, Any]:
    """A scenario's fields with two signals of slip."""
    return {"disturbance": {"slip": {"delta_1_mm_s": delta_1, "delta_2_rad_s": delta_2}}}


def ramped(ramp_s: float) -> dict[str, Any]:
    """The draws of ``slip``, reached within a time."""
    draws = {"type": "uniform", "every_s": 3.0, "ramp_s": ramp_s}
    return slip(draws | {"low": -60.0, "high": 60.0}, draws | {"low": -0.4, "high": 0.4})


def sines(frequency_hz: float) -> dict[str, Any]:
    """Slip of 40 mm/s and 0.25 rad/s, the yaw at 1.37 times the frequency."""
    return slip(
        {"type": "sine", "amplitude": 40.0, "frequency_hz": frequency_hz},
        {"type": "sine", "amplitude": 0.25, "frequency_hz": 1.37 * frequency_hz},
    )


def noise(kind: str, time: str, time_s: float) -> dict[str, Any]:
    """Random slip with a correlation time."""
    return slip({"type": kind, "std": 30.0, time: time_s}, {"type": kind, "std": 0.2, time: time_s})


def friction(scale: float, **fields: Any) -> dict[str, Any]:
    """Less friction everywhere."""
    return {"disturbance": {"tyre": {"friction_scale": scale}}, **fields}


def wet(scale: float) -> dict[str, Any]:
    """Four patches of radius 250 mm on the path."""
    places = ((4495.0, 2782.0), (4056.0, 545.0), (986.0, 4479.0), (582.0, 1412.0))
    patches = [
        {"x_mm": x, "y_mm": y, "radius_mm": 250.0, "friction_scale": scale} for x, y in places
    ]
    return {"disturbance": {"tyre": {"patches": patches}}}


def counts(number: int) -> dict[str, Any]:
    """Encoders with so many counts in a turn."""
    return {"disturbance": {"encoder": {"quantum_rad": 2 * math.pi / number}}}


def fixes(period_s: float, delay_s: float) -> dict[str, Any]:
    """Position fixes that are rare and late."""
    return {"disturbance": {"position": {"period_s": period_s, "delay_s": delay_s}}}


TABLES: dict[str, dict[str, dict[str, Any]]] = {
    "ramps": {f"{1000 * s:g} ms": ramped(s) for s in (0.0, 0.02, 0.05, 0.1, 0.2, 0.5, 3.0)},
    "sines": {f"{f:g} Hz": sines(f) for f in (0.05, 0.15, 0.2, 0.3, 0.4, 0.6, 1.0)},
    "noise": {
        f"{name} {s:g} s": noise(kind, time, s)
        for name, kind, time in (
            ("Ornstein–Uhlenbeck", "ornstein_uhlenbeck", "time_constant_s"),
            ("band-limited", "band_limited", "correlation_s"),
        )
        for s in (5.0, 1.5, 0.5, 0.1)
    },
    "friction": {
        f"{scale:g}, {start}": friction(scale, **fields)
        for start, fields in (("from rest", {}), ("6 s ramp", SMOOTH))
        for scale in (1.0, 0.6, 0.5, 0.45, 0.4, 0.35, 0.3)
    }
    | {f"patches of {scale:g}": wet(scale) for scale in (0.5, 0.3)},
    "sensors": {f"{n} counts": counts(n) for n in (65536, 16384, 4096, 1024)}
    | {
        f"{n} counts, velocity observer": counts(n) | {"wheel_loop": {"speed_observer_rad_s": 80.0}}
        for n in (4096, 1024)
    }
    | {
        f"fixes at {1 / period_s:.0f} Hz, {1000 * delay_s:g} ms old": fixes(period_s, delay_s)
        for period_s, delay_s in ((0.01, 0.0), (0.01, 0.01), (0.033, 0.05), (0.1, 0.0))
    },
    "robots": {f"{n} robots": {"robots": n} for n in (3, 4, 5, 8)},
}


def cell(entry: tuple[str, dict[str, Any]], fields: dict[str, Any], seeds: range) -> str:
    """The worst robot's position RMS (mm), median over seeds, and how many runs failed."""
    name, own = entry
    fields = {"source": "infinity", "horizon_s": HORIZON_S, "plant": "batch"} | fields
    scenario = load_scenario(**fields)
    fitted = fit_policy(name, scenario)
    driven = load_scenario(fitted.scenario, **own)
    runs = [record.metrics() for record in run_seeds(driven, fitted.policy, seeds, name=name)]
    rms_mm = np.median([max(robot.position_rmse_mm or 0.0 for robot in run) for run in runs])
    lost = sum(map(failed, runs))
    return f"{float(f'{rms_mm:.3g}'):g}" + (f" ({lost})" if lost else "")


def cells_of(table: str) -> dict[tuple[str, str], str]:
    """The cells of a table by row and column."""
    rows = [
        [text.strip() for text in line.strip("| ").split(" | ")]
        for line in table.splitlines()
        if line.startswith("| ")
    ]
    if not rows:
        return {}
    names = rows[0]  # of the columns; the first has no name
    return {
        (row[0], name): text for row in rows[1:] for name, text in zip(names, row[1:], strict=True)
    }


def renew(
    page: Path, name: str, rows: dict[str, dict[str, Any]], seeds: range, entries: Iterable[str]
) -> None:
    """Write a page's table: a row for each condition, a column for each entry.

    Only the columns of ``entries`` are driven. The others are kept; they must be in the page.
    """
    text = page.read_text("utf-8")
    old = cells_of(text.partition(f"<!-- {name} -->")[2].partition(f"<!-- end of {name} -->")[0])
    lines = ["| | " + " | ".join(ENTRIES) + " |", "|---" + "|---:" * len(ENTRIES) + "|"]
    for row, fields in rows.items():
        cells = [
            cell(entry, fields, seeds) if column in entries else old[row, column]
            for column, entry in ENTRIES.items()
        ]
        lines.append(f"| {row} | " + " | ".join(cells) + " |")
        print(lines[-1], flush=True)
    put(page, "\n".join(lines), name)


def arguments(description: str | None) -> argparse.ArgumentParser:
    """What the scripts that write such tables are given."""
    parser = argparse.ArgumentParser(description=description)
    parser.add_argument("--seeds", type=int, default=16)
    parser.add_argument(
        "--entry",
        action="append",
        choices=ENTRIES,
        help="drive only these; others keep their cells",
    )
    return parser


def main() -> None:
    """Drive and write the tables."""
    parser = arguments(__doc__)
    parser.add_argument("--tables", default=",".join(TABLES), help="comma-separated")
    options = parser.parse_args()
    seeds = range(FIRST_TABLE_SEED, FIRST_TABLE_SEED + options.seeds)
    for name in options.tables.split(","):
        print(name, flush=True)
        renew(DOCS / "limits.md", name, TABLES[name], seeds, options.entry or ENTRIES)


if __name__ == "__main__":
    main()
