"""Wrappers of Gymnasium and SuperSuit; and PPO in plain torch on ``gymnasium.make_vec``, as CleanRL has it.

The loop is that of CleanRL's ``ppo_continuous_action.py``, without its logging, and for environments that end
in one step and begin anew in the next (Gymnasium's autoreset mode ``NextStep``): the step of a new beginning
is left out of the losses.
"""

from __future__ import annotations

from pathlib import Path

import gymnasium
import numpy as np
import rung
import torch
from torch import nn
from wrappers import outcomes

ENVS, ROLLOUT, EPOCHS, BATCHES = 16, 64, 8, 4
GAMMA, LAMBDA, CLIP, RATE, VALUE_WEIGHT, NORM = 0.99, 0.95, 0.2, 1e-3, 0.5, 0.5


def layer(inputs: int, outputs: int, gain: float = 2.0**0.5) -> nn.Linear:
    """A layer with orthogonal weights."""
    made = nn.Linear(inputs, outputs)
    nn.init.orthogonal_(made.weight, gain)
    nn.init.zeros_(made.bias)
    return made


class Agent(nn.Module):
    """A critic, and an actor with one standard deviation."""

    def __init__(self, observations: int, actions: int) -> None:
        super().__init__()

        def network(outputs: int, gain: float) -> nn.Sequential:
            hidden = [layer(observations, 64), nn.Tanh(), layer(64, 64), nn.Tanh()]
            return nn.Sequential(*hidden, layer(64, outputs, gain))

        self.critic, self.actor = network(1, 1.0), network(actions, 0.01)
        self.log_std = nn.Parameter(torch.zeros(actions))

    def distribution(self, seen: torch.Tensor) -> torch.distributions.Normal:
        """Of the actions."""
        return torch.distributions.Normal(self.actor(seen), self.log_std.exp())


class CleanLoop(rung.Client):
    """PPO in a loop of one file."""

    library, package, algorithm, steps = "plain torch, as CleanRL", "gymnasium", "PPO", 60_000
    door = "`gymnasium.make_vec`"

    def __init__(self) -> None:
        torch.set_num_threads(1)
        torch.manual_seed(rung.SEED)
        self.envs = gymnasium.make_vec(rung.ID, num_envs=ENVS, infos=False, **rung.RUNG)
        self.sizes = tuple(
            space.shape[0]
            for space in (self.envs.single_observation_space, self.envs.single_action_space)
        )
        self.agent = Agent(*self.sizes)

    @staticmethod
    def _acting(agent: Agent) -> rung.Act:
        def act(observation: np.ndarray, first: bool) -> np.ndarray:
            with torch.no_grad():
                return agent.actor(torch.as_tensor(observation)).numpy()

        return act

    def act(self, observation: np.ndarray, first: bool) -> np.ndarray:
        return self._acting(self.agent)(observation, first)

    def learn(self) -> list[float]:
        agent, losses = self.agent, []
        optimiser = torch.optim.Adam(agent.parameters(), RATE, eps=1e-5)
        seen = torch.as_tensor(self.envs.reset(seed=rung.SEED)[0])
        begins = torch.zeros(ENVS, dtype=torch.bool)  # whether the next step begins an episode
        for _ in range(self.steps // (ENVS * ROLLOUT)):
            observations = torch.zeros(ROLLOUT, ENVS, self.sizes[0])
            actions = torch.zeros(ROLLOUT, ENVS, self.sizes[1])
            logs, rewards, values = (torch.zeros(ROLLOUT, ENVS) for _ in range(3))
            terminated, ended, used = (
                torch.zeros(ROLLOUT, ENVS, dtype=torch.bool) for _ in range(3)
            )
            after = torch.zeros(ROLLOUT, ENVS)  # value of what follows a step
            with torch.no_grad():
                for k in range(ROLLOUT):
                    drawn = agent.distribution(seen)
                    action = drawn.sample()
                    observations[k], actions[k], used[k] = seen, action, ~begins
                    logs[k], values[k] = drawn.log_prob(action).sum(-1), agent.critic(seen)[:, 0]
                    new, paid, lost, cut, _ = self.envs.step(action.clamp(-1.0, 1.0).numpy())
                    seen, rewards[k] = torch.as_tensor(new), torch.as_tensor(paid)
                    terminated[k], begins = torch.as_tensor(lost), torch.as_tensor(lost | cut)
                    ended[k], after[k] = begins, agent.critic(seen)[:, 0]
                advantages, last = torch.zeros(ROLLOUT, ENVS), torch.zeros(ENVS)
                for k in reversed(range(ROLLOUT)):
                    error = rewards[k] + GAMMA * after[k] * ~terminated[k] - values[k]
                    last = (error + GAMMA * LAMBDA * ~ended[k] * last) * used[k]
                    advantages[k] = last
                targets = advantages + values
            kept = used.flatten().nonzero()[:, 0]
            flat = [
                part.flatten(0, 1)[kept]
                for part in (observations, actions, logs, advantages, targets)
            ]
            for _ in range(EPOCHS):
                for rows in torch.randperm(len(kept)).chunk(BATCHES):
                    watched, acted, log, advantage, target = (part[rows] for part in flat)
                    advantage = (advantage - advantage.mean()) / (advantage.std() + 1e-8)
                    ratio = (agent.distribution(watched).log_prob(acted).sum(-1) - log).exp()
                    gain = torch.min(
                        ratio * advantage, ratio.clamp(1.0 - CLIP, 1.0 + CLIP) * advantage
                    )
                    off = (agent.critic(watched)[:, 0] - target).square().mean()
                    loss = VALUE_WEIGHT * off - gain.mean()
                    optimiser.zero_grad()
                    loss.backward()
                    nn.utils.clip_grad_norm_(agent.parameters(), NORM)
                    optimiser.step()
                    losses.append(loss.item())
        return losses

    def loaded(self, folder: Path) -> rung.Act:
        torch.save(self.agent.state_dict(), folder / "agent.pt")
        other = Agent(*self.sizes)
        other.load_state_dict(torch.load(folder / "agent.pt", weights_only=True))
        return self._acting(other)

    def close(self) -> None:
        self.envs.close()


def checks() -> list[dict[str, str]]:
    """What each wrapper does."""
    return list(outcomes())


CLIENTS = (CleanLoop,)
