"""The anchor's program on a radio that the test plays, in a time that jumps."""

import asyncio
import contextlib
import itertools

import pytest
from node_stage import LAB, LEAD_S, FakeRadio, play, receptions

from skyless.air.codec import decode
from skyless.constants import TICK_RATE_HZ
from skyless.master_election import SILENT_SUPERFRAMES
from skyless.nodes.anchor import ASK_AGAIN_S, LOST_ANSWER_S, AnchorNode, TransmissionCount
from skyless.radios.interface import Gone, Late, Restarted, Sent
from skyless.site.slots import superframe_ticks_of
from skyless.ticks import difference, wrap

SUPERFRAME_S = 6 * 2.5e-3


@contextlib.asynccontextmanager
async def running(anchor=1):
    """An anchor that has been told that its radio is ready, until it spoke first, if it is the master."""
    radio, said = FakeRadio(str(anchor)), []
    node = AnchorNode(LAB, anchor, radio, said.append)
    task = asyncio.ensure_future(node.run())
    await asyncio.sleep(0)
    node.on_event(Restarted())
    try:
        if anchor == 1:
            await first_words(radio)
        yield node, radio, said
    finally:
        task.cancel()
        await asyncio.wait([task])


async def first_words(radio):
    """A master listens first whether there is another."""
    before = len(radio.transmissions)
    for _ in range(2000):
        await asyncio.sleep(1e-3)
        if len(radio.transmissions) > before:
            return
    raise AssertionError("the master never speaks")


def test_a_master_transmits_once_in_a_superframe_and_hands_over_each_frame_as_late_as_it_may():
    async def main():
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

    play(main())


def test_a_late_frame_is_skipped_and_counted_and_the_next_slot_is_taken():
    async def main():
        async with running() as (node, radio, _):
            _, first = radio.transmissions[-1]
            node.on_event(Late(first.tx_ticks))
            assert node.late == 1
            await asyncio.sleep(ASK_AGAIN_S + SUPERFRAME_S)
            _, second = radio.transmissions[-1]
            superframes = difference(second.tx_ticks, first.tx_ticks) / TICK_RATE_HZ / SUPERFRAME_S
            assert superframes == pytest.approx(1.0, abs=1e-3)
            assert len(radio.transmissions) == 2
            one, two = decode(first.frame), decode(second.frame)
            assert two.sequence == (one.sequence + 1) & 0xFF

    play(main())


def test_an_answer_that_never_comes_is_waited_for_and_then_asked_for_again():
    async def main():
        async with running() as (node, radio, _):
            begin_s, first = radio.transmissions[-1]
            await asyncio.sleep(LOST_ANSWER_S - 2e-3)
            assert len(radio.transmissions) == 1
            await asyncio.sleep((1 + SILENT_SUPERFRAMES) * SUPERFRAME_S + 9e-3)  # so long silent, it listens first
            assert len(radio.transmissions) == 2
            when_s, second = radio.transmissions[-1]
            assert when_s - begin_s >= LOST_ANSWER_S
            slots = difference(second.tx_ticks, first.tx_ticks) / TICK_RATE_HZ / SUPERFRAME_S
            assert slots == pytest.approx(round(slots), abs=1e-3)  # still its own slot
            assert node.late == 0

    play(main())


def test_a_radio_that_starts_again_gets_a_new_machine_and_no_frame_of_the_old_one():
    async def main():
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

    play(main())


def test_an_anchor_that_knows_no_time_does_not_transmit():
    async def main():
        async with running(anchor=4) as (node, radio, _):
            await asyncio.sleep(0.02)
            assert radio.transmissions == []
            radio.ready = False  # nor stumbles over a radio that is not ready
            await asyncio.sleep(0.02)
            assert radio.transmissions == []
            assert node.machine.synchronisation.beacons == 0

    play(main())


def test_who_was_heard_is_noted_but_no_other_site():
    async def main():
        async with running(anchor=4) as (node, _, __):
            for reception in receptions(1.0)[:100]:
                node.on_event(reception)
            assert node.heard_s.keys() <= {1, 2, 3, 4, 5, 6}
            assert {1, 2} <= node.heard_s.keys()

    play(main())


def test_nothing_goes_on_after_it_was_stopped():
    async def main():
        async with running() as (_, radio, __):
            pass
        sent = len(radio.transmissions)
        await asyncio.sleep(2.0)
        assert len(radio.transmissions) == sent

    play(main())


def test_transmissions_that_were_passed_over_are_missed_too():
    step = superframe_ticks_of(LAB)
    count = TransmissionCount(LAB)
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
