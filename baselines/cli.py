"""The command line ``tlf``. Policies, matplotlib and other heavy parts are loaded where they are used.

Exit status: 0, also for a run in which robots get lost (a lost run is a result); 1 when something
failed; 2 for bad input, told in one line.
"""

from __future__ import annotations

import json
import os
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
    with Progress(*columns, console=notes, transient=True, disable=not notes.is_terminal) as bar:
        task = bar.add_task(what, total=None)
        yield lambda done, total: bar.update(task, completed=done, total=total)


@app.command()
def run(
    scenario: Annotated[
        str,
        typer.Argument(
            help="A preset (infinity, flower), a YAML file, or a path.csv: t_s,x_mm,y_mm."
        ),
    ],
    disturbance: Annotated[
        str | None,
        typer.Option(help="Preset: nominal, none, noise, slip, ice, start, payload, ..."),
    ] = None,
    level: Annotated[float | None, typer.Option(help="Level of the disturbance.")] = None,
    policy: Annotated[
        str,
        typer.Option(
            help="reference[:GAINS], reference:FILE.yaml, pure_pursuit, feedback_linearisation, a "
            "shipped learned policy, FILE.safetensors (with FILE.json), module:factory, "
            "FILE.zip (with --trust)."
        ),
    ] = "reference",
    gains: Annotated[
        str | None,
        typer.Option(
            help="Gains of the reference: consistent (default), printed, tuned, FILE.yaml."
        ),
    ] = None,
    estimator: Annotated[
        str | None,
        typer.Option(help="ekf (the paper's), ekf-slip, truth (privileged), or module:factory."),
    ] = None,
    wheel_loop: Annotated[str | None, typer.Option(help="module:factory of a wheel loop.")] = None,
    observer: Annotated[str | None, typer.Option(help="module:factory of an observer.")] = None,
    seed: Annotated[int, typer.Option(help="Seed of all random draws.")] = 0,
    robots: Annotated[int | None, typer.Option(help="How many robots.")] = None,
    plant: Annotated[
        str | None, typer.Option(help="pymunk, batch (no contact) or kinematic.")
    ] = None,
    control_period_s: Annotated[float | None, typer.Option(help="Period of the policy, s.")] = None,
    horizon_s: Annotated[float | None, typer.Option(help="Length of the run, s.")] = None,
    out: Annotated[
        Path | None, typer.Option(help="Folder of the results; results/SCENARIO without it.")
    ] = None,
    figures: Annotated[bool, typer.Option(help="Draw the figures.")] = True,
    mat: Annotated[bool, typer.Option("--mat", help="Write trajectory.mat too.")] = False,
    trust: Annotated[
        bool, typer.Option("--trust", help="Load an SB3 .zip, which runs code that is in it.")
    ] = False,
    as_json: Annotated[
        bool, typer.Option("--json", help="Print summary.json instead of the table.")
    ] = False,
) -> None:
    """Drive a policy through a scenario to the horizon; a table, a summary, data and figures."""
    from baselines.policies.registry import enter, overrides_told
    from baselines.runs.run import run_policy, summary, write_mat, write_record
    from tlf_env.numerics.philox import checked_seed
    from tlf_env.task.scenario import load_scenario, scenario_notes, scenario_warnings

    chosen = load_scenario(
        scenario,
        disturbance=disturbance,
        disturbance_level=level,
        robots=robots,
        plant=plant,
        estimator=estimator,
        wheel_loop=wheel_loop,
        observer=observer,
        control_period_s=control_period_s,
        horizon_s=horizon_s,
    )
    checked_seed(seed)
    name = named_policy(policy, gains)
    driver, chosen, overrides = enter(name, chosen, trust=trust)
    if overrides:
        told = overrides_told(overrides)
        notes.print(f"tlf: note: as {name} asks: {', '.join(told)}", markup=False, soft_wrap=True)
    for line in scenario_warnings(chosen):
        notes.print(f"tlf: warning: {line}", markup=False, soft_wrap=True)
    for line in scenario_notes(chosen):
        notes.print(f"tlf: note: {line}", markup=False, soft_wrap=True)
    folder = writable_folder(out or Path("results") / chosen.name)
    warn_of_compiling()
    with progress_bar(f"{chosen.name}, {name}") as update:
        record = run_policy(chosen, driver, seed, name=name, progress=update)
    written = write_record(record, folder)
    if mat:
        written.append(write_mat(record, folder))
    if figures:
        written += draw(record, folder)
    if as_json:
        typer.echo(json.dumps(summary(record), indent=2, allow_nan=False))
        return
    screen.print(metrics_table(record))
    screen.print(f"In {folder}: {', '.join(path.name for path in written)}", soft_wrap=True)


def warn_of_compiling() -> None:
    """Say why the first run on a machine takes its time."""
    from tlf_env.numerics.compiled import cache_folder

    if not any(cache_folder().rglob("*control_step*.nbi")):
        notes.print("Compiling the step drivers, once on this machine: about a minute.")


def named_policy(policy: str, gains: str | None) -> str:
    """The policy's name with the reference's gains in it.

    Raises
    ------
    ValueError
        for gains that no policy takes.
    """
    if policy == "reference":
        return f"reference:{gains or 'consistent'}"
    if gains is not None:
        raise ValueError(f"--gains {gains} goes with --policy reference, not with {policy!r}")
    return policy


def draw(record: Any, folder: Path) -> list[Path]:
    """The figures of a run, or none and a hint where matplotlib is missing."""
    try:
        from baselines.runs.figures import write_figures
    except ModuleNotFoundError as error:
        notes.print(f"No figures: {error.name} is missing (pip install 'tlf-env[figures]').")
        return []
    return write_figures(record, folder)


def metrics_table(record: Any) -> Table:
    """The run's summary, a row per robot."""
    s = record.scenario
    table = Table(
        title=f"{s.name}, {record.policy}, disturbance {s.disturbance.name}, seed {record.seed}",
        caption=f"errors from {s.settle_s:g} s on (form from 5 s after its gap); "
        "pos: to the own reference, form: to the leader's path one gap later each",
        box=SIMPLE_HEAD,
        collapse_padding=True,
        pad_edge=False,
    )
    columns: list[tuple[str, str, int]] = [
        ("pos RMS\nmm", "position_rmse_mm", 2),
        ("max\nmm", "position_max_mm", 1),
        ("form RMS\nmm", "formation_rmse_mm", 1),
        ("head RMS\nrad", "heading_rmse_rad", 4),
        ("gap RMS\ns", "time_gap_rmse_s", 4),
        ("at limit\n%", "saturation_fraction", 1),
        ("slip max\nmm/s", "slip_max_mm_s", 1),
    ]
    table.add_column("robot")
    for heading, _, _ in columns:
        table.add_column(heading, justify="right")
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
    formations: Annotated[
        str, typer.Option(help="Formations of the vector environment, parted by commas, or none.")
    ] = "1,32,1024,8192",
    threads: Annotated[str, typer.Option(help="Threads, parted by commas.")] = "1,2",
    peers: Annotated[
        bool, typer.Option(help="Measure mpe2 and VMAS too, where they are installed.")
    ] = True,
    parts: Annotated[bool, typer.Option(help="Tell where the time of a step goes.")] = True,
    out: Annotated[Path | None, typer.Option(help="Write the JSON to this file too.")] = None,
) -> None:
    """Steps per second as JSON (a table on stderr), beside mpe2 and VMAS where they are installed."""
    from baselines.speed.speed import measure

    counts = [] if formations == "none" else whole_numbers("formations", formations)
    warn_of_compiling()
    with progress_bar("speed") as update:
        result = measure(
            steps,
            repeats,
            update,
            formations=counts,
            threads=whole_numbers("threads", threads),
            peers=peers,
            parts=parts,
        )
    text = json.dumps(result, indent=2)
    if out is not None:
        out.write_text(text + "\n", encoding="utf-8")
    notes.print(speed_table(result))
    typer.echo(text)


def whole_numbers(name: str, text: str) -> list[int]:
    """Whole numbers parted by commas.

    Raises
    ------
    ValueError
        naming the option, for anything else.
    """
    try:
        return [int(part) for part in text.split(",")]
    except ValueError:
        raise ValueError(f"--{name} {text!r} must be whole numbers parted by commas") from None


def speed_table(result: dict[str, Any]) -> Table:
    """Agent steps per second of every environment that was measured."""
    table = Table(box=SIMPLE_HEAD)
    for name in ("environment", "robots", "formations", "threads", "agent steps/s", "to mpe2"):
        table.add_column(name, justify="left" if name == "environment" else "right")
    keys = ("env", "robots", "formations", "threads")
    ratios = {
        tuple(row[key] for key in keys): row["ratio"]
        for row in result["ratios"]
        if row["to"].startswith("mpe2")
    }
    for row in result["results"]:
        place = tuple(row[key] for key in keys)
        ratio = f"{ratios[place]:.1f} ×" if place in ratios else ""
        table.add_row(*map(str, place), f"{row['agent_steps_per_s']:.0f}", ratio)
    return table


PLAN_OPTIONS = frozenset(
    ("policies", "tasks", "disturbances", "seeds", "level", "sweep", "horizon_s", "plant")
)


def take_plan(ctx: typer.Context, plan: str | None) -> str | None:
    """Make a plan's values the defaults of the other options, which stand above it where given.

    Raises
    ------
    ValueError
        for a plan that there is not, a field that is no option of a plan, or a value of no use.
    """
    from baselines.benchmark.bench import read_plan

    if plan is not None:
        ctx.default_map = read_plan(plan, PLAN_OPTIONS)
    return plan


@app.command()
def bench(
    policies: Annotated[
        str, typer.Option(help="Names as in `tlf run --policy`, parted by commas.")
    ] = "reference:consistent,reference:printed,pure_pursuit,feedback_linearisation",
    tasks: Annotated[str, typer.Option(help="Scenarios, parted by commas.")] = "infinity,flower",
    disturbances: Annotated[
        str, typer.Option(help="Disturbance presets, parted by commas, or all.")
    ] = "all",
    seeds: Annotated[str, typer.Option(help="FIRST:END; END is not run.")] = "20000:20050",
    level: Annotated[float, typer.Option(help="Level of the disturbances.")] = 1.0,
    sweep: Annotated[
        str | None,
        typer.Option(
            help="A knob's values instead: PATH=FIRST:LAST:COUNT, slip.delta_1_mm_s=0:40:9."
        ),
    ] = None,
    horizon_s: Annotated[float | None, typer.Option(help="Length of each run, s.")] = None,
    plant: Annotated[
        str | None,
        typer.Option(help="pymunk, batch (seeds side by side, no contact) or kinematic."),
    ] = None,
    processes: Annotated[int, typer.Option(help="Processes on this machine; 0: one per core.")] = 0,
    ray: Annotated[
        str | None, typer.Option(help="Address of an existing Ray cluster to run on instead.")
    ] = None,
    trust: Annotated[
        bool, typer.Option("--trust", help="Load SB3 .zip files, which runs code in them.")
    ] = False,
    plan: Annotated[
        str | None,
        typer.Option(
            help="Take the options above from a plan, board or FILE.yaml; what is given stands.",
            is_eager=True,
            callback=take_plan,
        ),
    ] = None,
    out: Annotated[Path, typer.Option(help="Folder of the results.")] = Path("results/bench"),
    figures: Annotated[bool, typer.Option(help="Draw the figures.")] = True,
    as_json: Annotated[
        bool, typer.Option("--json", help="Print leaderboard.json instead of the tables.")
    ] = False,
) -> None:
    """Compare policies on the same draws; interrupt it and call it again to go on."""
    from baselines.benchmark.bench import (
        Plan,
        disturbance_presets,
        parse_seeds,
        parse_sweep,
        run_bench,
    )

    path, values = parse_sweep(sweep) if sweep else (None, ())
    asked = Plan(
        policies=listed(policies),
        tasks=listed(tasks),
        disturbances=tuple(disturbance_presets())
        if disturbances == "all"
        else listed(disturbances),
        seeds=parse_seeds(seeds),
        level=level,
        sweep=path,
        sweep_values=values,
        overrides=tuple(
            (field, value)
            for field, value in (("horizon_s", horizon_s), ("plant", plant))
            if value is not None
        ),
        trust=trust,
    )
    with progress_bar("bench") as update:
        results = run_bench(
            asked,
            out,
            processes=processes or os.cpu_count() or 1,
            ray_address=ray,
            progress=update,
        )
    from baselines.benchmark.aggregate import write_leaderboard

    command = "tlf " + " ".join(without_places(sys.argv[1:]))
    board = write_leaderboard(results, out, command, draw_bench if figures else None)
    if as_json:
        typer.echo(json.dumps(board, indent=1, allow_nan=False))
    else:
        screen.print(board_table(board))
        screen.print(f"In {out}: runs.jsonl, leaderboard.md, leaderboard.json", soft_wrap=True)


@app.command()
def train(
    config: Annotated[
        str,
        typer.Argument(help="A training: residual, direct, quick, sac, recurrent, or a YAML file."),
    ],
    seeds: Annotated[str, typer.Option(help="Training seeds, parted by commas.")] = "0",
    robot_steps: Annotated[
        int | None, typer.Option(help="Control steps times robots, instead of the file's.")
    ] = None,
    processes: Annotated[
        int, typer.Option(help="Seeds at a time on this machine; 0: one per core.")
    ] = 0,
    ray: Annotated[
        str | None, typer.Option(help="Address of an existing Ray cluster to run on instead.")
    ] = None,
    out: Annotated[
        Path | None, typer.Option(help="Folder of the results; results/train/CONFIG without it.")
    ] = None,
    as_json: Annotated[
        bool, typer.Option("--json", help="Print the evaluations as JSON instead of the table.")
    ] = False,
) -> None:
    """Train policies, a seed each; interrupt it and call it again to go on to the same result."""
    from baselines.training.config import load_config

    try:
        from baselines.training.train_seeds import kept, train_seeds
    except ModuleNotFoundError as error:
        raise ValueError(f"training needs {error.name} (pip install 'tlf-env[train]')") from error
    loaded = load_config(config, robot_steps=robot_steps)
    numbers = whole_numbers("seeds", seeds)
    name = Path(config).stem
    folder = writable_folder(out or Path("results/train") / name)
    warn_of_compiling()
    with progress_bar(f"train {name}") as update:
        curves = train_seeds(
            loaded,
            numbers,
            folder,
            processes=min(processes or os.cpu_count() or 1, len(numbers)),
            ray_address=ray,
            command="tlf " + " ".join(without_places(sys.argv[1:])),
            progress=update,
        )
    if as_json:
        rows = [
            {"seed": curve["seed"], "start": curve["evaluations"][0], "kept": kept(curve)}
            for curve in curves
        ]
        typer.echo(json.dumps(rows, indent=1, allow_nan=False))
        return
    screen.print(training_table(curves))
    screen.print(f"In {folder}: policy.safetensors and policy.json of the best, seed_N of each")


def training_table(curves: list[dict[str, Any]]) -> Table:
    """What every seed reached on the choosing seeds."""
    from baselines.training.train_seeds import kept

    table = Table(
        title="geometric mean of the worst robot's position RMS in mm, a failed run counts 1000",
        box=SIMPLE_HEAD,
    )
    for name in ("seed", "start", "kept", "failed at start", "failed", "robot steps", "minutes"):
        table.add_column(name, justify="right")
    for curve in curves:
        first, best = curve["evaluations"][0], kept(curve)
        table.add_row(
            str(curve["seed"]),
            f"{first['score_mm']:.2f}",
            f"{best['score_mm']:.2f}",
            str(first["failed"]),
            str(best["failed"]),
            f"{best['robot_steps']}",
            f"{curve['wall_time_s'] / 60:.1f}",
        )
    return table


@app.command()
def tune(
    config: Annotated[str, typer.Argument(help="A search: a preset (tuned), or a YAML file.")],
    trials: Annotated[
        int | None, typer.Option(help="Trials in all, those of earlier calls included.")
    ] = None,
    workers: Annotated[
        int, typer.Option(help="Processes on this machine; 0: one per core. One repeats exactly.")
    ] = 1,
    ray: Annotated[
        str | None, typer.Option(help="Address of an existing Ray cluster to run on instead.")
    ] = None,
    out: Annotated[
        Path | None, typer.Option(help="Folder of the results; results/tune/CONFIG without it.")
    ] = None,
    as_json: Annotated[
        bool, typer.Option("--json", help="Print the result as JSON instead of the table.")
    ] = False,
) -> None:
    """Find a controller's gains, limits and filter; interrupt it and call it again to go on."""
    from baselines.tuning.tune import RESULT, load_tune, run_tune

    search = load_tune(config, trials=trials)
    folder = out or Path("results") / "tune" / Path(config).stem
    warn_of_compiling()
    with progress_bar("tune") as update:
        result = run_tune(
            search,
            folder,
            workers=workers or os.cpu_count() or 1,
            ray_address=ray,
            command="tlf " + " ".join(without_places(sys.argv[1:])),
            progress=update,
        )
    if as_json:
        typer.echo(json.dumps(result, indent=2, allow_nan=False))
        return
    screen.print(tune_table(result["found"]))
    screen.print(f"In {folder}: {RESULT}; drive it with", soft_wrap=True)
    screen.print(f"tlf run {search.tasks[0]} --gains {folder / RESULT}", soft_wrap=True)


def tune_table(found: dict[str, Any]) -> Table:
    """The result of a search beside its start, on the seeds of both kinds."""
    table = Table(title=f"trial {found['trial']}, less is better", box=SIMPLE_HEAD)
    for heading in ("seeds", "task, disturbance"):
        table.add_column(heading)
    for heading in ("cost,\nfound", "cost,\nstart", "failed,\nfound", "failed,\nstart"):
        table.add_column(heading, justify="right")
    for seeds in ("tune", "choose"):
        mine, first = found[seeds]["found"], found[seeds]["start"]
        for place, row in mine["strata"].items():
            other = first["strata"][place]
            costs = (f"{row['cost']:.3f}", f"{other['cost']:.3f}")
            table.add_row(seeds, place, *costs, str(row["failed"]), str(other["failed"]))
        scores = (f"{mine['score']:.3f}", f"{first['score']:.3f}")
        table.add_row(seeds, "all", *scores, str(mine["failed"]), str(first["failed"]))
    return table


PLACES = ("--out", "--processes", "--workers", "--ray")


def without_places(words: list[str]) -> list[str]:
    """A command's words without those that say where it runs: they do not change a result."""
    kept: list[str] = []
    skip = False
    for word in words:
        if skip or word.split("=")[0] in PLACES:
            skip = not skip and "=" not in word
            continue
        kept.append(word)
    return kept


def listed(text: str) -> tuple[str, ...]:
    """Names parted by commas.

    Raises
    ------
    ValueError
        if there is none, or one twice.
    """
    names = tuple(name.strip() for name in text.split(",") if name.strip())
    if not names or len(set(names)) < len(names):
        raise ValueError(f"{text!r} must be names parted by commas, each once")
    return names


def draw_bench(board: dict[str, Any], folder: Path) -> list[Path]:
    """The benchmark's figures, or none and a hint where matplotlib is missing."""
    try:
        from baselines.benchmark.figures import write_bench_figures
    except ModuleNotFoundError as error:
        notes.print(f"No figures: {error.name} is missing (pip install 'tlf-env[figures]').")
        return []
    return write_bench_figures(board, folder)


def board_table(board: dict[str, Any]) -> Table:
    """Policies over all tasks and disturbances."""
    from baselines.benchmark.aggregate import title

    table = Table(title="score 0 to 100, interquartile mean over all runs", box=SIMPLE_HEAD)
    table.add_column("policy")
    for heading in ("score", "95 %", "normalised", "better than\nreference", "failed"):
        table.add_column(heading, justify="right")
    for row in board["policies"]:
        ends, better = row["score"]["interval"], row["probability_of_improvement"]
        scaled = row["normalised_score"]
        table.add_row(
            title(row),
            f"{row['score']['iqm']:.1f}",
            "–" if ends is None else f"{ends[0]:.1f}–{ends[1]:.1f}",
            "–" if scaled is None else f"{scaled:.2f}",
            "–" if better is None else f"{better:.2f}",
            f"{row['failed']} of {row['runs']}",
        )
    return table


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
        status = app(sys.argv[1:] or ["--help"], standalone_mode=False)
    except TyperException as error:
        fail(error.format_message(), error.exit_code)
    except ValueError as error:
        fail(str(error), BAD_INPUT)
    except OSError as error:
        fail(str(error), FAILED)
    except (KeyboardInterrupt, typer.Abort):
        fail("interrupted", INTERRUPTED)
    else:
        if status == INTERRUPTED:  # how typer tells of Ctrl-C
            fail("interrupted", INTERRUPTED)


def fail(message: str, status: int) -> None:
    """Say why in one line and leave."""
    notes.print(f"tlf: {' '.join(message.split())}", markup=False, soft_wrap=True)
    sys.exit(status)
