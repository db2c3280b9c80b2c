"""Things of a world as pymunk bodies and shapes."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import partial
from typing import Any

import pymunk

from tlf_env.physics.world import (
    BoxShape,
    CircleShape,
    Course,
    PolygonShape,
    Surface,
    Wall,
    World,
    capsules_of,
    corners_of,
    mean_distance,
    placed,
)


@dataclass
class Pushed:
    """A body that can be pushed, and the constraints that are its friction on the floor."""

    body: pymunk.Body
    joints: tuple[pymunk.Constraint, ...]


@dataclass
class Mover:
    """A moving obstacle: its body, its course, and its time on it at the start of an episode."""

    body: pymunk.Body
    course: Course
    start_s: float
    random_start: bool
    speed_mm_s: float
    offset_s: float = 0.0  # drawn for the episode

    def at(self, time_s: float) -> tuple[float, float]:
        """Place at a time of the episode, mm."""
        return self.course.at(self.start_s + self.offset_s + time_s)

    def place(self, time_s: float, period_s: float) -> None:
        """Put the body where it is at a time, with the velocity that leads to its next place."""
        now = self.start_s + self.offset_s + time_s
        x, y = self.at(time_s)
        next_x, next_y = self.course.at(now + period_s)
        self.body.position = x, y
        self.body.velocity = (next_x - x) / period_s, (next_y - y) / period_s


def build_fixed(space: pymunk.Space, world: World) -> list[pymunk.Shape]:
    """Add walls and obstacles to a space; returns their shapes."""
    shapes: list[pymunk.Shape] = []
    for thing in world.fixed:
        own: list[pymunk.Shape]
        if isinstance(thing, Wall):
            own = [
                pymunk.Segment(
                    space.static_body, (one.x_1, one.y_1), (one.x_2, one.y_2), one.radius
                )
                for one in capsules_of(thing)
            ]
        elif isinstance(thing.shape, CircleShape):
            place = (thing.x_mm, thing.y_mm)
            own = [pymunk.Circle(space.static_body, thing.shape.radius_mm, place)]
        else:
            corners = placed(corners_of(thing.shape), thing.x_mm, thing.y_mm, thing.angle_rad)
            own = [pymunk.Poly(space.static_body, corners.tolist())]
        for shape in own:
            _surface(shape, thing)
        shapes += own
    if shapes:
        space.add(*shapes)
    return shapes


def build_pushables(
    space: pymunk.Space, world: World, gravity_mm_s2: float, floor: pymunk.Body
) -> list[Pushed]:
    """Add the bodies that can be pushed, with their friction on the floor."""
    found = []
    for thing in world.pushables:
        inertia = thing.inertia_kg_mm2 or plate_inertia(thing.shape, thing.mass_kg)
        body = pymunk.Body(thing.mass_kg, inertia)
        body.position, body.angle = (thing.x_mm, thing.y_mm), thing.angle_rad
        if thing.damping_per_s:
            body.velocity_func = partial(damped_velocity, thing.damping_per_s)
        space.add(body, _on_body(body, thing.shape, thing))
        grip = thing.floor_friction * thing.mass_kg * gravity_mm_s2
        # Without a bias a joint keeps no place; it only takes away velocity, up to its largest force.
        slide = pymunk.PivotJoint(floor, body, (thing.x_mm, thing.y_mm), (0.0, 0.0))
        turn = pymunk.GearJoint(floor, body, 0.0, 1.0)
        slide.max_bias = turn.max_bias = 0.0
        slide.max_force, turn.max_force = grip, grip * mean_distance(thing.shape)
        space.add(slide, turn)
        found.append(Pushed(body, (slide, turn)))
    return found


def build_movers(space: pymunk.Space, world: World) -> list[Mover]:
    """Add the moving obstacles."""
    found = []
    for thing in world.moving:
        body = pymunk.Body(body_type=pymunk.Body.KINEMATIC)
        body.angle = thing.angle_rad
        space.add(body, _on_body(body, thing.shape, thing))
        found.append(
            Mover(body, thing.course(), thing.start_s, thing.random_start, thing.speed_mm_s)
        )
    return found


def damped_velocity(
    rate_per_s: float,
    body: pymunk.Body,
    gravity: tuple[float, float],
    damping: float,
    dt: float,
) -> None:
    """Chipmunk's step of the velocity, which decreases at a rate besides."""
    pymunk.Body.update_velocity(body, gravity, damping * math.exp(-rate_per_s * dt), dt)


def plate_inertia(shape: Any, mass_kg: float) -> float:
    """Moment of inertia of a uniform plate about its place, kg·mm²."""
    if isinstance(shape, CircleShape):
        return float(pymunk.moment_for_circle(mass_kg, 0.0, shape.radius_mm))
    return float(pymunk.moment_for_poly(mass_kg, corners_of(shape).tolist()))


def _on_body(
    body: pymunk.Body, shape: CircleShape | BoxShape | PolygonShape, surface: Surface
) -> pymunk.Shape:
    made: pymunk.Shape
    if isinstance(shape, CircleShape):
        made = pymunk.Circle(body, shape.radius_mm)
    else:
        made = pymunk.Poly(body, corners_of(shape).tolist())
    _surface(made, surface)
    return made


def _surface(shape: pymunk.Shape, surface: Surface) -> None:
    shape.elasticity, shape.friction = surface.restitution, surface.friction
