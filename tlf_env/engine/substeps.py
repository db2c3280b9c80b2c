"""The laws of a substep up to the plant: command, wheel loops, torques, floor, and their sums.

Wheel loop → torques → disturbances → plant → sensors → EKF; :mod:`tlf_env.engine.tiles` runs them, and
:mod:`tlf_env.engine.sensors` has those after the plant.
"""

from __future__ import annotations

import math

from tlf_env.disturbances.channels import Effects
from tlf_env.engine.layout import Order, Sensors, Trace, Traction
from tlf_env.numerics.compiled import law
from tlf_env.numerics.rows import replacing
from tlf_env.onboard.wheel_loop import WheelLoopRow, WheelLoopState, wheel_torque
from tlf_env.physics.units import MILLINEWTON_PER_NEWTON
from tlf_env.physics.vehicle import Body, Contact, Floor, Motion, Push, conveyor
from tlf_env.task.actions import EXTERNAL_TORQUE, TORQUE

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
        grip_l=effects.tyre_friction_scale * effects.tyre_friction_left,
        grip_r=effects.tyre_friction_scale * effects.tyre_friction_right,
        grip_c=effects.tyre_friction_scale,
    )


@law
def floor_under(body: Body, effects: Effects, traction: Traction) -> Floor:
    """Injected slip and friction of the floor under a robot during one substep."""
    belt_l, belt_r = conveyor(effects.slip_delta_1_mm_s, effects.slip_delta_2_rad_s, body.h)
    return Floor(
        conveyor_l=belt_l + effects.slip_left_mm_s,
        conveyor_r=belt_r + effects.slip_right_mm_s,
        grip_l=traction.grip_l,
        grip_r=traction.grip_r,
        grip_c=traction.grip_c,
        rolling=effects.floor_rolling_resistance,
        creep=effects.tyre_creep,
    )


@law
def push_on(body: Body, effects: Effects) -> Push:
    """Force from outside and the pull of gravity down a slope, in mN and mN·mm."""
    down = body.m * body.gravity * math.sin(effects.floor_slope_rad)
    return Push(
        f_x=effects.push_x_N * MILLINEWTON_PER_NEWTON + down * math.sin(effects.floor_uphill_rad),
        f_y=effects.push_y_N * MILLINEWTON_PER_NEWTON - down * math.cos(effects.floor_uphill_rad),
        torque=effects.push_torque_Nmm * MILLINEWTON_PER_NEWTON,
    )


@law
def motor_torque(torque: float, omega: float, limit: float, effects: Effects) -> float:
    """What a motor delivers of a torque: its current limit, its torque–speed curve and its dead band.

    Driving, the back-EMF leaves stall·(1 − k·|ω|) of the limit; braking it does not limit.
    """
    if abs(torque) <= effects.actuator_dead_band_Nmm * MILLINEWTON_PER_NEWTON:
        return 0.0
    driving = math.copysign(omega, omega * torque)
    share = min(
        max(effects.actuator_stall_torque * (1.0 - effects.actuator_back_emf_s_rad * driving), 0.0),
        effects.actuator_current_limit,
    )
    most = limit * share
    return min(max(torque, -most), most)


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
