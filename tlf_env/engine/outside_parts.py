"""Estimators, wheel loops and observers written in Python, called between the halves of each substep."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from tlf_env.common.trust import Trust
from tlf_env.engine import drivers
from tlf_env.engine.arrays import Arrays
from tlf_env.engine.layout import Sample, Trace, rows_of
from tlf_env.engine.settings import Settings
from tlf_env.hosting.crew import ESTIMATE, LOOP_SIZE, MESSAGE_SIZE, READING, READING_SIZE, Crew
from tlf_env.hosting.host import HostedCrew
from tlf_env.numerics.pointers import packed
from tlf_env.onboard.calibration import Belief
from tlf_env.onboard.parts import Factory, check_trust, load_part, runs_apart
from tlf_env.onboard.slip_estimator import SlipEstimate
from tlf_env.physics.units import MILLINEWTON_PER_NEWTON
from tlf_env.task.actions import TORQUE
from tlf_env.task.scenario import Scenario

AXLE = Belief._fields.index("h")
RADII = [Belief._fields.index(name) for name in ("radius_l", "radius_r")]
COVARIANCE = np.ravel_multi_index(
    np.triu_indices(3), (3, 3)
)  # its order in an Estimate, after the pose
SLIP = [SlipEstimate._fields.index(name) for name in ("delta_1", "delta_2")]
ODOMETRY = [Trace._fields.index(name) for name in ("distance", "turn")]
MOVED = [Trace._fields.index(name) for name in ("moved", "turned")]
NIS = Trace._fields.index("nis")
STEPS, FIX, TORQUES = (
    [Sample._fields.index(name) for name in names]
    for names in (("step_l", "step_r"), ("fix_x", "fix_y"), ("torque_l", "torque_r"))
)
HAS_FIX, FIX_AGE, GYRO = (Sample._fields.index(name) for name in ("has_fix", "fix_age", "gyro"))


def make_crews(
    scenario: Scenario, at_hand: Mapping[str, Factory], *, trust: Trust
) -> dict[str, Crew | HostedCrew]:
    """What makes and calls the parts that a scenario names, by role; those not in ``at_hand`` are imported.

    Raises
    ------
    ValueError
        for a part that cannot be imported, or may not be: ``trust`` is as of
        :func:`~tlf_env.onboard.parts.check_trust`.
    """
    paths = scenario.part_paths
    named = {role: path for role, path in paths.items() if role not in at_hand}
    check_trust(named, trust)
    periods_s = {
        "estimator": scenario.physics_period_s,
        "wheel_loop": scenario.physics_period_s,
        "observer": scenario.control_period_s,
    }
    robots = scenario.robot_models
    apart = {role: path for role, path in named.items() if runs_apart(path, trust)}
    here = {
        role: at_hand[role] if role in at_hand else load_part(role, path, trust=trust)
        for role, path in paths.items()
        if role not in apart
    }
    crews: dict[str, Crew | HostedCrew] = {}
    if here:
        crews |= dict.fromkeys(here, Crew(here, paths, periods_s, robots))
    if apart:
        crews |= dict.fromkeys(apart, HostedCrew(apart, periods_s, robots))
    return {role: crews[role] for role in paths}


class Parts:
    """One object per robot and role, in this process or in one of their own."""

    def __init__(self, crews: Mapping[str, Crew | HostedCrew], robots: int) -> None:
        self._crews, self._count = crews, robots
        self._distinct = list(dict.fromkeys(crews.values()))
        self._packed: Any = None  # the last arrays and settings, as drivers take them
        self._packed_of: Arrays | None = None
        self._radii = np.ones((robots, 2))  # of the wheels, believed over true
        self._next_radii = self._radii
        self._holds: list[int] = []  # substeps for which the last command still holds
        # In this control step, mm and rad: (substeps so far, 2, robot) by odometry, (2, robot) by estimators.
        self._odometry = np.zeros((1, 2, robots))
        self._moved = np.zeros((2, robots))

    def reset(self, arrays: Arrays, settings: Settings) -> None:
        """Make all parts again and start them; observers run ahead by the preview.

        Raises
        ------
        ValueError
            for a factory that makes no part of its role.
        """
        self._radii, widths_mm, poses = _start_of(arrays.constants, arrays.states)
        for crew in self._distinct:
            crew.start(widths_mm, poses)
        steps = range(settings.lookahead + 1)
        self._observe(arrays, settings, [(i, k) for i in range(1, self._count) for k in steps])

    def get_state(self, numbers: dict[str, np.ndarray]) -> Any:
        """The states of all parts as JSON values, their arrays in ``numbers``.

        Raises
        ------
        ValueError
            in one line that names the part, for a state that is not plain.
        """
        return {role: crew.get_state(role, numbers) for role, crew in self._crews.items()}

    def restored(
        self,
        tree: Any,
        numbers: Mapping[str, np.ndarray],
        constants: np.ndarray,
        states: np.ndarray,
    ) -> None:
        """Make new parts with the states of :meth:`get_state`, which :meth:`go_on` takes; nothing here changes.

        Raises
        ------
        ValueError
            in one line that names the part, if it does not take its state.
        """
        self._next_radii, widths_mm, poses = _start_of(constants, states)
        for role, crew in self._crews.items():
            trees = tree.get(role) if isinstance(tree, dict) else None
            if not isinstance(trees, list) or len(trees) != len(crew.used(role)):
                raise ValueError(f"the snapshot is damaged: it has no states for each {role}")
        for crew in self._distinct:
            mine = {role: tree[role] for role, one in self._crews.items() if one is crew}
            crew.restore(mine, numbers, widths_mm, poses)

    def go_on(self) -> None:
        """Go on with the parts that :meth:`restored` has made."""
        self._radii = self._next_radii
        for crew in self._distinct:
            crew.go_on()

    def close(self) -> None:
        """End the processes of the parts, if any; the next :meth:`reset` starts them again."""
        for crew in self._distinct:
            crew.close()

    def _given(self, arrays: Arrays, settings: Settings) -> tuple[Arrays, Settings]:
        """Both as drivers take them; packed again if the arrays are others than last time."""
        if self._packed_of is not arrays:
            self._packed, self._packed_of = (packed(arrays), packed(settings)), arrays
        given: tuple[Arrays, Settings] = self._packed
        return given

    def _hold(self, arrays: Arrays, settings: Settings, robot: int) -> int:
        """Substeps of the present control step for which a robot's last command still holds."""
        return drivers.delays_of(self._given(arrays, settings)[0], 0, robot, settings.dt)[1]

    def drive(self, arrays: Arrays, substep: int, settings: Settings) -> None:
        """Wheel loops: put torques in the place of the commands; the row ``wanted`` keeps those."""
        crew = self._crews.get("wheel_loop")
        if crew is None:
            return
        robots = [i for i in range(self._count) if arrays.kinds[i, 0] != TORQUE]
        if not robots:
            return
        rows, sensors = np.empty((len(robots), LOOP_SIZE)), arrays.named("sensors")
        for row, robot in zip(rows, robots, strict=True):
            held = substep < self._hold(arrays, settings, robot)
            row[:2] = arrays.rows("wanted_before" if held else "wanted")[:, robot, 0]
            row[2:] = sensors.speed_l[robot, 0], sensors.speed_r[robot, 0]
        torques = crew.torque(robots, rows)
        arrays.rows("command")[:, robots, 0] = torques.T * MILLINEWTON_PER_NEWTON

    def estimate(self, arrays: Arrays, substep: int, settings: Settings) -> None:
        """Estimators: update with the readings of the substeps, and hand on what they return.

        What they return is used after the control step. So where no wheel loop is called in between, they are
        called at its end, for all of its substeps one after the other.
        """
        if "estimator" not in self._crews:
            return
        if substep == 0:
            self._holds = [self._hold(arrays, settings, robot) for robot in range(self._count)]
            self._odometry = np.zeros((settings.substeps + 1, 2, self._count))
            self._moved = np.zeros((2, self._count))
        self._odometry[substep + 1] = arrays.rows("trace")[ODOMETRY, :, 0]
        if "wheel_loop" in self._crews:
            self._estimate(arrays, range(substep, substep + 1), settings)
        elif substep + 1 == settings.substeps:
            self._estimate(arrays, range(settings.substeps), settings)

    def _estimate(self, arrays: Arrays, substeps: range, settings: Settings) -> None:
        rows = self._readings(arrays, substeps, settings)
        crew = self._crews["estimator"]
        found = crew.estimate(rows.reshape(-1, READING_SIZE)).reshape(*rows.shape[:2], -1)
        estimates, slips, traces = (
            arrays.rows(name)[:, :, 0] for name in ("estimate", "slip", "trace")
        )
        fields = found.transpose(0, 2, 1)  # (substep, field, robot)
        last = fields[-1]
        estimates[:3], estimates[3:] = last[ESTIMATE.pose], last[ESTIMATE.covariance][COVARIANCE]
        slips[SLIP] = last[ESTIMATE.slip]
        # The engine's sums lack the twist, and have the slip of the substep before.
        by_twist = fields[:, [ESTIMATE.has_twist]] > 0.0
        way = np.diff(self._odometry[substeps.start : substeps.stop + 1], axis=0)
        moved = np.where(by_twist, fields[:, ESTIMATE.twist] * settings.dt, way)
        slipped = np.where(by_twist, 0.0, fields[:, ESTIMATE.slip] * settings.dt)
        motions = np.stack([moved, slipped], axis=1).reshape(-1, *self._moved.shape)
        traces[MOVED] = self._moved = _sum(self._moved, motions)
        traces[NIS] = _sum(traces[NIS], fields[:, ESTIMATE.nis])

    def _readings(self, arrays: Arrays, substeps: range, settings: Settings) -> np.ndarray:
        """What the robots' estimators receive of some substeps, ``(substep, robot, ReadingRow)``."""
        numbers = np.array(substeps)[:, None]
        sample = arrays.samples[substeps.start : substeps.stop, :, :, 0].transpose(1, 0, 2)
        t_s = (int(arrays.clock[0, 1]) * settings.substeps + numbers + 1) * settings.dt
        rows = np.empty((len(substeps), self._count, READING_SIZE))
        rows[..., READING.t_s] = t_s
        rows[..., READING.steps_rad] = sample[STEPS].transpose(1, 2, 0) * self._radii
        rows[..., READING.has_fix] = sample[HAS_FIX]
        rows[..., READING.fix_mm] = sample[FIX].transpose(1, 2, 0)
        rows[..., READING.fix_t_s] = t_s - sample[FIX_AGE]
        rows[..., READING.gyro_rad_s] = sample[GYRO]
        before, wanted = (arrays.rows(name)[:, :, 0].T for name in ("wanted_before", "wanted"))
        held = (numbers < self._holds)[..., None]
        by_wheels = (arrays.kinds[:, 0] != TORQUE)[:, None]
        rows[..., READING.wanted_rad_s] = np.where(by_wheels, np.where(held, before, wanted), 0.0)
        rows[..., READING.torques_Nmm] = sample[TORQUES].transpose(1, 2, 0) / MILLINEWTON_PER_NEWTON
        return rows

    def observe(self, arrays: Arrays, settings: Settings) -> None:
        """Observers: the followers' next references."""
        step = int(arrays.clock[0, 1]) + settings.lookahead
        self._observe(arrays, settings, [(robot, step) for robot in range(1, self._count)])

    def _observe(
        self, arrays: Arrays, settings: Settings, wanted: Sequence[tuple[int, int]]
    ) -> None:
        """Observers: references of robots at control steps, ``(robot, step)``, one after the other."""
        crew = self._crews.get("observer")
        if crew is None or not wanted:
            return
        given, numbers = self._given(arrays, settings)
        rows = np.empty((len(wanted), MESSAGE_SIZE + 1))
        for row, (robot, step) in zip(rows, wanted, strict=True):
            row[:MESSAGE_SIZE] = drivers.delayed_message_of(given, 0, robot, step, numbers)
            row[MESSAGE_SIZE] = step * settings.period
        found = crew.observe([robot for robot, _ in wanted], rows)
        for reference, (robot, step) in zip(found, wanted, strict=True):
            arrays.references[:, step % arrays.references.shape[1], robot, 0] = reference


def _start_of(
    constants: np.ndarray, states: np.ndarray
) -> tuple[np.ndarray, list[float], np.ndarray]:
    """Of an episode with these rows: wheel radii and axle widths (mm) believed in, and poses ``(robot, 3)``."""
    belief, starts = (
        rows_of(array, name)[:, :, 0] for array, name in ((constants, "belief"), (states, "start"))
    )
    widths_mm = [2.0 * h for h in belief[AXLE].tolist()]
    return belief[RADII].T.copy(), widths_mm, starts.T.copy()


def _sum(first: np.ndarray, more: np.ndarray) -> np.ndarray:
    """The sum of an array and of the rows of another one, added one after the other."""
    total: np.ndarray = np.add.accumulate([first, *more])[-1]
    return total
