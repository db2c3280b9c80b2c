"""``tlf compile``: put the step drivers into the cache of compiled code, in two processes side by side."""

from __future__ import annotations

import os
import signal
import threading
import time
from contextlib import suppress
from multiprocessing import get_context, parent_process
from multiprocessing.connection import Connection, wait
from typing import Any, NamedTuple

from numba.core.event import Event, Listener, install_listener

from baselines.console import notes, progress_bar, screen
from baselines.runs.stopping import starting_workers
from tlf_env.numerics.compiled import cache_folder


class Share(NamedTuple):
    """What one process compiles."""

    dtype: str  # of the scenario: each has drivers of its own
    of: tuple[str, ...]  # step, start, speed
    work: int  # how much that is, for the progress bar: functions, and what their drivers count for


# Optimising a driver as a whole takes about half as long as compiling the functions inside it.
DRIVER_FOR_FUNCTION = 0.5
# Each for two processes: what most runs need, and everything.
USUAL = (Share("float32", ("step",), 624), Share("float32", ("start",), 123))
ALL = (Share("float32", ("step", "start", "speed"), 682), Share("float64", ("step", "start"), 668))


def compile_drivers(shares: tuple[Share, ...] = USUAL) -> None:
    """Compile what is not in the cache yet, and print how long it took.

    Raises
    ------
    OSError
        if no folder for compiled code can be written, or a process failed.
    """
    folder = cache_folder()
    if folder is None:
        raise OSError(
            "no folder for compiled code can be written; the variable TLF_ENV_CACHE names another"
        )
    began = time.perf_counter()
    anything = in_two_processes(shares)
    took_s = time.perf_counter() - began
    if anything:
        text = f"Compiled the step drivers in {took_s:.0f} s, into {folder}"
    else:
        text = f"All step drivers are in {folder}"
    screen.print(text, soft_wrap=True)


def compile_before_first_run() -> None:
    """Compile what most runs need, if this machine has never done so."""
    folder = cache_folder()
    if folder is not None and any(folder.rglob("*control_step*.nbi")):
        return
    notes.print("Compiling the step drivers, once on this machine: about half a minute.")
    if folder is not None:  # otherwise the run compiles them itself, and nothing is kept
        in_two_processes(USUAL)


class Stage(NamedTuple):
    """How far a process is."""

    driver: str  # that it works on
    work: float  # done so far, as in a share


def in_two_processes(shares: tuple[Share, ...]) -> bool:
    """Compile both shares at the same time, with a progress bar; whether anything had to be compiled.

    However this ends, no process is left behind.

    Raises
    ------
    ChildProcessError
        if a process failed or was ended.
    """
    context = get_context("spawn")
    processes = []
    running: dict[Any, Any] = {}
    try:
        for share in shares:
            answers, to_parent = context.Pipe(duplex=False)
            process = context.Process(target=compile_share, args=(share, to_parent), daemon=True)
            with starting_workers():
                process.start()
            to_parent.close()
            processes.append(process)
            running[answers] = process
        stages: dict[Any, Stage] = {}
        anything = False
        with progress_bar("Compiling") as update:
            while running:
                ready = wait(list(running))
                for answers in [one for one in running if one in ready]:
                    answer = received(answers, running[answers])
                    if isinstance(answer, Stage):
                        stages[answers] = answer
                    else:
                        anything |= answer
                        del running[answers]
                now = ", ".join(stages[one].driver for one in running if one in stages)
                done = round(sum(one.work for one in stages.values()))
                update(done, max(done, sum(share.work for share in shares)), f"Compiling {now}")
        return anything
    finally:
        for process in processes:
            process.kill()
            process.join()


def received(answers: Connection, process: Any) -> Stage | bool:
    """What a process sent: how far it is, or at its end whether anything had to be compiled.

    Raises
    ------
    ChildProcessError
        if it sent an error, or ended without a word.
    """
    try:
        answer = answers.recv()
    except EOFError:
        process.join()
        answer = f"a process ended with status {process.exitcode}"
    if isinstance(answer, str):
        raise ChildProcessError(f"the step drivers could not be compiled: {answer}")
    return answer


def compile_share(share: Share, to_parent: Connection) -> None:
    """Compile one share, in a process of its own; send whether anything had to be compiled, or an error."""
    signal.signal(
        signal.SIGINT, signal.SIG_IGN
    )  # the parent is interrupted, too, and ends this process
    threading.Thread(target=_end_with_parent, daemon=True).start()
    try:
        with install_listener("numba:compile", _Counted(to_parent)):
            answer: bool | str = compiled(share)
    except Exception as error:
        answer = f"{type(error).__name__}: {error}"
    with suppress(BrokenPipeError):
        to_parent.send(answer)


class _Counted(Listener):
    """Sends the stage of a process whenever Numba has compiled a function."""

    def __init__(self, to_parent: Connection) -> None:
        self._to_parent = to_parent
        self._nested: list[
            str
        ] = []  # a driver, and the functions inside it, down to the present one
        self._inside = 0  # functions compiled for this driver
        self._work = 0.0

    def on_start(self, event: Event) -> None:
        self._nested.append(event.data["dispatcher"].py_func.__name__)

    def on_end(self, event: Event) -> None:
        driver = self._nested[0]
        self._nested.pop()
        self._inside += 1
        self._work += 1
        if not self._nested:
            self._work += DRIVER_FOR_FUNCTION * self._inside
            self._inside = 0
        with suppress(BrokenPipeError):
            self._to_parent.send(Stage(driver, self._work))


def compiled(share: Share) -> bool:
    """Compile one share in this process; whether anything had to be compiled."""
    from baselines.speed.parts import compile_timed
    from tlf_env.engine.batch import BatchPlant

    plant = BatchPlant("infinity", 1, dtype=share.dtype)
    how = {
        "step": plant.compile_step,
        "start": plant.compile_start,
        "speed": lambda: compile_timed(plant),
    }
    answers = [how[what]() for what in share.of]  # all of them, whatever the first one says
    return any(answers)


def _end_with_parent() -> None:
    """End this process when its parent is killed."""
    parent = parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)
