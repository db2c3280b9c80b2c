"""The step drivers: the only code that knows both the laws and the arrays.

One control step runs, for every robot and substep, wheel loop → torques → disturbances → plant →
sensors → EKF, and then once per robot radio → observer → observation, reward, errors. Robots do not
act on each other within a control step unless they touch, so each runs its substeps by itself; the
pymunk plant calls :func:`actuate` and :func:`sense` one substep at a time while robots are close.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from tlf_env.numerics.angles import wrap
from tlf_env.numerics.compiled import block, driver, law
from tlf_env.numerics.philox import normal_pair, unit, words
from tlf_env.onboard.estimator import (
    Ekf,
    Estimate,
    correct,
    odometry,
    predict,
    read_ekf,
    read_estimate,
    write_estimate,
)
from tlf_env.onboard.observer import (
    Message,
    Reference,
    observed_reference,
    observer_rates,
    smoothing,
)
from tlf_env.onboard.tracking import Gains, body_errors
from tlf_env.onboard.wheel_loop import (
    WheelLoop,
    WheelLoopState,
    read_loop_state,
    read_wheel_loop,
    wheel_torque,
    write_loop_state,
)
from tlf_env.physics.kernel import substep
from tlf_env.physics.kinematics import follow_wheels
from tlf_env.physics.parameters import MILLINEWTON_PER_NEWTON, Body
from tlf_env.physics.state import (
    Contact,
    Floor,
    Motion,
    Push,
    advance_pose,
    axle_midpoint,
    conveyor,
    read_body,
    read_contact,
    read_motion,
    write_contact,
    write_motion,
)
from tlf_env.task.actions import (
    FULL_RESIDUAL_MM_S,
    FULL_RESIDUAL_RAD_S,
    FULL_SPEED_MM_S,
    FULL_TORQUE_NMM,
    FULL_YAW_RATE_RAD_S,
    REFERENCE,
    RESIDUAL,
    TORQUE,
    TWIST,
    limited,
    reference_action,
    wheel_command,
)
from tlf_env.task.arrays import (
    Arrays,
    Info,
    Sample,
    Sensors,
    Trace,
    read_effects,
    read_sensors,
    read_trace,
    write_sample,
    write_sensors,
    write_trace,
)
from tlf_env.task.channels import (
    CHANNELS,
    COMPUTING_DELAY,
    DEAD_TIME,
    DROPOUT,
    ENCODER_NOISE,
    FIRST_CHANNEL_STREAM,
    JITTER,
    POSITION_NOISE,
    RADIO_DROPOUT,
    RADIO_JITTER,
    STEP_CHANNELS,
    SUBSTEP_CHANNELS,
)
from tlf_env.task.disturbance import Effects, wheel_factors
from tlf_env.task.measures import distance, time_gap_error
from tlf_env.task.observation import SensorTail, Tracking, preview_entries, scaled
from tlf_env.task.reward import reward_terms
from tlf_env.task.signals import SignalRow, signal_value


class Settings(NamedTuple):
    """Numbers of a scenario that all robots share."""

    kinematic: bool
    substeps: int
    dt: float  # physics period, s
    period: float  # control period, s
    gap: int  # control steps of the time gap
    lookahead: int  # control steps of the longest preview
    window: int  # control steps around one gap ago in which the time gap is measured
    observer_gain: float  # 1/s
    smoothing: float  # s
    lost_beyond: float  # mm
    estimator: int  # EKF, TRUTH or EXTERNAL
    external_wheel_loop: bool
    external_observer: bool
    cooperative: bool  # every robot gets the formation's mean reward
    changing: bool  # whether a channel of every substep varies within an episode
    adversary: bool
    base: Gains  # of the twist that a residual is added to


EKF, TRUTH, EXTERNAL = range(3)
EXTERNAL_TORQUE = 4  # stands for the kind of a robot whose wheel loop is an object outside

DONE, MUST_COLLIDE = -1, -2
# Outlines that could come closer than this within a control step are stepped through the space.
CLOSE_MARGIN_MM = 10.0
FASTEST_CHANGE_MM_S2 = 1500.0  # above what all three tyres can do at twice the paper's friction

NOMINALS = np.array([channel.nominal for channel in CHANNELS])
LOWS = np.array([channel.low for channel in CHANNELS])
HIGHS = np.array([channel.high for channel in CHANNELS])

NO_PUSH = Push(0.0, 0.0, 0.0)


@law
def command(a: Arrays, lane: int, r: int, s: Settings) -> tuple[float, float]:
    """What robot ``r``'s clipped action asks for: wheel speeds (rad/s), or torques (mN·mm)."""
    a_0, a_1 = a.actions[lane, r, 0], a.actions[lane, r, 1]
    kind = a.kinds[r, lane]
    if kind == TORQUE:
        full = FULL_TORQUE_NMM * MILLINEWTON_PER_NEWTON
        return a_0 * full, a_1 * full
    body = read_body(a.bodies, r, lane)
    if kind == RESIDUAL:
        base = a.base_actions[lane, r]
        base[0], base[1] = reference_action(a.observations[lane, r], a.scales, s.base)
        b_0 = base[0] + a_0 * FULL_RESIDUAL_MM_S / FULL_SPEED_MM_S
        b_1 = base[1] + a_1 * FULL_RESIDUAL_RAD_S / FULL_YAW_RATE_RAD_S
        return wheel_command(limited(b_0), limited(b_1), TWIST, body)
    return wheel_command(a_0, a_1, kind, body)


@law
def actuate_robot(
    body: Body,
    loop: WheelLoop,
    effects: Effects,
    motion: Motion,
    contact: Contact,
    held: WheelLoopState,
    sensors: Sensors,
    trace: Trace,
    kind: int,
    wanted_l: float,
    wanted_r: float,
    patches: np.ndarray,
    delayed: np.ndarray,
    dead: int,
    tick: int,
    kinematic: bool,
    dt: float,
) -> tuple[Motion, Contact, WheelLoopState, Trace]:
    """Wheel loop, torques, disturbances and plant for one substep of one robot."""
    if kinematic:
        moved = follow_wheels(
            body, motion, wanted_l, wanted_r, effects.delta_1, effects.delta_2, dt
        )
        return moved, contact, held, trace
    limit = body.torque_limit
    if kind in (TORQUE, EXTERNAL_TORQUE):
        torque_l = min(max(wanted_l, -limit), limit)
        torque_r = min(max(wanted_r, -limit), limit)
    else:
        torque_l, integral_l, lag_l = wheel_torque(
            wanted_l - sensors.speed_l, held.integral_l, held.lag_l, loop, limit
        )
        torque_r, integral_r, lag_r = wheel_torque(
            wanted_r - sensors.speed_r, held.integral_r, held.lag_r, loop, limit
        )
        held = WheelLoopState(integral_l, lag_l, integral_r, lag_r)
    belt_l, belt_r = conveyor(effects.delta_1, effects.delta_2, body.h)
    floor = Floor(belt_l, belt_r, effects.grip, effects.grip, effects.grip)
    if patches.shape[0] > 0:
        on_l, on_r, on_c = wheel_factors(patches, body, motion)
        floor = Floor(belt_l, belt_r, effects.grip * on_l, effects.grip * on_r, effects.grip * on_c)
    given_l, given_r = torque_l, torque_r
    slots = delayed.shape[1]
    if slots > 1:
        delayed[0, tick % slots], delayed[1, tick % slots] = torque_l, torque_r
        given_l, given_r = 0.0, 0.0
        if tick > dead:
            given_l, given_r = delayed[0, (tick - dead) % slots], delayed[1, (tick - dead) % slots]
    given_l *= effects.gain_l
    given_r *= effects.gain_r
    motion, contact = substep(body, motion, contact, floor, NO_PUSH, given_l, given_r, dt)
    at_limit = abs(torque_l) >= limit or abs(torque_r) >= limit
    return (
        advance_pose(motion, dt),
        contact,
        held,
        Trace(
            trace.distance,
            trace.turn,
            trace.innovation_forward,
            trace.innovation_right,
            trace.nis,
            trace.torque_l + given_l,
            trace.torque_r + given_r,
            trace.saturated + (1.0 if at_limit else 0.0),
            max(trace.slip, max(contact.slip_l, contact.slip_r)),
            trace.slid + 0.5 * (contact.slip_l + contact.slip_r) * dt,
            trace.torque_2 + given_l * given_l + given_r * given_r,
            trace.work
            + (max(given_l * motion.omega_l, 0.0) + max(given_r * motion.omega_r, 0.0)) * dt,
        ),
    )


@law
def sense_robot(
    body: Body,
    ekf: Ekf,
    effects: Effects,
    motion: Motion,
    sensors: Sensors,
    estimate: Estimate,
    trace: Trace,
    seed: int,
    episode: int,
    robot: int,
    tick: int,
    kind: int,
    dt: float,
) -> tuple[Sensors, Estimate, Trace, Sample]:
    """Encoders, position fix and estimator (of the ``kind``) after substep ``tick`` of one robot."""
    read_l, read_r = motion.angle_l, motion.angle_r
    if effects.encoder_std > 0.0:
        noise_l, noise_r = normal_pair(seed, ENCODER_NOISE, robot, episode, tick)
        read_l += effects.encoder_std * noise_l
        read_r += effects.encoder_std * noise_r
    if effects.quantum > 0.0:
        read_l = effects.quantum * math.floor(read_l / effects.quantum)
        read_r = effects.quantum * math.floor(read_r / effects.quantum)
    step_l, step_r = read_l - sensors.encoder_l, read_r - sensors.encoder_r
    u_1, u_2 = odometry(step_l, step_r, body.R, body.h)
    x, y = axle_midpoint(motion, body.d)
    x += effects.bias_x
    y += effects.bias_y
    if effects.fix_std > 0.0:
        noise_x, noise_y = normal_pair(seed, POSITION_NOISE, robot, episode, tick)
        x += effects.fix_std * noise_x
        y += effects.fix_std * noise_y
    d_x = d_y = nis = 0.0
    if kind == EKF:
        estimate, d_x, d_y, nis = correct(predict(estimate, ekf, u_1, u_2), ekf, x, y)
    elif kind == TRUTH:
        true_x, true_y = axle_midpoint(motion, body.d)
        estimate = Estimate(true_x, true_y, motion.theta, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    forward, right = body_errors(d_x, d_y, estimate.theta)
    return (
        Sensors(read_l, read_r, step_l / dt, step_r / dt),
        estimate,
        Trace(
            trace.distance + u_1,
            trace.turn + u_2,
            trace.innovation_forward + forward,
            trace.innovation_right + right,
            trace.nis + nis,
            trace.torque_l,
            trace.torque_r,
            trace.saturated,
            trace.slip,
            trace.slid,
            trace.torque_2,
            trace.work,
        ),
        Sample(x, y, step_l, step_r),
    )


@law
def delays(a: Arrays, lane: int, r: int, dt: float) -> tuple[int, int]:
    """Dead time of the torques, and for how long the last action still holds, in ticks."""
    dead = round(a.applied[DEAD_TIME, r, lane] / dt)
    return dead, round(a.applied[COMPUTING_DELAY, r, lane] / dt)


@block
def evaluate(a: Arrays, lane: int, r: int, first: int, last: int, tick: int, s: Settings) -> None:
    """Evaluate the channels from ``first`` to before ``last`` for one robot at a tick."""
    for c in range(first, last):
        row = SignalRow(
            a.signals[c, 0], a.signals[c, 1], a.signals[c, 2], a.signals[c, 3], a.signals[c, 4]
        )
        value, a.processes[c, r, lane] = signal_value(
            row,
            tick,
            s.dt,
            a.seeds[lane],
            FIRST_CHANNEL_STREAM + c,
            r,
            a.clock[lane, 2],
            a.processes[c, r, lane],
        )
        value = NOMINALS[c] + a.levels[lane] * (value - NOMINALS[c])
        value = min(max(value, LOWS[c]), HIGHS[c])
        if s.adversary and not np.isnan(a.imposed[c, r, lane]):
            value = a.imposed[c, r, lane]
        a.applied[c, r, lane] = value


@block
def take_actions(a: Arrays, s: Settings) -> int:
    """Clip the actions and turn them into commands; clears the traces.

    Returns ``DONE``, or lane · robots + robot of the first action that is not finite; then nothing changes.
    """
    lanes, robots = a.actions.shape[0], a.actions.shape[1]
    for lane in range(lanes):
        for r in range(robots):
            if not (np.isfinite(a.actions[lane, r, 0]) and np.isfinite(a.actions[lane, r, 1])):
                return lane * robots + r
    for lane in range(lanes):
        for r in range(robots):
            if a.kinds[r, lane] == REFERENCE:
                base = a.base_actions[lane, r]
                base[0], base[1] = reference_action(a.observations[lane, r], a.scales, s.base)
                a.actions[lane, r, 0], a.actions[lane, r, 1] = limited(base[0]), limited(base[1])
            a_0, a_1 = limited(a.actions[lane, r, 0]), limited(a.actions[lane, r, 1])
            clipped = a_0 != a.actions[lane, r, 0] or a_1 != a.actions[lane, r, 1]
            if clipped:
                a.infos[lane, r, CLIPPED] += 1.0
            a.actions[lane, r, 0], a.actions[lane, r, 1] = a_0, a_1
            a.wanted_before[0, r, lane] = a.wanted[0, r, lane]
            a.wanted_before[1, r, lane] = a.wanted[1, r, lane]
            a.wanted[0, r, lane], a.wanted[1, r, lane] = command(a, lane, r, s)
            a.commands[0, r, lane] = a.wanted[0, r, lane]
            a.commands[1, r, lane] = a.wanted[1, r, lane]
            evaluate(a, lane, r, SUBSTEP_CHANNELS, STEP_CHANNELS, a.clock[lane, 0], s)
            if s.adversary and not s.changing:
                evaluate(a, lane, r, 0, SUBSTEP_CHANNELS, a.clock[lane, 0], s)
            a.lost_now[lane, r] = a.touched_now[lane, r] = False
    a.traces[:] = 0.0
    return DONE


@block
def advance(a: Arrays, lane: int, s: Settings) -> None:
    """Run the substeps of a control step of every robot of a lane, each by itself."""
    substeps, dt = s.substeps, s.dt
    seed, episode, first = a.seeds[lane], a.clock[lane, 2], a.clock[lane, 0]
    for r in range(a.motions.shape[1]):
        body = read_body(a.bodies, r, lane)
        loop = read_wheel_loop(a.wheel_loops, r, lane)
        ekf = read_ekf(a.ekfs, r, lane)
        effects = read_effects(a.applied, r, lane)
        motion = read_motion(a.motions, r, lane)
        contact = read_contact(a.contacts, r, lane)
        held = read_loop_state(a.loop_states, r, lane)
        sensors = read_sensors(a.sensors, r, lane)
        estimate = read_estimate(a.estimates, r, lane)
        trace = read_trace(a.traces, r, lane)
        kind = a.kinds[r, lane]
        wanted_l, wanted_r = a.commands[0, r, lane], a.commands[1, r, lane]
        dead, hold = delays(a, lane, r, dt)
        delayed = a.torques[:, :, r, lane]
        for k in range(substeps):
            if s.changing:
                evaluate(a, lane, r, 0, SUBSTEP_CHANNELS, first + k, s)
                effects = read_effects(a.applied, r, lane)
            if k == 0 and hold > 0:
                wanted_l, wanted_r = a.wanted_before[0, r, lane], a.wanted_before[1, r, lane]
            if k == hold:
                wanted_l, wanted_r = a.commands[0, r, lane], a.commands[1, r, lane]
            motion, contact, held, trace = actuate_robot(
                body,
                loop,
                effects,
                motion,
                contact,
                held,
                sensors,
                trace,
                kind,
                wanted_l,
                wanted_r,
                a.patches,
                delayed,
                dead,
                first + k + 1,
                s.kinematic,
                dt,
            )
            sensors, estimate, trace, sample = sense_robot(
                body,
                ekf,
                effects,
                motion,
                sensors,
                estimate,
                trace,
                seed,
                episode,
                r,
                first + k + 1,
                s.estimator,
                dt,
            )
            write_sample(a.samples[k], r, lane, sample)
        write_motion(a.motions, r, lane, motion)
        write_contact(a.contacts, r, lane, contact)
        write_loop_state(a.loop_states, r, lane, held)
        write_sensors(a.sensors, r, lane, sensors)
        write_estimate(a.estimates, r, lane, estimate)
        write_trace(a.traces, r, lane, trace)
    a.clock[lane, 0] = first + substeps


@driver
def actuate(a: Arrays, k: int, s: Settings) -> None:
    """The first half of substep ``k`` of lane 0: everything up to the plant's new velocities and poses."""
    tick = a.clock[0, 0]
    for r in range(a.motions.shape[1]):
        kind = a.kinds[r, 0]
        if s.external_wheel_loop and kind != TORQUE:
            kind = EXTERNAL_TORQUE
        if s.changing:
            evaluate(a, 0, r, 0, SUBSTEP_CHANNELS, tick, s)
        dead, hold = delays(a, 0, r, s.dt)
        wanted_l, wanted_r = a.commands[0, r, 0], a.commands[1, r, 0]
        if k < hold and kind != EXTERNAL_TORQUE:
            wanted_l, wanted_r = a.wanted_before[0, r, 0], a.wanted_before[1, r, 0]
        motion, contact, held, trace = actuate_robot(
            read_body(a.bodies, r, 0),
            read_wheel_loop(a.wheel_loops, r, 0),
            read_effects(a.applied, r, 0),
            read_motion(a.motions, r, 0),
            read_contact(a.contacts, r, 0),
            read_loop_state(a.loop_states, r, 0),
            read_sensors(a.sensors, r, 0),
            read_trace(a.traces, r, 0),
            kind,
            wanted_l,
            wanted_r,
            a.patches,
            a.torques[:, :, r, 0],
            dead,
            tick + 1,
            s.kinematic,
            s.dt,
        )
        write_motion(a.motions, r, 0, motion)
        write_contact(a.contacts, r, 0, contact)
        write_loop_state(a.loop_states, r, 0, held)
        write_trace(a.traces, r, 0, trace)


@driver
def sense(a: Arrays, k: int, s: Settings) -> None:
    """The second half of substep ``k`` of lane 0: sensors and estimator, and which outlines meet."""
    tick = a.clock[0, 0] + 1
    for r in range(a.motions.shape[1]):
        sensors, estimate, trace, sample = sense_robot(
            read_body(a.bodies, r, 0),
            read_ekf(a.ekfs, r, 0),
            read_effects(a.applied, r, 0),
            read_motion(a.motions, r, 0),
            read_sensors(a.sensors, r, 0),
            read_estimate(a.estimates, r, 0),
            read_trace(a.traces, r, 0),
            a.seeds[0],
            a.clock[0, 2],
            r,
            tick,
            s.estimator,
            s.dt,
        )
        write_sample(a.samples[k], r, 0, sample)
        write_sensors(a.sensors, r, 0, sensors)
        write_estimate(a.estimates, r, 0, estimate)
        write_trace(a.traces, r, 0, trace)
    a.clock[0, 0] = tick
    mark_touched(a, 0)


@law
def wanted_of_formation(a: Arrays, lane: int, r: int, step: int, gap: int) -> tuple[float, float]:
    """Where robot ``r`` belongs by the leader's reference, ref(t − r·gap), at rest before it starts; mm."""
    k = max(step - r * gap, 0)
    return a.table[k, 0], a.table[k, 1]


@law
def message_slot(a: Arrays, lane: int, r: int, step: int, s: Settings) -> int:
    """Where the message is that robot ``r`` uses at a control step: one gap old, or older.

    Jitter makes it older by a fresh draw for each step, up to whole control periods within it. Before
    the first gap has passed it is the predecessor's start.
    """
    late = 0
    jitter = a.applied[JITTER, r, lane]
    if jitter > 0.0:
        word, _, _, _ = words(a.seeds[lane], RADIO_JITTER, r, a.clock[lane, 2], step)
        late = int(unit(word) * (math.floor(jitter / s.period + 1e-9) + 1.0))
    return max(step - s.gap - late, 0) % a.messages.shape[1]


@law
def delayed_message(a: Arrays, lane: int, r: int, step: int, s: Settings) -> Message:
    """What robot ``r`` hears from its predecessor for a control step."""
    old = message_slot(a, lane, r, step, s)
    return Message(
        a.messages[0, old, r - 1, lane],
        a.messages[1, old, r - 1, lane],
        a.messages[2, old, r - 1, lane],
        a.messages[3, old, r - 1, lane],
        a.messages[4, old, r - 1, lane],
    )


@block
def next_reference(a: Arrays, lane: int, r: int, m: int, s: Settings) -> None:
    """Put the reference of control step ``m`` into the ring and move the follower's observer on."""
    slot = m % a.references.shape[1]
    if r == 0:
        for i in range(5):
            a.references[i, slot, r, lane] = a.table[m, i]
        return
    delayed = delayed_message(a, lane, r, m, s)
    x, y = a.observers[0, r, lane], a.observers[1, r, lane]
    theta = a.observers[2, r, lane]
    factor = smoothing(m * s.period, s.smoothing)
    rate_x, rate_y, rate_theta = observer_rates(x, y, theta, delayed, s.observer_gain, factor)
    reference = observed_reference(x, y, theta, rate_x, rate_y, rate_theta)
    for i in range(5):
        a.references[i, slot, r, lane] = reference[i]
    a.observers[0, r, lane] = x + s.period * rate_x
    a.observers[1, r, lane] = y + s.period * rate_y
    a.observers[2, r, lane] = theta + s.period * rate_theta


@law
def read_reference(a: Arrays, lane: int, r: int, m: int) -> Reference:
    """The reference of control step ``m``, from the ring."""
    slot = m % a.references.shape[1]
    return Reference(
        a.references[0, slot, r, lane],
        a.references[1, slot, r, lane],
        a.references[2, slot, r, lane],
        a.references[3, slot, r, lane],
        a.references[4, slot, r, lane],
    )


@block
def record_truth(a: Arrays, lane: int, r: int, step: int) -> None:
    """Put the true place of robot ``r`` into the ring of paths."""
    slot = step % a.paths.shape[1]
    x, y = axle_midpoint(read_motion(a.motions, r, lane), a.bodies[BODY_D, r, lane])
    a.paths[0, slot, r, lane], a.paths[1, slot, r, lane] = x, y


@block
def broadcast(a: Arrays, lane: int, r: int, step: int, period: float) -> None:
    """Put robot ``r``'s estimated pose and odometry twist on the air."""
    slot = step % a.messages.shape[1]
    trace = read_trace(a.traces, r, lane)
    for i in range(3):
        a.messages[i, slot, r, lane] = a.estimates[i, r, lane]
    a.messages[3, slot, r, lane] = trace.distance / period
    a.messages[4, slot, r, lane] = trace.turn / period
    dropout = a.applied[DROPOUT, r, lane]
    lost = False
    if dropout > 0.0 and step > 0:
        word, _, _, _ = words(a.seeds[lane], RADIO_DROPOUT, r, a.clock[lane, 2], step)
        lost = unit(word) < dropout
    a.dropped[slot, r, lane] = lost
    if lost:  # whoever listens goes on with the last message that arrived
        before = (step - 1) % a.messages.shape[1]
        for i in range(a.messages.shape[0]):
            a.messages[i, slot, r, lane] = a.messages[i, before, r, lane]


@block
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
        trace.innovation_forward * per_substep,
        trace.innovation_right * per_substep,
        0.0,
        0.0,
        trace.torque_l * to_Nmm,
        trace.torque_r * to_Nmm,
        1.0 if r == 0 else 0.0,
        1.0 if r == robots - 1 else 0.0,
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


@block
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


@block
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
        late = time_gap_error(x, y, path, step, s.gap, s.window, s.period)
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


@block
def transmit_lane(a: Arrays, lane: int, s: Settings) -> None:
    """Count the control step; everybody broadcasts."""
    step = a.clock[lane, 1] + 1
    a.clock[lane, 1] = step
    for r in range(a.motions.shape[1]):
        broadcast(a, lane, r, step, s.period)
        record_truth(a, lane, r, step)


@block
def look_lane(a: Arrays, lane: int, s: Settings) -> None:
    """Errors, rewards and observations of a lane as it stands."""
    robots = a.motions.shape[1]
    step = a.clock[lane, 1]
    for r in range(robots):
        judge_robot(a, lane, r, step, s)
        observe_robot(a, lane, r, step, s)
        if a.sensor_observations.shape[2] > 0:
            observe_sensors(a, lane, r, step, s)
    if s.cooperative:
        mean = a.rewards[lane].mean()
        a.rewards[lane, :] = mean


@driver
def message_slot_of(a: Arrays, r: int, step: int, s: Settings) -> int:
    """:func:`message_slot` of lane 0, for observers outside."""
    return message_slot(a, 0, r, step, s)


@driver
def delays_of(a: Arrays, r: int, dt: float) -> tuple[int, int]:
    """:func:`delays` of lane 0, for wheel loops outside."""
    return delays(a, 0, r, dt)


@driver
def draw_episode(a: Arrays, lane: int, s: Settings) -> None:
    """All channels at the start of an episode; before the poses are set."""
    for r in range(a.motions.shape[1]):
        evaluate(a, lane, r, 0, a.signals.shape[0], 0, s)


@driver
def draw_normals(a: Arrays, lane: int, stream: int, r: int, index: int) -> tuple[float, float]:
    """Two standard normal numbers of a robot's stream in this episode."""
    return normal_pair(a.seeds[lane], stream, r, a.clock[lane, 2], index)


@driver
def begin(a: Arrays, lane: int, s: Settings) -> None:
    """After the poses of a lane are set: first messages, and references up to the preview."""
    robots = a.motions.shape[1]
    for r in range(robots):
        broadcast(a, lane, r, 0, s.period)
        record_truth(a, lane, r, 0)
    for r in range(robots):
        if r == 0 or not s.external_observer:
            for m in range(s.lookahead + 1):
                next_reference(a, lane, r, m, s)


@block
def conclude_lane(a: Arrays, lane: int, s: Settings) -> None:
    """After the substeps of a control step: radio, observers, errors, rewards and observations."""
    transmit_lane(a, lane, s)
    for r in range(a.motions.shape[1]):
        next_reference(a, lane, r, a.clock[lane, 1] + s.lookahead, s)
    look_lane(a, lane, s)


@driver
def transmit(a: Arrays, s: Settings) -> None:
    """:func:`transmit_lane` of lane 0, and the leader's next reference."""
    transmit_lane(a, 0, s)
    next_reference(a, 0, 0, a.clock[0, 1] + s.lookahead, s)


@driver
def observe_followers(a: Arrays, s: Settings) -> None:
    """The followers' next references in lane 0."""
    for r in range(1, a.motions.shape[1]):
        next_reference(a, 0, r, a.clock[0, 1] + s.lookahead, s)


@driver
def look(a: Arrays, s: Settings) -> None:
    """:func:`look_lane` of lane 0."""
    look_lane(a, 0, s)


@driver
def prepare(a: Arrays, s: Settings) -> int:
    """Take the actions of lane 0; returns as :func:`control_step` does, ``MUST_COLLIDE`` if near."""
    bad = take_actions(a, s)
    if bad != DONE:
        return bad
    if not s.kinematic and not room_to_move(a, 0, s.period):
        return MUST_COLLIDE
    return DONE


@driver
def control_step(a: Arrays, s: Settings) -> int:
    """A whole control step of lane 0.

    Returns ``DONE``; or the number of the first robot whose action is not finite, and nothing has
    changed; or ``MUST_COLLIDE``: robots are close, actions are taken, and the substeps are left to
    the plant's space.
    """
    bad = take_actions(a, s)
    if bad != DONE:
        return bad
    if not s.kinematic and not room_to_move(a, 0, s.period):
        return MUST_COLLIDE
    advance(a, 0, s)
    if s.kinematic:
        mark_touched(a, 0)
    conclude_lane(a, 0, s)
    return DONE


@law
def outline_centre(a: Arrays, lane: int, r: int) -> tuple[float, float]:
    """Centre of the outline's circle, mm."""
    motion = read_motion(a.motions, r, lane)
    ahead = a.bodies[BODY_AHEAD, r, lane]
    return motion.x - ahead * math.sin(motion.theta), motion.y + ahead * math.cos(motion.theta)


@block
def room_to_move(a: Arrays, lane: int, duration: float) -> bool:
    """Whether no two outlines (circles) can meet, or nearly so, during ``duration`` s."""
    robots = a.motions.shape[1]
    for i in range(robots):
        x_i, y_i = outline_centre(a, lane, i)
        speed_i = outline_speed(a, lane, i)
        for j in range(i):
            x_j, y_j = outline_centre(a, lane, j)
            room = a.bodies[BODY_OUTLINE, i, lane] + a.bodies[BODY_OUTLINE, j, lane]
            closing = speed_i + outline_speed(a, lane, j) + 2.0 * FASTEST_CHANGE_MM_S2 * duration
            if distance(x_i, y_i, x_j, y_j) - room <= CLOSE_MARGIN_MM + closing * duration:
                return False
    return True


@law
def outline_speed(a: Arrays, lane: int, r: int) -> float:
    """A bound on the speed of the outline's centre, mm/s."""
    motion = read_motion(a.motions, r, lane)
    swing = abs(motion.w * a.bodies[BODY_AHEAD, r, lane])
    return math.sqrt(motion.v_x * motion.v_x + motion.v_y * motion.v_y) + swing


@law
def touch(a: Arrays, lane: int, r: int) -> None:
    """Remember that robot ``r`` touched another."""
    if not a.touched[lane, r]:
        a.touched[lane, r] = a.touched_now[lane, r] = True


@block
def mark_touched(a: Arrays, lane: int) -> None:
    """Set ``touched`` for robots whose outlines meet."""
    robots = a.motions.shape[1]
    for i in range(robots):
        x_i, y_i = outline_centre(a, lane, i)
        for j in range(i):
            x_j, y_j = outline_centre(a, lane, j)
            room = a.bodies[BODY_OUTLINE, i, lane] + a.bodies[BODY_OUTLINE, j, lane]
            if distance(x_i, y_i, x_j, y_j) <= room:
                touch(a, lane, i)
                touch(a, lane, j)


CLIPPED = Info._fields.index("clipped")
BODY_D = Body._fields.index("d")
BODY_OUTLINE = Body._fields.index("outline_radius")
BODY_AHEAD = Body._fields.index("outline_ahead")
