"""One episode of one or more formations: plant, onboard stack and task, advanced one control step at a time."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pymunk

from tlf_env.physics.pymunk_plant import PymunkPlant
from tlf_env.physics.state import Motion
from tlf_env.task import drivers
from tlf_env.task.arrays import Arrays, make_arrays
from tlf_env.task.measures import TIME_GAP_WINDOW_S
from tlf_env.task.scenario import Scenario
from tlf_env.task.trajectories import sample

ACTION_KINDS = {"twist": drivers.TWIST, "wheel_speed": drivers.WHEEL_SPEED}


def reference_table(scenario: Scenario) -> np.ndarray:
    """The leader's reference at every control step of an episode and of its preview, (step, 5)."""
    steps = scenario.horizon_steps + max(scenario.preview_steps, default=0) + 1
    return sample(scenario.trajectory, np.arange(steps) * scenario.control_period_s)


# What each entry of State is divided by in the interface.
STATE_SCALES = np.array(
    [1000.0, 1000.0, 1.0, 1.0, 1.0, 500.0, 500.0, 2.0, 10.0, 10.0, 1000.0, 1000.0]
)


class Formation:
    """State of one formation on the ``pymunk`` or ``kinematic`` plant.

    Units: mm, s, rad; arrays are views that the next step overwrites.
    """

    def __init__(self, scenario: Scenario) -> None:
        self.scenario = scenario
        self.arrays: Arrays = make_arrays(scenario, reference_table(scenario))
        self.plant = PymunkPlant([scenario.robot] * scenario.robots)
        self._settings = drivers.Settings(
            kind=ACTION_KINDS[scenario.action],
            kinematic=scenario.plant == "kinematic",
            substeps=scenario.substeps,
            dt=scenario.physics_period_s,
            period=scenario.control_period_s,
            gap=scenario.gap_steps,
            lookahead=max(scenario.preview_steps, default=0),
            window=round(TIME_GAP_WINDOW_S / scenario.control_period_s),
            observer_gain=scenario.observer.gain_per_s,
            smoothing=scenario.observer.smoothing_s,
            lost_beyond=scenario.lost_beyond_mm,
        )

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

    def reset(self, seed: int, episode: int = 0) -> None:
        """Put all robots at their start, at rest, and take the first observation."""
        a, s = self.arrays, self.scenario
        for state in (a.motions, a.contacts, a.loop_states, a.sensors, a.estimates, a.traces):
            state[:] = 0.0
        for state in (a.actions, a.last_actions, a.infos):
            state[:] = 0.0
        for flags in (a.lost, a.touched, a.lost_now, a.touched_now):
            flags[:] = False
        a.clock[0] = 0, 0, episode
        a.seeds[0] = seed
        poses = start_poses(s, a.table[0])
        for r, (x_mm, y_mm, theta) in enumerate(poses):
            self._place(r, x_mm, y_mm, theta)
        self.plant.reset()
        drivers.begin(a, 0, self._settings)

    def _place(self, r: int, x_mm: float, y_mm: float, theta: float) -> None:
        a, d = self.arrays, self.scenario.robot.com_offset_mm
        a.motions[:4, r, 0] = x_mm + d * np.sin(theta), y_mm - d * np.cos(theta), theta, theta
        a.estimates[:3, r, 0] = x_mm, y_mm, theta
        a.observers[:, r, 0] = x_mm, y_mm, theta

    def step(self) -> None:
        """Advance one control step with ``arrays.actions``.

        Raises
        ------
        ValueError
            for an action that is not finite, naming the robot; then nothing has changed.
        """
        a = self.arrays
        result = drivers.control_step(a, self._settings)
        if result == drivers.MUST_COLLIDE:
            self._advance_through_space()
            drivers.conclude(a, self._settings)
        elif result != drivers.DONE:
            raise ValueError(
                f"robot_{result}: the action must be finite, got {a.actions[0, result].tolist()}"
            )

    def _advance_through_space(self) -> None:
        a, dt_s = self.arrays, self.scenario.physics_period_s
        for _ in range(self.scenario.substeps):
            before = a.motions.copy()
            drivers.actuate(a, False, dt_s)
            self.plant.collide(before, a.motions, dt_s)
            drivers.sense(a, dt_s)

    def state(self) -> np.ndarray:
        """The truth, (robot, :class:`State`), in physical units."""
        return state_rows(self.arrays)


def start_poses(scenario: Scenario, first: Sequence[float] | np.ndarray) -> np.ndarray:
    """Pose of c of every robot at t = 0, (robot, 3): the leader on its reference, the others behind it.

    The followers stand ``start_spacing_mm`` apart on the tangent, with the leader's heading.
    """
    x_mm, y_mm, theta = first[0], first[1], first[2]
    behind = scenario.start_spacing_mm * np.arange(scenario.robots)
    return np.stack(
        [
            x_mm + behind * np.sin(theta),
            y_mm - behind * np.cos(theta),
            np.full(scenario.robots, theta),
        ],
        axis=-1,
    )


def state_rows(a: Arrays) -> np.ndarray:
    """True state of lane 0, (robot, :class:`State`)."""
    m = Motion(*a.motions[:, :, 0])
    d = a.bodies[drivers.BODY_D, :, 0]
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
