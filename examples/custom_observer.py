"""A user-defined observer: a pure delay line instead of the paper's dynamic system.

A follower's reference is the message that its predecessor broadcast one time gap ago. During the first
seconds it is blended with a smooth path from the follower's own start to the predecessor's. The example
shows the observer protocol (``factory(robot, period_s)``, ``reset``, ``update``). A delay line passes on
the position noise of the predecessor; the paper's observer filters it.

    python examples/custom_observer.py --horizon-s 100
    tlf run infinity --observer examples.custom_observer:DelayLine --trust
"""

from __future__ import annotations

import math

import numpy as np
import typer

from baselines import ReferencePolicy
from baselines.runs.run import run_policy
from tlf_env import load_scenario
from tlf_env.onboard.observer import Message, Reference
from tlf_env.physics.vehicle import RobotParameters

BLEND_S = 5.0


class DelayLine:
    """The delayed message as reference, blended in over the first ``BLEND_S`` seconds."""

    def __init__(self, robot: RobotParameters, period_s: float) -> None:
        self._start = np.zeros(3)

    def reset(self, pose: np.ndarray) -> None:
        """Start at the follower's own pose."""
        self._start = pose.copy()

    def update(self, message: Message, t_s: float) -> Reference:
        """The reference for the time ``t_s``, from the message broadcast one gap earlier."""
        if t_s >= BLEND_S:
            return Reference(*message)
        part = t_s / BLEND_S
        share, rate = part**2 * (3 - 2 * part), 6 * part * (1 - part) / BLEND_S
        way = np.array(message[:3]) - self._start
        x, y, theta = self._start + share * way
        v_x = rate * way[0] - share * message.u_1 * math.sin(message.theta)
        v_y = rate * way[1] + share * message.u_1 * math.cos(message.theta)
        return Reference(x, y, theta, math.hypot(v_x, v_y), rate * way[2] + share * message.u_2)


def main(horizon_s: float = 100.0, seed: int = 0) -> None:
    """Run the ∞ with the paper's observer and with the delay line, on the paper's controller and filter."""
    for name, observer in (("paper", None), ("delay line", f"{__name__}:DelayLine")):
        scenario = load_scenario(
            "infinity",
            observer=observer,
            estimator="ekf",
            broadcast_smoothing_s=0.0,
            horizon_s=horizon_s,
        )
        robots = run_policy(scenario, ReferencePolicy("consistent"), seed, trust=True).metrics()
        errors = [f"{robot.position_rmse_mm:.2f}" for robot in robots]
        print(f"{name:10s}: position error {', '.join(errors)} mm RMS")


if __name__ == "__main__":
    typer.run(main)
