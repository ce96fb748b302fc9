"""Frames that are meant to disturb what listeners and anchors keep: clocks, allowances, sections of keys."""

import secrets
from collections import Counter

import pytest
from test_known_keys import CHAIN, FIRST, KEYS, PUBLIC, SITE, TIMING, count_steps

from skyless.core.air.almanac import KeyPage
from skyless.core.air.beacon import Beacon, decode, encode, with_authentication
from skyless.core.air.frame import Reception
from skyless.core.keys import chain, known_keys
from skyless.core.keys.authentication import NO_KEYS_S, BeaconAuthentication
from skyless.core.keys.chain import SECTION_INTERVALS, mac_of
from skyless.core.keys.fault import Fault
from skyless.core.keys.verifier import Verifier
from skyless.core.ticks import from_seconds, wrap

OWN = 4
START_S = TIMING.start_s(FIRST + SECTION_INTERVALS // 2) + 0.02


def beacon(anchor, sequence, at_s, key=None):
    page = None if key is None else KeyPage(key)
    return Beacon(SITE, anchor, sequence & 0xFF, wrap(from_seconds(at_s)), 0, 0x20, None, (), 0, page)


def frame(anchor, sequence, at_s, interval, *, key=None, keys=KEYS):
    """A frame of an interval; without ``keys`` its code is wrong."""
    code = (lambda _: bytes(8)) if keys is None else (lambda signed: mac_of(signed, keys.mac_key(interval)))
    return with_authentication(encode(beacon(anchor, sequence, at_s, key)), interval & 0xFFFF, code)


def received(sent, at_s):
    return decode(sent), Reception(sent, wrap(from_seconds(at_s)), at_s)


class OneAnchor:
    """An anchor whose clock is ahead, and what it would send."""

    def __init__(self, **fields):
        self.authentication = BeaconAuthentication([CHAIN], **fields)
        self.frames = 0

    def at(self, at_s, ahead_s=0.0):
        self.authentication.set_time(wrap(from_seconds(at_s)), START_S + at_s + ahead_s)

    def hear(self, sent, at_s):
        return self.authentication.fault_of(*received(sent, at_s))

    def contents(self, at_s):
        """Of a frame that may disclose a key."""
        self.frames += 2
        return self.authentication.contents(wrap(from_seconds(at_s)), self.frames | 1, OWN, 1 / 30)

    def hear_others(self, at_s, ahead_s=0.0, others=(1, 2, 3)):
        for other in others:
            now_s = at_s + 0.01 * other
            self.at(now_s, ahead_s)
            self.hear(frame(other, round(10 * at_s), now_s, TIMING.interval_at(START_S + now_s)), now_s)


@pytest.mark.parametrize("ahead_s", [0.4, 5.0, 9.0, 11.0, 300.0, 3000.0, 90000.0])
def test_an_anchor_whose_clock_is_ahead_discloses_no_key(ahead_s):
    anchor = OneAnchor()
    for number in range(100):
        at_s = 0.1 * number
        anchor.hear_others(at_s, ahead_s)
        anchor.at(at_s + 0.05, ahead_s)
        assert anchor.contents(at_s + 0.05).key is None
    if ahead_s < 10.0:
        assert anchor.authentication.fault() is Fault.CLOCK_WRONG


def test_an_anchor_discloses_keys_some_time_after_its_start_if_others_confirm_its_clock():
    for others in ((1, 2, 3), (1,), ()):
        anchor = OneAnchor()
        for number in range(100):
            at_s = 0.1 * number
            anchor.hear_others(at_s, others=others)
            anchor.at(at_s + 0.05)
            may_disclose = at_s + 0.05 >= NO_KEYS_S and len(others) > 0
            assert (anchor.contents(at_s + 0.05).key is not None) == may_disclose


@pytest.mark.parametrize("step_s", [200.0, -200.0])
def test_an_anchor_discloses_no_key_when_its_clock_has_just_been_set(step_s):
    anchor = OneAnchor(no_keys_s=NO_KEYS_S)
    for number in range(60):
        at_s = 0.1 * number
        ahead_s = step_s if number >= 40 else 0.0
        anchor.hear_others(at_s, ahead_s)
        anchor.at(at_s + 0.05, ahead_s)
        contents = anchor.contents(at_s + 0.05)
        if number >= 40:
            assert contents.key is None
        elif at_s > NO_KEYS_S:
            assert contents.key is not None


def test_old_beacons_of_absent_anchors_do_not_silence_an_anchor():
    """At most it discloses no key, which others do."""
    anchor = OneAnchor()
    for number in range(100):
        at_s = 0.1 * number
        anchor.hear_others(at_s, others=(1, 2))
        if number > 50 and number % 10 == 5:
            for absent in (3, 5, 6):
                then_s = at_s + 0.05 - 1.0
                anchor.hear(frame(absent, number, then_s, TIMING.interval_at(START_S + then_s)), at_s + 0.05)
        anchor.at(at_s + 0.09)
        assert anchor.authentication.fault() is None
        assert anchor.contents(at_s + 0.09).interval is not None


def test_frames_of_far_intervals_cost_an_anchor_no_keys(monkeypatch):
    anchor = OneAnchor()
    anchor.at(0.0)
    anchor.authentication.seal(encode(beacon(OWN, 0, 0.0)), anchor.contents(0.0).interval)
    steps = count_steps(monkeypatch, chain)
    for number in range(200):
        at_s = 0.1 * number
        anchor.at(at_s)
        steps.clear()
        anchor.authentication.seal(encode(beacon(OWN, number, at_s)), anchor.contents(at_s).interval)
        assert sum(steps) <= chain.STEPS_AHEAD
        steps.clear()
        far = TIMING.interval_at(START_S + at_s) + (number % 7 - 3) * SECTION_INTERVALS
        anchor.hear(frame(3, number, at_s, far + number, keys=None), at_s + 0.05)
        assert steps == []


class OneTag:
    """A verifier with the certificates of a chain, and genuine frames of four anchors."""

    def __init__(self):
        certificates = [KEYS.certificate(FIRST), KEYS.certificate(FIRST + SECTION_INTERVALS)]
        self.verifier = Verifier(SITE, PUBLIC, 0.1, Counter(), certificates=certificates)

    def hear(self, sent, at_s, unix_s):
        """Sequence numbers of the frames of which it is known from now on that they are genuine."""
        self.verifier.add(*received(sent, at_s), unix_s)
        return [one.beacon.sequence for one, fault in self.verifier.decided() if fault is None]

    def hear_anchors(self, at_s, start_s=START_S, number=0):
        genuine = []
        for anchor in range(4):
            now_s = at_s + 0.01 * anchor
            interval = TIMING.interval_at(start_s + now_s)
            key = KEYS.key(interval - TIMING.lag) if number & 1 else None
            genuine += self.hear(frame(anchor, number, now_s, interval, key=key), now_s, start_s + now_s)
        return genuine


def test_no_old_key_makes_frames_genuine_after_the_host_was_suspended():
    tested = OneTag()
    before = [tested.hear_anchors(0.1 * number, number=number) for number in range(20)]
    assert any(before)
    for number in range(20, 80):  # the monotonic clock goes on where it stopped, the Unix clock is right
        at_s = 0.1 * number
        interval = TIMING.interval_at(START_S + at_s)
        forged = frame(number % 4, number, at_s, interval, key=KEYS.key(interval - TIMING.lag))
        assert all(sequence < 20 for sequence in tested.hear(forged, at_s, START_S + at_s + 300.0))


def test_forged_keys_do_not_keep_a_tag_from_catching_up():
    tested, genuine = OneTag(), []
    for number in range(20):
        tested.hear_anchors(0.1 * number, number=number)
    for number in range(2000, 2100):  # after 200 s without reception
        at_s = 0.1 * number
        genuine += tested.hear_anchors(at_s, number=number)
        for other in range(25):
            now_s = at_s + 0.045 + 0.002 * other
            forged = frame(9, other, now_s, FIRST + SECTION_INTERVALS + 523, key=secrets.token_bytes(16), keys=None)
            tested.hear(forged, now_s, START_S + now_s)
    assert len(genuine) > 200


def test_forged_keys_cost_a_bounded_number_of_steps_in_any_section(monkeypatch):
    tested = OneTag()
    tested.hear_anchors(0.0, number=1)
    steps = count_steps(monkeypatch, known_keys)
    for number in range(1000):  # within a second
        at_s = 0.1 + 1e-3 * number
        interval = FIRST + (number * 37) % (2 * SECTION_INTERVALS)
        forged = frame(9, number, at_s, interval, key=secrets.token_bytes(16), keys=None)
        tested.hear(forged, at_s, START_S + at_s)
    assert sum(steps) <= known_keys.MAX_STEPS + known_keys.STEPS_PER_S + 1000 * known_keys.NEAR_STEPS


def test_old_keys_and_certificates_are_no_error_of_the_clock():
    tested, old = OneTag(), FIRST
    start_s = TIMING.start_s(FIRST + SECTION_INTERVALS + 4000)
    tested.hear_anchors(0.0, start_s, 1)
    for number in range(1, 50):
        at_s = 0.1 * number
        tested.hear_anchors(at_s, start_s, number)
        for _ in range(12):
            old += 1
            now_s = at_s + 0.05
            tested.hear(frame(9, number, now_s, old + TIMING.lag, key=KEYS.key(old), keys=None), now_s, start_s + now_s)
        assert tested.verifier.clock.error_s is None
