from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import tlf_env
from tlf_env.engine import drivers
from tlf_env.engine.excerpt import empty_excerpt
from tlf_env.engine.formation import reference_table
from tlf_env.engine.layout import (
    Arrays,
    make_arrays,
    make_variants,
    read_effects,
    read_sensors,
    read_trace,
    write_sample,
    write_sensors,
    write_trace,
)
from tlf_env.engine.settings import Settings, settings
from tlf_env.engine.substeps import (
    Draw,
    Order,
    asked_torques,
    disturbed_encoders,
    evaluate,
    floor_under,
    sense_robot,
    trace_drive,
    undisturbed,
)
from tlf_env.engine.tiles import WIDTH, advance
from tlf_env.numerics.compiled import driver
from tlf_env.onboard.estimator import read_ekf, read_estimate, write_estimate
from tlf_env.onboard.slip_estimator import read_slip_ekf, read_slip_estimate, write_slip_estimate
from tlf_env.onboard.wheel_loop import read_loop_state, read_wheel_loop, write_loop_state
from tlf_env.physics.kernel import substep
from tlf_env.physics.state import (
    Push,
    advance_pose,
    read_body,
    read_contact,
    read_motion,
    write_contact,
    write_motion,
)
from tlf_env.task.actions import TWIST

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
    a, s = make_arrays([scenario], table, lanes), settings(scenario)
    a.seeds[:] = seed + np.arange(lanes)
    everyone = np.ones(lanes, dtype=np.bool_)
    drivers.start(a, make_variants([scenario]), everyone, np.zeros((0, 3)), s)
    drivers.look(a, everyone, True, s)
    for lane in range(lanes):
        rng = np.random.default_rng(1000 * seed + lane)
        robots = a.motions.shape[1]
        scale = rng.choice([0.0, 1e-3, 0.3, 1.0], (1, robots))
        speeds = np.array([300, 300, 2, 5, 10, 10, 20])[:, None] * rng.normal(size=(7, robots))
        a.motions[4:11, :, lane] = scale * speeds
        stuck = rng.random(robots) < 0.5
        a.motions[7, stuck, lane] = a.motions[6, stuck, lane]
        a.motions[2:4, :, lane] += rng.uniform(-4, 4, (2, robots))
        a.actions[lane] = rng.uniform(-1.2, 1.2, (robots, 2))
    return a, s


def step_all(a: Arrays, s: Settings, *bounds: int) -> Arrays:
    """Three control steps, the lanes cut at ``bounds`` into calls of their own."""
    actions = a.actions.copy()
    for _ in range(3):
        a.actions[:] = actions
        for first, last in zip((0, *bounds), (*bounds, len(a.seeds)), strict=True):
            left, nothing = drivers.lanes_to_step(first, last), empty_excerpt(a, 0, 0)
            assert drivers.control_step(a, left, nothing, s) == drivers.DONE
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
    for name in ("motions", "contacts", "estimates", "traces", "sensors", "loop_states"):
        got, wanted = (getattr(arrays, name)[:, :, :lanes] for arrays in (few, many))
        assert got.tobytes() == wanted.tobytes()


def test_rolling_and_sliding_robots_and_a_stuck_steering_occur():
    a, _ = thrown_about(64)
    stuck = a.motions[6] == a.motions[7]
    after = step_all(*thrown_about(64))
    slides = after.contacts[10:13].any(axis=0)
    assert 0.1 < stuck.mean() < 0.9
    assert 0.05 < slides.mean() < 0.95


@driver
def one_by_one(a: Arrays, s: Settings) -> None:
    """What :func:`advance` does for wheels under twist, no dead time and no patches, without a tile."""
    push = Push(0.0, 0.0, 0.0)
    for lane in range(a.motions.shape[2]):
        for r in range(a.motions.shape[1]):
            body, loop, ekf, slip_ekf = (
                read_body(a.bodies, r, lane),
                read_wheel_loop(a.wheel_loops, r, lane),
                read_ekf(a.ekfs, r, lane),
                read_slip_ekf(a.slip_ekfs, r, lane),
            )
            wanted_l, wanted_r = a.commands[0, r, lane], a.commands[1, r, lane]
            order = Order(float(TWIST), wanted_l, wanted_r, 0.0, 0.0, 0.0, 0.0)
            for k in range(s.substeps):
                tick = a.clock[lane, 0] + k
                if s.changing:
                    evaluate(a, lane, r, 0, 10, tick, s)
                effects = read_effects(a.applied, r, lane)
                sensors = read_sensors(a.sensors, r, lane)
                asked_l, asked_r, held = asked_torques(
                    body, loop, order, read_loop_state(a.loop_states, r, lane), sensors, k
                )
                drive = undisturbed(asked_l, asked_r, effects)
                motion, contact = substep(
                    body,
                    read_motion(a.motions, r, lane),
                    read_contact(a.contacts, r, lane),
                    floor_under(body, effects, drive),
                    push,
                    drive.given_l,
                    drive.given_r,
                    s.dt,
                )
                trace = trace_drive(
                    read_trace(a.traces, r, lane), body.torque_limit, drive, motion, contact, s.dt
                )
                motion = advance_pose(motion, s.dt)
                draw = Draw(a.seeds[lane], r, a.clock[lane, 2], tick + 1)
                sensors, estimate, slip, trace, sample = sense_robot(
                    body,
                    ekf,
                    slip_ekf,
                    effects,
                    motion,
                    disturbed_encoders(motion, effects, draw),
                    sensors,
                    read_estimate(a.estimates, r, lane),
                    read_slip_estimate(a.slip_estimates, r, lane),
                    trace,
                    draw,
                    order,
                    k,
                    s.estimator,
                    s.dt,
                )
                write_motion(a.motions, r, lane, motion)
                write_contact(a.contacts, r, lane, contact)
                write_loop_state(a.loop_states, r, lane, held)
                write_sensors(a.sensors, r, lane, sensors)
                write_estimate(a.estimates, r, lane, estimate)
                write_slip_estimate(a.slip_estimates, r, lane, slip)
                write_trace(a.traces, r, lane, trace)
                write_sample(a.samples[k], r, lane, sample)
        a.clock[lane, 0] += s.substeps


@driver
def in_tiles(a: Arrays, lanes: np.ndarray, s: Settings) -> None:
    advance(a, lanes, 0, s.substeps, True, True, s)


@pytest.mark.parametrize("estimator", ["ekf", "ekf-slip"])
@pytest.mark.parametrize("disturbance", ["none", "combined-hard", CHANGING], ids=str)
def test_a_tile_gives_the_bits_of_the_laws_run_one_by_one(disturbance, estimator):
    lanes = WIDTH + 3
    rng = np.random.default_rng(5)
    commands = rng.uniform(-10, 10, (2, 3, lanes))
    (a, s), (b, _) = (
        thrown_about(lanes, disturbance=disturbance, estimator=estimator) for _ in range(2)
    )
    a.commands[:] = b.commands[:] = commands
    for _ in range(5):
        one_by_one(a, s)
        in_tiles(b, np.arange(lanes), s)
    assert_same(a, b)
