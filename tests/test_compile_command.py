"""``tlf compile``: what it compiles is all that an episode needs, and it ends in one line, whatever happens."""

from __future__ import annotations

import copy
import json
import multiprocessing
import os
import subprocess
import sys
import time
from contextlib import contextmanager
from multiprocessing.connection import Connection

import numpy as np
import pytest

from baselines import cli
from baselines.commands import compile as compile_command
from baselines.commands.compile import Share
from tlf_env import BatchPlant
from tlf_env.numerics.compiled import cache_folder


def arrays_of(plant: BatchPlant) -> list[np.ndarray]:
    return copy.deepcopy([one for one in plant.arrays if isinstance(one, np.ndarray)])


def test_compiling_changes_no_formation():
    plant = BatchPlant("infinity", 3, disturbance="combined-hard")
    before = arrays_of(plant)
    plant.compile_step()
    plant.compile_start()
    for one, other in zip(arrays_of(plant), before, strict=True):
        assert np.array_equal(one, other, equal_nan=True)
    with pytest.raises(RuntimeError, match="call reset"):
        plant.step(np.zeros((3, 3, 2)))
    plant.reset(seed=0)
    plant.step(np.full((3, 3, 2), 0.5))
    before = arrays_of(plant)
    plant.compile_step()
    plant.compile_start()
    for one, other in zip(arrays_of(plant), before, strict=True):
        assert np.array_equal(one, other, equal_nan=True)


# Episodes through several doors; prints the drivers of them that had to be compiled.
EPISODES = """
import json
import numpy as np
import tlf_env
from tlf_env.engine import drivers

for fields in ({}, {"plant": "kinematic"}, {"robots": 2}, {"estimator": "ekf"}):
    env = tlf_env.parallel_env("infinity", **fields)
    env.reset(seed=0)
    env.step({agent: env.action_space(agent).sample() for agent in env.agents})
near = [[0.0, 0.0, 0.0], [150.0, 0.0, 0.0], [1000.0, 0.0, 0.0]]  # two robots that could touch
env = tlf_env.parallel_env("infinity")
env.reset(seed=0, options={"poses": near})
env.step({agent: np.ones(2, dtype=np.float32) for agent in env.agents})
plant = tlf_env.BatchPlant(["infinity", "infinity"], 40, mixture=True, threads=2, disturbance="ice")
plant.reset(seed=0)
plant.step(np.zeros((40, 3, 2)), plant.excerpt(1))
plant.write_excerpt(plant.excerpt(1))
stats = {name: one.stats for name, one in vars(drivers).items() if hasattr(one, "stats")}
found = sorted(name for name, one in stats.items() if one.cache_hits)
print(json.dumps([found, [name for name, one in stats.items() if one.cache_misses]]))
"""


@pytest.mark.skipif(
    cache_folder() is None, reason="no folder for compiled code can be written here"
)
def test_after_it_an_episode_finds_everything_in_the_cache():
    compile_command.in_two_processes(compile_command.USUAL)
    done = subprocess.run(
        [sys.executable, "-c", EPISODES], capture_output=True, text=True, check=True
    )
    found, compiled = json.loads(done.stdout)
    assert compiled == []
    assert found == [
        "control_step",
        "excerpt_of",
        "mark",
        "start",
    ]


# Compiles one share, and prints how much work each of its drivers was up to its end.
WORK = """
import json, sys
from numba.core.event import install_listener
from baselines.commands import compile as command

class Sent(list):
    send = list.append

sent = Sent()
with install_listener("numba:compile", command._Counted(sent)):
    command.compiled(getattr(command, sys.argv[1])[int(sys.argv[2])])
print(json.dumps([list(one) for one in sent]))
"""


@pytest.mark.slow
@pytest.mark.parametrize("name", ["USUAL", "ALL"])
@pytest.mark.parametrize("which", [0, 1])
def test_the_progress_bar_ends_where_the_work_ends(name, which, tmp_path):
    done = subprocess.run(
        [sys.executable, "-c", WORK, name, str(which)],
        env={**os.environ, "TLF_ENV_CACHE": str(tmp_path)},
        capture_output=True,
        text=True,
        check=True,
    )
    stages = json.loads(done.stdout)
    assert [one[1] for one in stages] == sorted(one[1] for one in stages)
    share = getattr(compile_command, name)[which]
    assert stages[-1][1] == pytest.approx(share.work, rel=0.1)


def work(share: Share, to_parent: Connection) -> None:
    for done in (0.5, 1.0):
        to_parent.send(compile_command.Stage(f"driver {share.of[0]}", done * share.work))
    to_parent.send(share.of[0] == "start")


def test_the_progress_bar_names_the_drivers_and_the_share_done(monkeypatch):
    shown = []

    @contextmanager
    def bar(what: str):
        yield lambda done, total, now: shown.append((done / total, now))

    monkeypatch.setattr(compile_command, "compile_share", work)
    monkeypatch.setattr(compile_command, "progress_bar", bar)
    assert compile_command.in_two_processes(compile_command.USUAL)
    parts = [part for part, _ in shown]
    assert parts == sorted(parts)
    assert parts[-1] == 1.0
    assert any("driver step" in now for _, now in shown)
    assert any("driver start" in now for _, now in shown)


def test_a_first_run_compiles_and_the_next_one_does_not(monkeypatch, tmp_path, capsys):
    compiled = []
    monkeypatch.setattr(compile_command, "cache_folder", lambda: tmp_path)
    monkeypatch.setattr(compile_command, "in_two_processes", compiled.append)
    compile_command.compile_before_first_run()
    assert compiled == [compile_command.USUAL]
    assert "once on this machine" in capsys.readouterr().err
    (tmp_path / "engine").mkdir()
    (tmp_path / "engine" / "drivers.control_step-1.py311.nbi").touch()
    compile_command.compile_before_first_run()
    assert len(compiled) == 1
    assert not capsys.readouterr().err


@pytest.mark.parametrize(
    ("anything", "says"), [(True, "Compiled the step drivers in 0 s"), (False, "All step drivers")]
)
def test_it_says_what_it_did(anything, says, monkeypatch, capsys):
    monkeypatch.setattr(compile_command, "in_two_processes", lambda shares: anything)
    monkeypatch.setattr(sys, "argv", ["tlf", "compile"])
    cli.main()
    printed = capsys.readouterr().out
    assert printed.startswith(says)
    assert str(cache_folder()) in printed


def leave(share: Share, to_parent: Connection) -> None:
    os._exit(7)


def fail(share: Share, to_parent: Connection) -> None:
    to_parent.send(f"ValueError: {share.of[0]}\nis wrong")


def hang(share: Share, to_parent: Connection) -> None:
    time.sleep(600)


def one_fails_one_hangs(share: Share, to_parent: Connection) -> None:
    (fail if share == compile_command.USUAL[1] else hang)(share, to_parent)


@pytest.mark.parametrize(
    ("child", "says"),
    [
        (leave, "a process ended with status 7"),
        (fail, "is wrong"),
        (one_fails_one_hangs, "ValueError: start is wrong"),
    ],
)
def test_an_error_of_a_process_is_one_line(child, says, monkeypatch, capsys):
    monkeypatch.setattr(compile_command, "compile_share", child)
    monkeypatch.setattr(sys, "argv", ["tlf", "compile"])
    with pytest.raises(SystemExit) as ended:
        cli.main()
    assert ended.value.code == cli.FAILED
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("tlf: the step drivers could not be compiled: ")
    assert says in line
    assert not multiprocessing.active_children()


def test_an_error_while_compiling_is_sent(monkeypatch):
    class Sent(list):
        send = list.append

    def wrong(share: Share) -> bool:
        raise MemoryError(share.dtype)

    monkeypatch.setattr(compile_command.signal, "signal", lambda *_: None)
    monkeypatch.setattr(compile_command, "compiled", wrong)
    sent = Sent()
    compile_command.compile_share(compile_command.USUAL[0], sent)
    assert sent == ["MemoryError: float32"]


def test_an_interrupt_ends_both(monkeypatch, capsys):
    def interrupted(waiting: list[Connection]) -> None:
        assert len(multiprocessing.active_children()) == len(waiting) == 2
        raise KeyboardInterrupt

    monkeypatch.setattr(compile_command, "compile_share", hang)
    monkeypatch.setattr(compile_command, "wait", interrupted)
    monkeypatch.setattr(sys, "argv", ["tlf", "compile"])
    with pytest.raises(SystemExit) as ended:
        cli.main()
    assert ended.value.code == cli.INTERRUPTED
    assert capsys.readouterr().err.splitlines() == ["tlf: interrupted"]
    assert not multiprocessing.active_children()


def test_without_a_folder_nothing_is_compiled(monkeypatch, capsys):
    monkeypatch.setattr(compile_command, "cache_folder", lambda: None)
    monkeypatch.setattr(sys, "argv", ["tlf", "compile"])
    with pytest.raises(SystemExit) as ended:
        cli.main()
    assert ended.value.code == cli.FAILED
    assert "TLF_ENV_CACHE" in capsys.readouterr().err
