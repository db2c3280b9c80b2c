"""Measure what a world costs and write the table of ``docs/world.md``.

``python docs/figures/make_world.py`` takes about a minute and needs no extra. Three robots drive straight on,
one behind the other, at 100 mm/s. The cases are timed in turn, in CPU time, so that other programs matter
little; the table has the medians, of the times and of the ratios to the first case.
"""

from __future__ import annotations

import re
import statistics
import time
from pathlib import Path
from typing import Any

import numpy as np

import tlf_env
from tlf_env.envs.parallel import FormationParallelEnv

PAGE = Path(__file__).resolve().parent.parent / "world.md"
BEGIN, END = "<!-- cost -->\n", "<!-- end of cost -->"
ROUNDS, STEPS = 11, 150
ROBOTS = 3
DISC = {"type": "circle", "radius_mm": 150.0}
NEAR_X_MM, FAR_MM = 115.0, 20_000.0  # of a wall 5 mm beside the outlines, and of what is far away


def walls(count: int, x_mm: float) -> dict[str, Any]:
    """Walls along the way, one beside the other."""
    ends = [[[x_mm + 50.0 * i, -5000.0], [x_mm + 50.0 * i, 5000.0]] for i in range(count)]
    return {"walls": [{"points_mm": points, "thickness_mm": 0.0} for points in ends]}


def boxes(x_mm: float, y_mm: float) -> dict[str, Any]:
    """A box of 1 kg on castors."""
    shape = {"type": "box", "width_mm": 200.0, "length_mm": 200.0}
    place = {"x_mm": x_mm, "y_mm": y_mm, "mass_kg": 1.0, "floor_friction": 0.02}
    return {"pushables": [{"shape": shape, **place}]}


def persons(x_mm: float) -> dict[str, Any]:
    """A moving obstacle."""
    points = [[x_mm, 0.0], [x_mm + 500.0, 0.0]]
    return {"moving": [{"shape": DISC, "points_mm": points, "speed_mm_s": 300.0}]}


CASES: dict[str, dict[str, Any]] = {
    "nothing": {},
    "20 walls, 20 m away": walls(20, FAR_MM),
    "a box at rest, 20 m away": boxes(FAR_MM, 0.0),
    "a moving obstacle, 20 m away": persons(FAR_MM),
    "a wall 5 mm beside the outlines": walls(1, NEAR_X_MM),
    "the leader pushes a box": boxes(0.0, 200.0),
}


def driver(world: dict[str, Any]) -> FormationParallelEnv:
    """The environment of a case."""
    return tlf_env.parallel_env(
        robots=ROBOTS, world=world, disturbance="none", end_on=(), infos=False
    )


def timed(env: FormationParallelEnv) -> float:
    """CPU time of a control step in an episode, µs."""
    env.reset(seed=0, options={"poses": [[0.0, -400.0 * i, 0.0] for i in range(ROBOTS)]})
    ahead = dict.fromkeys(env.agents, np.array([0.1, 0.0]))
    for _ in range(50):
        env.step(ahead)
    begin = time.process_time()
    for _ in range(STEPS):
        env.step(ahead)
    return (time.process_time() - begin) / STEPS * 1e6


def table() -> str:
    """The medians of all cases in Markdown."""
    envs = {name: driver(world) for name, world in CASES.items()}
    times: dict[str, list[float]] = {name: [] for name in CASES}
    for _ in range(ROUNDS):
        for name, env in envs.items():
            times[name].append(timed(env))
    head = "| world | µs per control step | ratio |\n|---|---:|---:|\n"
    rows = []
    for name, found in times.items():
        ratios = [one / first for one, first in zip(found, times["nothing"], strict=True)]
        rows.append(
            f"| {name} | {statistics.median(found):.0f} | {statistics.median(ratios):.2f} |"
        )
    return head + "\n".join(rows) + "\n"


if __name__ == "__main__":
    text = PAGE.read_text(encoding="utf-8")
    made = table()
    print(made)
    text = re.sub(f"({BEGIN}).*?({END})", lambda at: at[1] + made + at[2], text, flags=re.DOTALL)
    PAGE.write_text(text, encoding="utf-8")
