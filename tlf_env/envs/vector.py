"""Gymnasium's vector environment: many formations with one learner each, on the batch plant."""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
from gymnasium.utils import seeding
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space

from tlf_env.common.errors import is_one_of, shown
from tlf_env.common.trust import Trust
from tlf_env.engine import judging
from tlf_env.engine.batch import DOUBLE, BatchPlant, checked_count
from tlf_env.engine.excerpt import END_ROW, REWARD_ROW, Excerpt
from tlf_env.engine.snapshot import Snapshot, checked_generator, checked_snapshot
from tlf_env.envs.single import BY_REFERENCE, HasSpec
from tlf_env.onboard.parts import real_numbers
from tlf_env.task.actions import ACTION_SIZE
from tlf_env.task.info import INFO_KEYS, TIME_GAP_KEY, InfoChoice, chosen_keys
from tlf_env.task.observation import OBSERVATION_LIMIT
from tlf_env.task.scenario import Scenario, learners_action, load_scenario
from tlf_env.task.start import start_options
from tlf_env.task.warn import callers_level

KIND = "FormationVectorEnv"
RESET_MASK = "reset_mask"


def shortened(scenario: Any, max_episode_steps: int, overrides: dict[str, Any]) -> dict[str, float]:
    """The ``horizon_s`` of at most so many control steps, if it is shorter than the (first) scenario's."""
    steps = checked_count("max_episode_steps", max_episode_steps)
    if isinstance(scenario, Sequence) and not isinstance(scenario, str):
        if not scenario:
            return {}
        scenario = scenario[0]
    first = load_scenario(scenario, **overrides)
    if steps >= first.horizon_steps:
        return {}
    if overrides.get("horizon_s") is not None:
        warnings.warn(
            f"max_episode_steps {steps} ends episodes before horizon_s {first.horizon_s:g}, which is "
            f"{first.horizon_steps} steps",
            UserWarning,
            stacklevel=callers_level(),
        )
    return {"horizon_s": steps * first.control_period_s}


class FormationVectorEnv(HasSpec, VectorEnv[np.ndarray, np.ndarray, np.ndarray]):
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
    staggered
        Whether the first episodes end at different times; as in
        :class:`~tlf_env.engine.batch.BatchPlant`.
    precision
        ``"double"`` or ``"single"``, of the numbers in the substeps; as in
        :class:`~tlf_env.engine.batch.BatchPlant`.
    autoreset_mode
        ``NextStep`` (Gymnasium's default), ``SameStep`` or ``Disabled``.
    max_episode_steps
        Shortens the scenario's ``horizon_s`` to so many control steps, if it is longer. With a warning if
        ``horizon_s`` is given, too.
    infos
        Whether steps return infos; or a sequence of the keys to return.
    trust
        As in :class:`~tlf_env.engine.batch.BatchPlant`.
    render_mode
        None.
    **overrides
        Fields of the scenarios; ``disturbance_level`` too. ``action`` is by default that of
        :class:`~tlf_env.envs.single.FormationEnv`.

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
        staggered: bool = False,
        precision: str = DOUBLE,
        autoreset_mode: str | AutoresetMode = AutoresetMode.NEXT_STEP,
        render_mode: str | None = None,
        max_episode_steps: int | None = None,
        infos: InfoChoice = True,
        trust: Trust = False,
        **overrides: Any,
    ) -> None:
        if "formations" in overrides:
            raise TypeError("unexpected keyword argument 'formations'; use num_envs")
        if max_episode_steps is not None:
            overrides |= shortened(scenario, max_episode_steps, overrides)
        self.plant = BatchPlant(
            scenario,
            checked_count("num_envs", num_envs),
            threads=threads,
            mixture=mixture,
            staggered=staggered,
            precision=precision,
            trust=trust,
            **learners_action(scenario, overrides),
        )
        self._info_keys = chosen_keys(infos)
        self._mask_keys = [f"_{key}" for key in self._info_keys]
        self._info_rows = [INFO_KEYS.index(key) for key in self._info_keys]
        flags = {
            "lost": np.bool_,
            "touched": np.bool_,
            "touched_by": np.int64,
            "end": np.int64,
        }
        self._flags = {key: dtype for key, dtype in flags.items() if key in self._info_keys}
        robots = self.scenario.robot_count
        agents = [f"robot_{i}" for i in range(robots)]
        learner = agents[min(1, robots - 1)] if learner is None else learner
        if not is_one_of(learner, agents):
            raise ValueError(f"learner {shown(learner)} is not one of {', '.join(agents)}")
        if not is_one_of(others, [BY_REFERENCE]):
            raise ValueError(
                f"others {shown(others)} must be {BY_REFERENCE!r} in a vector environment"
            )
        if render_mode is not None:
            raise ValueError(
                f"render_mode {shown(render_mode)} must be None in a vector environment"
            )
        try:
            self.autoreset_mode = AutoresetMode(autoreset_mode)
        except ValueError as error:
            modes = ", ".join(mode.value for mode in AutoresetMode)
            raise ValueError(
                f"autoreset_mode {shown(autoreset_mode)} is not one of {modes}"
            ) from error
        self.learner = learner
        self._robot = agents.index(learner)
        self.plant.compute_time_gap_of([self._robot] if TIME_GAP_KEY in self._info_keys else [])
        others_of = [i for i in range(robots) if i != self._robot]
        self.plant.arrays.kinds[others_of] = self.scenario.reference_kind
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
        self._last = np.zeros_like(self._actions)  # observations of the last step with an end

    @property
    def scenario(self) -> Scenario:
        """Everything that an episode depends on, except the seed; of several scenarios, the first."""
        return self.plant.scenario

    def reset(
        self,
        *,
        seed: int | Sequence[int | None] | None = None,
        options: dict[str, Any] | None = None,
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Start an episode in all formations, or in those of ``options["reset_mask"]``.

        Parameters
        ----------
        seed
            The seed of sub-environment k is ``seed`` + k, or ``seed[k]``; None starts its next episode.
        options
            ``reset_mask``: ``(num_envs,)`` bool; ``poses`` and ``phase_s``: as in
            :meth:`~tlf_env.engine.batch.BatchPlant.reset`, for the episodes that this call starts.

        Returns
        -------
        The observations of all formations, and the infos of those that were reset: elsewhere the masks
        are False and the values 0.

        Raises
        ------
        ValueError
            for a seed out of its range, a mask of another shape, or an unknown or invalid option.
        """
        mask = None
        if isinstance(options, Mapping):
            mask = options.get(RESET_MASK)
            options = {key: value for key, value in options.items() if key != RESET_MASK}
        start = start_options(options, self.scenario.robot_count, self.num_envs)
        chosen, given, seeds = self.plant.check_reset(seed, mask)
        # With NextStep, the next episode of a formation that ended has started already.
        begun = chosen & ~given & self._over
        if self.autoreset_mode is not AutoresetMode.NEXT_STEP:
            begun[:] = False
        if begun.any():
            self.plant.restart(begun, start)
        self.plant.reset(seed, chosen & ~begun, start)
        if given.any():
            self._np_random, self._np_random_seed = seeding.np_random(int(seeds[given][0]))
        self._over &= ~chosen
        seen = self._now()
        return seen.observations, self._infos(seen, None if mask is None else chosen)

    def _now(self) -> Excerpt:
        """What is seen of the learners at this moment."""
        seen = self.plant.excerpt(self._robot)
        self.plant.write_excerpt(seen)
        if self.autoreset_mode is AutoresetMode.NEXT_STEP and self._over.any():
            # They have ended and restart in the next step: until then their last observation is seen.
            seen.observations[self._over] = self._last[self._over]
        return seen

    def get_state(self) -> Snapshot:
        """Everything that the future of all formations depends on; :meth:`set_state` goes back to it.

        At any time, also between the end of an episode and the next. Not in it: the generators of the spaces.

        Raises
        ------
        RuntimeError
            before the first :meth:`reset`.
        """
        shows_last = self.autoreset_mode is AutoresetMode.NEXT_STEP and self._over.any()
        memory = {
            "over": self._over,
            "last": self._last if shows_last else None,
            "own_random": self._np_random,
            "own_random_seed": self._np_random_seed,
        }
        return self.plant.get_state().within(KIND, self._facts(), memory, {}, {})

    def _facts(self) -> dict[str, Any]:
        """What must be equal where a snapshot is put back, apart from the plant."""
        return {"learner": self.learner, "autoreset_mode": self.autoreset_mode.value}

    def set_state(self, state: Snapshot) -> tuple[np.ndarray, dict[str, Any]]:
        """Go back to a moment of this environment, or of another one that was made with the same arguments.

        Returns
        -------
        The observations and infos of that moment, of all formations, as :meth:`reset`.

        Raises
        ------
        TypeError
            for anything but a :class:`~tlf_env.engine.snapshot.Snapshot`.
        ValueError
            in one line that names the first difference, for a state that does not fit, or that is damaged;
            then nothing has changed.
        """
        checked_snapshot(state).check(KIND, self._facts())
        over, last = state.recall("over"), state.recall("last")
        generator = checked_generator(state.recall("own_random"))
        seed = state.recall("own_random_seed")
        fits = getattr(over, "shape", None) == self._over.shape and over.dtype == np.bool_
        if fits and over.any() and self.autoreset_mode is AutoresetMode.NEXT_STEP:
            wanted = self.plant.excerpt(self._robot).observations
            fits = getattr(last, "shape", None) == wanted.shape and last.dtype == wanted.dtype
        if not fits:
            raise ValueError("the snapshot is damaged: its ended formations do not fit")
        self.plant.restore(state)
        self._over = over
        self._last = self._last if last is None else last
        self._np_random, self._np_random_seed = generator, seed
        seen = self._now()
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
        if self._over.any() and self.autoreset_mode is not AutoresetMode.DISABLED:
            self._last = seen.observations.copy()
            self.plant.reset(mask=self._over)
            if self.autoreset_mode is AutoresetMode.SAME_STEP:
                seen, infos = self._begin_again(seen)
                return seen.observations, rewards, terminated, truncated, infos
        return seen.observations, rewards, terminated, truncated, self._infos(seen)

    def _begin_again(self, last: Excerpt) -> tuple[Excerpt, dict[str, Any]]:
        """Excerpt and infos of the new episodes, with the final ones of the ended episodes."""
        seen = Excerpt(last.robot, last.numbers.copy(), last.observations.copy())
        self.plant.write_excerpt(seen, self._over)
        final = np.full(self.num_envs, None, dtype=object)
        for k in np.flatnonzero(self._over):
            final[k] = last.observations[k]
        fresh = self._infos(seen)
        fresh |= {"final_obs": final, "_final_obs": self._over.copy()}
        fresh |= {"final_info": self._infos(last, self._over), "_final_info": self._over.copy()}
        self._over[:] = False
        return seen, fresh

    def _ends(self, seen: Excerpt) -> np.ndarray:
        return seen.numbers[END_ROW, : self.num_envs].astype(np.int8)

    def _infos(self, seen: Excerpt, of: np.ndarray | None = None) -> dict[str, Any]:
        """Infos in Gymnasium's form: for each key an array over the sub-environments and a mask ``_key``.

        ``of`` chooses sub-environments, all if None. The others have 0 and False.
        """
        rows = seen.numbers[:, : self.num_envs]
        if of is not None:
            rows = np.where(of, rows, 0.0)
        marks = np.empty((len(self._info_rows), self.num_envs), dtype=np.bool_)
        marks[:] = True if of is None else of
        infos: dict[str, Any] = {}
        for key, mask, row, mark in zip(
            self._info_keys, self._mask_keys, self._info_rows, marks, strict=True
        ):
            infos[key], infos[mask] = rows[row], mark
        for key, dtype in self._flags.items():
            infos[key] = infos[key].astype(dtype)
        return infos

    def close_extras(self, **kwargs: Any) -> None:
        """End the process in which the policy ``residual_base`` runs, if any; there is no window to close."""
        self.plant.close()
