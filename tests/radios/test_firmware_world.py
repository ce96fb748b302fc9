"""A whole simulated site whose anchors and tag are the firmware on driver and model: nothing is changed on the way."""

import msgspec
import pytest
from chip_stage import WorldAir
from firmware_stage import FirmwareAnchor, FirmwareNode

from skyless.anchor import Anchor
from skyless.evaluation.scenarios import Request, impairments_of
from skyless.radios.interface import Late, Sent
from skyless.receiver import Receiver
from skyless.simulation.stations import TagSpec
from skyless.simulation.trajectory import Static
from skyless.simulation.world import World
from skyless.site.lab import lab_site

LAB = lab_site()
FAULTS = msgspec.structs.replace(impairments_of(Request(LAB), LAB), diagnostics=True)
SECONDS = 3.0


def world_of(wrap):
    machines = {}

    def factory(number):
        machines[number] = wrap(Anchor(LAB, number), world.medium)
        return machines[number]

    world = World(LAB, factory, [TagSpec(Static(2.0, 3.0, 0.0))], FAULTS, 11)
    return world, machines


def on_boards(machine, medium):
    return FirmwareAnchor(machine, WorldAir(medium, medium.node_of[machine.id]))


@pytest.fixture(scope="module")
def ways():
    plain, _ = world_of(lambda machine, _: machine)
    emulated = [reception for broadcast in plain.run(SECONDS) for _, reception, _ in broadcast.receptions()]
    world, machines = world_of(on_boards)
    tag = FirmwareNode(WorldAir(world.medium, len(LAB.anchors)), can_transmit=False)
    tag.start()
    heard = [tag.hear(reception) for broadcast in world.run(SECONDS) for _, reception, _ in broadcast.receptions()]
    return emulated, heard, machines, tag


def test_the_same_frames_at_the_same_ticks_from_a_whole_site_of_boards(ways):
    emulated, heard, machines, tag = ways
    assert len(emulated) > 1000
    assert [(one.frame, one.rx_ticks) for one in heard] == [(one.frame, one.rx_ticks) for one in emulated]
    for node in (tag, *(machine.node for machine in machines.values())):
        assert not +node.chip.misuse
        assert not +node.line.counters
        assert set(node.chip.arrivals) == {"heard"}
    for machine in machines.values():
        told = machine.node.line.events
        assert sum(isinstance(event, Sent) for event in told) > 150
        assert not [event for event in told if isinstance(event, Late)]


def test_anchors_collect_garbage_in_their_own_slots_and_the_tag_where_there_is_silence(ways):
    _, _, machines, _ = ways
    assert all(1 <= machine.node.line.collections <= 3 for machine in machines.values())


@pytest.mark.parametrize("method", ["joint"])
def test_the_fixes_are_those_of_the_emulated_radio(ways, method):
    """Measured powers and offsets are rounded by chip and line, so the emulated radio is given those."""
    emulated, heard, _, _ = ways
    rounded = [
        msgspec.structs.replace(one, diagnostics=other.diagnostics) for one, other in zip(emulated, heard, strict=True)
    ]
    fixes = []
    for way in (rounded, heard):
        receiver = Receiver(method)
        told = [receiver.hear(reception) for reception in way]
        fixes.append([None if fix is None else (fix.position_m.tobytes(), fix.std_m, fix.time_s) for fix in told])
    assert fixes[0] == fixes[1]
    assert sum(fix is not None for fix in fixes[0]) > 100
