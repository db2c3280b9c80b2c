"""Configuration of ``tlf train``: one frozen, validated model, read from YAML."""

from __future__ import annotations

import itertools
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal, Self, get_args

from pydantic import Field, ValidationError, model_validator

from baselines.data.episodes import entry_names
from baselines.policies.history import History
from baselines.runs.nested import with_value
from baselines.runs.seed_ranges import CHOOSING_SEEDS, TRAINING_SEEDS, check_seeds
from baselines.runs.splits import check_choosing, check_training
from baselines.training.sensor_layer import sensor_layer
from tlf_env.common.errors import one_line
from tlf_env.common.models import Frozen, NonNegative, Number, Positive, Switch, Whole
from tlf_env.common.presets import beside, is_file_name, read_preset_or_file
from tlf_env.task.scenario import Scenario, scenario_with
from tlf_env.task.sources import BASE

Count = Annotated[Whole, Field(ge=1)]
SeedsFromTo = tuple[
    Annotated[Whole, Field(ge=0)], Annotated[Whole, Field(ge=0)]
]  # first, end (not run)

AlgorithmName = Literal["PPO", "SAC", "TQC", "CrossQ", "RecurrentPPO", "TD3BC"]
ALGORITHMS: tuple[str, ...] = get_args(AlgorithmName)

# Fields of a training's scenario that are the task; all others are the learner's.
OF_THE_TASK = (
    BASE,
    "trajectory",
    "robots",
    "robot",
    "time_gap_s",
    "start_spacing_mm",
    "start_ramp_s",
    "world",
    "plant",
    "control_period_s",
    "preview_s",
)


class NetworkConfig(Frozen):
    """The policy's network; the critic's has the same size."""

    hidden: Annotated[tuple[Count, ...], Field(max_length=4)] = (64, 64)
    activation: Literal["tanh", "relu"] = "tanh"
    history: History | None = None  # earlier observations that it sees; not RecurrentPPO
    # A fixed first layer for raw sensors (baselines/training/sensor_layer.py); the critic sees the truth.
    input: Literal["sensor"] | None = None
    lstm: Count | None = None  # size of the LSTM's state; RecurrentPPO only
    initial_log_std: Number = -1.6  # of the draws of actions; SAC, TQC and CrossQ: before the tanh
    action_gain: Positive = 0.1  # factor on the initial weights of the action: begin near 0


class ImitationConfig(Frozen):
    """Imitation before the training, of the reference or of a data set; PPO only."""

    # A file of `tlf export`, whose actions are imitated; None: the reference drives, with twists from
    # `tracking`.
    data: str | None = None
    controller: str = "tuned"  # gains of the reference, without its limits on accelerations
    robot_steps: Count = 600_000  # over all rounds
    rounds: Count = 1  # the reference drives in the first round, the network in the others
    window: Count | None = None  # rounds that the network is fitted to, the last ones; None: all
    noise: NonNegative = 0.02  # on the actions, standard deviation
    epochs: Count = 10
    learning_rate: Positive = 1e-3


class OfflineConfig(Frozen):
    """Learning from data sets alone; TD3BC, and no other algorithm, has it."""

    # Parquet files of `tlf export`, with the observation and the action of the scenario.
    data: Annotated[str, Field(min_length=1)] | Annotated[tuple[str, ...], Field(min_length=1)]
    # What the value of an action counts against its distance from the data's; 0: imitation of the data.
    alpha: NonNegative = 2.5
    normalise: Switch = True  # observations, by mean and spread of the data

    @property
    def files(self) -> tuple[str, ...]:
        """The files of the data."""
        return (self.data,) if isinstance(self.data, str) else self.data


class CurriculumConfig(Frozen):
    """The levels one after another: an episode draws one of those that were reached so far."""

    failed_share: Annotated[Number, Field(ge=0, lt=1)] = 0.05
    # The next level is added when at most this share of the last 100 robots' episodes ended before the horizon.


class EvaluationConfig(Frozen):
    """Evaluation on choosing seeds, which decides which policy is kept."""

    every: Count  # robot steps
    seeds: SeedsFromTo = (10_000, 10_016)
    disturbances: Annotated[tuple[str, ...], Field(min_length=1)]
    horizon_s: Positive = 60.0

    @model_validator(mode="after")
    def _check(self) -> Self:
        check_seeds("evaluation seeds", self.seeds, CHOOSING_SEEDS)
        return self


class SearchRange(Frozen):
    """Values that a search tries for one entry: from ``low`` to ``high``, or ``one_of`` some."""

    low: Number | None = None
    high: Number | None = None
    log: Switch = False  # uniform in the logarithm
    whole: Switch = False  # whole numbers only
    one_of: Annotated[tuple[Any, ...], Field(min_length=2)] | None = None

    @model_validator(mode="after")
    def _check(self) -> Self:
        if (self.one_of is None) == (self.low is None and self.high is None):
            raise ValueError("needs either low and high, or one_of")
        if self.one_of is not None:
            if self.log or self.whole:
                raise ValueError("log and whole go with low and high, not with one_of")
            return self
        if self.low is None or self.high is None:
            raise ValueError("needs both low and high")
        if not self.low < self.high:
            raise ValueError(f"low {self.low:g} must be below high {self.high:g}")
        if self.log and self.low <= 0:
            raise ValueError(f"low {self.low:g} must be above 0 with log true")
        if self.whole and (self.low % 1 or self.high % 1):
            raise ValueError(
                f"low {self.low:g} and high {self.high:g} must be whole with whole true"
            )
        return self

    @property
    def ends(self) -> tuple[Any, ...]:
        """The values at the ends of the range, or all of ``one_of``."""
        if self.one_of is not None:
            return self.one_of
        ends = (self.low, self.high)
        return tuple(int(end) for end in ends if end is not None) if self.whole else ends


class SearchConfig(Frozen):
    """A search for better numbers of the training (``tlf train --search``); trial 0 is the file itself."""

    ranges: Annotated[dict[str, SearchRange], Field(min_length=1)]  # by the path of an entry
    robot_steps: Count  # of each trial
    trials: Count = 20
    evaluations: Count = 4  # in each trial, evenly; a trial is stopped at one of them
    seeds: Annotated[tuple[Whole, ...], Field(min_length=1)] = (0,)  # training seeds of a trial
    startup_trials: Count = 5  # drawn at random, and not stopped
    finalists: Count = 3  # compared with the start on other training seeds
    choose_seeds: Annotated[tuple[Whole, ...], Field(min_length=1)] = (1, 2)
    sampler_seed: Annotated[Whole, Field(ge=0)] = 0

    @model_validator(mode="after")
    def _check(self) -> Self:
        both = set(self.seeds) & set(self.choose_seeds)
        if both:
            raise ValueError(
                f"choose_seeds {list(self.choose_seeds)} must differ from seeds {list(self.seeds)}: the "
                f"finalists were found on {sorted(both)}"
            )
        return self


class TrainConfig(Frozen):
    """A training: the algorithm, the episodes and the evaluation. Times in s."""

    algorithm: AlgorithmName
    settings: dict[str, Any] = {}  # keyword arguments of SB3's algorithm
    final_learning_rate_share: Annotated[Number, Field(gt=0, le=1)] = 1.0  # falls linearly
    network: NetworkConfig = NetworkConfig()
    imitation: ImitationConfig | None = None
    offline: OfflineConfig | None = None  # TD3BC: no episode is run but in evaluations
    # Control steps × robots, over all formations; offline those drawn from the data, updates × batch_size.
    robot_steps: Count
    formations: Count = 96
    precision: Literal["double", "single"] = "double"  # of episodes; evaluations are in double
    seeds: SeedsFromTo = TRAINING_SEEDS  # of the episodes
    scenario: dict[str, Any] = {}  # scenario fields of every task
    tasks: Annotated[
        dict[str, dict[str, Any]], Field(min_length=1)
    ]  # task: its own scenario fields; with `base`, the task is a new one, built on that
    # Preset or file: share of episodes; also PRESET@LEVEL, as ice@1.3.
    disturbances: Annotated[dict[str, NonNegative], Field(min_length=1)] = {"nominal": 1.0}
    levels: Annotated[tuple[Positive, ...], Field(min_length=1)] = (1.0,)  # with equal shares
    curriculum: CurriculumConfig | None = None  # None: all levels from the start
    checkpoint_every: Count = 1_000_000  # robot steps
    evaluation: EvaluationConfig
    search: SearchConfig | None = None  # of `tlf train --search`; a training itself does not use it

    @model_validator(mode="after")
    def _check(self) -> Self:
        check_seeds("seeds", self.seeds, TRAINING_SEEDS)
        if (self.network.lstm is not None) != (self.algorithm == "RecurrentPPO"):
            raise ValueError(
                f"RecurrentPPO, and no other algorithm, needs network.lstm; got {self.network.lstm} "
                f"with {self.algorithm}"
            )
        if (self.offline is not None) != (self.algorithm == "TD3BC"):
            raise ValueError(
                "TD3BC, and no other algorithm, needs offline; got "
                f"{'none' if self.offline is None else 'one'} with {self.algorithm}"
            )
        if self.offline is not None and self.network.history is not None:
            raise ValueError("offline needs a network without history: its data have none")
        if self.network.history is not None and self.network.lstm is not None:
            raise ValueError("network.history and network.lstm exclude each other; both are given")
        sensors = self.network.input == "sensor"
        if self.imitation is not None and self.network.history is not None and not sensors:
            raise ValueError(
                "imitation needs a network without history: its teacher and its data have none"
            )
        if sensors:
            self._check_sensors()
        if self.imitation is not None and self.algorithm != "PPO":
            raise ValueError(f"imitation needs algorithm PPO, got {self.algorithm}")
        if self.imitation is not None and self.imitation.data and self.imitation.rounds > 1:
            raise ValueError(
                "imitation.rounds needs a reference that drives; with data it must be 1"
            )
        if self.curriculum is not None and (
            len(self.levels) < 2 or list(self.levels) != sorted(set(self.levels))
        ):
            raise ValueError(
                f"curriculum needs at least two levels that increase, got levels {list(self.levels)}"
            )
        if not any(self.disturbances.values()):
            raise ValueError("disturbances: at least one share must be above 0")
        for reserved in ("seed", "policy", "env", "policy_kwargs", "tensorboard_log", "use_sde"):
            if reserved in self.settings:
                raise ValueError(f"settings.{reserved} is set by the training and must be left out")
        for place, fields in (
            ("scenario", self.scenario),
            *((f"tasks.{task}", fields) for task, fields in self.tasks.items()),
        ):
            if "disturbance" in fields:
                raise ValueError(f"{place}.disturbance must be left out; disturbances has them all")
        tasks, _ = self.mixture()
        self.evaluation_scenarios()
        if self.network.history is not None:
            try:
                self.network.history.places(entry_names(next(iter(tasks.values()))[0]))
                if self.network.input == "sensor":
                    for scenarios in tasks.values():
                        sensor_layer(scenarios[0], self.network.history)
            except ValueError as error:
                raise ValueError(f"network.{error}") from error
        return self

    def _check_sensors(self) -> None:
        """Check what a network with the input ``sensor`` needs, but for its scenario."""
        wanted = {
            "algorithm": ("PPO", self.algorithm),
            "network.activation": ("relu", self.network.activation),
            "imitation.data": (None, self.imitation.data if self.imitation else None),
        }
        for name, (needed, got) in wanted.items():
            if got != needed:
                raise ValueError(f"network.input sensor needs {name} {needed}, got {got}")
        if self.network.history is None:
            raise ValueError("network.input sensor needs network.history")

    @model_validator(mode="after")
    def _check_search(self) -> Self:
        for path, span in self.search.ranges.items() if self.search else ():
            for end in span.ends:
                try:
                    self.with_values({path: end})
                except (ValueError, TypeError) as error:
                    raise ValueError(f"search.ranges.{path}: {error}") from error
        return self

    @property
    def recorded(self) -> dict[str, Any]:
        """What a training is identified by: all of it but its search."""
        return self.model_dump(mode="json", exclude={"search"})

    def with_values(self, values: Mapping[str, Any], **fields: Any) -> TrainConfig:
        """The same training without its search, with other values at some paths, and other fields.

        Raises
        ------
        ValueError
            for a path that does not exist, or a value that is not allowed there.
        """
        data = self.model_dump(mode="json") | {"search": None} | fields
        for path, value in values.items():
            data = with_value(data, path, value)
        try:
            return TrainConfig.model_validate(data)
        except ValidationError as error:
            raise ValueError(one_line(error, TrainConfig)) from error

    def shares(self, level_count: int | None = None) -> list[float]:
        """Shares of episodes of each disturbance at each level, with the first levels only, all if None."""
        count = len(self.levels) if level_count is None else level_count
        return [
            share if number < count else 0.0
            for share in self.disturbances.values()
            if share > 0
            for number in range(len(self.levels))
        ]

    def mixture(self) -> tuple[dict[str, list[Scenario]], list[float]]:
        """Scenarios of each task (every disturbance at every level), and their shares of episodes.

        Raises
        ------
        ValueError
            for an invalid scenario, one that cannot run in a batch, or one that must not train
            (:mod:`baselines.runs.splits`).
        """
        wanted = [name for name, share in self.disturbances.items() if share > 0]
        tasks = {
            task: [self._scenario(task, name, level) for name in wanted for level in self.levels]
            for task in self.tasks
        }
        for scenario in itertools.chain.from_iterable(tasks.values()):
            check_training(scenario)
        return tasks, self.shares()

    def evaluation_scenarios(self) -> dict[tuple[str, str], Scenario]:
        """Scenario of each task and disturbance of the evaluation.

        Raises
        ------
        ValueError
            for an invalid scenario, or one that is for tests only (:mod:`baselines.runs.splits`).
        """
        scenarios = {
            (task, name): self._scenario(task, name, None, horizon_s=self.evaluation.horizon_s)
            for task in self.tasks
            for name in self.evaluation.disturbances
        }
        for scenario in scenarios.values():
            check_choosing(scenario)
        return scenarios

    def task_scenarios(self) -> dict[tuple[str, str], Scenario]:
        """As :func:`evaluation_scenarios`, without what belongs to the learner: for another policy."""
        found = {}
        for task, own in self.tasks.items():
            fields = {**self.scenario, **own}
            kept = {key: value for key, value in fields.items() if key in OF_THE_TASK}
            alone = self.model_copy(update={"scenario": {}, "tasks": {task: kept}})
            for name in self.evaluation.disturbances:
                found[task, name] = alone._scenario(
                    task, name, None, horizon_s=self.evaluation.horizon_s
                )
        return found

    def named_scenarios(self) -> list[tuple[str, Scenario]]:
        """Every scenario of the training and of its evaluation, with its task and disturbance."""
        tasks, _ = self.mixture()
        trained = [
            (f"{task}, {one.disturbance.name}", one)
            for task, scenarios in tasks.items()
            for one in scenarios
        ]
        evaluated = self.evaluation_scenarios().items()
        return trained + [(", ".join(place), scenario) for place, scenario in evaluated]

    def _scenario(self, task: str, disturbance: str, level: float | None, **more: Any) -> Scenario:
        """A task's scenario; an error names the place of the key in the configuration."""
        own = self.tasks[task]
        source = {"name": task, BASE: own[BASE]} if BASE in own else task
        own = {field: value for field, value in own.items() if field != BASE}
        disturbance, own_level = level_of(disturbance)
        if own_level is not None:
            level = own_level if level is None else own_level * level
        fields = {**self.scenario, "plant": "batch", **own, **more, "disturbance": disturbance}
        try:
            return scenario_with(source, fields, level)
        except ValueError as error:
            key = re.split(r"[.:\s]", str(error), maxsplit=1)[0]
            place = (
                f"tasks.{task}."
                if key in self.tasks[task]
                else "scenario."
                if key in self.scenario
                else ""
            )
            raise ValueError(f"{place}{error}") from error


def level_of(disturbance: str) -> tuple[str, float | None]:
    """The disturbance and the level of ``PRESET@LEVEL``; None without a level."""
    name, found, level = disturbance.rpartition("@")
    try:
        return (name, float(level)) if found else (disturbance, None)
    except ValueError:
        return disturbance, None


def _file_beside(folder: Path, name: Any) -> Any:
    """The path of a file in the folder, if there is such a file; of each one of a list."""
    if isinstance(name, list):
        return [_file_beside(folder, one) for one in name]
    return str(folder / name) if isinstance(name, str) and (folder / name).is_file() else name


def _place_files(data: dict[str, Any], folder: Path) -> None:
    """Replace the files in the configuration's folder by their paths: disturbances, bases, data."""
    for section in map(data.get, ("imitation", "offline")):
        if isinstance(section, dict) and "data" in section:
            section["data"] = _file_beside(folder, section["data"])
    tasks = data.get("tasks")
    for own in tasks.values() if isinstance(tasks, dict) else ():
        if isinstance(own, dict) and BASE in own:
            own[BASE] = beside(folder, own[BASE])
    for place in (data, data.get("evaluation")):
        if isinstance(place, dict) and "disturbances" in place:
            place["disturbances"] = beside(folder, place["disturbances"])


def load_config(source: str | Path | Mapping[str, Any], **overrides: Any) -> TrainConfig:
    """A training from a preset's name, a YAML file or a mapping; keywords override its fields.

    Raises
    ------
    ValueError
        in one line that names the value and what is allowed.
    """
    if isinstance(source, Mapping):
        data = dict(source)
    else:
        data = read_preset_or_file("training", source)
        if is_file_name(source):
            _place_files(data, Path(source).parent)
    data |= {name: value for name, value in overrides.items() if value is not None}
    try:
        return TrainConfig.model_validate(data)
    except ValidationError as error:
        raise ValueError(one_line(error, TrainConfig)) from error


def with_trials(config: TrainConfig, trials: int | None) -> TrainConfig:
    """The training with another number of trials in its search; None: as it is."""
    if trials is None or config.search is None:
        return config
    return config.model_copy(update={"search": config.search.model_copy(update={"trials": trials})})
