"""Code of others in a process of its own, as seen from the simulation.

That process has a memory of its own: it sees what it is sent, and what it answers is checked. It has the rights
of the user, the same working directory and the same paths of modules. Whatever it prints goes to stderr.
"""

from __future__ import annotations

import sys
import weakref
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from tlf_env.common.errors import shown
from tlf_env.common.pipes import PipedProcess
from tlf_env.common.trust import Trust
from tlf_env.hosting.crew import (
    ESTIMATE_SIZE,
    REFERENCE_SIZE,
    WHEELS,
    answer_text,
    checked_estimates,
    part_text,
    prefix,
)
from tlf_env.hosting.messages import (
    CALL,
    DONE,
    ESTIMATE,
    NO_NUMBERS,
    OBSERVE,
    REFUSED,
    TORQUE,
    DamagedError,
    decoded,
    encoded,
)
from tlf_env.onboard.memory import caller_state, give_caller_state
from tlf_env.onboard.parts import finite, load_part, make_part, runs_apart
from tlf_env.physics.vehicle import RobotParameters

START_LIMIT_S = 60.0  # for the first answer, before which modules are imported
CALL_LIMIT_S = 60.0  # for every other answer
LONGEST_ERROR = 10_000  # bytes
LONGEST_CALL = 1 << 30  # bytes of an answer to a call; the longest are states for a snapshot
SHOWN_ERROR = 1000  # characters
# Modules are found as here, whatever the working directory is; `-P` keeps that one out until then.
BEGIN = "import sys; sys.path[:] = sys.argv[1:]; from tlf_env.hosting.worker import main; main()"


class Host:
    """A process that runs code of others; it is started when it is needed first, and ends with this object.

    Parameters
    ----------
    name
        What runs there, for errors.
    first
        The call that is made when the process has started, and its arguments.
    """

    def __init__(self, name: str, first: tuple[str, Mapping[str, Any]]) -> None:
        self.name, self._first = name, first
        self._process: PipedProcess | None = None
        self.starts = 0  # of the process

    @property
    def pid(self) -> int | None:
        """Number of the process; None if there is none."""
        return self._process.process.pid if self.is_open and self._process is not None else None

    @property
    def is_open(self) -> bool:
        """Whether there is a process."""
        return self._process is not None and self._process.is_open

    def open(self) -> Any:
        """Start the process, if there is none; what its first call answers, or None.

        Raises
        ------
        ValueError
            in one line, if it cannot be started or refuses the first call.
        """
        if self.is_open:
            return None
        command = [sys.executable, "-P", "-c", BEGIN, *map(str, sys.path)]
        self._process = PipedProcess(self.name, command)
        self.starts += 1
        call, arguments = self._first
        try:
            return self.call(call, arguments, where="at the start", limit_s=START_LIMIT_S)[0]
        except ValueError:
            self.close()
            raise

    def call(
        self,
        call: str,
        arguments: Mapping[str, Any],
        numbers: Mapping[str, np.ndarray] = NO_NUMBERS,
        *,
        where: str,
        limit_s: float | None = None,
    ) -> tuple[Any, dict[str, np.ndarray]]:
        """What the process answers to a call: a JSON value and arrays.

        Raises
        ------
        ValueError
            as :meth:`numbers`.
        """
        data = self._asked(CALL + encoded([call, arguments], numbers), LONGEST_CALL, where, limit_s)
        try:
            return decoded(data)
        except DamagedError:
            raise self._damaged(where) from None

    def numbers(self, data: bytes, shape: tuple[int, int], where: str) -> np.ndarray:
        """The float64 numbers that the process answers to a message.

        Raises
        ------
        ValueError
            in one line, for what the code has done wrong; if the process has ended or does not answer in time;
            for an answer of another size.
        """
        answer = self._asked(data, 8 * shape[0] * shape[1], where)
        if len(answer) != 8 * shape[0] * shape[1]:
            raise self._damaged(where)
        return np.frombuffer(answer, "<f8").reshape(shape)

    def _asked(self, data: bytes, most: int, where: str, limit_s: float | None = None) -> bytes:
        if self._process is None or not self._process.is_open:
            raise ValueError(f"{self.name}: its process has ended; call reset() to start it again")
        limit_s = CALL_LIMIT_S if limit_s is None else limit_s
        answer = self._process.asked(data, limit_s, max(most, LONGEST_ERROR) + 1, where)
        if answer[:1] == REFUSED:
            text = " ".join(answer[1 : LONGEST_ERROR + 1].decode(errors="replace").split())
            raise ValueError(text if len(text) <= SHOWN_ERROR else f"{text[:SHOWN_ERROR]}...")
        if answer[:1] != DONE:
            raise self._damaged(where)
        return answer[1:]

    def _damaged(self, where: str) -> ValueError:
        """The error for an answer that is not as agreed; the process is ended."""
        self.close()
        return ValueError(f"{self.name}: an answer {where} that is not as agreed")

    def close(self) -> None:
        """End the process, if any."""
        if self._process is not None:
            self._process.close()


class HostedCrew:
    """Parts of some roles in a process of their own; used like a :class:`~tlf_env.hosting.crew.Crew`.

    Parameters
    ----------
    paths
        ``"module:factory"`` by role.
    periods_s
        By role.
    robots
        Of the formation, the leader first.

    Raises
    ------
    ValueError
        in one line, if a module cannot be imported, or lacks the factory.
    """

    def __init__(
        self,
        paths: Mapping[str, str],
        periods_s: Mapping[str, float],
        robots: Sequence[RobotParameters],
    ) -> None:
        self._paths, self._count = paths, len(robots)
        named = [f"{role.replace('_', ' ')} {path!r}" for role, path in paths.items()]
        first = {
            "paths": dict(paths),
            "periods_s": dict(periods_s),
            "robots": [robot.model_dump(mode="json") for robot in robots],
        }
        self.host = Host(" and ".join(named), ("load", first))
        self.host.open()

    def start(self, widths_mm: Sequence[float], poses: np.ndarray) -> None:
        """As :meth:`Crew.start`."""
        self.host.open()
        self.host.call(
            "start", {"widths_mm": list(widths_mm)}, {"poses": poses}, where="at the reset"
        )

    def used(self, role: str) -> list[int]:
        """As :meth:`Crew.used`."""
        return [*range(1 if role == "observer" else 0, self._count)]

    def estimate(self, rows: np.ndarray) -> np.ndarray:
        """As :meth:`Crew.estimate`."""
        shape = len(rows), ESTIMATE_SIZE
        where = "in update() of the estimators"
        found = self.host.numbers(ESTIMATE + rows.tobytes(), shape, where)
        return checked_estimates(found, self._count)

    def torque(self, robots: Sequence[int], rows: np.ndarray) -> np.ndarray:
        """As :meth:`Crew.torque`."""
        return self._of_robots("wheel_loop", TORQUE, robots, rows, WHEELS)

    def observe(self, robots: Sequence[int], rows: np.ndarray) -> np.ndarray:
        """As :meth:`Crew.observe`."""
        return self._of_robots("observer", OBSERVE, robots, rows, REFERENCE_SIZE)

    def _of_robots(
        self, role: str, kind: bytes, robots: Sequence[int], rows: np.ndarray, size: int
    ) -> np.ndarray:
        data = kind + np.array(robots, "<i8").tobytes() + rows.tobytes()
        where = f"in {answer_text(role, 0).rpartition(' ')[2]} of the {role.replace('_', ' ')}s"
        found = self.host.numbers(data, (len(rows), size), where)
        if not np.isfinite(found).all():
            for robot, row in zip(robots, found, strict=True):
                finite(row, size, answer_text(role, robot))
        return found

    def get_state(self, role: str, numbers: dict[str, np.ndarray]) -> list[Any]:
        """As :meth:`Crew.get_state`."""
        found, arrays = self.host.call(
            "state", {"role": role}, where=f"for the state of the {role}"
        )
        count = len(self.used(role))
        fits = isinstance(found, list) and len(found) == count
        if not fits or not all(name.startswith(prefix(role)) for name in arrays):
            raise ValueError(
                f"{part_text(role, self._paths[role], 0)}: a state that is not as agreed"
            )
        numbers |= arrays
        return list(found)

    def restore(
        self,
        trees: Mapping[str, Sequence[Any]],
        numbers: Mapping[str, np.ndarray],
        widths_mm: Sequence[float],
        poses: np.ndarray,
    ) -> None:
        """As :meth:`Crew.restore`."""
        self.host.open()
        own = tuple(prefix(role) for role in self._paths)
        given = {name: one for name, one in numbers.items() if name.startswith(own)}
        arguments = {"trees": dict(trees), "widths_mm": list(widths_mm)}
        self.host.call("restore", arguments, {**given, "poses": poses}, where="for their states")

    def go_on(self) -> None:
        """As :meth:`Crew.go_on`."""
        self.host.call("go_on", {}, where="for their states")

    def close(self) -> None:
        """End the process; the next reset starts another one."""
        self.host.close()


class Memory:
    """What a policy in another process has returned as its state, which stays there."""

    def __init__(self, number: int, start: int) -> None:
        self.number, self.start = number, start

    def __reduce__(self) -> str:
        raise TypeError("the state of a policy in a process of its own cannot be copied")


class HostedPolicy:
    """A policy in a process of its own, with SB3's ``predict``.

    Parameters
    ----------
    role
        As of :func:`~tlf_env.onboard.parts.make_part`.
    name
        Its name, for errors.
    action_size
        Entries of an action.
    code
        ``"module:factory"``; None: that is its name.
    given
        Arguments of the factory, JSON values.
    about
        ``"module:function"`` that returns what is to be known of the policy, as JSON values by name.

    Attributes
    ----------
    facts : dict
        What ``about`` has returned.

    Raises
    ------
    ValueError
        in one line, for code that cannot be imported, or makes no policy.
    """

    def __init__(
        self,
        role: str,
        name: str,
        action_size: int,
        *,
        code: str | None = None,
        given: Sequence[Any] = (),
        about: str | None = None,
    ) -> None:
        self._size, self._what = action_size, f"{role} {name!r}"
        self._forgotten: list[int] = []
        self._told: dict[str, Sequence[Any]] = {}
        first = {
            "role": role,
            "name": name,
            "code": name if code is None else code,
            "own": code is not None,
            "given": list(given),
            "about": about,
        }
        self.host = Host(self._what, ("make", first))
        facts = self.host.open()
        if not isinstance(facts, dict):
            self.close()
            raise ValueError(f"{self._what}: an answer at the start that is not as agreed")
        self.facts: dict[str, Any] = facts

    def predict(
        self,
        observation: np.ndarray,
        state: Any = None,
        episode_start: np.ndarray | None = None,
        deterministic: bool = True,
    ) -> tuple[np.ndarray, Any]:
        """Actions, float64, and the next state, which can only be given back.

        Raises
        ------
        ValueError
            in one line, for what the policy does wrong; if its process has ended or does not answer in time.
        """
        seen = np.asarray(observation)
        if episode_start is not None and not self.host.is_open and np.all(episode_start):
            state = (
                None  # an error has ended the process, and what it remembers is not needed any more
            )
        if state is None:
            self._open()
        numbers = {"observation": seen}
        if episode_start is not None:
            numbers["episode_start"] = np.asarray(episode_start)
        arguments = {
            "state": self._number_of(state),
            "deterministic": bool(deterministic),
            "shape": [*seen.shape[:-1], self._size],
            "forgotten": (forgotten := [*self._forgotten]),
        }
        del self._forgotten[: len(forgotten)]
        found, arrays = self.host.call("predict", arguments, numbers, where="in predict()")
        actions = arrays.get("actions")
        if actions is None or actions.dtype != np.float64:
            raise ValueError(f"{self._what}: an answer in predict() that is not as agreed")
        return actions, self._memory(found)

    def _number_of(self, state: Any) -> int | None:
        if state is None:
            return None
        if not isinstance(state, Memory) or state.start != self.host.starts:
            raise ValueError(
                f"{self._what}: a state that its process has not returned: {shown(state)}"
            )
        return state.number

    def _memory(self, number: Any) -> Memory | None:
        """What stands here for a state there; the next call tells the process that it is not used any more."""
        if number is None:
            return None
        if type(number) is not int:
            raise ValueError(f"{self._what}: a state that is not as agreed")
        memory = Memory(number, self.host.starts)
        weakref.finalize(memory, self._forgotten.append, number).atexit = False
        return memory

    def get_state(self, what: str, name: str, numbers: dict[str, np.ndarray], memory: Any) -> Any:
        """As :func:`~tlf_env.onboard.memory.caller_state`."""
        arguments = {"what": what, "name": name, "state": self._number_of(memory)}
        tree, arrays = self.host.call("get_state", arguments, where="for its state")
        fits = isinstance(tree, dict) and "memory" in tree
        if not fits or not all(one.startswith(f"{name}/") for one in arrays):
            raise ValueError(f"{self._what}: a state that is not as agreed")
        numbers |= arrays
        return tree

    def set_state(self, what: str, tree: Any, name: str, numbers: Mapping[str, np.ndarray]) -> Any:
        """As :func:`~tlf_env.onboard.memory.give_caller_state`."""
        self._open()
        given = {one: array for one, array in numbers.items() if one.startswith(f"{name}/")}
        arguments = {"what": what, "tree": tree}
        return self._memory(self.host.call("set_state", arguments, given, where="for its state")[0])

    def tell(self, code: str, *given: Any) -> Any:
        """What a function of the package, ``"module:function"``, answers when it is called with the policy.

        It is called again if the process has to be started again. Arguments and answer are JSON values.
        """
        self._told[code] = given
        return self._tell(code, given)

    def _tell(self, code: str, given: Sequence[Any]) -> Any:
        arguments = {"code": code, "given": list(given)}
        return self.host.call("tell", arguments, where="before the start")[0]

    def _open(self) -> None:
        """Start the process again, if an error has ended it."""
        if not self.host.is_open:
            self.host.open()
            self._forgotten = []
            for code, given in self._told.items():
                self._tell(code, given)

    def close(self) -> None:
        """End the process."""
        self.host.close()


def policy_state(
    policy: Any, what: str, name: str, numbers: dict[str, np.ndarray], memory: Any
) -> Any:
    """:func:`~tlf_env.onboard.memory.caller_state` of a policy here or in a process of its own."""
    if isinstance(policy, HostedPolicy):
        return policy.get_state(what, name, numbers, memory)
    return caller_state(policy, what, name, numbers, memory)


def give_policy_state(
    policy: Any, tree: Any, what: str, name: str, numbers: Mapping[str, np.ndarray]
) -> Any:
    """:func:`~tlf_env.onboard.memory.give_caller_state` of a policy here or in a process of its own."""
    if isinstance(policy, HostedPolicy):
        return policy.set_state(what, tree, name, numbers)
    return give_caller_state(policy, tree, what, numbers)


def named_policy(role: str, path: str, action_size: int, *, trust: Trust) -> Any:
    """The policy that ``"module:factory"`` names, here or in a process of its own.

    Raises
    ------
    ValueError
        in one line, if it cannot or may not be imported, or is no policy.
    """
    if runs_apart(path, trust):
        return HostedPolicy(role, path, action_size)
    return make_part(role, path, load_part(role, path, trust=trust))


def close_policy(policy: Any) -> None:
    """End the process of a policy, if it has one."""
    if isinstance(policy, HostedPolicy):
        policy.close()
