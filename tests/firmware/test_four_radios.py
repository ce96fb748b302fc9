"""One seed, three radios: emulated, the firmware's C, its ARM image. The same fixes.

A tag gets the frames of one simulated site; powers, carrier offsets and phases are given to the emulated radio as the
driver reads them from the chip's model, because chips round them.
"""

from collections import Counter
from functools import partial

import pytest
from chip_stage import TimedNode, WorldAir
from emulator.seat import Seat
from firmware_stage import HOST, IMAGE, boards
from msgspec.structs import replace
from radio_events import fixes_of

from skyless.core.protocol1.anchor import Anchor
from skyless.core.ticks import from_seconds, wrap
from skyless.radio.interface import AntennaDelays, Reception
from skyless.radio.serial.serial_radio import LinkSession
from skyless.sim.dw1000.chip import Chip
from skyless.sim.evaluation.scenarios import Request, impairments_of
from skyless.sim.lab import paper_lab_site
from skyless.sim.listening import TagSpec
from skyless.sim.medium import Timeline
from skyless.sim.trajectory import Static
from skyless.sim.world import World

pytestmark = pytest.mark.site

LAB = paper_lab_site()
SECONDS = 1.5
SEED = 7
STARTS_S = 0.1
"""Before the first frame a board is configured."""
DELAYS = AntennaDelays()


@pytest.fixture(scope="module")
def tape():
    """What the tag's antenna gets, and that as the driver reads it; ``host_s`` is when each frame ended."""
    faults = replace(impairments_of(Request(LAB, nlos=0.1, carrier=True), LAB), diagnostics=True)
    world = World(LAB, lambda number: Anchor(LAB, number), [TagSpec(Static(2.0, 3.0, 0.0))], faults, SEED)
    tag = TimedNode(WorldAir(world.medium, len(LAB.anchors)))
    tag.start()
    emulated, driver = [], []
    for broadcast in world.run(SECONDS):
        for _, reception, _ in broadcast.receptions():
            emulated.append(replace(reception, host_s=world.medium.now_s))
            given = reception.frame, reception.rx_ticks, reception.diagnostics, world.medium.now_s
            driver.append(tag.hear(*given, phase_cycles=reception.carrier_phase_cycles))
    rounded = [
        replace(one, diagnostics=other.diagnostics, carrier_phase_cycles=other.carrier_phase_cycles)
        for one, other in zip(emulated, driver, strict=True)
    ]
    return emulated, rounded


class TapeAir:
    """An air that only receives; its counter is that of the newest stamp, and what has passed since."""

    def __init__(self, timeline):
        self.timeline = timeline
        self.reading = 0, 0

    def now_ticks(self):
        ticks, at = self.reading
        return wrap(ticks + self.timeline.now_ticks - at)

    def now_s(self):
        return self.timeline.now_ticks / 63.8976e9

    def transmit(self, frame, leaves_ticks):
        raise AssertionError("a tag sends nothing")

    def withdraw(self):
        pass


@pytest.mark.parametrize("kind", [HOST, IMAGE])
def test_a_board_gives_the_fixes_of_the_emulated_radio_bit_for_bit(kind, tape):
    emulated, rounded = tape
    timeline, events, lines, counters = Timeline(), [], [], Counter()
    air = TapeAir(timeline)
    chip = Chip(air, DELAYS.tx_ticks, DELAYS.rx_ticks, air.now_s)
    session = LinkSession("the line", DELAYS, lines.append, events.append, counters, phases=True)
    board = boards(kind)(Seat(timeline, chip, lambda data: talk(session.on_data, data)))

    def talk(call, *values):
        """Let the host do something, and the board get what it writes."""
        call(*values, air.now_s())
        while lines:
            board.receive(lines.pop(0))

    def arrive(reception):
        air.reading = wrap(reception.rx_ticks + from_seconds(180e-6)), timeline.now_ticks
        of_chip = reception.frame, reception.rx_ticks, reception.diagnostics
        chip.receive(*of_chip, carrier_phase_cycles=reception.carrier_phase_cycles)
        board.notify()

    timeline.at(from_seconds(STARTS_S / 2), lambda: talk(session.begin))
    air.reading = wrap(emulated[0].rx_ticks - from_seconds(STARTS_S)), 0
    for reception in emulated:
        at = from_seconds(STARTS_S + reception.host_s - emulated[0].host_s)
        timeline.at(at, partial(arrive, reception))
    assert list(timeline.run(from_seconds(STARTS_S + SECONDS + 0.1))) == []
    getattr(board, "close", lambda: None)()
    assert set(chip.arrivals) == {"heard"}
    assert not +counters
    assert not +chip.misuse
    heard = [event for event in events if isinstance(event, Reception)]
    but_for_when = [[replace(one, host_s=None) for one in receptions] for receptions in (heard, rounded)]
    assert but_for_when[0] == but_for_when[1]
    here = fixes_of(rounded)
    assert here != fixes_of(replace(one, carrier_phase_cycles=None) for one in rounded)
    assert sum(fix is not None for fix in here[0]) > 150
    assert fixes_of(heard) == here
