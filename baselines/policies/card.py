"""A learned policy on disk: its tensors in ``NAME.safetensors``, and its card in ``NAME.json``.

The card describes the network, its observation and action, and how it was made. Neither file can hold
code, so a policy from an unknown source can be loaded safely.
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

from baselines.policies.columns import Columns, find_scaled_columns
from baselines.policies.network import NORMALISATION, Network
from tlf_env.common.errors import one_line
from tlf_env.common.files import atomic, parse_json
from tlf_env.common.models import Frozen, NonNegative, Positive, Whole
from tlf_env.common.presets import check_named_files
from tlf_env.onboard.limiters import Limiter
from tlf_env.onboard.parts import is_part
from tlf_env.onboard.rays import Rays
from tlf_env.onboard.supervisor import Neighbour
from tlf_env.task.actions import ActionKind
from tlf_env.task.observation import SAMPLE_ENTRIES, sensor_entries, tracking_entries
from tlf_env.task.scenario import Scenario

FORMAT_VERSION: Final = 1
WEIGHTS, CARD = ".safetensors", ".json"

Word = Annotated[str, Field(min_length=1)]
Tensors = Mapping[str, np.ndarray]


class Card(Frozen):
    """Description of a learned policy. Times in s."""

    format_version: Literal[1]
    algorithm: Word  # PPO, SAC, RecurrentPPO, or the name of another trainer

    # What it was trained with, and has to be run with.
    action: ActionKind
    action_scales: tuple[Positive, Positive]  # value of 1.0: mm/s, rad/s, N·mm
    tracking_fade_mm: NonNegative = (
        0.0  # estimated error at which `tracking_twist` has half its range
    )
    limiter: Limiter | None = None  # of the action's twist; None: it is not limited
    observation: Literal["tracking", "sensor"]
    entries: dict[str, Positive]  # that the policy takes, in its order, with their scales
    preview_s: tuple[NonNegative, ...]  # () for sensor, which has none
    rays: Rays | None = None  # None: it takes none, whether there are range sensors or not
    neighbour: Neighbour | None = None  # likewise
    control_period_s: Positive
    residual_base: Word | None = None  # gains of the base that a residual is added to
    residual_fade_mm: NonNegative = 0.0  # estimated errors at which the residual counts half
    residual_reach_mm: Positive | None = None
    estimator: Word | None = None  # None: the scenario's
    broadcast_smoothing_s: NonNegative | None = 0.0  # None: as the scenario finds room for

    network: Network

    # How it was made: a record that no code reads.
    scenario: dict[str, JsonValue]  # the whole scenario of the training
    training: dict[str, JsonValue]  # settings of the algorithm, environment steps, wall time
    seeds: dict[str, tuple[Whole, ...]]  # seeds of everything that was seeded
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
        if is_part(self.residual_base):
            raise ValueError(
                f"residual_base {self.residual_base!r} is a policy in Python, which would be run; a card may "
                "name a controller's preset or file"
            )
        if self.action == "residual" and self.estimator is None:
            raise ValueError("estimator must be named if the action is 'residual'")
        if self.network.history is not None:
            self.network.history.places(self.entries)
        return self

    @property
    def samples(self) -> int:
        """Samples of a ``sensor`` observation; 0 for ``tracking``."""
        first = f"{next(iter(SAMPLE_ENTRIES))}_"
        return sum(name.startswith(first) for name in self.entries)

    def fit(self, name: str, scenario: Scenario) -> Columns:
        """The columns of a scenario's observation that the policy takes, found by name.

        The observation may have further entries, in another order, and further previews. The estimator
        counts only if the action is a residual; other policies run with the scenario's estimator. Broadcasts
        may be smoothed or not.

        Raises
        ------
        ValueError
            naming the first difference that the policy cannot run with, and both values.
        """
        theirs = interface(scenario)
        if set(self.preview_s) <= set(theirs["preview_s"]):
            theirs["preview_s"] = self.preview_s
        for optional in ("rays", "neighbour"):
            if getattr(self, optional) is None:
                theirs[optional] = None
        if self.action != "residual":
            theirs["estimator"] = self.estimator
        theirs["broadcast_smoothing_s"] = self.broadcast_smoothing_s
        offered = theirs.pop("entries")
        try:
            for field, value in theirs.items():
                if getattr(self, field) != value:
                    raise ValueError(
                        f"it was trained with {field} {getattr(self, field)!r}, the scenario has "
                        f"{value!r}"
                    )
            if self.samples and self.samples != scenario.substeps:
                raise ValueError(
                    f"it was trained with {self.samples} samples in an observation, the scenario has "
                    f"{scenario.substeps}"
                )
            return find_scaled_columns(self.entries, offered)
        except ValueError as error:
            raise ValueError(f"policy {name!r} does not fit the scenario: {error}") from error

    def own_columns(self) -> Columns:
        """The columns of the observation with the card's previews and samples, and nothing more.

        Raises
        ------
        ValueError
            naming an entry that the observation lacks, or that has another scale.
        """
        return find_scaled_columns(
            self.entries,
            _scales(self.observation, self.preview_s, self.samples, self.rays, self.neighbour),
        )


class Loaded(NamedTuple):
    """Checked content of the two files of a policy."""

    card: Card
    tensors: dict[str, np.ndarray]
    files: tuple[Path, Path]


def _scales(
    observation: str,
    preview_s: tuple[float, ...],
    samples: int,
    rays: Rays | None,
    neighbour: Neighbour | None,
) -> dict[str, float]:
    """Entries of an observation and their scales, in order."""
    if observation == "tracking":
        entries = tracking_entries(preview_s, rays, neighbour)
    else:
        entries = sensor_entries(samples, rays)
    return {name: entry.scale for name, entry in entries.items()}


def interface(scenario: Scenario) -> dict[str, Any]:
    """The fields of a card that a scenario determines."""
    residual, limiter = scenario.action == "residual", scenario.action_limiter
    previews = scenario.preview_s if scenario.observation == "tracking" else ()
    return {
        "control_period_s": scenario.control_period_s,
        "action": scenario.action,
        "tracking_fade_mm": scenario.action_fade_mm if scenario.action == "tracking_twist" else 0.0,
        "limiter": None if limiter == Limiter() else limiter,
        "residual_base": scenario.residual_base if residual else None,
        "residual_fade_mm": scenario.residual_fade_mm if residual else 0.0,
        "residual_reach_mm": scenario.residual_reach_mm if residual else None,
        "estimator": scenario.estimator,
        "broadcast_smoothing_s": scenario.broadcast_smoothing_s,
        "observation": scenario.observation,
        "preview_s": previews,
        "rays": scenario.rays,
        "neighbour": scenario.neighbour,
        "entries": _scales(
            scenario.observation, previews, scenario.substeps, scenario.rays, scenario.neighbour
        ),
        "action_scales": tuple(entry.scale for entry in scenario.action_entries),
    }


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
        Tensors with the names and shapes of ``network.shapes(entries)``; stored as float32
        (``normalise.*``: float64).
    scenario
        The scenario of the training. The policy will ask for its action, observation and on-board
        parts.

    Raises
    ------
    ValueError
        if the name does not end in ``.safetensors``, a tensor is missing, unknown, of a wrong shape
        or not finite, or a value is not allowed in a card.
    """
    if path.suffix.lower() != WEIGHTS:
        raise ValueError(f"{path}: the name of a policy must end in {WEIGHTS}")
    # safetensors writes the memory of an array and ignores its strides.
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
        raise ValueError(f"{card_path(path)}: {one_line(error, Card)}") from error
    check_tensors(path, card, kept)
    text = json.dumps(card.model_dump(mode="json"), indent=2, ensure_ascii=False, allow_nan=False)
    with atomic(path, "wb") as file:
        file.write(data)
    with atomic(card_path(path), encoding="utf-8") as file:
        file.write(text + "\n")
    return card


def card_path(path: Path) -> Path:
    """The card of a policy's weights: ``NAME.json``, or ``NAME.JSON`` if that is the file there is."""
    card = path.with_suffix(CARD)
    shouted = path.with_suffix(CARD.upper())
    return shouted if shouted.exists() and not card.exists() else card


def read_policy(path: Path) -> Loaded:
    """Read ``NAME.safetensors`` and its card ``NAME.json``.

    Raises
    ------
    ValueError
        in one line: a file is missing or damaged, the card has an unknown key or a wrong value or names a
        file elsewhere, the weights are not those of the card, or a tensor is missing, unknown, of a wrong
        shape or not finite.
    """
    data = _bytes_of(path, "")
    place = card_path(path)
    card = _card(place, _bytes_of(place, f"{path} needs its card: "))
    check_named_files(place, card.residual_base)
    try:
        tensors = load(data)
    except (SafetensorError, KeyError, ValueError) as error:
        raise ValueError(
            f"{path} is not a complete safetensors file of plain numbers: {_line(error)}"
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
        parse_json(data)  # here, as pydantic's message would contain the whole file
    except ValueError as error:
        raise ValueError(f"{path} is not JSON: {_line(error)}") from error
    try:
        return Card.model_validate_json(data, strict=True)
    except ValidationError as error:
        raise ValueError(f"{path}: {one_line(error, Card)}") from error


def _line(error: Exception) -> str:
    return " ".join(str(error).split())
