"""The horizontal ellipse of a covariance."""

from math import cos, pi, sin, sqrt

import pytest
from hypothesis import given
from hypothesis import strategies as st

from skyless.core.earth import horizontal_ellipse

lengths_m = st.floats(0.001, 30.0)


@given(long_m=lengths_m, short_m=lengths_m, turned=st.floats(0.0, pi))
def test_the_longer_axis_points_where_the_variance_is_largest(long_m, short_m, turned):
    c, s = cos(turned), sin(turned)
    xx, yy = (c * long_m) ** 2 + (s * short_m) ** 2, (s * long_m) ** 2 + (c * short_m) ** 2
    xy = c * s * (long_m**2 - short_m**2)
    longer, shorter, direction = horizontal_ellipse((xx, xy, 0.0, xy, yy, 0.0, 0.0, 0.0, 1.0))
    assert longer == pytest.approx(max(long_m, short_m))
    assert shorter == pytest.approx(min(long_m, short_m), rel=1e-3)

    def std_m(angle):
        x, y = cos(angle), sin(angle)
        return sqrt(max(x * x * xx + 2.0 * x * y * xy + y * y * yy, 0.0))

    assert std_m(direction) == pytest.approx(longer)


def test_a_covariance_that_is_none_has_an_ellipse_all_the_same():
    assert horizontal_ellipse((0.0,) * 9) == (0.0, 0.0, 0.0)
    longer, shorter, _ = horizontal_ellipse((1.0, 5.0, 0.0, 5.0, 1.0, 0.0, 0.0, 0.0, 0.0))
    assert (longer, shorter) == (pytest.approx(sqrt(6.0)), 0.0)
