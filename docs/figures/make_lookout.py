"""How the entries of the board do in worlds with things in the way: they do not look.

Writes the table of ``docs/world.md``. ``python docs/figures/make_lookout.py`` drives 20 seeds of each cell on
the plant pymunk, until a robot touches something or for 60 s; it takes a few minutes and needs no extra.
"""

from __future__ import annotations

import argparse
import warnings
from typing import Any

import numpy as np
from make_board import DOCS
from make_parts import put

from baselines.policies.registry import fit_policy
from baselines.runs.seed_ranges import FIRST_TABLE_SEED
from tlf_env.engine.formation import Formation
from tlf_env.task.scenario import Scenario, load_scenario

HORIZON_S = 60.0
WORLDS = ("slalom_posts", "crossing_traffic")
DISTURBANCES = ("nominal", "slip")
ENTRIES = (
    "reference:printed",
    "reference:consistent",
    "reference:tuned",
    "pure_pursuit+ekf",
    "feedback_linearisation+ekf",
    "residual",
    "from-nothing",
)


def untouched_s(scenario: Scenario, policy: Any, seed: int) -> float:
    """Time until a robot is lost or touches something; the horizon if none does."""
    formation = Formation(scenario)
    formation.reset(seed)
    arrays, state = formation.arrays, None
    start = np.ones(scenario.robot_count, dtype=np.bool_)
    while not arrays.ends[0].any():
        actions, state = policy.predict(arrays.observations[0].copy(), state, start, True)
        arrays.actions[0], start = actions, np.zeros_like(start)
        formation.step()
    return formation.time_s


def cell(world: str, disturbance: str, name: str, seeds: range) -> str:
    """The median time until the end, s, and how many episodes reach the horizon."""
    scenario = load_scenario(world, disturbance=disturbance, horizon_s=HORIZON_S)
    fitted = fit_policy(name, scenario)
    times_s = [untouched_s(fitted.scenario, fitted.policy, seed) for seed in seeds]
    whole = sum(one >= HORIZON_S for one in times_s)
    return f"{np.median(times_s):.1f} ({whole})"


def table(seeds: range) -> str:
    """A row for each entry, a column for each world and disturbance."""
    cells = [(world, disturbance) for world in WORLDS for disturbance in DISTURBANCES]
    lines = ["| | " + " | ".join(f"`{world}`, {what}" for world, what in cells) + " |"]
    lines.append("|---" + "|---:" * len(cells) + "|")
    for name in ENTRIES:
        lines.append(f"| `{name}` | " + " | ".join(cell(*one, name, seeds) for one in cells) + " |")
        print(lines[-1], flush=True)
    return "\n".join(lines)


def main() -> None:
    """Drive and write the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=20)
    seeds = range(FIRST_TABLE_SEED, FIRST_TABLE_SEED + parser.parse_args().seeds)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # the path of the slalom leads into its posts
        put(DOCS / "world.md", table(seeds), "lookout")


if __name__ == "__main__":
    main()
