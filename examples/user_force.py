"""A force that is calculated outside, as in a hardware-in-the-loop rig.

Before each step a program reads where the robot is and answers with a force, which is applied to the robot's
body and acts for the whole step. Here it is a spring balance to which the robot is tied. The robot drives
slowly away until its motors are at their limit. Then it coasts on, as far as its momentum takes it, and stays
there: the friction in its joints holds it.

By hand: the motors' largest force is F = 2·(τ_max − τ_joints)/R. At the speed v it coasts on by v·√(m/k).

    python examples/user_force.py
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import typer

import tlf_env
from tlf_env.task.feasibility import motor_acceleration

SPEED_MM_S = 50.0
DRIVE_S = 10.0
STIFFNESS_N_M = 2.0


class SpringBalance:
    """Stands for a rig, a load cell or another simulator: a place in, a force out."""

    def __init__(self, stiffness_N_m: float) -> None:
        self.stiffness_N_m = stiffness_N_m

    def force(self, stretch_mm: float) -> float:
        """Force (N) along +y on the robot, which is at ``stretch_mm`` from where the spring is slack."""
        return -self.stiffness_N_m * max(stretch_mm, 0.0) / 1000.0


class Pull(NamedTuple):
    """A moment of the experiment."""

    y_mm: float
    speed_mm_s: float
    force_N: float


def pull(rig: SpringBalance) -> tuple[Pull, Pull]:
    """Drive away from the rig: the moments at which the motors reach their limit, and the end."""
    env = tlf_env.parallel_env(robots=1, disturbance="none", end_on=())
    env.reset(seed=0, options={"poses": [[0.0, 0.0, 0.0]]})  # at the origin, towards +y
    dt, limit_Nmm = env.scenario.control_period_s, env.scenario.robot.torque_limit_Nmm
    ahead = {"robot_0": np.array([SPEED_MM_S / 1000.0, 0.0])}  # 1 is 1000 mm/s
    body = env.robot_bodies["robot_0"]
    slack_mm, y_mm = body.position.y, 0.0
    at_limit: Pull | None = None
    for k in range(round(DRIVE_S / dt)):
        body = env.robot_bodies["robot_0"]  # puts the body where the robot is
        force_N = rig.force(body.position.y - slack_mm)
        body.apply_force_at_world_point((0.0, 1000.0 * force_N), body.position)  # mN
        *_, infos = env.step(ahead)
        info = infos["robot_0"]
        now = Pull(info["y_mm"], (info["y_mm"] - y_mm) / dt, force_N)
        y_mm = info["y_mm"]
        started = k > 1.0 / dt  # not while it accelerates
        if at_limit is None and started and info["torque_l_Nmm"] >= limit_Nmm:
            at_limit = now
    assert at_limit is not None
    return at_limit, now


def main() -> None:
    """Pull at the spring balance and compare with the calculation."""
    rig = SpringBalance(STIFFNESS_N_M)
    at_limit, end = pull(rig)
    robot = tlf_env.load_scenario().robot
    mass_kg = robot.mass_kg + 2 * robot.wheel_inertia_kg_mm2 / robot.wheel_radius_mm**2
    by_hand_N = mass_kg * motor_acceleration(robot) / 1000.0
    coast_mm = at_limit.speed_mm_s * math.sqrt(mass_kg / rig.stiffness_N_m)
    print(f"motors at their limit with {-at_limit.force_N:.3f} N, by hand {by_hand_N:.3f} N")
    print(
        f"at {at_limit.speed_mm_s:.0f} mm/s; coasts on by {end.y_mm - at_limit.y_mm:.1f} mm, "
        f"by hand {coast_mm:.1f} mm"
    )
    print(f"stays at {end.y_mm:.1f} mm with a pull of {-end.force_N:.3f} N")


if __name__ == "__main__":
    typer.run(main)
