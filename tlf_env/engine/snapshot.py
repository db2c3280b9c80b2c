"""A moment of a simulation: everything that its future depends on, in memory or in one file.

A snapshot holds numbers, and plain values as JSON. Its file is a safetensors file: nothing in it is pickled,
and reading it runs no code.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save

import tlf_env
from tlf_env.common.errors import path_text, shown
from tlf_env.common.files import atomic, parse_json
from tlf_env.common.models import LARGEST
from tlf_env.engine.arrays import FROM_SCENARIO, Arrays, Variants
from tlf_env.engine.layout import in_array
from tlf_env.numerics.compiled import simulation_digest
from tlf_env.onboard.calibration import Belief
from tlf_env.onboard.memory import packed, unpacked
from tlf_env.physics.vehicle import Mass
from tlf_env.task.info import EndReason, TouchedBy
from tlf_env.task.scenario import Scenario

FORMAT = "tlf_env snapshot 1"  # of the file; a reader refuses every other
LIBRARIES = ("numba", "pymunk")  # whose version decides about bits
Layout = Mapping[
    str, tuple[Any, tuple[int | None, ...]]
]  # dtype and shape, None where any length fits


# Constants of an episode that its start changes (a payload, calibration, the period of fixes), those of them
# whose sign may change, too, and those that are at most 1.
CHANGED_AT_START = {
    "body": Mass._fields,
    "belief": Belief._fields,
    "slip_ekf": ("variance_weight", "mean_weight", "threshold"),
    "gyro_ekf": ("variance_weight",),
}
MAY_CHANGE_SIGN = ("d", "q", "w_ef", "outline_ahead")
WEIGHTS = [in_array("slip_ekf", "variance_weight"), in_array("slip_ekf", "mean_weight")]
WEIGHTS.append(in_array("gyro_ekf", "variance_weight"))

# Arrays that may hold NaN: no value was set there.
UNDEFINED = ("imposed", "infos")  # NaN: not imposed, not computed


class Snapshot:
    """Everything that the future of an environment or a plant depends on, at one moment.

    ``get_state()`` makes one, and ``set_state(snapshot)`` goes back to it, in the same object, in another one
    that was made with the same arguments, or in another process. It does not change when the simulation goes
    on, it can be pickled, and two are equal if all their numbers are, bit for bit.
    """

    def __init__(
        self,
        kind: str,
        fits: Mapping[str, Any],
        memory: Mapping[str, Any],
        numbers: Mapping[str, np.ndarray],
    ) -> None:
        self._kind = kind
        self._fits = dict(fits)  # JSON values that have to be equal where it is put back
        self._memory = dict(memory)  # JSON values, see :func:`tlf_env.onboard.memory.packed`
        self._numbers = dict(numbers)
        for array in self._numbers.values():
            array.flags.writeable = False

    @property
    def kind(self) -> str:
        """Name of the class whose state it is, as ``"FormationParallelEnv"``."""
        return self._kind

    @property
    def numbers(self) -> Mapping[str, np.ndarray]:
        """All arrays by name; they cannot be written."""
        return dict(self._numbers)

    @property
    def nbytes(self) -> int:
        """Size of all numbers, bytes."""
        return sum(array.nbytes for array in self._numbers.values())

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, Snapshot):
            return NotImplemented
        mine, theirs = (
            (one._kind, one._fits, one._memory, [*one._numbers]) for one in (self, other)
        )
        return mine == theirs and all(
            _same(array, other._numbers[name]) for name, array in self._numbers.items()
        )

    __hash__ = None  # type: ignore[assignment]

    def __reduce__(self) -> Any:
        return Snapshot, (self._kind, self._fits, self._memory, self._numbers)

    def __repr__(self) -> str:
        return f"<Snapshot of a {self._kind}, {self.nbytes} bytes>"

    def within(
        self,
        kind: str,
        fits: Mapping[str, Any],
        memory: Mapping[str, Any],
        trees: Mapping[str, Any],
        numbers: Mapping[str, np.ndarray],
    ) -> Snapshot:
        """The snapshot of an object that contains this one's, with what it has in addition.

        ``memory`` has plain values, which :meth:`recall` returns; ``trees`` JSON values whose arrays are in
        ``numbers``, which :meth:`tree` returns.
        """
        all_numbers = {**self._numbers, **numbers}
        kept = {
            name: packed(value, f"memory/{name}", all_numbers, name)
            for name, value in memory.items()
        }
        return Snapshot(
            kind, {**self._fits, **fits}, {**self._memory, **kept, **trees}, all_numbers
        )

    def check(self, kind: str, fits: Mapping[str, Any]) -> None:
        """Refuse a snapshot of something else.

        Raises
        ------
        ValueError
            in one line that names the first difference.
        """
        if self._kind != kind:
            raise ValueError(f"the snapshot is of a {self._kind}, not of a {kind}")
        for name, here in fits.items():
            if self._fits.get(name) == here:
                continue
            found = difference(self._fits.get(name), here, name)
            if found is not None:
                place, theirs, mine = found
                raise ValueError(
                    f"the snapshot does not fit: {place} is {_text(mine)} here, and {_text(theirs)} in it"
                )

    def recall(self, name: str) -> Any:
        """A plain value by its name.

        Raises
        ------
        ValueError
            if the snapshot has none of this name.
        """
        try:
            return unpacked(self._memory[name], self._numbers)
        except (KeyError, ValueError) as error:
            raise ValueError(f"the snapshot is damaged: it has no {name!r}") from error

    def tree(self, name: str) -> Any:
        """A JSON value by its name."""
        if name not in self._memory:
            raise ValueError(f"the snapshot is damaged: it has no {name!r}")
        return self._memory[name]

    def part(
        self, name: str, layout: Layout, undefined: tuple[str, ...] = ()
    ) -> dict[str, np.ndarray]:
        """The arrays whose names begin with ``name/``, by the rest of their names.

        Parameters
        ----------
        layout
            Their names, dtypes and shapes.
        undefined
            Names of those that may hold NaN.

        Raises
        ------
        ValueError
            in one line, for an array that is missing or of another dtype or shape, or for a number that is
            not finite, or so large that no episode has it.
        """
        found = {}
        for key, (dtype, shape) in layout.items():
            array = self._numbers.get(f"{name}/{key}")
            what = f"the snapshot does not fit: {name}/{key}"
            if array is None:
                raise ValueError(f"{what} is missing")
            if array.dtype != dtype:
                raise ValueError(f"{what} has the type {array.dtype}, not {np.dtype(dtype)}")
            sizes = zip(array.shape, shape, strict=False)
            if array.ndim != len(shape) or any(n is not None and m != n for m, n in sizes):
                wanted = tuple("any" if n is None else n for n in shape)
                raise ValueError(f"{what} has the shape {array.shape}, not {wanted}")
            if array.dtype.kind == "f":
                known = array[~np.isnan(array)] if key in undefined else array
                if not np.isfinite(known).all():
                    raise ValueError(f"{what} has a number that is not finite")
                if (np.abs(known) > LARGEST).any():
                    raise ValueError(f"{what} has a number beyond ±{LARGEST:g}")
            found[key] = array
        return found

    def save(self, path: str | Path) -> None:
        """Write the snapshot to one file, which appears under its name only when it is complete.

        Raises
        ------
        ValueError
            in one line, if the file cannot be written.
        """
        path = Path(path)
        about = {
            "kind": self._kind,
            **_writer(),
            "fits": self._fits,
            "memory": self._memory,
            "order": [*self._numbers],
        }
        text = json.dumps(about)
        metadata = {"format": FORMAT, "about": text, "sha256": _checksum(text, self._numbers)}
        data = save(
            {name: np.ascontiguousarray(one) for name, one in self._numbers.items()}, metadata
        )
        try:
            with atomic(path, "wb") as file:
                file.write(data)
        except OSError as error:
            raise ValueError(f"cannot write {path_text(path)}: {error.strerror}") from error

    @classmethod
    def load(cls, path: str | Path) -> Snapshot:
        """Read a file that :meth:`save` has written; it runs no code.

        Raises
        ------
        ValueError
            in one line that names the file, if it is missing, damaged, no snapshot, or written by other code
            of tlf_env or with another version of Numba or pymunk: its future would not be the same.
        """
        path = Path(path)
        metadata, numbers = _read(path)
        if metadata.get("format") != FORMAT:
            raise ValueError(
                f"{path_text(path)} has the format {shown(metadata.get('format'))}, not {FORMAT!r}"
            )
        here = _writer()
        try:
            about = parse_json(metadata["about"])
            if metadata["sha256"] != _checksum(metadata["about"], numbers):
                raise ValueError
            written = {name: about[name] for name in here}
            ordered = {name: numbers[name] for name in about["order"]}
            loaded = cls(about["kind"], about["fits"], about["memory"], ordered)
        except (KeyError, ValueError, TypeError, AttributeError) as error:
            raise ValueError(f"{path_text(path)} is damaged") from error
        found = difference(written, here, "")
        if found is not None:
            place, theirs, mine = found
            raise ValueError(
                f"{path_text(path)} was written with another {NAMES.get(place, place)}: {_text(theirs)}; "
                f"here it is {_text(mine)}"
            )
        return loaded


NAMES = {
    "package": "version of tlf_env",
    "code": "code of the simulation",
    **{f"libraries.{name}": f"version of {name}" for name in LIBRARIES},
}


def _writer() -> dict[str, Any]:
    """What decides about bits, and is recorded in a file."""
    return {
        "package": tlf_env.__version__,
        "code": simulation_digest(),
        "libraries": {name: version(name) for name in LIBRARIES},
    }


def _read(path: Path) -> tuple[dict[str, str], dict[str, np.ndarray]]:
    """Metadata and arrays of a safetensors file."""
    try:
        with path.open("rb"):  # safetensors gives no reason for a file that cannot be read
            pass
        with safe_open(path, framework="numpy") as file:
            metadata = file.metadata() or {}
            names = list(file.keys())  # safetensors' file cannot be iterated
            return metadata, {name: file.get_tensor(name) for name in names}
    except OSError as error:
        raise ValueError(f"cannot read {path_text(path)}: {error.strerror}") from error
    except (SafetensorError, KeyError, TypeError, ValueError) as error:
        why = " ".join(str(error).split())
        raise ValueError(f"{path_text(path)} is damaged, or no snapshot: {why}") from error


def _checksum(about: str, numbers: Mapping[str, np.ndarray]) -> str:
    digest = hashlib.sha256(about.encode())
    for name in sorted(numbers):
        array = numbers[name]
        digest.update(f"\0{name} {array.dtype.str} {array.shape}\0".encode())
        digest.update(np.ascontiguousarray(array).data)
    return digest.hexdigest()


def _same(one: np.ndarray, other: np.ndarray) -> bool:
    return (
        one.dtype == other.dtype and one.shape == other.shape and one.tobytes() == other.tobytes()
    )


def _text(value: Any) -> str:
    return "missing" if value is MISSING else shown(value)


MISSING = object()


def difference(one: Any, other: Any, place: str = "") -> tuple[str, Any, Any] | None:
    """Where two JSON values first differ, and both values there; None if they are equal."""
    if isinstance(one, dict) and isinstance(other, dict):
        for key in [*one, *(key for key in other if key not in one)]:
            inner = f"{place}.{key}" if place else str(key)
            found = difference(one.get(key, MISSING), other.get(key, MISSING), inner)
            if found is not None:
                return found
        return None
    if isinstance(one, list) and isinstance(other, list):
        if len(one) != len(other):
            return f"the number of {place}" if place else "the length", len(one), len(other)
        for i, pair in enumerate(zip(one, other, strict=True)):
            found = difference(*pair, f"{place}[{i}]")
            if found is not None:
                return found
        return None
    return None if type(one) is type(other) and one == other else (place, one, other)


def checked_generator(value: Any) -> np.random.Generator | None:
    """A random generator of a snapshot, or None.

    Raises
    ------
    ValueError
        for anything else.
    """
    if value is None or isinstance(value, np.random.Generator):
        return value
    raise ValueError("the snapshot is damaged: its random generator is none")


def scenario_facts(scenario: Scenario) -> dict[str, Any]:
    """All fields of a scenario but its name, as JSON values."""
    return scenario.model_dump(mode="json", exclude={"name"})


def array_numbers(arrays: Arrays) -> dict[str, np.ndarray]:
    """Copies of all arrays of an episode that do not follow from the scenario, named for a snapshot."""
    return {
        f"arrays/{name}": array.copy()
        for name, array in arrays._asdict().items()
        if name not in FROM_SCENARIO
    }


def checked_arrays(
    snapshot: Snapshot,
    arrays: Arrays,
    variants: Variants,
    scenario: Scenario,
    counts: tuple[int, int],
    started: np.ndarray,
) -> dict[str, np.ndarray]:
    """The arrays of a snapshot that are to replace those in ``arrays``.

    Parameters
    ----------
    variants
        Constants of the scenarios that lanes may run.
    counts
        How many scenarios and tables of the reference there are.
    started
        ``(lane,)``: the formations that have begun an episode.

    Raises
    ------
    ValueError
        in one line, if one does not fit, or holds a number that no episode can have.
    """
    layout = {
        name: (array.dtype, array.shape)
        for name, array in arrays._asdict().items()
        if name not in FROM_SCENARIO
    }
    found = snapshot.part("arrays", layout, UNDEFINED)
    if not np.array_equal(found["kinds"], arrays.kinds):
        raise ValueError("the snapshot does not fit: its robots have other kinds of actions")
    substeps, steps, episodes, ends = found["clock"].T
    wrong = (
        ((found["variants"] < 0) | (found["variants"] >= counts[0])).any()
        or ((found["routes"] < 0) | (found["routes"] >= counts[1])).any()
        or ((steps < 0) | (steps > ends) | (ends > scenario.horizon_steps)).any()
        or (substeps != steps * scenario.substeps).any()
        or (episodes < 0).any()
        or (found["seeds"] < 0).any()
        or not np.isin(found["ends"], [int(end) for end in EndReason]).all()
        or not np.isin(found["touched_by"], [int(thing) for thing in TouchedBy]).all()
    )
    if wrong:
        raise ValueError(
            "the snapshot is damaged: its episode has a step, seed or number out of range"
        )
    _check_constants(found["constants"], variants.constants, found["variants"], started)
    return found


def _check_constants(
    found: np.ndarray, scenarios: np.ndarray, variants: np.ndarray, started: np.ndarray
) -> None:
    """Check an episode's constants against those of its scenario, (field, robot, lane) and variant.

    The start of an episode changes what a payload, calibration and the period of fixes change, and nothing of
    it from above 0 to 0 or below.

    Raises
    ------
    ValueError
        for constants that the scenario cannot have.
    """
    lanes = np.flatnonzero(started)
    here, there = found[:, :, lanes], scenarios[:, :, variants[lanes]]
    same = here == there
    for name, fields in CHANGED_AT_START.items():
        part = [in_array(name, field) for field in fields]
        same[part] |= (here[part] > 0.0) | (there[part] <= 0.0)
    for field in MAY_CHANGE_SIGN:
        same[in_array("body", field)] = True
    same[WEIGHTS] &= here[WEIGHTS] <= 1.0
    if not same.all():
        raise ValueError("the snapshot is damaged: its robots have constants of another scenario")


def put_arrays(arrays: Arrays, found: Mapping[str, np.ndarray]) -> None:
    """Write arrays of :func:`checked_arrays` in place, so that views stay valid."""
    for name, array in found.items():
        getattr(arrays, name)[...] = array


def checked_snapshot(value: Any) -> Snapshot:
    """A snapshot.

    Raises
    ------
    TypeError
        in one line, for anything else.
    """
    if not isinstance(value, Snapshot):
        raise TypeError(
            f"the state must be a tlf_env.Snapshot, as of get_state(), got {shown(value)}"
        )
    return value
