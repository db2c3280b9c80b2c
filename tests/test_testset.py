"""The test set: frozen cases that the robots can follow, refused by training, scored case by case."""

import dataclasses
import hashlib
import importlib
import json
import math
import sys

import numpy as np
import pytest
from page_tables import DOCS

pytest.importorskip("arch")
pytest.importorskip("scipy")

from baselines.benchmark import bench
from baselines.benchmark.bench import run_bench
from baselines.benchmark.drawn_tasks import Course, Curve, trajectory_of
from baselines.benchmark.draws import Draws, words_of
from baselines.benchmark.testset import VERSION, case_scenario, drawn_case, severity_of
from baselines.benchmark.testset_page import markdown, write_test_board
from baselines.benchmark.testset_plan import LOOKS_FILE, fingerprint, log_look, plan_of_test
from baselines.benchmark.testset_score import CAP_MM, case_error_mm, difference
from baselines.cli import main
from baselines.runs.provenance import command_line
from baselines.runs.splits import (
    CHOOSING_DISTURBANCES,
    TEST_DISTURBANCES,
    TEST_TASKS,
    TRAINING_FAMILIES,
)
from baselines.training.config import load_config
from baselines.tuning.config import load_tune
from tlf_env.common.presets import preset_names
from tlf_env.task.feasibility import warnings_for
from tlf_env.task.scenario import load_scenario, scenario_warnings
from tlf_env.task.trajectories import sample

CHECKED = range(10_300, 10_316)  # no cases of the published set: a test must not look at them
# Digests of some published cases. A change of a case makes a new version of the test set, with new digests.
SECRET = "a secret text"
FROZEN_VERSION = 1
FROZEN = {
    20_000: "aeb07ecfccaa88b1",
    20_001: "2f5f9adfa923cfa6",
    20_042: "c4be7c7a8097a68a",
    20_099: "ced80a5ffd921931",
    20_150: "483d46f80605ba8e",
    20_199: "3077a387f64fb933",
}
FROZEN_WITH_A_KEY = "6204d0057a0ffbea"


def digest(case: dict) -> str:
    return hashlib.sha256(json.dumps(case, sort_keys=True).encode()).hexdigest()[:16]


def test_the_cases_of_this_version_are_frozen():
    assert VERSION == FROZEN_VERSION
    assert {seed: digest(drawn_case(seed)) for seed in FROZEN} == FROZEN
    assert digest(drawn_case(20_000, SECRET)) == FROZEN_WITH_A_KEY


def test_a_case_depends_on_its_number_and_key_alone():
    one = drawn_case(10_300)
    drawn_case(10_301)
    assert drawn_case(10_300) == one
    others = [drawn_case(10_301), drawn_case(10_300, "a"), drawn_case(10_300, "b")]
    texts = {json.dumps({**case, "name": ""}) for case in (one, *others)}
    assert len(texts) == 4


def test_the_uniform_numbers_are_those_of_pcg64():
    """The first numbers of a stream whose definition does not change."""
    draws = Draws(1, 2)
    again = np.random.Generator(np.random.PCG64(np.random.SeedSequence((1, 2))))
    assert [draws.unit() for _ in range(5)] == again.random(5).tolist()
    assert words_of("") == ()
    digest = hashlib.sha256(b"key").digest()
    assert words_of("key") == tuple(np.frombuffer(digest, ">u4").tolist())


@pytest.fixture(scope="module")
def cases():
    return [drawn_case(seed) for seed in CHECKED]


def test_robots_can_follow_every_case(cases):
    for case in cases:
        scenario = load_scenario(case)
        lines = scenario_warnings(scenario)
        assert [line for line in lines if "the reference is at rest" not in line] == []
        last_s = scenario.time_gap_s * (scenario.robot_count - 1)
        assert last_s + 5 < scenario.horizon_s, "the last robot is in formation before the end"
        assert scenario == load_scenario(json.loads(json.dumps(case)))


def test_the_cases_differ_in_everything_that_is_drawn(cases):
    groups = {group for case in cases for group in case["disturbance"]}
    assert groups >= {"slip", "tyre", "floor", "position", "encoder", "gyro", "actuator", "radio"}
    assert {len(case["robots"]) for case in cases} == {3, 4, 5}
    assert {case["trajectory"]["type"] for case in cases} == {"waypoints", "stop_and_go"}
    assert len({case["start_ramp_s"] == 0.0 for case in cases}) == 2
    severities = [severity_of(seed) for seed in range(10_000, 11_000)]
    assert abs(np.mean(severities) - 0.5) < 0.05
    assert min(severities) < 0.02
    assert max(severities) > 0.98


def test_a_circle_is_driven_at_the_speed_of_the_course():
    radius = 1500.0
    circle = Curve(np.array([[radius, 0.0]]), np.array([[0.0, radius]]))
    course = Course(speed_mm_s=300.0, swing=0.0, waves=1, phase_rad=0.0, stops=None)
    trajectory = load_scenario({"trajectory": trajectory_of(circle, course)}).trajectory
    rows = sample(trajectory, np.arange(1.0, 59.0, 0.1))
    np.testing.assert_allclose(np.hypot(rows[:, 0], rows[:, 1]), radius, rtol=1e-4)
    np.testing.assert_allclose(rows[:, 3], 300.0, rtol=2e-3)
    np.testing.assert_allclose(rows[:, 4], 300.0 / radius, rtol=2e-2)
    assert warnings_for(trajectory, load_scenario().robot, 60.0) == []


def line(seed, error_mm, *, lost=False, touched=False):
    robot = {"settled_formation_rmse_mm": error_mm, "lost": lost, "touched": touched}
    return {
        "policy": "p",
        "seed": seed,
        "robots": [dict(robot, settled_formation_rmse_mm=0.2), robot],
    }


def test_the_error_of_a_case_is_that_of_the_worst_robot_within_bounds():
    assert case_error_mm(line(0, 7.0)) == 7.0
    assert case_error_mm(line(0, 7.0, lost=True)) == CAP_MM
    assert case_error_mm(line(0, 7.0, touched=True)) == CAP_MM
    assert case_error_mm(line(0, 1e4)) == CAP_MM
    assert case_error_mm({"robots": [dict(line(0, 0.001)["robots"][1])]}) == 0.1


def test_differences_are_paired_by_case():
    mine = [line(seed, 2.0 + seed) for seed in range(8)]
    theirs = [line(seed, 3.0 + seed, lost=seed == 7) for seed in reversed(range(8))]
    found = difference(mine, theirs)
    assert found["error_mm"]["median"] == -1.0
    assert found["held"]["only"] == [1, 0]
    assert found["held"]["p"] == 1.0
    back = difference(theirs, mine)
    assert back["error_mm"]["median"] == 1.0
    assert back["error_mm"]["p"] == pytest.approx(found["error_mm"]["p"])
    same = difference(mine, mine)
    assert (same["error_mm"]["median"], same["error_mm"]["p"], same["held"]["p"]) == (0.0, 1.0, 1.0)


@pytest.fixture
def short(monkeypatch):
    """Cases of 2 s, so that a test is quick."""

    def shortened(plan, episode):
        return load_scenario(case_scenario(episode.seed, plan.key), horizon_s=2.0)

    monkeypatch.setattr("baselines.benchmark.testset_plan.TestPlan.scenario", shortened)


POLICIES = ("reference:consistent", "pure_pursuit")


def test_the_test_set_is_resumed_and_scored(tmp_path, short, monkeypatch):
    plan = plan_of_test(POLICIES, (20_000, 20_002), SECRET)
    run, real = [], bench.run_episode

    def breaks_at_the_third(plan, episode):
        run.append(episode)
        if len(run) == 3:
            raise RuntimeError
        return real(plan, episode)

    monkeypatch.setattr(bench, "run_episode", breaks_at_the_third)
    with pytest.raises(RuntimeError):
        run_bench(plan, tmp_path)
    results = run_bench(plan, tmp_path)
    assert [episode.seed for episode in run] == [20_000, 20_000, 20_001, 20_001, 20_001]
    for policy in POLICIES:
        driven = [one for one in results.ordered() if one["policy"] == policy]
        assert len({one["scenario_hash"] for one in driven}) == len(driven) == 2
    board = write_test_board(results, tmp_path, "tlf bench")
    # The score again, from runs.jsonl alone, by the formula of the page.
    for entry in board["entries"]:
        errors = [
            500.0
            if any(robot["lost"] or robot["touched"] for robot in found["robots"])
            else min(
                max(0.1, *(r["settled_formation_rmse_mm"] or 500.0 for r in found["robots"])), 500.0
            )
            for found in map(json.loads, (tmp_path / "runs.jsonl").read_text().splitlines())
            if found["policy"] == entry["policy"]
        ]
        assert entry["score"]["mm"] == pytest.approx(math.exp(np.mean(np.log(errors))))
    assert "## Score" in (tmp_path / "leaderboard.md").read_text()


def test_a_key_is_written_to_no_file(tmp_path, short):
    plan = plan_of_test(POLICIES[:1], (20_000, 20_001), SECRET)
    log_look(plan, tmp_path)
    write_test_board(run_bench(plan, tmp_path), tmp_path, "tlf bench")
    files = list(tmp_path.iterdir())
    assert LOOKS_FILE not in [path.name for path in files]
    for path in files:
        assert SECRET not in path.read_text()
        assert json.loads((tmp_path / "plan.json").read_text())["plan"][
            "fingerprint"
        ] == fingerprint(SECRET)
    with pytest.raises(ValueError, match="different 'plan'"):
        run_bench(
            dataclasses.replace(plan, key="other", fingerprint=fingerprint("other")), tmp_path
        )
    words = ["bench", "--test-seed", SECRET, "--policies", "kanayama"]
    assert command_line(words) == "tlf bench --test-seed ... --policies kanayama"
    assert command_line(["bench", f"--test-seed={SECRET}"]) == "tlf bench --test-seed=..."


def test_every_look_at_the_published_cases_is_on_the_page(tmp_path):
    plan = plan_of_test(POLICIES, (20_000, 20_003))
    for _ in range(2):
        log_look(plan, tmp_path)
    looks = [json.loads(text) for text in (tmp_path / LOOKS_FILE).read_text().splitlines()]
    assert [look["policies"] for look in looks] == [list(POLICIES)] * 2
    board = {"command": "", "version": VERSION, "fingerprint": "", "cases": [20_000, 20_003]}
    page = markdown(board | {"published": True, "entries": [], "differences": [], "looks": looks})
    assert page.count("| 20000 to 20002 | reference:consistent, pure_pursuit |") == 2


@pytest.mark.parametrize(
    ("words", "line"),
    [
        ("--test --tasks infinity", "--tasks cannot be used with --test"),
        ("--test --disturbances slip", "--disturbances cannot be used with --test"),
        ("--test --plan board", "--tasks cannot be used with --test"),
        ("--test --seeds 10000:10010", "the cases of the test set begin at 20000"),
        ("--test --policies nothing", "'nothing' is not one of"),
        ("--test-seed=", "--test-seed must not be empty"),
    ],
)
def test_wrong_options_are_reported_in_one_line(words, line, monkeypatch, capsys, tmp_path):
    arguments = ["tlf", "bench", *words.split(), "--out", str(tmp_path / "out")]
    monkeypatch.setattr("sys.argv", arguments)
    with pytest.raises(SystemExit) as end:
        main()
    error = capsys.readouterr().err
    assert end.value.code == 2
    assert line in error
    assert error.count("\n") == 1
    assert not (tmp_path / "out" / LOOKS_FILE).exists()


def tune_with(**fields):
    found = {
        "start": "tuned",
        "search": {"lead_s": {"low": 0, "high": 0.04}},
        "tasks": ["infinity"],
    }
    found |= {
        "disturbances": ["slip"],
        "seeds": {"first": 0, "count": 1},
        "horizon_s": 50,
        "trials": 1,
    }
    return found | {"choose": {"first": 10_000, "count": 1}} | fields


def test_tuning_refuses_what_is_for_tests(tmp_path):
    case = tmp_path / "case.json"
    case.write_text(json.dumps(drawn_case(10_300)))
    case = case.rename(tmp_path / "case.yaml")
    search = tmp_path / "search.yaml"
    for fields, name in (
        ({"tasks": [str(case)]}, "test-set-1-10300"),
        ({"tasks": ["stop_and_go"]}, "stop_and_go"),
        ({"disturbances": ["swell"]}, "swell"),
        ({"disturbances": ["slip-sines"]}, "slip-sines"),
    ):
        search.write_text(json.dumps(tune_with(**fields)))
        with pytest.raises(ValueError, match=f"'{name}' .* must not"):
            load_tune(search)
    search.write_text(json.dumps(tune_with()))
    load_tune(search)


def test_training_refuses_what_is_for_tests():
    quick = load_config("quick").model_dump()
    evaluation = quick["evaluation"]
    with pytest.raises(ValueError, match="'stop_and_go' is for tests only"):
        load_config({**quick, "tasks": {"stop_and_go": {}}})
    with pytest.raises(ValueError, match="'slip-sines' chooses"):
        load_config({**quick, "disturbances": {"slip-sines": 1.0}})
    load_config({**quick, "evaluation": {**evaluation, "disturbances": ["slip-sines"]}})
    with pytest.raises(ValueError, match="'swell' is for tests only"):
        load_config({**quick, "evaluation": {**evaluation, "disturbances": ["swell"]}})


def test_every_preset_is_in_one_split():
    training = [name for names in TRAINING_FAMILIES.values() for name in names]
    named = [*training, *CHOOSING_DISTURBANCES, *TEST_DISTURBANCES]
    assert sorted(named) == sorted(preset_names("disturbance"))
    assert set(TEST_TASKS) <= set(preset_names("scenario"))


def test_the_published_results_are_those_on_the_page():
    pytest.importorskip("matplotlib")
    sys.path.insert(0, str(DOCS / "figures"))
    made = importlib.import_module("make_test_set")
    board = json.loads((DOCS / "test-set" / "leaderboard.json").read_text("utf-8"))
    assert (board["version"], board["published"], board["cases"]) == (
        VERSION,
        True,
        [20_000, 20_200],
    )
    page = (DOCS / "test-set.md").read_text("utf-8")
    assert f"<!-- results -->\n{made.results(board)}\n<!-- end of results -->" in page
    looks = [look["date"][:10] for look in board["looks"]]
    assert all(f"| {day} | 1 | 20000–20199 |" in page for day in looks)
    pair = next(
        one
        for one in board["differences"]
        if one["policy"].startswith("kanayama") and one["other"] == "reference:linearised"
    )
    low, high = pair["error_mm"]["interval"]
    found = f"{pair['error_mm']['median']:.2f} mm [{low:.2f}, {high:.2f}]".replace("-", "−")
    assert found in page
    readme = (DOCS.parent / "README.md").read_text("utf-8")
    held = {entry["policy"].partition("+")[0]: entry["held"]["count"] for entry in board["entries"]}
    text = " ".join(readme.split())
    scores = {
        entry["policy"].partition("+")[0]: f"{entry['score']['mm']:.1f} mm"
        for entry in board["entries"]
    }
    first = min(board["entries"], key=lambda entry: entry["score"]["mm"])["policy"]
    assert f"`{first}` has the best score, {scores[first]}, and holds {held[first]};" in text
    assert f"`from-nothing` has {scores['from-nothing']} and holds {held['from-nothing']}" in text
    for name in ("kanayama:searched", "adrc:searched"):
        assert f"`{name}` {scores[name]} and {held[name]}" in text
    default = "reference:linearised"
    assert f"the default {scores[default]} and {held[default]}" in text
    for name in ("reference:tuned", "reference:consistent"):
        assert f"`{name}` {held[name]}" in text
    (against,) = (
        one
        for one in board["differences"]
        if (one["policy"], one["other"]) == ("residual", default)
    )
    alone, other = against["held"]["only"]
    assert f"{alone} are held by it alone and {other} by the default alone" in " ".join(
        page.split()
    )
    assert (DOCS / "test-set" / "leaderboard.md").read_text("utf-8") == markdown(board)
