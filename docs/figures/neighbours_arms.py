"""What robots of a row see or send in the arms of ``make_neighbours.py``: environments and policies."""

from __future__ import annotations

from typing import Any, NamedTuple

import gymnasium
import numpy as np

from baselines.data.episodes import entry_names
from baselines.sb3 import FormationVecEnv
from tlf_env.onboard.parts import Policy
from tlf_env.task.observation import OBSERVATION_LIMIT, TRACKING_ENTRIES
from tlf_env.task.scenario import Scenario

OF_PREDECESSOR = "predecessor_"
ERROR = ("e_1", "e_2", "e_1_fine", "e_2_fine")
MOST_MM = 20.0  # of a correction, forward and to the right: a start is not corrected


class Arm(NamedTuple):
    """What a training differs in."""

    sees: str  # own, heard or shared
    neighbour: bool = False  # hear one more robot


ARMS = {
    "own": Arm("own"),
    "heard": Arm("heard"),
    "two": Arm("heard", neighbour=True),
    "shared": Arm("shared"),
}


def gap_steps(scenario: Scenario) -> int:
    """Control steps of a time gap."""
    return round(scenario.time_gap_s / scenario.control_period_s)


def leaders_of(rows: int, scenario: Scenario) -> np.ndarray:
    """Which of some rows, those of whole formations in order, are leaders."""
    result: np.ndarray = np.arange(rows) % scenario.robot_count == 0
    return result


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


def ahead(values: np.ndarray, leaders: np.ndarray) -> np.ndarray:
    """The row of the predecessor in place of the own one, ``(row, entry)``; 0 for leaders."""
    shifted = np.roll(values, 1, axis=0)
    shifted[leaders] = 0.0
    return shifted


class Sight:
    """What the network sees in an arm, made of the observations of all robots of some rows.

    Parameters
    ----------
    sees
        own: without the entries of the predecessor; heard: as it is; shared: also the whole observation of the
        predecessor, now and one gap ago, without loss or delay.
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
        kept = self._entries if sees == "shared" else 0
        self._earlier = Earlier(self._gap, len(self._leaders), kept)
        self.width = self._entries + 2 * kept

    def seen(self, present: np.ndarray) -> np.ndarray:
        """What the network sees beside present observations ``(row, entry)``; a copy."""
        if self._sees == "own":
            return np.where(self._of_predecessor, 0.0, present).astype(present.dtype)
        if self._sees == "heard":
            return present.copy()
        late = self._earlier.ago(self._gap)
        parts = [present, ahead(present, self._leaders), ahead(late, self._leaders)]
        return np.concatenate(parts, axis=1)

    def note(self, present: np.ndarray) -> None:
        """Keep what a step began with."""
        if self._sees == "shared":
            self._earlier.note(present)

    def clear(self, rows: np.ndarray) -> None:
        """An episode begins in the rows of a mask."""
        self._earlier.clear(rows)


class RowVecEnv(FormationVecEnv):
    """Formations whose robots see what they see in an arm.

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
        kind: Any = self.observation_space.dtype
        limit = OBSERVATION_LIMIT
        self.observation_space = gymnasium.spaces.Box(-limit, limit, (self.sight.width,), kind.type)

    def observations(self) -> np.ndarray:
        """As its base, with what the arm adds, ``(num_envs, entries)``; a copy."""
        return self.sight.seen(super().observations())

    def reset(self) -> np.ndarray:
        """As its base; nothing was seen before."""
        self.sight.clear(np.ones(self.num_envs, dtype=np.bool_))
        return super().reset()

    def begin_next(self, plant: int, mask: np.ndarray) -> None:
        """As its base; the robots of these formations have seen nothing."""
        super().begin_next(plant, mask)
        begun = np.zeros(self.num_envs, dtype=np.bool_)
        robots = self.plants[plant].scenario.robot_count
        begun[self._ends[plant] : self._ends[plant + 1]] = np.repeat(mask, robots)
        self.sight.clear(begun)

    def step_wait(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, list[dict[str, Any]]]:
        """As its base; an episode's last observation has what came before, the next one's first has nothing."""
        self.sight.note(super().observations())
        observations, rewards, dones, infos = super().step_wait()
        if dones.any():
            self.sight.clear(dones)
            observations = self.observations()
        return observations, rewards, dones, infos


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
            leaders = leaders_of(len(observation), self._scenario)
            state = Sight(self._arm.sees, self._scenario, leaders)
        if episode_start is not None and episode_start.any():
            state.clear(episode_start)
        actions, _ = self._model.predict(state.seen(observation), deterministic=deterministic)
        state.note(observation)
        return actions, state


class Weights(NamedTuple):
    """What a message of two numbers is made of, and what is done with it, each forward and to the right."""

    sent: tuple[float, float]  # of the own error
    relayed: tuple[float, float]  # of the message that was received one gap ago
    applied: tuple[float, float]  # of that message, in the correction


ALL, NONE = (1.0, 1.0), (0.0, 0.0)
OWN_ERROR = Weights(sent=ALL, relayed=NONE, applied=ALL)
CORRECTED_ERROR = Weights(sent=ALL, relayed=ALL, applied=ALL)


class CorrectingPolicy:
    """A law on ``tracking`` observations, whose robots send two numbers to their successors.

    A follower's reference is where its predecessor was one gap ago, so it repeats its predecessor's error of
    that time. Here it adds what it received at that time to its own error. If that is the predecessor's error,
    it follows its predecessor's reference. If it is the predecessor's corrected error, all robots follow the
    leader's reference. The headings of both robots at that place are taken to be the same.

    Parameters
    ----------
    policy
        A law without a state.
    scenario
        Of the run.
    weights
        What is sent, and what is done with it.
    """

    def __init__(self, policy: Policy, scenario: Scenario, weights: Weights) -> None:
        self._policy, self._scenario, self._weights = policy, scenario, weights
        names = entry_names(scenario)
        self._places = [names.index(name) for name in ERROR]
        self._scales_mm = np.array([TRACKING_ENTRIES[name].scale for name in ERROR])

    def predict(
        self,
        observation: np.ndarray,
        state: Any = None,
        episode_start: np.ndarray | None = None,
        deterministic: bool = True,
    ) -> tuple[np.ndarray, Any]:
        """As SB3's ``predict``, for the rows of all robots of some formations, in order.

        The state is an :class:`Earlier`, which each call changes.
        """
        steps = gap_steps(self._scenario)
        if state is None:
            state = Earlier(steps, len(observation), 2)
        if episode_start is not None and episode_start.any():
            state.clear(episode_start)
        leaders = leaders_of(len(observation), self._scenario)
        heard_mm = np.clip(ahead(state.ago(steps), leaders), -MOST_MM, MOST_MM)
        own_mm = observation[:, self._places[:2]] * self._scales_mm[:2]
        corrected = observation.copy()
        sent, relayed, applied = map(np.array, self._weights)
        corrected[:, self._places] += np.tile(applied * heard_mm, 2) / self._scales_mm
        actions, _ = self._policy.predict(corrected, None, episode_start, deterministic)
        state.note(sent * own_mm + relayed * heard_mm)
        return actions, state
