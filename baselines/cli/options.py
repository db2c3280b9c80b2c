"""Arguments and options that several commands have, and the texts they are read from."""

from __future__ import annotations

from typing import TYPE_CHECKING

import typer

from baselines.cli.app import completed

if TYPE_CHECKING:
    from tlf_env.common.trust import Trust

DEFAULT_SYSTEM = "reference:linearised"  # written out: `tlf --help` imports nothing of tlf_env


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
    "--trust",
    help="Run code, in processes of its own and with your rights: module:factory (also where a file names "
    "it), SB3 .zip files, programs of entries.",
)


def permission(trust: bool) -> Trust:
    """What ``--trust`` permits: code in processes of its own."""
    from tlf_env.common.trust import ISOLATED

    return ISOLATED if trust else False


REPLAYS = typer.Option(
    min=0,
    help="Pages of replays beside report.html: the worst and the median run of the most telling cells.",
)


THEME = typer.Option(help="Colours of the window: light or dark.")


LIVE_POLICY = typer.Option(
    help="As of tlf run; the keys p and t switch to others while it runs.",
    autocompletion=completed("policies"),
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
        return f"reference:{gains}" if gains else DEFAULT_SYSTEM
    if gains is not None:
        raise ValueError(f"--gains {gains} needs --policy reference, got {policy!r}")
    return policy
