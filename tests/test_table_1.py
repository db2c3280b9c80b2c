"""Table I of the paper: every entry is on the page of the physics, with the value that the code has."""

from __future__ import annotations

import math
import re

import pytest
from page_tables import DOCS, numbers_in, rows_of
from physics_helpers import ICE, ROBOT, first, run

from tlf_env.physics.parameters import FrictionCurve, JointFriction, RobotParameters

JOINTS = (ROBOT.drive_joint, ROBOT.castor_joint, ROBOT.steering_joint)


def of_joints(field: str) -> tuple[float, ...]:
    return tuple(getattr(joint, field) for joint in JOINTS)


# Entries as printed, and their values here in the printed unit; a text is quoted as it is.
TABLE_I = {
    "total mass": (ROBOT.mass_kg,),
    "radius of lateral wheels": (ROBOT.wheel_radius_mm,),
    "distance between lateral wheels": (ROBOT.axle_width_mm,),
    "mass moment of inertia of lateral wheels": (ROBOT.wheel_inertia_kg_mm2,),
    "offset distance of centre of mass": "unknown",
    "gravity": (ROBOT.gravity_mm_s2 / 1000,),
    "static friction coefficient": of_joints("mu_static"),
    "dynamic friction coefficient": of_joints("mu_dynamic"),
    "friction arm": of_joints("friction_arm_mm"),
    "pin radius": of_joints("pin_radius_mm"),
    "bending reaction arm": of_joints("bending_arm_mm"),
    "stiction transition velocity": of_joints("stiction_speed_mm_s"),
    "dynamic transition velocity": tuple(
        joint.dynamic_speed_mm_s / joint.stiction_speed_mm_s for joint in JOINTS
    ),
    "friction torque preload": of_joints("preload_Nmm"),
    "effect: reaction force": "on, on, on",
    "effect: preload": ", ".join("on" if joint.preload_Nmm else "off" for joint in JOINTS),
    "effect: bending moment": ", ".join("on" if joint.bending else "off" for joint in JOINTS),
    "inactive during static": "off, off, off",
    "impact: stiffness": "10 N/mm",
    "impact: force exponent": "2.2",
    "impact: damping": "0.2 N·s/mm",
    "impact: penetration depth": "0.001 mm",
    "Coulomb: static friction coefficient": (ROBOT.tyre.mu_static,),
    "Coulomb: dynamic friction coefficient": (ROBOT.tyre.mu_dynamic,),
    "Coulomb: stiction transition velocity": (ROBOT.tyre.stiction_speed_mm_s,),
}


WITHOUT_COUNTERPART = ("inactive during static", *(one for one in TABLE_I if "impact" in one))


def table() -> dict[str, list[str]]:
    """The page's rows: by entry, without its symbol, what is printed and what it is here."""
    rows = rows_of("physics.md", "table 1")
    return {re.sub(r" \$.*\$", "", entry): cells for entry, cells in rows.items()}


def test_the_page_names_every_entry_in_the_papers_order():
    assert list(table()) == list(TABLE_I)


@pytest.mark.parametrize("entry", TABLE_I)
def test_a_printed_value_is_the_default_or_has_no_counterpart(entry):
    printed, here = table()[entry]
    value = TABLE_I[entry]
    assert here.startswith("no counterpart") == (entry in WITHOUT_COUNTERPART)
    if isinstance(value, str):
        assert printed == value
    else:
        assert numbers_in(printed) == pytest.approx(value, rel=1e-12)


def test_the_page_names_fields_that_exist():
    known = {
        *RobotParameters.model_fields,
        *JointFriction.model_fields,
        *FrictionCurve.model_fields,
    }
    named = {name for _, here in table().values() for name in re.findall(r"`(\w+)`", here)}
    assert named <= known
    # All that concerns friction is on the page but the tyres' second speed, which is not printed.
    assert set(JointFriction.model_fields) <= named


def test_a_preload_above_0_acts():
    """A wheel on ice, held by its axle alone: up to 5.86 N·mm, and μ_s times the preload more."""
    joint = ROBOT.drive_joint.model_copy(update={"preload_Nmm": 2.0})
    robot = ROBOT.model_copy(update={"drive_joint": joint})

    def holds(robot: RobotParameters) -> float:
        return first(
            lambda torque: (
                run(robot, seconds=0.05, torques_Nmm=(torque, 0), floor=ICE).motion.omega_l[-1] > 0
            ),
            5,
            7,
            1e-4,
        )

    assert holds(robot) - holds(ROBOT) == pytest.approx(joint.mu_static * 2.0, abs=3e-4)


def test_what_the_papers_contact_stiffness_would_do():
    """The page's figures, from its rows: ADAMS's impact force k·pᵉ + c·ṗ under the constant loads."""
    (k,), (e,), (c,) = (
        numbers_in(table()[f"impact: {name}"][0])
        for name in ("stiffness", "force exponent", "damping")
    )
    weight_N = ROBOT.mass_kg * ROBOT.gravity_mm_s2 / 1000
    drive, castor = (
        (share * weight_N / k) ** (1 / e)
        for share in (ROBOT.drive_load_share, ROBOT.castor_load_share)
    )
    slope = k * e * (2 * drive ** (e - 1) + castor ** (e - 1)) * 1000  # N/m
    rate = math.sqrt(slope / ROBOT.mass_kg)  # rad/s
    damping = 3 * c * 1000 / (2 * math.sqrt(slope * ROBOT.mass_kg))
    slowest_s = 1 / (rate * (damping - math.sqrt(damping**2 - 1)))
    base_mm = ROBOT.castor_pivot_mm + ROBOT.castor_trail_mm
    text = " ".join(
        (DOCS / "physics.md").read_text(encoding="utf-8").split("**Contact stiffness.**")[1].split()
    )
    for said in (
        f"sink in by {drive:.2f} mm (drive wheels) and {castor:.2f} mm (castor)",
        f"pitches the robot by {(drive - castor) / base_mm:.3f} rad",
        f"overdamped ({rate / (2 * math.pi):.1f} Hz, damping ratio {damping:.2f}), with a time "
        f"constant of {1000 * slowest_s:.0f} ms",
        f"smaller by up to {100 * drive / ROBOT.wheel_radius_mm:.1f} %",
        f"`radius_right` at {1 / (1 - drive / ROBOT.wheel_radius_mm):.4f}",
    ):
        assert said in text
