"""A robot pulls a trailer on a rope: bodies and constraints of your own in ``env.space``.

The trailer is a pymunk body. Two constraints are its friction with the floor: a pivot and a gear to the
static body that may transmit a largest force only, and hold no place (``max_bias`` = 0). The rope is a
``SlideJoint``, which is slack up to its length. It becomes taut with a jerk; from then on it pulls, and at
a steady speed its force is the trailer's friction µ·m·g.

    python examples/trailer_on_a_rope.py
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import pymunk
import typer

import tlf_env
from tlf_env.envs.parallel import FormationParallelEnv

SPEED_MM_S = 200.0
DRIVE_S = 6.0
MASS_KG, WIDTH_MM, LENGTH_MM = 1.0, 150.0, 200.0
FRICTION = 0.02
ROPE_MM = 250.0
EYE_MM = (0.0, LENGTH_MM / 2)  # where the rope is tied to the trailer
HOOK_MM = (0.0, -60.0)  # where it is tied to the robot, from its centre of mass


class Trailer(NamedTuple):
    """The trailer and its rope."""

    body: pymunk.Body
    rope: pymunk.SlideJoint


def hitch(env: FormationParallelEnv, y_mm: float) -> Trailer:
    """Put the trailer on the floor and tie it to the leader."""
    space, leader = env.space, env.robot_bodies["robot_0"]
    grip = FRICTION * MASS_KG * env.scenario.robot.gravity_mm_s2  # mN
    trailer = pymunk.Body(MASS_KG, pymunk.moment_for_box(MASS_KG, (WIDTH_MM, LENGTH_MM)))
    trailer.position = 0.0, y_mm
    slide = pymunk.PivotJoint(space.static_body, trailer, trailer.position, (0.0, 0.0))
    turn = pymunk.GearJoint(space.static_body, trailer, 0.0, 1.0)
    slide.max_bias = turn.max_bias = 0.0
    slide.max_force, turn.max_force = (
        grip,
        grip * LENGTH_MM / 3,
    )  # force, and about force times lever
    rope = pymunk.SlideJoint(leader, trailer, HOOK_MM, EYE_MM, 0.0, ROPE_MM)
    space.add(trailer, pymunk.Poly.create_box(trailer, (WIDTH_MM, LENGTH_MM)), slide, turn, rope)
    return Trailer(trailer, rope)


def main() -> None:
    """Drive straight on and print how the trailer follows."""
    env = tlf_env.parallel_env(robots=1, disturbance="none", end_on=())
    env.reset(seed=0, options={"poses": [[0.0, 0.0, 0.0]]})  # at the origin, towards +y
    trailer = hitch(env, y_mm=-350.0)
    dt = env.scenario.control_period_s
    ahead = {"robot_0": np.array([SPEED_MM_S / 1000.0, 0.0])}  # 1 is 1000 mm/s
    taut_s = None
    for k in range(round(DRIVE_S / dt)):
        *_, infos = env.step(ahead)
        # A constraint has the impulse of the last substep.
        force_N = trailer.rope.impulse / env.scenario.physics_period_s / 1000.0
        if taut_s is None and force_N > 0.0:
            taut_s = (k + 1) * dt
            print(f"the rope is taut after {taut_s:.2f} s")
    by_hand_N = FRICTION * MASS_KG * env.scenario.robot.gravity_mm_s2 / 1000.0
    body = trailer.body
    print(f"after {DRIVE_S:g} s the robot is at y = {infos['robot_0']['y_mm']:.0f} mm")
    print(f"and the trailer at {body.position.y:.0f} mm with {body.velocity.length:.0f} mm/s")
    print(f"the rope pulls with {force_N:.3f} N; by hand, µ·m·g = {by_hand_N:.3f} N")


if __name__ == "__main__":
    typer.run(main)
