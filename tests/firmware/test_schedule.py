"""When a board expects beacons: against anchors whose clocks run at other rates, over losses and over sleeps."""

import ctypes

import pytest
from emulator.board_library import library
from firmware_stage import needs_compiler
from hypothesis import given, settings
from hypothesis import strategies as st

from skyless.core.air.almanac import LONGEST_PERIOD_CODE, gap_ticks
from skyless.core.air.frame import after_rmarker_s, preamble_s
from skyless.core.ticks import TICK_RATE_HZ

pytestmark = [pytest.mark.site, needs_compiler]

COUNTER = 1 << 40
US = TICK_RATE_HZ * 1e-6
SPARE_US = 60.0
"""Of the preamble, that the receiver may miss."""
IDS, SEQUENCES = st.integers(0, 0xFFFF), st.integers(0, 255)


class Expected(ctypes.Structure):
    _fields_ = (
        ("anchor", ctypes.c_uint16),
        *((name, ctypes.c_uint8) for name in ("sequence", "period_code", "missed")),
        *((name, ctypes.c_bool) for name in ("has_rate", "has_slept")),
        *((name, ctypes.c_uint32) for name in ("turns", "received")),
        *((name, ctypes.c_uint64) for name in ("due_ticks", "age_us")),
        ("rate_ppb", ctypes.c_int32),
    )


class Schedule(ctypes.Structure):
    _fields_ = (("count", ctypes.c_uint32), ("anchors", Expected * 12))


class Window(ctypes.Structure):
    _fields_ = (("row", ctypes.c_uint32), ("begin_ticks", ctypes.c_uint64), ("length_us", ctypes.c_uint32))


@pytest.fixture(scope="module")
def schedule_c():
    loaded = library()
    loaded.schedule_gap_ticks.restype = ctypes.c_uint64
    loaded.schedule_next.restype = loaded.schedule_is_done.restype = ctypes.c_bool
    return loaded


class Anchors:
    """Anchors that send at their instants, by the tag's time in ticks since a beginning that does not wrap."""

    def __init__(self, codes, ppm, begin=3):
        self.codes = codes
        self.rates = [1.0 - 1e-6 * one for one in ppm]
        self.sequences = [(7 * number + begin) % 256 for number in range(len(codes))]
        self.due = [US * (2000.0 + 900.0 * number) for number in range(len(codes))]

    def pop(self, until):
        """The next beacon before a time: anchor, sequence number, period, time."""
        number = min(range(len(self.due)), key=self.due.__getitem__)
        if self.due[number] >= until:
            return None
        sent = number + 1, self.sequences[number], self.codes[number], self.due[number]
        self.due[number] += gap_ticks(number + 1, self.sequences[number], self.codes[number]) * self.rates[number]
        self.sequences[number] = (self.sequences[number] + 1) % 256
        return sent


def note(c, schedule, sent, offset=0.0):
    anchor, sequence, code, at = sent
    c.schedule_note(ctypes.byref(schedule), anchor, sequence, code, ctypes.c_uint64(round(at - offset) % COUNTER))


def learnt(c, anchors, until):
    """A schedule of a receiver that was on up to a time."""
    schedule = Schedule()
    while sent := anchors.pop(until):
        note(c, schedule, sent)
    return schedule


def walk(c, schedule, anchors, now, until, offset=0.0, lost=lambda _: False):
    """Receive in windows only; beacons that were in one, out of all, and the windows' lengths."""
    received, all_sent, lengths_us, free = [], [], [], now
    while now < until:
        window = Window()
        counter = round(now - offset)
        assert c.schedule_next(ctypes.byref(schedule), ctypes.c_uint64(counter % COUNTER), ctypes.byref(window))
        wait = (window.begin_ticks - counter) % COUNTER
        assert 0 < wait < COUNTER // 2
        begin, end = now + wait, now + wait + US * window.length_us
        lengths_us.append(window.length_us)
        row, now = window.row, end
        while sent := anchors.pop(end):
            all_sent.append(sent)
            first = sent[3] - US * (1e6 * preamble_s() - SPARE_US)
            is_within = first >= begin and sent[3] + US * 1e6 * after_rmarker_s(100) <= end
            if sent[3] >= free and is_within and not lost(sent):
                received.append(sent)
                note(c, schedule, sent, offset)
                free = now = sent[3] + US * 1e6 * (after_rmarker_s(100) + 300e-6)
                break
        else:
            c.schedule_miss(ctypes.byref(schedule), row)
    return received, all_sent, lengths_us


def alone(sent):
    """Beacons with no other one so near that its window or the reading of it is in the way."""
    return [
        one
        for before, one, after in zip(sent, sent[1:], sent[2:], strict=False)
        if one[3] - before[3] > US * 1300.0 and after[3] - one[3] > US * 1300.0
    ]


@given(IDS, SEQUENCES, st.integers(0, LONGEST_PERIOD_CODE))
def test_gaps_are_those_of_anchors(schedule_c, anchor, sequence, code):
    assert schedule_c.schedule_gap_ticks(anchor, sequence, code) == gap_ticks(anchor, sequence, code)


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 255), st.lists(st.floats(-38.0, 38.0), min_size=4, max_size=6), st.integers(0, 2**40))
def test_beacons_that_do_not_overlap_are_in_their_windows(schedule_c, begin, ppm, start):
    anchors = Anchors([0x1C] * len(ppm), ppm, begin)  # 14 ms
    anchors.due = [one + start for one in anchors.due]
    schedule = learnt(schedule_c, anchors, start + US * 40e3)
    received, sent, _ = walk(schedule_c, schedule, anchors, start + US * 40e3, start + US * 400e3)
    assert len(alone(sent)) > 20
    assert set(alone(sent)) <= set(received)
    assert len(received) > 0.7 * len(sent)


def test_after_losses_the_next_beacon_is_in_its_window(schedule_c):
    anchors = Anchors([0x2C, 0x2C, 0x2C], [15.0, -15.0, 0.0])
    schedule = learnt(schedule_c, anchors, US * 80e3)
    lost = {"count": 0}

    def loses(sent):
        lost["count"] += sent[0] == 2
        return sent[0] == 2 and lost["count"] % 6 != 0

    received, sent, _ = walk(schedule_c, schedule, anchors, US * 80e3, US * 2000e3, lost=loses)
    by_second = [one for one in sent if one[0] == 2]
    assert sum(one[0] == 2 for one in received) >= len(by_second) // 6 - 2


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 10_000), st.floats(-120.0, 120.0), st.sampled_from([1.0, 3.0, 10.0]))
def test_over_sleeps_windows_hold_the_beacons_and_become_short(schedule_c, seed, clock_ppm, sleep_s):
    """The counter begins again, the time asleep is counted in steps of 31 µs by a crystal that is wrong itself."""
    anchors = Anchors([0x1C] * 5, [8.0, -6.0, 3.0, 0.0, -2.0], seed % 256)
    schedule, now, offset = learnt(schedule_c, anchors, US * 40e3), US * 40e3, 0.0
    longest_us = []
    for turn in range(4):
        before = round(now - offset) % COUNTER
        slept = US * 1e6 * sleep_s
        while anchors.pop(now + slept):
            pass
        counted_us = int(sleep_s * 1e6 * (1.0 + 1e-6 * (clock_ppm + turn % 2)) / 30.5) * 30.5
        now, offset = now + slept, now + slept - 12_345.0
        schedule_c.schedule_wake(
            ctypes.byref(schedule), ctypes.c_uint64(before), ctypes.c_uint64(12_345), ctypes.c_uint64(int(counted_us))
        )
        assert schedule.count == 5
        received, sent, lengths_us = walk(schedule_c, schedule, anchors, now, now + US * 120e3, offset)
        if max(lengths_us) < 1000:  # longer windows cover others' beacons
            assert set(alone(sent)) <= set(received)
            assert schedule_c.schedule_is_done(ctypes.byref(schedule), 2)
        longest_us.append(lengths_us[0])
        now = now + US * 120e3
    if sleep_s >= 3.0:
        assert longest_us[-1] < min(longest_us[0], 600)
