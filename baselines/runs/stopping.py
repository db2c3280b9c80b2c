"""Being asked to stop: SIGTERM like Ctrl-C, and workers that stop with the command that started them."""

from __future__ import annotations

import os
import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from multiprocessing import parent_process, resource_tracker
from multiprocessing.connection import Connection, wait
from types import FrameType
from typing import Any

INTERRUPTED, TERMINATED = 130, 143  # exit status after SIGINT and after SIGTERM: 128 + the signal

AGAIN_S = 0.01  # after which a signal is sent again that came where no error can be raised

_terminated: list[int] = []
_interrupted: list[int] = []
_running: list[
    object
] = []  # what stands for the command that runs, inside of :func:`interruptible`
_timers: list[threading.Timer] = []  # that send a signal again


class Interrupted(KeyboardInterrupt):
    """SIGINT or SIGTERM.

    Python itself ends a process by SIGINT, whatever status it asks for, once a plain ``KeyboardInterrupt`` has
    passed a call of ``exec``, as many modules have where they are imported.

    A library in C may drop it, as it may drop every error. While a command runs the signal then comes again.
    """

    def __init__(self, number: int | None = None) -> None:
        super().__init__()
        self.number = number  # of the signal; None: it does not come again
        self._command = _running[-1] if _running else None

    def __del__(self) -> None:
        if self.number is not None and _running and _running[-1] is self._command:
            _again(self.number)


def taken(error: BaseException) -> None:
    """Note that an interrupt was acted on where it was caught, so that it does not come again."""
    if isinstance(error, Interrupted):
        error.number = None


def _again(number: int) -> None:
    """Send this process a signal, a little later."""
    timer = threading.Timer(AGAIN_S, os.kill, (os.getpid(), number))
    timer.daemon = True
    _timers.append(timer)
    timer.start()


@contextmanager
def interruptible() -> Iterator[None]:
    """Let SIGTERM end a command as Ctrl-C does: either raises :class:`Interrupted`.

    A handler other than Python's own is left alone, and so is a signal that is ignored. In a call whose errors
    Python drops the signal is put off; after one that has dropped it, it comes again.
    """
    report = sys.unraisablehook

    def interrupt(number: int, frame: FrameType | None) -> None:
        if drops_errors(frame):
            _again(number)
            return
        if number == signal.SIGTERM:
            _terminated.append(number)
        _interrupted.append(number)
        raise Interrupted(number)

    def dropped(unraisable: sys.UnraisableHookArgs) -> None:
        error = unraisable.exc_value
        if isinstance(error, Interrupted) and error.number is not None:
            _again(error.number)  # now: what reports errors may keep this one
            taken(error)
        else:
            report(unraisable)

    _terminated.clear()
    _interrupted.clear()
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    usual = {signal.SIGINT: signal.default_int_handler, signal.SIGTERM: signal.SIG_DFL}
    ours = {number: how for number, how in usual.items() if signal.getsignal(number) is how}
    try:
        for number in ours:
            signal.signal(number, interrupt)
        _running.append(object())
        sys.unraisablehook = dropped
        yield
    finally:
        sys.unraisablehook = report
        _running.clear()
        while _timers:
            _timers.pop().cancel()
        for number, how in ours.items():
            signal.signal(number, how)


@contextmanager
def no_other_error() -> Iterator[None]:
    """Let an error that an interrupt has become be the interrupt: a module in C has none but an ImportError."""
    try:
        yield
    except Exception as error:
        if _interrupted:
            raise Interrupted from error
        raise


def drops_errors(frame: FrameType | None) -> bool:
    """Whether an error that is raised in a frame may be dropped: in a finaliser of either kind, and in pymunk.

    pymunk's library calls Python to free a body, for example, whenever the garbage collector runs.
    """
    while frame is not None:
        module = str(frame.f_globals.get("__name__"))
        if frame.f_code.co_name == "__del__" or module.partition(".")[0] in ("pymunk", "weakref"):
            return True
        frame = frame.f_back
    return False


def stopped_status() -> int:
    """The exit status of a command that was interrupted."""
    return TERMINATED if _terminated else INTERRUPTED


@contextmanager
def starting_workers() -> Iterator[None]:
    """A process that is started in this block sees no SIGINT from its beginning; this one gets it afterwards.

    Ctrl-C reaches a worker, too, while it is still importing its modules, and would end it with a traceback.
    """
    resource_tracker.ensure_running()  # it is started with the first process, and unblocks SIGINT
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def stop_with_parent(stop: Connection, leave: Connection) -> None:
    """Let this worker end with its parent; the initializer of a pool of processes.

    Ctrl-C is left to the parent, which a terminal interrupts, too. When the parent closes its end of ``stop``
    the worker gets a SIGTERM, which ends it at once, or a training at its next checkpoint
    (:func:`interrupts`). When it closes its end of ``leave``, or is killed, the worker ends at once.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    parent = parent_process()
    assert parent is not None

    def watch() -> None:
        at_once: list[Any] = [parent.sentinel, leave]
        ready = wait([*at_once, stop])
        if not any(one in ready for one in at_once):
            os.kill(os.getpid(), signal.SIGTERM)
            wait(at_once)
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()


@contextmanager
def interrupts() -> Iterator[list[int]]:
    """A list that is not empty once SIGINT or SIGTERM was received; a second one ends at once.

    A worker ends after the block if it was asked to stop in it; it counts no second signal, as the pool
    of processes may send one. Outside the main thread, where no signal can be handled, the list stays empty.
    """
    came: list[int] = []
    worker = parent_process() is not None

    def handle(number: int, frame: FrameType | None) -> None:
        if came and not worker:
            raise Interrupted
        if number == signal.SIGTERM:
            _terminated.append(number)
        came.append(number)

    if threading.current_thread() is not threading.main_thread():
        yield came
        return
    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    handled = [number for number, how in before.items() if how is not signal.SIG_IGN]
    try:
        for number in handled:
            signal.signal(number, handle)
        yield came
    finally:
        for number in handled:
            signal.signal(number, before[number])
        if worker and came:
            signal.raise_signal(came[0])
