"""A person crosses the way: a policy that looks, and one that does not.

The person is a ``moving`` obstacle of the scenario's world: it walks back and forth, whatever it meets.
``Careful`` wraps any policy. It stops a robot while driving on would bring it too close to the person within
the next seconds, and otherwise leaves the action as it is.

    python examples/person_crossing.py
"""

from __future__ import annotations

from typing import Any

import numpy as np
import pymunk
import typer

import tlf_env
from baselines import ReferencePolicy
from tlf_env.envs.parallel import Agent, FormationParallelEnv

SPEED_MM_S = 250.0
LOOK_S = 3.0  # so far ahead the policy looks
CLEAR_MM = 300.0  # least distance of centres: the outlines' radii, 110 and 150 mm, and a margin
HORIZON_S = 18.0
STRAIGHT = [[0, 0, 0], [1, 0, 62], [2, 0, 250], [4, 0, 750], [20, 0, 4750]]  # t in s, x, y in mm


def scenario(start_s: float) -> dict[str, Any]:
    """Two robots on a straight line that a person crosses, ``start_s`` later on its way."""
    person = {
        "shape": {"type": "circle", "radius_mm": 150.0},
        "points_mm": [[-1000.0, 2000.0], [1000.0, 2000.0]],
        "speed_mm_s": 300.0,
        "start_s": start_s,
    }
    return {
        "trajectory": {"type": "waypoints", "points": STRAIGHT},
        "robots": 2,
        "horizon_s": HORIZON_S,
        "lost_beyond_mm": 3000.0,  # while it waits, its reference goes on
        "estimator": "ekf-slip",
        "broadcast_smoothing_s": 0.0,
        "world": {"moving": [person]},
    }


class Careful:
    """Stops a robot while a person is about to cross its way.

    It uses the true places of robots and persons, as a perfect sensor would give them.
    """

    def __init__(self, env: FormationParallelEnv, policy: ReferencePolicy) -> None:
        self.env, self.policy = env, policy

    def act(self, observations: dict[Agent, np.ndarray]) -> dict[Agent, np.ndarray]:
        """The policy's actions; 0 for a robot that has to wait."""
        robots, persons = self.env.robot_bodies, self.env.moving_bodies
        return {
            agent: np.zeros(2)
            if any(self.too_close(robots[agent], person) for person in persons)
            else self.policy.predict(observation)[0]
            for agent, observation in observations.items()
        }

    def too_close(self, robot: pymunk.Body, person: pymunk.Body) -> bool:
        """Whether they come too close if the robot drives and the person walks straight on."""
        ahead = pymunk.Vec2d(0.0, SPEED_MM_S).rotated(robot.angle)
        apart, closing = person.position - robot.position, person.velocity - ahead
        nearest_s = min(max(-apart.dot(closing) / closing.dot(closing), 0.0), LOOK_S)
        return (apart + closing * nearest_s).length < CLEAR_MM


def drive(start_s: float, looking: bool) -> tuple[float, tlf_env.TouchedBy, float]:
    """Run an episode: its length, what was touched first, and the leader's largest error in mm."""
    env = tlf_env.parallel_env(scenario(start_s))
    policy = ReferencePolicy("tuned")
    careful = Careful(env, policy)
    observations, infos = env.reset(seed=0)
    largest = 0.0
    while env.agents:
        if looking:
            actions = careful.act(observations)
        else:
            actions = {agent: policy.predict(seen)[0] for agent, seen in observations.items()}
        observations, *_, infos = env.step(actions)
        largest = max(largest, infos["robot_0"]["position_error_mm"])
    touched = max(info["touched_by"] for info in infos.values())
    return env.formation.time_s, tlf_env.TouchedBy(touched), largest


def main() -> None:
    """Meet the person at three different times, with and without looking."""
    for start_s in (0.0, 1.0, 2.0):
        for looking in (False, True):
            time_s, touched, error_mm = drive(start_s, looking)
            what = f"touched an {touched.name.lower()}" if touched else "touched nothing"
            print(
                f"person {start_s:g} s ahead, {'looking' if looking else 'blind':7s}: {what} in "
                f"{time_s:.1f} s; up to {error_mm:.0f} mm off the reference"
            )


if __name__ == "__main__":
    typer.run(main)
