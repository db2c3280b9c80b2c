"""stable-baselines3's vector environment whose formations are spread over the machines of a Ray cluster."""

from __future__ import annotations

import secrets
from collections.abc import Callable, Iterable, Sequence
from typing import Any

import gymnasium
import numpy as np
from stable_baselines3.common.vec_env import VecEnv

from baselines.runs.jobs import connected_ray
from baselines.sb3 import FormationVecEnv
from tlf_env.common.errors import shown
from tlf_env.engine.batch import Source, checked_count
from tlf_env.numerics.philox import checked_seed
from tlf_env.onboard.parts import real_numbers
from tlf_env.task.actions import ACTION_SIZE


class RayFormationVecEnv(VecEnv):
    """Formations of one task on the workers of a Ray cluster; every robot is a sub-environment.

    Each worker is a process with a :class:`~baselines.sb3.FormationVecEnv` of its own, which holds a block of
    the formations. A step sends each worker its actions and waits for all of them. Observations, rewards,
    dones and infos are those of one ``FormationVecEnv`` with all formations, bit for bit, whatever the number
    of workers (but for ``staggered``, which every worker applies to its own block, and the times in
    ``episode``).

    Parameters
    ----------
    scenario
        As for :class:`~baselines.sb3.FormationVecEnv`, but of one task: no mapping of tasks.
    formations
        Number of formations in all; at least one for each worker.
    workers
        Number of worker processes.
    address
        Address of a Ray cluster; None starts Ray on this machine.
    threads
        Threads, and processors of the cluster, for each worker.
    seed
        Formation k gets ``seed`` + k in the first ``reset``; random if None.
    **settings
        Further parameters of ``FormationVecEnv``, and fields of the scenario.

    Raises
    ------
    ValueError
        without ray, without a cluster at the address, for fewer processors than the workers need, and as
        ``FormationVecEnv``.
    ConnectionError
        from a step or reset, if a worker has ended.
    """

    def __init__(
        self,
        scenario: Source | Sequence[Source] = "infinity",
        formations: int = 256,
        *,
        workers: int = 2,
        address: str | None = None,
        threads: int = 1,
        seed: int | None = None,
        **settings: Any,
    ) -> None:
        checked_count("workers", workers)
        checked_count("threads", threads)
        if checked_count("formations", formations) < workers:
            raise ValueError(
                f"formations {formations} must be at least one for each of {workers} workers"
            )
        if seed is not None:
            checked_seed(checked_seed(seed) + formations - 1)
        shares = [len(part) for part in np.array_split(np.arange(formations), workers)]
        self._first_formation = np.cumsum([0, *shares])[:-1]
        # What is wrong with the scenario is found here, with its usual error, before anything is started.
        alike = FormationVecEnv(scenario, 1, **settings)
        if len(alike.plants) > 1:
            raise ValueError(f"scenario: {len(alike.plants)} tasks; workers take one task")
        self._robots = robots = alike.num_envs  # in a formation
        self._ray = connected_ray(address)
        try:
            there = int(self._ray.cluster_resources().get("CPU", 0))
            if there < workers * threads:
                raise ValueError(
                    f"workers {workers} with threads {threads} need {workers * threads} processors, "
                    f"the cluster has {there}"
                )
            actor = self._ray.remote(num_cpus=threads)(Worker)
            self._workers = [
                actor.remote(scenario, share, threads=threads, **settings) for share in shares
            ]
            self._wait(worker.ready.remote() for worker in self._workers)
        except BaseException:
            self._ray.shutdown()
            raise
        self._ends = np.cumsum([0, *(share * robots for share in shares)])
        self._pending: list[Any] | None = None
        super().__init__(formations * robots, alike.observation_space, alike.action_space)
        self._seed = seed

    def _wait(self, answers: Iterable[Any]) -> list[Any]:
        """The workers' answers.

        Raises
        ------
        ConnectionError
            if a worker has ended.
        """
        found = []
        for number, answer in enumerate(answers):
            try:
                found.append(self._ray.get(answer))
            except self._ray.exceptions.RayTaskError as error:
                raise error.cause from None
            except self._ray.exceptions.RayActorError as error:
                raise ConnectionError(
                    f"worker {number} of {len(self._workers)} has ended: {error}"
                ) from None
        return found

    def _blocks(self) -> Iterable[tuple[Any, slice]]:
        """Each worker with the rows of its sub-environments."""
        for worker, first, end in zip(self._workers, self._ends, self._ends[1:], strict=False):
            yield worker, slice(first, end)

    def seed(self, seed: int | None = None) -> Sequence[int | None]:
        """Seed the next reset: formation k gets ``seed`` + k; returns each sub-environment's.

        Raises
        ------
        ValueError
            for a seed that is not a whole number from 0 on.
        """
        chosen = secrets.randbelow(2**31) if seed is None else checked_seed(seed)
        checked_seed(chosen + self.num_envs // self._robots - 1)
        self._seed = chosen
        self._seeds = [chosen + i // self._robots for i in range(self.num_envs)]
        return self._seeds

    def reset(self) -> np.ndarray:
        """Start an episode of every formation, with the given seed or the next one; ``(num_envs, entries)``."""
        answers = self._wait(
            worker.reset.remote(None if self._seed is None else self._seed + int(first))
            for worker, first in zip(self._workers, self._first_formation, strict=True)
        )
        self._seed = None
        self._reset_seeds()
        self._reset_options()
        self.reset_infos = [info for _, infos in answers for info in infos]
        return np.concatenate([observations for observations, _ in answers])

    def step_async(self, actions: np.ndarray) -> None:
        """Send the actions, ``(num_envs, 2)``, to the workers.

        Raises
        ------
        ValueError
            for actions of another shape or not finite; then no state changes.
        """
        given = real_numbers(actions)
        if (
            given is None
            or given.shape != (self.num_envs, ACTION_SIZE)
            or not np.isfinite(given).all()
        ):
            raise ValueError(
                f"actions must be {(self.num_envs, ACTION_SIZE)} finite numbers, got {shown(actions)}"
            )
        self._pending = [worker.step.remote(given[rows]) for worker, rows in self._blocks()]

    def step_wait(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, list[dict[str, Any]]]:
        """Wait for the step: observations, rewards, dones, infos.

        Raises
        ------
        ConnectionError
            if a worker has ended.
        """
        if self._pending is None:
            raise RuntimeError("call step_async() before step_wait()")
        pending, self._pending = self._pending, None
        observations, rewards, dones, infos = zip(*self._wait(pending), strict=True)
        return (
            np.concatenate(observations),
            np.concatenate(rewards),
            np.concatenate(dones),
            [info for each in infos for info in each],
        )

    def close(self) -> None:
        """End the workers and the connection."""
        self._workers = []
        self._ray.shutdown()

    def _each(self, indices: Any, call: Callable[[Any, list[int]], Any]) -> list[Any]:
        """Answers for sub-environments, in their order, from the workers that hold them."""
        chosen = np.asarray(list(self._get_indices(indices)))
        found: dict[int, Any] = {}
        for worker, rows in self._blocks():
            mine = chosen[(chosen >= rows.start) & (chosen < rows.stop)]
            if len(mine):
                (answers,) = self._wait([call(worker, (mine - rows.start).tolist())])
                found.update(zip(mine.tolist(), answers or [None] * len(mine), strict=True))
        return [found[i] for i in chosen.tolist()]

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        """As :meth:`baselines.sb3.FormationVecEnv.get_attr`; ``place`` is that within the worker."""
        return self._each(
            indices, lambda worker, mine: worker.call.remote("get_attr", attr_name, indices=mine)
        )

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        """As :meth:`baselines.sb3.FormationVecEnv.set_attr`."""
        self._each(
            indices,
            lambda worker, mine: worker.call.remote("set_attr", attr_name, value, indices=mine),
        )

    def env_method(
        self, method_name: str, *method_args: Any, indices: Any = None, **method_kwargs: Any
    ) -> list[Any]:
        """As :meth:`baselines.sb3.FormationVecEnv.env_method`."""
        return self._each(
            indices,
            lambda worker, mine: worker.call.remote(
                "env_method", method_name, *method_args, indices=mine, **method_kwargs
            ),
        )

    def env_is_wrapped(
        self, wrapper_class: type[gymnasium.Wrapper], indices: Any = None
    ) -> list[bool]:
        """False for each sub-environment: there are no wrappers."""
        return [False for _ in self._get_indices(indices)]


class Worker:
    """The environment of a worker, in its process."""

    def __init__(self, scenario: Any, formations: int, **settings: Any) -> None:
        self._envs = FormationVecEnv(scenario, formations, **settings)

    def ready(self) -> bool:
        """Answer when the environment is there."""
        return True

    def reset(self, seed: int | None) -> tuple[np.ndarray, list[dict[str, Any]]]:
        """Observations and infos after a reset; formation k of this worker gets ``seed`` + k."""
        if seed is not None:
            self._envs.seed(seed)
        return self._envs.reset(), self._envs.reset_infos

    def step(
        self, actions: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, list[dict[str, Any]]]:
        """A control step of this worker's formations."""
        return self._envs.step(actions)

    def call(self, name: str, *arguments: Any, **named: Any) -> Any:
        """A method of the environment."""
        return getattr(self._envs, name)(*arguments, **named)
