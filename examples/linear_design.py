"""Linear analysis of the wheel loop with python-control: linearised plant, margins and a Bode plot.

On a straight path the two wheels form two decoupled loops: the *common* mode (equal torques, the robot
accelerates) and the *differential* mode (opposite torques, it turns). The paper designs its AVC for one
wheel that carries 0.4 of the mass, eq. (6). This script prints the margins for that plant and for both
modes, with the loop as implemented: a zero-order hold every millisecond.

    python examples/linear_design.py --figure bode.png
"""

from __future__ import annotations

from pathlib import Path

import control
import numpy as np
import typer

from tlf_env.onboard.wheel_loop import WheelLoopParameters
from tlf_env.physics.linear import LinearPlant, linearise
from tlf_env.physics.vehicle import RobotParameters

PERIOD_S = 0.001
KG_MM2_S2_PER_NMM = 1000.0


def paper_plant(robot: RobotParameters) -> control.StateSpace:
    """Eq. (6): wheel speed from torque, κ/s, in rad/s per N·mm."""
    carried = robot.drive_load_share * robot.mass_kg * robot.wheel_radius_mm**2
    kappa = KG_MM2_S2_PER_NMM / (carried + robot.wheel_inertia_kg_mm2)
    return control.ss(0.0, kappa, 1.0, 0.0)


def mode(plant: LinearPlant, states: slice, sign: float) -> control.StateSpace:
    """One mode of the wheels, from torques (sign·τ, τ) to the mean of (sign·ω_l, ω_r)."""
    together = np.array([sign, 1.0])
    return control.ss(
        plant.A[states, states],
        plant.B[states] @ together,
        0.5 * together @ plant.C[:, states],
        0.0,
    )


def avc(p: WheelLoopParameters) -> control.StateSpace:
    """Eq. (13): K(s) in N·mm per rad/s."""
    return control.ss(
        control.tf(p.gain_Nmm_s * np.array([1.0, p.zeros_1, p.zeros_0]), [1.0, p.pole_rad_s, 0.0])
    )


def report(name: str, plant: control.StateSpace, loop: control.StateSpace) -> None:
    """Print the margins of the loop with a plant."""
    open_loop = control.sample_system(loop, PERIOD_S) * control.sample_system(plant, PERIOD_S)
    response = control.frequency_response(open_loop, np.geomspace(0.01, np.pi / PERIOD_S, 2000))
    _, phase, _, _, crossover, _ = control.stability_margins(response)
    modulus = np.abs(1 + response.complex).min()
    closed = np.abs(control.feedback(open_loop, 1).poles())
    print(
        f"{name:13s} |G(1 rad/s)| {np.abs(plant(1j)):.4f} rad/s per N·mm, crossover "
        f"{crossover:6.1f} rad/s, phase margin {phase:4.1f}°, modulus margin {modulus:.2f}, "
        f"{'stable' if closed.max() < 1 else 'unstable'}"
    )


def main(speed_mm_s: float = 300.0, figure: Path | None = None) -> None:
    """Print the margins of the wheel loop; with ``figure``, draw the open loops to that file."""
    robot, loop = RobotParameters(), avc(WheelLoopParameters())
    straight = linearise(robot, speed_mm_s)
    plants = {
        "eq. (6)": paper_plant(robot),
        "common": mode(straight, slice(0, 1), 1.0),
        "differential": mode(straight, slice(1, 3), -1.0),
    }
    for name, plant in plants.items():
        report(name, plant, loop)
    poles = ", ".join(f"{pole:+.2f}" for pole in plants["differential"].poles().real)
    print(f"poles of yaw and castor without the loop at {speed_mm_s:g} mm/s: {poles} 1/s")
    if figure is not None:
        import matplotlib.pyplot as plt

        control.bode_plot(
            [loop * plant for plant in plants.values()],
            omega_limits=(0.1, 1000.0),
            label=list(plants),
            title="The open wheel loop",
        )
        plt.savefig(figure)
        print(f"open loops in {figure}")


if __name__ == "__main__":
    typer.run(main)
