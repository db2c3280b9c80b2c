"""Between robots: broadcasts, what a follower receives of them, and the references made from it."""

from __future__ import annotations

import math

from tlf_env.disturbances.channels import DROPOUT, JITTER, RADIO_DROPOUT, RADIO_JITTER
from tlf_env.engine.arrays import (
    Arrays,
    read_estimate,
    read_kept,
    read_message,
    read_motion,
    read_observer,
    read_trace,
    write_kept,
    write_message,
    write_observer,
)
from tlf_env.engine.layout import Pose
from tlf_env.engine.settings import Settings
from tlf_env.numerics.compiled import law
from tlf_env.numerics.indices import slot_of
from tlf_env.numerics.philox import unit, words
from tlf_env.onboard.kinds import TRUTH
from tlf_env.onboard.observer import (
    Message,
    Reference,
    dead_reckoned,
    observed_reference,
    observer_rates,
    smoothing,
)
from tlf_env.physics.vehicle import forward_and_yaw
from tlf_env.task.measures import distance


@law
def broadcast(arrays: Arrays, lane: int, robot: int, step: int, settings: Settings) -> None:
    """Broadcast a robot's estimated pose and twist (odometry and estimated slip).

    With the estimator ``truth`` the twist is the true one at the step's end. If the broadcast is lost, the
    follower continues from the last message by dead reckoning.
    """
    slot = slot_of(step, arrays.messages.shape[1])
    if settings.estimator == TRUTH:
        u_1, u_2 = forward_and_yaw(read_motion(arrays.states, robot, lane))
    else:
        trace = read_trace(arrays.states, robot, lane)
        u_1, u_2 = trace.moved / settings.period, trace.turned / settings.period
    estimate = read_estimate(arrays.states, robot, lane)
    message = Message(estimate.x, estimate.y, estimate.theta, u_1, u_2)
    dropout = arrays.applied[DROPOUT, robot, lane]
    lost = False
    if dropout > 0.0 and step > 0:
        word, _, _, _ = words(arrays.seeds[lane], RADIO_DROPOUT, robot, arrays.clock[lane, 2], step)
        lost = unit(word) < dropout
    arrays.dropped[slot, robot, lane] = lost
    if lost:
        before = slot_of(step - 1, arrays.messages.shape[1])
        message = dead_reckoned(read_message(arrays.messages, before, robot, lane), settings.period)
    write_message(arrays.messages, slot, robot, lane, message)


@law
def lateness(
    arrays: Arrays, lane: int, robot: int, step: int, settings: Settings
) -> tuple[int, int]:
    """Control periods by which jitter makes messages older: of one gap ago, and of now."""
    jitter = arrays.applied[JITTER, robot, lane]
    if not jitter > 0.0:
        return 0, 0
    before, now, _, _ = words(arrays.seeds[lane], RADIO_JITTER, robot, arrays.clock[lane, 2], step)
    ages = math.floor(jitter / settings.period + 1e-9) + 1.0
    return int(unit(before) * ages), int(unit(now) * ages)


@law
def received_message(
    arrays: Arrays, lane: int, sender: int, step: int, late: int, settings: Settings
) -> Message:
    """A sender at a control step, by dead reckoning from its message ``late`` periods older."""
    old = max(step - late, 0)
    slot = slot_of(old, arrays.messages.shape[1])
    message = read_message(arrays.messages, slot, sender, lane)
    if late > 0:
        message = dead_reckoned(message, min(late, max(step, 0)) * settings.period)
    return message


@law
def delayed_message(
    arrays: Arrays, lane: int, robot: int, step: int, settings: Settings
) -> Message:
    """A robot's message at a control step about its predecessor one gap before.

    Jitter makes the newest message older by a fresh draw for each step, up to whole control periods
    within it; messages carry their time, so the rest is dead reckoning. Before the first gap has
    passed, it is the predecessor's start pose, at rest.
    """
    late, _ = lateness(arrays, lane, robot, step, settings)
    return received_message(arrays, lane, robot - 1, step - settings.gap, late, settings)


@law
def latest_message(arrays: Arrays, lane: int, robot: int, step: int, settings: Settings) -> Message:
    """A robot's message at a control step about its predecessor now; jitter as above."""
    _, late = lateness(arrays, lane, robot, step, settings)
    return received_message(arrays, lane, robot - 1, step, late, settings)


@law
def nearest_neighbour(arrays: Arrays, lane: int, robot: int, step: int, settings: Settings) -> int:
    """The nearest robot in range with a smaller number, other than the predecessor; −1 if there is none.

    The true distance counts: it decides how well a radio receives.
    """
    slot = slot_of(step, arrays.paths.shape[1])
    nearest, within = -1, settings.neighbour_range
    for other in range(robot - 1):
        away = distance(
            arrays.paths[0, slot, robot, lane],
            arrays.paths[1, slot, robot, lane],
            arrays.paths[0, slot, other, lane],
            arrays.paths[1, slot, other, lane],
        )
        if away <= within:
            nearest, within = other, away
    return nearest


@law
def neighbour_message(
    arrays: Arrays, lane: int, robot: int, neighbour: int, step: int, settings: Settings
) -> Message:
    """A robot's message at a control step about a neighbour now, as late as that of its predecessor."""
    _, late = lateness(arrays, lane, robot, step, settings)
    return received_message(arrays, lane, neighbour, step, late, settings)


@law
def next_reference(arrays: Arrays, lane: int, robot: int, step: int, settings: Settings) -> None:
    """Put the reference of control step ``m`` into the ring and move the follower's observer on."""
    slot = slot_of(step, arrays.references.shape[1])
    if robot == 0:
        for i in range(5):
            arrays.references[i, slot, robot, lane] = arrays.tables[arrays.routes[lane], step, i]
        return
    delayed = delayed_message(arrays, lane, robot, step, settings)
    x, y, theta = read_observer(arrays.states, robot, lane)
    factor = smoothing(step * settings.period, settings.smoothing)
    rate_x, rate_y, rate_theta = observer_rates(
        x, y, theta, delayed, settings.observer_gain, factor
    )
    reference = observed_reference(x, y, theta, rate_x, rate_y, rate_theta)
    write_kept(arrays.references, slot, robot, lane, reference)
    period = settings.period
    moved = Pose(x + period * rate_x, y + period * rate_y, theta + period * rate_theta)
    write_observer(arrays.states, robot, lane, moved)


@law
def read_reference(arrays: Arrays, lane: int, robot: int, step: int) -> Reference:
    """The reference of control step ``m``, from the ring."""
    slot = slot_of(step, arrays.references.shape[1])
    reference: Reference = read_kept(arrays.references, slot, robot, lane)
    return reference
