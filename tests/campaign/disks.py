"""Full disks and folders that can only be read (as root, on small file systems in memory).

    python tests/campaign/disks.py --sizes 8

Every job runs on a file system that is too small, of several sizes, so that it fills up in different files. The
command must end with one error that names the file, and with status 1; what was finished is on the disk and
whole. With more room the same command ends with the same bytes as on a large disk. Then the same for a file
system that can only be read, empty and with finished work on it.
"""

from __future__ import annotations

import argparse
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path

from tqdm import tqdm

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from campaign import jobs, kills, record

LIMIT_S = 300.0
LARGE = "64m"
FAILED, BAD_INPUT = 1, 2


def remount(place: Path, how: str) -> None:
    """Change a mounted file system: its size, or whether it can be written."""
    subprocess.run(["mount", "-o", f"remount,{how}", str(place)], check=True)


def failed_well(started: jobs.Started, folder: Path) -> list[str]:
    """What is wrong with a command that could not write."""
    said, status = started.said(), started.status()
    wrong = [] if status in (FAILED, BAD_INPUT) else [f"status {status}"]
    error = jobs.plain_error(said)
    if error:
        return [*wrong, error]
    last = said.strip().splitlines()[-1]
    if folder.name not in last:
        wrong.append(f"the error names no file: {last}")
    if not any(
        word in last for word in ("No space left", "Read-only file system", "readonly", "full")
    ):
        wrong.append(f"the error does not name the reason: {last}")
    return wrong


def full(
    job: jobs.Job,
    size: str,
    place: Path,
    start: Callable[..., jobs.Started],
    wanted: dict[str, object],
) -> list[str] | None:
    """Run a job on a disk of a size, then with more room; what went wrong, or None: it had room enough."""
    jobs.prepare(place, job)
    with jobs.mounted_tmpfs(place / jobs.OUT, size) as folder:
        started = start(place, job.words)
        try:
            if started.wait(LIMIT_S) == 0:
                return None
            wrong = failed_well(started, folder)
            finished = job.finished(folder)
            wrong += jobs.half_written(folder)
            wrong += [f"temporary: {one}" for one in jobs.temporary_files(folder)]
            remount(folder, f"size={LARGE}")
            jobs.run_whole(place, job, start, LIMIT_S)
        except (RuntimeError, TimeoutError) as error:
            return [*wrong, f"it does not go on: {str(error)[-400:]}"]
        finally:
            started.end()
        wrong += [f"lost: {one[:100]}" for one in jobs.lost(job, finished, job.finished(folder))]
        found = job.result(folder)
        wrong += [
            f"{key} differs from a large disk"
            for key in sorted({*found, *wanted})
            if found.get(key) != wanted.get(key)
        ]
    return wrong


def read_only(
    job: jobs.Job, place: Path, start: Callable[..., jobs.Started], filled: Path | None
) -> list[str]:
    """Run a job on a file system that can only be read, with the files of a folder on it."""
    jobs.prepare(place, job)
    with jobs.mounted_tmpfs(place / jobs.OUT, LARGE) as folder:
        if filled is not None:
            shutil.copytree(filled, folder, dirs_exist_ok=True)
        before = jobs._contents(folder)
        remount(folder, "ro")
        started = start(place, job.words)
        try:
            if started.wait(LIMIT_S) == 0:
                wrong = [] if before else ["it claims to have written"]
            else:
                wrong = failed_well(started, folder)
        except TimeoutError as error:
            wrong = [str(error)]
        finally:
            started.end()
        if jobs._contents(folder) != before:
            wrong.append("files changed")
    return wrong


def main() -> int:
    """Run the campaign; 1 if anything went wrong."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n", maxsplit=1)[0])
    parser.add_argument("--job", choices=[*jobs.JOBS, "all"], default="all")
    parser.add_argument("--sizes", type=int, default=8, help="sizes of the disk for each job")
    parser.add_argument("--real", action="store_true", help="new processes, not forks: slower")
    parser.add_argument("--out", type=Path, default=record.RESULTS / "disks.json")
    asked = parser.parse_args()
    outcome = record.Outcome(asked.out, {k: str(v) for k, v in vars(asked).items()})
    base = Path(tempfile.mkdtemp(prefix="disks-"))
    try:
        for name in list(jobs.JOBS) if asked.job == "all" else [asked.job]:
            job, place = jobs.JOBS[name], base / name
            start = kills.starter(job, forked=not asked.real)
            jobs.prepare(place / "whole", job)
            jobs.run_whole(place / "whole", job, start, LIMIT_S)
            wanted = job.result(place / "whole" / jobs.OUT)
            total = sum(len(one) for one in jobs._contents(place / "whole" / jobs.OUT).values())
            for i in tqdm(range(asked.sizes), desc=name, unit="size"):
                size = str(max(4096 * 2, int(total * (i + 0.5) / asked.sizes)))
                wrong = full(job, size, place / f"size {i}", start, wanted)
                kind = f"{name}, full disk" if wrong is not None else f"{name}, room enough"
                outcome.case(kind, wrong or [])
            wrong = read_only(job, place / "empty", start, None)
            outcome.case(f"{name}, read only", wrong)
            wrong = read_only(job, place / "filled", start, place / "whole" / jobs.OUT)
            outcome.case(f"{name}, read only with results", wrong)
    except KeyboardInterrupt:
        print("interrupted")
    shutil.rmtree(base, ignore_errors=True)
    return outcome.report()


if __name__ == "__main__":
    sys.exit(main())
