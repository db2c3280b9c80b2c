"""The command line ``tlf``. Policies, matplotlib and other heavy modules are imported where they are used.

Exit status: 0, also for a run in which robots get lost (that is a result); 1 after an error of the
system; 2 for invalid input, reported in one line; 130 after an interrupt (Ctrl-C, SIGINT), 143 after SIGTERM.
"""

from __future__ import annotations

import errno
import shlex
import sys
from collections.abc import Sequence

import typer
from typer.exceptions import TyperException

from baselines.cli import driving, learning, looking, measuring, paper
from baselines.cli.app import BAD_INPUT, FAILED, app, completed
from baselines.cli.measuring import PLAN_OPTIONS
from baselines.console import notes, print_on_any_terminal
from baselines.runs.stopping import (
    INTERRUPTED,
    TERMINATED,
    interruptible,
    no_other_error,
    stopped_status,
)

__all__ = [
    "BAD_INPUT",
    "FAILED",
    "INTERRUPTED",
    "PLAN_OPTIONS",
    "TERMINATED",
    "app",
    "completed",
    "main",
]

for part in (looking, driving, measuring, learning, paper):
    app.add_typer(part.commands)

RESUMED = ("bench", "eval", "train", "tune")  # commands that go on where they were interrupted


def main() -> None:
    """Run the command line; invalid input ends in one line on stderr and exit status 2."""
    print_on_any_terminal()
    with interruptible():
        try:
            with no_other_error():
                status = app(sys.argv[1:] or ["--help"], standalone_mode=False)
        except TyperException as error:
            fail(error.format_message(), error.exit_code)
        except ValueError as error:
            fail(str(error), BAD_INPUT)
        except OSError as error:
            fail(f"{error}{after_a_full_disk(error, sys.argv[1:])}", FAILED)
        except (KeyboardInterrupt, typer.Abort):
            fail(interrupted_message(sys.argv[1:]), stopped_status())
        else:
            if status == INTERRUPTED:  # typer's status after Ctrl-C
                fail(interrupted_message(sys.argv[1:]), stopped_status())


def interrupted_message(words: Sequence[str]) -> str:
    """What is printed after Ctrl-C or SIGTERM, with the command that goes on, if that can."""
    return f"interrupted{going_on(words)}"


def after_a_full_disk(error: OSError, words: Sequence[str]) -> str:
    """The command that goes on once there is room, if the disk was full and the command can."""
    return going_on(words) if error.errno in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG) else ""


def going_on(words: Sequence[str]) -> str:
    """How to go on with a command; nothing for one that begins anew."""
    if not words or words[0] not in RESUMED:
        return ""
    return f"; what is finished is kept, and the same command goes on: tlf {shlex.join(words)}"


def fail(message: str, status: int) -> None:
    """Print a message in one line, and exit."""
    notes.print(f"tlf: {' '.join(message.split())}", soft_wrap=True)
    sys.exit(status)
