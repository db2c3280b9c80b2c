"""Commands that measure: speed, benchmark, evaluation of a policy, data sets."""

from __future__ import annotations

import json
import os
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from baselines.cli.app import FAILED, completed
from baselines.cli.options import (
    DEFAULT_SYSTEM,
    RAY,
    REPLAYS,
    TRUST,
    permission,
)
from baselines.commands.examples import examples
from baselines.console import (
    given,
    listed,
    notes,
    progress_bar,
    screen,
    warn_of_scenarios,
    whole_numbers,
    writable_folder,
)

if TYPE_CHECKING:
    from tlf_env.common.trust import Trust

commands = typer.Typer()


@commands.command(epilog=examples("speed"))
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
        bool, typer.Option(help="Measure other environments, too, that are installed.")
    ] = True,
    peer_python: Annotated[
        list[str] | None,
        typer.Option(
            metavar="NAME=PYTHON",
            help="The Python of jaxmarl, kheperax or gym-pybullet-drones, if it is not this one; repeatable.",
        ),
    ] = None,
    parts: Annotated[bool, typer.Option(help="Measure the parts of a step.")] = True,
    memory: Annotated[
        bool, typer.Option("--memory", help="Measure the memory of a formation, too: minutes.")
    ] = False,
    cold: Annotated[
        bool,
        typer.Option(
            "--cold", help="Measure starts, too, ours also without compiled drivers: minutes."
        ),
    ] = False,
    training: Annotated[
        bool,
        typer.Option("--training", help="Time a training, too: minutes; needs the extra train."),
    ] = False,
    out: Annotated[Path | None, typer.Option(help="Write the JSON to this file, too.")] = None,
) -> None:
    """Measure steps per second, ours and of other environments; JSON on stdout, a table on stderr."""
    from baselines.commands.compile import compile_before_first_run
    from baselines.speed.footprint import MEMORY_FORMATIONS, START_FORMATIONS
    from baselines.speed.peers import pythons_of
    from baselines.speed.speed import measure
    from baselines.speed.trained import TRAINING
    from baselines.tables import speed_table

    counts = [] if formations == "none" else whole_numbers("formations", formations)
    pythons = pythons_of(peer_python or ())
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
            peer_pythons=pythons,
            memory=MEMORY_FORMATIONS if memory else None,
            start=START_FORMATIONS if cold else None,
            training=TRAINING if training else None,
        )
    text = json.dumps(result, indent=2)
    if out is not None:
        out.write_text(text + "\n", encoding="utf-8")
    notes.print(speed_table(result))
    for line in result["left_out"].values():
        notes.print(line, soft_wrap=True)
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


@commands.command(epilog=examples("bench"))
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
            trust=permission(trust),
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
        trust=permission(trust),
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


@commands.command("eval", epilog=examples("eval"))
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
    ] = DEFAULT_SYSTEM,
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
        trust=permission(trust),
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
    trust: Trust,
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


@commands.command(epilog=examples("export"))
def export(
    tasks: Annotated[str, typer.Argument(help="Tasks, comma-separated (see `tlf list tasks`).")],
    policy: Annotated[
        str, typer.Option(help="As in `tlf run --policy`.", autocompletion=completed("policies"))
    ] = DEFAULT_SYSTEM,
    disturbances: Annotated[
        str, typer.Option(help="Disturbances, comma-separated: presets or FILE.yaml.")
    ] = "nominal",
    seeds: Annotated[str, typer.Option(help="Seeds FIRST:END; END itself is not run.")] = "0:20",
    horizon_s: Annotated[float | None, typer.Option(help="Length of each episode, s.")] = None,
    noise: Annotated[
        float, typer.Option(help="Standard deviation of normal noise on the policy's actions.")
    ] = 0.0,
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
        noise=noise,
        form=form,
        joint=joint,
        name=name,
        out=out,
        trust=permission(trust),
    )
