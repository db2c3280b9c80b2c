from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from tlf_env.physics.openloop import COLUMNS, load_scenarios, run_open_loop

GOLDEN = Path(__file__).parent / "golden"
SCENARIOS = load_scenarios(GOLDEN / "scenarios.json")
SPEED_COLUMNS = [COLUMNS.index(name) for name in ("forward_mm_s", "right_mm_s")]
RATE_COLUMNS = [COLUMNS.index(name) for name in ("yaw_rad_s", "omega_l_rad_s", "omega_r_rad_s")]
GOLDEN_STEP_S = 1e-5
# Largest error at 1 ms: position as a share of the path, then heading in rad.
EXPECTED = {
    "straight": (0.004e-2, 1e-9),
    "straight_nojf": (0.025e-2, 1e-9),
    "coast": (0.064e-2, 0.005),
    "skid": (0.041e-2, 0.005),
    "spin": (0.49e-2, 0.005),
}


def golden(name: str) -> np.ndarray:
    path = GOLDEN / f"{name}.csv"
    assert path.read_text().splitlines()[0] == ",".join(COLUMNS)
    return np.loadtxt(path, delimiter=",", skiprows=1)


def path_length(rows: np.ndarray) -> float:
    return float(np.hypot(*np.diff(rows[:, 1:3], axis=0).T).sum())


def position_error(name: str, dt_s: float) -> float:
    """Largest over all rows, as a share of the path."""
    wanted, got = golden(name), run_open_loop(SCENARIOS[name], dt_s=dt_s)
    assert np.array_equal(got[:, 0].round(9), wanted[:, 0])
    return float(np.hypot(*(got - wanted)[:, 1:3].T).max()) / path_length(wanted)


def test_every_scenario_has_a_golden_run():
    assert set(SCENARIOS) == set(EXPECTED) == {path.stem for path in GOLDEN.glob("*.csv")}
    for name, scenario in SCENARIOS.items():
        assert len(golden(name)) == round(scenario.duration_s / 0.1) + 1


@pytest.mark.parametrize("name", EXPECTED)
def test_position_and_heading_follow_the_golden_run_at_1_ms(name):
    wanted, got = golden(name), run_open_loop(SCENARIOS[name])
    assert position_error(name, 0.001) <= (0.01 if name == "spin" else 0.001)
    assert np.abs(got - wanted)[:, 3].max() <= EXPECTED[name][1]


@pytest.mark.parametrize("name", EXPECTED)
def test_position_error_at_1_ms_is_the_documented_one(name):
    assert position_error(name, 0.001) == pytest.approx(EXPECTED[name][0], rel=0.05)


@pytest.mark.parametrize("name", EXPECTED)
def test_velocities_and_castor_follow_the_golden_run_at_1_ms(name):
    wanted, got = golden(name), run_open_loop(SCENARIOS[name])
    error = np.abs(got - wanted)
    assert error[:, SPEED_COLUMNS].max() < 1.5
    assert error[:, RATE_COLUMNS].max() < 0.05
    assert error[:, COLUMNS.index("castor_rad")].max() < 0.015


@pytest.mark.parametrize("name", EXPECTED)
def test_error_is_of_first_order_in_the_step(name):
    rows_per_output = [100, 125, 160, 200, 250, 320, 400, 500, 625, 800]
    steps = np.array([0.1 / n for n in rows_per_output])
    errors = [position_error(name, dt_s) for dt_s in steps]
    order = np.polyfit(np.log(steps - GOLDEN_STEP_S), np.log(errors), 1)[0]
    assert 0.85 < order < 1.15


# Not `skid`: its tyres catch twice, and where within a substep they do moves error/step up or down
# by a seventh; the test above sees through that.
@pytest.mark.parametrize("name", [name for name in EXPECTED if name != "skid"])
def test_half_the_step_halves_the_error(name):
    errors = np.array([position_error(name, dt_s) for dt_s in (0.001, 0.0005, 0.00025)])
    ratios = errors[:-1] / errors[1:]
    assert ((ratios > 1.7) & (ratios < 2.4)).all()
