"""Forty-bit time: against exact fractions and against times that never wrapped."""

from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from skyless.core import ticks
from skyless.core.ticks import TICK_M

RATE_HZ = 128 * 499_200_000
WRAP_S = Fraction(2**40, RATE_HZ)
HALF = 2**39

anytime = st.integers(-(2**62), 2**62)
widths = st.sampled_from([32, 40])
steps = st.integers(-HALF, HALF - 1)


def test_published_figures():
    assert float(WRAP_S) == pytest.approx(17.2074, abs=5e-5)  # DW1000 User Manual 7.2.8
    assert ticks.to_seconds(1) == pytest.approx(15.650040064e-12, rel=1e-10)
    assert pytest.approx(4.6917639786e-3, rel=1e-9) == TICK_M
    assert ticks.from_seconds(2.1005128205128206e-3) == 2**27  # the slot of 2.1005 ms


@given(anytime, widths)
def test_wrap_is_the_remainder(time, bits):
    assert ticks.wrap(time, bits) == time % 2**bits


@given(anytime, st.data(), widths)
def test_difference_of_wrapped_times(earlier, data, bits):
    step = data.draw(st.integers(-(2 ** (bits - 1)), 2 ** (bits - 1) - 1))
    wrapped = ticks.wrap(earlier + step, bits), ticks.wrap(earlier, bits)
    assert ticks.difference(*wrapped, bits) == step


@given(anytime, steps, widths)
def test_nearest_finds_the_time_near_the_expected_one(time, error, bits):
    error >>= 40 - bits  # less than half a wrap
    assert ticks.nearest(ticks.wrap(time, bits), time - error, bits) == time


@given(st.integers(-(2**53), 2**53))
def test_seconds_against_fractions(count):
    assert ticks.to_seconds(count) == pytest.approx(float(Fraction(count, RATE_HZ)), rel=4e-16, abs=0)


@given(st.integers(-(2**50), 2**50))
def test_seconds_and_back(count):
    assert ticks.from_seconds(ticks.to_seconds(count)) == count


@given(st.floats(-15_000, 15_000))
def test_from_seconds_rounds_to_the_nearest(seconds):
    exact = Fraction(seconds) * RATE_HZ
    assert abs(ticks.from_seconds(seconds) - exact) <= Fraction(1, 2) + abs(exact) / 2**52


@given(st.integers(0, 2**40 - 1), st.lists(steps, max_size=30))
def test_unwrapping_gives_back_a_time_that_never_wrapped(start, gaps):
    """Also for stamps out of order: each within half a wrap (8.6 s) of the one before."""
    times = start + np.cumsum([0, *gaps], dtype=np.int64)
    unwrapper = ticks.Unwrapper()
    assert [unwrapper.unwrap(ticks.wrap(int(time))) for time in times] == times.tolist()


@given(
    st.integers(0, 2**40 - 1),
    st.lists(
        st.tuples(st.integers(0, 12 * 3600 * 10**6), st.floats(-8.5, 8.5)),  # gap in µs, the host's error in s
        max_size=20,
    ),
)
def test_host_time_bridges_gaps_of_hours(start, gaps):
    unwrapper = ticks.Unwrapper()
    time, host_s = start, 1_000.0
    assert unwrapper.unwrap(start, host_s) == start
    for gap_us, error_s in gaps:
        gap = gap_us * RATE_HZ // 10**6
        time += gap
        host_s += float(Fraction(gap, RATE_HZ)) + error_s
        assert unwrapper.unwrap(ticks.wrap(time), host_s) == time


def test_a_gap_without_host_time_loses_whole_wraps_only():
    unwrapper = ticks.Unwrapper()
    unwrapper.unwrap(5)
    assert unwrapper.unwrap(ticks.wrap(5 + 3 * 2**40 + 7)) == 12


def test_host_time_that_comes_and_goes():
    """Stamps without a host time in between do not keep the others from bridging a gap."""
    unwrapper = ticks.Unwrapper()
    assert unwrapper.unwrap(1) == 1
    assert unwrapper.unwrap(2, host_s=100.0) == 2
    assert unwrapper.unwrap(3, host_s=100.0 + float(10 * WRAP_S)) == 3 + 10 * 2**40
    assert unwrapper.unwrap(4) == 4 + 10 * 2**40
    assert unwrapper.unwrap(5, host_s=100.0 + float(15 * WRAP_S)) == 5 + 15 * 2**40
