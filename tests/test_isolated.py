"""Code that a name stands for in a process of its own: the same bits, and whatever it does, one clear error."""

from __future__ import annotations

import copy
import gc
import os
import pickle
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest

import tlf_env
from baselines.benchmark.bench import run_bench
from baselines.benchmark.plan import Plan
from baselines.cli import main
from baselines.policies.registry import fit_policy, policy_hash
from baselines.runs.run import run_policy, run_seeds
from tlf_env import load_scenario
from tlf_env.common import pipes
from tlf_env.hosting import host, messages
from tlf_env.hosting.crew import ESTIMATE, ESTIMATE_SIZE, checked_estimates
from tlf_env.hosting.host import HostedPolicy
from tlf_env.onboard.parts import ISOLATED, PYTHON_ESTIMATORS

ROOT = Path(__file__).resolve().parent.parent
MODULE = """
import gc, os, pickle, signal, struct, sys, time
from collections import deque
from pathlib import Path

import numpy as np

import tlf_env


class Base:
    def __init__(self, robot, period_s):
        self.calls = 0

    def reset(self, pose):
        self.pose = pose

    def update(self, readings):
        self.calls += 1
        self.act()
        return self.pose


class Leaves(Base):
    def act(self):
        if self.calls == 37:
            os._exit(3)


class Killed(Base):
    def act(self):
        if self.calls == int(Path("when").read_text()):
            os.kill(os.getpid(), signal.SIGKILL)


class Hangs(Base):
    def act(self):
        if self.calls == 3:
            Path("hanging").write_text(str(os.getpid()))
            time.sleep(60)


class Talks(Base):
    def act(self):
        print("said in", os.getpid(), input if self.calls < 0 else sys.stdin.read())


class Looks(Base):
    def act(self):
        names = {type(one).__name__ for one in gc.get_objects()}
        raise KeyError(os.getpid(), sorted(names & {"Formation", "PymunkPlant", "FormationParallelEnv"}))


class Evil:
    def __reduce__(self):
        return Path.touch, (Path("unpickled"),)


class Forges(Base):
    def act(self):
        data = b"=" + pickle.dumps(Evil())
        for i in range(3, 20):
            try:
                os.write(i, struct.pack("<I", len(data)) + data)
            except OSError:
                pass


class Raises(Base):
    def act(self):
        raise ZeroDivisionError("all\\nover")


class Quits(Base):
    def act(self):
        sys.exit(0)


class Wide(Base):
    def update(self, readings):
        return np.zeros(4)


class Unready(Base):
    def reset(self, pose):
        raise LookupError("not yet")


class Unmade(Base):
    def __init__(self, robot, period_s):
        raise OSError("no file")


class Closed(Base):
    def act(self):
        self.file = sys.stderr


class Whole:
    \"\"\"An estimator with everything that one can return, and a state of every kind.\"\"\"

    def __init__(self, robot, period_s):
        self.robot, self.period_s = robot, period_s
        self.random, self.last = np.random.default_rng(3), deque(maxlen=3)

    def reset(self, pose):
        self.pose, self.twist = pose, None

    def update(self, readings):
        left, right = self.robot.wheel_radius_mm * readings.steps_rad
        forward, turn = (left + right) / 2, (right - left) / self.robot.axle_width_mm
        x, y, theta = self.pose
        self.pose = np.array([x - forward * np.sin(theta), y + forward * np.cos(theta), theta + turn])
        if readings.fix_mm is not None:
            self.pose[:2] += 0.1 * (readings.fix_mm - self.pose[:2]) * readings.fix_t_s / readings.t_s
        self.last.append((readings.gyro_rad_s, int(1e9 * readings.wanted_rad_s[0])))
        noise = self.random.normal()
        covariance = np.eye(3) + 1e-9 * readings.torques_Nmm[0]
        if len(self.last) < 3:
            return self.pose
        twist = (forward / self.period_s, turn / self.period_s) if noise > 0 else None
        return tlf_env.Estimated(self.pose, twist, (1e-3 * noise, 0.0), covariance, abs(noise))


class Wanders:
    \"\"\"A policy with a state, and with a memory of its own.\"\"\"

    scenario_overrides = {"preview_s": (0.5,), "ekf_slip": {}}
    privileged = True

    def __init__(self):
        self.count = 0

    def predict(self, observation, state=None, episode_start=None, deterministic=True):
        random = np.random.default_rng(1) if state is None else state["random"]
        self.count += 1
        lift = 0.1 * np.sin(self.count) + 0.01 * episode_start
        actions = 0.3 * np.tanh(observation[:, :2]) + lift[:, None] + 0.1 * random.random((len(observation), 2))
        return actions.astype(np.float32), {"random": random, "seen": observation[0].copy()}

    def get_state(self):
        return self.count

    def set_state(self, state):
        self.count = state


class Mortal(Wanders):
    \"\"\"Dies in the second episode of all processes, once.\"\"\"

    def predict(self, observation, state=None, episode_start=None, deterministic=True):
        if state is None:
            Path("episodes").open("a").write("1")
            if Path("episodes").stat().st_size == 2:
                os._exit(5)
        return super().predict(observation, state, episode_start, deterministic)


class Stuck:
    def predict(self, observation, state=None, episode_start=None, deterministic=True):
        while True:
            pass


def learned():
    from baselines.policies.learned import load_policy

    return load_policy("residual")


class Alone(Wanders):
    def predict(self, observation, state=None, episode_start=None, deterministic=True):
        return None
"""
EXAMPLES = {
    "estimator": "examples.custom_estimator:ComplementaryFilter",
    "wheel_loop": "examples.custom_wheel_loop:PiLoop",
    "observer": "examples.custom_observer:DelayLine",
}
ALL = {**EXAMPLES, "estimator": "isolated_code:Whole"}
BOTH = (True, ISOLATED)
PLACE = r"\(isolated_code\.py, line \d+\)"


@pytest.fixture(scope="module", autouse=True)
def module(tmp_path_factory):
    """A working directory with a module of a user."""
    folder = tmp_path_factory.mktemp("code")
    (folder / "isolated_code.py").write_text(MODULE)
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        patch.syspath_prepend(folder)
        patch.syspath_prepend(ROOT)
        yield folder
    sys.modules.pop("isolated_code", None)


@pytest.fixture
def quick(monkeypatch):
    """Short limits."""
    monkeypatch.setattr(host, "CALL_LIMIT_S", 1.5)
    monkeypatch.setattr(pipes, "END_LIMIT_S", 0.2)


def environment(trust: Any = ISOLATED, **fields: Any) -> Any:
    return tlf_env.parallel_env(
        "infinity", disturbance="combined-medium", end_on=(), trust=trust, **fields
    )


def steps(env: Any, count: int, gain: float = 0.4) -> list[bytes]:
    """All numbers of the formation after each of some control steps."""
    action, found = np.array([gain, 0.1], np.float32), []
    for _ in range(count):
        env.step(dict.fromkeys(env.agents, action))
        found.append(env.formation.arrays.states.tobytes())
    return found


def begin(env: Any, count: int) -> list[bytes]:
    """:func:`steps` of a new episode."""
    env.reset(seed=0)
    return steps(env, count)


def is_gone(pid: int) -> bool:
    """Whether there is no such process, not even a zombie."""
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return True
    return False


def has_ended(pid: int) -> bool:
    """:func:`is_gone`, or a zombie that its new parent, which is not ours, has left."""
    stat = Path(f"/proc/{pid}/stat")
    return is_gone(pid) or (stat.exists() and stat.read_text().rpartition(")")[2].split()[0] == "Z")


def pid_of(env: Any) -> int:
    """Of the process in which an environment's parts run."""
    (crew,) = env.formation._parts._distinct
    pid: int = crew.host.pid
    return pid


# The same bits


@pytest.mark.parametrize(
    "roles",
    [
        [*ALL],
        ["estimator"],
        pytest.param(["wheel_loop"], marks=pytest.mark.slow),
        pytest.param(["observer"], marks=pytest.mark.slow),
    ],
)
def test_parts_and_their_snapshots_are_those_in_this_process(roles):
    parts = {role: ALL[role] for role in roles}
    here, apart = (environment(trust, **parts) for trust in BOTH)
    taken = []
    for env in (here, apart):
        env.reset(seed=4)
        assert steps(env, 3) != steps(env, 3)
        taken.append(env.get_state())
    assert taken[0] == taken[1]
    wanted = steps(here, 6)
    assert steps(apart, 6) == wanted
    steps(apart, 2, gain=-0.3)
    for state in taken:  # each into each
        for env in (here, apart):
            env.set_state(state)
            assert steps(env, 6) == wanted
    for env in (here, apart):
        env.reset(seed=4)  # nothing of an episode is left in the next one
    assert steps(here, 3) == steps(apart, 3)


def test_parts_here_and_apart_work_together():
    """An object and an estimator of the package stay in this process."""
    from examples.custom_wheel_loop import PiLoop

    names = {"observer": EXAMPLES["observer"], "estimator": PYTHON_ESTIMATORS["ukf"]}
    runs = []
    for trust in BOTH:
        env = environment(trust, wheel_loop=PiLoop, **names)
        env.reset(seed=1)
        runs.append(steps(env, 4))
        before, wanted = env.get_state(), steps(env, 2)
        env.set_state(before)
        assert steps(env, 2) == wanted
    assert runs[0] == runs[1]
    assert "examples.custom_observer" not in (
        type(one).__name__ for one in env.formation._parts._distinct
    )
    assert [type(one).__name__ for one in env.formation._parts._distinct] == ["Crew", "HostedCrew"]


def single(trust: Any) -> Any:
    return gymnasium.make(
        "tlf_env/Infinity-v0", others="isolated_code:Wanders", trust=trust
    ).unwrapped


def test_the_policy_of_the_others_goes_on_bit_for_bit():
    here, apart = (single(trust) for trust in BOTH)
    taken, wanted = [], []
    for env in (here, apart):
        env.reset(seed=2)
        for _ in range(5):
            env.step(np.zeros(2, np.float32))
        taken.append(env.get_state())
        wanted.append([env.step(np.zeros(2, np.float32))[0].tobytes() for _ in range(5)])
    assert taken[0] == taken[1]
    assert wanted[0] == wanted[1]
    for state in taken:
        for env in (here, apart):
            env.set_state(state)
            again = [env.step(np.zeros(2, np.float32))[0].tobytes() for _ in range(5)]
            assert again == wanted[0]


@pytest.mark.parametrize("kind", ["formation", "batch"])
def test_a_base_goes_on_bit_for_bit(kind):
    fields = {"residual_base": "isolated_code:Wanders", "action": "residual"}
    taken, wanted = [], []
    for trust in BOTH:
        if kind == "batch":
            plant = tlf_env.BatchPlant("infinity", 3, trust=trust, **fields)
            plant.reset(5)
        else:
            plant = environment(trust, **fields).formation
            plant.reset(5)
        give = (lambda p: p.step(np.zeros((3, 3, 2)))) if kind == "batch" else (lambda p: p.step())
        for _ in range(4):
            give(plant)
        taken.append(plant.get_state())
        for _ in range(4):
            give(plant)
        wanted.append(plant.arrays.states.tobytes())
        plant.set_state(taken[0])
        for _ in range(4):
            give(plant)
        assert plant.arrays.states.tobytes() == wanted[0]
    assert taken[0] == taken[1]
    assert wanted[0] == wanted[1]


def test_runs_of_a_policy_are_those_in_this_process():
    scenario = load_scenario("infinity", horizon_s=0.4)
    fits = [fit_policy("isolated_code:Wanders", scenario, trust=trust) for trust in BOTH]
    assert fits[0].overrides == fits[1].overrides == {"preview_s": [0.5]}
    assert fits[0].scenario == fits[1].scenario
    assert all(fit.policy.privileged for fit in fits)
    digits = [policy_hash("isolated_code:Wanders", fit.policy) for fit in fits]
    assert digits[0] == digits[1] is not None
    a, b = (run_policy(fit.scenario, fit.policy, 3) for fit in fits)
    for column, values in a.columns.items():
        np.testing.assert_array_equal(values, b[column], err_msg=column)
    batch = load_scenario(fits[0].scenario, plant="batch")
    rows = [[record["x_mm"] for record in run_seeds(batch, fit.policy, [3, 4])] for fit in fits]
    np.testing.assert_array_equal(*rows)


def test_a_learned_policy_of_a_factory_is_fitted_to_the_scenario():
    scenario = load_scenario("infinity", horizon_s=0.2, preview_s=(0.24, 0.5, 1.0))
    own = fit_policy("residual", scenario)
    fit = fit_policy("isolated_code:learned", scenario, trust=ISOLATED)
    assert fit.scenario == own.scenario
    assert fit.overrides == own.overrides
    wanted = run_policy(own.scenario, own.policy, 2)["x_mm"]
    np.testing.assert_array_equal(run_policy(fit.scenario, fit.policy, 2)["x_mm"], wanted)
    fit.policy.close()
    np.testing.assert_array_equal(run_policy(fit.scenario, fit.policy, 2)["x_mm"], wanted)
    assert policy_hash("", fit.policy) == policy_hash("", own.policy)


@pytest.mark.slow  # torch is loaded twice
@pytest.mark.parametrize("algorithm", ["PPO", "SAC", "TD3"])
def test_a_zip_is_unpickled_in_a_process_of_its_own(algorithm, tmp_path):
    stable_baselines3 = pytest.importorskip("stable_baselines3")
    few = {"n_steps": 8, "batch_size": 8} if algorithm == "PPO" else {"buffer_size": 8}
    learner = gymnasium.make("tlf_env/Infinity-v0")
    model = getattr(stable_baselines3, algorithm)(
        "MlpPolicy", learner, policy_kwargs={"net_arch": [4]}, device="cpu", seed=0, **few
    )
    path = tmp_path / "model.zip"
    model.save(path)
    scenario = load_scenario("infinity", horizon_s=0.2)
    policy = fit_policy(str(path), scenario, trust=ISOLATED).policy
    seen = np.random.default_rng(0).normal(size=(3, *learner.observation_space.shape))
    seen = seen.astype(np.float32)
    wanted = model.predict(seen, deterministic=True)[0]
    np.testing.assert_array_equal(policy.predict(seen)[0], wanted)
    assert policy_hash(str(path), policy) == policy_hash(str(path), model)
    wrong = load_scenario("infinity", preview_s=(0.5,))
    with pytest.raises(ValueError, match=r"^\S+model\.zip: its observation has the shape \(\d+,\)"):
        fit_policy(str(path), wrong, trust=ISOLATED)


# What goes wrong is one line


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("Raises", rf" of robot_0: update\(\) raised ZeroDivisionError: all over {PLACE}"),
        ("Quits", rf" of robot_0: update\(\) raised SystemExit: 0 {PLACE}"),
        ("Unready", rf" of robot_0: reset\(\) raised LookupError: not yet {PLACE}"),
        ("Unmade", rf": its factory raised OSError: no file {PLACE}"),
        ("Leaves", r": the process ended with status 3 in update\(\) of the estimators"),
        ("Killed", r": the process was ended by SIGKILL in update\(\) of the estimators"),
        ("Hangs", r": no answer within 1\.5 s in update\(\) of the estimators"),
        ("Forges", r": an answer in update\(\) of the estimators that is not as agreed"),
    ],
)  # fmt: skip
def test_whatever_a_part_does_is_one_line_that_names_it(name, message, quick, module):
    (module / "when").write_text(str(np.random.default_rng().integers(1, 99)))
    env = environment(estimator=f"isolated_code:{name}")
    pid = pid_of(env)
    with pytest.raises(ValueError, match=rf"^estimator 'isolated_code:{name}'{message}$"):
        begin(env, 5)
    assert not (module / "unpickled").exists()
    if name in ("Leaves", "Killed", "Hangs", "Forges"):
        assert is_gone(pid)
        with pytest.raises(ValueError, match=r"its process has ended; call reset\(\)"):
            steps(env, 1)
        env.reset(seed=0)  # in another process
        assert pid_of(env) != pid


def test_an_answer_is_checked_as_in_this_process():
    env = environment(estimator="isolated_code:Wide")
    env.reset(seed=0)
    match = r"^robot_0: the estimator's update\(\) must return 3 finite numbers, got array\("
    with pytest.raises(ValueError, match=match):
        steps(env, 1)


def test_what_a_part_prints_goes_to_stderr_and_it_reads_nothing(capfd):
    env = environment(estimator="isolated_code:Talks")
    env.reset(seed=0)
    steps(env, 1)
    seen = capfd.readouterr()
    assert seen.out == ""
    assert seen.err.count(f"said in {pid_of(env)} \n") >= env.scenario.substeps


def test_a_part_finds_nothing_of_the_simulation():
    env = environment(estimator="isolated_code:Looks")
    env.reset(seed=0)
    with pytest.raises(ValueError, match=rf"raised KeyError: \({pid_of(env)}, \[\]\)"):
        steps(env, 1)
    assert pid_of(env) != os.getpid()
    assert os.getsid(pid_of(env)) == pid_of(env)  # a terminal's Ctrl-C does not reach it


def test_an_interrupt_ends_the_process(monkeypatch):
    monkeypatch.setattr(pipes, "END_LIMIT_S", 0.2)
    env = environment(estimator="isolated_code:Hangs")
    env.reset(seed=0)
    pid = pid_of(env)
    before = signal.signal(signal.SIGALRM, signal.default_int_handler)
    try:
        signal.setitimer(signal.ITIMER_REAL, 0.3)
        with pytest.raises(KeyboardInterrupt):
            steps(env, 1)
    finally:
        signal.signal(signal.SIGALRM, before)
    assert is_gone(pid)


@pytest.mark.slow
def test_ctrl_c_ends_a_command_whose_part_hangs(module, tmp_path):
    (module / "hanging").unlink(missing_ok=True)
    words = [
        "run",
        "infinity",
        "--trust",
        "--estimator",
        "isolated_code:Hangs",
        "--out",
        str(tmp_path / "out"),
    ]
    command = subprocess.Popen(
        [sys.executable, "-m", "baselines", *words],
        cwd=module,
        env={**os.environ, "PYTHONPATH": os.pathsep.join([str(ROOT), *sys.path])},
        start_new_session=True,
        stderr=subprocess.PIPE,
    )
    while not ((module / "hanging").exists() and (module / "hanging").read_text()):
        assert command.poll() is None
        time.sleep(0.05)
    os.killpg(command.pid, signal.SIGINT)  # as a terminal does
    _, errors = command.communicate(timeout=20)
    assert command.returncode == 130
    assert errors.decode().strip().splitlines()[-1].startswith("tlf: ")
    assert b"Traceback" not in errors
    assert has_ended(int((module / "hanging").read_text()))


def test_a_policy_that_returns_nothing_is_named():
    policy = fit_policy("isolated_code:Alone", load_scenario("infinity"), trust=ISOLATED).policy
    match = r"^policy 'isolated_code:Alone': predict\(\) must return a pair, \(actions, state\), got NoneType$"
    with pytest.raises(ValueError, match=match):
        policy.predict(np.zeros((3, 5)))
    with pytest.raises(ValueError, match="a state that its process has not returned: 3"):
        policy.predict(np.zeros((3, 5)), 3)


def test_a_benchmark_keeps_what_is_finished(tmp_path, module):
    pytest.importorskip("arch")
    overrides = (("horizon_s", 0.2), ("plant", "pymunk"))
    plan = Plan(
        ("isolated_code:Mortal",),
        ("infinity",),
        ("nominal",),
        (0, 2),
        overrides=overrides,
        trust=ISOLATED,
    )
    match = r"^policy 'isolated_code:Mortal': the process ended with status 5 in predict\(\)$"
    with pytest.raises(ValueError, match=match):
        run_bench(plan, tmp_path)
    assert len((tmp_path / "runs.jsonl").read_text().splitlines()) == 1
    assert len(run_bench(plan, tmp_path).lines) == 2
    assert (module / "episodes").read_text() == "1" * 3


def test_the_command_line_runs_code_in_a_process_of_its_own(monkeypatch, capsys, tmp_path):
    words = [
        "run",
        "infinity",
        "--trust",
        "--no-figures",
        "--horizon-s",
        "0.2",
        "--out",
        str(tmp_path / "out"),
    ]
    monkeypatch.setattr(sys, "argv", ["tlf", *words, "--estimator", "isolated_code:Looks"])
    with pytest.raises(SystemExit) as left:
        main()
    assert left.value.code == 2
    last = " ".join(capsys.readouterr().err.split())
    assert "tlf: estimator 'isolated_code:Looks' of robot_0: update() raised KeyError: (" in last
    assert f"({os.getpid()}" not in last


# Processes end


def test_closing_ends_the_process_and_a_reset_starts_another():
    env = environment(observer=EXAMPLES["observer"])
    env.reset(seed=1)
    first, pid = steps(env, 2), pid_of(env)
    env.close()
    assert is_gone(pid)
    env.reset(seed=1)
    assert steps(env, 2) == first
    pid = pid_of(env)
    for make in (copy.deepcopy, pickle.dumps):
        with pytest.raises(TypeError, match=r"process of its own, which cannot be copied"):
            make(env)
    del env
    gc.collect()
    assert is_gone(pid)


@pytest.mark.slow
def test_environments_that_are_dropped_leave_no_process():
    count = 40
    pids = []
    for _ in range(count):
        env = environment(wheel_loop=EXAMPLES["wheel_loop"])
        pids.append(pid_of(env))
        del env
        gc.collect()
    assert len(set(pids)) == count
    assert all(map(is_gone, pids))


def test_a_fork_leaves_the_process_alone(monkeypatch):
    policy = HostedPolicy("policy", "isolated_code:Wanders", 2)
    pid = policy.host.pid
    real = os.getpid
    monkeypatch.setattr(os, "getpid", lambda: -1)
    with pytest.raises(ValueError, match="from which this one was forked"):
        policy.predict(np.zeros((3, 5)))
    monkeypatch.setattr(os, "getpid", real)
    assert not is_gone(pid)
    policy.close()
    assert is_gone(pid)


def test_code_that_never_ends_ends_with_the_simulation(module):
    script = (
        "import numpy as np\nfrom tlf_env.hosting.host import HostedPolicy\n"
        "policy = HostedPolicy('policy', 'isolated_code:Stuck', 2)\n"
        "print(policy.host.pid, flush=True)\npolicy.predict(np.zeros((3, 5)))\n"
    )
    paths = os.pathsep.join([str(ROOT), *sys.path])
    parent = subprocess.Popen(
        [sys.executable, "-c", script],
        stdout=subprocess.PIPE,
        cwd=module,
        env={**os.environ, "PYTHONPATH": paths},
    )
    pid = int(parent.stdout.readline())
    time.sleep(0.2)
    assert not is_gone(pid)
    parent.kill()
    parent.wait()
    parent.stdout.close()
    until = time.monotonic() + 10.0
    while not has_ended(pid) and time.monotonic() < until:
        time.sleep(0.05)
    assert has_ended(pid)


# Messages


def test_messages_come_back_as_they_were():
    numbers = {
        "a": np.arange(6.0).reshape(2, 3),
        "b": np.array(3, np.int8),
        "c": np.zeros((0, 4), np.float32),
        "d": np.array([True, False]),
        "e": np.arange(6.0).reshape(2, 3).T,
        "f": np.array([np.nan, -0.0, np.inf]),
    }
    value, found = messages.decoded(messages.encoded([1, None, {"x": 1e-300}], numbers))
    assert value == [1, None, {"x": 1e-300}]
    for name, array in numbers.items():
        assert found[name].dtype == array.dtype
        assert found[name].shape == array.shape
        assert found[name].tobytes() == array.tobytes()
        assert found[name].flags.writeable


GOOD = messages.encoded({"x": 1}, {"a": np.arange(3.0)})


@pytest.mark.parametrize(
    "data",
    [
        b"",
        b"\x01",
        b"\xff\xff\xff\xff",
        GOOD[:-1],
        GOOD + b"1",
        pickle.dumps([1, 2]),
        b"\x02\0\0\0[]",
        GOOD.replace(b"<f8", b"|O8"),
        GOOD.replace(b"[3]", b"[9]"),
        GOOD.replace(b"[3]", b"[-"),
        b"\x04\0\0\0null",
        GOOD.replace(b'"a"', b"123"),
        GOOD.replace(b"[3]", b"3.0"),
        b"\x40\x0d\x03\0" + b"[" * 200000,
    ],
)
def test_a_message_that_is_not_as_agreed_is_refused(data):
    with pytest.raises(messages.DamagedError):
        messages.decoded(data)


@pytest.mark.parametrize(
    ("place", "value"),
    [(0, np.nan), (4, np.inf), (7, np.nan), (8, -1.0), (9, 1.0), (17, -0.5), (17, np.nan)],
)
def test_numbers_of_another_process_are_checked(place, value):
    rows = np.zeros((3, ESTIMATE_SIZE))
    rows[:, ESTIMATE.covariance] = np.eye(3).ravel()
    assert checked_estimates(rows, 3) is rows
    rows[1, place] = value
    with pytest.raises(ValueError, match=r"^robot_1: the estimator's update\(\) must return"):
        checked_estimates(rows, 3)
