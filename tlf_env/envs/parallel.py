"""The PettingZoo parallel environment."""

from __future__ import annotations

import secrets
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pymunk
from gymnasium.utils import seeding
from pettingzoo import ParallelEnv
from pettingzoo.utils.conversions import parallel_to_aec

from tlf_env.common.errors import is_one_of, shown
from tlf_env.common.trust import Trust
from tlf_env.disturbances.channels import CHANNELS
from tlf_env.engine.formation import STATE_LIMITS, STATE_SCALES, Formation, state_dtype
from tlf_env.engine.judging import TERMINATES, TRUNCATES
from tlf_env.engine.outside_base import separate_base
from tlf_env.engine.readout import info_rows
from tlf_env.engine.snapshot import Snapshot, checked_generator, checked_snapshot
from tlf_env.envs.spec import documented
from tlf_env.numerics.philox import MAX_SEED, checked_seed
from tlf_env.onboard.memory import caller_state, give_caller_state
from tlf_env.onboard.parts import Factory, part_name, real_numbers
from tlf_env.rendering.looks import RENDER_MODES
from tlf_env.task.actions import ACTION_SIZE
from tlf_env.task.info import INFO_KEYS, InfoChoice, chosen_keys
from tlf_env.task.observation import OBSERVATION_LIMIT
from tlf_env.task.scenario import Scenario, load_scenario
from tlf_env.task.start import start_options
from tlf_env.task.warn import ReferenceWarning as ReferenceWarning
from tlf_env.task.warn import warn_of

Agent = str
Adversary = Callable[["FormationParallelEnv"], Mapping[str, float | np.ndarray]]
KIND, ADVERSARY = "FormationParallelEnv", "adversary"
PETTINGZOO_TEST_OPTION = "options"  # PettingZoo's API test passes this option; it is ignored


@documented
class FormationParallelEnv(ParallelEnv[Agent, np.ndarray, np.ndarray]):
    """Robots in a line follow each other one time gap apart; every robot is an agent.

    The agents are ``robot_0`` (the leader, on the scenario's trajectory) to ``robot_{n-1}``; each
    follower's reference is computed from its predecessor's broadcast of one gap ago. All agents act at every
    control step. The tables of actions, observations, rewards and infos below are made from the code.

    Observations use data on board, not the true state (except with the estimator ``truth``); their size does
    not depend on the number of robots. An episode ends for the whole formation at once: when a robot is lost
    or touches another (if listed in ``end_on``), or at the horizon. The robots concerned are terminated, the
    others truncated.

    Parameters
    ----------
    scenario
        The name of a preset (a YAML file shipped in ``configs/``), a YAML file, a mapping or a
        :class:`~tlf_env.task.scenario.Scenario`.
    render_mode
        None, ``"rgb_array"`` (:meth:`render` returns frames) or ``"human"`` (a window, updated by every
        :meth:`reset` and :meth:`step`, at most in real time; the key h lists the keys of its view).
    adversary
        Called with the environment before every step; returns ``{channel: value or one per robot}`` to
        apply in that step, e.g. ``{"slip.delta_1_mm_s": 20.0}``.
    infos
        Whether :meth:`reset` and :meth:`step` return infos; or a sequence of the keys to return.
    trust
        Whether code that the scenario names (``"module:factory"``) may run: in this process (True) or in one of
        its own (``"isolated"``). Objects need no permission.
    **overrides
        Fields of the scenario; ``disturbance_level`` too.

    Raises
    ------
    TypeError
        in one line, for an unknown keyword.
    ValueError
        in one line, for an unknown key or an invalid value.
    """

    def __init__(
        self,
        scenario: str | Path | Mapping[str, Any] | Scenario = "infinity",
        *,
        render_mode: str | None = None,
        adversary: Adversary | None = None,
        infos: InfoChoice = True,
        trust: Trust = False,
        **overrides: Any,
    ) -> None:
        overrides, base = separate_base(overrides)
        overrides, parts = separate_parts(overrides)
        if adversary is not None:
            if not callable(adversary):
                raise ValueError(
                    f"adversary {shown(adversary)} must be callable with the environment"
                )
            overrides["adversary"] = True
        self._info_keys = chosen_keys(infos)
        channels = {channel.key: i for i, channel in enumerate(CHANNELS)}
        # Where some infos are chosen: their channels, and their places among what is read with these.
        chosen = sorted(channels[key] for key in self._info_keys if key in channels)
        self._chosen = np.array(chosen, dtype=np.intp)
        read = [key for key in INFO_KEYS if key not in channels or key in self._info_keys]
        self._pick = [(key, read.index(key)) for key in self._info_keys]
        self._scenario = load_scenario(scenario, **overrides)
        warn_of([self.scenario])
        self.metadata: dict[str, Any] = {
            "name": f"tlf_env/{self.scenario.name}-v0",
            "render_modes": list(RENDER_MODES),
            "is_parallelizable": True,
            "render_fps": 1 / self.scenario.control_period_s,
        }
        if render_mode is not None and not is_one_of(render_mode, RENDER_MODES):
            raise ValueError(
                f"render_mode {shown(render_mode)} is not one of {', '.join(RENDER_MODES)}, None"
            )
        self.render_mode = render_mode
        self.possible_agents = [f"robot_{i}" for i in range(self.scenario.robot_count)]
        self.agents: list[Agent] = []
        self._formation = Formation(self.scenario, parts, base, trust=trust)
        # Channels that stay for a whole episode are taken from its first infos.
        self._varying = np.array(
            [
                i
                for i, channel in enumerate(CHANNELS)
                if self.scenario.adversary
                or not self.scenario.disturbance.signal(channel.path).is_steady()
            ],
            dtype=np.intp,
        )
        steady = {one.key for i, one in enumerate(CHANNELS) if i not in self._varying}
        self._varying_keys = [key for key in INFO_KEYS if key not in steady]
        self._first_infos: list[dict[str, Any]] = []
        dtype = np.dtype(self.scenario.dtype)
        self.observation_spaces = {
            agent: gymnasium.spaces.Box(
                -OBSERVATION_LIMIT, OBSERVATION_LIMIT, self._seen().shape[1:], dtype.type
            )
            for agent in self.possible_agents
        }
        self.action_spaces = {
            agent: gymnasium.spaces.Box(-1.0, 1.0, (ACTION_SIZE,), dtype.type)
            for agent in self.possible_agents
        }
        limits = np.tile(STATE_LIMITS, len(self.possible_agents))
        dtype = state_dtype(self.scenario, self._formation.leader_path())
        self.state_space = gymnasium.spaces.Box(
            -limits.astype(dtype), limits.astype(dtype), dtype=dtype.type
        )
        self._adversary = adversary
        self._renderer: Any = None
        self._seed: int | None = None
        self._np_random: np.random.Generator | None = None
        self._episode = 0

    @property
    def np_random(self) -> np.random.Generator:
        """Random numbers for wrappers, seeded by :meth:`reset`; the environment draws none from it."""
        if self._np_random is None:
            self._np_random, _ = seeding.np_random(self._seed)
        return self._np_random

    @property
    def scenario(self) -> Scenario:
        """Everything that an episode depends on, except the seed."""
        return self._scenario

    @property
    def formation(self) -> Formation:
        """The simulation behind the environment; policies must not use its true state."""
        return self._formation

    @property
    def space(self) -> pymunk.Space:
        """The pymunk space, with its bodies at the present poses of the robots; mm, s, kg.

        Shapes, bodies and constraints that you add take part from the next :meth:`step` on, on the plants
        ``pymunk`` and ``chipmunk``. :meth:`reset` keeps them, and puts bodies back to where the first step
        found them.
        """
        return self._formation.space

    @property
    def robot_bodies(self) -> dict[Agent, pymunk.Body]:
        """The pymunk body of each robot, for constraints and forces; its origin is the centre of mass."""
        self._formation.space  # noqa: B018 - puts the bodies at their present poses
        return dict(zip(self.possible_agents, self._formation.plant.bodies, strict=True))

    @property
    def pushable_bodies(self) -> list[pymunk.Body]:
        """The pymunk bodies of the world's ``pushables``, in their order, where they are now."""
        return self._formation.plant.pushable_bodies

    @property
    def moving_bodies(self) -> list[pymunk.Body]:
        """The pymunk bodies of the world's ``moving`` obstacles, in their order, where they are now."""
        self._formation.space  # noqa: B018 - puts the bodies where they are now
        return self._formation.plant.moving_bodies

    def observation_space(self, agent: Agent) -> gymnasium.spaces.Box:
        """Space of an agent's observations; the same object at every call."""
        return self.observation_spaces[agent]

    def action_space(self, agent: Agent) -> gymnasium.spaces.Box:
        """Space of an agent's actions; the same object at every call."""
        return self.action_spaces[agent]

    def reset(
        self, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[Agent, np.ndarray], dict[Agent, dict[str, Any]]]:
        """Start an episode.

        Parameters
        ----------
        seed
            0 to 2⁶³ − 1. The same seed gives the same episode, bit for bit. None starts the next episode
            of the last seed, or of a random seed if there was none.
        options
            ``poses``: start poses of c at rest, ``(robot, 3)`` in mm, mm, rad; ``phase_s``: the time on
            its trajectory at which the leader's reference starts.

        Raises
        ------
        ValueError
            for a seed out of its range, an unknown option or an invalid value.
        ImportError
            in mode ``human`` without pygame.
        """
        given = options
        if isinstance(options, Mapping):
            given = {k: v for k, v in options.items() if k != PETTINGZOO_TEST_OPTION}
        start = start_options(given, self.scenario.robot_count)
        if seed is not None:
            self._seed, self._episode = checked_seed(seed), 0
            self._np_random = None
        elif self._seed is None:
            self._seed, self._episode = secrets.randbelow(MAX_SEED), 0
        else:
            self._episode += 1
        self._formation.reset(self._seed, self._episode, start)
        if self._renderer is not None:
            self._renderer.begin(self._path_mm())
        if self.render_mode == "human":
            self._draw(self.render_mode)
        self.agents = list(self.possible_agents)
        return self._observations(), self._infos()

    def get_state(self) -> Snapshot:
        """Everything that the future depends on, at this moment; the environment goes on unchanged.

        At any time, after the end of an episode too. The snapshot does not change with later steps.
        :meth:`~tlf_env.engine.snapshot.Snapshot.save` writes it to a file. Not in it: the random generators of
        the spaces, what is drawn, and the functions that you add to bodies, constraints and collisions.

        Raises
        ------
        RuntimeError
            before the first :meth:`reset`.
        ValueError
            in one line that names it, for a part, a policy or an adversary whose state cannot be read.
        """
        if self._seed is None:
            raise RuntimeError("call reset() before get_state()")
        numbers: dict[str, np.ndarray] = {}
        memory = {
            "over": not self.agents,
            "seed": self._seed,
            "episode": self._episode,
            "random": self._np_random,
        }
        adversary = caller_state(self._adversary, ADVERSARY, "adversary", numbers)
        inner = self._formation.get_state()
        return inner.within(KIND, {}, memory, {"adversary": adversary}, numbers)

    def set_state(
        self, state: Snapshot
    ) -> tuple[dict[Agent, np.ndarray], dict[Agent, dict[str, Any]]]:
        """Go back to a moment of :meth:`get_state`; all that follows is the same, bit for bit.

        Also a moment of another environment that was made with the same arguments, or of another process
        (:meth:`Snapshot.load <tlf_env.engine.snapshot.Snapshot.load>`); no :meth:`reset` is needed before.
        Objects that were added to the space must be there, in the same order.

        Returns
        -------
        The observations and infos of that moment, of all robots, as :meth:`reset`.

        Raises
        ------
        TypeError
            for anything but a :class:`~tlf_env.engine.snapshot.Snapshot`.
        ValueError
            in one line that names the first difference, for a state that does not fit, or that is damaged.
            Then nothing has changed, unless the ``set_state`` of a policy or an adversary raised an error.
        """
        checked_snapshot(state).check(KIND, {})
        self.restore(state)
        return self.now()

    def now(self) -> tuple[dict[Agent, np.ndarray], dict[Agent, dict[str, Any]]]:
        """The observations and infos of this moment, of all robots."""
        return self._observations(), self._infos(afresh=True)

    def restore(self, state: Snapshot) -> None:
        """:meth:`set_state` of a snapshot that contains that of a parallel environment."""
        over, episode = state.recall("over"), state.recall("episode")
        generator = checked_generator(state.recall("random"))
        seed = checked_seed(state.recall("seed"))
        if type(over) is not bool or type(episode) is not int or episode < 0:
            raise ValueError("the snapshot is damaged: its episode is none")
        self._formation.restore(state)
        give_caller_state(self._adversary, state.tree("adversary"), ADVERSARY, state.numbers)
        self.agents = [] if over else list(self.possible_agents)
        self._seed, self._episode, self._np_random = seed, episode, generator
        if self._renderer is not None:
            self._renderer.begin(self._path_mm())
        if self.render_mode == "human":
            self._draw(self.render_mode)

    def step(
        self, actions: dict[Agent, np.ndarray]
    ) -> tuple[
        dict[Agent, np.ndarray],
        dict[Agent, float],
        dict[Agent, bool],
        dict[Agent, bool],
        dict[Agent, dict[str, Any]],
    ]:
        """Advance all robots by one control period.

        Parameters
        ----------
        actions
            One action for every agent.

        Raises
        ------
        ValueError
            for a missing, unknown, wrongly shaped or non-finite action, naming the robot; the episode
            is not changed.
        RuntimeError
            before the first :meth:`reset`.
        """
        if not self.agents:
            if self._seed is None:
                raise RuntimeError("call reset() before step()")
            return {}, {}, {}, {}, {}
        self._take(actions)
        if self._adversary is not None:
            self._formation.impose(self._adversary(self))
        self._formation.step()
        a = self._formation.arrays
        rewards = dict(zip(self.agents, a.rewards[0].tolist(), strict=True))
        ends = dict(zip(self.agents, a.ends[0].tolist(), strict=True))
        ended = {agent: TERMINATES[end] for agent, end in ends.items()}
        cut = {agent: TRUNCATES[end] for agent, end in ends.items()}
        observations, infos = self._observations(), self._infos()
        if any(ends.values()):
            self.agents = []
        if self.render_mode == "human":
            self._draw(self.render_mode)
        return observations, rewards, ended, cut, infos

    def _take(self, actions: dict[Agent, np.ndarray]) -> None:
        buffer = self._formation.arrays.actions[0]
        if not isinstance(actions, Mapping) or len(actions) != len(self.agents):
            self._complain(actions)
        for i, agent in enumerate(self.agents):
            try:
                action = actions[agent]
            except KeyError:
                self._complain(actions)
            numbers = real_numbers(action)
            if numbers is None:
                raise ValueError(
                    f"{agent}: the action must be {ACTION_SIZE} numbers, got {shown(action)}"
                )
            if numbers.shape != (ACTION_SIZE,):
                raise ValueError(
                    f"{agent}: the action must have the shape ({ACTION_SIZE},), got {numbers.shape}"
                )
            buffer[i] = numbers

    def _complain(self, actions: Any) -> None:
        if not isinstance(actions, Mapping):
            raise ValueError(
                f"actions must be a mapping {{agent: {ACTION_SIZE} numbers}} with the agents "
                f"{', '.join(self.agents)}, got {shown(actions)}"
            )
        unknown = [agent for agent in actions if agent not in self.agents]
        missing = [agent for agent in self.agents if agent not in actions]
        what = f"{shown(unknown[0])} is not an agent" if unknown else f"no action for {missing[0]}"
        raise ValueError(f"{what}; the agents are {', '.join(self.agents)}")

    def _seen(self) -> np.ndarray:
        a = self._formation.arrays
        sensor = self.scenario.observation == "sensor"
        return a.sensor_observations[0] if sensor else a.observations[0]

    def _observations(self) -> dict[Agent, np.ndarray]:
        fresh = self._seen().copy()
        return dict(zip(self.possible_agents, fresh, strict=True))

    def _infos(self, *, afresh: bool = False) -> dict[Agent, dict[str, Any]]:
        keys, arrays = self._info_keys, self._formation.arrays
        if not keys:
            return {agent: {} for agent in self.possible_agents}
        if keys != INFO_KEYS:
            some = info_rows(arrays, channels=self._chosen)
            chosen = [{key: row[place] for key, place in self._pick} for row in some]
            return dict(zip(self.possible_agents, chosen, strict=True))
        if self._formation.step_count and not afresh:
            changed = info_rows(arrays, channels=self._varying)
            named = {}
            for agent, first, row in zip(
                self.possible_agents, self._first_infos, changed, strict=True
            ):
                named[agent] = info = first.copy()
                info.update(zip(self._varying_keys, row, strict=True))
            return named
        self._first_infos = [dict(zip(keys, row, strict=True)) for row in info_rows(arrays)]
        copies = [info.copy() for info in self._first_infos]
        return dict(zip(self.possible_agents, copies, strict=True))

    def state(self) -> np.ndarray:
        """The true state for critics: scaled :class:`tlf_env.task.info.State` of every robot.

        float32; but float64 if the scenario's ``dtype`` is, or if the reference path lies so far from the
        origin (some 260 m) that float32 would round a position by more than 0.01 mm.
        """
        scaled = self._formation.state() / STATE_SCALES
        return scaled.astype(self.state_space.dtype).ravel()

    def render(self) -> np.ndarray | None:
        """A frame ``(height, width, 3)`` uint8 in mode ``rgb_array``; None in mode ``human``.

        It shows robots, world and whatever else is in :attr:`space`; drawing changes none of it.
        In mode ``human`` it does nothing: :meth:`reset` and :meth:`step` have drawn the frame.

        Raises
        ------
        RuntimeError
            before the first :meth:`reset`, or if the environment was made without a render mode.
        """
        if self.render_mode is None or self._seed is None:
            raise RuntimeError("render() needs a render_mode and a previous reset()")
        return None if self.render_mode == "human" else self._draw(self.render_mode)

    def _draw(self, mode: str) -> np.ndarray | None:
        from tlf_env.rendering.renderer import renderer_of
        from tlf_env.rendering.scene import scene_of

        if self._renderer is None:
            self._renderer = renderer_of(self._formation, mode=mode)
        return self._renderer.draw(scene_of(self._formation))

    def _path_mm(self) -> np.ndarray:
        return self._formation.leader_path()

    def close(self) -> None:
        """Close the window, if any, and end the processes of code that runs in its own."""
        self._formation.close()
        if self._renderer is not None:
            self._renderer.close()
            self._renderer = None

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_renderer": None}


def separate_parts(overrides: dict[str, Any]) -> tuple[dict[str, Any], dict[str, Factory]]:
    """Split off parts that are given as objects: overrides with their names, and their factories by role."""
    parts = {
        role: overrides[role]
        for role in ("estimator", "wheel_loop", "observer")
        if callable(overrides.get(role))
    }
    return {**overrides, **{role: part_name(part) for role, part in parts.items()}}, parts


def parallel_env(
    scenario: str | Path | Mapping[str, Any] | Scenario = "infinity",
    *,
    render_mode: str | None = None,
    adversary: Adversary | None = None,
    infos: InfoChoice = True,
    trust: Trust = False,
    **overrides: Any,
) -> FormationParallelEnv:
    """Make the parallel environment; see :class:`FormationParallelEnv`."""
    return FormationParallelEnv(
        scenario,
        render_mode=render_mode,
        adversary=adversary,
        infos=infos,
        trust=trust,
        **overrides,
    )


def aec_env(
    scenario: str | Path | Mapping[str, Any] | Scenario = "infinity",
    *,
    render_mode: str | None = None,
    **overrides: Any,
) -> Any:
    """Make the turn-based (AEC) environment by PettingZoo's conversion.

    The robots move when the last of them has acted, and only then is a wrong action reported; call ``reset``
    after that.
    """
    return parallel_to_aec(parallel_env(scenario, render_mode=render_mode, **overrides))
