"""The benchmark: resumed after any interruption, the same table however it is run, clear refusals."""

import json
import os
import random
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("arch")

from baselines.benchmark import bench
from baselines.benchmark.aggregate import leaderboard, write_leaderboard
from baselines.benchmark.bench import run_bench
from baselines.benchmark.plan import Episode, Plan, parse_pairs, parse_seeds, parse_sweep, read_plan
from baselines.benchmark.results import RUNS_FILE
from baselines.cli import main
from baselines.runs.nested import value_at, with_value
from baselines.runs.provenance import physics_digest, simulation_digest
from baselines.runs.run import run_policy
from tlf_env.task.observation import sensor_entries
from tlf_env.task.scenario import load_scenario

SHORT = (("horizon_s", 2.0),)
PLAN = Plan(
    policies=("reference:consistent", "pure_pursuit"),
    tasks=("infinity",),
    disturbances=("nominal", "start"),
    seeds=(20_000, 20_003),
    overrides=SHORT,
)
COMMAND = [sys.executable, "-m", "baselines", "bench"]
ARGUMENTS = [
    *("--policies", "reference:consistent,pure_pursuit"),
    *("--tasks", "infinity"),
    *("--disturbances", "nominal,start"),
    *("--seeds", "20000:20030"),
    *("--horizon-s", "5"),
    "--no-figures",
]
RUNS_IN_ALL = 2 * 2 * 30


def lines_in(folder: Path) -> int:
    path = folder / RUNS_FILE
    return path.read_bytes().count(b"\n") if path.exists() else 0


def started(folder: Path, processes: int) -> subprocess.Popen:
    """`tlf bench` in a process group of its own."""
    places = ["--out", str(folder), "--processes", str(processes)]
    return subprocess.Popen(
        [*COMMAND, *ARGUMENTS, *places],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        start_new_session=True,
    )


def wait_for(condition, timeout_s: float = 120) -> None:
    end = time.monotonic() + timeout_s
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.005)


def group_is_gone(group: int) -> bool:
    try:
        os.killpg(group, 0)
    except ProcessLookupError:
        return True
    return False


def end_group(group: int) -> None:
    if not group_is_gone(group):
        os.killpg(group, signal.SIGKILL)


def tables(folder: Path) -> tuple[dict, str]:
    board = json.loads((folder / "leaderboard.json").read_text())
    del board["plan"]["git_revision"], board["plan"]["versions"]
    return board, (folder / "leaderboard.md").read_text()


@pytest.mark.slow
def test_a_bench_that_is_killed_three_times_ends_with_the_same_tables(tmp_path):
    whole, killed = tmp_path / "whole", tmp_path / "killed"
    assert started(whole, 1).wait(300) == 0
    rng = random.Random()
    for number in range(3):
        process = started(killed, 1 + number % 2)
        try:
            enough = lines_in(killed) + rng.randrange(1, RUNS_IN_ALL // 5)
            wait_for(lambda enough=enough: lines_in(killed) >= enough)
            process.send_signal(signal.SIGKILL)
            process.wait()
            wait_for(lambda group=process.pid: group_is_gone(group), 30)  # no worker is left behind
        finally:
            end_group(process.pid)
    assert lines_in(killed) < RUNS_IN_ALL
    assert started(killed, 2).wait(300) == 0
    assert lines_in(killed) == RUNS_IN_ALL
    assert tables(killed) == tables(whole)


def written(path):
    """What changes when a file is written, and not when it is read."""
    status = path.stat()
    return status.st_ino, status.st_size, status.st_mtime_ns


def test_what_is_finished_is_not_run_again(tmp_path, monkeypatch):
    real, run = bench.run_episode, []

    def breaks_at_the_fifth(plan, episode):
        run.append(episode)
        if len(run) == 5:
            raise RuntimeError
        return real(plan, episode)

    monkeypatch.setattr(bench, "run_episode", breaks_at_the_fifth)
    with pytest.raises(RuntimeError):
        run_bench(PLAN, tmp_path)
    assert lines_in(tmp_path) == 4
    results = run_bench(PLAN, tmp_path)
    assert run == [*PLAN.episodes()[:5], *PLAN.episodes()[4:]]
    assert not results.missing()
    before = written(tmp_path / RUNS_FILE)
    assert run_bench(PLAN, tmp_path).ordered() == results.ordered()
    assert written(tmp_path / RUNS_FILE) == before


def test_a_torn_last_line_is_cut_and_run_again(tmp_path):
    whole = run_bench(PLAN, tmp_path).ordered()
    path = tmp_path / RUNS_FILE
    path.write_bytes(path.read_bytes()[:-30])
    assert run_bench(PLAN, tmp_path).ordered() == whole
    assert lines_in(tmp_path) == len(PLAN.episodes())


def test_a_damaged_line_is_reported(tmp_path):
    run_bench(PLAN, tmp_path)
    path = tmp_path / RUNS_FILE
    path.write_bytes(b"{}\n" + path.read_bytes())
    with pytest.raises(ValueError, match=r"runs\.jsonl, line 1 is damaged"):
        run_bench(PLAN, tmp_path)


def test_the_table_does_not_depend_on_the_number_of_processes(tmp_path):
    one, two = (run_bench(PLAN, tmp_path / f"{n}", processes=n) for n in (1, 2))
    assert one.ordered() == two.ordered()
    for results in (one, two):
        write_leaderboard(results, results.folder, "tlf bench")
    names = ("leaderboard.md", "leaderboard.json")
    first, second = ([(r.folder / name).read_bytes() for name in names] for r in (one, two))
    assert first == second


@pytest.mark.slow
def test_the_table_is_the_same_from_a_ray_cluster(tmp_path):
    pytest.importorskip("ray")
    from ray.cluster_utils import Cluster

    cluster = Cluster(
        initialize_head=True, head_node_args={"num_cpus": 2, "include_dashboard": False}
    )
    try:
        far = run_bench(PLAN, tmp_path / "ray", ray_address=cluster.address)
    finally:
        cluster.shutdown()
    assert far.ordered() == run_bench(PLAN, tmp_path / "here").ordered()


class Circling:
    """Drives in a circle and keeps its observations."""

    def __init__(self, turn):
        self.turn, self.seen = turn, []

    def predict(self, observation, state=None, episode_start=None, deterministic=True):
        self.seen.append(observation)
        return np.full((len(observation), 2), (0.1, self.turn)), state


def test_policies_meet_the_same_starts_and_noise():
    scenario = load_scenario(
        disturbance="start", observation="sensor", dtype="float64", horizon_s=2.0
    )
    entries = sensor_entries(scenario.substeps)
    place = list(entries).index(f"fix_x_{scenario.substeps - 1}")
    scale = entries[f"fix_x_{scenario.substeps - 1}"].scale
    starts, paths, noise = [], [], []
    for turn in (-0.1, 0.1):
        policy = Circling(turn)
        x = run_policy(scenario, policy, 20_000)["x_mm"]
        fixes = scale * np.array(policy.seen)[1:, :, place]
        starts.append(x[0])
        paths.append(x)
        noise.append(fixes - (x[1:-1] - x[0]))
    np.testing.assert_array_equal(*starts)
    np.testing.assert_allclose(*noise, atol=1e-9)
    assert 0.3 < np.std(noise[0]) < 0.6
    assert np.abs(paths[0] - paths[1]).max() > 10


@pytest.mark.parametrize(
    "change",
    [
        {"seeds": (20_000, 20_004)},
        {"policies": ("reference:consistent",)},
        {"level": 0.5},
        {"overrides": (("horizon_s", 3.0),)},
    ],
)
def test_another_plan_in_the_same_folder_is_refused(tmp_path, change):
    run_bench(PLAN, tmp_path)
    before = {path: path.read_bytes() for path in tmp_path.iterdir()}
    with pytest.raises(
        ValueError, match=r"holds results with a different 'plan' in plan\.json: plan\."
    ):
        run_bench(Plan(**(vars(PLAN) | change)), tmp_path)
    assert {path: path.read_bytes() for path in tmp_path.iterdir()} == before


def test_a_policy_whose_file_changed_is_refused(tmp_path, monkeypatch):
    (tmp_path / "changing.py").write_text(
        "import numpy as np\n"
        "class Still:\n"
        "    def predict(self, seen, state=None, episode_start=None, deterministic=True):\n"
        "        return np.zeros((len(seen), 2)), state\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    plan = Plan(
        ("changing:Still",), ("infinity",), ("nominal",), (0, 1), overrides=SHORT, trust=True
    )
    run_bench(plan, tmp_path / "out")
    with (tmp_path / "changing.py").open("a") as file:
        file.write("# a comment\n")
    run_bench(plan, tmp_path / "out")
    with (tmp_path / "changing.py").open("a") as file:
        file.write("changed = True\n")
    with pytest.raises(ValueError, match="a different 'policies'"):
        run_bench(plan, tmp_path / "out")


def test_a_changed_simulation_is_refused_and_every_line_names_its_physics(tmp_path, monkeypatch):
    lines = run_bench(PLAN, tmp_path).ordered()
    plan = json.loads((tmp_path / "plan.json").read_text())
    assert {line["physics"] for line in lines} == {plan["physics"]} == {physics_digest()}
    assert plan["simulation"] == simulation_digest()
    monkeypatch.setattr("baselines.benchmark.results.simulation_digest", lambda: "0" * 12)
    with pytest.raises(ValueError, match="a different 'simulation'"):
        run_bench(PLAN, tmp_path)


def test_a_sweep_runs_every_value():
    path, values = parse_sweep("slip.delta_1_mm_s=0:40:5")
    assert (path, values) == ("slip.delta_1_mm_s", (0, 10, 20, 30, 40))
    plan = Plan(**(vars(PLAN) | {"sweep": path, "sweep_values": values, "seeds": (0, 1)}))
    assert [episode.sweep for episode in plan.episodes()[:10:2]] == list(values)
    for value in values:
        scenario = plan.scenario(Episode("", "infinity", "start", 1.0, value, 0))
        assert scenario.disturbance.slip.delta_1_mm_s.value == value
        assert scenario.disturbance.start.position_std_mm.value > 0
    level = Plan(**(vars(plan) | {"sweep": "level"}))
    assert level.scenario(Episode("", "infinity", "ice", 1.0, 0.5, 0)).disturbance.level == 0.5


def test_a_sweep_of_a_field_of_the_scenario_keeps_the_disturbance():
    path, values = parse_sweep("robots=2,3,5")
    assert (path, values) == ("robots", (2, 3, 5))
    plan = Plan(**(vars(PLAN) | {"sweep": path, "sweep_values": values}))
    episode = Episode("", "infinity", "start", 1.0, 5, 0)
    same = load_scenario("infinity", disturbance="start", robots=5, horizon_s=2.0)
    assert plan.scenario(episode) == same
    nested = Plan(**(vars(plan) | {"sweep": "robot.mass_kg"}))
    found = nested.scenario(episode._replace(sweep=1.5))
    assert found.robot.mass_kg == 1.5
    assert found.robot.wheel_radius_mm == same.robot.wheel_radius_mm
    assert found.disturbance == same.disturbance
    with pytest.raises(ValueError, match=r"robots.*2\.5"):
        plan.scenario(episode._replace(sweep=2.5))


def test_a_logarithmic_sweep_has_equal_ratios():
    from baselines.benchmark.knobs import is_geometric

    _, values = parse_sweep("slip.delta_1_mm_s.frequency_hz=0.05:2:9:log")
    assert (values[0], values[-1]) == (0.05, 2.0)
    assert np.ptp(np.diff(np.log(values))) < 1e-4
    assert is_geometric(values)
    assert not is_geometric(parse_sweep("level=1:3:9")[1])
    assert not is_geometric(parse_sweep("level=0:3:9")[1])


def test_a_sweep_reports_the_breaking_points(tmp_path):
    plan = Plan(
        ("reference:consistent",), ("infinity",), ("nominal",), (0, 2), overrides=(("horizon_s", 20.0),),
        sweep="slip.delta_1_mm_s", sweep_values=(0.0, 2000.0),
    )  # fmt: skip
    board = leaderboard(run_bench(plan, tmp_path))
    assert [cell["sweep"] for cell in board["cells"]] == [0, 2000]
    (row,) = board["breaking_points"]
    assert row["loses_50_percent_at"] == 1000


def test_only_numbers_that_exist_can_be_swept():
    tree = {"a": {"b": 1}, "c": 2}
    assert with_value(tree, "a.b", 5) == {"a": {"b": 5}, "c": 2}
    assert value_at(tree, "a.b") == tree["a"]["b"] == 1
    for path, said in (
        ("x", "no 'x'; there are a, c"),
        ("a.x", "no 'x'"),
        ("c.d", "'c' is a value, not a group"),
    ):
        with pytest.raises(ValueError, match=said):
            with_value(tree, path, 5)


@pytest.mark.parametrize(
    "text", ["", "a", "a=1", "a=1:2", "a=1:2:1", "a=1:2:3:4", "=1:2:3", "a=x:2:3"]
)
def test_a_sweep_of_another_form_is_reported(text):
    with pytest.raises(ValueError, match="must be PATH=FIRST:LAST:COUNT"):
        parse_sweep(text)


@pytest.mark.parametrize("text", ["", "5", "5:5", "6:5", "-1:5", "a:b", "1:2:3"])
def test_seeds_of_another_form_are_reported(text):
    with pytest.raises(ValueError, match="must be FIRST:END"):
        parse_seeds(text)


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ("--policies no_such", "no_such"),
        ("--policies pure_pursuit,pure_pursuit", "each once"),
        ("--policies model.zip", "--trust"),
        ("--tasks no_such", "no_such"),
        ("--tasks infinity,no_such", "no_such"),
        ("--tasks sensor.yaml", "takes 'tracking' observations"),
        ("--disturbances no_such", "no_such"),
        ("--disturbances nominal,no_such", "no_such"),
        ("--sweep slip.no_such=0:1:2", "sweep: there is no 'no_such'"),
        ("--sweep no_such=0:1:2", "no_such"),
        ("--sweep tyre.friction_scale=1:-1:3", "friction_scale"),
        ("--disturbances nominal,ice --sweep level=0:3:4", "friction_scale"),
        ("--sweep slip.delta_1_mm_s=nan:1:2", "delta_1_mm_s"),
        ("--also infinity", "also 'infinity' must be TASK:DISTURBANCE"),
        ("--also no_such:ice", "no_such"),
        ("--also infinity:no_such", "no_such"),
        ("--plan crossed.yaml", "policies.limiters is None"),
        ("--plan wider.yaml", "policies.tasks is ['infinity']"),
        ("--seeds 5", "FIRST:END"),
        ("--seeds 0:99999999999999999999999", "seed"),
        ("--level -1", "level"),
        ("--horizon-s 0.03", "horizon_s"),
        ("--processes -1", "processes"),
        (
            "--plan no_such",
            "not one of board, controllers, crossing, crossing-moving-horizon, crossing-slow, ",
        ),
        ("--plan no_such.yaml", "no_such.yaml"),
        ("--plan trusting.yaml", "'trust'"),
        ("--plan nested.yaml", "seeds must be a text, a number or a list"),
        ("--plan wordy.yaml", "--horizon-s"),
    ],
)
def test_bad_input_is_one_line_and_writes_nothing(words, said, tmp_path, monkeypatch, capsys):
    (tmp_path / "sensor.yaml").write_text(
        "observation: sensor\ntrajectory: {type: circle, radius_mm: 800, speed_mm_s: 200}\n"
    )
    (tmp_path / "trusting.yaml").write_text("trust: true\n")
    (tmp_path / "nested.yaml").write_text("seeds: {first: 1}\n")
    crossed = "controllers: [kanayama], estimators: [ekf]"
    (tmp_path / "crossed.yaml").write_text(f"policies: {{{crossed}}}\n")
    (tmp_path / "wider.yaml").write_text(
        f"policies: {{{crossed}, limiters: [none], tasks: [infinity]}}\n"
    )
    (tmp_path / "wordy.yaml").write_text("horizon_s: long\n")
    monkeypatch.chdir(tmp_path)
    defaults = {"--policies": "pure_pursuit", "--tasks": "infinity", "--disturbances": "nominal"}
    for name, value in defaults.items():
        if name not in words:
            words += f" {name} {value}"
    monkeypatch.setattr(sys, "argv", ["tlf", "bench", *words.split(), "--out", "out"])
    with pytest.raises(SystemExit) as end:
        main()
    assert end.value.code == 2
    shown = capsys.readouterr().err
    assert "\n" not in shown.strip()
    assert said in shown
    assert not list((tmp_path / "out").glob("*"))


def test_an_option_takes_precedence_over_the_plan(tmp_path, monkeypatch):
    (tmp_path / "plan.yaml").write_text(
        "policies: [pure_pursuit, feedback_linearisation]\ntasks: infinity\n"
        'disturbances: nominal\nseeds: "3:4"\nhorizon_s: 2\n'
    )
    monkeypatch.chdir(tmp_path)
    words = "bench --plan plan.yaml --seeds 5:6 --processes 1 --no-figures --out out"
    monkeypatch.setattr(sys, "argv", ["tlf", *words.split()])
    main()
    plan = json.loads((tmp_path / "out/plan.json").read_text())["plan"]
    assert plan["policies"] == ["pure_pursuit", "feedback_linearisation"]
    assert (plan["seeds"], plan["overrides"]) == ([5, 6], [["horizon_s", 2.0]])


def test_a_bench_without_arch_is_refused_before_it_runs(tmp_path, monkeypatch):
    monkeypatch.setattr(bench, "find_spec", lambda name: None)
    with pytest.raises(ValueError, match=r"pip install 'tlf-env\[bench\]'"):
        run_bench(PLAN, tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_an_error_in_a_worker_is_not_swallowed(tmp_path, monkeypatch):
    (tmp_path / "breaking.py").write_text(
        "class Breaking:\n"
        "    def predict(self, seen, state=None, episode_start=None, deterministic=True):\n"
        "        raise ValueError('no idea')\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    plan = Plan(
        ("breaking:Breaking",), ("infinity",), ("nominal",), (0, 3), overrides=SHORT, trust=True
    )
    with pytest.raises(ValueError, match="no idea"):
        run_bench(plan, tmp_path / "out", processes=2)


def test_small_panels_share_a_column():
    pytest.importorskip("matplotlib")
    from baselines.benchmark.figures import _columns

    rows = {"a": 22, "b": 22, "c": 3, "d": 2, "e": 18}
    assert _columns(rows) == [["a"], ["b"], ["c", "d"], ["e"]]
    assert _columns({}) == []


def test_the_figures_are_drawn_from_what_the_table_holds(tmp_path):
    pytest.importorskip("matplotlib")
    from baselines.benchmark.figures import write_bench_figures
    from baselines.benchmark.knobs import knob_label

    board = write_leaderboard(run_bench(PLAN, tmp_path), tmp_path, "tlf bench")
    written = write_bench_figures(board, tmp_path)
    assert [path.name for path in written] == ["scores.png", "failures.png", "profiles.png"]
    swept = Plan(
        **(vars(PLAN) | {"sweep": "level", "sweep_values": (0.0, 1.0), "seeds": (0, 1)})
    )  # a single seed: no intervals
    board = leaderboard(run_bench(swept, tmp_path / "swept"))
    written = write_bench_figures(board, tmp_path / "swept")
    assert written[-1].name == "sweep.png"
    assert all(path.read_bytes().startswith(b"\x89PNG") for path in written)
    assert knob_label("slip.delta_1_mm_s") == "slip.delta_1 (mm/s)"
    assert knob_label("level") == "level"


def test_a_plan_crosses_parts_and_adds_pairs(tmp_path):
    from baselines.cli import PLAN_OPTIONS

    path = tmp_path / "plan.yaml"
    path.write_text(
        "policies: {controllers: [kanayama, 'reference:tuned'], estimators: [ekf], limiters: [none, body]}\n"
        "also: ['infinity:ice', 'circle:slip']\n"
    )
    options = read_plan(str(path), PLAN_OPTIONS)
    assert options["policies"] == (
        "kanayama+ekf+none,kanayama+ekf+body,reference:tuned+ekf+none,reference:tuned+ekf+body"
    )
    plan = Plan(
        ("kanayama",), ("infinity",), ("nominal", "ice"), (0, 2), also=parse_pairs(options["also"])
    )
    places = [("infinity", "nominal"), ("infinity", "ice"), ("circle", "slip")]
    assert list(plan.places) == places  # each once
    assert [(one.task, one.disturbance) for one in plan.episodes()] == 2 * places
