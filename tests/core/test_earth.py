"""Points of a site on the Earth, against the textbook's conversion in the other direction, and ellipses of errors."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.optimize import brentq

from skyless.core.earth import east_north_up, east_north_up_of, geodetic, horizontal_ellipse, rotated
from skyless.core.site import GeoreferenceSite

A_M, F = 6_378_137.0, 1 / 298.257223563
"""WGS 84 (NIMA TR8350.2): semi-major axis and flattening."""


def earth_centred(latitude_deg, longitude_deg, height_m):
    """The closed form (any textbook of geodesy): X, Y, Z of a point."""
    latitude, longitude = np.radians([latitude_deg, longitude_deg])
    squared = F * (2 - F)
    normal_m = A_M / np.sqrt(1 - squared * np.sin(latitude) ** 2)
    flat_m = (normal_m + height_m) * np.cos(latitude)
    return np.array(
        [
            flat_m * np.cos(longitude),
            flat_m * np.sin(longitude),
            (normal_m * (1 - squared) + height_m) * np.sin(latitude),
        ]
    )


def axes(latitude_deg, longitude_deg):
    """East, north and up at a point, as rows."""
    p, q = np.radians([latitude_deg, longitude_deg])
    return np.array(
        [
            [-np.sin(q), np.cos(q), 0.0],
            [-np.sin(p) * np.cos(q), -np.sin(p) * np.sin(q), np.cos(p)],
            [np.cos(p) * np.cos(q), np.cos(p) * np.sin(q), np.sin(p)],
        ]
    )


ORIGINS = st.builds(
    GeoreferenceSite,
    latitude_deg=st.floats(-89.9, 89.9),
    longitude_deg=st.floats(-180, 180),
    height_m=st.floats(-400, 8000),
    heading_deg=st.floats(-360, 360),
)
POINTS = st.tuples(st.floats(-1000, 1000), st.floats(-1000, 1000), st.floats(-50, 200))


@given(ORIGINS, POINTS)
def test_a_point_is_found_again_within_a_hundredth_of_a_millimetre(origin, point_m):
    latitude_deg, longitude_deg, height_m = geodetic(point_m, origin)
    assert height_m == pytest.approx(origin.height_m + point_m[2], abs=1e-9)
    assert -180 <= longitude_deg < 180
    turn = axes(origin.latitude_deg, origin.longitude_deg)
    start = earth_centred(origin.latitude_deg, origin.longitude_deg, origin.height_m)

    def local(height_m):
        return turn @ (earth_centred(latitude_deg, longitude_deg, height_m) - start)

    # The vertical of the place meets the point's own height above the tangent plane somewhat higher.
    found = local(brentq(lambda height_m: local(height_m)[2] - point_m[2], height_m - 1, height_m + 1, xtol=1e-9))
    assert found == pytest.approx(east_north_up(point_m, origin.heading_deg), abs=1e-5)


@given(ORIGINS, POINTS)
def test_a_point_on_the_earth_is_where_it_was_in_the_site(origin, point_m):
    found = east_north_up_of(*geodetic(point_m, origin), origin)
    assert found == pytest.approx(east_north_up(point_m, origin.heading_deg), abs=5e-5)


def test_headings_are_azimuths_of_the_y_axis():
    assert east_north_up((0.0, 1.0, 2.0), 90.0) == pytest.approx((1.0, 0.0, 2.0))
    assert east_north_up((1.0, 0.0, 0.0), 90.0) == pytest.approx((0.0, -1.0, 0.0))


@given(st.lists(st.floats(-3, 3), min_size=9, max_size=9), st.floats(-360, 360))
def test_a_covariance_turns_as_the_vectors_do(values, heading_deg):
    root = np.array(values).reshape(3, 3)
    covariance = root @ root.T
    turn = np.array([east_north_up(tuple(axis), heading_deg) for axis in np.eye(3)]).T
    assert np.array(rotated(tuple(covariance.ravel()), heading_deg)).reshape(3, 3) == pytest.approx(
        turn @ covariance @ turn.T, abs=1e-9
    )


lengths_m = st.floats(0.001, 30.0)


@given(long_m=lengths_m, short_m=lengths_m, turned=st.floats(0.0, math.pi))
def test_the_longer_axis_points_where_the_variance_is_largest(long_m, short_m, turned):
    c, s = math.cos(turned), math.sin(turned)
    xx, yy = (c * long_m) ** 2 + (s * short_m) ** 2, (s * long_m) ** 2 + (c * short_m) ** 2
    xy = c * s * (long_m**2 - short_m**2)
    longer, shorter, direction = horizontal_ellipse((xx, xy, 0.0, xy, yy, 0.0, 0.0, 0.0, 1.0))
    assert longer == pytest.approx(max(long_m, short_m))
    assert shorter == pytest.approx(min(long_m, short_m), rel=1e-3)

    def std_m(angle):
        x, y = math.cos(angle), math.sin(angle)
        return math.sqrt(max(x * x * xx + 2.0 * x * y * xy + y * y * yy, 0.0))

    assert std_m(direction) == pytest.approx(longer)


def test_a_covariance_that_is_none_has_an_ellipse_all_the_same():
    assert horizontal_ellipse((0.0,) * 9) == (0.0, 0.0, 0.0)
    longer, shorter, _ = horizontal_ellipse((1.0, 5.0, 0.0, 5.0, 1.0, 0.0, 0.0, 0.0, 0.0))
    assert (longer, shorter) == (pytest.approx(math.sqrt(6.0)), 0.0)
