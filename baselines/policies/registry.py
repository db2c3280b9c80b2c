"""Policies by name, for the command line and the benchmark."""

from __future__ import annotations

import hashlib
import inspect
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple, TypeGuard

from pydantic import BaseModel

from baselines.policies.card import WEIGHTS
from baselines.policies.entries import EntryPolicy, make_entry
from baselines.policies.laws.catalogue import LAWS, make_law
from baselines.policies.laws.law import Law
from baselines.policies.learned import LearnedPolicy, load_policy, shipped_policies
from baselines.policies.reference import ReferencePolicy
from baselines.policies.systems import (
    ENTRY,
    ESTIMATORS,
    LimitedLaw,
    make_system,
    parse_system,
    system_controllers,
)
from tlf_env.common.digest import code_of
from tlf_env.common.errors import install_command, shown, suggestion
from tlf_env.common.trust import ISOLATED, Trust
from tlf_env.hosting.host import HostedPolicy
from tlf_env.onboard.kinds import DEFAULT_CONTROLLER
from tlf_env.onboard.parts import Policy, load_part, make_part, runs_apart
from tlf_env.task.actions import ACTION_SIZE
from tlf_env.task.observation import tracking_entries
from tlf_env.task.scenario import Scenario, load_scenario

# Fields of the scenario that a policy may ask for: its observation, its action and the on-board parts.
# The task and the disturbance are not among them: they are the same for all policies.
OVERRIDABLE = (
    "action",
    "action_range",
    "tracking_fade_mm",
    "limiter",
    "observation",
    "residual_base",
    "residual_fade_mm",
    "residual_reach_mm",
    "estimator",
    "ekf_slip",
    "ekf_gyro",
    "broadcast_smoothing_s",
    "preview_s",
    "rays",
    "neighbour",
)


# Fields that lengthen the observation, for which a law is made.
MADE_FOR = ("preview_s", "rays", "neighbour")


# Functions that are called with a policy in a process of its own, and what loads an SB3 file there.
ABOUT, LOADER, ASKED, BIND = (
    f"{__name__}:{name}" for name in ("facts_of", "load_zip", "asked_by", "bind_to")
)


class OwnProcess(HostedPolicy):
    """A policy in a process of its own, with what the benchmark has to know of it."""

    @property
    def privileged(self) -> bool:
        """Whether it uses the true state."""
        return bool(self.facts.get("privileged"))

    @property
    def scenario_overrides(self) -> Any:
        """Scenario fields that it asks for."""
        return self.facts.get("scenario_overrides", {})

    @property
    def supervisor(self) -> Any:
        """Not None if it looks out for a neighbour."""
        return self.facts.get("supervisor")

    @property
    def files(self) -> list[Path]:
        """Files that it is made from."""
        return [Path(str(path)) for path in self.facts.get("files", ())]

    @property
    def learned(self) -> bool:
        """Whether it is a learned policy, which has to be fitted to a scenario."""
        return bool(self.facts.get("learned"))

    def overrides_for(self, scenario: Scenario) -> Any:
        """As :meth:`LearnedPolicy.overrides_for`."""
        return self.tell(ASKED, scenario.model_dump(mode="json"))

    def bind(self, name: str, scenario: Scenario) -> None:
        """As :meth:`LearnedPolicy.bind`."""
        self.tell(BIND, name, scenario.model_dump(mode="json"))


def asked_by(policy: LearnedPolicy, scenario: Mapping[str, Any]) -> dict[str, Any]:
    """Scenario fields that a learned policy needs, as JSON values, for a scenario as JSON values."""
    asked = policy.overrides_for(Scenario.model_validate(scenario))
    return {field: _plain(value) for field, value in asked.items()}


def bind_to(policy: LearnedPolicy, name: str, scenario: Mapping[str, Any]) -> None:
    """Fit a learned policy to a scenario as JSON values."""
    policy.bind(name, Scenario.model_validate(scenario))


def facts_of(policy: Policy) -> dict[str, Any]:
    """What :class:`OwnProcess` needs to know of a policy, as JSON values.

    Raises
    ------
    ValueError
        for an entry, which has a process of its own.
    """
    if isinstance(policy, EntryPolicy):
        raise ValueError(
            "a factory of an entry cannot run in a process of its own; use entry:FOLDER"
        )
    asked = getattr(policy, "scenario_overrides", {})
    supervised = getattr(policy, "supervisor", None) is not None
    return {
        "learned": isinstance(policy, LearnedPolicy),
        "privileged": bool(getattr(policy, "privileged", False)),
        "scenario_overrides": {str(field): _plain(value) for field, value in asked.items()}
        if isinstance(asked, Mapping)
        else shown(asked),
        "supervisor": True if supervised else None,
        "files": [str(path.absolute()) for path in _source_files(policy)],
    }


def is_learned(policy: Policy) -> TypeGuard[LearnedPolicy | OwnProcess]:
    """Whether a policy has to be fitted to a scenario."""
    return isinstance(policy, LearnedPolicy) or (isinstance(policy, OwnProcess) and policy.learned)


class FittedPolicy(NamedTuple):
    """A policy, and the scenario with the fields that the policy asks for."""

    policy: Policy
    scenario: Scenario
    overrides: dict[str, Any]  # fields that differ from the given scenario, as JSON values


def policy_names() -> list[str]:
    """Names of the policies that are not learned; they need no file."""
    return system_controllers()


def make_policy(name: str, scenario: Scenario, *, trust: Trust = False) -> Policy:
    """A policy that fits a scenario.

    Parameters
    ----------
    name
        ``reference`` (the default controller) or ``reference:GAINS``, where GAINS is a preset or the path
        of a controller file (``.yaml``), a law of :data:`LAWS` such as ``kanayama`` (each also with
        ``:PARAMETERS``, a preset or the path of a ``.yaml`` file), a system
        ``CONTROLLER+ESTIMATOR+LIMITER`` of such a controller, the name of a shipped learned policy, the
        path of a ``.safetensors`` file (with its card in the same folder), ``module:factory`` of an object
        with SB3's ``predict``, ``entry:FOLDER`` of a competition's entry, or the path of an SB3 ``.zip``
        file.
    trust
        Allow ``module:factory``, an SB3 ``.zip`` file and an entry's program: all of them run code, the first
        two in this process (True) or in one of its own (``"isolated"``), an entry always in its own.

    Raises
    ------
    ValueError
        for an unknown name, a file that cannot be read, code without permission, or a policy that does
        not fit the scenario.
    """
    policy = _made(name, scenario, trust=trust)
    if is_learned(policy):
        policy.bind(name, scenario)
    _check_heard(name, policy, scenario)
    return policy


def fit_policy(name: str, scenario: Scenario, *, trust: Trust = False) -> FittedPolicy:
    """A policy, and the scenario with the fields that the policy asks for.

    A policy asks by an attribute ``scenario_overrides``, which maps fields of :data:`OVERRIDABLE` to
    values; a learned policy has it from its card. A field that the scenario's file or the caller has
    set keeps its value. Parameters of a filter that a system's name sets are merged with those that the
    scenario sets.

    Parameters
    ----------
    name, trust
        As for :func:`make_policy`.

    Raises
    ------
    ValueError
        as for :func:`make_policy`, if a policy asks for a field that it may not set, or for an invalid
        value, and if a system names another estimator, or another value of its parameters, than the file or
        the caller has set.
    """
    policy = _made(name, scenario, trust=trust)
    asked = _asked(name, policy, scenario)
    if asked:
        try:
            fitted = load_scenario(scenario, **asked)
        except ValueError as error:
            raise ValueError(f"policy {name!r} asks for an invalid scenario: {error}") from error
        differing = {
            field: getattr(fitted, field)
            for field in asked
            if getattr(fitted, field) != getattr(scenario, field)
        }
        asked = {field: _plain(value) for field, value in differing.items()}
        scenario = fitted if asked else scenario
        if asked.keys() & MADE_FOR and isinstance(policy, Law | LimitedLaw):
            policy = _made(name, scenario, trust=trust)
    if is_learned(policy):
        policy.bind(name, scenario)
    elif isinstance(policy, EntryPolicy):
        policy.bind(scenario)
    _check_heard(name, policy, scenario)
    return FittedPolicy(policy, scenario, asked)


def _check_heard(name: str, policy: Policy, scenario: Scenario) -> None:
    """Check that a system with a supervisor has a neighbour to look out for."""
    if getattr(policy, "supervisor", None) is not None and scenario.neighbour is None:
        raise ValueError(
            f"system {name!r} has a supervisor, which needs the scenario's field neighbour; it is None"
        )


def _plain(value: Any) -> Any:
    """A scenario's field as a JSON value."""
    if isinstance(value, BaseModel):
        return value.model_dump()
    return list(value) if isinstance(value, tuple) else value


def describe_overrides(overrides: Mapping[str, Any]) -> list[str]:
    """The fields that a policy asks for, in words: one text for each field and its value."""
    texts = []
    for field, value in overrides.items():
        if isinstance(value, Mapping):
            texts.append(f"own {field}")
        elif isinstance(value, list):
            texts.append(f"{field} {', '.join(map(str, value))}")
        else:
            texts.append(f"{field} {value}")
    return texts


def _asked(name: str, policy: Policy, scenario: Scenario) -> dict[str, Any]:
    """Fields that a policy asks for and that are not set yet."""
    if is_learned(policy):
        asked: Any = policy.overrides_for(scenario)
    else:
        asked = getattr(policy, "scenario_overrides", {})
    if not isinstance(asked, Mapping) or set(asked) - set(OVERRIDABLE):
        raise ValueError(
            f"policy {name!r}: scenario_overrides must map fields of {', '.join(OVERRIDABLE)}; "
            f"got {asked!r}"
        )
    named: Mapping[str, Any] = {}
    system = parse_system(name)
    if system is not None:
        named = ESTIMATORS[system.estimator]
        _check_named(name, named, scenario)
    # Parameters of a filter that a system's name sets are merged with those that the scenario sets.
    free = {
        field
        for field in asked
        if field not in scenario.model_fields_set or isinstance(named.get(field), Mapping)
    }
    return {field: asked[field] for field in asked if field in free}


def _check_named(name: str, named: Mapping[str, Any], scenario: BaseModel, group: str = "") -> None:
    """Check that the scenario sets no other value of a field that a system's name sets."""
    for field, value in named.items():
        if field not in scenario.model_fields_set:
            continue
        given = getattr(scenario, field)
        if isinstance(value, Mapping):
            _check_named(name, value, given, f"{field}.")
        elif given != value:
            raise ValueError(
                f"system {name!r} names the {group}{field} {value!r}; the scenario sets {given!r}"
            )


def _made(name: str, scenario: Scenario, *, trust: Trust) -> Policy:
    if name.startswith(ENTRY):
        return make_entry(name, scenario, trust=trust)
    if name.lower().endswith(".zip"):
        return _stable_baselines(Path(name), scenario, trust=trust)
    if name.lower().endswith(WEIGHTS) or name in shipped_policies():
        return load_policy(name)
    system = parse_system(name)
    if system is not None:
        check_interface(name, scenario, action="twist", observation="tracking")
        return make_system(system, scenario)
    head, _, tail = name.partition(":")
    if head == "reference" and name != "reference:":
        check_interface(name, scenario, action="twist", observation="tracking")
        return ReferencePolicy(
            tail or DEFAULT_CONTROLLER, scenario.control_period_s, scenario.preview_s
        )
    if head in LAWS:
        check_interface(name, scenario, action="twist", observation="tracking")
        return make_law(head, tail, scenario)
    if runs_code(name):
        if runs_apart(name, trust):
            return OwnProcess("policy", name, ACTION_SIZE, about=ABOUT)
        return make_part("policy", name, load_part("policy", name, trust=trust))
    names = [*policy_names(), *shipped_policies()]
    raise ValueError(
        f"policy {name!r} is not one of {', '.join(names)}, FILE{WEIGHTS}, module:factory, FILE.zip, "
        f"{ENTRY}FOLDER{suggestion(name, names)}"
    )


def runs_code(name: str) -> bool:
    """Whether a policy's name stands for code, which needs ``trust``; an entry of either kind counts."""
    if name.startswith(ENTRY) or name.lower().endswith(".zip"):
        return True
    if name.lower().endswith(WEIGHTS) or name in shipped_policies() or parse_system(name):
        return False
    head, _, tail = name.partition(":")
    return bool(tail) and head != "reference" and head not in LAWS


def check_interface(name: str, scenario: Scenario, *, action: str, observation: str) -> None:
    """Check that a policy's action and observation are the scenario's.

    Raises
    ------
    ValueError
        naming both pairs.
    """
    if (scenario.action, scenario.observation) != (action, observation):
        raise ValueError(
            f"policy {name!r} takes {observation!r} observations and gives {action!r} actions; the "
            f"scenario has {scenario.observation!r} and {scenario.action!r}"
        )


def policy_hash(name: str, policy: Policy) -> str | None:
    """Twelve hexadecimal digits over the files that a policy is made from; None without files.

    Comments, docstrings and layout of Python files do not count.
    """
    files = [Path(name)] if name.lower().endswith(".zip") else _source_files(policy)
    if not files:
        return None
    return hashlib.sha256(b"".join(map(_hashed_content, files))).hexdigest()[:12]


def _hashed_content(path: Path) -> bytes:
    data = path.read_bytes()
    try:
        return code_of(data.decode()).encode() if path.suffix == ".py" else data
    except (SyntaxError, UnicodeDecodeError):  # another encoding, or changed since the import
        return data


def _source_files(policy: Policy) -> list[Path]:
    """A learned policy's weights and card, or the file of the class and the controller file, if any."""
    if isinstance(policy, LearnedPolicy | EntryPolicy | OwnProcess):
        return list(policy.files)
    try:
        source = inspect.getsourcefile(type(policy))
    except TypeError:
        return []
    made_from = policy.files if isinstance(policy, ReferencePolicy | Law | LimitedLaw) else ()
    return [Path(source), *made_from] if source else []


def _stable_baselines(path: Path, scenario: Scenario, *, trust: Trust) -> Policy:
    if not trust:
        raise ValueError(
            f"{path}: loading an SB3 file runs code that it contains; allow that with --trust"
        )
    if not path.is_file():
        raise ValueError(f"cannot read {path}: no such file")
    entries = None
    if scenario.observation == "tracking":
        entries = len(tracking_entries(scenario.preview_s, scenario.rays, scenario.neighbour))
    if trust == ISOLATED:
        given = str(path), entries
        return OwnProcess("policy", str(path), ACTION_SIZE, code=LOADER, given=given)
    return load_zip(str(path), entries)


def load_zip(file: str, entries: int | None) -> Policy:
    """A PPO, SAC or TD3 model of stable-baselines3; its file runs code.

    Parameters
    ----------
    entries
        Of the observations that it must take for twists; None: any.

    Raises
    ------
    ValueError
        naming the file, for another model, or without stable-baselines3.
    """
    path = Path(file)
    try:
        from stable_baselines3.common.save_util import load_from_zip_file
    except ModuleNotFoundError as error:
        raise ValueError(f"{path} needs stable-baselines3 ({install_command('train')})") from error
    import stable_baselines3

    data, _, _ = load_from_zip_file(path, device="cpu")
    algorithm = _algorithm_of(data or {}, path)
    model = getattr(stable_baselines3, algorithm).load(path, device="cpu")
    seen, given = model.observation_space.shape, model.action_space.shape
    wanted = (entries,)
    if entries is not None and (seen != wanted or given != (ACTION_SIZE,)):
        raise ValueError(
            f"{path}: its observation has the shape {seen} and its action {given}; the scenario's "
            f"are {wanted} and {(ACTION_SIZE,)}"
        )
    return model


def _algorithm_of(data: dict[str, object], path: Path) -> str:
    for key, algorithm in (
        ("clip_range", "PPO"),
        ("target_entropy", "SAC"),
        ("policy_delay", "TD3"),
    ):
        if key in data:
            return algorithm
    raise ValueError(f"{path} is not a PPO, SAC or TD3 model of stable-baselines3")
