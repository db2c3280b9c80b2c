"""Candidates for the default system, under conditions that no search saw: a table of ``docs/systems.md``.

``python docs/figures/make_default.py`` drives 32 seeds of each cell for 60 s on the batch plant, on all
cores, in half an hour, most of it for ``nmpc``, which needs the extra ``mpc``. ``--seeds N`` drives others.
"""

from __future__ import annotations

import argparse
from typing import Any

from make_board import DOCS
from make_gyro import COLUMNS, CONDITIONS, GYRO, table
from make_limits import cell
from make_parts import put

CANDIDATES = (
    "feedback_linearisation:bounded",  # the default
    "feedback_linearisation:searched",
    "kanayama:searched",
    "lqr:searched",
    "sliding_mode:searched",
    "adrc:searched",
    "nmpc:searched",
)
PARTS = "+ekf-gyro-smoothed+grip"
FIRST = 10_400  # for choosing, and not of any search
SLIP = ("sine 0.15 Hz", "sine 1 Hz", "OU 1.5 s", "OU 0.1 s")
OTHERS = (
    "five robots",
    "ten robots on `long_circle`",
    "friction × 0.35",
    "patches × 0.3",
    "`split-ice`",
    "`payload`",
    "`calibration`",
    "`fixes-outage`",
)
ROWS: dict[str, dict[str, Any]] = {
    **{name: {"disturbance": {"slip": COLUMNS[name], "gyro": GYRO}} for name in SLIP},
    **{name: CONDITIONS[name] for name in OTHERS},
}


def made(candidate: str, row: str, seeds: range) -> str:
    """A cell of the table."""
    return cell((candidate.strip("`") + PARTS, {}), ROWS[row], seeds)


def main() -> None:
    """Drive and write the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=32)
    options = parser.parse_args()
    seeds = range(FIRST, FIRST + options.seeds)
    names = [f"`{name}`" for name in CANDIDATES]
    put(DOCS / "systems.md", table("", ROWS, names, made, seeds), "candidates")


if __name__ == "__main__":
    main()
