"""Wrappers of Gymnasium and SuperSuit that fit the environment: each runs past two ends, or says why not."""

from __future__ import annotations

import importlib
import re
import tempfile
from collections.abc import Callable, Iterator
from importlib.metadata import version
from typing import Any, NamedTuple

import gymnasium
import numpy as np
from gymnasium.spaces import Box

import tlf_env

BRIEF: dict[str, Any] = {
    "disturbance": "none",
    "horizon_s": 0.4,
    "time_gap_s": 0.2,
    "preview_s": (),
}
ID = "tlf_env/Infinity-v0"
STEPS = 60  # three episodes of 20 steps


class Kind(NamedTuple):
    """A wrapper, by its name: how it is put on an environment, which is made with some more arguments."""

    put: Callable[[Any, Any], Any]  # of its module and the environment
    made: dict[str, Any] = {}


def twice(space: Box) -> Box:
    """A space twice as large."""
    return Box(2.0 * space.low, 2.0 * space.high, dtype=space.dtype)


PICTURES = {"render_mode": "rgb_array"}
SINGLE = {
    "AddRenderObservation": Kind(lambda m, e: m.AddRenderObservation(e), PICTURES),
    "AddWhiteNoise": Kind(lambda m, e: m.AddWhiteNoise(e, 0.2), PICTURES),
    "ArrayConversion": Kind(lambda m, e: m.ArrayConversion(e, np, np)),
    "Autoreset": Kind(lambda m, e: m.Autoreset(e)),
    "ClipAction": Kind(lambda m, e: m.ClipAction(e)),
    "ClipReward": Kind(lambda m, e: m.ClipReward(e, -1.0, 1.0)),
    "DelayObservation": Kind(lambda m, e: m.DelayObservation(e, 3)),
    "DiscretizeAction": Kind(lambda m, e: m.DiscretizeAction(e, 5)),
    "DiscretizeObservation": Kind(
        lambda m, e: m.DiscretizeObservation(e, 4, multidiscrete=True),
    ),
    "DtypeObservation": Kind(lambda m, e: m.DtypeObservation(e, np.float64)),
    "FlattenObservation": Kind(lambda m, e: m.FlattenObservation(e)),
    "FrameStackObservation": Kind(lambda m, e: m.FrameStackObservation(e, 4)),
    "HumanRendering": Kind(lambda m, e: m.HumanRendering(e), PICTURES),
    "MaxAndSkipObservation": Kind(lambda m, e: m.MaxAndSkipObservation(e, 2)),
    "NormalizeObservation": Kind(lambda m, e: m.NormalizeObservation(e)),
    "NormalizeReward": Kind(lambda m, e: m.NormalizeReward(e)),
    "NumpyToTorch": Kind(lambda m, e: m.NumpyToTorch(e)),
    "ObstructView": Kind(lambda m, e: m.ObstructView(e, 0.2, 10), PICTURES),
    "OrderEnforcing": Kind(lambda m, e: m.OrderEnforcing(e)),
    "PassiveEnvChecker": Kind(lambda m, e: m.PassiveEnvChecker(e)),
    "RecordEpisodeStatistics": Kind(lambda m, e: m.RecordEpisodeStatistics(e)),
    "RecordVideo": Kind(lambda m, e: m.RecordVideo(e, tempfile.mkdtemp()), PICTURES),
    "RenderCollection": Kind(lambda m, e: m.RenderCollection(e), PICTURES),
    "RepeatAction": Kind(lambda m, e: m.RepeatAction(e, 2)),
    "RescaleAction": Kind(lambda m, e: m.RescaleAction(e, -2.0, 2.0)),
    "RescaleObservation": Kind(lambda m, e: m.RescaleObservation(e, -1.0, 1.0)),
    "ReshapeObservation": Kind(
        lambda m, e: m.ReshapeObservation(e, (e.observation_space.shape[0], 1))
    ),
    "StickyAction": Kind(lambda m, e: m.StickyAction(e, 0.3)),
    "TimeAwareObservation": Kind(lambda m, e: m.TimeAwareObservation(e)),
    "TimeLimit": Kind(lambda m, e: m.TimeLimit(e, 15)),
    "TransformAction": Kind(
        lambda m, e: m.TransformAction(e, lambda a: 0.5 * a, twice(e.action_space))
    ),
    "TransformObservation": Kind(
        lambda m, e: m.TransformObservation(e, lambda o: 2.0 * o, twice(e.observation_space))
    ),
    "TransformReward": Kind(lambda m, e: m.TransformReward(e, lambda r: 0.1 * r)),
}
VECTOR = {
    "ArrayConversion": Kind(lambda m, e: m.ArrayConversion(e, np, np)),
    "ClipAction": Kind(lambda m, e: m.ClipAction(e)),
    "ClipReward": Kind(lambda m, e: m.ClipReward(e, -1.0, 1.0)),
    "DictInfoToList": Kind(lambda m, e: m.DictInfoToList(e)),
    "DtypeObservation": Kind(lambda m, e: m.DtypeObservation(e, np.float64)),
    "FlattenObservation": Kind(lambda m, e: m.FlattenObservation(e)),
    "NormalizeObservation": Kind(lambda m, e: m.NormalizeObservation(e)),
    "NormalizeReward": Kind(lambda m, e: m.NormalizeReward(e)),
    "NumpyToTorch": Kind(lambda m, e: m.NumpyToTorch(e)),
    "RecordEpisodeStatistics": Kind(lambda m, e: m.RecordEpisodeStatistics(e)),
    "RescaleAction": Kind(lambda m, e: m.RescaleAction(e, -2.0, 2.0)),
    "RescaleObservation": Kind(lambda m, e: m.RescaleObservation(e, -1.0, 1.0)),
    "ReshapeObservation": Kind(
        lambda m, e: m.ReshapeObservation(e, (e.single_observation_space.shape[0], 1))
    ),
    "TransformAction": Kind(lambda m, e: m.TransformAction(e, lambda a: 0.5 * a)),
    "TransformObservation": Kind(lambda m, e: m.TransformObservation(e, lambda o: 2.0 * o)),
    "TransformReward": Kind(lambda m, e: m.TransformReward(e, lambda r: 0.1 * r)),
    "VectorizeTransformAction": Kind(
        lambda m, e: m.VectorizeTransformAction(e, gymnasium.wrappers.ClipAction)
    ),
    "VectorizeTransformObservation": Kind(
        lambda m, e: m.VectorizeTransformObservation(e, gymnasium.wrappers.FlattenObservation)
    ),
    "VectorizeTransformReward": Kind(
        lambda m, e: m.VectorizeTransformReward(
            e, gymnasium.wrappers.ClipReward, min_reward=-1.0, max_reward=1.0
        )
    ),
}
SUPERSUIT = {
    "action_lambda_v1": Kind(
        lambda m, e: m.action_lambda_v1(e, lambda a, _: 0.5 * a, lambda space: twice(space))
    ),
    "agent_indicator_v0": Kind(lambda m, e: m.agent_indicator_v0(e, type_only=False)),
    "black_death_v3": Kind(lambda m, e: m.black_death_v3(e)),
    "clip_actions_v0": Kind(lambda m, e: m.clip_actions_v0(e)),
    "clip_reward_v0": Kind(lambda m, e: m.clip_reward_v0(e)),
    "delay_observations_v0": Kind(lambda m, e: m.delay_observations_v0(e, 3)),
    "dtype_v0": Kind(lambda m, e: m.dtype_v0(e, np.float64)),
    "flatten_v0": Kind(lambda m, e: m.flatten_v0(e)),
    "frame_skip_v0": Kind(lambda m, e: m.frame_skip_v0(e, 3)),
    "frame_stack_v1": Kind(lambda m, e: m.frame_stack_v1(e, 4)),
    "max_observation_v0": Kind(lambda m, e: m.max_observation_v0(e, 2)),
    "normalize_obs_v0": Kind(lambda m, e: m.normalize_obs_v0(e)),
    "observation_lambda_v0": Kind(
        lambda m, e: m.observation_lambda_v0(e, lambda o, _: 2.0 * o, lambda space: twice(space))
    ),
    "pad_action_space_v0": Kind(lambda m, e: m.pad_action_space_v0(e)),
    "pad_observations_v0": Kind(lambda m, e: m.pad_observations_v0(e)),
    "reshape_v0": Kind(lambda m, e: m.reshape_v0(e, (e.observation_space("robot_0").shape[0], 1))),
    "reward_lambda_v0": Kind(lambda m, e: m.reward_lambda_v0(e, lambda r: 0.1 * r)),
    "sticky_actions_v0": Kind(lambda m, e: m.sticky_actions_v0(e, 0.3)),
}
SUPERSUIT_VECTORS = {  # from the parallel environment to one with a vector of robots
    "pettingzoo_env_to_vec_env_v1": lambda m, e: m.pettingzoo_env_to_vec_env_v1(e),
    "concat_vec_envs_v1": lambda m, e: m.concat_vec_envs_v1(
        m.pettingzoo_env_to_vec_env_v1(e), 2, num_cpus=1, base_class="gymnasium"
    ),
}
GROUPS = {
    "Gymnasium": SINGLE,
    "Gymnasium, vector": VECTOR,
    "SuperSuit": SUPERSUIT,
    "SuperSuit, to vectors": SUPERSUIT_VECTORS,
}


def exists(group: str, name: str) -> bool:
    """Whether the installed version has a wrapper: Gymnasium 1.2 does not have all that 1.4 has."""
    modules = {
        "Gymnasium": "gymnasium.wrappers",
        "Gymnasium, vector": "gymnasium.wrappers.vector",
    }
    return hasattr(importlib.import_module(modules.get(group, "supersuit")), name)


def finite(values: Any) -> bool:
    """Whether numbers, which may be tensors, are all finite."""
    return bool(np.isfinite(np.asarray(values, float)).all())


def sampled(env: Any, name: str) -> Callable[[], Any]:
    """Random actions of an environment of Gymnasium, single or vector; tensors if the wrapper wants them."""
    env.action_space.seed(0)
    if name != "NumpyToTorch":
        return env.action_space.sample
    import torch

    return lambda: torch.as_tensor(env.action_space.sample())


def stepped(env: Any, act: Callable[[], Any]) -> Iterator[tuple[Any, np.ndarray]]:
    """What is seen in each step, and whether an episode ends in it: one truth, or one for each of a vector."""
    env.reset(seed=0)
    for _ in range(STEPS):
        seen, reward, terminated, truncated, _ = env.step(act())
        assert finite(seen)
        assert finite(reward)
        yield seen, np.asarray(np.logical_or(terminated, truncated))
    env.close()


def drive_single(name: str) -> None:
    """Put a wrapper on ``gymnasium.make``, and step past two ends."""
    kind = SINGLE[name]
    env = kind.put(gymnasium.wrappers, gymnasium.make(ID, **BRIEF | kind.made))
    ended = 0
    for k, (seen, over) in enumerate(stepped(env, sampled(env, name))):
        if name not in ("NumpyToTorch", "NormalizeObservation"):
            assert env.observation_space.contains(seen), "an observation is not in its space"
        if kind.made and k == 0 and name != "HumanRendering":
            env.render()
        if over:
            ended += 1
            if name != "Autoreset":
                env.reset()
    assert ended >= 2


def drive_vector(name: str) -> None:
    """Put a wrapper on ``gymnasium.make_vec``, and step past two ends of each of three."""
    env = VECTOR[name].put(gymnasium.wrappers.vector, gymnasium.make_vec(ID, num_envs=3, **BRIEF))
    assert sum(over.sum() for _, over in stepped(env, sampled(env, name))) >= 6


def drive_parallel(name: str) -> None:
    """Put a wrapper of SuperSuit on ``parallel_env``, and step past two ends."""
    import supersuit

    env = SUPERSUIT[name].put(supersuit, tlf_env.parallel_env("infinity", **BRIEF))
    env.reset(seed=0)
    ended = 0
    for _ in range(STEPS):
        seen, rewards, *_ = env.step(
            {agent: env.action_space(agent).sample() for agent in env.agents}
        )
        assert all(finite(row) for row in (*seen.values(), *rewards.values()))
        if not env.agents:
            ended += 1
            seen, _ = env.reset(seed=ended)
        assert all(env.observation_space(agent).contains(row) for agent, row in seen.items()), (
            "an observation is not in its space"
        )
    assert ended >= 2


def drive_supersuits_vector(name: str) -> None:
    """Make a vector environment of SuperSuit from ``parallel_env``, and step past two ends."""
    import supersuit

    env = SUPERSUIT_VECTORS[name](supersuit, tlf_env.parallel_env("infinity", **BRIEF))
    still = np.zeros((env.num_envs, 2), np.float32)
    assert sum(over.any() for _, over in stepped(env, lambda: still)) >= 2


DRIVES = dict(
    zip(
        GROUPS,
        (drive_single, drive_vector, drive_parallel, drive_supersuits_vector),
        strict=True,
    )
)


def outcome(group: str, name: str) -> str:
    """Empty if a wrapper runs; otherwise the error, in one line."""
    try:
        DRIVES[group](name)
    except Exception as error:
        text = " ".join(re.sub(r"\x1b\[[0-9;]*m", "", str(error)).split())
        return f"{type(error).__name__}: {text[:160]}"
    return ""


def outcomes() -> Iterator[dict[str, str]]:
    """A row for each wrapper."""
    for group, kinds in GROUPS.items():
        for name in kinds:
            installed = version(group.partition(",")[0].lower())
            error = outcome(group, name)
            yield {"group": group, "wrapper": name, "version": installed, "error": error}


if __name__ == "__main__":
    for row in outcomes():
        print(row, flush=True)
