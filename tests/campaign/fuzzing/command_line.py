"""Words of the command line."""

from __future__ import annotations

import contextlib
import functools
import importlib
import io
import itertools
import json
import os
import shlex
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import typer
from campaign.fuzzing.cases import number, places, word
from campaign.fuzzing.checks import MOST_LINE, REFUSED, refused, working_folder
from campaign.fuzzing.files import LOGS, TORQUES
from campaign.fuzzing.registry import ViolationError, target
from campaign.fuzzing.scenarios import SHORT, described, plain
from hypothesis import strategies as st

from baselines import cli, console


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


# Of each command: positional words, and options. Values are in VALUES, or hostile.
WORDS: dict[str, list[str]] = {
    "show": ["infinity", "--disturbance", "--level", "--set", "--changes"],
    "list": ["tasks", "policies", "--json"],
    "run": [
        "infinity", "--disturbance", "--level", "--set", "--policy", "--gains", "--estimator", "--wheel-loop",
        "--observer", "--seed", "--robots", "--plant", "--control-period-s", "--horizon-s", "--phase-s",
        "--poses", "--out", "--overwrite", "--video", "--video-fps", "--video-speed", "--mat", "--parquet",
        "--json",
    ],
    "path": ["log.csv", "--out", "--columns", "--units", "--smooth", "--speed-limit", "--figures"],
    "openloop": ["open.json", "--out", "--dt-s", "--plant", "--json"],
    "compare": ["a", "b", "--out", "--video", "--video-fps", "--video-speed"],
    "bench": [
        "--policies", "--tasks", "--disturbances", "--also", "--seeds", "--level", "--sweep", "--knobs",
        "--envelope", "--resolution", "--plan", "--plant", "--processes", "--horizon-s", "--entry", "--check",
        "--test", "--test-seed", "--replays", "--out", "--json",
    ],
    "eval": [
        "residual", "--against", "--disturbances", "--tasks", "--seeds", "--horizon-s", "--plant",
        "--processes", "--replays", "--out", "--json",
    ],
    "export": [
        "infinity", "--policy", "--disturbances", "--seeds", "--horizon-s", "--noise", "--form", "--name",
        "--joint", "--out",
    ],
    "train": ["quick", "--seeds", "--robot-steps", "--processes", "--search", "--trials", "--out", "--json"],
    "tune": ["adrc", "--trials", "--workers", "--out", "--json"],
    "speed": ["--formations", "--steps", "--repeats", "--threads", "--peer-python", "--out"],
    "demo": ["--seed", "--out"],
    "compile": ["--all"],
    "paper": ["--figures", "--out", "--json"],
    "view": [
        "infinity", "--disturbance", "--level", "--set", "--theme", "--policy", "--seed", "--robots",
        "--horizon-s", "--phase-s",
    ],
    "play": ["infinity", "--disturbance", "--set", "--policy", "--robots", "--horizon-s", "--out", "--theme"],
    "nothing": [],
}  # fmt: skip
FLAGS = (
    "--changes", "--json", "--mat", "--parquet", "--overwrite", "--envelope", "--test", "--joint", "--search",
    "--all", "--help",
)  # fmt: skip
VALUES: dict[str, list[str]] = {
    "--against": ["reference", "pure_pursuit"],
    "--also": ["circle:ice", "infinity:nominal"],
    "--check": ["infinity:slip", "circle:nominal"],
    "--columns": ["t_s,x_mm,y_mm", "1,2,3"],
    "--control-period-s": ["0.02", "0.01"],
    "--disturbance": ["slip", "ice", "none", "noise", "own.yaml"],
    "--disturbances": ["nominal", "slip,ice", "all"],
    "--dt-s": ["0.001", "0.01"],
    "--entry": ["entry", "."],
    "--estimator": ["ekf", "truth", "ekf-slip"],
    "--form": ["parquet", "minari"],
    "--formations": ["1", "2,4"],
    "--gains": ["tuned", "consistent", "printed"],
    "--horizon-s": ["0.1", "0.4", "3"],
    "--knobs": ["friction", "payload"],
    "--level": ["0", "0.5", "1"],
    "--name": ["data", "a-b"],
    "--noise": ["0", "0.3"],
    "--observer": ["m:f"],
    "--out": ["out", "out/deep", "log.csv", "out.csv", "/dev/null", "/dev/null/x", "."],
    "--peer-python": ["jaxmarl=python", "kheperax=/dev/null"],
    "--phase-s": ["0", "5.5", "-3"],
    "--plan": ["board", "own.yaml"],
    "--plant": ["batch", "pymunk", "kinematic", "chipmunk", "kernel"],
    "--policies": ["reference", "residual,pure_pursuit", "from-nothing"],
    "--policy": ["reference", "residual", "pure_pursuit", "adrc:searched", "own.safetensors"],
    "--poses": ["0,0,0", "2500,2500,0;2100,2500,0;1700,2500,0"],
    "--repeats": ["1", "2"],
    "--replays": ["0", "1"],
    "--resolution": ["1.1", "2"],
    "--robot-steps": ["40", "1"],
    "--robots": ["1", "2", "4"],
    "--seed": ["0", "7"],
    "--seeds": ["0:1", "20000:20002", "0,1"],
    "--set": ["time_gap_s=0.2", "robots=2", "world=corridor", "disturbance.slip.delta_1_mm_s=20"],
    "--smooth": ["0", "5"],
    "--speed-limit": ["400", "1"],
    "--steps": ["1", "3"],
    "--sweep": ["level=0:1:2", "time_gap_s=1,2"],
    "--tasks": ["infinity", "circle,flower"],
    "--test-seed": ["a", "own"],
    "--theme": ["light", "dark"],
    "--threads": ["1", "2"],
    "--trials": ["1", "2"],
    "--units": ["m", "cm", "mm"],
    "--video": ["a.mp4", "a.gif"],
    "--video-fps": ["5", "25"],
    "--video-speed": ["1", "8"],
    "--wheel-loop": ["m:f"],
}
# Before the words of a case, which have the last say: a valid command is small, and starts no other process.
LIMITS: dict[str, list[str]] = {
    "run": ["--horizon-s", "0.3", "--no-figures"],
    "path": ["--no-figures"],
    "bench": [
        "--seeds", "20000:20002", "--horizon-s", "0.3", "--processes", "1", "--replays", "0", "--no-figures",
    ],
    "eval": [
        "--seeds", "20000:20002", "--horizon-s", "0.3", "--processes", "1", "--replays", "0", "--no-figures",
    ],
    "export": ["--seeds", "0:1", "--horizon-s", "0.3"],
    "train": ["--robot-steps", "40", "--processes", "1"],
    "tune": ["--trials", "1"],
    "speed": [
        "--formations", "1", "--threads", "1", "--steps", "1", "--repeats", "1", "--no-peers", "--no-parts",
    ],
    "demo": ["--no-figures"],
    "view": ["--horizon-s", "0.3"],
    "play": ["--horizon-s", "0.3"],
}  # fmt: skip
WORKERS = (
    "--processes",
    "--workers",
)  # a batch's process may start no other one: hostile values only
IMPORTED = (
    "arch.bootstrap", "control", "imageio_ffmpeg", "matplotlib.pyplot", "optuna", "PIL.Image",
    "pyarrow.parquet", "pygame", "scipy.io", "scipy.signal", "scipy.stats", "sqlalchemy",
    *(f"baselines.commands.{name}" for name in (
        "bench", "catalogue", "check", "compare", "compile", "demo", "envelope", "eval", "export", "live",
        "paper", "path", "run", "scenarios", "train",
    )),
    "baselines.benchmark.check", "baselines.live.play", "baselines.pages.replay", "baselines.paper.report",
    "baselines.runs.figures", "baselines.runs.video", "baselines.speed.speed", "baselines.tuning.search",
)  # fmt: skip
CUT_S = 0.12  # a command that still runs gets a SIGINT: Ctrl-C
WRONG = st.sampled_from(
    [
        *("nan", "inf", "-1", "", "x", "1e999", "a:b", "../..", "[", "0.5", "1,,2", "=", "é", "-", "--"),
        *("--no-such", "10:5", "1e-320", "99999999999999999999", "--help", "infinity", "\ud800"),
    ]
)  # fmt: skip


@st.composite
def command_lines(draw: Any) -> list[str]:
    """A command, most of its positional words, and some options with values that are valid or hostile."""
    name = draw(st.sampled_from(list(WORDS)))
    options = [one for one in WORDS[name] if one.startswith("--")]
    positional = [one for one in WORDS[name] if not one.startswith("--")]
    words = [name, *positional[: draw(st.sampled_from((len(positional), 9, 0)))]]
    for _ in range(draw(st.integers(0, 4))):
        if not options or draw(st.integers(0, 11)) == 0:
            words.append(draw(st.one_of(WRONG, word)))
            continue
        option = draw(st.sampled_from(options))
        words.append(option)
        if option not in FLAGS:
            usual = VALUES.get(option)
            hostile = usual is None or draw(st.integers(0, 2)) == 0
            words.append(draw(st.one_of(WRONG, word) if hostile else st.sampled_from(usual)))
    return words


@target(command_lines(), share=10.0)
def commands(case: list[str]) -> None:
    """Words of the command line: a status, and one line for what is wrong."""
    if any("\x00" in one for one in case):
        return  # no shell can give it
    if any(a in WORKERS and _is_count(b) for a, b in itertools.pairwise(case)):
        return
    if set(case) <= {"compile", "--all"}:
        return  # it starts processes
    warm()
    ran([case[0], *LIMITS.get(case[0], []), *case[1:]])


def _is_count(text: str) -> bool:
    with contextlib.suppress(ValueError):
        return int(text) != 1
    return False


@functools.cache
def warm() -> None:
    """Import what commands import, as a module whose import is interrupted is of no use any more.

    The parser is made once: that takes longer than most refusals.
    """
    typer.main.get_command = functools.cache(typer.main.get_command)
    for name in IMPORTED:
        with contextlib.suppress(ImportError):
            importlib.import_module(name)
    started(["run", "circle", "--horizon-s", "0.1", "--no-figures"], 60.0)


class Outcome(NamedTuple):
    """How a command has ended."""

    status: Any
    out: str
    err: str
    left: list[str]  # hidden files in its folder


def with_files(folder: Path) -> None:
    """Write the files that the words of a case name."""
    (folder / "log.csv").write_bytes(LOGS[0])
    (folder / "open.json").write_text(json.dumps(TORQUES[0]))
    (folder / "own.yaml").write_text("slip: {delta_1_mm_s: 20.0}\n")


def started(words: list[str], cut_s: float = CUT_S) -> Outcome:
    """Run a command in this process, in a folder of its own; a SIGINT after so many seconds."""
    out, err = io.StringIO(), io.StringIO()
    arguments, status = sys.argv, None
    streams = ((console.notes, err), (console.screen, out))
    with working_folder() as folder, _environment():
        with_files(folder)
        sys.argv = ["tlf", *words]
        try:
            with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
                for stream, text in streams:
                    stream.file = text
                with _interrupted_after(cut_s):
                    cli.main()
        except SystemExit as ended:
            status = ended.code
        except KeyboardInterrupt:  # it came after the command had ended
            status = 130
            err.write("tlf: interrupted\n")
        finally:
            sys.argv = arguments
            for stream, _ in streams:
                stream.file = None
        left = [path.name for path in folder.rglob(".*")]
    return Outcome(status or 0, out.getvalue(), err.getvalue(), left)


@contextlib.contextmanager
def _environment() -> Iterator[None]:
    """Lines that are not broken, and a window that is not seen."""
    given = {"COLUMNS": "500", "SDL_VIDEODRIVER": "dummy", "SDL_AUDIODRIVER": "dummy"}
    before = {name: os.environ.get(name) for name in given}
    os.environ.update(given)
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


@contextlib.contextmanager
def _interrupted_after(seconds: float) -> Iterator[None]:
    """Raise a SIGINT after some seconds; then an alarm that was set before goes on."""
    alarm, interrupt = signal.getsignal(signal.SIGALRM), signal.getsignal(signal.SIGINT)
    running = True

    def cut(*_: Any) -> None:
        signal.signal(signal.SIGALRM, alarm)
        signal.setitimer(signal.ITIMER_REAL, left_s)
        if running:
            signal.raise_signal(signal.SIGINT)

    # A shell lets its background commands ignore SIGINT, and a campaign passes this on.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    signal.signal(signal.SIGALRM, cut)
    left_s, _ = signal.setitimer(signal.ITIMER_REAL, seconds)
    try:
        yield
    finally:
        running = False
        signal.signal(signal.SIGALRM, alarm)
        signal.setitimer(signal.ITIMER_REAL, left_s)
        signal.signal(signal.SIGINT, interrupt)


def ran(words: list[str]) -> None:
    """Run a command, and check how it ends; what is wrong counts if a process of its own shows it, too.

    An interrupt in the midst of compiling leaves this process as no process of a command goes on.
    """
    try:
        checked(words, started(words))
    except Exception as error:
        try:
            checked(words, in_process(words))
        except ViolationError as confirmed:
            raise confirmed from error


def in_process(words: list[str]) -> Outcome:
    """Run a command in a process of its own, which is interrupted after some seconds.

    Raises
    ------
    ViolationError
        if it does not stop then.
    """
    with working_folder() as folder, _environment():
        with_files(folder)
        process = subprocess.Popen(
            [sys.executable, "-m", "baselines", *words],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            encoding="utf-8",
            errors="replace",
            preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
        )
        try:
            out, err = process.communicate(timeout=5)
        except subprocess.TimeoutExpired:
            process.send_signal(signal.SIGINT)
            try:
                out, err = process.communicate(timeout=20)
            except subprocess.TimeoutExpired as late:
                raise ViolationError("it does not stop", shlex.join(words)) from late
        finally:
            process.kill()
        left = [path.name for path in folder.rglob(".*")]
    return Outcome(process.returncode, out, err, left)


def checked(words: list[str], found: Outcome) -> None:
    """Check how a command has ended."""
    line = shlex.join(words)
    if found.status == -signal.SIGINT and "Traceback" not in found.err:
        found = found._replace(status=0)  # the interrupt came while Python ended, after the command
    if found.status not in (0, 1, 2, 130):
        raise ViolationError(f"status {found.status!r}", f"{line}: {found.err[-300:]!r}")
    if "Traceback" in found.err:
        raise ViolationError("a traceback on the command line", f"{line}: {found.err[-300:]}")
    if found.status:
        said = found.err.splitlines()[-1:]
        if not said or not said[0].startswith("tlf: ") or not said[0][5:].strip():
            raise ViolationError(
                f"status {found.status} without a last line that says why",
                f"{line}: {found.err[-300:]!r}",
            )
        if len(said[0]) > MOST_LINE + 2 * len(
            line
        ):  # the parser repeats words that it does not know
            raise ViolationError("a line that is too long", f"{line}: {said[0][:300]}")
    if not Path(os.devnull).is_char_device():
        raise ViolationError(f"{os.devnull} is no device any more", line)
    if found.left:
        raise ViolationError("hidden files are left", f"{line}: {found.left}")
    if not found.status and words[-1] == "--json" and "--help" not in words:
        try:
            json.loads(found.out)
        except ValueError as error:
            raise ViolationError("what --json prints is no JSON", f"{line}: {error}") from error
