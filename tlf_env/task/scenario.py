"""The scenario: a frozen, validated model of everything that an episode depends on, except the seed."""

from __future__ import annotations

import functools
import math
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal, NoReturn, Self

from pydantic import (
    AfterValidator,
    Field,
    ValidationError,
    field_validator,
    model_validator,
)
from pydantic_core import PydanticCustomError

from tlf_env.common.errors import nearest, one_line, path_text, shown, suggestion
from tlf_env.common.files import FILE_NAME
from tlf_env.common.models import (
    Frozen,
    NonNegative,
    Number,
    Positive,
    Switch,
    Whole,
    is_number,
)
from tlf_env.common.presets import is_file_name, read_preset_or_file
from tlf_env.disturbances.model import Disturbance
from tlf_env.onboard.controllers import controller_for
from tlf_env.onboard.estimator import EkfParameters
from tlf_env.onboard.gyro_estimator import GyroEkfParameters
from tlf_env.onboard.kinds import DEFAULT_CONTROLLER, ESTIMATOR_KINDS, EstimatorKind
from tlf_env.onboard.limiters import DEFAULT_LIMITER, Limiter, load_limiter
from tlf_env.onboard.observer import ObserverParameters
from tlf_env.onboard.parts import is_part
from tlf_env.onboard.rays import Rays
from tlf_env.onboard.slip_estimator import SlipEkfParameters
from tlf_env.onboard.supervisor import Neighbour
from tlf_env.onboard.tracking import Controller, can_lead, controller_row
from tlf_env.onboard.wheel_loop import WheelLoopParameters
from tlf_env.physics.vehicle import RobotParameters
from tlf_env.physics.world import World
from tlf_env.task.actions import (
    ACTION_KINDS,
    LIMITED_KINDS,
    LIMITED_OUTSIDE_KINDS,
    OUTSIDE_KINDS,
    OUTSIDE_RESIDUAL,
    RANGED_KINDS,
    REFERENCE,
    TRACKING_FADE_MM,
    ActionKind,
    action_entries,
)
from tlf_env.task.display import differences_text
from tlf_env.task.feasibility import (
    disturbed,
    push_warnings,
    sensor_warnings,
    start_note,
    wall_warnings,
    warnings_for,
)
from tlf_env.task.observation import Entry
from tlf_env.task.reward import DEFAULT_WEIGHTS, RewardTerms, least_reward
from tlf_env.task.sources import (
    DEFAULT_CONTROL_PERIOD_S,
    disturbance_data,
    merged,
    scenario_data,
    set_field,
    trajectory_data,
)
from tlf_env.task.trajectories import Trajectory
from tlf_env.task.waypoints import MAX_MAGNITUDE

MAX_ROBOTS = 1000
DEFAULT_PREVIEW_S = (0.5, 1.0)
BROADCAST_SMOOTHING_S = 0.1  # by default, where there is room
SETTLE_FRACTION = 0.4
LEARNERS_ACTION: ActionKind = "tracking_twist"  # of environments in which one robot, or all, learn
START_MARGIN_MM = 1.0  # smallest distance between outlines at the start
DIVIDES_TOLERANCE = 1e-9
MAX_STEPS = 10_000_000
# Names that other libraries use, and what to use here.
_LENGTH = "use horizon_s, the length of an episode in s"
_COUNT = "use robots"
_PERIOD = "use control_period_s, the time between two actions in s"
OTHER_NAMES = {
    **dict.fromkeys(("max_cycles", "max_steps", "max_episode_steps", "episode_length"), _LENGTH),
    **dict.fromkeys(("N", "n", "num_agents", "n_agents", "num_robots", "n_robots"), _COUNT),
    **dict.fromkeys(("frameskip", "frame_skip", "time_step", "timestep"), _PERIOD),
    "dt": "use control_period_s or physics_period_s",
    "num_envs": "use formations",
    "seed": "reset() takes the seed",
}

EndCondition = Literal["lost", "touched"]


def _part_path(value: str) -> str:
    if not is_part(value):
        raise PydanticCustomError("part_path", "Input should be module:factory")
    return value


PartPath = Annotated[str, AfterValidator(_part_path)]


class FrozenDict(dict[str, float]):
    """An immutable dictionary."""

    def _refuse(self, *_: Any, **__: Any) -> NoReturn:
        raise TypeError(
            "a scenario is immutable; make a changed copy with load_scenario(scenario, ...)"
        )

    __setitem__ = __delitem__ = __ior__ = _refuse
    update = pop = popitem = clear = setdefault = _refuse

    def __reduce__(self) -> tuple[Any, ...]:
        return FrozenDict, (dict(self),)


def whole_steps(duration_s: float, period_s: float) -> int | None:
    """The number of periods in a duration, or None if it is not a whole number."""
    steps = round(duration_s / period_s)
    return steps if abs(steps * period_s - duration_s) <= DIVIDES_TOLERANCE * duration_s else None


class Scenario(Frozen):
    """Task, robots, onboard software, disturbance, interface and end of an episode. Times in s."""

    name: str = "custom"
    trajectory: Trajectory
    robots: (
        Annotated[Whole, Field(ge=1, le=MAX_ROBOTS)]
        | Annotated[tuple[RobotParameters, ...], Field(min_length=1, max_length=MAX_ROBOTS)]
    ) = 3  # number of robots, or the parameters of each that differ from `robot`
    robot: RobotParameters = RobotParameters()
    time_gap_s: Positive = 5.0
    start_spacing_mm: Annotated[Positive, Field(le=MAX_MAGNITUDE)] = 300.0
    # Time in which the leader's reference gets from rest to the speed of its trajectory; 0: at once.
    start_ramp_s: Annotated[NonNegative, Field(le=MAX_MAGNITUDE)] = 0.0

    physics_period_s: Positive = 0.001
    control_period_s: Positive = DEFAULT_CONTROL_PERIOD_S
    horizon_s: Positive = 100.0
    # What moves the robots: `pymunk` is the exact kernel, with contact in a pymunk space; `batch` the kernel
    # alone; `kinematic` the wheels' commands; `chipmunk` pymunk's own bodies and constraints.
    plant: Literal["pymunk", "batch", "kinematic", "chipmunk"] = "pymunk"
    world: World = World()

    wheel_loop: WheelLoopParameters | PartPath = WheelLoopParameters()
    estimator: EstimatorKind | PartPath = "ekf-gyro"
    ekf: EkfParameters = EkfParameters()
    ekf_slip: SlipEkfParameters = SlipEkfParameters()
    ekf_gyro: GyroEkfParameters = GyroEkfParameters()
    # Smoothed broadcasts: a robot sends, beside its pose now, the one of a short time ago, from the position
    # fixes of this time before and after. 0: only its pose now. None: 0.1 s in whole control periods, or as
    # many as the time gap leaves room for.
    broadcast_smoothing_s: NonNegative | None = None
    observer: ObserverParameters | PartPath = ObserverParameters()

    disturbance: Disturbance = Disturbance()
    adversary: Switch = False  # whether a caller may set disturbance channels at every step

    action: ActionKind = "twist"
    # What 1.0 means in the actions `residual` and `tracking_twist`, mm/s and rad/s; None: 150 and 1, 100 and 1.
    action_range: tuple[Positive, Positive] | None = None
    # Estimated position error at which `tracking_twist` has half its range; None: 10. 0: all of it everywhere.
    tracking_fade_mm: NonNegative | None = None
    # What the actions `twist`, `wheel_speed` and `tracking_twist` are limited by: a preset, a file or a
    # mapping. None: `approach` for `tracking_twist`, no limits for the others.
    limiter: Limiter | None = None
    # Base controller of the action `residual`, which is added to its twist: a preset, a file, or a policy in
    # Python, `module:factory`.
    residual_base: str = DEFAULT_CONTROLLER
    # Estimated errors at which a residual has half its weight: the weight decreases below the first and
    # above the second. 0 and None: it does not.
    residual_fade_mm: NonNegative = 0.0
    residual_reach_mm: Positive | None = None
    observation: Literal["tracking", "sensor"] = "tracking"
    rays: Rays | None = None  # range sensors, at the end of the observation
    # Hearing beyond the predecessor, in the observation `tracking`; None: only the predecessor is heard.
    neighbour: Neighbour | None = None
    dtype: Literal["float32", "float64"] = "float32"  # of observations and actions
    preview_s: tuple[NonNegative, ...] = DEFAULT_PREVIEW_S
    reward: dict[str, Number] = Field(default_factory=lambda: FrozenDict(DEFAULT_WEIGHTS._asdict()))
    cooperative: Switch = False  # every robot receives the formation's mean reward
    end_on: tuple[EndCondition, ...] = ("lost", "touched")
    lost_beyond_mm: Positive = 1200.0

    @model_validator(mode="before")
    @classmethod
    def _different_robots(cls, data: Any) -> Any:
        """Complete robots that are given by their differences: from the defaults, or from ``robot``."""
        if not isinstance(data, Mapping):
            return data
        base = data.get("robot", {})
        if isinstance(base, Mapping):
            base = _robot_with(RobotParameters().model_dump(), base)
        data = {**data, "robot": base}
        if isinstance(data.get("robots"), list | tuple):
            common = base.model_dump() if isinstance(base, RobotParameters) else base
            data["robots"] = [
                _robot_with(common, one) if isinstance(one, Mapping) else one
                for one in data["robots"]
            ]
        return data

    @field_validator("name", mode="after")
    @classmethod
    def _names_a_folder(cls, value: str) -> str:
        if not FILE_NAME.fullmatch(value):
            raise ValueError(
                f"must be 1 to 100 letters, digits or _ . + -, and start with a letter, digit or _, "
                f"got {value!r}"
            )
        return value

    @field_validator("disturbance", mode="before")
    @classmethod
    def _disturbance_of_a_file(cls, value: Any) -> Any:
        return disturbance_data(value) if isinstance(value, str | Path | Mapping) else value

    @field_validator("trajectory", mode="before")
    @classmethod
    def _trajectory_of_a_file(cls, value: Any) -> Any:
        return trajectory_data(value) if isinstance(value, str | Path) else value

    @field_validator("limiter", mode="before")
    @classmethod
    def _limiter_of_a_file(cls, value: Any) -> Any:
        return load_limiter(value) if isinstance(value, str | Path) else value

    @field_validator("world", mode="before")
    @classmethod
    def _world_of_a_file(cls, value: Any) -> Any:
        if not isinstance(value, str | Path):
            return value
        return read_preset_or_file("world", value, ", nor a mapping")

    @field_validator("reward", mode="before")
    @classmethod
    def _complete_weights(cls, value: Any) -> Any:
        if not isinstance(value, Mapping):
            return value
        unknown = [name for name in value if name not in RewardTerms._fields]
        if unknown:
            raise ValueError(
                f"unknown term {shown(unknown[0])}; the terms are {', '.join(RewardTerms._fields)}"
                f"{suggestion(unknown[0], RewardTerms._fields)}"
            )
        return {**DEFAULT_WEIGHTS._asdict(), **value}

    @field_validator("reward", mode="after")
    @classmethod
    def _frozen_weights(cls, value: dict[str, float]) -> dict[str, float]:
        return FrozenDict(value)

    @model_validator(mode="after")
    def _check(self) -> Self:
        for name in ("control_period_s", "time_gap_s", "horizon_s"):
            if getattr(self, name) / self.physics_period_s > MAX_STEPS:
                raise ValueError(
                    f"{name} {getattr(self, name)} is more than {MAX_STEPS} steps of "
                    f"physics_period_s {self.physics_period_s}"
                )
        if whole_steps(self.control_period_s, self.physics_period_s) in (None, 0):
            raise ValueError(
                f"control_period_s {self.control_period_s} must be a multiple of physics_period_s "
                f"{self.physics_period_s}"
            )
        for name in ("time_gap_s", "horizon_s"):
            if whole_steps(getattr(self, name), self.control_period_s) in (None, 0):
                raise ValueError(
                    f"{name} {getattr(self, name)} must be a multiple of control_period_s "
                    f"{self.control_period_s}"
                )
        between_s = self.control_period_s if self.rays is None else self.rays.period_s
        if between_s is not None and (
            between_s / self.control_period_s > MAX_STEPS
            or whole_steps(between_s, self.control_period_s) in (None, 0)
        ):
            raise ValueError(
                f"rays.period_s {between_s} must be a multiple of control_period_s "
                f"{self.control_period_s}, at most {MAX_STEPS} of them"
            )
        if self.neighbour is not None and self.observation != "tracking":
            raise ValueError(
                f"neighbour needs observation 'tracking', which has its entries, got {self.observation!r}"
            )
        if len(set(self.preview_s)) < len(self.preview_s):
            raise ValueError(f"preview_s {self.preview_s} must not contain a time twice")
        for time_s in self.preview_s:
            if time_s > self.time_gap_s:
                raise ValueError(
                    f"preview_s {time_s} must be at most time_gap_s {self.time_gap_s}: later messages "
                    "do not exist yet"
                )
            if time_s and whole_steps(time_s, self.control_period_s) is None:
                raise ValueError(
                    f"preview_s {time_s} must be a multiple of control_period_s "
                    f"{self.control_period_s}"
                )
        self._check_smoothing()
        room_mm = 2 * max(robot.outline_radius_mm for robot in self.robot_models)
        if self.robot_count > 1 and self.start_spacing_mm < room_mm + START_MARGIN_MM:
            raise ValueError(
                f"start_spacing_mm {self.start_spacing_mm} must be at least {room_mm:g} (the outlines) "
                f"+ {START_MARGIN_MM:g}, or the robots touch at the start"
            )
        delay = self.disturbance.signal("actuator.computing_delay_s").reach()[1]
        if delay * self.disturbance.level > self.control_period_s:
            raise ValueError(
                f"actuator.computing_delay_s reaches {delay * self.disturbance.level:g}; it must be at "
                f"most one control_period_s, {self.control_period_s}"
            )
        controller_row(self.base_controller, self.control_period_s, self.preview_s)
        self._check_action()
        if self.plant == "kinematic" and (
            self.action == "torque" or isinstance(self.wheel_loop, str)
        ):
            raise ValueError(
                "plant 'kinematic' has no torques: action 'torque' and wheel_loop parts are not allowed"
            )
        if self.plant == "batch":
            self.check_lanes()
        if self.plant in ("batch", "kinematic"):
            self._check_contact()
        if self.plant == "chipmunk" and self.disturbance.constant("tyre.creep") != 0.0:
            raise ValueError(
                "plant 'chipmunk' has no tyres that creep; disturbance tyre.creep needs 'pymunk' or 'batch'"
            )
        return self

    def _check_action(self) -> None:
        """Check that the fields of an action belong to it, and what its limiter needs."""
        if self.action_range is not None and self.action not in RANGED_KINDS:
            raise ValueError(
                f"action_range goes with the actions {' and '.join(RANGED_KINDS)}, not with {self.action!r}"
            )
        if self.tracking_fade_mm is not None and self.action != "tracking_twist":
            raise ValueError(
                f"tracking_fade_mm goes with the action tracking_twist, not with {self.action!r}"
            )
        if self.limiter is None:
            return
        limited = LIMITED_OUTSIDE_KINDS if self.outside_base else LIMITED_KINDS
        if self.action not in limited:
            raise ValueError(
                f"limiter goes with the actions {', '.join(limited)}, not with {self.action!r}"
            )
        if self.limiter.lead_s and not can_lead(self.preview_s):
            raise ValueError(
                f"limiter.lead_s {self.limiter.lead_s} needs a first preview above 0, got preview_s "
                f"{self.preview_s}"
            )
        if self.limiter.supervisor is not None and self.neighbour is None:
            raise ValueError("limiter.supervisor needs a neighbour; set neighbour, for example {}")

    def _check_contact(self) -> None:
        """Check that the world needs no pymunk space."""
        needs = f"needs plant 'pymunk'; plant {self.plant!r} has none"
        for name in ("pushables", "moving"):
            if getattr(self.world, name):
                raise ValueError(f"world.{name} {needs} of them, only walls, obstacles and patches")
        if any(one.outline_polygon_mm is not None for one in self.robot_models):
            raise ValueError(f"outline_polygon_mm {needs}, only round outlines")

    def check_lanes(self) -> None:
        """Check that the scenario can run in a batch of formations, without Python in the step.

        Raises
        ------
        ValueError
            naming the field that prevents it.
        """
        for role, path in self.part_paths.items():
            raise ValueError(f"{role} {path!r} is a Python object, which cannot run in a batch")
        if self.adversary:
            raise ValueError("adversary True cannot be used with plant 'batch'")
        if self.plant == "chipmunk":
            raise ValueError(
                "plant 'chipmunk' moves one formation at a time; 'batch' and 'kinematic' can run in a batch"
            )

    def __str__(self) -> str:
        """What differs from the defaults, as YAML."""
        return differences_text(self)

    @property
    def robot_count(self) -> int:
        """Number of robots."""
        return self.robots if isinstance(self.robots, int) else len(self.robots)

    @property
    def robot_models(self) -> tuple[RobotParameters, ...]:
        """Parameters of every robot."""
        if isinstance(self.robots, int):
            return (self.robot,) * self.robots
        return self.robots

    @property
    def part_paths(self) -> dict[str, str]:
        """The user-defined onboard parts, by role."""
        named = {role: getattr(self, role) for role in ("estimator", "wheel_loop", "observer")}
        return {
            role: part
            for role, part in named.items()
            if isinstance(part, str) and part not in ESTIMATOR_KINDS
        }

    @property
    def outside_base(self) -> str | None:
        """The policy in Python that ``residual_base`` names, ``module:factory``; None: it is a controller."""
        return self.residual_base if is_part(self.residual_base) else None

    @property
    def code(self) -> dict[str, str]:
        """All code that the scenario names, ``module:factory`` by field."""
        base = self.outside_base
        return self.part_paths if base is None else {**self.part_paths, "residual_base": base}

    @property
    def privileged(self) -> bool:
        """Whether observations use the true state."""
        return self.estimator == "truth"

    def _check_smoothing(self) -> None:
        half_s, period_s = self.broadcast_smoothing_s, self.control_period_s
        if not half_s:
            return
        if whole_steps(half_s, period_s) in (None, 0):
            raise ValueError(
                f"broadcast_smoothing_s {half_s} must be a multiple of control_period_s {period_s}"
            )
        if self.smoothing_steps > self._longest_smoothing_steps:
            late_s = 2 * half_s + (self._fix_delay_steps + 1) * period_s
            room_s = self.time_gap_s - max(self.preview_s, default=0.0)
            raise ValueError(
                f"broadcast_smoothing_s {half_s} makes broadcasts {late_s:g} s late; followers use them "
                f"after {room_s:g} s (time_gap_s less the longest preview_s)"
            )

    @property
    def _fix_delay_steps(self) -> int:
        """Control steps that the latest position fix takes to arrive."""
        delay_s = self.disturbance.signal("position.delay_s").reach()[1] * self.disturbance.level
        return math.ceil(delay_s / self.control_period_s)

    @property
    def _longest_smoothing_steps(self) -> int:
        """The most control steps before and after a moment, so that a message is replaced before its use."""
        lookahead = max(self.preview_steps, default=0)
        return max(0, (self.gap_steps - lookahead - self._fix_delay_steps - 1) // 2)

    @property
    def substeps(self) -> int:
        """Physics steps per control step."""
        return round(self.control_period_s / self.physics_period_s)

    @property
    def horizon_steps(self) -> int:
        """Control steps per episode."""
        return round(self.horizon_s / self.control_period_s)

    @property
    def gap_steps(self) -> int:
        """Control steps per time gap."""
        return round(self.time_gap_s / self.control_period_s)

    @property
    def preview_steps(self) -> tuple[int, ...]:
        """Control steps to each preview."""
        return tuple(round(time_s / self.control_period_s) for time_s in self.preview_s)

    @property
    def smoothing_steps(self) -> int:
        """Control steps before and after a moment that a smoothed broadcast uses; 0: none is smoothed."""
        if self.broadcast_smoothing_s is not None:
            return round(self.broadcast_smoothing_s / self.control_period_s)
        usual = round(BROADCAST_SMOOTHING_S / self.control_period_s)
        return min(usual, self._longest_smoothing_steps)

    @property
    def smoothing_s(self) -> float:
        """Time before and after a moment that a smoothed broadcast uses, s; 0: none is smoothed."""
        given = self.broadcast_smoothing_s
        return self.smoothing_steps * self.control_period_s if given is None else given

    @property
    def base_controller(self) -> Controller:
        """The controller of ``residual_base``; the default goes without its lead where no preview is ahead.

        The default too where the base is a policy in Python.
        """
        named = DEFAULT_CONTROLLER if self.outside_base else self.residual_base
        return controller_for(named, self.preview_s)

    @property
    def action_entries(self) -> tuple[Entry, ...]:
        """Meaning, unit and scale of the components of an action."""
        return action_entries(self.action, self.action_range)

    @property
    def action_fade_mm(self) -> float:
        """Estimated position error at which an action about the reference has half its range."""
        return TRACKING_FADE_MM if self.tracking_fade_mm is None else self.tracking_fade_mm

    @property
    def action_limiter(self) -> Limiter:
        """What an action's twist is limited by; without anything in it, if it is not."""
        if self.limiter is not None:
            return self.limiter
        if self.action != "tracking_twist":
            return Limiter()
        usual = load_limiter(DEFAULT_LIMITER)
        return usual if can_lead(self.preview_s) else usual.model_copy(update={"lead_s": 0.0})

    @property
    def action_kind(self) -> int:
        """Code of the action in the compiled drivers."""
        limited = self.limiter is not None and self.limiter != Limiter()
        if self.outside_base:
            return (LIMITED_OUTSIDE_KINDS if limited else ACTION_KINDS | OUTSIDE_KINDS)[self.action]
        return (LIMITED_KINDS if limited else ACTION_KINDS)[self.action]

    @property
    def reference_kind(self) -> int:
        """Code, in the compiled drivers, of a robot that the controller ``residual_base`` drives."""
        return OUTSIDE_RESIDUAL if self.outside_base else REFERENCE

    @property
    def settle_s(self) -> float:
        """Time after which errors enter the metrics: 40 % of the horizon."""
        return SETTLE_FRACTION * self.horizon_s


def load_scenario(
    source: str | Path | Mapping[str, Any] | Scenario = "infinity",
    *,
    disturbance_level: float | None = None,
    **overrides: Any,
) -> Scenario:
    """A scenario from a preset's name, a YAML file, a mapping or a scenario, with fields overridden.

    Parameters
    ----------
    source
        The name of a preset (a YAML file shipped in ``configs/``) as ``"infinity"``, a path to a YAML
        file or to a CSV file of waypoints (``t_s,x_mm,y_mm``), a mapping, or a :class:`Scenario`.
    disturbance_level
        Overrides the level of the resulting disturbance.
    **overrides
        Fields of :class:`Scenario`; None keeps the source's value. Mappings are merged.

    Raises
    ------
    TypeError
        for a keyword that is no field of a scenario; in one line that names it.
    ValueError
        for an unknown key in a file or a mapping, and an invalid value; in one line with the key's path,
        the value and what is allowed.
    """
    for name in overrides:
        if name not in Scenario.model_fields:
            names = [*Scenario.model_fields, "disturbance_level"]
            raise TypeError(
                f"unexpected keyword argument {name!r}{nearest(name, names, OTHER_NAMES)}"
            )
    return scenario_with(source, overrides, disturbance_level)


def learners_action(source: Any, overrides: Mapping[str, Any]) -> dict[str, Any]:
    """The overrides with the action that learners have by default, if nothing says which.

    A :class:`Scenario` is complete: its action stays. ``source`` may be a sequence, also of sequences; one
    scenario that says its action is enough.

    Raises
    ------
    ValueError
        for an unknown preset, or a file that cannot be read.
    """
    if overrides.get("action") is not None or _says_action(
        source, overrides.get("control_period_s")
    ):
        return dict(overrides)
    return {**overrides, "action": LEARNERS_ACTION}


def _says_action(source: Any, control_period_s: Any) -> bool:
    """Whether a scenario, or one of several, says what its action is."""
    if isinstance(source, Scenario):
        return True
    if isinstance(source, Sequence) and not isinstance(source, str):
        return any(_says_action(one, control_period_s) for one in source)
    return scenario_data(source, control_period_s).get("action") is not None


def scenario_with(
    source: str | Path | Mapping[str, Any] | Scenario,
    fields: Mapping[str, Any],
    disturbance_level: float | None = None,
    settings: Mapping[str, Any] | None = None,
) -> Scenario:
    """A scenario as :func:`load_scenario`, its fields from a mapping, for example from a file.

    Parameters
    ----------
    settings
        Values of fields by their paths, as ``disturbance.slip.delta_1_mm_s``, set in this order after
        ``fields``; each field alone, without merging.

    Raises
    ------
    ValueError
        as :func:`load_scenario`; for an unknown key in ``fields``, too, and as :func:`set_field`.
    """
    if isinstance(source, Scenario):
        # A field that is left at its default may still be set, for example by what a policy asks for.
        data = {
            key: value
            for key, value in source.model_dump().items()
            if key in source.model_fields_set
        }
    else:
        data = scenario_data(source, fields.get("control_period_s"))
    for key, value in fields.items():
        if value is not None:
            old = data.get(key)
            if key == "trajectory" and isinstance(old, str | Path) and isinstance(value, Mapping):
                old = trajectory_data(old)
            data[key] = merged(old, value)
    named = data.get("disturbance")
    for path, value in (settings or {}).items():
        set_field(data, path, value)
    if disturbance_level is not None:
        data["disturbance"] = _with_level(data.get("disturbance", {}), disturbance_level)
    try:
        return Scenario.model_validate(data)
    except ValidationError as error:
        line = one_line(error, Scenario, OTHER_NAMES)
        if isinstance(named, str | Path) and is_file_name(named):
            file = path_text(named)
            if line.startswith("disturbance") and file not in line:
                line = f"{file}, {line}"
        raise ValueError(line) from error


@functools.lru_cache(maxsize=64)
def _warnings_for(*what: Any) -> tuple[str, ...]:
    trajectory, robot, horizon_s, robots, time_gap_s, start_spacing_mm, start_ramp_s = what
    return tuple(
        warnings_for(
            trajectory,
            robot,
            horizon_s,
            robots=robots,
            time_gap_s=time_gap_s,
            start_spacing_mm=start_spacing_mm,
            start_ramp_s=start_ramp_s,
        )
    )


@functools.lru_cache(maxsize=64)
def _wall_warnings(*what: Any) -> tuple[str, ...]:
    return tuple(wall_warnings(*what))


def _contact_warnings(scenario: Scenario) -> Iterator[str]:
    """Lines for surfaces without effect on the robots: a contact has the product of both values."""
    for field in ("restitution", "friction"):
        if any(getattr(robot, f"outline_{field}") for robot in scenario.robot_models):
            continue
        for name in ("walls", "obstacles", "pushables", "moving"):
            for number, thing in enumerate(getattr(scenario.world, name)):
                value = getattr(thing, field)
                if field in thing.model_fields_set and value not in (0.0, 1.0):
                    yield (
                        f"world.{name}[{number}].{field} {value:g} has no effect on robots: a contact "
                        f"has the product of both values, and robot.outline_{field} is 0"
                    )


def scenario_warnings(scenario: Scenario) -> list[str]:
    """A line for each limit of the robots or of the observation that the scenario exceeds.

    The robots' limits include constant friction and torque gains of the disturbance at its level. They do
    not include signals that vary or are random, nor patches of the floor.
    """
    lines = [
        line
        for robot in dict.fromkeys(_disturbed_robots(scenario))
        for line in _warnings_for(
            scenario.trajectory,
            robot,
            scenario.horizon_s,
            scenario.robot_count,
            scenario.time_gap_s,
            scenario.start_spacing_mm,
            scenario.start_ramp_s,
        )
    ]
    if scenario.world.fixed:
        lines += [
            line
            for robot in dict.fromkeys(scenario.robot_models)
            for line in _wall_warnings(
                scenario.trajectory,
                robot,
                scenario.world,
                scenario.horizon_s,
                scenario.start_ramp_s,
            )
        ]
    lines += push_warnings(scenario.robot_models, scenario.world)
    lines += _contact_warnings(scenario)
    if scenario.observation == "sensor":
        lines += sensor_warnings(
            scenario.trajectory,
            scenario.horizon_s,
            robots=scenario.robot_count,
            time_gap_s=scenario.time_gap_s,
            start_spacing_mm=scenario.start_spacing_mm,
            start_ramp_s=scenario.start_ramp_s,
        )
    radius_mm = min(robot.outline_radius_mm for robot in scenario.robot_models)
    if scenario.rays is not None and scenario.rays.range_mm <= radius_mm:
        lines.append(
            f"rays.range_mm {scenario.rays.range_mm:g} is at most outline_radius_mm {radius_mm:g}: rays "
            "start at the centre of the outline, so that they meet nothing outside"
        )
    drives = scenario.action == "residual" or scenario.residual_base != DEFAULT_CONTROLLER
    drives = drives and not scenario.outside_base
    if drives and scenario.estimator == "ekf" and scenario.base_controller.limits.cancel_slip:
        lines.append(
            f"residual_base {scenario.residual_base!r} subtracts the estimated slip from its commands, "
            "but estimator 'ekf' estimates none; use 'ekf-gyro' or 'ekf-slip'"
        )
    if scenario.estimator == "ekf" and scenario.limiter and scenario.limiter.limits.cancel_slip:
        lines.append(
            "the limiter subtracts the estimated slip from an action's twist, but estimator 'ekf' estimates "
            "none; use 'ekf-gyro' or 'ekf-slip'"
        )
    least, error_mm = least_reward(scenario.reward, scenario.lost_beyond_mm)
    for end in scenario.end_on:
        if least * scenario.horizon_steps < scenario.reward[end]:
            lines.append(
                f"reward: a robot {error_mm:g} mm from its reference receives {least:.3g} in every step, so "
                f"that being {end}, {scenario.reward[end]:g} once, may be better than driving on; reward.alive "
                f"{max(scenario.reward['alive'] - least, 0.0):.3g} and reward.{end} below 0 prevent it"
            )
    return list(dict.fromkeys(lines))


def scenario_notes(scenario: Scenario) -> list[str]:
    """A line for each note on the scenario that is not a warning."""
    if scenario.start_ramp_s > 0:
        return []
    note = start_note(scenario.trajectory, _disturbed_robots(scenario)[0])
    return [] if note is None else [note]


def _disturbed_robots(scenario: Scenario) -> list[RobotParameters]:
    """The robots with limits reduced by a constant disturbance."""
    disturbance = scenario.disturbance
    grip, gain_l, gain_r = (
        disturbance.constant(path)
        for path in (
            "tyre.friction_scale",
            "actuator.torque_gain_l",
            "actuator.torque_gain_r",
        )
    )
    gain = min((one for one in (gain_l, gain_r) if one is not None), default=1.0)
    return [
        disturbed(robot, 1.0 if grip is None else grip, gain) for robot in scenario.robot_models
    ]


def _robot_with(base: Any, differences: Mapping[str, Any]) -> Any:
    """A robot's parameters with some of them changed; a polygon as outline has a circle of its own."""
    if isinstance(base, Mapping) and differences.get("outline_polygon_mm") is not None:
        around = ("outline_radius_mm", "outline_offset_mm")
        base = {name: value for name, value in base.items() if name not in around}
    return merged(base, differences)


def _with_level(disturbance: Any, level: float) -> dict[str, Any]:
    if isinstance(disturbance, str | Path | Mapping):
        disturbance = disturbance_data(disturbance)
    elif isinstance(disturbance, Disturbance):
        disturbance = disturbance.model_dump()
    else:
        raise ValueError(f"disturbance: Input should be a mapping, got {shown(disturbance)}")
    if not is_number(level) or not 0 <= level < math.inf:
        raise ValueError(f"disturbance_level {shown(level)} must be a finite number, at least 0")
    return {**disturbance, "level": float(level)}
