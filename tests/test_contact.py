from __future__ import annotations

import copy
import math
import pickle
from collections.abc import Callable
from typing import Any, NamedTuple

import cloudpickle
import numpy as np
import pymunk
import pytest
from physics_helpers import DT_S, NO_MEMORY, ROBOT, STILL, kinetic_energy, rolling

import tlf_env
from tlf_env.engine.formation import reference_table
from tlf_env.physics.openloop import advance_open_loop
from tlf_env.physics.parameters import RobotParameters, body_array
from tlf_env.physics.pymunk_plant import COLLISION_SLOP_MM, ITERATIONS, PymunkPlant
from tlf_env.physics.state import Motion

OUTLINES_MM = 2 * ROBOT.outline_radius_mm
AHEAD_MM = (
    ROBOT.com_offset_mm - ROBOT.outline_offset_mm
)  # of the outline's centre, from the centre of mass
SPEED_MM_S = 300.0
ON_ICE = RobotParameters(
    tyre=ROBOT.tyre.model_copy(update={"mu_static": 0.0, "mu_dynamic": 0.0}), joint_friction=False
)
X, Y, THETA, V_X, V_Y, YAW, OMEGA_L = (
    Motion._fields.index(name) for name in ("x", "y", "theta", "v_x", "v_y", "w", "omega_l")
)
POSE, TWIST = [X, Y, THETA], [V_X, V_Y, YAW]
PHASES_MM = np.arange(0, 0.6, 0.05)


class Meeting(NamedTuple):
    """What was recorded after every substep of several robots in one space."""

    motions: np.ndarray  # (step, field, robot)
    overlap_mm: np.ndarray  # of the outlines of robots 0 and 1
    energy: np.ndarray  # (step, 2): after the kernel, after the space


def energy_of(motions: np.ndarray) -> float:
    return float(kinetic_energy(ROBOT, Motion(*motions[:, :, 0])).sum())


def outline_centres(motions: np.ndarray) -> np.ndarray:
    x, y, theta = motions[0, :, 0], motions[1, :, 0], motions[2, :, 0]
    return np.stack([x - AHEAD_MM * np.sin(theta), y + AHEAD_MM * np.cos(theta)], axis=-1)


def meet(starts: list[Motion], seconds: float, robot: RobotParameters = ROBOT) -> Meeting:
    """Coast robots through kernel and space."""
    plant = PymunkPlant([robot] * len(starts))
    bodies, zero = body_array([robot]), np.zeros(3)
    motions = np.array(starts).T[:, :, None].copy()
    contacts = [np.array(NO_MEMORY).reshape(-1, 1, 1) for _ in starts]
    steps = round(seconds / DT_S)
    rows = np.empty((steps, len(Motion._fields), len(starts)))
    overlap, energy = np.empty(steps), np.empty((steps, 2))
    for k in range(steps):
        before = motions.copy()
        for i, contact in enumerate(contacts):
            one = motions[:, i : i + 1].copy()
            advance_open_loop(bodies, one, contact, np.zeros((1, 2)), zero, DT_S)
            motions[:, i : i + 1] = one
        after_kernel = energy_of(motions)
        plant.collide(before, motions, DT_S)
        energy[k] = after_kernel, energy_of(motions)
        rows[k] = motions[:, :, 0]
        centres = outline_centres(motions)
        overlap[k] = OUTLINES_MM - math.dist(centres[0], centres[1])
    return Meeting(rows, overlap, energy)


def head_on(gap_mm: float) -> list[Motion]:
    """Two robots that face each other, their outlines ``gap_mm`` apart."""
    half = (gap_mm + OUTLINES_MM) / 2 + AHEAD_MM
    one = rolling(forward=SPEED_MM_S)._replace(y=-half)
    other = one._replace(y=half, theta=math.pi, psi=math.pi, v_y=-SPEED_MM_S)
    return [one, other]


@pytest.fixture(scope="module")
def collisions() -> list[Meeting]:
    """Head-on collisions whose first overlap falls all over a substep."""
    return [meet(head_on(20.0 + phase), 1.0) for phase in PHASES_MM]


def test_robots_that_collide_head_on_both_stop(collisions):
    for made in collisions:
        touch = np.argmax(made.overlap_mm > 0)
        speeds = np.hypot(made.motions[:, V_X], made.motions[:, V_Y])
        assert speeds[touch - 1].min() > 0.95 * SPEED_MM_S
        assert speeds[touch + 1 :].max() < 1e-6
        assert made.motions[-1, OMEGA_L].tolist() == [0.0, 0.0]


def test_head_on_collision_overlaps_by_less_than_a_substep_of_closing_about_0_24_mm(collisions):
    """Contact is seen at the first substep that overlaps: 0.24 mm is one of 0 to 0.6 mm."""
    closing_mm = 2 * SPEED_MM_S * DT_S
    deepest = np.array([made.overlap_mm.max() for made in collisions])
    assert (deepest <= closing_mm + COLLISION_SLOP_MM).all()
    assert deepest.min() < 0.24 < deepest.max()
    assert deepest.mean() == pytest.approx(closing_mm / 2, abs=0.05)
    for made in collisions:
        assert made.overlap_mm[-1] <= 1.02 * COLLISION_SLOP_MM


def test_head_on_collision_gains_no_energy(collisions):
    for made in collisions:
        start = 2 * float(kinetic_energy(ROBOT, rolling(forward=SPEED_MM_S)))
        flow = np.concatenate([[start], made.energy.ravel()])
        assert np.diff(flow).max() <= 1e-15 * start
        touch = np.argmax(made.overlap_mm > 0)
        assert made.energy[touch + 1, 1] < 0.1 * made.energy[touch - 1, 1]


def test_head_on_collision_is_symmetric(collisions):
    for made in collisions:
        assert np.abs(made.motions[:, Y].sum(axis=1)).max() < 1e-6
        assert np.abs(made.motions[:, 0]).max() < 1e-6


@pytest.mark.parametrize("aside_mm", [0.0, 60.0, 150.0])
def test_collision_conserves_momentum_where_the_floor_gives_none(aside_mm):
    one = STILL._replace(y=-200.0, v_y=SPEED_MM_S)
    other = STILL._replace(x=aside_mm, y=200.0, v_y=-0.5 * SPEED_MM_S, theta=math.pi)
    made = meet([one, other], 1.5, ON_ICE)
    assert made.overlap_mm.max() > 0
    momentum = made.motions[:, [V_X, V_Y]].sum(axis=2)
    assert momentum == pytest.approx(np.tile([0.0, 0.5 * SPEED_MM_S], (1500, 1)), abs=1e-9)
    assert np.diff(made.energy.ravel()).max() <= 1e-12 * made.energy[0, 0]


def chipmunk_alone(starts: list[Motion]) -> pymunk.Space:
    """Frictionless robots in a space of the test's own."""
    space = pymunk.Space()
    space.iterations, space.collision_slop = ITERATIONS, COLLISION_SLOP_MM
    for start in starts:
        one = pymunk.Body(ROBOT.mass_kg, ROBOT.body_inertia_kg_mm2)
        outline = pymunk.Circle(one, ROBOT.outline_radius_mm, offset=(0.0, AHEAD_MM))
        outline.friction = outline.elasticity = 0.0
        space.add(one, outline)
        one.angle, one.position = start.theta, (start.x, start.y)
        one.velocity, one.angular_velocity = (start.v_x, start.v_y), start.w
    return space


def space_poses(space: pymunk.Space) -> np.ndarray:
    return np.transpose([(*one.position, one.angle) for one in space.bodies])


def collide_once(plant: PymunkPlant, motions: np.ndarray) -> None:
    before = motions.copy()
    motions[POSE] += motions[TWIST] * DT_S
    plant.collide(before, motions, DT_S)


@pytest.mark.parametrize("seed", range(8))
def test_without_the_floor_robots_collide_exactly_as_chipmunk_has_it(seed):
    rng = np.random.default_rng(seed)
    starts = [
        STILL._replace(x=x, y=y, theta=theta, v_x=-x, v_y=-y, w=w)
        for x, y, theta, w in zip(
            [-130, 130, 0], [0, 10, 230], rng.uniform(-3, 3, 3), rng.uniform(-2, 2, 3), strict=True
        )
    ]
    space, plant = chipmunk_alone(starts), PymunkPlant([ROBOT] * 3)
    motions = np.array(starts).T[:, :, None].copy()
    for _ in range(800):
        space.step(DT_S)
        collide_once(plant, motions)
        assert np.array_equal(motions[POSE, :, 0], space_poses(space))
    assert not np.allclose(motions[V_X, :, 0], [start.v_x for start in starts])


def test_robots_that_part_are_still_pushed_out_of_their_last_overlap():
    """Chipmunk corrects an overlap in the substep after the one that saw it."""
    half = OUTLINES_MM / 2 - 0.2
    starts = [STILL._replace(x=-half), STILL._replace(x=half)]
    space, plant = chipmunk_alone(starts), PymunkPlant([ROBOT] * 2)
    motions = np.array(starts).T[:, :, None].copy()
    for speed in (0.0, 500.0, 500.0):
        for one, direction in zip(space.bodies, (-1, 1), strict=True):
            one.velocity = direction * speed, 0.0
        motions[V_X, :, 0] = -speed, speed
        space.step(DT_S)
        collide_once(plant, motions)
        assert np.array_equal(motions[POSE, :, 0], space_poses(space))


def test_a_rebuilt_space_repeats_a_collision_bit_for_bit():
    a, b = meet(head_on(20.0), 0.5), meet(head_on(20.0), 0.5)
    assert np.array_equal(a.motions, b.motions)


def test_a_reset_plant_has_forgotten_its_contacts():
    plant = PymunkPlant([ROBOT, ROBOT])
    results = []
    for _ in range(2):
        plant.reset()
        motions = np.array(head_on(0.2)).T[:, :, None].copy()
        for _ in range(5):
            collide_once(plant, motions)
        results.append(motions)
    assert np.array_equal(*results)


def test_the_space_leaves_robots_that_do_not_touch_alone():
    plant = PymunkPlant([ROBOT] * 3)
    rng = np.random.default_rng(0)
    motions = rng.normal(size=(len(Motion._fields), 3, 1)) * 100
    motions[X] = [[-5000.0], [0.0], [5000.0]]
    for _ in range(100):
        before = motions.copy()
        motions[POSE] += motions[TWIST] * DT_S
        kernel = motions.copy()
        plant.collide(before, motions, DT_S)
        assert np.array_equal(motions, kernel)


def test_the_space_that_a_user_reads_has_the_robots_where_they_are():
    plant = PymunkPlant([ROBOT] * 2)
    motions = np.random.default_rng(0).normal(size=(len(Motion._fields), 2, 1))
    motions[X] = [[-500.0], [700.0]]
    space = plant.space(motions, 0)
    assert {*plant.bodies} <= {*space.bodies}
    for i, body in enumerate(plant.bodies):
        seen = (*body.position, body.angle, *body.velocity, body.angular_velocity)
        assert seen == tuple(motions[[*POSE, *TWIST], i, 0])
        (outline,) = body.shapes
        info = space.point_query_nearest(
            tuple(body.position), ROBOT.outline_radius_mm, pymunk.ShapeFilter()
        )
        assert info is not None
        assert info.shape is outline  # the index knows the place, too


def test_a_collision_far_away_changes_nothing_here():
    bystander = rolling(forward=200.0, yaw=0.4)._replace(x=50_000.0)
    made = meet([*head_on(20.0), bystander], 0.3)
    alone = meet([bystander, STILL], 0.3)
    assert np.array_equal(made.motions[:, :, 2], alone.motions[:, :, 0])


def leader_states(robots: int, spacing_mm: float) -> np.ndarray:
    """Motion, memory and estimate of robot_0 over time; the others stand still."""
    env = tlf_env.parallel_env(robots=robots, end_on=())
    x, y, theta = reference_table(env.scenario)[0, :3]
    behind = spacing_mm * np.arange(robots)
    poses = np.column_stack(
        [x + behind * np.sin(theta), y - behind * np.cos(theta), np.full(robots, theta)]
    )
    env.reset(seed=3, options={"poses": poses})
    rng = np.random.default_rng(3)
    arrays, rows = env.formation.arrays, []
    actions = {agent: np.zeros(2) for agent in env.possible_agents}
    for forward, turn in rng.uniform([0.0, -0.3], [0.5, 0.3], (150, 2)):
        actions["robot_0"] = np.array([forward, turn])
        env.step(actions)
        states = (arrays.rows("motion"), arrays.rows("contact"), arrays.rows("estimate"))
        rows.append(np.concatenate([state[:, 0, 0] for state in states]))
    assert not arrays.touched.any()
    return np.array(rows)


@pytest.mark.parametrize("spacing_mm", [221.0, 300.0, 5000.0], ids=["near", "preset", "far"])
def test_robots_that_do_not_touch_change_nothing(spacing_mm):
    """Near ones go through the space, far ones do not."""
    assert np.array_equal(leader_states(3, spacing_mm), leader_states(1, spacing_mm))


def test_injected_slip_at_level_zero_is_the_nominal_run_bit_for_bit():
    slip = {"slip": {"delta_1_mm_s": 20.0, "delta_2_rad_s": 0.2}, "tyre": {"friction_scale": 0.5}}
    disturbances = ["none", {**slip, "level": 0.0}, {**slip, "level": 1.0}]
    envs = [tlf_env.parallel_env(robots=1, disturbance=one, end_on=()) for one in disturbances]
    for env in envs:
        env.reset(seed=0)
    for action in np.random.default_rng(0).uniform(-1, 1, (50, 2)):
        for env in envs:
            env.step({"robot_0": action})
    nominal, zero, disturbed = (env.formation.arrays.rows("motion") for env in envs)
    assert np.array_equal(nominal, zero)
    assert not np.array_equal(nominal, disturbed)


# --- copies ------------------------------------------------------------------------------------------

COPIERS: dict[str, Callable[[Any], Any]] = {
    "deepcopy": copy.deepcopy,
    "pickle": lambda env: pickle.loads(pickle.dumps(env)),
    "cloudpickle": lambda env: cloudpickle.loads(cloudpickle.dumps(env)),
}
PUSHED_S, STEP_S = 10.0, 0.02
PUSHED_STEPS = round(PUSHED_S / STEP_S)
MOMENTS = (
    0,
    *range(4, 40, 3),
    *range(70, 480, 31),
    150,
    151,
)  # control steps; first contacts are early
TO_THE_END = (0, 16, 22)
FOR_STEPS = 10


def pushing(robots: int) -> Any:
    """A queue of robots, the first of which backs into the others."""
    env = tlf_env.parallel_env(
        "infinity", robots=robots, horizon_s=PUSHED_S, control_period_s=STEP_S, time_gap_s=0.1,
        preview_s=(), end_on=(),
    )  # fmt: skip
    env.reset(seed=0, options={"poses": [[0.0, -210.0 * i, 0.0] for i in range(robots)]})
    return env


def push(env: Any, step: int) -> bytes:
    """One control step, and all that it gives."""
    rng = np.random.default_rng(step // 25)
    forward, turning = rng.uniform(-0.2, 0.8, 5), rng.uniform(-0.5, 0.5, 5)
    forward[0] = -0.3
    agents = env.possible_agents
    observations, rewards, *_ = env.step(
        {agent: [forward[i], turning[i]] for i, agent in enumerate(agents)}
    )
    seen = [*observations.values(), np.array(list(rewards.values())), env.unwrapped.state()]
    return b"".join(array.tobytes() for array in seen)


@pytest.mark.parametrize("robots", [2, 3, 4, 5])
def test_copies_before_at_and_in_contact_go_on_bit_for_bit(robots):
    env, copies, course = pushing(robots), [], []
    for step in range(PUSHED_STEPS):
        if step in MOMENTS:
            name = list(COPIERS)[len(copies) % len(COPIERS)]
            copies.append((step, name, COPIERS[name](env)))
        course.append(push(env, step))
    for first, name, twin in copies:
        last = PUSHED_STEPS if first in TO_THE_END else first + FOR_STEPS
        for step in range(first, last):
            assert push(twin, step) == course[step], (first, name, step)
    again = pushing(robots)  # nothing was copied from this one
    assert [push(again, step) for step in range(PUSHED_STEPS)] == course


@pytest.mark.parametrize("copier", COPIERS.values(), ids=COPIERS)
def test_a_copy_of_a_copy_and_a_second_copy_go_on_alike(copier):
    env = pushing(3)
    for step in range(40):
        push(env, step)
    twins = [copier(env), copier(copier(env)), copier(env)]
    for step in range(40, 120):
        wanted = push(env, step)
        assert all(push(twin, step) == wanted for twin in twins)


def test_a_look_at_the_space_changes_nothing_in_a_pile():
    quiet, looked_at = pushing(4), pushing(4)
    for step in range(300):
        assert len(looked_at.space.bodies) == 4
        assert push(quiet, step) == push(looked_at, step)
