"""A competition's entry as a process of its own: observations go in and actions come out through pipes.

The messages are those of :mod:`tlf_env.common.pipes`. The first one in each direction is JSON; the others are
numbers, little-endian, row by row. ``docs/competition.md``.
"""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from tlf_env.common.errors import shown
from tlf_env.common.files import parse_json
from tlf_env.common.pipes import PipedProcess
from tlf_env.task.actions import ACTION_SIZE

PROTOCOL = 1
START_LIMIT_S = 60.0  # for the first answer
STEP_LIMIT_S = 1.0  # for the actions of one step
LONGEST_HELLO = 10_000  # bytes


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
        self._process = PipedProcess(name, [program, *command[1:]], folder, keeps_errors=True)
        self.close = self._process.close
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
        most = max(LONGEST_HELLO, 8 * ACTION_SIZE * self._shape[0])
        return self._process.asked(data, limit_s, most, where, " (print to stderr only)")
