"""Write the tables of ``docs/crossing.md``: controllers, estimators and limiters crossed.

First run ``tlf bench --plan crossing --no-figures --out results/crossing``. Then
``python docs/figures/make_crossing.py results/crossing`` keeps the cells in ``docs/crossing/cells.json``, and
one run of each controller, which a test runs again, in ``docs/crossing/slice.jsonl``. Results of the plan
``crossing-slow`` may follow as a second folder. With ``--add`` the systems that are not in the new results
stay as they are. The same results give the same files. This needs the extra ``bench``.
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path
from typing import Any

from make_board import DOCS, ROOT, Line, failures, plan_of, read_results, with_part, write_text

from baselines.benchmark.page import number
from baselines.policies.systems import parse_system

KEPT = ("policy", "disturbance", "runs")
METRIC = "position_rmse_mm"
PAGE, CELLS, SLICE = "crossing.md", "crossing/cells.json", "crossing/slice.jsonl"

Cell = dict[str, Any]


def kept(cell: Cell) -> Cell:
    """What the page needs of a cell of a leaderboard."""
    return {
        **{name: cell[name] for name in KEPT},
        "failed": failures(cell),
        "median_mm": cell[METRIC]["median"],
        "interval_mm": cell[METRIC]["interval"],
    }


def shown(cell: Cell) -> str:
    """Text of a cell: median and interval, and the failed runs in brackets; alone, if at least half fail."""
    failed = f"({cell['failed']})"
    if 2 * cell["failed"] >= cell["runs"]:
        return failed
    digits = 1 if cell["median_mm"] >= 10 else 2
    ends = cell["interval_mm"]
    text = number(cell["median_mm"], digits)
    if ends is not None:
        text += f" [{number(ends[0], digits)}, {number(ends[1], digits)}]"
    return text if cell["failed"] == 0 else f"{text} {failed}"


def table(cells: list[Cell], estimator: str) -> str:
    """A row for each controller and limiter on one estimator, a column for each disturbance."""
    columns = list(dict.fromkeys(cell["disturbance"] for cell in cells))
    rows: dict[tuple[str, str], dict[str, Cell]] = {}
    for cell in cells:
        system = parse_system(cell["policy"])
        if system is None or system.limiter is None:
            raise ValueError(f"policy {cell['policy']!r} is not CONTROLLER+ESTIMATOR+LIMITER")
        if system.estimator == estimator:
            rows.setdefault((system.controller, system.limiter), {})[cell["disturbance"]] = cell
    out = [
        "| controller | limiter | runs | " + " | ".join(f"`{one}`" for one in columns) + " |",
        "|---|---|---:" + "|---:" * len(columns) + "|",
    ]
    for (controller, limiter), row in rows.items():
        runs = next(iter(row.values()))["runs"]
        texts = [shown(row[one]) for one in columns]
        out.append(f"| `{controller}` | `{limiter}` | {runs} | " + " | ".join(texts) + " |")
    return "\n".join(out)


def estimators(cells: list[Cell]) -> list[str]:
    """The estimators' names, in the order of the cells."""
    systems = (parse_system(cell["policy"]) for cell in cells)
    return list(dict.fromkeys(system.estimator for system in systems if system is not None))


def page_of(text: str, cells: list[Cell]) -> str:
    """The page with all its tables.

    Raises
    ------
    ValueError
        for a page without the markers of an estimator.
    """
    for one in estimators(cells):
        text = with_part(text, table(cells, one), f"<!-- {one} -->", f"<!-- end of {one} -->", PAGE)
    return text


def slice_of(lines: list[Line]) -> list[Line]:
    """One run of each controller, at the first seed, spread over estimators, limiters and disturbances."""
    first = min(line["seed"] for line in lines)
    runs: dict[str, list[Line]] = {}
    for line in lines:
        if line["seed"] == first:
            runs.setdefault(line["policy"].partition("+")[0], []).append(line)
    return [mine[7 * k % len(mine)] for k, mine in enumerate(runs.values())]


def write_crossing(folders: list[Path], root: Path = ROOT, *, add: bool = False) -> None:
    """Write page, cells and slice under ``root``, the checkout; with ``add``, beside what is there.

    Raises
    ------
    ValueError
        for results that are not complete, or are of other disturbances, before any file is written.
    """
    docs = root / DOCS.name
    cells: list[Cell] = []
    lines: list[Line] = []
    shared: tuple[str, ...] = ()
    if add:
        cells = json.loads((docs / CELLS).read_text("utf-8"))
        lines = [json.loads(one) for one in (docs / SLICE).read_text("utf-8").splitlines()]
        shared = tuple(dict.fromkeys(cell["disturbance"] for cell in cells))
    for folder in folders:
        board, found = read_results(folder, "crossing")
        shared = shared or plan_of(board).disturbances
        if plan_of(board).disturbances != shared:
            raise ValueError(f"{folder} has other disturbances than {folders[0]}")
        new = {cell["policy"] for cell in board["cells"]}
        cells = [cell for cell in cells if cell["policy"] not in new]
        cells += map(kept, board["cells"])
        drawn = {line["policy"].partition("+")[0] for line in lines}
        lines += [one for one in slice_of(found) if one["policy"].partition("+")[0] not in drawn]
    page = page_of((docs / PAGE).read_text("utf-8"), cells)
    (docs / CELLS).parent.mkdir(exist_ok=True)
    write_text(docs / CELLS, "[\n" + ",\n".join(json.dumps(cell) for cell in cells) + "\n]\n")
    write_text(docs / SLICE, "".join(json.dumps(line) + "\n" for line in lines))
    write_text(docs / PAGE, page)


def main() -> None:
    """Run the command line."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("results", type=Path, nargs="+", help="output folders of tlf bench")
    parser.add_argument("--add", action="store_true", help="keep the other systems of the page")
    given = parser.parse_args()
    try:
        write_crossing(given.results, add=given.add)
    except ValueError as error:
        sys.exit(f"make_crossing: {error}")


if __name__ == "__main__":
    main()
