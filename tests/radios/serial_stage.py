"""Boards behind pseudo-terminals whose radio the test plays, and hosts that are in touch with them."""

import contextlib
from collections import Counter

from radio_events import radio_events

from skyless.radio.interface import Restarted
from skyless.radio.serial.link import from_steps, to_steps
from skyless.radio.serial.pseudo_terminal import Pty
from skyless.radio.serial.serial_radio import SerialRadio
from skyless.run.board import LinkProtocol


def quantised(diagnostics):
    """Measured values as the serial link rounds them."""
    return from_steps(*to_steps(diagnostics))


class PlayedRadio:
    """The radio on the board."""

    def __init__(self, name="tag1"):
        self.name, self.counters, self.ticks = name, Counter(), 5
        self.transmissions = []

    def now_ticks(self):
        return self.ticks

    def transmit(self, transmission):
        self.transmissions.append(transmission)


class PlayedBoard:
    """A board that speaks the link, plugged in as long as the context lasts."""

    def __init__(self, link=None, can_transmit=True):
        self.radio = PlayedRadio()
        self.pty = Pty(link)
        self.protocol = LinkProtocol(self.radio, self.pty.send, can_transmit=can_transmit)

    async def __aenter__(self):
        self.pty.start(self.protocol.on_host_data)
        return self

    async def __aexit__(self, *_):
        self.pty.close()

    def hear(self, reception):
        self.protocol.on_radio_event(reception)


@contextlib.asynccontextmanager
async def linked(link=None, **kind):
    """A board and a host that are in touch."""
    async with PlayedBoard(link, **kind) as board, radio_events(SerialRadio(board.pty.name, 1_000_000, "tag1")) as host:
        await host.until(Restarted)
        yield board, host
