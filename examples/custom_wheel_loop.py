"""A user-defined wheel speed loop: PI with anti-windup by back-calculation.

It shows the wheel loop protocol (``factory(robot, period_s)``, ``reset``, ``torque``) and compares the
loop with the paper's AVC. The loop runs on every robot, every millisecond.

    python examples/custom_wheel_loop.py --horizon-s 100
    tlf run infinity --wheel-loop examples.custom_wheel_loop:PiLoop --trust
"""

from __future__ import annotations

import numpy as np
import typer

from baselines import ReferencePolicy
from baselines.runs.run import run_policy
from tlf_env import load_scenario
from tlf_env.physics.vehicle import RobotParameters

GAIN_NMM_S = 150.0  # N·mm per rad/s
INTEGRAL_TIME_S = 0.2
UNWIND_PER_S = 20.0


class PiLoop:
    """Torque = gain·(error + ∫error/T); the torque cut off by the limit reduces the integral."""

    def __init__(self, robot: RobotParameters, period_s: float) -> None:
        self._limit = robot.torque_limit_Nmm
        self._period_s = period_s
        self._integral = np.zeros(2)

    def reset(self) -> None:
        """Start from rest."""
        self._integral = np.zeros(2)

    def torque(self, wanted_rad_s: np.ndarray, measured_rad_s: np.ndarray) -> np.ndarray:
        """Torques (left, right) in N·mm."""
        error = wanted_rad_s - measured_rad_s
        asked = GAIN_NMM_S * error + self._integral
        given = np.clip(asked, -self._limit, self._limit)
        rate = GAIN_NMM_S / INTEGRAL_TIME_S * error + UNWIND_PER_S * (given - asked)
        self._integral = self._integral + self._period_s * rate
        return given


def main(horizon_s: float = 100.0, seed: int = 0) -> None:
    """Run the ∞ with the AVC and with the loop above."""
    for name, wheel_loop in (("AVC", None), ("PI", f"{__name__}:PiLoop")):
        scenario = load_scenario("infinity", wheel_loop=wheel_loop, horizon_s=horizon_s)
        robots = run_policy(scenario, ReferencePolicy(), seed, trust=True).metrics()
        errors = [f"{robot.position_rmse_mm:.2f}" for robot in robots]
        limited = [f"{100 * robot.saturation_fraction:.1f}" for robot in robots]
        print(
            f"{name:3s}: position error {', '.join(errors)} mm RMS, "
            f"torque at its limit {', '.join(limited)} % of the time"
        )


if __name__ == "__main__":
    typer.run(main)
