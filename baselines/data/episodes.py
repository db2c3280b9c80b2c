"""Episodes of robots that a policy drives, with what a learner needs of them."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

from tlf_env.common.trust import Trust
from tlf_env.envs.parallel import parallel_env
from tlf_env.onboard.parts import Policy, predicted
from tlf_env.task.observation import sensor_entries, tracking_entries
from tlf_env.task.scenario import Scenario


class RobotEpisode(NamedTuple):
    """One robot from the start to the end, or all robots of a formation together.

    The observation of step ``k`` and the action that followed have the same index; there is one observation
    more. Together (``robot`` None) observations and actions have a further axis, the robots, and the reward is
    their mean.
    """

    task: str
    disturbance: str
    seed: int
    robot: int | None
    observations: np.ndarray  # (steps + 1, entry), in the units of the observation space
    actions: np.ndarray  # (steps, 2), within ±1
    rewards: np.ndarray  # (steps,)
    terminated: bool  # at the last step: lost, or touched
    truncated: bool  # at the last step: horizon, or another robot ended the episode


def entry_names(scenario: Scenario) -> list[str]:
    """Names of the entries of an observation, in their order."""
    if scenario.observation == "sensor":
        return list(sensor_entries(scenario.substeps, scenario.rays))
    return list(tracking_entries(scenario.preview_s, scenario.rays, scenario.neighbour))


def robots_of(
    scenario: Scenario,
    policy: Policy,
    seed: int,
    name: str = "policy",
    noise: float = 0.0,
    *,
    trust: Trust = False,
) -> list[RobotEpisode]:
    """An episode for each robot of one formation, driven by a policy in the parallel environment.

    Parameters
    ----------
    noise
        Standard deviation of normal noise on the actions, from 0 on, drawn anew in each step from a generator
        with the seed. The episode has the actions with it, within ±1.
    trust
        Whether code that the scenario names (``"module:factory"``) may run: in this process (True) or in one of
        its own (``"isolated"``).

    Raises
    ------
    ValueError
        naming the policy, if its ``predict`` returns no actions of the right shape.
    """
    env = parallel_env(scenario, infos=False, trust=trust)
    found, _ = env.reset(seed=seed)
    agents = list(env.agents)
    seen, acted, rewarded = [np.stack([found[one] for one in agents])], [], []
    state, start = None, np.ones(len(agents), dtype=np.bool_)
    ends: dict[str, tuple[bool, bool]] = {}
    generator = np.random.default_rng(seed)
    shape = (len(agents), env.action_space(agents[0]).shape[0])
    while env.agents:
        answer = policy.predict(seen[-1], state, start, True)
        actions, state = predicted(answer, shape, f"policy {name!r}")
        if noise:
            actions = actions + noise * generator.standard_normal(shape)
        actions = np.clip(actions, -1.0, 1.0).astype(np.float32)
        start = np.zeros_like(start)
        found, rewards, terminated, truncated, _ = env.step(dict(zip(agents, actions, strict=True)))
        seen.append(np.stack([found[one] for one in agents]))
        acted.append(actions)
        rewarded.append([rewards[one] for one in agents])
        ends = {one: (terminated[one], truncated[one]) for one in agents}
    observations, actions_of = np.stack(seen), np.stack(acted)
    rewards_of = np.array(rewarded, dtype=np.float64)
    return [
        RobotEpisode(
            task=scenario.name,
            disturbance=scenario.disturbance.name,
            seed=seed,
            robot=i,
            observations=observations[:, i],
            actions=actions_of[:, i],
            rewards=rewards_of[:, i],
            terminated=bool(ends[agent][0]),
            truncated=bool(ends[agent][1]),
        )
        for i, agent in enumerate(agents)
    ]


def together(robots: Sequence[RobotEpisode]) -> RobotEpisode:
    """The robots of one formation as one episode."""
    first = robots[0]
    ended = any(one.terminated for one in robots)
    return first._replace(
        robot=None,
        observations=np.stack([one.observations for one in robots], axis=1),
        actions=np.stack([one.actions for one in robots], axis=1),
        rewards=np.mean([one.rewards for one in robots], axis=0),
        terminated=ended,
        truncated=not ended,
    )


def collected(
    scenarios: Sequence[tuple[Scenario, Policy]],
    seeds: Sequence[int],
    name: str,
    *,
    joint: bool,
    noise: float = 0.0,
    trust: Trust = False,
) -> Iterator[RobotEpisode]:
    """Episodes of every scenario and seed, those of a formation one after another."""
    for scenario, policy in scenarios:
        for seed in seeds:
            robots = robots_of(scenario, policy, seed, name, noise, trust=trust)
            if joint:
                yield together(robots)
            else:
                yield from robots
