"""Faults at boards of an emulated site: recovered, reported, and nothing wrong ever sent or reported."""

import asyncio
import random

import pytest
from site_stage import HOST, IMAGE, play, site_of, until

from skyless.sim.trajectory import Static

pytestmark = pytest.mark.site

SLOT_MS = 5.0
PLACES = [Static(2.0, 3.0, 0.0)]


def with_kind(kind, *values):
    """Cases of a test on boards of one kind, with its reason to be skipped."""
    return [pytest.param(value, *kind.values, marks=kind.marks) for value in values]


def logged(site, *words):
    return any(all(word in line for word in words) for line in site.log)


async def works(site, node):
    """Wait until frames of a node are sent and reported again, and others' reach its host."""
    sent = sum(one.node == node.air.node for one in site.sent)
    heard = len(node.radio.heard)
    await until(lambda: len(node.radio.heard) > heard + 20)
    if node in site.anchors:
        await until(lambda: sum(one.node == node.air.node for one in site.sent) > sent + 5)


def is_clean(site):
    """Every frame that left an antenna is its anchor's, at its time; every reception's stamp is the antenna's."""
    result = site.result(0.0)
    assert result.wrong == 0
    assert not result.misused
    return result.sent > 50


def run_faults(kind, script):
    site = site_of(kind, SLOT_MS, trajectories=PLACES)
    play(site, script)
    assert is_clean(site)
    return site


@pytest.mark.parametrize("kind", [HOST])
def test_a_chip_that_is_absent_is_reported_and_found_when_it_is_there(kind):
    async def script(site):
        await until(lambda: logged(site, "anchor 4", "refuses its configuration", "radio"))
        absent.chip.absent = False
        await works(site, absent)
        absent.chip.absent = True
        await until(lambda: sum("refuses its configuration" in line for line in site.log) == 2)
        absent.chip.absent = False
        absent.chip.pull_reset()
        await works(site, absent)

    site = site_of(kind, SLOT_MS, trajectories=PLACES)
    absent = site.anchors[3]
    absent.chip.absent = True
    play(site, script)
    assert is_clean(site)


@pytest.mark.parametrize(("state", "kind"), [*with_kind(HOST, False, True), *with_kind(IMAGE, False)])
@pytest.mark.statistical
def test_a_stuck_interrupt_line_is_reported_and_the_chip_polled(kind, state):
    async def script(site):
        anchor, tag = site.anchors[2], site.tags[0]
        await works(site, anchor)
        for node in (anchor, tag):
            node.chip.stuck = state
            node.board.notify()
        await until(lambda: logged(site, "anchor 3", "interrupt line") and logged(site, "tag1", "interrupt line"))
        begun_s, heard = site.medium.now_s, len(tag.radio.heard)
        await works(site, anchor)
        await works(site, tag)
        got = sum(ended_s > begun_s for ended_s in tag.at_antenna.values())
        assert len(tag.radio.heard) - heard >= 0.95 * got
        for node in (anchor, tag):
            node.chip.stuck = None
            node.board.notify()
        await works(site, anchor)
        assert anchor.radio.counters["interrupt-line-stuck"] == 1

    run_faults(kind, script)


@pytest.mark.parametrize(("part", "kind"), [*with_kind(HOST, "processor", "chip", "both"), *with_kind(IMAGE, "both")])
@pytest.mark.statistical
def test_a_brown_out_in_the_middle_of_a_frame(kind, part):
    async def script(site):
        node = site.anchors[1]
        await works(site, node)
        async with asyncio.timeout(5.0):
            while not node.is_sending:
                await asyncio.sleep(20e-6)
        site.brown_out(node, part)
        await until(lambda: node.radio.counters["board-restart"] == 1)
        await works(site, node)
        await works(site, site.tags[0])
        site.brown_out(site.tags[0], part)
        await until(lambda: site.tags[0].radio.counters["board-restart"] == 1)
        await works(site, site.tags[0])

    site = run_faults(kind, script)
    assert site.cut == (part != "processor")


@pytest.mark.parametrize("kind", [HOST])
def test_noise_on_the_lines_costs_records_and_nothing_else(kind):
    noise = random.Random(1)

    def spoil(data):
        """One byte in fifty is changed, lost or doubled."""
        changed = bytearray()
        for byte in data:
            fate = noise.randrange(150)
            changed += (
                bytes((noise.randrange(256),))
                if fate == 0
                else b""
                if fate == 1
                else bytes((byte,)) * (1 + (fate == 2))
            )
        return bytes(changed)

    async def script(site):
        nodes = [site.anchors[0], site.anchors[4], site.tags[0]]
        await works(site, nodes[1])
        wires = [node.wire for node in nodes]
        for wire in wires:
            wire.noise_to_board = wire.noise_to_host = spoil
        await asyncio.sleep(1.0)
        for wire in wires:
            wire.noise_to_board = wire.noise_to_host = bytes
        for node in nodes:
            assert node.radio.counters["garbled-record"] > 5
        for node in nodes:
            await works(site, node)

    run_faults(kind, script)


@pytest.mark.parametrize("kind", [HOST])
def test_a_host_that_goes_away_and_returns_finds_its_board_silent_in_between(kind):
    async def script(site):
        node = site.anchors[5]
        await works(site, node)
        await site.stop_host(node)
        await asyncio.sleep(0.1)  # the frame that the board may hold
        sent = sum(one.node == node.air.node for one in site.sent)
        await asyncio.sleep(0.5)
        assert sum(one.node == node.air.node for one in site.sent) == sent
        site.start_host(node)
        await works(site, node)
        await works(site, site.tags[0])

    run_faults(kind, script)
