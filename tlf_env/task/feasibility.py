"""Warnings for reference trajectories that the robots cannot follow.

The limits follow from :class:`~tlf_env.physics.vehicle.RobotParameters`; ``docs/trajectories.md``
derives them. A scenario that exceeds them still runs.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

import numpy as np

from tlf_env.physics.units import MILLINEWTON_PER_NEWTON
from tlf_env.physics.vehicle import RobotParameters, body
from tlf_env.physics.world import World, capsules_of, gaps_to_capsule
from tlf_env.task.actions import FULL_SPEED_MM_S, FULL_YAW_RATE_RAD_S
from tlf_env.task.observation import OBSERVATION_LIMIT, SAMPLE_ENTRIES, SENSOR_TAIL_ENTRIES
from tlf_env.task.trajectories import Trajectory, sample

SAMPLE_S = 0.01
MAX_SAMPLES = 200_000
REST_MM_S = 0.1
REST_S = 0.1  # a shorter rest is an instant of reversing or starting
NEAR_WORST = 1e-3  # the first value within this share of the largest is reported
NAMED = 6  # largest number of robot pairs in a warning
RATE_S = 0.1  # time that a robot may take for a change of speed or yaw rate
TURNS_RAD_S = 0.01  # at slower yaw rates the castor need not swing
SPOT_MM = 1.0  # a turn is on the spot if less is travelled within a sample
# Limits beyond which the observation `sensor` is clipped.
SENSOR_FIX_LIMIT_MM = OBSERVATION_LIMIT * SAMPLE_ENTRIES["fix_x"].scale
SENSOR_START_LIMIT_MM = OBSERVATION_LIMIT * SENSOR_TAIL_ENTRIES["start_x"].scale
SENSOR_TIME_LIMIT_S = OBSERVATION_LIMIT * SENSOR_TAIL_ENTRIES["time"].scale


def motor_acceleration(robot: RobotParameters) -> float:
    """Largest forward acceleration by the motors on a straight, with joint friction, mm/s²."""
    idle, per_acceleration = (_motor_torque(robot, 0.0, 0.0, a, 0.0) for a in (0.0, 1.0))
    return float((robot.torque_limit_Nmm - idle) / (per_acceleration - idle))


def grip_acceleration(robot: RobotParameters) -> tuple[float, float]:
    """Accelerations at the static and the dynamic friction of the drive wheels' tyres, mm/s².

    The castor is neglected: it swivels, and its lateral force is limited by the steering friction.
    """
    carried = 2 * robot.drive_load_share * robot.gravity_mm_s2
    return robot.tyre.mu_static * carried, robot.tyre.mu_dynamic * carried


def disturbed(robot: RobotParameters, friction_scale: float, torque_gain: float) -> RobotParameters:
    """The robot with tyre friction and motor torque scaled by factors, each at least 0."""
    tyre = robot.tyre.model_copy(
        update={
            "mu_static": friction_scale * robot.tyre.mu_static,
            "mu_dynamic": friction_scale * robot.tyre.mu_dynamic,
        }
    )
    return robot.model_copy(
        update={"tyre": tyre, "torque_limit_Nmm": torque_gain * robot.torque_limit_Nmm}
    )


def _motor_torque(
    robot: RobotParameters,
    u_1: np.ndarray | float,
    u_2: np.ndarray | float,
    acceleration: np.ndarray | float,
    yaw_acceleration: np.ndarray | float,
) -> np.ndarray:
    """The larger torque (N·mm) of the two motors for a motion without slip.

    Forward: m_eff·u̇₁ + m·d·u₂² + castor's axle; yaw about c: I·u̇₂ − m·d·u₁·u₂ plus, in a turn, the
    castor's steering friction; joints by eq. (5), with u₁·u₂ limited to the static grip.
    """
    row = body(robot)
    u_1, u_2 = np.asarray(u_1), np.asarray(u_2)
    held = grip_acceleration(robot)[0]
    lateral = np.clip(u_1 * u_2, -held, held)
    joint = row.drive_mu_dynamic * (
        (row.drive_axial + row.drive_bending * row.R) * row.m * np.abs(lateral) / 2
        + row.drive_radial * row.load_drive
        + row.drive_preload
    )
    castor = row.axle_mu_dynamic * (row.axle_radial * row.load_castor + row.axle_preload) / row.R_c
    steering = row.steer_mu_static * (
        (row.steer_axial + row.steer_bending * row.T) * row.load_castor + row.steer_preload
    )
    swing = steering * (row.d + row.q + row.T) / row.T * (np.abs(u_2) > TURNS_RAD_S)
    mass = row.m + 2 * row.spin_mass_drive + row.spin_mass_castor
    forward = mass * np.asarray(acceleration) + row.m * row.d * u_2**2 + castor
    yaw = row.I_rolling * np.asarray(yaw_acceleration) - row.m * row.d * lateral
    torques = [
        joint * np.where(u_1 + side * row.h * u_2 < 0, -1.0, 1.0)
        + row.R / 2 * (forward + (side * yaw + sign * swing) / row.h)
        for side in (-1.0, 1.0)
        for sign in (-1.0, 1.0)
    ]
    return np.max(np.abs(torques), axis=0) / MILLINEWTON_PER_NEWTON


def start_note(trajectory: Trajectory, robot: RobotParameters) -> str | None:
    """A note on a reference that does not start at rest, as the robots do; else None.

    It is no warning: the paper's trajectories start at speed.
    """
    u_1 = float(sample(trajectory, np.array([0.0]))[0, 3])
    if u_1 <= REST_MM_S:
        return None
    limit = motor_acceleration(robot)
    if limit <= 0:
        return (
            f"the reference starts at {u_1:.0f} mm/s and the robots at rest: a torque of "
            f"{robot.torque_limit_Nmm:g} N·mm does not move the leader"
        )
    return (
        f"the reference starts at {u_1:.0f} mm/s and the robots at rest: at full torque "
        f"({limit:.0f} mm/s²) the leader needs {u_1 / limit:.1f} s to reach that speed, and is then "
        f"{u_1**2 / (2 * limit):.0f} mm behind"
    )


def warnings_for(
    trajectory: Trajectory,
    robot: RobotParameters,
    horizon_s: float,
    *,
    robots: int = 1,
    time_gap_s: float = 5.0,
    start_spacing_mm: float = 300.0,
) -> list[str]:
    """A line for each limit of the robots that the reference exceeds within the horizon.

    Checked every 10 ms (less often for more than half an hour): rest, speed, yaw rate, turns on the spot,
    motor torque, grip of the tyres, and the distance between robots that follow one ``time_gap_s`` apart
    and start ``start_spacing_mm`` apart. Each line gives the worst place, the value and the limit.
    """
    t_s, gap_steps = _times(horizon_s, time_gap_s)
    reference = sample(trajectory, t_s)
    return [
        *_rests(t_s, reference),
        *_speed(t_s, reference),
        *_turning(t_s, reference),
        *_motors(t_s, reference, robot),
        *_grip(t_s, reference, robot),
        *_meetings(t_s, reference, robot, robots, gap_steps, start_spacing_mm),
    ]


def wall_warnings(
    trajectory: Trajectory, robot: RobotParameters, world: World, horizon_s: float
) -> list[str]:
    """A line if the reference passes through walls or obstacles of the world within the horizon.

    The line gives the first place at which the robot's outline (the circle around it) overlaps one, and how
    many others the path meets. Things that move or can be pushed do not count.
    """
    t_s, _ = _times(horizon_s, horizon_s)
    reference = sample(trajectory, t_s)
    ahead = np.stack([-np.sin(reference[:, 2]), np.cos(reference[:, 2])], axis=1)
    centres = reference[:, :2] - robot.outline_offset_mm * ahead
    met = []
    for name in ("walls", "obstacles"):
        for number, thing in enumerate(getattr(world, name)):
            room = np.min([gaps_to_capsule(one, centres) for one in capsules_of(thing)], axis=0)
            if (room < robot.outline_radius_mm).any():
                first = _first(room < robot.outline_radius_mm)
                deepest = robot.outline_radius_mm - float(room.min())
                met.append((first, f"world.{name}[{number}]", deepest))
    if not met:
        return []
    first, name, deepest = min(met)
    more = f"; it meets {len(met) - 1} more" if len(met) > 1 else ""
    return [
        f"{_place(t_s, reference, first)}: the path leads the outline of a robot up to {deepest:.0f} mm "
        f"into {name}{more}"
    ]


def largest_push(robot: RobotParameters) -> float:
    """The largest steady force (N) with which a robot pushes: by its motors, or the grip of its tyres."""
    idle = float(_motor_torque(robot, 0.0, 0.0, 0.0, 0.0))
    motors = 2.0 * (robot.torque_limit_Nmm - idle) / robot.wheel_radius_mm
    grip = robot.mass_kg * grip_acceleration(robot)[0] / MILLINEWTON_PER_NEWTON
    return max(min(motors, grip), 0.0)


def push_warnings(robots: Sequence[RobotParameters], world: World) -> Iterator[str]:
    """A line for each body that could be pushed, but that all robots together cannot push."""
    push = sum(map(largest_push, robots))
    for number, thing in enumerate(world.pushables):
        grip = thing.floor_friction * thing.mass_kg * robots[0].gravity_mm_s2
        if grip > push * MILLINEWTON_PER_NEWTON:
            yield (
                f"world.pushables[{number}] holds to the floor with "
                f"{grip / MILLINEWTON_PER_NEWTON:.3g} N, floor_friction·mass_kg·g; all robots together "
                f"push with {push:.3g} N, so it yields to impacts only"
            )


def sensor_warnings(
    trajectory: Trajectory,
    horizon_s: float,
    *,
    robots: int = 1,
    time_gap_s: float = 5.0,
    start_spacing_mm: float = 300.0,
) -> list[str]:
    """A line for each quantity that the observation ``sensor`` clips within the horizon.

    Position fixes and messages are relative to a robot's own start and clipped at ±10 m per coordinate, as
    are the start's coordinates in the world; ``time`` is clipped at 1000 s. Robot i follows the reference
    up to i gaps before the horizon. Each line gives the first place, the value and the limit.
    """
    t_s, gap_steps = _times(horizon_s, time_gap_s)
    reference = sample(trajectory, t_s)
    x, y, theta = reference[0, :3]
    behind = start_spacing_mm * np.arange(robots)[:, None]
    starts = np.array([x, y]) + behind * np.array([math.sin(theta), -math.cos(theta)])
    return [
        *_far_starts(starts),
        *_far_places(t_s, reference, starts, gap_steps),
        *_long_horizon(horizon_s),
    ]


def _far_starts(starts: np.ndarray) -> Iterator[str]:
    far = np.abs(starts).max(axis=1) > SENSOR_START_LIMIT_MM
    if far.any():
        i = _first(far)
        yield (
            f"t = 0 s: robot_{i} starts at ({starts[i, 0]:.0f}, {starts[i, 1]:.0f}) mm; observation "
            f"'sensor' clips start_x and start_y at ±{SENSOR_START_LIMIT_MM:.0f} mm{_and_more(far)}"
        )


def _far_places(
    t_s: np.ndarray, reference: np.ndarray, starts: np.ndarray, gap_steps: int
) -> Iterator[str]:
    """From running extremes: a robot farther behind drives a shorter part of the same path."""
    places = reference[:, :2]
    low, high = np.minimum.accumulate(places), np.maximum.accumulate(places)
    last = len(t_s) - 1 - gap_steps * np.arange(len(starts))
    driven = last >= 0
    k = np.maximum(last, 0)
    far = driven & (np.maximum(high[k] - starts, starts - low[k]).max(axis=1) > SENSOR_FIX_LIMIT_MM)
    if far.any():
        i = _first(far)
        apart = places - starts[i]
        at = _first(np.abs(apart).max(axis=1) > SENSOR_FIX_LIMIT_MM)
        yield (
            f"{_place(t_s, reference, at)}: the reference is ({apart[at, 0]:.0f}, "
            f"{apart[at, 1]:.0f}) mm from the start of robot_{i}; observation 'sensor' clips fixes "
            f"and messages at ±{SENSOR_FIX_LIMIT_MM:.0f} mm from it{_and_more(far)}"
        )


def _and_more(far: np.ndarray) -> str:
    """The number of robots, if more than one."""
    return f" ({np.count_nonzero(far)} robots in all)" if np.count_nonzero(far) > 1 else ""


def _long_horizon(horizon_s: float) -> Iterator[str]:
    if horizon_s > SENSOR_TIME_LIMIT_S:
        yield (
            f"t = {SENSOR_TIME_LIMIT_S:.0f} s: observation 'sensor' clips time at this value; the "
            f"horizon is {horizon_s:g} s"
        )


def _times(horizon_s: float, time_gap_s: float) -> tuple[np.ndarray, int]:
    """Times (s) to check and their number per gap: 10 ms apart, more for long horizons."""
    gap_steps = math.ceil(time_gap_s / max(SAMPLE_S, horizon_s / MAX_SAMPLES))
    step_s = time_gap_s / gap_steps
    t_s = np.arange(math.floor(horizon_s / step_s + 1e-9) + 1) * step_s
    return (t_s if len(t_s) >= 2 else np.array([0.0, horizon_s])), gap_steps


def _place(t_s: np.ndarray, reference: np.ndarray, index: int) -> str:
    x, y = reference[index, :2]
    return f"t = {t_s[index]:.2f} s at ({x:.0f}, {y:.0f}) mm"


def _first(flags: np.ndarray) -> int:
    return int(np.argmax(flags))


def _worst(values: np.ndarray) -> int:
    """Index of the first value that is about the largest."""
    return _first(values >= (1 - NEAR_WORST) * values.max())


def _rate(t_s: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Rate of change over ``RATE_S`` around each time, so that a jump gives a finite rate."""
    half = max(round(RATE_S / 2 / (t_s[1] - t_s[0])), 1)
    k = np.arange(len(t_s))
    before, after = np.maximum(k - half, 0), np.minimum(k + half, len(t_s) - 1)
    return (values[after] - values[before]) / (t_s[after] - t_s[before])


def _runs(flags: np.ndarray) -> np.ndarray:
    """First and last index of every run of True, ``(run, 2)``."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], flags, [False]]).astype(np.int8)))
    return edges.reshape(-1, 2) - [0, 1]


def _rests(t_s: np.ndarray, reference: np.ndarray) -> Iterator[str]:
    """Assumption 2: u₁* and u₂* are not both zero before the end."""
    runs = [
        (a, b)
        for a, b in _runs(reference[:, 3] < REST_MM_S)
        if b < len(t_s) - 1 and t_s[b] - t_s[a] >= REST_S
    ]
    if runs:
        a, b = runs[0]
        more = f" ({len(runs)} times in all)" if len(runs) > 1 else ""
        yield (
            f"{_place(t_s, reference, a)}: the reference is at rest until t = {t_s[b]:.2f} s{more}; "
            "the tracking law assumes that u_1 and u_2 are never both 0 before the end (assumption 2)"
        )


def _speed(t_s: np.ndarray, reference: np.ndarray) -> Iterator[str]:
    k = _worst(reference[:, 3])
    if reference[k, 3] > FULL_SPEED_MM_S:
        yield (
            f"{_place(t_s, reference, k)}: speed {reference[k, 3]:.0f} mm/s is above "
            f"{FULL_SPEED_MM_S:g} mm/s, the largest speed command"
        )


def _turning(t_s: np.ndarray, reference: np.ndarray) -> Iterator[str]:
    """Yaw rates above the limit, from the change of heading between samples."""
    turn = np.diff(reference[:, 2])
    rate = turn / (t_s[1] - t_s[0])
    travel = np.hypot(*np.diff(reference[:, :2], axis=0).T)
    fast = np.abs(rate) > FULL_YAW_RATE_RAD_S
    spots = _runs(fast & (travel < SPOT_MM))
    if len(spots):
        turns = [abs(turn[a : b + 1].sum()) for a, b in spots]
        worst = _worst(np.array(turns))
        more = f" ({len(spots)} times in all)" if len(spots) > 1 else ""
        yield (
            f"{_place(t_s, reference, spots[worst][0])}: the heading turns by {turns[worst]:.2f} rad "
            f"on the spot, faster than {FULL_YAW_RATE_RAD_S:g} rad/s{more}"
        )
    moving = np.where(fast & (travel >= SPOT_MM), np.abs(rate), 0.0)
    k = _worst(moving)
    if moving[k] > 0:
        yield (
            f"{_place(t_s, reference, k)}: yaw rate {moving[k]:.1f} rad/s is above "
            f"{FULL_YAW_RATE_RAD_S:g} rad/s, the largest yaw rate command"
        )


def _motors(t_s: np.ndarray, reference: np.ndarray, robot: RobotParameters) -> Iterator[str]:
    u_1, u_2 = reference[:, 3], reference[:, 4]
    acceleration, yaw_acceleration = (_rate(t_s, u) for u in (u_1, u_2))
    torque = _motor_torque(robot, u_1, u_2, acceleration, yaw_acceleration)
    k = _worst(torque)
    if torque[k] > robot.torque_limit_Nmm:
        yield (
            f"{_place(t_s, reference, k)}: changing speed by {acceleration[k]:.0f} mm/s² and yaw rate "
            f"by {yaw_acceleration[k]:.2g} rad/s² needs {torque[k]:.1f} N·mm of a motor, above "
            f"{robot.torque_limit_Nmm:g} (on a straight the motors give "
            f"{max(motor_acceleration(robot), 0.0):.0f} mm/s²)"
        )


def _grip(t_s: np.ndarray, reference: np.ndarray, robot: RobotParameters) -> Iterator[str]:
    lateral = reference[:, 3] * reference[:, 4]
    motors = max(motor_acceleration(robot), 0.0)
    along = np.clip(_rate(t_s, reference[:, 3]), -motors, motors)
    total = np.hypot(lateral, along)
    static, dynamic = grip_acceleration(robot)
    k = _worst(total)
    if total[k] > dynamic:
        if total[k] > static:
            limit = f"{static:.0f} mm/s², the static grip limit of the drive wheels"
        else:
            limit = (
                f"{dynamic:.0f} mm/s², the dynamic grip limit of the drive wheels; up to the static "
                f"limit, {static:.0f} mm/s², they hold, but a slip does not end"
            )
        yield (
            f"{_place(t_s, reference, k)}: acceleration {total[k]:.0f} mm/s² "
            f"({abs(lateral[k]):.0f} of it sideways) is above {limit}"
        )


def _meetings(
    t_s: np.ndarray,
    reference: np.ndarray,
    robot: RobotParameters,
    robots: int,
    gap_steps: int,
    start_spacing_mm: float,
) -> Iterator[str]:
    """Distances between the outlines' centres of robots i gaps apart.

    Before its start a robot is in the line behind the start and moves up one place per gap, as if the
    reference had come along that line.
    """
    theta = reference[:, 2]
    ahead = np.stack([-np.sin(theta), np.cos(theta)], axis=1)
    centre = reference[:, :2] - robot.outline_offset_mm * ahead
    places = np.arange((robots - 1) * gap_steps, 0, -1)[:, None] / gap_steps
    centre = np.concatenate([centre[0] - start_spacing_mm * places * ahead[0], centre])
    room_mm = 2 * robot.outline_radius_mm
    found: list[tuple[float, int, int]] = []
    for i in range(1, robots):
        behind = (robots - 1 - i) * gap_steps
        apart = centre[(robots - 1) * gap_steps :] - centre[behind : behind + len(t_s)]
        distance = np.hypot(*apart.T)
        k = _first(distance <= distance.min() + NEAR_WORST * room_mm)
        if distance[k] < room_mm:
            found.append((float(distance[k]), i, k))
    if found:
        distance_mm, i, k = min(found)
        others = sorted(other for _, other, _ in found if other != i)
        names = ", ".join(str(other) for other in others[:NAMED]) + ", …" * (len(others) > NAMED)
        more = f"; robots i and i + {names} are too close as well" if others else ""
        yield (
            f"{_place(t_s, reference, k)}: robot_0 and robot_{i} are {distance_mm:.0f} mm apart, below "
            f"{room_mm:.0f} mm, two outline radii; the same holds for robots i and i + {i}, one "
            f"gap later each{more}"
        )
