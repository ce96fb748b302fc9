"""Rotation, revocation, wrong seeds and wrong clocks at a simulated site: what is reported, and who goes on."""

from collections import Counter
from functools import lru_cache

import numpy as np
import pytest
from free_site import FREE
from msgspec.structs import replace

from skyless.core.keys.chain import Chain
from skyless.core.keys.fault import Fault
from skyless.core.tag.receiver import Receiver
from skyless.core.ticks import from_seconds, wrap
from skyless.core.trusted_receiver import SiteTrust, Trust, TrustedReceiver
from skyless.sim.evaluation.scenarios import Request, impairments_of
from skyless.sim.listening import TagSpec
from skyless.sim.trajectory import Static
from skyless.sim.world import World
from support.keyed_air import START_UNIX_S, anchors_with_keys, made_keys

pytestmark = pytest.mark.site

TRUTH_M = np.array((3.0, 4.0, 0.0))
KEYS = made_keys(FREE.id, 0.0)
ROTATED = made_keys(FREE.id, 0.0, 1.5)
"""A second chain counts from 1.5 s on."""


def on_air(keys, seconds, *, others=None, errors_s=None, seed=1):
    """All that one tag receives of a site with keys, and the anchors' machines."""
    machines = {}

    def new(anchor):
        machines[anchor] = make(anchor)
        return machines[anchor]

    world = World(FREE, new, [TagSpec(Static(*TRUTH_M))], impairments_of(Request(FREE), FREE), seed)
    make = anchors_with_keys(FREE, lambda: world.now_s, keys.chains, others=others or {}, errors_s=errors_s or {})
    received = [reception for broadcast in world.run(seconds) for _, reception, _ in broadcast.receptions()]
    return received, {anchor: one.machine for anchor, one in machines.items()}


@lru_cache(maxsize=4)
def usual_tape(seconds=3.0):
    return tuple(on_air(KEYS, seconds)[0])


def tag(public, trust=Trust.VERIFIED, **fields):
    return TrustedReceiver(SiteTrust(FREE.id, public, trust=trust, **fields), lambda: Receiver(site=FREE.id))


def fixes_of(receiver, received, error_s=0.0):
    """Fixes, with the time at which each was given, of a tag whose clock is ahead by an error."""
    given = []
    for reception in received:
        heard = receiver.hear(reception, START_UNIX_S + reception.host_s + error_s)
        given += [(reception.host_s, one) for one in heard]
    return given


def errors_m(given):
    return np.array([np.linalg.norm((one.fix.position_m - TRUTH_M)[:2]) for _, one in given])


def longest_gap_s(given):
    return np.diff([one.reception.host_s for _, one in given]).max()


def test_verified_fixes_are_those_of_a_plain_tag():
    received = usual_tape()
    plain, receiver = Receiver(site=FREE.id), tag(KEYS.public)
    expected = [fix for reception in received if (fix := plain.hear(reception)) is not None]
    given = fixes_of(receiver, received)
    assert len(given) > 600
    for (_, one), fix in zip(given, expected, strict=False):
        assert one.fix.rows == fix.rows
        assert (one.fix.verified_until_s, one.fix.unverified) == (fix.time_s, 0.0)
    assert not receiver.counters
    assert receiver.faults() == {}
    assert receiver.is_verified


def test_an_open_tag_gives_each_fix_at_once_and_states_how_far_it_is_verified():
    received = usual_tape()
    plain, receiver = Receiver(site=FREE.id), tag(KEYS.public, Trust.OPEN)
    expected = [fix for reception in received if (fix := plain.hear(reception)) is not None]
    given = fixes_of(receiver, received)
    assert [one.fix.rows for _, one in given] == [fix.rows for fix in expected]
    assert all(at_s == one.reception.host_s for at_s, one in given)
    unverified = [one.fix for at_s, one in given if at_s < 0.3]
    assert {(fix.verified_until_s, fix.unverified) for fix in unverified} == {(None, 1.0)}
    later = [one.fix for at_s, one in given if at_s > 1.5]
    assert all(0.4 <= fix.time_s - fix.verified_until_s < 0.6 for fix in later)  # (lag - 1) intervals and more
    assert all(0.3 < fix.unverified < 0.7 for fix in later)


@pytest.mark.parametrize("certificates", [False, True])
def test_first_verified_fix(certificates):
    before = tag(KEYS.public)
    received = usual_tape()
    fixes_of(before, received)
    known = before.verifier.keys.certificates if certificates else ()
    after = TrustedReceiver(
        SiteTrust(FREE.id, KEYS.public, trust=Trust.VERIFIED), lambda: Receiver(site=FREE.id), known
    )
    first_s = fixes_of(after, received)[0][0] - received[0].host_s
    assert first_s < (1.0 if certificates else 3.0)


def test_a_new_chain_takes_over_without_a_gap():
    received, machines = on_air(ROTATED, 3.0)
    receiver = tag(ROTATED.public)
    given = fixes_of(receiver, received)
    plain = Receiver(site=FREE.id)
    expected = [reception.host_s for reception in received if plain.hear(reception) is not None]
    assert [one.reception.host_s for _, one in given] == expected[: len(given)]
    assert given[-1][1].reception.host_s > 2.35
    assert not receiver.counters
    assert receiver.verifier.keys.serial == 2
    for machine in machines.values():
        assert not Counter({name: machine.counters[name] for name in Fault}).total()


@pytest.mark.parametrize(
    ("keys", "own", "seconds", "from_s", "fault"),
    [
        (KEYS, made_keys(FREE.id, 0.0, number=2).chains, 3.0, 1.0, Fault.BAD_CODE),
        (KEYS, (), 3.0, 0.0, Fault.NO_CODE),
        (ROTATED, ROTATED.chains[:1], 4.0, 3.0, Fault.REVOKED_CHAIN),
    ],
    ids=["wrong seed", "no keys", "revoked chain"],
)
def test_an_anchor_with_wrong_keys_is_named_and_left_out(keys, own, seconds, from_s, fault):
    received, machines = on_air(keys, seconds, others={4: own})
    for trust in Trust:
        receiver = tag(keys.public, trust)
        given = fixes_of(receiver, received)
        assert receiver.faults() == {4: fault}
        late = [one for at_s, one in given if at_s > from_s + 0.6 and one.reception.host_s > from_s]
        assert all(4 not in one.fix.anchors for one in late)
        assert len(late) > 100
        assert errors_m(given).max() < 0.2
        assert longest_gap_s(given) < 0.1
    faults = {
        anchor: {other: why for other, (why, _) in m.authentication.faults.items()} for anchor, m in machines.items()
    }
    assert all(faults[anchor] == {4: fault} for anchor in machines if anchor != 4)
    assert faults[4] == (dict.fromkeys(set(machines) - {4}, Fault.BAD_CODE) if own else {})
    assert machines[4].authentication.fault() is (None if own else Fault.NO_CHAIN)


def test_a_stolen_chain_does_not_count_for_who_knows_that_it_was_revoked():
    stolen = Chain(
        FREE.id, 1, *(getattr(ROTATED.chains[0], name) for name in ("timing", "first", "signatures", "seed"))
    )
    received, _ = on_air(replace(ROTATED, chains=(stolen,)), 2.0)
    assert fixes_of(tag(ROTATED.public), received)
    informed = tag(ROTATED.public, least_serial=2)
    assert not fixes_of(informed, received)
    assert set(informed.faults().values()) == {Fault.REVOKED_CHAIN}


def test_all_anchors_lose_power_and_go_on():
    """Everything is lost but the seed and the host's clock: the chain needs no other state."""
    receiver, off_s = tag(KEYS.public), 6.5
    before, _ = on_air(KEYS, 1.5)
    again, _ = on_air(KEYS, 1.5, errors_s=dict.fromkeys(range(1, 8), off_s), seed=2)
    ticks_off = before[-1].rx_ticks + from_seconds(again[0].host_s + off_s - before[-1].host_s) - again[0].rx_ticks
    after = [replace(one, host_s=one.host_s + off_s, rx_ticks=wrap(one.rx_ticks + ticks_off)) for one in again]
    assert fixes_of(receiver, before)
    given = fixes_of(receiver, after)
    assert given[0][0] - after[0].host_s < 1.0
    assert errors_m(given).max() < 0.3
    assert not {Fault.BAD_CODE, Fault.LATE, Fault.EARLY} & receiver.counters.keys()
    assert receiver.verifier.clock.error_s is None


@pytest.mark.parametrize("sign", [-1, 1])
@pytest.mark.parametrize("size_s", [0.0, 0.05, 0.09, 0.15, 0.4, 30.0, 3600.0, 86400.0])
def test_a_tag_with_a_wrong_clock_notices_and_one_within_its_bound_costs_nothing(size_s, sign):
    receiver = tag(KEYS.public)
    given = fixes_of(receiver, usual_tape(), sign * size_s)
    if size_s < 0.1:
        assert receiver.verifier.clock.error_s is None
        assert len(given) > 600
        assert not receiver.counters
        return
    tolerance_s = 0.05 if size_s < 1000.0 else 900.0
    assert receiver.verifier.clock.error_s == pytest.approx(sign * size_s, abs=tolerance_s)
    if size_s > 0.3:  # up to the bound and an anchor's lead, 0.25 s, an anchor that is ahead would look the same
        assert not given


@pytest.mark.parametrize("error_s", [-7200.0, 7200.0])
def test_a_host_clock_that_is_set_while_the_tag_is_on(error_s):
    """Set back it does no harm; ahead it counts, as the tag may have been suspended, and only stops fixes."""
    receiver, given = tag(KEYS.public), []
    for reception in usual_tape():
        jump_s = 0.0 if reception.host_s < 1.0 else error_s
        given += receiver.hear(reception, START_UNIX_S + reception.host_s + jump_s)
    last_s = given[-1].reception.host_s
    assert last_s < 1.0 if error_s > 0.0 else last_s > 2.4
    assert errors_m([(0.0, one) for one in given]).max() < 0.2
    if error_s < 0.0:
        assert not receiver.counters
        assert receiver.verifier.clock.error_s == pytest.approx(error_s, abs=0.1)
    else:
        assert receiver.verifier.clock.error_s == pytest.approx(error_s, abs=1.0)


@pytest.mark.parametrize("error_s", [-3.0, -0.2, 0.2, 3.0])
def test_an_anchor_with_a_wrong_clock_sends_without_codes(error_s):
    received, machines = on_air(KEYS, 4.0, errors_s={4: error_s})
    assert machines[4].authentication.fault() is Fault.CLOCK_WRONG
    assert all(machine.authentication.fault() is None for anchor, machine in machines.items() if anchor != 4)
    receiver = tag(KEYS.public)
    given = fixes_of(receiver, received)
    late = [one for _, one in given if one.reception.host_s > 2.5]
    assert len(late) > 200
    assert all(4 not in one.fix.anchors for one in late)
    assert receiver.faults() == {4: Fault.NO_CODE}
    assert errors_m(given).max() < 0.2
