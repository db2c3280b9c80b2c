"""The laws of a substep up to the plant: command, wheel loops, torques, floor, and their sums.

Wheel loop → torques → disturbances → plant → sensors → EKF; :mod:`tlf_env.engine.tiles` runs them, and
:mod:`tlf_env.engine.sensors` has those after the plant.
"""

from __future__ import annotations

from tlf_env.disturbances.channels import Effects
from tlf_env.engine.layout import Order, Sensors, Trace, Traction
from tlf_env.numerics.compiled import law
from tlf_env.numerics.rows import replacing
from tlf_env.onboard.wheel_loop import WheelLoopRow, WheelLoopState, wheel_torque
from tlf_env.physics.vehicle import Body, Contact, Floor, Motion, conveyor
from tlf_env.task.actions import TORQUE

# Replaces the kind of action of a robot whose wheel loop is an object in Python.
EXTERNAL_TORQUE = 4

with_drive_sums = replacing(
    Trace, "torque_l", "torque_r", "saturated", "slip", "slid", "torque_2", "work"
)
with_delivered = replacing(Traction, "delivered_l", "delivered_r")
with_grip = replacing(Traction, "grip_l", "grip_r", "grip_c")


@law
def wanted(order: Order, substep: int) -> tuple[float, float]:
    """The command that holds in a substep of the control step."""
    early = substep < order.hold
    return (
        order.before_l if early else order.wanted_l,
        order.before_r if early else order.wanted_r,
    )


@law
def commanded_torques(
    body: Body,
    loop: WheelLoopRow,
    order: Order,
    held: WheelLoopState,
    sensors: Sensors,
    substep: int,
) -> tuple[float, float, WheelLoopState]:
    """Commanded torques in a substep, within the motors' limit, and the wheel loops' new state."""
    limit = body.torque_limit
    wanted_l, wanted_r = wanted(order, substep)
    if order.kind == TORQUE or order.kind == EXTERNAL_TORQUE:
        return min(max(wanted_l, -limit), limit), min(max(wanted_r, -limit), limit), held
    torque_l, integral_l, lag_l = wheel_torque(
        wanted_l - sensors.speed_l, held.integral_l, held.lag_l, loop, limit
    )
    torque_r, integral_r, lag_r = wheel_torque(
        wanted_r - sensors.speed_r, held.integral_r, held.lag_r, loop, limit
    )
    return torque_l, torque_r, WheelLoopState(integral_l, lag_l, integral_r, lag_r)


@law
def undisturbed(commanded_l: float, commanded_r: float, effects: Effects) -> Traction:
    """Torques delivered without dead time, on a floor without patches."""
    return Traction(
        commanded_l=commanded_l,
        commanded_r=commanded_r,
        delivered_l=commanded_l * effects.actuator_torque_gain_l,
        delivered_r=commanded_r * effects.actuator_torque_gain_r,
        grip_l=effects.tyre_friction_scale,
        grip_r=effects.tyre_friction_scale,
        grip_c=effects.tyre_friction_scale,
    )


@law
def floor_under(body: Body, effects: Effects, traction: Traction) -> Floor:
    """Injected slip and friction of the floor under a robot during one substep."""
    belt_l, belt_r = conveyor(effects.slip_delta_1_mm_s, effects.slip_delta_2_rad_s, body.h)
    return Floor(belt_l, belt_r, traction.grip_l, traction.grip_r, traction.grip_c)


@law
def trace_drive(
    trace: Trace, limit: float, traction: Traction, motion: Motion, contact: Contact, dt: float
) -> Trace:
    """Sums and extremes of torque and slip, one substep on."""
    at_limit = abs(traction.commanded_l) >= limit or abs(traction.commanded_r) >= limit
    delivered_l, delivered_r = traction.delivered_l, traction.delivered_r
    return with_drive_sums(
        trace,
        trace.torque_l + delivered_l,
        trace.torque_r + delivered_r,
        trace.saturated + (1.0 if at_limit else 0.0),
        max(trace.slip, max(contact.slip_l, contact.slip_r)),
        trace.slid + 0.5 * (contact.slip_l + contact.slip_r) * dt,
        trace.torque_2 + delivered_l * delivered_l + delivered_r * delivered_r,
        trace.work
        + (max(delivered_l * motion.omega_l, 0.0) + max(delivered_r * motion.omega_r, 0.0)) * dt,
    )
