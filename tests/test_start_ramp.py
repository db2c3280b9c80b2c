"""A leader's reference that starts from rest."""

from __future__ import annotations

import numpy as np
import pytest

import tlf_env
from baselines import ReferencePolicy
from baselines.runs.run import run_policy, run_seeds
from tlf_env.task.scenario import load_scenario, scenario_notes, scenario_warnings
from tlf_env.task.trajectories import reference_from, sample

RAMP_S = 6.0


@pytest.mark.parametrize("name", ["infinity", "flower", "circle"])
def test_the_reference_starts_at_rest_and_is_half_a_ramp_late_afterwards(name):
    trajectory = load_scenario(name).trajectory
    t_s = np.arange(0, 20, 1e-3)
    rows = reference_from(trajectory, t_s, RAMP_S)
    assert rows[0, 3] == rows[0, 4] == 0.0
    assert rows[0, :3] == pytest.approx(sample(trajectory, np.zeros(1))[0, :3])
    late = t_s >= RAMP_S
    assert rows[late] == pytest.approx(sample(trajectory, t_s[late] - RAMP_S / 2), abs=1e-6)
    # Its twist is the derivative of its pose throughout.
    speed = np.hypot(*np.gradient(rows[:, :2], t_s, axis=0).T)
    assert speed[2:-2] == pytest.approx(rows[2:-2, 3], abs=0.05)
    assert np.gradient(rows[:, 2], t_s)[2:-2] == pytest.approx(rows[2:-2, 4], abs=1e-3)
    # The speed grows without a jump: at most 1.5/ramp of the top speed in a second, and the path's own.
    assert np.abs(np.diff(rows[:, 3])).max() / 1e-3 < 1.5 / RAMP_S * rows[:, 3].max() + 250.0


def test_without_a_ramp_nothing_changes_and_a_phase_is_kept():
    trajectory = load_scenario("infinity").trajectory
    t_s = np.arange(0, 10, 0.02)
    assert (reference_from(trajectory, t_s) == sample(trajectory, t_s)).all()
    assert (reference_from(trajectory, t_s, 0.0, 7.0) == sample(trajectory, 7.0 + t_s)).all()
    ramped = reference_from(trajectory, t_s, 2.0, 7.0)
    assert ramped[0, :2] == pytest.approx(sample(trajectory, np.array([7.0]))[0, :2])


def test_the_papers_loop_has_no_start_to_recover_from():
    fields = {"horizon_s": 20.0, "disturbance": "nominal"}
    policy = ReferencePolicy("consistent")
    from_speed = run_policy(load_scenario("infinity", **fields), policy).metrics()
    scenario = load_scenario("infinity", start_ramp_s=RAMP_S, **fields)
    record = run_policy(scenario, policy)
    from_rest = record.metrics()
    assert from_speed[0].error_capped_mean_mm > 50.0
    assert max(one.error_capped_mean_mm for one in from_rest) < 10.0
    assert from_rest[0].time_to_10_mm_s is not None
    assert from_rest[0].time_to_10_mm_s <= from_speed[0].time_to_10_mm_s
    # The same reference everywhere: recorded, and on the batch plant.
    t_s = record.t_s
    assert record.leader == pytest.approx(reference_from(scenario.trajectory, t_s, RAMP_S)[:, :2])
    batch = next(iter(run_seeds(scenario, policy, [0])))
    assert (batch["x_mm"] == record["x_mm"]).all()


def test_a_ramp_takes_the_note_on_the_start_away():
    assert scenario_notes(load_scenario("infinity"))
    ramped = load_scenario("infinity", start_ramp_s=RAMP_S)
    assert not scenario_notes(ramped)
    assert not scenario_warnings(ramped)


def test_time_to_10_mm_counts_to_the_last_time_outside():
    from tlf_env.task.metrics import settling_time_s

    t_s = np.arange(6.0)
    error = np.array([50.0, 8.0, 12.0, 9.0, 1.0, 1.0])
    assert settling_time_s(t_s, error, 10.0) == 3.0
    assert settling_time_s(t_s, error) == 1.0
    assert settling_time_s(t_s, error, 0.5) is None


@pytest.mark.parametrize("bad", [-1.0, float("nan"), "soon"])
def test_a_bad_ramp_is_one_line(bad):
    with pytest.raises(ValueError, match="start_ramp_s") as caught:
        tlf_env.load_scenario("infinity", start_ramp_s=bad)
    assert "\n" not in str(caught.value)
