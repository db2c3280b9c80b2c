"""One episode of one or more formations: plant, onboard stack and task, advanced one control step at a time."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np
import pymunk

from tlf_env.onboard.parts import Factory
from tlf_env.physics.parameters import body
from tlf_env.physics.pymunk_plant import PymunkPlant
from tlf_env.physics.state import Motion
from tlf_env.task import drivers
from tlf_env.task.arrays import Arrays, make_arrays
from tlf_env.task.channels import (
    CHANNELS,
    PATHS,
    PAYLOAD_BEHIND,
    PAYLOAD_INERTIA,
    PAYLOAD_MASS,
    START_HEADING,
    START_POSE,
    START_POSITION,
    STEP_CHANNELS,
)
from tlf_env.task.disturbance import loaded_body
from tlf_env.task.judging import BODY_D
from tlf_env.task.outlines import BODY_AHEAD, BODY_OUTLINE
from tlf_env.task.parts import Parts, part_factories
from tlf_env.task.scenario import START_MARGIN_MM, Scenario
from tlf_env.task.settings import settings
from tlf_env.task.trajectories import sample


def reference_table(scenario: Scenario, phase_s: float = 0.0) -> np.ndarray:
    """The leader's reference at every control step of an episode and of its preview, (step, 5)."""
    steps = scenario.horizon_steps + max(scenario.preview_steps, default=0) + 1
    return sample(scenario.trajectory, phase_s + np.arange(steps) * scenario.control_period_s)


# What each entry of State is divided by in the interface.
STATE_SCALES = np.array(
    [1000.0, 1000.0, 1.0, 1.0, 1.0, 500.0, 500.0, 2.0, 10.0, 10.0, 1000.0, 1000.0]
)


PAYLOAD = [PAYLOAD_MASS, PAYLOAD_BEHIND, PAYLOAD_INERTIA]
START_ATTEMPTS = 1000


class Formation:
    """State of one formation on the ``pymunk`` or ``kinematic`` plant.

    Units: mm, s, rad; arrays are views that the next step overwrites. ``parts`` gives factories for
    the ``estimator``, ``wheel_loop`` or ``observer`` that the scenario names, where they are at hand
    as objects; the rest is imported by name.
    """

    def __init__(self, scenario: Scenario, parts: Mapping[str, Factory] | None = None) -> None:
        self.scenario = scenario
        self._table = reference_table(scenario)
        self.arrays: Arrays = make_arrays(scenario, self._table)
        self.plant = PymunkPlant(list(scenario.robot_models))
        self._factories = part_factories(scenario, parts or {})
        self._parts = Parts(self._factories, scenario)
        self._settings = settings(scenario)
        self._loaded = False

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
        a, s = self.arrays, self.scenario
        for state in (
            a.motions,
            a.contacts,
            a.loop_states,
            a.sensors,
            a.estimates,
            a.slip_estimates,
            a.traces,
        ):
            state[:] = 0.0
        for state in (a.actions, a.last_actions, a.infos, a.samples):
            state[:] = 0.0
        for flags in (a.lost, a.touched, a.lost_now, a.touched_now):
            flags[:] = False
        a.clock[0] = 0, 0, episode
        a.seeds[0] = seed
        a.table[:] = reference_table(s, phase_s) if phase_s else self._table
        for state in (a.processes, a.torques, a.wanted, a.wanted_before):
            state[:] = 0.0
        a.dropped[:] = False
        a.imposed[:] = np.nan
        drivers.draw_episode(a, 0, self._settings)
        self._load()
        poses = scattered(a, start_poses(s, a.table[0])) if poses is None else poses
        for r, pose in enumerate(poses):
            self._place(r, *pose)
        self.plant.reset(a.bodies[:, :, 0])
        drivers.begin(a, 0, self._settings)
        self._parts.reset(a, self._settings)
        drivers.look(a, self._settings)
        for flags in (a.lost, a.lost_now):  # who starts lost is lost in the first step
            flags[:] = False

    def _load(self) -> None:
        """Put the payloads on."""
        a = self.arrays
        for r, robot in enumerate(self.scenario.robot_models):
            payload = a.applied[PAYLOAD, r, 0]
            if payload[0] > 0:
                a.bodies[:, r, 0] = loaded_body(robot, payload)
            elif self._loaded:
                a.bodies[:, r, 0] = body(robot)
        self._loaded = bool((a.applied[PAYLOAD[0]] > 0).any())

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

    def _place(self, r: int, x_mm: float, y_mm: float, theta: float) -> None:
        a, d = self.arrays, self.arrays.bodies[BODY_D, r, 0]
        a.motions[:4, r, 0] = x_mm + d * np.sin(theta), y_mm - d * np.cos(theta), theta, theta
        a.estimates[:3, r, 0] = x_mm, y_mm, theta
        a.observers[:, r, 0] = x_mm, y_mm, theta
        a.starts[:, r, 0] = x_mm, y_mm, theta

    def step(self) -> None:
        """Advance one control step with ``arrays.actions``.

        Raises
        ------
        ValueError
            for an action that is not finite, naming the robot; then nothing has changed.
        """
        a, s = self.arrays, self._settings
        if not self._parts:
            result = drivers.control_step(a, s)
            if result == drivers.DONE:
                return
        else:
            result = drivers.prepare(a, s)
        if result not in (drivers.DONE, drivers.MUST_COLLIDE):
            raise ValueError(
                f"robot_{result}: the action must be finite, got {a.actions[0, result].tolist()}"
            )
        self._substep_by_substep(close=result == drivers.MUST_COLLIDE)
        drivers.transmit(a, s)
        if s.external_observer:
            self._parts.observe(a, s)
        else:
            drivers.observe_followers(a, s)
        drivers.look(a, s)

    def _substep_by_substep(self, close: bool) -> None:
        a, s = self.arrays, self._settings
        for k in range(s.substeps):
            self._parts.drive(a, k, s)
            before = a.motions.copy() if close else a.motions
            drivers.actuate(a, k, s)
            if close:
                self.plant.collide(before, a.motions, s.dt)
            drivers.sense(a, k, s)
            self._parts.estimate(a, k)

    def state(self) -> np.ndarray:
        """The truth, (robot, :class:`State`), in physical units."""
        return state_rows(self.arrays)


def start_poses(scenario: Scenario, first: Sequence[float] | np.ndarray) -> np.ndarray:
    """Pose of c of every robot at t = 0, (robot, 3): the leader on its reference, the others behind it.

    The followers stand ``start_spacing_mm`` apart on the tangent, with the leader's heading.
    """
    x_mm, y_mm, theta = first[0], first[1], first[2]
    behind = scenario.start_spacing_mm * np.arange(scenario.robot_count)
    return np.stack(
        [
            x_mm + behind * np.sin(theta),
            y_mm - behind * np.cos(theta),
            np.full(scenario.robot_count, theta),
        ],
        axis=-1,
    )


def scattered(a: Arrays, poses: np.ndarray) -> np.ndarray:
    """Start poses with the disturbance's scatter, each robot redrawn while its outline overlaps another's.

    Raises
    ------
    ValueError
        if there is no room after many tries.
    """
    if not a.applied[[START_POSITION, START_HEADING]].any():
        return poses
    out = poses.copy()
    for r in range(len(out)):
        spread = a.applied[START_POSITION, r, 0], a.applied[START_HEADING, r, 0]
        for attempt in range(START_ATTEMPTS):
            x, y = drivers.draw_normals(a, 0, START_POSE, r, 2 * attempt)
            turn, _ = drivers.draw_normals(a, 0, START_POSE, r, 2 * attempt + 1)
            out[r] = poses[r] + (spread[0] * x, spread[0] * y, spread[1] * turn)
            if all(_apart(a, out, r, other) for other in range(r)):
                break
        else:
            raise ValueError(
                f"robot_{r}: no start pose without overlap in {START_ATTEMPTS} draws with "
                f"start.position_std_mm {spread[0]:g}; it leaves too little room"
            )
    return out


def _apart(a: Arrays, poses: np.ndarray, i: int, j: int) -> bool:
    """Whether two robots' outlines are apart at given poses of c."""
    centres, room = [], 0.0
    for r in (i, j):
        ahead = a.bodies[BODY_AHEAD, r, 0] - a.bodies[BODY_D, r, 0]
        x_mm, y_mm, theta = poses[r]
        centres.append((x_mm - ahead * np.sin(theta), y_mm + ahead * np.cos(theta)))
        room += a.bodies[BODY_OUTLINE, r, 0]
    (x_i, y_i), (x_j, y_j) = centres
    return math.hypot(x_i - x_j, y_i - y_j) > room + START_MARGIN_MM


def state_rows(a: Arrays) -> np.ndarray:
    """True state of lane 0, (robot, :class:`State`)."""
    m = Motion(*a.motions[:, :, 0])
    d = a.bodies[BODY_D, :, 0]
    sin, cos = np.sin(m.theta), np.cos(m.theta)
    slot = a.clock[0, 1] % a.references.shape[1]
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
        a.references[0, slot, :, 0],
        a.references[1, slot, :, 0],
    ]
    return np.stack(rows, axis=-1)
