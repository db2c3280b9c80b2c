"""The reference controller in the loop, against the table of an independent prototype.

Bounds are 1.5 times the settled RMS error of each robot there: what the pattern allows, not the third digit.
"""

from __future__ import annotations

import re

import numpy as np
import pytest
from helpers import TAIL_FROM, Run, drive
from page_tables import DOCS

from baselines import ReferencePolicy
from baselines.policies.registry import fit_policy
from baselines.runs.run import run_policy
from tlf_env.onboard.tracking import TrackingGains
from tlf_env.physics.parameters import RobotParameters
from tlf_env.task.scenario import load_scenario

SLACK = 1.5
WHOLE = RobotParameters()


def without_bending() -> RobotParameters:
    """The bending moment of the castor's steering joint left out of eq. (5)."""
    joint = WHOLE.steering_joint.model_copy(update={"bending": False})
    return WHOLE.model_copy(update={"steering_joint": joint})


def without_contact() -> RobotParameters:
    """Outlines so small that lost robots do not run into the others."""
    return WHOLE.model_copy(update={"outline_radius_mm": 1.0})


def with_trail(trail_mm: float) -> RobotParameters:
    """Another castor trail; the loads fix where the centre of mass then lies."""
    base_mm = WHOLE.castor_pivot_mm + trail_mm
    change = {"castor_trail_mm": trail_mm, "com_offset_mm": WHOLE.castor_load_share * base_mm}
    return RobotParameters(**{**WHOLE.model_dump(), **change})


def assert_within(run: Run, table_mm: tuple[float, ...]) -> None:
    assert not run.lost.any()
    assert not run.touched.any()
    assert np.all(run.rms_mm <= SLACK * np.array(table_mm)), run.rms_mm


# At the default control period of 20 ms


@pytest.mark.parametrize("seed", range(3))
def test_infinity_at_20_ms(seed):
    run = drive("infinity", seed=seed)
    assert_within(run, (2.7, 3.8, 5.3))
    assert run.rms_mm.max() <= 8.0


@pytest.mark.parametrize("seed", range(2))
def test_flower_at_20_ms(seed):
    run = drive("flower", seed=seed)
    assert_within(run, (0.9, 0.5, 0.5, 0.6, 0.8))
    assert run.rms_mm.max() <= 1.5


@pytest.mark.slow
def test_flower_at_20_ms_for_more_seeds():
    for seed in range(2, 12):
        run = drive("flower", seed=seed)
        assert_within(run, (0.9, 0.5, 0.5, 0.6, 0.8))
        assert run.rms_mm.max() <= 1.5


# The target is that every seed meets the bound. One of these misses it, as docs/controller/paper.md says: its
# last robot skids while it catches up, and the filter, which assumes no slip, loses the heading.
SEEDS, LOST_SEEDS = range(40), (15,)


@pytest.mark.slow
@pytest.mark.parametrize("seed", [k for k in SEEDS if k not in LOST_SEEDS])
def test_infinity_at_20_ms_holds_for_every_seed_but_one(seed):
    run = drive("infinity", seed=seed)
    assert not run.lost.any()
    assert_within(run, (2.7, 3.8, 5.3))
    assert run.rms_mm.max() <= 8.0


@pytest.mark.parametrize("seed", LOST_SEEDS)
def test_infinity_at_20_ms_loses_the_last_robot_of_one_seed(seed):
    """The others stay within the bound, and no robots touch."""
    run = drive("infinity", seed=seed)
    assert run.lost.tolist() == [False, False, True]
    assert not run.touched.any()
    assert np.all(run.rms_mm[:2] <= SLACK * np.array([2.7, 3.8]))


def test_the_page_names_the_lost_seeds():
    page = (DOCS / "controller" / "paper.md").read_text(encoding="utf-8")
    said = re.search(r"of seeds 0–399 are lost \(([\d,\s]+)\)", page)
    assert said is not None
    named = [int(seed) for seed in said[1].split(",")]
    assert tuple(seed for seed in named if seed in SEEDS) == LOST_SEEDS


def test_leader_peaks_near_470_mm_while_it_catches_up():
    run = drive("infinity", horizon_s=5.0)
    assert run.error_mm[:, 0].max() == pytest.approx(470, abs=30)
    assert np.argmax(run.error_mm[:, 0]) * 0.02 == pytest.approx(1.7, abs=0.3)


def test_errors_are_smaller_after_settling_than_before():
    run = drive("infinity")
    assert run.rms_between(0.4, 0.7)[0] < run.rms_between(0.0, 0.1)[0]
    assert np.abs(run.heading_error_rad[2000:]).max() < 0.2


def test_infinity_with_more_heading_damping():
    """k₂ = 2·k₃."""
    run = drive("infinity", TrackingGains(k_2_mm2_s=2 * 12e3))
    assert_within(run, (2.7, 3.2, 3.6))


@pytest.mark.slow
def test_flower_with_more_heading_damping():
    run = drive("flower", TrackingGains(k_2_mm2_s=2 * 12e3))
    assert_within(run, (0.6, 0.4, 0.4, 0.4, 0.5))


@pytest.mark.parametrize(("slip", "table_mm"), [("delta_1_mm_s", 18), ("delta_2_rad_s", 10)])
def test_constant_slip_with_the_true_pose_costs_what_it_did_in_the_study(slip, table_mm):
    """k₂ = 2·k₃, 5 mm/s or 0.2 rad/s. With k₂ = 0.83·k₃ each loses a robot."""
    amount = {"delta_1_mm_s": 5.0, "delta_2_rad_s": 0.2}[slip]
    given = {"disturbance": {"slip": {slip: amount}}, "estimator": "truth", "horizon_s": 60.0}
    scenario = load_scenario("infinity", plant="batch", **given)
    worst_mm = {}
    for ratio in (2.0, 0.83):
        policy = ReferencePolicy(TrackingGains(k_2_mm2_s=ratio * 12e3))
        error_mm = run_policy(scenario, policy, 20_000)["position_error_mm"]
        worst_mm[ratio] = np.sqrt(np.mean(error_mm[2100:] ** 2, axis=0)).max()
    assert worst_mm[2.0] == pytest.approx(table_mm, rel=0.1)
    assert worst_mm[0.83] > 100


# At 50 ms


def test_flower_holds_at_50_ms():
    assert_within(drive("flower", control_period_s=0.05), (1.2, 0.5, 0.6, 0.7, 0.8))


@pytest.mark.parametrize("seed", range(3))
def test_infinity_loses_a_follower_at_50_ms_while_the_leader_holds(seed):
    run = drive("infinity", seed=seed, control_period_s=0.05, robot=without_contact())
    assert run.lost[1:].any()
    assert run.lost[2]
    assert run.rms_mm[0] <= SLACK * 5


# At 1 ms


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(2))
def test_infinity_at_1_ms(seed):
    assert_within(drive("infinity", seed=seed, control_period_s=0.001), (1.4, 2.7, 3.7))


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(2))
def test_flower_at_1_ms(seed):
    run = drive("flower", seed=seed, control_period_s=0.001)
    assert_within(run, (0.8, 0.5, 0.5, 0.5, 0.6))


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(2))
def test_printed_gains_hold_the_flower_at_1_ms(seed):
    run = drive("flower", "printed", seed, control_period_s=0.001)
    assert_within(run, (13, 11, 11, 10, 10))
    assert run.rms_mm.min() > 13 / SLACK / 2  # many times what the consistent gains leave


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(2))
def test_printed_gains_lose_infinity_at_1_ms(seed):
    run = drive("infinity", "printed", seed, control_period_s=0.001, robot=without_contact())
    assert run.lost.any()


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(2))
def test_printed_gains_hold_at_1_ms_without_the_castors_bending(seed):
    easy = {"control_period_s": 0.001, "robot": without_bending()}
    assert_within(drive("infinity", "printed", seed, **easy), (4, 5, 6))
    assert_within(drive("flower", "printed", seed, **easy), (2.3, 0.7, 0.7, 0.7, 0.9))


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(2))
def test_printed_gains_hold_infinity_at_1_ms_with_a_short_trail(seed):
    run = drive("infinity", "printed", seed, control_period_s=0.001, robot=with_trail(5.0))
    assert_within(run, (13, 10, 9))


# What the loop does not survive


@pytest.mark.slow
@pytest.mark.parametrize("disturbance", ["slip", "noise", "ice"])
def test_infinity_is_lost_under_what_the_filter_does_not_know(disturbance):
    """δ₁ = 20 mm/s; fixes of 2 mm standard deviation; half the tyre friction."""
    nominal = {"position": {"noise_std_mm": 0.2**0.5}}
    channels = {
        "slip": {**nominal, "slip": {"delta_1_mm_s": 20.0}},
        "noise": {"position": {"noise_std_mm": 2.0}},
        "ice": {**nominal, "tyre": {"friction_scale": 0.5}},
    }
    for seed in range(4):
        run = drive(
            "infinity",
            seed=seed,
            disturbance=channels[disturbance],
            robot=without_contact(),
            horizon_s=60.0,
        )
        assert run.lost.any()


@pytest.mark.slow
def test_more_grip_loses_nothing():
    grip = {"position": {"noise_std_mm": 0.2**0.5}, "tyre": {"friction_scale": 1.5}}
    for seed in range(4):
        assert not drive("infinity", seed=seed, disturbance=grip, horizon_s=60.0).lost.any()


@pytest.mark.slow
def test_scattered_starts_lose_the_filter_and_not_the_law():
    """Start poses off by 80 mm and 0.3 rad: lost with the filter, recovered with the true pose."""
    scattered = {"start": {"position_std_mm": 80.0, "heading_std_rad": 0.3}}
    off = {"disturbance": scattered, "robot": without_contact(), "horizon_s": 60.0}
    filtered = [drive("infinity", seed=seed, **off) for seed in range(10)]
    assert sum(run.lost.any() for run in filtered) >= 8
    for seed in range(10):
        run = drive("infinity", seed=seed, estimator="truth", **off)
        assert run.rms_between(0.7).max() < 100


# Under disturbances, ∞ for 60 s: the tuned controller on its estimate of the slip, and the paper's

# RMS position error of the worst robot in the last 30 %, mm: the smallest figure that `tuned` has had here,
# the largest of seeds 0 to 2. The test allows 1.5 times as much.
TUNED_RMS_MM = {
    "nominal": 0.7,
    "slip": 2.5,
    "noise": 0.9,
    "ice": 0.4,
    "start": 0.7,
    "combined-hard": 2.5,
    "radio": 2.0,
    "actuator": 0.9,
}


def disturbed(policy: str, disturbance: str, seed: int) -> tuple[float, bool, bool]:
    """Error in the tail (mm) of the worst robot; whether any was lost, and whether any touched."""
    entry = fit_policy(policy, load_scenario("infinity", horizon_s=60.0, disturbance=disturbance))
    record = run_policy(entry.scenario, entry.policy, seed)
    tail = record["position_error_mm"][int(TAIL_FROM * len(record.t_s)) :]
    robots = record.metrics()
    return (
        float(np.sqrt(np.mean(tail**2, axis=0)).max()),
        any(robot.lost for robot in robots),
        any(robot.touched for robot in robots),
    )


@pytest.mark.parametrize(
    "seed", [0, pytest.param(1, marks=pytest.mark.slow), pytest.param(2, marks=pytest.mark.slow)]
)
@pytest.mark.parametrize("disturbance", list(TUNED_RMS_MM))
def test_the_tuned_reference_loses_nobody(disturbance, seed):
    rms_mm, lost, touched = disturbed("reference:tuned", disturbance, seed)
    assert not lost
    assert not touched
    assert rms_mm <= SLACK * TUNED_RMS_MM[disturbance]


@pytest.mark.parametrize("seed", [0, pytest.param(1, marks=pytest.mark.slow)])
@pytest.mark.parametrize(
    ("task", "own_mm", "formation_mm"), [("infinity", 1.7, 5.0), ("flower", 0.4, 2.0)]
)
def test_the_tuned_reference_is_precise_where_nothing_disturbs(task, own_mm, formation_mm, seed):
    """Worst robot from 40 % of the horizon on."""
    entry = fit_policy("reference:tuned", load_scenario(task))
    robots = run_policy(entry.scenario, entry.policy, seed).metrics()
    assert max(robot.position_rmse_mm for robot in robots) <= own_mm
    assert max(robot.settled_formation_rmse_mm for robot in robots) <= formation_mm


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("disturbance", [name for name in TUNED_RMS_MM if name != "nominal"])
def test_the_papers_controller_loses_somebody_in_each_of_them_but_the_nominal(disturbance, seed):
    assert disturbed("reference:consistent", disturbance, seed)[1]
