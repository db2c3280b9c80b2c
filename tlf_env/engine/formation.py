"""One episode of one or more formations: plant, onboard stack and task, advanced one control step at a time."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import pymunk

from tlf_env.disturbances.channels import (
    CHANNELS,
    PATHS,
    PAYLOAD_BEHIND,
    PAYLOAD_MASS,
    START_POSITION,
    STEP_CHANNELS,
)
from tlf_env.engine import drivers
from tlf_env.engine.excerpt import empty_excerpt
from tlf_env.engine.judging import BODY_D
from tlf_env.engine.layout import Arrays, Variants, make_arrays, make_variants
from tlf_env.engine.outside_parts import Parts, part_factories
from tlf_env.engine.settings import settings
from tlf_env.engine.starting import OFF_BASE, START_ATTEMPTS, STARTED
from tlf_env.onboard.parts import Factory
from tlf_env.physics.pymunk_plant import PymunkPlant
from tlf_env.physics.vehicle import Body, Motion
from tlf_env.task.scenario import Scenario
from tlf_env.task.trajectories import sample


def reference_table(scenario: Scenario, phase_s: float = 0.0) -> np.ndarray:
    """The leader's reference at every control step of an episode and of its preview, (step, 5)."""
    steps = scenario.horizon_steps + max(scenario.preview_steps, default=0) + 1
    return sample(scenario.trajectory, phase_s + np.arange(steps) * scenario.control_period_s)


# What each entry of State is divided by in the interface.
STATE_SCALES = np.array(
    [1000.0, 1000.0, 1.0, 1.0, 1.0, 500.0, 500.0, 2.0, 10.0, 10.0, 1000.0, 1000.0]
)


ALONE = np.ones(1, dtype=np.bool_)
NO_POSES = np.zeros((0, 3))


class Formation:
    """State of one formation on any plant.

    Units: mm, s, rad; arrays are views that the next step overwrites. ``parts`` gives factories for
    the ``estimator``, ``wheel_loop`` or ``observer`` that the scenario names, where they are at hand
    as objects; the rest is imported by name.
    """

    def __init__(self, scenario: Scenario, parts: Mapping[str, Factory] | None = None) -> None:
        self.scenario = scenario
        self._table = reference_table(scenario)
        self.arrays: Arrays = make_arrays([scenario], self._table)
        self._variants = make_variants([scenario])
        self.plant = PymunkPlant(list(scenario.robot_models))
        self._parts = Parts(part_factories(scenario, parts or {}), scenario)
        self._settings = settings(scenario)
        self._left = drivers.lanes_to_step(0, 1)
        self._nothing = empty_excerpt(self.arrays, 0, 0)

    @property
    def time_s(self) -> float:
        """Time since the start of the episode."""
        return float(self.arrays.clock[0, 1] * self.scenario.control_period_s)

    @property
    def step_count(self) -> int:
        """Control steps since the start of the episode."""
        return int(self.arrays.clock[0, 1])

    @property
    def space(self) -> pymunk.Space:
        """The pymunk space with the bodies where they are now."""
        return self.plant.space(self.arrays.motions)

    def reset(
        self,
        seed: int,
        episode: int = 0,
        poses: np.ndarray | None = None,
        phase_s: float = 0.0,
    ) -> None:
        """Put all robots at their start, at rest, and take the first observation.

        ``poses`` ``(robot, 3)`` (mm, mm, rad) replaces the start poses of c; ``phase_s`` starts the
        leader's reference that much later on its trajectory.
        """
        a, s = self.arrays, self._settings
        a.clock[0], a.seeds[0] = (0, 0, episode), seed
        a.table[:] = reference_table(self.scenario, phase_s) if phase_s else self._table
        result, r, _ = drivers.start(
            a, self._variants, ALONE, NO_POSES if poses is None else poses, s
        )
        if result != STARTED:
            raise ValueError(refusal(a, self._variants, result, r))
        self.plant.reset(a.bodies[:, :, 0])
        self._parts.reset(a, s)
        drivers.look(a, ALONE, True, s)

    def impose(self, values: Mapping[str, float | np.ndarray]) -> None:
        """Set channels for the coming control step: ``{path: value or one per robot}``.

        Raises
        ------
        ValueError
            for an unknown channel, one that cannot change within an episode, or a value out of range.
        """
        a, robots = self.arrays, self.scenario.robot_count
        if not self.scenario.adversary:
            raise ValueError(
                "channels can be set within an episode only if the scenario has adversary: true"
            )
        a.imposed[:] = np.nan
        for path, value in values.items():
            if path not in PATHS[:STEP_CHANNELS]:
                raise ValueError(
                    f"channel {path!r} cannot be set within an episode; there are "
                    f"{', '.join(PATHS[:STEP_CHANNELS])}"
                )
            channel = CHANNELS[PATHS.index(path)]
            high = channel.high
            if path == "actuator.computing_delay_s":
                high = min(high, self.scenario.control_period_s)
            row = np.asarray(value, dtype=np.float64)
            if row.shape not in ((), (robots,)):
                raise ValueError(
                    f"{path} must be a number or one per robot ({robots}), got {value!r}"
                )
            if not ((row >= channel.low) & (row <= high)).all():
                raise ValueError(
                    f"{path} {value!r} is out of its range, {channel.low:g} to {high:g}"
                )
            a.imposed[PATHS.index(path), :, 0] = row

    def applied(self) -> np.ndarray:
        """The channels' last values, (robot, channel), channels as in ``PATHS``."""
        return self.arrays.applied[:, :, 0].T

    def step(self) -> None:
        """Advance one control step with ``arrays.actions``.

        Raises
        ------
        ValueError
            for an action that is not finite, naming the robot; then nothing has changed.
        """
        a, s = self.arrays, self._settings
        self._left[0] = 0
        result = drivers.control_step(a, self._left, self._nothing, s)
        if result == drivers.DONE:
            return
        if result >= 0:
            raise ValueError(
                f"robot_{result}: the action must be finite, got {a.actions[0, result].tolist()}"
            )
        self._substep_by_substep(close=result == drivers.MUST_COLLIDE)
        drivers.transmit(a, 0, s)
        drivers.refer(a, 0, 0, 1 if s.external_observer else self.scenario.robot_count, s)
        if s.external_observer:
            self._parts.observe(a, s)
        drivers.look(a, ALONE, False, s)

    def _substep_by_substep(self, close: bool) -> None:
        a, s = self.arrays, self._settings
        for k in range(s.substeps):
            self._parts.drive(a, k, s)
            before = a.motions.copy() if close else a.motions
            drivers.actuate(a, 0, k, s)
            if close:
                self.plant.collide(before, a.motions, s.dt)
            drivers.sense(a, 0, k, s)
            self._parts.estimate(a, k)

    def state(self) -> np.ndarray:
        """The truth, (robot, :class:`State`), in physical units."""
        return state_rows(self.arrays)[0]


def refusal(a: Arrays, of: Variants, result: int, r: int, lane: int = 0) -> str:
    """Why a lane could not start, in one line."""
    if result == OFF_BASE:
        mass, behind = a.applied[PAYLOAD_MASS, r, lane], a.applied[PAYLOAD_BEHIND, r, lane]
        laden, empty = Body(*a.bodies[:, r, lane]), Body(*of.bodies[:, r, a.variants[lane]])
        return (
            f"payload of {mass:g} kg at {behind:g} mm puts the centre of mass {laden.d:g} mm behind "
            f"the axle; the wheels carry it from 0 to {empty.pivot + empty.T:g} mm"
        )
    return (
        f"robot_{r}: no start pose without overlap in {START_ATTEMPTS} draws with "
        f"start.position_std_mm {a.applied[START_POSITION, r, lane]:g}; it leaves too little room"
    )


def state_rows(a: Arrays) -> np.ndarray:
    """True state, (lane, robot, :class:`State`), in physical units."""
    lanes = a.clock.shape[0]
    m = Motion(*a.motions[:, :, :lanes])
    d = a.bodies[BODY_D, :, :lanes]
    sin, cos = np.sin(m.theta), np.cos(m.theta)
    slots = (a.clock[:, 1] % a.references.shape[1])[None, None, :]
    x, y = np.take_along_axis(a.references[:2, :, :, :lanes], slots[None], axis=1)[:, 0]
    rows = [
        m.x - d * sin,
        m.y + d * cos,
        sin,
        cos,
        np.remainder(m.psi - m.theta + np.pi, 2 * np.pi) - np.pi,
        -m.v_x * sin + m.v_y * cos,
        m.v_x * cos + m.v_y * sin - m.w * d,
        m.w,
        m.omega_l,
        m.omega_r,
        x,
        y,
    ]
    return np.stack(rows, axis=-1).transpose(1, 0, 2)
