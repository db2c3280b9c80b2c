"""``tlf train``: it resumes to the same result and refuses what it cannot do."""

from __future__ import annotations

import json
import re
import signal
import sys
import threading
import time
from pathlib import Path

import pytest
import yaml
from campaign.jobs import TRAINING
from safetensors.numpy import load_file

from baselines import load_policy
from baselines.cli import main
from baselines.training.config import load_config
from tlf_env.common.presets import presets_folder

SHORT = {"horizon_s": 2.0, "time_gap_s": 1.0, "preview_s": [0.5]}
CONFIG = {
    **TRAINING,
    "robot_steps": 600,
    "tasks": {"infinity": {}, "flower": {"robots": 3, "horizon_s": 3.0}},
    "disturbances": {"nominal": 1, "slip": 2, "combined-hard": 1},
    "levels": [0.5, 1.0],
    "final_learning_rate_share": 0.1,
}
WITH_A_BUFFER = {
    "robot_steps": 2400,
    "checkpoint_every": 768,
    "settings": {"buffer_size": 2000, "learning_starts": 100, "batch_size": 32},
}
ALGORITHMS = {
    "PPO": {},
    **{name: {"algorithm": name, **WITH_A_BUFFER} for name in ("SAC", "TQC", "CrossQ")},
    "SAC with a fixed entropy coefficient": {
        "algorithm": "SAC",
        **WITH_A_BUFFER,
        "settings": {**WITH_A_BUFFER["settings"], "ent_coef": 0.01, "n_steps": 3},
    },
    "PPO with a curriculum": {
        "curriculum": {"failed_share": 0.9},
        "tasks": {"infinity": {"horizon_s": 0.2}},
        "scenario": {**CONFIG["scenario"], "time_gap_s": 0.1, "preview_s": [0.02]},
    },
    "RecurrentPPO": {
        "algorithm": "RecurrentPPO",
        "network": {"hidden": [8], "lstm": 8},
        "scenario": {"observation": "sensor", "action": "twist", **SHORT},
    },
}


@pytest.mark.parametrize("path", sorted((presets_folder("training")).glob("*.yaml")), ids=str)
def test_shipped_configs_are_valid(path: Path):
    config = load_config(path)
    tasks, shares = config.mixture()
    assert all(len(scenarios) == len(shares) for scenarios in tasks.values())


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        (
            {"algorithm": "A2C"},
            "algorithm: Input should be 'PPO', 'SAC', 'TQC', 'CrossQ', 'RecurrentPPO' or 'TD3BC'",
        ),
        ({"robot_steps": 0}, "robot_steps: Input should be greater than or equal to 1, got 0"),
        ({"rollouts": 3}, "rollouts: unknown key"),
        (
            {"seeds": [0, 20_001]},
            "seeds 0 to 20000 must lie within 0 to 9999: seeds 0 to 9999 train and tune",
        ),
        ({"seeds": [5, 5]}, "seeds 5:5 must be FIRST:END with FIRST below END"),
        (
            {"evaluation": {**CONFIG["evaluation"], "seeds": [20_000, 20_050]}},
            "evaluation seeds 20000 to 20049 must lie within 10000 to 19999",
        ),
        ({"disturbances": {"storm": 1}}, "disturbance 'storm' is not one of"),
        ({"disturbances": {"slip": 0}}, "at least one share must be above 0"),
        ({"tasks": {"square": {}}}, "scenario 'square' is not one of"),
        ({"tasks": {"infinity": {"speed": 1}}}, "speed: unknown key"),
        ({"tasks": {"turned": {"base": "infiniti"}}}, "scenario 'infiniti' is not one of"),
        ({"tasks": {"turned": {"base": 3}}}, "tasks.turned.base 3 must be the name of a scenario"),
        (
            {"network": {"lstm": 8}},
            "RecurrentPPO, and no other algorithm, needs network.lstm; got 8",
        ),
        (
            {"algorithm": "RecurrentPPO"},
            "RecurrentPPO, and no other algorithm, needs network.lstm; got None",
        ),
        ({"settings": {"seed": 3}}, "settings.seed is set by the training"),
        (
            {"levels": [1.0], "curriculum": {}},
            "at least two levels that increase, got levels [1.0]",
        ),
        ({"levels": [1.0, 0.5], "curriculum": {}}, "that increase, got levels [1.0, 0.5]"),
        ({"curriculum": {"failed_share": 1.0}}, "failed_share: Input should be less than 1"),
        ({"algorithm": "SAC", "imitation": {}}, "imitation needs algorithm PPO, got SAC"),
        ({"precision": "half"}, "precision: Input should be 'double' or 'single'"),
    ],
)
def test_a_wrong_config_is_reported_in_one_line(changes: dict, said: str):
    with pytest.raises(ValueError, match=re.escape(said)) as error:
        load_config({**CONFIG, **changes})
    assert "\n" not in str(error.value)


def test_a_task_may_be_built_on_another(tmp_path):
    (tmp_path / "own.yaml").write_text("base: infinity\nrobots: 4\n", encoding="utf-8")
    tasks = {
        "mirrored": {"base": "infinity", "trajectory": {"phase_y_rad": 3.0}},
        "more": {"base": "own.yaml"},
    }
    path = tmp_path / "training.yaml"
    path.write_text(json.dumps({**CONFIG, "tasks": tasks}), encoding="utf-8")
    found, _ = load_config(path).mixture()
    mirrored, more = (found[task][0] for task in tasks)
    assert mirrored.name == "mirrored"
    assert mirrored.trajectory.phase_y_rad == 3.0
    assert mirrored.trajectory.amplitude_x_mm == 2000
    assert (more.name, more.robots) == ("more", 4)


def test_a_disturbance_may_have_a_level_of_its_own():
    tasks, shares = load_config(
        {**CONFIG, "disturbances": {"ice@1.3": 2, "slip": 1}, "levels": [0.5, 1.0]}
    ).mixture()
    drawn = [(one.disturbance.name, one.disturbance.level) for one in tasks["infinity"]]
    assert drawn == [("ice", 0.65), ("ice", 1.3), ("slip", 0.5), ("slip", 1.0)]
    assert shares == [2, 2, 1, 1]
    evaluated = load_config(
        {**CONFIG, "evaluation": {**CONFIG["evaluation"], "disturbances": ["ice@1.3"]}}
    ).evaluation_scenarios()
    assert {one.disturbance.level for one in evaluated.values()} == {1.3}
    assert set(evaluated) == {("infinity", "ice@1.3"), ("flower", "ice@1.3")}
    with pytest.raises(ValueError, match=re.escape("'ice@much' is not one of")):
        load_config({**CONFIG, "disturbances": {"ice@much": 1}})


def test_presets_have_names():
    assert load_config("quick") == load_config(presets_folder("training") / "quick.yaml")
    with pytest.raises(ValueError, match="training 'quickly' is not one of curriculum, direct"):
        load_config("quickly")


def command(tmp_path: Path, *words: str, **changes: object) -> list[str]:
    path = tmp_path / "small.yaml"
    path.write_text(yaml.safe_dump({**CONFIG, **changes}))
    return ["tlf", "train", str(path), "--out", str(tmp_path / "out"), *words]


def test_without_its_packages_training_reports_what_to_install(tmp_path, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "stable_baselines3", None)
    first = ("baselines.training", "baselines.sb3", "baselines.commands")
    loaded = [name for name in sys.modules if name.startswith(first)]
    for name in loaded:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setattr("sys.argv", command(tmp_path))
    with pytest.raises(SystemExit) as ended:
        main()
    assert ended.value.code == 2
    assert "pip install 'tlf-env[train]'" in capsys.readouterr().err


class TestTraining:
    """What needs stable-baselines3, sb3-contrib and torch."""

    @pytest.fixture(autouse=True)
    def _packages(self):
        pytest.importorskip("stable_baselines3")
        pytest.importorskip("sb3_contrib")

    @pytest.mark.parametrize("name", ALGORITHMS)
    def test_an_interrupted_training_continues_to_the_same_policy(
        self, name, tmp_path, monkeypatch
    ):
        from baselines.training.train import (
            CHECKPOINT_FILE,
            POLICY_FILE,
            FormationVecEnv,
            train,
        )

        monkeypatch.setattr(sys.modules[FormationVecEnv.__module__], "ENDS_KEPT", 20)
        config = load_config({**CONFIG, **ALGORITHMS[name]})
        whole = train(config, 3, tmp_path / "whole")
        assert whole["level_count"] == (2 if config.curriculum else 1)
        stops = []

        def interrupt(done: int, total: int) -> None:
            stops.append(done)
            if len(stops) in (1, 3):
                signal.raise_signal(signal.SIGINT)  # in this thread, not in one of a library

        parts = tmp_path / "parts"
        for _ in range(2):
            with pytest.raises(KeyboardInterrupt):
                train(config, 3, parts, progress=interrupt)
            assert (parts / CHECKPOINT_FILE).exists()
        again = train(config, 3, parts)
        for curve in (whole, again):
            times_s = curve.pop("evaluated_at_s")
            assert len(times_s) == len(curve["evaluations"])
            assert times_s == sorted(times_s)
            assert times_s[0] > 0
            assert times_s[-1] <= curve.pop("processor_time_s")
            assert curve.pop("wall_time_s") > 0
        assert whole == again
        assert len(whole["evaluations"]) >= 3
        assert (parts / POLICY_FILE).read_bytes() == (tmp_path / "whole" / POLICY_FILE).read_bytes()
        mine, theirs = (load_file(tmp_path / one / CHECKPOINT_FILE) for one in ("parts", "whole"))
        assert mine.keys() == theirs.keys()
        for name, tensor in theirs.items():
            assert mine[name].tobytes() == tensor.tobytes(), name

    @pytest.mark.parametrize("algorithm", ["PPO", "SAC", "TQC", "CrossQ"])
    def test_the_first_draws_have_the_deviation_of_the_configuration(self, algorithm):
        import numpy as np
        import torch

        from baselines.training.model import make_envs, make_model

        network = {"hidden": [16], "initial_log_std": -1.2, "action_gain": 0.01}
        settings = ALGORITHMS[algorithm].get("settings", CONFIG["settings"])
        config = load_config(
            {**CONFIG, "algorithm": algorithm, "settings": settings, "network": network}
        )
        envs = make_envs(config, 1)
        model = make_model(config, envs, 0)
        torch.manual_seed(0)
        drawn, _ = model.predict(np.tile(envs.reset(), (500, 1)), deterministic=False)
        before_the_tanh = drawn if algorithm == "PPO" else np.arctanh(drawn)
        np.testing.assert_allclose(before_the_tanh.mean(axis=0), 0.0, atol=0.03)
        np.testing.assert_allclose(np.log(before_the_tanh.std(axis=0)), -1.2, atol=0.03)

    def test_episodes_are_run_in_the_precision_of_the_configuration(self, tmp_path):
        from baselines.training.model import make_envs
        from baselines.training.train import train

        curves = {}
        for precision in ("double", "single"):
            config = load_config({**CONFIG, "precision": precision})
            assert {plant.precision for plant in make_envs(config, 1).plants} == {precision}
            curves[precision] = train(config, 3, tmp_path / precision)["evaluations"]
        first, later = ([curves[one][i] for one in curves] for i in (0, -1))
        assert first[0] == first[1], "the policy before the training, evaluated in double precision"
        assert later[0] != later[1]

    def test_a_killed_training_continues_from_its_last_checkpoint(self, tmp_path):
        from baselines.training.train import POLICY_FILE, train

        config = load_config(CONFIG)

        def die(done: int, total: int) -> None:
            if done > 360:  # later than the checkpoint, and than the evaluation
                raise RuntimeError

        with pytest.raises(RuntimeError):
            train(config, 3, tmp_path / "parts", progress=die)
        again = train(config, 3, tmp_path / "parts")
        whole = train(config, 3, tmp_path / "whole")
        assert again["evaluations"] == whole["evaluations"]
        assert again["rollouts"] == whole["rollouts"]
        assert (tmp_path / "parts" / POLICY_FILE).read_bytes() == (
            tmp_path / "whole" / POLICY_FILE
        ).read_bytes()

    def test_the_first_policy_is_the_reference_and_the_kept_one_the_best(self, tmp_path):
        from baselines import ReferencePolicy
        from baselines.training.curve import kept_evaluation
        from baselines.training.scoring import score_policy
        from baselines.training.train import train

        config = load_config({**CONFIG, "network": {"hidden": [16], "action_gain": 1e-9}})
        curve = train(config, 0, tmp_path)
        twist = load_config({**CONFIG, "scenario": {**CONFIG["scenario"], "action": "twist"}})
        seeds = range(*CONFIG["evaluation"]["seeds"])
        policy = ReferencePolicy("tuned", preview_s=(0.5,))
        reference = score_policy(policy, twist.evaluation_scenarios(), seeds)
        for name, cell in curve["evaluations"][0]["cells"].items():
            assert cell["score_mm"] == pytest.approx(reference[name].score_mm, rel=1e-4)
        policy = load_policy(tmp_path / "policy.safetensors")
        assert policy.card.scores["kept"] == kept_evaluation(curve)
        assert policy.card.residual_base == "tuned"
        found = score_policy(policy, config.evaluation_scenarios(), seeds)
        for name, cell in kept_evaluation(curve)["cells"].items():
            assert found[name].score_mm == pytest.approx(cell["score_mm"], rel=1e-3)

    def test_other_content_of_a_disturbances_file_is_another_training(self, tmp_path):
        from baselines.training.train import check_folder

        path = tmp_path / "gusts.yaml"
        shares = {"nominal": 1, str(path): 2}
        path.write_text("slip: {delta_1_mm_s: 20}", encoding="utf-8")
        check_folder(load_config({**CONFIG, "disturbances": shares}), 0, tmp_path / "out")
        check_folder(load_config({**CONFIG, "disturbances": shares}), 0, tmp_path / "out")
        path.write_text("slip: {delta_1_mm_s: 30}", encoding="utf-8")
        with pytest.raises(ValueError, match="holds a training with a different 'scenarios'"):
            check_folder(load_config({**CONFIG, "disturbances": shares}), 0, tmp_path / "out")

    def test_imitation_brings_the_network_near_the_reference(self):
        import numpy as np

        from baselines import ReferencePolicy
        from baselines.training.imitation import imitate
        from baselines.training.model import make_envs, make_model, spread_out

        fields = {**SHORT, "horizon_s": 10.0, "action": "twist", "estimator": "ekf-slip"}
        config = load_config(
            {
                **CONFIG,
                "scenario": fields,
                "imitation": {"robot_steps": 20_000, "epochs": 40},
                "network": {"hidden": [32, 32]},
            }
        )
        envs = make_envs(config, 1)
        model = make_model(config, envs, 0)
        spread_out(model, envs, 0)
        imitate(model, envs, config)
        seen = envs.observations()
        meant = ReferencePolicy("tuned", preview_s=(0.5,)).predict(seen)[0]
        apart = np.abs(model.predict(seen, deterministic=True)[0] - meant).mean()
        assert apart < 0.5 * np.abs(meant).mean()  # what an action of 0 is apart, halved
        assert np.array_equal(model._last_obs, seen)

    def test_after_the_first_round_of_an_imitation_the_network_drives(self, monkeypatch):
        """And the teacher still says what it should have done; no round gets lost."""
        from baselines.training import imitation
        from baselines.training.model import make_envs, make_model

        fields = {**SHORT, "horizon_s": 10.0, "action": "twist", "estimator": "ekf-slip"}
        config = load_config(
            {
                **CONFIG,
                "scenario": fields,
                "imitation": {"robot_steps": 600, "rounds": 3, "epochs": 1, "noise": 0.0},
            }
        )
        envs = make_envs(config, 1)
        model = make_model(config, envs, 0)
        envs.seed(0)
        envs.reset()
        drivers, fitted = [], []
        drive, fit = imitation._drive, imitation._fit

        def watched(model_, envs_, driver, teacher, *rest):
            drivers.append("teacher" if driver is teacher else "network")
            rows = drive(model_, envs_, driver, teacher, *rest)
            taught = teacher.predict(rows.seen)[0]
            assert abs(taught - rows.meant).max() < 1e-6
            return rows

        def counted(model_, seen, *rest):
            fitted.append(len(seen))
            fit(model_, seen, *rest)

        monkeypatch.setattr(imitation, "_drive", watched)
        monkeypatch.setattr(imitation, "_fit", counted)
        imitation.imitate(model, envs, config)
        assert drivers == ["teacher", "network", "network"]
        assert fitted == [fitted[0], 2 * fitted[0], 3 * fitted[0]]
        assert 600 <= fitted[-1] < 600 + 3 * envs.num_envs

    def test_another_training_in_the_folder_is_refused(self, tmp_path):
        from baselines.training.train import train

        train(load_config(CONFIG), 0, tmp_path)
        with pytest.raises(ValueError, match="holds a training with a different 'seed'"):
            train(load_config(CONFIG), 1, tmp_path)
        with pytest.raises(ValueError, match="holds a training with a different 'config'"):
            train(load_config(CONFIG, robot_steps=900), 0, tmp_path)

    @pytest.mark.skipif(not Path("/proc/self").is_dir(), reason="a folder that cannot be written")
    def test_a_folder_that_cannot_be_written_is_no_matter_of_tensorboard(self, monkeypatch):
        """Its thread, which writes, would end with a traceback."""
        pytest.importorskip("tensorboard")
        from baselines.training.train import tensorboard

        failed = []
        monkeypatch.setattr(threading, "excepthook", failed.append)
        with pytest.raises(OSError, match="/proc/self"):
            tensorboard(Path("/proc/self"))
        time.sleep(0.2)
        assert failed == []

    @pytest.mark.parametrize("damage", ["cut", "text", "other"])
    def test_a_damaged_checkpoint_is_reported_in_one_line(self, damage, tmp_path):
        from baselines.training.train import CHECKPOINT_FILE, train

        config = load_config(CONFIG)
        train(config, 0, tmp_path)
        path = tmp_path / CHECKPOINT_FILE
        if damage == "cut":
            path.write_bytes(path.read_bytes()[:-100])
        elif damage == "text":
            path.write_text("nothing")
        else:
            other = load_config({**CONFIG, "network": {"hidden": [8]}})
            train(other, 0, tmp_path / "other")
            path.write_bytes((tmp_path / "other" / CHECKPOINT_FILE).read_bytes())
        with pytest.raises(ValueError, match="cannot resume from") as error:
            train(config, 0, tmp_path)
        assert "\n" not in str(error.value)

    @pytest.mark.parametrize(
        ("settings", "said"),
        [
            ({"n_step": 10}, "settings.n_step is not one of"),
            ({"n_steps": "many"}, "settings: PPO refuses them"),
        ],
    )
    def test_settings_that_the_algorithm_refuses(self, settings, said, tmp_path):
        from baselines.training.train import train

        with pytest.raises(ValueError, match=said):
            train(load_config({**CONFIG, "settings": settings}), 0, tmp_path)

    @pytest.mark.slow
    def test_a_training_shows_the_default_and_what_comes_next(self, tmp_path, monkeypatch, capsys):
        path = tmp_path / "small.yaml"
        path.write_text(yaml.safe_dump(CONFIG), encoding="utf-8")
        monkeypatch.setattr("sys.argv", ["tlf", "train", str(path), "--out", str(tmp_path / "out")])
        main()
        answer = capsys.readouterr()
        curve = json.loads((tmp_path / "out/seed_0/curve.json").read_text(encoding="utf-8"))
        default = json.loads((tmp_path / "out/default.json").read_text(encoding="utf-8"))
        lines = answer.err.splitlines()
        assert (
            f"The default system in the same evaluation: {default['score_mm']:.2f} mm, 0 of 4"
            in answer.err
        )
        for one in curve["evaluations"]:
            steps = (
                f"seed 0, {one['robot_steps'] / 1e6:.2f} M robot steps: {one['score_mm']:.2f} mm"
            )
            assert sum(line.startswith(steps) for line in lines) == 1
        policy = tmp_path / "out" / "policy.safetensors"
        assert f"tlf run infinity --policy {policy}" in answer.out
        assert f"tensorboard --logdir {tmp_path / 'out'}" in answer.out
        monkeypatch.setattr("sys.argv", ["tlf", "train", str(path), "--out", str(tmp_path / "out")])
        main()  # finished: nothing is scored or evaluated again
        assert "robot steps:" not in capsys.readouterr().err

    def test_seeds_side_by_side_are_the_seeds_alone(self, tmp_path, monkeypatch, capsys):
        monkeypatch.setattr("sys.argv", command(tmp_path, "--seeds", "0,1", "--json"))
        main()
        rows = json.loads(capsys.readouterr().out)
        assert [row["seed"] for row in rows] == [0, 1]
        words = command(tmp_path, "--seeds", "0,1", "--processes", "1", "--json")
        words[words.index("--out") + 1] = str(tmp_path / "alone")
        monkeypatch.setattr("sys.argv", words)
        main()
        assert json.loads(capsys.readouterr().out) == rows
        best = min(rows, key=lambda row: row["kept"]["score_mm"])["seed"]
        for folder in (tmp_path / "out", tmp_path / "alone"):
            policy = (folder / "policy.safetensors").read_bytes()
            assert policy == (folder / f"seed_{best}" / "policy.safetensors").read_bytes()

    def test_a_level_is_added_when_few_enough_episodes_fail(self):
        from baselines.training.curve import TrainingProgress
        from baselines.training.model import make_envs
        from baselines.training.train import raise_level, set_level
        from tlf_env import EndReason

        config = load_config({**CONFIG, "formations": 40, "curriculum": {"failed_share": 0.1}})
        envs, done = make_envs(config, 1), TrainingProgress()
        set_level(envs, config, done)

        def drawn() -> set[float]:
            envs.reset()
            levels = [one.disturbance.level for one in envs.get_attr("scenario")]
            return set(levels)

        assert drawn() == {0.5}
        for ends, count in (
            ([EndReason.HORIZON] * 99, 1),  # too few
            ([EndReason.HORIZON] * 89 + [EndReason.LOST] * 11, 1),
            ([EndReason.HORIZON] * 90 + [EndReason.OTHER_ROBOT] * 10, 2),
            ([EndReason.HORIZON] * 100, 2),  # there is no further level
        ):
            envs.last_ends.clear()
            envs.last_ends.extend(ends)
            raise_level(envs, config, done)
            assert done.level_count == count
        assert drawn() == {0.5, 1.0}

    @pytest.mark.slow
    def test_from_nothing_it_learns_to_follow(self, tmp_path):
        """Before, every run is lost. It takes a minute and a half."""
        from baselines.training.train import train

        config = load_config("scratch", robot_steps=1_200_000)
        curve = train(config, 0, tmp_path)
        first, last = curve["evaluations"][0], curve["evaluations"][-1]
        assert first["cells"]["infinity, nominal"]["failed"] == 10
        assert last["cells"]["infinity, nominal"]["failed"] == 0
        assert last["cells"]["infinity, nominal"]["position_rmse_mm"] < 100.0


def test_the_default_is_scored_in_the_same_tasks():
    """With its own action and filter, in the learner's tasks, gaps and disturbances."""
    config = load_config({**CONFIG, "scenario": {**CONFIG["scenario"], "reward": {"alive": 1.0}}})
    learners, alone = config.evaluation_scenarios(), config.task_scenarios()
    assert list(alone) == list(learners)
    for place, scenario in alone.items():
        learner = learners[place]
        for name in ("trajectory", "robots", "time_gap_s", "preview_s", "horizon_s", "plant"):
            assert getattr(scenario, name) == getattr(learner, name)
        assert scenario.disturbance == learner.disturbance
        assert scenario.action == "twist"
        assert not {"estimator", "action", "reward"} & scenario.model_fields_set
