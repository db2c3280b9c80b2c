"""The search: the same however it is interrupted, what it may not see, and that its result can be used."""

import json
import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
import yaml
from campaign.jobs import SEARCH
from page_tables import numbers_in, rows_of

pytest.importorskip("optuna")

from baselines.cli import main
from baselines.policies.laws.catalogue import LAWS, read_law
from baselines.policies.reference import ReferencePolicy
from baselines.policies.registry import fit_policy
from baselines.runs.run import run_seeds
from baselines.runs.trials import STUDY_FILE
from baselines.tuning import search
from baselines.tuning.config import CAPS, Objective, TuneConfig, load_tune
from baselines.tuning.search import RESULT_FILE, run_tune
from baselines.tuning.study import SCORES, StoredStudy
from baselines.tuning.trial import Outcome, TrialJob, measured, run_trial
from tlf_env.onboard.controllers import controller, load_controller
from tlf_env.onboard.limiter import BOUNDS
from tlf_env.task.scenario import load_scenario

# A start of its own: the preset may change.
ROOT = Path(__file__).resolve().parents[1]
GAINS = {
    "k_1_per_s": 0.55,
    "k_2_mm2_s": 6.4 * 1.76e4,
    "k_3_mm2": 1.76e4,
    "eta": 1e-4,
    "epsilon": 0.05,
}
START = {**controller("tuned").model_dump(), "gains": GAINS}

SMALL = {
    **SEARCH,
    "start": START,
    "search": {
        "gains.k_1_per_s": {"low": 0.2, "high": 2, "log": True},
        "gains.k_2_mm2_s": {"low": 0.8, "high": 12, "log": True, "times": "gains.k_3_mm2"},
        "gains.k_3_mm2": {"low": 1e4, "high": 2e5, "log": True},
        "ekf_slip.fix_variance_mm2": {"low": 0.05, "high": 20, "log": True},
        "lead_s": {"low": 0, "high": 0.05},
    },
    "trials": 7,
}
COMMAND = [sys.executable, "-m", "baselines", "tune"]


def config(**fields):
    return TuneConfig.model_validate({**SMALL, **fields})


def quick(settings, job):
    """A trial that takes no time: high gains fail on noise."""
    gain, variance = job.values["gains.k_1_per_s"], job.values["ekf_slip.fix_variance_mm2"]
    strata, total = {}, 0
    for i, place in enumerate(("infinity, nominal", "infinity, noise")):
        failed = 2 if i == 0 and gain > 1.5 else 0
        total += failed
        cost = abs(gain - 0.8) + variance / 100 + job.seeds[0] / 1e6 + failed
        strata[place] = {"cost": cost, "failed": failed} | dict.fromkeys(CAPS, 1.0)
        if total >= job.too_many.get(place, 99):
            break
    score = sum(row["cost"] for row in strata.values()) / len(strata)
    return Outcome(job.number, score, total, 2 * len(strata), len(strata) < 2, strata)


def trials(folder, settings):
    """Everything about the trials but when they were."""
    return [
        (t.number, t.state.name, t.params, t.value, t.user_attrs)
        for t in StoredStudy(settings, folder).trials()
    ]


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """Folder and result of a search without interruption."""
    folder = tmp_path_factory.mktemp("whole")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(search, "run_trial", quick)
        return folder, run_tune(config(), folder)


def test_a_search_that_is_interrupted_is_the_search_that_was_not(tmp_path, monkeypatch, whole):
    left = [0, 5, 5]

    def drive(settings, job):
        if left and (job.number, job.seeds) == (left[0], [0, 1]):
            left.pop(0)
            raise KeyboardInterrupt
        return quick(settings, job)

    monkeypatch.setattr(search, "run_trial", drive)
    while left:
        finished = left[0]
        with pytest.raises(KeyboardInterrupt):
            run_tune(config(), tmp_path)
        states = [state for _, state, *_ in trials(tmp_path, config())]
        assert len([s for s in states if s in ("COMPLETE", "PRUNED")]) == finished
    assert run_tune(config(), tmp_path) == whole[1]
    assert trials(tmp_path, config()) == trials(whole[0], config())
    written = [(folder / RESULT_FILE).read_text() for folder in (tmp_path, whole[0])]
    assert written[0] == written[1]


@pytest.mark.parametrize("write", ["set_trial_user_attr", "set_trial_state_values"])
def test_a_trial_that_was_driven_and_not_stored_whole_is_driven_again(
    tmp_path, monkeypatch, whole, write
):
    """The process may end between any two writes to the database."""
    monkeypatch.setattr(search, "run_trial", quick)
    study = StoredStudy(config(), tmp_path)

    real = getattr(study.store.study._storage, write)

    def stops(*words, **named):
        if len(study.trials("COMPLETE", "PRUNED")) == 4:
            raise KeyboardInterrupt
        return real(*words, **named)

    monkeypatch.setattr(study.store.study._storage, write, stops)
    jobs = study.jobs()
    for _ in range(4):
        study.tell(quick(config(), next(jobs)))
    last = quick(config(), next(jobs))
    with pytest.raises(KeyboardInterrupt):
        study.tell(last)
    run_tune(config(), tmp_path)
    assert trials(tmp_path, config()) == trials(whole[0], config())


def test_what_is_finished_is_not_driven_again_and_more_trials_go_on(tmp_path, monkeypatch, whole):
    driven = []

    def drive(settings, job):
        driven.append((job.number, job.seeds[0]))
        return quick(settings, job)

    monkeypatch.setattr(search, "run_trial", drive)
    run_tune(config(trials=4), tmp_path)
    before = len(driven)
    run_tune(config(trials=4), tmp_path)
    assert len(driven) == before
    run_tune(config(), tmp_path)
    assert [n for n, seed in driven if seed == 0] == list(range(7))
    assert len(set(driven)) == len(driven)
    assert trials(tmp_path, config()) == trials(whole[0], config())


@pytest.mark.parametrize(
    ("change", "named"),
    [
        ({"sampler_seed": 1}, "sampler_seed"),
        ({"seeds": {"first": 1, "count": 2}}, "seeds"),
        ({"start": {"gains": {"k_1_per_s": 0.5, "k_2_mm2_s": 3e4}, "lead_s": 0.01}}, "start"),
        ({"disturbances": ["noise", "nominal"]}, "disturbances"),
    ],
)
def test_another_search_in_the_same_folder_is_refused(tmp_path, monkeypatch, change, named):
    monkeypatch.setattr(search, "run_trial", quick)
    StoredStudy(config(), tmp_path)
    with pytest.raises(
        ValueError,
        match=rf"holds a search with a different '{named}' in search\.json: {named}.* is .* there and .* "
        "now; choose another --out",
    ):
        run_tune(config(**change), tmp_path)


def test_a_task_whose_file_changed_is_refused(tmp_path):
    path = tmp_path / "round.yaml"
    text = "trajectory: {{type: circle, radius_mm: 800, speed_mm_s: {}}}\n"
    path.write_text(text.format(200))
    StoredStudy(config(tasks=[str(path)]), tmp_path / "out")
    path.write_text(text.format(300))
    with pytest.raises(ValueError, match="holds a search with a different 'scenarios'"):
        StoredStudy(config(tasks=[str(path)]), tmp_path / "out")


def test_two_at_once_in_a_folder_are_refused(tmp_path, monkeypatch):
    def drive(settings, job):
        with pytest.raises(ValueError, match="another process works in"):
            run_tune(config(), tmp_path)
        return quick(settings, job)

    monkeypatch.setattr(search, "run_trial", drive)
    assert run_tune(config(trials=1), tmp_path) == run_tune(config(trials=1), tmp_path)


def test_a_file_that_is_not_a_database_is_reported(tmp_path):
    (tmp_path / STUDY_FILE).write_bytes(b"no database, " * 100)
    with pytest.raises(ValueError, match=r"study\.db cannot be read"):
        StoredStudy(config(), tmp_path)


def test_the_seeds_for_choosing_choose(tmp_path, monkeypatch):
    """The best on the search's seeds is not the result if another is better on the others."""

    def drive(settings, job):
        outcome = quick(settings, job)
        if job.seeds[0] < 10_000:
            return outcome
        assert job.too_many == {}
        return outcome._replace(score=-outcome.score)

    monkeypatch.setattr(search, "run_trial", drive)
    found = run_tune(config(), tmp_path)["found"]
    assert len(found["finalists"]) in (2, 3)  # the start too, if it is not among the best
    assert 0 in [row["trial"] for row in found["finalists"]]
    tuned = [row["tune"] for row in found["finalists"]]
    assert tuned == sorted(tuned, reverse=True)
    assert found["choose"]["found"]["score"] < found["choose"]["start"]["score"] or (
        found["trial"] == 0
    )


def test_a_trial_that_fails_more_than_the_start_is_stopped(tmp_path, monkeypatch):
    monkeypatch.setattr(search, "run_trial", quick)
    run_tune(config(trials=12), tmp_path)
    for _, state, values, _, attributes in trials(tmp_path, config(trials=12)):
        fails = values["gains.k_1_per_s"] > 1.5
        assert state == ("PRUNED" if fails else "COMPLETE")
        assert len(attributes[SCORES]["strata"]) == (1 if fails else 2)


def test_a_failed_run_costs_more_than_any_other():
    objective = Objective(failed=0.01)
    worst = dict.fromkeys(CAPS, 1000000000.0)
    best = dict.fromkeys(CAPS, 0.0)
    assert objective.cost(best, True) > objective.cost(worst, False) > objective.cost(best, False)
    assert objective.cost(best, True) == objective.cost(worst, True)
    for name in CAPS:
        assert objective.cost({**best, name: 1.0}, False) > objective.cost(best, False)


def test_the_result_is_a_controller_that_scores_the_same(tmp_path):
    settings = config(trials=3, startup_trials=1)
    result = run_tune(settings, tmp_path, command="tlf tune x.yaml")
    found, path = result["found"], str(tmp_path / RESULT_FILE)
    assert yaml.safe_load((tmp_path / RESULT_FILE).read_text()) == result
    assert json.loads(json.dumps(result)) == result
    study = StoredStudy(settings, tmp_path)
    best = settings.built(study.values(found["trial"]))
    loaded = load_controller(path)
    assert (loaded.controller, loaded.ekf_slip) == (best.controller, best.ekf_slip)
    assert ReferencePolicy(path).controller == best.controller
    entry = fit_policy(f"reference:{path}", load_scenario(horizon_s=2.0, plant="batch"))
    assert entry.policy.controller == best.controller
    assert (entry.scenario.estimator, entry.scenario.ekf_slip) == ("ekf-slip", best.ekf_slip)
    json.dumps(entry.overrides)
    (again,) = run_seeds(entry.scenario, entry.policy, [0])
    job = TrialJob(0, study.values(found["trial"]), [0], {})
    alone = run_trial(config(disturbances=["nominal"]), job).strata["infinity, nominal"]
    assert measured(again)[0] == {name: alone[name] for name in CAPS}
    set_by_hand = load_scenario(ekf_slip={"fix_variance_mm2": 0.5}, estimator="ekf")
    asked = fit_policy(f"reference:{path}", set_by_hand).overrides
    assert asked == {"broadcast_smoothing_s": 0.0}  # as in the search


@pytest.mark.slow
def test_processes_drive_the_same_trials(tmp_path):
    settings = config(trials=4, startup_trials=10, stop_after_failed=None, disturbances=["nominal"])
    one, two = (
        run_tune(settings, tmp_path / f"{n}", workers=n) for n in (1, 2)
    )  # at random: no proposal depends on an outcome
    assert one == two


@pytest.mark.slow
def test_a_search_that_is_killed_loses_no_finished_trial(tmp_path):
    path = tmp_path / "search.yaml"
    path.write_text(yaml.safe_dump({**SMALL, "horizon_s": 6, "trials": 30}))
    settings = load_tune(path)

    def started(folder):
        return subprocess.Popen(
            [*COMMAND, str(path), "--out", str(folder), "--json"],
            stdout=subprocess.PIPE,
            start_new_session=True,
        )

    def finished(folder):
        if not (folder / STUDY_FILE).exists():
            return []
        try:
            return [t for t in trials(folder, settings) if t[1] in ("COMPLETE", "PRUNED")]
        except ValueError:  # not made whole yet
            return []

    folder = tmp_path / "killed"
    for enough in (2, 9):
        process = started(folder)
        try:
            end = time.monotonic() + 120
            while len(finished(folder)) < enough:
                assert time.monotonic() < end
                assert process.poll() is None
                time.sleep(0.02)
        finally:
            os.killpg(process.pid, signal.SIGKILL)
            process.communicate()
        before = finished(folder)
        assert len(before) < 30
        assert finished(folder) == before
    results = []
    for where in (folder, tmp_path / "whole"):
        process = started(where)
        out, _ = process.communicate(timeout=300)
        assert process.returncode == 0
        results.append(json.loads(out))
    assert results[0] == results[1]
    assert finished(folder)[: len(before)] == before
    assert trials(folder, settings) == trials(tmp_path / "whole", settings)


@pytest.mark.slow
def test_a_ray_cluster_drives_the_same_trials(tmp_path):
    pytest.importorskip("ray")
    from ray.cluster_utils import Cluster

    settings = config(trials=4, startup_trials=10, stop_after_failed=None)
    cluster = Cluster(
        initialize_head=True, head_node_args={"num_cpus": 2, "include_dashboard": False}
    )
    try:
        far = run_tune(settings, tmp_path / "ray", ray_address=cluster.address)
    finally:
        cluster.shutdown()
    assert far == run_tune(settings, tmp_path / "here")


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"start": "bold"}, "'bold' is not one of adrc, consistent, linearised, printed, tuned"),
        ({"start": {"gains": {"k_9": 1}}}, "start.gains.k_9: unknown key"),
        ({"start": "printed"}, "the start has 6.91667e-05; it must lie within 0.8 and 12"),
        (
            {"start": "consistent", "search": {"limits.lateral_error_mm": {"low": 1, "high": 9}}},
            "search.limits.lateral_error_mm: the start has None",
        ),
        ({"start": {"limits": {"cancel_slip": 3}}}, "cancel_slip"),
        ({"estimator": "kalman"}, "estimator"),
        ({"estimator": "ekf"}, "needs estimator 'ekf-slip'"),
        ({"ekf_slip": {"fix_variance_mm2": -1}}, "fix_variance_mm2"),
        ({"ekf_slip": {"fix_variance_mm2": 30}}, "the start has 30"),
        ({"search": {}}, "search"),
        ({"search": {"gains.k_9": {"low": 1, "high": 2}}}, "'gains.k_9' is not one of gains.k_1_"),
        ({"search": {"limits.cancel_slip": {"low": 0, "high": 1}}}, "'limits.cancel_slip' is not"),
        ({"search": {"lead_s": {"low": 1, "high": 0}}}, "low 1 must be below high 0"),
        ({"search": {"lead_s": {"low": 0, "high": 1, "log": True}}}, "above 0 with log true"),
        ({"search": {"lead_s": {"low": -1, "high": 1}}}, "search.lead_s, low: "),
        ({"search": {"lead_s": {"low": 0, "high": 1, "steps": 3}}}, "search.lead_s.steps: unknown"),
        (
            {"search": {"lead_s": {"low": 0, "high": 1, "times": "lead_s"}}},
            "has no times in its own range",
        ),
        ({"search": {"lead_s": {"low": 0, "high": 1, "times": "lead"}}}, "'lead' is not one of"),
        ({"tasks": ["no_such"]}, "no_such"),
        ({"tasks": ["infinity", "infinity"]}, "named once"),
        ({"disturbances": ["no_such"]}, "no_such"),
        ({"disturbances": []}, "disturbances"),
        ({"seeds": {"first": 20_000, "count": 3}}, "20000 and above are for tables"),
        ({"seeds": {"first": 9_999, "count": 2}}, "seeds 9999 to 10000 must lie within 0 to 9999"),
        ({"choose": {"first": 19_999, "count": 2}}, "choose: seeds 19999 to 20000 must lie within"),
        ({"choose": {"first": 0, "count": 2}}, "must lie within 10000 to 19999"),
        ({"choose": {"first": 10_000, "count": 2, "finalists": 0}}, "choose.finalists"),
        ({"horizon_s": 0.03}, "horizon_s"),
        ({"horizon_s": 15, "objective": {}}, "horizon_s 15 must be above 15"),
        ({"trials": 0}, "trials"),
        ({"objective": {"failed": 0}}, "objective.failed"),
        ({"objective": {"speed": 1}}, "objective.speed: unknown key"),
        ({"workers": 2}, "workers: unknown key"),
    ],
)
def test_bad_input_is_one_line_and_writes_nothing(change, said, tmp_path, monkeypatch, capsys):
    (tmp_path / "search.yaml").write_text(yaml.safe_dump({**SMALL, **change}))
    assert said in refused(["search.yaml"], tmp_path, monkeypatch, capsys)


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ("no_such", "'no_such' is not one of adrc, "),
        ("no_such.yaml", "cannot read no_such.yaml"),
        ("list.yaml", "must contain a mapping"),
        ("search.yaml --trials 0", "trials: Input should be greater than or equal to 1, got 0"),
        ("search.yaml --workers -1", "workers -1 must be at least 1"),
    ],
)
def test_bad_words_are_one_line_and_write_nothing(words, said, tmp_path, monkeypatch, capsys):
    (tmp_path / "search.yaml").write_text(yaml.safe_dump(SMALL))
    (tmp_path / "list.yaml").write_text("[1, 2]")
    assert said in refused(words.split(), tmp_path, monkeypatch, capsys)


def refused(words, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", ["tlf", "tune", *words, "--out", "out"])
    with pytest.raises(SystemExit) as end:
        main()
    assert end.value.code == 2
    shown = capsys.readouterr().err
    assert "\n" not in shown.strip()
    assert not (tmp_path / "out").exists()
    return shown


def test_the_command_prints_its_result(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(search, "run_trial", quick)
    monkeypatch.chdir(tmp_path)
    (tmp_path / "search.yaml").write_text(yaml.safe_dump(SMALL))
    printed = []
    for words in (["--json", "--trials", "3"], []):
        monkeypatch.setattr(sys, "argv", ["tlf", "tune", "search.yaml", *words])
        main()
        printed.append(capsys.readouterr().out)
    result = json.loads(printed[0])
    folder = tmp_path / "results" / "tune" / "search"
    assert yaml.safe_load((folder / RESULT_FILE).read_text())["found"]["search"]["trials"] == 7
    assert result["found"]["command"] == "tlf tune search.yaml --json --trials 3"
    assert result["found"]["search"]["trials"] == 3
    assert "less is better" in printed[1]
    assert "--gains results/tune/search/tuned.yaml" in " ".join(printed[1].split())


def test_an_interrupt_is_reported_and_is_not_a_success(tmp_path, monkeypatch, capsys):
    def drive(settings, job):
        raise KeyboardInterrupt

    monkeypatch.setattr(search, "run_trial", drive)
    monkeypatch.setattr(sys, "argv", ["tlf", "tune", "tuned", "--out", str(tmp_path)])
    with pytest.raises(SystemExit) as end:
        main()
    assert end.value.code == 130
    line = capsys.readouterr().err
    assert line.startswith("tlf: interrupted; ")
    assert line.endswith(f"the same command goes on: tlf tune tuned --out {tmp_path}\n")


def test_the_start_is_the_first_trial(tmp_path):
    """Whatever the search finds is at least as good on the seeds for choosing."""
    settings = load_tune("tuned")
    job = next(StoredStudy(settings, tmp_path).jobs())
    file = settings.built(job.values)
    assert (job.number, file.controller) == (0, controller("tuned"))
    assert file.ekf_slip == settings.ekf_slip


def test_the_committed_result_is_of_the_committed_search():
    result = load_controller(ROOT / "docs" / "tuning" / "tuned-result.yaml")
    search = load_tune("tuned").model_dump(mode="json")
    assert set(result.found["search"]["search"]) == set(search["search"])
    assert result.found["search"]["seeds"] == search["seeds"]
    assert result.found["choose"]["found"]["score"] <= result.found["choose"]["start"]["score"]


SEARCHED = list(LAWS)


@pytest.mark.parametrize("name", [*SEARCHED, "paper"])
def test_the_committed_results_are_of_the_committed_searches(name):
    """All are of one budget and one set of runs, and what they found is what is shipped."""
    result = yaml.safe_load((ROOT / "docs" / "tuning" / f"{name}-result.yaml").read_text("utf-8"))
    found = result.pop("found")
    mine, first = (
        load_tune(one).model_dump(mode="json") for one in (name, "feedback_linearisation")
    )
    assert found["search"]["search"] == mine["search"]
    for field in set(mine) - {"search", "start"}:
        assert found["search"][field] == mine[field] == first[field], field
    assert found["trials"]["finished"] + found["trials"]["stopped"] == mine["trials"]
    scores = {end: found["choose"][end]["score"] for end in ("found", "start")}
    assert (found["trial"] == 0) == (scores["found"] == scores["start"])
    assert scores["found"] <= scores["start"]
    if name == "paper":
        gains = result["controller"]["gains"]
        assert gains == controller("tuned").gains.model_dump(), "its page says that none is better"
    else:
        shipped = read_law(name, "searched").model_dump(exclude_none=True)
        assert shipped == {key: value for key, value in result.items() if value is not None}


def test_the_page_has_the_cost_of_each_search():
    rows = rows_of("controller/search.md", "searches")
    assert len(rows) == len(SEARCHED) + 1
    for name, cells in rows.items():
        file = ROOT / "docs" / "controller" / re.search(r"\]\((.*)\)", name)[1]
        found = yaml.safe_load(file.read_text("utf-8"))["found"]
        for text, end in zip(cells, ("start", "found"), strict=False):
            cost, *failed = numbers_in(text)
            assert cost == pytest.approx(found["choose"][end]["score"], abs=0.0051)
            assert failed == [found["choose"][end]["failed"]] or not found["choose"][end]["failed"]
        assert numbers_in(cells[2]) == list(found["trials"].values())
        assert cells[3] == str(found["trial"] or "the start")


@pytest.mark.parametrize("name", ["feedback_linearisation", "kanayama", "adrc"])
def test_the_committed_results_come_out_again(name):
    result = yaml.safe_load((ROOT / "docs" / "tuning" / f"{name}-result.yaml").read_text("utf-8"))
    choose = result.pop("found")["choose"]["found"]["strata"]["flower, slip-noise"]
    search = load_tune(name).model_dump() | {"tasks": ["flower"], "disturbances": ["slip-noise"]}
    settings = TuneConfig.model_validate(search)
    values = {path: result[path.removeprefix("law.")] for path in settings.search}
    seeds = range(settings.choose.first, settings.choose.first + settings.choose.count)
    again = run_trial(settings, TrialJob(0, values, list(seeds), {}))
    for metric in CAPS:
        wanted = pytest.approx(choose[metric], rel=0.02)
        assert again.strata["flower, slip-noise"][metric] == wanted


def test_a_search_may_give_its_start_in_numbers():
    numbers = controller("tuned").model_dump()
    assert config(start=numbers) == config(start="tuned")


def test_a_ratio_follows_what_it_is_of():
    settings = config()
    values = settings.start_values
    assert values["gains.k_2_mm2_s"] == 6.4
    gains = settings.built({**values, "gains.k_3_mm2": 2e4, "gains.k_2_mm2_s": 3}).controller.gains
    assert (gains.k_2_mm2_s, gains.k_3_mm2) == (6e4, 2e4)


def test_without_optuna_the_command_reports_what_to_install(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "optuna", None)
    with pytest.raises(ValueError, match=r"pip install 'tlf-env\[tune\]'"):
        run_tune(config(), tmp_path / "out")
    assert not (tmp_path / "out").exists()


LAW = {
    **SMALL,
    "start": "feedback_linearisation:bounded+ekf-slip+body",
    "search": {
        "law.gain_per_s": {"low": 0.5, "high": 3, "log": True},
        "limits.yaw_rate_rad_s": {"low": 0.5, "high": 3},
    },
}
ONLY_LAW = {"law.ahead_mm": {"low": 40, "high": 200}}


def test_a_law_is_searched_and_its_files_drive_the_same_runs(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "search.yaml").write_text(yaml.safe_dump({**LAW, "trials": 3}))
    monkeypatch.setattr(sys, "argv", ["tlf", "tune", "search.yaml", "--out", "out"])
    main()
    name = "feedback_linearisation:out/tuned.yaml+ekf-slip+out/limiter.yaml"
    assert f"tlf run infinity --policy {name}" in " ".join(capsys.readouterr().out.split())
    settings = load_tune("search.yaml", trials=3)
    study = StoredStudy(settings, tmp_path / "out")
    found = yaml.safe_load((tmp_path / "out" / RESULT_FILE).read_text())["found"]
    best = settings.built(study.values(found["trial"]))
    fitted = fit_policy(name, load_scenario("infinity", horizon_s=2.0, plant="batch"))
    assert fitted.policy.limiter == best.limits_of_it
    assert fitted.policy.law.gain_per_s == best.parameters["gain_per_s"]
    (again,) = run_seeds(fitted.scenario, fitted.policy, [0])
    job = TrialJob(0, study.values(found["trial"]), [0], {})
    alone = run_trial(TuneConfig.model_validate({**LAW, "disturbances": ["nominal"]}), job)
    assert measured(again)[0] == {name: alone.strata["infinity, nominal"][name] for name in CAPS}


def test_a_law_starts_as_it_is_and_a_limiter_that_is_not_searched_keeps_its_name(tmp_path):
    settings = TuneConfig.model_validate({**LAW, "search": ONLY_LAW})
    assert settings.start_values == {"law.ahead_mm": 80.0}
    scenario = load_scenario("infinity", horizon_s=2.0, plant="batch", estimator="ekf-slip")
    started = settings.policy(settings.built(settings.start_values), scenario)
    named = fit_policy(LAW["start"], scenario).policy
    found, wanted = (next(iter(run_seeds(scenario, one, [0])))["x_mm"] for one in (started, named))
    assert found.tobytes() == wanted.tobytes()
    use = search.use_of(settings, tmp_path)
    assert use == f"feedback_linearisation:{tmp_path / RESULT_FILE}+ekf-slip+body"


def test_a_system_of_the_papers_law_is_a_controller():
    assert config(start="reference:tuned+ekf-slip+body") == config(start="tuned")
    alone = TuneConfig.model_validate(
        {**LAW, "start": "kanayama", "search": {"law.k_x_per_s": {"low": 1, "high": 20}}}
    )
    assert (alone.estimator, alone.start.limiter, alone.start.lead_s) == ("ekf-slip", None, 0.0)
    assert alone.start.parameters["k_theta_per_mm"] == pytest.approx(0.016)


def test_a_start_names_its_estimator_whatever_the_search_that_it_is_like(tmp_path):
    path = tmp_path / "mine.yaml"
    own = {"start": "kanayama:bounded+ekf-gyro-smoothed+body", "horizon_s": 30}
    ranges = {"law.k_x_per_s": {"low": 1, "high": 5}}
    path.write_text(yaml.safe_dump({"like": "tuned", "search": ranges, **own}))
    settings = load_tune(path)
    named = fit_policy(own["start"], load_scenario()).scenario
    for scenario in settings.scenarios(None).values():
        assert scenario.estimator == settings.estimator == "ekf-gyro"
        assert scenario.broadcast_smoothing_s == named.broadcast_smoothing_s > 0
    assert search.use_of(settings) == "kanayama:FILE+ekf-gyro-smoothed+body"


def test_a_search_from_a_system_without_a_part_keeps_it_off(tmp_path):
    path = tmp_path / "mine.yaml"
    own = {"start": "kanayama:bounded+ekf-slip-without-jumps+body", "horizon_s": 30}
    ranges = {"law.k_x_per_s": {"low": 1, "high": 5}}
    path.write_text(yaml.safe_dump({"like": "tuned", "search": ranges, **own}))
    for scenario in load_tune(path).scenarios(None).values():
        assert scenario.estimator == "ekf-slip"
        assert scenario.ekf_slip.most_acceleration_mm_s2 is None


@pytest.mark.parametrize("name", [*LAWS, "paper"])
def test_every_law_has_a_search_with_the_tasks_and_the_budget_of_all(name):
    if name == "nmpc":
        pytest.importorskip("casadi")
    settings, shared = load_tune(name), load_tune("feedback_linearisation")
    own = {"start", "search"}
    assert settings.model_dump(exclude=own) == shared.model_dump(exclude=own)
    if name == "paper":
        before = settings.start.limits.model_dump(exclude=set(BOUNDS))
        assert before == controller("linearised").limits.model_dump(exclude=set(BOUNDS))
    else:
        assert settings.start.law == name
    searched = ("law.", "gains.", *(f"limits.{bound}" for bound in BOUNDS))
    assert all(path.startswith(searched) for path in settings.search)


def test_a_controller_is_searched_with_the_broadcasts_of_its_system():
    settings = load_tune("paper")
    assert settings.broadcast_smoothing_s > 0
    for scenario in settings.scenarios(None).values():
        assert scenario.broadcast_smoothing_s == settings.broadcast_smoothing_s
    made = settings.built(settings.start_values)
    assert (made.estimator, made.broadcast_smoothing_s) == ("ekf-gyro", 0.1)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"start": "feedback+ekf-slip+body"}, "controller 'feedback'"),
        (
            {"start": "reference:tuned+ekf-slip-without-jumps", "search": SMALL["search"]},
            "a controller is searched with the parameters of 'ekf-slip', not with those of 'ekf-slip-w",
        ),
        ({"start": "kanayama+ukf+body"}, "estimator 'ukf' is a Python object; a search runs on"),
        ({"start": "kanayama:no_such"}, "kanayama 'no_such' is not one of bounded"),
        ({"start": "kanayama+ekf-slip+bodi"}, "limiter 'bodi' is not one of approach, body"),
        ({"estimator": "ekf"}, "names the estimator 'ekf-slip'; estimator is 'ekf'"),
        ({"search": {"law.gain": {"low": 1, "high": 2}}}, "'law.gain' is not one of law.braking"),
        ({"search": {"gains.k_1_per_s": {"low": 1, "high": 2}}}, "'gains.k_1_per_s' is not one of"),
        ({"search": {"law.found": {"low": 1, "high": 2}}}, "'law.found' is not one of"),
        ({"search": {"law.ahead_mm": {"low": -1, "high": 100}}}, "search.law.ahead_mm, low: "),
        ({"ekf_slip": {"fix_variance_mm2": 2.0}}, "a law is searched with the scenario's filter"),
        ({"start": {"law": "kanayam", "parameters": {}}}, "start.law 'kanayam' is not one of"),
        ({"start": {"law": "lqr", "parameters": {"k": 1}}}, "start.k: unknown key"),
        ({"like": "no_such"}, "search 'no_such' is not one of adrc"),
        ({"like": "search.yaml"}, "like: search.yaml → search.yaml goes round in a circle"),
        ({"like": 3}, "like must be the name of a search or a .yaml file, got 3"),
    ],
)
def test_bad_input_of_a_law_is_one_line_and_writes_nothing(
    change, said, tmp_path, monkeypatch, capsys
):
    (tmp_path / "search.yaml").write_text(yaml.safe_dump({**LAW, **change}))
    assert said in refused(["search.yaml"], tmp_path, monkeypatch, capsys)
