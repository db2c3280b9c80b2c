"""Commands that are asked to stop: SIGINT (Ctrl-C) and SIGTERM at random moments, to the command or its group.

    python tests/campaign/stops.py --rounds 2

Ctrl-C in a terminal reaches the whole group; ``kill PID`` and a batch system reach the command alone. In both
cases the command must end within a few seconds, say in one line what to do, leave no worker behind, and end
with the status that its help promises. What was finished stays.
"""

from __future__ import annotations

import argparse
import json
import os
import random
import resource
import shutil
import signal
import statistics
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

from tqdm import tqdm

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from campaign import jobs, record

STATUS = {signal.SIGINT: 130, signal.SIGTERM: 143}
LIMIT_S = 60.0


class Stopped(NamedTuple):
    """A command that is stopped."""

    words: tuple[str, ...]
    goes_on: bool = False  # the message names the command that goes on
    ready: str = ""  # a file that is there once the command works; without: after a second
    keeps: Callable[[Path], dict[str, object]] | None = None
    settings: dict[str, str] = {}


class Took(NamedTuple):
    """Times from a signal to the end of a command, s; on a quiet machine the first is about the second."""

    wall_s: float
    processor_s: float  # of the command and its workers together


def processor_s(pid: int) -> float:
    """Processor time of a process and of its children that have ended."""
    try:
        fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    except OSError:
        return 0.0
    return sum(map(int, fields[11:15])) / os.sysconf("SC_CLK_TCK")


def ended_processor_s() -> float:
    """Processor time of all children of this process that have ended, and of theirs."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


LONG = {
    **jobs.TRAINING,
    "robot_steps": 3_000_000,
    "formations": 16,
    "checkpoint_every": 3000,
    "evaluation": jobs.TRAINING["evaluation"] | {"every": 200_000},
    "settings": jobs.TRAINING["settings"] | {"n_steps": 32, "batch_size": 512},
}
BENCH = (
    *("bench", "--policies", "reference:linearised,pure_pursuit", "--tasks", "infinity"),
    *("--disturbances", "nominal,slip", "--seeds", "20000:20400", "--horizon-s", "10"),
    *("--no-figures", "--out", "out"),
)
STOPPED = {
    "bench": Stopped((*BENCH, "--processes", "1"), True, "out/runs.jsonl", jobs.BENCH.finished),
    "bench, 2 processes": Stopped(
        (*BENCH, "--processes", "2"), True, "out/runs.jsonl", jobs.BENCH.finished
    ),
    "bench, batch plant": Stopped(
        (*BENCH[:-2], "--plant", "batch", "--processes", "2", "--out", "out"),
        True,
        "out/plan.json",
        jobs.BENCH.finished,
    ),
    "bench --test": Stopped(
        (*BENCH[:3], "--test", "--processes", "2", "--out", "out"), True, "out/plan.json"
    ),
    "bench --envelope": Stopped(
        (*BENCH[:3], "--envelope", "--processes", "2", "--out", "out"),
        True,
        "out/envelope_plan.json",
    ),
    "bench --check": Stopped(("bench", "--check", "infinity:slip", "--out", "out"), True),
    "eval": Stopped(
        ("eval", "pure_pursuit", "--processes", "2", "--out", "out"), True, "out/runs.jsonl"
    ),
    "run": Stopped(("run", "infinity", "--horizon-s", "4000", "--no-figures", "--out", "out")),
    "demo": Stopped(("demo", "--out", "out")),
    "speed": Stopped(("speed",)),
    "export": Stopped(("export", "infinity,flower", "--seeds", "0:400", "--out", "out")),
    "tune": Stopped(
        ("tune", "long.yaml", "--out", "out"), True, "out/study.db", jobs.TUNE.finished
    ),
    "tune, 2 workers": Stopped(
        ("tune", "long.yaml", "--workers", "2", "--out", "out"),
        True,
        "out/study.db",
        jobs.TUNE.finished,
    ),
    "paper": Stopped(("paper", "--out", "out")),
    "compile": Stopped(("compile",), settings={"TLF_ENV_CACHE": "cache"}),
    "openloop": Stopped(("openloop", "torques.json", "--out", "out", "--dt-s", "0.0001")),
    "view": Stopped(("view", "infinity"), settings={"SDL_VIDEODRIVER": "dummy"}),
    "play": Stopped(("play", "infinity"), settings={"SDL_VIDEODRIVER": "dummy"}),
}
LEARNING = {
    "train": Stopped(
        ("train", "train.yaml", "--seeds", "0", "--processes", "1", "--out", "out"),
        True,
        "out/seed_0/robot_steps",
        jobs.TRAIN.finished,
    ),
    "train, 2 processes": Stopped(
        ("train", "train.yaml", "--seeds", "0,1", "--processes", "2", "--out", "out"),
        True,
        "out/seed_1/robot_steps",
        jobs.TRAIN.finished,
    ),
    "train --search": Stopped(
        ("train", "search.yaml", "--search", "--processes", "2", "--out", "out"),
        True,
        "out/trial_001/seed_0/plan.json",
    ),
}
FILES = {
    "long.yaml": {**jobs.SEARCH, "trials": 5000, "horizon_s": 6},
    "train.yaml": LONG,
    "search.yaml": {
        **LONG,
        "search": {
            "ranges": {"settings.learning_rate": {"low": 1e-3, "high": 1e-2, "log": True}},
            "robot_steps": 200_000,
            "seeds": [0],
            "choose_seeds": [1],
            "trials": 6,
        },
    },
    "torques.json": {
        "one": {"duration_s": 1000.0, "inputs": [{"torque_l_Nmm": 1.0, "torque_r_Nmm": 1.0}]}
    },
}


def stop(
    what: Stopped,
    number: int,
    group: bool,
    place: Path,
    later_s: float,
    within_s: float,
    took: Callable[[Took], object] = lambda times: None,
) -> list[str]:
    """Start a command, stop it, and look at what is left; what went wrong.

    Parameters
    ----------
    took
        Called with the times from the signal to the end of the command.
    """
    others_s = ended_processor_s()
    place.mkdir(parents=True)
    for file, content in FILES.items():
        (place / file).write_text(json.dumps(content), encoding="utf-8")
    started = jobs.Started(place, what.words, **what.settings)
    wrong = []
    try:
        end = time.monotonic() + LIMIT_S
        ready = place / what.ready if what.ready else started.errors
        while not ready.exists() and started.status() is None and time.monotonic() < end:
            time.sleep(0.01)
        time.sleep(later_s + (0.0 if what.ready else 2.0))
        if started.status() is not None:
            return [
                f"it ended before it was stopped, with {started.status()}: {started.said()[-400:]}"
            ]
        before = what.keeps(place / "out") if what.keeps else {}
        sent, used_s = time.monotonic(), sum(map(processor_s, started.members()))
        if group:
            for pid in started.members():
                os.kill(pid, number)
        else:
            started.send(number)
        try:
            status = started.wait(LIMIT_S)
        except TimeoutError as error:
            return [str(error)]
        took_s = time.monotonic() - sent
        took(Took(took_s, max(0.0, ended_processor_s() - others_s - used_s)))
        said = started.said()
        if took_s > within_s:
            wrong.append(f"it took {took_s:.1f} s to stop")
        if status != STATUS[signal.Signals(number)]:
            wrong.append(f"status {status}: {said[-300:]!r}")
        error = jobs.plain_error(said)
        if error:
            wrong.append(error)
        elif "interrupted" not in said and "stopped" not in said:
            wrong.append(f"it does not say that it was interrupted: {said[-200:]!r}")
        elif what.goes_on and "the same command goes on" not in said:
            wrong.append("it does not say how to go on")
        if started.members():
            time.sleep(0.5)
        if started.members():
            wrong.append(f"{len(started.members())} processes are left")
        if what.keeps:
            job = jobs.Job(what.words, what.keeps, what.keeps)
            now = what.keeps(place / "out")
            wrong += [f"lost: {one[:100]}" for one in jobs.lost(job, before, now)]
        wrong += jobs.half_written(place / "out")
        left = jobs.temporary_files(place / "out")
        if left:
            wrong.append(f"temporary files are left: {left}")
    finally:
        started.end()
    return wrong


def main() -> int:
    """Run the campaign; 1 if anything went wrong."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n", maxsplit=1)[0])
    commands = {**STOPPED, **LEARNING}
    parser.add_argument("--only", help="names of cases, with ; between: " + "; ".join(commands))
    parser.add_argument("--learning", action="store_true", help="trainings, too (needs torch)")
    parser.add_argument(
        "--within-s", type=float, default=2.5, help="time to stop, on a quiet machine"
    )
    parser.add_argument("--rounds", type=int, default=1)
    parser.add_argument(
        "--usual", action="store_true", help="only Ctrl-C to the group, and SIGTERM to the command"
    )
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, default=record.RESULTS / "stops.json")
    asked = parser.parse_args()
    chosen = commands if asked.learning else STOPPED
    if asked.only:
        chosen = {name: commands[name] for name in asked.only.split(";")}
    outcome = record.Outcome(asked.out, {k: str(v) for k, v in vars(asked).items()})
    rng = random.Random(asked.seed)
    base = Path(tempfile.mkdtemp(prefix="stops-"))
    took_s: dict[str, list[Took]] = {}
    cases = [
        (name, number, group, turn)
        for turn in range(asked.rounds)
        for name in chosen
        for number in STATUS
        for group in (False, True)
        if not asked.usual or group is (number == signal.SIGINT)
    ]
    try:
        for i, (name, number, group, _) in enumerate(tqdm(cases, unit="case")):
            kind = f"{name}, {signal.Signals(number).name} to {'its group' if group else 'it'}"
            place = base / str(i)
            later_s = rng.uniform(0.0, 1.0)
            took = took_s.setdefault(name, []).append
            wrong = stop(chosen[name], number, group, place, later_s, asked.within_s, took)
            outcome.figures |= {
                f"{one}, s until it has ended": {
                    f"{which} {field.removesuffix('_s')}": round(of(column), 2)
                    for field, column in zip(Took._fields, zip(*times, strict=True), strict=True)
                    for which, of in (("median", statistics.median), ("largest", max))
                }
                for one, times in took_s.items()
                if times
            }
            outcome.figures["largest load of the machine"] = max(
                outcome.figures.get("largest load of the machine", 0.0),
                round(os.getloadavg()[0], 1),
            )
            outcome.case(kind, wrong)
            for one in wrong:
                tqdm.write(f"{kind}: {one}")
            shutil.rmtree(place)
    except KeyboardInterrupt:
        print("interrupted")
    shutil.rmtree(base, ignore_errors=True)
    return outcome.report()


if __name__ == "__main__":
    sys.exit(main())
