"""The anchor's program on a radio that the test plays, in a time that jumps."""

import asyncio
import contextlib
import itertools
import time

import msgspec
import pytest
from msgspec.structs import replace
from node_stage import LAB, LEAD_S, FakeLink, FakeRadio, played, receptions, running_anchor

from skyless.core.protocol1.anchor import SILENT_SUPERFRAMES
from skyless.core.protocol1.beacon import decode, schedule_of
from skyless.core.site import ScheduleSite, site_digest
from skyless.core.ticks import TICK_RATE_HZ, difference, wrap
from skyless.radio.interface import Gone, Late, Restarted, Sent
from skyless.run import anchor, process
from skyless.run import anchor as anchor_node
from skyless.run.mqtt.messages import MAX_LEASE_S, MAX_LEASES, Counters, Leases, PlacementMessage, RequestMessage, Stamp
from skyless.run.process import SitePublisher

SUPERFRAME_S = 6 * 2.5e-3
NONE = Counters(0, 0, 0)
FREE = replace(LAB, schedule=ScheduleSite(mode="free", rate_hz=50.0))
BEFORE = site_digest(LAB)


@contextlib.asynccontextmanager
async def running(anchor=1):
    """An anchor, until it spoke first if it is the master."""
    async with running_anchor(anchor=anchor, sends=False) as (node, radio, logged):
        if anchor == 1:
            await first_words(radio)
        yield node, radio, logged


async def first_words(radio):
    """A master listens first whether there is another."""
    before = len(radio.transmissions)
    for _ in range(2000):
        await asyncio.sleep(1e-3)
        if len(radio.transmissions) > before:
            return
    raise AssertionError("the master never speaks")


@played
async def test_a_master_transmits_once_in_a_superframe_and_hands_over_each_frame_as_late_as_it_may():
    async with running() as (node, radio, said):
        radio.sends = True
        node.on_event(Sent(radio.transmissions[0][1].tx_ticks))
        await asyncio.sleep(20.5 * SUPERFRAME_S)
        stamps = [transmission.tx_ticks for _, transmission in radio.transmissions]
        steps_s = [difference(b, a) / TICK_RATE_HZ for a, b in itertools.pairwise(stamps)]
        assert len(steps_s) == 20
        assert steps_s == [pytest.approx(SUPERFRAME_S, abs=512 / TICK_RATE_HZ)] * len(steps_s)
        for when_s, transmission in radio.transmissions:
            then = wrap(radio.begin_ticks + round((when_s - 1000.0) * TICK_RATE_HZ))
            assert difference(transmission.tx_ticks, then) / TICK_RATE_HZ == pytest.approx(LEAD_S, abs=1e-6)
        numbers = [decode(transmission.frame).superframe for _, transmission in radio.transmissions]
        assert numbers == list(range(numbers[0], numbers[0] + len(numbers)))
        assert node.late == 0
        assert said == ["anchor 1: on the air"]


@played
async def test_a_late_frame_is_skipped_and_counted_and_the_next_slot_is_taken():
    async with running() as (node, radio, _):
        _, first = radio.transmissions[-1]
        node.on_event(Late(first.tx_ticks))
        assert node.late == 1
        await asyncio.sleep(anchor_node.ASK_AGAIN_S + SUPERFRAME_S)
        _, second = radio.transmissions[-1]
        superframes = difference(second.tx_ticks, first.tx_ticks) / TICK_RATE_HZ / SUPERFRAME_S
        assert superframes == pytest.approx(1.0, abs=1e-3)
        assert len(radio.transmissions) == 2
        one, two = decode(first.frame), decode(second.frame)
        assert two.sequence == (one.sequence + 1) & 0xFF


@played
async def test_an_answer_that_never_comes_is_waited_for_and_then_asked_for_again():
    async with running() as (node, radio, _):
        begin_s, first = radio.transmissions[-1]
        await asyncio.sleep(anchor_node.LOST_ANSWER_S - 2e-3)
        assert len(radio.transmissions) == 1
        await asyncio.sleep((1 + SILENT_SUPERFRAMES) * SUPERFRAME_S + 9e-3)  # so long silent, it listens first
        assert len(radio.transmissions) == 2
        when_s, second = radio.transmissions[-1]
        assert when_s - begin_s >= anchor_node.LOST_ANSWER_S
        slots = difference(second.tx_ticks, first.tx_ticks) / TICK_RATE_HZ / SUPERFRAME_S
        assert slots == pytest.approx(round(slots), abs=1e-3)  # still its own slot
        assert node.late == 0


@played
async def test_a_radio_that_starts_again_gets_a_new_machine_and_no_frame_of_the_old_one():
    async with running() as (node, radio, said):
        old = node.machine
        node.on_event(Gone("pulled out"))
        radio.ready = False
        sent = len(radio.transmissions)
        await asyncio.sleep(3.0)
        assert len(radio.transmissions) == sent
        radio.ready, radio.begin_ticks = True, 5
        node.on_event(Restarted())
        assert node.machine is not old
        await first_words(radio)
        _, transmission = radio.transmissions[-1]
        ahead_s = difference(transmission.tx_ticks, radio.now_ticks()) / TICK_RATE_HZ
        assert 0.0 < ahead_s <= LEAD_S + 1e-6
        assert said == [
            "anchor 1: on the air",
            "anchor 1: pulled out; still looking for it",
            "anchor 1: on the air again",
        ]


@played
async def test_an_anchor_that_knows_no_time_does_not_transmit():
    async with running(anchor=4) as (node, radio, _):
        await asyncio.sleep(0.02)
        assert radio.transmissions == []
        radio.ready = False  # nor stumbles over a radio that is not ready
        await asyncio.sleep(0.02)
        assert radio.transmissions == []
        assert node.machine.clock(None).beacons == 0


@played
async def test_who_was_heard_is_noted_but_no_other_site():
    async with running(anchor=4) as (node, _, __):
        for reception in receptions(1.0)[:100]:
            node.on_event(reception)
        assert node.heard_s.keys() <= {1, 2, 3, 4, 5, 6}
        assert {1, 2} <= node.heard_s.keys()


@played
async def test_nothing_goes_on_after_it_was_stopped():
    async with running() as (_, radio, __):
        pass
    sent = len(radio.transmissions)
    await asyncio.sleep(2.0)
    assert len(radio.transmissions) == sent


def test_transmissions_that_were_passed_over_are_missed_too():
    step = schedule_of(LAB).superframe_ticks
    count = anchor_node.TransmissionCount(step)
    assert count.drain() == 0.0
    slots = [0, 1, 2, 5, 6, 7]  # two were passed over
    for before, after in itertools.pairwise(slots):
        count.plan(wrap(2**40 - 3 * step + before * step))
        count.sent += after > 0
    count.plan(wrap(2**40 - 3 * step + slots[-1] * step + 1000))
    assert (count.sent, count.missed) == (5, 2)
    assert count.drain() == 2 / 7
    assert count.drain() == 0.0
    count.plan(None)  # it does not know its slots, as at its start
    count.plan(wrap(100 * step))
    assert count.drain() == 0.0


# Protocol 2


@played
async def test_a_free_anchor_sends_at_once_and_has_no_time_but_its_own():
    async with running_anchor(FREE, seconds=2.0) as (node, radio, _):
        assert len(radio.transmissions) == pytest.approx(98, abs=10)
        health = anchor_node.health_of(node, NONE, 0.0, 0.0)
        assert (health.mode, health.role, health.synchronised) == ("free", "anchor", True)
        assert {health.master, health.term, health.offset_s, health.rate_ppm} == {None}
        assert [anchor_node.leads(node.machine, is_first=first) for first in (True, False)] == [True, False]


# Positions and delays of a survey


def surveyed(ticks=40, x_m=0.25):
    return replace(
        LAB,
        anchors=tuple(
            replace(one, x_m=one.x_m + x_m, tx_antenna_delay_ticks=one.tx_antenna_delay_ticks + ticks)
            for one in LAB.anchors
        ),
    )


def corrections(radio, since):
    """What frames state of their TX stamps beyond the radio's."""
    sent = [transmission for _, transmission in radio.transmissions[since:]]
    return {difference(decode(one.frame).tx_ticks, one.tx_ticks) for one in sent}


@played
async def test_an_anchor_adopts_a_placement_and_goes_on_in_its_slots():
    async with running_anchor(seconds=1.0) as (node, radio, said):
        count, superframe = len(radio.transmissions), decode(radio.transmissions[-1][1].frame).superframe
        assert corrections(radio, 0) == {0}
        assert node.place(PlacementMessage(0.0, BEFORE, surveyed()))
        await asyncio.sleep(0.15)
        assert corrections(radio, count + 1) == {40}
        later = [decode(transmission.frame) for _, transmission in radio.transmissions[count:]]
        assert [one.superframe for one in later] == list(range(superframe + 1, superframe + 1 + len(later)))
        for one in later[1:]:  # the master's time is its own counter, corrected as its stamps are
            assert one.master_time.tx_subticks_master >> 8 == pytest.approx(one.tx_ticks, abs=1)
        assert (
            len({one.almanac_issue for one in later[1:]} - {decode(radio.transmissions[0][1].frame).almanac_issue}) == 1
        )
        assert "adopted" in said[-1]
        assert not node.place(PlacementMessage(0.0, BEFORE, surveyed()))  # a second time changes nothing
        assert sum("adopted" in line for line in said) == 1


@played
async def test_a_radio_that_restarts_keeps_its_delays_and_the_placement():
    async with running_anchor(seconds=1.0) as (node, radio, _):
        node.place(PlacementMessage(0.0, BEFORE, surveyed()))
        node.on_event(Restarted())
        count = len(radio.transmissions)
        await asyncio.sleep(1.0)
        assert len(radio.transmissions) > count + 20
        assert corrections(radio, count) == {40}


@played
async def test_the_delay_of_receptions_counts_as_one_of_transmissions():
    async with running_anchor(seconds=1.0) as (node, radio, _):
        first = LAB.anchors[0]
        with_rx = replace(first, rx_antenna_delay_ticks=first.rx_antenna_delay_ticks - 15)
        node.place(PlacementMessage(0.0, BEFORE, replace(LAB, anchors=(with_rx, *LAB.anchors[1:]))))
        count = len(radio.transmissions) + 1
        await asyncio.sleep(0.1)
        assert corrections(radio, count) == {-15}


def test_placements_for_other_sites_are_ignored_and_logged():
    said = []
    node = anchor_node.AnchorNode(LAB, 1, FakeRadio("1"), said.append)
    assert not node.place(PlacementMessage(0.0, "0123456789abcdef", surveyed()))
    assert not node.place(PlacementMessage(0.0, BEFORE, replace(surveyed(), anchors=surveyed().anchors[1:])))
    far = replace(LAB, anchors=(replace(LAB.anchors[0], x_m=1e9), *LAB.anchors[1:]))
    assert not node.place(PlacementMessage(0.0, BEFORE, far))
    assert node.refused == {"placement-refused": 3}
    assert len(said) == 3
    assert all("ignored" in line for line in said)
    assert node.site is LAB


def test_an_anchor_with_an_older_file_adopts_the_newest_placement():
    twice = surveyed(50, 0.3)
    node = anchor_node.AnchorNode(LAB, 1, FakeRadio("1"), lambda _: None)
    assert node.place(PlacementMessage(0.0, site_digest(surveyed()), twice, (BEFORE,)))
    assert node.site == twice
    started_with_the_new_file = anchor_node.AnchorNode(twice, 1, FakeRadio("1"), pytest.fail)
    assert not started_with_the_new_file.place(PlacementMessage(0.0, site_digest(surveyed()), twice, (BEFORE,)))


def test_stamps_are_what_was_received_of_the_sites_anchors():
    node = anchor_node.AnchorNode(LAB, 2, FakeRadio("2"), lambda _: None)
    heard = [one for one in receptions(1.0) if decode(one.frame).anchor != 2]
    node.on_event(heard[0])
    node.on_request(RequestMessage("me", (), 10.0, True))
    for one in heard[1:30]:
        node.on_event(one)
    message = node.stamps.collect(time.monotonic(), 7.0)
    expected = [(decode(one.frame).anchor, decode(one.frame).tx_ticks, one.rx_ticks) for one in heard[1:30]]
    assert [(one.anchor, one.tx_ticks, one.rx_ticks) for one in message.stamps] == expected


def test_messages_that_cannot_be_read_are_counted(monkeypatch, links):
    monkeypatch.setattr(anchor, "link_of", FakeLink)
    (node,) = anchor.Anchors(LAB, [FakeRadio("1")], None, print, simulated=lambda: True).nodes
    for handler in links[0].handlers.values():
        handler("", b"nonsense")
        handler("", b"")  # withdrawn
    assert node.refused == {"bad-request": 1, "bad-placement": 1}


def test_the_site_is_published_after_a_placement_and_again_and_again(monkeypatch):
    link, now_s = FakeLink(), 0.0
    monkeypatch.setattr(process.time, "monotonic", lambda: now_s)
    publisher = SitePublisher(LAB, lambda: True)
    for placed, sites in ((LAB, [LAB]), (surveyed(), [LAB, surveyed()])):
        publisher.place(placed)
        publisher.publish(link)
        publisher.publish(link)
        assert [message.site for _, message, _ in link.published] == sites
    times = []
    for second in range(300):
        now_s, before = float(second), len(link.published)
        publisher.publish(link)
        times += [now_s] * (len(link.published) - before)
    assert len({message.unix_s for _, message, _ in link.published[1:]}) == 1
    assert all(14 <= later - earlier <= 31 for earlier, later in itertools.pairwise([0.0, *times]))
    assert times[-1] > 265


# Stamps


def request(by, lease_s=10.0, stamps=True):
    return RequestMessage(by, (), lease_s, stamps)


@pytest.fixture
def log():
    """Of an anchor that is asked at 100 s, for 10 s."""
    log = anchor_node.StampLog(2, "a")
    log.request(request("me"), 100.0)
    return log


def test_nothing_is_kept_until_somebody_asks():
    log = anchor_node.StampLog(2, "a")
    log.add(1, 10, 20)
    assert log.collect(100.0, 0.0) is None
    log.request(request("me"), 100.0)
    log.add(1, 11, 21)
    log.add(3, 12, 22, 0.2500153)
    log.add(3, 13, 23, 0.99998)
    message = log.collect(100.1, 5.0)
    assert (message.anchor, message.run, message.unix_s, message.missed) == (2, "a", 5.0, 0)
    assert message.stamps == (Stamp(1, 11, 21), Stamp(3, 12, 22, 0.25), Stamp(3, 13, 23, 0.0))
    assert msgspec.json.decode(b"[1, 11, 21]", type=Stamp) == Stamp(1, 11, 21), "as earlier versions publish it"


def test_messages_come_at_an_interval_also_when_nobody_is_received(log):
    assert log.collect(100.0, 0.0).stamps == ()
    assert log.collect(100.0 + 0.9 * anchor_node.STAMPS_INTERVAL_S, 0.0) is None
    log.add(1, 10, 20)
    assert log.collect(100.0 + anchor_node.STAMPS_INTERVAL_S, 0.0).stamps == (Stamp(1, 10, 20),)


def test_what_is_not_collected_takes_no_memory_and_is_counted(log):
    for number in range(anchor_node.MAX_PENDING_STAMPS + 7):
        log.add(1, number, number)
    message = log.collect(101.0, 0.0)
    assert len(message.stamps) == anchor_node.MAX_PENDING_STAMPS
    assert message.missed == 7
    assert message.stamps[0].tx_ticks == 7
    log.add(1, 1, 1)
    assert log.collect(102.0, 0.0).missed == 0


def test_a_lease_ends_by_its_time_or_by_a_request_without_stamps(log):
    log.request(request("other", 1e9), 100.0)
    log.request(request("other", stamps=False), 101.0)
    log.add(1, 1, 1)
    assert log.collect(110.0, 0.0) is None
    log.add(1, 1, 1)
    log.request(request("me"), 120.0)
    assert log.collect(120.0, 0.0).stamps == ()  # nothing of before


def test_a_counter_that_restarts_begins_another_run(log):
    log.add(1, 1, 1)
    log.restart("b")
    log.add(1, 2, 2)
    message = log.collect(100.5, 0.0)
    assert (message.run, message.stamps) == ("b", (Stamp(1, 2, 2),))


def test_leases_are_bounded_in_number_and_length():
    leases = Leases()
    assert all(leases.grant(str(number), 1e9, 0.0) for number in range(MAX_LEASES))
    assert not leases.grant("one more", 1.0, 0.0)
    assert leases.grant("0", 1.0, 0.0)  # who has one may extend it
    leases.expire(MAX_LEASE_S)
    assert not leases.are_held
    assert leases.grant("one more", 1.0, MAX_LEASE_S)
