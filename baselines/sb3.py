"""stable-baselines3's vector environment on the batch plant: every robot is a sub-environment."""

from __future__ import annotations

import secrets
import time
from collections import deque
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, NamedTuple

import gymnasium
import numpy as np
from stable_baselines3.common.vec_env import VecEnv

from tlf_env.common.errors import shown
from tlf_env.common.trust import Trust
from tlf_env.engine.batch import DOUBLE, BatchPlant, Source, checked_count
from tlf_env.numerics.philox import checked_seed
from tlf_env.onboard.parts import real_numbers
from tlf_env.task.actions import ACTION_SIZE
from tlf_env.task.info import TIME_GAP_KEY, EndReason, InfoChoice, chosen_keys
from tlf_env.task.observation import OBSERVATION_LIMIT
from tlf_env.task.scenario import learners_action
from tlf_env.task.start import Start, joined, same_start, start_options

# A dictionary for each robot in each step: with all 50 keys they cost nearly as much as the simulation.
CHEAP_INFOS = ("position_error_mm", "lost", "touched", "end")
ATTRIBUTES = ("scenario", "place", "render_mode")
ENDS_KEPT = 100  # episodes of a robot whose ends are counted, as many as SB3 averages


class Place(NamedTuple):
    """Place of a sub-environment: number of the plant, of the formation in it, and of the robot."""

    plant: int
    formation: int
    robot: int


class FormationVecEnv(VecEnv):
    """Formations on the batch plant; every robot is a sub-environment.

    Robot i of formation k is sub-environment k·n + i, with n robots per formation. The robots of a
    formation end together: the robot that ended the episode is terminated, the others are truncated
    (``TimeLimit.truncated``), so that a learner bootstraps correctly. A formation restarts in the step in
    which it ended, as SB3 requires; the last observation is ``terminal_observation``.

    Parameters
    ----------
    scenario
        A scenario as for :class:`~tlf_env.engine.batch.BatchPlant`; several tasks as a mapping
        ``{name: one scenario, or a sequence of them}``, which share the formations. No name is ``base`` or
        ``trajectory``: a mapping with such a key is a scenario.
    formations
        Number of formations in all.
    mixture
        Whether every episode draws its scenario from those of its task; a sequence gives their shares.
    staggered
        Whether the first episodes end at different times, each task's formations spread over its horizon;
        as in :class:`~tlf_env.engine.batch.BatchPlant`.
    precision
        ``"double"`` or ``"single"``, of the numbers in the substeps; as in
        :class:`~tlf_env.engine.batch.BatchPlant`.
    threads
        Number of threads for a step; None: one per core.
    seed
        Formation k gets ``seed`` + k in the first ``reset``; random if None.
    infos
        The keys of the infos that steps and ``reset_infos`` contain, True for all, False for none. The
        last step of an episode also contains ``terminal_observation``, ``TimeLimit.truncated`` and
        ``episode``: its return ``r``, its length ``l`` and the time ``t`` (s) since the environment was
        made, which SB3 averages as ``ep_rew_mean`` and ``ep_len_mean``.
    trust
        As in :class:`~tlf_env.engine.batch.BatchPlant`.
    **overrides
        Fields of the scenarios, and ``disturbance_level``. ``action`` is by default that of
        :class:`~tlf_env.envs.single.FormationEnv`.

    Raises
    ------
    TypeError
        in one line, for an unknown keyword.
    ValueError
        for a scenario that cannot run in a batch, tasks with different spaces, or too few formations.
    """

    def __init__(
        self,
        scenario: Source | Sequence[Source] | Mapping[str, Source | Sequence[Source]] = "infinity",
        formations: int = 256,
        *,
        mixture: bool | Sequence[float] = False,
        staggered: bool = False,
        precision: str = DOUBLE,
        threads: int | None = 1,
        seed: int | None = None,
        infos: InfoChoice = CHEAP_INFOS,
        trust: Trust = False,
        **overrides: Any,
    ) -> None:
        tasks = _tasks(scenario)
        self._info_keys = chosen_keys(infos)
        self._starts: list[list[Start]] = []  # of the formations of each plant, for the next reset
        if checked_count("formations", formations) < len(tasks):
            raise ValueError(
                f"formations {shown(formations)} must be at least one for each of {len(tasks)} tasks"
            )
        overrides = learners_action(tasks, overrides)  # of all together, which need the same
        shares = [len(part) for part in np.array_split(np.arange(formations), len(tasks))]
        self.plants = [
            BatchPlant(
                task,
                share,
                threads=threads,
                mixture=mixture,
                staggered=staggered,
                precision=precision,
                trust=trust,
                **overrides,
            )
            for task, share in zip(tasks, shares, strict=True)
        ]
        if TIME_GAP_KEY not in self._info_keys:
            for plant in self.plants:
                plant.compute_time_gap_of([])
        self._spaces_agree()
        self._rows = [plant.formations * plant.scenario.robot_count for plant in self.plants]
        self._ends = np.cumsum([0, *self._rows])
        self._first = np.cumsum([0, *shares])  # the first formation of each plant
        dtype = np.dtype(self.plants[0].scenario.dtype)
        entries = self.plants[0].observations.shape[2]
        self._attributes: list[dict[str, Any]] = [{} for _ in range(self._ends[-1])]
        self._actions: tuple[Any] | None = None
        super().__init__(
            int(self._ends[-1]),
            gymnasium.spaces.Box(-OBSERVATION_LIMIT, OBSERVATION_LIMIT, (entries,), dtype.type),
            gymnasium.spaces.Box(-1.0, 1.0, (ACTION_SIZE,), dtype.type),
        )
        self._seed: int | None = None if seed is None else self._checked_seed(seed)
        self._made_at_s = time.monotonic()
        self._returns = np.zeros(self.num_envs)
        self._lengths = np.zeros(self.num_envs, dtype=np.int64)
        self.last_ends: deque[int] = deque(maxlen=ENDS_KEPT)  # of robots, as in EndReason

    def clear_statistics(self) -> None:
        """Count the running episodes from now on, and forget how others ended."""
        self._returns[:], self._lengths[:] = 0.0, 0
        self.last_ends.clear()

    def end_shares(self) -> dict[str, float]:
        """How the last 100 episodes of robots ended: the share of each :class:`~tlf_env.EndReason`.

        All are 0 before the first end.
        """
        ended = max(len(self.last_ends), 1)
        return {
            reason.name.lower(): self.last_ends.count(reason) / ended
            for reason in EndReason
            if reason is not EndReason.RUNNING
        }

    def set_shares(self, mixture: bool | Sequence[float]) -> None:
        """As :meth:`~tlf_env.engine.batch.BatchPlant.set_shares`, for the scenarios of every task."""
        for plant in self.plants:
            plant.set_shares(mixture)

    def _spaces_agree(self) -> None:
        first = self.plants[0].scenario
        for plant in self.plants[1:]:
            for field in (
                "observation",
                "action",
                "action_range",
                "tracking_fade_mm",
                "preview_s",
                "rays",
                "neighbour",
                "dtype",
                "control_period_s",
            ):
                mine, theirs = getattr(first, field), getattr(plant.scenario, field)
                if mine != theirs:
                    raise ValueError(
                        f"task {plant.scenario.name!r} has {field} {theirs!r}, the first task {mine!r}; "
                        "tasks in one environment need the same"
                    )

    def place(self, index: int) -> Place:
        """Place of a sub-environment."""
        plant = int(np.searchsorted(self._ends, index, side="right")) - 1
        robots = self.plants[plant].scenario.robot_count
        formation, robot = divmod(index - int(self._ends[plant]), robots)
        return Place(plant, formation, robot)

    def seed(self, seed: int | None = None) -> Sequence[int | None]:
        """Seed the next reset: formation k gets ``seed`` + k; returns each sub-environment's.

        Raises
        ------
        ValueError
            for a seed that is not a whole number from 0 on.
        """
        self._seed = secrets.randbelow(2**31) if seed is None else self._checked_seed(seed)
        self._seeds = [
            self._seed + int(self._first[where.plant]) + where.formation
            for where in map(self.place, range(self.num_envs))
        ]
        return self._seeds

    def _checked_seed(self, seed: int) -> int:
        """The seed of the first formation, where the last one's is in range, too."""
        checked_seed(checked_seed(seed) + int(self._first[-1]) + self.plants[-1].formations - 1)
        return int(seed)

    def set_options(
        self, options: Sequence[Mapping[str, Any]] | Mapping[str, Any] | None = None
    ) -> None:
        """Options for the next :meth:`reset`: ``poses`` and ``phase_s`` of a formation.

        Parameters
        ----------
        options
            A mapping for all formations, or one for each sub-environment, equal within a formation. See
            :meth:`tlf_env.engine.batch.BatchPlant.reset`.

        Raises
        ------
        ValueError
            for an unknown option, an invalid value, or options that differ within a formation.
        """
        if options is None or isinstance(options, Mapping):
            options = [options or {}] * self.num_envs
        if isinstance(options, str) or not isinstance(options, Sequence):
            raise ValueError(
                f"options must be a mapping or a sequence of them, got {shown(options)}"
            )
        if len(options) != self.num_envs:
            raise ValueError(f"options: {len(options)} mappings for {self.num_envs} robots")
        self._starts = [
            self._starts_of(plant, options[first:end])
            for plant, first, end in zip(self.plants, self._ends, self._ends[1:], strict=False)
        ]

    @staticmethod
    def _starts_of(plant: BatchPlant, options: Sequence[Mapping[str, Any]]) -> list[Start]:
        """The start of each formation."""
        robots = plant.scenario.robot_count
        starts = []
        for k in range(plant.formations):
            mine = options[k * robots : (k + 1) * robots]
            each = [start_options(one, robots) for one in mine]
            if any(not same_start(one, each[0]) for one in each):
                raise ValueError(f"options differ between the robots of formation {k}")
            starts.append(each[0])
        return starts

    def reset(self) -> np.ndarray:
        """Start an episode of every formation, with the given seed or the next one; ``(num_envs, entries)``."""
        starts = self._starts or [[] for _ in self.plants]
        for plant, first, given in zip(self.plants, self._first, starts, strict=False):
            plant.reset(
                None if self._seed is None else self._seed + int(first), options=joined(given)
            )
        self._seed, self._starts = None, []
        self._returns[:], self._lengths[:] = 0.0, 0
        self._reset_seeds()
        self._reset_options()
        self.reset_infos = self._infos()
        return self.observations()

    def _infos(self) -> list[dict[str, Any]]:
        """The infos of all robots in the last step."""
        if not self._info_keys:
            return [{} for _ in range(self.num_envs)]
        columns = [
            [x for plant in self.plants for x in plant.info(key).ravel().tolist()]
            for key in self._info_keys
        ]
        rows = zip(*columns, strict=True)
        return [dict(zip(self._info_keys, row, strict=True)) for row in rows]

    def begin_next(self, plant: int, mask: np.ndarray) -> None:
        """Start the next episodes of the formations of a mask, of one of the plants."""
        self.plants[plant].reset(mask=mask)

    def step_async(self, actions: np.ndarray) -> None:
        """Keep the actions, ``(num_envs, 2)``, for the step."""
        self._actions = (actions,)

    def step_wait(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, list[dict[str, Any]]]:
        """Advance all formations by one control period: observations, rewards, dones, infos.

        Raises
        ------
        ValueError
            for actions of another shape or not finite; then no state changes.
        """
        if self._actions is None:
            raise RuntimeError("call step_async() before step_wait()")
        (actions,), self._actions = self._actions, None
        given = real_numbers(actions)
        if given is None:
            raise ValueError(
                f"actions must be {(self.num_envs, ACTION_SIZE)} finite numbers, got {shown(actions)}"
            )
        if given.shape != (self.num_envs, ACTION_SIZE) or not np.isfinite(given).all():
            raise ValueError(
                f"actions must be {(self.num_envs, ACTION_SIZE)} finite numbers, got the shape "
                f"{given.shape}: {shown(actions)}"
            )
        for plant, rows in self._parts(given):
            plant.step(rows.reshape(plant.arrays.actions.shape))
        rewards = np.concatenate([plant.rewards.ravel() for plant in self.plants])
        infos = self._infos()
        ends = np.concatenate([plant.ends.ravel() for plant in self.plants])
        dones = ends != EndReason.RUNNING
        self._returns += rewards
        self._lengths += 1
        if dones.any():
            last = self.observations()
            truncated = np.concatenate([plant.truncated.ravel() for plant in self.plants])
            time_s = round(time.monotonic() - self._made_at_s, 6)
            for i in np.flatnonzero(dones):
                infos[i]["terminal_observation"] = last[i]
                infos[i]["TimeLimit.truncated"] = bool(truncated[i])
                infos[i]["episode"] = {
                    "r": float(self._returns[i]),
                    "l": int(self._lengths[i]),
                    "t": time_s,
                }
            self.last_ends.extend(ends[dones].tolist())
            self._returns[dones], self._lengths[dones] = 0.0, 0
            for plant in self.plants:
                plant.reset_finished()
        return self.observations(), rewards.astype(np.float32), dones, infos

    def _parts(self, rows: np.ndarray) -> Iterable[tuple[BatchPlant, np.ndarray]]:
        """Each plant with the rows of its sub-environments."""
        for plant, first, end in zip(self.plants, self._ends, self._ends[1:], strict=False):
            yield plant, rows[first:end]

    def observations(self) -> np.ndarray:
        """Current observations, ``(num_envs, entries)``; a copy, as SB3 keeps them during the next step."""
        width = self.plants[0].observations.shape[2]
        return np.concatenate([plant.observations.reshape(-1, width) for plant in self.plants])

    def close(self) -> None:
        """End the processes in which the policy ``residual_base`` runs, if any."""
        for plant in self.plants:
            plant.close()

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        """``scenario``, ``place``, ``render_mode`` (None), or an attribute from ``set_attr``.

        Raises
        ------
        AttributeError
            for any other name.
        """
        return [self._attribute(attr_name, i) for i in self._get_indices(indices)]

    def _attribute(self, name: str, index: int) -> Any:
        if name in self._attributes[index]:
            return self._attributes[index][name]
        if name == "render_mode":
            return None
        if name == "place":
            return self.place(index)
        if name == "scenario":
            where = self.place(index)
            plant = self.plants[where.plant]
            return plant.scenarios[plant.scenario_numbers[where.formation]]
        raise AttributeError(
            f"a robot has no attribute {shown(name)}; there are {', '.join(ATTRIBUTES)}"
        )

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        """Store a value for sub-environments, for ``get_attr``; it has no other effect.

        Raises
        ------
        AttributeError
            for an attribute of the environment itself, as ``scenario``.
        """
        if attr_name in ATTRIBUTES:
            raise AttributeError(f"{attr_name} cannot be set; make another environment")
        for i in self._get_indices(indices):
            self._attributes[i][attr_name] = value

    def env_method(
        self, method_name: str, *method_args: Any, indices: Any = None, **method_kwargs: Any
    ) -> list[Any]:
        """Call ``state()``, a robot's true state, or a callable from ``set_attr``.

        Raises
        ------
        AttributeError
            for any other name.
        """
        if method_name == "state":
            states = [plant.state() for plant in self.plants]
            places = [self.place(i) for i in self._get_indices(indices)]
            return [states[at.plant][at.formation, at.robot].copy() for at in places]
        methods = self.get_attr(method_name, indices)
        return [method(*method_args, **method_kwargs) for method in methods]

    def env_is_wrapped(
        self, wrapper_class: type[gymnasium.Wrapper], indices: Any = None
    ) -> list[bool]:
        """False for each sub-environment: there are no wrappers."""
        return [False for _ in self._get_indices(indices)]


def _tasks(
    scenario: Source | Sequence[Source] | Mapping[str, Source | Sequence[Source]],
) -> list[Any]:
    """One scenario, or a sequence of them, for each task.

    A mapping that is itself a scenario has one of the keys ``base`` and ``trajectory``.
    """
    if isinstance(scenario, Mapping) and not {"base", "trajectory"} & scenario.keys():
        if not scenario:
            raise ValueError("scenario: the mapping of tasks is empty")
        return list(scenario.values())
    return [scenario]
