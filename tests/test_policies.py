"""Policies by name: what is made, what is refused and in which words."""

import json
import sys

import numpy as np
import pytest
from helpers import installed
from stack_policy import StackPolicy

from baselines import ReferencePolicy
from baselines.cli import main
from baselines.policies.registry import (
    describe_overrides,
    fit_policy,
    make_policy,
    policy_hash,
    policy_names,
)
from baselines.runs.run import run_policy, run_seeds
from tlf_env.envs.single import FormationEnv
from tlf_env.onboard.controllers import controller, load_controller
from tlf_env.task.observation import sensor_entries, tracking_entries
from tlf_env.task.scenario import load_scenario

SCENARIO = load_scenario(horizon_s=0.2)
MODULE = """
import numpy as np

class Still:
    def predict(self, observation, state=None, episode_start=None, deterministic=True):
        return np.zeros((len(observation), 2)), state

class Odd:
    def predict(self, observation, state=None, episode_start=None, deterministic=True):
        return np.zeros((len(observation), 3)), state

nothing = object

class Forgets:
    def predict(self, observation, state=None, episode_start=None, deterministic=True):
        self.seen = observation

class ActionsAlone:
    def predict(self, observation, state=None, episode_start=None, deterministic=True):
        return np.zeros((len(observation), 2))

class Words:
    def predict(self, observation, state=None, episode_start=None, deterministic=True):
        return [["0.5", "0.5"]] * len(observation), state

class Complex:
    def predict(self, observation, state=None, episode_start=None, deterministic=True):
        return np.zeros((len(observation), 2), complex), state

class Three:
    def predict(self, observation, state=None, episode_start=None, deterministic=True):
        return np.zeros((len(observation), 2)), state, None

class Short:
    def predict(self, observation):
        return np.zeros((len(observation), 2)), None

def needs(gain):
    return Still()

def a_class():
    return Still
"""


@pytest.fixture
def own_module(tmp_path, monkeypatch):
    (tmp_path / "own_policies.py").write_text(MODULE)
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)


@pytest.mark.parametrize("name", installed([*policy_names(), "reference"]))
def test_every_name_makes_a_policy_that_drives(name):
    record = run_policy(SCENARIO, make_policy(name, SCENARIO))
    assert np.isfinite(record["x_mm"]).all()


@pytest.mark.parametrize(
    "name", ["", "no_such", "reference:no_such", "reference:", "pure_pursuit:tuned"]
)
def test_an_unknown_name_is_reported(name):
    with pytest.raises(ValueError, match=r"^[^\n]+$"):
        make_policy(name, SCENARIO)


def test_the_tuned_reference_runs_on_an_estimate_of_the_slip():
    assert "reference:tuned" in policy_names()
    fitted = fit_policy("reference:tuned", SCENARIO)
    asked = {"estimator": "ekf-slip", "broadcast_smoothing_s": 0.0}
    assert fitted.overrides == asked
    assert fitted.scenario == load_scenario(SCENARIO, **asked)


def test_the_default_is_the_linearising_controller_on_the_scenarios_estimator():
    alone, named = (fit_policy(one, SCENARIO) for one in ("reference", "reference:linearised"))
    assert alone.policy.controller == named.policy.controller == ReferencePolicy().controller
    assert alone.policy.controller == controller(SCENARIO.residual_base)
    assert alone.overrides == named.overrides == {}
    assert (SCENARIO.estimator, SCENARIO.smoothing_s) == ("ekf-gyro", 0.1)


@pytest.mark.parametrize("gains", ["consistent", "printed"])
def test_the_papers_gains_run_on_the_papers_filter(gains):
    asked = {"estimator": "ekf", "broadcast_smoothing_s": 0.0}
    assert fit_policy(f"reference:{gains}", SCENARIO).overrides == asked


def test_the_default_drives_without_previews():
    """It goes without its lead, which is computed from the first preview."""
    blind = load_scenario(SCENARIO, preview_s=())
    policy = fit_policy("reference", blind).policy
    assert policy.controller == controller("linearised").model_copy(update={"lead_s": 0.0})
    assert blind.base_controller == policy.controller
    assert np.isfinite(run_policy(blind, policy)["x_mm"]).all()
    with pytest.raises(ValueError, match=r"lead_s 0\.02 needs a first preview above 0"):
        fit_policy("reference:tuned", blind)


@pytest.mark.parametrize("estimator", ["ekf", "truth", "ekf-slip", "ekf-gyro"])
def test_an_estimator_that_is_set_is_kept(estimator):
    fitted = fit_policy("reference:tuned", load_scenario(horizon_s=0.2, estimator=estimator))
    assert fitted.overrides == {"broadcast_smoothing_s": 0.0}
    assert fitted.scenario.estimator == estimator


@pytest.mark.parametrize(
    ("text", "overrides"),
    [
        ("controller: {gains: {k_1_per_s: 0.4}}", {}),
        ("controller: tuned", {}),
        ("controller: tuned\nestimator: ekf-gyro", {}),
        ("controller: tuned\nestimator: ekf", {"estimator": "ekf"}),
        ("controller: tuned\nbroadcast_smoothing_s: 0", {"broadcast_smoothing_s": 0.0}),
        ("controller: consistent\nestimator: truth\nfound: {by: hand}", {"estimator": "truth"}),
    ],
)
def test_a_controller_may_come_from_a_file(text, overrides, tmp_path):
    path = tmp_path / "mine.yaml"
    path.write_text(text)
    fitted = fit_policy(f"reference:{path}", SCENARIO)
    assert fitted.overrides == overrides
    assert fitted.policy.controller == load_controller(path).controller
    assert np.isfinite(run_policy(fitted.scenario, fitted.policy)["x_mm"]).all()


def test_a_controller_file_may_ask_for_its_filter(tmp_path):
    path = tmp_path / "mine.yaml"
    path.write_text("controller: tuned\nekf_slip: {fix_variance_mm2: 0.7}")
    fitted = fit_policy(f"reference:{path}", SCENARIO)
    assert fitted.scenario.estimator == "ekf-slip"
    assert fitted.scenario.ekf_slip.fix_variance_mm2 == 0.7
    assert fitted.overrides["ekf_slip"] == fitted.scenario.ekf_slip.model_dump()
    assert describe_overrides(fitted.overrides) == ["estimator ekf-slip", "own ekf_slip"]
    mine = load_scenario(SCENARIO, ekf_slip={"fix_variance_mm2": 0.2}, estimator="ekf-slip")
    assert fit_policy(f"reference:{path}", mine).scenario == mine


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (None, "cannot read"),
        ("gains: {}", "controller: Field required"),
        ("controller: bold", "'bold' is not one of adrc, consistent, linearised, printed, tuned"),
        ("controller: {gains: {k_1_per_s: -1}}", "controller.gains.k_1_per_s"),
        ("controller: tuned\nestimator: own:Filter", "estimator"),
        ("controller: tuned\nekf: {}", "ekf: unknown key"),
        ("controller: !!python/object:os.system {}", "is not YAML"),
    ],
)
def test_a_bad_controller_file_is_reported_in_one_line(text, said, tmp_path):
    path = tmp_path / "mine.yaml"
    if text is not None:
        path.write_text(text)
    with pytest.raises(ValueError, match=r"^[^\n]*mine\.yaml[^\n]*$") as shown:
        make_policy(f"reference:{path}", SCENARIO)
    assert said in str(shown.value)


def test_a_controller_file_counts_as_the_policys_source(tmp_path):
    path = tmp_path / "mine.yaml"
    seen = set()
    for text in ("controller: tuned", "controller: printed"):
        path.write_text(text)
        seen.add(policy_hash("reference", make_policy(f"reference:{path}", SCENARIO)))
    assert len(seen) == 2


def test_the_reference_has_the_scenarios_period():
    """A limit on an acceleration is a step of the command, as long as the period."""
    fastest = controller("tuned").limits.acceleration_mm_s2
    seen = np.zeros(len(tracking_entries((1.0,))), dtype=np.float64)
    seen[:4] = 1.0, 0.0, 0.0, 1.0  # the reference is far ahead
    seen[list(tracking_entries(())).index("is_leader")] = 1.0  # no predecessor in the way
    for period_s in (0.01, 0.02):
        scenario = load_scenario(control_period_s=period_s, preview_s=(1.0,), estimator="ekf-slip")
        action, _ = make_policy("reference:tuned", scenario).predict(seen)
        assert action[0] == pytest.approx(fastest * period_s / 1000.0)


def test_a_residual_is_added_to_the_tuned_reference():
    scenario = load_scenario(SCENARIO, action="residual", residual_base="tuned")
    record = run_policy(scenario, AlwaysStill())
    assert np.isfinite(record["x_mm"]).all()


class AlwaysStill:
    def predict(self, observation, state=None, episode_start=None, deterministic=True):
        return np.zeros((len(observation), 2)), state


FOR_THE_STACK = {
    "observation": "sensor",
    "action": "torque",
    "control_period_s": 0.001,
    "estimator": "ekf",
}


def test_the_stack_has_the_papers_law_alone():
    scenario = load_scenario(**FOR_THE_STACK)
    with pytest.raises(ValueError, match=r"gains consistent, printed; 'tuned' needs limits"):
        StackPolicy(scenario, "tuned")
    with pytest.raises(
        ValueError, match=r"'bold' is not one of adrc, consistent, linearised, printed, tuned, nor"
    ):
        StackPolicy(scenario, "bold")


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"estimator": "ekf-slip"}, "needs estimator 'ekf'; the scenario has 'ekf-slip'"),
        ({"estimator": "truth"}, "needs estimator 'ekf'; the scenario has 'truth'"),
        ({"estimator": "my:Filter"}, "needs estimator 'ekf'; the scenario has 'my:Filter'"),
        ({"action": "twist"}, "needs action 'torque'; the scenario has 'twist'"),
        ({"observation": "tracking"}, "needs observation 'sensor'; the scenario has 'tracking'"),
        ({"control_period_s": 0.02}, "control_period_s 0.02 must be physics_period_s 0.001"),
    ],
)
def test_the_stack_refuses_what_would_drive_another_way_than_on_board(fields, message):
    with pytest.raises(ValueError, match=message):
        StackPolicy(load_scenario(**{**FOR_THE_STACK, **fields}))


def test_a_stack_of_unlike_robots_needs_a_row_for_each():
    scenario = load_scenario(robots=[{}, {"wheel_radius_mm": 55}], **FOR_THE_STACK)
    rows = np.zeros((3, len(sensor_entries(1))))
    with pytest.raises(ValueError, match=r"3 rows; the scenario's 2 robots differ"):
        StackPolicy(scenario).predict(rows)
    StackPolicy(scenario).predict(np.zeros((4, len(sensor_entries(1)))))


@pytest.mark.parametrize("name", installed(policy_names()))
@pytest.mark.parametrize("fields", [{"observation": "sensor"}, {"action": "wheel_speed"}])
def test_a_policy_that_does_not_fit_is_reported(name, fields):
    with pytest.raises(ValueError, match="takes 'tracking' observations and gives 'twist'"):
        make_policy(name, load_scenario(**fields))


@pytest.mark.usefixtures("own_module")
def test_a_policy_may_come_from_a_custom_factory():
    policy = make_policy("own_policies:Still", SCENARIO, trust=True)
    record = run_policy(SCENARIO, policy)
    assert np.abs(np.diff(record["x_mm"], axis=0)).max() < 1e-6


@pytest.mark.usefixtures("own_module")
def test_a_custom_policy_must_predict_actions_of_the_right_shape():
    with pytest.raises(ValueError, match=r"has no predict\(\)"):
        make_policy("own_policies:nothing", SCENARIO, trust=True)
    with pytest.raises(ValueError, match=r"must have the shape \(3, 2\), got \(3, 3\)"):
        run_policy(SCENARIO, make_policy("own_policies:Odd", SCENARIO, trust=True))


@pytest.mark.usefixtures("own_module")
@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("needs", r"cannot be made by factory\(\): .*'gain'"),
        ("a_class", r"has no predict\(\): factory\(\) made the class Still"),
        ("Short", r"predict\(observation\) cannot be called as predict\(observation, state, "),
    ],
)
def test_a_factory_that_makes_no_policy_is_reported_in_one_line(name, message):
    with pytest.raises(ValueError, match=rf"^policy 'own_policies:{name}'[^\n]*{message}"):
        make_policy(f"own_policies:{name}", SCENARIO, trust=True)


PREDICTS = {
    "Forgets": r"must return a pair, \(actions, state\), got NoneType",
    "ActionsAlone": r"must return a pair, \(actions, state\), got ndarray",
    "Three": r"must return a pair, \(actions, state\), got tuple of 3",
    "Words": r"must be real numbers in the shape \(2, 2\)",
    "Complex": r"must be real numbers in the shape \(2, 2\)",
}


@pytest.mark.usefixtures("own_module")
@pytest.mark.parametrize(("name", "message"), PREDICTS.items())
def test_a_prediction_that_is_not_a_pair_of_actions_and_state_is_reported(name, message):
    """With two robots: two rows of actions alone could pass for a pair."""
    scenario = load_scenario(SCENARIO, robots=2)
    policy = make_policy(f"own_policies:{name}", scenario, trust=True)
    with pytest.raises(ValueError, match=rf"^policy 'mine': [^\n]*{message}[^\n]*$"):
        run_policy(scenario, policy, name="mine")
    with pytest.raises(ValueError, match=rf"^policy 'mine': [^\n]*{message}[^\n]*$"):
        list(run_seeds(load_scenario(scenario, plant="batch"), policy, [0], name="mine"))


@pytest.mark.usefixtures("own_module")
@pytest.mark.parametrize(("name", "message"), PREDICTS.items())
def test_the_policy_of_the_other_robots_is_checked(name, message):
    env = FormationEnv(SCENARIO, others=f"own_policies:{name}", trust=True)
    env.reset(seed=0)
    with pytest.raises(ValueError, match=rf"^others: [^\n]*{message}[^\n]*$"):
        env.step(np.zeros(2, np.float32))


@pytest.mark.usefixtures("own_module")
@pytest.mark.parametrize(
    "words",
    [
        ["--estimator", "os:getcwd"],
        ["--wheel-loop", "os:getcwd"],
        ["--observer", "builtins:dict"],
        ["--policy", "own_policies:needs"],
        ["--policy", "own_policies:ActionsAlone"],
        ["--policy", "reference:"],
    ],
)
def test_the_command_line_reports_a_wrong_part_in_one_line(words, monkeypatch, capsys, tmp_path):
    out = ["--out", str(tmp_path / "out"), "--no-figures", "--horizon-s", "0.2"]
    monkeypatch.setattr(sys, "argv", ["tlf", "run", "stop_and_go", "--trust", *words, *out])
    with pytest.raises(SystemExit) as left:
        main()
    assert left.value.code == 2
    last = capsys.readouterr().err.strip().splitlines()[-1]
    assert last.startswith("tlf: ")
    assert words[1] in last


def test_a_run_warns_of_the_scenario_that_the_policy_asks_for(monkeypatch, capsys, tmp_path):
    (tmp_path / "wide_asking.py").write_text(
        MODULE + "\nclass Sensing(Still):\n    scenario_overrides = {'observation': 'sensor'}\n"
    )
    (tmp_path / "wide.yaml").write_text(
        "trajectory: {type: circle, radius_mm: 1000, speed_mm_s: 100, centre_x_mm: 20000}\n"
    )
    monkeypatch.chdir(tmp_path)
    words = [
        "run",
        "wide.yaml",
        "--policy",
        "wide_asking:Sensing",
        "--trust",
        "--no-figures",
        "--horizon-s",
        "0.2",
    ]
    monkeypatch.setattr(sys, "argv", ["tlf", *words])
    main()
    assert "tlf: warning: t = 0 s: robot_0 starts at (21000, 0) mm" in capsys.readouterr().err


@pytest.mark.parametrize("as_json", [[], ["--json"]])
def test_a_run_notes_the_start_at_speed_once_and_beside_the_result(
    as_json, monkeypatch, capsys, tmp_path
):
    (tmp_path / "fast.yaml").write_text("base: infinity\nname: fast\n")
    words = [str(tmp_path / "fast.yaml"), "--no-figures", "--horizon-s", "0.2", *as_json]
    monkeypatch.setattr(sys, "argv", ["tlf", "run", *words, "--out", str(tmp_path / "out")])
    main()
    shown = capsys.readouterr()
    assert shown.err.count("tlf: note: the reference starts at 559 mm/s") == 1
    assert "559 mm/s" not in shown.out
    if as_json:
        json.loads(shown.out)


def test_a_run_of_a_preset_does_not_note_its_start(monkeypatch, capsys, tmp_path):
    words = ["infinity", "--no-figures", "--horizon-s", "0.2", "--out", str(tmp_path)]
    monkeypatch.setattr(sys, "argv", ["tlf", "run", *words])
    main()
    assert "note" not in capsys.readouterr().err


def test_a_zip_is_loaded_only_on_trust(tmp_path):
    path = tmp_path / "model.zip"
    path.write_bytes(b"no zip")
    with pytest.raises(ValueError, match="--trust"):
        make_policy(str(path), SCENARIO)
    with pytest.raises(ValueError, match="no such file"):
        make_policy(str(tmp_path / "none.zip"), SCENARIO, trust=True)


@pytest.fixture(scope="module")
def learner():
    pytest.importorskip("stable_baselines3")
    import gymnasium

    return gymnasium.make("tlf_env/Infinity-v0")


@pytest.mark.parametrize("algorithm", ["PPO", "SAC", "TD3"])
def test_a_model_of_stable_baselines_drives_every_robot(algorithm, learner, tmp_path):
    import stable_baselines3

    few = {"n_steps": 8, "batch_size": 8} if algorithm == "PPO" else {"buffer_size": 8}
    net = {"net_arch": [4]}
    model = getattr(stable_baselines3, algorithm)(
        "MlpPolicy", learner, policy_kwargs=net, device="cpu", seed=0, **few
    )
    path = tmp_path / "model.zip"
    model.save(path)
    policy = make_policy(str(path), SCENARIO, trust=True)
    seen = np.zeros((3, *learner.observation_space.shape), dtype=np.float32)
    found = policy.predict(seen, deterministic=True)[0]
    np.testing.assert_array_equal(found, model.predict(seen, deterministic=True)[0])
    run_policy(SCENARIO, policy)
    with pytest.raises(ValueError, match="its observation has the shape"):
        make_policy(str(path), load_scenario(preview_s=(0.5,)), trust=True)


@pytest.mark.usefixtures("learner")
def test_a_zip_that_is_not_a_model_is_reported(tmp_path):
    path = tmp_path / "model.zip"
    path.write_bytes(b"no zip")
    with pytest.raises(ValueError, match=r"model\.zip"):
        make_policy(str(path), SCENARIO, trust=True)
