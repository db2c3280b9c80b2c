"""Moments put back: their numbers and their files."""

from __future__ import annotations

import contextlib
import functools
from typing import Any

import numpy as np
from campaign.fuzzing.cases import anything, changed, damaged, number
from campaign.fuzzing.checks import REFUSED, finite, refused, working_folder
from campaign.fuzzing.parts import world_bases
from campaign.fuzzing.registry import target
from campaign.fuzzing.scenarios import SHORT
from hypothesis import strategies as st

import tlf_env
from tlf_env.engine.snapshot import Snapshot
from tlf_env.task.observation import OBSERVATION_LIMIT


@functools.cache
def moment() -> tuple[Any, Snapshot]:
    fields = {**SHORT, "disturbance": "combined-hard", "world": world_bases()[-1], "end_on": []}
    env = tlf_env.parallel_env("infinity", **fields)
    env.reset(seed=1)
    for _ in range(12):
        env.step({agent: [0.8, 0.1] for agent in env.agents})
    return env, env.get_state()


@functools.cache
def batch_moment() -> tuple[Any, Snapshot]:
    plant = tlf_env.BatchPlant("infinity", 2, **SHORT, disturbance="combined-hard")
    plant.reset(seed=1, options={"phase_s": 1.0})
    for _ in range(8):
        plant.step(np.full(plant.arrays.actions.shape, 0.3))
    return plant, plant.get_state()


@target(
    st.tuples(
        st.booleans(),
        st.lists(
            st.tuples(
                st.integers(0, 200), st.integers(0, 5000), st.one_of(number, st.integers(-3, 30))
            ),
            min_size=1,
            max_size=3,
        ),
    ),
    share=1.5,
)
def snapshots(case: Any) -> None:
    """Numbers in a snapshot: refused, or the simulation goes on with finite numbers."""
    of_batch, changes = case
    thing, taken = batch_moment() if of_batch else moment()
    numbers = {name: array.copy() for name, array in taken.numbers.items()}
    names = sorted(numbers)
    for which, place, value in changes:
        array = numbers[names[which % len(names)]].reshape(-1)
        if not array.size:
            continue
        with contextlib.suppress(OverflowError, ValueError, TypeError), np.errstate(all="ignore"):
            array[place % array.size] = value
    changed_ = Snapshot(taken.kind, taken._fits, taken._memory, numbers)
    try:
        went = refused(lambda: thing.set_state(changed_)) is not REFUSED
        for _ in range(2 * went):
            if of_batch:
                if (thing.arrays.clock[:, 1] >= thing.arrays.clock[:, 3]).any():
                    break
                actions = np.full(thing.arrays.actions.shape, 0.1)
                if refused(lambda: thing.step(actions), RuntimeError) is REFUSED:
                    break  # a formation of the snapshot has begun no episode
                finite("observations after a snapshot", thing.observations, OBSERVATION_LIMIT)
                finite("rewards after a snapshot", thing.rewards)
            elif thing.agents:
                seen, rewards, *_ = thing.step({agent: [0.1, 0.0] for agent in thing.agents})
                finite("observations after a snapshot", list(seen.values()), OBSERVATION_LIMIT)
                finite("rewards after a snapshot", list(rewards.values()))
        thing.set_state(taken)
    except BaseException:
        (batch_moment if of_batch else moment).cache_clear()  # it may be left half changed
        raise


@functools.cache
def snapshot_bytes() -> list[bytes]:
    with working_folder() as folder:
        env = tlf_env.parallel_env(
            "infinity", horizon_s=0.2, time_gap_s=0.1, preview_s=(), robots=1
        )
        env.reset(seed=0)
        env.get_state().save(folder / "moment")
        data = (folder / "moment").read_bytes()
    return [data[:20_000]] if len(data) > 20_000 else [data]


@target(
    st.one_of(damaged(snapshot_bytes), changed(lambda: [moment()[1]._memory], values=anything)),
    share=1.0,
)
def snapshot_files(case: Any) -> None:
    """Bytes of files of snapshots, and what a snapshot remembers."""
    if isinstance(case, dict):
        env, taken = moment()
        try:
            refused(lambda: env.set_state(Snapshot(taken.kind, taken._fits, case, taken.numbers)))
        finally:
            env.set_state(taken)
        return
    with working_folder() as folder:
        (folder / "moment").write_bytes(case)
        refused(lambda: Snapshot.load(folder / "moment"))
