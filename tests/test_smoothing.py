"""Smoothed broadcasts: exact on exact fixes, better than raw ones on noisy fixes, on where there is room."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from baselines import ReferencePolicy
from tlf_env import BatchPlant, load_scenario, parallel_env
from tlf_env.engine.arrays import Arrays
from tlf_env.numerics.angles import wrap

HALF_S = 0.1


class Driven:
    """A run on the ∞ with the true path of each robot, and the messages about it as they were last sent."""

    def __init__(self, seconds: float = 12.0, gains: str = "tuned", **options: Any) -> None:
        options = {"estimator": "ekf-slip", "horizon_s": seconds, "end_on": ()} | options
        self.env = parallel_env("infinity", **options)
        policy = ReferencePolicy(gains)
        seen, _ = self.env.reset(seed=4)
        poses, self.dropped = [], []
        while self.env.agents:
            actions = policy.predict(np.stack(list(seen.values())))[0]
            seen, *_ = self.env.step(dict(zip(self.env.agents, actions, strict=True)))
            truth = self.env.formation.info()
            poses.append([truth.x_mm.copy(), truth.y_mm.copy(), truth.theta_rad.copy()])
        self.poses = np.array(poses)
        self.period_s = self.env.formation.scenario.control_period_s

    @property
    def arrays(self) -> Arrays:
        return self.env.formation.arrays

    def sent(self, age_steps: int) -> np.ndarray:
        """Messages of some steps ago, (field, robot)."""
        step = len(self.poses) - age_steps
        return self.arrays.messages[:, step % self.arrays.messages.shape[1], :, 0]

    def errors(self, ages: range) -> np.ndarray:
        """RMS errors of the leader: position (mm), heading (rad), speed (mm/s), yaw rate (rad/s)."""
        found = []
        for age in ages:
            x, y, theta, u_1, u_2 = self.sent(age)
            before, then, after = self.poses[-age - 2 : -age + 1] if age > 1 else (None,) * 3
            moved = (after[:2] - before[:2]) / (2 * self.period_s)
            speed = np.cos(then[2]) * moved[1] - np.sin(then[2]) * moved[0]
            rate = (after[2] - before[2]) / (2 * self.period_s)
            off = [wrap(value) for value in theta - then[2]]
            found.append([np.hypot(x - then[0], y - then[1]), off, u_1 - speed, u_2 - rate])
        return np.sqrt((np.array(found)[:, :, :1] ** 2).mean(axis=(0, 2)))


SLIPPING = {"slip": {"delta_2_rad_s": {"type": "sine", "amplitude": 0.25, "frequency_hz": 1.0}}}
AGES = range(40, 200)  # from 0.8 s on


def test_by_default_it_is_a_tenth_of_a_second():
    usual, given = Driven(2.0), Driven(2.0, broadcast_smoothing_s=HALF_S)
    assert (usual.arrays.messages == given.arrays.messages).all()
    assert load_scenario("infinity").smoothing_s == HALF_S


def test_without_it_nothing_is_kept():
    env = parallel_env("infinity", broadcast_smoothing_s=0.0)
    env.reset(seed=0)
    assert env.formation.arrays.ways.shape[1] == 0


@pytest.mark.parametrize(
    ("fields", "steps"),
    [
        ({}, 5),
        ({"control_period_s": 0.04, "preview_s": (0.4,)}, 2),  # 0.1 s, rounded
        ({"control_period_s": 0.001, "horizon_s": 1.0}, 100),
        ({"control_period_s": 0.25}, 0),
        ({"time_gap_s": 1.22}, 5),  # 1 s of preview, 10 + 1 control periods
        ({"time_gap_s": 1.2}, 4),
        ({"time_gap_s": 1.04}, 0),
        ({"time_gap_s": 1.0}, 0),
        ({"time_gap_s": 1.0, "preview_s": (0.5,)}, 5),
        ({"time_gap_s": 1.22, "disturbance": {"position": {"delay_s": 0.05}}}, 3),
    ],
)
def test_by_default_it_is_as_long_as_there_is_room(fields, steps):
    scenario = load_scenario("infinity", **fields)
    assert scenario.smoothing_steps == steps
    found_s = scenario.smoothing_s
    assert found_s == pytest.approx(steps * scenario.control_period_s)
    assert load_scenario(scenario, broadcast_smoothing_s=found_s).smoothing_steps == steps
    if 0 < steps < round(0.1 / scenario.control_period_s):
        longer_s = found_s + scenario.control_period_s
        with pytest.raises(ValueError, match="makes broadcasts"):
            load_scenario("infinity", **fields, broadcast_smoothing_s=longer_s)


def test_a_batch_has_one_length_for_all_its_formations():
    late = {"position": {"delay_s": 0.05}}
    alone = {"time_gap_s": 1.22, "robots": 1}
    scenarios = [load_scenario(**alone), load_scenario(**alone, disturbance=late)]
    with pytest.raises(ValueError, match=r"scenario 1: broadcasts are smoothed over ±3 control pe"):
        BatchPlant(scenarios, 2)
    assert BatchPlant(scenarios, 2, broadcast_smoothing_s=0.06).scenario.smoothing_steps == 3


def test_on_exact_fixes_and_wheels_that_roll_the_message_is_the_truth():
    run = Driven(broadcast_smoothing_s=HALF_S, disturbance="none")
    position, heading, speed, rate = run.errors(AGES)
    assert position < 0.05
    assert heading < 3e-3  # the tyres' side slip
    assert speed < 0.5
    assert rate < 0.03


def test_under_fast_slip_smoothed_broadcasts_are_several_times_better():
    raw, smoothed = (
        Driven(disturbance=SLIPPING, broadcast_smoothing_s=half).errors(AGES)
        for half in (0.0, HALF_S)
    )
    assert (smoothed < 0.7 * raw).all()


def test_the_newest_message_is_not_changed():
    off, on = (Driven(2.0, broadcast_smoothing_s=half) for half in (0.0, HALF_S))
    # Followers have moved on smoothed references by then; the leader has not.
    assert (off.sent(0)[:, 0] == on.sent(0)[:, 0]).all()
    assert (off.sent(9)[:, 0] == on.sent(9)[:, 0]).all()
    assert (off.sent(11)[:, 0] != on.sent(11)[:, 0]).any()


def test_late_fixes_are_counted_at_their_own_time():
    late = {"position": {"delay_s": 0.05, "noise_std_mm": 0.0}}
    run = Driven(broadcast_smoothing_s=HALF_S, disturbance=late)
    assert run.errors(AGES)[0] < 0.1


def test_too_few_fixes_leave_the_raw_message():
    seldom = {"position": {"period_s": 0.5}}
    off, on = (
        Driven(3.0, broadcast_smoothing_s=half, disturbance=seldom) for half in (0.0, HALF_S)
    )
    for age in AGES[:100]:
        assert (off.sent(age)[:, 0] == on.sent(age)[:, 0]).all()


def test_a_lost_broadcast_smooths_nothing():
    lost = {"radio": {"dropout": 0.999}}
    off, on = (Driven(3.0, broadcast_smoothing_s=half, disturbance=lost) for half in (0.0, HALF_S))
    for age in range(120):
        assert (off.sent(age) == on.sent(age)).all()


def test_the_true_state_is_sent_as_it_is():
    off, on = (Driven(2.0, estimator="truth", broadcast_smoothing_s=half) for half in (0.0, HALF_S))
    assert (off.arrays.messages == on.arrays.messages).all()


@pytest.mark.parametrize(
    ("fields", "match"),
    [
        ({"broadcast_smoothing_s": 0.11}, "broadcast_smoothing_s 0.11 must be a multiple"),
        (
            {"broadcast_smoothing_s": 2.5},
            "makes broadcasts 5.02 s late; followers use them after 4",
        ),
        ({"broadcast_smoothing_s": -0.1}, "broadcast_smoothing_s"),
    ],
)
def test_a_window_that_does_not_fit_is_refused(fields, match):
    with pytest.raises(ValueError, match=match):
        load_scenario("infinity", **fields)
