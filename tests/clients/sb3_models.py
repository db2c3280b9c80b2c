"""Models with the interface of stable-baselines3 on the first rung."""

from __future__ import annotations

from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import rung
import torch
from stable_baselines3.common.callbacks import BaseCallback

from baselines.sb3 import FormationVecEnv

ON_POLICY = {"n_steps": 128, "batch_size": 512, "learning_rate": 1e-3}
OFF_POLICY = {
    "learning_starts": 1000,
    "batch_size": 128,
    "gradient_steps": 4,  # of a step of all formations
    "learning_rate": 1e-3,
    "gamma": 0.95,
}
# The coefficient of the entropy begins at 1 by default, the size of a reward; an update takes a thousandth off.
SMALL_ENTROPY = {**OFF_POLICY, "ent_coef": "auto_0.1"}
# The critics have 1024 neurons in each layer by default, with which an update takes 80 ms on one core.
CROSSQ = {**SMALL_ENTROPY, "policy_kwargs": {"net_arch": {"pi": [256, 256], "qf": [256, 256]}}}
FORMATIONS = 16


def side_by_side(formations: int) -> FormationVecEnv:
    """Formations on the batch plant, whose episodes end at different times."""
    return FormationVecEnv(rung.TASK, formations, staggered=True, infos=False, **rung.RUNG)


class Losses(BaseCallback):
    """The losses that the learner logs, after each rollout."""

    def __init__(self) -> None:
        super().__init__()
        self.found: list[float] = []

    def _on_step(self) -> bool:
        return True

    def _on_rollout_end(self) -> None:
        values = self.logger.name_to_value
        self.found += [float(value) for name, value in values.items() if "loss" in name]


class OfSB3(rung.Client):
    """A model with the interface of stable-baselines3."""

    library, package = "Stable-baselines3", "stable-baselines3"
    door = "`FormationVecEnv`"
    kind: ClassVar[Any]
    policy = "MlpPolicy"
    formations = FORMATIONS
    settings: ClassVar[dict[str, Any]] = {}

    def environment(self) -> Any:
        """What the model is trained on."""
        return side_by_side(self.formations)

    def __init__(self) -> None:
        torch.set_num_threads(1)
        self.model = self.kind(
            self.policy, self.environment(), seed=rung.SEED, device="cpu", **self.settings
        )

    def _acting(self, model: Any) -> rung.Act:
        state = None

        def act(observation: np.ndarray, first: bool) -> np.ndarray:
            nonlocal state
            action, state = model.predict(
                observation[None],
                state=None if first else state,
                episode_start=np.array([first]),
                deterministic=True,
            )
            return action[0]

        return act

    def act(self, observation: np.ndarray, first: bool) -> np.ndarray:
        if first:
            self._act = self._acting(self.model)
        return self._act(observation, first)

    def learn(self) -> list[float]:
        losses = Losses()
        self.model.learn(self.steps, callback=losses)
        return losses.found

    def loaded(self, folder: Path) -> rung.Act:
        self.model.save(folder / "model")
        return self._acting(self.kind.load(folder / "model", device="cpu"))
