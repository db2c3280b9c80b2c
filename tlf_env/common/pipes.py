"""A process of its own that answers messages through its pipes.

Every message is a length, four bytes, unsigned and little-endian, and as many bytes. What the process sends is
data, and never unpickled.
"""

from __future__ import annotations

import contextlib
import os
import select
import signal
import struct
import subprocess
import tempfile
import time
import weakref
from collections.abc import Sequence
from pathlib import Path
from typing import IO

LENGTH = struct.Struct("<I")
END_LIMIT_S = 1.0  # for the end of the process, after its input has ended
LAST_WORDS = 2000  # bytes of its stderr that are searched for the last line
READ_AT_ONCE = 1 << 16  # bytes


class PipedProcess:
    """A program that answers each message with one; it ends with this object, and with its parent.

    Parameters
    ----------
    name
        What it is, for errors.
    command
        The program and its arguments.
    folder
        Its working directory; None: that of this process.
    keeps_errors
        Whether what it writes to stderr is kept, so that an error can repeat the last line of it. Otherwise it
        goes where the errors of this process go.

    Raises
    ------
    ValueError
        in one line, if the program cannot be started.
    """

    def __init__(
        self,
        name: str,
        command: Sequence[str],
        folder: Path | None = None,
        *,
        keeps_errors: bool = False,
    ) -> None:
        self.name = name
        self._received = bytearray()
        self._owner = os.getpid()
        self._errors = tempfile.TemporaryFile() if keeps_errors else None  # noqa: SIM115 - see _end
        try:
            self.process = subprocess.Popen(
                command,
                cwd=folder,
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=self._errors,
                bufsize=0,
                start_new_session=True,  # so that Ctrl-C ends it by the end of its input
            )
        except OSError as error:
            raise ValueError(f"{name}: cannot start {command[0]!r}: {error.strerror}") from error
        self.close = weakref.finalize(self, _end, self.process, self._errors, self._owner)
        assert self.process.stdin is not None
        assert self.process.stdout is not None
        self._to, self._from = self.process.stdin.fileno(), self.process.stdout.fileno()
        os.set_blocking(self._to, False)
        self._may_write, self._may_read = select.poll(), select.poll()
        self._may_write.register(self._to, select.POLLOUT)
        self._may_read.register(self._from, select.POLLIN)

    @property
    def is_open(self) -> bool:
        """Whether it can be asked: it has neither been closed nor failed to answer."""
        return self.close.alive

    def asked(self, data: bytes, limit_s: float, most: int, where: str, hint: str = "") -> bytes:
        """The answer to a message; the process is ended if there is none.

        Parameters
        ----------
        limit_s
            Time for the answer.
        most
            Bytes that the answer may have.
        where
            When this is, for errors, as ``"at step 3"``.
        hint
            What to say in addition of an answer that is too long.

        Raises
        ------
        ValueError
            in one line, if the process has ended, does not answer in time, or sends more than it may.
        """
        if os.getpid() != self._owner:
            raise ValueError(
                f"{self.name}: it belongs to another process, from which this one was forked"
            )
        if not self.is_open:
            raise ValueError(f"{self.name}: its process has been ended")
        until = time.monotonic() + limit_s
        try:
            self._write(LENGTH.pack(len(data)) + data, until)
            length = self._receive(LENGTH.size, until)
            if length <= most:
                self._receive(end := LENGTH.size + length, until)
                answer = bytes(self._received[LENGTH.size : end])
                del self._received[:end]
                return answer
            why = f"an answer of {length} bytes {where}; at most {most} are allowed{hint}"
        except TimeoutError:
            why = f"no answer within {limit_s:g} s {where}"
        except (BrokenPipeError, EOFError):
            why = f"{self._ending()} {where}{self._last_words()}"
        except BaseException:  # an interrupt: the answer would be taken for the next one
            self.close()
            raise
        self.close()
        raise ValueError(f"{self.name}: {why}")

    def _write(self, data: bytes, until: float) -> None:
        while data:
            try:
                data = data[os.write(self._to, data) :]
            except BlockingIOError:
                _wait_for(self._may_write, until)

    def _receive(self, count: int, until: float) -> int:
        """Wait for the first bytes of a message; its length."""
        received = self._received
        while len(received) < count:
            _wait_for(self._may_read, until)
            part = os.read(self._from, max(READ_AT_ONCE, count - len(received)))
            if not part:
                raise EOFError
            received += part
        length: int = LENGTH.unpack_from(received)[0]
        return length

    def _ending(self) -> str:
        try:
            status = self.process.wait(END_LIMIT_S)
        except subprocess.TimeoutExpired:
            return "the process closed its output"
        if status < 0 and -status in [*signal.Signals]:
            return f"the process was ended by {signal.Signals(-status).name}"
        return f"the process ended with status {status}"

    def _last_words(self) -> str:
        """The last line that the process wrote to stderr, if that is kept."""
        if self._errors is None:
            return ""
        size = self._errors.seek(0, os.SEEK_END)
        self._errors.seek(max(size - LAST_WORDS, 0))
        lines = self._errors.read().decode(errors="replace").split("\n")
        last = [" ".join(line.split()) for line in lines if line.strip()][-1:]
        return "".join(f": {line}" for line in last)

    def __reduce__(self) -> str:
        raise TypeError(
            f"{self.name} runs in a process of its own, which cannot be copied; take get_state() and give it "
            "to the set_state() of another environment"
        )


def _wait_for(ready: select.poll, until: float) -> None:
    """Wait until a pipe is ready, or has been closed at the other end."""
    if not ready.poll(max(until - time.monotonic(), 0.0) * 1000.0):
        raise TimeoutError


def _end(process: subprocess.Popen[bytes], errors: IO[bytes] | None, owner: int) -> None:
    """End a process: first its input ends, then it is killed, with what it has started in its session."""
    for pipe in (process.stdin, process.stdout):
        if pipe is not None:
            with contextlib.suppress(OSError):
                pipe.close()
    if os.getpid() == owner:  # in a fork it is no child, and goes on
        try:
            process.wait(END_LIMIT_S)
        except subprocess.TimeoutExpired:
            with contextlib.suppress(ProcessLookupError, PermissionError):
                os.killpg(process.pid, signal.SIGKILL)
            process.wait()
    if errors is not None:
        errors.close()
