"""The site's time lies within the listener's bounds, whatever the host's clock does within its own."""

from collections import deque

import pytest
from hypothesis import given
from hypothesis import strategies as st

from skyless.authentication.certificate import ChainTiming
from skyless.authentication.site_clock import DRIFT, RECENT_KEYS, SiteClock
from skyless.ticks import from_seconds

BOUND_S = 0.1
TIMING = ChainTiming()
START_S = 1.8e9

steps = st.lists(
    st.tuples(
        st.floats(0.0, 5.0),  # time that passes
        st.floats(-BOUND_S, BOUND_S),  # error of the host's clock
        st.none() | st.floats(0.0, 20.0),  # how long after its disclosure a key is received
    ),
    min_size=1,
    max_size=60,
)


def clock(**fields):
    return SiteClock(BOUND_S, offsets_s=deque(), **fields)


def verified():
    tested = clock()
    tested.advance(0, START_S)
    tested.on_key(TIMING.interval_at(START_S) - TIMING.lag, TIMING)
    assert tested.is_verified
    return tested


@given(steps, st.floats(-DRIFT, DRIFT))
def test_bounds_hold(steps, drift):
    tested, true_s, known = clock(), START_S, set()
    for elapsed_s, error_s, delay_s in steps:
        true_s += elapsed_s
        tested.advance(from_seconds((true_s - START_S) * (1.0 + drift) * 0.9999999), true_s + error_s)
        assert tested.lower_s - 1e-5 <= true_s <= tested.upper_s + 1e-5
        if delay_s is not None:
            interval = TIMING.interval_at(true_s - delay_s) - TIMING.lag
            if interval not in known:
                known.add(interval)
                tested.on_key(interval, TIMING)
        assert not tested.is_late
        assert tested.lower_s - 1e-5 <= true_s <= tested.upper_s + 1e-5


@given(st.floats(2.5 * BOUND_S, 1e6))
def test_a_verified_clock_is_carried_when_the_host_goes_back(jump_s):
    tested = verified()
    for step in range(1, 11):
        true_s = START_S + step
        tested.advance(from_seconds(step), true_s - jump_s)
        assert tested.lower_s <= true_s <= tested.upper_s
    assert tested.upper_s - tested.lower_s < 2.0 * BOUND_S + 2.0 * 10.0 * DRIFT + 1e-6


@given(st.floats(2.5 * BOUND_S, 1e6), st.integers(1, 10))
def test_a_host_that_is_ahead_of_the_bounds_counts(sleep_s, step):
    """The radio's counter, or the monotonic clock that unwraps it, stands still while a computer is suspended."""
    tested = verified()
    true_s = START_S + step + sleep_s
    tested.advance(from_seconds(step), true_s)
    assert not tested.is_verified
    assert tested.lower_s <= true_s <= tested.upper_s


@given(st.floats(BOUND_S + 1e-3, 100.0))
def test_a_clock_that_is_behind_is_noticed_with_the_first_key(behind_s):
    tested = clock()
    disclosed_s = TIMING.start_s(TIMING.interval_at(START_S))
    tested.advance(0, disclosed_s - behind_s)
    tested.on_key(TIMING.interval_at(START_S) - TIMING.lag, TIMING)
    assert tested.is_late
    assert not tested.is_verified
    assert tested.error_s == pytest.approx(-behind_s, abs=1e-6)


def test_single_late_keys_are_no_error_of_the_clock():
    tested = clock()
    for number in range(3 * RECENT_KEYS):
        true_s = START_S + 0.1 * number
        late_s = 0.5 if number % RECENT_KEYS else 0.0
        tested.advance(from_seconds(0.1 * number), true_s)
        tested.on_key(TIMING.interval_at(true_s - late_s) - TIMING.lag, TIMING)
        assert tested.error_s is None or number < RECENT_KEYS


def test_a_counter_that_restarts_begins_with_the_host_again():
    tested = clock()
    tested.advance(from_seconds(100.0), START_S)
    tested.on_key(TIMING.interval_at(START_S) - TIMING.lag, TIMING)
    tested.advance(from_seconds(2.0), START_S + 1000.0)
    assert not tested.is_verified
    assert (tested.lower_s, tested.upper_s) == (START_S + 1000.0 - BOUND_S, START_S + 1000.0 + BOUND_S)
