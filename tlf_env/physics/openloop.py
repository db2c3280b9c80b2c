"""One robot with given torques, without wheel loop and torque limit, for checks against other plants."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any, Self

import numpy as np
from pydantic import Field, TypeAdapter, ValidationError, model_validator

from tlf_env.common.errors import one_line, shown
from tlf_env.common.files import FILE_NAME, atomic, read_json
from tlf_env.common.models import Frozen, Number, Switch
from tlf_env.numerics.compiled import driver
from tlf_env.physics.chipmunk_plant import ChipmunkPlant
from tlf_env.physics.kernel import substep
from tlf_env.physics.parameters import RobotParameters, body_array
from tlf_env.physics.state import (
    Contact,
    Floor,
    Motion,
    Push,
    advance_pose,
    read_body,
    read_contact,
    read_motion,
    write_contact,
    write_motion,
)
from tlf_env.physics.units import MILLINEWTON_PER_NEWTON

COLUMNS = (
    "t_s",
    "x_mm",
    "y_mm",
    "theta_rad",
    "castor_rad",
    "forward_mm_s",
    "right_mm_s",
    "yaw_rad_s",
    "omega_l_rad_s",
    "omega_r_rad_s",
)
ROW_EVERY_S = 0.1
MAX_DURATION_S = 1e5
MAX_TORQUE_NMM = 1e6
MAX_SUBSTEPS = 100_000_000
STILL_FLOOR = Floor(conveyor_l=0.0, conveyor_r=0.0, grip_l=1.0, grip_r=1.0, grip_c=1.0)
OPEN_LOOP_PLANTS = ("kernel", "chipmunk")
# Far beyond any robot, and small enough that squares and products in the plant stay finite.
MAX_MM = 1e9  # and mm/s
MAX_RAD = 1e4  # and rad/s

Torque = Annotated[Number, Field(ge=-MAX_TORQUE_NMM, le=MAX_TORQUE_NMM)]
Length = Annotated[Number, Field(ge=-MAX_MM, le=MAX_MM)]
Angle = Annotated[Number, Field(ge=-MAX_RAD, le=MAX_RAD)]


class OpenLoopStart(Frozen):
    """State of the axle midpoint c, the castor and the wheels at t = 0."""

    x_mm: Length = 0.0
    y_mm: Length = 0.0
    theta_rad: Angle = 0.0
    castor_rad: Angle = 0.0
    forward_mm_s: Length = 0.0
    right_mm_s: Length = 0.0
    yaw_rad_s: Angle = 0.0
    omega_l_rad_s: Angle = 0.0
    omega_r_rad_s: Angle = 0.0
    castor_spin_rad_s: Angle = 0.0


class OpenLoopInput(Frozen):
    """Torques (N·mm) from ``from_s`` on, until the next input."""

    from_s: Annotated[Number, Field(ge=0, le=MAX_DURATION_S)] = 0.0
    torque_l_Nmm: Torque
    torque_r_Nmm: Torque


class OpenLoopScenario(Frozen):
    """One open-loop run: duration, start, joint friction on or off, torques over time."""

    duration_s: Annotated[Number, Field(gt=0, le=MAX_DURATION_S)]
    start: OpenLoopStart = OpenLoopStart()
    joint_friction: Switch = True
    inputs: tuple[OpenLoopInput, ...] = Field(min_length=1)

    @model_validator(mode="after")
    def _check_order(self) -> Self:
        times = [one.from_s for one in self.inputs]
        if any(b <= a for a, b in itertools.pairwise(times)):
            raise ValueError(f"inputs: from_s must increase from one to the next, got {times}")
        rows = round(self.duration_s / ROW_EVERY_S)
        if rows < 1 or abs(rows * ROW_EVERY_S - self.duration_s) > 1e-9:
            raise ValueError(
                f"duration_s {self.duration_s} must be a multiple of {ROW_EVERY_S} s, the time between "
                "rows, and at least that"
            )
        return self


def initial_rows(start: OpenLoopStart, d_mm: float) -> tuple[np.ndarray, np.ndarray]:
    """Motion and contact arrays ``(field, 1, 1)`` at the start; contacts are zero."""
    sin, cos = math.sin(start.theta_rad), math.cos(start.theta_rad)
    right = start.right_mm_s + start.yaw_rad_s * d_mm
    motion = Motion(
        x=start.x_mm + d_mm * sin,
        y=start.y_mm - d_mm * cos,
        theta=start.theta_rad,
        psi=start.theta_rad + start.castor_rad,
        v_x=right * cos - start.forward_mm_s * sin,
        v_y=right * sin + start.forward_mm_s * cos,
        w=start.yaw_rad_s,
        s=start.yaw_rad_s,
        omega_l=start.omega_l_rad_s,
        omega_r=start.omega_r_rad_s,
        omega_c=start.castor_spin_rad_s,
        angle_l=0.0,
        angle_r=0.0,
    )
    return (
        np.array(motion, dtype=np.float64).reshape(-1, 1, 1),
        np.zeros((len(Contact._fields), 1, 1)),
    )


@driver
def advance_open_loop(
    bodies: np.ndarray,
    motions: np.ndarray,
    contacts: np.ndarray,
    torques: np.ndarray,
    push: np.ndarray,
    dt: float,
) -> None:
    """Advance robot 0 in place by ``len(torques)`` substeps of ``dt`` s; torques (steps, 2) in mN·mm.

    ``push`` is a constant load at the centre of mass: force (2,) in mN in world axes, torque in mN·mm.
    """
    body = read_body(bodies, 0, 0)
    motion = read_motion(motions, 0, 0)
    contact = read_contact(contacts, 0, 0)
    floor = STILL_FLOOR
    load = Push(push[0], push[1], push[2])
    for k in range(torques.shape[0]):
        motion, contact = substep(
            body, motion, contact, floor, load, torques[k, 0], torques[k, 1], dt
        )
        motion = advance_pose(motion, dt)
    write_motion(motions, 0, 0, motion)
    write_contact(contacts, 0, 0, contact)


def advance_chipmunk(
    plant: ChipmunkPlant, motions: np.ndarray, contacts: np.ndarray, torques: np.ndarray, dt: float
) -> None:
    """:func:`advance_open_loop` by a plant of pymunk's constraints, as one control step."""
    floors = np.array(STILL_FLOOR).reshape(-1, 1, 1)
    plant.sort(motions)
    for pair in torques:
        plant.advance(motions, contacts, pair.reshape(2, 1, 1), floors, dt)
    plant.release()


def _row(t_s: float, motion: Motion, d_mm: float) -> list[float]:
    sin, cos = math.sin(motion.theta), math.cos(motion.theta)
    x_mm, y_mm = motion.x - d_mm * sin, motion.y + d_mm * cos
    return [
        t_s,
        x_mm,
        y_mm,
        motion.theta,
        motion.psi - motion.theta,
        -motion.v_x * sin + motion.v_y * cos,
        motion.v_x * cos + motion.v_y * sin - motion.w * d_mm,
        motion.w,
        motion.omega_l,
        motion.omega_r,
    ]


def run_open_loop(
    scenario: OpenLoopScenario,
    robot: RobotParameters | None = None,
    dt_s: float = 0.001,
    plant: str | Callable[[RobotParameters], ChipmunkPlant] = "kernel",
) -> np.ndarray:
    """Run one scenario; returns rows ``(time, column)`` every 0.1 s, columns as in :data:`COLUMNS`.

    ``plant`` is the exact kernel, or ``"chipmunk"``: pymunk's bodies and constraints; or a function that makes
    such a plant.

    Raises
    ------
    ValueError
        if ``dt_s`` is not positive, does not divide 0.1 s, or makes too many steps; for an unknown plant.
    """
    if isinstance(plant, str) and plant not in OPEN_LOOP_PLANTS:
        raise ValueError(
            f"plant {shown(plant)} cannot run open loop; there are {', '.join(OPEN_LOOP_PLANTS)}"
        )
    robot = (robot or RobotParameters()).model_copy(
        update={"joint_friction": scenario.joint_friction}
    )
    if not (math.isfinite(dt_s) and dt_s > 0):
        raise ValueError(
            f"dt_s {dt_s} must divide the {ROW_EVERY_S} s between rows, and be above 0"
        )
    if scenario.duration_s / dt_s > MAX_SUBSTEPS:
        raise ValueError(
            f"dt_s {dt_s} makes more than {MAX_SUBSTEPS} steps of {scenario.duration_s} s"
        )
    per_row = round(ROW_EVERY_S / dt_s)
    if per_row < 1 or abs(per_row * dt_s - ROW_EVERY_S) > 1e-9:
        raise ValueError(f"dt_s {dt_s} must divide the {ROW_EVERY_S} s between rows")
    bodies = body_array([robot])
    motions, contacts = initial_rows(scenario.start, robot.com_offset_mm)
    steps = round(scenario.duration_s / dt_s)
    starts = np.array([math.ceil(one.from_s / dt_s - 1e-6) for one in scenario.inputs])
    levels = np.array([(one.torque_l_Nmm, one.torque_r_Nmm) for one in scenario.inputs])
    held = np.searchsorted(starts, np.arange(steps), side="right") - 1
    torques = np.where(held[:, None] >= 0, levels[held], 0.0) * MILLINEWTON_PER_NEWTON
    push = np.zeros(3)
    by_chipmunk = None
    if plant != "kernel":
        by_chipmunk = ChipmunkPlant([robot]) if isinstance(plant, str) else plant(robot)

    rows = [_row(0.0, Motion(*motions[:, 0, 0].tolist()), robot.com_offset_mm)]
    for first in range(0, steps - steps % per_row, per_row):
        some = torques[first : first + per_row]
        if by_chipmunk is None:
            advance_open_loop(bodies, motions, contacts, some, push, dt_s)
        else:
            advance_chipmunk(by_chipmunk, motions, contacts, some, dt_s)
        t_s = (first + per_row) * dt_s
        rows.append(_row(t_s, Motion(*motions[:, 0, 0].tolist()), robot.com_offset_mm))
    return np.array(rows)


def load_scenarios(path: Path) -> dict[str, OpenLoopScenario]:
    """Read ``{name: scenario}`` from a JSON file.

    Raises
    ------
    ValueError
        in one line, if the file is missing, is not JSON, or contains an invalid scenario.
    """
    data: Any = read_json(path)
    if not isinstance(data, dict) or not data:
        raise ValueError(
            f"{path} must contain an object of named scenarios, got {type(data).__name__}"
        )
    for name in data:
        if not FILE_NAME.fullmatch(name):
            raise ValueError(f"{path}: the scenario name {name!r} cannot be a file name")
    kind = dict[str, OpenLoopScenario]
    try:
        return TypeAdapter(kind).validate_python(data)
    except ValidationError as error:
        raise ValueError(f"{path}: {one_line(error, kind)}") from error


def write_rows(path: Path, rows: np.ndarray) -> Path:
    """Write the rows of a run as CSV with the header :data:`COLUMNS`, completely or not at all."""
    with atomic(path, encoding="utf-8") as file:
        file.write(",".join(COLUMNS) + "\n")
        np.savetxt(file, rows, fmt="%.12g", delimiter=",")
    return path
