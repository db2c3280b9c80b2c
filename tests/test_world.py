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
from tlf_env.physics.pymunk_plant import THETA, V_X, V_Y, YAW, PymunkPlant, X, Y
from tlf_env.physics.state import Motion
from tlf_env.physics.world import World, capsule_rows, gap_to_walls

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
        for _ in range(round(time_s / self.dt)):
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
