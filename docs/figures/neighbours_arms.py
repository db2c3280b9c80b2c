"""What robots of a row see in the arms of ``make_neighbours.py``: environments and policies."""

from __future__ import annotations

from typing import Any, NamedTuple

import gymnasium
import numpy as np

from baselines.data.episodes import entry_names
from baselines.sb3 import FormationVecEnv
from tlf_env.engine.batch import BatchPlant
from tlf_env.task.observation import OBSERVATION_LIMIT
from tlf_env.task.reward import RewardTerms, reward_terms
from tlf_env.task.scenario import Scenario

TWIST = 2  # entries of an action that move the robot; messages follow
MESSAGE = 4  # entries of a message
OF_PREDECESSOR = "predecessor_"
OF_THE_ERROR = ("far", "coarse", "medium", "fine")  # terms of the reward


class Arm(NamedTuple):
    """What a training differs in."""

    sees: str  # own, heard, shared or sent
    neighbour: bool = False  # hear one more robot
    by_path: bool = False  # rewarded for the distance to the leader's path


ARMS = {
    "own": Arm("own"),
    "heard": Arm("heard"),
    "two": Arm("heard", neighbour=True),
    "shared": Arm("shared"),
    "heard-path": Arm("heard", by_path=True),
    "shared-path": Arm("shared", by_path=True),
    "sent-path": Arm("sent", by_path=True),
}


def gap_steps(scenario: Scenario) -> int:
    """Control steps of a time gap."""
    return round(scenario.time_gap_s / scenario.control_period_s)


class Earlier:
    """The last values of some rows, up to a number of control steps ago; 0 where an episode was not so long.

    Parameters
    ----------
    steps
        How far back it reaches, from 1 on.
    rows, width
        Shape of the values of one step.
    """

    def __init__(self, steps: int, rows: int, width: int) -> None:
        self._kept = np.zeros((steps, rows, width), dtype=np.float32)
        self._noted = 0

    def note(self, values: np.ndarray) -> None:
        """Keep the values ``(row, entry)`` of the present step, which becomes the last one."""
        self._kept[self._noted % len(self._kept)] = values
        self._noted += 1

    def ago(self, steps: int) -> np.ndarray:
        """The values of so many steps ago, ``(row, entry)``; a view."""
        if not 1 <= steps <= len(self._kept):
            raise ValueError(f"steps {steps} must be from 1 to {len(self._kept)}")
        return self._kept[(self._noted - steps) % len(self._kept)]

    def clear(self, rows: np.ndarray) -> None:
        """Forget the values of the rows of a mask."""
        self._kept[:, rows] = 0.0


class Sight:
    """What the network sees in an arm, made of the observations of all robots of some rows.

    Parameters
    ----------
    sees
        own: without the entries of the predecessor; heard: as it is; shared: also the whole observation of the
        predecessor, now and one gap ago; sent: also the predecessor's message of the last control step and
        of one gap ago.
    scenario
        Of the task: its entries and its gap.
    leaders
        True for the rows without a predecessor; the predecessor of any other is the row before it.
    """

    def __init__(self, sees: str, scenario: Scenario, leaders: np.ndarray) -> None:
        self._sees, self._leaders = sees, np.asarray(leaders, dtype=np.bool_)
        names = entry_names(scenario)
        self._entries, self._gap = len(names), gap_steps(scenario)
        self._of_predecessor = [name.startswith(OF_PREDECESSOR) for name in names]
        kept = {"shared": self._entries, "sent": MESSAGE}.get(sees, 0)
        self._earlier = Earlier(self._gap, len(self._leaders), kept)
        self.width = self._entries + 2 * kept

    def seen(self, present: np.ndarray) -> np.ndarray:
        """What the network sees beside present observations ``(row, entry)``; a copy."""
        match self._sees:
            case "own":
                return np.where(self._of_predecessor, 0.0, present).astype(present.dtype)
            case "heard":
                return present.copy()
            case "shared":
                last = present
            case _:
                last = self._earlier.ago(1)
        parts = [present, self._ahead(last), self._ahead(self._earlier.ago(self._gap))]
        return np.concatenate(parts, axis=1)

    def _ahead(self, values: np.ndarray) -> np.ndarray:
        """The row of the predecessor in place of the own one; 0 for leaders."""
        shifted = np.roll(values, 1, axis=0)
        shifted[self._leaders] = 0.0
        return shifted

    def note(self, present: np.ndarray, messages: np.ndarray) -> None:
        """Keep what a step began with, and the messages that were sent in it."""
        if self._sees == "shared":
            self._earlier.note(present)
        elif self._sees == "sent":
            self._earlier.note(messages)

    def clear(self, rows: np.ndarray) -> None:
        """An episode begins in the rows of a mask."""
        self._earlier.clear(rows)


class RowVecEnv(FormationVecEnv):
    """Formations whose robots see, and are rewarded, as in an arm.

    In the arm that sends, an action has :data:`MESSAGE` further entries. They move nothing and cost nothing.

    Parameters
    ----------
    *args, **kwargs
        As for :class:`~baselines.sb3.FormationVecEnv`.
    arm
        Of :data:`ARMS`.
    """

    def __init__(self, *args: Any, arm: Arm, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self._arm = arm
        self._leaders = np.array([self.place(i).robot == 0 for i in range(self.num_envs)])
        first = self.plants[0].scenario
        for plant in self.plants[1:]:
            if gap_steps(plant.scenario) != gap_steps(first):
                raise ValueError(
                    f"task {plant.scenario.name!r} has time_gap_s {plant.scenario.time_gap_s:g}, the first "
                    f"task {first.time_gap_s:g}; tasks in one environment need the same"
                )
        self.sight = Sight(arm.sees, first, self._leaders)
        self._messages = np.zeros((self.num_envs, MESSAGE), dtype=np.float32)
        kind: Any = self.observation_space.dtype
        limit = OBSERVATION_LIMIT
        self.observation_space = gymnasium.spaces.Box(-limit, limit, (self.sight.width,), kind.type)
        if arm.sees == "sent":
            self.action_space = gymnasium.spaces.Box(-1.0, 1.0, (TWIST + MESSAGE,), kind.type)

    def observations(self) -> np.ndarray:
        """As its base, with what the arm adds, ``(num_envs, entries)``; a copy."""
        return self.sight.seen(super().observations())

    def reset(self) -> np.ndarray:
        """As its base; nothing was seen or sent before."""
        self.sight.clear(np.ones(self.num_envs, dtype=np.bool_))
        return super().reset()

    def begin_next(self, plant: int, mask: np.ndarray) -> None:
        """As its base; the robots of these formations have seen and sent nothing."""
        super().begin_next(plant, mask)
        begun = np.zeros(self.num_envs, dtype=np.bool_)
        robots = self.plants[plant].scenario.robot_count
        begun[self._ends[plant] : self._ends[plant + 1]] = np.repeat(mask, robots)
        self.sight.clear(begun)

    def step_async(self, actions: np.ndarray) -> None:
        """Keep the actions for the step, and pass the messages on."""
        if self._arm.sees == "sent":
            self._messages = np.clip(actions[:, TWIST:], -1.0, 1.0)
        super().step_async(actions[:, :TWIST])

    def step_wait(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, list[dict[str, Any]]]:
        """As its base; an episode's last observation has what came before, the next one's first has nothing."""
        self.sight.note(super().observations(), self._messages)
        # The base starts the next episodes within the step: what they replace has to be added here.
        observations, rewards, dones, infos = super().step_wait()
        if dones.any():
            self.sight.clear(dones)
            observations = self.observations()
        return observations, rewards, dones, infos


class PathVecEnv(RowVecEnv):
    """As its base; the terms of the reward that depend on the error have the distance to the leader's path."""

    def step_wait(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, list[dict[str, Any]]]:
        """As its base, but for the rewards. An episode that ended keeps the reward of its last step."""
        observations, rewards, dones, infos = super().step_wait()
        found = np.concatenate([by_path(plant).ravel() for plant in self.plants])
        return observations, np.where(dones, rewards, rewards + found), dones, infos


def by_path(plant: BatchPlant) -> np.ndarray:
    """What the rewards of the last step gain with the distance to the leader's path, ``(formation, robot)``."""
    places = [RewardTerms._fields.index(name) for name in OF_THE_ERROR]
    chosen = np.array([plant.scenario.reward[name] for name in OF_THE_ERROR])
    distances_mm = plant.info("formation_error_mm")
    wanted = [
        reward_terms(one, 0.0, 0.0, 0.0, False, False)[: len(OF_THE_ERROR)]
        for one in distances_mm.ravel().tolist()
    ]
    gained = np.array(wanted).reshape(*distances_mm.shape, -1) - plant.terms[:, :, places]
    result: np.ndarray = gained @ chosen
    return result


def environments(arm: Arm, *args: Any, **kwargs: Any) -> RowVecEnv:
    """The environments of an arm."""
    return (PathVecEnv if arm.by_path else RowVecEnv)(*args, arm=arm, **kwargs)


class RowPolicy:
    """A model of SB3 that was trained in an arm, as a policy for the observations of whole rows.

    Its state is a :class:`Sight`, which each call changes.
    """

    def __init__(self, model: Any, arm: Arm, scenario: Scenario) -> None:
        self._model, self._arm, self._scenario = model, arm, scenario

    def predict(
        self,
        observation: np.ndarray,
        state: Any = None,
        episode_start: np.ndarray | None = None,
        deterministic: bool = True,
    ) -> tuple[np.ndarray, Any]:
        """As SB3's ``predict``, for the rows of all robots of some formations, in order."""
        if state is None:
            leaders = np.arange(len(observation)) % self._scenario.robot_count == 0
            state = Sight(self._arm.sees, self._scenario, leaders)
        if episode_start is not None and episode_start.any():
            state.clear(episode_start)
        actions, _ = self._model.predict(state.seen(observation), deterministic=deterministic)
        state.note(observation, actions[:, TWIST:])
        return actions[:, :TWIST], state
