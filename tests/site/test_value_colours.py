"""The colours of predicted values: one function of the value, whatever draws it."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from matplotlib import colormaps
from matplotlib.colors import LogNorm

from skyless.site.planning.colours import round_values, scale_of
from skyless.site.planning.picture import value_colours
from support.value_colours import colour_at, colour_of

pytestmark = pytest.mark.site

POSITIVE = st.floats(1e-4, 1e4)


@given(st.lists(POSITIVE, min_size=1, max_size=50))
def test_a_scale_covers_its_values(values):
    ordered = sorted(values)
    scale = scale_of(ordered)
    assert ordered[0] <= scale.low < scale.high
    assert scale.high >= 1.5 * scale.low
    assert all(scale.low <= tick <= scale.high for tick in scale.ticks)


@given(POSITIVE, st.floats(1.01, 1e6))
def test_ticks_are_few_and_in_order(low, ratio):
    ticks = round_values(low, ratio * low)
    assert list(ticks) == sorted(set(ticks))
    assert len(ticks) <= 8
    assert ticks or ratio < 2.1


def test_single_extreme_values_do_not_use_up_the_colours():
    scale = scale_of([1.0] + [2.0] * 90 + [4.0] * 8 + [1000.0])
    assert (scale.low, scale.high) == (2.0, 4.0)
    assert scale_of([]) is None


def test_pictures_have_the_colours_of_the_page():
    """The page gets the stops with each overlay; a browser test compares what it draws, too."""
    scale = scale_of(np.geomspace(0.02, 0.4, 50).tolist())
    norm, colours = LogNorm(scale.low, scale.high), value_colours()
    for value in np.geomspace(0.01, 0.6, 40):
        drawn = 255.0 * np.array(colours(norm(value, clip=True))[:3])
        assert drawn == pytest.approx(colour_of(value, scale.low, scale.high), abs=2.0)


def test_the_colours_are_viridis():
    for share in np.linspace(0.0, 1.0, 21):
        viridis = 255.0 * np.array(colormaps["viridis"](share)[:3])
        assert colour_at(share) == pytest.approx(viridis, abs=16.0)
