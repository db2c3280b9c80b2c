"""The sliding-mode law: how its surfaces are approached, what happens on them, and its limits."""

import math

import numpy as np
import pytest

from baselines.policies.laws.sliding_mode import SlidingMode

U_1, U_2 = 300.0, 0.4
DT = 1e-3


def surfaces(law, x, y, e_3):
    return law.heading_weight * e_3 + math.atan(y / law.lateral_scale_mm), x


def simulated(law, x, y, e_3, time_s, u_1=U_1):
    """Errors ``(step, 3)`` of a unicycle about a reference with a constant twist: Heun's steps."""

    def rates(errors):
        x, y, e_3 = errors
        seen = {"e_1": x, "e_2": -y, "sin_e_3": math.sin(e_3), "cos_e_3": math.cos(e_3)}
        seen |= {"reference_u_1": u_1, "reference_u_2": U_2}
        v, w = law.twist({name: np.array([value]) for name, value in seen.items()})
        v, w = v[0], w[0]
        return np.array([w * y - v + u_1 * math.cos(e_3), u_1 * math.sin(e_3) - w * x, U_2 - w])

    errors = np.array([x, y, e_3])
    kept = [errors]
    for _ in range(round(time_s / DT)):
        first = rates(errors)
        errors = errors + DT / 2 * (first + rates(errors + DT * first))
        kept.append(errors)
    return np.array(kept)


def test_outside_the_layers_the_surfaces_are_approached_at_constant_rates():
    law = SlidingMode(turn_layer_rad=0.01, forward_layer_mm=1.0)
    errors = simulated(law, 40.0, 50.0, 0.3, 0.2)
    found = np.array([surfaces(law, *row) for row in errors])
    wanted = found[0] - np.outer(
        np.arange(len(errors)) * DT, [law.turn_reach_rad_s, law.forward_reach_mm_s]
    )
    np.testing.assert_allclose(found, wanted, rtol=1e-4, atol=1e-5)


def test_within_the_layers_the_surfaces_decay_exponentially():
    law = SlidingMode()
    errors = simulated(law, 20.0, 10.0, 0.05, 1.0)
    found = np.array([surfaces(law, *row) for row in errors])
    rates = (
        law.turn_reach_rad_s / law.turn_layer_rad,
        law.forward_reach_mm_s / law.forward_layer_mm,
    )
    times = np.arange(len(errors)) * DT
    np.testing.assert_allclose(found, found[0] * np.exp(-np.outer(times, rates)), atol=1e-4)


@pytest.mark.parametrize("speed", [100.0, 300.0])
def test_on_the_surface_a_lateral_error_decays_over_the_distance(speed):
    law = SlidingMode(lateral_scale_mm=200.0, heading_weight=0.8)
    y = 4.0
    e_3 = -math.atan(y / law.lateral_scale_mm) / law.heading_weight
    errors = simulated(law, 0.0, y, e_3, 1.0, speed)
    gone = speed * np.arange(len(errors)) * DT / (law.heading_weight * law.lateral_scale_mm)
    np.testing.assert_allclose(errors[:, 1], y * np.exp(-gone), atol=2e-3)
    np.testing.assert_allclose(errors[:, 0], 0.0, atol=1e-6)


def test_from_any_start_behind_the_reference_all_errors_vanish():
    for x, y, e_3 in ((400.0, 300.0, 1.0), (50.0, -600.0, -1.5), (0.0, 100.0, 3.0)):
        assert np.abs(simulated(SlidingMode(), x, y, e_3, 15.0)[-1]).max() < 0.1


def test_without_a_layer_the_corrections_switch():
    law = SlidingMode(turn_layer_rad=1e-12, forward_layer_mm=1e-12)
    for sign in (-1.0, 1.0):
        seen = {"e_1": 1e-6 * sign, "e_2": 0.0, "sin_e_3": 1e-6 * sign, "cos_e_3": 1.0}
        seen |= {"reference_u_1": 0.0, "reference_u_2": 0.0}
        v, w = law.twist({name: np.array([value]) for name, value in seen.items()})
        assert (v[0], w[0]) == pytest.approx((100.0 * sign, 1.0 * sign), rel=1e-4)


def test_far_ahead_of_the_reference_the_twist_stays_finite():
    law = SlidingMode()
    seen = {"e_2": -20.0, "sin_e_3": 0.1, "cos_e_3": math.cos(0.1)}
    seen |= {"reference_u_1": U_1, "reference_u_2": U_2}
    e_1 = np.linspace(-1000.0, 1000.0, 2001)
    seen = {name: np.full_like(e_1, value) for name, value in seen.items()}
    turn = law.twist(seen | {"e_1": e_1})[1]
    assert np.all(np.abs(np.diff(turn)) < 0.05)
