"""A history during a training: environments whose observations contain it, and the model as a policy."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np

from baselines.data.episodes import entry_names
from baselines.policies.history import History, Past
from baselines.sb3 import FormationVecEnv
from tlf_env.task.observation import OBSERVATION_LIMIT


class HistoryVecEnv(FormationVecEnv):
    """:class:`~baselines.sb3.FormationVecEnv` whose observations contain a robot's earlier ones.

    Parameters
    ----------
    *args, **kwargs
        As for :class:`~baselines.sb3.FormationVecEnv`.
    history
        Which earlier observations.

    Raises
    ------
    ValueError
        as its base does; for an entry that the observation lacks.
    """

    def __init__(self, *args: Any, history: History, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self.history = history
        self.past = Past(self.history, entry_names(self.plants[0].scenario))
        self.memory = self.past.memory(None, self.num_envs)  # before the present observations
        entries = self.plants[0].observations.shape[2]
        self.observation_space = gymnasium.spaces.Box(
            -OBSERVATION_LIMIT,
            OBSERVATION_LIMIT,
            (entries + history.size(entries),),
            np.dtype(self.plants[0].scenario.dtype).type,
        )

    def observations(self) -> np.ndarray:
        """Current observations with the earlier ones, ``(num_envs, entries)``; a copy."""
        return self.past.joined(super().observations(), self.memory)

    def reset(self) -> np.ndarray:
        """As its base; no robot has a past."""
        self.memory = self.past.memory(None, self.num_envs)
        return super().reset()

    def begin_next(self, plant: int, mask: np.ndarray) -> None:
        """As its base; the robots of these formations have no past."""
        super().begin_next(plant, mask)
        begun = np.zeros(self.num_envs, dtype=np.bool_)
        begun[self._ends[plant] : self._ends[plant + 1]] = np.repeat(
            mask, self.plants[plant].scenario.robot_count
        )
        self.memory[begun] = 0.0

    def step_wait(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, list[dict[str, Any]]]:
        """As its base. The last observation of an episode has its past, the first of the next one has none."""
        before = self.memory
        self.memory = self.past.after(before, super().observations())
        try:
            observations, rewards, dones, infos = super().step_wait()
        except Exception:
            self.memory = before
            raise
        if dones.any():
            self.memory[dones] = 0.0
            observations = self.observations()
        return observations, rewards, dones, infos


class ModelPolicy:
    """A model of SB3 as a policy for observations without their past: it keeps the past itself, as its state.

    Also normalises as the model's ``VecNormalize`` does, if it has one.
    """

    def __init__(self, model: Any) -> None:
        self._model = model
        history, self._past = history_of(model), None
        if history is not None:
            self._past = model.get_env().unwrapped.past
        self._normaliser = model.get_vec_normalize_env()

    def predict(
        self,
        observation: np.ndarray,
        state: Any = None,
        episode_start: np.ndarray | None = None,
        deterministic: bool = True,
    ) -> tuple[np.ndarray, Any]:
        """Actions for observations ``(row, entry)``, and the next state."""
        if self._past is None:
            seen = self._normalised(observation)
            answer: tuple[np.ndarray, Any] = self._model.predict(
                seen, state, episode_start, deterministic
            )
            return answer
        memory = self._past.memory(state, len(observation), episode_start)
        joined = self._past.joined(observation, memory)
        # What the environments add for the critic, the actor does not see.
        more = self._model.observation_space.shape[0] - joined.shape[1]
        seen = self._normalised(np.pad(joined, ((0, 0), (0, more))))
        actions, _ = self._model.predict(seen, deterministic=deterministic)
        return actions, self._past.after(memory, observation)

    def _normalised(self, observation: np.ndarray) -> np.ndarray:
        if self._normaliser is None:
            return observation
        seen: np.ndarray = self._normaliser.normalize_obs(observation)
        return seen


def history_of(model: Any) -> History | None:
    """The history of a model's environments, None if they have none."""
    envs = None if model.get_env() is None else model.get_env().unwrapped
    return envs.history if isinstance(envs, HistoryVecEnv) else None
