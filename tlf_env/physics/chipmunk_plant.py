"""The ``chipmunk`` plant: each robot is made of pymunk's own bodies and constraints (``docs/chipmunk.md``).

An engine beside the exact kernel: Chipmunk moves the bodies and solves all impulses. Here only the friction
limits of a substep are computed, with the kernel's laws, because a constraint of Chipmunk has one constant
limit of its force.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pymunk

from tlf_env.numerics.compiled import compile_for, driver, law
from tlf_env.numerics.rows import reader
from tlf_env.numerics.trig import sincos
from tlf_env.physics.friction import disc
from tlf_env.physics.friction_limits import friction_limits, grip
from tlf_env.physics.parameters import Body, RobotParameters
from tlf_env.physics.pymunk_plant import WITHIN_REACH, PymunkPlant
from tlf_env.physics.state import (
    Contact,
    Floor,
    Motion,
    Rates,
    read_body,
    read_contact,
    read_motion,
    write_contact,
)
from tlf_env.physics.sweeps import Slips, share_lateral, tyre_slips
from tlf_env.physics.world import World

ITERATIONS = 50
# The fork's share of the mass. It changes nothing about the robot, whose mass, centre of mass and inertia
# are those of its parameters; but iterations converge slowly between bodies of very different mass.
FORK_SHARE = 0.05
ARM_MM = 1000.0  # between the two ends of a tyre's constraint: long, so that its direction is exact
HELD_KG = 1e12  # of bodies that only turn
REST = 1e-9  # mm/s and rad/s: a robot whose bodies are all slower is at rest

# Rows of the array of limits: largest forces, and largest torques of friction at the joints.
FORCES = ("axle", "forward_l", "forward_r", "castor_across", "castor_along")
TORQUES = ("spin_l", "spin_r", "spin_c", "steering")

ANGLES = [Motion._fields.index(name) for name in ("angle_l", "angle_r")]
DRIVE_SPINS = [Motion._fields.index(name) for name in ("omega_l", "omega_r")]
CONTACT_IMPULSES = Contact._fields.index("slip_l")  # they come first
INVERSE_J = Body._fields.index("inverse_J")

read_floor = reader(Floor)


@law
def circle_limits(
    b_1: float, b_2: float, w_1: float, w_2: float, radius: float
) -> tuple[float, float]:
    """Limits of two perpendicular friction impulses, whose vector then never leaves the circle of ``radius``.

    ``b`` is an estimate of the slip that there would be without friction, ``w`` are the inverse masses. If
    the tyre slides, the limits are the components of the impulse on the circle. If it sticks, they are the
    impulses that it needs, and the same room for more in both directions.
    """
    q_1, q_2, lam = disc(w_1, w_2, 0.0, b_1, b_2, radius)
    if lam > 0.0:
        return abs(q_1), abs(q_2)
    room = 0.5 * max(radius * radius - q_1 * q_1 - q_2 * q_2, 0.0)
    return math.sqrt(q_1 * q_1 + room), math.sqrt(q_2 * q_2 + room)


@law
def with_sign(p: float, q: float, turned: float, R: float) -> float:
    """A tyre's impulse ``p`` with its sign: with the joint's ``q`` it makes the wheel's change of spin.

    Chipmunk gives both without their signs; ``turned`` is the angular momentum ± q − R p.
    """
    up, down = (q - turned) / R, (-q - turned) / R
    return math.copysign(p, up if abs(abs(up) - p) < abs(abs(down) - p) else down)


@law
def slips_of(body: Body, motion: Motion, floor: Floor) -> tuple[Slips, float, float]:
    """Slip velocities in the frames of a motion, and cosine and sine of its castor angle."""
    sin_t, cos_t = sincos(motion.theta)
    sin_p, cos_p = sincos(motion.psi - motion.theta)
    rates = Rates(
        v_e=cos_t * motion.v_x + sin_t * motion.v_y,
        v_f=-sin_t * motion.v_x + cos_t * motion.v_y,
        w=motion.w,
        s=motion.s,
        omega_l=motion.omega_l,
        omega_r=motion.omega_r,
        omega_c=motion.omega_c,
    )
    return tyre_slips(body, rates, floor, cos_p, sin_p), cos_p, sin_p


@driver
def set_limits(
    bodies: np.ndarray,
    motions: np.ndarray,
    contacts: np.ndarray,
    floors: np.ndarray,
    jumps: np.ndarray,
    limits: np.ndarray,
    dt: float,
) -> None:
    """Write the limits of the coming substep, (FORCES and TORQUES, robot), in mN and mN·mm.

    The other arrays are (field, robot, 1).
    The slip that there would be without friction is estimated: the last slip, less what the last impulse
    did, and what the jumps of the motors' torques (2, robot) will do.
    """
    for i in range(bodies.shape[1]):
        body, motion = read_body(bodies, i, 0), read_motion(motions, i, 0)
        contact, floor = read_contact(contacts, i, 0), read_floor(floors, i, 0)
        most = friction_limits(body, motion, contact, floor, dt)
        slips, cos_p, sin_p = slips_of(body, motion, floor)
        w_ff, turn = body.w_ff + body.spin_drive, body.R * body.inverse_J * dt
        e_l, f_l = circle_limits(
            abs(slips.e) + body.w_ee * abs(contact.p_le),
            slips.lf - w_ff * contact.p_lf - turn * jumps[0, i],
            body.w_ee,
            w_ff,
            most.grip_l,
        )
        e_r, f_r = circle_limits(
            abs(slips.e) + body.w_ee * abs(contact.p_re),
            slips.rf - w_ff * contact.p_rf - turn * jumps[1, i],
            body.w_ee,
            w_ff,
            most.grip_r,
        )
        q_cos, q_sin = body.q * cos_p, body.q * sin_p
        w_xx = body.inverse_m + q_cos * q_cos * body.inverse_I + body.T * body.T * body.inverse_I_s
        w_yy = body.inverse_m + q_sin * q_sin * body.inverse_I + body.spin_castor
        x_c, y_c = circle_limits(
            abs(slips.cx) + w_xx * abs(contact.p_cx),
            abs(slips.cy) + w_yy * abs(contact.p_cy),
            w_xx,
            w_yy,
            most.grip_c,
        )
        limits[0, i] = (e_l + e_r) / dt
        limits[1, i], limits[2, i] = f_l / dt, f_r / dt
        limits[3, i], limits[4, i] = x_c / dt, y_c / dt
        limits[5, i], limits[6, i] = most.axle_l / dt, most.axle_r / dt
        limits[7, i], limits[8, i] = most.axle_c / dt, most.steering / dt


@driver
def record(
    bodies: np.ndarray,
    motions: np.ndarray,
    contacts: np.ndarray,
    floors: np.ndarray,
    spins: np.ndarray,
    impulses: np.ndarray,
    dt: float,
) -> None:
    """Write ``contacts`` after a substep from the constraints' impulses, (FORCES and TORQUES, robot).

    ``spins`` (2, robot) are the drive wheels' with the torques and without friction. Impulses but those
    along the drive wheels are without sign, as Chipmunk gives them.
    """
    for i in range(bodies.shape[1]):
        body, motion = read_body(bodies, i, 0), read_motion(motions, i, 0)
        contact, floor = read_contact(contacts, i, 0), read_floor(floors, i, 0)
        q_l, q_r = impulses[5, i], impulses[6, i]
        turned_l = body.J * (motion.omega_l - spins[0, i])
        turned_r = body.J * (motion.omega_r - spins[1, i])
        p_lf = with_sign(impulses[1, i], q_l, turned_l, body.R)
        p_rf = with_sign(impulses[2, i], q_r, turned_r, body.R)
        grip_l = grip(body, body.load_drive, floor.grip_l, contact.slip_l, dt)
        grip_r = grip(body, body.load_drive, floor.grip_r, contact.slip_r, dt)
        p_le, p_re = share_lateral(impulses[0, i], p_lf, 0.0, p_rf, grip_l, grip_r)
        slips, _, _ = slips_of(body, motion, floor)
        after = Contact(
            p_le=p_le,
            p_lf=p_lf,
            p_re=p_re,
            p_rf=p_rf,
            p_cx=impulses[3, i],
            p_cy=impulses[4, i],
            q_l=q_l,
            q_r=q_r,
            q_c=impulses[7, i],
            q_s=impulses[8, i],
            slip_l=math.sqrt(slips.e * slips.e + slips.lf * slips.lf),
            slip_r=math.sqrt(slips.e * slips.e + slips.rf * slips.rf),
            slip_c=math.sqrt(slips.cx * slips.cx + slips.cy * slips.cy),
        )
        write_contact(contacts, i, 0, after)


def pin(
    a: pymunk.Body, b: pymunk.Body, at_a: tuple[float, float], at_b: tuple[float, float]
) -> pymunk.PinJoint:
    """A constraint of the velocity along the line through two points; it does not correct positions."""
    joint = pymunk.PinJoint(a, b, at_a, at_b)
    joint.max_bias = 0.0
    return joint


class RobotBodies:
    """One robot's bodies and constraints; lengths and angles as in ``docs/physics.md``.

    The chassis belongs to the space, with the outline. The others are put into it for a control step:

    - the fork, on a pivot of the chassis;
    - a body for each wheel's spin. It lies in the floor's plane with its rim on the line of rolling, so that
      the rim's speed along the line is Rω, and it moves with the floor under its wheel;
    - two frames, bodies at rest that are placed where chassis and fork will be: the floor, as seen by
      the tyres' constraints across the wheels.
    """

    tyre_count = len(FORCES)
    rim_mm = ARM_MM  # how far ahead of its tyre a wheel's rim is held

    def __init__(self, chassis: pymunk.Body, robot: Body) -> None:
        self.chassis = chassis
        self.fork = pymunk.Body()
        self.spins = [pymunk.Body(HELD_KG, 1.0) for _ in range(3)]  # left, right, castor
        self.frame = pymunk.Body(body_type=pymunk.Body.KINEMATIC)
        self.fork_frame = pymunk.Body(body_type=pymunk.Body.KINEMATIC)
        self.limited: list[pymunk.Constraint] = []  # tyres as in FORCES, then joints as in TORQUES
        self.constraints: list[pymunk.Constraint] = []
        self.weigh(robot)

    @property
    def bodies(self) -> list[pymunk.Body]:
        """All but the chassis."""
        return [self.fork, *self.spins, self.frame, self.fork_frame]

    def weigh(self, robot: Body) -> None:
        """Masses and inertias; the chassis has what the fork leaves of the robot's."""
        self.robot = robot
        # At most half of the robot's inertia may be the fork's mass on its lever.
        ratio = max((1.0 - FORK_SHARE) / FORK_SHARE, 2.0 * robot.m * robot.q**2 / robot.I)
        self.fork_mass = robot.m / (1.0 + ratio)
        self.chassis_mass = robot.m - self.fork_mass
        self.ahead = self.fork_mass * robot.q / self.chassis_mass
        inertia = robot.I - self.fork_mass * robot.q**2 - self.chassis_mass * self.ahead**2
        self.chassis.mass, self.chassis.moment = self.chassis_mass, inertia
        self.chassis.center_of_gravity = 0.0, self.ahead
        self.fork.mass, self.fork.moment = self.fork_mass, robot.I_s
        for spin, inertia in zip(self.spins, (robot.J, robot.J, robot.J_c), strict=True):
            spin.moment = inertia

    def tyres(self) -> list[pymunk.Constraint]:
        """The tyres' constraints, in the order of ``FORCES``.

        The tyres of both drive wheels act along the axle, so that only the sum of their lateral forces
        matters: one constraint has it.
        """
        r, chassis, fork = self.robot, self.chassis, self.fork
        left, right, castor = self.spins
        return [
            pin(self.frame, chassis, (-ARM_MM, r.d), (0.0, r.d)),
            pin(chassis, left, (-r.h, r.d), (r.R, 0.0)),
            pin(chassis, right, (r.h, r.d), (r.R, 0.0)),
            pin(self.fork_frame, fork, (-ARM_MM, -r.T), (0.0, -r.T)),
            pin(fork, castor, (0.0, -r.T), (r.R_c, 0.0)),
        ]

    def join(self, space: pymunk.Space) -> None:
        """Make all constraints anew, without memory of earlier impulses, and add everything to the space."""
        pivot = pymunk.PivotJoint(self.chassis, self.fork, (0.0, -self.robot.q), (0.0, 0.0))
        pivot.max_bias = 0.0  # the fork is put on its pivot in every control step
        tyres = self.tyres()
        joints = [
            *(pymunk.SimpleMotor(space.static_body, spin, 0.0) for spin in self.spins),
            pymunk.SimpleMotor(self.chassis, self.fork, 0.0),
        ]
        self.limited = [*tyres, *joints]
        self.constraints = [*joints, *tyres, pivot]  # Chipmunk solves them in this order
        space.add(*self.bodies, *self.constraints)

    def leave(self, space: pymunk.Space) -> None:
        """Take everything but the chassis out of the space."""
        space.remove(*self.constraints, *self.bodies)
        self.limited, self.constraints = [], []

    def write(self, motion: Motion) -> None:
        """Put the bodies where a motion says; the wheels' places follow in :meth:`place`."""
        r, chassis, fork = self.robot, self.chassis, self.fork
        sin, cos = math.sin(motion.theta), math.cos(motion.theta)
        chassis.angle, chassis.position = motion.theta, (motion.x, motion.y)
        chassis.velocity = (
            motion.v_x - motion.w * self.ahead * cos,
            motion.v_y - motion.w * self.ahead * sin,
        )
        chassis.angular_velocity = motion.w
        fork.angle, fork.position = motion.psi, (motion.x + r.q * sin, motion.y - r.q * cos)
        fork.velocity = motion.v_x + motion.w * r.q * cos, motion.v_y + motion.w * r.q * sin
        fork.angular_velocity = motion.s
        speeds = motion.omega_l, motion.omega_r, motion.omega_c
        for spin, omega in zip(self.spins, speeds, strict=True):
            spin.angular_velocity = omega

    def place(self, speeds: Sequence[float], belts: Sequence[float], dt: float) -> None:
        """Set the drive wheels' spins, and place wheels and frames for the coming substep.

        Chipmunk moves all bodies by their velocities before it solves, so that the places are those after
        that movement. ``belts`` are the speeds of the floor under the drive wheels.
        """
        r, chassis, fork = self.robot, self.chassis, self.fork
        left, right, castor = self.spins
        theta, (x, y), (v_x, v_y) = chassis.angle, chassis.position, chassis.velocity
        sin_0, cos_0 = math.sin(theta), math.cos(theta)
        theta += chassis.angular_velocity * dt
        sin, cos = math.sin(theta), math.cos(theta)
        x += v_x * dt + self.ahead * (sin - sin_0)
        y += v_y * dt - self.ahead * (cos - cos_0)
        self.frame.angle, self.frame.position = theta, (x, y)
        x, y = x - r.d * sin, y + r.d * cos
        for spin, side, omega, belt in zip((left, right), (-r.h, r.h), speeds, belts, strict=True):
            ahead, aside = self.rim_mm - belt * dt, side - r.R
            spin.angular_velocity, spin.angle = omega, theta - omega * dt
            spin.velocity = -belt * sin, belt * cos
            spin.position = x + aside * cos - ahead * sin, y + aside * sin + ahead * cos
        psi = fork.angle + fork.angular_velocity * dt
        (x, y), (v_x, v_y) = fork.position, fork.velocity
        x, y = x + v_x * dt, y + v_y * dt
        sin, cos = math.sin(psi), math.cos(psi)
        self.fork_frame.angle, self.fork_frame.position = psi, (x, y)
        ahead, aside = self.rim_mm - r.T, -r.R_c
        castor.angle, castor.velocity = psi - castor.angular_velocity * dt, (0.0, 0.0)
        castor.position = x + aside * cos - ahead * sin, y + aside * sin + ahead * cos

    def read(self, angle_l: float, angle_r: float) -> Motion:
        """The motion of the bodies, with these angles of the wheels."""
        chassis, fork = self.chassis, self.fork
        (x, y), (v_x, v_y), (fork_x, fork_y) = chassis.position, chassis.velocity, fork.velocity
        share = self.fork_mass / self.robot.m
        w, s = chassis.angular_velocity, fork.angular_velocity
        speeds = [spin.angular_velocity for spin in self.spins]
        if max(map(abs, (v_x, v_y, fork_x, fork_y, w, s, *speeds))) < REST:
            # Iterations only ever shrink what is left of a velocity, to numbers so small that processors
            # are slow with them.
            v_x = v_y = fork_x = fork_y = w = s = 0.0
            speeds = [0.0, 0.0, 0.0]
            for body in (chassis, fork, *self.spins):
                body.velocity, body.angular_velocity = (0.0, 0.0), 0.0
        return Motion(
            x=x,
            y=y,
            theta=chassis.angle,
            psi=fork.angle,
            v_x=v_x + share * (fork_x - v_x),
            v_y=v_y + share * (fork_y - v_y),
            w=w,
            s=s,
            omega_l=speeds[0],
            omega_r=speeds[1],
            omega_c=speeds[2],
            angle_l=angle_l,
            angle_r=angle_r,
        )


class ChipmunkPlant(PymunkPlant):
    """Robots of pymunk's bodies and constraints, in a space that they share with a user's objects.

    Between control steps the space has the chassis only, and what the user put there. A control step is
    :meth:`sort`, :meth:`advance` for each substep, and :meth:`release`. All constraints are made anew in each,
    so a copy that is made between control steps goes on as the original does.
    """

    kind = RobotBodies

    def __init__(
        self,
        robots: Sequence[RobotParameters],
        world: World | None = None,
        period_s: float = 0.02,
        iterations: int = ITERATIONS,
    ) -> None:
        self._robots: list[RobotBodies] = []
        super().__init__(robots, world, period_s)
        self._space.iterations = iterations
        self._limits = np.zeros((self.kind.tyre_count + len(TORQUES), len(robots)))
        self._impulses = np.zeros_like(self._limits)

    def reset(
        self,
        constants: np.ndarray | None = None,
        mover_offsets_s: Sequence[float] | None = None,
        shapes_by: Sequence[int] | None = None,
    ) -> None:
        """As of the plant ``pymunk``."""
        super().reset(constants, mover_offsets_s, shapes_by)
        self._torques = np.zeros((2, len(self.bodies)))  # of the last substep
        self._dt = 0.0

    def state_layout(self) -> dict[str, tuple[Any, tuple[int | None, ...]]]:
        """As of the plant ``pymunk``, and the torques (mN·mm) and the length (s) of the last substep."""
        torques = (np.float64, (2, len(self.bodies)))
        return {**super().state_layout(), "torques": torques, "dt": (np.float64, (1,))}

    def get_state(self) -> dict[str, np.ndarray]:
        """As of the plant ``pymunk``, between two control steps; constraints remember nothing then."""
        last = {"torques": self._torques.copy(), "dt": np.array([self._dt])}
        return {**super().get_state(), **last}

    def set_state(self, state: Mapping[str, np.ndarray], constants: np.ndarray) -> None:
        """As of the plant ``pymunk``."""
        super().set_state(state, constants)
        self._torques, self._dt = state["torques"].copy(), float(state["dt"][0])

    def _weigh(self, body: pymunk.Body, robot: Body) -> None:
        i = self.bodies.index(body)
        if i == len(self._robots):
            self._robots.append(self.kind(body, robot))
        self._robots[i].weigh(robot)

    def _write(self, poses: np.ndarray, velocities: np.ndarray) -> None:
        """Chassis only; their velocities are those of their own centres of mass."""
        super()._write(poses, velocities)
        for robot in self._robots:
            w = robot.chassis.angular_velocity
            robot.chassis.velocity -= robot.chassis.rotation_vector * (robot.ahead * w)

    @property
    def occupied(self) -> bool:
        """Always: the robots themselves move in the space."""
        return True

    def objects(self, motions: np.ndarray, step: int) -> int:
        """Something may always act on a robot, because it moves in the space only."""
        super().objects(motions, step)
        return WITHIN_REACH

    def sort(self, motions: np.ndarray, step: int = 0) -> None:
        """Begin a control step at ``motions`` (field, robot, 1): all bodies and constraints join the space."""
        super().sort(motions, step)
        self._held, self._pushing = self._forces, False
        for i, robot in enumerate(self._robots):
            robot.join(self._space)
            robot.write(Motion(*motions[:, i, 0].tolist()))

    def release(self) -> None:
        """End a control step: only the chassis stay in the space."""
        for robot in self._robots:
            robot.leave(self._space)

    def advance(
        self,
        motions: np.ndarray,
        contacts: np.ndarray,
        torques: np.ndarray,
        floors: np.ndarray,
        dt: float,
        pushes: np.ndarray | None = None,
    ) -> None:
        """One substep in place; arrays (field, robot, 1), torques in mN·mm.

        ``floors`` as :class:`Floor`, ``pushes`` as :class:`Push`.
        """
        if pushes is not None and (pushes.any() or self._pushing):
            self._push(pushes[:, :, 0])
        self.hits = {}
        parts = self._splits(dt)
        for _ in range(parts):
            self._advance_once(motions, contacts, torques, floors, dt / parts)

    def _advance_once(
        self,
        motions: np.ndarray,
        contacts: np.ndarray,
        torques: np.ndarray,
        floors: np.ndarray,
        dt: float,
    ) -> None:
        if self._dt not in (0.0, dt):  # the impulses of a substep of another length
            contacts[:CONTACT_IMPULSES] *= dt / self._dt
        self._dt = dt
        jumps, self._torques = torques[:, :, 0] - self._torques, torques[:, :, 0].copy()
        self._limit(motions, contacts, floors, jumps, dt)
        spins = motions[DRIVE_SPINS, :, 0]
        angles = motions[ANGLES, :, 0] + dt * spins
        spins = spins + dt * self._torques * self._constants[INVERSE_J]
        for i, robot in enumerate(self._robots):
            for constraint, limit in zip(robot.limited, self._limits[:, i].tolist(), strict=True):
                constraint.max_force = limit
            robot.place(spins[:, i].tolist(), floors[:2, i, 0].tolist(), dt)
        self._step_once(dt)
        for i, robot in enumerate(self._robots):
            motions[:, i, 0] = robot.read(*angles[:, i].tolist())
            self._impulses[:, i] = [constraint.impulse for constraint in robot.limited]
        self._record(motions, contacts, floors, spins, dt)

    def _push(self, pushes: np.ndarray) -> None:
        """Add forces from outside at the robots' centres of mass to those that users have applied."""
        forces = {body: (force, torque) for body, force, torque in self._held}
        for robot, (f_x, f_y, torque) in zip(self._robots, pushes.T.tolist(), strict=True):
            (held_x, held_y), held = forces.get(robot.chassis, ((0.0, 0.0), 0.0))
            sin, cos = math.sin(robot.chassis.angle), math.cos(robot.chassis.angle)
            lever_x, lever_y = robot.ahead * sin, -robot.ahead * cos  # from the chassis' own centre
            turning = torque + lever_x * f_y - lever_y * f_x
            forces[robot.chassis] = ((held_x + f_x, held_y + f_y), held + turning)
        self._forces = [(body, *both) for body, both in forces.items()]
        self._pushing = bool(pushes.any())

    def compile(
        self, motions: np.ndarray, contacts: np.ndarray, floors: np.ndarray, dt: float
    ) -> None:
        """Compile the drivers of a substep, or load them; the arguments as in :meth:`advance`."""
        bodies, wheels = self._constants[:, :, None], np.zeros((2, len(self._robots)))
        compile_for(set_limits, bodies, motions, contacts, floors, wheels, self._limits, dt)
        compile_for(record, bodies, motions, contacts, floors, wheels, self._impulses, dt)

    def _limit(
        self,
        motions: np.ndarray,
        contacts: np.ndarray,
        floors: np.ndarray,
        jumps: np.ndarray,
        dt: float,
    ) -> None:
        bodies = self._constants[:, :, None]
        set_limits(bodies, motions, contacts, floors, jumps, self._limits, dt)

    def _record(
        self,
        motions: np.ndarray,
        contacts: np.ndarray,
        floors: np.ndarray,
        spins: np.ndarray,
        dt: float,
    ) -> None:
        bodies = self._constants[:, :, None]
        record(bodies, motions, contacts, floors, spins, self._impulses, dt)
