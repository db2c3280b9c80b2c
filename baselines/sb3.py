"""stable-baselines3's vector environment on the batch plant: every robot is a sub-environment."""

from __future__ import annotations

import secrets
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, NamedTuple

import gymnasium
import numpy as np
from stable_baselines3.common.vec_env import VecEnv

from tlf_env.common.errors import shown
from tlf_env.engine.batch import BatchPlant, Source
from tlf_env.onboard.parts import real_numbers
from tlf_env.task.actions import ACTION_SIZE
from tlf_env.task.info import END_REASONS
from tlf_env.task.observation import OBSERVATION_LIMIT


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
        ``{name: one scenario, or a sequence of them}``, which share the formations.
    formations
        Number of formations in all.
    mixture
        Whether every episode draws its scenario from those of its task; a sequence gives their shares.
    threads
        Number of threads for a step; None: one per core.
    seed
        Formation k gets ``seed`` + k in the first ``reset``; random if None.
    **overrides
        Fields of the scenarios, and ``disturbance_level``.

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
        threads: int | None = 1,
        seed: int | None = None,
        **overrides: Any,
    ) -> None:
        tasks = _tasks(scenario)
        if isinstance(formations, bool) or formations < len(tasks):
            raise ValueError(
                f"formations {formations!r} must be at least one for each of {len(tasks)} tasks"
            )
        shares = [len(part) for part in np.array_split(np.arange(formations), len(tasks))]
        self.plants = [
            BatchPlant(task, share, threads=threads, mixture=mixture, **overrides)
            for task, share in zip(tasks, shares, strict=True)
        ]
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
        self._seed: int | None = seed

    def _spaces_agree(self) -> None:
        first = self.plants[0].scenario
        for plant in self.plants[1:]:
            for field in ("observation", "action", "preview_s", "dtype", "control_period_s"):
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
        """Seed the next reset: formation k gets ``seed`` + k; returns each sub-environment's."""
        self._seed = secrets.randbelow(2**31) if seed is None else int(seed)
        self._seeds = [
            self._seed + int(self._first[where.plant]) + where.formation
            for where in map(self.place, range(self.num_envs))
        ]
        return self._seeds

    def reset(self) -> np.ndarray:
        """Start an episode of every formation, with the given seed or the next one; ``(num_envs, entries)``."""
        for plant, first in zip(self.plants, self._first, strict=False):
            plant.reset(None if self._seed is None else self._seed + int(first))
        self._seed = None
        self._reset_seeds()
        self.reset_infos: list[dict[str, Any]] = [{} for _ in range(self.num_envs)]
        return self.observations()

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
        infos: list[dict[str, Any]] = [{} for _ in range(self.num_envs)]
        dones = np.concatenate([(plant.ends != 0).ravel() for plant in self.plants])
        if dones.any():
            last = self.observations()
            reasons = np.concatenate([plant.ends.ravel() for plant in self.plants])
            truncated = np.concatenate([plant.truncated.ravel() for plant in self.plants])
            for i in np.flatnonzero(dones):
                infos[i] = {
                    "terminal_observation": last[i],
                    "TimeLimit.truncated": bool(truncated[i]),
                    "end": END_REASONS[reasons[i]],
                }
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
        """Do nothing; there is nothing to close."""

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
            f"a robot has no attribute {name!r}; there are scenario, place, render_mode"
        )

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        """Store a value for sub-environments, for ``get_attr``; it has no other effect."""
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
    """One scenario, or a sequence of them, for each task."""
    if isinstance(scenario, Mapping) and "trajectory" not in scenario:
        if not scenario:
            raise ValueError("scenario: the mapping of tasks is empty")
        return list(scenario.values())
    return [scenario]
