"""Anchors of protocol 2 in the simulated world: when they send, what they relay, and what they drop."""

from itertools import pairwise

import numpy as np
import pytest
from msgspec.structs import replace

from skyless.core.air.almanac import OFFERED_HZ, gap_ticks, period_code, period_ticks, suitable_period_s
from skyless.core.air.beacon import Beacon, decode, encode
from skyless.core.air.frame import BLOCKED_DB, CLEAR_DB, Diagnostics, Reception
from skyless.core.anchor import Anchor
from skyless.core.any_anchor import new_anchor
from skyless.core.protocol1.anchor import Anchor as Protocol1Anchor
from skyless.core.site import AnchorSite, ScheduleSite, Site, UnplacedAnchor
from skyless.core.ticks import difference, from_seconds, to_seconds, wrap
from skyless.sim.impairments import AnchorOutage, Outage
from support.bench import LAB, Stage, tape

pytestmark = pytest.mark.site


def site_of(columns, rows, step_m, **schedule) -> Site:
    """Anchors on a grid; identifiers from 1."""
    anchors = tuple(
        AnchorSite(node + 1, step_m * (node // rows), step_m * (node % rows), 3.0) for node in range(columns * rows)
    )
    return replace(LAB, anchors=anchors, master=1, schedule=ScheduleSite(mode="free", **schedule))


def on_air(stage, seconds):
    """Beacons until then, each with its true time in s."""
    return [(broadcast.emission_s, decode(broadcast.frame)) for broadcast in stage.world.run(seconds)]


def test_the_site_decides_which_machine_its_anchors_have():
    assert isinstance(new_anchor(LAB, 1), Protocol1Anchor)
    assert isinstance(new_anchor(site_of(2, 2, 5.0), 1), Anchor)
    for site in (LAB, site_of(2, 2, 5.0)):
        with pytest.raises(KeyError):
            new_anchor(site, 99)


@pytest.mark.parametrize("rate_hz", [30.0, 120.0])
def test_anchors_send_at_the_rate_of_the_site_file_at_instants_that_anybody_can_predict(rate_hz):
    sent = on_air(Stage(site_of(3, 2, 6.0, rate_hz=rate_hz), make=new_anchor), 3.0)
    assert len({beacon.almanac_issue for _, beacon in sent}) == 1
    assert {type(beacon.page).__name__ for _, beacon in sent} == {"NoisePage", "AccuracyPage", "SitePage"}
    code = period_code(1.0 / rate_hz)
    for anchor in range(1, 7):
        own = [beacon for _, beacon in sent if beacon.anchor == anchor]
        mean_hz = 1.0 / to_seconds(period_ticks(code))
        assert len(own) == pytest.approx(3.0 * mean_hz, abs=6.0 * np.sqrt(3.0 * mean_hz / 12.0))
        for before, later in pairwise(own):
            assert before.period_code == code
            assert later.sequence == (before.sequence + 1) % 256
            assert difference(later.tx_ticks, before.tx_ticks) == gap_ticks(anchor, before.sequence, code)
    assert min(len(beacon.heard) for time_s, beacon in sent if time_s > 0.5) == 5


def ticks_ahead(beacon, beacons):
    """From this beacon of an anchor to the one that is ``beacons`` later."""
    return sum(gap_ticks(beacon.anchor, beacon.sequence + number, beacon.period_code) for number in range(beacons))


def test_a_beacon_that_is_not_sent_has_a_sequence_number_all_the_same():
    machine = new_anchor(site_of(3, 2, 6.0), 1)
    first = decode(machine.transmission(machine.next_transmission_ticks(0)).frame)
    late_ticks = from_seconds(0.5)
    later = decode(machine.transmission(machine.next_transmission_ticks(late_ticks)).frame)
    passed = (later.sequence - first.sequence) % 256
    assert passed > 20
    assert later.tx_ticks == first.tx_ticks + ticks_ahead(first, passed)
    assert later.tx_ticks > late_ticks


@pytest.mark.parametrize(("columns", "rows", "step_m"), [(2, 2, 5.0), (6, 5, 6.0)])
def test_the_rate_follows_from_how_many_anchors_are_received(columns, rows, step_m):
    count = columns * rows
    stage = Stage(site_of(columns, rows, step_m), make=new_anchor)
    sent = [beacon for time_s, beacon in on_air(stage, 4.0) if time_s > 3.0]
    period_s = suitable_period_s(count, None)
    assert len(sent) == pytest.approx(count / period_s, rel=0.15)
    assert len(sent) < 1.15 * OFFERED_HZ


def test_anchors_that_fall_silent_make_the_others_send_more_often():
    silent = tuple(AnchorOutage(anchor, Outage(3.0, 100.0)) for anchor in range(7, 31))
    sent = on_air(Stage(site_of(6, 5, 6.0), make=new_anchor, anchor_outages=silent), 8.0)
    codes = {beacon.anchor: beacon.period_code for _, beacon in sent}
    assert [codes[anchor] for anchor in range(1, 7)] == [period_code(suitable_period_s(6, None))] * 6
    assert codes[8] == pytest.approx(period_code(suitable_period_s(30, None)), abs=1)


def test_an_anchor_without_a_position_relays_all_the_same():
    site = site_of(6, 1, 12.0)
    placed = tuple(anchor for anchor in site.anchors if anchor.id != 4)
    without = replace(site, anchors=placed, unplaced=(UnplacedAnchor(4),))
    stage = Stage(site, make=new_anchor, site_of_anchor={anchor.id: without for anchor in site.anchors})
    mine = [beacon for time_s, beacon in on_air(stage, 1.0) if beacon.anchor == 4 and time_s > 0.5]
    assert len(mine) > 20
    assert all(beacon.position is None and len(beacon.heard) == 5 for beacon in mine)


def receive(machine, beacon, rx_ticks, diagnostics=None):
    machine.hear(Reception(encode(beacon), wrap(rx_ticks), None, diagnostics))


def a_beacon(machine_site, anchor, tx_ticks, sequence=0, **fields):
    plain = Beacon(machine_site.id, anchor, sequence, wrap(tx_ticks), 0, 0x20, None, (), 0, None)
    return replace(plain, **fields)


def test_what_does_not_belong_here_is_counted_and_dropped():
    site = site_of(3, 2, 6.0)
    machine = new_anchor(site, 1)
    receive(machine, a_beacon(replace(site, id=99), 2, 0), 10**6)
    receive(machine, a_beacon(site, 1, 0), 2 * 10**6)
    receive(machine, a_beacon(site, 77, 0), 3 * 10**6)
    receive(machine, a_beacon(site, 2, 0), 4 * 10**6)
    receive(machine, a_beacon(site, 2, 0), 4 * 10**6)
    receive(machine, a_beacon(site, 2, 10**6 + 10**5, sequence=1), 5 * 10**6)
    machine.hear(Reception(b"nothing of ours", 6 * 10**6))
    machine.hear(Reception(tape(LAB, 0.2)[0].frame, 7 * 10**6))  # of version 1, under the same identifier of the site
    assert machine.counters == {
        "foreign-site": 1,
        "unknown-anchor": 2,
        "heard": 1,
        "duplicate": 1,
        "impossible-stamp": 1,
        "bad-fcs": 1,
        "unknown-version": 1,
    }


def test_relays_say_which_first_paths_were_weak():
    site = site_of(3, 2, 6.0)
    machine = new_anchor(site, 1)
    middle_db = 0.5 * (CLEAR_DB + BLOCKED_DB)
    for number, (anchor, weaker_db) in enumerate(((2, middle_db + 0.5), (3, middle_db - 0.5), (4, BLOCKED_DB))):
        measured = Diagnostics(-80.0, -80.0 - weaker_db, 0.0)
        receive(machine, a_beacon(site, anchor, 10**9 * number), 10**9 * number + 5 * 10**8, measured)
    tx_ticks = machine.next_transmission_ticks(3 * 10**9)
    beacon = decode(machine.transmission(tx_ticks).frame)
    assert [heard.anchor for heard in beacon.heard] == [4, 3, 2]
    assert beacon.weak == 0b101
