"""The command line ``tlf``. Policies, matplotlib and other heavy modules are imported where they are used.

Exit status: 0, also for a run in which robots get lost (that is a result); 1 after an error of the
system; 2 for invalid input, reported in one line; 130 after an interrupt.
"""

from __future__ import annotations

import json
import os
import shlex
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Annotated, Any

import typer
from typer.exceptions import TyperException

from baselines.commands.examples import examples
from baselines.console import (
    given,
    listed,
    notes,
    print_on_any_terminal,
    progress_bar,
    screen,
    warn_of_scenarios,
    whole_numbers,
    writable_folder,
)
from tlf_env.common.errors import install_command
from tlf_env.onboard.controllers import DEFAULT_CONTROLLER

BAD_INPUT, FAILED, INTERRUPTED = 2, 1, 130
RESUMED = ("bench", "eval", "train", "tune")  # commands that go on where they were interrupted

app = typer.Typer(
    help="Time-gap leader-follower formations of wheeled robots that slip.",
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
)


def completed(kind: str) -> Callable[[str], list[str]]:
    """Completes the names of a kind of :data:`~baselines.commands.catalogue.KINDS` in a shell."""

    def matching(incomplete: str) -> list[str]:
        from baselines.commands.catalogue import catalogue

        return [name for name in catalogue(kind)[kind] if name.startswith(incomplete)]

    return matching


def print_version(wanted: bool) -> None:
    """Print the version and end, if it is wanted."""
    if wanted:
        from importlib.metadata import version

        typer.echo(f"tlf_env {version('tlf-env')}")
        raise typer.Exit


@app.callback()
def everywhere(
    version: Annotated[
        bool,
        typer.Option("--version", help="Print the version.", is_eager=True, callback=print_version),
    ] = False,
) -> None:
    """Time-gap leader-follower formations of wheeled robots that slip."""


@app.command(epilog=examples("demo"))
def demo(
    seed: Annotated[int, typer.Option(help="Seed of all random draws.")] = 0,
    out: Annotated[Path, typer.Option(help="Folder of the picture and the data.")] = Path(
        "results/demo"
    ),
    figures: Annotated[bool, typer.Option(help="Draw the picture.")] = True,
) -> None:
    """Compare the paper's loop, the default and a learned policy, with and without slip: a first look."""
    from baselines.commands.compile import compile_before_first_run
    from baselines.commands.demo import demo_command
    from tlf_env.numerics.philox import checked_seed

    compile_before_first_run()
    demo_command(checked_seed(seed), out, figures=figures)


@app.command("list", epilog=examples("list"))
def list_(
    kind: Annotated[
        str | None,
        typer.Argument(help="tasks, disturbances, policies, ...; all kinds if it is left out."),
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print the names as JSON.")] = False,
) -> None:
    """List what can be named: tasks, disturbances, policies, estimators, trainings, plans, ..."""
    from baselines.commands.catalogue import catalogue, print_catalogue

    found = catalogue(kind)
    if as_json:
        typer.echo(json.dumps(found, indent=1, ensure_ascii=False))
    else:
        print_catalogue(found)


SCENARIO = typer.Argument(
    help="Preset (see `tlf list tasks`), YAML file, CSV file of waypoints t_s,x_mm,y_mm, or -: YAML from the "
    "standard input.",
    autocompletion=completed("tasks"),
)
DISTURBANCE = typer.Option(
    help="Disturbance: a preset (see `tlf list disturbances`) or FILE.yaml.",
    autocompletion=completed("disturbances"),
)
LEVEL = typer.Option(help="Factor on the disturbance's deviation from nominal.")
SETTINGS = typer.Option(
    "--set",
    help="PATH=VALUE: set a field of the scenario, e.g. time_gap_s=3 or disturbance.slip.delta_1_mm_s=20; may "
    "be repeated. `tlf show SCENARIO` prints all fields.",
    metavar="PATH=VALUE",
)

VIDEO = typer.Option(help="Write a video, too: FILE.mp4 or FILE.gif.", metavar="FILE")
VIDEO_FPS = typer.Option(help="Frames per second of the video.")
VIDEO_SPEED = typer.Option(help="Speed of the video, relative to real time.")
RAY = typer.Option(help="Address of an existing Ray cluster to run on instead.")
TRUST = typer.Option(
    "--trust", help="Load SB3 .zip files and run entries' programs: code that they contain."
)

REPLAYS = typer.Option(
    min=0,
    help="Pages of replays beside report.html: the worst and the median run of the most telling cells.",
)


@app.command(epilog=examples("show"))
def show(
    scenario: Annotated[str, SCENARIO],
    disturbance: Annotated[str | None, DISTURBANCE] = None,
    level: Annotated[float | None, LEVEL] = None,
    settings: Annotated[list[str] | None, SETTINGS] = None,
    changes: Annotated[
        bool, typer.Option("--changes", help="Print only what differs from the defaults.")
    ] = False,
) -> None:
    """Print a scenario as YAML: `tlf show infinity > own.yaml`, or `tlf show infinity | tlf run -`."""
    from baselines.commands.scenarios import asked_scenario, shown_scenario

    chosen = asked_scenario(scenario, {"disturbance": disturbance}, level, settings or ())
    typer.echo(str(chosen) if changes else shown_scenario(chosen), nl=False)


@app.command(epilog=examples("run"))
def run(
    scenario: Annotated[str, SCENARIO],
    disturbance: Annotated[str | None, DISTURBANCE] = None,
    level: Annotated[float | None, LEVEL] = None,
    settings: Annotated[list[str] | None, SETTINGS] = None,
    policy: Annotated[
        str,
        typer.Option(
            autocompletion=completed("policies"),
            help="reference[:GAINS], reference:FILE.yaml, pure_pursuit, feedback_linearisation, kanayama, "
            "lqr, sliding_mode, adrc, nmpc, CONTROLLER+ESTIMATOR+LIMITER of these (e.g. "
            "kanayama+ekf-slip+body), the name of a shipped policy, FILE.safetensors (with FILE.json), "
            "module:factory; with --trust FILE.zip and entry:FOLDER (a competition's entry).",
        ),
    ] = "reference",
    gains: Annotated[
        str | None,
        typer.Option(
            help="Gains of the reference: linearised (default), tuned, consistent and printed (the paper's), "
            "FILE.yaml."
        ),
    ] = None,
    estimator: Annotated[
        str | None,
        typer.Option(
            help="ekf-gyro (default), ekf-slip, ekf (the paper's), truth (the true pose and slip), or "
            "module:factory."
        ),
    ] = None,
    wheel_loop: Annotated[str | None, typer.Option(help="Own wheel loop, module:factory.")] = None,
    observer: Annotated[str | None, typer.Option(help="Own observer, module:factory.")] = None,
    seed: Annotated[int, typer.Option(help="Seed of all random draws.")] = 0,
    robots: Annotated[int | None, typer.Option(help="Number of robots.")] = None,
    plant: Annotated[
        str | None, typer.Option(help="pymunk, batch (no contact), kinematic or chipmunk.")
    ] = None,
    control_period_s: Annotated[
        float | None, typer.Option(help="Control period of the policy, s.")
    ] = None,
    horizon_s: Annotated[float | None, typer.Option(help="Length of the run, s.")] = None,
    phase_s: Annotated[
        float | None,
        typer.Option(help="Time on its trajectory at which the leader's reference starts, s."),
    ] = None,
    poses: Annotated[
        str | None,
        typer.Option(
            help="Start poses of the robots, x_mm,y_mm,theta_rad of each, with ; between."
        ),
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option(
            help="Folder of the results; default results/SCENARIO-POLICY-DISTURBANCE-SEED, with some digits "
            "where anything else is not as in the presets."
        ),
    ] = None,
    overwrite: Annotated[
        bool, typer.Option("--overwrite", help="Replace another run that is in the folder --out.")
    ] = False,
    figures: Annotated[bool, typer.Option(help="Draw the figures.")] = True,
    parquet: Annotated[
        bool, typer.Option("--parquet", help="Write trajectory.parquet, too (needs pyarrow).")
    ] = False,
    mat: Annotated[bool, typer.Option("--mat", help="Write trajectory.mat, too.")] = False,
    video: Annotated[Path | None, VIDEO] = None,
    video_fps: Annotated[float, VIDEO_FPS] = 25.0,
    video_speed: Annotated[float, VIDEO_SPEED] = 1.0,
    trust: Annotated[bool, TRUST] = False,
    as_json: Annotated[
        bool, typer.Option("--json", help="Print summary.json instead of the table.")
    ] = False,
) -> None:
    """Run a policy in a scenario to its horizon; write table, summary, data, replay page and figures."""
    from baselines.commands.run import Wanted, run_command
    from baselines.commands.scenarios import asked_scenario

    fields = {
        "disturbance": disturbance,
        "robots": robots,
        "plant": plant,
        "estimator": estimator,
        "wheel_loop": wheel_loop,
        "observer": observer,
        "control_period_s": control_period_s,
        "horizon_s": horizon_s,
    }
    options: dict[str, Any] = {} if phase_s is None else {"phase_s": phase_s}
    if poses is not None:
        options["poses"] = start_poses(poses)
    finished = run_command(
        asked_scenario(scenario, fields, level, settings or ()),
        named_policy(policy, gains),
        seed,
        options,
        Wanted(
            out=out,
            overwrite=overwrite,
            figures=figures,
            mat=mat,
            parquet=parquet,
            as_json=as_json,
            video=video,
            video_fps=video_fps,
            video_speed=video_speed,
        ),
        trust=trust,
    )
    if not finished:
        raise SystemExit(INTERRUPTED)


@app.command(epilog=examples("compare"))
def compare(
    folders: Annotated[
        list[Path], typer.Argument(help="Folders of runs of one task and seed, by `tlf run`.")
    ],
    out: Annotated[Path, typer.Option(help="The page that is written.")] = Path(
        "results/compare.html"
    ),
    video: Annotated[Path | None, VIDEO] = None,
    video_fps: Annotated[float, VIDEO_FPS] = 25.0,
    video_speed: Annotated[float, VIDEO_SPEED] = 1.0,
) -> None:
    """Show recorded runs side by side: one page with one time line, a video, and what differs."""
    from baselines.commands.compare import Filmed, compare_command

    writable_folder(out.parent)
    film = None if video is None else Filmed(video, video_fps, video_speed)
    compare_command(folders, out, film)


THEME = typer.Option(help="Colours of the window: light or dark.")
LIVE_POLICY = typer.Option(
    help="As of tlf run; the keys p and t switch to others while it runs.",
    autocompletion=completed("policies"),
)


@app.command(epilog=examples("view"))
def view(
    scenario: Annotated[str, SCENARIO],
    disturbance: Annotated[str | None, DISTURBANCE] = None,
    level: Annotated[float | None, LEVEL] = None,
    settings: Annotated[list[str] | None, SETTINGS] = None,
    policy: Annotated[str, LIVE_POLICY] = "reference",
    seed: Annotated[int, typer.Option(help="Seed of all random draws.")] = 0,
    robots: Annotated[int | None, typer.Option(help="Number of robots.")] = None,
    horizon_s: Annotated[float | None, typer.Option(help="Length of the episode, s.")] = None,
    phase_s: Annotated[
        float | None,
        typer.Option(help="Time on its trajectory at which the leader's reference starts, s."),
    ] = None,
    theme: Annotated[str, THEME] = "light",
    trust: Annotated[bool, TRUST] = False,
) -> None:
    """Show an episode live in a window: pause, zoom, switch policy, push robots, drop slippery patches."""
    from baselines.commands.live import view_command
    from baselines.commands.scenarios import asked_scenario

    fields = {"disturbance": disturbance, "robots": robots, "horizon_s": horizon_s}
    view_command(
        asked_scenario(scenario, fields, level, settings or ()),
        named_policy(policy, None),
        seed,
        {} if phase_s is None else {"phase_s": phase_s},
        theme=theme,
        trust=trust,
    )


@app.command(epilog=examples("play"))
def play(
    scenario: Annotated[str, SCENARIO],
    disturbance: Annotated[str | None, DISTURBANCE] = None,
    level: Annotated[float | None, LEVEL] = None,
    settings: Annotated[list[str] | None, SETTINGS] = None,
    policy: Annotated[str, LIVE_POLICY] = "reference",
    seed: Annotated[int, typer.Option(help="Seed of all random draws.")] = 0,
    robots: Annotated[int | None, typer.Option(help="Number of robots.")] = None,
    horizon_s: Annotated[float, typer.Option(help="The longest drive, s.")] = 600.0,
    out: Annotated[
        Path, typer.Option(help="The path that was driven, a CSV file for `tlf run`.")
    ] = Path("drive.csv"),
    theme: Annotated[str, THEME] = "light",
    trust: Annotated[bool, TRUST] = False,
) -> None:
    """Drive the leader with arrow keys, W A S D or a gamepad; the others follow. Keeps the path as a file."""
    from baselines.commands.live import play_command
    from baselines.commands.scenarios import asked_scenario

    fields = {"disturbance": disturbance, "robots": robots}
    play_command(
        asked_scenario(scenario, fields, level, settings or ()),
        named_policy(policy, None),
        seed,
        out,
        horizon_s=horizon_s,
        theme=theme,
        trust=trust,
    )


@app.command("path", epilog=examples("path"))
def path_(
    log: Annotated[
        Path,
        typer.Argument(
            help="Log of positions over time: CSV with any delimiter and decimal sign, comments, and the usual "
            "names of columns."
        ),
    ],
    out: Annotated[
        Path, typer.Option(help="The path that is written, a CSV file for `tlf run`.")
    ] = Path("path.csv"),
    columns: Annotated[
        str | None,
        typer.Option(
            help="Columns of time, x and y: three names, or numbers from 1 on, with commas."
        ),
    ] = None,
    units: Annotated[
        str | None,
        typer.Option(help="Unit of x and y: m, cm or mm; by default as the header says."),
    ] = None,
    smooth: Annotated[
        float | None,
        typer.Option(
            help="Smooth the positions: standard deviation of their noise, mm (e.g. 5 for a camera)."
        ),
    ] = None,
    speed_limit: Annotated[
        float | None,
        typer.Option(
            help="Time the path anew, from rest to rest: largest speed, mm/s; slower in turns, as the tyres "
            "need it."
        ),
    ] = None,
    figures: Annotated[bool, typer.Option(help="Draw the path.")] = True,
) -> None:
    """Make a path that robots can follow of your own log: `tlf path log.csv --units m --smooth 5`."""
    from baselines.commands.path import path_command

    path_command(
        log,
        out,
        columns=columns,
        units=units,
        smooth_mm=smooth,
        speed_limit_mm_s=speed_limit,
        figures=figures,
    )


def start_poses(text: str) -> list[list[float]]:
    """Start poses from ``x_mm,y_mm,theta_rad`` of each robot, with ``;`` between.

    Raises
    ------
    ValueError
        for a text that is not numbers.
    """
    try:
        return [[float(number) for number in row.split(",")] for row in text.split(";")]
    except ValueError as error:
        raise ValueError(
            f"--poses {text!r} must be x_mm,y_mm,theta_rad of each robot, with ; between"
        ) from error


def named_policy(policy: str, gains: str | None) -> str:
    """The policy's name, with the gains if it is the reference.

    Raises
    ------
    ValueError
        for gains with another policy.
    """
    if policy == "reference":
        return f"reference:{gains or DEFAULT_CONTROLLER}"
    if gains is not None:
        raise ValueError(f"--gains {gains} needs --policy reference, got {policy!r}")
    return policy


@app.command(epilog=examples("openloop"))
def openloop(
    scenarios: Annotated[Path, typer.Argument(help="JSON file of named scenarios.")],
    out: Annotated[Path, typer.Option(help="Folder for one NAME.csv per scenario.")] = Path(
        "results/openloop"
    ),
    dt_s: Annotated[float, typer.Option(help="Substep, s; it must divide 0.1.")] = 0.001,
    plant: Annotated[
        str, typer.Option(help="kernel, or chipmunk: pymunk's bodies and constraints.")
    ] = "kernel",
    as_json: Annotated[
        bool, typer.Option("--json", help="Print the paths of the files as JSON.")
    ] = False,
) -> None:
    """Run one robot with given torques, without wheel loop and limits; write a row every 0.1 s."""
    from tlf_env.physics.openloop import load_scenarios, run_open_loop, write_rows

    loaded = load_scenarios(scenarios)
    folder = writable_folder(out)
    written = {}
    with progress_bar("open loop") as update:
        for done, (name, scenario) in enumerate(loaded.items(), start=1):
            written[name] = str(
                write_rows(folder / f"{name}.csv", run_open_loop(scenario, dt_s=dt_s, plant=plant))
            )
            update(done, len(loaded))
    if as_json:
        typer.echo(json.dumps(written, indent=2))
    else:
        for path in written.values():
            screen.print(path, soft_wrap=True)


@app.command(epilog=examples("speed"))
def speed(
    steps: Annotated[int, typer.Option(help="Environment steps per timing.")] = 1000,
    repeats: Annotated[
        int, typer.Option(help="Timings of each environment; the environments take turns.")
    ] = 7,
    formations: Annotated[
        str, typer.Option(help="Formations of the vector environment, comma-separated, or none.")
    ] = "1,32,1024,8192",
    threads: Annotated[str, typer.Option(help="Threads, comma-separated.")] = "1,2",
    peers: Annotated[
        bool, typer.Option(help="Measure mpe2 and VMAS, too, if they are installed.")
    ] = True,
    parts: Annotated[bool, typer.Option(help="Measure the parts of a step.")] = True,
    out: Annotated[Path | None, typer.Option(help="Write the JSON to this file, too.")] = None,
) -> None:
    """Measure steps per second, ours and of mpe2 and VMAS; JSON on stdout, a table on stderr."""
    from baselines.commands.compile import compile_before_first_run
    from baselines.speed.speed import measure
    from baselines.tables import speed_table

    counts = [] if formations == "none" else whole_numbers("formations", formations)
    if out is not None:
        writable_folder(out.parent)
    compile_before_first_run()
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


PLAN_OPTIONS = frozenset(
    ("policies", "tasks", "disturbances", "also", "seeds", "level", "sweep", "horizon_s", "plant")
)


def take_plan(ctx: typer.Context, plan: str | None) -> str | None:
    """Make a plan's values the defaults of the other options; given options take precedence.

    Raises
    ------
    ValueError
        for an unknown plan, an unknown field, or a value of the wrong type.
    """
    from baselines.benchmark.plan import read_plan

    if plan is not None:
        ctx.default_map = read_plan(plan, PLAN_OPTIONS)
    return plan


@app.command(epilog=examples("bench"))
def bench(
    ctx: typer.Context,
    policies: Annotated[
        str, typer.Option(help="Names as in `tlf run --policy`, comma-separated.")
    ] = "reference:linearised,reference:consistent,reference:printed,pure_pursuit,feedback_linearisation",
    tasks: Annotated[str, typer.Option(help="Scenarios, comma-separated.")] = "infinity,flower",
    disturbances: Annotated[
        str, typer.Option(help="Disturbances, comma-separated: presets or FILE.yaml; or all.")
    ] = "all",
    also: Annotated[
        str,
        typer.Option(
            help="TASK:DISTURBANCE, comma-separated: pairs that are run beside all pairs of --tasks and "
            "--disturbances."
        ),
    ] = "",
    seeds: Annotated[
        str, typer.Option(help="Seeds FIRST:END; END itself is not run.")
    ] = "20000:20050",
    level: Annotated[
        float, typer.Option(help="Factor on the disturbances' deviation from nominal.")
    ] = 1.0,
    sweep: Annotated[
        str | None,
        typer.Option(
            help="Run several values of a parameter of the disturbance or field of the scenario: "
            "PATH=FIRST:LAST:COUNT, e.g. slip.delta_1_mm_s=0:40:9; PATH=FIRST:LAST:COUNT:log; or "
            "PATH=VALUE,VALUE,..., e.g. robots=3,5,10."
        ),
    ] = None,
    envelope: Annotated[
        bool,
        typer.Option(
            "--envelope",
            help="Search the largest level of each knob that 95 % of the runs hold, in place of running "
            "--disturbances; --seeds is then 20000:20100 and --tasks infinity by default.",
        ),
    ] = False,
    knobs: Annotated[
        str,
        typer.Option(help="Of --envelope, comma-separated: presets or FILE.yaml; or all."),
    ] = "all",
    resolution: Annotated[
        float, typer.Option(help="Of --envelope: largest ratio of neighbouring levels, less 1.")
    ] = 0.05,
    horizon_s: Annotated[float | None, typer.Option(help="Length of each run, s.")] = None,
    plant: Annotated[
        str | None,
        typer.Option(help="pymunk, batch (seeds side by side, no contact), kinematic or chipmunk."),
    ] = None,
    processes: Annotated[int, typer.Option(help="Processes on this machine; 0: one per core.")] = 0,
    ray: Annotated[str | None, RAY] = None,
    trust: Annotated[bool, TRUST] = False,
    plan: Annotated[
        str | None,
        typer.Option(
            help="Read policies, tasks, disturbances, also, seeds, level, sweep, horizon and plant from a "
            "plan: a preset (see `tlf list plans`) or FILE.yaml; command-line options take precedence.",
            autocompletion=completed("plans"),
            is_eager=True,
            callback=take_plan,
        ),
    ] = None,
    entry: Annotated[
        list[Path] | None,
        typer.Option(
            help="Folder of a competition's entry, with entry.yaml; may be repeated. Without --policies only "
            "the entries run.",
        ),
    ] = None,
    test: Annotated[
        bool,
        typer.Option(
            "--test",
            help="Run the test set: cases with random tasks, robots and disturbances, 20000:20200 unless "
            "--seeds has others. Every look is logged.",
        ),
    ] = False,
    test_seed: Annotated[
        str | None,
        typer.Option(help="Run cases made from this text in place of the published test set."),
    ] = None,
    check: Annotated[
        str | None,
        typer.Option(
            "--check",
            metavar="TASK:DISTURBANCE",
            help="Run a cell of the published board again, for all its entries or those of --policies, and "
            "compare every digit.",
        ),
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option(help="Folder of the results; default results/bench or results/test."),
    ] = None,
    figures: Annotated[bool, typer.Option(help="Draw the figures.")] = True,
    replays: Annotated[int, REPLAYS] = 6,
    as_json: Annotated[
        bool, typer.Option("--json", help="Print leaderboard.json instead of the tables.")
    ] = False,
) -> None:
    """Compare policies on the same random draws. Interrupt it, and call it again to continue."""
    names = listed(policies)
    if check is not None:
        from baselines.commands.check import check_command

        refuse_beside_test(ctx, "--check")
        asked_names = names if given(ctx, "policies") else None
        if not check_command(check, asked_names, out, processes or os.cpu_count() or 1):
            raise SystemExit(FAILED)
        return
    if entry:
        names = (*(names if given(ctx, "policies") else ()), *(f"entry:{one}" for one in entry))
    if envelope:
        from baselines.commands.envelope import bench_envelope

        bench_envelope(ctx, names)
        return
    if test or test_seed is not None:
        refuse_beside_test(ctx)
        bench_test(
            names,
            seeds if given(ctx, "seeds") else None,
            test_seed,
            trust=trust,
            out=out or Path("results/test"),
            processes=processes or os.cpu_count() or 1,
            ray=ray,
            as_json=as_json,
        )
        return
    out = out or Path("results/bench")
    from baselines.benchmark.bench import named_scenarios, need_tables, run_bench
    from baselines.benchmark.plan import (
        Plan,
        disturbance_presets,
        parse_pairs,
        parse_seeds,
        parse_sweep,
    )
    from baselines.runs.provenance import command_line

    need_tables()
    path, values = parse_sweep(sweep) if sweep else (None, ())
    asked = Plan(
        policies=names,
        tasks=listed(tasks),
        disturbances=tuple(disturbance_presets())
        if disturbances == "all"
        else listed(disturbances),
        also=parse_pairs(also),
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
    warn_of_scenarios(named_scenarios(asked))
    with progress_bar("bench") as update:
        results = run_bench(
            asked,
            out,
            processes=processes or os.cpu_count() or 1,
            ray_address=ray,
            progress=update,
        )
    from baselines.commands.bench import BenchFiles, finish

    finish(
        results,
        BenchFiles(figures=figures, replays=replays, as_json=as_json),
        command_line(sys.argv[1:]),
    )


@app.command("eval", epilog=examples("eval"))
def eval_(
    policy: Annotated[
        str,
        typer.Argument(help="As in `tlf run --policy`.", autocompletion=completed("policies")),
    ],
    against: Annotated[
        str,
        typer.Option(
            help="The policy that it is compared with.", autocompletion=completed("policies")
        ),
    ] = f"reference:{DEFAULT_CONTROLLER}",
    tasks: Annotated[str, typer.Option(help="Scenarios, comma-separated.")] = "infinity,flower",
    disturbances: Annotated[
        str, typer.Option(help="Disturbances, comma-separated: presets or FILE.yaml; or all.")
    ] = "nominal,slip,ice,combined-medium",
    seeds: Annotated[
        str, typer.Option(help="Seeds FIRST:END; END itself is not run.")
    ] = "20000:20020",
    horizon_s: Annotated[float, typer.Option(help="Length of each run, s.")] = 60.0,
    plant: Annotated[
        str,
        typer.Option(help="batch (seeds side by side, no contact), pymunk, kinematic or chipmunk."),
    ] = "batch",
    processes: Annotated[int, typer.Option(help="Processes on this machine; 0: one per core.")] = 0,
    trust: Annotated[bool, TRUST] = False,
    out: Annotated[
        Path | None, typer.Option(help="Folder of the results; default results/eval/POLICY.")
    ] = None,
    figures: Annotated[bool, typer.Option(help="Draw the figures.")] = True,
    replays: Annotated[int, REPLAYS] = 4,
    as_json: Annotated[
        bool, typer.Option("--json", help="Print the comparison as JSON instead of the table.")
    ] = False,
) -> None:
    """Compare one policy with the default, in a minute or two. Call it again to continue."""
    from baselines.benchmark.bench import need_tables

    need_tables()
    from baselines.commands.bench import BenchFiles
    from baselines.commands.eval import eval_command

    eval_command(
        policy,
        against,
        tasks=tasks,
        disturbances=disturbances,
        seeds=seeds,
        overrides={"horizon_s": horizon_s, "plant": plant},
        out=out,
        processes=processes or os.cpu_count() or 1,
        wanted=BenchFiles(figures=figures, replays=replays, as_json=as_json),
        trust=trust,
    )


def refuse_beside_test(ctx: typer.Context, option_given: str = "--test") -> None:
    """Refuse options that the cases of the test set, or a cell of the board, have themselves.

    Raises
    ------
    ValueError
        naming the first option.
    """
    for option in ("tasks", "disturbances", "also", "level", "sweep", "horizon_s", "plant"):
        if given(ctx, option):
            raise ValueError(
                f"--{option.replace('_', '-')} cannot be used with {option_given}: every case has its own"
            )


def bench_test(
    policies: tuple[str, ...],
    seeds: str | None,
    test_seed: str | None,
    *,
    trust: bool,
    out: Path,
    processes: int,
    ray: str | None,
    as_json: bool,
) -> None:
    """Run entries on the test set, and write and print the tables."""
    from baselines.benchmark.bench import run_bench
    from baselines.benchmark.plan import parse_seeds
    from baselines.benchmark.testset_page import write_test_board
    from baselines.benchmark.testset_plan import PUBLISHED, log_look, plan_of_test
    from baselines.commands.compile import compile_before_first_run
    from baselines.runs.provenance import command_line
    from baselines.tables import testset_table

    if test_seed == "":
        raise ValueError("--test-seed must not be empty")
    cases = PUBLISHED if seeds is None else parse_seeds(seeds)
    plan = plan_of_test(policies, cases, test_seed or "", trust=trust)
    compile_before_first_run()
    with progress_bar("test set") as update:
        results = run_bench(
            plan,
            out,
            processes=processes,
            ray_address=ray,
            progress=update,
            begin=lambda: log_look(plan, out),
        )
    board = write_test_board(results, out, command_line(sys.argv[1:]))
    if as_json:
        typer.echo(json.dumps(board, indent=1, allow_nan=False))
        return
    screen.print(testset_table(board))
    screen.print(f"In {out}: runs.jsonl, leaderboard.md, leaderboard.json", soft_wrap=True)


@app.command(epilog=examples("export"))
def export(
    tasks: Annotated[str, typer.Argument(help="Tasks, comma-separated (see `tlf list tasks`).")],
    policy: Annotated[
        str, typer.Option(help="As in `tlf run --policy`.", autocompletion=completed("policies"))
    ] = f"reference:{DEFAULT_CONTROLLER}",
    disturbances: Annotated[
        str, typer.Option(help="Disturbances, comma-separated: presets or FILE.yaml.")
    ] = "nominal",
    seeds: Annotated[str, typer.Option(help="Seeds FIRST:END; END itself is not run.")] = "0:20",
    horizon_s: Annotated[float | None, typer.Option(help="Length of each episode, s.")] = None,
    form: Annotated[str, typer.Option(help="parquet (a plain table) or minari.")] = "parquet",
    joint: Annotated[
        bool,
        typer.Option(
            "--joint", help="One episode for each formation in place of one for each robot."
        ),
    ] = False,
    name: Annotated[str, typer.Option(help="Name of the data set.")] = "dataset",
    out: Annotated[Path, typer.Option(help="Folder of the data set.")] = Path("results/data"),
    trust: Annotated[bool, TRUST] = False,
) -> None:
    """Write runs as a data set for offline learning: observations, actions and rewards of every robot."""
    from baselines.commands.export import export_command

    export_command(
        tasks,
        disturbances,
        policy,
        seeds,
        horizon_s=horizon_s,
        form=form,
        joint=joint,
        name=name,
        out=out,
        trust=trust,
    )


@app.command(epilog=examples("train"))
def train(
    ctx: typer.Context,
    config: Annotated[
        str,
        typer.Argument(
            help="Training: a preset (see `tlf list trainings`) or a YAML file.",
            autocompletion=completed("trainings"),
        ),
    ],
    seeds: Annotated[str, typer.Option(help="Training seeds, comma-separated.")] = "0",
    robot_steps: Annotated[
        int | None, typer.Option(help="Control steps × robots; overrides the file's.")
    ] = None,
    processes: Annotated[
        int,
        typer.Option(
            help="Seeds, or trials of a search, at a time on this machine; 0: one per core. A search is "
            "repeatable with 1 only."
        ),
    ] = 0,
    ray: Annotated[str | None, RAY] = None,
    out: Annotated[
        Path | None,
        typer.Option(
            help="Folder of the results; default results/train/CONFIG, of a search results/search/CONFIG."
        ),
    ] = None,
    search: Annotated[
        bool,
        typer.Option(
            "--search", help="Search for better numbers: the ranges of its section `search`."
        ),
    ] = False,
    trials: Annotated[
        int | None,
        typer.Option(
            min=1,
            help="Number of trials of a search, those of earlier calls included.",
            show_default=False,
        ),
    ] = None,
    as_json: Annotated[
        bool, typer.Option("--json", help="Print the evaluations as JSON instead of the table.")
    ] = False,
) -> None:
    """Train one policy per seed. Interrupt it, and call it again to continue to the same result."""
    from baselines.training.config import load_config, with_trials

    if trials is not None and not search:
        raise ValueError("--trials goes with --search")
    if search and (given(ctx, "seeds") or given(ctx, "robot_steps")):
        raise ValueError(
            "--seeds and --robot-steps do not go with --search: its section `search` has its own"
        )
    loaded = load_config(config, robot_steps=robot_steps)
    numbers = whole_numbers("seeds", seeds)
    try:
        from baselines.commands.train import search_command, train_command
    except ModuleNotFoundError as error:
        raise ValueError(f"training needs {error.name} ({install_command('train')})") from error
    if search:
        search_command(
            with_trials(loaded, trials),
            Path(config).stem,
            out=out,
            processes=processes or os.cpu_count() or 1,
            ray=ray,
            as_json=as_json,
        )
        return
    train_command(
        loaded,
        Path(config).stem,
        numbers,
        out=out,
        processes=processes or os.cpu_count() or 1,
        ray=ray,
        as_json=as_json,
    )


@app.command(epilog=examples("tune"))
def tune(
    config: Annotated[
        str,
        typer.Argument(
            help="Search: a preset (see `tlf list searches`) or a YAML file.",
            autocompletion=completed("searches"),
        ),
    ],
    trials: Annotated[
        int | None, typer.Option(help="Number of trials, including those of earlier calls.")
    ] = None,
    workers: Annotated[
        int,
        typer.Option(
            help="Processes on this machine; 0: one per core. Results are reproducible with 1 only."
        ),
    ] = 1,
    ray: Annotated[str | None, RAY] = None,
    out: Annotated[
        Path | None, typer.Option(help="Folder of the results; default results/tune/CONFIG.")
    ] = None,
    as_json: Annotated[
        bool, typer.Option("--json", help="Print the result as JSON instead of the table.")
    ] = False,
) -> None:
    """Search a controller's or a law's numbers. Interrupt it, and call it again to continue."""
    from baselines.commands.compile import compile_before_first_run
    from baselines.runs.provenance import command_line
    from baselines.tables import tune_table
    from baselines.tuning.config import load_tune
    from baselines.tuning.search import RESULT_FILE, run_tune, use_of

    search = load_tune(config, trials=trials)
    folder = out or Path("results") / "tune" / Path(config).stem
    warn_of_scenarios(search.scenarios(search.ekf_slip).items())
    compile_before_first_run()
    with progress_bar("tune") as update:
        result = run_tune(
            search,
            folder,
            workers=workers or os.cpu_count() or 1,
            ray_address=ray,
            command=command_line(sys.argv[1:]),
            progress=update,
        )
    if as_json:
        typer.echo(json.dumps(result, indent=2, allow_nan=False))
        return
    screen.print(tune_table(result["found"]))
    screen.print(f"In {folder}: {RESULT_FILE}; run it with", soft_wrap=True)
    use = use_of(search, folder)
    how = use.replace("reference:", "--gains ", 1) if "+" not in use else f"--policy {use}"
    screen.print(f"tlf run {search.tasks[0]} {how}", soft_wrap=True)


@app.command("paper", epilog=examples("paper"))
def paper(
    figures: Annotated[
        str,
        typer.Option(
            help="fig7ab, fig7c, fig8, slip, ekf, observer, proofs, fig11, robustness and unpublished, "
            "comma-separated; or all. What the folder has of the others stays on its page."
        ),
    ] = "all",
    out: Annotated[Path, typer.Option(help="Folder of the page and the figures.")] = Path(
        "results/paper"
    ),
    as_json: Annotated[
        bool, typer.Option("--json", help="Print paper.json instead of the table.")
    ] = False,
) -> None:
    """Compute the paper's figures and claims anew; write a page with a verdict on each claim."""
    try:
        from baselines.commands.paper import paper_command
    except ModuleNotFoundError as error:
        raise ValueError(f"tlf paper needs {error.name} ({install_command('figures')})") from error
    paper_command(None if figures == "all" else listed(figures), out, as_json=as_json)


@app.command("compile", epilog=examples("compile"))
def compile_(
    everything: Annotated[
        bool,
        typer.Option("--all", help="Also the drivers of scenarios in float64, and of tlf speed."),
    ] = False,
) -> None:
    """Compile the step drivers ahead of the first run, on two cores; nothing is done twice."""
    from baselines.commands.compile import ALL, USUAL, compile_drivers

    compile_drivers(ALL if everything else USUAL)


def main() -> None:
    """Run the command line; invalid input ends in one line on stderr and exit status 2."""
    print_on_any_terminal()
    try:
        status = app(sys.argv[1:] or ["--help"], standalone_mode=False)
    except TyperException as error:
        fail(error.format_message(), error.exit_code)
    except ValueError as error:
        fail(str(error), BAD_INPUT)
    except OSError as error:
        fail(str(error), FAILED)
    except (KeyboardInterrupt, typer.Abort):
        fail(interrupted_message(sys.argv[1:]), INTERRUPTED)
    else:
        if status == INTERRUPTED:  # typer's status after Ctrl-C
            fail(interrupted_message(sys.argv[1:]), INTERRUPTED)


def interrupted_message(words: Sequence[str]) -> str:
    """What is printed after Ctrl-C, with the command that goes on, if that can."""
    if not words or words[0] not in RESUMED:
        return "interrupted"
    return f"interrupted; what is finished is kept, and the same command goes on: tlf {shlex.join(words)}"


def fail(message: str, status: int) -> None:
    """Print a message in one line, and exit."""
    notes.print(f"tlf: {' '.join(message.split())}", soft_wrap=True)
    sys.exit(status)
