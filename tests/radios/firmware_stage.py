"""The board's firmware on driver and register model, in an air of the test's, and its host's end of the link."""

from collections import Counter

from skyless.air.reception import Diagnostics
from skyless.firmware import board, dw1000
from skyless.radios.interface import AntennaDelays, Reception
from skyless.radios.serial.serial_radio import LinkSession
from skyless.simulation.dw1000.chip import Chip, ModelBus

DELAYS = AntennaDelays()


class Line:
    """A wire without a delay between the board's UART and the host's conversation; clock and collector besides."""

    def __init__(self, air):
        self.air, self.events, self.counters = air, [], Counter()
        self.to_board = bytearray()
        self.session = LinkSession("the wire", DELAYS, self.to_board.extend, self.events.append, self.counters)
        self.host_s = None
        self.collections = 0

    def read(self, into):
        size = min(len(into), len(self.to_board))
        into[:size] = self.to_board[:size]
        del self.to_board[:size]
        return size

    def write(self, line, end):
        self.session.on_data(bytes(line[:end]), self.air.now_s() if self.host_s is None else self.host_s)
        return True

    def restart(self):
        raise AssertionError("there is no noise on this wire")

    def ticks_us(self):
        return round(self.air.now_s() * 1e6)

    def ticks_add(self, ticks, change):
        return ticks + change

    def ticks_diff(self, later, earlier):
        return later - earlier

    def collect(self):
        self.collections += 1


class FirmwareNode:
    """A chip's model, the firmware on it, and its host."""

    def __init__(self, air, *, can_transmit):
        self.air, self.line = air, Line(air)
        self.chip = Chip(air, DELAYS.tx_ticks, DELAYS.rx_ticks, air.now_s)
        driver = dw1000.DW1000(ModelBus(self.chip, air.pass_s))
        wire = self.line
        self.board = board.Board(driver, wire, wire, wire, can_transmit, bytearray(8), self, lead_us=5000)

    def value(self):
        return int(self.chip.irq)

    def serve(self):
        """Let the board turn until nothing is left to do."""
        self.board.turn()
        while self.chip.irq or self.line.to_board:
            self.board.turn()

    def start(self):
        self.board.begin()
        self.line.session.begin(self.air.now_s())
        self.serve()
        assert self.line.session.ready

    def hear(self, reception):
        """The reception as it arrives at the host."""
        self.line.host_s = reception.host_s
        told = len(self.line.events)
        self.chip.receive(reception.frame, reception.rx_ticks, reception.diagnostics or Diagnostics())
        self.serve()
        (heard,) = [event for event in self.line.events[told:] if isinstance(event, Reception)]
        return heard


class FirmwareAnchor:
    """An anchor's machine whose receptions and transmissions pass through its board (``AnchorMachine``)."""

    def __init__(self, machine, air):
        self._machine, self.id = machine, machine.id
        self.node = FirmwareNode(air, can_transmit=True)
        self.node.start()

    def hear(self, reception):
        self._machine.hear(self.node.hear(reception))

    def next_transmission_ticks(self, now_ticks):
        self.node.serve()  # the end of its own frame
        return self._machine.next_transmission_ticks(now_ticks)

    def transmission(self, tx_ticks):
        self.node.line.session.transmit(self._machine.transmission(tx_ticks))
        self.node.serve()
        return self.node.air.handed_over
