"""What holds for every tracking law: exact on an exact reference, mirrored, row by row, with its state."""

import math

import numpy as np
import pytest
from helpers import installed

from baselines.policies.laws.catalogue import LAWS, make_law
from baselines.policies.laws.law import Remembering
from baselines.policies.registry import fit_policy
from baselines.runs.run import run_policy
from tlf_env.common.presets import preset_names
from tlf_env.task.actions import FULL_SPEED_MM_S, FULL_YAW_RATE_RAD_S
from tlf_env.task.observation import tracking_entries
from tlf_env.task.scenario import DEFAULT_PREVIEW_S, load_scenario

SCENARIO = load_scenario()
ENTRIES = tracking_entries(DEFAULT_PREVIEW_S)
TOLERANCE = {"nmpc": 0.05}  # it predicts by Simpson's rule
TWISTS = [(400.0, 0.0), (300.0, 0.5), (200.0, -0.8), (0.0, 0.0)]
# Entries that change sign if left and right are exchanged.
ODD = ("e_2", "sin_", "_u_2", "u_2_", "right", "slip_2", "action_1")


every_law = pytest.mark.parametrize("name", installed(LAWS))


def law(name, parameters=""):
    return make_law(name, parameters, SCENARIO)


def ahead(u_1, u_2, time_s):
    """Forward and right of where a robot with that twist will be."""
    turn = u_2 * time_s
    if abs(u_2) < 1e-12:
        return u_1 * time_s, 0.0
    return u_1 / u_2 * math.sin(turn), -u_1 / u_2 * (1 - math.cos(turn))


def on_the_reference(u_1, u_2):
    """A scaled observation of a robot without error, whose reference keeps its twist, as it does itself."""
    seen = {"cos_e_3": 1.0, "reference_u_1": u_1, "reference_u_2": u_2}
    seen |= {"command_u_1": u_1, "command_u_2": u_2, "odometry_u_1": u_1, "odometry_u_2": u_2}
    for time_s in DEFAULT_PREVIEW_S:
        forward, right = ahead(u_1, u_2, time_s)
        later = {"forward": forward, "right": right, "u_1": u_1, "u_2": u_2}
        later |= {"sin_turn": math.sin(u_2 * time_s), "cos_turn": math.cos(u_2 * time_s)}
        seen |= {f"{key}_in_{time_s:g}_s": value for key, value in later.items()}
    return np.array([seen.get(key, 0.0) / entry.scale for key, entry in ENTRIES.items()])


def drawn(rows, seed=0, dtype=np.float64):
    """Observations that may be seen: errors of any size, headings of length 1."""
    out = np.random.default_rng(seed).uniform(-1, 1, (rows, len(ENTRIES)))
    names = list(ENTRIES)
    for i, key in enumerate(names):
        if key.startswith("cos_") or "_cos_" in key:
            angle = np.random.default_rng(seed + i).uniform(-1.5, 1.5, rows)
            out[:, i] = np.cos(angle)
            out[:, names.index(key.replace("cos_", "sin_"))] = np.sin(angle)
    return out.astype(dtype)


@every_law
@pytest.mark.parametrize("twist", TWISTS)
def test_without_error_the_twist_is_the_references(name, twist):
    made, state = law(name), "memory"
    if isinstance(made, Remembering):
        state = None
    for _ in range(3):
        action, state = made.predict(on_the_reference(*twist), state)
        found = action * (FULL_SPEED_MM_S, FULL_YAW_RATE_RAD_S)
        assert found == pytest.approx(twist, abs=TOLERANCE.get(name, 1e-6))
    if not isinstance(made, Remembering):
        assert state == "memory"


@every_law
def test_a_mirrored_observation_gives_the_mirrored_twist(name):
    rows = drawn(20)
    odd = [any(part in key for part in ODD) for key in ENTRIES]
    mirrored = np.where(odd, -rows, rows)
    made = law(name)
    (found, after), (other, after_other) = made.predict(rows), made.predict(mirrored)
    np.testing.assert_allclose(found * [1, -1], other, atol=1e-6)
    found, other = made.predict(rows, after)[0], made.predict(mirrored, after_other)[0]
    np.testing.assert_allclose(found * [1, -1], other, atol=1e-6)


@every_law
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_a_batch_is_its_rows_and_an_episode_starts_afresh(name, dtype):
    made = law(name)
    steps = [drawn(5, seed, dtype) for seed in range(3)]
    starts = [np.ones(5, bool), np.zeros(5, bool), np.array([False, True, False, False, True])]
    state, alone = None, [None] * 5
    for rows, start in zip(steps, starts, strict=True):
        batch, state = made.predict(rows, state, start)
        assert batch.dtype == dtype
        assert np.abs(batch).max() <= 1
        for i in range(5):
            action, alone[i] = made.predict(rows[i], alone[i], start[i : i + 1])
            np.testing.assert_array_equal(batch[i], action)
    fresh = made.predict(steps[2])[0]
    np.testing.assert_array_equal(batch[[1, 4]], fresh[[1, 4]])
    if isinstance(made, Remembering):
        assert (batch[[0, 2, 3]] != fresh[[0, 2, 3]]).any()


@every_law
def test_a_call_repeats_and_leaves_its_state_alone(name):
    made = law(name)
    state = made.predict(drawn(4))[1]
    kept = None if state is None else state.copy()
    first, second = (made.predict(drawn(4, 1), state) for _ in range(2))
    assert first[0].tobytes() == second[0].tobytes()
    np.testing.assert_array_equal(first[1], second[1])
    np.testing.assert_array_equal(state, kept)


@every_law
@pytest.mark.parametrize("shape", [(), (3,), (2, len(ENTRIES) + 1), (1, 1, len(ENTRIES))])
def test_a_wrong_shape_is_reported(name, shape):
    with pytest.raises(ValueError, match="takes tracking observations of"):
        law(name).predict(np.zeros(shape))


@every_law
def test_a_state_of_other_rows_is_reported(name):
    made = law(name)
    if isinstance(made, Remembering):
        with pytest.raises(ValueError, match=r"^the state must be of the shape \(2, \d+\), got"):
            made.predict(drawn(2), made.predict(drawn(3))[1])


@every_law
def test_a_bad_parameter_is_reported_in_one_line(name, tmp_path):
    path = tmp_path / "mine.yaml"
    for text, said in (("gain: 1", "gain: unknown key"), ("lateral_error_mm: -1", "lateral_error")):
        path.write_text(text)
        with pytest.raises(ValueError, match=rf"^[^\n]*mine\.yaml: [^\n]*{said}[^\n]*$"):
            law(name, str(path))


@pytest.mark.parametrize("name", installed(LAWS))
def test_behind_the_limits_of_the_body_a_law_with_bounded_errors_holds_the_infinity(name):
    assert "bounded" in preset_names(name)
    scenario = load_scenario("infinity", robots=2, horizon_s=18.0, plant="batch")
    fitted = fit_policy(f"{name}:bounded+ekf-slip+body", scenario)
    record = run_policy(fitted.scenario, fitted.policy, 10_000)
    assert not any(metrics.lost or metrics.touched for metrics in record.metrics())
    assert record["position_error_mm"][-1].max() < 40
