"""Systems: names of controller, estimator and limiter, and that each part does what it does by itself."""

import math

import numpy as np
import pytest
from helpers import installed

from baselines import ReferencePolicy
from baselines.benchmark.page import policy_label
from baselines.policies.laws.law import ErrorBounds
from baselines.policies.laws.textbook import FeedbackLinearisation, Kanayama
from baselines.policies.registry import fit_policy, make_policy, policy_hash, policy_names
from baselines.policies.systems import (
    ESTIMATORS,
    LimitedLaw,
    Limiter,
    load_limiter,
    own_limiter,
    parse_system,
)
from baselines.runs.run import run_policy
from tlf_env.common.presets import preset_names, yaml_text
from tlf_env.onboard.controllers import controller
from tlf_env.onboard.parts import PYTHON_ESTIMATORS
from tlf_env.onboard.tracking import Controller
from tlf_env.task.actions import FULL_SPEED_MM_S, FULL_YAW_RATE_RAD_S
from tlf_env.task.observation import tracking_entries
from tlf_env.task.scenario import DEFAULT_PREVIEW_S, load_scenario

SCENARIO = load_scenario(horizon_s=2.0, disturbance="slip")
ENTRIES = tracking_entries(DEFAULT_PREVIEW_S)
PERIOD_S = SCENARIO.control_period_s


def rows(dtype=np.float32, count=64):
    """Random observations of any size and sign."""
    drawn = np.random.default_rng(0).normal(0.0, 1.0, (count, len(ENTRIES)))
    return drawn.astype(dtype)


def row(**seen):
    """A scaled observation of what is named; the heading error is 0 by default."""
    values = {"cos_e_3": 1.0} | seen
    return np.array([values.get(name, 0.0) / entry.scale for name, entry in ENTRIES.items()])


def limiter_file(tmp_path, **fields):
    path = tmp_path / "limiter.yaml"
    path.write_text(yaml_text(fields))
    return path


def drive(name, **fields):
    """The commanded twists ``(step, robot, 2)`` of an episode, in mm/s and rad/s."""
    fitted = fit_policy(name, load_scenario(SCENARIO, **fields))
    commands = []

    class Kept:
        def predict(self, *given):
            action, state = fitted.policy.predict(*given)
            commands.append(action)
            return action, state

    run_policy(fitted.scenario, Kept())
    return np.array(commands, dtype=np.float64) * (FULL_SPEED_MM_S, FULL_YAW_RATE_RAD_S)


@pytest.mark.parametrize("law", policy_names())
@pytest.mark.parametrize("estimator", ESTIMATORS)
@pytest.mark.parametrize("limiter", [None, *preset_names("limiter"), "my+own.yaml"])
def test_a_name_is_its_parts(law, estimator, limiter):
    name = "+".join(part for part in (law, estimator, limiter) if part)
    assert parse_system(name) == (law, estimator, limiter)
    assert str(parse_system(name)) == name


@pytest.mark.parametrize(
    "name", [*policy_names(), "reference", "residual", "a+b.zip", "a+ekf.safetensors", "my:Own", ""]
)
def test_other_policies_are_no_systems(name):
    assert parse_system(name) is None


def test_a_path_with_a_plus_is_still_one_controller(tmp_path):
    path = tmp_path / "mine+yours.yaml"
    path.write_text("controller: printed")
    assert parse_system(f"reference:{path}") is None
    assert make_policy(f"reference:{path}", SCENARIO).controller == controller("printed")
    system = f"reference:{path}+ekf+none"
    assert parse_system(system) == (f"reference:{path}", "ekf", "none")
    assert make_policy(system, SCENARIO).controller.gains == controller("printed").gains


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("kanayana+ekf", "controller 'kanayana' is not one of .*; did you mean 'kanayama'?"),
        ("residual+ekf", "controller 'residual' is not one of reference:adrc, "),
        ("reference:tund+ekf", "controller 'reference:tund' is .*; did you mean 'reference:tuned'"),
        ("kanayama:bold+ekf", "controller 'kanayama:bold' is not one of"),
        ("reference:+ekf+none", "controller 'reference:' is not one of"),
        ("+ekf+none", "controller '' is not one of"),
        ("kanayama+ekf-slp+body", "estimator 'ekf-slp' is .*; did you mean 'ekf-slip'?"),
        (
            "kanayama+body",
            "estimator 'body' is not one of ekf, ekf-slip, ekf-gyro, truth, ekf-slip-without",
        ),
        ("kanayama+", "estimator '' is not one of ekf"),
        (
            "kanayama+ekf+bodi",
            "limiter 'bodi' is not one of approach, body, .*, FILE.yaml; did you mean",
        ),
        (
            "kanayama+ekf+",
            "limiter '' is not one of approach, body, grip, none, supervised, yaw-rate, FILE",
        ),
        ("kanayama+ekf+body+none", r"limiter 'body\+none' is not one of"),
        ("kanayama+ekf+no_such.yaml", "cannot read no_such.yaml"),
        ("kanayama:no_such.yaml+ekf", "cannot read no_such.yaml"),
    ],
)
def test_an_unknown_part_is_reported_in_one_line(name, said):
    with pytest.raises(ValueError, match=rf"^[^\n]*{said}[^\n]*$"):
        fit_policy(name, SCENARIO)


@pytest.mark.parametrize(
    ("fields", "said"),
    [
        ({"limits": {"yaw_rate_rad_s": -1}}, r"limits\.yaw_rate_rad_s"),
        ({"limits": {"lateral_error_mm": 1}}, "lateral_error_mm belongs to a controller"),
        ({"gains": {}}, "gains: unknown key"),
    ],
)
def test_a_bad_limiter_file_is_reported_in_one_line(tmp_path, fields, said):
    path = limiter_file(tmp_path, **fields)
    with pytest.raises(ValueError, match=rf"^[^\n]*limiter\.yaml: [^\n]*{said}[^\n]*$"):
        load_limiter(path)


def test_a_lead_needs_a_preview():
    for name in ("kanayama+ekf+body", "reference:printed+ekf+body"):
        with pytest.raises(ValueError, match=r"lead_s 0\.02 needs a first preview above 0"):
            make_policy(name, load_scenario(preview_s=()))


WITH_LIMITS = ("reference:adrc", "reference:linearised", "reference:tuned")


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize(
    "name",
    installed(one for one in policy_names() if one not in WITH_LIMITS),
)
def test_without_a_limiter_the_laws_twist_is_commanded(name, dtype):
    alone = make_policy(name, SCENARIO).predict(rows(dtype))[0]
    system = make_policy(f"{name}+ekf+none", SCENARIO).predict(rows(dtype))[0]
    assert alone.dtype == system.dtype == dtype
    assert alone.tobytes() == system.tobytes()
    assert make_policy(f"{name}+ekf", SCENARIO).predict(rows(dtype))[0].tobytes() == alone.tobytes()


def test_the_tuned_reference_is_the_sum_of_its_parts(tmp_path):
    own = own_limiter(controller("tuned"))
    assert own == load_limiter("body")
    path = limiter_file(tmp_path, **own.model_dump())
    alone = fit_policy("reference:tuned", SCENARIO)
    for limiter in ("", "+body", f"+{path}"):
        system = fit_policy(f"reference:tuned+ekf-slip{limiter}", SCENARIO)
        assert (system.scenario, system.overrides) == (alone.scenario, alone.overrides)
        found, wanted = (one.policy.predict(rows())[0] for one in (system, alone))
        assert found.tobytes() == wanted.tobytes()
    bare = make_policy("reference:tuned+ekf-slip+none", SCENARIO)
    assert bare.controller.limits.lateral_error_mm == 150.0  # a bound on errors stays with its law
    assert bare.controller.limits.yaw_rate_rad_s is None


@pytest.mark.parametrize(
    ("preset", "law"), [("linearised", "feedback_linearisation:bounded"), ("adrc", "adrc:searched")]
)
def test_a_reference_is_a_system_of_a_law(preset, law):
    """One compiled law, in a controller and behind a limiter: the same bits."""
    name = f"{law}+ekf-gyro-smoothed+grip"
    alone, system = (fit_policy(one, SCENARIO) for one in (f"reference:{preset}", name))
    assert (alone.overrides, system.overrides) == ({}, {"broadcast_smoothing_s": 0.1})
    assert alone.scenario.smoothing_s == 0.1
    assert load_scenario(alone.scenario, broadcast_smoothing_s=0.1) == system.scenario
    found, wanted = (one.policy.predict(rows())[0] for one in (system, alone))
    assert found.tobytes() == wanted.tobytes()
    first, second = (run_policy(one.scenario, one.policy, 3) for one in (system, alone))
    for column, values in first.columns.items():
        np.testing.assert_array_equal(values, second[column], err_msg=column)


def test_a_controller_has_one_law():
    with pytest.raises(ValueError, match="gains and linearisation exclude each other"):
        Controller(gains={"k_1_per_s": 0.4}, linearisation={"ahead_mm": 80.0, "gain_per_s": 1.0})


def test_a_system_drives_as_its_parts_put_together_by_hand():
    name = "feedback_linearisation:bounded+ekf-slip+body"
    fitted = fit_policy(name, SCENARIO)
    bounds = ErrorBounds(braking_error_mm=23.0, forward_error_mm=119.0, lateral_error_mm=150.0)
    law = FeedbackLinearisation(ahead_mm=80.0, gain_per_s=1.3, bounds=bounds)
    by_hand = LimitedLaw(law, load_limiter("body"), PERIOD_S, DEFAULT_PREVIEW_S)
    scenario = load_scenario(SCENARIO, estimator="ekf-slip", broadcast_smoothing_s=0.0)
    first = run_policy(fitted.scenario, fitted.policy, 3)
    second = run_policy(scenario, by_hand, 3)
    for column, values in first.columns.items():
        np.testing.assert_array_equal(values, second[column], err_msg=column)


LIMITS = {
    "yaw_rate_rad_s": (0.3, lambda u: np.abs(u[..., 1])),
    "acceleration_mm_s2": (100.0, lambda u: np.abs(np.diff(u[..., 0], axis=0)) / PERIOD_S),
    "yaw_acceleration_rad_s2": (2.0, lambda u: np.abs(np.diff(u[..., 1], axis=0)) / PERIOD_S),
    "lateral_acceleration_mm_s2": (50.0, lambda u: np.abs(u[..., 0] * u[..., 1])),
}


@pytest.mark.parametrize("law", ["feedback_linearisation", "kanayama", "reference:consistent"])
@pytest.mark.parametrize("limit", LIMITS)
def test_every_command_of_an_episode_is_within_the_limit(tmp_path, law, limit):
    most, measured = LIMITS[limit]
    path = limiter_file(tmp_path, limits={limit: most})
    limited = drive(f"{law}+ekf+{path}", disturbance="start")
    assert measured(limited).max() <= most * 1.001  # an observation is rounded to float32
    assert measured(drive(f"{law}+ekf+none", disturbance="start")).max() > 1.01 * most


def test_a_robot_ahead_of_its_reference_reverses_no_faster_than_its_limit(tmp_path):
    path = limiter_file(tmp_path, limits={"reverse_mm_s": 20.0})
    seen = row(e_1=-200.0)
    for limiter, u_1 in (("none", -200.0), (path, -20.0)):
        policy = make_policy(f"feedback_linearisation+ekf+{limiter}", SCENARIO)
        assert policy.predict(seen)[0][0] * FULL_SPEED_MM_S == pytest.approx(u_1)


def test_a_law_behind_a_lead_sees_the_later_reference():
    later = {"u_1_in_0.5_s": 200.0, "u_2_in_0.5_s": 1.0}
    seen = row(reference_u_1=100.0, reference_u_2=0.5, **later)
    policy = LimitedLaw(Kanayama(), Limiter(lead_s=0.05), PERIOD_S, DEFAULT_PREVIEW_S)
    twist = policy.predict(seen)[0] * (FULL_SPEED_MM_S, FULL_YAW_RATE_RAD_S)
    assert twist == pytest.approx((110.0, 0.55))


def test_the_slip_of_the_observation_is_subtracted(tmp_path):
    path = limiter_file(tmp_path, limits={"cancel_slip": True})
    seen = row(reference_u_1=200.0, slip_1=30.0, slip_2=-0.2)
    action = make_policy(f"kanayama+ekf-slip+{path}", SCENARIO).predict(seen)[0]
    assert action * (FULL_SPEED_MM_S, FULL_YAW_RATE_RAD_S) == pytest.approx((170.0, 0.2))


@pytest.mark.parametrize("law", ["feedback_linearisation", "kanayama", "pure_pursuit"])
def test_a_preset_bounds_the_errors_that_its_law_sees(law):
    forward = 119.0 * math.tanh(math.sqrt(23.0 * (2000.0 - 23.0)) / 119.0)
    preset = make_policy(f"{law}:bounded", SCENARIO)
    far, near = (preset.wanted(row(reference_u_1=100.0, e_1=e_1))[0] for e_1 in (1000.0, 10.0))
    assert far[0, 0] == pytest.approx(100.0 + 1.3 * forward)
    assert near[0, 0] == pytest.approx(100.0 + 1.3 * 119.0 * math.tanh(10.0 / 119.0))


def test_a_system_asks_for_its_estimator_with_the_scenarios_filter(tmp_path):
    path = tmp_path / "mine.yaml"
    path.write_text("controller: tuned\nestimator: ekf\nekf_slip: {fix_variance_mm2: 0.7}")
    fitted = fit_policy(f"reference:{path}+ekf-slip+body", SCENARIO)
    assert fitted.overrides == {"estimator": "ekf-slip", "broadcast_smoothing_s": 0.0}
    assert fitted.scenario.ekf_slip == SCENARIO.ekf_slip
    assert not fitted.policy.privileged
    assert fit_policy("kanayama+truth", SCENARIO).policy.privileged
    assert fit_policy("reference:tuned+truth+none", SCENARIO).policy.privileged


def test_an_estimator_that_is_set_and_another_that_is_named_are_refused():
    fixed = load_scenario(SCENARIO, estimator="truth")
    assert fit_policy("kanayama+truth+none", fixed).overrides == {"broadcast_smoothing_s": 0.0}
    said = r"^system 'kanayama\+ekf\+none' names the estimator 'ekf'; the scenario sets 'truth'$"
    with pytest.raises(ValueError, match=said):
        fit_policy("kanayama+ekf+none", fixed)


def test_the_files_of_a_system_count_as_its_source(tmp_path):
    def found(name):
        return policy_hash(name, make_policy(name, SCENARIO))

    name = f"kanayama+ekf+{limiter_file(tmp_path, limits={'yaw_rate_rad_s': 1.0})}"
    before = found(name)
    limiter_file(tmp_path, limits={"yaw_rate_rad_s": 2.0})
    names = ["kanayama+ekf", "kanayama+ekf+none", "kanayama+ekf+body", "kanayama:bounded+ekf+body"]
    assert len({before, found(name), *map(found, names)}) == 6
    assert found("kanayama:bounded") != found("kanayama")


def test_a_table_has_the_systems_name_and_no_second_estimator():
    line = {"overrides": {"estimator": "ekf-slip"}, "privileged": False}
    assert policy_label({"policy": "kanayama+ekf-slip+body"} | line) == "kanayama+ekf-slip+body"
    smoothed = {"overrides": {"estimator": "ekf-gyro", "broadcast_smoothing_s": 0.1}}
    name = "kanayama+ekf-gyro-smoothed+body"
    assert policy_label({"policy": name} | line | smoothed) == name
    assert policy_label({"policy": "reference:tuned"} | line) == (
        "reference:tuned (estimator ekf-slip)"
    )


def test_a_batch_is_its_rows():
    policy = make_policy("kanayama+ekf+body", SCENARIO)
    batch = policy.predict(rows())[0]
    assert np.abs(batch).max() <= 1
    np.testing.assert_array_equal(batch, [policy.predict(one)[0] for one in rows()])


@pytest.mark.parametrize("limiter", ["", "+grip"])
def test_the_reference_without_gains_is_the_default_controller(limiter):
    default = make_policy(f"reference+ekf-gyro{limiter}", SCENARIO).predict(rows())[0]
    assert default.tobytes() == ReferencePolicy().predict(rows())[0].tobytes()


@pytest.mark.parametrize("limiter", ["", "+none"])
def test_a_law_named_alone_runs_on_the_scenarios_estimator(limiter):
    """The same filter for every law; a system names another."""
    assert fit_policy("kanayama", SCENARIO).overrides == {}
    fitted = fit_policy(f"kanayama+ekf{limiter}", SCENARIO)
    assert fitted.overrides == {"estimator": "ekf", "broadcast_smoothing_s": 0.0}


def test_a_changed_scenario_does_not_count_as_set():
    """A policy asks for fields that a caller has not set, also of a scenario made from another."""
    changed = load_scenario(load_scenario("infinity"), horizon_s=2.0)
    assert fit_policy("kanayama+ekf", changed).scenario.estimator == "ekf"
    assert fit_policy("reference:consistent", changed).scenario.estimator == "ekf"
    kept = load_scenario(load_scenario("infinity", estimator="ekf-slip"), horizon_s=2.0)
    assert fit_policy("reference:consistent", kept).scenario.estimator == "ekf-slip"


def test_a_smoothed_estimator_is_the_filter_with_smoothed_broadcasts():
    scenario = fit_policy("kanayama+ekf-gyro-smoothed+body", SCENARIO).scenario
    assert (scenario.estimator, scenario.broadcast_smoothing_s) == ("ekf-gyro", 0.1)
    assert fit_policy("kanayama+ekf-gyro-smoothed+body", scenario).scenario == scenario
    plain = fit_policy("kanayama+ekf-gyro+body", SCENARIO).scenario
    assert (plain.estimator, plain.broadcast_smoothing_s) == ("ekf-gyro", 0.0)
    other = load_scenario("infinity", broadcast_smoothing_s=0.2)
    said = r"^system '.*' names the broadcast_smoothing_s 0\.1; the scenario sets 0\.2$"
    with pytest.raises(ValueError, match=said):
        fit_policy("kanayama+ekf-gyro-smoothed+body", other)


def test_an_estimator_without_a_part_merges_with_the_scenarios_parameters():
    given = load_scenario("infinity", ekf_slip={"fix_variance_mm2": 0.7})
    fitted = fit_policy("kanayama+ekf-slip-without-jumps+body", given)
    found = fitted.scenario.ekf_slip
    assert (found.most_acceleration_mm_s2, found.most_yaw_acceleration_rad_s2) == (None, None)
    assert found.fix_variance_mm2 == 0.7
    assert fitted.scenario.estimator == "ekf-slip"
    fields = fit_policy("kanayama+ekf-gyro-without-torques", SCENARIO).scenario
    assert (fields.estimator, fields.ekf_gyro.torque_time_s) == ("ekf-gyro", None)
    assert fit_policy("kanayama+ekf-slip", SCENARIO).scenario.ekf_slip == SCENARIO.ekf_slip


def test_a_scenario_that_sets_what_a_name_leaves_out_is_refused():
    given = load_scenario("infinity", ekf_slip={"most_acceleration_mm_s2": 500})
    said = (
        r"^system '.*' names the ekf_slip\.most_acceleration_mm_s2 None; the scenario sets 500\.0$"
    )
    with pytest.raises(ValueError, match=said):
        fit_policy("kanayama+ekf-slip-without-jumps+body", given)
    agreeing = load_scenario("infinity", ekf_slip={"most_acceleration_mm_s2": None})
    found = fit_policy("kanayama+ekf-slip-without-jumps+body", agreeing).scenario.ekf_slip
    assert found.most_yaw_acceleration_rad_s2 is None


@pytest.mark.parametrize("estimator", PYTHON_ESTIMATORS)
def test_an_estimator_in_python_is_a_part_and_is_refused_on_batch(estimator):
    name = f"kanayama+{estimator}+body"
    fitted = fit_policy(name, SCENARIO)
    assert fitted.scenario.part_paths == {"estimator": PYTHON_ESTIMATORS[estimator]}
    assert not fitted.policy.privileged
    assert (
        policy_label({"policy": name, "overrides": fitted.overrides, "privileged": False}) == name
    )
    said = (
        rf"^system '.*': estimator '{estimator}' is a Python object, which plant 'batch' cannot .*$"
    )
    with pytest.raises(ValueError, match=said):
        fit_policy(name, load_scenario("infinity", plant="batch"))


def test_the_source_of_an_estimator_in_python_counts_as_the_systems():
    names = [f"kanayama+{one}+body" for one in ("ekf", *PYTHON_ESTIMATORS)]
    assert len({policy_hash(name, make_policy(name, SCENARIO)) for name in names}) == len(names)
