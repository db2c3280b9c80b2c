"""The report of a benchmark: the runs that it names, the commands that run them again, and its page."""

from __future__ import annotations

import html.parser
import json
import re
import shlex
import statistics
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

pytest.importorskip("arch")

from baselines import cli
from baselines.benchmark.aggregate import leaderboard
from baselines.benchmark.bench import run_bench
from baselines.benchmark.comparisons import in_words, only_one_failed
from baselines.benchmark.notable import Commands, notable, plain
from baselines.benchmark.plan import Episode, Plan
from baselines.benchmark.replays import (
    Choice,
    differences,
    file_name,
    headline,
    record_of,
    write_replays,
)
from baselines.benchmark.report import report_page
from baselines.commands.eval import full_name, summary_of
from tlf_env.common.presets import parsed_yaml

SHORT = (("horizon_s", 2.0),)
PLAN = Plan(
    policies=("reference:consistent", "pure_pursuit"),
    tasks=("infinity",),
    disturbances=("nominal", "start"),
    seeds=(20_000, 20_003),
    overrides=SHORT,
)
HOSTILE = "</script><script>alert(1)</script><img src=x onerror=alert(2)> & \" '"
ROBOT = {
    "lost": False,
    "touched": False,
    "position_rmse_mm": 3.0,
    "settled_formation_rmse_mm": None,
    "error_capped_mean_mm": 4.0,
    "torque_rms_Nmm": 5.0,
    "score": 50.0,
}


class Page(html.parser.HTMLParser):
    """Elements, links, and the texts inside ``code``."""

    def __init__(self, source: str) -> None:
        super().__init__()
        self.names: list[str] = []
        self.ids: list[str] = []
        self.links: list[str] = []
        self.codes: list[str] = []
        self._code = False
        self.feed(source)

    def handle_starttag(self, tag, attrs):
        self.names.append(tag)
        found = dict(attrs)
        self.ids.append(found.get("id", ""))
        assert "src" not in found
        if tag == "a":
            self.links.append(found["href"])
        if tag == "code":
            self.codes.append("")
        self._code = tag == "code" or (self._code and tag == "br")

    def handle_endtag(self, tag):
        self._code = self._code and tag != "code"

    def handle_data(self, data):
        if self._code:
            self.codes[-1] += data


def line(policy="reference:consistent", seed=0, errors=(1.0,), disturbance="nominal", **robot):
    return {
        "policy": policy,
        "task": "infinity",
        "disturbance": disturbance,
        "level": 1.0,
        "sweep": None,
        "seed": seed,
        "privileged": False,
        "overrides": {},
        "string": {"time_gain": None, "frequency_gain": None, "frequency_Hz": None},
        "robots": [ROBOT | {"position_rmse_mm": error} | robot for error in errors],
    }


def made(lines, folder: Path):
    """A leaderboard and its plan, from lines."""
    unique = {
        key: tuple(dict.fromkeys(one[key] for one in lines)) for key in ("policy", "disturbance")
    }
    seeds = [one["seed"] for one in lines]
    plan = Plan(
        unique["policy"],
        ("infinity",),
        unique["disturbance"],
        (min(seeds), max(seeds) + 1),
        overrides=SHORT,
    )
    record = {"plan": json.loads(json.dumps(vars(plan)))}
    (folder / "plan.json").write_text(json.dumps(record))
    results = SimpleNamespace(folder=folder, plan=plan, ordered=lambda: lines)
    return leaderboard(results, "tlf bench"), plan


# --- which runs are named

RUNS = st.lists(
    st.tuples(
        st.sampled_from([0.5, 1.0, 2.0, None]),
        st.sampled_from([0.5, 1.0, 3.0, None]),
        st.booleans(),
        st.booleans(),
    ),
    min_size=1,
    max_size=9,
)


@given(RUNS)
def test_the_median_run_has_the_lower_median_and_the_worst_run_failed_first(runs):
    lines = [
        line(seed=seed, errors=(a, b), lost=lost, touched=touched)
        for seed, (a, b, lost, touched) in enumerate(runs)
    ]
    errors = [max((x for x in run[:2] if x is not None), default=None) for run in runs]
    found = notable(lines)
    known = [float("inf") if error is None else error for error in errors]
    assert known[found.median["seed"]] == statistics.median_low(known)
    fails = [lost or touched for *_, lost, touched in runs]
    among = [seed for seed in range(len(runs)) if fails[seed] == any(fails)]
    largest = max(-1.0 if errors[seed] is None else errors[seed] for seed in among)
    same = [seed for seed in among if (-1.0 if errors[seed] is None else errors[seed]) == largest]
    assert found.worst["seed"] == same[0]


def test_the_headline_begins_with_the_users_policies_and_the_cells_in_which_they_fail():
    lines = [
        line(policy, seed, (error,), disturbance, lost=lost)
        for policy in ("reference:consistent", "mine:make")
        for disturbance, lost in (
            ("nominal", False),
            ("ice", policy == "mine:make"),
            ("slip", False),
        )
        for seed, error in enumerate((2.0, 3.0, 4.0 if disturbance != "slip" else 9.0))
    ]
    found = headline(lines, ["reference:consistent", "mine:make"], 4)
    short = [
        (one.line["policy"], one.line["disturbance"], one.line["seed"], one.what) for one in found
    ]
    assert short == [
        ("mine:make", "ice", 2, "worst"),
        ("mine:make", "nominal", 1, "median"),
        ("reference:consistent", "slip", 2, "worst"),
        ("reference:consistent", "nominal", 1, "median"),
    ]
    assert headline(lines, ["reference:consistent", "mine:make"], 0) == []
    every = headline(lines, ["reference:consistent", "mine:make"], 100)
    assert len(every) == len({(Episode.of_line(one.line), one.what) for one in every}) == 12


def test_names_of_files_are_safe_and_differ():
    names = {file_name(line(policy=HOSTILE + "/../x", seed=seed)) for seed in range(5)}
    assert len(names) == 5
    for name in names:
        assert re.fullmatch(r"[\w+-][\w.+-]*\.html", name)


# --- the commands


def run_again(words: list[str], folder: Path, monkeypatch, capsys) -> list[dict]:
    """The metrics of every robot from the command ``tlf``, as a person would call it."""
    extra = ["--no-figures", "--json", "--out", str(folder)]
    monkeypatch.setattr(sys, "argv", ["tlf", *words, *extra])
    cli.main()
    return list(json.loads(capsys.readouterr().out)["robots"].values())


@pytest.mark.parametrize(
    "change",
    [
        {},
        {"disturbances": ("slip-noise",), "level": 0.5, "overrides": (*SHORT, ("plant", "batch"))},
        {
            "policies": ("residual",),
            "disturbances": ("ice",),
            "overrides": (*SHORT, ("plant", "batch")),
        },
        {"sweep": "slip.delta_1_mm_s", "sweep_values": (0.0, 12.5), "level": 2.0},
        {
            "sweep": "slip.delta_1_mm_s",
            "sweep_values": (1e-05, 10.0),
            "disturbances": ("slip-noise",),
        },
        {
            "sweep": "slip.delta_1_mm_s.std",
            "sweep_values": (5.0, 10.0),
            "disturbances": ("slip-noise",),
        },
        {"sweep": "level", "sweep_values": (0.5, 2.0), "disturbances": ("slip",)},
        {"sweep": "robots", "sweep_values": (2.0, 4.0)},
        {"sweep": "robot.mass_kg", "sweep_values": (0.9, 1.3)},
        {
            "sweep": "time_gap_s",
            "sweep_values": (1.5, 3.0),
            "overrides": (*SHORT, ("plant", "kinematic")),
        },
    ],
    ids=lambda change: ", ".join(map(str, change.values())) or "nominal",
)
def test_every_command_runs_its_episode_again_digit_for_digit(
    change, tmp_path, monkeypatch, capsys
):
    plan = replace(
        PLAN, **({"policies": ("reference:consistent",), "seeds": (20_000, 20_002)} | change)
    )
    lines = run_bench(plan, tmp_path / "bench").ordered()
    commands = Commands(plan)
    for number, one in enumerate((lines[0], lines[-1])):
        words = commands.words(Episode.of_line(one))
        assert words is not None
        words = shlex.split(shlex.join(words))
        again = run_again(words, tmp_path / f"{number}", monkeypatch, capsys)
        assert again == one["robots"]
        assert differences(record_of(plan, Episode.of_line(one)), one) == []


def test_a_command_names_the_permission_only_where_code_is_run():
    plan = replace(PLAN, trust=True)
    words = {
        policy: Commands(plan).words(Episode(policy, "infinity", "ice", 1.0, None, 7))
        for policy in ("my model.zip", "entry:folder", "mine:Policy", "reference:tuned", "adrc")
    }
    assert [("--trust" in found) for found in words.values()] == [True, True, True, False, False]
    assert "'my model.zip'" in shlex.join(words["my model.zip"])


def test_a_run_without_a_command_says_so(tmp_path, monkeypatch):
    board, plan = made([line()], tmp_path)
    monkeypatch.setattr("baselines.benchmark.notable._same", lambda *_: False)
    assert Commands(plan).words(Episode.of_line(line())) is None
    assert "No single command asks for exactly this run." in report_page(board, plan, [line()])


@given(st.floats(allow_nan=False, allow_infinity=False))
def test_a_number_in_a_command_is_the_number(value):
    assert parsed_yaml(plain(value), "value") == value


def test_a_difference_is_found_in_every_digit():
    episode = PLAN.episodes()[0]
    record = record_of(PLAN, episode)
    robots = [metrics._asdict() for metrics in record.metrics()]
    assert differences(record, {"robots": json.loads(json.dumps(robots))}) == []
    robots[1]["score"] = float(np.nextafter(robots[1]["score"], 0))
    (said,) = differences(record, {"robots": robots})
    assert said.startswith("robot 1: score is ")


# --- the page


def bench(words: str, monkeypatch) -> None:
    monkeypatch.setattr(sys, "argv", ["tlf", "bench", *words.split()])
    cli.main()


def test_a_bench_and_a_resumed_one_write_the_report_with_replays(tmp_path, monkeypatch, capsys):
    words = (
        "--policies reference:consistent,pure_pursuit --tasks infinity --disturbances nominal,start "
        f"--seeds 20000:20002 --horizon-s 2 --no-figures --processes 1 --replays 2 --out {tmp_path}"
    )
    bench(words, monkeypatch)
    report = tmp_path / "report.html"
    first = report.read_text("utf-8")
    runs = (tmp_path / "runs.jsonl").read_bytes()
    page = Page(first)
    assert {
        "policies",
        "replays",
        "heat",
        "chart",
        "profiles",
        "cells",
        "definitions",
        "plan",
    } <= set(page.ids)
    assert "sweep" not in page.ids
    replays = {link for link in page.links if link.startswith("replays/")}
    assert len(replays) == 2
    assert all((tmp_path / link).stat().st_size > 1000 for link in replays)
    assert first.count("in every digit.</span>") == 2
    commands = [code for code in page.codes if code.startswith("tlf run ")]
    assert len(commands) == 2 * 4  # the median and the worst run of each cell
    report.unlink()
    (tmp_path / "runs.jsonl").write_bytes(runs[:-30])  # cut: the last episode is run again
    bench(words, monkeypatch)
    assert report.read_text("utf-8") == first
    assert "Open " in capsys.readouterr().out
    assert json.loads((tmp_path / "leaderboard.json").read_text())["cells"]


def test_without_replays_none_is_written(tmp_path, monkeypatch, capsys):
    words = (
        "--policies pure_pursuit --tasks infinity --disturbances nominal --seeds 0:1 --horizon-s 2"
    )
    bench(f"{words} --replays 0 --no-figures --processes 1 --out {tmp_path}", monkeypatch)
    assert (tmp_path / "report.html").exists()
    assert not (tmp_path / "replays").exists()
    capsys.readouterr()


def test_a_replay_that_differs_is_said_on_the_page(tmp_path, monkeypatch, capsys):
    words = (
        "--policies pure_pursuit --tasks infinity --disturbances nominal --seeds 0:1 --horizon-s 2"
    )
    monkeypatch.setattr(
        "baselines.benchmark.replays.differences", lambda *_: ["robot 0: score is 1.0"]
    )
    bench(f"{words} --no-figures --processes 1 --out {tmp_path}", monkeypatch)
    text = (tmp_path / "report.html").read_text("utf-8")
    assert "Not the same run as in the table: 1 value differs; robot 0: score is 1.0." in text
    assert "differs: robot 0" in capsys.readouterr().err


def test_any_name_stays_text(tmp_path):
    lines = [line(policy=name, disturbance=HOSTILE) for name in (HOSTILE, "reference:consistent")]
    board, plan = made(lines, tmp_path)
    board["plan"]["policies"] = {HOSTILE: "0" * 12}
    board["plan"]["versions"] = {HOSTILE: HOSTILE}
    board["command"] = HOSTILE
    known = replace(plan, disturbances=("nominal",))  # a scenario must load
    source = report_page(board, known, [])
    page = Page(source)
    assert page.names.count("script") == 3  # data, theme.js, report.js
    assert "img" not in page.names
    (data,) = re.findall(r'<script type="application/json" id="data">(.*?)</script>', source, re.S)
    assert HOSTILE in {one["policy"] for one in json.loads(data)["cells"]}
    assert HOSTILE in page.codes


def test_a_board_with_one_seed_and_a_policy_that_only_fails(tmp_path):
    lines = [line(), line("mine:make", errors=(None,), lost=True, score=0.0)]
    board, plan = made(lines, tmp_path)
    source = report_page(board, plan, lines)
    (data,) = re.findall(r'<script type="application/json" id="data">(.*?)</script>', source, re.S)
    cells = json.loads(data)["cells"]
    assert cells[0]["values"][0] == [1.0, None, None]
    assert cells[1]["values"][0] == [None, None, None]
    assert cells[1]["values"][1][0] == 100
    assert "too few runs" in source


def test_a_sweep_has_its_curves(tmp_path):
    plan = replace(PLAN, sweep="slip.delta_1_mm_s", sweep_values=(0.0, 20.0), seeds=(0, 1))
    results = run_bench(plan, tmp_path)
    source = report_page(leaderboard(results), plan, results.ordered())
    assert "sweep-panels" in Page(source).ids
    (data,) = re.findall(r'<script type="application/json" id="data">(.*?)</script>', source, re.S)
    held = json.loads(data)
    assert held["sweep"] == {"label": "slip.delta_1 (mm/s)", "log": False}
    assert {one["sweep"] for one in held["cells"]} == {0.0, 20.0}
    assert "start = 20" in {one["place"] for one in held["cells"]}


# --- verdicts, and tlf eval


def row(failed=(0, 0), ends=(-1.0, 1.0), runs=10):
    return {
        "failed": list(failed),
        "runs": runs,
        "position_rmse_mm": {"difference": 0.0, "interval": ends},
    }


@pytest.mark.parametrize(
    ("found", "only", "said"),
    [
        (row(), (0, 0), "no difference"),
        (row(ends=(-2, -1)), (0, 0), "better: smaller error"),
        (row(ends=(1, 2)), (0, 0), "worse: larger error"),
        (row((8, 0), (-2, -1)), (8, 0), "worse: fails more"),
        (row((0, 8), (1, 2)), (0, 8), "better: fails less"),
        (row((2, 0), (-2, -1)), (2, 0), "unclear: smaller error, more failures"),
        (row((0, 2), (1, 2)), (0, 2), "unclear: larger error, fewer failures"),
        (row((9, 9), (1, 2)), (1, 1), "no difference: both fail"),
        (row(ends=None, runs=1), (0, 0), "too few runs"),
        (row(ends=(1, 2), runs=5), (0, 0), "too few runs"),
        (row(ends=(1, 2), runs=6), (0, 0), "worse: larger error"),
    ],
)
def test_a_verdict_weighs_failures_first(found, only, said):
    assert in_words(found, only) == said


def test_failures_are_compared_on_the_same_seeds():
    mine = [line(seed=seed, lost=seed in (1, 2)) for seed in range(5)]
    theirs = [line(seed=seed, touched=seed in (2, 3, 4)) for seed in (4, 3, 2, 1, 0)]
    assert only_one_failed(mine, theirs) == (1, 2)
    assert only_one_failed(mine, mine) == (0, 0)


def test_a_summary_counts_the_verdicts():
    rows = [
        {"verdict": one}
        for one in ("better: x", "better: y", "no difference: both fail", "unclear: z")
    ]
    assert summary_of(rows) == (
        "better in 2, worse in 0, no difference in 1, unclear in 1 of 4 pairs of task and disturbance."
    )
    assert full_name("reference") == "reference:linearised"
    assert full_name("residual") == "residual"


EVAL = "--tasks infinity --disturbances nominal --seeds 20000:20006 --horizon-s 2 --no-figures --processes 1"


def test_eval_compares_a_file_with_the_default_and_is_resumed(tmp_path, monkeypatch, capsys):
    (tmp_path / "still.py").write_text(
        "import numpy as np\n"
        "class Still:\n"
        "    def predict(self, seen, state=None, episode_start=None, deterministic=True):\n"
        "        return np.zeros((len(seen), 2)), state\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    out = tmp_path / "out"
    words = [
        "tlf",
        "eval",
        "still:Still",
        "--trust",
        *EVAL.split(),
        "--replays",
        "1",
        "--out",
        str(out),
    ]
    monkeypatch.setattr(sys, "argv", words)
    cli.main()
    said = capsys.readouterr().out
    assert "still:Still against reference:linearised" in said
    assert "worse in 1" in said
    assert "worse: larger error" in (out / "report.html").read_text("utf-8")
    assert len(list((out / "replays").iterdir())) == 1
    page = (out / "replay.html").read_text("utf-8")
    assert "2 runs: " in page
    assert (
        page.count('"policy":"still:Still"') == page.count('"policy":"reference:linearised"') == 1
    )
    (out / "replays" / "of-an-earlier-choice.html").touch()
    before = (out / "runs.jsonl").read_bytes()
    monkeypatch.setattr(sys, "argv", [*words, "--json"])
    cli.main()
    assert (out / "runs.jsonl").read_bytes() == before
    assert len(list((out / "replays").iterdir())) == 1
    found = json.loads(capsys.readouterr().out)
    (cell,) = found["cells"]
    assert (found["policy"], found["against"]) == ("still:Still", "reference:linearised")
    assert (cell["verdict"], cell["runs"]) == ("worse: larger error", 6)
    assert cell["medians"][0] > cell["medians"][1]
    assert cli.interrupted_message(["eval", "residual"]).endswith("goes on: tlf eval residual")


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ("no_such", "no_such"),
        ("residul", "residual"),
        ("reference", "cannot be compared with itself"),
        ("residual --against residual", "cannot be compared with itself"),
        ("residual --against no_such", "no_such"),
        ("no_such.safetensors", "no_such.safetensors"),
        ("model.zip", "--trust"),
        ("residual --tasks no_such", "no_such"),
        ("residual --disturbances no_such", "no_such"),
        ("residual --seeds 5", "FIRST:END"),
        ("residual --plant no_such", "no_such"),
        ("residual --replays -1", "replays"),
    ],
)
def test_eval_refuses_bad_input_in_one_line(words, said, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", ["tlf", "eval", *words.split(), "--out", "out"])
    with pytest.raises(SystemExit) as end:
        cli.main()
    assert end.value.code == cli.BAD_INPUT
    shown = capsys.readouterr().err
    assert "\n" not in shown.strip()
    assert said in shown
    assert not list(tmp_path.rglob("*.jsonl"))


@pytest.mark.parametrize("words", ["bench --policies pure_pursuit", "eval residual"])
def test_without_arch_the_command_says_what_is_missing_before_it_runs(words, tmp_path):
    """In a process of its own, in which nothing is imported yet."""
    arguments = ["tlf", *words.split(), "--out", str(tmp_path / "out")]
    code = (
        "import sys; sys.modules['arch'] = None\n"
        f"sys.argv = {arguments!r}\n"
        "from baselines.cli import main; main()"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=120)
    assert done.returncode == cli.BAD_INPUT
    assert done.stderr.count("\n") == 1
    assert "tlf-env[bench]" in done.stderr
    assert not (tmp_path / "out").exists()


def test_the_time_of_a_step_is_shown_where_it_is_known(tmp_path):
    lines = [line(), line("entry:mine")]
    board, plan = made(lines, tmp_path)
    assert "time per step, ms" not in report_page(board, plan, [])
    board["policies"][0]["step_ms"] = {"median": 1.25, "p99": 2.0, "largest": 9.0, "late": 0.5}
    source = report_page(board, plan, [])
    assert "time per step, ms" in source
    assert "1.25" in source
    assert "50.00" in source


def test_the_headlines_are_run_once(tmp_path):
    one = line(errors=(1.0, 2.0, 3.0))
    plan = replace(PLAN, seeds=(0, 1))
    written = []

    def write(record, path):
        written.append(path.name)
        path.write_text("page")
        return path

    made = write_replays(plan, [Choice(one, "worst"), Choice(one, "median")], tmp_path, write)
    assert [replay.what for replay in made] == ["worst", "median"]
    assert len(written) == 1
    assert made[0].file == made[1].file == f"replays/{written[0]}"
    assert made[0].differences
