"""A policy trained by gradients through a differentiable model of the robots, and judged on the real plant.

Writes ``docs/learning/differentiable.json`` and the tables of the section *A differentiable model* of
``docs/learning.md``. It needs the extra ``train``. ``python docs/figures/make_differentiable.py`` makes the
tables from the file. Before that:

``check`` compares the model's open-loop prediction with the plant, along runs of the default system.

``train`` trains with some seeds by backpropagation through the model. It compiles one function, which needs a
compiler of C++.

``judge`` runs what was trained on seeds that nothing was tuned on.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from differentiable_model import Model, State, driven, usual
from differentiable_training import train
from make_board import DOCS
from make_parts import put
from make_speed import table
from torch import Tensor

from baselines.policies.card import read_policy
from baselines.policies.registry import fit_policy
from baselines.runs.outcome import failed
from baselines.runs.run import PolicyDriver, run_seeds, seed_blocks
from baselines.runs.seed_ranges import CHOOSING_SEEDS, FIRST_TABLE_SEED
from tlf_env.common.files import atomic
from tlf_env.engine import readout
from tlf_env.engine.batch import BatchPlant
from tlf_env.physics.units import MILLINEWTON_PER_NEWTON
from tlf_env.task.observation import tracking_entries
from tlf_env.task.scenario import load_scenario

PAGE, RESULTS = DOCS / "learning.md", DOCS / "learning" / "differentiable.json"
TRAINED = Path("results/differentiable")
CHECK_S, CHECK_RUNS = 40.0, 4
HORIZON_S, RUNS = 60.0, 50
CELLS = (
    *(("infinity", name) for name in ("nominal", "slip", "start", "ice", "combined-hard")),
    ("flower", "nominal"),
)
RIVALS = {"reference:linearised": ("", ""), "from-nothing": ("at most 1480", "7.5 M")}
ARMS = {"model": ("through the model", "0")}


class Run(NamedTuple):
    """Some runs of the default system, in time: what the model needs to go on from any moment."""

    state: State  # each field (time, formation, robot, ...)
    torque: Tensor  # of the wheels, mean over the last step


def recorded(model: Model) -> Run:
    """The default system on the plant, on choosing seeds."""
    scenario = load_scenario("infinity", disturbance="nominal", horizon_s=CHECK_S)
    policy, scenario = fit_policy("reference:linearised", scenario)[:2]
    plant = BatchPlant(scenario.model_copy(update={"end_on": ()}), CHECK_RUNS)
    plant.reset(CHOOSING_SEEDS[0])
    driver = PolicyDriver(policy, scenario, plant.arrays, "reference:linearised")
    entries = tracking_entries(scenario.preview_s)
    names = ("command_u_1", "command_u_2", "odometry_u_1", "odometry_u_2")
    places = [list(entries).index(name) for name in names]
    scales = np.array([entries[name].scale for name in names])
    columns: list[list[np.ndarray]] = []
    for step in range(scenario.horizon_steps + 1):
        if step:
            plant.step(driver.act())
        info, now = readout.info(plant.arrays), readout.state(plant.arrays)
        loop = readout.named(plant.arrays, "loop_state")
        integral = np.stack([loop.integral_l, loop.integral_r], axis=-1)
        lag = np.stack([loop.lag_l, loop.lag_r], axis=-1)
        twists = plant.observations[..., places] * scales
        columns.append(
            [
                np.stack([info.x_mm, info.y_mm, info.theta_rad], axis=-1),
                np.stack([now.omega_l_rad_s, now.omega_r_rad_s], axis=-1),
                np.stack([integral, lag], axis=-1),
                twists[..., :2],
                twists[..., :2],  # the actions play no part
                twists[..., 2:],
                np.zeros_like(info.x_mm),
                np.stack([info.torque_l_Nmm, info.torque_r_Nmm], -1) * MILLINEWTON_PER_NEWTON,
            ]
        )
    *fields, torque = (
        torch.tensor(np.stack(one), dtype=torch.float32) for one in zip(*columns, strict=True)
    )
    run, nominal = State(*fields), usual(fields[-1].shape[1:])
    for step in range(1, len(torque)):
        before = State(*(field[step - 1] for field in run))
        run.castor[step] = model.friction(before, nominal, run.command[step])[1]
    return Run(run, torque)


def check() -> list[dict[str, Any]]:
    """Errors of open-loop predictions from every moment of the runs, and of wheels that follow at once."""
    model = Model(load_scenario("infinity", action="tracking_twist"))
    run = recorded(model)
    state, torque = run
    steady = (state.command[1:, ..., 0] > 100.0)[..., None]
    inertia = torch.linalg.inv(model.mobility)
    rest = torque[1:] - (state.wheels[1:] - state.wheels[:-1]) / model.period @ inertia
    both = torch.masked_select(rest.mean(-1, keepdim=True), steady).median()
    apart = torch.masked_select(rest.diff(dim=-1).abs() / 2, steady).median()
    print(f"torques of friction: axles {float(both):.0f}, castor {float(apart):.0f} mN·mm")
    steps = round(1.0 / model.period)
    moments = len(torque) - steps
    now = State(*(field[:moments] for field in state))
    nominal, at_once, rows = usual(now.castor.shape), now.pose, []
    for step in range(1, steps + 1):
        command = state.command[step : step + moments]
        now = model.moved(now, nominal, now.action, command)
        at_once = driven(at_once, command, model.period)
        if step not in (1, steps):
            continue
        true = state.pose[step : step + moments]
        for name, pose in (("the model", now.pose), ("wheels that follow at once", at_once)):
            away = torch.linalg.vector_norm((pose - true)[..., :2], dim=-1)
            for what, off in (
                ("position, mm", away),
                ("heading, rad", (pose - true)[..., 2].abs()),
            ):
                shares = torch.tensor([0.5, 0.95, 1.0])
                found = [
                    float(f"{q:.2g}")
                    for q in off.flatten()[:: max(1, off.numel() // 10**6)].quantile(shares)
                ]
                rows.append(
                    {"of": name, "after_s": step * model.period, "what": what, "errors": found}
                )
    return rows


def checked_table(rows: list[dict[str, Any]]) -> str:
    """A row for each prediction: median, 95 % and largest error."""
    out = [
        [f"{row['after_s']:g} s", row["what"], row["of"], *(f"{one:g}" for one in row["errors"])]
        for row in rows
    ]
    return table(["after", "error of", "prediction", "median", "95 %", "largest"], out, names=3)


def judge(trained: Path) -> list[dict[str, Any]]:
    """Position RMS of the worst robot, mm, and failures, of every run of every trained policy."""
    rows = []
    for arm in ARMS:
        for file in sorted((trained / arm).glob("seed_*/policy.safetensors")):
            for task, disturbance in CELLS:
                scenario = load_scenario(task, disturbance=disturbance, horizon_s=HORIZON_S)
                policy, fitted = fit_policy(str(file), scenario)[:2]
                blocks = seed_blocks(range(FIRST_TABLE_SEED, FIRST_TABLE_SEED + RUNS))
                robots = [
                    record.metrics()
                    for block in blocks
                    for record in run_seeds(fitted, policy, block)
                ]
                rms = [max(one.position_rmse_mm for one in each) for each in robots]
                row = {
                    "arm": arm,
                    "seed": file.parent.name,
                    "task": task,
                    "disturbance": disturbance,
                }
                row |= {
                    "rms_mm": [round(one, 3) for one in rms],
                    "failed": [failed(each) for each in robots],
                }
                rows.append(row)
                print(
                    arm,
                    file.parent.name,
                    task,
                    disturbance,
                    np.median(rms),
                    sum(row["failed"]),
                    flush=True,
                )
    return rows


def judged_table(judged: list[dict[str, Any]], cost_s: dict[str, float]) -> str:
    """A row for each policy: medians over all runs, failed runs in brackets, as the board has them."""
    board = json.loads((DOCS / "leaderboard" / "leaderboard.json").read_text("utf-8"))["cells"]
    out = []
    for name in RIVALS:
        cells = {(one["task"], one["disturbance"]): one for one in board if one["policy"] == name}
        mine = [cells[cell] for cell in CELLS]
        shown = [
            shown_cell(one["position_rmse_mm"]["median"], one["runs"] - one["success"]["count"])
            for one in mine
        ]
        out.append([f"`{name}`", *shown, *RIVALS[name]])
    for arm in ARMS:
        for seed in sorted({row["seed"] for row in judged if row["arm"] == arm}):
            mine = [row for row in judged if (row["arm"], row["seed"]) == (arm, seed)]
            cells = {(row["task"], row["disturbance"]): row for row in mine}
            shown = [
                shown_cell(float(np.median(cells[one]["rms_mm"])), sum(cells[one]["failed"]))
                for one in CELLS
            ]
            name = f"{ARMS[arm][0]}, {seed.replace('_', ' ')}"
            out.append([name, *shown, f"{cost_s[f'{arm}/{seed}']:.0f}", ARMS[arm][1]])
    heads = [("∞, " if task == "infinity" else "flower, ") + f"`{name}`" for task, name in CELLS]
    return table(["policy", *heads, "s of a core", "steps of the plant"], out)


def shown_cell(median_mm: float, lost: int) -> str:
    """A cell of the table."""
    return f"{median_mm:.2f} ({lost})" if lost else f"{median_mm:.2f}"


def main() -> None:
    """Make what is asked for, and write the tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("what", nargs="?", choices=("check", "train", "judge"))
    parser.add_argument("--seeds", default="0,1,2", help="of the trainings")
    parser.add_argument("--trained", type=Path, default=TRAINED)
    given = parser.parse_args()
    torch.set_num_threads(1)
    kept = json.loads(RESULTS.read_text("utf-8")) if RESULTS.exists() else {}
    match given.what:
        case "train":
            for seed in given.seeds.split(","):
                train(int(seed), given.trained / "model" / f"seed_{int(seed)}")
            return
        case "check":
            kept["check"] = check()
        case "judge":
            kept["judged"] = judge(given.trained)
            kept["core_s"] = {
                f"{file.parents[1].name}/{file.parent.name}": read_policy(file).card.training[
                    "core_s"
                ]
                for file in sorted(given.trained.glob("*/seed_*/policy.safetensors"))
            }
    with atomic(RESULTS, encoding="utf-8") as file:
        json.dump(kept, file, separators=(",", ":"))
        file.write("\n")
    if "check" in kept:
        put(PAGE, checked_table(kept["check"]), "differentiable-check")
    if "judged" in kept:
        put(PAGE, judged_table(kept["judged"], kept["core_s"]), "differentiable")


if __name__ == "__main__":
    main()
