"""What a listener decides about each frame of a site with keys: by its time, its code, and what came before."""

import math
from collections import Counter, deque

import pytest
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey
from test_attacks_on_state import START_S, beacon, frame, received
from test_known_keys import FIRST, KEYS, PUBLIC, SITE, TIMING, chain

from skyless.core.air.beacon import Beacon, decode
from skyless.core.air.frame import Reception
from skyless.core.keys import verifier
from skyless.core.keys.chain import SECTION_BITS, SECTION_INTERVALS, ChainKeys
from skyless.core.keys.fault import Fault
from skyless.core.keys.verifier import DRIFT, FAULT_TICKS, LONGEST_WAIT_TICKS, RECENT_KEYS, SiteClock, Verifier
from skyless.core.ticks import TICK_S, from_seconds, wrap

BOUND_S = 0.125
"""A host's largest error that floats hold exactly, so that tests can stand on the bound itself."""
NOW = TIMING.interval_at(START_S)


class Listener:
    """A verifier with both certificates, whose host's clock is right."""

    def __init__(self, **options):
        self.counters = Counter()
        certificates = [KEYS.certificate(FIRST), KEYS.certificate(FIRST + SECTION_INTERVALS)]
        self.verifier = Verifier(SITE, PUBLIC, 0.1, self.counters, **{"certificates": certificates, **options})

    def hear(self, interval, *, present=NOW, anchor=1, sequence=0, key=None, keys=KEYS):
        """A frame, received when ``present`` is the latest interval that any anchor can have begun.

        ``key``: an interval whose key it discloses.
        """
        unix_s = TIMING.start_s(present) + 0.5 * TIMING.interval_s - 0.1 - TIMING.anchor_lead_s
        at_s = unix_s - START_S + 5.0
        disclosed = None if key is None else KEYS.key(key)
        sent = frame(anchor, sequence, at_s, interval, key=disclosed, keys=keys)
        return self.verifier.add(*received(sent, at_s), unix_s)

    def decided(self):
        return [(one.beacon.sequence, fault) for one, fault in self.verifier.decided()]

    def begin(self, *anchors):
        """Two frames of each anchor, so that later ones are judged alone; keys are known up to five intervals ago."""
        for number, interval in enumerate((NOW - 8, NOW - 7)):
            for anchor in anchors:
                self.hear(interval, present=interval, anchor=anchor, sequence=200 + number)
        self.hear(NOW - 2, present=NOW - 2, anchor=60, key=NOW - 7, sequence=250)
        self.verifier.decided()


@pytest.mark.parametrize(
    ("behind", "fault"),
    [(-9, Fault.EARLY), (-1, Fault.EARLY), (0, None), (1, None), (4, None), (5, Fault.LATE), (60, Fault.LATE)],
)
def test_a_frame_arrives_within_its_interval_and_before_its_key_may_be_disclosed(behind, fault):
    listener = Listener()
    waits = listener.hear(NOW - behind)
    assert (waits is None) == (fault is not None)
    if waits is None:
        assert listener.counters == {fault: 1}
        assert listener.verifier.faults() == {1: fault}
    else:
        assert waits.interval == NOW - behind
        assert listener.verifier.waiting() == (waits,)


def test_a_frame_is_genuine_once_its_key_is_disclosed_and_not_before():
    listener = Listener()
    listener.begin(1, 2)
    for sequence, interval in ((1, NOW), (2, NOW + 1)):
        assert listener.hear(interval, present=interval, sequence=sequence).is_plausible
    listener.hear(NOW, present=NOW + 1, anchor=2, sequence=3, keys=None)
    assert listener.decided() == []
    listener.hear(NOW + 5, present=NOW + 5, key=NOW, sequence=4)
    assert listener.decided()[1:] == [(1, None)]  # the first one is that which had disclosed a key
    listener.hear(NOW + 6, present=NOW + 6, key=NOW + 1, sequence=5)
    assert listener.decided() == [(2, None), (3, Fault.BAD_CODE)]
    assert listener.counters[Fault.BAD_CODE] == 1


def test_keys_in_time_are_followed_without_end():
    """They need none of the allowance that forged ones use up."""
    listener = Listener()
    for interval in range(NOW, NOW + 100):
        for anchor in range(4):
            listener.hear(interval, present=interval, anchor=anchor, key=interval - TIMING.lag)
            assert listener.verifier.keys.newest == interval - TIMING.lag
    assert "forged-key" not in listener.counters
    listener.verifier._on_key(bytes(16), NOW + 90, 1, TIMING, is_early=False)
    assert listener.counters["forged-key"] == 1


def test_nothing_is_decided_by_keys_that_show_the_host_s_clock_to_be_behind():
    listener = Listener()
    listener.begin(1)
    listener.hear(NOW, sequence=1)
    listener.hear(NOW + 3, anchor=2, key=NOW - 2, sequence=2)  # early by this clock, and its key is right
    assert listener.verifier.clock.is_late
    assert listener.decided() == []
    assert listener.hear(NOW - 3) is None, "the key of a later interval is known"
    assert listener.hear(NOW - 2) is None, "its key is known"
    assert listener.counters[Fault.LATE] == 2
    assert listener.hear(NOW - 1) is not None
    listener.hear(NOW + 5, anchor=2, key=NOW, sequence=2)
    assert listener.decided() == []


def test_a_frame_without_a_key_is_given_up_after_two_seconds():
    listener = Listener()
    sent = frame(1, 1, 0.0, NOW)
    ends = []
    for ticks in (0, LONGEST_WAIT_TICKS - 1, LONGEST_WAIT_TICKS, LONGEST_WAIT_TICKS + 1):
        unix_s = START_S - 0.2
        listener.verifier.add(decode(sent), Reception(sent, wrap(10**9 + ticks), ticks * TICK_S), unix_s)
        ends.append([(one.rx_ticks - 10**9, fault) for one, fault in listener.verifier.decided()])
    assert ends == [[], [], [(0, Fault.NO_KEY)], []]
    assert listener.counters == {Fault.NO_KEY: 1}
    assert listener.verifier.faults() == {}, "it may have been genuine"


def test_a_frame_whose_key_cannot_come_any_more_does_not_hold_up_those_after_it():
    """Keys of a section's end cannot be derived from those of the next section."""
    listener = Listener()
    last = FIRST + SECTION_INTERVALS - 1
    listener.hear(last, present=last, sequence=1)
    listener.hear(last + 1, present=last + 1, sequence=2)
    listener.hear(last + 6, present=last + 6, sequence=3, key=last + 1)
    assert listener.decided() == [(1, Fault.NO_KEY), (2, Fault.FIRST)]
    assert listener.verifier.faults() == {}, "both may be genuine"


def test_frames_from_before_the_first_certificate_are_judged_by_the_time_of_their_arrival():
    listener = Listener(certificates=[])
    assert listener.decided() == []
    for sequence, interval in ((1, NOW), (2, NOW + 1), (3, NOW - 4), (4, NOW - 5)):
        assert listener.hear(interval, sequence=sequence).interval is None
    sent = Beacon(SITE, 2, 0, 0, 0, 0x20, None, (), 0, None, KEYS.certificate(NOW))
    listener.verifier.add(sent, Reception(b"", wrap(from_seconds(5.0)), 5.0), START_S)
    assert listener.decided() == []
    listener.hear(NOW + 6, present=NOW + 6, sequence=5, key=NOW + 1)
    assert listener.decided() == [(1, None), (2, Fault.EARLY), (3, None), (4, Fault.LATE)]


def test_frames_that_wait_are_limited_in_number(monkeypatch):
    monkeypatch.setattr(verifier, "MAX_UNDECIDED", 3)
    listener = Listener()
    assert [listener.hear(NOW, sequence=number) is None for number in range(5)] == [False, False, False, True, True]
    assert listener.counters == {Fault.TOO_MANY: 2}


@pytest.mark.parametrize(("between", "fault"), [(0, Fault.REPEATED), (1, Fault.REPEATED), (2, None)])
def test_a_repetition_is_found_as_long_as_codes_are_kept(monkeypatch, between, fault):
    """Two to four of them here. A repetition at the very time of the first one has no other fault."""
    monkeypatch.setattr(verifier, "CODES_KEPT", 2)
    listener = Listener()
    listener.begin(1)  # its last frame is decided with those that follow
    for sequence in (1, *range(2, 2 + between), 1):
        listener.hear(NOW, sequence=sequence)
    listener.hear(NOW + 5, present=NOW + 5, key=NOW, sequence=9)
    assert [fault for sequence, fault in listener.decided() if sequence == 1] == [None, fault]


REVOKED = ChainKeys(chain(serial=1)).certificate(FIRST)


def test_a_revoked_chain_is_reported_rather_than_what_else_its_anchor_does():
    listener = Listener(least_serial=2, certificates=[])
    found = []
    for after, certificate in ((0, REVOKED), (1, None), (5, REVOKED), (FAULT_TICKS + 4, None), (FAULT_TICKS + 5, None)):
        sent = beacon(1, 0, 0.0)
        sent = sent if certificate is None else Beacon(SITE, 1, 0, 0, 0, 0x20, None, (), 0, None, certificate)
        listener.verifier.add(sent, Reception(b"", wrap(10**9 + after), after * TICK_S), START_S)
        found.append(listener.verifier.faults()[1])
    assert found == [Fault.REVOKED_CHAIN] * 4 + [Fault.NO_CODE]
    listener.verifier.newest_ticks += FAULT_TICKS - 1
    assert listener.verifier.faults() == {1: Fault.NO_CODE}
    listener.verifier.newest_ticks += 1
    assert listener.verifier.faults() == {}
    assert listener.counters == {Fault.REVOKED_CHAIN: 2, Fault.NO_CODE: 5}


def test_forged_names_displace_each_other_and_no_anchor_s_fault(monkeypatch):
    monkeypatch.setattr(verifier, "MAX_FAULTY_ANCHORS", 3)
    listener = Listener()
    listener.begin(1)
    for anchor in (1, 2, 3, 4, 5):
        assert listener.hear(NOW - 5, anchor=anchor) is None
    assert set(listener.verifier.faults()) == {1, 4, 5}


# The bounds of the site's time.


def clock_at(unix_s=START_S, ticks=0):
    clock = SiteClock(BOUND_S, offsets_s=deque())
    clock.advance(ticks, unix_s)
    return clock


DISCLOSED_S = TIMING.start_s(NOW + TIMING.lag)
"""When the key of ``NOW`` is disclosed."""


def test_a_key_at_the_upper_bound_is_in_time():
    for early_s, is_late in ((0.0, False), (1e-5, True)):
        clock = clock_at(DISCLOSED_S - BOUND_S - TIMING.anchor_lead_s - early_s)
        clock.on_key(NOW, TIMING)
        assert clock.is_late is is_late
        assert clock.lower_s == (-math.inf if is_late else DISCLOSED_S)


@pytest.mark.parametrize(("offset_s", "error_s"), [(BOUND_S, None), (-BOUND_S, None), (BOUND_S + 1e-5, BOUND_S + 1e-5)])
def test_an_error_of_the_host_s_clock_is_beyond_its_bound(offset_s, error_s):
    clock = clock_at(DISCLOSED_S + offset_s)
    clock.on_key(NOW, TIMING)
    assert clock.error_s == (None if error_s is None else pytest.approx(error_s, abs=1e-6))


def test_a_host_s_clock_that_has_been_set_forward_is_an_error_beyond_a_second():
    clock = clock_at(DISCLOSED_S)
    clock.on_key(NOW, TIMING)
    for ahead_s in (BOUND_S + verifier.AHEAD_S, BOUND_S + verifier.AHEAD_S + 1e-5):
        clock.advance(0, DISCLOSED_S + ahead_s)
        assert clock.error_s == (None if ahead_s == BOUND_S + verifier.AHEAD_S else pytest.approx(ahead_s))


LENGTH_S = SECTION_INTERVALS * TIMING.interval_s + BOUND_S


@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.parametrize(("beyond_s", "is_far"), [(-1e-3, False), (1e-3, True)])
def test_a_section_that_is_far_shows_an_error_of_the_host_s_clock_until_there_is_a_key(sign, beyond_s, is_far):
    section, offset_s = NOW >> SECTION_BITS, sign * (LENGTH_S + beyond_s)
    clock = clock_at(TIMING.start_s(section << SECTION_BITS) + offset_s)
    clock.on_section(section, TIMING)
    assert clock.error_s == (pytest.approx(offset_s, abs=1e-6) if is_far else None)
    clock.advance(0, DISCLOSED_S)
    clock.on_key(NOW, TIMING)
    assert clock.error_s is None


def test_a_certificate_is_of_its_section_s_time_unless_there_are_too_many_to_check():
    for forged in (0, 100):
        listener = Listener()
        stranger = ChainKeys(chain(private=Ed25519PrivateKey.from_private_bytes(bytes(32)))).certificate(FIRST)
        third = chain(serial=2, first=FIRST + SECTION_INTERVALS)
        for certificate in (*[stranger] * forged, ChainKeys(third).certificate(FIRST + SECTION_INTERVALS)):
            sent = Beacon(SITE, 2, 0, 0, 0, 0x20, None, (), 0, None, certificate)
            listener.verifier.add(sent, Reception(b"", wrap(from_seconds(5.0)), 5.0), START_S + 1e6)
        assert (listener.verifier.clock.error_s is None) == (forged > 0)
        assert listener.counters["forged-certificate"] == forged


def test_one_prompt_key_of_ten_shows_that_the_clock_is_right():
    clock, late_s = clock_at(DISCLOSED_S), 0.5
    clock.on_key(NOW, TIMING)
    for number in range(1, RECENT_KEYS + 1):
        assert clock.error_s is None
        at_s = 0.1 * number + late_s
        clock.advance(from_seconds(at_s), DISCLOSED_S + at_s)
        clock.on_key(NOW + number, TIMING)
    assert clock.error_s == pytest.approx(late_s, abs=1e-6)


def test_the_lower_bound_goes_on_slower_than_any_counter():
    clock = clock_at(DISCLOSED_S)
    clock.on_key(NOW, TIMING)
    clock.advance(from_seconds(1000.0), DISCLOSED_S)
    assert clock.upper_s(TIMING) - clock.lower_s == pytest.approx(2 * TIMING.interval_s, abs=1e-5)
    assert clock.lower_s - DISCLOSED_S == pytest.approx(1000.0 * (1.0 - DRIFT), abs=1e-5)


def test_only_a_counter_that_goes_back_by_more_than_a_second_has_restarted():
    for back, is_verified in ((from_seconds(1.0), True), (from_seconds(1.0) + 1, False)):
        clock = clock_at(DISCLOSED_S, 10**12)
        clock.on_key(NOW, TIMING)
        clock.advance(10**12 - back, DISCLOSED_S)
        assert clock.is_verified is is_verified
