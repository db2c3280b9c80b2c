"""Errors of the estimators, and whether they are expected: the tables of ``docs/controller/estimators.md``.

``python docs/figures/make_estimators.py`` drives 2 seeds of each cell for 30 s, with contact. A seed takes
about 5 minutes of processor time, nearly all of it for the two estimators in Python. It needs no extra. It
can be interrupted and goes on where it was: runs are kept in ``results/estimators`` until the code changes.
``--seeds N`` drives others, ``--only ESTIMATOR`` one estimator and keeps the other rows.
"""

from __future__ import annotations

import argparse
import json
import os
import time
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from make_board import DOCS
from make_parts import put

from baselines.console import progress_bar
from baselines.policies import estimators
from baselines.policies.registry import fit_policy
from baselines.runs.consistency import estimator_consistency
from baselines.runs.jobs import spread
from baselines.runs.provenance import simulation_digest
from baselines.runs.run import run_policy
from baselines.runs.seed_ranges import FIRST_TABLE_SEED
from tlf_env.common.digest import code_digest
from tlf_env.common.presets import read_preset_or_file
from tlf_env.onboard.parts import PYTHON_ESTIMATORS, Estimated, Readings, load_part
from tlf_env.physics.vehicle import RobotParameters
from tlf_env.task.scenario import Scenario, load_scenario

PAGE = DOCS / "controller" / "estimators.md"
RUNS = DOCS.parent / "results" / "estimators" / "runs.jsonl"
HORIZON_S, START_RAMP_S = 30.0, 6.0
LAW, LIMITER = "feedback_linearisation:bounded", "body"
ESTIMATORS = (
    "ekf",
    "ekf-slip",
    "ekf-slip-without-jumps",
    "ekf-gyro",
    "ekf-gyro-without-torques",
    "ukf",
    "moving-horizon",
    "truth",
)
DISTURBANCES = (
    "nominal",
    "slip",
    "slip-ramps",
    "slip-noise",
    "slip-sines",
    "ice",
    "hardware",
    "fixes-outage",
    "noise",
)
TIMED_S = 10.0


class Job(NamedTuple):
    """A run."""

    estimator: str
    disturbance: str
    seed: int


def scenario_of(disturbance: str) -> Scenario:
    """The ∞ with a start from rest, under a disturbance; with a gyro as sold."""
    source = "infinity_hardware" if disturbance == "hardware" else "infinity"
    channels = read_preset_or_file("disturbance", disturbance)
    gyro = read_preset_or_file("disturbance", "gyro")
    return load_scenario(
        source, disturbance={**channels, **gyro}, horizon_s=HORIZON_S, start_ramp_s=START_RAMP_S
    )


def line_of(digest: str, job: Job) -> dict[str, Any]:
    """A run, as a line of the file."""
    start = time.process_time()
    fitted = fit_policy(f"{LAW}+{job.estimator}+{LIMITER}", scenario_of(job.disturbance))
    found = estimator_consistency(fitted.scenario, fitted.policy, job.seed)
    seconds = time.process_time() - start
    return {**job._asdict(), "digest": digest, "seconds": seconds, **found._asdict()}


def known(digest: str) -> dict[Job, dict[str, Any]]:
    """The runs that are there, made by this code; an incomplete last line does not count."""
    found = {}
    for text in RUNS.read_text("utf-8").splitlines() if RUNS.is_file() else ():
        try:
            line = json.loads(text)
        except ValueError:
            continue
        if line["digest"] == digest:
            found[Job(line["estimator"], line["disturbance"], line["seed"])] = line
    return found


def driven(jobs: list[Job], processes: int) -> dict[Job, dict[str, Any]]:
    """The lines of the jobs; those that are missing are driven and kept."""
    digest = code_digest([Path(estimators.__path__[0])], simulation_digest(), str(HORIZON_S))
    found = known(digest)
    missing = [job for job in jobs if job not in found]
    RUNS.parent.mkdir(parents=True, exist_ok=True)
    with progress_bar("runs") as update, RUNS.open("a", encoding="utf-8") as file:
        update(len(jobs) - len(missing), len(jobs))
        answers = spread(line_of, digest, missing, processes=processes)
        for done, line in enumerate(answers, len(jobs) - len(missing) + 1):
            file.write(json.dumps(line) + "\n")
            file.flush()
            found[Job(line["estimator"], line["disturbance"], line["seed"])] = line
            update(done, len(jobs))
    return {job: found[job] for job in jobs}


def digits(value: float) -> str:
    """Three significant digits, without an exponent up to 99999."""
    return f"{value:.1e}" if value >= 1e5 else f"{float(f'{value:.3g}'):g}"


def errors(runs: list[dict[str, Any]]) -> str:
    """Errors of position (mm) and heading (mrad): the median over the runs, and how many failed."""
    position = np.median([run["position_mm"] for run in runs])
    heading = 1000.0 * np.median([run["heading_rad"] for run in runs])
    failed = sum(run["failed"] for run in runs)
    return f"{digits(position)} / {digits(heading)}" + (f" ({failed})" if failed else "")


def squares(runs: list[dict[str, Any]]) -> str:
    """Mean NEES and NIS, the median over the runs."""
    texts = []
    for name in ("nees", "nis"):
        values = [run[name] for run in runs if run[name] is not None]
        texts.append(digits(float(np.median(values))) if values else "–")
    return " / ".join(texts) if set(texts) != {"–"} else "–"


def table(
    name: str, made: Callable[[list[dict[str, Any]]], str], found: dict[Job, dict[str, Any]]
) -> str:
    """A row for each estimator, a column for each disturbance; rows that were not driven are kept."""
    page = PAGE.read_text("utf-8")
    old = page[page.index(f"<!-- {name} -->") : page.index(f"<!-- end of {name} -->")].splitlines()
    lines = [
        "| estimator | " + " | ".join(f"`{one}`" for one in DISTURBANCES) + " |",
        "|---" + "|---:" * len(DISTURBANCES) + "|",
    ]
    for estimator in ESTIMATORS:
        start = f"| `{estimator}` |"
        runs = {
            one: [line for job, line in found.items() if job[:2] == (estimator, one)]
            for one in DISTURBANCES
        }
        if all(runs.values()):
            lines.append(f"{start} " + " | ".join(made(each) for each in runs.values()) + " |")
        else:
            lines += [line for line in old if line.startswith(start)]
    return "\n".join(lines)


class Timed:
    """An estimator that adds up the processor time of its updates."""

    def __init__(self, name: str, seconds: list[float]) -> None:
        self._factory = load_part("estimator", PYTHON_ESTIMATORS[name], trust=False)
        self._seconds = seconds

    def __call__(self, robot: RobotParameters, period_s: float) -> Timed:
        """The estimator of a robot."""
        made = Timed.__new__(Timed)
        made._part, made._seconds = self._factory(robot, period_s), self._seconds
        return made

    def reset(self, pose: np.ndarray) -> None:
        """Start."""
        self._part.reset(pose)

    def update(self, readings: Readings) -> Estimated:
        """The estimator's answer."""
        start = time.thread_time()
        answer = self._part.update(readings)
        self._seconds.append(time.thread_time() - start)
        return answer


def times(names: Iterable[str]) -> str:
    """Processor time for each robot and control period: the median and the 99th percentile."""
    lines = ["| estimator | median, ms | 99th percentile, ms |", "|---|---:|---:|"]
    for name in names:
        seconds: list[float] = []
        fitted = fit_policy(f"{LAW}+{name}+{LIMITER}", load_scenario("infinity", horizon_s=TIMED_S))
        run_policy(
            fitted.scenario, fitted.policy, 10_000, parts={"estimator": Timed(name, seconds)}
        )
        robots, each = fitted.scenario.robot_count, fitted.scenario.substeps
        steps = 1e3 * np.array(seconds).reshape(-1, robots)
        steps = steps.reshape(-1, each, robots).sum(axis=1)
        median, most = np.percentile(steps, (50, 99))
        lines.append(f"| `{name}` | {median:.1f} | {most:.1f} |")
    return "\n".join(lines)


def main() -> None:
    """Drive and write the tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=2)
    parser.add_argument("--only", choices=ESTIMATORS)
    parser.add_argument("--processes", type=int, default=os.cpu_count() or 1)
    options = parser.parse_args()
    names = (options.only,) if options.only else ESTIMATORS
    seeds = range(FIRST_TABLE_SEED, FIRST_TABLE_SEED + options.seeds)
    jobs = [Job(name, one, seed) for seed in seeds for one in DISTURBANCES for name in names]
    try:
        found = driven(jobs, options.processes)
    except KeyboardInterrupt:
        raise SystemExit("interrupted; the same command goes on") from None
    minutes = sum(line["seconds"] for line in found.values()) / 60
    print(f"{len(jobs)} runs, {minutes:.1f} minutes of processor time")
    put(PAGE, table("errors", errors, found), "errors")
    put(PAGE, table("consistency", squares, found), "consistency")
    timed = [name for name in names if name in PYTHON_ESTIMATORS]
    if len(timed) == len(PYTHON_ESTIMATORS):
        put(PAGE, times(timed), "times")


if __name__ == "__main__":
    main()
