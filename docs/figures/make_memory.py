"""What a history is worth to a learned policy, and what it would be worth to be given what is true.

Writes ``docs/learning/memory.json`` and the tables of the section *Memory* of ``docs/learning.md``. It needs
the extra ``train``. ``python docs/figures/make_memory.py`` makes the tables from the file. Before that:

``probe`` drives the default system with drawn friction, payload and wheel errors, and fits networks that
estimate these from the present observation and from histories.

``train ARM`` trains the preset ``history`` with some seeds and no evaluation: as it is (``history``), without
its history (``plain``), or without it and with the drawn numbers as further entries, which no robot can know
(``truth``).

``judge`` runs what was trained on seeds that nothing was tuned on, and ``courses`` keeps the courses of the
trainings.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import gymnasium
import numpy as np
import torch
from make_algorithms import MILLION, Entry
from make_board import DOCS
from make_figures import BLUE, GREY, ORANGE
from make_parts import put
from make_speed import table
from stable_baselines3 import PPO
from training_courses import Course, courses_of, draw_courses

from baselines.data.episodes import entry_names
from baselines.policies.history import History, Past
from baselines.policies.registry import fit_policy
from baselines.runs.outcome import failed
from baselines.runs.run import PolicyDriver, run_seeds
from baselines.runs.seed_ranges import FIRST_TABLE_SEED
from baselines.sb3 import FormationVecEnv
from baselines.training.config import TrainConfig, level_of, load_config
from baselines.training.export import export_policy
from baselines.training.model import (
    make_envs,
    make_model,
    rollout_steps,
    set_learning_rate,
    spread_out,
)
from tlf_env.common.files import atomic
from tlf_env.disturbances.channels import number
from tlf_env.engine.batch import BatchPlant
from tlf_env.onboard.parts import Policy
from tlf_env.task.scenario import Scenario, load_scenario

PAGE, RESULTS = DOCS / "learning.md", DOCS / "learning" / "memory.json"
TRAINED = Path("results/memory")
PICTURE = RESULTS.with_suffix(".png")
ARMS = ("plain", "history", "truth")
LINES = (
    Entry("plain", "without", GREY, "-"),
    Entry("history", "history", BLUE, "--"),
    Entry("truth", "truth", ORANGE, "-."),
)
POLICY_FILE, MODEL_FILE = "policy.safetensors", "policy.zip"  # the latter of the arm `truth`
HORIZON_S = 60.0
CELLS = (
    "nominal",
    "start",
    "slip",
    "slip-noise",
    "combined-hard",
    "calibration",
    "payload",
    "ice",
    "ice@1.3",
    "split-ice",
    "split-ice-right",
    "patches",
)
RESAMPLES = 4000

# What is true of a robot during a whole episode: channels, nominal values and what is scaled to 1.
TRUTH = (
    ("tyre.friction_left", 1.0, 0.3),
    ("tyre.friction_right", 1.0, 0.3),
    ("payload.mass_kg", 0.0, 0.15),
    ("payload.behind_mm", 0.0, 40.0),
    ("calibration.radius_left", 1.0, 0.007),
    ("calibration.radius_right", 1.0, 0.007),
    ("calibration.track", 1.0, 0.02),
)
EVERYWHERE = "tyre.friction_scale"  # counts on both sides


def applied(plant: BatchPlant, path: str) -> np.ndarray:
    """A channel's values, a row for each robot of each formation."""
    values: np.ndarray = plant.arrays.applied[number(path), :, : plant.formations].T.ravel()
    return values


def truth(plant: BatchPlant) -> np.ndarray:
    """Entries of what is true, ``(row, entry)``."""
    columns = []
    for path, nominal, scale in TRUTH:
        values = applied(plant, path)
        if path.startswith("tyre"):
            values = values * applied(plant, EVERYWHERE)
        columns.append((values - nominal) / scale)
    return np.stack(columns, axis=1).astype(np.float32)


class TruthVecEnv(FormationVecEnv):
    """Formations whose observations end with :func:`truth`."""

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        box = self.observation_space
        size = box.shape[0] + len(TRUTH)
        self.observation_space = gymnasium.spaces.Box(box.low[0], box.high[0], (size,), box.dtype)

    def observations(self) -> np.ndarray:
        """As its base, and what is true."""
        known = np.concatenate([truth(plant) for plant in self.plants])
        return np.concatenate([super().observations(), known], axis=1)


class Informed:
    """A model that is given what is true in the runs of some seeds; it stays the same during a run."""

    def __init__(self, model: Any, scenario: Scenario, seeds: Sequence[int]) -> None:
        plant = BatchPlant(scenario, len(seeds))
        plant.reset(list(seeds))
        self._model, self._truth = model, truth(plant)

    def predict(
        self,
        observation: np.ndarray,
        state: Any = None,
        episode_start: np.ndarray | None = None,
        deterministic: bool = True,
    ) -> tuple[np.ndarray, Any]:
        """As SB3's ``predict``, for the rows of all runs."""
        rows = np.concatenate([observation, self._truth], axis=1)
        actions, _ = self._model.predict(rows, deterministic=deterministic)
        return actions, state


def config_of(arm: str) -> TrainConfig:
    """The training of an arm."""
    config = load_config("history")
    if arm == "history":
        return config
    network = config.network.model_copy(update={"history": None})
    return config.model_copy(update={"network": network})


def train_arm(arm: str, seeds: Sequence[int], trained: Path) -> None:
    """Train an arm with some seeds, one after another, and keep the last policy of each."""
    torch.set_num_threads(1)
    config = config_of(arm)
    tasks, shares = config.mixture()
    scenario = next(iter(tasks.values()))[0]
    for seed in seeds:
        folder = trained / arm / f"seed_{seed}"
        folder.mkdir(parents=True, exist_ok=True)
        envs = (
            TruthVecEnv(tasks, config.formations, mixture=shares, infos=False)
            if arm == "truth"
            else make_envs(config, 1)
        )
        model = make_model(config, envs, seed)
        spread_out(model, envs, config.seeds[0])
        course = Course()
        while model.num_timesteps < config.robot_steps:
            set_learning_rate(model, config)
            model.learn(rollout_steps(model), reset_num_timesteps=False, log_interval=None)
            course.note(model.num_timesteps, float(model.rollout_buffer.rewards.mean()))
        course.keep(folder)
        if arm == "truth":
            model.save(folder / MODEL_FILE)
        else:
            about = {"training": {"arm": arm}, "seeds": {"learner": [seed]}}
            export_policy(model, folder / POLICY_FILE, scenario, **about)


def judge(trained: Path, runs: int) -> list[dict[str, Any]]:
    """Position RMS of the worst robot, mm, and failures, of every run of every trained policy."""
    seeds, rows = range(FIRST_TABLE_SEED, FIRST_TABLE_SEED + runs), []
    learner = load_config("history").evaluation_scenarios()["infinity", "nominal"]
    for cell in CELLS:
        print(cell, flush=True)
        disturbance, level = level_of(cell)
        scenario = load_scenario(
            "infinity", disturbance=disturbance, disturbance_level=level, horizon_s=HORIZON_S
        )
        for arm in ARMS:
            for folder in sorted((trained / arm).glob("seed_*")):
                policy, fitted = of_folder(folder, arm, scenario, learner, seeds)
                records = [record.metrics() for record in run_seeds(fitted, policy, seeds)]
                rows.append(
                    {
                        "cell": cell,
                        "arm": arm,
                        "seed": folder.name,
                        "rms_mm": [
                            round(max(one.position_rmse_mm for one in robots), 4)
                            for robots in records
                        ],
                        "failed": [bool(failed(robots)) for robots in records],
                    }
                )
    return rows


def of_folder(
    folder: Path, arm: str, scenario: Scenario, learner: Scenario, seeds: Sequence[int]
) -> tuple[Policy, Scenario]:
    """The policy that was trained in a folder, and the scenario with what it needs."""
    if arm != "truth":
        fitted = fit_policy(str(folder / POLICY_FILE), scenario)
        return fitted.policy, fitted.scenario
    needed = learner.model_copy(
        update={"disturbance": scenario.disturbance, "horizon_s": scenario.horizon_s}
    )
    model = PPO.load(folder / MODEL_FILE, device="cpu")
    return Informed(model, needed, seeds), needed


class Difference(NamedTuple):
    """An arm against the one without memory, in one cell: mm, over the runs that both hold."""

    median: float
    low: float  # 95 % interval
    high: float


def held_mm(rows: list[dict[str, Any]], cell: str, arm: str) -> np.ndarray:
    """Position RMS, (training seed, run), NaN where the run failed."""
    mine = [row for row in rows if (row["cell"], row["arm"]) == (cell, arm)]
    rms, lost = (np.array([row[name] for row in mine]) for name in ("rms_mm", "failed"))
    return np.where(lost, np.nan, rms)


def difference(arm: np.ndarray, plain: np.ndarray) -> Difference:
    """Median over the runs and all pairs of training seeds; resampled over runs and training seeds."""
    generator = np.random.default_rng(0)

    def median(mine: np.ndarray, theirs: np.ndarray, runs: np.ndarray) -> float:
        apart = arm[mine][:, np.newaxis][:, :, runs] - plain[theirs][np.newaxis][:, :, runs]
        both = apart[np.isfinite(apart)]
        return float(np.median(both)) if len(both) else np.nan

    sizes = (len(arm), len(plain), arm.shape[1])
    drawn = [
        median(*(generator.integers(size, size=size) for size in sizes)) for _ in range(RESAMPLES)
    ]
    low, high = np.nanpercentile(drawn, [2.5, 97.5])
    return Difference(median(*map(np.arange, sizes)), float(low), float(high))


def judged_table(rows: list[dict[str, Any]]) -> str:
    """A row for each disturbance: medians and failed runs of every arm, and differences to the first."""
    out = []
    for cell in CELLS:
        held = {arm: held_mm(rows, cell, arm) for arm in ARMS}
        line = [f"`{cell}`"]
        for arm in ARMS:
            lost = int(np.isnan(held[arm]).sum())
            shown = f"{np.nanmedian(held[arm]):.2f}"
            line.append(f"{shown} ({lost})" if lost else shown)
        for arm in ARMS[1:]:
            found = difference(held[arm], held["plain"])
            shown = f"{found.median:+.2f} [{found.low:+.2f}, {found.high:+.2f}]"
            line.append(shown.replace("-", "−"))
        out.append(line)
    head = ["∞", "without", "history", "truth", "history − without", "truth − without"]
    return table(head, out)


# The probe: what can be estimated of what is true.
PROBED = {
    "friction of all tyres": EVERYWHERE,
    "mass of the payload": "payload.mass_kg",
    "its distance behind the axle": "payload.behind_mm",
    "radius of the left wheel": "calibration.radius_left",
    "width of the axle": "calibration.track",
}
DRAWN = {
    "tyre": {"friction_scale": {"type": "uniform", "low": 0.4, "high": 1.0}},
    "payload": {
        "mass_kg": {"type": "uniform", "low": 0.0, "high": 0.18},
        "behind_mm": {"type": "uniform", "low": 0.0, "high": 40.0},
    },
    "calibration": {
        "radius_left": {"type": "uniform", "low": 0.993, "high": 1.007},
        "radius_right": {"type": "uniform", "low": 0.993, "high": 1.007},
        "track": {"type": "uniform", "low": 0.98, "high": 1.02},
    },
}
DRIVER = "reference:linearised"
PROBE_S, PROBE_EVERY = 30.0, 25  # of a run; control steps between two rows
EARLY_S, LATE_S = 6.0, 10.0  # the first rows, and the others
PROBE_RUNS = {0: 160, FIRST_TABLE_SEED: 60}  # first seed: runs, to fit and to judge
MEANS = {
    "the present observation": (0, 1),
    "and 8 observations": (8, 1),
    "and 8 means of 0.1 s": (8, 5),
    "and 8 means of 0.5 s": (8, 25),
    "and 8 means of 1 s": (8, 50),
}
EPOCHS, BATCH = 25, 1024


class Probed(NamedTuple):
    """Rows of some runs: times, what a network sees with each history, and what is true."""

    time_s: np.ndarray
    seen: dict[str, np.ndarray]
    true: np.ndarray


def drive(first_seed: int, runs: int, histories: dict[str, History]) -> Probed:
    """Runs of the default system, a row for each robot every half second."""
    scenario = load_scenario("infinity", disturbance=DRAWN, horizon_s=PROBE_S)
    policy, scenario = fit_policy(DRIVER, scenario)[:2]
    plant = BatchPlant(scenario.model_copy(update={"end_on": ()}), runs)
    plant.reset(first_seed)
    driver = PolicyDriver(policy, scenario, plant.arrays, DRIVER)
    pasts = {name: Past(one, entry_names(scenario)) for name, one in histories.items()}
    rows = runs * scenario.robot_count
    memories = {name: past.memory(None, rows) for name, past in pasts.items()}
    time_s: list[np.ndarray] = []
    seen: dict[str, list[np.ndarray]] = {name: [] for name in pasts}
    for step in range(scenario.horizon_steps):
        present = plant.observations.reshape(rows, -1)
        for name, past in pasts.items():
            if step % PROBE_EVERY == 0 and step:
                seen[name].append(past.joined(present, memories[name]))
            memories[name] = past.after(memories[name], present)
        if step % PROBE_EVERY == 0 and step:
            time_s.append(np.full(rows, step * scenario.control_period_s))
        plant.step(driver.act())
    true = np.stack([applied(plant, path) for path in PROBED.values()], axis=1)
    return Probed(
        np.concatenate(time_s),
        {name: np.concatenate(one) for name, one in seen.items()},
        np.tile(true, (len(time_s), 1)),
    )


def explained(seen: np.ndarray, true: np.ndarray, judged: np.ndarray, wanted: np.ndarray) -> Any:
    """Share of the variance of ``wanted`` that a network explains from ``judged``, fitted to other rows."""
    torch.manual_seed(0)
    mean, spread = seen.mean(axis=0), seen.std(axis=0) + 1e-6
    centre, scale = true.mean(axis=0), true.std(axis=0)
    x, judged_x = (
        torch.from_numpy(np.clip((one - mean) / spread, -10, 10)) for one in (seen, judged)
    )
    y = torch.from_numpy(((true - centre) / scale).astype(np.float32))
    layers = [torch.nn.Linear(x.shape[1], 64), torch.nn.Tanh(), torch.nn.Linear(64, 64)]
    network = torch.nn.Sequential(*layers, torch.nn.Tanh(), torch.nn.Linear(64, y.shape[1]))
    optimizer = torch.optim.Adam(network.parameters(), lr=2e-3, weight_decay=1e-5)
    batches = EPOCHS * -(-len(x) // BATCH)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, batches)
    for _ in range(EPOCHS):
        for rows in torch.randperm(len(x)).split(BATCH):
            loss = torch.square(network(x[rows]) - y[rows]).mean()
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
            schedule.step()
    with torch.no_grad():
        found = network(judged_x).numpy() * scale + centre
    return 1.0 - np.square(wanted - found).mean(axis=0) / wanted.var(axis=0)


def probe() -> list[dict[str, Any]]:
    """Share of the variance that is explained of each of :data:`PROBED`, early and later, with each history."""
    torch.set_num_threads(1)
    kept = load_config("history").network.history
    assert kept is not None
    histories = {
        name: History(observations=count, mean_of=steps, entries=kept.entries)
        for name, (count, steps) in MEANS.items()
    }
    fitted, judged = (drive(first, runs, histories) for first, runs in PROBE_RUNS.items())
    rows = []
    for name in histories:
        for when, first_s, end_s in (
            ("first 6 s", 0.0, EARLY_S),
            ("from 10 s on", LATE_S, PROBE_S),
        ):
            mine, theirs = (
                (one.time_s >= first_s) & (one.time_s < end_s) for one in (fitted, judged)
            )
            shares = explained(
                fitted.seen[name][mine],
                fitted.true[mine],
                judged.seen[name][theirs],
                judged.true[theirs],
            )
            rows.append({"seen": name, "when": when, "explained": shares.round(3).tolist()})
    return rows


def probed_table(rows: list[dict[str, Any]]) -> str:
    """A row for each history and time, a column for each of :data:`PROBED`."""
    out = [
        [row["seen"], row["when"], *(f"{max(share, 0.0):.2f}" for share in row["explained"])]
        for row in rows
    ]
    return table(["what is seen", "when", *PROBED], out, names=2)


def main() -> None:
    """Make what is asked for, and write the tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument(
        "what", nargs="*", help="probe; train ARM; judge; courses; nothing: tables and figure"
    )
    parser.add_argument("--seeds", default="0,1,2", help="of the trainings")
    parser.add_argument("--runs", type=int, default=30, help="of each cell")
    parser.add_argument("--trained", type=Path, default=TRAINED)
    given = parser.parse_args()
    kept = json.loads(RESULTS.read_text("utf-8")) if RESULTS.exists() else {}
    match given.what:
        case ["train", arm] if arm in ARMS:
            train_arm(arm, [int(seed) for seed in given.seeds.split(",")], given.trained)
            return
        case ["probe"]:
            kept["probe"] = probe()
        case ["judge"]:
            kept["judged"] = judge(given.trained, given.runs)
        case ["courses"]:
            kept["courses"] = [one for arm in ARMS for one in courses_of(given.trained / arm, arm)]
        case []:
            pass
        case _:
            parser.error(f"{' '.join(given.what)!r} is none of probe, train ARM, judge, courses")
    with atomic(RESULTS, encoding="utf-8") as file:
        json.dump(kept, file, separators=(",", ":"))
        file.write("\n")
    if "probe" in kept:
        put(PAGE, probed_table(kept["probe"]), "probe")
    if "judged" in kept:
        put(PAGE, judged_table(kept["judged"]), "memory")
    if "courses" in kept:
        draw_courses(
            kept["courses"],
            LINES,
            PICTURE,
            along="robot steps, millions",
            values="mean reward of a rollout",
            scale=MILLION,
        )


if __name__ == "__main__":
    main()
