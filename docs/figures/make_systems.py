"""The processor time of each tracking law, a table of ``docs/systems.md``.

``python docs/figures/make_systems.py`` takes a minute and needs the extra ``mpc``.
"""

from __future__ import annotations

import argparse
import time
from typing import Any

import numpy as np
from make_board import DOCS
from make_parts import put

from baselines.policies.laws.catalogue import LAWS
from baselines.policies.registry import fit_policy
from baselines.runs.run import run_policy
from baselines.runs.seed_ranges import CHOOSING_SEEDS
from tlf_env.task.scenario import load_scenario

NAMES = (
    "reference:tuned+ekf-gyro-smoothed+grip",
    *(f"{law}:bounded+ekf-gyro-smoothed+grip" for law in LAWS),
)
ROBOTS, HORIZON_S = 5, 20.0


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


def row(name: str) -> str:
    """Median and 99th percentile over the steps, in ms for all robots, and their share of a control period."""
    scenario = load_scenario("infinity", robots=ROBOTS, horizon_s=HORIZON_S, plant="batch")
    fitted = fit_policy(name, scenario)
    timed = Timed(fitted.policy)
    run_policy(fitted.scenario, timed, CHOOSING_SEEDS[0])
    median, most = np.percentile(timed.seconds[1:], (50, 99))
    share = most / scenario.control_period_s
    return f"| `{name}` | {1e3 * median:.2f} | {1e3 * most:.2f} | {share:.1%} |".replace("%", " %")


def main() -> None:
    """Drive and write the table."""
    argparse.ArgumentParser(description=__doc__).parse_args()
    lines = ["| system | median ms | 99th percentile ms | of 20 ms |", "|---|---:|---:|---:|"]
    for name in NAMES:
        lines.append(row(name))
        print(lines[-1], flush=True)
    put(DOCS / "systems.md", "\n".join(lines), "times")


if __name__ == "__main__":
    main()
