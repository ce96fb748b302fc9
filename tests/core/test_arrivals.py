"""Which of an anchor's genuine frames came late, by the counters of both ends."""

from hypothesis import given
from hypothesis import strategies as st

from skyless.core.keys.fault import Fault
from skyless.core.keys.known_keys import SILENCE_TICKS, Arrivals, Stamps
from skyless.core.ticks import MAX_DRIFT, from_seconds, wrap

MS = from_seconds(1e-3)

drifts = st.floats(-0.9 * MAX_DRIFT, 0.9 * MAX_DRIFT)
starts = st.integers(0, (1 << 40) - 1)
gaps = st.lists(st.integers(MS, 400 * MS), min_size=1, max_size=40)


def frames_of(start, drift, gaps, anchor=1):
    rx_ticks, frames = 0, []
    for gap in gaps:
        rx_ticks += gap
        frames.append(Stamps(anchor, rx_ticks, wrap(start + round(rx_ticks * (1.0 + drift)))))
    return frames


def alone(arrivals, frames):
    """Frames that are known one after the other."""
    return [arrivals.faults([one])[0] for one in frames]


@given(starts, drifts, gaps)
def test_frames_without_delay_are_in_time(start, drift, gaps):
    frames = frames_of(start, drift, gaps)
    assert alone(Arrivals(), frames) == [Fault.FIRST, *[None] * (len(gaps) - 1)]
    assert Arrivals().faults(frames) == ([Fault.FIRST] if len(frames) == 1 else [None] * len(gaps))


@given(starts, drifts, gaps, st.data())
def test_repetitions_are_late_wherever_they_stand(start, drift, gaps, data):
    genuine = frames_of(start, drift, gaps)
    lost = data.draw(st.sets(st.integers(0, len(genuine) - 1), max_size=len(genuine) - 1))
    copies = [
        (Stamps(1, one.rx_ticks + data.draw(st.integers(MS // 5, 200 * MS)), one.tx_ticks), False) for one in genuine
    ]
    kept = [(one, True) for number, one in enumerate(genuine) if number not in lost]
    mixed = sorted([*kept, *copies], key=lambda pair: pair[0].rx_ticks)
    first = min(one.rx_ticks for one, _ in kept)
    within = [pair for pair in mixed if abs(pair[0].rx_ticks - first) < from_seconds(0.8)]
    found = Arrivals().faults([one for one, _ in within])
    assert [one is not Fault.LATE for one in found] == [is_genuine for _, is_genuine in within]


@given(starts, drifts, gaps)
def test_a_repetition_that_comes_first_is_not_accepted_alone(start, drift, gaps):
    genuine = frames_of(start, drift, [*gaps, MS, MS])
    copy = Stamps(1, genuine[0].rx_ticks + MS // 4, genuine[0].tx_ticks)
    assert alone(Arrivals(), [copy, *genuine[1:3]]) == [Fault.FIRST, Fault.FIRST, None]


@given(starts, starts, drifts)
def test_an_anchor_that_restarts_is_late_for_a_second_at_most(start, other, drift):
    arrivals = Arrivals()
    alone(arrivals, frames_of(start, drift, [20 * MS] * 20))
    again = [Stamps(1, one.rx_ticks + 400 * MS, one.tx_ticks) for one in frames_of(other, drift, [20 * MS] * 120)]
    later = [
        found
        for one, found in zip(again, alone(arrivals, again), strict=True)
        if one.rx_ticks > 400 * MS + SILENCE_TICKS + 40 * MS
    ]
    assert set(later) == {None}


@given(starts, starts, drifts, gaps)
def test_anchors_do_not_disturb_each_other(start, other, drift, gaps):
    first, second = frames_of(start, drift, gaps), frames_of(other, -drift, gaps, anchor=2)
    mixed = [one for pair in zip(first, second, strict=True) for one in pair]
    assert Fault.LATE not in Arrivals().faults(mixed)
