"""Commands that drive a formation: runs and their comparison, the live windows, paths, open-loop torques."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated, Any

import typer

from baselines.cli.app import completed
from baselines.cli.options import (
    DISTURBANCE,
    LEVEL,
    LIVE_POLICY,
    SCENARIO,
    SETTINGS,
    THEME,
    TRUST,
    VIDEO,
    VIDEO_FPS,
    VIDEO_SPEED,
    named_policy,
    permission,
    start_poses,
)
from baselines.commands.examples import examples
from baselines.console import (
    progress_bar,
    screen,
    writable_folder,
)
from baselines.runs.stopping import stopped_status

commands = typer.Typer()


@commands.command(epilog=examples("run"))
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
            "entry:FOLDER (a competition's entry); with --trust module:factory and FILE.zip.",
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
            "with --trust module:factory."
        ),
    ] = None,
    wheel_loop: Annotated[
        str | None, typer.Option(help="Own wheel loop, module:factory (with --trust).")
    ] = None,
    observer: Annotated[
        str | None, typer.Option(help="Own observer, module:factory (with --trust).")
    ] = None,
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
        trust=permission(trust),
    )
    if not finished:
        raise SystemExit(stopped_status())


@commands.command(epilog=examples("compare"))
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


@commands.command(epilog=examples("view"))
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
        trust=permission(trust),
    )


@commands.command(epilog=examples("play"))
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
        trust=permission(trust),
    )


@commands.command("path", epilog=examples("path"))
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


@commands.command(epilog=examples("openloop"))
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
