"""Sites whose anchors relay phases of the carrier: what tags make of them, and of beacons without them beside."""

from itertools import chain

import numpy as np
import pytest
from free_site import FREE, beacon_of
from msgspec import UNSET
from msgspec.structs import replace

from skyless.core.air.beacon import decode
from skyless.core.air.frame import Reception
from skyless.core.any_anchor import new_anchor
from skyless.core.any_receiver import AnyReceiver
from skyless.core.ticks import wrap
from skyless.core.trusted_receiver import SiteTrust, Trust
from skyless.run.masterless.smoothing import OwnReceiver
from skyless.sim.evaluation.scenarios import Request
from skyless.sim.impairments import CarrierModel
from skyless.site.survey.legs import RelayedDifferences
from support.bench import Stage
from support.frames import with_fcs
from support.keyed_air import AttackedAir, made_keys, run_tag

pytestmark = pytest.mark.site


def site_of(*, carrier_phase, rate_hz=60.0):
    return replace(FREE, schedule=replace(FREE.schedule, carrier_phase=carrier_phase, rate_hz=rate_hz))


def receptions_of(site, seconds, carrier=None, seed=1, site_of_anchor=None):
    """What a tag in the lab receives, with its phases, of anchors with phases or without."""
    stage = Stage(site, seed, ((3.0, 4.0, 0.0),), site_of_anchor, carrier=carrier)
    return [one for broadcast in stage.world.run(seconds) for _, one, _ in broadcast.receptions()]


def tag_of(receptions):
    """A tag that has heard them, and all that its fixes hold."""
    tag, fixes = AnyReceiver(), []
    for one in receptions:
        fix = tag.hear(one)
        if fix is not None:
            fixes.append((fix.time_s, fix.rows, fix.anchors))
    return tag, fixes


def status_of(tag):
    return tag.receiver.method.estimator.state.status


@pytest.mark.parametrize("rate_hz", [1.5, 60.0])
def test_short_stamps_are_worth_as_much_as_whole_ones(rate_hz):
    """Without a phase in them, beacons of both kinds give the same fixes; at 1.5 Hz stamps are old by many wraps."""
    seconds = 3.0 if rate_hz > 10.0 else 20.0
    (whole, _), (short, _) = pair = [
        (receptions_of(site_of(carrier_phase=phase, rate_hz=rate_hz), seconds), phase) for phase in (UNSET, True)
    ]
    assert all(decode(one.frame).has_phases is (phase is True) for receptions, phase in pair for one in receptions)
    assert [len(one.frame) for one in whole] == [len(one.frame) for one in short]
    (_, expected), (_, found) = tag_of(whole), tag_of(short)
    assert found == expected
    assert len(found) > 30


def test_relayed_phases_are_used_and_the_same_relays_as_without():
    site, carrier = site_of(carrier_phase=True), CarrierModel()
    alone, _ = tag_of(receptions_of(site_of(carrier_phase=False), 5.0, carrier))
    tag, fixes = tag_of(receptions_of(site, 5.0, carrier))
    own, both = status_of(alone), status_of(tag)
    assert both.phases_used > 1.5 * own.phases_used
    assert both.phases_refused < 0.01 * both.phases_used
    assert both.relays_lately_accepted == pytest.approx(own.relays_lately_accepted, rel=0.01)
    assert tag.counters == alone.counters
    assert np.linalg.norm(np.frombuffer(fixes[-1][1])[:3] - (3.0, 4.0, 0.0)) < 0.02


def test_anchors_of_old_and_new_program_share_a_site():
    """Anchors 1 to 3 have a site file without the key; everybody understands everybody."""
    old = dict.fromkeys((1, 2, 3), site_of(carrier_phase=UNSET))
    receptions = receptions_of(site_of(carrier_phase=True), 3.0, CarrierModel(), site_of_anchor=old)
    assert {(beacon.anchor, beacon.has_phases) for beacon in map(beacon_of, receptions)} == {
        (anchor.id, anchor.id not in old) for anchor in FREE.anchors
    }
    tag, fixes = tag_of(receptions)
    assert set(tag.counters) == {"heard", "fixes"}
    assert len(fixes) > 300
    own, _ = tag_of(receptions_of(site_of(carrier_phase=UNSET), 3.0, CarrierModel()))
    assert status_of(tag).phases_used > 1.1 * status_of(own).phases_used


@pytest.mark.parametrize("phase_cycles", [None, -0.25, 1.0, float("nan"), float("inf"), 0.123])
def test_an_anchor_relays_the_phase_that_its_radio_measured(phase_cycles):
    """Whatever a radio reports, the frame can be sent; only what is a phase is relayed, in the nearest of 128 steps."""
    site = site_of(carrier_phase=True)
    sender, listener = new_anchor(site, 1), new_anchor(site, 2)
    frame = sender.transmission(sender.next_transmission_ticks(0)).frame
    listener.hear(Reception(frame, 0xAB_1234_5678, 0.1, None, phase_cycles))
    made = decode(listener.transmission(listener.next_transmission_ticks(wrap(0xAB_1234_5678 + 1000))).frame)
    (entry,) = made.heard
    assert (entry.anchor, entry.rx_ticks, entry.is_short) == (1, 0x1234_5678, True)
    assert entry.phase_cycles == (16 / 128 if phase_cycles == 0.123 else None)


def test_keys_protect_beacons_with_phases_as_others():
    """Frames with a certificate have none; all others are verified, as at a site without."""
    found = []
    for phase in (UNSET, True):
        site = site_of(carrier_phase=phase)
        keys = made_keys(site.id, -60.0)
        received = tuple(AttackedAir(Request(site), keys, None).run(1.2))
        beacons = [decode(one.reception.frame) for one in received]
        assert {one.has_phases for one in beacons if one.certificate is None} == {phase is True}
        assert {one.has_phases for one in beacons if one.certificate is not None} == {False}
        run = run_tag(received, SiteTrust(site.id, keys.public, trust=Trust.VERIFIED))
        found.append([(one.given_s, one.fix.rows) for one in run.given])
    assert found[0] == found[1]
    assert len(found[0]) > 100


def test_surveys_and_estimators_of_ones_own_find_the_same_in_both():
    class Kept(list):
        def hear(self, observation):
            self.append(observation)

    found = []
    for phase in (False, True):
        site = site_of(carrier_phase=phase, rate_hz=20.0)
        receptions = receptions_of(site, 3.0)
        differences, kept = RelayedDifferences(site.id), Kept()
        own = OwnReceiver(kept, site)
        found.append([list(chain.from_iterable(map(differences.add, receptions))), kept])
        for one in receptions:
            own.hear(one)
    assert found[0] == found[1]
    assert min(map(len, found[0])) > 100


def test_a_hostile_channel():
    """Damaged relays, phases and flags with a right check sequence are used or dropped and counted; nothing raises."""
    site, draw = site_of(carrier_phase=True), np.random.default_rng(5)
    tag, anchor = AnyReceiver(), new_anchor(site, 4)
    receptions = receptions_of(site, 3.0, CarrierModel())
    for one in receptions:
        body = bytearray(one.frame[:-2])
        if draw.random() < 0.5:
            body[draw.choice([11, *range(34, len(body))])] = draw.integers(256)
        for hearer in (tag, anchor):
            hearer.hear(replace(one, frame=with_fcs(body)))
        anchor.transmission(anchor.next_transmission_ticks(one.rx_ticks))
    assert tag.counters["bad-flags"] > 0
    assert tag.counters["fixes"] > 0.7 * len(receptions)
