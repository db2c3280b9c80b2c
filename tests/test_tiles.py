from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import tlf_env
from tlf_env import BatchPlant
from tlf_env.disturbances.channels import SUBSTEP, Effects, numbers
from tlf_env.engine import drivers
from tlf_env.engine.arrays import Arrays, make_arrays, make_variants
from tlf_env.engine.effects import evaluate
from tlf_env.engine.excerpt import empty_excerpt
from tlf_env.engine.formation import reference_table
from tlf_env.engine.layout import (
    Draw,
    Order,
    Sample,
    Trace,
    WheelPair,
    YawRate,
    array_reader,
    array_writer,
)
from tlf_env.engine.sensors import (
    account_robot,
    correct_robot,
    disturbed_encoders,
    measured_fix,
    odometry_of,
    predict_robot,
    sense_with_gyro,
)
from tlf_env.engine.settings import Settings, make_settings
from tlf_env.engine.substeps import commanded_torques, floor_under, trace_drive, undisturbed
from tlf_env.engine.tiles import WIDTH, advance
from tlf_env.numerics.compiled import driver
from tlf_env.numerics.rows import reader, writer
from tlf_env.onboard.kinds import EKF_GYRO
from tlf_env.physics.kernel import substep
from tlf_env.physics.state import Push, advance_pose
from tlf_env.task.actions import TWIST
from tlf_env.task.scenario import load_scenario

EVERYTHING: dict[str, Any] = {
    "slip": {"delta_1_mm_s": {"type": "ornstein_uhlenbeck", "std": 10, "time_constant_s": 2}},
    "tyre": {"patches": [{"x_mm": 0, "y_mm": 0, "radius_mm": 400, "friction_scale": 0.3}]},
    "encoder": {"noise_std_rad": 1e-3, "quantum_rad": 1e-3},
    "actuator": {"dead_time_s": 0.004, "computing_delay_s": 0.007},
}
CHANGING: dict[str, Any] = {
    "slip": {"delta_2_rad_s": {"type": "sine", "amplitude": 0.4, "frequency_hz": 3}},
    "encoder": {"noise_std_rad": {"type": "uniform", "low": 0, "high": 1e-3}},
}
SCENARIOS: list[dict[str, Any]] = [
    {"disturbance": "nominal"},
    {"disturbance": "none", "estimator": "truth"},
    {"disturbance": "combined-hard"},
    {"disturbance": "combined-hard", "estimator": "ekf-slip"},
    {"disturbance": "nominal", "action": "torque"},
    {"disturbance": EVERYTHING},
    {"disturbance": CHANGING},
    {"plant": "kinematic"},
]


def thrown_about(lanes: int, seed: int = 0, **overrides: Any) -> tuple[Arrays, Settings]:
    """Formations with velocities and actions at random: rolling, sliding, at rest, steering stuck."""
    scenario = tlf_env.parallel_env("infinity", **({"plant": "batch"} | overrides)).scenario
    table = reference_table(scenario)
    a, s = make_arrays([scenario], table, lanes), make_settings(scenario)
    a.seeds[:] = seed + np.arange(lanes)
    everyone = np.ones(lanes, dtype=np.bool_)
    drivers.start(a, make_variants([scenario]), everyone, np.zeros((0, 0, 3)), s)
    at, nothing = np.arange(lanes), empty_excerpt(a, 0, 0)
    drivers.control_step(a, at, nothing, drivers.LOOK_AT_START, 0, s)
    for lane in range(lanes):
        rng = np.random.default_rng(1000 * seed + lane)
        robots = a.rows("motion").shape[1]
        scale = rng.choice([0.0, 1e-3, 0.3, 1.0], (1, robots))
        speeds = np.array([300, 300, 2, 5, 10, 10, 20])[:, None] * rng.normal(size=(7, robots))
        a.rows("motion")[4:11, :, lane] = scale * speeds
        stuck = rng.random(robots) < 0.5
        a.rows("motion")[7, stuck, lane] = a.rows("motion")[6, stuck, lane]
        a.rows("motion")[2:4, :, lane] += rng.uniform(-4, 4, (2, robots))
        a.actions[lane] = rng.uniform(-1.2, 1.2, (robots, 2))
    return a, s


def step_all(a: Arrays, s: Settings, *bounds: int) -> Arrays:
    """Three control steps, the lanes cut at ``bounds`` into calls of their own."""
    actions = a.actions.copy()
    for _ in range(3):
        a.actions[:] = actions
        for first, last in zip((0, *bounds), (*bounds, len(a.seeds)), strict=True):
            left, nothing = drivers.lanes_to_step(first, last), empty_excerpt(a, 0, 0)
            assert drivers.control_step(a, left, nothing, drivers.WHOLE, 0, s) == drivers.DONE
    return a


def assert_same(a: Arrays, b: Arrays) -> None:
    for name, x, y in zip(Arrays._fields, a, b, strict=True):
        assert x.tobytes() == y.tobytes(), name


@pytest.mark.parametrize("overrides", SCENARIOS, ids=str)
def test_lanes_give_the_same_bits_alone_and_together(overrides):
    lanes = 2 * WIDTH + 5
    together = step_all(*thrown_about(lanes, **overrides))
    alone = step_all(*thrown_about(lanes, **overrides), *range(1, lanes))
    assert_same(together, alone)


@pytest.mark.parametrize("lanes", [1, 2, 3, 5, 7, 64])
def test_what_else_is_in_the_arrays_does_not_matter(lanes):
    few, many = step_all(*thrown_about(lanes)), step_all(*thrown_about(64))
    for name in ("motion", "contact", "estimate", "trace", "sensors", "loop_state"):
        got, wanted = (arrays.rows(name)[:, :, :lanes] for arrays in (few, many))
        assert got.tobytes() == wanted.tobytes()


def test_rolling_and_sliding_robots_and_a_stuck_steering_occur():
    a, _ = thrown_about(64)
    stuck = a.rows("motion")[6] == a.rows("motion")[7]
    after = step_all(*thrown_about(64))
    slides = after.rows("contact")[10:13].any(axis=0)
    assert 0.1 < stuck.mean() < 0.9
    assert 0.05 < slides.mean() < 0.95


OF_SUBSTEPS = tuple(numbers(SUBSTEP).tolist())
read_effects, write_sample = reader(Effects), writer(Sample)
read_body, read_wheel_loop = array_reader("body"), array_reader("wheel_loop")
read_ekf, read_slip_ekf = array_reader("ekf"), array_reader("slip_ekf")
read_motion, write_motion = array_reader("motion"), array_writer("motion")
read_contact, write_contact = array_reader("contact"), array_writer("contact")
read_loop_state, write_loop_state = array_reader("loop_state"), array_writer("loop_state")
read_sensors, write_sensors = array_reader("sensors"), array_writer("sensors")
read_estimate, write_estimate = array_reader("estimate"), array_writer("estimate")
read_slip, write_slip = array_reader("slip"), array_writer("slip")
read_gyro, write_gyro = array_reader("gyro"), array_writer("gyro")
read_gyro_ekf = array_reader("gyro_ekf")
read_trace, write_trace = array_reader("trace"), array_writer("trace")
read_command = array_reader("command")
read_belief = array_reader("belief")
write_commanded = array_writer("commanded")


@driver
def one_by_one(a: Arrays, s: Settings) -> None:
    """What :func:`advance` does for wheels under twist, no dead time and no patches, without a tile."""
    push = Push(0.0, 0.0, 0.0)
    values = np.empty((len(OF_SUBSTEPS), 1, 1))
    for lane in range(a.states.shape[2]):
        for r in range(a.states.shape[1]):
            body, loop, ekf, slip_ekf = (
                read_body(a.constants, r, lane),
                read_wheel_loop(a.constants, r, lane),
                read_ekf(a.constants, r, lane),
                read_slip_ekf(a.constants, r, lane),
            )
            wanted_l, wanted_r = read_command(a.states, r, lane)
            order = Order(float(TWIST), wanted_l, wanted_r, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0)
            for k in range(s.substeps):
                tick = a.clock[lane, 0] + k
                if s.changing:
                    for channel in OF_SUBSTEPS:
                        evaluate(a, lane, r, channel, tick, s)
                for f in range(len(OF_SUBSTEPS)):
                    values[f, 0, 0] = a.applied[OF_SUBSTEPS[f], r, lane]
                effects = read_effects(values, 0, 0)
                sensors = read_sensors(a.states, r, lane)
                commanded_l, commanded_r, held = commanded_torques(
                    body, loop, order, read_loop_state(a.states, r, lane), sensors, k
                )
                drive = undisturbed(commanded_l, commanded_r, effects)
                motion, contact = substep(
                    body,
                    read_motion(a.states, r, lane),
                    read_contact(a.states, r, lane),
                    floor_under(body, effects, drive),
                    push,
                    drive.delivered_l,
                    drive.delivered_r,
                    s.dt,
                )
                trace = trace_drive(
                    read_trace(a.states, r, lane), body.torque_limit, drive, motion, contact, s.dt
                )
                motion = advance_pose(motion, s.dt)
                draw = Draw(a.seeds[lane], r, a.clock[lane, 2], tick + 1)
                if s.estimator == EKF_GYRO:
                    sensors, estimate, slip, found, trace, sample = sense_with_gyro(
                        body,
                        read_belief(a.constants, r, lane),
                        read_gyro_ekf(a.constants, r, lane),
                        disturbed_encoders(motion, effects, draw),
                        measured_fix(body, motion, effects, draw),
                        YawRate(motion.w),
                        WheelPair(commanded_l, commanded_r),
                        sensors,
                        read_estimate(a.states, r, lane),
                        read_slip(a.states, r, lane),
                        read_gyro(a.states, r, lane),
                        trace,
                        s.dt,
                    )
                    write_gyro(a.states, r, lane, found)
                else:
                    belief = read_belief(a.constants, r, lane)
                    reading = disturbed_encoders(motion, effects, draw)
                    increments = odometry_of(body, belief, reading, sensors)
                    sensors, estimate, slip = predict_robot(
                        body,
                        belief,
                        ekf,
                        slip_ekf,
                        motion,
                        increments,
                        sensors,
                        read_estimate(a.states, r, lane),
                        read_slip(a.states, r, lane),
                        order,
                        k,
                        s.estimator,
                        s.dt,
                    )
                    fix = measured_fix(body, motion, effects, draw)
                    estimate, slip, innovation = correct_robot(
                        ekf, slip_ekf, fix, sensors, estimate, slip, s.estimator
                    )
                    sensors, trace, sample = account_robot(
                        reading,
                        fix,
                        YawRate(motion.w),
                        WheelPair(commanded_l, commanded_r),
                        increments,
                        sensors,
                        estimate,
                        slip,
                        trace,
                        innovation,
                        s.dt,
                    )
                write_motion(a.states, r, lane, motion)
                write_contact(a.states, r, lane, contact)
                write_loop_state(a.states, r, lane, held)
                write_commanded(a.states, r, lane, WheelPair(commanded_l, commanded_r))
                write_sensors(a.states, r, lane, sensors)
                write_estimate(a.states, r, lane, estimate)
                write_slip(a.states, r, lane, slip)
                write_trace(a.states, r, lane, trace)
                write_sample(a.samples[k], r, lane, sample)
        a.clock[lane, 0] += s.substeps


@driver
def in_tiles(a: Arrays, lanes: np.ndarray, s: Settings) -> None:
    advance(s.number, a, lanes, 0, s.substeps, True, True, s)


@pytest.mark.parametrize("estimator", ["ekf", "ekf-slip", "ekf-gyro"])
@pytest.mark.parametrize("disturbance", ["none", "combined-hard", CHANGING], ids=str)
def test_a_tile_gives_the_bits_of_the_laws_run_one_by_one(disturbance, estimator):
    lanes = WIDTH + 3
    rng = np.random.default_rng(5)
    commands = rng.uniform(-10, 10, (2, 3, lanes))
    (a, s), (b, _) = (
        thrown_about(lanes, disturbance=disturbance, estimator=estimator) for _ in range(2)
    )
    a.rows("command")[:] = b.rows("command")[:] = commands
    for _ in range(5):
        one_by_one(a, s)
        in_tiles(b, np.arange(lanes), s)
    a.samples[:-1] = 0.0  # only the last are kept
    assert_same(a, b)


@pytest.mark.parametrize("precision", ["double", "single"])
def test_robots_need_not_be_neighbours_in_the_arrays(precision):
    """Neighbours are copied to a tile and back as vectors, others one by one."""
    lanes = 4 * WIDTH
    (a, s), (b, _) = (thrown_about(lanes, disturbance="combined-hard") for _ in range(2))
    number = np.float64(0.0) if precision == "double" else np.float32(0.0)
    s = s._replace(number=number)
    for _ in range(5):
        in_tiles(a, np.arange(lanes), s)
        for first in range(3):
            in_tiles(b, np.arange(first, lanes, 3), s)
    assert_same(a, b)


@driver
def substep_by_substep(a: Arrays, lanes: np.ndarray, s: Settings) -> None:
    for k in range(s.substeps):
        advance(s.number, a, lanes, k, k + 1, True, True, s)


@pytest.mark.parametrize("estimator", ["ekf", "ekf-slip", "ekf-gyro", "truth"])
@pytest.mark.parametrize(
    "disturbance", ["fixes-100hz", "fixes-camera", "fixes-uwb", "fixes-outage"]
)
def test_fixes_come_alike_whether_substeps_are_taken_at_once_or_one_by_one(disturbance, estimator):
    lanes = WIDTH + 3
    (a, s), (b, _) = (
        thrown_about(lanes, disturbance=disturbance, estimator=estimator) for _ in range(2)
    )
    for _ in range(20):
        in_tiles(a, np.arange(lanes), s)
        substep_by_substep(b, np.arange(lanes), s)
    assert b.rows("trace")[Trace._fields.index("fixes")].all()
    b.samples[:-1] = 0.0  # only the last are kept
    assert_same(a, b)


def test_what_fixes_the_others_in_a_tile_get_does_not_matter():
    names = ["nominal", "fixes-camera", "fixes-100hz", "none", "fixes-uwb"]
    scenarios = [load_scenario("infinity", disturbance=name, plant="batch") for name in names]
    many = BatchPlant(scenarios, len(names))
    many.reset(seed=3)
    actions = np.random.default_rng(0).uniform(-1, 1, (25, *many.arrays.actions.shape))
    for action in actions:
        many.step(action)
    for k, scenario in enumerate(scenarios):
        alone = BatchPlant(scenario, 1)
        alone.reset(seed=3 + k)
        for action in actions:
            alone.step(action[k : k + 1])
        assert (alone.observations[0] == many.observations[k]).all()
        for name in ("motion", "estimate", "slip", "trace"):
            assert (alone.arrays.rows(name)[:, :, 0] == many.arrays.rows(name)[:, :, k]).all()


@pytest.mark.parametrize(
    "others",
    [
        {"actuator": {"current_limit": 0.5}},
        {"actuator": {"dead_band_Nmm": 1.0}},
        {"actuator": {"back_emf_s_rad": 0.01}},
        {"push": {"x_N": 0.3}, "floor": {"slope_rad": 0.05}},
        {"encoder": {"noise_std_rad": 1e-3}, "gyro": {"bias_rad_s": 0.1}},
        {"tyre": {"creep": 0.1}, "slip": {"left_mm_s": 10.0}},
    ],
    ids=str,
)
def test_what_disturbs_the_others_in_a_tile_does_not_matter(others):
    """A gain that delivers more than the commands' limit, beside robots whose motors are limited."""
    own = {"actuator": {"torque_gain_l": 1.5, "torque_gain_r": 1.2}}
    mine, theirs = (
        load_scenario("infinity", plant="batch", action="torque", end_on=(), disturbance=one)
        for one in (own, others)
    )
    alone, among = BatchPlant(mine, 4), BatchPlant([mine, theirs], 4)
    for plant in (alone, among):
        plant.reset(seed=3)
        for _ in range(10):
            plant.step(np.ones(plant.arrays.actions.shape))
    assert among.scenario_numbers.tolist() == [0, 1, 0, 1]
    for name in ("motion", "contact", "estimate"):
        got, wanted = among.arrays.rows(name)[:, :, ::2], alone.arrays.rows(name)[:, :, ::2]
        assert got.tobytes() == wanted.tobytes()
    assert alone.info("torque_l_Nmm") == pytest.approx(1.5 * 15.0)


@pytest.mark.parametrize(("observation", "kept"), [("tracking", False), ("sensor", True)])
def test_the_samples_of_all_substeps_are_kept_for_those_who_read_them(observation, kept):
    plant = BatchPlant("infinity", 2, observation=observation)
    plant.reset(seed=0)
    plant.step(np.full(plant.arrays.actions.shape, 0.5))
    assert plant.arrays.samples[-1].any()
    assert plant.arrays.samples[:-1].any() == kept
