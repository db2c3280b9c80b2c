"""TorchRL's environment on the batch plant: formations side by side, robots as one group of agents.

>>> from baselines.torchrl import FormationBatchEnv
>>> env = FormationBatchEnv("infinity", formations=64)
>>> env.rollout(10).shape
torch.Size([64, 10])
"""

from __future__ import annotations

import secrets
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from torchrl.data import Binary, Bounded, Composite, Unbounded
from torchrl.envs import EnvBase

from tlf_env.common.trust import Trust
from tlf_env.engine import judging, readout
from tlf_env.engine.batch import DOUBLE, BatchPlant, Source, checked_count
from tlf_env.engine.formation import STATE_SCALES
from tlf_env.numerics.philox import MAX_SEED
from tlf_env.task.actions import ACTION_SIZE
from tlf_env.task.info import TIME_GAP_KEY, EndReason, InfoChoice, chosen_keys
from tlf_env.task.observation import OBSERVATION_LIMIT
from tlf_env.task.scenario import learners_action

GROUP = "robot"
ENDS = ("done", "terminated", "truncated")


class FormationBatchEnv(EnvBase):
    """Formations on the batch plant as one environment with ``batch_size`` (formations,).

    Entries, each with the formations first: ``("robot", "observation")`` (robots, entries),
    ``("robot", "action")`` (robots, 2), ``("robot", "reward")`` (robots, 1), ``("robot", "info")`` with the
    chosen keys (robots,), and ``"state"``: the true state of the formation for critics, (robots · 16,),
    scaled as :meth:`tlf_env.envs.parallel.FormationParallelEnv.state`. Robots of a formation end together:
    the one that ended the episode is terminated, the others are truncated, so that their values are
    bootstrapped. The formation's own ``"terminated"`` is that of any robot.

    Parameters
    ----------
    scenario
        What :class:`~tlf_env.engine.batch.BatchPlant` takes.
    formations
        How many.
    staggered
        Whether the first episodes end at different times; later ones follow from them.
    threads
        How many work on a step; None: one for each core.
    seed
        Formation k begins with ``seed`` + k; random if None.
    infos
        The keys of the infos, True for all, False for none.
    device
        Of the tensors; the simulation runs on the CPU.
    trust
        As in :class:`~tlf_env.engine.batch.BatchPlant`.
    **overrides
        Fields of the scenario. ``action`` is by default that of the other learners' environments.

    Raises
    ------
    TypeError
        in one line, for an unknown keyword.
    ValueError
        for a scenario that cannot run in a batch, or a number out of range; naming the field.
    """

    def __init__(
        self,
        scenario: Source | Sequence[Source] = "infinity",
        formations: int = 64,
        *,
        staggered: bool = True,
        precision: str = DOUBLE,
        threads: int | None = 1,
        seed: int | None = None,
        infos: InfoChoice = False,
        device: Any = "cpu",
        trust: Trust = False,
        **overrides: Any,
    ) -> None:
        self._info_keys = chosen_keys(infos)
        super().__init__(device=device, batch_size=(checked_count("formations", formations),))
        overrides = learners_action(scenario, overrides)
        self.plant = BatchPlant(
            scenario,
            formations,
            threads=threads,
            staggered=staggered,
            precision=precision,
            trust=trust,
            **overrides,
        )
        if TIME_GAP_KEY not in self._info_keys:
            self.plant.compute_time_gap_of([])
        self._first_seed = seed
        self._make_specs()

    @property
    def group_map(self) -> dict[str, list[str]]:
        """All robots in one group."""
        return {GROUP: [f"robot_{i}" for i in range(self.plant.scenario.robot_count)]}

    def _make_specs(self) -> None:
        lanes, (_, robots, entries) = self.batch_size, self.plant.observations.shape
        each, device = (*lanes, robots), self.device
        dtype = torch.float64 if self.plant.scenario.dtype == "float64" else torch.float32

        def flags(shape: tuple[int, ...]) -> Composite:
            return Composite({name: _flag(shape, device) for name in ENDS}, shape=shape[:-1])

        seen = Bounded(
            -OBSERVATION_LIMIT, OBSERVATION_LIMIT, (*each, entries), device=device, dtype=dtype
        )
        group = {"observation": seen}
        if self._info_keys:
            number = Unbounded(each, device=device, dtype=torch.float32)
            group["info"] = Composite(
                {key: number.clone() for key in self._info_keys}, shape=each, device=device
            )
        width = robots * len(STATE_SCALES)
        self.observation_spec = Composite(
            {
                GROUP: Composite(group, shape=each, device=device),
                "state": Unbounded((*lanes, width), device=device, dtype=torch.float32),
            },
            shape=lanes,
            device=device,
        )
        action = Bounded(-1.0, 1.0, (*each, ACTION_SIZE), device=device, dtype=dtype)
        self.action_spec = Composite(
            {GROUP: Composite({"action": action}, shape=each)}, shape=lanes, device=device
        )
        reward = Unbounded((*each, 1), device=device, dtype=torch.float32)
        self.reward_spec = Composite(
            {GROUP: Composite({"reward": reward}, shape=each)}, shape=lanes, device=device
        )
        self.done_spec = Composite(
            {**dict(flags((*lanes, 1)).items()), GROUP: flags((*each, 1))},
            shape=lanes,
            device=device,
        )

    def _reset(self, tensordict: TensorDictBase | None = None, **_: Any) -> TensorDictBase:
        mask = None if tensordict is None else tensordict.get("_reset", None)
        if mask is None:
            seed = self._first_seed
            if seed is None:
                seed = secrets.randbelow(MAX_SEED - self.plant.formations)
            self.plant.reset(seed)
            self._first_seed = seed + self.plant.formations  # of the next reset of all
        else:
            self.plant.reset(mask=mask.cpu().numpy().reshape(self.plant.formations))
        found = self._seen()
        ends = np.zeros((*self.batch_size, self.plant.scenario.robot_count), dtype=np.int64)
        found.update(self._ended(ends))
        return found

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        self.plant.step(tensordict[GROUP, "action"].detach().cpu().numpy())
        found = self._seen()
        reward = torch.from_numpy(self.plant.rewards.astype(np.float32))
        found[GROUP, "reward"] = reward.unsqueeze(-1).to(self.device)
        found.update(self._ended(self.plant.arrays.ends))
        return found

    def _seen(self) -> TensorDict:
        """Observations, state and infos of all formations."""
        plant = self.plant
        scaled = (plant.state() / STATE_SCALES).astype(np.float32)
        group = {"observation": torch.from_numpy(plant.observations.copy())}
        each = (*self.batch_size, plant.scenario.robot_count)
        if self._info_keys:
            group["info"] = TensorDict(
                {
                    key: torch.from_numpy(readout.info_of(plant.arrays, key).astype(np.float32))
                    for key in self._info_keys
                },
                batch_size=each,
            )
        return TensorDict(
            {
                GROUP: TensorDict(group, batch_size=each),
                "state": torch.from_numpy(scaled.reshape(self.plant.formations, -1)),
            },
            batch_size=self.batch_size,
        ).to(self.device)

    def _ended(self, ends: np.ndarray) -> TensorDict:
        """The three flags of every formation, and of every robot, by its :class:`~tlf_env.EndReason`."""
        done = torch.from_numpy(ends != EndReason.RUNNING).unsqueeze(-1)
        terminated = torch.from_numpy(judging.terminated(ends)).unsqueeze(-1)
        robots = {"done": done, "terminated": terminated, "truncated": done & ~terminated}
        over, fell = done.any(dim=1), terminated.any(dim=1)
        whole = {"done": over, "terminated": fell, "truncated": over & ~fell}
        return TensorDict(
            {**whole, GROUP: TensorDict(robots, batch_size=ends.shape)}, batch_size=self.batch_size
        ).to(self.device)

    def _set_seed(self, seed: int | None) -> None:
        self._first_seed = seed


def _flag(shape: tuple[int, ...], device: Any) -> Binary:
    return Binary(n=shape[-1], shape=shape, device=device, dtype=torch.bool)
