"""The command line ``tlf``. Policies, matplotlib and other heavy parts are loaded where they are used.

Exit status: 0, also for a run in which robots get lost (a lost run is a result); 1 when something
failed; 2 for bad input, told in one line.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn
from rich.table import Table
from typer.exceptions import TyperException

BAD_INPUT, FAILED, INTERRUPTED = 2, 1, 130

app = typer.Typer(
    help="Time-gap leader-follower control of wheeled robots that slip.",
    add_completion=False,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
)
screen = Console(highlight=False)
notes = Console(stderr=True, highlight=False)


@contextmanager
def progress_bar(what: str) -> Iterator[Callable[[int, int], None]]:
    """A progress bar on stderr; yields ``update(done, total)``."""
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeRemainingColumn(),
    )
    with Progress(*columns, console=notes, transient=True) as bar:
        task = bar.add_task(what, total=None)
        yield lambda done, total: bar.update(task, completed=done, total=total)


@app.command()
def run(
    scenario: Annotated[str, typer.Argument(help="infinity, flower, or a scenario's YAML file.")],
    disturbance: Annotated[str | None, typer.Option(help="Preset: nominal, none.")] = None,
    level: Annotated[float | None, typer.Option(help="Level of the disturbance.")] = None,
    policy: Annotated[str, typer.Option(help="Who drives: reference.")] = "reference",
    gains: Annotated[
        str, typer.Option(help="Gains of the reference: consistent, printed.")
    ] = "consistent",
    seed: Annotated[int, typer.Option(help="Seed of all random draws.")] = 0,
    robots: Annotated[int | None, typer.Option(help="How many robots.")] = None,
    plant: Annotated[str | None, typer.Option(help="pymunk or kinematic.")] = None,
    control_period_s: Annotated[float | None, typer.Option(help="Period of the policy, s.")] = None,
    horizon_s: Annotated[float | None, typer.Option(help="Length of the run, s.")] = None,
    out: Annotated[
        Path | None, typer.Option(help="Folder of the results; results/SCENARIO without it.")
    ] = None,
    figures: Annotated[bool, typer.Option(help="Draw the figures.")] = True,
    as_json: Annotated[
        bool, typer.Option("--json", help="Print summary.json instead of the table.")
    ] = False,
) -> None:
    """Drive a policy through a scenario to the horizon; a table, a summary, data and figures."""
    from baselines.policies import make_policy
    from baselines.run import run_policy, summary, write_record
    from tlf_env.envs.parallel import checked_seed
    from tlf_env.task.scenario import load_scenario

    chosen = load_scenario(
        scenario,
        disturbance=disturbance,
        disturbance_level=level,
        robots=robots,
        plant=plant,
        control_period_s=control_period_s,
        horizon_s=horizon_s,
    )
    checked_seed(seed)
    driver = make_policy(policy, gains)
    folder = writable_folder(out or Path("results") / chosen.name)
    with progress_bar(f"{chosen.name}, {policy}") as update:
        record = run_policy(chosen, driver, seed, name=f"{policy} ({gains})", progress=update)
    write_record(record, folder)
    drawn = draw(record, folder) if figures else []
    if as_json:
        typer.echo(json.dumps(summary(record), indent=2, allow_nan=False))
        return
    screen.print(metrics_table(record))
    names = ["summary.json", "trajectory.npz", "trajectory.csv", *(path.name for path in drawn)]
    screen.print(f"In {folder}: {', '.join(names)}", soft_wrap=True)


def draw(record: Any, folder: Path) -> list[Path]:
    """The figures of a run, or none and a hint where matplotlib is missing."""
    try:
        from baselines.figures import write_figures
    except ModuleNotFoundError as error:
        notes.print(f"No figures: {error.name} is missing (pip install 'tlf-env[figures]').")
        return []
    return write_figures(record, folder)


def metrics_table(record: Any) -> Table:
    """The run's summary, a row per robot."""
    s = record.scenario
    table = Table(
        title=f"{s.name}, {record.policy}, disturbance {s.disturbance.name}, seed {record.seed}",
        caption=f"RMS, largest error and time gap from {s.settle_s:g} s to {s.horizon_s:g} s; "
        "the rest over the whole run",
        box=SIMPLE_HEAD,
        collapse_padding=True,
        pad_edge=False,
    )
    columns: list[tuple[str, str, int]] = [
        ("position\nRMS mm", "position_rmse_mm", 2),
        ("largest\nmm", "position_max_mm", 1),
        ("formation\nRMS mm", "formation_rmse_mm", 1),
        ("heading\nRMS rad", "heading_rmse_rad", 4),
        ("time gap\nRMS s", "time_gap_rmse_s", 4),
        ("torque at\nlimit %", "saturation_fraction", 1),
        ("largest\nslip mm/s", "slip_max_mm_s", 1),
    ]
    table.add_column("robot")
    for title, _, _ in columns:
        table.add_column(title, justify="right")
    table.add_column("end")
    for i, metrics in enumerate(record.metrics()):
        row = metrics._asdict() | {"saturation_fraction": 100 * metrics.saturation_fraction}
        cells = [
            "–" if row[key] is None else f"{row[key]:.{digits}f}" for _, key, digits in columns
        ]
        ends = [name for name in ("lost", "touched") if row[name]]
        table.add_row(str(i), *cells, " ".join(ends) or "held")
    return table


@app.command()
def openloop(
    scenarios: Annotated[Path, typer.Argument(help="JSON file of named scenarios.")],
    out: Annotated[Path, typer.Option(help="Folder for NAME.csv of each.")] = Path(
        "results/openloop"
    ),
    dt_s: Annotated[float, typer.Option(help="Substep, s; it must divide 0.1.")] = 0.001,
    as_json: Annotated[
        bool, typer.Option("--json", help="Print where the files are, as JSON.")
    ] = False,
) -> None:
    """Drive one robot with given torques (no wheel loop, no limit); a row every 0.1 s."""
    from tlf_env.physics.openloop import load_scenarios, run_open_loop, write_rows

    loaded = load_scenarios(scenarios)
    folder = writable_folder(out)
    written = {}
    with progress_bar("open loop") as update:
        for done, (name, scenario) in enumerate(loaded.items(), start=1):
            written[name] = str(
                write_rows(folder / f"{name}.csv", run_open_loop(scenario, dt_s=dt_s))
            )
            update(done, len(loaded))
    if as_json:
        typer.echo(json.dumps(written, indent=2))
    else:
        for path in written.values():
            screen.print(path, soft_wrap=True)


@app.command()
def speed(
    steps: Annotated[int, typer.Option(help="Environment steps per timing.")] = 1000,
    repeats: Annotated[int, typer.Option(help="Timings of each environment, taken in turn.")] = 7,
) -> None:
    """Environment steps per second as JSON, beside mpe2's simple_spread_v3 where it is installed."""
    from baselines.speed import measure

    with progress_bar("speed") as update:
        result = measure(steps, repeats, progress=update)
    typer.echo(json.dumps(result, indent=2))


def writable_folder(folder: Path) -> Path:
    """The folder, made if need be.

    Raises
    ------
    ValueError
        if it cannot be made or is no folder.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ValueError(f"cannot write to {folder}: {error.strerror}") from error
    return folder


def main() -> None:
    """Run the command line; every bad input ends in one line on stderr and exit status 2."""
    try:
        app(sys.argv[1:] or ["--help"], standalone_mode=False)
    except TyperException as error:
        fail(error.format_message(), error.exit_code)
    except ValueError as error:
        fail(str(error), BAD_INPUT)
    except OSError as error:
        fail(str(error), FAILED)
    except (KeyboardInterrupt, typer.Abort):
        fail("interrupted", INTERRUPTED)


def fail(message: str, status: int) -> None:
    """Say why in one line and leave."""
    notes.print(f"tlf: {' '.join(message.split())}", markup=False, soft_wrap=True)
    sys.exit(status)
