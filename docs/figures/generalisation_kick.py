"""One robot of a row slips once, and the robots behind it move: for ``make_generalisation.py``."""

from __future__ import annotations

from typing import Any

import numpy as np
from generalisation_cells import ENTRIES
from generalisation_runs import Line, rounded

from baselines.policies.registry import fit_policy
from baselines.runs.run import PolicyDriver
from baselines.runs.seed_ranges import FIRST_TABLE_SEED
from tlf_env.engine.formation import Formation
from tlf_env.onboard.parts import Policy
from tlf_env.task.info import Info
from tlf_env.task.scenario import Scenario, load_scenario

ROBOTS, HORIZON_S = 10, 110.0
SLIPPING, AT_S, FOR_S = 1, 60.0, 1.0  # the first follower, when all robots drive
SLIP: dict[str, float] = {"slip.delta_1_mm_s": 40.0, "slip.delta_2_rad_s": 0.25}
SEEDS = range(FIRST_TABLE_SEED, FIRST_TABLE_SEED + 3)
KICK = "10 robots, one slips once"  # the name of its kept lines
PLACES = [Info._fields.index(name) for name in ("x_mm", "y_mm")]


def row_scenario(**fields: Any) -> Scenario:
    """A row of ten on the long circle, whose channels can be set while it drives; with further fields."""
    return load_scenario(
        "long_circle",
        robots=ROBOTS,
        horizon_s=HORIZON_S,
        disturbance="nominal",
        adversary=True,
        end_on=(),
        **fields,
    )


def imposed(time_s: float) -> dict[str, np.ndarray]:
    """The slip of the robot that slips, within its time."""
    if not AT_S <= time_s < AT_S + FOR_S:
        return {}
    return {path: value * (np.arange(ROBOTS) == SLIPPING) for path, value in SLIP.items()}


def positions_mm(scenario: Scenario, policy: Policy, seed: int, slips: bool) -> np.ndarray:
    """Positions of all robots after each control step, (step, robot, 2)."""
    formation = Formation(scenario)
    formation.reset(seed)
    driver = PolicyDriver(policy, scenario, formation.arrays, "policy")
    found = np.zeros((scenario.horizon_steps, ROBOTS, 2))
    for step in range(scenario.horizon_steps):
        formation.impose(imposed(formation.time_s) if slips else {})
        formation.arrays.actions[:] = driver.act()
        formation.step()
        found[step] = formation.arrays.infos[0][:, PLACES]
    return found


def displacements_mm(scenario: Scenario, policy: Policy, seed: int) -> np.ndarray:
    """The largest distance of each robot from where it is without the slip; all draws are the same."""
    with_slip, without = (positions_mm(scenario, policy, seed, slips) for slips in (True, False))
    distance: Any = np.linalg.norm(with_slip - without, axis=2)
    return np.max(distance, axis=0)


def kicked(entry: str) -> Line:
    """The kept line of an entry: the median over the seeds for each robot."""
    found = fit_policy(ENTRIES[entry], row_scenario())
    all_mm = np.median(
        [displacements_mm(found.scenario, found.policy, one) for one in SEEDS], axis=0
    )
    return {
        "table": "kick",
        "cell": KICK,
        "entry": entry,
        "seeds": [SEEDS[0], SEEDS[-1] + 1],
        "row_mm": [rounded(one) for one in all_mm],
    }
