"""Controllers, estimators and limiters crossed: the tables of ``docs/systems.md``.

``python docs/figures/make_systems.py`` drives 8 seeds of each cell for 60 s on the batch plant; it takes about
a quarter of an hour on one core and needs no extra. ``--seeds N`` drives more.
"""

from __future__ import annotations

import argparse

from make_board import DOCS
from make_limits import cell
from make_parts import put

from baselines.policies.systems import SystemName
from baselines.runs.seed_ranges import FIRST_TABLE_SEED
from tlf_env.onboard.kinds import ESTIMATOR_KINDS

CONTROLLERS = (
    "reference:printed",
    "reference:consistent",
    "reference:tuned",
    "pure_pursuit",
    "feedback_linearisation",
    "feedback_linearisation:bounded",
    "kanayama",
    "kanayama:bounded",
)
LIMITERS = ("none", "yaw-rate", "body")
DISTURBANCES = ("nominal", "slip", "slip-ramps", "ice")


def crossed(estimator: str, seeds: range) -> str:
    """A row for each controller and limiter on one estimator, a column for each disturbance."""
    lines = [
        "| controller | limiter | " + " | ".join(f"`{one}`" for one in DISTURBANCES) + " |",
        "|---|---" + "|---:" * len(DISTURBANCES) + "|",
    ]
    for controller in CONTROLLERS:
        for limiter in LIMITERS:
            name = str(SystemName(controller, estimator, limiter))
            row = []
            for disturbance in DISTURBANCES:
                text = cell((name, {}), {"disturbance": disturbance}, seeds)
                all_failed = f"({len(seeds)})"
                row.append(all_failed if text.endswith(all_failed) else text)
            lines.append(f"| `{controller}` | `{limiter}` | " + " | ".join(row) + " |")
            print(lines[-1], flush=True)
    return "\n".join(lines)


def main() -> None:
    """Drive and write the tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=8)
    options = parser.parse_args()
    seeds = range(FIRST_TABLE_SEED, FIRST_TABLE_SEED + options.seeds)
    for estimator in ESTIMATOR_KINDS:
        print(estimator, flush=True)
        put(DOCS / "systems.md", crossed(estimator, seeds), estimator)


if __name__ == "__main__":
    main()
