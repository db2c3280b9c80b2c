"""The ``pymunk`` plant: one formation in a Chipmunk space, for contact between robots.

The kernel computes centre of mass, angle and velocities, and advances poses exactly as Chipmunk does.
While all outlines are well apart, a step of Chipmunk would change nothing and is left out. While robots
are close, each substep runs through the space, and only robots that a contact has moved are read back.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import pymunk

from tlf_env.physics.parameters import Body, RobotParameters, body_array
from tlf_env.physics.state import Motion

ITERATIONS = 20
COLLISION_SLOP_MM = 0.1
CONTACT_FRICTION = 0.0

X, Y, THETA, V_X, V_Y, YAW = (
    Motion._fields.index(name) for name in ("x", "y", "theta", "v_x", "v_y", "w")
)


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

    def collide(self, before: np.ndarray, motions: np.ndarray, dt: float) -> None:
        """Run one substep of the space: from the poses ``before`` with the velocities of ``motions``.

        ``motions`` contains the new velocities and poses of the kernel; for robots that a contact has
        moved they are overwritten with those of Chipmunk. Chipmunk corrects positions in the step after
        it has solved a contact, so the robots of the previous step are included.
        """
        self._write(before, motions)
        self._moved_before, self._moved = self._moved, set()
        self._space.step(dt)
        for i in self._moved | self._moved_before:
            body = self._bodies[i]
            motions[X, i, 0], motions[Y, i, 0] = body.position
            motions[THETA, i, 0] = body.angle
            motions[V_X, i, 0], motions[V_Y, i, 0] = body.velocity
            motions[YAW, i, 0] = body.angular_velocity

    def __getstate__(self) -> dict[str, Any]:
        return {"constants": self._constants}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.reset(state["constants"])
