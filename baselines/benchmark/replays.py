"""Replays of some runs of a benchmark: run again, compared with their lines digit for digit, and written."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from baselines.benchmark.comparisons import built_in
from baselines.benchmark.lines import Line, failures, grouped
from baselines.benchmark.notable import key_of, notable
from baselines.benchmark.plan import Episode, Plan
from baselines.policies.registry import fit_policy
from baselines.runs.folders import NOT_IN_FOLDERS
from baselines.runs.run import Record, run_policy

FOLDER = "replays"
DEFAULT_COUNT = 6
LONGEST = 80  # characters of a file's name before its digits
HASH = 6


class Choice(NamedTuple):
    """A run to be replayed."""

    line: Line
    what: str  # "median" or "worst"


class Replay(NamedTuple):
    """A written replay."""

    line: Line
    what: str
    file: str  # beside the report, with / between
    differences: list[str]  # from the line of runs.jsonl; empty: the same in every digit


def headline(lines: Sequence[Line], ranked: Sequence[str], count: int) -> list[Choice]:
    """The runs that say most about the policies, at most ``count``.

    For each policy the worst run of the cell in which it fails most (of equals: the one with the largest
    error), and its median run in the first cell of the plan, which mostly is nominal. Policies that are not
    built in come first, then the others in the order ``ranked``. Then, if there is room, the worst and the
    median run of every other cell, by failures.
    """
    groups = grouped(lines)
    order = sorted(ranked, key=built_in)
    found: list[Choice] = []
    rest: list[tuple[int, Choice, Choice]] = []
    for policy in order:
        cells = [(failures(own), notable(own)) for own in groups[policy].values()]
        _, most = max(cells, key=lambda cell: (cell[0], _error(cell[1].worst)))
        found += [Choice(most.worst, "worst"), Choice(cells[0][1].median, "median")]
        rest += [
            (count, Choice(one.worst, "worst"), Choice(one.median, "median"))
            for count, one in cells
        ]
    rest.sort(key=lambda one: -one[0])
    found += [wanted for _, *pair in rest for wanted in pair]
    unique = {(Episode.of_line(one.line), one.what): one for one in found}
    return list(unique.values())[: max(count, 0)]


def _error(line: Line) -> float:
    values = [robot["position_rmse_mm"] for robot in line["robots"]]
    return max((value for value in values if value is not None), default=0.0)


def record_of(plan: Plan, episode: Episode) -> Record:
    """An episode of a plan, run again by itself and recorded with all its signals."""
    fitted = fit_policy(episode.policy, plan.scenario(episode), trust=plan.trust)
    return run_policy(
        fitted.scenario, fitted.policy, episode.seed, name=episode.policy, trust=plan.trust
    )


def differences(record: Record, line: Line) -> list[str]:
    """What differs between the metrics of a run and its line, in words; nothing if every digit is the same."""
    found = []
    again = json.loads(json.dumps([metrics._asdict() for metrics in record.metrics()]))
    for number, (now, then) in enumerate(zip(again, line["robots"], strict=True)):
        found += [
            f"robot {number}: {name} is {now.get(name)!r}, in runs.jsonl {value!r}"
            for name, value in then.items()
            if now.get(name) != value
        ]
    return found


def file_name(line: Line) -> str:
    """The name of the file of a run's replay."""
    episode = Episode.of_line(line)
    parts = [episode.task, episode.disturbance, episode.policy.removeprefix("reference:")]
    parts += [] if episode.sweep is None else [f"{episode.sweep:g}"]
    name = NOT_IN_FOLDERS.sub("_", "-".join((*parts, str(episode.seed)))).strip("_.-")
    digits = hashlib.sha256(json.dumps(episode).encode()).hexdigest()[:HASH]
    return f"{name[-LONGEST:].lstrip('_.-')}-{digits}.html"


def write_replays(
    plan: Plan,
    wanted: Sequence[Choice],
    folder: Path,
    write: Callable[[Record, Path], Path],
    progress: Callable[[int, int], None] | None = None,
) -> list[Replay]:
    """Run some episodes again and write their pages into ``replays`` of a folder.

    A run that is wanted as median and as worst is run once. Pages of an earlier choice are removed.

    Parameters
    ----------
    write
        Writes a record's page.
    """
    made: dict[Episode, Replay] = {}
    for done, (line, what) in enumerate(wanted, start=1):
        episode = Episode.of_line(line)
        if episode not in made:
            record = record_of(plan, episode)
            file = f"{FOLDER}/{file_name(line)}"
            (folder / FOLDER).mkdir(exist_ok=True)
            write(record, folder / file)
            made[episode] = Replay(line, what, file, differences(record, line))
        if progress is not None:
            progress(done, len(wanted))
    kept = {one.file for one in made.values()}
    for path in (folder / FOLDER).glob("*.html"):
        if f"{FOLDER}/{path.name}" not in kept:
            path.unlink()
    return [made[Episode.of_line(line)]._replace(what=what) for line, what in wanted]


def by_cell(replays: Iterable[Replay]) -> dict[tuple[Any, str], Replay]:
    """The replays by cell, and by median or worst."""
    return {(key_of(one.line), one.what): one for one in replays}
