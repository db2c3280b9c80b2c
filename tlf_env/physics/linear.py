"""The plant linearised about steady rolling, for control design, for example with python-control."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from tlf_env.physics.kernel import substep
from tlf_env.physics.parameters import Body, FrictionCurve, RobotParameters, body
from tlf_env.physics.state import Contact, Floor, Motion, Push
from tlf_env.physics.units import MILLINEWTON_PER_NEWTON

STATES = ("forward_mm_s", "yaw_rad_s", "castor_rad")
INPUTS = ("torque_l_Nmm", "torque_r_Nmm")
OUTPUTS = ("omega_l_rad_s", "omega_r_rad_s")

STEP_S = 1e-5
PERTURBATIONS = np.array([1e-2, 1e-3, 1e-4, 1e-3, 1e-3])  # of the states, then the inputs
ENDLESS_GRIP = FrictionCurve(
    mu_static=1e6, mu_dynamic=1e6, stiction_speed_mm_s=1.0, dynamic_speed_mm_s=2.0
)


class LinearPlant(NamedTuple):
    """ẋ = A x + B u, y = C x + D u for deviations from the operating point.

    x: :data:`STATES`; u: :data:`INPUTS`; y: :data:`OUTPUTS`. ``state`` and ``torques_Nmm`` are the
    operating point.
    """

    A: np.ndarray  # (3, 3)
    B: np.ndarray  # (3, 2)
    C: np.ndarray  # (2, 3)
    D: np.ndarray  # (2, 2)
    state: np.ndarray  # (3,)
    torques_Nmm: np.ndarray  # (2,) steady torques, without friction

    def to_control(self) -> Any:
        """The model as a ``control.StateSpace`` with named signals (needs python-control)."""
        import control

        return control.ss(
            self.A,
            self.B,
            self.C,
            self.D,
            states=list(STATES),
            inputs=list(INPUTS),
            outputs=list(OUTPUTS),
        )


def _rolling_motion(robot: Body, forward: float, yaw: float, castor: float) -> Motion:
    """The motion with all wheels rolling at a state, at the origin, heading 0.

    It is the result of a previous substep: the wheels roll in frames that lie half a substep back.
    """
    pivot = robot.d + robot.q
    fork_rate = -(pivot * yaw * math.cos(castor) + forward * math.sin(castor)) / robot.T
    before = castor - 0.5 * STEP_S * (fork_rate - yaw)
    sin, cos = math.sin(before), math.cos(before)
    back = -0.5 * STEP_S * yaw
    return Motion(
        x=0.0,
        y=0.0,
        theta=0.0,
        psi=castor,
        v_x=yaw * robot.d * math.cos(back) - forward * math.sin(back),
        v_y=yaw * robot.d * math.sin(back) + forward * math.cos(back),
        w=yaw,
        s=-(pivot * yaw * cos + forward * sin) / robot.T,
        omega_l=(forward - yaw * robot.h) / robot.R,
        omega_r=(forward + yaw * robot.h) / robot.R,
        omega_c=(forward * cos - pivot * yaw * sin) / robot.R_c,
        angle_l=0.0,
        angle_r=0.0,
    )


def _rates(robot: Body, state: np.ndarray, torques_Nmm: np.ndarray) -> np.ndarray:
    motion = _rolling_motion(robot, *state.tolist())
    torque_l, torque_r = (torques_Nmm * MILLINEWTON_PER_NEWTON).tolist()
    after, _ = substep(
        robot,
        motion,
        Contact(*(0.0,) * len(Contact._fields)),
        Floor(conveyor_l=0.0, conveyor_r=0.0, grip_l=1.0, grip_r=1.0, grip_c=1.0),
        Push(0.0, 0.0, 0.0),
        torque_l,
        torque_r,
        STEP_S,
    )
    forward = -after.v_x * math.sin(0.5 * STEP_S * motion.w) + after.v_y * math.cos(
        0.5 * STEP_S * motion.w
    )
    change = np.array([forward - state[0], after.w - state[1], (after.s - after.w) * STEP_S])
    return change / STEP_S


def linearise(
    robot: RobotParameters | None = None, u_1_mm_s: float = 300.0, u_2_rad_s: float = 0.0
) -> LinearPlant:
    """The rolling robot about a steady speed and yaw rate, without dry friction.

    Joint friction is set-valued and has no derivative; as in eqs (6) and (7) of the paper it is a
    disturbance at the input. In forward motion the castor trails, and a centre of mass behind the axle
    makes the yaw mode unstable.

    Raises
    ------
    ValueError
        for a speed that is not positive, or a curve so tight that the castor cannot trail.
    """
    if not math.isfinite(u_1_mm_s) or u_1_mm_s <= 0:
        raise ValueError(
            f"u_1_mm_s {u_1_mm_s} must be above 0: at rest the castor has no direction"
        )
    robot = robot or RobotParameters()
    row = body(robot.model_copy(update={"joint_friction": False, "tyre": ENDLESS_GRIP}))
    # φ̇ = 0: the fork turns with the body, u₂(a cos φ + T) + u₁ sin φ = 0, a tangent to a circle.
    a = row.d + row.q
    reach = math.hypot(u_1_mm_s, a * u_2_rad_s)
    if not math.isfinite(u_2_rad_s) or abs(row.T * u_2_rad_s) >= reach:
        raise ValueError(f"u_2_rad_s {u_2_rad_s} at {u_1_mm_s} mm/s is too tight a curve")
    castor = -math.asin(row.T * u_2_rad_s / reach) - math.atan2(a * u_2_rad_s, u_1_mm_s)
    state = np.array([u_1_mm_s, u_2_rad_s, castor])

    B = np.empty((3, 2))
    torques = np.zeros(2)
    for i, step in enumerate(PERTURBATIONS[3:]):
        d = step * np.eye(2)[i]
        B[:, i] = (_rates(row, state, torques + d) - _rates(row, state, torques - d)) / (2 * step)
    torques = -np.linalg.solve(B[:2], _rates(row, state, torques)[:2])
    A = np.empty((3, 3))
    for i, step in enumerate(PERTURBATIONS[:3]):
        d = step * np.eye(3)[i]
        A[:, i] = (_rates(row, state + d, torques) - _rates(row, state - d, torques)) / (2 * step)
    C = np.array([[1.0, -row.h, 0.0], [1.0, row.h, 0.0]]) / row.R
    return LinearPlant(A, B, C, np.zeros((2, 2)), state, torques)
