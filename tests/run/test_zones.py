"""Polygons against Matplotlib's, closed forms and a brute-force distance."""

import math

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from matplotlib.path import Path

from skyless.run.zones import area_m2, depth_m, is_simple, perimeter_m

pytestmark = pytest.mark.site

COORDINATE = st.floats(-50.0, 50.0).map(lambda value: round(value, 3))
POINT = st.tuples(COORDINATE, COORDINATE)


@st.composite
def stars(draw):
    """Simple polygons: corners in the order of their bearing from the middle."""
    count = draw(st.integers(3, 12))
    radii = draw(st.lists(st.floats(0.5, 20.0), min_size=count, max_size=count))
    x0, y0 = draw(POINT)
    bearings = [2 * math.pi * (k + 0.3 * draw(st.floats(0.0, 1.0))) / count for k in range(count)]
    return tuple((x0 + r * math.cos(b), y0 + r * math.sin(b)) for r, b in zip(radii, bearings, strict=True))


@given(stars(), POINT)
def test_inside_is_what_matplotlib_calls_inside(polygon, point):
    depth = depth_m(point, polygon)
    assume(abs(depth) > 1e-9)
    assert (depth > 0.0) == Path([*polygon, polygon[0]], closed=True).contains_point(point)


@given(stars(), POINT)
def test_the_distance_is_that_of_the_nearest_point_on_the_sides(polygon, point):
    corners = np.array([*polygon, polygon[0]])
    share = np.linspace(0.0, 1.0, 201)[:, None, None]
    along = corners[:-1] + share * np.diff(corners, axis=0)
    sampled = np.linalg.norm(along - np.array(point), axis=-1).min()
    spacing = np.linalg.norm(np.diff(corners, axis=0), axis=1).max() / 200
    assert sampled - spacing <= abs(depth_m(point, polygon)) <= sampled + 1e-9


@given(stars())
def test_polygons_around_a_middle_do_not_cross_themselves(polygon):
    assert is_simple(polygon)
    assert is_simple(polygon[::-1])


@given(stars(), st.data())
def test_two_corners_in_the_wrong_order_cross(polygon, data):
    assume(len(polygon) >= 4)
    k = data.draw(st.integers(0, len(polygon) - 1))
    turned = list(polygon[k:] + polygon[:k])
    crossing = _crossing_of([turned[0], turned[2], turned[1], turned[3]])
    assume(crossing)
    turned[1], turned[2] = turned[2], turned[1]
    assert not is_simple(tuple(turned))


def _crossing_of(corners):
    """Whether the first and last sides of a run of four corners cross properly, by solving for the point."""
    a, b, c, d = (np.array(corner) for corner in corners)
    matrix = np.column_stack([b - a, c - d])
    if abs(np.linalg.det(matrix)) < 1e-6:
        return False
    s, t = np.linalg.solve(matrix, c - a)
    return 0.01 < s < 0.99 and 0.01 < t < 0.99


@pytest.mark.parametrize(
    "polygon",
    [
        ((0, 0), (1, 1), (1, 0), (0, 1)),  # a bow tie
        ((0, 0), (1, 0), (2, 0)),  # no area
        ((0, 0), (1, 0), (1, 0), (1, 1)),  # a corner twice
        ((0, 0), (4, 0), (4, 4), (2, 0), (0, 4)),  # a corner on a side
        ((0, 0), (2, 0), (1, 0), (1, 1)),  # a side that runs back
        ((0, 0), (1, 0), (2, 1), (1, 0), (0, 1)),  # two corners in one place
    ],
)
def test_what_touches_itself_is_not_simple(polygon):
    assert not is_simple(polygon)


@given(st.floats(0.1, 50.0), st.floats(0.1, 50.0), POINT)
def test_rectangles_have_the_area_and_perimeter_of_the_book(width, height, corner):
    x, y = corner
    rectangle = ((x, y), (x + width, y), (x + width, y + height), (x, y + height))
    assert area_m2(rectangle) == pytest.approx(width * height, rel=1e-6)
    assert perimeter_m(rectangle) == pytest.approx(2 * (width + height))
    assert depth_m((x + width / 2, y + height / 2), rectangle) == pytest.approx(min(width, height) / 2)
