"""Controllers, laws, limiters, learned policies and names of policies."""

from __future__ import annotations

import functools
import json
import sys
from typing import Any

import numpy as np
from campaign.fuzzing.cases import changed, damaged, number, word
from campaign.fuzzing.checks import REFUSED, driven, finite, refused, working_folder
from campaign.fuzzing.registry import ViolationError, target
from campaign.fuzzing.scenarios import SHORT
from hypothesis import strategies as st

import tlf_env
from baselines.policies.card import read_policy
from baselines.policies.laws.catalogue import LAWS
from baselines.policies.learned import SHIPPED, LearnedPolicy
from baselines.policies.registry import fit_policy, make_policy, policy_names
from tlf_env.common.presets import preset_names, read_preset_or_file, yaml_text
from tlf_env.engine.snapshot import Snapshot
from tlf_env.onboard.limiters import load_limiter
from tlf_env.task.observation import OBSERVATION_LIMIT
from tlf_env.task.scenario import load_scenario


@functools.cache
def law_bases() -> list[Any]:
    found = [
        {"kind": "reference", "data": read_preset_or_file("controller", name)}
        for name in preset_names("controller")
    ]
    for law in LAWS:
        if law == "nmpc":
            continue
        found += [
            {"kind": law, "data": read_preset_or_file(law, name)} for name in preset_names(law)
        ]
        found.append(
            {"kind": law, "data": LAWS[law][1]().model_dump(mode="json", exclude_none=True)}
        )
    found += [
        {"kind": "limiter", "data": read_preset_or_file("limiter", name)}
        for name in preset_names("limiter")
    ]
    return found


@functools.cache
def rows_seen() -> np.ndarray:
    width = len(tlf_env.parallel_env("infinity").observation_space("robot_0").low)
    rng = np.random.default_rng(0)
    rows = rng.uniform(-1, 1, (6, width))
    rows[1], rows[2], rows[3] = 0.0, OBSERVATION_LIMIT, -OBSERVATION_LIMIT
    return rows.astype(np.float32)


def asked(policy: Any, rows: np.ndarray) -> None:
    """A policy's actions must be finite; ±1 is not demanded, as the environment clips."""
    state, starts = None, np.ones(len(rows), dtype=np.bool_)
    for _ in range(2):
        actions, state = policy.predict(rows, state, starts, True)
        finite("actions of a policy", actions)
        starts = np.zeros(len(rows), dtype=np.bool_)


@target(changed(law_bases, most=3, values=number), share=1.5)
def controllers(case: Any) -> None:
    """Files of controllers, laws and limiters."""
    kind, data = case.get("kind"), case.get("data")
    if kind not in ("limiter", "reference", *LAWS):
        return
    scenario = load_scenario("infinity")
    with working_folder() as folder:
        (folder / "own.yaml").write_text(yaml_text(data))
        if kind == "limiter":
            limiter = refused(lambda: load_limiter("own.yaml"))
            if limiter is not REFUSED:
                fields = {"action": "tracking_twist", "limiter": "own.yaml", **SHORT}
                limited = refused(lambda: load_scenario("infinity", **fields))
                if limited is not REFUSED:
                    driven(limited, steps=2)
            return
        policy = refused(lambda: make_policy(f"{kind}:own.yaml", scenario))
        if policy is not REFUSED:
            asked(policy, rows_seen())


@functools.cache
def cards() -> list[Any]:
    return [json.loads(path.read_text("utf-8")) for path in sorted(SHIPPED.glob("*.json"))]


@target(st.tuples(changed(cards, most=2), st.integers(0, 3)), share=0.7)
def policy_cards(case: Any) -> None:
    """Cards of learned policies."""
    card, which = case
    name = sorted(SHIPPED.glob("*.safetensors"))[which % len(list(SHIPPED.glob("*.safetensors")))]
    with working_folder() as folder:
        (folder / "own.safetensors").symlink_to(name)
        (folder / "own.json").write_text(json.dumps(card))
        loaded = refused(lambda: read_policy(folder / "own.safetensors"))
        if loaded is REFUSED:
            return
        policy = LearnedPolicy(loaded)
        fitted = refused(lambda: fit_policy("own.safetensors", load_scenario("infinity")))
        if fitted is not REFUSED:
            env = refused(lambda: tlf_env.parallel_env(fitted.scenario))
            if env is not REFUSED:
                seen, _ = env.reset(seed=0)
                asked(fitted.policy, np.stack(list(seen.values())))
        refused(lambda: asked(policy, rows_seen()))


def tensors(header: bytes, body: bytes) -> bytes:
    return len(header).to_bytes(8, "little") + header + body


@functools.cache
def weights() -> list[bytes]:
    from safetensors.numpy import save

    return [save({"a": np.arange(6, dtype=np.float32).reshape(2, 3), "b": np.zeros(2, np.float64)})]


@target(damaged(weights), share=2.0)
def weight_files(case: bytes) -> None:
    """Bytes of weights, with a card of their digest."""
    import hashlib

    with working_folder() as folder:
        card = {**cards()[0], "weights_sha256": hashlib.sha256(case).hexdigest()}
        (folder / "own.safetensors").write_bytes(case)
        (folder / "own.json").write_text(json.dumps(card))
        refused(lambda: read_policy(folder / "own.safetensors"))
        refused(lambda: Snapshot.load(folder / "own.safetensors"))


@target(
    st.one_of(
        word,
        st.lists(word, max_size=3).map("+".join),
        st.tuples(
            st.sampled_from(["adrc", "reference", "kanayama", "nmpc", "entry", "residual", "x"]),
            word,
        ).map(":".join),
    ),
    share=1.0,
)
def policy_names_(case: str) -> None:
    """Names of policies; nothing is imported."""
    before = set(sys.modules)
    with working_folder():
        made = refused(lambda: make_policy(case, load_scenario("infinity")))
    if (
        made is not REFUSED
        and ":" in case
        and not case.startswith(tuple(one.partition(":")[0] for one in policy_names()))
    ):
        raise ViolationError("a name has made a policy without permission", case)
    del before
