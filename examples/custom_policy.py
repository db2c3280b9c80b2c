"""A user-defined policy: pure pursuit of the previewed reference, with the ``predict`` of SB3.

It shows how to read entries of a ``tracking`` observation by name. Any object with this ``predict`` can
drive a formation: in your own loop, in :func:`baselines.runs.run.run_policy`, and as ``others=`` of the
Gymnasium environment.

    python examples/custom_policy.py --horizon-s 100
"""

from __future__ import annotations

from typing import Any

import numpy as np
import typer

from baselines import ReferencePolicy
from baselines.runs.run import run_policy
from tlf_env import load_scenario
from tlf_env.task.actions import FULL_SPEED_MM_S, FULL_YAW_RATE_RAD_S
from tlf_env.task.observation import tracking_entries

PREVIEW_S = (0.5, 1.0)  # the default of the scenarios
SPEED_GAIN_PER_S = 0.5
NEAREST_MM = 20.0  # lower bound of the distance to the target in the curvature


class PurePursuit:
    """Drive along the arc through the position of the reference in half a second."""

    privileged = False

    def __init__(self) -> None:
        entries = tracking_entries(PREVIEW_S)
        self._place = {name: i for i, name in enumerate(entries)}
        self._scale = np.array([entry.scale for entry in entries.values()])

    def predict(
        self,
        observation: np.ndarray,
        state: Any = None,
        episode_start: np.ndarray | None = None,
        deterministic: bool = True,
    ) -> tuple[np.ndarray, Any]:
        """``twist`` actions for one observation or a batch; the policy has no state."""
        values = observation * self._scale  # physical units
        speed = (
            values[..., self._place["reference_u_1"]]
            + SPEED_GAIN_PER_S * values[..., self._place["e_1"]]
        )
        forward = values[..., self._place["forward_in_0.5_s"]]
        right = values[..., self._place["right_in_0.5_s"]]
        away = np.maximum(np.hypot(forward, right), NEAREST_MM)
        yaw_rate = -2.0 * speed * right / away**2  # positive turns left
        action = np.stack([speed / FULL_SPEED_MM_S, yaw_rate / FULL_YAW_RATE_RAD_S], axis=-1)
        return np.clip(action, -1.0, 1.0).astype(observation.dtype), state


def main(horizon_s: float = 100.0, seed: int = 0) -> None:
    """Run the ∞ and the flower with the default controller and with pure pursuit."""
    for task in ("infinity", "flower"):
        scenario = load_scenario(task, horizon_s=horizon_s)
        for policy in (ReferencePolicy(), PurePursuit()):
            robots = run_policy(scenario, policy, seed).metrics()
            errors = ["lost" if robot.lost else f"{robot.position_rmse_mm:.2f}" for robot in robots]
            print(f"{task}, {type(policy).__name__}: {', '.join(errors)} mm RMS")


if __name__ == "__main__":
    typer.run(main)
