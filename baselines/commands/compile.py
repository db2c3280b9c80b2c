"""``tlf compile``: put the step drivers into the cache of compiled code, in two processes side by side."""

from __future__ import annotations

import os
import signal
import threading
import time
from contextlib import suppress
from multiprocessing import get_context, parent_process
from multiprocessing.connection import Connection, wait
from typing import NamedTuple

from baselines.console import notes, screen


class Share(NamedTuple):
    """What one process compiles."""

    dtype: str  # of the scenario: each has drivers of its own
    of: tuple[str, ...]  # step, start, speed


# Each for two processes: what most runs need, and everything.
USUAL = (Share("float32", ("step",)), Share("float32", ("start",)))
ALL = (Share("float32", ("step", "start", "speed")), Share("float64", ("step", "start")))


def compile_drivers(shares: tuple[Share, ...] = USUAL) -> None:
    """Compile what is not in the cache yet, and print how long it took.

    Raises
    ------
    OSError
        if no folder for compiled code can be written, or a process failed.
    """
    from tlf_env.numerics.compiled import cache_folder

    folder = cache_folder()
    if folder is None:
        raise OSError(
            "no folder for compiled code can be written; the variable TLF_ENV_CACHE names another"
        )
    began = time.perf_counter()
    with notes.status("Compiling the step drivers"):
        anything = in_two_processes(shares)
    took_s = time.perf_counter() - began
    if anything:
        text = f"Compiled the step drivers in {took_s:.0f} s, into {folder}"
    else:
        text = f"All step drivers are in {folder}"
    screen.print(text, soft_wrap=True)


def in_two_processes(shares: tuple[Share, ...]) -> bool:
    """Compile both shares at the same time; whether anything had to be compiled.

    However this ends, no process is left behind.

    Raises
    ------
    ChildProcessError
        if a process failed or was ended.
    """
    context = get_context("spawn")
    processes = []
    running = {}
    try:
        for share in shares:
            answers, to_parent = context.Pipe(duplex=False)
            process = context.Process(target=compile_share, args=(share, to_parent), daemon=True)
            process.start()
            to_parent.close()
            processes.append(process)
            running[answers] = process
        anything = False
        while running:
            ready = wait(list(running))
            for answers in [one for one in running if one in ready]:
                process = running.pop(answers)
                try:
                    answer = answers.recv()
                except EOFError:
                    process.join()
                    answer = f"a process ended with status {process.exitcode}"
                if isinstance(answer, str):
                    raise ChildProcessError(f"the step drivers could not be compiled: {answer}")
                anything |= answer
        return anything
    finally:
        for process in processes:
            process.kill()
            process.join()


def compile_share(share: Share, to_parent: Connection) -> None:
    """Compile one share, in a process of its own; send whether anything had to be compiled, or an error."""
    signal.signal(
        signal.SIGINT, signal.SIG_IGN
    )  # the parent is interrupted, too, and ends this process
    threading.Thread(target=_end_with_parent, daemon=True).start()
    try:
        answer: bool | str = compiled(share)
    except Exception as error:
        answer = f"{type(error).__name__}: {error}"
    with suppress(BrokenPipeError):
        to_parent.send(answer)


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
