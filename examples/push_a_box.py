"""Two robots push a box together, and let it go.

A scenario's ``world`` contains the box: its mass, and its friction with the floor, here that of castors. The
robots start side by side behind it, drive straight on, and stop. The box leaves them and slides on.

Two things can be calculated by hand. While the box moves steadily, the motors give µ·m·g more than without
it. Let go at the speed v, it slides v²/(2·µ·g) before it rests.

    python examples/push_a_box.py
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import typer

import tlf_env

SPEED_MM_S = 200.0
PUSH_S, REST_S = 4.0, 1.5
STARTS = [[-120.0, 0.0, 0.0], [120.0, 0.0, 0.0]]  # x, y in mm and the heading: +y
BOX: dict[str, Any] = {
    "shape": {"type": "box", "width_mm": 500.0, "length_mm": 200.0},
    "x_mm": 0.0,
    "y_mm": 200.0,
    "mass_kg": 1.5,
    "floor_friction": 0.03,
}


class Pushed(NamedTuple):
    """What is measured: how far the box came, and the force of the motors."""

    pushed_mm: float
    let_go_mm_s: float
    slid_mm: float
    turned_rad: float
    motors_N: float  # of all wheels, at the end of the push


def drive(boxes: list[dict[str, Any]]) -> Pushed:
    """Drive straight on, stop, and wait until all is at rest; with a box or without."""
    env = tlf_env.parallel_env(robots=2, world={"pushables": boxes}, disturbance="none", end_on=())
    radius_mm, dt = env.scenario.robot.wheel_radius_mm, env.scenario.control_period_s
    env.reset(seed=0, options={"poses": STARTS})
    ahead = dict.fromkeys(env.agents, np.array([SPEED_MM_S / 1000.0, 0.0]))  # 1 is 1000 mm/s
    still = dict.fromkeys(env.agents, np.zeros(2))
    for _ in range(round(PUSH_S / dt)):
        *_, infos = env.step(ahead)
    torques = [info["torque_l_Nmm"] + info["torque_r_Nmm"] for info in infos.values()]
    motors_N = sum(torques) / radius_mm
    if not boxes:
        return Pushed(0.0, 0.0, 0.0, 0.0, motors_N)
    (box,) = env.pushable_bodies
    let_go, speed = box.position, box.velocity.length
    for _ in range(round(REST_S / dt)):
        env.step(still)
    return Pushed(
        let_go.y - boxes[0]["y_mm"], speed, box.position.y - let_go.y, box.angle, motors_N
    )


def main() -> None:
    """Push the box and compare with the calculation."""
    gravity = tlf_env.load_scenario().robot.gravity_mm_s2
    found, without = drive([BOX]), drive([])
    friction, mass = BOX["floor_friction"], BOX["mass_kg"]
    print(f"pushed {found.pushed_mm:.0f} mm far, turned by {found.turned_rad:.3f} rad")
    print(
        f"motors: {found.motors_N - without.motors_N:.3f} N more than without a box, "
        f"by hand {friction * mass * gravity / 1000.0:.3f} N"
    )
    print(
        f"let go at {found.let_go_mm_s:.0f} mm/s: slid {found.slid_mm:.1f} mm, "
        f"by hand {found.let_go_mm_s**2 / (2.0 * friction * gravity):.1f} mm"
    )


if __name__ == "__main__":
    typer.run(main)
