"""The world of a scenario: contact laws, floor friction, moving obstacles, walls on every plant."""

from __future__ import annotations

import copy
import itertools
import math
import pickle

import numpy as np
import pymunk
import pytest

import tlf_env
from tlf_env.physics.parameters import RobotParameters
from tlf_env.physics.pymunk_plant import (
    NO_OBJECTS,
    OUT_OF_REACH,
    THETA,
    V_X,
    V_Y,
    WITHIN_REACH,
    YAW,
    PymunkPlant,
    X,
    Y,
)
from tlf_env.physics.space_state import body_row, hold, put_body, scale_contacts, take_correction
from tlf_env.physics.state import Motion
from tlf_env.physics.world import World, capsule_rows, gap_to_walls, placed

DISC = {"type": "circle", "radius_mm": 80.0}
WALL = {"points_mm": [[-5000.0, 0.0], [5000.0, 0.0]], "thickness_mm": 0.0}
STILL = np.zeros(2)
RECTANGLE = [[-90.0, -120.0], [90.0, -120.0], [90.0, 80.0], [-90.0, 80.0]]


class Flight:
    """Robots without wheels: bodies that fly freely through the space of a plant."""

    def __init__(self, world=None, robots=({},), dt=0.001):
        models = [RobotParameters(**fields) for fields in robots]
        self.plant = PymunkPlant(models, World(**(world or {})))
        self.dt, self.mass = dt, models[0].mass_kg
        self.motions = np.zeros((len(Motion._fields), len(models), 1))

    def put(self, robot, x, y, v_x=0.0, v_y=0.0, theta=0.0, yaw=0.0):
        for field, value in zip(
            (X, Y, V_X, V_Y, THETA, YAW), (x, y, v_x, v_y, theta, yaw), strict=True
        ):
            self.motions[field, robot, 0] = value

    def fly(self, time_s):
        self.plant.sort(self.motions, 0)
        self.substeps(round(time_s / self.dt))

    def substeps(self, count):
        for _ in range(count):
            before = self.motions.copy()
            for place, speed in ((X, V_X), (Y, V_Y), (THETA, YAW)):
                self.motions[place] += self.dt * self.motions[speed]
            self.plant.collide(before, self.motions, self.dt)

    def velocity(self, robot=0):
        return self.motions[[V_X, V_Y, YAW], robot, 0]


@pytest.mark.parametrize(
    ("own", "walls"), [(0.0, 1.0), (0.5, 1.0), (1.0, 1.0), (0.8, 0.5), (1.0, 0.0)]
)
def test_a_wall_returns_the_speed_that_restitution_says(own, walls):
    flight = Flight({"walls": [WALL | {"restitution": walls}]}, [{"outline_restitution": own}])
    flight.put(0, 0.0, -300.0, v_y=400.0)
    flight.fly(1.2)
    v_x, v_y, yaw = flight.velocity()
    assert v_y == pytest.approx(-own * walls * 400.0, abs=0.02)
    assert (v_x, yaw) == pytest.approx((0.0, 0.0), abs=1e-9)


@pytest.mark.parametrize(
    ("force_mN", "torque"), [((3000.0, -500.0), 0.0), ((0.0, 0.0), 4e5), ((0.0, 800.0), -1e5)]
)
def test_a_force_on_a_body_acts_for_the_whole_control_step(force_mN, torque):
    """Chipmunk forgets forces after each of its steps; a body gains force times time, not times a substep."""
    flight = Flight()
    body, shape_less = pymunk.Body(2.0, 3e4), pymunk.Body(1.0, 1.0)
    flight.plant.space(flight.motions, 0).add(body, pymunk.Circle(body, 50.0), shape_less)
    body.position = 2000.0, 0.0
    body.force, body.torque = force_mN, torque
    flight.fly(0.02)
    assert tuple(body.velocity) == pytest.approx(
        (0.02 * force_mN[0] / 2.0, 0.02 * force_mN[1] / 2.0), rel=1e-12
    )
    assert body.angular_velocity == pytest.approx(0.02 * torque / 3e4, rel=1e-12)
    assert tuple(shape_less.velocity) == (0.0, 0.0)
    assert not flight.velocity().any()


@pytest.mark.parametrize("friction", [0.0, 0.1, 0.4])
def test_a_wall_rubs_by_coulombs_law(friction):
    """While an outline slides, the impulse along the wall is µ times the one across it, at the outline."""
    flight = Flight({"walls": [WALL]}, [{"outline_friction": friction, "outline_restitution": 0.5}])
    robot = RobotParameters()
    flight.put(0, 0.0, -200.0, v_x=900.0, v_y=300.0)
    before = flight.velocity().copy()
    flight.fly(0.6)
    change = flight.velocity() - before
    across = -change[1] * robot.mass_kg
    along = -change[0] * robot.mass_kg
    assert change[1] < -300.0
    assert along == pytest.approx(friction * across, rel=0.02, abs=1e-6)
    # The friction turns the robot: its lever is the distance of the wall from the centre of mass.
    lever = robot.outline_radius_mm + robot.com_offset_mm - robot.outline_offset_mm
    assert change[2] * robot.body_inertia_kg_mm2 == pytest.approx(along * lever, rel=0.03, abs=1.0)


@pytest.mark.parametrize("restitution", [0.0, 0.5, 1.0])
def test_two_robots_keep_their_momentum_and_lose_the_energy_that_restitution_says(restitution):
    fields = {"outline_restitution": math.sqrt(restitution)}
    flight = Flight(robots=[fields, fields])
    flight.put(0, 0.0, 0.0, v_y=500.0)
    flight.put(1, 0.0, 400.0, v_y=-100.0)
    flight.fly(0.8)
    first, second = flight.velocity(0)[1], flight.velocity(1)[1]
    assert first + second == pytest.approx(400.0, abs=1e-9)
    assert second - first == pytest.approx(restitution * 600.0, abs=0.05)


@pytest.mark.parametrize("restitution", [0.0, 0.7])
def test_a_free_box_takes_the_momentum_that_the_robot_loses(restitution):
    box = {
        "shape": {"type": "box", "width_mm": 300.0, "length_mm": 100.0},
        "x_mm": 0.0,
        "y_mm": 300.0,
        "mass_kg": 2.0,
        "floor_friction": 0.0,
        "restitution": restitution,
    }
    flight = Flight({"pushables": [box]}, [{"outline_restitution": 1.0}])
    flight.put(0, 0.0, 0.0, v_y=500.0)
    flight.fly(0.6)
    body = flight.plant._pushed[0].body
    robot = flight.velocity()[1]
    assert flight.mass * robot + 2.0 * body.velocity.y == pytest.approx(
        flight.mass * 500.0, rel=1e-9
    )
    assert body.velocity.y - robot == pytest.approx(restitution * 500.0, abs=0.05)


def test_a_box_slides_as_far_as_friction_with_the_floor_lets_it():
    """v²/(2 µ g); and in turning, the limit torque of a disc is two thirds of µ m g R."""
    friction, speed, turn = 0.2, 800.0, 10.0
    disc = {"shape": {"type": "circle", "radius_mm": 100.0}, "x_mm": 0.0, "y_mm": 0.0}
    flight = Flight({"pushables": [disc | {"mass_kg": 3.0, "floor_friction": friction}]})
    flight.put(0, 9000.0, 0.0)
    body = flight.plant._pushed[0].body
    body.velocity = (speed, 0.0)
    flight.fly(1.0)
    g = RobotParameters().gravity_mm_s2
    assert body.position.x == pytest.approx(speed**2 / (2 * friction * g), rel=0.01)
    body.velocity, body.angular_velocity = (0.0, 0.0), turn
    start = body.angle
    flight.fly(1.0)
    slowing = friction * 3.0 * g * (2 / 3 * 100.0) / (3.0 * 100.0**2 / 2)
    assert body.angle - start == pytest.approx(turn**2 / (2 * slowing), rel=0.01)
    assert abs(body.angular_velocity) < 1e-6


def test_damping_slows_a_body_by_its_rate():
    disc = {"shape": {"type": "circle", "radius_mm": 100.0}, "x_mm": 0.0, "y_mm": 0.0}
    flight = Flight(
        {"pushables": [disc | {"mass_kg": 3.0, "floor_friction": 0.0, "damping_per_s": 2.0}]}
    )
    flight.put(0, 9000.0, 0.0)
    body = flight.plant._pushed[0].body
    body.velocity = (800.0, 0.0)
    flight.fly(0.5)
    assert body.velocity.x == pytest.approx(800.0 * math.exp(-1.0), rel=1e-3)


THIN = [[-20.0, -60.0], [20.0, -60.0], [20.0, 60.0], [-20.0, 60.0]]


@pytest.mark.parametrize("dt", [0.0001, 0.001, 0.005, 0.02, 0.1])
@pytest.mark.parametrize("speed", [100.0, 1000.0, 10000.0])
@pytest.mark.parametrize("outline", [{}, {"outline_radius_mm": 20.0}, {"outline_polygon_mm": THIN}])
def test_nothing_tunnels_through_a_line(dt, speed, outline):
    """Whatever the speed and the substep: a robot, and a thin box that a robot throws, stay on their side."""
    if speed * dt < 0.1:
        pytest.skip("too slow to reach the wall soon")
    flight = Flight({"walls": [WALL]}, [outline], dt=dt)
    for theta in (0.0, 0.7, math.pi / 2):
        start = -200.0 - 0.37 * speed * dt
        flight.put(0, 0.0, start, v_y=speed, theta=theta)
        flight.fly(max(400.0 / speed, 20 * dt))
        assert flight.motions[Y, 0, 0] < 1.0


@pytest.mark.parametrize("dt", [0.001, 0.02, 0.1])
def test_a_thin_box_does_not_leave_a_room_of_lines(dt):
    room = [[-500.0, -500.0], [500.0, -500.0], [500.0, 500.0], [-500.0, 500.0]]
    stick = {"shape": {"type": "box", "width_mm": 300.0, "length_mm": 4.0}, "mass_kg": 0.5}
    flight = Flight(
        {
            "walls": [{"points_mm": room, "closed": True, "thickness_mm": 0.0}],
            "pushables": [
                stick | {"x_mm": 0.0, "y_mm": 0.0, "floor_friction": 0.0, "restitution": 1.0}
            ],
        },
        dt=dt,
    )
    flight.put(0, 9000.0, 0.0)
    body = flight.plant._pushed[0].body
    body.velocity, body.angular_velocity = (3000.0, 1700.0), 8.0
    for _ in range(5):
        flight.fly(5 * dt)
        assert max(map(abs, body.position)) < 500.0


def crowd():
    """Robots that fly into a pile of pushed things and a user's own, beside a moving obstacle."""
    box = {"type": "box", "width_mm": 120.0, "length_mm": 60.0}
    flight = Flight(
        {
            "walls": [WALL],
            "pushables": [
                {"shape": box, "x_mm": 0.0, "y_mm": 40.0, "mass_kg": 0.5, "angle_rad": 0.2},
                {"shape": box, "x_mm": 20.0, "y_mm": 110.0, "mass_kg": 0.4, "damping_per_s": 0.5},
                {"shape": DISC, "x_mm": -110.0, "y_mm": 60.0, "mass_kg": 0.3},
            ],
            "moving": [
                {
                    "shape": DISC,
                    "points_mm": [[-400.0, 250.0], [300.0, 260.0]],
                    "speed_mm_s": 500.0,
                    "start_s": 0.3,
                }
            ],
        },
        [{}, {"outline_polygon_mm": RECTANGLE, "outline_friction": 0.4}],
    )
    flight.put(0, 10.0, 330.0, v_x=-20.0, v_y=-600.0, theta=0.4, yaw=0.5)
    flight.put(1, 400.0, 200.0, v_x=-700.0, v_y=-150.0, theta=1.1, yaw=-1.0)
    crate, cart = pymunk.Body(0.7, 2500.0), pymunk.Body(body_type=pymunk.Body.KINEMATIC)
    crate.center_of_gravity = 6.0, -4.0
    crate.position, crate.angle, crate.velocity = (150.0, 70.0), 0.5, (-300.0, 40.0)
    cart.position, cart.velocity, cart.angular_velocity = (-260.0, 60.0), (300.0, 0.0), 1.5
    shapes = [pymunk.Poly.create_box(one, (70.0, 70.0)) for one in (crate, cart)]
    shapes[0].friction = 0.6
    flight.plant.space(flight.motions, 0).add(crate, cart, *shapes)
    return flight


def control_step(flight, step):
    """Twenty substeps, and where all bodies then are, as bytes."""
    flight.plant.sort(flight.motions, step)
    flight.substeps(20)
    rows = [body_row(body) for body in flight.plant._space.bodies]
    return np.array(rows).tobytes() + flight.motions.tobytes()


CROWD_STEPS, CROWD_GOES_ON = 30, 5


@pytest.fixture(scope="module")
def crowded():
    """The course of a crowd, and its motions and states before every step."""
    quiet, asked = crowd(), crowd()
    course = [control_step(quiet, step) for step in range(CROWD_STEPS)]
    moments = []
    for step in range(CROWD_STEPS):
        moments.append((asked.motions.copy(), asked.plant.get_state()))
        assert control_step(asked, step) == course[step]  # it goes on as if it had not been asked
    assert max(len(state["pairs"]) for _, state in moments) >= 5
    assert max(np.abs(state["corrections"][:, 2]).max() for _, state in moments) > 0.0
    return course, moments


@pytest.mark.parametrize("first", range(0, CROWD_STEPS - CROWD_GOES_ON, 2))
def test_a_space_goes_on_from_its_state_to_the_last_bit(first, crowded):
    course, moments = crowded
    motions, state = moments[first]
    for name, (dtype, shape) in crowd().plant.state_layout().items():
        assert state[name].dtype == dtype, name
        assert len(state[name].shape) == len(shape), name
        assert all(b in (None, a) for a, b in zip(state[name].shape, shape, strict=True)), name
    again = crowd()
    control_step(again, 0)  # whatever it did before
    again.plant.check_state(state)
    again.plant.set_state(state, again.plant._constants)
    again.motions[:] = motions
    found = again.plant.get_state()
    assert all(np.array_equal(found[name], state[name]) for name in state)
    for step in range(first, first + CROWD_GOES_ON):
        assert control_step(again, step) == course[step]


@pytest.mark.parametrize("moments", [(0, 1, 2), (6, 9), (14, 21)])
def test_copies_of_a_space_go_on_to_the_last_bit(moments):
    """Also those of a body whose centre of mass is not at its origin, which pymunk's own copies displace."""
    flight, course, twins = crowd(), [], []
    for step in range(moments[-1] + CROWD_GOES_ON):
        if step in moments:
            copies = copy.deepcopy(flight), pickle.loads(pickle.dumps(flight))
            twins += [(step, one) for one in copies]
        course.append(control_step(flight, step))
    for first, twin in twins:
        for step in range(first, first + CROWD_GOES_ON):
            assert control_step(twin, step) == course[step], (first, step)


def test_contacts_that_no_space_has_are_refused(crowded):
    _, moments = crowded
    state = max((state for _, state in moments), key=lambda state: len(state["pairs"]))
    plant, counts = crowd().plant, state["pair_counts"]
    plant.check_state(state)

    def refused(message, **changed):
        with pytest.raises(ValueError, match=message):
            plant.check_state({**state, **changed})

    limits = [len(plant._space.shapes), len(plant._space.shapes), 3, 2, 1 << 32, 5, 2]
    for column, limit in enumerate(limits):
        for wrong in (-1, limit):
            changed = counts.copy()
            changed[-1, column] = wrong
            refused("out of range", pair_counts=changed)
    refused("out of range", pairs=state["pairs"][:-1])
    touching_itself = counts.copy()
    touching_itself[0, 1] = touching_itself[0, 0]
    refused("touches itself", pair_counts=touching_itself)
    refused("without their contacts", contacts=state["contacts"][:-1])
    refused("without their contacts", contact_keys=state["contact_keys"][:-1])
    numbers = state["shape_numbers"].copy()
    numbers[0] = numbers[1]
    refused("no number of their own", shape_numbers=numbers)
    numbers[0] = -1
    refused("no number of their own", shape_numbers=numbers)


def test_what_is_in_a_space_does_not_depend_on_what_has_happened_there(crowded):
    _, moments = crowded
    fresh, used = crowd().plant, crowd()
    control_step(used, 0)
    used.plant.reset(shapes_by=moments[0][1]["shape_numbers"] + 100)
    assert used.plant.structure() == fresh.structure()
    other = crowd().plant
    next(iter(other.pushable_bodies[0].shapes)).friction = 0.9
    assert other.structure() != fresh.structure()


def overlapping():
    """Two boxes that overlap and turn, after a step that has seen it."""
    space = pymunk.Space()
    bodies = [pymunk.Body(0.5, 400.0), pymunk.Body(0.8, 900.0)]
    space.add(*bodies, *(pymunk.Poly.create_box(one, (40.0, 30.0)) for one in bodies))
    bodies[0].center_of_gravity = 3.0, -2.0
    bodies[0].position, bodies[1].position = (1.0, 2.0), (30.0, 14.0)
    bodies[0].angle, bodies[1].angle = 0.3, -0.2
    bodies[0].velocity, bodies[1].angular_velocity = (20.0, -5.0), 0.7
    space.step(0.01)
    return space, bodies


def test_a_correction_is_what_chipmunk_adds_to_a_velocity_in_the_next_step():
    space, bodies = overlapping()
    _, others = overlapping()
    before = [body_row(body) for body in bodies]
    corrections = [take_correction(body) for body in others]
    assert [body_row(body) for body in others] == before  # nothing else is taken
    assert [tuple(take_correction(body)) for body in others] == [(0.0, 0.0, 0.0)] * 2
    dt = 0.004
    space.step(dt)
    for body, row, correction in zip(bodies, before, corrections, strict=True):
        assert np.abs(correction).min() > 1e-3
        x, y, angle, v_x, v_y, turning, *_ = row
        expected = (
            x + dt * (v_x + correction.x),
            y + dt * (v_y + correction.y),
            angle + dt * (turning + correction.turning),
        )
        assert body_row(body)[:3] == pytest.approx(expected, rel=1e-12)


@pytest.mark.parametrize("kind", [pymunk.Body.DYNAMIC, pymunk.Body.KINEMATIC])
@pytest.mark.parametrize("centre", [(0.0, 0.0), (7.0, -3.0), (1.0, 0.0), (0.0, 1.0)])
def test_a_body_that_leaves_the_index_and_enters_it_again_is_the_same(kind, centre):
    space, body = pymunk.Space(), pymunk.Body(2.5, 800.0, kind)
    space.add(body, pymunk.Circle(body, 20.0))
    body.center_of_gravity = centre
    put_body(body, (1234.5, -0.3, 0.7, 11.0, 12.0, -1.3, 0.0, 0.0, 0.0))

    def numbers():
        return (*body_row(body), *body.center_of_gravity, body.mass, body.moment, body.body_type)

    before = numbers()
    held = hold(body)
    held.leave()
    assert body.body_type == pymunk.Body.STATIC
    if kind == pymunk.Body.DYNAMIC:  # what is not moved by forces keeps its place
        body.position = 0.0, 0.0
    held.enter()
    assert numbers() == before
    centre_of_mass = body.local_to_world(body.center_of_gravity)
    assert before[:2] == pytest.approx(tuple(centre_of_mass), rel=1e-12)
    row = (5.0, 6.0, -2.0, 7.0, 8.0, 9.0, 10.0, 11.0, 12.0)
    put_body(body, row)
    assert body_row(body) == row
    assert tuple(body.center_of_gravity) == centre


def test_a_reset_takes_away_forces():
    flight = crowd()
    bodies = flight.plant._space.bodies
    for body in bodies:
        body.force, body.torque = (5.0, -3.0), 20.0
    flight.plant.reset()
    assert all((*body.force, body.torque) == (0.0, 0.0, 0.0) for body in bodies)


def test_things_of_a_world_have_its_surfaces_places_and_inertias():
    triangle = {"type": "polygon", "points_mm": [[-30.0, -20.0], [60.0, -20.0], [-30.0, 40.0]]}
    box = {"type": "box", "width_mm": 30.0, "length_mm": 70.0}
    things = [
        {
            "shape": shape,
            "x_mm": 200.0 * i,
            "y_mm": 50.0,
            "restitution": 0.1 * i,
            "friction": 0.2 * i,
        }
        for i, shape in enumerate([DISC, box, triangle], start=1)
    ]
    wall = WALL | {"restitution": 0.7, "friction": 0.9}
    flight = Flight(
        {
            "walls": [wall],
            "obstacles": things,
            "pushables": [one | {"mass_kg": 2.0, "y_mm": 900.0} for one in things],
        }
    )
    flight.put(0, 9000.0, 0.0)
    fixed = [
        one for one in flight.plant._space.shapes if one.body is flight.plant._space.static_body
    ]
    assert len(fixed) == 4
    assert [one.friction for one in fixed] == [0.9, 0.2, 0.4, 0.2 * 3]
    assert [one.elasticity for one in fixed] == [0.7, 0.1, 0.2, 0.1 * 3]
    pushed = flight.plant.pushable_bodies
    assert [next(iter(one.shapes)).friction for one in pushed] == [0.2, 0.4, 0.2 * 3]
    assert pushed[0].moment == pytest.approx(2.0 * 80.0**2 / 2)
    assert pushed[1].moment == pytest.approx(2.0 * (30.0**2 + 70.0**2) / 12)
    assert (pushed[2].position.x, pushed[2].position.y) == (600.0, 900.0)


def test_a_moving_obstacle_reaches_its_next_place_by_its_velocity():
    walker = {"shape": DISC, "points_mm": [[100.0, -200.0], [900.0, 400.0]], "speed_mm_s": 250.0}
    late = walker | {"start_s": 1.5, "angle_rad": 0.3}
    flight = Flight({"moving": [walker, late]})
    plant, period_s = flight.plant, 0.02
    plant.reset(mover_offsets_s=[0.0, 0.8])
    for step in (0, 7, 60):
        poses = plant.object_poses(step)
        plant.space(flight.motions, step)
        for i, (time_s, angle) in enumerate([(0.0, 0.0), (2.3, 0.3)]):
            way_mm = 250.0 * (time_s + step * period_s)
            expected = (100.0 + 0.8 * way_mm, -200.0 + 0.6 * way_mm)
            assert poses[i] == pytest.approx((*expected, angle))
            body = plant.moving_bodies[i]
            assert tuple(body.position) == pytest.approx(expected)
            assert tuple(body.velocity) == pytest.approx((0.8 * 250.0, 0.6 * 250.0))
            assert np.hypot(*body.velocity) == pytest.approx(plant._movers[i].speed_mm_s)


def test_what_is_in_the_space_is_seen_where_it_is():
    """Walls of the world and sensors apart; on robots where the robots are now, not where their bodies were."""
    walker = {"shape": DISC, "points_mm": [[0.0, -500.0], [700.0, -500.0]], "speed_mm_s": 100.0}
    box = {"type": "box", "width_mm": 30.0, "length_mm": 70.0}
    pushable = {"shape": box, "x_mm": 300.0, "y_mm": 20.0, "mass_kg": 1.0, "angle_rad": math.pi / 2}
    world = {"walls": [WALL], "moving": [walker], "pushables": [pushable]}
    flight = Flight(world, [{}, {}])
    plant = flight.plant
    space = plant.space(flight.motions, 0)
    bars = [pymunk.Segment(body, (0.0, 100.0), (0.0, 150.0), 4.0) for body in plant.bodies]
    zone = pymunk.Circle(space.static_body, 60.0, (900.0, 900.0))
    zone.sensor = True
    post = pymunk.Circle(space.static_body, 25.0, (-300.0, 80.0))
    rope = pymunk.PinJoint(plant.bodies[1], space.static_body, (0.0, 10.0), (50.0, 60.0))
    space.add(*bars, zone, post, rope)
    flight.put(0, 1000.0, 10.0, theta=math.pi / 2)
    flight.put(1, -500.0, 0.0)
    rows, owners = plant.visible(flight.motions, 50)
    assert sorted(owners.tolist()) == [-1] * 6 + [0, 1]
    wanted = {
        0: (900.0, 10.0, 850.0, 10.0, 4.0),
        1: (-500.0, 100.0, -500.0, 150.0, 4.0),
    }
    for robot, bar in wanted.items():
        assert rows[owners == robot][0] == pytest.approx(bar, abs=1e-9)
    others = rows[owners == -1]
    circles = others[(others[:, :2] == others[:, 2:4]).all(axis=1)]
    assert sorted(circles.tolist()) == [
        [-300.0, 80.0, -300.0, 80.0, 25.0],
        [100.0, -500.0, 100.0, -500.0, 80.0],
    ]
    sides = others[(others[:, :2] != others[:, 2:4]).any(axis=1)]
    assert sorted(np.hypot(*(sides[:, 2:4] - sides[:, :2]).T)) == pytest.approx([30, 30, 70, 70])
    assert sides[:, [0, 2]].mean() == pytest.approx(300.0)
    assert np.ptp(sides[:, [0, 2]]) == pytest.approx(70.0)
    seen = {(one.kind, one.corners_mm[0]): one for one in plant.shapes(flight.motions, 50)}
    assert {kind for kind, _ in seen} == {"fixed", "moving", "loose", "zone", "link"}
    assert ("zone", (900.0, 900.0)) in seen
    assert ("fixed", (-300.0, 80.0)) in seen
    (link,) = [one for one in seen.values() if one.kind == "link"]
    assert np.array(link.corners_mm) == pytest.approx(np.array([(-500.0, 10.0), (50.0, 60.0)]))
    places = {corner for kind, corner in seen if kind == "loose"}
    assert any(np.allclose(corner, (900.0, 10.0)) for corner in places)
    (walks,) = [one for one in seen.values() if one.kind == "moving"]
    assert walks.corners_mm[0] == pytest.approx((100.0, -500.0))


OUTLINE_MM = RobotParameters().outline_radius_mm
PERIOD_S = 0.02


def with_ball(x=3000.0, speed=0.0, outline=None):
    """A robot at the origin, and a ball of a user's at a distance along x."""
    flight = Flight(robots=[outline or {}])
    ball = pymunk.Body(1.0, 500.0)
    ball.position, ball.velocity = (x, 0.0), (speed, 0.0)
    flight.plant.space(flight.motions, 0).add(ball, pymunk.Circle(ball, 20.0))
    return flight, ball


def answer(flight, step=0):
    return flight.plant.objects(flight.motions, step)


def test_objects_are_out_of_reach_as_long_as_none_can_come_close():
    """At rest they may be forgotten for a time in which nothing can come; moving they have to be moved."""
    flight, ball = with_ball()
    assert answer(flight) == NO_OBJECTS
    until = flight.plant._calm_until
    assert 0 < until <= round(2.0 / PERIOD_S)
    ball.position = 2990.0, 0.0
    assert not flight.plant._is_calm()
    assert answer(flight) == NO_OBJECTS
    ball.velocity = 0.0, 50.0
    assert answer(flight) == OUT_OF_REACH
    ball.velocity = 0.0, 0.0
    ball.force = 1.0, 0.0
    assert answer(flight) == WITHIN_REACH
    ball.force = 0.0, 0.0
    flight.plant.bodies[0].force = 1.0, 0.0
    assert answer(flight) == WITHIN_REACH


@pytest.mark.parametrize("outline", [{}, {"outline_polygon_mm": RECTANGLE}])
@pytest.mark.parametrize("theta", [0.0, 0.9, -2.5])
@pytest.mark.parametrize("y", [30.0, 1500.0])
def test_how_long_nothing_can_come_follows_from_the_distance_to_the_outline(outline, theta, y):
    """Nothing changes its speed by more than 6 m/s² before another look; a margin of 10 mm is kept.

    The outline of a polygon is the circle around the box around it.
    """
    robot = RobotParameters(**outline)
    behind = robot.outline_offset_mm - robot.com_offset_mm
    counts = set()
    for x in np.linspace(320.0, 1300.0, 50):
        flight, ball = with_ball(outline=outline)
        flight.put(0, 1000.0 + x, y - 400.0, theta=theta)
        ball.position = 1000.0, y
        flight.plant._space.reindex_shapes_for_body(ball)
        place = 1000.0 + x, y - 400.0
        if outline:
            corners = np.add(RECTANGLE, (0.0, robot.com_offset_mm))
            low, high = (side(placed(corners, *place, theta), axis=0) for side in (np.min, np.max))
            centre, size = (low + high) / 2, math.dist(low, high) / 2
        else:
            centre = place[0] + behind * math.sin(theta), place[1] - behind * math.cos(theta)
            size = robot.outline_radius_mm
        apart = math.dist(centre, ball.position) - size - 20.0
        assert answer(flight, 5) == NO_OBJECTS
        steps = flight.plant._calm_until - 5
        assert steps == int(min(math.sqrt(2.0 * (apart - 10.0) / 6000.0), 2.0) / PERIOD_S)
        counts.add(steps)
    assert len(counts) >= 4


def test_robots_and_moving_obstacles_are_no_objects_that_have_to_be_moved():
    walker = {"shape": DISC, "points_mm": [[5000.0, 0.0], [9000.0, 0.0]], "speed_mm_s": 100.0}
    flight = Flight({"moving": [walker]})
    flight.put(0, 0.0, 0.0, v_y=200.0, yaw=0.3)
    for step in (0, 1):
        flight.plant.space(flight.motions, step)  # the bodies have the robots' velocities
        assert answer(flight, step) == NO_OBJECTS
    assert not flight.plant._rests
    far = {"shape": DISC, "x_mm": -5000.0, "y_mm": 0.0, "mass_kg": 1.0}
    flight = Flight({"moving": [walker], "pushables": [far]})
    assert answer(flight) == OUT_OF_REACH  # it may be pushed by what moves


def test_one_pulled_or_moving_body_among_others_is_enough():
    flight, first = with_ball(x=5000.0)
    space = flight.plant._space
    others = [pymunk.Body(1.0, 1.0) for _ in range(2)]
    for i, body in enumerate(others):
        body.position = -5000.0, 900.0 * i
        space.add(body, pymunk.Circle(body, 20.0))
    assert answer(flight) == NO_OBJECTS
    others[1].angular_velocity = 0.5
    assert answer(flight) == OUT_OF_REACH
    others[1].angular_velocity = 0.0
    others[0].torque = 2.0
    assert answer(flight) == WITHIN_REACH
    others[0].torque = 0.0
    first.position_func = lambda body, dt: None
    assert answer(flight) == WITHIN_REACH


def test_a_fast_object_is_within_reach_when_it_can_touch_within_a_control_step():
    for speed in (1000.0, 10_000.0):
        far = OUTLINE_MM + 20.0 + speed * PERIOD_S + 100.0
        assert answer(with_ball(x=far, speed=-speed)[0]) == OUT_OF_REACH
        near = OUTLINE_MM + 20.0 + speed * PERIOD_S - 1.0
        assert answer(with_ball(x=near, speed=-speed)[0]) == WITHIN_REACH


def test_calm_is_kept_in_states_and_copies():
    flight, ball = with_ball()
    assert answer(flight) == NO_OBJECTS
    state = flight.plant.get_state()
    until, calm = state["calm"].tolist()
    assert calm == 1
    assert until == flight.plant._calm_until > 1
    twin = pickle.loads(pickle.dumps(flight))
    assert twin.plant._is_calm()
    other, _ = with_ball(x=2000.0)
    other.plant.set_state(state, other.plant._constants)
    assert other.plant._is_calm()
    ball.position = 2500.0, 0.0
    assert flight.plant.get_state()["calm"].tolist() == [until, 0]
    assert not pickle.loads(pickle.dumps(flight)).plant._is_calm()


def test_a_step_is_divided_for_the_fastest_body_whatever_comes_before_it():
    """So that no part of it moves a body by more than a quarter of half its thickness."""
    flight, ball = with_ball(x=5000.0)
    still = pymunk.Body(1.0, 1.0)
    flight.plant._space.add(still, pymunk.Circle(still, 5.0))
    assert flight.plant._splits(0.001) == 1
    ball.velocity = 10 * 20.0 / 0.001, 0.0  # ten times half its thickness in a step
    assert flight.plant._splits(0.001) == 40
    ball.velocity, ball.angular_velocity = (0.0, 0.0), 10.0 / 0.001
    assert flight.plant._splits(0.001) == 40


def test_pushed_things_that_hardly_move_stand_still():
    disc = {"shape": DISC, "x_mm": 3000.0, "y_mm": 0.0, "mass_kg": 3.0}
    flight = Flight({"pushables": [disc]})
    (body,) = flight.plant.pushable_bodies
    body.velocity, body.angular_velocity = (1e-7, -1e-7), 1e-7
    assert answer(flight) == NO_OBJECTS
    assert (*body.velocity, body.angular_velocity) == (0.0, 0.0, 0.0)
    body.velocity, body.angular_velocity = (1e-3, 0.0), 1e-7
    assert answer(flight) == OUT_OF_REACH
    assert (*body.velocity, body.angular_velocity) == (1e-3, 0.0, 1e-7)


def environment(name="infinity", **fields):
    return tlf_env.parallel_env(name, **{"horizon_s": 20.0, "end_on": ()} | fields)


def driven(env, steps, action=(0.6, 0.0), observations=False):
    """Poses, and what is needed to compare two runs, of some steps with one action."""
    rows = []
    for _ in range(steps):
        seen, _, _, _, infos = env.step(dict.fromkeys(env.agents, np.array(action)))
        rows.append(
            [[i["x_mm"], i["y_mm"], i["theta_rad"], i["touched_by"]] for i in infos.values()]
        )
        if observations:
            rows.append(np.stack(list(seen.values())).tolist())
    return rows


@pytest.mark.parametrize("physics_period_s", [0.0005, 0.001, 0.005, 0.02])
def test_a_wall_stops_a_robot_that_drives_at_full_speed(physics_period_s):
    env = environment(
        robots=1,
        disturbance="none",
        physics_period_s=physics_period_s,
        world={"walls": [{"points_mm": [[-9000, 4000], [9000, 4000]], "thickness_mm": 0}]},
    )
    env.reset(seed=0, options={"poses": [[2500.0, 2500.0, 0.0]]})
    rows = driven(env, 300, (1.0, 0.0))
    front = max(row[0][1] for row in rows) + env.scenario.robot.outline_front_mm
    assert 3995.0 < front < 4001.0 + 1000.0 * physics_period_s  # it meets the wall within a substep
    last = rows[-1][0]
    assert 3995.0 < last[1] + env.scenario.robot.outline_front_mm < 4002.0
    assert rows[-1][0][3] == tlf_env.TouchedBy.WALL


def test_an_oblique_wall_lets_a_robot_slide_along_it_without_friction_and_holds_it_with():
    def went(friction):
        env = environment(
            robots=1,
            disturbance="none",
            robot={"outline_friction": friction},
            world={"walls": [{"points_mm": [[-9000, 3000], [9000, 3000]]}]},
        )
        env.reset(seed=0, options={"poses": [[2500.0, 2600.0, -0.5]]})
        rows = driven(env, 150, (0.4, 0.0))
        return rows[-1][0][0] - 2500.0

    assert went(0.0) > went(2.0) + 50.0


def test_touched_says_what_and_pushables_do_not_count():
    def by(world, action=(0.5, 0.0), poses=((2500.0, 2500.0, 0.0),), steps=150, **fields):
        env = environment(robots=len(poses), disturbance="none", world=world, **fields)
        env.reset(seed=0, options={"poses": poses})
        rows = driven(env, steps, action)
        return [tlf_env.TouchedBy(robot[3]) for robot in rows[-1]]

    disc = {"type": "circle", "radius_mm": 80.0}
    place = {"x_mm": 2500.0, "y_mm": 2900.0}
    assert by({}) == [tlf_env.TouchedBy.NOTHING]
    assert by({"obstacles": [{"shape": disc} | place]}) == [tlf_env.TouchedBy.WALL]
    assert by({"pushables": [{"shape": disc, "mass_kg": 1.0} | place]}) == [
        tlf_env.TouchedBy.NOTHING
    ]
    walker = {"shape": disc, "points_mm": [[1500.0, 2500.0], [3500.0, 2500.0]], "speed_mm_s": 500.0}
    assert by({"moving": [walker]}, (0.0, 0.0)) == [tlf_env.TouchedBy.OBSTACLE]
    two = ((2500.0, 2500.0, 0.0), (2500.0, 2800.0, math.pi))
    assert by({}, poses=two) == [tlf_env.TouchedBy.ROBOT] * 2
    polygon = {"robot": {"outline_polygon_mm": RECTANGLE}}
    assert by({}, poses=two, **polygon) == [tlf_env.TouchedBy.ROBOT] * 2
    wall = {"walls": [{"points_mm": [[-9000, 3000], [9000, 3000]]}]}
    assert by(wall, **polygon) == [tlf_env.TouchedBy.WALL]


@pytest.mark.parametrize("what", ["walls", "pushables", "moving"])
def test_an_episode_ends_with_a_touch_and_pays_for_it(what):
    worlds = {
        "walls": {"walls": [{"points_mm": [[-9000, 3000], [9000, 3000]]}]},
        "moving": {
            "moving": [
                {
                    "shape": {"type": "circle", "radius_mm": 100.0},
                    "points_mm": [[2500.0, 4500.0], [2500.0, 0.0]],
                    "speed_mm_s": 800.0,
                }
            ]
        },
        "pushables": {
            "pushables": [
                {
                    "shape": {"type": "circle", "radius_mm": 100.0},
                    "x_mm": 2500.0,
                    "y_mm": 2850.0,
                    "mass_kg": 0.5,
                }
            ]
        },
    }
    env = environment(robots=1, disturbance="none", world=worlds[what], end_on=("touched",))
    env.reset(seed=0, options={"poses": [[2500.0, 2500.0, 0.0]]})
    for _ in range(300):
        _, rewards, ended, _, infos = env.step({"robot_0": np.array([0.5, 0.0])})
        if ended["robot_0"]:
            break
    info = infos["robot_0"]
    if what == "pushables":
        assert not info["touched"]
        return
    assert info["end"] == tlf_env.EndReason.TOUCHED
    assert info["touched"]
    assert info["reward_touched"] == 1.0
    assert rewards["robot_0"] < -15.0


def test_a_rectangle_touches_where_its_corner_is_and_not_where_a_circle_would():
    """Side by side, 190 mm apart, rectangles 180 mm wide do not touch; the circles around them would."""
    poses = [[0.0, 0.0, 0.0], [190.0, 0.0, 0.0]]
    env = environment(robots=2, disturbance="none", robot={"outline_polygon_mm": RECTANGLE})
    env.reset(seed=0, options={"poses": poses})
    rows = driven(env, 50, (0.2, 0.0))
    assert not any(robot[3] for row in rows for robot in row)
    env = environment(robots=2, disturbance="none", robot={"outline_polygon_mm": RECTANGLE})
    env.reset(seed=0, options={"poses": [[0.0, 0.0, 0.0], [178.0, 0.0, 0.0]]})
    assert any(robot[3] for row in driven(env, 50, (0.2, 0.0)) for robot in row)


@pytest.mark.parametrize("name", ["corridor", "warehouse", "slalom_posts", "crossing_traffic"])
def test_an_episode_in_a_world_repeats_and_its_copies_go_on_bit_for_bit(name):
    env = environment(name, disturbance="combined-medium", horizon_s=25.0)
    env.reset(seed=3)
    first = driven(env, 150, (0.7, 0.15), observations=True)
    env.reset(seed=3)
    assert driven(env, 100, (0.7, 0.15), observations=True) == first[:200]
    for twin in (copy.deepcopy(env), pickle.loads(pickle.dumps(env))):
        assert driven(twin, 50, (0.7, 0.15), observations=True) == first[200:]
    assert driven(env, 50, (0.7, 0.15), observations=True) == first[200:]
    fresh = environment(name, disturbance="combined-medium", horizon_s=25.0)
    fresh.reset(seed=3)
    assert driven(fresh, 150, (0.7, 0.15), observations=True) == first


def test_copies_go_on_bit_for_bit_while_a_box_is_pushed():
    box = {
        "shape": {"type": "box", "width_mm": 300.0, "length_mm": 200.0},
        "x_mm": 2520.0,
        "y_mm": 2800.0,
        "mass_kg": 1.0,
        "floor_friction": 0.05,
    }
    env = environment(robots=1, world={"pushables": [box]}, robot={"outline_friction": 0.5})
    env.reset(seed=0, options={"poses": [[2500.0, 2500.0, 0.0]]})
    driven(env, 60, (0.3, 0.0))
    twin = copy.deepcopy(env)
    assert driven(twin, 60, (0.3, 0.0), True) == driven(env, 60, (0.3, 0.0), True)
    bodies = [one.formation.plant._pushed[0].body for one in (env, twin)]
    assert bodies[0].position == bodies[1].position
    assert bodies[0].position.y > 2900.0


@pytest.mark.parametrize("name", ["warehouse", "crossing_traffic"])
def test_a_world_out_of_reach_changes_no_bit(name):
    world = tlf_env.load_scenario(name).world
    shifted = {
        "walls": [{"points_mm": [[-1e5, -1e5], [1e5, -1e5]]}],
        "pushables": [{**one.model_dump(), "x_mm": one.x_mm + 3e4} for one in world.pushables],
        "moving": [
            {**one.model_dump(), "points_mm": [[x + 3e4, y] for x, y in one.points_mm]}
            for one in world.moving
        ],
    }
    plain, there = environment(disturbance="slip"), environment(disturbance="slip", world=shifted)
    plain.reset(seed=1)
    there.reset(seed=1)
    assert driven(there, 100, observations=True) == driven(plain, 100, observations=True)


@pytest.mark.parametrize(
    ("closed", "times_s", "places"),
    [
        (True, (0.0, 1.0, 5.0, 13.0), (0.0, 100.0, None, 100.0)),
        (False, (0.0, 1.0, 4.0, 5.5, 7.5, 9.0), (0.0, 100.0, 300.0, 250.0, 50.0, 0.0)),
    ],
)
def test_a_moving_obstacle_keeps_its_timetable(closed, times_s, places):
    """100 mm/s along 300 mm and back with pauses of 2 s; round a square in 12 s."""
    square = [[0.0, 0.0], [300.0, 0.0], [300.0, 300.0], [0.0, 300.0]]
    world = World(
        moving=[
            {
                "shape": {"type": "circle", "radius_mm": 10.0},
                "points_mm": square if closed else square[:2],
                "speed_mm_s": 100.0,
                "closed": closed,
                "pause_s": 0.0 if closed else 2.0,
            }
        ]
    )
    course = world.moving[0].course()
    for time_s, place in zip(times_s, places, strict=True):
        x, y = course.at(time_s)
        assert (x, y) == pytest.approx((300.0, 200.0) if place is None else (place, 0.0))
    assert course.lap_s == pytest.approx(12.0 if closed else 10.0)


def test_random_starts_of_obstacles_depend_on_the_seed_and_the_episode_only():
    def starts(env, seed):
        env.reset(seed=seed)
        return [tuple(mover.body.position) for mover in env.formation.plant._movers]

    env = environment("crossing_traffic", disturbance="none")
    first = starts(env, 0)
    assert starts(env, 1) != first
    assert starts(env, 0) == first
    env.reset()
    assert [tuple(mover.body.position) for mover in env.formation.plant._movers] != first
    other = environment("crossing_traffic", disturbance="combined-hard", robots=1)
    assert starts(other, 0) == first


# The compiled law of walls, and the plants without contact.


def test_the_gap_to_walls_is_the_distance_of_the_nearest_point():
    """Against points that lie densely on the shapes."""
    world = World(
        walls=[{"points_mm": [[0, 0], [1000, 0], [1000, 700]], "thickness_mm": 40, "closed": True}],
        obstacles=[
            {"shape": {"type": "circle", "radius_mm": 90}, "x_mm": -500, "y_mm": 300},
            {
                "shape": {"type": "box", "width_mm": 200, "length_mm": 100},
                "x_mm": 300,
                "y_mm": -600,
                "angle_rad": 0.6,
            },
        ],
    )
    rows = capsule_rows(world)
    share = np.linspace(0.0, 1.0, 20001)[:, None]
    rng = np.random.default_rng(0)
    for x, y in rng.uniform(-1500, 1500, (50, 2)):
        nearest = min(
            np.hypot(*((row[:2] + share * (row[2:4] - row[:2])) - (x, y)).T).min() - row[4]
            for row in rows
        )
        assert gap_to_walls(rows, x, y) == pytest.approx(nearest, abs=1e-3)


@pytest.mark.parametrize("name", ["slalom_posts", "corridor"])
def test_batch_and_pymunk_touch_walls_in_the_same_step(name):
    """Until then all is the same bit for bit; afterwards, on the batch plant, robots pass through walls."""
    fields = {"end_on": ("touched",), "disturbance": "slip", "horizon_s": 20.0}
    one, many = (
        tlf_env.parallel_env(name, **fields),
        tlf_env.BatchPlant(name, 3, **fields),
    )
    for seed in range(2):
        one.reset(seed=seed)
        many.reset(seed)
        for step in itertools.count():
            action = np.array([0.8, 0.1 * math.sin(0.02 * step)])
            *_, infos = one.step(dict.fromkeys(one.agents, action))
            many.step(np.broadcast_to(action, (3, one.scenario.robot_count, 2)))
            rows = [[i[key] for key in ("touched", "touched_by", "end")] for i in infos.values()]
            theirs = [many.touched[0], many.touched_by[0], many.ends[0]]
            assert np.array_equal(np.array(rows).T, np.array(theirs))
            x = [i["x_mm"] for i in infos.values()]
            if not one.agents:
                break
            assert x == many.info("x_mm")[0].tolist()
        assert many.ended[0]
        assert any(row[1] == tlf_env.TouchedBy.WALL for row in rows)


def test_the_kinematic_plant_touches_walls_too():
    env = environment("slalom_posts", plant="kinematic", robots=1, disturbance="none")
    env.reset(seed=0)
    from baselines import ReferencePolicy

    policy, seen = ReferencePolicy("consistent"), env.reset(seed=0)[0]
    for _ in range(400):
        actions = policy.predict(np.stack(list(seen.values())))[0]
        seen, *_, infos = env.step(dict(zip(env.agents, actions, strict=True)))
    assert infos["robot_0"]["touched_by"] == tlf_env.TouchedBy.WALL


@pytest.mark.parametrize("plant", ["batch", "kinematic"])
@pytest.mark.parametrize(
    ("fields", "named"),
    [
        ({"world": "crossing_traffic"}, "world.moving"),
        ({"world": "warehouse"}, "world.pushables"),
        ({"robot": {"outline_polygon_mm": RECTANGLE}}, "outline_polygon_mm"),
    ],
)
def test_a_plant_without_contact_names_the_plant_that_can(plant, fields, named):
    with pytest.raises(ValueError, match=f"{named} needs plant 'pymunk'") as caught:
        tlf_env.load_scenario("infinity", plant=plant, **fields)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("plant", ["pymunk", "batch"])
def test_a_start_in_a_wall_is_refused_and_a_scattered_start_avoids_it(plant):
    wall = {"walls": [{"points_mm": [[2600, 0], [2600, 5000]]}]}
    with pytest.raises(ValueError, match="robot_0 starts in a wall") as caught:
        environment(plant=plant, world=wall).reset(seed=0)
    assert "\n" not in str(caught.value)
    near = {"walls": [{"points_mm": [[2680, 0], [2680, 5000]]}]}
    env = environment(
        plant=plant, world=near, disturbance={"start": {"position_std_mm": 60.0}}, robots=1
    )
    for seed in range(20):
        _, infos = env.reset(seed=seed)
        theta, x = infos["robot_0"]["theta_rad"], infos["robot_0"]["x_mm"]
        centre = x + env.scenario.robot.outline_offset_mm * math.sin(theta)
        assert centre + env.scenario.robot.outline_radius_mm < 2670.0


def test_patches_of_the_world_act_at_every_level_and_as_those_of_a_disturbance():
    patch = {"x_mm": 2500.0, "y_mm": 3000.0, "radius_mm": 600.0, "friction_scale": 0.3}
    of_world = environment(world={"patches": [patch]}, disturbance="none", disturbance_level=0.0)
    of_disturbance = environment(disturbance={"tyre": {"patches": [patch]}})
    plain = environment(disturbance="none")
    rows = []
    for env in (of_world, of_disturbance, plain):
        env.reset(seed=0)
        rows.append([[r[:2] for r in row] for row in driven(env, 150, (1.0, 0.3))])
    assert rows[0] != rows[2]
    still = environment(world={"patches": [patch]}, disturbance="none")
    still.reset(seed=0)
    assert [[r[:2] for r in row] for row in driven(still, 150, (1.0, 0.3))] == rows[0]


def test_feasibility_names_the_walls_that_the_path_passes_through():
    lines = [
        line
        for line in tlf_env.task.scenario.scenario_warnings(tlf_env.load_scenario("slalom_posts"))
        if "world." in line
    ]
    assert len(lines) == 1
    assert "into world.obstacles[0]; it meets 9 more" in lines[0]
    wall = {"walls": [{"points_mm": [[-5000, 3300], [8000, 3300]], "thickness_mm": 10}]}
    lines = tlf_env.task.scenario.scenario_warnings(tlf_env.load_scenario("infinity", world=wall))
    assert any("into world.walls[0]" in line and "t = " in line for line in lines)
    for name in ("corridor", "warehouse", "crossing_traffic", "infinity"):
        found = tlf_env.task.scenario.scenario_warnings(tlf_env.load_scenario(name))
        assert not [line for line in found if "world" in line]


def test_a_surface_without_effect_is_reported():
    wall = {"walls": [{"points_mm": [[-5000, 9000], [8000, 9000]], "restitution": 0.8}]}
    warnings = tlf_env.task.scenario.scenario_warnings
    lines = warnings(tlf_env.load_scenario("infinity", world=wall))
    assert any("world.walls[0].restitution 0.8 has no effect" in line for line in lines)
    robot = {"outline_restitution": 1.0}
    lines = warnings(tlf_env.load_scenario("infinity", world=wall, robot=robot))
    assert not [line for line in lines if "no effect" in line]


@pytest.mark.parametrize("factor", [0.1, 10.0, 100.0])
def test_a_contact_goes_on_in_steps_of_another_length(factor):
    """Discs without bounce go on together after they met; Chipmunk alone would throw them apart."""
    space = pymunk.Space()
    discs = []
    for x_mm, speed_mm_s in ((0.0, 100.0), (19.99, 0.0)):
        body = pymunk.Body(1.0, 100.0)
        body.position, body.velocity = (x_mm, 0.0), (speed_mm_s, 0.0)
        space.add(body, pymunk.Circle(body, 10.0))
        discs.append(body)
    space.step(1e-3)
    assert [disc.velocity.x for disc in discs] == pytest.approx([50.0, 50.0])
    for _ in range(3):
        scale_contacts(space, 1e-3 * factor)
        space.step(1e-3 * factor)
        assert [disc.velocity.x for disc in discs] == pytest.approx([50.0, 50.0], abs=1e-9)
