"""How much of a slip the encoders show, against the table of docs/controller/slip-estimator.md."""

from __future__ import annotations

import functools

import numpy as np
import pytest
from page_tables import numbers_in, rows_of

from tlf_env.engine.formation import Formation
from tlf_env.onboard.slip_estimator import SlipEkfParameters
from tlf_env.physics.parameters import RobotParameters
from tlf_env.task.scenario import load_scenario

R, L = RobotParameters().wheel_radius_mm, RobotParameters().axle_width_mm
FROM_MS, AFTER_MS = 3000, 1100
TIMES_MS = (1, 4, 50, 1000)
CASES = {
    "step of 10 mm/s": ((10.0, 0.0), 0),
    "step of 30 mm/s": ((30.0, 0.0), 0),
    "step of 60 mm/s": ((60.0, 0.0), 0),
    "step of −60 mm/s": ((-60.0, 0.0), 0),
    "step of 0.2 rad/s": ((0.0, 0.2), 0),
    "step of 0.4 rad/s": ((0.0, 0.4), 0),
    "60 mm/s within 0.2 s": ((60.0, 0.0), 200),
    "0.4 rad/s within 0.2 s": ((0.0, 0.4), 200),
}


@functools.cache
def wheel_twist(slip: tuple[float, float], ramp_ms: int) -> np.ndarray:
    """The wheels' forward speed (mm/s) and yaw rate (rad/s) at each millisecond, from the last before the slip.

    One robot, commanded 400 mm/s straight ahead; without noise an encoder's increment in a millisecond is
    the wheel's spin times that.
    """
    scenario = load_scenario(
        "infinity",
        robots=1,
        control_period_s=0.001,
        adversary=True,
        disturbance="none",
        end_on=(),
        horizon_s=6.0,
        time_gap_s=1.0,
        preview_s=(),
    )
    formation = Formation(scenario)
    formation.reset(0)
    twists = []
    for k in range(FROM_MS + AFTER_MS):
        share = 0.0 if k < FROM_MS else min((k - FROM_MS + 1) / max(ramp_ms, 1), 1.0)
        formation.impose(
            {"slip.delta_1_mm_s": share * slip[0], "slip.delta_2_rad_s": share * slip[1]}
        )
        formation.arrays.actions[0] = [[0.4, 0.0]]
        formation.step()
        motion = formation.named("motion")
        left, right = R * float(motion.omega_l[0]), R * float(motion.omega_r[0])
        twists.append(((left + right) / 2, (right - left) / L))
    return np.array(twists[FROM_MS - 1 :])


def shown(case: str) -> np.ndarray:
    """Share of the slip by which the wheels' twist has changed against it, in % at each millisecond."""
    slip, ramp_ms = CASES[case]
    axis = 0 if slip[0] else 1
    twist = wheel_twist(slip, ramp_ms)[:, axis]
    return -100.0 * (twist - twist[0]) / slip[axis]


PAGE = rows_of("controller/slip-estimator.md", "encoders")


def test_the_page_has_every_case():
    assert list(PAGE) == list(CASES)


@pytest.mark.parametrize("case", CASES)
def test_share_of_a_slip_that_the_encoders_show(case):
    """To a percentage point, and the largest share at any time."""
    measured = shown(case)
    quoted = numbers_in(" ".join(PAGE[case]))
    np.testing.assert_allclose([*measured[list(TIMES_MS)], measured.max()], quoted, atol=1.0)


def test_steady_slip_does_not_show():
    """The wheel loop holds the commanded speed: from 0.5 s on at most 6 % of any of these slips is left."""
    for case in CASES:
        assert np.abs(shown(case)[500:]).max() < 6.0, case


def test_a_ramp_is_slower_than_what_counts_as_a_jump():
    """Also from one end of the preset's range to the other within 0.2 s: the filter takes it as usual."""
    most = SlipEkfParameters()
    for slip, axis, limit in (
        ((120.0, 0.0), 0, most.most_acceleration_mm_s2),
        ((0.0, 0.8), 1, most.most_yaw_acceleration_rad_s2),
    ):
        ramp = np.diff(wheel_twist(slip, 200)[:, axis]) / 0.001
        step = np.diff(wheel_twist(slip, 0)[:, axis]) / 0.001
        assert np.abs(ramp).max() < limit < np.abs(step).max()
