"""Physics under stress: random robots, floors, disturbances and actions, and an audit of every substep.

    python tests/campaign/stress.py batch --substeps 1e8
    python tests/campaign/stress.py presets --cases 66
    python tests/campaign/stress.py contact --substeps 1e6
    python tests/campaign/stress.py chipmunk --substeps 1e6
    python tests/campaign/stress.py agree --cases 40

Each part goes on where its result file ends; Ctrl-C keeps what is finished. A case follows from its number
alone: ``--first N --cases 1`` runs case N again. ``--jobs`` runs cases side by side.
"""

from __future__ import annotations

import argparse
import json
import signal
import sys
import time
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

from tqdm import tqdm

sys.path.insert(0, str(Path(__file__).parents[1]))

from stress_agree import agree_case
from stress_formations import chipmunk_case, contact_case
from stress_runs import Tally, preset_case, run_case

from tlf_env.common.files import atomic

PARTS: dict[str, Callable[[int], Tally]] = {
    "batch": run_case,
    "presets": preset_case,
    "contact": contact_case,
    "chipmunk": chipmunk_case,
    "agree": agree_case,
}
SAVE_EVERY_S = 20.0


def arguments() -> argparse.Namespace:
    """Of the command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("part", choices=PARTS)
    parser.add_argument("--substeps", type=float, default=float("inf"), help="at least so many")
    parser.add_argument("--cases", type=float, default=float("inf"), help="at most so many")
    parser.add_argument(
        "--first", type=int, default=None, help="first case, without the file before"
    )
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--out", type=Path, default=None, help="results/campaign/stress-PART.json")
    return parser.parse_args()


def save(path: Path, done: int, seconds: float, tally: Tally) -> None:
    """Write the results; ``done`` is the number of the next case."""
    with atomic(path) as file:
        json.dump({"next": done, "cpu_s": round(seconds, 1), **tally.as_json()}, file, indent=1)


def timed(part: str, number: int) -> tuple[Tally, float]:
    """A case and its processor time."""
    start = time.process_time()
    return PARTS[part](number), time.process_time() - start


def ignore_interrupt() -> None:
    """Leave Ctrl-C to the process that keeps the results."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)


def main() -> int:
    """Run the cases; 1 if a law was broken."""
    given = arguments()
    path = given.out or Path("results") / "campaign" / f"stress-{given.part}.json"
    done, seconds, tally = given.first or 0, 0.0, Tally()
    if given.first is None and path.exists():
        tree = json.loads(path.read_text(encoding="utf-8"))
        done, seconds, tally = tree["next"], tree["cpu_s"], Tally.of_json(tree)
    last, saved = done + given.cases, time.monotonic()
    goal = None if given.substeps == float("inf") else int(given.substeps)
    bar = tqdm(
        total=goal, initial=int(tally.counts.get("substeps", 0)), unit=" substeps", unit_scale=True
    )
    try:
        with ProcessPoolExecutor(given.jobs, initializer=ignore_interrupt) as pool, bar:
            while done < last and tally.counts.get("substeps", 0) < given.substeps:
                numbers = range(done, int(min(done + given.jobs, last)))
                for one, cpu_s in pool.map(timed, [given.part] * len(numbers), numbers):
                    tally.add(one)
                    seconds += cpu_s
                    done += 1
                    bar.update(int(one.counts.get("substeps", 0)))
                if time.monotonic() > saved + SAVE_EVERY_S:
                    save(path, done, seconds, tally)
                    saved = time.monotonic()
    except KeyboardInterrupt:
        print("interrupted")
    save(path, done, seconds, tally)
    broken = {
        name: int(n) for name, n in tally.counts.items() if name.startswith("findings/") and n
    }
    print(
        f"{path}: {int(tally.counts.get('substeps', 0))} substeps in {done} cases, {seconds:.0f} s of CPU"
    )
    print(f"laws broken: {broken or 'none'}")
    return 1 if broken else 0


if __name__ == "__main__":
    sys.exit(main())
