"""A competition's entry as a process of its own: observations go in and actions come out through pipes.

Every message is a length, four bytes, unsigned and little-endian, and as many bytes. The first message
in each direction is JSON; the others are numbers, little-endian, row by row. ``docs/competition.md``.
"""

from __future__ import annotations

import contextlib
import json
import os
import select
import struct
import subprocess
import sys
import tempfile
import time
import weakref
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import IO, Any

import numpy as np

from tlf_env.common.errors import shown
from tlf_env.common.files import parse_json
from tlf_env.task.actions import ACTION_SIZE

PROTOCOL = 1
LENGTH = struct.Struct("<I")
START_LIMIT_S = 60.0  # for the first answer
STEP_LIMIT_S = 1.0  # for the actions of one step
LONGEST_HELLO = 10_000  # bytes
END_LIMIT_S = 1.0  # for the end of the process, after its input has ended
LAST_WORDS = 2000  # bytes of its stderr that are searched for the last line


class EntryProcess:
    """One run of an entry's program, for one episode.

    Parameters
    ----------
    name
        The entry's name, for errors.
    command
        The program and its arguments; ``python`` means the interpreter that runs this.
    folder
        Its working directory.
    hello
        The first message: what the entry needs to know of the interface.
    shape
        Robots and entries of an observation.

    Raises
    ------
    ValueError
        in one line, if the program cannot be started, ends, or does not answer in time and as agreed.
    """

    def __init__(
        self,
        name: str,
        command: Sequence[str],
        folder: Path,
        hello: Mapping[str, Any],
        shape: tuple[int, int],
    ) -> None:
        self._name, self._shape = name, shape
        self._type = np.dtype(hello["dtype"])
        self.step_times_s: list[float] = []
        program = sys.executable if command[0] == "python" else command[0]
        self._errors = tempfile.TemporaryFile()  # noqa: SIM115 - _end closes it, after the process
        try:
            self._process = subprocess.Popen(
                [program, *command[1:]],
                cwd=folder,
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=self._errors,
                bufsize=0,
                start_new_session=True,  # so that Ctrl-C ends it by the end of its input
            )
        except OSError as error:
            raise ValueError(f"{name}: cannot start {command[0]!r}: {error.strerror}") from error
        self.close = weakref.finalize(self, _end, self._process, self._errors)
        self._check_hello(self._asked(json.dumps(hello).encode(), START_LIMIT_S, "at the start"))

    def act(self, rows: np.ndarray) -> np.ndarray:
        """Actions ``(robot, 2)`` for the observations ``(robot, entry)`` of the next step.

        Raises
        ------
        ValueError
            if the process has ended or is too slow, and for an answer of another size or with a number that
            is not finite.
        """
        step = len(self.step_times_s)
        where = f"at step {step}"
        data = np.ascontiguousarray(rows, dtype=self._type).tobytes()
        began = time.perf_counter()
        answer = self._asked(data, STEP_LIMIT_S, where)
        self.step_times_s.append(time.perf_counter() - began)
        robots = self._shape[0]
        wanted = robots * ACTION_SIZE * self._type.itemsize
        if len(answer) != wanted:
            self.close()
            raise ValueError(
                f"{self._name}: an answer of {len(answer)} bytes {where}; {wanted} are needed, {robots} "
                f"robots × {ACTION_SIZE} numbers of {self._type.itemsize} bytes"
            )
        actions = np.frombuffer(answer, dtype=self._type).reshape(robots, ACTION_SIZE)
        if not np.isfinite(actions).all():
            self.close()
            robot = int(np.argmin(np.isfinite(actions).all(axis=1)))
            raise ValueError(
                f"{self._name}: the action of robot_{robot} {where} is {actions[robot].tolist()}; it must "
                "be finite"
            )
        return actions

    def _check_hello(self, answer: bytes) -> None:
        try:
            found = parse_json(answer)
        except ValueError:
            found = answer[:100]
        if found != {"protocol": PROTOCOL}:
            self.close()
            raise ValueError(
                f'{self._name}: the first answer must be {{"protocol": {PROTOCOL}}}, got {shown(found)}'
            )

    def _asked(self, data: bytes, limit_s: float, where: str) -> bytes:
        """The answer to a message; the process is ended if there is none."""
        until = time.monotonic() + limit_s
        most = max(LONGEST_HELLO, 8 * ACTION_SIZE * self._shape[0])
        try:
            self._write(LENGTH.pack(len(data)) + data, until)
            (length,) = LENGTH.unpack(self._read(LENGTH.size, until))
            if length <= most:
                return self._read(length, until)
            why = f"an answer of {length} bytes {where}; at most {most} are allowed (print to stderr only)"
        except TimeoutError:
            why = f"no answer within {limit_s:g} s {where}"
        except (BrokenPipeError, EOFError):
            why = f"{self._ending()} {where}{self._last_words()}"
        self.close()
        raise ValueError(f"{self._name}: {why}")

    def _write(self, data: bytes, until: float) -> None:
        pipe = self._process.stdin
        assert pipe is not None
        os.set_blocking(pipe.fileno(), False)
        while data:
            _, ready, _ = select.select([], [pipe], [], max(until - time.monotonic(), 0.0))
            if not ready:
                raise TimeoutError
            data = data[os.write(pipe.fileno(), data) :]

    def _read(self, count: int, until: float) -> bytes:
        pipe = self._process.stdout
        assert pipe is not None
        data = b""
        while len(data) < count:
            ready, _, _ = select.select([pipe], [], [], max(until - time.monotonic(), 0.0))
            if not ready:
                raise TimeoutError
            part = os.read(pipe.fileno(), count - len(data))
            if not part:
                raise EOFError
            data += part
        return data

    def _ending(self) -> str:
        try:
            status = self._process.wait(END_LIMIT_S)
        except subprocess.TimeoutExpired:
            return "the process closed its output"
        return f"the process ended with status {status}"

    def _last_words(self) -> str:
        """The last line that the process wrote to stderr."""
        size = self._errors.seek(0, os.SEEK_END)
        self._errors.seek(max(size - LAST_WORDS, 0))
        lines = self._errors.read().decode(errors="replace").split("\n")
        last = [" ".join(line.split()) for line in lines if line.strip()][-1:]
        return "".join(f": {line}" for line in last)


def _end(process: subprocess.Popen[bytes], errors: IO[bytes]) -> None:
    """End a process: first its input ends, then it is killed."""
    for pipe in (process.stdin, process.stdout):
        if pipe is not None:
            with contextlib.suppress(OSError):
                pipe.close()
    try:
        process.wait(END_LIMIT_S)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()
    errors.close()
