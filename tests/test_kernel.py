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
    curve,
    joint_torque,
    kinetic_energy,
    random_start,
    random_torques,
    rolling,
    run,
    wheel_slip,
)

from tlf_env.numerics.compiled import driver
from tlf_env.numerics.rows import reader, row_writer, writer
from tlf_env.physics.kernel import roll, slide, substep_frame
from tlf_env.physics.parameters import (
    Body,
    FrictionCurve,
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
    read_contact,
    read_motion,
    write_motion,
)
from tlf_env.physics.sweeps import (
    SWEEP_CAP,
    SWEEP_TOLERANCE_MM_S,
    Sweep,
    begin_sweeps,
    change_of,
    sweep,
    sweep_on,
)

SEEDS = range(24)
SECONDS = 2.0
SHORT_SEEDS = range(60)
SHORT_STEPS = 6
# No two of its lengths, masses or friction arms are the default robot's.
UNLIKE = RobotParameters(
    mass_kg=3.1,
    body_inertia_kg_mm2=21_000.0,
    axle_width_mm=151.0,
    com_offset_mm=31.0,
    wheel_radius_mm=27.0,
    castor_radius_mm=13.0,
    castor_pivot_mm=83.0,
    castor_trail_mm=17.0,
    drive_load_share=0.345,
    castor_load_share=0.31,
)
STAGES = 80  # more sweeps than any of the cases here needs
write_rates = row_writer(Rates, 0)
read_sweep, write_sweep = reader(Sweep), writer(Sweep)
read_floor, read_push = reader(Floor), reader(Push)


def loads_of(robot: RobotParameters) -> np.ndarray:
    """On left wheel, right wheel and castor, mN."""
    shares = [robot.drive_load_share] * 2 + [robot.castor_load_share]
    return np.array(shares) * robot.mass_kg * robot.gravity_mm_s2


LOADS = loads_of(ROBOT)


class Drive(NamedTuple):
    torques_Nmm: np.ndarray
    push: np.ndarray
    floor: Floor
    run: Run
    robot: RobotParameters


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
    return Drive(torques, push, floor, made, robot)


def with_fork_at_rest(robot: RobotParameters, start: Motion, forward: float, yaw: float) -> Motion:
    """A rolling robot on a circle, whose castor angle stays as it is: nothing slips and s = w."""
    across = yaw * robot.castor_pivot_mm
    phi = math.asin(-yaw * robot.castor_trail_mm / math.hypot(forward, across))
    phi -= math.atan2(across, forward)
    along = forward * math.cos(phi) - across * math.sin(phi)
    return start._replace(psi=start.theta + phi, omega_c=along / robot.castor_radius_mm)


def short_drive(seed: int) -> Drive:
    """A few substeps, so that many cases take little time, also where the laws are not compiled.

    Every other robot goes on rolling, so that the closed form holds, with its steering stuck or turning. The
    others slide, spin or are nearly at rest, on weak grip, with creep and pushes.
    """
    rng = np.random.default_rng(seed)
    robot = (ROBOT, WITHOUT_JOINT_FRICTION, UNLIKE)[seed % 3]
    belts = rng.uniform(-50, 50, 2) * rng.integers(2)
    rolls, grips, creep = seed % 2 == 1, np.ones(3), 0.0
    if rolls:
        forward, yaw = rng.choice([-1, 1]) * rng.uniform(100, 500), rng.uniform(-0.6, 0.6)
        start = rolling(robot, forward, yaw)
        still = 7.0 * np.sign(forward) * robot.joint_friction
        torques = still + rng.uniform(-1, 1, (SHORT_STEPS, 2))
        push = rng.uniform(-1, 1, 3) * [20, 20, 1e3]
        spins = belts / robot.wheel_radius_mm
        start = start._replace(omega_l=start.omega_l - spins[0], omega_r=start.omega_r - spins[1])
        if seed % 4 == 3:
            start = with_fork_at_rest(robot, start, forward, yaw)
    else:
        start = random_start(rng, 10.0 ** rng.uniform(-3, 0))
        if seed % 8 == 0:
            start = start._replace(s=start.w)
        torques = rng.uniform(-14, 14, (SHORT_STEPS, 2))
        push = rng.uniform(-1, 1, 3) * [1000, 1000, 5e4] * rng.integers(2)
        grips = rng.uniform(0.1, 1.2, 3)
        creep = 0.05 * (seed % 6 == 0)
    turn = rng.uniform(-3, 3)
    cos, sin = math.cos(turn), math.sin(turn)
    start = start._replace(
        theta=start.theta + turn,
        psi=start.psi + turn,
        v_x=cos * start.v_x - sin * start.v_y,
        v_y=sin * start.v_x + cos * start.v_y,
    )
    floor = Floor(*belts, *grips, 0.02 * rng.integers(2), creep)
    made = run(
        robot, start, seconds=SHORT_STEPS * DT_S, torques_Nmm=torques, push=push, floor=floor
    )
    return Drive(torques, push, floor, made, robot)


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


def check_momentum(drive: Drive) -> None:
    """All bodies change their momenta by the impulses, and fork and wheels turn with the new rates."""
    torques, push, _, made, robot = drive
    r, t = body(robot), substeps(made)
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
        "fork angle": b.psi - a.psi - DT_S * b.s,
        "angle left": b.angle_l - a.angle_l - DT_S * b.omega_l,
        "angle right": b.angle_r - a.angle_r - DT_S * b.omega_r,
        "x": b.x - a.x - DT_S * b.v_x,
        "y": b.y - a.y - DT_S * b.v_y,
        "theta": b.theta - a.theta - DT_S * b.w,
    }
    for name, difference in balances.items():
        assert np.abs(difference).max() < 1e-9, name


def check_tyres(drive: Drive, held_mm_s: float = 1e-8) -> None:
    """Each tyre holds within its circle, but for its creep, or pulls on it against its slip.

    ``held_mm_s`` is what counts as no slip. Sweeps of a tyre with creep end before that is as small.
    """
    floor, robot = drive.floor, drive.robot
    r, t = body(robot), substeps(drive.run)
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
    kept = [p.slip_l, p.slip_r, p.slip_c]
    grips = floor.grip_l, floor.grip_r, floor.grip_c
    rims = r.R * t.before.omega_l, r.R * t.before.omega_r, r.R_c * t.before.omega_c
    for slip, impulse, speed, after, grip, rim, load in zip(
        slips, impulses, speeds, kept, grips, rims, loads_of(robot), strict=True
    ):
        circle = curve(robot.tyre, speed) * load * grip * DT_S
        size, slip_speed = np.hypot(*impulse), np.hypot(*slip)
        assert slip_speed == pytest.approx(after, abs=1e-9, rel=1e-9)
        assert (size <= circle * (1 + 1e-12)).all()
        sticks = size < circle * (1 - 1e-9)
        creep = floor.creep * np.abs(rim) / (load * DT_S)
        held = np.hypot(*(one + creep * given for one, given in zip(slip, impulse, strict=True)))
        # The sweeps stop after their cap in a few substeps in ten thousand.
        assert np.count_nonzero(held[sticks] > held_mm_s) <= 0.01 * len(sticks)
        assert held[sticks].max(initial=0) < 0.01
        cross = (slip[0] * impulse[1] - slip[1] * impulse[0])[~sticks] / circle[~sticks]
        assert np.abs(cross).max(initial=0) < 0.01
        assert (slip[0] * impulse[0] + slip[1] * impulse[1])[~sticks].max(initial=0) < 1e-9


def check_joints(drive: Drive) -> None:
    """Each axle holds within eq. (5) and the resistance to rolling, or both oppose its turning."""
    robot = drive.robot
    r, t = body(robot), substeps(drive.run)
    a, b, p = t.before, t.after, t.given
    old = Contact(*(x / DT_S for x in t.last))
    drives, axle, steering = robot.drive_joint, robot.castor_joint, robot.steering_joint
    load, _, load_c = loads_of(robot)
    resists, there = drive.floor.rolling, float(robot.joint_friction)

    def wheel(joint, radius, spin, across, along, load):
        radial = np.hypot(load, along)
        torque = joint_torque(joint, radius * spin, across, radial, radius * across)
        return there * torque + resists * load * radius

    turning = joint_torque(
        steering,
        steering.pin_radius_mm * (a.s - a.w),
        load_c,
        np.hypot(old.p_cx, old.p_cy),
        load_c * r.T,
    )
    joints = [
        (p.q_l, b.omega_l, wheel(drives, r.R, a.omega_l, old.p_le, old.p_lf, load)),
        (p.q_r, b.omega_r, wheel(drives, r.R, a.omega_r, old.p_re, old.p_rf, load)),
        (p.q_c, b.omega_c, wheel(axle, r.R_c, a.omega_c, old.p_cx, old.p_cy, load_c)),
        (p.q_s, b.s - b.w, there * turning),
    ]
    for impulse, rate, largest in joints:
        cap = largest * DT_S
        assert (np.abs(impulse) <= cap * (1 + 1e-12)).all()
        sticks = np.abs(impulse) < cap * (1 - 1e-9)
        assert not rate[sticks].any()
        assert (impulse * rate)[~sticks].max(initial=0) <= 0


@pytest.mark.parametrize("seed", SHORT_SEEDS)
def test_a_few_substeps_in_any_state_keep_all_laws(seed):
    drive = short_drive(seed)
    check_momentum(drive)
    check_tyres(drive, held_mm_s=1e-4)
    check_joints(drive)


@driver
def both_ways(
    bodies: np.ndarray,
    motions: np.ndarray,
    contacts: np.ndarray,
    floors: np.ndarray,
    pushes: np.ndarray,
    torques: np.ndarray,
    holds: np.ndarray,
    rolled: np.ndarray,
    slid: np.ndarray,
) -> None:
    """Each substep of a run in closed form, and whether that holds, and by sweeps; (field, substep, 1)."""
    for k in range(torques.shape[0]):
        robot, floor, push = (
            read_body(bodies, 0, 0),
            read_floor(floors, 0, 0),
            read_push(pushes, 0, 0),
        )
        motion, contact = read_motion(motions, k, 0), read_contact(contacts, k, 0)
        left, right = torques[k, 0], torques[k, 1]
        holds[k], closed, _ = roll(robot, motion, contact, floor, push, left, right, DT_S)
        swept, _ = slide(robot, motion, contact, floor, push, left, right, DT_S)
        write_motion(rolled, k, 0, closed)
        write_motion(slid, k, 0, swept)


@pytest.mark.parametrize("seed", [seed for seed in SHORT_SEEDS if seed % 6])  # those without creep
def test_the_closed_form_holds_where_all_wheels_roll_and_is_what_sweeps_find(seed):
    drive = short_drive(seed)
    made, joints = drive.run, drive.robot.joint_friction
    resists = joints or drive.floor.rolling > 0.0
    holds = np.zeros(SHORT_STEPS, dtype=np.bool_)
    rolled, slid = np.zeros((2, len(Motion._fields), SHORT_STEPS, 1))
    both_ways(
        np.array(body(drive.robot)).reshape(-1, 1, 1),
        np.array(made.motion)[:, :, None],
        np.array(made.contact)[:, :, None],
        np.array(drive.floor).reshape(-1, 1, 1),
        drive.push.reshape(-1, 1, 1),
        1000.0 * drive.torques_Nmm,
        holds,
        rolled,
        slid,
    )
    a, b = Motion(*(x[:-1] for x in made.motion)), Motion(*slid[:, :, 0])
    slips = np.max([x[1:] for x in made.contact[-3:]], axis=0)
    axles = [(a.omega_l, b.omega_l), (a.omega_r, b.omega_r), (a.omega_c, b.omega_c)]
    go_on = [(before * after > 0) | (not resists) for before, after in axles]
    steers = ((a.s - a.w) * (b.s - b.w) > 0) | (not joints)
    steering = np.where(a.s == a.w, b.s == b.w, steers)
    even = np.isclose(made.contact.p_le[1:], made.contact.p_re[1:])  # not if a circle is too small
    expected = (slips < 1e-6) & np.all(go_on, axis=0) & steering & even
    assert np.array_equal(holds, expected)
    velocities = np.s_[Motion._fields.index("v_x") : Motion._fields.index("angle_l")]
    scale = np.array([300.0, 300.0, 2.0, 2.0, 10.0, 10.0, 20.0])[:, None]
    difference = np.abs(rolled - slid)[velocities, :, 0] / scale
    assert difference[:, holds].max(initial=0.0) < 1e-7


@driver
def in_stages(
    bodies: np.ndarray,
    motions: np.ndarray,
    floors: np.ndarray,
    torques: np.ndarray,
    one_by_one: np.ndarray,
    at_once: np.ndarray,
) -> None:
    """The state after every sweep, (field, sweep, robot), and where the sweeps end, (field, robot, 1)."""
    for i in range(motions.shape[1]):
        robot, motion, floor = (
            read_body(bodies, 0, 0),
            read_motion(motions, i, 0),
            read_floor(floors, i, 0),
        )
        push = Push(0.0, 0.0, 0.0)
        frame = substep_frame(
            robot, motion, NO_MEMORY, floor, push, torques[i, 0], torques[i, 1], DT_S
        )
        cos_p, sin_p, free, limits = frame.cos_p, frame.sin_p, frame.free, frame.limits
        state = begin_sweeps(robot, free, NO_MEMORY, cos_p, sin_p)
        ended = sweep_on(robot, free, cos_p, sin_p, floor, limits, state, SWEEP_CAP)
        write_sweep(at_once, i, 0, ended)
        write_sweep(one_by_one, 0, i, state)
        for k in range(STAGES):
            state = sweep_on(robot, free, cos_p, sin_p, floor, limits, state, 1)
            write_sweep(one_by_one, k + 1, i, state)


def speeds_of(robot: RobotParameters, rows: Sweep) -> np.ndarray:
    """The velocities of a sweep as speeds, mm/s: (velocity, ...)."""
    r = body(robot)
    turns = r.h * rows.w, r.T * rows.s
    spins = r.R * rows.omega_l, r.R * rows.omega_r, r.R_c * rows.omega_c
    return np.array([rows.v_e, rows.v_f, *turns, *spins])


def test_sweeps_end_as_soon_as_no_velocity_changes():
    rng = np.random.default_rng(3)
    count = 12
    starts = [random_start(rng, 10.0 ** rng.uniform(-3, 0)) for _ in range(count)]
    motions = np.array(starts).T[:, :, None].copy()
    floors = np.repeat(np.array(FLOOR)[:, None, None], count, axis=1)
    torques = rng.uniform(-2e4, 2e4, (count, 2))
    bodies = np.array(body(ROBOT)).reshape(-1, 1, 1)
    stages = np.zeros((len(Sweep._fields), STAGES + 1, count))
    ends = np.zeros((len(Sweep._fields), count, 1))
    in_stages(bodies, motions, floors, torques, stages, ends)
    speeds = speeds_of(ROBOT, Sweep(*stages))
    settled = np.abs(np.diff(speeds, axis=1)).max(axis=0) < SWEEP_TOLERANCE_MM_S
    assert settled.any(axis=0).all()
    needed = settled.argmax(axis=0) + 1
    assert needed.max() > 10
    assert np.array_equal(ends[:, :, 0], stages[:, needed, np.arange(count)])


@driver
def all_changes(bodies: np.ndarray, rows: np.ndarray, changes: np.ndarray) -> None:
    """The change from each of some sweeps, (field, 1, sweep), to each."""
    robot = read_body(bodies, 0, 0)
    for i in range(changes.shape[0]):
        for j in range(changes.shape[1]):
            changes[i, j] = change_of(robot, read_sweep(rows, 0, j), read_sweep(rows, 0, i))


def test_the_change_by_a_sweep_is_the_largest_speed_of_any_sign():
    rng = np.random.default_rng(0)
    count, changes = 40, np.zeros((40, 40))
    rows = rng.normal(size=(len(Sweep._fields), 1, count))
    only = rng.integers(Sweep._fields.index("v_e"), Sweep._fields.index("lam_l"), count)
    rows[only, 0, np.arange(count)] *= 100.0  # so that each velocity is the largest at times
    all_changes(np.array(body(UNLIKE)).reshape(-1, 1, 1), rows, changes)
    speeds = speeds_of(UNLIKE, Sweep(*rows[:, 0]))
    assert changes == pytest.approx(np.abs(speeds[:, :, None] - speeds[:, None]).max(axis=0))


@pytest.mark.parametrize("seed", SEEDS)
def test_momentum_changes_by_the_impulses(seed):
    check_momentum(random_drive(seed))


@pytest.mark.parametrize("seed", SEEDS)
def test_tyres_stick_within_their_circle_or_oppose_their_slip(seed):
    check_tyres(random_drive(seed))


@pytest.mark.parametrize("seed", SEEDS)
def test_joints_stick_within_eq_5_or_oppose_their_turning(seed):
    check_joints(random_drive(seed))


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
    return Drive(np.zeros((round(seconds / DT_S), 2)), np.zeros(3), FLOOR, made, robot)


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
    torques, push, floor, whole, _ = random_drive(seed)
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
    torques, push, floor, whole, _ = random_drive(0)
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
