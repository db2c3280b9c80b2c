"""Runs for ``make_generalisation.py``: driven once, kept line by line, and put together for each cell."""

from __future__ import annotations

import functools
import json
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from generalisation_cells import CELLS, ENTRIES, ROW_GAP_S, ROW_SETTLE_S, Cell, scenario_of
from make_board import DOCS, write_text

from baselines.console import progress_bar
from baselines.policies import laws
from baselines.policies.learned import LearnedPolicy
from baselines.policies.registry import FittedPolicy, fit_policy
from baselines.runs.jobs import spread
from baselines.runs.jsonl import append_line, read_lines
from baselines.runs.outcome import failed
from baselines.runs.provenance import simulation_digest
from baselines.runs.run import Record, run_policy, run_seeds
from baselines.runs.seed_ranges import FIRST_TABLE_SEED
from tlf_env.common.digest import code_digest
from tlf_env.task.neutral import scenario_hash

RUNS = DOCS.parent / "results" / "generalisation" / "runs.jsonl"
KEPT = DOCS / "generalisation" / "runs.jsonl"
ROBOTS_AT_ONCE = 200  # with 125 s each they take 300 MB
DIGITS = 6

Line = dict[str, Any]
Key = tuple[str, str, int]  # digest, entry, seed


class Job(NamedTuple):
    """Some seeds of an entry in a cell."""

    cell: Cell
    entry: str
    seeds: tuple[int, ...]


def fitted(cell: Cell, entry: str) -> FittedPolicy:
    """The entry, and the cell's scenario with the fields that the entry asks for."""
    return fit_policy(ENTRIES[entry], scenario_of(cell))


@functools.cache
def laws_digest() -> str:
    """Digest of the code of the simulation and of the laws."""
    return code_digest([Path(laws.__path__[0])], simulation_digest())


def digest_of(found: FittedPolicy) -> str:
    """Digest of everything that a run depends on but its entry and seed: code, scenario and weights."""
    weights = found.policy.card.weights_sha256 if isinstance(found.policy, LearnedPolicy) else ""
    return code_digest([], laws_digest(), scenario_hash(found.scenario), weights)


def rounded(value: float) -> float:
    """Six significant digits: the last ones may differ between processors."""
    return float(f"{value:.{DIGITS}g}")


def rms_mm(values: np.ndarray) -> list[float]:
    """Root mean square of each column."""
    return [rounded(one) for one in np.sqrt(np.mean(values**2, axis=0))]


def along_row(record: Record, settle_s: float = ROW_SETTLE_S) -> Line:
    """Errors of every robot of a long row, from the time at which the last one has driven for so long."""
    first_s = (record.robots - 1) * ROW_GAP_S + settle_s
    whole = record.t_s >= first_s
    return {
        "row_mm": rms_mm(record["position_error_mm"][whole]),
        "path_mm": rms_mm(record["formation_error_mm"][whole]),
        "gain": rounded(record.string().time_gain or 0.0),
    }


def line_of(job: Job, digest: str, record: Record) -> Line:
    """A run: whether it failed, and the position RMS of its worst robot."""
    metrics = record.metrics()
    long = job.cell.table == "rows"
    return {
        "digest": digest,
        "entry": job.entry,
        "seed": record.seed,
        "failed": failed(metrics),
        "rms_mm": rounded(max(robot.position_rmse_mm or 0.0 for robot in metrics)),
        **(along_row(record) if long else {}),
    }


def records(found: FittedPolicy, seeds: Sequence[int]) -> Iterator[Record]:
    """Runs side by side, or one after the other where there is contact."""
    if found.scenario.plant == "batch":
        yield from run_seeds(found.scenario, found.policy, seeds)
    else:
        for seed in seeds:
            yield run_policy(found.scenario, found.policy, seed)


def drive(_: None, job: Job) -> list[Line]:
    """The lines of a job."""
    found = fitted(job.cell, job.entry)
    digest = digest_of(found)
    return [line_of(job, digest, record) for record in records(found, job.seeds)]


def key_of(line: Line) -> Key:
    """What a run is found by."""
    return line["digest"], line["entry"], line["seed"]


def seeds_of(cell: Cell, count: int) -> range:
    """The seeds of a cell."""
    most = count if cell.most_seeds is None else min(count, cell.most_seeds)
    return range(FIRST_TABLE_SEED, FIRST_TABLE_SEED + most)


def missing_jobs(
    places: Iterable[tuple[Cell, str]], done: dict[Key, Line], count: int
) -> list[Job]:
    """What is still to be driven, in blocks."""
    jobs = []
    for cell, entry in places:
        found = fitted(cell, entry)
        digest, at_once = digest_of(found), ROBOTS_AT_ONCE // found.scenario.robot_count
        seeds = [s for s in seeds_of(cell, count) if (digest, entry, s) not in done]
        jobs += [
            Job(cell, entry, tuple(seeds[i : i + at_once])) for i in range(0, len(seeds), at_once)
        ]
    return jobs


def drive_missing(
    places: Sequence[tuple[Cell, str]], count: int, processes: int
) -> dict[Key, Line]:
    """All runs that are there, after the missing ones were driven."""
    RUNS.parent.mkdir(parents=True, exist_ok=True)
    done = read_lines(RUNS, key_of)
    jobs = missing_jobs(places, done, count)
    with progress_bar("blocks of runs") as update:
        for number, lines in enumerate(spread(drive, None, jobs, processes=processes), start=1):
            for line in lines:
                append_line(RUNS, line)
                done[key_of(line)] = line
            update(number, len(jobs))
    return done


def together(cell: Cell, entry: str, lines: Sequence[Line]) -> Line:
    """The runs of a cell and an entry in one line: failed seeds, errors, and medians along a long row."""
    seeds = [line["seed"] for line in lines]
    made = {
        "table": cell.table,
        "cell": cell.name,
        "entry": entry,
        "seeds": [seeds[0], seeds[-1] + 1],
        "failed": [line["seed"] for line in lines if line["failed"]],
        "rms_mm": [line["rms_mm"] for line in lines],
    }
    for name in ("row_mm", "path_mm", "gain"):
        if name in lines[0]:
            medians = np.median([line[name] for line in lines], axis=0)
            made[name] = np.vectorize(rounded)(medians).tolist()
    return made


def kept() -> dict[tuple[str, str], Line]:
    """The kept lines by cell and entry."""
    return read_lines(KEPT, lambda line: (line["cell"], line["entry"]))


def keep(lines: dict[tuple[str, str], Line]) -> None:
    """Write the kept lines, in the order of cells and entries; others come last."""
    order = [(cell.name, entry) for cell in CELLS for entry in ENTRIES]
    order += [key for key in lines if key not in order]
    texts = [json.dumps(lines[key], ensure_ascii=False) for key in order if key in lines]
    write_text(KEPT, "\n".join(texts) + "\n")


def put_together(places: Sequence[tuple[Cell, str]], done: dict[Key, Line], count: int) -> None:
    """Bring the kept lines up to date."""
    lines = kept()
    for cell, entry in places:
        digest = digest_of(fitted(cell, entry))
        runs = [done[digest, entry, seed] for seed in seeds_of(cell, count)]
        lines[cell.name, entry] = together(cell, entry, runs)
    keep(lines)
