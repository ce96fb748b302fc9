"""Boards behind pseudo-terminals whose radio the test plays, and programs' ears on the other side."""

import asyncio
import contextlib
from collections import Counter

from skyless.nodes.board_speech import LinkSpeech
from skyless.nodes.pty import Pty
from skyless.radios.radio import Restarted
from skyless.radios.serial_radio import SerialRadio


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
        self.speech = LinkSpeech(self.radio, self.pty.send, can_transmit=can_transmit)

    async def __aenter__(self):
        self.pty.start(self.speech.hear_host)
        return self

    async def __aexit__(self, *_):
        self.pty.close()

    def hear(self, reception):
        self.speech.hear_radio(reception)


class Ears:
    """A radio that runs, and all that it has told."""

    def __init__(self, radio):
        self.radio, self.told = radio, []
        self.task = asyncio.ensure_future(radio.run(self.told.append))

    def of(self, kind):
        return [event for event in self.told if isinstance(event, kind)]

    async def until(self, kind, count=1):
        async with asyncio.timeout(30):
            while len(self.of(kind)) < count:
                await asyncio.sleep(0.002)
        return self.of(kind)[-1]

    async def stop(self):
        self.task.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await self.task


@contextlib.asynccontextmanager
async def ears(radio):
    node = Ears(radio)
    try:
        yield node
    finally:
        await node.stop()


@contextlib.asynccontextmanager
async def linked(link=None, **kind):
    """A board and a host that are in touch."""
    async with PlayedBoard(link, **kind) as board, ears(SerialRadio(board.pty.place, 1_000_000, "tag1")) as host:
        await host.until(Restarted)
        yield board, host
