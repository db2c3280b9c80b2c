"""What the estimators of this package share: the model of the motion, and dead reckoning between their steps.

The state is :class:`State`. Over an interval T the gyro turned by g and the plant's law made the speed v grow
by γ; :func:`moved` gives the state after it:

- v grows by γ + a T. Newton's law of the body, whatever the floor does, is
  m (v̇ + d ω²) = (τ_l + τ_r)/R − (J/R²)(v̇_l + v̇_r), with the centre of mass d behind the axle, the wheels'
  inertia J and their speeds v_l, v_r at the rim. It is integrated over the readings to γ. The pull a is what
  it leaves out: friction, slopes, payload, motors that do not deliver what is asked for.
- The heading grows by (1 − s) g − b T, with the gyro's error of scale s and its bias b.
- The encoders roll by the distance less the slip δ₁ of eq. (14): their mean speed measures v − δ₁.
- δ₁ and a are first-order Gauss–Markov processes; s and b are random walks.

So slip in yaw is no state: δ₂ is what the corrected gyro measures beyond the encoders.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections import deque
from typing import NamedTuple

import numpy as np

from tlf_env.common.models import Frozen, NonNegative, Positive
from tlf_env.onboard.parts import Estimated, Readings
from tlf_env.onboard.slip_estimator import sample_weight
from tlf_env.physics.vehicle import RobotParameters


class State(NamedTuple):
    """What is estimated; also the columns of arrays of states."""

    x: float  # of c, mm
    y: float
    theta: float  # heading, rad; 0 points along +y
    speed: float  # v of c forward, mm/s
    slip: float  # δ₁, mm/s
    pull: float  # a, mm/s²
    scale: float  # s of the gyro
    bias: float  # b of the gyro, rad/s


STATES = len(State._fields)
X, Y, THETA, SPEED, SLIP, PULL, SCALE, BIAS = range(STATES)


class Noise(Frozen):
    """Sizes of noise and errors, and bounds of what is reported."""

    # White noise: standard deviation after 1 s
    forward_mm: Positive = 0.5
    sideways_mm: Positive = 0.3
    heading_rad: Positive = 3.0e-4
    speed_mm_s: Positive = 5.0
    scale: Positive = 1.0e-3
    bias_rad_s: Positive = 1.0e-4
    # Gauss–Markov processes: standard deviation and correlation time
    slip_mm_s: Positive = 30.0
    slip_time_s: Positive = 1.0
    pull_mm_s2: Positive = 300.0
    pull_time_s: Positive = 10.0
    # At the start; the pose is known
    start_scale: Positive = 0.02
    start_bias_rad_s: Positive = 0.01
    # Sensors
    rolled_mm: Positive = 0.04  # of what the encoders rolled in an interval
    fix_variance_mm2: Positive = 0.2  # of each coordinate, at the start
    fix_variance_time_s: Positive = 0.5  # averaging time of its adaptation, at least 50 fixes
    least_fix_variance_mm2: Positive = 0.01
    # Reported slip: its averaging time, against the encoders' noise, and bounds
    report_time_s: Positive = 0.02
    delta_1_bound_mm_s: NonNegative = 60.0
    delta_2_bound_rad_s: NonNegative = 0.415

    def start(self) -> np.ndarray:
        """Variances ``(8,)`` of the state at the start, at rest."""
        standard = [0.01, 0.01, 1e-4, 1.0, 1.0, 1.0, self.start_scale, self.start_bias_rad_s]
        return np.square(standard)

    def variances(self, time_s: float) -> np.ndarray:
        """Variances ``(8,)`` of the process noise over an interval; the first two forward and to the right."""
        walks = [self.forward_mm, self.sideways_mm, self.heading_rad, self.speed_mm_s]
        return np.array(
            [
                *(size**2 * time_s for size in walks),
                self.slip_mm_s**2 * -math.expm1(-2.0 * time_s / self.slip_time_s),
                self.pull_mm_s2**2 * -math.expm1(-2.0 * time_s / self.pull_time_s),
                self.scale**2 * time_s,
                self.bias_rad_s**2 * time_s,
            ]
        )


class Interval(NamedTuple):
    """Readings of an interval; numbers, or arrays with one of each."""

    time_s: float
    turned: float  # by the gyro, rad
    gained: float  # speed by Newton's law, mm/s
    reached: float  # distance by that gain alone, mm
    rolled: float  # by the encoders, mm


def moved(states: np.ndarray, past: Interval, noise: Noise) -> np.ndarray:
    """States ``(…, 8)`` after an interval."""
    x, y, theta, speed, slip, pull, scale, bias = np.moveaxis(states, -1, 0)
    time_s = past.time_s
    turn = (1.0 - scale) * past.turned - bias * time_s
    distance = speed * time_s + past.reached + 0.5 * pull * time_s**2
    middle = theta + 0.5 * turn
    return np.stack(
        [
            x - distance * np.sin(middle),
            y + distance * np.cos(middle),
            theta + turn,
            speed + past.gained + pull * time_s,
            slip * np.exp(-time_s / noise.slip_time_s),
            pull * np.exp(-time_s / noise.pull_time_s),
            scale,
            bias,
        ],
        axis=-1,
    )


def slopes(states: np.ndarray, past: Interval, noise: Noise) -> np.ndarray:
    """Derivative ``(…, 8, 8)`` of :func:`moved` by the states ``(…, 8)``."""
    _, _, theta, speed, _, pull, scale, bias = np.moveaxis(states, -1, 0)
    time_s = past.time_s
    turn = (1.0 - scale) * past.turned - bias * time_s
    distance = speed * time_s + past.reached + 0.5 * pull * time_s**2
    sin, cos = np.sin(theta + 0.5 * turn), np.cos(theta + 0.5 * turn)
    found = np.zeros((*states.shape, STATES))
    found[..., range(STATES), range(STATES)] = 1.0
    found[..., X, THETA], found[..., Y, THETA] = -distance * cos, -distance * sin
    found[..., X, SPEED], found[..., Y, SPEED] = -time_s * sin, time_s * cos
    found[..., X, PULL], found[..., Y, PULL] = -0.5 * time_s**2 * sin, 0.5 * time_s**2 * cos
    for column, part in ((SCALE, -past.turned), (BIAS, -time_s)):
        found[..., X, column] = -0.5 * part * distance * cos
        found[..., Y, column] = -0.5 * part * distance * sin
        found[..., THETA, column] = part
    found[..., SPEED, PULL] = time_s
    found[..., SLIP, SLIP] = np.exp(-time_s / noise.slip_time_s)
    found[..., PULL, PULL] = np.exp(-time_s / noise.pull_time_s)
    return found


def rolling_speed(states: np.ndarray, past: Interval) -> np.ndarray:
    """What the encoders measure as their mean speed in an interval, from the states ``(…, 8)`` at its end."""
    mean = states[..., SPEED] - past.gained + past.reached / past.time_s
    return mean - 0.5 * states[..., PULL] * past.time_s - states[..., SLIP]


def rolling_slope(past: Interval) -> np.ndarray:
    """Derivative ``(8,)`` of :func:`rolling_speed` by the state."""
    row = np.zeros(STATES)
    row[SPEED], row[SLIP], row[PULL] = 1.0, -1.0, -0.5 * past.time_s
    return row


def in_world(variances: np.ndarray, theta: np.ndarray | float) -> np.ndarray:
    """Covariances ``(…, 8, 8)`` of :meth:`Noise.variances` for headings ``(…)``."""
    sin, cos = np.sin(theta), np.cos(theta)
    forward, right = variances[:2]
    covariance = np.zeros((*np.shape(theta), STATES, STATES))
    covariance[..., range(STATES), range(STATES)] = variances
    covariance[..., X, X] = sin * sin * forward + cos * cos * right
    covariance[..., Y, Y] = cos * cos * forward + sin * sin * right
    covariance[..., X, Y] = covariance[..., Y, X] = sin * cos * (right - forward)
    return covariance


class Fix(NamedTuple):
    """A position fix of a robot that moves."""

    t_s: float  # when it was taken
    x: float  # mm
    y: float
    way_x: float  # the dead-reckoned way at that time, mm
    way_y: float
    nis: float  # normalised innovation squared


class Reckoning(ABC):
    """Estimator that reckons in every period, and corrects its state at the end of each interval.

    Readings are collected over an interval of several periods. What is reported in between is reckoned on from
    the last state. A fix that comes late is compared with the pose at its time: the pose now less the way
    since. The fixes' variance is adapted from the differences of successive fixes along the way, which have
    twice the variance of a fix; outliers count in it only up to the gate. If all fixes of a second are
    beyond the gate, it is raised to what they show.

    Parameters
    ----------
    robot
        Parameters of the empty robot.
    period_s
        Period of the readings, s.
    interval_s
        Time between two corrections, s, rounded to periods.
    noise
        Sizes of noise and errors.

    Raises
    ------
    ValueError
        for a period or an interval that is not a positive number.
    """

    LONGEST_DELAY_S = 0.5  # of a fix; later ones are taken as of that age
    GATE = 13.8  # of the normalised innovation squared: one in a thousand fixes lies beyond
    GIVE_UP_S = 1.0  # all fixes of this time beyond the gate are no outliers
    LARGEST_WEIGHT = 0.02  # of a fix in the adapted variance

    def __init__(
        self, robot: RobotParameters, period_s: float, interval_s: float, noise: Noise
    ) -> None:
        for name, value in (("period_s", period_s), ("interval_s", interval_s)):
            if not 0.0 < value < math.inf:
                raise ValueError(f"{name} {value} must be a positive number of seconds")
        self.noise = noise
        self._dt_s = period_s
        self._every = max(round(interval_s / period_s), 1)
        self._radius, self._width = robot.wheel_radius_mm, robot.axle_width_mm
        self._behind = robot.com_offset_mm
        mass = robot.mass_kg * robot.wheel_radius_mm
        # N·mm/(kg·mm) is 1000 mm/s²
        self._by_torque = 1000.0 * period_s / mass
        self._by_wheels = 2.0 * robot.wheel_inertia_kg_mm2 / (mass * robot.wheel_radius_mm)
        self._report = sample_weight(period_s, noise.report_time_s)
        self._variances = noise.variances(self._every * period_s)

    def reset(self, pose: np.ndarray) -> None:
        """Start at the true pose ``(x mm, y mm, θ rad)``, at rest."""
        self.state = np.array([*pose, *(STATES - 3) * [0.0]], dtype=np.float64)
        self.covariance = np.diag(self.noise.start())
        self.fix_variance = self.noise.fix_variance_mm2
        self._pose = self.state[:3].tolist()
        self._speed, self._rolling = 0.0, 0.0
        self._slips = [0.0, 0.0]
        self._way = (0.0, 0.0)
        self._ways = deque([self._way], maxlen=round(self.LONGEST_DELAY_S / self._dt_s) + 1)
        self._last_off: tuple[float, float, float] | None = (
            None  # of the last fix: when, and off the way
        )
        self._believed_s = 0.0  # when a fix was last within the gate
        self._collect()
        self._expect()

    def _collect(self) -> None:
        """Start an interval."""
        self._samples = 0
        self._turned = self._gained = self._reached = self._rolled = 0.0
        self._errors = self.state[[PULL, SCALE, BIAS]].tolist()

    def _expect(self) -> None:
        """What the fixes of the coming interval are expected to vary by, apart from their noise."""
        past = Interval(self._every * self._dt_s, 0.0, 0.0, 0.0, 0.0)
        slope = slopes(self.state, past, self.noise)[:2]
        noise = in_world(self._variances, self.state[THETA])[:2, :2]
        (self._p_xx, self._p_xy), (_, self._p_yy) = (
            slope @ self.covariance @ slope.T + noise
        ).tolist()

    def update(self, readings: Readings) -> Estimated:
        """Reckon on; at the end of an interval, correct.

        Returns
        -------
        Estimated
            Pose, twist, slip and covariance, and the normalised innovation squared of a fix.
        """
        dt = self._dt_s
        left, right = (self._radius * readings.steps_rad).tolist()
        rolled, spun = 0.5 * (left + right), (right - left) / self._width
        torque_l, torque_r = readings.torques_Nmm.tolist()
        rolling, rate = rolled / dt, readings.gyro_rad_s
        if torque_l == torque_r == 0.0:  # the kinematic plant has no torques
            gained = rolling - self._rolling
        else:
            gained = self._by_torque * (torque_l + torque_r)
            gained -= self._by_wheels * (rolling - self._rolling)
            gained -= self._behind * rate * rate * dt
        self._rolling = rolling
        self._reached += (self._gained + 0.5 * gained) * dt
        self._gained += gained
        self._turned += rate * dt
        self._rolled += rolled
        self._samples += 1
        pull, scale, bias = self._errors
        yaw_rate = (1.0 - scale) * rate - bias
        self._reckon(gained + pull * dt, yaw_rate * dt)
        slip_1, slip_2 = self._slips
        slip_1 += self._report * (self._speed - rolling - slip_1)
        slip_2 += self._report * (yaw_rate - spun / dt - slip_2)
        self._slips = [slip_1, slip_2]
        nis = 0.0
        if readings.fix_mm is not None and readings.fix_t_s is not None:
            fix_x, fix_y = readings.fix_mm.tolist()
            nis = self._fix(readings.t_s, fix_x, fix_y, readings.fix_t_s)
        if self._samples == self._every:
            self._finish(readings.t_s)
        most_1, most_2 = self.noise.delta_1_bound_mm_s, self.noise.delta_2_bound_rad_s
        return Estimated(
            pose=np.array(self._pose),
            twist=np.array([self._speed, yaw_rate]),
            slip=np.array([min(max(slip_1, -most_1), most_1), min(max(slip_2, -most_2), most_2)]),
            covariance=self.covariance[:3, :3],
            nis=nis,
        )

    def _reckon(self, gained: float, turned: float) -> None:
        """Move pose, speed and way by one period."""
        x, y, theta = self._pose
        ahead = (self._speed + 0.5 * gained) * self._dt_s
        middle = theta + 0.5 * turned
        step_x, step_y = -ahead * math.sin(middle), ahead * math.cos(middle)
        self._pose = [x + step_x, y + step_y, theta + turned]
        self._speed += gained
        self._way = (self._way[0] + step_x, self._way[1] + step_y)
        self._ways.append(self._way)

    def _fix(self, t_s: float, x: float, y: float, taken_s: float) -> float:
        """Take a fix; its normalised innovation squared."""
        age = min(round((t_s - taken_s) / self._dt_s), len(self._ways) - 1)
        way_x, way_y = self._ways[-1 - age]
        off_x, off_y = x - way_x, y - way_y
        variance = self.fix_variance
        d_x = off_x + self._way[0] - self._pose[0]
        d_y = off_y + self._way[1] - self._pose[1]
        s_xx, s_yy, s_xy = self._p_xx + variance, self._p_yy + variance, self._p_xy
        nis = (s_yy * d_x * d_x - 2.0 * s_xy * d_x * d_y + s_xx * d_y * d_y) / (
            s_xx * s_yy - s_xy * s_xy
        )
        if self._last_off is not None:
            last_s, last_x, last_y = self._last_off
            step_x, step_y = off_x - last_x, off_y - last_y
            square = min(0.25 * (step_x * step_x + step_y * step_y), 0.5 * self.GATE * variance)
            apart_s = max(taken_s - last_s, 0.0)
            weight = min(apart_s / self.noise.fix_variance_time_s, self.LARGEST_WEIGHT)
            changed = variance + weight * (square - variance)
            self.fix_variance = max(changed, self.noise.least_fix_variance_mm2)
        self._last_off = (taken_s, off_x, off_y)
        if nis <= self.GATE:
            self._believed_s = t_s
        elif t_s - self._believed_s >= self.GIVE_UP_S:
            self._believed_s = t_s
            self.fix_variance = max(self.fix_variance, 0.5 * (d_x * d_x + d_y * d_y))
        self._take(Fix(taken_s, x, y, way_x, way_y, nis))
        return nis

    def _finish(self, t_s: float) -> None:
        """End an interval: correct the state, and go on from it."""
        time_s = self._every * self._dt_s
        past = Interval(time_s, self._turned, self._gained, self._reached, self._rolled)
        self._correct(t_s, past)
        self._pose, self._speed = self.state[:3].tolist(), float(self.state[SPEED])
        self._collect()
        self._expect()

    @abstractmethod
    def _take(self, fix: Fix) -> None:
        """Keep a fix of the interval."""

    @abstractmethod
    def _correct(self, t_s: float, past: Interval) -> None:
        """Set ``state`` and ``covariance`` at the end of an interval."""
