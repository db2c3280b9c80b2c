"""What a recorded run holds beside its metrics: actions, observations, rewards, estimates, messages, grip."""

from __future__ import annotations

from typing import Any

import numpy as np

from tlf_env.disturbances.channels import CHANNELS
from tlf_env.disturbances.model import wheel_factors
from tlf_env.engine import readout
from tlf_env.engine.arrays import Arrays
from tlf_env.onboard.estimator import Estimate
from tlf_env.physics.vehicle import Body, Motion, odometry
from tlf_env.task.observation import sensor_entries, tracking_entries
from tlf_env.task.reward import RewardTerms
from tlf_env.task.scenario import Scenario

COVARIANCE = {
    "p_xx": "covariance_xx_mm2",
    "p_xy": "covariance_xy_mm2",
    "p_xt": "covariance_xtheta_mm_rad",
    "p_yy": "covariance_yy_mm2",
    "p_yt": "covariance_ytheta_mm_rad",
    "p_tt": "covariance_thetatheta_rad2",
}
MESSAGE = ("x_mm", "y_mm", "theta_rad", "u_1_mm_s", "u_2_rad_s")
ACTIONS = ("action_0", "action_1")
OBSERVATION = "observation_"  # before an entry's name
SIGNALS = (
    *ACTIONS,
    "reward",
    *(f"reward_{term}" for term in RewardTerms._fields),
    "reference_u_1_mm_s",
    "reference_u_2_rad_s",
    "slip_1_mm_s",
    "slip_2_rad_s",
    "estimated_x_mm",
    "estimated_y_mm",
    "estimated_theta_rad",
    *COVARIANCE.values(),
    "estimated_slip_1_mm_s",
    "estimated_slip_2_rad_s",
    *(f"message_{name}" for name in MESSAGE),
    "friction_left",
    "friction_right",
    "friction_castor",
    "tyre_slip_left_mm_s",
    "tyre_slip_right_mm_s",
    "tyre_slip_castor_mm_s",
)


class SignalTape:
    """Rows of the signals of one formation, kept while it runs; memory as large as the run is long."""

    def __init__(self, arrays: Arrays, scenario: Scenario) -> None:
        self._arrays, self._scenario = arrays, scenario
        seen = scenario.observation == "sensor"
        self._observations = arrays.sensor_observations if seen else arrays.observations
        entries = (
            sensor_entries(scenario.substeps, scenario.rays)
            if seen
            else tracking_entries(scenario.preview_s, scenario.rays, scenario.neighbour)
        )
        self._names = [f"{OBSERVATION}{name}" for name in entries]
        self._rows: list[np.ndarray] = []  # each (column, robot)
        self.note(0)

    def note(self, step: int) -> None:
        """Keep the values after a control step; the action and the reward are those of the step."""
        a = self._arrays
        motion, body = readout.named(a, "motion"), readout.named(a, "body")
        contact = readout.named(a, "contact")
        estimate, slip = readout.named(a, "estimate"), readout.named(a, "slip")
        reference = readout.reference(a)
        grip = readout.info_of(a, "tyre_friction_scale")[0]
        left, right, castor = self._patches(motion, body)
        true = readout.state(a)
        by_wheels = zip(
            true.omega_l_rad_s[0], true.omega_r_rad_s[0], body.R[0], body.h[0], strict=True
        )
        rolling, turning = np.array([odometry(*one) for one in by_wheels]).T
        acted = a.last_actions[0].T if step else np.full((len(ACTIONS), a.rewards.shape[1]), np.nan)
        lines = [
            *acted,
            a.rewards[0] if step else np.full_like(a.rewards[0], np.nan),
            *a.terms[0].T,
            reference.u_1[0],
            reference.u_2[0],
            true.forward_mm_s[0] - rolling,
            true.yaw_rad_s[0] - turning,
            *(getattr(estimate, name)[0] for name in Estimate._fields),
            slip.delta_1[0],
            slip.delta_2[0],
            *a.slot(a.messages, step)[:, :, 0],
            grip * readout.info_of(a, "tyre_friction_left")[0] * left,
            grip * readout.info_of(a, "tyre_friction_right")[0] * right,
            grip * castor,
            contact.slip_l[0],
            contact.slip_r[0],
            contact.slip_c[0],
            *self._observations[0].T,
            *a.applied[:, :, 0],
        ]
        self._rows.append(np.stack(lines))

    def columns(self, steps: int) -> dict[str, np.ndarray]:
        """The columns of the first steps, each (time, robot).

        Of the disturbance's channels only those that were not nominal throughout.
        """
        table = np.stack(self._rows[: steps + 1])
        names = [*SIGNALS, *self._names, *(channel.key for channel in CHANNELS)]
        found = {name: table[:, i] for i, name in enumerate(names)}
        for channel in CHANNELS:
            if (found[channel.key] == channel.nominal).all():
                del found[channel.key]
        return found

    def _patches(self, motion: Any, body: Any) -> np.ndarray:
        """Friction factors of the patches under the wheels, (wheel, robot)."""
        patches = self._arrays.patches[self._arrays.variants[0]]
        robots = range(motion.x.shape[1])
        if not len(patches):
            return np.ones((3, len(robots)))
        return np.array(
            [
                wheel_factors(
                    patches,
                    Body(*(field[0, i] for field in body)),
                    Motion(*(field[0, i] for field in motion)),
                )
                for i in robots
            ]
        ).T
