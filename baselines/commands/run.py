"""``tlf run``: one run, from its scenario to its folder."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import typer

from baselines.commands.compile import compile_before_first_run
from baselines.console import (
    notes,
    progress_bar,
    screen,
    warn_of_missing,
    warn_of_scenarios,
    writable_folder,
)
from baselines.pages.replay import write_replay
from baselines.pages.runs import write_index
from baselines.policies.learned import shipped_policies
from baselines.policies.registry import (
    FittedPolicy,
    describe_overrides,
    fit_policy,
    policy_hash,
    policy_names,
)
from baselines.policies.systems import parse_system
from baselines.runs.files import (
    summary,
    write_mat,
    write_parquet,
    write_record,
    write_summary,
)
from baselines.runs.folders import (
    REPLAY,
    Identity,
    check_room,
    folder_name,
    identity_of,
    is_preset,
    replaced,
)
from baselines.runs.jobs import alone_in
from baselines.runs.run import Record, run_policy
from baselines.runs.video import FPS, Film, check_video, write_video
from baselines.tables import metrics_table
from tlf_env.common.presets import preset_names
from tlf_env.common.trust import Trust
from tlf_env.numerics.philox import checked_seed
from tlf_env.onboard.parts import check_trust
from tlf_env.task.scenario import Scenario, load_scenario, scenario_notes
from tlf_env.task.start import start_options

RESULTS = Path("results")


class Wanted(NamedTuple):
    """What a run writes and prints."""

    out: Path | None = None  # None: a folder of its own below `results`
    overwrite: bool = False
    figures: bool = True
    mat: bool = False
    parquet: bool = False
    as_json: bool = False
    video: Path | None = None
    video_fps: float = FPS
    video_speed: float = 1.0


def run_command(
    chosen: Scenario,
    name: str,
    seed: int,
    options: Mapping[str, Any],
    wanted: Wanted,
    *,
    trust: Trust,
) -> bool:
    """Run a policy in a scenario, write its folder and print its table; whether it was not interrupted.

    Raises
    ------
    ValueError
        for whatever does not fit, before the run.
    """
    checked_seed(seed)
    start_options(options, chosen.robot_count)
    film = asked_film(wanted)
    fitted = fit_policy(name, chosen, trust=trust)
    check_trust(fitted.scenario.code, trust)
    if fitted.overrides:
        fields = ", ".join(describe_overrides(fitted.overrides))
        notes.print(f"tlf: note: {name} asks for {fields}", soft_wrap=True)
    scenario = fitted.scenario
    warn_of_scenarios([(scenario.name, scenario)])
    if not _shipped_path(chosen):  # the paper's own trajectories start at speed, too
        for line in scenario_notes(scenario):
            notes.print(f"tlf: note: {line}", soft_wrap=True)
    identity = identity_for(name, fitted, seed, options)
    folder = wanted.out
    if folder is None:
        folder = RESULTS / folder_name(scenario, identity, _usual(chosen, name, seed, trust))
    writable_folder(folder)
    with alone_in(folder):
        whole = check_room(folder, identity, wanted.overwrite)
        compile_before_first_run()
        with progress_bar(f"{scenario.name}, {name}") as update:
            record = run_policy(
                scenario,
                fitted.policy,
                seed,
                name=name,
                options=options,
                progress=update,
                watch=film,
                keep_interrupted=True,
                trust=trust,
            )
        if record.interrupted and whole:
            notes.print(
                f"tlf: interrupted after {record.t_s[-1]:.6g} s of {scenario.horizon_s:g} s; {folder} keeps "
                "the whole run that it holds. The same command runs it from the start.",
                soft_wrap=True,
            )
            return False
        written = write_run(record, folder, identity, wanted)
    if wanted.out is None:
        with alone_in(RESULTS, wait=True):
            write_index(RESULTS)
    if film is not None and wanted.video is not None:
        with progress_bar("video") as update:
            write_video([film], wanted.video, progress=update)
    if wanted.as_json:
        typer.echo(json.dumps(summary(record), indent=2, allow_nan=False))
    else:
        screen.print(metrics_table(record))
        screen.print(f"In {folder}: {', '.join(path.name for path in written)}", soft_wrap=True)
        if wanted.video is not None:
            screen.print(f"Video: {wanted.video}", soft_wrap=True)
    if record.interrupted:
        notes.print(
            f"tlf: interrupted after {record.t_s[-1]:.6g} s of {scenario.horizon_s:g} s; what was simulated is "
            "in the folder. The same command runs it from the start.",
            soft_wrap=True,
        )
    return not record.interrupted


def asked_film(wanted: Wanted) -> Film | None:
    """What keeps the scenes for the video that is asked for, if any.

    Raises
    ------
    ValueError
        for a video that cannot be written, and for ``video_fps`` and ``video_speed`` out of their range.
    """
    if wanted.video is None:
        return None
    check_video(wanted.video)
    writable_folder(wanted.video.parent)
    return Film(wanted.video_fps, wanted.video_speed)


def write_run(record: Record, folder: Path, identity: Identity, wanted: Wanted) -> list[Path]:
    """Write all files of a run, in place of those of an earlier one in the folder."""
    with replaced(folder) as place:
        written = write_record(record, place)
        if wanted.mat:
            written.append(write_mat(record, place))
        if wanted.parquet:
            written.append(write_parquet(record, place))
        written.append(write_replay(record, place / REPLAY))
        if wanted.figures:
            written += draw(record, place)
        written.insert(0, write_summary(record, place, identity, written))
    return [folder / path.name for path in written]


def draw(record: Record, folder: Path) -> list[Path]:
    """The figures of a run; none, and a note, if matplotlib is missing."""
    try:
        from baselines.runs.figures import write_figures
    except ModuleNotFoundError as error:
        warn_of_missing(error)
        return []
    return write_figures(record, folder)


def identity_for(
    name: str, fitted: FittedPolicy, seed: int, options: Mapping[str, Any] | None
) -> Identity:
    """The identity of a run with a policy of this name."""
    digits = policy_hash(name, fitted.policy)
    return identity_of(fitted.scenario, name, digits, seed, options)


def _shipped_path(chosen: Scenario) -> bool:
    """Whether the leader's path is that of the preset of the same name."""
    return (
        chosen.name in preset_names() and chosen.trajectory == load_scenario(chosen.name).trajectory
    )


def _usual(chosen: Scenario, name: str, seed: int, trust: Trust) -> Identity | None:
    """The identity of the run that the names alone describe; None if they do not."""
    named = name in (*policy_names(), *shipped_policies()) or parse_system(name) is not None
    if not is_preset(chosen) or not named:
        return None
    usual = load_scenario(chosen.name, disturbance=chosen.disturbance.name)
    return identity_for(name, fit_policy(name, usual, trust=trust), seed, {})
