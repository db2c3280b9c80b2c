"""The ``pymunk`` plant: one formation in a Chipmunk space, for contact between robots and with objects.

The kernel computes centre of mass, angle and velocities, and advances poses exactly as Chipmunk does.
While nothing in the space could act on a robot, a step of Chipmunk would change nothing about the robots and
is left out. Otherwise each substep of a control step runs through the space, and only robots that a contact,
a constraint or a force has moved are read back.
"""

from __future__ import annotations

import math
from functools import partial
from typing import Any, NamedTuple

import numpy as np
import pymunk

from tlf_env.physics.parameters import Body, RobotParameters, body_array
from tlf_env.physics.state import Motion

ITERATIONS = 20
COLLISION_SLOP_MM = 0.1
CONTACT_FRICTION = 0.0
SEPARATED = 3  # Chipmunk's state of a contact that has ended, and is remembered for some steps

X, Y, THETA, V_X, V_Y, YAW = (
    Motion._fields.index(name) for name in ("x", "y", "theta", "v_x", "v_y", "w")
)


# What the objects that a user has put into the space do within a control step.
NO_OBJECTS, OUT_OF_REACH, WITHIN_REACH = range(3)
REACH_MM = 10.0  # objects that could come closer to an outline than this are within reach
FASTEST_CHANGE_MM_S2 = 1500.0  # of a robot's velocity, as in tlf_env.engine.outlines


class Rest(NamedTuple):
    """State of a user's body, to which a reset puts it back."""

    position: tuple[float, float]
    angle: float
    velocity: tuple[float, float]
    angular_velocity: float


class Correction(NamedTuple):
    """A velocity that Chipmunk adds to a body's own in the next step only."""

    x: float  # mm/s
    y: float
    turning: float  # rad/s


class PymunkPlant:
    """Bodies of one formation in a :class:`pymunk.Space`; outlines are circles, contact is inelastic.

    A user may add shapes, bodies and constraints to the space; they take part in every step. A reset puts
    the user's bodies back to where they were when the first step found them.
    """

    def __init__(self, robots: list[RobotParameters]) -> None:
        space = pymunk.Space()
        space.iterations = ITERATIONS
        space.collision_slop = COLLISION_SLOP_MM
        space.damping = 1.0
        space.gravity = (0.0, 0.0)
        self._space = space
        self._constants = body_array(robots)[:, :, 0]
        self.bodies: list[pymunk.Body] = []  # of the robots
        for row in self._constants.T.tolist():
            robot = Body(*row)
            body = pymunk.Body(robot.m, robot.I)
            outline = pymunk.Circle(body, robot.outline_radius, offset=(0.0, robot.outline_ahead))
            outline.friction = CONTACT_FRICTION
            outline.elasticity = 0.0
            space.add(body, outline)
            self.bodies.append(body)
        self._outlines = [next(iter(body.shapes)) for body in self.bodies]
        self._number = {body: i for i, body in enumerate(self.bodies)}
        self._shared = False  # whether a user has had the space
        self._rests: dict[pymunk.Body, Rest] = {}
        self.reset()

    def reset(self, constants: np.ndarray | None = None) -> None:
        """Forget all contacts and put the user's bodies back, so that a run repeats bit for bit.

        ``constants`` (field, robot) are the bodies' constants of the kernel; None keeps the last ones.
        """
        if constants is not None:
            self._constants = constants.copy()
        space = self._space
        shapes = [*self._outlines, *(one for one in space.shapes if one not in self._outlines)]
        space.remove(*shapes)  # with a shape its contacts go
        for body in space.bodies:
            _take_correction(body)
        for body, rest in self._rests.items():
            body.angle, body.position = rest.angle, rest.position
            body.velocity, body.angular_velocity = rest.velocity, rest.angular_velocity
        for body, outline, row in zip(
            self.bodies, self._outlines, self._constants.T.tolist(), strict=True
        ):
            robot = Body(*row)
            self._weigh(body, robot)
            outline.unsafe_set_radius(robot.outline_radius)
            outline.unsafe_set_offset((0.0, robot.outline_ahead))
        space.add(*shapes)
        self._moved: set[int] = set()
        self._moved_before: set[int] = set()
        self._corrections: list[tuple[pymunk.Body, Correction]] = []
        self.hit: set[int] = set()  # robots that touched a wall or a moving obstacle in a substep

    def _weigh(self, body: pymunk.Body, robot: Body) -> None:
        """Give a robot's body its mass and inertia."""
        body.mass, body.moment = robot.m, robot.I

    def space(self, motions: np.ndarray) -> pymunk.Space:
        """The space with its bodies at ``motions`` (field, robot, 1)."""
        self._shared = True
        self._write(motions, motions)
        for body in self.bodies:
            self._space.reindex_shapes_for_body(body)
        return self._space

    def objects(self, motions: np.ndarray, duration: float) -> int:
        """What the user's objects could do within ``duration`` s.

        ``NO_OBJECTS``: there are none, or all are at rest and out of reach; ``OUT_OF_REACH``: some move, but
        cannot act on a robot; ``WITHIN_REACH``: something may act on a robot.
        """
        if not self._shared:
            return NO_OBJECTS
        space, robots = self._space, len(self.bodies)
        forced = any(_is_forced(body) for body in self.bodies)
        if not forced and len(space.shapes) == len(space.bodies) == robots:
            return NO_OBJECTS
        others = [
            body
            for body in space.bodies
            if body not in self._number and body.body_type != pymunk.Body.STATIC
        ]
        for body in others:
            self._rests.setdefault(
                body, Rest(body.position, body.angle, body.velocity, body.angular_velocity)
            )
        if forced or any(_is_forced(body) for body in others):
            return WITHIN_REACH
        falling = space.gravity != (0.0, 0.0)
        moving = [
            body
            for body in others
            if falling or body.velocity != (0.0, 0.0) or body.angular_velocity != 0.0
        ]
        fastest = max((_fastest_point(body) for body in moving), default=0.0)
        self._write(motions, motions)
        for body in moving:
            space.reindex_shapes_for_body(body)
        for body, outline in zip(self.bodies, self._outlines, strict=True):
            speed = _fastest_point(body) + fastest + 2.0 * FASTEST_CHANGE_MM_S2 * duration
            room = REACH_MM + speed * duration
            box = outline.cache_bb()
            near = pymunk.BB(box.left - room, box.bottom - room, box.right + room, box.top + room)
            for shape in space.bb_query(near, pymunk.ShapeFilter()):
                if shape.body not in self._number:
                    return WITHIN_REACH
        return OUT_OF_REACH if moving else NO_OBJECTS

    def advance_objects(self, motions: np.ndarray, steps: int, dt: float) -> None:
        """Run so many substeps of the space while the robots stand where they are."""
        self._write(motions, np.zeros_like(motions))
        for _ in range(steps):
            self._space.step(dt)

    def _write(self, poses: np.ndarray, velocities: np.ndarray) -> None:
        for i, body in enumerate(self.bodies):
            body.angle = poses[THETA, i, 0]
            body.position = poses[X, i, 0], poses[Y, i, 0]
            body.velocity = velocities[V_X, i, 0], velocities[V_Y, i, 0]
            body.angular_velocity = velocities[YAW, i, 0]

    def sort(self, motions: np.ndarray) -> None:
        """Make the space's index of outlines anew, robot by robot; to be called before a control step.

        The order in which Chipmunk solves contacts comes from that index, which otherwise depends on all
        that happened before, even on whether :meth:`space` was read. A body that changes its
        type leaves the index and enters it again, and keeps its contacts. Two robots have only one.
        """
        if len(self.bodies) <= 2 and len(self._space.shapes) == len(self.bodies):
            return
        for body in self.bodies:
            body.body_type = pymunk.Body.STATIC
        self._write(motions, motions)
        for body, row in zip(self.bodies, self._constants.T.tolist(), strict=True):
            robot = Body(*row)
            for outline in body.shapes:
                outline.cache_bb()
            body.body_type = pymunk.Body.DYNAMIC
            self._weigh(body, robot)

    def collide(self, before: np.ndarray, motions: np.ndarray, dt: float) -> None:
        """Run one substep of the space: from the poses ``before`` with the velocities of ``motions``.

        ``motions`` contains the new velocities and poses of the kernel; for robots that a contact has
        moved they are overwritten with those of Chipmunk. Chipmunk corrects positions in the step after
        it has solved a contact, so the robots of the previous step are included.
        """
        self._write(before, motions)
        self._moved_before, self._moved = self._moved, set()
        self._run(dt)
        for i, body in enumerate(self.bodies):
            if body.constraints or _is_forced(body):
                self._moved.add(i)
        for i in self._moved | self._moved_before:
            body = self.bodies[i]
            motions[X, i, 0], motions[Y, i, 0] = body.position
            motions[THETA, i, 0] = body.angle
            motions[V_X, i, 0], motions[V_Y, i, 0] = body.velocity
            motions[YAW, i, 0] = body.angular_velocity

    def release(self) -> None:
        """Called after a control step that ran substep by substep."""

    def _run(self, dt: float) -> None:
        """A step of the space, and which robots a contact has moved in it."""
        if self._corrections:
            self._step_after_a_copy(dt)
        else:
            self._space.step(dt)
        self.hit = set()
        for i, body in enumerate(self.bodies):
            body.each_arbiter(self._remember, i)

    def _remember(self, arbiter: pymunk.Arbiter, robot: int) -> None:
        self._moved.add(robot)
        for shape in arbiter.shapes:
            body = shape.body
            if body is None or body in self._number:
                continue
            if body.body_type != pymunk.Body.DYNAMIC:
                self.hit.add(robot)

    def _step_after_a_copy(self, dt: float) -> None:
        """A step of the space that puts back what a copy leaves out, in the original as in the copy."""
        ended = [each for each in self._space._get_arbiters() if each.state == SEPARATED]

        def advance(correction: Correction, body: pymunk.Body, dt: float) -> None:
            for arbiter in ended:  # a copied space begins its step as if all contacts lasted
                arbiter.state = SEPARATED
            _advance_corrected(correction, body, dt)

        for body, correction in self._corrections:
            body.position_func = partial(advance, correction)
        self._space.step(dt)
        for body, _ in self._corrections:
            body.position_func = pymunk.Body.update_position
            body._position_func = None  # pymunk before 7.3.1 keeps the last one, and copies it
        self._corrections = []

    def __getstate__(self) -> dict[str, Any]:
        """Everything, with the contacts' memory: what pymunk keeps of it, and what it leaves out."""
        if not self._corrections:
            self._corrections = [(body, _take_correction(body)) for body in self._space.bodies]
        return self.__dict__.copy()


def _is_forced(body: pymunk.Body) -> bool:
    """Whether a force, a constraint or a function of the user's may change a body's motion."""
    return bool(
        body.force != (0.0, 0.0)
        or body.torque
        or body.constraints
        or body.velocity_func is not pymunk.Body.update_velocity
        or body.position_func is not pymunk.Body.update_position
    )


def _fastest_point(body: pymunk.Body) -> float:
    """A bound on the speed of all points of a body's shapes, mm/s."""
    radius = 0.0
    for shape in body.shapes:
        box = shape.cache_bb()
        far_x = max(abs(box.left - body.position.x), abs(box.right - body.position.x))
        far_y = max(abs(box.bottom - body.position.y), abs(box.top - body.position.y))
        radius = max(radius, math.hypot(far_x, far_y))
    return body.velocity.length + abs(body.angular_velocity) * radius


def _take_correction(body: pymunk.Body) -> Correction:
    """The velocity with which Chipmunk's next step will push a body out of an overlap, taken from it.

    pymunk has no property for it. But a body at rest at the origin goes just that far in one second.
    """
    centre = body.center_of_gravity
    _move_origin(body, (0.0, 0.0))
    pose, twist = (body.position, body.angle), (body.velocity, body.angular_velocity)
    body.position, body.angle, body.velocity, body.angular_velocity = (
        (0.0, 0.0),
        0.0,
        (0.0, 0.0),
        0.0,
    )
    pymunk.Body.update_position(body, 1.0)
    correction = Correction(*body.position, body.angle)
    body.position, body.angle = pose
    body.velocity, body.angular_velocity = twist
    _move_origin(body, centre)
    return correction


def _move_origin(body: pymunk.Body, centre: tuple[float, float]) -> None:
    """Move a body's origin so that its centre of mass, which stays where it is, is at ``centre``."""
    body.center_of_gravity = centre
    body.angle = body.angle  # only now does the position follow


def _advance_corrected(correction: Correction, body: pymunk.Body, dt: float) -> None:
    """Chipmunk's own step of a pose, with a correction that was taken before: the same to the last bit."""
    velocity, turning = body.velocity, body.angular_velocity
    body.velocity = velocity.x + correction.x, velocity.y + correction.y
    body.angular_velocity = turning + correction.turning
    pymunk.Body.update_position(body, dt)
    body.velocity, body.angular_velocity = velocity, turning
