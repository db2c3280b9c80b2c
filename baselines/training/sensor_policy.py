"""PPO's policy on raw sensors: an actor that sees readings, and a critic that sees what is true."""

from __future__ import annotations

from typing import Any, NamedTuple

import gymnasium
import numpy as np
import torch
from stable_baselines3.common.policies import ActorCriticPolicy
from torch import nn

from baselines.training.history import HistoryVecEnv
from baselines.training.sensor_layer import FEATURE_LIMIT, SensorLayer, sensor_layer
from tlf_env.engine import readout
from tlf_env.engine.arrays import Arrays
from tlf_env.task.observation import OBSERVATION_LIMIT

CRITIC_HIDDEN = 64
# What the head's weights are multiplied with, so that those for small corrections are about 1, as an optimiser
# expects them.
ACTION_SCALE = 0.01
# What of the truth the critic sees, and what is scaled to 1; errors in three scales, as in the sensor layer.
TRUTH_SCALES = {
    "e_1": (500.0, 100.0, 10.0),
    "e_2": (500.0, 100.0, 10.0),
    "sin_e_3": (1.0, 0.1),
    "cos_e_3": (1.0,),
    "reference_u_1": (500.0,),
    "reference_u_2": (2.0,),
    "speed_error": (500.0, 50.0),
    "right": (50.0,),
    "turn_error": (2.0, 0.5),
    "castor": (1.0,),
    "omega_l": (10.0,),
    "omega_r": (10.0,),
    "is_leader": (1.0,),
    "sin_theta": (1.0,),
    "cos_theta": (1.0,),
}
TRUTHS = sum(map(len, TRUTH_SCALES.values()))


def truth(arrays: Arrays) -> np.ndarray:
    """The true state of every robot about its reference, scaled and clipped at ±10, (row, entry)."""
    state, reference = readout.state(arrays), readout.reference(arrays)
    theta = np.arctan2(state.sin_theta, state.cos_theta)
    d_x, d_y = reference.x - state.x_mm, reference.y - state.y_mm
    leader = np.zeros(theta.shape)
    leader[:, 0] = 1.0
    values = {
        "e_1": d_y * state.cos_theta - d_x * state.sin_theta,
        "e_2": d_x * state.cos_theta + d_y * state.sin_theta,
        "sin_e_3": np.sin(reference.theta - theta),
        "cos_e_3": np.cos(reference.theta - theta),
        "reference_u_1": reference.u_1,
        "reference_u_2": reference.u_2,
        "speed_error": state.forward_mm_s - reference.u_1,
        "right": state.right_mm_s,
        "turn_error": state.yaw_rad_s - reference.u_2,
        "castor": state.castor_rad,
        "omega_l": state.omega_l_rad_s,
        "omega_r": state.omega_r_rad_s,
        "is_leader": leader,
        "sin_theta": state.sin_theta,
        "cos_theta": state.cos_theta,
    }
    columns = [
        values[name].ravel() / scale for name, scales in TRUTH_SCALES.items() for scale in scales
    ]
    return np.clip(np.stack(columns, axis=1), -OBSERVATION_LIMIT, OBSERVATION_LIMIT)


class SensorVecEnv(HistoryVecEnv):
    """Formations whose observations end with :func:`truth`, for the critic; the actor does not see it."""

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self.layer = sensor_layer(self.plants[0].scenario, self.history)
        box = self.observation_space
        self.observation_space = gymnasium.spaces.Box(
            -OBSERVATION_LIMIT, OBSERVATION_LIMIT, (box.shape[0] + TRUTHS,), box.dtype
        )

    def observations(self) -> np.ndarray:
        """As its base, and what is true."""
        known = np.concatenate([truth(plant.arrays) for plant in self.plants])
        seen = super().observations()
        return np.concatenate([seen, known.astype(seen.dtype)], axis=1)


class Dense(NamedTuple):
    """A layer, out by in."""

    weight: np.ndarray
    bias: np.ndarray


class SensorExtractor(nn.Module):
    """The actor's layers after the sensor layer, beside them the reference's twist, and the critic's layers."""

    def __init__(self, layer: SensorLayer, hidden: tuple[int, ...], truths: int) -> None:
        super().__init__()
        self.register_buffer("first", torch.from_numpy(layer.weight))
        self.twist = list(layer.twist)
        self.policy_net = _layers(len(layer.weight), hidden)
        self.value_net = _layers(truths, (CRITIC_HIDDEN, CRITIC_HIDDEN))
        self.latent_dim_pi = hidden[-1] + len(self.twist)
        self.latent_dim_vf = CRITIC_HIDDEN

    def forward(self, seen: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """What the heads of actor and critic see."""
        return self.forward_actor(seen), self.forward_critic(seen)

    def features(self, seen: torch.Tensor) -> torch.Tensor:
        """The sensor layer's features, and the entries of the reference's twist."""
        found = (seen[:, : self.first.shape[1]] @ self.first.T).clamp(-FEATURE_LIMIT, FEATURE_LIMIT)
        return torch.cat([found, seen[:, self.twist]], dim=1)

    def of_features(self, features: torch.Tensor) -> torch.Tensor:
        """What the actor's head sees, from :meth:`features`."""
        split = len(self.first)
        inner = ACTION_SCALE * self.policy_net(features[:, :split])
        return torch.cat([inner, features[:, split:]], dim=1)

    def forward_actor(self, seen: torch.Tensor) -> torch.Tensor:
        """What the actor's head sees."""
        return self.of_features(self.features(seen))

    def forward_critic(self, seen: torch.Tensor) -> torch.Tensor:
        """What the critic's head sees."""
        found: torch.Tensor = self.value_net(seen[:, self.first.shape[1] :])
        return found


class SensorPolicy(ActorCriticPolicy):
    """An actor whose first layer is fixed, and whose head also sees the twist of the reference.

    Parameters
    ----------
    *args, **kwargs
        As for SB3's policy.
    layer
        The first layer.
    """

    def __init__(self, *args: Any, layer: SensorLayer, **kwargs: Any) -> None:
        self.layer = layer
        super().__init__(*args, **kwargs)
        # The wheel speeds of the reference's twist are known, and not trained.
        trained = torch.ones_like(self.action_net.weight)
        trained[:, -len(layer.twist) :] = 0.0
        self.action_net.weight.register_hook(lambda gradient: gradient * trained)

    def begin_at_reference(self) -> None:
        """Let the wheels do what the reference's twist needs, besides what the other layers say."""
        with torch.no_grad():
            carried = self.action_net.weight[:, -len(self.layer.twist) :]
            carried.copy_(torch.from_numpy(self.layer.wheels))

    def _build_mlp_extractor(self) -> None:
        truths = self.features_dim - self.layer.weight.shape[1]
        hidden = tuple(self.net_arch)
        self.mlp_extractor = SensorExtractor(self.layer, hidden, truths).to(self.device)

    def _get_constructor_parameters(self) -> dict[str, Any]:
        return super()._get_constructor_parameters() | {"layer": self.layer}

    def plain_layers(self) -> list[Dense]:
        """The actor as plain layers, all but the last with ReLU, from readings to actions.

        Clipping a feature at ±L is relu(z + L) − relu(z − L) − L, and a reading within ±L passes a ReLU as
        relu(r + L) − L.
        """
        extractor, limit = self.mlp_extractor, FEATURE_LIMIT
        first = extractor.first.numpy().astype(np.float64)
        count, carried = len(first), len(extractor.twist)
        carry = np.zeros((carried, first.shape[1]))
        carry[range(carried), extractor.twist] = 1.0
        above = np.full(count, limit)
        layers = [
            Dense(
                np.concatenate([first, first, carry]),
                np.concatenate([above, -above, np.full(carried, limit)]),
            )
        ]
        dense = [_dense(one) for one in list(extractor.policy_net)[::2]]
        weight, bias = dense[0]
        dense[0] = Dense(
            np.concatenate([weight, -weight], axis=1), bias - limit * weight.sum(axis=1)
        )
        for weight, bias in dense:
            layers.append(
                Dense(_beside(weight, np.eye(carried)), np.concatenate([bias, np.zeros(carried)]))
            )
        weight, bias = _dense(self.action_net)
        weight[:, :-carried] *= ACTION_SCALE
        layers.append(Dense(weight, bias - limit * weight[:, -carried:].sum(axis=1)))
        return [Dense(*(part.astype(np.float32) for part in layer)) for layer in layers]


def _layers(size: int, hidden: tuple[int, ...]) -> nn.Sequential:
    parts: list[nn.Module] = []
    for units in hidden:
        parts += [nn.Linear(size, units), nn.ReLU()]
        size = units
    return nn.Sequential(*parts)


def _dense(layer: Any) -> Dense:
    weight, bias = (part.detach().numpy().astype(np.float64) for part in (layer.weight, layer.bias))
    return Dense(weight, bias)


def _beside(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Both matrices as the blocks of a diagonal."""
    out = np.zeros((one.shape[0] + other.shape[0], one.shape[1] + other.shape[1]))
    out[: one.shape[0], : one.shape[1]] = one
    out[one.shape[0] :, one.shape[1] :] = other
    return out
