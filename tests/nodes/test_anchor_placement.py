"""The anchor's program: stamps on request, and positions and delays of a survey without a restart."""

import asyncio
import contextlib
import itertools
import time

import msgspec
import pytest
from msgspec.structs import replace
from node_stage import LAB, FakeRadio, play, receptions

from skyless.air.codec import decode
from skyless.mqtt.messages import PlacementMessage, RequestMessage
from skyless.nodes import process
from skyless.nodes.anchor import AnchorNode
from skyless.nodes.process import SitePublisher
from skyless.radios.interface import Restarted
from skyless.site.digest import site_digest
from skyless.ticks import difference

BEFORE = site_digest(LAB)


def surveyed(ticks=40, x_m=0.25):
    return replace(
        LAB,
        anchors=tuple(
            replace(one, x_m=one.x_m + x_m, tx_antenna_delay_ticks=one.tx_antenna_delay_ticks + ticks)
            for one in LAB.anchors
        ),
    )


@contextlib.asynccontextmanager
async def master():
    """The lab's master, alone, that sends."""
    radio, said = FakeRadio("1"), []
    radio.sends = True
    node = AnchorNode(LAB, 1, radio, said.append)
    task = asyncio.ensure_future(node.run())
    await asyncio.sleep(0)
    node.on_event(Restarted())
    await asyncio.sleep(1.0)
    try:
        yield node, radio, said
    finally:
        task.cancel()
        await asyncio.wait([task])


def corrections(radio, since):
    """What frames state of their TX stamps beyond the radio's."""
    sent = [transmission for _, transmission in radio.transmissions[since:]]
    return {difference(decode(one.frame).tx_ticks, one.tx_ticks) for one in sent}


def test_an_anchor_adopts_a_placement_and_goes_on_in_its_slots():
    async def main():
        async with master() as (node, radio, said):
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
                len({one.almanac_issue for one in later[1:]} - {decode(radio.transmissions[0][1].frame).almanac_issue})
                == 1
            )
            assert "adopted" in said[-1]
            assert not node.place(PlacementMessage(0.0, BEFORE, surveyed()))  # a second time changes nothing
            assert sum("adopted" in line for line in said) == 1

    play(main())


def test_a_radio_that_restarts_keeps_its_delays_and_the_placement():
    async def main():
        async with master() as (node, radio, _):
            node.place(PlacementMessage(0.0, BEFORE, surveyed()))
            node.on_event(Restarted())
            count = len(radio.transmissions)
            await asyncio.sleep(1.0)
            assert len(radio.transmissions) > count + 20
            assert corrections(radio, count) == {40}

    play(main())


def test_the_delay_of_receptions_counts_as_one_of_transmissions():
    async def main():
        async with master() as (node, radio, _):
            first = LAB.anchors[0]
            with_rx = replace(first, rx_antenna_delay_ticks=first.rx_antenna_delay_ticks - 15)
            node.place(PlacementMessage(0.0, BEFORE, replace(LAB, anchors=(with_rx, *LAB.anchors[1:]))))
            count = len(radio.transmissions) + 1
            await asyncio.sleep(0.1)
            assert corrections(radio, count) == {-15}

    play(main())


def test_placements_for_other_sites_are_ignored_and_logged():
    said = []
    node = AnchorNode(LAB, 1, FakeRadio("1"), said.append)
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
    node = AnchorNode(LAB, 1, FakeRadio("1"), lambda _: None)
    assert node.place(PlacementMessage(0.0, site_digest(surveyed()), twice, (BEFORE,)))
    assert node.site == twice
    started_with_the_new_file = AnchorNode(twice, 1, FakeRadio("1"), pytest.fail)
    assert not started_with_the_new_file.place(PlacementMessage(0.0, site_digest(surveyed()), twice, (BEFORE,)))


def test_stamps_are_what_was_received_of_the_sites_anchors():
    node = AnchorNode(LAB, 2, FakeRadio("2"), lambda _: None)
    heard = [one for one in receptions(1.0) if decode(one.frame).anchor != 2]
    node.on_event(heard[0])
    node.on_request("", msgspec.json.encode(RequestMessage("me", (), 10.0, True)))
    node.on_request("", b"nonsense")
    assert node.refused == {"bad-request": 1}
    for one in heard[1:30]:
        node.on_event(one)
    message = node.stamps.collect(time.monotonic(), 7.0)
    expected = [(decode(one.frame).anchor, decode(one.frame).tx_ticks, one.rx_ticks) for one in heard[1:30]]
    assert [(one.anchor, one.tx_ticks, one.rx_ticks) for one in message.stamps] == expected
    run = message.run
    node.stamps.restart("next")
    assert node.stamps.collect(time.monotonic() + 1.0, 8.0).run != run


def test_the_site_is_published_again_after_a_placement():
    published = []

    class FakeLink:
        def publish(self, topic, message, **_):
            published.append((topic, message))

    publisher = SitePublisher(LAB, lambda: True)
    publisher.publish(FakeLink())
    publisher.publish(FakeLink())
    publisher.place(LAB)
    publisher.publish(FakeLink())
    assert len(published) == 1
    publisher.place(surveyed())
    publisher.publish(FakeLink())
    assert [message.site for _, message in published] == [LAB, surveyed()]


def test_the_site_is_published_again_and_again(monkeypatch):
    published, now_s = [], 0.0

    class FakeLink:
        def publish(self, _topic, message, **_):
            published.append((now_s, message))

    monkeypatch.setattr(process.time, "monotonic", lambda: now_s)
    publisher = SitePublisher(LAB, lambda: True)
    for second in range(300):
        now_s = float(second)
        publisher.publish(FakeLink())
    assert len({message.unix_s for _, message in published}) == 1
    times = [moment for moment, _ in published]
    assert all(14 <= later - earlier <= 31 for earlier, later in itertools.pairwise(times))
    assert times[-1] > 265
