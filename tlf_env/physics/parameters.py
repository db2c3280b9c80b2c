"""Parameters of the robot's body: Table I of the paper, and chosen values for what is not in it.

Units: mm, kg, s, rad; torques and torque limits N·mm; inertias kg·mm².
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Annotated, Any, NamedTuple, Self

import numpy as np
from pydantic import Field, model_validator

from tlf_env.common.models import Frozen, NonNegative, Number, Positive, Switch
from tlf_env.numerics.compiled import law
from tlf_env.physics.units import MILLINEWTON_PER_NEWTON

# Far beyond any robot, and near enough that products of all of them stay finite.
Length = Annotated[Positive, Field(ge=1e-3, le=1e6)]  # mm
Lever = Annotated[NonNegative, Field(le=1e6)]  # mm
Offset = Annotated[Number, Field(ge=-1e6, le=1e6)]  # mm
BodyMass = Annotated[Positive, Field(ge=1e-6, le=1e6)]  # kg
Inertia = Annotated[Positive, Field(ge=1e-6, le=1e15)]  # kg·mm²
Speed = Annotated[Positive, Field(ge=1e-6, le=1e6)]  # mm/s
Acceleration = Annotated[Positive, Field(ge=1e-3, le=1e7)]  # mm/s²
Coefficient = Annotated[NonNegative, Field(le=1e6)]  # so large a friction means that nothing slides
TorqueLimit = Annotated[Positive, Field(ge=1e-6, le=1e9)]  # N·mm
Preload = Annotated[NonNegative, Field(le=1e9)]  # N·mm

LOAD_SPLIT_TOLERANCE = 1e-9
CONVEX_TOLERANCE = 1e-9


def convex(points: tuple[tuple[float, float], ...]) -> bool:
    """Whether corners, in order, are those of a convex polygon with an area."""
    corners = np.array(points, dtype=np.float64)
    edges = np.roll(corners, -1, axis=0) - corners
    following = np.roll(edges, -1, axis=0)
    with np.errstate(over="ignore", invalid="ignore"):
        turns = edges[:, 0] * following[:, 1] - edges[:, 1] * following[:, 0]
        angles = np.arctan2(turns, (edges * following).sum(axis=1))
        longest_2 = (edges**2).sum(axis=1).max()
    if not np.abs(turns).max() > CONVEX_TOLERANCE * longest_2:
        return False  # all on a line
    room = CONVEX_TOLERANCE * np.abs(turns).max()
    one_way = bool((turns >= -room).all() or (turns <= room).all())
    once_around = abs(abs(float(angles.sum())) - 2 * math.pi) < 1e-6
    return one_way and once_around


class FrictionCurve(Frozen):
    """Friction coefficient against speed (paper, Fig. 3b): static, then a smooth decrease to dynamic.

    ``mu_static`` applies up to ``stiction_speed_mm_s`` (v_s), ``mu_dynamic`` above
    ``dynamic_speed_mm_s`` (v_d). At zero speed the law is set-valued: true stiction.
    """

    mu_static: Coefficient
    mu_dynamic: Coefficient
    stiction_speed_mm_s: Speed
    dynamic_speed_mm_s: Speed

    @model_validator(mode="after")
    def _check(self) -> Self:
        if self.mu_dynamic > self.mu_static:
            raise ValueError(
                f"mu_dynamic {self.mu_dynamic} must be at most mu_static {self.mu_static}"
            )
        if self.dynamic_speed_mm_s <= self.stiction_speed_mm_s:
            raise ValueError(
                f"dynamic_speed_mm_s {self.dynamic_speed_mm_s} must be above "
                f"stiction_speed_mm_s {self.stiction_speed_mm_s}"
            )
        return self


class JointFriction(FrictionCurve):
    """Friction torque of a revolute joint, eq. (5), with the on/off settings of Table I."""

    friction_arm_mm: Lever  # R_n, lever of the axial force
    pin_radius_mm: Lever  # R_p, lever of the radial force
    bending_arm_mm: Length  # R_b, divides the bending moment
    preload_Nmm: Preload = 0.0  # T_pre; off in Table I
    bending: Switch = True  # friction from the bending moment; on in Table I


def _joint(
    mu_static: float, mu_dynamic: float, arms_mm: tuple[float, float, float]
) -> JointFriction:
    friction_arm_mm, pin_radius_mm, bending_arm_mm = arms_mm
    return JointFriction(
        mu_static=mu_static,
        mu_dynamic=mu_dynamic,
        stiction_speed_mm_s=1.0,
        dynamic_speed_mm_s=1.5,
        friction_arm_mm=friction_arm_mm,
        pin_radius_mm=pin_radius_mm,
        bending_arm_mm=bending_arm_mm,
    )


class RobotParameters(Frozen):
    """One robot: chassis, two drive wheels, castor fork, castor wheel.

    The centre of mass lies ``com_offset_mm`` behind the axle midpoint c, the castor's pivot
    ``castor_pivot_mm`` behind c, and its floor contact ``castor_trail_mm`` behind the pivot.
    Fields marked *chosen* are not in the paper.

    Raises
    ------
    pydantic.ValidationError
        (a ValueError) for a value outside its range, an unknown field, or wheel loads that contradict
        the position of the centre of mass.
    """

    # Table I
    mass_kg: BodyMass = 1.245
    wheel_radius_mm: Length = 50.0
    axle_width_mm: Length = 156.0
    wheel_inertia_kg_mm2: Inertia = 52.91
    gravity_mm_s2: Acceleration = 9807.0
    # Section II-B: 0.8 of the weight on the drive wheels, 0.2 on the castor
    drive_load_share: Annotated[Number, Field(gt=0, le=0.5)] = 0.4
    castor_load_share: Annotated[Number, Field(ge=0, lt=1)] = 0.2
    # chosen
    body_inertia_kg_mm2: Inertia = 6197.0
    com_offset_mm: Lever = 20.0
    castor_pivot_mm: Length = 85.0
    castor_trail_mm: Length = 15.0
    castor_radius_mm: Length = 20.0
    castor_inertia_kg_mm2: Inertia = 4.0
    fork_inertia_kg_mm2: Inertia = 20.0
    # The outline is a circle, or a convex polygon with corners (right, forward of c); then radius and offset
    # are those of a circle around it.
    outline_radius_mm: Length = 110.0
    outline_offset_mm: Offset = 30.0  # centre of the outline's circle, behind c
    outline_polygon_mm: (
        Annotated[tuple[tuple[Offset, Offset], ...], Field(min_length=3, max_length=100)] | None
    ) = None
    # A contact has the product of both surfaces' values, as in Chipmunk.
    outline_restitution: Annotated[Number, Field(ge=0, le=1)] = 0.0
    outline_friction: Coefficient = 0.0  # coefficient of Coulomb friction
    # footnote 4
    torque_limit_Nmm: TorqueLimit = 15.0
    # Table I; it does not give the tyres' v_d: 1.5 v_s, as for the joints
    tyre: FrictionCurve = FrictionCurve(
        mu_static=0.073, mu_dynamic=0.055, stiction_speed_mm_s=2.0, dynamic_speed_mm_s=3.0
    )
    drive_joint: JointFriction = _joint(0.15, 0.1, (12.0, 8.0, 36.0))
    castor_joint: JointFriction = _joint(0.15, 0.1, (6.2, 3.025, 30.0))
    steering_joint: JointFriction = _joint(0.05, 0.033, (2.5, 2.5, 3.0))
    joint_friction: Switch = True  # False turns eq. (5) off for all joints

    @property
    def outline_front_mm(self) -> float:
        """How far the outline reaches ahead of c."""
        return self.outline_radius_mm - self.outline_offset_mm

    @model_validator(mode="before")
    @classmethod
    def _circle_around_the_polygon(cls, data: Any) -> Any:
        """Radius and offset of a circle around the polygon, if they are not given."""
        if not isinstance(data, Mapping) or data.get("outline_polygon_mm") is None:
            return data
        try:
            corners = np.array(data["outline_polygon_mm"], dtype=np.float64).reshape(-1, 2)
            forward = float(corners[:, 1].min() + corners[:, 1].max()) / 2
            radius = float(np.hypot(corners[:, 0], corners[:, 1] - forward).max())
        except (TypeError, ValueError):
            return data  # the field's own check says what is wrong
        return {"outline_offset_mm": -forward, "outline_radius_mm": radius} | dict(data)

    @model_validator(mode="after")
    def _check_outline(self) -> Self:
        polygon = self.outline_polygon_mm
        if polygon is None:
            return self
        if not convex(polygon):
            raise ValueError(
                f"outline_polygon_mm {polygon} must be the corners of a convex polygon, in order"
            )
        reach = max(math.hypot(x, y + self.outline_offset_mm) for x, y in polygon)
        if reach > self.outline_radius_mm * (1 + LOAD_SPLIT_TOLERANCE):
            raise ValueError(
                f"outline_radius_mm {self.outline_radius_mm} and outline_offset_mm "
                f"{self.outline_offset_mm} do not contain outline_polygon_mm; leave them out or give at "
                f"least {reach:g}"
            )
        return self

    @model_validator(mode="after")
    def _check_loads(self) -> Self:
        total = 2 * self.drive_load_share + self.castor_load_share
        if abs(total - 1) > LOAD_SPLIT_TOLERANCE:
            raise ValueError(f"2·drive_load_share + castor_load_share is {total}; it must be 1")
        base_mm = self.castor_pivot_mm + self.castor_trail_mm
        needed_mm = self.castor_load_share * base_mm
        if abs(needed_mm - self.com_offset_mm) > LOAD_SPLIT_TOLERANCE * base_mm:
            raise ValueError(
                f"com_offset_mm {self.com_offset_mm} does not fit castor_load_share "
                f"{self.castor_load_share}: moments about the axle need castor_load_share·"
                f"(castor_pivot_mm + castor_trail_mm) = {needed_mm:g}"
            )
        return self


class Joint(NamedTuple):
    """Eq. (5) in kernel units, with constant parts combined: T_f = μ(v)·(constant + radial + bending).

    ``axial`` (mm) multiplies the axial force, ``radial`` (mm) the radial one, ``bending`` the bending
    moment; ``preload`` is in mN·mm.
    """

    mu_static: float
    mu_dynamic: float
    stiction_speed: float
    dynamic_speed: float
    axial: float
    radial: float
    bending: float
    preload: float


class Mass(NamedTuple):
    """The constants that a payload changes: the first fields of :class:`Body`, in the same order."""

    m: float
    I: float  # noqa: E741  the symbol of the equations
    d: float
    q: float
    load_drive: float
    load_castor: float
    w_ee: float
    w_ff: float
    w_ef: float
    I_rolling: float  # about c, with the drive wheels' spins: I + m d² + 2 J h²/R²
    inverse_m: float
    inverse_I: float
    outline_ahead: float  # centre of the outline ahead of the centre of mass


class Body(NamedTuple):
    """Constants of one robot for the kernel, in mN, mm, kg, s; inverse masses are computed once.

    Names as in ``docs/physics.md``: h half the axle width, d distance of the centre of mass behind c, q
    distance of the pivot behind the centre of mass, T trail; subscripts e to the right, f forward.
    """

    # the fields of Mass
    m: float
    I: float  # noqa: E741  the symbol of the equations
    d: float
    q: float
    load_drive: float
    load_castor: float
    w_ee: float
    w_ff: float
    w_ef: float
    I_rolling: float
    inverse_m: float
    inverse_I: float
    outline_ahead: float
    # not changed by a payload
    I_s: float
    J: float
    J_c: float
    R: float
    R_c: float
    h: float
    T: float
    spin_drive: float  # R²/J
    spin_castor: float  # R_c²/J_c
    spin_mass_drive: float  # J/R²
    spin_mass_castor: float  # J_c/R_c²
    inverse_I_s: float
    inverse_J: float
    inverse_J_c: float
    torque_limit: float
    outline_radius: float
    gravity: float
    pivot: float  # castor's pivot behind c
    outline_behind: float  # centre of the outline behind c
    # tyre
    mu_static: float
    mu_dynamic: float
    stiction_speed: float
    dynamic_speed: float
    # eq. (5): drive wheels, castor axle, steering axle
    drive_mu_static: float
    drive_mu_dynamic: float
    drive_stiction_speed: float
    drive_dynamic_speed: float
    drive_axial: float
    drive_radial: float
    drive_bending: float
    drive_preload: float
    axle_mu_static: float
    axle_mu_dynamic: float
    axle_stiction_speed: float
    axle_dynamic_speed: float
    axle_axial: float
    axle_radial: float
    axle_bending: float
    axle_preload: float
    steer_mu_static: float
    steer_mu_dynamic: float
    steer_stiction_speed: float
    steer_dynamic_speed: float
    steer_axial: float
    steer_radial: float
    steer_bending: float
    steer_preload: float
    steer_pin: float  # R_p of the steering axle: its friction speed is R_p·φ̇


def _joint_row(joint: JointFriction, *, enabled: bool) -> Joint:
    on = 1.0 if enabled else 0.0
    return Joint(
        mu_static=on * joint.mu_static,
        mu_dynamic=on * joint.mu_dynamic,
        stiction_speed=joint.stiction_speed_mm_s,
        dynamic_speed=joint.dynamic_speed_mm_s,
        axial=joint.friction_arm_mm,
        radial=joint.pin_radius_mm,
        bending=joint.pin_radius_mm / joint.bending_arm_mm if joint.bending else 0.0,
        preload=joint.preload_Nmm * MILLINEWTON_PER_NEWTON,
    )


def _prefixed(prefix: str, joint: Joint) -> dict[str, float]:
    """A joint's numbers by the names of their fields in :class:`Body`."""
    return {f"{prefix}_{name}": value for name, value in joint._asdict().items()}


def weighed(
    m: float,
    I: float,  # noqa: E741  the symbol of the equations
    d: float,
    drive_share: float,
    castor_share: float,
    gravity: float,
    pivot: float,
    h: float,
    spin_mass: float,
    outline_behind: float,
) -> Mass:
    """Constants that follow from mass, inertia, centre of mass and each wheel's share of the weight."""
    weight = m * gravity
    inverse_m, inverse_I = 1.0 / m, 1.0 / I
    return Mass(
        m=m,
        I=I,
        d=d,
        q=pivot - d,
        load_drive=drive_share * weight,
        load_castor=castor_share * weight,
        w_ee=inverse_m + d * d * inverse_I,
        w_ff=inverse_m + h * h * inverse_I,
        w_ef=d * h * inverse_I,
        I_rolling=I + m * (d * d) + 2.0 * spin_mass * (h * h),
        inverse_m=inverse_m,
        inverse_I=inverse_I,
        outline_ahead=d - outline_behind,
    )


compiled_weighed = law(weighed)


@law
def laden(empty: Body, mass: float, behind: float, inertia: float) -> Mass:
    """Constants of the robot with a payload (kg, mm behind c, kg·mm² about the payload's centre).

    The wheels can carry the payload if the common centre of mass ``d`` lies above their base, between 0
    and ``pivot + T``.
    """
    m = empty.m + mass
    d = (empty.m * empty.d + mass * behind) / m
    own, other = d - empty.d, behind - d
    castor_share = d / (empty.pivot + empty.T)
    return compiled_weighed(
        m=m,
        I=empty.I + empty.m * (own * own) + inertia + mass * (other * other),
        d=d,
        drive_share=(1.0 - castor_share) / 2.0,
        castor_share=castor_share,
        gravity=empty.gravity,
        pivot=empty.pivot,
        h=empty.h,
        spin_mass=empty.spin_mass_drive,
        outline_behind=empty.outline_behind,
    )


def body(robot: RobotParameters) -> Body:
    """Kernel constants of one robot."""
    half_mm = robot.axle_width_mm / 2
    spin_mass = robot.wheel_inertia_kg_mm2 / robot.wheel_radius_mm**2
    mass = weighed(
        m=robot.mass_kg,
        I=robot.body_inertia_kg_mm2,
        d=robot.com_offset_mm,
        drive_share=robot.drive_load_share,
        castor_share=robot.castor_load_share,
        gravity=robot.gravity_mm_s2,
        pivot=robot.castor_pivot_mm,
        h=half_mm,
        spin_mass=spin_mass,
        outline_behind=robot.outline_offset_mm,
    )
    on = robot.joint_friction
    return Body(
        **mass._asdict(),
        I_s=robot.fork_inertia_kg_mm2,
        J=robot.wheel_inertia_kg_mm2,
        J_c=robot.castor_inertia_kg_mm2,
        R=robot.wheel_radius_mm,
        R_c=robot.castor_radius_mm,
        h=half_mm,
        T=robot.castor_trail_mm,
        spin_drive=robot.wheel_radius_mm**2 / robot.wheel_inertia_kg_mm2,
        spin_castor=robot.castor_radius_mm**2 / robot.castor_inertia_kg_mm2,
        spin_mass_drive=spin_mass,
        spin_mass_castor=robot.castor_inertia_kg_mm2 / robot.castor_radius_mm**2,
        inverse_I_s=1 / robot.fork_inertia_kg_mm2,
        inverse_J=1 / robot.wheel_inertia_kg_mm2,
        inverse_J_c=1 / robot.castor_inertia_kg_mm2,
        torque_limit=robot.torque_limit_Nmm * MILLINEWTON_PER_NEWTON,
        outline_radius=robot.outline_radius_mm,
        gravity=robot.gravity_mm_s2,
        pivot=robot.castor_pivot_mm,
        outline_behind=robot.outline_offset_mm,
        mu_static=robot.tyre.mu_static,
        mu_dynamic=robot.tyre.mu_dynamic,
        stiction_speed=robot.tyre.stiction_speed_mm_s,
        dynamic_speed=robot.tyre.dynamic_speed_mm_s,
        **_prefixed("drive", _joint_row(robot.drive_joint, enabled=on)),
        **_prefixed("axle", _joint_row(robot.castor_joint, enabled=on)),
        **_prefixed("steer", _joint_row(robot.steering_joint, enabled=on)),
        steer_pin=robot.steering_joint.pin_radius_mm,
    )


def body_array(robots: list[RobotParameters], lanes: int = 1) -> np.ndarray:
    """Constants of a formation, ``(field, robot, lane)``, the same in every lane (formation of a batch)."""
    rows = np.array([body(robot) for robot in robots], dtype=np.float64)
    return np.ascontiguousarray(np.repeat(rows.T[:, :, None], lanes, axis=2))
