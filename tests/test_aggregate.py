"""Statistics of the benchmark's tables, against known numbers and brute force."""

import itertools
import json
import math
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

pytest.importorskip("arch")

from baselines.benchmark import aggregate, comparisons, page, statistics
from baselines.benchmark import lines as of_lines
from baselines.benchmark.plan import Plan

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
    assert statistics.interquartile_mean(np.array([-1000, 2, 4, 1e9])) == 3
    assert statistics.interquartile_mean(np.array([7.0])) == 7


def test_a_share_has_wilsons_interval():
    z, runs, events = 1.959963984540054, 50, 3
    share = events / runs
    middle = (share + z**2 / (2 * runs)) / (1 + z**2 / runs)
    half = z / (1 + z**2 / runs) * math.sqrt(share * (1 - share) / runs + (z / runs) ** 2 / 4)
    found = statistics.rate(events, runs)
    assert found["share"] == share
    assert found["interval"] == pytest.approx([middle - half, middle + half])
    assert statistics.rate(0, 50)["interval"][0] == 0


def test_the_intervals_of_a_mean_agree_with_all_resamples():
    values = np.array([1.0, 4.0, 9.0, 10.0])
    means = [np.mean(pick) for pick in itertools.product(values, repeat=4)]
    found = statistics.interval(values, lambda x: float(np.mean(x)))
    assert found == pytest.approx(np.percentile(means, [2.5, 97.5]), abs=0.5)


def test_a_stratified_interval_resamples_each_stratum_by_itself():
    strata = [np.zeros(5), np.full(5, 100.0)]

    def mean(*parts: np.ndarray) -> float:
        return float(np.mean(np.concatenate(parts)))

    assert statistics.stratified_interval(strata, mean) == [50, 50]
    low, high = statistics.interval(np.concatenate(strata), lambda x: float(np.mean(x)))
    assert high - low > 30


def test_intervals_are_the_same_every_time_and_none_of_one_value():
    values = np.arange(9.0)
    twice = [statistics.interval(values, statistics.interquartile_mean) for _ in range(2)]
    assert twice[0] == twice[1]
    assert statistics.interval(values[:1], np.median) is None
    assert statistics.stratified_interval([values, values[:1]], np.median) is None
    assert statistics.stratified_interval([], np.median) is None


@given(SCORES, SCORES)
def test_the_probability_of_improvement_counts_pairs(mine, theirs):
    pairs = [(a > b) + 0.5 * (a == b) for a in mine for b in theirs]
    found = statistics.improvement(mine, theirs)
    assert found == pytest.approx(np.mean(pairs))
    assert found + statistics.improvement(theirs, mine) == pytest.approx(1)


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
    assert statistics.crossing([0, 10, 20, 30], shares, level) == (at and pytest.approx(at))


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
    assert of_lines.worst(run, "position_rmse_mm") == 8
    assert of_lines.worst(run, "settled_formation_rmse_mm") is None
    assert of_lines.run_score(run) == 20


@pytest.mark.parametrize(
    ("policies", "wanted"),
    [
        (["reference:printed+ekf+none", "reference:consistent+ekf+none"], 1),
        (["reference:consistent", "reference:linearised+ekf"], 1),
        (["kanayama", "lqr"], 0),
        ([], None),
    ],
)
def test_the_reference_may_be_in_a_system(policies, wanted):
    assert aggregate.reference_of(policies) == (None if wanted is None else policies[wanted])


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
    assert {row.count("|") for row in rows if "of 2 |" in row} == {7, 9}


def runs(policy, errors_mm, **robot):
    return [
        line(policy, seed, position_rmse_mm=error_mm, **robot)
        for seed, error_mm in enumerate(errors_mm)
    ]


def test_a_paired_interval_is_narrow_where_seeds_explain_the_spread():
    rng = np.random.default_rng(1)
    seeds = rng.normal(50, 20, 60)
    theirs, mine = seeds, seeds - 2 + rng.normal(0, 0.1, 60)
    row = comparisons.comparison(runs("mine", mine), runs("theirs", theirs))
    found = row["position_rmse_mm"]
    assert found["difference"] == pytest.approx(np.median(mine - theirs))
    assert found["interval"][0] < -2 < found["interval"][1] < 0
    assert found["interval"][1] - found["interval"][0] < 1
    shuffled = comparisons.comparison(runs("mine", rng.permutation(mine)), runs("theirs", theirs))
    low, high = shuffled["position_rmse_mm"]["interval"]
    assert low < 0 < high
    assert high - low > 5


@settings(max_examples=5, deadline=None)
@given(shift=st.floats(0.5, 50), n=st.integers(5, 30))
def test_a_difference_has_the_sign_of_the_shift_and_turns_with_the_policies(shift, n):
    theirs = np.linspace(10, 20, n)
    better, worse = (
        comparisons.comparison(*pair)["position_rmse_mm"]
        for pair in (
            (runs("a", theirs - shift), runs("b", theirs)),
            (runs("b", theirs), runs("a", theirs - shift)),
        )
    )
    assert better["difference"] == pytest.approx(-shift)
    assert better["interval"] == pytest.approx([-shift, -shift])
    assert worse["interval"] == pytest.approx([shift, shift])
    assert (page.sign(better, 0), page.sign(worse, 0)) == (-1, 1)


def test_torque_is_compared_by_its_ratio():
    pair = [runs(name, range(4), torque_rms_Nmm=t) for name, t in (("a", 6.0), ("b", 5.0))]
    found = comparisons.comparison(*pair)["torque_rms_Nmm"]
    assert found == {"ratio": pytest.approx(1.2), "interval": pytest.approx([1.2, 1.2])}
    assert page.compared(found, 2) == "**1.20** [1.20, 1.20]"
    assert statistics.paired([(0.0, 0.0)] * 3, "ratio") == {"ratio": None, "interval": None}


def test_pairs_that_are_undefined_on_one_side_are_left_out():
    found = statistics.paired([(None, 1.0), (1.0, None), (3.0, 1.0), (3.0, 1.0)], "difference")
    assert found == {"difference": 2, "interval": [2, 2]}
    assert statistics.paired([(None, 1.0)], "ratio") == {"ratio": None, "interval": None}
    assert page.compared({"ratio": None, "interval": None}, 2) == "–"


def test_a_difference_is_the_median_of_the_pairs_not_the_difference_of_medians():
    """Better on two seeds of three by a little, and by much on none: the medians say the opposite."""
    pairs = [(1.0, 2.0), (10.0, 11.0), (12.0, 5.0)]
    assert statistics.paired(pairs, "difference")["difference"] == -1.0
    assert np.median([a for a, _ in pairs]) - np.median([b for _, b in pairs]) == 5.0
    assert statistics.paired(pairs, "ratio")["ratio"] == pytest.approx(10 / 11)


def test_an_older_board_says_how_it_was_compared(tmp_path):
    lines = [*runs("learned", (5.0, 6.0)), *runs("pure_pursuit", (1.0, 2.0))]
    board = aggregate.leaderboard(results(lines, tmp_path))
    assert "Medians of the differences over seeds" in "\n".join(page.comparison_tables(board))
    del board["compared_by"]
    assert "Differences of medians over seeds" in "\n".join(page.comparison_tables(board))


def test_a_difference_that_is_not_significant_is_not_bold():
    assert page.compared({"difference": 0.5, "interval": [-0.1, 1.0]}, 1) == "+0.5 [-0.1, 1.0]"
    assert page.sign({"difference": 1.0, "interval": None}, 0.0) == 0


def test_the_rival_of_an_entry_fails_least_and_then_errs_least(tmp_path, monkeypatch):
    monkeypatch.setattr(statistics, "REPEATS", 100)
    lines = [
        *runs("learned", (5.0, 6.0)),
        *runs("pure_pursuit", (1.0, 2.0), touched=True),
        *runs("reference:tuned", (7.0, 9.0)),
        *runs("feedback_linearisation", (8.0, 9.0)),
        *runs("kanayama+ekf-slip+body", (7.5, 9.0)),
        *runs("oracle", (0.1, 0.1)),
    ]
    board = aggregate.leaderboard(results(lines, tmp_path))
    rows = {row["policy"]: row for row in board["comparisons"]}
    assert set(rows) == {"learned", "oracle"}
    assert rows["learned"]["rival"] == rows["oracle"]["rival"] == "reference:tuned"
    assert rows["learned"]["failed"] == [0, 0]
    table = "\n".join(page.comparison_tables(board))
    assert "smaller in 1 of 1 rows, larger in 0, no significant difference in 0" in table


@pytest.mark.parametrize(
    ("policy", "expected"),
    [
        ("reference", True),
        ("kanayama:bounded", True),
        ("reference:tuned+truth", True),
        ("reference+ekf+body", True),
        ("residual", False),
        ("reference:mine.yaml", False),
        ("reference:mine.yaml+ekf+body", False),
        ("kanayama+ekf+mine.yaml", False),
    ],
)
def test_a_system_of_the_packages_parts_is_no_entry(policy, expected):
    assert comparisons.built_in(policy) == expected


def test_without_an_entry_the_first_by_score_is_compared(tmp_path, monkeypatch):
    monkeypatch.setattr(statistics, "REPEATS", 100)
    lines = [
        line(policy, seed, score=score)
        for seed in range(2)
        for policy, score in (("pure_pursuit", 30.0), ("reference", 60.0))
    ]
    (row,) = aggregate.leaderboard(results(lines, tmp_path))["comparisons"]
    assert (row["policy"], row["rival"]) == ("reference", "pure_pursuit")


def test_a_single_policy_is_compared_with_nothing(tmp_path):
    board = aggregate.leaderboard(results([line(), line(seed=1)], tmp_path))
    assert board["comparisons"] == []


def test_other_seeds_cannot_be_paired(tmp_path):
    lines = [*runs("learned", (1.0, 2.0)), *runs("pure_pursuit", (1.0, 2.0, 3.0))]
    with pytest.raises(ValueError, match="not run the same seeds of infinity, nominal"):
        aggregate.leaderboard(results(lines, tmp_path))


def test_the_page_shows_the_figures_that_were_drawn(tmp_path):
    def draw(board, folder):
        return [folder / "scores.png"]

    for drawn, shown in ((draw, True), (None, False), (lambda board, folder: [], False)):
        aggregate.write_leaderboard(results([line()], tmp_path), tmp_path, "tlf bench", drawn)
        page = (tmp_path / "leaderboard.md").read_text()
        assert ("![Scores](scores.png)" in page) == shown
        assert "Made by `tlf bench`" in page


def test_what_is_undefined_is_a_dash():
    assert page.number(None, 1) == page.number(math.nan, 1) == "–"
    assert page.number(1.26, 1) == "1.3"
    assert page.span([1.26, 2], 1) == "[1.3, 2.0]"
    assert page.span(None, 1) == ""
