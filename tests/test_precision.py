"""Substeps in single precision: close to those in double precision, and as repeatable."""

import numpy as np
import pytest

from tlf_env.engine.batch import BatchPlant
from tlf_env.engine.layout import ROWS, Kind
from tlf_env.task.actions import REFERENCE

# What drives the robots: it loses none in the undisturbed run.
STACK = {"residual_base": "tuned", "estimator": "ekf-slip", "broadcast_smoothing_s": 0.0}
STATES = [row.name for row in ROWS if row.kind is Kind.STATE]


def driven(formations=5, steps=0, **fields):
    """A plant whose robots follow the reference; ``precision`` and fields of the scenario."""
    plant = BatchPlant("infinity", formations, **{"end_on": (), **STACK, **fields})
    plant.reset(seed=0)
    plant.arrays.kinds[:] = REFERENCE
    go_on(plant, steps)
    return plant


def go_on(plant, steps):
    for _ in range(steps):
        plant.step(np.zeros(plant.arrays.actions.shape))


def places(plant):
    return np.stack([plant.info("x_mm"), plant.info("y_mm")])


@pytest.mark.parametrize("estimator", ["ekf", "ekf-slip", "ekf-gyro", "truth"])
def test_both_precisions_agree_at_first(estimator):
    double, single = (
        driven(precision=one, estimator=estimator, residual_base="consistent")
        for one in ("double", "single")
    )
    for plant in (double, single):
        go_on(plant, 10)  # 0.2 s
    assert np.abs(places(double) - places(single)).max() < 0.01  # mm
    for name in STATES:
        assert np.isfinite(single.arrays.rows(name)).all()


def test_errors_of_a_lap_are_the_same_in_both_precisions():
    rms = {}
    for precision in ("double", "single"):
        plant, squares = driven(16, 1000, precision=precision), []
        for _ in range(500):
            go_on(plant, 1)
            squares.append(plant.info("position_error_mm") ** 2)
        assert not plant.lost.any()
        rms[precision] = np.sqrt(np.mean(squares, axis=(0, 1)))
    np.testing.assert_allclose(rms["single"], rms["double"], rtol=0.02)


def test_a_substep_in_single_precision_is_that_in_double_precision_rounded():
    plant = driven(16, 600)
    single = driven(16, precision="single")
    for name, array in plant.arrays._asdict().items():
        getattr(single.arrays, name)[...] = array
    for one in (plant, single):
        go_on(one, 1)
    away = np.abs(places(plant) - places(single))
    assert 0.0 < away.max() < 1e-3  # mm, of 11 mm in a step


def test_far_from_the_origin_nothing_is_lost_by_rounding():
    far = [[1e6, -1e6, 0.0], [1e6 - 700.0, -1e6, 0.0], [1e6 - 1400.0, -1e6, 0.0]]
    double, single = (
        BatchPlant("infinity", 2, precision=one, end_on=(), action="twist")
        for one in ("double", "single")
    )
    for plant in (double, single):
        plant.reset(seed=0, options={"poses": far})
        for _ in range(100):
            plant.step(np.full(plant.arrays.actions.shape, 0.2))
    assert (
        np.abs(places(double) - places(single)).max() < 0.05
    )  # mm; single numbers are 0.06 mm apart there


@pytest.mark.parametrize(
    "disturbance", ["combined-hard", "ice", "patches", "fixes-outage", "actuator"]
)
def test_disturbed_robots_stay_finite_and_sweeps_end(disturbance):
    plant = driven(8, 400, precision="single", disturbance=disturbance)
    for name in STATES:
        assert np.isfinite(plant.arrays.rows(name)).all()
    double = driven(8, 400, disturbance=disturbance)
    medians = [np.median(one.info("position_error_mm")) for one in (plant, double)]
    assert medians[0] == pytest.approx(medians[1], rel=0.25, abs=0.5)


def test_a_formation_does_not_depend_on_the_others_of_its_tile():
    few, many = (driven(one, 150, precision="single", disturbance="slip") for one in (3, 20))
    for name in STATES:
        np.testing.assert_array_equal(
            few.arrays.rows(name)[:, :, :3], many.arrays.rows(name)[:, :, :3]
        )


def test_a_snapshot_does_not_fit_the_other_precision():
    state = driven(2, 5).get_state()
    with pytest.raises(ValueError, match="precision"):
        driven(2, precision="single").set_state(state)


def test_a_snapshot_in_single_precision_goes_on_bit_for_bit():
    plant = driven(3, 60, precision="single")
    state = plant.get_state()
    go_on(plant, 20)
    other = driven(3, precision="single")
    other.set_state(state)
    go_on(other, 20)
    for name in STATES:
        np.testing.assert_array_equal(plant.arrays.rows(name), other.arrays.rows(name))


def test_another_precision_is_refused():
    with pytest.raises(ValueError, match="precision 'half' is not one of double, single"):
        BatchPlant("infinity", 1, precision="half")
