"""Files of data sets: a plain table in Parquet, and Minari's form."""

from __future__ import annotations

import json
import os
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import gymnasium
import numpy as np

from baselines.data.episodes import RobotEpisode
from tlf_env.common.errors import install_command, path_text
from tlf_env.common.files import atomic

MINARI_FOLDER = "MINARI_DATASETS_PATH"  # the variable by which Minari finds its data sets
ABOUT = b"tlf_env"  # key of the metadata in a Parquet file
PLACE = ("episode", "task", "disturbance", "seed", "robot", "step")
OUTCOME = ("reward", "terminated", "truncated")


class About(NamedTuple):
    """What a data set was made of; written into its files."""

    policy: str
    action: str  # kind of the actions
    observation: str
    entries: list[str]  # of an observation
    control_period_s: float
    scenario: str  # the first one, as YAML
    versions: dict[str, str]


class Rows(NamedTuple):
    """Steps of a data set, for a learner."""

    observations: np.ndarray  # (step, entry)
    actions: np.ndarray  # (step, 2)
    rewards: np.ndarray  # (step,)
    last: np.ndarray  # (step,): whether its episode ends with the step
    about: About


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
    """The steps of a Parquet file that :func:`write_parquet` wrote, without the last observations.

    Raises
    ------
    ValueError
        in one line, for a file that cannot be read or is no such data set, and without pyarrow.
    """
    _, pq = _arrow()
    name = path_text(path)
    try:
        table = pq.read_table(path)
        about = About(**json.loads((table.schema.metadata or {})[ABOUT]))
    except OSError as error:
        raise ValueError(f"cannot read {name}: {error}") from error
    except (ValueError, KeyError, TypeError) as error:
        raise ValueError(f"{name} is no data set of `tlf export`") from error
    columns = {one: table[one].to_numpy() for one in table.column_names if one not in PLACE[1:3]}
    names = [f"observation_{one}" for one in about.entries]
    missing = {*names, *OUTCOME, "action_0", "action_1"} - set(columns)
    if missing:
        raise ValueError(f"{name} has no column {sorted(missing)[0]}")
    kept = ~np.isnan(columns["action_0"])
    return Rows(
        observations=np.stack([columns[one][kept] for one in names], axis=1).astype(np.float32),
        actions=np.stack([columns[f"action_{i}"][kept] for i in (0, 1)], axis=1).astype(np.float32),
        rewards=columns["reward"][kept],
        last=(columns["terminated"] | columns["truncated"])[kept],
        about=about,
    )


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
