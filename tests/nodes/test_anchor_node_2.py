"""The anchor's program at sites of protocol 2: frames without a master, and the health that it publishes."""

import asyncio
import itertools

import pytest
from msgspec.structs import replace
from node_stage import LAB, FakeRadio, play

from skyless.air.beacon2 import Beacon2
from skyless.air.codec2 import decode_2
from skyless.constants import TICK_RATE_HZ
from skyless.mqtt.messages import Counters
from skyless.nodes.anchor import AnchorNode, health_of, leads
from skyless.radios.interface import Restarted
from skyless.site.model import ScheduleSite
from skyless.ticks import difference

NONE = Counters(0, 0, 0)
ANCHORS = tuple(replace(anchor, slot=slot) for slot, anchor in enumerate(LAB.anchors))
SLOTS = replace(LAB, anchors=ANCHORS, schedule=ScheduleSite(mode="slots", slot_s=2e-3, slots=len(ANCHORS)))
FREE = replace(LAB, schedule=ScheduleSite(mode="free", rate_hz=50.0))
SUPERFRAME_S = 2e-3 * len(ANCHORS)


async def alone(site, seconds):
    """An anchor that receives nobody, after that time."""
    radio = FakeRadio("1")
    radio.sends = True
    node = AnchorNode(site, 1, radio, lambda _: None)
    task = asyncio.ensure_future(node.run())
    await asyncio.sleep(0)
    node.on_event(Restarted())
    await asyncio.sleep(seconds)
    task.cancel()
    await asyncio.wait([task])
    return node, radio


def stamps(radio):
    return [transmission.tx_ticks for _, transmission in radio.transmissions]


def test_an_anchor_in_slots_leads_when_it_is_alone_and_says_so():
    async def main():
        node, radio = await alone(SLOTS, 1.0)
        steps_s = [difference(later, one) / TICK_RATE_HZ for one, later in itertools.pairwise(stamps(radio))]
        assert len(steps_s) > 50
        assert steps_s == [pytest.approx(SUPERFRAME_S, abs=512 / TICK_RATE_HZ)] * len(steps_s)
        last = decode_2(radio.transmissions[-1][1].frame)
        assert isinstance(last, Beacon2)
        assert (last.slot_time.root, last.slot_time.hop, last.slot_time.pulse_age) == (1, 0, 0)
        health = health_of(node, NONE, 0.0, 0.0)
        assert (health.mode, health.role, health.root, health.term, health.hop) == ("slots", "root", 1, 0, 0)
        assert (health.master, health.offset_std_m, health.parents, health.synchronised) == (None, None, (), True)
        assert health.offset_s == pytest.approx(0.0)
        assert health.superframe == pytest.approx(last.slot_time.superframe, abs=1)
        assert leads(node.machine, is_first=False)

    play(main())


def test_an_anchor_that_listens_has_no_slot_time_yet():
    async def main():
        node, radio = await alone(SLOTS, 0.01)
        assert not radio.transmissions
        health = health_of(node, NONE, 0.0, 0.0)
        assert (health.role, health.root, health.synchronised, health.superframe) == ("listening", None, False, None)
        assert not leads(node.machine, is_first=True)

    play(main())


def test_a_free_anchor_sends_at_once_and_has_no_time_but_its_own():
    async def main():
        node, radio = await alone(FREE, 2.0)
        assert len(radio.transmissions) == pytest.approx(100, abs=3)
        assert all(decode_2(transmission.frame).slot_time is None for _, transmission in radio.transmissions)
        health = health_of(node, NONE, 0.0, 0.0)
        assert (health.mode, health.role, health.synchronised) == ("free", "anchor", True)
        assert {health.master, health.root, health.term, health.hop, health.offset_s, health.rate_ppm} == {None}
        assert [leads(node.machine, is_first=first) for first in (True, False)] == [True, False]

    play(main())
