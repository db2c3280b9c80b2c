"""Networks on raw sensors: their first layer, their critic, and how they learn and are written to a file."""

from __future__ import annotations

import importlib
import json
import re
import signal
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from safetensors.numpy import load_file
from test_train import CONFIG, SHORT

from baselines import load_policy
from baselines.data.episodes import entry_names
from baselines.policies.history import History
from baselines.training.config import load_config
from baselines.training.sensor_layer import (
    ERROR_SCALES_MM,
    RATE_SCALES_MM_S,
    SPEED_SCALES_MM_S,
    TURN_SCALES_RAD_S,
    sensor_layer,
)
from tlf_env.task.actions import FULL_WHEEL_SPEED_RAD_S
from tlf_env.task.observation import SENSOR_TAIL_ENTRIES, sensor_entries
from tlf_env.task.scenario import load_scenario

DOCS = Path(__file__).resolve().parents[1] / "docs"
KEPT = (
    *(f"{name}_{k}" for k in (9, 19) for name in ("fix_x", "fix_y", "step_l", "step_r")),
    "message_x",
    "message_y",
    "message_u_1",
    "message_u_2",
)
HISTORY = {"observations": 8, "mean_of": 1, "entries": list(KEPT)}
SENSORS = load_scenario("infinity", observation="sensor", action="wheel_speed")
NAMES = entry_names(SENSORS)
LAYER = sensor_layer(SENSORS, History(**HISTORY))
PERIOD_S, STEPS = SENSORS.control_period_s, SENSORS.substeps
ROBOT = SENSORS.robot_models[0]
SCALES = {name: entry.scale for name, entry in sensor_entries(STEPS).items()}
TRAINING = {
    **CONFIG,
    "scenario": {"observation": "sensor", "action": "wheel_speed", **SHORT},
    "network": {"hidden": [16, 8], "activation": "relu", "input": "sensor", "history": HISTORY},
}


def readings(at: dict[str, float]) -> np.ndarray:
    """An observation with these values, in their units, and 0 elsewhere."""
    row = np.zeros(len(NAMES))
    for name, value in at.items():
        row[NAMES.index(name)] = value / SCALES[name]
    return row


def driven(
    start: np.ndarray, velocity: np.ndarray, twist: tuple[float, float], wheels: tuple[float, float]
) -> np.ndarray:
    """Input of a robot whose error (x, y; mm) changes at a constant rate, the reference at (700, −300)."""
    rows = []
    for ago in range(HISTORY["observations"] + 1):
        error = start - ago * PERIOD_S * velocity
        at = {"message_x": 700.0, "message_y": -300.0}
        at |= {"message_u_1": twist[0], "message_u_2": twist[1]}
        for k in range(STEPS):
            at |= {f"fix_x_{k}": 700.0 + error[0], f"fix_y_{k}": -300.0 + error[1]}
            at |= {
                f"step_{side}_{k}": w * PERIOD_S / STEPS
                for side, w in zip("lr", wheels, strict=True)
            }
        rows.append(readings(at))
    kept = [NAMES.index(name) for name in KEPT]
    return np.concatenate([rows[0], *(row[kept] for row in rows[1:])])


@given(
    st.floats(-400, 400),
    st.floats(-400, 400),
    st.floats(-300, 300),
    st.floats(-300, 300),
)
def test_features_are_errors_and_their_rates_in_several_scales(x, y, v_x, v_y):
    still = driven(np.array([x, y]), np.array([v_x, v_y]), (0.0, 0.0), (0.0, 0.0))
    found = LAYER.weight.astype(np.float64) @ still
    each = len(ERROR_SCALES_MM) + 3 * len(
        RATE_SCALES_MM_S
    )  # the longest of four spans is not there
    for axis, (error, rate) in enumerate(((x, v_x), (y, v_y))):
        mine = found[axis * each : (axis + 1) * each]
        wanted = [error / scale for scale in ERROR_SCALES_MM]
        wanted += [rate / scale for scale in RATE_SCALES_MM_S] * 3
        assert mine == pytest.approx(wanted, abs=2e-3)


@given(st.floats(-300, 300), st.floats(-2, 2), st.floats(-300, 300), st.floats(-2, 2))
def test_wheels_are_seen_against_the_reference(u_1, u_2, reference_1, reference_2):
    body = (ROBOT.wheel_radius_mm, ROBOT.axle_width_mm / 2)
    wheels = ((u_1 - body[1] * u_2) / body[0], (u_1 + body[1] * u_2) / body[0])
    zero = np.zeros(2)
    found = LAYER.weight.astype(np.float64) @ driven(zero, zero, (reference_1, reference_2), wheels)
    first = 2 * (len(ERROR_SCALES_MM) + 3 * len(RATE_SCALES_MM_S))
    speed, turn = u_1 - reference_1, u_2 - reference_2
    each = len(SPEED_SCALES_MM_S) + 3
    wanted = [speed / scale for scale in SPEED_SCALES_MM_S] + [speed / SPEED_SCALES_MM_S[0]] * 3
    assert found[first : first + each] == pytest.approx(wanted, abs=1e-3)
    wanted = [turn / scale for scale in TURN_SCALES_RAD_S] + [turn / TURN_SCALES_RAD_S[0]] * 3
    assert found[first + each : first + 2 * each] == pytest.approx(wanted, abs=1e-3)


def test_the_carried_twist_makes_the_reference_s_wheel_speeds():
    twist = (230.0, -0.7)
    entries = [
        value / SENSOR_TAIL_ENTRIES[f"message_u_{i}"].scale
        for i, value in enumerate(twist, start=1)
    ]
    body = SENSORS.robot_models[0]
    left, right = LAYER.wheels @ entries * FULL_WHEEL_SPEED_RAD_S * body.wheel_radius_mm
    half = body.axle_width_mm / 2
    assert (left, right) == pytest.approx((twist[0] - half * twist[1], twist[0] + half * twist[1]))


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"algorithm": "SAC", "settings": {}}, "network.input sensor needs algorithm PPO, got SAC"),
        (
            {"network": {**TRAINING["network"], "activation": "tanh"}},
            "network.input sensor needs network.activation relu, got tanh",
        ),
        (
            {"network": {**TRAINING["network"], "history": None}},
            "network.input sensor needs network.history",
        ),
        (
            {"imitation": {"data": "runs.parquet"}},
            "network.input sensor needs imitation.data None, got runs.parquet",
        ),
        (
            {"network": {**TRAINING["network"], "history": {**HISTORY, "mean_of": 2}}},
            "at least 2 observations with mean_of 1; it has 8 with mean_of 2",
        ),
        (
            {
                "network": {
                    **TRAINING["network"],
                    "history": {**HISTORY, "entries": list(KEPT[1:9])},
                }
            },
            "history.entries lacks message_y, message_u_1, message_u_2",
        ),
        (
            {"network": {**TRAINING["network"], "history": {**HISTORY, "entries": list(KEPT[8:])}}},
            "history.entries lacks fix_x_0 or a later one, fix_y_0 or a later one",
        ),
        (
            {
                "scenario": {**TRAINING["scenario"], "observation": "tracking"},
                "network": {**TRAINING["network"], "history": {"observations": 8}},
            },
            "needs observation sensor, the scenario has 'tracking'",
        ),
        (
            {"scenario": {**TRAINING["scenario"], "action": "twist"}},
            "input sensor needs action wheel_speed, the scenario has 'twist'",
        ),
        ({"network": {"input": "camera"}}, "network.input: Input should be 'sensor', got 'camera'"),
    ],
)
def test_a_wrong_config_is_reported_in_one_line(changes: dict, said: str):
    with pytest.raises(ValueError, match=re.escape(said)) as error:
        load_config({**TRAINING, **changes})
    assert "\n" not in str(error.value)


def test_the_page_has_what_was_measured(monkeypatch):
    """The table, and that no nominal run fails with any of three training seeds."""
    monkeypatch.syspath_prepend(str(DOCS / "figures"))
    make_sensors = importlib.import_module("make_sensors")
    kept = json.loads((DOCS / "learning" / "sensors.json").read_text("utf-8"))
    section = (DOCS / "learning.md").read_text("utf-8").split("## Raw sensors")[1].split("\n## ")[0]
    assert make_sensors.judged_table(kept) in section
    trained = [one for name, one in kept.items() if name.startswith("seed_")]
    assert len(trained) == 3
    lost = {
        head: sum(len(one["cells"][head]["failed"]) for one in trained)
        for head in trained[0]["cells"]
    }
    assert lost["∞, nominal"] == lost["flower, nominal"] == 0
    assert {one["cells"]["∞, nominal"]["runs"] for one in trained} == {100}
    assert f"{lost['`slip`']} of 90 runs under `slip`" in section
    board = kept["seed_0"]["board"]
    score, (low, high) = board["score"]["iqm"], board["score"]["interval"]
    assert (
        f"a score of {score:.1f} [{low:.1f}, {high:.1f}] with seed 0, "
        f"{board['failed']} of {board['runs']} runs failed" in section
    )
    worst = board["failed_of"]
    assert sum(worst.values()) == board["failed"]
    assert f"(`fixes-outage`, {worst['infinity, fixes-outage']} of 100 on the ∞)" in section
    assert f"under `slip-noise` ({worst['infinity, slip-noise']} of 100)" in section
    published = json.loads((DOCS / "leaderboard" / "leaderboard.json").read_text("utf-8"))
    better = sum(one["score"]["iqm"] > score for one in published["policies"])
    assert (better, len(published["policies"])) == (8, 10)
    assert "ninth of eleven" in section
    training = [one["training"] for name, one in sorted(kept.items()) if name.startswith("seed_")]
    assert all(one["kept_at"] == 0 for one in training)  # PPO added nothing
    for name in ("imitated_mm", "ended_mm"):
        assert "{:.1f}, {:.1f} and {:.1f}".format(*(one[name] for one in training)) in section


class TestWithTorch:
    @pytest.fixture(autouse=True)
    def _needs(self):
        pytest.importorskip("torch")
        pytest.importorskip("stable_baselines3")

    @pytest.fixture
    def made(self):
        """Environments and a model in the middle of their episodes."""
        from baselines.training.model import make_envs, make_model

        config = load_config({**TRAINING, "network": {**TRAINING["network"], "action_gain": 1.0}})
        envs = make_envs(config, 1)
        model = make_model(config, envs, 0)
        envs.seed(5)
        found = envs.reset()
        for _ in range(40):
            found = envs.step(model.predict(found)[0])[0]
        return config, envs, model, found

    def test_the_actor_sees_the_readings_and_the_critic_the_truth(self, made):
        import torch

        _, envs, model, found = made
        readings = envs.layer.weight.shape[1]
        changed = {"readings": found.copy(), "truth": found.copy()}
        changed["readings"][:, :readings] += 0.01
        changed["truth"][:, readings:] += 0.5
        heads = {}
        for name, rows in {"as it is": found, **changed}.items():
            with torch.no_grad():
                distribution = model.policy.get_distribution(torch.from_numpy(rows))
                value = model.policy.predict_values(torch.from_numpy(rows))
            heads[name] = distribution.distribution.mean.numpy(), value.numpy()
        np.testing.assert_array_equal(heads["truth"][0], heads["as it is"][0])
        np.testing.assert_array_equal(heads["readings"][1], heads["as it is"][1])
        assert (heads["truth"][1] != heads["as it is"][1]).any()
        assert (heads["readings"][0] != heads["as it is"][0]).any()

    def test_the_truth_is_the_state_about_the_reference(self, made):
        from baselines.training.sensor_policy import TRUTH_SCALES, TRUTHS, truth

        _, envs, _, found = made
        plant = envs.plants[0]
        rows = truth(plant.arrays)
        assert rows.shape[1] == TRUTHS == found.shape[1] - envs.layer.weight.shape[1]
        places = np.cumsum([0, *map(len, TRUTH_SCALES.values())])
        at = dict(zip(TRUTH_SCALES, places, strict=False))
        e_1, e_2 = (rows[:, at[name]] * TRUTH_SCALES[name][0] for name in ("e_1", "e_2"))
        distance = plant.info("position_error_mm").ravel()
        np.testing.assert_allclose(np.hypot(e_1, e_2), distance, rtol=1e-5, atol=1e-3)
        turned = plant.info("reference_theta_rad") - plant.info("theta_rad")
        np.testing.assert_allclose(rows[:, at["sin_e_3"]], np.sin(turned.ravel()), atol=1e-9)
        assert rows[:, at["is_leader"]].tolist() == [1.0, 0.0, 0.0] * plant.formations

    def test_without_gain_it_drives_the_twist_of_the_reference(self):
        from baselines.training.model import make_envs, make_model

        config = load_config({**TRAINING, "network": {**TRAINING["network"], "action_gain": 1e-9}})
        envs = make_envs(config, 1)
        envs.seed(0)
        found = envs.reset()
        actions, _ = make_model(config, envs, 0).predict(found, deterministic=True)
        columns = [NAMES.index(f"message_u_{i}") for i in (1, 2)]
        np.testing.assert_allclose(actions, found[:, columns] @ LAYER.wheels.T, atol=1e-6)

    def test_the_file_drives_as_the_model_does(self, made, tmp_path):
        """Step by step, with resets in between; features beyond their limit, too."""
        from baselines.training.export import export_policy

        config, envs, model, _ = made
        path = tmp_path / "policy.safetensors"
        scenario = config.mixture()[0]["infinity"][0]
        card = export_policy(model, path, scenario, training={}, seeds={"learner": [0]})
        features = len(envs.layer.weight)
        assert card.network.hidden == (2 * features + 2, 16 + 2, 8 + 2)
        policy, state = load_policy(path), None
        found, start, clipped, ended = envs.reset(), np.ones(envs.num_envs, dtype=bool), 0, 0
        for _ in range(150):
            wanted, _ = model.predict(found, deterministic=True)
            action, state = policy.predict(found[:, : len(card.entries)], state, start)
            np.testing.assert_allclose(action, wanted, atol=1e-5)
            seen = found[:, : envs.layer.weight.shape[1]] @ envs.layer.weight.T
            clipped += int((np.abs(seen) > 10).sum())
            found, _, start, _ = envs.step(wanted)
            ended += int(start.sum())
        assert ended > 0
        assert clipped > 0

    def test_imitation_brings_the_network_near_its_teacher(self, monkeypatch):
        """It drives in all rounds but the first; its error falls, and the critic is fitted to the returns."""
        from baselines.training import sensor_imitation
        from baselines.training.model import make_envs, make_model

        fields = {"horizon_s": 8.0}
        changes = {
            "formations": 8,
            "tasks": {"infinity": fields},
            "disturbances": {"nominal": 1},
            "network": {**TRAINING["network"], "hidden": [32, 32]},
            "imitation": {
                "robot_steps": 19_200,
                "rounds": 4,
                "window": 3,
                "epochs": 20,
                "noise": 0.003,
            },
        }
        config = load_config({**TRAINING, **changes})
        envs = make_envs(config, 1)
        model = make_model(config, envs, 0)
        rounds, drive = [], sensor_imitation._drive

        def watched(model, envs, teacher, alone, *more):
            found = drive(model, envs, teacher, alone, *more)
            rounds.append((alone, found[0]))
            if not alone:
                rounds.append(apart())
            return found

        def apart():
            """From the teacher, in the rows that it drove."""
            with sensor_imitation.torch.no_grad():
                rows = rounds[0][1]
                return float(sensor_imitation.loss_of(model.policy, rows.features, rows.added))

        monkeypatch.setattr(sensor_imitation, "_drive", watched)
        envs.seed(0)
        envs.reset()
        before = model.policy.value_net.weight.clone()
        sensor_imitation.imitate_with_sensors(model, envs, config)
        first = rounds.pop(1)
        assert [alone for alone, _ in rounds] == [False, True, True, True]
        assert apart() < 0.5 * first
        assert (model.policy.value_net.weight != before).any()

    def test_an_interrupted_training_continues_to_the_same_policy(self, tmp_path):
        from baselines.training.train import CHECKPOINT_FILE, POLICY_FILE, train

        small = {"robot_steps": 240, "rounds": 2, "epochs": 1}
        config = load_config({**TRAINING, "imitation": small})
        train(config, 3, tmp_path / "whole")
        stops = []

        def interrupt(done: int, total: int) -> None:
            stops.append(done)
            if len(stops) == 2:
                signal.raise_signal(signal.SIGINT)

        with pytest.raises(KeyboardInterrupt):
            train(config, 3, tmp_path / "parts", progress=interrupt)
        train(config, 3, tmp_path / "parts")
        mine, theirs = (tmp_path / one / POLICY_FILE for one in ("parts", "whole"))
        assert mine.read_bytes() == theirs.read_bytes()
        mine, theirs = (load_file(tmp_path / one / CHECKPOINT_FILE) for one in ("parts", "whole"))
        for key, tensor in theirs.items():
            assert mine[key].tobytes() == tensor.tobytes(), key
