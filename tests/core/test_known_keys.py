"""What a listener keeps of certificates and keys, nothing forged and at a bounded cost; which frames came late."""

import secrets

import pytest
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey
from hypothesis import given, settings
from hypothesis import strategies as st

from skyless.core.keys import chain as chains
from skyless.core.keys import known_keys
from skyless.core.keys.fault import Fault
from skyless.core.keys.known_keys import SILENCE_TICKS, Arrivals, KeyUse, KnownKeys, Stamps
from skyless.core.ticks import MAX_DRIFT, from_seconds, wrap

SITE = 42
TIMING = chains.ChainTiming()
SECTION = 2_197_265
FIRST = SECTION << chains.SECTION_BITS
PRIVATE = Ed25519PrivateKey.from_private_bytes(bytes(range(32)))
PUBLIC = chains.public_key(PRIVATE.public_key().public_bytes_raw())


def chain(serial=1, first=FIRST, sections=2, site=SITE, private=PRIVATE):
    covered = range(first >> chains.SECTION_BITS, (first >> chains.SECTION_BITS) + sections)
    seed = bytes((serial,)) * 32
    return chains.Chain(
        site,
        serial,
        TIMING,
        first,
        chains.section_signatures(seed, site, serial, TIMING, first, covered, private),
        seed,
    )


CHAIN = chain()
KEYS = chains.ChainKeys(CHAIN)
SENT = KEYS.certificate(FIRST)


def at_s(interval):
    return TIMING.start_s(interval)


def known():
    made = KnownKeys(SITE, PUBLIC)
    assert made.on_certificate(SENT, at_s(FIRST)) is KeyUse.NEW
    return made


@given(st.integers(0, 8 * len(SENT) - 1))
@settings(max_examples=60)
def test_no_bit_of_a_certificate_can_be_changed(bit):
    made = KnownKeys(SITE, PUBLIC)
    altered = (int.from_bytes(SENT, "big") ^ 1 << bit).to_bytes(len(SENT), "big")
    assert made.on_certificate(altered, at_s(FIRST)) is KeyUse.FORGED
    assert made.certificates == ()
    assert made.timing is None


@given(st.binary(min_size=94, max_size=94))
def test_any_bytes_are_a_forged_certificate(sent):
    assert KnownKeys(SITE, PUBLIC).on_certificate(sent, at_s(FIRST)) is KeyUse.FORGED


def test_certificates_of_other_sites_and_owners_are_forged():
    for other in (chain(site=43), chain(private=Ed25519PrivateKey.generate())):
        sent = chains.ChainKeys(other).certificate(FIRST)
        assert KnownKeys(SITE, PUBLIC).on_certificate(sent, at_s(FIRST)) is KeyUse.FORGED


@given(st.lists(st.integers(0, 3000), min_size=1, max_size=8))
@settings(max_examples=30)
def test_keys_are_accepted_in_any_order_and_give_those_between(offsets):
    made, newest = known(), -1
    for offset in offsets:
        use = made.on_key(KEYS.key(FIRST + offset), FIRST + offset, at_s(FIRST + offset), 1)
        assert use is (KeyUse.NEW if offset > newest else KeyUse.KNOWN)
        newest = max(newest, offset)
    assert made.newest == FIRST + newest
    for offset in range(max(0, newest - 200), newest + 1):
        assert made.mac_key(FIRST + offset) == KEYS.mac_key(FIRST + offset)
    assert made.mac_key(FIRST + newest + 1) is None


@given(st.integers(-3, 300), st.binary(min_size=16, max_size=16))
def test_a_forged_key_changes_nothing(offset, key):
    made = known()
    made.on_key(KEYS.key(FIRST + 10), FIRST + 10, at_s(FIRST), 1)
    assert made.on_key(key, FIRST + offset, at_s(FIRST), 1) in {KeyUse.FORGED, KeyUse.KNOWN}
    assert made.newest == FIRST + 10
    assert made.mac_key(FIRST + 10) == KEYS.mac_key(FIRST + 10)


def test_a_key_of_another_interval_is_forged():
    made = known()
    assert made.on_key(KEYS.key(FIRST + 11), FIRST + 10, at_s(FIRST), 1) is KeyUse.FORGED


def count_steps(monkeypatch, module):
    """The steps of each hash from now on."""
    steps, earlier_key = [], chains.earlier_key

    def counted(key, name, number=1):
        steps.append(number)
        return earlier_key(key, name, number)

    monkeypatch.setattr(module, "earlier_key", counted)
    return steps


def test_forged_keys_far_ahead_cost_a_bounded_number_of_steps(monkeypatch):
    steps = count_steps(monkeypatch, known_keys)
    made, interval = known(), FIRST + chains.SECTION_INTERVALS - 1
    for number in range(1000):  # within a second
        made.on_key(secrets.token_bytes(16), interval, at_s(FIRST) + 1e-3 * number, 1)
    assert sum(steps) <= known_keys.MAX_STEPS + known_keys.STEPS_PER_S
    assert made.on_key(KEYS.key(FIRST + 3), FIRST + 3, at_s(FIRST) + 1.0, 1) is KeyUse.NEW  # the expected ones are free


def test_many_forged_keys_do_not_keep_a_right_one_waiting_that_two_anchors_sent():
    made, interval = known(), FIRST + 4000
    for number in range(1000):
        assert made.on_key(secrets.token_bytes(16), interval, at_s(interval), number) is not KeyUse.NEW
    assert made.on_key(KEYS.key(interval), interval, at_s(interval), 1) is KeyUse.KNOWN
    assert made.on_key(KEYS.key(interval), interval, at_s(interval), 2) is KeyUse.NEW


def test_forged_certificates_cost_a_bounded_number_of_checks():
    made, uses = KnownKeys(SITE, PUBLIC), []
    for number in range(400):
        sent = SENT[:-2] + number.to_bytes(2, "big")
        uses.append(made.on_certificate(sent, at_s(FIRST) + 1e-3 * number))
    assert uses.count(KeyUse.FORGED) <= known_keys.MAX_CHECKS + 0.4 * known_keys.CHECKS_PER_S
    assert uses[-1] is KeyUse.IGNORED
    assert made.on_certificate(SENT, at_s(FIRST) + 2.0) is KeyUse.NEW


def test_the_next_section_and_the_next_chain_go_on():
    made, last = known(), FIRST + chains.SECTION_INTERVALS - 1
    assert made.on_certificate(KEYS.certificate(last + 1), at_s(last)) is KeyUse.NEW
    for interval in (last, last + 1, last + 5):
        assert made.on_key(KEYS.key(interval), interval, at_s(last), 1) is KeyUse.NEW
        assert made.mac_key(interval) == KEYS.mac_key(interval)
    second = chains.ChainKeys(chain(serial=2, first=last + 100, sections=2))
    assert made.on_certificate(second.certificate(last + 100), at_s(last)) is KeyUse.NEW
    assert made.serial == 1  # it does not count yet
    assert made.on_key(KEYS.key(last + 99), last + 99, at_s(last), 1) is KeyUse.NEW
    assert made.on_key(KEYS.key(last + 100), last + 100, at_s(last), 1) is KeyUse.FORGED
    assert made.on_key(second.key(last + 101), last + 101, at_s(last), 1) is KeyUse.NEW
    assert made.mac_key(last + 100) == second.mac_key(last + 100)
    assert made.mac_key(last + 99) == KEYS.mac_key(last + 99)
    assert made.serial == 2
    assert made.on_certificate(KEYS.certificate(last + 1), at_s(last + 110)) is KeyUse.REVOKED


def test_old_certificates_make_way():
    made = KnownKeys(SITE, PUBLIC)
    long = chains.ChainKeys(chain(sections=12))
    for section in range(12):
        interval = FIRST + section * chains.SECTION_INTERVALS
        assert made.on_certificate(long.certificate(interval), at_s(interval)) is KeyUse.NEW
        assert len(made.certificates) <= known_keys.MAX_CERTIFICATES
        assert chains.read_certificate(SITE, made.certificates[-1])[0].name.section == SECTION + section
        assert made.on_key(long.key(interval), interval, at_s(interval), 1) is KeyUse.NEW


@pytest.mark.parametrize(
    "damage", [lambda sent: sent[:-1] + b"\0", lambda sent: bytes(94), lambda sent: sent[:40], lambda sent: sent[::-1]]
)
def test_damaged_certificates_of_an_earlier_run_are_ignored(damage):
    assert KnownKeys(SITE, PUBLIC, certificates=[damage(SENT)]).certificates == ()
    assert KnownKeys(SITE, PUBLIC, certificates=[damage(SENT), SENT]).certificates == (SENT,)


# Which of an anchor's genuine frames came late, by the counters of both ends

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
