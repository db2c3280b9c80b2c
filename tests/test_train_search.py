"""``tlf train --search``: proposals, trials that stop, what is chosen, and a search that goes on."""

from __future__ import annotations

import json
import math
import re
import signal
from pathlib import Path

import pytest
import yaml
from helpers import refused
from test_train import CONFIG

from baselines.training.config import SearchConfig, SearchRange, load_config, with_trials

RANGES = {
    "settings.learning_rate": {"low": 0.001, "high": 0.1, "log": True},
    "settings.n_epochs": {"low": 1, "high": 4, "whole": True},
    "network.hidden": {"one_of": [[16], [8]]},
}
SEARCH = {
    "ranges": RANGES,
    "robot_steps": 240,
    "trials": 4,
    "evaluations": 2,
    "startup_trials": 2,
    "finalists": 1,
    "choose_seeds": [1],
}
SMALL = {
    **CONFIG,
    "tasks": {"infinity": {}},
    "disturbances": {"nominal": 1},
    "levels": [1.0],
    "evaluation": {**CONFIG["evaluation"], "disturbances": ["nominal"]},
}


def config(**changes: object):
    return load_config({**SMALL, "search": {**SEARCH, **changes}})


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"ranges": {}}, "search.ranges: must have at least 1 entry"),
        ({"robot_steps": 0}, "search.robot_steps: Input should be greater than or equal to 1"),
        ({"trial": 3}, "search.trial: unknown key"),
        ({"choose_seeds": [0]}, "choose_seeds [0] must differ from seeds [0]"),
        ({"ranges": {"settings.gama": {"low": 0, "high": 1}}}, "there is no 'gama'"),
        ({"ranges": {"networks.lstm": {"low": 0, "high": 1}}}, "there is no 'networks'"),
        (
            {"ranges": {"network.activation": {"one_of": ["tanh", "elu"]}}},
            "search.ranges.network.activation: network.activation: Input should be 'tanh' or 'relu'",
        ),
        (
            {"ranges": {"formations": {"low": 0, "high": 8, "whole": True}}},
            "formations: Input should",
        ),
    ],
)
def test_a_wrong_search_is_reported_in_one_line(changes, said):
    with pytest.raises(ValueError, match=re.escape(said)) as error:
        config(**changes)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("span", "said"),
    [
        ({}, "needs either low and high, or one_of"),
        ({"low": 1}, "needs both low and high"),
        ({"low": 1, "high": 2, "one_of": [1, 2]}, "needs either low and high, or one_of"),
        ({"one_of": [1]}, "at least 2 items"),
        ({"one_of": [1, 2], "log": True}, "log and whole go with low and high"),
        ({"low": 2, "high": 2}, "low 2 must be below high 2"),
        ({"low": 0, "high": 2, "log": True}, "low 0 must be above 0 with log true"),
        ({"low": 0.5, "high": 2, "whole": True}, "must be whole with whole true"),
    ],
)
def test_a_wrong_range_is_refused(span, said):
    with pytest.raises(ValueError, match=re.escape(said)):
        SearchRange.model_validate(span)


def test_values_reach_the_training_and_its_search_stays_out():
    found = config().with_values({"settings.n_epochs": 3, "network.hidden": [8]}, robot_steps=100)
    assert found.settings["n_epochs"] == 3
    assert found.network.hidden == (8,)
    assert found.robot_steps == 100
    assert found.search is None
    assert found.settings["batch_size"] == SMALL["settings"]["batch_size"]


def test_a_training_is_the_same_with_and_without_a_search():
    assert config().recorded == load_config(SMALL).recorded


def test_more_trials_are_asked_for_on_the_command_line():
    assert with_trials(config(), 9).search == SearchConfig.model_validate({**SEARCH, "trials": 9})
    assert with_trials(config(), None) == config()


def written(tmp_path: Path, **fields: object) -> list[str]:
    path = tmp_path / "small.yaml"
    path.write_text(yaml.safe_dump({**SMALL, **fields}), encoding="utf-8")
    return ["train", str(path)]


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--trials", "3"], "--trials goes with --search"),
        (["--search", "--seeds", "1"], "--seeds and --robot-steps do not go with --search"),
        (["--search", "--robot-steps", "9"], "--seeds and --robot-steps do not go with --search"),
    ],
)
def test_options_that_do_not_fit_are_refused(words, said, tmp_path, capsys, monkeypatch):
    assert said in refused([*written(tmp_path), *words], capsys, monkeypatch)


class TestSearch:
    """What needs stable-baselines3, torch and optuna."""

    @pytest.fixture(autouse=True)
    def _packages(self):
        pytest.importorskip("stable_baselines3")
        pytest.importorskip("optuna")

    def test_a_training_without_ranges_is_refused(self, tmp_path, capsys, monkeypatch):
        words = [*written(tmp_path), "--search", "--out", str(tmp_path / "out")]
        assert "--search needs a section `search` in the training" in refused(
            words, capsys, monkeypatch
        )

    def test_a_search_finds_and_writes_a_training(self, tmp_path):
        from baselines.training.search import FOUND_FILE, run_search

        seen, steps = [], []
        found = run_search(
            config(),
            tmp_path,
            progress=lambda done, total: steps.append((done, total)),
            finished=lambda outcome, values: seen.append((outcome.number, values)),
        )
        assert [number for number, _ in seen[:4]] == [0, 1, 2, 3]
        assert seen[0][1] == {
            "settings.learning_rate": 0.01,
            "settings.n_epochs": 2,
            "network.hidden": [16],
        }  # trial 0 is the file itself
        for _, values in seen:
            assert 0.001 <= values["settings.learning_rate"] <= 0.1
            assert values["settings.n_epochs"] in (1, 2, 3, 4)
            assert values["network.hidden"] in ([16], [8])
        assert steps[-1][0] == steps[-1][1]
        assert {one["trial"] for one in found["finalists"]} >= {0}
        scores = [one["choose_mm"] for one in found["finalists"]]
        assert scores == sorted(scores)
        assert found["values"] == found["finalists"][0]["values"]
        best = load_config(tmp_path / FOUND_FILE)
        assert best == config().with_values(found["values"])

    def test_an_interrupted_search_goes_on_to_the_same_result(self, tmp_path):
        from baselines.training import search

        whole = search.run_search(config(), tmp_path / "whole")
        stops = []

        def interrupt(outcome: search.Trained, values: object) -> None:
            stops.append(outcome.number)
            if len(stops) in (2, 4):
                raise KeyboardInterrupt  # the outcome is not stored yet

        for _ in range(2):
            with pytest.raises(KeyboardInterrupt):
                search.run_search(config(), tmp_path / "parts", finished=interrupt)
        assert search.run_search(config(), tmp_path / "parts") == whole
        assert stops == [0, 1, 1, 2]

    def test_a_trial_that_is_cut_goes_on_from_its_checkpoint(self, tmp_path, monkeypatch):
        from baselines.training import search

        job = search.TrialJob(0, {}, (0,), "trial_000", ())
        shared = search.Shared(config(), tmp_path / "parts", 1)
        real, calls = search.train, []

        def interrupted(*words: object, **named: object) -> dict:
            def stop(done: int, total: int) -> None:
                if not calls:
                    calls.append(done)
                    signal.raise_signal(signal.SIGINT)

            return real(*words, **named, progress=stop)

        monkeypatch.setattr(search, "train", interrupted)
        with pytest.raises(KeyboardInterrupt):
            search.run_trial(shared, job)
        again = search.run_trial(shared, job)
        monkeypatch.setattr(search, "train", real)
        whole = search.run_trial(search.Shared(config(), tmp_path / "whole", 1), job)
        assert again == whole
        assert len(again.courses[0]) == 3  # at the start and at the search's two evaluations

    def test_a_trial_worse_than_the_median_stops(self, tmp_path):
        from baselines.training import search

        shared = search.Shared(config(), tmp_path, 1)
        bad = search.TrialJob(1, {}, (0,), "trial_001", (9.0, -9.0, -9.0))
        outcome = search.run_trial(shared, bad)
        assert outcome.stopped
        assert len(outcome.courses[0]) == 2
        good = search.TrialJob(2, {}, (0,), "trial_002", (9.0, 9.0, 9.0))
        assert not search.run_trial(shared, good).stopped

    def test_medians_are_those_of_the_best_so_far(self, tmp_path):
        from baselines.training import search

        found = search.TrainingSearch(config(), tmp_path)
        for course in ([8.0, 4.0, 6.0], [8.0, 2.0, 1.0], [8.0, 3.0, 2.0]):
            job = next(found.jobs())
            found.tell(search.Trained(job.number, [course], 0, False))
        medians = next(found.jobs()).medians
        assert medians == pytest.approx(tuple(math.log(one) for one in (8.0, 3.0, 2.0)))

    def test_another_search_in_the_folder_is_refused_and_more_trials_are_not(self, tmp_path):
        from baselines.training.search import TrainingSearch

        TrainingSearch(config(), tmp_path)
        TrainingSearch(config(trials=7), tmp_path)
        with pytest.raises(ValueError, match="holds a search with a different 'search'"):
            TrainingSearch(config(robot_steps=480), tmp_path)

    def test_a_start_outside_its_range_is_refused(self, tmp_path):
        from baselines.training.search import TrainingSearch

        far = {"settings.learning_rate": {"low": 0.1, "high": 0.2}}
        with pytest.raises(ValueError, match=r"own value 0.01 must lie within 0.1 to 0.2"):
            next(TrainingSearch(config(ranges=far), tmp_path).jobs())
        other = {"network.hidden": {"one_of": [[4], [8]]}}
        with pytest.raises(ValueError, match=r"own value \[16\] must be one of \[4\], \[8\]"):
            next(TrainingSearch(config(ranges=other), tmp_path / "other").jobs())

    def test_the_command_prints_trials_and_what_comes_next(self, tmp_path, capsys, monkeypatch):
        from baselines import cli

        words = [*written(tmp_path, search=SEARCH), "--search", "--processes", "1", "--trials", "2"]
        words += ["--out", str(tmp_path / "out")]
        cli.app(words, standalone_mode=False)
        shown = capsys.readouterr()
        assert "trial 0: " in shown.err
        assert "Finalists:" in shown.out
        assert "tlf train" in shown.out
        cli.app([*words, "--json"], standalone_mode=False)
        assert json.loads(capsys.readouterr().out)["trials"] == 2
