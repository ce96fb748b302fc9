"""The channel against closed forms and published figures."""

import math

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from skyless.core.site import WallSite
from skyless.site.channel import (
    ChannelModel,
    barriers_of,
    cross_walls,
    delivery_probability,
    power_bias_m,
    received_power_dbm,
)

APS011_CM = [-11.0, -10.5, -10.0, -9.3, -8.2, -6.9, -5.1, -2.7, 0, 2.1, 3.5, 4.2, 4.9, 6.2, 7.1, 7.6, 8.1, 8.6]


def test_range_bias_follows_the_application_note():
    for k, bias_cm in enumerate(APS011_CM):
        assert power_bias_m(-61.0 - 2.0 * k) == pytest.approx(bias_cm / 100.0)
    assert power_bias_m(-62.0) == pytest.approx((-11.0 - 10.5) / 200.0)
    assert power_bias_m(-40.0) == pytest.approx(-0.11)
    assert power_bias_m(-120.0) == pytest.approx(0.086)


def test_power_at_five_metres_is_where_the_bias_vanishes():
    """Friis at the regulation's limit gives -77 dBm at 5 m, the level of APS011's zero."""
    tx_dbm = -41.3 + 10.0 * math.log10(499.2)
    assert ChannelModel().tx_power_dbm == pytest.approx(tx_dbm, abs=0.05)
    power_dbm = received_power_dbm(ChannelModel().tx_power_dbm, 5.0, 0.0)
    assert power_dbm == pytest.approx(-77.0, abs=0.1)
    assert abs(power_bias_m(power_dbm)) < 0.002


def test_power_falls_by_twenty_db_a_decade_and_by_the_walls():
    assert received_power_dbm(-14.3, 2.0, 0.0) - received_power_dbm(-14.3, 20.0, 6.0) == pytest.approx(26.0)
    assert received_power_dbm(-14.3, 0.0, 0.0) == received_power_dbm(-14.3, 0.01, 0.0)


def test_delivery_is_even_at_the_sensitivity_and_certain_far_from_it():
    assert delivery_probability(-93.0, -93.0, 0.5) == 0.5
    assert delivery_probability(-83.0, -93.0, 0.5) > 1.0 - 1e-8
    assert delivery_probability(-103.0, -93.0, 0.5) < 1e-8
    assert delivery_probability(-1000.0, -93.0, 0.5) == pytest.approx(0.0)


place = st.tuples(st.floats(-20, 20), st.floats(-20, 20))


@given(a=place, b=place, c=place, d=place)
def test_walls_count_where_the_segments_cross(a, b, c, d):
    """Against the intersection's parameters along both segments."""
    matrix = np.column_stack([np.subtract(b, a), np.subtract(c, d)])
    with np.errstate(divide="ignore"):  # numbers below the smallest normal one, whose determinant is 0
        assume(abs(np.linalg.det(matrix)) > 1e-3)
    along = np.linalg.solve(matrix, np.subtract(c, a))
    assume(np.abs(along).min() > 1e-6)
    assume(np.abs(along - 1.0).min() > 1e-6)
    crosses = bool(((along > 0.0) & (along < 1.0)).all())
    walls = barriers_of((WallSite(*c, *d, loss_db=5.0, delay_m=0.2),))
    assert cross_walls(*walls, *a, 0.0, *b, 0.0) == ((5.0, 0.2) if crosses else (0.0, 0.0))


def test_walls_add_up_and_none_is_nothing():
    walls = barriers_of((WallSite(1, -1, 1, 1, 6.0, 0.1), WallSite(2, -1, 2, 1, 3.0, 0.2), WallSite(9, 9, 9, 8)))
    assert cross_walls(*walls, 0.0, 0.0, 0.0, 5.0, 0.0, 0.0) == pytest.approx((9.0, 0.3))
    assert cross_walls(*barriers_of(()), 0.0, 0.0, 0.0, 5.0, 0.0, 0.0) == (0.0, 0.0)
