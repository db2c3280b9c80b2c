"""The plant ``chipmunk``: the robot as pymunk's bodies and constraints, beside the exact kernel."""

from __future__ import annotations

import copy
import gc
import math
import os
import pickle
import subprocess
import sys
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pymunk
import pytest
from numpy.typing import ArrayLike
from physics_helpers import (
    DT_S,
    FLOOR,
    ICE,
    NO_MEMORY,
    ROBOT,
    STILL,
    WITHOUT_JOINT_FRICTION,
    complete,
    curve,
    forward_speed,
    joint_torque,
    kinetic_energy,
    random_start,
    random_torques,
    rolling,
)

import tlf_env
from baselines import ReferencePolicy
from tlf_env.physics.chipmunk_plant import ARM_MM, FORCES, ChipmunkPlant, RobotBodies
from tlf_env.physics.openloop import COLUMNS, load_scenarios, run_open_loop
from tlf_env.physics.parameters import RobotParameters, body
from tlf_env.physics.state import Contact, Floor, Motion

GOLDEN = Path(__file__).parent / "golden"
SCENARIOS = load_scenarios(GOLDEN / "scenarios.json")
PER_CONTROL_STEP = 20
LONGEST_S = 4.0  # of a golden run here; docs/chipmunk.md has them whole
# Largest error at 1 ms: position as a share of the path, and heading in rad. See docs/chipmunk.md.
GOLDEN_BOUNDS = {
    "straight": (0.01e-2, 1e-6),
    "straight_nojf": (0.03e-2, 1e-6),
    "coast": (0.04e-2, 0.001),
    "skid": (0.06e-2, 0.003),
    "spin": (0.6e-2, 0.02),
}


class Run(NamedTuple):
    """The state before the first and after every substep: fields are arrays (substep, robot)."""

    motion: Motion
    contact: Contact


def run(
    starts: list[Motion],
    robot: RobotParameters = ROBOT,
    *,
    seconds: float,
    torques_Nmm: ArrayLike = (0.0, 0.0),
    floor: ArrayLike = FLOOR,
    dt_s: float = DT_S,
    objects: tuple[pymunk.Body | pymunk.Shape, ...] = (),
) -> Run:
    """Drive robots; torques (left, right) and floor: one row, or one a substep."""
    plant = ChipmunkPlant([robot] * len(starts))
    steps = round(seconds / dt_s)
    motions = np.array(starts).T[:, :, None].copy()
    contacts = np.repeat(np.array(NO_MEMORY)[:, None, None], len(starts), axis=1)
    torques = np.broadcast_to(1000.0 * np.asarray(torques_Nmm), (steps, 2))
    floors = np.broadcast_to(complete(floor), (steps, len(Floor._fields)))
    if objects:
        plant.space(motions, 0).add(*objects)
    rows = [(motions[:, :, 0].copy(), contacts[:, :, 0].copy())]
    for k in range(steps):
        if k % PER_CONTROL_STEP == 0:
            if k:
                plant.release()
            plant.sort(motions)
        each = np.ones((1, len(starts), 1))
        plant.advance(
            motions,
            contacts,
            torques[k][:, None, None] * each,
            floors[k][:, None, None] * each,
            dt_s,
        )
        rows.append((motions[:, :, 0].copy(), contacts[:, :, 0].copy()))
    return Run(
        Motion(*np.array([row[0] for row in rows]).swapaxes(0, 1)),
        Contact(*np.array([row[1] for row in rows]).swapaxes(0, 1)),
    )


def tyre_forces(contact: Contact) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Size of the impulse of each tyre after every substep, (substep, robot)."""
    return (
        np.hypot(contact.p_le, contact.p_lf)[1:],
        np.hypot(contact.p_re, contact.p_rf)[1:],
        np.hypot(contact.p_cx, contact.p_cy)[1:],
    )


# --- the robot ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", GOLDEN_BOUNDS)
def test_golden_runs_are_followed(name):
    wanted = np.loadtxt(GOLDEN / f"{name}.csv", delimiter=",", skiprows=1)
    short = SCENARIOS[name].model_copy(
        update={"duration_s": min(SCENARIOS[name].duration_s, LONGEST_S)}
    )
    got = run_open_loop(short, plant="chipmunk")
    wanted = wanted[: len(got)]
    error = got - wanted
    path = np.hypot(*np.diff(wanted[:, 1:3], axis=0).T).sum()
    share, heading = GOLDEN_BOUNDS[name]
    assert np.hypot(*error[:, 1:3].T).max() <= share * path
    assert np.abs(error[:, COLUMNS.index("theta_rad")]).max() <= heading


def test_half_the_step_halves_the_error_in_a_skid_on_the_spot():
    wanted = np.loadtxt(GOLDEN / "spin.csv", delimiter=",", skiprows=1)
    errors = [
        np.hypot(
            *(run_open_loop(SCENARIOS["spin"], dt_s=dt_s, plant="chipmunk") - wanted)[:, 1:3].T
        ).max()
        for dt_s in (0.002, 0.001)
    ]
    assert 1.7 < errors[0] / errors[1] < 2.4


def test_a_straight_run_without_joint_friction_has_its_analytic_length():
    r = WITHOUT_JOINT_FRICTION
    spins = 2 * r.wheel_inertia_kg_mm2 / r.wheel_radius_mm**2
    castor = r.castor_inertia_kg_mm2 / r.castor_radius_mm**2
    acceleration = 2 * 8000.0 / r.wheel_radius_mm / (r.mass_kg + spins + castor)
    assert 0.5 * acceleration * 4.0**2 == pytest.approx(1973.29, abs=0.01)
    end = run([STILL], r, seconds=4.0, torques_Nmm=(8.0, 8.0)).motion
    # Chipmunk moves before it solves, so that the path is one half of a substep behind.
    assert end.y[-1, 0] == pytest.approx(0.5 * acceleration * (4.0**2 - 4.0 * DT_S), rel=1e-6)
    assert abs(end.x[-1, 0]) < 1e-9


def test_the_robot_breaks_away_at_its_friction():
    still = run([STILL], seconds=0.3, torques_Nmm=(7.2, 7.2)).motion
    moving = run([STILL], seconds=0.3, torques_Nmm=(7.3, 7.3)).motion
    assert np.abs(still.y).max() < 0.02  # what is left by 50 iterations, anew in each control step
    assert np.abs(still.v_y[-10:]).max() < 0.05
    assert forward_speed(moving)[-1, 0] > 0.4


def test_at_rest_it_stays_at_rest():
    torques = np.repeat([[5.0, 3.0]], 3000, axis=0)
    motion = run([STILL], seconds=3.0, torques_Nmm=torques).motion
    assert max(np.abs(motion.x).max(), np.abs(motion.y).max(), np.abs(motion.theta).max()) < 1e-9
    assert not np.array(motion[4:11])[:, -1].any()


@pytest.mark.parametrize("seed", range(4))
def test_no_tyre_has_more_than_its_friction(seed):
    rng = np.random.default_rng(seed)
    scale = rng.uniform(0.2, 1.0)
    torques = random_torques(rng, 1.0, 30.0)
    contact = run(
        [random_start(rng, 0.5)], seconds=1.0, torques_Nmm=torques, floor=(0, 0, *[scale] * 3)
    ).contact
    robot = body(ROBOT)
    loads = robot.load_drive, robot.load_drive, robot.load_castor
    slips = contact.slip_l, contact.slip_r, contact.slip_c
    for force, load, slip in zip(tyre_forces(contact), loads, slips, strict=True):
        x = np.clip(slip[:-1] - robot.stiction_speed, 0, 1)
        mu = robot.mu_static + (robot.mu_dynamic - robot.mu_static) * x**2 * (3 - 2 * x)
        most = mu * load * scale * DT_S
        assert (force <= most * (1 + 1e-9)).all()
        assert (force > 0.999 * most).any()  # it slides at times


def test_a_sliding_tyre_pulls_against_its_slip():
    """Both wheels spin while the robot slides sideways; one constraint with a limit would be off by far."""
    start = STILL._replace(v_x=300.0, v_y=300.0, omega_l=20.0, omega_r=20.0, psi=0.3)
    made = run([start], seconds=0.05)
    side = made.motion.v_x[1:] - made.motion.w[1:] * ROBOT.com_offset_mm
    slip_e, slip_f = made.contact.slip_l, made.contact.p_lf
    angle = np.arctan2(made.contact.p_le[5:], np.abs(slip_f[5:]))
    wanted = np.arcsin(np.clip(np.abs(side[3:-1]) / slip_e[4:-1], 0, 1))
    assert np.abs(angle - wanted).max() < 0.05


@pytest.mark.parametrize("seed", range(4))
def test_friction_never_adds_energy(seed):
    start = random_start(np.random.default_rng(seed))
    energy = kinetic_energy(ROBOT, run([start], seconds=1.0).motion)[:, 0]
    assert (np.diff(energy) <= 1e-6 * energy[0]).all()
    assert energy[-1] < 0.9 * energy[0]


def test_without_friction_it_moves_as_a_free_body():
    """The fork's mass is taken out of the chassis, and put back on its pivot: nothing is lost."""
    start = STILL._replace(v_x=30.0, v_y=-200.0, w=1.5, s=1.5)
    motion = run([start], WITHOUT_JOINT_FRICTION, seconds=1.0, floor=ICE).motion
    assert motion.v_x[-1, 0] == pytest.approx(30.0, abs=0.05)
    assert motion.v_y[-1, 0] == pytest.approx(-200.0, abs=0.05)
    assert motion.w[-1, 0] == pytest.approx(1.5, abs=1e-3)
    assert motion.theta[-1, 0] == pytest.approx(1.5, abs=1e-3)


@pytest.mark.parametrize(("delta_1", "delta_2"), [(20.0, 0.0), (-10.0, 0.1), (0.0, -0.2)])
def test_injected_slip_is_that_of_eq_14(delta_1, delta_2):
    half = ROBOT.axle_width_mm / 2
    floor = (delta_1 - delta_2 * half, delta_1 + delta_2 * half, 1.0, 1.0, 1.0)
    motion = run([rolling(forward=200.0)], seconds=0.6, torques_Nmm=(6.0, 6.0), floor=floor).motion
    radius, width = ROBOT.wheel_radius_mm, ROBOT.axle_width_mm
    more = forward_speed(motion) - radius * (motion.omega_l + motion.omega_r) / 2
    turn = motion.w - radius * (motion.omega_r - motion.omega_l) / width
    assert more[-50:] == pytest.approx(delta_1, abs=1e-4)
    assert turn[-50:] == pytest.approx(delta_2, abs=1e-6)


def test_a_long_arm_of_the_castor_leaves_inertia_to_the_chassis():
    long = RobotParameters(castor_pivot_mm=385.0, com_offset_mm=80.0, body_inertia_kg_mm2=500.0)
    plant = ChipmunkPlant([long])
    chassis = plant.bodies[0]
    assert chassis.moment > 0.1 * long.body_inertia_kg_mm2
    assert 0 < chassis.mass < long.mass_kg


def placed_robot(seed, robot=ROBOT):
    """A robot's bodies before a substep, the motion that they have, spins, and speeds of the floor."""
    rng = np.random.default_rng(seed)
    motion = random_start(rng)._replace(psi=rng.uniform(-4, 4))
    space, chassis = pymunk.Space(), pymunk.Body(1.0, 1.0)
    space.add(chassis)
    made = RobotBodies(chassis, body(robot))
    made.join(space)
    made.write(motion)
    spins, belts = rng.uniform(-20, 20, 2), rng.uniform(-80, 80, 2)
    made.place(spins.tolist(), belts.tolist(), DT_S)
    return made, motion, spins, belts


LONG_FORK = RobotParameters(
    castor_pivot_mm=140.0, castor_trail_mm=60.0, com_offset_mm=40.0, castor_radius_mm=27.0
)


@pytest.mark.parametrize("robot", [ROBOT, LONG_FORK], ids=["default", "long fork"])
@pytest.mark.parametrize("seed", range(5))
def test_the_bodies_of_a_robot_have_its_mass_inertia_and_motion(seed, robot):
    made, motion, spins, _ = placed_robot(seed, robot)
    parts = [made.chassis, made.fork]
    masses = np.array([part.mass for part in parts])
    centres = np.array([part.local_to_world(part.center_of_gravity) for part in parts])
    # A body's velocity in pymunk is that of its centre of mass.
    speeds = np.array([tuple(part.velocity) for part in parts])
    assert masses.sum() == pytest.approx(robot.mass_kg)
    assert masses @ centres / masses.sum() == pytest.approx([motion.x, motion.y])
    assert masses @ speeds / masses.sum() == pytest.approx([motion.v_x, motion.v_y])
    away, relative = centres - [motion.x, motion.y], speeds - [motion.v_x, motion.v_y]
    turning = masses @ (away[:, 0] * relative[:, 1] - away[:, 1] * relative[:, 0])
    turning += made.chassis.moment * motion.w
    assert turning == pytest.approx(robot.body_inertia_kg_mm2 * motion.w)
    assert made.fork.moment == robot.fork_inertia_kg_mm2
    inertias = 2 * [robot.wheel_inertia_kg_mm2] + [robot.castor_inertia_kg_mm2]
    assert [spin.moment for spin in made.spins] == inertias
    pivot = made.chassis.local_to_world((0.0, com_to_pivot(robot)))
    assert tuple(made.fork.position) == pytest.approx(tuple(pivot))
    joint = made.constraints[-1]
    assert made.fork.local_to_world(joint.anchor_b) == pytest.approx(
        made.chassis.local_to_world(joint.anchor_a)
    )
    assert joint.max_bias == 0.0
    read = made.read(motion.angle_l, motion.angle_r)
    expected = motion._replace(omega_l=spins[0], omega_r=spins[1])
    assert read == pytest.approx(expected)
    for still in ("v_x", "v_y", "w", "s", "omega_c"):
        made.write(motion._replace(**{still: 0.0}))
        found = made.read(0.0, 0.0)
        assert found == pytest.approx(
            motion._replace(**{still: 0.0}, angle_l=0.0, angle_r=0.0), abs=1e-9
        )
    made.write(Motion(*motion[:4], *[1e-12] * 7, 0.0, 0.0))
    found = made.read(0.0, 0.0)
    assert found[:4] == pytest.approx(motion[:4])
    assert found[4:] == (0.0,) * 9


def com_to_pivot(robot):
    """Place of the fork's pivot ahead of the centre of mass, mm."""
    return robot.com_offset_mm - robot.castor_pivot_mm


@pytest.mark.parametrize("robot", [ROBOT, LONG_FORK], ids=["default", "long fork"])
@pytest.mark.parametrize("seed", range(5))
def test_each_tyre_pulls_at_its_place_and_along_its_direction(seed, robot):
    """After Chipmunk has moved the bodies, in every constraint of a tyre the two ends lie as they should.

    Those of the axle to the right of each other, those of the drive wheels ahead of each other, and so for
    the castor and its fork; the speed of the ends is that of the tyre over the floor.
    """
    made, motion, spins, belts = placed_robot(seed, robot)
    for part in (made.chassis, *made.bodies):
        pymunk.Body.update_position(part, DT_S)
    theta, psi = motion.theta + DT_S * motion.w, motion.psi + DT_S * motion.s
    right, ahead = ((math.cos(angle), math.sin(angle)) for angle in (theta, psi))
    right, ahead = np.array(right), np.array([-right[1], right[0]])
    fork_right = np.array([math.cos(psi), math.sin(psi)])
    fork_ahead = np.array([-fork_right[1], fork_right[0]])
    axle = np.array(made.chassis.local_to_world((0.0, robot.com_offset_mm)))
    half = robot.axle_width_mm / 2
    contact = np.array(made.fork.local_to_world((0.0, -robot.castor_trail_mm)))
    places = [axle, axle - half * right, axle + half * right, contact, contact]
    ways = [right, ahead, ahead, fork_right, fork_ahead]
    radius, castor = robot.wheel_radius_mm, robot.castor_radius_mm
    rims = [
        None,
        radius * spins[0] + belts[0],
        radius * spins[1] + belts[1],
        None,
        castor * motion.omega_c,
    ]
    for i, (tyre, place, way, rim) in enumerate(zip(made.tyres(), places, ways, rims, strict=True)):
        first, last = (
            np.array(one.local_to_world(anchor))
            for one, anchor in ((tyre.a, tyre.anchor_a), (tyre.b, tyre.anchor_b))
        )
        assert last - first == pytest.approx(ARM_MM * way, abs=1e-6), FORCES[i]
        at_robot = last if rim is None else first
        assert at_robot == pytest.approx(place, abs=1e-9), FORCES[i]
        assert tyre.max_bias == 0.0
        speed = tyre.b.velocity_at_local_point(tyre.anchor_b) @ way if rim is not None else 0.0
        assert speed == pytest.approx(rim or 0.0, rel=1e-9, abs=1e-9), FORCES[i]
        if rim is None:
            still = tyre.a.velocity_at_local_point(tyre.anchor_a)
            assert tuple(still) == (0.0, 0.0)


def test_a_push_acts_at_the_centre_of_mass_besides_a_users_force():
    plant = ChipmunkPlant([ROBOT, ROBOT])
    motions = np.repeat(np.array(STILL._replace(theta=0.8, psi=0.8))[:, None, None], 2, axis=1)
    motions[0, 1] = 1000.0
    plant.space(motions, 0)
    plant.bodies[1].force, plant.bodies[1].torque = (100.0, -50.0), 700.0
    plant.sort(motions)
    pushes = np.array([[300.0, -200.0], [40.0, 10.0], [5000.0, -900.0]])
    plant._push(pushes)
    forces = {body: (np.array(force), torque) for body, force, torque in plant._forces}
    for i, (own, own_torque) in enumerate([((0.0, 0.0), 0.0), ((100.0, -50.0), 700.0)]):
        force, torque = forces[plant.bodies[i]]
        assert force == pytest.approx(pushes[:2, i] + own)
        # Chipmunk lets a force act at the chassis' own centre of mass, ahead of the robot's.
        away = np.array(plant.bodies[i].local_to_world(plant.bodies[i].center_of_gravity))
        away -= motions[:2, i, 0]
        about_the_robot = torque - own_torque + away[0] * pushes[1, i] - away[1] * pushes[0, i]
        assert about_the_robot == pytest.approx(pushes[2, i])
    plant._push(np.zeros((3, 2)))
    forces = {body: (tuple(force), torque) for body, force, torque in plant._forces}
    assert forces[plant.bodies[0]] == ((0.0, 0.0), 0.0)
    assert forces[plant.bodies[1]] == ((100.0, -50.0), 700.0)


@pytest.mark.parametrize("seed", range(6))
def test_limits_and_memory_of_a_substep_follow_from_its_state(seed):
    """The joints have the kernel's limits; a tyre's two limits lie on its circle or have the same room."""
    rng = np.random.default_rng(seed)
    plant = ChipmunkPlant([ROBOT])
    motion = random_start(rng, 10.0 ** rng.uniform(*((-2, 0) if seed % 2 else (-6, -4))))
    motions = np.array(motion)[:, None, None].copy()
    slips = rng.uniform(0, 5, 3)
    contacts = np.array(
        NO_MEMORY._replace(p_cx=0.2, p_cy=-0.3, slip_l=slips[0], slip_r=slips[1], slip_c=slips[2])
    )
    contacts = contacts[:, None, None].copy()
    belts = (20.0, -10.0) if seed % 2 else (0.0, 0.0)  # without, slow tyres stick
    floors = np.array(complete((*belts, 0.9, 0.8, 0.7)))[:, None, None].copy()
    plant._limit(motions, contacts, floors, np.zeros((2, 1)), DT_S)
    limits = plant._limits[:, 0]
    robot = body(ROBOT)
    mu = curve(ROBOT.tyre, slips)
    grips = mu * [robot.load_drive, robot.load_drive, robot.load_castor] * [0.9, 0.8, 0.7]
    across = [limits[0] / 2, limits[0] / 2, limits[3]]
    along = [limits[1], limits[2], limits[4]]
    assert (np.array(along) <= grips * (1 + 1e-9)).all()
    assert np.hypot(across[2], along[2]) == pytest.approx(grips[2])
    sides = limits[0] - np.sqrt(np.maximum(grips[:2] ** 2 - np.array(along[:2]) ** 2, 0.0)).sum()
    assert sides == pytest.approx(0.0, abs=1e-6 * grips.sum())
    load, load_c = robot.load_drive, robot.load_castor
    rims = robot.R * motion.omega_l, robot.R * motion.omega_r, robot.R_c * motion.omega_c
    joints = ROBOT.drive_joint, ROBOT.drive_joint, ROBOT.castor_joint
    across, along = (0.0, 0.0, 0.2 / DT_S), (0.0, 0.0, 0.3 / DT_S)
    radii = robot.R, robot.R, robot.R_c
    for i, carried in enumerate((load, load, load_c)):
        radial = math.hypot(carried, along[i])
        most = joint_torque(joints[i], rims[i], across[i], radial, across[i] * radii[i])
        assert limits[5 + i] == pytest.approx(most)
    steering = ROBOT.steering_joint
    turning = steering.pin_radius_mm * (motion.s - motion.w)
    expected = joint_torque(
        steering, turning, load_c, math.hypot(0.2, 0.3) / DT_S, load_c * robot.T
    )
    assert limits[8] == pytest.approx(expected)
    if seed % 2 == 0:
        return
    # The castor slides: its impulse is opposite to the slip that there would be without it, as the last
    # substep has left it, less what the impulse itself changes.
    sin, cos = math.sin(motion.psi - motion.theta), math.cos(motion.psi - motion.theta)
    side = motion.v_x * math.cos(motion.theta) + motion.v_y * math.sin(motion.theta)
    ahead = motion.v_y * math.cos(motion.theta) - motion.v_x * math.sin(motion.theta)
    pivot = side + robot.q * motion.w
    x_c = pivot * cos + ahead * sin + robot.T * motion.s
    y_c = ahead * cos - pivot * sin - robot.R_c * motion.omega_c
    w_x = 1 / robot.m + (robot.q * cos) ** 2 / robot.I + robot.T**2 / robot.I_s
    w_y = 1 / robot.m + (robot.q * sin) ** 2 / robot.I + robot.R_c**2 / robot.J_c
    lambdas = [
        (abs(slip) + w * last) / (limit * DT_S) - w
        for slip, w, last, limit in ((x_c, w_x, 0.2, limits[3]), (y_c, w_y, 0.3, limits[4]))
    ]
    assert lambdas[0] == pytest.approx(lambdas[1], rel=1e-6)


@pytest.mark.parametrize("seed", range(4))
def test_what_is_recorded_of_a_substep_moves_its_wheels(seed):
    """Tyre and joint make each wheel's change of spin; the slips are those of the motion."""
    rng = np.random.default_rng(seed)
    starts = [random_start(rng, 0.5) for _ in range(3)]
    plant = ChipmunkPlant([ROBOT] * 3)
    motions = np.array(starts).T[:, :, None].copy()
    motions[0, :, 0] = [0.0, 1e4, 2e4]
    contacts = np.repeat(np.array(NO_MEMORY)[:, None, None], 3, axis=1)
    floors = np.repeat(np.array(complete((30.0, -20.0, 1.0, 0.8, 0.9)))[:, None, None], 3, axis=1)
    torques = rng.uniform(-1e4, 1e4, (2, 3, 1))
    before = motions[:, :, 0].copy()
    plant.sort(motions)
    plant.advance(motions, contacts, torques, floors, DT_S)
    first, after = Motion(*before), Motion(*motions[:, :, 0])
    found, robot = Contact(*contacts[:, :, 0]), body(ROBOT)
    for spins, others, torque, q, p in (
        (first.omega_l, after.omega_l, torques[0, :, 0], found.q_l, found.p_lf),
        (first.omega_r, after.omega_r, torques[1, :, 0], found.q_r, found.p_rf),
    ):
        turned = robot.J * (others - spins) - DT_S * torque + robot.R * p
        assert np.abs(turned) == pytest.approx(q, abs=1e-6)
        assert np.abs(p).min() > 0.0
    across = plant._impulses[0]
    assert found.p_le + found.p_re == pytest.approx(across)
    loads = robot.load_drive * 1.0, robot.load_drive * 0.8
    for load, p_e, p_f in zip(
        loads, (found.p_le, found.p_re), (found.p_lf, found.p_rf), strict=True
    ):
        assert (np.hypot(p_e, p_f) <= robot.mu_static * load * DT_S * (1 + 1e-9)).all()
    sin, cos = np.sin(after.theta), np.cos(after.theta)
    side = after.v_x * cos + after.v_y * sin
    ahead = after.v_y * cos - after.v_x * sin
    half = robot.h * after.w
    left = ahead - half - robot.R * after.omega_l - 30.0
    right = ahead + half - robot.R * after.omega_r + 20.0
    assert found.slip_l == pytest.approx(np.hypot(side - robot.d * after.w, left))
    assert found.slip_r == pytest.approx(np.hypot(side - robot.d * after.w, right))
    sin, cos = np.sin(after.psi - after.theta), np.cos(after.psi - after.theta)
    pivot = side + robot.q * after.w
    x_c = pivot * cos + ahead * sin + robot.T * after.s
    y_c = ahead * cos - pivot * sin - robot.R_c * after.omega_c
    assert found.slip_c == pytest.approx(np.hypot(x_c, y_c))
    assert np.array_equal(plant._impulses[[3, 4, 7, 8]], contacts[[4, 5, 8, 9], :, 0])


READY = """
import numpy as np
from physics_helpers import DT_S, NO_MEMORY, ROBOT, STILL, complete, FLOOR
from tlf_env.physics.chipmunk_plant import ChipmunkPlant, record, set_limits

plant = ChipmunkPlant([ROBOT])
rows = (np.array(row)[:, None, None].copy() for row in (STILL, NO_MEMORY, complete(FLOOR)))
motions, contacts, floors = rows
plant.compile(motions, contacts, floors, DT_S)
before = [len(one.overloads) for one in (set_limits, record)]
plant.sort(motions)
plant.advance(motions, contacts, np.zeros((2, 1, 1)), floors, DT_S)
after = [len(one.overloads) for one in (set_limits, record)]
assert before == after == [1, 1], (before, after)
"""


def test_the_drivers_of_a_substep_are_there_before_the_first_one():
    """In a process of its own, as others here have loaded them."""
    done = subprocess.run(
        [sys.executable, "-c", READY],
        capture_output=True,
        text=True,
        check=False,
        env={**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)},
    )
    assert done.returncode == 0, done.stderr


# --- contact -----------------------------------------------------------------------------------------


def test_two_robots_that_meet_head_on_stop_and_gain_no_energy():
    gap, ahead = 20.0, ROBOT.com_offset_mm - ROBOT.outline_offset_mm
    half = gap / 2 + ROBOT.outline_radius_mm + ahead
    one = rolling(forward=300.0)._replace(y=-half)
    other = rolling(forward=300.0)._replace(y=half, theta=math.pi, psi=math.pi, v_x=0.0, v_y=-300.0)
    motion = run([one, other], seconds=0.4).motion
    overlap = 2 * (ROBOT.outline_radius_mm + ahead) - (motion.y[:, 1] - motion.y[:, 0])
    assert overlap.max() < 0.7
    assert overlap[-1] > -1.0
    assert np.abs(motion.v_y[-1]).max() < 1.0
    energy = kinetic_energy(ROBOT, motion).sum(axis=1)
    assert np.diff(energy).max() <= 1e-6 * energy[0]


def test_a_robot_does_not_feel_another_one_far_away():
    """Nor a wall: Chipmunk solves all constraints together, but those of different bodies do not mix."""
    start = random_start(np.random.default_rng(0))
    far = rolling(forward=100.0)._replace(x=1e5)
    alone, beside = run([start], seconds=0.3), run([start, far], seconds=0.3)
    for a, b in zip(alone.motion, beside.motion, strict=True):
        assert np.array_equal(a[:, 0], b[:, 0])


# --- in the environment ------------------------------------------------------------------------------


def environment(**fields):
    given = {"plant": "chipmunk", "robots": 2, "horizon_s": 20.0, "end_on": ()} | fields
    return tlf_env.parallel_env("infinity", **given)


def driven(env, observations, steps):
    """All that the reference's steps give, as bytes."""
    policy, rows = ReferencePolicy("consistent"), []
    for _ in range(steps):
        actions = policy.predict(np.stack(list(observations.values())))[0]
        observations, rewards, *_ = env.step(dict(zip(env.agents, actions, strict=True)))
        rows.append(
            (
                np.stack(list(observations.values())).tobytes(),
                tuple(rewards.values()),
                env.unwrapped.state().tobytes(),
            )
        )
    return observations, rows


def test_the_closed_loop_is_that_of_the_exact_kernel():
    course = []
    for plant in ("pymunk", "chipmunk"):
        env = environment(plant=plant, robots=1, disturbance="none")
        observations, _ = env.reset(seed=0)
        rows = []
        for _ in range(150):
            action = ReferencePolicy("consistent").predict(np.stack(list(observations.values())))[0]
            observations, *_, infos = env.step({"robot_0": action[0]})
            rows.append([infos["robot_0"][name] for name in ("x_mm", "y_mm", "torque_l_Nmm")])
        course.append(np.array(rows))
    exact, made = course
    assert np.hypot(*(exact - made)[:, :2].T).max() < 1.0
    assert np.abs(exact - made)[:, 2].mean() < 0.1


def test_episodes_repeat_and_copies_go_on_bit_for_bit():
    env = environment(disturbance="slip")
    observations, _ = env.reset(seed=5)
    observations, before = driven(env, observations, 30)
    twins = copy.deepcopy(env), pickle.loads(pickle.dumps(env))
    seen = {agent: row.copy() for agent, row in observations.items()}
    _, after = driven(env, observations, 30)
    for twin in twins:
        assert driven(twin, seen, 30)[1] == after
    observations, _ = env.reset(seed=5)
    assert driven(env, observations, 60)[1] == before + after


def test_copies_in_contact_go_on_bit_for_bit():
    env = environment(robots=3, time_gap_s=0.1, preview_s=())
    env.reset(seed=0, options={"poses": [[0.0, -212.0 * i, 0.0] for i in range(3)]})

    def push(env, steps):
        return [
            np.stack(
                list(
                    env.step({a: [-0.3 if a == "robot_0" else 0.2, 0.0] for a in env.agents})[
                        0
                    ].values()
                )
            ).tobytes()
            for _ in range(steps)
        ]

    push(env, 12)
    assert env.formation.arrays.touched.any()
    twin = copy.deepcopy(env)
    assert push(twin, 12) == push(env, 12)


def test_a_run_does_not_depend_on_when_python_collects_garbage():
    """Constraints of earlier control steps stay known to their bodies until then."""
    box = {
        "shape": {"type": "box", "width_mm": 120.0, "length_mm": 90.0},
        "x_mm": 0.0,
        "y_mm": 160.0,
        "mass_kg": 0.5,
        "floor_friction": 0.1,
    }
    courses = []
    for often in (False, True):
        env = environment(robots=1, world={"pushables": [box, {**box, "y_mm": 255.0}]})
        env.reset(seed=0, options={"poses": [[0.0, 0.0, 0.0]]})
        gc.disable()
        try:
            rows = []
            for step in range(60):
                if often:
                    gc.collect()
                env.step({"robot_0": [0.3 if step < 30 else -0.3, 0.02]})
                rows.append([(*one.position, *one.velocity) for one in env.pushable_bodies])
        finally:
            gc.enable()
        courses.append(rows)
    assert courses[0] == courses[1]


@pytest.mark.parametrize("disturbance", ["slip", "ice", "payload", "actuator"])
def test_a_disturbance_of_level_zero_is_off_bit_for_bit(disturbance):
    courses = []
    for name, level in ((disturbance, 0.0), ("nominal", 0.0), (disturbance, 1.0)):
        env = environment(robots=1, disturbance=name, disturbance_level=level)
        observations, _ = env.reset(seed=1)
        courses.append(driven(env, observations, 25)[1])
    assert courses[0] == courses[1]
    assert courses[2] != courses[1]


def test_disturbances_are_those_of_the_other_plants():
    applied = []
    for plant in ("pymunk", "chipmunk"):
        env = environment(plant=plant, disturbance="combined-hard")
        env.reset(seed=2)
        rows = []
        for _ in range(20):
            env.step({agent: [0.3, 0.1] for agent in env.agents})
            rows.append(env.formation.applied().copy())
        applied.append(np.array(rows))
    assert np.array_equal(*applied)


def test_infos_have_slip_and_torque_of_this_plant():
    env = environment(robots=1, disturbance="none", action="torque")
    env.reset(seed=0)
    for _ in range(30):
        *_, infos = env.step({"robot_0": [1.0, 1.0]})
    info, motion = infos["robot_0"], env.formation.named("motion")
    assert info["torque_l_Nmm"] == pytest.approx(15.0)
    power_mW = 15.0 * (motion.omega_l[0] + motion.omega_r[0])
    assert info["energy_mJ"] == pytest.approx(power_mW * 0.02, rel=0.05)
    assert info["slip_mm_s"] < 0.01


def test_a_wall_stops_it_and_a_box_is_pushed():
    env = environment(robots=1, disturbance="none")
    _, infos = env.reset(seed=0, options={"poses": [[0.0, 0.0, 0.0]]})
    box = pymunk.Body(1.0, 2000.0)
    box.position = 0.0, 200.0
    wall = pymunk.Segment(env.space.static_body, (-2000.0, 500.0), (2000.0, 500.0), 5.0)
    env.space.add(box, pymunk.Poly.create_box(box, (100.0, 100.0)), wall)
    touched = []
    for _ in range(150):
        *_, infos = env.step({"robot_0": [0.3, 0.0]})
        touched.append(infos["robot_0"]["touched"])
    outline = ROBOT.outline_radius_mm - ROBOT.outline_offset_mm
    assert box.position.y > 300.0
    assert infos["robot_0"]["y_mm"] + outline < 495.0 + 1.0
    assert infos["robot_0"]["y_mm"] > 200.0


def test_a_wall_is_touched():
    env = environment(robots=1, disturbance="none")
    env.reset(seed=0, options={"poses": [[0.0, 0.0, 0.0]]})
    env.space.add(pymunk.Segment(env.space.static_body, (-2000.0, 200.0), (2000.0, 200.0), 5.0))
    for _ in range(80):
        *_, infos = env.step({"robot_0": [0.4, 0.0]})
    assert infos["robot_0"]["touched"]
    assert infos["robot_0"]["y_mm"] + ROBOT.outline_front_mm < 195.0 + 1.0


def test_between_steps_the_space_has_only_the_chassis_and_what_a_user_put_there():
    env = environment()
    observations, _ = env.reset(seed=0)
    rope = pymunk.SlideJoint(*env.robot_bodies.values(), (0, 0), (0, 0), 0.0, 320.0)
    env.space.add(rope)
    driven(env, observations, 5)
    assert set(env.space.bodies) == set(env.robot_bodies.values())
    assert list(env.space.constraints) == [rope]


def test_a_payload_is_part_of_the_bodies():
    env = environment(robots=1, disturbance="payload")
    env.reset(seed=0)
    laden = env.formation.named("body")
    driven(env, env.reset(seed=0)[0], 2)
    bodies = env.formation.plant._robots[0]
    assert laden.m[0] > ROBOT.mass_kg + 0.1
    assert bodies.chassis.mass + bodies.fork.mass == pytest.approx(laden.m[0])
    ahead = bodies.chassis.center_of_gravity.y
    inertia = (
        bodies.chassis.moment + bodies.chassis.mass * ahead**2 + bodies.fork.mass * laden.q[0] ** 2
    )
    assert inertia == pytest.approx(laden.I[0])
    assert bodies.chassis.mass * ahead == pytest.approx(bodies.fork.mass * laden.q[0])


def test_it_cannot_run_in_a_batch():
    with pytest.raises(
        ValueError, match=r"plant 'chipmunk' .* 'batch' and 'kinematic' can"
    ) as caught:
        tlf_env.BatchPlant("infinity", 2, plant="chipmunk")
    assert "\n" not in str(caught.value)
    with pytest.raises(ValueError, match="plant 'rapier' cannot run open loop"):
        run_open_loop(SCENARIOS["spin"], plant="rapier")


def test_fast_bodies_divide_a_substep_and_change_little():
    """Nothing passes through a wall; a substep in parts has the motors' torques in each of them."""
    start = rolling(forward=300.0)
    bullet = pymunk.Body(1e-6, 1.0)
    bullet.position, bullet.velocity = (5000.0, 0.0), (0.0, 3000.0)
    whole = run([start], seconds=0.1, torques_Nmm=(9.0, 8.0)).motion
    parted = run(
        [start], seconds=0.1, torques_Nmm=(9.0, 8.0), objects=(bullet, pymunk.Circle(bullet, 2.0))
    ).motion
    assert not np.array_equal(whole.v_y, parted.v_y)
    assert parted.v_y[-1, 0] == pytest.approx(whole.v_y[-1, 0], rel=1e-3)
    assert parted.w[-1, 0] == pytest.approx(whole.w[-1, 0], abs=2e-3)


def test_a_world_has_walls_things_to_push_and_moving_obstacles():
    world = {
        "walls": [{"points_mm": [[-2000.0, 600.0], [2000.0, 600.0]]}],
        "pushables": [
            {
                "shape": {"type": "box", "width_mm": 100.0, "length_mm": 100.0},
                "mass_kg": 0.5,
                "x_mm": 0.0,
                "y_mm": 220.0,
                "floor_friction": 0.02,
            }
        ],
    }
    env = environment(robots=1, disturbance="none", world=world)
    env.reset(seed=0, options={"poses": [[0.0, 0.0, 0.0]]})
    for _ in range(120):
        *_, infos = env.step({"robot_0": [0.3, 0.0]})
    assert 300.0 < env.pushable_bodies[0].position.y < 600.0
    assert infos["robot_0"]["y_mm"] + ROBOT.outline_front_mm < 600.0


def test_a_reset_puts_a_trailer_back():
    env = environment(robots=1, disturbance="none")
    env.reset(seed=0, options={"poses": [[0.0, 0.0, 0.0]]})
    trailer = pymunk.Body(0.5, 500.0)
    trailer.position = 0.0, -300.0
    rope = pymunk.SlideJoint(env.robot_bodies["robot_0"], trailer, (0, 0), (0, 0), 0.0, 310.0)
    env.space.add(trailer, pymunk.Circle(trailer, 50.0), rope)
    for _ in range(60):
        env.step({"robot_0": [0.3, 0.0]})
    assert trailer.position.y > -250.0
    env.reset(seed=0)
    assert tuple(trailer.position) == (0.0, -300.0)
