"""The paper's whole stack on the policy's side: from the ``sensor`` observation to torques.

It runs the same compiled laws as the on-board stack, on the readings of a robot's sensors and radio only,
which shows that the observation suffices. Use it with ``observation="sensor"``,
``action="torque"`` and ``control_period_s=0.001``.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from tlf_env.numerics.compiled import driver
from tlf_env.numerics.rows import reader, writer
from tlf_env.onboard.controllers import controller
from tlf_env.onboard.estimator import (
    Ekf,
    Estimate,
    correct,
    ekf_constants,
    predict,
)
from tlf_env.onboard.observer import Message, observed_reference, observer_rates, smoothing
from tlf_env.onboard.tracking import (
    Controller,
    Gains,
    body_errors,
    gains_row,
    tracking_twist,
)
from tlf_env.onboard.wheel_loop import (
    WheelLoopRow,
    WheelLoopState,
    digital_wheel_loop,
    wheel_torque,
)
from tlf_env.physics.units import MILLINEWTON_PER_NEWTON
from tlf_env.physics.vehicle import Body, body_array, odometry, wheel_speeds
from tlf_env.task.actions import (
    ACTION_SIZE,
    FULL_SPEED_MM_S,
    FULL_TORQUE_NMM,
    FULL_YAW_RATE_RAD_S,
)
from tlf_env.task.observation import SAMPLE_ENTRIES, SensorTail, sensor_entries
from tlf_env.task.scenario import Scenario

SAMPLE = len(SAMPLE_ENTRIES)
read_body = reader(Body)
read_estimate, write_estimate = reader(Estimate), writer(Estimate)
read_loop_state, write_loop_state = reader(WheelLoopState), writer(WheelLoopState)


class StackState(NamedTuple):
    """What the stacks of a batch remember; ``(field, row, 1)`` unless said."""

    estimates: np.ndarray
    loops: np.ndarray
    observers: np.ndarray
    speeds: np.ndarray
    steps: np.ndarray  # (row,) int64: control steps since the start


class StackSettings(NamedTuple):
    """Constants of the stacks."""

    bodies: np.ndarray  # (field, robot, 1); one robot where all are alike
    ekf: Ekf
    loop: WheelLoopRow
    gains: Gains
    observer_gain: float
    smoothing: float
    period: float
    sample_period: float
    substeps: int


@driver
def _torques(
    rows: np.ndarray, scales: np.ndarray, state: StackState, c: StackSettings, out: np.ndarray
) -> None:
    for r in range(rows.shape[0]):
        body = read_body(c.bodies, r % c.bodies.shape[1], 0)
        values = rows[r] * scales
        first = SAMPLE * c.substeps
        tail = SensorTail(
            values[first],
            values[first + 1],
            values[first + 2],
            values[first + 3],
            values[first + 4],
            values[first + 5],
            values[first + 6],
            values[first + 7],
            values[first + 8],
            values[first + 9],
            values[first + 10],
            values[first + 11],
        )
        step = state.steps[r]
        if step == 0:
            heading = math.atan2(tail.start_sin, tail.start_cos)
            write_estimate(
                state.estimates,
                r,
                0,
                Estimate(tail.start_x, tail.start_y, heading, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0),
            )
            write_loop_state(state.loops, r, 0, WheelLoopState(0.0, 0.0, 0.0, 0.0))
            state.observers[0, r, 0] = tail.start_x
            state.observers[1, r, 0] = tail.start_y
            state.observers[2, r, 0] = heading
            state.speeds[:, r, 0] = 0.0
        else:
            estimate = read_estimate(state.estimates, r, 0)
            for k in range(c.substeps):
                i = SAMPLE * k
                step_l, step_r = values[i + 2], values[i + 3]
                u_1, u_2 = odometry(step_l, step_r, body.R, body.h)
                estimate = predict(estimate, c.ekf, u_1, u_2)
                fix_x, fix_y = values[i] + tail.start_x, values[i + 1] + tail.start_y
                estimate, _, _, _ = correct(estimate, c.ekf, fix_x, fix_y)
                state.speeds[0, r, 0] = step_l / c.sample_period
                state.speeds[1, r, 0] = step_r / c.sample_period
            write_estimate(state.estimates, r, 0, estimate)
        state.steps[r] = step + 1
        estimate = read_estimate(state.estimates, r, 0)

        x, y = tail.message_x + tail.start_x, tail.message_y + tail.start_y
        heading = math.atan2(tail.message_sin, tail.message_cos)
        reference_u_1, reference_u_2 = tail.message_u_1, tail.message_u_2
        if tail.is_leader < 0.5:
            message = Message(x, y, heading, reference_u_1, reference_u_2)
            x, y = state.observers[0, r, 0], state.observers[1, r, 0]
            heading = state.observers[2, r, 0]
            factor = smoothing(step * c.period, c.smoothing)
            rate_x, rate_y, rate = observer_rates(x, y, heading, message, c.observer_gain, factor)
            seen = observed_reference(x, y, heading, rate_x, rate_y, rate)
            reference_u_1, reference_u_2 = seen.u_1, seen.u_2
            state.observers[0, r, 0] = x + c.period * rate_x
            state.observers[1, r, 0] = y + c.period * rate_y
            state.observers[2, r, 0] = heading + c.period * rate

        e_1, e_2 = body_errors(x - estimate.x, y - estimate.y, estimate.theta)
        e_3 = heading - estimate.theta
        u_1, u_2 = tracking_twist(
            e_1, e_2, math.sin(e_3), math.cos(e_3), reference_u_1, reference_u_2, c.gains
        )
        u_1 = min(max(u_1, -FULL_SPEED_MM_S), FULL_SPEED_MM_S)
        u_2 = min(max(u_2, -FULL_YAW_RATE_RAD_S), FULL_YAW_RATE_RAD_S)
        wanted_l, wanted_r = wheel_speeds(u_1, u_2, body)
        held = read_loop_state(state.loops, r, 0)
        limit = body.torque_limit
        torque_l, integral_l, lag_l = wheel_torque(
            wanted_l - state.speeds[0, r, 0], held.integral_l, held.lag_l, c.loop, limit
        )
        torque_r, integral_r, lag_r = wheel_torque(
            wanted_r - state.speeds[1, r, 0], held.integral_r, held.lag_r, c.loop, limit
        )
        write_loop_state(state.loops, r, 0, WheelLoopState(integral_l, lag_l, integral_r, lag_r))
        full = FULL_TORQUE_NMM * MILLINEWTON_PER_NEWTON
        out[r, 0], out[r, 1] = torque_l / full, torque_r / full


class StackPolicy:
    """EKF, observer, tracking law and wheel loop, each robot by itself; SB3's ``predict``, recurrent.

    Where the scenario's robots are alike it drives any number of them; where they are not, row r of a
    batch is robot r modulo their number, as the rows of several formations are.

    Parameters
    ----------
    scenario
        The scenario that it will run on: periods, robots and the stack's parameters are read from it.
    gains
        A preset of the paper's law, ``"consistent"`` or ``"printed"``.

    Raises
    ------
    ValueError
        for other gains (the stack has neither limits nor an estimate of the slip), and if the
        scenario names parts of its own, has another estimator than ``ekf``, another observation than
        ``sensor``, another action than ``torque``, or a control period of several physics periods
        (on board the wheel loop runs in every one).
    """

    privileged = False

    def __init__(self, scenario: Scenario, gains: str = "consistent") -> None:
        wheel_loop, observer = scenario.wheel_loop, scenario.observer
        if isinstance(wheel_loop, str) or isinstance(observer, str):
            raise ValueError(
                "StackPolicy has the paper's wheel loop and observer; the scenario names parts"
            )
        for field, only in (("estimator", "ekf"), ("observation", "sensor"), ("action", "torque")):
            if getattr(scenario, field) != only:
                raise ValueError(
                    f"StackPolicy needs {field} {only!r}; the scenario has {getattr(scenario, field)!r}"
                )
        if scenario.substeps != 1:
            raise ValueError(
                "StackPolicy gives the torques of every physics period: control_period_s "
                f"{scenario.control_period_s} must be physics_period_s {scenario.physics_period_s}"
            )
        law = controller(gains)
        if law != Controller(gains=law.gains):
            raise ValueError(
                "StackPolicy has the paper's law and filter, gains consistent, printed; "
                f"{gains!r} needs limits and an estimate of the slip"
            )
        robots = scenario.robot_models
        if len(set(robots)) == 1:
            robots = robots[:1]
        entries = sensor_entries(scenario.substeps)
        self._scales = np.array([entry.scale for entry in entries.values()])
        self._settings = StackSettings(
            bodies=body_array(list(robots)),
            ekf=ekf_constants(scenario.ekf),
            loop=digital_wheel_loop(wheel_loop, scenario.control_period_s),
            gains=gains_row(law.gains),
            observer_gain=observer.gain_per_s,
            smoothing=observer.smoothing_s,
            period=scenario.control_period_s,
            sample_period=scenario.physics_period_s,
            substeps=scenario.substeps,
        )

    def predict(
        self,
        observation: np.ndarray,
        state: StackState | None = None,
        episode_start: np.ndarray | None = None,
        deterministic: bool = True,
    ) -> tuple[np.ndarray, Any]:
        """``torque`` action for one ``sensor`` observation or a batch, and what to remember.

        A row starts anew where ``episode_start`` is true, or where there is no state yet.

        Raises
        ------
        ValueError
            if the observation is not a ``sensor`` observation of the scenario, or unlike robots
            cannot be distinguished by the number of rows.
        """
        observation = np.asarray(observation)
        if observation.ndim not in (1, 2) or observation.shape[-1] != len(self._scales):
            raise ValueError(
                f"the observation has the shape {observation.shape}; a sensor observation has "
                f"{len(self._scales)} entries, in one row or a batch of rows"
            )
        rows = np.ascontiguousarray(np.atleast_2d(observation))
        n = len(rows)
        robots = self._settings.bodies.shape[1]
        if n % robots:
            raise ValueError(
                f"the batch has {n} rows; the scenario's {robots} robots differ, and it needs a row "
                "for each of them, or for each of several formations"
            )
        if state is None or len(state.steps) != n:
            state = StackState(
                np.zeros((len(Estimate._fields), n, 1)),
                np.zeros((len(WheelLoopState._fields), n, 1)),
                np.zeros((3, n, 1)),
                np.zeros((2, n, 1)),
                np.zeros(n, dtype=np.int64),
            )
        elif episode_start is not None:
            state.steps[np.atleast_1d(episode_start).astype(bool)] = 0
        action = np.empty((n, ACTION_SIZE), dtype=rows.dtype)
        _torques(rows, self._scales, state, self._settings, action)
        return (action[0] if observation.ndim == 1 else action), state
