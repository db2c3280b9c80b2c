"""sbx, stable-baselines3 in JAX, on the first rung."""

from __future__ import annotations

import rung
import sbx
from sb3_models import CROSSQ, OFF_POLICY, ON_POLICY, OfSB3


class OfSBX(OfSB3):
    """A model of sbx."""

    library, package = "sbx", "sbx-rl"


class PPO(OfSBX):
    """PPO on formations side by side."""

    algorithm, kind, steps, settings = "PPO", sbx.PPO, 60_000, ON_POLICY


class SAC(OfSBX):
    """SAC on formations side by side."""

    algorithm, kind, steps, settings = "SAC", sbx.SAC, 10_000, OFF_POLICY


class CrossQ(OfSBX):
    """CrossQ on formations side by side."""

    algorithm, kind, steps, settings = "CrossQ", sbx.CrossQ, 12_000, CROSSQ


class Alone(OfSBX):
    """PPO with the environment of one learner."""

    algorithm, kind, steps, settings = "PPO", sbx.PPO, 20_000, {"learning_rate": 1e-3}
    door = "`gymnasium.make`"

    def environment(self) -> object:
        return rung.single()


CLIENTS = (PPO, Alone, SAC, CrossQ)
