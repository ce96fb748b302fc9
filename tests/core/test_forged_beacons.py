"""Forged, altered, repeated and delayed beacons at a site with keys: none moves a verified fix."""

import os
from bisect import bisect_right
from collections import Counter
from functools import lru_cache
from random import Random

import numpy as np
import pytest
from free_site import FREE
from hypothesis import given, settings
from hypothesis import strategies as st
from msgspec.structs import replace

from skyless.core.air.beacon import decode
from skyless.core.air.frame import Malformed, Reception
from skyless.core.anchor import Anchor
from skyless.core.keys.authentication import BeaconAuthentication
from skyless.core.keys.fault import Fault
from skyless.core.ticks import SPEED_OF_LIGHT_MPS, from_seconds, wrap
from skyless.core.trusted_receiver import SiteTrust, Trust
from skyless.sim.evaluation.scenarios import Request
from support import keyed_air
from support.adversary import FORGERIES, Adversary, any_forgery

pytestmark = pytest.mark.statistical

KEYS = keyed_air.made_keys(FREE.id, -60.0)
VERIFIED = SiteTrust(FREE.id, KEYS.public, trust=Trust.VERIFIED)
OPEN = replace(VERIFIED, trust=Trust.OPEN)
ATTACK_FROM_S = 0.7
SWITCHED_ON_S = 0.8
SECONDS = 1.8
OPEN_SECONDS = 2.4
"""Fixes of a tag with trust open may come 0.6 s late in an attack."""
AHEAD_S = 0.25
"""How far ahead of the site an accepted frame's interval may be; frames received after it wait for its key."""
REPEATED = ("repeated-at-once", "repeated-soon")
"""The only forgeries of which a tag may accept some: genuine frames that it lost, a little later."""

RIGHT_REASONS = {
    "false-page": {Fault.BAD_CODE},
    "false-measurement": {Fault.BAD_CODE},
    "restarted-counter": {Fault.BAD_CODE},
    "flipped-bits": {Fault.BAD_CODE, Malformed.BAD_FCS},
    "truncated": {Malformed.BAD_LENGTH, Malformed.TOO_SHORT},
    "repeated-at-once": {Fault.REPEATED},
    "repeated-soon": {Fault.REPEATED},
    "repeated-later": {Fault.LATE},
    "false-key": {"forged-key", Fault.EARLY, Fault.LATE, Fault.BAD_CODE},
    "false-interval": {Fault.EARLY, Fault.LATE, Fault.BAD_CODE},
    "false-certificate": {"forged-certificate", Fault.BAD_CODE},
    "disclosed-key": {Fault.LATE},
    "other-name": {Fault.BAD_CODE},
    "no-code": {Fault.NO_CODE},
    "strange-names": {Fault.BAD_CODE},
}


@lru_cache(maxsize=64)
def air_of(forgery=None, rate_hz=477.0, is_noise=False, until_s=SECONDS):
    """What the tag receives, and the anchors, after an attack."""
    attack = None if forgery is None else keyed_air.Attack(forgery, rate_hz, ATTACK_FROM_S, is_noise)
    air = keyed_air.AttackedAir(Request(FREE), KEYS, attack)
    return tuple(air.run(until_s)), air


def genuine_of(tape):
    return [one for one in tape if one.is_genuine]


@pytest.mark.parametrize("name", FORGERIES)
def test_no_forged_frame_moves_a_verified_fix_or_an_anchor(name):
    tape, air = air_of(FORGERIES[name])
    noise, _ = air_of(FORGERIES[name], is_noise=True)
    run, expected = keyed_air.run_tag(tape, VERIFIED), keyed_air.run_tag(noise, VERIFIED)
    found = keyed_air.compare(run, tape, FREE.id)
    in_time = [one for one in expected.given if one.given_s < SECONDS - AHEAD_S]
    assert len(in_time) > 200
    assert (found.moved, found.most_moved_m, found.refused) == (0, 0.0, 0)
    assert found.forged == 0 or name in REPEATED
    assert found.fixes >= 0.9 * len(in_time)
    assert {reason for reason, count in run.counters.items() if count > 10} >= RIGHT_REASONS[name]
    sent = [one.reception for one in genuine_of(tape)]
    assert sent == [one.reception for one in genuine_of(noise)]
    counted = Counter()
    for anchor in air.anchors.values():
        counted.update(anchor.machine.counters)
    assert counted.total() > counted["sent"] + counted["heard"] + 500


@pytest.mark.parametrize("name", [*FORGERIES, "any"])
def test_a_tag_that_is_switched_on_in_an_attack(name):
    """Not even repetitions of frames that it lost disturb its first fixes, before it knows the anchors' counters."""
    forgery = FORGERIES.get(name, any_forgery)
    tape, air = air_of(forgery)
    later = [one for one in tape if one.reception.host_s > SWITCHED_ON_S]
    run = keyed_air.run_tag(later, VERIFIED)
    found = keyed_air.compare(run, later, FREE.id)
    assert found.fixes > 40
    assert run.given[0].given_s < SWITCHED_ON_S + 0.7 + AHEAD_S  # two intervals and the lag
    assert (found.moved, found.forged) == (0, 0)
    sent = {one.frame for one in air.adversary.recent}
    assert {frame for _, frame in run.accepted} <= sent


@pytest.mark.parametrize("rate_hz", [20.0, 477.0])
def test_an_open_tag_is_soon_back(rate_hz):
    """Up to a key, which comes at most 0.6 s later, forged frames count; then few do, or verified ones only."""
    tape, _ = air_of(FORGERIES["false-measurement"], rate_hz, False, OPEN_SECONDS)
    noise, _ = air_of(FORGERIES["false-measurement"], rate_hz, True, OPEN_SECONDS)
    found, expected = (
        keyed_air.errors_m(keyed_air.run_tag(tape, OPEN), tape),
        keyed_air.errors_m(keyed_air.run_tag(noise, OPEN), noise),
    )
    after = found[found[:, 0] > ATTACK_FROM_S + 0.8]
    assert len(after) > 50
    assert after[:, 1].max() < expected[expected[:, 0] > 0.4][:, 1].max() + 0.2


@pytest.mark.parametrize(
    ("name", "rate_hz"), [("false-measurement", 20.0), ("no-code", 20.0), ("false-measurement", 477.0)]
)
def test_forged_frames_cost_an_open_tag_hardly_more_fixes_than_noise(name, rate_hz):
    """A fix may come later than with noise, so those of the last moments are left out: their keys are still to come."""
    fixes = []
    for attack in ((None, 0.0, False), (FORGERIES[name], rate_hz, True), (FORGERIES[name], rate_hz, False)):
        tape, _ = air_of(*attack, OPEN_SECONDS)
        received_s = {keyed_air.key_of(one.reception): one.reception.host_s for one in tape}
        given_s = [received_s[one.key] for one in keyed_air.run_tag(tape, OPEN).given]
        assert given_s == sorted(set(given_s))
        fixes.append(sum(ATTACK_FROM_S < each_s < OPEN_SECONDS - 0.6 for each_s in given_s))
    clean, noise, forged = fixes
    assert clean > 100
    assert clean - forged <= 1.5 * (clean - noise) + 1


@lru_cache(maxsize=1)
def genuine_tape():
    return air_of()[0]


@lru_cache(maxsize=1)
def forged_frames():
    """Forged frames of all kinds, with the time for which each was made, and all genuine ones that were on the air."""
    air = keyed_air.AttackedAir(Request(FREE), KEYS)
    adversary, made, genuine = air.adversary, [], set()
    for one in air.run(SECONDS):
        now_s = one.reception.host_s
        genuine.update(overheard.frame for overheard in adversary.recent)
        for forgery in FORGERIES.values():
            if not adversary.random.randrange(4):
                adversary.now_s = now_s + 1e-4
                made.append((now_s + 1e-4, forgery(adversary)))
    return tuple(made), frozenset(genuine)


def received_at(frame, near: keyed_air.Received, host_s):
    """A frame that a tag receives some time after another one."""
    later = from_seconds(host_s - near.reception.host_s)
    return replace(near, is_genuine=False, reception=Reception(frame, wrap(near.reception.rx_ticks + later), host_s))


@settings(max_examples=int(os.environ.get("SKYLESS_FUZZ_FRAMES", "3000")) // 200, deadline=None)
@given(seed=st.integers(0, 1 << 32), losses=st.integers(0, 100), additions=st.integers(0, 400))
def test_any_mix_gives_the_fixes_of_the_genuine_frames(seed, losses, additions):
    """Some frames are lost for ever; among the others are forged and altered ones, and copies of those received."""
    draw = Random(seed)
    lost = set(draw.sample(range(len(genuine_tape())), losses))
    kept = [one for number, one in enumerate(genuine_tape()) if number not in lost]
    sent = {one.frame for one in air_of()[1].adversary.recent}
    mixed = list(kept)
    for _ in range(additions):
        at = draw.randrange(len(kept))
        host_s = kept[at].reception.host_s + draw.uniform(1e-6, 1e-3)
        frame = kept[draw.randint(0, at)].reception.frame
        match draw.choice(("forged", "copy", "altered")):
            case "forged":
                made = bisect_right(forged_frames()[0], host_s, key=lambda one: one[0])
                forged = forged_frames()[0][draw.randrange(made)][1] if made else b""
                frame = forged if forged not in sent else frame
            case "altered":
                altered = bytearray(frame)
                altered[draw.randrange(len(frame))] ^= draw.randint(1, 255)
                frame = bytes(altered)
        mixed.append(received_at(frame, kept[at], host_s))
    mixed.sort(key=lambda one: one.reception.host_s)
    found = keyed_air.compare(keyed_air.run_tag(mixed, VERIFIED), mixed, FREE.id)
    assert (found.moved, found.forged) == (0, 0)
    assert found.fixes > 100


@settings(max_examples=10, deadline=None)
@given(later_s=st.floats(0.61, 5.0), every=st.integers(1, 7))
def test_frames_that_come_when_their_key_is_known_are_refused(later_s, every):
    tape = genuine_tape()
    chosen = {one.reception.frame for one in tape[::every]}
    mixed = keyed_air.delayed(tape, lambda one: later_s if one.reception.frame in chosen else 0.0)
    run = keyed_air.run_tag([replace(one, is_genuine=one.reception.frame not in chosen) for one in mixed], VERIFIED)
    assert not chosen & {frame for _, frame in run.accepted}
    assert run.counters[Fault.LATE] > 0
    if every > 1:
        assert len(run.given) > 100


def test_a_delay_that_grows_slowly_is_not_found_by_codes():
    """It is what codes cannot show; the protection level or an alert may."""
    tape = genuine_tape()
    slowly = keyed_air.delayed(tape, lambda one: 0.25 * one.reception.host_s / SPEED_OF_LIGHT_MPS)
    run = keyed_air.run_tag(slowly, VERIFIED)
    assert len(run.accepted) > 0.7 * len(tape)
    assert not run.counters


def test_anchors_admit_no_forged_frame():
    """At an anchor, which knows all keys, only repetitions get past the code, and their stamps are impossible.

    Repetitions of frames that the anchor has missed are left out: those are the first that it receives.
    """
    tape = genuine_tape()
    own = FREE.anchors[0].id
    authentication = BeaconAuthentication(KEYS.chains)
    anchor = Anchor(FREE, own, authentication=authentication)
    counters = anchor.counters
    genuine_frames = {one.reception.frame for one in tape}
    all_forged, on_the_air = forged_frames()
    missed = on_the_air - genuine_frames
    forged = iter([(forged_s, made) for forged_s, made in all_forged if made not in missed])
    next_s, frame = next(forged)
    admitted = 0
    for one in tape:
        host_s = one.reception.host_s
        authentication.set_time(one.reception.rx_ticks, keyed_air.START_UNIX_S + host_s)
        anchor.hear(one.reception)
        while next_s is not None and next_s <= host_s:
            heard = counters["heard"]
            anchor.hear(received_at(frame, one, max(next_s, host_s + 1e-6)).reception)
            admitted += counters["heard"] - heard
            assert counters["heard"] == heard or frame in genuine_frames
            next_s, frame = next(forged, (None, b""))
    assert counters["heard"] > 300
    assert admitted == 0
    assert {Fault.BAD_CODE, Fault.LATE, Fault.NO_CODE, "duplicate"} <= counters.keys()


def test_the_attacker_knows_only_what_was_disclosed():
    """Else the attacks would be none: it learns keys from the air alone, each when its lag has passed."""
    tape, air = genuine_tape(), air_of()[1]
    adversary = Adversary(keyed_air.START_UNIX_S, 1, np.zeros(3))
    for one in tape:
        adversary.overhear(one.reception.frame, one.reception.host_s)
        present = adversary.interval_at(one.reception.host_s)
        assert max(adversary.keys, default=0) <= present - adversary.timing.lag
    assert len(adversary.keys) > 10
    assert air.adversary.keys.keys() >= adversary.keys.keys()
    assert all(decode(frame) is not None for _, frame in forged_frames()[0])
