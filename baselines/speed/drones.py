"""gym-pybullet-drones as a peer: quadcopters as rigid bodies in Bullet, with a velocity controller on board."""

from __future__ import annotations

import numpy as np
from gym_pybullet_drones.envs.MultiHoverAviary import MultiHoverAviary
from gym_pybullet_drones.utils.enums import ActionType, Physics

from baselines.speed.served import Drive, timed

CONTROL_HZ, PHYSICS_HZ = 48, 240  # its own defaults for control; ours is 50 Hz
COMMAND = (1.0, 0.0, 0.0, 0.3)  # direction of the velocity, and its size, from 0 to 1


def drones_drive(robots: int, formations: int, threads: int, at_once: int) -> Drive:
    """``drive(steps)`` of one formation that is commanded velocities.

    Raises
    ------
    ValueError
        for more than one formation: an environment is one world.
    """
    if formations != 1:
        raise ValueError(f"formations {formations} must be 1")
    env = MultiHoverAviary(
        num_drones=robots,
        physics=Physics.PYB,
        pyb_freq=PHYSICS_HZ,
        ctrl_freq=CONTROL_HZ,
        act=ActionType.VEL,
    )
    action = np.tile(np.array(COMMAND, dtype=np.float32), (robots, 1))

    def drive(steps: int) -> float:
        env.reset(seed=0)
        return timed(lambda: env.step(action), steps)

    return drive
