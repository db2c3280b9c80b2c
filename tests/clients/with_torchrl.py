"""TorchRL on the first rung: its PPO loss, on the batch plant."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import rung
import torch
from tensordict import TensorDict
from tensordict.nn import InteractionType, NormalParamExtractor, TensorDictModule
from torch import nn
from torchrl.modules import ProbabilisticActor, TanhNormal, ValueOperator
from torchrl.objectives import ClipPPOLoss, ValueEstimators

from baselines.torchrl import FormationBatchEnv

FORMATIONS, ROLLOUT, EPOCHS, BATCHES = 16, 64, 8, 4
SEEN, ACTED, PAID = ("robot", "observation"), ("robot", "action"), ("robot", "reward")


def network(inputs: int, outputs: int, *last: nn.Module) -> nn.Sequential:
    """Two hidden layers."""
    hidden = [nn.Linear(inputs, 64), nn.Tanh(), nn.Linear(64, 64), nn.Tanh()]
    return nn.Sequential(*hidden, nn.Linear(64, outputs), *last)


class WithTorchRL(rung.Client):
    """PPO on formations side by side."""

    library, package, algorithm, steps = "TorchRL", "torchrl", "PPO", 40_000
    door = "`baselines.torchrl`"

    def __init__(self) -> None:
        torch.set_num_threads(1)
        torch.manual_seed(rung.SEED)
        self.env = FormationBatchEnv(
            rung.TASK, FORMATIONS, seed=rung.SEED, staggered=True, infos=False, **rung.RUNG
        )
        self.actor = self._actor()
        inputs = self.env.observation_spec[SEEN].shape[-1]
        critic = ValueOperator(
            network(inputs, 1), in_keys=[SEEN], out_keys=[("robot", "state_value")]
        )
        self.loss = ClipPPOLoss(self.actor, critic, entropy_coeff=0.0, normalize_advantage=True)
        self.loss.set_keys(
            action=ACTED,
            reward=PAID,
            done=("robot", "done"),
            terminated=("robot", "terminated"),
            value=("robot", "state_value"),
            advantage=("robot", "advantage"),
            value_target=("robot", "value_target"),
            sample_log_prob=("robot", "log_prob"),
        )
        self.loss.make_value_estimator(ValueEstimators.GAE, gamma=0.99, lmbda=0.95)

    def _actor(self) -> ProbabilisticActor:
        inputs = self.env.observation_spec[SEEN].shape[-1]
        outputs = [("robot", "loc"), ("robot", "scale")]
        mean = TensorDictModule(
            network(inputs, 4, NormalParamExtractor()), in_keys=[SEEN], out_keys=outputs
        )
        return ProbabilisticActor(
            mean,
            in_keys=outputs,
            out_keys=[ACTED],
            spec=self.env.action_spec,
            distribution_class=TanhNormal,
            default_interaction_type=InteractionType.RANDOM,
            return_log_prob=True,
            log_prob_key=("robot", "log_prob"),
        )

    @staticmethod
    def _acting(actor: ProbabilisticActor) -> rung.Act:
        def act(observation: np.ndarray, first: bool) -> np.ndarray:
            given = TensorDict({SEEN: torch.as_tensor(observation)[None, None]}, batch_size=[1])
            with torch.no_grad():
                mean = actor[0](given)[("robot", "loc")]
            return torch.tanh(mean).flatten().numpy()

        return act

    def act(self, observation: np.ndarray, first: bool) -> np.ndarray:
        return self._acting(self.actor)(observation, first)

    def learn(self) -> list[float]:
        optimiser = torch.optim.Adam(self.loss.parameters(), 1e-3)
        losses: list[float] = []
        begun = self.env.reset()
        for _ in range(self.steps // (FORMATIONS * ROLLOUT)):
            with torch.no_grad():
                steps = []
                for _ in range(ROLLOUT):
                    step, begun = self.env.step_and_maybe_reset(self.actor(begun))
                    steps.append(step)
                rollout = torch.stack(steps, dim=1)
                self.loss.value_estimator(
                    rollout,
                    params=self.loss.critic_network_params,
                    target_params=self.loss.target_critic_network_params,
                )
            flat = rollout.reshape(-1)
            for _ in range(EPOCHS):
                for rows in torch.randperm(len(flat)).chunk(BATCHES):
                    found = self.loss(flat[rows])
                    total = found["loss_objective"] + found["loss_critic"]
                    optimiser.zero_grad()
                    total.backward()
                    nn.utils.clip_grad_norm_(self.loss.parameters(), 0.5)
                    optimiser.step()
                    losses.append(total.item())
        return losses

    def loaded(self, folder: Path) -> rung.Act:
        torch.save(self.actor.state_dict(), folder / "actor.pt")
        other = self._actor()
        other.load_state_dict(torch.load(folder / "actor.pt", weights_only=True))
        return self._acting(other)


CLIENTS = (WithTorchRL,)
