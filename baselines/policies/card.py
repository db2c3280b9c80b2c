"""A learned policy on disk: its tensors in ``NAME.safetensors``, and its card in ``NAME.json``.

The card says what the network is, what it sees and does, and how it was made. Neither file can hold
code, so that a policy of somebody else's is read without trust.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Annotated, Any, Final, Literal, NamedTuple, Self

import numpy as np
from pydantic import Field, JsonValue, ValidationError, model_validator
from safetensors import SafetensorError
from safetensors.numpy import load, save

from tlf_env.common.errors import one_line
from tlf_env.common.files import atomic
from tlf_env.common.models import Frozen, NonNegative, Positive
from tlf_env.task.actions import ACTION_ENTRIES, ACTION_SIZE
from tlf_env.task.observation import sensor_entries, tracking_entries
from tlf_env.task.scenario import Scenario

FORMAT_VERSION: Final = 1
WEIGHTS, CARD = ".safetensors", ".json"
NORMALISATION = "normalise."
LSTM_GATES = 4  # input, forget, cell, output, in this order

Size = Annotated[int, Field(ge=1)]
Word = Annotated[str, Field(min_length=1)]
Tensors = Mapping[str, np.ndarray]


class Network(Frozen):
    """What is computed: normalisation, an LSTM, hidden layers and a linear head, in this order.

    Tensors are named and shaped as :meth:`shapes` says; a weight is (out, in), as in torch.
    """

    hidden: tuple[Size, ...]  # sizes of the hidden layers
    activation: Literal["tanh", "relu"]  # after each of them
    lstm: Size | None = None  # size of its state; None without one
    head: Literal["gaussian", "squashed_gaussian"]  # the latter: tanh of the draw, as SAC does
    normalised: bool = False  # whether observations are, as VecNormalize does

    def shapes(self, entries: int) -> dict[str, tuple[int, ...]]:
        """Shapes of all tensors by name, for an observation of so many entries.

        ``normalise.*`` are float64, as VecNormalize keeps them; all others are float32.
        """
        shapes: dict[str, tuple[int, ...]] = {}
        if self.normalised:
            shapes |= {f"{NORMALISATION}{name}": (entries,) for name in ("mean", "var")}
            shapes |= {f"{NORMALISATION}{name}": () for name in ("epsilon", "clip")}
        size = entries
        if self.lstm is not None:
            gates = LSTM_GATES * self.lstm
            shapes |= {"lstm.weight_ih": (gates, size), "lstm.weight_hh": (gates, self.lstm)}
            shapes |= {"lstm.bias_ih": (gates,), "lstm.bias_hh": (gates,)}
            size = self.lstm
        for i, width in enumerate(self.hidden):
            shapes |= {f"hidden.{i}.weight": (width, size), f"hidden.{i}.bias": (width,)}
            size = width
        shapes |= {"mean.weight": (ACTION_SIZE, size), "mean.bias": (ACTION_SIZE,)}
        if self.head == "gaussian":
            return shapes | {"log_std": (ACTION_SIZE,)}
        return shapes | {"log_std.weight": (ACTION_SIZE, size), "log_std.bias": (ACTION_SIZE,)}


class Card(Frozen):
    """Everything that is told of a learned policy. Times in s."""

    format_version: Literal[1]
    algorithm: Word  # PPO, SAC, RecurrentPPO, or what one's own trainer is called

    # What it was trained with, and has to be run with.
    action: Literal["twist", "wheel_speed", "torque", "residual"]
    action_scales: tuple[Positive, Positive]  # what 1.0 means: mm/s, rad/s, N·mm
    observation: Literal["tracking", "sensor"]
    entries: dict[str, Positive]  # of the observation, in order, and the value that is scaled to 1
    preview_s: tuple[NonNegative, ...]  # () for sensor, which has none
    control_period_s: Positive
    residual_base: Word | None = None  # gains that a residual is added to
    residual_fade_mm: NonNegative = 0.0  # estimated errors at which the residual counts half
    residual_reach_mm: Positive | None = None
    estimator: Word | None = None  # None: whatever the scenario has

    network: Network

    # How it was made: a record, which nothing reads.
    scenario: dict[str, JsonValue]  # the whole scenario of the training
    training: dict[str, JsonValue]  # settings of the algorithm, environment steps, wall time
    seeds: dict[str, tuple[int, ...]]  # what was seeded, and with what
    versions: dict[str, str]
    scores: dict[str, JsonValue]
    command: str  # that made it

    weights_sha256: Annotated[str, Field(pattern="^[0-9a-f]{64}$")]

    @model_validator(mode="after")
    def _check(self) -> Self:
        if (self.action == "residual") != (self.residual_base is not None):
            raise ValueError(
                f"residual_base goes with the action 'residual', and only with it; got "
                f"{self.residual_base!r} with {self.action!r}"
            )
        if self.action == "residual" and self.estimator is None:
            raise ValueError("estimator must be named where the action is 'residual'")
        return self

    def check_fit(self, name: str, scenario: Scenario) -> None:
        """Check that a scenario is what the policy was trained for.

        The estimator counts where the action is a residual; with another action the policy runs on
        whatever the scenario has.

        Raises
        ------
        ValueError
            naming the first difference, and what both have.
        """
        theirs = interface(scenario)
        for field in theirs:
            mine, its = getattr(self, field), theirs[field]
            if field == "estimator" and self.action != "residual":
                continue
            if field == "entries":
                mine, its = _first_difference(list(mine.items()), list(its.items()))
            if mine != its:
                raise ValueError(
                    f"policy {name!r} does not fit the scenario: it was trained with {field} "
                    f"{mine!r}, the scenario has {its!r}"
                )


class Loaded(NamedTuple):
    """What the two files of a policy hold, checked."""

    card: Card
    tensors: dict[str, np.ndarray]
    files: tuple[Path, Path]


def interface(scenario: Scenario) -> dict[str, Any]:
    """The fields of a card that a scenario fixes."""
    tracking = scenario.observation == "tracking"
    residual = scenario.action == "residual"
    entries = (
        tracking_entries(scenario.preview_s) if tracking else sensor_entries(scenario.substeps)
    )
    return {
        "control_period_s": scenario.control_period_s,
        "action": scenario.action,
        "residual_base": scenario.residual_base if residual else None,
        "residual_fade_mm": scenario.residual_fade_mm if residual else 0.0,
        "residual_reach_mm": scenario.residual_reach_mm if residual else None,
        "estimator": scenario.estimator,
        "observation": scenario.observation,
        "preview_s": scenario.preview_s if tracking else (),
        "entries": {name: entry.scale for name, entry in entries.items()},
        "action_scales": tuple(entry.scale for entry in ACTION_ENTRIES[scenario.action]),
    }


def _first_difference(mine: list[Any], theirs: list[Any]) -> tuple[str, str]:
    """How two lists of entries and scales differ, in words; twice the same if they do not."""
    if mine == theirs:
        return "", ""
    i = next(
        (i for i, pair in enumerate(zip(mine, theirs, strict=False)) if pair[0] != pair[1]),
        min(len(mine), len(theirs)),
    )

    def told(items: list[Any]) -> str:
        entry = f"{items[i][0]} (scale {items[i][1]:g})" if i < len(items) else "nothing"
        return f"{len(items)} in all, entry {i} is {entry}"

    return told(mine), told(theirs)


def write_policy(
    path: Path,
    network: Network,
    tensors: Tensors,
    scenario: Scenario,
    *,
    algorithm: str,
    training: Mapping[str, Any],
    seeds: Mapping[str, Iterable[int]],
    versions: Mapping[str, str],
    scores: Mapping[str, Any],
    command: str,
) -> Card:
    """Write ``NAME.safetensors`` and its card, each atomically; returns the card.

    Parameters
    ----------
    tensors
        As ``network.shapes(entries)`` says; kept as float32 (``normalise.*``: float64).
    scenario
        What the policy was trained on; its action, observation and on-board parts are what the
        policy will ask for.

    Raises
    ------
    ValueError
        if the name does not end in ``.safetensors``, a tensor is missing, unknown, of a wrong shape
        or not finite, or something told is not what a card can hold.
    """
    if path.suffix != WEIGHTS:
        raise ValueError(f"{path}: the name of a policy must end in {WEIGHTS}")
    # safetensors writes the memory behind an array, whatever its strides.
    kept = {
        name: np.array(tensor, dtype=_dtype(name), order="C") for name, tensor in tensors.items()
    }
    data = save(kept)
    try:
        card = Card(
            format_version=FORMAT_VERSION,
            algorithm=algorithm,
            **interface(scenario),
            network=network,
            scenario=scenario.model_dump(mode="json"),
            training=dict(training),
            seeds={name: tuple(values) for name, values in seeds.items()},
            versions=dict(versions),
            scores=dict(scores),
            command=command,
            weights_sha256=hashlib.sha256(data).hexdigest(),
        )
    except ValidationError as error:
        raise ValueError(f"{path.with_suffix(CARD)}: {one_line(error)}") from error
    check_tensors(path, card, kept)
    text = json.dumps(card.model_dump(mode="json"), indent=2, ensure_ascii=False, allow_nan=False)
    with atomic(path, "wb") as file:
        file.write(data)
    with atomic(path.with_suffix(CARD), encoding="utf-8") as file:
        file.write(text + "\n")
    return card


def read_policy(path: Path) -> Loaded:
    """Read ``NAME.safetensors`` and its card ``NAME.json``.

    Raises
    ------
    ValueError
        in one line: a file is missing or damaged, the card has an unknown key or a wrong value, the
        weights are not those of the card, or a tensor is missing, unknown, of a wrong shape or not
        finite.
    """
    data = _bytes_of(path, "")
    place = path.with_suffix(CARD)
    card = _card(place, _bytes_of(place, f"{path} needs its card: "))
    try:
        tensors = load(data)
    except (SafetensorError, KeyError, ValueError) as error:
        raise ValueError(
            f"{path} is not a whole safetensors file of plain numbers: {_line(error)}"
        ) from error
    found = hashlib.sha256(data).hexdigest()
    if found != card.weights_sha256:
        raise ValueError(
            f"{path} is not the file that {place.name} describes: its sha256 is {found}, the card has "
            f"{card.weights_sha256}"
        )
    check_tensors(path, card, tensors)
    return Loaded(card, tensors, (path, place))


def check_tensors(path: Path, card: Card, tensors: Tensors) -> None:
    """Check names, types, shapes and values of a policy's tensors.

    Raises
    ------
    ValueError
        naming the first tensor that is wrong.
    """
    shapes = card.network.shapes(len(card.entries))
    for name in sorted(shapes.keys() | tensors.keys()):
        if name not in tensors:
            raise ValueError(f"{path}: tensor {name!r} is missing")
        if name not in shapes:
            raise ValueError(f"{path}: the card's network has no tensor {name!r}")
        tensor = tensors[name]
        if tensor.shape != shapes[name]:
            raise ValueError(
                f"{path}: tensor {name!r} has the shape {tensor.shape}; the card's network has "
                f"{shapes[name]}"
            )
        if tensor.dtype != _dtype(name):
            raise ValueError(
                f"{path}: tensor {name!r} is {tensor.dtype}; it must be {_dtype(name)}"
            )
        if not np.isfinite(tensor).all():
            raise ValueError(f"{path}: tensor {name!r} holds a number that is not finite")
        if name.startswith(NORMALISATION) and not name.endswith("mean") and (tensor < 0).any():
            raise ValueError(f"{path}: tensor {name!r} holds a number below 0")
    if card.network.normalised:
        spread = tensors[f"{NORMALISATION}var"] + tensors[f"{NORMALISATION}epsilon"]
        if not (spread > 0).all():
            raise ValueError(f"{path}: normalise.var + normalise.epsilon must be above 0")


def _dtype(name: str) -> np.dtype[Any]:
    return np.dtype(np.float64 if name.startswith(NORMALISATION) else np.float32)


def _bytes_of(path: Path, why: str) -> bytes:
    try:
        return path.read_bytes()
    except OSError as error:
        raise ValueError(f"{why}cannot read {path}: {error.strerror}") from error


def _card(path: Path, data: bytes) -> Card:
    try:
        json.loads(data)
    except ValueError as error:  # told here: pydantic's message would hold the whole file
        raise ValueError(f"{path} is not JSON: {_line(error)}") from error
    try:
        return Card.model_validate_json(data, strict=True)
    except ValidationError as error:
        raise ValueError(f"{path}: {one_line(error)}") from error


def _line(error: Exception) -> str:
    return " ".join(str(error).split())
