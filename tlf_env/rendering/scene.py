"""The data of a formation that one frame shows."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import NamedTuple

import numpy as np

from tlf_env.disturbances.model import PatchRow
from tlf_env.engine.formation import Formation
from tlf_env.physics.shapes import PlacedShape
from tlf_env.task.info import State

STILL_MM = 1e-3  # a smaller displacement has no direction


class Scene(NamedTuple):
    """The data of one frame; arrays ``(robot,)`` in mm, rad, s.

    Poses are those of the axle midpoint c; headings counter-clockwise from +y (unlike ROS REP-103, where
    heading 0 is +x).
    """

    t_s: float
    x_mm: np.ndarray
    y_mm: np.ndarray
    theta_rad: np.ndarray
    castor_rad: np.ndarray  # fork angle relative to the body
    wheel_angle_l_rad: np.ndarray
    wheel_angle_r_rad: np.ndarray
    reference_x_mm: np.ndarray  # each robot's own reference
    reference_y_mm: np.ndarray
    reference_theta_rad: np.ndarray
    ghost_x_mm: np.ndarray  # the predecessor one gap ago; NaN if none
    ghost_y_mm: np.ndarray
    ghost_theta_rad: np.ndarray
    slip_l_mm_s: np.ndarray
    slip_r_mm_s: np.ndarray
    slip_c_mm_s: np.ndarray
    position_error_mm: np.ndarray
    time_gap_error_s: np.ndarray
    lost: np.ndarray  # bool
    touched: np.ndarray  # bool
    touched_by: np.ndarray  # TouchedBy: what was touched first
    objects: tuple[PlacedShape, ...] = ()  # everything in the space but the robots


def scene_of(formation: Formation) -> Scene:
    """The present scene of a formation: the true state, in new arrays."""
    motion, contact = formation.named("motion"), formation.named("contact")
    reference, info = formation.reference(), formation.info()
    state = dict(zip(State._fields, formation.state().T, strict=True))
    ghost_x_mm, ghost_y_mm, ghost_theta_rad = _ghosts(formation, motion.theta)
    return Scene(
        t_s=formation.time_s,
        x_mm=state["x_mm"],
        y_mm=state["y_mm"],
        theta_rad=motion.theta.copy(),
        castor_rad=state["castor_rad"],
        wheel_angle_l_rad=motion.angle_l.copy(),
        wheel_angle_r_rad=motion.angle_r.copy(),
        reference_x_mm=reference.x.copy(),
        reference_y_mm=reference.y.copy(),
        reference_theta_rad=reference.theta.copy(),
        ghost_x_mm=ghost_x_mm,
        ghost_y_mm=ghost_y_mm,
        ghost_theta_rad=ghost_theta_rad,
        slip_l_mm_s=contact.slip_l.copy(),
        slip_r_mm_s=contact.slip_r.copy(),
        slip_c_mm_s=contact.slip_c.copy(),
        position_error_mm=info.position_error_mm.copy(),
        time_gap_error_s=info.time_gap_error_s.copy(),
        lost=formation.arrays.lost[0].copy(),
        touched=formation.arrays.touched[0].copy(),
        touched_by=formation.arrays.touched_by[0].copy(),
        objects=tuple(
            formation.plant.shapes(formation.arrays.rows("motion"), formation.step_count)
        ),
    )


def patches_of(formation: Formation) -> list[dict[str, float]]:
    """The patches of different friction under a formation, as :func:`named_patches`."""
    rows = formation.arrays.patches[formation.arrays.variants[0]].tolist()
    return named_patches(map(PatchRow._make, rows))


def named_patches(rows: Iterable[PatchRow]) -> list[dict[str, float]]:
    """Patches by ``x_mm``, ``y_mm``, ``radius_mm`` and ``scale``, without those that have no effect."""
    return [
        {"x_mm": patch.x, "y_mm": patch.y, "radius_mm": patch.radius, "scale": patch.scale}
        for patch in rows
        if patch.scale != 1
    ]


def _ghosts(formation: Formation, theta: np.ndarray) -> np.ndarray:
    """The ghosts of a formation now, as :func:`ghosts`."""
    step = formation.step_count - formation.scenario.gap_steps
    return ghosts(step, formation.true_positions, theta)


def ghosts(step: int, positions: Callable[[int], np.ndarray], theta: np.ndarray) -> np.ndarray:
    """Pose of every robot's predecessor one gap ago, ``(3, robot)``; NaN where there is none.

    Its heading is the direction of its motion, or its present heading if it was at rest.

    Parameters
    ----------
    step
        The control step one gap ago.
    positions
        Gives the true positions at a step, ``(2, robot)``, mm; also one step later.
    theta
        Present headings, ``(robot,)``, rad.
    """
    found = np.full((3, len(theta)), np.nan)
    if step < 0 or len(theta) == 1:
        return found
    before = positions(max(step - 1, 0))[:, :-1]  # of the predecessors
    after = positions(step + 1)[:, :-1]
    went_x, went_y = after - before
    found[:2, 1:] = positions(step)[:, :-1]
    moved = np.hypot(went_x, went_y) > STILL_MM
    found[2, 1:] = np.where(moved, np.arctan2(-went_x, went_y), theta[:-1])
    return found
