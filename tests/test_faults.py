"""Faults while something is written: interrupts, kills, full disks, two commands in one folder."""

from __future__ import annotations

import json
import os
import random
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import numpy as np
import pytest

from baselines import ReferencePolicy
from baselines.benchmark.bench import run_bench
from baselines.benchmark.plan import Plan
from baselines.benchmark.results import RUNS_FILE
from baselines.runs.run import run_policy
from tlf_env.task.scenario import load_scenario

SHORT = (("horizon_s", 2.0),)
PLAN = Plan(
    policies=("pure_pursuit",),
    tasks=("infinity",),
    disturbances=("nominal", "start"),
    seeds=(20_000, 20_002),
    overrides=SHORT,
)


class InterruptedAt:
    """The reference, until Ctrl-C is pressed at a call."""

    def __init__(self, call: int) -> None:
        self.left, self.reference = call, ReferencePolicy()

    def predict(self, rows, state=None, episode_start=None, deterministic=True):
        self.left -= 1
        if not self.left:
            raise KeyboardInterrupt
        return self.reference.predict(rows, state, episode_start, deterministic)


# --- interrupts


@pytest.mark.parametrize("call", [1, 2, 50])
def test_an_interrupt_goes_on_unless_the_part_is_asked_for(call):
    scenario = load_scenario("circle", horizon_s=2.0)
    with pytest.raises(KeyboardInterrupt):
        run_policy(scenario, InterruptedAt(call))


def test_an_interrupted_episode_is_no_line_of_a_benchmark(tmp_path, monkeypatch):
    """Ctrl-C in an episode: it is neither taken as finished nor is the benchmark gone on with."""
    pytest.importorskip("arch")
    from baselines.runs import run as runs

    real, steps = runs.PolicyDriver.act, iter(range(10_000))

    def act(self):
        if next(steps) == 150:  # in the second episode
            raise KeyboardInterrupt
        return real(self)

    with monkeypatch.context() as patch:
        patch.setattr(runs.PolicyDriver, "act", act)
        with pytest.raises(KeyboardInterrupt):
            run_bench(PLAN, tmp_path / "cut")
    assert (tmp_path / "cut" / RUNS_FILE).read_bytes().count(b"\n") == 1
    run_bench(PLAN, tmp_path / "cut")
    run_bench(PLAN, tmp_path / "whole")
    cut, whole = ((tmp_path / one / RUNS_FILE).read_bytes() for one in ("cut", "whole"))
    assert cut == whole
