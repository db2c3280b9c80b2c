"""BenchMARL on the first rung."""

from __future__ import annotations

import tempfile
from pathlib import Path

import numpy as np
import rung
import torch
from benchmarl.algorithms import IppoConfig
from benchmarl.experiment import Callback, Experiment, ExperimentConfig
from benchmarl.models import MlpConfig
from tensordict import TensorDict
from torchrl.envs.utils import ExplorationType, set_exploration_type

from baselines.benchmarl import FormationTask

FRAMES = 2048


class Losses(Callback):
    """The losses of each update."""

    def __init__(self) -> None:
        super().__init__()
        self.found: list[float] = []

    def on_train_end(self, training_td: TensorDict, group: str) -> None:
        self.found += [
            float(value.mean()) for name, value in training_td.items() if "loss" in str(name)
        ]


class WithBenchMARL(rung.Client):
    """IPPO on formations side by side."""

    library, package, algorithm, steps = "BenchMARL", "benchmarl", "IPPO", 10 * FRAMES
    door = "`baselines.benchmarl`"

    def __init__(self) -> None:
        torch.set_num_threads(1)
        self.kept = tempfile.TemporaryDirectory()
        self.folder = self.kept.name
        self.losses = Losses()
        self.experiment = self._experiment()

    def _experiment(self, restored: str | None = None) -> Experiment:
        task = FormationTask.INFINITY.get_from_yaml()
        task.config.update(rung.RUNG)
        config = ExperimentConfig.get_from_yaml()
        config.save_folder, config.loggers, config.render = self.folder, ["csv"], False
        config.evaluation, config.checkpoint_at_end = False, True
        config.max_n_iters, config.max_n_frames = None, self.steps
        config.on_policy_collected_frames_per_batch = FRAMES
        config.on_policy_n_envs_per_worker = 32
        config.on_policy_minibatch_size, config.on_policy_n_minibatch_iters = 256, 6
        config.lr, config.restore_file = 1e-3, restored
        return Experiment(
            task=task,
            algorithm_config=IppoConfig.get_from_yaml(),
            model_config=MlpConfig.get_from_yaml(),
            critic_model_config=MlpConfig.get_from_yaml(),
            seed=rung.SEED,
            config=config,
            callbacks=[self.losses],
        )

    @staticmethod
    def _acting(experiment: Experiment) -> rung.Act:
        def act(observation: np.ndarray, first: bool) -> np.ndarray:
            seen = {("robot", "observation"): torch.as_tensor(observation)[None, None]}
            given = TensorDict(seen, batch_size=[1])
            with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
                return experiment.policy(given)["robot", "action"].flatten().numpy()

        return act

    def act(self, observation: np.ndarray, first: bool) -> np.ndarray:
        return self._acting(self.experiment)(observation, first)

    def learn(self) -> list[float]:
        self.experiment.run()
        return self.losses.found

    def loaded(self, folder: Path) -> rung.Act:
        newest = max(
            Path(self.folder).rglob("checkpoint_*.pt"), key=lambda path: path.stat().st_mtime
        )
        return self._acting(self._experiment(str(newest)))


CLIENTS = (WithBenchMARL,)
