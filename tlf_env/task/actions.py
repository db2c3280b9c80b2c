"""The kinds of action, all in [−1, 1]², and their conversion to wheel speeds or torques."""

from __future__ import annotations

import math
from typing import Literal

import numpy as np

from tlf_env.numerics.compiled import law
from tlf_env.onboard.calibration import Belief, believed_wheel_speeds
from tlf_env.onboard.limiter import braked, closing_speed, limited_twist, saturated
from tlf_env.onboard.observer import Message
from tlf_env.onboard.rejection import RejectionState, observed_rejection
from tlf_env.onboard.spacing import Predecessor, spaced_twist
from tlf_env.onboard.supervisor import SupervisorRow, curvature, supervised_twist
from tlf_env.onboard.tracking import ControllerRow, linearised_twist, tracking_twist
from tlf_env.physics.vehicle import Body
from tlf_env.task.observation import Entry, Preview, Tracking

ACTION_SIZE = 2
TWIST, WHEEL_SPEED, TORQUE, RESIDUAL, TRACKING_TWIST = range(5)
LIMITED_TWIST, LIMITED_WHEEL_SPEED = 5, 6  # behind the scenario's limiter
REFERENCE = 7  # the twist of the reference controller instead of an action
EXTERNAL_TORQUE = 8  # what a wheel loop in Python makes of any of them but TORQUE
OUTSIDE_RESIDUAL, LIMITED_OUTSIDE_RESIDUAL = 9, 10  # on a policy in Python
ActionKind = Literal["twist", "wheel_speed", "torque", "residual", "tracking_twist"]
ACTION_KINDS: dict[ActionKind, int] = {
    "twist": TWIST,
    "wheel_speed": WHEEL_SPEED,
    "torque": TORQUE,
    "residual": RESIDUAL,
    "tracking_twist": TRACKING_TWIST,
}
LIMITED_KINDS: dict[ActionKind, int] = {
    "twist": LIMITED_TWIST,
    "wheel_speed": LIMITED_WHEEL_SPEED,
    "tracking_twist": TRACKING_TWIST,
}
OUTSIDE_KINDS: dict[ActionKind, int] = {"residual": OUTSIDE_RESIDUAL}
LIMITED_OUTSIDE_KINDS: dict[ActionKind, int] = {
    **LIMITED_KINDS,
    "residual": LIMITED_OUTSIDE_RESIDUAL,
}
RANGED_KINDS: tuple[ActionKind, ...] = ("residual", "tracking_twist")  # action_range is theirs

FULL_SPEED_MM_S = 1000.0
FULL_YAW_RATE_RAD_S = 8.0
FULL_WHEEL_SPEED_RAD_S = 25.0
FULL_TORQUE_NMM = 15.0
FULL_RESIDUAL_MM_S = 150.0
FULL_RESIDUAL_RAD_S = 1.0
FULL_TRACKING_MM_S = 100.0
FULL_TRACKING_RAD_S = 1.0
TRACKING_FADE_MM = 10.0

ACTION_ENTRIES = {
    "twist": (
        Entry("commanded forward speed u₁", "mm/s", FULL_SPEED_MM_S),
        Entry("commanded yaw rate u₂, counter-clockwise", "rad/s", FULL_YAW_RATE_RAD_S),
    ),
    "wheel_speed": (
        Entry("commanded speed of the left wheel", "rad/s", FULL_WHEEL_SPEED_RAD_S),
        Entry("commanded speed of the right wheel", "rad/s", FULL_WHEEL_SPEED_RAD_S),
    ),
    "torque": (
        Entry("torque on the left wheel, without wheel loop", "N·mm", FULL_TORQUE_NMM),
        Entry("torque on the right wheel", "N·mm", FULL_TORQUE_NMM),
    ),
    "residual": (
        Entry(
            "forward speed added to the command of the controller residual_base, before its limits; "
            "residual_fade_mm and residual_reach_mm reduce it",
            "mm/s",
            FULL_RESIDUAL_MM_S,
        ),
        Entry("yaw rate added to that command", "rad/s", FULL_RESIDUAL_RAD_S),
    ),
    "tracking_twist": (
        Entry(
            "forward speed added to the reference's u₁*; tracking_fade_mm reduces it near the reference",
            "mm/s",
            FULL_TRACKING_MM_S,
        ),
        Entry("yaw rate added to the reference's u₂*", "rad/s", FULL_TRACKING_RAD_S),
    ),
}

E_1 = Tracking._fields.index("e_1")
E_2 = Tracking._fields.index("e_2")
SIN_E_3 = Tracking._fields.index("sin_e_3")
COS_E_3 = Tracking._fields.index("cos_e_3")
U_1 = Tracking._fields.index("reference_u_1")
U_2 = Tracking._fields.index("reference_u_2")
ODOMETRY_1 = Tracking._fields.index("odometry_u_1")
ODOMETRY_2 = Tracking._fields.index("odometry_u_2")
COMMAND_1 = Tracking._fields.index("command_u_1")
COMMAND_2 = Tracking._fields.index("command_u_2")
LATER_U_1 = len(Tracking._fields) + Preview._fields.index("u_1")
LATER_U_2 = len(Tracking._fields) + Preview._fields.index("u_2")
SLIP_1 = Tracking._fields.index("slip_1")
SLIP_2 = Tracking._fields.index("slip_2")
IS_LEADER = Tracking._fields.index("is_leader")
PREDECESSOR = Tracking._fields.index("predecessor_forward")


def action_entries(
    kind: ActionKind, action_range: tuple[float, float] | None = None
) -> tuple[Entry, ...]:
    """Meaning, unit and scale of an action's components, with the scenario's ``action_range``, if any."""
    entries = ACTION_ENTRIES[kind]
    if action_range is None:
        return entries
    return tuple(
        entry._replace(scale=full) for entry, full in zip(entries, action_range, strict=True)
    )


@law
def clipped_action(component: float) -> float:
    """A component of an action, clipped to [−1, 1]."""
    return min(max(component, -1.0), 1.0)


@law
def led_reference(observation: np.ndarray, scales: np.ndarray, lead: float) -> tuple[float, float]:
    """Twist (mm/s, rad/s) of the reference, ``lead`` of the way to that at the first preview."""
    u_1, u_2 = observation[U_1] * scales[U_1], observation[U_2] * scales[U_2]
    if lead > 0.0:
        u_1 += lead * (observation[LATER_U_1] * scales[LATER_U_1] - u_1)
        u_2 += lead * (observation[LATER_U_2] * scales[LATER_U_2] - u_2)
    return u_1, u_2


@law
def wanted_twist(
    observation: np.ndarray, scales: np.ndarray, row: ControllerRow, memory: RejectionState
) -> tuple[float, float, RejectionState]:
    """Twist (mm/s, rad/s) of the controller's law from one ``tracking`` observation, and its next memory."""
    now_1, now_2 = observation[U_1] * scales[U_1], observation[U_2] * scales[U_2]
    u_1, u_2 = led_reference(observation, scales, row.lead)
    whole_1, whole_2 = observation[E_1] * scales[E_1], observation[E_2] * scales[E_2]
    e_1 = saturated(braked(whole_1, row.limits.braking_error), row.limits.forward_error)
    e_2 = saturated(whole_2, row.limits.lateral_error)
    sin, cos = observation[SIN_E_3] * scales[SIN_E_3], observation[COS_E_3] * scales[COS_E_3]
    if row.ahead > 0.0:
        v_1, v_2 = linearised_twist(e_1, e_2, sin, cos, u_1, u_2, row.ahead, row.decay)
        if row.rejection.at_once > 0.0:
            cancelled = row.limits.slip  # what the limiter subtracts counts as motion by the wheels
            memory = observed_rejection(
                memory,
                row.rejection,
                row.ahead,
                whole_1,
                whole_2,
                sin,
                cos,
                now_1,
                now_2,
                observation[ODOMETRY_1] * scales[ODOMETRY_1]
                + cancelled * observation[SLIP_1] * scales[SLIP_1],
                observation[ODOMETRY_2] * scales[ODOMETRY_2]
                + cancelled * observation[SLIP_2] * scales[SLIP_2],
            )
            v_1, v_2 = v_1 - memory.d_1, v_2 - memory.d_2
    else:
        v_1, v_2 = tracking_twist(e_1, e_2, sin, cos, u_1, u_2, row.gains)
    return v_1, v_2, memory


@law
def received_predecessor(observation: np.ndarray, scales: np.ndarray) -> Predecessor:
    """The predecessor from one ``tracking`` observation."""
    i = PREDECESSOR
    return Predecessor(
        observation[i] * scales[i],
        observation[i + 1] * scales[i + 1],
        observation[i + 2] * scales[i + 2],
        observation[i + 3] * scales[i + 3],
        observation[i + 4] * scales[i + 4],
        observation[i + 5] * scales[i + 5],
    )


@law
def heard_message(observation: np.ndarray, scales: np.ndarray, i: int) -> Message:
    """The message behind six entries from ``i`` on, in a world with the robot at its origin, heading 0."""
    return Message(
        observation[i + 1] * scales[i + 1],
        observation[i] * scales[i],
        math.atan2(observation[i + 2] * scales[i + 2], observation[i + 3] * scales[i + 3]),
        observation[i + 4] * scales[i + 4],
        observation[i + 5] * scales[i + 5],
    )


@law
def allowed_twist(
    observation: np.ndarray,
    scales: np.ndarray,
    row: ControllerRow,
    supervisor: SupervisorRow,
    u_1: float,
    u_2: float,
) -> tuple[float, float]:
    """A twist (mm/s, rad/s) as the supervisor allows it, before the limits of :func:`twist_action`."""
    i = supervisor.place
    if i < 0 or observation[i] * scales[i] < 0.5:
        return u_1, u_2
    other = heard_message(observation, scales, i + 1)
    ahead = heard_message(observation, scales, PREDECESSOR)
    now = (
        observation[COMMAND_1] * scales[COMMAND_1]
        + row.limits.slip * observation[SLIP_1] * scales[SLIP_1]
    )
    later_bend = curvature(observation[U_1] * scales[U_1], observation[U_2] * scales[U_2])
    return supervised_twist(u_1, u_2, now, later_bend, other, ahead, supervisor)


@law
def twist_action(
    observation: np.ndarray, scales: np.ndarray, row: ControllerRow, u_1: float, u_2: float
) -> tuple[float, float]:
    """The ``twist`` action that commands a twist (mm/s, rad/s), within the limits."""
    cruise, e_1 = observation[U_1] * scales[U_1], observation[E_1] * scales[E_1]
    u_1 = max(closing_speed(u_1, cruise, e_1, row.limits), -row.limits.reverse)
    if row.spacing.distance > 0.0 and observation[IS_LEADER] * scales[IS_LEADER] < 0.5:
        u_1, u_2 = spaced_twist(u_1, u_2, received_predecessor(observation, scales), row.spacing)
    v_1, v_2 = limited_twist(
        u_1,
        u_2,
        observation[COMMAND_1] * scales[COMMAND_1],
        observation[COMMAND_2] * scales[COMMAND_2],
        observation[SLIP_1] * scales[SLIP_1],
        observation[SLIP_2] * scales[SLIP_2],
        cruise,
        math.hypot(e_1, observation[E_2] * scales[E_2]),
        row.limits,
    )
    return clipped_action(v_1 / FULL_SPEED_MM_S), clipped_action(v_2 / FULL_YAW_RATE_RAD_S)


@law
def reference_action(
    observation: np.ndarray, scales: np.ndarray, row: ControllerRow, memory: RejectionState
) -> tuple[float, float, RejectionState]:
    """The ``twist`` action of the reference controller from one observation, and its next memory."""
    u_1, u_2, memory = wanted_twist(observation, scales, row, memory)
    a_0, a_1 = twist_action(observation, scales, row, u_1, u_2)
    return a_0, a_1, memory


@law
def residual_share(observation: np.ndarray, scales: np.ndarray, fade: float, reach: float) -> float:
    """Weight of a residual at the estimated error e (mm): e/(e + fade) · reach⁴/(e⁴ + reach⁴).

    A residual is an action added to a base controller's twist. Near the reference and far from it the base
    controller acts alone. Near, a residual then only changes the gain, and its bias causes no steady error;
    far, the base controller is known to return. An action about the reference has the first
    factor alone. The weight is 1 if ``fade`` is 0 and ``reach`` infinite.
    """
    if fade == 0.0 and reach == math.inf:
        return 1.0
    e_1, e_2 = observation[E_1] * scales[E_1], observation[E_2] * scales[E_2]
    squared = e_1 * e_1 + e_2 * e_2
    error = math.sqrt(squared)
    near = 1.0 if fade == 0.0 else error / (error + fade)
    far = squared / (reach * reach)
    return near / (1.0 + far * far)


@law
def wheel_command(
    a_0: float, a_1: float, kind: int, body: Body, belief: Belief
) -> tuple[float, float]:
    """Wheel speeds (left, right; rad/s) that a ``twist`` or ``wheel_speed`` action commands."""
    if kind == WHEEL_SPEED:
        return a_0 * FULL_WHEEL_SPEED_RAD_S, a_1 * FULL_WHEEL_SPEED_RAD_S
    return believed_wheel_speeds(a_0 * FULL_SPEED_MM_S, a_1 * FULL_YAW_RATE_RAD_S, body, belief)
