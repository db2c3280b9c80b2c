"""Fuzzing: hostile files, mappings, actions, snapshots, arguments and words of the command line.

Each target makes cases and tries them. What is allowed is a documented error, in one line, or a valid result
with finite numbers. What is found: any other error, a line that is none, a number that is not finite, a
traceback on the command line, a hang, and a crash of the interpreter. Cases run in processes of their own, so
that the last two are found, too. Each finding is kept as a file, its case as small as Hypothesis can make it:

    python tests/campaign/fuzz.py --cases 2000 --seed 1
    python tests/campaign/fuzz.py --targets actions,snapshots --cases 10000
    python tests/campaign/fuzz.py --replay results/campaign/fuzz/NAME.json

The counts of each target are in fuzz.json; ``--table`` shows them, with those of fuzz_parsers.py. Ctrl-C ends
the campaign; what was counted is kept.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import multiprocessing
import os
import resource
import signal
import sys
import time
import traceback
import warnings
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from campaign.fuzzing import TARGETS, ViolationError, encoded, restored

OUT = Path("results/campaign/fuzz")
CASE_LIMIT_S = 300  # for one case: compiling a driver takes minutes where other work goes on
STALL_LIMIT_S = (
    600.0  # without a new case, after which a process is killed: compiled code that hangs
)
MOST_MEMORY = 3 * 2**30  # bytes that a process may take: more is a finding, a MemoryError
BATCH = 500  # cases in one process


class Finding(NamedTuple):
    """What a case has shown that is not allowed."""

    target: str
    signature: str  # equal for findings that probably have the same cause
    message: str
    case: Any


class HangError(Exception):
    """A case that takes too long."""


def signature_of(error: BaseException) -> str:
    """The type of an error, and where in the project it was raised."""
    if isinstance(error, ViolationError):
        return error.what
    places = [
        f"{Path(frame.filename).name}:{frame.name}"
        for frame in traceback.extract_tb(error.__traceback__)
        if any(room in frame.filename for room in ("tlf_env", "baselines"))
    ]
    return f"{type(error).__name__} in {places[-1] if places else 'a library'}"


def tried(target: str, case: Any) -> Finding | None:
    """Try a case; what it has shown that is not allowed."""

    def late(*_: Any) -> None:
        raise HangError(f"more than {CASE_LIMIT_S} s")

    signal.signal(signal.SIGALRM, late)
    signal.alarm(CASE_LIMIT_S)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            TARGETS[target].check(restored(case))
    except KeyboardInterrupt:
        raise
    except BaseException as error:  # SystemExit and every other kind is a finding
        text = "".join(traceback.format_exception(error)[-4:])
        return Finding(target, signature_of(error), text, case)
    finally:
        signal.alarm(0)
    return None


def searched(
    target: str, cases: int, seed: int, known: set[str], begun: Callable[[Any], None]
) -> Iterator[Finding | int]:
    """Findings with new signatures among so many cases, each case minimised; at the end the number of cases."""
    from hypothesis import HealthCheck, Phase, given, settings
    from hypothesis import seed as seeded

    done, rounds = 0, 0
    while done < cases:
        found: dict[str, Finding] = {}  # by signature; the last one of each is the smallest

        @seeded(seed + 7919 * rounds)
        @settings(
            max_examples=cases - done,
            database=None,
            deadline=None,
            suppress_health_check=list(HealthCheck),
            phases=(Phase.generate, Phase.shrink),
            report_multiple_bugs=False,
        )
        @given(TARGETS[target].cases)
        def attempt(case: Any) -> None:
            nonlocal done
            done += not found
            plain = encoded(case)
            begun(plain)
            one = tried(target, plain)
            if one is not None and one.signature not in known:
                found[one.signature] = one
                # Hypothesis takes errors of one type for the same, and would minimise one into another.
                raise type(one.signature, (AssertionError,), {})

        before = done
        try:
            attempt()
        except Exception as error:  # also Hypothesis's own: a case that fails only sometimes
            if not found:
                what = f"{type(error).__name__} of Hypothesis"
                found[what] = Finding(target, what, str(error)[:2000], None)
        known.update(found)
        yield from found.values()
        rounds += 1
        if done == before:  # the target has no more cases than these
            break
    yield done


def in_process(
    target: str, cases: int, seed: int, known: set[str], folder: Path, queue: Any
) -> None:
    """Run a batch in this process, and report into a queue."""
    sys.stdout = sys.stderr = Path(os.devnull).open("w", encoding="utf-8")  # noqa: SIM115 - open until the process ends
    used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (used + MOST_MEMORY, used + MOST_MEMORY))
    current = folder / f".{target}.current.json"

    def begun(case: Any) -> None:
        current.write_text(json.dumps(case))

    for one in searched(target, cases, seed, known, begun):
        queue.put(one if isinstance(one, int) else tuple(one))
    current.unlink(missing_ok=True)


def batch(
    target: str, cases: int, seed: int, known: set[str], folder: Path
) -> tuple[int, list[Finding]]:
    """A batch in a process of its own: how many cases ran, and findings; a crash and a hang are findings."""
    context = multiprocessing.get_context("fork")
    queue = context.Queue()
    current = folder / f".{target}.current.json"
    process = context.Process(
        target=in_process, args=(target, cases, seed, known, folder, queue), daemon=True
    )
    process.start()
    found: list[Finding] = []
    done, last, stamp = None, time.monotonic(), 0.0
    while done is None and (process.is_alive() or not queue.empty()):
        with suppress(Exception):  # queue.Empty
            one = queue.get(timeout=1.0)
            if isinstance(one, int):
                done = one
            else:
                found.append(Finding(*one))
            continue
        with suppress(OSError):
            if current.stat().st_mtime != stamp:
                stamp, last = current.stat().st_mtime, time.monotonic()
        if time.monotonic() - last > STALL_LIMIT_S:
            process.kill()
            found.append(Finding(target, "hang in compiled code", "killed", _case(current)))
            done = 0
    process.join(10)
    if done is None:
        how = f"the interpreter ended with status {process.exitcode}"
        found.append(Finding(target, how, how, _case(current)))
    current.unlink(missing_ok=True)
    return done or 0, found


def _case(path: Path) -> Any:
    try:
        return json.loads(path.read_text())
    except (OSError, ValueError):
        return None


def save(found: Finding, folder: Path) -> Path:
    """Write a finding as a file that ``--replay`` tries again."""
    digits = hashlib.sha256(f"{found.target} {found.signature}".encode()).hexdigest()[:8]
    path = folder / f"{found.target}-{digits}.json"
    path.write_text(json.dumps(found._asdict(), indent=1))
    return path


def write_counts(path: Path, counts: dict[str, Any]) -> None:
    """Write the counts; the file is complete or not changed."""
    temporary = path.with_suffix(".part")
    temporary.write_text(json.dumps(counts, indent=1))
    temporary.replace(path)


def campaign(names: list[str], cases: int, seed: int, folder: Path) -> dict[str, Any]:
    """Run all targets; the counts by target."""
    from tqdm import tqdm

    folder.mkdir(parents=True, exist_ok=True)
    path = folder / "fuzz.json"
    counts: dict[str, Any] = json.loads(path.read_text()) if path.exists() else {}
    wanted = {name: max(1, round(cases * TARGETS[name].share)) for name in names}
    bar = tqdm(total=sum(wanted.values()), unit="case", smoothing=0.05)
    try:
        for name, total in wanted.items():
            bar.set_description(name)
            entry = counts.setdefault(name, {"cases": 0, "seconds": 0.0, "findings": []})
            known = {one["signature"] for one in entry["findings"]}
            done, number = 0, 0
            while done < total:
                since = time.monotonic()
                size = min(BATCH, total - done)
                here = seed + 1_000_003 * number
                ran, found = batch(name, size, here, set(known), folder)
                for one in found:
                    known.add(one.signature)
                    entry["findings"].append(
                        {"signature": one.signature, "file": save(one, folder).name}
                    )
                entry["cases"] += ran
                entry["seconds"] += round(time.monotonic() - since, 1)
                number += 1
                done += ran if ran else size
                bar.update(ran if ran else size)
                write_counts(path, counts)
                if ran < size and not found:  # the target has no more cases
                    break
    except KeyboardInterrupt:
        print("interrupted; what was counted is kept")
    bar.close()
    return counts


def table(counts: dict[str, Any], guided: dict[str, Any]) -> list[str]:
    """The lines of a table in Markdown: cases and findings of each module of targets, and of all.

    Parameters
    ----------
    counts
        As in ``fuzz.json``.
    guided
        As in ``fuzz_parsers.json``.
    """
    kinds: dict[str, list[str]] = {}
    for name, one in TARGETS.items():
        if name in counts or name in guided:
            about = sys.modules[one.check.__module__].__doc__ or ""
            kinds.setdefault(about.splitlines()[0].rstrip("."), []).append(name)

    def row(what: str, names: list[str]) -> str:
        drawn = sum(counts[name]["cases"] for name in names if name in counts)
        led = sum(guided[name]["cases"] for name in names if name in guided)
        found = sum(len(counts[name]["findings"]) for name in names if name in counts)
        found += sum(guided[name]["status"] != 0 for name in names if name in guided)
        return f"| {what} | {drawn} | {led or ''} | {found} |"

    return [
        "| what | cases | guided cases | findings |",
        "|---|---:|---:|---:|",
        *(row(what, names) for what, names in kinds.items()),
        row("**all**", [name for names in kinds.values() for name in names]),
    ]


def main() -> int:
    """Run the command; 0 if nothing was found."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("--targets", default="all", help=f"all, or some of {', '.join(TARGETS)}")
    parser.add_argument(
        "--cases", type=int, default=1000, help="cases of a target with the share 1"
    )
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, default=OUT)
    parser.add_argument("--replay", type=Path, help="a finding's file, tried again in this process")
    parser.add_argument(
        "--table", action="store_true", help="print what the results hold, as a table"
    )
    given = parser.parse_args()
    if given.table:
        paths = [given.out / name for name in ("fuzz.json", "fuzz_parsers.json")]
        print(
            *table(*(json.loads(one.read_text()) if one.exists() else {} for one in paths)),
            sep="\n",
        )
        return 0
    if given.replay is not None:
        one = json.loads(given.replay.read_text())
        found = tried(one["target"], one["case"])
        print("allowed" if found is None else found.message)
        return int(found is not None)
    names = list(TARGETS) if given.targets == "all" else given.targets.split(",")
    unknown = [name for name in names if name not in TARGETS]
    if unknown:
        parser.error(f"target {unknown[0]!r} is not one of {', '.join(TARGETS)}")
    counts = campaign(names, given.cases, given.seed, given.out.resolve())
    for name in names:
        if name in counts:
            one = counts[name]
            print(
                f"{name}: {one['cases']} cases, {len(one['findings'])} findings, {one['seconds']:.0f} s"
            )
            for found in one["findings"]:
                print(f"  {found['signature']}: {found['file']}")
    return int(any(counts[name]["findings"] for name in names if name in counts))


if __name__ == "__main__":
    sys.exit(main())
