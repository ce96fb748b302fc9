"""Anchors and tags of the simulated world on driver and register model, with a host that takes no time."""

from collections import Counter

from skyless.core.air.frame import Diagnostics, Reception, Transmission
from skyless.core.ticks import TICK_S, wrap
from skyless.radio.dw1000.radio import ChipSession
from skyless.radio.interface import AntennaDelays, Sent
from skyless.sim.dw1000.chip import Chip, ModelBus

DELAYS = AntennaDelays()


class HandClock:
    """A chip's air whose time the test moves; what is sent is written down."""

    def __init__(self, ticks=0):
        self.ticks, self.sent, self.withdrawn, self.in_time = ticks, [], 0, True

    def now_ticks(self):
        return wrap(self.ticks)

    def now_s(self):
        return self.ticks * TICK_S

    def pass_s(self, seconds):
        self.ticks += round(seconds / TICK_S)

    def transmit(self, frame, leaves_ticks):
        if self.in_time:
            self.sent.append(Transmission(frame, leaves_ticks))
        return self.in_time

    def withdraw(self):
        self.withdrawn += 1


class ChipNode:
    """A chip, its driver, and what both tell."""

    def __init__(self, air, delays=DELAYS, true_delays=DELAYS, *, phases=True):
        self.air, self.events, self.counters = air, [], Counter()
        self.chip = Chip(air, true_delays.tx_ticks, true_delays.rx_ticks, air.now_s)
        bus = ModelBus(self.chip, self.pause)
        self.session = ChipSession(bus, delays, self.events.append, self.counters, phases=phases)

    def pause(self, seconds):
        """Only what the driver waits for takes time, and only on the chip's own clock."""

    def start(self):
        self.session.start()

    def hear(self, frame, rx_ticks, diagnostics=None, host_s=None, fault=None, phase_cycles=None):
        """A frame comes in, and the host serves its interrupt; the reception, if it became one."""
        self.chip.receive(frame, rx_ticks, diagnostics or Diagnostics(), fault, carrier_phase_cycles=phase_cycles)
        told = len(self.events)
        while self.chip.irq:
            self.session.serve(host_s)
        return next((event for event in self.events[told:] if isinstance(event, Reception)), None)


class TimedNode(ChipNode):
    """One whose waiting passes the air's time."""

    def pause(self, seconds):
        self.air.pass_s(seconds)


class WorldAir:
    """The air of a node of a world; reading the counter draws no noise."""

    def __init__(self, medium, node):
        self._medium, self._node = medium, node
        self._waited_s = 0.0
        self.handed_over = None

    def now_ticks(self):
        clock = self._medium.clocks[self._node]
        passed = self._medium.timeline.now_ticks - clock.true_ticks - clock.true_fraction
        return wrap(clock.local_ticks + round(clock.local_fraction + passed * (1.0 + clock.rate)))

    def now_s(self):
        return self._waited_s + self._medium.now_s

    def pass_s(self, seconds):
        self._waited_s += seconds

    def transmit(self, frame, leaves_ticks):
        self.handed_over = Transmission(frame, leaves_ticks)
        return True

    def withdraw(self):
        raise AssertionError("no frame of these tests is taken back")


class ChipAnchor:
    """An anchor's machine whose receptions and transmissions pass through its chip (``AnchorMachine``)."""

    def __init__(self, machine, medium):
        self._machine, self.id = machine, machine.id
        self.node = TimedNode(WorldAir(medium, medium.node_of[machine.id]))
        self.node.start()

    def hear(self, reception):
        told = reception.frame, reception.rx_ticks, reception.diagnostics, reception.host_s
        heard = self.node.hear(*told, phase_cycles=reception.carrier_phase_cycles)
        assert heard is not None, (self.node.chip.arrivals, self.node.events[-3:])
        self._machine.hear(heard)

    def next_transmission_ticks(self, now_ticks):
        self.node.session.serve()  # the end of its own frame
        return self._machine.next_transmission_ticks(now_ticks)

    def transmission(self, tx_ticks):
        self.node.session.transmit(self._machine.transmission(tx_ticks))
        return self.node.air.handed_over

    @property
    def sent(self):
        return sum(isinstance(event, Sent) for event in self.node.events)
