"""Envelopes: the search finds what trying every level finds, with fewer runs; its interval covers the truth."""

import json
import math
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import beta, lognorm

from baselines.benchmark import envelope_runs
from baselines.benchmark.envelope import (
    Counts,
    EnvelopePlan,
    Probe,
    allowed_failures,
    bracket,
    envelope,
    grid,
    knob_presets,
    load_knob,
    most_left,
    untested,
)
from baselines.benchmark.envelope_board import (
    envelope_board,
    sign_interval,
    text_of,
    write_envelope,
)
from baselines.benchmark.envelope_runs import EnvelopeResults, run_envelope, run_probe
from baselines.cli import main
from baselines.policies.registry import fit_policy
from baselines.runs.outcome import failed
from baselines.runs.run import run_seeds

PLAN = EnvelopePlan(
    ("reference:tuned", "kanayama"), ("infinity",), ("friction", "slip-yaw"), (20_000, 20_020)
)


def searched(found, counts, failures, cap=None):
    """The tested places and their failed seeds, as a run of the search finds them."""
    known, left = {}, None
    while places := untested(found, known, counts):
        assert left is None or most_left(found, known, counts) <= left
        left = most_left(found, known, counts) - len(places)
        for place in places:
            known[place] = failures(place) if cap is None else min(failures(place), cap)
    assert most_left(found, known, counts) == 0
    return known


@given(
    seeds=st.integers(1, 120),
    resolution=st.sampled_from([0.02, 0.05, 0.3]),
    spread=st.floats(0.01, 2.0),
    draw=st.integers(0, 2**32 - 1),
)
@settings(max_examples=25, deadline=None)
def test_the_search_finds_what_every_level_would(seeds, resolution, spread, draw):
    found, counts = grid((0.1, 12.0), resolution), allowed_failures(seeds)
    critical = np.exp(np.random.default_rng(draw).normal(0.0, spread, seeds))
    failures = np.searchsorted(np.sort(critical), found.levels, side="right").tolist()
    whole = envelope(found, dict(enumerate(failures)), counts)
    most = counts.held if counts.high is None else counts.high
    for cap in (None, most + 1):  # the levels may be left early
        known = searched(found, counts, failures.__getitem__, cap)
        assert envelope(found, known, counts) == whole
        assert set(found.first) <= set(known)
    holds = [
        level for level, number in zip(found.levels, failures, strict=True) if number <= counts.held
    ]
    assert whole.level == max(holds, default=None)
    assert whole.beyond == (len(holds) == len(found.levels))
    assert whole.holds_again == ()


@pytest.mark.parametrize("seeds", [1, 6, 20, 50, 71, 72, 100, 300])
def test_the_ends_are_those_of_the_exact_binomial_interval(seeds):
    """Clopper and Pearson's interval of the share that fails lies below 5 %, or above it."""
    counts, k = allowed_failures(seeds), np.arange(seeds + 1)
    high = np.where(k < seeds, beta.ppf(0.975, k + 1, np.maximum(seeds - k, 1)), 1.0)
    low = np.where(k > 0, beta.ppf(0.025, np.maximum(k, 1), seeds - k + 1), 0.0)
    assert counts.low == max(k[high < 0.05], default=None)
    assert counts.high == (min(k[low > 0.05]) - 1 if (low > 0.05).any() else None)
    assert counts.held / seeds <= 0.05 < (counts.held + 1) / seeds


def test_a_hundred_seeds_need_95_and_twenty_19():
    assert allowed_failures(100) == Counts(held=5, low=0, high=10)
    assert allowed_failures(20) == Counts(held=1, low=None, high=3)
    assert allowed_failures(71).low is None
    assert allowed_failures(72).low == 0


def test_the_interval_covers_the_level_that_95_percent_of_all_seeds_hold():
    found, counts = grid((0.02, 50.0), 0.02), allowed_failures(100)
    truth = lognorm(0.5).ppf(0.05)
    rng = np.random.default_rng(1)
    covered = 0
    for _ in range(200):
        critical = np.sort(rng.lognormal(0.0, 0.5, 100))
        failures = np.searchsorted(critical, found.levels, side="right")
        known = searched(found, counts, failures.__getitem__)
        made = envelope(found, known, counts)
        assert made.low <= made.level < made.high
        covered += made.low <= truth <= made.high
    assert covered >= 0.95 * 200  # 98.3 %, and a little more by the grid


@given(first=st.floats(1e-3, 10), ratio=st.floats(1.01, 1000), resolution=st.floats(1e-3, 1.0))
@settings(max_examples=60, deadline=None)
def test_a_grid_is_geometric_between_its_ends(first, ratio, resolution):
    found = grid((first, first * ratio), resolution)
    levels = np.array(found.levels)
    assert levels[[0, -1]] == pytest.approx([first, first * ratio], rel=1e-3)
    steps = np.diff(np.log(levels))
    assert np.ptp(steps) < 3e-3  # rounded to four digits
    assert steps.max() <= math.log1p(resolution) + 2e-3
    assert found.first[-1] == len(levels) - 1
    assert np.diff(np.log(levels[found.first])).max() <= math.log(2) + 2e-3


def test_a_level_that_holds_above_one_that_fails_is_reported():
    found, counts = grid((1.0, 8.0), 0.5), allowed_failures(20)
    assert found.levels == (1.0, 1.414, 2.0, 2.828, 4.0, 5.657, 8.0)
    failures = {0: 0, 1: 1, 2: 9, 4: 1, 6: 20}
    made = envelope(found, failures, counts)
    assert (made.level, made.beyond, made.high) == (1.414, False, 2.0)
    assert made.holds_again == (4.0,)
    assert bracket({0: 2}, 1, 7) == (-1, 0)
    assert envelope(found, {0: 2}, counts).level is None
    assert envelope(found, {0: 0, 6: 0}, counts).beyond


@pytest.mark.parametrize("name", knob_presets())
def test_shipped_knobs_run_on_the_infinity(name):
    knob = load_knob(name)
    for level in knob.levels:
        scenario = knob.scenario("infinity", level)
        assert scenario.disturbance.level == level
        if not knob.shown.startswith("tyre.patches") and knob.shown.count(".") == 1:
            assert scenario.disturbance.constant(knob.shown) == knob.value(level)
    assert knob.levels[0] < 1 < knob.levels[1]


def test_the_shown_number_is_the_one_of_the_disturbance():
    assert load_knob("friction").value(1.3) == pytest.approx(0.35)
    assert load_knob("patches").value(7 / 6) == pytest.approx(0.3)
    assert load_knob("slip-yaw").value(2.0) == 0.5
    assert load_knob("slip-jumps").value(0.5) == 30.0
    assert load_knob("calibration").value(2.0) == pytest.approx(1.04)
    assert load_knob("fix-noise").value(0.0) == math.sqrt(0.2)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (
            "disturbance: ice\nshown: tyre.friction_scale\nlevels: [2, 1]\n",
            "levels .* must increase",
        ),
        ("disturbance: ice\nshown: tyre.no\nlevels: [1, 2]\n", "shown 'tyre.no' must be the path"),
        ("disturbance: ice\nshown: tyre\nlevels: [1, 2]\n", "shown 'tyre' must be the path"),
        ("disturbance: nope\nshown: a\nlevels: [1, 2]\n", "disturbance 'nope' is not one of"),
        ("disturbance: {level: 2}\nshown: tyre.creep\nlevels: [1, 2]\n", "level 2 must be 1"),
        ("disturbance: ice\nshown: tyre.creep\n", "levels"),
        (
            "disturbance: ice\nshown: tyre.creep\nlevels: [0, 2]\n",
            "levels.0: .* greater than 0, got 0",
        ),
    ],
)
def test_a_wrong_knob_gives_one_line(tmp_path, text, said):
    file = tmp_path / "mine.yaml"
    file.write_text(text)
    with pytest.raises(ValueError, match=said) as caught:
        load_knob(str(file))
    assert "\n" not in str(caught.value)
    assert "mine.yaml" in str(caught.value)


def test_a_knob_may_name_a_disturbance_file_beside_it(tmp_path):
    (tmp_path / "wet.yaml").write_text("tyre: {friction_scale: 0.7}\n")
    file = tmp_path / "mine.yaml"
    file.write_text("disturbance: wet.yaml\nshown: tyre.friction_scale\nlevels: [0.5, 3]\n")
    assert load_knob(str(file)).value(2.0) == pytest.approx(0.4)


def test_runs_are_left_only_when_too_many_have_failed():
    scenario = load_knob("friction").scenario("infinity", 2.0, 10.0)
    fitted = fit_policy("kanayama", scenario)
    seeds = range(20_000, 20_003)
    whole = [record.metrics() for record in run_seeds(fitted.scenario, fitted.policy, seeds)]
    assert all(map(failed, whole))
    kept = run_seeds(fitted.scenario, fitted.policy, seeds, most_failed=3)
    assert [record.metrics() for record in kept] == whole
    assert not list(run_seeds(fitted.scenario, fitted.policy, seeds, most_failed=2))
    plan = EnvelopePlan(
        ("kanayama",), ("infinity",), ("friction",), (20_000, 20_003), horizon_s=10.0
    )
    assert plan.counts == (0, None, 1)
    line = run_probe(plan, Probe("kanayama", "infinity", "friction", 2.0))
    assert (line["failed"], line["stopped"]) == (2, True)
    assert line["position_rmse_mm"] is None
    easy = run_probe(plan, Probe("reference:tuned", "infinity", "friction", 0.2))
    assert (easy["failed"], easy["stopped"]) == (0, False)
    knob = load_knob("friction").scenario("infinity", 0.2, 10.0)
    tuned = fit_policy("reference:tuned", knob)
    runs = [one.metrics() for one in run_seeds(tuned.scenario, tuned.policy, seeds)]
    for metric, of_run in (
        ("position_rmse_mm", lambda run: max(one.position_rmse_mm for one in run)),
        ("torque_rms_Nmm", lambda run: max(one.torque_rms_Nmm for one in run)),
        ("time_gap_rmse_s", lambda run: max(one.time_gap_rmse_s for one in run[1:])),
        ("energy_J", lambda run: run[0].energy_J + run[1].energy_J + run[2].energy_J),
    ):
        assert easy[metric] == pytest.approx(sorted(map(of_run, runs))[1])
        assert line[metric] is None


def test_the_usual_level_is_the_last_coarse_one_up_to_1():
    found = grid((0.2, 2.0), 0.05)
    coarse = [found.levels[i] for i in found.first]
    assert found.usual in coarse
    assert found.usual <= 1 < coarse[coarse.index(found.usual) + 1]
    assert grid((1.5, 3.0), 0.05).usual == 1.5


def made_up(plan, probe):
    """A line without a run: the systems fail at levels of their own."""
    ends = {"reference:tuned": 1.5, "kanayama": 0.6}
    most = plan.counts.high
    lost = 0 if probe.level < ends[probe.policy] else most + 1
    return {
        **probe._asdict(), "failed": lost, "stopped": lost > 0, "privileged": False,
        "overrides": {}, "seconds": 36.0,
    }  # fmt: skip


def lines_in(folder: Path) -> int:
    return len((folder / "levels.jsonl").read_text().splitlines())


def test_it_goes_on_where_it_was_interrupted(tmp_path, monkeypatch):
    monkeypatch.setattr(envelope_runs, "run_probe", made_up)
    whole = run_envelope(PLAN, tmp_path / "whole")
    tested = []

    def breaks(plan, probe):
        tested.append(probe)
        if len(tested) in (7, 20):
            raise RuntimeError
        return made_up(plan, probe)

    monkeypatch.setattr(envelope_runs, "run_probe", breaks)
    for _ in range(2):
        with pytest.raises(RuntimeError):
            run_envelope(PLAN, tmp_path / "broken")
    path = tmp_path / "broken" / "levels.jsonl"
    path.write_bytes(path.read_bytes()[:-10])  # as a power cut leaves it
    seen = []
    again = run_envelope(PLAN, tmp_path / "broken", progress=lambda *done: seen.append(done))
    assert again.lines == whole.lines
    assert len(tested) == len(whole.lines) + 3  # two broken, one torn
    assert lines_in(tmp_path / "broken") == len(whole.lines)
    assert seen[-1] == (len(whole.lines), len(whole.lines))
    assert envelope_board(again) | {"plan": 0} == envelope_board(whole) | {"plan": 0}
    other = replace(PLAN, resolution=0.1)
    with pytest.raises(ValueError, match="holds envelopes with a different 'plan'"):
        EnvelopeResults(tmp_path / "whole", other)


def test_levels_are_drawn_while_answers_are_missing(tmp_path):
    """As from several processes: two jobs in flight, and the later one is answered first."""
    results = EnvelopeResults(tmp_path, PLAN)
    ready = envelope_runs._Ready(results)
    flying = []
    while True:
        flying += [probe for probe in [next(ready, None) for _ in range(2 - len(flying))] if probe]
        if not flying:
            break
        results.add(made_up(PLAN, flying.pop()))
    assert not any(map(results.untested, PLAN.searches()))
    assert lines_in(tmp_path) == len(results.lines)  # no level twice


def test_the_score_is_the_geometric_mean_of_the_levels(tmp_path, monkeypatch):
    monkeypatch.setattr(envelope_runs, "run_probe", made_up)
    results = run_envelope(PLAN, tmp_path)
    board = write_envelope(results, tmp_path, "tlf bench --envelope")
    assert json.loads((tmp_path / "envelope.json").read_text()) == board
    best, other = board["policies"]
    assert (best["policy"], other["policy"]) == ("reference:tuned", "kanayama")
    levels = [cell["level"] for cell in board["cells"] if cell["policy"] == "reference:tuned"]
    assert best["score"] == pytest.approx(math.sqrt(math.prod(levels)))
    assert all(1.5 / 1.05 <= level < 1.5 for level in levels)
    (row,) = board["comparisons"]
    assert row["ratio"] == pytest.approx(0.6 / 1.5, rel=0.05)
    assert (row["smaller"], row["larger"], row["interval"]) == (2, 0, None)
    assert board["processor_hours"] == pytest.approx(len(results.lines) / 100)
    assert (
        text_of(board["cells"][0] | {"level": None, "holds_again": [1.0]}) == "none (0.9 fails) ↕"
    )
    assert "| `friction` | `tyre.friction_scale` | 0.5 |" in (tmp_path / "envelope.md").read_text()


def test_a_knob_whose_first_level_fails_counts_with_it(tmp_path, monkeypatch):
    def fails(plan, probe):
        lost = 4 if probe.policy == "kanayama" else 0
        return made_up(plan, probe) | {"failed": lost}

    monkeypatch.setattr(envelope_runs, "run_probe", fails)
    board = envelope_board(run_envelope(PLAN, tmp_path))
    all_hold, none = board["policies"]
    assert (all_hold["beyond_last"], none["below_first"]) == (2, 2)
    assert none["score"] == pytest.approx(math.sqrt(0.2 * 0.05))
    assert all_hold["score"] == pytest.approx(math.sqrt(2.0 * 12.8))
    cells = [cell for cell in board["cells"] if cell["policy"] == "kanayama"]
    assert all(cell["level"] is None and cell["low"] is None for cell in cells)


def test_the_interval_of_a_median_has_the_order_statistics_of_the_sign_test():
    assert sign_interval([1.0, 2.0, 3.0, 4.0, 5.0]) is None  # 2/32 is more than 5 %
    assert sign_interval([1.0, 2.0, 3.0, 4.0, 5.0, 6.0]) == [1.0, 6.0]
    rng = np.random.default_rng(2)
    inside = 0
    for _ in range(400):
        low, high = sign_interval(sorted(rng.exponential(1.0, 18)))
        inside += low <= math.log(2) <= high
    assert 0.94 <= inside / 400 < 0.99  # exactly 0.969


def test_the_figure_is_drawn(tmp_path, monkeypatch):
    pytest.importorskip("matplotlib")
    from baselines.benchmark.envelope_figure import write_envelope_figure

    monkeypatch.setattr(envelope_runs, "run_probe", made_up)
    board = envelope_board(run_envelope(PLAN, tmp_path))
    (path,) = write_envelope_figure(board, tmp_path)
    assert path.read_bytes().startswith(b"\x89PNG")


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ("--sweep level=0:1:3", "--sweep level=0:1:3 does not go with --envelope"),
        ("--disturbances ice", "--disturbances ice does not go with"),
        ("--test", "--test cannot be used with --envelope"),
        ("--entry no_such_folder --knobs friction", "no_such_folder"),
        ("--plant pymunk", "--plant pymunk: --envelope runs on the plant batch"),
        ("--knobs no_such", "knob 'no_such' is not one of calibration"),
        ("--knobs friction --resolution 0", "resolution 0 must be 0.001 to 1"),
        ("--knobs friction --seeds 5", "seeds '5' must be FIRST:END"),
        ("--knobs friction --policies no_such", "policy 'no_such' is not one of"),
        ("--knobs friction --processes -1", "processes -1 must be at least 1"),
    ],
)
def test_wrong_options_end_in_one_line(words, said, tmp_path, monkeypatch, capsys):
    command = ["tlf", "bench", "--envelope", *words.split(), "--out", str(tmp_path / "out")]
    monkeypatch.setattr(sys, "argv", command)
    with pytest.raises(SystemExit) as ended:
        main()
    assert ended.value.code == 2
    said_so = capsys.readouterr().err.strip()
    assert said in said_so
    assert "\n" not in said_so
    assert not (tmp_path / "out").exists()
