"""Estimators, wheel loops and observers written in Python, called between the halves of each substep."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from tlf_env.engine import drivers
from tlf_env.engine.arrays import Arrays
from tlf_env.engine.layout import Sample
from tlf_env.engine.settings import Settings
from tlf_env.onboard.parts import Factory, finite, load_part, make_part
from tlf_env.physics.units import MILLINEWTON_PER_NEWTON
from tlf_env.task.actions import TORQUE
from tlf_env.task.scenario import Scenario

STEPS = [Sample._fields.index("step_l"), Sample._fields.index("step_r")]
FIXES = [Sample._fields.index("fix_x"), Sample._fields.index("fix_y")]


def part_factories(scenario: Scenario, at_hand: Mapping[str, Factory]) -> dict[str, Factory]:
    """Factories of the parts that a scenario names; those not in ``at_hand`` are imported.

    Raises
    ------
    ValueError
        for a part that cannot be imported.
    """
    return {
        role: at_hand.get(role) or load_part(path) for role, path in scenario.part_paths.items()
    }


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

    def reset(self, arrays: Arrays, settings: Settings) -> None:
        """Make all parts again and start them; observers run ahead by the preview.

        Raises
        ------
        ValueError
            for a factory that makes no part of its role.
        """
        self._made = {
            role: [
                make_part(role, self._names[role], factory, robot, self._periods[role])
                for robot in self._robots
            ]
            for role, factory in self._factories.items()
        }
        starts = arrays.rows("start")[:, :, 0]
        for estimator, pose in zip(self._of("estimator"), starts.T, strict=False):
            estimator.reset(pose.copy())
        for loop in self._of("wheel_loop"):
            loop.reset()
        for robot, observer in enumerate(self._of("observer")):
            if robot > 0:
                observer.reset(starts[:, robot].copy())
                for step in range(settings.lookahead + 1):
                    self._observe_one(arrays, settings, robot, step)

    def _of(self, role: str) -> list[Any]:
        return self._made.get(role, [])

    def drive(self, arrays: Arrays, substep: int, settings: Settings) -> None:
        """Wheel loops: put torques in the place of the commands; the row ``wanted`` keeps those."""
        for robot, loop in enumerate(self._of("wheel_loop")):
            if arrays.kinds[robot, 0] == TORQUE:
                continue
            _, hold = drivers.delays_of(arrays, 0, robot, settings.dt)
            row = "wanted_before" if substep < hold else "wanted"
            wanted = arrays.rows(row)[:, robot, 0].copy()
            sensors = arrays.named("sensors")
            measured = np.array([sensors.speed_l[robot, 0], sensors.speed_r[robot, 0]])
            torques = finite(
                loop.torque(wanted, measured), 2, f"robot_{robot}: the wheel loop's torque()"
            )
            arrays.rows("command")[:, robot, 0] = torques * MILLINEWTON_PER_NEWTON

    def estimate(self, arrays: Arrays, substep: int) -> None:
        """Estimators: update with the readings of a substep."""
        for robot, estimator in enumerate(self._of("estimator")):
            sample = arrays.samples[substep, :, robot, 0]
            pose = estimator.update(sample[STEPS], sample[FIXES])
            estimate = arrays.rows("estimate")
            estimate[:3, robot, 0] = finite(pose, 3, f"robot_{robot}: the estimator's update()")

    def observe(self, arrays: Arrays, settings: Settings) -> None:
        """Observers: the followers' next references."""
        for robot in range(1, len(self._robots)):
            self._observe_one(arrays, settings, robot, int(arrays.clock[0, 1]) + settings.lookahead)

    def _observe_one(self, arrays: Arrays, settings: Settings, robot: int, step: int) -> None:
        message = drivers.delayed_message_of(arrays, 0, robot, step, settings)
        reference = self._made["observer"][robot].update(message, step * settings.period)
        row = finite(reference, 5, f"robot_{robot}: the observer's update()")
        arrays.references[:, step % arrays.references.shape[1], robot, 0] = row
