"""What a robot sees and what is told of it: observations, true errors, reward terms."""

from __future__ import annotations

import math

import numpy as np

from tlf_env.engine.layout import Arrays, read_trace
from tlf_env.engine.radio import DELTA_1, DELTA_2, delayed_message, latest_message, read_reference
from tlf_env.engine.settings import Settings
from tlf_env.numerics.angles import wrap
from tlf_env.numerics.compiled import law
from tlf_env.onboard.estimator import read_estimate
from tlf_env.onboard.observer import Reference
from tlf_env.onboard.tracking import body_errors
from tlf_env.physics.units import MILLINEWTON_PER_NEWTON
from tlf_env.physics.vehicle import Body, axle_midpoint, odometry, read_body, read_motion
from tlf_env.task.actions import TORQUE
from tlf_env.task.info import HORIZON, LOST, OTHER_ROBOT, RUNNING, TOUCHED, Info
from tlf_env.task.measures import distance, time_gap_error
from tlf_env.task.observation import Preview, SensorTail, Tracking, preview_entries, scaled
from tlf_env.task.reward import reward_terms

CLIPPED = Info._fields.index("clipped")
BODY_D = Body._fields.index("d")


@law
def observe_robot(a: Arrays, lane: int, r: int, step: int, s: Settings) -> None:
    """Write the ``tracking`` observation of one robot."""
    robots = a.motions.shape[1]
    estimate = read_estimate(a.estimates, r, lane)
    reference = read_reference(a, lane, r, step)
    trace = read_trace(a.traces, r, lane)
    e_1, e_2 = body_errors(reference.x - estimate.x, reference.y - estimate.y, estimate.theta)
    e_3 = reference.theta - estimate.theta
    sin_e3, cos_e3 = math.sin(e_3), math.cos(e_3)
    per_substep = 1.0 / s.substeps
    to_Nmm = per_substep / MILLINEWTON_PER_NEWTON
    command_1 = command_2 = 0.0
    if a.kinds[r, lane] != TORQUE:
        body = read_body(a.bodies, r, lane)
        command_1, command_2 = odometry(a.wanted[0, r, lane], a.wanted[1, r, lane], body.R, body.h)
    before = Preview(0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    if r > 0:
        heard = latest_message(a, lane, r, step, s)
        before = preview_entries(heard, estimate.x, estimate.y, estimate.theta)
    row = Tracking(
        e_1,
        e_2,
        sin_e3,
        cos_e3,
        e_1,
        e_2,
        sin_e3,
        reference.u_1,
        reference.u_2,
        trace.distance / s.period,
        trace.turn / s.period,
        a.last_actions[lane, r, 0],
        a.last_actions[lane, r, 1],
        command_1,
        command_2,
        trace.innovation_forward * per_substep,
        trace.innovation_right * per_substep,
        a.slip_estimates[DELTA_1, r, lane],
        a.slip_estimates[DELTA_2, r, lane],
        trace.torque_l * to_Nmm,
        trace.torque_r * to_Nmm,
        1.0 if r == 0 else 0.0,
        1.0 if r == robots - 1 else 0.0,
        before.forward,
        before.right,
        before.sin_turn,
        before.cos_turn,
        before.u_1,
        before.u_2,
    )
    entries = len(row)
    for i in range(entries):
        a.observations[lane, r, i] = scaled(row[i], a.scales[i])
    for p in range(a.previews.shape[0]):
        later = read_reference(a, lane, r, step + a.previews[p])
        preview = preview_entries(later, estimate.x, estimate.y, estimate.theta)
        for i in range(len(preview)):
            j = entries + p * len(preview) + i
            a.observations[lane, r, j] = scaled(preview[i], a.scales[j])


@law
def observe_sensors(a: Arrays, lane: int, r: int, step: int, s: Settings) -> None:
    """Write the ``sensor`` observation of one robot."""
    out = a.sensor_observations[lane, r]
    start_x, start_y, start = a.starts[0, r, lane], a.starts[1, r, lane], a.starts[2, r, lane]
    i = 0
    for k in range(s.substeps):
        for f in range(a.samples.shape[1]):
            value = a.samples[k, f, r, lane] if step > 0 else 0.0
            if step > 0 and f == 0:
                value -= start_x
            elif step > 0 and f == 1:
                value -= start_y
            out[i] = scaled(value, a.sensor_scales[i])
            i += 1
    if r == 0:
        heard = read_reference(a, lane, r, step)
    else:
        delayed = delayed_message(a, lane, r, step, s)
        heard = Reference(delayed.x, delayed.y, delayed.theta, delayed.u_1, delayed.u_2)
    tail = SensorTail(
        step * s.period,
        start_x,
        start_y,
        math.sin(start),
        math.cos(start),
        heard.x - start_x,
        heard.y - start_y,
        math.sin(heard.theta),
        math.cos(heard.theta),
        heard.u_1,
        heard.u_2,
        1.0 if r == 0 else 0.0,
    )
    for j in range(len(tail)):
        out[i + j] = scaled(tail[j], a.sensor_scales[i + j])


@law
def wanted_of_formation(a: Arrays, lane: int, r: int, step: int, gap: int) -> tuple[float, float]:
    """Where robot ``r`` belongs by the leader's reference, ref(t − r·gap), at rest before it starts; mm."""
    k = max(step - r * gap, 0)
    return a.table[k, 0], a.table[k, 1]


@law
def record_truth(a: Arrays, lane: int, r: int, step: int) -> None:
    """Put the true place of robot ``r`` into the ring of paths."""
    slot = step % a.paths.shape[1]
    x, y = axle_midpoint(read_motion(a.motions, r, lane), a.bodies[BODY_D, r, lane])
    a.paths[0, slot, r, lane], a.paths[1, slot, r, lane] = x, y
    if step == 0:
        a.longest[r, lane] = 0.0
    else:
        before = (step - 1) % a.paths.shape[1]
        way = distance(x, y, a.paths[0, before, r, lane], a.paths[1, before, r, lane])
        a.longest[r, lane] = max(a.longest[r, lane], way)


@law
def judge_robot(a: Arrays, lane: int, r: int, step: int, s: Settings) -> None:
    """Write the true errors, the reward terms and whether one robot is lost."""
    motion = read_motion(a.motions, r, lane)
    d = a.bodies[BODY_D, r, lane]
    x, y = axle_midpoint(motion, d)
    reference = read_reference(a, lane, r, step)
    trace = read_trace(a.traces, r, lane)
    error = distance(x, y, reference.x, reference.y)
    wanted_x, wanted_y = wanted_of_formation(a, lane, r, step, s.gap)
    late = 0.0
    if r > 0:
        path = a.paths[:, :, r - 1, lane]
        late = time_gap_error(x, y, path, step, s.gap, s.window, s.period, a.longest[r - 1, lane])
    to_Nmm = 1.0 / (s.substeps * MILLINEWTON_PER_NEWTON)
    info = Info(
        error,
        distance(x, y, wanted_x, wanted_y),
        wrap(reference.theta - motion.theta),
        late,
        trace.slip,
        trace.torque_l * to_Nmm,
        trace.torque_r * to_Nmm,
        math.sqrt(trace.torque_2 / (2.0 * s.substeps)) / MILLINEWTON_PER_NEWTON,
        trace.work / MILLINEWTON_PER_NEWTON,
        trace.slid,
        trace.saturated / s.substeps,
        trace.nis / s.substeps,
        x,
        y,
        motion.theta,
        reference.x,
        reference.y,
        reference.theta,
        a.infos[lane, r, CLIPPED],
    )
    for i in range(len(info)):
        a.infos[lane, r, i] = info[i]

    if error > s.lost_beyond and not a.lost[lane, r]:
        a.lost[lane, r] = a.lost_now[lane, r] = True
    size = change = 0.0
    for i in range(a.actions.shape[2]):
        size += a.actions[lane, r, i] ** 2
        change += (a.actions[lane, r, i] - a.last_actions[lane, r, i]) ** 2
        a.last_actions[lane, r, i] = a.actions[lane, r, i]
    lost, touched = a.lost_now[lane, r], a.touched_now[lane, r]
    terms = reward_terms(error, change, size, trace.slip, lost, touched)
    total = 0.0
    for i in range(len(terms)):
        a.terms[lane, r, i] = terms[i]
        total += a.weights[i] * terms[i]
    a.rewards[lane, r] = total


@law
def end_lane(a: Arrays, lane: int, s: Settings) -> None:
    """Whether and why the episode ended in this step: for the whole formation at once.

    See :func:`terminated` and :func:`truncated`.
    """
    rest = HORIZON if a.clock[lane, 1] >= s.horizon else RUNNING
    for r in range(a.ends.shape[1]):
        a.ends[lane, r] = RUNNING
        if s.end_on_lost and a.lost_now[lane, r]:
            a.ends[lane, r] = LOST
        if s.end_on_touched and a.touched_now[lane, r]:
            a.ends[lane, r] = TOUCHED
        if a.ends[lane, r] != RUNNING:
            rest = OTHER_ROBOT
    for r in range(a.ends.shape[1]):
        if a.ends[lane, r] == RUNNING:
            a.ends[lane, r] = rest


def terminated(ends: np.ndarray) -> np.ndarray:
    """Who ended the episode, of any shape: who was lost or touched another."""
    return (ends == LOST) | (ends == TOUCHED)


def truncated(ends: np.ndarray) -> np.ndarray:
    """Whose episode was ended by another robot or the horizon, of any shape."""
    return (ends == OTHER_ROBOT) | (ends == HORIZON)
