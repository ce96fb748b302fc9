"""Stamps of anchors, unwrapped: what becomes of forged ones and of counters that restart."""

from collections import Counter

import pytest

from skyless.core.air.anchor_stamps import MAX_TRACKS, RESTART_SILENCE_PERIODS, AnchorStamps
from skyless.core.air.beacon import Beacon
from skyless.core.ticks import from_seconds, wrap

HALF_S = from_seconds(0.5)


def beacon(anchor, tx_ticks, sequence=0):
    return Beacon(1, anchor, sequence & 0xFF, wrap(tx_ticks), 0, None, None, None, (), 0, None)


@pytest.mark.parametrize("superframe_ticks", [0, HALF_S])
def test_forged_stamps_do_not_replace_an_anchor_that_sends_twice_a_second(superframe_ticks):
    """Nine between any two of its own. Where the superframe is not known yet, they do."""
    counters = Counter()
    stamps = AnchorStamps(counters)
    for n in range(100):
        now = n * HALF_S // 10
        tx_ticks = now + 99 if n % 10 == 0 else 7 * now + n
        stamps.unwrap(beacon(1, tx_ticks, n), now, superframe_ticks)
    assert (counters["anchor-restart"] == 0) == (superframe_ticks > 0)


@pytest.mark.parametrize("first", [0, 1])
def test_a_false_stamp_that_came_first_does_not_keep_an_anchor_out(first):
    """Five frames a second of a counter that runs on, under the name of an anchor that sends 28."""
    stamps, counters = AnchorStamps(Counter()), Counter()
    forged = [(n * from_seconds(0.2), 10**9) for n in range(20)]
    own = [(from_seconds(0.01 + first * 0.3) + n * from_seconds(1 / 28), 0) for n in range(110)]
    for n, (now, start) in enumerate(sorted(forged + own)):
        counters[start, stamps.unwrap(beacon(1, now + start, n), now) is not None] += 1
    assert counters[0, True] > 100 if first == 0 else counters[10**9, True] > 18


def test_a_counter_that_restarts_counts_again_after_a_few_superframes():
    stamps = AnchorStamps(Counter())
    for n in range(4):
        assert stamps.unwrap(beacon(1, n * HALF_S, n), n * HALF_S, HALF_S) is not None
    again = [stamps.unwrap(beacon(1, n * HALF_S + 10**11, n), n * HALF_S, HALF_S) for n in range(4, 20)]
    accepted = next(n for n, ticks in enumerate(again) if ticks is not None)
    assert accepted <= RESTART_SILENCE_PERIODS + 1
    assert None not in again[accepted:]


def test_strangers_of_a_single_frame_do_not_displace_an_anchor():
    stamps = AnchorStamps(Counter())
    for n in range(2):
        stamps.unwrap(beacon(1, n * 1000, n), n * 1000)
    for n in range(2 * MAX_TRACKS):
        stamps.unwrap(beacon(1000 + n, 5 * n), 2000 + n)
    assert len(stamps.tracks.of_anchor) == MAX_TRACKS
    assert stamps.unwrap(beacon(1, 10**10, 3), 4000) is None
