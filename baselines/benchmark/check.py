"""Regenerating cells of the published board, and comparing them digit for digit."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

from baselines.benchmark.aggregate import cell_table
from baselines.benchmark.bench import run_bench
from baselines.benchmark.plan import Plan
from tlf_env.common.errors import suggestion
from tlf_env.common.files import read_json

PUBLISHED = Path(__file__).parent / "published.json"  # cells of docs/leaderboard/leaderboard.json
UNCOMPARED = ("policy", "task", "disturbance", "sweep", "privileged", "overrides", "time")
NUMBER_FORMAT = ".17g"


class Difference(NamedTuple):
    """A value of a cell that comes out differently."""

    name: str  # with dots between the keys
    published: Any
    here: Any


class Checked(NamedTuple):
    """A cell of the board, run again."""

    policy: str
    task: str
    disturbance: str
    values: int  # that were compared
    differences: tuple[Difference, ...]


def published_board() -> dict[str, Any]:
    """The plan and the cells of the published board."""
    return dict(read_json(PUBLISHED))


def checked_plan(board: Mapping[str, Any], cell: str, policies: tuple[str, ...] | None) -> Plan:
    """The plan that runs one pair of task and disturbance of the board again.

    Parameters
    ----------
    cell
        ``TASK:DISTURBANCE``.
    policies
        Those of the board's entries that are run; None: all.

    Raises
    ------
    ValueError
        for a pair or an entry that the board does not have.
    """
    task, _, disturbance = cell.partition(":")
    pairs = sorted({f"{one['task']}:{one['disturbance']}" for one in board["cells"]})
    if cell not in pairs:
        raise ValueError(
            f"--check {cell!r} must be TASK:DISTURBANCE of the published board, for example "
            f"{pairs[0]}{suggestion(cell, pairs)}"
        )
    plan = board["plan"]
    there = tuple(plan["policies"])
    for name in policies or ():
        if name not in there:
            raise ValueError(
                f"policy {name!r} is not one of the board's entries, {', '.join(there)}"
                f"{suggestion(name, there)}"
            )
    return Plan(
        policies=policies or there,
        tasks=(task,),
        disturbances=(disturbance,),
        seeds=(plan["seeds"][0], plan["seeds"][1]),
        level=plan["level"],
        overrides=tuple((field, value) for field, value in plan["overrides"]),
    )


def check(
    board: Mapping[str, Any],
    plan: Plan,
    folder: Path,
    *,
    processes: int,
    progress: Callable[[int, int], None] | None = None,
) -> list[Checked]:
    """Run a plan of :func:`checked_plan`, and compare its cells with the published ones.

    Raises
    ------
    ValueError
        if the folder holds results of another plan.
    """
    results = run_bench(plan, folder, processes=processes, progress=progress)
    lines = results.ordered()
    found = []
    for policy in plan.policies:
        mine = [line for line in lines if line["policy"] == policy]
        (published,) = (
            one
            for one in board["cells"]
            if (one["policy"], one["task"], one["disturbance"])
            == (policy, plan.tasks[0], plan.disturbances[0])
        )
        here = flat(cell_table(mine))
        wanted = {
            name: value
            for name, value in flat(published).items()
            if name.partition(".")[0] not in UNCOMPARED
        }
        differences = tuple(
            Difference(name, value, here.get(name))
            for name, value in wanted.items()
            if here.get(name) != value
        )
        found.append(Checked(policy, plan.tasks[0], plan.disturbances[0], len(wanted), differences))
    return found


def flat(tree: Any, path: str = "") -> dict[str, Any]:
    """The values of nested mappings and lists by their paths."""
    if isinstance(tree, Mapping):
        parts = tree.items()
    elif isinstance(tree, list | tuple):
        parts = {str(number): one for number, one in enumerate(tree)}.items()
    else:
        return {path: tree}
    return {
        name: value
        for key, one in parts
        for name, value in flat(one, f"{path}.{key}" if path else key).items()
    }


def digits(value: Any) -> str:
    """A value with every digit that distinguishes it."""
    return format(value, NUMBER_FORMAT) if isinstance(value, float) else str(value)
