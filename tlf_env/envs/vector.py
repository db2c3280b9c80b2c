"""Gymnasium's vector environment: many formations with one learner each, on the batch plant."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import gymnasium
import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space

from tlf_env.common.errors import shown
from tlf_env.disturbances.channels import PATHS
from tlf_env.engine import judging
from tlf_env.engine.batch import BatchPlant
from tlf_env.engine.excerpt import (
    APPLIED_ROW,
    END_ROW,
    LOST_ROW,
    REWARD_ROW,
    TERMS_ROW,
    TOUCHED_ROW,
    Excerpt,
)
from tlf_env.envs.parallel import start_options
from tlf_env.envs.single import BY_REFERENCE
from tlf_env.onboard.parts import real_numbers
from tlf_env.task.actions import ACTION_SIZE, REFERENCE
from tlf_env.task.info import END_REASONS, Info
from tlf_env.task.observation import OBSERVATION_LIMIT
from tlf_env.task.reward import RewardTerms
from tlf_env.task.scenario import Scenario

RESET_MASK = "reset_mask"
REASONS = np.array(END_REASONS)


class Names(NamedTuple):
    """Keys of Gymnasium's infos, and of the masks of their sub-environments."""

    keys: tuple[str, ...]
    masks: tuple[str, ...]


INFO, REWARDS, DISTURBANCE, OTHERS = (
    Names(tuple(keys), tuple(f"_{key}" for key in keys))
    for keys in (
        Info._fields,
        RewardTerms._fields,
        PATHS,
        ("reward", "disturbance", "lost", "touched"),
    )
)


class FormationVectorEnv(VectorEnv[np.ndarray, np.ndarray, np.ndarray]):
    """Many formations with one learner each; the reference controller drives the other robots.

    Sub-environment k with seed s equals :class:`~tlf_env.envs.single.FormationEnv` with seed s + k, bit
    for bit, until two robots touch. It has no ``render``: make a single environment for pictures.

    Parameters
    ----------
    scenario
        One scenario, or a sequence that is distributed over the formations; as in
        :class:`~tlf_env.engine.batch.BatchPlant`.
    num_envs
        Number of formations.
    learner
        The agent that acts in each; as in :class:`~tlf_env.envs.single.FormationEnv`.
    others
        Only ``"reference"``: a policy in Python would be called once per robot.
    threads
        Number of threads for a step; None: one per core.
    mixture
        True, or a share for each scenario: every episode draws its scenario.
    autoreset_mode
        ``NextStep`` (Gymnasium's default), ``SameStep`` or ``Disabled``.
    render_mode
        None.
    **overrides
        Fields of the scenarios; ``disturbance_level`` too.

    Raises
    ------
    TypeError
        in one line, for an unknown keyword.
    ValueError
        in one line, for an unknown learner, mode, key or value.
    """

    def __init__(
        self,
        scenario: str | Path | Mapping[str, Any] | Scenario | Sequence[Any] = "infinity",
        num_envs: int = 1,
        *,
        learner: str | None = None,
        others: str = BY_REFERENCE,
        threads: int | None = 1,
        mixture: bool | Sequence[float] = False,
        autoreset_mode: str | AutoresetMode = AutoresetMode.NEXT_STEP,
        render_mode: str | None = None,
        **overrides: Any,
    ) -> None:
        self.plant = BatchPlant(scenario, num_envs, threads=threads, mixture=mixture, **overrides)
        self.scenario = self.plant.scenario
        robots = self.scenario.robot_count
        agents = [f"robot_{i}" for i in range(robots)]
        learner = agents[min(1, robots - 1)] if learner is None else learner
        if learner not in agents:
            raise ValueError(f"learner {learner!r} is not one of {', '.join(agents)}")
        if others != BY_REFERENCE:
            raise ValueError(f"others {others!r} must be {BY_REFERENCE!r} in a vector environment")
        if render_mode is not None:
            raise ValueError(f"render_mode {render_mode!r} must be None in a vector environment")
        try:
            self.autoreset_mode = AutoresetMode(autoreset_mode)
        except ValueError as error:
            modes = ", ".join(mode.value for mode in AutoresetMode)
            raise ValueError(f"autoreset_mode {autoreset_mode!r} is not one of {modes}") from error
        self.learner = learner
        self._robot = agents.index(learner)
        self.plant.arrays.kinds[[i for i in range(robots) if i != self._robot]] = REFERENCE
        self.num_envs = self.plant.formations
        self.metadata = {
            "render_modes": [],
            "render_fps": 1 / self.scenario.control_period_s,
            "autoreset_mode": self.autoreset_mode,
        }
        dtype = np.dtype(self.scenario.dtype)
        shape = self.plant.observations.shape[2:]
        self.single_observation_space = gymnasium.spaces.Box(
            -OBSERVATION_LIMIT, OBSERVATION_LIMIT, shape, dtype.type
        )
        self.single_action_space = gymnasium.spaces.Box(-1.0, 1.0, (ACTION_SIZE,), dtype.type)
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)
        self.action_space = batch_space(self.single_action_space, self.num_envs)
        self._actions = np.zeros((self.num_envs, robots, ACTION_SIZE))
        self._over = np.zeros(self.num_envs, dtype=np.bool_)  # ended and not restarted

    def reset(
        self,
        *,
        seed: int | Sequence[int] | None = None,
        options: dict[str, Any] | None = None,
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Start an episode in all formations, or in those of ``options["reset_mask"]``.

        The seed of sub-environment k is ``seed`` + k, or ``seed[k]``; None starts its next episode. Other
        options are not supported here.

        Raises
        ------
        ValueError
            for a seed out of its range, a mask of another shape, or another option.
        """
        options = dict(options or {})
        mask = options.pop(RESET_MASK, None)
        start_options(options, self.scenario.robot_count)
        if options:
            raise ValueError(
                f"reset option {next(iter(options))!r} does not exist in a vector environment; the "
                f"only option is {RESET_MASK}"
            )
        begun = self._begun(mask) if seed is None else np.zeros_like(self._over)
        if begun.any():  # their next episode has started already
            self.plant.restart(begun)
            mask = ~begun if mask is None else mask & ~begun
        self.plant.reset(seed, mask)
        self._over &= ~(np.ones_like(begun) if mask is None else mask | begun)
        seen = self.plant.excerpt(self._robot)
        self.plant.write_excerpt(seen)
        return seen.observations, self._infos(seen)

    def step(
        self, actions: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """Advance all formations by one control period; ``actions`` is ``(num_envs, 2)``.

        A formation that has ended is restarted according to ``autoreset_mode``. With ``NextStep`` its next
        action is ignored, and that step returns the first observation and a reward of 0.

        Raises
        ------
        ValueError
            for actions of another shape or not finite, naming the sub-environment; nothing is changed.
        RuntimeError
            before the first reset, or in mode ``Disabled`` if a formation ended and was not reset.
        """
        given = real_numbers(actions)
        if given is None:
            raise ValueError(
                f"actions must be real numbers in the shape {self._actions[:, self._robot].shape}, got "
                f"{shown(actions)}"
            )
        if given.shape != self._actions[:, self._robot].shape:
            raise ValueError(
                f"actions must have the shape {self._actions[:, self._robot].shape}, got {given.shape}"
            )
        if self._over.any() and self.autoreset_mode is AutoresetMode.DISABLED:
            raise RuntimeError(
                f"sub-environment {np.flatnonzero(self._over)[0]} has ended; reset it before step()"
            )
        self._actions[:, self._robot] = given
        begun = self._over
        seen = self.plant.excerpt(self._robot)
        self.plant.step(self._actions, seen)
        rewards = seen.numbers[REWARD_ROW, : self.num_envs]
        if begun.any():  # already started: put them back to their start
            self.plant.restart(begun)
            self.plant.write_excerpt(seen, begun)
            rewards[begun] = 0.0
        ends = self._ends(seen)
        terminated, truncated = judging.terminated(ends), judging.truncated(ends)
        self._over = terminated | truncated
        infos = self._infos(seen)
        if self._over.any() and self.autoreset_mode is not AutoresetMode.DISABLED:
            self.plant.reset(mask=self._over)
            if self.autoreset_mode is AutoresetMode.SAME_STEP:
                seen, infos = self._begin_again(seen, infos)
        return seen.observations, rewards, terminated, truncated, infos

    def _begun(self, mask: np.ndarray | None) -> np.ndarray:
        """The formations of the mask that have ended and are already restarted for the next step."""
        if self.autoreset_mode is not AutoresetMode.NEXT_STEP:
            return np.zeros_like(self._over)
        return self._over if mask is None else self._over & mask

    def _begin_again(self, last: Excerpt, infos: dict[str, Any]) -> tuple[Excerpt, dict[str, Any]]:
        """Excerpt and infos of the new episodes, with the final ones of the ended episodes."""
        seen = Excerpt(last.robot, last.numbers.copy(), last.observations.copy())
        self.plant.write_excerpt(seen, self._over)
        final = np.full(self.num_envs, None, dtype=object)
        for k in np.flatnonzero(self._over):
            final[k] = last.observations[k]
        fresh = self._infos(seen)
        fresh |= {"final_obs": final, "_final_obs": self._over.copy()}
        fresh |= {"final_info": infos, "_final_info": self._over.copy()}
        self._over[:] = False
        return seen, fresh

    def _ends(self, seen: Excerpt) -> np.ndarray:
        return seen.numbers[END_ROW, : self.num_envs].astype(np.int8)

    def _infos(self, seen: Excerpt) -> dict[str, Any]:
        """Infos in Gymnasium's form: for each key an array over the sub-environments and a mask ``_key``."""
        rows, ends = seen.numbers[:, : self.num_envs], self._ends(seen)
        everywhere = np.ones(self.num_envs, dtype=np.bool_)

        def named(names: Names, values: Iterable[Any]) -> dict[str, Any]:
            columns = dict(zip(names.keys, values, strict=True))
            columns.update(dict.fromkeys(names.masks, everywhere))
            return columns

        infos = named(INFO, rows[:TERMS_ROW])
        terms, channels = (
            named(REWARDS, rows[TERMS_ROW:APPLIED_ROW]),
            named(DISTURBANCE, rows[APPLIED_ROW:REWARD_ROW]),
        )
        infos |= named(OTHERS, (terms, channels, rows[LOST_ROW] != 0, rows[TOUCHED_ROW] != 0))
        ended = ends != 0
        reasons = np.zeros(self.num_envs, REASONS.dtype)
        reasons[ended] = REASONS[ends[ended]]
        return infos | {"end": reasons, "_end": ended}

    def close_extras(self, **kwargs: Any) -> None:
        """Do nothing: there is no window to close."""
