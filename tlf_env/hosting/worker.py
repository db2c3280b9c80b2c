"""The process in which code of others runs: it answers the messages of :mod:`tlf_env.hosting.host`."""

from __future__ import annotations

import os
import sys
import threading
import time
import traceback
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from tlf_env.common.pipes import LENGTH, READ_AT_ONCE
from tlf_env.hosting.crew import (
    LOOP_SIZE,
    MESSAGE_SIZE,
    READING_SIZE,
    Crew,
    part_text,
)
from tlf_env.hosting.messages import (
    CALL,
    DONE,
    ESTIMATE,
    OBSERVE,
    REFUSED,
    TORQUE,
    decoded,
    encoded,
)
from tlf_env.onboard.memory import caller_state, give_caller_state
from tlf_env.onboard.parts import Factory, load_part, make_part, predicted
from tlf_env.physics.vehicle import RobotParameters

LOOKED_EVERY_S = 1.0  # whether the simulation's process is still there
OWN = ("tlf_env", "baselines")  # packages whose frames are not the place of an error
Numbers = Mapping[str, np.ndarray]


class CodeError(ValueError):
    """Code of others has raised an error; the message says where, and which."""


def raised(what: str, error: BaseException) -> CodeError:
    """An error of code of others in one line, with its kind and the line that raised it."""
    text = " ".join(str(error).split())
    kind = type(error).__name__
    frames = traceback.extract_tb(error.__traceback__)
    place = f" ({Path(frames[-1].filename).name}, line {frames[-1].lineno})" if frames else ""
    return CodeError(f"{what} raised {kind}{f': {text}' if text else ''}{place}")


class GuardedCrew(Crew):
    """A crew whose errors name role, robot and method."""

    def called(self, role: str, robot: int, part: Any, method: str, *given: Any) -> Any:
        """As :meth:`Crew.called`."""
        try:
            return getattr(part, method)(*given)
        except (Exception, SystemExit) as error:
            what = part_text(role, self._names[role], robot)
            raise raised(f"{what}: {method}()", error) from error


def guarded(what: str, factory: Factory) -> Factory:
    """A factory whose errors say what could not be made; a TypeError is that of :func:`make_part`."""

    def make(*given: Any) -> Any:
        try:
            return factory(*given)
        except TypeError:
            raise
        except (Exception, SystemExit) as error:
            raise raised(f"{what}: its factory", error) from error

    return make


class Parts:
    """Answers for parts of some roles."""

    def __init__(
        self, paths: Mapping[str, str], periods_s: Mapping[str, float], robots: Sequence[Any]
    ) -> None:
        factories = {
            role: guarded(f"{role} {path!r}", load_part(role, path, trust=True))
            for role, path in paths.items()
        }
        models = [RobotParameters.model_validate(robot) for robot in robots]
        self._crew = GuardedCrew(factories, paths, periods_s, models)

    def start(self, numbers: Numbers, widths_mm: Sequence[float]) -> None:
        """Make and start all parts."""
        self._crew.start(widths_mm, numbers["poses"])

    def state(self, numbers: Numbers, role: str) -> tuple[Any, Numbers]:
        """The states of the parts of a role."""
        arrays: dict[str, np.ndarray] = {}
        return self._crew.get_state(role, arrays), arrays

    def restore(self, numbers: Numbers, trees: Any, widths_mm: Sequence[float]) -> None:
        """Make parts with these states, beside those that are at work."""
        self._crew.restore(trees, numbers, widths_mm, numbers["poses"])

    def go_on(self, numbers: Numbers) -> None:
        """Go on with the parts of :meth:`restore`."""
        self._crew.go_on()

    def numbers(self, kind: bytes, data: bytes) -> np.ndarray:
        """The answer to a message of numbers."""
        if kind == ESTIMATE:
            return self._crew.estimate(np.frombuffer(data, "<f8").reshape(-1, READING_SIZE).copy())
        size, act = {
            TORQUE: (LOOP_SIZE, self._crew.torque),
            OBSERVE: (MESSAGE_SIZE + 1, self._crew.observe),
        }[kind]
        count = len(data) // (8 * (size + 1))
        robots = np.frombuffer(data, "<i8", count).tolist()
        return act(robots, np.frombuffer(data, "<f8", offset=8 * count).reshape(count, size).copy())


class Policy:
    """Answers for a policy."""

    def __init__(
        self, role: str, name: str, code: str, own: bool, given: Sequence[Any], about: str | None
    ) -> None:
        self._what = f"{role} {name!r}"
        factory = load_part(role, code, trust=True)
        if own:  # a factory of the package, whose errors say all
            self._policy = factory(*given)
        else:
            self._policy = make_part(role, name, guarded(self._what, factory))
        self.facts = load_part(role, about, trust=True)(self._policy) if about else {}
        self._states: dict[int, Any] = {}
        self._next = 1

    def tell(self, numbers: Numbers, code: str, given: Sequence[Any]) -> Any:
        """What a function of the package answers, called with the policy."""
        return load_part("policy", code, trust=True)(self._policy, *given)

    def predict(
        self,
        numbers: Numbers,
        state: int | None,
        deterministic: bool,
        shape: Sequence[int],
        forgotten: Sequence[int],
    ) -> tuple[Any, Numbers]:
        """Actions, and the number of the state."""
        before = self._state(state)
        for number in forgotten:
            self._states.pop(number, None)
        seen, starts = numbers["observation"], numbers.get("episode_start")
        try:
            answer = self._policy.predict(seen, before, starts, deterministic)
        except (Exception, SystemExit) as error:
            raise raised(f"{self._what}: predict()", error) from error
        actions, after = predicted(answer, tuple(shape), self._what)
        return self._kept(after), {"actions": actions}

    def _state(self, number: int | None) -> Any:
        return None if number is None else self._states[number]

    def _kept(self, state: Any) -> int | None:
        if state is None:
            return None
        number, self._next = self._next, self._next + 1
        self._states[number] = state
        return number

    def get_state(
        self, numbers: Numbers, what: str, name: str, state: int | None
    ) -> tuple[Any, Numbers]:
        """What the policy remembers."""
        arrays: dict[str, np.ndarray] = {}
        return caller_state(self._policy, what, name, arrays, self._state(state)), arrays

    def set_state(self, numbers: Numbers, what: str, tree: Any) -> int | None:
        """Give the policy what it remembers; the number of its state."""
        return self._kept(give_caller_state(self._policy, tree, what, numbers))

    def numbers(self, kind: bytes, data: bytes) -> np.ndarray:
        """No message of numbers is for a policy."""
        raise KeyError(kind)


class Service:
    """Answers messages: the first call makes what answers the others."""

    def __init__(self) -> None:
        self._served: Any = None

    def answer(self, message: bytes) -> bytes:
        """The answer to a message: the result, or the text of an error."""
        kind = message[:1]
        try:
            if kind == CALL:
                (call, arguments), numbers = decoded(message[1:])
                found = self._begin(call, arguments) if self._served is None else None
                if found is None:
                    found = getattr(self._served, call)(numbers, **arguments)
                return DONE + (encoded(*found) if isinstance(found, tuple) else encoded(found))
            rows: np.ndarray = self._served.numbers(kind, message[1:])
            return DONE + rows.astype("<f8", copy=False).tobytes()
        except ValueError as error:
            return REFUSED + " ".join(str(error).split()).encode(errors="replace")
        except (Exception, SystemExit) as error:
            return REFUSED + str(raised("code in a process of its own", error)).encode(
                errors="replace"
            )

    def _begin(self, call: str, arguments: Mapping[str, Any]) -> Any:
        makers: dict[str, Callable[..., Any]] = {"load": Parts, "make": Policy}
        self._served = makers[call](**arguments)
        return getattr(self._served, "facts", {})


def serve(requests: int, answers: int) -> None:
    """Answer the messages that come through one pipe through another, until there are no more."""
    service, received = Service(), bytearray()
    while True:
        end = LENGTH.size
        while len(received) < end or len(received) < (end := LENGTH.size + _length(received)):
            part = os.read(requests, max(READ_AT_ONCE, end - len(received)))
            if not part:
                return
            received += part
        answer = service.answer(bytes(received[LENGTH.size : end]))
        del received[:end]
        data = LENGTH.pack(len(answer)) + answer
        while data:
            data = data[os.write(answers, data) :]


def _length(received: bytearray) -> int:
    """Length of the message that begins here."""
    length: int = LENGTH.unpack_from(received)[0]
    return length


def end_with(parent: int) -> None:
    """End this process if its parent has ended, even in the midst of a call."""
    while os.getppid() == parent:
        time.sleep(LOOKED_EVERY_S)
    os._exit(1)


def main() -> None:
    """Serve the process that has started this one, through stdin and stdout.

    Both are taken away from the code that is served: what it prints goes to stderr, and it can read nothing.
    """
    sys.argv[1:] = []
    requests, answers = os.dup(0), os.dup(1)
    nothing = os.open(os.devnull, os.O_RDONLY)
    os.dup2(nothing, 0)
    os.close(nothing)
    os.dup2(2, 1)
    sys.stdout.reconfigure(line_buffering=True)  # type: ignore[union-attr]
    threading.Thread(target=end_with, args=(os.getppid(),), daemon=True).start()
    serve(requests, answers)
