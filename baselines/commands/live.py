"""``tlf view`` and ``tlf play``: an episode in a window, and a leader that is driven by hand."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from baselines.commands.catalogue import POLICY_FORMS, catalogue
from baselines.commands.compile import compile_before_first_run
from baselines.commands.path import write_path
from baselines.console import notes, screen, writable_folder
from baselines.live.drive import DriveSession
from baselines.live.play import PlayWindow
from baselines.live.session import Session
from baselines.live.window import LiveWindow
from tlf_env.common.trust import Trust
from tlf_env.task.scenario import Scenario


def view_command(
    chosen: Scenario,
    policy: str,
    seed: int,
    options: Mapping[str, Any],
    *,
    theme: str,
    trust: Trust,
) -> None:
    """Show an episode in a window until it is closed.

    Raises
    ------
    ValueError
        in one line, for whatever does not fit, and without a display.
    """
    compile_before_first_run()
    session = Session(chosen, policy, seed, options=options, trust=trust)
    _say_what_is_asked(session)
    policies, disturbances = menus()
    LiveWindow(session, policies=policies, disturbances=disturbances, theme=theme).run()


def play_command(
    chosen: Scenario,
    policy: str,
    seed: int,
    out: Path,
    *,
    horizon_s: float,
    theme: str,
    trust: Trust,
) -> None:
    """Let a leader be driven by hand in a window, and write its path when that is closed.

    Raises
    ------
    ValueError
        in one line, for whatever does not fit, and without a display.
    """
    if out.suffix.lower() != ".csv":
        raise ValueError(f"--out {out} must end in .csv")
    writable_folder(out.parent)
    compile_before_first_run()
    session = DriveSession(chosen, policy, seed, trust=trust, horizon_s=horizon_s)
    _say_what_is_asked(session)
    policies, disturbances = menus()
    try:
        PlayWindow(session, policies=policies, disturbances=disturbances, theme=theme).run()
    finally:
        times, points = session.path()
        if len(times):
            write_path(out, times, points)
    if not len(times):
        notes.print("tlf: the leader was not driven; no path is written", soft_wrap=True)
        return
    screen.print(f"{out}: a path of {times[-1]:.1f} s; run it with", soft_wrap=True)
    screen.print(f"tlf run {out}", soft_wrap=True)


def menus() -> tuple[dict[str, str], dict[str, str]]:
    """The policies and disturbances that a window can switch to, each with a line."""
    policies = catalogue("policies")["policies"]
    named = {name: line for name, line in policies.items() if name not in POLICY_FORMS}
    return named, catalogue("disturbances")["disturbances"]


def _say_what_is_asked(session: Session) -> None:
    if session.asks_for:
        notes.print(
            f"tlf: note: {session.policy} asks for {', '.join(session.asks_for)}", soft_wrap=True
        )
