"""A policy in Python as the base of the action ``residual``; it runs once a control step, for all robots."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from tlf_env.common.errors import shown
from tlf_env.common.trust import Trust
from tlf_env.engine.arrays import Arrays
from tlf_env.hosting.host import close_policy, give_policy_state, named_policy, policy_state
from tlf_env.onboard.parts import Policy, check_trust, make_part, part_name, predicted
from tlf_env.task.actions import ACTION_SIZE
from tlf_env.task.scenario import Scenario

ROLE = "residual_base"
BASE = "base"  # its arrays in a snapshot


def separate_base(overrides: Mapping[str, Any]) -> tuple[dict[str, Any], Any]:
    """Split off a ``residual_base`` that is given as an object: overrides with its name, and the object.

    The object is None if there is none; then the scenario names a controller, or ``"module:factory"``.
    """
    base = overrides.get(ROLE)
    if isinstance(base, Path):
        base = str(base)
    if base is None or isinstance(base, str):
        return {**overrides, ROLE: base}, None
    named = base if callable(base) else type(base)
    return {**overrides, ROLE: part_name(named)}, base


def make_base(scenario: Scenario, given: Any = None, *, trust: Trust) -> OutsideBase | None:
    """The base of a scenario that is a policy in Python; None if its base is a controller.

    Parameters
    ----------
    given
        The policy, or a factory of it; None: what the scenario names is imported.
    trust
        As of :func:`~tlf_env.onboard.parts.check_trust`.

    Raises
    ------
    ValueError
        for a policy that cannot or may not be imported, cannot be made, or has no ``predict``; and for another
        ``trust``, also where there is no policy.
    """
    check_trust({}, trust)
    path = scenario.outside_base
    if path is None:
        return None
    if given is None:
        return OutsideBase(path, named_policy(ROLE, path, ACTION_SIZE, trust=trust))
    return OutsideBase(path, make_part(ROLE, path, given if callable(given) else lambda: given))


class OutsideBase:
    """A policy with SB3's ``predict`` from ``tracking`` observations to ``twist`` actions, and its state."""

    def __init__(self, name: str, policy: Policy) -> None:
        self._name, self._policy = name, policy
        self._state: Any = None

    @property
    def what(self) -> str:
        """Role and name, for errors."""
        return f"{ROLE} {self._name!r}"

    def get_state(self, numbers: dict[str, np.ndarray]) -> Any:
        """What the policy remembers, as JSON values, its arrays in ``numbers``.

        Raises
        ------
        ValueError
            in one line that names the policy, if its state is not plain.
        """
        return policy_state(self._policy, self.what, BASE, numbers, self._state)

    def set_state(self, tree: Any, numbers: Mapping[str, np.ndarray]) -> None:
        """Go on from a state of :meth:`get_state`.

        Raises
        ------
        ValueError
            in one line that names the policy, if it does not take its state.
        """
        self._state = give_policy_state(self._policy, tree, self.what, BASE, numbers)

    def close(self) -> None:
        """End the process of the policy, if it has one."""
        close_policy(self._policy)

    def command(self, arrays: Arrays) -> None:
        """Write the twists of all robots in all formations, as actions, for the coming step.

        Raises
        ------
        ValueError
            for actions of another shape or not finite; nothing has changed.
        """
        lanes, robots, entries = arrays.observations.shape
        starts = np.repeat(arrays.clock[:lanes, 1] == 0, robots)
        seen = arrays.observations.reshape(-1, entries).copy()
        answer = self._policy.predict(seen, self._state, starts, True)
        actions, state = predicted(answer, (len(seen), ACTION_SIZE), self.what)
        if not np.isfinite(actions).all():
            raise ValueError(f"{self.what}: the actions must be finite, got {shown(actions)}")
        arrays.twists[:] = np.clip(actions, -1.0, 1.0).reshape(arrays.twists.shape)
        self._state = state
