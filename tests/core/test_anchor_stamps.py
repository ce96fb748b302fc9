"""Stamps of anchors, unwrapped: what becomes of forged ones and of counters that restart."""

from collections import Counter

import pytest

from skyless.core.air.neighbours import ANCHOR_RESTART, RESTART_SILENCE_PERIODS, STAMP_FITS, Neighbours, unwrap_stamp
from skyless.core.native.records import MAX_NEIGHBOURS
from skyless.core.ticks import from_seconds, wrap

HALF_S = from_seconds(0.5)


def stamp_of(neighbours, anchor, tx_ticks, rx_ticks, sequence=0, period_ticks=0):
    return unwrap_stamp(neighbours, anchor, sequence & 0xFF, wrap(tx_ticks), rx_ticks, period_ticks)


@pytest.mark.parametrize("superframe_ticks", [0, HALF_S])
def test_forged_stamps_do_not_replace_an_anchor_that_sends_twice_a_second(superframe_ticks):
    """Nine between any two of its own. Where the superframe is not known yet, they do."""
    neighbours, found = Neighbours(), Counter()
    for n in range(100):
        now = n * HALF_S // 10
        tx_ticks = now + 99 if n % 10 == 0 else 7 * now + n
        found[stamp_of(neighbours, 1, tx_ticks, now, n, superframe_ticks)] += 1
    assert (found[ANCHOR_RESTART] == 0) == (superframe_ticks > 0)


@pytest.mark.parametrize("first", [0, 1])
def test_a_false_stamp_that_came_first_does_not_keep_an_anchor_out(first):
    """Five frames a second of a counter that runs on, under the name of an anchor that sends 28."""
    neighbours, counters = Neighbours(), Counter()
    forged = [(n * from_seconds(0.2), 10**9) for n in range(20)]
    own = [(from_seconds(0.01 + first * 0.3) + n * from_seconds(1 / 28), 0) for n in range(110)]
    for n, (now, start) in enumerate(sorted(forged + own)):
        counters[start, stamp_of(neighbours, 1, now + start, now, n) == STAMP_FITS] += 1
    assert counters[0, True] > 100 if first == 0 else counters[10**9, True] > 18


def test_a_counter_that_restarts_counts_again_after_a_few_superframes():
    neighbours = Neighbours()
    for n in range(4):
        assert stamp_of(neighbours, 1, n * HALF_S, n * HALF_S, n, HALF_S) == STAMP_FITS
    again = [stamp_of(neighbours, 1, n * HALF_S + 10**11, n * HALF_S, n, HALF_S) for n in range(4, 20)]
    assert again.index(STAMP_FITS) <= RESTART_SILENCE_PERIODS + 1
    assert set(again[again.index(STAMP_FITS) :]) == {STAMP_FITS}


def test_strangers_of_a_single_frame_do_not_displace_an_anchor():
    neighbours = Neighbours()
    for n in range(2):
        stamp_of(neighbours, 1, n * 1000, n * 1000, n)
    for n in range(2 * MAX_NEIGHBOURS):
        stamp_of(neighbours, 1000 + n, 5 * n, 2000 + n)
    assert neighbours.count == MAX_NEIGHBOURS
    assert stamp_of(neighbours, 1, 10**10, 4000, 3) != STAMP_FITS
