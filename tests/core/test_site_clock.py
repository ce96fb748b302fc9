"""The site's time lies within the listener's bounds, whatever the host's clock does, and nothing wrong lasts."""

from collections import deque

from hypothesis import given
from hypothesis import strategies as st

from skyless.core.keys.chain import ChainTiming
from skyless.core.keys.verifier import DRIFT, SiteClock
from skyless.core.ticks import from_seconds

BOUND_S = 0.1
TIMING = ChainTiming()
START_S = 1.8e9
UNSEEN_S = TIMING.anchor_lead_s
TOLERANCE_S = 1e-5

steps = st.lists(
    st.tuples(
        st.floats(0.0, 5.0),  # time that passes
        st.floats(-BOUND_S, BOUND_S),  # error of the host's clock
        st.none() | st.floats(0.0, 20.0),  # how long after its disclosure a key is received
    ),
    min_size=1,
    max_size=60,
)
leads = st.floats(0.0, UNSEEN_S)
drifts = st.floats(-DRIFT, DRIFT)


class Listener:
    """A clock, the true time, and keys that an anchor discloses whose clock is ahead."""

    def __init__(self, lead_s=0.0, drift=0.0):
        self.clock = SiteClock(BOUND_S, offsets_s=deque())
        self.true_s, self._lead_s, self._rate, self._known = START_S, lead_s, 1.0 + drift, set()

    def after(self, elapsed_s, error_s=0.0, key_delay_s=None):
        self.true_s += elapsed_s
        self.clock.advance(from_seconds((self.true_s - START_S) * self._rate * 0.9999999), self.true_s + error_s)
        if key_delay_s is not None:
            interval = TIMING.interval_at(self.site_s - key_delay_s) - TIMING.lag
            if interval not in self._known:
                self._known.add(interval)
                self.clock.on_key(interval, TIMING)

    @property
    def site_s(self):
        return self.true_s + self._lead_s

    @property
    def spare_s(self):
        """How far the upper bound is above the site's time."""
        return self.clock.upper_s(TIMING) - self.site_s


def verified():
    tested = Listener()
    for _ in range(20):
        tested.after(0.05, 0.0, 0.0)
    assert tested.clock.is_verified
    return tested


@given(steps, leads, drifts)
def test_bounds_hold(steps, lead_s, drift):
    tested = Listener(lead_s, drift)
    for elapsed_s, error_s, delay_s in steps:
        tested.after(elapsed_s, error_s, delay_s)
        assert tested.clock.lower_s - TOLERANCE_S <= tested.site_s
        assert tested.spare_s >= -TOLERANCE_S
        assert not tested.clock.is_late


@given(steps, leads)
def test_every_genuine_frame_is_in_time_where_clocks_are_right(steps, lead_s):
    """The budget holds: a frame from the end of its interval, of an anchor that is behind, comes before its key."""
    tested = Listener(min(lead_s, 0.5 * TIMING.anchors_apart_s))
    for elapsed_s, error_s, delay_s in steps:
        tested.after(elapsed_s, error_s, delay_s)
        oldest_s = TIMING.interval_s + 0.5 * TIMING.anchors_apart_s
        assert tested.clock.upper_s(TIMING) - tested.true_s + oldest_s <= TIMING.lag * TIMING.interval_s + TOLERANCE_S


@given(st.floats(0.0, 1e6), st.floats(1e-3, 100.0), drifts)
def test_a_host_that_is_set_or_dragged_back_lets_no_old_key_in(back_s, rate, drift):
    """``rate``: seconds a second; a step where that is fast. Keys go on for a while, and then they are jammed."""
    tested = Listener(UNSEEN_S, drift)
    for number in range(400):
        tested.after(0.05, -min(back_s, rate * 0.05 * max(number - 20, 0)), 0.0 if number < 200 else None)
        assert tested.spare_s >= -TOLERANCE_S


@given(st.floats(0.0, 1e7), st.floats(0.05, 100.0), st.booleans())
def test_nothing_lasts_of_a_host_that_was_ahead(ahead_s, seconds, has_keys):
    tested = verified()
    for _ in range(10):
        tested.after(0.1 * seconds, ahead_s, 0.0 if has_keys else None)
    tested.after(0.05, 0.0)
    assert tested.spare_s <= BOUND_S + UNSEEN_S + TOLERANCE_S


@given(st.floats(0.0, 1e6))
def test_the_host_counts_after_a_standstill_of_the_counter(sleep_s):
    """The radio's counter, or the monotonic clock that unwraps it, stands still while a computer is suspended."""
    tested = verified()
    true_s = tested.true_s + sleep_s
    tested.clock.advance(from_seconds(tested.true_s - START_S), true_s)
    assert true_s + UNSEEN_S <= tested.clock.upper_s(TIMING)


def test_a_counter_that_restarts_begins_with_the_host_again():
    tested = verified()
    tested.clock.advance(from_seconds(-2.0), START_S + 1000.0)
    assert not tested.clock.is_verified
    assert tested.clock.upper_s(TIMING) == START_S + 1000.0 + BOUND_S + UNSEEN_S
