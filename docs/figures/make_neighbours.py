"""What knowing its predecessor is worth to a robot of a row, and what messages along the row could be worth.

Writes ``docs/learning/neighbours.json``, the tables of the section *Neighbours and messages* of
``docs/learning.md``, and ``docs/learning/neighbours.png``. It needs the extra ``train``.
``python docs/figures/make_neighbours.py`` makes tables and figure from the file. Before that:

``train ARM`` trains an arm of ``neighbours_arms.py`` with some seeds and no evaluation; ``train learned``
searches the weights of a message with Optuna, which needs the extra ``tune``.

``probe`` fits networks that estimate a follower's error half a second later from what it sees in an arm.

``judge`` runs what was trained on seeds that nothing was tuned on; with ``--only ARM`` one arm alone.
``courses`` keeps the courses of the trainings without judging them again.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from generalisation_kick import SLIPPING, displacements_mm, row_scenario
from generalisation_runs import along_row
from make_algorithms import MILLION, Entry
from make_board import DOCS
from make_figures import BLUE, GREY, ORANGE
from make_memory import difference, explained
from make_parts import put
from make_speed import table
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FormatStrFormatter, LogLocator, MaxNLocator, NullLocator
from neighbours_arms import (
    ARMS,
    CORRECTED_ERROR,
    OWN_ERROR,
    Arm,
    CorrectingPolicy,
    RowPolicy,
    RowVecEnv,
    Sight,
    Weights,
    leaders_of,
)
from stable_baselines3 import PPO
from training_courses import Course, courses_of, draw_courses

from baselines.data.episodes import entry_names
from baselines.policies.registry import fit_policy
from baselines.runs.outcome import failed
from baselines.runs.run import PolicyDriver, run_seeds
from baselines.runs.seed_ranges import FIRST_TABLE_SEED
from baselines.runs.style import MARKERS, METADATA, hex_colour, tidy
from baselines.training.config import TrainConfig, load_config
from baselines.training.model import make_model, rollout_steps, set_learning_rate, spread_out
from tlf_env.common.files import atomic
from tlf_env.engine.batch import BatchPlant
from tlf_env.onboard.parts import Policy
from tlf_env.task.scenario import Scenario, load_scenario

PAGE, RESULTS = DOCS / "learning.md", DOCS / "learning" / "neighbours.json"
PICTURE, COURSES = RESULTS.with_suffix(".png"), RESULTS.with_name("neighbours-courses.png")
COURSES_DRAWN = (
    Entry("own", "own", GREY, "-"),
    Entry("heard", "heard", BLUE, "--"),
    Entry("shared", "shared", ORANGE, "-."),
)
TRAINED = Path("results/neighbours")
MODEL_FILE = "policy.zip"
ROW = 5  # robots of a training; with six or more, robots of the ∞ meet at its crossing
FAR = {"range_mm": 5000.0}  # the largest range: a neighbour is always heard
ROBOT_STEPS, FORMATIONS = 1_000_000, 32
DISTURBANCES = {
    "nominal": 1,
    "slip": 2,
    "slip-noise": 2,
    "start": 1,
    "combined-hard": 2,
    "patches": 2,
}
BASE_POLICY = "reference:linearised"  # beneath all arms
# No message, the messages of CorrectingPolicy that are written by hand, and one whose weights are learned.
BASE, HOP, RELAYED, LEARNED = "base", "hop", "relayed", "learned"
BY_HAND = {HOP: OWN_ERROR, RELAYED: CORRECTED_ERROR}
LAWS = (BASE, HOP, RELAYED, LEARNED)
WEIGHTS_FILE = "weights.json"
TRIALS, TRIAL_RUNS = (
    60,
    4,
)  # of a search; runs of each cell in a trial, from TRIAL_RUNS · training seed on
LEAST, MOST = -0.5, 1.5  # weights that are tried
FAILED_MM = 1000.0  # counted for a failed run


class Cell(NamedTuple):
    """A row that is judged. Errors count from the time on at which the last robot has driven for 20 s."""

    task: str
    disturbance: str
    robots: int
    horizon_s: float
    most_runs: int

    @property
    def name(self) -> str:
        """Its name in the tables."""
        return f"{SHOWN[self.task]}, {self.robots} robots, `{self.disturbance}`"


SHOWN = {"infinity": "∞", "long_circle": "circle"}
CELLS = [
    *(Cell("infinity", name, ROW, 65.0, 30) for name in ("slip", "patches")),
    Cell("long_circle", "slip", 10, 90.0, 10),
]
SETTLE_S = 20.0  # the last robot repeats for 10 s how the leader catches up after the start
KICKED_SEED = 0  # the training whose row has one robot that slips
PROBE_SEED = -1  # in place of a training seed
SIGNIFICANT = 4  # digits that are kept


def config_of(arm: Arm) -> TrainConfig:
    """The training of an arm: that of the preset ``residual``, with longer rows and fewer disturbances."""
    residual = load_config("residual")
    more = {"neighbour": FAR} if arm.neighbour else {}
    return load_config(
        residual.model_dump(mode="json"),
        robot_steps=ROBOT_STEPS,
        formations=FORMATIONS,
        scenario={**residual.scenario, **more},
        tasks={task: {"robots": ROW, "horizon_s": 66.0} for task in ("infinity",)},
        disturbances=DISTURBANCES,
    )


def train_arm(name: str, seeds: Sequence[int], trained: Path) -> None:
    """Train an arm with some seeds, one after another, and keep the last policy of each."""
    torch.set_num_threads(1)
    arm = ARMS[name]
    config = config_of(arm)
    tasks, shares = config.mixture()
    for seed in seeds:
        folder = trained / name / f"seed_{seed}"
        folder.mkdir(parents=True, exist_ok=True)
        envs = RowVecEnv(tasks, config.formations, arm=arm, mixture=shares, infos=False)
        model = make_model(config, envs, seed)
        spread_out(model, envs, config.seeds[0])
        course = Course()
        while model.num_timesteps < config.robot_steps:
            set_learning_rate(model, config)
            model.learn(rollout_steps(model), reset_num_timesteps=False, log_interval=None)
            course.note(model.num_timesteps, float(model.rollout_buffer.rewards.mean()))
        model.save(folder / MODEL_FILE)
        course.keep(folder)
        print(name, seed, envs.end_shares(), flush=True)


def scenario_of(cell: Cell) -> Scenario:
    """The scenario of a cell, without what a policy needs."""
    return load_scenario(
        cell.task,
        disturbance=cell.disturbance,
        robots=cell.robots,
        horizon_s=cell.horizon_s,
        plant="batch",
    )


def arm_scenario(cell: Cell, arm: Arm) -> Scenario:
    """The scenario of a cell with the fields that an arm was trained with."""
    return load_scenario(scenario_of(cell).model_dump(mode="json"), **config_of(arm).scenario)


def short(values: Any) -> list[float]:
    """Numbers with the digits that are kept."""
    return [float(f"{value:.{SIGNIFICANT}g}") for value in values]


def learn_message(seeds: Sequence[int], trained: Path) -> None:
    """Search the weights of a message that bring the last robot nearest to the leader's path."""
    import optuna

    optuna.logging.set_verbosity(optuna.logging.WARNING)
    names = [f"{name}_{axis}" for name in Weights._fields for axis in ("forward", "right")]
    cells = [cell for cell in CELLS if cell.task == "infinity"]
    for seed in seeds:
        began_s = time.process_time()

        def score_mm(trial: optuna.Trial, first: int = TRIAL_RUNS * seed) -> float:
            values = [trial.suggest_float(name, LEAST, MOST) for name in names]
            found = []
            for cell in cells:
                policy, scenario = law_of(weights_of(values), scenario_of(cell))
                one = driven(policy, scenario, TRIAL_RUNS, first)
                last = [row[-1] for row in one["path_mm"]]
                found += np.where(one["failed"], FAILED_MM, last).tolist()
            return float(np.mean(found))

        study = optuna.create_study(sampler=optuna.samplers.TPESampler(seed=seed))
        study.enqueue_trial(dict.fromkeys(names, 0.0))  # no message
        study.optimize(score_mm, n_trials=TRIALS)
        scores = [trial.value for trial in study.trials]
        about = {
            "weights": short(study.best_params[name] for name in names),
            "score_mm": short(np.minimum.accumulate(scores)),
            "minutes": round((time.process_time() - began_s) / 60, 2),
        }
        folder = trained / LEARNED / f"seed_{seed}"
        folder.mkdir(parents=True, exist_ok=True)
        (folder / WEIGHTS_FILE).write_text(json.dumps(about) + "\n", encoding="utf-8")
        print(LEARNED, seed, about, flush=True)


def weights_of(values: Sequence[float]) -> Weights:
    """The weights of six numbers: forward and to the right of each."""
    sent, relayed, applied = zip(values[::2], values[1::2], strict=True)
    return Weights(sent, relayed, applied)


def driven(
    policy: Policy, scenario: Scenario, runs: int, first: int = FIRST_TABLE_SEED
) -> dict[str, Any]:
    """Errors of every robot in some runs, mm, and whether these failed."""
    seeds = range(first, first + runs)
    found: dict[str, Any] = {"failed": [], "row_mm": [], "path_mm": []}
    for record in run_seeds(scenario, policy, seeds):
        found["failed"].append(int(failed(record.metrics())))
        row = along_row(record, SETTLE_S)
        for name in ("row_mm", "path_mm"):
            found[name].append(short(row[name]))
    return found


def kicked(policy: Policy, scenario: Scenario) -> list[float]:
    """The largest displacement of every robot, mm, when only robot 1 slips."""
    return short(displacements_mm(scenario, policy, FIRST_TABLE_SEED))


def law_of(weights: Weights | None, scenario: Scenario) -> tuple[Policy, Scenario]:
    """The default system with a message, or without one, and the scenario with what it needs."""
    policy, needed, _ = fit_policy(BASE_POLICY, scenario)
    if weights is not None:
        policy = CorrectingPolicy(policy, needed, weights)
    return policy, needed


def judge_law(name: str, seed: int, weights: Weights | None) -> list[dict[str, Any]]:
    """What the default system with a message does in every cell, and when one robot slips."""
    rows, about = [], {"arm": name, "seed": seed}
    for cell in CELLS:
        policy, scenario = law_of(weights, scenario_of(cell))
        rows.append({"cell": cell.name, **about, **driven(policy, scenario, cell.most_runs)})
    if seed == KICKED_SEED:
        moved = kicked(*law_of(weights, row_scenario()))
        rows.append({"cell": "kick", **about, "moved_mm": moved})
    return rows


def judge_arm(name: str, seeds: Sequence[int], trained: Path) -> list[dict[str, Any]]:
    """What the trainings of an arm do in every cell, and when one robot slips."""
    rows = []
    if name == LEARNED:
        for seed in seeds:
            found = json.loads((trained / name / f"seed_{seed}" / WEIGHTS_FILE).read_text("utf-8"))
            rows += judge_law(name, seed, weights_of(found["weights"]))
            rows.append({"cell": "training", "arm": name, "seed": seed, **found})
        return rows
    if name in LAWS:
        return judge_law(name, 0, BY_HAND.get(name))
    arm = ARMS[name]
    for seed in seeds:
        folder = trained / name / f"seed_{seed}"
        print(name, seed, flush=True)
        model = PPO.load(folder / MODEL_FILE, device="cpu")
        about = {"arm": name, "seed": seed}
        for cell in CELLS:
            scenario = arm_scenario(cell, arm)
            found = driven(RowPolicy(model, arm, scenario), scenario, cell.most_runs)
            rows.append({"cell": cell.name, **about, **found})
        if seed == KICKED_SEED:
            scenario = row_scenario(**config_of(arm).scenario)
            moved = kicked(RowPolicy(model, arm, scenario), scenario)
            rows.append({"cell": "kick", **about, "moved_mm": moved})
    return rows + trainings(name, trained)


def trainings(name: str, trained: Path) -> list[dict[str, Any]]:
    """The courses of an arm's trainings, a row for each."""
    return [
        {"cell": "training", **one, "seed": int(one["seed"].removeprefix("seed_"))}
        for one in courses_of(trained / name, name)
    ]


def joined(rows: list[dict[str, Any]], new: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """The kept rows with new ones, in place of those of the same arms and training seeds."""
    again = {(row["arm"], row["seed"]) for row in new}
    every = [row for row in rows if (row["arm"], row["seed"]) not in again] + new
    return sorted(every, key=lambda row: ((*LAWS, *ARMS).index(row["arm"]), row["seed"]))


def keep(rows: list[dict[str, Any]]) -> None:
    """Write what was found, a line for each row."""
    with atomic(RESULTS, encoding="utf-8") as file:
        file.write("[\n" + ",\n".join(json.dumps(row) for row in rows) + "\n]\n")


# --- what can be foreseen ------------------------------------------------------------------------

PROBED = ("slip", "patches")
PROBE_RUNS = {0: 40, FIRST_TABLE_SEED: 20}  # first seed: runs, to fit and to judge
PROBE_EVERY, PROBE_LATER = (
    5,
    5,
)  # control steps between two rows, and rows until the error that is wanted
PROBE_SEES = ("own", "heard", "shared")
WANTED = ("e_1_fine", "e_2_fine")


def foreseen(
    disturbance: str, first_seed: int, runs: int
) -> tuple[dict[str, np.ndarray], np.ndarray]:
    """What followers see in runs of the base, and their errors half a second later, ``(row, entry)``."""
    cell = next(one for one in CELLS if one.disturbance == disturbance)
    policy, scenario = law_of(None, scenario_of(cell))
    plant = BatchPlant(scenario.model_copy(update={"end_on": ()}), runs)
    plant.reset(first_seed)
    driver = PolicyDriver(policy, scenario, plant.arrays, BASE)
    rows, names = runs * cell.robots, entry_names(scenario)
    leaders = leaders_of(rows, scenario)
    sights = {sees: Sight(sees, scenario, leaders) for sees in PROBE_SEES}
    wanted = [names.index(name) for name in WANTED]
    first = round(((cell.robots - 1) * scenario.time_gap_s + SETTLE_S) / scenario.control_period_s)
    seen: dict[str, list[np.ndarray]] = {sees: [] for sees in sights}
    errors = []
    for step in range(scenario.horizon_steps):
        present = plant.observations.reshape(rows, -1).copy()
        for sees, sight in sights.items():
            if step >= first and step % PROBE_EVERY == 0:
                seen[sees].append(sight.seen(present)[~leaders])
            sight.note(present)
        if step >= first and step % PROBE_EVERY == 0:
            errors.append(present[~leaders][:, wanted])
        plant.step(driver.act())
    kept = {sees: np.concatenate(one[:-PROBE_LATER]) for sees, one in seen.items()}
    return kept, np.concatenate(errors[PROBE_LATER:]).astype(float)


def probe() -> list[dict[str, Any]]:
    """Share of the variance of a follower's error in half a second that a network finds in what it sees."""
    torch.set_num_threads(1)
    rows = []
    for disturbance in PROBED:
        fitted, judged = (foreseen(disturbance, *one) for one in PROBE_RUNS.items())
        for sees in PROBE_SEES:
            found = explained(fitted[0][sees], fitted[1], judged[0][sees], judged[1])
            about = {"cell": f"probe, {disturbance}", "arm": sees, "seed": PROBE_SEED}
            rows.append({**about, "explained": short(found)})
            print(rows[-1], flush=True)
    return rows


# --- measures ------------------------------------------------------------------------------------


def of(rows: list[dict[str, Any]], cell: str, arm: str) -> list[dict[str, Any]]:
    """The kept rows of an arm in a cell, one for each training seed."""
    return [row for row in rows if (row["cell"], row["arm"]) == (cell, arm)]


def errors_mm(rows: list[dict[str, Any]], cell: str, arm: str, name: str) -> np.ndarray:
    """RMS of every robot, (training seed, run, robot); NaN where the run failed."""
    mine = of(rows, cell, arm)
    lost = np.array([row["failed"] for row in mine], dtype=np.bool_)
    return np.where(lost[:, :, np.newaxis], np.nan, np.array([row[name] for row in mine]))


def followers_mm(errors: np.ndarray) -> np.ndarray:
    """RMS over all followers, (training seed, run)."""
    result: np.ndarray = np.sqrt(np.mean(errors[:, :, 1:] ** 2, axis=2))
    return result


def growth(errors: np.ndarray) -> np.ndarray:
    """Factor by which errors grow from one follower to the next, (training seed, run).

    Of the straight line that fits the logarithm of the error over the place in the row, from robot 1 on.
    """
    places = np.arange(1, errors.shape[2], dtype=float)
    places -= places.mean()
    result: np.ndarray = np.exp(np.log(errors[:, :, 1:]) @ places / (places @ places))
    return result


MEASURES = {
    "own error of the followers": lambda row, path: followers_mm(row),
    "last robot to the leader's path": lambda row, path: path[:, :, -1],
    "growth of the own error": lambda row, path: growth(row),
    "growth to the leader's path": lambda row, path: growth(path),
}


def measured(rows: list[dict[str, Any]], cell: str, arm: str, measure: str) -> np.ndarray:
    """A measure of an arm in a cell, (training seed, run)."""
    row, path = (errors_mm(rows, cell, arm, name) for name in ("row_mm", "path_mm"))
    result: np.ndarray = MEASURES[measure](row, path)
    return result


# --- tables and figure ---------------------------------------------------------------------------


def signed(text: str) -> str:
    """With the sign of mathematics."""
    return text.replace("-", "−")


def arms_in(rows: list[dict[str, Any]]) -> list[str]:
    """The judged arms, the base first."""
    return [name for name in (*LAWS, *ARMS) if any(row["arm"] == name for row in rows)]


def error_table(rows: list[dict[str, Any]], measure: str, pairs: Sequence[tuple[str, str]]) -> str:
    """Medians and failed runs of every arm in every cell, and differences of some pairs of arms."""
    names, out = arms_in(rows), []
    pairs = [pair for pair in pairs if set(pair) <= set(names)]
    for cell in CELLS:
        found = {name: measured(rows, cell.name, name, measure) for name in names}
        line = [cell.name]
        for name in names:
            lost = int(np.isnan(found[name]).sum())
            line.append(f"{np.nanmedian(found[name]):.2f}" + (f" ({lost})" if lost else ""))
        for mine, other in pairs:
            one = difference(found[mine], found[other])
            line.append(signed(f"{one.median:+.2f} [{one.low:+.2f}, {one.high:+.2f}]"))
        out.append(line)
    head = [f"`{name}`" for name in names] + [f"`{mine}` − `{other}`" for mine, other in pairs]
    return table(["row", *head], out)


def growth_table(rows: list[dict[str, Any]]) -> str:
    """Growth from follower to follower, of both errors."""
    out = []
    for measure in ("growth of the own error", "growth to the leader's path"):
        for cell in CELLS:
            line = [measure.removeprefix("growth "), cell.name]
            for name in arms_in(rows):
                found = measured(rows, cell.name, name, measure)
                one = difference(found, np.zeros((1, found.shape[1])))
                line.append(f"{one.median:.2f} [{one.low:.2f}, {one.high:.2f}]")
            out.append(line)
    return table(["growth", "row", *(f"`{name}`" for name in arms_in(rows))], out, names=2)


def kick_table(rows: list[dict[str, Any]]) -> str:
    """How far robots move when robot 1 alone slips once."""
    out = []
    for name in arms_in(rows):
        moved = of(rows, "kick", name)[0]["moved_mm"]
        ratio = moved[-1] / moved[SLIPPING + 1]
        shown = (f"{moved[place]:.1f}" for place in (1, 2, 3, 5, -1))
        out.append([f"`{name}`", *shown, f"{ratio:.2f}"])
    last = len(moved) - 1
    head = [f"robot {place}" for place in (1, 2, 3, 5, last)]
    return table(["arm", *head, f"robot {last} / robot {SLIPPING + 1}"], out)


def probe_table(rows: list[dict[str, Any]]) -> str:
    """What networks explain of a follower's error half a second later."""
    out = []
    for disturbance in PROBED:
        for place, name in enumerate(("forward", "to the right")):
            shares = [
                of(rows, f"probe, {disturbance}", sees)[0]["explained"][place]
                for sees in PROBE_SEES
            ]
            out.append([f"`{disturbance}`", name, *(f"{share:.3f}" for share in shares)])
    return table(["disturbance", "error", *(f"`{sees}`" for sees in PROBE_SEES)], out, names=2)


PAIRS = (("heard", "own"), ("two", "heard"), ("shared", "heard"))
BY_MESSAGES = ((HOP, BASE), (RELAYED, BASE), (LEARNED, RELAYED))
DRAWN = ("∞, 5 robots, `slip`", "∞, 5 robots, `patches`", "circle, 10 robots, `slip`")
DASHES = ("-", (0, (6, 2)), (0, (1, 1)), (0, (5, 1, 1, 1)), "-", (0, (3, 1)), (0, (2, 2)), "-")
DPI, TICKS = 110, (1.0, 1.5, 2.0, 3.0, 5.0, 7.0)


def draw_panel(axes: Axes, rows: list[dict[str, Any]], cell: str, name: str) -> None:
    """A line for each arm over the places of a row: the median over trainings and runs."""
    names = arms_in(rows)
    for number, arm in enumerate(names):
        middle = np.nanmedian(errors_mm(rows, cell, arm, name), axis=(0, 1))
        axes.plot(
            middle,
            color=hex_colour(number, len(names)),
            ls=DASHES[number],
            lw=2.2 - 0.2 * number,
            marker=MARKERS[number],
            ms=4.5,
            label=arm,
        )
    axes.set_yscale("log")
    axes.yaxis.set_major_locator(LogLocator(subs=TICKS))
    axes.yaxis.set_major_formatter(FormatStrFormatter("%g"))
    axes.yaxis.set_minor_locator(NullLocator())
    axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    to = "own reference" if name == "row_mm" else "leader's path"
    axes.set_title(f"{cell.replace('`', '')}: to the {to}", loc="left", fontsize="small")
    axes.set_xlabel("place in the row (the leader has 0)")
    axes.set_ylabel("position RMS (mm)")


def draw(rows: list[dict[str, Any]], path: Path) -> None:
    """Errors along the row in every arm."""
    figure = Figure(figsize=(12.5, 7.6), layout="constrained", facecolor="white")
    panels = figure.subplots(2, len(DRAWN))
    for line, name in zip(panels, ("row_mm", "path_mm"), strict=True):
        for axes, cell in zip(line, DRAWN, strict=True):
            draw_panel(axes, rows, cell, name)
    tidy(*panels.ravel())
    handles, labels = panels[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=len(labels), frameon=False)
    with atomic(path, "wb") as file:
        figure.savefig(file, format="png", dpi=DPI, metadata=METADATA.get("png"))


def tables(rows: list[dict[str, Any]]) -> dict[str, str]:
    """All tables by their names."""
    own, path = list(MEASURES)[:2]
    return {
        "neighbours-own": error_table(rows, own, PAIRS),
        "neighbours-path": error_table(rows, path, (*BY_MESSAGES, *PAIRS)),
        "neighbours-growth": growth_table(rows),
        "neighbours-kick": kick_table(rows),
        "neighbours-probe": probe_table(rows),
    }


def main() -> None:
    """Make what is asked for, and write tables and figure."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument(
        "what", nargs="*", help="train ARM; judge; courses; probe; nothing: tables and figures"
    )
    parser.add_argument("--seeds", default="0,1,2", help="of the trainings")
    parser.add_argument("--only", choices=(*LAWS, *ARMS), help="judge one arm, and keep the others")
    parser.add_argument("--trained", type=Path, default=TRAINED)
    given = parser.parse_args()
    seeds = [int(seed) for seed in given.seeds.split(",")]
    rows = json.loads(RESULTS.read_text("utf-8")) if RESULTS.exists() else []
    match given.what:
        case ["train", arm] if arm == LEARNED:
            learn_message(seeds, given.trained)
            return
        case ["train", arm] if arm in ARMS:
            train_arm(arm, seeds, given.trained)
            return
        case ["judge"]:
            trained = [name for name in (LEARNED, *ARMS) if (given.trained / name).exists()]
            every = (BASE, *BY_HAND, *trained)
            for name in (given.only,) if given.only else every:
                rows = joined(rows, judge_arm(name, seeds, given.trained))
                keep(rows)
        case ["courses"]:
            kept = [row for row in rows if row["cell"] != "training" or row["arm"] not in ARMS]
            rows = kept + [one for name in ARMS for one in trainings(name, given.trained)]
            keep(rows)
        case ["probe"]:
            rows = joined(rows, probe())
            keep(rows)
        case []:
            pass
        case _:
            parser.error(f"{' '.join(given.what)!r} is none of train ARM, judge, courses, probe")
    for name, text in tables(rows).items():
        put(PAGE, text, name)
    draw(rows, PICTURE)
    courses = [row for row in rows if row["cell"] == "training" and "along" in row]
    draw_courses(
        courses,
        COURSES_DRAWN,
        COURSES,
        along="robot steps, millions",
        values="mean reward of a rollout",
        scale=MILLION,
    )


if __name__ == "__main__":
    main()
