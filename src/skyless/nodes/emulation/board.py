"""``skyless board``: an emulated board, one node of the emulated air behind a pseudo-terminal."""

from pathlib import Path
from typing import Final, Literal

from skyless.nodes.emulation.board_protocol import BoardProtocol, LinkProtocol, ListenerProtocol, SnifferProtocol
from skyless.nodes.process.pty import Pty
from skyless.nodes.process.running import Log
from skyless.radios.interface import Gone, Hint, Radio, RadioEvent, Restarted

BoardFormat = Literal["link", "sniffer", "sniffer-text", "listener"]
RADIO_OF: Final[dict[BoardFormat, str]] = {
    "link": "serial",
    "sniffer": "sniffer",
    "sniffer-text": "sniffer",
    "listener": "listener",
}
"""What ``--radio`` calls a board of each format."""


class Board:
    """A board from its radio to its serial port."""

    def __init__(
        self, radio: Radio, kind: Literal["anchor", "tag"], speaks: BoardFormat, link: Path | None, say: Log
    ) -> None:
        """``say`` is told in words what a person should know. Raises SkylessError."""
        self.radio, self._say = radio, say
        self.pty = Pty(link)
        self.speech: BoardProtocol
        if speaks == "link":
            self.speech = LinkProtocol(radio, self.pty.send, can_transmit=kind == "anchor")
        elif speaks == "listener":
            self.speech = ListenerProtocol(self.pty.send)
        else:
            self.speech = SnifferProtocol(self.pty.send, knows_binary=speaks == "sniffer")

    async def run(self) -> None:
        """Serve until cancelled."""
        self.pty.start(self.speech.hear_host)
        try:
            await self.radio.run(self._hear)
        finally:
            self.pty.close()

    def _hear(self, event: RadioEvent) -> None:
        if isinstance(event, Restarted):
            self._say(f"board {self.radio.name}: on the air")
        elif isinstance(event, Gone):
            self._say(f"board {self.radio.name}: {event.reason}; still looking for it")
        elif isinstance(event, Hint):
            self._say(f"board {self.radio.name}: {event.text}")
        self.speech.hear_radio(event)
