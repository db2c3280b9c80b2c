"""A formation's parts in Python, one object for each robot and role, called with rows of numbers.

Rows are float64, one for each robot that is called:

======================  ===============================================================================
:class:`ReadingRow`     what an estimator receives
:class:`EstimateRow`    what it returns
``(robot, 4)``          wanted and measured speeds of the wheels, rad/s; answered by torques, N·mm
``(message, time)``     what the predecessor broadcast, and a time, s; answered by a reference
======================  ===============================================================================
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from tlf_env.onboard.memory import give_state, state_of
from tlf_env.onboard.observer import Message, Reference
from tlf_env.onboard.parts import (
    Estimated,
    Factory,
    Readings,
    checked_estimate,
    finite,
    make_part,
)
from tlf_env.physics.vehicle import RobotParameters


class ReadingRow(NamedTuple):
    """Where the fields of :class:`~tlf_env.onboard.parts.Readings` are in a row."""

    t_s: int = 0
    steps_rad: slice = slice(1, 3)
    has_fix: int = 3  # 1 or 0
    fix_mm: slice = slice(4, 6)
    fix_t_s: int = 6
    gyro_rad_s: int = 7
    wanted_rad_s: slice = slice(8, 10)
    torques_Nmm: slice = slice(10, 12)


class EstimateRow(NamedTuple):
    """Where the fields of an :class:`~tlf_env.onboard.parts.Estimated` are in a row."""

    pose: slice = slice(0, 3)
    has_twist: int = 3  # 1 or 0
    twist: slice = slice(4, 6)
    slip: slice = slice(6, 8)
    covariance: slice = slice(8, 17)
    nis: int = 17


READING, ESTIMATE = ReadingRow(), EstimateRow()
READING_SIZE, ESTIMATE_SIZE = 12, 18
BESIDE = slice(8, 18)  # of an estimate: what may not be any finite number
WHEELS = 2
LOOP_SIZE = 2 * WHEELS  # wanted and measured speeds
MESSAGE_SIZE, REFERENCE_SIZE = len(Message._fields), len(Reference._fields)
METHOD = {"estimator": "update", "wheel_loop": "torque", "observer": "update"}


def with_axle_width(robot: RobotParameters, width_mm: float) -> RobotParameters:
    """The robot with the axle's width that its computer believes in."""
    if width_mm == robot.axle_width_mm:
        return robot
    return robot.model_copy(update={"axle_width_mm": width_mm})


def part_text(role: str, name: str, robot: int) -> str:
    """Role, name and robot of a part, for errors."""
    return f"{role.replace('_', ' ')} {name!r} of robot_{robot}"


def answer_text(role: str, robot: int) -> str:
    """What a part answers, for errors."""
    return f"robot_{robot}: the {role.replace('_', ' ')}'s {METHOD[role]}()"


class Crew:
    """Parts of some roles, in this process.

    Parameters
    ----------
    factories
        By role.
    names
        Their names by role, for errors.
    periods_s
        By role.
    robots
        Of the formation, the leader first.
    """

    def __init__(
        self,
        factories: Mapping[str, Factory],
        names: Mapping[str, str],
        periods_s: Mapping[str, float],
        robots: Sequence[RobotParameters],
    ) -> None:
        self._factories, self._names, self._periods = factories, names, periods_s
        self._robots = robots
        self._texts = {
            role: [answer_text(role, robot) for robot in range(len(robots))] for role in factories
        }
        self._made: dict[str, list[Any]] = {}
        self._restored: dict[str, list[Any]] = {}

    def start(self, widths_mm: Sequence[float], poses: np.ndarray) -> None:
        """Make all parts and start them.

        Parameters
        ----------
        widths_mm
            Of the robots' axles, as their computers believe.
        poses
            ``(robot, 3)``: true poses at the start, mm and rad.

        Raises
        ------
        ValueError
            for a factory that makes no part of its role.
        """
        self._made = self._started(widths_mm, poses)

    def _started(self, widths_mm: Sequence[float], poses: np.ndarray) -> dict[str, list[Any]]:
        robots = [
            with_axle_width(robot, width)
            for robot, width in zip(self._robots, widths_mm, strict=True)
        ]
        made = {
            role: [
                make_part(role, self._names[role], factory, robot, self._periods[role])
                for robot in robots
            ]
            for role, factory in self._factories.items()
        }
        for role, parts in made.items():
            for robot in self.used(role):
                given = () if role == "wheel_loop" else (poses[robot].copy(),)
                self.called(role, robot, parts[robot], "reset", *given)
        return made

    def used(self, role: str) -> list[int]:
        """Robots whose part is ever called: the leader's observer is not."""
        return [*range(1 if role == "observer" else 0, len(self._robots))]

    def called(self, role: str, robot: int, part: Any, method: str, *given: Any) -> Any:
        """What a method of a part answers."""
        return getattr(part, method)(*given)

    def estimate(self, rows: np.ndarray) -> np.ndarray:
        """Estimates ``(row, EstimateRow)`` for readings ``(row, ReadingRow)``, which the parts may keep.

        Rows are those of all robots in a substep, and then those of the next one.

        Raises
        ------
        ValueError
            in one line with robot and part, for an answer that is not as agreed.
        """
        found = np.zeros((len(rows), ESTIMATE_SIZE))
        parts, texts = self._made["estimator"], self._texts["estimator"]
        for place, (row, out) in enumerate(zip(rows, found, strict=True)):
            robot = place % len(parts)
            answer = self.called("estimator", robot, parts[robot], "update", readings_of(row))
            result = checked_estimate(answer, texts[robot])
            out[ESTIMATE.pose], out[ESTIMATE.slip] = result.pose, result.slip
            out[ESTIMATE.covariance], out[ESTIMATE.nis] = result.covariance.ravel(), result.nis
            if result.twist is not None:
                out[ESTIMATE.has_twist], out[ESTIMATE.twist] = 1.0, result.twist
        return found

    def torque(self, robots: Sequence[int], rows: np.ndarray) -> np.ndarray:
        """Torques ``(robot, 2)`` of some robots, for wanted and measured speeds ``(robot, 4)``."""
        parts, texts = self._made["wheel_loop"], self._texts["wheel_loop"]
        found = np.empty((len(rows), WHEELS))
        for place, (robot, row) in enumerate(zip(robots, rows, strict=True)):
            speeds = row[:WHEELS], row[WHEELS:]
            answer = self.called("wheel_loop", robot, parts[robot], "torque", *speeds)
            found[place] = finite(answer, WHEELS, texts[robot])
        return found

    def observe(self, robots: Sequence[int], rows: np.ndarray) -> np.ndarray:
        """References ``(row, 5)`` of some robots, one after the other, for rows of message and time."""
        parts, texts = self._made["observer"], self._texts["observer"]
        found = np.empty((len(rows), REFERENCE_SIZE))
        for place, (robot, row) in enumerate(zip(robots, rows.tolist(), strict=True)):
            message, t_s = Message(*row[:MESSAGE_SIZE]), row[MESSAGE_SIZE]
            answer = self.called("observer", robot, parts[robot], "update", message, t_s)
            found[place] = finite(answer, REFERENCE_SIZE, texts[robot])
        return found

    def get_state(self, role: str, numbers: dict[str, np.ndarray]) -> list[Any]:
        """The states of the parts of a role as JSON values, their arrays in ``numbers``.

        Raises
        ------
        ValueError
            in one line that names the part, for a state that is not plain.
        """
        parts = self._made[role]
        return [
            state_of(parts[i], part_text(role, self._names[role], i), f"{prefix(role)}{i}", numbers)
            for i in self.used(role)
        ]

    def restore(
        self,
        trees: Mapping[str, Sequence[Any]],
        numbers: Mapping[str, np.ndarray],
        widths_mm: Sequence[float],
        poses: np.ndarray,
    ) -> None:
        """Make parts with the states of :meth:`get_state` by role; :meth:`go_on` takes them.

        Raises
        ------
        ValueError
            in one line that names the part, if it does not take its state.
        """
        made = self._started(widths_mm, poses)
        for role, parts in made.items():
            for robot, tree in zip(self.used(role), trees[role], strict=True):
                give_state(parts[robot], tree, part_text(role, self._names[role], robot), numbers)
        self._restored = made

    def go_on(self) -> None:
        """Go on with the parts that :meth:`restore` has made."""
        self._made, self._restored = self._restored, {}

    def close(self) -> None:
        """Do nothing: these parts need no end."""


def prefix(role: str) -> str:
    """How the names of the arrays begin that a role's parts have in a snapshot."""
    return f"parts/{role}/"


def readings_of(row: np.ndarray) -> Readings:
    """The readings of one robot from a row; arrays are parts of it."""
    numbers: list[float] = row.tolist()
    has_fix = numbers[READING.has_fix] > 0.0
    return Readings(
        t_s=numbers[READING.t_s],
        steps_rad=row[READING.steps_rad],
        fix_mm=row[READING.fix_mm] if has_fix else None,
        fix_t_s=numbers[READING.fix_t_s] if has_fix else None,
        gyro_rad_s=numbers[READING.gyro_rad_s],
        wanted_rad_s=row[READING.wanted_rad_s],
        torques_Nmm=row[READING.torques_Nmm],
    )


def checked_estimates(rows: np.ndarray, robots: int) -> np.ndarray:
    """Rows of estimates that another process has sent, of so many robots, checked as those of a part here.

    Raises
    ------
    ValueError
        as :func:`~tlf_env.onboard.parts.checked_estimate`.
    """
    finite_rows = np.isfinite(rows).all()
    if finite_rows and not rows[:, BESIDE].any():  # the usual cases, in a fraction of the time
        return rows
    covariances = rows[:, ESTIMATE.covariance].reshape(-1, 3, 3)
    if (
        finite_rows
        and (rows[:, ESTIMATE.nis] >= 0.0).all()
        and (covariances == covariances.transpose(0, 2, 1)).all()
        and (covariances.diagonal(axis1=1, axis2=2) >= 0.0).all()
    ):
        return rows
    for place, row in enumerate(rows):
        checked_estimate(
            Estimated(
                pose=row[ESTIMATE.pose],
                twist=row[ESTIMATE.twist],
                slip=row[ESTIMATE.slip],
                covariance=row[ESTIMATE.covariance].reshape(3, 3),
                nis=row[ESTIMATE.nis],
            ),
            answer_text("estimator", place % robots),
        )
    return rows
