"""Entries of a competition: a folder with ``entry.yaml`` and a learned policy's weights, or a program."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Annotated, Any, Literal, Self

import numpy as np
from pydantic import Field, ValidationError, field_validator, model_validator

from baselines.policies.card import WEIGHTS
from baselines.policies.entry_process import PROTOCOL, EntryProcess
from baselines.policies.learned import LearnedPolicy, load_policy
from baselines.policies.systems import ENTRY
from tlf_env.common.errors import one_line, shown
from tlf_env.common.models import Frozen
from tlf_env.common.presets import check_named_files, read_yaml
from tlf_env.common.trust import Trust
from tlf_env.onboard.gyro_estimator import GyroEkfParameters
from tlf_env.onboard.kinds import ESTIMATOR_KINDS
from tlf_env.onboard.limiters import Limiter
from tlf_env.onboard.parts import is_part
from tlf_env.onboard.rays import Rays
from tlf_env.onboard.slip_estimator import SlipEkfParameters
from tlf_env.onboard.supervisor import Neighbour
from tlf_env.task.actions import ActionKind
from tlf_env.task.observation import Entry, sensor_entries, tracking_entries
from tlf_env.task.scenario import Scenario

ENTRY_FILE = "entry.yaml"
NOT_HASHED = ("__pycache__",)
Text = Annotated[str, Field(min_length=1, max_length=200)]


class AskedFields(Frozen):
    """The scenario fields that a program may ask for; None: the scenario's."""

    action: ActionKind | None = None
    action_range: tuple[float, float] | None = None
    tracking_fade_mm: float | None = None
    limiter: Limiter | None = None
    observation: Literal["tracking", "sensor"] | None = None
    estimator: str | None = None
    ekf_slip: SlipEkfParameters | None = None
    ekf_gyro: GyroEkfParameters | None = None
    broadcast_smoothing_s: float | None = None
    residual_base: str | None = None
    residual_fade_mm: float | None = None
    residual_reach_mm: float | None = None
    preview_s: tuple[float, ...] | None = None
    rays: Rays | None = None
    neighbour: Neighbour | None = None

    @field_validator("estimator")
    @classmethod
    def _built_in(cls, value: str | None) -> str | None:
        allowed = [kind for kind in ESTIMATOR_KINDS if kind != "truth"]
        if value is not None and value not in allowed:
            raise ValueError(f"must be one of {', '.join(allowed)}, got {value!r}")
        return value

    @field_validator("residual_base")
    @classmethod
    def _no_code(cls, value: str | None) -> str | None:
        if is_part(value):
            raise ValueError(f"must be a controller's preset or file, got {value!r}")
        return value


class EntryCard(Frozen):
    """Contents of ``entry.yaml``."""

    name: Text
    authors: Annotated[tuple[Text, ...], Field(min_length=1)]
    kind: Literal["weights", "code"]
    file: Text | None = None  # of the kind weights: NAME.safetensors, with NAME.json beside it
    command: Annotated[tuple[Text, ...], Field(min_length=1)] | None = None  # of the kind code
    scenario: AskedFields = AskedFields()
    description: str = ""
    licence: str = ""

    @model_validator(mode="after")
    def _check(self) -> Self:
        needed, other = ("file", "command") if self.kind == "weights" else ("command", "file")
        if getattr(self, needed) is None or getattr(self, other) is not None:
            raise ValueError(f"kind {self.kind!r} needs {needed}, and no {other}")
        if self.kind == "weights" and self.scenario != AskedFields():
            raise ValueError(
                "kind 'weights' has its scenario fields in its card, not in entry.yaml"
            )
        return self


def load_entry(folder: Path) -> EntryCard:
    """The card of an entry.

    Raises
    ------
    ValueError
        in one line, for a folder without ``entry.yaml``, an unknown key, and an invalid value.
    """
    path = folder / ENTRY_FILE
    if not os.path.isfile(path):  # noqa: PTH113 - Path's raises an error for a name that is too long
        raise ValueError(f"entry {shown(str(folder))} has no file {ENTRY_FILE}")
    data = read_yaml(path)
    check_named_files(path, data.get("scenario"))
    try:
        return EntryCard.model_validate(data)
    except ValidationError as error:
        raise ValueError(f"{path}: {one_line(error, EntryCard)}") from error


def make_entry(name: str, scenario: Scenario, *, trust: Trust) -> LearnedPolicy | EntryPolicy:
    """The policy of an entry by its name, ``entry:FOLDER``.

    Raises
    ------
    ValueError
        in one line, as :func:`load_entry`; for code without permission, and for weights that cannot be
        loaded.
    """
    folder = Path(name.removeprefix(ENTRY))
    card = load_entry(folder)
    if card.file is not None:
        path = _inside(folder, card.file)
        if path.suffix != WEIGHTS:
            raise ValueError(f"{folder / ENTRY_FILE}: file {card.file!r} must be a {WEIGHTS} file")
        return load_policy(str(path))
    if not trust:
        raise ValueError(f"entry {str(folder)!r} runs code of its own; allow that with --trust")
    return EntryPolicy(card, folder, scenario)


def _inside(folder: Path, file: str) -> Path:
    """A file of the entry's folder."""
    path = (folder / file).resolve()
    if folder.resolve() not in path.parents:
        raise ValueError(f"{folder / ENTRY_FILE}: file {file!r} must be in the entry's folder")
    return path


class EntryPolicy:
    """A program with the signature of SB3's ``predict``; a process of its own for each episode.

    Attributes
    ----------
    files : tuple of Path
        All files in its folder.
    scenario_overrides : dict
        Scenario fields that it asks for.
    """

    privileged = False

    def __init__(self, card: EntryCard, folder: Path, scenario: Scenario) -> None:
        self.card, self.folder = card, folder
        self.files = tuple(
            path
            for path in sorted(folder.rglob("*"))
            if path.is_file() and not set(NOT_HASHED) & set(path.parts)
        )
        self.scenario_overrides = card.scenario.model_dump(exclude_none=True)
        self._scenario = scenario
        self._process: EntryProcess | None = None

    def bind(self, scenario: Scenario) -> None:
        """Take the interface of a scenario from now on."""
        self._scenario = scenario

    @property
    def step_times_s(self) -> list[float]:
        """Time of each step of the present or last episode, s, for all robots together."""
        return [] if self._process is None else self._process.step_times_s

    def predict(
        self,
        observation: np.ndarray,
        state: Any = None,
        episode_start: np.ndarray | None = None,
        deterministic: bool = True,
    ) -> tuple[np.ndarray, Any]:
        """Actions ``(robot, 2)`` of one formation, and the number of steps.

        A new episode begins, with a new process, if ``state`` is None.

        Raises
        ------
        ValueError
            for the observations of more than one formation, and as :class:`EntryProcess`.
        """
        rows = np.asarray(observation)
        robots = self._scenario.robot_count
        if rows.ndim != 2 or len(rows) != robots:
            raise ValueError(
                f"entry {self.card.name!r} takes the observations of one formation, ({robots}, entry), got "
                f"{rows.shape}"
            )
        if state is None or self._process is None:
            self.close()
            self._process = EntryProcess(
                f"entry {self.card.name!r}",
                self.card.command or (),
                self.folder,
                hello(self._scenario),
                (robots, rows.shape[1]),
            )
        return self._process.act(rows), len(self.step_times_s)

    def close(self) -> None:
        """End the process of the present episode, if any."""
        if self._process is not None:
            self._process.close()


def entries_of(scenario: Scenario) -> dict[str, Entry]:
    """The entries of a scenario's observation by name, in order."""
    if scenario.observation == "sensor":
        return sensor_entries(scenario.substeps, scenario.rays)
    return tracking_entries(scenario.preview_s, scenario.rays, scenario.neighbour)


def hello(scenario: Scenario) -> dict[str, Any]:
    """The first message to an entry: the interface, and nothing of the task and the disturbance."""
    return {
        "protocol": PROTOCOL,
        "robots": scenario.robot_count,
        "observation": [
            {"name": name, "unit": entry.unit, "scale": entry.scale}
            for name, entry in entries_of(scenario).items()
        ],
        "action": [
            {"meaning": entry.meaning, "unit": entry.unit, "scale": entry.scale}
            for entry in scenario.action_entries
        ],
        "dtype": "<f4" if scenario.dtype == "float32" else "<f8",
        "control_period_s": scenario.control_period_s,
        "time_gap_s": scenario.time_gap_s,
        "horizon_steps": scenario.horizon_steps,
        "robot_models": [robot.model_dump() for robot in scenario.robot_models],
    }


def step_statistics(times_s: list[float], control_period_s: float) -> dict[str, float]:
    """Of the times of an episode's steps: median, 99 % quantile and maximum in ms, and the share that is late.

    A step is late if it takes longer than a control period.
    """
    times = np.array(times_s)
    quantiles = (("median", 0.5), ("p99", 0.99), ("largest", 1.0))
    found = {name: round(1000 * float(np.quantile(times, q)), 4) for name, q in quantiles}
    return {**found, "late": float((times > control_period_s).mean())}
