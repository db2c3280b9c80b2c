"""A user-defined pose estimator: odometry, corrected towards the position fixes by constant gains.

It shows the estimator protocol (``factory(robot, period_s)``, ``reset``, ``update``) and compares the
filter with the paper's EKF on the same random draws. The filter runs on every robot, every millisecond.

    python examples/custom_estimator.py --horizon-s 100
    tlf run infinity --estimator examples.custom_estimator:ComplementaryFilter --trust
"""

from __future__ import annotations

import math

import numpy as np
import typer

from baselines import ReferencePolicy
from baselines.runs.run import run_policy
from tlf_env import Readings, load_scenario
from tlf_env.physics.vehicle import RobotParameters

POSITION_GAIN_PER_S = 8.0
HEADING_GAIN_RAD_S_MM = 0.02  # correction of the heading per lateral deviation of a fix


class ComplementaryFilter:
    """Pose of c, the axle's midpoint, from the encoders, slowly corrected by the position fixes."""

    def __init__(self, robot: RobotParameters, period_s: float) -> None:
        self._radius = robot.wheel_radius_mm
        self._width = robot.axle_width_mm
        self._follow = POSITION_GAIN_PER_S * period_s
        self._turn = HEADING_GAIN_RAD_S_MM * period_s
        self._pose = np.zeros(3)

    def reset(self, pose: np.ndarray) -> None:
        """Start at the true pose."""
        self._pose = pose.copy()

    def update(self, readings: Readings) -> np.ndarray:
        """Integrate the wheels' increments, then correct by the fix, if one has arrived.

        Heading 0 points along +y, unlike ROS REP-103 (+x).
        """
        left, right = self._radius * readings.steps_rad
        forward, turn = 0.5 * (left + right), (right - left) / self._width
        x, y, theta = self._pose
        x -= forward * math.sin(theta + 0.5 * turn)
        y += forward * math.cos(theta + 0.5 * turn)
        theta += turn
        self._pose = np.array([x, y, theta])
        if readings.fix_mm is None:
            return self._pose
        # If a fix is to the right of the estimate while driving forward, the heading is too far left.
        off_x, off_y = readings.fix_mm[0] - x, readings.fix_mm[1] - y
        to_the_right = off_x * math.cos(theta) + off_y * math.sin(theta)
        theta -= self._turn * to_the_right * np.sign(forward)
        self._pose = np.array([x + self._follow * off_x, y + self._follow * off_y, theta])
        return self._pose


def main(horizon_s: float = 100.0, seed: int = 0) -> None:
    """Run the ∞ with the EKF and with the filter above."""
    for estimator in ("ekf", f"{__name__}:ComplementaryFilter"):
        scenario = load_scenario(
            "infinity", estimator=estimator, broadcast_smoothing_s=0.0, horizon_s=horizon_s
        )
        record = run_policy(scenario, ReferencePolicy("consistent"), seed, trust=True)
        errors = [f"{robot.position_rmse_mm:.2f}" for robot in record.metrics()]
        print(f"{estimator}: position error {', '.join(errors)} mm RMS")


if __name__ == "__main__":
    typer.run(main)
