import json
import os
from pathlib import Path

import numpy as np
import pytest

from baselines.speed import environments, parts, speed
from baselines.speed.environments import ALONE, MPE2, VECTOR, VMAS
from baselines.speed.moments import DRIVEN, Moments
from tlf_env import BatchPlant, load_scenario
from tlf_env.engine.arrays import make_arrays, padded
from tlf_env.engine.formation import reference_table
from tlf_env.envs.vector import FormationVectorEnv
from tlf_env.task.actions import REFERENCE

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
    usual = load_scenario("infinity").disturbance
    for fields in environments.SPECIAL.values():
        assert load_scenario("infinity", **fields).disturbance != usual


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
