"""The robots of a run as polygons, to scale."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from baselines.runs.run import Record
from tlf_env.physics.vehicle import RobotParameters
from tlf_env.rendering.looks import (
    CASTOR_WIDTH_MM,
    DRIVE_WHEEL_WIDTH_MM,
    NOSE,
    front_mm,
    outline_mm,
)


class BodyParts(NamedTuple):
    """A robot's polygons, each ``(corner, 2)``, mm, right and forward of the midpoint c of its axle."""

    outline: np.ndarray
    left: np.ndarray  # wheel
    right: np.ndarray
    nose: np.ndarray
    castor: np.ndarray  # right and forward of its pivot, along its fork
    pivot: np.ndarray  # of the castor, (2,)


def body_parts(robot: RobotParameters) -> BodyParts:
    """The polygons of a robot; the castor's wheel trails behind its pivot."""
    half_mm = robot.axle_width_mm / 2
    aside = np.array([half_mm, 0.0])
    tyre = _rectangle(DRIVE_WHEEL_WIDTH_MM, 2 * robot.wheel_radius_mm)
    castor = _rectangle(CASTOR_WIDTH_MM, 2 * robot.castor_radius_mm)
    return BodyParts(
        outline=outline_mm(robot),
        left=tyre - aside,
        right=tyre + aside,
        nose=front_mm(robot) * np.array(NOSE),
        castor=castor - (0.0, robot.castor_trail_mm),
        pivot=np.array([0.0, -robot.castor_pivot_mm]),
    )


def body_polygons(record: Record, row: int, number: int) -> list[np.ndarray]:
    """A robot at a row, to scale, mm: left wheel, right wheel, castor, nose; each ``(corner, 2)``.

    Body axes are e = (cos θ, sin θ), right, and f = (−sin θ, cos θ), forward. The castor's fork is
    turned by ``castor_rad``.
    """
    parts = body_parts(record.scenario.robot_models[number])
    c = np.array([record["x_mm"][row, number], record["y_mm"][row, number]])
    theta = record["theta_rad"][row, number]
    body, fork = axes_of(theta), axes_of(theta + record["castor_rad"][row, number])
    return [
        c + parts.left @ body,
        c + parts.right @ body,
        c + parts.pivot @ body + parts.castor @ fork,
        c + parts.nose @ body,
    ]


def axes_of(theta: float) -> np.ndarray:
    """A body's axes e and f, as rows."""
    return np.array([[np.cos(theta), np.sin(theta)], [-np.sin(theta), np.cos(theta)]])


def _rectangle(width: float, length: float) -> np.ndarray:
    return np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * (width / 2, length / 2)
