"""Where the user's parts meet the arrays: called in Python, between the halves of each substep."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from tlf_env.engine import drivers
from tlf_env.engine.layout import Arrays, Sample, Sensors
from tlf_env.engine.settings import Settings
from tlf_env.onboard.parts import Factory, finite, load_part, make_part
from tlf_env.physics.units import MILLINEWTON_PER_NEWTON
from tlf_env.task.actions import TORQUE
from tlf_env.task.scenario import Scenario

SPEEDS = [Sensors._fields.index("speed_l"), Sensors._fields.index("speed_r")]
STEPS = [Sample._fields.index("step_l"), Sample._fields.index("step_r")]
FIXES = [Sample._fields.index("fix_x"), Sample._fields.index("fix_y")]


def part_factories(scenario: Scenario, at_hand: Mapping[str, Factory]) -> dict[str, Factory]:
    """Factories of the parts that a scenario names; those not ``at_hand`` are imported.

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

    def reset(self, a: Arrays, s: Settings) -> None:
        """Make all parts anew and start them; observers run ahead by the preview.

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
        for estimator, pose in zip(self._of("estimator"), a.starts[:, :, 0].T, strict=False):
            estimator.reset(pose.copy())
        for loop in self._of("wheel_loop"):
            loop.reset()
        for r, observer in enumerate(self._of("observer")):
            if r > 0:
                observer.reset(a.starts[:, r, 0].copy())
                for m in range(s.lookahead + 1):
                    self._observe_one(a, s, r, m)

    def _of(self, role: str) -> list[Any]:
        return self._made.get(role, [])

    def drive(self, a: Arrays, k: int, s: Settings) -> None:
        """Wheel loops: put torques in the place of the commands that :attr:`Arrays.wanted` keeps."""
        for r, loop in enumerate(self._of("wheel_loop")):
            if a.kinds[r, 0] == TORQUE:
                continue
            _, hold = drivers.delays_of(a, 0, r, s.dt)
            wanted = (a.wanted_before if k < hold else a.wanted)[:, r, 0].copy()
            measured = a.sensors[SPEEDS, r, 0]
            torques = finite(
                loop.torque(wanted, measured), 2, f"robot_{r}: the wheel loop's torque()"
            )
            a.commands[:, r, 0] = torques * MILLINEWTON_PER_NEWTON

    def estimate(self, a: Arrays, k: int) -> None:
        """Estimators: update with the readings of substep ``k``."""
        for r, estimator in enumerate(self._of("estimator")):
            sample = a.samples[k, :, r, 0]
            pose = estimator.update(sample[STEPS], sample[FIXES])
            a.estimates[:3, r, 0] = finite(pose, 3, f"robot_{r}: the estimator's update()")

    def observe(self, a: Arrays, s: Settings) -> None:
        """Observers: the followers' next references."""
        for r in range(1, len(self._robots)):
            self._observe_one(a, s, r, int(a.clock[0, 1]) + s.lookahead)

    def _observe_one(self, a: Arrays, s: Settings, r: int, m: int) -> None:
        message = drivers.delayed_message_of(a, 0, r, m, s)
        reference = self._made["observer"][r].update(message, m * s.period)
        row = finite(reference, 5, f"robot_{r}: the observer's update()")
        a.references[:, m % a.references.shape[1], r, 0] = row
