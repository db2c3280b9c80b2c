"""Reference trajectories of the leader, with exact first and second derivatives.

Heading as in the paper: θ* = atan2(−ẋ*, ẏ*), unwrapped over time. Heading 0 is +y (unlike ROS REP-103,
where it is +x). While the reference is at rest, its heading is constant. Formulas and limits of the robots:
``docs/trajectories.md``.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple, Self

import numpy as np
from pydantic import Field, ValidationInfo, field_validator, model_validator

from tlf_env.common.errors import shown
from tlf_env.common.models import Frozen, NonNegative, Number, Positive
from tlf_env.task.waypoints import (
    MAX_COORDINATE_MM,
    MAX_MAGNITUDE,
    Point,
    checked_points,
    drive_through,
    read_points,
)

REFERENCE_COLUMNS = ("x_mm", "y_mm", "theta_rad", "u_1_mm_s", "u_2_rad_s")

STILL_MM_S = 1e-10  # below it the direction of a velocity is rounding
NEARBY_S = 1e-5  # time before such an instant at which the heading is evaluated

# Far beyond any robot, and small enough that squares and products do not overflow.
MAX_RATE_RAD_S = 1e4
SHORTEST_RAMP_S = 1e-6

Coordinate = Annotated[Number, Field(ge=-MAX_COORDINATE_MM, le=MAX_COORDINATE_MM)]  # mm
Phase = Annotated[Number, Field(ge=-MAX_MAGNITUDE, le=MAX_MAGNITUDE)]  # rad
Size = Annotated[Positive, Field(le=MAX_MAGNITUDE)]  # mm, mm/s, s
Rate = Annotated[Positive, Field(le=MAX_RATE_RAD_S)]


class _Timed(Frozen):
    """A trajectory as a function of time."""

    @abstractmethod
    def derivatives(self, t_s: np.ndarray) -> np.ndarray:
        """Position, velocity and acceleration: ``(3, 2, ...)`` in mm, mm/s, mm/s²."""

    def tangent(
        self, t_s: np.ndarray, velocity: np.ndarray, acceleration: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """A vector along the heading and its rate of change, each ``(2, ...)``.

        These are velocity and acceleration at ``t_s``. At an instant of zero velocity the velocity just
        before is used (at the start: just after).
        """
        still = np.hypot(*velocity) < STILL_MM_S
        if not still.any():
            return velocity, acceleration
        starting = (t_s >= 0) & (t_s < NEARBY_S)
        nearby = self.derivatives(np.where(starting, t_s + NEARBY_S, t_s - NEARBY_S))[1]
        return np.where(still, nearby, velocity), np.where(still, 0.0, acceleration)


class Sinusoid(NamedTuple):
    """amplitude · sin(rate · t + phase)."""

    amplitude_mm: float
    rate_rad_s: float
    phase_rad: float


def _derivative(terms: list[Sinusoid], t_s: np.ndarray, order: int) -> np.ndarray:
    total = np.zeros_like(t_s)
    for term in terms:
        phase = term.rate_rad_s * t_s + term.phase_rad + order * np.pi / 2
        total += term.amplitude_mm * term.rate_rad_s**order * np.sin(phase)
    return total


class _Harmonic(_Timed):
    """A sum of sinusoids per axis, so that its derivatives are sums of sinusoids too."""

    centre_x_mm: Coordinate = 0.0
    centre_y_mm: Coordinate = 0.0

    @abstractmethod
    def sinusoids(self) -> tuple[list[Sinusoid], list[Sinusoid]]:
        """The terms of x and y relative to the centre."""

    @model_validator(mode="after")
    def _bound(self) -> Self:
        terms = [term for axis in self.sinusoids() for term in axis]
        fastest = max(abs(term.rate_rad_s) for term in terms)
        if not fastest <= MAX_RATE_RAD_S:
            raise ValueError(
                f"{self._rate_values()} gives {fastest:g} rad/s; at most {MAX_RATE_RAD_S:g} is allowed"
            )
        return self

    def _rate_values(self) -> str:
        """The fields that determine the rates, with their values."""
        return ", ".join(f"{name} {getattr(self, name):g}" for name in self._rate_fields())

    @abstractmethod
    def _rate_fields(self) -> list[str]:
        """The names of these fields."""

    def derivatives(self, t_s: np.ndarray) -> np.ndarray:
        """Position, velocity and acceleration: ``(3, 2, ...)`` in mm, mm/s, mm/s²."""
        t_s = np.asarray(t_s, dtype=np.float64)
        axes = self.sinusoids()
        out = np.array([[_derivative(terms, t_s, order) for terms in axes] for order in range(3)])
        out[0, 0] += self.centre_x_mm
        out[0, 1] += self.centre_y_mm
        return out


class Lissajous(_Harmonic):
    """x = A sin(a t + α) + x₀, y = B sin(b t + β) + y₀. The paper's ∞ is eq. (52): A = B, b = 2a."""

    type: Literal["lissajous"] = "lissajous"
    amplitude_x_mm: Size
    amplitude_y_mm: Size
    rate_x_rad_s: Rate
    rate_y_rad_s: Rate
    phase_x_rad: Phase = 0.0
    phase_y_rad: Phase = 0.0

    def sinusoids(self) -> tuple[list[Sinusoid], list[Sinusoid]]:
        """One term per axis."""
        return (
            [Sinusoid(self.amplitude_x_mm, self.rate_x_rad_s, self.phase_x_rad)],
            [Sinusoid(self.amplitude_y_mm, self.rate_y_rad_s, self.phase_y_rad)],
        )

    def _rate_fields(self) -> list[str]:
        return ["rate_x_rad_s", "rate_y_rad_s"]


class Rose(_Harmonic):
    """x = A cos(k s) sin s + x₀, y = −B cos(k s) cos s + y₀, s = 2πt/period. Eq. (53): k = 2, 120 s."""

    type: Literal["rose"] = "rose"
    amplitude_x_mm: Size
    amplitude_y_mm: Size
    petals_k: Size = 2.0
    period_s: Size

    def sinusoids(self) -> tuple[list[Sinusoid], list[Sinusoid]]:
        """Two terms per axis: the products of eq. (53) as sums."""
        rate = 2 * np.pi / self.period_s
        fast, slow = (self.petals_k + 1) * rate, (self.petals_k - 1) * rate
        half_x, half_y = self.amplitude_x_mm / 2, self.amplitude_y_mm / 2
        return (
            [Sinusoid(half_x, fast, 0.0), Sinusoid(-half_x, slow, 0.0)],
            [Sinusoid(-half_y, fast, np.pi / 2), Sinusoid(-half_y, slow, np.pi / 2)],
        )

    def _rate_fields(self) -> list[str]:
        return ["petals_k", "period_s"]


class Circle(_Harmonic):
    """x = r cos(φ ± ω t) + x₀, y = r sin(φ ± ω t) + y₀, with ω = 2π/period or speed/r.

    Raises
    ------
    pydantic.ValidationError
        (a ValueError) unless exactly one of ``period_s`` and ``speed_mm_s`` is given.
    """

    type: Literal["circle"] = "circle"
    radius_mm: Size
    period_s: Size | None = None
    speed_mm_s: Size | None = None
    direction: Literal["counterclockwise", "clockwise"] = "counterclockwise"
    phase_rad: Phase = 0.0  # φ: angle of the start, from +x

    @model_validator(mode="after")
    def _check(self) -> Self:
        if (self.period_s is None) == (self.speed_mm_s is None):
            raise ValueError(
                f"a circle needs either period_s or speed_mm_s, got period_s {self.period_s} "
                f"and speed_mm_s {self.speed_mm_s}"
            )
        return self

    def sinusoids(self) -> tuple[list[Sinusoid], list[Sinusoid]]:
        """One term per axis."""
        if self.speed_mm_s is not None:
            rate = self.speed_mm_s / self.radius_mm
        else:
            rate = 2 * np.pi / (self.period_s or np.inf)
        if self.direction == "clockwise":
            rate = -rate
        return (
            [Sinusoid(self.radius_mm, rate, self.phase_rad + np.pi / 2)],
            [Sinusoid(self.radius_mm, rate, self.phase_rad)],
        )

    def _rate_fields(self) -> list[str]:
        return ["period_s"] if self.speed_mm_s is None else ["radius_mm", "speed_mm_s"]


class Waypoints(_Timed):
    """A smooth curve through timed points, ``(t_s, x_mm, y_mm)`` each; the first time becomes 0.

    ``file`` is the path of a CSV file with the header ``t_s,x_mm,y_mm``. It is read into ``points`` during
    validation and not kept, so that a dumped model does not depend on the file. A relative path starts at
    ``folder`` of the validation context, or else at the working directory. The curve is the cubic spline
    of :func:`tlf_env.task.waypoints.drive_through`: a point that is repeated at a later time is a stop
    until then. After the last point the reference is at rest.

    Raises
    ------
    pydantic.ValidationError
        (a ValueError) that names the point or the line, the value and what is allowed.
    """

    type: Literal["waypoints"] = "waypoints"
    file: str | None = None
    points: tuple[Point, ...] = ()

    @model_validator(mode="before")
    @classmethod
    def _read(cls, data: Any, info: ValidationInfo) -> Any:
        if not isinstance(data, Mapping):
            return data
        file, points = data.get("file"), data.get("points")
        if (file is None) == (points is None):
            raise ValueError("waypoints need either points or file, and not both")
        if file is None:
            return data
        if not isinstance(file, str | Path):
            raise ValueError(f"file must be a path, got {shown(file)}")
        folder = Path((info.context or {}).get("folder", ""))
        return {**data, "file": None, "points": read_points(folder / file)}

    @field_validator("points", mode="before")
    @classmethod
    def _check(cls, points: Any) -> tuple[Point, ...]:
        points = points.tolist() if isinstance(points, np.ndarray) else points
        if not isinstance(points, list | tuple):
            raise ValueError(f"points must be a list of (t_s, x_mm, y_mm), got {shown(points)}")
        return checked_points(points, "points", lambda index: f"points[{index}]")

    @model_validator(mode="after")
    def _try(self) -> Self:
        drive_through(self.points)
        return self

    @property
    def end_s(self) -> float:
        """Time of the last point."""
        return self.points[-1][0]

    def derivatives(self, t_s: np.ndarray) -> np.ndarray:
        """Position, velocity and acceleration: ``(3, 2, ...)`` in mm, mm/s, mm/s²."""
        return drive_through(self.points).derivatives(np.asarray(t_s, dtype=np.float64))

    def tangent(
        self, t_s: np.ndarray, velocity: np.ndarray, acceleration: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """The velocity; at rest the last one of the motion (before any motion: the first)."""
        heading_time = drive_through(self.points).heading_time(t_s)
        direction, rate = super().tangent(heading_time, *self.derivatives(heading_time)[1:])
        return direction, np.where(heading_time == t_s, rate, 0.0)


Plain = Annotated[Lissajous | Rose | Circle | Waypoints, Field(discriminator="type")]


class StopAndGo(_Timed):
    """Another trajectory, ``path``, with stops: p(t) = path(q(t)), from rest.

    In every ``drive_s`` the rate q̇ rises from 0 to 1 over ``ramp_s`` by the cubic 3x² − 2x³, stays 1, and
    falls to 0 in the same way; then q is constant for ``stop_s``. So q̈ is continuous, and a cycle covers
    drive_s − ramp_s of the path's time.

    Raises
    ------
    pydantic.ValidationError
        (a ValueError) if two ramps do not fit into ``drive_s``.
    """

    type: Literal["stop_and_go"] = "stop_and_go"
    path: Plain
    drive_s: Size
    stop_s: Annotated[NonNegative, Field(le=MAX_MAGNITUDE)]
    ramp_s: Annotated[Size, Field(ge=SHORTEST_RAMP_S)] = 2.0

    @model_validator(mode="after")
    def _check(self) -> Self:
        if 2 * self.ramp_s > self.drive_s:
            raise ValueError(f"ramp_s {self.ramp_s} must be at most half of drive_s {self.drive_s}")
        return self

    def warp(self, t_s: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """The path's time q (s), its rate q̇ (1) and q̈ (1/s)."""
        t_s = np.asarray(t_s, dtype=np.float64)
        ramp_s, cycle_s = self.ramp_s, self.drive_s + self.stop_s
        cycle = np.floor(t_s / cycle_s)
        t = np.clip(t_s - cycle * cycle_s, 0.0, self.drive_s)
        up = np.minimum(t / ramp_s, 1.0)
        down = np.minimum((self.drive_s - t) / ramp_s, 1.0)
        area_up, area_down = (x**3 * (1 - x / 2) for x in (up, down))
        rate_up, rate_down = (x**2 * (3 - 2 * x) for x in (up, down))
        slope_up, slope_down = (6 * x * (1 - x) / ramp_s for x in (up, down))
        q = t + ramp_s * (area_up - up - area_down + down - 0.5)
        return (
            cycle * (self.drive_s - ramp_s) + q,
            rate_up * rate_down,
            slope_up - slope_down,
        )

    def derivatives(self, t_s: np.ndarray) -> np.ndarray:
        """Position, velocity and acceleration by the chain rule: ``(3, 2, ...)`` in mm, mm/s, mm/s²."""
        q, rate, slope = self.warp(t_s)
        position, velocity, acceleration = self.path.derivatives(q)
        return np.stack([position, velocity * rate, acceleration * rate**2 + velocity * slope])

    def tangent(
        self, t_s: np.ndarray, velocity: np.ndarray, acceleration: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """The tangent of the path at its time q; it does not depend on the rate q̇."""
        q, rate, _ = self.warp(t_s)
        direction, turning = self.path.tangent(q, *self.path.derivatives(q)[1:])
        return direction, turning * rate


Trajectory = Annotated[
    Lissajous | Rose | Circle | Waypoints | StopAndGo, Field(discriminator="type")
]


def sample(trajectory: Trajectory, t_s: np.ndarray) -> np.ndarray:
    """Reference pose and twist ``(len(t_s), 5)``, columns as in :data:`REFERENCE_COLUMNS`.

    ``t_s`` is increasing; the heading is unwrapped along it. u₁* = √(ẋ² + ẏ²) and
    u₂* = θ̇* = (ẋÿ − ẏẍ)/u₁*². While the reference is at rest, u₁* and u₂* are 0 and θ* is its last
    heading, or its first one before any motion.
    """
    t_s = np.asarray(t_s, dtype=np.float64)
    (x, y), velocity, acceleration = trajectory.derivatives(t_s)
    (d_x, d_y), (r_x, r_y) = trajectory.tangent(t_s, velocity, acceleration)
    speed = np.sqrt(velocity[0] ** 2 + velocity[1] ** 2)
    square = d_x**2 + d_y**2
    turn = np.divide(d_x * r_y - d_y * r_x, square, out=np.zeros_like(square), where=square > 0)
    theta = np.unwrap(np.arctan2(-d_x, d_y))
    return np.stack([x, y, theta, speed, turn], axis=-1)


def started(t_s: np.ndarray, ramp_s: float) -> tuple[np.ndarray, np.ndarray]:
    """Time on the trajectory (s) at times after the start, and the rate at which it passes, each ``(time,)``.

    Within ``ramp_s`` the rate grows smoothly from 0 to 1, as 3x² − 2x³ with x = t/ramp; afterwards the
    reference is half a ramp behind one that starts at speed.
    """
    x = np.clip(t_s / ramp_s, 0.0, 1.0)
    ramping = ramp_s * (x**3 - x**4 / 2)
    return np.where(t_s < ramp_s, ramping, t_s - ramp_s / 2), 3 * x**2 - 2 * x**3


def reference_from(
    trajectory: Trajectory, t_s: np.ndarray, ramp_s: float = 0.0, phase_s: float = 0.0
) -> np.ndarray:
    """:func:`sample` of the reference at times after its start, ``(len(t_s), 5)``.

    It starts ``phase_s`` later on its trajectory; from rest, if ``ramp_s`` is above 0: see :func:`started`.
    """
    t_s = np.asarray(t_s, dtype=np.float64)
    if ramp_s == 0.0:
        return sample(trajectory, phase_s + t_s)
    course_s, rate = started(t_s, ramp_s)
    rows = sample(trajectory, phase_s + course_s)
    rows[:, 3:] *= rate[:, None]
    return rows
