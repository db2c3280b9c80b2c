"""Mutation testing of the laws: which small errors in tlf_env/physics and tlf_env/onboard do tests notice?

    python tests/campaign/mutants.py --sample 300 --seed 1
    python tests/campaign/mutants.py --sample 300 --seed 1 --again    # the survivors, after a new test
    python tests/campaign/mutants.py --only physics/friction --sample 40

Each mutant is one change of the sources (``mutation.py``), drawn at random from every file in proportion
to its lines. The checkout is never edited. A change inside a function is made in memory, in a child of a
process that has imported everything and collected the tests; any other change in a temporary copy of the
project, where all is imported anew. Then the tests run that call the changed function, and after them the
others of their files, the shortest of every file first, until one fails: the mutant is *killed*. A run that
takes far longer than it should is ended, and counts as killed, by the time limit.

Each mutant goes through up to three ways to run tests:

- ``python``: with Numba switched off, so that a change of a law needs no compiling. What Numba's own code
  does in the laws (tables on the stack, bits of floats) is done in Python.
- ``compiled``: with the drivers of the unchanged sources, from the cache. So episodes run, and a change of
  plain Python is judged by them.
- ``fresh``, with ``--again``: a law of the plant that survived is compiled anew, with the small drivers of
  the tests of the plant. With ``--again --episodes`` the survivors of both rooms are, with the drivers of
  the episodes, which takes minutes each.

Which test calls which function is found out once, and again for a file that has changed. Tests that do not
pass without a change, or take too long, are left out, and so are recorded bits (``test_golden.py``,
``test_digest.py``): any change of a law alters them, which says nothing about the other tests.

Why not a library: mutmut makes no mutants of decorated functions, as all laws are; cosmic-ray starts a new
process for each mutant, which takes longer here than the tests, and changes the files in their place.
"""

from __future__ import annotations

import argparse
import contextlib
import functools
import gc
import hashlib
import importlib
import inspect
import json
import os
import resource
import shutil
import signal
import struct
import subprocess
import sys
import tempfile
import time
import traceback
import types
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

from tqdm import tqdm

HERE = Path(__file__).resolve().parent
ROOT = HERE.parent.parent
sys.path.insert(0, str(HERE))

import mutation  # noqa: E402 - of this folder, which is on the path from here on

ROOMS = ("physics", "onboard")
COMPILING = frozenset({"law", "block", "view", "allocating", "driver"})
MODES = ("python", "compiled")
ALIVE = ("survived", "no test")
QUIET = ("-q", "-s", "-p", "no:cacheprovider", "--no-header", "-W", "ignore")
OTHER_PACKAGES = (
    "gymnasium",
    "numba",
    "pettingzoo",
    "pydantic",
    "pymunk",
    "rich.progress",
    "scipy.integrate",
    "scipy.linalg",
    "scipy.optimize",
    "scipy.spatial",
    "scipy.stats",
    "typer",
    "yaml",
)
COPIED = ("tlf_env", "baselines", "tests", "configs", "examples", "docs")
EXAMPLES = 20  # of Hypothesis for each property that does not ask for another number
DEFAULTS = ("tests/test_scenario_page.py", "tests/test_table_1.py")  # compare defaults with pages
# Limits in s of processor time, all scaled by --patience.
LONGEST_TEST_S = {"python": 2.5, "compiled": 3.0}  # a longer test is not used
STOP_S = {"python": 4.0, "compiled": 10.0}  # a longer test is ended; a first one may load drivers
LONGEST_FILE_S = {"python": 60.0, "compiled": 60.0}  # what is left of a file is not used
MOST_TESTS_S = {
    "python": 8.0,
    "compiled": 10.0,
}  # of a mutant's tests, by their times without a change
COLD_S = 30.0  # importing, and compiling the drivers of one file
SLOWER, MORE_S = (
    3.0,
    12.0,
)  # the limit of a run: so many times what it should take, and so much more

# Files with tests of the laws that need no whole episode, and files that use the rooms' plain Python.
LAW_FILES = (
    "friction",
    "openloop",
    "sliding",
    "linear",
    "rays",
    "laws",
    "tracking_laws",
    "textbook_laws",
    "sliding_mode",
    "disturbance_rejection",
    "limiter",
    "limited_actions",
    "spacing",
    "supervisor",
    "observer",
    "estimator",
    "slip_estimator",
    "gyro_estimator",
    "wheel_loop",
    "scenario_page",
    "sensors",
    "kernel",
    "world",
    "chipmunk",
)
PLAIN_FILES = (
    "table_1",
    "openloop",
    "state",
    "shapes",
    "objects",
    "world",
    "world_input",
    "contact",
    "chipmunk",
    "parts",
    "memory",
    "snapshots",
    "files",
)
FILES: dict[str, Sequence[str]] = {"python": LAW_FILES, "compiled": PLAIN_FILES}
FRESH = ("kernel", "physics_numbers")  # of the plant, with the driver of physics_helpers.py
FRESH_OF = {
    "tlf_env/physics/sliding.py": ("sliding",),
    "tlf_env/physics/openloop.py": ("openloop",),
}
EPISODES = {
    "physics": ("sliding", "tiles", "disturbed_plant", "floor_and_motors", "contact", "world"),
    "onboard": (
        "estimator",
        "slip_estimator",
        "gyro_estimator",
        "sensors",
        "wheel_loop",
        "supervisor",
        "spacing",
        "limiter",
        "observer",
        "tracking_laws",
        "disturbance_rejection",
        "parts",
        "python_estimators",
        "hardware",
    ),
}


# The worker: a process that has imported what takes long, and forks for every run


def worker(mode: str, warm: bool, copy: Path) -> None:
    """Read jobs, a line each, and answer each with a line.

    A warm one has collected all tests of its mode from the checkout; another imports only other packages.
    """
    import hypothesis
    import pytest

    hypothesis.settings.register_profile(
        "mutants",
        max_examples=EXAMPLES,
        deadline=None,
        derandomize=True,
        database=None,
        suppress_health_check=list(hypothesis.HealthCheck),
        phases=[hypothesis.Phase.explicit, hypothesis.Phase.generate],
    )
    hypothesis.settings.load_profile("mutants")
    sys.dont_write_bytecode = True
    answers = os.dup(1)
    log = os.open(os.devnull, os.O_WRONLY)
    for one in (1, 2):
        os.dup2(log, one)
    with os.fdopen(answers, "w", buffering=1) as out:
        if warm:
            os.chdir(ROOT)
            sys.path[:0] = [str(ROOT), str(ROOT / "tests")]
            _prepare(mode, ROOT)
            files = [f"tests/test_{stem}.py" for stem in FILES[mode]]
            pytest.main([*QUIET, *files], plugins=[_Loop(mode, out)])
        else:
            os.chdir(copy)
            sys.path[:0] = [str(copy), str(copy / "tests")]
            for package in OTHER_PACKAGES:
                importlib.import_module(package)
            for line in sys.stdin:
                job = json.loads(line)
                answer = _forked(job, lambda job=job: _imported(job, mode, copy))
                out.write(json.dumps(answer) + "\n")


class _Loop:
    """Instead of running the tests that it has collected, pytest waits for jobs."""

    def __init__(self, mode: str, out: Any) -> None:
        self.mode, self.out = mode, out

    def pytest_collectreport(self, report: Any) -> None:
        if report.failed:
            answer = {"outcome": "broken", "error": str(report.longrepr), "children_s": 0}
            self.out.write(json.dumps(answer) + "\n")  # a line is sent at once
            os._exit(1)

    def pytest_runtestloop(self, session: Any) -> bool:
        if self.mode == "compiled":
            _load_drivers()
        functions = _functions()
        gc.collect()
        gc.freeze()
        items = {item.nodeid: item for item in session.items}
        for line in sys.stdin:
            job = json.loads(line)
            answer = _forked(job, lambda job=job: self._run(job, items, functions))
            self.out.write(json.dumps(answer) + "\n")
        return True

    def _run(self, job: dict[str, Any], items: dict[str, Any], functions: Any) -> dict[str, Any]:
        if job["map"]:
            chosen = [one for name, one in items.items() if name.partition("::")[0] in job["files"]]
        else:
            chosen = [items[one] for one in job["tests"]]
        if not chosen:
            return {"outcome": "map", "tests": {}}
        plugin = _Plugin(self.mode, job["map"], job.get("patience", 1.0))
        chosen[0].config.pluginmanager.register(plugin)
        if "source" in job and not _exchanged(job, functions):
            return {"outcome": "cold"}
        for item, following in zip(chosen, [*chosen[1:], None], strict=True):
            item.config.hook.pytest_runtest_protocol(item=item, nextitem=following)
            if plugin.failed is not None and not job["map"]:
                break
            if job["map"]:
                write(Path(job["out"]), json.dumps(plugin.tests))
        return plugin.answer()


def _load_drivers() -> None:
    """Compile the drivers, or load them, before any child needs them."""
    import numpy as np

    import tlf_env

    for plant in ("pymunk", "kinematic", "chipmunk"):
        env = tlf_env.parallel_env("infinity", plant=plant)
        env.reset(seed=0)
        env.step({agent: np.zeros(2) for agent in env.agents})
    batch = tlf_env.BatchPlant("infinity", 2, threads=1)
    batch.reset(seed=0)
    batch.step(np.zeros((2, 3, 2)))
    env = tlf_env.parallel_env("infinity", estimator=_Still)  # the drivers for parts in Python
    env.reset(seed=0)
    env.step({agent: np.zeros(2) for agent in env.agents})


class _Still:
    """An estimator that thinks that the robot stands."""

    def __init__(self, robot: Any, period_s: float) -> None:
        pass

    def reset(self, pose: Any) -> None:
        self.pose = pose.copy()

    def update(self, readings: Any) -> Any:
        return self.pose


def _functions() -> dict[tuple[str, str], list[Any]]:
    """All functions of the two rooms, by file and qualified name."""
    found: dict[tuple[str, str], list[Any]] = {}
    folders = {str(ROOT / "tlf_env" / room) for room in ROOMS}
    for one in gc.get_objects():
        if type(one) is types.FunctionType:
            code = one.__code__
            if str(Path(code.co_filename).parent) in folders:
                found.setdefault((code.co_filename, code.co_qualname), []).append(one)
    return found


def _codes(code: types.CodeType) -> Iterator[types.CodeType]:
    """Of all functions, and what is inside them, in a module's code."""
    for one in code.co_consts:
        if isinstance(one, types.CodeType):
            if one.co_flags & inspect.CO_OPTIMIZED:  # not a class's body
                yield one
            else:
                yield from _codes(one)


def _exchanged(job: dict[str, Any], functions: dict[tuple[str, str], list[Any]]) -> bool:
    """Give the changed function its changed code; whether that can be done."""
    file = str(ROOT / job["file"])
    inside = job["function"]
    codes = [
        one
        for one in _codes(compile(job["source"], file, "exec", dont_inherit=True))
        if inside == one.co_qualname or inside.startswith(f"{one.co_qualname}.")
    ]
    if len(codes) != 1:  # none, or a property's two functions of the same name
        return False
    old = functions.get((file, codes[0].co_qualname), [])
    if not old or any(one.__code__.co_freevars != codes[0].co_freevars for one in old):
        return False
    for one in old:
        one.__code__ = codes[0]
    return True


def _imported(job: dict[str, Any], mode: str, copy: Path) -> dict[str, Any]:
    """Import everything anew, and run tests."""
    import pytest

    _prepare(mode, copy, job["fresh"], job["file"])
    plugin = _Plugin(mode, order=job["tests"])
    code = int(pytest.main([*QUIET, "-x", *job["files"]], plugins=[plugin]))
    if plugin.failed is None and code not in (0, 5):
        plugin.failed = "(import)", f"pytest ended with {code}"
    return plugin.answer()


def _forked(job: dict[str, Any], run: Callable[[], dict[str, Any]]) -> dict[str, Any]:
    """Run a job in a child; the outcome is "time" if it does not end."""
    with tempfile.TemporaryDirectory(prefix="mutant-") as folder:
        answer, log = Path(folder) / "answer.json", Path(folder) / "log"
        began = time.monotonic()
        child = os.fork()
        if child == 0:
            os.setpgid(0, 0)  # one group to end, in the session of the harness
            os.environ["TMPDIR"] = tempfile.tempdir = folder
            limit = int(job["limit_s"])
            resource.setrlimit(resource.RLIMIT_CPU, (limit, limit + 5))
            out = os.open(log, os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
            for one in (1, 2):
                os.dup2(out, one)
            os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
            try:
                answer.write_text(json.dumps(run()))
            except BaseException:
                traceback.print_exc()
            finally:
                sys.stderr.flush()
                os._exit(0)
        status = None
        while status is None:
            done, found = os.waitpid(child, os.WNOHANG)
            if done:
                status = found
            elif time.monotonic() - began > 20 * job["limit_s"] + 120:
                break
            else:
                time.sleep(0.05)
        with contextlib.suppress(ProcessLookupError, PermissionError):
            os.killpg(child, signal.SIGKILL)  # and what it started
        if status is None:
            os.waitpid(child, 0)
        used = resource.getrusage(resource.RUSAGE_CHILDREN)
        if answer.exists() and answer.stat().st_size:
            result = json.loads(answer.read_text())
        else:
            ends = (signal.SIGKILL, signal.SIGXCPU)
            late = status is None or (os.WIFSIGNALED(status) and os.WTERMSIG(status) in ends)
            tail = log.read_text(errors="replace")[-2000:] if log.exists() else ""
            result = {"outcome": "time" if late else "crash", "test": "", "error": tail, "ran": 0}
        return {**result, "children_s": used.ru_utime + used.ru_stime}


def _prepare(mode: str, place: Path, fresh: bool = False, changed_file: str = "") -> None:
    """Let the laws run without Numba; or use the checkout's cache of drivers, without writing into it."""
    import numpy as np

    from tlf_env.numerics import compiled

    if mode == "python":
        from tlf_env.numerics import memory, trig

        def fetch_add(numbers: Any, amount: int) -> int:
            old = int(numbers.flat[0])
            numbers.flat[0] += amount
            return old

        def plain(function: Any, *_: Any, **__: Any) -> Any:
            function.py_func = function
            return function

        def shaped(array: Any, rows: int, columns: int) -> Any:
            return array.reshape(-1)[: rows * columns].reshape(rows, columns)

        compiled.fetch_add, compiled._inner = fetch_add, plain
        memory.table, memory.shaped = lambda rows, columns: np.empty((rows, columns)), shaped
        memory.prefetch = lambda *_: None
        trig.bits_of = lambda number: struct.unpack("<q", struct.pack("<d", number))[0]
        trig.float_of = lambda bits: struct.unpack("<d", struct.pack("<q", bits))[0]
        np.seterr(all="ignore")
    elif fresh:
        compiled.sources_digest = lambda: f"mutant-{os.getpid()}"
        _keep_nothing()
    else:
        unchanged, drivers = os.environ["MUTANTS_DIGEST"], os.environ["MUTANTS_DRIVERS"]
        compiled.sources_digest = lambda: unchanged
        made = compiled._Locator.__init__

        def of_the_unchanged(self: Any, function: Any, file: str) -> None:
            made(self, function, file.replace(str(place), drivers))

        compiled._Locator.__init__ = of_the_unchanged
        if place != ROOT:
            _compile_anew(place / changed_file)
            _keep_nothing()


def _compile_anew(file: Path) -> None:
    """Take no driver of this file from the cache."""
    from tlf_env.numerics import compiled

    made, load = compiled._Cache.__init__, compiled._Cache._load

    def init(self: Any, function: Any) -> None:
        made(self, function)
        self.stale = function.__code__.co_filename == str(file)

    compiled._Cache.__init__ = init
    compiled._Cache._load = lambda self, *key: None if self.stale else load(self, *key)


def _keep_nothing() -> None:
    from tlf_env.numerics import compiled

    compiled._Cache.save_overload = lambda *_: None
    compiled._Cache._lock = lambda _: False


class _TooLong(BaseException):
    pass


class _Plugin:
    """Orders the tests of one run, notes the first that fails, and, for a map, what each calls."""

    def __init__(
        self, mode: str, mapping: bool = False, patience: float = 1.0, order: Sequence[str] = ()
    ) -> None:
        self.order = {test: i for i, test in enumerate(order)}
        self.map = mapping
        self.mode = mode
        self.patience = patience
        self.failed: tuple[str, str] | None = None
        self.ran = 0
        self.tests: dict[str, Any] = {}
        self.called: set[str] = set()
        self.began = 0.0
        self.used: Counter[str] = Counter()
        self.names: dict[Any, str | None] = {}
        _keep_nothing()

    def answer(self) -> dict[str, Any]:
        """What the run found."""
        if self.map:
            return {"outcome": "map", "tests": self.tests}
        if self.failed is None:
            return {"outcome": "survived", "test": "", "error": "", "ran": self.ran}
        return {
            "outcome": "killed",
            "test": self.failed[0],
            "error": self.failed[1],
            "ran": self.ran,
        }

    def pytest_collection_modifyitems(self, items: list[Any]) -> None:
        if self.order:
            items[:] = sorted(
                (one for one in items if one.nodeid in self.order),
                key=lambda one: self.order[one.nodeid],
            )

    def pytest_collectreport(self, report: Any) -> None:
        if report.failed and self.failed is None:
            self.failed = f"(import of {report.nodeid})", str(report.longrepr)[-1500:]

    def pytest_runtest_setup(self, item: Any) -> None:
        used = self.used[item.nodeid.partition("::")[0]]
        if self.map and used > self.patience * LONGEST_FILE_S[self.mode]:
            import pytest

            pytest.skip("the file takes too long")

    def pytest_runtest_logreport(self, report: Any) -> None:
        if report.failed and self.failed is None:
            self.failed = report.nodeid, str(report.longrepr)[-1500:]
        self.ran += report.when == "call"
        if self.map:
            test = self.tests.setdefault(report.nodeid, {"passed": False})
            if report.when == "call":
                test["passed"] = report.passed
            elif not report.passed:
                test["passed"] = False

    def pytest_runtest_logstart(self, nodeid: str) -> None:
        if self.map:
            self.called = set()
            self.began = time.process_time()
            signal.signal(signal.SIGPROF, self._stop)
            signal.setitimer(signal.ITIMER_PROF, self.patience * STOP_S[self.mode])
            sys.setprofile(self._note)

    def pytest_runtest_logfinish(self, nodeid: str) -> None:
        if self.map:
            sys.setprofile(None)
            signal.setitimer(signal.ITIMER_PROF, 0)
            used = time.process_time() - self.began
            self.used[nodeid.partition("::")[0]] += used
            test = self.tests.setdefault(nodeid, {"passed": False})
            test |= {"seconds": round(used, 4), "calls": sorted(self.called)}

    def _stop(self, *_: Any) -> None:
        raise _TooLong

    def _note(self, frame: Any, event: str, _: Any) -> None:
        if event != "call":
            return
        code = frame.f_code
        if code not in self.names:
            parts = Path(code.co_filename).parts
            inside = "tlf_env" in parts and parts[-2] in ROOMS
            self.names[code] = (
                f"tlf_env/{parts[-2]}/{parts[-1]}::{code.co_qualname}" if inside else None
            )
        name = self.names[code]
        if name is not None:
            self.called.add(name)


# The controller


class Worker:
    """A process that runs tests in one way, started at its first job."""

    def __init__(self, mode: str, warm: bool, copy: Path, drivers: Path) -> None:
        self.mode, self.warm, self.copy, self.drivers = mode, warm, copy, drivers
        self.process: subprocess.Popen[str] | None = None
        self.before_s = 0.0

    def run(self, **job: Any) -> dict[str, Any]:
        """Do a job; the answer has the processor time that it took."""
        if self.process is None:
            environment = {
                **os.environ,
                "PYTHONPYCACHEPREFIX": str(self.copy / ".pycache"),
                "PYTHONHASHSEED": "0",
                "OMP_NUM_THREADS": "1",
                "NUMBA_DISABLE_JIT": "1" if self.mode == "python" else "0",
                "MUTANTS_DIGEST": sources_digest(),
                "MUTANTS_DRIVERS": str(self.drivers),
            }
            command = [sys.executable, str(Path(__file__)), "--worker", self.mode]
            self.process = subprocess.Popen(
                [
                    *command,
                    *("--copy", str(self.copy), "--tests", *FILES[self.mode]),
                    *(["--warm"] if self.warm else []),
                ],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                text=True,
                env=environment,
            )
            self.before_s = 0.0
        assert self.process.stdin
        assert self.process.stdout
        self.process.stdin.write(json.dumps({"map": False, "fresh": False, **job}) + "\n")
        self.process.stdin.flush()
        line = self.process.stdout.readline()
        answer: dict[str, Any] = (
            json.loads(line) if line else {"outcome": "broken", "error": "it has ended"}
        )
        if answer["outcome"] == "broken":
            raise SystemExit(f"the process that runs tests ({self.mode}) failed: {answer['error']}")
        now = answer.pop("children_s")
        answer["seconds"] = round(now - self.before_s, 2)
        self.before_s = now
        return answer

    def close(self) -> None:
        """End the process."""
        if self.process is not None:
            assert self.process.stdin
            self.process.stdin.close()
            self.process.wait()
            self.process = None


@functools.cache
def sources_digest() -> str:
    """What the cache of drivers of the checkout is named by."""
    code = "from tlf_env.numerics.compiled import sources_digest as d; print(d())"
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True
    )
    return done.stdout.strip()


def write(path: Path, text: str) -> None:
    """Replace a file as a whole."""
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.name}.{os.getpid()}")
    temporary.write_text(text, encoding="utf-8")
    temporary.replace(path)


def make_copy(copy: Path) -> None:
    """Bring the copy up to date; files that are the same keep their times, for the caches."""
    wanted = set()
    for top in COPIED:
        for source in sorted((ROOT / top).rglob("*")):
            if source.is_file() and "__pycache__" not in source.parts:
                wanted.add(source.relative_to(ROOT))
    wanted |= {Path(one.name) for one in ROOT.iterdir() if one.is_file()}
    for name in sorted(wanted):
        source, target = ROOT / name, copy / name
        if not target.exists() or target.read_bytes() != source.read_bytes():
            target.parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(source, target)
    for top in COPIED:
        for target in sorted((copy / top).rglob("*.py")):
            if target.relative_to(copy) not in wanted:
                target.unlink()


def digest_of(copy: Path, *names: str) -> str:
    """Of the contents of files and of all Python files in folders."""
    found = hashlib.sha256()
    for name in names:
        path = copy / name
        for one in sorted(path.rglob("*.py")) if path.is_dir() else [path]:
            found.update(one.read_bytes())
    return found.hexdigest()[:16]


def test_map(mode: str, copy: Path, warm: Worker, patience: float) -> dict[str, Any]:
    """Of each test that passes in time: the functions that it calls, and its processor time."""
    files = [f"tests/test_{stem}.py" for stem in FILES[mode]]
    missing = [file for file in files if not (ROOT / file).exists()]
    if missing:
        raise SystemExit(
            f"{missing[0]} is missing: mend the lists of files in {Path(__file__).name}"
        )
    path = copy / f".map-{mode}-{patience:g}.json"
    kept = json.loads(path.read_text()) if path.exists() else {}
    shared = digest_of(copy, "tlf_env", "tests/helpers.py", "tests/physics_helpers.py")
    digests = {file: f"{shared} {digest_of(copy, file)}" for file in files}
    stale = [file for file in files if kept.get(file, {}).get("digest") != digests[file]]
    for file in tqdm(stale, desc=f"tests, {mode}") if stale else ():
        answer = warm.run(
            map=True,
            limit_s=900,
            patience=patience,
            files=[file],
            out=str(copy / f".map-{mode}.partial"),
        )
        if answer["outcome"] != "map":
            raise SystemExit(f"{file} ({mode}) did not run to its end: {answer}")
        kept[file] = {"digest": digests[file], "tests": answer["tests"]}
        write(path, json.dumps(kept))
    return {
        name: test
        for file in files
        for name, test in kept[file]["tests"].items()
        if test["passed"] and test["seconds"] <= patience * LONGEST_TEST_S[mode]
    }


def chosen(tests: dict[str, Any], mutant: mutation.Mutant, most_s: float) -> list[str]:
    """Tests for a mutant: first those that call its function, then the others of their files."""

    def calls(name: str, test: dict[str, Any]) -> bool:
        if not mutant.inside and name.startswith(DEFAULTS):
            return True
        for one in test["calls"]:
            file, _, called = one.partition("::")
            if file == mutant.file and (
                not mutant.inside
                or called == mutant.function
                or called.replace(".<locals>", "") == mutant.function
                or called.startswith(f"{mutant.function}.")
            ):
                return True
        return False

    first = {name for name, test in tests.items() if calls(name, test)}
    files = {name.partition("::")[0] for name in first}
    others = {name for name in tests if name.partition("::")[0] in files} - first
    found, used = [], 0.0
    for group in (first, others):
        for name in _in_turn(group, tests):
            used += tests[name]["seconds"]
            if used > most_s:
                return found
            found.append(name)
    return found


def _in_turn(names: set[str], tests: dict[str, Any]) -> list[str]:
    """The shortest test of every file, then the second of every file, and so on."""
    seen: Counter[str] = Counter()
    ranked = []
    for name in sorted(names, key=lambda one: (tests[one]["seconds"], one)):
        file = name.partition("::")[0]
        ranked.append((seen[file], tests[name]["seconds"], name))
        seen[file] += 1
    return [name for *_, name in sorted(ranked)]


class Judge:
    """What runs the tests of a mutant until one fails."""

    def __init__(self, options: argparse.Namespace) -> None:
        self.copy, self.patience, self.again = options.copy, options.patience, options.again
        self.episodes, self.control = options.episodes, options.control
        drivers = options.drivers.resolve()
        self.warm = {mode: Worker(mode, True, self.copy, drivers) for mode in MODES}
        self.cold = {mode: Worker(mode, False, self.copy, drivers) for mode in MODES}
        self.maps = {
            mode: test_map(mode, self.copy, self.warm[mode], self.patience) for mode in MODES
        }

    def close(self) -> None:
        """End all processes."""
        for one in (*self.warm.values(), *self.cold.values()):
            one.close()

    def result(self, mutant: mutation.Mutant) -> dict[str, Any]:
        """A line for the file of results."""
        answer: dict[str, Any] = {"outcome": "no test", "test": "", "error": "", "mode": ""}
        seconds, ran = 0.0, 0
        for mode, found in self.runs(mutant):
            seconds, ran = seconds + found["seconds"], ran + found.get("ran", 0)
            answer = {**found, "mode": mode}
            if found["outcome"] != "survived":
                break
        error = answer["error"].strip().splitlines()
        return {
            "key": mutant.key,
            "function": mutant.function,
            "kind": mutant.kind,
            "before": mutant.before,
            "after": "(no change)" if self.control else mutant.after,
            "outcome": answer["outcome"],
            "mode": answer["mode"],
            "test": answer["test"],
            "error": error[-1][:160] if error else "",
            "tests_run": ran,
            "seconds": round(seconds, 1),
        }

    def runs(self, mutant: mutation.Mutant) -> Iterator[tuple[str, dict[str, Any]]]:
        """The ways to run tests, one after the other."""
        source = mutation.source_of(ROOT, mutant, COMPILING)
        law = mutant.compiled and mutant.inside
        has_drivers = "@driver\n" in source
        for mode in MODES:
            names = chosen(self.maps[mode], mutant, self.patience * MOST_TESTS_S[mode])
            if names and (mode == "python" or has_drivers or not law):
                yield mode, self.tests(mutant, source, mode, names)
        room = mutant.file.split("/")[1]
        stems = FRESH_OF.get(mutant.file, FRESH if room == "physics" else ())
        stems += EPISODES[room] if self.episodes else ()
        if mutant.compiled and stems and FILES["compiled"] and self.again and not self.control:
            with changed(self.copy, mutant.file, source):
                yield (
                    "fresh",
                    self.cold["compiled"].run(
                        files=[f"tests/test_{stem}.py" for stem in stems],
                        tests=[],
                        fresh=True,
                        file=mutant.file,
                        limit_s=900 if self.episodes else 150,
                    ),
                )

    def tests(
        self, mutant: mutation.Mutant, source: str, mode: str, names: list[str]
    ) -> dict[str, Any]:
        """Run tests with a change in memory, if that can be done, or else in the copy."""
        usual = sum(self.maps[mode][one]["seconds"] for one in names)
        job = {"tests": names, "limit_s": SLOWER * usual + self.patience * MORE_S}
        if self.control:
            return self.warm[mode].run(**job)
        job |= {"file": mutant.file}
        if mutant.inside and (mode == "python" or not mutant.compiled):
            answer = self.warm[mode].run(**job, source=source, function=mutant.function)
            if answer["outcome"] != "cold":
                return answer
        with changed(self.copy, mutant.file, source):
            files = sorted({one.partition("::")[0] for one in names})
            return self.cold[mode].run(**job | {"limit_s": job["limit_s"] + COLD_S}, files=files)


@contextlib.contextmanager
def changed(copy: Path, file: str, source: str) -> Iterator[None]:
    """The copy with another source of a file."""
    path = copy / file
    before, times = path.read_bytes(), path.stat()
    try:
        path.write_text(source, encoding="utf-8")
        os.utime(path, (time.time() + 10, time.time() + 10))  # not the file that a cache knows
        yield
    finally:
        path.write_bytes(before)
        os.utime(path, ns=(times.st_atime_ns, times.st_mtime_ns))


def save(path: Path, head: dict[str, Any], results: dict[str, dict[str, Any]]) -> None:
    """One line for each mutant."""
    lines = ",\n".join(json.dumps(one, ensure_ascii=False) for one in results.values())
    top = json.dumps(head, ensure_ascii=False)[:-1]
    write(path, f'{top}, "mutants": [\n{lines}\n]}}\n')


def report(results: list[dict[str, Any]]) -> str:
    """Shares of the two rooms, and the survivors."""
    lines = []
    for room in ROOMS:
        mine = [one for one in results if one["key"].startswith(f"tlf_env/{room}/")]
        counts = Counter(one["outcome"] for one in mine)
        alive = [one for one in mine if one["outcome"] in ALIVE]
        same = sum("equivalent" in one for one in alive)
        killed = len(mine) - len(alive)
        share = f"{100 * killed / (len(mine) - same):.1f} %" if len(mine) > same else "-"
        lines.append(
            f"{room}: {len(mine)} mutants, {killed} killed ({counts['time']} by the time limit), "
            f"{len(alive)} survived, {same} of them equivalent; killed of those that are not: {share}"
        )
    seconds = sum(one["seconds"] for one in results)
    lines.append(
        f"processor time: {seconds / 60:.0f} min, {seconds / max(len(results), 1):.1f} s a mutant"
    )
    for one in results:
        if one["outcome"] in ALIVE:
            why = f"  [{one['equivalent']}]" if "equivalent" in one else ""
            lines.append(
                f"  {one['key']} {one['function']}: {one['before']} -> {one['after']} ({one['outcome']}){why}"
            )
    return "\n".join(lines)


def main() -> None:
    """Draw mutants, judge each, and write a line for each."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument(
        "--sample", type=int, default=300, metavar="COUNT", help="number of mutants"
    )
    parser.add_argument("--seed", type=int, default=1, help="of the draw")
    parser.add_argument("--only", metavar="MODULE", default="", help="for example physics/friction")
    parser.add_argument(
        "--key", metavar="KEY", default="", help="one mutant, by its key in the results"
    )
    parser.add_argument(
        "--again", action="store_true", help="judge the survivors of a finished sample again"
    )
    parser.add_argument(
        "--episodes", action="store_true", help="with --again: compile survivors in full"
    )
    parser.add_argument(
        "--control", action="store_true", help="run the same tests without any change"
    )
    parser.add_argument("--report", action="store_true", help="show the results that there are")
    parser.add_argument("--out", type=Path, help="default: results/campaign/mutants-SEED.json")
    parser.add_argument("--copy", type=Path, default=Path(tempfile.gettempdir()) / "tlf-mutants")
    parser.add_argument(
        "--tests",
        nargs="+",
        metavar="STEM",
        help="only these files, for example friction, without Numba",
    )
    parser.add_argument(
        "--patience", type=float, default=1.0, help="factor on the times that tests may take"
    )
    parser.add_argument(
        "--drivers",
        type=Path,
        default=ROOT,
        metavar="CHECKOUT",
        help="with the same sources, whose drivers are compiled",
    )
    parser.add_argument("--worker", choices=MODES, help=argparse.SUPPRESS)
    parser.add_argument("--warm", action="store_true", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.tests:
        FILES.update(dict.fromkeys(MODES, ()) | {options.worker or "python": options.tests})
    if options.worker:
        worker(options.worker, options.warm, options.copy)
        return

    sources = [
        f"tlf_env/{room}/{one.name}"
        for room in ROOMS
        for one in sorted((ROOT / "tlf_env" / room).glob("*.py"))
    ]
    sources = [one for one in sources if options.only in one]
    pools = {one: mutation.mutants_of(ROOT, one, COMPILING) for one in sources}
    pools = {file: mutants for file, mutants in pools.items() if mutants}
    if not pools:
        raise SystemExit(
            f"--only {options.only}: no such module in tlf_env/physics and tlf_env/onboard"
        )
    lines = {file: len((ROOT / file).read_text().splitlines()) for file in pools}
    drawn = mutation.sample(pools, lines, options.sample, options.seed)
    if options.key:
        drawn = [one for pool in pools.values() for one in pool if one.key == options.key]
    word = f"-{options.only.replace('/', '-')}" if options.only else ""
    kind = "control" if options.control else "mutants"
    out = options.out or ROOT / "results" / "campaign" / f"{kind}-{options.seed}{word}.json"
    results: dict[str, Any] = {}
    if out.exists() and not options.key:
        results = {one["key"]: one for one in json.loads(out.read_text())["mutants"]}
    if options.report:
        print(report(list(results.values())))
        return

    make_copy(options.copy)
    judge = Judge(options)
    head = {"seed": options.seed, "sample": options.sample, "drawn": len(drawn)}

    def wanted(mutant: mutation.Mutant) -> bool:
        old = results.get(mutant.key)
        if options.again:
            return old is not None and old["outcome"] in ALIVE and "equivalent" not in old
        return old is None

    # First those that need no new import; each part in the order of the draw, so that a run that is stopped
    # has judged a random part of them.
    left = sorted((one for one in drawn if wanted(one)), key=lambda one: not one.inside)
    try:
        for mutant in tqdm(left, desc=kind):
            result = judge.result(mutant)
            results[mutant.key] = result
            if options.key:
                print(json.dumps(result, ensure_ascii=False, indent=1))
            else:
                save(out, head, results)
    except KeyboardInterrupt:
        print("stopped; the same command goes on from here")
    judge.close()
    if not options.key:
        print(report(list(results.values())))


if __name__ == "__main__":
    main()
