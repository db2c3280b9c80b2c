"""Systems: a controller, an estimator and a limiter by name, ``CONTROLLER+ESTIMATOR+LIMITER``."""

from __future__ import annotations

import inspect
import re
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from baselines.policies.laws.catalogue import LAWS, law_names, make_law
from baselines.policies.laws.law import Law
from baselines.policies.reference import ReferencePolicy
from tlf_env.common.errors import shown, suggestion
from tlf_env.common.presets import is_file_name, preset_names, preset_or_file
from tlf_env.numerics.compiled import driver
from tlf_env.onboard.controllers import controller_for, controller_names
from tlf_env.onboard.kinds import DEFAULT_CONTROLLER, ESTIMATOR_KINDS, EstimatorKind
from tlf_env.onboard.limiters import Limiter, behind, limiter_files, load_limiter, own_limiter
from tlf_env.onboard.parts import PYTHON_ESTIMATORS, Policy, load_part
from tlf_env.onboard.supervisor import Neighbour, SupervisorRow, supervisor_row
from tlf_env.onboard.tracking import Controller, ControllerRow, controller_row
from tlf_env.task.actions import ACTION_SIZE, allowed_twist, twist_action
from tlf_env.task.scenario import BROADCAST_SMOOTHING_S, Scenario

FORM = "CONTROLLER+ESTIMATOR or CONTROLLER+ESTIMATOR+LIMITER"
ENTRY = "entry:"  # before the folder of a competition's entry
NOT_LIMITED = (".zip", ".safetensors")  # learned policies, whose paths may contain a +


SMOOTHED: tuple[EstimatorKind, ...] = ("ekf", "ekf-slip", "ekf-gyro")
# The fields of the scenario that an estimator's name sets: the filter on board and parameters of it, and the
# smoothing of what is broadcast of it.
FILTERS: dict[str, dict[str, Any]] = {
    **{kind: {"estimator": kind} for kind in ESTIMATOR_KINDS},
    "ekf-slip-without-jumps": {
        "estimator": "ekf-slip",
        "ekf_slip": {"most_acceleration_mm_s2": None, "most_yaw_acceleration_rad_s2": None},
    },
    "ekf-gyro-without-torques": {"estimator": "ekf-gyro", "ekf_gyro": {"torque_time_s": None}},
    **{name: {"estimator": path} for name, path in PYTHON_ESTIMATORS.items()},
}
ESTIMATORS: dict[str, dict[str, Any]] = {
    **{name: fields | {"broadcast_smoothing_s": 0.0} for name, fields in FILTERS.items()},
    **{
        f"{kind}-smoothed": {"estimator": kind, "broadcast_smoothing_s": BROADCAST_SMOOTHING_S}
        for kind in SMOOTHED
    },
}


class SystemName(NamedTuple):
    """The names of a system's parts; ``str`` gives the system's name."""

    controller: str
    estimator: str
    limiter: str | None  # None: the limits of the controller's own file, if any

    def __str__(self) -> str:
        return "+".join(part for part in self if part is not None)


def parse_system(name: str) -> SystemName | None:
    """The parts of a system's name; None for the name of another policy.

    The first ``+`` before an estimator's name ends the controller, so that the paths of the controller's
    and the limiter's file may contain a ``+``.

    Raises
    ------
    ValueError
        naming the part, if the name has a ``+`` and no estimator behind it, or a part is empty.
    """
    if "+" not in name or name.lower().endswith(NOT_LIMITED) or name.startswith(ENTRY):
        return None
    kinds = "|".join(map(re.escape, ESTIMATORS))
    found = re.match(rf"(?P<controller>.*?)\+(?P<estimator>{kinds})(?:\+(?P<limiter>.*))?$", name)
    if found is None:
        head, _, tail = name.partition("+")
        if ":" in head and is_file_name(name) and Path(name.partition(":")[2]).is_file():
            return None  # the path of one controller file
        raise _unknown(name, "estimator", tail.partition("+")[0], ESTIMATORS)
    system = SystemName(**found.groupdict())
    if not system.controller:
        raise _unknown(name, "controller", "", system_controllers())
    if system.limiter == "":
        raise _unknown(name, "limiter", "", limiters())
    return system


def system_controllers() -> list[str]:
    """Names of the controllers that need no file."""
    return [*(f"reference:{gains}" for gains in controller_names()), *law_names()]


def limiters() -> list[str]:
    """What a limiter may be: the presets, or a file."""
    return [*preset_names("limiter"), "FILE.yaml"]


@driver
def _limited(
    rows: np.ndarray,
    scales: np.ndarray,
    row: ControllerRow,
    supervisor: SupervisorRow,
    wanted: np.ndarray,
    out: np.ndarray,
) -> None:
    for i in range(rows.shape[0]):
        u_1, u_2 = allowed_twist(rows[i], scales, row, supervisor, wanted[i, 0], wanted[i, 1])
        out[i, 0], out[i, 1] = twist_action(rows[i], scales, row, u_1, u_2)


def asked_by(limiter: Limiter) -> dict[str, Any]:
    """The scenario's fields that a limiter asks for."""
    return {} if limiter.supervisor is None else {"neighbour": Neighbour().model_dump()}


class LimitedLaw:
    """A law behind a limiter, with the signature of SB3's ``predict``.

    Parameters
    ----------
    law
        A tracking law, which wants a twist for each observation.
    limiter
        What its twist is limited by; its lead shifts the reference that the law sees.
    control_period_s
        Control period, s; needed for the limits on accelerations.
    preview_s
        The scenario's previews, s; a lead is computed from the first.

    Raises
    ------
    ValueError
        for a lead without a first preview above 0.
    """

    privileged = False
    scenario_overrides: Mapping[str, Any] = {}
    files: tuple[Path, ...] = ()

    def __init__(
        self,
        law: Law,
        limiter: Limiter,
        control_period_s: float,
        preview_s: tuple[float, ...],
    ) -> None:
        self.law, self.limiter = law, limiter
        # The gains of the row are not used: the law that wants the twist is another.
        self._row = controller_row(behind(Controller(), limiter), control_period_s, preview_s)
        self.supervisor = limiter.supervisor
        self._supervisor_row = supervisor_row(limiter.supervisor, law.place("neighbour_heard"))
        self.scenario_overrides = asked_by(limiter)

    def predict(
        self,
        observation: np.ndarray,
        state: Any = None,
        episode_start: np.ndarray | None = None,
        deterministic: bool = True,
    ) -> tuple[np.ndarray, Any]:
        """``twist`` action for one ``tracking`` observation or a batch, and the law's next state.

        Raises
        ------
        ValueError
            as the law's ``wanted``.
        """
        observation = np.asarray(observation)
        wanted, state = self.law.wanted(
            observation,
            state,
            episode_start,
            lead_s=self.limiter.lead_s,
            slip_cancelled=self.limiter.limits.cancel_slip,
        )
        rows = np.ascontiguousarray(np.atleast_2d(observation))
        action = np.empty((len(rows), ACTION_SIZE), dtype=rows.dtype)
        _limited(rows, self.law.scales, self._row, self._supervisor_row, wanted, action)
        return (action[0] if observation.ndim == 1 else action), state


def make_system(system: SystemName, scenario: Scenario) -> Policy:
    """The policy of a system, for a scenario with ``tracking`` observations and ``twist`` actions.

    Its ``scenario_overrides`` ask for what the law asks for, and for the estimator, with the scenario's
    parameters whatever the controller's file has, so that all controllers are compared on the same filter.
    A system on the true state is privileged.

    Raises
    ------
    ValueError
        in one line, for an unknown part, an invalid file, a lead without a first preview above 0, or an
        estimator in Python on the plant ``batch``.
    """
    name = str(system)
    limiter, files = None, estimator_files(system.estimator)
    if files and scenario.plant == "batch":
        raise ValueError(
            f"system {name!r}: estimator {system.estimator!r} is a Python object, which plant 'batch' cannot "
            "run; use plant 'pymunk'"
        )
    if system.limiter is not None:
        path = preset_or_file("limiter", system.limiter)
        if path is None:
            raise _unknown(name, "limiter", system.limiter, limiters())
        limiter = load_limiter(system.limiter)
        files += limiter_files(system.limiter)
    head, _, tail = system.controller.partition(":")
    kind = "controller" if head == "reference" else head
    known = kind == "controller" or kind in LAWS
    path = preset_or_file(kind, tail) if known else None
    if not known or (path is None and system.controller != head):
        raise _unknown(name, "controller", system.controller, system_controllers())
    policy: ReferencePolicy | LimitedLaw
    asked: Mapping[str, Any] = {}
    period_s, preview_s = scenario.control_period_s, scenario.preview_s
    if kind == "controller":
        law = controller_for(tail or DEFAULT_CONTROLLER, scenario.preview_s)
        whole = behind(law, own_limiter(law) if limiter is None else limiter)
        supervisor = None if limiter is None else limiter.supervisor
        policy = ReferencePolicy(whole, period_s, preview_s, supervisor)
        files += [] if path is None else [path]
    else:
        made = make_law(head, tail, scenario)
        policy = LimitedLaw(made, limiter or Limiter(), period_s, preview_s)
        asked = made.scenario_overrides
        files += [Path(inspect.getfile(type(made))), *made.files]
    policy.files = tuple(files)
    policy.privileged = system.estimator == "truth"
    heard = {} if limiter is None else asked_by(limiter)
    policy.scenario_overrides = {**asked, **heard, **ESTIMATORS[system.estimator]}
    return policy


def estimator_files(name: str) -> list[Path]:
    """Source files of an estimator in Python, by its name in systems; none for a compiled one."""
    if name not in PYTHON_ESTIMATORS:
        return []
    package = PYTHON_ESTIMATORS[name].rpartition(".")[0]
    made: Any = load_part("estimator", PYTHON_ESTIMATORS[name], trust=False)
    return [
        Path(inspect.getfile(one))
        for one in inspect.getmro(made)
        if one.__module__.startswith(package)
    ]


def _unknown(name: str, part: str, given: str, allowed: Iterable[str]) -> ValueError:
    """The error for an unknown part of a system."""
    names = list(allowed)
    return ValueError(
        f"system {shown(name)}: {part} {shown(given)} is not one of {', '.join(names)}"
        f"{suggestion(given, names)}; a system is {FORM}"
    )
