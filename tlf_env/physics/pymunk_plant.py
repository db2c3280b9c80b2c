"""The ``pymunk`` plant: one formation in a Chipmunk space, for contact between robots.

The kernel computes centre of mass, angle and velocities, and advances poses exactly as Chipmunk does.
While all outlines are well apart, a step of Chipmunk would change nothing and is left out. While robots
are close, each substep runs through the space, and only robots that a contact has moved are read back.
"""

from __future__ import annotations

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


class Correction(NamedTuple):
    """A velocity that Chipmunk adds to a body's own in the next step only."""

    x: float  # mm/s
    y: float
    turning: float  # rad/s


class PymunkPlant:
    """Bodies of one formation in a :class:`pymunk.Space`; outlines are circles, contact is inelastic."""

    def __init__(self, robots: list[RobotParameters]) -> None:
        self.reset(body_array(robots)[:, :, 0])

    def reset(self, constants: np.ndarray | None = None) -> None:
        """Rebuild the space without contacts, so that a run repeats bit for bit.

        ``constants`` (field, robot) are the bodies' constants of the kernel; None keeps the last ones.
        """
        if constants is not None:
            self._constants = constants.copy()
        space = pymunk.Space()
        space.iterations = ITERATIONS
        space.collision_slop = COLLISION_SLOP_MM
        space.damping = 1.0
        space.gravity = (0.0, 0.0)
        self._bodies: list[pymunk.Body] = []
        for row in self._constants.T.tolist():
            robot = Body(*row)
            body = pymunk.Body(robot.m, robot.I)
            outline = pymunk.Circle(body, robot.outline_radius, offset=(0.0, robot.outline_ahead))
            outline.friction = CONTACT_FRICTION
            outline.elasticity = 0.0
            space.add(body, outline)
            self._bodies.append(body)
        space.on_collision(post_solve=self._remember)
        self._number = {body: i for i, body in enumerate(self._bodies)}
        self._moved: set[int] = set()
        self._moved_before: set[int] = set()
        self._corrections: list[Correction] = []
        self._space = space

    def _remember(self, arbiter: pymunk.Arbiter, _space: pymunk.Space, _data: Any) -> None:
        for shape in arbiter.shapes:
            if shape.body in self._number:
                self._moved.add(self._number[shape.body])

    def space(self, motions: np.ndarray) -> pymunk.Space:
        """The space with its bodies at ``motions`` (field, robot, 1), for drawing and queries."""
        self._write(motions, motions)
        for body in self._bodies:
            self._space.reindex_shapes_for_body(body)
        return self._space

    def _write(self, poses: np.ndarray, velocities: np.ndarray) -> None:
        for i, body in enumerate(self._bodies):
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
        if len(self._bodies) <= 2:
            return
        for body in self._bodies:
            body.body_type = pymunk.Body.STATIC
        self._write(motions, motions)
        for body, row in zip(self._bodies, self._constants.T.tolist(), strict=True):
            robot = Body(*row)
            for outline in body.shapes:
                outline.cache_bb()
            body.body_type = pymunk.Body.DYNAMIC
            body.mass, body.moment = robot.m, robot.I

    def collide(self, before: np.ndarray, motions: np.ndarray, dt: float) -> None:
        """Run one substep of the space: from the poses ``before`` with the velocities of ``motions``.

        ``motions`` contains the new velocities and poses of the kernel; for robots that a contact has
        moved they are overwritten with those of Chipmunk. Chipmunk corrects positions in the step after
        it has solved a contact, so the robots of the previous step are included.
        """
        self._write(before, motions)
        self._moved_before, self._moved = self._moved, set()
        if self._corrections:
            self._step_after_a_copy(dt)
        else:
            self._space.step(dt)
        for i in self._moved | self._moved_before:
            body = self._bodies[i]
            motions[X, i, 0], motions[Y, i, 0] = body.position
            motions[THETA, i, 0] = body.angle
            motions[V_X, i, 0], motions[V_Y, i, 0] = body.velocity
            motions[YAW, i, 0] = body.angular_velocity

    def _step_after_a_copy(self, dt: float) -> None:
        """A step of the space that puts back what a copy leaves out, in the original as in the copy."""
        ended = [each for each in self._space._get_arbiters() if each.state == SEPARATED]

        def advance(correction: Correction, body: pymunk.Body, dt: float) -> None:
            for arbiter in ended:  # a copied space begins its step as if all contacts lasted
                arbiter.state = SEPARATED
            _advance_corrected(correction, body, dt)

        for body, correction in zip(self._space.bodies, self._corrections, strict=True):
            body.position_func = partial(advance, correction)
        self._space.step(dt)
        for body in self._space.bodies:
            body.position_func = pymunk.Body.update_position
            body._position_func = None  # pymunk before 7.3.1 keeps the last one, and copies it
        self._corrections = []

    def __getstate__(self) -> dict[str, Any]:
        """Everything, with the contacts' memory: what pymunk keeps of it, and what it leaves out."""
        if not self._corrections:
            self._corrections = [_take_correction(body) for body in self._space.bodies]
        return self.__dict__.copy()


def _take_correction(body: pymunk.Body) -> Correction:
    """The velocity with which Chipmunk's next step will push a body out of an overlap, taken from it.

    pymunk has no property for it. But a body at rest at the origin goes just that far in one second.
    """
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
    return correction


def _advance_corrected(correction: Correction, body: pymunk.Body, dt: float) -> None:
    """Chipmunk's own step of a pose, with a correction that was taken before: the same to the last bit."""
    velocity, turning = body.velocity, body.angular_velocity
    body.velocity = velocity.x + correction.x, velocity.y + correction.y
    body.angular_velocity = turning + correction.turning
    pymunk.Body.update_position(body, dt)
    body.velocity, body.angular_velocity = velocity, turning
