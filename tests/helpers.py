"""Shared by the tests: driving an environment, and comparing what it returns bit for bit."""

from __future__ import annotations

import hashlib
import importlib.util
import marshal
import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import settings

import tlf_env
from baselines import ReferencePolicy, cli
from tlf_env.onboard.tracking import TrackingGains

Actions = dict[str, np.ndarray]

# The first call of a compiled law takes a second or so.
untimed = settings(deadline=None)

LOST_RMS_MM = 100.0
SETTLED_FROM, TAIL_FROM = 0.4, 0.7  # fractions of a run
# The paper's filter and broadcasts, for tests with numbers of the paper's controller.
PAPERS: dict[str, Any] = {"estimator": "ekf", "broadcast_smoothing_s": 0.0}


@dataclass(frozen=True)
class Run:
    """A finished run, ends ignored: one row per control step, the start included."""

    error_mm: np.ndarray  # (time, robot), true pose to the robot's own reference
    heading_error_rad: np.ndarray  # (time, robot)
    lost_at_once: np.ndarray  # (robot,) the error passed lost_beyond_mm
    touched: np.ndarray  # (robot,)

    @property
    def rms_mm(self) -> np.ndarray:
        """Settled error of each robot."""
        return self.rms_between(SETTLED_FROM)

    @property
    def lost(self) -> np.ndarray:
        """Which robots a table would call lost."""
        return self.lost_at_once | (self.rms_between(TAIL_FROM) > LOST_RMS_MM)

    def rms_between(self, first: float, last: float = 1.0) -> np.ndarray:
        """RMS error of each robot between two fractions of the run."""
        rows = len(self.error_mm)
        return np.sqrt(np.mean(self.error_mm[int(first * rows) : int(last * rows)] ** 2, axis=0))


def stacked(by_agent: Mapping[str, np.ndarray]) -> np.ndarray:
    """Observations of all agents as one batch."""
    return np.stack(list(by_agent.values()))


def unstacked(env: Any, rows: np.ndarray) -> Actions:
    """A batch of actions as one for each agent."""
    return dict(zip(env.possible_agents, np.asarray(rows, dtype=np.float32), strict=True))


def alike(env: Any, action: tuple[float, float] = (0.0, 0.0)) -> Actions:
    """The same action for every agent."""
    return {agent: np.array(action, dtype=np.float32) for agent in env.possible_agents}


def reference_actions(env: Any, observations: Mapping[str, np.ndarray]) -> Actions:
    """What the reference controller does."""
    return unstacked(env, ReferencePolicy().predict(stacked(observations))[0])


def random_actions(rng: np.random.Generator) -> Callable[..., Actions]:
    """Uniform actions from the whole action space, as a policy."""
    return lambda env, _: unstacked(env, rng.uniform(-1, 1, (len(env.possible_agents), 2)))


def drive(
    scenario: str = "infinity",
    gains: str | TrackingGains = "consistent",
    seed: int = 0,
    **overrides: Any,
) -> Run:
    """Run a reference controller over the whole horizon; the filter is the paper's if none is named."""
    env = tlf_env.parallel_env(scenario, end_on=(), **PAPERS | overrides)
    policy = ReferencePolicy(gains)
    observations, infos = env.reset(seed=seed)
    rows = [infos]
    while env.agents:
        actions = unstacked(env, policy.predict(stacked(observations))[0])
        observations, _, _, _, infos = env.step(actions)
        rows.append(infos)

    def column(name: str) -> np.ndarray:
        return np.array([[info[name] for info in row.values()] for row in rows])

    return Run(
        error_mm=column("position_error_mm"),
        heading_error_rad=column("heading_error_rad"),
        lost_at_once=column("lost")[-1],
        touched=column("touched")[-1],
    )


def play(
    env: Any,
    observations: Mapping[str, np.ndarray],
    steps: int | None = None,
    policy: Callable[..., Actions] = reference_actions,
) -> list[Any]:
    """Everything that ``steps`` steps return (by default, all until the episode ends)."""
    returned = []
    while env.agents and (steps is None or len(returned) < steps):
        returned.append(env.step(policy(env, observations)))
        observations = returned[-1][0]
    return returned


def digest(value: Any) -> str:
    """A hash of nested containers, arrays and numbers that changes with any bit of them."""
    return hashlib.sha256(marshal.dumps(_plain(value), 2)).hexdigest()


def _plain(value: Any) -> Any:
    if isinstance(value, np.ndarray):
        return str(value.dtype), value.shape, value.tobytes()
    if isinstance(value, np.generic):
        return str(value.dtype), value.tobytes()
    if isinstance(value, dict):
        return {key: _plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    return value


def whole_episode_digest(scenario: str, seed: int, **overrides: Any) -> str:
    """Digest of everything that an episode of the reference controller returns."""
    env = tlf_env.parallel_env(scenario, **overrides)
    start = env.reset(seed=seed)
    observations, digests = start[0], [digest(start)]
    while env.agents:
        step = env.step(reference_actions(env, observations))
        observations = step[0]
        digests.append(digest(step))
    return digest(digests)


def installed(policies):
    """Names of policies for a parametrised test, which skips those whose package is missing."""
    missing = importlib.util.find_spec("casadi") is None
    skip = pytest.mark.skipif(missing, reason="nmpc needs casadi, of the optional extra mpc")
    return [pytest.param(name, marks=skip if name.startswith("nmpc") else ()) for name in policies]


def benched(folder: Path, plan: str, words: str) -> Path:
    """The results of ``tlf bench`` with a plan, in a folder below the given one."""
    from baselines.cli import main

    (folder / "plan.yaml").write_text(plan)
    with pytest.MonkeyPatch.context() as patch:
        places = f"--plan {folder}/plan.yaml --out {folder}/made"
        given = f"bench {places} --no-figures --replays 0 --processes 1 {words}"
        patch.setattr(sys, "argv", ["tlf", *given.split()])
        main()
    return folder / "made"


class Aborted(ReferencePolicy):
    """The reference, interrupted in its 51st step."""

    calls = 0

    def predict(self, *args: Any, **kwargs: Any) -> Any:
        self.calls += 1
        if self.calls > 50:
            raise KeyboardInterrupt
        return super().predict(*args, **kwargs)


def refused(
    words: list[str], capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> str:
    """The one line with which the command line refuses some words as bad input."""
    monkeypatch.setattr("sys.argv", ["tlf", *words])
    with pytest.raises(SystemExit) as stopped:
        cli.main()
    assert stopped.value.code == cli.BAD_INPUT
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 1
    return lines[0]
