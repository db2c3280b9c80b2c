"""The table of the rivals in ``docs/systems.md``: other laws, on seeds for choosing.

``python docs/figures/make_systems.py`` drives 8 seeds of each cell for 60 s on the batch plant and measures the
processor time of each law; it takes about a quarter of an hour on one core and needs the extra ``mpc``.
``--seeds N`` drives more, ``--only LAW ...`` only some rows.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Iterable
from typing import Any

import numpy as np
from make_board import DOCS
from make_limits import cell
from make_parts import put

from baselines.policies.laws.catalogue import LAWS
from baselines.policies.registry import fit_policy
from baselines.policies.systems import SystemName
from baselines.runs.run import run_policy
from baselines.runs.seed_ranges import CHOOSING_SEEDS
from tlf_env.task.scenario import load_scenario

RIVALS = tuple(f"{law}:bounded" for law in LAWS)
RIVAL_LIMITERS = ("none", "body")
RIVAL_ESTIMATORS = ("ekf-slip", "truth")
RIVAL_DISTURBANCES = ("nominal", "slip")
RIVAL_HEAD = "| controller | limiter |"


def cells(name: str, disturbances: Iterable[str], seeds: range) -> list[str]:
    """A system's cell for each disturbance; only the number of failed runs where all fail."""
    all_failed = f"({len(seeds)})"
    found = [cell((name, {}), {"disturbance": one}, seeds) for one in disturbances]
    return [all_failed if text.endswith(all_failed) else text for text in found]


class Timed:
    """A policy that counts the seconds of processor time that it takes."""

    def __init__(self, policy: Any) -> None:
        self.policy, self.seconds = policy, []

    def predict(self, *given: Any) -> Any:
        """The policy's answer."""
        start = time.thread_time()
        answer = self.policy.predict(*given)
        self.seconds.append(time.thread_time() - start)
        return answer


def microseconds(name: str) -> str:
    """Processor time for each robot and step of five robots: the median and the 99th percentile of steps."""
    robots = 5
    scenario = load_scenario("infinity", robots=robots, horizon_s=20.0, plant="batch")
    fitted = fit_policy(name, scenario)
    timed = Timed(fitted.policy)
    run_policy(fitted.scenario, timed, 10_000)
    per_robot = 1e6 * np.array(timed.seconds[1:]) / robots
    return " / ".join(f"{value:.0f}" for value in np.percentile(per_robot, (50, 99)))


def rivals(seeds: range, only: tuple[str, ...]) -> str:
    """The rivals' rows, those of other laws than ``only`` as they are in the page."""
    places = [(one, two) for one in RIVAL_ESTIMATORS for two in RIVAL_DISTURBANCES]
    head = " | ".join(f"`{one}`, `{two}`" for one, two in places)
    lines = [f"{RIVAL_HEAD} {head} | µs |", "|---|---" + "|---:" * (len(places) + 1) + "|"]
    page = (DOCS / "systems.md").read_text(encoding="utf-8")
    kept = page[page.index("<!-- rivals -->") : page.index("<!-- end of rivals -->")].splitlines()
    for controller in RIVALS:
        for limiter in RIVAL_LIMITERS:
            start = f"| `{controller}` | `{limiter}` |"
            row = next((line for line in kept if line.startswith(start)), None)
            if row is None or not only or controller.partition(":")[0] in only:
                names = [str(SystemName(controller, one, limiter)) for one in RIVAL_ESTIMATORS]
                found = [text for name in names for text in cells(name, RIVAL_DISTURBANCES, seeds)]
                row = f"{start} " + " | ".join([*found, microseconds(names[0])]) + " |"
            lines.append(row)
            print(row, flush=True)
    return "\n".join(lines)


def main() -> None:
    """Drive and write the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=8)
    parser.add_argument("--only", nargs="*", metavar="LAW", default=())
    options = parser.parse_args()
    first = CHOOSING_SEEDS[0]
    made = rivals(range(first, first + options.seeds), tuple(options.only))
    put(DOCS / "systems.md", made, "rivals")


if __name__ == "__main__":
    main()
