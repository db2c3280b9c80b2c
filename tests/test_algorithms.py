"""The comparison of algorithms: what is driven again, its table and what the page says of it."""

from __future__ import annotations

import importlib
import json
import sys
from pathlib import Path

import pytest

pytest.importorskip("arch")
pytest.importorskip("matplotlib")

from tlf_env.common.presets import preset_names

DOCS = Path(__file__).parent.parent / "docs"
sys.path.insert(0, str(DOCS / "figures"))
algorithms = importlib.import_module("make_algorithms")

PAGE = (DOCS / "learning.md").read_text("utf-8")
SECTION = PAGE.split("## Algorithms\n")[1].split("\n## ")[0]
TEXT = " ".join(SECTION.split())
ROWS = json.loads((DOCS / "learning" / "algorithms.json").read_text("utf-8"))
CURVE = {
    "evaluations": [
        {"robot_steps": 0, "score_mm": 1000.0, "failed": 10},
        {"robot_steps": 500_000, "score_mm": 0.5, "failed": 0},
    ],
    "wall_time_s": 600.0,
    "evaluated_at_s": [30.0, 150.0],
}


def trained(folder: Path, name: str, seed: int, weights: bytes, **curve) -> None:
    """Files of a training with one seed."""
    place = folder / name / f"seed_{seed}"
    place.mkdir(parents=True, exist_ok=True)
    (place / algorithms.POLICY_FILE).write_bytes(weights)
    (place / algorithms.CARD_FILE).write_text('{"algorithm": "SAC"}')
    (place / algorithms.CURVE_FILE).write_text(json.dumps({**CURVE, "seed": seed, **curve}))


def test_only_what_is_new_is_driven(tmp_path):
    driven = []

    def judge(policy: str, seeds: range) -> dict[str, dict[str, list]]:
        driven.append((policy, seeds))
        one = {"rms_mm": [float(seed) for seed in seeds], "failed": [seeds[0]]}
        return dict.fromkeys(algorithms.CELLS, one)

    def again(kept, folder=tmp_path, runs=3):
        driven.clear()
        return algorithms.judged_anew(kept, folder, runs, judge)

    def names() -> list[str]:
        return ["/".join(Path(policy).parts[-3:-1]) for policy, _ in driven]

    trained(tmp_path, "scratch", 0, b"a")
    trained(tmp_path, "scratch", 1, b"b")
    trained(tmp_path, "unknown", 0, b"c")
    trained(tmp_path, "scratch", 2, b"unfinished", config={"robot_steps": 500_001})
    first = again([])
    assert [(row["name"], row["seed"]) for row in first] == [
        (algorithms.DEFAULT, 0),
        ("scratch", 0),
        ("scratch", 1),
    ]
    assert len(driven) == 3
    assert again(first) == first
    assert not driven
    trained(tmp_path, "sac-scratch", 2, b"d")
    second = again(first)
    assert [row["cells"] for row in second[:3]] == [row["cells"] for row in first]
    assert names() == ["sac-scratch/seed_2"]
    assert again(second, tmp_path / "nothing") == second  # trained on another machine
    assert not driven
    trained(tmp_path, "scratch", 1, b"other")
    third = again(second)
    assert names() == ["scratch/seed_1"]
    more = again(third, runs=5)
    assert len(driven) == 4
    assert {seeds for _, seeds in driven} == {range(20_003, 20_005)}
    for row in more:
        assert row["runs"] == 5
        for cell in row["cells"].values():
            assert cell["rms_mm"] == [20_000, 20_001, 20_002, 20_003, 20_004]
            assert cell["failed"] == [20_000, 20_003]
    assert again(more, runs=3) == more


def test_minutes_are_those_of_the_processor_after_the_start():
    found = algorithms.about_training(CURVE)
    assert (found["robot_steps"], found["minutes"]) == (500_000, 2.0)
    assert found["course"] == [[0, 1000.0, 10, 0.0], [500_000, 0.5, 0, 2.0]]
    clock = {name: value for name, value in CURVE.items() if name != "evaluated_at_s"}
    found = algorithms.about_training(clock)
    assert found["minutes"] == 10.0
    assert [at for *_, at in found["course"]] == [None, None]


def test_a_row_shows_medians_ranges_and_failures():
    def row(seed: int, rms_mm: list[float], failed: list[int]) -> dict:
        cell = {"rms_mm": rms_mm, "failed": failed}
        cells = dict.fromkeys(algorithms.CELLS, cell)
        about = algorithms.about_training(CURVE)
        return {"name": "scratch", "seed": seed, "runs": len(rms_mm), "cells": cells, **about}

    one, other = row(0, [0.1, 0.2, 900.0], [20_002]), row(1, [0.5, 0.6, 0.7], [])
    assert algorithms.shown([one, other], "`slip`") == "0.50 [0.15–0.60] (1)"
    assert algorithms.shown([other], "`slip`") == "0.60"
    lost = row(2, [900.0] * 3, [20_000, 20_001, 20_002])
    assert algorithms.shown([one, other, lost], "`slip`") == "0.50 [0.15–0.60] (4)"
    assert algorithms.shown([one, lost], "`slip`") == "(4)"
    line = algorithms.judged_table([one, other]).splitlines()[-1]
    assert line.startswith("| PPO, `scratch` | 2 | 0.5 M | 2.0 | 0.50 [0.15–0.60] (1) |")
    assert line.endswith("| 6 of 36 |")


def test_the_table_is_that_of_the_kept_runs():
    text = algorithms.judged_table(ROWS)
    assert f"<!-- algorithms -->\n{text}\n<!-- end of algorithms -->" in SECTION


def test_every_row_drove_the_same_seeds():
    for row in ROWS:
        assert row["runs"] == ROWS[0]["runs"]
        assert list(row["cells"]) == list(algorithms.CELLS)
        for cell in row["cells"].values():
            assert len(cell["rms_mm"]) == row["runs"]
            assert set(cell["failed"]) <= {20_000 + k for k in range(row["runs"])}


def test_every_entry_of_tlf_train_names_a_preset():
    names = {entry.name for entry in algorithms.ENTRIES}
    assert {name for name in names if name.endswith("scratch")} <= set(preset_names("training"))


def test_the_default_has_the_kept_digits_when_it_drives_again():
    kept = ROWS[0]["cells"]["∞, nominal"]
    found = algorithms.drive(algorithms.DEFAULT, "infinity", "nominal", range(20_000, 20_002))
    assert found["rms_mm"] == kept["rms_mm"][:2]


# --- what the page says --------------------------------------------------------------------------

PPO, SAC = (algorithms.rows_of(ROWS, name) for name in ("scratch", "sac-scratch"))


def test_robot_steps_until_the_robots_are_held():
    assert len(SAC) == 3
    for row in SAC:
        assert all(failed == 0 for steps, _, failed, _ in row["course"][:-1] if steps > 120_000)
    scores = [f"{row['course'][-2][1]:.1f}" for row in SAC]
    assert {row["course"][-2][0] for row in SAC} == {202_752}
    assert f"after 0.20 M the three seeds have {scores[0]}, {scores[1]} and {scores[2]} mm" in TEXT
    first = [row["course"][1] for row in PPO]
    assert len(first) == 3
    scores = "{:.1f}, {:.1f} and {:.1f}".format(*(score for _, score, *_ in first))
    steps = first[0][0] / 1e6
    assert f"PPO has {scores} mm at its first evaluation, after {steps:.2f} M" in TEXT


def test_minutes():
    minutes = sorted(row["minutes"] for row in SAC)[1]
    assert f"A training of SAC takes {minutes:.1f} minutes for an eighth of the robot" in TEXT
    assert 7 < PPO[0]["robot_steps"] / SAC[0]["robot_steps"] < 9
    for row in PPO:
        _, score, _, after = row["course"][2]
        assert after < 1.55 < minutes
        assert score == pytest.approx(1.0, abs=0.2)
    assert "After 1.5 minutes PPO has about 1 mm" in TEXT


def test_ppo_is_more_precise():
    default = algorithms.rows_of(ROWS, algorithms.DEFAULT)
    for cell in algorithms.CELLS:
        ppo, sac, base = (algorithms.median_mm(rows, cell) for rows in (PPO, SAC, default))
        assert ppo < 0.5 * sac
        assert sac > base
        assert (ppo < base) == (cell != "`slip`")


def test_a_training_that_broke_keeps_its_best_policy():
    assert [row["course"][-1][2] for row in SAC] == [0, 0, 8]
    best = min(score for _, score, *_ in SAC[2]["course"])
    assert best == SAC[2]["course"][-2][1]
    assert f"Seed 2 had {best:.1f} mm at its last evaluation but one, and lost all 8" in TEXT
