"""The Gymnasium environment: one robot is the learner, a policy drives the others."""

from __future__ import annotations

import copy
from abc import abstractmethod
from collections.abc import Mapping
from pathlib import Path
from typing import Any, cast

import gymnasium
import numpy as np
from gymnasium.envs.registration import EnvSpec

from tlf_env.common.errors import is_one_of, shown
from tlf_env.common.trust import Trust
from tlf_env.engine.snapshot import Snapshot, checked_generator, checked_snapshot
from tlf_env.envs.parallel import FormationParallelEnv
from tlf_env.envs.spec import documented
from tlf_env.hosting.host import close_policy, give_policy_state, named_policy, policy_state
from tlf_env.onboard.parts import Policy, part_name, predicted
from tlf_env.rendering.looks import RENDER_MODES
from tlf_env.task.actions import ACTION_SIZE, TWIST
from tlf_env.task.info import InfoChoice
from tlf_env.task.scenario import Scenario, learners_action

KIND, OTHERS = "FormationEnv", "policy of the other robots"
DRIVER = "others"  # its role, and its arrays in a snapshot
BY_REFERENCE = "reference"


class HasSpec:
    """The property ``spec`` of an environment with a scenario."""

    _spec: EnvSpec | None = None

    @property
    @abstractmethod
    def scenario(self) -> Scenario:
        """The scenario, whose horizon is the length."""

    @property
    def spec(self) -> EnvSpec | None:
        """Gymnasium's specification, with the steps of an episode; None without Gymnasium's makers."""
        return self._spec

    @spec.setter
    def spec(self, value: EnvSpec | None) -> None:
        self._spec = copy.deepcopy(value)
        if self._spec is not None:
            self._spec.max_episode_steps = self.scenario.horizon_steps


@documented
class FormationEnv(HasSpec, gymnasium.Env[np.ndarray, np.ndarray]):
    """One learner in a formation; a policy drives the other robots.

    Actions, observations, rewards and infos are those of the learner in
    :class:`tlf_env.envs.parallel.FormationParallelEnv`, see the tables below. The episode is terminated if
    the learner is lost or touches another robot, and truncated at the horizon or if another robot ends it.

    Parameters
    ----------
    scenario
        The name of a preset (a YAML file shipped in ``configs/``), a YAML file, a mapping or a
        :class:`~tlf_env.task.scenario.Scenario`.
    learner
        The agent that acts, ``"robot_0"`` to ``"robot_{n-1}"``. None: ``robot_1``, or ``robot_0`` in a
        formation of one robot.
    others
        The policy of the other robots: ``"reference"`` (the controller ``residual_base``), an object with
        SB3's ``predict`` from ``tracking`` observations to ``twist`` actions, or ``"module:factory"`` of
        such an object.
    render_mode
        None, ``"rgb_array"`` (:meth:`render` returns frames) or ``"human"`` (a window, updated by every
        :meth:`reset` and :meth:`step`, at most in real time).
    infos
        Whether :meth:`reset` and :meth:`step` return infos; or a sequence of the keys to return.
    trust
        Whether code that ``others`` or the scenario names (``"module:factory"``) may run: in this process
        (True) or in one of its own (``"isolated"``). Objects need no permission.
    **overrides
        Fields of the scenario; ``disturbance_level`` too. ``action`` is ``"tracking_twist"`` unless it, or
        the scenario's file or mapping, says otherwise; a :class:`~tlf_env.task.scenario.Scenario` keeps
        its own.

    Raises
    ------
    TypeError
        in one line, for an unknown keyword.
    ValueError
        in one line, for an unknown learner, key or value.
    """

    metadata: dict[str, Any] = {"render_modes": list(RENDER_MODES), "render_fps": 50}

    def __init__(
        self,
        scenario: str | Path | Mapping[str, Any] | Scenario = "infinity",
        *,
        learner: str | None = None,
        others: str | Policy = BY_REFERENCE,
        render_mode: str | None = None,
        infos: InfoChoice = True,
        trust: Trust = False,
        **overrides: Any,
    ) -> None:
        self.formation_env = FormationParallelEnv(
            scenario,
            render_mode=render_mode,
            infos=infos,
            trust=trust,
            **learners_action(scenario, overrides),
        )
        agents = self.formation_env.possible_agents
        if learner is None:
            learner = agents[min(1, len(agents) - 1)]
        if not is_one_of(learner, agents):
            raise ValueError(f"learner {shown(learner)} is not one of {', '.join(agents)}")
        self.learner = learner
        self.render_mode = render_mode
        self.metadata = dict(self.formation_env.metadata)
        self.observation_space = self.formation_env.observation_space(learner)
        self.action_space = self.formation_env.action_space(learner)
        self._rest = [i for i, agent in enumerate(agents) if agent != learner]
        self._driver = self._make_driver(others, trust)
        self._others = others if isinstance(others, str) else part_name(type(others))
        self._driver_state: Any = None
        kinds = self.formation_env.formation.arrays.kinds
        kinds[self._rest] = self.scenario.reference_kind if self._driver is None else TWIST
        self._driver_start = np.ones(len(self._rest), dtype=np.bool_)
        self._still = {
            agents[i]: np.zeros(ACTION_SIZE, self.action_space.dtype) for i in self._rest
        }

    @staticmethod
    def _make_driver(others: str | Policy, trust: Trust) -> Policy | None:
        if is_one_of(others, [BY_REFERENCE]):
            return None
        driver: Any = others
        if isinstance(others, str):
            if ":" not in others:
                raise ValueError(
                    f"others {shown(others)} must be {BY_REFERENCE!r}, 'module:factory' or an object"
                )
            driver = named_policy(DRIVER, others, ACTION_SIZE, trust=trust)
        if isinstance(driver, type) or not hasattr(driver, "predict"):
            raise ValueError(f"others {shown(driver)} has no predict()")
        return cast(Policy, driver)

    @property
    def scenario(self) -> Scenario:
        """Everything that an episode depends on, except the seed."""
        return self.formation_env.scenario

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Start an episode, as :meth:`FormationParallelEnv.reset`; results are those of the learner."""
        super().reset(seed=seed)
        observations, infos = self.formation_env.reset(seed=seed, options=options)
        self._driver_state = None
        self._driver_start[:] = True
        return observations[self.learner], infos[self.learner]

    def get_state(self) -> Snapshot:
        """Everything that the future depends on, as :meth:`FormationParallelEnv.get_state`.

        Of ``others`` the state that its ``predict`` returned last, and that of its own ``get_state`` if it
        has one. The counters of Gymnasium's wrappers are not in it.
        """
        numbers: dict[str, np.ndarray] = {}
        driver = policy_state(self._driver, OTHERS, DRIVER, numbers, self._driver_state)
        inner = self.formation_env.get_state()
        memory = {
            "driver_start": self._driver_start,
            "own_random": self._np_random,
            "own_random_seed": self._np_random_seed,
        }
        return inner.within(KIND, self._facts(), memory, {"others": driver}, numbers)

    def _facts(self) -> dict[str, Any]:
        """What must be equal where a snapshot is put back, apart from the formation."""
        return {"learner": self.learner, "others": self._others}

    def set_state(self, state: Snapshot) -> tuple[np.ndarray, dict[str, Any]]:
        """Go back to a moment, as :meth:`FormationParallelEnv.set_state`; results are those of the learner."""
        checked_snapshot(state).check(KIND, self._facts())
        start = state.recall("driver_start")
        generator = checked_generator(state.recall("own_random"))
        seed = state.recall("own_random_seed")
        if getattr(start, "shape", None) != self._driver_start.shape or start.dtype != np.bool_:
            raise ValueError("the snapshot is damaged: its driver_start does not fit")
        env = self.formation_env
        env.restore(state)
        tree = state.tree("others")
        self._driver_state = give_policy_state(self._driver, tree, OTHERS, DRIVER, state.numbers)
        self._driver_start[:] = start
        self._np_random, self._np_random_seed = generator, seed
        observations, infos = env.now()
        return observations[self.learner], infos[self.learner]

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """Advance all robots by one control period.

        Raises
        ------
        ValueError
            for a wrongly shaped or non-finite action, also of ``others``; the episode is not changed.
        RuntimeError
            before the first reset, or after the end of the episode.
        """
        if not self.formation_env.agents:
            raise RuntimeError("call reset() before step()")
        actions = self._drive() | {self.learner: action}
        observations, rewards, terminated, truncated, infos = self.formation_env.step(actions)
        me = self.learner
        return observations[me], rewards[me], terminated[me], truncated[me], infos[me]

    def _drive(self) -> dict[str, np.ndarray]:
        if self._driver is None or not self._rest:
            return dict(self._still)  # the engine replaces these actions by the reference's
        seen = self.formation_env.formation.arrays.observations[0, self._rest]
        answer = self._driver.predict(seen, self._driver_state, self._driver_start.copy(), True)
        actions, self._driver_state = predicted(answer, (len(seen), ACTION_SIZE), "others")
        self._driver_start[:] = False
        return dict(zip(self._still, actions, strict=True))

    def state(self) -> np.ndarray:
        """The true state for critics; see :meth:`FormationParallelEnv.state`."""
        return self.formation_env.state()

    def render(self) -> np.ndarray | None:
        """A frame in mode ``rgb_array``; None in mode ``human``, where reset and step draw."""
        return self.formation_env.render()

    def close(self) -> None:
        """Close the window, if any, and end the processes of code that runs in its own."""
        self.formation_env.close()
        close_policy(self._driver)
