"""Estimators, wheel loops and observers written in Python, called between the halves of each substep."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from tlf_env.engine import drivers
from tlf_env.engine.arrays import Arrays
from tlf_env.engine.layout import Sample, Trace, rows_of
from tlf_env.engine.settings import Settings
from tlf_env.numerics.pointers import packed
from tlf_env.onboard.calibration import Belief
from tlf_env.onboard.memory import give_state, state_of
from tlf_env.onboard.parts import (
    Factory,
    Readings,
    checked_estimate,
    finite,
    load_part,
    make_part,
)
from tlf_env.onboard.slip_estimator import SlipEstimate
from tlf_env.physics.units import MILLINEWTON_PER_NEWTON
from tlf_env.physics.vehicle import RobotParameters
from tlf_env.task.actions import TORQUE
from tlf_env.task.scenario import Scenario

AXLE = Belief._fields.index("h")
RADII = [Belief._fields.index(name) for name in ("radius_l", "radius_r")]
COVARIANCE = np.triu_indices(3)  # its order in an Estimate, after the pose
SLIP = [SlipEstimate._fields.index(name) for name in ("delta_1", "delta_2")]
ODOMETRY = [Trace._fields.index(name) for name in ("distance", "turn")]
MOVED = [Trace._fields.index(name) for name in ("moved", "turned")]
NIS = Trace._fields.index("nis")


def part_factories(
    scenario: Scenario, at_hand: Mapping[str, Factory], *, trust: bool
) -> dict[str, Factory]:
    """Factories of the parts that a scenario names; those not in ``at_hand`` are imported.

    Raises
    ------
    ValueError
        for a part that cannot be imported, or may not be: ``trust`` is as of
        :func:`~tlf_env.onboard.parts.check_trust`.
    """
    return {
        role: at_hand.get(role) or load_part(role, path, trust=trust)
        for role, path in scenario.part_paths.items()
    }


def with_axle_width(robot: RobotParameters, width_mm: float) -> RobotParameters:
    """The robot with the axle's width that its computer believes in."""
    if width_mm == robot.axle_width_mm:
        return robot
    return robot.model_copy(update={"axle_width_mm": width_mm})


class Parts:
    """One object per robot and role."""

    def __init__(self, factories: Mapping[str, Factory], scenario: Scenario) -> None:
        self._factories = factories
        self._names = scenario.part_paths
        self._robots = scenario.robot_models
        self._periods = {
            "estimator": scenario.physics_period_s,
            "wheel_loop": scenario.physics_period_s,
            "observer": scenario.control_period_s,
        }
        self._made: dict[str, list[Any]] = {}
        self._packed: Any = None  # the last arrays and settings, as drivers take them
        self._packed_of: Arrays | None = None
        self._radii = np.ones((len(self._robots), 2))  # of the wheels, believed over true
        self._holds: list[int] = []  # substeps for which the last command still holds
        self._odometry = self._moved = np.zeros((2, 0))  # (mm and rad, robot) in this control step

    def reset(self, arrays: Arrays, settings: Settings) -> None:
        """Make all parts again and start them; observers run ahead by the preview.

        Raises
        ------
        ValueError
            for a factory that makes no part of its role.
        """
        self._radii, self._made = self._started(arrays.constants, arrays.states)
        for robot in range(1, len(self._of("observer"))):
            for step in range(settings.lookahead + 1):
                self._observe_one(arrays, settings, robot, step)

    def _started(
        self, constants: np.ndarray, states: np.ndarray
    ) -> tuple[np.ndarray, dict[str, list[Any]]]:
        """Wheel radii, and new parts at the start of the episode with these rows of the engine's arrays."""
        belief, starts = (
            rows_of(array, name)[:, :, 0]
            for array, name in ((constants, "belief"), (states, "start"))
        )
        robots = [
            with_axle_width(robot, 2.0 * h)
            for robot, h in zip(self._robots, belief[AXLE].tolist(), strict=True)
        ]
        made = {
            role: [
                make_part(role, self._names[role], factory, robot, self._periods[role])
                for robot in robots
            ]
            for role, factory in self._factories.items()
        }
        for estimator, pose in zip(made.get("estimator", []), starts.T, strict=False):
            estimator.reset(pose.copy())
        for loop in made.get("wheel_loop", []):
            loop.reset()
        for observer, pose in zip(made.get("observer", [])[1:], starts.T[1:], strict=False):
            observer.reset(pose.copy())
        return belief[RADII].T.copy(), made

    def get_state(self, numbers: dict[str, np.ndarray]) -> Any:
        """The states of all parts as JSON values, their arrays in ``numbers``.

        Raises
        ------
        ValueError
            in one line that names the part, for a state that is not plain.
        """
        return {
            role: [
                state_of(part, self._what(role, robot), f"parts/{role}/{robot}", numbers)
                for robot, part in enumerate(parts)
                if self._is_used(role, robot)
            ]
            for role, parts in self._made.items()
        }

    def restored(
        self,
        tree: Any,
        numbers: Mapping[str, np.ndarray],
        constants: np.ndarray,
        states: np.ndarray,
    ) -> tuple[np.ndarray, dict[str, list[Any]]]:
        """What :meth:`go_on` takes: new parts with the states of :meth:`get_state`; nothing here changes.

        Raises
        ------
        ValueError
            in one line that names the part, if it does not take its state.
        """
        radii, made = self._started(constants, states)
        for role, parts in made.items():
            used = [robot for robot in range(len(parts)) if self._is_used(role, robot)]
            trees = tree.get(role) if isinstance(tree, dict) else None
            if not isinstance(trees, list) or len(trees) != len(used):
                raise ValueError(f"the snapshot is damaged: it has no states for each {role}")
            for robot, one in zip(used, trees, strict=True):
                give_state(parts[robot], one, self._what(role, robot), numbers)
        return radii, made

    def go_on(self, restored: tuple[np.ndarray, dict[str, list[Any]]]) -> None:
        """Go on with the parts that :meth:`restored` has made."""
        self._radii, self._made = restored

    def _what(self, role: str, robot: int) -> str:
        return f"{role.replace('_', ' ')} {self._names[role]!r} of robot_{robot}"

    @staticmethod
    def _is_used(role: str, robot: int) -> bool:
        """Whether a part is ever called: the leader's observer is not."""
        return role != "observer" or robot > 0

    def _of(self, role: str) -> list[Any]:
        return self._made.get(role, [])

    def _given(self, arrays: Arrays, settings: Settings) -> tuple[Arrays, Settings]:
        """Both as drivers take them; packed again if the arrays are others than last time."""
        if self._packed_of is not arrays:
            self._packed, self._packed_of = (packed(arrays), packed(settings)), arrays
        given: tuple[Arrays, Settings] = self._packed
        return given

    def drive(self, arrays: Arrays, substep: int, settings: Settings) -> None:
        """Wheel loops: put torques in the place of the commands; the row ``wanted`` keeps those."""
        for robot, loop in enumerate(self._of("wheel_loop")):
            if arrays.kinds[robot, 0] == TORQUE:
                continue
            _, hold = drivers.delays_of(self._given(arrays, settings)[0], 0, robot, settings.dt)
            row = "wanted_before" if substep < hold else "wanted"
            wanted = arrays.rows(row)[:, robot, 0].copy()
            sensors = arrays.named("sensors")
            measured = np.array([sensors.speed_l[robot, 0], sensors.speed_r[robot, 0]])
            torques = finite(
                loop.torque(wanted, measured), 2, f"robot_{robot}: the wheel loop's torque()"
            )
            arrays.rows("command")[:, robot, 0] = torques * MILLINEWTON_PER_NEWTON

    def estimate(self, arrays: Arrays, substep: int, settings: Settings) -> None:
        """Estimators: update with the readings of a substep, and hand on what they return."""
        estimators = self._of("estimator")
        if not estimators:
            return
        if substep == 0:
            self._holds = [
                drivers.delays_of(self._given(arrays, settings)[0], 0, robot, settings.dt)[1]
                for robot in range(len(estimators))
            ]
            self._odometry, self._moved = np.zeros((2, 2, len(estimators)))
        estimates, slips, traces = (arrays.rows(name) for name in ("estimate", "slip", "trace"))
        for robot, estimator in enumerate(estimators):
            readings = self._readings(arrays, substep, robot, settings)
            result = checked_estimate(
                estimator.update(readings), f"robot_{robot}: the estimator's update()"
            )
            estimates[:3, robot, 0] = result.pose
            estimates[3:, robot, 0] = result.covariance[COVARIANCE]
            slips[SLIP, robot, 0] = result.slip
            odometry = traces[ODOMETRY, robot, 0]
            if result.twist is None:
                self._moved[:, robot] += odometry - self._odometry[:, robot]
                self._moved[:, robot] += result.slip * settings.dt
            else:
                self._moved[:, robot] += result.twist * settings.dt
            self._odometry[:, robot] = odometry
            # The engine's sums lack the twist, and have the slip of the substep before.
            traces[MOVED, robot, 0] = self._moved[:, robot]
            traces[NIS, robot, 0] += result.nis

    def _readings(self, arrays: Arrays, substep: int, robot: int, settings: Settings) -> Readings:
        """What a robot's estimator receives of a substep."""
        sample = Sample(*arrays.samples[substep, :, robot, 0].tolist())
        tick = int(arrays.clock[0, 1]) * settings.substeps + substep + 1
        t_s = tick * settings.dt
        has_fix = sample.has_fix > 0.0
        wanted = np.zeros(2)
        if arrays.kinds[robot, 0] != TORQUE:
            row = "wanted_before" if substep < self._holds[robot] else "wanted"
            wanted = arrays.rows(row)[:, robot, 0].copy()
        return Readings(
            t_s=t_s,
            steps_rad=np.array([sample.step_l, sample.step_r]) * self._radii[robot],
            fix_mm=np.array([sample.fix_x, sample.fix_y]) if has_fix else None,
            fix_t_s=t_s - sample.fix_age if has_fix else None,
            gyro_rad_s=sample.gyro,
            wanted_rad_s=wanted,
            torques_Nmm=np.array([sample.torque_l, sample.torque_r]) / MILLINEWTON_PER_NEWTON,
        )

    def observe(self, arrays: Arrays, settings: Settings) -> None:
        """Observers: the followers' next references."""
        for robot in range(1, len(self._robots)):
            self._observe_one(arrays, settings, robot, int(arrays.clock[0, 1]) + settings.lookahead)

    def _observe_one(self, arrays: Arrays, settings: Settings, robot: int, step: int) -> None:
        given, numbers = self._given(arrays, settings)
        message = drivers.delayed_message_of(given, 0, robot, step, numbers)
        reference = self._made["observer"][robot].update(message, step * settings.period)
        row = finite(reference, 5, f"robot_{robot}: the observer's update()")
        arrays.references[:, step % arrays.references.shape[1], robot, 0] = row
