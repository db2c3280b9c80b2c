"""Peers in JAX, in the form that JAX is fast in: ``jit`` of a ``scan`` over time of a ``vmap`` over formations.

Every observation and reward is computed in every step, as a learner needs them: their sum is carried
along, as the compiler leaves out what has no effect. Episodes do not end: ``step_env`` resets nothing. Keys
and actions are drawn before.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

LEAST_S = 0.1  # of a timing: a scan may take less than the clock can tell
BEAMS = 16  # of JaxNav's lidar, whose default is 200

Step = Callable[
    [Any, Any, Any], tuple[Any, Any]
]  # state, key, action → state, what a learner reads


class Rollout:
    """Formations that are stepped by one compiled scan; a drive of :mod:`~baselines.speed.served`.

    Parameters
    ----------
    reset
        Key → state of one formation.
    step
        Step of one formation.
    actions
        ``(at_once, formations, ...)``.
    """

    def __init__(self, reset: Callable[[Any], Any], step: Step, actions: Any) -> None:
        self.at_once, formations = jax.tree_util.tree_leaves(actions)[0].shape[:2]
        keys = jax.random.split(jax.random.PRNGKey(1), self.at_once * formations)
        self.inputs = (keys.reshape(self.at_once, formations, *keys.shape[1:]), actions)

        def one(carry: Any, inputs: Any) -> tuple[Any, None]:
            state, total = carry
            state, seen = jax.vmap(step)(state, *inputs)
            return (state, total + sum(jnp.sum(x) for x in jax.tree_util.tree_leaves(seen))), None

        begun = time.process_time()
        first = jax.jit(jax.vmap(reset))(jax.random.split(jax.random.PRNGKey(0), formations))
        self.carry = (first, jnp.float32(0.0))
        scan = jax.jit(lambda carry, inputs: jax.lax.scan(one, carry, inputs)[0])
        self.run = scan.lower(self.carry, self.inputs).compile()
        jax.block_until_ready(first)
        self.compile_s = time.process_time() - begun

    def __call__(self, steps: int) -> float:
        """Time of so many steps, s, from as many scans as the clock needs."""
        start = time.perf_counter()
        done = 0
        while done == 0 or time.perf_counter() - start < LEAST_S:
            self.carry = jax.block_until_ready(self.run(self.carry, self.inputs))
            done += self.at_once
        return (time.perf_counter() - start) * steps / done


def _jaxmarl(
    name: str, robots: int, formations: int, at_once: int, low: float, high: float, **options: Any
) -> Rollout:
    import jaxmarl

    env = jaxmarl.make(name, num_agents=robots, **options)
    keys = jax.random.split(jax.random.PRNGKey(2), robots)
    actions = {
        agent: jax.random.uniform(
            key, (at_once, formations, *env.action_space(agent).shape), minval=low, maxval=high
        )
        for agent, key in zip(env.agents, keys, strict=True)
    }

    def step(state: Any, key: Any, action: Any) -> tuple[Any, Any]:
        observations, state, rewards, _, _ = env.step_env(key, state, action)
        return state, (observations, rewards)

    return Rollout(lambda key: env.reset(key)[1], step, actions)


def spread_drive(robots: int, formations: int, threads: int, at_once: int) -> Rollout:
    """JaxMARL's ``MPE_simple_spread_v3`` with continuous actions: mpe2's model, in JAX."""
    return _jaxmarl(
        "MPE_simple_spread_v3",
        robots,
        formations,
        at_once,
        low=0.0,
        high=1.0,
        action_type="Continuous",
    )


def jaxnav_drive(robots: int, formations: int, threads: int, at_once: int) -> Rollout:
    """JaxMARL's ``jaxnav``: robots with two wheels and lidar among obstacles."""
    return _jaxmarl(
        "jaxnav", robots, formations, at_once, low=-0.5, high=1.0, lidar_num_beams=BEAMS
    )


def kheperax_drive(robots: int, formations: int, threads: int, at_once: int) -> Rollout:
    """Kheperax's standard maze: one Khepera with three lasers and two bumpers in each formation."""
    from kheperax.tasks.config import KheperaxConfig
    from kheperax.tasks.main import KheperaxTask

    if robots != 1:
        raise ValueError(f"robots {robots} must be 1")
    task = KheperaxTask(KheperaxConfig.get_default())
    actions = jax.random.uniform(
        jax.random.PRNGKey(2), (at_once, formations, task.action_size), minval=-1.0, maxval=1.0
    )

    def step(state: Any, key: Any, action: Any) -> tuple[Any, Any]:
        state = task.step(state, action)
        return state, (state.obs, state.reward)

    return Rollout(task.reset, step, actions)
