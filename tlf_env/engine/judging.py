"""What a step returns of a robot: observations, true errors, reward terms, and why an episode ended."""

from __future__ import annotations

import math

import numpy as np

from tlf_env.engine.arrays import (
    Arrays,
    read_belief,
    read_body,
    read_estimate,
    read_motion,
    read_slip,
    read_start,
    read_trace,
    read_wanted,
)
from tlf_env.engine.layout import in_array
from tlf_env.engine.radio import (
    delayed_message,
    latest_message,
    nearest_neighbour,
    neighbour_message,
    read_reference,
)
from tlf_env.engine.settings import Settings
from tlf_env.numerics.angles import wrap
from tlf_env.numerics.compiled import law
from tlf_env.numerics.indices import slot_of
from tlf_env.numerics.memory import table
from tlf_env.numerics.rows import entries_writer, row_writer
from tlf_env.onboard.calibration import believed_odometry
from tlf_env.onboard.observer import Reference
from tlf_env.onboard.tracking import body_errors
from tlf_env.physics.units import MILLINEWTON_PER_NEWTON
from tlf_env.physics.vehicle import axle_midpoint
from tlf_env.task.actions import TORQUE
from tlf_env.task.info import HORIZON, LOST, OTHER_ROBOT, RUNNING, TOUCHED, Info
from tlf_env.task.measures import distance, time_gap_error
from tlf_env.task.observation import (
    SAMPLE_ENTRIES,
    Preview,
    SensorTail,
    Tracking,
    preview_entries,
    scaled,
)
from tlf_env.task.reward import RewardTerms, reward_terms

# For each EndReason, whether it is a failure of the robot itself, or cuts the episode off.
TERMINATES = (False, True, True, False, False)
TRUNCATES = (False, False, False, True, True)
CLIPPED = Info._fields.index("clipped")
BODY_D = in_array("body", "d")
SAMPLE_SIZE = len(SAMPLE_ENTRIES)  # the first fields of a Sample
# A row is written to a column of a table first. So a loop scales its entries, in vectors: compiled code has no
# fields by number, and would jump to a place of its own for each.
TRACKING_SIZE, PREVIEW_SIZE = len(Tracking._fields), len(Preview._fields)
set_tracking, set_preview = row_writer(Tracking, 0), row_writer(Preview, 0)
write_info, write_terms = entries_writer(Info), entries_writer(RewardTerms)


@law
def observe_preview(arrays: Arrays, lane: int, robot: int, place: int, preview: Preview) -> None:
    """Write the entries of a later reference or of another robot from ``place`` on."""
    column = table(PREVIEW_SIZE, 1)
    set_preview(column, 0, preview)
    for i in range(PREVIEW_SIZE):
        arrays.observations[lane, robot, place + i] = scaled(column[i, 0], arrays.scales[place + i])


@law
def observe_neighbour(arrays: Arrays, lane: int, robot: int, step: int, settings: Settings) -> None:
    """Write the entries of a robot's neighbour, before those of the range sensors."""
    heard, its = 0.0, Preview(0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    neighbour = nearest_neighbour(arrays, lane, robot, step, settings)
    if neighbour >= 0:
        estimate = read_estimate(arrays.states, robot, lane)
        message = neighbour_message(arrays, lane, robot, neighbour, step, settings)
        heard, its = 1.0, preview_entries(message, estimate.x, estimate.y, estimate.theta)
    place = arrays.observations.shape[2] - arrays.ranges.shape[2] - len(its) - 1
    arrays.observations[lane, robot, place] = scaled(heard, arrays.scales[place])
    observe_preview(arrays, lane, robot, place + 1, its)


@law
def observe_robot(arrays: Arrays, lane: int, robot: int, step: int, settings: Settings) -> None:
    """Write the ``tracking`` observation of one robot."""
    robots = arrays.states.shape[1]
    estimate = read_estimate(arrays.states, robot, lane)
    reference = read_reference(arrays, lane, robot, step)
    trace = read_trace(arrays.states, robot, lane)
    e_1, e_2 = body_errors(reference.x - estimate.x, reference.y - estimate.y, estimate.theta)
    e_3 = reference.theta - estimate.theta
    sin_e3, cos_e3 = math.sin(e_3), math.cos(e_3)
    per_substep = 1.0 / settings.substeps
    per_fix = 1.0 / max(trace.fixes, 1.0)
    to_Nmm = per_substep / MILLINEWTON_PER_NEWTON
    command_1 = command_2 = 0.0
    if arrays.kinds[robot, lane] != TORQUE:
        body = read_body(arrays.constants, robot, lane)
        wanted = read_wanted(arrays.states, robot, lane)
        belief = read_belief(arrays.constants, robot, lane)
        command_1, command_2 = believed_odometry(wanted.left, wanted.right, body, belief)
    before = Preview(0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    if robot > 0:
        received = latest_message(arrays, lane, robot, step, settings)
        before = preview_entries(received, estimate.x, estimate.y, estimate.theta)
    slip = read_slip(arrays.states, robot, lane)
    is_leader = 1.0 if robot == 0 else 0.0
    is_last = 1.0 if robot == robots - 1 else 0.0
    row = Tracking(  # Numba takes no conditional inside so many keywords
        e_1=e_1,
        e_2=e_2,
        sin_e_3=sin_e3,
        cos_e_3=cos_e3,
        e_1_fine=e_1,
        e_2_fine=e_2,
        sin_e_3_fine=sin_e3,
        reference_u_1=reference.u_1,
        reference_u_2=reference.u_2,
        odometry_u_1=trace.distance / settings.period,
        odometry_u_2=trace.turn / settings.period,
        last_action_0=arrays.last_actions[lane, robot, 0],
        last_action_1=arrays.last_actions[lane, robot, 1],
        command_u_1=command_1,
        command_u_2=command_2,
        innovation_forward=trace.innovation_forward * per_fix,
        innovation_right=trace.innovation_right * per_fix,
        slip_1=slip.delta_1,
        slip_2=slip.delta_2,
        torque_l=trace.torque_l * to_Nmm,
        torque_r=trace.torque_r * to_Nmm,
        is_leader=is_leader,
        is_last=is_last,
        predecessor_forward=before.forward,
        predecessor_right=before.right,
        predecessor_sin_turn=before.sin_turn,
        predecessor_cos_turn=before.cos_turn,
        predecessor_u_1=before.u_1,
        predecessor_u_2=before.u_2,
    )
    column = table(TRACKING_SIZE, 1)
    set_tracking(column, 0, row)
    for i in range(TRACKING_SIZE):
        arrays.observations[lane, robot, i] = scaled(column[i, 0], arrays.scales[i])
    for p in range(arrays.previews.shape[0]):
        later = read_reference(arrays, lane, robot, step + arrays.previews[p])
        preview = preview_entries(later, estimate.x, estimate.y, estimate.theta)
        observe_preview(arrays, lane, robot, TRACKING_SIZE + p * PREVIEW_SIZE, preview)
    if settings.neighbour_range > 0.0:
        observe_neighbour(arrays, lane, robot, step, settings)


@law
def observe_sensors(arrays: Arrays, lane: int, robot: int, step: int, settings: Settings) -> None:
    """Write the ``sensor`` observation of one robot."""
    out = arrays.sensor_observations[lane, robot]
    start_x, start_y, start = read_start(arrays.states, robot, lane)
    i = 0
    for substep in range(settings.substeps):
        for f in range(SAMPLE_SIZE):
            value = arrays.samples[substep, f, robot, lane] if step > 0 else 0.0
            if step > 0 and f == 0:
                value -= start_x
            elif step > 0 and f == 1:
                value -= start_y
            out[i] = scaled(value, arrays.sensor_scales[i])
            i += 1
    if robot == 0:
        received = read_reference(arrays, lane, robot, step)
    else:
        delayed = delayed_message(arrays, lane, robot, step, settings)
        received = Reference(delayed.x, delayed.y, delayed.theta, delayed.u_1, delayed.u_2)
    tail = SensorTail(
        time=step * settings.period,
        start_x=start_x,
        start_y=start_y,
        start_sin=math.sin(start),
        start_cos=math.cos(start),
        message_x=received.x - start_x,
        message_y=received.y - start_y,
        message_sin=math.sin(received.theta),
        message_cos=math.cos(received.theta),
        message_u_1=received.u_1,
        message_u_2=received.u_2,
        is_leader=1.0 if robot == 0 else 0.0,
    )
    for j in range(len(tail)):
        out[i + j] = scaled(tail[j], arrays.sensor_scales[i + j])


@law
def wanted_of_formation(
    arrays: Arrays, lane: int, robot: int, step: int, gap: int
) -> tuple[float, float]:
    """A robot's place by the leader's reference, ref(t − robot·gap); ref(0) before the start; mm."""
    substep = max(step - robot * gap, 0)
    route = arrays.routes[lane]
    return arrays.tables[route, substep, 0], arrays.tables[route, substep, 1]


@law
def record_truth(arrays: Arrays, lane: int, robot: int, step: int) -> None:
    """Put a robot's true position, and its way so far, into the ring of paths."""
    slot = slot_of(step, arrays.paths.shape[1])
    x, y = axle_midpoint(
        read_motion(arrays.states, robot, lane), arrays.constants[BODY_D, robot, lane]
    )
    arrays.paths[0, slot, robot, lane], arrays.paths[1, slot, robot, lane] = x, y
    way = 0.0
    if step > 0:
        before = slot - 1 if slot > 0 else arrays.paths.shape[1] - 1
        way = arrays.paths[2, before, robot, lane] + distance(
            x, y, arrays.paths[0, before, robot, lane], arrays.paths[1, before, robot, lane]
        )
    arrays.paths[2, slot, robot, lane] = way


@law
def judge_robot(arrays: Arrays, lane: int, robot: int, step: int, settings: Settings) -> None:
    """Write the true errors, the reward terms and whether one robot is lost."""
    motion = read_motion(arrays.states, robot, lane)
    d = arrays.constants[BODY_D, robot, lane]
    x, y = axle_midpoint(motion, d)
    reference = read_reference(arrays, lane, robot, step)
    trace = read_trace(arrays.states, robot, lane)
    error = distance(x, y, reference.x, reference.y)
    wanted_x, wanted_y = wanted_of_formation(arrays, lane, robot, step, settings.gap)
    late = 0.0
    if not arrays.timed[robot]:
        late = math.nan
    elif robot > 0:
        path = arrays.paths[:, :, robot - 1, lane]
        late = time_gap_error(
            x,
            y,
            path,
            step,
            settings.gap,
            settings.window,
            settings.period,
        )
    to_Nmm = 1.0 / (settings.substeps * MILLINEWTON_PER_NEWTON)
    info = Info(
        position_error_mm=error,
        formation_error_mm=distance(x, y, wanted_x, wanted_y),
        heading_error_rad=wrap(reference.theta - motion.theta),
        time_gap_error_s=late,
        slip_mm_s=trace.slip,
        torque_l_Nmm=trace.torque_l * to_Nmm,
        torque_r_Nmm=trace.torque_r * to_Nmm,
        torque_rms_Nmm=math.sqrt(trace.torque_2 / (2.0 * settings.substeps))
        / MILLINEWTON_PER_NEWTON,
        energy_mJ=trace.work / MILLINEWTON_PER_NEWTON,
        slid_mm=trace.slid,
        saturation_fraction=trace.saturated / settings.substeps,
        innovation_nis=trace.nis / max(trace.fixes, 1.0),
        x_mm=x,
        y_mm=y,
        theta_rad=motion.theta,
        reference_x_mm=reference.x,
        reference_y_mm=reference.y,
        reference_theta_rad=reference.theta,
        clipped=arrays.infos[lane, robot, CLIPPED],
    )
    write_info(arrays.infos, lane, robot, info)

    if error > settings.lost_beyond and not arrays.lost[lane, robot]:
        arrays.lost[lane, robot] = arrays.lost_now[lane, robot] = True
    size = change = 0.0
    for i in range(arrays.actions.shape[2]):
        size += arrays.actions[lane, robot, i] ** 2
        change += (arrays.actions[lane, robot, i] - arrays.last_actions[lane, robot, i]) ** 2
        arrays.last_actions[lane, robot, i] = arrays.actions[lane, robot, i]
    lost, touched = arrays.lost_now[lane, robot], arrays.touched_now[lane, robot]
    terms = reward_terms(error, change, size, trace.slip, lost, touched)
    write_terms(arrays.terms, lane, robot, terms)
    total = 0.0
    for i in range(arrays.weights.shape[0]):
        total += arrays.weights[i] * arrays.terms[lane, robot, i]
    arrays.rewards[lane, robot] = total


@law
def end_lane(arrays: Arrays, lane: int, settings: Settings) -> None:
    """Whether and why the episode ended in this step: for the whole formation at once.

    See :func:`terminated` and :func:`truncated`.
    """
    rest = HORIZON if arrays.clock[lane, 1] >= arrays.clock[lane, 3] else RUNNING
    for robot in range(arrays.ends.shape[1]):
        arrays.ends[lane, robot] = RUNNING
        if settings.end_on_lost and arrays.lost_now[lane, robot]:
            arrays.ends[lane, robot] = LOST
        if settings.end_on_touched and arrays.touched_now[lane, robot]:
            arrays.ends[lane, robot] = TOUCHED
        if arrays.ends[lane, robot] != RUNNING:
            rest = OTHER_ROBOT
    for robot in range(arrays.ends.shape[1]):
        if arrays.ends[lane, robot] == RUNNING:
            arrays.ends[lane, robot] = rest


def terminated(ends: np.ndarray) -> np.ndarray:
    """Whether a robot ended the episode because it was lost or touched another; any shape."""
    return np.array(TERMINATES)[ends]


def truncated(ends: np.ndarray) -> np.ndarray:
    """Whether another robot or the horizon ended a robot's episode; any shape."""
    return np.array(TRUNCATES)[ends]
