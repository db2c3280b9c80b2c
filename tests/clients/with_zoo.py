"""The zoo of stable-baselines3 on the first rung: its ``train.py``, with a file of hyperparameters."""

from __future__ import annotations

import re
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import rung
from sb3_models import OfSB3
from stable_baselines3 import PPO

HYPERPARAMETERS = Path(__file__).parent / "zoo.yaml"
ID = "tlf_env/Infinity-v0"


class ByZoo(OfSB3):
    """PPO, trained by ``python -m rl_zoo3.train``."""

    library, package, algorithm, kind = "rl-baselines3-zoo", "rl_zoo3", "PPO", PPO
    door, steps = "`gymnasium.make`, by `--gym-packages tlf_env`", 20_000
    remark = "the numbers are a file, `tests/clients/zoo.yaml`"

    def __init__(self) -> None:
        super().__init__()
        self.kept = tempfile.TemporaryDirectory()
        self.logs = Path(self.kept.name)

    def environment(self) -> Any:
        return rung.single()

    def learn(self) -> list[float]:
        arguments = [f"{name}:{value!r}" for name, value in {**rung.RUNG, "infos": False}.items()]
        words = ["--algo", "ppo", "--env", ID, "--gym-packages", "tlf_env"]
        words += ["--conf-file", str(HYPERPARAMETERS), "--log-folder", str(self.logs)]
        words += ["--seed", str(rung.SEED), "--device", "cpu", "--num-threads", "1"]
        words += ["--n-timesteps", str(self.steps), "--eval-freq", "-1", "--log-interval", "1"]
        done = subprocess.run(
            [sys.executable, "-m", "rl_zoo3.train", *words, "--env-kwargs", *arguments],
            capture_output=True,
            text=True,
            check=False,
        )
        if done.returncode:
            raise RuntimeError(done.stderr[-2000:])
        (self.file,) = self.logs.glob("ppo/*/tlf_env-Infinity-v0.zip")
        self.model = PPO.load(self.file, device="cpu")
        return [float(value) for value in re.findall(r"loss +\| (\S+)", done.stdout)]

    def loaded(self, folder: Path) -> rung.Act:
        return self._acting(PPO.load(self.file, device="cpu"))


CLIENTS = (ByZoo,)
