"""Borders of placed shapes: hulls of corners with a radius."""

from __future__ import annotations

import math

import numpy as np
import pymunk
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tlf_env.physics.shapes import PlacedShape, border, placed_link, placed_shape, signed_area
from tlf_env.physics.world import Capsule, gaps_to_capsule

HULLS = {
    "circle": np.array([(3.0, 4.0)]),
    "segment": np.array([(0.0, 0.0), (30.0, 10.0)]),
    "triangle": np.array([(0.0, 0.0), (30.0, 0.0), (10.0, 20.0)]),
    "with a straight corner": np.array(
        [(0.0, 0.0), (5.0, 0.0), (10.0, 0.0), (10.0, 9.0), (0.0, 9.0)]
    ),
    "no length": np.array([(1.0, 2.0), (1.0, 2.0)]),
}


def gaps(corners: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Distance of points from the nearest edge of a hull."""
    ends = np.roll(corners, -1, axis=0)
    edges = [Capsule(*a, *b, 0.0) for a, b in zip(corners.tolist(), ends.tolist(), strict=True)]
    return np.min([gaps_to_capsule(edge, points) for edge in edges], axis=0)


@pytest.mark.parametrize("name", HULLS)
@pytest.mark.parametrize("clockwise", [False, True])
@given(radius=st.floats(0.1, 100.0))
def test_a_border_is_a_radius_away_and_goes_round_once(
    name: str, clockwise: bool, radius: float
) -> None:
    corners = HULLS[name][::-1] if clockwise else HULLS[name]
    around = border(corners, radius)
    assert np.allclose(gaps(corners, around), radius)
    ends = np.roll(corners, -1, axis=0)
    edge = float(np.hypot(*(ends - corners).T).sum()) if len(corners) > 1 else 0.0
    hull_area = abs(signed_area(corners)) if len(corners) > 2 else 0.0
    expected = hull_area + edge * radius + math.pi * radius**2  # Steiner's formula
    assert signed_area(around) == pytest.approx(expected, rel=0.01)


@pytest.mark.parametrize("name", HULLS)
def test_without_a_radius_the_corners_are_the_border(name: str) -> None:
    assert np.array_equal(border(HULLS[name], 0.0), HULLS[name])


@given(x=st.floats(-1e4, 1e4), y=st.floats(-1e4, 1e4), angle=st.floats(-10.0, 10.0))
def test_a_shape_is_placed_as_pymunk_places_it(x: float, y: float, angle: float) -> None:
    body = pymunk.Body(1.0, 1.0)
    body.position, body.angle = (x, y), angle
    shapes = [
        (pymunk.Circle(body, 5.0, (3.0, 4.0)), [(3.0, 4.0)]),
        (pymunk.Segment(body, (0.0, 1.0), (7.0, 2.0), 0.5), [(0.0, 1.0), (7.0, 2.0)]),
    ]
    box = pymunk.Poly.create_box(body, (10.0, 4.0))
    shapes.append((box, [tuple(v) for v in box.get_vertices()]))
    for shape, corners in shapes:
        found = placed_shape(shape, (x, y, angle))
        assert isinstance(found, PlacedShape)
        assert found.kind == "loose"
        assert found.radius_mm == shape.radius
        there = [body.local_to_world(corner) for corner in corners]
        assert np.allclose(found.corners_mm, there, atol=1e-8)


@pytest.mark.parametrize("pose", [(math.nan, 0.0, 0.0), (0.0, math.inf, 0.0), (0.0, 0.0, math.inf)])
def test_a_shape_that_is_nowhere_has_no_place(pose: tuple[float, float, float]) -> None:
    body, other = pymunk.Body(1.0, 1.0), pymunk.Body(1.0, 1.0)
    rope = pymunk.SlideJoint(body, other, (0.0, 0.0), (1.0, 0.0), 0.0, 9.0)
    assert placed_shape(pymunk.Circle(body, 5.0), pose) is None
    assert placed_link(rope, (0.0, 0.0, 0.0), pose) is None
    assert placed_link(rope, (0.0, 0.0, 0.0), (2.0, 0.0, 0.0)) is not None
