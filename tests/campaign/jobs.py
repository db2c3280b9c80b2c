"""Small jobs of the long commands, what each has finished so far, and what must come out byte for byte.

A job runs in a folder of its own, always with the same words and the same relative folder of results. So an
uninterrupted run and one that was killed and resumed can be compared byte for byte. What may differ: times of
day and durations (the fields of :data:`TIMES`, Optuna's dates), and files of TensorBoard, one for each start.
"""

from __future__ import annotations

import json
import os
import re
import signal
import sqlite3
import subprocess
import sys
import time
import traceback
import zipfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import yaml
from safetensors import safe_open

OUT = "out"
CHECKPOINT, STUDY, LINES, SUMMARY = (
    "checkpoint.safetensors",
    "study.db",
    "runs.jsonl",
    "summary.json",
)
TIMES = ("wall_time_s", "processor_time_s", "evaluated_at_s")
TENSORBOARD = "events.out.tfevents"
# Of git: a commit during a campaign is no difference, nor that a clock that jumps ends git before it answers.
REVISION = re.compile(
    rb'<tr><th scope="row">revision</th>.*\n|"?git_revision"?: ("?[0-9a-f]{40}\+?"?|null)|[0-9a-f]{40}\+?'
)

TRAINING = {
    "algorithm": "PPO",
    "robot_steps": 1200,
    "formations": 4,
    "scenario": {
        "action": "residual",
        "residual_base": "tuned",
        "estimator": "ekf-slip",
        "horizon_s": 2.0,
        "time_gap_s": 1.0,
        "preview_s": [0.5],
    },
    "tasks": {"infinity": {}},
    "disturbances": {"nominal": 1, "slip": 2},
    "network": {"hidden": [16]},
    "settings": {"n_steps": 10, "batch_size": 40, "n_epochs": 2, "learning_rate": 0.01},
    "checkpoint_every": 240,
    "evaluation": {
        "every": 360,
        "seeds": [10_000, 10_002],
        "disturbances": ["slip"],
        "horizon_s": 2.0,
    },
}
SEARCH = {
    "start": "tuned",
    "search": {
        "gains.k_1_per_s": {"low": 0.2, "high": 4, "log": True},
        "gains.k_3_mm2": {"low": 1e4, "high": 2e5, "log": True},
    },
    "tasks": ["infinity"],
    "disturbances": ["nominal", "noise"],
    "seeds": {"first": 0, "count": 2},
    "choose": {"first": 10_000, "count": 2, "finalists": 2},
    "horizon_s": 2,
    "trials": 12,
    "startup_trials": 3,
    "objective": {"settled_formation_rmse_mm": 0},
}


class Job(NamedTuple):
    """A command, and what its folder holds."""

    words: tuple[str, ...]
    finished: Callable[[Path], dict[str, Any]]  # pieces that no later kill may lose or change
    result: Callable[[Path], dict[str, Any]]  # what must be the same as without a kill
    files: dict[str, dict[str, Any]] = {}  # YAML files beside the folder of the results
    imports: tuple[str, ...] = ()  # modules that a process loads before it forks


def _bench_lines(folder: Path) -> dict[str, Any]:
    path = folder / LINES
    whole = path.read_bytes() if path.exists() else b""
    lines = whole[: whole.rfind(b"\n") + 1].splitlines()
    return {line.decode(): True for line in lines}


def _bench_result(folder: Path) -> dict[str, Any]:
    found = {name: content for name, content in _contents(folder).items() if name != LINES}
    return found | {LINES: sorted((folder / LINES).read_bytes().splitlines())}


def _train_finished(folder: Path) -> dict[str, Any]:
    """Robot steps of each seed's checkpoint: compared as numbers that only grow."""
    found: dict[str, Any] = {}
    for path in sorted(folder.glob(f"*/{CHECKPOINT}")):
        with safe_open(path, "np") as file:
            found[path.parent.name] = json.loads(file.metadata()["state"])["steps"]
    return found


def _train_result(folder: Path) -> dict[str, Any]:
    found: dict[str, Any] = {}
    for name, content in _contents(folder).items():
        if name.endswith("evaluations.jsonl"):  # a line after the last checkpoint comes twice
            lines = [json.loads(line) for line in content.splitlines()]
            found[name] = {line["robot_steps"]: line for line in lines}
        elif name.endswith(CHECKPOINT):
            with safe_open(folder / name, "np") as file:
                state = json.loads(file.metadata()["state"])
                names = list(file.keys())  # an opened file of safetensors cannot be iterated itself
                found[name] = {key: file.get_tensor(key).tobytes() for key in names}
            found[f"{name}, state"] = _without_times(state)
        elif name.endswith("curve.json"):
            found[name] = _without_times(json.loads(content))
        else:
            found[name] = content
    return found


def _without_times(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _without_times(one) for key, one in value.items() if key not in TIMES}
    if isinstance(value, list):  # the pairs of a checkpoint's tree
        return [
            _without_times(one)
            for one in value
            if not (isinstance(one, list) and one and one[0] in TIMES)
        ]
    return value


TRIALS = (
    "select number, state, value, param_name, param_value from trials "
    "left join trial_values using (trial_id) left join trial_params using (trial_id) "
    "order by number, param_name"
)
NOTES = (
    "select number, key, value_json from trials join trial_user_attributes using (trial_id) "
    "order by number, key"
)


def _tune_finished(folder: Path) -> dict[str, Any]:
    path = folder / STUDY
    if not path.exists():
        return {}
    try:
        with sqlite3.connect(path, timeout=30) as base:
            rows = base.execute(TRIALS).fetchall()
    except sqlite3.OperationalError:  # killed before its tables were made
        return {}
    done = [row for row in rows if row[1] in ("COMPLETE", "PRUNED")]
    return {f"{row[0]}, {row[3]}": row for row in done}


def _tune_result(folder: Path) -> dict[str, Any]:
    found: dict[str, Any] = {n: c for n, c in _contents(folder).items() if not n.startswith(STUDY)}
    with sqlite3.connect(folder / STUDY) as base:
        found[STUDY] = (base.execute(TRIALS).fetchall(), base.execute(NOTES).fetchall())
    return found


def _run_finished(folder: Path) -> dict[str, Any]:
    """Every file of a run whose summary is there."""
    path = folder / SUMMARY
    if not path.exists():
        return {}
    return {name: (folder / name).read_bytes() for name in json.loads(path.read_text())["files"]}


def _contents(folder: Path) -> dict[str, bytes]:
    """Bytes of all files below a folder, TensorBoard's and the revision of the sources left out."""
    return {
        str(path.relative_to(folder)): REVISION.sub(b"", path.read_bytes())
        for path in sorted(folder.rglob("*"))
        if path.is_file() and TENSORBOARD not in path.name
    }


BENCH = Job(
    words=(
        *("bench", "--policies", "reference:consistent,pure_pursuit", "--tasks", "infinity"),
        *("--disturbances", "nominal,start", "--seeds", "20000:20008", "--horizon-s", "3"),
        *("--processes", "1", "--replays", "1", "--no-figures", "--out", OUT),
    ),
    finished=_bench_lines,
    result=_bench_result,
    imports=("arch", "baselines.commands.bench", "baselines.commands.run"),
)
TRAIN = Job(
    words=("train", "small.yaml", "--seeds", "0,1", "--processes", "1", "--out", OUT),
    finished=_train_finished,
    result=_train_result,
    files={"small.yaml": TRAINING},
    imports=("baselines.commands.train", "torch.utils.tensorboard"),
)
TUNE = Job(
    words=("tune", "small.yaml", "--out", OUT),
    finished=_tune_finished,
    result=_tune_result,
    files={"small.yaml": SEARCH},
    imports=("optuna", "sqlalchemy", "baselines.tuning.search", "baselines.commands.run"),
)
RUN = Job(
    words=("run", "circle", "--horizon-s", "6", "--no-figures", "--out", OUT),
    finished=_run_finished,
    result=_contents,
    imports=("baselines.commands.run",),
)
JOBS = {"bench": BENCH, "train": TRAIN, "tune": TUNE, "run": RUN}


def with_processes(job: Job, count: int) -> Job:
    """The job spread over some processes."""
    option = "--workers" if job.words[0] == "tune" else "--processes"
    words = list(job.words)
    if option in words:
        words[words.index(option) + 1] = str(count)
    else:
        words += [option, str(count)]
    return job._replace(words=tuple(words))


def lost(job: Job, before: dict[str, Any], now: dict[str, Any]) -> list[str]:
    """Finished pieces that are gone or different; of a training the steps of a checkpoint may grow."""
    if job.words[0] == "train":
        return [name for name, steps in before.items() if now.get(name, -1) < steps]
    return [name for name, value in before.items() if name not in now or now[name] != value]


# --- files: whole or not there


def half_written(folder: Path) -> list[str]:
    """Files below a folder, but temporary ones, that cannot be read as a whole; with the reason."""
    found = []
    for path in sorted(folder.rglob("*")):
        if path.is_dir() or path.name.startswith(".") or TENSORBOARD in path.name:
            continue
        try:
            _read_whole(path)
        except Exception as error:
            found.append(f"{path.relative_to(folder)}: {type(error).__name__}: {error}")
    return found


def _read_whole(path: Path) -> None:
    if path.suffix == ".json":
        json.loads(path.read_text(encoding="utf-8"))
    elif path.suffix == ".jsonl":  # its last line may be cut: that is known, and it is not read
        data = path.read_bytes()
        for line in data[: data.rfind(b"\n") + 1].splitlines():
            json.loads(line)
    elif path.suffix == ".yaml":
        yaml.safe_load(path.read_text(encoding="utf-8"))
    elif path.suffix == ".npz":
        with np.load(path) as file:
            for name in file.files:
                file[name]
    elif path.suffix == ".safetensors":
        with safe_open(path, "np") as file:
            for name in list(file.keys()):  # the file itself cannot be iterated
                file.get_tensor(name)
    elif path.suffix == ".html":
        _ends_with(path, b"</html>")
    elif path.suffix == ".png":
        _ends_with(path, b"IEND\xaeB`\x82")
    elif path.suffix in (".csv", ".md"):
        _ends_with(path, b"")
    elif path.suffix == ".zip":
        with zipfile.ZipFile(path) as file:
            assert file.testzip() is None
    elif path.suffix == ".db":
        with sqlite3.connect(path, timeout=30) as base:
            (answer,) = base.execute("pragma integrity_check").fetchone()
        if answer != "ok":
            raise ValueError(answer)


def _ends_with(path: Path, end: bytes) -> None:
    data = path.read_bytes()
    if not data.rstrip(b"\n").endswith(end) or not data.endswith(b"\n" if not end else b""):
        raise ValueError(f"it ends with {data[-20:]!r}")


def temporary_files(folder: Path) -> list[str]:
    """Files that a writer has left behind: hidden ones."""
    return [str(path.relative_to(folder)) for path in folder.rglob(".*") if path.is_file()]


# --- starting a job


class Started:
    """A command that runs in a process group of its own."""

    def __init__(self, place: Path, words: tuple[str, ...], **settings: str) -> None:
        self.errors = place / "stderr.txt"
        with self.errors.open("wb") as errors:
            self._process = subprocess.Popen(
                [sys.executable, "-m", "baselines", *words],
                cwd=place,
                stdout=subprocess.DEVNULL,
                stderr=errors,
                stdin=subprocess.DEVNULL,
                start_new_session=True,
                env=os.environ | settings,
                preexec_fn=_as_in_a_terminal,
            )
        self.pid = self._process.pid

    def status(self) -> int | None:
        """Exit status; a negative number is a signal; None while it runs."""
        return self._process.poll()

    def send(self, number: int) -> None:
        """Send a signal to the command alone, not to its workers."""
        if self.status() is None:
            os.kill(self.pid, number)

    def wait(self, limit_s: float) -> int:
        """Its exit status.

        Raises
        ------
        TimeoutError
            if it still runs after the limit.
        """
        end = time.monotonic() + limit_s
        while (status := self.status()) is None:
            if time.monotonic() > end:
                raise TimeoutError(f"it runs for more than {limit_s:g} s")
            time.sleep(0.003)
        return status

    def members(self) -> list[int]:
        """Processes of its group that are left, zombies not counted."""
        return group_members(self.pid)

    def end(self) -> None:
        """Kill what is left of the group."""
        for pid in self.members():
            try:
                os.kill(pid, signal.SIGKILL)
            except ProcessLookupError:
                continue
        self.status()

    def said(self) -> str:
        """What it has written to standard error."""
        return self.errors.read_text(encoding="utf-8", errors="replace")


def _as_in_a_terminal() -> None:
    """Undo what a shell does to a command in the background: it ignores SIGINT, and so do its children."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)


class Forked(Started):
    """A command in a fork of this process, which has imported what it needs: no time is lost on that."""

    def __init__(self, place: Path, words: tuple[str, ...]) -> None:
        self.errors = place / "stderr.txt"
        self._status: int | None = None
        sys.stdout.flush()
        sys.stderr.flush()
        self.pid = os.fork()
        if not self.pid:
            _be_the_command(place, words, self.errors)

    def status(self) -> int | None:
        if self._status is None:
            done, status = os.waitpid(self.pid, os.WNOHANG)
            if done:
                self._status = os.waitstatus_to_exitcode(status)
        return self._status


def _be_the_command(place: Path, words: tuple[str, ...], errors: Path) -> None:
    status = 99
    try:
        os.setsid()
        signal.signal(signal.SIGINT, signal.default_int_handler)
        os.chdir(place)
        handle = os.open(errors, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o644)
        os.dup2(handle, 2)
        os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
        os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
        sys.argv = ["tlf", *words]
        from baselines import cli

        cli.main()
        status = 0
    except SystemExit as ended:
        status = ended.code if isinstance(ended.code, int) else int(ended.code is not None)
    except BaseException:
        traceback.print_exc()
    finally:
        sys.stderr.flush()
        os._exit(status)


def group_members(group: int) -> list[int]:
    """Processes of a process group, zombies not counted."""
    found = []
    for entry in Path("/proc").iterdir():
        if not entry.name.isdigit():
            continue
        try:
            state = (entry / "stat").read_text()
        except OSError:
            continue
        fields = state[state.rfind(")") + 2 :].split()
        if int(fields[2]) == group and fields[0] != "Z":
            found.append(int(entry.name))
    return found


def prepare(place: Path, job: Job) -> None:
    """Make the folder in which a job runs, with its files."""
    place.mkdir(parents=True)
    for name, content in job.files.items():
        (place / name).write_text(yaml.safe_dump(content), encoding="utf-8")


def run_whole(
    place: Path, job: Job, start: Callable[..., Started], limit_s: float = 300
) -> Started:
    """Run a job to its end.

    Raises
    ------
    RuntimeError
        with what it said, if it fails.
    """
    started = start(place, job.words)
    try:
        if started.wait(limit_s):
            raise RuntimeError(
                f"tlf {job.words[0]} ended with {started.status()}: {started.said()}"
            )
    finally:
        started.end()
    return started


ONE_LINE = re.compile(r"^tlf: .+$")


def plain_error(said: str) -> str | None:
    """None if the last line is one message of ``tlf``, and there is no traceback; else what is wrong."""
    if "Traceback" in said:
        return f"a traceback: {said[-600:]}"
    lines = said.strip().splitlines()
    if not lines or not ONE_LINE.match(lines[-1]):
        return f"no message of tlf: {said[-300:]!r}"
    return None


@contextmanager
def mounted_tmpfs(place: Path, size: str) -> Iterator[Path]:
    """A small file system of its own at a folder (needs root); unmounted at the end."""
    place.mkdir(parents=True, exist_ok=True)
    subprocess.run(["mount", "-t", "tmpfs", "-o", f"size={size}", "tmpfs", str(place)], check=True)
    try:
        yield place
    finally:
        subprocess.run(["umount", "-l", str(place)], check=True)
