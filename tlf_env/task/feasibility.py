"""What a reference trajectory asks of the robots beyond what they can do, in words.

The limits follow from :class:`~tlf_env.physics.vehicle.RobotParameters`; ``docs/trajectories.md``
derives them. They are for warnings: a scenario that breaks them still runs.
"""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np

from tlf_env.physics.units import MILLINEWTON_PER_NEWTON
from tlf_env.physics.vehicle import RobotParameters, body
from tlf_env.task.actions import FULL_SPEED_MM_S, FULL_YAW_RATE_RAD_S
from tlf_env.task.observation import OBSERVATION_LIMIT, SAMPLE_ENTRIES, SENSOR_TAIL_ENTRIES
from tlf_env.task.trajectories import Trajectory, sample

SAMPLE_S = 0.01
MAX_SAMPLES = 200_000
STANDS_MM_S = 0.1
STANDS_S = 0.1  # a shorter stand is an instant of turning back or of starting
NEAR_WORST = 1e-3  # the first place that is as bad as the worst, but for this share, is told
NAMED = 6  # at most, of the distances at which robots meet
RATE_S = 0.1  # a robot may take so long over a change of speed or of yaw rate
TURNS_RAD_S = 0.01  # slower, the castor need not swing
SPOT_MM = 1.0  # a turn within a sample that travels less than this is on the spot
# What the observation `sensor` can tell before it is clipped.
SENSOR_FIX_LIMIT_MM = OBSERVATION_LIMIT * SAMPLE_ENTRIES["fix_x"].scale
SENSOR_START_LIMIT_MM = OBSERVATION_LIMIT * SENSOR_TAIL_ENTRIES["start_x"].scale
SENSOR_TIME_LIMIT_S = OBSERVATION_LIMIT * SENSOR_TAIL_ENTRIES["time"].scale


def motor_acceleration(robot: RobotParameters) -> float:
    """The largest forward acceleration that the motors give on a straight, joints rubbing, mm/s²."""
    idle, per_acceleration = (_motor_torque(robot, 0.0, 0.0, a, 0.0) for a in (0.0, 1.0))
    return float((robot.torque_limit_Nmm - idle) / (per_acceleration - idle))


def grip_acceleration(robot: RobotParameters) -> tuple[float, float]:
    """What the drive wheels' tyres hold (static) and, once they slip, give (dynamic), mm/s².

    The castor is left out: it swivels, and sideways gives no more than its steering friction does.
    """
    carried = 2 * robot.drive_load_share * robot.gravity_mm_s2
    return robot.tyre.mu_static * carried, robot.tyre.mu_dynamic * carried


def disturbed(robot: RobotParameters, friction_scale: float, torque_gain: float) -> RobotParameters:
    """The robot with its tyres' friction and its motors' torque scaled by factors, each at least 0."""
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

    Forward: m_eff·u̇₁ + m·d·u₂² + castor's axle; yaw about c: I·u̇₂ − m·d·u₁·u₂ and, in a turn, all
    that the castor's steering friction resists; joints by eq. (5), u₁·u₂ at most what the tyres hold.
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
    """What it means that the robots start at rest, where the reference does not; else None.

    A note and no warning: the paper's own trajectories start at speed.
    """
    u_1 = float(sample(trajectory, np.array([0.0]))[0, 3])
    if u_1 <= STANDS_MM_S:
        return None
    limit = motor_acceleration(robot)
    if limit <= 0:
        return (
            f"the reference starts at {u_1:.0f} mm/s and the robots at rest: "
            f"{robot.torque_limit_Nmm:g} N·mm do not move the leader"
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
    """A line for each thing that the reference asks within the horizon and a robot cannot do.

    Looked at every 10 ms (or less often over more than half an hour): standing still, speed, yaw
    rate, turning on the spot, the motors' torque, the tyres' grip, and the distance between robots
    that follow one ``time_gap_s`` apart, lined up ``start_spacing_mm`` apart at the start. Each line
    names the worst place, the value and the limit.
    """
    t_s, gap_steps = _times(horizon_s, time_gap_s)
    reference = sample(trajectory, t_s)
    return [
        *_stands(t_s, reference),
        *_speed(t_s, reference),
        *_turning(t_s, reference),
        *_motors(t_s, reference, robot),
        *_grip(t_s, reference, robot),
        *_meetings(t_s, reference, robot, robots, gap_steps, start_spacing_mm),
    ]


def sensor_warnings(
    trajectory: Trajectory,
    horizon_s: float,
    *,
    robots: int = 1,
    time_gap_s: float = 5.0,
    start_spacing_mm: float = 300.0,
) -> list[str]:
    """A line for each thing within the horizon that the observation ``sensor`` clips in silence.

    Position fixes and messages count from a robot's own start and are clipped at ±10 m per
    coordinate; so are the start's coordinates in the world, and ``time`` at 1000 s. Robot i drives
    what the reference drives until i gaps before the horizon. Each line names the first place, the
    value and the limit.
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
    """Per robot by the extremes so far: a robot behind drives a shorter part of the same path."""
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
    """How many robots are concerned, if more than one."""
    return f" ({np.count_nonzero(far)} robots in all)" if np.count_nonzero(far) > 1 else ""


def _long_horizon(horizon_s: float) -> Iterator[str]:
    if horizon_s > SENSOR_TIME_LIMIT_S:
        yield (
            f"t = {SENSOR_TIME_LIMIT_S:.0f} s: observation 'sensor' clips time there; the horizon is "
            f"{horizon_s:g} s"
        )


def _times(horizon_s: float, time_gap_s: float) -> tuple[np.ndarray, int]:
    """Times (s) to look at, and how many of them make a gap: 10 ms apart, more over long horizons."""
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
    """The first place of about the largest value."""
    return _first(values >= (1 - NEAR_WORST) * values.max())


def _rate(t_s: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Rate of change over ``RATE_S`` around each time: a jump counts by what is left of it then."""
    half = max(round(RATE_S / 2 / (t_s[1] - t_s[0])), 1)
    k = np.arange(len(t_s))
    before, after = np.maximum(k - half, 0), np.minimum(k + half, len(t_s) - 1)
    return (values[after] - values[before]) / (t_s[after] - t_s[before])


def _runs(flags: np.ndarray) -> np.ndarray:
    """First and last index of every run of True, ``(run, 2)``."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], flags, [False]]).astype(np.int8)))
    return edges.reshape(-1, 2) - [0, 1]


def _stands(t_s: np.ndarray, reference: np.ndarray) -> Iterator[str]:
    """Assumption 2: u₁* and u₂* are not zero at once, until the end."""
    runs = [
        (a, b)
        for a, b in _runs(reference[:, 3] < STANDS_MM_S)
        if b < len(t_s) - 1 and t_s[b] - t_s[a] >= STANDS_S
    ]
    if runs:
        a, b = runs[0]
        more = f" ({len(runs)} times in all)" if len(runs) > 1 else ""
        yield (
            f"{_place(t_s, reference, a)}: the reference stands still until t = {t_s[b]:.2f} s{more}; "
            "the tracking law assumes that u_1 and u_2 are never both 0 before the end (assumption 2)"
        )


def _speed(t_s: np.ndarray, reference: np.ndarray) -> Iterator[str]:
    k = _worst(reference[:, 3])
    if reference[k, 3] > FULL_SPEED_MM_S:
        yield (
            f"{_place(t_s, reference, k)}: speed {reference[k, 3]:.0f} mm/s is above "
            f"{FULL_SPEED_MM_S:g} mm/s, the most that a robot can be asked for"
        )


def _turning(t_s: np.ndarray, reference: np.ndarray) -> Iterator[str]:
    """Yaw rates above the limit, by the change of heading from sample to sample."""
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
            f"{FULL_YAW_RATE_RAD_S:g} rad/s, the most that a robot can be asked for"
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
            f"{robot.torque_limit_Nmm:g} (on a straight they give "
            f"{max(motor_acceleration(robot), 0.0):.0f} mm/s²)"
        )


def _grip(t_s: np.ndarray, reference: np.ndarray, robot: RobotParameters) -> Iterator[str]:
    lateral = reference[:, 3] * reference[:, 4]
    motors = max(motor_acceleration(robot), 0.0)
    along = np.clip(_rate(t_s, reference[:, 3]), -motors, motors)
    total = np.hypot(lateral, along)
    holds, gives = grip_acceleration(robot)
    k = _worst(total)
    if total[k] > gives:
        if total[k] > holds:
            limit = f"{holds:.0f} mm/s², where the drive wheels break loose"
        else:
            limit = f"{gives:.0f} mm/s²; up to {holds:.0f} they hold, but a slip will not end there"
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

    A robot that has not set out yet waits in the line behind the start, and moves up one place per
    gap: as if the reference had come along that line.
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
        more = f"; robots {names} apart come too close as well" if others else ""
        yield (
            f"{_place(t_s, reference, k)}: robot_0 and robot_{i} are {distance_mm:.0f} mm apart, below "
            f"{room_mm:.0f} mm, two outline radii; so is every pair {i} apart, each a gap later{more}"
        )
