"""Entries of a competition: programs in processes of their own, and weights; errors in one line."""

import importlib.util
import json
import shutil
import sys
from pathlib import Path

import numpy as np
import pytest

from baselines.benchmark.bench import run_bench
from baselines.benchmark.lines import step_times
from baselines.benchmark.page import time_table
from baselines.benchmark.plan import Plan
from baselines.cli import main
from baselines.policies import entry_process
from baselines.policies.entries import AskedFields, hello, load_entry, step_statistics
from baselines.policies.entry_process import EntryProcess
from baselines.policies.learned import SHIPPED
from baselines.policies.registry import OVERRIDABLE, fit_policy, make_policy, policy_hash
from baselines.runs.run import run_policy
from tlf_env.common import pipes
from tlf_env.task.scenario import load_scenario

EXAMPLE = Path(__file__).resolve().parent.parent / "examples" / "entry"
NAME = f"entry:{EXAMPLE}"
SHORT = load_scenario("infinity", horizon_s=2.0, start_ramp_s=12.0)

# A program that answers every observation with the expression ANSWER, bytes.
PROGRAM = """
import json, struct, sys, time
import numpy as np
requests, answers = sys.stdin.buffer, sys.stdout.buffer
def receive():
    head = requests.read(4)
    if len(head) < 4: sys.exit()
    return requests.read(*struct.unpack("<I", head))
def send(message):
    answers.write(struct.pack("<I", len(message)) + message); answers.flush()
hello = json.loads(receive())
zeros = np.zeros((hello["robots"], 2), hello["dtype"])
HELLO
while True:
    observation = receive()
    send(ANSWER)
"""
WELCOME = "send(b'{\"protocol\": 1}')"


@pytest.fixture
def steering():
    """The example's law in this process, with the signature of SB3's ``predict``."""
    spec = importlib.util.spec_from_file_location("example_entry", EXAMPLE / "entry.py")
    module = importlib.util.module_from_spec(spec)
    stdout = sys.stdout
    spec.loader.exec_module(module)
    sys.stdout = stdout

    class Law:
        privileged = False

        def __init__(self, scenario):
            self.law = module.Steering(hello(scenario))

        def predict(self, observation, state=None, episode_start=None, deterministic=True):
            return self.law.act(observation).astype(observation.dtype), state

    return Law


def test_the_example_drives_as_it_does_without_a_process_of_its_own(steering):
    fitted = fit_policy(NAME, SHORT, trust=True)
    far = [run_policy(fitted.scenario, fitted.policy, 3) for _ in range(2)]
    near = run_policy(fitted.scenario, steering(fitted.scenario), 3)
    for column, values in near.columns.items():
        for record in far:  # the second time in another process, without a memory of the first
            np.testing.assert_array_equal(record[column], values, err_msg=column)
    assert max(metrics.position_rmse_mm for metrics in near.metrics()) < 15
    assert len(fitted.policy.step_times_s) == SHORT.horizon_steps
    assert fitted.overrides["estimator"] == "ekf-slip"


def test_the_first_message_tells_nothing_of_task_and_disturbance():
    one = hello(load_scenario("infinity", disturbance="slip"))
    assert one == hello(load_scenario("flower", robots=3, disturbance="ice", horizon_s=100.0))
    assert set(one) == {
        "protocol", "robots", "observation", "action", "dtype", "control_period_s", "time_gap_s",
        "horizon_steps", "robot_models",
    }  # fmt: skip
    sensor = hello(load_scenario("infinity", observation="sensor", action="torque"))
    assert [entry["unit"] for entry in sensor["action"]] == ["N·mm", "N·mm"]
    assert "fix_x_0" in [entry["name"] for entry in sensor["observation"]]


def test_a_benchmark_reports_the_time_per_step_on_both_plants(tmp_path):
    lines = {}
    for plant in ("pymunk", "batch"):
        overrides = (("horizon_s", 0.4), ("plant", plant))
        plan = Plan((NAME,), ("infinity",), ("nominal",), (0, 2), overrides=overrides, trust=True)
        lines[plant] = run_bench(plan, tmp_path / plant).ordered()
    for one, other in zip(lines["pymunk"], lines["batch"], strict=True):
        assert one["robots"] == other["robots"]
        times = one["step_ms"]
        assert 0 < times["median"] <= times["p99"] <= times["largest"]
        assert 0 <= times["late"] <= 1
    found = step_times(lines["batch"])
    assert found["largest"] == max(line["step_ms"]["largest"] for line in lines["batch"])
    assert step_times([{}]) is None
    table = time_table([{"policy": "mine", "step_ms": found}, {"policy": "built in"}])
    assert [row.split(" | ")[0] for row in table if row.startswith("| ")] == ["| policy", "| mine"]
    assert time_table([{"policy": "built in"}]) == []


def test_late_steps_are_those_longer_than_a_control_period():
    times_s = [0.001] * 97 + [0.02, 0.021, 0.5]
    found = step_statistics(times_s, 0.02)
    assert found == {"median": 1.0, "p99": pytest.approx(25.79), "largest": 500.0, "late": 0.02}
    rows = [
        {"policy": name, "step_ms": step_times([{"step_ms": found | {"late": late}}])}
        for name, late in (("slow", 0.02), ("quick", 0.01))
    ]
    assert [row.split(" | ")[-1] for row in time_table(rows)[-3:-1]] == ["no |", "yes |"]


def made_entry(folder, program, **fields):
    """A folder with an entry that is a program."""
    folder.mkdir(exist_ok=True)
    card = {"name": "mine", "authors": ["A"], "kind": "code", "command": ["python", "entry.py"]}
    (folder / "entry.yaml").write_text(json.dumps(card | fields))
    (folder / "entry.py").write_text(program)
    return f"entry:{folder}"


@pytest.mark.parametrize(
    ("welcome", "answer", "error"),
    [
        (WELCOME, "b'1234567'", "an answer of 7 bytes at step 0; 24 are needed, 3 robots × 2 numbers of 4"),
        (WELCOME, "(zeros + np.nan).tobytes()", "action of robot_0 at step 0 is [nan, nan]; it must be finite"),
        (WELCOME, "zeros.tobytes() if 1/0 else 0", "status 1 at step 0: ZeroDivisionError: division"),
        (WELCOME, "sys.exit(3)", "the process ended with status 3 at step 0"),
        (WELCOME, "time.sleep(5)", "no answer within 0.3 s at step 0"),
        (WELCOME, "print('here I am', flush=True)", "(print to stderr only)"),
        ("raise OSError('no weights')", "0", "ended with status 1 at the start: OSError: no weights"),
        ("send(b'{}')", "0", 'the first answer must be {"protocol": 1}, got {}'),
        ("send(b'hello')", "0", "the first answer must be {\"protocol\": 1}, got b'hello'"),
    ],
)  # fmt: skip
def test_what_is_wrong_with_a_program_is_reported_in_one_line(
    welcome, answer, error, tmp_path, monkeypatch
):
    monkeypatch.setattr(entry_process, "STEP_LIMIT_S", 0.3)
    monkeypatch.setattr(pipes, "END_LIMIT_S", 0.1)
    processes = []
    real = pipes.subprocess.Popen
    monkeypatch.setattr(
        pipes.subprocess,
        "Popen",
        lambda *args, **options: processes.append(real(*args, **options)) or processes[-1],
    )
    program = PROGRAM.replace("HELLO", welcome).replace("ANSWER", answer)
    policy = make_policy(made_entry(tmp_path / "entry", program), SHORT, trust=True)
    with pytest.raises(ValueError, match="entry 'mine': ") as found:
        run_policy(SHORT, policy)
    assert error in str(found.value)
    assert "\n" not in str(found.value)
    assert [process.poll() is not None for process in processes] == [True]


def test_a_program_may_write_to_stderr_and_ends_with_its_policy(tmp_path):
    program = PROGRAM.replace("HELLO", WELCOME).replace(
        "ANSWER", "[sys.stderr.write('x' * 1000), zeros.tobytes()][1]"
    )
    policy = make_policy(made_entry(tmp_path / "entry", program), SHORT, trust=True)
    record = run_policy(SHORT, policy)
    assert not record["omega_l_command_rad_s"][10:].any()
    process = policy._process._process.process
    assert process.poll() is None
    policy.close()
    assert process.poll() == 0


def test_a_program_that_cannot_be_started_is_reported(tmp_path):
    name = made_entry(tmp_path / "entry", "", command=["no-such-program"])
    with pytest.raises(ValueError, match="'mine': cannot start 'no-such-program': No such file"):
        run_policy(SHORT, make_policy(name, SHORT, trust=True))


def test_observations_of_several_formations_are_refused():
    policy = make_policy(NAME, SHORT, trust=True)
    with pytest.raises(
        ValueError, match=r"observations of one formation, \(3, entry\), got \(6, 4\)"
    ):
        policy.predict(np.zeros((6, 4)))


def test_code_runs_only_with_permission():
    with pytest.raises(ValueError, match="runs code of its own; allow that with --trust"):
        make_policy(NAME, SHORT)


@pytest.mark.parametrize(
    ("fields", "error"),
    [
        ({"kind": "text"}, "kind"),
        ({"command": []}, "command"),
        ({"command": None}, "kind 'code' needs command, and no file"),
        ({"file": "a.safetensors"}, "kind 'code' needs command, and no file"),
        ({"authors": []}, "authors"),
        ({"weights": "a"}, "weights"),
        ({"scenario": {"estimator": "truth"}}, "must be one of ekf, ekf-slip"),
        ({"scenario": {"estimator": "my:Own"}}, "must be one of ekf, ekf-slip"),
        ({"scenario": {"disturbance": "none"}}, "scenario.disturbance"),
        ({"kind": "weights", "command": None, "file": "../a.safetensors"}, "must be in the entry's folder"),
        ({"kind": "weights", "command": None, "file": "a.zip"}, "must be a .safetensors file"),
        ({"kind": "weights", "command": None, "file": "a.safetensors"}, "a.safetensors"),
    ],
)  # fmt: skip
def test_what_is_wrong_with_a_card_is_reported_in_one_line(fields, error, tmp_path):
    name = made_entry(tmp_path / "entry", "", **fields)
    with pytest.raises(ValueError, match=r".") as found:
        make_policy(name, SHORT, trust=True)
    assert error in str(found.value)
    assert "\n" not in str(found.value)


def test_a_folder_without_a_card_is_refused(tmp_path):
    with pytest.raises(ValueError, match=r"has no file entry\.yaml"):
        load_entry(tmp_path)


def test_an_entry_may_ask_for_what_every_policy_may_ask_for():
    assert set(AskedFields.model_fields) == set(OVERRIDABLE)


def test_weights_run_as_the_policy_itself_and_without_permission(tmp_path):
    shipped = SHIPPED / "residual.safetensors"
    for suffix in (".safetensors", ".json"):
        shutil.copy(shipped.with_suffix(suffix), tmp_path / f"mine{suffix}")
    fields = {"kind": "weights", "command": None, "file": "mine.safetensors"}
    mine = fit_policy(made_entry(tmp_path, "", **fields), SHORT)
    own = fit_policy("residual", SHORT)
    assert mine.overrides == own.overrides
    records = [run_policy(one.scenario, one.policy, 1) for one in (mine, own)]
    np.testing.assert_array_equal(*(record["x_mm"] for record in records))


def test_every_file_of_an_entry_is_in_its_hash(tmp_path):
    folder = tmp_path / "entry"
    name = made_entry(folder, "1")

    def digest():
        return policy_hash(name, make_policy(name, SHORT, trust=True))

    first = digest()
    (folder / "__pycache__").mkdir()
    (folder / "__pycache__" / "entry.pyc").write_bytes(b"1")
    (folder / "entry.py").write_text("1  # the same code")
    assert digest() == first
    (folder / "data.bin").write_bytes(b"1")
    assert digest() != first


def test_a_process_is_not_left_behind_by_a_policy_that_is_forgotten():
    policy = make_policy(NAME, SHORT, trust=True)
    run_policy(load_scenario(SHORT, horizon_s=0.1), policy)
    process = policy._process._process.process
    assert isinstance(policy._process, EntryProcess)
    del policy
    assert process.poll() is not None


def test_the_command_line_runs_an_entry(tmp_path, monkeypatch, capsys):
    pytest.importorskip("arch")
    words = f"bench --entry {EXAMPLE} --tasks infinity --disturbances nominal --seeds 0:2 --horizon-s 0.4"
    arguments = ["tlf", *words.split(), "--no-figures", "--out", str(tmp_path / "out")]
    monkeypatch.setattr("sys.argv", arguments)
    with pytest.raises(SystemExit) as end:
        main()
    assert end.value.code == 2
    assert "allow that with --trust" in capsys.readouterr().err
    monkeypatch.setattr("sys.argv", [*arguments, "--trust", "--processes", "1"])
    main()
    assert "## Time per step" in (tmp_path / "out" / "leaderboard.md").read_text()
    plan = json.loads((tmp_path / "out" / "plan.json").read_text())["plan"]
    assert plan["policies"] == [NAME]
