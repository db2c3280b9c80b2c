"""Faults while something is written: interrupts, kills, full disks, two commands in one folder."""

from __future__ import annotations

import errno
import gc
import json
import os
import resource
import signal
import subprocess
import sys
import tempfile
import threading
import time
import weakref
from contextlib import suppress
from pathlib import Path

import pytest
from campaign.jobs import group_members

from baselines import ReferencePolicy, cli
from baselines.benchmark.bench import run_bench
from baselines.benchmark.plan import Plan
from baselines.benchmark.results import PLAN_FILE, RUNS_FILE
from baselines.runs import jobs
from baselines.runs.folders import SUMMARY, UNFINISHED
from baselines.runs.jobs import alone_in, claim
from baselines.runs.jsonl import append_line, read_lines
from baselines.runs.run import run_policy
from baselines.runs.stopping import Interrupted, interruptible
from tlf_env.common import files
from tlf_env.common.files import atomic
from tlf_env.task.scenario import load_scenario

SHORT = (("horizon_s", 2.0),)
PLAN = Plan(
    policies=("pure_pursuit",),
    tasks=("infinity",),
    disturbances=("nominal", "start"),
    seeds=(20_000, 20_002),
    overrides=SHORT,
)


class InterruptedAt:
    """The reference, until Ctrl-C is pressed at a call."""

    def __init__(self, call: int) -> None:
        self.left, self.reference = call, ReferencePolicy()

    def press(self) -> None:
        raise KeyboardInterrupt

    def predict(self, rows, state=None, episode_start=None, deterministic=True):
        self.left -= 1
        if not self.left:
            self.press()
        return self.reference.predict(rows, state, episode_start, deterministic)


# --- interrupts


@pytest.mark.parametrize("call", [1, 2, 50])
def test_an_interrupt_goes_on_unless_the_part_is_asked_for(call):
    scenario = load_scenario("circle", horizon_s=2.0)
    with pytest.raises(KeyboardInterrupt):
        run_policy(scenario, InterruptedAt(call))


class Finalised:
    """An object in whose last moment Ctrl-C is pressed: Python drops an error that is raised there."""

    def __del__(self) -> None:
        signal.raise_signal(signal.SIGINT)


def end_a_weak_reference() -> None:
    """Press Ctrl-C in the call that follows the end of an object."""

    class Held:
        pass

    held = Held()
    weakref.finalize(held, signal.raise_signal, signal.SIGINT)
    del held


def collect_garbage() -> None:
    """Press Ctrl-C in a function that Python calls at each collection, as Hypothesis adds one."""

    def press(phase: str, info: dict) -> None:
        signal.raise_signal(signal.SIGINT)

    gc.callbacks.append(press)
    try:
        gc.collect()
    finally:
        gc.callbacks.remove(press)


def free_a_body() -> None:
    """Press Ctrl-C while pymunk frees a body: its library calls Python there, and drops errors."""
    import pymunk

    def press(frame, event, arg):
        if event == "call" and frame.f_code.co_name == "freebody":
            sys.setprofile(None)
            signal.raise_signal(signal.SIGINT)

    body = pymunk.Body(1.0, 1.0)
    sys.setprofile(press)
    del body
    end = time.monotonic() + 5.0
    # Again while another thread is collecting: then nothing happens.
    while sys.getprofile() is not None:
        assert time.monotonic() < end, "no body was freed"
        gc.collect()  # a body refers to itself


def in_a_library() -> None:
    """Press Ctrl-C in a function whose library drops every error, as C can."""
    with suppress(KeyboardInterrupt):
        signal.raise_signal(signal.SIGINT)


@pytest.mark.parametrize(
    "where", [Finalised, end_a_weak_reference, collect_garbage, free_a_body, in_a_library]
)
def test_an_interrupt_where_errors_are_dropped_comes_a_little_later(where, capfd):
    def go_on() -> None:
        with interruptible():
            where()
            end = time.monotonic() + 5.0
            while time.monotonic() < end:
                time.sleep(0.001)

    with pytest.raises(Interrupted):
        go_on()
    assert capfd.readouterr().err == ""


def test_an_interrupted_episode_is_no_line_of_a_benchmark(tmp_path, monkeypatch):
    """Ctrl-C in an episode: it is neither taken as finished nor is the benchmark gone on with."""
    pytest.importorskip("arch")
    from baselines.runs import run as runs

    real, steps = runs.PolicyDriver.act, iter(range(10_000))

    def act(self):
        if next(steps) == 150:  # in the second episode
            raise KeyboardInterrupt
        return real(self)

    with monkeypatch.context() as patch:
        patch.setattr(runs.PolicyDriver, "act", act)
        with pytest.raises(KeyboardInterrupt):
            run_bench(PLAN, tmp_path / "cut")
    assert (tmp_path / "cut" / RUNS_FILE).read_bytes().count(b"\n") == 1
    run_bench(PLAN, tmp_path / "cut")
    run_bench(PLAN, tmp_path / "whole")
    cut, whole = ((tmp_path / one / RUNS_FILE).read_bytes() for one in ("cut", "whole"))
    assert cut == whole


@pytest.fixture
def in_a_folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return tmp_path


def tlf(monkeypatch, *words: str) -> int:
    monkeypatch.setattr("sys.argv", ["tlf", *words])
    try:
        cli.main()
    except SystemExit as ended:
        return int(ended.code)
    return 0


@pytest.mark.parametrize(("number", "status"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_a_signal_ends_a_command_with_its_status_and_how_to_go_on(
    number, status, monkeypatch, capsys
):
    """Also where a plain interrupt has passed `exec`, after which Python would end by SIGINT."""

    def work(*_, **__):
        exec("signal.raise_signal(number)", {"signal": signal, "number": number})
        time.sleep(10)

    # A shell has its jobs in the background ignore SIGINT, and so the tests that run there.
    usual = signal.default_int_handler if number == signal.SIGINT else signal.SIG_DFL
    before = signal.signal(number, usual)
    monkeypatch.setattr(cli, "app", work)
    try:
        assert tlf(monkeypatch, "bench", "--plan", "board") == status
        assert signal.getsignal(number) is usual
    finally:
        signal.signal(number, before)
    (line,) = capsys.readouterr().err.splitlines()
    assert line.endswith("the same command goes on: tlf bench --plan board")


def test_an_interrupt_does_not_come_to_the_next_command():
    """Its error is held by the one that ended the command, and forgotten later."""
    with pytest.raises(KeyboardInterrupt) as held, interruptible():
        signal.raise_signal(signal.SIGTERM)

    def next_command() -> None:
        with interruptible():
            held.value.__del__()
            time.sleep(0.1)

    next_command()


def test_an_interrupt_that_ends_a_run_early_comes_once():
    """The part of the run that is kept is written without another one."""
    policy = InterruptedAt(50)
    policy.press = lambda: signal.raise_signal(signal.SIGINT)
    scenario = load_scenario("circle", horizon_s=2.0)

    def part() -> bool:
        with interruptible():
            record = run_policy(scenario, policy, keep_interrupted=True)
            time.sleep(0.3)
            return record.interrupted

    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        assert part()
    finally:
        signal.signal(signal.SIGINT, before)


@pytest.mark.parametrize(
    ("handler", "status"), [("SIG_DFL", -signal.SIGINT), ("SIG_IGN", 0)], ids=str
)
def test_an_interrupt_while_modules_are_imported_gives_no_traceback(handler, status):
    """With SIG_IGN, as a shell starts a command in the background, it is ignored."""
    code = """
import signal, sys

class Finder:
    def find_spec(self, name, path, target=None):
        if name == "baselines.cli":
            signal.raise_signal(signal.SIGINT)

sys.meta_path.insert(0, Finder())
sys.argv = ["tlf", "--version"]
from baselines.__main__ import main
main()
"""
    ended = subprocess.run(
        [sys.executable, "-c", code],
        capture_output=True,
        text=True,
        preexec_fn=lambda: signal.signal(signal.SIGINT, getattr(signal, handler)),
    )
    assert (ended.returncode, ended.stderr) == (status, "")


def test_an_interrupt_that_becomes_another_error_is_still_one(monkeypatch, capsys):
    """A module in C whose import is interrupted raises an ImportError."""

    def work(*_, **__):
        try:
            signal.raise_signal(signal.SIGTERM)
            time.sleep(10)
        except KeyboardInterrupt:
            raise ImportError("numba._devicearray failed to import") from None

    before = signal.signal(signal.SIGTERM, signal.SIG_DFL)
    monkeypatch.setattr(cli, "app", work)
    try:
        assert tlf(monkeypatch, "openloop", "torques.json") == 143
    finally:
        signal.signal(signal.SIGTERM, before)
    assert capsys.readouterr().err == "tlf: interrupted\n"


WORKERS = """
import sys, time
from baselines.runs.jobs import spread
from baselines.runs.stopping import interruptible, interrupts, stopped_status

def work(shared, job):
    if shared == "checkpoint":
        with interrupts() as stop:
            open(f"began_{job}", "w").close()
            while not stop:
                time.sleep(0.01)
            open(f"checkpoint_{job}", "w").close()
            raise KeyboardInterrupt
    open(f"began_{job}", "w").close()
    time.sleep(60)

if __name__ == "__main__":
    with interruptible():
        try:
            list(spread(work, sys.argv[1], [1, 2], processes=2))
        except KeyboardInterrupt:
            sys.exit(stopped_status())
"""


@pytest.mark.parametrize("shared", ["nothing", "checkpoint"])
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
@pytest.mark.parametrize("group", [False, True])
def test_workers_stop_with_their_command(shared, number, group, tmp_path):
    """At once, or after a checkpoint, whether the signal reaches the command alone or its workers, too."""
    (tmp_path / "work.py").write_text(WORKERS, encoding="utf-8")
    process = subprocess.Popen(
        [sys.executable, "work.py", shared],
        cwd=tmp_path,
        stderr=subprocess.PIPE,
        start_new_session=True,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
        env=os.environ | {"PYTHONPATH": str(Path(__file__).parents[1])},
    )
    try:
        end = time.monotonic() + 60
        while len(list(tmp_path.glob("began_*"))) < 2:
            assert time.monotonic() < end
            assert process.poll() is None
            time.sleep(0.01)
        if group and number == signal.SIGTERM and shared == "nothing":
            os.kill(process.pid, number)  # the workers end by themselves, which is no different
        elif group:
            os.killpg(process.pid, number)
        else:
            os.kill(process.pid, number)
        _, said = process.communicate(timeout=30)
    finally:
        process.kill()
        process.wait()
    assert process.returncode == {signal.SIGINT: 130, signal.SIGTERM: 143}[number]
    assert b"Traceback" not in said
    while group_members(
        process.pid
    ):  # no worker is left; multiprocessing's own helper ends a little later
        assert time.monotonic() < end
        time.sleep(0.01)
    assert len(list(tmp_path.glob("checkpoint_*"))) == (2 if shared == "checkpoint" else 0)


# --- kills


def test_a_killed_writer_leaves_no_file_behind(tmp_path):
    child = os.fork()
    if not child:
        with atomic(tmp_path / "one.txt") as file:
            file.write("half")
            file.flush()
            os.kill(os.getpid(), signal.SIGKILL)
    os.waitpid(child, 0)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("unnamed", [True, False])
def test_a_file_appears_whole_with_its_name(unnamed, tmp_path, monkeypatch):
    """On file systems without files that have no name, too."""
    if not unnamed:
        monkeypatch.setattr(files, "_unnamed", lambda folder: None)
    path = tmp_path / "one.txt"
    for text in ("first", "second"):
        with atomic(path) as file:
            file.write(text)
            assert not path.exists() or path.read_text() == "first"
        assert path.read_text() == text
        assert path.stat().st_mode & 0o777 == 0o644
    with pytest.raises(ValueError, match="JSON"), atomic(path) as file:
        json.dump(float("nan"), file, allow_nan=False)
    with pytest.raises(FileExistsError), atomic(path, exclusive=True) as file:
        file.write("third")
    with atomic(tmp_path / "two.txt", exclusive=True) as file:
        file.write("new")
    assert path.read_text() == "second"
    assert {one.name for one in tmp_path.iterdir()} == {"one.txt", "two.txt"}


def test_a_pipe_or_a_device_is_written_into_and_stays(tmp_path):
    """A file that takes the place of /dev/null would be in the way of every program."""
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    reader = os.open(pipe, os.O_RDONLY | os.O_NONBLOCK)
    with atomic(pipe) as file:
        file.write("whole")
    assert os.read(reader, 100) == b"whole"
    with pytest.raises(FileExistsError), atomic(pipe, exclusive=True) as file:
        file.write("new")
    os.close(reader)
    assert pipe.is_fifo()
    assert list(tmp_path.iterdir()) == [pipe]
    with atomic(Path(os.devnull), "wb") as file:
        file.write(b"whole")
    assert Path(os.devnull).is_char_device()


@pytest.mark.skipif(not Path("/dev/shm").is_dir(), reason="no memory with this name")
def test_a_link_below_dev_to_a_file_is_no_device():
    with tempfile.TemporaryDirectory(dir="/dev/shm") as name:
        link = Path(name, "link")
        Path(name, "one.txt").write_text("first")
        link.symlink_to("one.txt")
        with atomic(link) as file:
            file.write("second")
        assert link.read_text() == "second"


@pytest.mark.skipif(not Path("/dev/stdout").is_symlink(), reason="no link with this name")
@pytest.mark.parametrize("redirected", [True, False])
def test_standard_output_can_be_named_as_a_file(redirected, tmp_path):
    code = """
from pathlib import Path
from tlf_env.common.files import atomic

print("before", flush=True)
with atomic(Path("/dev/stdout")) as file:
    file.write("whole")
"""
    link = Path("/dev/stdout").readlink()
    with (tmp_path / "out").open("w") as out:
        ended = subprocess.run(
            [sys.executable, "-c", code],
            check=True,
            stdout=out if redirected else subprocess.PIPE,
        )
    written = (tmp_path / "out").read_bytes() if redirected else ended.stdout
    assert written == b"before\nwhole"
    assert Path("/dev/stdout").readlink() == link


def test_a_file_is_on_the_disk_before_it_has_its_name(tmp_path, monkeypatch):
    seen = []
    monkeypatch.setattr(files.os, "fsync", lambda handle: seen.append(list(tmp_path.iterdir())))
    with atomic(tmp_path / "one.txt") as file:
        file.write("whole")
    assert seen == [[]]


def test_a_repeated_run_that_is_cut_keeps_the_finished_one(in_a_folder, monkeypatch, capsys):
    """Interrupted, or killed while it simulates or writes: the earlier files stay as they are."""
    from baselines.commands import run as command
    from baselines.runs import run as runs

    words = ("run", "circle", "--horizon-s", "2", "--no-figures", "--out", "here")
    assert tlf(monkeypatch, *words) == 0
    here = Path("here")
    whole = {path.name: path.read_bytes() for path in here.iterdir()}
    real, steps = runs.PolicyDriver.act, iter(range(10_000))

    def act(self):
        if next(steps) == 50:
            raise KeyboardInterrupt
        return real(self)

    def die(*_):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    with monkeypatch.context() as patch:
        patch.setattr(runs.PolicyDriver, "act", act)
        assert tlf(patch, *words) == cli.INTERRUPTED
        assert "keeps the whole run" in capsys.readouterr().err
        steps = iter(range(10_000))
        assert tlf(patch, *words[:-2], "--out", "here", "--seed", "1", "--overwrite") == 130
    with monkeypatch.context() as patch:
        patch.setattr(command, "write_replay", die)
        assert tlf(patch, *words) == cli.FAILED
    assert {path.name: path.read_bytes() for path in here.iterdir()} == whole
    (here / f"{UNFINISHED}x").mkdir()  # of a killed run
    (here / f"{UNFINISHED}x" / "replay.html").write_text("half", encoding="utf-8")
    assert tlf(monkeypatch, *words) == 0
    assert {path.name: path.read_bytes() for path in here.iterdir()} == whole


def test_what_is_left_of_a_line_is_cut_before_the_next(tmp_path):
    path = tmp_path / "lines.jsonl"
    append_line(path, {"number": 1})
    with path.open("ab") as file:
        file.write(b'{"number": 2, "other')
    append_line(path, {"number": 3})
    assert [*read_lines(path, lambda line: line["number"])] == [1, 3]
    with path.open("ab") as file:
        file.write(b'{"number": 4, "other')
    assert [*read_lines(path, lambda line: line["number"])] == [1, 3]
    append_line(path, {"number": 5})
    assert [json.loads(line) for line in path.read_text().splitlines()] == [
        {"number": 1},
        {"number": 3},
        {"number": 5},
    ]


# --- full disks


def in_a_child_with_files_up_to(size: int, work) -> int:
    """Exit status of a child that can write so many bytes to a file, and then gets errors."""
    child = os.fork()
    if not child:
        status = 99
        try:
            signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
            resource.setrlimit(resource.RLIMIT_FSIZE, (size, size))
            status = work()
        finally:
            os._exit(status)
    return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])


def test_a_line_that_does_not_fit_leaves_nothing(tmp_path):
    """The system takes a part of it without an error first."""
    path = tmp_path / "lines.jsonl"
    append_line(path, {"number": 1})

    def work() -> int:
        try:
            append_line(path, {"number": 2, "long": "x" * 300})
        except OSError as error:
            return 7 if error.filename == str(path) else 8
        return 9

    assert in_a_child_with_files_up_to(200, work) == 7
    assert json.loads(path.read_text()) == {"number": 1}


def test_an_error_of_the_disk_names_the_file(tmp_path):
    path = tmp_path / "one.txt"

    def work() -> int:
        try:
            with atomic(path) as file:
                file.write("x" * 300)
        except OSError as error:
            return 7 if error.filename == str(path) else 8
        return 9

    assert in_a_child_with_files_up_to(200, work) == 7
    assert list(tmp_path.iterdir()) == []
    (tmp_path / "no folder").write_text("a file", encoding="utf-8")
    with pytest.raises(OSError, match=r"no folder"), atomic(tmp_path / "no folder" / "a") as file:
        file.write("never")


@pytest.mark.parametrize("mode", ["full", "read only"])
def test_a_search_whose_database_cannot_be_written_does_not_advise_to_remove_it(mode, tmp_path):
    """And its finished trials are there when there is room again."""
    pytest.importorskip("optuna")
    import optuna

    from baselines.runs.trials import STUDY_FILE, TrialStore

    ranges = {"x": optuna.distributions.FloatDistribution(0.0, 1.0)}

    def opened() -> TrialStore:
        return TrialStore(tmp_path, "one", ranges, sampler_seed=0, startup_trials=1)

    store = opened()
    store.tell(store.propose({"x": 0.5}).number, 1.0, {})
    path, number = tmp_path / STUDY_FILE, errno.ENOSPC if mode == "full" else errno.EROFS

    @sqlalchemy_event(store)
    def pragma(connection) -> None:
        how = "max_page_count = 1" if mode == "full" else "query_only = 1"
        connection.execute(f"pragma {how}")

    def go_on() -> None:
        for _ in range(100):
            store.tell(store.propose({"x": 0.5}).number, 1.0, {"note": "x" * 500})

    with pytest.raises(OSError, match=os.strerror(number)) as failed:
        go_on()
    assert (failed.value.errno, failed.value.filename) == (number, str(path))
    assert [one.value for one in opened().trials("COMPLETE")][:1] == [1.0]


def sqlalchemy_event(store):
    """Call a function with every connection that the store of a study makes from now on."""
    from sqlalchemy import event

    engine = store.study._storage._backend.engine
    engine.dispose()

    def register(function):
        event.listen(engine, "connect", lambda connection, _: function(connection))
        return function

    return register


def test_the_command_that_goes_on_after_a_full_disk_is_named(monkeypatch, capsys):
    def work(*_, **__):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), "out/runs.jsonl")

    monkeypatch.setattr(cli, "app", work)
    assert tlf(monkeypatch, "bench", "--plan", "board") == cli.FAILED
    (line,) = capsys.readouterr().err.splitlines()
    assert "No space left on device: 'out/runs.jsonl'; what is finished is kept" in line
    assert line.endswith("the same command goes on: tlf bench --plan board")
    assert tlf(monkeypatch, "run", "circle") == cli.FAILED
    assert capsys.readouterr().err.strip().endswith("'out/runs.jsonl'")


# --- two at once


def test_two_benchmarks_in_one_folder_are_refused(tmp_path):
    pytest.importorskip("arch")
    with alone_in(tmp_path), pytest.raises(ValueError, match=r"another process works in .*; wait"):
        run_bench(PLAN, tmp_path)
    assert not (tmp_path / RUNS_FILE).exists()
    assert len(run_bench(PLAN, tmp_path).lines) == 4


def test_two_runs_in_one_folder_are_refused(in_a_folder, monkeypatch, capsys):
    Path("here").mkdir()
    words = ("run", "circle", "--horizon-s", "2", "--no-figures", "--out", "here")
    with alone_in(Path("here")):
        assert tlf(monkeypatch, *words) == cli.BAD_INPUT
    assert "another process works in here" in capsys.readouterr().err
    assert list(Path("here").iterdir()) == []
    assert tlf(monkeypatch, *words) == 0
    assert (Path("here") / SUMMARY).exists()


def test_of_two_that_claim_a_folder_at_once_the_first_has_it(tmp_path, monkeypatch):
    path = tmp_path / PLAN_FILE
    real = jobs.atomic

    def late(*args, **options):  # the other process claims after this one has looked
        if not path.exists():
            path.write_text(json.dumps({"plan": 1}), encoding="utf-8")
        return real(*args, **options)

    monkeypatch.setattr(jobs, "atomic", late)
    with pytest.raises(ValueError, match="holds results with a different 'plan'"):
        claim(path, {"plan": 2}, ["plan"], "results")
    assert json.loads(path.read_text()) == {"plan": 1}
    path.unlink()
    claim(path, {"plan": 1}, ["plan"], "results")  # for the same plan it is no matter


def test_a_waiting_lock_is_given_on(tmp_path):
    seen = []

    def other() -> None:
        with alone_in(tmp_path, wait=True):
            seen.append("other")

    with alone_in(tmp_path):
        thread = threading.Thread(target=other)
        thread.start()
        time.sleep(0.1)
        seen.append("first")
    thread.join(10)
    assert seen == ["first", "other"]
