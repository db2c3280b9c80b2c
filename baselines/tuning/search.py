"""The search for a controller's gains, limits and filter parameters; it can be interrupted and resumed.

A configuration names a start, ranges, tasks, disturbances and seeds. Optuna's tree-structured Parzen
estimator proposes trials; every trial runs all tasks and disturbances on the batch plant. The best trials
and the start are then run on other seeds, and the best of them is the result: a controller file, or the file
of a law, that also records the scores of the result and of the start. A law's limiter has a file of its own
if the search changed it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any

from baselines.runs.jobs import alone_in, spread
from baselines.runs.provenance import git_revision, simulation_digest, versions
from baselines.runs.trials import optuna_package
from baselines.tuning.config import TuneConfig
from baselines.tuning.start import LawStart
from baselines.tuning.study import StoredStudy, search_record
from baselines.tuning.trial import Outcome, TrialJob, run_trial
from tlf_env.common.files import atomic
from tlf_env.common.presets import yaml_text

RESULT_FILE, LIMITER_FILE = "tuned.yaml", "limiter.yaml"


def run_tune(
    config: TuneConfig,
    folder: Path,
    *,
    workers: int = 1,
    ray_address: str | None = None,
    command: str = "",
    progress: Callable[[int, int], None] | None = None,
) -> dict[str, Any]:
    """Search up to ``config.trials`` trials, choose, and write ``tuned.yaml``; returns its content.

    Parameters
    ----------
    folder
        Folder of ``search.json`` (the configuration), ``study.db`` (Optuna's) and ``tuned.yaml``.
    workers
        Processes that run trials. With more than one, the proposals depend on which trial ends first.
    ray_address
        Address of a Ray cluster that runs them instead.
    progress
        Called with the number of trials run and their total, including the finalists' runs on the
        choosing seeds.

    Raises
    ------
    ValueError
        for a folder that holds another search or in which another process works, a missing package, or
        no worker, before anything is run.
    """
    if workers < 1:
        raise ValueError(f"workers {workers} must be at least 1")
    record = search_record(config)
    folder.mkdir(parents=True, exist_ok=True)
    with alone_in(folder):
        study = StoredStudy(config, folder, record)
        chosen = _search(study, workers, ray_address, progress or (lambda done, total: None))
        result = _result(study, chosen, command)
        use = use_of(config)
        if _limiter_is_searched(config):
            best = config.built(study.values(result["found"]["trial"]))
            assert isinstance(best, LawStart)
            _write(best.limits_of_it.model_dump(mode="json"), folder / LIMITER_FILE, use)
        _write(result, folder / RESULT_FILE, use)
    return result


def use_of(config: TuneConfig, folder: Path | None = None) -> str:
    """The policy's name with the result in a folder; with FILE in place of its path without one."""
    path, limiter_path = "FILE", "LIMITER.yaml"
    if folder is not None:
        path, limiter_path = str(folder / RESULT_FILE), str(folder / LIMITER_FILE)
    if not isinstance(config.start, LawStart):
        return f"reference:{path}"
    limiter = limiter_path if _limiter_is_searched(config) else config.start.limiter or "none"
    return f"{config.start.law}:{path}+{config.start.estimator or config.estimator}+{limiter}"


def _limiter_is_searched(config: TuneConfig) -> bool:
    return isinstance(config.start, LawStart) and any(
        not p.startswith("law.") for p in config.search
    )


def _search(
    study: StoredStudy, workers: int, ray_address: str | None, progress: Callable[[int, int], None]
) -> dict[int, Outcome]:
    """Run the remaining trials, then the finalists on the choosing seeds; the finalists' outcomes."""
    config = study.config

    def outcomes(jobs: Iterable[TrialJob]) -> Iterator[Outcome]:
        return spread(run_trial, config, jobs, processes=workers, ray_address=ray_address)

    done = len(study.trials("COMPLETE", "PRUNED"))
    total = max(config.trials, done) + config.choose.finalists
    progress(done, total)
    for outcome in outcomes(study.jobs()):
        study.tell(outcome)
        done += 1
        progress(done, total)
    finalists, chosen = study.finalists(), study.chosen()
    left = [number for number in finalists if number not in chosen]
    for outcome in outcomes(TrialJob(n, study.values(n), config.choose.all, {}) for n in left):
        study.choose(outcome)
        chosen[outcome.number] = outcome
        progress(done + len(chosen), done + len(finalists))
    return chosen


def _result(study: StoredStudy, chosen: dict[int, Outcome], command: str) -> dict[str, Any]:
    """The content of ``tuned.yaml``: a controller's or a law's file, and how it was found."""
    config = study.config
    ranking = sorted(chosen.values(), key=lambda outcome: (outcome.score, outcome.number))
    best = ranking[0].number
    tuned = {outcome.number: outcome for outcome in study.outcomes()}
    made = config.built(study.values(best))
    made_file = made.file if isinstance(made, LawStart) else made
    file = made_file.model_dump(mode="json", exclude={"found"})
    return {
        **{key: value for key, value in file.items() if value is not None},
        "found": {
            "command": command,
            "trial": best,
            "trials": {
                "finished": len(study.trials("COMPLETE")),
                "stopped": len(study.trials("PRUNED")),
            },
            "tune": {"found": _recorded(tuned[best]), "start": _recorded(tuned[0])},
            "choose": {"found": _recorded(chosen[best]), "start": _recorded(chosen[0])},
            "finalists": [
                {
                    "trial": outcome.number,
                    "tune": tuned[outcome.number].score,
                    "choose": outcome.score,
                    "failed": outcome.failed,
                }
                for outcome in ranking
            ],
            "search": config.model_dump(mode="json"),
            "simulation": simulation_digest(),
            "versions": versions() | {"optuna": optuna_package().__version__},
            "git_revision": git_revision(),
        },
    }


def _recorded(outcome: Outcome) -> dict[str, Any]:
    kept = outcome._asdict()
    del kept["number"], kept["stopped"]
    return kept


def _write(result: dict[str, Any], path: Path, use: str) -> None:
    with atomic(path, encoding="utf-8") as file:
        file.write(f"# Found by tlf tune. Use it with --policy {use}.\n")
        file.write(yaml_text(result))
