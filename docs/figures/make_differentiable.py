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
from differentiable_training import Formations, driven_on, learner, step_of, train
from make_algorithms import Entry
from make_board import DOCS
from make_figures import BLUE
from make_parts import put
from make_speed import table
from torch import Tensor
from training_courses import courses_of, draw_courses

from baselines.policies.card import read_policy
from baselines.policies.learned import load_policy
from baselines.policies.registry import fit_policy
from baselines.runs.outcome import failed
from baselines.runs.run import PolicyDriver, run_seeds, seed_blocks
from baselines.runs.seed_ranges import CHOOSING_SEEDS, FIRST_TABLE_SEED
from tlf_env.common.files import atomic
from tlf_env.engine import readout
from tlf_env.engine.batch import BatchPlant
from tlf_env.physics.units import MILLINEWTON_PER_NEWTON
from tlf_env.task.observation import tracking_entries
from tlf_env.task.scenario import SETTLE_FRACTION, load_scenario

PAGE, RESULTS = DOCS / "learning.md", DOCS / "learning" / "differentiable.json"
PICTURE = RESULTS.with_suffix(".png")
TRAINED = Path("results/differentiable")
CHECK_S, CHECK_RUNS = 40.0, 4
HORIZON_S = 60.0
CELLS = (
    *(("infinity", name) for name in ("nominal", "slip", "start", "ice", "combined-hard")),
    ("flower", "nominal"),
)
RIVALS = {"reference:linearised": ("", ""), "from-nothing": ("at most 1480", "7.5 M")}


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


def in_the_model(file: Path) -> float:
    """Position RMS of the worst robot, mm, that the model predicts for the nominal ∞, over the settled part."""
    torch.manual_seed(0)
    scenario = load_scenario(learner(), horizon_s=HORIZON_S)
    model, policy = Model(scenario), load_policy(file)
    formations = Formations(model, [scenario], 1)
    formations.begin(torch.arange(1), plain=True)
    formations.nature = usual((1, scenario.robot_count))

    def act(row: Tensor) -> Tensor:
        action, _ = policy.predict(row[0].numpy(), deterministic=True)
        return torch.from_numpy(action)[None]

    step, errors = step_of(model, act, formations.roles), []
    with torch.no_grad():
        for _ in range(scenario.horizon_steps):
            driven_on(formations, step)
            errors.append(formations.away()[0])
    settled = torch.stack(errors)[round(SETTLE_FRACTION * len(errors)) :]
    return float(settled.square().mean(dim=0).sqrt().max())


def judge(trained: Path, runs: int) -> list[dict[str, Any]]:
    """For every trained policy: position RMS of the worst robot (mm) and failures of every run, and more."""
    rows = []
    for file in sorted(trained.glob("seed_*/policy.safetensors")):
        cells = []
        for task, disturbance in CELLS:
            scenario = load_scenario(task, disturbance=disturbance, horizon_s=HORIZON_S)
            policy, fitted = fit_policy(str(file), scenario)[:2]
            robots = [
                record.metrics()
                for block in seed_blocks(range(FIRST_TABLE_SEED, FIRST_TABLE_SEED + runs))
                for record in run_seeds(fitted, policy, block)
            ]
            rms = [round(max(one.position_rmse_mm for one in each), 3) for each in robots]
            cells.append({"rms_mm": rms, "failed": [bool(failed(each)) for each in robots]})
            print(file.parent.name, task, disturbance, np.median(rms), flush=True)
        took_s = read_policy(file).card.training["core_s"]
        row = {"seed": file.parent.name, "model_mm": round(in_the_model(file), 3)}
        rows.append(row | {"core_s": took_s, "cells": cells})
    return rows


def judged_table(rows: list[dict[str, Any]]) -> str:
    """A row for each policy: medians over all runs, failed runs in brackets, as the board has them."""
    board = json.loads((DOCS / "leaderboard" / "leaderboard.json").read_text("utf-8"))["cells"]
    out = []
    for name, cost in RIVALS.items():
        cells = {(one["task"], one["disturbance"]): one for one in board if one["policy"] == name}
        found = [
            shown_cell(one["position_rmse_mm"]["median"], one["runs"] - one["success"]["count"])
            for one in map(cells.__getitem__, CELLS)
        ]
        out.append([f"`{name}`", *found, "", *cost])
    for row in rows:
        found = [
            shown_cell(float(np.median(one["rms_mm"])), sum(one["failed"])) for one in row["cells"]
        ]
        costs = [f"{row['core_s']:.0f}", "0"]
        out.append([row["seed"].replace("_", " "), *found, f"{row['model_mm']:.2f}", *costs])
    heads = [("∞, " if task == "infinity" else "flower, ") + f"`{name}`" for task, name in CELLS]
    more = ["∞, `nominal`, in the model", "s of a core", "steps of the plant"]
    return table(["policy", *heads, *more], out)


def shown_cell(median_mm: float, lost: int) -> str:
    """A cell of the table."""
    return f"{median_mm:.2f} ({lost})" if lost else f"{median_mm:.2f}"


def main() -> None:
    """Make what is asked for, and write the tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("what", nargs="?", choices=("check", "train", "judge", "courses"))
    parser.add_argument("--seeds", default="0,1,2", help="of the trainings")
    parser.add_argument("--runs", type=int, default=100, help="of each cell")
    parser.add_argument("--trained", type=Path, default=TRAINED)
    given = parser.parse_args()
    torch.set_num_threads(1)
    kept = json.loads(RESULTS.read_text("utf-8")) if RESULTS.exists() else {}
    match given.what:
        case "train":
            for seed in given.seeds.split(","):
                train(int(seed), given.trained / f"seed_{int(seed)}")
            return
        case "check":
            kept["check"] = check()
        case "judge":
            kept["judged"] = judge(given.trained, given.runs)
        case "courses":
            kept["courses"] = courses_of(given.trained, "model")
    with atomic(RESULTS, encoding="utf-8") as file:
        json.dump(kept, file, separators=(",", ":"))
        file.write("\n")
    if "check" in kept:
        put(PAGE, checked_table(kept["check"]), "differentiable-check")
    if "judged" in kept:
        put(PAGE, judged_table(kept["judged"]), "differentiable")
    if "courses" in kept:
        draw_courses(
            kept["courses"],
            [Entry("model", "through the model", BLUE)],
            PICTURE,
            along="windows",
            values="mean reward in the model",
        )


if __name__ == "__main__":
    main()
