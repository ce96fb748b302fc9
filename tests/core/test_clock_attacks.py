"""Attacks through time: hosts whose clocks are set or dragged, and anchors that are ahead, within what is documented.

The attacker receives every key the moment that the first anchor discloses it, and sends frames with right codes and
right stamps made with it at once. Anchors' counters and the tag's run alike.
"""

from collections import Counter

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from test_attacks_on_state import START_S, frame, received
from test_known_keys import CHAIN, FIRST, KEYS, PUBLIC, SITE, TIMING

from skyless.core.keys.authentication import BeaconAuthentication
from skyless.core.keys.chain import SECTION_INTERVALS
from skyless.core.keys.fault import Fault
from skyless.core.keys.verifier import Verifier

BOUND_S = 0.5 * ((TIMING.lag - 1) * TIMING.interval_s - TIMING.anchor_lead_s - TIMING.anchors_apart_s)
"""How far a tag's clock may be off without a genuine frame being refused."""
ANCHOR_S = 0.5 * TIMING.anchors_apart_s
"""How far an anchor's clock may be off."""
BACK_S = 1.0
"""A tag may need this long for fixes after its clock is right again: keys, and two frames of each anchor."""
FORGED = 200


class Air:
    """A tag among four anchors with 10 beacons a second each, and an attacker."""

    def __init__(self, errors_s=(0.0, 0.0, 0.0, 0.0)):
        self._errors_s = errors_s
        certificates = [KEYS.certificate(FIRST), KEYS.certificate(FIRST + SECTION_INTERVALS)]
        self.counters = Counter()
        self.verifier = Verifier(SITE, PUBLIC, BOUND_S, self.counters, certificates=certificates)
        self.genuine, self.forged = [], []
        """When frames were accepted."""
        self._round = 0

    def run(self, from_s, until_s, host_error_s=lambda _: 0.0, *, attacks=False, is_jammed=lambda _: False):
        for number in range(round(10 * from_s), round(10 * until_s)):
            for anchor, error_s in enumerate(self._errors_s):
                at_s = 0.1 * number + 0.025 * anchor + 0.003
                if not is_jammed(at_s):
                    interval = TIMING.interval_at(START_S + at_s + error_s)
                    key = KEYS.key(interval - TIMING.lag)
                    self._hear(frame(anchor, number & 0x7F | 1, at_s, interval, key=key), at_s, host_error_s(at_s))
                if attacks:
                    at_s += 0.01
                    disclosed = TIMING.interval_at(START_S + at_s + max(self._errors_s)) - TIMING.lag
                    self._hear(frame(anchor, FORGED, at_s, disclosed), at_s, host_error_s(at_s))

    def _hear(self, sent, at_s, error_s):
        self.verifier.add(*received(sent, at_s), START_S + at_s + error_s)
        for one, fault in self.verifier.decided():
            if fault is None:
                (self.forged if one.beacon.sequence == FORGED else self.genuine).append(at_s)


def accepted(air, from_s, until_s):
    return sum(from_s <= at_s < until_s for at_s in air.genuine)


@pytest.mark.parametrize("seconds", [0.2, 4.0])
@pytest.mark.parametrize("step_s", [-90000.0, -5.0, -0.3, 0.15, 0.25, 0.5, 1.0, 60.0, 3600.0, 2e6])
def test_frames_are_accepted_again_soon_after_any_step_of_the_host_clock(step_s, seconds):
    air, ends_s = Air(), 2.0 + seconds
    air.run(0.0, ends_s + 2.0, lambda at_s: step_s if 2.0 <= at_s < ends_s else 0.0)
    assert accepted(air, 1.0, 2.0) == 40
    assert accepted(air, ends_s + BACK_S, ends_s + 2.0) >= 40
    assert air.verifier.clock.error_s is None or seconds < 1.0


@pytest.mark.site
@settings(max_examples=20, deadline=None)
@given(
    anchors_s=st.lists(st.floats(-ANCHOR_S, ANCHOR_S), min_size=4, max_size=4),
    host_s=st.floats(-BOUND_S, BOUND_S),
    ahead_s=st.none() | st.floats(ANCHOR_S, TIMING.anchor_lead_s),
)
def test_no_forged_frame_is_accepted_where_clocks_are_within_their_tolerances(anchors_s, host_s, ahead_s):
    """Also where an anchor that the tag does not hear is ahead by as much as it may be unnoticed."""
    air = Air((*anchors_s, anchors_s[0] if ahead_s is None else ahead_s))
    air.run(0.0, 3.0, lambda _: host_s, attacks=True)
    assert air.forged == []
    assert accepted(air, 1.5, 2.5) >= 39
    assert set(air.counters) <= {Fault.LATE, Fault.FIRST}


@pytest.mark.parametrize("rate", [3e-3, 0.1, 1.0, 100.0])
def test_a_host_clock_that_is_dragged_back_lets_no_old_key_in(rate):
    """Genuine frames come at first, are jammed for three seconds, and come again; forged ones all the time."""
    air = Air()
    ends_s = 8.0 if rate > 0.01 else 30.0
    begins_s = ends_s - 5.0
    air.run(
        0.0,
        ends_s,
        lambda at_s: -min(3.0, rate * max(at_s - 1.0, 0.0)),
        attacks=True,
        is_jammed=lambda at_s: begins_s <= at_s < begins_s + 3.0,
    )
    assert accepted(air, 1.0, 2.0) >= 39
    assert air.forged == []


@pytest.mark.parametrize("ahead_s", [0.06, 0.08, 0.14])
def test_an_anchor_that_is_ahead_is_reported_by_the_others(ahead_s):
    authentication = BeaconAuthentication([CHAIN], no_keys_s=0.0)
    found = set()
    for number in range(40):
        for anchor, error_s in ((1, 0.0), (2, 0.0), (3, ahead_s)):
            now_s = 0.093 * number + 0.03 * anchor  # at any time of an interval
            authentication.set_time(received(b"", now_s)[1].rx_ticks, START_S + now_s)
            sent = frame(anchor, number, now_s, TIMING.interval_at(START_S + now_s + error_s))
            found.add((anchor, authentication.fault_of(*received(sent, now_s))))
    assert (3, Fault.EARLY) in found
    assert {(1, None), (2, None)} == {one for one in found if one[0] < 3}


@pytest.mark.parametrize("late_s", [0.31, 0.36, 0.49])
def test_an_anchor_refuses_frames_whose_key_another_one_may_have_disclosed(late_s):
    authentication = BeaconAuthentication([CHAIN], no_keys_s=0.0)
    start_s = TIMING.start_s(TIMING.interval_at(START_S))
    authentication.set_time(received(b"", late_s)[1].rx_ticks, start_s + late_s)
    sent = frame(1, 1, 0.0, TIMING.interval_at(START_S))
    assert authentication.fault_of(*received(sent, late_s)) is Fault.LATE
