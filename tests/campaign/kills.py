"""Writers that are killed at random moments.

    python tests/campaign/kills.py --job bench --kills 50

SIGKILL at random moments; half of them shortly after a file of the folder has changed. After every
kill each file is whole and nothing finished is lost; a kill is followed by the same command. After some kills
the command runs to its end: the folder must have the bytes of an uninterrupted run, with no temporary file.
"""

from __future__ import annotations

import argparse
import importlib
import os
import random
import shutil
import signal
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

from tqdm import tqdm

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from campaign import jobs, record

LIMIT_S = 300.0
POLLED_EVERY_S = 0.001
KILLS_PER_FOLDER = 6  # then the command runs to its end


def changes(folder: Path) -> tuple[tuple[str, int, int], ...]:
    """Names, sizes and times of all files below a folder."""
    found = []
    for parent, _, names in os.walk(folder):  # a folder that has just been removed is no error
        for name in names:
            path = Path(parent, name)
            try:
                status = path.stat()
            except OSError:
                continue
            found.append((str(path), status.st_size, status.st_mtime_ns))
    return tuple(sorted(found))


def kill_at_random(
    started: jobs.Started, folder: Path, rng: random.Random, whole_s: float, whole_changes: int
) -> bool:
    """Kill a command after a random time, or after a random number of changes; whether it still ran."""
    end = time.monotonic() + LIMIT_S
    if rng.random() < 0.5:
        end = time.monotonic() + rng.uniform(0.0, whole_s)
        while started.status() is None and time.monotonic() < end:
            time.sleep(0.001)
    else:
        left, seen = rng.randint(1, max(whole_changes, 1)), changes(folder)
        while started.status() is None and left and time.monotonic() < end:
            now = changes(folder)
            left -= now != seen
            seen = now
            time.sleep(POLLED_EVERY_S)
        time.sleep(rng.uniform(0.0, 0.004))
    killed = started.status() is None
    started.send(signal.SIGKILL)
    started.wait(30)
    return killed


def starter(job: jobs.Job, *, forked: bool) -> Callable[..., jobs.Started]:
    """What starts a job: a new process, or a fork of this one, which imports what the job needs."""
    if not forked:
        return jobs.Started
    for module in job.imports:
        importlib.import_module(module)
    warm()
    return jobs.Forked


def warm() -> None:
    """Load the compiled drivers, so that forks of this process have them."""
    from baselines.policies.registry import fit_policy
    from baselines.runs.run import run_policy, run_seeds
    from tlf_env.task.scenario import load_scenario

    for name in ("reference:linearised", "reference:consistent"):
        fitted = fit_policy(
            name, load_scenario("circle", horizon_s=0.1, time_gap_s=0.1, preview_s=())
        )
        run_policy(fitted.scenario, fitted.policy)
        list(run_seeds(fitted.scenario, fitted.policy, [0, 1]))


def measured(place: Path, job: jobs.Job, start: Callable[..., jobs.Started]) -> tuple[float, int]:
    """Run a job to its end; how long it takes, and how many changes of the folder are seen."""
    began, seen, count = time.monotonic(), (), 0
    started = start(place, job.words)
    while started.status() is None:
        now = changes(place / jobs.OUT)
        count += now != seen
        seen = now
        time.sleep(POLLED_EVERY_S)
        if time.monotonic() > began + LIMIT_S:
            started.end()
            raise TimeoutError(f"tlf {job.words[0]}")
    if started.status():
        raise RuntimeError(started.said())
    return time.monotonic() - began, count


def kill_job(
    name: str,
    kills: int,
    seed: int,
    base: Path,
    *,
    forked: bool = True,
    processes: int = 1,
    case: Callable[[list[str]], None] = lambda wrong: None,
) -> list[str]:
    """Kill a job some times, in folder after folder; what went wrong.

    Parameters
    ----------
    forked
        Start the command in a fork of this process, without the time of its imports.
    case
        Called after every kill, and after every run to the end, with what went wrong in it.
    """
    job = jobs.with_processes(jobs.JOBS[name], processes) if processes > 1 else jobs.JOBS[name]
    start = starter(job, forked=forked)
    rng = random.Random(f"{name} {seed}")
    whole = base / "whole"
    jobs.prepare(whole, job)
    whole_s, whole_changes = measured(whole, job, start)
    wanted = job.result(whole / jobs.OUT)
    wrong_in_all: list[str] = []
    number, done = 0, 0
    while done < kills:
        place = base / f"killed_{number}"
        number += 1
        jobs.prepare(place, job)
        folder = place / jobs.OUT
        finished = {}
        for _ in range(min(KILLS_PER_FOLDER, kills - done)):
            started = start(place, job.words)
            killed = kill_at_random(started, folder, rng, whole_s, whole_changes)
            if not killed and started.status():
                wrong = [
                    f"before the kill it ended with {started.status()}: {started.said()[-500:]}"
                ]
            else:
                now, wrong = job.finished(folder), jobs.half_written(folder)
                wrong += [f"lost: {one[:200]}" for one in jobs.lost(job, finished, now)]
                finished = now
            _wait_for_workers(started, wrong)
            done += 1
            wrong_in_all += wrong
            case(wrong)
        wrong = _run_to_the_end(place, job, start, wanted)
        wrong_in_all += wrong
        case(wrong)
        if not wrong:
            shutil.rmtree(place)
    return wrong_in_all


def _wait_for_workers(started: jobs.Started, wrong: list[str]) -> None:
    end = time.monotonic() + 10
    while started.members() and time.monotonic() < end:
        time.sleep(0.01)
    if started.members():
        wrong.append(f"workers are left: {started.members()}")
    started.end()


def _run_to_the_end(
    place: Path, job: jobs.Job, start: Callable[..., jobs.Started], wanted: dict[str, object]
) -> list[str]:
    try:
        jobs.run_whole(place, job, start, LIMIT_S)
    except (RuntimeError, TimeoutError) as error:
        return [f"it does not go on: {str(error)[-600:]}"]
    found, temporary = job.result(place / jobs.OUT), jobs.temporary_files(place)
    wrong = [f"temporary files are left: {temporary}"] if temporary else []
    visible = {key: value for key, value in found.items() if not Path(key).name.startswith(".")}
    return wrong + [
        f"{key} differs from an uninterrupted run"
        for key in sorted({*visible, *wanted})
        if visible.get(key) != wanted.get(key)
    ]


def parsed() -> argparse.Namespace:
    """The options of the command line."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n", maxsplit=1)[0])
    parser.add_argument("--job", choices=[*jobs.JOBS, "all"], default="all")
    parser.add_argument("--kills", type=int, default=50, help="for each job")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--processes", type=int, default=1, help="workers of the command")
    parser.add_argument("--real", action="store_true", help="new processes, not forks: slower")
    parser.add_argument("--out", type=Path, default=record.RESULTS / "kills.json")
    parser.add_argument("--keep", type=Path, help="folder for what went wrong")
    return parser.parse_args()


def main() -> int:
    """Run the campaign; 1 if anything went wrong."""
    asked = parsed()
    if asked.keep:
        asked.keep.mkdir(parents=True, exist_ok=True)
    chosen = list(jobs.JOBS) if asked.job == "all" else [asked.job]
    outcome = record.Outcome(asked.out, {k: str(v) for k, v in vars(asked).items()})
    try:
        for name in chosen:
            base = Path(tempfile.mkdtemp(prefix=f"kills-{name}-", dir=asked.keep))
            with tqdm(desc=name, unit="case") as bar:

                def case(wrong: list[str], name: str = name, bar: tqdm = bar) -> None:
                    outcome.case(name, wrong)
                    bar.update()
                    bar.set_postfix(defects=len(outcome.defects))

                wrong = kill_job(
                    name,
                    asked.kills,
                    asked.seed,
                    base,
                    forked=not asked.real,
                    processes=asked.processes,
                    case=case,
                )
            if not (wrong and asked.keep):
                shutil.rmtree(base)
    except KeyboardInterrupt:
        print("interrupted")
    return outcome.report()


if __name__ == "__main__":
    sys.exit(main())
