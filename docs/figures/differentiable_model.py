"""For ``make_differentiable.py``: a differentiable model of the robots, with motors, limiter and observation.

Lengths in mm, angles in rad, time in s, torques in mN·mm. Tensors begin with the robots' dimensions, in general
``(formation, robot)``.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from tlf_env.engine import readout
from tlf_env.engine.batch import BatchPlant
from tlf_env.engine.settings import make_settings
from tlf_env.onboard.limiter import TwistLimitsRow
from tlf_env.onboard.wheel_loop import WheelLoopParameters, digital_wheel_loop
from tlf_env.task.observation import OBSERVATION_LIMIT, Tracking, tracking_entries
from tlf_env.task.scenario import Scenario

SUBSTEPS = 4  # of the model in a control step; the plant has 20
# Torques of friction on each wheel, as ``make_differentiable.py check`` measures them along runs: of the axles,
# and of the castor's joint, which brakes one wheel and drives the other while its angle changes.
AXLES_mNmm, CASTOR_mNmm = 5000.0, 3700.0
STILL_RAD_S, STILL_RAD = 0.2, 3e-4  # speeds, and changes of the castor's angle, that are no motion


class State(NamedTuple):
    """The robots of the model."""

    pose: Tensor  # (..., 3): x, y, heading; as everywhere, heading 0 is +y
    wheels: Tensor  # (..., 2): speeds, left and right, rad/s
    held: Tensor  # (..., 2, 2): torques of the integrator and of the lag, for each wheel
    command: Tensor  # (..., 2): last commanded twist of the wheels
    action: Tensor  # (..., 2): last action
    odometry: Tensor  # (..., 2): twist by the wheels, mean over the last step
    castor: Tensor  # (...): angle of the castor


class Nature(NamedTuple):
    """What differs from robot to robot."""

    stiffness: Tensor  # (..., 1): of the wheel loop's gain, so inversely of its lag
    torque: Tensor  # (..., 1): of the largest torque; less grip is a smaller one
    friction: Tensor  # (..., 1): of the joints' friction
    slip: Tensor  # (..., 2): slip δ₁, δ₂
    estimate: Tensor  # (..., 2): what the limiter cancels of it, which is observed


def hypot(x: Tensor, y: Tensor) -> Tensor:
    """√(x² + y²) with a finite gradient at 0."""
    return torch.sqrt(x * x + y * y + 1e-8)


def bounded(value: Tensor, low: Tensor, high: Tensor) -> Tensor:
    """A value within bounds that are tensors, too."""
    return torch.minimum(torch.maximum(value, low), high)


class Model:
    """Unicycles on two wheels with eq. (13) in each, without tyres, castor and friction; behind the limiter."""

    def __init__(self, scenario: Scenario) -> None:
        plant = BatchPlant(scenario, 1)
        plant.reset(0)
        body = readout.named(plant.arrays, "body")
        self.radius, self.half = (float(one[0, 0]) for one in (body.R, body.h))
        self.pivot, self.trail = (float(one[0, 0]) for one in (body.pivot, body.T))
        self.limit = float(body.torque_limit[0, 0])
        settings = make_settings(scenario)
        self.full = torch.tensor([settings.full_1, settings.full_2])
        self.fade, self.lead = settings.tracking_fade, settings.limits.lead
        self.limits: TwistLimitsRow = settings.limits.limits
        self.period, self.gap = settings.period, settings.gap
        self.observer_gain, self.smoothing = settings.observer_gain, settings.smoothing
        self.previews = scenario.preview_steps
        parameters = scenario.wheel_loop
        assert isinstance(parameters, WheelLoopParameters)
        self.loop = digital_wheel_loop(parameters, self.period)
        # Torques of the wheels to their accelerations: half the mass and half the inertia on each wheel.
        mass = float(body.m[0, 0]) * self.radius**2 / 4
        turn = float(body.I_rolling[0, 0]) * self.radius**2 / (4 * self.half**2)
        own = float(body.J[0, 0])
        inertia = torch.tensor([[mass + turn + own, mass - turn], [mass - turn, mass + turn + own]])
        self.mobility = torch.linalg.inv(inertia)
        self.inertia = float(inertia[0, 0])
        entries = tracking_entries(scenario.preview_s)
        later = list(entries)[len(Tracking._fields) :]
        self.known = [
            *("e_1", "e_2", "sin_e_3", "cos_e_3", "reference_u_1", "reference_u_2", *later),
            *("odometry_u_1", "odometry_u_2", "last_action_0", "last_action_1"),
            *("command_u_1", "command_u_2", "slip_1", "slip_2", "is_leader", "is_last"),
        ]
        same = {f"{name}_fine": name for name in ("e_1", "e_2", "sin_e_3")}
        names = [same.get(name, name) for name in entries]
        zero = len(self.known)  # the column of the entries that the model lacks
        self.places = torch.tensor(
            [self.known.index(one) if one in self.known else zero for one in names]
        )
        self.scales = torch.tensor([entry.scale for entry in entries.values()])

    def relative(self, pose: Tensor, targets: Tensor) -> Tensor:
        """References ``(..., target, 5)`` as a robot sees them, ``(..., target, 6)``: as ``Preview``."""
        d, turn = targets[..., :2] - pose[..., None, :2], targets[..., 2] - pose[..., None, 2]
        sin, cos = torch.sin(pose[..., 2:]), torch.cos(pose[..., 2:])
        forward, right = cos * d[..., 1] - sin * d[..., 0], cos * d[..., 0] + sin * d[..., 1]
        seen = torch.stack([forward, right, torch.sin(turn), torch.cos(turn)], dim=-1)
        return torch.cat([seen, targets[..., 3:]], dim=-1)

    def observation(self, state: State, seen: Tensor, slip: Tensor, roles: Tensor) -> Tensor:
        """The ``tracking`` observation; 0 for what the model lacks."""
        rest = (
            state.odometry,
            state.action,
            state.command,
            slip,
            roles,
            torch.zeros_like(roles[..., :1]),
        )
        row = torch.cat([seen.flatten(-2), *rest], dim=-1)[..., self.places]
        return (row / self.scales).clamp(-OBSERVATION_LIMIT, OBSERVATION_LIMIT)

    def limited(self, seen: Tensor, last: Tensor, slip: Tensor, action: Tensor) -> Tensor:
        """The twist that an action commands, as ``tlf_env.task.actions`` does, but for the spacing."""
        row = self.limits
        now, later = seen[..., 0, 4:], seen[..., 1, 4:]
        e_1, cruise = seen[..., 0, 0], seen[..., 0, 4]
        error = hypot(e_1, seen[..., 0, 1])
        share = (error / (error + self.fade))[..., None]
        u_1, u_2 = (now + self.lead * (later - now) + share * action * self.full).unbind(-1)
        closing = torch.sqrt(row.closing_speed**2 + 2 * row.closing * e_1.clamp(min=0.0))
        u_1 = bounded(u_1, torch.full_like(u_1, -row.reverse), cruise + closing)
        cancelled = row.slip * slip
        last_1, last_2 = (last + cancelled).unbind(-1)
        b_2 = bounded(
            u_2.clamp(-row.yaw_rate, row.yaw_rate), last_2 - row.step_2, last_2 + row.step_2
        )
        used = ((last_1 * last_2).abs() / row.lateral).clamp(max=1.0)
        step = row.step_1 - row.turning_loss * used * used
        free = row.free / (1.0 + (error / row.free_reach) ** 4)
        near = (last_1 - cruise).abs() <= free
        low = torch.where(near, torch.minimum(last_1 - step, cruise - free), last_1 - step)
        high = torch.where(near, torch.maximum(last_1 + step, cruise + free), last_1 + step)
        b_1 = bounded(u_1, low, high)
        enough = torch.maximum(row.lateral / b_2.abs().clamp(min=1e-3), cruise.abs())
        slower = torch.minimum(torch.maximum(torch.copysign(enough, b_1), low), high)
        fast = ((b_1 * b_2).abs() > row.lateral) & (b_1.abs() > enough)
        b_1 = torch.where(fast, slower, b_1)
        most = row.lateral / b_1.abs().clamp(min=1e-3)
        return torch.stack([b_1, bounded(b_2, -most, most)], dim=-1) - cancelled

    def twist(self, wheels: Tensor) -> Tensor:
        """Forward speed and yaw rate by wheel speeds."""
        left, right = wheels.unbind(-1)
        both = [(left + right) / 2, (right - left) / (2 * self.half)]
        return self.radius * torch.stack(both, dim=-1)

    def moved(self, state: State, nature: Nature, action: Tensor, command: Tensor) -> State:
        """One control step."""
        v, w = command.unbind(-1)
        wanted = torch.stack([v - self.half * w, v + self.half * w], dim=-1) / self.radius
        dt, limit = self.period / SUBSTEPS, self.limit * nature.torque
        # With this gain a substep decays the error exactly as the continuous loop does.
        stiff = (
            self.inertia
            / dt
            * (1 - torch.exp(-self.loop.gain * nature.stiffness * dt / self.inertia))
        )
        wheels, held, total = state.wheels, state.held.sum(-1), 0.0
        resistance, castor = self.friction(state, nature, command)
        for _ in range(SUBSTEPS):
            torque = stiff * (wanted - wheels) + held
            torque = torch.minimum(torch.maximum(torque, -limit), limit) - resistance
            before, wheels = wheels, wheels + dt * torque @ self.mobility
            total = total + (before + wheels) / 2
        mean = total / SUBSTEPS
        error = wanted - mean
        held = torch.stack(
            [
                state.held[..., 0] + self.loop.integral_step * error,
                state.held[..., 1] * self.loop.lag_decay + self.loop.lag_step * error,
            ],
            dim=-1,
        ).clamp(-self.limit, self.limit)
        odometry = self.twist(mean)
        pose = driven(state.pose, odometry + nature.slip, self.period)
        return State(pose, wheels, held, command, action, odometry, castor)

    @torch.no_grad()  # it changes by steps
    def friction(self, state: State, nature: Nature, command: Tensor) -> tuple[Tensor, Tensor]:
        """Torques of the joints' friction on the wheels, and the castor's next angle."""
        v, w = command.unbind(-1)
        wanted = torch.atan2(self.pivot * w, v.clamp(min=1.0))
        turned = (wanted - state.castor) * (1 - torch.exp(-v.abs() * self.period / self.trail))
        swivel = CASTOR_mNmm * torch.tanh(turned / STILL_RAD)
        axles = AXLES_mNmm * torch.tanh(state.wheels / STILL_RAD_S)
        return nature.friction * (
            axles + torch.stack([-swivel, swivel], dim=-1)
        ), state.castor + turned


def driven(pose: Tensor, twist: Tensor, duration: float) -> Tensor:
    """Poses after a short arc."""
    way, turn = (twist * duration).unbind(-1)
    middle = pose[..., 2] + turn / 2
    steps = [-way * torch.sin(middle), way * torch.cos(middle), turn]
    return pose + torch.stack(steps, dim=-1)


def usual(shape: Sequence[int]) -> Nature:
    """Robots that are as the model has them, without slip."""
    return Nature(*(torch.ones(*shape, 1) for _ in range(3)), *torch.zeros(2, *shape, 2))
