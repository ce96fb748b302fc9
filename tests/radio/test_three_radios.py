"""One seed, three radios: emulated, serial over a pseudo-terminal, driver and register model. The same fixes.

What chips and lines round is rounded alike before: the measured powers, carrier offsets and phases, which may decide
what a reception weighs. The emulated radio and the board are given them as the driver reads them from the model's
registers.
"""

import asyncio

import msgspec
import pytest
from chip_stage import ChipAnchor, TimedNode, WorldAir
from radio_events import fixes_of, radio_events
from serial_stage import PlayedBoard

from skyless.core.protocol1.anchor import Anchor
from skyless.radio.interface import Reception, Restarted
from skyless.radio.serial.serial_radio import SerialRadio
from skyless.sim.evaluation.scenarios import Request, impairments_of
from skyless.sim.lab import paper_lab_site
from skyless.sim.listening import TagSpec
from skyless.sim.trajectory import Static
from skyless.sim.world import World

pytestmark = pytest.mark.site

LAB = paper_lab_site()
SECONDS = 4.0
SEED = 7
FAULTS = msgspec.structs.replace(impairments_of(Request(LAB, nlos=0.1, carrier=True), LAB), diagnostics=True)


def world_of(make_anchor):
    """A world of that seed; anchors are what ``make_anchor`` makes of an ``Anchor`` and the medium."""
    machines = {}

    def factory(number):
        machines[number] = make_anchor(Anchor(LAB, number), world.medium)
        return machines[number]

    world = World(LAB, factory, [TagSpec(Static(2.0, 3.0, 0.0))], FAULTS, SEED)
    return world, machines


def tape(make_anchor=lambda machine, _: machine):
    """What the tag's antenna gets."""
    world, machines = world_of(make_anchor)
    heard = [reception for broadcast in world.run(SECONDS) for _, reception, _ in broadcast.receptions()]
    return heard, machines


def through_the_chip():
    """The same world with every anchor and the tag on driver and model."""
    world, machines = world_of(ChipAnchor)
    tag = TimedNode(WorldAir(world.medium, len(LAB.anchors)))
    tag.start()
    heard = []
    for broadcast in world.run(SECONDS):
        for _, one, _ in broadcast.receptions():
            told = one.frame, one.rx_ticks, one.diagnostics, one.host_s
            heard.append(tag.hear(*told, phase_cycles=one.carrier_phase_cycles))
    return heard, machines, tag


async def over_the_line(heard):
    """The same receptions behind a board and a serial port."""
    board = PlayedBoard()
    async with board, radio_events(SerialRadio(board.pty.name, (1_000_000,), "tag1", phases=True)) as host:
        await host.until(Restarted)
        for at in range(0, len(heard), 20):
            for reception in heard[at : at + 20]:
                board.hear(reception)
            await host.until(Reception, min(at + 20, len(heard)))
        return host.of(Reception)


@pytest.fixture(scope="module")
def ways():
    """What the tag hears over each radio, and the emulated receptions as they were."""
    emulated, _ = tape()
    chip, machines, tag = through_the_chip()
    rounded = [
        msgspec.structs.replace(one, diagnostics=other.diagnostics, carrier_phase_cycles=other.carrier_phase_cycles)
        for one, other in zip(emulated, chip, strict=True)
    ]
    return emulated, rounded, asyncio.run(over_the_line(rounded)), chip, machines, tag


@pytest.mark.statistical
def test_the_same_frames_at_the_same_ticks_from_a_whole_site_on_driver_and_model(ways):
    emulated, _, serial, chip, machines, tag = ways
    assert len(emulated) > 1000
    for way in (serial, chip):
        assert [(one.frame, one.rx_ticks) for one in way] == [(one.frame, one.rx_ticks) for one in emulated]
    assert [one.carrier_phase_cycles for one in serial] == [one.carrier_phase_cycles for one in chip]
    for node in (tag, *(machine.node for machine in machines.values())):
        assert not +node.chip.misuse
        assert not +node.counters
        assert set(node.chip.arrivals) == {"heard"}
    assert sum(machine.sent for machine in machines.values()) == pytest.approx(len(emulated), abs=7)


def test_what_the_chip_measures_is_what_the_air_gives_but_for_rounding(ways):
    emulated, _, _, chip, _, _ = ways
    for one, other in zip(emulated, chip, strict=True):
        assert other.diagnostics.rx_power_dbm == pytest.approx(one.diagnostics.rx_power_dbm, abs=0.03)
        assert other.diagnostics.first_path_power_dbm == pytest.approx(one.diagnostics.first_path_power_dbm, abs=0.03)
        assert other.diagnostics.carrier_offset_ppm == pytest.approx(one.diagnostics.carrier_offset_ppm, abs=0.0011)
        assert abs((other.carrier_phase_cycles - one.carrier_phase_cycles + 0.5) % 1.0 - 0.5) < 2e-4


@pytest.mark.parametrize("method", ["joint", "bracketed"])
def test_three_radios_give_the_same_fixes_bit_for_bit(ways, method):
    _, rounded, serial, chip, _, _ = ways
    here = fixes_of(rounded, method)
    assert sum(fix is not None for fix in here[0]) > 150
    assert fixes_of(serial, method) == here
    assert fixes_of(chip, method) == here
    if method == "joint":
        assert here != fixes_of(msgspec.structs.replace(one, carrier_phase_cycles=None) for one in rounded)
