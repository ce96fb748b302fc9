"""Boards behind pseudo-terminals whose radio the test plays, and hosts that are in touch with them."""

import contextlib
import ctypes
from collections import Counter

from radio_events import radio_events

from skyless.radio.interface import Restarted
from skyless.radio.serial import link
from skyless.radio.serial.link import from_steps, to_steps
from skyless.radio.serial.serial_port import Pty
from skyless.radio.serial.serial_radio import SerialRadio
from skyless.run.board import LinkProtocol
from support.board_tag import ANCHORS, AnchorInC, OriginInC, StatusInC, fix_in_c


def quantised(diagnostics):
    """Measured values as the serial link rounds them."""
    return from_steps(*to_steps(diagnostics))


class PlayedRadio:
    """The radio on the board."""

    def __init__(self, name="tag1", ticks=5):
        self.name, self.counters, self.ticks, self.transmissions = name, Counter(), ticks, []

    def now_ticks(self):
        return self.ticks

    def transmit(self, transmission):
        self.transmissions.append(transmission)


class PlayedBoard:
    """A board that speaks the link, plugged in as long as the context lasts."""

    def __init__(self, place=None, can_transmit=True):
        self.radio = PlayedRadio()
        self.pty = Pty(place)
        self.protocol = LinkProtocol(self.radio, self.pty.send, can_transmit=can_transmit)

    async def __aenter__(self):
        self.pty.start(self.protocol.on_host_data)
        return self

    async def __aexit__(self, *_):
        self.pty.close()

    def hear(self, reception):
        self.protocol.on_radio_event(reception)


class ComputingBoard(PlayedBoard):
    """A board that can be a tag by itself; it hears nothing, and says what the test has it say."""

    def __init__(self):
        super().__init__(can_transmit=False)
        self.tag, self.report = self.protocol.tag, self.protocol.report

    def report_all(self):
        """What a tag with a fix says within ten seconds."""
        for number, place_mm in ANCHORS:
            self.report(link.ANCHOR_PLACE, bytes(AnchorInC(number, (ctypes.c_int32 * 3)(*place_mm))))
        self.report(link.GEOREFERENCE, bytes(OriginInC(525_130_000, 134_000_000, 40_000, 0)))
        self.report(link.TAG_STATUS, bytes(StatusInC(site=3, heard=100)))
        self.report(link.FIX, fix_in_c().sent())


@contextlib.asynccontextmanager
async def linked(place=None, **kind):
    """A board and a host that are in touch."""
    async with (
        PlayedBoard(place, **kind) as board,
        radio_events(SerialRadio(board.pty.name, (1_000_000,), "tag1")) as host,
    ):
        await host.until(Restarted)
        yield board, host
