from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import pytest
from physics_helpers import (
    DT_S,
    FLOOR,
    ICE,
    NO_MEMORY,
    ROBOT,
    STILL,
    WITHOUT_JOINT_FRICTION,
    Run,
    kinetic_energy,
    random_start,
    random_torques,
    rolling,
    run,
    wheel_slip,
)

from tlf_env.numerics.compiled import driver
from tlf_env.numerics.rows import row_writer
from tlf_env.physics.kernel import substep_frame
from tlf_env.physics.parameters import (
    Body,
    FrictionCurve,
    JointFriction,
    Mass,
    RobotParameters,
    body,
)
from tlf_env.physics.state import (
    Contact,
    Floor,
    Motion,
    Push,
    Rates,
    conveyor,
    read_body,
    read_motion,
)
from tlf_env.physics.sweeps import begin_sweeps, sweep

SEEDS = range(24)
SECONDS = 2.0
WEIGHT_mN = ROBOT.mass_kg * ROBOT.gravity_mm_s2
write_rates = row_writer(Rates, 0)
LOADS = np.array([ROBOT.drive_load_share] * 2 + [ROBOT.castor_load_share]) * WEIGHT_mN


class Drive(NamedTuple):
    torques_Nmm: np.ndarray
    push: np.ndarray
    floor: Floor
    run: Run


def random_drive(seed: int, robot: RobotParameters = ROBOT) -> Drive:
    """A robot driven at random: half start thrown, half rolling; some are pushed or on conveyors."""
    rng = np.random.default_rng(seed)
    if seed % 2:
        start = random_start(rng, 10.0 ** rng.uniform(-3, 0))
        torques = random_torques(rng, SECONDS, 20.0)
    else:
        start = rolling(robot, *rng.uniform([-500, -1], [500, 1]))
        torques = random_torques(rng, SECONDS, 14.0)
    push = rng.uniform(-1, 1, 3) * [1000, 1000, 5e4] * (seed % 3 == 1)
    belts = rng.uniform(-50, 50, 2) * (seed % 3 == 2)
    floor = FLOOR._replace(conveyor_l=belts[0], conveyor_r=belts[1])
    made = run(robot, start, seconds=SECONDS, torques_Nmm=torques, push=push, floor=floor)
    return Drive(torques, push, floor, made)


class Substeps(NamedTuple):
    """All substeps of a run side by side: before, after, and the velocities in mid-attitude axes."""

    before: Motion
    after: Motion
    last: Contact
    given: Contact
    cos_phi: np.ndarray
    sin_phi: np.ndarray
    old_e: np.ndarray
    old_f: np.ndarray
    new_e: np.ndarray
    new_f: np.ndarray


def substeps(made: Run) -> Substeps:
    before, after = (Motion(*(x[cut] for x in made.motion)) for cut in (np.s_[:-1], np.s_[1:]))
    last, given = (Contact(*(x[cut] for x in made.contact)) for cut in (np.s_[:-1], np.s_[1:]))
    theta = before.theta + before.w * DT_S / 2
    phi = before.psi - before.theta + (before.s - before.w) * DT_S / 2
    cos, sin = np.cos(theta), np.sin(theta)
    return Substeps(
        before,
        after,
        last,
        given,
        np.cos(phi),
        np.sin(phi),
        cos * before.v_x + sin * before.v_y,
        cos * before.v_y - sin * before.v_x,
        cos * after.v_x + sin * after.v_y,
        cos * after.v_y - sin * after.v_x,
    )


def curve(mu: FrictionCurve, speed: np.ndarray) -> np.ndarray:
    x = np.clip(
        (np.abs(speed) - mu.stiction_speed_mm_s) / (mu.dynamic_speed_mm_s - mu.stiction_speed_mm_s),
        0,
        1,
    )
    return mu.mu_static + (mu.mu_dynamic - mu.mu_static) * x**2 * (3 - 2 * x)


def joint_torque(joint: JointFriction, speed, axial, radial, moment) -> np.ndarray:
    """Eq. (5)."""
    lever = joint.pin_radius_mm / joint.bending_arm_mm
    return curve(joint, speed) * (
        joint.friction_arm_mm * np.abs(axial)
        + joint.pin_radius_mm * np.abs(radial)
        + lever * np.abs(moment)
        + 1000 * joint.preload_Nmm
    )


@pytest.mark.parametrize("seed", SEEDS)
def test_momentum_changes_by_the_impulses(seed):
    torques, push, _, made = random_drive(seed)
    r, t = body(ROBOT), substeps(made)
    p = t.given
    p_ce = p.p_cx * t.cos_phi - p.p_cy * t.sin_phi
    p_cf = p.p_cx * t.sin_phi + p.p_cy * t.cos_phi
    theta = t.before.theta + t.before.w * DT_S / 2
    push_e = push[0] * np.cos(theta) + push[1] * np.sin(theta)
    push_f = push[1] * np.cos(theta) - push[0] * np.sin(theta)
    yaw = r.h * (p.p_rf - p.p_lf) - r.d * (p.p_le + p.p_re) + r.q * p_ce - p.q_s
    spins = DT_S * 1000 * torques.T
    a, b = t.before, t.after
    balances = {
        "right": r.m * (t.new_e - t.old_e) - p.p_le - p.p_re - p_ce - push_e * DT_S,
        "forward": r.m * (t.new_f - t.old_f) - p.p_lf - p.p_rf - p_cf - push_f * DT_S,
        "yaw": (r.I * (b.w - a.w) - yaw - push[2] * DT_S) / r.h,
        "fork": (r.I_s * (b.s - a.s) - r.T * p.p_cx - p.q_s) / r.T,
        "left": (r.J * (b.omega_l - a.omega_l) - spins[0] - p.q_l + r.R * p.p_lf) / r.R,
        "right wheel": (r.J * (b.omega_r - a.omega_r) - spins[1] - p.q_r + r.R * p.p_rf) / r.R,
        "castor": (r.J_c * (b.omega_c - a.omega_c) - p.q_c + r.R_c * p.p_cy) / r.R_c,
    }
    for name, difference in balances.items():
        assert np.abs(difference).max() < 1e-9, name


@pytest.mark.parametrize("seed", SEEDS)
def test_tyres_stick_within_their_circle_or_oppose_their_slip(seed):
    _, _, floor, made = random_drive(seed)
    r, t = body(ROBOT), substeps(made)
    b, p = t.after, t.given
    side = t.new_e - b.w * r.d
    pivot = t.new_e + b.w * r.q
    slips = [
        (side, t.new_f - b.w * r.h - r.R * b.omega_l - floor.conveyor_l),
        (side, t.new_f + b.w * r.h - r.R * b.omega_r - floor.conveyor_r),
        (
            pivot * t.cos_phi + t.new_f * t.sin_phi + r.T * b.s,
            t.new_f * t.cos_phi - pivot * t.sin_phi - r.R_c * b.omega_c,
        ),
    ]
    impulses = [(p.p_le, p.p_lf), (p.p_re, p.p_rf), (p.p_cx, p.p_cy)]
    speeds = [t.last.slip_l, t.last.slip_r, t.last.slip_c]
    for slip, impulse, speed, load in zip(slips, impulses, speeds, LOADS, strict=True):
        circle = curve(ROBOT.tyre, speed) * load * DT_S
        size, slip_speed = np.hypot(*impulse), np.hypot(*slip)
        assert (size <= circle * (1 + 1e-12)).all()
        sticks = size < circle * (1 - 1e-9)
        # The sweeps stop after their cap in a few substeps in ten thousand.
        assert np.count_nonzero(slip_speed[sticks] > 1e-8) <= 0.01 * len(sticks)
        assert slip_speed[sticks].max(initial=0) < 0.01
        cross = (slip[0] * impulse[1] - slip[1] * impulse[0])[~sticks] / circle[~sticks]
        assert np.abs(cross).max(initial=0) < 0.01
        assert (slip[0] * impulse[0] + slip[1] * impulse[1])[~sticks].max(initial=0) < 1e-9


@pytest.mark.parametrize("seed", SEEDS)
def test_joints_stick_within_eq_5_or_oppose_their_turning(seed):
    made = random_drive(seed).run
    r, t = body(ROBOT), substeps(made)
    a, b, p = t.before, t.after, t.given
    old = Contact(*(x / DT_S for x in t.last))
    drive, axle, steering = ROBOT.drive_joint, ROBOT.castor_joint, ROBOT.steering_joint
    load, load_c = LOADS[0], LOADS[2]

    def wheel(joint, radius, spin, across, along, load):
        radial = np.hypot(load, along)
        return joint_torque(joint, radius * spin, across, radial, radius * across)

    joints = [
        (p.q_l, b.omega_l, wheel(drive, r.R, a.omega_l, old.p_le, old.p_lf, load)),
        (p.q_r, b.omega_r, wheel(drive, r.R, a.omega_r, old.p_re, old.p_rf, load)),
        (p.q_c, b.omega_c, wheel(axle, r.R_c, a.omega_c, old.p_cx, old.p_cy, load_c)),
        (
            p.q_s,
            b.s - b.w,
            joint_torque(
                steering,
                steering.pin_radius_mm * (a.s - a.w),
                load_c,
                np.hypot(old.p_cx, old.p_cy),
                load_c * r.T,
            ),
        ),
    ]
    for impulse, rate, largest in joints:
        cap = largest * DT_S
        assert (np.abs(impulse) <= cap * (1 + 1e-12)).all()
        sticks = np.abs(impulse) < cap * (1 - 1e-9)
        assert not rate[sticks].any()
        assert (impulse * rate)[~sticks].max(initial=0) <= 0


@pytest.mark.parametrize("seed", SEEDS)
def test_no_tyre_ever_gives_more_than_static_friction(seed):
    p = random_drive(seed).run.contact
    sizes = np.hypot([p.p_le, p.p_re, p.p_cx], [p.p_lf, p.p_rf, p.p_cy])
    assert (sizes <= ROBOT.tyre.mu_static * LOADS[:, None] * DT_S * (1 + 1e-12)).all()


def energy_gain(drive: Drive, robot: RobotParameters) -> tuple[np.ndarray, np.ndarray]:
    """What each substep adds to the energy beyond the torques' and the push's work, and the energy.

    In extended precision, so that the sums' own rounding does not hide a gain.
    """
    wide = np.longdouble
    r = type(body(robot))(*(wide(x) for x in body(robot)))
    motion = Motion(*(x.astype(wide) for x in drive.run.motion))
    energy = kinetic_energy(r, motion)
    before = Motion(*(x[:-1] for x in motion))
    twists = 1000 * wide(DT_S) * drive.torques_Nmm.astype(wide).T
    pushes = wide(DT_S) * drive.push.astype(wide)
    work = sum(
        impulse * (speed + impulse / (2 * inertia))
        for impulse, speed, inertia in [
            (twists[0], before.omega_l, r.J),
            (twists[1], before.omega_r, r.J),
            (pushes[0], before.v_x, r.m),
            (pushes[1], before.v_y, r.m),
            (pushes[2], before.w, r.I),
        ]
    )
    return np.diff(energy) - work, energy[:-1] + work


@pytest.mark.parametrize("robot", [ROBOT, WITHOUT_JOINT_FRICTION], ids=["joints", "no joints"])
@pytest.mark.parametrize("seed", [seed for seed in range(60) if seed % 3 != 2])
def test_friction_never_adds_energy_to_a_driven_robot(robot, seed):
    gain, energy = energy_gain(random_drive(seed, robot), robot)
    assert (gain <= 0).all()
    assert (gain + energy >= 0).all()


def coasting(start: Motion, robot: RobotParameters, seconds: float) -> Drive:
    made = run(robot, start, seconds=seconds)
    return Drive(np.zeros((round(seconds / DT_S), 2)), np.zeros(3), FLOOR, made)


@pytest.mark.parametrize("seed", range(40))
def test_friction_adds_less_than_1e_23_of_full_speed_to_a_robot_that_coasts_to_rest(seed):
    """The one gain there is: a residual speed below 1e-9 mm/s, as the last wheel comes to a stop."""
    rng = np.random.default_rng(seed)
    gain, energy = energy_gain(coasting(random_start(rng, rng.uniform(0.01, 1)), ROBOT, 6), ROBOT)
    assert energy[-1] < 1e-20
    assert gain.max() <= 0.5 * ROBOT.mass_kg * 1e-9**2
    assert gain.max() <= 1e-23 * kinetic_energy(ROBOT, rolling(forward=1000.0))


def test_without_joint_friction_rolling_keeps_its_energy_to_rounding():
    straight = coasting(rolling(forward=400.0), WITHOUT_JOINT_FRICTION, 5.0)
    gain, energy = energy_gain(straight, WITHOUT_JOINT_FRICTION)
    assert np.abs(gain).max() <= 1e-15 * energy[0]
    turning = coasting(rolling(forward=400.0, yaw=0.8), WITHOUT_JOINT_FRICTION, 5.0)
    gain, energy = energy_gain(turning, WITHOUT_JOINT_FRICTION)
    assert gain.max() <= 1e-14 * energy[0]


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_a_run_repeats_bit_for_bit(seed):
    assert np.array_equal(random_drive(seed).run, random_drive(seed).run)


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_a_run_resumes_from_motion_and_memory_bit_for_bit(seed):
    torques, push, floor, whole = random_drive(seed)
    k = 777
    rest = run(
        ROBOT,
        *whole.at(k),
        seconds=(len(torques) - k) * DT_S,
        torques_Nmm=torques[k:],
        push=push,
        floor=floor,
    )
    assert np.array_equal(rest.motion, np.array(whole.motion)[:, k:])
    assert np.array_equal(rest.contact, np.array(whole.contact)[:, k:])


def test_the_memory_is_part_of_the_state():
    torques, push, floor, whole = random_drive(0)
    forgetful = run(
        ROBOT, whole.at(777)[0], seconds=0.1, torques_Nmm=torques[777:877], push=push, floor=floor
    )
    assert not np.array_equal(forgetful.motion, np.array(whole.motion)[:, 777:878])


@pytest.mark.parametrize("yaw", [0.0, 0.8])
def test_a_mirrored_run_gives_the_mirrored_path(yaw):
    torques = random_torques(np.random.default_rng(0), 1.0, 14.0)
    a = run(ROBOT, rolling(forward=300, yaw=yaw), seconds=1, torques_Nmm=torques).motion
    b = run(ROBOT, rolling(forward=300, yaw=-yaw), seconds=1, torques_Nmm=torques[:, ::-1]).motion
    for name in ("y", "v_y", "omega_c"):
        assert getattr(b, name) == pytest.approx(getattr(a, name), abs=1e-8), name
    for name in ("x", "theta", "psi", "v_x", "w", "s"):
        assert getattr(b, name) == pytest.approx(-getattr(a, name), abs=1e-8), name
    assert b.omega_l == pytest.approx(a.omega_r, abs=1e-8)
    assert b.omega_r == pytest.approx(a.omega_l, abs=1e-8)


@pytest.mark.parametrize("seed", [0, 3, 6])
def test_neither_place_nor_heading_matters(seed):
    rng = np.random.default_rng(seed)
    start, torques = random_start(rng), random_torques(rng, 1.0, 14.0)
    x, y, turn = 4000.0, -700.0, 2.0
    cos, sin = math.cos(turn), math.sin(turn)
    moved = start._replace(
        x=x + cos * start.x - sin * start.y,
        y=y + sin * start.x + cos * start.y,
        theta=start.theta + turn,
        psi=start.psi + turn,
        v_x=cos * start.v_x - sin * start.v_y,
        v_y=sin * start.v_x + cos * start.v_y,
    )
    a = run(ROBOT, start, seconds=1, torques_Nmm=torques).motion
    b = run(ROBOT, moved, seconds=1, torques_Nmm=torques).motion
    assert b.theta - turn == pytest.approx(a.theta, abs=1e-6)
    assert b.x == pytest.approx(x + cos * a.x - sin * a.y, abs=1e-5)
    assert b.y == pytest.approx(y + sin * a.x + cos * a.y, abs=1e-5)


SMOOTH = FrictionCurve(
    mu_static=0.0, mu_dynamic=0.0, stiction_speed_mm_s=2.0, dynamic_speed_mm_s=3.0
)
BALANCED = {"com_offset_mm": 0.0, "castor_load_share": 0.0, "drive_load_share": 0.5}


@pytest.mark.parametrize("balanced", [{}, BALANCED], ids=["d > 0", "d = 0"])
def test_without_friction_momentum_is_conserved(balanced):
    robot = RobotParameters(tyre=SMOOTH, joint_friction=False, **balanced)
    start = random_start(np.random.default_rng(0))
    made = run(robot, start, seconds=5).motion
    for name in ("v_x", "v_y", "w", "s", "omega_l", "omega_r", "omega_c"):
        assert getattr(made, name) == pytest.approx(getattr(start, name), rel=1e-12), name
    t = np.arange(len(made.x)) * DT_S
    assert made.x == pytest.approx(start.x + start.v_x * t, rel=1e-9)
    assert made.theta == pytest.approx(start.theta + start.w * t, rel=1e-9)


def test_on_ice_a_push_gives_the_momentum_of_its_impulse():
    push = np.array([120.0, -40.0, 3000.0])
    made, _ = run(WITHOUT_JOINT_FRICTION, seconds=2, push=push, floor=ICE).at(-1)
    assert made.v_x == pytest.approx(push[0] * 2 / ROBOT.mass_kg, rel=1e-12)
    assert made.v_y == pytest.approx(push[1] * 2 / ROBOT.mass_kg, rel=1e-12)
    assert made.w == pytest.approx(push[2] * 2 / ROBOT.body_inertia_kg_mm2, rel=1e-12)


def test_rolling_wheels_do_not_slip():
    made = run(ROBOT, rolling(forward=300, yaw=0.5), seconds=1, torques_Nmm=(5, 10)).motion
    assert np.abs(made.w).min() > 0.3
    assert np.abs(wheel_slip(ROBOT, made)).max() < 1e-9


@pytest.mark.parametrize("delta", [(20.0, 0.0), (0.0, 0.2), (-7.0, 0.1), (0.3, -0.05)])
@pytest.mark.parametrize("torques", [(6.0, 6.2), (2.0, 10.0)], ids=["straight", "turning"])
def test_conveyors_inject_the_slip_of_eq_14_while_the_wheels_roll(delta, torques):
    belts = conveyor(*delta, ROBOT.axle_width_mm / 2)
    floor = FLOOR._replace(conveyor_l=belts[0], conveyor_r=belts[1])
    made = run(ROBOT, rolling(forward=150.0), seconds=2, torques_Nmm=torques, floor=floor)
    slip = np.array(wheel_slip(ROBOT, made.motion)).T
    settled = np.s_[500:1500]
    assert np.abs(slip - delta)[settled].max() < 1e-9


def test_conveyors_at_rest_are_no_conveyors():
    assert Floor(*conveyor(0.0, 0.0, ROBOT.axle_width_mm / 2), 1.0, 1.0, 1.0) == FLOOR


def test_grip_scales_the_force_of_a_sliding_wheel():
    start = STILL._replace(v_x=300.0)
    memory = NO_MEMORY._replace(slip_l=300.0, slip_r=300.0, slip_c=300.0)
    for grip in (0.5, 1.0, 1.5):
        after, _ = run(ROBOT, start, memory, seconds=DT_S, floor=(0, 0, grip, grip, grip)).at(-1)
        slowed = grip * ROBOT.tyre.mu_dynamic * ROBOT.gravity_mm_s2 * DT_S
        assert start.v_x - after.v_x == pytest.approx(slowed, rel=1e-6)


@driver
def solve(
    bodies: np.ndarray,
    motions: np.ndarray,
    torques: np.ndarray,
    solved: np.ndarray,
    begun: np.ndarray,
) -> None:
    """Velocities of a substep by sweeps, and those that belong to its impulses, (field, robot)."""
    for i in range(motions.shape[1]):
        robot, motion = read_body(bodies, 0, 0), read_motion(motions, i, 0)
        memory, floor = NO_MEMORY, FLOOR
        frame = substep_frame(
            robot, motion, memory, floor, Push(0.0, 0.0, 0.0), torques[i, 0], torques[i, 1], DT_S
        )
        cos_p, sin_p, limits = frame.cos_p, frame.sin_p, frame.limits
        after, impulses = sweep(robot, frame.free, memory, cos_p, sin_p, floor, limits)
        again = begin_sweeps(robot, frame.free, impulses, cos_p, sin_p)
        write_rates(solved, i, after)
        write_rates(
            begun,
            i,
            Rates(
                again.v_e,
                again.v_f,
                again.w,
                again.s,
                again.omega_l,
                again.omega_r,
                again.omega_c,
            ),
        )


def test_the_impulses_of_a_substep_give_its_velocities_at_once():
    """So a substep that starts from the impulses of a solved one starts from its velocities."""
    rng = np.random.default_rng(7)
    starts = [random_start(rng, 10.0 ** rng.uniform(-3, 0)) for _ in range(60)]
    motions = np.array(starts).T[:, :, None].copy()
    torques = rng.uniform(-2e4, 2e4, (60, 2))
    solved, begun = np.empty((2, len(Rates._fields), 60))
    solve(np.array(body(ROBOT)).reshape(-1, 1, 1), motions, torques, solved, begun)
    scale = np.array([[300.0, 300.0, 2.0, 5.0, 10.0, 10.0, 20.0]]).T
    assert np.abs((begun - solved) / scale).max() < 1e-9
    assert (np.abs(solved).max(axis=1) > 0.01 * scale[:, 0]).all()


def test_a_payload_s_constants_are_the_first_of_the_body():
    """A payload is written over them by row."""
    assert Body._fields[: len(Mass._fields)] == Mass._fields
