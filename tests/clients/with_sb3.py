"""Stable-baselines3 and sb3-contrib on the first rung."""

from __future__ import annotations

from typing import Any, ClassVar

import numpy as np
import rung
from sb3_contrib import TQC, CrossQ, RecurrentPPO
from sb3_models import CROSSQ, OFF_POLICY, ON_POLICY, SMALL_ENTROPY, OfSB3
from stable_baselines3 import PPO, SAC, TD3
from stable_baselines3.common.noise import NormalActionNoise


class PPOSideBySide(OfSB3):
    """PPO on formations side by side."""

    algorithm, kind, steps, settings = "PPO", PPO, 60_000, ON_POLICY


class PPOAlone(OfSB3):
    """PPO with the environment of one learner."""

    algorithm, kind, steps = "PPO", PPO, 20_000
    door = "`gymnasium.make`"
    settings: ClassVar[dict[str, Any]] = {"learning_rate": 1e-3}

    def environment(self) -> Any:
        return rung.single()


class SACSideBySide(OfSB3):
    """SAC on formations side by side."""

    algorithm, kind, steps, settings = "SAC", SAC, 10_000, OFF_POLICY


class TD3SideBySide(OfSB3):
    """TD3 on formations side by side, with noise on its actions, and an update for each step of a formation.

    Its first policies are at the limits of the actions, from where it needs thousands of updates to come back.
    """

    algorithm, kind, steps = "TD3", TD3, 8_000
    settings: ClassVar[dict[str, Any]] = {
        **OFF_POLICY,
        "gradient_steps": -1,
        "action_noise": NormalActionNoise(np.zeros(2), np.full(2, 0.3)),
    }


class OfContrib(OfSB3):
    """A model of sb3-contrib."""

    library, package = "sb3-contrib", "sb3-contrib"


class Recurrent(OfContrib):
    """PPO with a small LSTM and the library's learning rate, a third of that of the others."""

    algorithm, kind, steps = "RecurrentPPO", RecurrentPPO, 20_480
    policy = "MlpLstmPolicy"
    settings: ClassVar[dict[str, Any]] = {
        **ON_POLICY,
        "batch_size": 256,
        "learning_rate": 3e-4,
        "policy_kwargs": {"lstm_hidden_size": 64, "enable_critic_lstm": False},
    }


class TQCSideBySide(OfContrib):
    """TQC on formations side by side."""

    algorithm, kind, steps, settings = "TQC", TQC, 10_000, SMALL_ENTROPY


class CrossQSideBySide(OfContrib):
    """CrossQ on formations side by side."""

    algorithm, kind, steps, settings = "CrossQ", CrossQ, 12_000, CROSSQ


CLIENTS = (
    PPOSideBySide,
    PPOAlone,
    SACSideBySide,
    Recurrent,
    TQCSideBySide,
    CrossQSideBySide,
    TD3SideBySide,
)
