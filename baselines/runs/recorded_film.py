"""The film of a recorded run, from its columns: nothing is simulated again."""

from __future__ import annotations

import numpy as np

from baselines.runs.borders import patches
from baselines.runs.run import Record
from baselines.runs.video import FPS, Film
from tlf_env.physics.shapes import Kind, PlacedShape
from tlf_env.physics.world import CircleShape, Shape, Wall, capsules_of, corners_of, placed
from tlf_env.rendering.scene import Scene, ghosts, named_patches


def film_of(record: Record, fps: float = FPS, speed: float = 1.0) -> Film:
    """The film of a run, as one that was kept while it went.

    Parameters
    ----------
    fps, speed
        As of :class:`~baselines.runs.video.Film`.

    Raises
    ------
    ValueError
        as :class:`~baselines.runs.video.Film`.
    """
    film = Film(fps, speed)
    period_s = record.scenario.control_period_s
    angles = [_turned(record[name], period_s) for name in ("omega_l_rad_s", "omega_r_rad_s")]
    rows = [row for row, t_s in enumerate(record.t_s) for _ in range(film.frames_at(t_s, period_s))]
    fixed = fixed_shapes(record)
    film.keep(
        [_scene(record, row, angles, fixed) for row in rows],
        robots=record.scenario.robot_models,
        path_mm=record.leader,
        fps=1 / period_s,
        patches=named_patches(patches(record)),
        courses_mm=[thing.corners_mm() for thing in record.scenario.world.moving],
    )
    return film


def _turned(speeds_rad_s: np.ndarray, period_s: float) -> np.ndarray:
    """Angles of the wheels, ``(time, robot)``: the integral of their speeds."""
    means = (speeds_rad_s[1:] + speeds_rad_s[:-1]) / 2
    return np.concatenate([np.zeros_like(speeds_rad_s[:1]), np.cumsum(means, axis=0) * period_s])


def _scene(record: Record, row: int, angles: list[np.ndarray], fixed: list[PlacedShape]) -> Scene:
    def of(name: str) -> np.ndarray:
        values: np.ndarray = record[name][row]
        return values

    ghost = ghosts(
        row - record.scenario.gap_steps,
        lambda step: np.stack([record["x_mm"][step], record["y_mm"][step]]),
        of("theta_rad"),
    )
    t_s = float(record.t_s[row])
    touched = record.touched_at_s <= t_s + 1e-9
    return Scene(
        t_s=t_s,
        x_mm=of("x_mm"),
        y_mm=of("y_mm"),
        theta_rad=of("theta_rad"),
        castor_rad=of("castor_rad"),
        wheel_angle_l_rad=angles[0][row],
        wheel_angle_r_rad=angles[1][row],
        reference_x_mm=of("reference_x_mm"),
        reference_y_mm=of("reference_y_mm"),
        reference_theta_rad=of("reference_theta_rad"),
        ghost_x_mm=ghost[0],
        ghost_y_mm=ghost[1],
        ghost_theta_rad=ghost[2],
        slip_l_mm_s=of("tyre_slip_left_mm_s"),
        slip_r_mm_s=of("tyre_slip_right_mm_s"),
        slip_c_mm_s=of("tyre_slip_castor_mm_s"),
        position_error_mm=of("position_error_mm"),
        time_gap_error_s=of("time_gap_error_s"),
        lost=record.lost_at_s <= t_s + 1e-9,
        touched=touched,
        touched_by=np.where(touched, record.touched_by, 0),
        objects=(*fixed, *moved_shapes(record, row)),
    )


def fixed_shapes(record: Record) -> list[PlacedShape]:
    """Walls, piece by piece, and obstacles."""
    found = []
    for thing in record.scenario.world.fixed:
        if isinstance(thing, Wall):
            found += [
                PlacedShape("fixed", ((one.x_1, one.y_1), (one.x_2, one.y_2)), one.radius)
                for one in capsules_of(thing)
            ]
        else:
            found.append(_shape("fixed", thing.shape, thing.x_mm, thing.y_mm, thing.angle_rad))
    return found


def moved_shapes(record: Record, row: int) -> list[PlacedShape]:
    """Things that can be pushed, and moving obstacles, at a row of the record."""
    if record.objects is None:
        return []
    world = record.scenario.world
    poses = record.objects[row].tolist()
    shapes: list[tuple[Kind, Shape]] = [("loose", thing.shape) for thing in world.pushables]
    shapes += [("moving", thing.shape) for thing in world.moving]
    return [_shape(*one, *pose) for one, pose in zip(shapes, poses, strict=True)]


def _shape(kind: Kind, shape: Shape, x_mm: float, y_mm: float, angle_rad: float) -> PlacedShape:
    if isinstance(shape, CircleShape):
        return PlacedShape(kind, ((x_mm, y_mm),), shape.radius_mm)
    corners = placed(corners_of(shape), x_mm, y_mm, angle_rad)
    return PlacedShape(kind, tuple((x, y) for x, y in corners.tolist()), 0.0)
