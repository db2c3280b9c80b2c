"""A forked child goes on with the same numbers, whatever the threads of its parent were doing."""

from __future__ import annotations

import hashlib
import os
import signal
import sys
import threading
import time
from collections.abc import Callable

import gymnasium
import numpy as np
import pytest

from tlf_env import BatchPlant

pytestmark = [
    pytest.mark.skipif(not hasattr(os, "fork"), reason="Windows has no os.fork"),
    # Python itself warns of threads before a fork; that it goes well here is what is tested.
    pytest.mark.filterwarnings("ignore:.*multi-threaded:DeprecationWarning"),
]

FORMATIONS = 40  # enough for as many threads as are tested
CHILD_LIMIT_S = 30
SHORT = {"time_gap_s": 0.1, "horizon_s": 2.0, "preview_s": (), "end_on": ()}


def in_a_child(work: Callable[[], bytes]) -> bytes:
    """What a forked child returns; a child that hangs is ended by its alarm."""
    reader, writer = os.pipe()
    sys.stdout.flush()
    pid = os.fork()
    if pid == 0:
        signal.signal(signal.SIGALRM, signal.SIG_DFL)
        signal.alarm(CHILD_LIMIT_S)
        status = 1
        try:
            os.write(writer, work())
            status = 0
        finally:
            os._exit(status)
    os.close(writer)
    with os.fdopen(reader, "rb") as pipe:
        answer = pipe.read()
    assert os.waitpid(pid, 0)[1] == 0, "the child hung or failed"
    return answer


def actions(count: int) -> np.ndarray:
    return np.random.default_rng(count).uniform(-1, 1, (FORMATIONS, 3, 2))


def stepped(plant: BatchPlant, first: int, last: int) -> bytes:
    """A digest of some steps."""
    digest = hashlib.sha256()
    for step in range(first, last):
        plant.step(actions(step))
        digest.update(plant.observations.tobytes())
        digest.update(plant.rewards.tobytes())
    return digest.digest()


@pytest.fixture(params=[1, 2, 3])
def plant(request: pytest.FixtureRequest) -> BatchPlant:
    made = BatchPlant("infinity", FORMATIONS, threads=request.param, **SHORT)
    made.reset(0)
    stepped(made, 0, 3)
    return made


def test_a_child_steps_on_as_its_parent(plant):
    child = in_a_child(lambda: stepped(plant, 3, 9))
    assert child == stepped(plant, 3, 9)


def test_a_childs_child_steps_on_as_well(plant):
    def child() -> bytes:
        mine = stepped(plant, 3, 6)
        return mine + in_a_child(lambda: stepped(plant, 6, 9)) + stepped(plant, 6, 9)

    answer = in_a_child(child)
    assert answer == stepped(plant, 3, 6) + 2 * stepped(plant, 6, 9)


def test_a_child_may_start_anew_while_another_thread_of_its_parent_steps(plant):
    plant.reset(0)
    wanted = stepped(plant, 0, 5)
    done = threading.Event()

    def go_on() -> None:
        while not done.is_set():
            plant.reset(1)
            stepped(plant, 0, 20)

    def anew() -> bytes:
        plant.reset(0)
        return stepped(plant, 0, 5)

    other = threading.Thread(target=go_on)
    other.start()
    try:
        for _ in range(10):
            time.sleep(0.01)
            assert in_a_child(anew) == wanted
    finally:
        done.set()
        other.join()


def test_an_ordinary_end_of_a_child_does_not_wait_for_threads_of_its_parent(plant):
    """The interpreter's own exit joins the threads of every pool that it knows."""
    sys.stdout.flush()
    sys.stderr.flush()
    pid = os.fork()
    if pid == 0:
        signal.alarm(CHILD_LIMIT_S)
        stepped(plant, 3, 5)
        threading._shutdown()  # what the interpreter calls before it ends
        os._exit(0)
    assert os.waitpid(pid, 0)[1] == 0


@pytest.mark.parametrize("threads", [1, 2])
def test_a_vector_environment_steps_on_in_a_child(threads):
    env = gymnasium.make_vec("tlf_env/Infinity-v0", num_envs=FORMATIONS, threads=threads, **SHORT)
    env.reset(seed=0)
    env.step(actions(0)[:, 0].astype(np.float32))

    def go_on() -> bytes:
        results = [env.step(actions(step)[:, 0].astype(np.float32))[:2] for step in range(1, 5)]
        return b"".join(array.tobytes() for result in results for array in result)

    assert in_a_child(lambda: hashlib.sha256(go_on()).digest()) == hashlib.sha256(go_on()).digest()


def test_forked_workers_step_a_plant_that_two_threads_of_the_parent_have_stepped():
    """As :class:`gymnasium.vector.AsyncVectorEnv` and SubprocVecEnv start theirs."""
    parent = gymnasium.make_vec("tlf_env/Infinity-v0", num_envs=FORMATIONS, threads=2, **SHORT)
    parent.reset(seed=0)
    parent.step(actions(0)[:, 0].astype(np.float32))

    class Inner(gymnasium.Env):
        """Steps the plant of the parent in its worker."""

        observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (1,), np.float64)
        action_space = gymnasium.spaces.Box(-1, 1, (2,), np.float32)

        def reset(self, *, seed=None, options=None):
            parent.reset(seed=seed)
            return np.zeros(1), {}

        def step(self, action):
            rewards = parent.step(np.tile(action, (FORMATIONS, 1)))[1]
            return np.array([rewards.sum()]), 0.0, False, False, {}

    vector = gymnasium.vector.AsyncVectorEnv([Inner, Inner], context="fork", shared_memory=False)
    try:
        vector.reset(seed=[3, 3])
        for _ in range(3):
            vector.step_async(np.full((2, 2), 0.3, dtype=np.float32))
            seen = vector.step_wait(timeout=CHILD_LIMIT_S)[0]
    finally:
        vector.close(terminate=True)
    parent.reset(seed=3)
    for _ in range(3):
        rewards = parent.step(np.full((FORMATIONS, 2), 0.3, dtype=np.float32))[1]
    assert seen.tolist() == [[rewards.sum()]] * 2


def test_a_child_compiles_though_another_thread_of_its_parent_was_compiling():
    """A lock that another thread held at the moment of the fork is free in the child."""
    from numba.core.compiler_lock import global_compiler_lock

    held, done = threading.Event(), threading.Event()

    def hold() -> None:
        with global_compiler_lock:
            held.set()
            done.wait(0.5)

    def compile_anew() -> bytes:
        with global_compiler_lock:
            return b"free"

    other = threading.Thread(target=hold)
    other.start()
    held.wait()
    try:
        assert in_a_child(compile_anew) == b"free"
    finally:
        done.set()
        other.join()
    with global_compiler_lock:
        pass


def test_threads_end_with_their_plants():
    before = threading.active_count()
    for _ in range(30):
        made = BatchPlant("infinity", FORMATIONS, threads=3, **SHORT)
        made.reset(0)
        made.step(actions(0))
    del made
    for _ in range(100):
        if threading.active_count() <= before:
            break
        time.sleep(0.05)
    assert threading.active_count() <= before
