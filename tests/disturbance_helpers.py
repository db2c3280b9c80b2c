"""Runs under chosen channels of a disturbance, for the tests of disturbances."""

import functools
from pathlib import Path

import numpy as np

from baselines import ReferencePolicy
from tlf_env.disturbances.channels import (
    CHANNELS,
    EPISODE,
    number,
)
from tlf_env.engine.formation import Formation
from tlf_env.engine.layout import Sample
from tlf_env.envs.parallel import parallel_env
from tlf_env.physics.parameters import RobotParameters
from tlf_env.task.info import Info
from tlf_env.task.scenario import load_scenario

ROBOT = RobotParameters()


FREE = {"joint_friction": False}  # wheels that turn without friction: the physics is closed form


DOCS = Path(__file__).parent.parent / "docs" / "disturbances.md"


GAP_S = 1.0  # short, so that followers hear something new within the first seconds


FIX = [Sample._fields.index("fix_x"), Sample._fields.index("fix_y")]


STEPS = [Sample._fields.index("step_l"), Sample._fields.index("step_r")]


GYRO = Sample._fields.index("gyro")


ANGLES = [11, 12]  # of Motion


# One value for every channel that shows, and a random signal that stays within the range.
SHOWS = {
    "slip.delta_1_mm_s": 20.0,
    "slip.delta_2_rad_s": 0.1,
    "tyre.friction_scale": 0.5,
    "position.bias_x_mm": 5.0,
    "position.bias_y_mm": 5.0,
    "position.noise_std_mm": 2.0,
    "encoder.noise_std_rad": 1e-4,
    "encoder.quantum_rad": 1e-3,
    "actuator.torque_gain_l": 0.9,
    "actuator.torque_gain_r": 0.9,
    "actuator.dead_time_s": 0.003,
    "actuator.computing_delay_s": 0.01,
    "radio.jitter_s": 0.2,
    "radio.dropout": 0.3,
    "payload.mass_kg": 0.5,
    "payload.behind_mm": 50.0,
    "payload.inertia_kg_mm2": 2000.0,
    "start.position_std_mm": 30.0,
    "start.heading_std_rad": 0.1,
    "slip.left_mm_s": 20.0,
    "slip.right_mm_s": 20.0,
    "tyre.friction_left": 0.5,
    "tyre.friction_right": 0.5,
    "tyre.creep": 0.1,
    "floor.rolling_resistance": 0.002,
    "floor.slope_rad": 0.02,
    "floor.uphill_rad": 1.0,
    "push.x_N": 0.1,
    "push.y_N": 0.1,
    "push.torque_Nmm": 20.0,
    "actuator.back_emf_s_rad": 0.05,
    "actuator.dead_band_Nmm": 1.0,
    "actuator.current_limit": 0.8,
    "actuator.stall_torque": 0.8,
    "position.period_s": 0.01,
    "position.delay_s": 0.02,
    "position.outage": 0.3,
    "position.outlier_share": 0.1,
    "position.outlier_std_mm": 5.0,
    "gyro.bias_rad_s": 0.01,
    "gyro.scale": 1.1,
    "gyro.noise_rad_s_sqrt_hz": 1e-4,
    "calibration.radius_left": 1.01,
    "calibration.radius_right": 1.01,
    "calibration.track": 1.01,
}


# Channels that act only beside another.
NEEDS = {
    "payload.behind_mm": {"payload.mass_kg": 0.5},
    "payload.inertia_kg_mm2": {"payload.mass_kg": 0.5},
    "floor.uphill_rad": {"floor.slope_rad": 0.02},
    "position.outlier_share": {"position.outlier_std_mm": 5.0},
    "position.outlier_std_mm": {"position.outlier_share": 0.1},
}


def random_signal(path):
    low, high = sorted((CHANNELS[number(path)].nominal, SHOWS[path]))
    signal = {"type": "uniform", "low": low, "high": high}
    return signal if CHANNELS[number(path)].rate == EPISODE else {**signal, "every_s": 0.1}


def tree(channels):
    """``{"slip.delta_1_mm_s": 1}`` as the nested mapping of YAML."""
    out = {}
    for path, value in channels.items():
        group, name = path.split(".")
        out.setdefault(group, {})[name] = value
    return out


def make(disturbance=None, *, seed=0, parts=None, **overrides):
    given = {"time_gap_s": GAP_S, "horizon_s": 20.0, "end_on": ()}
    overrides = given | {"observation": "sensor"} | overrides  # so that all samples are kept
    scenario = load_scenario("infinity", disturbance=disturbance or {}, **overrides)
    formation = Formation(scenario, parts)
    formation.reset(seed)
    return formation


class Run:
    """A closed loop under the reference policy, or ``actions`` for all robots, with all that it said."""

    def __init__(self, formation, seconds=3.0, actions=None):
        a, scenario = formation.arrays, formation.scenario
        policy, rows = ReferencePolicy(preview_s=scenario.preview_s), []
        self.starts = a.rows("start")[:, :, 0].T.copy()
        for k in range(round(seconds / scenario.control_period_s)):
            seen = a.observations[0].copy()
            a.actions[0] = policy.predict(seen)[0] if actions is None else actions(k)
            formation.step()
            c = formation.state()[:, :2]
            rows.append(
                {
                    "motion": a.rows("motion")[:, :, 0].T.copy(),
                    "applied": formation.applied().copy(),
                    "fix": a.samples[-1, FIX, :, 0].T - c,
                    "turned": a.samples[..., 0].sum(axis=0)[STEPS].T,
                    "gyro": a.samples[:, GYRO, :, 0].copy(),
                    "dropped": a.dropped[formation.step_count % len(a.dropped), :, 0].copy(),
                    "message": a.messages[:, formation.step_count % len(a.dropped), :, 0].T.copy(),
                    "info": a.infos[0].copy(),
                    "seen": a.sensor_observations[0].copy(),
                    "forward": formation.state()[:, 5],
                }
            )
        self.formation = formation
        for name in rows[0]:
            setattr(self, name, np.array([row[name] for row in rows]))

    def of_info(self, name):
        return self.info[:, :, Info._fields.index(name)]


def run(channels=None, seconds=3.0, level=1.0, actions=None, **overrides):
    disturbance = {"level": level, **tree(channels or {})}
    return Run(make(disturbance, **overrides), seconds, actions)


@functools.cache
def nominal(seconds=3.0):
    return run(seconds=seconds)


SLIPPING = {"slip.delta_1_mm_s": 12.0, "slip.delta_2_rad_s": 0.1}


def constant(*action):
    return lambda k: np.array(action)


ONE_LINE = r"\A[^\n]+\Z"


def environment(adversary=None, disturbance="nominal", **overrides):
    env = parallel_env(
        "infinity", adversary=adversary, disturbance=disturbance, end_on=(), **overrides
    )
    env.reset(seed=0)
    return env


def rest(env):
    return {agent: np.zeros(2, dtype=np.float32) for agent in env.agents}
