"""One formation: plant, on-board stack and task, advanced one control step at a time."""

from __future__ import annotations

import functools
from collections.abc import Mapping
from typing import Any

import numpy as np
import pymunk

from tlf_env.common.errors import shown
from tlf_env.common.trust import Trust
from tlf_env.disturbances.channels import (
    CHANNELS,
    MOVING_OBSTACLE,
    PAYLOAD_BEHIND,
    PAYLOAD_MASS,
    SET_WITHIN_EPISODE,
    START_POSITION,
    number,
)
from tlf_env.engine import drivers, readout
from tlf_env.engine.arrays import (
    FLOOR_INPUT,
    PUSH_INPUT,
    Arrays,
    Variants,
    make_arrays,
    make_variants,
)
from tlf_env.engine.excerpt import empty_excerpt
from tlf_env.engine.layout import Traction, rows_of
from tlf_env.engine.outside_base import make_base
from tlf_env.engine.outside_parts import Parts, make_crews
from tlf_env.engine.settings import make_settings
from tlf_env.engine.snapshot import (
    Snapshot,
    array_numbers,
    checked_arrays,
    checked_snapshot,
    put_arrays,
    scenario_facts,
)
from tlf_env.engine.starting import IN_WALL, OFF_BASE, START_ATTEMPTS, STARTED
from tlf_env.numerics.compiled import compile_for
from tlf_env.numerics.pointers import packed
from tlf_env.onboard.observer import Reference
from tlf_env.onboard.parts import Factory, real_numbers
from tlf_env.physics.chipmunk_plant import ChipmunkPlant
from tlf_env.physics.pymunk_plant import (
    NO_CAPSULES,
    NO_OBJECTS,
    NO_OWNERS,
    OUT_OF_REACH,
    WITHIN_REACH,
    PymunkPlant,
)
from tlf_env.physics.vehicle import Body
from tlf_env.task.info import Info, TouchedBy
from tlf_env.task.scenario import Scenario
from tlf_env.task.start import Start
from tlf_env.task.trajectories import reference_from


def reference_table(scenario: Scenario, phase_s: float = 0.0) -> np.ndarray:
    """The leader's reference at every control step of an episode and of its preview, (step, 5)."""
    steps = scenario.horizon_steps + max(scenario.preview_steps, default=0) + 1
    t_s = np.arange(steps) * scenario.control_period_s
    return reference_from(scenario.trajectory, t_s, scenario.start_ramp_s, phase_s)


# Each entry of State is divided by its scale in the interface.
STATE_SCALES = np.array(
    [1000.0, 1000.0, 1.0, 1.0, 1.0, 500.0, 500.0, 2.0, 10.0, 10.0, 1000.0, 1000.0]
)
# No entry, so divided, is ever larger: a sine, an angle, and elsewhere far more than a model can reach.
STATE_LIMITS = np.array([1e12, 1e12, 1.0, 1.0, np.pi, 1e12, 1e12, 1e12, 1e12, 1e12, 1e12, 1e12])
STATE_ROUNDING_MM = 0.01  # of a position; float32 is not enough where it would round by more


def state_dtype(scenario: Scenario, path: np.ndarray) -> np.dtype:
    """The dtype of the scaled state: float32, unless the scenario or a ``path`` far away wants float64."""
    farthest = np.float32(np.abs(path).max() / STATE_SCALES[0])
    rounding_mm = float(np.spacing(farthest)) / 2 * STATE_SCALES[0]
    exact = scenario.dtype == "float64" or rounding_mm > STATE_ROUNDING_MM
    return np.dtype(np.float64 if exact else np.float32)


# What a body in the space is that a robot touched, by its type.
TOUCHED_BY = {
    pymunk.Body.DYNAMIC: int(TouchedBy.ROBOT),
    pymunk.Body.STATIC: int(TouchedBy.WALL),
    pymunk.Body.KINEMATIC: int(TouchedBy.OBSTACLE),
}
KIND = "Formation"
USUAL_START = Start(poses=None, phases_s=None)
ALONE = np.ones(1, dtype=np.bool_)
FIRST_LANE = np.zeros(1, dtype=np.int64)
NO_POSES = np.zeros((0, 0, 3))
DELIVERED = [Traction._fields.index(name) for name in ("delivered_l", "delivered_r")]


class Formation:
    """State of one formation on any plant.

    Units: mm, s, rad; arrays are views that the next step overwrites. ``parts`` gives factories for
    the ``estimator``, ``wheel_loop`` or ``observer`` that the scenario names, if they are given
    as objects; the others are imported by name, if ``trust`` allows it. ``base`` is the policy that
    ``residual_base`` names, if it is given as an object.
    """

    def __init__(
        self,
        scenario: Scenario,
        parts: Mapping[str, Factory] | None = None,
        base: Any = None,
        *,
        trust: Trust = False,
    ) -> None:
        self.scenario = scenario
        self._table = reference_table(scenario)
        self.arrays: Arrays = make_arrays([scenario], self._table)
        self._variants = make_variants([scenario])
        kind = ChipmunkPlant if scenario.plant == "chipmunk" else PymunkPlant
        self.plant = kind(scenario.robot_models, scenario.world, scenario.control_period_s)
        self._base = make_base(scenario, base, trust=trust)
        crews = make_crews(scenario, parts or {}, trust=trust)
        self._parts = Parts(crews, scenario.robot_count)
        self._settings = make_settings(scenario)
        self._packed = packed(self._settings)
        # Settings of a step that goes substep by substep though no part is outside.
        self._by_substep = packed(self._settings._replace(has_parts=True))
        self._packed_arrays, self._packed_of = packed(self.arrays), self.arrays
        self._compiled = False
        self._has_rays = scenario.rays is not None
        self._phase_s = 0.0  # of the leader's reference in this episode
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
        return self.plant.space(self.arrays.rows("motion"), self.step_count)

    def reset(
        self,
        seed: int,
        episode: int = 0,
        start: Start = USUAL_START,
    ) -> None:
        """Put all robots at their start, at rest, and take the first observation.

        ``start`` may replace the start poses of c, and start the leader's reference later on its
        trajectory.
        """
        if not self._compiled:
            self._compile()
        arrays, settings = self.arrays, self._settings
        arrays.clock[0], arrays.seeds[0] = (0, 0, episode, self.scenario.horizon_steps), seed
        self._follow_from(0.0 if start.phases_s is None else float(start.phases_s[0]))
        poses = NO_POSES if start.poses is None else start.poses
        result, robot, _ = drivers.start(self._given(), self._variants, ALONE, poses, self._packed)
        if result != STARTED:
            raise ValueError(refusal(arrays, self._variants, result, robot))
        offsets_s = [
            lap_s * drivers.uniform(seed, MOVING_OBSTACLE, i, episode)
            for i, lap_s in enumerate(self.plant.mover_laps_s)
        ]
        self.plant.reset(arrays.rows("body")[:, :, 0], offsets_s)
        self._parts.reset(arrays, settings)
        self._do(drivers.LOOK_AT_START)
        if self._has_rays:
            self._look_at_objects()

    def _follow_from(self, phase_s: float) -> None:
        """Let the leader follow its trajectory from a time on."""
        table = reference_table(self.scenario, phase_s) if phase_s else self._table
        self.arrays.tables[0] = table
        self._phase_s = phase_s

    def get_state(self) -> Snapshot:
        """Everything that the next steps depend on; :meth:`set_state` goes back to it, bit for bit.

        The formation goes on as if it had not been asked.

        Raises
        ------
        RuntimeError
            before the first :meth:`reset`.
        ValueError
            in one line that names it, for a part or a policy whose state cannot be read: see
            :mod:`tlf_env.onboard.memory`.
        """
        if not self.arrays.clock[0, 3]:
            raise RuntimeError("call reset() before get_state()")
        numbers = array_numbers(self.arrays)
        memory = {"phase_s": self._phase_s, "parts": self._parts.get_state(numbers)}
        if self._base is not None:
            memory["base"] = self._base.get_state(numbers)
        numbers |= {f"space/{name}": array for name, array in self.plant.get_state().items()}
        return Snapshot(KIND, self._facts(), memory, numbers)

    def close(self) -> None:
        """End the processes in which parts and policies run, if any; the next :meth:`reset` starts new ones."""
        self._parts.close()
        if self._base is not None:
            self._base.close()

    def _facts(self) -> dict[str, Any]:
        """What must be equal where a snapshot is put back."""
        return {"scenario": self._scenario_facts, "space": self.plant.structure()}

    @functools.cached_property
    def _scenario_facts(self) -> dict[str, Any]:
        return scenario_facts(self.scenario)

    def set_state(self, state: Snapshot) -> None:
        """Go back to a moment of this formation, or of another one of the same scenario.

        Objects that a user has added to the space must be there, in the same order; they go back, too.
        Parts in Python are made again and get their states.

        Raises
        ------
        TypeError
            for anything but a :class:`~tlf_env.engine.snapshot.Snapshot`.
        ValueError
            in one line that names the first difference, for a state that does not fit, or that is damaged.
            Then nothing has changed, unless the ``set_state`` of a policy raised an error.
        """
        checked_snapshot(state).check(KIND, {})
        self.restore(state)

    def restore(self, state: Snapshot) -> None:
        """:meth:`set_state` of a snapshot that contains that of a formation."""
        state.check(state.kind, self._facts())
        if not self._compiled:
            self._compile()
        arrays, phase_s = self.arrays, state.tree("phase_s")
        if not isinstance(phase_s, float):
            raise ValueError(f"the snapshot is damaged: its phase is {shown(phase_s)}")
        found = checked_arrays(state, arrays, self._variants, self.scenario, (1, 1), ALONE)
        space = state.part("space", self.plant.state_layout())
        try:
            self.plant.check_state(space)
        except ValueError as error:
            raise ValueError(f"the snapshot is damaged: {error}") from error
        self._parts.restored(
            state.tree("parts"), state.numbers, found["constants"], found["states"]
        )
        if self._base is not None:
            self._base.set_state(state.tree("base"), state.numbers)
        put_arrays(arrays, found)
        self._follow_from(phase_s)
        self.plant.set_state(space, arrays.rows("body")[:, :, 0])
        self._parts.go_on()

    def impose(self, values: Mapping[str, float | np.ndarray]) -> None:
        """Set channels for the coming control step: ``{path: value or one per robot}``.

        Raises
        ------
        ValueError
            for anything but a mapping, an unknown channel, one that cannot change within an episode, a
            value out of range, or creep on the plant ``chipmunk``.
        """
        arrays, robots = self.arrays, self.scenario.robot_count
        if not self.scenario.adversary:
            raise ValueError(
                "channels can be set within an episode only if the scenario has adversary: true"
            )
        if not isinstance(values, Mapping):
            raise ValueError(
                "the adversary must return a mapping of channels, {path: value or one per robot}, "
                f"got {shown(values)}"
            )
        arrays.imposed[:] = np.nan
        for path, value in values.items():
            if path not in SET_WITHIN_EPISODE:
                raise ValueError(
                    f"channel {shown(path)} cannot be set within an episode; there are "
                    f"{', '.join(SET_WITHIN_EPISODE)}"
                )
            channel = CHANNELS[number(path)]
            high = channel.high
            if path == "actuator.computing_delay_s":
                high = min(high, self.scenario.control_period_s)
            row = real_numbers(value)
            if row is None or row.shape not in ((), (robots,)):
                raise ValueError(
                    f"{path} must be a number or one per robot ({robots}), got {shown(value)}"
                )
            if not ((row >= channel.low) & (row <= high)).all():
                raise ValueError(
                    f"{path} {shown(value)} is out of its range, {channel.low:g} to {high:g}"
                )
            if path == "tyre.creep" and self.scenario.plant == "chipmunk" and row.any():
                raise ValueError(
                    f"{path} {shown(value)} needs plant 'pymunk'; the tyres of 'chipmunk' do not creep"
                )
            arrays.imposed[number(path), :, 0] = row

    def applied(self) -> np.ndarray:
        """The channels' last values, (robot, channel), channels as in ``PATHS``."""
        return self.arrays.applied[:, :, 0].T

    def step(self) -> None:
        """Advance one control step with ``arrays.actions``.

        Raises
        ------
        ValueError
            for an action that is not finite, naming the robot; for objects in the space that could act on
            a robot, on a plant without contact. Then nothing has changed.
        """
        arrays, settings = self.arrays, self._settings
        if self._base is not None and np.isfinite(arrays.actions).all():
            self._base.command(arrays)
        objects, step = NO_OBJECTS, 0
        if self.plant.occupied:
            step = self.step_count
            objects = self.plant.objects(arrays.rows("motion"), step)
            if objects != NO_OBJECTS and not settings.collides:
                raise ValueError(
                    f"plant {self.scenario.plant!r} has no contact: objects in the space need plant 'pymunk'"
                )
        self._left[0] = 0
        by_substep = objects == WITHIN_REACH and not settings.has_parts
        given = self._by_substep if by_substep else self._packed
        result = drivers.control_step(
            self._given(), self._left, self._nothing, drivers.WHOLE, 0, given
        )
        if objects == OUT_OF_REACH and result in (drivers.DONE, drivers.MUST_SUBSTEP):
            self.plant.advance_objects(arrays.rows("motion"), step, settings.substeps, settings.dt)
        if result == drivers.DONE:
            if self._has_rays:
                self._look_at_objects()
            return
        if result >= 0:
            raise ValueError(
                f"robot_{result}: the action must be finite, got {arrays.actions[0, result].tolist()}"
            )
        try:
            self._substep_by_substep(
                close=result == drivers.MUST_COLLIDE or objects == WITHIN_REACH
            )
        finally:
            self.plant.release()
        referred = 1 if settings.external_observer else self.scenario.robot_count
        self._do(drivers.TRANSMIT, referred)
        if settings.external_observer:
            self._parts.observe(arrays, settings)
        self._do(drivers.LOOK)
        if self._has_rays:
            self._look_at_objects()

    def _compile(self) -> None:
        """Compile what an episode may need, or load it from the cache, so that none waits in its midst."""
        arrays, settings, chosen = self._given(), self._packed, self._settings
        nowhere = self._left, self._nothing
        compile_for(drivers.start, arrays, self._variants, ALONE, NO_POSES, settings)
        compile_for(drivers.control_step, arrays, *nowhere, drivers.WHOLE, 0, settings)
        if chosen.collides:
            compile_for(drivers.mark, arrays, 0, 0, 0)
        if isinstance(self.plant, ChipmunkPlant):
            compile_for(drivers.account, arrays, 0, settings)
            rows, inputs = self.arrays.rows, self.arrays.inputs
            floors = inputs[FLOOR_INPUT:PUSH_INPUT]
            self.plant.compile(rows("motion"), rows("contact"), floors, chosen.dt)
        if chosen.collides and self._has_rays:  # bodies may be put into the space at any time
            compile_for(drivers.cast_at, arrays, 0, NO_CAPSULES, NO_OWNERS, settings)
        if chosen.has_parts:
            compile_for(drivers.delays_of, arrays, 0, 0, chosen.dt)
            compile_for(drivers.delayed_message_of, arrays, 0, 0, 0, settings)
        self._compiled = True

    def _do(self, part: int, number: int = 0) -> None:
        """A part of a control step; see :func:`~tlf_env.engine.drivers.control_step`."""
        arrays = self._given()
        drivers.control_step(arrays, FIRST_LANE, self._nothing, part, number, self._packed)

    def _given(self) -> Arrays:
        """The arrays as drivers take them; packed again if others were put in their place."""
        if self._packed_of is not self.arrays:
            self._packed_arrays, self._packed_of = packed(self.arrays), self.arrays
        return self._packed_arrays

    def _look_at_objects(self) -> None:
        """Let the rays of the range sensors meet what only the space contains."""
        arrays, settings, step = self.arrays, self._settings, self.step_count
        if step % settings.ray_period:
            return
        capsules, owners = self.plant.visible(arrays.rows("motion"), step)
        if len(capsules):
            drivers.cast_at(self._given(), 0, capsules, owners, self._packed)

    def _substep_by_substep(self, close: bool) -> None:
        arrays, settings = self.arrays, self._settings
        motion = arrays.rows("motion")
        if close:
            self.plant.sort(motion, self.step_count)
        for substep in range(settings.substeps):
            self._parts.drive(arrays, substep, settings)
            before = motion.copy() if close else motion
            self._do(drivers.ACTUATE, substep)
            if isinstance(self.plant, ChipmunkPlant):
                inputs, contact = arrays.inputs, arrays.rows("contact")
                floors, pushes = inputs[FLOOR_INPUT:PUSH_INPUT], inputs[PUSH_INPUT:]
                self.plant.advance(motion, contact, inputs[DELIVERED], floors, settings.dt, pushes)
                drivers.account(self._given(), 0, self._packed)
            elif close:
                self.plant.collide(before, motion, settings.dt)
            self._do(drivers.SENSE, substep)
            for robot, body_type in self.plant.hits.items() if close else ():
                drivers.mark(self._given(), 0, robot, TOUCHED_BY[body_type])
            self._parts.estimate(arrays, substep, settings)
        if close:
            arrays.calm[0] = 0  # a contact may have changed velocities at once

    def state(self) -> np.ndarray:
        """The true state, (robot, :class:`~tlf_env.task.info.State`), in physical units."""
        return readout.state_rows(self.arrays)[0]

    def named(self, name: str) -> Any:
        """A row of the engine's table by name: its named tuple of arrays ``(robot,)``; views."""
        row = readout.named(self.arrays, name)
        return type(row)(*(field[0] for field in row))

    def info(self) -> Any:
        """:class:`~tlf_env.task.info.Info` of the last step, each field ``(robot,)``; views."""
        return Info(*(field[0] for field in readout.info(self.arrays)))

    def reference(self) -> Any:
        """:class:`~tlf_env.onboard.observer.Reference` of every robot now, each field ``(robot,)``."""
        return Reference(*(field[0] for field in readout.reference(self.arrays)))

    def true_positions(self, step: int) -> np.ndarray:
        """True position of c at a control step of the last gap, ``(2, robot)``, mm; a view."""
        return readout.true_positions(self.arrays, step)[:, 0]

    def leader_path(self) -> np.ndarray:
        """The leader's whole reference path, ``(step, 2)``, mm; a view."""
        return self.arrays.tables[0, :, :2]


def refusal(arrays: Arrays, of: Variants, result: int, robot: int, lane: int = 0) -> str:
    """Why a lane could not start, in one line."""
    if result == OFF_BASE:
        mass = arrays.applied[PAYLOAD_MASS, robot, lane]
        behind = arrays.applied[PAYLOAD_BEHIND, robot, lane]
        laden = Body(*arrays.rows("body")[:, robot, lane])
        empty = Body(*rows_of(of.constants, "body")[:, robot, arrays.variants[lane]])
        return (
            f"payload of {mass:g} kg at {behind:g} mm puts the centre of mass {laden.d:g} mm behind "
            f"the axle; the wheels carry it from 0 to {empty.pivot + empty.T:g} mm"
        )
    if result == IN_WALL:
        x, y, theta = rows_of(arrays.states, "start")[:, robot, lane].tolist()
        return (
            f"robot_{robot} starts in a wall or an obstacle of the world: its outline around "
            f"({x:.0f}, {y:.0f}) mm at the heading {theta:.2f} rad"
        )
    return (
        f"robot_{robot}: no start pose without overlap in {START_ATTEMPTS} draws with "
        f"start.position_std_mm {arrays.applied[START_POSITION, robot, lane]:g}; it leaves too little room"
    )
