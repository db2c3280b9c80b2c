"""Between robots: broadcasts, what a follower hears of them, and the references that come of it."""

from __future__ import annotations

import math

from tlf_env.disturbances.channels import DROPOUT, JITTER, RADIO_DROPOUT, RADIO_JITTER
from tlf_env.engine.layout import Arrays, read_trace
from tlf_env.engine.settings import Settings
from tlf_env.numerics.compiled import law, slot_reader, slot_writer
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
from tlf_env.onboard.slip_estimator import SlipEstimate
from tlf_env.physics.vehicle import forward_and_yaw, read_motion

DELTA_1 = SlipEstimate._fields.index("delta_1")
DELTA_2 = SlipEstimate._fields.index("delta_2")

read_message = slot_reader(Message)
write_message = slot_writer(Message)


@law
def broadcast(a: Arrays, lane: int, r: int, step: int, s: Settings) -> None:
    """Put robot ``r``'s estimated pose and twist (odometry and estimated slip) on the air.

    With the estimator ``truth`` it is the true twist at the step's end. If the broadcast is lost,
    whoever listens goes on from the last message, by dead reckoning.
    """
    slot = step % a.messages.shape[1]
    if s.estimator == TRUTH:
        u_1, u_2 = forward_and_yaw(read_motion(a.motions, r, lane))
    else:
        trace = read_trace(a.traces, r, lane)
        u_1, u_2 = trace.moved / s.period, trace.turned / s.period
    message = Message(
        a.estimates[0, r, lane], a.estimates[1, r, lane], a.estimates[2, r, lane], u_1, u_2
    )
    dropout = a.applied[DROPOUT, r, lane]
    lost = False
    if dropout > 0.0 and step > 0:
        word, _, _, _ = words(a.seeds[lane], RADIO_DROPOUT, r, a.clock[lane, 2], step)
        lost = unit(word) < dropout
    a.dropped[slot, r, lane] = lost
    if lost:
        before = (step - 1) % a.messages.shape[1]
        message = dead_reckoned(read_message(a.messages, before, r, lane), s.period)
    write_message(a.messages, slot, r, lane, message)


@law
def lateness(a: Arrays, lane: int, r: int, step: int, s: Settings) -> tuple[int, int]:
    """Control periods by which jitter makes messages older: of one gap ago, and of now."""
    jitter = a.applied[JITTER, r, lane]
    if not jitter > 0.0:
        return 0, 0
    before, now, _, _ = words(a.seeds[lane], RADIO_JITTER, r, a.clock[lane, 2], step)
    ages = math.floor(jitter / s.period + 1e-9) + 1.0
    return int(unit(before) * ages), int(unit(now) * ages)


@law
def heard_message(a: Arrays, lane: int, r: int, step: int, late: int, s: Settings) -> Message:
    """The predecessor at a control step, by dead reckoning from a message ``late`` periods older."""
    old = max(step - late, 0)
    message = read_message(a.messages, old % a.messages.shape[1], r - 1, lane)
    if late > 0:
        message = dead_reckoned(message, min(late, max(step, 0)) * s.period)
    return message


@law
def delayed_message(a: Arrays, lane: int, r: int, step: int, s: Settings) -> Message:
    """What robot ``r`` knows at a control step of its predecessor one gap before.

    Jitter makes the newest message older by a fresh draw for each step, up to whole control periods
    within it; messages carry their time, so the rest is dead reckoning. Before the first gap has
    passed it is the predecessor's start, at rest.
    """
    late, _ = lateness(a, lane, r, step, s)
    return heard_message(a, lane, r, step - s.gap, late, s)


@law
def latest_message(a: Arrays, lane: int, r: int, step: int, s: Settings) -> Message:
    """What robot ``r`` knows at a control step of its predecessor now; jitter as above."""
    _, late = lateness(a, lane, r, step, s)
    return heard_message(a, lane, r, step, late, s)


@law
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
