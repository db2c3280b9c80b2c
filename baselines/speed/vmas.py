"""A formation for VMAS, timed as a peer: unicycles with collisions, 10 substeps of 2 ms."""

from __future__ import annotations

import time
from collections.abc import Callable

import torch
from vmas import make_env
from vmas.simulator.core import Agent, Sphere, World
from vmas.simulator.dynamics.diff_drive import DiffDrive
from vmas.simulator.scenario import BaseScenario

CONTROL_PERIOD_S = 0.02
SUBSTEPS = 10
RADIUS_M, START_SPACING_M = 0.12, 0.6
ACTIONS_KEPT = 8


class VmasFormation(BaseScenario):
    """Robots in a line, each to keep one spacing to the robot ahead; collisions on."""

    def make_world(self, batch_dim: int, device: torch.device, **kwargs: int) -> World:
        """A world with ``robots`` robots."""
        self.plot_grid = False
        world = World(batch_dim, device, dt=CONTROL_PERIOD_S, substeps=SUBSTEPS)
        for i in range(kwargs["robots"]):
            world.add_agent(
                Agent(
                    name=f"robot_{i}",
                    shape=Sphere(radius=RADIUS_M),
                    collide=True,
                    u_multiplier=[1.0, 1.0],
                    dynamics=DiffDrive(world, integration="rk4"),
                )
            )
        return world

    def reset_world_at(self, env_index: int | None = None) -> None:
        """Robots in a line."""
        batch = (1,) if env_index is not None else (self.world.batch_dim, 1)
        for i, agent in enumerate(self.world.agents):
            x = torch.full(batch, -START_SPACING_M * i, device=self.world.device)
            agent.set_pos(torch.cat([x, torch.zeros_like(x)], dim=-1), batch_index=env_index)

    def _ahead(self, agent: Agent) -> torch.Tensor:
        i = self.world.agents.index(agent)
        return self.world.agents[max(i - 1, 0)].state.pos - agent.state.pos

    def reward(self, agent: Agent) -> torch.Tensor:
        """Minus the deviation of the distance to the robot ahead from the spacing."""
        return -(torch.linalg.vector_norm(self._ahead(agent), dim=-1) - START_SPACING_M).abs()

    def observation(self, agent: Agent) -> torch.Tensor:
        """Own pose and velocities, and the position of the robot ahead."""
        state = agent.state
        return torch.cat(
            [state.pos, state.rot, state.vel, state.ang_vel, self._ahead(agent)], dim=-1
        )


def vmas_drive(robots: int, formations: int, threads: int) -> Callable[[int], float]:
    """``drive(steps)``: time of so many steps of the formations, s; actions are drawn before."""
    env = make_env(
        scenario=VmasFormation(),
        num_envs=formations,
        device="cpu",
        continuous_actions=True,
        seed=0,
        robots=robots,
    )
    generator = torch.Generator().manual_seed(0)
    shape = (ACTIONS_KEPT, robots, formations, 2)
    kept = torch.tensor([0.3, 0.0]) + 0.1 * torch.randn(shape, generator=generator)
    actions = [[kept[k, i] for i in range(robots)] for k in range(ACTIONS_KEPT)]

    def drive(steps: int) -> float:
        before = torch.get_num_threads()
        torch.set_num_threads(threads)
        try:
            env.reset()
            with torch.no_grad():
                env.step(actions[0])
                start = time.perf_counter()
                for k in range(steps):
                    env.step(actions[k % ACTIONS_KEPT])
                return time.perf_counter() - start
        finally:
            torch.set_num_threads(before)

    return drive


def vmas_served(robots: int, formations: int, threads: int, at_once: int) -> Callable[[int], float]:
    """:func:`vmas_drive` as :mod:`~baselines.speed.served` asks for it."""
    return vmas_drive(robots, formations, threads)
