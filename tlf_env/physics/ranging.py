"""Distances along rays to what they meet."""

from __future__ import annotations

import math

from tlf_env.numerics.compiled import law
from tlf_env.physics.world import Capsule

JOINT_MM = 1e-6  # so much longer is each side, that no ray slips through where two of them join


@law
def way_to(capsule: Capsule, x: float, y: float, ray_x: float, ray_y: float) -> float:
    """Distance from a point to a capsule along a ray (a unit vector), mm.

    0 if the point is inside, infinity if the ray misses the capsule.
    """
    along_x, along_y = capsule.x_2 - capsule.x_1, capsule.y_2 - capsule.y_1
    to_x, to_y = capsule.x_1 - x, capsule.y_1 - y
    radius = capsule.radius
    length = math.sqrt(along_x * along_x + along_y * along_y)
    beside = math.inf  # distance of the point from the capsule's axis, if it is beside it
    nearest = math.inf
    if length > 0.0:
        side_x, side_y = along_x / length, along_y / length
        before = -(to_x * side_x + to_y * side_y)  # the point's place along the axis
        left = to_x * side_y - to_y * side_x  # and to the left of it
        if 0.0 <= before <= length:
            beside = abs(left)
        towards = side_x * ray_y - side_y * ray_x  # how fast the ray goes to the left
        if left > 0.0:
            towards = -towards
        if abs(left) > radius and towards > 0.0:
            way = (abs(left) - radius) / towards
            place = before + way * (side_x * ray_x + side_y * ray_y)
            if -JOINT_MM <= place <= length + JOINT_MM:
                nearest = way
    if beside <= radius:
        return 0.0
    # Both ends are discs.
    for end in range(2):
        end_x, end_y = to_x + end * along_x, to_y + end * along_y
        ahead = end_x * ray_x + end_y * ray_y
        aside = end_x * ray_y - end_y * ray_x
        if end_x * end_x + end_y * end_y <= radius * radius:
            return 0.0
        inside = radius * radius - aside * aside
        if ahead >= 0.0 and inside >= 0.0:
            nearest = min(nearest, ahead - math.sqrt(inside))
    return nearest
