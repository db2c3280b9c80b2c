"""Between robots: broadcasts, what a follower hears of them, and the references that come of it."""

from __future__ import annotations

import math

from tlf_env.numerics.compiled import block, law
from tlf_env.numerics.philox import unit, words
from tlf_env.onboard.observer import (
    Message,
    Reference,
    observed_reference,
    observer_rates,
    smoothing,
)
from tlf_env.task.arrays import Arrays, read_trace
from tlf_env.task.channels import DROPOUT, JITTER, RADIO_DROPOUT, RADIO_JITTER
from tlf_env.task.settings import Settings


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
