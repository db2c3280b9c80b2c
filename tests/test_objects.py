"""What a user puts into the pymunk space takes part: walls, boxes, ropes, forces, moving obstacles."""

from __future__ import annotations

import copy
import math
import pickle
from pathlib import Path
from typing import Any

import numpy as np
import pymunk
import pytest

import tlf_env
from baselines import ReferencePolicy
from tlf_env.physics.pymunk_plant import farthest_point
from tlf_env.physics.reach import CALM_CHANGE_MM_S2, time_for, way

WALL_Y_MM = 3300.0


def environment(**fields):
    return tlf_env.parallel_env("infinity", **{"horizon_s": 20.0, "end_on": ()} | fields)


def wall(env, *ends, radius=5.0):
    shape = pymunk.Segment(env.space.static_body, *ends, radius)
    env.space.add(shape)
    return shape


def box(env, place, mass=2.0, size=150.0, velocity=(0.0, 0.0)):
    body = pymunk.Body(mass, pymunk.moment_for_box(mass, (size, size)))
    body.position, body.velocity = place, velocity
    env.space.add(body, pymunk.Poly.create_box(body, (size, size)))
    return body


def driven(env, steps, seed=0, reset=True):
    """Observations, rewards and places of the reference's steps, and the last infos."""
    policy = ReferencePolicy("consistent")
    observations = env.reset(seed=seed)[0] if reset else driven.last
    rows = []
    for _ in range(steps):
        seen = np.stack(list(observations.values()))
        actions = policy.predict(seen)[0]
        observations, rewards, *_, infos = env.step(dict(zip(env.agents, actions, strict=True)))
        rows.append([seen.ravel(), list(rewards.values()), [*places(infos)]])
    driven.last = observations
    return rows, infos


def places(infos):
    return [x for info in infos.values() for x in (info["x_mm"], info["y_mm"], info["theta_rad"])]


def same(one, other):
    return all(
        np.array_equal(a, b)
        for x, y in zip(one, other, strict=True)
        for a, b in zip(x, y, strict=True)
    )


def highest(rows, robot=0):
    return max(row[2][3 * robot + 1] for row in rows)


def test_a_wall_across_the_path_stops_the_leader():
    free = environment()
    assert highest(driven(free, 600)[0]) > WALL_Y_MM + 500
    env = environment()
    env.reset(seed=0)
    wall(env, (-5000.0, WALL_Y_MM), (8000.0, WALL_Y_MM))
    rows, infos = driven(env, 600)
    outline = env.scenario.robot.outline_radius_mm
    assert highest(rows) < WALL_Y_MM - 5.0 + 1.0
    assert highest(rows) > WALL_Y_MM - 2 * outline - 5.0
    assert infos["robot_0"]["touched"]


@pytest.mark.parametrize("what", ["wall of the world", "wall", "box", "robot"])
def test_a_bar_on_a_robot_meets_what_the_outline_does_not(what):
    """A bar that a user fixes to a robot, 300 mm ahead of its centre of mass."""
    line = {"points_mm": [[-300.0, 700.0], [300.0, 700.0]], "thickness_mm": 10.0}
    world = {"walls": [line]} if what == "wall of the world" else {}
    env = environment(robots=2, disturbance="none", world=world)
    other = [0.0, 830.0, 0.0] if what == "robot" else [2000.0, 0.0, 0.0]
    env.reset(seed=0, options={"poses": [[0.0, 0.0, 0.0], other]})
    if what == "wall":
        wall(env, *line["points_mm"])
    pushed = box(env, (0.0, 775.0)) if what == "box" else None
    env.space.add(pymunk.Segment(env.robot_bodies["robot_0"], (0, 100), (0, 300), 5))
    for _ in range(200):
        *_, infos = env.step({"robot_0": np.array([0.2, 0.0]), "robot_1": np.zeros(2)})
    tip = infos["robot_0"]["y_mm"] - env.scenario.robot.com_offset_mm + 305.0
    if what == "box":
        assert pushed.position.y - 75.0 > tip - 1.0
        assert pushed.position.y > 800.0
        assert infos["robot_0"]["touched_by"] == tlf_env.TouchedBy.NOTHING
    elif what == "robot":
        assert infos["robot_0"]["touched_by"] == tlf_env.TouchedBy.ROBOT
        assert infos["robot_1"]["y_mm"] - 140.0 > tip - 1.0
    else:
        assert tip < 696.0
        assert infos["robot_0"]["touched_by"] == tlf_env.TouchedBy.WALL


def test_touching_a_wall_ends_the_episode():
    env = environment(end_on=("touched",))
    env.reset(seed=0)
    wall(env, (-5000.0, WALL_Y_MM), (8000.0, WALL_Y_MM))
    policy, (observations, _) = ReferencePolicy("consistent"), env.reset(seed=0)
    while env.agents:
        actions = policy.predict(np.stack(list(observations.values())))[0]
        observations, rewards, _, cut, infos = env.step(dict(zip(env.agents, actions, strict=True)))
    assert infos["robot_0"]["end"] == tlf_env.EndReason.TOUCHED
    assert rewards["robot_0"] < -15
    assert cut["robot_1"]


@pytest.mark.parametrize("what", ["wall", "box at rest", "moving box", "nothing"])
def test_objects_out_of_reach_change_no_bit(what):
    free = driven(environment(disturbance="slip"), 150)[0]
    env = environment(disturbance="slip")
    env.reset(seed=0)
    if what == "wall":
        wall(env, (9000.0, -9000.0), (9000.0, 9000.0))
    elif what == "box at rest":
        box(env, (-9000.0, 0.0))
    elif what == "moving box":
        moved = box(env, (-9000.0, 0.0), velocity=(0.0, 100.0))
    assert env.space.bodies
    assert same(driven(env, 150)[0], free)
    if what == "moving box":
        assert moved.position == pytest.approx((-9000.0, 300.0), abs=1e-6)


def test_a_robot_pushes_a_box_and_no_momentum_comes_from_nowhere():
    env = environment(robots=1, disturbance="none")
    _, infos = env.reset(seed=0)
    theta = infos["robot_0"]["theta_rad"]
    ahead = np.array([-math.sin(theta), math.cos(theta)])
    start = np.array([infos["robot_0"]["x_mm"], infos["robot_0"]["y_mm"]])
    pushed = box(env, tuple(start + 260.0 * ahead))
    for _ in range(100):
        *_, infos = env.step({"robot_0": np.array([0.3, 0.0])})
    went = np.array(pushed.position) - start
    robot = np.array([infos["robot_0"]["x_mm"], infos["robot_0"]["y_mm"]]) - start
    assert went @ ahead > robot @ ahead + 100.0  # the box stays before the robot
    assert robot @ ahead > 100.0
    assert not infos["robot_0"]["touched"]  # what can be pushed is no obstacle


def test_a_reset_puts_objects_back_and_the_episode_repeats():
    env = environment(robots=1, disturbance="noise")
    _, infos = env.reset(seed=0)
    theta = infos["robot_0"]["theta_rad"]
    pushed = box(
        env,
        (
            infos["robot_0"]["x_mm"] - 260 * math.sin(theta),
            infos["robot_0"]["y_mm"] + 260 * math.cos(theta),
        ),
    )
    place = tuple(pushed.position)
    space = env.space

    def episode():
        env.reset(seed=3)
        assert tuple(pushed.position) == place
        rows = []
        for _ in range(100):
            *_, infos = env.step({"robot_0": np.array([0.3, 0.02])})
            rows.append([places(infos), tuple(pushed.position), [pushed.angle]])
        return rows

    first = episode()
    assert first[-1][1] != place
    assert same(episode(), first)
    assert env.space is space


def test_a_reset_puts_back_what_hangs_on_a_robot_and_forgets_forces():
    env = environment(robots=1, disturbance="noise")
    poses = {"poses": [[0.0, 0.0, 0.0]]}
    env.reset(seed=0, options=poses)
    trailer = box(env, (0.0, -350.0), mass=1.0)
    robot = env.robot_bodies["robot_0"]
    env.space.add(pymunk.SlideJoint(robot, trailer, (0, -60), (0, 75), 0.0, 250.0))

    def episode():
        env.reset(seed=3, options=poses)
        rows = []
        for _ in range(100):
            *_, infos = env.step({"robot_0": np.array([0.2, 0.02])})
            rows.append([places(infos), tuple(trailer.position), [trailer.angle]])
        return rows

    first = episode()
    assert first[-1][1] != (0.0, -350.0)
    for body in (robot, trailer):
        body.apply_force_at_world_point((3000.0, 0.0), body.position)
    assert same(episode(), first)


@pytest.mark.parametrize("duplicate", [copy.deepcopy, lambda env: pickle.loads(pickle.dumps(env))])
def test_a_copy_takes_the_objects_along(duplicate):
    env = environment()
    env.reset(seed=0)
    wall(env, (-5000.0, WALL_Y_MM), (8000.0, WALL_Y_MM))
    box(env, (0.0, -300.0), velocity=(20.0, 5.0))
    driven(env, 420)
    twin = duplicate(env)
    last = driven.last
    rows = driven(env, 100, reset=False)[0]
    driven.last = last
    assert same(driven(twin, 100, reset=False)[0], rows)
    assert len(twin.space.bodies) == len(env.space.bodies)


def pile(plant: str) -> Any:
    """Two robots in front of boxes and discs, two rows deep, at a wall."""
    box = {"type": "box", "width_mm": 120.0, "length_mm": 90.0}
    disc = {"type": "circle", "radius_mm": 55.0}
    things = [
        {
            "shape": shape,
            "x_mm": x,
            "y_mm": y,
            "mass_kg": 0.5,
            "floor_friction": 0.1,
            "friction": 0.4,
        }
        for x, shapes in ((-60.0, (box, disc)), (65.0, (disc, box)))
        for y, shape in zip((250.0, 355.0), shapes, strict=True)
    ]
    walls = [{"points_mm": [[-600.0, 425.0], [600.0, 425.0]]}]
    return tlf_env.parallel_env(
        "infinity", plant=plant, robots=2, world={"pushables": things, "walls": walls}, end_on=(),
        time_gap_s=0.1, preview_s=(), robot={"outline_friction": 0.4}, horizon_s=20.0,
    )  # fmt: skip


@pytest.mark.parametrize("plant", ["pymunk", "chipmunk"])
def test_a_pile_repeats_in_every_episode_and_its_copies_go_on_bit_for_bit(plant):
    """Contacts are solved in an order that earlier episodes, steps and copies do not change."""

    def episode() -> None:
        env.reset(seed=0, options={"poses": [[0.0, 100.0, 0.0], [240.0, 100.0, 0.0]]})

    def push(env: Any, step: int) -> list[Any]:
        turn = 0.1 * math.sin(0.2 * step)
        env.step({agent: [0.3, turn] for agent in env.possible_agents})
        return [(*body.position, body.angle, *body.velocity) for body in env.pushable_bodies]

    env, twins = pile(plant), []
    episode()
    first = []
    for step in range(100):
        if step in (20, 45, 70):
            twins.append((step, copy.deepcopy(env)))
        first.append(push(env, step))
    assert len(env.space._get_arbiters()) > 3
    for start, twin in twins:
        assert [push(twin, step) for step in range(start, 100)] == first[start:]
    episode()
    assert [push(env, step) for step in range(100)] == first


def test_a_rope_pulls_a_trailer():
    env = environment(robots=1, disturbance="none")
    _, infos = env.reset(seed=0)
    theta = infos["robot_0"]["theta_rad"]
    behind = (
        infos["robot_0"]["x_mm"] + 400 * math.sin(theta),
        infos["robot_0"]["y_mm"] - 400 * math.cos(theta),
    )
    trailer = box(env, behind, mass=1.0, size=60.0)
    robot = env.robot_bodies["robot_0"]
    env.space.add(pymunk.SlideJoint(robot, trailer, (0, 0), (0, 0), 0.0, 450.0))
    for _ in range(150):
        *_, infos = env.step({"robot_0": np.array([0.3, 0.0])})
    assert math.dist(trailer.position, behind) > 200.0
    assert math.dist(trailer.position, robot.position) < 460.0


def test_a_force_pushes_a_robot_sideways_no_farther_than_friction_allows():
    """A force below the tyres' friction is held; a larger one makes the robot slide."""

    def slid(force):
        env = environment(robots=1, disturbance="none")
        _, infos = env.reset(seed=0)
        theta, start = infos["robot_0"]["theta_rad"], places(infos)[:2]
        robot = env.robot_bodies["robot_0"]

        def push(body, gravity, damping, dt):
            body.apply_force_at_world_point(
                (force * math.cos(theta), force * math.sin(theta)), body.position
            )
            pymunk.Body.update_velocity(body, gravity, damping, dt)

        robot.velocity_func = push
        for _ in range(25):
            *_, infos = env.step({"robot_0": np.zeros(2)})
        return math.dist(places(infos)[:2], start)

    weight = tlf_env.load_scenario("infinity").robot.mass_kg * 9810.0  # mN
    assert slid(0.05 * weight) < 1.0
    assert slid(2.0 * weight) > 100.0


def test_a_moving_obstacle_is_touched_wherever_it_comes_from():
    env = environment(robots=1, disturbance="none")
    _, infos = env.reset(seed=0)
    x, y, _ = places(infos)
    body = pymunk.Body(body_type=pymunk.Body.KINEMATIC)
    body.position, body.velocity = (x - 2000.0, y), (1000.0, 0.0)
    env.space.add(body, pymunk.Circle(body, 100.0))
    touched_at = None
    for k in range(150):
        *_, infos = env.step({"robot_0": np.zeros(2)})
        if touched_at is None and infos["robot_0"]["touched"]:
            touched_at = 0.02 * (k + 1)
    outline = env.scenario.robot.outline_radius_mm
    assert touched_at == pytest.approx((2000.0 - 100.0 - outline) / 1000.0, abs=0.06)
    assert places(infos)[0] > x + 100.0  # it is pushed along


def test_a_users_own_collision_handler_is_called_and_changes_nothing():
    def run(handler):
        env = environment()
        env.reset(seed=0)
        wall(env, (-5000.0, WALL_Y_MM), (8000.0, WALL_Y_MM))
        if handler is not None:
            env.space.on_collision(post_solve=handler)
        return driven(env, 500)[0]

    calls = []
    plain = run(None)
    assert same(run(lambda arbiter, space, data: calls.append(arbiter.is_first_contact)), plain)
    assert calls


def test_the_documented_example_runs():
    page = (Path(__file__).parent.parent / "docs" / "environment.md").read_text(encoding="utf-8")
    section = page.split("## Objects in the space")[1]
    names: dict = {}
    exec(section.split("```python\n")[1].split("```")[0], names)
    env = names["env"]
    start = names["person"].position
    for _ in range(10):
        env.step(dict.fromkeys(env.agents, np.zeros(2)))
    assert names["person"].position - start == pytest.approx((160.0, 0.0), abs=1e-6)
    assert names["box"].position == (0.0, 0.0)


@pytest.mark.parametrize("plant", ["batch", "kinematic"])
def test_a_plant_without_contact_refuses_objects(plant):
    env = environment(plant=plant)
    env.reset(seed=0)
    still = dict.fromkeys(env.agents, np.zeros(2))
    assert env.space.bodies
    env.step(still)
    x, y = env.robot_bodies["robot_0"].position
    box(env, (x, y + 150.0))
    before = env.state()
    with pytest.raises(ValueError, match=f"plant '{plant}' has no contact: .* need plant 'pymunk'"):
        env.step(still)
    assert np.array_equal(env.state(), before)


def test_no_point_of_a_body_is_farther_away_at_any_angle_than_its_bound():
    body = pymunk.Body(1.0, 1.0)
    corners = [(-20.0, -10.0), (60.0, -10.0), (0.0, 40.0)]
    shapes = {
        math.hypot(30.0, 40.0) + 5.0: pymunk.Circle(body, 5.0, (30.0, 40.0)),
        13.0 + 2.0: pymunk.Segment(body, (5.0, 12.0), (0.0, 0.0), 2.0),
        math.hypot(60.0, 10.0): pymunk.Poly(body, corners),
    }
    for bound, shape in shapes.items():
        alone = pymunk.Body(1.0, 1.0)
        shape.body = alone
        assert farthest_point(alone) == pytest.approx(bound)
        reached = 0.0
        for angle in np.linspace(0.0, 2.0 * math.pi, 721):
            alone.angle = angle
            box = shape.cache_bb()
            reached = max(reached, *map(abs, box))
        assert reached == pytest.approx(bound, rel=1e-4)
    alone.center_of_gravity = (3.0, 4.0)
    assert farthest_point(alone) == pytest.approx(bound + 5.0)


@pytest.mark.parametrize("speed_mm_s", [0.0, 120.0, 900.0])
def test_the_way_in_a_time_and_the_time_for_a_way_are_inverse(speed_mm_s):
    """And the way is what integrating the fastest change of speed gives."""
    for time_s in (1e-3, 0.05, 2.0):
        assert time_for(speed_mm_s, way(speed_mm_s, time_s)) == pytest.approx(time_s, rel=1e-9)
        steps = np.linspace(0.0, time_s, 100_001)
        speeds = speed_mm_s + CALM_CHANGE_MM_S2 * steps
        assert way(speed_mm_s, time_s) == pytest.approx(np.trapezoid(speeds, steps), rel=1e-9)
    assert time_for(speed_mm_s, 0.0) == 0.0
    assert time_for(speed_mm_s, -5.0) == 0.0
