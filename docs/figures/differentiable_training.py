"""For ``make_differentiable.py``: formations of the model, and training by gradients through them.

Windows of the model follow each other, as in the short-horizon actor-critic of Xu et al., "Accelerated policy
learning with parallel differentiable simulation", ICLR 2022: the return of a window and a learned value at its
end have a gradient with respect to the policy's weights. No step of the plant is used.
"""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from differentiable_model import Model, Nature, State, driven, hypot
from torch import Tensor
from training_courses import Course

from baselines.policies.card import write_policy
from baselines.policies.network import Network
from baselines.runs.provenance import installed_versions, versions
from baselines.training.config import load_config
from baselines.training.export import TRAINERS
from tlf_env.engine.formation import reference_table
from tlf_env.task.reward import FAR_MM, RewardTerms
from tlf_env.task.scenario import Scenario, load_scenario

# What the trainings draw: standard deviations, where nothing else is said.
ROUTE_S = 100.0  # phases at which half of the episodes start; the others start at 0
EPISODE_S = 30.0
START = (80.0, 80.0, 0.3)  # of start poses, in half of the episodes
NOISE = (0.05, 0.05, 0.0005)  # of estimated poses, in every step
SLIP, LEFT = (
    (20.0, 0.15),
    (2.0, 0.01),
)  # of slip, in half of the draws, and of what an estimate of it misses
ESTIMATED = 0.8  # share of a change of the slip that an estimate finds in a window
KICK, CHANGE = 0.02, 0.1  # probability in a window of a kick, and of another nature of the robot
KICK_MM, KICK_RAD_MM = (3.0, 300.0), 0.001  # size of a kick, log-uniform, and its turn

FORMATIONS, WINDOWS, WINDOW = 48, 500, 32
RATE, VALUE_RATE, LAST_RATE, GAMMA, FITS, EXCESS = 6e-3, 2e-3, 0.03, 0.99, 6, 0.01
WARM = 100  # windows in which the weight of the value grows


class Formations:
    """Formations of the model that drive the tasks; a follower's reference is what its predecessor drove."""

    def __init__(self, model: Model, scenarios: Sequence[Scenario], count: int) -> None:
        self.model, self.count, self.robots = model, count, scenarios[0].robot_count
        self.spacing, self.lost = scenarios[0].start_spacing_mm, scenarios[0].lost_beyond_mm
        self.episode = round(EPISODE_S / model.period)
        long_s = ROUTE_S + EPISODE_S + WINDOW * model.period  # an episode ends with a window
        longer = [one.model_copy(update={"horizon_s": long_s}) for one in scenarios]
        tables = np.stack([reference_table(one) for one in longer])
        self.tables = torch.tensor(tables, dtype=torch.float32)
        self.ahead = max(model.previews)
        self.ring, self.step = model.gap + self.ahead + 2, 0
        shape = (count, self.robots)
        self.messages, self.references = torch.zeros(2, self.ring, *shape, 5)
        self.observed = torch.zeros(*shape, 3)
        self.clock, self.route, self.phase, self.ends = torch.zeros(4, count, dtype=torch.long)
        ends = ((3,), (2,), (2, 2), (2,), (2,), (2,), ())
        self.state = State(*(torch.zeros(*shape, *end) for end in ends))
        self.nature = Nature(*(torch.zeros(*shape, size) for size in (1, 1, 1, 2, 2)))
        self.roles = torch.zeros(*shape, 2)  # leader, last
        self.roles[:, 0, 0] = self.roles[:, -1, 1] = 1.0
        self.begin(torch.arange(count))
        self.ends = torch.randint(self.episode, (count,))  # so that later starts are spread
        self.vary(torch.ones(shape, dtype=torch.bool))

    def begin(self, lanes: Tensor, plain: bool = False) -> None:
        """Start an episode in some formations; a plain one begins as the task does."""
        if not len(lanes):
            return
        self.clock[lanes], self.ends[lanes] = 0, self.episode
        self.route[lanes] = torch.randint(len(self.tables), (len(lanes),))
        phase = torch.randint(round(ROUTE_S / self.model.period), (len(lanes),))
        self.phase[lanes] = torch.where(torch.rand(len(lanes)) < (not plain) / 2, phase, 0)
        pose = self.tables[self.route[lanes], self.phase[lanes], :3][:, None].repeat(
            1, self.robots, 1
        )
        back = torch.arange(self.robots)[:, None] * torch.tensor([-self.spacing, 0.0])
        pose = driven(pose, back.expand(len(lanes), -1, -1), 1.0)
        scattered = torch.rand(len(lanes), 1, 1) < (not plain) / 2
        pose += scattered * torch.randn(pose.shape) * torch.tensor(START)
        for kept in self.state:
            kept[lanes] = 0.0
        self.state.pose[lanes] = pose
        self.observed[lanes] = pose
        self.messages[:, lanes] = torch.cat([pose, torch.zeros_like(pose[..., :2])], dim=-1)
        for later in range(self.ahead + 1):
            self.refer(lanes, later)

    def vary(self, chosen: Tensor) -> None:
        """Draw what differs between robots anew, for some of them."""
        drawn = Nature(
            1 + 0.2 * torch.randn(self.nature.stiffness.shape).clamp(-2, 2),
            1 - 0.4 * torch.rand(self.nature.torque.shape),
            1 + 0.3 * torch.randn(self.nature.friction.shape).clamp(-2, 2),
            torch.randn(self.nature.slip.shape)
            * torch.tensor(SLIP)
            * (torch.rand(*chosen.shape, 1) < 0.5),
            self.nature.estimate,
        )
        every = zip(drawn, self.nature, strict=True)
        self.nature = Nature(*(torch.where(chosen[..., None], new, old) for new, old in every))

    def between(self) -> None:
        """Between two windows: new episodes, other robots, and kicks."""
        over = (self.clock >= self.ends) | (self.away() > self.lost).any(dim=-1)
        self.state = State(*(one.detach().clone() for one in self.state))
        shape = (self.count, self.robots)
        missed = self.nature.slip - self.nature.estimate
        drawn = torch.randn(missed.shape) * torch.tensor(LEFT)
        estimate = self.nature.estimate + ESTIMATED * missed + drawn
        self.nature = self.nature._replace(estimate=estimate)
        self.vary(torch.rand(shape) < CHANGE)
        low, high = map(math.log, KICK_MM)
        size = torch.exp(low + (high - low) * torch.rand(*shape, 1))
        kick = torch.randn(*shape, 3) * torch.cat([size, size, size * KICK_RAD_MM], dim=-1)
        self.state.pose.add_((torch.rand(*shape, 1) < KICK) * kick)
        self.begin(over.nonzero()[:, 0])

    def away(self) -> Tensor:
        """Distances of the robots from their references."""
        slot = self.step % self.ring
        away = self.references[slot, ..., :2] - self.messages[slot, ..., :2]
        return torch.hypot(*away.unbind(-1))

    def refer(self, lanes: Tensor, later: int) -> None:
        """The references of some formations ``later`` steps from now, as the robots' observers make them."""
        model, clock, slot = self.model, self.clock[lanes] + later, (self.step + later) % self.ring
        heard = self.messages[(self.step + later - model.gap) % self.ring, lanes][:, :-1]
        seen, u_1 = self.observed[lanes][:, 1:], heard[..., 3]
        sin, cos = torch.sin(seen[..., 2]), torch.cos(seen[..., 2])
        onward = torch.stack([-u_1 * sin, u_1 * cos, heard[..., 4]], dim=-1)
        share = (clock * model.period / model.smoothing).clamp(max=1.0)[:, None, None]
        pull = model.observer_gain * (heard[..., :3] - seen)
        rate = 0.5 * (1 - torch.cos(math.pi * share)) * (onward + pull)
        twist = torch.stack([torch.hypot(rate[..., 0], rate[..., 1]), rate[..., 2]], dim=-1)
        self.references[slot, lanes, 1:] = torch.cat([seen, twist], dim=-1)
        self.references[slot, lanes, 0] = self.tables[self.route[lanes], self.phase[lanes] + clock]
        self.observed[lanes, 1:] = seen + model.period * rate

    def targets(self) -> Tensor:
        """The robots' references and previews, ``(formation, robot, target, 5)``."""
        slots = [(self.step + later) % self.ring for later in (0, *self.model.previews)]
        return self.references[slots].movedim(0, -2)

    def follow(self, state: State) -> None:
        """Take the robots one step later, and give them their next references."""
        self.state, self.step = state, self.step + 1
        self.clock += 1
        moved = state.odometry.detach() + self.nature.estimate
        self.messages[self.step % self.ring] = torch.cat([state.pose.detach(), moved], dim=-1)
        self.refer(torch.arange(self.count), self.ahead)


class Seen(NamedTuple):
    """What a step gives to the losses."""

    row: Tensor  # the observation
    action: Tensor  # before it is clipped
    reward: Tensor


WEIGHTS = RewardTerms(
    **load_config("from-nothing").evaluation_scenarios()["infinity", "nominal"].reward
)


def reward(error: Tensor, change: Tensor, action: Tensor) -> Tensor:
    """The reward of ``tlf_env.task.reward`` without its terms of slip and ends."""
    near = [torch.exp(-error / reach) for reach in (100.0, 10.0, 2.0)]
    total = WEIGHTS.far * error / FAR_MM + WEIGHTS.alive
    total = total + WEIGHTS.coarse * near[0] + WEIGHTS.medium * near[1] + WEIGHTS.fine * near[2]
    of_actions = WEIGHTS.action_change * change**2 + WEIGHTS.action_size * action**2
    return total + of_actions.sum(-1)


def make_network(known: Tensor, outputs: int, gain: float) -> torch.nn.Sequential:
    """64 × 64, tanh; the weights of entries that the model lacks are 0 and have no gradient."""
    layers = [
        torch.nn.Linear(len(known), 64),
        torch.nn.Tanh(),
        torch.nn.Linear(64, 64),
        torch.nn.Tanh(),
    ]
    network = torch.nn.Sequential(*layers, torch.nn.Linear(64, outputs))
    with torch.no_grad():
        network[0].weight *= known
        network[-1].weight *= gain
        network[-1].bias *= gain
    return network


def step_of(model: Model, policy: torch.nn.Module, roles: Tensor) -> Any:
    """One step of the policy in the model, as a function that can be compiled."""

    def step(state: State, nature: Nature, targets: Tensor, goal: Tensor, noise: Tensor) -> Any:
        seen = model.relative(state.pose + noise, targets)
        row = model.observation(state, seen, nature.estimate, roles)
        raw = policy(row)
        action = raw + (raw.clamp(-1, 1) - raw).detach()
        command = model.limited(seen, state.command, nature.estimate, action)
        after = model.moved(state, nature, action, command)
        error = hypot(*(goal - after.pose[..., :2]).unbind(-1))
        return after, Seen(row, raw, reward(error, action - state.action, action))

    return step


def driven_on(formations: Formations, step: Any) -> Seen:
    """Let formations drive on by one step."""
    goal = formations.references[(formations.step + 1) % formations.ring][..., :2].clone()
    noise = torch.randn(*goal.shape[:-1], 3) * torch.tensor(NOISE)
    after, seen = step(formations.state, formations.nature, formations.targets(), goal, noise)
    formations.follow(after)
    return seen


def train(seed: int, folder: Path) -> None:
    """Train with one seed and keep the last policy: windows of the model, and a learned value at their ends."""
    torch.set_num_threads(1)
    torch.manual_seed(seed)
    began, course = time.process_time(), Course()
    model = Model(learner())
    tasks = [
        load_scenario(task, action="tracking_twist", robots=3) for task in ("infinity", "flower")
    ]
    formations = Formations(model, tasks, FORMATIONS)
    known = (model.places < len(model.known)).float()
    # What a deterministic policy commands follows from the rest, so a value's slope there would be arbitrary.
    sighted = known * (model.places < 6 * (1 + len(model.previews)))
    policy, value, target = (
        make_network(one, size, gain)
        for one, size, gain in ((known, 2, 0.01), (sighted, 1, 0.1), (sighted, 1, 0.1))
    )
    target.load_state_dict(value.state_dict())
    step = torch.compile(step_of(model, policy, formations.roles))
    steps = [
        torch.optim.Adam(policy.parameters(), lr=RATE),
        torch.optim.Adam(value.parameters(), lr=VALUE_RATE),
    ]
    for window in range(WINDOWS):
        share = 1 - (1 - LAST_RATE) * window / WINDOWS
        for one, rate in zip(steps, (RATE, VALUE_RATE), strict=True):
            one.param_groups[0]["lr"] = rate * share
        formations.between()
        seen = [driven_on(formations, step) for _ in range(WINDOW)]
        state = formations.state
        sight = model.relative(state.pose, formations.targets())
        last = model.observation(state, sight, formations.nature.estimate, formations.roles)
        gain = min(window / WARM, 1.0) * target(last)[..., 0] / (1 - GAMMA)
        returns = []
        for one in reversed(seen):
            gain = one.reward + GAMMA * gain
            returns.append(gain.detach())
        excess = torch.stack([one.action for one in seen]).abs().sub(1).clamp(min=0).square().mean()
        loss = EXCESS * excess - gain.mean() / WINDOW
        steps[0].zero_grad()
        loss.backward()
        torch.nn.utils.clip_grad_norm_(policy.parameters(), 1.0)
        steps[0].step()
        rows = torch.stack([one.row for one in seen]).detach().flatten(0, 2)
        wanted = torch.stack(returns[::-1]).flatten() * (1 - GAMMA)
        for batch in torch.randperm(len(rows)).repeat(FITS).split(2048)[:FITS]:
            off = (value(rows[batch])[:, 0] - wanted[batch]).square().mean()
            steps[1].zero_grad()
            off.backward()
            steps[1].step()
        with torch.no_grad():
            for mine, theirs in zip(target.parameters(), value.parameters(), strict=True):
                mine.lerp_(theirs, 0.05)
        course.note(window, float(torch.stack([one.reward for one in seen]).detach().mean()))
        if window % 100 == 0:
            error = torch.hypot(*(rows[:, :2] * model.scales[:2]).unbind(-1)).median()
            print(f"window {window}: median error {float(error):.1f} mm", flush=True)
    save(policy, seed, folder, time.process_time() - began)
    course.keep(folder)


def learner() -> Scenario:
    """The scenario that the policy is made for: action, range, fade and broadcasts of `from-nothing`."""
    return load_config("from-nothing").evaluation_scenarios()["infinity", "nominal"]


def save(policy: torch.nn.Sequential, seed: int, folder: Path, took_s: float) -> None:
    """Write the policy with its card; the value is not kept."""
    folder.mkdir(parents=True, exist_ok=True)
    names = ("hidden.0", "hidden.1", "mean")
    dense = [layer for layer in policy if isinstance(layer, torch.nn.Linear)]
    tensors = {"log_std": np.full(2, -1.5)}
    for name, layer in zip(names, dense, strict=True):
        tensors |= {
            f"{name}.{kind}": getattr(layer, kind).detach().numpy() for kind in ("weight", "bias")
        }
    write_policy(
        folder / "policy.safetensors",
        Network(hidden=(64, 64), activation="tanh", head="gaussian"),
        tensors,
        learner(),
        algorithm="gradients through a differentiable model",
        training={"windows": WINDOWS, "window": WINDOW, "formations": FORMATIONS, "core_s": took_s},
        seeds={"learner": [seed]},
        versions=versions() | installed_versions(TRAINERS),
        scores={},
        command=f"python docs/figures/make_differentiable.py train --seeds {seed}",
    )
