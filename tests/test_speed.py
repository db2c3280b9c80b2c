import ast
import dataclasses
import importlib
import importlib.util
import json
import os
import sys
from pathlib import Path

import numpy as np
import pytest

from baselines import cli
from baselines.speed import crew, environments, footprint, parts, served, speed, trained
from baselines.speed.moments import DRIVEN, Moments
from baselines.speed.peers import (
    ALONE,
    MPE2,
    OURS,
    PEERS,
    VECTOR,
    VMAS,
    Peer,
    Simulated,
    pythons_of,
)
from baselines.speed.worker import PeerError, Worker
from tlf_env import BatchPlant
from tlf_env.common.presets import read_preset_or_file, yaml_text
from tlf_env.engine.arrays import make_arrays, padded
from tlf_env.engine.formation import reference_table
from tlf_env.envs.vector import FormationVectorEnv
from tlf_env.task.actions import REFERENCE

sys.path.append(str(Path(__file__).resolve().parents[1] / "docs/figures"))
make_speed = importlib.import_module("make_speed")  # a script, in no package

KEYS = ("env", "robots", "formations", "threads")


@pytest.fixture(scope="module")
def measured():
    return speed.measure(3, 2, formations=(1, 3), threads=(1, 2), parts=False)


def test_every_environment_is_measured_and_compared(measured):
    found = {tuple(row[key] for key in KEYS): row for row in measured["results"]}
    for robots in speed.ROBOTS:
        assert (ALONE, robots, 1, 1) in found
        for place in ((1, 1), (3, 1), (3, 2)):
            assert (VECTOR, robots, *place) in found
    for row in found.values():
        assert 0 < row["min"] <= row["env_steps_per_s"] <= row["max"]
        assert row["agent_steps_per_s"] == pytest.approx(
            row["env_steps_per_s"] * row["robots"], abs=1.0
        )
    assert [row["robots"] for row in measured["scaling"]] == list(speed.SCALING)
    assert measured["memory_per_formation_bytes"]["3"] > 1000
    json.dumps(measured, allow_nan=False)


@pytest.mark.parametrize(("package", "name"), [("mpe2", MPE2), ("vmas", VMAS)])
def test_peers_are_measured_where_they_are_installed(measured, package, name):
    pytest.importorskip(package)
    assert any(row["env"] == name for row in measured["results"])
    ratios = [row for row in measured["ratios"] if row["to"] == name]
    assert ratios
    assert all(0 < row["min"] <= row["ratio"] <= row["max"] for row in ratios)


def test_without_peers_and_batches_only_our_own_formations_are_timed():
    found = speed.measure(2, 1, formations=(), peers=False, parts=False)
    assert {row["env"] for row in found["results"]} == {ALONE, "tlf_env/wide-circle-v0"}
    assert found["ratios"] == []


def test_special_scenarios_are_timed_beside_the_usual_one(monkeypatch):
    """Those of few fixes and of sliding robots, and they are compared with the peers, too."""
    monkeypatch.setattr(environments, "SPECIAL_FORMATIONS", 3)
    monkeypatch.setattr(speed, "SPECIAL_FORMATIONS", 3)
    found = speed.measure(2, 1, formations=(3,), threads=(1,), parts=False)
    timed = {row["env"] for row in found["results"]}
    assert timed >= {f"{VECTOR}, fixes at 100 Hz", f"{VECTOR}, combined-hard"}
    if MPE2 in timed:
        compared = {row["env"] for row in found["ratios"] if row["to"] == MPE2}
        assert compared == {ALONE, VECTOR, *environments.SPECIAL}
    usual = BatchPlant("infinity", 1)
    for fields in environments.SPECIAL.values():
        special = BatchPlant("infinity", 1, **fields)
        assert (special.scenario.disturbance, special.precision) != (
            usual.scenario.disturbance,
            usual.precision,
        )


@pytest.mark.parametrize(
    "wrong", [{"steps": 0}, {"repeats": 0}, {"formations": (0,)}, {"threads": (1, 0)}]
)
def test_numbers_below_one_are_refused(wrong):
    with pytest.raises(ValueError, match="at least 1"):
        speed.measure(**{"steps": 1, "repeats": 1, **wrong})


@pytest.fixture(scope="module")
def moments():
    return Moments(3, kept=10)


def test_formations_are_put_where_the_recorded_ones_stood(moments):
    count = len(moments.lanes)
    plant = BatchPlant("infinity", 3 * count, robots=3, end_on=(), **DRIVEN)
    plant.reset(seed=0)
    moments.spread(plant)
    assert plant.step_counts.tolist() == np.repeat([1000, 1100, 1200], count).tolist()
    assert np.array_equal(plant.seeds, np.tile(moments.lanes, 3))
    for number, infos in enumerate(np.split(plant.infos, 3)):
        recorded = moments.arrays[number]
        assert np.array_equal(infos, recorded.infos[moments.lanes])
        here = plant.arrays.rows("motion")[:, :, number * count : (number + 1) * count]
        assert np.array_equal(here, recorded.rows("motion")[:, :, moments.lanes])


def test_recorded_actions_go_on_where_the_reference_went(moments):
    runs = [BatchPlant("infinity", 100, robots=3, end_on=(), **DRIVEN) for _ in range(2)]
    for plant in runs:
        plant.reset(seed=0)
        moments.spread(plant)
    runs[0].arrays.kinds[:] = REFERENCE
    for k in range(10):
        for plant in runs:
            plant.step(moments.actions_of(100, k))
    assert np.array_equal(runs[0].observations, runs[1].observations)


def test_the_parts_of_a_step_are_measured(monkeypatch):
    monkeypatch.setattr(parts, "PARTS_FORMATIONS", 4)
    found = parts.part_times(3, 4, 1)["us_per_formation_step"]
    assert set(found) == {
        "plant",
        "onboard",
        "actions",
        "radio",
        "observation_reward_info",
        "api",
    }
    assert found["onboard"] > 0


@pytest.mark.parametrize("lanes", [1, 63, 64, 100, 1000, 1024, 8192])
def test_rows_of_many_lanes_are_an_odd_number_of_cache_lines_long(lanes):
    columns = padded(lanes)
    assert lanes <= columns <= lanes + 15
    assert lanes < 64 or (columns * 8 / 64) % 2 == 1
    scenario = BatchPlant("infinity", 1).scenario
    arrays = make_arrays([scenario], reference_table(scenario), min(lanes, 100))
    assert arrays.rows("motion").shape[2] == padded(min(lanes, 100))


def resident_bytes() -> int:
    fields = Path("/proc/self/statm").read_text().split()
    return int(fields[1]) * os.sysconf("SC_PAGE_SIZE")


@pytest.mark.slow
@pytest.mark.skipif(
    not Path("/proc/self/statm").exists(),
    reason="only Linux gives the memory of a process in /proc/self/statm",
)
def test_memory_stays_while_a_million_steps_with_resets_are_taken():
    formations, steps = 500, 2000
    env = FormationVectorEnv("infinity", formations, horizon_s=2.0, autoreset_mode="SameStep")
    env.reset(seed=0)
    generator = np.random.default_rng(0)
    begun = 0
    for k in range(steps):
        env.step(generator.uniform(-0.3, 0.3, (formations, 2)))
        if k == steps // 10:
            begun = resident_bytes()
    assert env.plant.episodes.min() >= 10
    assert resident_bytes() - begun < 4e6


# --- peers in processes of their own

FAKE = """
import os, sys

print("a greeting that is no answer", flush=True)
os.system("echo another one")
held = []

class Drive:
    compile_s = 1.5
    def __init__(self, robots, formations, threads, at_once):
        held.append(bytearray(os.urandom(1000)) * (20 * formations))
        self.words = robots, formations, threads, at_once
    def __call__(self, steps):
        return 0.001 * steps

def make(*words):
    return Drive(*words)

def cores(robots, formations, threads, at_once):
    return lambda steps: len(os.sched_getaffinity(0))

def flags(robots, formations, threads, at_once):
    return lambda steps: os.environ.get("XLA_FLAGS", "") + os.environ["OMP_NUM_THREADS"]

def ours(robots, formations, threads, at_once):
    return lambda steps: sorted({name.partition(".")[0] for name in sys.modules} & {
        "tlf_env", "numba", "numpy", "typer"})

def words(robots, formations, threads, at_once):
    return lambda steps: [robots, formations, threads, at_once, steps]

def refuse(robots, formations, threads, at_once):
    raise ValueError("two\\nlines")

def die(robots, formations, threads, at_once):
    os._exit(3)
"""
NOTHING = Simulated(model="", step="", substeps="", sensors="", contacts="", controllers="")


@pytest.fixture
def fake(tmp_path, monkeypatch):
    """A maker of peers whose functions are in FAKE."""
    (tmp_path / "fake_peer.py").write_text(FAKE)
    inherited = os.environ.get("PYTHONPATH")
    folders = [str(tmp_path), *([inherited] if inherited else [])]
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(folders))
    monkeypatch.syspath_prepend(tmp_path)  # the package is looked for here, too

    def make(function="make", **fields):
        about = {
            "name": f"fake/{function}",
            "package": "fake_peer",
            "install": "fake",
            "factory": f"fake_peer:{function}",
            "packages": ("numpy", "fake-peer"),
        }
        return Peer(simulated=NOTHING, **{**about, **fields})

    return make


def test_a_process_makes_and_steps_what_it_is_asked_for(fake):
    with Worker(fake(), 3) as worker:
        worker.make(7, 5)
        assert worker.drive(200, 7) == pytest.approx(0.2)
        assert worker.compile_s == {7: 1.5}
        assert worker.versions == {"numpy": np.__version__}  # it has no version of fake-peer
    assert worker.process.poll() == 0
    with Worker(fake("words"), 3, 2) as worker:
        worker.make(7, 5)
        assert worker.drive(11, 7) == [3, 7, 2, 5, 11]


@pytest.mark.skipif(not hasattr(os, "sched_setaffinity"), reason="only Linux keeps to some cores")
def test_a_process_has_as_many_cores_as_it_has_threads(fake):
    with Worker(fake("cores"), 3, 1) as worker:
        worker.make(1, 1)
        assert worker.drive(1, 1) == 1
    many = min(2, len(os.sched_getaffinity(0)))
    with Worker(fake("cores"), 3, 2) as worker:
        worker.make(1, 1)
        assert worker.drive(1, 1) == many


@pytest.mark.parametrize("threads", [1, 2])
def test_libraries_of_a_process_are_given_its_threads(fake, threads, monkeypatch):
    monkeypatch.delenv("XLA_FLAGS", raising=False)
    with Worker(fake("flags"), 3, threads) as worker:
        worker.make(1, 1)
        one = served.ONE_THREAD_OF_XLA if threads == 1 else ""
        assert worker.drive(1, 1) == f"{one}{threads}"


def test_the_other_python_imports_none_of_our_libraries(fake):
    with Worker(fake("ours"), 3) as worker:
        worker.make(1, 1)
        assert worker.drive(1, 1) == []


def test_what_is_wrong_with_a_peer_is_said_in_one_line(fake):
    with pytest.raises(PeerError, match="fake/make: ModuleNotFoundError: No module named 'absent'"):
        Worker(dataclasses.replace(fake(), factory="absent:make"), 3)
    line = r"^fake/refuse: ValueError: two lines$"
    with Worker(fake("refuse"), 3) as worker, pytest.raises(PeerError, match=line):
        worker.make(1, 1)
    with Worker(fake("die"), 3) as worker:
        for _ in range(2):
            with pytest.raises(PeerError, match="its process has ended"):
                worker.make(1, 1)


@pytest.fixture
def only(monkeypatch):
    """Let some peers, and none of ours in a process of its own, be all that are measured."""

    def use(*peers):
        table = {one.name: one for one in peers}
        for module in (crew, footprint, speed):
            monkeypatch.setattr(module, "PEERS", table)
        monkeypatch.setattr(footprint, "OURS", {})
        monkeypatch.setattr(speed, "SCALING", ())
        monkeypatch.setattr(speed, "ROBOTS", (3,))
        monkeypatch.setattr(speed, "mpe2_environment", lambda robots: None)
        monkeypatch.setattr(speed, "vmas_environments", lambda formations, threads: [])

    return use


def test_peers_of_many_formations_and_of_one_are_timed_and_compared(fake, only):
    many, one = fake(), fake("make", name="fake/one", many=False, robots=(3, 5))
    single = fake("make", name="fake/robot", robots=(1,))
    only(many, one, single)
    found = speed.measure(100, 2, formations=(1, 4), threads=(1, 2), parts=False)
    rows = {tuple(row[key] for key in KEYS): row for row in found["results"]}
    for count, threads in ((1, 1), (4, 1), (4, 2)):
        row = rows["fake/make", 3, count, threads]  # a step takes 1 ms
        assert row["env_steps_per_s"] == pytest.approx(1000 * count)
        assert row["agent_steps_per_s"] == pytest.approx(3000 * count)
        assert rows["fake/robot", 1, count, threads]["agent_steps_per_s"] == pytest.approx(
            1000 * count
        )
    assert ("fake/make", 3, 1, 2) not in rows
    assert {key for key in rows if key[0] == "fake/one"} == {
        ("fake/one", 3, 1, 1),
        ("fake/one", 5, 1, 1),
    }
    for row in found["ratios"]:
        ours = rows[tuple(row[key] for key in KEYS)]["agent_steps_per_s"]
        theirs = {
            "fake/make": 3000 * row["formations"],
            "fake/one": 3000,
            "fake/robot": 1000 * row["formations"],
        }[row["to"]]
        assert row["min"] <= row["ratio"] <= row["max"]
        assert row["ratio"] == pytest.approx(ours / theirs, rel=0.5)
    places = {(row["env"], row["to"], row["formations"], row["threads"]) for row in found["ratios"]}
    assert (ALONE, "fake/one", 1, 1) in places
    assert (ALONE, "fake/make", 1, 1) not in places
    assert (VECTOR, "fake/robot", 4, 2) in places
    assert (VECTOR, "fake/one", 4, 2) in places
    assert {(row["env"], row["formations"], row["compile_s"]) for row in found["compiled"]} >= {
        ("fake/make", 4, 1.5),
        ("fake/robot", 1, 1.5),
    }
    assert found["left_out"] == {}
    json.dumps(found, allow_nan=False)


def test_peers_that_cannot_be_had_are_left_out_with_a_line(fake, only):
    missing = fake("make", name="fake/missing", package="absent_package")
    broken, mute = fake("refuse"), fake("die")
    only(missing, broken, mute)
    found = speed.measure(10, 1, formations=(2,), threads=(1,), parts=False, memory=(1, 2), start=2)
    assert found["left_out"]["fake/missing"] == "fake/missing is left out: pip install fake"
    assert found["left_out"]["fake/refuse"].startswith("fake/refuse: ValueError: two lines")
    assert found["left_out"]["fake/die"].startswith("fake/die: its process has ended")
    assert {row["env"] for row in found["results"]} == {ALONE, VECTOR}
    assert found["memory"] == found["starts"] == []


def test_a_peer_of_another_python_need_not_be_installed_here(fake, only, tmp_path):
    peer = fake("make", package="elsewhere")
    only(peer)
    python = tmp_path / "python"
    python.write_text(f'#!/bin/sh\nexec {sys.executable} "$@"\n')
    python.chmod(0o755)
    with crew.Crew({"elsewhere": str(python)}) as members:
        (timed,) = members.environments((2,), (1,), 100)
        assert timed.drive(50) == pytest.approx(0.05)
        assert members.workers[0].process.args[0] == str(python)
    assert members.workers[0].process.poll() is not None


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["jaxmarl"], "must be NAME=PYTHON"),
        (["jaxmal=/bin/sh"], "did you mean 'jaxmarl'"),
        (["vmas=/bin/sh"], "not one of gym-pybullet-drones, jaxmarl, kheperax"),
        (["jaxmarl=/no/such/python"], "there is no Python '/no/such/python'"),
    ],
)
def test_wrong_pythons_are_refused(options, message):
    with pytest.raises(ValueError, match=message):
        pythons_of(options)


def test_every_peer_says_what_it_simulates_and_how_it_is_installed():
    for peer in {**PEERS, **OURS}.values():
        assert peer.install
        assert all(dataclasses.astuple(peer.simulated))
        module, _, function = peer.factory.partition(":")
        tree = ast.parse(Path(importlib.util.find_spec(module).origin).read_text())
        assert function in {one.name for one in tree.body if isinstance(one, ast.FunctionDef)}


@pytest.mark.parametrize("name", [name for name, peer in PEERS.items() if peer.served])
def test_served_peers_step_where_they_are_installed(name):
    peer = PEERS[name]
    pytest.importorskip(peer.package)
    count = 3 if peer.many else 1
    with Worker(peer, peer.robots[0]) as worker:
        worker.make(count, 4)
        assert 0 < worker.drive(5, count) < 60
        assert set(worker.versions) == set(peer.packages)
        assert (worker.compile_s[count] > 0) == ("jax" in peer.packages)


def test_a_scan_takes_the_steps_that_a_loop_takes():
    """And it computes the observations and rewards, whose sum it carries."""
    jaxmarl, jax = pytest.importorskip("jaxmarl"), pytest.importorskip("jax")
    from baselines.speed.jax_peers import spread_drive

    drive = spread_drive(3, 2, 1, 4)
    (state, _), (keys, actions) = drive.carry, drive.inputs
    env = jaxmarl.make("MPE_simple_spread_v3", num_agents=3, action_type="Continuous")
    step = jax.jit(env.step_env)
    total = 0.0
    ends = []
    for lane in range(2):
        one = jax.tree_util.tree_map(lambda x, lane=lane: x[lane], state)
        for k in range(4):
            action = {agent: one_of[k, lane] for agent, one_of in actions.items()}
            observations, one, rewards, _, _ = step(keys[k, lane], one, action)
            total += sum(float(x.sum()) for x in (*observations.values(), *rewards.values()))
        ends.append(np.asarray(one.p_pos))
    assert drive(4) > 0
    state, carried = drive.run((state, 0.0 * drive.carry[1]), drive.inputs)
    assert np.allclose(state.p_pos, ends, atol=1e-5)
    assert float(carried) == pytest.approx(total, rel=1e-4)


# --- memory, starts and a training


@pytest.mark.skipif(
    not Path("/proc/self/status").exists(), reason="only Linux tells the memory of a process"
)
def test_memory_grows_by_what_a_formation_holds(fake, only):
    """The fake holds 20 kB for each formation."""
    only(fake(), fake("make", name="fake/one", many=False))
    done = []
    with crew.Crew({}) as members:
        rows = footprint.memory_rows(members, True, (100, 2100), lambda: done.append(1))
    assert [(row["env"], row["robots"], row["formations"]) for row in rows] == [
        ("fake/make", 3, [100, 2100])
    ]
    for kind in ("resident", "peak"):
        assert rows[0][kind] == pytest.approx(20_000, rel=0.05)
    assert len(done) == 1


def test_a_start_is_measured_from_the_start_of_python_on(fake, only):
    only(fake(), fake("make", name="fake/one", many=False))
    with crew.Crew({}) as members:
        rows = footprint.start_rows(members, True, 5, lambda: None)
    assert [(row["env"], row["formations"], row["cache"]) for row in rows] == [
        ("fake/make", 5, None),
        ("fake/one", 1, None),
    ]
    for row in rows:
        assert 0 <= row["import_s"] <= row["first_step_s"] < 10


@pytest.mark.parametrize("name", OURS)
def test_ours_start_and_step_in_a_process_of_their_own(name):
    row = footprint.start_row(OURS[name], sys.executable, 2 if OURS[name].many else 1, None)
    assert 0.2 < row["import_s"] < row["first_step_s"]


@pytest.mark.slow
def test_a_start_with_an_empty_cache_compiles_and_the_next_one_does_not(monkeypatch):
    monkeypatch.setattr(footprint, "OURS", {VECTOR: OURS[VECTOR]})
    with crew.Crew({}) as members:
        empty, full = footprint.start_rows(members, False, 2, lambda: None)
    assert (empty["cache"], full["cache"]) == ("empty", "full")
    assert empty["first_step_s"] > full["first_step_s"] + 10


def curve(*evaluations):
    return {
        "evaluations": [
            {"robot_steps": steps, "score_mm": score, "failed": failed}
            for steps, score, failed, _ in evaluations
        ],
        "evaluated_at_s": [seconds for *_, seconds in evaluations],
        "processor_time_s": 70.0,
        "wall_time_s": 50.0,
    }


def test_a_policy_is_trained_once_it_is_precise_and_loses_no_run():
    course = curve(
        (0, 1000.0, 10, 5.0), (10, 0.9, 1, 20.0), (20, 1.0, 0, 33.34), (30, 0.5, 0, 60.0)
    )
    row = trained.row_of("scratch", 1.0, course)
    assert (row["trained_s"], row["robot_steps"]) == (33.3, 20)
    assert (row["whole_s"], row["whole_wall_s"], row["last_mm"]) == (70.0, 50.0, 0.5)
    never = trained.row_of("scratch", 0.4, course)
    assert never["trained_s"] is never["robot_steps"] is None


def test_a_training_without_its_libraries_is_refused(monkeypatch):
    monkeypatch.setattr(trained, "find_spec", lambda name: None)
    with pytest.raises(
        ValueError, match=r"--training needs stable_baselines3 \(.*tlf-env\[train\]"
    ):
        trained.trained_row()


def test_a_training_is_timed(tmp_path):
    pytest.importorskip("stable_baselines3")
    config = read_preset_or_file("training", "scratch")
    config |= {"robot_steps": 384, "formations": 2, "checkpoint_every": 384}
    config["settings"] |= {"n_steps": 64, "batch_size": 64, "n_epochs": 1}
    config["evaluation"] |= {"every": 384, "seeds": [10000, 10001], "horizon_s": 2.0}
    config.pop("search")
    file = tmp_path / "short.yaml"
    file.write_text(yaml_text(config))
    row = trained.trained_row(str(file), good_mm=1e4)
    assert row["whole_robot_steps"] >= 384
    assert 0 <= row["trained_s"] <= row["whole_s"]
    assert set(row["versions"]) == set(trained.LEARNERS)
    with pytest.raises(OSError, match="tlf train no-such"):
        trained.trained_row("no-such")


# --- the command, and the page


def test_the_command_measures_more_only_if_it_is_asked_to(monkeypatch, capsys, tmp_path):
    given = []

    def measure(*words, **named):
        given.append(named)
        return {
            "results": [],
            "ratios": [],
            "left_out": {"fake": "fake is left out: pip install x"},
        }

    monkeypatch.setattr(speed, "measure", measure)
    monkeypatch.setattr("baselines.commands.compile.compile_before_first_run", lambda: None)
    for words in ([], ["--memory", "--cold", "--training", "--peer-python", "jaxmarl=/bin/sh"]):
        assert cli.app(["speed", *words], standalone_mode=False) is None
    kinds = ("memory", "start", "training", "peer_pythons")
    assert [given[0][kind] for kind in kinds] == [None, None, None, {}]
    assert [given[1][kind] for kind in kinds] == [
        footprint.MEMORY_FORMATIONS,
        footprint.START_FORMATIONS,
        trained.TRAINING,
        {"jaxmarl": "/bin/sh"},
    ]
    assert "fake is left out: pip install x" in capsys.readouterr().err


def test_wrong_numbers_for_the_memory_are_refused():
    with pytest.raises(ValueError, match=r"memory \(2, 2\) must be two growing numbers"):
        speed.measure(1, 1, memory=(2, 2))


def test_the_page_holds_what_was_measured():
    result = json.loads((make_speed.DOCS / "performance.json").read_text(encoding="utf-8"))
    page = (make_speed.DOCS / "performance.md").read_text(encoding="utf-8")
    assert make_speed.written(page, result) == page
    for name in PEERS:
        assert f"| `{name}` |" in make_speed.simulated(result)
    for part, option in make_speed.OPTIONAL.items():
        without = {key: one for key, one in result.items() if key != part}
        hint = f"Not measured in this run (`tlf speed {option}`)."
        assert hint in make_speed.written(page, without)
    with pytest.raises(ValueError, match="one line '<!-- starts -->'"):
        make_speed.written(page.replace("<!-- starts -->", ""), result)


SHORT_ROWS = {
    "memory": [
        {"env": VECTOR, "robots": 3, "formations": [8, 16], "resident": 77049, "peak": None},
        {"env": VMAS, "robots": 3, "formations": [8, 16], "resident": 951, "peak": 1049},
    ],
    "starts": [
        {"env": ALONE, "formations": 1, "import_s": 0.81, "first_step_s": 40.24, "cache": "empty"},
        {"env": ALONE, "formations": 1, "import_s": 0.81, "first_step_s": 3.04, "cache": "full"},
        {"env": VMAS, "formations": 1024, "import_s": 2.0, "first_step_s": 3.0, "cache": None},
    ],
}


def test_memory_and_starts_are_tables_of_the_page():
    assert make_speed.footprint(SHORT_ROWS).splitlines() == [
        "| 8 to 16 formations | robots | kB after the steps | kB at most |",
        "|---|---:|---:|---:|",
        f"| `{VECTOR}` | 3 | 77.0 |  |",
        f"| `{VMAS}` | 3 | 1.0 | 1.0 |",
    ]
    assert make_speed.starts(SHORT_ROWS).splitlines()[2:] == [
        f"| `{ALONE}`, nothing compiled | 1 | 0.8 | 40.2 |",
        f"| `{ALONE}`, all compiled before | 1 | 0.8 | 3.0 |",
        f"| `{VMAS}` | 1024 | 2.0 | 3.0 |",
    ]


def test_the_page_says_whether_a_training_got_there():
    course = curve((0, 1000.0, 10, 5.0), (1_000_000, 0.9, 0, 200.4))
    text = make_speed.training({"training": trained.row_of("scratch", 1.0, course)})
    assert "reached after 200 s, 1 000 000 robot steps" in text
    never = make_speed.training({"training": trained.row_of("scratch", 0.1, course)})
    assert "a score of at most 0.1 mm not reached;" in never
