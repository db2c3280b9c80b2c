"""Environments for a long time, and many of them: no growth, and the same numbers however they are started.

Short versions of ``tests/campaign/endurance.py``, which takes ten million steps.
"""

from __future__ import annotations

import itertools
import time
import tracemalloc
from collections.abc import Iterator
from pathlib import Path

import pytest
from campaign import endurance, jobs
from campaign.endurance import KINDS, MANY, STEPS, Sample, grown

pytestmark = [
    pytest.mark.skipif(not Path("/proc/self/task").is_dir(), reason="counts by Linux' /proc"),
    pytest.mark.filterwarnings("ignore"),
]
FEW_STEPS = {"parallel_env": 2000, "gymnasium env": 1000, "vector env": 6400, "batch plant": 61_440}
RSS_MIB = 30.0  # of a few steps: the first ones fill caches


@pytest.fixture
def traced() -> Iterator[None]:
    tracemalloc.start()
    yield
    tracemalloc.stop()


@pytest.mark.parametrize("kind", STEPS)
def test_steps_hold_on_to_nothing(kind, traced):
    done, samples = endurance.watched(STEPS[kind][0](), FEW_STEPS[kind])
    assert done >= FEW_STEPS[kind]
    assert grown(samples, RSS_MIB) == []


@pytest.mark.parametrize("kind", MANY)
def test_environments_that_are_closed_leave_nothing(kind, traced, monkeypatch):
    if "images" in kind or "window" in kind:
        pytest.importorskip("pygame")
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    assert grown(endurance.made_and_closed(MANY[kind], 15), RSS_MIB) == []


def test_growth_is_seen():
    """Of each kind, and only of what is new after the first fifth."""
    flat = Sample(100.0, 10.0, 7, 3)
    for field in Sample._fields:
        more = flat._replace(**{field: getattr(flat, field) + 1000})
        (said,) = grown([flat] * 10 + [more])
        assert said.startswith(f"{field} has grown")
        assert grown([more] + [flat] * 10) == []
    kept = []
    tracemalloc.start()
    _, samples = endurance.watched((kept.append(bytes(1000)) or 1 for _ in itertools.count()), 1000)
    tracemalloc.stop()
    assert any("traced" in one for one in grown(samples))


@pytest.mark.parametrize("method", endurance.METHODS)
def test_environments_of_other_processes_and_threads_return_the_same(method):
    for kind, found in zip(KINDS, endurance.digests_in(method, KINDS, 2), strict=True):
        assert set(found) == {endurance.digest_of(kind)}


def test_a_clock_that_jumps_changes_no_result(tmp_path, monkeypatch):
    """Ahead by a year, and back by two, at every look at it."""
    from baselines import cli

    words = ("run", "circle", "--horizon-s", "3", "--no-figures", "--out", jobs.OUT)
    for place in ("usual", "jumping"):
        (tmp_path / place).mkdir()
        monkeypatch.chdir(tmp_path / place)
        monkeypatch.setattr("sys.argv", ["tlf", *words])
        if place == "jumping":
            for clock in ("time", "monotonic", "perf_counter"):
                monkeypatch.setattr(time, clock, that_jumps(getattr(time, clock)))
        cli.main()
    monkeypatch.undo()
    usual, jumping = (jobs._contents(tmp_path / place) for place in ("usual", "jumping"))
    assert usual == jumping


def that_jumps(clock):
    jumps_s = itertools.cycle([3.15e7, -6.3e7, 0.0])
    return lambda: clock() + next(jumps_s)


@pytest.mark.skipif(not endurance.FAKETIME.exists(), reason="needs the package faketime")
def test_a_command_under_a_clock_that_jumps_ends_with_the_same_bytes(tmp_path):
    job = jobs.RUN
    jobs.prepare(tmp_path / "usual", job)
    jobs.run_whole(tmp_path / "usual", job, jobs.Started)
    wanted = job.result(tmp_path / "usual" / jobs.OUT)
    jobs.prepare(tmp_path / "jumping", job)
    assert endurance._under_clock(tmp_path / "jumping", job, "jumps back and forth", wanted) == []


def test_a_revision_of_git_is_no_difference_but_all_else_is():
    usual = b'{"git_revision": "' + b"a" * 40 + b'+", "score": 1}'
    assert jobs.REVISION.sub(b"", usual) == b'{, "score": 1}'
    assert jobs.REVISION.sub(b"", b'{"git_revision": null, "score": 1}') == b'{, "score": 1}'
    assert jobs.REVISION.sub(b"", b"git_revision: null\n") == b"\n"
    row = b'<tr><th scope="row">revision</th><td class="text">' + b"a" * 40 + b"</td></tr>\n<tr>"
    assert jobs.REVISION.sub(b"", row) == b"<tr>"
