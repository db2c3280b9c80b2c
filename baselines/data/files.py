"""Files of data sets: a plain table in Parquet, and Minari's form."""

from __future__ import annotations

import hashlib
import json
import os
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import gymnasium
import numpy as np
import yaml

from baselines.data.episodes import RobotEpisode, entry_names
from baselines.policies.card import interface
from tlf_env.common.errors import install_command, path_text
from tlf_env.common.files import atomic
from tlf_env.onboard.parts import is_part
from tlf_env.task.scenario import Scenario, load_scenario

MINARI_FOLDER = "MINARI_DATASETS_PATH"  # the variable by which Minari finds its data sets
ABOUT = b"tlf_env"  # key of the metadata in a Parquet file
PLACE = ("episode", "task", "disturbance", "seed", "robot", "step")
OUTCOME = ("reward", "terminated", "truncated")
# What decides which twist an action is: fields of a scenario, and of what `interface` says of it.
ACTION_FIELDS = (
    "action",
    "action_range",
    "tracking_fade_mm",
    "limiter",
    "residual_base",
    "residual_fade_mm",
    "residual_reach_mm",
    "control_period_s",
)
ACTION_MEANING = ("action_scales", *ACTION_FIELDS[2:])


class About(NamedTuple):
    """What a data set was made of; written into its files."""

    policy: str
    action: str  # kind of the actions
    observation: str
    entries: list[str]  # of an observation
    control_period_s: float
    scenario: str  # the first one, as YAML
    versions: dict[str, str]
    noise: float = 0.0  # standard deviation of what was added to the policy's actions


class Rows(NamedTuple):
    """Steps of a data set, for a learner."""

    observations: np.ndarray  # (step, entry)
    actions: np.ndarray  # (step, 2)
    rewards: np.ndarray  # (step,)
    next_observations: np.ndarray  # (step, entry), after the action
    terminated: np.ndarray  # (step,): whether the robot is lost or has touched; nothing follows
    last: np.ndarray  # (step,): whether its episode ends with the step, terminated or truncated
    tasks: tuple[str, ...]  # that occur, sorted; so the next ones
    disturbances: tuple[str, ...]
    seeds: tuple[int, ...]
    about: About
    file: str  # its name, without its folder
    sha256: str  # of its content

    def origin(self) -> dict[str, Any]:
        """Where the data come from, as JSON values."""
        return {
            "file": self.file,
            "sha256": self.sha256,
            "policy": self.about.policy,
            "noise": self.about.noise,
            "tasks": list(self.tasks),
            "disturbances": list(self.disturbances),
            "seeds": [self.seeds[0], self.seeds[-1] + 1],  # first, end
            "steps": len(self.actions),
            "versions": self.about.versions,
        }


def write_parquet(episodes: Sequence[RobotEpisode], about: About, path: Path) -> None:
    """Write a row for each robot and step; the last observation of an episode has a row without an action.

    Raises
    ------
    ValueError
        without pyarrow.
    """
    pa, pq = _arrow()
    tables = []
    for number, episode in enumerate(episodes):
        robots = [episode] if episode.robot is not None else _apart(episode)
        tables += [pa.table(_columns(number, one, about.entries)) for one in robots]
    whole = pa.concat_tables(tables).replace_schema_metadata({ABOUT: json.dumps(about._asdict())})
    with atomic(path, "wb") as file:
        pq.write_table(whole, file)


def _columns(number: int, episode: RobotEpisode, entries: Sequence[str]) -> dict[str, Any]:
    steps = len(episode.actions)
    flags = np.zeros((2, steps + 1), dtype=np.bool_)
    flags[:, steps - 1] = episode.terminated, episode.truncated
    nothing = np.full((1, episode.actions.shape[1]), np.nan, dtype=np.float32)
    actions = np.concatenate([episode.actions, nothing])
    place = (number, episode.task, episode.disturbance, episode.seed, episode.robot)
    return {
        **{name: [value] * (steps + 1) for name, value in zip(PLACE[:-1], place, strict=True)},
        PLACE[-1]: np.arange(steps + 1),
        **{f"observation_{one}": episode.observations[:, i] for i, one in enumerate(entries)},
        **{f"action_{i}": actions[:, i] for i in range(actions.shape[1])},
        OUTCOME[0]: np.append(episode.rewards, np.nan),
        OUTCOME[1]: flags[0],
        OUTCOME[2]: flags[1],
    }


def _apart(episode: RobotEpisode) -> list[RobotEpisode]:
    """A joint episode as one for each robot, with the joint reward."""
    return [
        episode._replace(
            robot=i, observations=episode.observations[:, i], actions=episode.actions[:, i]
        )
        for i in range(episode.actions.shape[1])
    ]


def read_rows(path: Path) -> Rows:
    """The steps of a Parquet file that :func:`write_parquet` wrote, each with the observation after it.

    Raises
    ------
    ValueError
        in one line, for a file that cannot be read or is no such data set, for one that lacks a column, a
        step or the observation after a step, or holds a number that is not finite, and without pyarrow.
    """
    pa, pq = _arrow()
    name = path_text(path)
    try:
        content = path.read_bytes()
        table = pq.read_table(pa.BufferReader(content))
        about = About(**json.loads((table.schema.metadata or {})[ABOUT]))
    except OSError as error:
        why = " ".join(str(error.strerror or error).split())
        raise ValueError(f"cannot read {name}: {why}") from error
    except (ValueError, KeyError, TypeError) as error:
        raise ValueError(f"{name} is no data set of `tlf export`") from error
    names = [f"observation_{one}" for one in about.entries]
    missing = {*PLACE, *names, *OUTCOME, "action_0", "action_1"} - set(table.column_names)
    if missing:
        raise ValueError(f"{name} has no column {sorted(missing)[0]}")
    texts = {one: tuple(sorted(set(table[one].unique().to_pylist()))) for one in PLACE[1:4]}
    columns = {one: table[one].to_numpy() for one in table.column_names if one not in PLACE[1:3]}
    acted = ~np.isnan(columns["action_0"])
    steps = np.flatnonzero(acted)
    if len(steps) == 0:
        raise ValueError(f"{name} has no step")
    last = columns["terminated"] | columns["truncated"]
    _check_order(name, columns, acted, last)
    seen = np.stack([columns[one] for one in names], axis=1).astype(np.float32)
    rows = Rows(
        observations=seen[steps],
        actions=np.stack([columns[f"action_{i}"][steps] for i in (0, 1)], axis=1).astype(
            np.float32
        ),
        rewards=columns["reward"][steps],
        next_observations=seen[steps + 1],
        terminated=columns["terminated"][steps],
        last=last[steps],
        tasks=texts["task"],
        disturbances=texts["disturbance"],
        seeds=texts["seed"],
        about=about,
        file=path.name,
        sha256=hashlib.sha256(content).hexdigest(),
    )
    for what, numbers in rows._asdict().items():
        if isinstance(numbers, np.ndarray) and not np.isfinite(numbers).all():
            raise ValueError(f"{name} holds {what} that are not finite")
    if np.abs(rows.actions).max() > 1.0:
        raise ValueError(
            f"{name} holds an action of {np.abs(rows.actions).max():g}; actions must lie within ±1"
        )
    return rows


def _check_order(name: str, columns: dict[str, np.ndarray], acted: np.ndarray, last: Any) -> None:
    """Check that after each step comes the next one of its episode, or its last observation.

    Raises
    ------
    ValueError
        naming the first step that lacks it.
    """
    same = acted[:-1].copy()
    for one, apart in ((PLACE[0], 0), (PLACE[4], 0), (PLACE[5], 1)):
        same &= columns[one][1:] - columns[one][:-1] == apart
    same &= acted[1:] != last[:-1]  # after the end without an action, else with one
    wrong = np.flatnonzero(acted & ~np.append(same, False))
    if len(wrong):
        k = wrong[0]
        place = ", ".join(f"{one} {columns[one][k]}" for one in (PLACE[0], PLACE[4], PLACE[5]))
        what = "last observation" if last[k] else "next step"
        raise ValueError(f"{name}: {place} has no row with its {what} behind it")


def fitting_rows(path: Path, scenario: Scenario) -> Rows:
    """As :func:`read_rows`, of a data set with the scenario's observation and action.

    Raises
    ------
    ValueError
        as there, and for data of another observation, another kind of action, or actions that mean another
        twist.
    """
    data, name = read_rows(path), path_text(path)
    mine = (scenario.action, entry_names(scenario))
    if (data.about.action, data.about.entries) != mine:
        raise ValueError(
            f"{name} has {len(data.about.entries)} entries of {data.about.observation!r} observations and "
            f"{data.about.action!r} actions; the scenario has {len(mine[1])} of {scenario.observation!r} and "
            f"{scenario.action!r}"
        )
    theirs, wanted = interface(_acted_in(data.about, name)), interface(scenario)
    for field in ACTION_MEANING:
        if theirs.get(field) != wanted.get(field):
            raise ValueError(
                f"{name} has actions with {field} {theirs.get(field)}; the scenario has "
                f"{wanted.get(field)}"
            )
    return data


def _acted_in(about: About, name: str) -> Scenario:
    """A scenario in which actions mean what they do in a data set; runs no code that its file names."""
    try:
        fields = dict(yaml.safe_load(about.scenario) or {})
    except (yaml.YAMLError, TypeError, ValueError) as error:
        raise ValueError(f"{name} is no data set of `tlf export`") from error
    kept = {one: fields[one] for one in ACTION_FIELDS if one in fields}
    code = [one for one, value in kept.items() if isinstance(value, str) and is_part(value)]
    return load_scenario("infinity", **{one: kept[one] for one in kept if one not in code})


def write_minari(
    episodes: Sequence[RobotEpisode],
    about: About,
    space: gymnasium.spaces.Box,
    folder: Path,
    dataset_id: str,
) -> None:
    """Write a data set in Minari's form (Arrow files) below a folder.

    ``minari.load_dataset(dataset_id)`` reads it with the environment variable ``MINARI_DATASETS_PATH`` set to
    the folder.

    Parameters
    ----------
    space
        Of one robot's observations.

    Raises
    ------
    ValueError
        without Minari, or if the folder has such a data set already.
    """
    try:
        with minari_folder(folder):
            import minari
            from minari.data_collector.episode_buffer import EpisodeBuffer
    except ModuleNotFoundError as error:
        raise ValueError(f"--form minari needs {error.name} ({install_command('data')})") from error
    if (folder / dataset_id).exists():
        raise ValueError(f"{folder / dataset_id} exists already; choose another --out or --name")
    shape = episodes[0].observations.shape[1:]
    low, high = (np.broadcast_to(end, shape) for end in (space.low, space.high))
    spaces = {
        "observation_space": gymnasium.spaces.Box(low, high, dtype=np.float32),
        "action_space": gymnasium.spaces.Box(-1.0, 1.0, episodes[0].actions.shape[1:], np.float32),
    }
    buffers = [
        EpisodeBuffer(
            id=number,
            seed=one.seed,
            observations=list(one.observations.astype(np.float32)),
            actions=list(one.actions),
            rewards=one.rewards.tolist(),
            terminations=_at_the_end(len(one.rewards), one.terminated),
            truncations=_at_the_end(len(one.rewards), one.truncated),
        )
        for number, one in enumerate(episodes)
    ]
    with minari_folder(folder), warnings.catch_warnings():
        warnings.simplefilter(
            "ignore", UserWarning
        )  # it asks for a link to the code, and more of that kind
        minari.create_dataset_from_buffers(
            dataset_id,
            buffers,
            algorithm_name=about.policy,
            author="tlf_env",
            description=json.dumps(about._asdict()),
            data_format="arrow",
            **spaces,
        )


def _at_the_end(steps: int, value: bool) -> list[bool]:
    return [*[False] * (steps - 1), value]


@contextmanager
def minari_folder(folder: Path) -> Iterator[None]:
    """Let Minari keep its data sets in a folder."""
    before = os.environ.get(MINARI_FOLDER)
    os.environ[MINARI_FOLDER] = str(folder.resolve())
    try:
        yield
    finally:
        if before is None:
            del os.environ[MINARI_FOLDER]
        else:
            os.environ[MINARI_FOLDER] = before


def _arrow() -> tuple[Any, Any]:
    try:
        import pyarrow as pa
        import pyarrow.parquet as pq
    except ModuleNotFoundError as error:
        raise ValueError(f"Parquet needs {error.name} ({install_command('data')})") from error
    return pa, pq
