"""The ``pymunk`` plant: one formation in a Chipmunk space, for contact between robots and with objects.

The kernel computes centre of mass, angle and velocities, and advances poses exactly as Chipmunk does.
While nothing in the space could act on a robot, a step of Chipmunk would change nothing about the robots and
is left out. Otherwise each substep of a control step runs through the space, and only robots that a contact,
a constraint or a force has moved are read back.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from functools import partial
from typing import Any, NamedTuple

import numpy as np
import pymunk
from pymunk.batch import BodyFields, Buffer, get_space_bodies

from tlf_env.physics.borders import Borders
from tlf_env.physics.objects import (
    Mover,
    Pushed,
    build_fixed,
    build_movers,
    build_pushables,
    damped_velocity,
)
from tlf_env.physics.parameters import Body, RobotParameters, body_array
from tlf_env.physics.reach import CLOSE_MARGIN_MM, FASTEST_CHANGE_MM_S2, time_for, way
from tlf_env.physics.shapes import PlacedShape, Pose, placed_link, placed_shape
from tlf_env.physics.space_state import (
    BODY_COLUMNS,
    CONTACT_COLUMNS,
    COUNTS,
    PAIR_COLUMNS,
    Correction,
    add_shapes,
    body_row,
    check_contacts,
    contacts_of,
    hold,
    put_body,
    put_contacts,
    scale_contacts,
    shape_numbers,
    structure_of,
    take_correction,
)
from tlf_env.physics.state import Motion
from tlf_env.physics.world import Capsule, World

ITERATIONS = 20
COLLISION_SLOP_MM = 0.1
SEPARATED = 3  # Chipmunk's state of a contact that has ended, and is remembered for some steps

X, Y, THETA, V_X, V_Y, YAW = (
    Motion._fields.index(name) for name in ("x", "y", "theta", "v_x", "v_y", "w")
)

POSE = [X, Y, THETA]
NO_CAPSULES, NO_OWNERS = np.zeros((0, len(Capsule._fields))), np.zeros(0, dtype=np.int64)

# What the objects in the space do within a control step, walls of the world apart.
NO_OBJECTS, OUT_OF_REACH, WITHIN_REACH = range(3)
MOST_CALM_S = 2.0  # so long objects may be taken to be out of reach without another look
STIRRED = (
    BodyFields.POSITION
    | BodyFields.ANGLE
    | BodyFields.VELOCITY
    | BodyFields.ANGULAR_VELOCITY
    | BodyFields.FORCE
    | BodyFields.TORQUE
)
# A body can pass through a thin one only if it moves farther in a step than half its own thickness.
LARGEST_MOVE = 0.25  # of that, within a step of the space
LEAST_HALF_MM = 0.5  # a body that is thinner counts as so thick
MOST_SPLITS = 1000  # of a substep
SPRINGS = (pymunk.DampedSpring, pymunk.DampedRotarySpring)
REST_COLUMNS = 6  # of a row with a Rest
AT_REST_MM_S = 1e-6  # a body that is slower, and rubs on the floor, is at rest


class Rest(NamedTuple):
    """State of a body, to which a reset puts it back."""

    position: tuple[float, float]
    angle: float
    velocity: tuple[float, float]
    angular_velocity: float


class PymunkPlant:
    """Bodies of one formation in a :class:`pymunk.Space`, with the things of a world.

    A user may add shapes, bodies and constraints to the space; they take part in every step. A reset puts
    the user's bodies back to where they were when the first step found them.

    Parameters
    ----------
    robots
        Parameters of each robot.
    world
        Walls, obstacles, and things to push.
    period_s
        Control period.
    """

    def __init__(
        self,
        robots: Sequence[RobotParameters],
        world: World | None = None,
        period_s: float = 0.02,
    ) -> None:
        space = pymunk.Space()
        space.iterations = ITERATIONS
        space.collision_slop = COLLISION_SLOP_MM
        space.damping = 1.0
        space.gravity = (0.0, 0.0)
        self._space = space
        self._period_s = period_s
        self._constants = body_array(list(robots))[:, :, 0]
        self._polygons = [robot.outline_polygon_mm for robot in robots]
        self.bodies: list[pymunk.Body] = []  # of the robots
        for row, parameters in zip(self._constants.T.tolist(), robots, strict=True):
            robot = Body(*row)
            body = pymunk.Body(robot.m, robot.I)
            outline: pymunk.Shape
            if parameters.outline_polygon_mm is None:
                centre = (0.0, robot.outline_ahead)
                outline = pymunk.Circle(body, robot.outline_radius, offset=centre)
            else:
                outline = pymunk.Poly(body, _from_com(parameters.outline_polygon_mm, robot))
            outline.friction = parameters.outline_friction
            outline.elasticity = parameters.outline_restitution
            space.add(body, outline)
            self.bodies.append(body)
        self._outlines = [next(iter(body.shapes)) for body in self.bodies]
        self._number = {body: i for i, body in enumerate(self.bodies)}
        world = World() if world is None else world
        self._walls = set(build_fixed(space, world))
        self._pushed: list[Pushed] = build_pushables(
            space, world, robots[0].gravity_mm_s2, floor=space.static_body
        )
        self._movers: list[Mover] = build_movers(space, world)
        self._floor = [joint for one in self._pushed for joint in one.joints]
        self._rests: dict[pymunk.Body, Rest] = {one.body: _rest(one.body) for one in self._pushed}
        self._shared = False  # whether a user has had the space
        self._borders: Borders | None = None  # of what rays see in the space, and for which shapes
        self._bordered: tuple[list[pymunk.Shape], list[bool]] = [], []
        self._buffer = Buffer()
        # Half the thickness and the farthest point of bodies, mm; found once per control step.
        self._sizes: dict[pymunk.Body, tuple[float, float]] = {}
        self._calm: tuple[Any, ...] = ()
        self.reset()

    def reset(
        self,
        constants: np.ndarray | None = None,
        mover_offsets_s: Sequence[float] | None = None,
        shapes_by: Sequence[int] | None = None,
    ) -> None:
        """Forget all contacts and put all objects back, so that a run repeats bit for bit.

        ``constants`` (field, robot) are the bodies' constants of the kernel; None keeps the last ones.
        ``mover_offsets_s`` is added to the times of the moving obstacles. ``shapes_by`` are the numbers by
        which the space shall know its shapes, as of :func:`~tlf_env.physics.space_state.shape_numbers`.
        """
        if constants is not None:
            self._constants = constants.copy()
        space = self._space
        shapes = [*self._outlines, *(one for one in space.shapes if one not in self._outlines)]
        space.remove(*shapes)  # with a shape its contacts go
        for body in space.bodies:
            take_correction(body)
            body.force, body.torque = (0.0, 0.0), 0.0
        for body, rest in self._rests.items():
            body.angle, body.position = rest.angle, rest.position
            body.velocity, body.angular_velocity = rest.velocity, rest.angular_velocity
        for body, outline, polygon, row in zip(
            self.bodies, self._outlines, self._polygons, self._constants.T.tolist(), strict=True
        ):
            robot = Body(*row)
            self._weigh(body, robot)
            if isinstance(outline, pymunk.Circle):
                outline.unsafe_set_radius(robot.outline_radius)
                outline.unsafe_set_offset((0.0, robot.outline_ahead))
            elif isinstance(outline, pymunk.Poly):
                outline.unsafe_set_vertices(_from_com(polygon, robot))
        add_shapes(space, shapes, range(len(shapes) + 1) if shapes_by is None else shapes_by)
        if mover_offsets_s is not None:
            for mover, offset_s in zip(self._movers, mover_offsets_s, strict=True):
                mover.offset_s = offset_s
        self._place_movers(0)
        self._forget_constraints()
        self._moved: set[int] = set()
        self._moved_before: set[int] = set()
        self._corrections: list[tuple[pymunk.Body, Correction]] = []
        self._calm_until = 0  # control step before which no object can be within reach
        self._pulled: set[int] = set()  # robots with forces, constraints or functions of the user's
        self._forces: list[tuple[pymunk.Body, tuple[float, float], float]] = []
        self.hits: dict[
            int, int
        ] = {}  # of a substep: robots, and the type of body that each touched

    def _weigh(self, body: pymunk.Body, robot: Body) -> None:
        """Give a robot's body its mass and inertia."""
        body.mass, body.moment = robot.m, robot.I

    @property
    def pushable_bodies(self) -> list[pymunk.Body]:
        """The bodies of the world's ``pushables``, in their order."""
        return [one.body for one in self._pushed]

    @property
    def moving_bodies(self) -> list[pymunk.Body]:
        """The bodies of the world's ``moving`` obstacles, in their order."""
        return [mover.body for mover in self._movers]

    @property
    def mover_laps_s(self) -> list[float]:
        """For each moving obstacle the time of a lap if its start is random, else 0."""
        return [mover.course.lap_s if mover.random_start else 0.0 for mover in self._movers]

    def space(self, motions: np.ndarray, step: int) -> pymunk.Space:
        """The space with its bodies at ``motions`` (field, robot, 1), moving obstacles as at a control step."""
        self._shared = True
        self._calm_until = 0  # whatever is moved now is seen
        self._settle(motions, step)
        return self._space

    def shapes(self, motions: np.ndarray, step: int) -> list[PlacedShape]:
        """What is in the space beside the robots' outlines, where it is at a control step; only read.

        ``motions`` (field, robot, 1) are the robots', to whose bodies a user may have added shapes.
        """
        poses = {
            body: (motions[X, i, 0], motions[Y, i, 0], motions[THETA, i, 0])
            for i, body in enumerate(self.bodies)
        }
        for mover in self._movers:
            poses[mover.body] = (*mover.at(step * self._period_s), mover.body.angle)

        def pose(body: pymunk.Body | None) -> Pose:
            if body is None:
                return 0.0, 0.0, 0.0
            return poses.get(body) or (*body.position, body.angle)

        found = [
            placed_shape(shape, pose(shape.body))
            for shape in self._space.shapes
            if shape not in self._outlines
        ]
        found += [
            placed_link(joint, pose(joint.a), pose(joint.b))
            for joint in self._space.constraints
            if joint not in self._floor
        ]
        return [one for one in found if one is not None]

    def object_poses(self, step: int) -> np.ndarray:
        """Pose of each pushed body and then of each moving obstacle at a control step, (object, 3); mm, rad."""
        rows = [(*one.body.position, one.body.angle) for one in self._pushed]
        rows += [(*one.at(step * self._period_s), one.body.angle) for one in self._movers]
        return np.array(rows, dtype=np.float64).reshape(-1, 3)

    def _settle(self, motions: np.ndarray, step: int) -> None:
        self._write(motions, motions)
        self._place_movers(step)
        for body in self.bodies:
            self._space.reindex_shapes_for_body(body)

    def _place_movers(self, step: int) -> None:
        for mover in self._movers:
            mover.place(step * self._period_s, self._period_s)
            self._space.reindex_shapes_for_body(mover.body)

    def visible(self, motions: np.ndarray, step: int) -> tuple[np.ndarray, np.ndarray]:
        """What the space contains besides the walls of the world and round robots.

        Capsules ``(number, Capsule)``, and the robots ``(number,)`` on whose bodies they are, or −1. Nothing in
        the space changes, so that looking changes no motion.
        """
        round_only = all(polygon is None for polygon in self._polygons)
        if round_only and not (self._shared or self._pushed or self._movers):
            return NO_CAPSULES, NO_OWNERS
        shapes = list(self._space.shapes)
        kinds = [shape.sensor for shape in shapes]
        if self._borders is None or (shapes, kinds) != self._bordered:
            skipped = {*self._walls, *(self._outlines if round_only else ())}
            self._borders = Borders(
                [one for one in shapes if one not in skipped and not one.sensor]
            )
            self._bordered = shapes, kinds
        borders = self._borders
        if not borders.bodies:
            return NO_CAPSULES, NO_OWNERS
        moved = {mover.body: mover.at(step * self._period_s) for mover in self._movers}
        owners = [self._number.get(body, -1) for body in borders.bodies]
        poses = [
            tuple(motions[POSE, owner, 0].tolist())
            if owner >= 0
            else (*moved.get(body, body.position), body.angle)
            for body, owner in zip(borders.bodies, owners, strict=True)
        ]
        return borders.capsules(poses), np.array(owners, dtype=np.int64)[borders.body_of]

    def _stir(self) -> tuple[Any, ...]:
        """What would differ if a user had added, moved, or pulled at anything but a static shape.

        One call of pymunk for all bodies: this is read in every control step.
        """
        space, buffer = self._space, self._buffer
        buffer.clear()
        get_space_bodies(space, STIRRED, buffer)
        return (
            len(space.shapes),
            len(space.constraints),
            bytes(buffer.float_buf()),
            [body.velocity_func for body in space.bodies],
            [body.position_func for body in space.bodies],
        )

    @property
    def occupied(self) -> bool:
        """Whether there may be anything in the space but the robots and the walls of the world."""
        return bool(self._shared or self._pushed or self._movers)

    def objects(self, motions: np.ndarray, step: int) -> int:
        """What objects could do within a control step: all but the walls of the world.

        ``NO_OBJECTS``: there are none, or they cannot act on a robot, and none has to be moved;
        ``OUT_OF_REACH``: some move, but cannot act on a robot; ``WITHIN_REACH``: something may act on a robot.
        """
        if step < self._calm_until and self._stir() == self._calm:
            return NO_OBJECTS
        space = self._space
        own = {mover.body for mover in self._movers}
        loose = [
            body
            for body in space.bodies
            if body not in self._number and body.body_type != pymunk.Body.STATIC and body not in own
        ]
        for body in loose:
            self._rests.setdefault(body, _rest(body))
        if any(_is_forced(body) for body in self.bodies):
            return WITHIN_REACH
        self._stop_on_floor()
        floor = set(self._floor)
        if any(_is_forced(body, floor) for body in loose):
            return WITHIN_REACH
        falling = space.gravity != (0.0, 0.0)
        moving = [body for body in loose if falling or not _is_still(body)]
        self._write(motions, motions)
        self._place_movers(step)
        for body in moving:
            space.reindex_shapes_for_body(body)
        fastest = max(
            [_fastest_point(body) for body in moving] + [one.speed_mm_s for one in self._movers],
            default=0.0,
        )
        calm_s = self._calm_time(fastest)
        if calm_s < 0.0:
            return WITHIN_REACH
        if moving or (self._movers and loose):
            return OUT_OF_REACH
        self._calm_until = step + int(calm_s / self._period_s)
        self._calm = self._stir()
        return NO_OBJECTS

    def _calm_time(self, fastest: float) -> float:
        """How long no object can be within reach, s; −1 if one can within a control step.

        ``fastest`` is a bound on the objects' speeds, mm/s. The robots' bodies are where the robots are.
        """
        space, period_s = self._space, self._period_s
        calm_s = MOST_CALM_S
        speeds = [_fastest_point(body) for body in self.bodies]
        for body, outline, own_speed in zip(self.bodies, self._outlines, speeds, strict=True):
            # The compiled laws know of outlines and walls, but not of shapes that a user adds to a robot.
            enlarged = len(body.shapes) > 1
            speed = own_speed + (max([fastest, *speeds]) if enlarged else fastest)
            box = outline.cache_bb()
            centre = ((box.left + box.right) / 2, (box.bottom + box.top) / 2)
            size = math.hypot(box.right - box.left, box.top - box.bottom) / 2
            if isinstance(outline, pymunk.Circle):
                size = outline.radius
            if enlarged:
                centre, size = (body.position.x, body.position.y), farthest_point(body)
            room = CLOSE_MARGIN_MM + (speed + 2.0 * FASTEST_CHANGE_MM_S2 * period_s) * period_s
            wide = size + CLOSE_MARGIN_MM + way(speed, MOST_CALM_S)
            near = pymunk.BB(centre[0] - wide, centre[1] - wide, centre[0] + wide, centre[1] + wide)
            for shape in space.bb_query(near, pymunk.ShapeFilter()):
                known = shape.body in self._number or shape in self._walls
                if shape.body is body or (known and not enlarged):
                    continue
                apart = shape.point_query(centre).distance - size
                if apart <= room:
                    return -1.0
                calm_s = min(calm_s, time_for(speed, apart - CLOSE_MARGIN_MM))
        return calm_s

    def _stop_on_floor(self) -> None:
        """Stop pushed bodies that rounding keeps in motion."""
        for one in self._pushed:
            body = one.body
            if body.velocity.length < AT_REST_MM_S and abs(body.angular_velocity) < AT_REST_MM_S:
                body.velocity, body.angular_velocity = (0.0, 0.0), 0.0

    def advance_objects(self, motions: np.ndarray, step: int, substeps: int, dt: float) -> None:
        """Run so many substeps of the space while the robots stand where they are."""
        self._place_movers(step)
        self._hold_forces()
        self._forget_constraints()
        self._index_anew(motions, np.zeros_like(motions))
        for _ in range(substeps):
            self._step_space(dt)

    def _step_space(self, dt: float) -> None:
        """A step of the space, in parts if a body would move far compared with its thickness."""
        parts = self._splits(dt)
        for _ in range(parts):
            self._step_once(dt / parts)

    def _splits(self, dt: float) -> int:
        """In how many parts a step of the space has to be made."""
        farthest = 0.0
        for body in self._space.bodies:
            if _is_still(body) or not body.shapes:
                continue
            if body not in self._sizes:
                self._sizes[body] = half_thickness(body), farthest_point(body)
            half, radius = self._sizes[body]
            speed = body.velocity.length + abs(body.angular_velocity) * radius
            farthest = max(farthest, speed * dt / half)
        return min(max(1, math.ceil(farthest / LARGEST_MOVE)), MOST_SPLITS)

    def _step_once(self, dt: float) -> None:
        for body, force, torque in self._forces:
            body.force, body.torque = force, torque
        scale_contacts(self._space, dt)
        if self._corrections:
            self._step_after_a_copy(dt)
        else:
            self._space.step(dt)
        for i, body in enumerate(self.bodies):
            body.each_arbiter(self._remember, i)

    def _write(self, poses: np.ndarray, velocities: np.ndarray) -> None:
        for i, body in enumerate(self.bodies):
            body.angle = poses[THETA, i, 0]
            body.position = poses[X, i, 0], poses[Y, i, 0]
            body.velocity = velocities[V_X, i, 0], velocities[V_Y, i, 0]
            body.angular_velocity = velocities[YAW, i, 0]

    def sort(self, motions: np.ndarray, step: int = 0) -> None:
        """Make the space's index of all that moves anew; to be called before a control step.

        The order in which Chipmunk solves contacts comes from that index, which otherwise depends on all
        that happened before, even on whether :meth:`space` was read. A body that changes its
        type leaves the index and enters it again, and keeps its contacts. Two circles have only one.
        """
        self._place_movers(step)
        self._hold_forces()
        self._forget_constraints()
        self._index_anew(motions, motions)

    def _index_anew(self, poses: np.ndarray, velocities: np.ndarray) -> None:
        """Let all bodies that move leave the index and enter it again, robots last; see :meth:`sort`."""
        robots_only = len(self._space.shapes) == len(self.bodies)
        if robots_only and len(self.bodies) <= 2 and not any(self._polygons):
            self._write(poses, velocities)
            return
        loose = [
            body
            for body in self._space.bodies
            if body not in self._number and body.body_type != pymunk.Body.STATIC and body.shapes
        ]
        held = [hold(body) for body in loose]
        for body in self.bodies:
            body.body_type = pymunk.Body.STATIC
        for one in held:
            one.leave()
        for one in held:
            one.enter()
        self._write(poses, velocities)
        for body, row in zip(self.bodies, self._constants.T.tolist(), strict=True):
            robot = Body(*row)
            for outline in body.shapes:
                outline.cache_bb()
            body.body_type = pymunk.Body.DYNAMIC
            self._weigh(body, robot)

    def _hold_forces(self) -> None:
        """Remember the forces on bodies, which Chipmunk forgets after a step, for the whole control step."""
        self._forces = [
            (body, body.force, body.torque)
            for body in self._space.bodies
            if body.force != (0.0, 0.0) or body.torque
        ]
        self._pulled = {i for i, body in enumerate(self.bodies) if _is_forced(body)}
        self._sizes.clear()

    def _forget_constraints(self) -> None:
        """Set the impulses that constraints remember to 0; to be called before a control step.

        A copy of a space does not have them, so that it could not go on as the original does. A step with a
        largest force of 0, in a space without bodies, clears them; it takes them from the bodies' velocities,
        which are put back. Springs remember nothing.
        """
        constraints = list(self._space.constraints)
        if not constraints:
            return
        clamped = [one for one in constraints if not isinstance(one, SPRINGS)]
        self._space.remove(*constraints)
        kept = [(one.max_force, one.pre_solve, one.post_solve) for one in clamped]
        bodies = {body for one in clamped for body in (one.a, one.b)}
        twists = [(body, body.velocity, body.angular_velocity) for body in bodies]
        empty = pymunk.Space()
        for one in clamped:
            one.max_force, one.pre_solve, one.post_solve = 0.0, None, None
            empty.add(one)
        empty.step(1.0)
        empty.remove(*clamped)
        for body, velocity, turning in twists:
            body.velocity, body.angular_velocity = velocity, turning
        for one, (max_force, before, after) in zip(clamped, kept, strict=True):
            one.max_force, one.pre_solve, one.post_solve = max_force, before, after
        self._space.add(*constraints)

    def collide(self, before: np.ndarray, motions: np.ndarray, dt: float) -> None:
        """Run one substep of the space: from the poses ``before`` with the velocities of ``motions``.

        ``motions`` contains the new velocities and poses of the kernel; for robots that a contact has
        moved they are overwritten with those of Chipmunk. Chipmunk corrects positions in the step after
        it has solved a contact, so the robots of the previous step are included.
        """
        self._write(before, motions)
        self._moved_before, self._moved = self._moved, set()
        self.hits = {}
        self._step_space(dt)
        self._moved |= self._pulled
        for i in self._moved | self._moved_before:
            body = self.bodies[i]
            motions[X, i, 0], motions[Y, i, 0] = body.position
            motions[THETA, i, 0] = body.angle
            motions[V_X, i, 0], motions[V_Y, i, 0] = body.velocity
            motions[YAW, i, 0] = body.angular_velocity

    def release(self) -> None:
        """Called after a control step that ran substep by substep."""

    def _remember(self, arbiter: pymunk.Arbiter, robot: int) -> None:
        self._moved.add(robot)
        for shape in arbiter.shapes:
            body = shape.body
            if body is None or body is self.bodies[robot]:
                continue
            if body in self._number or body.body_type != pymunk.Body.DYNAMIC:
                self.hits.setdefault(robot, body.body_type)

    def _step_after_a_copy(self, dt: float) -> None:
        """A step of the space that puts back what a copy leaves out, in the original as in the copy."""
        ended = [each for each in self._space._get_arbiters() if each.state == SEPARATED]

        def advance(correction: Correction, body: pymunk.Body, dt: float) -> None:
            for arbiter in ended:  # a copied space begins its step as if all contacts lasted
                arbiter.state = SEPARATED
            _advance_corrected(correction, body, dt)

        corrected = [
            (body, correction)
            for body, correction in self._corrections
            if body.position_func is pymunk.Body.update_position
        ]
        for body, correction in corrected:
            body.position_func = partial(advance, correction)
        self._space.step(dt)
        for body, _ in corrected:
            body.position_func = pymunk.Body.update_position
            body._position_func = None  # pymunk before 7.3.1 keeps the last one, and copies it
        self._corrections = []

    def _is_calm(self) -> bool:
        """Whether nothing has been stirred since objects were found to be out of reach."""
        return self._calm_until > 0 and self._stir() == self._calm

    def _take_corrections(self) -> None:
        """Take the corrections of the next step from the bodies; that step adds them itself."""
        if not self._corrections:
            self._corrections = [(body, take_correction(body)) for body in self._space.bodies]

    def structure(self) -> dict[str, Any]:
        """What is in the space, a user's things too, apart from its motion, as JSON values."""
        return structure_of(self._space, frozenset([*self.bodies, *self._outlines]))

    def state_layout(self) -> dict[str, tuple[Any, tuple[int | None, ...]]]:
        """Dtype and shape of the arrays of :meth:`get_state`, None where any length fits."""
        bodies, robots = len(self._space.bodies), len(self.bodies)
        return {
            "bodies": (np.float64, (bodies, BODY_COLUMNS)),
            "corrections": (np.float64, (bodies, len(Correction._fields))),
            "rests": (np.float64, (bodies, REST_COLUMNS)),
            "has_rest": (np.bool_, (bodies,)),
            "shape_numbers": (np.int64, (len(self._space.shapes) + 1,)),
            "pair_counts": (np.int64, (None, len(COUNTS))),
            "pairs": (np.float64, (None, PAIR_COLUMNS)),
            "contacts": (np.float64, (None, CONTACT_COLUMNS)),
            "contact_keys": (np.uint64, (None,)),
            "last_dt": (np.float64, (1,)),
            "offsets_s": (np.float64, (len(self._movers),)),
            "moved": (np.bool_, (2, robots)),
            "calm": (np.int64, (2,)),
        }

    def get_state(self) -> dict[str, np.ndarray]:
        """Everything that the next steps depend on, apart from the robots' motions and constants.

        The space goes on with the same bits as if it had not been asked.
        """
        bodies, robots = list(self._space.bodies), range(len(self.bodies))
        self._take_corrections()
        none = Correction(0.0, 0.0, 0.0)
        corrections = dict(self._corrections)
        rests = [self._rests.get(body) for body in bodies]
        return {
            "bodies": np.array([body_row(body) for body in bodies]),
            "corrections": np.array([corrections.get(body, none) for body in bodies]),
            "rests": np.array([_rest_row(rest) for rest in rests]),
            "has_rest": np.array([rest is not None for rest in rests]),
            "shape_numbers": shape_numbers(self._space),
            **contacts_of(self._space),
            "offsets_s": np.array([mover.offset_s for mover in self._movers], dtype=np.float64),
            "moved": np.array(
                [[i in some for i in robots] for some in (self._moved, self._moved_before)]
            ),
            "calm": np.array([self._calm_until, self._is_calm()], dtype=np.int64),
        }

    def check_state(self, state: Mapping[str, np.ndarray]) -> None:
        """Refuse a state that no such space can have; its arrays are as in :meth:`state_layout`.

        Raises
        ------
        ValueError
            saying what is wrong.
        """
        check_contacts(state, len(self._space.shapes))
        numbers = state["shape_numbers"]
        if (numbers < 0).any() or len(np.unique(numbers)) < len(numbers):
            raise ValueError("shapes that have no number of their own")

    def set_state(self, state: Mapping[str, np.ndarray], constants: np.ndarray) -> None:
        """Go on from a state of :meth:`get_state`, with the bodies' ``constants`` as of :meth:`reset`."""
        self.reset(constants, state["offsets_s"].tolist(), state["shape_numbers"].tolist())
        bodies = list(self._space.bodies)
        for body, row in zip(bodies, state["bodies"].tolist(), strict=True):
            put_body(body, row)
            self._space.reindex_shapes_for_body(body)
        put_contacts(self._space, state)
        self._corrections = [
            (body, Correction(*row))
            for body, row in zip(bodies, state["corrections"].tolist(), strict=True)
        ]
        self._rests = {
            body: Rest((row[0], row[1]), row[2], (row[3], row[4]), row[5])
            for body, row, there in zip(
                bodies, state["rests"].tolist(), state["has_rest"], strict=True
            )
            if there
        }
        self._moved, self._moved_before = (
            set(np.flatnonzero(row).tolist()) for row in state["moved"]
        )
        self._calm_until, calm = state["calm"].tolist()
        self._calm = self._stir() if calm else ()

    def __getstate__(self) -> dict[str, Any]:
        """Everything, with the contacts' memory: what pymunk keeps of it, and what it leaves out."""
        self._take_corrections()
        return {
            **self.__dict__,
            "_buffer": None,
            "_calm": self._is_calm(),
            "_sizes": {},
            "_borders": None,
            "_bordered": ([], []),
            "_placed": [
                (body, body_row(body))
                for body in self._space.bodies
                if body.center_of_gravity != (0.0, 0.0)
            ],
        }

    def __setstate__(self, state: dict[str, Any]) -> None:
        kept = {name: value for name, value in state.items() if name != "_placed"}
        self.__dict__.update(kept, _buffer=Buffer())
        # pymunk sets the place of a copied body before its centre of mass, which moves its shapes.
        for body, row in state["_placed"]:
            put_body(body, row)
            self._space.reindex_shapes_for_body(body)
        self._calm = self._stir() if state["_calm"] else ()


def half_thickness(body: pymunk.Body) -> float:
    """Half the smallest width of a body's shapes, mm."""
    return max(LEAST_HALF_MM, min(map(_half_width, body.shapes)))


def _half_width(shape: pymunk.Shape) -> float:
    if isinstance(shape, pymunk.Poly):
        corners = np.array(shape.get_vertices())
        edges = np.roll(corners, -1, axis=0) - corners
        normals = np.stack([-edges[:, 1], edges[:, 0]]) / np.hypot(*edges.T)
        heights = np.ptp(corners @ normals, axis=0)
        return float(heights.min()) / 2 + shape.radius
    return float(shape.radius) if isinstance(shape, pymunk.Circle | pymunk.Segment) else 0.0


def farthest_point(body: pymunk.Body) -> float:
    """A bound on the distance of all points of a body's shapes from its centre of mass, mm."""
    return max(map(_farthest_of, body.shapes)) + body.center_of_gravity.length


def _farthest_of(shape: pymunk.Shape) -> float:
    if isinstance(shape, pymunk.Circle):
        return float(shape.offset.length + shape.radius)
    if isinstance(shape, pymunk.Segment):
        return float(max(shape.a.length, shape.b.length) + shape.radius)
    if isinstance(shape, pymunk.Poly):
        return float(max(corner.length for corner in shape.get_vertices()) + shape.radius)
    return 0.0


def _rest(body: pymunk.Body) -> Rest:
    return Rest(body.position, body.angle, body.velocity, body.angular_velocity)


def _rest_row(rest: Rest | None) -> tuple[float, ...]:
    if rest is None:
        return REST_COLUMNS * (0.0,)
    return (*rest.position, rest.angle, *rest.velocity, rest.angular_velocity)


def _from_com(
    polygon: Sequence[tuple[float, float]] | None, robot: Body
) -> list[tuple[float, float]]:
    """Corners relative to the centre of mass, from those relative to c."""
    return [(right, forward + robot.d) for right, forward in polygon or ()]


def _is_still(body: pymunk.Body) -> bool:
    return bool(body.velocity == (0.0, 0.0) and body.angular_velocity == 0.0)


def _is_forced(body: pymunk.Body, passive: Collection[pymunk.Constraint] = ()) -> bool:
    """Whether a force, a constraint or a function of the user's may change a body's motion.

    ``passive`` constraints move nothing that is at rest. A body also knows constraints that have left the
    space, until Python collects them: they do not count.
    """
    acting = () if body.space is None else body.space.constraints
    velocity_func = body.velocity_func
    if isinstance(velocity_func, partial) and velocity_func.func is damped_velocity:
        velocity_func = pymunk.Body.update_velocity
    return bool(
        body.force != (0.0, 0.0)
        or body.torque
        or any(one in acting and one not in passive for one in body.constraints)
        or velocity_func is not pymunk.Body.update_velocity
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


def _advance_corrected(correction: Correction, body: pymunk.Body, dt: float) -> None:
    """Chipmunk's own step of a pose, with a correction that was taken before: the same to the last bit."""
    velocity, turning = body.velocity, body.angular_velocity
    body.velocity = velocity.x + correction.x, velocity.y + correction.y
    body.angular_velocity = turning + correction.turning
    pymunk.Body.update_position(body, dt)
    body.velocity, body.angular_velocity = velocity, turning
