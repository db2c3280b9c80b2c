"""Processes that are killed while they compile, and caches on a full disk or one that can only be read.

    python tests/campaign/compiling.py --kills 20

A process that compiles some small drivers into one cache is killed at a random moment, again and again. The
next process must get right numbers from whatever is in the cache, and keep what it compiles itself.
"""

from __future__ import annotations

import argparse
import os
import random
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from tqdm import tqdm

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from campaign import jobs, record

PROGRAM = """
import sys
import warnings
import numpy as np
from tlf_env.numerics.compiled import driver

def made(power):
    @driver
    def f(a):
        for i in range(a.size):
            a[i] = a[i] ** power + i
    return f

with warnings.catch_warnings(record=True) as said:
    warnings.simplefilter("always")
    hits = 0
    for power in (1, 2, 3, 4):
        for dtype in (np.float64, np.float32):
            f, a = made(power), np.full(3, 2, dtype=dtype)
            f(a)
            assert a.tolist() == [2.0**power + i for i in range(3)], a
            hits += sum(f.stats.cache_hits.values())
            print(power, flush=True)
print("hits", hits, "warnings", len({str(one.message) for one in said}))
"""


def started(folder: Path, cache: Path) -> subprocess.Popen[str]:
    """A process that compiles the drivers of :data:`PROGRAM`."""
    path = folder / "program.py"
    if not path.exists():
        path.write_text(PROGRAM, encoding="utf-8")
    root = str(Path(__file__).resolve().parents[2])
    return subprocess.Popen(
        [sys.executable, str(path)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env=os.environ | {"TLF_ENV_CACHE": str(cache), "PYTHONPATH": root},
    )


def whole(folder: Path, cache: Path) -> tuple[list[str], list[str]]:
    """Run the process to its end; the words of its last line, and what went wrong."""
    process = started(folder, cache)
    said, errors = process.communicate(timeout=600)
    if process.returncode:
        return [], [f"status {process.returncode}: {errors[-300:]}"]
    return said.splitlines()[-1].split(), []


def killed(folder: Path, cache: Path, rng: random.Random) -> None:
    """Kill the process while it compiles: after some of its drivers, and a little more."""
    process = started(folder, cache)
    for _ in range(rng.randrange(8)):
        process.stdout.readline()
    time.sleep(rng.uniform(0.0, 0.3))
    process.send_signal(signal.SIGKILL)
    process.communicate()


def main() -> int:
    """Run the campaign; 1 if anything went wrong."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n", maxsplit=1)[0])
    parser.add_argument("--kills", type=int, default=20)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, default=record.RESULTS / "compiling.json")
    asked = parser.parse_args()
    outcome = record.Outcome(asked.out, {k: str(v) for k, v in vars(asked).items()})
    rng = random.Random(asked.seed)
    try:
        with tempfile.TemporaryDirectory() as name:
            folder = Path(name)
            for i in tqdm(range(asked.kills), unit="kill"):
                cache = folder / f"cache {i // 4}"
                killed(folder, cache, rng)
                last = i % 4 == 3 or i == asked.kills - 1
                wrong: list[str] = []
                if last:  # whatever is there: the next one works, and the one after finds all of it
                    for _ in range(2):
                        words, wrong = whole(folder, cache)
                    if words and (words[1], words[3]) != ("8", "0"):
                        wrong.append(f"not all of it is kept: {words}")
                outcome.case("killed while it compiles", wrong)
            with jobs.mounted_tmpfs(folder / "small", "16k") as small:
                words, wrong = whole(folder, small)
                if words and words[3] == "0":
                    wrong.append("no warning on a full disk")
                outcome.case("full disk", wrong)
            with jobs.mounted_tmpfs(folder / "fixed", "16m") as fixed:
                whole(folder, fixed)
                subprocess.run(["mount", "-o", "remount,ro", str(fixed)], check=True)
                words, wrong = whole(folder, fixed)
                if words and (words[1], words[3]) != ("8", "0"):
                    wrong.append(f"a cache that can only be read is not used: {words}")
                outcome.case("read only", wrong)
    except KeyboardInterrupt:
        print("interrupted")
    return outcome.report()


if __name__ == "__main__":
    sys.exit(main())
