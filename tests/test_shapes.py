"""Borders of placed shapes: hulls of corners with a radius."""

from __future__ import annotations

import math

import numpy as np
import pymunk
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tlf_env.physics.borders import Borders
from tlf_env.physics.parameters import convex
from tlf_env.physics.shapes import PlacedShape, border, placed_link, placed_shape, signed_area
from tlf_env.physics.world import Capsule, contains_origin, gaps_to_capsule, placed

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


@settings(max_examples=40, deadline=None)
@given(
    seed=st.integers(0, 10_000),
    count=st.integers(3, 12),
    scale=st.floats(1e-3, 1e6),
    stretch=st.floats(0.05, 1.0),
)
def test_corners_on_an_ellipse_are_convex_either_way_round_and_in_no_other_order(
    seed: int, count: int, scale: float, stretch: float
) -> None:
    rng = np.random.default_rng(seed)
    angles = 2.0 * math.pi * (np.arange(count) + rng.uniform(-0.3, 0.3, count)) / count
    corners = scale * np.stack([np.cos(angles), stretch * np.sin(angles)], axis=-1)
    corners = placed(corners, *rng.normal(size=2) * scale, rng.uniform(-3, 3))

    def is_convex(points: np.ndarray) -> bool:
        return convex(tuple((x, y) for x, y in points.tolist()))

    assert is_convex(corners)
    assert is_convex(corners[::-1])
    middles = (corners + np.roll(corners, -1, axis=0)) / 2
    with_middles = np.stack([corners, middles], axis=1).reshape(-1, 2)  # straight but for rounding
    assert is_convex(with_middles)
    if count > 3:
        exchanged = corners.copy()
        exchanged[[0, 1]] = corners[[1, 0]]
        assert not is_convex(exchanged)
    if count > 5:
        hollow = corners.copy()
        hollow[1] = corners.mean(axis=0)
        assert not is_convex(hollow)
    if count % 2:
        assert not is_convex(np.concatenate([corners[::2], corners[1::2]])) or count == 3
    assert not is_convex(np.concatenate([corners, corners]))  # twice around
    assert not is_convex(np.repeat(corners[:1], count, axis=0))
    assert not is_convex(corners[0] + np.outer(np.arange(count), corners[1] - corners[0]))


def test_the_area_of_a_triangle_is_half_its_base_times_its_height_as_a_plain_number() -> None:
    corners = np.array([(1.0, 2.0), (7.0, 2.0), (3.0, 6.0)])
    assert signed_area(corners) == pytest.approx(12.0)
    assert signed_area(corners[::-1]) == pytest.approx(-12.0)
    assert type(signed_area(corners)) is float


def test_borders_are_the_capsules_of_their_shapes_at_any_pose() -> None:
    one, other = pymunk.Body(1.0, 1.0), pymunk.Body(1.0, 1.0)
    shapes: list[pymunk.Shape] = [
        pymunk.Circle(one, 5.0, (3.0, 4.0)),
        pymunk.Poly(other, [(0.0, 0.0), (20.0, 0.0), (0.0, 10.0)], radius=1.5),
        pymunk.Segment(one, (0.0, 1.0), (7.0, 2.0), 0.5),
    ]
    borders = Borders([*shapes, pymunk.Circle(None, 9.0)])  # one of no body is nowhere
    assert borders.bodies == [one, other]
    assert borders.body_of.tolist() == [0, 1, 1, 1, 0]
    poses = [(100.0, -50.0, 0.7), (-300.0, 20.0, -2.1)]
    rows = borders.capsules(poses)
    assert rows[:, 4].tolist() == [5.0, 1.5, 1.5, 1.5, 0.5]
    ends = [np.array([[(3.0, 4.0)] * 2])]
    corners = np.array(shapes[1].get_vertices())  # type: ignore[attr-defined]
    ends.append(np.stack([corners, np.roll(corners, -1, axis=0)], axis=1))
    ends.append(np.array([[(0.0, 1.0), (7.0, 2.0)]]))
    for row, end, body in zip(rows, np.concatenate(ends), borders.body_of, strict=True):
        assert row[:4] == pytest.approx(placed(end, *poses[body]).ravel(), abs=1e-9)


@pytest.mark.parametrize("scale", [1e-3, 1.0, 1e6])
def test_a_polygon_contains_the_origin_strictly_inside_at_any_scale(scale: float) -> None:
    around = scale * np.array([(-1.0, -1.0), (2.0, -1.0), (0.0, 3.0)])

    def contains(points: np.ndarray) -> bool:
        return contains_origin(tuple((x, y) for x, y in points.tolist()))

    for corners in (around, around[::-1]):
        assert contains(corners)
        assert not contains(np.add(corners, (0.0, scale)))  # on its border
        assert not contains(np.add(corners, (2.5 * scale, 0.0)))
