"""Pages that replay runs: the formation to scale, and plots whose cursor follows the time.

A page holds the recorded columns of its runs, thinned out if they are too many, and draws them in the browser.
"""

from __future__ import annotations

import base64
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from baselines.pages.differences import differences
from baselines.pages.page import page, text
from baselines.runs.bodies import body_parts
from baselines.runs.borders import fixed_borders, patches, shape_border
from baselines.runs.run import Record
from tlf_env.common.files import atomic
from tlf_env.rendering import looks
from tlf_env.rendering.scene import named_patches

SCRIPTS = ("replay_data.js", "replay_plane.js", "replay_plots.js", "replay.js")
STYLES = ("replay.css",)
EXACT = ("x_mm", "y_mm", "theta_rad", "reference_x_mm", "reference_y_mm", "reference_theta_rad")
ROUNDED = (
    "castor_rad",
    "position_error_mm",
    "formation_error_mm",
    "time_gap_error_s",
    "torque_l_Nmm",
    "torque_r_Nmm",
    "saturation_fraction",
    "slip_1_mm_s",
    "slip_2_rad_s",
    "estimated_slip_1_mm_s",
    "estimated_slip_2_rad_s",
    "estimated_x_mm",
    "estimated_y_mm",
    "tyre_slip_left_mm_s",
    "tyre_slip_right_mm_s",
    "tyre_slip_castor_mm_s",
)
MOST_BYTES = 1_900_000  # of all columns of a page, before they are text
CODES = 65_534  # steps from the least to the largest value of a rounded column
MISSING = 65_535
MOST_RUNS = 8
DIGITS = 3  # after the point, of the lengths of things that stand, mm


def write_replay(record: Record, path: Path) -> Path:
    """Write the page of one run; what it holds is drawn from the record alone."""
    return write_comparison([record], path)


def write_comparison(
    records: Sequence[Record], path: Path, names: Sequence[str] | None = None
) -> Path:
    """Write a page with some runs side by side, on one time line.

    Parameters
    ----------
    names
        Name of each run on the page; by default, its policy.

    Raises
    ------
    ValueError
        for no run, or for more than 8.
    """
    content = replay_page(records, names)
    with atomic(path, encoding="utf-8") as file:
        file.write(content)
    return path


def replay_page(records: Sequence[Record], names: Sequence[str] | None = None) -> str:
    """The page of :func:`write_comparison`."""
    if not 1 <= len(records) <= MOST_RUNS:
        raise ValueError(f"a page replays 1 to {MOST_RUNS} runs, not {len(records)}")
    names = list(names) if names is not None else [record.policy for record in records]
    stride = thinning(records)
    data = {"runs": [run_data(one, name, stride) for one, name in zip(records, names, strict=True)]}
    title = records[0].title if len(records) == 1 else common_title(records)
    notes = [
        note for record, name in zip(records, names, strict=True) for note in _notes(record, name)
    ]
    if stride > 1:
        notes.append(f"Of the recorded rows, this page has one in {stride}.")
    body = [f"<header><h1>{text(title)}</h1>"]
    body += [f'<p class="soft">{text(note)}</p>' for note in notes]
    body += ['</header><main id="replay"></main>']
    if len(records) > 1:
        body.append(_table_of_differences(records, names))
    body.append(FOOT)
    return page(title, "\n".join(body), scripts=SCRIPTS, styles=STYLES, data=data)


FOOT = """<noscript><p>This page draws with JavaScript, which is switched off.</p></noscript>"""


def common_title(records: Sequence[Record]) -> str:
    """What several runs have in common."""
    parts = []
    for what, values in {
        "": {record.scenario.name for record in records},
        "disturbance ": {record.scenario.disturbance.name for record in records},
        "seed ": {str(record.seed) for record in records},
    }.items():
        if len(values) == 1:
            parts.append(what + values.pop())
    return f"{len(records)} runs: {', '.join(parts)}" if parts else f"{len(records)} runs"


def _notes(record: Record, name: str) -> list[str]:
    if not record.interrupted:
        return []
    return [
        f"{name}: interrupted after {record.t_s[-1]:.6g} s of {record.scenario.horizon_s:g} s; the page has "
        "what was simulated."
    ]


def _table_of_differences(records: Sequence[Record], names: Sequence[str]) -> str:
    """What differs between the runs: settings, then results."""
    rows = "".join(
        f"<tr><td>{text(name)}</td>" + "".join(f"<td>{text(cell)}</td>" for cell in cells) + "</tr>"
        for name, cells in differences(records)
    )
    heads = "".join(f"<th>{text(name)}</th>" for name in names)
    return (
        '<h2>What differs</h2><div class="wide"><table id="differences"><thead><tr><th>field</th>'
        f"{heads}</tr></thead><tbody>{rows}</tbody></table></div>"
    )


# --- data


def thinning(records: Sequence[Record]) -> int:
    """Of how many rows a page keeps one, so that it stays small."""
    total = sum(
        len(record.t_s)
        * (
            record.robots * (4 * len(EXACT) + 2 * len(ROUNDED))
            + (0 if record.objects is None else 4 * record.objects[0].size)
        )
        for record in records
    )
    return max(1, -(-total // MOST_BYTES))


def run_data(record: Record, name: str, stride: int = 1) -> dict[str, Any]:
    """What a page holds of a run; lengths in mm, times in s.

    A column is an object with ``bytes`` in base64, little-endian, row by row: 4-byte floats, or 2-byte codes
    with the value ``low + step · code`` of each robot and 65535 for no value.
    """
    rows = np.unique(np.r_[0 : len(record.t_s) : stride, len(record.t_s) - 1])
    scenario = record.scenario
    columns = {column: exact(record[column][rows]) for column in EXACT}
    columns |= {column: rounded(record[column][rows]) for column in ROUNDED if has(record, column)}
    return {
        "name": name,
        "policy": record.policy,
        "rows": len(rows),
        "t_s": exact(record.t_s[rows]),
        "columns": columns,
        "leader_mm": exact(record.leader[rows]),
        "robots": [
            {
                "colour": _css(colour),
                "lost_at_s": _finite(record.lost_at_s[i]),
                "touched_at_s": _finite(record.touched_at_s[i]),
                "limit_Nmm": robot.torque_limit_Nmm,
                "half_axle_mm": robot.axle_width_mm / 2,
                "radius_mm": robot.outline_radius_mm,
                **{key: points(part) for key, part in body_parts(robot)._asdict().items()},
            }
            for i, (robot, colour) in enumerate(
                zip(scenario.robot_models, looks.robot_colours(record.robots), strict=True)
            )
        ],
        "gap_s": scenario.time_gap_s,
        "settle_s": scenario.settle_s,
        "horizon_s": scenario.horizon_s,
        "lost_beyond_mm": scenario.lost_beyond_mm,
        "walls": [points(one) for one in fixed_borders(record)],
        "patches": named_patches(patches(record)),
        "things": _things(record),
        "objects": None if record.objects is None else exact(record.objects[rows]),
        "palette": {
            "crate": _css(looks.CRATE),
            "crate_edge": _css(looks.CRATE_EDGE),
            "mover": _css(looks.MOVER),
            "mover_edge": _css(looks.MOVER_EDGE),
        },
    }


def has(record: Record, column: str) -> bool:
    """Whether a record has a column."""
    return column in record.columns or column in record.signals


def exact(values: np.ndarray) -> dict[str, Any]:
    """A column in 4-byte floats."""
    return {"bytes": base64.b64encode(values.astype("<f4").tobytes()).decode("ascii")}


def rounded(values: np.ndarray) -> dict[str, Any]:
    """A column ``(time, robot)`` in 2-byte codes: off by at most 1/131 068 of its robot's range."""
    finite = np.isfinite(values)
    known = np.where(finite, values, np.nan)
    low = np.where(finite.any(axis=0), _reduced(np.fmin, known), 0.0)
    high = np.where(finite.any(axis=0), _reduced(np.fmax, known), 0.0)
    step = np.where(high > low, (high - low) / CODES, 1.0)
    codes = np.where(finite, np.round((np.where(finite, values, low) - low) / step), MISSING)
    return {
        "bytes": base64.b64encode(codes.astype("<u2").tobytes()).decode("ascii"),
        "low": low.tolist(),
        "step": step.tolist(),
    }


def _reduced(smaller: np.ufunc, values: np.ndarray) -> np.ndarray:
    return np.asarray(np.nan_to_num(smaller.reduce(values, axis=0)))


def points(polygon: np.ndarray) -> list[Any]:
    """Points as lists, rounded."""
    return np.asarray(np.round(polygon, DIGITS)).tolist()


def _finite(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None


def _things(record: Record) -> list[Mapping[str, Any]]:
    """What has a pose in ``objects``: its border around its own origin, the pushables first."""
    world = record.scenario.world
    return [
        {"kind": kind, "points": points(shape_border(thing.shape, 0.0, 0.0, 0.0))}
        for kind, things in (("crate", world.pushables), ("mover", world.moving))
        for thing in things
    ]


def _css(colour: looks.Colour) -> str:
    return "#{:02x}{:02x}{:02x}".format(*colour)
