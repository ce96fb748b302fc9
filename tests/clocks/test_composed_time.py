"""One timeline over hops: closed forms of exact clocks, wraps, take-over, and what is rejected."""

import math
from collections import Counter

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from skyless.air.beacon2 import SlotTime, StatedSiteTime
from skyless.clocks.composed_time import ComposedTime
from skyless.clocks.composition import MEAN_LATE_TICKS, by_parent
from skyless.clocks.filter import clock_noise, stamp_variance_m2
from skyless.constants import SUBTICKS, TICK_M, TICK_S
from skyless.site.slots import Schedule
from skyless.ticks import WRAP_TICKS, wrap

SCHEDULE = Schedule(124_800 * 512, 17)
NOISE = clock_noise(2e-11, 1e-9)
VARIANCE_M2 = 2.0 * stamp_variance_m2(100e-12, rounded=True)
RANGE_M = 1000 * TICK_M


def composed(counters=None):
    return ComposedTime(NOISE, VARIANCE_M2, SCHEDULE, Counter() if counters is None else counters)


class Link:
    """A sender with a constant rate and a receiver with another, without noise; true time is the timeline."""

    def __init__(self, sender_ppm=5, receiver_ppm=-7, sender_start=0, receiver_start=1 << 45):
        self.sender = lambda ticks: sender_start + ticks + ticks * sender_ppm // 10**6
        self.receiver = lambda ticks: receiver_start + ticks + ticks * receiver_ppm // 10**6
        self.sender_rate = sender_ppm * 1e-6
        self.receiver_rate = receiver_ppm * 1e-6

    def beacon(self, time, superframe, *, site_time=True, parent=1, slot=3, hop=1, offset=0, std_ticks=2.0):
        """Let one beacon arrive; the sender's stamp lies ``offset`` ticks before its slot."""
        start = SCHEDULE.slot_start_ticks(superframe, slot)
        at = start - offset
        stated = StatedSiteTime(-float(offset), std_ticks) if site_time else None
        claim = SlotTime(wrap(superframe, 32), slot, 9, 0, hop, 0, self.sender_rate)
        return time.on_beacon(parent, wrap(self.sender(at)), self.receiver(at) + 1000, RANGE_M, claim, stated)


def test_two_clocks_of_constant_rates_agree_to_a_tick():
    time, link = composed(), Link()
    time.set_parents([1])
    for superframe in range(1000, 1100):
        assert link.beacon(time, superframe)
    later = SCHEDULE.slot_start_ticks(1100, 0)
    assert time.subticks(link.receiver(later)) / SUBTICKS == pytest.approx(later, abs=1.5)
    assert time.ticks_own(later) == pytest.approx(link.receiver(later), abs=1.5)
    assert time.rate == pytest.approx(link.receiver_rate, abs=1e-10)


def test_the_stated_residual_is_that_of_the_map():
    time, link = composed(), Link()
    time.set_parents([1])
    for superframe in range(50):
        link.beacon(time, superframe)
    own = time.ticks_own(SCHEDULE.slot_start_ticks(50, 7)) - 300
    stated = time.stated(own, 50, 7)
    assert stated.residual_ticks == pytest.approx(-300, abs=1.0)
    assert stated.std_ticks == pytest.approx(math.sqrt(time.variance_m2(own)) / TICK_M)


def test_raw_counters_of_40_bits_and_superframes_of_32_bits_wrap():
    time, link = composed(), Link(sender_start=WRAP_TICKS - 40 * SCHEDULE.superframe_ticks)
    time.set_parents([1])
    first = (1 << 32) - 50
    for superframe in range(first, first + 100):  # both wrap on the way, in the middle of the runs
        link.beacon(time, superframe)
    later = SCHEDULE.slot_start_ticks(first + 100, 0)
    assert time.superframe(link.receiver(later) + 1000) == first + 100
    assert time.subticks(link.receiver(later)) / SUBTICKS == pytest.approx(later, abs=1.5)


def test_a_root_goes_on_without_a_step_and_exactly():
    time, link = composed(), Link()
    time.set_parents([1])
    for superframe in range(60):
        link.beacon(time, superframe)
    own = link.receiver(SCHEDULE.slot_start_ticks(60, 0))
    before, rate = time.subticks(own), time.rate
    time.lead(own)
    assert time.subticks(own) == before
    assert time.rate == rate
    assert time.variance_m2(own) == 0.0
    hour = round(3600.0 / TICK_S)
    assert time.subticks(own + hour) - before == pytest.approx(hour * SUBTICKS / (1.0 + rate), rel=1e-15)
    assert not link.beacon(time, 61)


def test_the_first_root_leads_by_its_own_counter():
    time = composed()
    time.lead(12345)
    assert time.subticks(10**15) == 10**15 * SUBTICKS
    assert time.ticks_own(10**15) == 10**15


@given(st.integers(0, 1 << 55), st.integers(-(10**9), 10**12))
def test_conversion_there_and_back(start, ahead):
    time, link = composed(), Link(receiver_start=start)
    time.set_parents([1])
    for superframe in range(3):
        link.beacon(time, superframe)
    ticks = SCHEDULE.slot_start_ticks(3, 0) + ahead
    own = time.ticks_own(ticks)
    assert abs(time.subticks(own) - ticks * SUBTICKS) <= SUBTICKS // 2 + 2


def test_slots_alone_are_known_to_half_the_radios_grid():
    time, link = composed(), Link()
    time.set_parents([1])
    generator = np.random.default_rng(3)
    offsets = generator.integers(0, 512, 400)
    for superframe, offset in enumerate(offsets):
        link.beacon(time, superframe, site_time=False, offset=int(offset))
    later = SCHEDULE.slot_start_ticks(400, 0)
    gain = 1.0 / 16.0
    std = 512 / math.sqrt(12.0) * math.sqrt(gain / (2.0 - gain))
    assert abs(time.subticks(link.receiver(later)) / SUBTICKS - later) < 4.0 * std
    assert MEAN_LATE_TICKS == 256


def test_another_parent_makes_no_step_beyond_the_difference():
    time = composed()
    first, second = Link(), Link(sender_ppm=11, sender_start=777)
    time.set_parents([1])
    for superframe in range(60):
        first.beacon(time, superframe)
    time.set_parents([2])
    own = first.receiver(SCHEDULE.slot_start_ticks(60, 9))
    before = time.subticks(own)
    assert second.beacon(time, 60, parent=2, slot=5)
    assert abs(time.subticks(own) - before) <= 3 * SUBTICKS
    assert abs(time.rate - first.receiver_rate) < 1e-9


def test_a_parents_counter_may_restart():
    counters = Counter()
    time, link = composed(counters), Link()
    time.set_parents([1])
    for superframe in range(60):
        link.beacon(time, superframe)
    restarted = Link(sender_start=987654321987)
    results = [restarted.beacon(time, superframe) for superframe in range(60, 90)]
    assert results[:2] == [False, False]
    assert all(results[2:])
    assert counters["clock-restart"] == 1
    later = SCHEDULE.slot_start_ticks(90, 0)
    assert time.subticks(link.receiver(later)) / SUBTICKS == pytest.approx(later, abs=3.0)


def test_what_cannot_be_is_counted_and_changes_nothing():
    counters = Counter()
    time, link = composed(counters), Link()
    time.set_parents([1])
    for superframe in range(60):
        link.beacon(time, superframe)
    own = link.receiver(SCHEDULE.slot_start_ticks(60, 0))
    before = time.subticks(own)
    assert not time.on_beacon(2, 5, own, RANGE_M, SlotTime(60, 3, 9, 0, 1, 0, 0.0))
    assert not time.on_beacon(1, 5, own, RANGE_M, SlotTime(60, 17, 9, 0, 1, 0, 0.0))
    assert not time.on_beacon(1, 5, own, RANGE_M, SlotTime(60, 3, 9, 0, 1, 0, 1e-4))
    assert not time.on_beacon(1, 5, own, RANGE_M, SlotTime(60, 3, 9, 0, 1, 0, link.sender_rate))
    link.beacon(time, 61)
    assert not link.beacon(time, 61)
    assert counters == {"impossible-slot-time": 2, "impossible-stamp": 1, "duplicate": 1}
    assert abs(time.subticks(own) - before) <= SUBTICKS


def test_one_step_of_the_stated_time_is_left_out_and_a_lasting_one_accepted():
    counters = Counter()
    time, link = composed(counters), Link()
    time.set_parents([1])
    for superframe in range(60):
        link.beacon(time, superframe)
    own = link.receiver(SCHEDULE.slot_start_ticks(60, 0))
    before = time.subticks(own)

    def later_by(superframe, ticks):
        start = SCHEDULE.slot_start_ticks(superframe, 3)
        claim = SlotTime(superframe, 3, 9, 0, 1, 0, link.sender_rate)
        stamps = wrap(link.sender(start)), link.receiver(start) + 1000
        return time.on_beacon(1, *stamps, RANGE_M, claim, StatedSiteTime(float(ticks), 2.0))

    assert not later_by(60, 5000)
    assert abs(time.subticks(own) - before) <= SUBTICKS
    assert later_by(61, 0)
    assert [later_by(superframe, 5000) for superframe in (62, 63, 64)] == [False, False, True]
    assert counters == {"timeline-step": 4}
    own = link.receiver(SCHEDULE.slot_start_ticks(65, 0))
    assert time.subticks(own) / SUBTICKS == pytest.approx(SCHEDULE.slot_start_ticks(65, 0) + 5000, abs=1.5)


def test_nothing_is_known_before_a_beacon():
    time = composed()
    assert not time.is_known
    with pytest.raises(ValueError, match="not known yet"):
        time.subticks(0)


def test_restart_forgets_the_timeline_and_keeps_the_pairs():
    time, link = composed(), Link()
    time.set_parents([1])
    for superframe in range(60):
        link.beacon(time, superframe)
    updates = time.updates(1)
    time.restart()
    assert not time.is_known
    assert link.beacon(time, 60)
    assert time.updates(1) == updates + 1


@settings(max_examples=50)
@given(st.floats(0.0, 1.0), st.integers(0, 66), st.floats(0.0, 0.3), st.floats(0.0, 0.2))
def test_variance_grows_with_age_delay_and_the_parents(stated, hop, age_s, delay_s):
    pair = (4e-4, 1e-3, 3e-2)
    here = sum(by_parent(stated, hop, age_s, delay_s, pair, NOISE.white, NOISE.walk))
    assert here <= sum(by_parent(stated, hop, age_s + 0.01, delay_s, pair, NOISE.white, NOISE.walk))
    assert here <= sum(by_parent(stated, hop, age_s, delay_s + 0.01, pair, NOISE.white, NOISE.walk))
    assert here <= sum(by_parent(stated + 0.1, hop, age_s, delay_s, pair, NOISE.white, NOISE.walk))


def test_a_child_of_the_root_has_its_filters_variance():
    pair = (4e-4, 1e-3, 3e-2)
    assert sum(by_parent(0.0, 0, 0.0, 0.0, pair, NOISE.white, NOISE.walk)) == pytest.approx(pair[0])
