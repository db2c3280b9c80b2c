"""Range sensors: what the rays of a robot meet, and what its observations report of it."""

from __future__ import annotations

import math

import numpy as np

from tlf_env.disturbances.channels import RAYS
from tlf_env.engine.arrays import Arrays, read_motion
from tlf_env.engine.layout import in_array
from tlf_env.engine.outlines import outline_centre
from tlf_env.engine.settings import Settings
from tlf_env.numerics.compiled import law
from tlf_env.numerics.philox import normal_pair
from tlf_env.onboard.rays import MAX_RAYS
from tlf_env.physics.ranging import way_to
from tlf_env.physics.world import Capsule
from tlf_env.task.observation import scaled

BODY_OUTLINE = in_array("body", "outline_radius")
MOST_PAIRS = -(-MAX_RAYS // 2)  # of normal numbers in a reading; so their index depends on no count


@law
def is_reading(arrays: Arrays, lane: int, settings: Settings) -> bool:
    """Whether there are range sensors, and they take a reading in the present control step."""
    return arrays.ranges.shape[2] > 0 and arrays.clock[lane, 1] % settings.ray_period == 0


@law
def capsule_at(capsules: np.ndarray, number: int) -> Capsule:
    """A row of ``(number, Capsule)``."""
    return Capsule(
        capsules[number, 0],
        capsules[number, 1],
        capsules[number, 2],
        capsules[number, 3],
        capsules[number, 4],
    )


@law
def meet(arrays: Arrays, lane: int, robot: int, capsule: Capsule, settings: Settings) -> None:
    """Shorten the rays of a robot that end at a capsule."""
    x, y = outline_centre(arrays, lane, robot)
    along_x, along_y = capsule.x_2 - capsule.x_1, capsule.y_2 - capsule.y_1
    half = math.sqrt(along_x * along_x + along_y * along_y) / 2.0
    from_x, from_y = (capsule.x_1 + capsule.x_2) / 2.0 - x, (capsule.y_1 + capsule.y_2) / 2.0 - y
    away = math.sqrt(from_x * from_x + from_y * from_y)
    if away - half - capsule.radius >= settings.ray_range:
        return
    theta = read_motion(arrays.states, robot, lane).theta
    sin, cos = math.sin(theta), math.cos(theta)
    for ray in range(arrays.ranges.shape[2]):
        ahead, left = arrays.rays[ray, 0], arrays.rays[ray, 1]
        way = way_to(capsule, x, y, -ahead * sin - left * cos, ahead * cos - left * sin)
        arrays.ranges[lane, robot, ray] = min(arrays.ranges[lane, robot, ray], way)


@law
def cast_rays(arrays: Arrays, lane: int, robot: int, settings: Settings) -> None:
    """Distances of a robot to the static world, and to the other robots if all outlines are circles."""
    for ray in range(arrays.ranges.shape[2]):
        arrays.ranges[lane, robot, ray] = settings.ray_range
    for number in range(arrays.walls.shape[0]):
        meet(arrays, lane, robot, capsule_at(arrays.walls, number), settings)
    if settings.round_outlines:
        for other in range(arrays.states.shape[1]):
            if other != robot:
                x, y = outline_centre(arrays, lane, other)
                radius = arrays.constants[BODY_OUTLINE, other, lane]
                meet(arrays, lane, robot, Capsule(x, y, x, y, radius), settings)


@law
def report_rays(arrays: Arrays, lane: int, robot: int, settings: Settings) -> None:
    """Write a robot's distances, with noise, at the end of its observations."""
    count = arrays.ranges.shape[2]
    first = arrays.observations.shape[2] - count
    sensor_first = arrays.sensor_observations.shape[2] - count
    step, episode = arrays.clock[lane, 1], arrays.clock[lane, 2]
    even = odd = 0.0
    for ray in range(count):
        reading = arrays.ranges[lane, robot, ray]
        if settings.ray_noise > 0.0:
            if ray % 2 == 0:
                index = step * MOST_PAIRS + ray // 2
                even, odd = normal_pair(arrays.seeds[lane], RAYS, robot, episode, index)
            reading += settings.ray_noise * (even if ray % 2 == 0 else odd)
            reading = min(max(reading, 0.0), settings.ray_range)
        place = first + ray
        arrays.observations[lane, robot, place] = scaled(reading, arrays.scales[place])
        if sensor_first >= 0:
            place = sensor_first + ray
            arrays.sensor_observations[lane, robot, place] = scaled(
                reading, arrays.sensor_scales[place]
            )
