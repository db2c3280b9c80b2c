"""The program of a process that holds one environment, peer or ours, and times its steps.

It runs under the Python that has the environment, which need not be the one that runs ``tlf speed``, so this
module and those of the peers import nothing but the standard library, NumPy and the peer. Standard input and
output carry one JSON object a line; what a peer prints itself goes nowhere.
"""

from __future__ import annotations

import ctypes
import gc
import importlib
import json
import os
import sys
import time
from collections.abc import Callable, Iterable
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any, TextIO

# Steps so many times and returns the seconds; its attribute `compile_s`, if it has one, is the processor
# time that compiling the steps took.
Drive = Callable[[int], float]
MakeDrive = Callable[[int, int, int, int], Drive]  # robots, formations, threads, steps in one go

ONE_THREAD_OF_XLA = "--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1"
POOLS = ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NPROC")


def restrict(threads: int) -> None:
    """Keep this process to so many cores and threads; before numerical libraries are imported."""
    for name in POOLS:
        os.environ[name] = str(threads)
    os.environ["JAX_PLATFORMS"] = "cpu"
    if threads == 1:
        os.environ["XLA_FLAGS"] = ONE_THREAD_OF_XLA
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, sorted(os.sched_getaffinity(0))[-threads:])


def processor_s() -> float:
    """Processor time of this process and of those that it ran, s, the start of Python included."""
    found = os.times()
    return found.user + found.system + found.children_user + found.children_system


def memory_bytes(field: str) -> int | None:
    """A field of the system's report on this process, for example VmRSS or VmHWM; None if there is none."""
    try:
        report = Path("/proc/self/status").read_text(encoding="ascii")
    except OSError:
        return None
    lines = [line for line in report.splitlines() if line.startswith(f"{field}:")]
    return int(lines[0].split()[1]) * 1024 if lines else None


def forget_peak() -> None:
    """Let the largest resident memory of this process, VmHWM, begin anew, without unused pages."""
    gc.collect()
    try:
        ctypes.CDLL(None).malloc_trim(0)  # of glibc
        Path("/proc/self/clear_refs").write_text("5", encoding="ascii")
    except (OSError, AttributeError):
        pass


class Server:
    """Makes drives of one environment and uses them, as it is asked."""

    def __init__(self, factory: str, robots: int, threads: int, packages: Iterable[str]) -> None:
        module, _, function = factory.partition(":")
        begun = processor_s()
        self.make: MakeDrive = getattr(importlib.import_module(module), function)
        self.import_s = processor_s() - begun
        self.robots, self.threads, self.packages = robots, threads, packages
        self.drives: dict[int, Drive] = {}

    def answer(self, request: dict[str, Any]) -> dict[str, Any]:
        """The answer to a request; its key ``do`` names a method."""
        methods: dict[str, Callable[..., dict[str, Any]]] = {
            "about": self.about,
            "make": self.made,
            "drive": self.driven,
            "memory": self.memory,
        }
        return methods[request.pop("do")](**request)

    def about(self) -> dict[str, Any]:
        """Versions, and the processor time of the imports."""
        found = {}
        for package in self.packages:
            try:
                found[package] = version(package)
            except PackageNotFoundError:
                continue
        return {"versions": found, "import_s": self.import_s}

    def made(self, formations: int, at_once: int) -> dict[str, Any]:
        """Make so many formations, and compile what steps them."""
        self.drives[formations] = drive = self.make(self.robots, formations, self.threads, at_once)
        return {"compile_s": getattr(drive, "compile_s", 0.0)}

    def driven(self, formations: int, steps: int) -> dict[str, Any]:
        """Wall-clock time of so many steps, and the processor time of the whole process."""
        return {"seconds": self.drives[formations](steps), "processor_s": processor_s()}

    def memory(self, formations: int, steps: int) -> dict[str, Any]:
        """Resident memory after so many steps, and the largest while they are taken."""
        forget_peak()
        self.drives[formations](steps)
        return {"resident": memory_bytes("VmRSS"), "peak": memory_bytes("VmHWM")}


def serve(requests: Iterable[str], answers: TextIO, make: Callable[[], Server]) -> None:
    """Answer requests until they end; an error is an answer, too, and the last if nothing could be made."""
    server: Server | None = None
    for line in requests:
        try:
            server = server or make()
            answer = server.answer(json.loads(line))
        except Exception as error:
            answer = {"error": f"{type(error).__name__}: {' '.join(str(error).split())}"}
        answers.write(json.dumps(answer) + "\n")
        answers.flush()


def main() -> None:
    """Serve an environment: ``FACTORY ROBOTS THREADS PACKAGES``, the last separated by commas."""
    factory, robots, threads, packages = sys.argv[-4:]
    restrict(int(threads))
    answers = os.fdopen(os.dup(1), "w", encoding="utf-8")
    nowhere = os.open(os.devnull, os.O_WRONLY)
    for stream in (1, 2):
        os.dup2(nowhere, stream)
    serve(
        sys.stdin,
        answers,
        lambda: Server(
            factory, int(robots), int(threads), [one for one in packages.split(",") if one]
        ),
    )


def timed(step: Callable[[], Any], steps: int) -> float:
    """Wall-clock time of so many calls, s."""
    start = time.perf_counter()
    for _ in range(steps):
        step()
    return time.perf_counter() - start
