"""An unscented Kalman filter as a robot's estimator: pose, slip and gyro bias, driven under continuous slip.

It shows how an estimator of one's own is made from the filter in ``baselines.policies.estimators.unscented``;
the estimator ``ukf`` there has a fuller model. It uses encoders, position fixes with their times, and the gyro,
and returns pose, twist, slip and covariance; controllers cancel the slip, and the follower receives the twist.
It is compared with the built-in filters on the same random draws, with a fix every 1 ms and every 10 ms.

    python examples/ukf_estimator.py --disturbance slip-ramps
    tlf run infinity --disturbance slip-noise --gains tuned --estimator examples.ukf_estimator:SlipUkf --trust
"""

from __future__ import annotations

import math
from collections import deque
from typing import Any, NamedTuple

import numpy as np
import typer

from baselines import ReferencePolicy
from baselines.policies.estimators.unscented import UnscentedKalmanFilter
from tlf_env import Estimated, Readings, load_scenario, parallel_env
from tlf_env.physics.vehicle import RobotParameters

FILTER_PERIOD_S = 0.005  # of the filter's steps; between them, the pose is extrapolated
LONGEST_DELAY_S = 0.5  # of a fix
FIX_VARIANCE_MM2 = 0.2
GYRO_STD_RAD_S = 0.02  # of a mean over a filter period: noise and scale, and the encoders' noise
SLIP_STD = np.array([35.0, 0.23])  # mm/s, rad/s
SLIP_TIME_S = 1.0  # correlation time of the slip
# Random walks, standard deviation after 1 s: along the heading, across it (skids), of heading and gyro bias.
FORWARD_MM, SIDEWAYS_MM, HEADING_RAD, BIAS_RAD_S = 1.0, 0.3, 1e-3, 1e-4
START_STD = np.array([0.01, 0.01, 1e-4, 0.1, 1e-3, 0.01])

# Gyro of the comparison: InvenSense, MPU-6050 Product Specification 3.4, 2013, section 6.1: rate noise spectral
# density of 0.005 °/s/√Hz, scale within ±3 %; the bias is that of a calibration at rest.
GYRO = {
    "noise_rad_s_sqrt_hz": 8.73e-5,
    "scale": {"type": "uniform", "low": 0.97, "high": 1.03},
    "bias_rad_s": {"type": "uniform", "low": -0.01, "high": 0.01},
}


class SlipUkf:
    """States: x and y of c (mm), heading (rad), slip δ₁ (mm/s) and δ₂ (rad/s) of eq. (14), gyro bias (rad/s).

    Slip is a first-order Gauss–Markov process. Readings are collected over a filter period. Fixes are moved
    forward to its end by the motion since they were taken, then averaged.
    """

    def __init__(self, robot: RobotParameters, period_s: float) -> None:
        self._radius, self._width = robot.wheel_radius_mm, robot.axle_width_mm
        self._dt_s = period_s
        self._every = max(round(FILTER_PERIOD_S / period_s), 1)
        self._decay = math.exp(-self._every * period_s / SLIP_TIME_S)
        walks = np.square([FORWARD_MM, SIDEWAYS_MM, HEADING_RAD, BIAS_RAD_S])
        walks *= self._every * period_s
        self._noise = np.diag([*walks[:3], *SLIP_STD**2 * (1.0 - self._decay**2), walks[3]])

    def reset(self, pose: np.ndarray) -> None:
        """Start at the true pose, at rest."""
        self._filter = UnscentedKalmanFilter(
            np.array([*pose, 0.0, 0.0, 0.0]), np.diag(START_STD**2)
        )
        self._pose = pose.tolist()
        self._way = np.zeros(2)  # sum of all motions of the pose, without corrections
        self._ways = deque([self._way], maxlen=round(LONGEST_DELAY_S / self._dt_s) + 1)
        self._clear()

    def get_state(self) -> list[Any]:
        """What it remembers, for ``env.get_state()``: plain values, and no filter."""
        filtered = self._filter.mean, self._filter.covariance
        collected = self._samples, self._rolled, self._yawed, self._fixes, self._fix_sum
        return [filtered, self._pose, list(self._ways), collected]

    def set_state(self, state: list[Any]) -> None:
        """Go on from what ``get_state`` has returned; ``reset`` was called before."""
        filtered, self._pose, ways, collected = state
        self._filter = UnscentedKalmanFilter(*filtered)
        self._ways = deque(ways, maxlen=self._ways.maxlen)
        self._way = self._ways[-1]
        self._samples, self._rolled, self._yawed, self._fixes, self._fix_sum = collected

    def _clear(self) -> None:
        """Start to collect readings."""
        self._samples, self._rolled, self._yawed = 0, np.zeros(2), 0.0
        self._fixes, self._fix_sum = 0, np.zeros(2)

    def update(self, readings: Readings) -> Estimated:
        """Extrapolate by the encoders and the slip; with the last sample of a filter period, correct."""
        left, right = self._radius * readings.steps_rad
        rolled = np.array([0.5 * (left + right), (right - left) / self._width])
        slip = self._filter.mean[3:5]
        moved, turned = (rolled + slip * self._dt_s).tolist()
        self._extrapolate(moved, turned)
        self._samples += 1
        self._rolled += rolled
        self._yawed += readings.gyro_rad_s * self._dt_s
        if readings.fix_mm is not None:
            age = round((readings.t_s - readings.fix_t_s) / self._dt_s)
            self._fixes += 1
            self._fix_sum += readings.fix_mm - self._ways[-1 - min(age, len(self._ways) - 1)]
        if self._samples == self._every:
            self._step()
        return Estimated(
            pose=np.array(self._pose),
            twist=(moved / self._dt_s, turned / self._dt_s),
            slip=self._filter.mean[3:5],
            covariance=self._filter.covariance[:3, :3],
        )

    def _extrapolate(self, moved: float, turned: float) -> None:
        """Move the pose by one sample."""
        x, y, theta = self._pose
        step = -moved * math.sin(theta + 0.5 * turned), moved * math.cos(theta + 0.5 * turned)
        self._pose = [x + step[0], y + step[1], theta + turned]
        self._way = self._way + step
        self._ways.append(self._way)

    def _step(self) -> None:
        """One step of the filter with the readings collected; its heading 0 points along +y."""
        time_s = self._samples * self._dt_s
        ahead, turn = self._rolled

        def move(points: np.ndarray) -> np.ndarray:
            x, y, theta, delta_1, delta_2, bias = points.T
            moved, turned = ahead + delta_1 * time_s, turn + delta_2 * time_s
            middle = theta + 0.5 * turned
            return np.column_stack(
                [
                    x - moved * np.sin(middle),
                    y + moved * np.cos(middle),
                    theta + turned,
                    self._decay * delta_1,
                    self._decay * delta_2,
                    bias,
                ]
            )

        def measure(points: np.ndarray) -> np.ndarray:
            gyro = turn / time_s + points[:, 4] + points[:, 5]
            return np.column_stack([gyro, points[:, :2]])[:, : 3 if self._fixes else 1]

        sin, cos = math.sin(self._pose[2]), math.cos(self._pose[2])
        to_world = np.eye(6)
        to_world[:2, :2] = [[-sin, cos], [cos, sin]]  # columns: forward, to the right
        self._filter.predict(move, to_world @ self._noise @ to_world.T)
        measured, variances = [self._yawed / time_s], [GYRO_STD_RAD_S**2]
        if self._fixes:
            measured += (self._fix_sum / self._fixes + self._way).tolist()
            variances += 2 * [FIX_VARIANCE_MM2 / self._fixes]
        self._filter.correct(measure, np.array(measured), np.diag(variances))
        self._pose = self._filter.mean[:3].tolist()
        self._clear()


class Errors(NamedTuple):
    """Errors of a run from a third of its time on: RMS of the worst robot."""

    position_mm: float  # true position to the reference
    estimate_mm: float  # estimated to true position
    slip_1_mm_s: float  # estimated to injected slip; skids count as errors
    slip_2_rad_s: float
    lost: int  # number of robots


def drive(
    gains: str, estimator: str, disturbance: str, fix_period_s: float, horizon_s: float, seed: int
) -> Errors:
    """Drive the ∞ with the reference controller and an estimator, under a disturbance preset."""
    channels = load_scenario("infinity", disturbance=disturbance).disturbance.model_dump()
    channels["position"]["period_s"] = fix_period_s
    channels["gyro"].update(GYRO)
    env = parallel_env(
        "infinity",
        disturbance=channels,
        estimator=estimator,
        broadcast_smoothing_s=0.0,
        start_ramp_s=4.0,
        horizon_s=horizon_s,
        end_on=(),
        trust=True,
    )
    policy, rows = ReferencePolicy(gains), []
    seen, _ = env.reset(seed=seed)
    while env.agents:
        actions = policy.predict(np.stack(list(seen.values())))[0]
        seen, *_, infos = env.step(dict(zip(env.agents, actions, strict=True)))
        truth = env.formation.info()
        pose, slip = env.formation.named("estimate"), env.formation.named("slip")
        injected = np.array(
            [[info["slip_delta_1_mm_s"], info["slip_delta_2_rad_s"]] for info in infos.values()]
        ).T
        rows.append(
            [
                truth.position_error_mm.copy(),
                np.hypot(pose.x - truth.x_mm, pose.y - truth.y_mm),
                slip.delta_1 - injected[0],
                slip.delta_2 - injected[1],
            ]
        )
    settled = np.array(rows)[len(rows) // 3 :]
    rms = np.sqrt((settled**2).mean(axis=0)).max(axis=1)
    return Errors(*rms.tolist(), lost=sum(info["lost"] for info in infos.values()))


def main(
    disturbance: str = "slip-noise", horizon_s: float = 24.0, seed: int = 0, seeds: int = 1
) -> None:
    """Compare the filters, as medians over seeds, with two sets of gains and two rates of the fixes."""
    print(f"{disturbance}, from {horizon_s / 3:g} to {horizon_s:g} s, RMS of the worst robot")
    print("gains       fixes    filter    position    estimate      slip 1        slip 2     lost")
    for gains in ("consistent", "tuned"):
        for fix_period_s, rate in ((0.001, "1000 Hz"), (0.01, " 100 Hz")):
            for estimator in ("ekf", "ekf-slip", f"{__name__}:SlipUkf"):
                runs = [
                    drive(gains, estimator, disturbance, fix_period_s, horizon_s, number)
                    for number in range(seed, seed + seeds)
                ]
                it = Errors(*np.median(runs, axis=0))
                print(
                    f"{gains:10}  {rate}  {estimator.split(':')[-1]:8}{it.position_mm:8.1f} mm"
                    f"{it.estimate_mm:8.2f} mm{it.slip_1_mm_s:7.1f} mm/s{it.slip_2_rad_s:8.3f} rad/s"
                    f"{sum(run.lost for run in runs):5}"
                )


if __name__ == "__main__":
    typer.run(main)
