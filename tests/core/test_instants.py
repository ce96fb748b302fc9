"""When anchors of protocol 2 send: the published function, the same of integers and of arrays."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import kstest

from skyless.core.air import almanac
from skyless.core.ticks import DELAYED_TX_GRANULARITY_TICKS, WRAP_TICKS, from_seconds, to_seconds

ANCHORS = st.integers(0, 0xFFFF)
SEQUENCES = st.integers(0, 0xFF)
CODES = st.integers(0, almanac.LONGEST_PERIOD_CODE)


@given(ANCHORS, SEQUENCES, CODES)
def test_integers_and_arrays_agree(anchor_id, sequence, code):
    as_arrays = (np.array([number]) for number in (anchor_id, sequence, code))
    assert almanac.gap_ticks(*as_arrays)[0] == almanac.gap_ticks(anchor_id, sequence, code)


@given(ANCHORS, SEQUENCES, CODES)
def test_gaps_are_steps_of_the_radio_around_their_period(anchor_id, sequence, code):
    gap, period = almanac.gap_ticks(anchor_id, sequence, code), almanac.period_ticks(code)
    assert gap % DELAYED_TX_GRANULARITY_TICKS == 0
    assert period // 2 <= gap < period + period // 2 < WRAP_TICKS // 2
    assert gap >= from_seconds(1.3e-3), "the driver's lead time, and a frame after its RMARKER"


@given(st.floats(4e-3, 3.9))
def test_the_code_of_a_period_is_at_most_a_sixteenth_longer(period_s):
    stated_s = to_seconds(almanac.period_ticks(almanac.period_code(period_s)))
    assert period_s <= stated_s * (1 + 1e-12) <= period_s * (17 / 16 + 1e-9)


def test_codes_beyond_the_longest_period_are_never_chosen():
    assert almanac.period_code(1e9) == almanac.LONGEST_PERIOD_CODE
    assert almanac.period_code(0.0) == 0
    assert all(
        almanac.period_ticks(code) < almanac.period_ticks(code + 1) for code in range(almanac.LONGEST_PERIOD_CODE)
    )


def test_gaps_are_uniform_over_sequence_numbers_and_anchors_and_independent():
    period = almanac.period_ticks(0x30)
    of_one = np.array([almanac.gap_ticks(7, number, 0x30) for number in range(256)]) / period - 0.5
    of_all = np.array([almanac.gap_ticks(anchor, 7, 0x30) for anchor in range(20_000)]) / period - 0.5
    for drawn in (of_one, of_all):
        assert kstest(drawn, "uniform").pvalue > 1e-6
        assert abs(np.corrcoef(drawn[1:], drawn[:-1])[0, 1]) < 5.0 / np.sqrt(len(drawn))


@given(st.integers(1, 1000))
def test_anchors_in_reach_share_what_the_air_carries_best(anchors):
    period_s = almanac.suitable_period_s(anchors, None)
    assert period_s >= almanac.SHORTEST_PERIOD_S
    assert anchors / period_s <= almanac.OFFERED_HZ * (1 + 1e-12)
    assert almanac.suitable_period_s(anchors, 20.0) == 0.05
