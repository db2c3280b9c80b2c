"""Words of the command line."""

from __future__ import annotations

import contextlib
import io
import json
import os
import shlex
import sys
from typing import Any

from campaign.fuzzing.cases import number, places, word
from campaign.fuzzing.checks import REFUSED, refused, working_folder
from campaign.fuzzing.files import LOGS, TORQUES
from campaign.fuzzing.registry import ViolationError, target
from campaign.fuzzing.scenarios import SHORT, described, plain
from hypothesis import strategies as st

from baselines import cli


@target(
    st.lists(
        st.one_of(
            st.tuples(
                st.sampled_from([".".join(map(str, path)) for path in places(plain({})) if path]),
                st.one_of(word, number.map(str)),
            ).map("=".join),
            word,
        ),
        min_size=1,
        max_size=2,
    ),
    share=2.0,
)
def settings(case: Any) -> None:
    """Texts of ``--set``."""
    from baselines.commands.scenarios import asked_scenario

    with working_folder():
        found = refused(lambda: asked_scenario("infinity", SHORT, None, case))
    if found is not REFUSED:
        described(found)


WORDS: dict[str, list[str]] = {
    "show": ["infinity", "--disturbance", "--level", "--set", "--changes"],
    "list": ["tasks", "policies", "--json"],
    "run": [
        "infinity", "--disturbance", "--level", "--set", "--policy", "--gains", "--estimator", "--wheel-loop",
        "--observer", "--seed", "--robots", "--plant", "--control-period-s", "--horizon-s", "--phase-s",
        "--poses", "--out", "--video", "--video-fps", "--video-speed", "--mat", "--parquet", "--json",
    ],
    "path": ["log.csv", "--out", "--columns", "--units", "--smooth", "--speed-limit"],
    "openloop": ["open.json", "--out", "--dt-s", "--plant", "--json"],
    "compare": ["a", "b", "--out", "--video", "--video-fps"],
    "bench": [
        "--policies", "--tasks", "--disturbances", "--also", "--seeds", "--level", "--sweep", "--knobs",
        "--plan", "--plant", "--processes", "--horizon-s", "--entry", "--check", "--test-seed", "--replays",
    ],
    "eval": ["residual", "--against", "--disturbances", "--tasks", "--seeds", "--horizon-s"],
    "export": ["infinity", "--policy", "--seeds", "--horizon-s", "--noise", "--form", "--name", "--joint"],
    "train": ["quick", "--seeds", "--robot-steps", "--processes", "--search", "--trials"],
    "tune": ["adrc", "--trials", "--workers"],
    "speed": ["--formations", "--steps", "--threads"],
    "demo": ["--seed", "--out"],
    "compile": ["--all"],
    "paper": ["--figures"],
    "view": ["infinity", "--theme", "--policy"],
    "play": ["infinity", "--horizon-s", "--out"],
    "nothing": [],
}  # fmt: skip

# One hostile word at least: what is left over is a valid command, which would run for long.
WRONG = st.sampled_from(
    [
        "nan",
        "inf",
        "-1",
        "",
        "x",
        "1e999",
        "a:b",
        "\x00",
        "../..",
        "[",
        "0",
        "1,,2",
        "=",
        "é",
        "-",
        "--",
        "--no-such",
        "10:5",
    ]
)


@st.composite
def command_lines(draw: Any) -> list[str]:
    name = draw(st.sampled_from(list(WORDS)))
    words = [name]
    positional = [one for one in WORDS[name] if not one.startswith("--")]
    words += positional[: draw(st.integers(0, 2))]
    for _ in range(draw(st.integers(1, 3))):
        options = [one for one in WORDS[name] if one.startswith("--")]
        if options:
            words.append(draw(st.sampled_from(options)))
        words.append(draw(st.one_of(WRONG, word)))
    return words


SLOW = ("paper", "compile", "demo", "speed", "train", "tune", "bench", "eval")


@target(command_lines(), share=0.7)
def commands(case: list[str]) -> None:
    """Words of the command line: a status, and one line for what is wrong."""
    if any("\x00" in one for one in case):
        return  # no shell can give it
    if (
        case[0] in SLOW
    ):  # what is left of a wrong command may run for long: only its check is of interest
        case = [*case, "--out", "/dev/null/none"]
    ran(["tlf", *case], case)


def ran(words: list[str], case: list[str]) -> None:
    out, err = io.StringIO(), io.StringIO()
    before = sys.argv
    status: Any = 0
    with working_folder() as folder:
        (folder / "log.csv").write_bytes(LOGS[0])
        (folder / "open.json").write_text(json.dumps(TORQUES[0]))
        sys.argv = words
        os.environ["COLUMNS"] = "500"
        try:
            with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
                import baselines.console as console

                for one in (console.notes, console.screen):
                    one.file = err if one is console.notes else out
                cli.main()
        except SystemExit as left:
            status = left.code
        finally:
            sys.argv = before
            for one in (console.notes, console.screen):
                one.file = None
    said = err.getvalue()
    if status not in (None, 0, 1, 2, 130):
        raise ViolationError(f"status {status!r}", shlex.join(case))
    if "Traceback" in said:
        raise ViolationError("a traceback on the command line", said[-300:])
    if status in (1, 2):
        lines = [one for one in said.splitlines() if one.startswith("tlf: ")]
        if not lines:
            raise ViolationError(f"status {status} without a line that says why", said[-300:])
