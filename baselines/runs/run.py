"""One run of a policy on a scenario, recorded and measured; several seeds side by side."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, TypeVar

import numpy as np

from baselines.runs.signals import SignalTape
from baselines.runs.stopping import taken
from tlf_env.common.trust import Trust
from tlf_env.engine import readout
from tlf_env.engine.arrays import Arrays
from tlf_env.engine.batch import BatchPlant
from tlf_env.engine.formation import Formation
from tlf_env.numerics.philox import checked_seed
from tlf_env.onboard.parts import Factory, Policy, predicted
from tlf_env.task.info import Info
from tlf_env.task.metrics import RobotMetrics, StringMetrics, robot_metrics, string_metrics
from tlf_env.task.scenario import Scenario
from tlf_env.task.start import start_options
from tlf_env.task.warn import without_warnings

ItemT = TypeVar("ItemT")

SEEDS_PER_BLOCK = 50  # runs side by side: a record takes 2 to 4 MB

# Columns of a record, in the order of trajectory.csv; each is (time, robot).
RECORDED = (
    "x_mm",
    "y_mm",
    "theta_rad",
    "castor_rad",
    "reference_x_mm",
    "reference_y_mm",
    "reference_theta_rad",
    "position_error_mm",
    "formation_error_mm",
    "heading_error_rad",
    "time_gap_error_s",
    "J_mm_s",
    "J_theta_rad_s",
    "omega_l_rad_s",
    "omega_r_rad_s",
    "omega_l_command_rad_s",
    "omega_r_command_rad_s",
    "torque_l_Nmm",
    "torque_r_Nmm",
    "torque_rms_Nmm",
    "energy_mJ",
    "saturation_fraction",
    "slip_mm_s",
    "slid_mm",
    "innovation_nis",
)
FROM_INFO = tuple(name for name in RECORDED if name in Info._fields)
FROM_WHEELS = (
    "castor_rad",
    "omega_l_rad_s",
    "omega_r_rad_s",
    "omega_l_command_rad_s",
    "omega_r_command_rad_s",
)
INFO_PLACES = [Info._fields.index(name) for name in FROM_INFO]


@dataclass(frozen=True)
class Record:
    """A finished run, one row per control step, including the start.

    Torques are means over the control step that ends at the row's time; ``slip_mm_s`` is the maximum.
    """

    scenario: Scenario
    seed: int
    policy: str
    t_s: np.ndarray  # (time,)
    columns: dict[str, np.ndarray]  # each (time, robot)
    leader: np.ndarray  # (time, 2): the leader's reference path, mm
    lost_at_s: np.ndarray  # (robot,): when the error first passed lost_beyond_mm; infinite if never
    touched_at_s: (
        np.ndarray
    )  # (robot,): when it first touched a robot, wall or obstacle; else infinite
    touched_by: np.ndarray  # (robot,): what that was, a TouchedBy
    options: Mapping[str, Any] | None = None  # of the reset
    # (time, object, 3): x and y (mm) and angle (rad) of the world's pushables, then of its moving obstacles
    objects: np.ndarray | None = None  # None if the world has neither
    # Further columns, each (time, robot), of :mod:`baselines.runs.signals`; of single runs only.
    signals: Mapping[str, np.ndarray] = field(default_factory=dict)
    interrupted: bool = False  # before the horizon

    def __getitem__(self, column: str) -> np.ndarray:
        return self.columns[column] if column in self.columns else self.signals[column]

    @property
    def robots(self) -> int:
        """Number of robots."""
        return len(self.lost_at_s)

    @property
    def contact(self) -> bool:
        """Whether any robot touched another, a wall or an obstacle."""
        return bool(np.isfinite(self.touched_at_s).any())

    @property
    def title(self) -> str:
        """Task, policy, disturbance and seed."""
        disturbance = self.scenario.disturbance
        level = "" if disturbance.level == 1 else f" × {disturbance.level:g}"
        return (
            f"{self.scenario.name}, policy {self.policy}, disturbance {disturbance.name}{level}, "
            f"seed {self.seed}"
        )

    def metrics(self) -> list[RobotMetrics]:
        """Metrics of every robot."""
        return robot_metrics(
            self.scenario,
            self.t_s,
            self.columns,
            self.lost_at_s,
            self.touched_at_s,
            self.touched_by,
        )

    def string(self) -> StringMetrics:
        """Growth of the errors along the string of robots."""
        return string_metrics(self.scenario, self.columns, self.leader)


def run_policy(
    scenario: Scenario,
    policy: Policy,
    seed: int = 0,
    *,
    name: str = "policy",
    parts: Mapping[str, Factory] | None = None,
    options: Mapping[str, Any] | None = None,
    progress: Callable[[int, int], None] | None = None,
    watch: Callable[[Formation], None] | None = None,
    keep_interrupted: bool = False,
    trust: Trust = False,
) -> Record:
    """Run a policy over the whole horizon, without early ends (``end_on=()``), and record everything.

    Parameters
    ----------
    parts
        Factories of custom on-board parts of the scenario, if given as objects.
    options
        Options of the reset: ``poses`` and ``phase_s``, as of the environments.
    progress
        Called with the steps done and their total.
    watch
        Called with the formation at the start and after every control step; it must only read, for example
        keep scenes for a video (:class:`baselines.runs.video.Film`).
    keep_interrupted
        After an interrupt (Ctrl-C) return a record of what was simulated, marked as interrupted, once there
        is a step; without it the interrupt goes on, so that a part is never taken for the whole.
    trust
        Whether code that the scenario names (``"module:factory"``) may run: in this process (True) or in one of
        its own (``"isolated"``). Objects need no permission.

    Raises
    ------
    ValueError
        for an unknown or invalid option; naming the policy, if its ``predict`` does not return a pair of
        actions (in the right shape) and a state; naming part and factory, for a part that cannot be made.
    """
    formation = Formation(scenario.model_copy(update={"end_on": ()}), parts, trust=trust)
    formation.reset(checked_seed(seed), start=start_options(options, scenario.robot_count))
    a, steps = formation.arrays, scenario.horizon_steps
    tape, signals = _Tape(a, steps), SignalTape(a, scenario)
    driver = PolicyDriver(policy, scenario, a, name)
    objects = [formation.plant.object_poses(0)]
    done = 0
    if watch is not None:
        watch(formation)
    try:
        for k in range(1, steps + 1):
            a.actions[:] = driver.act()
            formation.step()
            if watch is not None:
                watch(formation)
            objects.append(formation.plant.object_poses(k))
            signals.note(k)
            tape.note(k, scenario.control_period_s)
            done = k
            if progress is not None:
                progress(k, steps)
    except KeyboardInterrupt as interrupt:
        if not (keep_interrupted and done):
            raise
        taken(interrupt)
    plain = {name: np.asarray(value).tolist() for name, value in (options or {}).items()} or None
    return replace(
        tape.record(0, scenario, seed, name, done),
        options=plain,
        objects=np.stack(objects[: done + 1]) if objects[0].size else None,
        signals=signals.columns(done),
        interrupted=done < steps,
    )


def run_seeds(
    scenario: Scenario,
    policy: Policy,
    seeds: Sequence[int],
    *,
    name: str = "policy",
    most_failed: int | None = None,
    trust: Trust = False,
) -> Iterator[Record]:
    """Runs of several seeds side by side, without contact between robots; as :func:`run_policy`.

    The policy is called once per step with all rows, ``(seed · robots, entry)``. If it refuses them with
    a ValueError, the seeds are run one after the other.

    Parameters
    ----------
    most_failed
        Stop, with no record at all, as soon as robots are lost or touch in more runs than this.
    trust
        As of :func:`run_policy`.
    """
    with without_warnings():
        plant = BatchPlant(scenario.model_copy(update={"end_on": ()}), len(seeds), trust=trust)
    plant.reset(list(seeds))
    a, steps = plant.arrays, scenario.horizon_steps
    tape = _Tape(a, steps)
    driver = PolicyDriver(policy, scenario, a, name)
    try:
        actions = driver.act()
    except ValueError:
        if len(seeds) == 1:
            raise
        for seed in seeds:
            yield from run_seeds(scenario, policy, [seed], name=name, trust=trust)
        return
    for k in range(1, steps + 1):
        plant.step(actions)
        tape.note(k, scenario.control_period_s)
        if most_failed is not None and tape.failed > most_failed:
            return
        if k < steps:
            actions = driver.act()
    for lane, seed in enumerate(seeds):
        yield tape.record(lane, scenario, seed, name)


def seed_blocks(seeds: Sequence[ItemT]) -> Iterator[Sequence[ItemT]]:
    """Blocks of up to 50 seeds, or of items with one seed each: as many as run side by side."""
    for i in range(0, len(seeds), SEEDS_PER_BLOCK):
        yield seeds[i : i + SEEDS_PER_BLOCK]


class PolicyDriver:
    """A policy and its state during an episode.

    Parameters
    ----------
    policy
        As SB3's ``predict``.
    scenario
        Says which observation the policy gets.
    arrays
        Of the plant, whose observations are read.
    name
        Of the policy, in errors.
    """

    def __init__(self, policy: Policy, scenario: Scenario, arrays: Arrays, name: str) -> None:
        self._policy, self._name = policy, name
        sensor = scenario.observation == "sensor"
        self._seen = arrays.sensor_observations if sensor else arrays.observations
        self._shape = arrays.actions.shape
        self._state: Any = None
        self._start = np.ones(self._shape[0] * self._shape[1], dtype=np.bool_)

    def act(self) -> np.ndarray:
        """Actions for all robots of all lanes, ``(lane, robot, 2)``."""
        rows = self._seen.reshape(len(self._start), -1).copy()
        answer = self._policy.predict(rows, self._state, self._start, True)
        shape = (len(rows), self._shape[2])
        actions, self._state = predicted(answer, shape, f"policy {self._name!r}")
        self._start = np.zeros_like(self._start)
        return actions.reshape(self._shape)


class _Tape:
    """Rows of the records of some lanes (formations), kept while they run."""

    def __init__(self, arrays: Arrays, steps: int) -> None:
        lanes, n = arrays.rewards.shape
        self._arrays, self._steps = arrays, steps
        self._infos = np.zeros((lanes, steps + 1, n, len(FROM_INFO)))
        self._wheels = np.zeros((lanes, steps + 1, len(FROM_WHEELS), n))
        self._lost_at_s, self._touched_at_s = np.full((2, lanes, n), np.inf)
        self._touched_by = np.zeros((lanes, n), dtype=np.int8)
        self.note(0, 0.0)

    def note(self, step: int, period_s: float) -> None:
        """Keep the row of a control step."""
        a = self._arrays
        self._infos[:, step] = a.infos[:, :, INFO_PLACES]
        motion, wanted = readout.named(a, "motion"), readout.named(a, "wanted")
        self._wheels[:, step, 0] = motion.psi - motion.theta
        self._wheels[:, step, 1] = motion.omega_l
        self._wheels[:, step, 2] = motion.omega_r
        self._wheels[:, step, 3] = wanted.left
        self._wheels[:, step, 4] = wanted.right
        if a.lost_now.any() or a.touched_now.any():
            self._lost_at_s[a.lost_now] = step * period_s
            self._touched_at_s[a.touched_now] = step * period_s
            self._touched_by[a.touched_now] = a.touched_by[a.touched_now]

    @property
    def failed(self) -> int:
        """Number of lanes in which a robot has been lost or has touched something."""
        ended = np.isfinite(self._lost_at_s) | np.isfinite(self._touched_at_s)
        return int(ended.any(axis=1).sum())

    def record(
        self, lane: int, scenario: Scenario, seed: int, policy: str, steps: int | None = None
    ) -> Record:
        """The record of a lane, of all its steps or of the first ones."""
        period_s = scenario.control_period_s
        rows = (self._steps if steps is None else steps) + 1
        columns = {name: self._infos[lane, :rows, :, i] for i, name in enumerate(FROM_INFO)}
        columns |= {name: self._wheels[lane, :rows, i] for i, name in enumerate(FROM_WHEELS)}
        return Record(
            scenario=scenario,
            seed=seed,
            policy=policy,
            t_s=np.arange(rows) * period_s,
            columns=_with_functionals(columns, period_s),
            leader=self._arrays.tables[0, :rows, :2].copy(),
            lost_at_s=self._lost_at_s[lane],
            touched_at_s=self._touched_at_s[lane],
            touched_by=self._touched_by[lane],
        )


def _with_functionals(rows: dict[str, np.ndarray], period_s: float) -> dict[str, np.ndarray]:
    """Add J and J_θ of eq. (54): running integrals of the signed errors, robot − reference."""
    error = rows["x_mm"] - rows["reference_x_mm"] + rows["y_mm"] - rows["reference_y_mm"]
    rows["J_mm_s"] = np.cumsum(error, axis=0) * period_s
    rows["J_theta_rad_s"] = np.cumsum(-rows["heading_error_rad"], axis=0) * period_s
    return rows
