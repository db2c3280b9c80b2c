"""Fuzzing of the readers of files with atheris, guided by the lines that a case reaches.

It needs ``pip install atheris`` (CPython 3.11 to 3.13 on Linux), which no extra of the package has. The checks
are those of ``fuzz.py``; a case that fails is written to the folder of the results:

    python tests/campaign/fuzz_parsers.py --reader paths --seconds 60 --seed 1
    python tests/campaign/fuzz_parsers.py --reader paths --replay results/campaign/fuzz/crash-...

Each reader runs for so long, from a corpus of valid files, and the number of cases is printed. What libFuzzer
prints goes to a log beside the counts. ``--reader all`` runs one after another, each in a process of its own.
"""

from __future__ import annotations

import argparse
import json
import re
import subprocess
import sys
import tempfile
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

OUT = Path("results/campaign/fuzz")
LONGEST = 2000  # bytes of a case
# Modules whose lines guide the search; none with compiled laws, which Numba would compile with the counters.
READING = [
    "tlf_env.common.presets",
    "tlf_env.common.files",
    "tlf_env.common.errors",
    "tlf_env.task.waypoints",
    "tlf_env.task.sources",
    "baselines.paths.read",
    "baselines.benchmark.plan",
    "baselines.policies.card",
    "baselines.runs.jsonl",
    "yaml",
]


NAMES = (
    "paths",
    "scenario_files",
    "open_loop_files",
    "weight_files",
    "result_lines",
    "option_texts",
    "settings",
)


def readers() -> dict[str, tuple[Callable[[bytes], Any], list[bytes]]]:
    """What reads the bytes of a case, and valid files to begin with."""
    from campaign.fuzzing import TARGETS
    from campaign.fuzzing.checks import refused, working_folder
    from campaign.fuzzing.files import LOGS
    from campaign.fuzzing.policies import weights
    from campaign.fuzzing.scenarios import scenario_texts

    from baselines.paths.read import read_log
    from tlf_env.task.waypoints import read_points

    def text(data: bytes) -> str:
        return data.decode("utf-8", "replace")

    def path(data: bytes) -> None:
        with working_folder() as folder:
            (folder / "log.csv").write_bytes(data)
            refused(lambda: read_points(folder / "log.csv"))
            refused(lambda: read_log(folder / "log.csv"))

    def check(name: str) -> Callable[[Any], Any]:
        return TARGETS[name].check

    options = [b"1:9", b"slip.delta_1_mm_s=0:40:9:log", b"a:b,c:d", b"robots=3,5"]
    fields = [
        b"time_gap_s=3",
        b"disturbance.slip.delta_1_mm_s={type: sine, amplitude: 1, frequency_hz: 2}",
    ]
    torques = json.dumps(
        {"a": {"duration_s": 0.1, "inputs": [{"torque_l_Nmm": 1, "torque_r_Nmm": 1}]}}
    )
    return {
        "paths": (path, LOGS),
        "scenario_files": (check("scenario_files"), scenario_texts()),
        "open_loop_files": (check("open_loop_files"), [torques.encode()]),
        "weight_files": (check("weight_files"), weights()),
        "result_lines": (check("result_lines"), [b'{"seed": 1}\n{"seed": 2}\n']),
        "option_texts": (lambda data: check("option_texts")(text(data)), options),
        "settings": (lambda data: check("settings")([text(data)]), fields),
    }


def fuzz(name: str, seconds: int, seed: int, folder: Path) -> None:
    """Run one reader in this process, until libFuzzer ends it."""
    import atheris

    with atheris.instrument_imports(include=READING):
        check, corpus = readers()[name]
    start = Path(tempfile.mkdtemp())
    for number, data in enumerate(corpus):
        (start / str(number)).write_bytes(data[:LONGEST])

    def attempt(data: bytes) -> None:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            check(data)

    words = [
        f"-max_total_time={seconds}",
        f"-seed={seed}",
        f"-max_len={LONGEST}",
        f"-artifact_prefix={folder}/{name}-",
        "-timeout=30",
        "-rss_limit_mb=4000",
        "-print_final_stats=1",
    ]
    atheris.Setup([sys.argv[0], *words, str(start)], attempt)
    atheris.Fuzz()


def main() -> int:
    """Run the command; 0 if nothing was found."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("--reader", default="all", help=f"all, or one of {', '.join(NAMES)}")
    parser.add_argument("--seconds", type=int, default=60, help="for each reader")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--out", type=Path, default=OUT)
    parser.add_argument("--replay", type=Path, help="a file that libFuzzer has written")
    parser.add_argument("--inner", action="store_true", help=argparse.SUPPRESS)
    given = parser.parse_args()
    if given.replay is not None:
        readers()[given.reader][0](given.replay.read_bytes())
        print("allowed")
        return 0
    folder = given.out.resolve()
    folder.mkdir(parents=True, exist_ok=True)
    if given.inner:
        fuzz(given.reader, given.seconds, given.seed, folder)
        return 0
    names = list(NAMES) if given.reader == "all" else [given.reader]
    counts, failed = {}, 0
    for name in names:
        words = [
            "--reader",
            name,
            "--seconds",
            given.seconds,
            "--seed",
            given.seed,
            "--out",
            folder,
        ]
        with (folder / f"{name}.log").open("w") as log:
            done = subprocess.run(
                [sys.executable, __file__, *map(str, words), "--inner"],
                stdout=log,
                stderr=subprocess.STDOUT,
                check=False,
            )
        said = (folder / f"{name}.log").read_text(errors="replace")
        ran = re.findall(r"number_of_executed_units: (\d+)|^#(\d+)\s", said, re.MULTILINE)
        counts[name] = {
            "cases": max((int(a or b) for a, b in ran), default=0),
            "status": done.returncode,
        }
        failed |= done.returncode
        print(f"{name}: {counts[name]['cases']} cases, status {done.returncode}", flush=True)
        (folder / "fuzz_parsers.json").write_text(json.dumps(counts, indent=1))
    return int(failed != 0)


if __name__ == "__main__":
    sys.exit(main())
