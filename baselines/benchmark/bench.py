"""The benchmark: policies × tasks × disturbances × seeds, interrupted and resumed at will.

Every policy meets the same draws: a seed fixes noise, slip and starts whatever the policy does.
Finished episodes go to ``runs.jsonl``, a line each, flushed to disk; what is there is not run again,
and the tables are made from the lines in a fixed order, so that neither the number of processes nor
an interruption changes them.
"""

from __future__ import annotations

import hashlib
import inspect
import json
import os
import subprocess
from collections.abc import Callable, Collection, Sequence
from dataclasses import asdict, dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any, NamedTuple

from baselines.policies.learned import LearnedPolicy
from baselines.policies.reference import ReferencePolicy
from baselines.policies.registry import enter
from baselines.runs.jobs import claim, spread
from baselines.runs.run import Record, run_policy, run_seeds, versions
from tlf_env.common.files import atomic
from tlf_env.common.presets import preset_names, read_preset_or_file
from tlf_env.numerics.compiled import sources_digest
from tlf_env.numerics.philox import checked_seed
from tlf_env.onboard.parts import Policy
from tlf_env.task.scenario import Scenario, load_scenario

RUNS, PLAN = "runs.jsonl", "plan.json"
FIRST_CHOOSING_SEED, FIRST_TABLE_SEED = 10_000, 20_000
IN_FLIGHT_PER_PROCESS = 4
SEEDS_PER_BLOCK = 25  # a record takes 2 to 4 MB


class Cell(NamedTuple):
    """One episode of the table."""

    policy: str
    task: str
    disturbance: str
    level: float
    sweep: float | None  # value of the swept knob
    seed: int


@dataclass(frozen=True)
class Plan:
    """What is to be run. ``overrides`` are fields of every scenario; ``sweep`` is a knob's path."""

    policies: tuple[str, ...]
    tasks: tuple[str, ...]
    disturbances: tuple[str, ...]
    seeds: tuple[int, int]  # first, and the one after the last
    level: float = 1.0
    sweep: str | None = None
    sweep_values: tuple[float, ...] = ()
    overrides: tuple[tuple[str, Any], ...] = ()
    trust: bool = False

    @property
    def values(self) -> tuple[float | None, ...]:
        """Values of the swept knob; only None without a sweep."""
        return self.sweep_values if self.sweep else (None,)

    def cells(self) -> list[Cell]:
        """All episodes in the order of the tables; seeds run slowest, so that early results cover all."""
        return [
            Cell(policy, task, disturbance, self.level, value, seed)
            for seed in range(*self.seeds)
            for task in self.tasks
            for disturbance in self.disturbances
            for value in self.values
            for policy in self.policies
        ]

    def scenario(self, cell: Cell) -> Scenario:
        """The scenario of one episode.

        Raises
        ------
        ValueError
            for an unknown task, disturbance or knob, or a value out of its range.
        """
        overrides = dict(self.overrides)
        disturbance: Any = cell.disturbance
        if self.sweep is not None and cell.sweep is not None:
            if self.sweep == "level":
                return load_scenario(
                    cell.task, disturbance=disturbance, disturbance_level=cell.sweep, **overrides
                )
            base = load_scenario(cell.task, disturbance=disturbance).disturbance.model_dump()
            disturbance = with_value(base, self.sweep, cell.sweep)
        return load_scenario(
            cell.task, disturbance=disturbance, disturbance_level=cell.level, **overrides
        )


def with_value(tree: dict[str, Any], path: str, value: float) -> dict[str, Any]:
    """A copy of a nested mapping with one number replaced.

    Raises
    ------
    ValueError
        if there is nothing at the path.
    """
    head, _, tail = path.partition(".")
    if head not in tree:
        raise ValueError(f"sweep: there is no {head!r}; there are {', '.join(sorted(tree))}")
    if tail and not isinstance(tree[head], dict):
        raise ValueError(f"sweep: {head!r} has no parts, got {path!r}")
    return {**tree, head: with_value(tree[head], tail, value) if tail else value}


def parse_sweep(text: str) -> tuple[str, tuple[float, ...]]:
    """``path=first:last:count`` as the path and the values.

    Raises
    ------
    ValueError
        if it is not of that form.
    """
    path, _, span = text.partition("=")
    parts = span.split(":")
    try:
        first, last, count = float(parts[0]), float(parts[1]), int(parts[2])
        if len(parts) != 3 or count < 2 or not path:
            raise ValueError
    except (ValueError, IndexError):
        raise ValueError(
            f"sweep {text!r} must be PATH=FIRST:LAST:COUNT with COUNT at least 2, "
            "e.g. slip.delta_1_mm_s=0:40:9"
        ) from None
    return path, tuple(first + (last - first) * i / (count - 1) for i in range(count))


def parse_seeds(text: str) -> tuple[int, int]:
    """``first:end`` as two numbers; ``end`` is not run.

    Raises
    ------
    ValueError
        if it is not of that form.
    """
    first, _, end = text.partition(":")
    if not (first.isdecimal() and end.isdecimal() and int(first) < int(end)):
        raise ValueError(f"seeds {text!r} must be FIRST:END, e.g. 20000:20050")
    return int(first), int(end)


def read_plan(name: str, fields: Collection[str]) -> dict[str, Any]:
    """The options of `tlf bench` that a plan sets, as they stand on a command line.

    Parameters
    ----------
    name
        A plan's name (``board``) or a YAML file, which maps options to values; a list stands for names
        parted by commas.
    fields
        Options that a plan may set.

    Raises
    ------
    ValueError
        for a plan that there is not, and for another field or a value of no use.
    """
    found = read_preset_or_file("plan", name)
    options = {}
    for field, value in found.items():
        if field not in fields:
            raise ValueError(f"plan {name!r} has {field!r}; a plan has {', '.join(sorted(fields))}")
        options[field] = ",".join(map(str, value)) if isinstance(value, list) else value
        if not isinstance(options[field], str | int | float):
            raise ValueError(f"plan {name!r}: {field} must be a text, a number or a list")
    return options


def disturbance_presets() -> list[str]:
    """Names of all disturbance presets."""
    return preset_names("disturbance")


def run_cell(plan: Plan, cell: Cell) -> dict[str, Any]:
    """Run one episode; the line that it adds to ``runs.jsonl``.

    The scenario is the plan's with what the policy asks for: what it sees, acts on and runs on board.
    """
    policy, scenario, overrides = enter(cell.policy, plan.scenario(cell), trust=plan.trust)
    return _line(cell, policy, overrides, run_policy(scenario, policy, cell.seed, name=cell.policy))


def run_block(plan: Plan, cells: Sequence[Cell]) -> list[dict[str, Any]]:
    """Run the episodes of a block, side by side if their plant is ``batch``; their lines."""
    first = cells[0]
    policy, scenario, overrides = enter(first.policy, plan.scenario(first), trust=plan.trust)
    if scenario.plant != "batch":
        return [run_cell(plan, cell) for cell in cells]
    records = run_seeds(scenario, policy, [cell.seed for cell in cells], name=first.policy)
    return [
        _line(cell, policy, overrides, record) for cell, record in zip(cells, records, strict=True)
    ]


def _line(cell: Cell, policy: Policy, overrides: dict[str, Any], record: Record) -> dict[str, Any]:
    return {
        **cell._asdict(),
        "scenario_hash": scenario_hash(record.scenario),
        "overrides": overrides,
        "privileged": record.scenario.privileged or bool(getattr(policy, "privileged", False)),
        "contact": record.contact,
        "string": record.string()._asdict(),
        "robots": [metrics._asdict() for metrics in record.metrics()],
    }


def blocks(plan: Plan, cells: Sequence[Cell]) -> list[tuple[Cell, ...]]:
    """Cells that are run and written together: one by one, or on the batch plant up to 25 seeds.

    A block's cells differ in their seeds only. Blocks come in the order of their first cells.
    """
    if dict(plan.overrides).get("plant") != "batch":
        return [(cell,) for cell in cells]
    alike: dict[Cell, list[Cell]] = {}
    for cell in cells:
        alike.setdefault(cell._replace(seed=0), []).append(cell)
    parts = [
        tuple(group[i : i + SEEDS_PER_BLOCK])
        for group in alike.values()
        for i in range(0, len(group), SEEDS_PER_BLOCK)
    ]
    place = {cell: i for i, cell in enumerate(cells)}
    return sorted(parts, key=lambda part: place[part[0]])


def scenario_hash(scenario: Scenario) -> str:
    """Twelve digits that stand for everything an episode depends on but its seed."""
    return hashlib.sha256(scenario.model_dump_json().encode()).hexdigest()[:12]


def _git(*words: str) -> str:
    """What git says of the checkout that this file lies in."""
    here = Path(__file__).resolve().parent
    done = subprocess.run(
        ["git", *words], cwd=here, capture_output=True, text=True, timeout=10, check=True
    )
    return done.stdout.strip()


def git_revision() -> str | None:
    """Revision of the source checkout that runs, with ``+`` if it has changes; None without git."""
    try:
        revision = _git("rev-parse", "HEAD")
        changes = _git("status", "--porcelain", "-uno")
    except (OSError, subprocess.SubprocessError):
        return None
    return revision + ("+" if changes else "")


def policy_hash(name: str, policy: Policy) -> str | None:
    """Twelve digits of the files that a policy comes from; None if there are none."""
    files = [Path(name)] if name.endswith(".zip") else _sources(policy)
    if not files:
        return None
    return hashlib.sha256(b"".join(path.read_bytes() for path in files)).hexdigest()[:12]


def _sources(policy: Policy) -> list[Path]:
    """A learned policy's weights and card, or the file of the object's class and what it was made from."""
    if isinstance(policy, LearnedPolicy):
        return list(policy.files)
    try:
        source = inspect.getsourcefile(type(policy))
    except TypeError:
        return []
    made_from = policy.files if isinstance(policy, ReferencePolicy) else ()
    return [Path(source), *made_from] if source else []


def plan_record(plan: Plan) -> dict[str, Any]:
    """What ``plan.json`` holds. Every scenario is loaded and every policy made on the way.

    Raises
    ------
    ValueError
        for an unknown name, a knob out of its range, a seed too large, or a policy that does not fit.
    """
    checked_seed(plan.seeds[1] - 1)
    scenarios: dict[str, str] = {}
    policies: dict[str, str | None] = {}
    for task in plan.tasks:
        for disturbance in plan.disturbances:
            for value in plan.values:
                cell = Cell("", task, disturbance, plan.level, value, plan.seeds[0])
                place = ", ".join(
                    (task, disturbance) if value is None else (task, disturbance, f"{value:g}")
                )
                scenario = plan.scenario(cell)
                scenarios[place] = scenario_hash(scenario)
        for name in plan.policies:
            policies[name] = policy_hash(name, enter(name, scenario, trust=plan.trust).policy)
    asked = asdict(plan)
    del asked["trust"]  # a permission, which changes no result
    return {
        "plan": json.loads(json.dumps(asked)),
        "policies": policies,
        "scenarios": scenarios,
        "sources": sources_digest(),
        "versions": versions(),
        "git_revision": git_revision(),
    }


class Results:
    """The lines of finished episodes in a folder, and what is still missing.

    Raises
    ------
    ValueError
        if the plan cannot run, or the folder holds results of another plan, of other policies or of
        other sources of the simulation.
    """

    def __init__(self, folder: Path, plan: Plan) -> None:
        self.folder, self.plan = folder, plan
        record = plan_record(plan)
        folder.mkdir(parents=True, exist_ok=True)
        claim(folder / PLAN, record, ("plan", "policies", "scenarios", "sources"), "results")
        self.lines = self._read()

    def _read(self) -> dict[Cell, dict[str, Any]]:
        """Whole lines only: what a killed writer left half written is cut off."""
        path = self.folder / RUNS
        if not path.exists():
            return {}
        data = path.read_bytes()
        whole = data[: data.rfind(b"\n") + 1]
        if len(whole) < len(data):
            with atomic(path, "wb") as file:
                file.write(whole)
        lines: dict[Cell, dict[str, Any]] = {}
        for number, text in enumerate(whole.splitlines(), start=1):
            try:
                line = json.loads(text)
                lines[Cell(*(line[name] for name in Cell._fields))] = line
            except (ValueError, KeyError, TypeError) as error:
                raise ValueError(f"{path}, line {number} is damaged; remove it") from error
        return lines

    def add(self, line: dict[str, Any]) -> None:
        """Append one episode; it is on the disk when this returns."""
        text = json.dumps(line, allow_nan=False) + "\n"
        handle = os.open(self.folder / RUNS, os.O_WRONLY | os.O_APPEND | os.O_CREAT, 0o644)
        try:
            os.write(handle, text.encode())
            os.fsync(handle)
        finally:
            os.close(handle)
        self.lines[Cell(*(line[name] for name in Cell._fields))] = line

    def missing(self) -> list[Cell]:
        """Episodes that have not been run."""
        return [cell for cell in self.plan.cells() if cell not in self.lines]

    def ordered(self) -> list[dict[str, Any]]:
        """The finished lines in the plan's order."""
        return [self.lines[cell] for cell in self.plan.cells() if cell in self.lines]


def run_bench(
    plan: Plan,
    folder: Path,
    *,
    processes: int = 1,
    ray_address: str | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> Results:
    """Run what is missing of a plan, here or on a Ray cluster.

    Raises
    ------
    ValueError
        for a plan that cannot run, before anything is run.
    """
    if processes < 1:
        raise ValueError(f"processes {processes} must be at least 1")
    if find_spec("arch") is None:
        raise ValueError("the tables need arch (pip install 'tlf-env[bench]')")
    results = Results(folder, plan)
    todo = results.missing()
    total = len(plan.cells())
    if progress is not None:
        progress(total - len(todo), total)
    finished = spread(
        run_block,
        plan,
        blocks(plan, todo),
        processes=processes,
        ray_address=ray_address,
        ahead=IN_FLIGHT_PER_PROCESS,
    )
    for lines in finished:
        for line in lines:
            results.add(line)
        if progress is not None:
            progress(len(results.lines), total)
    return results
