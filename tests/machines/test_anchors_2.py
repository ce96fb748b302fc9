"""Anchors of protocol 2 in the simulated world: slots on a common time, random instants, and what they drop."""

from collections import Counter
from itertools import pairwise

import numpy as np
import pytest
from msgspec.structs import replace

from bench import LAB, Stage
from skyless.air.beacon2 import Beacon2, SlotTime, StatedPosition
from skyless.air.codec2 import decode_2, encode_2
from skyless.air.reception import Diagnostics, Reception
from skyless.anchor import Anchor
from skyless.anchors.factory import new_anchor
from skyless.anchors.free import FreeAnchor
from skyless.anchors.slots import GUARD_S, SlotsAnchor
from skyless.constants import DELAYED_TX_GRANULARITY_TICKS, TICK_RATE_HZ, TICK_S
from skyless.positioning.methods.observations import BLOCKED_DB, CLEAR_DB
from skyless.simulation.impairments import AnchorOutage, Outage
from skyless.site.free_access import free_instant_ticks, free_window_ticks
from skyless.site.model import AnchorSite, ScheduleSite, Site, UnplacedAnchor
from skyless.slot_claims import SILENCE_SUPERFRAMES, SlotRole
from skyless.ticks import Unwrapper, wrap

ALIGNED_S = 50e-9
"""Slots of neighbours differ by less (``docs/protocol2.md``)."""


def site_of(columns, rows, step_m, mode="slots", **schedule) -> Site:
    """Anchors on a grid, in slots of 1 ms; identifiers from 1."""
    count = columns * rows
    if mode == "slots":
        schedule = {"slot_s": 1e-3, "slots": count} | schedule
    anchors = tuple(
        AnchorSite(node + 1, step_m * (node // rows), step_m * (node % rows), 3.0, node if mode == "slots" else None)
        for node in range(count)
    )
    return replace(LAB, anchors=anchors, master=1, schedule=ScheduleSite(mode=mode, **schedule))


def on_air(stage, seconds):
    """Beacons until then, each with its true time in s."""
    found = []
    for broadcast in stage.world.run(seconds):
        beacon = decode_2(broadcast.frame)
        assert isinstance(beacon, Beacon2)
        found.append((broadcast.emission_s, beacon))
    return found


def slot_starts_s(stage, ahead=2):
    """True time at which a superframe soon begins, by each anchor that is on."""
    medium, starts = stage.world.medium, {}
    number = None
    for anchor, machine in stage.machines.items():
        node = medium.node_of[anchor]
        if not medium.stations[node]["on"]:
            continue
        local = medium.read_counter(node)
        if number is None:
            number = machine.slot_time(wrap(local))[1] + ahead
        start = machine.slot_start_ticks(number, 0)
        shown = Unwrapper(last_ticks=start).expect(wrap(local))
        starts[anchor] = medium.foresee(node, local + start - shown) * TICK_S
    return starts


def neighbours(site, reach_m):
    positions = {anchor.id: np.array((anchor.x_m, anchor.y_m)) for anchor in site.anchors}
    return [
        (one, other)
        for one in positions
        for other in positions
        if one < other and np.linalg.norm(positions[one] - positions[other]) <= reach_m
    ]


def test_the_factory_chooses_by_the_mode():
    assert isinstance(new_anchor(LAB, 1), Anchor)
    assert isinstance(new_anchor(site_of(2, 2, 5.0), 1), SlotsAnchor)
    assert isinstance(new_anchor(site_of(2, 2, 5.0, "free"), 1), FreeAnchor)
    with pytest.raises(KeyError):
        new_anchor(site_of(2, 2, 5.0), 99)


@pytest.mark.parametrize("columns, rows, step_m, settled_s", [(7, 1, 4.0, 1.0), (10, 3, 15.0, 4.0)])
def test_slots_of_neighbours_are_aligned(columns, rows, step_m, settled_s):
    """In one cell and over several hops."""
    site = site_of(columns, rows, step_m)
    stage = Stage(site, make=new_anchor)
    on_air(stage, settled_s)
    known = {machine.synchronisation.root for machine in stage.machines.values()}
    assert known == {1}
    for later_s in (0.3, 0.6, 0.9):
        sent = on_air(stage, settled_s + later_s)
        starts = slot_starts_s(stage)
        assert len(starts) == columns * rows
        apart_s = [abs(starts[one] - starts[other]) for one, other in neighbours(site, 1.5 * step_m)]
        assert max(apart_s) < ALIGNED_S
    frames = Counter(beacon.anchor for _, beacon in sent)
    assert len(frames) == columns * rows
    assert max(frames.values()) - min(frames.values()) <= 1
    for _, beacon in sent:
        assert beacon.slot_time.slot == beacon.anchor - 1
        assert beacon.position.x_m == pytest.approx(site.anchors[beacon.anchor - 1].x_m)
        assert beacon.slot_time.pulse_age <= 2 * beacon.slot_time.hop
    if rows > 1:
        assert max(machine.synchronisation.hop for machine in stage.machines.values()) > 2


def test_a_killed_root_is_replaced_and_slots_go_on():
    """No counter jumps, no slot is silent, and the time of the slots is the same."""
    site = site_of(8, 1, 4.0)
    stage = Stage(site, make=new_anchor, anchor_outages=(AnchorOutage(1, Outage(1.0, 2.0)),))
    on_air(stage, 0.999)
    before = slot_starts_s(stage)
    sent = on_air(stage, 1.9)
    after = slot_starts_s(stage)
    states = {anchor: machine.synchronisation for anchor, machine in stage.machines.items() if anchor != 1}
    (root,) = {state.root for state in states.values()}
    assert root != 1
    assert {state.term for state in states.values()} == {1}
    assert states[root].role is SlotRole.ROOT
    superframe_s = 8e-3
    shift_s = np.median(list(after.values())) - np.median(list(before.values()))
    assert abs(shift_s - round(shift_s / superframe_s) * superframe_s) < GUARD_S + 25e-6  # a crystal of 20 ppm for 1 s
    times = {anchor: [time_s for time_s, beacon in sent if beacon.anchor == anchor] for anchor in states}
    for stamps in times.values():
        assert np.diff(stamps) == pytest.approx(superframe_s, abs=2e-6)
    assert max(abs(after[one] - after[other]) for one in after for other in after) < ALIGNED_S
    on_air(stage, 2.5)  # the root of old is back, and follows
    assert stage.machines[1].synchronisation.root == root
    assert all(not machine.counters["phase-change"] for machine in stage.machines.values())


def test_raw_stamps_run_on_at_the_rate_of_the_crystal():
    """Whatever the claims do: TX stamps of each anchor against true time, by its own rate."""
    site = site_of(6, 1, 4.0)
    stage = Stage(site, make=new_anchor, anchor_outages=(AnchorOutage(1, Outage(0.8, 1.2)),))
    sent = on_air(stage, 2.0)
    for anchor in range(2, 7):
        own = [(time_s, beacon.tx_ticks) for time_s, beacon in sent if beacon.anchor == anchor]
        assert len(own) > 300
        unwrap = Unwrapper()
        ticks = np.array([unwrap.unwrap(tx_ticks) for _, tx_ticks in own])
        seconds = np.array([time_s for time_s, _ in own])
        rates = np.diff(ticks) / (np.diff(seconds) * TICK_RATE_HZ) - 1.0
        assert np.ptp(rates) < 2e-7  # 100 ps in 6 ms, 5 σ either way


def test_islands_with_other_phases_merge_after_a_silence():
    """Two anchors lead alone, then receive each other: one changes its phase, after a silence."""
    site = site_of(2, 1, 4.0)
    late = (AnchorOutage(2, Outage(0.0, 0.5)),)
    apart = Stage(site, seed=4, make=new_anchor, anchor_outages=late)
    alone = new_anchor(site, 2)
    taken = alone.next_transmission_ticks(0)
    now = 0
    while taken is None:
        now += round(5e-3 * TICK_RATE_HZ)
        taken = alone.next_transmission_ticks(now)
    assert alone.synchronisation.role is SlotRole.ROOT
    last = first = None
    for broadcast in apart.world.run(0.4):
        beacon = decode_2(broadcast.frame)
        if beacon.anchor != 1:
            continue
        ticks = wrap(now + round(broadcast.end_s * TICK_RATE_HZ))
        frame = alone.transmission(taken) if taken is not None else None
        if frame is not None:
            stated = decode_2(frame.frame).slot_time
            if stated is None or stated.root == 2:
                last = frame.tx_ticks
            elif first is None:
                first = frame.tx_ticks
        alone.hear(Reception(broadcast.frame, wrap(ticks + 12_345)))
        taken = alone.next_transmission_ticks(ticks)
    assert alone.synchronisation.root == 1
    assert alone.counters["phase-change"] == 1
    assert (first - last) * TICK_S >= SILENCE_SUPERFRAMES * 2e-3


@pytest.mark.parametrize("rate_hz", [30.0, 120.0])
def test_free_anchors_send_once_in_each_window(rate_hz):
    site = site_of(3, 2, 6.0, "free", rate_hz=rate_hz)
    stage = Stage(site, make=new_anchor)
    sent = on_air(stage, 1.0)
    window = free_window_ticks(rate_hz)
    for anchor in range(1, 7):
        unwrap = Unwrapper()
        stamps = [unwrap.unwrap(beacon.tx_ticks) for _, beacon in sent if beacon.anchor == anchor]
        assert len(stamps) == pytest.approx(rate_hz, abs=2)
        numbers = [ticks // window for ticks in stamps]
        assert all(later - before == 1 for before, later in pairwise(numbers))
        for number, ticks in zip(numbers, stamps, strict=True):
            late = free_instant_ticks(anchor, number, window) - ticks
            assert 0 <= late < DELAYED_TX_GRANULARITY_TICKS
    for _, beacon in sent:
        assert beacon.slot_time is None
        assert beacon.site_time is None
    relays = [len(beacon.heard) for time_s, beacon in sent if time_s > 0.5]
    assert min(relays) == 5


def test_pages_go_round_and_carry_the_issue():
    stage = Stage(site_of(3, 2, 6.0, "free"), make=new_anchor)
    sent = [beacon for _, beacon in on_air(stage, 0.5)]
    assert len({beacon.almanac_issue for beacon in sent}) == 1
    assert {type(beacon.page).__name__ for beacon in sent} == {"NoisePage", "AccuracyPage", "SitePage"}


def test_an_anchor_without_a_position_keeps_its_slot_and_measures_how_far_others_are():
    """Its range to its parents comes of two-way exchanges, so its slot is aligned as well."""
    site = site_of(6, 1, 12.0)
    placed = tuple(anchor for anchor in site.anchors if anchor.id != 4)
    without = replace(site, anchors=placed, unplaced=(UnplacedAnchor(4, slot=3),))
    stage = Stage(site, make=new_anchor, site_of_anchor={anchor.id: without for anchor in site.anchors})
    sent = on_air(stage, 3.0)
    mine = [beacon for time_s, beacon in sent if beacon.anchor == 4 and time_s > 2.0]
    assert len(mine) > 100
    assert all(beacon.position is None and len(beacon.heard) == 5 for beacon in mine)
    starts = slot_starts_s(stage)
    assert max(abs(starts[4] - start) for start in starts.values()) < ALIGNED_S


def receive(machine, beacon, rx_ticks, diagnostics=None):
    machine.hear(Reception(encode_2(beacon), wrap(rx_ticks), None, diagnostics))


def a_beacon(machine_site, anchor, tx_ticks, sequence=0, **fields):
    plain = Beacon2(machine_site.id, anchor, sequence, wrap(tx_ticks), 0, None, None, None, (), 0, None)
    return replace(plain, **fields)


def test_what_does_not_belong_here_is_counted_and_dropped():
    site = site_of(3, 2, 6.0, "free")
    machine = new_anchor(site, 1)
    receive(machine, a_beacon(replace(site, id=99), 2, 0), 10**6)
    receive(machine, a_beacon(site, 1, 0), 2 * 10**6)
    receive(machine, a_beacon(site, 77, 0), 3 * 10**6)
    receive(machine, a_beacon(site, 2, 0), 4 * 10**6)
    receive(machine, a_beacon(site, 2, 0), 4 * 10**6)
    receive(machine, a_beacon(site, 2, 10**6 + 10**5, sequence=1), 5 * 10**6)
    machine.hear(Reception(b"nothing of ours", 6 * 10**6))
    machine.hear(Reception(next(iter(lab_frames())), 7 * 10**6))
    assert machine.counters == {
        "foreign-site": 1,
        "unknown-anchor": 2,
        "heard": 1,
        "duplicate": 1,
        "impossible-stamp": 1,
        "bad-fcs": 1,
        "other-version": 1,
    }


def lab_frames():
    """Frames of version 1 under the same site identifier."""
    stage = Stage(LAB)
    for broadcast in stage.world.run(0.2):
        yield broadcast.frame


def test_relays_say_which_first_paths_were_weak():
    site = site_of(3, 2, 6.0, "free")
    machine = new_anchor(site, 1)
    middle_db = 0.5 * (CLEAR_DB + BLOCKED_DB)
    for number, (anchor, weaker_db) in enumerate(((2, middle_db + 0.5), (3, middle_db - 0.5), (4, BLOCKED_DB))):
        measured = Diagnostics(-80.0, -80.0 - weaker_db, 0.0)
        receive(machine, a_beacon(site, anchor, 10**9 * number), 10**9 * number + 5 * 10**8, measured)
    tx_ticks = machine.next_transmission_ticks(3 * 10**9)
    beacon = decode_2(machine.transmission(tx_ticks).frame)
    assert [heard.anchor for heard in beacon.heard] == [4, 3, 2]
    assert beacon.weak == 0b101


def test_a_false_master_of_real_anchors_does_not_stop_the_others():
    """2.2 frames a second of an anchor that is received for real, and of one that is off, with the highest term."""
    site = site_of(7, 1, 4.0)
    stage = Stage(site, make=new_anchor, anchor_outages=(AnchorOutage(7, Outage(0.0, 100.0)),))
    sent, forged_s, number = [], 1.0, 0
    medium = stage.world.medium
    for broadcast in stage.world.run(6.0):
        beacon = decode_2(broadcast.frame)
        sent.append((broadcast.emission_s, beacon))
        if broadcast.emission_s < forged_s:
            continue
        forged_s += 1 / 2.2
        number += 1
        for name, stamp in ((2, 12_345 * number), (7, round(forged_s * TICK_RATE_HZ))):
            slot_time = replace(beacon.slot_time, root=name, term=2**32 - 2, hop=0, superframe=number * 7_777)
            false = replace(beacon, anchor=name, tx_ticks=wrap(stamp), slot_time=slot_time, heard=(), weak=0)
            for anchor, machine in stage.machines.items():
                if anchor not in {name, 7}:
                    local = medium.read_counter(medium.node_of[anchor])
                    receive(machine, false, local)
    frames = Counter(beacon.anchor for time_s, beacon in sent if time_s >= 1.0)
    for anchor in range(1, 7):
        assert frames[anchor] >= 0.9 * 5.0 / 7e-3


@pytest.mark.parametrize("late_s", [-1.5e-6, 0.0, 1.5e-6])
def test_a_frame_that_was_due_when_the_timeline_moved_is_sent_with_what_still_holds(late_s):
    """A greater claim within the guard moves the slot by more than site time has bits for: then it is not stated."""
    site = site_of(3, 1, 4.0, site_time=True)
    machine, now, tx_ticks = new_anchor(site, 1), 0, None
    while tx_ticks is None or machine.synchronisation.role is not SlotRole.ROOT:
        now += round(1e-3 * TICK_RATE_HZ)
        tx_ticks = machine.next_transmission_ticks(now)
    superframe = machine.slot_time(now)[1]
    start = machine.slot_start_ticks(superframe, 1)
    late = round(late_s * TICK_RATE_HZ)
    claimed = SlotTime(superframe, 1, 2, 7, 0, 0, 0.0)
    position = StatedPosition(site.anchors[1].x_m, site.anchors[1].y_m, site.anchors[1].z_m)
    for slot_time, ticks in ((None, start - 10**7), (claimed, start)):
        beacon = a_beacon(site, 2, ticks, slot_time=slot_time, position=position, site_time=None)
        receive(machine, beacon, ticks + late)
    assert machine.synchronisation.root == 2
    assert machine.counters["phase-change"] == 0
    sent = decode_2(machine.transmission(tx_ticks).frame)
    assert sent.slot_time.root == 2
    assert (sent.site_time is None) == (late_s != 0.0)
