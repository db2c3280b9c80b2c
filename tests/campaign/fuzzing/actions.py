"""Actions, resets, start poses and adversaries."""

from __future__ import annotations

import functools
from typing import Any

import numpy as np
from campaign.fuzzing.cases import anything, arrays, number, real, scalar, word
from campaign.fuzzing.checks import REFUSED, finite, observed, refused
from campaign.fuzzing.registry import ViolationError, target
from campaign.fuzzing.scenarios import SHORT
from hypothesis import strategies as st

import tlf_env
from tlf_env.disturbances.channels import CHANNELS
from tlf_env.envs.single import FormationEnv
from tlf_env.envs.vector import FormationVectorEnv
from tlf_env.task.observation import OBSERVATION_LIMIT

action = st.one_of(
    st.lists(number, min_size=2, max_size=2),
    st.lists(st.floats(-2, 2), min_size=2, max_size=2),
    arrays,
    anything,
    st.fixed_dictionaries({"!": st.just("tuple"), "value": st.lists(number, max_size=3)}),
    st.fixed_dictionaries({"!": st.just("object")}),
)

moves = st.one_of(
    st.fixed_dictionaries(
        {"do": st.just("step"), "actions": st.lists(action, min_size=2, max_size=2)}
    ),
    st.fixed_dictionaries(
        {"do": st.just("step"), "actions": st.lists(action, min_size=2, max_size=2)}
    ),
    st.fixed_dictionaries(
        {
            "do": st.just("agents"),
            "actions": st.dictionaries(
                word | st.sampled_from(["robot_0", "robot_1"]), action, max_size=3
            ),
        }
    ),
    st.fixed_dictionaries({"do": st.just("raw"), "actions": action}),
    st.fixed_dictionaries(
        {"do": st.just("reset"), "seed": scalar, "options": anything | st.none()}
    ),
    st.fixed_dictionaries(
        {"do": st.just("reset"), "seed": st.integers(0, 9), "options": st.none()}
    ),
    st.fixed_dictionaries({"do": st.just("mutate")}),
    st.fixed_dictionaries({"do": st.just("end")}),
)


@functools.cache
def parallel(kind: int) -> Any:
    fields = [
        {},
        {"action": "torque", "dtype": "float64", "observation": "sensor"},
        {"action": "tracking_twist", "plant": "batch"},
        {"action": "residual", "estimator": "ekf-slip", "disturbance": "combined-hard"},
    ][kind]
    return tlf_env.parallel_env("infinity", **{**SHORT, "horizon_s": 0.4, **fields})


@target(st.tuples(st.integers(0, 3), st.lists(moves, min_size=1, max_size=6)), share=2.0)
def actions(case: Any) -> None:
    """Streams of actions and resets in the parallel environment."""
    kind, stream = case
    env = parallel(kind)
    env.reset(seed=0)
    for move in stream:
        before = env.formation.step_count
        if move["do"] == "reset":
            done = refused(
                lambda: env.reset(seed=real(move["seed"]), options=real(move["options"])), TypeError
            )
            if done is not REFUSED:
                observed("at the start", env, *done)
            elif not env.agents and before == 0:
                raise ViolationError("a refused reset has ended the episode")
            continue
        if move["do"] == "mutate":
            given = {agent: np.zeros(2, np.float32) for agent in env.agents}
            result = env.step(given)
            for one in given.values():
                one[:] = np.nan
            for seen in result[0].values():
                seen[:] = np.nan
            if env.agents:
                result = env.step({agent: np.zeros(2) for agent in env.agents})
                observed("after arrays of the caller were changed", env, result[0], result[4])
            continue
        if move["do"] == "end":
            for _ in range(25):
                if env.agents:
                    env.step({agent: [0.0, 0.0] for agent in env.agents})
            if env.step({}) != ({}, {}, {}, {}, {}):
                raise ViolationError("a step after the end returns something")
            continue
        given = real(move["actions"])
        if move["do"] == "step":
            given = dict(zip(env.possible_agents, given, strict=True))
        done = refused(lambda: env.step(given))
        if done is REFUSED:
            if env.formation.step_count != before:
                raise ViolationError("a refused action has changed the episode")
            continue
        observed("after an action", env, done[0], done[4])
        finite("rewards after an action", list(done[1].values()))


@functools.cache
def batches(kind: int) -> Any:
    fields: dict[str, Any] = [{}, {"action": "tracking_twist"}, {"plant": "kinematic"}][kind]
    return tlf_env.BatchPlant("infinity", 2, **{**SHORT, "horizon_s": 0.4, **fields})


@functools.cache
def vectors(kind: int) -> FormationVectorEnv:
    mode = ["NextStep", "SameStep", "Disabled"][kind]
    return FormationVectorEnv("infinity", 2, autoreset_mode=mode, **{**SHORT, "horizon_s": 0.4})


batch_moves = st.one_of(
    st.fixed_dictionaries({"do": st.just("step"), "actions": action}),
    st.fixed_dictionaries(
        {
            "do": st.just("step"),
            "actions": st.lists(
                st.lists(st.lists(number, min_size=2, max_size=2), min_size=2, max_size=2),
                min_size=2,
                max_size=2,
            ),
        }
    ),
    st.fixed_dictionaries(
        {
            "do": st.just("step"),
            "actions": st.lists(st.lists(number, min_size=2, max_size=2), min_size=2, max_size=2),
        }
    ),
    st.fixed_dictionaries(
        {
            "do": st.just("reset"),
            "seed": scalar | st.lists(scalar, max_size=3),
            "mask": st.none() | arrays | st.lists(st.booleans(), max_size=3) | anything,
            "options": st.none()
            | anything
            | st.fixed_dictionaries(
                {},
                optional={
                    "poses": anything,
                    "phase_s": number | st.lists(number, max_size=2),
                    "reset_mask": anything | arrays,
                },
            ),
        }
    ),
    st.fixed_dictionaries({"do": st.just("shares"), "value": anything}),
)


@target(st.tuples(st.integers(0, 2), st.lists(batch_moves, min_size=1, max_size=5)), share=1.5)
def batch_actions(case: Any) -> None:
    """Streams of actions and resets on the batch plant and in the vector environment."""
    kind, stream = case
    plant, envs = batches(kind), vectors(kind)
    plant.reset(seed=0)
    envs.reset(seed=0)
    for move in stream:
        if move["do"] == "shares":
            refused(lambda: plant.set_shares(real(move["value"])))
        elif move["do"] == "reset":
            seed, mask, options = (real(move[one]) for one in ("seed", "mask", "options"))
            refused(lambda: plant.reset(seed, mask, options))
            done = refused(lambda: envs.reset(seed=seed, options=options), TypeError)
            if done is not REFUSED:
                finite("observations of a vector environment", done[0], OBSERVATION_LIMIT)
        else:
            given = real(move["actions"])
            if refused(lambda: plant.step(given), RuntimeError) is not REFUSED:
                finite("observations of a batch", plant.observations, OBSERVATION_LIMIT)
                finite("rewards of a batch", plant.rewards)
            done = refused(lambda: envs.step(given), RuntimeError)
            if done is not REFUSED:
                finite("observations of a vector environment", done[0], OBSERVATION_LIMIT)
                finite("rewards of a vector environment", done[1])


@functools.cache
def single() -> Any:
    return FormationEnv("infinity", **{**SHORT, "horizon_s": 0.4})


@functools.cache
def turns() -> Any:
    return tlf_env.aec_env("infinity", **{**SHORT, "horizon_s": 0.4})


@target(st.lists(action, min_size=1, max_size=4), share=1.5)
def single_actions(case: Any) -> None:
    """Streams of actions in the Gymnasium environment and in the turn-based one."""
    env, aec = single(), turns()
    env.reset(seed=0)
    aec.reset(seed=0)
    for one in case:
        given = real(one)
        done = refused(lambda: env.step(given), RuntimeError)
        if done is not REFUSED:
            finite("an observation of the learner", done[0], OBSERVATION_LIMIT)
            finite("a reward of the learner", done[1])
            if done[2] or done[3]:
                env.reset(seed=0)
        if not aec.agents:
            aec.reset(seed=0)
        if refused(lambda: aec.step(given), RuntimeError) is REFUSED:
            aec.reset(seed=0)
            continue
        finite("an observation of a turn", aec.observe(aec.agent_selection), OBSERVATION_LIMIT)


poses = st.lists(
    st.lists(st.one_of(st.floats(-1e4, 1e4), number), min_size=3, max_size=3),
    min_size=2,
    max_size=2,
)


@target(
    st.fixed_dictionaries(
        {"kind": st.integers(0, 3), "seed": st.integers(0, 99)},
        optional={"poses": poses, "phase_s": number},
    ),
    share=1.0,
)
def starts(case: Any) -> None:
    """Start poses, far, near and inside each other, and phases."""
    env = parallel(case["kind"])
    options = {name: case[name] for name in ("poses", "phase_s") if name in case}
    done = refused(lambda: env.reset(seed=case["seed"], options=options))
    if done is REFUSED:
        return
    observed("at a given start", env, *done)
    for _ in range(2):
        if env.agents:
            seen, rewards, _, _, infos = env.step({agent: [0.5, 0.1] for agent in env.agents})
            observed("after a given start", env, seen, infos)
            finite("rewards after a given start", list(rewards.values()))


@functools.cache
def attacked() -> tuple[Any, dict[str, Any]]:
    given: dict[str, Any] = {}
    env = tlf_env.parallel_env(
        "infinity", adversary=lambda _: given["values"], **{**SHORT, "end_on": []}
    )
    return env, given


@target(
    st.one_of(
        st.dictionaries(
            st.sampled_from([one.path for one in CHANNELS]),
            st.one_of(number, st.lists(number, min_size=2, max_size=2), arrays, anything),
            max_size=3,
        ),
        st.lists(st.tuples(st.integers(0, len(CHANNELS) - 1), st.floats(0, 1)), max_size=4),
        anything,
    ),
    share=1.0,
)
def adversaries(case: Any) -> None:
    """What an adversary returns, hostile or within the channels' ranges."""
    env, given = attacked()
    env.reset(seed=0)
    values = real(case)
    pairs = isinstance(case, list) and all(isinstance(one, list) and len(one) == 2 for one in case)
    if pairs and all(type(which) is int and type(share) is float for which, share in case):
        values = {}
        for which, share in case:
            channel = CHANNELS[which % len(CHANNELS)]
            values[channel.path] = channel.low + min(max(float(share), 0.0), 1.0) * (
                channel.high - channel.low
            )
    given["values"] = values
    for _ in range(3):
        done = refused(lambda: env.step({agent: [0.4, 0.1] for agent in env.agents}))
        if done is REFUSED:
            return
        observed("with an adversary", env, done[0], done[4])
        finite("rewards with an adversary", list(done[1].values()))
