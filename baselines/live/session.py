"""An episode that runs step by step and can be changed by hand: restarts, patches, pushes, the level."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from baselines.policies.registry import FittedPolicy, describe_overrides, fit_policy
from baselines.runs.run import PolicyDriver
from tlf_env.common.trust import Trust
from tlf_env.disturbances.channels import CHANNELS, EPISODE, number
from tlf_env.disturbances.model import PatchRow, patch_rows
from tlf_env.engine.formation import Formation
from tlf_env.numerics.philox import MAX_SEED, checked_seed
from tlf_env.task.scenario import Scenario, load_scenario
from tlf_env.task.start import start_options
from tlf_env.task.warn import without_warnings

WITH_FORCES = ("pymunk", "chipmunk")  # plants on which a push and a patch act while an episode runs
PUSH_S = 0.2  # duration of a push
MOST_PUSH_N = 8.0  # the motors give about 0.4
PATCH_RADIUS_MM, PATCH_SCALE = 250.0, 0.1
MOST_LEVEL = 3.0


class Session:
    """An episode of a policy in a scenario, without early ends, and what was changed in it by hand.

    Without a change by hand it is the episode of ``tlf run`` with the same options, bit for bit.

    Parameters
    ----------
    scenario
        The task, before the policy asks for fields of it.
    policy
        Name of the policy.
    seed
        Seed of all random draws.
    options
        Of the start: ``poses`` and ``phase_s``.
    trust
        As of :func:`~baselines.policies.registry.fit_policy`.

    Raises
    ------
    ValueError
        in one line, for a name or a value that does not fit.
    """

    asked: Scenario
    policy: str
    seed: int
    fitted: FittedPolicy
    formation: Formation

    def __init__(
        self,
        scenario: Scenario,
        policy: str = "reference",
        seed: int = 0,
        *,
        options: Mapping[str, Any] | None = None,
        trust: Trust = False,
    ) -> None:
        self.options, self._trust = dict(options or {}), trust
        self.restart(scenario=scenario, policy=policy, seed=seed)

    def restart(
        self,
        *,
        scenario: Scenario | None = None,
        policy: str | None = None,
        seed: int | None = None,
    ) -> None:
        """Start again, without changes by hand; what is not given stays.

        If something does not fit, the present episode goes on.

        Raises
        ------
        ValueError
            in one line, for a name or a value that does not fit.
        """
        asked = self.asked if scenario is None else scenario
        name = self.policy if policy is None else policy
        number = self.seed if seed is None else checked_seed(seed)
        with without_warnings():
            fitted = fit_policy(name, asked, trust=self._trust)
            formation = self._formation(fitted)
        formation.reset(number, start=start_options(self.options, asked.robot_count))
        self.asked, self.policy, self.seed, self.fitted = asked, name, number, fitted
        self.formation = formation
        self.changes: list[str] = []  # by hand, in words
        self._driver = PolicyDriver(fitted.policy, fitted.scenario, formation.arrays, name)
        self._pushes: dict[int, tuple[int, float, float]] = {}  # robot: last step, force in N
        self._dropped: list[PatchRow] = []

    def _formation(self, fitted: FittedPolicy) -> Formation:
        scenario = fitted.scenario
        live = {"adversary": scenario.adversary or scenario.plant in WITH_FORCES}
        alike = scenario.model_copy(update={"end_on": (), **live})
        return Formation(alike, trust=self._trust)

    def next_seed(self) -> None:
        """Start again with the next seed."""
        self.restart(seed=(self.seed + 1) % (MAX_SEED + 1))

    def use_disturbance(self, name: str) -> None:
        """Start the same seed again with another disturbance, at its own level."""
        self.restart(scenario=load_scenario(self.asked, disturbance=name))

    @property
    def scenario(self) -> Scenario:
        """The scenario with what the policy asks for."""
        return self.fitted.scenario

    @property
    def asks_for(self) -> list[str]:
        """What the policy asks for, in words."""
        return describe_overrides(self.fitted.overrides)

    @property
    def ended(self) -> bool:
        """Whether the horizon is reached."""
        return self.formation.step_count >= self.scenario.horizon_steps

    def step(self) -> None:
        """One control step; none after the horizon."""
        if self.ended:
            return
        self.formation.arrays.actions[:] = self._driver.act()
        if self._pushes:
            self._impose()
        self.formation.step()

    # Changes by hand

    @property
    def level(self) -> float:
        """Level of the disturbance."""
        return float(self.formation.arrays.levels[0])

    def set_level(self, level: float) -> list[str]:
        """Set the level of the disturbance, from 0 to 3, from the next control step on.

        Returns
        -------
        list
            Groups of channels in the disturbance that are drawn at the start only and so do not change.

        Raises
        ------
        ValueError
            on a plant that takes no changes.
        """
        self._check_plant("the level cannot change while it runs")
        level = round(min(max(level, 0.0), MOST_LEVEL), 2)
        disturbance = self.scenario.disturbance
        self.formation.arrays.levels[0] = level
        self._lay_patches()
        self._note("level", f"level {level:g}")
        fixed = [
            channel.path.partition(".")[0]
            for channel in CHANNELS
            if channel.rate == EPISODE
            and disturbance.signal(channel.path).reach(channel.nominal)
            != (channel.nominal, channel.nominal)
        ]
        return list(dict.fromkeys(fixed))

    def drop_patch(self, x_mm: float, y_mm: float) -> None:
        """Put a round patch of little friction on the floor.

        Raises
        ------
        ValueError
            on a plant without forces.
        """
        self._check_plant("a patch has no effect")
        self._dropped.append(PatchRow(x_mm, y_mm, PATCH_RADIUS_MM, PATCH_SCALE))
        self._lay_patches()
        count = len(self._dropped)
        self._note("patch", f"{count} patch{'es' * (count > 1)}")

    def push(self, robot: int, x_N: float, y_N: float) -> tuple[float, float]:
        """Push a robot at its centre of mass for 0.2 s with a force of up to 8 N; the force that acts.

        Raises
        ------
        ValueError
            on a plant without forces.
        """
        self._check_plant("a push has no effect")
        force_N = math.hypot(x_N, y_N)
        factor = min(1.0, MOST_PUSH_N / force_N) if force_N > 0 else 1.0
        steps = max(round(PUSH_S / self.scenario.control_period_s), 1)
        force = x_N * factor, y_N * factor
        self._pushes[robot] = (self.formation.step_count + steps, *force)
        self._note("push", "push")
        return force

    def _check_plant(self, what: str) -> None:
        if self.scenario.plant not in WITH_FORCES:
            raise ValueError(f"plant {self.scenario.plant}: {what}")

    def _impose(self) -> None:
        """The pushes that act in the coming control step, in place of the disturbance's on those robots."""
        step = self.formation.step_count
        self._pushes = {i: push for i, push in self._pushes.items() if push[0] > step}
        imposed = self.formation.arrays.imposed
        imposed[:] = np.nan
        for i, (_, x_N, y_N) in self._pushes.items():
            imposed[number("push.x_N"), i, 0] = x_N
            imposed[number("push.y_N"), i, 0] = y_N

    def _lay_patches(self) -> None:
        """Put the scenario's patches, at the present level, and those that were dropped into the arrays."""
        scenario, arrays = self.scenario, self.formation.arrays
        disturbance = scenario.disturbance
        own = patch_rows(
            disturbance.model_copy(update={"level": self.level}), scenario.world.patches
        )
        rows = np.concatenate([own, np.array(self._dropped).reshape(-1, len(PatchRow._fields))])
        rows[:, PatchRow._fields.index("scale")] = np.maximum(rows[:, -1], 0.0)
        self.formation.arrays = arrays._replace(patches=np.ascontiguousarray(rows[None]))

    def _note(self, what: str, words: str) -> None:
        kept = [one for one in self.changes if what not in one]
        self.changes = [*kept, words]
