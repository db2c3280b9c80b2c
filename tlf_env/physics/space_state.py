"""What a pymunk space carries from one step to the next, as arrays; and its index made anew.

Chipmunk remembers more than the motion of its bodies: a velocity with which the next step corrects an overlap,
the impulses and the age of contacts, and the index of shapes, whose order decides in which order contacts
are solved. pymunk has no properties for these; its copies read them from Chipmunk as is done here.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import pymunk
from pymunk._chipmunk_cffi import lib
from pymunk.arbiter import _arbiter_from_dict

# Columns of a body's row: place of its centre of mass (mm), angle (rad), velocities (mm/s, rad/s),
# force (mN) and torque (mN·mm).
BODY_COLUMNS = 9
# Columns of a contact's row; places relative to the centres of mass, impulses of the last step.
POINTS = ("r1", "r2")
NUMBERS = ("nMass", "tMass", "bounce", "jnAcc", "jtAcc", "jBias", "bias")
CONTACT_COLUMNS = 2 * len(POINTS) + len(NUMBERS)
# Columns of a touching pair's rows: numbers and whole numbers. Places are those of shapes in the space.
PAIR_COLUMNS = 6  # restitution, friction, velocity of the surface (x, y), normal (x, y)
COUNTS = ("first", "second", "contacts", "swapped", "age", "state", "processed")
FIRST, SECOND, COUNT, SWAPPED, AGE, STATE, PROCESSED = range(len(COUNTS))
STATES = 5  # that a pair may have
MOST_POINTS = 2  # contacts of a pair
SPACE_FIELDS = (
    "iterations",
    "gravity",
    "damping",
    "sleep_time_threshold",
    "collision_slop",
    "collision_bias",
    "collision_persistence",
)
STAMPS = 1 << 32  # Chipmunk counts its steps modulo this


class Correction(NamedTuple):
    """A velocity that Chipmunk adds to a body's own in the next step only."""

    x: float  # mm/s
    y: float
    turning: float  # rad/s


def take_correction(body: pymunk.Body) -> Correction:
    """The velocity with which Chipmunk's next step will push a body out of an overlap, taken from it.

    pymunk has no property for it. But a body at rest at the origin goes just that far in one second.
    """
    centre = body.center_of_gravity
    move_origin(body, (0.0, 0.0))
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
    move_origin(body, centre)
    return correction


def move_origin(body: pymunk.Body, centre: tuple[float, float]) -> None:
    """Move a body's origin so that its centre of mass, which stays where it is, is at ``centre``."""
    body.center_of_gravity = centre
    body.angle = body.angle  # only now does the position follow


def add_shapes(space: pymunk.Space, shapes: Sequence[pymunk.Shape], numbers: Sequence[int]) -> None:
    """Add shapes that the space shall know by certain numbers; the last of ``numbers`` is for the next shape.

    Contacts of polygons are found again by these numbers, and the index goes through its shapes in their
    order, so that an episode repeats only if they do.
    """
    for shape, number in zip(shapes, numbers, strict=False):
        lib.cpSpaceSetShapeIDCounter(space._space, number)
        space.add(shape)
    lib.cpSpaceSetShapeIDCounter(space._space, numbers[-1])


class Held(NamedTuple):
    """A body that leaves the space's index and enters it again, with what a change of its type takes."""

    body: pymunk.Body
    kind: int
    mass: float
    moment: float
    centre: tuple[float, float]  # of mass
    place: tuple[float, float]  # of the centre of mass, mm
    angle: float
    velocity: tuple[float, float]
    turning: float

    def leave(self) -> None:
        """Take the body's shapes out of the index of what moves."""
        _set_type(self.body, pymunk.Body.STATIC)

    def enter(self) -> None:
        """Put its shapes back."""
        body = self.body
        body.velocity, body.angular_velocity = self.velocity, self.turning
        for shape in body.shapes:
            shape.cache_bb()
        _set_type(body, self.kind)
        body.velocity, body.angular_velocity = self.velocity, self.turning
        if self.kind == pymunk.Body.DYNAMIC:
            body.mass, body.moment = self.mass, self.moment
            _put(body, self.place, self.angle, self.centre)


def _set_type(body: pymunk.Body, kind: int) -> None:
    """Change a body's type; pymunk itself refuses this for a kinematic body with a constraint."""
    lib.cpBodySetType(body._body, kind)


def hold(body: pymunk.Body) -> Held:
    """A body with what it has now."""
    return Held(
        body=body,
        kind=body.body_type,
        mass=body.mass,
        moment=body.moment,
        centre=body.center_of_gravity,
        place=_place(body),
        angle=body.angle,
        velocity=body.velocity,
        turning=body.angular_velocity,
    )


def _place(body: pymunk.Body) -> tuple[float, float]:
    """Where a body's centre of mass is, to the last bit."""
    centre = body.center_of_gravity
    if centre == (0.0, 0.0):
        return (body.position.x, body.position.y)
    move_origin(body, (0.0, 0.0))
    x, y = body.position
    move_origin(body, centre)
    return x, y


def _put(
    body: pymunk.Body, place: tuple[float, float], angle: float, centre: tuple[float, float]
) -> None:
    """Put a body's centre of mass, which is at ``centre`` in its own frame, at a place."""
    body.center_of_gravity = (0.0, 0.0)
    body.angle = angle
    body.position = place
    if centre != (0.0, 0.0):
        move_origin(body, centre)


def body_row(body: pymunk.Body) -> tuple[float, ...]:
    """A body's motion, and the forces on it, in ``BODY_COLUMNS`` columns."""
    return (
        *_place(body),
        body.angle,
        *body.velocity,
        body.angular_velocity,
        *body.force,
        body.torque,
    )


def put_body(body: pymunk.Body, row: Iterable[float]) -> None:
    """The inverse of :func:`body_row`."""
    x, y, angle, v_x, v_y, turning, f_x, f_y, torque = row
    _put(body, (x, y), angle, body.center_of_gravity)
    body.velocity, body.angular_velocity = (v_x, v_y), turning
    body.force, body.torque = (f_x, f_y), torque


def shape_numbers(space: pymunk.Space) -> np.ndarray:
    """By which numbers the space knows its shapes, in their order, and which it gives next."""
    own = [lib.cpShapeGetHashID(shape._shape) for shape in space.shapes]
    return np.array([*own, lib.cpSpaceGetShapeIDCounter(space._space)], dtype=np.int64)


def contacts_of(space: pymunk.Space) -> dict[str, np.ndarray]:
    """The pairs of shapes that touch or have touched, with their memory, in a fixed order."""
    places = {shape._shape: i for i, shape in enumerate(space.shapes)}
    now = lib.cpSpaceGetTimestamp(space._space)
    found = []
    for pair in space._get_arbiters():
        contacts = [pair.contacts[i] for i in range(pair.count)]
        rows = [
            [
                *(number for name in POINTS for number in _xy(getattr(one, name))),
                *(getattr(one, name) for name in NUMBERS),
            ]
            for one in contacts
        ]
        counts = (
            places[pair.a],
            places[pair.b],
            pair.count,
            pair.swapped,
            (now - pair.stamp) % STAMPS,
            pair.state,
            int(lib.cpArbiterGetProcessCollision(pair)),
        )
        numbers = (pair.e, pair.u, *_xy(pair.surface_vr), *_xy(pair.n))
        found.append((counts, numbers, rows, [one.hash for one in contacts]))
    found.sort(key=lambda one: one[0])
    return {
        "pair_counts": np.array([one[0] for one in found], dtype=np.int64).reshape(-1, len(COUNTS)),
        "pairs": np.array([one[1] for one in found], dtype=np.float64).reshape(-1, PAIR_COLUMNS),
        "contacts": np.array([row for one in found for row in one[2]], dtype=np.float64).reshape(
            -1, CONTACT_COLUMNS
        ),
        "contact_keys": np.array([key for one in found for key in one[3]], dtype=np.uint64),
        "last_dt": np.array([lib.cpSpaceGetCurrentTimeStep(space._space)]),
    }


def scale_contacts(space: pymunk.Space, dt: float) -> None:
    """Let the next step of another length than the last one begin with the last forces of the contacts.

    Chipmunk begins with the last impulses, times the ratio of the lengths. But it then counts them without this
    ratio, and what it takes back leaves energy behind.
    """
    last = lib.cpSpaceGetCurrentTimeStep(space._space)
    if last in (0.0, dt):
        return
    for pair in space._get_arbiters():
        for i in range(pair.count):
            pair.contacts[i].jnAcc *= dt / last
            pair.contacts[i].jtAcc *= dt / last
    lib.cpSpaceSetCurrentTimeStep(space._space, dt)


def _xy(vector: Any) -> tuple[float, float]:
    return vector.x, vector.y


def check_contacts(numbers: Mapping[str, np.ndarray], shapes: int) -> None:
    """Refuse contacts that no space with so many shapes can have.

    Raises
    ------
    ValueError
        saying what is wrong.
    """
    counts, pairs = numbers["pair_counts"], numbers["pairs"]
    limits = np.array([shapes, shapes, MOST_POINTS + 1, 2, STAMPS, STATES, 2])
    if len(counts) != len(pairs) or (counts < 0).any() or (counts >= limits).any():
        raise ValueError("pairs of shapes that are out of range")
    if (counts[:, FIRST] == counts[:, SECOND]).any():
        raise ValueError("a shape that touches itself")
    total = int(counts[:, COUNT].sum())
    if len(numbers["contacts"]) != total or len(numbers["contact_keys"]) != total:
        raise ValueError("pairs of shapes without their contacts")


def put_contacts(space: pymunk.Space, numbers: Mapping[str, np.ndarray]) -> None:
    """Give a space without contacts those that :func:`contacts_of` has read."""
    shapes = list(space.shapes)
    # Later than any memory of contacts that the space has had, so that Chipmunk uses it again.
    now = lib.cpSpaceGetTimestamp(space._space)
    now = (now + round(space.collision_persistence) + 2) % STAMPS
    lib.cpSpaceSetTimestamp(space._space, now)
    lib.cpSpaceSetCurrentTimeStep(space._space, float(numbers["last_dt"][0]))
    contacts = _contacts(numbers)
    for counts, pair in zip(
        numbers["pair_counts"].tolist(), numbers["pairs"].tolist(), strict=True
    ):
        stamp = (now - counts[AGE]) % STAMPS
        made = _arbiter_from_dict(
            {
                "a": shapes[counts[FIRST]],
                "b": shapes[counts[SECOND]],
                "e": pair[0],
                "u": pair[1],
                "surface_vr": tuple(pair[2:4]),
                "n": tuple(pair[4:6]),
                "count": counts[COUNT],
                "contacts": [next(contacts) for _ in range(counts[COUNT])],
                "swapped": counts[SWAPPED],
                "stamp": stamp,
                "state": counts[STATE],
            },
            space,
        )
        lib.cpArbiterSetProcessCollision(made, bool(counts[PROCESSED]))
        lib.cpSpaceAddCachedArbiter(space._space, made)
        made.stamp, made.swapped = stamp, counts[SWAPPED]  # these two it has set anew


def _contacts(numbers: Mapping[str, np.ndarray]) -> Iterator[dict[str, Any]]:
    """Contacts as pymunk keeps them in a copy."""
    first = 2 * len(POINTS)
    for row, key in zip(
        numbers["contacts"].tolist(), numbers["contact_keys"].tolist(), strict=True
    ):
        places = {name: tuple(row[2 * i : 2 * i + 2]) for i, name in enumerate(POINTS)}
        yield {**places, **dict(zip(NUMBERS, row[first:], strict=True)), "hash": key}


def structure_of(space: pymunk.Space, derived: frozenset[Any]) -> dict[str, Any]:
    """What is in a space, apart from its motion, as plain values.

    Of the ``derived`` bodies and shapes only the kind is named: their sizes follow from something else.
    """
    places = {body: i for i, body in enumerate(space.bodies)}

    def traits(thing: Any) -> dict[str, Any]:
        found: dict[str, Any] = {"kind": type(thing).__name__}
        state = thing.__getstate__()
        for name, value in () if thing in derived else [*state["init"], *state["general"]]:
            found[name] = plain(value)
        found.pop("_hashid", None)
        found["bodies"] = [
            places.get(body, -1)
            for body in (getattr(thing, name, None) for name in ("body", "a", "b"))
            if isinstance(body, pymunk.Body)
        ]
        return found

    def plain(value: Any) -> Any:
        if isinstance(value, pymunk.Body):
            return "body"
        if isinstance(value, tuple | list):
            return [plain(one) for one in value]
        return value

    def masses(body: pymunk.Body) -> dict[str, Any]:
        if body in derived:
            return {"kind": "robot"}
        centre = list(body.center_of_gravity)
        return {
            "kind": body.body_type,
            "mass": body.mass,
            "moment": body.moment,
            "centre": centre,
        }

    return {
        "bodies": [masses(body) for body in space.bodies],
        "shapes": [traits(shape) for shape in space.shapes],
        "constraints": [traits(joint) for joint in space.constraints],
        "space": {name: plain(getattr(space, name)) for name in SPACE_FIELDS},
    }
