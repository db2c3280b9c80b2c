"""IPPO and MAPPO of BenchMARL on the ∞: the part "A critic with the truth" of ``docs/learning.md``.

``python docs/figures/make_marl.py`` trains and judges every variant with 5 seeds; a training takes about 5
minutes of a core. It needs the extra ``benchmarl``. It can be interrupted and goes on where it was: results
are kept in ``results/marl`` until the simulation changes. ``--seeds N`` trains fewer, ``--only VARIANT`` one
variant; ``--draw`` makes table and figure from ``docs/learning/marl.json`` alone.
"""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from make_board import DOCS
from make_parts import put
from matplotlib.figure import Figure

from baselines.runs.provenance import simulation_digest
from baselines.runs.seed_ranges import FIRST_TABLE_SEED
from baselines.runs.style import tidy
from tlf_env.common.files import atomic

PAGE, KEPT = DOCS / "learning.md", DOCS / "learning" / "marl.json"
RUNS = DOCS.parent / "results" / "marl"
FORMATIONS, STEPS, ROLLOUTS = 64, 128, 40  # of a rollout: formations and control steps
ROBOTS, JUDGED, HORIZON_S, SETTLED_S = 3, 50, 60.0, 24.0
SEEDS = 5
CELLS = ("nominal", "slip")
FEWEST = 3  # training seeds that an interval needs


class Variant(NamedTuple):
    """An algorithm, and what its critic is."""

    algorithm: str
    shared: bool = True  # one network of the actor for all robots
    true_state: bool = (
        True  # a central critic sees `state()`; if not, the observations of all robots
    )
    one_value: bool = (
        True  # a central critic has one value for the formation; if not, one for each robot
    )


VARIANTS = {
    "IPPO": Variant("Ippo"),
    "MAPPO": Variant("Mappo"),
    "MAPPO, all observations": Variant("Mappo", true_state=False),
    "MAPPO, a value for each robot": Variant("Mappo", one_value=False),
    "MAPPO, a value for each robot, all observations": Variant(
        "Mappo", true_state=False, one_value=False
    ),
    "IPPO, a network for each robot": Variant("Ippo", shared=False),
    "MAPPO, a value and a network for each robot, all observations": Variant(
        "Mappo", shared=False, true_state=False, one_value=False
    ),
}
STYLES = {
    "IPPO": ("#0072B2", "-"),
    "MAPPO": ("#D55E00", "--"),
    "MAPPO, all observations": ("#CC79A7", (0, (5, 1, 1, 1, 1, 1))),
    "MAPPO, a value for each robot": ("#009E73", "-."),
    "MAPPO, a value for each robot, all observations": ("#000000", ":"),
    "IPPO, a network for each robot": ("#56B4E9", (0, (1, 1))),
    "MAPPO, a value and a network for each robot, all observations": ("#E69F00", (0, (3, 2))),
}


def no_state(env: Any) -> None:
    """The specification of a task without state; BenchMARL pickles it, so that it needs a name."""


def experiment(variant: str, seed: int) -> Any:
    """A training of BenchMARL on its shipped task ``infinity``."""
    import torch
    from benchmarl import algorithms
    from benchmarl.experiment import Experiment, ExperimentConfig
    from benchmarl.models import MlpConfig

    from baselines.benchmarl import FormationTask

    torch.set_num_threads(1)
    wanted = VARIANTS[variant]
    task = FormationTask.INFINITY.get_from_yaml()
    if not wanted.true_state:
        task.state_spec = no_state
    task.config.update(horizon_s=66.0, infos=())
    config = ExperimentConfig.get_from_yaml()
    config.loggers, config.render, config.evaluation = [], False, False
    config.share_policy_params = wanted.shared
    config.max_n_iters, config.max_n_frames = ROLLOUTS, None
    config.on_policy_n_envs_per_worker = FORMATIONS
    config.on_policy_collected_frames_per_batch = FORMATIONS * STEPS
    config.on_policy_minibatch_size, config.on_policy_n_minibatch_iters = 341, 10
    config.lr, config.gamma, config.clip_grad_val = 1e-3, 0.99, 0.5
    config.save_folder = str(RUNS)
    algorithm = getattr(algorithms, f"{wanted.algorithm}Config").get_from_yaml()
    algorithm.share_param_critic = wanted.one_value
    algorithm.entropy_coef, algorithm.lmbda = 0.0, 0.95
    algorithm.scale_mapping = "biased_softplus_0.5"
    network = MlpConfig(
        num_cells=[64, 64], layer_class=torch.nn.Linear, activation_class=torch.nn.Tanh
    )
    return Experiment(
        task=task,
        algorithm_config=algorithm,
        model_config=network,
        critic_model_config=network,
        seed=seed,
        config=config,
    )


def trained(variant: str, seed: int) -> dict[str, Any]:
    """Train and judge one seed: its curve, its errors, and the minutes it took."""
    made, returns = experiment(variant, seed), []
    log = made.logger.log_collection

    def logged(*words: Any, **named: Any) -> Any:
        value = log(*words, **named)
        returns.append(float(value))
        return value

    made.logger.log_collection = logged
    start = time.perf_counter()
    made.run()
    minutes = (time.perf_counter() - start) / 60
    return {
        "variant": variant,
        "seed": seed,
        "returns": [value if np.isfinite(value) else None for value in returns],
        "minutes": minutes,
        "digest": simulation_digest(),
        **{name: judged(made.policy, name) for name in CELLS},
    }


def judged(policy: Any, disturbance: str) -> dict[str, list[float]]:
    """RMS error of the worst robot (mm) from 24 s on and whether the run failed, of 50 unseen seeds."""
    import torch
    from tensordict.nn import set_interaction_type
    from torchrl.envs.utils import ExplorationType

    from baselines.torchrl import FormationBatchEnv

    env = FormationBatchEnv(
        "infinity",
        JUDGED,
        staggered=False,
        seed=FIRST_TABLE_SEED,
        disturbance=disturbance,
        action="tracking_twist",
        horizon_s=HORIZON_S,
        infos=("position_error_mm", "end"),
    )
    steps = env.plant.scenario.horizon_steps
    squares, failed = np.zeros((JUDGED, ROBOTS)), np.zeros(JUDGED, dtype=bool)
    with set_interaction_type(ExplorationType.DETERMINISTIC), torch.no_grad():
        seen = env.reset()
        for k in range(1, steps + 1):
            seen = env.step(policy(seen))["next"]
            # A formation that failed continues to the horizon, as in the benchmark.
            failed |= seen["terminated"].numpy().ravel()
            if k * env.plant.scenario.control_period_s > SETTLED_S:
                squares += seen["robot", "info", "position_error_mm"].numpy() ** 2
    count = round((HORIZON_S - SETTLED_S) / env.plant.scenario.control_period_s)
    return {
        "rms_mm": np.sqrt(squares.max(axis=1) / count).round(4).tolist(),
        "failed": failed.astype(int).tolist(),
    }


def every_run(variants: list[str], seeds: int) -> list[dict[str, Any]]:
    """Results of all trainings; those that are missing are trained and kept."""
    RUNS.mkdir(parents=True, exist_ok=True)
    found = []
    for seed in range(seeds):
        for variant in variants:
            path = RUNS / f"{variant.replace(', ', '-').replace(' ', '_')}_{seed}.json"
            if not path.is_file() or json.loads(path.read_text())["digest"] != simulation_digest():
                result = trained(variant, seed)
                with atomic(path, encoding="utf-8") as file:
                    json.dump(result, file)
            found.append(json.loads(path.read_text(encoding="utf-8")))
            print(line(found[-1]), flush=True)
    return found


def line(one: dict[str, Any]) -> str:
    """A training in one line."""
    cells = [
        f"{name} {np.median(one[name]['rms_mm']):.2f} mm, {sum(one[name]['failed'])} failed"
        for name in CELLS
    ]
    return f"{one['variant']}, seed {one['seed']}: {'; '.join(cells)}; {one['minutes']:.1f} minutes"


def shown(mean: float, half: float) -> str:
    """A geometric mean and its interval, from their logarithms to base 10."""
    middle, low, high = (digits(10.0**value) for value in (mean, mean - half, mean + half))
    return f"{middle} [{low}, {high}]"


def digits(value: float) -> str:
    """A number with three digits, without an exponent."""
    return f"{float(f'{value:.3g}'):.10g}"


def interval(values: list[float]) -> str:
    """Geometric mean of the seeds' values with the 95 % interval of Student's t for their logarithms."""
    from scipy.stats import t

    logs = np.log10(values)
    if len(values) < FEWEST:
        return digits(10.0 ** float(np.mean(logs)))
    half = t.ppf(0.975, len(values) - 1) * np.std(logs, ddof=1) / np.sqrt(len(values))
    return shown(float(np.mean(logs)), float(half))


def ratio(values: list[float], others: list[float]) -> str:
    """Ratio of two geometric means with the 95 % interval of Welch's t for the logarithms."""
    from scipy.stats import ttest_ind

    if len(values) < FEWEST:
        return ""
    mine, theirs = np.log10(values), np.log10(others)
    low, high = ttest_ind(mine, theirs, equal_var=False).confidence_interval(0.95)
    return shown(float((low + high) / 2), float((high - low) / 2))


def table(found: list[dict[str, Any]]) -> str:
    """A row for each variant: geometric mean of the seeds' medians, ratio to the first, and failed runs."""
    lines = [
        "| variant | seeds | RMS error, nominal, mm | under `slip`, mm | ratio to IPPO, nominal | "
        "failed, nominal | under `slip` | minutes |",
        "|---|---:|---:|---:|---:|---:|---:|---:|",
    ]
    of = {name: [one for one in found if one["variant"] == name] for name in VARIANTS}
    medians = {
        name: {cell: [float(np.median(one[cell]["rms_mm"])) for one in runs] for cell in CELLS}
        for name, runs in of.items()
    }
    first = next(iter(VARIANTS))
    for name, runs in of.items():
        if not runs:
            continue
        mine = medians[name]
        failed = [
            f"{sum(sum(one[cell]['failed']) for one in runs)} of {JUDGED * len(runs)}"
            for cell in CELLS
        ]
        against = "" if name == first else ratio(mine[CELLS[0]], medians[first][CELLS[0]])
        cells = [name, str(len(runs)), *(interval(mine[cell]) for cell in CELLS), against, *failed]
        lines.append(f"| {' | '.join(cells)} | {np.median([one['minutes'] for one in runs]):.1f} |")
    return "\n".join(lines)


def draw(found: list[dict[str, Any]], path: Path) -> None:
    """Mean return of a rollout's episodes against robot steps: the median of the seeds, and their range."""
    figure = Figure(figsize=(7.0, 3.6), layout="constrained")
    axes = figure.subplots()
    for variant, (colour, dashes) in STYLES.items():
        curves = [one["returns"] for one in found if one["variant"] == variant]
        if not curves:
            continue
        values = np.array(curves, dtype=float)  # None where no episode ended
        steps = FORMATIONS * STEPS * ROBOTS * (1 + np.arange(values.shape[1])) / 1e6
        some = np.isfinite(values).any(axis=0)
        steps, values = steps[some], values[:, some]
        axes.plot(steps, np.nanmedian(values, axis=0), color=colour, ls=dashes, label=variant)
        low, high = np.nanmin(values, axis=0), np.nanmax(values, axis=0)
        axes.fill_between(steps, low, high, color=colour, alpha=0.15, lw=0)
    axes.set_xlabel("robot steps (millions)")
    axes.set_ylabel("mean return of episodes that ended")
    axes.legend(fontsize=8, frameon=False)
    tidy(axes)
    with atomic(path, "wb") as file:
        figure.savefig(file, format="png", dpi=120, facecolor="white")


def main() -> None:
    """Train, judge, and write table and figure."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=SEEDS)
    parser.add_argument("--only", choices=VARIANTS)
    parser.add_argument("--draw", action="store_true")
    options = parser.parse_args()
    if options.draw:
        found = json.loads(KEPT.read_text(encoding="utf-8"))
    else:
        found = every_run([options.only] if options.only else list(VARIANTS), options.seeds)
        with atomic(KEPT, encoding="utf-8") as file:
            json.dump(found, file)
    put(PAGE, table(found), "marl")
    draw(found, DOCS / "learning" / "marl.png")


if __name__ == "__main__":
    main()
