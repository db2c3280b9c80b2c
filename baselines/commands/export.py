"""``tlf export``: runs of a policy as a data set for offline learning."""

from __future__ import annotations

import math
from pathlib import Path

from baselines.benchmark.plan import parse_seeds
from baselines.commands.compile import compile_before_first_run
from baselines.console import listed, progress_bar, screen, writable_folder
from baselines.data.episodes import collected, entry_names
from baselines.data.files import MINARI_FOLDER, About, write_minari, write_parquet
from baselines.policies.registry import fit_policy
from baselines.runs.provenance import versions
from tlf_env.common.trust import Trust
from tlf_env.envs.parallel import parallel_env
from tlf_env.onboard.parts import check_trust
from tlf_env.task.scenario import load_scenario

FORMS = ("parquet", "minari")


def export_command(
    tasks: str,
    disturbances: str,
    policy: str,
    seeds: str,
    *,
    horizon_s: float | None,
    noise: float,
    form: str,
    joint: bool,
    name: str,
    out: Path,
    trust: Trust,
) -> None:
    """Drive a policy through every task, disturbance and seed, and write the data set.

    Raises
    ------
    ValueError
        for whatever does not fit, before the runs.
    """
    if form not in FORMS:
        raise ValueError(f"--form {form!r} must be one of {', '.join(FORMS)}")
    if not (math.isfinite(noise) and noise >= 0):
        raise ValueError(f"--noise {noise:g} must be a finite number from 0 on")
    first, end = parse_seeds(seeds)
    fitted = [
        fit_policy(policy, load_scenario(task, disturbance=one, horizon_s=horizon_s), trust=trust)
        for task in listed(tasks)
        for one in listed(disturbances)
    ]
    for fit in fitted:
        check_trust(fit.scenario.code, trust)
    kinds = {(one.scenario.action, tuple(entry_names(one.scenario))) for one in fitted}
    if len(kinds) > 1:
        raise ValueError("the tasks must have the same action and the same observation")
    if joint and len({one.scenario.robot_count for one in fitted}) > 1:
        raise ValueError("--joint needs tasks with the same number of robots")
    writable_folder(out)
    scenario = fitted[0].scenario
    about = About(
        policy=policy,
        action=scenario.action,
        observation=scenario.observation,
        entries=entry_names(scenario),
        control_period_s=scenario.control_period_s,
        scenario=str(scenario),
        versions=versions(),
        noise=noise,
    )
    compile_before_first_run()
    episodes = []
    formations = len(fitted) * (end - first)
    with progress_bar("export") as update:
        pairs = [(one.scenario, one.policy) for one in fitted]
        for one in collected(
            pairs, range(first, end), policy, joint=joint, noise=noise, trust=trust
        ):
            episodes.append(one)
            per_formation = 1 if joint else scenario.robot_count
            update(min(len(episodes) // per_formation, formations), formations)
    steps = sum(len(one.actions) for one in episodes)
    if form == "parquet":
        path = out / f"{name}.parquet"
        write_parquet(episodes, about, path)
        use = f"imitation: {{data: {path}}} or offline: {{data: {path}}} in a training's file"
    else:
        space = parallel_env(scenario, trust=trust).observation_space("robot_0")
        write_minari(episodes, about, space, out, f"tlf_env/{name}-v0")
        path = out / f"tlf_env/{name}-v0"
        load = f"import minari; data = minari.load_dataset('tlf_env/{name}-v0')"
        use = f"{load}, with the environment variable {MINARI_FOLDER}={out.resolve()}"
    ended = sum(one.terminated for one in episodes)
    screen.print(
        f"{path}: {len(episodes)} episodes, {steps} steps; {ended} ended early. Use it with",
        soft_wrap=True,
    )
    screen.print(use, soft_wrap=True)
