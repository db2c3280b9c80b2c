"""Statistics of the benchmark's tables, against known numbers and brute force."""

import itertools
import json
import math
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

pytest.importorskip("arch")

from baselines import aggregate
from baselines.bench import Plan

ROBOT = {
    "lost": False,
    "touched": False,
    "position_rmse_mm": 3.0,
    "settled_formation_rmse_mm": None,
    "error_capped_mean_mm": 4.0,
    "torque_rms_Nmm": 5.0,
    "score": 50.0,
}
SCORES = st.lists(st.floats(0, 100), min_size=1, max_size=12).map(np.array)


def line(policy="reference:consistent", seed=0, sweep=None, score=50.0, **robot):
    return {
        "policy": policy,
        "task": "infinity",
        "disturbance": "nominal",
        "level": 1.0,
        "sweep": sweep,
        "seed": seed,
        "privileged": policy == "oracle",
        "string": {"time_gain": None, "frequency_gain": None, "frequency_Hz": None},
        "robots": [ROBOT | {"score": score} | robot],
    }


def results(lines, folder: Path, **plan):
    policies = tuple(dict.fromkeys(one["policy"] for one in lines))
    plan = {"sweep": None, "seeds": [20000, 20002]} | plan
    (folder / "plan.json").write_text(json.dumps({"plan": plan}))
    made = Plan(policies, ("infinity",), ("nominal",), tuple(plan["seeds"]), sweep=plan["sweep"])
    return SimpleNamespace(folder=folder, plan=made, ordered=lambda: lines)


def test_the_interquartile_mean_drops_a_quarter_at_either_end():
    assert aggregate.interquartile_mean(np.array([-1000, 2, 4, 1e9])) == 3
    assert aggregate.interquartile_mean(np.array([7.0])) == 7


def test_a_share_has_wilsons_interval():
    z, runs, events = 1.959963984540054, 50, 3
    share = events / runs
    middle = (share + z**2 / (2 * runs)) / (1 + z**2 / runs)
    half = z / (1 + z**2 / runs) * math.sqrt(share * (1 - share) / runs + (z / runs) ** 2 / 4)
    found = aggregate.rate(events, runs)
    assert found["share"] == share
    assert found["interval"] == pytest.approx([middle - half, middle + half])
    assert aggregate.rate(0, 50)["interval"][0] == 0


def test_the_intervals_of_a_mean_agree_with_all_resamples():
    values = np.array([1.0, 4.0, 9.0, 10.0])
    means = [np.mean(pick) for pick in itertools.product(values, repeat=4)]
    found = aggregate.interval(values, lambda x: float(np.mean(x)))
    assert found == pytest.approx(np.percentile(means, [2.5, 97.5]), abs=0.5)


def test_a_stratified_interval_resamples_each_stratum_by_itself():
    strata = [np.zeros(5), np.full(5, 100.0)]
    mean = lambda *parts: float(np.mean(np.concatenate(parts)))  # noqa: E731  a statistic for one use
    assert aggregate.stratified_interval(strata, mean) == [50, 50]
    low, high = aggregate.interval(np.concatenate(strata), lambda x: float(np.mean(x)))
    assert high - low > 30


def test_intervals_are_the_same_every_time_and_none_of_one_value():
    values = np.arange(9.0)
    twice = [aggregate.interval(values, aggregate.interquartile_mean) for _ in range(2)]
    assert twice[0] == twice[1]
    assert aggregate.interval(values[:1], np.median) is None
    assert aggregate.stratified_interval([values, values[:1]], np.median) is None
    assert aggregate.stratified_interval([], np.median) is None


@given(SCORES, SCORES)
def test_the_probability_of_improvement_counts_pairs(mine, theirs):
    pairs = [(a > b) + 0.5 * (a == b) for a in mine for b in theirs]
    found = aggregate.improvement(mine, theirs)
    assert found == pytest.approx(np.mean(pairs))
    assert found + aggregate.improvement(theirs, mine) == pytest.approx(1)


def test_a_profile_weighs_every_stratum_the_same():
    strata = {
        ("infinity", "nominal", None): [line(score=90.0)],
        ("infinity", "slip", None): [line(score=10.0), line(score=30.0), line(score=30.0)],
    }
    shares = aggregate.profile(strata)
    assert len(shares) == len(aggregate.PROFILE_SCORES)
    assert shares[0] == 1
    assert shares[20] == pytest.approx((1 + 2 / 3) / 2)
    assert shares[30] == 0.5  # above, not at
    assert shares[100] == 0


@pytest.mark.parametrize(
    ("shares", "level", "at"),
    [
        ([0, 0, 0.1, 1], 0.05, 15),
        ([0, 0.5, 1], 0.5, 10),
        ([0.2, 0, 1], 0.05, 0),
        ([0, 0, 0.04], 0.05, None),
        ([0, 0.1, 0, 1], 0.55, 25.5),
    ],
)
def test_a_crossing_lies_between_its_neighbours(shares, level, at):
    assert aggregate.crossing([0, 10, 20, 30], shares, level) == (at and pytest.approx(at))


def test_a_sweep_is_walked_from_the_nominal_value_outwards(tmp_path):
    lines = [
        line(seed=seed, sweep=scale, lost=scale < 0.5)
        for seed in range(2)
        for scale in (0.2, 0.4, 0.8, 1.0)
    ]
    board = aggregate.leaderboard(results(lines, tmp_path, sweep="tyre.friction_scale"))
    (row,) = board["breaking_points"]
    assert row["loses_5_percent_at"] == pytest.approx(0.78)
    assert row["loses_50_percent_at"] == pytest.approx(0.6)


def test_a_run_fails_once_however_many_robots_fail(tmp_path):
    lost = line(seed=1, lost=True)
    lost["robots"].append(ROBOT | {"touched": True})
    board = aggregate.leaderboard(results([line(), lost], tmp_path))
    (cell,), (row,) = board["cells"], board["policies"]
    assert [cell[what]["count"] for what in ("lost", "touched", "success")] == [1, 1, 1]
    assert (row["failed"], row["runs"]) == (1, 2)


def test_a_run_counts_at_its_worst_robot_and_scores_the_mean():
    run = line(score=10.0)
    run["robots"].append(ROBOT | {"score": 30.0, "position_rmse_mm": 8.0})
    assert aggregate.worst(run, "position_rmse_mm") == 8
    assert aggregate.worst(run, "settled_formation_rmse_mm") is None
    assert aggregate.run_score(run) == 20


def test_scores_are_normalised_by_the_reference_whatever_the_order(tmp_path):
    lines = [
        line(policy, seed, score=score)
        for seed in range(2)
        for policy, score in (("mine", 30.0), ("reference", 60.0), ("oracle", 90.0))
    ]
    board = aggregate.leaderboard(results(lines, tmp_path))
    assert board["reference"] == "reference"
    rows = {row["policy"]: row for row in board["policies"]}
    assert [row["policy"] for row in board["policies"]] == ["oracle", "reference", "mine"]
    assert rows["mine"]["normalised_score"] == 0.5
    assert rows["mine"]["probability_of_improvement"] == 0
    assert rows["reference"]["probability_of_improvement"] == 0.5


def test_the_tables_are_whole_markdown_and_strict_json(tmp_path):
    lines = [line(policy, seed) for seed in range(2) for policy in ("reference", "oracle")]
    board = aggregate.write_leaderboard(results(lines, tmp_path), tmp_path, "tlf bench")
    text = (tmp_path / "leaderboard.json").read_text()
    assert json.loads(text, parse_constant=pytest.fail) == json.loads(json.dumps(board))
    table = (tmp_path / "leaderboard.md").read_text()
    assert "oracle (privileged)" in table
    for words in ("nan", "None", "inf "):
        assert words not in table
    rows = [row for row in table.splitlines() if row.startswith("|")]
    assert {row.count("|") for row in rows if "of 2 [" in row} == {10}
    assert {row.count("|") for row in rows if "of 2 |" in row} == {7}


def test_what_is_undefined_is_a_dash():
    assert aggregate.number(None, 1) == aggregate.number(math.nan, 1) == "–"
    assert aggregate.number(1.26, 1) == "1.3"
    assert aggregate.span([1.26, 2], 1) == "[1.3, 2.0]"
    assert aggregate.span(None, 1) == ""
